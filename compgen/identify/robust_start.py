"""Start values of the stations in spite of gross errors: a low quantile of the residuals, then a robust refinement.

Rousseeuw (1984), Least Median of Squares Regression: the closed form of ``start.py`` is solved for many small random
subsets of a station's readings; the one whose residuals have the smallest quantile has met no bad reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.errors import ConvergenceError, InputError
from compgen.identify.start import StationStart
from compgen.identify.state import IntArray, State

#: A station is looked at again when a residual at its start exceeds this many robust standard deviations ...
START_LIMIT = 6.0
#: ... or when their robust standard deviation is larger than this; errors of a machine are mostly below.
ORDINARY_MM = 0.5
#: Beyond this share of the extent of the targets the readings cannot be those of one station at these points.
GROSS_SHARE = 0.01
TRIALS = 200
#: At most so many readings judge a trial.
JUDGES = 400
#: A station is never further away than so many times the extent of its targets.
FARTHEST = 100.0
#: Factors that a slip leaves between readings and displacements in millimetres.
SLIPS = {
    1000.0: "when they are taken as metres; the unit is mm: convert them",
    0.001: "when they are taken as micrometres; the unit is mm: convert them",
    25.4: "when they are taken as inches; the unit is mm: convert them",
    -1.0: "with the opposite sign; a reading grows with the distance: reverse the sign",
}


@dataclass(frozen=True)
class _Station:
    """Targets (n, 3), readings (n,) and set-up 0 ... g-1 (n,) of one station."""

    target_mm: FloatArray
    length_mm: FloatArray
    member: IntArray

    def residuals(self, start: StationStart) -> FloatArray:
        distance = np.linalg.norm(self.target_mm - start.position_mm, axis=1)
        return np.asarray(distance - start.dead_length_mm[self.member] - self.length_mm)

    def part(self, rows: IntArray) -> _Station:
        return _Station(self.target_mm[rows], self.length_mm[rows], self.member[rows])


def robust_spread(values: FloatArray) -> float:
    """Return 1.907 times the 40 % quantile of the absolute values: the standard deviation of normal ones about zero.

    Less than the median, so that one half of the readings may be off by a beam break.
    """
    return 1.907 * float(np.quantile(np.abs(values), 0.4))


def robust_state(
    start: State, lengths: Lengths, target_mm: FloatArray, station: IntArray, group: IntArray
) -> tuple[State, bool]:
    """Return start values that gross errors do not move, and whether there are any gross errors.

    Parameters
    ----------
    start : closed-form start of all stations.
    lengths : names, readings and origin.
    target_mm, station, group : nominal target (n, 3), station and dead length (n,) of every reading.

    Raises
    ------
    InputError
        if the readings of a station fit after a change of unit or sign.
    ConvergenceError
        if the readings of a station fit no place, or those of all stations fit none.
    """
    stations, dead = start.stations_mm.copy(), start.dead_length_mm.copy()
    misfit_mm = np.zeros(len(stations))
    found_any = False
    parts = {}
    for k in range(len(stations)):
        rows = np.flatnonzero(station == k)
        own, member = np.unique(group[rows], return_inverse=True)
        part = _Station(target_mm[rows], lengths.length_mm[rows], member.ravel().astype(np.int64))
        first = StationStart(stations[k], dead[own])
        if _looks_sound(part, first):
            continue
        better = _robust(part, first)
        stations[k], dead[own] = better.position_mm, better.dead_length_mm
        misfit_mm[k], parts[k] = robust_spread(part.residuals(better)), part
        found_any = True
    gross_mm = GROSS_SHARE * max(float(np.ptp(target_mm, axis=0).max()), 1.0)
    bad = np.flatnonzero(misfit_mm > gross_mm)
    if bad.size:
        raise _no_place(lengths, bad.tolist(), misfit_mm, parts, station)
    return replace(start, stations_mm=stations, dead_length_mm=dead), found_any


def _looks_sound(part: _Station, start: StationStart) -> bool:
    rows = _sample(len(part.length_mm), 2000)
    residual = part.part(rows).residuals(start)
    spread = robust_spread(residual)
    return bool(spread < ORDINARY_MM and np.abs(residual).max() <= START_LIMIT * max(spread, 1e-9))


def _sample(count: int, most: int) -> IntArray:
    """Rows spread over all, at most ``most``, at random distances so that no period of the data is met."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _robust(part: _Station, first: StationStart) -> StationStart:
    """Best of random subsets, of all readings and of parts that follow each other, and the given start; refined."""
    groups = len(first.dead_length_mm)
    rng = np.random.default_rng(1)
    judges = part.part(_sample(len(part.length_mm), JUDGES))
    best, score = first, robust_spread(judges.residuals(first))
    count = len(part.length_mm)
    size = min(3 + 2 * groups + 4, count)
    for trial in range(TRIALS):
        window = count if trial % 2 else max(size, int(count * rng.uniform(0.1, 0.4)))  # no beam break within a part
        first_row = int(rng.integers(0, count - window + 1))
        rows = first_row + rng.choice(window, size, replace=False)
        candidate = _closed_form(part.part(rows), groups)
        if candidate is not None and (spread := robust_spread(judges.residuals(candidate))) < score:
            best, score = candidate, spread
    return _refined(part, best)


