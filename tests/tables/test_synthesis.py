"""The wanted correction, and the tables that come closest to it."""

from dataclasses import replace

import numpy as np
import pytest

from compgen.controls import CONTROLLERS
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import CHAINS, Axis, Chain, Machine
from compgen.data.names import SQUARENESS_NAMES, error_named
from compgen.data.toml_files import Section
from compgen.errors import ConvergenceError
from compgen.kinematics import modelled_errors
from compgen.kinematics.exact_chain import exact_error, tip_position
from compgen.kinematics.many_points import VolumeGrid
from compgen.tables import projector, synthesize, wanted_correction
from compgen.tables.synthesis import error_at

PICOMETRE = 1e-9
NANOMETRE = 1e-6
MICROMETRE = 1e-3
EXAMPLE_SQUARENESS_RAD = 2.9e-3
ANCHORED = sorted(name for name, control in CONTROLLERS.items() if control.anchored)


def random_positions(machine, count=200, seed=1):
    return np.random.default_rng(seed).uniform(machine.lower_mm, machine.upper_mm, (count, 3))


def terms_of(name, machine, errors):
    control = CONTROLLERS[name]
    return control(machine).basis(errors)


def test_kept_results_are_those_of_the_same_numbers_and_no_others(small_machine, small_errors):
    position = random_positions(small_machine)
    curve = small_errors.curves["EAX"]
    longer = replace(small_machine, tool_offset_mm=(1.0, 2.0, 3.0))
    steeper = small_errors.replace(curves={**small_errors.curves, "EAX": replace(curve, value=1.5 * curve.value)})
    shifted = small_errors.replace(
        curves={**small_errors.curves, "EAX": replace(curve, position_mm=curve.position_mm + 5.0)}
    )
    leaning = small_errors.replace(squareness={**small_errors.squareness, "EC0Y": (1e-3, 0.0)})
    other_chain = replace(small_machine, chain=Chain("WXYFZT"))
    other_reference = replace(small_machine, squareness_reference="Y")
    calls = [
        *((small_machine, errors, position) for errors in (small_errors, steeper, shifted, leaning)),
        *((machine, small_errors, position) for machine in (longer, other_chain, other_reference)),
        (small_machine, small_errors, position + 1.0),
        (small_machine, small_errors, position, np.array([0.0, 0.0, -50.0])),
        (small_machine, small_errors, position, position),
    ]
    for _ in range(2):  # the second time they are known
        for call in calls:
            found = error_at(*call)
            assert np.array_equal(found, exact_error(*call))
            found[:] = np.nan  # a copy: nobody else sees this
    equal = small_errors.replace(
        curves={name: replace(item, value=item.value.copy()) for name, item in small_errors.curves.items()}
    )
    assert np.array_equal(
        error_at(small_machine, equal, position.copy()), exact_error(small_machine, small_errors, position)
    )


# --- the wanted correction -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chain", CHAINS)
def test_the_wanted_correction_puts_the_tip_where_it_was_told_to(chain, small_machine, make_errors):
    machine = Machine(
        "turned", Chain(chain), small_machine.axes, tool_offset_mm=(10.0, -20.0, -80.0), reference_point_mm=(0, 0, 0)
    )
    errors = make_errors(machine, squareness_rad=(EXAMPLE_SQUARENESS_RAD, -60e-6, 23e-6))
    position = random_positions(machine)
    moved = position + wanted_correction(machine, errors, position)
    tip = tip_position(machine, errors.at(moved), moved)
    assert np.max(np.abs(tip - position - np.array(machine.tool_offset_mm))) < PICOMETRE


def test_the_wanted_correction_of_a_squareness_is_that_of_the_triangle(small_machine):
    """Y stands at the angle c, so Y/cos(c) must be travelled along it, and X must give way by Y tan(c)."""
    errors = ErrorTable(squareness={"EC0Y": (EXAMPLE_SQUARENESS_RAD, 0.0)})
    position = random_positions(small_machine)
    y = position[:, 1]
    expected = np.column_stack(
        [y * np.tan(EXAMPLE_SQUARENESS_RAD), y / np.cos(EXAMPLE_SQUARENESS_RAD) - y, np.zeros_like(y)]
    )
    assert np.allclose(wanted_correction(small_machine, errors, position), expected, rtol=0, atol=PICOMETRE)


def test_errors_as_large_as_the_machine_are_refused(small_machine):
    with pytest.raises(ConvergenceError, match="too large"):
        wanted_correction(small_machine, ErrorTable(squareness={"EC0Y": (1.2, 0.0)}), random_positions(small_machine))


# --- least squares against a dense solution --------------------------------------------------------------------------


