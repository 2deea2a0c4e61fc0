"""Whether the residuals are larger than their uncertainty allows, and whether a step or a drift explains most of them.

``whiteness`` tests whether residuals look like noise; this asks how large they are, and for the causes that make a
measurement worthless although every uncertainty can be computed: something moved between two runs, at one moment, or
slowly. Such a cause is looked for with the sum of squares that it takes away, in the residuals as they are and in those
with the reversal put back: a step between two runs that came from opposite sides looks like a reversal at first.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.errors import CompgenWarning

IntArray = NDArray[np.int64]

#: Probability that noise of the stated uncertainty alone gives a larger reduced chi-square than the limit.
FALSE_ALARM = 0.001
#: An uncertainty that was assumed, not stated, may be wrong by this factor before the residuals speak against the model.
ASSUMED_FACTOR = 5.0
#: A cause is named when it takes away this share of the sum of squares, ...
EXPLAINS = 0.5
#: ... with at least so many readings for each of its parameters.
READINGS_PER_PARAMETER = 10
#: Degree of the polynomial in time that a drift is looked for with.
DRIFT_DEGREE = 3
#: Degree of the polynomial in time that repeated readings are compared with.
REPEATS_DEGREE = 5
#: Moments at which a step is tried.
MOMENTS = 200
#: Times the uncertainty from which the machine file or the units, and not the measurement, are in doubt.
LARGEST_CHI_SQUARE = {"stated": 25.0, "assumed": 1000.0}


@dataclass(frozen=True)
class Cause:
    """Something that explains most of the residuals: ``code`` for programs, ``text`` for people, share of the squares."""

    code: str
    text: str
    share: float


@dataclass(frozen=True)
class Series:
    """Residuals in the order in which they were read, n of them, for the search for causes.

    Parameters
    ----------
    residual_um : residuals, (n,).
    bare_um : the same with the reversal put back where one was taken out, (n,); None where none was.
    sigma_um : standard uncertainty of each, (n,).
    group : what has an unknown constant of its own, (n,): the dead length of a length, the component of a deviation.
    labels : what may have moved between readings of different value: run, block, file, each (n,).
    time_s : moments, (n,); None where the order of the rows is all that is known.
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
        """Time of each reading, scaled to -1 ... 1; the order of the rows where no time is known."""
        return scaled_clock(np.arange(len(self.group)) if self.time_s is None else self.time_s)


@dataclass(frozen=True)
class Misfit:
    """How far the residuals are above what their uncertainty allows.

    Parameters
    ----------
    reduced_chi_square, degrees_of_freedom : of the readings that were used.
    limit : reduced chi-square that noise exceeds with probability ``FALSE_ALARM``; ``ASSUMED_FACTOR`` squared times that
        where the uncertainty was assumed.
    scaled_by : by how much all standard uncertainties were widened.
    source : where the uncertainty of the readings comes from, "stated" or "assumed".
    causes : steps and drifts that explain most of the residuals, the strongest first.
    series : the residuals that they were looked for in; None where there are none.
    """

    reduced_chi_square: float
    degrees_of_freedom: int
    limit: float
    scaled_by: float
    source: str
    causes: tuple[Cause, ...] = ()
    series: Series | None = field(default=None, repr=False, compare=False)

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
    reduced_chi_square: float, degrees_of_freedom: int, scaled_by: float, source: str, series: Callable[[], Series]
) -> Misfit:
    """Judge the size of the residuals, and look for causes where it is beyond the limit.

    ``series`` makes the readings that were used, where they are looked at.
    """
    noise_alone = float(chdtri(degrees_of_freedom, FALSE_ALARM)) / degrees_of_freedom
    limit = noise_alone * (ASSUMED_FACTOR**2 if source == "assumed" else 1.0)
    found = Misfit(reduced_chi_square, degrees_of_freedom, limit, scaled_by, source)
    if not reduced_chi_square > noise_alone:
        return found
    readings = series()
    return replace(found, causes=tuple(_causes(readings)), series=readings)


