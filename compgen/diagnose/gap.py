"""Does the gap shrink: residuals before and after, on the readings used and on lines, stations and times left out.

Plain least squares on all but the part left out; columns that vanish on the rest (a dead length, a station) are fitted
to the part itself, since nothing else can know them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.diagnose.base import BaseFit
from compgen.diagnose.layout import IntArray
from compgen.diagnose.noise import Noise, difference_matrix

FOLDS = 5
#: Stations that must be left for the others to determine the errors.
LEAST_STATIONS = 3
#: Eigenvalues of the scaled normal matrix below this hold no information.
LEAST_EIGENVALUE = 1e-9


@dataclass(frozen=True)
class BeforeAfter:
    """RMS of the residuals without and with what was added, mm."""

    before_mm: float
    after_mm: float

    def to_dict(self) -> dict[str, float]:
        """Values in um, as in ``diagnosis.json``."""
        return {"before_rms_um": self.before_mm / MM_PER_UM, "after_rms_um": self.after_mm / MM_PER_UM}

    @property
    def shrinks(self) -> bool:
        """Whether what was added makes the residual smaller."""
        return self.after_mm < self.before_mm


@dataclass(frozen=True)
class Gap:
    """The gap on the readings used and on parts left out; None where that is not possible."""

    train: BeforeAfter
    lines: BeforeAfter | None
    stations: BeforeAfter | None
    times: BeforeAfter | None
    floor_mm: float
    floor_source: str
    residual_before_mm: FloatArray
    residual_after_mm: FloatArray


def gap_of(
    fit: BaseFit,
    added: Sequence[FloatArray],
    predicting: Sequence[FloatArray],
    noise: Noise,
    base: Sequence[FloatArray] = (),
) -> Gap:
    """Compute the gap.

    Parameters
    ----------
    fit : the base fit.
    added : columns (n, k) of everything that was added.
    predicting : those of them that say something about readings that were left out.
    noise : the noise model.
    base : columns that belong to the base model beside those of its fit: they are there before and after.
    """
    count = len(fit.residual_mm)
    columns = np.hstack([fit.jacobian[:, : fit.base_size], *base])
    weight = 1.0 / noise.scale
    everything = _Problem(columns, _hstack(added, count), fit.residual_mm, weight)
    before, after = everything.fitted(False), everything.fitted(True)
    some = _Problem(columns, _hstack(predicting, count), fit.residual_mm, weight)
    layout = fit.observed.layout
    lines = _line_folds(layout.condition[layout.stop])
    stations = layout.channel if _stations_left(fit) else None
    return Gap(
        _rms_pair(before, after),
        some.left_out(lines),
        None if stations is None else some.left_out(stations),
        some.left_out(_time_folds(fit)),
        _floor(fit, after, noise),
        noise.source,
        before,
        after,
    )


def _hstack(columns: Sequence[FloatArray], count: int) -> FloatArray:
    return np.hstack(columns) if columns else np.zeros((count, 0))


def _stations_left(fit: BaseFit) -> bool:
    return len(fit.readings.stations) > LEAST_STATIONS


def _line_folds(condition: IntArray) -> IntArray | None:
    """Fold of every reading: whole conditions, so that both repeats of a line are left out together."""
    kinds = int(condition.max()) + 1
    if kinds < 2 * FOLDS:
        return None
    order = np.random.default_rng(0).permutation(kinds)
    return np.asarray((order % FOLDS)[condition], dtype=np.int64)


def _time_folds(fit: BaseFit) -> IntArray | None:
    """Fold of every reading: time blocks of the file, else quarters of the time."""
    block = fit.readings.labels.get("block")
    if block is not None and len(np.unique(block)) > 2:
        return np.unique(block, return_inverse=True)[1].ravel().astype(np.int64)
    layout = fit.observed.layout
    if layout.stops < 8:
        return None
    if fit.readings.kind == "axis":
        return (layout.run[layout.stop] % 4).astype(np.int64)
    return np.minimum(layout.stop * 4 // layout.stops, 3).astype(np.int64)


def _rms_pair(before: FloatArray, after: FloatArray) -> BeforeAfter:
    return BeforeAfter(float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2))))


def _floor(fit: BaseFit, after: FloatArray, noise: Noise) -> float:
    """RMS that the repeats alone leave, else the standard deviation of the noise model."""
    if noise.source != "repeats":
        return float(np.sqrt(noise.variances.total))
    layout = fit.observed.layout
    squares, count = 0.0, 0
    for block in layout.blocks:
        matrix = difference_matrix(layout, block)
        values = matrix @ after[block.rows]
        squares += float(np.sum(values**2))
        count += values.size
    return float(np.sqrt(squares / max(count, 1)))


class _Problem:
    """Linear least squares with base columns and added ones, through one normal matrix."""

    def __init__(self, base: FloatArray, added: FloatArray, residual: FloatArray, weight: FloatArray) -> None:
        self.base = base.shape[1]
        columns = np.hstack([base, added])
        self.norm = np.linalg.norm(columns, axis=0)
        self.columns = columns / np.maximum(self.norm, 1e-300)
        self.residual, self.weight = residual, weight
        self._weighted = self.columns * weight[:, None]
        self._target = residual * weight
        self.normal, self.right = self._weighted.T @ self._weighted, self._weighted.T @ self._target

    def _sizes(self, added: bool) -> int:
        return int(self.columns.shape[1]) if added else self.base

    def fitted(self, added: bool) -> FloatArray:
        """Residuals after a fit to everything, (n,)."""
        k = self._sizes(added)
        return np.asarray(self.residual - self.columns[:, :k] @ _solve(self.normal[:k, :k], self.right[:k]))

    def left_out(self, fold: IntArray | None) -> BeforeAfter | None:
        """RMS over all folds, each predicted from the others; None without folds."""
        if fold is None or len(np.unique(fold)) < 2:
            return None
        before, after = np.empty_like(self.residual), np.empty_like(self.residual)
        for k in np.unique(fold):
            rows = np.flatnonzero(fold == k)
            before[rows], after[rows] = self._predicted(rows, False), self._predicted(rows, True)
        return _rms_pair(before, after)

    def _predicted(self, rows: IntArray, added: bool) -> FloatArray:
        k = self._sizes(added)
        own = self._weighted[rows][:, :k]
        square = own.T @ own
        normal = self.normal[:k, :k] - square
        right = self.right[:k] - own.T @ self._target[rows]
        unseen = np.diag(normal) < 1e-9 * np.maximum(np.diag(self.normal)[:k], 1e-300)
        known = ~unseen
        solution = np.zeros(k)
        solution[known] = _solve(normal[np.ix_(known, known)], right[known])
        left = self.residual[rows] - self.columns[rows][:, :k] @ solution
        if unseen.any():
            part = own[:, unseen]
            left = left - self.columns[rows][:, :k][:, unseen] @ _solve(
                part.T @ part, part.T @ (left * self.weight[rows])
            )
        return np.asarray(left)


def _solve(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of normal equations without directions that hold no information."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    square, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    kept = square > LEAST_EIGENVALUE * max(float(square[-1]), 1e-300)
    turned = vectors[:, kept].T @ (right / scale)
    return np.asarray((vectors[:, kept] @ (turned / square[kept])) / scale)
