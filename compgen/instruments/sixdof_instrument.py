"""The six-DOF instrument: its optics, the linear model of its signals, the instrument file, and its raw readings.

Signals = S_g errors + S_s systematics + S_d drift; :func:`error_matrix`, :func:`systematic_columns` and
:func:`drift_matrix` return these matrices, :func:`solve_errors` inverts the first. :func:`read_instrument` reads the
constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from compgen.data import toml_files
from compgen.data.csv_files import CsvTable, FloatArray
from compgen.data.machine import Vector3
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.records import AXIS, RUN, Field, Schema, within
from compgen.data.toml_files import part_setting, setting
from compgen.errors import InputError, Message, nearest

# Constants of the six-DOF laser instrument, and which error of which axis each of its channels sees.
#
# P. Jia, B. Zhang, F. Zheng, Q. Feng, Meas. Sci. Technol. 33 (2022) 015202, corrected by exact ray tracing.


#: Rows of every model matrix: interferometer, spots of beams 1 and 2, angle of the beam reflected by the film, in mm.
SIGNALS = ("displacement_mm", "y_qd1_mm", "z_qd1_mm", "y_qd2_mm", "z_qd2_mm", "y_psd1_mm", "z_psd1_mm")
#: Columns of the error matrix: along the beam, along the Y and the Z detector, about their axes, about the beam.
ROLES = ("along", "horizontal", "vertical", "yaw", "pitch", "roll")
#: ISO 230-1 names of the errors of X, Y and Z in the order of ROLES (Jia et al. 2022, eq. 5-7).
ERRORS_OF_AXIS = (
    ("EXX", "EYX", "EZX", "ECX", "EBX", "EAX"),
    ("EYY", "EXY", "EZY", "ECY", "EAY", "EBY"),
    ("EZZ", "EYZ", "EXZ", "EAZ", "EBZ", "ECZ"),
)
#: Machine axes of ``along``, ``horizontal``, ``vertical`` (translations) for X, Y and Z.
DIRECTIONS = ((0, 1, 2), (1, 0, 2), (2, 1, 0))
#: Machine axes of ``yaw``, ``pitch``, ``roll`` (rotations) for X, Y and Z.
ROTATIONS = ((2, 1, 0), (2, 0, 1), (0, 1, 2))
#: (along x horizontal) . vertical: the handedness of the channels at the target.
HANDEDNESS = (1, -1, -1)


@toml_files.accepts({**toml_files.accepted(toml_files.number), "not": {"const": 0}, "examples": [30.0]})
def _separation(value: Any) -> float:
    result = toml_files.number(value)
    if result == 0.0:
        raise ValueError("expected the separation of the beams, not zero")
    return result


_glass = toml_files.bounded("a refractive index between 1 and 4", exclusiveMinimum=1.0, exclusiveMaximum=4.0)


@dataclass(frozen=True)
class Optics:
    """Constants of the optics.

    Parameters
    ----------
    focal_length_mm : f of the lenses of the angle channels.
    beam_separation_mm : h, beam 2 runs at y = -h of the unit.
    glass_index : n of plate, cube corners and first prism.
    cube_side_mm : a, side of the equilateral entry face of the cube corner; its apex is sqrt(6) a / 6 behind it.
    plate_thickness_mm : L_D of the plate that carries the reflecting film in front of the cube corner.
    prism_leg_mm : b of the right-angle prisms.
    exit_to_prism_mm : l_0 from the exit (and detector) plane of the unit to the prism.
    """

    focal_length_mm: float = setting(toml_files.positive, 100.0, required=True)
    beam_separation_mm: float = setting(_separation, 30.0, required=True)
    glass_index: float = setting(_glass, 1.5151, required=True)
    cube_side_mm: float = setting(toml_files.positive, 30.0, required=True)
    plate_thickness_mm: float = setting(toml_files.not_negative, 3.0, required=True)
    prism_leg_mm: float = setting(toml_files.positive, 25.4)
    exit_to_prism_mm: float = setting(toml_files.not_negative, 0.0)

    @property
    def apex_depth_mm(self) -> float:
        """Depth of the cube's apex behind the front face of the plate, in glass."""
        return self.plate_thickness_mm + float(np.sqrt(6.0)) * self.cube_side_mm / 6.0

    @property
    def reduced_depth_mm(self) -> float:
        """The reduced depth t = (L_D + sqrt(6) a / 6) / n."""
        return self.apex_depth_mm / self.glass_index

    def reduced_prism_mm(self, axis: int) -> float:
        """Path through the prism of an axis, reduced by the index: none for X, b/n in glass for Y, b in air for Z."""
        return (0.0, self.prism_leg_mm / self.glass_index, self.prism_leg_mm)[axis]

    def lever_mm(self, axis: int) -> float:
        """l_p: from the reference point of the axis' translations to the exit plane if the unit moves."""
        return 0.0 if axis == 0 else 0.5 * self.prism_leg_mm


