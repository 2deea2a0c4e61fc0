"""FANUC stored pitch error compensation, and trilinear grids in FANUC's corner order."""

from __future__ import annotations

import json
import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from steps import grows_with_its_file

from compgen.controls import SourceFile, controller_named
from compgen.controls.fanuc_pitch_tables import PitchBlock, PitchTables
from compgen.controls.shared.grids import trilinear
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import read_machine
from compgen.errors import InputError
from compgen.tables.render import load_format, render, render_files

GOLDEN = Path(__file__).parents[1] / "golden" / "fanuc-pitch"
SAMPLE = (GOLDEN / "PITCH.TXT").read_text()
SAMPLE_VALUES = (2, 1, 1, -2, 0, -1, 0, -1, 2, 1, 0, -1, -1, -2, 0, 1, 2)
SAMPLE_ENDS_MM = np.arange(-400.0, 451.0, 50.0)
SAMPLE_CURVE = np.array([0, 2, 3, 4, 2, 2, 1, 1, 0, 2, 3, 3, 2, 1, -1, -1, 0, 2])
CONTROL = controller_named("fanuc-pitch")
UM = 1e-3
ROUNDING_MM = 1e-12
COMMON = {
    "machine_name": 'mill "7"',
    "chain": "WXYFZT",
    "tool_offset_mm": ["0", "0", "0"],
    "reference_point_mm": ["0", "0", "0"],
    "version": "1.0",
    "inputs": ["a.errors.csv"],
    "input_sha256": "0123456789abcdef" * 4,
    "files": [],
}


def machine_of(tmp_path, options="", ranges=((-300.0, 500.0), (-600.0, 0.0), (-500.0, -20.0)), **fields):
    reference = fields.get("reference", (-100.0, 0.0, -500.0))
    axes = "\n".join(
        f"[axes.{name}]\nrange_mm = [{low}, {high}]\nnodes = {nodes}"
        for name, (low, high), nodes in zip("XYZ", ranges, (11, 11, 9), strict=True)
    )
    path = tmp_path / "machine.toml"
    path.write_text(
        f'name = "asymmetric"\nchain = "{fields.get("chain", "WXYFZT")}"\nreference_point_mm = {list(reference)}\n'
        f"tool_offset_mm = [10.0, -20.0, -150.0]\n{axes}\n[controllers.fanuc-pitch]\n{options}\n"
    )
    return read_machine(path)


def sample_machine(tmp_path, options=""):
    return machine_of(tmp_path, options, ((-400.0, 450.0), (-1.0, 1.0), (-1.0, 1.0)), reference=(0.0, 0.0, 0.0))


def curve(machine, axis, values):
    nodes = machine.axes[axis].nodes_mm
    return Curve(nodes, np.array(values), np.full(len(nodes), np.nan))


def asymmetric_errors(machine):
    walk = np.random.default_rng(3)
    sizes = {"EXX": (0, 6 * UM), "EYY": (1, 4 * UM), "EZZ": (2, 2 * UM), "EBZ": (2, 4e-6), "EBX": (0, 4e-6)}
    curves = {
        name: curve(machine, axis, np.cumsum(walk.normal(0, size, len(machine.axes[axis].nodes_mm))))
        for name, (axis, size) in sizes.items()
    }
    return ErrorTable(curves, {"EC0Y": (25e-6, 0.0)})


def natural_tables(machine, errors):
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(errors)
    return chosen, basis, CONTROL(machine, chosen).build(basis, {term.name: term.start for term in basis})


def texts_of(machine, chosen, tables):
    return render_files(load_format("fanuc-pitch"), {**COMMON, **CONTROL(machine, chosen).context(tables)})


def parse(machine, text, name="PITCH.TXT"):
    return CONTROL(machine).parse([SourceFile(Path(name), text)])


def read_all(machine, texts):
    files = [SourceFile(Path(name), text) for name, text in texts.items()]
    return CONTROL(machine).parse(files)


def added_x(machine, tables, x_mm):
    points = Points(np.column_stack([x_mm, np.zeros_like(x_mm), np.zeros_like(x_mm)]))
    added = CONTROL(machine).emulate(tables, points)
    assert not added[:, 1:].any()
    return added[:, 0]


# --- golden values -------------------------------------------------------------------------------------------------


def test_the_worked_table_of_the_manual_gives_its_cumulative_curve(tmp_path):
    machine = sample_machine(tmp_path)
    tables = parse(machine, SAMPLE)
    block = tables.blocks[0]
    assert block.values == SAMPLE_VALUES
    np.testing.assert_array_equal(block.curve, SAMPLE_CURVE)
    np.testing.assert_array_equal(block.curve_mm, SAMPLE_ENDS_MM)
    np.testing.assert_array_equal(np.round(added_x(machine, tables, SAMPLE_ENDS_MM) / UM, 9), SAMPLE_CURVE)


