"""What to measure next: which reading would reduce the uncertainty of the tool tip over the volume most.

Every candidate that a workshop has is known by the readings that it would take: their design A on the state of a posterior
and their noise R, but no values. With S = G G' the covariance of the state, and W = R^-1/2 A G after its own unknowns
(zero of a run, pose of a plate, stations) are eliminated,

    S' = S - S A' (A S A' + R)^-1 A S = G (I + W' W)^-1 G'

(Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.2), and the mean square of u over the volume
is the trace of N (I + W' W)^-1 with N = G' M G and M the mean of F' F over its points, E = F times the state.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from typing import Any

import numpy as np

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, ERROR_INDEX, MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES, error_named
from compgen.drawing.charts import Picture, Plot, page_assets, picture_grid, svg
from compgen.errors import um_text
from compgen.identification.adjust.determined import Observations
from compgen.identification.adjust.unknowns import ErrorParameters
from compgen.identification.axis_tests import axis_observations, circle_design
from compgen.identification.options import IdentifyOptions
from compgen.identification.positions import artefact_observations
from compgen.identification.posterior import Posterior, posterior_of_values
from compgen.kinematics.first_order import c_matrix
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import full_grid

#: Levels of each axis at which u of the field is evaluated, in the middle of as many equal parts of the travel.
LEVELS = 5
#: A measurement is proposed if it takes this share of u, rms over the volume, and at most so many are.
USEFUL, MOST = 0.03, 8
#: What is said where nothing is proposed.
NOTHING_NEXT = "Nothing of what a workshop has would reduce the uncertainty over the volume by much."
#: An error counts as reduced if its standard uncertainty falls by this share.
REDUCED = 0.1
#: Where lines and set-ups away from the middle are, as shares of the travel.
LOW, MIDDLE, HIGH = 0.1, 0.5, 0.9

# Standard uncertainties of a reading with the usual instrument of a workshop, mm and rad.
#: Dial gauge on a straightedge or square (its own straightness included); autocollimator or level.
U_DIAL, U_ANGLE = 1.0 * MM_PER_UM, 3.0 * RAD_PER_URAD
#: Angle of a granite square as calibrated; ballbar; probed coordinate of a ball, and its calibration.
U_SQUARE, U_CIRCLE = 5.0 * RAD_PER_URAD, 1.0 * MM_PER_UM
U_PROBE_UM, U_BALL_UM = 1.0, 0.5
#: Laser tracer: of a length, constant and per mm; of the scale common to all, with temperatures read.
U_LENGTH, U_PER_MM, U_SCALE = 0.2 * MM_PER_UM, 0.2e-6, 0.7e-6
#: Positions along a line, readings of a circle in each direction, balls along a side of a plate, targets along an edge.
ALONG, AROUND, BALLS, TARGETS = 11, 18, 4, 5
#: Sizes of circles, squares and plates, mm, the largest that fits is used, within this share of the travel.
RADII_MM, EDGES_MM = (300.0, 200.0, 150.0, 100.0, 50.0), (630.0, 500.0, 400.0, 300.0, 200.0, 150.0, 100.0)
FITS = 0.9
#: Distance of tracer stations from the volume, mm.
AWAY_MM = 300.0


@dataclass(frozen=True)
class Candidate:
    """A measurement that could be made: in words, what it reads, and how its instrument stands.

    Parameters
    ----------
    code : kind of measurement; of each kind only the best candidate is proposed.
    what, how : in words; how it is done, and in which file its readings go.
    set_ups : how often something is set up: 1, or more for several set-ups.
    readings : of the errors of the state; their values mean nothing.
    lines_mm, points_mm : what its picture shows, in machine coordinates: lines (n, 3), and places (n, 3).
    options : those with which ``volcomp plan`` plans it in detail; empty if it does not.
    """

    code: str
    what: str
    how: str
    set_ups: int
    readings: Observations
    lines_mm: tuple[FloatArray, ...]
    points_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    options: str = ""


@dataclass(frozen=True)
class NextMeasurement:
    """A measurement that is proposed: u of the field over the volume (rms, um) before and after, and what it reduces.

    ``reduces`` are the errors whose standard uncertainty it reduces, those first that matter most.
    """

    candidate: Candidate
    u_before_um: float
    u_after_um: float
    reduces: tuple[str, ...]

    def summary(self, machine: Machine) -> dict[str, Any]:
        """Return one entry of ``next_measurements``."""
        own = self.candidate
        rounded = [np.round(line, 1).tolist() for line in own.lines_mm]
        return {
            "what": own.what,
            "code": own.code,
            "how": own.how,
            "command": f"volcomp plan {shlex.quote(str(machine.source))} {own.options} --out plan"
            if own.options
            else None,
            "set_ups": own.set_ups,
            "u_before_um": self.u_before_um,
            "u_after_um": self.u_after_um,
            "U_before_um": COVERAGE * self.u_before_um,
            "U_after_um": COVERAGE * self.u_after_um,
            "reduces": list(self.reduces),
            "picture": {
                "volume_mm": [list(axis.range_mm) for axis in machine.axes],
                "lines_mm": rounded,
                "points_mm": np.round(own.points_mm, 1).tolist(),
            },
        }


@dataclass(frozen=True)
class NextBest:
    """What to measure next, the most useful first.

    Parameters
    ----------
    machine : its travel.
    u_um : u of the field over the volume as it is known, rms, um.
    measurements : those that help; empty where everything is determined.
    largest : the error that is not determined and makes most of the uncertainty; empty where there is none.
    sentence : what is assumed of it.
    """

    machine: Machine
    u_um: float
    measurements: tuple[NextMeasurement, ...] = ()
    largest: str = ""
    sentence: str = ""

    @property
    def text(self) -> str:
        """What makes most of the uncertainty, and what would reduce it; empty where nothing is proposed."""
        if not self.measurements:
            return ""
        chosen: list[NextMeasurement] = []
        for least in (1, 2, 3):  # the best with one set-up, with two, with more; more work has to bring more
            found = [item for item in self.measurements if min(item.candidate.set_ups, 3) == least]
            if found and (not chosen or found[0].u_after_um < chosen[-1].u_after_um):
                chosen.append(found[0])
        first, *others = chosen
        said = f"{_capital(first.candidate.what)} would reduce u from {um_text(self.u_um)} to {um_text(first.u_after_um)} um"
        said += "".join(f", {item.candidate.what} down to {um_text(item.u_after_um)} um" for item in others)
        gain = f"{said} (rms over the volume)."
        return f"{self.sentence} {gain}"

    def summary(self) -> dict[str, Any]:
        """Return the keys ``next_measurements`` and ``next_text`` of the JSON files."""
        return {
            "next_measurements": [item.summary(self.machine) for item in self.measurements],
            "next_text": self.text,
        }


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def unmeasured(machine: Machine) -> Posterior:
    """Return what is known of a machine before anything is measured: its prior."""
    return posterior_of_values(machine, (), np.zeros(0), np.zeros(0), np.zeros((0, 0)))


def next_best(found: Posterior) -> NextBest:
    """Return what to measure next, from what is known of the errors of a machine.

    Examples
    --------
    >>> import compgen
    >>> from compgen.planning.next_measurement import next_best, unmeasured
    >>> next_best(unmeasured(compgen.load_machine("zha-gantry"))).measurements[0].candidate.code
    'laser_tracer'
    """
    with one_thread():
        volume = _Volume(found)
        if set(found.determined) >= set(found.names):
            return NextBest(found.machine, volume.rms_um())
        return _searched(found, volume)


def _searched(found: Posterior, volume: _Volume) -> NextBest:
    machine, before = found.machine, volume.rms_um()
    best: dict[str, tuple[float, Candidate]] = {}
    for candidate in candidates(found):
        after = volume.rms_um(candidate.readings)
        if candidate.code not in best or after < best[candidate.code][0]:
            best[candidate.code] = after, candidate
    useful = [(after, item) for after, item in best.values() if after <= (1.0 - USEFUL) * before]
    useful.sort(key=lambda pair: pair[0])
    chosen = [NextMeasurement(item, before, after, volume.reduced(item.readings)) for after, item in useful[:MOST]]
    open_errors = {name: share for name, share in volume.parts().items() if name not in found.determined}
    if not chosen or not open_errors:
        return NextBest(machine, before)
    largest = max(open_errors, key=lambda name: open_errors[name])
    share = open_errors[largest] / sum(volume.parts().values())
    return NextBest(machine, before, tuple(chosen), largest, _assumed(found, largest, share))


def _assumed(found: Posterior, name: str, share: float) -> str:
    """What is known of the error that makes most of the uncertainty, and how much of it, in two sentences."""
    error = error_named(name)
    part = f"It makes {100.0 * share:.0f} % of the remaining uncertainty."
    if name not in found.shown:
        # positioning errors grow with the travel, too
        scale = found.prior.scale(name) * found.machine.axes[error.axis].length_mm / error.si_per_unit
        size = COVERAGE * float(np.hypot(found.prior.size_um(name), scale))
        return f"Assumed, not measured: {error_words(name)} ({name}) up to {size:.3g} {error.unit} (k = 2). {part}"
    low, high = found.machine.axes[error.axis].range_mm
    u = float(found.curve(name, np.linspace(low, high, ALONG)).u.max()) / error.si_per_unit
    return f"Known least: {error_words(name)} ({name}) to {COVERAGE * u:.3g} {error.unit} (k = 2). {part}"


def error_words(name: str) -> str:
    """Return an error in words within a sentence, e.g. ``"yaw of X"`` of a machine whose Z is upright.

    >>> error_words("ECX"), error_words("EAZ"), error_words("EYX"), error_words("EB0Z")
    ('yaw of X', 'rotation of Z about X', 'straightness of X in Y', 'squareness of Z to X')
    """
    error = error_named(name)
    axis, across = AXES[error.axis], AXES[error.direction]
    if error.kind == "linear":
        return f"straightness of {axis} in {across}" if error.is_straightness else f"positioning of {axis}"
    if error.kind == "squareness":
        return f"squareness of {axis} to {'XYZ'[3 - error.direction - error.axis]}"
    if error.direction == error.axis:
        return f"roll of {axis}"
    if error.axis == 2:
        return f"rotation of {axis} about {across}"
    return f"{'yaw' if error.direction == 2 else 'pitch'} of {axis}"


class _Volume:
    """u of the field over the volume with what is known, and with readings in addition."""

    def __init__(self, found: Posterior) -> None:
        self.found = found
        shares = (np.arange(LEVELS) + 0.5) / LEVELS
        levels = [axis.range_mm[0] + shares * axis.length_mm for axis in found.machine.axes]
        at_mm = full_grid(levels).reshape(-1, 3)
        columns = c_matrix(found.machine, at_mm)
        count, r = len(at_mm), found.factor.shape[1]
        field_rows = np.zeros((count, 3, r))
        self.rows: dict[str, FloatArray] = {}  # of each error at its levels, (levels, r)
        self.weight: dict[str, FloatArray] = {}  # mean square lever of each level, (levels,)
        self.between = 0.0
        for name, span in found.layout.columns():
            column, axis = columns[:, :, ERROR_INDEX[name]], error_named(name).axis
            of = np.searchsorted(levels[axis], at_mm[:, axis])
            square = np.bincount(of, np.sum(column**2, axis=1), minlength=LEVELS) / count
            if name in SQUARENESS_NAMES:
                self.rows[name] = np.broadcast_to(found.factor[span], (LEVELS, r))
            else:
                weights, left = found.rows(name, levels[axis])
                self.rows[name] = weights @ found.factor[span]
                self.between += float(square @ np.maximum(np.diag(left), 0.0))
            self.weight[name] = square
            for output in np.flatnonzero(column.any(axis=0)):
                field_rows[:, output] += column[:, output, None] * self.rows[name][of]
        flat = field_rows.reshape(3 * count, r)
        self.inner = flat.T @ flat / count

    def whitened(self, readings: Observations) -> FloatArray:
        """W (k, r): the design of readings in units of their noise, their own unknowns eliminated."""
        read = readings.design.any(axis=0)
        shown = (readings.design[:, read] / readings.sigma[:, None]) @ self.found.factor[read]
        others = readings.others / readings.sigma[:, None]
        size = np.linalg.norm(others, axis=0)
        if not (size > 0).any():
            return np.asarray(shown)
        left, values, _ = np.linalg.svd(others[:, size > 0] / size[size > 0], full_matrices=False)
        own = left[:, values > 1e-9 * values[0]]
        return np.asarray(shown - own @ (own.T @ shown))

    def rms_um(self, readings: Observations | None = None) -> float:
        """Root mean square of u over the volume, um; with further readings."""
        square = float(np.trace(self.inner)) + self.between
        if readings is not None:
            w = self.whitened(readings)
            square -= float(np.vdot(np.linalg.solve(np.eye(len(w)) + w @ w.T, w), w @ self.inner))
        return float(np.sqrt(max(square, 0.0))) / MM_PER_UM

    def parts(self) -> dict[str, float]:
        """Mean square of u over the volume that each error makes, mm^2, their correlations left aside."""
        return {name: float(self.weight[name] @ np.sum(rows**2, axis=1)) for name, rows in self.rows.items()}

    def reduced(self, readings: Observations) -> tuple[str, ...]:
        """Errors whose standard uncertainty further readings reduce, by what that takes from u of the field."""
        w = self.whitened(readings)
        inverse = np.linalg.inv(np.eye(len(w)) + w @ w.T)
        gains = {}
        for name, rows in self.rows.items():
            seen = rows @ w.T
            before = np.sum(rows**2, axis=1)
            less = np.sum((seen @ inverse) * seen, axis=1)
            if less.sum() > (1.0 - (1.0 - REDUCED) ** 2) * before.sum():
                gains[name] = float(self.weight[name] @ less)
        return tuple(sorted((name for name, gain in gains.items() if gain > 0), key=lambda name: -gains[name]))


# --- what a workshop has --------------------------------------------------------------------------------------------


def candidates(found: Posterior) -> Iterator[Candidate]:
    """Yield what could be measured, with the readings that it would take."""
    at = _Places(found)
    for axis in range(3):
        yield from _runs(at, axis)
        yield from _straightedges(at, axis)
        yield from _angles(at, axis)
    for plane, (first, second) in PLANES.items():
        yield from _circles(at, plane)
        yield from _squares(at, first, second)
    yield from _plates(at)
    yield _tracer(at)


@dataclass(frozen=True)
class _Places:
    """Places in the travel of a machine, and readings there as readings of a posterior's state."""

    found: Posterior

    @cached_property
    def machine(self) -> Machine:
        return self.found.machine

    @cached_property
    def layout(self) -> ErrorParameters:
        return self.found.layout

    def at(self, x: float, y: float, z: float) -> FloatArray:
        """The place at shares of the travel of X, Y and Z, mm, to a tenth."""
        low, high = self.machine.lower_mm, self.machine.upper_mm
        return np.asarray(np.round(low + np.array([x, y, z]) * (high - low), 1))

    def line(self, axis: int, centre_mm: FloatArray, length_mm: float, count: int = ALONG) -> FloatArray:
        """Places (count, 3) along an axis, about the centre."""
        places = np.tile(centre_mm, (count, 1))
        places[:, axis] += np.linspace(-0.5, 0.5, count) * length_mm
        return places

    def text(self, place_mm: FloatArray, axes: Sequence[int]) -> str:
        """Coordinates of some axes, in words."""
        return ", ".join(f"{AXES[k]} {place_mm[k]:g}" for k in axes)

    def read(
        self,
        at_mm: FloatArray,
        direction: FloatArray,
        sigma_mm: float | FloatArray,
        others: Sequence[FloatArray],
        proper: Sequence[FloatArray] = (),
    ) -> Observations:
        """Displacements of the tool tip along unit vectors (n, 3); unknowns of their own, and those of unit variance."""
        count, known = len(at_mm), len(proper)
        design = np.einsum(
            "nd,ndp->np", direction, self.layout.design(c_matrix(self.machine, at_mm), self.layout.bases(at_mm))
        )
        own = np.zeros((count + known, len(others) + known))
        own[:count] = np.column_stack([*others, *proper])
        own[count:, len(others) :] = np.eye(known)
        return Observations(
            design=np.vstack([design, np.zeros((known, self.layout.size))]),
            others=own,
            value=np.zeros(count + known),
            sigma=np.concatenate([np.broadcast_to(sigma_mm, count), np.ones(known)]),
            at_mm=np.vstack([at_mm, np.full((known, 3), np.nan)]),
            shows=np.zeros((count + known, len(self.layout.curves)), dtype=bool),
        )

    def unit(self, axis: int, count: int) -> FloatArray:
        """The direction of an axis, (count, 3)."""
        return np.tile(np.eye(3)[axis], (count, 1))


