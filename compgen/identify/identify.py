"""Joint identification of error curves, squareness, stations and dead lengths from tracer lengths.

Zha & Zhang 2024, section 5 (eq. 22-28), with the exact machine model in place of C P and the constraints of
``docs/conventions.md`` by elimination.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.errors import ConvergenceError, InputError, UndeterminedError
from compgen.identify.outliers import Rejected, accepted_readings, explain_rejected
from compgen.identify.parameters import ErrorParameters, error_parameters
from compgen.identify.problem import LengthProblem, State, length_problem
from compgen.identify.rank import Rank, analyse_rank
from compgen.identify.solver import Solution, solve
from compgen.identify.start import station_start
from compgen.model.observability import modelled_errors
from compgen.model.volumetric import tool_of

#: Standard uncertainty of a laser tracer's length when neither the file nor the user states one: half of the usual
#: statement 0.2 um + 0.3 um/m at k = 2.
ASSUMED_U_UM = 0.1
ASSUMED_U_UM_PER_M = 0.15
MIN_STATIONS = 3


@dataclass(frozen=True)
class IdentifyOptions:
    """What the user may say beyond the machine and the readings.

    ``u_length_um`` and ``u_length_um_per_m`` are the standard uncertainty a + b L of a reading; without them the
    comments of that name in the file count, else the usual statement of a laser tracer. ``reject`` False keeps all
    readings.
    """

    u_length_um: float | None = None
    u_length_um_per_m: float | None = None
    reject: bool = True


@dataclass(frozen=True)
class StationResult:
    """One station and set-up: position and dead length with standard uncertainties, mm, and residual RMS in um."""

    station: str
    setup: int
    position_mm: tuple[float, float, float]
    u_position_mm: tuple[float, float, float]
    dead_length_mm: float
    u_dead_length_mm: float
    readings: int
    rms_um: float


@dataclass(frozen=True)
class Identification:
    """Result of :func:`identify`.

    Parameters
    ----------
    errors : the identified errors with standard uncertainties.
    stations : one entry for every station and set-up.
    residual_mm : model minus reading of every reading (n,), also of the rejected ones.
    accepted : which readings were used, (n,).
    rms_um, degrees_of_freedom, reduced_chi_square : of the used readings; chi-square with the stated uncertainty.
    u_source : "stated" or "assumed"; with "assumed", and whenever the residuals are larger than stated, the
        uncertainties are scaled by the root of the reduced chi-square (``u_scale``).
    unobservable : combinations that the model leaves out because nothing can show them, in words.
    rejected : readings that were not used, with the reason.
    rank, unknowns, condition, iterations : of the least-squares problem.
    worst_u : largest standard uncertainty by unit ("um", "urad") with its error.
    covariance : of the unknown errors in the order of ``unknowns`` of the layout, mm and rad.
    layout : the unknown errors and their bases.
    """

    errors: ErrorTable
    stations: tuple[StationResult, ...]
    residual_mm: FloatArray
    accepted: NDArray[np.bool_]
    rms_um: float
    degrees_of_freedom: int
    reduced_chi_square: float
    u_source: str
    u_length_um: float
    u_length_um_per_m: float
    u_scale: float
    unobservable: tuple[str, ...]
    rejected: tuple[Rejected, ...]
    rank: int
    unknowns: int
    condition: float
    iterations: int
    worst_u: dict[str, tuple[float, str]]
    covariance: FloatArray
    layout: ErrorParameters

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``identify.json``."""
        return {
            "residual_rms_um": self.rms_um,
            "residual_max_um": float(np.max(np.abs(self.residual_mm[self.accepted]))) / MM_PER_UM,
            "degrees_of_freedom": self.degrees_of_freedom,
            "reduced_chi_square": self.reduced_chi_square,
            "u_length": {
                "source": self.u_source,
                "constant_um": self.u_length_um,
                "proportional_um_per_m": self.u_length_um_per_m,
                "scaled_by": self.u_scale,
            },
            "readings": len(self.accepted),
            "readings_used": int(np.count_nonzero(self.accepted)),
            "rank": self.rank,
            "unknowns": self.unknowns,
            "condition": self.condition,
            "iterations": self.iterations,
            "identified": list(self.errors.names),
            "unobservable": list(self.unobservable),
            "rejected": [asdict(item) for item in self.rejected],
            "worst_standard_uncertainty": {
                unit: {"value": value, "error": name} for unit, (value, name) in self.worst_u.items()
            },
            "squareness_urad": {
                name: {"value": value * 1e6, "u": u * 1e6} for name, (value, u) in self.errors.squareness.items()
            },
            "stations": [asdict(station) for station in self.stations],
        }