def test_between_section_ends_the_interpolated_type_is_linear_and_outside_the_sum_is_held(tmp_path):
    machine = sample_machine(tmp_path)
    tables = parse(machine, SAMPLE)
    x_mm = np.array([-1000.0, -375.0, -240.0, 25.0, 440.0, 450.0, 9999.0])
    expected_um = [0.0, 1.0, 3.6, 1.0, 1.6, 2.0, 2.0]
    np.testing.assert_allclose(added_x(machine, tables, x_mm), np.array(expected_um) * UM, atol=ROUNDING_MM)


def test_a_staircase_puts_the_value_of_a_section_out_at_its_beginning_and_agrees_at_section_ends(tmp_path):
    machine = sample_machine(tmp_path, 'interpolation = "staircase"')
    tables = parse(machine, SAMPLE)
    np.testing.assert_allclose(added_x(machine, tables, SAMPLE_ENDS_MM), SAMPLE_CURVE * UM, atol=ROUNDING_MM)
    x_mm = np.array([-1000.0, -399.0, -350.0, -349.0, -49.0, 0.0, 1.0, 50.0, 449.0, 451.0])
    expected_um = [0, 2, 2, 3, 0, 0, 2, 2, 2, 2]
    np.testing.assert_allclose(added_x(machine, tables, x_mm), np.array(expected_um) * UM, atol=ROUNDING_MM)


def test_rounding_the_cumulative_curve_keeps_counts_that_rounded_increments_lose(tmp_path):
    """0, 2.4, ... 12 um give 2, 3, 2, 3, 2 (sum 12), not 2, 2, 2, 2, 2."""
    ranges = ((0.0, 250.0), (-1.0, 1.0), (-1.0, 1.0))
    machine = machine_of(tmp_path, "interval_mm = { X = 50.0 }", ranges, reference=(0.0, 0.0, 0.0))
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(ErrorTable())
    values = {term.name: term.start for term in basis} | {"X(x)": np.array([0, 2.4, 4.8, 7.2, 9.6, 12.0]) * UM}
    block = CONTROL(machine, chosen).build(basis, values).blocks[0]
    assert dict(zip(range(block.first, block.last + 1), block.values, strict=True)) == {
        block.reference: 0,  # no travel below the reference point, its number is kept all the same
        block.reference + 1: 2,
        block.reference + 2: 3,
        block.reference + 3: 2,
        block.reference + 4: 3,
        block.reference + 5: 2,
    }


def test_the_rendered_records_of_the_worked_table_are_those_of_the_sample(tmp_path):
    machine = sample_machine(tmp_path, "first_number = 33\ninterval_mm = { X = 50.0, Y = 1.0, Z = 1.0 }")
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(ErrorTable())
    values = {term.name: term.start for term in basis} | {"X(x)": SAMPLE_CURVE * UM}
    tables = CONTROL(machine, chosen).build(basis, values)
    only_x = PitchTables((tables.blocks[0], None, None))
    assert texts_of(machine, chosen, only_x)["PITCH.TXT"] == SAMPLE


# --- sign ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stores", "stored"), [("correction", 2), ("error", -2)])
def test_an_axis_that_travels_two_um_short_gets_plus_two_and_is_sent_two_um_further(tmp_path, stores, stored):
    """Laser reads 49.998 mm over 0 ... 50 mm: EXX(50) = -2 um, correction +2 um."""
    ranges = ((0.0, 50.0), (-1.0, 1.0), (-1.0, 1.0))
    machine = machine_of(tmp_path, f'stores = "{stores}"', ranges, reference=(0.0, 0.0, 0.0))
    nodes = machine.axes[0].nodes_mm
    errors = ErrorTable({"EXX": curve(machine, 0, -2 * UM * nodes / 50.0)})
    chosen, _, tables = natural_tables(machine, errors)
    block = tables.blocks[0]
    assert sum(block.values) == stored
    back = read_all(machine, texts_of(machine, chosen, tables))
    np.testing.assert_allclose(added_x(machine, back, np.array([0.0, 50.0])), [0.0, 2 * UM], atol=ROUNDING_MM)
    assert f"gets {stored:+d} there" in CONTROL(machine, chosen).context(tables)["sign_statement"]


