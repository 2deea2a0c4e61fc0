"""Machines with known errors and the readings that a shop takes of them, for tests of what is stated about unknown errors.

It shares nothing with the program but the classes that contain readings: the tool tip follows from finite rotations along
the chain (``model.md`` of the papers: a carriage on the tool side shifts and turns what it carries, one on the workpiece
side the other way round), the errors from families that no kernel knows, and which errors a chain can show from its
levers. Lengths are mm, angles rad.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import Circles
from compgen.data.deviations import Artefact, Deviations
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.identification.any_measurement import MixedMeasurement
from machines import machine_of

Array = NDArray[np.float64]
LETTERS = "XYZ"
SQUARENESS = ("EC0Y", "EB0Z", "EA0Z")
PLANES = {"XY": (0, 1), "YZ": (1, 2), "ZX": (2, 0)}
#: Standard deviations of a machining centre (class "general"): mm, mm per mm, rad.
POSITIONING, SCALE, STRAIGHTNESS, ANGLE, SQUARE = 6e-3, 15e-6, 2.5e-3, 12e-6, 40e-6
#: Points of a true curve, far closer than readings and nodes.
FINE = 801


def is_angle(name: str) -> bool:
    """Whether an error turns a carriage."""
    return name[1] in "ABC"


def is_straightness(name: str) -> bool:
    """Whether an error shifts a carriage across its travel."""
    return not is_angle(name) and name[1] != name[2]


# --- true errors -----------------------------------------------------------------------------------------------------


def smooth(share: Array, rng: Generator) -> Array:
    """Waves of at most one and a half periods along the travel (0 to 1)."""
    waves = [rng.normal() * np.cos(np.pi * k * share + rng.uniform(0.0, 6.3)) / k for k in (1, 2, 3)]
    return np.asarray(sum(waves) / np.sqrt(0.5 * (1.0 + 1.0 / 4.0 + 1.0 / 9.0)))


def piecewise(share: Array, rng: Generator) -> Array:
    """Straight lines between 5 to 11 nodes."""
    nodes = np.linspace(0.0, 1.0, int(rng.integers(5, 12)))
    return np.asarray(np.interp(share, nodes, smooth(nodes, rng) + 0.15 * rng.normal(size=len(nodes))))


def cyclic(share: Array, rng: Generator) -> Array:
    """Smooth, with a wave of 25 to 60 periods and a fifth of the amplitude: a screw of 10 to 20 mm pitch."""
    return smooth(share, rng) + 0.2 * np.sqrt(2.0) * np.cos(
        2.0 * np.pi * rng.uniform(25.0, 60.0) * share + rng.uniform(0, 6.3)
    )


def walk(share: Array, rng: Generator) -> Array:
    """A random walk; its distance from its mean is 1 (rms) on average."""
    steps = np.cumsum(rng.normal(size=len(share)))
    return np.asarray((steps - steps.mean()) * np.sqrt(6.0 / len(share)))


def jumps(share: Array, rng: Generator) -> Array:
    """Smooth, with two steps where rails or scales are joined."""
    steps = sum(rng.normal(0.0, 0.5) * (share > rng.uniform(0.1, 0.9)) for _ in range(2))
    return np.asarray(smooth(share, rng) + steps)


FAMILIES: dict[str, Callable[[Array, Generator], Array]] = {
    "smooth": smooth,
    "piecewise": piecewise,
    "cyclic": cyclic,
    "walk": walk,
    "jumps": jumps,
}


@cache
def _root_of_the_prior(count: int) -> Array:
    d = np.abs(np.subtract.outer(np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, count)))
    s = np.sqrt(5.0) * d / 0.3
    kernel = (1.0 + s + s**2 / 3.0) * np.exp(-s) + 0.1**2 * np.exp(-d / 0.03)
    return np.asarray(np.linalg.cholesky(kernel + 1e-8 * np.eye(count)))


def of_the_prior(share: Array, rng: Generator) -> Array:
    """A draw of the process that the program assumes: Matern 5/2 of 0.3 of the travel, a tenth of it exponential of 0.03."""
    return np.asarray(_root_of_the_prior(len(share)) @ rng.normal(size=len(share)))


@dataclass(frozen=True)
class Truth:
    """All errors of a machine: values of each curve at closely spaced positions, and the squareness errors."""

    machine: Machine
    curves: dict[str, tuple[Array, Array]]
    squareness: dict[str, float]

    def value(self, name: str, at: Array) -> Array:
        """Value of one error at positions (m,); 0 for errors that the machine does not have."""
        if name in SQUARENESS:
            return np.full(np.shape(at), self.squareness.get(name, 0.0))
        return np.asarray(np.interp(at, *self.curves[name])) if name in self.curves else np.zeros(np.shape(at))

    def field(self, position: Array, tool: Sequence[float] | None = None) -> Array:
        """Actual minus commanded position of the tool tip in the workpiece frame, (n, 3)."""
        offset = np.array(self.machine.tool_offset_mm if tool is None else tool, dtype=float)
        left, right = self.machine.chain.name[1:-1].split("F")
        at = np.tile(offset, (len(position), 1))
        for letter in reversed(right):
            at = (
                self._travel(letter, position)
                + self._shift(letter, position)
                + _turned(self._turn(letter, position), at)
            )
        for letter in reversed(left):
            at = _turned(
                self._turn(letter, position), at + self._travel(letter, position) + self._shift(letter, position)
            )
        return np.asarray(at - position - offset)

    def _travel(self, letter: str, position: Array) -> Array:
        """Commanded travel of an axis along its direction, which is out of square."""
        axis = LETTERS.index(letter)
        turn = {
            "X": (0.0, 0.0, 0.0),
            "Y": (0.0, 0.0, self.squareness.get("EC0Y", 0.0)),
            "Z": (self.squareness.get("EA0Z", 0.0), self.squareness.get("EB0Z", 0.0), 0.0),
        }[letter]
        direction = _turned(np.array([turn]), np.eye(3)[[axis]])
        return position[:, [axis]] * direction

    def _shift(self, letter: str, position: Array) -> Array:
        return self._six(letter, position, "XYZ")

    def _turn(self, letter: str, position: Array) -> Array:
        return self._six(letter, position, "ABC")

    def _six(self, letter: str, position: Array, kinds: str) -> Array:
        at = position[:, LETTERS.index(letter)]
        return np.column_stack([self.value(f"E{kind}{letter}", at) for kind in kinds])

    def only(self, *names: str) -> Truth:
        """The same machine with no other errors."""
        curves = {name: curve for name, curve in self.curves.items() if name in names}
        return Truth(self.machine, curves, {name: v for name, v in self.squareness.items() if name in names})

    @classmethod
    def of_table(cls, machine: Machine, table: ErrorTable) -> Truth:
        """A machine whose errors are those of a table."""
        curves = {name: (curve.position_mm, curve.value) for name, curve in table.curves.items()}
        return cls(machine, curves, {name: value for name, (value, _) in table.squareness.items()})


def _turned(turn: Array, vector: Array) -> Array:
    """Vectors (n, 3) turned by rotation vectors (n, 3), by Rodrigues' formula."""
    angle = np.linalg.norm(turn, axis=1)[:, None]
    axis = np.divide(turn, angle, out=np.zeros_like(turn), where=angle > 0.0)
    along = np.sum(axis * vector, axis=1)[:, None]
    across = np.cross(axis, vector)
    return np.asarray(vector * np.cos(angle) + across * np.sin(angle) + axis * along * (1.0 - np.cos(angle)))


