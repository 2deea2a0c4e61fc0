"""Errors, stations and dead lengths from tracer lengths (Zha & Zhang 2024, section 5), from readings to result."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import of_kind
from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, Message, UndeterminedError
from compgen.identification.adjust.grid_problem import GridProblem, grid_problem
from compgen.identification.adjust.propagation import Adjustment
from compgen.identification.adjust.residual_tests import EXPLAINS, Cause, drift_of_repeats, labels_of, split_labels
from compgen.identification.adjust.robust import RobustFit, WeightedReadings, belonging, explain_rejected, fit_robustly
from compgen.identification.adjust.solver import (
    NO_DATA,
    Factor,
    Rank,
    describe_rank,
    determined_factor,
    solve,
    unknown_names,
)
from compgen.identification.adjust.starts import (
    StationStart,
    affine_start,
    robust_state,
    start_moments,
    station_start,
    station_start_from_moments,
    station_starts_from_moments,
)
from compgen.identification.adjust.unknowns import (
    ErrorParameters,
    IntArray,
    State,
    check_travel,
    common_tool,
    dead_lengths_of,
    parameters_for_tools,
)
from compgen.identification.covariance import with_systematic
from compgen.identification.options import (
    IdentifyOptions,
    KnownStations,
    ReadingNoise,
    known_positions,
    locate_stations,
    reading_noise,
    with_known_start,
)
from compgen.identification.reference_conditions import identify_at_reference, reading_conditions
from compgen.identification.result import (
    AdjustedReadings,
    Identification,
    StationResult,
    error_table,
    station_results,
)
from compgen.kinematics.first_order import c_matrix, tool_of
from compgen.kinematics.kernel_switch import one_thread, use_compiled

if TYPE_CHECKING:
    from compgen.identification.adjust.determined import Observations
    from compgen.identification.adjust.path_problem import PathProblem
    from compgen.identification.adjust.problem import LengthProblem

# The readings of an identification with their problem, and start values in closed form.


AnyProblem: TypeAlias = "GridProblem | LengthProblem | PathProblem"


@dataclass(frozen=True)
class Task:
    """The readings with everything common to the steps of the identification."""

    machine: Machine
    lengths: Lengths
    problem: AnyProblem
    station: IntArray
    group: IntArray

    @cached_property
    def target_mm(self) -> FloatArray:
        """Nominal target of every reading, (n, 3)."""
        return self.lengths.position_mm + common_tool(self.machine, self.lengths.tool_mm)

    def unknown_names(self) -> list[str]:
        """Names of all unknowns, for messages."""
        return unknown_names(self.problem.parameters, self.lengths.stations, self.station, self.group)


#: Positions within this share of the travel of every axis determine nothing; they were probably written in metres.
SHARE_OF_METRES = 0.002


def check_readings(machine: Machine, lengths: Lengths, least: int) -> None:
    """Raise InputError for fewer than ``least`` stations, positions outside the travel, and positions in metres."""
    if len(lengths.stations) < least:
        raise InputError(
            Message(
                "too-few-stations",
                "contains readings of {stations} station(s) ({stations2}); identification needs at "
                "least {least}: with fewer unknown stations a function-valued ambiguity remains. Add "
                "the missing station, measure with the same tracer from more places, give known "
                "stations, or give other measurements as well (axis runs, a plate)",
                stations=len(lengths.stations),
                stations2=", ".join(lengths.stations),
                least=least,
            ),
            file=lengths.origin[0][0] if lengths.origin else None,
        )
    check_travel(machine, lengths.position_mm, lengths.origin)
    span_mm = np.ptp(lengths.position_mm, axis=0)
    travel_mm = np.array([np.ptp(axis.range_mm) for axis in machine.axes])
    if np.all(span_mm < SHARE_OF_METRES * travel_mm):
        k = int(np.argmax(span_mm))
        raise InputError(
            Message(
                "positions-in-metres",
                "the positions look like metres: they span {span_mm:g} of {travel_mm:g} mm of "
                "{value}; convert them to mm",
                span_mm=span_mm[k],
                travel_mm=travel_mm[k],
                value=AXES[k],
            ),
            file=lengths.origin[0][0] if lengths.origin else None,
            field="columns x_mm, y_mm, z_mm",
        )


def task_of(machine: Machine, lengths: Lengths) -> Task:
    """Lay out the unknowns for the readings, all with weight 1."""
    tool_mm = common_tool(machine, lengths.tool_mm)
    layout = parameters_for_tools(machine, tool_mm)
    group = dead_lengths_of(lengths)
    problem = problem_of(machine, lengths, layout, group)
    return Task(machine, lengths, problem, lengths.station, group)


#: Number of readings from which the compiled pass over scattered positions pays off.
ENOUGH = 20_000


def problem_of(machine: Machine, lengths: Lengths, layout: ErrorParameters, group: IntArray) -> AnyProblem:
    """Return the least-squares problem of the readings: on a grid of levels if they form one, otherwise point by point."""
    readings = common_tool(machine, lengths.tool_mm), lengths.station, group, lengths.length_mm
    found: AnyProblem | None = grid_problem(layout, lengths.position_mm, *readings)
    if found is None and len(lengths) >= ENOUGH and use_compiled(len(lengths), ENOUGH):
        from compgen.identification.adjust.path_problem import path_problem

        found = path_problem(layout, lengths.position_mm, *readings)
    if found is None:
        from compgen.identification.adjust.problem import length_problem

        found = length_problem(machine, lengths, layout, group)
    return found


def start_values(task: Task) -> tuple[State, list[int]]:
    """Return the start values, and the stations that the closed form could not locate."""
    stations = np.zeros((len(task.lengths.stations), 3))
    groups = int(task.group.max()) + 1
    dead = np.zeros(groups)
    station_of = np.zeros(groups, dtype=np.int64)
    station_of[task.group] = task.station
    moments = start_moments(task.problem) if isinstance(task.problem, GridProblem) else None
    readings = np.bincount(task.station, minlength=len(stations))
    searched: list[int] = []
    at_once: list[StationStart | None] = [None] * len(stations)
    if moments is not None and groups == len(stations):
        at_once = station_starts_from_moments(*moments)
    for k in range(len(stations)):
        own = np.flatnonzero(station_of == k)
        if readings[k] < 4 + len(own):
            origin = task.lengths.origin
            file = origin[int(np.flatnonzero(task.station == k)[0])][0] if origin and readings[k] else None
            message = f"station {task.lengths.stations[k]!r} has only {readings[k]} reading(s); it cannot be located"
            raise InputError(message, file=file)
        found = at_once[k]
        if found is None and moments is not None:
            sums, offset, centre, scale = moments
            found = station_start_from_moments(sums[own], offset[own], centre, scale)
        if found is None:
            rows = task.station == k
            member = np.searchsorted(own, task.group[rows])
            found = station_start(task.target_mm[rows], task.lengths.length_mm[rows], member, len(own))
            searched.append(k)
        stations[k], dead[own] = found.position_mm, found.dead_length_mm
    return State(np.zeros(task.problem.parameters.size), stations, dead), searched


def with_weights(task: Task, start: State, noise: ReadingNoise) -> tuple[Task, FloatArray, FloatArray]:
    """Return the task with weighted readings, their standard uncertainty in mm and their weights, each (n,)."""
    if noise.uniform_mm is not None:  # the problem came with weights 1
        count = len(task.lengths)
        return task, np.full(count, noise.uniform_mm), np.ones(count)
    sigma_mm = noise.sigma_mm(task.problem.distances(start))
    weights = (sigma_mm.min() / sigma_mm) ** 2
    return replace(task, problem=task.problem.weighted(weights)), sigma_mm, weights


# What the readings leave undetermined at the start, before the adjustment.


#: Eigenvalue of the scaled normal matrix below which a combination is reported if nothing converges.
HARDLY_DETERMINED = 1e-6


def determined(task: Task, start: State) -> tuple[Factor, Rank | None]:
    """Return the factor of the normal matrix at the start; UndeterminedError if it is singular."""
    return determined_factor(task.problem.normal_matrix(start), task.unknown_names, "the readings")


def unmirrored(task: Task, start: State, searched: Sequence[int]) -> State:
    """Choose the side for stations whose targets are all in a plane: the mirror image explains the readings equally well.

    Only the machine's errors, seen from the other stations, distinguish the two, so both are tried.
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
    """Return which combinations are weakly determined, if that may be why nothing converged."""
    rank = describe_rank(factor.matrix, task.unknown_names(), HARDLY_DETERMINED)
    if rank.rank == rank.size:
        return ""
    return (
        f"; only weakly determined even at the start: {'; '.join(rank.combinations[:3])}; stations must not be on a line, "
        "nor in a plane with an end of the travel"
    )