@pytest.mark.parametrize("stores", ["correction", "error"])
@pytest.mark.parametrize("value_type", ["incremental", "total"])
@pytest.mark.parametrize("reference_mm", [-300.0, -100.0, 500.0])
def test_the_trial_of_one_section_in_preflight_says_what_the_emulated_control_does(
    tmp_path, stores, value_type, reference_mm
):
    options = f'stores = "{stores}"\nvalue_type = "{value_type}"\nmagnification = 3\ndetection_unit_um = 0.5'
    machine = machine_of(tmp_path, options, reference=(reference_mm, 0.0, -500.0))
    chosen, _, tables = natural_tables(machine, asymmetric_errors(machine))
    check = CONTROL(machine, chosen).context(tables)["check"]
    text = re.sub(r"(?m)^(N1\d{4})P.*$", r"\1P0", texts_of(machine, chosen, tables)["PITCH.TXT"])
    text = text.replace(f"N{check['record']}P0", f"N{check['record']}P{check['counts']}")
    trial = parse(machine, text)
    start, end = added_x(machine, trial, np.array([check["from_mm"], check["to_mm"]]))
    assert (end - start) / UM == pytest.approx(check["change_um"], abs=1e-9)
    low, high = machine.axes[0].range_mm
    assert low - 1e-6 <= check["from_mm"] < check["to_mm"] <= high + 1e-6


# --- round trip ----------------------------------------------------------------------------------------------------

STYLES = [
    "",
    'q_word = true\neol = "crlf"',
    'value_type = "total"',
    'stores = "error"\nmagnification = 2\ndetection_unit_um = 0.5',
    "real_point = false\ninterval_unit_mm = 0.001",
    "q_word = true\nnumber_base = 0\ndigits = 4",
    "axis_numbers = { X = 3, Y = 1, Z = 5 }\nfirst_number = 500",
]


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize("options", STYLES)
def test_render_parse_gives_the_same_tables_and_the_emulator_the_term_model_within_half_a_count(
    tmp_path, chain, options
):
    machine = machine_of(tmp_path, options, chain=chain)
    errors = asymmetric_errors(machine)
    chosen, basis, tables = natural_tables(machine, errors)
    texts = texts_of(machine, chosen, tables)
    back = read_all(machine, texts)
    assert back == tables
    assert CONTROL(machine, chosen).violations(back) == []
    points = Points(np.random.default_rng(5).uniform(machine.lower_mm, machine.upper_mm, (500, 3)))
    wanted = sum(
        term.curve(term.start, points.position_mm)[:, None]
        * term.carrier_field(points.position_mm, np.array(machine.tool_offset_mm))
        for term in basis
    )
    difference = np.abs(CONTROL(machine, chosen).emulate(back, points) - wanted)
    assert difference.max() <= CONTROL(machine, chosen).resolution_mm() + ROUNDING_MM
    assert np.abs(wanted).max(axis=0).min() > 4 * UM  # every axis has something to lose


def test_positioning_errors_are_corrected_in_their_own_direction(tmp_path):
    machine = machine_of(tmp_path)
    errors = ErrorTable({name: c for name, c in asymmetric_errors(machine).curves.items() if name in ("EXX", "EYY")})
    chosen, _, tables = natural_tables(machine, errors)
    x_mm = np.linspace(-300.0, 500.0, 101)
    y_mm = np.linspace(-600.0, 0.0, 101)
    points = Points(np.column_stack([x_mm, y_mm, np.full(101, -200.0)]))
    added = CONTROL(machine, chosen).emulate(tables, points)
    for column, name, at_mm, reference_mm in ((0, "EXX", x_mm, -100.0), (1, "EYY", y_mm, 0.0)):
        error = errors.curves[name].at(at_mm) - errors.curves[name].at(np.array([reference_mm]))
        assert np.abs(added[:, column] + error).max() <= 0.55 * UM  # half a count, and 0.05 counts of interpolation
    assert not added[:, 2].any()


def test_styles_show_in_the_text(tmp_path):
    options = 'q_word = true\neol = "crlf"\ndigits = 6\nreal_point = false\ninterval_unit_mm = 1.0\nmagnification = 4'
    machine = machine_of(tmp_path, options)
    chosen, _, tables = natural_tables(machine, asymmetric_errors(machine))
    text = texts_of(machine, chosen, tables)["PITCH.TXT"]
    assert text.startswith("%\r\nN003620Q1A1P") and text.endswith("\r\n%\r\n")
    assert text.count("\n") == text.count("\r\n")
    assert re.search(r"^N003623Q1A1P4A2P4A3P4\r$", text, re.M)
    assert re.search(r"^N003624Q1A1P\d+A2P\d+A3P\d+\r$", text, re.M)
    assert re.search(r"^N010001Q0P-?\d+\r$", text, re.M)
    assert ";" not in text and " " not in text and text.isascii()


