"""Whitening: columns and readings in which the noise is white with variance 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack, solve_triangular

from compgen.core.csvio import FloatArray
from compgen.diagnose.layout import Block, IntArray, Layout
from compgen.diagnose.noise import Noise, kernels, rotated, spacing_of


@dataclass(frozen=True)
class Whitener:
    """Takes columns (n, k) of all readings to (n, k) of whitened ones, block by block and channel by channel.

    ``factors`` of a block: inverse-free Cholesky factors of the covariance of the mean and of the contrasts.
    """

    layout: Layout
    scale: FloatArray
    factors: tuple[tuple[FloatArray, FloatArray], ...]

    def __call__(self, columns: FloatArray) -> FloatArray:
        """Whiten columns (n, k), or one of (n,)."""
        wide = columns if columns.ndim == 2 else columns[:, None]
        wide = wide / self.scale[:, None]
        parts = []
        for block, (mean, contrast) in zip(self.layout.blocks, self.factors, strict=True):
            turned = rotated(block, wide)
            for channel in range(block.channels):
                factor = mean if channel == 0 else contrast
                parts.append(_solved(factor, turned[channel]))
        result = np.concatenate(parts)
        return result if columns.ndim == 2 else result[:, 0]

    def order_of(self, stop: IntArray) -> IntArray:
        """Stop of every whitened row, (n,); ``stop`` is that of every reading."""
        blocks = self.layout.blocks
        return np.concatenate([np.tile(stop[block.rows[:, 0]], block.channels) for block in blocks])


def _solved(factor: FloatArray, columns: FloatArray) -> FloatArray:
    if factor.ndim == 1:
        return np.asarray(columns / factor[:, None])
    return np.asarray(solve_triangular(factor, columns, lower=True, check_finite=False))


def whitener(layout: Layout, noise: Noise) -> Whitener:
    """Return the whitening of a noise model."""
    spacing = spacing_of(layout)
    return Whitener(layout, noise.scale, tuple(_factors(layout, block, noise, spacing) for block in layout.blocks))


def _factors(layout: Layout, block: Block, noise: Noise, spacing: float) -> tuple[FloatArray, FloatArray]:
    size = len(block.stop)
    variances = noise.variances
    if variances.slow <= 0.0:
        plain = np.full(size, np.sqrt(variances.white))
        return plain, plain
    pattern = kernels(layout.time[block.stop], spacing, layout.run[block.stop], layout.in_run[block.stop])
    contrast = variances.white * np.eye(size)
    mean = np.zeros((size, size))
    for own, common, kernel in zip(variances.own, variances.common, pattern, strict=True):
        if own > 0:
            contrast += own * kernel
        if common > 0:
            mean += (block.channels if block.channels > 1 else 1) * common * kernel
    both = _factor(contrast)
    return (_factor(contrast + mean) if mean.any() else both), both


def _factor(matrix: FloatArray) -> FloatArray:
    factor, failed = lapack.dpotrf(np.asfortranarray(matrix), lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the covariance of the noise is not positive definite")
    return np.asarray(factor)