def _closed_form(part: _Station, groups: int) -> StationStart | None:
    """The linear equations of ``start.station_start`` for a few readings; None where they determine nothing."""
    centre = part.target_mm.mean(axis=0)
    p = part.target_mm - centre
    scale = max(float(np.abs(p).max()), 1.0)
    p, reading = p / scale, part.length_mm / scale
    member = (part.member[:, None] == np.arange(groups)).astype(np.float64)
    if not member.any(axis=0).all():
        return None
    columns = np.column_stack([2 * p, 2 * reading[:, None] * member, member])
    target = np.einsum("ij,ij->i", p, p) - reading**2
    solution, _, rank, _ = np.linalg.lstsq(columns, target, rcond=1e-10)
    if rank < columns.shape[1]:
        return None
    return StationStart(solution[:3] * scale + centre, solution[3 : 3 + groups] * scale)


def _refined(part: _Station, start: StationStart) -> StationStart:
    """Gauss-Newton on the distances with Tukey's weights (zero beyond ``START_LIMIT`` robust deviations)."""
    groups = len(start.dead_length_mm)
    member = (part.member[:, None] == np.arange(groups)).astype(np.float64)
    score = robust_spread(part.residuals(start))
    for _ in range(20):
        residual = part.residuals(start)
        ratio = residual / (START_LIMIT * max(robust_spread(residual), 1e-9))
        weight = np.clip(1.0 - ratio**2, 0.0, None)
        sight = part.target_mm - start.position_mm
        unit = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        design = np.hstack([-unit, -member]) * weight[:, None]
        step = np.linalg.lstsq(design, -weight * residual, rcond=1e-9)[0]
        moved = StationStart(start.position_mm + step[:3], start.dead_length_mm + step[3:])
        new = robust_spread(part.residuals(moved))
        if not new < 1.5 * score:
            break
        start, score = moved, new
        if np.abs(step).max() < 1e-4:
            break
    return start


def _no_place(
    lengths: Lengths, bad: Sequence[int], misfit_mm: FloatArray, parts: dict[int, _Station], station: IntArray
) -> InputError | ConvergenceError:
    """Return the error for stations whose readings fit no place, with the likely cause."""
    worst = max(bad, key=lambda k: misfit_mm[k])
    for k in sorted(bad, key=lambda k: -misfit_mm[k]):
        slip = _slip(parts[k], float(misfit_mm[k]))
        if slip:
            row = int(np.flatnonzero(station == k)[0])
            file, line = lengths.origin[row] if lengths.origin else (None, None)
            return InputError(
                f"the readings of station {lengths.stations[k]!r} fit {slip}",
                file=file,
                line=line,
                field="column length_mm",
            )
    names = ", ".join(lengths.stations[k] for k in bad)
    if len(bad) > 1 and len(bad) > len(lengths.stations) / 2:
        return ConvergenceError(
            f"the lengths do not fit the commanded positions: the readings of {len(bad)} of {len(lengths.stations)} "
            f"stations ({names}) fit no place, the worst {lengths.stations[worst]!r} with {misfit_mm[worst]:.3g} mm; "
            "check axis order, signs and unit of x_mm, y_mm, z_mm, and the station labels"
        )
    return ConvergenceError(
        f"the readings of station {lengths.stations[worst]!r} fit no place: their misfit is "
        f"{misfit_mm[worst]:.3g} mm; check its unit, and whether readings of another station or of other points "
        "stand under its name"
    )


def _slip(part: _Station, misfit_mm: float) -> str:
    """Say which slip of unit or sign explains the readings of a station; empty if none does."""
    extent_mm = float(np.ptp(part.target_mm, axis=0).max())
    groups = int(part.member.max()) + 1
    best, found = 0.02 * misfit_mm, ""
    for factor, slip in SLIPS.items():
        scaled = replace(part, length_mm=part.length_mm * factor)
        start = _robust(scaled, StationStart(part.target_mm.mean(axis=0), np.zeros(groups)))
        near = np.linalg.norm(start.position_mm - part.target_mm[0]) < FARTHEST * extent_mm
        spread = robust_spread(scaled.residuals(start))
        if near and spread < best:
            best, found = spread, slip
    return found
