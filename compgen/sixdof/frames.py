"""Motion of the target relative to the unit to errors of the machine model, tool relative to workpiece.

The one place where bodies, sides and reference points are turned into each other (``docs/sixdof.md``).

Unit on the workpiece side, target at the tool (A): what is measured is the error E of the tool point that the target's
front centre is, tool offset ``target_offset_mm``. Unit on the tool side, target on the workpiece (B): the error of
the unit's reference point (where beam 1 meets the reflector; X: the exit point), which then has that offset. In both,
with the model's own lever arms,

    delta_i(q) = E(q) - eps_i(q) x lever_i(q) - (sum of eps of the carriers of i) x q e_i

with all eps zero at the machine's reference point. In B the unit, and with it the measured directions, stands turned by
the eps of all axes at the first position of the run; that turn is put back.

Which of the two it is follows from chain and mode: A if the moving body is the target on a tool-side axis, or the unit on
a workpiece-side axis. The interferometer shows it too: in A the target moves along the positive axis as the command
rises. Where the two disagree, the readings are taken for the motion of the moving body in its own axes, errors and
coordinate alike (the component convention of the paper), with a warning.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES
from compgen.errors import CompgenWarning
from compgen.sixdof.instrument import AxisSetUp, Instrument
from compgen.sixdof.reduction import RelativeRun


@dataclass(frozen=True)
class AxisRun:
    """Errors of one axis over one run: translations (n, 3) mm, rotations (n, 3) rad, zero at the reference point.

    The translations are those of the carriage's reference point of the machine model, the rotation of other axes left
    in (:func:`turned_by`). ``unit_at_tool`` says that it was the unit that the tool's side carried;
    ``contradiction`` why the component convention was taken, or is empty.
    """

    axis: int
    run: int
    position_mm: FloatArray
    delta_mm: FloatArray
    eps_rad: FloatArray
    direction: FloatArray
    unit_at_tool: bool = False
    contradiction: str = ""


def expected_away(machine: Machine, instrument: Instrument) -> dict[int, int]:
    """By measured axis: +1 if chain and mode put the unit on the workpiece side (A), -1 if on the tool side (B)."""
    return {
        axis: 1 if (axis in machine.chain.tool_side) == (entry.set_up.mode == 1) else -1
        for axis, entry in instrument.axes.items()
    }


def errors_of_run(machine: Machine, instrument: Instrument, run: RelativeRun) -> AxisRun:
    """Errors of the axis over a run; a CompgenWarning where chain and readings contradict each other."""
    expected = expected_away(machine, instrument)[run.axis]
    if run.away != expected:
        return _component_run(machine, instrument, run)
    entry, at_tool = instrument.axes[run.axis], run.away < 0
    error, turn = motion_of_unit(instrument, run) if at_tool else (run.shift_mm, run.turn_rad)
    eps = zeroed(machine, run.axis, run.position_mm, turn)
    if at_tool:
        error = error + np.cross(eps[0], along(run.axis, run.position_mm))
    lever = lever_arm(machine, run.axis, _positions(entry, run), np.array(entry.target_offset_mm))
    delta = zeroed(machine, run.axis, run.position_mm, error - np.cross(eps, lever))
    return AxisRun(run.axis, run.run, run.position_mm, delta, eps, run.direction, at_tool)


def along(axis: int, position_mm: FloatArray) -> FloatArray:
    """Travel vectors (n, 3) of an axis since its first position."""
    return np.asarray((position_mm - position_mm[0])[:, None] * np.eye(3)[axis])


def zeroed(machine: Machine, axis: int, position_mm: FloatArray, values: FloatArray) -> FloatArray:
    """Values (n, k) less their values at the machine's reference point, linear between positions, held outside."""
    order = np.argsort(position_mm, kind="stable")
    at = machine.reference_point_mm[axis]
    return np.asarray(values - [np.interp(at, position_mm[order], column[order]) for column in values.T])


def motion_of_unit(instrument: Instrument, run: RelativeRun) -> tuple[FloatArray, FloatArray]:
    """Motion of the unit relative to the target: of its reference point (n, 3) mm, and its rotation (n, 3) rad."""
    beam = instrument.axes[run.axis].set_up.beam_direction * np.eye(3)[run.axis]
    reach = (run.distance_mm + instrument.optics.lever_mm(run.axis))[:, None] * beam
    return np.cross(run.turn_rad, reach) - run.shift_mm, -run.turn_rad


def _component_run(machine: Machine, instrument: Instrument, run: RelativeRun) -> AxisRun:
    """Errors of the moving body in its own axes and at its own reference point."""
    set_up = instrument.axes[run.axis].set_up
    letter, rises = AXES[run.axis], run.away * set_up.beam_direction > 0
    text = (
        f"{letter}: displacement_mm {'rises' if rises else 'falls'} with position_mm, which contradicts mode {set_up.mode} "
        f"and beam_direction {set_up.beam_direction} on this chain; taken as the motion of the moving body in its own "
        "axes. Check mode, beam_direction and the chain: a wrong one turns signs"
    )
    warnings.warn(text, CompgenWarning, stacklevel=2)
    delta, eps = (run.shift_mm, run.turn_rad) if set_up.mode == 1 else motion_of_unit(instrument, run)
    delta, eps = (zeroed(machine, run.axis, run.position_mm, values) for values in (delta, eps))
    return AxisRun(run.axis, run.run, run.position_mm, delta, eps, run.direction, False, text)


def _positions(entry: AxisSetUp, run: RelativeRun) -> FloatArray:
    """Positions of all axes over the run, (n, 3): the others stand where the instrument file says, else at zero."""
    position = np.tile(np.array(entry.position_mm or (0.0, 0.0, 0.0)), (len(run.position_mm), 1))
    position[:, run.axis] = run.position_mm
    return position


def lever_arm(machine: Machine, axis: int, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """Lever arm of the rotation of ``axis`` at positions (n, 3) with tool offset (3,), (n, 3), mm.

    The model's: the tool offset plus the travel of the axes between the axis and the tool (tool side), or of all
    tool-side axes and of the workpiece-side axes from the foundation up to and including it (workpiece side).
    """
    lever = np.tile(tool_mm, (len(position_mm), 1))
    for other in machine.chain.lever_axes(axis):
        lever[:, other] += position_mm[:, other]
    return lever


def turned_by(machine: Machine, axis: int, *, unit_at_tool: bool) -> dict[int, int]:
    """By other axis: how often its rotation, where it stood, turns the measured travel of ``axis``.

    The carriers turn the travel as the workpiece sees it (+1); a unit on the tool's side is itself turned by all axes
    (-1).
    """
    chain = machine.chain
    if axis in chain.tool_side:
        carriers = (*chain.workpiece_side, *chain.tool_side[: chain.tool_side.index(axis)])
    else:
        carriers = tuple(chain.workpiece_side[chain.workpiece_side.index(axis) + 1 :])
    others = [other for other in range(3) if other != axis]
    return {other: (other in carriers) - unit_at_tool for other in others}
