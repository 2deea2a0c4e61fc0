"""Rigid motion, figures and uncertainty of a difference, against other ways to the same numbers."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from compgen.data.comparison import (
    Difference,
    best_rotation,
    compare,
    normalized_error,
    residuals_twice,
    rigid_fields,
    sizes_of,
    small_motion,
    without_rigid_motion,
)

URAD = 1e-6
VOLUME = np.random.default_rng(1).uniform([-800.0, -1000.0, -350.0], [0.0, 0.0, 100.0], (60, 3))
TURN = np.array([0.6, -0.48, 0.64])  # of length 1


def horn(points, targets, weight):
    """The best rotation by Horn's quaternion (1987): another way than singular values."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (weight[:, None] * points).T @ targets
    matrix = np.array(
        [
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]
    )
    w, x, y, z = np.linalg.eigh(matrix)[1][:, -1]
    return Rotation.from_quat([x, y, z, w]).as_matrix()


@pytest.mark.parametrize("angle_rad", [1e-6, 1e-3, 0.7, 3.0])
def test_the_best_rotation_is_that_of_horns_quaternion(angle_rad):
    generator = np.random.default_rng(2)
    points = VOLUME - VOLUME.mean(axis=0)
    targets = Rotation.from_rotvec(angle_rad * TURN).apply(points) + generator.normal(0, 0.02, points.shape)
    weight = generator.uniform(0.2, 3.0, len(points))
    found = best_rotation(targets.T @ (weight[:, None] * points))
    assert np.allclose(found, horn(points, targets, weight), rtol=0, atol=1e-12)


def test_a_mirrored_body_is_turned_never_mirrored():
    points = VOLUME - VOLUME.mean(axis=0)
    found = best_rotation((points * [1.0, 1.0, -1.0]).T @ points)
    assert np.linalg.det(found) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("count", [1, 5])
def test_points_on_one_line_are_placed_without_a_word(count):
    position = np.outer(np.linspace(0.0, 400.0, count), [1.0, 0.0, 0.0])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rest = without_rigid_motion(position, np.tile([0.01, -0.02, 0.03], (count, 1)))
    assert np.abs(rest).max() < 1e-12


@pytest.mark.parametrize("weight", [None, np.linspace(0.1, 4.0, len(VOLUME))])
def test_the_small_motion_is_that_of_weighted_least_squares(weight):
    field = np.random.default_rng(3).normal(0, 0.01, VOLUME.shape)
    root = np.ones(field.size) if weight is None else np.repeat(np.sqrt(weight), 3)
    design = np.hstack([np.tile(np.eye(3), (len(VOLUME), 1)), np.vstack([-np.cross(np.eye(3), p).T for p in VOLUME])])
    design[:, 3:] = np.column_stack([np.cross(axis, VOLUME).ravel() for axis in np.eye(3)])
    amounts = np.linalg.lstsq(root[:, None] * design, root * field.ravel(), rcond=None)[0]
    motion = small_motion(VOLUME, weight)
    found = motion.taken_out(field)
    assert np.allclose(found.ravel(), field.ravel() - design @ amounts, rtol=0, atol=1e-13)
    assert np.allclose(motion.taken_out(field.reshape(-1, 1)).ravel(), found.ravel(), rtol=0, atol=1e-16)
    # weights on the field without the motion, and the weights that do the same on the field with it
    reading = np.random.default_rng(4).normal(size=VOLUME.shape)
    assert np.sum(reading * found) == pytest.approx(np.sum(motion.taken_out_of_weights(reading) * field), rel=1e-9)


@pytest.mark.parametrize("axis", [*np.eye(3), TURN])
def test_small_turns_are_those_of_finite_rotations(axis):
    """t + w x p is what ``Rotation`` does to a point, but for w^2 / 2 times its distance: 0.05 nm for 10 urad at 1 m."""
    centred = VOLUME - VOLUME.mean(axis=0)
    reach = np.linalg.norm(centred, axis=1).max()
    left = []
    for angle in (10 * URAD, 100 * URAD):
        moved = Rotation.from_rotvec(angle * axis).apply(centred) - centred
        to_first_order = (rigid_fields(centred) @ np.concatenate([np.zeros(3), angle * axis])).reshape(-1, 3)
        assert np.abs(moved - to_first_order).max() <= 0.5 * angle**2 * reach * (1 + 1e-3)
        left.append(np.linalg.norm(small_motion(VOLUME).taken_out(moved + [0.3, -1.2, 0.05]), axis=1).max())
        assert left[-1] <= 0.5 * angle**2 * reach
    assert left[1] == pytest.approx(100 * left[0], rel=1e-2)  # second order in the angle, so the sign is right


