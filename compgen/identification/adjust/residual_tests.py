"""Tests of the residuals: their size and its causes, and whiteness over time, stations, distance and axes."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_INDEX, MM_PER_UM
from compgen.errors import CompgenWarning, Message
from compgen.identification.adjust.grid_problem import levels_of
from compgen.identification.adjust.robust import median, time_order
from compgen.identification.adjust.unknowns import IntArray
from compgen.kinematics.first_order import c_matrix

if TYPE_CHECKING:
    from compgen.data.deviations import Deviations

# Whether the residuals are larger than their uncertainty allows, and whether a step or a drift explains most of them.
#
# ``whiteness`` tests whether residuals look like noise; this part tests how large they are, and searches for causes
# that make a measurement worthless although every uncertainty can be computed: something moved between two runs, at one
# moment, or slowly. A cause is measured by its reduction of the sum of squares, in the residuals and in the residuals
# with the reversal restored: a step between two runs from opposite sides first looks like a reversal.


#: Probability that noise of the stated uncertainty alone gives a larger reduced chi-square than the limit.
FALSE_ALARM = 0.001
#: An assumed uncertainty may be wrong by this factor before the residuals count against the model.
ASSUMED_FACTOR = 5.0
#: A cause is reported if it explains this share of the sum of squares, ...
EXPLAINS = 0.5
#: ... with at least this many readings for each of its parameters.
READINGS_PER_PARAMETER = 10
#: Degree of the polynomial in time for a drift.
DRIFT_DEGREE = 3
#: Degree of the polynomial in time for repeated readings.
REPEATS_DEGREE = 5
#: Number of moments at which a step is tried.
MOMENTS = 200
#: Multiple of the uncertainty from which the machine file or the units are in doubt, not the measurement.
LARGEST_CHI_SQUARE = {"stated": 25.0, "assumed": 1000.0}


@dataclass(frozen=True)
class Cause:
    """A cause of most of the residuals: ``code`` for programs, ``text`` for people, share of the squares."""

    code: str
    text: str
    share: float


@dataclass(frozen=True)
class ResidualSeries:
    """n residuals in the order of the readings, for the search for causes.

    Parameters
    ----------
    residual_um : residuals, (n,).
    bare_um : the same with the removed reversal restored, (n,); None if none was removed.
    sigma_um : standard uncertainty of each, (n,).
    group : index of the unknown constant, (n,): the dead length of a length, the component of a deviation.
    labels : labels between whose values something may have moved: run, block, file, each (n,).
    time_s : times, (n,); None if only the order of the rows is known.
    """

    residual_um: FloatArray
    bare_um: FloatArray | None
    sigma_um: FloatArray
    group: IntArray
    labels: Mapping[str, IntArray]
    time_s: FloatArray | None

    def square_sum(self, value_um: FloatArray) -> float:
        """Weighted sum of squares of values (n,)."""
        return float(np.sum((value_um / self.sigma_um) ** 2))

    def without_means(self, value_um: FloatArray, cell: IntArray) -> FloatArray:
        """Values (n,) minus the weighted mean of their cell."""
        weight = 1.0 / self.sigma_um**2
        total = np.bincount(cell, weight)
        mean = np.bincount(cell, weight * value_um) / np.where(total > 0, total, 1.0)
        return np.asarray(value_um - mean[cell])

    @property
    def clock(self) -> FloatArray:
        """Time of each reading, scaled to -1 ... 1; the order of the rows if the time is unknown."""
        return scaled_clock(np.arange(len(self.group)) if self.time_s is None else self.time_s)


def residual_series(
    readings: Lengths | Deviations,
    rows: NDArray[Any],
    residual_mm: FloatArray,
    sigma_mm: FloatArray,
    group: IntArray,
    bare_mm: FloatArray | None = None,
) -> ResidualSeries:
    """Collect the residuals (k,) of the readings at ``rows`` with their labels, see :class:`ResidualSeries`."""
    station = readings.station if isinstance(readings, Lengths) else None
    labels = labels_of(readings.labels, readings.origin, readings.position_mm, station)
    time = readings.covariates.get("time_s")
    return ResidualSeries(
        residual_um=residual_mm / MM_PER_UM,
        bare_um=None if bare_mm is None else bare_mm / MM_PER_UM,
        sigma_um=sigma_mm / MM_PER_UM,
        group=group,
        labels={name: label[rows] for name, label in labels.items()},
        time_s=None if time is None or not np.isfinite(time[rows]).all() else time[rows],
    )


@dataclass(frozen=True)
class Misfit:
    """How far the residuals exceed their uncertainty.

    Parameters
    ----------
    reduced_chi_square, degrees_of_freedom : of the used readings.
    limit : reduced chi-square that noise exceeds with probability ``FALSE_ALARM``; ``ASSUMED_FACTOR`` squared times
        that if the uncertainty was assumed.
    scaled_by : factor by which all standard uncertainties were increased.
    source : source of the uncertainty of the readings, "stated" or "assumed".
    causes : steps and drifts that explain most of the residuals, the strongest first.
    series : the residuals that were searched; None if there are none.
    """

    reduced_chi_square: float
    degrees_of_freedom: int
    limit: float
    scaled_by: float
    source: str
    causes: tuple[Cause, ...] = ()
    series: ResidualSeries | None = field(default=None, repr=False, compare=False)

    @property
    def beyond(self) -> bool:
        """Whether the residuals are larger than their uncertainty and the degrees of freedom allow."""
        return self.reduced_chi_square > self.limit

    @property
    def text(self) -> str:
        """The misfit in one sentence."""
        return (
            f"the residuals are {np.sqrt(self.reduced_chi_square):.3g} times their {self.source} uncertainty (reduced "
            f"chi-square {self.reduced_chi_square:.3g}, the limit is {self.limit:.3g}); all uncertainties were "
            f"widened by {self.scaled_by:.3g}"
        )

    def summary(self) -> dict[str, Any]:
        """Return the object ``misfit`` of ``identify.json``."""
        return {
            "beyond": self.beyond,
            "reduced_chi_square": self.reduced_chi_square,
            "limit": self.limit,
            "scaled_by": self.scaled_by,
            "source": self.source,
            "causes": [asdict(item) for item in self.causes],
        }


def misfit_of(
    reduced_chi_square: float,
    degrees_of_freedom: int,
    scaled_by: float,
    source: str,
    series: Callable[[], ResidualSeries] | None = None,
) -> Misfit:
    """Judge the size of the residuals, and search for causes if it exceeds the limit.

    ``series`` returns the used readings when they are needed.
    """
    noise_alone = chi_square_limit(degrees_of_freedom, FALSE_ALARM) / degrees_of_freedom
    limit = noise_alone * (ASSUMED_FACTOR**2 if source == "assumed" else 1.0)
    misfit = Misfit(reduced_chi_square, degrees_of_freedom, limit, scaled_by, source)
    if series is None or not reduced_chi_square > noise_alone:
        return misfit
    readings = series()
    # causes that explain most of the sum of squares, the strongest first
    whole, count = readings.square_sum(readings.residual_um), len(readings.group)
    found: dict[str, Cause] = {}
    for values_um in (readings.residual_um, readings.bare_um):
        if values_um is None:
            continue
        centred_um = readings.without_means(values_um, readings.group)
        for code, text, parameters, rest_um in _candidates(readings, centred_um):
            if count < READINGS_PER_PARAMETER * parameters:
                continue
            share = 1.0 - readings.square_sum(rest_um) * count / (count - parameters) / max(whole, 1e-30)
            if share > EXPLAINS and (code not in found or share > found[code].share):
                found[code] = Cause(code, text, round(share, 4))
    causes = sorted(found.values(), key=lambda item: -item.share)
    # a step between runs is also a step at one moment, and partly a drift: a cause that leaves twice as much is not
    # reported
    named = [item for item in causes if 1.0 - item.share < 2.0 * (1.0 - causes[0].share) + 1e-9]
    return replace(misfit, causes=tuple(named), series=readings)


def chi_square_limit(freedom: float, probability: float) -> float:
    """Value that chi-square with ``freedom`` degrees of freedom exceeds with a small probability (below a half).

    Newton's method on the logarithm of the upper tail, whose continued fraction over its density is all that a step needs
    (Press et al., Numerical Recipes, 6.2.7), from the value of Wilson & Hilferty (1931); scipy.special has the same
    function, and takes longer to load than an identification takes.

    >>> round(chi_square_limit(3, 0.001), 6)  # of any table
    16.266236
    """
    half, spread = 0.5 * freedom, 2.0 / (9.0 * freedom)
    x = half * (1.0 - spread + NormalDist().inv_cdf(1.0 - probability) * math.sqrt(spread)) ** 3
    for _ in range(4):
        below = x + 1.0 - half
        above, part, factor, count = math.inf, 1.0 / below, 0.0, 0
        fraction = part
        while abs(factor - 1.0) > 1e-15:
            count, below = count + 1, below + 2.0
            term = count * (half - count)
            part, above = 1.0 / (term * part + below), below + term / above
            factor = above * part
            fraction *= factor
        tail = half * math.log(x) - x - math.lgamma(half) + math.log(fraction)
        x += (tail - math.log(probability)) * x * fraction
    return 2.0 * x


def warn_of_misfit(reduced_chi_square: float, u_source: str) -> None:
    """Warn of residuals that are too large for the model to be right."""
    if reduced_chi_square > LARGEST_CHI_SQUARE[u_source]:
        warnings.warn(
            Message(
                "model-misfit",
                "the model does not describe the readings: the residuals are "
                "{reduced_chi_square:.0f} times their {u_source} uncertainty (reduced chi-square "
                "{reduced_chi_square2:.3g}); check the chain and the errors of the machine file, the "
                "order and the signs of the axes, and the uncertainty of a length",
                reduced_chi_square=np.sqrt(reduced_chi_square),
                u_source=u_source,
                reduced_chi_square2=reduced_chi_square,
            ),
            CompgenWarning,
            stacklevel=4,
        )


def split_labels(series: ResidualSeries) -> Iterator[tuple[str, str, IntArray]]:
    """Yield code, text and label (n,) of possible changes of the constants: run, block, file, a moment.

    With separate constants for each value of the label, a second adjustment shows whether that explains a misfit;
    residuals alone do not, if a step was mistaken for a reversal and distorted everything else.
    """
    for name, label in series.labels.items():
        if label.min() < label.max():
            yield f"step_between_{name}s", f"a step between {name}s", label
    for values_um in (series.bare_um, series.residual_um):
        if values_um is None:
            continue
        late = _best_split(series, series.without_means(values_um, series.group), series.clock)
        if late is not None:
            yield "step", f"a step at {_moment(series, late)}", late
            return


def _moment(series: ResidualSeries, late: IntArray) -> str:
    row = int(np.argmin(np.where(late > 0, series.clock, np.inf)))
    return f"reading {row + 1}" if series.time_s is None else f"{series.time_s[row]:.0f} s"


def _candidates(series: ResidualSeries, value_um: FloatArray) -> Iterator[tuple[str, str, int, FloatArray]]:
    """Yield code, text and number of parameters of each cause, and the rest of values (n,) without group means."""
    for name, label in series.labels.items():
        _, place = np.unique(label, return_inverse=True)
        if place.max() > 0:
            cell = _pairs(series.group, place.ravel())
            rest_um = series.without_means(value_um, cell)
            size_um = 2.0 * float(np.sqrt(np.mean((value_um - rest_um) ** 2)))
            yield (
                f"step_between_{name}s",
                f"a step between {name}s of about {size_um:.3g} um",
                int(cell.max()) + 1,
                rest_um,
            )
    clock, groups = series.clock, int(series.group.max()) + 1
    late = _best_split(series, value_um, clock)
    if late is not None:
        rest_um = series.without_means(value_um, _pairs(series.group, late))
        size_um = 2.0 * float(np.sqrt(np.mean((value_um - rest_um) ** 2)))
        yield "step", f"a step of about {size_um:.3g} um at {_moment(series, late)}", 2 * groups, rest_um
    drift_um = _drift(series, value_um, clock)
    text = f"a drift with time over a range of about {float(np.ptp(drift_um)):.3g} um"
    yield "drift", text, DRIFT_DEGREE * groups, value_um - drift_um


def _pairs(first: IntArray, second: IntArray) -> IntArray:
    """Number the pairs of two labels."""
    _, number = np.unique(first * (int(second.max()) + 1) + second, return_inverse=True)
    return np.asarray(number, dtype=np.int64).ravel()


def _best_split(series: ResidualSeries, value_um: FloatArray, clock: FloatArray) -> IntArray | None:
    """Return which readings (1) are after the moment that best splits values without group means; None if none does."""
    weight = 1.0 / series.sigma_um**2
    groups = int(series.group.max()) + 1
    total = np.bincount(series.group, weight, groups)
    best, found = 0.0, None
    for place in np.unique(np.quantile(clock, np.linspace(0.0, 1.0, MOMENTS + 2)[1:-1], method="lower")).tolist():
        late = clock > place
        behind = np.bincount(series.group, weight * late, groups)
        both = (behind > 1e-9 * total) & (behind < (1.0 - 1e-9) * total)
        moved = np.bincount(series.group, weight * value_um * late, groups)[both]
        taken = float(np.sum(moved**2 * total[both] / (behind[both] * (total[both] - behind[both]))))
        if taken > best:
            best, found = taken, late.astype(np.int64)
    return found


def _drift(series: ResidualSeries, value_um: FloatArray, clock: FloatArray) -> FloatArray:
    """Polynomial in time of each group that fits the values best, (n,)."""
    fitted = np.zeros(len(value_um))
    for group in np.unique(series.group).tolist():
        own = series.group == group
        if np.count_nonzero(own) > DRIFT_DEGREE + 1 and np.ptp(clock[own]) > 0:
            design = np.polynomial.legendre.legvander(clock[own], DRIFT_DEGREE)
            weight = 1.0 / series.sigma_um[own]
            fitted[own] = design @ np.linalg.lstsq(weight[:, None] * design, weight * value_um[own], rcond=None)[0]
    return fitted


def drift_of_repeats(lengths: Lengths) -> FloatArray | None:
    """Return the drift of each station with time that repeated readings show, (n,), mm; None if too few are repeated.

    Two readings of one station at one position differ by the drift between them, whatever the machine's errors. The
    drift is a polynomial in time for each station, zero on average.
    """
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    keys = np.column_stack([np.round(lengths.position_mm, 4), lengths.station, setup])
    _, first, stop = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    earlier = first[stop.ravel()]
    time = lengths.covariates.get("time_s")
    clock = scaled_clock(np.arange(len(lengths)) if time is None or not np.isfinite(time).all() else time)
    design = np.polynomial.legendre.legvander(clock, REPEATS_DEGREE)[:, 1:]
    drift = np.zeros(len(lengths))
    for station in range(len(lengths.stations)):
        rows = np.flatnonzero((lengths.station == station) & (earlier != np.arange(len(lengths))))
        if len(rows) < READINGS_PER_PARAMETER * REPEATS_DEGREE:
            return None
        moved = lengths.length_mm[rows] - lengths.length_mm[earlier[rows]]
        found = np.linalg.lstsq(design[rows] - design[earlier[rows]], moved, rcond=None)[0]
        own = lengths.station == station
        drift[own] = design[own] @ found - float(np.mean(design[own] @ found))
    return drift


def scaled_clock(time: NDArray[Any]) -> FloatArray:
    """Moments (n,) scaled to -1 ... 1."""
    span = float(np.ptp(time))
    return np.asarray(2.0 * (time - time.min()) / span - 1.0) if span > 0 else np.zeros(len(time))


def labels_of(
    labels: Mapping[str, IntArray],
    origin: Sequence[tuple[str, int]],
    position_mm: FloatArray,
    group: IntArray | None = None,
) -> dict[str, IntArray]:
    """Return the labels between which something may have moved (n,): run and block, and the file of each reading.

    Without run labels, the k-th reading at a position (n, 3) belongs to the k-th run; ``group`` (n,) distinguishes
    stations.
    """
    found = {name: labels[name] for name in ("run", "block") if name in labels}
    if "run" not in found:
        keys = np.round(np.asarray(position_mm), 4)
        keys = keys if group is None else np.column_stack([keys, group])
        _, stop = np.unique(keys, axis=0, return_inverse=True)
        # number of earlier occurrences of each value
        stop = stop.ravel()
        order = np.argsort(stop, kind="stable")
        first = np.flatnonzero(np.diff(stop[order], prepend=-1))
        found["run"] = np.empty(len(stop), dtype=np.int64)
        found["run"][order] = np.arange(len(stop)) - np.repeat(first, np.diff(np.append(first, len(stop))))
    names = {file: k for k, file in enumerate(dict.fromkeys(file for file, _ in origin))}
    if len(names) > 1:
        found["file"] = np.array([names[file] for file, _ in origin], dtype=np.int64)
    return found


# Whether the residuals are noise: tests along time, between stations, over distance and along the axes.
#
# Residuals of a model that describes the readings are independent, with the stated variance. Every test is
# conservative, because fitting removes part of the noise from the residuals.


#: Probability of a false alarm of each of the four kinds of test, over all stations and axes; together below 1 %.
WHITENESS_FALSE_ALARM = 0.001
#: Variance ratios between stations, and between near and far readings, that are too small to matter.
STATION_RATIO = 2.0
DISTANCE_RATIO = 1.5
#: Fewer readings than this are not tested.
LEAST_READINGS = 30
#: Residuals smaller than this share of their uncertainty are rounding.
ROUNDING = 0.02
#: Levels of an axis are combined into at most this many bins.
MOST_BINS = 60
#: An error is weakly determined if its standard uncertainty in um or urad is this many times that of a reading in um,
WEAK = 50.0
#: ... or if it is more than this share of the error, and moves the tool by this many times that of a reading.
WEAK_SHARE, WEAK_READINGS = 1.0 / 6.0, 3.0


@dataclass(frozen=True)
class StationWhiteness:
    """One station: autocorrelation of successive residuals, Durbin-Watson statistic, variance relative to the mean of all.

    ``limit`` is the autocorrelation from which the test fires.
    """

    lag_1: float
    limit: float
    durbin_watson: float
    variance_ratio: float


@dataclass(frozen=True)
class Whiteness:
    """Results of all tests.

    Parameters
    ----------
    stations : by name.
    far_to_near : variance of the far half of the readings over that of the near half.
    axes : for each axis the variance of the means of the levels, station by station, over what noise would give, and
        the limit of that.
    messages : deviations from whiteness, in words; empty for white residuals.
    """

    stations: Mapping[str, StationWhiteness]
    far_to_near: float
    axes: Mapping[str, tuple[float, float]]
    messages: tuple[str, ...]

    @property
    def white(self) -> bool:
        """Whether no test fired."""
        return not self.messages

    def summary(self) -> dict[str, Any]:
        """Return the object ``whiteness`` of ``identify.json``."""
        return {
            "white": self.white,
            "stations": {name: asdict(item) for name, item in self.stations.items()},
            "far_to_near_variance": self.far_to_near,
            "axes": {name: {"ratio": ratio, "limit": limit} for name, (ratio, limit) in self.axes.items()},
            "messages": list(self.messages),
        }


def check_whiteness(
    lengths: Lengths, group: IntArray, standardised: FloatArray, distance_mm: FloatArray, unknowns: int
) -> Whiteness:
    """Test the residuals of the used readings.

    Parameters
    ----------
    lengths, group : the readings and the dead length of each, (n,).
    standardised : residual over standard uncertainty of each, (n,); nan for a rejected one.
    distance_mm : distance of each, (n,).
    unknowns : number of fitted unknowns.
    """
    used = np.isfinite(standardised)
    z = np.where(used, standardised, 0.0)
    mean_square = float(z @ z) / max(int(used.sum()), 1)
    if used.sum() - unknowns < LEAST_READINGS or mean_square < ROUNDING**2:
        return Whiteness({}, 1.0, {}, ())
    z = z / np.sqrt(mean_square)
    stations = _stations(lengths, group, z, used, unknowns)
    far_to_near, distance_message = _distance(z[used], distance_mm[used])
    axes = {name: _axis(lengths, z, used, axis) for axis, name in enumerate(AXES)}
    messages = []
    for name, item in stations.items():
        if item.lag_1 > item.limit:
            messages.append(
                f"successive residuals of station {name} are correlated: autocorrelation {item.lag_1:.2f} (limit "
                f"{item.limit:.2f}), Durbin-Watson {item.durbin_watson:.2f} (noise: 2); drift, or another effect"
            )
        pairs = (_normal_limit(1) / item.limit) ** 2
        chance = 2.0 * _normal_limit(2 * len(stations)) * np.sqrt(2.0 / pairs)  # of the ratio, with a margin
        if item.variance_ratio > STATION_RATIO + chance or item.variance_ratio < 1.0 / (STATION_RATIO + chance):
            messages.append(
                f"the residuals of station {name} have {item.variance_ratio:.2f} times the variance of all, contrary to the "
                "stated uncertainty; give it a separate uncertainty, or find what disturbs it"
            )
    messages += [
        *distance_message,
        *(
            f"the residuals depend on the position of {name}: the means of its levels scatter {ratio:.1f} times as much "
            f"as noise would (limit {limit:.1f}); a finer curve or another effect is missing"
            for name, (ratio, limit) in axes.items()
            if ratio > limit
        ),
    ]
    return Whiteness(stations, far_to_near, axes, tuple(messages))


def _normal_limit(tests: int) -> float:
    """Value that a standard normal variable exceeds with FALSE_ALARM / tests."""
    return NormalDist().inv_cdf(1.0 - WHITENESS_FALSE_ALARM / tests)


def _stations(
    lengths: Lengths, group: IntArray, z: FloatArray, used: np.ndarray[Any, Any], unknowns: int
) -> dict[str, StationWhiteness]:
    order = time_order(lengths)
    order = order[used[order]]
    order = order[np.argsort(group[order], kind="stable")]
    same = group[order[1:]] == group[order[:-1]]
    before, after = z[order[:-1]], z[order[1:]]
    of_pair = lengths.station[order[1:]]
    count = len(lengths.stations)
    pairs = np.bincount(of_pair, same, count)
    products = np.bincount(of_pair, before * after * same, count)
    changes = np.bincount(of_pair, (after - before) ** 2 * same, count)
    squares = np.bincount(lengths.station, z**2, count)
    readings = np.bincount(lengths.station, used, count)
    limit = _normal_limit(count)
    found = {}
    for k, name in enumerate(lengths.stations):
        if pairs[k] < LEAST_READINGS:
            continue
        mean = squares[k] / readings[k]
        found[name] = StationWhiteness(
            lag_1=float(products[k] / pairs[k] / mean),
            limit=float(limit / np.sqrt(pairs[k])),
            durbin_watson=float(changes[k] / pairs[k] / mean),
            variance_ratio=float(mean),
        )
    return found


def _distance(z: FloatArray, distance_mm: FloatArray) -> tuple[float, list[str]]:
    """Return the ratio of the variances of far and near readings, and the message if it is not one."""
    far = distance_mm > median(distance_mm)
    if min(np.count_nonzero(far), np.count_nonzero(~far)) < LEAST_READINGS:
        return 1.0, []
    ratio = float(np.mean(z[far] ** 2) / np.mean(z[~far] ** 2))
    chance = _normal_limit(2) * np.sqrt(2.0 / np.count_nonzero(far) + 2.0 / np.count_nonzero(~far))
    if abs(np.log(ratio)) < np.log(DISTANCE_RATIO) + chance:
        return ratio, []
    return ratio, [
        f"the far half of the readings has {ratio:.2f} times the variance of the near half, contrary to the stated "
        "uncertainty a + b L: a and b do not describe the readings"
    ]


def _axis(lengths: Lengths, z: FloatArray, used: np.ndarray[Any, Any], axis: int) -> tuple[float, float]:
    """Mean square of the level means of all stations times their numbers (1 for noise, less after a fit), and limit."""
    levels, level = levels_of(lengths.position_mm[:, axis])
    if len(levels) > MOST_BINS:
        level = (level * MOST_BINS) // len(levels)
    cell = level * len(lengths.stations) + lengths.station
    numbers = np.bincount(cell, used)
    sums = np.bincount(cell, z)
    filled = numbers > 0
    cells = int(np.count_nonzero(filled))
    ratio = float(np.sum(sums[filled] ** 2 / numbers[filled]) / cells)
    # Wilson & Hilferty (1931): the upper tail of chi-square over its degrees of freedom
    spread = 2.0 / (9.0 * cells)
    return ratio, float((1.0 - spread + _normal_limit(3) * np.sqrt(spread)) ** 3)


def warn_of_weakness(
    machine: Machine, errors: ErrorTable, worst: Mapping[str, tuple[float, str]], sigma_mm: float
) -> None:
    """Warn of errors that the set-up determines only weakly.

    That is a standard uncertainty far above that of a reading, or one that is a large part of the error itself and
    moves the tool, by the lever arms of this machine, by more than the scatter of the readings.

    Parameters
    ----------
    machine : its chain, travel and tool give the lever arms.
    errors : the identified errors.
    worst : the largest standard uncertainty by unit with its error.
    sigma_mm : standard uncertainty of a reading.
    """
    advice = "place the stations at different heights, not on a line, and not in a plane with an end of the travel"
    for unit, (value, name) in worst.items():
        times = value * MM_PER_UM / sigma_mm
        if times > WEAK:
            warnings.warn(
                Message(
                    "unknown-weakly-determined",
                    "{name} is weakly determined: its standard uncertainty is {value:.3g} {unit}, "
                    "{times:.0f} times that of a reading; {advice}",
                    name=name,
                    value=value,
                    unit=unit,
                    times=times,
                    advice=advice,
                ),
                CompgenWarning,
                stacklevel=4,
            )
            return
    weak = []
    corners = np.array(list(itertools.product(*zip(machine.lower_mm, machine.upper_mm, strict=True))))
    levers = np.linalg.norm(c_matrix(machine, corners), axis=1).max(axis=0)
    for name in errors.names:
        if name in errors.squareness:
            size, u = (abs(part) for part in errors.squareness[name])
        else:
            size, u = float(np.abs(errors.curves[name].value).max()), float(errors.curves[name].u.max())
        if u > WEAK_SHARE * size and u * levers[ERROR_INDEX[name]] > WEAK_READINGS * sigma_mm:
            weak.append(name)
    if weak:
        warnings.warn(
            Message(
                "weakly-determined",
                "{weak} {weak2} weakly determined: the standard uncertainty is more than a sixth of "
                "the largest value; {advice}",
                weak=", ".join(weak),
                weak2="are" if len(weak) > 1 else "is",
                advice=advice,
            ),
            CompgenWarning,
            stacklevel=4,
        )


def warn_of_residuals(whiteness: Whiteness, reduced_chi_square: float, u_source: str) -> None:
    """Warn of residuals that are not white, unless they are too large for the model to be right."""
    if whiteness.messages and reduced_chi_square <= LARGEST_CHI_SQUARE[u_source]:
        more = f"; and {len(whiteness.messages) - 1} more in identify.json" if len(whiteness.messages) > 1 else ""
        warnings.warn(
            Message(
                "residuals-not-white",
                "the residuals are not white: {messages}{more}",
                messages=whiteness.messages[0],
                more=more,
            ),
            CompgenWarning,
            stacklevel=4,
        )
