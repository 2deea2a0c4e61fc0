"""Six-DOF signals to errors of the moved axis, run by run.

First the motion of the target relative to the unit (:func:`reduce_runs`), then the errors of the machine model
(:func:`errors_of_run`): the only place that converts between bodies, sides and reference points. The printed equations
of the paper are at the end, for comparison only.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.errors import CompgenWarning, InputError, Message
from compgen.instruments.sixdof_instrument import (
    DIRECTIONS,
    ROTATIONS,
    SIGNALS,
    AxisSetUp,
    Optics,
    SetUp,
    SixDof,
    SixDofInstrument,
    drift_matrix,
    solve_errors,
    systematic_signals,
)

# Raw signals of one run to the motion of the target relative to the unit.
#
# Whichever body moves, the instrument sees the same thing: the pose of the target in the frame of unit and prism. So both
# modes are reduced as "the target moves"; what moves which way in the machine is defined once, below.


#: Below this slope against the command, the interferometer's readings are deviations only.
DEVIATIONS_ONLY = 0.5
#: Largest deviation of the slope from -1, 0 or +1.
LARGEST_SCALE_ERROR = 0.01


@dataclass(frozen=True)
class RelativeRun:
    """Motion of the target relative to the unit over one run, changes since its first row; n rows.

    Parameters
    ----------
    axis, run : axis and number of the run.
    rows : rows of the readings.
    position_mm : commanded positions of the axis, (n,).
    distance_mm : optical distance L, (n,).
    shift_mm : displacement of the front centre of the first cube corner in machine axes, less nominal travel, (n, 3).
    turn_rad : rotation of the target, (n, 3).
    away : +1 if the target moves along the positive axis relative to the unit when the command rises, else -1.
    direction : sign of travel, 0 if not given, (n,).
    """

    axis: int
    run: int
    rows: NDArray[np.int64]
    position_mm: FloatArray
    distance_mm: FloatArray
    shift_mm: FloatArray
    turn_rad: FloatArray
    away: int
    direction: FloatArray


def reduce_runs(readings: SixDof, instrument: SixDofInstrument, expected_away: dict[int, int]) -> list[RelativeRun]:
    """Reduce every run.

    Parameters
    ----------
    expected_away : by axis, which way the target moves relative to the unit when the command rises, from machine
        and mode; used if the interferometer's readings are deviations only.

    Raises
    ------
    InputError
        for an axis that the instrument file does not describe, a run of fewer than two positions, an interferometer
        reading that does not follow the command.
    """
    first: dict[int, float] = {}
    reduced = []
    for axis, run, rows in readings.runs():
        if axis not in instrument.axes:
            message = f"axis {AXES[axis]} was measured, but the instrument file has no [axes.{AXES[axis]}]"
            raise InputError(message, file=instrument.source)
        if len(np.unique(readings.position_mm[rows])) < 2:
            file, line = readings.origin[int(rows[0])] if readings.origin else (None, None)
            raise InputError(
                Message(
                    "run-few-positions", "run {run} of {value} has fewer than two positions", run=run, value=AXES[axis]
                ),
                file=file,
                line=line,
            )
        first.setdefault(axis, float(readings.position_mm[rows[0]]))
        set_up, position = instrument.axes[axis], readings.position_mm[rows]
        away, nominal = _travel(readings, axis, run, rows, set_up, expected_away[axis])
        distance = _distance(readings, rows, set_up, instrument, away * (position - first[axis]))
        motion = relative_motion(readings, instrument, rows, axis, distance, nominal)
        shift, turn = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
        shift[:, list(DIRECTIONS[axis])] = motion[:, :3]
        turn[:, list(ROTATIONS[axis])] = motion[:, 3:]
        shift, turn = shift - shift[0], turn - turn[0]
        direction = readings.direction[rows]
        reduced.append(RelativeRun(axis, run, rows, position, distance, shift, turn, away, direction))
    return reduced


def relative_motion(
    readings: SixDof,
    instrument: SixDofInstrument,
    rows: NDArray[np.int64],
    axis: int,
    distance_mm: FloatArray,
    nominal_mm: FloatArray,
) -> FloatArray:
    """Motion of the target relative to the unit, (n, 6) in the order of ROLES, systematics and drift removed.

    ``nominal_mm`` is the part of the interferometer's reading due to the commanded travel.
    """
    optics, entry = instrument.optics, instrument.axes[axis]
    fixed = SetUp(axis, 1, entry.set_up.beam_direction)
    signals = signals_of(readings, rows)
    signals[:, 0] -= nominal_mm
    signals -= systematic_signals(optics, fixed, distance_mm, entry.systematics)
    drift = drift_of(readings, rows, optics.focal_length_mm)
    signals -= np.einsum("nij,nj->ni", drift_matrix(optics, fixed, distance_mm), drift)
    return solve_errors(optics, fixed, distance_mm, signals)


def signals_of(readings: SixDof, rows: NDArray[np.int64]) -> FloatArray:
    """Signals (n, 7) in the order of SIGNALS, mm; nan for the second horizontal spot where it was not read."""
    empty = np.full(len(readings), np.nan)
    return np.column_stack([readings.signals_mm.get(name, empty)[rows] for name in SIGNALS])


def drift_of(readings: SixDof, rows: NDArray[np.int64], focal_length_mm: float) -> FloatArray:
    """Tilt of both beams toward unit +y and +z from the drift monitor, (n, 2), rad.

    Its zero is the zero of the readings: for squareness it must be the same for all axes.
    """
    monitor = [readings.signals_mm[name][rows] for name in ("y_psd2_mm", "z_psd2_mm")]
    return np.column_stack(monitor) / focal_length_mm


def _travel(
    readings: SixDof,
    axis: int,
    run: int,
    rows: NDArray[np.int64],
    entry: AxisSetUp,
    expected_away: int,
) -> tuple[int, FloatArray]:
    """Which way the target moves relative to the unit as the command rises, and the nominal part of the reading (n,)."""
    position, reading = readings.position_mm[rows], readings.signals_mm["displacement_mm"][rows]
    beam = entry.set_up.beam_direction
    slope = float(np.polyfit(position - position.mean(), reading - reading.mean(), 1)[0])
    nearest = 0 if abs(slope) < DEVIATIONS_ONLY else int(np.sign(slope))
    if abs(slope - nearest) > LARGEST_SCALE_ERROR:
        file, line = readings.origin[int(rows[0])] if readings.origin else (None, None)
        raise InputError(
            Message(
                "displacement-slope",
                "run {run} of {value}: displacement_mm changes by {slope:.4f} mm per mm of "
                "position_mm; expected 1, -1, or 0 (deviations only): check units, position_mm, and "
                "the interferometer",
                run=run,
                value=AXES[axis],
                slope=slope,
            ),
            file=file,
            line=line,
            field="column displacement_mm",
        )
    if nearest == 0:
        return expected_away, np.zeros(len(rows))
    return nearest * beam, nearest * position


def _distance(
    readings: SixDof, rows: NDArray[np.int64], entry: AxisSetUp, instrument: SixDofInstrument, travel_mm: FloatArray
) -> FloatArray:
    """Optical distance L of each row: as read, else from the first target position; ``travel_mm`` along the axis."""
    read = readings.distance_mm[rows]
    if not np.isnan(read).any():
        return read
    letter = AXES[entry.set_up.axis]
    if entry.distance_first_mm is None:
        message = (
            "is missing, and the readings have no column distance_mm; give the optical distance at the first target"
        )
        raise InputError(message, file=instrument.source, field=f"[axes.{letter}] distance_first_mm")
    distance = entry.distance_first_mm + entry.set_up.beam_direction * travel_mm
    if distance.min() < 0.0:
        raise InputError(
            Message(
                "optical-distance-negative",
                "the optical distance would become {distance:g} mm; check distance_first_mm (now "
                "{distance_first_mm:g}), beam_direction and mode of {letter}",
                distance=distance.min(),
                distance_first_mm=entry.distance_first_mm,
                letter=letter,
            ),
            file=instrument.source,
            field=f"[axes.{letter}] distance_first_mm",
        )
    return np.asarray(distance)


# Motion of the target relative to the unit to errors of the machine model, tool relative to workpiece.
#
# The only place that converts between bodies, sides and reference points (``docs/sixdof.md``).
#
# Unit on the workpiece side, target at the tool (A): the measurement gives the error E of the tool point at the
# target's front centre, tool offset ``target_offset_mm``. Unit on the tool side, target on the workpiece (B): the error
# of the unit's reference point (where beam 1 meets the reflector; X: the exit point), which then has that offset.
# In both, with the model's lever arms,
#
#     delta_i(q) = E(q) - eps_i(q) x lever_i(q) - (sum of eps of the carriers of i) x q e_i
#
# with all eps zero at the machine's reference point. In B the unit, and with it the measured directions, is rotated by
# the eps of all axes at the first position of the run; that rotation is undone.
#
# Chain and mode decide which of the two applies: A if the moving body is the target on a tool-side axis, or the unit on
# a workpiece-side axis. The interferometer shows it too: in A the target moves along the positive axis as the command
# rises. If the two disagree, the readings are taken as the motion of the moving body in its own axes, errors and
# coordinate alike (the component convention of the paper), with a warning.


@dataclass(frozen=True)
class AxisRun:
    """Errors of one axis over one run: translations (n, 3) mm, rotations (n, 3) rad, zero at the reference point.

    The translations are at the carriage's reference point in the machine model and still contain the rotation of the
    other axes (:func:`turned_by`). ``unit_at_tool``: the unit was on the tool side; ``contradiction``: why the
    component convention was used, or empty.
    """

    axis: int
    run: int
    position_mm: FloatArray
    delta_mm: FloatArray
    eps_rad: FloatArray
    direction: FloatArray
    unit_at_tool: bool = False
    contradiction: str = ""


def expected_away(machine: Machine, instrument: SixDofInstrument) -> dict[int, int]:
    """By measured axis: +1 if chain and mode put the unit on the workpiece side (A), -1 if on the tool side (B)."""
    return {
        axis: 1 if (axis in machine.chain.tool_side) == (entry.set_up.mode == 1) else -1
        for axis, entry in instrument.axes.items()
    }


def errors_of_run(machine: Machine, instrument: SixDofInstrument, run: RelativeRun) -> AxisRun:
    """Errors of the axis over a run; a CompgenWarning if chain and readings contradict each other."""
    entry, at_tool = instrument.axes[run.axis], run.away < 0
    if run.away != expected_away(machine, instrument)[run.axis]:
        # the errors of the moving body in its own axes and at its own reference point
        set_up, rises = entry.set_up, run.away * entry.set_up.beam_direction > 0
        text = (
            f"{AXES[run.axis]}: displacement_mm {'rises' if rises else 'falls'} with position_mm, which contradicts mode "
            f"{set_up.mode} and beam_direction {set_up.beam_direction} on this chain; taken as the motion of the moving body in "
            "its own axes. Check mode, beam_direction and the chain: a wrong one reverses signs"
        )
        warnings.warn(text, CompgenWarning, stacklevel=2)
        motion = (run.shift_mm, run.turn_rad) if set_up.mode == 1 else motion_of_unit(instrument, run)
        delta, eps = (zeroed(machine, run.axis, run.position_mm, values) for values in motion)
        return AxisRun(run.axis, run.run, run.position_mm, delta, eps, run.direction, False, text)
    error, turn = motion_of_unit(instrument, run) if at_tool else (run.shift_mm, run.turn_rad)
    eps = zeroed(machine, run.axis, run.position_mm, turn)
    if at_tool:
        error = error + np.cross(eps[0], along(run.axis, run.position_mm))
    # the other axes are at the position in the instrument file, else at zero
    position = np.tile(np.array(entry.position_mm or (0.0, 0.0, 0.0)), (len(run.position_mm), 1))
    position[:, run.axis] = run.position_mm
    lever = lever_arm(machine, run.axis, position, np.array(entry.target_offset_mm))
    delta = zeroed(machine, run.axis, run.position_mm, error - np.cross(eps, lever))
    return AxisRun(run.axis, run.run, run.position_mm, delta, eps, run.direction, at_tool)


def along(axis: int, position_mm: FloatArray) -> FloatArray:
    """Travel vectors (n, 3) of an axis since its first position."""
    return np.asarray((position_mm - position_mm[0])[:, None] * np.eye(3)[axis])


def zeroed(machine: Machine, axis: int, position_mm: FloatArray, values: FloatArray) -> FloatArray:
    """Values (n, k) minus their values at the machine's reference point, linear between positions, constant outside."""
    order = np.argsort(position_mm, kind="stable")
    at = machine.reference_point_mm[axis]
    return np.asarray(values - [np.interp(at, position_mm[order], column[order]) for column in values.T])


