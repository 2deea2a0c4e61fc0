"""The result of an identification: error curves, stations, uncertainties, and the contents of ``identify.json``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.machine import Machine
from compgen.data.names import ERROR_NAMES, MM_PER_UM, SQUARENESS_NAMES
from compgen.data.prior import DETERMINED
from compgen.drawing.display import Drawable, Overview, Panel, PlottedLine
from compgen.errors import UndeterminedError
from compgen.identification.adjust.propagation import Adjustment, Systematic
from compgen.identification.adjust.residual_tests import Misfit, ResidualSeries, Whiteness, misfit_of, warn_of_residuals
from compgen.identification.adjust.robust import Rejected, Segment
from compgen.identification.adjust.unknowns import ErrorParameters, error_parameters, state_names
from compgen.identification.reversal_errors import Reversal
from compgen.kinematics.first_order import observable_errors

if TYPE_CHECKING:
    from compgen.data.deviations import Deviations
    from compgen.identification.posterior import Posterior

# The result of an identification, and the contents of ``identify.json``.


#: Readings closer to a node than this are at it, mm.
AT_NODE_MM = 1e-2


@dataclass(frozen=True)
class StationResult:
    """One station and set-up: position and dead length with standard uncertainties, mm, and residual RMS in um.

    ``segment`` numbers the dead lengths that beam breaks added to it; 0 is the main one.
    """

    station: str
    setup: int
    position_mm: tuple[float, float, float]
    u_position_mm: tuple[float, float, float]
    dead_length_mm: float
    u_dead_length_mm: float
    readings: int
    rms_um: float
    segment: int = 0


@dataclass(frozen=True, repr=False, kw_only=True)
class Identification(Drawable):
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
    unobservable : combinations that are not in the model because they are not observable, in words.
    rejected : rejected readings, with the reason.
    segments : beam breaks: runs of readings with a separate dead length, or rejected together.
    reversal : mean difference between the directions of approach; None if no stop was approached from both sides.
    residual_tests : computes the tests of ``whiteness``.
    corrections : what was removed from the readings (temperature of the scales, wavelength, effects of the machine
        file).
    rank, unknowns, condition, iterations : of the least-squares problem.
    worst_u : largest standard uncertainty by unit ("um", "urad") with its error.
    layout : the unknown errors and their bases.
    adjustment : the optimum with its factor, for the joint covariance and for systematic inputs; None if there is none.
    systematic : contributions of systematic inputs, included in the standard uncertainties; None if there are none.
    method : "joint", "two-step", "sixdof" for readings of the six-DOF instrument (the residuals are translations about
        the mean of their position), "merged" for those and others, "axis-runs" for
        runs along single axes, "circles" for circular tests, "artefact","together" for a mixture of these, "given" for errors of
        another program (no residuals), or "deviations" where measured positions were given instead of lengths; then the
        residuals are those of the components dx, dy, dz, and ``u_length_um`` is their standard uncertainty.
    steps : figures of the single steps of the two-step method.
    positions : the positions measured by it in the machine frame, and the commanded ones.
    values_factor : without an adjustment: F (k, r) with F F^T the covariance of the error values in the order of the
        errors file, mm and rad; None if there is none.
    reversal_curves : reversals over the position of each axis, if the instrument shows them.
    details : additional figures of the method.
    objections : why no result from these errors may be accepted; empty if there is no such reason.
    doubts : why a result from these errors is accepted with reservations only.
    notes : what these readings cannot show although it would make the errors wrong, and which check would show it.
    posterior_source : computes ``posterior``.
    misfit : whether the residuals exceed their uncertainty, and what explains them; None if the method does not use an
        uncertainty of the readings.
    counted : number of readings and of used readings, if ``residual_mm`` and ``accepted`` are those of a sample.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> lengths = compgen.read_lengths("examples/zha-gantry.lengths.csv")
    >>> found: compgen.Identification = compgen.identify(machine, lengths)
    >>> found
    <Identification: 17 errors from 10648 of 10648 readings (joint), residual 0.279 um rms, reduced chi-square 0.999>
    >>> found.rank, found.unknowns, [item.station for item in found.stations]
    (153, 153, ['LT1', 'LT2', 'LT3', 'LT4'])
    """

    errors: ErrorTable
    stations: tuple[StationResult, ...] = ()
    residual_mm: FloatArray
    accepted: NDArray[np.bool]
    rms_um: float
    degrees_of_freedom: int
    reduced_chi_square: float
    u_source: str
    u_length_um: float
    u_length_um_per_m: float = 0.0
    u_scale: float = 1.0
    unobservable: tuple[str, ...]
    rejected: tuple[Rejected, ...] = ()
    rank: int
    unknowns: int
    condition: float = 1.0
    iterations: int = 1
    worst_u: dict[str, tuple[float, str]]
    layout: ErrorParameters
    adjustment: Adjustment | None = None
    segments: tuple[Segment, ...] = ()
    reversal: Reversal | None = None
    residual_tests: Callable[[], Whiteness] | None = field(default=None, repr=False)
    corrections: Mapping[str, Any] = field(default_factory=dict)
    systematic: Systematic | None = None
    method: str = "joint"
    steps: Mapping[str, Any] = field(default_factory=dict)
    positions: Deviations | None = None
    values_factor: FloatArray | None = None
    reversal_curves: ReversalCurves | None = None
    details: Mapping[str, Any] = field(default_factory=dict)
    objections: tuple[str, ...] = ()
    misfit: Misfit | None = None
    counted: tuple[int, int] | None = None
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    posterior_source: Callable[[], Posterior] | None = field(default=None, repr=False)

    @cached_property
    def posterior(self) -> Posterior | None:
        """What is known of every error, with the prior of the machine file; None without a prior. Computed on first use."""
        return None if self.posterior_source is None else self.posterior_source()

    @property
    def readings(self) -> int:
        """Number of readings."""
        return self.counted[0] if self.counted else len(self.accepted)

    @property
    def readings_used(self) -> int:
        """Number of readings that were used."""
        return self.counted[1] if self.counted else int(np.count_nonzero(self.accepted))

    @property
    def has_covariance(self) -> bool:
        """Whether the joint covariance of the errors is known."""
        return self.adjustment is not None or self.values_factor is not None

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the unknown errors in the order of the layout (size, size), mm and rad; computed on first use.

        Systematic inputs are included if given.
        """
        if self.adjustment is None:
            raise ValueError("this identification has no covariance")
        factor = self.adjustment.covariance_factor()[: self.layout.size]
        if self.systematic is None:
            return factor @ factor.T
        response = self.systematic.response[: self.layout.size]
        return factor @ factor.T + response @ response.T

    @cached_property
    def whiteness(self) -> Whiteness | None:
        """Tests of the residuals, computed on first use, with a CompgenWarning if one fails; None if there are none."""
        if self.residual_tests is None:
            return None
        found = self.residual_tests()
        warn_of_residuals(found, self.reduced_chi_square, self.u_source)
        return found

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``identify.json``."""
        of_lengths = self.method not in (
            "deviations",
            "artefact",
            "sixdof",
            "axis-runs",
            "circles",
            "given",
            "together",
        )
        return {
            "method": self.method,
            "residual_rms_um": self.rms_um,
            "residual_max_um": float(np.max(np.abs(self.residual_mm[self.accepted]), initial=0.0)) / MM_PER_UM,
            "degrees_of_freedom": self.degrees_of_freedom,
            "reduced_chi_square": None if np.isnan(self.reduced_chi_square) else self.reduced_chi_square,
            ("u_length" if of_lengths else "u_deviation"): {
                "source": self.u_source,
                "constant_um": self.u_length_um,
                **({"proportional_um_per_m": self.u_length_um_per_m} if of_lengths else {}),
                "scaled_by": self.u_scale,
            },
            "readings": self.readings,
            "readings_used": self.readings_used,
            "rank": self.rank,
            "unknowns": self.unknowns,
            "condition": self.condition,
            "iterations": self.iterations,
            "identified": list(self.errors.names),
            **self._assumptions(),
            "unobservable": list(self.unobservable),
            "rejected": [asdict(item) for item in self.rejected],
            "segments": [item.summary() for item in self.segments],
            "misfit": None if self.misfit is None else self.misfit.summary(),
            "reversal": None if self.reversal is None else self.reversal.summary(),
            "whiteness": None if self.whiteness is None else self.whiteness.summary(),
            "corrections": {key: value for key, value in self.corrections.items() if key != "effects"},
            "effects": dict(self.corrections.get("effects", {})),
            "worst_standard_uncertainty": {
                unit: {"value": value, "error": name} for unit, (value, name) in self.worst_u.items()
            },
            "squareness_urad": {
                name: {"value": value * 1e6, "u": u * 1e6} for name, (value, u) in self.errors.squareness.items()
            },
            "stations": [asdict(station) for station in self.stations],
            "systematic": None if self.systematic is None else self.systematic.summary(),
            **({"steps": dict(self.steps)} if self.steps else {}),
            **({self.method: dict(self.details)} if self.details else {}),
            **({"objections": list(self.objections)} if self.objections else {}),
            "notes": list(self.notes),
        }

    def _assumptions(self) -> dict[str, Any]:
        """What was assumed of errors that no reading determines; of a result that has all of them, the sizes only."""
        prior = self.layout.machine.prior
        if "posterior_means" not in self.details or self.posterior is None:
            said = (
                {}
                if prior.is_none
                else {"assumed": f"every error was measured; assumed between the readings: {prior.class_text}"}
            )
            return {"prior": prior.as_dict(), **said, "not_measured": {}, "determined": list(self.errors.names)}
        from compgen.identification.posterior import assumed_text, not_measured, worse_text

        found = self.posterior
        return {
            "prior": found.prior.as_dict(),
            "assumed": assumed_text(found),
            "machine_worse_than_class": worse_text(found) or None,
            "determined": [name for name in found.determined if name in self.errors.names],
            "not_measured": not_measured(found, self.errors.names),
        }

    def overview(self) -> Overview:
        """How well the model fits the readings, and the largest value of each error."""
        table = self.errors.overview()
        used = f"{self.readings_used} of {self.readings} readings"
        quality = f"residual {self.rms_um:.3f} um rms, reduced chi-square {self.reduced_chi_square:.3f}"
        count = len(self.errors.names)
        title = f"{count} error{'s' * (count != 1)} from {used} ({self.method}), {quality}"
        notes = (f"rank {self.rank} of {self.unknowns} unknowns", *self.objections)
        return Overview(title, table.header, table.rows, notes)

    def panels(self) -> Sequence[Panel]:
        """The errors, and the residuals of the used readings."""
        residual_um = -self.residual_mm[self.accepted] / MM_PER_UM  # kept as model minus reading, shown as in the files
        if not len(residual_um):
            return self.errors.panels()
        number = np.flatnonzero(self.accepted).astype(np.float64)
        drawn = Panel(
            "reading minus model", "residual (um)", (PlottedLine("", number, residual_um),), x_label="reading"
        )
        return [*self.errors.panels(), drawn]


