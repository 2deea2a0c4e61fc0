"""Classes of noise that have a name of their own: outliers, a trend of the variance with time, quantisation.

They are looked for in what is left when the model, everything that was found and the free generic terms are taken out
of the readings, so that an effect does not pass for an outlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.diagnose.analysis import Analysis
from compgen.diagnose.base import least_norm
from compgen.diagnose.evidence import leftover
from compgen.diagnose.layout import IntArray, Layout
from compgen.diagnose.result import Classed

#: A reading further than so many standard deviations from its neighbours in time is gross; readings of 4600 without
#: gross errors hold one in one of 10^5 sets.
GROSS = 6.5
#: Gross readings are the exception: with a larger share something else is the matter.
MOST_GROSS = 0.03
#: Neighbours in time whose median a reading is compared with, itself among them.
NEIGHBOURS = 5
#: A gross reading moves the fit, and by it others: the largest are taken out first, and the fit is repeated.
ROUNDS = 8
#: Numbers of stops in a burst that are tried, and the largest share of the session that is one.
BURSTS, LONGEST_BURST = (2, 3, 4, 6, 8, 11, 15, 20, 27, 36, 48), 0.03
#: Mean square in a burst beyond the median of all windows of its length, in robust standard deviations of these. Noise
#: that wanders alike at all stations has one degree of freedom in a window: 30 is beyond one window in 50,000 then.
LOUD = 30.0
#: Stops at the ends of a burst below this many times the median mean square do not belong to it.
QUIET = 5.0
#: Most bursts, and rounds in which the fit is repeated without them.
MOST_BURSTS = 3
#: Deviate of the slope of the variance against time that counts as a trend.
TREND_Z = 6.0
#: Share of readings that must lie on a grid of the step, and the least step over the noise.
ON_GRID, COARSE = 0.999, 1.0


def classes_of(analysis: Analysis, removed: int = 0) -> list[Classed]:
    """Return the classes of noise that the readings show beyond doubt; ``removed`` gross readings were left out."""
    found = _outliers(removed)
    return [*found, *_trend(analysis, leftover(analysis.scene, analysis.chosen)), *_quantised(analysis)]


def gross_readings(analysis: Analysis) -> IntArray:
    """Rows of readings that lie far from their neighbours when all that was found is taken off; none if they are many."""
    fit, scene = analysis.fit, analysis.scene
    added = [scene.groups[g].columns @ scene.maps[g] for g in analysis.chosen.members]
    design = np.hstack([fit.jacobian, *added])
    kept = np.ones(len(design), dtype=bool)
    for _ in range(ROUNDS):
        left = fit.residual_mm - design @ least_norm(design[kept], fit.residual_mm[kept])
        size = _apart(fit.observed.layout, left / analysis.noise.scale) * kept
        if size.max() <= GROSS:
            break
        kept &= size < max(GROSS, 0.5 * float(size.max()))
    found = np.flatnonzero(~kept)
    return found if len(found) <= MOST_GROSS * len(design) else np.zeros(0, dtype=np.int64)


def _apart(layout: Layout, left: FloatArray) -> FloatArray:
    """Distance from the median of the neighbours in time at the same channel, in standard deviations, (n,)."""
    from scipy.ndimage import median_filter  # imported here: slow to load

    apart = np.zeros_like(left)
    for channel in np.unique(layout.channel):
        rows = np.flatnonzero(layout.channel == channel)
        rows = rows[np.argsort(layout.stop[rows], kind="stable")]
        apart[rows] = left[rows] - median_filter(left[rows], NEIGHBOURS, mode="nearest")
    moved = np.abs(apart[apart != 0.0])
    if len(moved) < NEIGHBOURS * NEIGHBOURS:
        return np.zeros(len(left))
    return np.asarray(np.abs(apart) / (1.4826 * float(np.median(moved))))


@dataclass(frozen=True)
class Burst:
    """Readings ``rows`` that are far off for a short time, from ``first`` to ``last`` (s, or numbers of the stops)."""

    rows: IntArray
    first: float
    last: float
    rms_mm: float
    timed: bool

    @property
    def text(self) -> str:
        """In words."""
        unit = " s" if self.timed else ""
        what = "time" if self.timed else "stop"
        return (
            f"disturbed readings from {what} {self.first:g}{unit} to {self.last:g}{unit}: {len(self.rows)} readings, "
            f"{self.rms_mm / MM_PER_UM:.2f} um rms beside everything that was found"
        )


def disturbed_readings(analysis: Analysis) -> list[Burst]:
    """Short bursts in time in which the readings of all channels are far off (a gust, somebody at the machine).

    What is left of the readings is compared between windows of equal length, so that noise of any size, and slow noise,
    sets its own scale; the fit is repeated without each burst, since a burst pulls it.
    """
    fit, scene = analysis.fit, analysis.scene
    layout = fit.observed.layout
    added = [scene.groups[g].columns @ scene.maps[g] for g in analysis.chosen.members]
    design = np.hstack([fit.jacobian, *added])
    kept = np.ones(len(design), dtype=bool)
    found: list[Burst] = []
    for _ in range(MOST_BURSTS):
        left = fit.residual_mm - design @ least_norm(design[kept], fit.residual_mm[kept])
        window = _loudest(layout, (left / analysis.noise.scale) ** 2 * kept)
        if window is None:
            break
        rows = np.flatnonzero((layout.stop >= window[0]) & (layout.stop <= window[1]) & kept)
        kept[rows] = False
        left = fit.residual_mm - design @ least_norm(design[kept], fit.residual_mm[kept])
        first, last = (float(layout.time[stop]) for stop in window)
        found.append(Burst(rows, first, last, float(np.sqrt(np.mean(left[rows] ** 2))), layout.timed))
    return found


def _loudest(layout: Layout, square: FloatArray) -> tuple[int, int] | None:
    """First and last stop of the loudest window, None if none is loud; ``square`` (n,) is zero where left out."""
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
    """Bursts as they are reported."""
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


def _outliers(removed: int) -> list[Classed]:
    if not removed:
        return []
    text = f"{removed} reading(s) lie more than {GROSS:g} standard deviations from their neighbours; they were left out"
    return [Classed("outliers", {"count": float(removed)}, 1.0, text)]


def _trend(analysis: Analysis, residual: FloatArray) -> list[Classed]:
    """Score test of the variance against time (Breusch and Pagan 1979, in the form of Koenker 1981), outliers clipped."""
    layout = analysis.fit.observed.layout
    time = analysis.scene.whiten.order_of(layout.stop)
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


def _quantised(analysis: Analysis) -> list[Classed]:
    """Readings that all lie on a grid whose step is as large as the noise."""
    values = analysis.fit.observed.value_mm
    sigma = float(np.sqrt(analysis.noise.variances.white))
    apart = np.diff(np.unique(np.round(values, 7)))
    if not apart.size:
        return []
    step = float(apart.min())
    if step < COARSE * sigma:
        return []
    off = np.abs(values / step - np.round(values / step))
    if float(np.mean(off < 0.01)) < ON_GRID:
        return []
    text = f"readings are multiples of {step / MM_PER_UM:g} um, as coarse as the noise"
    return [Classed("quantisation", {"step_um": step / MM_PER_UM}, 1.0, text)]
