"""SINUMERIK tables: golden files, signs by hand, folding, limits, malformed text."""

import re
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgen.controls import SourceFile, controller_named
from compgen.controls.shared.base import Monomial, Term
from compgen.controls.siemens_cec import CecTables
from compgen.controls.siemens_cec_tables import (
    CecTable,
    around_kept,
    folded_tables,
    reversal_statement,
    sum_into_axes,
    term_names,
    with_reversal_tables,
)
from compgen.controls.siemens_machine_data import (
    cec_overwrites,
    cec_reservations,
    cec_usage,
    cec_warnings,
    largest_slopes,
    largest_sums,
    set_violations,
    stated_limit_violations,
)
from compgen.controls.siemens_text import LinearTable
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import CHAINS, Machine, read_machine
from compgen.data.names import CURVE_NAMES, error_named
from compgen.errors import CompgenWarning, InputError
from compgen.kinematics.many_points import volumetric_error
from compgen.tables import export, read_tables, verify
from compgen.tables.render import load_format, render, render_files

GOLDEN = Path(__file__).parents[1] / "golden"
NANOMETRE = 1e-6  # mm
ARITHMETIC = 1e-12  # mm, rounding of doubles

MACHINE = """
name = "lopsided"
chain = "{chain}"
tool_offset_mm = [12.0, -7.0, 150.0]
reference_point_mm = [-200.0, 55.5, 300.0]
[axes.X]
range_mm = [-730.5, 120.0]
nodes = 8
[axes.Y]
range_mm = [-100.0, 415.3]
nodes = 6
[axes.Z]
range_mm = [50.0, 640.0]
nodes = 5
"""
#: Own steps for encoder tables: the random curves have no wide grid through the reference point.
STEPS = "step_mm = { X = 10.0, Y = 12.5, Z = 7.3 }"
PLACES = {"tool_offset_mm": ["0", "0", "0"], "reference_point_mm": ["0", "0", "0"]}
COMMON = {
    **PLACES,
    "version": "1",
    "machine_name": "lopsided",
    "chain": "WFYXZT",
    "inputs": ["a"],
    "input_sha256": "0" * 64,
}


def make_machine(folder: Path, own: str = "", chain: str = "WFYXZT", control: str = "siemens-cec") -> Machine:
    path = folder / "machine.toml"
    path.write_text(MACHINE.format(chain=chain) + f"[controllers.{control}]\n{own}\n")
    return read_machine(path)


def simple_machine(folder: Path, own: str, control: str) -> Machine:
    """A machine whose axes are named as in the golden files and run from -1000 to 1000 mm."""
    axes = "".join(f"[axes.{axis}]\nrange_mm = [-1000.0, 1000.0]\nnodes = 3\n" for axis in "XYZ")
    path = folder / "simple.toml"
    path.write_text(f'name = "simple"\nchain = "WFYXZT"\n{axes}[controllers.{control}]\n{own}\n')
    return read_machine(path)


def random_errors(machine: Machine, seed: int = 5) -> ErrorTable:
    """All 18 curves, at the nodes that an equidistant table over the travel has, and three squareness errors."""
    rng = np.random.default_rng(seed)
    curves = {}
    for name in CURVE_NAMES:
        error = error_named(name)
        nodes = machine.axes[error.axis].nodes_mm
        size = 0.02 if error.kind == "linear" else 3e-5
        curves[name] = Curve(nodes, size * rng.uniform(-1, 1, len(nodes)), np.full(len(nodes), np.nan))
    return ErrorTable(curves, {"EC0Y": (4e-5, 0.0), "EB0Z": (-7e-5, 0.0), "EA0Z": (2e-5, 0.0)})


def rendered(control, machine, own, tables) -> str:
    context = {**COMMON, **control(machine, own).context(tables)}
    (text,) = render_files(load_format(control.name), context).values()
    return text


def parsed(control, machine, own, text):
    return control(machine, own).parse([SourceFile(Path("t.ini"), text)])


def grid_points(machine: Machine, counts=(8, 6, 5)) -> Points:
    along = [np.linspace(*axis.range_mm, n) for axis, n in zip(machine.axes, counts, strict=True)]
    return Points(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3))


def random_points(machine: Machine, count: int = 400) -> Points:
    return Points(np.random.default_rng(11).uniform(machine.lower_mm, machine.upper_mm, (count, 3)))


def term_model(machine, basis, values, points) -> np.ndarray:
    """Sum of carrier times interpolated value: np.interp here, not the interpolation of the package."""
    field = np.zeros((len(points), 3))
    for term in basis:
        curve = np.interp(points.position_mm[:, term.axis], term.nodes_mm, values[term.name])
        field += term.carrier_field(points.position_mm, np.array(machine.tool_offset_mm)) * curve[:, None]
    return field


# --- encoder compensation ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "position_mm", "value_mm"),
    [
        ("manual_p242.ini", [-200, -199.5, -199, -198.25, -198, 600], [0.003, 0.0065, 0.010, 0.0115, 0.012, 0.0]),
        ("five_nodes.ini", [25, 125, 250], [0.002, 0.004, 0.0]),
    ],
)
def test_encoder_tables_of_the_manual_move_the_axis_by_minus_their_value(tmp_path, name, position_mm, value_mm):
    machine = simple_machine(tmp_path, 'axis_names = { X = "X1" }', "siemens-eec")
    control = controller_named("siemens-eec")
    own = control.read_settings(machine)
    tables = parsed(control, machine, own, (GOLDEN / "siemens-eec" / name).read_text())
    points = Points(np.array([[x, 7.0, 8.0] for x in position_mm]))
    expected = np.zeros((len(position_mm), 3))
    expected[:, 0] = -np.array(value_mm)
    np.testing.assert_allclose(control(machine, own).emulate(tables, points), expected, atol=ARITHMETIC)


def test_encoder_example_of_the_manual_needs_801_nodes_and_6408_bytes(tmp_path):
    machine = simple_machine(tmp_path, 'axis_names = { X = "X1" }', "siemens-eec")
    control = controller_named("siemens-eec")
    own = control.read_settings(machine)
    tables = parsed(control, machine, own, (GOLDEN / "siemens-eec" / "manual_p242.ini").read_text())
    row = control(machine, own).context(tables)["parameters"][0]
    assert row["name"] == "MD38000 $MA_MM_ENC_COMP_MAX_POINTS[0,X1]"
    assert row["value"] == ">= 801"
    assert "6408 bytes" in row["meaning"]


