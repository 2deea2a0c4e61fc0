"""Numbers that a person typed, beside measurements of the same: refused where they contradict, otherwise adjusted together.

A squareness or a scale joins the adjustment as a reading of its own (:mod:`compgen.identification.together`); a backlash is
joined with the measured reversal here. Which sign a reversal value has is asked, not guessed.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from compgen.data.axis_runs import SAME_TARGET_MM, AxisRuns, two_way_mean
from compgen.data.circles import Circles
from compgen.data.comparison import normalized_error
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import SPANS_KEY, Curve, ErrorTable, square_spans_mm
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.effects.active import added, effects_reversal
from compgen.errors import CompgenWarning, InputError, Message, UndeterminedError
from compgen.identification.adjust.determined import FINEST, Observations
from compgen.identification.adjust.unknowns import ErrorParameters
from compgen.identification.axis_tests import identify_circles, u_scale_of
from compgen.identification.kinds import Measurement, MixedMeasurement
from compgen.identification.options import STATED_SOURCE, StatedNumbers
from compgen.identification.posterior import square_sd
from compgen.identification.result import Identification

#: Standard uncertainty of a typed number that states none, and of a measured one where nothing was repeated: that of a
#: granite square or a dial gauge, um and urad (um/m).
ASSUMED_UM, ASSUMED_URAD = 1.0, 5.0

#: Reversals along axes, with the name of what showed them.
Shown = Mapping[int, Sequence[tuple[str, Curve]]]
#: Readings that take away less than this share of the variance of the prior say nothing.
NOTHING = 1e-6


def is_stated(part: object) -> bool:
    """Whether a part of a measurement is numbers that were typed."""
    return isinstance(part, ErrorTable) and part.metadata.get("source") == STATED_SOURCE


def without_stated(measurement: Measurement | ErrorTable) -> Measurement | ErrorTable | None:
    """Return what was measured, without the numbers typed beside it; None if there is nothing else."""
    if not isinstance(measurement, MixedMeasurement):
        return None if is_stated(measurement) else measurement
    parts = tuple((name, part) for name, part in measurement.parts if not is_stated(part))
    return parts[0][1] if len(parts) == 1 else MixedMeasurement(parts)


def over_travel(machine: Machine, errors: ErrorTable) -> ErrorTable:
    """Return errors whose squareness is that of the whole travel, where it was read from squares with shorter arms.

    What the guides do within and beside the arms adds to the uncertainty (:func:`compgen.identification.posterior.square_sd`). A
    reading without an uncertainty has that of a granite square.

    Raises
    ------
    InputError
        for arms that the errors state and nobody understands.
    """
    spans = square_spans_mm(errors)
    if not spans:
        return errors
    squareness = dict(errors.squareness)
    for name in spans.keys() & squareness.keys():
        value, u = squareness[name]
        own = ASSUMED_URAD * RAD_PER_URAD if np.isnan(u) else u
        squareness[name] = value, float(np.hypot(own, square_sd(machine, name, spans[name])))
    kept = {key: text for key, text in errors.metadata.items() if key != SPANS_KEY}
    return errors.replace(squareness=squareness, metadata=kept)


def given_numbers(result: Identification) -> bool:
    """Whether errors that were given are numbers that were typed."""
    return result.method == "given" and result.details.get("file") == STATED_SOURCE


def factor_of_numbers(errors: ErrorTable) -> FloatArray:
    """Return a factor of the covariance of typed numbers, a column each, in the order of the table: a scale moves both ends."""
    columns = []
    for name, rows in errors.rows().items():
        column = np.zeros(len(errors.values()))
        if name in errors.squareness:
            column[rows] = errors.squareness[name][1]
        else:
            curve, reference_mm = errors.curves[name], errors.curves[name].position_mm[errors.curves[name].u == 0.0]
            column[rows] = curve.u * np.sign(curve.position_mm - reference_mm[0])
        columns.append(column)
    return np.column_stack(columns)


def stated_observations(layout: ErrorParameters, errors: ErrorTable, *, lines: bool) -> Observations:
    """Return typed numbers as readings of the errors of a layout; each number counts once, also where it rules two ends.

    A scale is the slope of a curve from end to end of the travel, which says nothing of its shape. With ``lines`` the curve
    is a line, as least squares without a prior need it. A number that states no uncertainty has that of a granite square.
    """
    errors = errors.only(*(name for name, _ in layout.columns()))
    names, at = list(errors.squareness), [np.nan] * len(errors.squareness)
    values, u = ([pair[k] for pair in errors.squareness.values()] for k in (0, 1))
    rows = layout.value_rows(names, np.array(at))
    for name, curve in errors.curves.items():
        away = curve.position_mm - layout.machine.reference_point_mm[error_named(name).axis]
        ends = np.abs(away) > SAME_TARGET_MM
        on_curve = layout.value_rows([name] * len(away), curve.position_mm)
        slope = np.tile((on_curve[-1] - on_curve[0]) / (away[-1] - away[0]), (len(away), 1))
        rows = np.vstack([rows, on_curve[ends] / away[ends, None] if lines else slope[ends]])
        values += (curve.value[ends] / away[ends]).tolist()
        u += (curve.u[ends] / np.abs(away[ends])).tolist()
        names, at = [*names, *[name] * int(ends.sum())], [*at, *curve.position_mm[ends].tolist()]
    at_mm, known = np.full((len(names), 3), np.nan), np.nan_to_num(u, nan=RAD_PER_URAD * ASSUMED_URAD)
    at_mm[np.arange(len(names)), [error_named(name).axis for name in names]] = at
    return Observations(
        design=rows,
        others=np.zeros((len(names), 0)),
        value=np.array(values),
        # the ends of a scale share what is known of it
        sigma=np.sqrt([names.count(name) for name in names]) * np.maximum(known, RAD_PER_URAD * FINEST),
        at_mm=at_mm,
        shows=np.array(names)[:, None]
        == np.array([curve.error.name for curve in layout.curves], dtype=object)[None, :],
    )


def u_scale_of_runs(machine: Machine, measurement: Measurement | ErrorTable | None) -> float:
    """Standard uncertainty of the scale of the axis runs in a measurement, per mm; zero if there are none."""
    parts = measurement.parts if isinstance(measurement, MixedMeasurement) else (("", measurement),)
    return max((u_scale_of(machine, part) for _, part in parts if isinstance(part, AxisRuns)), default=0.0)


def check_errors(numbers: StatedNumbers, measured: Identification, u_scale: float) -> None:
    """Raise InputError for a typed squareness or scale that contradicts the measured one.

    ``u_scale`` is the uncertainty of the scale of the instrument where there is no prior, which contains it otherwise.
    """
    typed_errors = numbers.errors(measured.layout.machine)
    typed_squareness = {} if typed_errors is None else over_travel(measured.layout.machine, typed_errors).squareness
    for name, typed in typed_squareness.items():
        if name in measured.errors.squareness:
            _compare("--squareness", name, typed, _squareness(measured, name))
    for letter, typed in numbers.scales().items():
        name = f"E{letter}{letter}"
        if name in measured.errors.curves and len(measured.errors.curves[name].value) > 1:
            _compare("--scale", letter, typed, _slope(measured, name, u_scale))


def _squareness(measured: Identification, name: str) -> tuple[float, float]:
    """A squareness over the travel and its standard uncertainty, rad, by the readings without its own prior."""
    found = measured.posterior
    if found is None:
        return measured.errors.squareness[name]
    curve = found.curve(name, np.zeros(1))
    return _without_prior(float(curve.value[0]), float(curve.u[0]), found.squareness_sd[name])


def _slope(measured: Identification, name: str, u_scale: float) -> tuple[float, float]:
    """Slope of a curve over its positions and its standard uncertainty, rad.

    The number may be the slope from end to end or that of the best line: the difference of both adds to the uncertainty.
    """
    own = measured.errors.curves[name]
    at, found = own.position_mm, measured.posterior
    away = at - at.mean()
    best, ends = away / float(away @ away), np.zeros(len(at))
    ends[[0, -1]] = np.array([-1.0, 1.0]) / float(np.ptp(at))
    apart = float((best - ends) @ own.value)
    if found is None:
        known = np.nan_to_num(own.u, nan=ASSUMED_UM * MM_PER_UM)
        return float(ends @ own.value), float(np.linalg.norm([*(best * known), apart, u_scale]))
    prior = found.processes[name].covariance(at, at)
    u = float(np.linalg.norm(ends @ found.values_factor([name], [at])))
    sd = float(np.sqrt(ends @ prior @ ends))
    value, u = _without_prior(float(ends @ found.curve(name, at).value), u, sd)
    return value, float(np.hypot(u, apart))


def _without_prior(mean: float, u: float, sd: float) -> tuple[float, float]:
    """Return what the readings say of a number, of which the posterior is a mean with u, and the prior zero with sd."""
    left = 1.0 - (u / sd) ** 2
    return (mean / left, u / float(np.sqrt(left))) if left > NOTHING else (mean, np.inf)


def _compare(option: str, name: str, typed: tuple[float, float], found: tuple[float, float]) -> None:
    """Raise InputError if a typed angle or ratio contradicts the measured one; both with their standard uncertainty, rad."""
    assumed = ASSUMED_URAD * RAD_PER_URAD
    typed_u, found_u = (assumed if np.isnan(u) else u for _, u in (typed, found))
    expanded = COVERAGE * float(np.hypot(typed_u, found_u))
    en = float(normalized_error(np.array([typed[0] - found[0]]), np.array([expanded]))[0])
    if en <= 1.0:
        return
    unit = "urad" if option == "--squareness" else "um/m"
    turned = abs(typed[0] + found[0]) < expanded < abs(found[0])
    hint = " It has the opposite sign: docs/instruments.md has a drawing of each." if turned else ""
    stated = "not given, 5 assumed" if np.isnan(typed[1]) else f"{typed_u / RAD_PER_URAD:.3g}"
    raise InputError(
        Message(
            "stated-contradicts",
            "{name} = {typed:.4g} {unit} (u: {stated}) contradicts what was measured, "
            "{found:.4g} {unit2} (u: {found_u:.3g}): En = {en:.1f}, 1 is the limit.{hint} Check "
            "sign and unit, or leave one of the two out",
            name=name,
            typed=typed[0] / RAD_PER_URAD,
            unit=unit,
            stated=stated,
            found=found[0] / RAD_PER_URAD,
            unit2=unit,
            found_u=found_u / RAD_PER_URAD,
            en=en,
            hint=hint,
        ),
        field=option,
    )


# Reversal: a typed backlash beside the reversals that axis runs, circles, tracers or the machine file show.


def shown_reversals(measurement: Measurement | ErrorTable | None, result: Identification) -> Shown:
    """Return the reversals along each axis that were measured, also those that are too small for a table."""
    parts = measurement.parts if isinstance(measurement, MixedMeasurement) else (("the measurement", measurement),)
    found: dict[int, list[tuple[str, Curve]]] = {}
    for name, part in parts:
        for axis, curve in _reversals_of(result, part):
            found.setdefault(axis, []).append((name, curve))
    if result.reversal is not None:
        removed = effects_reversal(result.layout.machine, result.corrections.get("effects", {}))
        for letter, item in result.reversal.axes.items():
            axis = AXES.index(letter)
            curve = Curve(np.zeros(1), np.array([item.vector_mm[axis]]), np.array([item.u_mm[axis]]))
            own = None if removed is None else removed.curves.get((axis, axis))
            found.setdefault(axis, []).append(("the lengths", added(own, curve)))
    curves = {} if result.reversal_curves is None else result.reversal_curves.curves
    for (axis, component), curve in curves.items():
        if axis == component:
            found.setdefault(axis, [("the measurement", curve)])
    return found


def _reversals_of(result: Identification, part: object) -> Iterator[tuple[int, Curve]]:
    if isinstance(part, AxisRuns):
        for axis in part.axes:
            rows = part.axis == axis
            reversal = two_way_mean(part.position_mm[rows], part.direction[rows], part.deviation_mm[rows])[1]
            if reversal is not None:
                yield axis, reversal
    if isinstance(part, Circles):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", CompgenWarning)  # said when they were identified
                unknowns = identify_circles(result.layout.machine, part).details["unknowns"]
        except UndeterminedError:
            return
        for item in unknowns:
            if item["what"] == "reversal":
                value, u = MM_PER_UM * item["value"], MM_PER_UM * item["u"]
                yield AXES.index(item["of"]), Curve(np.zeros(1), np.array([value]), np.array([u]))


def joined_reversal(axis: int, number: Curve, sources: Sequence[tuple[str, Curve]]) -> Curve:
    """Return the reversal along an axis of a number and what was measured of it, the first of which counts.

    Raises
    ------
    InputError
        for a number that contradicts any of them.
    """
    value, u = float(number.value[0]), float(number.u[0])
    for source, curve in sources:
        _compare_reversal(axis, (value, u), source, curve)
    return _adjusted(sources[0][1], value, _or_assumed(u)) if sources else number


def _compare_reversal(axis: int, typed: tuple[float, float], source: str, curve: Curve) -> None:
    mean, u_mean = _mean(curve)
    expanded = COVERAGE * float(np.hypot(np.hypot(_or_assumed(typed[1]), u_mean), np.std(curve.value)))
    if not abs(typed[0] - mean) > expanded:
        return
    en = abs(typed[0] - mean) / expanded
    turned = " It has the opposite sign." if abs(typed[0] + mean) < expanded < abs(mean) else ""
    letter = AXES[axis]
    stated = f"not given, {ASSUMED_UM:g} assumed" if np.isnan(typed[1]) else f"{typed[1] / MM_PER_UM:.3g}"
    raise InputError(
        Message(
            "stated-reversal-contradicts",
            "{letter}: a reversal value B of {typed:+.4g} um (u: {stated}) contradicts that of "
            "{source}, B = {mean:+.4g} um (u: {u_mean:.3g}): En = {en:.1f}, 1 is the "
            "limit.{turned} B is negative where the axis stays behind, and --backlash positive: "
            "B = -6 um is {letter2}=6, or {letter3}=B=-6. Correct the number, or leave it out",
            letter=letter,
            typed=typed[0] / MM_PER_UM,
            stated=stated,
            source=source,
            mean=mean / MM_PER_UM,
            u_mean=u_mean / MM_PER_UM,
            en=en,
            turned=turned,
            letter2=letter,
            letter3=letter,
        ),
        field="--backlash",
    )


def _mean(curve: Curve) -> tuple[float, float]:
    """Mean of a reversal over its positions, and its standard uncertainty, mm."""
    u = np.where(np.isnan(curve.u), ASSUMED_UM * MM_PER_UM, curve.u)
    return float(curve.value.mean()), float(np.linalg.norm(u)) / len(u)


def _or_assumed(u: float) -> float:
    return ASSUMED_UM * MM_PER_UM if np.isnan(u) else u


def _adjusted(curve: Curve, value: float, u: float) -> Curve:
    """Return a measured reversal adjusted together with a number, which is its mean over the travel (least squares)."""
    own_u: FloatArray = np.where(np.isnan(curve.u), ASSUMED_UM * MM_PER_UM, curve.u)
    mean, u_mean = _mean(curve)
    # the number is that of an unknown place: the spread over the travel is a part of its uncertainty
    total = u_mean**2 + u**2 + float(np.var(curve.value))
    if total == 0.0:
        return curve
    share = own_u**2 / len(own_u)
    moved = curve.value + share / total * (value - mean)
    return Curve(curve.position_mm, moved, np.sqrt(np.maximum(own_u**2 - share**2 / total, 0.0)))


def check_signs(numbers: StatedNumbers, shown: Mapping[int, object]) -> None:
    """Ask for the sign of a reversal that is typed as a negative backlash, where nothing in ``shown`` tells it, by axis.

    Raises
    ------
    InputError
        with both ways to write it.
    """
    for letter, (value, _) in numbers.backlashes().items():
        if value > 0.0 and not numbers.says_reversal_value(letter) and AXES.index(letter) not in shown:
            um = value / MM_PER_UM
            raise InputError(
                Message(
                    "stated-reversal-negative",
                    "{letter}={backlash}: is that an axis that runs ahead, or the reversal value B of "
                    "ISO 230-2, which is negative where the axis stays behind? For a printed B = "
                    "{um:.4g} um write {letter2}=B={um2:.4g}, the same as {letter3}={um3:.4g}; for an "
                    "axis that runs ahead {letter4}=B=+{um4:.4g}. The backlash parameter of a control is "
                    "positive for play",
                    letter=letter,
                    backlash=numbers.backlash[letter],
                    um=-um,
                    letter2=letter,
                    um2=-um,
                    letter3=letter,
                    um3=um,
                    letter4=letter,
                    um4=um,
                ),
                field="--backlash",
            )


def with_contradictions(result: Identification, shown: Shown) -> Identification:
    """Return a result with a doubt for each axis of which two instruments show different reversals."""
    found = []
    for axis, sources in shown.items():
        for (one, first), (other, second) in zip(sources, sources[1:], strict=False):
            (a, u_a), (b, u_b) = _mean(first), _mean(second)
            expanded = COVERAGE * float(
                np.linalg.norm([u_a, u_b, float(np.std(first.value)), float(np.std(second.value))])
            )
            if abs(a - b) > max(expanded, ASSUMED_UM * MM_PER_UM):
                found.append(
                    f"{one} and {other} disagree in the reversal of {AXES[axis]}: B = {a / MM_PER_UM:+.3g} and "
                    f"{b / MM_PER_UM:+.3g} um, more than the uncertainty of both; check directions and feed"
                )
    for text in found:
        warnings.warn(text, CompgenWarning, stacklevel=3)
    return replace(result, doubts=(*result.doubts, *found)) if found else result
