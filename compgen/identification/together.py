"""Several measurements of one machine in one adjustment: axis runs, lengths, positions, six-DOF readings, known errors.

Readings are linear in the errors, or nearly so; each kind keeps its separate further unknowns (the zero of a laser, the
pose of a plate). What no reading determines is not identified. If each error comes directly from a single source, such
as pitch from a laser and squareness from a granite square, no adjustment is needed: the results are joined unchanged,
at the targets that were measured.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import Circles
from compgen.data.comparison import Uncertain, compare, normalized_error, small_motion
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Deviations
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_NAMES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.errors import CompgenWarning, InputError, Message, UndeterminedError
from compgen.identification.adjust.determined import (
    FAINT,
    FAINTER,
    SHOWS,
    Determined,
    Observations,
    determined_values,
    least_squares,
    stacked,
)
from compgen.identification.adjust.residual_tests import misfit_of
from compgen.identification.adjust.robust import Rejected, fit_accepted
from compgen.identification.adjust.unknowns import ErrorParameters, error_parameters, state_names
from compgen.identification.axis_tests import axis_observations, circle_observations, circle_readings
from compgen.identification.covariance import (
    error_design,
    error_values,
    joint_covariance,
    values_at_nodes,
    values_with_factor,
)
from compgen.identification.options import IdentifyOptions
from compgen.identification.positions import (
    artefact_observations,
    plausible_errors,
    position_observations,
    without_faint,
)
from compgen.identification.posterior import (
    MOST_LEVELS,
    Information,
    Posterior,
    reading_levels,
    solve_posterior,
    spans_of,
    state_layout,
    with_information,
)
from compgen.identification.result import (
    Identification,
    at_nodes,
    not_among,
    same_nodes,
    table_of_values,
    uncertainty_scale,
    without_adjustment,
    worst_uncertainty,
)
from compgen.identification.stated import given_numbers, stated_observations
from compgen.identification.tracer_lengths import length_observations
from compgen.kinematics.first_order import c_matrix, modelled_errors, tool_of
from compgen.kinematics.gauge import common_gauge_part
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import full_grid


@dataclass(frozen=True)
class Source:
    """One of several measurements: its name, the measurement, and what it determines alone (None: too little).

    ``fitting`` says which of its lengths fit the model where these were adjusted with the other measurements only.
    """

    name: str
    measurement: object
    alone: Identification | None
    fitting: NDArray[np.bool_] | None = None

    @property
    def new_lengths(self) -> int:
        """Number of its lengths if these were not adjusted alone, else 0."""
        return len(self.measurement) if isinstance(self.measurement, Lengths) and self.alone is None else 0

    def observed(
        self, machine: Machine, layout: ErrorParameters, options: IdentifyOptions, around: FloatArray | None
    ) -> Observations:
        """Return its readings of the errors of a layout; ``around`` are approximate errors (size,).

        Positions enter reading by reading, and lengths that alone do not determine the errors. Other lengths, six-DOF
        readings and circles enter as the errors that they determine, with their joint covariance: stations, dead lengths and
        rejected readings are already settled. Axis runs and known errors enter value by value.
        """
        if self.alone is not None and given_numbers(self.alone):
            return stated_observations(layout, self.alone.errors, lines=True)
        if isinstance(self.measurement, Deviations):
            found = position_observations(machine, layout, self.measurement, options, around)
            return self._as_alone(found)
        if isinstance(self.measurement, Artefact):
            start = np.zeros(layout.size) if around is None else around
            found, _, _ = artefact_observations(machine, layout, self.measurement, options, start)
            return self._as_alone(found)
        if isinstance(self.measurement, Lengths) and self.alone is None:
            start = np.zeros(layout.size) if around is None else around
            return length_observations(machine, layout, self.measurement, options, start)
        if self.alone is None:
            text = f"{self.name}: the readings do not determine the errors and the other unknowns of this measurement"
            raise UndeterminedError(
                Message("identify-alone-hint", "{text}; identify it alone to see what is missing", text=text), []
            )
        if isinstance(self.measurement, Circles):
            return circle_observations(machine, layout, self.measurement, self.alone)
        if self.alone.method == "sixdof" and self.alone.has_covariance:
            names, positions, values, factor, _ = projected(machine, layout, self.alone)
            return Observations.of_values(layout, names, positions, values, factor @ factor.T)
        if self.alone.has_covariance and self.alone.method not in ("deviations", "axis-runs", "given"):
            known = joint_covariance(self.alone)
            return Observations.of_values(
                layout, known.error, known.position_mm, self.alone.errors.values(), known.errors_covariance
            )
        return Observations.of_curves(layout, self.alone.errors)

    def readings(
        self, machine: Machine, layout: ErrorParameters, options: IdentifyOptions, around: FloatArray
    ) -> Observations:
        """Return what it says about the state of a posterior: as :meth:`observed`, but with everything that moved the tool.

        Axis runs enter with the angles along their lines and the scale of their laser, circles reading by reading. Lengths
        that were adjusted with other nodes than those of the machine enter reading by reading, too.
        """
        if self.alone is not None and given_numbers(self.alone):
            return stated_observations(layout, self.alone.errors, lines=False)
        if isinstance(self.measurement, AxisRuns):
            return axis_observations(machine, layout, self.measurement, machine.prior)
        if isinstance(self.measurement, Circles) and self.alone is not None:
            return circle_readings(machine, layout, self.measurement, self.alone)
        lengths = self.measurement
        if isinstance(lengths, Lengths) and not (
            self.alone and same_nodes(machine, self.alone) and at_nodes(machine, lengths.position_mm)
        ):
            kept = self.fitting if self.alone is None else self.alone.accepted
            if kept is None:
                kept = np.ones(len(lengths), dtype=bool)
            rows = np.flatnonzero(kept)
            few = lengths.part(rows[:: 1 + len(rows) // MOST_LENGTHS])
            return length_observations(machine, layout, few, options, around)
        known = self.measurement is not None and not isinstance(self.measurement, Artefact)
        if known and self.alone is not None and self.alone.adjustment is not None:
            return self._adjusted_values(machine, layout, self.alone)
        return self.observed(machine, layout, options, around)

    def _adjusted_values(self, machine: Machine, layout: ErrorParameters, alone: Identification) -> Observations:
        """The values at the nodes that the readings alone determine, with their joint covariance.

        Between two nodes they are drawn straight: at a reference point there the true curve is bent, and what it differs
        by was taken off the values, and is in the squareness.
        """
        known, values = joint_covariance(alone), alone.errors.values()
        taken_off = common_gauge_part(machine, alone.errors) if machine.curves == "linear" else None
        return Observations.of_values(
            layout, known.error, known.position_mm, values, known.errors_covariance, taken_off=taken_off
        )

    def _as_alone(self, found: Observations) -> Observations:
        """Readings without those rejected alone, with the uncertainties found alone; calibration data follow and stay."""
        if self.alone is None:
            return found
        kept = np.ones(len(found), dtype=bool)
        kept[: len(self.alone.accepted)] = self.alone.accepted
        return replace(found.kept(kept), sigma=found.sigma[kept] * self.alone.u_scale)

    def summary(self) -> dict[str, object]:
        """Return the entry of the part in ``identify.json``."""
        if self.alone is None:
            return {"name": self.name, "method": "", "errors": [], "readings": 0}
        return {
            "name": self.name,
            "method": self.alone.method,
            "errors": list(self.alone.errors.names),
            "readings": self.alone.readings if self.measurement is not None else 0,
            "residual_rms_um": self.alone.rms_um,
            "reduced_chi_square": self.alone.reduced_chi_square,
        }


def identify_together(machine: Machine, parts: Sequence[Source], options: IdentifyOptions) -> Identification:
    """Identify the errors that several measurements determine together.

    Parameters
    ----------
    machine : chain, nodes, reference point and the errors that its model contains.
    parts : the measurements; errors known from elsewhere have no ``measurement``.
    options : those that apply to these kinds of measurements.

    Raises
    ------
    UndeterminedError
        if no error is determined, or a nonlinear kind does not determine its further unknowns.
    """
    known = [part.alone for part in parts if part.alone is not None]
    if not known:
        raise UndeterminedError(
            Message("none-determines", "none of the measurements alone determines any of the machine's errors"), []
        )
    listed = list(chain.from_iterable(result.errors.names for result in known))
    direct = all(part.measurement is None or isinstance(part.measurement, AxisRuns | Circles) for part in parts)
    if any(isinstance(part.measurement, Circles) for part in parts):  # guides that are bent change what circles show
        direct = direct and not any(
            name not in SQUARENESS_NAMES and error_named(name).is_straightness for name in listed
        )
    if direct and len(listed) == len(set(listed)):
        return _joined(machine, parts, known)
    return _adjusted(machine, parts, options)


# The posterior: what the readings and the prior of the machine file say together.


def posterior_of(
    machine: Machine, parts: Sequence[Source], options: IdentifyOptions, result: Identification, *, learn: bool
) -> tuple[Posterior, tuple[Information, ...]]:
    """Return the posterior of several measurements, and what each of them says about its state.

    ``result`` are errors close enough to linearise about.
    """
    with one_thread():
        return _posterior_of(machine, parts, options, result, learn=learn)


def _posterior_of(
    machine: Machine, parts: Sequence[Source], options: IdentifyOptions, result: Identification, *, learn: bool
) -> tuple[Posterior, tuple[Information, ...]]:
    names = state_names(machine)
    places = [_places_mm(part) for part in parts]
    levels = [
        reading_levels(axis, np.concatenate([np.zeros(0), *(place[k] for place in places)]))
        for k, axis in enumerate(machine.axes)
    ]
    layout = state_layout(machine, levels, names)
    known = {name for name, _ in layout.columns()}
    errors, around = result.errors, np.zeros(layout.size)
    for curve in layout.curves:
        name = curve.error.name
        if name in errors.curves and np.isfinite(errors.curves[name].value).all():
            around[curve.columns] = errors.curves[name].at(curve.nodes_mm[curve.free.argmax(axis=0)])
    for name, columns in layout.columns():
        if name in errors.squareness and name in known:
            around[columns] = errors.squareness[name][0]
    found = [part.readings(machine, layout, options, around) for part in parts]
    information = [Information.of(item) for item in found]
    moves = [k for k, part in enumerate(parts) if isinstance(part.measurement, Deviations | Artefact | Lengths)]
    if moves:  # poses and stations: once more about better errors than those of least squares
        around = solve_posterior(machine, layout, information, spans_of(found), learn=False, passes=1).state
        for k in moves:
            found[k] = parts[k].readings(machine, layout, options, around)
            information[k] = Information.of(found[k])
    return solve_posterior(machine, layout, information, spans_of(found), learn=learn), tuple(information)


def _places_mm(part: Source) -> list[FloatArray]:
    """Positions of each axis at which a measurement read the errors."""
    measured = part.measurement
    if isinstance(measured, Lengths | Deviations):
        return list(measured.position_mm.T)
    if isinstance(measured, Artefact):
        return list(np.where(np.isnan(measured.measured_mm), measured.nominal_mm, measured.measured_mm).T)
    if isinstance(measured, Circles):
        return [np.linspace(0.0, 1.0, 2 * MOST_LEVELS)] * 3  # scattered
    found = [np.zeros(0)] * 3
    if part.alone is not None:
        for name, curve in part.alone.errors.curves.items():
            axis = error_named(name).axis
            found[axis] = np.concatenate([found[axis], curve.position_mm])
    return found


def with_prior(
    machine: Machine, parts: Sequence[Source], result: Identification, options: IdentifyOptions
) -> Identification:
    """Return a result with what is known of every error: from the readings, or from the prior of the machine file.

    Errors that the readings alone determine keep their least-squares values; of the others the posterior mean is listed
    where a reading shows them. What no reading shows is not listed; ``posterior`` has it.
    """
    if machine.prior.is_none:
        return _without_prior(machine, parts, result, options)
    parts = _with_fitting(parts, result)
    found, information = posterior_of(machine, parts, options, result, learn=True)
    if result.method in ("sixdof", "merged"):  # six errors of an axis at once, in the gauge of the instrument
        details = {**result.details, "posterior_means": []}
        apart = replace(found, follows_table=False)
        return replace(result, posterior_source=lambda: apart, details=details)
    full = result.adjustment is not None and same_nodes(machine, result)
    whole = set(result.errors.names) if full else _kept(machine, parts, result, options, found)
    typed = {name for part in parts if part.alone and given_numbers(part.alone) for name in part.alone.errors.names}
    listed = [name for name in ERROR_NAMES if name in found.shown or name in whole or name in typed]
    if not listed:
        raise UndeterminedError(
            Message(
                "none-better-than-prior", "the readings show none of the machine's errors better than the prior does"
            ),
            [],
        )
    curves, squareness, positions = {}, {}, []
    known = _in_its_gauge(machine, result.errors.only(*whole), found)
    for name in listed:
        own = result.errors.curves.get(name)
        if name in SQUARENESS_NAMES:
            at = np.array([np.nan])
            mean = found.curve(name, at)
            value, u = float(mean.value[0]), float(mean.u[0])
            if name in whole:  # as it was stated or measured
                (value, stated), (likely, u) = result.errors.squareness[name], known.squareness[name]
                u = float(_as_stated(np.hypot([u], [value - likely]), np.array([stated]))[0])
            squareness[name] = (value, u)
        else:
            at = _output_mm(machine, name, own, whole=name in whole)
            mean = found.curve(name, at)
            if own is not None and name in whole:
                kept, likely_u = np.isin(at, own.position_mm), known.curves[name].u
                stated_u = np.where(kept, np.interp(at, own.position_mm, own.u), np.nan)
                values = np.where(kept, own.at(at), mean.value)
                off = np.where(kept, values - known.curves[name].at(at), 0.0)
                own_u = np.where(kept, np.interp(at, own.position_mm, likely_u), mean.u)
                mean = Curve(at, values, _as_stated(np.hypot(own_u, off), stated_u))
            curves[name] = mean
        positions.append(at)
    errors = ErrorTable(curves, squareness, result.errors.metadata)
    factor = found.values_factor(listed, positions)
    if factor.shape[1] > factor.shape[0]:
        factor = np.transpose(np.linalg.qr(factor.T)[1])
    size, known_u = np.linalg.norm(factor, axis=1), errors.uncertainties()
    factor = factor * np.where(size > 0, known_u / np.where(size > 0, size, 1.0), 1.0)[:, None]
    own_names = set(result.errors.names)
    left = {name for name in result.errors.names if name not in listed}
    agreement = _agreement(machine, parts, information, found) if len(parts) > 1 else {}
    objections, doubts = _disagreements(agreement)
    return replace(
        result,
        errors=errors,
        unobservable=(
            *(
                text
                for text in result.unobservable
                if text.partition(":")[0] not in {*left, *(set(listed) - own_names)}
            ),
            *(f"{name}: the readings show little of it" for name in ERROR_NAMES if name in left),
        ),
        worst_u=worst_uncertainty(errors),
        layout=result.layout if full else error_parameters(machine, errors.names),
        adjustment=result.adjustment if full else None,
        systematic=result.systematic if full else None,
        values_factor=result.values_factor if full else factor,
        posterior_source=lambda: found,
        objections=(*result.objections, *objections),
        doubts=(*result.doubts, *doubts),
        details={
            **result.details,
            **({"en": agreement} if len(parts) > 1 else {}),
            "posterior_means": [name for name in listed if name not in whole],
        },
    )


def _with_fitting(parts: Sequence[Source], result: Identification) -> list[Source]:
    """The parts with the lengths that were rejected when all were adjusted together."""
    found, first = [], 0
    for part in parts:
        count = part.new_lengths
        if part.measurement is not None and part.alone is not None:
            count = len(part.alone.accepted)
        new = part.new_lengths and first + count <= len(result.accepted)
        found.append(replace(part, fitting=result.accepted[first : first + count]) if new else part)
        first += count
    return found


def _in_its_gauge(machine: Machine, table: ErrorTable, found: Posterior) -> ErrorTable:
    """The posterior of the values of a table, which is zero at a reference point between two nodes if drawn straight."""
    if not table.names:
        return table
    places = [table.curves[name].position_mm if name in table.curves else np.zeros(1) for name in table.names]
    mean = np.concatenate([found.curve(name, at).value for name, at in zip(table.names, places, strict=True)])
    factor = found.values_factor(table.names, places)
    if machine.curves == "linear":
        taken_off = common_gauge_part(machine, table)
        mean, factor = mean - taken_off @ mean, factor - taken_off @ factor
    return table.with_values(mean, np.linalg.norm(factor, axis=1))


def _as_stated(u: FloatArray, stated: FloatArray) -> FloatArray:
    """Uncertainties of values that stay, (n,): those stated or found where the prior hardly changes them."""
    same = np.isfinite(stated) & (np.abs(stated - u) <= NEARLY * u)
    return np.where(same, stated, u)


def _kept(
    machine: Machine, parts: Sequence[Source], result: Identification, options: IdentifyOptions, found: Posterior
) -> set[str]:
    """Errors whose least-squares values stay: the readings alone determine them everywhere, to a third of the prior.

    Where the readings are not at the nodes, least squares are off by what the curve bends between the nodes: then the
    posterior mean is better.
    """
    layout = error_parameters(machine, modelled_errors(machine))
    around = np.zeros(layout.size)
    observed = []
    for part in parts:
        if isinstance(part.measurement, Circles) and part.alone is not None:
            observed.append(circle_readings(machine, layout, part.measurement, part.alone))
        else:
            observed.append(part.observed(machine, layout, options, around))
    names, at = result.errors.labels()
    rows = layout.value_rows(names, at)
    determined = determined_values(layout, stacked(observed), rows) | ~np.any(rows, axis=1)
    kept = set()
    for name, values in result.errors.rows().items():
        if name not in found.determined or not determined[values].all():
            continue
        if name in result.errors.curves:
            curve, mean = result.errors.curves[name], found.curve(name, at[values])
            low, high = found.processes[name].zero_mm[0], found.processes[name].zero_mm[-1]
            if curve.position_mm[0] > low + 1e-6 or curve.position_mm[-1] < high - 1e-6:
                continue  # its zero is beyond what was measured
            if np.any(np.abs(curve.value - mean.value) > MOST_OFF * mean.u + 1e-6 * found.processes[name].s):
                continue
        elif (
            name in SQUARENESS_NAMES
        ):  # that of a circle is the one within its diameter, and less certain over the travel
            mean = found.curve(name, np.zeros(1))
            if abs(result.errors.squareness[name][0] - mean.value[0]) > SQUARENESS_OFF * mean.u[0]:
                continue
        kept.add(name)
    return kept


def _output_mm(machine: Machine, name: str, own: Curve | None, *, whole: bool) -> FloatArray:
    """Positions at which a curve is written: those measured, and the nodes of the machine where nothing was measured."""
    axis = machine.axes[error_named(name).axis]
    if own is None:
        return axis.nodes_mm
    at = own.position_mm
    low, high = (at[0] - 1e-6, at[-1] + 1e-6) if whole else (np.inf, -np.inf)
    more = axis.nodes_mm[(axis.nodes_mm < low) | (axis.nodes_mm > high)]
    more = more[[bool(np.abs(at - value).min() > 1e-6) for value in more]]
    return np.sort(np.concatenate([at, more]))


def _without_prior(
    machine: Machine, parts: Sequence[Source], result: Identification, options: IdentifyOptions
) -> Identification:
    """Return a result without a prior: what the readings do not determine has no uncertainty, and that is said."""
    if result.adjustment is not None or not result.errors.names:
        return result
    layout = error_parameters(machine, modelled_errors(machine))
    observed = stacked([part.observed(machine, layout, options, np.zeros(layout.size)) for part in parts])
    names, at = result.errors.labels()
    rows = layout.value_rows(names, at)
    open_values = ~determined_values(layout, observed, rows) & np.any(rows, axis=1)
    if not open_values.any():
        return result
    u = np.where(open_values, np.nan, result.errors.uncertainties())
    lost = dict.fromkeys(name for name, missing in zip(names, open_values.tolist(), strict=True) if missing)
    return replace(
        result,
        errors=result.errors.with_values(u=u),
        values_factor=None,
        worst_u={},
        unobservable=(
            *result.unobservable,
            *(f"{name}: not determined everywhere; its u is not known" for name in lost),
        ),
    )


def _joined(machine: Machine, parts: Sequence[Source], known: Sequence[Identification]) -> Identification:
    """The errors of all results, each in one result only; each keeps the positions at which it was measured."""
    errors = ErrorTable(
        dict(chain.from_iterable(result.errors.curves.items() for result in known)),
        dict(chain.from_iterable(result.errors.squareness.items() for result in known)),
        known[0].errors.metadata,
    )
    u, rows = errors.uncertainties(), errors.rows()
    whole = bool(np.isfinite(u).all())
    # the values of one result keep their joint covariance, those of different ones are independent
    factors = [np.diag(u)]
    for result in known:
        if result.values_factor is not None and whole:
            own = np.concatenate([np.arange(rows[name].start, rows[name].stop) for name in result.errors.names])
            # as many columns as values, not as readings
            square = np.transpose(np.linalg.qr(result.values_factor.T)[1])
            factors[0][own] = 0.0
            factors.append(np.zeros((len(u), square.shape[1])))
            factors[-1][own] = square
    return replace(
        _common(parts, known),
        errors=errors,
        degrees_of_freedom=sum(result.degrees_of_freedom for result in known),
        unobservable=not_among(errors, "no file contains it"),
        rank=sum(result.rank for result in known),
        unknowns=sum(result.unknowns for result in known),
        worst_u=worst_uncertainty(errors) if whole else {},
        layout=error_parameters(machine, errors.names),
        values_factor=np.hstack(factors) if whole else None,
        details={"parts": [part.summary() for part in parts]},
    )


def solve_together(
    machine: Machine, layout: ErrorParameters, parts: Sequence[Source], options: IdentifyOptions
) -> tuple[list[Observations], Determined, NDArray[np.bool_]]:
    """Return the readings of each part, what all of them determine together, and which of all readings fit.

    Raises UndeterminedError if no error is determined. Positions in a frame of unknown pose and lengths from unknown
    stations are linear around approximate errors only: those of a first solution.
    """
    plates = [part.measurement for part in parts if isinstance(part.measurement, Artefact)]
    few = any(part.new_lengths for part in parts) or any(plate.calibrated.all() for plate in plates)
    posed = any(isinstance(part.measurement, Deviations | Artefact | Lengths) for part in parts)

    def adjusted_with(least: float) -> tuple[float, list[Observations], Observations, Determined]:
        around: FloatArray | None = None
        for _ in range(2 if posed else 1):
            found = [part.observed(machine, layout, options, around) for part in parts]
            found = [
                _with_known_curves(layout, found, k) if isinstance(part.measurement, Circles) else found[k]
                for k, part in enumerate(parts)
            ]
            everything = stacked(found)
            solution = least_squares(layout, everything, np.ones(len(everything), dtype=bool), least)
            around = solution.on(layout)
            for plate in plates:
                plausible_errors(machine, layout, plate, around)
        return least, found, everything, solution

    least, found, everything, solution = without_faint(adjusted_with, FAINTER if few else (SHOWS,))
    accepted = np.ones(len(everything), dtype=bool)
    # lengths that were not adjusted alone contain their gross errors
    new = np.concatenate([np.arange(len(item)) < part.new_lengths for item, part in zip(found, parts, strict=True)])

    def fit(fitting: NDArray[np.bool_], _: Determined | None) -> Determined:
        accepted[new] = fitting
        return least_squares(layout, everything, accepted, least)

    if new.any():
        solution, _ = fit_accepted(
            fit,
            lambda result: (result.residual / everything.sigma)[new],
            int(np.count_nonzero(new)),
            "lengths do not fit the model and the other measurements; check stations, axes, signs and units,",
            reject=options.reject,
        )
    return found, solution, accepted


def _determined_errors(layout: ErrorParameters, observations: Observations, least: float) -> set[str]:
    """Errors of which every value at the positions of the readings is determined."""
    places = observations.positions(layout)
    names = [name for name, position_mm in places.items() for _ in position_mm]
    rows = layout.value_rows(names, np.concatenate(list(places.values())))
    fixed = ~np.any(rows, axis=1)  # zero by definition
    whole = determined_values(layout, observations, rows, least) | fixed
    lost = {name for name, known in zip(names, whole.tolist(), strict=True) if not known}
    return set(places) - lost


def _with_known_curves(layout: ErrorParameters, found: Sequence[Observations], k: int) -> Observations:
    """The readings of circles ``found[k]``: of the curves only those that the other parts determine wherever they show them.

    Straightness that nothing else shows stays a part of the squareness within the circle.
    """
    design = found[k].design.copy()
    if len(found) == 1:
        design[:, : layout.size - len(layout.squareness)] = 0.0
        return replace(found[k], design=design)
    others = stacked([item for j, item in enumerate(found) if j != k])
    known = _determined_errors(layout, others, SHOWS)
    for number, curve in enumerate(layout.curves):
        name = curve.error.name
        if name not in others.covered and not (name in known and others.shows[:, number].any()):
            design[:, curve.columns] = 0.0
    return replace(found[k], design=design)


def _adjusted(machine: Machine, parts: Sequence[Source], options: IdentifyOptions) -> Identification:
    """One least-squares adjustment of everything, and how the parts agree."""
    layouts = [part.alone.layout for part in parts if part.alone is not None and part.alone.adjustment is not None]
    layout = max(layouts, key=lambda item: item.size, default=error_parameters(machine, modelled_errors(machine)))
    found, solution, accepted = solve_together(machine, layout, parts, options)
    starts = np.cumsum([0, *(len(readings) for readings in found)])
    fitting = [
        readings.kept(accepted[start : start + len(readings)]) for readings, start in zip(found, starts, strict=False)
    ]
    # with a prior the posteriors are compared: least squares takes what is not read as zero
    agreement = _agreement_without_prior(layout, parts, fitting, solution) if machine.prior.is_none else {}
    freedom, sigma = solution.freedom, np.concatenate([readings.sigma for readings in found])
    reduced = float(np.sum((solution.residual / sigma)[accepted] ** 2)) / freedom if freedom > 0 else 1.0
    u_scale = uncertainty_scale(reduced, "stated")
    errors, factor = values_with_factor(solution.layout, solution.unknowns, u_scale * solution.factor)
    known = [part.alone for part in parts if part.alone is not None]
    adjusted = []
    for part, first in zip(parts, starts, strict=False):
        rows = slice(first, first + part.new_lengths)
        if isinstance(part.measurement, Lengths) and part.new_lengths:
            part = replace(part, alone=_as_adjusted(machine, part.measurement, solution.residual[rows], accepted[rows]))
        adjusted.append(part)
    shown, hardly = errors, dict[str, str]()
    if any(part.new_lengths for part in parts):
        # lengths of few stations show a little of everything: what is known elsewhere stays, and what is determined
        elsewhere = {name for result in known for name in result.errors.names}
        determined = elsewhere | _determined_errors(layout, stacked(fitting), FAINT)
        hardly = {
            name: f"{name}: the readings do not separate it from the stations and other errors"
            for name in errors.names
            if name not in determined
        }
        values = errors.rows()
        kept = [name for name in errors.names if name not in hardly]
        factor, errors = np.vstack([factor[values[name]] for name in kept]), errors.only(*kept)
    beyond = {
        name: ", ".join(f"{error} ({value:.1f})" for error, value in numbers.items() if value > 1.0)
        for name, numbers in agreement.items()
    }
    texts = [
        f"{name} disagrees with the other measurements beyond the uncertainty of both in {listed} (En, 1 is the limit); "
        "check calibration, set-up, signs and the time between the measurements"
        for name, listed in beyond.items()
        if listed
    ]
    for text in texts:
        warnings.warn(text, CompgenWarning, stacklevel=4)
    common = _common(adjusted, known)
    return replace(
        common,
        objections=(*common.objections, *texts),
        errors=errors.replace(metadata=known[0].errors.metadata),
        degrees_of_freedom=freedom,
        reduced_chi_square=reduced,
        u_source="stated",
        u_scale=u_scale,
        misfit=misfit_of(reduced, freedom, u_scale, "stated") if freedom > 0 else None,
        unobservable=(
            *not_among(shown, "no reading shows it"),
            *hardly.values(),
            *(
                f"{name}: part of it cannot be separated from other unknowns"
                for name in solution.partly
                if name not in hardly
            ),
        ),
        rank=solution.rank,
        unknowns=solution.rank,
        condition=solution.condition,
        worst_u=worst_uncertainty(errors),
        layout=error_parameters(machine, errors.names) if hardly else solution.layout,
        adjustment=None,
        values_factor=factor,
        details={
            "parts": [part.summary() for part in adjusted],
            "en": agreement,
            "tied_nodes_mm": {name: nodes.tolist() for name, nodes in solution.unreached.items()},
        },
    )


def _as_adjusted(
    machine: Machine, lengths: Lengths, residual_mm: FloatArray, accepted: NDArray[np.bool_]
) -> Identification:
    """Lengths that were adjusted with other readings only: no errors of their own, residuals (n,) reading minus model."""
    rejected = tuple(
        Rejected(
            row,
            lengths.stations[lengths.station[row]],
            str(lengths.point[row]),
            float(residual_mm[row]) / MM_PER_UM,
            f"differs from the model by {residual_mm[row] / MM_PER_UM:+.1f} um",
            *(lengths.origin[row] if lengths.origin else ()),
        )
        for row in np.flatnonzero(~accepted).tolist()
    )
    plain = without_adjustment(machine, ErrorTable({}, {}, dict(lengths.metadata)), -residual_mm, "unknown", "")
    return replace(plain, accepted=accepted, rejected=rejected, method="lengths with other readings")


def _agreement(
    machine: Machine, parts: Sequence[Source], information: Sequence[Information], found: Posterior
) -> dict[str, dict[str, float]]:
    """Largest E_n number of each error between the readings of one part and all others, by name of the part.

    What a part changes in the posterior of the others, m - m_0, has the covariance S_0 - S. The coverage factor is chosen
    to give the probability of a false alarm for all values of a part together. Errors have the sizes that one side or the
    other needs by itself: what only both together need is no larger machine, it is the disagreement.
    """
    from scipy.special import stdtrit  # imported here: slow to load

    layout, result = found.layout, {}
    for k in range(len(parts)) if len(parts) > 2 else range(1):
        rest = [item for j, item in enumerate(information) if j != k]
        sides = [
            solve_posterior(found.machine, layout, side, found.spans_mm, learn=False)
            for side in ([information[k]], rest)
        ]
        sizes = _larger_sizes(found, sides)
        both = with_information(sizes, information)
        changes = [_changes(with_information(sizes, side), both) for side in ([information[k]], rest)]
        ratio = np.fmax(*changes)  # of the part by the others, and of the others by the part
        count = sum(int(np.count_nonzero(np.isfinite(change))) for change in changes)
        factor = -float(stdtrit(MANY, FALSE_ALARM / 2.0 / max(count, 1)))
        result[parts[k].name] = {
            name: float(np.nanmax(ratio[columns])) / factor
            for name, columns in layout.columns()
            if np.isfinite(ratio[columns]).any()
        }
    return result


def _changes(less: Posterior, more: Posterior) -> FloatArray:
    """What further readings change in the state of a posterior, over the uncertainty of that change; nan if they show nothing."""
    before, after = (np.einsum("ij,ij->i", item.factor, item.factor) for item in (less, more))
    gained = before - after
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(gained > SHARED * before, np.abs(more.state - less.state) / np.sqrt(gained), np.nan)


def _larger_sizes(found: Posterior, sides: Sequence[Posterior]) -> Posterior:
    """A posterior with the larger of the sizes that either of two posteriors has for each error."""
    processes = {
        name: max((side.processes[name] for side in sides), key=lambda item: item.s) for name in found.processes
    }
    squareness = {name: max(side.squareness_sd[name] for side in sides) for name in found.squareness_sd}
    return replace(found, processes=processes, squareness_sd=squareness)


def _disagreements(agreement: Mapping[str, Mapping[str, float]]) -> tuple[list[str], list[str]]:
    """Return objections to parts that contradict the others, and reservations about those that nearly do."""
    objections: list[str] = []
    doubts: list[str] = []
    for name, numbers in agreement.items():
        over = {error: value for error, value in numbers.items() if value > 1.0}
        if not over:
            continue
        listed = ", ".join(f"{error} ({value:.1f})" for error, value in over.items())
        text = f"{name} disagrees with the other measurements beyond the uncertainty of both in {listed} (En, 1 is the limit); "
        text += "check calibration, set-up, signs and the time between the measurements"
        (objections if max(over.values()) > CONTRADICTS else doubts).append(text)
        warnings.warn(text, CompgenWarning, stacklevel=5)
    return objections, doubts


def _agreement_without_prior(
    layout: ErrorParameters, parts: Sequence[Source], found: Sequence[Observations], solution: Determined
) -> dict[str, dict[str, float]]:
    """Largest E_n number of each error between one part alone and all others, by name of the part.

    The coverage factor is chosen to give the probability of a false alarm for all values of a part together. Circles are
    compared in squareness, with the curves as the solution of everything has them.
    """
    unknowns, found = solution.on(layout), list(found)
    curves = np.arange(layout.size) < layout.size - len(layout.squareness)
    for k, part in enumerate(parts):
        if isinstance(part.measurement, Circles):
            value = found[k].value - found[k].design[:, curves] @ unknowns[curves]
            found[k] = replace(found[k], design=np.where(curves, 0.0, found[k].design), value=value)
    from scipy.special import stdtrit  # imported here: slow to load

    result: dict[str, dict[str, float]] = {}
    for k in range(len(parts)) if len(parts) > 2 else range(1):
        others = stacked([item for j, item in enumerate(found) if j != k])
        try:
            one, other = (least_squares(layout, item, np.ones(len(item), dtype=bool)) for item in (found[k], others))
        except UndeterminedError:
            continue
        differences, places = {}, found[k].positions(layout)
        label = np.array([name for name, position_mm in places.items() for _ in position_mm])
        rows = layout.value_rows(label.tolist(), np.concatenate(list(places.values())))
        shared = determined_values(layout, found[k], rows) & determined_values(layout, others, rows)
        for name, position_mm in places.items():
            both = shared[label == name]
            if both.any():
                (value, u), (against, u_against) = (side.curve(name, position_mm[both]) for side in (one, other))
                differences[name] = (value - against, np.hypot(u, u_against))
        count = sum(len(u) for _, u in differences.values())
        factor = -float(stdtrit(MANY, FALSE_ALARM / 2.0 / max(count, 1)))
        result[parts[k].name] = {
            name: float(normalized_error(value, factor * u).max()) for name, (value, u) in differences.items()
        }
    return result


def _common(parts: Sequence[Source], known: Sequence[Identification]) -> Identification:
    """The combined fields of all parts' results: readings one after another, stations, reversals, objections."""
    measured = [part.alone for part in parts if part.alone is not None and part.measurement is not None]
    residual = np.concatenate([np.zeros(0), *(result.residual_mm for result in measured)])
    accepted = np.concatenate([np.zeros(0, dtype=bool), *(result.accepted for result in measured)])
    reversal: dict[tuple[int, int], Curve] = {}
    for result in known:
        if result.reversal_curves is not None:
            reversal |= result.reversal_curves.curves
    return replace(
        known[0],
        method="together",
        stations=tuple(chain.from_iterable(result.stations for result in known)),
        residual_mm=residual,
        accepted=accepted,
        counted=None,
        rms_um=float(np.sqrt(np.mean(residual[accepted] ** 2))) / MM_PER_UM if accepted.any() else 0.0,
        rejected=tuple(chain.from_iterable(part.alone.rejected for part in parts if part.alone is not None)),
        segments=tuple(chain.from_iterable(result.segments for result in known)),
        reversal=next((result.reversal for result in known if result.reversal is not None), None),
        reversal_curves=ReversalCurves(reversal, {"machine": known[0].layout.machine.name}) if reversal else None,
        positions=next((result.positions for result in known if result.positions is not None), None),
        corrections=dict(chain.from_iterable(result.corrections.items() for result in known)),
        residual_tests=None,
        systematic=None,
        steps={},
        objections=tuple(dict.fromkeys(chain.from_iterable(result.objections for result in known))),
        doubts=tuple(dict.fromkeys(chain.from_iterable(result.doubts for result in known))),
        misfit=next((result.misfit for result in known if result.misfit is not None and result.misfit.beyond), None),
    )


