"""The judgement on a correction: what it leaves, compared with the best possible, and how it would move the axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from compgen.controls import AnyController
from compgen.controls.shared.grids import curve_nodes_mm
from compgen.data.comparison import Residuals, residuals_twice, rms
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import WORTH_MM, ErrorTable, ReversalCurves, reversal_name
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.data.toml_files import option
from compgen.errors import InputError
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.first_order import coefficients, factor, tool_of
from compgen.kinematics.many_points import VolumeGrid, volume_grid
from compgen.tables.synthesis import Projector, best_values, error_at, kept, projector

# A field on a full grid, split into parts that depend on one axis, on a pair of axes, and on all three.
#
# Each component shows a wrong sign, a swapped axis or a wrong unit, however small it is compared with a squareness of
# millimetres.


def components(grid: VolumeGrid, field_mm: FloatArray) -> dict[str, FloatArray]:
    """Split a field (n, 3) on the grid's points; returns arrays of shape (nx, ny, nz) that broadcast, by name.

    Names: ``X constant``, ``X linear in y`` (slope), ``X(y)`` (the rest of the main effect), ``X(x,z)`` (interaction of
    a pair), ``X(x,y,z)``. The parts are orthogonal on the grid, so none hides another.
    """
    parts: dict[str, FloatArray] = {}
    for output, letter in enumerate(AXES):
        rest = field_mm[:, output].reshape(grid.shape)
        constant = rest.mean(keepdims=True)
        parts[f"{letter} constant"] = constant
        rest = rest - constant
        for axis in range(3):
            others = tuple(k for k in range(3) if k != axis)
            main = rest.mean(axis=others, keepdims=True)
            rest = rest - main
            shape = [1, 1, 1]
            shape[axis] = -1
            level = grid.levels_mm[axis].reshape(shape)
            level = level - level.mean()
            slope = level * (np.sum(level * main) / np.sum(level**2))
            parts[f"{letter} linear in {AXES[axis].lower()}"] = slope
            parts[f"{letter}({AXES[axis].lower()})"] = main - slope
        for axis in (2, 1, 0):
            pair = rest.mean(axis=axis, keepdims=True)
            rest = rest - pair
            name = ",".join(AXES[k].lower() for k in range(3) if k != axis)
            parts[f"{letter}({name})"] = pair
        parts[f"{letter}(x,y,z)"] = rest
    return parts


# Lines along the axes, sampled densely: a single wrong node of a fine table shows here but in no mean.


#: Positions along a line in addition to the nodes of the tables: evenly spaced over the travel.
SCAN_POSITIONS = 1001
#: At a point the correction may miss the best possible one by this share of its range, and of the largest range of all
#: axes without the linear parts (a squareness of millimetres must hide nothing) ...
POINT_SHARE = 0.3
#: ... or by this much, whichever is larger; on top come the quantum and this many standard uncertainties of the
#: errors, up to POINT_SHARE of the whole range.
POINT_FLOOR_MM = 1.0 * MM_PER_UM
POINT_UNCERTAINTIES = 5.0


def scan_lines(machine: Machine, nodes_mm: tuple[FloatArray, ...]) -> tuple[VolumeGrid, VolumeGrid, VolumeGrid]:
    """Return nine lines along each axis, with the other two at both ends and in the middle, as one grid for each axis."""
    low, high = machine.lower_mm, machine.upper_mm
    lines = []
    for axis in range(3):
        nodes = nodes_mm[axis][(nodes_mm[axis] >= low[axis]) & (nodes_mm[axis] <= high[axis])]
        levels = [np.array([low[k], 0.5 * (low[k] + high[k]), high[k]]) for k in range(3)]
        levels[axis] = np.unique(np.concatenate([np.linspace(low[axis], high[axis], SCAN_POSITIONS), nodes]))
        lines.append(VolumeGrid((levels[0], levels[1], levels[2])))
    x, y, z = lines
    return x, y, z


@kept
def displacement_uncertainty(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Standard uncertainty of E = C P at positions (n, 3) from those of the errors, shape (3,): the largest, mm.

    Correlations are ignored; an unknown uncertainty counts as zero.
    """
    tool_mm, u = tool_of(machine, tool_mm), {}
    for name, curve in errors.curves.items():
        known = replace(curve, value=np.nan_to_num(curve.u))
        u[name] = known.at(position_mm[:, error_named(name).axis])
    u |= {name: np.nan_to_num(value) for name, (_, value) in errors.squareness.items()}
    entries: dict[tuple[str, int], FloatArray] = {}  # of C: the sums of their monomials
    for part in coefficients(machine.chain, machine.squareness_reference):
        if part.error in u:
            term = part.sign * factor(part.lever, position_mm, tool_mm)
            key = part.error, part.output
            entries[key] = entries[key] + term if key in entries else term
    variance = np.zeros((3, len(position_mm)))
    for (name, output), entry in entries.items():
        variance[output] += (entry * u[name]) ** 2
    return np.asarray(np.sqrt(variance.max(axis=1, initial=0.0)))


