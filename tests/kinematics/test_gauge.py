"""Gauge alignment: what no measurement can show makes no difference, for any chain and tool."""

import numpy as np
import pytest

import machines
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import CHAINS
from compgen.data.names import ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.kinematics import align, gauge_directions, observable_errors, volumetric_error
from compgen.kinematics.gauge import gauge_part

ROUNDING = 1e-12  # mm, and rad at a lever of one metre
RANGES = ((-420.0, 130.0), (50.0, 650.0), (-300.0, 0.0))
COUNTS = (5, 4, 6)


def machine_of(chain="WFYXZT", **fields):
    return machines.machine_of(RANGES, COUNTS, chain, reference_point_mm=(0.0, 50.0, -100.0), **fields)


def table_of(machine, names, seed=1):
    rng = np.random.default_rng(seed)
    curves, squareness = {}, {}
    for name in names:
        size = 0.01 if error_named(name).kind == "linear" else 2e-5
        if name in SQUARENESS_NAMES:
            squareness[name] = (rng.normal(0, size), 1e-6)
        else:
            nodes = machine.axes[error_named(name).axis].nodes_mm
            curves[name] = Curve(nodes, rng.normal(0, size, len(nodes)), np.full(len(nodes), 1e-4))
    return ErrorTable(curves, squareness, {"machine": machine.name})


def transformed(table, direction):
    """The table with constants and slopes (21, 2) added."""
    curves = {
        name: Curve(
            curve.position_mm,
            curve.value + direction[ERROR_INDEX[name]] @ [np.ones(len(curve.value)), curve.position_mm],
            curve.u,
        )
        for name, curve in table.curves.items()
    }
    squareness = {name: (v + direction[ERROR_INDEX[name], 0], u) for name, (v, u) in table.squareness.items()}
    return ErrorTable(curves, squareness, table.metadata)


def random_gauge(machine, names, seed=2):
    """A random gauge change of some 10 um over the travel."""
    directions = gauge_directions(machine, names)
    rng = np.random.default_rng(seed)
    sizes = np.array([np.abs(d[:, 0]).max() + 300.0 * np.abs(d[:, 1]).max() for d in directions])
    return np.einsum("k,kij->ij", rng.normal(0, 1e-2, len(directions)) / sizes, directions)


def volume(machine, count=6):
    levels = [np.linspace(*axis.range_mm, count) for axis in machine.axes]
    return np.stack(np.meshgrid(*levels, indexing="ij"), -1).reshape(-1, 3)


def without_rigid_motion(field, position):
    """A field (n, 3) less its best-fit small rigid motion."""
    unit = np.eye(3)
    columns = [np.tile(unit[k], len(position)) for k in range(3)]
    columns += [np.cross(unit[k], position / 500.0).ravel() for k in range(3)]
    design = np.column_stack(columns)
    return field.ravel() - design @ np.linalg.lstsq(design, field.ravel(), rcond=None)[0]


def difference(first, second):
    found = [np.abs(first.curves[n].value - second.curves[n].value).max() for n in first.curves]
    found += [abs(first.squareness[n][0] - second.squareness[n][0]) for n in first.squareness]
    return max(found)


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("tool", [(0.0, 0.0, 0.0), (20.0, -30.0, -150.0)])
def test_the_17_errors_of_one_tool_have_20_gauge_directions(chain, tool):
    machine = machine_of(chain, tool_offset_mm=tool)
    assert len(gauge_directions(machine, observable_errors(machine))) == 20


def test_three_tools_leave_the_gauge_of_21_errors_at_21():
    machine = machine_of(tool_offset_mm=(0.0, 0.0, -100.0))
    tools = np.array([[0.0, 0.0, -100.0], [80.0, 0.0, -100.0], [0.0, 90.0, -180.0]])
    assert len(gauge_directions(machine, ERROR_NAMES, tools)) == 21


@pytest.mark.parametrize("chain", CHAINS[::2])
@pytest.mark.parametrize("reference", ["X", "Y"])
def test_a_gauge_change_leaves_the_machine_and_is_undone_by_alignment(chain, reference):
    machine = machine_of(chain, tool_offset_mm=(20.0, -30.0, -150.0), squareness_reference=reference)
    names = observable_errors(machine)
    table = table_of(machine, names)
    other = transformed(table, random_gauge(machine, names))
    position = volume(machine)
    change = volumetric_error(machine, other, position) - volumetric_error(machine, table, position)
    assert difference(other, table) > 1e-3
    assert np.abs(without_rigid_motion(change, position)).max() < ROUNDING
    assert difference(align(machine, other, table), table) < ROUNDING