def same_nodes(machine: Machine, result: Identification) -> bool:
    """Whether errors were identified at the nodes of the machine file."""
    pairs = zip(machine.axes, result.layout.machine.axes, strict=True)
    return all(np.array_equal(own.nodes_mm, other.nodes_mm) for own, other in pairs)


def at_nodes(machine: Machine, position_mm: FloatArray) -> bool:
    """Whether all positions (n, 3) are at the nodes of the machine: then its curves have the values that were read."""
    for k, axis in enumerate(machine.axes):
        nearest = np.clip(np.searchsorted(axis.nodes_mm, position_mm[:, k]), 1, len(axis.nodes_mm) - 1)
        away = np.minimum(position_mm[:, k] - axis.nodes_mm[nearest - 1], axis.nodes_mm[nearest] - position_mm[:, k])
        if np.abs(away).max(initial=0.0) > AT_NODE_MM:
            return False
    return True


def determines_all(machine: Machine, result: Identification) -> bool:
    """Whether the readings alone determine every error of the machine, each node to better than a third of its prior."""
    if not result.has_covariance or not set(state_names(machine)) <= set(result.errors.names):
        return False
    if not same_nodes(machine, result) or result.details.get("tied_nodes_mm") or result.method == "together":
        return False
    largest = {name: machine.prior.size(name) * DETERMINED for name in result.errors.names}
    values = [(name, curve.u) for name, curve in result.errors.curves.items()]
    values += [(name, np.array([u])) for name, (_, u) in result.errors.squareness.items()]
    return all(bool((u < largest[name]).all()) for name, u in values)


