"""Trend of one figure over time: weighted regression, a random walk on top, temperature, and sudden steps.

The model of readings y_i with known standard uncertainty u_i at times t_i (days) is

    y_i = level + slope t_i + c (T_i - T_ref) + sum of steps before t_i + w(t_i) + e_i,

where w is a random walk with variance q per day, w(t_1) = 0. Level, slope, c and steps have flat priors; q is zero with
a probability of one quarter and otherwise spread evenly in its logarithm, and is integrated over with its restricted likelihood
(Patterson & Thompson 1971, Biometrika 58). Without the walk this is the weighted least-squares line.

A step is sought beside the line: for each gap between measurements its size is estimated together with everything else,
with q weighed as if the step was there, so that a crash is not taken for a restless machine and a slow drift not for a
crash. The error probability counts every gap (and every figure) that was looked at: Bonferroni.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, t

from compgen.core.csvio import FloatArray

#: Standard deviations of the random walk over the whole history that are weighed, as multiples of the median u.
WALKS = (0.3, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
#: Prior probability that there is no random walk.
NO_WALK = 0.25
#: Temperatures that vary by less say nothing about their effect, K.
LEAST_RANGE_K = 0.5
#: Most steps that are sought in one series.
MOST_STEPS = 3


@dataclass(frozen=True)
class Series:
    """Readings of one figure: ``days``, ``value``, ``u`` (n,); ``temperature_k`` (n,) from its reference, or None."""

    days: FloatArray
    value: FloatArray
    u: FloatArray
    temperature_k: FloatArray | None = None


@dataclass(frozen=True)
class Step:
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

    series: Series
    steps: tuple[Step, ...]
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
        """Probability that there is a random walk beside the line."""
        return float(sum(item.share for item in self.components if item.q > 0.0))


def regressors(series: Series, steps: Sequence[int] = ()) -> FloatArray:
    """Columns level, slope, temperature and steps, (n, p); the level is that at the last reading."""
    columns = [np.ones(len(series.days)), series.days - series.days[-1]]
    if series.temperature_k is not None:
        columns.append(series.temperature_k)
    columns += [_before(series, k) for k in steps]
    return np.column_stack(columns)


def _before(series: Series, after: int) -> FloatArray:
    """Minus one before the step, so that the level is that after it."""
    return np.where(np.arange(len(series.days)) < after, -1.0, 0.0)


def usable_temperature(days: FloatArray, temperature_c: FloatArray) -> bool:
    """Whether temperatures (n,) vary enough, and otherwise than linearly in time, to show their effect."""
    if len(days) < 5 or not np.isfinite(temperature_c).all():
        return False
    line = np.polyval(np.polyfit(days, temperature_c, 1), days)
    return bool(np.ptp(temperature_c - line) > LEAST_RANGE_K)


def fit_trend(series: Series, *, walk: bool = True, looks: int = 1, level: float = 0.01) -> Trend | None:
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
    steps: list[Step] = []
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


def _walks(series: Series, walk: bool) -> list[tuple[float, float]]:
    """Variances per day that are weighed, with their prior probabilities."""
    if not walk:
        return [(0.0, 1.0)]
    scale = float(np.median(series.u)) ** 2 / float(np.ptp(series.days))
    return [(0.0, NO_WALK), *((size**2 * scale, (1.0 - NO_WALK) / len(WALKS)) for size in WALKS)]


def _spread(series: Series, q: float) -> FloatArray:
    """Covariance of the readings about the regression, (n, n)."""
    since = series.days - series.days[0]
    return np.asarray(np.diag(series.u**2) + q * np.minimum.outer(since, since))


Rest = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


def _component(series: Series, design: FloatArray, q: float) -> tuple[float, Rest]:
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


def _next_step(series: Series, known: Sequence[int], walk: bool, looks: int) -> Step | None:
    """Return the most significant further step; None where none can be told from the rest."""
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
    return Step(gaps[k], mean, spread, min(1.0, float(each[k]) * len(gaps) * looks))


def _with_column(
    series: Series, base: FloatArray, columns: FloatArray, q: float
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
