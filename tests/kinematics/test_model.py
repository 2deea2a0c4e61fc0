"""The machine model against hand-written signs, Zha & Zhang (2024) eq. 9, matrix products and the SVD."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import machines
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import CHAINS
from compgen.data.names import AXES, CURVE_NAMES, ERROR_INDEX, ERROR_NAMES
from compgen.kinematics import (
    c_matrix,
    exact_columns,
    exact_error,
    modelled_errors,
    observable_errors,
    volumetric_error,
)
from compgen.kinematics.exact_chain import tip_position, travel_directions

MICROMETRE = 1e-3  # mm
PICOMETRE = 1e-9  # mm: rounding of double arithmetic over a metre, with room


def machine_of(chain, reference="X", tool_mm=(0.0, 0.0, 0.0), range_mm=(-500.0, 500.0), nodes=4):
    fields = {"squareness_reference": reference, "tool_offset_mm": tool_mm}
    return machines.machine_of((range_mm,) * 3, nodes, chain, name="test", **fields)


def constant_table(**errors):
    """Errors that are the same everywhere, in mm and rad."""
    curves = {
        name: Curve(np.zeros(1), np.array([value]), np.full(1, np.nan))
        for name, value in errors.items()
        if name in CURVE_NAMES
    }
    squareness = {name: (value, np.nan) for name, value in errors.items() if name not in CURVE_NAMES}
    return ErrorTable(curves, squareness)


def random_values(seed, rows, linear_mm=0.03, angular_rad=1e-4):
    scale = np.array(([linear_mm] * 3 + [angular_rad] * 3) * 3 + [angular_rad] * 3)
    return np.random.default_rng(seed).uniform(-1, 1, (rows, 21)) * scale


def table_of(values):
    return constant_table(**dict(zip(ERROR_NAMES, values.tolist(), strict=True)))


# --- Zha & Zhang 2024, eq. 9 ------------------------------------------------------------------------------------

#: Every term of eq. 9 at X = 2, Y = 3, Z = 5 (mm), chain WFYXZT, tool offset zero; columns that are not named are zero.
ZHA_EQ_9 = {
    "EXX": (1, 0, 0),
    "EXY": (1, 0, 0),
    "EXZ": (1, 0, 0),
    "EYX": (0, 1, 0),
    "EYY": (0, 1, 0),
    "EYZ": (0, 1, 0),
    "EZX": (0, 0, 1),
    "EZY": (0, 0, 1),
    "EZZ": (0, 0, 1),
    "EBX": (5, 0, 0),
    "EBY": (5, 0, -2),
    "EAX": (0, -5, 0),
    "EAY": (0, -5, 0),
    "ECY": (0, 2, 0),
    "EB0Z": (5, 0, 0),
    "EA0Z": (0, -5, 0),
}


@pytest.mark.parametrize(
    ("reference", "c0y"),
    [("X", (-3, 0, 0)), ("Y", (0, -2, 0))],
)
def test_c_of_wfyxzt_is_equation_9_of_zha_term_by_term(reference, c0y):
    found = c_matrix(machine_of("WFYXZT", reference), np.array([[2.0, 3.0, 5.0]]))[0]
    expected = np.zeros((3, 21))
    for name, column in {**ZHA_EQ_9, "EC0Y": c0y}.items():
        expected[:, ERROR_INDEX[name]] = column
    np.testing.assert_array_equal(found, expected)


def test_equation_9_of_zha_has_17_columns_and_the_other_four_have_no_lever_arm():
    machine = machine_of("WFYXZT")
    without = {"ECX", "EAZ", "EBZ", "ECZ"}
    assert observable_errors(machine) == tuple(name for name in ERROR_NAMES if name not in without)
    points_mm = np.random.default_rng(1).uniform(-500, 500, (50, 3))
    zero = ~np.any(c_matrix(machine, points_mm), axis=(0, 1))
    assert {name for name, is_zero in zip(ERROR_NAMES, zero, strict=True) if is_zero} == without


# --- signs by hand ----------------------------------------------------------------------------------------------
# At X, Y, Z = 100, 200, 300 mm with a tool offset of (10, 20, 30) mm; every linear error is +5 um, every rotation
# +100 urad, the error of the tip is in um. A rotation about +x takes y to z and z to -y, about +y z to x and x to -z,
# about +z x to y and y to -x.

LINEAR_UM = {
    f"E{letter}{axis}": tuple(5.0 if letter == component else 0.0 for component in "XYZ")
    for axis in "XYZ"
    for letter in "XYZ"
}
SQUARENESS_UM = {
    "EC0Y": (-20.0, 0.0, 0.0),  # Y turned about +z: 200 mm along Y lean towards -x
    "EB0Z": (30.0, 0.0, 0.0),  # Z turned about +y: 300 mm along Z lean towards +x
    "EA0Z": (0.0, -30.0, 0.0),  # Z turned about +x: 300 mm along Z lean towards -y
}

#: All axes carry the tool. X carries Y and Z (arm 10, 220, 330), Y carries Z (10, 20, 330 mm), Z the tool (10, 20, 30).
TOOL_SIDE_UM = {
    "EAX": (0.0, -33.0, 22.0),
    "EBX": (33.0, 0.0, -1.0),
    "ECX": (-22.0, 1.0, 0.0),
    "EAY": (0.0, -33.0, 2.0),
    "EBY": (33.0, 0.0, -1.0),
    "ECY": (-2.0, 1.0, 0.0),
    "EAZ": (0.0, -3.0, 2.0),
    "EBZ": (3.0, 0.0, -1.0),
    "ECZ": (-2.0, 1.0, 0.0),
}

#: All axes carry the workpiece, X next to the foundation, then Y, then Z. The tool stands still; seen from the X
#: carriage's origin, which moved to -100 mm, the tip is at (110, 20, 30), from Y at (110, 220, 30), from Z at
#: (110, 220, 330) mm. The table turns the other way, so that the tool turns by +100 urad as the workpiece sees it.
WORKPIECE_SIDE_UM = {
    "EAX": (0.0, -3.0, 2.0),
    "EBX": (3.0, 0.0, -11.0),
    "ECX": (-2.0, 11.0, 0.0),
    "EAY": (0.0, -3.0, 22.0),
    "EBY": (3.0, 0.0, -11.0),
    "ECY": (-22.0, 11.0, 0.0),
    "EAZ": (0.0, -33.0, 22.0),
    "EBZ": (33.0, 0.0, -11.0),
    "ECZ": (-22.0, 11.0, 0.0),
}

#: Y carries the workpiece, X and then Z the tool: arms X (10, 20, 330), Y (110, 220, 330), Z (10, 20, 30) mm.
MOVING_TABLE_UM = {
    "EAX": (0.0, -33.0, 2.0),
    "EBX": (33.0, 0.0, -1.0),
    "ECX": (-2.0, 1.0, 0.0),
    "EAY": (0.0, -33.0, 22.0),
    "EBY": (33.0, 0.0, -11.0),
    "ECY": (-22.0, 11.0, 0.0),
    "EAZ": (0.0, -3.0, 2.0),
    "EBZ": (3.0, 0.0, -1.0),
    "ECZ": (-2.0, 1.0, 0.0),
}

SIGNS = [
    (chain, name, expected_um)
    for chain, angular in (("WFXYZT", TOOL_SIDE_UM), ("WZYXFT", WORKPIECE_SIDE_UM), ("WYFXZT", MOVING_TABLE_UM))
    for name, expected_um in {**LINEAR_UM, **angular, **SQUARENESS_UM}.items()
]


def test_the_hand_written_signs_cover_all_21_errors_of_each_chain():
    assert [name for _, name, _ in SIGNS].count("EXX") == 3
    assert len(SIGNS) == 3 * 21 == len({(chain, name) for chain, name, _ in SIGNS})


@pytest.mark.parametrize(("chain", "name", "expected_um"), SIGNS)
def test_a_positive_error_moves_the_tool_where_the_hand_says(chain, name, expected_um):
    machine = machine_of(chain, tool_mm=(10.0, 20.0, 30.0))
    table = constant_table(**{name: 0.005 if name in LINEAR_UM else 1e-4})
    position_mm = np.array([[100.0, 200.0, 300.0]])
    np.testing.assert_allclose(
        volumetric_error(machine, table, position_mm)[0], np.array(expected_um) * MICROMETRE, atol=PICOMETRE
    )
    second_order = 0.5 * 1e-4**2 * 400.0  # half the angle squared times the longest arm
    np.testing.assert_allclose(
        exact_error(machine, table, position_mm)[0], np.array(expected_um) * MICROMETRE, atol=1.01 * second_order
    )


def test_with_y_as_the_reference_a_positive_c0y_turns_the_x_axis_to_minus_y():
    machine, table = machine_of("WFYXZT", "Y"), constant_table(EC0Y=1e-4)
    position_mm = np.array([[100.0, 200.0, 300.0]])
    np.testing.assert_allclose(volumetric_error(machine, table, position_mm), [[0.0, -0.010, 0.0]], atol=PICOMETRE)
    np.testing.assert_allclose(exact_error(machine, table, position_mm), [[0.0, -0.010, 0.0]], atol=5.1e-7)


def test_the_two_squareness_references_differ_by_a_rigid_rotation_about_z():
    table = constant_table(EC0Y=1e-4)
    points_mm = np.random.default_rng(2).uniform(-500, 500, (20, 3))
    difference = volumetric_error(machine_of("WFYXZT", "Y"), table, points_mm) - volumetric_error(
        machine_of("WFYXZT", "X"), table, points_mm
    )
    np.testing.assert_allclose(difference, np.cross([0.0, 0.0, -1e-4], points_mm), atol=PICOMETRE)


# --- exact against first order, and against an independent product of matrices --------------------------------


def pose(translation_mm=(0, 0, 0), rotation_rad=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_rad).as_matrix()
    matrix[:3, 3] = translation_mm
    return matrix


def directions_of_travel(values, reference):
    c0y, b0z, a0z = values[18:]
    turn = {"X": (0, 0, 0), "Y": (0, 0, c0y), "Z": (a0z, b0z, 0)}
    if reference == "Y":
        turn |= {"X": (0, 0, -c0y), "Y": (0, 0, 0)}
    return {axis: Rotation.from_rotvec(turn[axis]).apply(np.eye(3)["XYZ".index(axis)]) for axis in "XYZ"}


def tip_by_matrices(chain, values, position_mm, tool_mm, reference="X"):
    """Tool tip in the workpiece frame: inverse pose of the workpiece times pose of the tool, from the foundation."""
    travel = directions_of_travel(values, reference)

    def carriage(letter, sign):
        k = "XYZ".index(letter)
        delta, eps = values[6 * k : 6 * k + 3], values[6 * k + 3 : 6 * k + 6]
        return pose(sign * position_mm[k] * travel[letter]) @ pose(sign * delta) @ pose(rotation_rad=sign * eps)

    left, right = chain[1:-1].split("F")
    workpiece, tool = np.eye(4), np.eye(4)
    for letter in reversed(left):
        workpiece = workpiece @ carriage(letter, -1)
    for letter in right:
        tool = tool @ carriage(letter, +1)
    tip = np.linalg.inv(workpiece) @ tool @ np.array([*tool_mm, 1.0])
    return tip[:3]


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", CHAINS)
def test_the_exact_model_is_the_product_of_the_poses_along_the_chain(chain, reference):
    machine = machine_of(chain, reference)
    values = random_values(3, 6, linear_mm=3.0, angular_rad=0.03)
    rng = np.random.default_rng(4)
    points_mm, tools_mm = rng.uniform(-500, 500, (6, 3)), rng.uniform(-200, 200, (6, 3))
    expected = [
        tip_by_matrices(chain, *row, reference=reference) for row in zip(values, points_mm, tools_mm, strict=True)
    ]
    np.testing.assert_allclose(tip_position(machine, values, points_mm, tools_mm), expected, atol=PICOMETRE)


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", CHAINS)
def test_the_first_order_model_is_the_derivative_of_that_product(chain, reference):
    rng = np.random.default_rng(5)
    position_mm, tool_mm = rng.uniform(-500, 500, 3), rng.uniform(-200, 200, 3)
    step = 1e-4
    derivative = np.empty((3, 21))
    for k in range(21):
        up, down = (
            tip_by_matrices(chain, sign * step * np.eye(21)[k], position_mm, tool_mm, reference) for sign in (1, -1)
        )
        derivative[:, k] = (up - down) / (2 * step)
    found = c_matrix(machine_of(chain, reference), position_mm[None], tool_mm)[0]
    third_order = 1000.0 * step**2  # arm times the square of the step, per unit of the error
    np.testing.assert_allclose(found, derivative, atol=third_order)


@pytest.mark.parametrize("chain", ["WFYXZT", "WYFXZT", "WZYXFT"])
def test_exact_and_first_order_differ_by_second_order_that_quarters_when_errors_halve(chain):
    machine = machine_of(chain, tool_mm=(10.0, 20.0, 150.0))
    points_mm = np.random.default_rng(6).uniform(-500, 500, (40, 3))
    largest = []
    for scale in (1.0, 0.5, 0.25):
        table = table_of(scale * random_values(7, 1)[0])
        gap = exact_error(machine, table, points_mm) - volumetric_error(machine, table, points_mm)
        largest.append(np.abs(gap).max())
    assert 0 < largest[0] < 6 * 1e-4 * (0.09 + 1e-4 * 3000)
    assert largest[0] / largest[1] == pytest.approx(4, rel=0.01)
    assert largest[1] / largest[2] == pytest.approx(4, rel=0.01)


def test_a_squareness_of_2903_urad_needs_the_exact_model_over_a_metre():
    machine, table = machine_of("WFYXZT"), constant_table(EC0Y=2903e-6)
    exact = exact_error(machine, table, np.array([[0.0, -1000.0, 0.0]]))[0]
    np.testing.assert_allclose(exact, [1000 * np.sin(2903e-6), 1000 * (1 - np.cos(2903e-6)), 0], atol=PICOMETRE)
    assert exact[1] == pytest.approx(4.2 * MICROMETRE, abs=0.02 * MICROMETRE)


# --- derivative of the exact model ------------------------------------------------------------------------------


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", CHAINS)
def test_exact_columns_agree_with_finite_differences_and_give_the_same_tip(chain, reference):
    machine = machine_of(chain, reference)
    values = random_values(8, 3, linear_mm=1.0, angular_rad=0.01)
    rng = np.random.default_rng(9)
    points_mm, tools_mm = rng.uniform(-500, 500, (3, 3)), rng.uniform(-200, 200, (3, 3))
    tip, columns = exact_columns(machine, values, points_mm, tools_mm)
    np.testing.assert_allclose(tip, tip_position(machine, values, points_mm, tools_mm), atol=PICOMETRE)
    step = 1e-4
    for k in range(21):
        up, down = (
            tip_position(machine, values + sign * step * np.eye(21)[k], points_mm, tools_mm) for sign in (1, -1)
        )
        np.testing.assert_allclose(columns[:, :, k], (up - down) / (2 * step), atol=1000.0 * step**2)


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", CHAINS)
def test_exact_columns_at_zero_errors_are_c(chain, reference):
    machine = machine_of(chain, reference, tool_mm=(10.0, -20.0, 150.0))
    points_mm = np.random.default_rng(10).uniform(-500, 500, (5, 3))
    tip, columns = exact_columns(machine, np.zeros((5, 21)), points_mm)
    np.testing.assert_allclose(columns, c_matrix(machine, points_mm), atol=PICOMETRE)
    np.testing.assert_allclose(tip, points_mm + [10.0, -20.0, 150.0], atol=PICOMETRE)


# --- shapes ---------------------------------------------------------------------------------------------------


def test_many_points_give_what_each_point_gives_alone():
    machine = machine_of("WYFXZT", tool_mm=(1.0, 2.0, 3.0))
    positions = np.linspace(-500, 500, 5)
    table = ErrorTable(
        {
            name: Curve(positions, np.sin(positions / 90 + k) * (0.02 if k % 6 < 3 else 5e-5), np.full(5, np.nan))
            for k, name in enumerate(CURVE_NAMES)
        },
        {"EC0Y": (2e-5, np.nan), "EA0Z": (-1e-5, np.nan)},
    )
    rng = np.random.default_rng(11)
    points_mm, tools_mm = rng.uniform(-500, 500, (7, 3)), rng.uniform(-50, 50, (7, 3))
    for model in (volumetric_error, exact_error):
        together = model(machine, table, points_mm, tools_mm)
        assert together.shape == (7, 3)
        alone = [model(machine, table, points_mm[[k]], tools_mm[k])[0] for k in range(7)]
        np.testing.assert_allclose(together, alone, atol=PICOMETRE)
    assert c_matrix(machine, points_mm, tools_mm).shape == (7, 3, 21)
    by_matrix = np.einsum("nij,nj->ni", c_matrix(machine, points_mm, tools_mm), table.at(points_mm))
    np.testing.assert_allclose(volumetric_error(machine, table, points_mm, tools_mm), by_matrix, atol=PICOMETRE)


def test_without_a_tool_offset_given_the_machines_own_is_used():
    table, point_mm = constant_table(EBZ=1e-4), np.array([[0.0, 0.0, 0.0]])
    machine = machine_of("WFYXZT", tool_mm=(0.0, 0.0, 150.0))
    assert volumetric_error(machine, table, point_mm)[0, 0] == pytest.approx(0.015, abs=PICOMETRE)
    assert volumetric_error(machine, table, point_mm, np.zeros(3))[0, 0] == 0.0


def test_the_inputs_are_not_changed():
    machine, table = machine_of("WYFXZT"), constant_table(EAX=1e-4, EXX=0.01)
    points_mm, tool_mm = np.ones((2, 3)), np.ones((2, 3))
    values = np.full((2, 21), 1e-4)
    exact_error(machine, table, points_mm, tool_mm)
    volumetric_error(machine, table, points_mm, tool_mm)
    exact_columns(machine, values, points_mm, tool_mm)
    assert np.all(points_mm == 1) and np.all(tool_mm == 1) and np.all(values == 1e-4)


# --- what can be told apart: numerical rank -------------------------------------------------------------------


def hat_basis(position_mm, nodes_mm):
    return np.array([np.interp(position_mm, nodes_mm, unit) for unit in np.eye(len(nodes_mm))]).T


def length_system(machine, names, stations_mm, tools_mm=((0.0, 0.0, 0.0),)):
    """Jacobian of the lengths by the nodes of ``names``, the stations and the dead lengths, and the nodes' places."""
    nodes_mm = machine.axes[0].nodes_mm
    grid = np.array(np.meshgrid(nodes_mm, nodes_mm, nodes_mm, indexing="ij")).reshape(3, -1).T
    points_mm = np.repeat(grid, len(tools_mm), axis=0)
    tools = np.tile(np.asarray(tools_mm), (len(grid), 1))
    matrix = c_matrix(machine, points_mm, tools)
    blocks, places = [], []
    for name in names:
        column = matrix[:, :, ERROR_INDEX[name]]
        if name in CURVE_NAMES:
            basis = hat_basis(points_mm[:, AXES.index(name[2])], nodes_mm)
            blocks.append(column[:, :, None] * basis[:, None, :])
            places += [(name, node) for node in range(len(nodes_mm))]
        else:
            blocks.append(column[:, :, None])
            places.append((name, 0))
    error_part = np.concatenate(blocks, axis=2)
    rows = []
    for k, station in enumerate(stations_mm):
        sight = points_mm + tools - station
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        own = np.zeros((len(points_mm), 4 * len(stations_mm)))
        own[:, 4 * k : 4 * k + 3], own[:, 4 * k + 3] = -sight, -1.0
        rows.append(np.hstack([np.einsum("ni,nik->nk", sight, error_part), own]))
    return np.vstack(rows), places