# The linear model of the instrument: signals = S_g g + S_s p + S_d alpha, and its closed-form inverse.
#
# Jia et al. 2022, eq. 5-7 with the corrections from exact ray tracing (``docs/sixdof.md``). Every matrix is made
# for a beam along the positive axis and rotated by half a turn about the vertical direction for one along the negative
# axis, whose horizontal channels are read with the opposite sign: a positive reading always means the positive axis.


Y1, Z1, Y2, Z2, YP, ZP = range(1, 7)
#: Signs of the signals and of the errors under half a turn about the vertical direction.
TURNED_SIGNALS = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
TURNED_ERRORS = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
TURNED_DRIFT = np.array([-1.0, 1.0])


@toml_files.accepts({"enum": [1, -1]})
def _beam_direction(value: Any) -> int:
    if value not in (1, -1) or isinstance(value, bool):
        raise ValueError("expected 1 (beam along the positive axis at the target) or -1")
    return int(value)


@dataclass(frozen=True)
class SetUp:
    """How one axis is measured.

    Parameters
    ----------
    axis : 0, 1, 2 for X, Y, Z.
    mode : 1: the target moves; 2: the unit and its prism move, the target is at rest.
    beam_direction : +1 or -1, the sense along the axis in which the beam meets the target.
    """

    axis: int
    mode: int = setting(toml_files.whole(1, 2), 1, required=True)
    beam_direction: int = setting(_beam_direction, 1)

    @property
    def sense(self) -> float:
        """+1 if the target moves, -1 if the unit does."""
        return 1.0 if self.mode == 1 else -1.0


def _turned(matrix: FloatArray, set_up: SetUp, columns: FloatArray) -> FloatArray:
    if set_up.beam_direction > 0:
        return matrix
    return np.asarray(TURNED_SIGNALS[:, None] * matrix * columns)


def _separation_mm(optics: Optics, set_up: SetUp) -> float:
    return optics.beam_separation_mm * set_up.beam_direction


def path_mm(optics: Optics, set_up: SetUp, distance_mm: FloatArray) -> FloatArray:
    """Full reduced path from the exit plane to the effective apex (capital lambda of the drift terms), (n,)."""
    ahead = optics.exit_to_prism_mm + optics.reduced_prism_mm(set_up.axis)
    return np.asarray(ahead + distance_mm + optics.reduced_depth_mm)


def cross_talk_arm_mm(optics: Optics, set_up: SetUp, distance_mm: FloatArray) -> FloatArray:
    """Arm by which an angle of the axis appears as straightness: +t if target moves, -(L + l_p + t) if unit moves."""
    if set_up.mode == 1:
        return np.full(np.shape(distance_mm), optics.reduced_depth_mm)
    return np.asarray(-(distance_mm + optics.lever_mm(set_up.axis) + optics.reduced_depth_mm))