# From the optimum to the result: curves, stations, uncertainties, and rejected readings.


def assemble(
    task: Task,
    fit: RobustFit[AnyProblem],
    sigma_mm: FloatArray,
    noise: ReadingNoise,
    rank: Rank | None,
) -> Identification:
    """Return the result of a finished adjustment.

    Parameters
    ----------
    task : the readings and their problem.
    fit : the optimum, which readings were used, and the residuals.
    sigma_mm : standard uncertainty of each reading, (n,).
    noise : its source.
    rank : the detailed analysis of the rank, if made.

    Raises
    ------
    UndeterminedError
        if fewer readings than unknowns are left.
    """
    problem, layout = task.problem, task.problem.parameters
    solution, accepted, known = fit.solution, fit.accepted, problem.known
    least = float(sigma_mm.min())
    freedom = int(np.count_nonzero(accepted)) - problem.size + (len(known) if known else 0)
    known_square_sum = known.square_sum(solution.state) / least**2 if known else 0.0
    adjusted = AdjustedReadings(
        fit.residual_mm, sigma_mm, accepted, noise.source, problem.size, freedom, known_square_sum
    )
    known_weight = None
    if known:
        known_weight = np.zeros(problem.size)
        known_weight[known.columns(layout.size)] += known.weight[:, None]
    adjustment = Adjustment(
        state=solution.state,
        factor=solution.factor,
        weight=(least / sigma_mm) ** 2 * accepted,
        group=task.group,
        sigma_mm=least * adjusted.u_scale,
        known_weight=known_weight,
    )
    errors = error_table(layout, solution.state.errors, adjustment.covariance_factor()[: layout.size])
    rejected = np.flatnonzero(~accepted)
    return replace(
        adjusted.identification(errors, layout, task.lengths.metadata, noise.constant_um),
        stations=_stations(task, adjustment, fit.residual_mm, accepted),
        u_length_um_per_m=noise.proportional_um_per_m,
        rejected=explain_rejected(
            task.lengths, layout, solution.state, task.group, rejected, fit.residual_mm, sigma_mm, fit.segments
        ),
        segments=fit.segments,
        rank=problem.size if rank is None else problem.size - (rank.size - rank.rank),
        condition=1.0 / solution.factor.rcond,
        iterations=solution.iterations,
        adjustment=adjustment,
    )


