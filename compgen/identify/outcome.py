"""From the optimum to what the user gets: curves, stations, uncertainties, and what was rejected."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.errors import UndeterminedError
from compgen.identify.adjustment import Adjustment
from compgen.identify.known_stations import HeldStations
from compgen.identify.noise import ReadingNoise
from compgen.identify.outliers import explain_rejected
from compgen.identify.rank import Rank
from compgen.identify.result import Identification, StationResult, worst_uncertainty
from compgen.identify.robust import RobustFit
from compgen.identify.tables import error_table, metadata_of, unobservable
from compgen.identify.task import AnyProblem, Task


def assemble(
    task: Task,
    fit: RobustFit[AnyProblem],
    sigma_mm: FloatArray,
    noise: ReadingNoise,
    rank: Rank | None,
) -> Identification:
    """Return what the user gets of a finished adjustment.

    Parameters
    ----------
    task : the readings and their problem.
    fit : the optimum, which readings were used, and the residuals.
    sigma_mm : standard uncertainty of each reading, (n,).
    noise : where that comes from.
    rank : the detailed look at the rank, if it was taken.

    Raises
    ------
    UndeterminedError
        if fewer readings than unknowns are left.
    """
    problem, layout = task.problem, task.problem.parameters
    solution, accepted, residual = fit.solution, fit.accepted, fit.residual_mm
    held = problem if isinstance(problem, HeldStations) else None
    freedom = int(np.count_nonzero(accepted)) - problem.size + (held.observations if held else 0)
    if freedom < 1:
        raise UndeterminedError(f"{np.count_nonzero(accepted)} readings for {problem.size} unknowns", [])
    everything = bool(accepted.all())
    used = residual if everything else residual[accepted]
    standardised = used / (sigma_mm if everything else sigma_mm[accepted])
    square_sum = float(standardised @ standardised)
    square_sum += held.square_sum(solution.state) / float(sigma_mm.min()) ** 2 if held else 0.0
    chi_square = square_sum / freedom
    u_scale = float(np.sqrt(chi_square)) if noise.source == "assumed" else max(1.0, float(np.sqrt(chi_square)))
    least = float(sigma_mm.min())
    adjustment = Adjustment(
        state=solution.state,
        factor=solution.factor,
        weight=(least / sigma_mm) ** 2 * accepted,
        group=task.group,
        sigma_mm=least * u_scale,
        held_weight=held.held_weight if held else None,
    )
    errors = error_table(layout, solution.state.errors, adjustment.covariance_factor()[: layout.size])
    errors = errors.replace(metadata=metadata_of(task.machine, task.lengths.metadata))
    rejected = np.flatnonzero(~accepted)
    return Identification(
        errors=errors,
        stations=_stations(task, adjustment, residual, accepted),
        residual_mm=residual,
        accepted=accepted,
        rms_um=float(np.sqrt(used @ used / len(used))) / MM_PER_UM,
        degrees_of_freedom=freedom,
        reduced_chi_square=chi_square,
        u_source=noise.source,
        u_length_um=noise.constant_um,
        u_length_um_per_m=noise.proportional_um_per_m,
        u_scale=u_scale,
        unobservable=unobservable(layout),
        rejected=explain_rejected(
            task.lengths, layout, solution.state, task.group, rejected, residual, sigma_mm, fit.segments
        ),
        segments=fit.segments,
        rank=problem.size if rank is None else problem.size - (rank.size - rank.rank),
        unknowns=problem.size,
        condition=1.0 / solution.factor.rcond,
        iterations=solution.iterations,
        worst_u=worst_uncertainty(errors),
        layout=layout,
        adjustment=adjustment,
    )


def _stations(
    task: Task, adjustment: Adjustment, residual: FloatArray, accepted: NDArray[np.bool_]
) -> tuple[StationResult, ...]:
    state, factor = adjustment.state, adjustment.covariance_factor()
    u = np.sqrt(np.einsum("ij,ij->i", factor, factor))
    first = task.problem.parameters.size
    second = first + state.stations_mm.size
    groups = len(state.dead_length_mm)
    everything = bool(accepted.all())
    used = np.bincount(task.group, None if everything else accepted, groups)
    squares = np.bincount(task.group, residual**2 if everything else residual**2 * accepted, groups)
    setups = task.lengths.labels.get("setup", np.zeros(len(task.lengths), dtype=np.int64))
    row_of = np.zeros(groups, dtype=np.int64)
    row_of[task.group] = np.arange(len(task.group))
    results: list[StationResult] = []
    for group in range(groups):
        k = int(task.station[row_of[group]])
        x, y, z = state.stations_mm[k].tolist()
        u_x, u_y, u_z = u[first + 3 * k : first + 3 * k + 3].tolist()
        results.append(
            StationResult(
                station=task.lengths.stations[k],
                setup=int(setups[row_of[group]]),
                position_mm=(x, y, z),
                u_position_mm=(u_x, u_y, u_z),
                dead_length_mm=float(state.dead_length_mm[group]),
                u_dead_length_mm=float(u[second + group]),
                readings=int(used[group]),
                rms_um=float(np.sqrt(squares[group] / max(used[group], 1.0))) / MM_PER_UM,
                segment=sum((r.station, r.setup) == (task.lengths.stations[k], setups[row_of[group]]) for r in results),
            )
        )
    return tuple(results)