def test_both_ways_leave_the_same_of_small_errors():
    field = np.random.default_rng(5).normal(0, 0.01, VOLUME.shape)
    turned = field + Rotation.from_rotvec(20 * URAD * TURN).apply(VOLUME) - VOLUME
    assert np.abs(without_rigid_motion(VOLUME, turned) - small_motion(VOLUME).taken_out(turned)).max() < 1e-6


def test_points_on_one_line_lose_what_they_show():
    """A turn about the line moves none of its points; errors that only five amounts explain are taken out, no others."""
    line = np.outer(np.linspace(-300.0, 300.0, 7), [1.0, 0.0, 0.0])
    motion = small_motion(line)
    shown = rigid_fields(line) @ np.array([0.01, 0.02, -0.01, 0.0, 1e-5, -2e-5])
    bow = np.column_stack([np.zeros(7), (line[:, 0] / 300.0) ** 2 - 4.0 / 9.0, np.zeros(7)])
    assert np.abs(motion.taken_out(shown)).max() < 1e-14
    assert np.allclose(motion.taken_out(bow), bow, rtol=0, atol=1e-14)


def test_sizes_and_figures_by_hand():
    assert sizes_of(np.array([-3.0, 4.0])) == pytest.approx((4.0, 12.5**0.5, 3.95))
    shifted = np.tile([0.003, -0.004, 0.0], (len(VOLUME), 1))
    as_it_stands, removed = residuals_twice(VOLUME, shifted)
    assert (as_it_stands.max_um, as_it_stands.v_x_um) == pytest.approx((5.0, 0.0))
    assert removed.max_um < 1e-8


def test_a_difference_has_the_covariance_of_both_without_the_motion():
    generator = np.random.default_rng(6)
    first, second = ((generator.normal(size=180), generator.normal(size=(180, k))) for k in (4, 7))
    plain, freed = compare(first, second), compare(first, second, small_motion(VOLUME))
    covariance = first[1] @ first[1].T + second[1] @ second[1].T
    assert np.allclose(plain.value, first[0] - second[0])
    assert np.allclose(plain.u**2, np.diag(covariance))
    rigid = rigid_fields((VOLUME - VOLUME.mean(axis=0)) / 500.0)
    keep = np.eye(180) - rigid @ np.linalg.solve(rigid.T @ rigid, rigid.T)
    assert np.allclose(freed.value, keep @ (first[0] - second[0]))
    assert freed.noise == pytest.approx(np.trace(keep @ covariance @ keep))
    assert np.allclose(freed.u_size**2, np.diag(keep @ covariance @ keep).reshape(-1, 3).sum(axis=1))
    assert np.allclose(freed.size, np.linalg.norm(freed.value.reshape(-1, 3), axis=1))
    rows = np.array([3, 5])
    assert np.array_equal(plain.part(rows).u, plain.u[rows])


@pytest.mark.parametrize("shape", [(12, 5), (5, 12)])
def test_the_probability_of_a_sum_is_that_of_brute_force(shape):
    generator = np.random.default_rng(3)
    factor = generator.normal(size=shape) * np.geomspace(3.0, 0.1, shape[1])
    totals = np.sum((generator.normal(size=(200_000, shape[1])) @ factor.T) ** 2, axis=1)
    for share in (0.5, 0.9, 0.95, 0.99):
        value = np.zeros(shape[0])
        value[0] = np.sqrt(np.quantile(totals, share))
        assert Difference(value, factor).p_of_sum() == pytest.approx(1.0 - share, rel=0.25, abs=0.01)


def test_the_probability_of_a_pattern_is_that_of_its_covariance():
    factor = np.array([[1.0, 0.5], [0.0, 2.0]])
    value = np.array([1.5, -2.0])
    square = value @ np.linalg.solve(factor @ factor.T, value)
    assert Difference(value, factor).p_of_pattern() == pytest.approx(chi2.sf(square, 2))
    # a third value that is the sum of the others adds no information
    more = np.vstack([factor, factor.sum(axis=0)])
    assert Difference(np.append(value, value.sum()), more).p_of_pattern() == pytest.approx(chi2.sf(square, 2))


def test_what_is_known_exactly_differs_for_certain_or_not_at_all():
    exact = np.zeros((3, 0))
    same = compare((np.ones(3), exact), (np.ones(3), exact))
    assert (same.p_of_sum(), same.noise) == (1.0, 0.0)
    assert compare((np.ones(3), exact), (np.zeros(3), exact)).p_of_sum() == 0.0
    assert normalized_error(np.array([0.0, -3.0, 1.0]), np.array([0.0, 2.0, 0.0])).tolist() == [0.0, 1.5, np.inf]