def _stations(
    task: Task, adjustment: Adjustment, residual: FloatArray, accepted: NDArray[np.bool_]
) -> tuple[StationResult, ...]:
    groups = len(adjustment.state.dead_length_mm)
    everything = bool(accepted.all())
    used = np.bincount(task.group, None if everything else accepted, groups)
    squares = np.bincount(task.group, residual**2 if everything else residual**2 * accepted, groups)
    setups = task.lengths.labels.get("setup", np.zeros(len(task.lengths), dtype=np.int64))
    row_of = np.zeros(groups, dtype=np.int64)
    row_of[task.group] = np.arange(len(task.group))
    of_group = list(zip(task.station[row_of].tolist(), setups[row_of].tolist(), strict=True))
    return station_results(task.lengths.stations, of_group, adjustment, task.problem.parameters.size, used, squares)


# Joint identification of error curves, squareness, stations and dead lengths from tracer lengths.
#
# Zha & Zhang 2024, section 5 (eq. 22-28), with the exact machine model instead of C P and the constraints of
# ``docs/conventions.md`` by elimination.


# What to do where the readings do not determine the errors of the machine file.


#: Stations of two names closer than this are one place, mm: the distance of two tracers set up side by side is larger.
ONE_PLACE_MM = 20.0
#: Levels closer than this are the same position of an axis, mm.
SAME_LEVEL_MM = 0.5


