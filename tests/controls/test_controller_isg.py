"""ISG kernel / TwinCAT volumetric compensation: both parameter file formats and the list file."""

import re
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import CONTROLLERS
from compgen.controls.isg_kernel import errors_from_etalon, is_list_file, read_error_file
from compgen.controls.shared.base import SourceFile
from compgen.data import toml_files
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import CHAINS, Axis, Chain, Machine
from compgen.data.names import CURVE_NAMES, ERROR_NAMES, error_named
from compgen.errors import CompgenError, CompgenWarning, InputError
from compgen.kinematics.many_points import volumetric_error
from compgen.tables.render import load_format, render, render_files

GOLDEN = Path(__file__).parents[1] / "golden"
BOTH = ["isg-csv", "etalon-exchange"]
NANOMETRE = 1e-6
ROUNDING_MM = 1e-15  # of a handful of double-precision products around 0.1 mm
TRAVELS = ((-300.0, 500.0), (-150.0, 700.5), (-420.0, 80.0))


def machine_with(chain="WXYFZT", reference="X", tool=(3.0, -40.0, -155.0), travels=TRAVELS, **controls):
    """An asymmetric machine; ``controls`` are settings for both formats. All nodes of the curves are kept."""
    controls = {"loss_um": 1e-9, **controls}
    sections = {name: toml_files.Section(controls, path=None, name=f"controllers.{name}") for name in BOTH}
    x, y, z = (Axis(travel, np.linspace(*travel, 5)) for travel in travels)
    return Machine("lopsided", Chain(chain), (x, y, z), reference, tool, (10.0, 20.0, -30.0), controllers=sections)


def random_errors(machine, seed=7, names=CURVE_NAMES):
    """All errors with uneven positions, some um and some ten urad, none alike."""
    generator = np.random.default_rng(seed)
    curves = {}
    for name in names:
        error = error_named(name)
        low, high = machine.axes[error.axis].range_mm
        position = np.concatenate([[low], np.sort(generator.uniform(low, high, 3)).round(3), [high]])
        value = generator.normal(size=5) * (1e-2 if error.kind == "linear" else 3e-5)
        curves[name] = Curve(position, value, np.full(5, np.nan))
    return ErrorTable(curves, {"EC0Y": (1.1e-5, 0.0), "EB0Z": (-2e-5, 0.0), "EA0Z": (3e-5, 0.0)})


def built(name, machine, errors):
    """Tables from the natural start values."""
    control = CONTROLLERS[name]
    own = control.read_settings(machine)
    basis = control(machine, own).basis(errors)
    return control(machine, own).build(basis, {term.name: term.start for term in basis})


def context_of(name, machine, tables):
    control = CONTROLLERS[name]
    places = {"tool_offset_mm": ["0", "0", "0"], "reference_point_mm": ["0", "0", "0"]}
    common = {**places, "version": "1.2.3", "machine_name": machine.name, "chain": machine.chain.name, "files": []}
    common |= {"inputs": ["a.errors.csv"], "input_sha256": "0123456789abcdef" * 4}
    return common | control(machine).context(tables)


def exported(name, machine, errors):
    """Texts by file name."""
    return render_files(load_format(name), context_of(name, machine, built(name, machine, errors)))


def sources(texts):
    return [SourceFile(Path(name), text) for name, text in texts.items()]


def parsed(name, machine, texts):
    control = CONTROLLERS[name]
    return control(machine).parse(sources(texts))


def added(name, machine, texts, position, tool=None):
    """What the control adds at positions after reading the texts."""
    control = CONTROLLERS[name]
    tool = None if tool is None else np.broadcast_to(tool, np.shape(position))
    points = Points(np.asarray(position, dtype=float), tool_mm=tool)
    return control(machine).emulate(parsed(name, machine, texts), points)


def complaints(name, machine, texts):
    control = CONTROLLERS[name]
    return control(machine).violations(parsed(name, machine, texts))


def golden(*path):
    return {path[-1]: (GOLDEN.joinpath(*path)).read_text()}


def positions_in(machine, count=200, seed=5):
    return np.random.default_rng(seed).uniform(machine.lower_mm, machine.upper_mm, (count, 3))


# --- golden numbers ----------------------------------------------------------------------------------------------

PLAIN = machine_with("WFXYZT", tool=(0.0, 0.0, 0.0))


def test_rows_of_the_vendor_give_exx_0_010_at_5_and_eyx_minus_0_0175_at_2_5():
    at_5, at_2_5 = added("isg-csv", PLAIN, golden("isg-csv", "x_axis.csv"), [[5, 0, 0], [2.5, 0, 0]])
    # chain WFXYZT at Y = Z = 0: the angles have no lever arm, the control adds minus the errors
    assert at_5[0] == pytest.approx(-0.010, abs=ROUNDING_MM)
    assert at_2_5[1] == pytest.approx(+0.0175, abs=ROUNDING_MM)


def test_errors_of_x_at_two_z_are_a_grid_of_two_arguments():
    tables = parsed("isg-csv", PLAIN, golden("isg-csv", "x_axis_at_two_z.csv"))
    middle = np.array([[5.0, 0.0, 50.0]])
    assert tables.fields["EXX"].at(middle)[0] == pytest.approx(0.015, abs=ROUNDING_MM)
    assert tables.fields["EYX"].at(middle)[0] == pytest.approx(-0.040, abs=ROUNDING_MM)
    upper = np.array([[5.0, 0.0, 100.0]])
    assert tables.fields["EXX"].at(upper)[0] == pytest.approx(0.020, abs=ROUNDING_MM)
    assert tables.fields["EYX"].at(upper)[0] == pytest.approx(-0.035, abs=ROUNDING_MM)
    assert tables.records == 4


