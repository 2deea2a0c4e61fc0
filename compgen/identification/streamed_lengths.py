"""Errors from an archive of tracer lengths, of any size: the normal equations are accumulated chunk by chunk.

A sample of the readings is identified first, like a separate file: with rank, gross errors, tests of the residuals and
all warnings. All readings are used from its optimum on: passes over the archive, chunk by chunk, accumulate cost,
gradient and normal matrix until no unknown changes. So the required memory does not depend on the number of readings.

The sample alone provides the kept residuals, and the tests on the order of the readings (whiteness, misfit and its
causes, weak errors). A gross error is a reading beyond the robust limit at the optimum; beam breaks get no separate
dead length, and the readings after one are rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.length_archive import CHUNK, LengthArchive
from compgen.data.lengths import MOST_WHOLE, Lengths
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.data.records import POSITION_COLUMNS
from compgen.errors import ConvergenceError, InputError, Message
from compgen.identification.adjust.path_problem import Chunk, DistanceNoise, PathModel, Sums, chunk_of, path_model
from compgen.identification.adjust.problem import LengthProblem
from compgen.identification.adjust.propagation import SystematicInputs
from compgen.identification.adjust.residual_tests import residual_series
from compgen.identification.adjust.robust import LIMIT, MOST_REJECTED, Rejected, standardised_spread
from compgen.identification.adjust.solver import Factor, Rank, determined_factor, step_levers, unknown_names
from compgen.identification.adjust.unknowns import (
    ErrorParameters,
    IntArray,
    State,
    check_travel,
    common_tool,
    distinct_poses,
)
from compgen.identification.options import IdentifyOptions
from compgen.identification.reference_conditions import reading_conditions
from compgen.identification.result import (
    Identification,
    error_table,
    judged,
    station_results,
    uncertainty_scale,
    worst_uncertainty,
)
from compgen.identification.tracer_lengths import identify
from compgen.kinematics.kernel_switch import one_thread, use_compiled

#: The remaining distance to the optimum, estimated from the last two steps, that ends the passes, mm.
TOLERANCE_MM = 1e-8
MOST_PASSES = 12
#: Number of rejected readings that are listed; the others are counted.
MOST_NAMED = 1000


@dataclass(frozen=True)
class _Stream:
    """The archive with its unknowns; ``setups`` (G, 2) are station and set-up of each dead length.

    ``model`` is the compiled form; without it every chunk is a separate problem.
    """

    archive: LengthArchive
    layout: ErrorParameters
    tool_mm: FloatArray
    setups: IntArray
    model: PathModel | None

    def chunks(self) -> Iterator[Chunk]:
        """Readings in memory at a time."""
        columns = self.archive.columns
        most = int(self.setups[:, 1].max()) + 1
        for rows in self.archive.chunks():
            station = group = np.asarray(columns["station"][rows], dtype=np.int64)
            if "setup" in columns:
                setup = columns["setup"][rows]
                group = np.searchsorted(self.setups @ (most, 1), station * most + setup)
                group = np.minimum(group, len(self.setups) - 1)
                for row in np.flatnonzero((self.setups[group] != np.stack([station, setup], axis=1)).any(axis=1))[:1]:
                    name = self.archive.stations[int(station[row])]
                    message = f"setup {setup[row]} of station {name!r} has so few readings that the sample contains none of them"
                    raise InputError(
                        Message("remove-readings-hint", "{message}; remove them", message=message),
                        file=self.archive.path,
                        field="setup",
                    )
            x, y, z = (columns[name][rows] for name in POSITION_COLUMNS)
            yield chunk_of((x, y, z), station, group, columns["length_mm"][rows])

    def sums(self, state: State, noise: DistanceNoise, rejected: list[tuple[int, float]], *, matrix: bool) -> Sums:
        """Pass over all readings; ``rejected`` gets row and residual of some that are not used."""
        rejected.clear()
        first = 0

        def look(chunk: Chunk, residual: FloatArray) -> None:
            nonlocal first
            if len(rejected) < MOST_NAMED and np.isnan(residual.sum()):
                for row in np.flatnonzero(np.isnan(residual))[: MOST_NAMED - len(rejected)].tolist():
                    position = np.array([[along[row] for along in chunk.position_mm]])
                    sight = self.layout.tips(state.errors, position, self.tool_mm)[0]
                    distance = float(np.linalg.norm(sight - state.stations_mm[chunk.station[row]]))
                    reading = float(chunk.length_mm[row] + state.dead_length_mm[chunk.group[row]])
                    rejected.append((first + row, distance - reading))
            first += len(residual)

        if self.model is not None:
            weight, room = np.ones(CHUNK), np.empty(CHUNK)
            sized = ((chunk, weight[: len(chunk.group)], room[: len(chunk.group)]) for chunk in self.chunks())
            return self.model.sums(state, sized, noise, matrix=matrix, look=look)
        size = self.layout.size + 3 * len(self.archive.stations) + len(self.setups)
        total = Sums(np.zeros(size), np.zeros((len(self.setups), 3)), np.zeros((size, size)) if matrix else None)
        for chunk in self.chunks():
            self._add_plain(total, chunk, state, noise, look)
        return total

    def _add_plain(
        self, total: Sums, chunk: Chunk, state: State, noise: DistanceNoise, look: Callable[[Chunk, FloatArray], None]
    ) -> None:
        """Add a chunk without compiled code: its normal equations are those of a separate problem."""
        count, stations = len(chunk.group), len(self.archive.stations)
        poses = distinct_poses(np.column_stack(chunk.position_mm), self.tool_mm)
        where = self.layout.bases(poses.position_mm), poses.position_mm, poses.tool_mm, poses.of
        what = chunk.station, chunk.group, chunk.length_mm, np.ones(count)
        problem = LengthProblem(self.layout, *where, *what, numbers=(stations, len(self.setups)))
        residual = problem.residuals(state)
        sigma = noise.constant_mm + noise.proportional * (
            residual + chunk.length_mm + state.dead_length_mm[chunk.group]
        )
        used = np.abs(residual) <= noise.limit * sigma
        weight = np.where(used, (noise.scale_mm / sigma) ** 2, 0.0)
        cost, gradient = problem.weighted(weight).evaluate(state)
        total.cost += cost
        total.gradient += gradient
        if total.matrix is not None:
            total.matrix += problem.weighted(weight).normal_matrix(state)
        for k, values in enumerate((used.astype(np.float64), np.where(used, residual**2, 0.0), weight)):
            total.by_group[:, k] += np.bincount(chunk.group, values, len(self.setups))
        look(chunk, np.where(used, residual, np.nan))

    def optimum(self, state: State, noise: DistanceNoise) -> _Optimum:
        """Gauss-Newton with one normal matrix, made in the first pass, until no unknown changes and the used readings stay."""
        archive, layout, setups, count = self.archive, self.layout, self.setups, len(self.archive)

        def names() -> list[str]:
            return unknown_names(layout, archive.stations, setups[:, 0], np.arange(len(setups)))

        rejected: list[tuple[int, float]] = []
        sums = self.sums(state, noise, rejected, matrix=True)
        assert sums.matrix is not None
        factor, rank = determined_factor(sums.matrix, names, "the readings")
        levers, previous, used = step_levers(layout, len(sums.gradient)), np.inf, -1.0
        for passes in range(1, MOST_PASSES + 1):
            before, used = used, float(sums.by_group[:, 0].sum())
            if count - used > MOST_REJECTED * count:
                break
            step = -factor.solve(sums.gradient)
            length = float(np.max(np.abs(step) * levers))
            state = state.moved(step)
            if length * min(length / previous, 1.0) < TOLERANCE_MM and used == before:
                return _Optimum(self, noise, state, factor, rank, sums, rejected, passes)
            previous, sums = length, self.sums(state, noise, rejected, matrix=False)
        raise ConvergenceError(
            Message(
                "readings-misfit-sample",
                "{count:.0f} of {count2} readings do not fit the model of a sample of them; look for "
                "beam breaks (readings after one need a separate setup), and check station labels "
                "and units",
                count=count - used,
                count2=count,
            )
        )


def identify_archive(
    machine: Machine, archive: LengthArchive, options: IdentifyOptions | None = None
) -> Identification:
    """Identify the errors of a machine, the stations and the dead lengths from an archive of tracer lengths.

    The result is that of :func:`compgen.identification.identify`, but ``residual_mm`` and ``accepted`` are those of the sample.

    Raises
    ------
    InputError
        for options and corrections that require all readings at once, and for the reasons of
        :func:`compgen.identification.identify`.
    UndeterminedError
        if the readings do not determine the unknowns; it lists the combinations.
    ConvergenceError
        if no optimum is reached, or too many readings do not fit the model.
    """
    chosen = options or IdentifyOptions()
    if chosen.method != "joint" or chosen.stations is not None or chosen.systematic != SystematicInputs():
        raise InputError(
            "--method, --stations and the systematic inputs need all readings in memory; an archive of more than "
            f"{MOST_WHOLE} readings cannot be combined with them: write some of its readings to another one",
            file=archive.path,
        )
    low, high = (np.array(ends) for ends in (machine.lower_mm, machine.upper_mm))

    def within(first: int, xyz_mm: list[FloatArray]) -> None:
        if any(one.min() < low[k] or one.max() > high[k] for k, one in enumerate(xyz_mm)):
            lines = archive.lines(slice(first, first + len(xyz_mm[0]))).tolist()
            origin = [(str(archive.path), line) for line in lines]
            check_travel(machine, np.column_stack(xyz_mm), origin)

    archive.check(within)
    sample = archive.taken(archive.sample_rows)
    if "u_length_um" in sample.covariates:
        message = (
            f"is a column; an archive of more than {MOST_WHOLE} readings has a single u_length_um and u_length_um_per_m"
        )
        raise InputError(message, file=archive.path, field="u_length_um")
    _, conditions = reading_conditions(machine, sample, temperature=chosen.temperature)
    if conditions.needs_geometry or conditions.notes:
        raise InputError(
            Message(
                "archive-needs-correction",
                "needs a correction for temperature, air or effects of the machine file, which an "
                "archive of more than {value} readings does not support; correct the readings "
                "beforehand, or write some of them to another archive",
                value=MOST_WHOLE,
            ),
            file=archive.path,
        )
    found = identify(machine, sample, chosen)
    with one_thread():
        return _with_all(machine, archive, sample, found, reject=chosen.reject)


@dataclass(frozen=True)
class _Optimum:
    """The end of the passes over all readings, with the sums there and the listed rejected readings."""

    stream: _Stream
    noise: DistanceNoise
    state: State
    factor: Factor
    rank: Rank | None
    sums: Sums
    rejected: list[tuple[int, float]]
    passes: int

    def identification(self, of_sample: Identification) -> Identification:
        """Return the identification of the sample with the values, uncertainties and counts of all readings."""
        assert of_sample.adjustment is not None
        archive, layout, scale_mm = self.stream.archive, self.stream.layout, self.noise.scale_mm
        readings, squares, _ = self.sums.by_group.T
        used, size = int(readings.sum()), len(self.sums.gradient)
        chi_square = 2.0 * self.sums.cost / scale_mm**2 / (used - size)
        u_scale = uncertainty_scale(chi_square, of_sample.u_source)
        adjustment = replace(of_sample.adjustment, state=self.state, factor=self.factor, sigma_mm=scale_mm * u_scale)
        errors = error_table(layout, self.state.errors, adjustment.covariance_factor()[: layout.size])
        errors = errors.replace(metadata=of_sample.errors.metadata)
        of_group = [(k, setup) for k, setup in self.stream.setups.tolist()]
        return replace(
            of_sample,
            errors=errors,
            stations=station_results(archive.stations, of_group, adjustment, layout.size, readings, squares),
            counted=(len(archive), used),
            rms_um=float(np.sqrt(squares.sum() / used)) / MM_PER_UM,
            degrees_of_freedom=used - size,
            reduced_chi_square=chi_square,
            u_scale=u_scale,
            rejected=tuple(_rejected(archive, row, off_mm) for row, off_mm in self.rejected),
            rank=size if self.rank is None else self.rank.rank,
            condition=1.0 / self.factor.rcond,
            iterations=self.passes,
            worst_u=worst_uncertainty(errors),
            adjustment=adjustment,
            details={
                "sample_readings": len(of_sample.residual_mm),
                "passes": self.passes,
                "robust_limit": self.noise.limit if np.isfinite(self.noise.limit) else None,
                "from_the_sample": "residuals, whiteness, causes of a misfit, beam breaks",
            },
        )


def _noise(sample: Lengths, found: Identification, *, reject: bool) -> DistanceNoise:
    """Uncertainty of a reading, and what is a gross error, as the identification of the sample shows them."""
    assert found.adjustment is not None
    constant_mm, proportional = found.u_length_um * MM_PER_UM, found.u_length_um_per_m * MM_PER_UM / 1000.0
    dead_length_mm = found.adjustment.state.dead_length_mm[found.adjustment.group]
    distance_mm = sample.length_mm + found.residual_mm + dead_length_mm
    standardised = found.residual_mm / (constant_mm + proportional * distance_mm)
    limit = LIMIT * standardised_spread(standardised) if reject else np.inf
    return DistanceNoise(constant_mm, proportional, found.adjustment.sigma_mm / found.u_scale, limit)


def _with_all(
    machine: Machine, archive: LengthArchive, sample: Lengths, found: Identification, *, reject: bool
) -> Identification:
    """Bring the identification of the sample to the optimum of all readings."""
    assert found.adjustment is not None
    if any(item.segment for item in found.stations):
        raise ConvergenceError(
            Message(
                "archive-beam-breaks",
                "the sample of the readings shows beam breaks, after which the dead length of a "
                "station differs; give the readings after each a separate setup",
            )
        )
    layout, tool_mm = found.layout, common_tool(machine, None)
    setups = np.array([(archive.stations.index(item.station), item.setup) for item in found.stations], dtype=np.int64)
    model = path_model(layout, tool_mm, setups[:, 0]) if use_compiled(len(archive), 0) else None
    noise = _noise(sample, found, reject=reject)
    stream = _Stream(archive, layout, tool_mm, setups, model)
    everything = stream.optimum(found.adjustment.state, noise).identification(found)
    kept, group = found.accepted, found.adjustment.group
    sigma_mm = np.full(np.count_nonzero(kept), noise.scale_mm)
    return judged(everything, lambda: residual_series(sample, kept, found.residual_mm[kept], sigma_mm, group[kept]))


def _rejected(archive: LengthArchive, row: int, off_mm: float) -> Rejected:
    station = archive.stations[int(archive.columns["station"][row : row + 1][0])]
    off_um = -off_mm / MM_PER_UM
    reason = f"differs from the model by {off_um:+.1f} um; beam break or disturbed reading?"
    line = int(archive.lines(slice(row, row + 1))[0])
    return Rejected(row, station, str(row + 1), off_um, reason, str(archive.path), line)
