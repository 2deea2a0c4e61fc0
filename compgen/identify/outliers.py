"""Readings that do not belong: found by a robust limit, explained where the data allow it, never dropped silently."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.identify.parameters import ErrorParameters
from compgen.identify.state import IntArray, State
from compgen.model.exact import tip_position
from compgen.model.volumetric import tool_of

#: A reading is rejected when its residual exceeds this many robust standard deviations (1.4826 MAD).
LIMIT = 6.0


@dataclass(frozen=True)
class Rejected:
    """One rejected reading: where it stands, its residual in um, and the reason in words."""

    row: int
    station: str
    point: str
    residual_um: float
    reason: str
    file: str = ""
    line: int = 0


def accepted_readings(standardised: FloatArray) -> NDArray[np.bool_]:
    """Mark the readings whose residual over its standard uncertainty (n,) lies within the robust limit.

    The scale is not let below a thousandth of the uncertainty, so that rounding in noise-free data rejects nothing.
    """
    size = np.abs(standardised)
    if float(size.max()) <= LIMIT * 1e-3:
        return np.ones(len(size), dtype=bool)
    spread = 1.4826 * float(np.median(np.abs(standardised - np.median(standardised))))
    return np.asarray(size <= LIMIT * max(spread, 1e-3))


def explain_rejected(
    lengths: Lengths,
    layout: ErrorParameters,
    state: State,
    group: IntArray,
    rejected: IntArray,
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
) -> tuple[Rejected, ...]:
    """Give every rejected reading a reason: another station's or another point's length, or just its size.

    Parameters
    ----------
    lengths, layout, state, group : readings, unknowns, their values, and the dead length of each reading.
    rejected : rows of the rejected readings.
    residual_mm, sigma_mm : model minus reading and standard uncertainty of every reading, (n,).
    """
    if not len(rejected):
        return ()
    tool = np.broadcast_to(tool_of(layout.machine, lengths.tool_mm), lengths.position_mm.shape)
    poses, pose = np.unique(np.column_stack([lengths.position_mm, tool]), axis=0, return_inverse=True)
    bases = [layout.basis(axis, poses[:, axis]) for axis in range(3)]
    tip = tip_position(layout.machine, layout.values(state.errors, bases), poses[:, :3], poses[:, 3:])
    dead = np.zeros(len(state.stations_mm))
    dead[lengths.station] = state.dead_length_mm[group]
    predicted = np.linalg.norm(tip[:, None, :] - state.stations_mm[None], axis=2) - dead
    found = []
    for row in rejected.tolist():
        file, line = lengths.origin[row] if lengths.origin else ("", 0)
        found.append(
            Rejected(
                row=row,
                station=lengths.stations[lengths.station[row]],
                point=str(lengths.point[row]),
                residual_um=float(-residual_mm[row] * 1000.0),
                reason=_reason(
                    lengths,
                    predicted,
                    poses,
                    int(pose.ravel()[row]),
                    row,
                    float(residual_mm[row]),
                    float(sigma_mm[row]),
                ),
                file=file,
                line=line,
            )
        )
    return tuple(found)


def _reason(
    lengths: Lengths,
    predicted: FloatArray,
    poses: FloatArray,
    pose: int,
    row: int,
    residual: float,
    sigma_mm: float,
) -> str:
    size = f"differs from the model by {-residual * 1000.0:+.1f} um, {abs(residual) / sigma_mm:.0f} standard deviations"
    station, reading = lengths.station[row], lengths.length_mm[row]
    close = 10.0 * sigma_mm
    others = np.abs(predicted[pose] - reading)
    others[station] = np.inf
    if others.min() < close:
        return (
            f"{size}; it fits station {lengths.stations[int(np.argmin(others))]!r} at this point: wrong station label?"
        )
    points = np.abs(predicted[:, station] - reading)
    points[pose] = np.inf
    if abs(residual) > 0.05 and points.min() < min(close, 0.002):
        where = ", ".join(f"{value:g}" for value in poses[int(np.argmin(points)), :3])
        return f"{size}; it fits the position ({where}) mm: duplicated or swapped point?"
    return f"{size}; beam break or disturbed reading?"