def error_matrix(optics: Optics, set_up: SetUp, distance_mm: FloatArray) -> FloatArray:
    """S_g, shape (n, 7, 6): signals in mm per mm and rad of the errors of the axis in the order of ROLES."""
    kappa, s, f = HANDEDNESS[set_up.axis], set_up.sense, optics.focal_length_mm
    arm = cross_talk_arm_mm(optics, set_up, distance_mm)
    matrix = np.zeros((len(distance_mm), len(SIGNALS), 6))
    matrix[:, 0, 0] = s
    matrix[:, [Y1, Y2], 1] = 2.0 * s
    matrix[:, [Z1, Z2], 2] = 2.0 * s
    matrix[:, [Y1, Y2], 3] = 2.0 * kappa * arm[:, None]
    matrix[:, [Z1, Z2], 4] = -2.0 * kappa * arm[:, None]
    matrix[:, YP, 3] = -2.0 * f * kappa * s
    matrix[:, ZP, 4] = 2.0 * f * kappa * s
    matrix[:, Z2, 5] = -2.0 * kappa * _separation_mm(optics, set_up) * s
    return _turned(matrix, set_up, TURNED_ERRORS)


def drift_matrix(optics: Optics, set_up: SetUp, distance_mm: FloatArray) -> FloatArray:
    """S_d, shape (n, 7, 2): signals in mm per rad of the tilt of both beams toward unit +y and +z."""
    path = path_mm(optics, set_up, distance_mm)
    matrix = np.zeros((len(distance_mm), len(SIGNALS), 2))
    matrix[:, [Y1, Y2], 0] = -2.0 * path[:, None]
    matrix[:, [Z1, Z2], 1] = -2.0 * path[:, None]
    matrix[:, YP, 0] = matrix[:, ZP, 1] = optics.focal_length_mm
    return _turned(matrix, set_up, TURNED_DRIFT)


Columns = dict[str, FloatArray]