@kept
def residuals_before(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> tuple[Residuals, Residuals]:
    """Return the figures of the exact error at commanded positions (n, 3), as it is and with the rigid motion removed."""
    return residuals_twice(position_mm + tool_of(machine, tool_mm), error_at(machine, errors, position_mm, tool_mm))


def point_reasons(
    position_mm: FloatArray,
    correction_mm: FloatArray,
    best_mm: FloatArray,
    bent_mm: float,
    u_mm: FloatArray,
    resolution_mm: float,
) -> list[str]:
    """Describe for each axis the point (of n) where the correction (n, 3) misses the best one most, if too far.

    ``bent_mm`` is the largest range of the best one without its linear part, ``u_mm`` (3,) the standard uncertainty
    that the errors give the correction, ``resolution_mm`` the format's.
    """
    reasons = []
    for output, letter in enumerate(AXES):
        miss = np.abs(correction_mm[:, output] - best_mm[:, output])
        worst = int(np.argmax(miss))
        share = POINT_SHARE * float(np.ptp(best_mm[:, output]))
        limit = max(min(share, POINT_SHARE * bent_mm), POINT_FLOOR_MM) + resolution_mm
        limit += min(POINT_UNCERTAINTIES * u_mm[output], share)
        if miss[worst] > limit:
            x, y, z = position_mm[worst]
            reasons.append(
                f"correction {letter} at X {x:g} Y {y:g} Z {z:g} mm: {_um(correction_mm[worst, output])} um in the table, "
                f"{_um(best_mm[worst, output])} um needed"
            )
    return reasons


def _um(value_mm: float) -> str:
    return f"{round(float(value_mm) / MM_PER_UM, 2) + 0.0:+.2f}"


# The judgement on a correction: the best that a control could do is prepared once, any correction is compared with it.
#
# It does not depend on files: ``verify`` passes what parsed tables do, the sign crash test what wrong ones would do.


#: One entry of a table may move the tip by this share of the largest correction without its linear part, or this much.
GOAL_SHARE, GOAL_MM = 0.03, 1.0 * MM_PER_UM
#: A component of the correction may miss the best possible one by this share of it ...
COMPONENT_SHARE = 0.3
#: ... or by this much, whichever is larger; the quantum of the format comes on top, and this many standard
#: uncertainties of the errors (what smoothing may take away), up to COMPONENT_SHARE of the whole correction.
COMPONENT_FLOOR_MM = 0.2 * MM_PER_UM
COMPONENT_UNCERTAINTIES = 0.5


@dataclass(frozen=True)
class Judge:
    """What a correction is compared with: the best one of the control, on a grid over the volume and on lines.

    Parameters
    ----------
    solver, values : the control's basis over the volume, and the best values in it before rounding.
    grid, best_mm : points (n, 3) over the volume, nodes and middles, and the best correction there (n, 3).
    line_mm, line_best_mm : points (m, 3) on lines along the axes, and the best correction there (m, 3).
    bent_mm : largest range of the best correction of an axis without its linear part.
    goal_mm : how far one entry of a table may move the tip and still pass.
    slack_mm : what quantum and uncertainty explain of a component, shape (3,).
    resolution_mm : largest error of the format's rounding.
    """

    machine: Machine
    errors: ErrorTable
    solver: Projector
    values: FloatArray
    grid: VolumeGrid
    best_mm: FloatArray
    line_mm: FloatArray
    line_best_mm: FloatArray
    bent_mm: float
    goal_mm: float
    slack_mm: FloatArray
    resolution_mm: float

    def reasons(
        self, grid_correction_mm: FloatArray, line_correction_mm: FloatArray, left: Residuals | None = None
    ) -> list[str]:
        """Say why a correction, given on the grid (n, 3) and on the lines (m, 3), is not acceptable; empty if it is.

        ``left`` are the figures of what it leaves on the grid, rigid motion removed, where they are known.
        """
        return [
            *self.shrink_reasons(grid_correction_mm, left),
            *self.component_reasons(grid_correction_mm),
            *self.line_reasons(line_correction_mm),
        ]

    def line_reasons(self, correction_mm: FloatArray) -> list[str]:
        """Describe for each axis the point on the lines where a correction (m, 3) is too far from the best one."""
        against = self.line_mm, correction_mm, self.line_best_mm, self.bent_mm
        if not point_reasons(*against, np.zeros(3), self.resolution_mm):
            return []  # the usual case; the uncertainty of the errors only widens the limit
        u_mm = displacement_uncertainty(self.machine, self.errors, self.line_mm)
        return point_reasons(*against, u_mm, self.resolution_mm)

    @cached_property
    def best_components(self) -> dict[str, tuple[FloatArray, float]]:
        """Components of the best correction, each with what another correction may miss it by (rms, mm)."""
        return {
            name: (part, max(COMPONENT_SHARE * rms(part), COMPONENT_FLOOR_MM) + self.slack_mm[AXES.index(name[0])])
            for name, part in components(self.grid, self.best_mm).items()
        }

    @cached_property
    def rms_before_mm(self) -> float:
        """Exact residual without any correction, rigid motion taken out, mm rms."""
        return residuals_before(self.machine, self.errors, self.grid.position_mm)[1].rms_um * MM_PER_UM

    def component_reasons(self, correction_mm: FloatArray) -> list[str]:
        """Describe every component of the correction (n, 3) that misses the best possible one by more than its share."""
        miss = components(self.grid, correction_mm - self.best_mm)
        too_far = [name for name, (_, limit) in self.best_components.items() if rms(miss[name]) > limit]
        own = components(self.grid, correction_mm) if too_far else {}
        reasons = []
        for name in too_far:
            best, _ = self.best_components[name]
            ratio = np.sum(own[name] * best) / max(float(np.sum(best**2)), 1e-30)
            hint = "; its sign is reversed" if abs(ratio + 1) < 0.1 else ""
            reasons.append(
                f"correction {name}: {rms(own[name]) / MM_PER_UM:.2f} um rms in the table, "
                f"{rms(best) / MM_PER_UM:.2f} um rms needed, they differ by "
                f"{rms(miss[name]) / MM_PER_UM:.2f} um{hint}"
            )
        return reasons

    def shrink_reasons(self, correction_mm: FloatArray, left: Residuals | None = None) -> list[str]:
        """Return a reason if the exact residual grows with the correction (n, 3), rigid motion removed."""
        if left is None:
            position_mm = self.grid.position_mm
            error = exact_error(self.machine, self.errors, position_mm + correction_mm) + correction_mm
            left = residuals_twice(position_mm + tool_of(self.machine, None), error)[1]
        rms_before, rms_after = self.rms_before_mm, left.rms_um * MM_PER_UM
        if rms_after <= rms_before + 1e-9 or rms_after <= self.resolution_mm:
            return []
        return [
            f"the residual does not shrink: {rms_before / MM_PER_UM:.2f} um rms before, {rms_after / MM_PER_UM:.2f} um "
            "rms after (rigid motion removed)"
        ]


def judge_of(machine: Machine, control: AnyController, errors: ErrorTable, tables: Any = None) -> Judge:
    """Prepare the judgement for the tables of one control on a machine with these errors.

    ``tables`` are the parsed ones: if a control has room for only some tables, there is more than one good choice.
    """
    basis = control.basis(errors) if tables is None else control.basis_of(errors, tables)
    solver = projector(machine, basis, anchored=control.anchored)
    values = best_values(machine, errors, solver)
    nodes = _nodes(machine, errors, solver)
    grid = volume_grid(machine, nodes)
    lines = scan_lines(machine, nodes)
    best_mm = solver.field_on_grid(values, grid)
    # the bent part: the field without its best-fit constant and slopes (squareness, pitch)
    columns = np.column_stack([np.ones(len(best_mm)), grid.position_mm - grid.position_mm.mean(axis=0)])
    bent_mm = best_mm - columns @ np.linalg.lstsq(columns, best_mm, rcond=None)[0]
    resolution_mm = control.resolution_mm()
    grid_u_mm = COMPONENT_UNCERTAINTIES * displacement_uncertainty(machine, errors, grid.position_mm)
    return Judge(
        machine=machine,
        errors=errors,
        solver=solver,
        values=values,
        grid=grid,
        best_mm=best_mm,
        line_mm=np.vstack([part.position_mm for part in lines]),
        line_best_mm=np.vstack([solver.field_on_grid(values, part) for part in lines]),
        bent_mm=float(np.ptp(bent_mm, axis=0).max()),
        goal_mm=max(GOAL_MM, GOAL_SHARE * float(np.max(np.linalg.norm(bent_mm, axis=1)))),
        slack_mm=resolution_mm + np.minimum(grid_u_mm, COMPONENT_SHARE * np.std(best_mm, axis=0)),
        resolution_mm=resolution_mm,
    )


def _nodes(machine: Machine, errors: ErrorTable, solver: Projector) -> tuple[FloatArray, ...]:
    """Return the positions of the curves and of the control's tables, by axis."""
    return tuple(
        np.unique(
            np.concatenate(
                [curve_nodes_mm(machine, errors, axis), *(t.nodes_mm for t in solver.basis if t.axis == axis)]
            ).round(6)
        )
        for axis in range(3)
    )


# Both directions of travel: the mean of what tables do in each, and whether their difference corrects the reversal.


Correction = Callable[[Points], FloatArray]

#: Positions along the travel at which the difference of the directions is checked.
REVERSAL_POSITIONS = 201
#: The difference may miss the reversal by this share of its largest value, or by this much, whichever is larger.
REVERSAL_SHARE = 0.3
REVERSAL_FLOOR_MM = 0.2 * MM_PER_UM


def in_both_directions(points: Points) -> Points:
    """Return the points twice: reached by positive travel of all axes, then by negative travel of all."""
    up = np.ones_like(points.position_mm)
    tool_mm = None
    if points.tool_mm is not None:
        tool_mm = np.vstack([np.broadcast_to(points.tool_mm, up.shape)] * 2)
    return Points(np.vstack([points.position_mm] * 2), tool_mm, np.vstack([up, -up]))


def mean_correction(correction: Correction, position_mm: FloatArray, tool_mm: FloatArray | None = None) -> FloatArray:
    """Return the mean of the corrections after positive and after negative travel of all axes, shape (n, 3), mm."""
    both = correction(in_both_directions(Points(position_mm, tool_mm)))
    return np.asarray(0.5 * (both[: len(position_mm)] + both[len(position_mm) :]))


def reversal_reasons(
    machine: Machine, correction: Correction, reversal: ReversalCurves, resolution_mm: float
) -> list[str]:
    """Describe each reversal that the tables do not correct, or that they add, axis by axis along the travel.

    The correction after positive travel minus the one after negative travel must be minus the reversal value.
    """
    reasons = []
    for axis in range(3):
        position_mm = np.tile(0.5 * (machine.lower_mm + machine.upper_mm), (REVERSAL_POSITIONS, 1))
        position_mm[:, axis] = np.linspace(*machine.axes[axis].range_mm, REVERSAL_POSITIONS)
        up, down = np.ones_like(position_mm), np.ones_like(position_mm)
        down[:, axis] = -1.0
        given = correction(Points(position_mm, approach=up)) - correction(Points(position_mm, approach=down))
        needed = reversal.displacement(position_mm, down) - reversal.displacement(position_mm, up)
        for component in range(3):
            miss = np.abs(given[:, component] - needed[:, component])
            limit = max(REVERSAL_SHARE * float(np.max(np.abs(needed[:, component]))), REVERSAL_FLOOR_MM)
            worst = int(np.argmax(miss))
            if miss[worst] > limit + resolution_mm:
                reasons.append(
                    f"{reversal_name(axis, component)} at {AXES[axis]} {position_mm[worst, axis]:g} mm: the tables differ by "
                    f"{given[worst, component] / MM_PER_UM:+.2f} um between positive and negative travel, "
                    f"{needed[worst, component] / MM_PER_UM:+.2f} um needed"
                )
    return reasons


def left_by_reversal(reversal: ReversalCurves | None, *, corrected: bool) -> dict[str, float]:
    """Return in um the part of a reversal that no table corrects: half of its largest value, by name."""
    if reversal is None or corrected:
        return {}
    largest = {reversal_name(*key): 0.5 * abs(value) for key, value in reversal.largest_mm.items()}
    return {name: round(value / MM_PER_UM, 3) for name, value in largest.items() if value >= 0.5 * WORTH_MM}


# How parsed tables would move the axes, whatever the errors are: steps, the reference point, the ends of the tables.
#
# The tables are checked on lines along the axes at all of their nodes, including those outside the travel, which no
# residual over the working volume shows.

#: A larger step between neighbouring nodes that the slope of the best table does not explain is rejected, um.
UNEXPLAINED_STEP_UM = 500.0
#: A step is rejected if it is this many times as steep as the steepest one that does not touch the same nodes ...
SPIKE_RATIO = 10.0
#: ... and larger than this, um.
SPIKE_FLOOR_UM = 10.0
#: Slope up to this many times the steepest one of the best table counts as explained.
SLOPE_SHARE = 2.0
#: A larger correction at the reference point gets a warning, um: the axes move when the table is switched on.
REFERENCE_UM = 20.0
#: How far outside the last node the emulator is tried, mm.
OUTSIDE_MM = 1.0
#: Positions along the travel if a control does not state the nodes of its tables.
WITHOUT_NODES = 201

CorrectionAt = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class SafetyLimits:
    """Limits of :func:`safety_of`; ``max_step_um``: no step between neighbouring nodes may be larger; None: the default there."""

    max_step_um: float | None = option(
        None,
        "Largest allowed step of the correction between neighbouring table nodes, um; default: 500 um beyond "
        "what the slope of the errors explains.",
    )

    def __post_init__(self) -> None:
        if self.max_step_um is not None and not self.max_step_um > 0.0:
            raise InputError(f"--max-step-um is {self.max_step_um:g}; expected a number of um above zero")


@dataclass(frozen=True)
class LargestStep:
    """The largest step of the correction of one axis (``output``) along one axis, between neighbouring nodes.

    ``step_um`` over ``from_mm`` ... ``to_mm``; ``slope_um_per_mm`` is the steepest one, which may be elsewhere.
    """

    output: str
    along: str
    step_um: float
    from_mm: float
    to_mm: float
    slope_um_per_mm: float


@dataclass(frozen=True)
class TableEnd:
    """One end of the tables over one axis.

    ``jump_um`` is the largest correction at this end on any of the lines: the axes jump by it if the control drops the
    compensation beyond. ``outside`` is what the emulated control does: ``"held"`` (the value stays constant),
    ``"continued"`` (it continues smoothly, as levers do) or ``"dropped"``.
    """

    along: str
    end_mm: float
    travel_mm: float
    jump_um: float
    outside: str


@dataclass(frozen=True)
class Safety:
    """Outcome of :func:`safety_of`; ``reasons`` make the tables unacceptable, ``warnings`` do not."""

    steps: tuple[LargestStep, ...]
    reference_um: tuple[float, float, float]
    ends: tuple[TableEnd, ...]
    limits: SafetyLimits
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]

    def summary(self) -> dict[str, object]:
        """Return the object ``safety`` of ``result.json``."""
        largest = max(self.steps, key=lambda item: item.step_um, default=None)
        return {
            "largest_step_um": 0.0 if largest is None else largest.step_um,
            "largest_slope_um_per_mm": max((item.slope_um_per_mm for item in self.steps), default=0.0),
            "steps": [asdict(item) for item in self.steps],
            "reference_um": dict(zip("xyz", self.reference_um, strict=True)),
            "table_ends": [asdict(item) for item in self.ends],
            "limits": asdict(self.limits),
            "reasons": list(self.reasons),
            "warnings": list(self.warnings),
        }


