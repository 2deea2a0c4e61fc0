"""What a planned measurement will determine, how well, and which effects it cannot show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import of_kind
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths, Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.data.records import approach_of
from compgen.drawing.display import Drawable, Overview, Panel
from compgen.effects import Card, Effect, Readings, catalogue
from compgen.effects.all_effects import INVISIBLE, Pair, VisiblePart, alike_pairs, separating, visible_parts
from compgen.effects.structure import SignError, Squareness
from compgen.errors import InputError, Message
from compgen.identification.adjust.grid_problem import GridProblem, grid_problem
from compgen.identification.adjust.problem import LengthProblem, length_problem
from compgen.identification.adjust.solver import ZERO_EIGENVALUE, Rank, describe_rank, unknown_names
from compgen.identification.adjust.unknowns import (
    ErrorParameters,
    State,
    check_travel,
    dead_lengths_of,
    error_parameters,
    state_names,
)
from compgen.identification.covariance import error_values
from compgen.identification.options import IdentifyOptions, ReadingNoise, reading_noise
from compgen.identification.posterior import (
    Information,
    Posterior,
    assumed_text,
    posterior_of_values,
    reading_levels,
    solve_posterior,
    state_layout,
)
from compgen.identification.result import at_nodes, table_of_values
from compgen.kinematics.first_order import c_matrix, modelled_errors, tool_of
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import MOST_POINTS, volume_grid
from compgen.planning.stations import PlannedStations

# The least-squares problem of a measurement that has not been made: its normal matrix, and its consequences.


#: A target nearer to a station than this cannot be measured; its line of sight has no direction.
NEAREST_MM = 1.0
#: A quantity with more than this share of its size in directions without data is undetermined.
UNDETERMINED_SHARE = 1e-4


@dataclass(frozen=True)
class Planned:
    """A planned measurement as a least-squares problem whose errors are zero.

    Parameters
    ----------
    machine, stations, noise : the machine, the stations and the noise of the readings.
    lengths : the future readings, without errors.
    problem : all weights 1; the weights follow the distances, so they change with the stations.
    tool_mm : tool offsets, (3,) or (n, 3).
    """

    machine: Machine
    stations: PlannedStations
    noise: ReadingNoise
    lengths: Lengths
    problem: GridProblem | LengthProblem
    tool_mm: FloatArray

    def normal_matrix(self, stations_mm: FloatArray) -> FloatArray:
        """Return the normal matrix (size, size) in 1/mm^2 with the stations at the given places (S, 3)."""
        distance = np.linalg.norm(self.lengths.position_mm + self.tool_mm - stations_mm[self.lengths.station], axis=1)
        weight = 1.0 / self.noise.sigma_mm(distance) ** 2
        state = State(np.zeros(self.problem.parameters.size), stations_mm, np.zeros(self.problem.groups))
        return self.problem.weighted(weight).normal_matrix(state)

    def distances_mm(self) -> FloatArray:
        """Distance of station and target of each reading, (n,)."""
        centre = self.stations.position_mm[self.lengths.station]
        return np.asarray(np.linalg.norm(self.lengths.position_mm + self.tool_mm - centre, axis=1))

    def error_rows(
        self, position_mm: FloatArray, layout: ErrorParameters | None = None, tool_mm: FloatArray | None = None
    ) -> FloatArray:
        """Derivative of E by the unknown errors at commanded points (n, 3): C B, shape (n, 3, errors)."""
        chosen = layout or self.problem.parameters
        bases = chosen.bases(position_mm)
        return chosen.design(c_matrix(self.machine, position_mm, tool_mm), bases)

    def nodes_without_data(self) -> dict[str, list[float]]:
        """Nodes in mm by axis that no reading affects."""
        found = {}
        for axis, name in enumerate(AXES):
            basis = self.problem.parameters.basis(axis, np.unique(self.lengths.position_mm[:, axis]))
            empty = np.abs(basis).max(axis=0) < 1e-12
            found[name] = self.machine.axes[axis].nodes_mm[empty].tolist()
        return {name: nodes for name, nodes in found.items() if nodes}


def planned(machine: Machine, stations: PlannedStations, points: Points, noise: ReadingNoise) -> Planned:
    """Set up the problem of a planned measurement: every station reads every point once in each of its passes.

    Raises
    ------
    InputError
        for a point outside the travel, or a station at a point.
    """
    check_travel(machine, points.position_mm)
    count, passes = len(points), len(stations.passes)
    tool = tool_of(machine, points.tool_mm)
    several = tool.ndim == 2 and bool(np.any(np.ptp(tool, axis=0) > 1e-9))
    if tool.ndim == 2 and not several:
        tool = tool[0]
    names = modelled_errors(machine, np.unique(tool, axis=0) if several else None)
    station, setup = np.repeat(stations.passes, count, axis=0).T
    position_mm = np.tile(points.position_mm, (passes, 1))
    tools = np.tile(tool, (passes, 1)) if several else tool
    distance = np.linalg.norm(position_mm + tools - stations.position_mm[station], axis=1)
    lengths = Lengths(
        stations=stations.names,
        station=station,
        point=[str(k + 1) for k in range(count)] * passes,
        position_mm=position_mm,
        length_mm=distance,
        tool_mm=tools if several else np.broadcast_to(tools, position_mm.shape),
        labels={"setup": setup},
    )
    layout = error_parameters(machine, names, several_tools=several)
    problem = grid_problem(layout, position_mm, tools, station, dead_lengths_of(lengths), distance)
    found = Planned(machine, stations, noise, lengths, problem or length_problem(machine, lengths, layout), tools)
    nearest = int(np.argmin(found.distances_mm()))
    if found.distances_mm()[nearest] < NEAREST_MM:
        where = ", ".join(f"{value:g}" for value in position_mm[nearest])
        raise InputError(
            Message(
                "station-at-target",
                "station {names!r} coincides with the target at ({where}) mm; move it",
                names=stations.names[station[nearest]],
                where=where,
            )
        )
    return found


@dataclass(frozen=True)
class Prediction:
    """What a normal matrix says about the unknowns.

    ``scale`` (size,) gives the matrix a unit diagonal, ``eigenvalues`` (size,) and ``vectors`` (size, size) are those
    of the scaled matrix; directions with an eigenvalue below the limit are undetermined.
    """

    scale: FloatArray
    eigenvalues: FloatArray
    vectors: FloatArray

    @property
    def null(self) -> NDArray[np.bool_]:
        """Which directions have no data, (size,)."""
        return np.asarray(self.eigenvalues < ZERO_EIGENVALUE)

    @cached_property
    def factor(self) -> FloatArray:
        """F (size, rank) with F F^T the covariance of the determined part, mm and rad."""
        kept = ~self.null
        return np.asarray(self.scale[:, None] * self.vectors[:, kept] / np.sqrt(self.eigenvalues[kept]))

    def of(self, unknowns: slice) -> Prediction:
        """Return the prediction of a part of the unknowns."""
        return Prediction(self.scale[unknowns], self.eigenvalues, self.vectors[unknowns])

    def u(self, rows: FloatArray) -> FloatArray:
        """Standard uncertainty of linear functions of the unknowns, rows (..., size): shape (...,), nan if undetermined."""
        spread = rows @ self.factor
        u = np.sqrt(np.einsum("...k,...k->...", spread, spread))
        if self.null.any():
            scaled = rows * self.scale
            lost = np.linalg.norm(scaled @ self.vectors[:, self.null], axis=-1)
            u = np.where(lost > UNDETERMINED_SHARE * np.linalg.norm(scaled, axis=-1), np.nan, u)
        return np.asarray(u)


def predict_unknowns(matrix: FloatArray) -> Prediction:
    """Return the prediction of a normal matrix (size, size)."""
    diagonal = np.diag(matrix)
    empty = diagonal <= 1e-14 * np.median(diagonal[diagonal > 0])
    scale = 1.0 / np.sqrt(np.where(empty, 1.0, diagonal))
    scaled = np.where(empty[:, None] | empty, 0.0, matrix * scale * scale[:, None])
    return Prediction(scale, *np.linalg.eigh(scaled))


def planned_rank(found: Planned, matrix: FloatArray) -> Rank:
    """Return the rank with the combinations in words."""
    lengths = found.lengths
    names = unknown_names(found.problem.parameters, lengths.stations, lengths.station, dead_lengths_of(lengths))
    return describe_rank(matrix, names)


# What a measurement will determine, and how well, before it is made.


#: Points of the volume whose rows of C B are computed together; enough points to rank candidates.
CHUNK_POINTS, FEW_POINTS = 1024, 200


@dataclass(frozen=True)
class VolumeUncertainty:
    """Standard uncertainty of E = C P over the grid of nodes and the middles between them, reference point fixed.

    With a prior it includes what nobody measures, and what the curves do between the readings.

    Parameters
    ----------
    position_mm : the points, shape (n, 3).
    u_mm : standard uncertainty of each component, shape (n, 3), nan if undetermined (without a prior only).
    """

    position_mm: FloatArray
    u_mm: FloatArray

    @property
    def total_mm(self) -> FloatArray:
        """Root of the sum of the squares of the three components, (n,)."""
        return np.asarray(np.sqrt(np.sum(self.u_mm**2, axis=1)))

    @property
    def worst_um(self) -> float:
        """Largest total in um; infinite if a point is undetermined."""
        return float(self.total_mm.max()) / MM_PER_UM if np.isfinite(self.u_mm).all() else np.inf

    @property
    def rms_um(self) -> float:
        """Root mean square of the total in um; infinite if a point is undetermined."""
        return float(np.sqrt(np.mean(self.total_mm**2))) / MM_PER_UM if np.isfinite(self.u_mm).all() else np.inf

    def summary(self) -> dict[str, Any]:
        """Return the object ``volume`` of ``plan.json``; None if a point is undetermined."""
        open_points = ~np.isfinite(self.u_mm).all(axis=1)
        report: dict[str, Any] = {"points": len(self.u_mm), "undetermined_points": int(np.count_nonzero(open_points))}
        whole = not open_points.any()
        for k, axis in enumerate("xyz"):
            report[f"u_{axis}_max_um"] = float(self.u_mm[:, k].max()) / MM_PER_UM if whole else None
            report[f"u_{axis}_rms_um"] = float(np.sqrt(np.mean(self.u_mm[:, k] ** 2))) / MM_PER_UM if whole else None
        report["u_max_um"] = self.worst_um if whole else None
        report["u_rms_um"] = self.rms_um if whole else None
        report["worst_at_mm"] = self.position_mm[int(np.argmax(self.total_mm))].tolist() if whole else None
        return report


@dataclass(frozen=True, repr=False)
class Plan(Drawable):
    """What a planned measurement determines.

    Parameters
    ----------
    planned : the measurement.
    rank : numerical rank, condition and the combinations without data in words.
    nodes_without_data : nodes in mm by axis that no reading affects.
    errors : zero values with the predicted standard uncertainties; of values that the readings do not determine that of the
        posterior, without a prior nan.
    volume : uncertainty of E over the working volume.
    from_readings : the part of it that the noise of the readings makes, which depends on stations and points; the curves
        are taken as straight between their nodes. Without a prior it is the same as ``volume``.
    open_errors : errors that the readings alone do not determine at every node.
    posterior : what will be known of every error; None without a prior.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> stations = compgen.planned_stations({"A": (-900, -1100, -400), "B": (100, -1100, -400), "C": (100, 100, -300)})
    >>> grid = np.meshgrid(*(axis.nodes_mm for axis in machine.axes), indexing="ij")
    >>> points = compgen.Points(np.column_stack([item.ravel() for item in grid]))
    >>> predicted: compgen.Plan = compgen.plan(machine, stations, points)
    >>> predicted
    <Plan: 3993 readings, rank 149 of 149: everything is determined>
    """

    planned: Planned
    rank: Rank
    nodes_without_data: dict[str, list[float]]
    errors: ErrorTable
    volume: VolumeUncertainty
    from_readings: VolumeUncertainty
    open_errors: tuple[str, ...] = ()
    posterior: Posterior | None = None

    @property
    def readings(self) -> int:
        """Number of readings."""
        return len(self.planned.lengths)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the measurement is insufficient, in words; empty if everything is determined."""
        found = list(self.rank.combinations) if self.rank.rank < self.rank.size else []
        if not found and self.readings <= self.rank.size:
            found.append(f"{self.readings} readings for {self.rank.size} unknowns leave no redundancy for a check")
        return tuple(found)

    @property
    def determined(self) -> bool:
        """Whether the measurement determines every unknown."""
        return not self.reasons

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``plan.json``."""
        stations, noise, curves = self.planned.stations, self.planned.noise, {}
        for name, curve in self.errors.curves.items():
            error, known = error_named(name), bool(np.isfinite(curve.u).all())
            curves[name] = {
                "unit": error.unit,
                "determined": name not in self.open_errors,
                "u_max": float(curve.u.max()) / error.si_per_unit if known else None,
                "at_mm": float(curve.position_mm[int(np.argmax(curve.u))]) if known else None,
            }
        return {
            "determined": self.determined,
            "reasons": list(self.reasons),
            "machine": self.planned.machine.name,
            "stations": [
                {"station": name, "position_mm": place.tolist()}
                for name, place in zip(stations.names, stations.position_mm, strict=True)
            ],
            "passes": len(stations.passes),
            "points": self.readings // len(stations.passes),
            "readings": self.readings,
            "rank": self.rank.rank,
            "unknowns": self.rank.size,
            "undetermined_directions": self.rank.size - self.rank.rank,
            "condition": self.rank.condition,
            "nodes_without_data": self.nodes_without_data,
            "u_length": {
                "source": noise.source,
                "constant_um": noise.constant_um,
                "proportional_um_per_m": noise.proportional_um_per_m,
            },
            "curves": curves,
            "squareness": {
                name: {"unit": "urad", "u": _known(u * 1e6)} for name, (_, u) in self.errors.squareness.items()
            },
            "volume": self.volume.summary(),
            "volume_from_readings": self.from_readings.summary(),
            "prior": (self.planned.machine if self.posterior is None else self.posterior).prior.as_dict(),
            **({} if self.posterior is None else {"assumed": assumed_text(self.posterior)}),
        }

    def overview(self) -> Overview:
        """Whether everything is determined, and the largest standard uncertainty of each error."""
        found = "everything is determined" if self.determined else "not everything is determined"
        title = f"{self.readings} readings, rank {self.rank.rank} of {self.rank.size}: {found}"
        rows = tuple((name, known, unit) for name, _, _, known, unit in self.errors.overview().rows)
        return Overview(title, ("error", "u (k = 1)", "unit"), rows, self.reasons)

    def panels(self) -> Sequence[Panel]:
        """The predicted standard uncertainty of each curve, as a band about zero."""
        return self.errors.panels()


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def plan(machine: Machine, stations: PlannedStations, points: Points, options: IdentifyOptions | None = None) -> Plan:
    """Predict what a measurement will determine, and with which standard uncertainty.

    Parameters
    ----------
    machine : chain, nodes, and which errors its model contains.
    stations : any number of them; with one or two the remaining ambiguity is reported.
    points : commanded points; a point listed twice is read twice.
    options : standard uncertainty of a reading.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> stations = compgen.planned_stations({"A": (-900, -1100, -400), "B": (100, -1100, -400), "C": (100, 100, -300)})
    >>> grid = np.meshgrid(*(axis.nodes_mm for axis in machine.axes), indexing="ij")
    >>> points = compgen.Points(np.column_stack([item.ravel() for item in grid]))
    >>> compgen.plan(machine, stations, points).determined
    True
    """
    of_kind("machine", machine, Machine)
    of_kind("stations", stations, PlannedStations)
    of_kind("points", points, Points)
    with one_thread():
        return plan_of(planned(machine, stations, points, planned_noise(options)))


def planned_noise(options: IdentifyOptions | None = None) -> ReadingNoise:
    """Return the uncertainty of a planned reading: the stated one, otherwise the usual one of a laser tracer."""
    nothing = np.zeros(0)
    no_readings = Lengths((), nothing.astype(np.int64), (), nothing.reshape(0, 3), nothing)
    return reading_noise(no_readings, options or IdentifyOptions())


def plan_of(found: Planned) -> Plan:
    """Return the plan of a measurement that has been set up."""
    matrix = found.normal_matrix(found.stations.position_mm)
    rank, prediction = planned_rank(found, matrix), predict_unknowns(matrix)
    of_errors = prediction.of(slice(0, found.problem.parameters.size))
    table = table_of_values(
        (name, position_mm, np.zeros(len(position_mm)), prediction.of(columns).u(matrix))
        for name, position_mm, columns, matrix in error_values(found.problem.parameters)
    )
    machine, lost = found.machine, np.isnan(table.uncertainties())
    names, at_mm = table.labels()
    posterior = _planned_posterior(found, of_errors, full=not lost.any() and rank.rank == rank.size)
    from_readings = _from_readings(found, of_errors)
    volume = from_readings if posterior is None else volume_of(machine, posterior)
    if posterior is not None and lost.any():
        table = table.with_values(u=np.where(lost, _assumed_u(posterior, names, at_mm), table.uncertainties()))
    metadata = {
        "machine": machine.name,
        "source": "compgen plan",
        "values": "zero, only u_value is predicted",
        "reference_point_mm": " ".join(f"{value:g}" for value in machine.reference_point_mm),
    }
    open_errors = tuple(dict.fromkeys(name for name, missing in zip(names, lost.tolist(), strict=True) if missing))
    errors = table.replace(metadata=metadata)
    return Plan(found, rank, found.nodes_without_data(), errors, volume, from_readings, open_errors, posterior)


def _from_readings(found: Planned, of_errors: Prediction) -> VolumeUncertainty:
    """What the noise of the readings makes of u(E), the curves taken as straight between their nodes."""
    grid = _grid_mm(found.machine)
    chunks = [grid[k : k + CHUNK_POINTS] for k in range(0, len(grid), CHUNK_POINTS)]
    return VolumeUncertainty(grid, np.concatenate([of_errors.u(found.error_rows(chunk)) for chunk in chunks]))


def _grid_mm(machine: Machine, most: int = MOST_POINTS) -> FloatArray:
    nodes = [axis.nodes_mm for axis in machine.axes]
    return volume_grid(machine, (nodes[0], nodes[1], nodes[2]), most).position_mm


def volume_of(machine: Machine, posterior: Posterior, most: int = MOST_POINTS) -> VolumeUncertainty:
    """Return u(E) over the volume of a machine, at ``most`` points, from what is known of every error."""
    grid = _grid_mm(machine, most)
    chunks = [grid[k : k + CHUNK_POINTS] for k in range(0, len(grid), CHUNK_POINTS)]
    return VolumeUncertainty(grid, np.concatenate([np.sqrt(posterior.field(chunk).variance) for chunk in chunks]))


def _assumed_u(posterior: Posterior, names: Sequence[str], at_mm: FloatArray) -> FloatArray:
    """Standard uncertainty of error values (k,) in the posterior; nan for errors that it does not contain."""
    label, found = np.array(names), np.full(len(names), np.nan)
    for name in posterior.names:
        own = label == name
        if own.any():
            found[own] = posterior.curve(name, at_mm[own]).u
    return found


def _planned_posterior(found: Planned, of_errors: Prediction, *, full: bool) -> Posterior | None:
    """What identification of the lengths would know of every error; None without a prior.

    As there, lengths at the nodes that determine everything enter as the errors that they determine, others one by one.
    """
    machine = found.machine
    if machine.prior.is_none:
        return None
    position_mm = found.lengths.position_mm
    if full and at_nodes(machine, position_mm):
        values = [
            (name, at, of_errors.of(columns), rows)
            for name, at, columns, rows in error_values(found.problem.parameters)
        ]
        names = [name for name, at, _, _ in values for _ in at]
        factor = np.vstack([rows @ part.factor for _, _, part, rows in values])
        return posterior_of_values(
            machine, names, np.concatenate([at for _, at, _, _ in values]), np.zeros(len(names)), factor
        )
    levels = [reading_levels(axis, position_mm[:, k]) for k, axis in enumerate(machine.axes)]
    layout = state_layout(machine, levels, state_names(machine))
    spans = np.column_stack([position_mm.min(axis=0), position_mm.max(axis=0)])
    learn = not full or machine.prior.learn in ("up", "both")
    return solve_posterior(machine, layout, [_information(found, layout)], spans, learn=learn)


def _information(found: Planned, layout: ErrorParameters) -> Information:
    """What the lengths say about the unknowns of a layout, stations and dead lengths eliminated; they say zero."""
    lengths, groups = found.lengths, dead_lengths_of(found.lengths)
    finer = layout.machine
    problem = grid_problem(layout, lengths.position_mm, found.tool_mm, lengths.station, groups, found.distances_mm())
    state = State(np.zeros(layout.size), found.stations.position_mm, np.zeros(found.problem.groups))
    weight = 1.0 / found.noise.sigma_mm(found.distances_mm()) ** 2
    matrix = (problem or length_problem(finer, lengths, layout)).weighted(weight).normal_matrix(state)
    errors, others = slice(0, layout.size), slice(layout.size, None)
    values, directions = np.linalg.eigh(matrix[others, others])
    used = values > ZERO_EIGENVALUE * values[-1]
    shared = (directions[:, used] / np.sqrt(values[used])).T @ matrix[others, errors]
    reduced = matrix[errors, errors] - shared.T @ shared
    freedom = len(lengths) - int(np.count_nonzero(used))
    return Information(0.5 * (reduced + reduced.T), np.zeros(layout.size), 0.0, freedom)


# Effects of the catalogue that a planned measurement cannot show, and what to measure in addition.


#: Time between two stops and feed of a plan that does not state them; it only matters that they are constant.
STOP_S = 10.0
FEED_MM_MIN = 1000.0
CHUNK_READINGS = 2048
#: Warming of every channel over a plan without temperatures, K; it only matters that they warm together.
WARMING_K = 1.0


@dataclass(frozen=True)
class PlanVisibility:
    """Visible fractions, hidden effects with the reason, effects that look alike.

    Parameters
    ----------
    parts : visible part of every effect whose columns the plan provides.
    hidden : why an effect does not show at all, by name.
    pairs : effects that cannot be distinguished.
    cards : cards of the effects.
    assumed : what the plan does not state and was assumed, in words.
    """

    parts: dict[str, VisiblePart]
    hidden: dict[str, str]
    pairs: list[Pair]
    cards: dict[str, Card]
    assumed: list[str]

    @property
    def never(self) -> dict[str, str]:
        """Effects that the plan cannot show, with the reason."""
        faint = {
            name: f"visible fraction {part.fraction:.3f}: the errors of the machine, stations and dead lengths imitate it"
            for name, part in self.parts.items()
            if part.fraction < INVISIBLE
        }
        return {**self.hidden, **faint}

    def summary(self) -> dict[str, Any]:
        """Return the object ``visibility`` of ``plan.json``."""
        return {
            "assumed": self.assumed,
            "fractions": {name: round(part.fraction, 4) for name, part in self.parts.items()},
            "never": [
                {"name": name, "reason": reason, "measure": self.cards[name].breaker}
                for name, reason in self.never.items()
            ],
            "alike": [
                {
                    "names": list(pair.names),
                    "correlation": round(pair.correlation, 4),
                    "shared_directions": pair.shared,
                    "directions": pair.directions,
                    "measure": separating(*(self.cards[name] for name in pair.names)),
                }
                for pair in self.pairs
            ],
        }


def plan_visibility(found: Planned, points: Points) -> PlanVisibility:
    """Project errors, stations and dead lengths of this plan out of every effect of the catalogue.

    The points are visited in their order. What they do not state is assumed: one feed, equal times, temperatures that
    rise together; the result says so.
    """
    readings, assumed = _readings(found, points)
    modelled = modelled_errors(found.machine)
    chosen, hidden, cards = {}, {}, {}
    logged = {*readings.covariates, *readings.labels, "station", "approach_x", "approach_y", "approach_z"}
    for name, effect in catalogue(found.stations.names).items():
        if isinstance(effect, SignError | Squareness):
            missing = effect.displacement(readings) is not None  # otherwise the sign has no meaning on this chain
        else:
            missing = effect.card.name.removeprefix("lever_") not in modelled
        if "lengths" not in effect.card.kinds or not missing:
            continue
        cards[name] = effect.card
        columns = _columns(effect, readings)
        if columns is None:
            of_one = "tool offset" if name.startswith("lever_") else "set-up" if name == "tool_offset_error" else ""
            lacking = [key for key in effect.card.covariates if key not in logged]
            hidden[name] = f"the plan has no {', '.join(lacking)}" if lacking else "it does not vary in this plan"
            hidden[name] = f"one {of_one}" if of_one else hidden[name]
        else:
            chosen[name] = columns
    gram, base, where = _gram(found, readings, chosen)
    parts = visible_parts(gram, base, where)
    seen = {name: part for name, part in parts.items() if part.fraction >= INVISIBLE}
    return PlanVisibility(parts, hidden, alike_pairs(gram, base, seen), cards, assumed)


def _columns(effect: Effect, readings: Readings) -> FloatArray | None:
    """Return the columns of an effect at the middle of its scan positions."""
    positions = list(effect.positions(readings))
    fixed = effect.at(positions[len(positions) // 2]) if positions else effect
    columns = fixed.columns(readings)
    return None if columns is None or not np.any(columns) else columns


def _readings(found: Planned, points: Points) -> tuple[Readings, list[str]]:
    """The planned readings with covariates, and what was assumed."""
    lengths, count = found.lengths, len(points)
    passes = found.stations.passes[:, 0]
    stop = np.tile(np.arange(count), len(passes))
    own_pass = np.repeat([np.count_nonzero(passes[:k] == station) for k, station in enumerate(passes)], count)
    covariates, assumed = _covariates(points)
    covariates = {name: values[stop] for name, values in covariates.items()}
    covariates["time_s"] = np.asarray(covariates["time_s"] + own_pass * count * STOP_S, dtype=np.float64)
    approach = points.approach
    if approach is None:
        approach = approach_of(np.diff(points.position_mm, axis=0, prepend=points.position_mm[:1]))
        assumed.append("points are visited in the order of the file")
    setup = lengths.labels["setup"] if "setup" not in points.covariates else points.covariates["setup"][stop]
    tool_mm = np.broadcast_to(found.tool_mm, lengths.position_mm.shape)
    line_mm = lengths.position_mm + tool_mm - found.stations.position_mm[lengths.station]
    range_mm = np.asarray(np.linalg.norm(line_mm, axis=1), dtype=np.float64)
    readings = Readings(
        machine=found.machine,
        kind="lengths",
        position_mm=lengths.position_mm,
        direction=line_mm / range_mm[:, None],
        tool_mm=tool_mm,
        stations=found.stations.names,
        station=lengths.station,
        range_mm=range_mm,
        approach=approach[stop],
        covariates=covariates,
        labels={"setup": setup.astype(np.int64)},
    )
    return readings, assumed


def _covariates(points: Points) -> tuple[dict[str, FloatArray], list[str]]:
    logged = {name: values for name, values in points.covariates.items() if name != "setup"}
    assumed: list[str] = []
    if "time_s" not in logged:
        logged["time_s"] = STOP_S * np.arange(len(points), dtype=np.float64)
        assumed.append("stops follow at equal intervals, and all stations read simultaneously")
    if "feed_mm_min" not in logged:
        logged["feed_mm_min"] = np.full(len(points), FEED_MM_MIN)
        assumed.append("one feed")
    if not any(name.startswith("temp_") for name in logged):
        warming = np.asarray(WARMING_K * np.linspace(0.0, 1.0, len(points)))
        names = ("x", "y", "z", "spindle", "ambient", "column_front")
        logged |= {f"temp_{name}_c": 20.0 + warming for name in names}
        logged["temp_column_rear_c"] = np.full(len(points), 20.0)
        assumed.append("temperatures are logged and rise together during the measurement")
    if "load_kg" not in logged:
        assumed.append("one load")
    return logged, assumed


def _gram(
    found: Planned, readings: Readings, chosen: dict[str, FloatArray]
) -> tuple[FloatArray, int, dict[str, slice]]:
    """Return the Gram matrix of the base Jacobian and the columns of the effects, readings in units of their uncertainty."""
    where, start = {}, 0
    for name, columns in chosen.items():
        where[name] = slice(start, start + columns.shape[1])
        start += columns.shape[1]
    names = modelled_errors(found.machine)  # those of one tool: what other tools show is an effect here
    layout = error_parameters(found.machine, names)
    keys = np.column_stack([readings.station, readings.labels["setup"], found.lengths.labels["setup"]])
    _, group = np.unique(keys, axis=0, return_inverse=True)
    weight = 1.0 / found.noise.sigma_mm(readings.range_mm)
    size = layout.size + 3 * len(readings.stations) + int(group.max()) + 1
    gram = np.zeros((size + start, size + start))
    for first in range(0, len(readings), CHUNK_READINGS):
        rows = slice(first, first + CHUNK_READINGS)
        moved = found.error_rows(readings.position_mm[rows], layout, readings.tool_mm[rows])
        errors = np.einsum("nd,ndp->np", readings.direction[rows], moved)
        # derivative of the readings by stations and dead lengths
        station = readings.station[rows]
        each, placing = np.arange(len(station)), np.zeros((len(station), size - layout.size))
        for axis in range(3):
            placing[each, 3 * station + axis] = -readings.direction[rows, axis]
        placing[each, 3 * len(readings.stations) + group.ravel()[rows]] = -1.0
        block = np.hstack([errors, placing, *(columns[rows] for columns in chosen.values())]) * weight[rows, None]
        gram += block.T @ block
    return gram, size, where