def test_an_axis_that_goes_too_far_gets_a_positive_table_value_and_is_pulled_back(tmp_path):
    machine = simple_machine(tmp_path, "", "siemens-eec")
    nan = np.full(3, np.nan)
    errors = ErrorTable({"EXX": Curve(np.array([-1000.0, 0.0, 1000.0]), np.array([0.0, 0.0, 0.010]), nan)})
    control = controller_named("siemens-eec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(errors)
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    text = rendered(control, machine, own, tables)
    assert "$AA_ENC_COMP[0,2,AX1]=0.010000\n" in text
    points = Points(np.array([[1000.0, 0.0, 0.0]]))
    correction = control(machine, own).emulate(parsed(control, machine, own, text), points)
    np.testing.assert_allclose(correction, [[-0.010, 0.0, 0.0]], atol=ARITHMETIC)
    statement = control(machine, own).context(tables)["sign_statement"]
    assert (
        "at X = 1000.000 mm the table value is +0.010000 mm, so the control moves the axis AX1 by -0.010000 mm"
        in statement
    )


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
@pytest.mark.parametrize("own", [STEPS, "encoder = 1\ndecimals = 4\nstep_mm = { X = 42.25, Y = 0.7, Z = 59.0 }"])
def test_encoder_tables_survive_the_text_and_act_as_the_term_model(tmp_path, chain, own):
    machine = make_machine(tmp_path, own, chain, "siemens-eec")
    control = controller_named("siemens-eec")
    settings_ = control.read_settings(machine)
    basis = control(machine, settings_).basis(random_errors(machine))
    values = {term.name: term.start for term in basis}
    tables = control(machine, settings_).build(basis, values)
    again = parsed(control, machine, settings_, rendered(control, machine, settings_, tables))
    assert again == tables
    assert control(machine, settings_).violations(again) == []
    points = random_points(machine)
    difference = control(machine, settings_).emulate(again, points) - term_model(machine, basis, values, points)
    assert np.max(np.abs(difference)) <= control(machine, settings_).resolution_mm() + ARITHMETIC
    reference = Points(np.array([machine.reference_point_mm]))
    assert np.all(control(machine, settings_).emulate(again, reference) == 0.0)


def test_nodes_of_every_encoder_table_meet_the_last_position_exactly(tmp_path):
    machine = make_machine(tmp_path, STEPS, control="siemens-eec")
    control = controller_named("siemens-eec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    for table in parsed(control, machine, own, rendered(control, machine, own, tables)).tables.values():
        steps = (table.last_mm - table.start_mm) / table.step_mm
        assert steps == len(table.values) - 1
        assert table.start_mm + int(steps) * table.step_mm == table.last_mm


def test_encoder_tables_that_are_short_long_or_uneven_are_violations(tmp_path):
    machine = simple_machine(tmp_path, 'axis_names = { X = "X1" }\nmax_points = 4', "siemens-eec")
    control = controller_named("siemens-eec")
    own = control.read_settings(machine)
    text = (GOLDEN / "siemens-eec" / "five_nodes.ini").read_text().replace("MAX[0,X1]=200.0", "MAX[0,X1]=201.0")
    found = control(machine, own).violations(parsed(control, machine, own, text))
    assert len(found) == 3
    assert "never meets MAX" in found[0]
    assert "has 5 nodes; the control takes at most 4" in found[1]
    assert "covers 0 ... 201 mm of X; the travel is -1000 ... 1000 mm" in found[2]


# --- cross-error compensation: golden ------------------------------------------------------------------------------


@pytest.mark.parametrize(("sign", "factor"), [("error", -1.0), ("correction", 1.0)])
def test_two_cross_tables_add_up_to_the_sums_worked_by_hand(tmp_path, sign, factor):
    machine = simple_machine(tmp_path, f'sign = "{sign}"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    tables = parsed(control, machine, own, (GOLDEN / "siemens-cec" / "two_tables.ini").read_text())
    points = Points(np.array([[375.0, -400.0, 0.0], [900.0, 100.0, 0.0], [900.0, 500.0, 0.0]]))
    totals = np.array([[-0.012, 0.0, 0.002], [0.003, 0.0, 0.0], [0.012, 0.0, 0.0]])
    np.testing.assert_allclose(control(machine, own).emulate(tables, points), factor * totals, atol=ARITHMETIC)


def constant(index: int, value: str, multiplier: int = 0, axes=("AX1", "AX1"), extra: str = "") -> str:
    """A table of one value over the travel of the simple machine."""
    lines = [
        f"$AN_CEC[{index},0]={value}",
        f"$AN_CEC[{index},1]={value}",
        f"$AN_CEC_INPUT_AXIS[{index}]=({axes[0]})",
        f"$AN_CEC_OUTPUT_AXIS[{index}]=({axes[1]})",
        f"$AN_CEC_STEP[{index}]=2000.0",
        f"$AN_CEC_MIN[{index}]=-1000.0",
        f"$AN_CEC_MAX[{index}]=1000.0",
        f"$AN_CEC_DIRECTION[{index}]=0",
        f"$AN_CEC_MULT_BY_TABLE[{index}]={multiplier}",
        f"$AN_CEC_IS_MODULO[{index}]=0",
    ]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("mode", "total_mm"), [("S1", 0.56), ("S2", 0.06), ("S3", 0.26), ("S4", 0.36)])
def test_constants_tell_the_four_readings_of_the_product_apart(tmp_path, mode, total_mm):
    machine = simple_machine(tmp_path, f'sign = "correction"\nmult_mode = "{mode}"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    tables = parsed(control, machine, own, constant(0, "0.2", 2) + constant(1, "0.3") + "M17\n")
    moved = control(machine, own).emulate(tables, Points(np.zeros((1, 3))))
    np.testing.assert_allclose(moved, [[total_mm, 0.0, 0.0]], atol=ARITHMETIC)
    assert f'| {total_mm:.2f} | `mult_mode = "{mode}"` |' in preflight(control, machine, own, tables)


def preflight(control, machine, own, tables) -> str:
    context = {**COMMON, **control(machine, own).context(tables), "files": [{"name": "f", "sha256": "0"}]}
    return render(load_format(control.name), "preflight.md.j2", context)


def test_balanced_scale_of_the_example_is_5000():
    """sqrt(500 mm / 20e-6 rad) = 5000 mm: the scaled angle and the scaled lever are both 0.1 mm at most."""
    terms = [
        Term("X(z)", 2, np.array([0.0, 500.0]), (Monomial(0),), np.zeros(2)),
        Term("X(x)*z", 0, np.array([0.0, 100.0]), (Monomial(0, 1, 2, 0.0),), np.array([0.0, 20e-6])),
    ]
    tables = folded_tables(terms, {term.name: term.start for term in terms}, flip=False, mode="S2")
    angles, lever = (tables[index].table.numbers for index in (0, 1))
    assert angles.max() / 20e-6 == pytest.approx(5000.0, rel=1e-12)
    assert 500.0 / lever.max() == pytest.approx(5000.0, rel=1e-12)
    np.testing.assert_allclose([angles.max(), lever.max()], 0.1, rtol=1e-12)


@pytest.mark.parametrize("mode", ["S1", "S2", "S3", "S4"])
@pytest.mark.parametrize("sign", ["error", "correction"])
def test_folded_products_are_angle_times_lever_worked_by_hand(tmp_path, mode, sign):
    machine = simple_machine(tmp_path, f'sign = "{sign}"\nmult_mode = "{mode}"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    x, z = np.array([0.0, 100.0, 200.0, 300.0]), np.array([0.0, 125.0, 250.0, 375.0, 500.0])
    basis = [
        Term("X(x)", 0, x, (Monomial(0),), np.zeros(4)),
        Term("X(z)", 2, z, (Monomial(0),), np.zeros(5)),
        Term("X(x)*z", 0, x, (Monomial(0, 1, 2, 0.0),), np.array([0.0, 4e-6, 10e-6, -20e-6])),
    ]
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    text = rendered(control, machine, own, tables)
    again = parsed(control, machine, own, text)
    points = Points(np.array([[50.0, 0.0, 300.0], [100.0, 0.0, 300.0], [150.0, 0.0, 250.0], [300.0, 0.0, 500.0]]))
    moved = control(machine, own).emulate(again, points)
    np.testing.assert_allclose(moved[:, 0], [0.0006, 0.0012, 0.00175, -0.01], atol=1e-3 * NANOMETRE)
    assert not np.any(moved[:, 1:])
    factors = [entry for entry in again.tables.values() if len(entry.table.values) == 2 or entry.multiplier]
    assert [float(np.max(np.abs(entry.table.numbers))) for entry in factors] == pytest.approx([0.1, 0.1], abs=1e-9)
    assert len(again.tables) == {"S1": 4, "S2": 2, "S3": 3, "S4": 3}[mode]


def test_only_the_angle_and_its_fold_change_sign_with_the_convention(tmp_path):
    x, z = np.array([0.0, 100.0, 200.0]), np.array([0.0, 500.0])
    terms = [
        Term("X(x)", 0, x, (Monomial(0),), np.zeros(3)),
        Term("X(z)", 2, z, (Monomial(0),), np.zeros(2)),
        Term("X(x)*z", 0, x, (Monomial(0, 1, 2, 0.0),), np.array([0.0, 4e-6, -2e-6])),
    ]
    values = {term.name: term.start for term in terms}
    plain = folded_tables(terms, values, flip=False, mode="S1")
    flipped = folded_tables(terms, values, flip=True, mode="S1")
    for index, changes in [(0, True), (1, False), (2, True), (3, False)]:
        factor = -1 if changes else 1
        assert [factor * value for value in plain[index].table.values] == list(flipped[index].table.values)
    assert plain[2].multiplier == 4


def test_the_fold_cancels_the_scaled_angle_to_the_last_decimal(tmp_path):
    machine = make_machine(tmp_path, 'sign = "correction"\nmult_mode = "S1"')
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    angle = next(term for term in basis if term.name == "X(x)*z")
    values = {term.name: angle.start if term is angle else 0.0 * term.start for term in basis}
    tables = control(machine, own).build(basis, values).tables
    fold, scaled = tables[0], tables[2]
    assert scaled.multiplier == 4
    assert [-value for value in fold.table.values] == list(scaled.table.values)


# --- cross-error compensation: whole machine -----------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["S1", "S2", "S3", "S4"])
@pytest.mark.parametrize(("sign", "style"), [("error", "paren"), ("correction", "quote")])
@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
def test_cross_tables_survive_the_text_and_act_as_the_term_model(tmp_path, mode, sign, style, chain):
    machine = make_machine(tmp_path, f'sign = "{sign}"\nmult_mode = "{mode}"\naxis_style = "{style}"', chain)
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    values = {term.name: term.start for term in basis}
    tables = control(machine, own).build(basis, values)
    text = rendered(control, machine, own, tables)
    again = parsed(control, machine, own, text)
    assert again == tables
    assert ("[0]=(AX1)" in text) == (style == "paren")
    assert len(again.tables) == 19  # 9 ordinary, 6 angles, 4 levers
    assert control(machine, own).violations(again) == []
    points = random_points(machine)
    difference = control(machine, own).emulate(again, points) - term_model(machine, basis, values, points)
    assert np.max(np.abs(difference)) <= 1.5 * NANOMETRE + 1e-8
    assert control(machine, own).resolution_mm() >= 1.5 * NANOMETRE + 1e-8


@pytest.mark.parametrize("chain", CHAINS)
def test_the_tables_of_all_21_errors_take_the_error_out_at_every_node(tmp_path, chain):
    machine = make_machine(tmp_path, 'sign = "error"\nmult_mode = "S1"', chain)
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    errors = random_errors(machine)
    basis = control(machine, own).basis(errors)
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    again = parsed(control, machine, own, rendered(control, machine, own, tables))
    points = grid_points(machine)
    before = volumetric_error(machine, errors, points.position_mm)
    after = before + control(machine, own).emulate(again, points)
    assert np.max(np.abs(before)) > 0.02
    assert np.max(np.abs(after)) <= control(machine, own).resolution_mm()


@pytest.mark.parametrize(("sign", "slope"), [("error", -1), ("correction", 1)])
def test_squareness_makes_a_line_of_the_sign_worked_by_hand(tmp_path, sign, slope):
    """EC0Y > 0 gives dX = -EC0Y Y; at Y = 1000 mm the tool is 40 um too low in X, so +40 um must be added."""
    machine = simple_machine(tmp_path, f'sign = "{sign}"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(ErrorTable(squareness={"EC0Y": (4e-5, 0.0)}))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    text = rendered(control, machine, own, tables)
    assert len(tables.tables) == 1
    assert f"$AN_CEC[0,1]={slope * 0.04:.6f}\n" in text
    assert "$AN_CEC_INPUT_AXIS[0]=(AX2)\n$AN_CEC_OUTPUT_AXIS[0]=(AX1)\n" in text
    assert f"$AN_CEC[0,0]={-slope * 0.04:.6f}\n" in text
    moved = control(machine, own).emulate(parsed(control, machine, own, text), Points(np.array([[0.0, 1000.0, 0.0]])))
    np.testing.assert_allclose(moved, [[0.04, 0.0, 0.0]], atol=ARITHMETIC)
    verb = {"error": "SUBTRACTS", "correction": "ADDS"}[sign]
    assert verb in control(machine, own).context(tables)["sign_statement"]


def test_without_products_there_are_nine_tables_and_no_multiplier(tmp_path):
    machine = make_machine(tmp_path, 'sign = "error"\nproducts = false')
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis}).tables
    assert len(tables) == 9
    assert {(entry.output_axis, entry.input_axis) for entry in tables.values()} == set(product(range(3), repeat=2))
    assert not any(entry.multiplier for entry in tables.values())


def test_tables_of_zeros_are_left_out_but_one_remains(tmp_path):
    machine = make_machine(tmp_path, 'sign = "error"\nmult_mode = "S1"')
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tiny = {term.name: np.full(len(term.nodes_mm), 4e-7 if term.carrier[0].lever is None else 5e-13) for term in basis}
    tables = control(machine, own).build(basis, tiny)
    assert [(entry.output_axis, entry.input_axis) for entry in tables.tables.values()] == [(0, 0)]
    assert parsed(control, machine, own, rendered(control, machine, own, tables)) == tables


def test_tables_of_different_outputs_share_no_lever(tmp_path):
    machine = make_machine(tmp_path, 'sign = "error"\nmult_mode = "S1"', "WXYFZT")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis}).tables
    products = [entry for entry in tables.values() if entry.multiplier]
    assert len(products) == 6
    for entry in products:
        lever = tables[entry.multiplier - 1]
        assert lever.output_axis == entry.output_axis
        assert len(lever.table.values) == 2
        assert lever.table.start_mm == Decimal(repr(machine.axes[lever.input_axis].range_mm[0]))


def table_of(output: int, axis: int, number: float, multiplier: int = 0, direction: int = 0) -> CecTable:
    """A table of one value from -1 to 1 mm of its input axis."""
    linear = LinearTable(Decimal(-1), Decimal(2), Decimal(1), (Decimal(str(number)),) * 2)
    return CecTable(axis, output, linear, direction, multiplier)


#: X(x) for one direction, X(z), the scaled angle X(y) with the lever z of X, and that lever.
MIXED = {0: table_of(0, 0, 0.1, 0, 1), 2: table_of(0, 2, 0.2), 3: table_of(0, 1, 0.3, 6), 5: table_of(0, 2, 0.4)}


def test_tables_around_kept_ones_keep_their_order_and_their_multiplier():
    moved = around_kept(MIXED, {1, 2, 4})
    assert {index: float(entry.table.values[0]) for index, entry in moved.items()} == {0: 0.1, 3: 0.2, 5: 0.3, 6: 0.4}
    assert {index: entry.multiplier for index, entry in moved.items()} == {0: 0, 3: 0, 5: 7, 6: 0}


def test_tables_are_the_terms_of_both_directions_and_their_products():
    assert term_names(MIXED) == {"X(z)", "X(y)*z"}
    assert term_names({index: MIXED[index] for index in (3, 5)}) == {"X(y)*z"}  # a factor is no term of its own
    assert term_names({0: table_of(1, 0, 0.1, direction=-1)}) == set()


@pytest.mark.parametrize(("mode", "total"), [("S1", 1.12), ("S2", 0.42), ("S3", 0.72), ("S4", 0.82)])
def test_factors_act_as_the_mode_has_them_whatever_the_order_of_their_indices(mode, total):
    """0.1 + 0.2 + 0.3 x 0.4, and what the mode leaves of 0.3 and 0.4."""
    turned = {0: table_of(0, 2, 0.4), 3: table_of(0, 1, 0.3, 1), 4: table_of(0, 2, 0.2), 7: table_of(0, 0, 0.1)}
    for tables in (MIXED, turned):
        sums = sum_into_axes(tables, mode, {index: entry.at(np.zeros(1)) for index, entry in tables.items()})
        assert sums[0] == pytest.approx([total])
        assert not np.any(sums[1]) and not np.any(sums[2])


@pytest.mark.parametrize(("angle_rad", "written"), [(0.9e-9, False), (1.1e-9, True)])
def test_a_product_below_half_of_the_last_decimal_is_left_out(angle_rad, written):
    """The lever goes from -250 to 500 mm around its origin: 0.5 nm are reached at 1e-9 rad."""
    x, z = np.array([0.0, 100.0]), np.array([0.0, 750.0])
    product_term = Term("X(x)*z", 0, x, (Monomial(0, 1, 2, 250.0),), np.array([0.0, angle_rad]))
    straight = Term("X(z)", 2, z, (Monomial(0),), np.array([0.001, 0.0]))
    terms = [straight, product_term]
    tables = folded_tables(terms, {term.name: term.start for term in terms}, flip=False, mode="S2")
    assert any(entry.multiplier for entry in tables.values()) is written


@pytest.mark.parametrize("largest_rad", [1.7e-5, 2.3e-5, 7.1e-5])
def test_the_fold_of_a_lever_is_the_nearest_to_its_line_in_the_last_decimal(largest_rad):
    """What the control makes of the two nodes of the lever between them, and the table that cancels it at its own."""
    x, z = np.array([0.0, 100.0]), np.array([-70.0, 20.0, 110.0, 200.0, 290.0])
    terms = [
        Term("X(z)", 2, z, (Monomial(0),), np.zeros(5)),
        Term("X(x)*z", 0, x, (Monomial(0, 1, 2, 0.0),), np.array([0.0, largest_rad])),
    ]
    fold, _, lever = folded_tables(terms, {t.name: t.start for t in terms}, flip=False, mode="S4").values()
    first, last = (int(value * 10**9) for value in lever.table.values)
    for place, value in enumerate(fold.table.values):
        exact = Fraction(first) + Fraction(place, 4) * (last - first)
        assert abs(int(value * 10**9) + exact) <= Fraction(1, 2)


@pytest.mark.parametrize(("sign", "plus"), [("error", +0.004), ("correction", -0.004)])
def test_a_reversal_is_a_pair_of_halves_that_says_when_it_acts(tmp_path, sign, plus):
    """+8 um: the tool is 4 um too far after positive travel; an error table holds +4 um there, a correction -4 um."""
    machine = make_machine(tmp_path, f'sign = "{sign}"\nmult_mode = "S1"')
    reversal = ReversalCurves({(1, 2): Curve(np.zeros(1), np.array([0.008]), np.zeros(1))})
    options = {"subtracts": sign == "error", "max_points": 100, "step_mm": (None, None, None)}
    pair = with_reversal_tables(machine, {}, reversal, **options)
    assert {index: (entry.direction, entry.input_axis, entry.output_axis) for index, entry in pair.items()} == {
        0: (1, 1, 2),
        1: (-1, 1, 2),
    }
    assert [entry.table.numbers.tolist() for entry in pair.values()] == [[plus] * 2, [-plus] * 2]
    assert [entry.label for entry in pair.values()] == [
        f"reversal Y in Z, after {words} travel of Y" for words in ("positive", "negative")
    ]
    assert pair[0].table.nodes_mm.tolist() == list(machine.axes[1].range_mm)
    behind = with_reversal_tables(machine, {0: MIXED[0], 4: MIXED[2]}, reversal, **options)
    assert sorted(behind) == [0, 4, 5, 6]
    names = ("AX1", "AX2", "AX3")
    assert reversal_statement(pair, names) == (
        f" Direction: table 0 acts only after positive travel of AX2 and adds {plus:+.6f} mm (its largest value) to the sum "
        "of AX3; its partner with DIRECTION -1 adds the opposite after negative travel."
    )
    assert reversal_statement({2: MIXED[2]}, names) == ""
    tiny = ReversalCurves({(1, 2): Curve(np.zeros(1), np.array([0.00009]), np.zeros(1))})
    assert with_reversal_tables(machine, {}, tiny, **options) == {}


# --- cross-error compensation: run-time rules ----------------------------------------------------------------------


@pytest.fixture
def simple(tmp_path):
    def make(own: str = ""):
        machine = simple_machine(tmp_path, f'sign = "correction"\nmult_mode = "S1"\n{own}', "siemens-cec")
        control = controller_named("siemens-cec")
        return machine, control, control.read_settings(machine)

    return make


def test_a_table_for_one_direction_acts_only_after_travel_in_that_direction(simple):
    machine, control, own = simple()
    text = constant(0, "0.01").replace("DIRECTION[0]=0", "DIRECTION[0]=1")
    text += constant(1, "-0.03").replace("DIRECTION[1]=0", "DIRECTION[1]=-1")
    tables = parsed(control, machine, own, text + "M17\n")
    points = Points(np.zeros((2, 3)), approach=np.array([[1.0, -1.0, -1.0], [-1.0, 1.0, 1.0]]))
    np.testing.assert_array_equal(control(machine, own).emulate(tables, points)[:, 0], [0.01, -0.03])
    with pytest.warns(CompgenWarning, match="approach_x"):
        moved = control(machine, own).emulate(tables, Points(np.zeros((1, 3)), approach=np.zeros((1, 3))))
    assert not np.any(moved)
    with pytest.warns(CompgenWarning, match="taken as inactive there"):
        assert not np.any(control(machine, own).emulate(tables, Points(np.zeros((1, 3)))))


def test_tables_of_opposite_directions_never_add_up_in_the_largest_sum(simple):
    machine, control, own = simple()
    text = constant(0, "0.01").replace("DIRECTION[0]=0", "DIRECTION[0]=1")
    text += constant(1, "0.03").replace("DIRECTION[1]=0", "DIRECTION[1]=-1")
    tables = parsed(control, machine, own, text + constant(2, "-0.1") + "M17\n")
    assert largest_sums(machine, tables.tables, "S1")[0][0] == pytest.approx(-0.09, abs=ARITHMETIC)
    turned = parsed(control, machine, own, text.replace("=0.03", "=-0.03") + constant(2, "-0.1") + "M17\n")
    assert largest_sums(machine, turned.tables, "S1")[0][0] == pytest.approx(-0.13, abs=ARITHMETIC)


@pytest.mark.parametrize(("sign", "moved"), [("error", "-0.050000"), ("correction", "+0.050000")])
def test_the_sign_statement_says_where_the_axis_goes(tmp_path, sign, moved):
    machine = simple_machine(tmp_path, f'sign = "{sign}"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    tables = parsed(control, machine, own, constant(0, "0.05") + "M17\n")
    statement = control(machine, own).context(tables)["sign_statement"]
    assert f"the sum into AX1 is +0.050000 mm, so the control moves the axis by {moved} mm" in statement
    assert f'| {moved[:-3]} mm | `sign = "{sign}"` |' in preflight(control, machine, own, tables)


def test_a_cyclic_table_repeats(simple):
    machine, control, own = simple()
    nodes = "$AN_CEC[0,0]=0.0\n$AN_CEC[0,1]=0.02\n$AN_CEC[0,2]=0.04\n$AN_CEC[0,3]=0.0\n"
    text = constant(0, "0").partition("$AN_CEC_INPUT")[2]
    text = (
        nodes + "$AN_CEC_INPUT" + text.replace("2000.0", "10.0").replace("=-1000.0", "=0.0").replace("=1000.0", "=30.0")
    )
    text = text.replace("MODULO[0]=0", "MODULO[0]=1") + "M17\n"
    tables = parsed(control, machine, own, text)
    points = Points(np.array([[5.0, 0, 0], [35.0, 0, 0], [-15.0, 0, 0], [30.0, 0, 0]]))
    moved = control(machine, own).emulate(tables, points)[:, 0]
    np.testing.assert_allclose(moved, [0.01, 0.01, 0.03, 0.0], atol=ARITHMETIC)
    assert control(machine, own).violations(tables) == []
    uneven = parsed(control, machine, own, text.replace("[0,3]=0.0", "[0,3]=0.1"))
    assert "first and last value differ" in control(machine, own).violations(uneven)[0]


@pytest.mark.parametrize("stated", ["0.5", "{ X = 0.5, Y = 1.0, Z = 1.0 }"])
def test_a_stated_limit_of_the_sum_clips_and_is_a_violation(simple, stated):
    machine, control, own = simple(f"max_sum_mm = {stated}")
    tables = parsed(control, machine, own, constant(0, "-0.2") + constant(1, "-0.4", axes=("AX2", "AX1")) + "M17\n")
    assert control(machine, own).emulate(tables, Points(np.zeros((1, 3))))[0, 0] == -0.5
    (found,) = control(machine, own).violations(tables)
    assert "the sum into AX1 reaches -0.600000 mm" in found
    assert "MD32720 clips it at 0.5 mm" in found


def test_an_unstated_limit_is_a_value_to_set_and_a_warning_above_the_usual_one(simple):
    machine, control, own = simple()
    tables = parsed(control, machine, own, constant(0, "0.7") + constant(1, "0.5", axes=("AX2", "AX1")) + "M17\n")
    assert control(machine, own).violations(tables) == []
    context = control(machine, own).context(tables)
    values = {row["name"]: row["value"] for row in context["parameters"]}
    assert values["MD32720 $MA_CEC_MAX_SUM[AX1]"] == ">= 1.2000 mm"
    assert values["MD18342 $MN_MM_CEC_MAX_POINTS[1]"] == "2"
    assert any("the usual MD32720 is 1 mm" in warning for warning in context["warnings"])
    assert any("at the reference point is +1.200000 mm" in warning for warning in context["warnings"])


def test_largest_sum_of_a_product_stands_in_the_corner_found_by_brute_force(tmp_path):
    machine = make_machine(tmp_path, 'sign = "correction"\nmult_mode = "S1"', "WXYFZT")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    sums = largest_sums(machine, tables.tables, "S1")
    along = [
        np.concatenate([item.table.nodes_mm for item in tables.tables.values() if item.input_axis == axis])
        for axis in range(3)
    ]
    along = [np.unique(np.clip(values, *axis.range_mm)) for values, axis in zip(along, machine.axes, strict=True)]
    field = control(machine, own).emulate(
        tables, Points(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1).reshape(-1, 3))
    )
    np.testing.assert_allclose([abs(value) for value, _ in sums], np.max(np.abs(field), axis=0), rtol=1e-9)
    for output, (value, place) in enumerate(sums):
        moved = control(machine, own).emulate(tables, Points(np.array([place])))
        assert moved[0, output] == pytest.approx(value, rel=1e-9)


def test_the_rate_of_change_is_the_slope_of_the_sum(simple):
    machine, control, own = simple()
    tables = parsed(control, machine, own, (GOLDEN / "siemens-cec" / "two_tables.ini").read_text())
    slopes = largest_slopes(machine, tables.tables, "S1")
    expected = np.zeros((3, 3))
    expected[2, 0] = 0.005 / 250.0
    expected[0, 1] = 0.024 / 800.0
    np.testing.assert_allclose(slopes, expected, atol=1e-15)
    rows = {row["name"]: row for row in control(machine, own).context(tables)["parameters"]}
    assert rows["MD32730 $MA_CEC_MAX_VELO[AX1]"]["value"] == ">= 0.0030 %"
    assert rows["MD32730 $MA_CEC_MAX_VELO[AX3]"]["value"] == ">= 0.0020 %"


def test_folds_do_not_count_in_the_rate_because_the_control_limits_the_sum(simple):
    machine, _, _ = simple()
    x, z = np.array([-1000.0, 1000.0]), np.array([-1000.0, 1000.0])
    terms = [
        Term("X(x)", 0, x, (Monomial(0),), np.zeros(2)),
        Term("X(z)", 2, z, (Monomial(0),), np.zeros(2)),
        Term("X(x)*z", 0, x, (Monomial(0, 1, 2, 0.0),), np.array([-1e-5, 1e-5])),
    ]
    tables = folded_tables(terms, {term.name: term.start for term in terms}, flip=False, mode="S1")
    slopes = largest_slopes(machine, tables, "S1")
    np.testing.assert_allclose(slopes[0], [2e-5 / 2000.0 * 1000.0, 0.0, 1e-5], atol=1e-11)


def fine_table(output: int, axis: int, heights: dict[int, float], nodes: int = 201) -> CecTable:
    """A table every 10 mm from -1000 mm, zero but at some nodes."""
    values = tuple(Decimal(str(heights.get(n, 0.0))) for n in range(nodes))
    return CecTable(axis, output, LinearTable(Decimal(-1000), Decimal(10), Decimal(-1000 + 10 * (nodes - 1)), values))


@pytest.mark.parametrize("node", [1, 57, 199])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_steep_interval_of_a_fine_table_is_found_wherever_it_is(simple, node, axis):
    machine, _, _ = simple()
    slopes = largest_slopes(machine, {0: fine_table(2, axis, {node: 0.004, 100: 0.001})}, "S1")
    expected = np.zeros((3, 3))
    expected[2, axis] = 0.004 / 10.0
    np.testing.assert_allclose(slopes, expected, atol=1e-15)
    ((value, place),) = largest_sums(machine, {0: fine_table(2, axis, {node: -0.004, 100: 0.001})}, "S1")[2:]
    assert (value, place[axis]) == pytest.approx((-0.004, -1000.0 + 10.0 * node))


def test_the_slope_along_one_axis_counts_where_the_other_factor_is_largest(simple):
    """(0.1 mm of X at node 57) times (0.2 mm of Y at node 3): 0.1 x 0.2 / 10 mm along either."""
    machine, _, _ = simple()
    lever = fine_table(0, 1, {3: 0.2})
    tables = {0: replace(fine_table(0, 0, {57: 0.1}), multiplier=2), 1: lever}
    slopes = largest_slopes(machine, tables, "S2")
    np.testing.assert_allclose(slopes[0], [0.002, 0.002, 0.0], atol=1e-15)
    assert largest_sums(machine, tables, "S2")[0] == (pytest.approx(0.02), (-430.0, -970.0, pytest.approx(-1000.0)))


@pytest.mark.parametrize(
    ("indices", "words"),
    [
        ((0,), "0"),
        ((0, 1), "0 ... 1"),
        ((2, 3, 4, 6), "2 ... 4, 6"),
        ((0, 2, 4, 5, 8, 9), "0, 2, 4 ... 5, 8 ... 9"),
    ],
)
def test_indices_are_named_without_those_of_other_axes(indices, words):
    tables = {index: table_of(0, 0, 0.1) for index in indices}
    assert cec_overwrites(tables, ())[1] == f"Tables {words}, whatever they contain now."


@pytest.mark.parametrize(
    ("data", "usable"),
    [
        ("", None),
        ("tables_available = 8", 8),
        ("tables_available = 8\ntables_reserved = 2", 6),
        ("tables_available = 8\ntables_reserved = 2\nkept_tables = [7, 8, 900]", 5),
        ("tables_available = 2\ntables_reserved = 5", 1),
    ],
)
def test_tables_for_the_errors_are_those_that_nobody_else_needs(simple, data, usable):
    _, _, own = simple(data)
    assert own.tables_usable == usable


def test_equal_indices_and_two_active_encoders_are_refused(simple, tmp_path):
    with pytest.raises(InputError, match="a list of different table indices"):
        simple("kept_tables = [6, 6]")
    both = simple_machine(tmp_path, "encoder = [0, 1]\nactive_encoder = [0, 1]", "siemens-eec")
    with pytest.raises(InputError, match="active_encoder: expected one of the encoders of X"):
        controller_named("siemens-eec").read_settings(both)


def test_a_step_may_use_every_node_that_the_control_takes(simple):
    """2000 mm: 41 nodes at 50 mm."""
    assert simple("max_points = 41\nstep_mm = { X = 50.0 }")[2].step_mm == (50.0, None, None)
    with pytest.raises(InputError, match="50 mm gives more than the 40 nodes"):
        simple("max_points = 40\nstep_mm = { X = 50.0 }")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (table_of(0, 0, 0.00049), ""),
        (
            table_of(0, 0, 0.00051),
            "AX1: the sum at the reference point is +0.000510 mm (X); the axis jumps by this amount",
        ),
        (fine_table(1, 0, {57: 0.99}), ""),
        (
            fine_table(1, 0, {57: 1.01}),
            "AX2: the sum changes by up to 0.101 mm per mm of travel; the usual MD32730 is 10",
        ),
        (table_of(2, 0, -1.01), "AX3: the sum reaches -1.0100 mm; the usual MD32720 is 1 mm"),
    ],
)
def test_usual_limits_and_jumps_are_warned_of(simple, table, words):
    machine, control, own = simple()
    found = cec_warnings(machine, own.axis_names, {0: table}, own, largest_sums(machine, {0: table}, "S1"))
    assert any(text.startswith(words) for text in found) if words else found == []