def test_the_plan_holds_number_and_value_of_every_point_and_is_no_table_by_itself(tmp_path):
    machine = machine_of(tmp_path)
    chosen, _, tables = natural_tables(machine, asymmetric_errors(machine))
    texts = texts_of(machine, chosen, tables)
    plan = json.loads(texts["PITCH.plan.json"])
    in_text = {int(n): int(v) for n, v in re.findall(r"^N1(\d{4})P(-?\d+)$", texts["PITCH.TXT"], re.M)}
    assert {int(number): value for number, value in plan["points"].items()} == in_text
    assert plan["machine"] == 'mill "7"' and plan["stores"] == "correction" and plan["detection_unit_um"] == 1.0
    assert plan["parameters"]["3620"]["1"] == str(tables.blocks[0].reference)
    assert read_all(machine, {name: texts[name] for name in ("PITCH.plan.json", "PITCH.TXT")}) == tables
    with pytest.raises(InputError, match=r"PITCH\.TXT"):
        read_all(machine, {"PITCH.plan.json": texts["PITCH.plan.json"]})


def test_preflight_names_parameters_backup_sign_check_and_undo(tmp_path):
    machine = machine_of(tmp_path)
    chosen, _, tables = natural_tables(machine, asymmetric_errors(machine))
    context = {**COMMON, **CONTROL(machine, chosen).context(tables)}
    page = render(load_format("fanuc-pitch"), "preflight.md.j2", context)
    assert "| `3620 (X, A1)` |" in page and "3605#0" in page and "49.998" in page and "value +2" in page
    assert page.index("Punch (output) ALL") < page.index("Read in `PITCH.TXT`") < page.index("How to undo")


# --- numbering and interval ------------------------------------------------------------------------------------------


def test_numbers_follow_from_stroke_and_interval_and_blocks_do_not_overlap(tmp_path):
    """Farthest negative = ref - stroke/d + 1, farthest positive = ref + stroke/d, one block behind the other."""
    machine = machine_of(tmp_path, "first_number = 33\ninterval_mm = { X = 50.0, Y = 60.0, Z = 40.0 }")
    _, _, tables = natural_tables(machine, ErrorTable())
    x, y, z = tables.blocks
    assert (x.reference, x.first, x.last) == (36, 33, 48)  # -200 ... +600 mm about the reference point
    assert (y.reference, y.first, y.last) == (58, 49, 58)  # -600 ... 0 mm
    assert (z.reference, z.first, z.last) == (59, 59, 71)  # 0 ... +480 mm


def test_sections_get_shorter_until_a_steep_curve_keeps_the_increment_limit(tmp_path):
    machine = machine_of(tmp_path, "increment_limit = 5")
    steep = curve(machine, 0, machine.axes[0].nodes_mm * 0.2e-3)  # 16 um per 80 mm
    gentle = curve(machine, 1, np.array([0, 1, 0, 2, 1, 0, 1, 1, 0, 0, 1]) * UM)
    chosen, basis, tables = natural_tables(machine, ErrorTable({"EXX": steep, "EYY": gentle}))
    assert max(map(abs, tables.blocks[0].values)) <= 5
    assert 10.0 < float(tables.blocks[0].interval_mm) < 25.0
    assert float(tables.blocks[1].interval_mm) == 60.0  # as wide as the curve nodes where nothing is steep
    assert CONTROL(machine, chosen).violations(tables) == []
    assert float(tables.blocks[2].interval_mm) == 480.0  # nothing to correct: one section
    assert any(np.abs(term.nodes_mm - machine.reference_point_mm[0]).min() < 1e-9 for term in basis)


def test_a_curve_too_steep_for_the_numbers_is_a_violation_that_says_so(tmp_path):
    machine = machine_of(tmp_path, "last_number = 60")
    steep = ErrorTable({"EXX": curve(machine, 0, machine.axes[0].nodes_mm * 1e-3)})
    chosen, _, tables = natural_tables(machine, steep)
    messages = CONTROL(machine, chosen).violations(tables)
    assert len(messages) == 1 and "the limit is 7" in messages[0] and messages[0].startswith("X")
    assert tables.blocks[2].last <= 60


