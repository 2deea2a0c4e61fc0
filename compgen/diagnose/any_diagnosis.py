"""Diagnose: find where model and measurement disagree, name the effect, add it, and see the misfit shrink."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import PART, Artefact, Deviations
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import option
from compgen.diagnose.analysis import Analysis, analyse, leftover
from compgen.diagnose.axis_diagnosis import LEAST_FREEDOM, AxisDiagnosis, findings_of
from compgen.diagnose.axis_session import Order
from compgen.diagnose.base_fit import BaseFit, CurveBasis, base_errors, fit_base, least_norm
from compgen.diagnose.circle_diagnosis import CircleDiagnosis, diagnose_circles
from compgen.diagnose.diagnosis import Classed, Diagnosis, misfit_before_after, refit
from compgen.diagnose.feature_diagnosis import FeatureDiagnosis, diagnose_features
from compgen.diagnose.groups import fit_smooth
from compgen.diagnose.layout import IntArray, MeasurementLayout
from compgen.diagnose.noise_model import difference_matrix
from compgen.diagnose.observed import Measurement, Observed, ObservedDeviations, ObservedLengths, located
from compgen.diagnose.verdict import advice_of, compared, verdict_of
from compgen.effects import catalogue
from compgen.effects.active import active_effects
from compgen.errors import CompgenError, InputError, Message, messages_of, nearest
from compgen.identification.adjust.starts import robust_state
from compgen.identification.adjust.unknowns import State, dead_lengths_of
from compgen.instruments.sixdof_health import Suspicion, sixdof_health, turning_beams
from compgen.instruments.sixdof_instrument import SixDof, SixDofInstrument
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.kernel_switch import one_thread

# Gross errors of convention, checked first: swapped axes, wrong signs, reversed tool offset, mixed-up stations.
#
# They leave residuals of mm, whereas machine errors leave um. All 48 signed permutations of the axes are tried, each
# with the tool unchanged, reversed, and mapped like the axes; then the station labels in single runs.


#: Residuals above this many times the scatter of repeats, or this many mm without repeats, are checked further.
SUSPICIOUS, SUSPICIOUS_MM = 20.0, 0.02
#: A mapping is accepted if it makes the residual this many times smaller.
BETTER = 5.0
#: Readings that a mapping is tried on.
READINGS = 900
#: Residual of a reading, mm, above which only a wrong label explains it.
LABEL_MM = 0.5
#: Maximum number of mappings that are compared with the machine errors in the model.
MOST_CLOSE = 24


@dataclass(frozen=True)
class Correction:
    """Corrected lengths, and a description of what was wrong."""

    lengths: Lengths
    text: str


def looks_gross(observed: ObservedLengths, rms_mm: float) -> bool:
    """Whether the residual of the base model is far larger than the scatter of repeats."""
    squares, count = 0.0, 0
    for block in observed.layout.blocks:
        values = difference_matrix(observed.layout, block) @ observed.value_mm[block.rows]
        squares += float(np.sum(values**2))
        count += values.size
    if count < 20:
        return rms_mm > SUSPICIOUS_MM
    return rms_mm > SUSPICIOUS * float(np.sqrt(squares / count)) or rms_mm > 1.0


def correction_of(machine: Machine, lengths: Lengths, rms_mm: float) -> Correction | None:
    """Return the mapping that makes the residuals small; None if there is none."""
    some = _some(lengths)
    scored = [(_stations_only(machine, mapped), text, mapped) for text, mapped in _mappings(machine, some)]
    if scored:
        scored.sort(key=lambda item: item[0])
        # mappings that the stations alone cannot distinguish are compared with the machine errors in the model
        close = [item for item in scored if item[0] < 3.0 * scored[0][0]][:MOST_CLOSE]
        if len(close) > 1 or scored[0][0] > 0.5 * _stations_only(machine, some):
            close = sorted(((_small_fit(machine, e[2]), e[1], e[2]) for e in close), key=lambda item: item[0])
        least, what, best = close[0]
        if least < rms_mm / BETTER or _small_fit(machine, best) < rms_mm / BETTER:
            return Correction(dict(_mappings(machine, lengths))[what], what)
    return _relabelled(machine, lengths, rms_mm)


def _mappings(machine: Machine, lengths: Lengths) -> Iterator[tuple[str, Lengths]]:
    several = lengths.tool_mm is not None and bool(np.any(lengths.tool_mm))
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            moved = lengths.position_mm @ turn.T
            room = 0.05 * (machine.upper_mm - machine.lower_mm)
            if not ((moved >= machine.lower_mm - room) & (moved <= machine.upper_mm + room)).all():
                continue  # beyond the travel of the machine
            plain = bool(np.array_equal(turn, np.eye(3)))
            parts = [f"{AXES[k]} is {'-' if signs[k] < 0 else ''}{AXES[order[k]]} of the file" for k in range(3)]
            what = "" if plain else ", ".join(p for k, p in enumerate(parts) if order[k] != k or signs[k] < 0)
            if not plain:
                yield what, replace(lengths, position_mm=moved)
            if several and lengths.tool_mm is not None:
                yield (
                    _joined(what, "the tool offset has the other sign"),
                    replace(lengths, position_mm=moved, tool_mm=-lengths.tool_mm),
                )
                if not plain:
                    yield (
                        _joined(what, "the tool offset is rotated in the same way"),
                        replace(lengths, position_mm=moved, tool_mm=lengths.tool_mm @ turn.T),
                    )


def _joined(first: str, second: str) -> str:
    return f"{first}; {second}" if first else second


def _some(lengths: Lengths) -> Lengths:
    rng = np.random.default_rng(0)
    return lengths.part(np.sort(rng.choice(len(lengths), min(READINGS, len(lengths)), replace=False)))


def _small_fit(machine: Machine, lengths: Lengths) -> float:
    """Residual RMS in mm of a base model of low degree on some of the readings."""
    basis = CurveBasis(machine, base_errors(machine), (4, 4, 4))
    try:
        return fit_base(ObservedLengths(machine, _some(lengths)), basis, steps=3).rms_mm
    except (CompgenError, np.linalg.LinAlgError):
        return float("inf")


def _stations_only(machine: Machine, lengths: Lengths) -> float:
    """Residual RMS in mm for a perfect machine: enough to distinguish mm from um."""
    target = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    group = dead_lengths_of(lengths)
    squares = 0.0
    for k in range(len(lengths.stations)):
        rows = np.flatnonzero(lengths.station == k)
        own, member = np.unique(group[rows], return_inverse=True)
        residual = located(target[rows], lengths.length_mm[rows], member.ravel().astype(np.int64), len(own))[1]
        squares += float(np.sum(residual**2))
    return float(np.sqrt(squares / len(lengths)))


def _relabelled(machine: Machine, lengths: Lengths, rms_mm: float) -> Correction | None:
    """Swap the labels of two stations in runs whose readings fit after the swap."""
    observed = ObservedLengths(machine, lengths)
    if len(lengths.stations) < 2:
        return None
    count = len(lengths.stations)
    placement = observed.start()
    state = State(np.zeros(0), placement[: 3 * count].reshape(-1, 3), placement[3 * count :])
    target = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    try:
        state, _ = robust_state(state, lengths, target, lengths.station, observed.group)
    except CompgenError:
        return None
    distance = np.linalg.norm(target[:, None, :] - state.stations_mm[None], axis=2)
    station, swapped = _swapped(observed, lengths, distance, state)
    if not swapped:
        return None
    better = replace(lengths, station=station)
    if not _small_fit(machine, better) < rms_mm / BETTER:
        return None
    pairs = sorted({f"{lengths.stations[i]} and {lengths.stations[j]}" for _, i, j in swapped})
    return Correction(better, f"the labels of stations {', '.join(pairs)} are exchanged in {len(swapped)} run(s)")


def _swapped(
    observed: ObservedLengths, lengths: Lengths, distance: FloatArray, state: State
) -> tuple[IntArray, list[tuple[int, int, int]]]:
    """Labels after the swaps, and each swap as (run, station, station)."""
    count = len(lengths.stations)
    run = observed.layout.run[observed.layout.stop]
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    group_of = {(int(s), int(k)): int(g) for s, k, g in zip(lengths.station, setup, observed.group, strict=True)}
    station = lengths.station.copy()
    own = distance[np.arange(len(station)), station] - state.dead_length_mm[observed.group] - lengths.length_mm
    found = []
    for number in np.unique(run[np.abs(own) > LABEL_MM]):
        here = np.flatnonzero(run == number)
        for i in range(count):
            for j in range(i + 1, count):
                rows = here[(lengths.station[here] == i) | (lengths.station[here] == j)]
                other = np.where(lengths.station[rows] == i, j, i)
                group = [group_of.get((int(o), int(setup[r])), 0) for o, r in zip(other, rows, strict=True)]
                fit = distance[rows, other] - state.dead_length_mm[group] - lengths.length_mm[rows]
                if len(rows) and np.median(np.abs(fit)) < LABEL_MM < np.median(np.abs(own[rows])):
                    station[rows] = other
                    found.append((int(number), i, j))
    return station, found


# Named classes of noise: outliers, a trend of the variance with time, quantisation.
#
# They are looked for in the residuals after the model, all effects found and the free generic terms, so an effect is
# not mistaken for an outlier.


#: A reading further than this many standard deviations from its neighbours in time is gross; without gross errors, only
#: one in 10^5 sets of 4600 readings contains such a reading.
GROSS = 6.5
#: Gross readings are the exception: a larger share has another cause.
MOST_GROSS = 0.03
#: Number of neighbours in time, including the reading itself, whose median a reading is compared with.
NEIGHBOURS = 5
#: Maximum number of rounds: a gross reading shifts the fit and other residuals, so the largest are removed first and
#: the fit is repeated.
ROUNDS = 8
#: Burst lengths (stops) that are tried, and the largest share of the session that counts as a burst.
BURSTS, LONGEST_BURST = (2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48), 0.03
#: Least excess of the mean square in a burst over the median of all windows of that length, in their robust standard
#: deviations. Wandering noise common to all stations has one degree of freedom per window: fewer than one window in
#: 50,000 then exceeds 30.
LOUD = 30.0
#: Stops at the ends of a burst with less than this many times the median mean square are not part of it.
QUIET = 5.0
#: Maximum number of bursts, and of rounds in which the fit is repeated without them.
MOST_BURSTS = 3
#: Standard normal deviate of the slope of the variance against time above which it is a trend.
TREND_Z = 6.0
#: Least share of readings on the grid of the step, and least ratio of step to noise.
ON_GRID, COARSE = 0.999, 1.0


def classes_of(analysis: Analysis, removed: int = 0) -> list[Classed]:
    """Return the noise classes that the readings clearly show; ``removed`` gross readings were left out."""
    text = f"{removed} reading(s) lie more than {GROSS:g} standard deviations from their neighbours; they were left out"
    found = [Classed("outliers", {"count": float(removed)}, 1.0, text)] if removed else []
    found += _trend(analysis, leftover(analysis.design, analysis.chosen))
    # all readings are on a grid whose step is as large as the noise
    values = analysis.fit.observed.value_mm
    apart = np.diff(np.unique(np.round(values, 7)))
    step = float(apart.min()) if apart.size else 0.0
    if apart.size and step >= COARSE * float(np.sqrt(analysis.noise.variances.white)):
        off = np.abs(values / step - np.round(values / step))
        if float(np.mean(off < 0.01)) >= ON_GRID:
            text = f"readings are multiples of {step / MM_PER_UM:g} um, as coarse as the noise"
            found.append(Classed("quantisation", {"step_um": step / MM_PER_UM}, 1.0, text))
    return found


def gross_readings(analysis: Analysis) -> IntArray:
    """Rows of readings far from their neighbours after subtracting all findings; none if there are many."""
    fit, left = analysis.fit, analysis.left_mm
    kept = np.ones(len(left), dtype=bool)
    for _ in range(ROUNDS):
        size = _apart(fit.observed.layout, left / analysis.noise.scale) * kept
        if size.max() <= GROSS:
            break
        kept &= size < max(GROSS, 0.5 * float(size.max()))
        left = _left_without(analysis, kept)
    found = np.flatnonzero(~kept)
    return found if len(found) <= MOST_GROSS * len(kept) else np.zeros(0, dtype=np.int64)


def _left_without(analysis: Analysis, kept: NDArray[np.bool_]) -> FloatArray:
    """Residuals of all readings after a fit to those ``kept``, (n,)."""
    columns, residual_mm = analysis.columns(), analysis.fit.residual_mm
    return np.asarray(residual_mm - columns @ least_norm(columns[kept], residual_mm[kept]))


def _apart(layout: MeasurementLayout, left: FloatArray) -> FloatArray:
    """Distance from the median of the neighbours in time on the same channel, in standard deviations, (n,)."""
    apart = np.zeros_like(left)
    for channel in np.unique(layout.channel):
        rows = np.flatnonzero(layout.channel == channel)
        rows = rows[np.argsort(layout.stop[rows], kind="stable")]
        around = sliding_window_view(np.pad(left[rows], NEIGHBOURS // 2, mode="edge"), NEIGHBOURS)
        apart[rows] = left[rows] - np.median(around, axis=1)
    moved = np.abs(apart[apart != 0.0])
    if len(moved) < NEIGHBOURS * NEIGHBOURS:
        return np.zeros(len(left))
    return np.asarray(np.abs(apart) / (1.4826 * float(np.median(moved))))


@dataclass(frozen=True)
class Burst:
    """Readings ``rows`` that are far off for a short time, from ``first`` to ``last`` (s, or stop numbers)."""

    rows: IntArray
    first: float
    last: float
    rms_mm: float
    timed: bool

    @property
    def text(self) -> str:
        """Description in words."""
        unit = " s" if self.timed else ""
        what = "time" if self.timed else "stop"
        return (
            f"disturbed readings from {what} {self.first:g}{unit} to {self.last:g}{unit}: {len(self.rows)} readings, "
            f"{self.rms_mm / MM_PER_UM:.2f} um rms in addition to everything that was found"
        )


def disturbed_readings(analysis: Analysis) -> list[Burst]:
    """Short bursts in time in which the readings of all channels are far off (a draught, a person at the machine).

    Residuals are compared between windows of equal length, which scales with the noise, including slow noise. The fit
    is repeated without each burst because a burst distorts it.
    """
    layout, left = analysis.fit.observed.layout, analysis.left_mm
    kept = np.ones(len(left), dtype=bool)
    found: list[Burst] = []
    for _ in range(MOST_BURSTS):
        window = _loudest(layout, (left / analysis.noise.scale) ** 2 * kept)
        if window is None:
            break
        rows = np.flatnonzero((layout.stop >= window[0]) & (layout.stop <= window[1]) & kept)
        kept[rows] = False
        left = _left_without(analysis, kept)
        first, last = (float(layout.time[stop]) for stop in window)
        found.append(Burst(rows, first, last, float(np.sqrt(np.mean(left[rows] ** 2))), layout.timed))
    return found


def _loudest(layout: MeasurementLayout, square: FloatArray) -> tuple[int, int] | None:
    """First and last stop of the window with the largest excess, or None; ``square`` (n,) is zero where left out."""
    count = np.bincount(layout.stop, minlength=layout.stops)
    power = np.bincount(layout.stop, square, layout.stops) / np.maximum(count, 1)
    best: tuple[float, tuple[int, int]] | None = None
    for length in BURSTS:
        if length > max(LONGEST_BURST * layout.stops, 2) or layout.stops < 20 * length:
            break
        mean = np.convolve(power, np.ones(length) / length, "valid")
        middle = float(np.median(mean))
        spread = 1.4826 * float(np.median(np.abs(mean - middle)))
        start = int(np.argmax(mean))
        ratio = float(mean[start]) / middle if middle > 0.0 else 0.0
        gain = length * (ratio - 1.0 - np.log(max(ratio, 1.0)))
        if mean[start] - middle > LOUD * spread > 0.0 and (best is None or gain > best[0]):
            best = (gain, (start, start + length - 1))
    if best is None:
        return None
    first, last = best[1]
    quiet = QUIET * float(np.median(power))
    while first < last and power[first] < quiet:
        first += 1
    while first < last and power[last] < quiet:
        last -= 1
    return first, last


def disturbed_class(bursts: Sequence[Burst], *, left_out: bool) -> list[Classed]:
    """Bursts in the form in which they are reported."""
    end = "left out" if left_out else "--leave-out-disturbed leaves them out"
    return [
        Classed(
            "disturbed_readings",
            {"first": b.first, "last": b.last, "count": float(len(b.rows)), "rms_um": b.rms_mm / MM_PER_UM},
            1.0,
            f"{b.text}; {end}",
        )
        for b in bursts
    ]


def _trend(analysis: Analysis, residual: FloatArray) -> list[Classed]:
    """Score test of the variance against time (Breusch and Pagan 1979, Koenker 1981 form), with outliers clipped."""
    layout = analysis.fit.observed.layout
    time = analysis.design.whiten.order_of(layout.stop)
    t = layout.time[time]
    if np.ptp(t) == 0.0:
        return []
    s = (t - t.mean()) / t.std()
    square = np.minimum(residual**2, 16.0 * float(np.mean(residual**2)))
    slope = float(np.mean(s * square) / np.mean(square))
    z = float(np.mean(s * (square - square.mean())) / (square.std() / np.sqrt(len(square))))
    if abs(z) < TREND_Z:
        return []
    text = f"the variance of the noise {'grows' if slope > 0 else 'falls'} with time"
    return [Classed("variance_trend", {"slope_per_sd": slope, "z": z}, 1.0, text)]


# The steps of a diagnosis, and the diagnosis of six-DOF readings.


Show = Callable[[str], None]

#: Residuals of the base model larger than this, mm, are not machine errors.
HOPELESS_MM = 1.0


@dataclass(frozen=True)
class DiagnoseOptions:
    """What a diagnosis may do.

    Parameters
    ----------
    max_effects : maximum number of named effects.
    effects : names to look for; default the whole catalogue.
    add : names to add whether found or not.
    u_um : standard uncertainty of a reading in um, if known; used without repeats.
    against : predicted errors that the measurement is compared with.
    leave_out_disturbed : leave out bursts of disturbed readings (lengths and deviations) that are found.
    order : time order of axis runs: as logged, otherwise run by run, up then down; or as requested by the user.
    """

    max_effects: int = option(4, "Largest number of effects to name.", within=(0, 6))
    effects: tuple[str, ...] = option(
        (), "Look only for these effects; default: the whole catalogue.", metavar="NAME,..."
    )
    add: tuple[str, ...] = option((), "Add this effect whether it was found or not.", metavar="NAME")
    u_um: float | None = option(None, "Standard uncertainty of a reading, um; used if no line was repeated.")
    against: ErrorTable | None = option(
        None,
        "Errors (*.errors.csv) to compare the measurement with, to show which have changed.",
        metavar="ERRORS",
    )
    order: Order = option(
        "auto",
        "Time order of axis runs: by time_s or the column order, else run by run, up then down (auto); or as named. The "
        "order of the rows is used only with 'rows'.",
    )
    leave_out_disturbed: bool = option(False, "Leave out short bursts of disturbed readings once they are found.")


def diagnose(
    machine: Machine,
    measurement: Measurement,
    options: DiagnoseOptions | None = None,
    *,
    show: Show = lambda _: None,
) -> Diagnosis | AxisDiagnosis | CircleDiagnosis | FeatureDiagnosis:
    """Diagnose a measurement.

    Parameters
    ----------
    machine : kinematic chain, travel, and the errors that its model contains.
    measurement : tracer lengths, measured deviations, axis runs, circles, features of a part, or an artefact.
    options : options of the diagnosis.
    show : called with a description of each step.

    Raises
    ------
    InputError
        for names that are not effects, and for too few readings.
    """
    chosen = options or DiagnoseOptions()
    if chosen.order != "auto" and not isinstance(measurement, AxisRuns):
        raise InputError("--order applies to axis runs only; other measurements are ordered by time_s")
    if isinstance(measurement, Circles):
        if chosen.against is not None:
            raise InputError("--against cannot be used with circles; identify them, and compare the errors")
        return diagnose_circles(
            machine,
            measurement,
            most=chosen.max_effects,
            only=chosen.effects,
            add=chosen.add,
            u_um=chosen.u_um,
            show=show,
        )
    if isinstance(measurement, Artefact) or (
        isinstance(measurement, Deviations) and measurement.metadata.get("measured") == PART
    ):
        if chosen.against is not None or chosen.effects or chosen.add:
            raise InputError("--against, --effects and --add cannot be used with features of parts and artefacts")
        return diagnose_features(machine, measurement, most=chosen.max_effects, u_um=chosen.u_um, show=show)
    known = catalogue(measurement.stations if isinstance(measurement, Lengths) else ())
    for name in chosen.effects:
        if name not in known:
            raise InputError(
                f"{name!r} is not an effect of this measurement; {nearest(name, known)}", field="--effects"
            )
    if isinstance(measurement, AxisRuns):
        found = findings_of(
            machine, measurement, order=chosen.order, most=chosen.max_effects, only=chosen.effects, add=chosen.add,
            u_um=chosen.u_um, against=chosen.against, show=show,
        )  # fmt: skip
        return AxisDiagnosis(machine, measurement, tuple(found))
    with one_thread():
        show("fitting the base model")
        observed = observed_of(machine, measurement)
        fit = _base(observed)
        classed: list[Classed] = []
        before = fit
        _refuse_too_few(fit)  # before the search, which is slow
        if isinstance(observed, ObservedLengths) and looks_gross(observed, fit.rms_mm):
            show("residuals are very large: trying other axes, signs and labels")
            corrected = correction_of(machine, observed.lengths, fit.rms_mm)
            if corrected is not None:
                classed.append(Classed("axis_mapping", {}, 1.0, corrected.text))
                measurement = corrected.lengths
                observed = observed_of(machine, measurement)
                fit = _base(observed)
        _refuse_too_few(fit)
        analysis = _analysed(observed, fit, chosen, show)
        before = analysis.fit if before is fit else before
        gross = gross_readings(analysis)
        if len(gross):
            show(f"leaving out {len(gross)} gross readings")
            observed = observed.part(np.setdiff1d(np.arange(len(observed)), gross))
            plain = before is analysis.fit
            analysis = _analysed(observed, _base(observed), chosen, show)
            before = analysis.fit if plain else before
        bursts = disturbed_readings(analysis)
        classed += disturbed_class(bursts, left_out=chosen.leave_out_disturbed)
        if bursts and chosen.leave_out_disturbed:
            show("leaving out disturbed readings")
            loud = np.concatenate([burst.rows for burst in bursts])
            observed = observed.part(np.setdiff1d(np.arange(len(observed)), loud))
            analysis = _analysed(observed, _base(observed), chosen, show)
        return _completed(machine, analysis, chosen, show, before, classed, len(gross))


def _refuse_too_few(fit: BaseFit) -> None:
    freedom = len(fit.observed) - fit.jacobian.shape[1]
    if freedom < LEAST_FREEDOM:
        raise InputError(
            f"{len(fit.observed)} readings with {fit.jacobian.shape[1]} unknowns leave {freedom} degrees of freedom; "
            f"a diagnosis needs at least {LEAST_FREEDOM}: measure more lines"
        )


def _base(observed: Observed) -> BaseFit:
    """Fit the base model after subtracting the effects enabled in the machine file from the readings."""
    fit = fit_smooth(observed)
    known = [effect.change_mm(fit.readings) for effect in active_effects(observed.machine)]
    present = [change for change in known if change is not None]
    if not present:
        return fit
    return fit_smooth(observed.minus(np.sum(present, axis=0)))


def _analysed(observed: Observed, fit: BaseFit, options: DiagnoseOptions, show: Show) -> Analysis:
    # standard uncertainty of every reading, if stated
    sigma_mm: FloatArray | None = None
    if options.u_um is not None:
        if not options.u_um > 0:
            raise InputError(f"an uncertainty of {options.u_um:g} um was given; it must be above zero")
        sigma_mm = np.full(len(observed), options.u_um * MM_PER_UM)
    elif isinstance(observed, ObservedLengths) and "u_length_um" in observed.lengths.covariates:
        sigma_mm = observed.lengths.covariates["u_length_um"] * MM_PER_UM
    elif isinstance(observed, ObservedDeviations) and observed.deviations.u_mm is not None:
        sigma_mm = observed.deviations.u_mm[observed.place, observed.component]
    if sigma_mm is not None and np.isnan(sigma_mm).any():
        sigma_mm = None
    return analyse(
        fit,
        most_named=options.max_effects,
        only=(*options.effects, *options.add) if options.effects else (),
        sigma_mm=sigma_mm,
        show=show,
    )


def observed_of(machine: Machine, measurement: Lengths | Deviations) -> Observed:
    """Return the measurement as scalar readings."""
    if isinstance(measurement, Lengths):
        return ObservedLengths(machine, measurement)
    return ObservedDeviations(machine, measurement)


def _completed(
    machine: Machine,
    analysis: Analysis,
    options: DiagnoseOptions,
    show: Show,
    before: BaseFit,
    classed: Sequence[Classed],
    removed: int,
) -> Diagnosis:
    """Verdict, refit and misfit; ``before`` is the fit to the unchanged file."""
    verdict = verdict_of(analysis)
    show("fitting the model with what was found")
    added, design = list(verdict.added), analysis.design
    for name in options.add:
        groups = [g for g, group in enumerate(design.groups) if group.name == name and group.tier == "named"]
        if not groups:
            known = sorted({group.name for group in design.groups if group.tier == "named"})
            raise InputError(f"{name!r} cannot be added to this measurement; possible are {', '.join(known)}")
        if not set(groups) & set(verdict.added):  # requested by the user: use its best scan position
            added.append(max(groups, key=lambda g: float(np.sum(design.score[design.place(g)] ** 2))))
    found = refit(analysis, added)
    show("testing on lines, stations and times left out")
    seen = {g: design.groups[g].columns @ design.maps[g] for g in added if design.size(g)}
    base = [columns for g, columns in seen.items() if design.groups[g].tier == "base"]
    columns = [columns for g, columns in seen.items() if design.groups[g].tier != "base"]
    predicting = [
        columns for g, columns in seen.items() if design.groups[g].tier != "base" and design.groups[g].predicts
    ]
    misfit = misfit_before_after(analysis.fit, columns, predicting, analysis.noise, base)
    if before is not analysis.fit:
        misfit = replace(misfit, train=replace(misfit.train, before_mm=before.rms_mm))
    if analysis.fit.rms_mm > HOPELESS_MM:
        text = Message(
            "positions-do-not-fit",
            "the readings do not fit the commanded positions: {rms:.3g} mm rms",
            rms=analysis.fit.rms_mm,
        )
        verdict = replace(verdict, word="not_decidable", reasons=(*verdict.reasons, text))
    advice = advice_of(analysis, verdict)
    observed = analysis.fit.observed
    classes = [*classed, *classes_of(analysis, removed)]
    done = Diagnosis(machine, analysis, verdict, found, misfit, tuple(classes), advice)
    if options.against is not None:
        against = compared(observed, analysis, options.against)
        done = replace(done, changes=against.changes, against_rms_mm=against.rms_mm)
    return done


# Six-DOF readings: what they show about the instrument, in the form of a diagnosis.
#
# An instrument error that depends only on distance is indistinguishable from a geometric error, and statistics cannot
# identify it; only changes with direction, time or order are visible. Names are tentative: a machine may bend that way.


NOTE = Message(
    "distance-is-geometry",
    "an optical error that depends only on the distance equals a geometric error: no statistical test can distinguish the two",
)
#: How to separate instrument and machine.
ADVICE = (
    Message(
        "turn-the-target",
        "turn the target by 180 degrees and measure again: separates crosstalk fixed to the target from straightness",
    ),
    Message(
        "second-target-offset",
        "measure with a second target offset: separates crosstalk and detector gains from straightness",
    ),
    Message(
        "measure-three-times", "measure forth and back three times: separates the drift of the beam from straightness"
    ),
)


@dataclass(frozen=True)
class SixDofDiagnosis:
    """What six-DOF readings show about their instrument."""

    machine: Machine
    suspicions: tuple[Suspicion, ...]

    @property
    def acceptable(self) -> bool:
        """Hints are not a reason to reject the readings."""
        return True

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        names = {item.name for item in self.suspicions}
        cards = {name: e.card for name, e in catalogue().items() if "sixdof" in e.card.kinds}
        empty = {"before_rms_um": None, "after_rms_um": None}
        return {
            "verdict": "named" if self.suspicions else "none",
            "effects": [_effect(item) for item in self.suspicions],
            "unknown": [],
            "invisible": [name for name in cards if name not in names and name != "beam_drift"],
            "secondary": [],
            "gap": {"train": empty, "noise_floor_um": None, "noise_floor_source": "assumed"},
            "advice": list(ADVICE),
            "reasons": [],
            "notes": [NOTE],
            **messages_of([*(item.text for item in self.suspicions), *ADVICE, NOTE]),
        }


def _effect(item: Suspicion) -> dict[str, Any]:
    return {
        "name": item.name,
        "alias_set": [{"name": item.name, "weight": 1.0}],
        "parameters": {key: {"value": value, "u": None} for key, value in item.evidence.items()},
        "confidence": 0.5,
        # what the drift monitor reads is measured; everything else is a hint
        "grade": "confirmed" if "range_arcsec" in item.evidence else "tentative",
        "visible_fraction": None,
        "axis": item.axis,
        "reasons": [item.text],
    }


def diagnose_sixdof(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> SixDofDiagnosis:
    """Return what the readings show about the instrument."""
    found = sixdof_health(machine, readings, instrument)
    known = {(item.name, item.axis) for item in found}  # a wrong monitor explains the beam, too
    turning = [item for item in turning_beams(machine, readings, instrument) if (item.name, item.axis) not in known]
    return SixDofDiagnosis(machine, (*found, *turning))


def sixdof_text(found: SixDofDiagnosis) -> str:
    """Return the report as Markdown text."""
    lines = [f"# Diagnosis of the six-DOF readings of {found.machine.name}", ""]
    lines += [f"* **{item.name}** ({item.axis}): {item.text}" for item in found.suspicions] or ["* nothing significant"]
    return "\n".join([*lines, "", f"Note: {NOTE}.", "", *[f"* {text}" for text in ADVICE]]) + "\n"
