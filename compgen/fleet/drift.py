"""Drift of one machine from its calibrations: trends, steps, forecasts, in figures and in sentences.

See ``docs/drift.md``; :mod:`compgen.fleet.change` compares calibrations, this module fits and forecasts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.stats import norm, t

from compgen.data.comparison import small_motion
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.errors import InputError
from compgen.fleet.change import (
    Aligned,
    Calibration,
    Change,
    ErrorChange,
    MonitoredFigure,
    aligned,
    calibrations_of,
    change_between,
    changes,
    holm,
    volume_points,
    with_all_errors,
    with_other_prior,
)
from compgen.fleet.decisions import excluded
from compgen.fleet.records import MachineRecord, active_of
from compgen.fleet.store import Store
from compgen.identification.covariance import error_design
from compgen.identification.posterior import symmetric_root

# Trend of one figure over time: weighted regression plus a random walk, temperature and sudden steps.
#
# The model of readings y_i with known standard uncertainty u_i at times t_i (days) is
#
#     y_i = level + slope t_i + c (T_i - T_ref) + sum of steps before t_i + w(t_i) + e_i,
#
# where w is a random walk with variance q per day, w(t_1) = 0. Level, slope, c and steps have flat priors; q is zero with
# a prior probability of one quarter and otherwise uniform in its logarithm, and is integrated out with its restricted
# likelihood (Patterson & Thompson 1971, Biometrika 58). Without the walk this is the weighted least-squares line.
#
# Steps are fitted together with the line: for each gap between measurements the step is estimated jointly with all
# other parameters, and q is weighted as if the step were present. A crash is then not mistaken for a random walk, nor a
# slow drift for a crash. The error probability is corrected for every gap (and every figure) tested: Bonferroni.


# Trend of one figure over time: regression, random walk, steps; forecast of the first exit from its tolerance.

#: Standard deviations of the random walk over the whole history that are tried, as multiples of the median u.
WALKS = (0.3, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
#: Prior probability that there is no random walk.
NO_WALK = 0.25
#: Temperatures that vary by less than this do not show their effect, K.
LEAST_RANGE_K = 0.5
#: Largest number of steps searched for in one series.
MOST_STEPS = 3


@dataclass(frozen=True)
class TimeSeries:
    """Readings of one figure: ``days``, ``value``, ``u`` (n,); ``temperature_k`` (n,) above its reference, or None."""

    days: FloatArray
    value: FloatArray
    u: FloatArray
    temperature_k: FloatArray | None = None


@dataclass(frozen=True)
class DriftStep:
    """A sudden change between reading ``after`` - 1 and ``after``; ``p_value`` is corrected for all tests."""

    after: int
    size: float
    u: float
    p_value: float


@dataclass(frozen=True)
class Component:
    """The trend for one size of the random walk: its share, variance per day, and the state at the last reading.

    ``coefficients`` (level, slope, temperature, steps) have the covariance ``covariance``. ``state`` is level and slope
    at the last reading (reference temperature, walk included), with joint covariance ``state_covariance`` (2, 2).
    """

    share: float
    q: float
    coefficients: FloatArray
    covariance: FloatArray
    state: FloatArray
    state_covariance: FloatArray


@dataclass(frozen=True)
class Trend:
    """Trend of a series: the steps found and the components of the random walk."""

    series: TimeSeries
    steps: tuple[DriftStep, ...]
    components: tuple[Component, ...]

    def _moments(self, index: int) -> tuple[float, float]:
        share = np.array([item.share for item in self.components])
        mean = np.array([item.coefficients[index] for item in self.components])
        spread = np.array([item.covariance[index, index] for item in self.components])
        middle = float(share @ mean)
        return middle, float(np.sqrt(share @ (spread + (mean - middle) ** 2)))

    @property
    def slope(self) -> tuple[float, float]:
        """Change per day and its standard uncertainty."""
        return self._moments(1)

    @property
    def p_value(self) -> float:
        """Probability of at least this slope if there was none."""
        value, u = self.slope
        return float(2.0 * norm.sf(abs(value) / u))

    @property
    def per_kelvin(self) -> tuple[float, float] | None:
        """Change per kelvin and its standard uncertainty; None without temperatures."""
        return None if self.series.temperature_k is None else self._moments(2)

    @property
    def walk_share(self) -> float:
        """Probability that there is a random walk in addition to the line."""
        return float(sum(item.share for item in self.components if item.q > 0.0))


def regressors(series: TimeSeries, steps: Sequence[int] = ()) -> FloatArray:
    """Columns level, slope, temperature and steps, (n, p); the level is the value at the last reading."""
    columns = [np.ones(len(series.days)), series.days - series.days[-1]]
    if series.temperature_k is not None:
        columns.append(series.temperature_k)
    columns += [_before(series, k) for k in steps]
    return np.column_stack(columns)


def _before(series: TimeSeries, after: int) -> FloatArray:
    """Column with -1 before the step and 0 after it: the level is the value after the step."""
    return np.where(np.arange(len(series.days)) < after, -1.0, 0.0)


def usable_temperature(days: FloatArray, temperature_c: FloatArray) -> bool:
    """Whether temperatures (n,) vary enough about a straight line in time to show their effect."""
    if len(days) < 5 or not np.isfinite(temperature_c).all():
        return False
    line = np.polyval(np.polyfit(days, temperature_c, 1), days)
    return bool(np.ptp(temperature_c - line) > LEAST_RANGE_K)


def fit_trend(series: TimeSeries, *, walk: bool = True, looks: int = 1, level: float = 0.01) -> Trend | None:
    """Fit the trend; None for too few readings (three, more with temperatures).

    Parameters
    ----------
    series : the readings.
    walk : whether a random walk is considered; without it the figure follows the line exactly.
    looks : number of series that are searched for steps, to correct the error probability of the steps.
    level : error probability below which a step counts.
    """
    if len(series.days) < regressors(series).shape[1] + 1 or np.ptp(series.days) <= 0.0:
        return None
    steps: list[DriftStep] = []
    while len(steps) < MOST_STEPS:
        found = _next_step(series, [step.after for step in steps], walk, looks)
        if found is None or found.p_value > level:
            break
        steps.append(found)
    design = regressors(series, [step.after for step in steps])
    parts = [(q, prior, *_component(series, design, q)) for q, prior in _walks(series, walk)]
    log = np.array([np.log(prior) + likelihood for _, prior, likelihood, _ in parts])
    share = np.exp(log - log.max())
    share /= share.sum()
    components = [
        Component(float(weight), q, *rest)
        for weight, (q, _, _, rest) in zip(share, parts, strict=True)
        if weight > 1e-6
    ]
    return Trend(series, tuple(steps), tuple(components))


def _walks(series: TimeSeries, walk: bool) -> list[tuple[float, float]]:
    """Variances per day that are tried, with their prior probabilities."""
    if not walk:
        return [(0.0, 1.0)]
    scale = float(np.median(series.u)) ** 2 / float(np.ptp(series.days))
    return [(0.0, NO_WALK), *((size**2 * scale, (1.0 - NO_WALK) / len(WALKS)) for size in WALKS)]


def _spread(series: TimeSeries, q: float) -> FloatArray:
    """Covariance of the readings about the regression, (n, n)."""
    since = series.days - series.days[0]
    return np.asarray(np.diag(series.u**2) + q * np.minimum.outer(since, since))


Rest = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _component(series: TimeSeries, design: FloatArray, q: float) -> tuple[float, Rest]:
    """Logarithm of the restricted likelihood for one q; coefficients and state at the last reading with covariances."""
    spread = _spread(series, q)
    root = np.linalg.cholesky(spread)
    columns, target = np.linalg.solve(root, design), np.linalg.solve(root, series.value)
    normal = columns.T @ columns
    covariance = np.linalg.inv(normal)
    coefficients = covariance @ columns.T @ target
    residual = target - columns @ coefficients
    log = -np.log(np.diag(root)).sum() - 0.5 * np.linalg.slogdet(normal)[1] - 0.5 * residual @ residual
    # the walk at the last reading given the others: mean and variance of a Gaussian process (kriging)
    shared = np.linalg.solve(root, q * (series.days - series.days[0]))
    jump = float(shared @ residual)
    state = np.array([coefficients[0] + jump, coefficients[1]])
    map_ = np.zeros((2, design.shape[1]))
    map_[0, 0] = map_[1, 1] = 1.0
    map_[0] -= shared @ columns
    own = q * float(series.days[-1] - series.days[0]) - float(shared @ shared)
    state_covariance = map_ @ covariance @ map_.T + np.diag([max(own, 0.0), 0.0])
    return float(log), (coefficients, covariance, state, state_covariance)


def _next_step(series: TimeSeries, known: Sequence[int], walk: bool, looks: int) -> DriftStep | None:
    """Return the most significant step that is not known yet; None if none can be separated from the other terms."""
    base = regressors(series, known)
    count, unknowns = base.shape[0], base.shape[1] + 1
    gaps = [k for k in range(1, count) if k not in known and series.days[k] > series.days[k - 1]]
    if count <= unknowns or not gaps:
        return None
    columns = np.column_stack([_before(series, k) for k in gaps])
    walks = _walks(series, walk)
    results = [_with_column(series, base, columns, q) for q, _ in walks]
    log, size, u, square = (np.array(part) for part in zip(*results, strict=True))
    share = log + np.log([[prior] for _, prior in walks])
    share = np.exp(share - share.max(axis=0))
    share /= share.sum(axis=0)
    # scatter of the readings beyond u and the walk makes the step less certain
    freedom = count - unknowns
    inflated = u * np.sqrt(np.maximum(1.0, square / freedom))
    ratio = np.where(np.isfinite(inflated), np.abs(size) / inflated, 0.0)
    moves = np.array([[q > 0.0] for q, _ in walks]) | (square > freedom)
    each = np.sum(share * np.where(moves, 2.0 * t.sf(ratio, freedom), 2.0 * norm.sf(ratio)), axis=0)
    k = int(np.lexsort((-np.max(ratio, axis=0), each))[0])
    mean = float(share[:, k] @ size[:, k])
    spread = float(np.sqrt(share[:, k] @ (inflated[:, k] ** 2 + (size[:, k] - mean) ** 2)))
    return DriftStep(gaps[k], mean, spread, min(1.0, float(each[k]) * len(gaps) * looks))


def _with_column(
    series: TimeSeries, base: FloatArray, columns: FloatArray, q: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Log restricted likelihood, coefficient, u and residual sum of squares with each of ``columns`` added, (m,)."""
    root = np.linalg.cholesky(_spread(series, q))
    white = np.linalg.solve(root, np.column_stack([base, columns, series.value]))
    width = base.shape[1]
    orthonormal, upper = np.linalg.qr(white[:, :width])
    rest = white[:, width:] - orthonormal @ (orthonormal.T @ white[:, width:])
    own, target = rest[:, :-1], rest[:, -1]
    square = np.einsum("ij,ij->j", own, own)
    open_gap = square < 1e-8 * np.einsum("ij,ij->j", white[:, width:-1], white[:, width:-1])
    square = np.where(open_gap, np.nan, square)
    size = own.T @ target / square
    log = -np.log(np.diag(root)).sum() - np.log(np.abs(np.diag(upper))).sum() - 0.5 * np.log(square)
    left = target @ target - np.nan_to_num(size**2 * square)
    u = np.where(open_gap, np.inf, 1.0 / np.sqrt(square))
    return np.nan_to_num(log - 0.5 * left, nan=-1e300), np.nan_to_num(size), u, left