#: Share of an assumed uncertainty that residuals of zero leave: numbers that fit exactly are rounded, not exact.
LEAST_SHARE = 0.01


def uncertainty_scale(reduced_chi_square: float, u_source: str) -> float:
    """Factor of all standard uncertainties: an assumed one follows the residuals, a stated one only if they exceed it."""
    root = float(np.sqrt(reduced_chi_square))
    return max(LEAST_SHARE, root) if u_source == "assumed" else max(1.0, root)


def worst_uncertainty(errors: ErrorTable) -> dict[str, tuple[float, str]]:
    """Return the largest standard uncertainty by unit ("um", "urad") with its error."""
    worst: dict[str, tuple[float, str]] = {"um": (0.0, ""), "urad": (0.0, "")}
    for name, curve in errors.curves.items():
        unit = "um" if name[1] in "XYZ" else "urad"
        value = float(np.max(curve.u)) * (1e3 if unit == "um" else 1e6)
        if value > worst[unit][0]:
            worst[unit] = (value, name)
    for name, (_, u) in errors.squareness.items():
        if u * 1e6 > worst["urad"][0]:
            worst["urad"] = (u * 1e6, name)
    return worst


# What the methods of identification share: from residuals to a result, with or without an adjustment.


@dataclass(frozen=True)
class AdjustedReadings:
    """Readings at the optimum of an adjustment, n of them, and what their residuals say about all uncertainties.

    Parameters
    ----------
    residual_mm, sigma_mm : model minus reading, and the standard uncertainty of the reading, (n,).
    accepted : which readings were used, (n,).
    u_source : "stated" or "assumed".
    unknowns, degrees_of_freedom : of the adjustment.
    known_square_sum : weighted sum of squares of what was known of the unknowns beforehand.
    too_few : message with the numbers of readings and unknowns where no degree of freedom is left.

    Raises
    ------
    UndeterminedError
        without a degree of freedom.
    """

    residual_mm: FloatArray
    sigma_mm: FloatArray
    accepted: NDArray[np.bool_]
    u_source: str
    unknowns: int
    degrees_of_freedom: int
    known_square_sum: float = 0.0
    too_few: str = "{} readings for {} unknowns"

    def __post_init__(self) -> None:
        """Check that the readings are more than the unknowns."""
        if self.degrees_of_freedom < 1:
            raise UndeterminedError(self.too_few.format(np.count_nonzero(self.accepted), self.unknowns), [])

    @cached_property
    def reduced_chi_square(self) -> float:
        """Weighted sum of squares of the residuals over the degrees of freedom."""
        standardised = self.used(self.residual_mm) / self.used(self.sigma_mm)
        return (float(standardised @ standardised) + self.known_square_sum) / self.degrees_of_freedom

    @property
    def u_scale(self) -> float:
        """Factor of all standard uncertainties: an assumed one follows the residuals, a stated one only if they exceed it."""
        return uncertainty_scale(self.reduced_chi_square, self.u_source)

    def used(self, values: FloatArray) -> FloatArray:
        """Values (n,) of the readings that were used; no copy where all of them were."""
        return values if self.accepted.all() else values[self.accepted]

    def identification(
        self,
        errors: ErrorTable,
        layout: ErrorParameters,
        metadata: Mapping[str, str],
        u_length_um: float,
    ) -> Identification:
        """Return the result with what every adjustment says; ``metadata`` is that of the measurement."""
        used_mm = self.used(self.residual_mm)
        return Identification(
            errors=errors.replace(metadata=metadata_of(layout.machine, metadata)),
            residual_mm=self.residual_mm,
            accepted=self.accepted,
            rms_um=float(np.sqrt(used_mm @ used_mm / len(used_mm))) / MM_PER_UM,
            degrees_of_freedom=self.degrees_of_freedom,
            reduced_chi_square=self.reduced_chi_square,
            u_source=self.u_source,
            u_length_um=u_length_um,
            u_scale=self.u_scale,
            unobservable=unobservable(layout),
            rank=self.unknowns,
            unknowns=self.unknowns,
            worst_u=worst_uncertainty(errors),
            layout=layout,
        )


