"""How rich the base model is: smooth curves first; steeper ones and nodes stand in the search like everything else.

Nodes could take up an effect that repeats along an axis, and what a named effect explains with few parameters is not
for the machine's errors. So the wider curves of an axis are one group of the search, charged for every column, and the
base model is fitted with them only if they win there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.diagnose.base import BaseFit, error_columns, fit_base
from compgen.diagnose.basis import CurveBasis, first_basis, size_of, wider_bases
from compgen.diagnose.groups import Group
from compgen.diagnose.observed import Observed

#: Directions of new columns of which less than this (squared) is left beside the old ones say nothing.
LEAST_SQUARE = 1e-6
#: Standard deviations of a chi-square beyond its mean that wider curves must explain to be looked at more closely.
CHANCE = 4.0


@dataclass(frozen=True)
class Wider:
    """A wider basis of one axis that the readings ask for, and what it adds as a group of the search."""

    axis: int
    basis: CurveBasis
    group: Group


def fit_smooth(observed: Observed) -> BaseFit:
    """Fit the smooth base model."""
    poses = observed.poses
    basis = first_basis(observed.machine, poses.position_mm, len(observed), len(poses.position_mm))
    return fit_base(observed, basis)


def wider_of(fit: BaseFit) -> tuple[Wider, ...]:
    """Return for every axis the wider basis with the largest evidence, if one explains more than chance: a first look."""
    found: list[Wider] = []
    for axis in range(3 if fit.basis.errors else 0):
        best, least = None, -np.inf
        for basis in wider_bases(fit.basis, axis, fit.observed.poses.position_mm, len(fit.observed)):
            columns = _columns(fit, basis)
            gain, added = _gain(fit, columns)
            evidence = gain - added * (1.0 + np.log(max(gain / max(added, 1), 1.0)))
            if added and gain > added + CHANCE * np.sqrt(2.0 * added) and evidence > least:
                best, least = (basis, columns), evidence
        if best is not None:
            found.append(Wider(axis, best[0], Group(f"wider curves of {AXES[axis]}", "base", best[1])))
    return tuple(found)


def widened(fit: BaseFit, taken: Sequence[Wider]) -> BaseFit:
    """Fit the base model again with the wider bases ``taken``."""
    basis = fit.basis
    for item in taken:
        basis = basis.with_axis(item.axis, item.basis)
    return fit_base(fit.observed, basis, start=_extended(fit, basis))


def _columns(fit: BaseFit, wider: CurveBasis) -> FloatArray:
    """Derivative of the readings by the curves of a wider basis, at the present fit."""
    return error_columns(fit.observed, wider, _extended(fit, wider))


def _gain(fit: BaseFit, extra: FloatArray) -> tuple[float, int]:
    """chi-square that columns gain beside the base model, in its residual variance, and how many are new."""
    extra = extra / np.maximum(np.linalg.norm(extra, axis=0), 1e-300)
    q = np.linalg.qr(fit.jacobian / np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300))[0]
    left = extra - q @ (q.T @ extra)
    left -= q @ (q.T @ left)
    square, vectors = np.linalg.eigh(left.T @ left)
    kept = square > LEAST_SQUARE
    new = left @ (vectors[:, kept] / np.sqrt(square[kept]))
    explained = float(np.sum((new.T @ fit.residual_mm) ** 2))
    freedom = len(fit.observed) - fit.jacobian.shape[1] - new.shape[1]
    left_over = float(np.sum(fit.residual_mm**2)) - explained
    return explained / max(left_over / max(freedom, 1), 1e-300), new.shape[1]


def _extended(fit: BaseFit, wider: CurveBasis) -> FloatArray:
    """Start values for a wider basis: the present ones, zero for what is new."""
    position_mm = fit.observed.poses.position_mm[:1]
    old, new = fit.basis.parts(position_mm), wider.parts(position_mm)
    values = np.zeros(size_of(new))
    for before, after in zip(old, new, strict=True):
        count = before.basis.shape[1]
        values[after.place.start : after.place.start + count] = fit.unknowns[before.place]
    return np.concatenate([values, fit.unknowns[size_of(old) :]])
