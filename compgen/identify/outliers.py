"""Readings that do not belong: found by a robust limit, explained where the data allow it, never dropped silently."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.deviations import DEVIATION_COLUMNS, Deviations
from compgen.core.lengths import Lengths
from compgen.core.names import MM_PER_UM
from compgen.identify.parameters import ErrorParameters
from compgen.identify.segments import Segment
from compgen.identify.state import IntArray, State
from compgen.model.exact import tip_position
from compgen.model.volumetric import tool_of

#: A reading is rejected when its residual exceeds this many robust standard deviations (1.4826 MAD).
LIMIT = 6.0
#: The robust standard deviation is not let below this share of the stated uncertainty.
LEAST_SPREAD = 0.02
#: Residuals that scatter more than so many standard uncertainties are looked at for gross mistakes.
LARGEST_SPREAD = 10.0
#: Residuals that are enough to see whether they scatter that much.
SAMPLE = 2000
#: A reading fits another point or station when it agrees within so many standard deviations.
CLOSE = 10.0
#: Below this size a residual is no exchange of points: neighbours in the volume are further apart.
SMALLEST_EXCHANGE_MM = 0.05


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


def standardised_spread(standardised: FloatArray) -> float:
    """Robust standard deviation (1.4826 MAD) of residuals over their standard uncertainties (n,).

    Not let below ``LEAST_SPREAD``, so that rounding in noise-free data rejects nothing.
    """
    return max(1.4826 * float(np.median(np.abs(standardised - np.median(standardised)))), LEAST_SPREAD)


def accepted_readings(standardised: FloatArray) -> NDArray[np.bool_]:
    """Mark the readings whose residual over its standard uncertainty (n,) lies within the robust limit."""
    size = np.abs(standardised)
    largest = float(size.max())
    quick = 1.25 * float(np.median(size[:: max(1, len(size) // 500) | 1]))  # of a sample, and on the safe side
    if largest <= LIMIT * max(quick, LEAST_SPREAD):
        return np.ones(len(size), dtype=bool)
    return np.asarray(size <= LIMIT * standardised_spread(standardised))


def belonging(standardised: FloatArray) -> bool:
    """Whether all readings belong: none beyond the limit, and no residuals so large that a mistake may hide in them."""
    return (
        bool(accepted_readings(standardised).all())
        and standardised_spread(standardised[:: max(7, len(standardised) // SAMPLE) | 1]) < LARGEST_SPREAD
    )


@dataclass(frozen=True)
class _Expected:
    """What the model expects: distances of poses and stations (m, S), dead lengths and their stations (g,)."""

    distance_mm: FloatArray
    dead_mm: FloatArray
    station_of: IntArray
    pose: IntArray
    group: IntArray
    close_mm: FloatArray


def explain_rejected(
    lengths: Lengths,
    layout: ErrorParameters,
    state: State,
    group: IntArray,
    rejected: IntArray,
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
    segments: Sequence[Segment] = (),
) -> tuple[Rejected, ...]:
    """Give every rejected reading a reason: another station's or another point's length, a beam break, or its size.

    Parameters
    ----------
    lengths, layout, state, group : readings, unknowns, their values, and the dead length of each reading.
    rejected : rows of the rejected readings.
    residual_mm, sigma_mm : model minus reading and standard uncertainty of every reading, (n,).
    segments : runs of readings with a common offset.
    """
    if not len(rejected):
        return ()
    expected = _expected(lengths, layout, state, group, residual_mm, sigma_mm)
    rows = rejected.tolist()
    broken = _rows_of(lengths, segments, set(rows))
    exchanged = _exchanges(lengths, expected, [row for row in rows if row not in broken], residual_mm)
    found = []
    for row in rows:
        size = f"differs from the model by {-residual_mm[row] * 1000.0:+.1f} um, "
        size += f"{abs(residual_mm[row]) / sigma_mm[row]:.0f} standard deviations"
        why = broken.get(row) or _other_station(lengths, expected, row) or exchanged.get(row)
        file, line = lengths.origin[row] if lengths.origin else ("", 0)
        found.append(
            Rejected(
                row=row,
                station=lengths.stations[lengths.station[row]],
                point=str(lengths.point[row]),
                residual_um=float(-residual_mm[row] * 1000.0),
                reason=f"{size}; {why or 'beam break or disturbed reading?'}",
                file=str(file),
                line=line,
            )
        )
    return tuple(found)


def _expected(
    lengths: Lengths,
    layout: ErrorParameters,
    state: State,
    group: IntArray,
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
) -> _Expected:
    tool = np.broadcast_to(tool_of(layout.machine, lengths.tool_mm), lengths.position_mm.shape)
    poses, pose = np.unique(np.column_stack([lengths.position_mm, tool]), axis=0, return_inverse=True)
    bases = [layout.basis(axis, poses[:, axis]) for axis in range(3)]
    tip = tip_position(layout.machine, layout.values(state.errors, bases), poses[:, :3], poses[:, 3:])
    station_of = np.zeros(len(state.dead_length_mm), dtype=np.int64)
    station_of[group] = lengths.station
    return _Expected(
        distance_mm=np.linalg.norm(tip[:, None, :] - state.stations_mm[None], axis=2),
        dead_mm=state.dead_length_mm,
        station_of=station_of,
        pose=pose.ravel().astype(np.int64),
        group=group,
        close_mm=CLOSE * sigma_mm * max(standardised_spread(residual_mm / sigma_mm), 0.1),
    )


def _rows_of(lengths: Lengths, segments: Sequence[Segment], rejected: set[int]) -> dict[int, str]:
    """Rejected rows that are part of a rejected segment, with the reason."""
    found = {}
    for segment in segments:
        if not segment.kept:
            where = f"lines {segment.line} to {segment.last_line}" if segment.line else "a run of readings"
            text = f"one of {segment.readings} readings off by {segment.offset_mm:+.3f} mm ({where}): beam break"
            found.update({row: text for row in segment.rows if row in rejected})
    return found


def _other_station(lengths: Lengths, expected: _Expected, row: int) -> str | None:
    """Say which other station's length at this point the reading is, if it is one."""
    predicted = expected.distance_mm[expected.pose[row], expected.station_of] - expected.dead_mm
    off = np.abs(predicted - lengths.length_mm[row])
    off[expected.station_of == lengths.station[row]] = np.inf
    best = int(np.argmin(off))
    if off[best] > expected.close_mm[row]:
        return None
    return f"it fits station {lengths.stations[expected.station_of[best]]!r} at this point: wrong station label?"