def station_results(
    names: Sequence[str],
    of_group: Sequence[tuple[int, int]],
    adjustment: Adjustment,
    errors: int,
    used: NDArray[Any],
    square_sum: NDArray[Any],
) -> tuple[StationResult, ...]:
    """Return position and dead length of every station and set-up, with standard uncertainties.

    Parameters
    ----------
    names : of the stations.
    of_group : index of the station, and the set-up, of each dead length.
    adjustment, errors : the optimum, and how many of its unknowns are errors; stations and dead lengths follow them.
    used, square_sum : readings of each dead length that were used, and the sum of their squared residuals, mm^2, (G,).
    """
    state, factor = adjustment.state, adjustment.covariance_factor()
    u = np.sqrt(np.einsum("ij,ij->i", factor, factor))
    u_stations_mm = u[errors : errors + state.stations_mm.size].reshape(-1, 3)
    u_dead_length_mm = u[errors + state.stations_mm.size :]
    results: list[StationResult] = []
    for group, (k, setup) in enumerate(of_group):
        x, y, z = state.stations_mm[k].tolist()
        u_x, u_y, u_z = u_stations_mm[k].tolist()
        results.append(
            StationResult(
                station=names[k],
                setup=setup,
                position_mm=(x, y, z),
                u_position_mm=(u_x, u_y, u_z),
                dead_length_mm=float(state.dead_length_mm[group]),
                u_dead_length_mm=float(u_dead_length_mm[group]),
                readings=int(used[group]),
                rms_um=float(np.sqrt(square_sum[group] / max(used[group], 1.0))) / MM_PER_UM,
                segment=list(of_group[:group]).count((k, setup)),
            )
        )
    return tuple(results)


