"""What parsed tables would make the axes do, whatever the errors are: steps, the reference point, the table's ends.

The tables are looked at on lines along the axes at all of their nodes, also those outside the travel, which no
residual over the working volume shows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np

from compgen.controls import AnyController
from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import option
from compgen.errors import InputError

#: A step between neighbouring nodes that the slope of the best table does not explain is absurd from here on, um.
UNEXPLAINED_STEP_UM = 500.0
#: A step is absurd if it is this many times as steep as the steepest one that does not touch the same nodes ...
SPIKE_RATIO = 10.0
#: ... and larger than this, um.
SPIKE_FLOOR_UM = 10.0
#: Slope up to this many times the steepest one of the best table counts as explained.
SLOPE_SHARE = 2.0
#: A correction at the reference point beyond this is worth a warning, um: the axes move when the table is switched on.
REFERENCE_UM = 20.0
#: How far outside the last node the emulator is tried, mm.
OUTSIDE_MM = 1.0
#: Positions along the travel where a control does not say where its tables have their nodes.
WITHOUT_NODES = 201

Correction = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class SafetyLimits:
    """Limits of :func:`safety_of`; ``max_step_um``: no step between neighbouring nodes may be larger, None: see there."""

    max_step_um: float | None = option(
        None,
        "No step of the correction between neighbouring table nodes may be larger than this, um; default: 500 um beyond "
        "what the slope of the errors explains.",
    )

    def __post_init__(self) -> None:
        if self.max_step_um is not None and not self.max_step_um > 0.0:
            raise InputError(f"--max-step-um is {self.max_step_um:g}; expected a number of um above zero")


@dataclass(frozen=True)
class LargestStep:
    """The largest step of the correction of one axis (``output``) along one axis, between neighbouring nodes.

    ``step_um`` over ``from_mm`` ... ``to_mm``; ``slope_um_per_mm`` is the steepest one, which may lie elsewhere.
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

    ``jump_um`` is the largest correction that belongs to this end on any of the lines: by this the axes jump if the
    control drops the compensation beyond it. ``outside`` is what the emulated control does: ``"held"`` (the value
    stays), ``"continued"`` (it goes on smoothly, as levers do) or ``"dropped"``.
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
    """Return where the tables over an axis are looked at: their nodes and the travel ends, ascending, mm."""
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


def _on_lines(correction: Correction, lines_mm: FloatArray) -> FloatArray:
    return np.asarray(correction(lines_mm.reshape(-1, 3))).reshape(lines_mm.shape)


def safety_of(
    machine: Machine,
    control: AnyController,
    tables: object,
    best: Correction,
    limits: SafetyLimits | None = None,
) -> Safety:
    """Look at parsed tables as they would move the axes.

    Parameters
    ----------
    machine, control, tables : the tables as the control parsed them.
    best : the best correction of this control as a function of positions (n, 3); its slope explains steps.
    limits : by default a step is absurd that is 0.5 mm larger, or ten times steeper than all others and 10 um larger,
        than twice the slope of ``best`` explains; with ``max_step_um`` no step may exceed that either.
    """
    limits = limits or SafetyLimits()
    nodes = control.table_nodes_mm(tables)

    def correction(position_mm: FloatArray, side: float = 1.0) -> FloatArray:
        points = Points(position_mm, approach=np.full_like(position_mm, side))
        return np.asarray(control.emulate(tables, points))

    slack_um = 2.0 * control.resolution_mm() / MM_PER_UM
    steps: list[LargestStep] = []
    reasons: list[str] = []
    for axis in range(3):
        along = node_positions(machine, nodes[axis], axis)
        lines = lines_along(machine, axis, along)
        added = np.concatenate([_on_lines(partial(correction, side=side), lines) for side in (1.0, -1.0)])
        wanted = np.tile(_on_lines(best, lines), (2, 1, 1))
        for output in range(3):
            profile = _Profile(axis, output, along, added[:, :, output], wanted[:, :, output], slack_um)
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
    jolt = f"at the reference point the correction is {', '.join(moved)}: the axes move when it is switched on there"
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
    """Correction of one axis along another on nine lines in both directions, own and best, (18, n), mm, at (n,)."""

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
        """Largest step over each interval, shape (n - 1,)."""
        return np.asarray(np.max(np.abs(np.diff(self.own_mm, axis=1)), axis=0) / MM_PER_UM)

    def explained(self, range_mm: tuple[float, float]) -> float:
        """Slope that the best table explains, um/mm: twice its steepest one within the travel."""
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


def _ends(machine: Machine, nodes_mm: tuple[FloatArray, ...], correction: Correction) -> tuple[TableEnd, ...]:
    """Both ends of the tables over every axis that has some."""
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
    """Say what happens beyond a table's end from corrections (9, 4, 3): inside, at the end, just and well outside."""
    jump, travelled = (float(np.max(np.abs(values_mm[:, k] - values_mm[:, 1]))) for k in (2, 3))
    inside = float(np.max(np.abs(values_mm[:, 0] - values_mm[:, 1])))
    if jump > max(0.5 * MM_PER_UM, 10.0 * inside):
        return "dropped"
    return "held" if travelled < 1e-9 else "continued"