class _Builder:
    """Columns (n, 7) by parameter name, for a beam along the positive axis."""

    def __init__(self, optics: Optics, set_up: SetUp, distance_mm: FloatArray) -> None:
        self.optics, self.set_up, self.distance = optics, set_up, np.asarray(distance_mm, dtype=np.float64)
        self.kappa, self.f = HANDEDNESS[set_up.axis], optics.focal_length_mm
        self.h, self.t = _separation_mm(optics, set_up), optics.reduced_depth_mm
        self.path = path_mm(optics, set_up, self.distance)
        self.columns: Columns = {}

    def add(self, name: str, terms: Mapping[int | tuple[int, ...], FloatArray | float]) -> None:
        column = self.columns.setdefault(name, np.zeros((len(self.distance), len(SIGNALS))))
        for rows, value in terms.items():
            for row in (rows,) if isinstance(rows, int) else rows:
                column[:, row] += value

    def target(self) -> None:
        """Installation of the target about the front centre of its first cube corner."""
        along, horizontal, vertical = ("xyz"[k] for k in DIRECTIONS[self.set_up.axis])
        yaw, pitch, roll = ("xyz"[k] for k in ROTATIONS[self.set_up.axis])
        kappa, t, f = self.kappa, self.t, self.f
        self.add(f"delta_{along}ic", {0: 1.0})
        self.add(f"delta_{horizontal}ic", {(Y1, Y2): 2.0})
        self.add(f"delta_{vertical}ic", {(Z1, Z2): 2.0})
        self.add(f"eps_{yaw}ic", {(Y1, Y2): 2 * kappa * t, YP: -2 * f * kappa})
        self.add(f"eps_{pitch}ic", {(Z1, Z2): -2 * kappa * t, ZP: 2 * f * kappa})
        self.add(f"eps_{roll}ic", {Z2: -2 * kappa * self.h})

    def cubes(self) -> None:
        """Offset and angle of the beams that the two cube corners return, after leaving the front face."""
        _, horizontal, vertical = ("xyz"[k] for k in DIRECTIONS[self.set_up.axis])
        yaw, pitch, _ = ("xyz"[k] for k in ROTATIONS[self.set_up.axis])
        arm = self.path - self.t
        first = 2 * self.set_up.axis + 1
        for number, (y, z) in ((first, (Y1, Z1)), (first + 1, (Y2, Z2))):
            self.add(f"delta_{horizontal}mc{number}", {y: 1.0})
            self.add(f"delta_{vertical}mc{number}", {z: 1.0})
            self.add(f"eps_{yaw}mc{number}", {y: -self.kappa * arm})
            self.add(f"eps_{pitch}mc{number}", {z: self.kappa * arm})

    def beams(self) -> None:
        """Beam 2 not parallel to beam 1."""
        self.add("eps_PEy", {Z2: 2 * self.path, ZP: -self.f})
        self.add("eps_PEz", {Y2: -2 * self.path, YP: self.f})

    def first_prism(self) -> None:
        """Right-angle prism in glass, for Y: installation about the centre of its entrance face, angles of its faces."""
        n, b, t, f, distance = self.optics.glass_index, self.optics.prism_leg_mm, self.t, self.f, self.distance
        self.add("eps_zir", {(Y1, Y2): 2 * (2 * distance + 2 * t + b / n + b / 2), YP: -4 * f, 0: -b / 2})
        for name, arm in (("eps_xir", distance + t + b / 2), ("eps_yir", distance + t + b / n - b / 2)):
            self.add(name, {(Z1, Z2): -2 * arm, Z2: -2 * self.h, ZP: 2 * f})
        outer, inner = (n - 1) * (distance + t), (n - 1) * (distance + t) + b * (1 - 1 / n)
        self.add("eps_zmrs1", {(Y1, Y2): -2 * inner, YP: 2 * f * (n - 1)})
        self.add("eps_zmrs2", {(Y1, Y2): -2 * outer, YP: 2 * f * (n - 1)})
        self.add("eps_ymrs1", {(Z1, Z2): 2 * inner, ZP: -2 * f * (n - 1)})
        self.add("eps_xmrs2", {(Z1, Z2): 2 * outer, ZP: -2 * f * (n - 1)})
        self.add("delta_xir", {(Y1, Y2): -2.0, 0: 1.0})
        self.add("delta_yir", {(Y1, Y2): 2.0, 0: -1.0})

    def second_prism(self) -> None:
        """Right-angle prism that reflects on its outside, for Z."""
        b, t, f, distance = self.optics.prism_leg_mm, self.t, self.f, self.distance
        for name in ("eps_xir", "eps_zir"):
            self.add(name, {(Y1, Y2): 2 * (distance + t + b / 2), Z2: -2 * self.h, YP: -2 * f})
        self.add("eps_yir", {(Z1, Z2): -4 * (distance + 0.75 * b + t), ZP: 4 * f, 0: b / 2})
        self.add("delta_xir", {(Z1, Z2): -2.0, 0: 1.0})
        self.add("delta_zir", {(Z1, Z2): 2.0, 0: -1.0})


def systematic_columns(optics: Optics, set_up: SetUp, distance_mm: FloatArray) -> Columns:
    """S_s by parameter: signals in mm per mm or rad, each of shape (n, 7).

    Names as in the paper: ``delta_?ic, eps_?ic`` target installation, ``delta_?ir, eps_?ir`` prism installation,
    ``delta_?mc<k>, eps_?mc<k>`` cube corner k (1, 2 on X; 3, 4 on Y; 5, 6 on Z), ``eps_?mrs1, eps_?mrs2`` faces of the
    prism, ``eps_PEy, eps_PEz`` beam 2 against beam 1. Translations and rotations along and about machine axes.
    """
    builder = _Builder(optics, set_up, distance_mm)
    builder.target()
    builder.cubes()
    builder.beams()
    (lambda: None, builder.first_prism, builder.second_prism)[set_up.axis]()
    if set_up.beam_direction > 0:
        return builder.columns
    # half a turn about the vertical; beams are in the unit's frame: y is read with the opposite sign, z unchanged
    vertical, turned = "xyz"[DIRECTIONS[set_up.axis][2]], {}
    for name, column in builder.columns.items():
        rest = name.partition("_")[2]
        unchanged = rest != "PEz" if rest.startswith("PE") else rest[0] == vertical
        turned[name] = TURNED_SIGNALS * column * (1.0 if unchanged else -1.0)
    return turned


