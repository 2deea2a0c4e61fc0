"""The shortest re-check: the fewest points at which a requested change of one error is detected with a given power.

The readings are J (e + s p) + N n + noise: errors e as last identified, a change of size s and shape p, and nuisance
parameters n (station positions and dead lengths, found anew each time). With the covariance of e from the last
calibration as prior, the information I on s is what remains of p' J' W J p once e and n are eliminated (Schur
complement of the normal matrix, which ``compgen.plan`` sets up and which is a sum over points). The two-sided test at
error probability alpha detects s with power Phi(s sqrt(I) - z) + Phi(-s sqrt(I) - z), z the 1 - alpha / 2 quantile. The
other errors are taken as unchanged within that covariance.

Points are added greedily from a lattice over the volume, the one that raises the information most first; then every
point that the power does not need is dropped again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

from compgen.data.csv_files import FloatArray, format_csv
from compgen.data.files import OutputFolder
from compgen.data.lengths import POSITION_COLUMNS, Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, SQUARENESS_NAMES, error_named
from compgen.errors import InputError
from compgen.fleet.records import RequestedChange
from compgen.identification.adjust.unknowns import ErrorParameters
from compgen.identification.covariance import Covariance, error_values
from compgen.identification.options import IdentifyOptions
from compgen.kinematics.many_points import full_grid
from compgen.planning import PlannedStations, planned, planned_noise

#: Levels of the lattice of candidate points on each axis.
LEVELS = 4
#: Largest number of points of a re-check; if more are needed, a full calibration is better.
MOST_POINTS = 40
#: Scaled nuisance parameters with eigenvalues below this fraction have no data.
NO_DATA = 1e-10


@dataclass(frozen=True)
class Recheck:
    """Points (n, 3) in mm, the most useful first, and what they show.

    ``u`` is the standard uncertainty of the change, mm or rad; ``smallest`` the smallest change that is detected with
    the requested power.
    """

    request: RequestedChange
    position_mm: FloatArray
    readings: int
    u: float
    power: float
    smallest: float

    def summary(self) -> dict[str, Any]:
        """Return the figures in um or urad."""
        name = error_named(self.request.error)
        scale = 1.0 / name.si_per_unit
        return {
            "error": name.name,
            "unit": name.unit,
            "change": self.request.size * scale,
            "confidence": self.request.confidence,
            "wanted_power": self.request.power,
            "power": self.power,
            "u": self.u * scale,
            "smallest": self.smallest * scale,
            "points": len(self.position_mm),
            "readings": self.readings,
            "position_mm": self.position_mm.tolist(),
        }


def power_of(size: float, u: float, confidence: float) -> float:
    """Power of the two-sided test for a change of ``size`` measured with standard uncertainty ``u``."""
    z = norm.ppf(0.5 + 0.5 * confidence)
    return float(norm.cdf(size / u - z) + norm.cdf(-size / u - z))


def shortest_recheck(
    machine: Machine,
    stations: PlannedStations,
    request: RequestedChange,
    covariance: Covariance | None = None,
    options: IdentifyOptions | None = None,
) -> Recheck:
    """Find as few points as possible at which ``stations`` detect the requested change.

    Parameters
    ----------
    machine : chain, nodes, and which errors its model contains.
    stations : as for :func:`compgen.planning.prediction`; a station reads every point once per pass.
    request : error, size of its change, power and confidence.
    covariance : of the errors of the last calibration; None takes them as exactly known.
    options : standard uncertainty of a reading.

    Raises
    ------
    InputError
        for an error that is not in the model, an impossible request, or one that 40 points do not meet.
    """
    _check(request)
    levels = [np.linspace(*axis.range_mm, LEVELS) for axis in machine.axes]
    candidates = full_grid(levels).reshape(-1, 3)
    each = [planned(machine, stations, Points(place[None]), planned_noise(options)) for place in candidates]
    matrices = np.array([item.normal_matrix(stations.position_mm) for item in each])  # of each candidate alone
    layout = each[0].problem.parameters
    shape = _shape(layout, request.error)
    prior = None if covariance is None else _prior(layout, covariance)

    def information(chosen: Sequence[int]) -> float:
        return _information(matrices[list(chosen)].sum(axis=0), shape, prior, layout.size)

    def reached(chosen: Sequence[int]) -> bool:
        found = information(chosen)
        return found > 0.0 and power_of(request.size, found**-0.5, request.confidence) >= request.power

    chosen = _greedy(len(candidates), information, reached, request)
    for k in reversed(chosen.copy()):  # drop points that the power does not need, the latest first
        fewer = [each for each in chosen if each != k]
        if fewer and reached(fewer):
            chosen = fewer
    u = information(chosen) ** -0.5
    return Recheck(
        request=request,
        position_mm=candidates[chosen],
        readings=len(chosen) * len(stations.passes),
        u=u,
        power=power_of(request.size, u, request.confidence),
        smallest=float(u * (norm.ppf(0.5 + 0.5 * request.confidence) + norm.ppf(request.power))),
    )


def _check(request: RequestedChange) -> None:
    if request.size <= 0.0:
        raise InputError(f"a change of {request.size:g} cannot be detected; give a positive one")
    if not 0.0 < request.confidence < 1.0 or not 1.0 - request.confidence < request.power < 1.0:
        raise InputError(
            f"power {request.power:g} at confidence {request.confidence:g} is not a test; give both between 0 and 1, and the "
            "power above 1 - confidence"
        )


def _shape(layout: ErrorParameters, name: str) -> FloatArray:
    """Change of the unknowns (errors,) with the requested shape and size 1, up to the gauge of the layout."""
    known = next((item for item in error_values(layout) if item[0] == name), None)
    if known is None:
        raise InputError(f"{name!r} is not in the model of machine {layout.machine.name!r}; choose one that is")
    _, position_mm, columns, matrix = known
    shape = np.zeros(layout.size)
    if name in SQUARENESS_NAMES:
        shape[columns] = 1.0
        return shape
    share = np.interp(position_mm, (position_mm[0], position_mm[-1]), (0.0, 1.0))
    bowed = error_named(name).is_straightness
    target = 4.0 * share * (1.0 - share) if bowed else share
    free = [np.ones_like(share), *([share] if bowed else [])]  # gauge: constants, and slopes of straightness
    solution = np.linalg.lstsq(np.column_stack([matrix, *free]), target, rcond=None)[0]
    shape[columns] = solution[: matrix.shape[1]]
    return shape


def _prior(layout: ErrorParameters, covariance: Covariance) -> FloatArray:
    """Factor F (errors, r) of the covariance of the unknown errors after the last calibration."""
    names, rows, maps = np.array(covariance.error), [], []
    for name, position_mm, columns, matrix in error_values(layout):
        found = np.flatnonzero(names == name)
        if len(found) != len(position_mm):
            where = "" if name in SQUARENESS_NAMES else f" on the nodes of {AXES[error_named(name).axis]}"
            raise InputError(f"the last calibration does not contain {name}{where} of the machine file; measure again")
        rows.append(found)
        spread = np.zeros((len(found), layout.size))
        spread[:, columns] = matrix
        maps.append(spread)
    factor = np.linalg.pinv(np.vstack(maps)) @ covariance.errors_factor[np.concatenate(rows)]
    left, sizes, _ = np.linalg.svd(factor, full_matrices=False)
    return np.asarray(left * sizes)


def _information(matrix: FloatArray, shape: FloatArray, prior: FloatArray | None, errors: int) -> float:
    """Information on the size of the change with everything else eliminated, 1/mm^2 or 1/rad^2."""
    column = matrix[:, :errors] @ shape
    own = float(shape @ column[:errors])
    if prior is None:
        rest, mixed = matrix[errors:, errors:], column[errors:]
    else:
        # errors are F z with z of unit covariance: exactly known errors need no infinite information
        map_ = np.zeros((len(matrix), prior.shape[1] + len(matrix) - errors))
        map_[:errors, : prior.shape[1]] = prior
        map_[errors:, prior.shape[1] :] = np.eye(len(matrix) - errors)
        rest, mixed = map_.T @ matrix @ map_, map_.T @ column
        rest[range(prior.shape[1]), range(prior.shape[1])] += 1.0
    diagonal = np.diag(rest)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(rest * scale * scale[:, None])
    kept = values > NO_DATA * values[-1]
    part = vectors[:, kept].T @ (scale * mixed)
    left = own - float(part @ (part / values[kept]))
    return left if left > 1e-9 * own else 0.0


def _greedy(
    count: int,
    information: Callable[[Sequence[int]], float],
    reached: Callable[[Sequence[int]], bool],
    request: RequestedChange,
) -> list[int]:
    """Start with the corners and add the best candidate until the power is reached."""
    ends = (0, LEVELS - 1)  # new stations are poorly located without the corners
    chosen = [(x * LEVELS + y) * LEVELS + z for x in ends for y in ends for z in ends]
    while not reached(chosen):
        if len(chosen) >= min(MOST_POINTS, count):
            best = information(chosen)
            seen = f"{power_of(request.size, best**-0.5, request.confidence):.2f}" if best > 0.0 else "none"
            raise InputError(
                f"{len(chosen)} points do not show this change of {request.error} with power {request.power:g} (they reach "
                f"{seen}); ask for a larger change, use more stations, or measure again"
            )
        rest = [k for k in range(count) if k not in chosen]
        chosen.append(max(rest, key=lambda k: information([*chosen, k])))
    return chosen


def format_recheck_points(recheck: Recheck) -> str:
    """Return the points as the text of a points file."""
    columns = {name: recheck.position_mm[:, k] for k, name in enumerate(POSITION_COLUMNS)}
    return format_csv(columns, {"source": "compgen recal recheck"}, dict.fromkeys(POSITION_COLUMNS, 3))


def write_recheck_points(path: Path, recheck: Recheck) -> Path:
    """Write the points as a points file, atomically."""
    folder = OutputFolder(path.parent)
    folder.add(path.name, format_recheck_points(recheck))
    return next(iter(folder.commit().values()))
