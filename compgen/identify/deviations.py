"""Errors from positions measured against commanded ones (``*.deviations.csv``): the separation step on its own.

The rigid placement of the measured frame is unknown (six unknowns more), so that a file in the frame of any instrument
will do as long as its axes are those of the machine to a few degrees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.threads import one_thread
from compgen.errors import ConvergenceError, InputError, UndeterminedError
from compgen.identify.adjustment import Adjustment
from compgen.identify.effects import without_effects
from compgen.identify.free_pose import identify_with_free_pose, needs_free_pose
from compgen.identify.misfit import Series, labels_of, misfit_of
from compgen.identify.noise import IdentifyOptions
from compgen.identify.outliers import accepted_readings, rejected_components
from compgen.identify.parameters import ErrorParameters, common_tool, parameters_for_tools
from compgen.identify.rank import describe_rank
from compgen.identify.result import Identification, worst_uncertainty
from compgen.identify.separation import SeparationProblem
from compgen.identify.solver import Factor, Solution, factorise, solve
from compgen.identify.state import State
from compgen.identify.tables import error_table, metadata_of, unobservable
from compgen.identify.travel import check_travel

#: Standard uncertainty of a measured deviation when nothing states one; it is then scaled by the residuals.
ASSUMED_U_UM = 1.0
SUSPICIOUS_RCOND = 1e-10
#: Share of the components that may be rejected.
MOST_REJECTED = 0.3
MOST_ROUNDS = 20


def identify_deviations(
    machine: Machine, deviations: Deviations, options: IdentifyOptions | None = None
) -> Identification:
    """Identify the errors of a machine from measured positions.

    Parameters
    ----------
    machine : chain, nodes, reference point and which errors its model contains.
    deviations : measured minus commanded position; any of the three components.
    options : ``u_deviation_um`` and ``reject`` count.

    Raises
    ------
    InputError
        for positions outside the travel, or an uncertainty that is not above zero.
    UndeterminedError
        if the positions do not determine the errors; it names the combinations.
    ConvergenceError
        if no optimum is reached.
    """
    chosen = options or IdentifyOptions()
    check_travel(machine, deviations.position_mm, deviations.origin)
    with one_thread():
        deviations, effects = without_effects(machine, deviations)
        identified = identify_with_free_pose if needs_free_pose(deviations) else _identify
        found = identified(machine, deviations, chosen)
        return replace(found, corrections={**found.corrections, "effects": effects}) if effects else found


@dataclass(frozen=True)
class _Components:
    """The k measured components: which of the 3 n they are, and their standard uncertainty in mm, (k,)."""

    index: NDArray[np.int64]
    sigma_mm: FloatArray
    source: str


def _identify(machine: Machine, deviations: Deviations, options: IdentifyOptions) -> Identification:
    tool_mm = common_tool(machine, deviations.tool_mm)
    layout = parameters_for_tools(machine, tool_mm)
    components = _components(deviations, options)
    problem = _problem(layout, deviations, tool_mm, components)
    factor = _determined(problem)
    solution, accepted = _solve_robustly(problem, factor, components, reject=options.reject)
    return _result(problem, deviations, components, solution, accepted)


def _components(deviations: Deviations, options: IdentifyOptions) -> _Components:
    index = np.flatnonzero(np.isfinite(deviations.deviation_mm.ravel())).astype(np.int64)
    stated = options.u_deviation_um
    if stated is None and deviations.u_mm is not None:
        return _Components(index, deviations.u_mm.ravel()[index], "stated")
    if stated is None and "u_deviation_um" in deviations.metadata:
        text = deviations.metadata["u_deviation_um"]
        try:
            stated = float(text)
        except ValueError:
            file = deviations.origin[0][0] if deviations.origin else None
            raise InputError(f"the comment u_deviation_um = {text!r} is not a number", file=file) from None
    if stated is not None and not 0 < stated < np.inf:
        raise InputError(f"the uncertainty of a deviation is {stated:g} um; it must be above zero")
    u_um = ASSUMED_U_UM if stated is None else stated
    return _Components(index, np.full(len(index), u_um * MM_PER_UM), "assumed" if stated is None else "stated")


def _problem(
    layout: ErrorParameters, deviations: Deviations, tool_mm: FloatArray, components: _Components
) -> SeparationProblem:
    count = len(deviations)
    tools = np.broadcast_to(tool_mm, deviations.position_mm.shape)
    weight = np.zeros(3 * count)
    weight[components.index] = 1.0 / components.sigma_mm**2
    bases = tuple(layout.basis(axis, deviations.position_mm[:, axis]) for axis in range(3))
    return SeparationProblem(
        parameters=layout,
        bases=bases,  # type: ignore[arg-type]
        position_mm=deviations.position_mm,
        tool_mm=tools,
        measured_mm=deviations.position_mm + tools + np.nan_to_num(deviations.deviation_mm),
        information=weight.reshape(count, 3, 1) * np.eye(3),
        lever=np.zeros((count, 3, 0)),
        station_information=np.zeros((0, 0)),
    )


def _determined(problem: SeparationProblem) -> Factor:
    """Return the factor of the normal matrix at the start; UndeterminedError if it is singular."""
    matrix = problem.normal_matrix(problem.start)
    try:
        factor = factorise(matrix)
        if factor.rcond > SUSPICIOUS_RCOND:
            return factor
    except LinAlgError:
        pass
    rank = describe_rank(matrix, problem.unknown_names())
    if rank.rank < rank.size:
        raise UndeterminedError(
            f"the measured positions determine {rank.rank} of {rank.size} unknowns; "
            + "; ".join(rank.combinations[:8]),
            list(rank.combinations),
        )
    return factorise(matrix)


def _solve_robustly(
    problem: SeparationProblem, factor: Factor, components: _Components, *, reject: bool
) -> tuple[Solution, NDArray[np.bool_]]:
    """Solve, reject what lies beyond the robust limit, and repeat until the same components are kept."""
    accepted = np.ones(len(components.index), dtype=bool)
    solution = solve(problem, problem.start, factor)
    for _ in range(MOST_ROUNDS if reject else 0):
        residual = problem.residuals(solution.state)[components.index]
        keep = accepted_readings(residual / components.sigma_mm)
        if np.count_nonzero(~keep) > MOST_REJECTED * len(keep):
            raise ConvergenceError(
                f"{np.count_nonzero(~keep)} of {len(keep)} deviations do not fit the model; check the machine file's "
                "chain, the axis order, signs and units before anything is rejected"
            )
        if np.array_equal(keep, accepted):
            break
        accepted = keep
        weight = np.zeros(3 * len(problem.position_mm))
        weight[components.index] = accepted
        solution = solve(problem.weighted(weight), solution.state)
    return solution, accepted


def _result(
    problem: SeparationProblem,
    deviations: Deviations,
    components: _Components,
    solution: Solution,
    accepted: NDArray[np.bool_],
) -> Identification:
    layout = problem.parameters
    residual = problem.residuals(solution.state)[components.index]
    freedom = int(np.count_nonzero(accepted)) - problem.size
    if freedom < 1:
        raise UndeterminedError(f"{np.count_nonzero(accepted)} deviations for {problem.size} unknowns", [])
    chi_square = float(np.sum((residual / components.sigma_mm)[accepted] ** 2)) / freedom
    root = float(np.sqrt(chi_square))
    u_scale = root if components.source == "assumed" else max(1.0, root)
    factor = _of_the_errors(solution.factor, layout.size)
    adjustment = Adjustment(
        state=State(solution.state.errors, np.zeros((0, 3)), np.zeros(0)),
        factor=factor,
        weight=accepted / components.sigma_mm**2,
        group=np.zeros(0, dtype=np.int64),
        sigma_mm=u_scale,
    )
    errors = error_table(layout, solution.state.errors, adjustment.covariance_factor())
    errors = errors.replace(metadata=metadata_of(layout.machine, deviations.metadata))
    return Identification(
        errors=errors,
        stations=(),
        residual_mm=residual,
        accepted=accepted,
        rms_um=float(np.sqrt(np.mean(residual[accepted] ** 2))) / MM_PER_UM,
        degrees_of_freedom=freedom,
        reduced_chi_square=chi_square,
        u_source=components.source,
        u_length_um=float(np.median(components.sigma_mm)) / MM_PER_UM,
        u_length_um_per_m=0.0,
        u_scale=u_scale,
        unobservable=unobservable(layout),
        rejected=rejected_components(
            deviations, *np.divmod(components.index, 3), residual, components.sigma_mm, accepted
        ),
        rank=problem.size,
        unknowns=problem.size,
        condition=1.0 / solution.factor.rcond,
        iterations=solution.iterations,
        worst_u=worst_uncertainty(errors),
        layout=layout,
        adjustment=adjustment,
        method="deviations",
        misfit=misfit_of(
            chi_square, freedom, u_scale, components.source, lambda: _series(deviations, components, residual, accepted)
        ),
    )


def _series(
    deviations: Deviations, components: _Components, residual_mm: FloatArray, accepted: NDArray[np.bool_]
) -> Series:
    """Residuals of the components that were used, with what may explain them."""
    row, component = np.divmod(components.index[accepted], 3)
    labels = labels_of(deviations.labels, deviations.origin, deviations.position_mm)
    time = deviations.covariates.get("time_s")
    return Series(
        residual_um=residual_mm[accepted] / MM_PER_UM,
        bare_um=None,
        sigma_um=components.sigma_mm[accepted] / MM_PER_UM,
        group=component,
        labels={name: label[row] for name, label in labels.items()},
        time_s=None if time is None or not np.isfinite(time).all() else time[row],
    )


def _of_the_errors(factor: Factor, errors: int) -> Factor:
    """Factor of the normal matrix of the errors, the placement eliminated."""
    matrix, rest = factor.matrix[:errors, :errors], factor.matrix[errors:, :errors]
    reduced = matrix - rest.T @ np.linalg.solve(factor.matrix[errors:, errors:], rest)
    return factorise(0.5 * (reduced + reduced.T))