def identify(machine: Machine, lengths: Lengths, options: IdentifyOptions | None = None) -> Identification:
    """Identify the errors of a machine, the stations and the dead lengths from tracer lengths.

    Parameters
    ----------
    machine : chain, nodes, reference point and which errors its model contains.
    lengths : readings of three or more stations (one tracer at three or more places counts as so many).
    options : uncertainty of the readings, rejection.

    Raises
    ------
    InputError
        for fewer than three stations, or positions outside the travel.
    UndeterminedError
        if the readings do not determine the unknowns; it names the combinations.
    ConvergenceError
        if no optimum is reached.
    """
    options = options or IdentifyOptions()
    _check_readings(machine, lengths)
    tools = np.atleast_2d(tool_of(machine, lengths.tool_mm))
    several_tools = bool(np.any(np.ptp(tools, axis=0) > 1e-9))
    names = modelled_errors(machine, tools if several_tools else None)
    layout = error_parameters(machine, names, several_tools=several_tools)
    problem = length_problem(machine, lengths, layout)
    start = _start(problem, lengths)
    sigma_mm, noise = _uncertainty(lengths, problem, start, options)
    weights = (sigma_mm.min() / sigma_mm) ** 2
    problem = problem.weighted(weights)
    rank = _checked_rank(problem, start, lengths)
    solution, accepted = _solve_robustly(problem, start, weights, reject=options.reject)
    return _result(problem, lengths, solution, accepted, sigma_mm, noise, rank)


def _check_readings(machine: Machine, lengths: Lengths) -> None:
    if len(lengths.stations) < MIN_STATIONS:
        raise InputError(
            f"holds readings of {len(lengths.stations)} station(s) ({', '.join(lengths.stations)}); identification "
            f"needs at least {MIN_STATIONS}: with fewer unknown stations a function-valued ambiguity is left. Add the "
            "missing station, or measure with the same tracer from further places",
            file=lengths.origin[0][0] if lengths.origin else None,
        )
    outside = (lengths.position_mm < machine.lower_mm - 1e-3) | (lengths.position_mm > machine.upper_mm + 1e-3)
    if outside.any():
        row, axis = (int(k) for k in np.argwhere(outside)[0])
        low, high = machine.axes[axis].range_mm
        file, line = lengths.origin[row] if lengths.origin else (None, None)
        raise InputError(
            f"{lengths.position_mm[row, axis]:g} mm lies outside the travel {low:g} ... {high:g} mm of {AXES[axis]} "
            f"of machine {machine.name!r}: wrong machine file, wrong axis order or wrong unit?",
            file=file,
            line=line,
            field=f"column {AXES[axis].lower()}_mm",
        )


def _start(problem: LengthProblem, lengths: Lengths) -> State:
    stations = np.zeros((problem.stations, 3))
    dead = np.zeros(problem.groups)
    nominal = (problem.position_mm + problem.tool_mm)[problem.pose]
    for k in range(problem.stations):
        rows = problem.station == k
        own, member = np.unique(problem.group[rows], return_inverse=True)
        if np.count_nonzero(rows) < 4 + len(own):
            file = lengths.origin[int(np.flatnonzero(rows)[0])][0] if lengths.origin else None
            message = (
                f"station {lengths.stations[k]!r} has only {np.count_nonzero(rows)} reading(s); it cannot be located"
            )
            raise InputError(message, file=file)
        found = station_start(nominal[rows], problem.length_mm[rows], member.ravel().astype(np.int64), len(own))
        stations[k], dead[own] = found.position_mm, found.dead_length_mm
    return State(np.zeros(problem.parameters.size), stations, dead)


