"""Raw signals of one run to the motion of the target relative to the unit.

Whichever body moves, the instrument sees the same thing: the pose of the target in the frame of unit and prism. So both
modes are reduced as "the target moves"; what moves which way in the machine is said in one place, :mod:`frames`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.errors import InputError
from compgen.sixdof.instrument import AxisSetUp, Instrument
from compgen.sixdof.model import SetUp, drift_matrix, solve_errors, systematic_signals
from compgen.sixdof.optics import DIRECTIONS, ROTATIONS, SIGNALS
from compgen.sixdof.readings import SixDof

#: Slope of the interferometer's reading against the command below which it holds deviations only.
DEVIATIONS_ONLY = 0.5
#: How far the slope may be from -1, 0 or +1.
LARGEST_SCALE_ERROR = 0.01


@dataclass(frozen=True)
class RelativeRun:
    """Motion of the target relative to the unit over one run, changes since its first row; n rows.

    Parameters
    ----------
    axis, run : which one.
    rows : rows of the readings.
    position_mm : commanded positions of the axis, (n,).
    distance_mm : optical distance L, (n,).
    shift_mm : displacement of the front centre of the first cube corner in machine axes, nominal travel left out, (n, 3).
    turn_rad : rotation of the target, (n, 3).
    away : +1 if the target moves along the positive axis relative to the unit when the command rises, else -1.
    direction : sign of travel, 0 where it is not given, (n,).
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


def reduce_runs(readings: SixDof, instrument: Instrument, expected_away: dict[int, int]) -> list[RelativeRun]:
    """Return every run, reduced.

    Parameters
    ----------
    expected_away : by axis, which way the target moves relative to the unit when the command rises, as machine and mode
        have it; it counts where the interferometer's readings hold deviations only.

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
            raise InputError(f"run {run} of {AXES[axis]} has fewer than two positions", file=file, line=line)
        first.setdefault(axis, float(readings.position_mm[rows[0]]))
        reduced.append(_reduce(readings, instrument, axis, run, rows, first[axis], expected_away[axis]))
    return reduced


def _reduce(
    readings: SixDof,
    instrument: Instrument,
    axis: int,
    run: int,
    rows: NDArray[np.int64],
    first_mm: float,
    expected_away: int,
) -> RelativeRun:
    set_up = instrument.axes[axis]
    position = readings.position_mm[rows]
    away, nominal = _travel(readings, axis, run, rows, set_up, expected_away)
    distance = _distance(readings, rows, set_up, instrument, away * (position - first_mm))
    motion = relative_motion(readings, instrument, rows, axis, distance, nominal)
    shift, turn = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
    shift[:, list(DIRECTIONS[axis])] = motion[:, :3]
    turn[:, list(ROTATIONS[axis])] = motion[:, 3:]
    return RelativeRun(
        axis=axis,
        run=run,
        rows=rows,
        position_mm=position,
        distance_mm=distance,
        shift_mm=shift - shift[0],
        turn_rad=turn - turn[0],
        away=away,
        direction=readings.direction[rows],
    )


def relative_motion(
    readings: SixDof,
    instrument: Instrument,
    rows: NDArray[np.int64],
    axis: int,
    distance_mm: FloatArray,
    nominal_mm: FloatArray,
) -> FloatArray:
    """Motion of the target relative to the unit, (n, 6) in the order of ROLES, systematics and drift taken out.

    ``nominal_mm`` is the part of the interferometer's reading that the commanded travel makes.
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

    Its zero is that of the readings: for squareness it must be one and the same for all axes.
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
            f"run {run} of {AXES[axis]}: displacement_mm changes by {slope:.4f} mm per mm of position_mm; 1, -1, or 0 "
            "(deviations only) is due: check units, position_mm, and the interferometer",
            file=file,
            line=line,
            field="column displacement_mm",
        )
    if nearest == 0:
        return expected_away, np.zeros(len(rows))
    return nearest * beam, nearest * position


def _distance(
    readings: SixDof, rows: NDArray[np.int64], entry: AxisSetUp, instrument: Instrument, travel_mm: FloatArray
) -> FloatArray:
    """Optical distance L of each row: as it was read, else from the first target position; ``travel_mm`` along the axis."""
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
            f"the optical distance would become {distance.min():g} mm; check distance_first_mm (now "
            f"{entry.distance_first_mm:g}), beam_direction and mode of {letter}",
            file=instrument.source,
            field=f"[axes.{letter}] distance_first_mm",
        )
    return np.asarray(distance)