def systematic_signals(
    optics: Optics, set_up: SetUp, distance_mm: FloatArray, values: Mapping[str, float]
) -> FloatArray:
    """Signals of the systematic parameters ``values`` (mm, rad; those of other axes are ignored), (n, 7), mm."""
    columns = systematic_columns(optics, set_up, distance_mm)
    total = np.zeros((len(distance_mm), len(SIGNALS)))
    for name, value in values.items():
        if name in columns:
            total += value * columns[name]
    return total


def solve_errors(optics: Optics, set_up: SetUp, distance_mm: FloatArray, signals_mm: FloatArray) -> FloatArray:
    """Errors (n, 6), mm and rad in the order of ROLES, from signals (n, 7) without systematics and drift.

    S_g is triangular: angles first, then roll, then the translations with the cross-talk of the angles removed. The
    second horizontal spot is not needed.
    """
    matrix = error_matrix(optics, set_up, distance_mm)
    errors = np.zeros((len(distance_mm), 6))
    errors[:, 3] = signals_mm[:, YP] / matrix[:, YP, 3]
    errors[:, 4] = signals_mm[:, ZP] / matrix[:, ZP, 4]
    errors[:, 5] = (signals_mm[:, Z2] - signals_mm[:, Z1]) / matrix[:, Z2, 5]
    errors[:, 0] = signals_mm[:, 0] / matrix[:, 0, 0]
    errors[:, 1] = (signals_mm[:, Y1] - matrix[:, Y1, 3] * errors[:, 3]) / matrix[:, Y1, 1]
    errors[:, 2] = (signals_mm[:, Z1] - matrix[:, Z1, 4] * errors[:, 4]) / matrix[:, Z1, 2]
    return errors


# The instrument file: constants of the optics, the set-up of each axis, calibrated systematic parameters.


RAD_PER_ARCSEC = math.pi / 648000.0
#: Units of systematic parameters by the ending of their key, to mm or rad.
UNITS = {
    "eps": {"arcsec": RAD_PER_ARCSEC, "urad": 1e-6, "rad": 1.0},
    "delta": {"um": 1e-3, "mm": 1.0},
}
Line = Literal["ls", "minzone"]
#: Signs of S_xy, S_xz, S_yz (90 degrees minus the angle between the positive axes) in EC0Y, EB0Z, EA0Z.
SQUARENESS_SIGNS = (-1.0, 1.0, -1.0)


@toml_files.accepts({"anyOf": [{"enum": [1, -1]}, {**toml_files.array_schema({"enum": [1, -1]}, 3), "maxItems": 3}]})
def _signs(value: Any) -> tuple[float, float, float]:
    """One sign for all three, or a list of three: +1 keeps the program's convention, -1 reverses it."""
    turns = toml_files.numbers(value) if isinstance(value, list) else (toml_files.number(value),) * 3
    if len(turns) != 3 or any(turn not in (-1.0, 1.0) for turn in turns):
        raise ValueError("expected 1, -1, or a list of three of them (for XY, XZ, YZ)")
    x, y, z = (sign * turn for sign, turn in zip(SQUARENESS_SIGNS, turns, strict=True))
    return x, y, z


@toml_files.accepts({"anyOf": [{"const": 0}, toml_files.accepted(toml_files.vector3)]})
def _offset(value: Any) -> Vector3:
    """Three numbers, or 0."""
    if not isinstance(value, bool) and value == 0:
        return (0.0, 0.0, 0.0)
    return toml_files.vector3(value)


#: Constants whose standard uncertainty an instrument file may state.
U_CONSTANTS = (
    *(item.name for item in fields(Optics)),
    *("distance_first_mm", "drift_gain_percent", "parallel_drift_um", "displacement_ppm"),
)