# When a figure leaves its tolerance: distribution of the first exit, sampled from the trend and its uncertainty.


#: Number of paths drawn, and of times at which each is evaluated.
PATHS, TIMES = 2000, 300
SEED = 20260101


@dataclass(frozen=True)
class Forecast:
    """First exit from the tolerance, in days after the last reading; infinite if later than ``horizon_days``.

    ``outside_now`` is the probability that it is already outside; ``within_horizon`` that it leaves by the horizon.
    """

    median_days: float
    low_days: float
    high_days: float
    outside_now: float
    within_horizon: float
    confidence: float
    horizon_days: float

    def summary(self) -> dict[str, Any]:
        """Return the fields by name; times after the horizon are None."""
        days = {"median_days": self.median_days, "low_days": self.low_days, "high_days": self.high_days}
        return {
            **{name: value if np.isfinite(value) else None for name, value in days.items()},
            "outside_now": self.outside_now,
            "within_horizon": self.within_horizon,
            "confidence": self.confidence,
            "horizon_days": self.horizon_days,
        }

    def words(self, name: str) -> str:
        """State it in one sentence, e.g. ``EC0Y leaves tolerance in about 7 weeks, 95 % 5-11``."""
        percent = f"{100.0 * self.confidence:g} %"
        if self.outside_now > 0.5:
            return f"{name} is already outside its tolerance (probability {self.outside_now:.2f})"
        if not np.isfinite(self.low_days):
            return f"{name} stays within tolerance for the next {_span(self.horizon_days)} ({percent})"
        divisor, unit = _unit(self.median_days if np.isfinite(self.median_days) else self.low_days)
        high = f"-{self.high_days / divisor:.0f}" if np.isfinite(self.high_days) else " or later"
        if not np.isfinite(self.median_days):
            at_first = f"{self.low_days / divisor:.0f} {unit}"
            rather = f"more likely later than {_span(self.horizon_days)}"
            return f"{name} may leave tolerance after {at_first} at the earliest ({percent}), {rather}"
        about = f"{self.median_days / divisor:.0f}"
        word = unit.removesuffix("s") if about == "1" else unit
        return f"{name} leaves tolerance in about {about} {word}, {percent} {self.low_days / divisor:.0f}{high}"


