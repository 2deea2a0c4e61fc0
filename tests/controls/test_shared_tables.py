"""Tables that controls share: interpolation, units, signs, directions and what holds outside, by hand and by exact formulas."""

import numpy as np
import pytest

from compgen.controls.shared.base import Monomial, Term
from compgen.controls.shared.tables import Table1D, TableGrid, along_itself, largest_of
from compgen.controls.shared.terms import field_on_grid
from compgen.data.error_table import Curve, ReversalCurves
from compgen.data.lengths import Points

NODES, VALUES = np.array([0.0, 10.0, 30.0]), np.array([2.0, 4.0, -6.0])


def at(x, approach=None):
    """Points with X at these places, Y at 1000 mm, reached in one direction of X."""
    position = np.zeros((len(x), 3))
    position[:, 0], position[:, 1] = x, 1000.0
    return Points(position, approach=None if approach is None else np.tile([float(approach), 0.0, 0.0], (len(x), 1)))


def test_a_table_is_linear_between_its_nodes_and_keeps_its_end_values():
    """4 at 10 and -6 at 30: -1 at 20; below 0 the first value, above 30 the last."""
    table = Table1D(0, 2, NODES, VALUES)
    assert table.at(np.array([-5.0, 0.0, 5.0, 20.0, 31.0])).tolist() == [2.0, 2.0, 3.0, -1.0, -6.0]


def test_a_table_may_be_zero_outside():
    """The ends themselves still act."""
    table = Table1D(0, 2, NODES, VALUES, zero_outside=True)
    assert table.at(np.array([-5.0, 0.0, 30.0, 31.0])).tolist() == [0.0, 2.0, -6.0, 0.0]


def test_units_sign_and_origin_of_a_table():
    """Nodes in 0.1 um from X 100 mm, values in um that the control subtracts: 4 at 10 nodes is -0.004 mm at 100.001 mm."""
    table = Table1D(0, 2, NODES, VALUES, value_mm=-1e-3, node_mm=1e-4, origin_mm=100.0)
    assert table.nodes_mm.tolist() == pytest.approx([100.0, 100.001, 100.003], abs=1e-12)
    assert table.added_mm(at([100.001, 100.002])) == pytest.approx([-0.004, +0.001], abs=1e-9)


def test_a_second_column_acts_after_travel_in_negative_direction():
    """The mean of both where nobody knows the direction."""
    table = Table1D(0, 0, NODES, VALUES, VALUES + 1.0, value_mm=0.1)
    assert table.added_mm(at([10.0], 1)) == pytest.approx([0.4])
    assert table.added_mm(at([10.0], -1)) == pytest.approx([0.5])
    assert table.added_mm(at([10.0])) == table.added_mm(at([10.0], 0)) == pytest.approx([0.45])


def test_the_table_with_the_largest_value_is_the_example():
    tables = [Table1D(axis, axis, NODES, factor * VALUES) for axis, factor in enumerate((1.0, -2.0, 1.5))]
    assert (largest_of(tables).axis, largest_of(tables).largest) == (1, 2)


def bilinear(y, z):
    """A function that is linear along each axis, so that a grid has it exactly."""
    return 3.0 + 0.5 * y - 0.25 * z + 0.125 * y * z


def plane(**other):
    """Its values over Z (5 places) and Y (3 places), in this order."""
    z, y = np.meshgrid(-4.0 + 2.0 * np.arange(5), 10.0 + 5.0 * np.arange(3), indexing="ij")
    return TableGrid((2, 1), (0,), np.array([-4.0, 10.0]), np.array([2.0, 5.0]), bilinear(y, z)[..., None], **other)


def test_a_grid_has_every_function_that_is_linear_along_each_axis():
    place = np.random.default_rng(1).uniform([0.0, 10.0, -4.0], [1.0, 20.0, 4.0], (50, 3))
    assert plane().at(place)[:, 0] == pytest.approx(bilinear(place[:, 1], place[:, 2]), abs=1e-12)


def test_outside_a_grid_its_surface_holds_or_its_cells_go_on():
    """Y 25 is 5 mm beyond, Z -6 is 2 mm beyond."""
    beyond = np.array([[0.0, 25.0, -6.0]])
    assert plane().at(beyond) == pytest.approx(bilinear(20.0, -4.0))
    assert plane(extends=True).at(beyond) == pytest.approx(bilinear(25.0, -6.0))


def test_nodes_of_a_grid_and_what_it_adds():
    grid = plane(value_mm=-1e-3, node_mm=0.1)
    assert [(axis, nodes.tolist()) for axis, nodes in grid.spans] == [
        (2, pytest.approx([-0.4, -0.2, 0.0, 0.2, 0.4])),
        (1, pytest.approx([1.0, 1.5, 2.0])),
    ]
    added = grid.added_mm(Points(np.array([[0.0, 1.5, 0.2]])))
    assert added == pytest.approx(-1e-3 * bilinear(15.0, 2.0))


def test_a_grid_of_three_axes_moves_three():
    """x + 2 y + 4 z for the first number of a vertex, x y z for the second, in cells of 2 mm."""
    x, y, z = np.meshgrid(*[2.0 * np.arange(3)] * 3, indexing="ij")
    grid = TableGrid((0, 1, 2), (0, 2), np.zeros(3), 2.0, np.stack([x + 2 * y + 4 * z, x * y * z], axis=-1))
    assert grid.at(np.array([[1.0, 3.0, 0.5], [4.0, 4.0, 4.0]])) == pytest.approx(np.array([[9.0, 1.5], [28.0, 64.0]]))


def test_only_the_reversal_along_the_axis_itself_has_room():
    curve = Curve(np.array([0.0]), np.array([1e-3]), np.array([np.nan]))
    assert list(along_itself(ReversalCurves({(0, 0): curve, (2, 0): curve, (1, 1): curve})).curves) == [(0, 0), (1, 1)]


def test_the_field_of_terms_at_the_vertices_of_a_grid():
    """-X(y) (z - 3): X(y) is 0.01 at Y 10 and 0.02 at Y 20, Z 8 is 5 mm from the origin of the lever; axes in the order asked."""
    term = Term("X(y)*z", 1, np.array([0.0, 20.0]), (Monomial(0, -1, 2, 3.0),), np.zeros(2))
    field = field_on_grid(
        [term],
        {"X(y)*z": np.array([0.0, 0.02])},
        {2: np.array([3.0, 8.0]), 1: np.array([0.0, 10.0, 20.0])},
        np.zeros(3),
    )
    assert field.shape == (2, 3, 3)
    assert field[..., 0] == pytest.approx(np.array([[0.0, 0.0, 0.0], [0.0, -0.05, -0.10]]))
    assert not field[..., 1:].any()
