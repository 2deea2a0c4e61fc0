"""Start values: stations in closed form, a first affine machine, and a start that is robust against gross errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.names import AXES
from compgen.errors import ConvergenceError, InputError, Message
from compgen.identification.adjust.grid_problem import GridProblem, LevelGrid, nominal_targets
from compgen.identification.adjust.solver import factorise
from compgen.identification.adjust.unknowns import IntArray, State

# Start values of the stations in closed form: from lengths to positions that may be metres away.


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
    set-up ``group`` (n,) = 0 ... groups - 1. If the points do not determine it (all in a plane or on a line) or the
    result does not explain the readings, a search from many directions replaces it.
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
    found = solution[: 3 + groups]
    if not kept.all() or np.median(np.abs(_residual(p, reading, member, found))) > 1e-2:
        found = _search(p, reading, member)
    return StationStart(found[:3] * scale + centre, found[3:] * scale)


def station_start_from_moments(
    moments: FloatArray, offset: FloatArray, centre_mm: FloatArray, scale_mm: float
) -> StationStart | None:
    """Locate one station from the moments of its set-ups (g, 6, 6) from :func:`start_moments`.

    None if they do not determine it.
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


def _search(p: FloatArray, reading: FloatArray, member: NDArray[np.bool_]) -> FloatArray:
    from scipy.optimize import least_squares  # imported here: slow to load, and rarely needed

    best: tuple[float, FloatArray] | None = None

    def misfit(x: FloatArray) -> FloatArray:
        return _residual(p, reading, member, x)

    def derivative(x: FloatArray) -> FloatArray:
        sight = p - x[:3]
        sight /= np.maximum(np.linalg.norm(sight, axis=1), 1e-12)[:, None]
        return np.hstack([-sight, -member.astype(np.float64)])

    for direction in np.stack(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3):
        for distance in (1.0, 3.0):
            start = direction * distance
            dead = np.linalg.norm(p - start, axis=1) - reading
            x0 = np.concatenate([start, member.T @ dead / member.sum(axis=0)])
            found = least_squares(misfit, x0, derivative, loss="soft_l1", f_scale=1e-3, max_nfev=60)
            # the two sides of a plane fit equally well: the first one is kept, whatever the rounding errors
            if best is None or found.cost < best[0] * (1.0 - 1e-6) - 1e-20:
                best = (float(found.cost), found.x)
    assert best is not None
    return best[1]


# Moments of the readings on a grid for the closed-form start of the stations.


