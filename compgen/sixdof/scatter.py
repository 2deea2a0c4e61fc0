"""How much single readings scatter: stated noise of the detectors, and what repeated runs show beyond it.

Scatter is described where it arises: as motion of the body (translations and rotations of target or unit, (6,), before
anything is zeroed), because an angle that scatters does so together with the straightness that its arm makes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.sixdof.frames import expected_away, motion_of_unit
from compgen.sixdof.instrument import Instrument
from compgen.sixdof.optics import DIRECTIONS, ROTATIONS
from compgen.sixdof.readings import SixDof
from compgen.sixdof.reduction import RelativeRun, relative_motion

DETECTORS = {
    "displacement_mm": "displacement",
    "y_qd1_mm": "qd",
    "z_qd1_mm": "qd",
    "z_qd2_mm": "qd",
    "y_psd1_mm": "psd",
    "z_psd1_mm": "psd",
}
MONITOR = {"y_psd2_mm": "psd", "z_psd2_mm": "psd"}
#: Steps of a signal for its derivative, mm; the reduction is linear in it.
STEP_MM = 1e-3


@dataclass(frozen=True)
class Scatter:
    """Covariance of one reading of an axis by source, each (groups, 6, 6), mm and rad.

    A group is a target position in one direction of travel; ``rows`` says for each run to which group its rows belong.
    """

    axis: int
    rows: tuple[NDArray[np.int64], ...]
    count: FloatArray
    sources: dict[str, FloatArray]


def body_motion(instrument: Instrument, run: RelativeRun, at_tool: bool) -> FloatArray:
    """Motion (n, 6) of the target, or of the unit if ``at_tool``, in machine axes, mm and rad."""
    if not at_tool:
        return np.hstack([run.shift_mm, run.turn_rad])
    return np.hstack(motion_of_unit(instrument, run))


def moved_run(instrument: Instrument, run: RelativeRun, at_tool: bool, change: FloatArray) -> RelativeRun:
    """The run with the body moved by ``change`` (n, 6) further; changes since its first row, as :func:`reduce_runs`."""
    if at_tool:
        beam = instrument.axes[run.axis].set_up.beam_direction * np.eye(3)[run.axis]
        reach = (run.distance_mm + instrument.optics.lever_mm(run.axis))[:, None] * beam
        turn = -change[:, 3:]
        shift = np.cross(turn, reach) - change[:, :3]
    else:
        shift, turn = change[:, :3], change[:, 3:]
    return replace(run, shift_mm=run.shift_mm + shift - shift[0], turn_rad=run.turn_rad + turn - turn[0])


def unit_moves(machine: Machine, instrument: Instrument, run: RelativeRun) -> bool:
    """Whether the errors are made from the motion of the unit."""
    if run.away == expected_away(machine, instrument)[run.axis]:
        return run.away < 0
    return instrument.axes[run.axis].set_up.mode == 2


def groups_of(runs: Sequence[RelativeRun]) -> tuple[tuple[NDArray[np.int64], ...], int]:
    """Group of each row of each run by position (0.1 um) and direction, and how many groups there are."""
    keys = [np.column_stack([np.round(run.position_mm, 4), run.direction]) for run in runs]
    found, index = np.unique(np.vstack(keys), axis=0, return_inverse=True)
    ends = np.cumsum([len(key) for key in keys])[:-1]
    return tuple(part.astype(np.int64) for part in np.split(index.ravel(), ends)), len(found)


def scatter_of(machine: Machine, readings: SixDof, instrument: Instrument, runs: Sequence[RelativeRun]) -> Scatter:
    """Scatter of the readings of one axis, whose runs are ``runs``.

    The stated noise counts as it is. What repeated runs scatter beyond it (each run freed of an offset and a line, which
    its first row makes) is the source ``repeatability``. Without repeats and without stated noise the differences of
    neighbouring positions take its place.
    """
    rows, size = groups_of(runs)
    count = np.bincount(np.concatenate(rows), minlength=size).astype(np.float64)
    at_tool = unit_moves(machine, instrument, runs[0])
    stated = _stated(readings, instrument, runs, rows, size, at_tool) if instrument.noise else {}
    motion = [body_motion(instrument, run, at_tool) for run in runs]
    observed = _repeats(runs, motion, rows, size) if len(runs) > 1 else None
    if observed is None and not stated:
        observed = _neighbours(motion)
    sources = dict(stated)
    if observed is not None:
        known = sum((value.mean(axis=0) for value in stated.values()), np.zeros((6, 6)))
        sources["repeatability"] = np.tile(_excess(observed, known), (size, 1, 1))
    return Scatter(runs[0].axis, rows, count, sources)


def _excess(observed: FloatArray, known: FloatArray) -> FloatArray:
    """The part of an observed covariance (6, 6) beyond what is known; all of it where nothing is."""
    if not np.any(known):
        return observed
    return np.diag(np.maximum(np.diag(observed) - np.diag(known), 0.0))


def _repeats(
    runs: Sequence[RelativeRun], motion: Sequence[FloatArray], rows: Sequence[NDArray[np.int64]], size: int
) -> FloatArray | None:
    """Covariance (6, 6) of single readings about the mean of the runs; None where too few positions are repeated."""
    total, weight = np.zeros((6, 6)), 0.0
    table = np.full((len(runs), size, 6), np.nan)
    for table_run, values, index in zip(table, motion, rows, strict=True):
        table_run[index] = values
    position = np.full(size, np.nan)
    for run, index in zip(runs, rows, strict=True):
        position[index] = run.position_mm
    whole = ~np.isnan(table).any(axis=(0, 2))
    if np.count_nonzero(whole) < 4:
        return None
    rest = table[:, whole] - table[:, whole].mean(axis=0)
    line = np.column_stack([np.ones(int(whole.sum())), position[whole]])
    for values in rest:
        left = values - line @ np.linalg.lstsq(line, values, rcond=None)[0]
        total += left.T @ left
        weight += len(left) - 2
    freedom = weight * (len(runs) - 1) / len(runs)
    return total / freedom * student(freedom)


def student(freedom: float) -> float:
    """Variance of Student's t for so many degrees of freedom: what a variance from few readings has to be multiplied by."""
    return freedom / max(freedom - 2.0, 0.5)