def _unit(days: float) -> tuple[float, str]:
    if days < 14.0:
        return 1.0, "days"
    return (7.0, "weeks") if days < 182.0 else (30.4375, "months")


def _span(days: float) -> str:
    divisor, unit = _unit(days)
    return f"{days / divisor:.0f} {unit}"


def forecast(
    trend: Trend, reference: float, tolerance: float, *, horizon_days: float = 730.0, confidence: float = 0.95
) -> Forecast:
    """Forecast when |figure - reference| exceeds the tolerance.

    Parameters
    ----------
    trend : of the figure.
    reference : value that the active tables compensate (or 0).
    tolerance : in the unit of the figure, positive.
    horizon_days : later exits count as infinitely late.
    confidence : of the interval, with equal tails on both sides.
    """
    days = exit_grid(horizon_days)
    exits = []
    for k, part in enumerate(trend.components):  # the number of exits drawn from each follows its share
        generator = np.random.default_rng([SEED, k])
        count = max(int(round(PATHS * part.share)), 1)
        state = part.state + generator.standard_normal((count, 2)) @ symmetric_root(part.state_covariance)
        path = state[:, :1] - reference + state[:, 1:] * days
        if part.q > 0.0:
            steps = generator.standard_normal((count, len(days) - 1)) * np.sqrt(part.q * np.diff(days))
            path[:, 1:] += np.cumsum(steps, axis=1)
        exits.append(first_exit(path, tolerance, days))
    return forecast_of(np.concatenate(exits), horizon_days, confidence)