def test_the_fastest_feed_keeps_sections_long(tmp_path):
    machine = machine_of(tmp_path, "max_feed_mm_min = 300000.0")  # at least 40 mm
    steep = ErrorTable({"EXX": curve(machine, 0, machine.axes[0].nodes_mm * 0.2e-3)})
    chosen, _, tables = natural_tables(machine, steep)
    assert min(float(block.interval_mm) for block in tables.blocks) >= 40.0
    assert any("the limit is 7" in message for message in CONTROL(machine, chosen).violations(tables))


# --- limits ----------------------------------------------------------------------------------------------------------


def block(**changes):
    fields = {
        "reference": 10,
        "first": 5,
        "values": (1,) * 12,
        "total": False,
        "magnification": 1,
        "interval_mm": Decimal(100),
    }
    return PitchBlock(**{**fields, **changes})


@pytest.mark.parametrize(
    ("options", "changes", "words"),
    [
        ("", {"values": (1,) * 11 + (-8,)}, "X: the change over section 16 is 8 counts; the limit is 7"),
        ("increment_limit = 127", {"values": (128,) + (0,) * 11}, "the limit is 127"),
        ('value_type = "total"', {"total": True, "values": (40000,) * 12}, "16 bits"),
        (
            'value_type = "total"',
            {"total": True, "values": (3,) * 12},
            "total value at the reference point 10 must be 0",
        ),
        ("", {"reference": 1020, "first": 1015}, "beyond the last number 1023"),
        ("", {"magnification": 0}, "switches the table off"),
        ("max_feed_mm_min = 1000000.0", {}, "shorter than"),
        ("", {"values": (1,) * 10}, "covers -700 ... 300 mm of X; the travel is -300 ... 500 mm"),
        ("", {"reference": 5}, "covers -200 ... 1000 mm of X"),
    ],
)
def test_every_limit_that_is_broken_is_named(tmp_path, options, changes, words):
    machine = machine_of(tmp_path, options)
    tables = PitchTables((block(**changes), None, None))
    messages = CONTROL(machine).violations(tables)
    assert any(words in message for message in messages), messages


def test_a_table_within_all_limits_has_no_violation_but_missing_axes_have(tmp_path):
    machine = machine_of(tmp_path)
    chosen = CONTROL.read_settings(machine)
    messages = CONTROL(machine, chosen).violations(PitchTables((block(), None, None)))
    assert [message.split()[0] for message in messages] == ["Y", "Z"]


def test_blocks_that_share_numbers_are_named_also_those_of_other_axes(tmp_path):
    machine = machine_of(tmp_path)
    chosen = CONTROL.read_settings(machine)
    tables = PitchTables((block(), block(first=16, reference=20), block(first=100, reference=105)), ((4, 111, 150),))
    overlaps = [message for message in CONTROL(machine, chosen).violations(tables) if "overlap" in message]
    assert overlaps == [
        "the compensation points of X (5 to 16) and Y (16 to 27) overlap",
        "the compensation points of Z (100 to 111) and axis A4 (111 to 150) overlap",
    ]


# --- parsing ---------------------------------------------------------------------------------------------------------


def with_q_words(text):
    text = re.sub(r"(?m)^N0(\d{4})", r"N0\1Q1", text)
    return re.sub(r"(?m)^N1(\d{4})", r"N1\1Q0", text)


def reversed_records(text):
    return "\n".join(["%", *reversed(text.split()[1:-1]), "%", ""])


VARIANTS = {
    "as it is": lambda text: text,
    "Q words": with_q_words,
    "several axes in a record": lambda text: re.sub(r"(?m)^(N0.*)$", r"\1A4P0", text),
    "Q words and several axes": lambda text: re.sub(r"(?m)^(N0.*)$", r"\1A4P0", with_q_words(text)),
    "no decimal point": lambda text: text.replace("P50.0", "P50"),
    "decimal points everywhere": lambda text: re.sub(r"(?m)P(-?\d+)$", r"P\1.", text),
    "metric value word": lambda text: text.replace("P50.0", "M50.0"),
    "no leading zero": lambda text: text.replace("N0", "N"),
    "more leading zeros": lambda text: text.replace("N", "N00").replace("P2", "P002"),
    "CR LF": lambda text: text.replace("\n", "\r\n"),
    "LF CR CR": lambda text: text.replace("\n", "\n\r\r"),
    "CR alone": lambda text: text.replace("\n", "\r"),
    "semicolons": lambda text: text.replace("\n", ";\n"),
    "blank lines and white space": lambda text: text.replace("\n", " \n\n").replace("P", " \tP"),
    "comments": lambda text: text.replace("N03622", "(FARTHEST; +)\nN03622").replace("P2\n", "P2 (TWO)\n"),
    "any order": reversed_records,
    "no last line end": lambda text: text.rstrip("\n"),
    "plus signs": lambda text: text.replace("P2", "P+2"),
    "other parameters": lambda text: text.replace(
        "N03620",
        "N00010P00000001\nN01815Q1A1P00110000A2P00110000\nN05898S1P30.0S2P-30.0\nN11222Q1L1P00000011\nN12700A1P7.5\n"
        "N13000P0.25\nN10033Q1A1P3.5\nN99999Q1P1\nN03620",
    ),
    "two containers": lambda text: text.replace("N10033", "%\n%\nN10033"),
    "a fourth axis with points of its own": lambda text: text.replace(
        "N10033",
        "N03620A4P60\nN03621A4P60\nN03622A4P61\nN03623A4P1\nN03624A4P45.0\nN10060P1\nN10061P-1\nN10033",
    ),
}