def start_moments(grid: LevelGrid) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the moments for the closed-form start, in centred and scaled coordinates.

    With p = (target - centre)/scale and L = reading/scale - offset of the group: sums over the readings of each group
    of products of (2 p, 2 L, 1, |p|^2 - L^2).

    Returns
    -------
    moments (groups, 6, 6), offset (groups,), centre in mm (3,), scale in mm.
    """
    centre = np.array([levels.mean() for levels in grid.levels_mm]) + grid.tools[0].tool_mm
    scale = max(max(float(np.ptp(levels)) for levels in grid.levels_mm), 1.0)
    if grid.compiled:
        from compgen.identification.adjust.grid_kernels import add_sums, start_sums

        number, total, moments = np.zeros(grid.groups), np.zeros(grid.groups), np.zeros((grid.groups, 6, 6))
        for data in grid.tools:
            add_sums(data.weight, data.length_mm, number, total)
        offset = total / np.maximum(number, 1.0) / scale
        (out, mid, inner), axes = grid.order, np.array(grid.order)
        for data in grid.tools:
            along = [(levels + data.tool_mm[k] - centre[k]) / scale for k, levels in enumerate(grid.levels_mm)]
            plane = np.stack([np.repeat(along[mid], len(along[inner])), np.tile(along[inner], len(along[mid]))])
            for k in range(grid.groups):
                readings = data.weight[k], data.length_mm[k], scale, float(offset[k])
                start_sums(along[out], plane, axes, *readings, moments[k])
        moments += moments.swapaxes(1, 2).copy()  # each product was added once, on one side of the diagonal or on it
        moments[:, np.arange(6), np.arange(6)] *= 0.5
        return moments, offset, centre, scale
    readings = np.sum([np.sum(data.length_mm * (data.weight > 0), axis=(1, 2)) for data in grid.tools], axis=0)
    counts = np.sum([np.count_nonzero(data.weight, axis=(1, 2)) for data in grid.tools], axis=0)
    offset = readings / np.maximum(counts, 1) / scale
    moments = np.zeros((grid.groups, 6, 6))
    for data, target in zip(grid.tools, nominal_targets(grid), strict=True):
        p = (target - centre[:, None]) / scale
        columns = np.ones((6, p.shape[1]))
        columns[:3] = 2.0 * p
        square = np.einsum("km,km->m", p, p)
        for group in range(grid.groups):
            reading = data.length_mm[group].ravel() / scale - offset[group]
            columns[3] = 2.0 * reading
            columns[5] = square - reading**2
            present = (data.weight[group] > 0).ravel()
            moments[group] += (columns * present) @ columns.T
    return moments, offset, centre, scale


# A better start: the machine as an affine map (scales and squareness), stations and dead lengths, from a few readings.
#
# A squareness of milliradians moves the stations of the closed form by millimetres. If it is removed beforehand, the
# lines of sight of the first normal matrix are right, and its factor can be used until the end.


#: Number of cells of the grid used, spread over the volume.
SAMPLE = 150
#: One step is enough: the rest is below the effect of the curves, which the map does not contain.
STEPS = 1
#: Reciprocal condition below which the readings do not determine the affine map, and the start is left unchanged.
LEAST_RCOND = 1e-12


def affine_start(problem: GridProblem, start: State) -> State:
    """Return ``start`` with squareness, scales, stations and dead lengths improved; unchanged if that fails."""
    if len(problem.tools) != 1:
        return start
    data = problem.tools[0]
    target = nominal_targets(problem)[0]
    picked = _spread(target.shape[1])
    p = target[:, picked].T
    weight = data.weight.reshape(problem.groups, -1)[:, picked]
    reading = data.length_mm.reshape(problem.groups, -1)[:, picked]
    # displacement fields (n, 3, 6): scales of X, Y, Z, then EC0Y, EB0Z, EA0Z
    fields = np.zeros((len(p), 3, 6))
    for axis in range(3):
        fields[:, axis, axis] = p[:, axis]
    in_y = problem.parameters.machine.squareness_reference == "Y"
    fields[:, int(in_y), 3] = -p[:, 0 if in_y else 1]
    fields[:, 0, 4] = p[:, 2]
    fields[:, 1, 5] = -p[:, 2]
    affine, stations, dead = np.zeros(6), start.stations_mm.copy(), start.dead_length_mm.copy()
    for _ in range(STEPS):
        tip = p + fields @ affine
        sight = tip[None] - stations[problem.station_of][:, None]
        distance = np.linalg.norm(sight, axis=2)
        unit = sight / distance[:, :, None]
        residual = distance - dead[:, None] - reading
        step = _step(problem, fields, unit, residual, weight)
        if step is None or not np.isfinite(step).all():
            return start
        affine += step[:6]
        stations += step[6 : 6 + stations.size].reshape(-1, 3)
        dead += step[6 + stations.size :]
    return State(_errors(problem, affine), stations, dead)


def _spread(count: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.round(np.linspace(0, count - 1, min(count, SAMPLE))).astype(np.int64)


def _step(
    problem: GridProblem, fields: FloatArray, unit: FloatArray, residual: FloatArray, weight: FloatArray
) -> FloatArray | None:
    groups, count = residual.shape
    size = 6 + 3 * problem.stations + groups
    jacobian = np.zeros((groups, count, size))
    jacobian[:, :, :6] = np.einsum("gna,nak->gnk", unit, fields)
    for group, station in enumerate(problem.station_of.tolist()):
        jacobian[group, :, 6 + 3 * station : 9 + 3 * station] = -unit[group]
        jacobian[group, :, 6 + 3 * problem.stations + group] = -1.0
    root = np.sqrt(weight)[:, :, None]
    rows = (jacobian * root).reshape(-1, size)
    matrix = rows.T @ rows
    gradient = rows.T @ (residual[:, :, None] * root).ravel()
    try:
        factor = factorise(matrix)
    except LinAlgError:
        return None
    return None if factor.rcond < LEAST_RCOND else -factor.solve(gradient)


def _errors(problem: GridProblem, affine: FloatArray) -> FloatArray:
    """Store scales as slopes of EXX, EYY, EZZ, and squareness; skip what is not modelled."""
    parameters = problem.parameters
    errors = np.zeros(parameters.size)
    for curve in parameters.curves:
        axis = curve.error.axis
        if curve.error.name == f"E{AXES[axis]}{AXES[axis]}":
            reference = parameters.machine.reference_point_mm[axis]
            if parameters.machine.curves == "linear" and np.count_nonzero(curve.free) == curve.free.shape[1]:
                errors[curve.columns] = affine[axis] * (curve.nodes_mm - reference) @ curve.free  # picks free nodes
                continue
            line = affine[axis] * (problem.levels_mm[axis] - reference)
            reduced = problem.bases[axis] @ curve.free
            errors[curve.columns] = np.linalg.lstsq(reduced, line, rcond=1e-9)[0]
    first = parameters.size - len(parameters.squareness)
    for k, name in enumerate(parameters.squareness):
        errors[first + k] = affine[3 + ("EC0Y", "EB0Z", "EA0Z").index(name)]
    return errors


# Start values of the stations robust against gross errors: a low quantile of the residuals, then a robust refinement.
#
# Rousseeuw (1984), Least Median of Squares Regression: the closed form above is solved for many small random subsets of
# a station's readings; the one whose residuals have the smallest quantile contains no bad reading.


#: A station is examined again if a residual at its start exceeds this many robust standard deviations ...
START_LIMIT = 6.0
#: ... or if their robust standard deviation is larger than this; errors of a machine are mostly below.
ORDINARY_MM = 0.5
#: Beyond this share of the extent of the targets the readings cannot be those of one station at these points.
GROSS_SHARE = 0.01
TRIALS = 200
#: Number of readings that judge a trial.
JUDGES = 400
#: A station is never further away than this multiple of the extent of its targets.
FARTHEST = 100.0
#: Factors between readings and displacements in millimetres due to a mistake.
SLIPS = {
    1000.0: "if they are read as metres; the unit is mm: convert them",
    0.001: "if they are read as micrometres; the unit is mm: convert them",
    25.4: "if they are read as inches; the unit is mm: convert them",
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

    Less than the median, so that half of the readings may be off by a beam break.
    """
    return 1.907 * float(np.quantile(np.abs(values), 0.4))