def test_a_grid_of_two_arguments_acts_in_the_volume_and_holds_its_edge_values():
    texts = golden("isg-csv", "x_axis_at_two_z.csv")
    inside, beyond, edge = added("isg-csv", PLAIN, texts, [[5, 0, 50], [99, 0, 500], [10, 0, 100]])
    # at Z the lever of EBX (mean 0.0027 rad) is Z: dX = EXX + Z EBX, dY = EYX - Z EAX (mean 0.0325 rad)
    assert inside[0] == pytest.approx(-(0.015 + 50 * 0.0027), abs=10 * ROUNDING_MM)
    assert inside[1] == pytest.approx(-(-0.040 - 50 * 0.0325), abs=10 * ROUNDING_MM)
    assert beyond[0] == pytest.approx(-(0.03 + 500 * 0.0015), abs=10 * ROUNDING_MM)
    assert edge[0] == pytest.approx(-(0.03 + 100 * 0.0015), abs=10 * ROUNDING_MM)


def test_three_arguments_with_the_list_file_of_the_vendor():
    texts = golden("isg-csv", "volcomp1.csv") | golden("isg-csv", "volcomp1.lis")
    assert added("isg-csv", PLAIN, texts, [[7, 12, -3]])[0] == pytest.approx([-0.0024, -0.0024, 0.0])
    listing = parsed("isg-csv", PLAIN, texts).listing
    assert (listing.chain, listing.workpiece_axes, listing.logical_axes) == ("XYZ", 0, (1, 2, 3))


def test_the_constructed_file_follows_the_formula_of_its_chain():
    machine = machine_with("WFYXZT", tool=(0.0, 0.0, 0.0))
    x, y, z = position = (50.0, 80.0, -30.0)
    clamp = 0.0  # the tables begin at zero
    # Zha eq. 9 with the errors as slopes; Z is below its table
    dx = 0.0021 * x / 100 + 0.0002 * y / 100 + z * (2e-6 * x / 100 + 1e-6 * y / 100) + z * -3e-6 - y * 1.2e-5 + clamp
    dy = -0.0004 * x / 100 + 0.0013 * y / 100 - z * (1e-6 * x / 100) - z * 2e-6 + x * 0.5e-6 * y / 100
    dz = 0.0003 * x / 100 + 0.0001 * y / 100 - x * 1e-6 * y / 100
    result = added("isg-csv", machine, golden("isg-csv", "constructed.csv"), [position])[0]
    assert result == pytest.approx([-dx, -dy, -dz], abs=ROUNDING_MM)
    assert any("exponent" in text for text in complaints("isg-csv", machine, golden("isg-csv", "constructed.csv")))


def test_rows_of_the_exchange_file_give_exy_at_minus_275():
    with pytest.warns(CompgenWarning, match="C0B, A0B belong to rotary axes"):
        result = added("etalon-exchange", PLAIN, golden("etalon-exchange", "vendor.etalon.txt"), [[0, -275, 0]])
    assert result[0] == pytest.approx([+0.000799657948, 0, 0], abs=ROUNDING_MM)


def test_the_exchange_format_takes_the_same_rows_as_the_columns():
    text = "[EXX]\nGridpoints = {\n0.0 0.02\n10.0 0.00\n}\n[EYX]\nGridpoints = {\n0.0 0.01\n10.0 -0.1\n}\n"
    at_5, at_2_5 = added("etalon-exchange", PLAIN, {"a.txt": text}, [[5, 0, 0], [2.5, 0, 0]])
    assert at_5[0] == pytest.approx(-0.010, abs=ROUNDING_MM)
    assert at_2_5[1] == pytest.approx(+0.0175, abs=ROUNDING_MM)


def test_a_value_may_follow_the_name_of_its_parameter_on_the_same_line():
    text = "[C0Y] VALUE = 1e-5\n[B0Z] VALUE = 2e-5\n[A0Z] VALUE = 3e-5\n"
    table = errors_from_etalon(text)
    assert {name: value for name, (value, _) in table.squareness.items()} == {"EC0Y": 1e-5, "EB0Z": 2e-5, "EA0Z": 3e-5}


def test_an_exchange_file_is_imported_as_errors_in_mm_and_rad():
    text = "[C0Y]\nVALUE = -0.000012\n" + golden("etalon-exchange", "vendor.etalon.txt")["vendor.etalon.txt"]
    with pytest.warns(CompgenWarning, match="rotary"):
        errors = errors_from_etalon(text, Path("tracer.txt"))
    assert errors.names == ("EXY", "EC0Y")
    assert errors.squareness["EC0Y"][0] == -0.000012
    np.testing.assert_array_equal(errors.curves["EXY"].position_mm, [-280.0, -270.0, -260.0, 260.0, 270.0])
    assert errors.curves["EXY"].value[1] == -0.000240680764
    assert np.isnan(errors.curves["EXY"].u).all()
    assert errors.metadata["source"] == "tracer.txt"