# Errors from several sources that were identified apart: compared where they share, and averaged.


#: Probability of a false report that two measurements disagree.
FALSE_ALARM = 0.05
#: Of more lengths at scattered positions only some are used for the posterior: it needs a row of the state for each.
MOST_LENGTHS = 8000
#: Standard uncertainties stay as they were stated if the posterior ones differ by at most this share.
NEARLY = 0.1
#: Least-squares values stay where they are within so many standard uncertainties of the posterior mean.
MOST_OFF = 1.0
#: The same of a squareness.
SQUARENESS_OFF = 0.25
#: E_n number from which a disagreement is a contradiction; between 1 and this it is a reservation.
CONTRADICTS = 1.5
#: A value is shared by two parts if one of them takes this share of the variance that the other leaves.
SHARED = 0.01
#: Degrees of freedom of a stated scatter.
MANY = 1e6
#: Levels of the other axes at which the motion of the tool is compared.
LEVELS = 3


@dataclass(frozen=True)
class InstrumentAgreement:
    """Comparison of two identifications, by error.

    Parameters
    ----------
    en : largest |difference| / (k u(difference)) over the positions of each error; above 1 they disagree.
    coverage_factor : k of Student's distribution, chosen so that ``FALSE_ALARM`` holds for all values together.
    not_expressed_mm : largest motion of the tool of the second one that the errors of the first cannot express.
    """

    en: dict[str, float]
    coverage_factor: float
    not_expressed_mm: float

    @property
    def disagree(self) -> list[str]:
        """Names of the errors that disagree."""
        return [name for name, value in self.en.items() if value > 1.0]


