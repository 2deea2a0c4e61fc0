"""Start values of the stations in closed form: from lengths to positions that may be metres away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray

#: Share of the largest eigenvalue below which the readings do not locate a station in closed form.
LEAST_EIGENVALUE = 1e-10


@dataclass(frozen=True)
class StationStart:
    """Start of one station: position (3,) and dead length of each of its set-ups (g,), mm."""

    position_mm: FloatArray
    dead_length_mm: FloatArray


def station_start(points_mm: FloatArray, length_mm: FloatArray, group: NDArray[np.int64], groups: int) -> StationStart:
    """Locate one station from nominal points (n, 3) and readings (n,).

    |P - s|^2 = (L + l)^2 gives |P|^2 - L^2 = 2 P.s + 2 l L - (|s|^2 - l^2), linear in s, l and a constant for every
    set-up ``group`` (n,) = 0 ... groups - 1. Where the points do not determine it (all in a plane or on a line) or
    where the result does not explain the readings, a search from many directions takes its place.
    """
    centre, scale = points_mm.mean(axis=0), max(float(np.ptp(points_mm, axis=0).max()), 1.0)
    p = (points_mm - centre) / scale
    reading = length_mm / scale
    member = group[:, None] == np.arange(groups)
    target = np.einsum("ij,ij->i", p, p) - reading**2
    offset = reading.mean()
    columns = np.column_stack([2 * p, 2 * (reading - offset)[:, None] * member, member, target])
    normal = columns.T @ columns
    size = 3 + 2 * groups
    unit = 1.0 / np.sqrt(np.maximum(np.diag(normal)[:size], 1e-300))
    eigenvalues, vectors = np.linalg.eigh(normal[:size, :size] * unit * unit[:, None])
    kept = eigenvalues > 1e-11 * eigenvalues[-1]
    right = vectors[:, kept].T @ (normal[:size, size] * unit)
    solution = unit * (vectors[:, kept] @ (right / eigenvalues[kept]))
    position, dead = solution[:3], solution[3 : 3 + groups]
    if not kept.all() or _misfit(p, reading, member, position, dead) > 1e-2:
        position, dead = _search(p, reading, member)
    return StationStart(position * scale + centre, dead * scale)


def station_start_from_moments(
    moments: FloatArray, offset: FloatArray, centre_mm: FloatArray, scale_mm: float
) -> StationStart | None:
    """Locate one station from the moments of its set-ups (g, 6, 6) as ``grid_start.start_moments`` has them.

    None where they do not determine it.
    """
    groups = len(moments)
    size = 3 + 2 * groups
    normal, right = np.zeros((size, size)), np.zeros(size)
    for k, part in enumerate(moments):
        index = [0, 1, 2, 3 + k, 3 + groups + k]
        normal[np.ix_(index, index)] += part[:5, :5]
        right[index] += part[:5, 5]
    diagonal = np.diag(normal)
    if not diagonal.min() > 0:
        return None
    unit = 1.0 / np.sqrt(diagonal)
    eigenvalues, vectors = np.linalg.eigh(normal * unit * unit[:, None])
    if eigenvalues[0] < LEAST_EIGENVALUE * eigenvalues[-1]:
        return None
    solution = unit * (vectors @ ((vectors.T @ (right * unit)) / eigenvalues))
    return StationStart(solution[:3] * scale_mm + centre_mm, (solution[3 : 3 + groups] - offset) * scale_mm)


def station_starts_from_moments(
    moments: FloatArray, offset: FloatArray, centre_mm: FloatArray, scale_mm: float
) -> list[StationStart | None]:
    """Locate stations of one set-up each, all at once: moments (S, 6, 6) and offsets (S,) as for one."""
    normal, right = moments[:, :5, :5], moments[:, :5, 5]
    diagonal = np.einsum("sii->si", normal)
    unit = 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))
    eigenvalues, vectors = np.linalg.eigh(normal * unit[:, :, None] * unit[:, None, :])
    good = (diagonal.min(axis=1) > 0) & (eigenvalues[:, 0] >= LEAST_EIGENVALUE * eigenvalues[:, -1])
    along = np.einsum("sik,si->sk", vectors, right * unit) / np.where(good[:, None], eigenvalues, 1.0)
    solution = unit * np.einsum("sik,sk->si", vectors, along)
    return [
        StationStart(solution[k, :3] * scale_mm + centre_mm, (solution[k, 3:4] - offset[k]) * scale_mm)
        if good[k]
        else None
        for k in range(len(moments))
    ]


def _residual(p: FloatArray, reading: FloatArray, member: NDArray[np.bool_], x: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(p - x[:3], axis=1) - member @ x[3:] - reading)


def _misfit(
    p: FloatArray, reading: FloatArray, member: NDArray[np.bool_], position: FloatArray, dead: FloatArray
) -> float:
    return float(np.median(np.abs(_residual(p, reading, member, np.concatenate([position, dead])))))


def _search(p: FloatArray, reading: FloatArray, member: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    from scipy.optimize import least_squares  # imported here: slow to load, and rarely needed

    best: tuple[float, FloatArray] | None = None

    def misfit(x: FloatArray) -> FloatArray:
        return _residual(p, reading, member, x)

    for direction in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3):
        for distance in (1.0, 3.0):
            start = direction * distance
            dead = np.linalg.norm(p - start, axis=1) - reading
            x0 = np.concatenate([start, member.T @ dead / member.sum(axis=0)])
            found = least_squares(misfit, x0, loss="soft_l1", f_scale=1e-3, max_nfev=60)
            if best is None or found.cost < best[0]:
                best = (float(found.cost), found.x)
    assert best is not None
    return best[1][:3], best[1][3:]
