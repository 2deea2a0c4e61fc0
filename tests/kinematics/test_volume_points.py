"""Points that fill the working volume: levels, grids that are thinned, integrals that are exact."""

import numpy as np
import pytest

from compgen.data.machine import Emphasis
from compgen.kinematics.many_points import levels_between, volume_grid, volume_sample
from tests.machines import machine_of

RANGES = ((-300.0, 500.0), (-150.0, 250.0), (0.0, 80.0))
MACHINE = machine_of(RANGES, 5)


def nodes_of(*counts):
    return tuple(np.linspace(*travel, count) for travel, count in zip(RANGES, counts, strict=True))


def inner_of(sample):
    """Points that have a weight."""
    return sample.position_mm[sample.weight > 0.0]


def mean_of(sample, values):
    return float(sample.weight @ values / sample.weight.sum())


@pytest.mark.parametrize(
    "nodes",
    [[4.0], [-10.0, 0.0, 4.0, 10.0, 20.0], [1e-10, 4.0, 10.0 - 1e-10], [-1e-10, 4.0, 10.0 + 1e-10]],
)
def test_levels_are_the_nodes_within_the_travel_its_ends_and_the_middles(nodes):
    assert levels_between(np.array(nodes), 0.0, 10.0).tolist() == [0.0, 2.0, 4.0, 7.0, 10.0]


def test_a_grid_has_its_points_in_the_order_of_its_shape_and_keeps_its_corners_when_thinned():
    nodes = nodes_of(5, 4, 3)
    grid = volume_grid(MACHINE, nodes)
    assert grid.shape == (9, 7, 5)
    points = grid.position_mm.reshape(9, 7, 5, 3)
    assert points[2, 3, 4] == pytest.approx([-100.0, 50.0, 80.0])
    assert volume_grid(MACHINE, nodes, 315).shape == (9, 7, 5)
    thin = volume_grid(MACHINE, nodes, 314)
    assert thin.shape == (7, 7, 5)  # four fifths of the longest
    for levels, (low, high) in zip(thin.levels_mm, RANGES, strict=True):
        assert (levels[0], levels[-1]) == (low, high)
    assert set(thin.levels_mm[0]) < set(grid.levels_mm[0])


@pytest.mark.parametrize(("nodes", "points"), [(2, 20), (3, 20), (4, 24), (11, 20), (12, 22)])
def test_an_axis_has_two_points_for_each_of_at_least_ten_intervals(nodes, points):
    sample = volume_sample(MACHINE, nodes_of(nodes, 2, 2), 10**6)
    assert [len(np.unique(inner_of(sample)[:, axis])) for axis in range(3)] == [points, 20, 20]
    assert len(inner_of(sample)) == points * 400


@pytest.mark.parametrize(("most", "points"), [(8000, 8000), (7999, 4000), (4000, 4000)])
def test_a_sample_that_is_too_large_is_halved_evenly(most, points):
    sample = volume_sample(MACHINE, nodes_of(11, 11, 11), most)
    assert len(inner_of(sample)) == points
    for axis in range(3):
        counts = np.unique(inner_of(sample)[:, axis], return_counts=True)[1]
        assert counts.tolist() == [points // 20] * 20


@pytest.mark.parametrize("most", [3999, 2880])
def test_a_third_of_the_points_is_no_more_than_was_asked_for(most):
    assert 8000 // 3 <= len(inner_of(volume_sample(MACHINE, nodes_of(11, 11, 11), most))) <= 8000 // 3 + 1


@pytest.mark.parametrize(("most", "across"), [(4000, 4), (10_000, 5), (57_599, 11)])
def test_tables_with_many_nodes_get_three_grids(most, across):
    """400 points of the own axis by the root of most / 400 of the others, 4 at least."""
    sample = volume_sample(MACHINE, nodes_of(201, 201, 201), most)
    assert len(inner_of(sample)) == 3 * 400 * across**2


@pytest.mark.parametrize(("counts", "most"), [((3, 7, 2), 10**6), ((201, 201, 201), 4000)])
def test_what_tables_hold_is_integrated_exactly(counts, most):
    """Means over the box by hand: cubes, a product, and bends at nodes, where a hat function of a table has its own."""
    nodes = nodes_of(*counts)
    sample = volume_sample(MACHINE, nodes, most)
    assert sample.weight.mean() == pytest.approx(1.0)
    for axis, (low, high) in enumerate(RANGES):
        along = sample.position_mm[:, axis]
        cube = (high**4 - low**4) / 4.0 / (high - low)
        assert mean_of(sample, along**3) == pytest.approx(cube, rel=1e-9)
        node = nodes[axis][1]
        if counts[0] == 3:  # three grids hold a bend on average over the grid of its own axis only
            bent = ((node - low) ** 2 + (high - node) ** 2) / 2.0 / (high - low)
            assert mean_of(sample, np.abs(along - node)) == pytest.approx(bent, rel=1e-9)
    x, y, _ = sample.position_mm.T
    assert mean_of(sample, x * y) == pytest.approx(100.0 * 50.0, rel=1e-9)


@pytest.mark.parametrize(("counts", "most"), [((11, 11, 11), 10**6), ((201, 201, 201), 4000)])
def test_a_work_zone_counts_as_often_as_it_is_told(counts, most):
    """X from 0 to 100 mm four times: 400 of 400 + 700, and the mean of x over both parts."""
    zone = Emphasis(((0.0, 100.0), None, None), 4.0)
    sample = volume_sample(MACHINE, nodes_of(*counts), most, zone)
    x = sample.position_mm[:, 0]
    assert mean_of(sample, ((x > 0.0) & (x < 100.0)).astype(float)) == pytest.approx(400.0 / 1100.0)
    assert mean_of(sample, x) == pytest.approx((300.0 * -150.0 + 400.0 * 50.0 + 400.0 * 300.0) / 1100.0)


def test_lines_through_corners_and_middles_follow_without_weight():
    nodes = (np.array([-400.0, 123.0]), np.array([77.0]), np.array([33.0, 90.0]))
    sample = volume_sample(MACHINE, nodes)
    lines = sample.position_mm[sample.weight == 0.0]
    ends = [{low, 0.5 * (low + high), high} for low, high in RANGES]
    for axis, inner in enumerate((123.0, 77.0, 33.0)):
        assert set(np.unique(lines[:, axis])) == ends[axis] | {inner}
        own = lines[lines[:, axis] == inner]
        assert len(own) == 9
        assert all(set(own[:, k]) == ends[k] for k in range(3) if k != axis)