@pytest.mark.parametrize("chain", CHAINS[1::3])
def test_alignment_to_another_table_leaves_the_machine_as_it_is(chain):
    machine = machine_of(chain, tool_offset_mm=(20.0, -30.0, -150.0))
    names = observable_errors(machine)
    table, reference = table_of(machine, names), table_of(machine, names, seed=9)
    aligned = align(machine, table, reference)
    position = volume(machine)
    change = volumetric_error(machine, aligned, position) - volumetric_error(machine, table, position)
    assert np.abs(change).max() > 1e-3
    assert np.abs(without_rigid_motion(change, position)).max() < ROUNDING
    again = align(machine, aligned, reference)
    assert difference(again, aligned) < ROUNDING


def test_a_line_moved_from_straightness_into_squareness_changes_nothing():
    """By hand: EXY = -a y does what EC0Y = +a does (dX = EXY - Y EC0Y)."""
    machine = machine_of()
    nodes = machine.axes[1].nodes_mm
    leaning = ErrorTable(squareness={"EC0Y": (50e-6, 0.0)})
    bent = ErrorTable({"EXY": Curve(nodes, -50e-6 * nodes, 0 * nodes)}, {"EC0Y": (0.0, 0.0)})
    position = volume(machine)
    assert np.allclose(
        volumetric_error(machine, leaning, position), volumetric_error(machine, bent, position), rtol=0, atol=ROUNDING
    )
    aligned = align(machine, bent, ErrorTable({"EXY": Curve(nodes, 0 * nodes, 0 * nodes)}, leaning.squareness))
    assert aligned.squareness["EC0Y"][0] == pytest.approx(50e-6, abs=1e-15)
    assert np.abs(aligned.curves["EXY"].value).max() < ROUNDING


def test_squareness_that_only_the_reference_has_takes_up_its_line():
    machine = machine_of()
    nodes = machine.axes[1].nodes_mm
    bent = ErrorTable({"EXY": Curve(nodes, -50e-6 * nodes, 0 * nodes)})
    aligned = align(machine, bent, ErrorTable(squareness={"EC0Y": (50e-6, 0.0)}))
    assert aligned.squareness["EC0Y"][0] == pytest.approx(50e-6, abs=1e-15)


def test_angular_errors_without_lever_arm_follow_the_reference():
    machine = machine_of(tool_offset_mm=(20.0, -30.0, -150.0))
    table, reference = table_of(machine, ERROR_NAMES), table_of(machine, ERROR_NAMES, seed=4)
    aligned = align(machine, table, reference)
    position = volume(machine)
    change = volumetric_error(machine, aligned, position) - volumetric_error(machine, table, position)
    assert np.abs(without_rigid_motion(change, position)).max() < ROUNDING
    assert not np.allclose(aligned.curves["EAZ"].value, table.curves["EAZ"].value, rtol=0, atol=1e-6)


def test_curves_on_other_nodes_are_compared_where_they_are():
    machine = machine_of()
    names = observable_errors(machine)
    table = table_of(machine, names)
    finer = {
        name: Curve(p := np.linspace(*RANGES[error_named(name).axis], 61), curve.at(p), np.zeros(61))
        for name, curve in table.curves.items()
    }
    other = transformed(table, random_gauge(machine, names))
    assert difference(align(machine, other, ErrorTable(finer, table.squareness)), table) < ROUNDING


def test_the_uncertainties_and_the_input_stay():
    machine = machine_of()
    names = observable_errors(machine)
    table = table_of(machine, names)
    before = {name: curve.value.copy() for name, curve in table.curves.items()}
    aligned = align(machine, table, table_of(machine, names, seed=3))
    for name, curve in table.curves.items():
        assert np.array_equal(curve.value, before[name])
        assert np.array_equal(aligned.curves[name].u, curve.u)
    assert aligned.metadata == table.metadata


TOOLS_MM = np.array([[0.0, 0.0, -100.0], [80.0, 0.0, -100.0], [0.0, 90.0, -180.0]])


def seen_by(machine, before, after, tools):
    """Change of the error with every tool, and the tips (n, 3) at which it is seen."""
    position = volume(machine)
    changes = [
        volumetric_error(machine, after, position, tool) - volumetric_error(machine, before, position, tool)
        for tool in tools
    ]
    return np.concatenate(changes), np.concatenate([position + tool for tool in tools])