def merge(machine: Machine, first: Identification, second: Identification) -> Identification:
    """Merge the identification of lengths or deviations with that of six-DOF readings of the same machine.

    Values that agree are averaged. An error that disagrees keeps the value of ``first``, with half of the difference as
    additional uncertainty, and is listed in a CompgenWarning.

    Raises
    ------
    InputError
        if the six-DOF readings do not cover all three axes, or one of the two has no uncertainties.
    """
    _check(machine, first, second)
    own = joint_covariance(first)
    names, positions, turned, factor, left = projected(machine, first.layout, second)
    values = values_at_nodes(first.errors, names, positions)
    freedom = float(second.details.get("repeatability_freedom") or MANY)
    pair = (values, own.errors_factor), (turned, factor)
    agreement = _compare(names, *pair, left, freedom)
    merged, roots = _average(names, agreement, *pair)
    errors = _table(first.errors, names, positions, merged, roots)
    texts = _texts(agreement)
    for text in texts:
        warnings.warn(text, CompgenWarning, stacklevel=3)
    details = {
        "en": agreement.en,
        "coverage_factor": agreement.coverage_factor,
        "disagree": agreement.disagree,
        "not_expressed_um": agreement.not_expressed_mm / MM_PER_UM,
        "first": first.method,
        "sixdof": dict(second.details),
    }
    return replace(
        first,
        errors=errors,
        method="merged",
        adjustment=None,
        values_factor=roots,
        worst_u=worst_uncertainty(errors),
        reversal_curves=second.reversal_curves,
        corrections={**first.corrections, **({"sixdof": dict(second.corrections)} if second.corrections else {})},
        details=details,
        objections=(*first.objections, *second.objections, *texts),
    )