def motion_of_unit(instrument: SixDofInstrument, run: RelativeRun) -> tuple[FloatArray, FloatArray]:
    """Motion of the unit relative to the target: of its reference point (n, 3) mm, and its rotation (n, 3) rad."""
    beam = instrument.axes[run.axis].set_up.beam_direction * np.eye(3)[run.axis]
    reach = (run.distance_mm + instrument.optics.lever_mm(run.axis))[:, None] * beam
    return np.cross(run.turn_rad, reach) - run.shift_mm, -run.turn_rad


def lever_arm(machine: Machine, axis: int, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """Lever arm of the rotation of ``axis`` at positions (n, 3) with tool offset (3,), (n, 3), mm.

    As in the model: the tool offset plus the travel of the axes between the axis and the tool (tool side), or of all
    tool-side axes and of the workpiece-side axes from the foundation up to and including it (workpiece side).
    """
    lever = np.tile(tool_mm, (len(position_mm), 1))
    for other in machine.chain.lever_axes(axis):
        lever[:, other] += position_mm[:, other]
    return lever


def turned_by(machine: Machine, axis: int, *, unit_at_tool: bool) -> dict[int, int]:
    """By other axis: how many times its rotation, where it was, turns the measured travel of ``axis``.

    The carriers turn the travel relative to the workpiece (+1); a unit on the tool side is itself turned by all axes
    (-1).
    """
    chain = machine.chain
    if axis in chain.tool_side:
        carriers = (*chain.workpiece_side, *chain.tool_side[: chain.tool_side.index(axis)])
    else:
        carriers = tuple(chain.workpiece_side[chain.workpiece_side.index(axis) + 1 :])
    others = [other for other in range(3) if other != axis]
    return {other: (other in carriers) - unit_at_tool for other in others}


# Equations 5 to 7 of Jia et al. 2022 as printed, only for comparison with the paper.
#
# Exact ray tracing refutes them in several places (``docs/sixdof.md``, "What the print has otherwise"): the cross-talk of
# the angles in mode 1, the drift in yaw and pitch, the roll of Y and Z. Nothing else in the program uses this part.
# Where the print is illegible (pitch of Y, the sign of the drift) the traced form is used.


WARNING = (
    "as_printed = true: the paper's own equations 5 to 7 are used, with the signs that ray tracing refutes (cross-talk in "
    "mode 1, drift, roll of Y and Z); the result is for comparison with the paper only, never for a machine"
)


class _Terms:
    """Quantities in the equations, for one run of n rows."""

    def __init__(self, readings: SixDof, optics: Optics, entry: AxisSetUp, run: RelativeRun) -> None:
        signals = signals_of(readings, run.rows)
        f = optics.focal_length_mm
        self.y1, self.z1, self.z2 = signals[:, 1], signals[:, 2], signals[:, 4]
        self.yp, self.zp = signals[:, 5] / (2 * f), signals[:, 6] / (2 * f)
        self.ay, self.az = drift_of(readings, run.rows, f).T
        self.L, self.h, self.t = run.distance_mm, optics.beam_separation_mm, optics.reduced_depth_mm
        self.n, self.b, self.second = optics.glass_index, optics.prism_leg_mm, float(entry.set_up.mode == 2)
        self.s = entry.set_up.sense
        self.values: Mapping[str, float] = entry.systematics

    def p(self, name: str) -> float:
        """Value of a systematic parameter, mm or rad, 0 if it is not calibrated."""
        return self.values.get(name, 0.0)


def _x(m: _Terms) -> list[FloatArray]:
    """Equation 5: horizontal, vertical, yaw, pitch, roll of X."""
    p = m.p
    yaw = -m.s * (m.yp + p("eps_zic") - p("eps_PEz") / 2 - m.ay)
    pitch = m.s * (m.zp - p("eps_yic") + p("eps_PEy") / 2 - m.az)
    across = m.y1 / 2 - p("delta_ymc1") / 2 + p("eps_zmc1") * m.L / 2 - p("delta_yic")
    up = m.z1 / 2 - p("delta_zmc1") / 2 - p("eps_ymc1") * m.L / 2 - p("delta_zic")
    horizontal = m.s * (across + m.t * (p("eps_zic") + yaw) + m.second * m.L * yaw + m.L * m.ay)
    vertical = m.s * (up - m.t * (p("eps_yic") + pitch) - m.second * m.L * pitch + m.L * m.az)
    cubes = p("delta_zmc2") - p("delta_zmc1") + m.L * (p("eps_ymc2") - p("eps_ymc1"))
    roll = m.s * (m.z1 - m.z2 + 2 * p("eps_PEy") * (m.L + m.t) + cubes) / (2 * m.h)
    return [horizontal, vertical, yaw, pitch, roll]


def _y(m: _Terms) -> list[FloatArray]:
    """Equation 6: horizontal, vertical, yaw, pitch, roll of Y."""
    p, n, b = m.p, m.n, m.b
    faces = p("eps_zmrs1") + p("eps_zmrs2")
    yaw = m.s * (m.yp - p("eps_zic") - p("eps_PEz") / 2 + 2 * p("eps_zir") - (n - 1) * faces - m.ay)
    tilt = p("eps_xic") + p("eps_PEy") / 2 - p("eps_xir") - p("eps_yir") + (n - 1) * (p("eps_ymrs1") + p("eps_xmrs2"))
    pitch = -m.s * (m.zp + tilt - m.az)
    outer, inner, arm = (n - 1) * (m.L + m.t), (n - 1) * (m.L + m.t) + b * (1 - 1 / n), m.L + b / 2
    across = m.y1 / 2 - p("eps_zmc3") * (m.L + b / n) / 2 - p("delta_xmc3") / 2 - p("delta_xic")
    across = across + p("delta_xir") - p("delta_yir") - p("eps_zir") * (2 * m.L + 2 * m.t + b / n + b / 2)
    across = across + inner * p("eps_zmrs1") + outer * p("eps_zmrs2")
    up = m.z1 / 2 + p("eps_xmc3") * (m.L + b / n) / 2 - p("delta_zmc3") / 2 - p("delta_zic")
    up = up + p("eps_xir") * (arm + m.t) + p("eps_yir") * (arm + m.t + b / n)
    up = up - inner * p("eps_ymrs1") - outer * p("eps_xmrs2")
    horizontal = m.s * (across - m.t * (p("eps_zic") + yaw) - m.second * arm * yaw + m.L * m.ay)
    vertical = m.s * (up + m.t * (p("eps_xic") + pitch) + m.second * arm * pitch + m.L * m.az)
    cubes = p("delta_zmc4") - p("delta_zmc3") + (p("eps_xmc3") - p("eps_xmc4")) * (m.L + b / n)
    roll = m.s * (m.z1 - m.z2 + 2 * p("eps_PEy") * (m.L + b / n + m.t) + cubes) / (2 * m.h)
    return [horizontal, vertical, yaw, pitch, roll]


def _z(m: _Terms) -> list[FloatArray]:
    """Equation 7: horizontal, vertical, yaw, pitch, roll of Z."""
    p, b, arm = m.p, m.b, m.L + m.b / 2
    yaw = m.s * (m.yp - p("eps_xic") - p("eps_PEz") / 2 + p("eps_xir") + p("eps_zir") - m.ay)
    pitch = -m.s * (m.zp + p("eps_yic") + p("eps_PEy") / 2 - 2 * p("eps_yir") - m.az)
    across = m.y1 / 2 - p("delta_ymc5") / 2 - p("delta_yic") - (b + m.L) * p("eps_xmc5") / 2
    across = across - (p("eps_xir") + p("eps_zir")) * (arm + m.t)
    up = m.z1 / 2 - p("delta_xmc5") / 2 - p("delta_xic") + p("delta_xir") - p("delta_zir")
    up = up + (b + m.L) * p("eps_ymc5") / 2 + 2 * p("eps_yir") * (m.L + 0.75 * b - m.t)
    horizontal = m.s * (across - m.t * (p("eps_xic") + yaw) - m.second * arm * yaw + m.L * m.ay)
    vertical = m.s * (up + m.t * (p("eps_yic") + pitch) + m.second * arm * pitch + m.L * m.az)
    cubes = p("delta_xmc6") - p("delta_xmc5") - (b + m.L) * (p("eps_ymc6") - p("eps_ymc5"))
    roll = m.s * (m.z1 - m.z2 - 2 * p("eps_PEy") * (b + m.L + m.t) + cubes) / (2 * m.h)
    return [horizontal, vertical, yaw, pitch, roll]


def printed_run(machine: Machine, readings: SixDof, instrument: SixDofInstrument, run: RelativeRun) -> AxisRun:
    """Errors of the moving body over a run by the printed equations, in its own axes, zero at the reference point."""
    entry, axis = instrument.axes[run.axis], run.axis
    if entry.set_up.beam_direction < 0:
        message = "is -1, for which the paper prints no equations; as_printed needs beam_direction = 1"
        raise InputError(message, file=instrument.source, field=f"[axes.{AXES[axis]}] beam_direction")
    terms = _Terms(readings, instrument.optics, entry, run)
    delta, eps = np.zeros((len(run.rows), 3)), np.zeros((len(run.rows), 3))
    channels = (_x, _y, _z)[axis](terms)
    delta[:, list(DIRECTIONS[axis][1:])] = np.column_stack(channels[:2])
    eps[:, list(ROTATIONS[axis])] = np.column_stack(channels[2:])
    delta[:, axis] = terms.s * run.shift_mm[:, axis]
    delta, eps = (zeroed(machine, axis, run.position_mm, values) for values in (delta, eps))
    return AxisRun(axis, run.run, run.position_mm, delta, eps, run.direction, False, "as printed")