# --- signs by hand -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "position", "tool", "expected_mm"),
    [
        ("EXX 0.005", (100, 0, 0), (0, 0, 0), (-0.005, 0, 0)),  # 5 um too far in +X: the control goes back
        ("EZY -0.002", (0, 50, 0), (0, 0, 0), (0, 0, +0.002)),
        ("C0Y 0.00001", (0, 200, 0), (0, 0, 0), (+0.002, 0, 0)),  # dX = -C0Y Y
        ("B0Z 0.00001", (0, 0, -300), (0, 0, 0), (+0.003, 0, 0)),  # dX = +B0Z Z
        ("A0Z 0.00001", (0, 0, -300), (0, 0, 0), (0, -0.003, 0)),  # dY = -A0Z Z
        ("EBX 0.00001", (0, 0, 0), (0, 0, 100), (-0.001, 0, 0)),  # tool 100 mm up: dX = EBX 100
        ("EAZ 0.00001", (0, 0, 0), (0, 100, 0), (0, 0, -0.001)),  # dZ = EAZ 100
        ("EBX 0.00001", (0, 0, -200), (0, 0, 0), (+0.002, 0, 0)),  # WFYXZT: Z is part of the lever of X
        ("ECY 0.00001", (250, 0, 0), (0, 0, 0), (0, -0.0025, 0)),  # and X of the lever of Y: dY = ECY X
    ],
)
def test_the_control_takes_the_error_off_the_command(name, position, tool, expected_mm):
    machine = machine_with("WFYXZT", tool=(0.0, 0.0, 0.0))
    error, value = name.split()
    argument = "" if error[1] == "0" else error[-1]
    csv = f"{argument} {error}\n{'0 ' if argument else ''}{value}\n"
    etalon = f"[{error}]\nVALUE = {value}\n"
    for control, text in (("isg-csv", csv), ("etalon-exchange", etalon)):
        assert added(control, machine, {"a.csv": text}, [position], tool)[0] == pytest.approx(expected_mm)


def test_negate_flips_and_set_to_zero_blanks_the_result():
    machine = machine_with()
    texts = exported("isg-csv", machine, random_errors(machine))
    position = positions_in(machine)
    plain = added("isg-csv", machine, texts, position)
    assert np.abs(plain).min(axis=0).max() > 0
    listing = texts["volcomp0.lis"].replace("entries: 9", "entries: 11") + "negate YX\nset_to_zero Z\n"
    changed = added("isg-csv", machine, texts | {"volcomp0.lis": listing}, position)
    np.testing.assert_array_equal(changed, plain * [-1.0, -1.0, 0.0])
    assert "list file: negate is XY; the machine file requires nothing" in complaints(
        "isg-csv", machine, texts | {"volcomp0.lis": listing}
    )


@pytest.mark.parametrize("name", BOTH)
def test_a_control_that_was_found_to_add_the_error_gets_negate_and_is_right_again(name):
    usual, found = machine_with(), machine_with(reversed_axes="XZ")
    errors, position = random_errors(usual), positions_in(usual)
    texts = exported(name, found, errors)
    assert re.search(r"^negate +XZ$", texts["volcomp0.lis"], re.MULTILINE)
    due = added(name, usual, exported(name, usual, errors), position)
    np.testing.assert_array_equal(added(name, found, texts, position), due)
    without_list = {file: text for file, text in texts.items() if file != "volcomp0.lis"}
    np.testing.assert_array_equal(added(name, found, without_list, position), due)
    assert complaints(name, found, texts) == []


def test_negate_alone_turns_the_compensation_around_and_is_warned_of():
    plain, negated = machine_with(), machine_with(negate="Y")
    errors, position = random_errors(plain), positions_in(plain)
    due = added("isg-csv", plain, exported("isg-csv", plain, errors), position) * [1.0, -1.0, 1.0]
    np.testing.assert_array_equal(added("isg-csv", negated, exported("isg-csv", negated, errors), position), due)
    context = context_of("isg-csv", negated, built("isg-csv", negated, errors))
    assert any("differ for Y: the control then ADDS the error" in text for text in context["warnings"])


# --- round trip --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT", "WZFXYT"])
def test_the_files_read_back_take_the_errors_away(name, chain, reference):
    machine = machine_with(chain, reference)
    errors, position = random_errors(machine), positions_in(machine)
    texts = exported(name, machine, errors)
    left = added(name, machine, texts, position) + volumetric_error(machine, errors, position)
    control = CONTROLLERS[name]
    assert np.abs(left).max() <= control(machine).resolution_mm() < 10e-3 * NANOMETRE
    assert complaints(name, machine, texts) == []


@pytest.mark.parametrize("name", BOTH)
def test_numbers_read_back_are_those_that_were_written(name):
    machine = machine_with()
    errors = random_errors(machine)
    before, after = built(name, machine, errors), parsed(name, machine, exported(name, machine, errors))
    assert list(after.fields) == list(ERROR_NAMES)
    for error in ERROR_NAMES:
        np.testing.assert_array_equal(after.fields[error].values, before.fields[error].values)
        for nodes, nodes_before in zip(after.fields[error].nodes_mm, before.fields[error].nodes_mm, strict=True):
            np.testing.assert_array_equal(nodes, nodes_before)
    assert (after.records, after.listing, after.files) == (before.records, before.listing, before.files)


@pytest.mark.parametrize("name", BOTH)
def test_any_values_act_as_the_terms_say(name):
    machine = machine_with("WFYXZT")
    control, position = CONTROLLERS[name], positions_in(machine)
    own = control.read_settings(machine)
    basis = control(machine, own).basis(random_errors(machine))
    generator = np.random.default_rng(11)
    values = {term.name: generator.normal(size=len(term.nodes_mm)) * 1e-4 for term in basis}
    due = sum(
        term.carrier_field(position, np.array(machine.tool_offset_mm))
        * term.curve(values[term.name], position)[:, None]
        for term in basis
    )
    tables = control(machine, own).build(basis, values)
    texts = render_files(load_format(name), context_of(name, machine, tables))
    assert np.abs(added(name, machine, texts, position) - due).max() <= control(machine, own).resolution_mm()