def shown_by_chain(machine: Machine) -> tuple[str, ...]:
    """Errors that one tool can tell from others: an angle needs the travel of another axis as a lever."""
    left, right = machine.chain.name[1:-1].split("F")
    names = []
    for letter in LETTERS:
        names += [f"E{along}{letter}" for along in LETTERS]
        levers = set(right.partition(letter)[2]) if letter in right else set(right) | set(left[left.index(letter) :])
        for about, parallel in zip("ABC", LETTERS, strict=True):
            if levers - {letter, parallel}:
                names.append(f"E{about}{letter}")
    return (*names, *SQUARENESS)


def drawn_machine(rng: Generator, chain: str = "WFYXZT", **fields: object) -> Machine:
    """A machine with travels of 300 to 1000 mm of any sign, zero at machine zero."""
    length = np.round(rng.uniform(300.0, 1000.0, 3), 1)
    low = np.round(np.where(rng.random(3) < 0.5, -length, -0.4 * length), 1)
    ranges = [(float(a), float(a + b)) for a, b in zip(low, length, strict=True)]
    return machine_of(ranges, [int(rng.integers(6, 9)) for _ in range(3)], chain, name="drawn", **fields)


def drawn_truth(
    machine: Machine,
    rng: Generator,
    family: Callable[[Array, Generator], Array],
    size: float = 1.0,
    spread: float = 0.3,
) -> Truth:
    """Errors of class "general" times ``size``, each curve and kind a little larger or smaller (``spread``)."""
    curves, share = {}, np.linspace(0.0, 1.0, FINE)
    for name in shown_by_chain(machine):
        if name in SQUARENESS:
            continue
        axis = LETTERS.index(name[2])
        low, high = machine.axes[axis].range_mm
        at = low + (high - low) * share
        sigma = ANGLE if is_angle(name) else STRAIGHTNESS if is_straightness(name) else POSITIONING
        value = sigma * family(share, rng) * np.exp(spread * rng.normal())
        if not is_angle(name) and not is_straightness(name):
            value = value + rng.normal(0.0, SCALE) * at
        if is_straightness(name):
            value = value - np.interp(at, [low, high], value[[0, -1]])
        else:
            value = value - np.interp(machine.reference_point_mm[axis], at, value)
        curves[name] = (at, size * value)
    squareness = {name: float(size * rng.normal(0.0, SQUARE)) for name in SQUARENESS}
    return Truth(machine, curves, squareness)