#: Signals whose standard deviation an instrument file may state.
NOISE = ("displacement_um", "qd_um", "psd_um")


@dataclass(frozen=True)
class AxisSetUp:
    """How one axis was measured.

    Parameters
    ----------
    set_up : axis, mode and beam direction.
    distance_first_mm : L at the first target position of a run; None if the readings contain the distance.
    position_mm : where the other axes were (its own component does not count); None: machine zero.
    target_offset_mm : from the reference point of the tool (spindle nose) to the front centre of the first cube corner.
    systematics : calibrated parameters of this axis, mm and rad.
    """

    set_up: SetUp
    distance_first_mm: float | None = setting(toml_files.number, None)
    position_mm: Vector3 | None = setting(toml_files.vector3, None)
    target_offset_mm: Vector3 = setting(_offset, (0.0, 0.0, 0.0))
    systematics: Mapping[str, float] = part_setting(factory=dict)


@dataclass(frozen=True)
class SixDofInstrument:
    """A six-DOF laser instrument as its TOML file describes it.

    Parameters
    ----------
    optics : constants.
    axes : set-up of each measured axis by number (0, 1, 2).
    line : the line that is removed from straightness: least squares, or minimum zone.
    as_printed : use equations 5-7 as printed in the paper, only for comparison with it.
    squareness_signs : signs of S_xy, S_xz, S_yz in EC0Y, EB0Z, EA0Z.
    u_systematics : standard uncertainties of calibrated parameters, mm and rad.
    u_constants : standard uncertainties of constants by their key in the file.
    noise : standard deviations of the signals by name, mm.
    """

    optics: Optics
    axes: Mapping[int, AxisSetUp] = part_setting(
        lambda: {
            **toml_files.table_schema(
                {
                    letter: toml_files.section_schema(SetUp, AxisSetUp, systematics=systematics_schema(axis))
                    for axis, letter in enumerate(AXES)
                }
            ),
            "minProperties": 1,
        },
        required=True,
    )
    line: Line = setting(toml_files.choice("ls", "minzone"), "ls")
    as_printed: bool = setting(toml_files.flag, False)
    squareness_signs: tuple[float, float, float] = setting(_signs, SQUARENESS_SIGNS, key="squareness_sign")
    u_systematics: Mapping[str, float] = part_setting(
        lambda: systematics_schema(check=toml_files.not_negative), factory=dict
    )
    u_constants: Mapping[str, float] = part_setting(lambda: _numbers_schema(U_CONSTANTS), factory=dict)
    noise: Mapping[str, float] = part_setting(lambda: _numbers_schema(NOISE), factory=dict)
    source: Path | None = None


_KIND = toml_files.choice("sixdof-laser")


def known_systematics(axis: int | None = None) -> tuple[str, ...]:
    """Names of the systematic parameters of one axis, or of all."""
    at = np.zeros(1)
    axes = range(3) if axis is None else (axis,)
    return tuple(dict.fromkeys(name for k in axes for name in systematic_columns(Optics(), SetUp(k), at)))


def read_instrument(path: str | Path) -> SixDofInstrument:
    """Read an instrument TOML strictly; InputError with file, line and key."""
    return instrument_of(toml_files.read_toml(path))


def instrument_schema() -> dict[str, Any]:
    """Return the JSON schema of an instrument file."""
    kind = {**toml_files.accepted(_KIND), "description": "kind of the instrument", "required": True}
    common = {**systematics_schema(), "description": "calibrated parameters of every axis that has them"}
    return toml_files.section_schema(Optics, SixDofInstrument, kind=kind, systematics=common)