@pytest.mark.parametrize("style", VARIANTS)
def test_every_style_of_the_sample_gives_the_same_curve(tmp_path, style):
    machine = sample_machine(tmp_path)
    text = VARIANTS[style](SAMPLE)
    assert (text == SAMPLE) == (style == "as it is")
    tables = parse(machine, text)
    np.testing.assert_array_equal(tables.blocks[0].curve, SAMPLE_CURVE)
    np.testing.assert_array_equal(tables.blocks[0].curve_mm, SAMPLE_ENDS_MM)
    assert tables.others == (((4, 60, 61),) if style.startswith("a fourth") else ())


def test_parameters_and_points_may_come_in_two_files(tmp_path):
    machine = sample_machine(tmp_path)
    lines = SAMPLE.split()
    texts = {"CNCPARA.TXT": "\n".join([*lines[:6], "%"]), "PITCH.TXT": "\n".join(["%", *lines[6:]])}
    np.testing.assert_array_equal(read_all(machine, texts).blocks[0].curve, SAMPLE_CURVE)


def test_the_magnification_of_the_file_counts_and_not_that_of_the_settings(tmp_path):
    machine = sample_machine(tmp_path, "magnification = 7\ndetection_unit_um = 0.5")
    tables = parse(machine, SAMPLE.replace("N03623A1P1", "N03623A1P3"))
    np.testing.assert_allclose(added_x(machine, tables, SAMPLE_ENDS_MM), 1.5 * SAMPLE_CURVE * UM, atol=ROUNDING_MM)


def test_axis_numbers_say_which_axis_a_number_is(tmp_path):
    machine = sample_machine(tmp_path, "axis_numbers = { X = 3, Y = 1, Z = 2 }")
    tables = parse(machine, SAMPLE)
    assert tables.blocks[0] is None and tables.blocks[2] is None
    np.testing.assert_array_equal(tables.blocks[1].curve, SAMPLE_CURVE)


def test_positions_count_from_the_reference_point_of_the_machine(tmp_path):
    machine = machine_of(tmp_path, "", ((-300.0, 550.0), (-1.0, 1.0), (-1.0, 1.0)), reference=(100.0, 0.0, 0.0))
    tables = parse(machine, SAMPLE)
    np.testing.assert_allclose(added_x(machine, tables, SAMPLE_ENDS_MM + 100.0), SAMPLE_CURVE * UM, atol=ROUNDING_MM)