def nullity(matrix):
    """Number of columns less the numerical rank; the gap between kept and dropped values must be wide."""
    scale = np.linalg.norm(matrix, axis=0)
    assert np.all(scale > 0)
    singular = np.linalg.svd(matrix / scale, compute_uv=False)
    singular = np.concatenate([singular, np.zeros(matrix.shape[1] - len(singular))])
    kept = singular > 1e-10 * singular[0]
    assert singular[kept].min() > 1e-5 * singular[0]
    return int(np.count_nonzero(~kept))


def constrained(matrix, places, names):
    """The same system with the first node of every curve and the last of every straightness curve held at zero."""
    last = max(node for _, node in places)
    held = [
        k
        for k, (name, node) in enumerate(places)
        if name in CURVE_NAMES and (node == 0 or (node == last and name[1] in AXES and name[1] != name[2]))
    ]
    return np.delete(matrix, held, axis=1), len(held)


STATIONS_MM = np.array(
    [[-900.0, -700.0, -650.0], [850.0, -750.0, -600.0], [-700.0, 900.0, -720.0], [760.0, 810.0, 900.0]]
)


@pytest.mark.parametrize("stations", [3, 4])
@pytest.mark.parametrize("chain", CHAINS)
def test_17_errors_miss_20_dimensions_and_20_constraints_give_full_rank(chain, stations):
    machine = machine_of(chain)
    names = observable_errors(machine)
    matrix, places = length_system(machine, names, STATIONS_MM[:stations])
    assert len(names) == 17
    assert nullity(matrix) == 20
    fixed, held = constrained(matrix, places, names)
    assert held == 20
    assert nullity(fixed) == 0


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WZYXFT", "WYFXZT"])
def test_every_error_that_is_left_out_adds_only_directions_that_the_lengths_do_not_show(chain):
    """Leaving it out loses nothing: the rank with it is the rank without it."""
    machine = machine_of(chain)
    names = observable_errors(machine)
    matrix, _ = length_system(machine, names, STATIONS_MM)
    rank = np.linalg.matrix_rank(matrix / np.linalg.norm(matrix, axis=0), tol=1e-9)
    for name in set(ERROR_NAMES) - set(names):
        more, _ = length_system(machine, (*names, name), STATIONS_MM)
        scale = np.linalg.norm(more, axis=0)
        more = more / np.where(scale > 0, scale, 1)
        assert np.linalg.matrix_rank(more, tol=1e-9) == rank, name