def _runs(at: _Places, axis: int) -> Iterator[Candidate]:
    """Positioning runs along the middle of the others and near the corners of their travel."""
    lever = [k for k in range(3) if k != axis]
    letter, travel = AXES[axis], at.machine.axes[axis]
    corners = [(MIDDLE, MIDDLE), *((a, b) for a in (LOW, HIGH) for b in (LOW, HIGH))]
    for shares in corners:
        place = np.full(3, MIDDLE)
        place[lever] = shares
        line = at.line(axis, at.at(*place.tolist()), travel.length_mm)
        count = len(line)
        stated = {f"line_{AXES[k].lower()}_mm": line[:, k] for k in lever}
        runs = AxisRuns(
            axis=np.full(count, axis),
            position_mm=line[:, axis],
            direction=np.ones(count, dtype=np.int64),
            run=np.ones(count, dtype=np.int64),
            deviation_mm=np.zeros(count),
            covariates=stated,
        )
        comments = " and ".join(f"# line_{AXES[k].lower()}_mm = {line[0, k]:g}" for k in lever)
        yield Candidate(
            "axis_run",
            f"a pitch run along {letter} at {at.text(line[0], lever)} mm",
            f"laser or step gauge along {letter} with {at.text(line[0], lever)} mm; *.axis.csv with the comments {comments}",
            1,
            axis_observations(at.machine, at.layout, runs, at.found.prior),
            (line[[0, -1]],),
        )


