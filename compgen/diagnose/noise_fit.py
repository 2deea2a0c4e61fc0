"""From a base fit to its noise model: dependence on range and channel, then the variances of the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.base import BaseFit
from compgen.diagnose.groups import Group
from compgen.diagnose.layout import IntArray, Layout
from compgen.diagnose.noise import Noise, Variances, fit_reml, packed, reml_problem, spacing_of

#: Differences of repeats below which the residuals themselves have to serve.
LEAST_DIFFERENCES = 60
#: Slope over its uncertainty above which the noise depends on range.
RANGE_Z = 3.5
#: The same for channels whose noise differs: deviate of the logarithm of a variance.
CHANNEL_Z = 6.0
#: Neighbouring second differences overlap: sum of their squared correlations.
OVERLAP = 1 + 2 * (4 / 6) ** 2 + 2 * (1 / 6) ** 2
#: Squares beyond so many times the variance are gross errors and count as this.
FAR_OUT = 16.0
#: Variance of single runs, as a share of the white one, below which it is not tested.
LEAST_RUN_SHARE = 0.04


def has_repeats(layout: Layout) -> bool:
    """Whether the measurement holds enough repeats for an independent noise model."""
    counts = np.bincount(layout.cell)
    return int(np.sum(np.maximum(counts - 1, 0))) >= LEAST_DIFFERENCES


def noise_of(
    fit: BaseFit, fixed: Sequence[Group], *, sigma_mm: FloatArray | None = None, before: Noise | None = None
) -> Noise:
    """Fit the noise model.

    Parameters
    ----------
    fit : the base fit.
    fixed : groups whose columns may differ between repeats; they neither inflate the noise nor are eaten by it.
    sigma_mm : standard uncertainty of every reading, if it is given, (n,); used without repeats.
    before : an earlier model to start from.
    """
    layout = fit.observed.layout
    if not has_repeats(layout):
        return _without_repeats(fit, fixed, sigma_mm)
    scale = before.scale if before is not None else noise_scale(fit)
    residual = fit.residual_mm / scale
    problem = reml_problem(layout, residual, _unit_columns(fixed, len(residual)) / scale[:, None])
    start = None if before is None else np.maximum(packed(before.variances, problem.common), problem.starts * 1e-3)
    variances, quadratic, criterion, freedom = fit_reml(problem, start=start, steps=60 if before is None else 15)
    return Noise(variances, scale, quadratic, freedom, criterion, "repeats", spacing_of(layout))


def _unit_columns(groups: Sequence[Group], count: int) -> FloatArray:
    if not groups:
        return np.zeros((count, 0))
    columns = np.hstack([group.columns for group in groups])
    return np.asarray(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))


def _without_repeats(fit: BaseFit, fixed: Sequence[Group], sigma_mm: FloatArray | None) -> Noise:
    """Noise from the residuals of the base model and of the groups ``fixed``: an assumption, not a measurement."""
    residual = fit.residual_mm
    columns = _unit_columns(fixed, len(residual))
    design = np.hstack([fit.jacobian, columns])
    q = np.linalg.qr(design / np.maximum(np.linalg.norm(design, axis=0), 1e-300))[0]
    residual = residual - q @ (q.T @ residual)
    freedom = max(len(residual) - design.shape[1], 1)
    residual = residual * np.sqrt(len(residual) / freedom)
    scale = np.ones(len(residual)) if sigma_mm is None else sigma_mm / np.sqrt(np.mean(sigma_mm**2))
    problem = reml_problem(
        fit.observed.layout, residual / scale, np.zeros((len(residual), 0)), repeats=False, runs=False
    )
    variances, quadratic, criterion, _ = fit_reml(problem, steps=20)
    source = "assumed" if sigma_mm is None else "given"
    if sigma_mm is not None:
        variances = Variances(float(np.mean(sigma_mm**2)), variances.own, variances.common)
    return Noise(variances, scale, quadratic, 0, criterion, source, spacing_of(fit.observed.layout))


def run_ratio(fit: BaseFit, fixed: Sequence[Group], noise: Noise, enough: float = 0.0) -> float:
    """Likelihood ratio of the parts that change from run to run; 0 where they are too small to matter.

    They are compared with noise that goes on in time, and with noise that goes on from stop to stop, unless the first
    comparison gives no more than ``enough``.
    """
    runs = float(noise.variances.own[-2:].sum() + noise.variances.common[-2:].sum())
    if noise.source != "repeats" or runs <= LEAST_RUN_SHARE * noise.variances.white:
        return 0.0
    scale = noise.scale
    columns = _unit_columns(fixed, len(scale)) / scale[:, None]
    ratio = np.inf
    for numbered in (False, True):
        problem = reml_problem(fit.observed.layout, fit.residual_mm / scale, columns, runs=False, numbered=numbered)
        start = np.maximum(packed(noise.variances, problem.common), problem.starts * 1e-3)
        ratio = min(ratio, fit_reml(problem, start=start, steps=30)[2] - noise.criterion)
        if ratio <= enough:
            break
    return max(0.0, float(ratio))


def noise_scale(fit: BaseFit) -> FloatArray:
    """Factor of the standard deviation of every reading, (n,), mean square 1.

    It is 1 unless the noise grows with range, or differs between channels by more than that.
    """
    bends = _bends(fit)
    count = len(fit.residual_mm)
    if bends is None:
        return np.ones(count)
    square = _square_of_range(fit)
    with_range = _range_scale(bends.power, bends.rows, square, count)
    own = _channel_factor(fit, bends, bends.power / with_range[bends.rows] ** 2)
    if not own.any():
        return with_range
    factor = _channel_factor(fit, bends, bends.power, certain=True)
    factor = np.where(factor > 0, factor, 1.0)[fit.observed.layout.channel]
    scale = factor * _range_scale(bends.power / factor[bends.rows] ** 2, bends.rows, square, count)
    return np.asarray(scale / np.sqrt(np.mean(scale**2)))


@dataclass(frozen=True)
class _Bends:
    """Squared second differences of the differences of repeats, mm^2, with variance of a reading; their middle rows."""

    power: FloatArray
    rows: IntArray


def _bends(fit: BaseFit) -> _Bends | None:
    """Second differences of the differences of repeats along a run: they hold nothing slow. None if they are few."""
    layout = fit.observed.layout
    power, middle = [], []
    for block in layout.blocks:
        first, second = _pairs(layout, block.stop)
        if len(first) < 3:
            continue
        runs = layout.run[block.stop]
        together = (runs[second[2:]] == runs[second[:-2]]) & (runs[first[2:]] == runs[first[:-2]])
        difference = fit.residual_mm[block.rows[second]] - fit.residual_mm[block.rows[first]]
        bend = (difference[2:] - 2 * difference[1:-1] + difference[:-2])[together]
        power.append((bend**2 / 12.0).ravel())
        middle.append(block.rows[second[1:-1]][together].ravel())
    if sum(map(len, power)) < LEAST_DIFFERENCES:
        return None
    return _Bends(np.concatenate(power), np.concatenate(middle))


def _square_of_range(fit: BaseFit) -> FloatArray | None:
    readings = fit.readings
    return (readings.range_mm / readings.range_mm.mean()) ** 2 if readings.kind == "lengths" else None


def _clipped(power: FloatArray) -> FloatArray:
    """Squares without the weight of gross errors; 0.455 is the median of a squared normal deviate."""
    return np.minimum(power, FAR_OUT * float(np.median(power)) / 0.455)


def _channel_factor(fit: BaseFit, bends: _Bends, power: FloatArray, *, certain: bool = False) -> FloatArray:
    """Standard deviation of every channel over that of all, (channels,); zeros if they do not differ beyond doubt."""
    channel = fit.observed.layout.channel[bends.rows]
    factor = np.zeros(int(fit.observed.layout.channel.max()) + 1)
    means, counts = np.zeros(len(factor)), np.bincount(channel, minlength=len(factor))
    for k in np.flatnonzero(counts):
        means[k] = float(_clipped(power[channel == k]).mean())
    seen = counts > 0
    middle = float(np.exp(np.average(np.log(means[seen]), weights=counts[seen])))
    u = np.sqrt(2.0 * OVERLAP / np.maximum(counts, 1))
    apart = np.abs(np.log(np.where(seen, means, middle) / middle)) / u
    if not certain and float(apart.max()) < CHANNEL_Z:
        return factor
    factor[seen] = np.sqrt(means[seen] / middle)
    return factor


def _range_scale(power: FloatArray, rows: IntArray, square: FloatArray | None, count: int) -> FloatArray:
    """Factor of the standard deviation by range, mean square 1, from a regression of squares on the squared range."""
    if square is None:
        return np.ones(count)
    against, power = square[rows], _clipped(power)
    design = np.column_stack([np.ones(len(against)), against])
    weight = np.ones(len(power))
    for _ in range(4):  # the variance of a squared normal deviate is twice the square of its mean
        coefficients = np.linalg.lstsq(design * weight[:, None], power * weight, rcond=None)[0]
        expected = np.maximum(design @ coefficients, 0.05 * power.mean())
        weight = 1.0 / expected
    inverse = np.linalg.inv((design * weight[:, None]).T @ (design * weight[:, None]))
    u = np.sqrt(inverse[1, 1] * 2.0 * OVERLAP)
    if coefficients[1] / u <= RANGE_Z:
        return np.ones(len(square))
    variance = np.maximum(coefficients[0] + coefficients[1] * square, 0.02 * power.mean())
    return np.asarray(np.sqrt(variance / variance.mean()))


def _pairs(layout: Layout, stop: IntArray) -> tuple[IntArray, IntArray]:
    """Places in a block of the first and second stop of each repeated cell, in the order of the second one in time."""
    cells = layout.cell[stop]
    order = np.lexsort((np.arange(len(cells)), cells))
    starts = np.flatnonzero(np.diff(cells[order], prepend=-1))
    counts = np.diff(np.append(starts, len(cells)))
    twice = starts[counts > 1]
    first, second = order[twice], order[twice + 1]
    by_time = np.argsort(second)
    return first[by_time], second[by_time]