def dense_columns(basis, position_mm, tool_mm):
    """Design matrix (3 n, parameters), one unit value at a time; nodes that must be zero are left out."""
    columns = []
    for term in basis:
        field = np.zeros((len(position_mm), 3))
        for part in term.carrier:
            if part.lever is None:
                amount = np.ones(len(position_mm))
            else:
                amount = (
                    position_mm[:, part.lever] if part.lever < 3 else np.full(len(position_mm), tool_mm[part.lever - 3])
                )
            field[:, part.output] += part.sign * (amount - part.origin_mm)
        for k, node in enumerate(term.nodes_mm):
            zeros = [*term.zeros_mm, *([] if term.zero_at_mm is None else [term.zero_at_mm])]
            if any(abs(node - zero) < NANOMETRE for zero in zeros):
                continue
            unit = np.zeros(len(term.nodes_mm))
            unit[k] = 1.0
            along = np.ones(len(position_mm)) if term.axis is None else position_mm[:, term.axis]
            shape = unit if term.axis is None else np.interp(along, term.nodes_mm, unit)
            columns.append((field * np.reshape(shape, (-1, 1))).ravel())
    return np.column_stack(columns)


#: Controls that hold squareness alone, as shears about machine zero.
SHEARS = ("klipper", "linuxcnc-matrixkins", "marlin", "reprapfirmware", "ucnc")


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_the_tables_are_the_least_squares_optimum(name, small_machine, make_errors):
    errors = make_errors(small_machine, squareness_rad=(EXAMPLE_SQUARENESS_RAD, -60e-6, 23e-6))
    basis = terms_of(name, small_machine, errors)
    anchored = CONTROLLERS[name].anchored
    solver = projector(small_machine, basis, anchored=anchored)
    wanted = wanted_correction(small_machine, errors, solver.position_mm)
    dense = dense_columns(basis, solver.position_mm, small_machine.tool_offset_mm)
    offsets = np.tile(np.eye(3), (len(wanted), 1)) if anchored else np.zeros((wanted.size, 0))
    if name in SHEARS:  # nor may they take a rotation for a squareness
        turned = [np.cross(axis, solver.position_mm).ravel() / 1e3 for axis in np.eye(3)]
        offsets = np.hstack([offsets, np.array(turned).T])
    full = np.hstack([dense / np.maximum(np.linalg.norm(dense, axis=0), 1e-300), offsets])
    root = np.repeat(np.sqrt(solver.weight), 3)
    solution = np.linalg.lstsq(full * root[:, None], wanted.ravel() * root, rcond=1e-13)[0]
    fitted = (full[:, : dense.shape[1]] @ solution[: dense.shape[1]]).reshape(-1, 3)
    values = synthesize(small_machine, errors, basis, anchored=anchored)
    own = solver.field(np.concatenate([values[term.name] for term in basis]))
    assert np.max(np.abs(fitted)) > 1e-3
    miss = own - fitted
    if anchored:  # how a constant is shared between tables and offsets is no matter
        miss = miss - miss[0]
    assert np.max(np.abs(miss)) < NANOMETRE


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_the_field_on_a_grid_is_that_at_its_points(name, small_machine, small_errors):
    """Bit for bit: a table is looked up at the same numbers, and the sums have the same order."""
    solver = projector(small_machine, terms_of(name, small_machine, small_errors), anchored=CONTROLLERS[name].anchored)
    values = np.random.default_rng(2).normal(0.0, 1e-2, sum(len(term.nodes_mm) for term in solver.basis))
    levels = tuple(
        np.linspace(axis.range_mm[0] - 3.0, axis.range_mm[1] + 5.0, n)
        for axis, n in zip(small_machine.axes, (7, 4, 9), strict=True)
    )
    grid = VolumeGrid(levels)
    assert np.array_equal(solver.field_on_grid(values, grid), solver.field(values, grid.position_mm))


# --- where the volume leaves a choice --------------------------------------------------------------------------------


def test_zeros_of_the_fitted_curves_stay_where_there_is_a_choice(small_machine, small_errors):
    """A slope can stand in EYX or in EC0Y, an offset in any of EXX, EXY, EXZ: the fitted curves decide."""
    basis = terms_of("isg-csv", small_machine, small_errors)
    values = synthesize(small_machine, small_errors, basis, anchored=False)
    for term in basis:
        for where in term.keep_mm:
            assert abs(np.interp(where, term.nodes_mm, values[term.name])) < 20 * NANOMETRE, term.name
    assert any(len(term.keep_mm) == 2 for term in basis)


def test_values_that_nothing_determines_stay_at_their_start(small_machine, small_errors):
    """ECX has no lever arm with a tool on the Z axis of a WFYXZT machine: its column of C is zero."""
    curve = small_errors.curves["EXX"]
    idle = {**small_errors.curves, "ECX": curve}
    basis = terms_of("isg-csv", small_machine, small_errors.replace(curves=idle))
    values = synthesize(small_machine, small_errors.replace(curves=idle), basis, anchored=False)
    assert np.allclose(values["ECX"], curve.value, rtol=0, atol=NANOMETRE)