def test_an_error_whose_only_lever_is_its_own_travel_is_left_out():
    assert "ECY" not in observable_errors(machine_of("WXYFZT"))
    assert "ECX" in observable_errors(machine_of("WXYFZT"))


def test_three_tools_that_are_not_in_line_show_all_21_errors_with_21_free_directions():
    tools_mm = np.array([[0.0, 0.0, 100.0], [80.0, 0.0, 60.0], [0.0, 70.0, 150.0]])
    machine = machine_of("WFYXZT")
    assert observable_errors(machine, tools_mm) == ERROR_NAMES
    matrix, _ = length_system(machine, ERROR_NAMES, STATIONS_MM, tools_mm)
    assert nullity(matrix) == 21


@pytest.mark.parametrize(
    ("tools_mm", "left_out"),
    [
        ([[0.0, 0.0, 100.0], [0.0, 0.0, 200.0]], {"ECX", "ECZ"}),
        ([[0.0, 0.0, 100.0], [80.0, 0.0, 100.0]], {"EAZ"}),
        ([[0.0, 0.0, 0.0], [50.0, 70.0, 90.0]], {"ECZ"}),
        ([[0.0, 0.0, 100.0], [0.0, 0.0, 100.0]], {"ECX", "EAZ", "EBZ", "ECZ"}),
    ],
)
def test_tools_in_line_leave_out_the_rotation_about_that_line_and_lose_no_rank(tools_mm, left_out):
    machine = machine_of("WFYXZT")
    names = observable_errors(machine, np.array(tools_mm))
    assert set(ERROR_NAMES) - set(names) == left_out
    kept, places = length_system(machine, names, STATIONS_MM, tools_mm)
    every, _ = length_system(machine, ERROR_NAMES, STATIONS_MM, tools_mm)
    every = every[:, np.any(every != 0, axis=0)]
    ranks = [np.linalg.matrix_rank(m / np.linalg.norm(m, axis=0), tol=1e-9) for m in (kept, every)]
    assert ranks[0] == ranks[1]
    scaled = kept / np.linalg.norm(kept, axis=0)
    for error in (name for name in names if name in CURVE_NAMES):
        others = [k for k in range(kept.shape[1]) if k >= len(places) or places[k][0] != error]
        shown = ranks[0] - np.linalg.matrix_rank(scaled[:, others], tol=1e-9)
        assert shown >= 2, error  # of its 4 nodes the gauge takes a constant and a slope at most


