"""From the tracers' frame into the machine's (Zha & Zhang 2024, eq. 20), in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import UndeterminedError
from compgen.model.rotation import cross_matrices

#: A mirror image is believed when it fits this much better than the proper placement.
MIRROR_RATIO = 0.5


@dataclass(frozen=True)
class Placement:
    """Rigid motion x -> R x + t from one frame into another, with what it leaves.

    Parameters
    ----------
    rotation, translation_mm : R (3, 3), a rotation, never a reflection, and t (3,).
    rms_mm : weighted root mean square distance that is left.
    mirrored : the points fit only as their mirror image: the frame they come from is left-handed.
    """

    rotation: FloatArray
    translation_mm: FloatArray
    rms_mm: float
    mirrored: bool

    def apply(self, points_mm: FloatArray) -> FloatArray:
        """Return points (n, 3) in the other frame."""
        return points_mm @ self.rotation.T + self.translation_mm


def place(
    points_mm: FloatArray, target_mm: FloatArray, weight: FloatArray | None = None, anchor: int | None = None
) -> Placement:
    """Return the rigid motion that brings points (n, 3) closest to targets (n, 3): eq. 20 by singular values.

    Parameters
    ----------
    points_mm, target_mm : corresponding points in the two frames.
    weight : of each point, (n,); default 1.
    anchor : index of a point that is brought onto its target exactly (the paper's machine origin); default none: the
        weighted centroids are brought together, which is the minimum.

    Raises
    ------
    UndeterminedError
        if the points lie on one line.
    """
    w = np.ones(len(points_mm)) if weight is None else weight / weight.mean()
    share = w / w.sum() if anchor is None else (np.arange(len(w)) == anchor).astype(np.float64)
    here, there = share @ points_mm, share @ target_mm
    left, size, right = np.linalg.svd((target_mm - there).T @ (w[:, None] * (points_mm - here)))
    if size[1] <= 1e-12 * size[0]:
        raise UndeterminedError("the points lie on one line; nothing tells how the frame is turned about it", [])
    hand = 1.0 if np.linalg.det(left @ right) > 0 else -1.0
    proper = _rotated(left, right, hand, points_mm - here, target_mm - there, w)
    image = _rotated(left, right, -hand, points_mm - here, target_mm - there, w)
    rotation, rms = proper
    return Placement(rotation, there - rotation @ here, rms, image[1] < MIRROR_RATIO * rms)


def _rotated(
    left: FloatArray, right: FloatArray, hand: float, points: FloatArray, targets: FloatArray, weight: FloatArray
) -> tuple[FloatArray, float]:
    rotation = left @ np.diag([1.0, 1.0, hand]) @ right
    rest = points @ rotation.T - targets
    return rotation, float(np.sqrt(np.average(np.sum(rest**2, axis=1), weights=weight)))


def placed_covariance(
    own: FloatArray, lever: FloatArray, shared: FloatArray, points_mm: FloatArray, weight: FloatArray
) -> FloatArray:
    """Covariance of each point against the best-fit placement of all of them, (n, 3, 3), mm^2.

    Parameters
    ----------
    own : covariance of each point by itself, (n, 3, 3).
    lever, shared : (n, 3, q) and (q, q); the points share the part lever shared lever^T.
    points_mm, weight : as for :func:`place`, the points in the final frame.
    """
    w = weight / weight.mean()
    share = w / w.sum()
    arms = cross_matrices(points_mm - share @ points_mm)
    rigid = np.concatenate([np.broadcast_to(np.eye(3), own.shape), -arms], axis=2)  # movement by (shift, turn)
    moment = np.einsum("n,nji,njk->ik", w, arms, arms)
    turning = np.linalg.solve(moment, w[:, None, None] * arms)
    taken = np.concatenate(
        [share[:, None, None] * np.eye(3), turning], axis=1
    )  # (shift, turn) by each point, (n, 6, 3)
    own_part = taken @ own  # (n, 6, 3)
    total = np.einsum("nij,nkj->ik", own_part, taken)
    cross = rigid @ own_part
    rest = lever - rigid @ np.einsum("nij,njq->iq", taken, lever)
    placed = own - cross - cross.transpose(0, 2, 1) + rigid @ total @ rigid.transpose(0, 2, 1)
    return np.asarray(placed + rest @ shared @ rest.transpose(0, 2, 1))