MALFORMED = [
    (lambda t: "", r"contains no '%'", None),
    (lambda t: t.replace("%", ""), r"N03620A1P40.*is not between two '%'", 2),
    (lambda t: t[: t.rindex("%")], r"last '%' is missing", 24),
    (lambda t: t[: t.index("N10040")], r"last '%' is missing", None),
    (lambda t: t + "N10050P1\n", r"N10050P1.*is not between two '%'", 25),
    (lambda t: t.replace("N10041P2\n", ""), r"gives points 33 to 49, but 41 \(1 in all\) are missing", 4),
    (lambda t: t.replace("N03623A1P1\n", ""), r"parameter 3623 is missing for X \(axis A1\)", None),
    (lambda t: t.replace("N10041P2", "N10041P2\nN10041P2"), r"N10041: is given a second time.*:15\)", 16),
    (lambda t: t.replace("N03620A1P40", "N03620A1P40A1P40"), r"axis A1 is given a second time", 2),
    (lambda t: t.replace("A1", "A7"), r"none of the parameters 3620 to 3624 for the axes A1, A2, A3", None),
    (lambda t: t.replace("N10036P-2", "N10036P-2.5"), r"got -2.5; expected a whole number", 10),
    (lambda t: t.replace("N10036P-2", "N10036P-2E1"), r"single value word P", 10),
    (lambda t: t.replace("N10036P-2", "N10036P-2,0"), r"',0' is not allowed in a block", 10),
    (lambda t: t.replace("N10036P-2", "N10036P--2"), r"'P--2' is not a word", 10),
    (lambda t: t.replace("N10036P-2", "N10036PNAN"), r"is not a word", 10),
    (lambda t: t.replace("N10036P-2", "N10036"), r"single value word P", 10),
    (lambda t: t.replace("N10036P-2", "N10036P" + "9" * 50), r"is not a word", 10),
    (lambda t: t.replace("N10036P-2", "N10036P" + "9" * 5000), r"5007 characters", 10),
    (lambda t: t.replace("N10036P-2", "N10036P99999999"), r"a whole number from", 10),
    (lambda t: t.replace("N10036P-2\n", "N10036P-2"), r"single value word P", 10),
    (lambda t: t.replace("N10036P-2", "N10036P٣"), r"is not allowed in a block", 10),
    (lambda t: t.replace("N10036P-2", "ÄÖÜ"), r"is not a block", 10),
    (lambda t: t.replace("N10036P-2", "G10L50"), r"'G10L50' is not a block", 10),
    (lambda t: t.replace("N10036P-2", "(open"), r"is not a block", 10),
    (lambda t: t.replace("P50.0", "I2.0"), r"inch data", 6),
    (lambda t: t.replace("P50.0", "P0.0"), r"interval 0.0 mm is not possible", 6),
    (lambda t: t.replace("P50.0", "P-50.0"), r"not possible", 6),
    (lambda t: t.replace("N03622A1P49", "N03622A1P999999999"), r"whole number from 0 to 9999", 4),
    (lambda t: t.replace("N03620A1P40", "N03620A1P60"), r"reference point must be one of 32 to 49", 2),
    (lambda t: t.replace("N03622A1P49", "N03622A1P20"), r"points 33 to 20", 2),
    (lambda t: t.replace("N03623A1P1", "N03623A1P101"), r"whole number from 0 to 100", 5),
    (lambda t: t.replace("N03623A1P1", "N03623P1"), r"pairs of an axis word", 5),
    (lambda t: t.replace("N03623A1P1", "N03623S1P1"), r"expected an axis word A, e.g. A1P40, found S1", 5),
    (lambda t: t.replace("N03623A1P1", "N03623A1X1"), r"expected a value word P, e.g. A1P40, found X1", 5),
    (lambda t: t.replace("N03623A1P1", "N03623Q5A1P1"), r"Q5", 5),
]


@pytest.mark.parametrize(("damage", "words", "line"), MALFORMED)
def test_a_damaged_file_is_refused_with_file_line_and_reason(tmp_path, damage, words, line):
    machine = sample_machine(tmp_path)
    text = damage(SAMPLE)
    assert text != SAMPLE
    with pytest.raises(InputError, match=words) as caught:
        parse(machine, text)
    assert caught.value.file == Path("PITCH.TXT")
    assert caught.value.line == line or line is None


@pytest.mark.parametrize(
    "seed", ["A", "N1", "%\n", "(", "\0", "N10033P1\n", "N1\n", "%\n%\n", "%N1P11", "9" * 50, "A1P1"]
)
def test_huge_garbage_is_refused_at_a_cost_that_grows_with_it(tmp_path, seed):
    machine = sample_machine(tmp_path)
    garbage = seed * (3_900_000 // len(seed))

    def read(text):
        with pytest.raises(InputError):
            parse(machine, text)

    for head in ("%\n", "%\nN03620", "%\n" + seed):
        assert grows_with_its_file(read, seed, head)
        read(head + garbage)
    with pytest.raises(InputError, match="a file of this kind has at most 4000000"):
        parse(machine, garbage * 2)


@given(
    st.lists(
        st.one_of(
            st.sampled_from([*SAMPLE.split(), "N03620Q1A1P1A2P-", "N10041Q0P1", "%", "", "(x)", "N", "P", "٣", ";"]),
            st.text("NAPQ0123456789.+-%; ();\r\n", max_size=12),
            st.text(max_size=6),
        ),
        max_size=40,
    )
)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_text_is_parsed_or_refused_but_never_crashes(tmp_path, lines):
    machine = sample_machine(tmp_path)
    try:
        tables = parse(machine, "\n".join(["%", *lines, "%"]))
    except InputError as error:
        assert str(error).isprintable()
    else:
        assert any(tables.blocks)


# --- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("detectionunit_um = 1.0", "detection_unit_um"),
        ("magnification = 101", "from 1 to 100"),
        ("magnification = 1.5", "whole number"),
        ('stores = "minus"', "'correction', 'error'"),
        ("real_point = false", "interval_unit_mm"),
        ("interval_mm = { X = 0.0005 }", "expected a multiple of 0.001 mm"),
        ("interval_mm = { A = 5.0 }", "not a known key"),
        ("real_point = false\ninterval_unit_mm = 1.0\ninterval_mm = { Y = 2.5 }", "expected a multiple of 1.0 mm"),
        ("number_base = 0", "q_word = true"),
        ("axis_numbers = { X = 2 }", "same number"),
        ("first_number = 30\nlast_number = 20", "below first_number"),
    ],
)
def test_a_wrong_setting_is_refused_with_the_reason(tmp_path, options, words):
    machine = machine_of(tmp_path, options)
    with pytest.raises(InputError, match=re.escape(words)):
        CONTROL.read_settings(machine)