def _exchanges(lengths: Lengths, expected: _Expected, rows: Sequence[int], residual_mm: FloatArray) -> dict[int, str]:
    """Find readings that belong to another point: two points exchanged, or one point's reading given twice.

    All rejected readings of one stop must agree on the other point.
    """
    run = lengths.labels.get("run", np.zeros(len(lengths), dtype=np.int64))
    candidates: dict[tuple[int, int], set[int]] = {}
    members: dict[tuple[int, int], list[int]] = defaultdict(list)
    for row in rows:
        fits = _fitting_poses(lengths, expected, row) if abs(residual_mm[row]) > SMALLEST_EXCHANGE_MM else set()
        if fits:
            stop = (int(expected.pose[row]), int(run[row]))
            candidates[stop] = candidates.get(stop, fits) & fits
            members[stop].append(row)
    found = {}
    for stop, fits in candidates.items():
        mutual = [pose for pose in fits if stop[0] in candidates.get((pose, stop[1]), set())]
        chosen = mutual or sorted(fits)
        if len(chosen) != 1:
            continue
        what = "the two points are exchanged" if mutual else "duplicated or wrong point?"
        text = f"it fits {_point_name(lengths, expected, chosen[0])}: {what}"
        found.update(dict.fromkeys(members[stop], text))
    return found


def _fitting_poses(lengths: Lengths, expected: _Expected, row: int) -> set[int]:
    predicted = expected.distance_mm[:, lengths.station[row]] - expected.dead_mm[expected.group[row]]
    off = np.abs(predicted - lengths.length_mm[row])
    off[expected.pose[row]] = np.inf
    return set(np.flatnonzero(off <= expected.close_mm[row]).tolist())


def _point_name(lengths: Lengths, expected: _Expected, pose: int) -> str:
    row = int(np.flatnonzero(expected.pose == pose)[0])
    where = ", ".join(f"{value:g}" for value in lengths.position_mm[row])
    return f"point {lengths.point[row]} at ({where}) mm"


def rejected_components(
    deviations: Deviations,
    row: IntArray,
    component: IntArray,
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
    accepted: NDArray[np.bool_],
) -> tuple[Rejected, ...]:
    """Name the measured components (k,) that were rejected: row and component of each, residual as model minus measured."""
    found = []
    for k in np.flatnonzero(~accepted).tolist():
        at = int(row[k])
        file, line = deviations.origin[at] if deviations.origin else ("", 0)
        where = ", ".join(f"{value:g}" for value in deviations.position_mm[at])
        size_um = float(-residual_mm[k]) / MM_PER_UM
        many = abs(residual_mm[k]) / sigma_mm[k]
        reason = f"differs from the model by {size_um:+.1f} um, {many:.0f} standard deviations; disturbed reading?"
        name = DEVIATION_COLUMNS[component[k]]
        found.append(Rejected(at, name, f"({where}) mm", size_um, reason, str(file), line))
    return tuple(found)