def by_cross_products(chain, errors, position, tool):
    """E at one position from the sentences of the model page, without the program's list of coefficients."""
    left, right = chain[1:-1].split("F")
    travel = {letter: position[k] * np.eye(3)[k] for k, letter in enumerate("XYZ")}
    total = np.zeros(3)
    for letter in "XYZ":
        at = {key: errors.curves[f"E{key}{letter}"].at(travel[letter].sum()) for key in "XYZABC"}
        passed = right.partition(letter)[2] if letter in right else right + left[left.index(letter) :]
        lever = np.array(tool) + sum((travel[other] for other in passed), np.zeros(3))
        total += [at["X"], at["Y"], at["Z"]] + np.cross([at["A"], at["B"], at["C"]], lever)
    square = {name: value for name, (value, _) in errors.squareness.items()}
    total += np.cross([0, 0, square["EC0Y"]], travel["Y"])
    return total + np.cross([square["EA0Z"], square["EB0Z"], 0], travel["Z"])


@pytest.mark.parametrize("direction", ["workpiece_to_tool", "tool_to_workpiece"])
def test_every_chain_gives_minus_the_sum_of_translations_and_cross_products(direction):
    for chain in CHAINS:
        machine = machine_with(chain, chain_direction=direction)
        errors, position = random_errors(machine), positions_in(machine, 3)
        due = [by_cross_products(chain, errors, point, machine.tool_offset_mm) for point in position]
        result = added("isg-csv", machine, exported("isg-csv", machine, errors), position)
        assert np.abs(result + due).max() < 10e-3 * NANOMETRE


def test_the_tool_of_a_point_goes_before_that_of_the_machine():
    machine = machine_with("WFYXZT")
    errors, position, tool = random_errors(machine), positions_in(machine, 4), np.array([7.0, 70.0, -210.0])
    texts = exported("isg-csv", machine, errors)
    due = [by_cross_products("WFYXZT", errors, point, tool) for point in position]
    assert np.abs(added("isg-csv", machine, texts, position, tool) + due).max() < 10e-3 * NANOMETRE


def test_the_tool_offset_can_be_written_as_p0():
    errors = random_errors(machine_with("WFYXZT"))
    machine = machine_with("WFYXZT", write_tool_position=True)
    machine = replace(machine, controllers={"isg-csv": machine.controllers["isg-csv"]})
    texts = exported("isg-csv", machine, errors)
    assert re.search(r"P0X +P0Y +P0Z\n +3\.000000 +-40\.000000 +-155\.000000\n", texts["volcomp0.csv"])
    position = positions_in(machine, 5)
    other_tool = replace(machine, tool_offset_mm=(0.0, 0.0, 0.0))
    np.testing.assert_array_equal(
        added("isg-csv", other_tool, texts, position), added("isg-csv", machine, texts, position)
    )


# --- the text ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", BOTH)
def test_files_are_plain_ascii_without_exponents_and_come_out_alike_each_time(name):
    machine = machine_with(path="C:\\vc", reversed_axes="Y")
    errors = random_errors(machine)
    texts = exported(name, machine, errors)
    assert texts == exported(name, machine, errors)
    for text in texts.values():
        assert text.isascii()
        assert text.endswith("\n")
    data = next(text for file, text in texts.items() if not file.endswith(".lis"))
    code = "\n".join(line.partition("//")[0] for line in data.split("\n"))
    assert not re.search(r"[0-9][eE]|-0\.0+\s", code)
    assert "file[0]             C:\\vc\\" in texts["volcomp0.lis"]


def test_the_column_file_has_the_blocks_in_order_and_the_units():
    machine = machine_with()
    text = exported("isg-csv", machine, random_errors(machine))["volcomp0.csv"]
    headers = [line.split() for line in text.split("\n") if re.match(r" *[A-Z]", line)]
    assert headers == [
        ["C0Y", "B0Z", "A0Z"],
        *[[axis, *(f"E{key}{axis}" for key in "XYZABC")] for axis in "XYZ"],
    ]
    row = next(line.split() for line in text.split("\n") if line.strip().startswith("-300"))
    assert [len(cell.partition(".")[2]) for cell in row] == [6, 9, 9, 9, 12, 12, 12]


def test_errors_that_are_absent_are_named_in_the_file():
    machine = machine_with()
    text = exported("isg-csv", machine, random_errors(machine, names=CURVE_NAMES[:17]))["volcomp0.csv"]
    assert "// Errors left out because they are zero: ECZ\n" in text


def test_a_machine_with_reference_y_says_where_its_squareness_went():
    machine = machine_with(reference="Y")
    texts = exported("isg-csv", machine, random_errors(machine))
    assert "a slope in EYX" in texts["volcomp0.csv"]
    assert parsed("isg-csv", machine, texts).fields["EC0Y"].values == 0.0


@pytest.mark.parametrize("name", BOTH)
def test_carriage_returns_blank_lines_tabs_and_the_order_of_files_do_not_matter(name):
    machine = machine_with()
    texts = exported(name, machine, random_errors(machine))
    ruffled = {
        file: re.sub(" +", "\t ", re.sub("(?m)^([^/#\n].*)$", r" \1  \n", text)).replace("\n", "\r\n")
        for file, text in reversed(texts.items())
    }
    position = positions_in(machine, 20)
    np.testing.assert_array_equal(added(name, machine, ruffled, position), added(name, machine, texts, position))


def test_rows_and_blocks_may_come_in_any_order_and_comments_may_be_german():
    machine = machine_with(tool=(0.0, 0.0, 0.0))
    first = "X EXX\n-300 0.001\n500 -0.003\n#\nC0Y\n0.00001\n"
    second = "C0Y // Rechtwinkligkeit für Y\n0.00001\n# \n\nEXX X\n-0.003 500\n0.001 -300\n#\n"
    position = positions_in(machine, 20)
    np.testing.assert_array_equal(
        added("isg-csv", machine, {"a.csv": second}, position), added("isg-csv", machine, {"a.csv": first}, position)
    )