def remedies(machine: Machine, lengths: Lengths, options: IdentifyOptions, *, empty_nodes: bool) -> list[str]:
    """Return what makes the readings determine the errors, the most likely cause first; empty if nothing simple does.

    Fewer nodes are tried only for nodes without any reading (``empty_nodes``): they do not help stations on a line.
    """
    span_mm = np.ptp(lengths.position_mm, axis=0)
    found = [
        f"{AXES[k]} did not move (all readings at {lengths.position_mm[0, k]:g} mm): measure at several positions along it"
        for k in np.flatnonzero(span_mm < SAME_LEVEL_MM).tolist()
    ]
    if found:
        return found
    task = task_of(machine, lengths)
    place_mm = start_values(task)[0].stations_mm
    for first, second in itertools.combinations(range(len(place_mm)), 2):
        distance = float(np.linalg.norm(place_mm[first] - place_mm[second]))
        if distance < ONE_PLACE_MM:
            names = f"{lengths.stations[first]} and {lengths.stations[second]}"
            found.append(
                f"the stations {names} are in one place ({distance:.1f} mm apart), which counts once: measure from another place"
            )
    if options.nodes == "machine" and empty_nodes and not found:
        fewer = next(
            (item for item in with_fewer_nodes(machine, lengths) if _quietly(item, lengths, options) is not None), None
        )
        if fewer is not None:
            counts = ", ".join(
                f"{letter} = {len(axis.nodes_mm)}" for letter, axis in zip(AXES, fewer.axes, strict=True)
            )
            has = ", ".join(str(len(axis.nodes_mm)) for axis in machine.axes)
            found.append(
                f"{counts} nodes fit these readings (the machine file has {has}): set nodes there, or use "
                "--nodes from-data (where nothing was read curves are then extrapolated, and their u grows; readings over the "
                "whole travel are better)"
            )
    return found


def with_fewer_nodes(machine: Machine, lengths: Lengths) -> Iterator[Machine]:
    """Yield the machine with the nodes that the positions of the readings can support, then with ever fewer.

    An axis has at most as many nodes as positions were measured; the nodes are equally spaced, or at measured positions.
    """
    levels = []
    for position in lengths.position_mm.T:
        sorted_mm = np.sort(position)
        levels.append(sorted_mm[np.flatnonzero(np.diff(sorted_mm, prepend=-np.inf) > SAME_LEVEL_MM)])
    counts = [max(2, min(len(axis.nodes_mm), len(own))) for axis, own in zip(machine.axes, levels, strict=True)]
    while True:
        for at_levels in (False, True):
            axes = []
            for axis, own, count in zip(machine.axes, levels, counts, strict=True):
                nodes = np.linspace(*axis.range_mm, count)
                if len(axis.nodes_mm) == count:
                    nodes = axis.nodes_mm
                elif at_levels and len(own) >= count:
                    nodes = own[np.rint(np.linspace(0, len(own) - 1, count)).astype(int)]
                    nodes[[0, -1]] = axis.range_mm
                axes.append(replace(axis, nodes_mm=nodes))
            yield replace(machine, axes=(axes[0], axes[1], axes[2]))
        if max(counts) == 2:
            return
        counts = [max(2, int(0.85 * count)) for count in counts]


MIN_STATIONS = 3


