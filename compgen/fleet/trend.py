"""Trend of one figure over time: regression, random walk, steps; forecast of the first exit from its tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm, t

from compgen.data.csv_files import FloatArray
from compgen.fleet.change import Aligned, rigid_free_projector, volume_points
from compgen.identify.covariance import error_design

# Trend of one figure over time: weighted regression, a random walk on top, temperature, and sudden steps.
#
# The model of readings y_i with known standard uncertainty u_i at times t_i (days) is
#
#     y_i = level + slope t_i + c (T_i - T_ref) + sum of steps before t_i + w(t_i) + e_i,
#
# where w is a random walk with variance q per day, w(t_1) = 0. Level, slope, c and steps have flat priors; q is zero with
# a probability of one quarter and otherwise spread evenly in its logarithm, and is integrated over with its restricted likelihood
# (Patterson & Thompson 1971, Biometrika 58). Without the walk this is the weighted least-squares line.
#
# A step is sought together with the line: for each gap between measurements its size is estimated together with everything else,
# with q weighed as if the step was there, so that a crash is not taken for a restless machine and a slow drift not for a
# crash. The error probability counts every gap (and every figure) that was looked at: Bonferroni.


#: Standard deviations of the random walk over the whole history that are weighed, as multiples of the median u.
WALKS = (0.3, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
#: Prior probability that there is no random walk.
NO_WALK = 0.25
#: Temperatures that vary by less say nothing about their effect, K.
LEAST_RANGE_K = 0.5
#: Most steps that are sought in one series.
MOST_STEPS = 3


@dataclass(frozen=True)
class TimeSeries:
    """Readings of one figure: ``days``, ``value``, ``u`` (n,); ``temperature_k`` (n,) from its reference, or None."""

    days: FloatArray
    value: FloatArray
    u: FloatArray
    temperature_k: FloatArray | None = None


@dataclass(frozen=True)
class DriftStep:
    """A sudden change between reading ``after`` - 1 and ``after``; ``p_value`` counts everything that was looked at."""

    after: int
    size: float
    u: float
    p_value: float


@dataclass(frozen=True)
class Component:
    """The trend for one size of the random walk: its share, variance per day, and the state at the last reading.

    ``coefficients`` and ``covariance`` are those of level, slope, temperature and steps; ``level``, ``slope`` at the last
    reading (reference temperature, walk included) have the joint covariance ``state_covariance`` (2, 2).
    """

    share: float
    q: float
    coefficients: FloatArray
    covariance: FloatArray
    state: FloatArray
    state_covariance: FloatArray


@dataclass(frozen=True)
class Trend:
    """Trend of a series: the steps that were found and the components of the random walk."""

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
    """Columns level, slope, temperature and steps, (n, p); the level is that at the last reading."""
    columns = [np.ones(len(series.days)), series.days - series.days[-1]]
    if series.temperature_k is not None:
        columns.append(series.temperature_k)
    columns += [_before(series, k) for k in steps]
    return np.column_stack(columns)


def _before(series: TimeSeries, after: int) -> FloatArray:
    """Minus one before the step, so that the level is that after it."""
    return np.where(np.arange(len(series.days)) < after, -1.0, 0.0)


def usable_temperature(days: FloatArray, temperature_c: FloatArray) -> bool:
    """Whether temperatures (n,) vary enough, and otherwise than linearly in time, to show their effect."""
    if len(days) < 5 or not np.isfinite(temperature_c).all():
        return False
    line = np.polyval(np.polyfit(days, temperature_c, 1), days)
    return bool(np.ptp(temperature_c - line) > LEAST_RANGE_K)


def fit_trend(series: TimeSeries, *, walk: bool = True, looks: int = 1, level: float = 0.01) -> Trend | None:
    """Fit the trend; None for too few readings (three, more with temperatures).

    Parameters
    ----------
    series : the readings.
    walk : whether a random walk is weighed; without it the line holds exactly.
    looks : number of series that are searched for steps, for their error probability.
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
    """Variances per day that are weighed, with their prior probabilities."""
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
    """Logarithm of the restricted likelihood, and coefficients with the state at the last reading for one q."""
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
    """Return the most significant step that is not known yet; None where none can be told from the rest."""
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
    # what the readings scatter more than u and the walk say makes the step less certain
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
    """Restricted likelihoods, coefficients, their u and sums of squares left when each of ``columns`` joins, (m,)."""
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


# When a figure leaves its tolerance: the distribution of the first exit, drawn from the trend and its uncertainty.


#: Paths that are drawn, and times at which each is looked at.
PATHS, TIMES = 2000, 300
SEED = 20260101