def instrument_of(root: toml_files.Section) -> SixDofInstrument:
    """Read the root of an instrument TOML as :func:`read_instrument` does."""
    root.take("kind", _KIND)
    optics = toml_files.take_settings(Optics, root)
    common = read_systematics(root.section("systematics", required=False))
    u_common = read_systematics(root.section("u_systematics", required=False), check=toml_files.not_negative)
    noise = _read_numbers(root.section("noise", required=False), NOISE)
    section = root.section("axes")
    axes = {}
    for axis, letter in enumerate(AXES):
        if letter not in section:
            continue
        entry = section.section(letter)
        set_up = toml_files.take_settings(SetUp, entry, axis=axis)
        own = read_systematics(entry.section("systematics", required=False), axis)
        known = {name: value for name, value in common.items() if name in known_systematics(axis)}
        axes[axis] = toml_files.read_settings(AxisSetUp, entry, set_up=set_up, systematics={**known, **own})
    section.finish()
    if not axes:
        raise section.fail("X", "no axis is described; give [axes.X], [axes.Y] or [axes.Z]")
    return toml_files.read_settings(
        SixDofInstrument,
        root,
        optics=optics,
        axes=axes,
        u_systematics=u_common,
        u_constants=_read_numbers(root.section("u_constants", required=False), U_CONSTANTS),
        noise={name.removesuffix("_um"): value * MM_PER_UM for name, value in noise.items()},
        source=root.path,
    )


def _read_numbers(section: toml_files.Section, names: tuple[str, ...]) -> dict[str, float]:
    found = {name: section.take(name, toml_files.not_negative) for name in names if name in section}
    section.finish()
    return found


def _numbers_schema(names: Sequence[str]) -> dict[str, Any]:
    return toml_files.table_schema(dict.fromkeys(names, toml_files.accepted(toml_files.not_negative)))


def systematics_schema(axis: int | None = None, check: Callable[[Any], float] = toml_files.number) -> dict[str, Any]:
    """Return the JSON schema of what :func:`read_systematics` reads."""
    names = known_systematics(axis)
    keys = [f"{name}_{unit}" for name in names for unit in UNITS[name.partition("_")[0]]]
    return toml_files.table_schema(dict.fromkeys(keys, toml_files.accepted(check)))


def read_systematics(
    section: toml_files.Section, axis: int | None = None, check: Callable[[Any], float] = toml_files.number
) -> dict[str, float]:
    """Read parameters with their unit at the end of the key (``eps_zir_arcsec``, ``delta_xic_um``) to mm and rad."""
    names, found = known_systematics(axis), {}
    for key in section.data:
        name, _, unit = key.rpartition("_")
        units = UNITS.get(name.partition("_")[0], {})
        if name not in names or unit not in units:
            allowed = [f"{n}_{'arcsec' if n.startswith('eps') else 'um'}" for n in names]
            raise section.fail(key, f"is not a systematic parameter; {nearest(key, allowed)}", kind="unknown")
        if name in found:
            raise section.fail(key, "is given twice, in two units")
        found[name] = section.take(key, check) * units[unit]
    section.finish()
    return found


# Raw readings of the instrument: ``*.sixdof.csv``.


SPOTS = ("y_qd1_mm", "z_qd1_mm", "z_qd2_mm", "y_psd1_mm", "z_psd1_mm", "y_psd2_mm", "z_psd2_mm")


@dataclass(frozen=True)
class SixDof:
    """Readings of runs along axes, n rows, one per target position.

    Parameters
    ----------
    axis : 0, 1, 2 of each row, (n,).
    position_mm : commanded position of that axis, (n,).
    run : number of the run, (n,).
    signals_mm : by column name, each (n,): spots, angles times focal length, interferometer; ``y_qd2_mm`` if present.
    distance_mm : absolute optical distance L of each row, nan if not given, (n,).
    direction : sign of travel, 0 if not given, (n,).
    covariates : ``time_s``, air and temperatures by column name, each (n,); ``phase_rad`` if the interferometer's
        phase was given instead of its displacement, which is then nan until :func:`compensated` computes it.
    metadata : comments ``key = value``.
    origin : (file, line) of each row.
    """

    axis: NDArray[np.int64]
    position_mm: FloatArray
    run: NDArray[np.int64]
    signals_mm: Mapping[str, FloatArray]
    distance_mm: FloatArray
    direction: FloatArray
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.position_mm)

    def runs(self) -> list[tuple[int, int, NDArray[np.int64]]]:
        """Return (axis, run, rows in their order) of every run, in the order of their first rows."""
        keys = list(dict.fromkeys(zip(self.axis.tolist(), self.run.tolist(), strict=True)))
        return [(axis, run, np.flatnonzero((self.axis == axis) & (self.run == run))) for axis, run in keys]