def _straightedges(at: _Places, axis: int) -> Iterator[Candidate]:
    """A straightedge or stretched line along an axis, read across: its lay is unknown."""
    line = at.line(axis, at.at(MIDDLE, MIDDLE, MIDDLE), at.machine.axes[axis].length_mm)
    along = np.linspace(-1.0, 1.0, len(line))
    for across in (k for k in range(3) if k != axis):
        letter, read = AXES[axis], AXES[across]
        others = [k for k in range(3) if k != axis]
        yield Candidate(
            "straightedge",
            f"a straightedge along {letter}, read in {read}",
            f"dial gauge against a straightedge along {letter}, plunger in {read}, with {at.text(line[0], others)} mm; "
            f"straightness E{read}{letter} as *.errors.csv",
            1,
            at.read(line, at.unit(across, len(line)), U_DIAL, [np.ones(len(line)), along]),
            (line[[0, -1]], _arrow(line[len(line) // 2], across, at.machine)),
        )


def _angles(at: _Places, axis: int) -> Iterator[Candidate]:
    """Angles of a carriage by an autocollimator or a level, from an unknown zero."""
    letter, travel = AXES[axis], at.machine.axes[axis]
    line = at.line(axis, at.at(MIDDLE, MIDDLE, MIDDLE), travel.length_mm)
    position_mm = np.clip(line[:, axis], *travel.range_mm)
    for about in range(3):
        name = f"E{'ABC'[about]}{letter}"
        if name not in at.found.names:
            continue
        curve = Curve(position_mm, np.zeros(ALONG), np.full(ALONG, U_ANGLE))
        means = "a level" if about == axis else "a level or autocollimator"
        yield Candidate(
            "angles",
            f"{means} reading of the {error_words(name)} ({name})",
            f"{means} on the carriage of {letter}, angle about {AXES[about]} over {letter}"
            f"{' (a level where the axis lies horizontally)' if about == axis else ''}; {name} as *.errors.csv",
            1,
            Observations.of_curves(at.layout, ErrorTable({name: curve}, {})),
            (line[[0, -1]], _turn(line[len(line) // 2], about, at.machine)),
        )


def _circles(at: _Places, plane: str) -> Iterator[Candidate]:
    """Circles in a plane, in the middle and near both ends of the third axis."""
    first, second = PLANES[plane]
    third = 3 - first - second
    room_mm = 0.5 * FITS * min(at.machine.axes[k].length_mm for k in (first, second))
    radius_mm = next((radius for radius in RADII_MM if radius <= room_mm), None)
    if radius_mm is None:
        return
    turn = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    count = 2 * AROUND
    for share in (MIDDLE, LOW, HIGH):
        shares = np.full(3, MIDDLE)
        shares[third] = share
        centre = at.at(*shares.tolist())
        circles = Circles(
            plane=np.full(count, list(PLANES).index(plane)),
            angle_rad=np.tile(turn, 2),
            radius_mm=np.full(count, radius_mm),
            deviation_mm=np.zeros(count),
            direction=np.repeat([1, -1], AROUND),
            run=np.ones(count, dtype=np.int64),
            setup=np.zeros(count, dtype=np.int64),
            centre_mm=np.tile(centre, (count, 1)),
            u_mm=np.full(count, U_CIRCLE),
        )
        ring = centre + radius_mm * circles.part(np.append(np.arange(AROUND), 0)).radial()
        where = ",".join(f"{value:g}" for value in centre)
        yield Candidate(
            "circle",
            f"a circle in {plane}, radius {radius_mm:g} mm, at {AXES[third]} {centre[third]:g} mm",
            f"ballbar, centre {at.text(centre, range(3))} mm, both directions; *.circle.csv with the columns centre_x_mm, "
            "centre_y_mm, centre_z_mm",
            1,
            circle_design(at.machine, at.layout, circles, U_CIRCLE),
            (ring,),
            centre[None],
            f"--circle {plane}:{radius_mm:g}:{where}",
        )


def _squares(at: _Places, first: int, second: int) -> Iterator[Candidate]:
    """A granite square between two axes: both arms against the guides; how it lies is unknown, its angle calibrated."""
    room_mm = FITS * min(at.machine.axes[k].length_mm for k in (first, second))
    edge_mm = next((edge for edge in EDGES_MM if edge <= room_mm), None)
    if edge_mm is None:
        return
    first, second = min(first, second), max(first, second)
    centre = at.at(MIDDLE, MIDDLE, MIDDLE)
    to_corner = 0.5 * edge_mm * np.eye(3)
    arms = [at.line(axis, centre - to_corner[other], edge_mm) for axis, other in ((first, second), (second, first))]
    count = len(arms[0])
    places = np.vstack(arms)
    direction = np.vstack([at.unit(second, count), at.unit(first, count)])
    along = np.linspace(-0.5, 0.5, count) * edge_mm
    none, ones = np.zeros(count), np.ones(count)
    others = [np.append(ones, none), np.append(none, ones), np.append(along, -along) / edge_mm]
    names = f"{AXES[first]}{AXES[second]}"
    name = {"XY": "EC0Y", "XZ": "EB0Z", "YZ": "EA0Z"}[names]
    yield Candidate(
        "square",
        f"a granite square in {names}",
        f"dial gauge along both arms of a square, edge {edge_mm:g} mm, about {at.text(centre, range(3))} mm; "
        f"--squareness {name}=VALUE±U",
        1,
        at.read(places, direction, U_DIAL, others, [np.append(none, along * U_SQUARE)]),
        (arms[0][[0, -1]], arms[1][[0, -1]]),
    )


def _plates(at: _Places) -> Iterator[Candidate]:
    """A ball plate in one and in two set-ups: two heights, turned, upright."""
    spans = [FITS * axis.length_mm for axis in at.machine.axes]
    flat_mm = next((edge for edge in EDGES_MM if edge <= min(spans[:2])), None)
    tall_mm = next((edge for edge in EDGES_MM if edge <= min(spans)), None)
    if flat_mm is None:
        return
    middle, low, high = (at.at(MIDDLE, MIDDLE, share) for share in (MIDDLE, LOW, HIGH))
    still, turned = np.zeros(3), np.array([0.0, 0.0, 90.0])
    poses = [
        ("plate", "a ball plate in one set-up", [(middle, still)], flat_mm),
        ("plate_heights", "two set-ups of a ball plate, at two heights", [(low, still), (high, still)], flat_mm),
        (
            "plate_turned",
            "two set-ups of a ball plate, turned by 90 degrees",
            [(middle, still), (middle, turned)],
            flat_mm,
        ),
    ]
    if tall_mm is not None:
        stands = [("ZX", np.array([90.0, 0.0, 0.0])), ("YZ", np.array([0.0, -90.0, 0.0]))]
        for plane, turn in stands:
            text = f"two set-ups of a ball plate, flat and upright in {plane}"
            poses.append(("plate_upright", text, [(middle, still), (middle, turn)], tall_mm))
    for code, what, lies, edge_mm in poses:
        yield _plate(at, code, what, lies, edge_mm)


def _plate(
    at: _Places, code: str, what: str, poses: Sequence[tuple[FloatArray, FloatArray]], edge_mm: float
) -> Candidate:
    """A calibrated plate of balls in some poses: centre (mm) and rotation vector (degrees)."""
    side = np.linspace(-0.5, 0.5, BALLS) * edge_mm
    balls = np.column_stack([part.ravel() for part in np.meshgrid(side, side, [0.0], indexing="ij")])
    placed, lines, words = [], [], []
    corners = 0.5 * edge_mm * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, 1, 0]])
    for centre, turn in poses:
        rotation = _rotation(turn)
        placed.append(centre + balls @ rotation.T)
        lines.append(centre + corners[:5] @ rotation.T)
        numbers = [*centre.tolist(), *([turn[2]] if not turn[:2].any() else turn.tolist())]
        words.append("--pose " + ",".join(f"{value:g}" for value in (numbers if turn.any() else numbers[:3])))
    count = len(poses)
    artefact = Artefact(
        feature=[f"B{k}" for k in range(len(balls))] * count,
        nominal_mm=np.tile(balls, (count, 1)),
        u_nominal_mm=np.full((count * len(balls), 3), U_BALL_UM * MM_PER_UM),
        measured_mm=np.vstack(placed),
        setup=np.repeat(np.arange(count), len(balls)),
        calibrated=np.ones(count * len(balls), dtype=bool),
        metadata={"u_probe_um": f"{U_PROBE_UM:g}"},
    )
    observed, _, _ = artefact_observations(at.machine, at.layout, artefact, IdentifyOptions(), np.zeros(at.layout.size))
    where = "; ".join(f"{at.text(centre, range(3))} mm" for centre, _ in poses)
    return Candidate(
        code,
        what,
        f"calibrated plate of {BALLS} x {BALLS} balls, {edge_mm:g} mm, with the machine's probe, centre at {where}; "
        "*.artefact.csv",
        count,
        observed,
        tuple(lines),
        np.array([line[0] for line in lines]),
        f"--artefact plate.toml {' '.join(words)}",
    )


def _rotation(turn_deg: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector about one axis."""
    angle = float(np.radians(np.linalg.norm(turn_deg)))
    x, y, z = turn_deg / max(float(np.linalg.norm(turn_deg)), 1e-300)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross)


def _edges(low_mm: FloatArray, high_mm: FloatArray) -> FloatArray:
    """Targets (n, 3) along the 12 edges of the volume, which determine everything (docs/method.md)."""
    shares = np.linspace(0.0, 1.0, TARGETS)
    grid = full_grid([low_mm[k] + shares * (high_mm[k] - low_mm[k]) for k in range(3)]).reshape(-1, 3)
    at_end = (np.abs(grid - low_mm) < 1e-9) | (np.abs(grid - high_mm) < 1e-9)
    return np.asarray(grid[at_end.sum(axis=1) >= 2])


def _tracer(at: _Places) -> Candidate:
    """Lengths of a laser tracer from four stations around the volume to a grid of targets; stations unknown."""
    low, high = at.machine.lower_mm, at.machine.upper_mm
    tool = np.array(at.machine.tool_offset_mm)
    away = np.array([AWAY_MM, AWAY_MM, 0.0])
    stations = tool + np.array(
        [
            low - away,
            np.where([True, False, False], high + away, low - away),
            np.where([True, True, False], high + away, low),
            np.where([False, True, True], high + away, low - away),
        ]
    )
    targets = _edges(low, high)
    count, many = len(targets), len(stations)
    sight = (targets + tool)[None] - stations[:, None]
    distance = np.linalg.norm(sight, axis=2)
    unit = (sight / distance[:, :, None]).reshape(-1, 3)
    station = np.repeat(np.arange(many), count)
    own = [np.where(station == k, -unit[:, axis], 0.0) for k in range(many) for axis in range(3)]
    own += [(station == k).astype(np.float64) for k in range(many)]
    readings = at.read(
        np.tile(targets, (many, 1)), unit, U_LENGTH + U_PER_MM * distance.ravel(), own, [U_SCALE * distance.ravel()]
    )
    middle = at.at(MIDDLE, MIDDLE, MIDDLE) + tool
    return Candidate(
        "laser_tracer",
        "a laser tracer from four stations",
        "reflector in the spindle, lengths from four stations around the table, one of them higher, to positions along the 12 "
        "edges of the volume or more; *.lengths.csv",
        many,
        readings,
        tuple(np.array([place, middle]) - tool for place in stations),
        stations - tool,
        "--stations stations.csv --grid",
    )


# --- the picture ----------------------------------------------------------------------------------------------------


def _arrow(place_mm: FloatArray, axis: int, machine: Machine) -> FloatArray:
    """A short line along an axis: where a plunger acts."""
    reach = 0.12 * max(item.length_mm for item in machine.axes)
    return np.asarray(place_mm + np.outer([0.0, 1.0], reach * np.eye(3)[axis]))


def _turn(place_mm: FloatArray, about: int, machine: Machine) -> FloatArray:
    """Three quarters of a circle about an axis."""
    reach = 0.1 * max(item.length_mm for item in machine.axes)
    angle = np.linspace(0.0, 1.5 * np.pi, 13)
    first, second = ((about + 1) % 3, (about + 2) % 3)
    eye = np.eye(3)
    return np.asarray(place_mm + reach * (np.outer(np.cos(angle), eye[first]) + np.outer(np.sin(angle), eye[second])))


#: The picture of a set-up, and its part for the drawing.
SIZE, BOX = (250.0, 190.0), (8.0, 8.0, 242.0, 182.0)
#: Edges of a box between its corners; bits of the numbers are X, Y, Z.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]


def set_up_picture(entry: Mapping[str, Any], key: str) -> Picture:
    """Draw how the instrument of an entry of ``next_measurements`` stands in the working volume, seen from above.

    ValueError, KeyError or TypeError if the entry is not one.
    """
    drawn = entry["picture"]
    ranges = np.array(drawn["volume_mm"], dtype=np.float64)
    corners = np.array([[ranges[k, k_bit >> k & 1] for k in range(3)] for k_bit in range(8)])
    lines = [np.array(line, dtype=np.float64).reshape(-1, 3) for line in drawn["lines_mm"]]
    points = np.array(drawn["points_mm"], dtype=np.float64).reshape(-1, 3)
    flat = _seen(np.vstack([corners, *lines, points]))
    middle, half = 0.5 * (flat.min(axis=0) + flat.max(axis=0)), 0.5 * np.ptp(flat, axis=0)
    scale = 1.12 * max(half[0] / (BOX[2] - BOX[0]), half[1] / (BOX[3] - BOX[1]), 1e-9)
    wide, tall = scale * (BOX[2] - BOX[0]), scale * (BOX[3] - BOX[1])
    plot = Plot((middle[0] - wide, middle[0] + wide), (middle[1] - tall, middle[1] + tall), BOX, bare=True)
    for a, b in _EDGES:
        x, y = _seen(corners[[a, b]]).T
        plot.line(x, y, "grid", width=0.9)
    for axis, letter in enumerate(AXES):
        (x, y), end = 0.5 * (_seen(corners)[0] + _seen(corners)[1 << axis]), axis == 2
        plot.text(float(x), float(y), letter, anchor="middle", shift=(-7.0, 0.0) if end else (0.0, 9.0))
    for line in lines:
        x, y = _seen(line).T
        plot.line(x, y, "c1", width=2.0)
    if len(points):
        x, y = _seen(points).T
        plot.dots(x, y, "c0", size=6.0)
    title = str(entry["what"])
    return Picture(key, title, svg(key, title, [plot], SIZE), note="frame: the working volume")


def _seen(place_mm: FloatArray) -> FloatArray:
    """Places (n, 3) as seen from the front, from above: X to the right, Z up, Y away, (n, 2)."""
    x, y, z = place_mm.T
    return np.column_stack([x + 0.45 * y, z + 0.3 * y])


_TO_PRINT = "<p>To print and fill in: order.html beside this page, a sheet for each measurement.</p>"


def next_page(found: NextBest, assumed: str) -> str:
    """Return the text of ``plan.html``: what to measure next, and how each instrument stands. It loads nothing."""
    pictures = [
        replace(set_up_picture(item.summary(found.machine), f"next-{k}"), note=f"u {um_text(item.u_after_um)} µm")
        for k, item in enumerate(found.measurements)
    ]
    rows = "".join(
        f'<tr><th scope="row">{escape(item.candidate.what)}</th><td class="n">{um_text(item.u_after_um)}</td>'
        f"<td>{', '.join(item.reduces)}</td><td>{escape(item.candidate.how)}</td></tr>"
        for item in found.measurements
    )
    head = '<tr><th scope="col">measurement</th><th scope="col" class="n">u after, µm</th><th scope="col">reduces</th>'
    table = f'<div class="scroll"><table>{head}<th scope="col">how</th></tr>{rows}</table></div>'
    style, _, policy = page_assets()
    name = escape(found.machine.name)
    body = (
        f"<h1>What to measure next on {name}</h1><p>{escape(found.text or NOTHING_NEXT)}</p>"
        f'<p class="note">u of the tool tip over the volume now: {um_text(found.u_um)} µm rms (k = 1); {escape(assumed)}.</p>'
        + (table + picture_grid(pictures) + _TO_PRINT if pictures else "")
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: next measurement</title><style>{style}</style></head><body>\n{body}</body></html>\n"
    )
