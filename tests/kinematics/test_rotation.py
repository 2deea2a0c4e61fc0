"""The small rotation against scipy's, from rounding to a quarter of a turn, in every form that it has."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compgen.kinematics.exact_chain import (
    cross_matrices,
    level_rotations,
    rotate,
    rotation_derivative,
    rotation_factors,
)

SIZES = [0.0, 1e-12, 1e-6, 1e-3, 0.00999, 0.01, 0.01001, 0.1, 1.5]


def vectors_of(size):
    """Rotation vectors of one length (20, 3), with vectors to turn (20, 3)."""
    rng = np.random.default_rng(0)
    eps = rng.normal(size=(20, 3))
    return size * eps / np.linalg.norm(eps, axis=1)[:, None], rng.normal(size=(20, 3))


@pytest.mark.parametrize("size", SIZES)
def test_vectors_columns_and_matrices_are_turned_alike_and_as_by_scipy(size):
    eps, v = vectors_of(size)
    turn = Rotation.from_rotvec(eps)
    assert rotate(eps, v) == pytest.approx(turn.apply(v), abs=3e-16 * 10)
    assert rotate(eps, np.stack([v, -2 * v], axis=2))[:, :, 1] == pytest.approx(-2 * turn.apply(v), abs=1e-14)
    assert level_rotations(eps)[0] == pytest.approx(turn.as_matrix(), abs=3e-15)
    first, second = rotation_factors(np.full(3, size**2))
    if size:  # sin a = 2 sin(a/2) cos(a/2) and 1 - cos a = 2 sin^2(a/2), good for every angle
        assert first == pytest.approx(2 * np.sin(size / 2) * np.cos(size / 2) / size, rel=4e-16)
        assert second == pytest.approx(2 * (np.sin(size / 2) / size) ** 2, rel=4e-16)


@pytest.mark.parametrize("size", SIZES)
def test_the_left_jacobian_is_the_mean_of_the_rotations_on_the_way(size):
    eps, _ = vectors_of(size)
    place, weight = np.polynomial.legendre.leggauss(12)
    mean = sum(
        0.5 * w * Rotation.from_rotvec(0.5 * (p + 1) * eps).as_matrix() for p, w in zip(place, weight, strict=True)
    )
    assert level_rotations(eps)[1] == pytest.approx(mean, abs=1e-14)


@pytest.mark.parametrize("size", SIZES)
def test_the_derivative_is_that_of_turned_vectors(size):
    eps, v = vectors_of(size)
    found = rotation_derivative(eps, rotate(eps, v))
    step = 1e-5
    for k in range(3):
        there, back = eps + step * np.eye(3)[k], eps - step * np.eye(3)[k]
        slope = (Rotation.from_rotvec(there).apply(v) - Rotation.from_rotvec(back).apply(v)) / (2 * step)
        assert found[:, :, k] == pytest.approx(slope, abs=1e-9)


def test_small_and_large_angles_together_are_what_each_is_alone():
    eps = np.concatenate([vectors_of(size)[0] for size in SIZES])
    v = np.concatenate([vectors_of(size)[1] for size in SIZES])
    alone = np.concatenate([rotate(vectors_of(size)[0], vectors_of(size)[1]) for size in SIZES])
    assert np.array_equal(rotate(eps, v), alone)
    assert cross_matrices(eps) @ v[:, :, None] == pytest.approx(np.cross(eps, v)[:, :, None], abs=1e-15)


@pytest.mark.parametrize("size", SIZES)
def test_the_compiled_form_is_the_plain_one(size):
    pytest.importorskip("numba")
    from compgen.kinematics.compiled_kernels import level_rotation

    eps, _ = vectors_of(size)
    rotation, jacobian = level_rotations(eps)
    found, slope = np.empty((3, 3)), np.empty((3, 3))
    for k, vector in enumerate(eps):
        level_rotation(vector, found, slope)
        assert found == pytest.approx(rotation[k], abs=2e-15)
        assert slope == pytest.approx(jacobian[k], abs=2e-15)
