"""The linear model of the instrument: signals = S_g g + S_s p + S_d alpha, and its closed-form inverse.

Jia et al. 2022, eq. 5-7 with the corrections that exact ray tracing asks for (``docs/sixdof.md``). Every matrix is made
for a beam along the positive axis and turned by half a turn about the vertical direction for one along the negative
axis, whose horizontal channels are read with the opposite sign: a positive reading always means the positive axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.sixdof.optics import DIRECTIONS, HANDEDNESS, ROTATIONS, SIGNALS, Optics

Y1, Z1, Y2, Z2, YP, ZP = range(1, 7)
#: Signs of the signals and of the errors under half a turn about the vertical direction.
TURNED_SIGNALS = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0])
TURNED_ERRORS = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])
TURNED_DRIFT = np.array([-1.0, 1.0])


@dataclass(frozen=True)
class SetUp:
    """How one axis is measured.

    Parameters
    ----------
    axis : 0, 1, 2 for X, Y, Z.
    mode : 1: the target moves; 2: the unit and its prism move, the target stands.
    beam_direction : +1 or -1, the sense along the axis in which the beam meets the target.
    """

    axis: int
    mode: int = 1
    beam_direction: int = 1

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
    """Arm by which an angle of the axis shows as straightness: +t if the target moves, -(L + l_p + t) if the unit does."""
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

    Names as in the paper: ``delta_?ic, eps_?ic`` target installed, ``delta_?ir, eps_?ir`` prism installed,
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
    return {name: TURNED_SIGNALS * column * _turn_of(name, set_up) for name, column in builder.columns.items()}


def _turn_of(name: str, set_up: SetUp) -> float:
    """Sign of a parameter under half a turn about the vertical direction; beams belong to the unit's own frame."""
    kind, _, rest = name.partition("_")
    if rest.startswith("PE"):  # tilts in the unit's frame: y is read with the opposite sign, z alike
        return -1.0 if rest == "PEz" else 1.0
    vertical = DIRECTIONS[set_up.axis][2]
    return 1.0 if "xyz".index(rest[0]) == vertical else -1.0


def systematic_signals(
    optics: Optics, set_up: SetUp, distance_mm: FloatArray, values: Mapping[str, float]
) -> FloatArray:
    """Signals of the systematic parameters ``values`` (mm, rad; those of other axes are passed over), (n, 7), mm."""
    columns = systematic_columns(optics, set_up, distance_mm)
    total = np.zeros((len(distance_mm), len(SIGNALS)))
    for name, value in values.items():
        if name in columns:
            total += value * columns[name]
    return total


def solve_errors(optics: Optics, set_up: SetUp, distance_mm: FloatArray, signals_mm: FloatArray) -> FloatArray:
    """Errors (n, 6), mm and rad in the order of ROLES, from signals (n, 7) freed of systematics and drift.

    S_g is triangular: angles first, then roll, then the translations with the cross-talk of the angles taken out. The
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
