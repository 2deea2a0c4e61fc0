"""Whether the readings determine the unknowns, before anything is adjusted; and what is said where they do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import LinAlgError

from compgen.errors import ConvergenceError, UndeterminedError
from compgen.identify.rank import Rank, analyse_rank
from compgen.identify.solver import Factor, factorise, solve
from compgen.identify.state import State
from compgen.identify.task import AnyProblem, Task

#: Reciprocal condition of the scaled normal matrix below which the rank is looked at in detail.
SUSPICIOUS_RCOND = 1e-10
#: Eigenvalue of the scaled normal matrix below which a combination is named when nothing converges.
HARDLY_DETERMINED = 1e-6


def determined(task: Task, start: State) -> tuple[Factor, Rank | None]:
    """Return the factor of the normal matrix at the start; UndeterminedError if it is singular.

    The detailed look at the rank is taken only where the condition gives reason.
    """
    matrix = task.problem.normal_matrix(start)
    try:
        factor = factorise(matrix)
        if factor.rcond > SUSPICIOUS_RCOND:
            return factor, None
    except LinAlgError:
        pass
    rank = analyse_rank(task.problem, matrix, task.lengths.stations, task.station, task.group)
    if rank.rank < rank.size:
        raise UndeterminedError(
            f"the readings determine {rank.rank} of {rank.size} unknowns; " + "; ".join(rank.combinations[:8]),
            list(rank.combinations),
        )
    return factorise(matrix), rank


def unmirrored(task: Task, start: State, searched: Sequence[int]) -> State:
    """Choose the side for stations whose targets all lie in a plane: its mirror image explains the readings as well.

    Only the machine's errors, seen from the other stations, tell the two apart; so both are tried.
    """
    for k in searched:
        targets = task.target_mm[task.station == k]
        centre = targets.mean(axis=0)
        _, spread, directions = np.linalg.svd(np.cov((targets - centre).T))
        if spread[2] > 1e-6 * spread[0]:
            continue
        across = directions[2]
        mirrored = start.stations_mm.copy()
        mirrored[k] -= 2.0 * across * float(across @ (mirrored[k] - centre))
        other = State(start.errors, mirrored, start.dead_length_mm)
        if _cost_from(task.problem, other) < _cost_from(task.problem, start):
            start = other
    return start


def _cost_from(problem: AnyProblem, start: State) -> float:
    try:
        return solve(problem, start).cost
    except ConvergenceError:
        return np.inf


def weakness(task: Task, factor: Factor) -> str:
    """Say which combinations are hardly determined, where that may be why nothing converged."""
    rank = analyse_rank(task.problem, factor.matrix, task.lengths.stations, task.station, task.group, HARDLY_DETERMINED)
    if rank.rank == rank.size:
        return ""
    return (
        f"; hardly determined even at the start: {'; '.join(rank.combinations[:3])}; stations must not stand on a line, "
        "nor in a plane with an end of the travel"
    )