@dataclass(frozen=True)
class Forecast:
    """First exit from the tolerance, in days after the last reading; infinite for later than ``horizon_days``.

    ``outside_now`` is the probability that it is outside already; ``within_horizon`` that it leaves by the horizon.
    """

    median_days: float
    low_days: float
    high_days: float
    outside_now: float
    within_horizon: float
    confidence: float
    horizon_days: float

    def summary(self) -> dict[str, Any]:
        """Return the fields by name; None for later than the horizon."""
        days = {"median_days": self.median_days, "low_days": self.low_days, "high_days": self.high_days}
        return {
            **{name: value if np.isfinite(value) else None for name, value in days.items()},
            "outside_now": self.outside_now,
            "within_horizon": self.within_horizon,
            "confidence": self.confidence,
            "horizon_days": self.horizon_days,
        }

    def words(self, name: str) -> str:
        """Say it in one sentence, e.g. ``EC0Y leaves tolerance in about 7 weeks, 95 % 5-11``."""
        percent = f"{100.0 * self.confidence:g} %"
        if self.outside_now > 0.5:
            return f"{name} is outside its tolerance already (probability {self.outside_now:.2f})"
        if not np.isfinite(self.low_days):
            return f"{name} stays within tolerance for the next {_span(self.horizon_days)} ({percent})"
        divisor, unit = _unit(self.median_days if np.isfinite(self.median_days) else self.low_days)
        high = f"-{self.high_days / divisor:.0f}" if np.isfinite(self.high_days) else " or later"
        if not np.isfinite(self.median_days):
            at_first = f"{self.low_days / divisor:.0f} {unit}"
            rather = f"rather later than {_span(self.horizon_days)}"
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
    reference : value that the active tables take out (or 0).
    tolerance : in the unit of the figure, positive.
    horizon_days : later exits count as infinitely late.
    confidence : of the interval, which leaves equal shares on both sides.
    """
    days = exit_grid(horizon_days)
    exits = np.concatenate([_exits(trend, k, reference, tolerance, days) for k in range(len(trend.components))])
    return forecast_of(exits, horizon_days, confidence)


def exit_grid(horizon_days: float) -> FloatArray:
    """Times at which paths are looked at, closer together at the beginning."""
    return np.asarray(horizon_days * np.linspace(0.0, 1.0, TIMES) ** 1.5)


def forecast_of(exits_days: FloatArray, horizon_days: float, confidence: float) -> Forecast:
    """Return the forecast of drawn exits; infinite ones come after the horizon."""
    ordered = np.sort(exits_days)
    tail = (1.0 - confidence) / 2.0
    low, median, high = (ordered[min(int(p * len(ordered)), len(ordered) - 1)] for p in (tail, 0.5, 1.0 - tail))
    inside = float(np.mean(np.isfinite(ordered)))
    now = float(np.mean(ordered <= 0.0))
    return Forecast(float(median), float(low), float(high), now, inside, confidence, horizon_days)


def _exits(trend: Trend, k: int, reference: float, tolerance: float, days: FloatArray) -> FloatArray:
    """Draw exits of one component; their number follows its share."""
    part = trend.components[k]
    generator = np.random.default_rng([SEED, k])
    count = max(int(round(PATHS * part.share)), 1)
    values, vectors = np.linalg.eigh(part.state_covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    state = part.state + generator.standard_normal((count, 2)) @ root.T
    path = state[:, :1] - reference + state[:, 1:] * days
    if part.q > 0.0:
        steps = generator.standard_normal((count, len(days) - 1)) * np.sqrt(part.q * np.diff(days))
        path[:, 1:] += np.cumsum(steps, axis=1)
    return first_exit(path, tolerance, days)


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


# When the error over the volume leaves its tolerance: one line through the whole field, with its joint covariance.


#: Fields that are drawn.
DRAWS = 1000


def volume_forecast(
    data: Aligned,
    reference: int,
    steps: Sequence[int],
    temperature_k: FloatArray | None,
    limits: tuple[float, float, float],
) -> Forecast | None:
    """Forecast when the rms of E over the volume, minus what the active tables take out, exceeds the tolerance.

    Level and slope of all error values come from one weighted line with the same weights for each; the scatter about
    it, where it is more than the uncertainties say, widens the result. A random walk is not weighed here. None for too
    few calibrations.

    Parameters
    ----------
    data, reference, steps, temperature_k : calibrations, which one the tables hold, steps and temperatures of the trends.
    limits : tolerance in mm, horizon in days, confidence.
    """
    tolerance, horizon_days, confidence = limits
    root, pull, design = _regression(data, steps, temperature_k)
    if pull is None:
        return None
    state = pull[:2] @ data.value
    field = _field(data)
    excess = _excess(data, design, pull, root, field)
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

    A drawn square holds the variance twice, once from the estimate and once from the draw. The reading that the tables
    took out has noise which is real, and which the estimate shares by its weight.
    """
    spread = np.array([np.sum((field @ factor) ** 2) for factor in data.factor])
    parts = [excess**2 * float(np.sum(pull[i] * pull[j] * spread)) for i, j in ((0, 0), (0, 1), (1, 1))]
    shared = pull[:2, reference] * spread[reference]
    return 2.0 * parts[0] - 2.0 * float(shared[0]), 2.0 * parts[1] - float(shared[1]), 2.0 * parts[2]


def _regression(
    data: Aligned, steps: Sequence[int], temperature_k: FloatArray | None
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Weights (n,), matrix (p, n) that makes the coefficients from the readings, and the design (n, p)."""
    size = np.array([np.linalg.norm(factor) for factor in data.factor])
    series = TimeSeries(data.days, np.zeros(len(size)), size, temperature_k)
    design = regressors(series, steps)
    root = 1.0 / size
    if len(size) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return root, None, design
    return root, np.linalg.pinv(root[:, None] * design) * root, design


def _field(data: Aligned) -> FloatArray:
    """E at the points of the volume without rigid motion, by the error values, (3 n, k)."""
    position_mm = volume_points(data.machine)
    design = error_design(data.machine, data.field_covariance(0), position_mm)
    return np.asarray(rigid_free_projector(data.machine, position_mm) @ design.reshape(3 * len(position_mm), -1))


def _excess(data: Aligned, design: FloatArray, pull: FloatArray, root: FloatArray, field: FloatArray) -> float:
    """Factor, at least 1, by which the field scatters more about its line than the uncertainties say."""
    left = np.eye(len(root)) - design @ pull
    seen = float(np.sum((root[:, None] * ((left @ data.value) @ field.T)) ** 2))
    spread = np.array([np.sum((field @ factor) ** 2) for factor in data.factor])
    expected = float(np.sum((root[:, None] * left) ** 2 @ spread))
    return max(1.0, float(np.sqrt(seen / expected)))