def test_the_model_holds_what_the_machine_file_asks_for():
    machine = machine_of("WFYXZT")
    tools_mm = np.array([[0.0, 0.0, 100.0], [80.0, 0.0, 60.0], [0.0, 70.0, 150.0]])
    assert len(modelled_errors(machine)) == 17
    assert len(modelled_errors(machine, tools_mm)) == 21
    assert len(modelled_errors(replace(machine, errors=17), tools_mm)) == 17
    assert modelled_errors(replace(machine, errors=21)) == ERROR_NAMES
    assert modelled_errors(replace(machine, errors=("EXX", "EC0Y"))) == ("EXX", "EC0Y")


# --- invariance -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reference", "straightness"),
    [("X", "EXY"), ("Y", "EYX")],
)
@pytest.mark.parametrize("chain", ["WFYXZT", "WYFXZT", "WXYZFT"])
def test_a_line_moved_from_straightness_into_squareness_leaves_the_error_as_it_is(chain, reference, straightness):
    machine = machine_of(chain, reference)
    nodes_mm, slope_rad = np.linspace(-500, 500, 11), 4e-5
    curve = Curve(nodes_mm, 0.005 * np.sin(nodes_mm / 150), np.full(11, np.nan))
    leaning = replace(curve, value=curve.value + slope_rad * nodes_mm)
    in_curve = ErrorTable({straightness: leaning, "EBX": replace(curve, value=curve.value * 2e-3)}, {})
    in_squareness = ErrorTable({straightness: curve, "EBX": in_curve.curves["EBX"]}, {"EC0Y": (-slope_rad, np.nan)})
    points_mm = np.random.default_rng(12).uniform(-500, 500, (60, 3))
    first_order = volumetric_error(machine, in_curve, points_mm) - volumetric_error(machine, in_squareness, points_mm)
    assert np.abs(volumetric_error(machine, in_curve, points_mm)).max() > 10 * MICROMETRE
    np.testing.assert_allclose(first_order, 0.0, atol=PICOMETRE)
    exact = exact_error(machine, in_curve, points_mm) - exact_error(machine, in_squareness, points_mm)
    second_order = 0.5 * slope_rad**2 * 500  # shortening of the turned axis
    assert np.abs(exact).max() <= 1.1 * second_order


@pytest.mark.parametrize("size", [1.0, 2e-3])
@pytest.mark.parametrize("reference", ["X", "Y"])
def test_derivatives_of_the_travel_directions_hold_at_small_and_large_squareness(reference, size):
    """Against central differences, also at angles so large that every sine counts; directions stay unit vectors."""
    machine = machine_of("WFYXZT", reference=reference)
    squareness = size * np.array([0.3, -0.2, 0.25])
    directions, derivatives = travel_directions(machine, squareness)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1.0, abs=1e-15)
    for k, step in enumerate(1e-6 * np.eye(3)):
        later, earlier = (travel_directions(machine, squareness + sign * step)[0] for sign in (1.0, -1.0))
        assert derivatives[:, :, k] == pytest.approx((later - earlier) / 2e-6, abs=1e-9)