@pytest.mark.parametrize("name", BOTH)
def test_a_file_that_is_cut_anywhere_is_refused(name):
    machine = machine_with()
    texts = exported(name, machine, random_errors(machine, names=("EXX", "EBZ")))
    for file, text in texts.items():
        for end in range(len(text)):
            with pytest.raises(InputError):
                parsed(name, machine, texts | {file: text[:end]})


# --- limits ------------------------------------------------------------------------------------------------------


def test_travel_that_is_not_covered_is_named():
    machine = machine_with()
    assert complaints("isg-csv", machine, {"a.csv": "X EXX EYX\n-300 0 0\n499 0.001 0\n#\nC0Y\n0\n"}) == [
        "EXX, EYX: covers -300 ... 499 mm of X; the travel is -300 ... 500 mm"
    ]


@pytest.mark.parametrize("name", BOTH)
def test_more_records_than_the_control_takes_is_a_violation(name):
    errors = random_errors(machine_with())
    tables = parsed(name, machine_with(), exported(name, machine_with(), errors))
    exact, short = machine_with(max_records=tables.records), machine_with(max_records=tables.records - 1)
    assert complaints(name, exact, exported(name, exact, errors)) == []
    found = complaints(name, short, exported(name, short, errors))
    assert len(found) == 1
    assert f"{tables.records} records, but max_records is {tables.records - 1}" in found[0]


def test_records_are_the_rows_of_numbers_in_the_file():
    machine = machine_with()
    texts = exported("isg-csv", machine, random_errors(machine, names=("EXX", "EBZ")))
    rows = [line for line in texts["volcomp0.csv"].split("\n") if re.match(r" *[-0-9]", line)]
    assert parsed("isg-csv", machine, texts).records == len(rows) == 1 + 5 + 5
    texts = exported("etalon-exchange", machine, random_errors(machine, names=("EXX", "EBZ")))
    assert parsed("etalon-exchange", machine, texts).records == 3 + 5 + 5


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("chain               XYZ", "chain YXZ", "chain is YXZ; the machine file requires XYZ"),
        ("workpiece_axes      2", "workpiece_axes 0", "workpiece_axes is 0; the machine file requires 2"),
        ("Y                   2", "Y 5", "Y is 5; the machine file requires 2"),
        ("volcomp0.csv", "other.csv", r"file\[0\] is other.csv, which was not given"),
        ("volcomp0.csv", "other.csv", "volcomp0.csv is not named in the list file"),
        ("ISG_CSV", "ETALON_EXCHANGE", "declared ETALON_EXCHANGE, but it is ISG_CSV"),
        ("use_axis_offsets    0", "use_axis_offsets 1", "use_axis_offsets 1"),
        ("file[0]  ", "file[10] ", "the control accepts 10"),
    ],
)
def test_a_list_file_that_disagrees_is_a_violation(old, new, words):
    machine = machine_with()
    texts = exported("isg-csv", machine, random_errors(machine))
    assert old in texts["volcomp0.lis"]
    changed = texts | {"volcomp0.lis": texts["volcomp0.lis"].replace(old, new)}
    assert any(re.search(words, text) for text in complaints("isg-csv", machine, changed))


def test_a_list_file_of_another_chain_acts_as_that_chain():
    machine, other = machine_with("WXYFZT"), machine_with("WFYXZT")
    errors, position = random_errors(machine), positions_in(machine)
    mixed = exported("isg-csv", machine, errors) | {"volcomp0.lis": exported("isg-csv", other, errors)["volcomp0.lis"]}
    due = added("isg-csv", other, exported("isg-csv", other, errors), position)
    np.testing.assert_array_equal(added("isg-csv", machine, mixed, position), due)
    assert len(complaints("isg-csv", machine, mixed)) == 2


def test_more_than_ten_parameter_files_is_a_violation():
    names = [name for name in CURVE_NAMES if name[2] == "X"] + [name for name in CURVE_NAMES if name[2] == "Y"]
    texts = {}
    for name in names[:11]:
        low, high = TRAVELS["XYZ".index(name[2])]
        texts[f"{name}.csv"] = f"{name[2]} {name}\n{low} 0\n{high} 0\n"
    assert complaints("isg-csv", machine_with(), texts) == ["11 parameter files; the control accepts 10"]


def test_logical_numbers_in_the_parameter_file_must_be_those_of_the_machine_file():
    found = complaints("isg-csv", machine_with(), {"a.csv": "LNX LNY C0Y\n1 7 0\n"})
    assert found == ["LNY = 7, but the machine file says 2"]


# --- malformed text ----------------------------------------------------------------------------------------------