def node_positions(machine: Machine, nodes_mm: FloatArray, axis: int) -> FloatArray:
    """Return the positions at which tables over an axis are checked: their nodes and the travel ends, ascending, mm."""
    ends = np.array(machine.axes[axis].range_mm)
    inner = nodes_mm if len(nodes_mm) else np.linspace(float(ends[0]), float(ends[1]), WITHOUT_NODES)
    return np.unique(np.concatenate([ends, inner]).round(6))


def lines_along(machine: Machine, axis: int, along_mm: FloatArray) -> FloatArray:
    """Return nine lines along an axis at positions (n,), the others at travel ends and middles: shape (9, n, 3), mm."""
    others = [k for k in range(3) if k != axis]
    levels = [(low, 0.5 * (low + high), high) for low, high in (machine.axes[k].range_mm for k in others)]
    lines = np.zeros((9, len(along_mm), 3))
    lines[:, :, axis] = along_mm
    for number, (first, second) in enumerate((a, b) for a in levels[0] for b in levels[1]):
        lines[number, :, others[0]], lines[number, :, others[1]] = first, second
    return lines


def _on_lines(correction: CorrectionAt, lines_mm: FloatArray) -> FloatArray:
    return np.asarray(correction(lines_mm.reshape(-1, 3))).reshape(lines_mm.shape)


