"""The simulated six-DOF instrument: exact ray tracer, raw signals, measurement."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine, Vector3
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import part_setting, setting
from compgen.errors import InputError, Message
from compgen.instruments.sixdof_instrument import (
    DIRECTIONS,
    RAD_PER_ARCSEC,
    ROTATIONS,
    SIGNALS,
    Optics,
    SixDof,
    SixDofInstrument,
    known_systematics,
    read_instrument,
    read_systematics,
    systematics_schema,
)
from compgen.instruments.sixdof_reduction import expected_away
from compgen.kinematics.exact_chain import tip_position

# Exact vector ray tracer of the six-DOF instrument: refraction and reflection at planes, cube corner, prism, plate.
#
# Written from the geometry alone, not from the linear model; it replaces the ray tracing program of Jia et al. 2022.
#
# Frame of the unit: beam 1 leaves along +x on y = z = 0, beam 2 at y = -h; the detectors are in the exit plane. X: the
# beam goes straight on, the front face of the target is at x = L. Y: prism 1 with entrance face x = -b/2, reflector y =
# x, exit face y = b/2. Z: prism 2 reflects on its outside at z = x. Front faces at b/2 + L behind a prism. A beam along
# the negative axis is the same layout after half a turn about the vertical direction.


X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class RigidPose:
    """A rigid placement x -> turn x + shift_mm; ``turn`` (3, 3) is a rotation."""

    turn: FloatArray = field(default_factory=lambda: np.eye(3))
    shift_mm: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __matmul__(self, inner: RigidPose) -> RigidPose:
        """Apply ``inner`` first, then this one."""
        return RigidPose(self.turn @ inner.turn, self.turn @ inner.shift_mm + self.shift_mm)

    def inverse(self) -> RigidPose:
        """The placement undone."""
        return RigidPose(self.turn.T, -self.turn.T @ self.shift_mm)

    def about(self, pivot_mm: FloatArray) -> RigidPose:
        """Return the same rotation about ``pivot_mm``."""
        return RigidPose(self.turn, self.shift_mm + pivot_mm - self.turn @ pivot_mm)


def rotation(vector_rad: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector, rad."""
    angle = float(np.linalg.norm(vector_rad))
    matrix = np.array(
        [
            [0.0, -vector_rad[2], vector_rad[1]],
            [vector_rad[2], 0.0, -vector_rad[0]],
            [-vector_rad[1], vector_rad[0], 0.0],
        ]
    )
    once, twice = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + once * matrix + twice * matrix @ matrix)


@dataclass(frozen=True)
class Ray:
    """A ray: a point, a unit direction, and the optical path so far, mm."""

    point_mm: FloatArray
    direction: FloatArray
    path_mm: float = 0.0


@dataclass(frozen=True)
class OpticalPlane:
    """A plane through ``point_mm`` with unit ``normal``."""

    point_mm: FloatArray
    normal: FloatArray

    def placed(self, pose: RigidPose) -> OpticalPlane:
        """Return the plane moved by ``pose``."""
        return OpticalPlane(pose.turn @ self.point_mm + pose.shift_mm, pose.turn @ self.normal)

    def turned(self, vector_rad: FloatArray) -> OpticalPlane:
        """Return the plane rotated about its point."""
        return OpticalPlane(self.point_mm, rotation(vector_rad) @ self.normal)


def _advance(ray: Ray, plane: OpticalPlane, index: float) -> Ray:
    """Propagate to the plane, through a medium of refractive ``index``."""
    distance = float((plane.point_mm - ray.point_mm) @ plane.normal / (ray.direction @ plane.normal))
    return Ray(ray.point_mm + distance * ray.direction, ray.direction, ray.path_mm + index * distance)


def reflect(ray: Ray, plane: OpticalPlane, index: float = 1.0) -> Ray:
    """Propagate to the plane in a medium of ``index`` and reflect."""
    there = _advance(ray, plane, index)
    direction = there.direction - 2.0 * (there.direction @ plane.normal) * plane.normal
    return Ray(there.point_mm, direction, there.path_mm)


def refract(ray: Ray, plane: OpticalPlane, before: float, after: float) -> Ray:
    """Propagate to the plane in a medium of index ``before`` and refract into one of index ``after`` (Snell, as vectors)."""
    there = _advance(ray, plane, before)
    cosine = float(there.direction @ plane.normal)
    normal = plane.normal if cosine > 0 else -plane.normal
    ratio, cosine = before / after, abs(cosine)
    inside = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
    return Ray(there.point_mm, ratio * there.direction + (inside - ratio * cosine) * normal, there.path_mm)