# --- readings --------------------------------------------------------------------------------------------------------


@dataclass
class Shop:
    """Takes readings of one machine; each method returns what a file of that kind contains.

    ``noise`` and ``setup`` are factors of the noise of readings, and of how far set-ups lie from where they were planned.
    """

    truth: Truth
    rng: Generator
    noise: float = 1.0
    setup: float = 1.0
    scale: float = field(default=0.0)

    def __post_init__(self) -> None:
        """One laser with one temperature for all axes: 1.5 um/m and 0.3 K of steel."""
        self.scale = self._lies(1.5e-6) + self._lies(0.3 * 11.5e-6)

    @property
    def machine(self) -> Machine:
        """The machine that is measured."""
        return self.truth.machine

    @property
    def middle(self) -> Array:
        """Middle of the travel."""
        return np.array([np.mean(axis.range_mm) for axis in self.machine.axes])

    def _read(self, u: float, shape: tuple[int, ...]) -> Array:
        """Noise of readings."""
        return self.noise * self.rng.normal(0.0, u, shape)

    def _lies(self, u: float, size: int | None = None) -> Any:
        """How far something lies from its planned place."""
        return self.setup * self.rng.normal(0.0, u, size)

    def _along(self, axis: int, count: int, span: float) -> Array:
        low, high = self.machine.axes[axis].range_mm
        return np.asarray(0.5 * (low + high) + 0.5 * span * (high - low) * np.linspace(-1.0, 1.0, count))

    def runs(
        self, axes: str = "XYZ", *, line: Array | None = None, stated: bool = True, span: float = 1.0, count: int = 11
    ) -> AxisRuns:
        """Positioning along lines with a laser: five runs both ways, each with a zero of its own."""
        at_line = np.zeros(3) if line is None else np.asarray(line)
        rows = []
        for letter in axes:
            axis = LETTERS.index(letter)
            position = np.tile(at_line, (count, 1))
            position[:, axis] = self._along(axis, count, span)
            error = self.truth.field(position)[:, axis] + self.scale * position[:, axis]
            for run in range(1, 6):
                zero = self._lies(0.2e-3)
                for way in (1, -1):
                    read = error - error[0] + zero + self._read(0.3e-3, (count,))
                    rows += [(axis, at, way, run, value) for at, value in zip(position[:, axis], read, strict=True)]
        table = np.array(rows)
        where = (
            {f"line_{a.lower()}_mm": np.full(len(table), at_line[k]) for k, a in enumerate(LETTERS)} if stated else {}
        )
        whole = table[:, [0, 2, 3]].astype(np.int64)
        return AxisRuns(whole[:, 0], table[:, 1], whole[:, 1], whole[:, 2], table[:, 4], covariates=where)

    def circles(self, planes: Sequence[str] = ("XY",), *, off_centre: float = 0.0, u: float = 0.3e-3) -> Circles:
        """A ball bar of 150 mm at most, both ways; its length and the pivot, set where the tool stood, are unknown."""
        parts = []
        for number, (plane, (i, j)) in enumerate(PLANES.items()):
            if plane not in planes:
                continue
            length = [axis.range_mm[1] - axis.range_mm[0] for axis in self.machine.axes]
            radius, centre = min(150.0, 0.45 * min(length[i], length[j])), self.middle
            room = np.array([0.5 * length[k] - (radius if k in (i, j) else 0.0) for k in range(3)])
            centre = np.round(centre + off_centre * room * self.rng.uniform(-1.0, 1.0, 3), 1)
            angle = np.radians(np.arange(0.0, 360.0, 2.0))
            unit = np.zeros((len(angle), 3))
            unit[:, i], unit[:, j] = np.cos(angle), np.sin(angle)
            position = centre + radius * unit
            pivot, zero = self._lies(3e-3, 3), self._lies(2e-3)
            moved = self.truth.field(position) - self.truth.field(centre[None, :])
            distance = np.linalg.norm(radius * unit + moved - pivot, axis=1)
            for way in (1, -1):
                read = distance - radius + zero + self._read(u, (len(angle),))
                ones = np.ones(len(angle), dtype=np.int64)
                parts.append(
                    (
                        number * ones,
                        angle,
                        radius * ones,
                        read,
                        way * ones,
                        ones,
                        0 * ones,
                        np.tile(centre, (len(angle), 1)),
                    )
                )
        columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
        return Circles(*columns, np.full(len(columns[0]), np.nan))

    def straightedges(self, *names: str, u: float = 0.3e-3, count: int = 13) -> ErrorTable:
        """Straightness along straightedges, each of which lies askew."""
        curves = {}
        for name in names:
            at = self._along(LETTERS.index(name[2]), count, 1.0)
            lay = self._lies(1e-2) + self._lies(1e-4) * (at - at[0])
            curves[name] = Curve(at, self.truth.value(name, at) + lay + self._read(u, (count,)), np.full(count, u))
        return ErrorTable(curves, {}, {"squareness": "not measured"} if len(names) > 1 else {})

    def squares(self, *names: str, u: float = 2e-6) -> ErrorTable:
        """Squareness errors as numbers."""
        chosen = names or SQUARENESS
        return ErrorTable({}, {name: (self.truth.squareness[name] + float(self._read(u, ())), u) for name in chosen})

    def positions(self, levels: Sequence[int] = (6, 6, 6), *, u: float = 0.5e-3, only: str = "XYZ") -> Deviations:
        """Deviations on a grid, in a frame that is shifted and turned a little; components ``only``."""
        position = self._grid([self._along(k, n, 0.9 if n == 1 else 1.0) for k, n in enumerate(levels)])
        return self._posed(position, u, only, {})

    def part(self, levels: Sequence[int] = (6, 6, 2), *, u: float = 1e-3, only: str = "XYZ") -> Deviations:
        """Holes of a part drilled by the machine, measured elsewhere; the pose is unknown."""
        position = self._grid([self._along(k, n, 0.8) for k, n in enumerate(levels)])
        return self._posed(position, u, only, {"measured": "part"})

    def _grid(self, along: Sequence[Array]) -> Array:
        return np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3)

    def _posed(self, position: Array, u: float, only: str, metadata: dict[str, str]) -> Deviations:
        tip = position + self.truth.field(position)
        middle = position.mean(axis=0)
        turn = np.tile(self._lies(2e-4, 3), (len(position), 1))
        seen = _turned(turn, tip - middle) + middle + self._lies(0.05, 3)
        deviation = seen - position + self._read(u, position.shape)
        deviation[:, [letter not in only for letter in LETTERS]] = np.nan
        known = np.where(np.isnan(deviation), np.nan, u)
        return Deviations(position, deviation, known, metadata=metadata)

    def plate(self, heights: int = 1, *, count: int = 5, u: float = 0.5e-3) -> Artefact:
        """A calibrated ball plate in the XY plane, probed by the machine at one or several heights; its pose is unknown."""
        length = [axis.range_mm[1] - axis.range_mm[0] for axis in self.machine.axes]
        pitch = 0.8 * min(length[:2]) / (count - 1)
        balls = self._grid([pitch * np.arange(count), pitch * np.arange(count), np.zeros(1)])
        levels = np.linspace(*self.machine.axes[2].range_mm, heights + 2)[1:-1]
        parts = []
        for number, z in enumerate(levels):
            lying = balls - balls.mean(axis=0)
            turn = np.tile(self._lies(1e-4, 3), (len(balls), 1))
            place = _turned(turn, lying) + [*self.middle[:2], z] + self._lies(0.05, 3)
            measured = place - self.truth.field(place) + self._read(u, place.shape)
            parts.append(([f"B{k}" for k in range(len(balls))], balls, measured, np.full(len(balls), number)))
        names = [name for part in parts for name in part[0]]
        nominal, measured, setup = (np.concatenate([part[k] for part in parts]) for k in (1, 2, 3))
        known = np.ones(len(names), dtype=bool)
        return Artefact(names, nominal, np.full(nominal.shape, np.nan), measured, setup, known)

    def lengths(self, stations: int = 4, *, span: float = 1.0, levels: int | None = None, u: float = 0.3e-3) -> Lengths:
        """Displacements seen by tracers around the volume, at the nodes of the machine or at evenly spaced levels."""
        machine = self.machine
        along = [
            axis.nodes_mm if levels is None and span == 1.0 else self._along(k, levels or len(axis.nodes_mm), span)
            for k, axis in enumerate(machine.axes)
        ]
        position = self._grid(along)
        low, high = (np.array([axis.range_mm[k] for axis in machine.axes]) for k in (0, 1))
        corners = np.array([(0, 0, 0), (1, 0, 0.1), (1, 1, 0.02), (0, 1, 0.9)])[:stations]
        places = low + corners * (high - low) + 200.0 * np.sign(corners - 0.5) * [1.0, 1.0, 0.8]
        tip = position + self.truth.field(position)
        read, station = [], []
        for number, place in enumerate(places):
            distance = np.linalg.norm(tip - place - self._lies(1.0, 3), axis=1)
            read.append(distance - (150.0 + number) + self._lies(1.0) + self._read(u, (len(tip),)))
            station.append(np.full(len(tip), number))
        points = [str(k) for k in range(len(tip))] * len(places)
        return Lengths(
            tuple(f"S{k + 1}" for k in range(len(places))),
            np.concatenate(station),
            points,
            np.tile(position, (len(places), 1)),
            np.concatenate(read),
        )