# --- trilinear -------------------------------------------------------------------------------------------------------


#: Corner (x, y, z) of C1 ... C8 in FANUC's formula: around the lower face, then the upper one.
FANUC_CORNERS = (
    (0, 0, 0),
    (1, 0, 0),
    (1, 1, 0),
    (0, 1, 0),
    (0, 0, 1),
    (1, 0, 1),
    (1, 1, 1),
    (0, 1, 1),
)


def box_of_corners(corners):
    """Return a grid of one box (2, 2, 2, k) from values (8, k) in FANUC's order C1 ... C8."""
    values = np.asarray(corners, dtype=np.float64)
    box = np.empty((2, 2, 2, values.shape[1]))
    for corner, value in zip(FANUC_CORNERS, values, strict=True):
        box[corner] = value
    return box


def test_the_worked_box_in_fanuc_order_gives_36_and_2():
    ratio = np.array([[0.25, 0.5, 0.75]])
    ramp = box_of_corners(np.arange(0.0, 64.0, 8.0)[:, None])
    assert trilinear(ramp, np.zeros(3), np.ones(3), ratio)[0, 0] == 36.0
    second = np.zeros((8, 1))
    second[1] = 8.0
    assert trilinear(box_of_corners(second), np.zeros(3), np.ones(3), np.array([[0.25, 0.0, 0.0]]))[0, 0] == 2.0


def test_the_formula_of_the_manual_agrees_term_by_term():
    rng = np.random.default_rng(8)
    corners = rng.normal(size=(8, 3))
    x, y, z = ratio = rng.uniform(size=3)
    c1, c2, c3, c4, c5, c6, c7, c8 = corners
    by_hand = (
        c1 * (1 - x) * (1 - y) * (1 - z)
        + c2 * x * (1 - y) * (1 - z)
        + c3 * x * y * (1 - z)
        + c4 * (1 - x) * y * (1 - z)
        + c5 * (1 - x) * (1 - y) * z
        + c6 * x * (1 - y) * z
        + c7 * x * y * z
        + c8 * (1 - x) * y * z
    )
    np.testing.assert_allclose(
        trilinear(box_of_corners(corners), np.zeros(3), np.ones(3), ratio[None])[0], by_hand, atol=1e-14
    )
    assert len(set(FANUC_CORNERS)) == 8


def test_a_regular_grid_agrees_with_another_implementation_and_is_clamped_outside():
    rng = np.random.default_rng(9)
    vertices = rng.normal(size=(4, 3, 2, 3))
    start, step = np.array([-100.0, 20.0, -5.0]), np.array([50.0, 12.5, 300.0])
    axes = tuple(start[k] + step[k] * np.arange(vertices.shape[k]) for k in range(3))
    last = np.array([axis[-1] for axis in axes])
    points = rng.uniform(start - 40.0, last + 40.0, (300, 3))
    expected = RegularGridInterpolator(axes, vertices)(np.clip(points, start, last))
    np.testing.assert_allclose(trilinear(vertices, start, step, points), expected, atol=1e-12)
    corner = trilinear(vertices, start, step, last[None] + 1e6)
    np.testing.assert_allclose(corner[0], vertices[-1, -1, -1], atol=1e-12)


def test_an_axis_with_one_vertex_is_constant_along_itself():
    vertices = np.arange(2.0)[:, None, None, None] * np.ones((1, 1, 1, 3))
    result = trilinear(vertices, np.zeros(3), np.array([10.0, 1.0, 1.0]), np.array([[5.0, -7.0, 9.0]]))
    np.testing.assert_array_equal(result, [[0.5, 0.5, 0.5]])