CSV = "// head\nX EXX EYX\n-300 0.001 0.002\n500 0.003 0.004\n#\nC0Y\n0.00001\n"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", None, "contains no data"),
        ("// only a comment\n", None, "contains no data"),
        ("#\n#\n", None, "contains no block"),
        (CSV.replace("X EXX EYX", "X EXX EXX"), 2, "twice .*70469"),
        (CSV.replace("X EXX EYX", "X EXX EQX"), 2, "'EQX' is not a parameter .*70468"),
        (CSV.replace("X EXX EYX", "X exx EYX"), 2, "did you mean 'EXX'"),
        (CSV.replace("X EXX EYX", "EZX EXX EYX"), 4, "second row without an argument"),
        (CSV.replace("X EXX EYX", "X Y Z"), 2, "arguments only"),
        (CSV.replace("X EXX EYX\n", ""), 2, "expected a header with names"),
        (CSV.replace("0.003 0.004", "0.003"), 4, "has 2 columns, but its header in line 2 has 3"),
        (CSV.replace("0.003 0.004", "0.003 0.004 0"), 4, "has 4 columns"),
        (CSV.replace("0.003", "0,003"), 4, "'0,003' is not a finite number; the decimal mark"),
        (CSV.replace("0.003", "nan"), 4, "'nan' is not a finite number"),
        (CSV.replace("0.003", "inf"), 4, "not a finite number"),
        (CSV.replace("0.003", "1e999"), 4, "not a finite number"),
        (CSV.replace("0.003", "1_0"), 4, "not a finite number"),
        (CSV.replace("0.003", "0x1"), 4, "not a finite number"),
        (CSV.replace("0.003", "0.00\N{ARABIC-INDIC DIGIT THREE}"), 4, "printable ASCII"),
        (CSV.replace("0.003", "0.003\0"), 4, "printable ASCII"),
        (CSV.replace("500 ", "-300 "), 4, "is given twice"),
        (CSV.replace("C0Y\n0.00001\n", "EXX\n0.1\n"), 6, "EXX is given a second time; the first is in a.csv:2"),
        (CSV.replace("C0Y\n0.00001\n", "C0Y\n"), 6, "no rows"),
        (CSV.replace("C0Y\n0.00001\n", "C0Y\n0.1\n0.2\n"), 8, "second row"),
        (CSV.replace("C0Y", "A0X"), 6, "A0X is not zero, but the model has only"),
        (CSV.replace("C0Y", "C0Y # more"), 6, "'#' ends a block"),
        (CSV.replace("X EXX EYX", "A EXX EYX"), 2, "depends on a rotary axis"),
        ("X Z EXX\n0 0 1\n0 5 1\n1 0 1\n", 4, "3 rows do not fill the grid of 2 x 2"),
        ("P0X X\n0 0\n", 1, "is a constant"),
        ("P0X\n5\n", 1, "none of the 21 errors"),
        ("X EXX\n" + "1" * 5000, 2, "the line has 5000 characters"),
        ("//\n" * 200_001, 200_000, "lines; at most"),
    ],
)
def test_a_malformed_column_file_is_refused_with_its_line(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed("isg-csv", machine_with(), {"a.csv": text})
    assert (str(caught.value.file), caught.value.line) == ("a.csv", line)


ETALON = "// head\n[C0Y]\nVALUE = 0.00001\n[EXX]\nGridpoints = {\n-300 0.001\n500 0.002\n} // end\n"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("", None, "contains no data"),
        ("VALUE = 1\n", 1, "name in brackets"),
        (ETALON.replace("} // end\n", ""), 4, "no closing brace"),
        ("[C0Y] VALUE = 1\n[B0Z] VALUE = 2\n[EXX] Gridpoints = {\n0 1\n", 3, r"\[EXX\] has no closing brace"),
        (ETALON.replace("[EXX]", "[C0Y]"), 4, "is a constant"),
        (ETALON.replace("[C0Y]", "[EXX]"), 4, "second time; the first is in a.txt:2"),
        (ETALON.replace("[C0Y]", "[Q0Y]"), 2, "'Q0Y' is not a parameter"),
        (ETALON.replace("[C0Y]", "[X]"), 2, "is an argument"),
        (ETALON.replace("[C0Y]", "[A0X]"), 2, "A0X is not zero"),
        (ETALON.replace("VALUE = 0.00001", "VALUE = 0,00001"), 3, "decimal mark"),
        (ETALON.replace("VALUE = 0.00001", "VALUE = nan"), 3, "not a finite number"),
        (ETALON.replace("VALUE = 0.00001", "VALUE 0.00001"), 3, "'VALUE = number' or"),
        (ETALON.replace("VALUE = 0.00001\n", "VALUE = 1\nVALUE = 2\n"), 4, "already has a value"),
        (ETALON.replace("VALUE = 0.00001\n", ""), 2, "has no values"),
        (ETALON.replace("Gridpoints", "Points"), 5, "'VALUE = number' or"),
        (ETALON.replace("500 0.002", "500 0.002 1"), 7, "two numbers"),
        (ETALON.replace("500 0.002", "500"), 7, "two numbers"),
        (ETALON.replace("500 0.002", "-300.0 0.002"), 7, "is given twice"),
        (ETALON.replace("500 0.002", "[EYX]"), 7, "two numbers"),
        (ETALON.replace("500 0.002", "500 0.002 } }"), 7, "two numbers"),
    ],
)
def test_a_malformed_exchange_file_is_refused_with_its_line(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed("etalon-exchange", machine_with(), {"a.txt": text})
    assert (str(caught.value.file), caught.value.line) == ("a.txt", line)


LIST = "# head\nX 1\nY 2\nZ 3\nchain XYZ\nworkpiece_axes 2\nfile[0] a.csv\nfile_format[0] ISG_CSV\n"


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        (LIST.replace("chain XYZ", "chian XYZ"), 5, "'chian' is not a key .*did you mean 'chain'"),
        (LIST.replace("chain XYZ", "chain XYC"), 5, "one of 'XYZ', 'XZY'"),
        (LIST.replace("chain XYZ", "chain"), 5, "has no value"),
        (LIST.replace("chain XYZ", "y 3"), 5, "second time; the first is in line 3"),
        (LIST.replace("workpiece_axes 2", "workpiece_axes 4"), 6, "from 0 to 3"),
        (LIST.replace("workpiece_axes 2", "workpiece_axes two"), 6, "from 0 to 3"),
        (LIST.replace("workpiece_axes 2", "negate XA"), 6, "letters X, Y, Z"),
        (LIST.replace("workpiece_axes 2", "set_to_zero XX"), 6, "letters X, Y, Z"),
        (LIST.replace("workpiece_axes 2", "interpolation SCATTER"), 6, "expected one of 'GRID', 'AUTO'"),
        (LIST.replace("file[0] a.csv\n", ""), None, r"file\[0\] is missing"),
        (LIST.replace("X 1", "X one"), 2, "whole number"),
        ("", None, "contains no data"),
    ],
)
def test_a_malformed_list_file_is_refused_with_its_line(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        parsed("isg-csv", machine_with(), {"a.csv": CSV, "a.lis": text})
    assert (str(caught.value.file), caught.value.line) == ("a.lis", line)


def test_a_list_file_is_known_by_its_contents_and_alone_it_is_not_enough():
    texts = {"a.csv": CSV, "vc.txt": LIST}
    assert parsed("isg-csv", machine_with(), texts).listing.workpiece_axes == 2
    with pytest.raises(InputError, match="no error-parameter file"):
        parsed("isg-csv", machine_with(), {"vc.txt": LIST})
    with pytest.raises(InputError, match="second list file"):
        parsed("isg-csv", machine_with(), texts | {"b.lis": LIST})


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("x 1\n", True),
        ("X EXX\n", False),  # a header with the argument X
        ("chain XYZ\n", True),
        ("# comment\n// comment\nfile[0] a.csv\n", True),
        ("X EXX EYX\n", False),
        ("chain\n", False),
        ("C0Y 0\n", False),
    ],
)
def test_a_list_file_begins_with_a_key_and_one_value(text, found):
    assert is_list_file(SourceFile(Path("volcomp.txt"), text)) is found
    assert is_list_file(SourceFile(Path("volcomp.LIS"), text)) is True
    assert is_list_file(SourceFile(Path("volcomp.csv"), text)) is False


