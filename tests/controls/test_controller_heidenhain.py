"""HEIDENHAIN .COM and .CMA tables, tables saved on a control, and the KinematicsComp draft."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import compgen
from compgen.controls import SourceFile, controller_named
from compgen.controls.heidenhain_com import GRADIENT_SHARE, intervals, spacing_mm
from compgen.controls.shared.grids import curve_nodes_mm
from compgen.controls.shared.terms import one_dimensional_terms
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import read_machine
from compgen.errors import CompgenWarning, InputError
from compgen.tables import export

GOLDEN = Path(__file__).parents[1] / "golden" / "heidenhain-com"
COM, CMA = (GOLDEN / "AXIS_Y.COM").read_text(), (GOLDEN / "CONFIG.CMA").read_text()
EMPTY = (GOLDEN / "EMPTY.COM").read_bytes()
CONTROL, DRAFT = controller_named("heidenhain-com"), controller_named("heidenhain-kinematics")
ROUNDING_MM = 1e-12
QUANTUM_MM = 1e-4
RANGES = ((-300.0, 500.0), (-90.0, 410.0), (-800.0, -20.0))


def machine_of(tmp_path, options="", chain="WXYFZT", name="heidenhain-com"):
    axes = "\n".join(
        f"[axes.{letter}]\nrange_mm = [{low}, {high}]\nnodes = {nodes}"
        for letter, (low, high), nodes in zip("XYZ", RANGES, (9, 6, 14), strict=True)
    )
    path = tmp_path / "machine.toml"
    path.write_text(
        f'name = "asymmetric"\nchain = "{chain}"\nreference_point_mm = [-100.0, 10.0, -500.0]\n'
        f"tool_offset_mm = [10.0, -20.0, -150.0]\n{axes}\n[controllers.{name}]\n{options}\n"
    )
    return read_machine(path)


def parse(machine, com=COM, cma=CMA):
    files = [SourceFile(Path("CONFIG.CMA"), cma), SourceFile(Path("AXIS_Y.COM"), com)]
    return CONTROL(machine).parse(files)


def read_back(control, machine, made):
    sources = [SourceFile(Path(name), text) for name, text in made.files.items()]
    return control(machine).parse(sources)


def added(machine, tables, position_mm, approach=None):
    points = Points(np.atleast_2d(np.array(position_mm, dtype=float)), approach=approach)
    return CONTROL(machine).emulate(tables, points)


def at_y(*values):
    return [[7.0, value, -33.0] for value in values]


# --- golden values ---------------------------------------------------------------------------------------------------


def test_the_sample_tables_give_their_values_and_the_control_subtracts_them(tmp_path):
    machine = machine_of(tmp_path)
    found = added(machine, parse(machine), at_y(-15.0, 35.0, 200.0, -500.0))
    expected = -np.array([[0, 0.0035, 0.0070], [0, 0.0040, 0.0080], [0, 0.0030, 0.0060], [0, 0, 0]])
    np.testing.assert_allclose(found, expected, atol=ROUNDING_MM)


def test_with_the_other_sign_the_control_adds_them(tmp_path):
    machine = machine_of(tmp_path, 'sign = "correction"')
    np.testing.assert_allclose(added(machine, parse(machine), at_y(-15.0)), [[0, 0.0035, 0.0070]], atol=ROUNDING_MM)


def test_spacing_counts_and_positions_are_those_of_the_manual():
    assert spacing_mm(16) == Decimal("6.5536")
    assert (intervals(500.0, spacing_mm(16)), intervals(800.0, spacing_mm(16))) == (77, 123)
    ladder = [spacing_mm(n) for n in range(10, 19)]
    printed = "0.1024 0.2048 0.4096 0.8192 1.6384 3.2768 6.5536 13.1072 26.2144"
    assert ladder == [Decimal(text) for text in printed.split()]
    assert float(spacing_mm(16)) * GRADIENT_SHARE == pytest.approx(0.1024, abs=1e-15)


def test_a_table_with_datum_and_spacing_of_the_manual_stands_on_its_positions(tmp_path, make_errors):
    options = 'generation = "power-of-two"\nspacing_exponent = { X = 20, Y = 16, Z = 20 }\ndatum_mm = { Y = -90.0 }'
    machine = machine_of(tmp_path, options)
    made = export(machine, make_errors(machine), "heidenhain-com")
    positions = [line.split()[1] for line in made.files["AXIS_Y.COM"].splitlines()[2:-1]]
    printed = ["-90.0000", "-76.8928", "-63.7856", "-50.6784", "-37.5712", "-24.4640", "-11.3568", "1.7504"]
    assert positions[:15:2] == printed
    assert float(positions[-2]) >= 410.0
    assert made.violations == []


# --- assignment ------------------------------------------------------------------------------------------------------


def test_a_table_acts_over_the_axis_in_whose_column_of_the_assignment_it_stands(tmp_path):
    machine = machine_of(tmp_path)
    over_x = CMA.replace("0    *                     AXIS_Y.COM", "0    *        AXIS_Y.COM")
    found = added(machine, parse(machine, cma=over_x), [[-15.0, 300.0, 0.0]])
    np.testing.assert_allclose(found, [[0, -0.0035, -0.0070]], atol=ROUNDING_MM)


def test_several_tables_into_one_axis_add_up_and_only_the_marked_line_counts(tmp_path):
    machine = machine_of(tmp_path)
    cma = "BEGIN CONFIG .CMA MM\nNR   ACTIVE   X            Y            Z\n"
    cma += "0                          A.COM\n1    *                     A.COM        B.COM\n[END]\n"
    other = COM.replace("0.0100", "0.0200").replace("AXIS_Y", "B")
    files = [SourceFile(Path(n), t) for n, t in (("a.com", COM), ("NOT-ACCEPTED-B.COM", other), ("C.CMA", cma))]
    tables = CONTROL(machine).parse(files)
    found = added(machine, tables, [[0.0, 10.0, 10.0]])
    np.testing.assert_allclose(found, [[0, -0.0050 - 0.0050, -0.0100 - 0.0200]], atol=ROUNDING_MM)


def test_crlf_blank_lines_tabs_and_wide_gaps_do_no_harm(tmp_path):
    machine = machine_of(tmp_path)
    text = COM.replace("1    -40.0000     0.0000", "\n; a comment\n1\t-40.0000       0.0000").replace("\n", "\r\n")
    assert parse(machine, text) == parse(machine)


def test_a_table_that_is_not_used_is_named(tmp_path):
    machine = machine_of(tmp_path)
    files = [SourceFile(Path(n), t) for n, t in (("AXIS_Y.COM", COM), ("B.COM", COM), ("C.CMA", CMA))]
    with pytest.warns(CompgenWarning, match="B: not in the active line"):
        CONTROL(machine).parse(files)


# --- export ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize("options", ["", 'sign = "correction"', 'generation = "power-of-two"'])
def test_the_files_do_what_the_terms_say(tmp_path, make_errors, chain, options):
    machine = machine_of(tmp_path, options, chain)
    errors = make_errors(machine)
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(errors)
    generator = np.random.default_rng(2)
    values = {term.name: generator.normal(0.0, 0.01, len(term.nodes_mm)) for term in basis}
    built = CONTROL(machine, chosen).build(basis, values)
    position = generator.uniform(machine.lower_mm, machine.upper_mm, (200, 3))
    wanted = np.zeros((200, 3))
    for term in basis:
        wanted += term.carrier_field(position, np.zeros(3)) * term.curve(values[term.name], position)[:, None]
    found = CONTROL(machine, chosen).emulate(built, Points(position))
    assert np.max(np.abs(found - wanted)) <= CONTROL(machine, chosen).resolution_mm() + ROUNDING_MM


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize("options", ["", 'sign = "correction"', 'generation = "power-of-two"\nmax_points = 60'])
def test_exported_files_are_read_back_and_accepted(tmp_path, make_errors, chain, options):
    machine = machine_of(tmp_path, options, chain)
    errors = make_errors(machine)
    made = export(machine, errors, "heidenhain-com")
    paths = made.write(tmp_path / "out")
    assert sorted(made.files) == ["AXIS_X.COM", "AXIS_Y.COM", "AXIS_Z.COM", "CONFIG.CMA"]
    result = compgen.verify(machine, compgen.read_tables(machine, paths, "heidenhain-com"), errors)
    assert result.accepted, result.reasons
    assert result.after_rigid_removed.rms_um < 0.7 * result.before_rigid_removed.rms_um


def test_an_axis_that_goes_too_far_gets_a_positive_entry(tmp_path):
    """ISO: a positive EYY means that the tool goes too far; the entry is that error, the axis is moved back."""
    machine = machine_of(tmp_path)
    nodes = machine.axes[1].nodes_mm
    errors = ErrorTable({"EYY": Curve(nodes, 2e-5 * (nodes - 10.0), np.full(len(nodes), np.nan))})
    made = export(machine, errors, "heidenhain-com")
    last = made.files["AXIS_Y.COM"].splitlines()[-2].split()
    assert last[1:] == ["420.0000", "0.0000", "0.0000", "0.0080", "0.0000"]
    found = added(machine, read_back(CONTROL, machine, made), at_y(410.0, 500.0))
    np.testing.assert_allclose(found, [[0, -0.008, 0], [0, -0.008, 0]], atol=ROUNDING_MM)


def test_free_positions_stand_where_the_curves_bend(tmp_path):
    """One kink: the ends, the kink and the reference point do; beyond both ends stands one more row."""
    machine = machine_of(tmp_path)
    nodes = machine.axes[2].nodes_mm
    value = np.where(nodes > -200.0, 1e-4 * (nodes + 200.0), 0.0)
    errors = ErrorTable({"EXZ": Curve(nodes, value, np.full(len(nodes), np.nan))})
    rows = [line.split() for line in export(machine, errors, "heidenhain-com").files["AXIS_Z.COM"].splitlines()[2:-1]]
    assert [row[1] for row in rows] == ["-810.0000", "-800.0000", "-500.0000", "-200.0000", "-20.0000", "-10.0000"]
    assert rows[0][3] == rows[1][3]
    assert rows[-1][3] == rows[-2][3]


def test_free_positions_lose_less_than_what_is_wanted_also_where_curves_times_position_are_bent(tmp_path, make_errors):
    machine = machine_of(tmp_path, "loss_um = 0.2")
    errors = make_errors(machine)
    errors = ErrorTable(
        {name: Curve(c.position_mm, c.value, np.full(len(c.value), np.nan)) for name, c in errors.curves.items()}
    )
    chosen = CONTROL.read_settings(machine)
    nodes = {term.axis: term.nodes_mm for term in CONTROL(machine, chosen).basis(errors)}
    for axis in range(3):
        dense = np.linspace(*machine.axes[axis].range_mm, 5001)
        pairs = [(output, axis) for output in range(3)]
        for term in one_dimensional_terms(machine, errors, [dense] * 3, pairs):
            lost = term.start - np.interp(dense, nodes[axis], np.interp(nodes[axis], dense, term.start))
            assert np.max(np.abs(lost)) < 0.25e-3
        assert len(nodes[axis]) <= 4 * len(curve_nodes_mm(machine, errors, axis))


def test_limits_that_are_stated_are_enforced(tmp_path, make_errors):
    options = 'generation = "power-of-two"\nmax_points = 20\nmax_tables = 2\nmax_total_points = 40\n'
    machine = machine_of(tmp_path, options + "spacing_exponent = { X = 16 }")
    found = " ".join(export(machine, make_errors(machine), "heidenhain-com").violations)
    assert "error 3" in found
    assert "error 4" in found
    assert "error 5" in found


def test_a_spacing_that_is_no_power_of_two_breaks_a_limit_of_the_older_controls(tmp_path):
    machine = machine_of(tmp_path, 'generation = "power-of-two"')
    found = CONTROL(machine).violations(parse(machine))
    assert any("50.0000 mm; expected one power of two" in text for text in found)
    assert any("covers -90 ... 60 mm of Y" in text for text in found)


# --- both directions -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("meaning", ["absolute", "difference"])
@pytest.mark.parametrize("sign", ["error", "correction"])
def test_the_column_backlash_takes_a_reversal_out(tmp_path, make_errors, meaning, sign):
    machine = machine_of(tmp_path, f'backlash_column = "{meaning}"\nsign = "{sign}"')
    errors = make_errors(machine)
    nodes = machine.axes[1].nodes_mm
    curve = Curve(nodes, np.linspace(-0.008, -0.002, len(nodes)), np.full(len(nodes), np.nan))
    across = Curve(np.zeros(1), np.array([0.003]), np.array([np.nan]))
    reversal = ReversalCurves({(1, 1): curve, (0, 2): across})
    plain = read_back(CONTROL, machine, export(machine, errors, "heidenhain-com"))
    made = export(machine, errors, "heidenhain-com", reversal=reversal)
    tables = read_back(CONTROL, machine, made)
    position = np.random.default_rng(4).uniform(machine.lower_mm, machine.upper_mm, (50, 3))
    for direction in (1.0, -1.0):
        approach = np.full((50, 3), direction)
        change = added(machine, tables, position, approach) - added(machine, plain, position)
        expected = np.zeros((50, 3))
        expected[:, 1] = -0.5 * direction * curve.at(position[:, 1])
        assert np.max(np.abs(change - expected)) < 2 * QUANTUM_MM
    mean = added(machine, tables, position)
    np.testing.assert_allclose(mean, added(machine, plain, position), atol=2 * QUANTUM_MM)
    assert "reversal X in Z" in " ".join(made.warnings)


def test_a_reversal_becomes_a_parameter_while_the_column_stays_empty(tmp_path, make_errors):
    machine = machine_of(tmp_path)
    curve = Curve(np.zeros(1), np.array([-0.006]), np.array([np.nan]))
    made = export(machine, make_errors(machine), "heidenhain-com", reversal=ReversalCurves({(1, 1): curve}))
    assert "| `MP_backLash of Y` | 0.0060 mm in size |" in made.preflight
    assert all(line.split()[2] == "0.0000" for line in made.files["AXIS_Y.COM"].splitlines()[2:-1])


def test_a_filled_column_backlash_is_refused_until_its_meaning_is_stated(tmp_path):
    text = COM.replace("-40.0000     0.0000", "-40.0000     0.0010")
    with pytest.raises(InputError, match=r"AXIS_Y.COM:2: the column BACKLASH is filled"):
        parse(machine_of(tmp_path), text)
    machine = machine_of(tmp_path, 'backlash_column = "absolute"')
    found = added(machine, parse(machine, text), at_y(-40.0, -40.0), np.array([[0, 1.0, 0], [0, -1.0, 0]]))
    np.testing.assert_allclose(found[:, 1], [-0.0020, -0.0010], atol=ROUNDING_MM)


# --- tables saved on the control -------------------------------------------------------------------------------------


def with_template(tmp_path, content, options=""):
    path = tmp_path / "SAVED.COM"
    path.write_bytes(content)
    return machine_of(tmp_path, options).with_setting("heidenhain-com", "template_from", str(path))


def test_a_saved_table_keeps_its_lines_columns_and_line_ends_byte_for_byte(tmp_path, make_errors):
    machine = with_template(tmp_path, EMPTY)
    errors = make_errors(machine)
    made = export(machine, errors, "heidenhain-com")
    plain = export(machine_of(tmp_path), errors, "heidenhain-com")
    head, tail = EMPTY.decode().split("[END]")
    for name in ("AXIS_X.COM", "AXIS_Y.COM", "AXIS_Z.COM"):
        text = made.files[name]
        assert text.startswith(head)
        assert text.endswith("[END]" + tail)
        assert text.count("\n") == text.count("\r\n")
        header = head.splitlines()[1]
        starts = [match.start() for match in re.finditer(r"\S+", header)]
        row = text.splitlines()[4].ljust(200)
        assert [row[start] != " " for start in starts] == [True] * 6 + [False]
        assert all(row[start - 1] == " " for start in starts[1:])
    again = read_back(CONTROL, machine, made)
    assert again == read_back(CONTROL, machine_of(tmp_path), plain)


def test_the_command_line_takes_the_saved_table(tmp_path, make_errors):
    machine = machine_of(tmp_path)
    errors = tmp_path / "e.errors.csv"
    errors.write_text(compgen.format_errors(make_errors(machine)))
    words = ["export", str(machine.source), str(errors), "--controller", "heidenhain-com", "--out", str(tmp_path / "o")]
    saved = tmp_path / "S.COM"
    saved.write_bytes(EMPTY)
    from compgen.cli import cli
    from compgen.cli.common import run_command

    assert run_command(cli, [*words, "--template-from", str(saved)]) == 0
    assert (tmp_path / "o" / "AXIS_Z.COM").read_bytes().startswith(b"BEGIN NEU .COM MM\r\nNR      AXISPOS ")


def test_the_name_in_the_first_line_follows_the_file_if_that_is_wanted(tmp_path, make_errors):
    machine = with_template(tmp_path, EMPTY, 'begin_name = "file"')
    made = export(machine, make_errors(machine), "heidenhain-com")
    assert made.files["AXIS_X.COM"].startswith("BEGIN AXIS_X .COM MM\r\nNR      AXISPOS")


def test_words_behind_the_unit_and_lines_before_the_header_of_a_saved_table_stay(tmp_path, make_errors):
    content = EMPTY.replace(b" MM\r\n", b" MM VERSION:2\r\n#TABLE of the control\r\n")
    machine = with_template(tmp_path, content, 'begin_name = "file"')
    made = export(machine, make_errors(machine), "heidenhain-com")
    expected = "BEGIN AXIS_Y .COM MM VERSION:2\r\n#TABLE of the control\r\nNR      AXISPOS"
    assert made.files["AXIS_Y.COM"].startswith(expected)
    assert sorted(read_back(CONTROL, machine, made).tables) == [0, 1, 2]


def test_an_assignment_saved_on_the_control_is_filled_in_too(tmp_path, make_errors):
    saved = tmp_path / "SAVED.CMA"
    saved.write_bytes(b"BEGIN CONF .CMA MM\r\nNR  ACTIVE  A           X               Y               Z\r\n[END]\r\n")
    machine = machine_of(tmp_path, 'cma_template_from = "SAVED.CMA"')
    made = export(machine, make_errors(machine), "heidenhain-com")
    row = "0   *                   AXIS_X.COM      AXIS_Y.COM      AXIS_Z.COM"
    assert made.files["CONFIG.CMA"] == saved.read_bytes().decode().replace("[END]", row + "\r\n[END]")
    assert sorted(read_back(CONTROL, machine, made).tables) == [0, 1, 2]


def test_a_saved_table_without_positions_needs_datum_and_spacing(tmp_path, make_errors):
    old = b"BEGIN Y .COM MM\nNR     X           Y           Z\n[END]\n"
    start = 'generation = "power-of-two"\n'
    with pytest.raises(InputError, match="datum_mm"):
        CONTROL.read_settings(with_template(tmp_path, old, start))
    stated = "datum_mm = { X = -320.0, Y = -100.0, Z = -810.0 }\nspacing_exponent = { X = 20, Y = 16, Z = 20 }"
    machine = with_template(tmp_path, old, start + stated)
    errors = make_errors(machine)
    made = export(machine, errors, "heidenhain-com")
    assert made.files["AXIS_Y.COM"].splitlines()[2].split()[0] == "0"
    assert len(made.files["AXIS_Y.COM"].splitlines()[2].split()) == 4
    tables = read_back(CONTROL, machine, made)
    assert tables.tables[1].positions[:2] == (Decimal("-100"), Decimal("-93.4464"))
    with_positions = machine_of(tmp_path, start + stated)
    plain = read_back(CONTROL, with_positions, export(with_positions, errors, "heidenhain-com"))
    for axis in range(3):
        assert tables.tables[axis].positions == plain.tables[axis].positions
        assert tables.tables[axis].columns == plain.tables[axis].columns


@pytest.mark.parametrize(
    ("content", "line", "message"),
    [
        (b"", 1, "first line"),
        (b"BEGIN NEU .COM MM\r\n[END]\r\n", 2, "header row"),
        (EMPTY.replace(b"[END]", b""), 4, "truncated"),
        (EMPTY.replace(b"MM", b"INCH"), 1, "inches"),
        (EMPTY.replace(b".COM", b".TCH"), 1, "type TCH"),
        (EMPTY.replace(b"Y ", b"B "), 2, "no column Y"),
        (EMPTY.replace(b"AXISPOS", b"POS    "), 2, "no column AXISPOS"),
        (EMPTY.replace(b"Z            A", b"A            A"), 2, "twice"),
        (EMPTY.replace(b"[END]", b"0       10.0\r\n[END]"), 3, "without values"),
        (EMPTY.replace(b"MM\r\n", b"MM\n"), 2, "mixed"),
        (EMPTY.replace(b"NEU", b"N\xdc"), 1, "not ASCII"),
        (b"BEGIN N .COM MM\nNR AXISPOS X Y Z\n[END]\n", 2, "wider columns"),
    ],
)
def test_a_saved_table_that_cannot_be_filled_is_refused_with_its_line(tmp_path, make_errors, content, line, message):
    machine = with_template(tmp_path, content)
    with pytest.raises(InputError, match=message) as caught:
        export(machine, make_errors(machine), "heidenhain-com")
    assert (caught.value.file.name, caught.value.line) == ("SAVED.COM", line)


# --- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        'sign = "plus"',
        'generation = "new"',
        'axis_names = { X = "Y" }',
        'axis_names = { X = "NR" }',
        "decimals = 9",
        "spacing_exponent = { X = 16 }",
        'generation = "power-of-two"\nbacklash_column = "absolute"',
        'generation = "power-of-two"\ndatum_mm = { X = 0.00001 }',
        'template_from = "missing.com"',
        "unknown = 1",
    ],
)
def test_settings_that_make_no_sense_are_refused(tmp_path, options):
    with pytest.raises(InputError):
        CONTROL.read_settings(machine_of(tmp_path, options))


def test_columns_carry_the_names_of_the_control(tmp_path, make_errors):
    machine = machine_of(tmp_path, 'axis_names = { X = "1", Y = "2", Z = "3" }')
    made = export(machine, make_errors(machine), "heidenhain-com")
    assert made.files["AXIS_X.COM"].splitlines()[1].split() == ["NR", "AXISPOS", "BACKLASH", "1", "2", "3"]
    assert made.files["CONFIG.CMA"].splitlines()[1].split() == ["NR", "ACTIVE", "1", "2", "3"]
    assert sorted(read_back(CONTROL, machine, made).tables) == [0, 1, 2]


# --- malformed files -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "line", "message"),
    [
        ("[END]\n", "", 7, "truncated"),
        ("0.0030     0.0060\n[END]\n", "0.0030     0.00", 6, "truncated"),
        ("BEGIN", "ANFANG", 1, "first line"),
        (" MM", " INCH", 1, "inches"),
        (" MM", "", 1, "has no unit"),
        ("NR   AXISPOS", "NO   AXISPOS", 2, "header row"),
        ("     Z\n", "     Y\n", 2, "twice"),
        ("     Z\n", "     Q\n", 3, "is not an axis of the machine file"),
        ("0.0020", "0,0020", 4, "comma"),
        ("0.0020", "2.0e-3", 4, "exponent"),
        ("0.0020", "nan", 4, "not a number"),
        ("0.0020", "inf", 4, "not a number"),
        ("0.0020     0.0040", "0.0020", 4, "column Z is blank"),
        ("0.0020     0.0040", "0.0020     0.0040   7", 4, "6 values are given for 5 columns"),
        ("0.0020     0.0040", "           0.0040", 4, "column Y is blank"),
        ("10.0000 ", "-40.0000", 5, "ascend"),
        ("10.0000 ", "-60.0000", 5, "ascend"),
        ("\n2    10", "\n3    10", 5, "expected 2"),
        ("\n2    10", "\n1    10", 5, "expected 2"),
        ("[END]\n", "[END]\nmore\n", 8, "the end of the table"),
        ("0.0050", "0.005\u20ac", 5, "printable ASCII"),
        ("0.0050", "0.0050" + " " * 2000, 5, "characters"),
    ],
)
def test_a_malformed_table_is_refused_with_its_line(tmp_path, before, after, line, message):
    text = COM.replace(before, after, 1)
    assert text != COM
    with pytest.raises(InputError, match=message) as caught:
        parse(machine_of(tmp_path), text)
    assert (caught.value.file.name, caught.value.line) == ("AXIS_Y.COM", line)


@pytest.mark.parametrize(
    ("before", "after", "line", "message"),
    [
        ("0    *  ", "0       ", 2, "no line is marked"),
        ("0    *  ", "0    x  ", 3, "'\\*' or nothing"),
        ("AXIS_Y.COM", "AXIS_Q.COM", 3, "not among the given files"),
        ("AXIS_Y.COM", "AXIS_Y.TXT", 3, "not the name of a .COM file"),
        ("ACTIVE", "AKTIV ", 2, "no column ACTIVE"),
        ("Y            Z", "B            Z", 3, "is not an axis of the machine file"),
        ("\n[END]", "\n1    *                     AXIS_Y.COM\n[END]", 4, "second line"),
        ("AXIS_Y.COM", "", 3, "contains no .COM file"),
        ("[END]\n", "", 4, "truncated"),
    ],
)
def test_a_malformed_assignment_is_refused_with_its_line(tmp_path, before, after, line, message):
    text = CMA.replace(before, after, 1)
    assert text != CMA
    with pytest.raises(InputError, match=message) as caught:
        parse(machine_of(tmp_path), cma=text)
    assert (caught.value.file.name, caught.value.line) == ("CONFIG.CMA", line)


def test_a_set_without_assignment_or_with_two_is_refused(tmp_path):
    machine = machine_of(tmp_path)
    chosen = CONTROL.read_settings(machine)
    com, cma = SourceFile(Path("AXIS_Y.COM"), COM), SourceFile(Path("CONFIG.CMA"), CMA)
    for files, message in (
        ([com], "no .CMA file"),
        ([com, cma, SourceFile(Path("B.CMA"), CMA)], "second .CMA"),
        ([com, com, cma], "same table"),
        ([], "no .CMA file"),
    ):
        with pytest.raises(InputError, match=message):
            CONTROL(machine, chosen).parse(files)


GARBAGE = [b"\n" * 10_000_000, b"A" * 100_000_000, b"0 " * 5_000_000, b"NR\n" * 1_000_000]


@pytest.mark.parametrize("garbage", GARBAGE, ids=["lines", "one line", "numbers", "headers"])
def test_garbage_is_refused_for_its_size_before_it_is_parsed(tmp_path, garbage):
    machine, text = machine_of(tmp_path), garbage.decode("ascii")
    with pytest.raises(
        InputError, match=f"has {len(text)} characters; a file of this kind has at most 2000000"
    ) as caught:
        parse(machine, text)
    assert caught.value.line is not None


PIECES = [
    "0",
    "1",
    "\n",
    " ",
    "     ",
    "*",
    "[END]",
    "NR",
    "Y",
    "AXISPOS",
    "-",
    ".",
    ",",
    "e",
    "BEGIN",
    ".COM MM",
    "\u0663",
]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    which=st.booleans(),
    cut=st.tuples(st.integers(0, 260), st.integers(0, 12)),
    put=st.lists(st.sampled_from(PIECES), max_size=5).map("".join),
)
def test_any_text_is_read_or_refused(tmp_path, which, cut, put):
    text = COM if which else CMA
    text = text[: cut[0]] + put + text[cut[0] + cut[1] :]
    machine = machine_of(tmp_path)
    try:
        tables = parse(machine, text) if which else parse(machine, cma=text)
    except InputError:
        return
    found = added(machine, tables, at_y(-15.0))
    assert np.all(np.isfinite(found))


# --- KinematicsComp --------------------------------------------------------------------------------------------------


def test_the_draft_needs_to_be_allowed(tmp_path, make_errors):
    machine = machine_of(tmp_path, name="heidenhain-kinematics")
    with pytest.raises(InputError, match="--allow-unverified"):
        export(machine, make_errors(machine), "heidenhain-kinematics")


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_the_draft_holds_all_errors_and_is_accepted(tmp_path, make_errors, chain, unit):
    machine = machine_of(tmp_path, f'angle_unit = "{unit}"', chain, "heidenhain-kinematics")
    errors = make_errors(machine)
    made = export(machine, errors, "heidenhain-kinematics", allow_unverified=True)
    paths = made.write(tmp_path / "out")
    result = compgen.verify(machine, compgen.read_tables(machine, paths, "heidenhain-kinematics"), errors)
    assert result.accepted, result.reasons
    assert result.after.max_um < 0.5
    assert "DRAFT" in made.preflight


@pytest.mark.parametrize("reference", ["X", "Y"])
def test_the_draft_holds_a_machine_far_out_of_square_to_below_a_micrometre(tmp_path, make_errors, reference):
    """At 2.9 mrad the finite rotations of the control differ from the sum of the tables by 4 um over a metre."""
    machine = machine_of(tmp_path, chain="WFYXZT", name="heidenhain-kinematics")
    machine = replace(machine, squareness_reference=reference)
    straight = make_errors(machine)
    (name,) = {"EC0Y", "EC0X"} & set(straight.squareness)
    errors = straight.replace(squareness={**straight.squareness, name: (2.9e-3, 0.0)})
    made = export(machine, errors, "heidenhain-kinematics", allow_unverified=True)
    paths = made.write(tmp_path / "out")
    result = compgen.verify(machine, compgen.read_tables(machine, paths, "heidenhain-kinematics"), errors)
    assert result.accepted, result.reasons
    assert result.before.max_um > 1000 and result.after.max_um < 0.5


def test_columns_rows_and_units_of_the_draft_are_those_of_the_manual(tmp_path):
    machine = machine_of(tmp_path, chain="WFYXZT", name="heidenhain-kinematics")
    nodes = machine.axes[0].nodes_mm
    slope = {"EXX": 1e-5, "EYX": 2e-5, "EZX": -1e-5, "EAX": 1e-8, "EBX": 2e-8, "ECX": -1e-8}
    curves = {name: Curve(nodes, value * (nodes + 100.0), np.full(len(nodes), np.nan)) for name, value in slope.items()}
    chosen = DRAFT.read_settings(machine)
    errors = ErrorTable(curves, {"EC0Y": (1e-4, 0.0)})
    basis = DRAFT(machine, chosen).basis(errors)
    tables = DRAFT(machine, chosen).build(basis, {term.name: term.start for term in basis})
    context = DRAFT(machine, chosen).context(tables)
    last = context["com"]["X"]["rows"][-1]
    degrees = [math.degrees(slope[name] * 600.0) for name in ("EAX", "EBX", "ECX")]
    assert last[1:5] == ["510.0000", "0.0060", "0.0120", "-0.0060"]
    np.testing.assert_allclose([float(cell) for cell in last[5:]], degrees, atol=0.51e-7)
    rows = [row[1:] for row in context["chain_rows"]["rows"]]
    x = [row for row in rows if row[0].endswith("X")]
    assert [(row[0], row[2], row[4]) for row in x] == [
        ("EXX", "X", "X..C1"),
        ("EYX", "Y", "X..C2"),
        ("EZX", "Z", "X..C3"),
        ("EAX", "A", "X..C4"),
        ("EBX", "B", "X..C5"),
        ("ECX", "C", "X..C6"),
    ]
    assert [row[2] for row in rows if row[1] == "MachAxis"] == ["Z", "X", "Y"]
    at = [row[0] for row in rows].index("EC0Y")
    assert [row[0] for row in rows[at:]] == ["EC0Y", "", "-EC0Y"]
    assert float(rows[at][4]) == -float(rows[at + 2][4]) == pytest.approx(math.degrees(1e-4), abs=1e-7)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("X..C2", "X..C3", "expected EYX along Y with X..C2"),
        ("X..C2", "Y..C2", "expected EYX along Y with X..C2"),
        ("X..C2", "X.C2", "expected a row such as"),
        ("-EA0Z ", "-EC0Y ", "cancels EC0Y after its axis: there is no such constant"),
        ("EYX ", "EQX ", "expected a row such as"),
    ],
)
def test_rows_that_do_not_fit_their_error_are_refused(tmp_path, make_errors, before, after, message):
    machine = machine_of(tmp_path, chain="WFYXZT", name="heidenhain-kinematics")
    made = export(machine, make_errors(machine), "heidenhain-kinematics", allow_unverified=True)
    texts = dict(made.files)
    changed = texts["KINCOMP.TAB"].replace(before, after, 1)
    assert changed != texts["KINCOMP.TAB"]
    files = [SourceFile(Path(name), text) for name, text in {**texts, "KINCOMP.TAB": changed}.items()]
    with pytest.raises(InputError, match=message) as caught:
        DRAFT(machine).parse(files)
    assert caught.value.line is not None