def identify(machine: Machine, lengths: Lengths, options: IdentifyOptions | None = None) -> Identification:
    """Identify the errors of a machine, the stations and the dead lengths from tracer lengths.

    Parameters
    ----------
    machine : chain, nodes, reference point and which errors its model contains.
    lengths : readings of three or more stations (one tracer at three or more places counts as several).
    options : uncertainty of the readings and of their common inputs, rejection.

    Raises
    ------
    InputError
        for fewer than three stations, or positions outside the travel.
    UndeterminedError
        if the readings do not determine the unknowns; it lists the combinations.
    ConvergenceError
        if no optimum is reached.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> lengths = compgen.read_lengths("examples/zha-gantry.lengths.csv")
    >>> found = compgen.identify(machine, lengths)
    >>> value, u = found.errors.squareness["EC0Y"]
    >>> print(f"{1e6 * value:.1f} +- {1e6 * u:.1f} urad")
    2903.6 +- 0.2 urad
    """
    of_kind("machine", machine, Machine)
    of_kind("lengths", lengths, Lengths)
    of_kind("options", options, IdentifyOptions, type(None))
    if not len(lengths):
        raise InputError(Message("no-reading", "contains no reading"), field="lengths")
    chosen = options or IdentifyOptions()
    with one_thread():
        if chosen.nodes == "from-data":  # tried without warnings; those of the nodes that are taken come below
            fitting = (item for item in with_fewer_nodes(machine, lengths) if _quietly(item, lengths, chosen))
            machine = next(fitting, machine)
        try:
            found = _at_reference(machine, lengths, chosen)
        except ConvergenceError as error:
            raise ConvergenceError(f"{error}{_explained(machine, lengths, chosen)}") from error
        except UndeterminedError as error:
            empty = any(text.startswith(NO_DATA) for text in error.combinations)
            advice = "".join(f"{text}; " for text in remedies(machine, lengths, chosen, empty_nodes=empty))
            raise UndeterminedError(f"{advice}{error}", error.combinations) from error
        return with_systematic(machine, lengths, _with_causes(machine, lengths, chosen, found), chosen.systematic)