def safety_of(
    machine: Machine,
    control: AnyController,
    tables: object,
    best: CorrectionAt,
    limits: SafetyLimits | None = None,
) -> Safety:
    """Check how parsed tables would move the axes.

    Parameters
    ----------
    machine, control, tables : the tables as the control parsed them.
    best : the best correction of this control as a function of positions (n, 3); its slope explains steps.
    limits : by default a step is rejected if it exceeds what twice the slope of ``best`` explains by 0.5 mm, or by 10
        um and it is ten times steeper than all others; with ``max_step_um`` no step may exceed that either.
    """
    limits = limits or SafetyLimits()
    nodes = control.table_nodes_mm(tables)

    def correction(position_mm: FloatArray, side: float = 1.0) -> FloatArray:
        points = Points(position_mm, approach=np.full_like(position_mm, side))
        return np.asarray(control.emulate(tables, points))

    sides = (1.0, -1.0) if control.by_direction(tables) else (1.0,)
    slack_um = 2.0 * control.resolution_mm() / MM_PER_UM
    steps: list[LargestStep] = []
    reasons: list[str] = []
    for axis in range(3):
        along = node_positions(machine, nodes[axis], axis)
        lines = lines_along(machine, axis, along)
        added = np.concatenate([_on_lines(partial(correction, side=side), lines) for side in sides])
        required = np.tile(_on_lines(best, lines), (len(sides), 1, 1))
        for output in range(3):
            profile = _Profile(axis, output, along, added[:, :, output], required[:, :, output], slack_um)
            steps.append(profile.largest())
            reasons += profile.reasons(machine.axes[axis].range_mm, limits)
    reference = correction(np.array([machine.reference_point_mm], dtype=np.float64))[0] / MM_PER_UM
    ends = _ends(machine, nodes, correction)
    x, y, z = (float(value) + 0.0 for value in reference)
    moved = [
        f"{axis} {value:+.1f} um"
        for axis, value in zip(AXES, (x, y, z), strict=True)
        if abs(value) > REFERENCE_UM + slack_um
    ]
    jolt = f"the correction at the reference point is {', '.join(moved)}: the axes move when it is switched on there"
    warnings = [jolt] if moved else []
    warnings += [
        f"the tables over {end.along} end at {end.end_mm:g} mm and the control drops them there: a jump of "
        f"{end.jump_um:.1f} um"
        for end in ends
        if end.outside == "dropped" and end.jump_um > SPIKE_FLOOR_UM + slack_um
    ]
    return Safety(
        tuple(item for item in steps if item.step_um > 0.0),
        (x, y, z),
        ends,
        limits,
        tuple(reasons),
        tuple(warnings),
    )