@pytest.mark.parametrize("chain", CHAINS)
def test_alignment_for_several_tools_moves_all_of_them_as_one_rigid_body(chain):
    """A rotation moves the tips position + tool, each by its own lever; nothing that one of the tools shows may change."""
    machine = machine_of(chain, tool_offset_mm=tuple(TOOLS_MM[0]))
    table, reference = table_of(machine, ERROR_NAMES), table_of(machine, ERROR_NAMES, seed=9)
    aligned = align(machine, table, reference, TOOLS_MM)
    change, tips = seen_by(machine, table, aligned, TOOLS_MM)
    assert np.abs(change).max() > 1e-3
    assert np.abs(without_rigid_motion(change, tips)).max() < ROUNDING


@pytest.mark.parametrize("chain", CHAINS)
def test_rigid_rotations_of_the_workpiece_are_gauge_also_for_several_tools(chain):
    """The directions that several tools leave hold all that an independent count of unseen changes finds."""
    machine = machine_of(chain, tool_offset_mm=tuple(TOOLS_MM[0]))
    for direction in gauge_directions(machine, ERROR_NAMES, TOOLS_MM):
        table = table_of(machine, ERROR_NAMES)
        change, tips = seen_by(machine, table, transformed(table, 1e-3 * direction / np.abs(direction).max()), TOOLS_MM)
        assert np.abs(without_rigid_motion(change, tips)).max() < ROUNDING


def test_the_same_tool_given_twice_is_one_tool():
    machine = machine_of(tool_offset_mm=tuple(TOOLS_MM[2]))
    table, reference = table_of(machine, ERROR_NAMES), table_of(machine, ERROR_NAMES, seed=9)
    once = align(machine, table, reference, TOOLS_MM[2:])
    twice = align(machine, table, reference, TOOLS_MM[[2, 2]])
    assert difference(once, twice) < ROUNDING


def test_errors_that_need_no_change_are_not_added():
    """The reference alone has EYX = 0: aligning a machine with nothing but a constant EXX does not make up a curve."""
    machine = machine_of()
    nodes = machine.axes[0].nodes_mm
    table = ErrorTable({"EXX": Curve(nodes, 0.01 * np.sin(nodes / 50.0), 0 * nodes)})
    reference = ErrorTable({**table.curves, "EYX": Curve(nodes, 0 * nodes, 0 * nodes)})
    assert set(align(machine, table, reference).curves) == {"EXX"}


def distance_to(table, reference):
    """Square sum over the nodes, each curve with the same weight, 1 um (linear) as much as 1 urad (angular)."""
    parts = [
        (1.0 if error_named(name).kind == "linear" else 1000.0) ** 2
        * np.mean((table.curves[name].value - reference.curves[name].value) ** 2)
        for name in table.curves
    ]
    parts += [1e6 * (table.squareness[n][0] - reference.squareness[n][0]) ** 2 for n in table.squareness]
    return sum(parts)


def test_alignment_comes_as_close_as_the_gauge_allows():
    """A step along any gauge direction, either way, leads away from the reference."""
    machine = machine_of(tool_offset_mm=(20.0, -30.0, -150.0))
    names = observable_errors(machine)
    table, reference = table_of(machine, names), table_of(machine, names, seed=9)
    aligned = align(machine, table, reference)
    least = distance_to(aligned, reference)
    for direction in gauge_directions(machine, names):
        step = direction * 1e-6 / max(np.abs(direction[:, 0]).max(), 300.0 * np.abs(direction[:, 1]).max())
        assert distance_to(transformed(aligned, step), reference) > least
        assert distance_to(transformed(aligned, -step), reference) > least


def test_what_is_taken_out_along_the_gauge_leaves_the_least_of_the_conditions():
    """The part lies along the changes, is taken out once and for all, and no step along them leaves less."""
    generator = np.random.default_rng(3)
    changes, conditions = generator.normal(size=(30, 4)) * [1.0, 1e-3, 1e3, 1.0], generator.normal(size=(12, 30))
    changes[:, 3] = 2.0 * changes[:, 0]  # the same change twice
    part, values = gauge_part(changes, conditions), generator.normal(size=30)
    taken = part @ values
    amounts = np.linalg.lstsq(changes[:, :3], taken, rcond=None)[0]
    assert np.allclose(changes[:, :3] @ amounts, taken, rtol=0, atol=1e-10)
    assert np.allclose(part @ taken, taken, rtol=0, atol=1e-10)
    effect = conditions @ changes
    left = conditions @ (values - taken)
    assert np.abs(left @ effect / np.linalg.norm(effect, axis=0)).max() < 1e-10  # normal equations
    assert not gauge_part(changes, np.zeros((5, 30))).any()  # nothing that is to be small