def _neighbours(motion: Sequence[FloatArray]) -> FloatArray:
    """Variances (6, 6) from second differences of neighbouring readings, which a smooth curve hardly shows."""
    seconds = [values[2:] - 2 * values[1:-1] + values[:-2] for values in motion if len(values) > 3]
    if not seconds:
        return np.zeros((6, 6))
    stacked = np.vstack(seconds)
    return np.diag(np.mean(stacked**2, axis=0) / 6.0)


def _stated(
    readings: SixDof,
    instrument: Instrument,
    runs: Sequence[RelativeRun],
    rows: Sequence[NDArray[np.int64]],
    size: int,
    at_tool: bool,
) -> dict[str, FloatArray]:
    """Covariances (groups, 6, 6) of the body's motion by the stated noise of detectors and drift monitor."""
    result = {}
    for source, channels in (("detectors", DETECTORS), ("drift monitor", MONITOR)):
        covariance = np.zeros((size, 6, 6))
        for run, index in zip(runs, rows, strict=True):
            columns = [
                instrument.noise.get(kind, 0.0) * _response(readings, instrument, run, at_tool, name)
                for name, kind in channels.items()
            ]
            covariance[index] = sum(np.einsum("ni,nj->nij", column, column) for column in columns)
        result[source] = covariance
    return result


def _response(readings: SixDof, instrument: Instrument, run: RelativeRun, at_tool: bool, name: str) -> FloatArray:
    """Motion of the body (n, 6) that 1 mm more of one signal makes, by differences of the real reduction."""

    def reduced(step: float) -> FloatArray:
        signals = {**readings.signals_mm, name: readings.signals_mm[name] + step}
        zero = np.zeros(len(run.rows))
        moved = replace(readings, signals_mm=signals)
        roles = relative_motion(moved, instrument, run.rows, run.axis, run.distance_mm, zero)
        part = replace(run, shift_mm=np.zeros((len(zero), 3)), turn_rad=np.zeros((len(zero), 3)))
        part.shift_mm[:, list(DIRECTIONS[run.axis])] = roles[:, :3]
        part.turn_rad[:, list(ROTATIONS[run.axis])] = roles[:, 3:]
        return body_motion(instrument, part, at_tool)

    return np.asarray((reduced(STEP_MM) - reduced(-STEP_MM)) / (2.0 * STEP_MM))


__all__ = ["Scatter", "body_motion", "groups_of", "moved_run", "scatter_of", "unit_moves"]