def _signal(table: CsvTable, column: str) -> FloatArray:
    """Read a signal; a spot farther out than any detector is wide indicates a wrong unit."""
    return (
        within(50.0, "mm", "exceeds the range of any detector; is the unit mm?")
        if column in SPOTS
        else CsvTable.numbers
    )(table, column)


_SIXDOF = Schema(
    (
        AXIS,
        Field("position_mm", ("position_mm",)),
        RUN,
        Field("signals_mm", (*SPOTS, "displacement_mm", "y_qd2_mm"), _signal, digits=9, presence="each"),
        Field("distance_mm", ("distance_mm",), presence="filled"),
        Field("direction", ("direction",), CsvTable.signs, digits=0, presence="filled", fill=0.0),
        # phase of an interferometer that does not output displacement; time, air and temperatures
        Field(
            "covariates", ("phase_rad", "time_s", "pressure_hpa", "humidity_percent"), digits=3, presence="covariates"
        ),
    ),
    keys=("axis", "position_mm", "run", "direction"),
    needed=SPOTS,
)


def read_sixdof(files: str | Path | Sequence[str | Path]) -> SixDof:
    """Read one or more ``*.sixdof.csv`` files strictly; the same run in two files is an error."""
    tables = _SIXDOF.read_tables(files)
    seen: dict[tuple[str, str], Path] = {}
    for table in tables:
        for key in dict.fromkeys(zip(table.columns["axis"], table.columns["run"], strict=True)):
            if key in seen:
                message = f"run {key[1]} of {key[0]} is also in {seen[key]}; number the runs of all files"
                raise InputError(message, file=table.path, field="column run")
            seen[key] = table.path
    for table in tables:  # each file needs exactly one kind of interferometer reading
        kinds = [name for name in ("displacement_mm", "phase_rad") if name in table.columns]
        if len(kinds) != 1:
            message = "contains both of them" if kinds else "contains neither of them"
            field = "columns displacement_mm, phase_rad"
            raise InputError(
                Message(
                    "interferometer-value",
                    "{message}; give the one that was read from the interferometer",
                    message=message,
                ),
                file=table.path,
                field=field,
            )
        if kinds[0] not in tables[0].columns:
            raise InputError(
                Message(
                    "columns-differ",
                    "has {kinds}, but {path} does not; use the same column in all files",
                    kinds=kinds[0],
                    path=tables[0].path,
                ),
                file=table.path,
            )
    parts = [SixDof(**_SIXDOF.values(table)) for table in tables]
    # the displacement is nan if the phase was read; the second spot counts only if all files have it
    second = ("y_qd2_mm",) if all("y_qd2_mm" in part.signals_mm for part in parts) else ()
    names = (*SPOTS, "displacement_mm", *second)
    for k, part in enumerate(parts):
        unknown = np.full(len(part), np.nan)
        parts[k] = replace(part, signals_mm={name: part.signals_mm.get(name, unknown) for name in names})
    return _SIXDOF.joined(parts)


def format_sixdof(readings: SixDof) -> str:
    """Return the text of a ``*.sixdof.csv`` file: signals in mm, 9 decimals; without columns not known in all rows."""
    signals = {name: values for name, values in readings.signals_mm.items() if not np.isnan(values).any()}
    unknown = {"distance_mm"} if np.isnan(readings.distance_mm).any() else set()
    unknown |= set() if readings.direction.any() else {"direction"}
    schema = Schema(tuple(field for field in _SIXDOF.fields if field.name not in unknown))
    return schema.format(replace(readings, signals_mm=signals), readings.metadata, decimals={"phase_rad": 6})