def _check(machine: Machine, first: Identification, second: Identification) -> None:
    missing = [axis for axis in AXES if f"E{axis}{axis}" not in second.errors.curves]
    if missing:
        message = f"the six-DOF readings lack {', '.join(missing)}; merging requires all three axes"
        raise InputError(message + "; otherwise identify the files separately")
    if not first.has_covariance or not second.has_covariance:
        raise InputError(
            Message(
                "merge-without-uncertainty",
                "one of the measurements has no uncertainties, so they cannot be compared or averaged",
            )
        )


def _points(machine: Machine) -> FloatArray:
    """Positions (m, 3): every axis at its nodes, the others at a few levels."""
    levels = [np.linspace(*axis.range_mm, LEVELS) for axis in machine.axes]
    parts = []
    for k, axis in enumerate(machine.axes):
        lists = [axis.nodes_mm if j == k else levels[j] for j in range(3)]
        parts.append(full_grid(lists).reshape(-1, 3))
    return np.vstack(parts)


Rows = tuple[list[str], FloatArray, FloatArray, FloatArray, float]


def projected(machine: Machine, layout: ErrorParameters, second: Identification) -> Rows:
    """Six-DOF errors in the layout of another identification.

    Returns name and position of each value (k,), the values (k,), their factor (k, r), and the largest motion of the
    tool that the layout cannot express, mm.
    """
    position = _points(machine)
    bases = [layout.basis(axis, position[:, axis]) for axis in range(3)]
    design = layout.design(c_matrix(machine, position, None), bases).reshape(-1, layout.size)
    covariance = joint_covariance(second)
    target = error_design(machine, covariance, position).reshape(len(design), -1)
    motion = small_motion(position + tool_of(machine, None))  # each instrument has a frame of its own
    design, target = motion.taken_out(design), motion.taken_out(target)
    scale = np.linalg.norm(design, axis=0)
    found = np.linalg.lstsq(design / scale, target, rcond=1e-11)[0] / scale[:, None]
    values = values_at_nodes(second.errors, list(covariance.error), covariance.position_mm)
    left = float(np.abs((design @ found - target) @ values).max())
    names, positions, rows = [], [], []
    for name, at, columns, matrix in error_values(layout):
        names += [name] * len(at)
        positions.append(at)
        rows.append(matrix @ found[columns])
    change = np.vstack(rows)
    return names, np.concatenate(positions), change @ values, change @ covariance.errors_factor, left