@pytest.mark.parametrize(("tables", "nodes", "said"), [(6, 200, False), (7, 2, True), (6, 201, True)])
def test_what_the_smallest_controls_hold_needs_no_statement(simple, tables, nodes, said):
    """840D sl with three axes: six tables; 828D: 200 nodes. The machine file says nothing of either."""
    _, _, own = simple()
    held = {index: fine_table(0, 1, {}, nodes) for index in range(tables)}
    found = [text for text in cec_reservations(held, own) if "does not say how many the control has" in text]
    expected = f"{tables} tables with up to {nodes} nodes are needed"
    assert [text.startswith(expected) for text in found] == [True] * said


@pytest.mark.parametrize(("available", "broken"), [(3, True), (4, False)])
def test_the_highest_index_is_the_number_of_tables(simple, available, broken):
    machine, _, own = simple(f"tables_available = {available}")
    tables = {3: fine_table(0, 1, {5: 0.1})}
    found = set_violations(machine, tables, 2000, own.tables_available)
    assert found == ([f"4 tables are needed, but the control has only {available}"] if broken else [])
    (use,) = [item for item in cec_usage(machine, tables, own) if item.name == "tables"]
    assert (use.used, use.allowed) == (4, available)


@pytest.mark.parametrize(("limit_mm", "broken"), [(0.0999, True), (0.1001, False)])
def test_a_stated_limit_is_broken_only_beyond_it(simple, limit_mm, broken):
    machine, _, own = simple(f"max_sum_mm = {limit_mm}")
    assert len(stated_limit_violations(machine, {0: table_of(0, 1, -0.1)}, own)) == broken


