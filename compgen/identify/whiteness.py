"""Whether the residuals are noise: tests along time, between stations, over distance and along the axes.

Residuals of a model that describes the readings are independent, with the variance that was stated. Every test is made
so that it errs on the quiet side, because fitting takes part of the noise out of the residuals.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES, ERROR_INDEX, MM_PER_UM
from compgen.errors import CompgenWarning
from compgen.identify.grid_readings import levels_of
from compgen.identify.misfit import LARGEST_CHI_SQUARE
from compgen.identify.segments import time_order
from compgen.identify.state import IntArray
from compgen.model.volumetric import c_matrix

#: Probability of a false alarm of each of the four kinds of test, over all stations and axes; together below 1 %.
FALSE_ALARM = 0.001
#: Variance ratios between stations, and between near and far readings, that are small enough to be of no interest.
STATION_RATIO = 2.0
DISTANCE_RATIO = 1.5
#: Fewer readings than this say nothing.
LEAST_READINGS = 30
#: Residuals smaller than this share of their uncertainty are rounding.
ROUNDING = 0.02
#: Levels of an axis are gathered into at most so many bins.
MOST_BINS = 60
#: An error is hardly determined when its standard uncertainty in um or urad is so many times that of a reading in um.
WEAK = 50.0
#: ... or when it is more than this share of the error, and moves the tool by so many times that of a reading.
WEAK_SHARE, WEAK_READINGS = 1.0 / 6.0, 3.0


@dataclass(frozen=True)
class StationWhiteness:
    """One station: autocorrelation of successive residuals, Durbin-Watson statistic, variance against the mean of all.

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
    messages : what is not white, in words; empty for white residuals.
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
    """Test residuals of readings that were used.

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
    messages = [
        *_station_messages(stations),
        *distance_message,
        *(
            f"the residuals depend on the position of {name}: the means of its levels scatter {ratio:.1f} times as much "
            f"as noise would (limit {limit:.1f}); a finer curve or a further effect is missing"
            for name, (ratio, limit) in axes.items()
            if ratio > limit
        ),
    ]
    return Whiteness(stations, far_to_near, axes, tuple(messages))


def _normal_limit(tests: int) -> float:
    """Value that a standard normal variable exceeds with FALSE_ALARM / tests."""
    from statistics import NormalDist

    return NormalDist().inv_cdf(1.0 - FALSE_ALARM / tests)


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


def _station_messages(stations: Mapping[str, StationWhiteness]) -> list[str]:
    found = []
    for name, item in stations.items():
        if item.lag_1 > item.limit:
            found.append(
                f"successive residuals of station {name} are alike: autocorrelation {item.lag_1:.2f} (limit "
                f"{item.limit:.2f}), Durbin-Watson {item.durbin_watson:.2f} where noise has 2; drift, or a further effect"
            )
        pairs = (_normal_limit(1) / item.limit) ** 2
        chance = 2.0 * _normal_limit(2 * len(stations)) * np.sqrt(2.0 / pairs)  # of the ratio, with a margin
        if item.variance_ratio > STATION_RATIO + chance or item.variance_ratio < 1.0 / (STATION_RATIO + chance):
            found.append(
                f"the residuals of station {name} have {item.variance_ratio:.2f} times the variance of all, against the "
                "stated uncertainty; give it another uncertainty, or look for what disturbs it"
            )
    return found


def _distance(z: FloatArray, distance_mm: FloatArray) -> tuple[float, list[str]]:
    """Ratio of the variances of far and near readings, and the message if it is not one."""
    far = distance_mm > np.median(distance_mm)
    if min(np.count_nonzero(far), np.count_nonzero(~far)) < LEAST_READINGS:
        return 1.0, []
    ratio = float(np.mean(z[far] ** 2) / np.mean(z[~far] ** 2))
    chance = _normal_limit(2) * np.sqrt(2.0 / np.count_nonzero(far) + 2.0 / np.count_nonzero(~far))
    if abs(np.log(ratio)) < np.log(DISTANCE_RATIO) + chance:
        return ratio, []
    return ratio, [
        f"the far half of the readings has {ratio:.2f} times the variance of the near half, against the stated "
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
    """Warn of errors that the set-up hardly shows.

    That is a standard uncertainty far above that of a reading, or one that is a good part of the error itself and moves the
    tool, by the lever arms of this machine, by more than the readings scatter.

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
                f"{name} is hardly determined: its standard uncertainty is {value:.3g} {unit}, {times:.0f} "
                f"times that of a reading; {advice}",
                CompgenWarning,
                stacklevel=4,
            )
            return
    weak = [name for name in errors.names if _weak(machine, errors, name, sigma_mm)]
    if weak:
        warnings.warn(
            f"{', '.join(weak)} {'are' if len(weak) > 1 else 'is'} hardly determined: the standard uncertainty is more than a "
            f"sixth of the largest value; {advice}",
            CompgenWarning,
            stacklevel=4,
        )


def _weak(machine: Machine, errors: ErrorTable, name: str, sigma_mm: float) -> bool:
    if name in errors.squareness:
        value, u = (abs(part) for part in errors.squareness[name])
    else:
        curve = errors.curves[name]
        value, u = float(np.abs(curve.value).max()), float(curve.u.max())
    corners = np.array(list(itertools.product(*zip(machine.lower_mm, machine.upper_mm, strict=True))))
    lever = float(np.linalg.norm(c_matrix(machine, corners)[:, :, ERROR_INDEX[name]], axis=1).max())
    return bool(u > WEAK_SHARE * value and u * lever > WEAK_READINGS * sigma_mm)


def warn_of_residuals(whiteness: Whiteness, reduced_chi_square: float, u_source: str) -> None:
    """Warn of residuals that are not white, unless they are too large for the model to be right at all."""
    if whiteness.messages and reduced_chi_square <= LARGEST_CHI_SQUARE[u_source]:
        more = f"; and {len(whiteness.messages) - 1} more in identify.json" if len(whiteness.messages) > 1 else ""
        warnings.warn(f"the residuals are not white: {whiteness.messages[0]}{more}", CompgenWarning, stacklevel=4)