def _at_reference(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> Identification:
    def rough(readings: Lengths) -> tuple[ErrorParameters, State, IntArray]:
        """Unknown errors, start values of everything and the dead length of each reading."""
        task = task_of(machine, readings)
        start, _ = robust_state(start_values(task)[0], readings, task.target_mm, task.station, task.group)
        return task.problem.parameters, start, task.group

    def adjust(readings: Lengths) -> Identification:
        return _identify(machine, readings, options)

    return identify_at_reference(machine, lengths, adjust, rough, temperature=options.temperature)


def _with_causes(machine: Machine, lengths: Lengths, options: IdentifyOptions, found: Identification) -> Identification:
    """Add the main cause to a misfit: the errors are identified again with dead lengths for each run, ..."""
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
    again = (
        None
        if drift_mm is None
        else _quietly(machine, replace(lengths, length_mm=lengths.length_mm - drift_mm), options)
    )
    share = 0.0 if again is None else 1.0 - again.reduced_chi_square / misfit.reduced_chi_square
    if drift_mm is None or share <= EXPLAINS:
        return found
    text = f"a drift with time over a range of about {float(np.ptp(drift_mm)) / MM_PER_UM:.3g} um"
    return replace(found, misfit=replace(misfit, causes=(Cause("drift", text, round(share, 4)),)))


def _explained(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> str:
    """Return what makes readings fit for which no optimum was found; empty if nothing simple does."""
    for name, label in labels_of(lengths.labels, lengths.origin, lengths.position_mm, lengths.station).items():
        if label.min() < label.max() and _split_by(machine, lengths, options, label) is not None:
            found = f"with separate dead lengths for each {name} the readings fit: there is a step between {name}s"
            return f"; {found}; `volcomp diagnose` shows it"
    return "; `volcomp diagnose` searches for the missing effect"


def _split_by(machine: Machine, lengths: Lengths, options: IdentifyOptions, label: IntArray) -> Identification | None:
    """Identify with a separate set-up, and so dead lengths, for each value of a label (n,); None if that fails."""
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    _, number = np.unique(np.column_stack([setup, label]), axis=0, return_inverse=True)
    labels = {**lengths.labels, "setup": np.asarray(number, dtype=np.int64).ravel()}
    return _quietly(machine, replace(lengths, labels=labels), options)


def _quietly(machine: Machine, lengths: Lengths, options: IdentifyOptions) -> Identification | None:
    """Identify without warnings; None if that fails."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        try:
            return _at_reference(machine, lengths, options)
        except CompgenError:
            return None


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
        known = options.stations
        if not isinstance(known, KnownStations):
            known = locate_stations(machine, lengths)
            message = (
                "the stations were located with the machine assumed perfect: its errors are part of their positions"
            )
            warnings.warn(
                Message("rounded-to", "{message} (to {u_mm:.1f} um)", message=message, u_mm=known.u_mm.max() * 1000.0),
                CompgenWarning,
                stacklevel=4,
            )
        start = with_known_start(start, known, lengths, task.target_mm, task.group)
        observed = known_positions(known, lengths.stations, float(sigma_mm.min()))
        task = replace(task, problem=replace(task.problem, known=observed))
    factor, rank = determined(task, start)
    start = unmirrored(task, start, searched)
    if options.method == "two-step":
        return _two_step_result(task, start, sigma_mm, noise, options)
    readings = WeightedReadings(lengths, task.target_mm, task.group, weights, sigma_mm)
    try:
        fit = _fit(task, start, readings, factor, options, disturbed=disturbed)
    except ConvergenceError as error:
        raise ConvergenceError(f"{error}{weakness(task, factor)}") from error
    task = replace(task, problem=fit.problem, group=fit.group)
    return assemble(task, fit, sigma_mm, noise, rank)


def _undisturbed(task: Task, start: State, options: IdentifyOptions) -> Identification | None:
    """Identify by plain least squares; None if a reading does not fit, or if it does not converge.

    Undisturbed readings are the usual case and need no search for gross errors.
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


def _two_step_result(
    task: Task, start: State, sigma_mm: FloatArray, noise: ReadingNoise, options: IdentifyOptions
) -> Identification:
    """Identify by self-calibration, transformation and separation (Zha & Zhang 2024, sections 4 and 5)."""
    if options.stations is not None:
        raise InputError(
            Message(
                "stations-need-joint",
                "known stations require the joint method; in the two-step method the tracers locate themselves",
            )
        )
    from compgen.identification.two_step import TracerReadings, solve_in_two_steps

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
    task: Task, start: State, readings: WeightedReadings, factor: Factor, options: IdentifyOptions, *, disturbed: bool
) -> RobustFit[AnyProblem]:
    """Adjust with rejection and beam breaks, or with all readings."""
    if not options.reject:
        solution = solve(task.problem, start, factor)
        accepted = np.ones(len(readings.group), dtype=bool)
        return RobustFit(task.problem, task.group, solution, accepted, task.problem.residuals(solution.state))

    def rebuilt(group: IntArray) -> AnyProblem:
        problem = problem_of(task.machine, task.lengths, task.problem.parameters, group).weighted(readings.weight)
        return replace(problem, known=task.problem.known)

    return fit_robustly(task.problem, start, readings, factor, rebuilt, disturbed=disturbed)


# Lengths that alone do not determine the errors, as readings in an adjustment with other measurements.


#: Steps that fit stations and dead lengths to given errors; each of them gains several digits.
PLACING_STEPS = 5
#: Targets whose thickness is below this share of their spread lie in a plane: either side of it explains their lengths.
FLAT = 1e-3


def length_observations(
    machine: Machine, layout: ErrorParameters, lengths: Lengths, options: IdentifyOptions, around: FloatArray
) -> Observations:
    """Return the lengths of any number of stations as readings of the errors of a layout, then the known stations.

    Stations and dead lengths are further unknowns. Linear about the errors ``around`` (size,) and the stations that fit
    them best.

    Raises
    ------
    InputError
        for positions outside the travel, too few readings of a station.
    UndeterminedError
        if all targets of a station lie in a plane: the lengths do not show on which side of it the station is.
    """
    from compgen.identification.adjust.determined import (
        Observations,  # whoever adjusts them together has it; lengths alone have not
    )

    check_readings(machine, lengths, 1)
    lengths, conditions = reading_conditions(machine, lengths, temperature=options.temperature)
    task = task_of(machine, lengths)
    start = robust_state(start_values(task)[0], lengths, task.target_mm, task.station, task.group)[0]
    known = options.stations if isinstance(options.stations, KnownStations) else None
    if known is not None:
        start = with_known_start(start, known, lengths, task.target_mm, task.group)
    for k, name in enumerate(lengths.stations):
        targets_mm = task.target_mm[task.station == k]
        spread = np.linalg.svd(targets_mm - targets_mm.mean(axis=0), compute_uv=False)
        if spread[2] < FLAT * spread[0] and (known is None or name not in known.names):
            raise UndeterminedError(
                Message(
                    "targets-in-plane",
                    "all targets of station {name!r} lie in a plane, so its lengths do not show on which "
                    "side of it the station is: measure at another height as well, or give the place of "
                    "the station (--stations)",
                    name=name,
                ),
                [],
            )
    n, stations, rows = len(lengths), 3 * len(lengths.stations), np.arange(len(lengths))
    tool_mm = np.broadcast_to(tool_of(machine, lengths.tool_mm), lengths.position_mm.shape)
    tip_mm = layout.tips(around, lengths.position_mm, tool_mm)
    state, still = replace(start, errors=around), np.zeros_like(tip_mm)
    sigma_mm = reading_noise(lengths, options).sigma_mm(
        np.linalg.norm(tip_mm - state.stations_mm[task.station], axis=1)
    )
    others = np.zeros((n, stations + len(state.dead_length_mm)))
    others[rows, stations + task.group] = -1.0
    behind = np.zeros((0, others.shape[1]))
    pull, u_mm = np.zeros(0), np.zeros(0)
    for _ in range(PLACING_STEPS):
        sight = tip_mm - state.stations_mm[task.station]
        distance = np.linalg.norm(sight, axis=1)
        unit = sight / distance[:, None]
        reading_mm = lengths.length_mm
        if conditions.needs_geometry:
            reading_mm = reading_mm + conditions.correction_mm(lengths, layout, state, task.group, still)
        gap_mm = reading_mm - distance + state.dead_length_mm[task.group]
        for axis in range(3):
            others[rows, 3 * task.station + axis] = -unit[:, axis]
        if known is not None:
            index = known.indices(lengths.stations)
            behind = np.eye(others.shape[1])[(3 * index[:, None] + np.arange(3)).ravel()]
            pull = (known.position_mm - state.stations_mm[index]).ravel()
            u_mm = np.repeat(known.u_mm, 3)
        sigma = np.concatenate([sigma_mm, u_mm])
        both, gaps = np.vstack([others, behind]), np.concatenate([gap_mm, pull])
        placing = np.linalg.lstsq(both / sigma[:, None], gaps / sigma, rcond=1e-12)[0]
        state = state.moved(np.concatenate([np.zeros(len(around)), placing]))
    design = np.einsum(
        "nd,ndp->np",
        unit,
        layout.design(c_matrix(machine, lengths.position_mm, tool_mm), layout.bases(lengths.position_mm)),
    )
    nothing = len(behind)
    return Observations(
        design=np.vstack([design, np.zeros((nothing, layout.size))]),
        others=both,
        value=gaps + np.concatenate([design @ around, np.zeros(nothing)]),
        sigma=sigma,
        at_mm=np.vstack([lengths.position_mm, np.full((nothing, 3), np.nan)]),
        shows=np.repeat([[True], [False]], [n, nothing], axis=0) & np.ones(len(layout.curves), dtype=bool),
    )