def test_errors_of_rotary_axes_are_left_out_with_a_warning():
    text = "C EXC\n0 0.1\n#\nC0Y X0A\n0.00001 0.3\n"
    with pytest.warns(CompgenWarning) as caught:
        tables = parsed("isg-csv", machine_with(), {"a.csv": text})
    assert [str(item.message).split(":")[0] for item in caught] == ["a.csv", "a.csv"]
    assert list(tables.fields) == ["EC0Y"]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"sign": "error"}, "sign: is not a known key"),
        ({"negate": "XA"}, "letters X, Y, Z"),
        ({"reversed_axes": 1}, "letters X, Y, Z"),
        ({"logical_axes": {"X": 2}}, "three different numbers"),
        ({"logical_axes": {"U": 2}}, "not a known key"),
        ({"chain_direction": "up"}, "workpiece_to_tool"),
        ({"max_records": 0}, "from 1 to"),
        ({"path": "C:\\my files"}, "without blanks"),
        ({"path": "C:\\a#b"}, "without blanks"),
        ({"use_axis_offsets": 2}, "from 0 to 1"),
    ],
)
@pytest.mark.parametrize("name", BOTH)
def test_wrong_settings_are_refused(name, wrong, words):
    with pytest.raises(InputError, match=words):
        CONTROLLERS[name].read_settings(machine_with(**wrong))


@pytest.mark.parametrize(
    ("path", "written"),
    [
        ("", "volcomp0.csv"),
        ("CNC/vc", "CNC/vc/volcomp0.csv"),
        ("CNC/vc/", "CNC/vc/volcomp0.csv"),
        ("C:\\vc", "C:\\vc\\volcomp0.csv"),
        ("C:\\vc\\", "C:\\vc\\volcomp0.csv"),
        ("C:", "C:\\volcomp0.csv"),
        ("p" * 200, "p" * 200 + "/volcomp0.csv"),
    ],
)
def test_a_folder_of_the_control_ends_with_one_slash_of_its_kind(path, written):
    machine = machine_with(path=path)
    assert f" {written}\n" in exported("isg-csv", machine, random_errors(machine))["volcomp0.lis"]


def test_a_folder_of_the_control_has_at_most_200_characters():
    with pytest.raises(InputError, match="expected a folder on the control"):
        CONTROLLERS["isg-csv"].read_settings(machine_with(path="p" * 201))


@pytest.mark.parametrize("name", BOTH)
@pytest.mark.parametrize(("place", "value_mm"), [(0, 0.02), (1, 0.03), (2, -0.04)])
def test_the_check_is_where_the_correction_of_an_axis_is_largest(name, place, value_mm):
    """EXX is 0 but at one end or in the middle of X, EYZ likewise over Z: there minus the error is added."""
    machine = machine_with()
    curves = {}
    for error, (low, high) in (("EXX", TRAVELS[0]), ("EYZ", TRAVELS[2])):
        value = np.zeros(3)
        value[place] = value_mm
        curves[error] = Curve(np.array([low, 0.5 * (low + high), high]), value, np.full(3, np.nan))
    errors = ErrorTable(curves, {})
    checks = {item["axis"]: item for item in context_of(name, machine, built(name, machine, errors))["check"]}
    for axis, base in (("X", 0), ("Y", 2)):
        low, high = TRAVELS[base]
        assert checks[axis]["position"][base] == (low, 0.5 * (low + high), high)[place]
        assert checks[axis]["correction"] == pytest.approx(-value_mm)
    for item in checks.values():
        for at, (low, high) in zip(item["position"], TRAVELS, strict=True):
            assert at in (low, 0.5 * (low + high), high)


@pytest.mark.parametrize("name", BOTH)
def test_the_quantum_is_half_a_digit_of_three_lengths_and_of_eight_angles_at_the_longest_lever(name):
    """Nanometres have 9 digits in mm, angles 12 in rad; the longest lever is 700.5 mm of Y and 40 mm of the tool."""
    due = 0.5 * (3e-9 + 8e-12 * 740.5)
    assert CONTROLLERS[name](machine_with()).resolution_mm() == pytest.approx(due, rel=1e-12)