def _uncertainty(
    lengths: Lengths, problem: LengthProblem, start: State, options: IdentifyOptions
) -> tuple[FloatArray, tuple[str, float, float]]:
    """Standard uncertainty a + b L of every reading in mm, with (source, a in um, b in um/m)."""
    constant = _stated(lengths, "u_length_um", options.u_length_um)
    proportional = _stated(lengths, "u_length_um_per_m", options.u_length_um_per_m)
    source = "assumed" if constant is None and proportional is None else "stated"
    a_um = ASSUMED_U_UM if source == "assumed" else constant or 0.0
    b_um_per_m = ASSUMED_U_UM_PER_M if source == "assumed" else proportional or 0.0
    if a_um < 0 or b_um_per_m < 0 or a_um + b_um_per_m <= 0:
        raise InputError(f"the uncertainty of a length is {a_um:g} um + {b_um_per_m:g} um/m; it must be above zero")
    nominal = problem.position_mm + problem.tool_mm
    distance = np.linalg.norm(nominal[problem.pose] - start.stations_mm[problem.station], axis=1)
    return (a_um + b_um_per_m * distance / 1000.0) * MM_PER_UM, (source, a_um, b_um_per_m)


def _stated(lengths: Lengths, key: str, option: float | None) -> float | None:
    if option is not None:
        return option
    text = lengths.metadata.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        file = lengths.origin[0][0] if lengths.origin else None
        raise InputError(f"the comment {key} = {text!r} is not a number", file=file) from None


def _checked_rank(problem: LengthProblem, start: State, lengths: Lengths) -> Rank:
    matrix, _ = problem.normal_equations(start)
    rank = analyse_rank(problem, matrix, lengths.stations)
    if rank.rank < rank.size:
        raise UndeterminedError(
            f"the readings determine {rank.rank} of {rank.size} unknowns; " + "; ".join(rank.combinations[:8]),
            list(rank.combinations),
        )
    return rank


def _solve_robustly(
    problem: LengthProblem, start: State, weights: FloatArray, *, reject: bool
) -> tuple[Solution, NDArray[np.bool_]]:
    """Solve, reject what lies beyond the robust limit, and repeat until the same readings are kept."""
    accepted = np.ones(len(weights), dtype=bool)
    solution = solve(problem, start)
    for _ in range(20 if reject else 0):
        keep = accepted_readings(problem.residuals(solution.state) * np.sqrt(weights))
        if np.count_nonzero(keep) < 0.7 * len(keep):
            raise ConvergenceError(
                f"{np.count_nonzero(~keep)} of {len(keep)} readings do not fit the model; check the machine file's chain, "
                "the station labels and the units before anything is rejected"
            )
        if np.array_equal(keep, accepted):
            break
        accepted = keep
        problem = problem.weighted(weights * accepted)
        solution = solve(problem, solution.state)
    return solution, accepted


def _result(
    problem: LengthProblem,
    lengths: Lengths,
    solution: Solution,
    accepted: NDArray[np.bool_],
    sigma_mm: FloatArray,
    noise: tuple[str, float, float],
    rank: Rank,
) -> Identification:
    residual = problem.residuals(solution.state)
    freedom = int(np.count_nonzero(accepted)) - problem.size
    if freedom < 1:
        raise UndeterminedError(f"{np.count_nonzero(accepted)} readings for {problem.size} unknowns", [])
    chi_square = float(np.sum((residual / sigma_mm)[accepted] ** 2)) / freedom
    source, a_um, b_um_per_m = noise
    u_scale = float(np.sqrt(chi_square)) if source == "assumed" else max(1.0, float(np.sqrt(chi_square)))
    covariance = _inverse(solution.matrix) * (float(sigma_mm.min()) * u_scale) ** 2
    layout = problem.parameters
    errors = _error_table(layout, solution.state.errors, covariance[: layout.size, : layout.size])
    errors = replace(errors, metadata=_metadata(layout.machine, lengths))
    rejected = explain_rejected(lengths, problem, solution.state, np.flatnonzero(~accepted), sigma_mm)
    return Identification(
        errors=errors,
        stations=_stations(problem, lengths, solution.state, covariance, np.where(accepted, residual, np.nan)),
        residual_mm=residual,
        accepted=accepted,
        rms_um=float(np.sqrt(np.mean(residual[accepted] ** 2))) / MM_PER_UM,
        degrees_of_freedom=freedom,
        reduced_chi_square=chi_square,
        u_source=source,
        u_length_um=a_um,
        u_length_um_per_m=b_um_per_m,
        u_scale=u_scale,
        unobservable=_unobservable(layout),
        rejected=rejected,
        rank=rank.rank,
        unknowns=problem.size,
        condition=rank.condition,
        iterations=solution.iterations,
        worst_u=_worst_u(errors),
        covariance=covariance[: layout.size, : layout.size],
        layout=layout,
    )