Reading = AxisRuns | Circles | ErrorTable | Deviations | Artefact | Lengths


def together(*parts: Reading) -> object:
    """One measurement of several readings, each with a name of its own."""
    if len(parts) == 1:
        return parts[0]
    return MixedMeasurement(tuple((f"{k}-{type(part).__name__}", part) for k, part in enumerate(parts)))


#: The mixture whose curves have nodes where the readings are.
FROM_DATA = "tracer, inner 60 %"
#: What shops measure: the rows of the table in ``benchmarks/prior_coverage.py``.
MIXTURES: dict[str, Callable[[Shop], object]] = {
    "pitch": lambda shop: together(shop.runs()),
    "pitch at mid-travel": lambda shop: together(shop.runs(line=shop.middle)),
    "pitch, nobody knows where": lambda shop: together(shop.runs(line=shop.middle, stated=False)),
    "pitch + squareness": lambda shop: together(shop.runs(), shop.squares()),
    "pitch + 1 circle": lambda shop: together(shop.runs(), shop.circles()),
    "pitch + 2 circles": lambda shop: together(shop.runs(), shop.circles(("XY", "YZ"))),
    "pitch + 3 circles": lambda shop: together(shop.runs(), shop.circles(tuple(PLANES))),
    "pitch + 3 circles off centre": lambda shop: together(shop.runs(), shop.circles(tuple(PLANES), off_centre=0.8)),
    "pitch + 3 circles + straightedges": lambda shop: together(
        shop.runs(), shop.circles(tuple(PLANES)), shop.straightedges(*filter(is_straightness, shop.truth.curves))
    ),
    "pitch + flat plate": lambda shop: together(shop.runs(), shop.plate()),
    "pitch + 3 circles + plate": lambda shop: together(shop.runs(), shop.circles(tuple(PLANES)), shop.plate()),
    "pitch + 3 circles + plate at 2 heights": lambda shop: together(
        shop.runs(), shop.circles(tuple(PLANES)), shop.plate(2)
    ),
    "circle + plate": lambda shop: together(shop.circles(), shop.plate()),
    "part": lambda shop: together(shop.part()),
    "pitch, inner 60 %": lambda shop: together(shop.runs(span=0.6)),
    "pitch, inner 60 % + squareness": lambda shop: together(shop.runs(span=0.6), shop.squares()),
    FROM_DATA: lambda shop: together(shop.lengths(span=0.6)),
    "tracer": lambda shop: together(shop.lengths()),
    "everything": lambda shop: together(
        shop.lengths(), shop.runs(), shop.circles(tuple(PLANES)), shop.plate(2), shop.squares()
    ),
}
CHAINS = ("WFYXZT", "WXFYZT", "WXYFZT")