def test_ten_parameter_files_are_allowed_and_file_9_is_the_last():
    names = [name for name in CURVE_NAMES if name[2] in "XY"]
    texts = {}
    for name in names[:10]:
        low, high = TRAVELS["XYZ".index(name[2])]
        texts[f"{name}.csv"] = f"{name[2]} {name}\n{low} 0\n{high} 0\n"
    assert complaints("isg-csv", machine_with(), texts) == []
    machine = machine_with()
    texts = exported("isg-csv", machine, random_errors(machine))
    last = texts["volcomp0.lis"].replace("file[0]  ", "file[9]  ").replace("file_format[0]", "file_format[9]")
    assert complaints("isg-csv", machine, texts | {"volcomp0.lis": last}) == []


@pytest.mark.parametrize("name", BOTH)
def test_the_preflight_states_what_must_be_set_and_checked(name):
    machine = machine_with(max_records=700, path="C:\\vc", logical_axes={"X": 4})
    tables = built(name, machine, random_errors(machine))
    page = render(load_format(name), "preflight.md.j2", context_of(name, machine, tables))
    for words in (
        "| `vol_comp[0].file_name` | C:\\vc\\volcomp0.lis |",
        "| `vol_comp[0].max_records` | 700 |",
        "| `X` | 4 |",
        "| `chain` | XYZ |",
        "| `workpiece_axes` | 2 |",
        "so the control must command X = 99.995 mm",
        "tool offset (3, -40, -155) mm",
        "#VOLCOMP OFF [ID0]",
        "chain_direction",
    ):
        assert words in page
    row = re.search(r"\| X \| (\S+) \| (\S+) \| (\S+) \| (\S+) \|\n", page).groups()
    *position, correction = map(float, row)
    due = -volumetric_error(machine, random_errors(machine), np.array([position]))[0, 0]
    assert correction == pytest.approx(due, abs=NANOMETRE)


# --- garbage -----------------------------------------------------------------------------------------------------

WORDS = [
    "X",
    "Y",
    "Z",
    "EXX",
    "EBZ",
    "C0Y",
    "C0B",
    "P0X",
    "[EXX]",
    "[C0Y]",
    "VALUE =",
    "Gridpoints = {",
    "}",
    "#",
    "//",
]
SCRAPS = st.lists(
    st.one_of(
        st.sampled_from(
            [*WORDS, "chain", "XYZ", "file[0]", "negate", "0", "1", "-2.5", "1e3", " ", "\n", "\n", "\r\n"]
        ),
        st.text(max_size=4),
    ),
    max_size=40,
).map(" ".join)


@settings(max_examples=150, deadline=None)
@given(text=SCRAPS, suffix=st.sampled_from([".csv", ".lis", ".txt"]))
@pytest.mark.parametrize("name", BOTH)
def test_garbage_is_read_or_refused_but_never_crashes(name, text, suffix):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        try:
            tables = parsed(name, PLAIN, {"a.csv": CSV if name == "isg-csv" else ETALON, f"b{suffix}": text})
        except CompgenError:
            return
    control = CONTROLLERS[name]
    own = control.read_settings(PLAIN)
    assert np.isfinite(control(PLAIN, own).emulate(tables, Points(np.zeros((1, 3))))).all()
    control(PLAIN, own).violations(tables)


# --- the exchange file as errors of the commands -------------------------------------------------------------------------


def test_the_commands_take_an_exchange_file_for_errors(
    small_machine_file, small_machine, small_errors, tmp_path, capsys
):
    paths = compgen.export(small_machine, small_errors, "etalon-exchange").write(tmp_path / "a")
    exchange = next(str(path) for path in paths if path.name.endswith(".txt"))
    machine = str(small_machine_file)
    for words in (
        ["fit", machine, exchange, "--out", str(tmp_path / "f")],
        ["export", machine, exchange, "--controller", "isg-csv", "--out", str(tmp_path / "b")],
        ["verify", machine, str(tmp_path / "b" / "volcomp0.csv"), str(tmp_path / "b" / "volcomp0.lis")]
        + ["--controller", "isg-csv", "--errors", exchange, "--out", str(tmp_path / "v")],
    ):
        assert run_command(cli, words) == 0
    read = read_error_file(exchange)
    assert set(read.names) == set(small_errors.names)
    position = positions_in(small_machine, 50)
    before, after = (volumetric_error(small_machine, table, position) for table in (small_errors, read))
    assert np.abs(before - after).max() < 0.5e-3  # tables hold what fits best, second order included
    bad = tmp_path / "bad.txt"
    bad.write_text("// x\n[EXX]\nGridpoints = {\n0 0.1\n1 abc\n}\n")
    capsys.readouterr()
    assert run_command(cli, ["fit", machine, str(bad), "--out", str(tmp_path / "g")]) == 2
    assert "bad.txt:5" in capsys.readouterr().err


def test_a_grid_of_several_arguments_is_written_again_as_it_was_read():
    tables = parsed("isg-csv", PLAIN, golden("isg-csv", "x_axis_at_two_z.csv"))
    texts = render_files(load_format("isg-csv"), context_of("isg-csv", PLAIN, tables))
    again = parsed("isg-csv", PLAIN, {"volcomp0.csv": texts["volcomp0.csv"]})
    assert again.fields["EXX"].axes == tables.fields["EXX"].axes == (2, 0)
    position = positions_in(PLAIN, 50)
    for name, item in tables.fields.items():
        np.testing.assert_array_equal(again.fields[name].at(position), item.at(position))