def _compare(
    names: Sequence[str], first: Uncertain, second: Uncertain, left_mm: float, freedom: float
) -> InstrumentAgreement:
    from scipy.special import stdtrit  # imported here: slow to load, and few measurements have two instruments

    found = compare(first, second)
    known = found.u > 1e-15
    k = -float(stdtrit(freedom, FALSE_ALARM / 2.0 / max(int(known.sum()), 1)))
    ratio = np.where(known, normalized_error(found.value, k * found.u), 0.0)
    label = np.array(names)
    en = {name: float(ratio[label == name].max()) for name in dict.fromkeys(names)}
    return InstrumentAgreement(en, k, left_mm)


def _average(
    names: Sequence[str], agreement: InstrumentAgreement, first: Uncertain, second: Uncertain
) -> tuple[FloatArray, FloatArray]:
    """Weighted means (k,) and a factor of their covariance; disagreeing errors keep the first value."""
    (one, root1), (other, root2) = first, second
    square1, square2 = (np.einsum("ij,ij->i", root, root) for root in (root1, root2))
    square = square1 + square2
    share = np.where(square > 0, square1 / np.where(square > 0, square, 1.0), 0.0)
    label = np.array(names)
    odd = np.zeros((len(names), len(agreement.disagree)))
    for column, name in enumerate(agreement.disagree):
        rows = label == name
        share[rows] = 0.0
        odd[rows, column] = 0.5 * (other - one)[rows]
    merged = (1.0 - share) * one + share * other
    return merged, np.hstack([(1.0 - share)[:, None] * root1, share[:, None] * root2, odd])


def _table(
    errors: ErrorTable, names: Sequence[str], positions: FloatArray, values: FloatArray, root: FloatArray
) -> ErrorTable:
    u = np.sqrt(np.einsum("ij,ij->i", root, root))
    label = np.array(names)
    rows = {name: label == name for name in dict.fromkeys(names)}
    found = table_of_values((name, positions[at], values[at], u[at]) for name, at in rows.items())
    return errors.replace(curves=found.curves, squareness=found.squareness)


def _texts(agreement: InstrumentAgreement) -> tuple[str, ...]:
    """Return the warnings; empty if everything agrees."""
    if not agreement.disagree:
        return ()
    listed = ", ".join(f"{name} ({agreement.en[name]:.1f})" for name in agreement.disagree)
    kinds = {error_named(name).kind for name in agreement.disagree}
    return (
        f"the two instruments disagree beyond their uncertainty in {listed} (En, 1 is the limit): these "
        f"{'angles and lengths' if len(kinds) > 1 else 'errors'} keep the value of the first one with half of the "
        "difference as uncertainty; check calibration, set-up and time between the measurements",
    )