def judged(found: Identification, series: Callable[[], ResidualSeries]) -> Identification:
    """Add whether the residuals are larger than their uncertainty allows; ``series`` makes those used, if they are looked at."""
    misfit = misfit_of(found.reduced_chi_square, found.degrees_of_freedom, found.u_scale, found.u_source, series)
    return replace(found, misfit=misfit)


def without_adjustment(
    machine: Machine, errors: ErrorTable, residual_mm: FloatArray, u_source: str, missing: str
) -> Identification:
    """Return errors that were evaluated directly: every reading counts, and no unknown is adjusted.

    Parameters
    ----------
    machine, errors : the machine, and its errors with the comments of the errors file.
    residual_mm : of the readings (n,); empty or zero where there are none.
    u_source : where the uncertainties come from; "unknown" if there are none.
    missing : why the other errors are not among them.
    """
    rms_um = float(np.sqrt(np.mean(residual_mm**2))) / MM_PER_UM
    return Identification(
        errors=errors,
        residual_mm=residual_mm,
        accepted=np.ones(len(residual_mm), dtype=bool),
        rms_um=rms_um,
        degrees_of_freedom=0,
        reduced_chi_square=1.0,
        u_source=u_source,
        u_length_um=rms_um,
        unobservable=not_among(errors, missing),
        rank=len(errors.names),
        unknowns=len(errors.names),
        worst_u={} if u_source == "unknown" else worst_uncertainty(errors),
        layout=error_parameters(machine, errors.names),
    )