@pytest.mark.parametrize(
    ("own", "text", "message"),
    [
        ("", constant(0, "0.1", 3), "MULT_BY_TABLE names table number 3, which does not exist"),
        ("", constant(0, "0.1").replace("DIRECTION[0]=0", "DIRECTION[0]=2"), "DIRECTION is 2; expected 0, 1 or -1"),
        (
            "",
            constant(0, "0.1", 2) + constant(1, "0.1").replace("MODULO[1]=0", "MODULO[1]=1"),
            "either this table or its multiplier 1 is cyclic; both must be, or neither",
        ),
        ("", constant(0, "0.1").replace("=1000.0", "=1000.5"), "never meets MAX"),
        (
            "",
            constant(0, "0.1").replace("2000.0", "1900.0").replace("=1000.0", "=900.0"),
            "the travel is -1000 ... 1000",
        ),
        ("tables_available = 2", constant(2, "0.1"), "3 tables are needed, but the control has only 2"),
        (
            "max_points = 3",
            constant(0, "0.1").replace("2000.0", "500.0") + "".join(f"$AN_CEC[0,{n}]=0.1\n" for n in range(2, 5)),
            "has 5 nodes; the control takes at most 3",
        ),
    ],
)
def test_a_broken_rule_of_the_control_is_one_violation_that_names_it(simple, own, text, message):
    machine, control, settings_ = simple(own)
    found = control(machine, settings_).violations(parsed(control, machine, settings_, text + "M17\n"))
    assert len(found) == 1
    assert message in found[0]