# --- anchored controls -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ANCHORED)
def test_anchored_tables_are_exactly_zero_at_the_reference_point(name, small_machine, small_errors):
    basis = terms_of(name, small_machine, small_errors)
    values = synthesize(small_machine, small_errors, basis, anchored=True)
    reference, tool = np.array([small_machine.reference_point_mm]), np.array(small_machine.tool_offset_mm)
    for term in basis:
        zero = reference.copy()
        if term.zero_at_mm is not None:  # a control may anchor its tables elsewhere
            zero[0, term.axis] = term.zero_at_mm
        if term.axis is None:  # a shear is anchored at machine zero
            zero[:] = 0.0
        added = term.carrier_field(zero, tool) * term.curve(values[term.name], zero)[:, None]
        at_node = term.zero_at_mm is None or np.any(term.nodes_mm == term.zero_at_mm)
        assert np.max(np.abs(added)) <= (0.0 if at_node else 1e-15)  # else interpolated between two nodes
        assert np.max(np.abs(values[term.name])) > (1e-3 if term.carrier[0].lever is None else 1e-6)


@pytest.mark.parametrize("name", ANCHORED)
def test_a_constant_offset_of_the_field_does_not_distort_anchored_tables(name, small_machine, small_errors):
    basis = terms_of(name, small_machine, small_errors)
    solver = projector(small_machine, basis, anchored=True)
    wanted = wanted_correction(small_machine, small_errors, solver.position_mm)
    shifted = wanted + np.array([0.05, -0.02, 0.03])
    start = np.concatenate([term.start for term in basis])
    change = solver.field(solver.project(shifted, start)) - solver.field(solver.project(wanted, start))
    assert np.max(np.abs(change)) < PICOMETRE


def test_a_field_that_a_basis_can_hold_is_returned_exactly(small_machine, small_errors):
    basis = terms_of("siemens-cec", small_machine, small_errors)
    solver = projector(small_machine, basis, anchored=False)
    values = np.concatenate([term.start for term in basis])
    wanted = solver.field(values)
    assert np.max(np.abs(solver.field(solver.project(wanted)) - wanted)) < NANOMETRE


def smooth_errors(machine, seed=4):
    """Smooth curves of some 10 um and 20 urad, in the gauge of the model, on many positions."""
    rng = np.random.default_rng(seed)
    curves = {}
    for name in modelled_errors(machine):
        if name in SQUARENESS_NAMES:
            continue
        error = error_named(name)
        low, high = machine.axes[error.axis].range_mm
        where = np.linspace(low, high, 41)
        s = (where - low) / (high - low)
        value = sum(rng.normal() * np.sin(np.pi * k * s) / k for k in (1, 2, 3))
        if not error.is_straightness:
            value = value - np.interp(machine.reference_point_mm[error.axis], where, value)
        curves[name] = Curve(where, value * (0.01 if error.kind == "linear" else 2e-5), np.zeros(41))
    return ErrorTable(curves, {name: (60e-6, 0.0) for name in SQUARENESS_NAMES})


@pytest.mark.parametrize("controller", ["siemens-eec", "fanuc-pitch"])
@pytest.mark.parametrize("reference_mm", [(13.7, 201.3, -77.7), (-299.0, 1.0, -399.0), (299.9, 499.9, -0.1)])
def test_nodes_beyond_the_travel_continue_the_curve(controller, reference_mm):
    axes = tuple(Axis(r, np.linspace(*r, 9)) for r in ((-300.0, 300.0), (0.0, 500.0), (-400.0, 0.0)))
    machine = Machine("m", Chain("WFYXZT"), axes, reference_point_mm=reference_mm)
    errors = smooth_errors(machine)
    control = CONTROLLERS[controller]
    basis = control(machine).basis(errors)
    values = synthesize(machine, errors, basis, anchored=True)
    for term in basis:
        steps = np.abs(np.diff(values[term.name]))
        assert max(steps[0], steps[-1]) < 2.0 * np.max(steps[1:-1]) + 1e-5, term.name


def test_the_lever_of_an_axis_own_travel_is_held_between_the_nodes():
    axes = tuple(Axis(r, np.linspace(*r, 6)) for r in ((-300.0, 900.0), (0.0, 800.0), (-400.0, 0.0)))
    machine = Machine("m", Chain("WXYFZT"), axes, reference_point_mm=(0.0, 0.0, 0.0))
    settings = Section({"sign": "error", "mult_mode": "S1"}, path=None, name="controllers.siemens-cec")
    machine = replace(machine, controllers={"siemens-cec": settings})
    nodes = axes[0].nodes_mm
    value = 60e-6 * np.sin(nodes / 170.0)
    errors = ErrorTable({"ECX": Curve(nodes, value - np.interp(0.0, nodes, value), np.zeros(6))})
    control = CONTROLLERS["siemens-cec"]
    basis = control(machine).basis(errors)
    solver = projector(machine, basis, anchored=False)
    wanted = wanted_correction(machine, errors, solver.position_mm)
    rest = wanted - solver.field(solver.project(wanted), solver.position_mm)
    assert np.max(np.abs(wanted)) > 0.03
    assert np.max(np.abs(rest)) < 0.3 * MICROMETRE
