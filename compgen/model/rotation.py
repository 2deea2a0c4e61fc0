"""The small rotation: R(eps) of a rotation vector eps in rad, and its derivative. The one place of these formulas.

With a = |eps| and [eps]x the matrix of the cross product (Rodrigues; Chirikjian 2011, Stochastic Models 2, section 10.6)

    R   = 1 + f1 [eps]x + f2 [eps]x^2,   f1 = sin(a)/a,         f2 = (1 - cos(a))/a^2
    J_l = 1 + f2 [eps]x + f3 [eps]x^2,   f3 = (a - sin(a))/a^3, R(eps + d) = R(J_l d) R(eps) to first order in d

Kernels take f1 and f2 from the same series (``rotation_factors`` of :mod:`compgen.model.compiled`).
"""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray

#: rad^2; below, the next terms of the series are less than 1e-21 (f1, f2) and 1e-16 (f3) of the result.
SERIES_BELOW = 1e-4


def rotation_factors(square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """f1 and f2 for the squares of angles (n,) in rad^2, without loss of digits for small angles."""
    first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
    second = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    large = square >= SERIES_BELOW
    if large.any():
        angle = np.sqrt(square[large])
        first[large] = np.sin(angle) / angle
        second[large] = 2.0 * (np.sin(0.5 * angle) / angle) ** 2
    return first, second


def rotate(eps_rad: FloatArray, vectors: FloatArray) -> FloatArray:
    """Turn vectors (n, 3), or every column of (n, 3, k), by rotation vectors (n, 3)."""
    first, second = rotation_factors(np.einsum("ij,ij->i", eps_rad, eps_rad))
    if vectors.ndim == 3:
        eps_rad = eps_rad[:, :, None]
    shape = (-1, *(1,) * (vectors.ndim - 1))
    once = np.cross(eps_rad, vectors, axis=1)
    return np.asarray(vectors + first.reshape(shape) * once + second.reshape(shape) * np.cross(eps_rad, once, axis=1))


def level_rotations(eps_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation matrices R and left Jacobians J_l, each (n, 3, 3), of rotation vectors (n, 3)."""
    square = np.einsum("ij,ij->i", eps_rad, eps_rad)
    first, second = rotation_factors(square)
    third = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
    large = square >= SERIES_BELOW
    third[large] = (1.0 - first[large]) / square[large]
    cross = cross_matrices(eps_rad)
    twice = cross @ cross
    identity = np.eye(3)
    rotation = identity + first[:, None, None] * cross + second[:, None, None] * twice
    return rotation, identity + second[:, None, None] * cross + third[:, None, None] * twice


def rotation_derivative(eps_rad: FloatArray, turned: FloatArray) -> FloatArray:
    """d(R(eps) v)/d eps = -[R v]x J_l(eps), shape (n, 3, 3); ``turned`` (n, 3) is R v."""
    return -np.cross(turned[:, :, None], level_rotations(eps_rad)[1], axis=1)


def cross_matrices(vectors: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) of the cross product with vectors (n, 3) from the left."""
    matrices = np.zeros((len(vectors), 3, 3))
    matrices[:, 2, 1], matrices[:, 0, 2], matrices[:, 1, 0] = vectors.T
    matrices[:, 1, 2], matrices[:, 2, 0], matrices[:, 0, 1] = -vectors.T
    return matrices