def robust_state(
    start: State, lengths: Lengths, target_mm: FloatArray, station: IntArray, group: IntArray
) -> tuple[State, bool]:
    """Return start values that gross errors do not affect, and whether there are gross errors.

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
        if the readings of a station fit no position, or those of all stations fit none.
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
        residual = part.part(_sample(len(rows), 2000)).residuals(first)
        spread = robust_spread(residual)
        if spread < ORDINARY_MM and np.abs(residual).max() <= START_LIMIT * max(spread, 1e-9):
            continue  # plausible
        better = _robust(part, first)
        stations[k], dead[own] = better.position_mm, better.dead_length_mm
        misfit_mm[k], parts[k] = robust_spread(part.residuals(better)), part
        found_any = True
    gross_mm = GROSS_SHARE * max(float(np.ptp(target_mm, axis=0).max()), 1.0)
    bad = np.flatnonzero(misfit_mm > gross_mm)
    if bad.size:
        raise _no_place(lengths, bad.tolist(), misfit_mm, parts, station)
    return replace(start, stations_mm=stations, dead_length_mm=dead), found_any


def _sample(count: int, most: int) -> IntArray:
    """Return rows spread over all, at most ``most``, at random distances so that no period of the data is aliased."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False))


def _robust(part: _Station, first: StationStart) -> StationStart:
    """Return the refined best of random subsets of all readings and of consecutive parts, and the given start."""
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
    """The linear equations of :func:`station_start` for a few readings; None if they determine nothing."""
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
    """Return the error for stations whose readings fit no position, with the likely cause."""
    worst = max(bad, key=lambda k: misfit_mm[k])
    for k in sorted(bad, key=lambda k: -misfit_mm[k]):
        slip = _slip(parts[k], float(misfit_mm[k]))
        if slip:
            row = int(np.flatnonzero(station == k)[0])
            file, line = lengths.origin[row] if lengths.origin else (None, None)
            return InputError(
                Message(
                    "station-slip",
                    "the readings of station {stations!r} fit {slip}",
                    stations=lengths.stations[k],
                    slip=slip,
                ),
                file=file,
                line=line,
                field="column length_mm",
            )
    names = ", ".join(lengths.stations[k] for k in bad)
    if len(bad) > 1 and len(bad) > len(lengths.stations) / 2:
        return ConvergenceError(
            Message(
                "lengths-without-positions",
                "the lengths do not fit the commanded positions: the readings of {bad} of {stations} "
                "stations ({names}) fit no position, the worst {stations2!r} with {misfit_mm:.3g} "
                "mm; check axis order, signs and unit of x_mm, y_mm, z_mm, and the station labels",
                bad=len(bad),
                stations=len(lengths.stations),
                names=names,
                stations2=lengths.stations[worst],
                misfit_mm=misfit_mm[worst],
            )
        )
    return ConvergenceError(
        Message(
            "station-without-position",
            "the readings of station {stations!r} fit no position: their misfit is "
            "{misfit_mm:.3g} mm; check its unit, and whether readings of another station or of "
            "other points are labelled with its name",
            stations=lengths.stations[worst],
            misfit_mm=misfit_mm[worst],
        )
    )


def _slip(part: _Station, misfit_mm: float) -> str:
    """Return which mistake in unit or sign explains the readings of a station; empty if none does."""
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