@dataclass(frozen=True)
class _Profile:
    """Correction of one axis along another on nine lines, given and best, (9, n), mm, at (n,).

    If the directions of travel differ, there are 18 lines.
    """

    axis: int
    output: int
    along_mm: FloatArray
    own_mm: FloatArray
    best_mm: FloatArray
    slack_um: float

    @property
    def width_mm(self) -> FloatArray:
        return np.diff(self.along_mm)

    @property
    def step_um(self) -> FloatArray:
        """Return the largest step over each interval, shape (n - 1,)."""
        return np.asarray(np.max(np.abs(np.diff(self.own_mm, axis=1)), axis=0) / MM_PER_UM)

    def explained(self, range_mm: tuple[float, float]) -> float:
        """Return the slope that the best table explains, um/mm: twice its steepest one within the travel."""
        inside = (self.along_mm[:-1] >= range_mm[0] - 1e-9) & (self.along_mm[1:] <= range_mm[1] + 1e-9)
        slopes = np.max(np.abs(np.diff(self.best_mm, axis=1)), axis=0) / MM_PER_UM / self.width_mm
        return SLOPE_SHARE * float(np.max(slopes[inside], initial=0.0))

    def largest(self) -> LargestStep:
        worst = int(np.argmax(self.step_um))
        return LargestStep(
            AXES[self.output],
            AXES[self.axis],
            float(self.step_um[worst]),
            float(self.along_mm[worst]),
            float(self.along_mm[worst + 1]),
            float(np.max(self.step_um / self.width_mm)),
        )

    def reasons(self, range_mm: tuple[float, float], limits: SafetyLimits) -> list[str]:
        step, slope = self.step_um, self.step_um / self.width_mm
        surplus = step - self.explained(range_mm) * self.width_mm - self.slack_um
        found = []
        worst = int(np.argmax(surplus))
        others = np.delete(slope, slice(max(worst - 1, 0), worst + 2))
        steepest = float(np.max(others, initial=0.0))
        if surplus[worst] > UNEXPLAINED_STEP_UM:
            found.append(f"{self._place(worst)}, which no slope of the machine's errors explains")
        elif surplus[worst] > SPIKE_FLOOR_UM and len(others) and slope[worst] > SPIKE_RATIO * steepest:
            found.append(f"{self._place(worst)}: more than {SPIKE_RATIO:g} times as steep as anywhere else")
        high = int(np.argmax(step))
        if limits.max_step_um is not None and step[high] > limits.max_step_um:
            found.append(f"{self._place(high)}; the limit is {limits.max_step_um:g} um")
        return found

    def _place(self, k: int) -> str:
        return (
            f"correction {AXES[self.output]} steps by {self.step_um[k]:.1f} um between {AXES[self.axis]} "
            f"{self.along_mm[k]:g} and {self.along_mm[k + 1]:g} mm"
        )


