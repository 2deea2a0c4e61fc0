"""Start values of a station in closed form, refined on the distances; no search, so that gross errors show at once."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.layout import IntArray
from compgen.identify.start import StationStart, station_start

REFINEMENTS = 4
LEAST_SHARE = 1e-9


def located(
    target_mm: FloatArray, length_mm: FloatArray, group: IntArray, groups: int
) -> tuple[StationStart, FloatArray]:
    """Place and dead lengths of a station, and the residuals of its readings, (n,).

    |P|^2 - L^2 = 2 P.s + 2 l L - (|s|^2 - l^2), linear in s, l and a constant for each set-up.
    """
    centre = target_mm.mean(axis=0)
    scale = max(float(np.abs(target_mm - centre).max()), 1.0)
    p, offset = (target_mm - centre) / scale, float(length_mm.mean())
    reading = (length_mm - offset) / scale
    member = (group[:, None] == np.arange(groups)).astype(np.float64)
    design = np.hstack([2 * p, 2 * reading[:, None] * member, member])
    target = np.einsum("ij,ij->i", p, p) - reading**2
    solution, _, rank, _ = np.linalg.lstsq(design, target, rcond=LEAST_SHARE)
    if rank < design.shape[1]:
        found = station_start(target_mm, length_mm, group, groups)
    else:
        found = StationStart(solution[:3] * scale + centre, solution[3 : 3 + groups] * scale - offset)
    return _refined(target_mm, length_mm, group, member, found)


def _refined(
    target_mm: FloatArray, length_mm: FloatArray, group: IntArray, member: FloatArray, start: StationStart
) -> tuple[StationStart, FloatArray]:
    best, residual = start, _residual(target_mm, length_mm, group, start)
    for _ in range(REFINEMENTS):
        line = target_mm - best.position_mm
        unit = line / np.maximum(np.linalg.norm(line, axis=1), 1e-9)[:, None]
        step = np.linalg.lstsq(np.hstack([-unit, -member]), residual, rcond=1e-9)[0]
        moved = StationStart(best.position_mm + step[:3], best.dead_length_mm + step[3:])
        new = _residual(target_mm, length_mm, group, moved)
        if not np.sum(new**2) < np.sum(residual**2):
            break
        best, residual = moved, new
    return best, residual


def _residual(target_mm: FloatArray, length_mm: FloatArray, group: IntArray, start: StationStart) -> FloatArray:
    distance = np.linalg.norm(target_mm - start.position_mm, axis=1)
    return np.asarray(length_mm - distance + start.dead_length_mm[group])
