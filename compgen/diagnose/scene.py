"""The whitened problem with the base model projected out: products of columns on which all sets of groups are compared.

Frisch-Waugh-Lovell: what the base model can do as well is invisible, so both residual and columns lose their part in
the span of the base Jacobian first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.base import BaseFit
from compgen.diagnose.groups import Group
from compgen.diagnose.layout import IntArray
from compgen.diagnose.whiten import Whitener

#: Directions of a group of which less than this share is left beside the base model are dropped.
LEAST_VISIBLE = 1e-3
#: Columns smaller than this share of the largest of their group are rounding.
ROUNDING = 1e-9
#: Columns whitened at a time.
CHUNK = 400


@dataclass(frozen=True)
class Scene:
    """Groups in orthonormal coordinates of what is visible of them; K coordinates in all.

    Parameters
    ----------
    groups : the groups.
    start : first coordinate of each group, (groups + 1,).
    maps : matrix (k, k_visible) of each group from its coordinates to the parameters of its columns.
    score : products with the residual, (K,).
    visible : share of each group that is left beside the base model (RMS over its columns), (groups,).
    residual : whitened residual without its part in the base model, (N,).
    base : orthonormal columns of the whitened base model, (N, p).
    directions : the coordinates as whitened columns, (N, K).
    whiten : the whitening.
    fit : the base fit.
    """

    groups: tuple[Group, ...]
    start: IntArray
    maps: tuple[FloatArray, ...]
    score: FloatArray
    visible: FloatArray
    residual: FloatArray
    base: FloatArray
    directions: FloatArray
    whiten: Whitener
    fit: BaseFit
    _rows: dict[int, FloatArray] = field(default_factory=dict)

    def rows(self, members: Sequence[int]) -> FloatArray:
        """Products of the coordinates of ``members`` with all coordinates, (r, K), computed when first asked for."""
        for g in members:
            if g not in self._rows:
                self._rows[g] = self.directions[:, self.place(g)].T @ self.directions
        return np.vstack([self._rows[g] for g in members]) if members else np.zeros((0, len(self.score)))

    @property
    def total(self) -> float:
        """Residual sum of squares of the base model, whitened."""
        return float(self.residual @ self.residual)

    @property
    def count(self) -> int:
        """Number of readings."""
        return len(self.residual)

    @property
    def freedom(self) -> int:
        """Readings less unknowns of the base model."""
        return self.count - int(self.base.shape[1])

    def size(self, group: int) -> int:
        """Visible dimensions of a group."""
        return int(self.start[group + 1] - self.start[group])

    def place(self, group: int) -> slice:
        """Coordinates of a group."""
        return slice(int(self.start[group]), int(self.start[group + 1]))

    def coordinates(self, members: Sequence[int]) -> IntArray:
        """Coordinates of several groups."""
        parts = [np.arange(self.start[g], self.start[g + 1]) for g in members]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)

    def projected(self, columns: FloatArray) -> FloatArray:
        """Whiten columns (n, k) and take out the base model."""
        white = self.whiten(columns)
        return np.asarray(white - self.base @ (self.base.T @ white))


def orthonormal(columns: FloatArray, least: float = 1e-9) -> FloatArray:
    """Orthonormal basis of the span of columns (n, p)."""
    norm = np.linalg.norm(columns, axis=0)
    kept = norm > 0
    q, r = np.linalg.qr(columns[:, kept] / norm[kept])
    u, singular, _ = np.linalg.svd(r, full_matrices=False)
    return np.asarray(q @ u[:, singular > least * singular[0]])


def scene_of(fit: BaseFit, groups: Sequence[Group], whiten: Whitener) -> Scene:
    """Whiten, project and reduce all groups."""
    base = orthonormal(whiten(fit.jacobian))
    white = whiten(fit.residual_mm)
    residual = white - base @ (base.T @ white)
    directions, maps, visible = [], [], []
    for part in _chunks(groups):
        raw = [_centred(fit, group.columns) for group in part]
        sizes = np.cumsum([0, *(columns.shape[1] for columns in raw)])
        tall = whiten(np.hstack(raw))
        left = tall - base @ (base.T @ tall)
        for k in range(len(part)):
            place = slice(sizes[k], sizes[k + 1])
            basis, mapping, share = _reduced(tall[:, place], left[:, place])
            directions.append(basis)
            maps.append(mapping)
            visible.append(share)
    stacked = np.hstack(directions) if directions else np.zeros((len(residual), 0))
    start = np.cumsum([0, *(basis.shape[1] for basis in directions)]).astype(np.int64)
    return Scene(
        tuple(groups),
        start,
        tuple(maps),
        stacked.T @ residual,
        np.array(visible),
        residual,
        base,
        stacked,
        whiten,
        fit,
    )


def _centred(fit: BaseFit, columns: FloatArray) -> FloatArray:
    """Columns without their mean at every channel: a dead length takes it anyhow."""
    channel = fit.observed.layout.channel
    count = np.bincount(channel).astype(np.float64)
    result = columns.copy()
    for k in range(columns.shape[1]):
        result[:, k] -= (np.bincount(channel, columns[:, k]) / count)[channel]
    return result


def _chunks(groups: Sequence[Group]) -> list[list[Group]]:
    parts: list[list[Group]] = []
    width = CHUNK
    for group in groups:
        if width + group.columns.shape[1] > CHUNK:
            parts.append([])
            width = 0
        parts[-1].append(group)
        width += group.columns.shape[1]
    return parts


def _reduced(raw: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Orthonormal visible directions (N, m), their map to the parameters (k, m), and the visible share.

    The raw columns are first made orthonormal, so that the singular values of what is left are shares.
    """
    if raw.shape[1] == 1:
        return _single(raw, left)
    norm = np.linalg.norm(raw, axis=0)
    present = norm > ROUNDING * norm.max()
    norm = np.where(present, norm, np.inf)
    square, vectors = np.linalg.eigh((raw / norm).T @ (raw / norm))
    kept = square > 1e-8 * max(square[-1], 1e-300)
    turn = vectors[:, kept] / np.sqrt(square[kept]) / norm[:, None]
    if not kept.any() or not np.any(raw):
        return np.zeros((len(raw), 0)), np.zeros((raw.shape[1], 0)), 0.0
    seen = left @ turn
    share2, axes = np.linalg.eigh(seen.T @ seen)
    visible = share2 > LEAST_VISIBLE**2
    mapping = turn @ (axes[:, visible] / np.sqrt(share2[visible]))
    share = np.sum((left / norm) ** 2) / max(float(np.sum((raw / norm) ** 2)), 1e-300)
    return left @ mapping, mapping, float(np.sqrt(share))


def _single(raw: FloatArray, left: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """The same for one column."""
    whole, seen = float(np.linalg.norm(raw)), float(np.linalg.norm(left))
    share = seen / whole if whole > 0.0 else 0.0
    if share <= LEAST_VISIBLE:
        return np.zeros((len(raw), 0)), np.zeros((1, 0)), share
    return left / seen, np.array([[1.0 / seen]]), share