# --- settings ------------------------------------------------------------------------------------------------------


def test_the_sign_is_inferred_and_said_with_both_indications_unless_it_is_stated(tmp_path):
    control = controller_named("siemens-cec")
    for own, inferred in (("", True), ('sign = "error"', False), ('sign = "correction"', False)):
        machine = make_machine(tmp_path, own)
        settings_ = control.read_settings(machine)
        assert settings_.subtracts == (own != 'sign = "correction"')
        made = export(machine, random_errors(machine), "siemens-cec")
        assert ("is inferred" in made.manifest["sign_statement"]) == inferred
        assert any("inferred from two indications" in text for text in made.warnings) == inferred
        for indication in ("calibration cycle", "p. 236"):
            assert indication in made.preflight
    assert "calibration cycle" in " ".join(load_format("siemens-cec-eec").unverified)


def test_without_a_mode_no_products_are_written_and_what_stays_is_said_in_the_verdict(tmp_path):
    machine = make_machine(tmp_path, 'sign = "error"')
    errors = random_errors(machine)
    made = export(machine, errors, "siemens-cec")
    assert not re.search(r"MULT_BY_TABLE\[\d+\]=[1-9]", made.files["NC_CEC.INI"])
    result = verify(machine, read_tables(machine, made.write(tmp_path / "out"), "siemens-cec"), errors)
    (left,) = [note for note in result.notes if "no products of tables are written" in note]
    assert "X(x)*z (" in left and left in made.preflight
    read = read_tables(machine, made.write(tmp_path / "out"), "siemens-cec")
    points = random_points(machine, 4000)
    rest = volumetric_error(machine, errors, points.position_mm) + read.controller.emulate(read.tables, points)
    said = float(re.search(r"together these leave ([\d.]+) um", left).group(1))
    assert said == pytest.approx(1e3 * np.sqrt(np.mean(np.sum(rest**2, axis=1))), rel=0.1)
    assert any("mult_mode is not set" in note for note in result.notes)


