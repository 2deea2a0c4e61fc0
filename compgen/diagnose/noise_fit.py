"""From a base fit to its noise model: dependence on range, then the variances of the kernels."""

from __future__ import annotations

from collections.abc import Sequence

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
    scale = before.scale if before is not None else range_scale(fit)
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


def run_ratio(fit: BaseFit, fixed: Sequence[Group], noise: Noise) -> float:
    """Likelihood ratio of the parts that change from run to run; 0 where they are too small to matter."""
    runs = float(noise.variances.own[-2:].sum() + noise.variances.common[-2:].sum())
    if noise.source != "repeats" or runs <= LEAST_RUN_SHARE * noise.variances.white:
        return 0.0
    scale = noise.scale
    columns = _unit_columns(fixed, len(scale)) / scale[:, None]
    problem = reml_problem(fit.observed.layout, fit.residual_mm / scale, columns, runs=False)
    start = np.maximum(packed(noise.variances, problem.common), problem.starts * 1e-3)
    return max(0.0, fit_reml(problem, start=start, steps=30)[2] - noise.criterion)


def range_scale(fit: BaseFit) -> FloatArray:
    """Factor of the standard deviation of every reading, (n,), mean square 1: 1 unless the noise grows with range.

    Second differences of the differences of repeats along a run hold nothing slow; a regression of their squares on
    the square of the range tells.
    """
    readings, layout = fit.readings, fit.observed.layout
    ones = np.ones(len(readings))
    if readings.kind != "lengths":
        return ones
    square = (readings.range_mm / readings.range_mm.mean()) ** 2
    power, against = [], []
    for block in layout.blocks:
        first, second = _pairs(layout, block.stop)
        if len(first) < 3:
            continue
        runs = layout.run[block.stop]
        together = (runs[second[2:]] == runs[second[:-2]]) & (runs[first[2:]] == runs[first[:-2]])
        difference = fit.residual_mm[block.rows[second]] - fit.residual_mm[block.rows[first]]
        bend = (difference[2:] - 2 * difference[1:-1] + difference[:-2])[together]
        power.append((bend**2 / 12.0).ravel())
        against.append(square[block.rows[second[1:-1]]][together].ravel())
    if not power or sum(map(len, power)) < LEAST_DIFFERENCES:
        return ones
    return _scale_from(np.concatenate(power), np.concatenate(against), square)


def _scale_from(power: FloatArray, against: FloatArray, square: FloatArray) -> FloatArray:
    design = np.column_stack([np.ones(len(against)), against])
    power = np.minimum(power, FAR_OUT * float(np.median(power)) / 0.455)  # 0.455: median of a squared normal deviate
    weight = np.ones(len(power))
    for _ in range(4):  # the variance of a squared normal deviate is twice the square of its mean
        coefficients = np.linalg.lstsq(design * weight[:, None], power * weight, rcond=None)[0]
        expected = np.maximum(design @ coefficients, 0.05 * power.mean())
        weight = 1.0 / expected
    inverse = np.linalg.inv((design * weight[:, None]).T @ (design * weight[:, None]))
    # neighbouring second differences overlap, which widens the scatter by the sum of their squared correlations
    u = np.sqrt(inverse[1, 1] * 2.0 * (1 + 2 * (4 / 6) ** 2 + 2 * (1 / 6) ** 2))
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