def _inverse(matrix: FloatArray) -> FloatArray:
    scale = 1.0 / np.sqrt(np.diag(matrix))
    factor = cho_factor(matrix * scale[:, None] * scale, lower=True)
    return np.asarray(cho_solve(factor, np.eye(len(matrix)))) * scale[:, None] * scale


def _error_table(layout: ErrorParameters, unknowns: FloatArray, covariance: FloatArray) -> ErrorTable:
    curves = {}
    for curve in layout.curves:
        positions = layout.output_positions_mm(curve.error.axis)
        reduced = layout.basis(curve.error.axis, positions) @ curve.free
        block = covariance[curve.columns, curve.columns]
        u = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", reduced, block, reduced), 0.0))
        curves[curve.error.name] = Curve(positions, reduced @ unknowns[curve.columns], u)
    first = layout.size - len(layout.squareness)
    squareness = {
        name: (float(unknowns[first + k]), float(np.sqrt(covariance[first + k, first + k])))
        for k, name in enumerate(layout.squareness)
    }
    return ErrorTable(curves, squareness)


def _metadata(machine: Machine, lengths: Lengths) -> dict[str, str]:
    reference = " ".join(f"{value:g}" for value in machine.reference_point_mm)
    kept = {key: lengths.metadata[key] for key in ("date",) if key in lengths.metadata}
    return {"machine": machine.name, **kept, "source": "compgen identify", "reference_point_mm": reference}


def _stations(
    problem: LengthProblem, lengths: Lengths, state: State, covariance: FloatArray, residual: FloatArray
) -> tuple[StationResult, ...]:
    u = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    first, second = problem.parameters.size, problem.parameters.size + 3 * problem.stations
    setups = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    results = []
    for group in range(problem.groups):
        rows = np.flatnonzero(problem.group == group)
        k = int(problem.station[rows[0]])
        x, y, z = state.stations_mm[k].tolist()
        u_x, u_y, u_z = u[first + 3 * k : first + 3 * k + 3].tolist()
        used = residual[rows][np.isfinite(residual[rows])]
        results.append(
            StationResult(
                station=lengths.stations[k],
                setup=int(setups[rows[0]]),
                position_mm=(x, y, z),
                u_position_mm=(u_x, u_y, u_z),
                dead_length_mm=float(state.dead_length_mm[group]),
                u_dead_length_mm=float(u[second + group]),
                readings=len(used),
                rms_um=float(np.sqrt(np.mean(used**2))) / MM_PER_UM if len(used) else float("nan"),
            )
        )
    return tuple(results)


def _unobservable(layout: ErrorParameters) -> tuple[str, ...]:
    from compgen.core.names import ERROR_NAMES

    identified = {curve.error.name for curve in layout.curves} | set(layout.squareness)
    missing = [name for name in ERROR_NAMES if name not in identified]
    return tuple(
        f"{name}: no lever arm but its own axis' travel or one tool offset on chain {layout.machine.chain.name}"
        for name in missing
    )


def _worst_u(errors: ErrorTable) -> dict[str, tuple[float, str]]:
    worst: dict[str, tuple[float, str]] = {"um": (0.0, ""), "urad": (0.0, "")}
    for name, curve in errors.curves.items():
        unit = "um" if name[1] in "XYZ" else "urad"
        value = float(np.nanmax(curve.u)) * (1e3 if unit == "um" else 1e6)
        if value > worst[unit][0]:
            worst[unit] = (value, name)
    for name, (_, u) in errors.squareness.items():
        if u * 1e6 > worst["urad"][0]:
            worst["urad"] = (u * 1e6, name)
    return worst