@dataclass(frozen=True)
class Geometry:
    """Nominal layout for one axis.

    Parameters
    ----------
    axis : 0, 1, 2 for X, Y, Z.
    exit_mm : x of the exit and detector plane.
    target : from the target's own frame (beam along +x, its horizontal along +y) to the unit's frame at distance 0.
    """

    axis: int
    exit_mm: float
    target: RigidPose


def _geometry(optics: Optics, axis: int) -> Geometry:
    half, ahead = 0.5 * optics.prism_leg_mm, optics.exit_to_prism_mm
    if axis == 0:
        return Geometry(0, -ahead, RigidPose())
    along = np.eye(3)[axis]
    turn = np.column_stack([along, *((Y, Z) if axis == 0 else (Z, X) if axis == 1 else (X, Y))])
    return Geometry(axis, -half - ahead, RigidPose(turn, half * along))


BeamPath = Callable[[Ray], Ray]


def _vector(values: Mapping[str, float], kind: str, suffix: str) -> FloatArray:
    return np.array([values.get(f"{kind}_{letter}{suffix}", 0.0) for letter in "xyz"])


def _pose(values: Mapping[str, float], suffix: str) -> RigidPose:
    return RigidPose(rotation(_vector(values, "eps", suffix)), _vector(values, "delta", suffix))


