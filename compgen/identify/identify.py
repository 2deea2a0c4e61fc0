"""Joint identification of error curves, squareness, stations and dead lengths from tracer lengths.

Zha & Zhang 2024, section 5 (eq. 22-28), with the exact machine model in place of C P and the constraints of
``docs/conventions.md`` by elimination.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Literal

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.threads import one_thread
from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.identify.affine_start import affine_start
from compgen.identify.covariance import with_systematic
from compgen.identify.determined import determined, unmirrored, weakness
from compgen.identify.grid_problem import GridProblem
from compgen.identify.known_stations import HeldStations, KnownStations, hold, locate_stations, with_known_start
from compgen.identify.located import TracerReadings
from compgen.identify.misfit import EXPLAINS, Cause, drift_of_repeats, labels_of, split_labels
from compgen.identify.noise import IdentifyOptions, ReadingNoise, reading_noise
from compgen.identify.outcome import assemble
from compgen.identify.outliers import belonging
from compgen.identify.parameters import ErrorParameters
from compgen.identify.reference import identify_at_reference
from compgen.identify.result import Identification
from compgen.identify.robust import Readings, RobustFit, fit_robustly
from compgen.identify.robust_start import robust_state
from compgen.identify.solver import Factor, solve
from compgen.identify.state import IntArray, State
from compgen.identify.task import AnyProblem, Task, check_readings, problem_of, start_values, task_of, with_weights
from compgen.identify.two_step import solve_in_two_steps

MIN_STATIONS = 3


def identify(machine: Machine, lengths: Lengths, options: IdentifyOptions | None = None) -> Identification:
    """Identify the errors of a machine, the stations and the dead lengths from tracer lengths.

    Parameters
    ----------
    machine : chain, nodes, reference point and which errors its model contains.
    lengths : readings of three or more stations (one tracer at three or more places counts as so many).
    options : uncertainty of the readings and of inputs that they share, rejection.

    Raises
    ------
    InputError
        for fewer than three stations, or positions outside the travel.
    UndeterminedError
        if the readings do not determine the unknowns; it names the combinations.
    ConvergenceError
        if no optimum is reached.
    """
    chosen = options or IdentifyOptions()
    with one_thread():
        try:
            found = _at_reference(machine, lengths, chosen)
        except ConvergenceError as error:
            raise ConvergenceError(f"{error}{_explained(machine, lengths, chosen)}") from error
        return with_systematic(machine, lengths, _with_causes(machine, lengths, chosen, found), chosen.systematic)


def _at_reference(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> Identification:
    return identify_at_reference(
        machine,
        lengths,
        lambda readings: _identify(machine, readings, options),
        lambda readings: _rough(machine, readings),
        temperature=options.temperature,
    )


def _with_causes(machine: Machine, lengths: Lengths, options: IdentifyOptions, found: Identification) -> Identification:
    """Add to a misfit what explains most of it: the errors are identified again with dead lengths for each run, ..."""
    misfit = found.misfit
    if misfit is None or misfit.series is None or misfit.causes:
        return found
    for code, text, label in split_labels(misfit.series):
        every = np.full(len(lengths), int(label.min()), dtype=np.int64)
        every[found.accepted] = label
        again = _split_by(machine, lengths, options, every)
        if again is None:
            continue
        share = 1.0 - again.reduced_chi_square / misfit.reduced_chi_square
        if share > EXPLAINS:
            return replace(found, misfit=replace(misfit, causes=(Cause(code, text, round(share, 4)),)))
    drift_mm = drift_of_repeats(lengths)
    again = None if drift_mm is None else _quietly(machine, _added(lengths, -drift_mm), options)
    share = 0.0 if again is None else 1.0 - again.reduced_chi_square / misfit.reduced_chi_square
    if drift_mm is None or share <= EXPLAINS:
        return found
    text = f"a drift with time over a range of about {float(np.ptp(drift_mm)) / MM_PER_UM:.3g} um"
    return replace(found, misfit=replace(misfit, causes=(Cause("drift", text, round(share, 4)),)))


def _added(lengths: Lengths, correction_mm: FloatArray) -> Lengths:
    return replace(lengths, length_mm=lengths.length_mm + correction_mm)


def _explained(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> str:
    """Say what makes readings fit that no optimum was found for; empty if nothing simple does."""
    for name, label in labels_of(lengths.labels, lengths.origin, lengths.position_mm, lengths.station).items():
        if label.min() < label.max() and _split_by(machine, lengths, options, label) is not None:
            found = f"with dead lengths of its own for each {name} the readings fit: there is a step between {name}s"
            return f"; {found}; `volcomp diagnose` shows it"
    return "; `volcomp diagnose` looks for what the model lacks"


def _split_by(machine: Machine, lengths: Lengths, options: IdentifyOptions, label: IntArray) -> Identification | None:
    """Identify with a set-up, and so dead lengths, of its own for each value of a label (n,); None where that fails."""
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    _, number = np.unique(np.column_stack([setup, label]), axis=0, return_inverse=True)
    labels = {**lengths.labels, "setup": np.asarray(number, dtype=np.int64).ravel()}
    return _quietly(machine, replace(lengths, labels=labels), options)


def _quietly(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> Identification | None:
    """Identify without warnings; None where that fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        try:
            return _at_reference(machine, lengths, options)
        except CompgenError:
            return None