def exit_grid(horizon_days: float) -> FloatArray:
    """Times at which paths are evaluated, closer together at the beginning."""
    return np.asarray(horizon_days * np.linspace(0.0, 1.0, TIMES) ** 1.5)


def forecast_of(exits_days: FloatArray, horizon_days: float, confidence: float) -> Forecast:
    """Return the forecast from drawn exits; infinite exits are after the horizon."""
    ordered = np.sort(exits_days)
    tail = (1.0 - confidence) / 2.0
    low, median, high = (ordered[min(int(p * len(ordered)), len(ordered) - 1)] for p in (tail, 0.5, 1.0 - tail))
    inside = float(np.mean(np.isfinite(ordered)))
    now = float(np.mean(ordered <= 0.0))
    return Forecast(float(median), float(low), float(high), now, inside, confidence, horizon_days)


def first_exit(path: FloatArray, tolerance: float, days: FloatArray) -> FloatArray:
    """First time at which each path (m, times) exceeds the tolerance, linear in between; infinite if never."""
    size = np.abs(path)
    outside = size > tolerance
    first = np.argmax(outside, axis=1)
    never = ~outside.any(axis=1)
    rows = np.arange(len(path))
    late, early = size[rows, first], size[rows, np.maximum(first - 1, 0)]
    share = np.clip((tolerance - early) / np.where(late > early, late - early, 1.0), 0.0, 1.0)
    at = days[np.maximum(first - 1, 0)] + share * (days[first] - days[np.maximum(first - 1, 0)])
    return np.where(never, np.inf, np.where(first == 0, 0.0, at))


# When the error over the volume leaves its tolerance: one line fitted to the whole field, with its joint covariance.


#: Number of fields drawn.
DRAWS = 1000


def volume_forecast(
    data: Aligned,
    reference: int,
    steps: Sequence[int],
    temperature_k: FloatArray | None,
    limits: tuple[float, float, float],
) -> Forecast | None:
    """Forecast when the rms of E over the volume, minus what the active tables compensate, exceeds the tolerance.

    Level and slope of all error values come from one weighted line with the same weights for all; scatter about the
    line beyond the uncertainties widens the result. A random walk is not considered here. None for too few
    calibrations.

    Parameters
    ----------
    data, reference, steps, temperature_k : calibrations, the one that the tables compensate, the trends' steps and
        temperatures.
    limits : tolerance in mm, horizon in days, confidence.
    """
    tolerance, horizon_days, confidence = limits
    root, pull, design = _regression(data, steps, temperature_k)
    if pull is None:
        return None
    state = pull[:2] @ data.value
    field = _field(data)
    # factor, at least 1: observed scatter of the field about its line over the scatter expected from the uncertainties
    left = np.eye(len(root)) - design @ pull
    seen = float(np.sum((root[:, None] * ((left @ data.value) @ field.T)) ** 2))
    spread = np.array([np.sum((field @ factor) ** 2) for factor in data.factor])
    expected = float(np.sum((root[:, None] * left) ** 2 @ spread))
    excess = max(1.0, float(np.sqrt(seen / expected)))
    generator = np.random.default_rng([SEED, 99])
    draws = np.zeros((2, DRAWS, data.value.shape[1]))
    for k, factor in enumerate(data.factor):
        noise = generator.standard_normal((DRAWS, factor.shape[1])) @ factor.T
        draws += excess * pull[:2, k, None, None] * noise
    level = (state[0] - data.value[reference] + draws[0]) @ field.T
    slope = (state[1] + draws[1]) @ field.T
    days = exit_grid(horizon_days)
    square, mixed, steep = (np.sum(a * b, axis=1) for a, b in ((level, level), (level, slope), (slope, slope)))
    at_once, growing, fast = _noise(data, reference, pull, field, excess)
    square, mixed, steep = square - at_once, mixed - growing, steep - fast
    count = field.shape[0] / 3.0
    rms = np.sqrt(np.maximum(square[:, None] + 2 * mixed[:, None] * days + steep[:, None] * days**2, 0.0) / count)
    return forecast_of(first_exit(rms, tolerance, days), horizon_days, confidence)