class Tracer:
    """The instrument set up at one axis with its systematic parameters (mm, rad, names of the linear model)."""

    def __init__(
        self,
        optics: Optics,
        axis: int,
        mode: int = 1,
        beam_direction: int = 1,
        systematics: Mapping[str, float] | None = None,
    ) -> None:
        self.optics, self.mode, self.beam_direction = optics, mode, beam_direction
        self.half_turn = np.eye(3)
        if beam_direction < 0:
            self.half_turn = 2.0 * np.outer(np.eye(3)[DIRECTIONS[axis][2]], np.eye(3)[DIRECTIONS[axis][2]]) - np.eye(3)
        self.values = {}  # in the frame of the layout: machine axes after the half turn; beam tilts by their channel
        for name, value in (systematics or {}).items():
            rest = name.partition("_")[2]
            if rest.startswith("PE"):
                self.values[name] = value * (beam_direction if rest == "PEz" else 1)
            else:
                self.values[name] = value * float(self.half_turn["xyz".index(rest[0]), "xyz".index(rest[0])])
        self.geometry = _geometry(optics, axis)
        self._out, self._back = self._prism(self.values)

    def _prism(self, values: Mapping[str, float]) -> tuple[BeamPath, BeamPath]:
        """The path from unit to target and back through the prism of the axis."""
        axis, n = self.geometry.axis, self.optics.glass_index
        half = 0.5 * self.optics.prism_leg_mm
        pose = _pose(values, "ir").about(np.array([-half, 0.0, 0.0]))
        if axis == 0:
            return (lambda ray: ray), (lambda ray: ray)
        if axis == 2:
            mirror = OpticalPlane(np.zeros(3), (X - Z) / np.sqrt(2.0)).placed(pose)
            return (lambda ray: reflect(ray, mirror)), (lambda ray: reflect(ray, mirror))
        entrance = OpticalPlane(-half * X, X).turned(_vector(values, "eps", "mrs1")).placed(pose)
        mirror = OpticalPlane(np.zeros(3), (X - Y) / np.sqrt(2.0)).placed(pose)
        leave = OpticalPlane(half * Y, Y).turned(_vector(values, "eps", "mrs2")).placed(pose)

        def out(ray: Ray) -> Ray:
            return refract(reflect(refract(ray, entrance, 1.0, n), mirror, n), leave, n, 1.0)

        def back(ray: Ray) -> Ray:
            return refract(reflect(refract(ray, leave, 1.0, n), mirror, n), entrance, n, 1.0)

        return out, back

    def _target(self, travel_mm: float, distance_mm: float, delta_mm: FloatArray, eps_rad: FloatArray) -> RigidPose:
        """Pose of the target's frame (origin: front centre at beam 1) in the frame of the unit."""
        along = self.geometry.target.turn[:, 0]
        start = RigidPose(shift_mm=self.geometry.target.shift_mm + distance_mm * along)
        install = _pose(self.values, "ic")
        delta, eps = self.half_turn @ delta_mm, self.half_turn @ eps_rad
        if self.mode == 1:
            moved = start @ RigidPose(rotation(eps), delta + travel_mm * along)
        else:
            moved = RigidPose(rotation(eps), delta + travel_mm * along).inverse() @ start
        return moved @ install @ RigidPose(self.geometry.target.turn)

    def signals(
        self,
        distance_mm: float,
        delta_mm: FloatArray,
        eps_rad: FloatArray,
        *,
        drift_rad: tuple[float, float] = (0.0, 0.0),
        travel_mm: float = 0.0,
    ) -> FloatArray:
        """Signals in mm in the order of SIGNALS, shape (7,).

        Parameters
        ----------
        distance_mm : L at travel 0, from the exit face of the prism (X: exit plane, less l_0) to the front face.
        delta_mm, eps_rad : motion errors of the moving body in machine axes, each (3,): of the target about the front
            centre of its first cube corner (mode 1), of unit and prism about the point where beam 1 meets the
            reflector (X: the exit point) (mode 2).
        drift_rad : tilt of both beams toward unit +y and +z, as in the channels.
        travel_mm : travel of the moving body from the position of L, along the beam.
        """
        optics, geometry = self.optics, self.geometry
        pose = self._target(travel_mm, distance_mm, np.asarray(delta_mm), np.asarray(eps_rad))
        flip = float(self.beam_direction)
        tilt = np.array([flip * drift_rad[0], drift_rad[1]])
        first = self._beam(np.zeros(2), tilt)
        parallel = np.array([self.values.get("eps_PEz", 0.0), -self.values.get("eps_PEy", 0.0)])
        second = self._beam(np.array([-flip * optics.beam_separation_mm, 0.0]), tilt + parallel)
        number = 2 * geometry.axis + 1
        spot1, path = self._spot(first, pose, number)
        spot2, _ = self._spot(second, pose, number + 1, offset=-flip * optics.beam_separation_mm)
        # behind the angle lens: the beam that the film on the front face reflects
        film = OpticalPlane(np.zeros(3), X).placed(pose)
        direction = self._back(reflect(self._out(second), film)).direction
        angle = optics.focal_length_mm * direction[1:] / abs(direction[0])
        prism = (0.0, optics.prism_leg_mm * optics.glass_index, optics.prism_leg_mm)[geometry.axis]
        nominal = distance_mm + optics.exit_to_prism_mm + prism + optics.apex_depth_mm * optics.glass_index
        displacement = 0.5 * path - nominal
        result = np.array(
            [displacement, flip * spot1[0], spot1[1], flip * spot2[0], spot2[1], flip * angle[0], angle[1]]
        )
        assert len(result) == len(SIGNALS)
        return result

    def _beam(self, offset_mm: FloatArray, tilt_rad: FloatArray) -> Ray:
        direction = np.array([1.0, tilt_rad[0], tilt_rad[1]])
        point = np.array([self.geometry.exit_mm, offset_mm[0], offset_mm[1]])
        return Ray(point, direction / np.linalg.norm(direction))

    def _spot(self, ray: Ray, pose: RigidPose, number: int, offset: float = 0.0) -> tuple[FloatArray, float]:
        """Spot (y, z) of the beam that cube corner ``number`` returns, and the total optical path."""
        n = self.optics.glass_index
        # front plane of the plate, and the three mirrors that meet at the apex behind it, ``offset`` from beam 1
        across = np.eye(3)[DIRECTIONS[self.geometry.axis][1]]
        apex = self.geometry.target.turn.T @ across * offset + self.optics.apex_depth_mm * X
        front = OpticalPlane(np.zeros(3), X).placed(pose)
        mirrors = [OpticalPlane(apex, normal).placed(pose) for normal in _TRIAD]
        ray = refract(self._out(ray), front, 1.0, n)
        for mirror in mirrors:
            ray = reflect(ray, mirror, n)
        ray = refract(ray, front, n, 1.0)
        turned = rotation(_vector(self.values, "eps", f"mc{number}")) @ ray.direction
        ray = Ray(ray.point_mm + _vector(self.values, "delta", f"mc{number}"), turned, ray.path_mm)
        end = _advance(self._back(ray), OpticalPlane(self.geometry.exit_mm * X, X), 1.0)
        return end.point_mm[1:] - np.array([offset, 0.0]), end.path_mm


#: Three perpendicular unit normals, one a row, all at the same angle to +x.
_DIAGONAL, _ACROSS = np.ones(3) / np.sqrt(3.0), np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
_TRIAD = np.column_stack([_DIAGONAL, _ACROSS, np.cross(_DIAGONAL, _ACROSS)])