@pytest.mark.parametrize("own", ["products = true", 'sign = "error"\nproducts = true'])
def test_products_without_a_mode_are_refused_with_the_reason(tmp_path, own):
    with pytest.raises(InputError, match=r"mult_mode: is missing.*0.56.*products = false") as caught:
        controller_named("siemens-cec").read_settings(make_machine(tmp_path, own))
    assert caught.value.exit_code == 2


def test_a_file_that_multiplies_tables_is_not_read_without_a_mode(tmp_path):
    machine = simple_machine(tmp_path, "", "siemens-cec")
    control = controller_named("siemens-cec")
    text = constant(0, "0.2", 2) + constant(1, "0.3") + "M17\n"
    with pytest.raises(InputError, match=r"MULT_BY_TABLE\[0\]: the file multiplies tables.*mult_mode") as caught:
        parsed(control, machine, control.read_settings(machine), text)
    assert caught.value.line == 9


@pytest.mark.parametrize(
    ("own", "said"),
    [("", True), ('profile = "840D sl"', True), ("nc_axes = 10", False), ("tables_available = 31", False)],
)
def test_a_number_of_tables_that_nobody_stated_is_in_the_verdict(tmp_path, own, said):
    machine = make_machine(tmp_path, f'sign = "error"\nmult_mode = "S1"\n{own}')
    errors = random_errors(machine)
    made = export(machine, errors, "siemens-cec")
    result = verify(machine, read_tables(machine, made.write(tmp_path / "out"), "siemens-cec"), errors)
    assert result.accepted
    notes = [note for note in result.notes if "19 tables" in note and "nc_axes" in note]
    assert bool(notes) == said
    assert result.summary()["notes"] == list(result.notes)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ('sign = "minus"', "expected one of 'error', 'correction'"),
        ('sign = "error"\nmult_mode = "S5"', "one of 'S1', 'S2', 'S3', 'S4'"),
        ('sign = "error"\nmultmode = "S1"', "is not a known key; did you mean 'mult_mode'"),
        ('sign = "error"\naxis_names = { X = "AX2" }', "two axes have the same name"),
        ('sign = "error"\naxis_names = { X = "AX 2" }', "an axis name of letters"),
        ('sign = "error"\naxis_names = { x = "AX1" }', "did you mean 'X'"),
        ('sign = "error"\nstep_mm = { X = 0.0000001 }', "a multiple of 0.000001 mm"),
        ('sign = "error"\nstep_mm = { X = 0.01 }', "more than the 2000 nodes"),
        ('sign = "error"\nmax_sum_mm = { X = 1.0 }', "one number, or a table"),
        ('sign = "error"\nmax_sum_mm = -1', "a number above zero"),
    ],
)
def test_wrong_settings_say_what_is_expected(tmp_path, own, message):
    with pytest.raises(InputError) as caught:
        controller_named("siemens-cec").read_settings(make_machine(tmp_path, own))
    assert message in str(caught.value)
    assert "machine.toml" in str(caught.value)