def _ends(machine: Machine, nodes_mm: tuple[FloatArray, ...], correction: CorrectionAt) -> tuple[TableEnd, ...]:
    """Return both ends of the tables over every axis that has tables."""
    found = []
    for axis, nodes in enumerate(nodes_mm):
        if len(nodes) < 2:
            continue
        for side, end in ((-1.0, nodes[0]), (1.0, nodes[-1])):
            along = np.array([end - side * OUTSIDE_MM, end, end + 1e-3 * side, end + side * OUTSIDE_MM])
            values = _on_lines(correction, lines_along(machine, axis, along))
            travel = machine.axes[axis].range_mm[0 if side < 0 else 1]
            jump = float(np.max(np.abs(values[:, 1]))) / MM_PER_UM
            found.append(TableEnd(AXES[axis], float(end), travel, jump, _outside(values)))
    return tuple(found)


def _outside(values_mm: FloatArray) -> str:
    """Return what happens beyond a table's end, from corrections (9, 4, 3): inside, at the end, just and well outside."""
    jump, travelled = (float(np.max(np.abs(values_mm[:, k] - values_mm[:, 1]))) for k in (2, 3))
    inside = float(np.max(np.abs(values_mm[:, 0] - values_mm[:, 1])))
    if jump > max(0.5 * MM_PER_UM, 10.0 * inside):
        return "dropped"
    return "held" if travelled < 1e-9 else "continued"