def not_among(errors: ErrorTable, why: str) -> tuple[str, ...]:
    """Say of each of the 21 errors that a table does not contain why that is so."""
    return tuple(f"{name}: {why}" for name in ERROR_NAMES if name not in errors.names)


# Common results of all methods of identification: error curves with uncertainties, and notes about them.


def error_table(layout: ErrorParameters, unknowns: FloatArray, factor: FloatArray) -> ErrorTable:
    """Return curves and squareness for the unknown errors (size,), mm and rad.

    ``factor`` (size, r) times its transpose is their covariance.
    """
    positions = [layout.output_positions_mm(axis) for axis in range(3)]
    plain = layout.machine.curves == "linear"  # written at the nodes, so coefficients are values
    bases = [np.zeros((0, 0)) if plain else layout.basis(axis, positions[axis]) for axis in range(3)]
    variance = np.einsum("ij,ij->i", factor, factor)
    curves = {}
    for curve in layout.curves:
        axis, free = curve.error.axis, curve.free
        kept = free.argmax(axis=0)
        if plain and np.count_nonzero(free) == free.shape[1] == free[kept, np.arange(free.shape[1])].sum():
            value, square = np.zeros(len(free)), np.zeros(len(free))
            value[kept], square[kept] = unknowns[curve.columns], variance[curve.columns]
        else:
            reduced = free if plain else bases[axis] @ free
            value = reduced @ unknowns[curve.columns]
            spread = reduced @ factor[curve.columns]
            square = np.einsum("ij,ij->i", spread, spread)
        curves[curve.error.name] = Curve(positions[axis], value, np.sqrt(square))
    first = layout.size - len(layout.squareness)
    squareness = {
        name: (float(unknowns[first + k]), float(np.sqrt(variance[first + k])))
        for k, name in enumerate(layout.squareness)
    }
    return ErrorTable(curves, squareness)


def table_of_values(values: Iterable[tuple[str, FloatArray, FloatArray, FloatArray]]) -> ErrorTable:
    """Make curves and squareness of names with positions, values and standard uncertainties, each (m,), mm and rad."""
    curves, squareness = {}, {}
    for name, position_mm, value, u in values:
        if name in SQUARENESS_NAMES:
            squareness[name] = (float(value[0]), float(u[0]))
        else:
            curves[name] = Curve(position_mm, value, u)
    return ErrorTable(curves, squareness)


def metadata_of(machine: Machine, metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the comments of the errors file; ``metadata`` is that of the measurement."""
    reference = " ".join(f"{value:g}" for value in machine.reference_point_mm)
    kept = {key: metadata[key] for key in ("date",) if key in metadata}
    return {"machine": machine.name, **kept, "source": "compgen identify", "reference_point_mm": reference}


def unobservable(layout: ErrorParameters) -> tuple[str, ...]:
    """Return in words which of the 21 errors are not in the model, and why."""
    machine = layout.machine
    identified = {curve.error.name for curve in layout.curves} | set(layout.squareness)
    shown = observable_errors(machine)
    return tuple(
        f"{name}: excluded by errors in the machine file, although it is observable on chain {machine.chain.name}"
        if name in shown
        else f"{name}: no lever arm other than the travel of its axis or one tool offset on chain {machine.chain.name}"
        for name in ERROR_NAMES
        if name not in identified
    )