def test_a_step_of_the_user_is_the_step_of_the_tables(tmp_path):
    machine = make_machine(tmp_path, 'sign = "error"\nstep_mm = { Y = 51.53 }')
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    text = rendered(control, machine, own, tables)
    assert "$AN_CEC_STEP[1]=51.530000\n$AN_CEC_MIN[1]=-100.000000\n$AN_CEC_MAX[1]=415.300000\n" in text


# --- text ----------------------------------------------------------------------------------------------------------


def test_comments_blank_lines_case_and_order_do_not_matter(simple):
    machine, control, own = simple()
    plain = parsed(control, machine, own, (GOLDEN / "siemens-cec" / "two_tables.ini").read_text())
    lines = (GOLDEN / "siemens-cec" / "two_tables.ini").read_text().splitlines()
    body = [line.replace("=", " = ").replace("[", " [ ") + "\t; note" for line in reversed(lines[2:-1])]
    text = "\r\n".join(["", "; a comment", *lines[:2], *body, "", "m17 ; end", "", ""]).replace("AX", "ax")
    assert parsed(control, machine, own, text) == plain


def test_tables_may_stand_in_several_files_of_any_order(simple):
    machine, control, own = simple()
    files = [SourceFile(Path(f"{n}.ini"), constant(n, f"0.{n + 1}") + "M17\n") for n in (1, 0)]
    assert sorted(control(machine, own).parse(files).tables) == [0, 1]
    with pytest.raises(InputError, match=r"b\.ini:1: .*a second time; the first is in a\.ini, line 1"):
        control(machine, own).parse([SourceFile(Path(f"{n}.ini"), constant(0, "0.1") + "M17\n") for n in "ab"])


def test_a_dot_between_indices_is_read_with_a_warning(simple):
    machine, control, own = simple()
    text = constant(0, "0.1").replace("[0,", "[0.") + "M17\n"
    with pytest.warns(CompgenWarning, match="write a comma"):
        tables = parsed(control, machine, own, text)
    assert tables == parsed(control, machine, own, constant(0, "0.1") + "M17\n")


GOOD = "%_N_NC_CEC_INI\nCHANDATA(1)\n" + constant(0, "0.1") + "M17\n"