def case(number: int, *, family: str | None = None, size: float = 1.0, seed: int = 0, **fields: object) -> Shop:
    """The shop number ``number``: chain and family of errors take turns."""
    rng = np.random.default_rng([seed, number])
    machine = drawn_machine(rng, CHAINS[number % len(CHAINS)], **fields)
    kind = family or tuple(FAMILIES)[number % len(FAMILIES)]
    make = of_the_prior if kind == "prior" else FAMILIES[kind]
    spread = 0.0 if kind == "prior" else 0.3
    return Shop(drawn_truth(machine, rng, make, size, spread), rng)


# --- what a reading shows ---------------------------------------------------------------------------------------------


def values(reading: Reading) -> Array:
    """Everything that was read, (m,)."""
    if isinstance(reading, ErrorTable):
        parts = [
            *(curve.value for curve in reading.curves.values()),
            [value for value, _ in reading.squareness.values()],
        ]
        return np.concatenate(parts)
    if isinstance(reading, Lengths):
        return reading.length_mm
    read = reading.measured_mm if isinstance(reading, Artefact) else reading.deviation_mm
    return np.asarray(read[np.isfinite(read)])


#: Set-ups and errors are this much smaller than usual, so that readings depend on them linearly.
TINY = 1e-3


def shown_by(shop: Shop, take: Callable[[Shop], Reading]) -> set[str]:
    """Errors that change a reading in a way that its set-up (zeros, centre, pose, stations, lay) cannot.

    By trial: each error in three shapes, one after the other, against thirty set-ups.
    """
    machine, share = shop.machine, np.linspace(0.0, 1.0, FINE)
    perfect = Truth(machine, {}, dict.fromkeys(SQUARENESS, 0.0))

    def read(truth: Truth, setup: float = 0.0, seed: int = 0) -> Array:
        return values(take(Shop(truth, np.random.default_rng(seed), noise=0.0, setup=setup)))

    plan = read(perfect)
    setups = np.column_stack([read(perfect, TINY, seed) - plan for seed in range(30)])
    left, size, _ = np.linalg.svd(setups, full_matrices=False)
    basis = left[:, size > 1e-5 * max(size[0], 1e-12)]
    shown = set()
    for name in shown_by_chain(machine):
        shapes = []
        for shape in (share * (1.0 - share), share * (1.0 - share) * (0.4 - share), np.sin(3.0 * np.pi * share)):
            if name in SQUARENESS:
                shapes.append(Truth(machine, {}, perfect.squareness | {name: TINY * SQUARE}))
                continue
            axis = machine.axes[LETTERS.index(name[2])]
            at = axis.range_mm[0] + (axis.range_mm[1] - axis.range_mm[0]) * share
            zero = (
                0.0
                if is_straightness(name)
                else np.interp(machine.reference_point_mm[LETTERS.index(name[2])], at, shape)
            )
            size_of = ANGLE if is_angle(name) else STRAIGHTNESS
            shapes.append(Truth(machine, {name: (at, TINY * size_of * (shape - zero))}, perfect.squareness))
        changes = np.column_stack([read(truth) - plan for truth in shapes])
        if np.abs(changes - basis @ (basis.T @ changes)).max() > 1e-3 * TINY * STRAIGHTNESS:
            shown.add(name)
    return shown