def warn_of_misfit(reduced_chi_square: float, u_source: str) -> None:
    """Warn of residuals that are too large for the model to be right."""
    if reduced_chi_square > LARGEST_CHI_SQUARE[u_source]:
        warnings.warn(
            f"the model does not describe the readings: the residuals are {np.sqrt(reduced_chi_square):.0f} times their "
            f"{u_source} uncertainty (reduced chi-square {reduced_chi_square:.3g}); check the chain and the errors of the "
            "machine file, the order and the signs of the axes, and the uncertainty of a length",
            CompgenWarning,
            stacklevel=4,
        )


def _causes(series: Series) -> list[Cause]:
    """Causes that take away most of the sum of squares, the strongest first."""
    whole, count = series.square_sum(series.residual_um), len(series.group)
    found: dict[str, Cause] = {}
    for values_um in (series.residual_um, series.bare_um):
        if values_um is None:
            continue
        centred_um = series.without_means(values_um, series.group)
        for code, text, parameters, rest_um in _candidates(series, centred_um):
            if count < READINGS_PER_PARAMETER * parameters:
                continue
            share = 1.0 - series.square_sum(rest_um) * count / (count - parameters) / max(whole, 1e-30)
            if share > EXPLAINS and (code not in found or share > found[code].share):
                found[code] = Cause(code, text, round(share, 4))
    causes = sorted(found.values(), key=lambda item: -item.share)
    # a step between runs is a step at one moment, too, and much of a drift: what leaves twice as much is not named
    return [item for item in causes if 1.0 - item.share < 2.0 * (1.0 - causes[0].share) + 1e-9]


def split_labels(series: Series) -> Iterator[tuple[str, str, IntArray]]:
    """Yield code, text and label (n,) of what may have given the readings another constant: run, block, file, a moment.

    With a constant of its own for each value of the label, a second adjustment tells whether that explains a misfit;
    residuals alone do not, where a step was taken for a reversal and bent everything else.
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


def _moment(series: Series, late: IntArray) -> str:
    row = int(np.argmin(np.where(late > 0, series.clock, np.inf)))
    return f"reading {row + 1}" if series.time_s is None else f"{series.time_s[row]:.0f} s"


def _candidates(series: Series, value_um: FloatArray) -> Iterator[tuple[str, str, int, FloatArray]]:
    """Yield code, text and number of parameters of each cause, and what it leaves of values (n,) without group means."""
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


def _best_split(series: Series, value_um: FloatArray, clock: FloatArray) -> IntArray | None:
    """Return which readings (1) lie after the moment that splits values without group means best; None if none does."""
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


def _drift(series: Series, value_um: FloatArray, clock: FloatArray) -> FloatArray:
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

    Two readings of one station at one position differ by what drifted between them, whatever the machine's errors are. The
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
    """Return what may have moved between readings (n,): the labels run and block, and the file of each.

    Where no run is labelled, the readings that come to a position (n, 3) for the k-th time are the k-th run of it; ``group``
    (n,) says which readings belong to another station.
    """
    found = {name: labels[name] for name in ("run", "block") if name in labels}
    if "run" not in found:
        keys = np.round(np.asarray(position_mm), 4)
        keys = keys if group is None else np.column_stack([keys, group])
        _, stop = np.unique(keys, axis=0, return_inverse=True)
        found["run"] = _occurrence(stop.ravel())
    names = {file: k for k, file in enumerate(dict.fromkeys(file for file, _ in origin))}
    if len(names) > 1:
        found["file"] = np.array([names[file] for file, _ in origin], dtype=np.int64)
    return found


def _occurrence(value: IntArray) -> IntArray:
    """Number, from 0, how often each value has been there before (n,)."""
    order = np.argsort(value, kind="stable")
    ranked = value[order]
    first = np.flatnonzero(np.concatenate([[True], ranked[1:] != ranked[:-1]]))
    counted = np.arange(len(value)) - np.repeat(first, np.diff(np.append(first, len(value))))
    result = np.empty(len(value), dtype=np.int64)
    result[order] = counted
    return result