@pytest.mark.parametrize(
    ("old", "new", "message", "line"),
    [
        ("M17\n", "", "the end mark M17 is missing: the file is truncated", 12),
        ("M17\n", "M17\n$AN_CEC[0,2]=0.0\n", "follows the end mark M17", 14),
        ("$AN_CEC[0,1]=0.1\n", "", "node 1 of 0 ... 1 is missing", None),
        ("$AN_CEC[0,1]=0.1\n", "$AN_CEC[0,0]=0.1\n", "is assigned a second time; the first is in line 3", 4),
        ("$AN_CEC[0,1]=0.1\n", "$AN_CEC[0,00]=0.1\n", "is assigned a second time", 4),
        ("$AN_CEC[0,1]=0.1\n", "$AN_CEC[0,1]=0.1\n$AN_CEC[0,2]=0.1\n", "this node is not one of them", 5),
        ("$AN_CEC_STEP[0]=2000.0\n", "", "$AN_CEC_STEP is missing", None),
        ("$AN_CEC_INPUT_AXIS[0]=(AX1)\n", "", "$AN_CEC_INPUT_AXIS is missing", None),
        ("$AN_CEC_IS_MODULO[0]=0\n", "", "$AN_CEC_IS_MODULO is missing", None),
        ("_STEP[0]", "_STEPP[0]", "$AN_CEC_STEPP is not a variable of these tables; did you mean '$AN_CEC_STEP'", 7),
        ("[0,1]=0.1", "[0,1]=1e-05", "'1E-05' has an exponent", 4),
        ("[0,1]=0.1", "[0,1]=1EX-5", "has an exponent", 4),
        ("[0,1]=0.1", "[0,1]=0,1", "the decimal mark is '.'", 4),
        ("[0,1]=0.1", "[0,1]=nan", "'NAN' is not a number", 4),
        ("[0,1]=0.1", "[0,1]=inf", "'INF' is not a number", 4),
        ("[0,1]=0.1", "[0,1]=" + "9" * 60, "is not a number", 4),
        ("[0,1]=0.1", "[0,1]=", "is not an assignment", 4),
        ("[0,1]=0.1", "[0,1]=0.1 0.2", "is not a number", 4),
        ("[0,1]=0.1", "[0,-1]=0.1", "index '-1' is not a whole number", 4),
        ("[0,1]=0.1", "[0,1,2]=0.1", "$AN_CEC has 2 indices; got [0,1,2]", 4),
        ("[0,1]=0.1", "[0,]=0.1", "$AN_CEC has 2 indices", 4),
        ("[0,1]=0.1", "[0,1=0.1", "is not an assignment", 4),
        ("(AX1)\n$AN_CEC_OUT", "(AX9)\n$AN_CEC_OUT", "no axis of the machine file is named 'AX9'", 5),
        ("(AX1)\n$AN_CEC_OUT", "AX1\n$AN_CEC_OUT", "'AX1' is not an axis name; write (AX1)", 5),
        ("STEP[0]=2000.0", "STEP[0]=0.0", "0.0 is not above zero", 7),
        ("STEP[0]=2000.0", "STEP[0]=0.000000000000001", "node 2 of 0 ...", None),
        ("MAX[0]=1000.0", "MAX[0]=-1000.0", "-1000.0 is not above the position -1000.0", 9),
        ("DIRECTION[0]=0", "DIRECTION[0]=0.5", "0.5 is not a whole number", 10),
        ("MODULO[0]=0", "MODULO[0]=-1", "-1 is not a whole number from 0 to 1", 12),
        ("MULT_BY_TABLE[0]=0", "MULT_BY_TABLE[0]=-1", "is not a whole number from 0", 11),
        ("CHANDATA(1)", "CHANDATA(1", "is not an assignment", 2),
        ("[0,1]=0.1", "[0,1]=0.1\u00a0", "contains the character '\\xa0'", 4),
        ("[0,1]=0.1", "[0,1]=0.1\0", "contains the character '\\x00'", 4),
        ("[0,1]=0.1", "[0,1]=\u0661", "contains the character", 4),
        ("[0,1]=0.1", "[0,1]=" + "1" * 2000, "the line has 2013 characters", 4),
        (GOOD, "", "the end mark M17 is missing", 1),
        (GOOD, "M17", "contains no table", None),
    ],
)
def test_malformed_text_is_an_error_at_its_line(simple, old, new, message, line):
    machine, control, own = simple()
    assert GOOD.count(old) == 1
    with pytest.raises(InputError) as caught:
        parsed(control, machine, own, GOOD.replace(old, new))
    assert message in str(caught.value)
    assert str(caught.value).startswith("t.ini" if line is None else f"t.ini:{line}:")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[0,1,X1]=0.004000", "[1,1,X1]=0.004000", "belongs to encoder 1, but the machine file has encoder = 0"),
        ("[0,1,X1]=0.004000", "[0,1,U1]=0.004000", "no axis of the machine file is named 'U1'"),
        ("$AA_ENC_COMP[0,1,X1]=0.004000\n", "", "table of X1: node 1 of 0 ... 4 is missing"),
        ("$AA_ENC_COMP_IS_MODULO[0,X1]=0\n", "", "$AA_ENC_COMP_IS_MODULO is missing"),
        ("$AA_ENC_COMP_STEP", "$AN_CEC_STEP", "$AN_CEC_STEP is not a variable of these tables"),
    ],
)
def test_malformed_encoder_tables_are_errors(tmp_path, old, new, message):
    machine = simple_machine(tmp_path, 'axis_names = { X = "X1" }', "siemens-eec")
    control = controller_named("siemens-eec")
    text = (GOLDEN / "siemens-eec" / "five_nodes.ini").read_text()
    assert text.count(old) == 1
    with pytest.raises(InputError) as caught:
        parsed(control, machine, control.read_settings(machine), text.replace(old, new))
    assert message in str(caught.value)


def test_a_file_cut_anywhere_is_refused(simple):
    machine, control, own = simple()
    for length in range(len(GOOD) - 2):
        with pytest.raises(InputError):
            parsed(control, machine, own, GOOD[:length])


@pytest.mark.parametrize(
    ("garbage", "reason"),
    [
        ("[" * 5_000_000, ":1: the line has 5000000 characters; at most 1000"),
        ("$AN_CEC[0,0]=" + "1" * 5_000_000, ":1: the line has 5000013 characters; at most 1000"),
        ("$A[" * 1_000_000, ":1: the line has 3000000 characters; at most 1000"),
        ("; comment\n" * 150_000, "the end mark M17 is missing"),  # the largest that is read at all
        (" \n" * 5_000_000, "has 5000000 lines; at most 200000"),
        ("\0\n" * 1_000_000, "has 1000000 lines; at most 200000"),
        ("$AN_CEC[0,0] " + " " * 5_000_000 + "= x", ":1: the line has 5000016 characters; at most 1000"),
    ],
    ids=["brackets", "digits", "names", "comments", "blank lines", "NUL", "blanks"],  # not these texts themselves
)
def test_huge_garbage_is_refused_for_its_size_before_it_is_parsed(simple, garbage, reason):
    machine, control, own = simple()
    with pytest.raises(InputError, match=reason):
        parsed(control, machine, own, garbage)


PIECES = st.sampled_from(
    [*GOOD.splitlines(), "$AN_CEC[0,1]=", "[", "]", "=", ";", "M17", "1E5", "é", "(AX1)", ",", "-", "."]
)


@given(st.lists(st.one_of(PIECES, st.text(max_size=12)), max_size=25), st.sampled_from(["\n", " ", "", "\r\n"]))
@settings(max_examples=80, deadline=None)
def test_any_text_parses_or_is_an_input_error(tmp_path_factory, pieces, glue):
    machine = simple_machine(tmp_path_factory.getbasetemp(), 'sign = "error"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    try:
        tables = parsed(control, machine, own, glue.join(pieces) + "\nM17\n")
    except (InputError, CompgenWarning):
        return
    assert isinstance(tables, CecTables)


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_a_good_file_with_one_changed_character_parses_or_is_an_input_error(tmp_path_factory, data):
    machine = simple_machine(tmp_path_factory.getbasetemp(), 'sign = "error"', "siemens-cec")
    control = controller_named("siemens-cec")
    own = control.read_settings(machine)
    place = data.draw(st.integers(0, len(GOOD) - 1))
    text = GOOD[:place] + data.draw(st.characters()) + GOOD[place + 1 :]
    try:
        tables = parsed(control, machine, own, text)
    except (InputError, CompgenWarning):
        return
    assert all(isinstance(text, str) for text in control(machine, own).violations(tables))


@pytest.mark.parametrize("name", ["siemens-eec", "siemens-cec"])
def test_the_preflight_list_is_complete_and_the_text_is_plain(tmp_path, name):
    machine = make_machine(tmp_path, 'sign = "error"' if name == "siemens-cec" else STEPS, control=name)
    control = controller_named(name)
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    tables = control(machine, own).build(basis, {term.name: term.start for term in basis})
    page = preflight(control, machine, own, tables)
    for heading in ("Options and parameters", "Order of activation", "Check the sign", "How to undo"):
        assert heading in page
    assert "MD18342" in page or "MD38000" in page
    assert load_format(name).unverified
    text = rendered(control, machine, own, tables)
    assert text.isascii()
    assert "-0.000000\n" not in text
    assert text == rendered(control, machine, own, tables)