def _rough(machine: Machine, lengths: Lengths) -> tuple[ErrorParameters, State, IntArray]:
    """Return the unknown errors, start values of everything and the dead length of each reading."""
    task = task_of(machine, lengths)
    start, _ = robust_state(start_values(task)[0], lengths, task.target_mm, task.station, task.group)
    return task.problem.parameters, start, task.group


def _identify(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> Identification:
    check_readings(machine, lengths, 1 if options.stations is not None else MIN_STATIONS)
    task = task_of(machine, lengths)
    start, searched = start_values(task)
    if not searched and options.stations is None and options.method == "joint":
        found = _undisturbed(task, start, options)
        if found is not None:
            return found
    start, disturbed = robust_state(start, lengths, task.target_mm, task.station, task.group)
    noise = reading_noise(lengths, options)
    task, sigma_mm, weights = with_weights(task, start, noise)
    if options.stations is not None:
        task, start = _with_known_stations(task, start, options.stations, float(sigma_mm.min()))
    factor, rank = determined(task, start)
    start = unmirrored(task, start, searched)
    if options.method == "two-step":
        return _two_step_result(task, start, sigma_mm, noise, options)
    readings = Readings(lengths, task.target_mm, task.group, weights, sigma_mm)
    try:
        fit = _fit(task, start, readings, factor, options, disturbed=disturbed)
    except ConvergenceError as error:
        raise ConvergenceError(f"{error}{weakness(task, factor)}") from error
    task = replace(task, problem=fit.problem, group=fit.group)
    return assemble(task, fit, sigma_mm, noise, rank)


def _undisturbed(task: Task, start: State, options: IdentifyOptions) -> Identification | None:
    """Identify by plain least squares; None where a reading does not belong, or where it does not converge.

    Undisturbed readings are the rule, and need none of the search for gross errors.
    """
    if isinstance(task.problem, GridProblem):
        start = affine_start(task.problem, start)
    noise = reading_noise(task.lengths, options)
    task, sigma_mm, _ = with_weights(task, start, noise)
    try:
        factor, rank = determined(task, start)
        solution = solve(task.problem, start, factor)
    except (ConvergenceError, UndeterminedError):
        return None
    residual = task.problem.residuals(solution.state)
    if options.reject and not belonging(residual / sigma_mm):
        return None
    accepted = np.ones(len(residual), dtype=bool)
    return assemble(task, RobustFit(task.problem, task.group, solution, accepted, residual), sigma_mm, noise, rank)


def _with_known_stations(
    task: Task, start: State, stations: KnownStations | Literal["nominal"], sigma_mm: float
) -> tuple[Task, State]:
    """Add the known stations to the problem and start from them."""
    known = stations if isinstance(stations, KnownStations) else locate_stations(task.machine, task.lengths)
    if known is not stations:
        message = "the stations were located with the machine taken as perfect: its errors are part of their positions"
        warnings.warn(f"{message} (to {known.u_mm.max() * 1e3:.1f} um)", CompgenWarning, stacklevel=5)
    assert not isinstance(task.problem, HeldStations)
    start = with_known_start(start, known, task.lengths, task.target_mm, task.group)
    return replace(task, problem=hold(task.problem, known, task.lengths.stations, sigma_mm)), start


def _two_step_result(
    task: Task, start: State, sigma_mm: FloatArray, noise: ReadingNoise, options: IdentifyOptions
) -> Identification:
    """Identify by self-calibration, transformation and separation (Zha & Zhang 2024, sections 4 and 5)."""
    if options.stations is not None:
        raise InputError("known stations belong to the joint method; in two steps the tracers locate themselves")
    readings = TracerReadings(task.lengths, task.problem.parameters, task.group, sigma_mm, start)
    found = solve_in_two_steps(readings, reject=options.reject)
    residual = task.problem.residuals(found.solution.state)
    fit = RobustFit(task.problem, task.group, found.solution, found.accepted, residual)
    result = assemble(task, fit, sigma_mm, noise, None)
    reasons = {item.row: item for item in found.rejected}
    return replace(
        result,
        rejected=tuple(reasons.get(item.row, item) for item in result.rejected),
        method="two-step",
        steps=found.summary,
        positions=found.located.deviations,
    )


def _fit(
    task: Task, start: State, readings: Readings, factor: Factor, options: IdentifyOptions, *, disturbed: bool
) -> RobustFit[AnyProblem]:
    """Adjust with rejection and beam breaks, or with all readings as they are."""
    if not options.reject:
        solution = solve(task.problem, start, factor)
        accepted = np.ones(len(readings.group), dtype=bool)
        return RobustFit(task.problem, task.group, solution, accepted, task.problem.residuals(solution.state))

    def rebuilt(group: IntArray) -> AnyProblem:
        problem = problem_of(task.machine, task.lengths, task.problem.parameters, group).weighted(readings.weight)
        return task.problem.rebuilt(problem) if isinstance(task.problem, HeldStations) else problem

    return fit_robustly(task.problem, start, readings, factor, rebuilt, disturbed=disturbed)