# Raw signals of the six-DOF instrument on a virtual machine: exact chain, exact ray tracer.


def tool_pose(machine: Machine, truth: ErrorTable, position_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pose of the tool's body in the workpiece frame at positions (n, 3): origin (n, 3) in mm, rotation (n, 3, 3)."""
    values = truth.at(position_mm)
    origin = tip_position(machine, values, position_mm, np.zeros(3))
    columns = [tip_position(machine, values, position_mm, unit) - origin for unit in np.eye(3)]
    return origin, np.stack(columns, axis=2)


def run_positions(machine: Machine, instrument: SixDofInstrument, axis: int, along_mm: FloatArray) -> FloatArray:
    """Return the positions of all axes while ``axis`` moves to ``along_mm`` (n,), shape (n, 3)."""
    position = np.tile(np.array(instrument.axes[axis].position_mm or (0.0, 0.0, 0.0)), (len(along_mm), 1))
    position[:, axis] = along_mm
    return position


def run_signals(
    machine: Machine,
    truth: ErrorTable,
    instrument: SixDofInstrument,
    axis: int,
    along_mm: FloatArray,
    drift_rad: FloatArray | None = None,
    first_mm: float | None = None,
    scatter: FloatArray | None = None,
) -> FloatArray:
    """Signals (n, 7) of one run, in mm and in the order of SIGNALS; the interferometer's with its travel.

    Chain and mode determine where unit and target are. The one on the workpiece does not move in the workpiece frame;
    the one at the tool has the offset ``target_offset_mm`` (the target's front centre, or the unit's reference point).

    Parameters
    ----------
    along_mm : commanded positions of the axis, (n,).
    drift_rad : tilt of the beams toward unit +y, +z, (n, 2); None for no drift.
    first_mm : position of ``distance_first_mm``; default: the first position.
    scatter : additional motion of the body at the tool, translations in mm and rotations in rad, (n, 6).
    """
    from scipy.spatial.transform import Rotation  # imported here: slow to load, and few commands simulate

    entry, optics = instrument.axes[axis], instrument.optics
    position = run_positions(machine, instrument, axis, along_mm)
    offset = np.array(entry.target_offset_mm)
    origin, turn = tool_pose(machine, truth, position)
    added = np.zeros((len(along_mm), 6)) if scatter is None else scatter
    moved = origin + np.einsum("nij,j->ni", turn, offset) - position - offset + added[:, :3]
    at_tool = expected_away(machine, instrument)[axis] > 0
    tracer = Tracer(optics, axis, 1 if at_tool else 2, entry.set_up.beam_direction, entry.systematics)
    start = along_mm[0] if first_mm is None else first_mm
    travel = entry.set_up.beam_direction * (along_mm - start)
    tilt = np.zeros((len(along_mm), 2)) if drift_rad is None else drift_rad
    angles = Rotation.from_matrix(turn).as_rotvec() + added[:, 3:]
    return np.array(
        [
            tracer.signals(
                float(entry.distance_first_mm or 0.0),
                moved[k],
                angles[k],
                drift_rad=tuple(tilt[k]),
                travel_mm=travel[k],
            )
            for k in range(len(along_mm))
        ]
    )


# A simulated measurement with the six-DOF instrument: runs along every axis, noise, drift, and uncalibrated parameters.


#: Mean of the largest half range of 3 runs over 17 positions, in standard deviations of a reading.
HALF_RANGE = 1.75
#: Half ranges of X, Y, Z in Table 3 of Jia et al. 2022 in the order of ROLES: um, um, um, arcsec, arcsec, arcsec.
TABLE_3 = (
    (0.090, 0.96, 1.21, 0.30, 0.53, 2.03),
    (0.010, 0.33, 0.71, 0.54, 0.23, 1.19),
    (0.070, 0.34, 0.84, 0.78, 0.83, 1.58),
)
_KEYS = ("positioning_um", "horizontal_um", "vertical_um", "yaw_arcsec", "pitch_arcsec", "roll_arcsec")
_UNITS = np.array([MM_PER_UM] * 3 + [RAD_PER_ARCSEC] * 3)
_NOISE = {"displacement_um": (0,), "qd_um": (1, 2, 3, 4), "psd_um": (5, 6)}


#: Keys of positions that are equally spaced.
_SPAN = ("from", "to", "step")


@toml_files.accepts(
    {
        "anyOf": [
            toml_files.accepted(toml_files.ascending),
            toml_files.table_schema(dict.fromkeys(_SPAN, toml_files.accepted(toml_files.number)), _SPAN),
        ]
    }
)
def _positions(value: Any) -> tuple[float, ...]:
    """Target positions: a list, or a table with from, to and step."""
    if not isinstance(value, dict):
        return toml_files.ascending(value)
    if set(value) != set(_SPAN):
        raise ValueError(
            Message("positions-expected", "expected a list of positions, or {{ from = .., to = .., step = .. }}")
        )
    low, high, step = (toml_files.number(value[key]) for key in _SPAN)
    if not (high > low and step > 0 and (high - low) / step < 10000):
        raise ValueError("expected from below to, and a step above zero")
    return tuple((low + step * np.arange(int(np.floor((high - low) / step + 1e-9)) + 1)).tolist())


@dataclass(frozen=True)
class SimulatedSixDof:
    """How the axes are measured.

    Parameters
    ----------
    instrument : constants, set-up and calibrated parameters, as in the instrument file.
    uncalibrated : further parameters of the instrument that the instrument file does not contain, mm and rad.
    runs, there_and_back : number of runs of each axis, and whether each run returns.
    positions_mm : target positions by axis; None takes the machine's nodes.
    scatter : standard deviation of each reading by axis in the order of ROLES, (3, 6), mm and rad: repeatability of the
        machine.
    noise_mm : standard deviation of the signals in the order of SIGNALS, then of the two of the drift monitor, (9,).
    drift_rad : standard deviation of the change of beam tilt from reading to reading, rad.
    reversal_mm : reversal value of each axis.
    seconds : time between readings.
    """

    instrument: SixDofInstrument = part_setting(
        lambda: toml_files.accepted(toml_files.text_of_path), key="file", required=True, meaning="the instrument file"
    )
    uncalibrated: Mapping[str, float] = part_setting(lambda: systematics_schema(), factory=dict)
    runs: int = setting(toml_files.whole(1, 100), 3)
    there_and_back: bool = setting(toml_files.flag, False)
    positions_mm: tuple[FloatArray | None, FloatArray | None, FloatArray | None] = part_setting(
        lambda: toml_files.table_schema(dict.fromkeys(AXES, toml_files.accepted(_positions))), (None, None, None)
    )
    scatter: FloatArray = part_setting(
        lambda: {"anyOf": [{"const": "table3"}, toml_files.table_schema(dict.fromkeys(AXES, _sizes_schema(_KEYS)))]},
        factory=lambda: np.zeros((3, 6)),
    )
    noise_mm: FloatArray = part_setting(lambda: _sizes_schema(_NOISE), factory=lambda: np.zeros(9), key="noise")
    drift_rad: float = setting(toml_files.not_negative, 0.0, key="drift_arcsec_per_reading", unit=RAD_PER_ARCSEC)
    reversal_mm: Vector3 = setting(toml_files.vector3, (0.0, 0.0, 0.0), key="reversal_um", unit=MM_PER_UM)
    seconds: float = setting(toml_files.positive, 5.0, key="seconds_per_reading")

    @property
    def true_instrument(self) -> SixDofInstrument:
        """The true instrument."""
        axes = {}
        for k, entry in self.instrument.axes.items():
            names = dict.fromkeys([*entry.systematics, *(n for n in self.uncalibrated if n in known_systematics(k))])
            total = {name: entry.systematics.get(name, 0.0) + self.uncalibrated.get(name, 0.0) for name in names}
            axes[k] = replace(entry, systematics=total)
        return replace(self.instrument, axes=axes)

    def measure(self, machine: Machine, truth: ErrorTable, rng: np.random.Generator) -> SixDof:
        """Return the readings on the exactly moved machine, all axes and runs one after another."""
        blocks: list[tuple[NDArray[Any], ...]] = []
        tilt = np.zeros(2)
        for axis in sorted(self.instrument.axes):
            along, direction = self._path(machine, axis)
            for run in range(1, self.runs + 1):
                drift = tilt + np.cumsum(self.drift_rad * rng.standard_normal((len(along), 2)), axis=0)
                tilt = drift[-1]
                drawn = rng.standard_normal((len(along), 6)) * self.scatter[axis]
                moved = np.zeros((len(along), 6))
                moved[:, list(DIRECTIONS[axis])] = drawn[:, :3]
                moved[:, [3 + k for k in ROTATIONS[axis]]] = drawn[:, 3:]
                moved[:, axis] += 0.5 * direction * self.reversal_mm[axis]
                signals = run_signals(machine, truth, self.true_instrument, axis, along, drift, None, moved)
                monitor = self.instrument.optics.focal_length_mm * drift
                noise = rng.standard_normal((len(along), 9)) * self.noise_mm
                signals = np.hstack([signals, monitor]) + noise
                blocks.append((np.full(len(along), axis), along, np.full(len(along), run), direction, signals))
        return self._readings(machine, blocks)

    def _path(self, machine: Machine, axis: int) -> tuple[FloatArray, FloatArray]:
        """Positions of one run and the direction of travel at each."""
        given = self.positions_mm[axis]
        there = machine.axes[axis].nodes_mm if given is None else given
        low, high = machine.axes[axis].range_mm
        if there.min() < low - 1e-9 or there.max() > high + 1e-9:
            raise InputError(
                Message(
                    "positions-exceed-travel",
                    "positions from {there:g} to {there2:g} mm exceed the travel of {value}, {low:g} to {high:g} mm",
                    there=there.min(),
                    there2=there.max(),
                    value=AXES[axis],
                    low=low,
                    high=high,
                ),
                field=f"[instrument.positions_mm] {AXES[axis]}",
            )
        if not self.there_and_back:
            return there, np.zeros(len(there))
        return np.concatenate([there, there[::-1]]), np.repeat([1.0, -1.0], len(there))

    def _readings(self, machine: Machine, blocks: list[tuple[NDArray[Any], ...]]) -> SixDof:
        axis, along, run, direction, signals = (np.concatenate(column) for column in zip(*blocks, strict=True))
        names = (*SIGNALS, "y_psd2_mm", "z_psd2_mm")
        return SixDof(
            axis=axis.astype(np.int64),
            position_mm=np.asarray(along, dtype=np.float64),
            run=run.astype(np.int64),
            signals_mm=dict(zip(names, signals.T, strict=True)),
            distance_mm=np.full(len(along), np.nan),
            direction=np.asarray(direction, dtype=np.float64),
            covariates={"time_s": np.asarray(self.seconds * np.arange(len(along)), dtype=np.float64)},
            metadata={"machine": machine.name, "instrument": "sixdof-laser"},
        )


def read_sixdof_measurement(section: toml_files.Section) -> SimulatedSixDof:
    """A laser instrument that reads all six errors of an axis in one run: *.sixdof.csv.

    Read from the section ``[instrument]`` of a scenario, without its ``type``, strictly.
    """
    path = section.file("file")
    if path is None:
        raise section.fail("file", "is missing; give the instrument TOML, relative to the scenario")
    instrument = read_instrument(path)
    positions = section.section("positions_mm", required=False)
    targets = [positions.take(letter, _positions, None) for letter in AXES]
    uncalibrated = read_systematics(section.section("uncalibrated", required=False))
    # standard deviations (3, 6) of the readings in the order of ROLES: Table 3 of the paper, given ones, or zero
    if section.data.get("scatter") == "table3":
        section.take("scatter", toml_files.choice("table3"))
        scatter = np.array(TABLE_3) * _UNITS / HALF_RANGE
    else:
        given, scatter = section.section("scatter", required=False), np.zeros((3, 6))
        for axis, letter in enumerate(AXES):
            entry = given.section(letter, required=False)
            scatter[axis] = [entry.take(key, toml_files.not_negative, 0.0) for key in _KEYS]
            entry.finish()
        given.finish()
        scatter = scatter * _UNITS
    measurement = toml_files.take_settings(
        SimulatedSixDof,
        section,
        instrument=instrument,
        uncalibrated=uncalibrated,
        positions_mm=tuple(None if value is None else np.asarray(value) for value in targets),
        scatter=np.asarray(scatter),
        noise_mm=_noise(section.section("noise", required=False), instrument),
    )
    positions.finish()
    section.finish()
    return measurement


def _sizes_schema(keys: Iterable[str]) -> dict[str, Any]:
    return toml_files.table_schema(dict.fromkeys(keys, toml_files.accepted(toml_files.not_negative)))


def _noise(section: toml_files.Section, instrument: SixDofInstrument) -> FloatArray:
    """Return standard deviations (9,) of the signals: the given ones, otherwise those of the instrument file."""
    result = np.zeros(9)
    for key, places in _NOISE.items():
        stated = instrument.noise.get(key.removesuffix("_um"), 0.0) / MM_PER_UM
        value = MM_PER_UM * section.take(key, toml_files.not_negative, stated)
        result[list(places)] = value
        if key == "psd_um":
            result[7:] = value
    section.finish()
    return result