def _noise(
    data: Aligned, reference: int, pull: FloatArray, field: FloatArray, excess: float
) -> tuple[float, float, float]:
    """What noise adds to the square of a drawn field: parts constant, linear (half) and quadratic in time.

    A drawn square contains the variance twice, from the estimate and from the draw. The noise of the calibration that
    the tables compensate is real, and enters the estimate with that calibration's weight.
    """
    spread = np.array([np.sum((field @ factor) ** 2) for factor in data.factor])
    parts = [excess**2 * float(np.sum(pull[i] * pull[j] * spread)) for i, j in ((0, 0), (0, 1), (1, 1))]
    shared = pull[:2, reference] * spread[reference]
    return 2.0 * parts[0] - 2.0 * float(shared[0]), 2.0 * parts[1] - float(shared[1]), 2.0 * parts[2]


def _regression(
    data: Aligned, steps: Sequence[int], temperature_k: FloatArray | None
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Weights (n,), matrix (p, n) from the readings to the coefficients, and the design (n, p)."""
    size = np.array([np.linalg.norm(factor) for factor in data.factor])
    series = TimeSeries(data.days, np.zeros(len(size)), size, temperature_k)
    design = regressors(series, steps)
    root = 1.0 / size
    if len(size) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return root, None, design
    return root, np.linalg.pinv(root[:, None] * design) * root, design


def _field(data: Aligned) -> FloatArray:
    """Matrix (3 n, k) from the error values to E at the points of the volume, without rigid motion."""
    position_mm = volume_points(data.machine)
    design = error_design(data.machine, data.field_covariance(0), position_mm)
    return small_motion(position_mm).taken_out(design.reshape(3 * len(position_mm), -1))


#: Mean length of a month.
DAYS_A_MONTH = 30.4375


def interval_of(value: float, u: float, confidence: float) -> tuple[float, float]:
    """Return the ends of the interval that contains the true value with this confidence."""
    reach = float(norm.ppf(0.5 + 0.5 * confidence)) * u
    return value - reach, value + reach


def moment_of(iso: str) -> str:
    """Return a time as people read it, e.g. ``2026-07-05 06:00 UTC``."""
    return f"{datetime.fromisoformat(iso).astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def sentences(drift: Drift) -> list[str]:
    """State in words what matters; every figure is given with its interval."""
    level = 1.0 - drift.settings.confidence
    warm = following_temperature(drift)
    logged = drift.temperature_c
    at = f", at {sum(logged) / len(logged):.1f} degC" if logged else ""
    told = _steps(drift)
    for item in drift.figures:
        if item.trend is not None and item.adjusted < level:
            value, u = (DAYS_A_MONTH * part for part in item.trend.slope)
            told.append(f"{item.figure.name} drifts by {_with_interval(drift, item.figure, value, u)} per month")
        if item.figure.name in warm and item.trend is not None and item.trend.per_kelvin is not None:
            size = _with_interval(drift, item.figure, *item.trend.per_kelvin)
            told.append(f"{item.figure.name} changes with temperature by {size} per K")
        if item.forecast is not None:
            told.append(item.forecast.words(item.figure.name) + (at if item.figure.name in warm else ""))
    if drift.volume_forecast is not None:
        told.append(drift.volume_forecast.words("the volume") + (at if warm else ""))
    return told + list(drift.notes)


def outlook(drift: Drift) -> tuple[str, str]:
    """State what changes most significantly, and what leaves its tolerance first; each is empty if there is nothing."""
    level = 1.0 - drift.settings.confidence
    moving = sorted((item for item in drift.figures if item.p_value < level), key=lambda item: item.p_value)
    told = ""
    if moving:
        item = moving[0]
        assert item.trend is not None
        scale = item.figure.scale
        if item.adjusted < level:
            told = f"{item.figure.name} {item.trend.slope[0] * DAYS_A_MONTH * scale:+.2f} {item.figure.unit} a month"
        else:
            step = min(item.trend.steps, key=lambda step: step.p_value)
            told = f"{item.figure.name} step of {step.size * scale:+.2f} {item.figure.unit} before {drift.times[step.after][:10]}"
        told += f", and {len(moving) - 1} more" if len(moving) > 1 else ""
    known = [(item.figure.name, item.forecast) for item in drift.figures if item.forecast is not None]
    if drift.volume_forecast is not None:
        known.append(("the volume", drift.volume_forecast))
    if not known:
        return told, ""
    name, first = min(known, key=lambda each: (-(each[1].outside_now > 0.5), each[1].median_days, each[1].low_days))
    return told, first.words(name)


def following_temperature(drift: Drift) -> set[str]:
    """Return the figures that follow the temperature significantly, corrected for all figures tested."""
    found = {}
    for item in drift.figures:
        if item.trend is not None and item.trend.per_kelvin is not None:
            value, u = item.trend.per_kelvin
            found[item.figure.name] = float(2.0 * norm.sf(abs(value) / u))
    adjusted = holm(list(found.values()))
    level = 1.0 - drift.settings.confidence
    return {name for name, p_value in zip(found, adjusted, strict=True) if p_value < level}


def _steps(drift: Drift) -> list[str]:
    told = []
    for after, steps in drift.gaps.items():
        listed = "; ".join(f"{f.name} {_with_interval(drift, f, step.size, step.u)}" for f, step in steps)
        before, since = (moment_of(drift.times[k]) for k in (after - 1, after))
        told.append(f"step between {before} and {since}: {listed}")
    return told


def _with_interval(drift: Drift, figure: MonitoredFigure, value: float, u: float) -> str:
    """State a figure with its interval, e.g. ``+1.50 urad (95 % +1.20 to +1.80)``."""
    confidence = drift.settings.confidence
    scale = figure.scale
    low, high = interval_of(value, u, confidence)
    return f"{value * scale:+.2f} {figure.unit} ({100 * confidence:g} % {low * scale:+.2f} to {high * scale:+.2f})"


@dataclass(frozen=True)
class DriftSettings:
    """Settings for judging the drift.

    Parameters
    ----------
    tolerances : by error name, mm or rad, and ``volume`` for the rms over the volume, mm.
    reference : number of the calibration that the active tables compensate; the first if unknown.
    walk : whether a random walk is considered in addition to the line.
    confidence : of intervals and of what counts as significant.
    horizon_days : how far forecasts look.
    """

    tolerances: Mapping[str, float] = field(default_factory=dict)
    reference: int = 0
    walk: bool = True
    confidence: float = 0.95
    horizon_days: float = 730.0


@dataclass(frozen=True)
class FigureDrift:
    """Trend of one figure; None for too few calibrations. ``reference`` is the value that the active tables compensate.

    ``adjusted`` is the error probability of the slope, corrected for all figures.
    """

    figure: MonitoredFigure
    series: TimeSeries
    reference: float
    trend: Trend | None
    adjusted: float
    tolerance: float | None = None
    forecast: Forecast | None = None

    @property
    def p_value(self) -> float:
        """Error probability of its slope or one of its steps, whichever is lowest; corrected for all figures."""
        steps = () if self.trend is None else self.trend.steps
        return min([self.adjusted, *(step.p_value for step in steps)])

    @property
    def limits(self) -> tuple[float, ...]:
        """Lower and upper tolerance limits about ``reference``, mm or rad; empty without a tolerance."""
        return () if self.tolerance is None else (self.reference - self.tolerance, self.reference + self.tolerance)

    def line(self) -> tuple[FloatArray, FloatArray]:
        """Days and values of the line with its steps, each in the middle of its gap, at the mean temperature."""
        assert self.trend is not None
        days, slope = self.series.days, self.trend.slope[0]
        now = sum(part.share * part.state[0] for part in self.trend.components)
        corners = [(float(k), day) for k, day in enumerate(days)]
        for step in self.trend.steps:  # between readings after - 1 and after: just before and just after the step
            middle = 0.5 * (days[step.after - 1] + days[step.after])
            corners += [(step.after - 0.6, middle), (step.after - 0.4, middle)]
        order, places = (np.array(part) for part in zip(*sorted(corners), strict=True))
        values = now + slope * (places - days[-1])
        for step in self.trend.steps:
            values -= np.where(order < step.after - 0.5, step.size, 0.0)
        return places, values

    def summary(self, times: Sequence[str], confidence: float) -> dict[str, Any]:
        """Return value, trend and forecast by name, in um or urad and days; ``times`` are the calibrations' times."""
        scale = self.figure.scale
        found: dict[str, Any] = {
            "figure": self.figure.name,
            "error": self.figure.error,
            "part": self.figure.part,
            "unit": self.figure.unit,
            "value": (self.series.value * scale).tolist(),
            "u": (self.series.u * scale).tolist(),
            "reference": self.reference * scale,
            "tolerance": None if self.tolerance is None else self.tolerance * scale,
            "forecast": None if self.forecast is None else self.forecast.summary(),
            "trend": None,
        }

        def interval(value: float, u: float) -> list[float]:
            return [end * scale for end in interval_of(value, u, confidence)]

        if self.trend is not None:
            slope, kelvin = self.trend.slope, self.trend.per_kelvin
            found["trend"] = {
                "per_day": slope[0] * scale,
                "u_per_day": slope[1] * scale,
                "interval_per_day": interval(*slope),
                "p_value": self.trend.p_value,
                "adjusted_p_value": self.adjusted,
                "random_walk_probability": self.trend.walk_share,
                "per_kelvin": None if kelvin is None else kelvin[0] * scale,
                "u_per_kelvin": None if kelvin is None else kelvin[1] * scale,
                "interval_per_kelvin": None if kelvin is None else interval(*kelvin),
                "steps": [
                    {
                        "between": [times[step.after - 1], times[step.after]],
                        "size": step.size * scale,
                        "u": step.u * scale,
                        "interval": interval(step.size, step.u),
                        "p_value": step.p_value,
                    }
                    for step in self.trend.steps
                ],
            }
        return found


@dataclass(frozen=True)
class Drift:
    """Everything known about the drift of one machine; ``gaps`` are the steps by the calibration after them."""

    machine: str
    times: tuple[str, ...]
    settings: DriftSettings
    since_last: tuple[ErrorChange, ...]
    since_first: tuple[ErrorChange, ...]
    volume_since_last: Change | None
    volume_since_first: Change | None
    volume_um: tuple[tuple[float, float], ...]
    volume_forecast: Forecast | None
    figures: tuple[FigureDrift, ...]
    temperature_c: tuple[float, ...] | None
    notes: tuple[str, ...]

    @property
    def gaps(self) -> dict[int, list[tuple[MonitoredFigure, DriftStep]]]:
        """Steps by the number of the calibration after them."""
        found: dict[int, list[tuple[MonitoredFigure, DriftStep]]] = {}
        for item in self.figures:
            for step in item.trend.steps if item.trend is not None else ():
                found.setdefault(step.after, []).append((item.figure, step))
        return dict(sorted(found.items()))

    def sentences(self) -> list[str]:
        """State in words what matters."""
        return sentences(self)

    def outlook(self) -> tuple[str, str]:
        """State briefly what changes and when the first tolerance is exceeded; each is empty if there is nothing."""
        return outlook(self)

    def summary(self) -> dict[str, Any]:
        """Return all figures for JSON, in um, urad, days."""
        return {
            "machine": self.machine,
            "times": list(self.times),
            "reference": self.times[self.settings.reference],
            "temperature_c": None if self.temperature_c is None else list(self.temperature_c),
            "since_last": [item.summary() for item in self.since_last],
            "since_first": [item.summary() for item in self.since_first],
            "volume": {
                "since_last": None if self.volume_since_last is None else self.volume_since_last.summary(),
                "since_first": None if self.volume_since_first is None else self.volume_since_first.summary(),
                "rms_um": [rms for rms, _ in self.volume_um],
                "expected_rms_um": [expected for _, expected in self.volume_um],
                "forecast": None if self.volume_forecast is None else self.volume_forecast.summary(),
            },
            "confidence": self.settings.confidence,
            "figures": [item.summary(self.times, self.settings.confidence) for item in self.figures],
            "sentences": self.sentences(),
        }


def drift_of_store(store: Store, machine: MachineRecord, settings: DriftSettings) -> Drift:
    """Return the drift of a machine in the store; the calibration behind its active tables is the reference."""
    (history, ids, model), tables, left_out, other = store.together(
        lambda moment: (
            calibrations_of(moment, machine),
            moment.tables(machine, figures=False),
            excluded(moment, machine),
            with_other_prior(moment, machine),
        )
    )
    history, ids, fewer = with_all_errors(history, ids)
    active = active_of(tables)
    known = active is not None and active.identification_id in ids
    reference = ids.index(active.identification_id) if known and active is not None else 0
    found = drift_report(model, history, replace(settings, reference=reference), name=machine.name)
    return replace(found, notes=(*found.notes, *fewer, *left_out.values(), *other.values()))


def drift_report(
    machine: Machine, history: Sequence[Calibration], settings: DriftSettings | None = None, *, name: str = ""
) -> Drift:
    """Judge the drift over calibrations, oldest first.

    Parameters
    ----------
    machine : as in the newest calibration.
    history : at least one calibration; trends need three, with temperatures five.
    settings : tolerances, reference, confidence; by default :class:`DriftSettings`.
    name : of the machine in reports; default: the name in its file.
    """
    chosen = settings or DriftSettings()
    if not history:
        raise InputError("a drift needs at least one calibration")
    if not 0 <= chosen.reference < len(history):
        raise InputError(f"the reference is calibration {chosen.reference}, but there are {len(history)}")
    data = aligned(machine, history)
    last, notes = len(history) - 1, []
    temperature = _temperature(history, data)
    if temperature is None and any(item.temperatures_c for item in history):
        notes.append("there are too few temperatures, or they vary too little, to separate their effect from the drift")
    if last < 2:
        notes.append("a trend needs three calibrations")
    figures = _figures(data, chosen, temperature)
    volume = [_volume(machine, history, k, chosen.reference, chosen.confidence) for k in range(len(history))]
    tolerance, in_volume = chosen.tolerances.get("volume"), None
    if tolerance is not None:
        steps = sorted({step.after for item in figures if item.trend is not None for step in item.trend.steps})
        warm = None if temperature is None else np.array(temperature) - np.mean(temperature)
        limits = (tolerance, chosen.horizon_days, chosen.confidence)
        in_volume = volume_forecast(data, chosen.reference, steps, warm, limits)
    return Drift(
        machine=name or machine.name,
        times=tuple(item.at.isoformat(timespec="minutes") for item in history),
        settings=chosen,
        since_last=changes(data, last, last - 1) if last else (),
        since_first=changes(data, last, 0) if last else (),
        volume_since_last=_volume(machine, history, last, last - 1, chosen.confidence) if last else None,
        volume_since_first=_volume(machine, history, last, 0, chosen.confidence) if last else None,
        volume_um=tuple((item.rms_um, item.expected_rms_um) for item in volume),
        volume_forecast=in_volume,
        figures=figures,
        temperature_c=temperature,
        notes=tuple(notes),
    )


def _volume(machine: Machine, history: Sequence[Calibration], new: int, old: int, confidence: float) -> Change:
    if new == old:
        return Change(0.0, 0.0, 0.0, 1.0, confidence)
    pair = [(history[k].errors, history[k].covariance) for k in (new, old)]
    return change_between(machine, pair[0], pair[1], confidence)


def _temperature(history: Sequence[Calibration], data: Aligned) -> tuple[float, ...] | None:
    """Mean over the channels that every calibration logged; None if they do not show an effect."""
    channels = set.intersection(*({*item.temperatures_c} for item in history))
    if not channels:
        return None
    mean = [float(np.mean([item.temperatures_c[name] for name in sorted(channels)])) for item in history]
    return tuple(mean) if usable_temperature(data.days, np.array(mean)) else None


def _figures(data: Aligned, chosen: DriftSettings, temperature: tuple[float, ...] | None) -> tuple[FigureDrift, ...]:
    values, u = data.figure_values(), data.figure_u()
    warm = None if temperature is None else np.array(temperature) - np.mean(temperature)
    all_series = [TimeSeries(data.days, values[:, k], u[:, k], warm) for k in range(len(data.figures))]
    trends = [
        fit_trend(item, walk=chosen.walk, looks=len(all_series), level=1.0 - chosen.confidence) for item in all_series
    ]
    adjusted = iter(holm([item.p_value for item in trends if item is not None]))
    found = []
    for figure, series, trend in zip(data.figures, all_series, trends, strict=True):
        reference, tolerance = float(series.value[chosen.reference]), chosen.tolerances.get(figure.error)
        leaves = None
        if tolerance is not None and trend is not None:
            limits = {"horizon_days": chosen.horizon_days, "confidence": chosen.confidence}
            leaves = forecast(trend, reference, tolerance, **limits)
        p_value = 1.0 if trend is None else next(adjusted)
        found.append(FigureDrift(figure, series, reference, trend, p_value, tolerance, leaves))
    return tuple(found)
