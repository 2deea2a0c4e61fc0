"""Mitsubishi machine error compensation: the set sheet, its formulas, its limits."""

from __future__ import annotations

import itertools
import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import SourceFile, controller_named
from compgen.controls.mitsubishi import values_of
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import read_machine
from compgen.errors import CompgenWarning, InputError
from compgen.tables import export
from compgen.tables.options import _variants

GOLDEN = Path(__file__).parents[1] / "golden" / "mitsubishi" / "SETSHEET.CSV"
SAMPLE = GOLDEN.read_text()
CONTROL = controller_named("mitsubishi")
UM = 1e-3
ROUNDING_MM = 1e-12
RANGES = ((-300.0, 500.0), (-90.0, 410.0), (-800.0, -20.0))
REFERENCE = (-100.0, 10.0, -500.0)


def machine_of(tmp_path, options="", chain="WXYFZT", ranges=RANGES, reference=REFERENCE):
    axes = "\n".join(
        f"[axes.{letter}]\nrange_mm = [{low}, {high}]\nnodes = {nodes}"
        for letter, (low, high), nodes in zip("XYZ", ranges, (9, 6, 14), strict=True)
    )
    path = tmp_path / "machine.toml"
    if "mode" not in options and "style_from" not in options:
        options += '\nmode = "incremental"'
    path.write_text(
        f'name = "asymmetric"\nchain = "{chain}"\nreference_point_mm = {list(reference)}\n'
        f"tool_offset_mm = [10.0, -20.0, -150.0]\n{axes}\n[controllers.mitsubishi]\n{options}\n"
    )
    return read_machine(path)


def parse(machine, text, name="SETSHEET.CSV"):
    return CONTROL(machine).parse([SourceFile(Path(name), text)])


def read_back(machine, made):
    sources = [SourceFile(Path(name), text) for name, text in made.files.items()]
    return CONTROL(machine).parse(sources)


def added(machine, tables, position_mm):
    return CONTROL(machine).emulate(tables, Points(np.array(position_mm, dtype=float)))


@pytest.mark.parametrize(
    ("options", "um"),
    [
        ("", 0.75),  # three tables act on an axis, each rounds to half of a count of half a setting unit of 1 um
        ("relative_errors = false", 0.25),
        ('relative_errors = ["Y(x)"]', 0.5),
        ("relative_errors = false\nscale = 3\nsetting_unit_um = 0.1", 0.075),
    ],
)
def test_rounding_costs_half_a_count_for_each_table_of_an_axis(tmp_path, options, um):
    assert CONTROL(machine_of(tmp_path, options)).resolution_mm() == pytest.approx(um * UM)


def test_the_worked_values_of_the_formulas_push_away_from_the_reference_point(tmp_path):
    """(100.000 - 99.990) x 2 = +20 on the positive side, (100.000 + -99.990) x 2 = +20 on the negative side."""
    machine = machine_of(tmp_path)
    tables = parse(machine, SAMPLE)
    x = np.array([-300.0, -200.0, -150.0, -100.0, -50.0, 0.0, 100.0, 999.0])
    found = added(machine, tables, np.column_stack([x, np.full(8, 10.0), np.zeros(8)]))
    expected_counts = np.array([-16, -20, -10, 0, 10, 20, 14, 14])
    np.testing.assert_allclose(found[:, 0], 0.5 * UM * expected_counts, atol=ROUNDING_MM)
    assert not found[:, 1:].any()
    # A feed of 100 mm that goes 99.990 mm comes out right on either side: the axis is 10 um short.
    assert 99.990 + found[5, 0] == pytest.approx(100.0, abs=ROUNDING_MM)
    assert -99.990 + found[1, 0] == pytest.approx(-100.0, abs=ROUNDING_MM)


def test_a_relative_error_moves_another_axis_by_scale_times_count(tmp_path):
    machine = machine_of(tmp_path)
    y = np.array([-90.0, 10.0, 35.0, 60.0, 110.0, 400.0])
    found = added(machine, parse(machine, SAMPLE), np.column_stack([np.full(6, -100.0), y, np.zeros(6)]))
    np.testing.assert_allclose(found[:, 2], np.array([0, 0, 1.5, 3.0, -189.0, -189.0]) * UM, atol=ROUNDING_MM)
    assert not found[:, :2].any()


def test_setting_unit_and_what_is_stored_are_settings(tmp_path):
    machine = machine_of(tmp_path, 'setting_unit_um = 0.1\nstores = "error"')
    found = added(machine, parse(machine, SAMPLE), [[0.0, 10.0, 0.0]])
    np.testing.assert_allclose(found, [[-1.0 * UM, 0, 0]], atol=ROUNDING_MM)


def test_stored_values_and_curve_belong_together():
    """A[n] = A[n-1] + v[n] above, A[n] = A[n+1] - v[n] below, by hand."""
    curve = np.array([-16, -20, 0, 20, 14])
    assert values_of(curve, 2) == (-4, 20, 0, 20, -6)
    assert values_of(curve - curve[0], 0) == (0, -4, 20, 20, -6)
    assert values_of(curve - curve[4], 4) == (-4, 20, 20, -6, 0)


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize(
    "options", ["", "relative_errors = false", "scale = 3\nsetting_unit_um = 0.5", 'stores = "error"']
)
def test_exported_sheets_are_read_back_and_accepted(tmp_path, make_errors, chain, options):
    machine = machine_of(tmp_path, options, chain)
    errors = make_errors(machine)
    made = export(machine, errors, "mitsubishi")
    assert made.violations == []
    paths = made.write(tmp_path / "out")
    result = compgen.verify(machine, compgen.read_tables(machine, paths, "mitsubishi"), errors)
    assert result.accepted, result.reasons
    assert result.after_rigid_removed.rms_um < result.before_rigid_removed.rms_um
    plan = json.loads(made.files["SETSHEET.plan.json"])
    rows = [row.split(",") for row in made.files["SETSHEET.CSV"].splitlines()[1:]]
    assert {**plan["parameters"], **{k: str(v) for k, v in plan["values"].items()}} == {
        row[0].removeprefix("#"): row[1] for row in rows
    }


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
def test_the_sheet_does_what_the_terms_say_to_within_half_a_count_each(tmp_path, make_errors, chain):
    machine = machine_of(tmp_path, "", chain)
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(make_errors(machine))
    generator = np.random.default_rng(6)
    values = {}
    for term in basis:
        walk = np.cumsum(generator.normal(0.0, 4 * UM, len(term.nodes_mm)))
        values[term.name] = walk - np.interp(term.zero_at_mm, term.nodes_mm, walk)
    tables = CONTROL(machine, chosen).build(basis, values)
    position = generator.uniform(machine.lower_mm, machine.upper_mm, (300, 3))
    wanted = np.zeros((300, 3))
    for term in basis:
        wanted += term.carrier_field(position, np.zeros(3)) * term.curve(values[term.name], position)[:, None]
    found = CONTROL(machine, chosen).emulate(tables, Points(position))
    assert np.max(np.abs(found - wanted)) <= 3 * 0.25 * UM + ROUNDING_MM


def test_the_whole_numbers_are_the_best_ones_by_brute_force(tmp_path):
    """Of all curves within half a count of the wanted one, none misses it by less (mean square along the axis)."""
    options = "relative_errors = false\ninterval_mm = { X = 200.0 }"
    machine = machine_of(tmp_path, options)
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(ErrorTable())
    term = basis[0]
    counts = np.array([1.5, 0.0, 0.5, 2.5, 1.5])
    values = {item.name: np.zeros(len(item.nodes_mm)) for item in basis} | {term.name: 0.5 * UM * counts}
    built = CONTROL(machine, chosen).build(basis, values).sets[0].curve
    dense = np.linspace(-300.0, 500.0, 3201)
    wanted = np.interp(dense, term.nodes_mm, counts)

    def missed(curve):
        return np.mean((np.interp(dense, term.nodes_mm, curve) - wanted) ** 2)

    choices = list(itertools.product(*[[0] if c == 0 else [np.floor(c), np.floor(c) + 1] for c in counts]))
    assert len(choices) == 16
    assert missed(built) == pytest.approx(min(missed(choice) for choice in choices), rel=1e-3)
    assert missed(built) < 0.7 * missed(np.floor(counts + 0.5))


def test_an_axis_that_stops_short_gets_positive_values_on_both_sides(tmp_path):
    """10 um short over every 100 mm: EXX falls with X; so +20 per 100 mm on either side of the reference point."""
    machine = machine_of(tmp_path, "interval_mm = { X = 100.0 }")
    nodes = machine.axes[0].nodes_mm
    errors = ErrorTable({"EXX": Curve(nodes, -1e-4 * (nodes + 100.0), np.full(len(nodes), np.nan))})
    table = read_back(machine, export(machine, errors, "mitsubishi")).sets[0]
    assert (table.base, table.output, table.interval_mm) == (0, 0, Decimal("100.000"))
    assert table.values == (20, 20, 0, 20, 20, 20, 20, 20, 20)


def test_steep_squareness_gets_shorter_intervals(tmp_path, make_errors):
    """2.9 mm over a metre: 127 counts of 0.5 um hold 22 mm of it."""
    machine = machine_of(tmp_path)
    errors = make_errors(machine, squareness_rad=(2.9e-3, -1e-4, 3e-4))
    made = export(machine, errors, "mitsubishi")
    assert made.violations == []
    intervals = {(t.output, t.base): float(t.interval_mm) for t in read_back(machine, made).sets}
    assert 0.5 * 22.0 < intervals[0, 1] < 22.0


def test_a_curve_that_is_too_steep_is_said_and_not_accepted(tmp_path):
    machine = machine_of(tmp_path, "interval_mm = { X = 400.0 }")
    nodes = machine.axes[0].nodes_mm
    errors = ErrorTable({"EXX": Curve(nodes, 4e-4 * (nodes + 100.0), np.full(len(nodes), np.nan))})
    made = export(machine, errors, "mitsubishi")
    assert any("too steep for 127 counts" in text for text in made.violations)
    wider = machine_of(tmp_path, "interval_mm = { X = 400.0 }\nscale = 3")
    assert export(wider, errors, "mitsubishi").violations == []


def test_numbers_of_sets_do_not_overlap_and_fit_what_is_free(tmp_path, make_errors):
    machine = machine_of(tmp_path, "first_number = 4800\nfirst_set = 2\nloss_um = 0.001")
    errors = make_errors(machine)
    made = export(machine, errors, "mitsubishi")
    tables = read_back(machine, made)
    numbers = [number for table in tables.sets for number in range(table.first, table.last + 1)]
    assert numbers == list(range(4800, 4800 + len(numbers)))
    assert numbers[-1] <= 5124
    assert "\n#4011,X," in made.files["SETSHEET.CSV"]
    assert "#4001," not in made.files["SETSHEET.CSV"]
    assert made.violations == []


def test_limits_of_a_foreign_sheet_are_named(tmp_path):
    machine = machine_of(tmp_path)
    text = SAMPLE.replace("#4103,0", "#4103,5").replace("#4014,4106", "#4014,4105").replace("#4006,1", "#4006,0")
    found = " ".join(CONTROL(machine).violations(parse(machine, text)))
    for part in (
        "value at the reference number 4103 must be 0",
        "overlap",
        "scale is 0",
        "covers",
        "Y has no positioning table",
    ):
        assert part in found


def test_a_set_of_an_axis_that_is_not_in_the_machine_file_is_left_out_with_a_warning(tmp_path):
    machine = machine_of(tmp_path)
    with pytest.warns(CompgenWarning, match="set 2 belongs to axis A, which is not in the machine file"):
        tables = parse(machine, SAMPLE.replace("#4011,Y", "#4011,A"))
    assert [(table.base, table.output) for table in tables.sets] == [(0, 0)]


def test_order_crlf_blank_lines_and_missing_signs_do_no_harm(tmp_path):
    machine = machine_of(tmp_path)
    lines = SAMPLE.splitlines()
    mixed = "\r\n".join([*(line.replace("#", "").replace(",", " , ", 1) for line in reversed(lines[1:])), "", ""])
    assert parse(machine, mixed) == parse(machine, SAMPLE)


@pytest.mark.parametrize(
    ("before", "after", "line", "message"),
    [
        ("#4102,20,", "#4102,20.5,", 18, "whole number from -128 to 127"),
        ("#4102,20,", "#4102,128,", 18, "whole number from -128 to 127"),
        ("#4102,20,", "#4102,-129,", 18, "whole number from -128 to 127"),
        ("#4102,20,", "#4102,2e1,", 18, "whole number"),
        ("#4102,20,", "#4102,nan,", 18, "whole number"),
        ("#4102,20,", "#4102;20;", 18, "not a parameter number"),
        ("#4102,20,", "#4103,20,", 19, "second time"),
        ("#4102,20,X at -100\n", "", 7, "missing: #4102 \\(1 in all\\)"),
        ("#4102,20,X at -100", "#4102,2", 18, "is the file truncated"),
        ("#4003,4103", "#4003,4106", 5, "outside the numbers 4101 to 4105"),
        ("#4003,4103", "#4003,", 3, "set 1 is incomplete: #4003 missing"),
        ("#4003,4103", "#4003,40", 5, "4101 to 5999"),
        ("#4007,100.0", "#4007,1e2", 9, "interval in mm"),
        ("#4007,100.0", "#4007,0.0", 9, "interval in mm"),
        ("#4007,100.0", "#4007,-5.0", 9, "interval in mm"),
        ("#4000,1", "#4000,0", 2, "absolute system"),
        ("#4000,1", "#3999,1", 1, "#4000"),
        ("X at -100", "X at \u2212100", 18, "not a row"),
    ],
)
def test_a_malformed_sheet_is_refused_with_its_line(tmp_path, before, after, line, message):
    text = SAMPLE.replace(before, after, 1)
    assert text != SAMPLE
    with pytest.raises(InputError, match=message) as caught:
        parse(machine_of(tmp_path), text)
    assert (caught.value.file.name, caught.value.line) == ("SETSHEET.CSV", line)


def test_a_sheet_that_was_cut_is_refused_wherever_it_was_cut(tmp_path):
    machine = machine_of(tmp_path)
    for end in range(len(SAMPLE) - len(",Z at Y +100\n")):
        with pytest.raises(InputError):
            parse(machine, SAMPLE[:end])


@pytest.mark.parametrize(
    ("part", "times"), [("\n", 10_000_000), ("A", 100_000_000), ("#4101,1,a\n", 90_000), ("#", 900_000)]
)
def test_garbage_is_refused_at_a_cost_that_grows_with_it(tmp_path, part, times):
    machine = machine_of(tmp_path)

    def read(text):
        with pytest.raises(InputError) as caught:
            parse(machine, text)
        assert caught.value.line is not None

    assert grows_with_its_file(read, part)
    read(part * times)


@pytest.mark.parametrize(
    "options",
    [
        "scale = 0",
        'stores = "both"',
        "first_set = 3",
        "last_number = 4110",
        "interval_mm = { X = 0.0005 }",
        'axis_names = { X = "Y" }',
        "unknown = 1",
    ],
)
def test_settings_that_make_no_sense_are_refused(tmp_path, options):
    with pytest.raises(InputError):
        CONTROL.read_settings(machine_of(tmp_path, options))


# --- the control's own file ------------------------------------------------------------------------------------------


def backup(system=0, sets=(), values=None, last=5999, unit="B"):
    """A parameter file in the form of an M80's: every number is there, a set without axes has empty names."""
    rows = [
        "%",
        ";20240101 10:00",
        ";MITSUBISHI CNC",
        "PARA101()",
        "N1P28",
        f"N1006T1P{unit}",
        f"N1006T2P{unit}",
        "N1013A1PX",
    ]
    rows.append(f"N4000P{system}")
    for k in range(10):
        own = dict(sets).get(k, ("", "", 0, 0, 0, 0, "0.000"))
        rows += [f"N{4001 + 10 * k + j}P{value}" for j, value in enumerate(own)]
        rows += [f"N{4008 + 10 * k}P0", f"N{4009 + 10 * k}P0"]
    rows += [f"N{number}P{(values or {}).get(number, 0)}" for number in range(4101, last + 1)]
    return "\r\n".join([*rows, "N8001P", "N88140P0", "%", ""])


#: X over itself in 9 points, and rotary axes A and C; that of C has its reference number below the first one.
SETS = {
    0: ("X", "X", 4103, 4101, 4109, 2, "100.000"),
    3: ("A", "A", 4413, 4401, 4416, 2, "10.000"),
    4: ("", "", 4401, 4414, 4416, 2, "10.000"),
    5: ("C", "C", 4501, 4502, 4524, 2, "15.000"),
}
VALUES = {4101: -4, 4102: -3, 4104: 5, 4105: 9, 4413: 0, 4414: 7, 4502: 8, 4503: 7}
ONLY_OWN = "relative_errors = false"


@pytest.fixture
def backup_file(tmp_path):
    (tmp_path / "ALL.PRM").write_bytes(backup(sets=SETS, values=VALUES).encode())
    return tmp_path / "ALL.PRM"


def following(tmp_path, options=ONLY_OWN):
    return machine_of(tmp_path, f'style_from = "ALL.PRM"\n{options}')


def test_absolute_values_of_a_backup_are_sums_and_other_axes_are_kept_apart(tmp_path, backup_file):
    """One count is 2 x 0.5 um; at 100 mm above the reference point 5 um, at 200 mm 9 um (not 14), below -3 and -4 um."""
    machine = following(tmp_path)
    read = compgen.read_tables(machine, [backup_file], "mitsubishi")
    x = [-300.0, -200.0, -100.0, -50.0, 0.0, 50.0, 100.0]
    found = added(machine, read.tables, [[value, 10.0, -500.0] for value in x])
    np.testing.assert_allclose(found[:, 0], np.array([-4, -3, 0, 2.5, 5, 7, 9]) * UM, atol=ROUNDING_MM)
    assert read.remarks[0].startswith("#4000 = 0: absolute values")
    assert read.remarks[1] == "set 4 of A, numbers 4401 to 4416: not in the machine file, kept separate"
    assert read.remarks[2] == "set 6 of C, numbers 4501 to 4524: not in the machine file, kept separate"
    assert read.remarks[3] == "skipped: 5 lines that cannot change a table"


def test_the_mode_sets_and_numbers_of_the_backup_are_kept(tmp_path, backup_file, make_errors):
    """The rest of the file is as it was, byte for byte; no number of A and C changes, #4000 stays 0."""
    machine = following(tmp_path)
    errors = make_errors(machine, squareness_rad=(0.0, 0.0, 0.0))
    made = export(machine, errors, "mitsubishi")
    assert made.violations == []
    before, after = backup_file.read_bytes().decode(), made.files["ALL-NEW.PRM"]
    changed = [(a, b) for a, b in zip(before.split("\n"), after.split("\n"), strict=True) if a != b]
    numbers = [int(b[1:5]) for _, b in changed]
    assert all(number in range(4011, 4018) or number in range(4021, 4028) or number >= 4101 for number in numbers)
    assert not [number for number in numbers if 4401 <= number <= 4416 or 4501 <= number <= 4524]
    assert "\n#4000,0," in made.files["SETSHEET.CSV"]
    tables = read_back(machine, made)
    x = tables.sets[0]
    assert (x.index, x.reference, x.first, x.last, x.scale, x.absolute) == (0, 4103, 4101, 4109, 2, True)
    assert [table.index for table in tables.sets] == [0, 1, 2]
    positions = np.random.default_rng(3).uniform(machine.lower_mm, machine.upper_mm, (50, 3))
    sheet = CONTROL(machine).parse([SourceFile(Path("S.CSV"), made.files["SETSHEET.CSV"])])
    np.testing.assert_array_equal(added(machine, tables, positions), added(machine, sheet, positions))
    told = made.preflight.split("## What the files overwrite")[1]
    assert told.index("Of other axes: nothing. Kept: set 4 (A over A") < told.index("Set 1 (#4001")


@pytest.mark.parametrize(("system", "chain"), [(0, "WXYFZT"), (1, "WFYXZT")])
def test_both_systems_correct_what_was_measured(tmp_path, make_errors, system, chain):
    (tmp_path / "ALL.PRM").write_bytes(backup(system, {1: ("B", "B", 4200, 4200, 4236, 1, "10.000")}).encode())
    machine = machine_of(tmp_path, 'style_from = "ALL.PRM"\nscale = 4', chain)
    errors = make_errors(machine)
    made = export(machine, errors, "mitsubishi")
    assert made.violations == []
    result = compgen.verify(machine, compgen.read_tables(machine, made.write(tmp_path / "out"), "mitsubishi"), errors)
    assert result.accepted, result.reasons


def test_the_values_of_both_systems_by_hand(tmp_path):
    """10 um short over every 100 mm: steps of +20 on either side, or sums ... -40, -20, 0, 20, 40 ..."""
    nodes = np.array([-300.0, -100.0, 500.0])
    errors = ErrorTable({"EXX": Curve(nodes, -1e-4 * (nodes + 100.0), np.full(3, np.nan))})
    options = "interval_mm = { X = 100.0 }\n" + ONLY_OWN
    stored = {}
    for mode in ("incremental", "absolute"):
        machine = machine_of(tmp_path, f'{options}\nmode = "{mode}"')
        stored[mode] = read_back(machine, export(machine, errors, "mitsubishi")).sets[0].values
    assert stored["incremental"] == (20, 20, 0, 20, 20, 20, 20, 20, 20)
    assert stored["absolute"] == (-40, -20, 0, 20, 40, 60, 80, 100, 120)


def test_an_export_asks_for_the_mode_and_writes_nothing(tmp_path, make_errors):
    machine = machine_of(tmp_path)
    machine.controllers["mitsubishi"].data.pop("mode")
    with pytest.raises(InputError, match="#4000 applies to the tables of ALL axes"):
        export(machine, make_errors(machine), "mitsubishi")
    assert parse(machine, SAMPLE).sets[0].absolute is False
    assert parse(machine, SAMPLE.replace("#4000,1", "#4000,0")).sets[0].absolute is True


def test_options_assume_a_mode_and_say_so(tmp_path, make_errors):
    machine = machine_of(tmp_path)
    machine.controllers["mitsubishi"].data.pop("mode")
    ((variant, changed),) = _variants(machine, "mitsubishi")
    assert variant.notes == ("mode is not stated in the machine file; 'incremental' is assumed here",)
    assert export(changed, make_errors(machine), "mitsubishi").violations == []
    assert _variants(machine_of(tmp_path), "mitsubishi")[0][0].notes == ()


def test_a_sum_out_of_range_names_the_scale_that_holds_it(tmp_path):
    nodes = np.array([-300.0, -100.0, 500.0])
    errors = ErrorTable({"EXX": Curve(nodes, -1e-4 * (nodes + 100.0) * 3, np.full(3, np.nan))})
    machine = machine_of(tmp_path, f'mode = "absolute"\n{ONLY_OWN}')
    assert any(
        "the value 360 is outside -128 ... 127; set scale = 3" in v
        for v in export(machine, errors, "mitsubishi").violations
    )
    wider = machine_of(tmp_path, f'mode = "absolute"\n{ONLY_OWN}\nscale = 3')
    assert export(wider, errors, "mitsubishi").violations == []


def test_tables_of_another_pair_go_into_free_sets_and_numbers(tmp_path, backup_file, make_errors):
    machine = following(tmp_path, 'relative_errors = ["Y(x)"]\nscale = 9')
    tables = read_back(machine, export(machine, make_errors(machine), "mitsubishi"))
    assert [(table.index, table.output, table.base) for table in tables.sets] == [
        (0, 0, 0),
        (1, 1, 1),
        (2, 2, 2),
        (4, 1, 0),
    ]
    taken = {*range(4401, 4417), *range(4501, 4525)}
    assert not any(taken & set(range(table.first, table.last + 1)) for table in tables.sets)


def test_a_constant_at_the_reference_point_stays(tmp_path, make_errors):
    """In the control's file X has 2 at its reference number: that is in all its new values, and moves no position."""
    (tmp_path / "ALL.PRM").write_bytes(backup(sets=SETS, values={4103: 2, 4104: 5}).encode())
    machine = following(tmp_path)
    (tmp_path / "zero").mkdir()
    (tmp_path / "zero" / "ALL.PRM").write_bytes(backup(sets=SETS).encode())
    plain = following(tmp_path / "zero")
    errors = make_errors(machine, squareness_rad=(0.0, 0.0, 0.0))
    made, other = export(machine, errors, "mitsubishi"), export(plain, errors, "mitsubishi")
    assert made.violations == []
    x, bare = read_back(machine, made).sets[0], read_back(plain, other).sets[0]
    assert x.values == tuple(value + 2 for value in bare.values)
    np.testing.assert_array_equal(x.curve, bare.curve)
    assert "The value at the reference number #4103 stays 2: a constant of 2 um in all values of X(x)" in made.preflight
    read = compgen.read_tables(machine, [tmp_path / "ALL.PRM"], "mitsubishi")
    found = added(machine, read.tables, [[-100.0, 0, -500.0], [0.0, 0, -500.0], [100.0, 0, -500.0]])
    np.testing.assert_allclose(found[:, 0], np.array([0.0, 3.0, -2.0]) * UM, atol=ROUNDING_MM)
    assert any("the value 2 at the reference number #4103 only shifts the zero" in remark for remark in read.remarks)
    changed = CONTROL(machine).parse(
        [SourceFile(Path("S.CSV"), made.files["SETSHEET.CSV"].replace("\n#4103,2,", "\n#4103,0,"))]
    )
    assert any(
        "the value at the reference number 4103 must be 2 as in the control's file" in text
        for text in CONTROL(machine).violations(changed)
    )


def test_a_constant_at_the_reference_point_that_goes_is_said(tmp_path, make_errors):
    (tmp_path / "ALL.PRM").write_bytes(backup(sets=SETS, values={4103: 2}).encode())
    machine = following(tmp_path, ONLY_OWN + "\ninterval_mm = { X = 40.0 }")
    made = export(machine, make_errors(machine, squareness_rad=(0.0, 0.0, 0.0)), "mitsubishi")
    assert "The value at the reference number #4103 was 2 and is now 0: X shifts by a constant" in made.preflight


def test_what_is_active_comes_back_where_nothing_is_left_to_correct(tmp_path):
    """Backup -> active tables -> merged with errors of zero: the same file, but for the points beyond the travel."""
    sets = {k: v for k, v in SETS.items() if k}
    sets |= {k: (n, n, 4110 + 20 * k, 4106 + 20 * k, 4115 + 20 * k, 2, "80.000") for k, n in enumerate("XYZ")}
    shape = (-7, -6, -3, -1, 0, 2, 5, 4, 4, 3)
    values = {4106 + 20 * k + j: value for k in range(3) for j, value in enumerate(shape)}
    (tmp_path / "ALL.PRM").write_bytes(backup(sets=sets, values=values).encode())
    machine = following(tmp_path).source
    travels = "\n".join(f"[axes.{n}]\nrange_mm = [-320.0, 400.0]\nnodes = 5" for n in "XYZ")
    text = f'name = "m"\nchain = "WXYFZT"\n{travels}\n[controllers.mitsubishi]\n{ONLY_OWN}\n'
    machine.write_text(text)
    zeros = [f"{name},{position},0.0," for name in ("EXX", "EYY", "EZZ") for position in (-320.0, 400.0)]
    (tmp_path / "zero.errors.csv").write_text("\n".join(["error,position_mm,value,u_value", *zeros, ""]))
    words = ["merge", machine, tmp_path / "ALL.PRM", "--style-from", tmp_path / "ALL.PRM", "--controller", "mitsubishi"]
    words += ["--errors", tmp_path / "zero.errors.csv", "--out", tmp_path / "out"]
    assert run_command(cli, [str(word) for word in words]) == 0
    assert (tmp_path / "out" / "ALL-NEW.PRM").read_bytes() == (tmp_path / "ALL.PRM").read_bytes()


def test_a_set_of_ours_that_is_no_longer_used_is_switched_off(tmp_path, make_errors):
    sets = {**SETS, 7: ("X", "Z", 4602, 4601, 4609, 2, "100.000")}
    (tmp_path / "ALL.PRM").write_bytes(backup(sets=sets).encode())
    machine = following(tmp_path)
    made = export(machine, make_errors(machine, squareness_rad=(0.0, 0.0, 0.0)), "mitsubishi")
    assert "\n#4071,," in made.files["SETSHEET.CSV"] and "\nN4071P\r\n" in made.files["ALL-NEW.PRM"]
    assert "Switched off, because this export has no such table: set 8 (Z over X)" in made.preflight
    assert len(read_back(machine, made).sets) == 3


@pytest.mark.parametrize(
    ("change", "options", "words"),
    [
        (lambda t: t, 'mode = "incremental"\n' + ONLY_OWN, "#4000 = 0"),
        (
            lambda t: t,
            "",
            "8 new sets are needed, but only 7 of the 10 sets of the control are free \\(other axes use set 4 of A",
        ),
        (lambda t: t[: t.rindex("%")], ONLY_OWN, "is the file truncated"),
        (lambda t: t.replace("N4000P0\r\n", ""), ONLY_OWN, "#4000 .* is missing"),
        (lambda t: t.replace("N4102P-3", "N4102P-3\r\nN4102P1"), ONLY_OWN, "second time"),
        (lambda t: t.replace("N4102P-3", "N4102A1P-3"), ONLY_OWN, "the word A1"),
        (lambda t: t.replace("N4102P-3", "N4102 = -3"), ONLY_OWN, "is not understood"),
        (lambda t: t.replace("N4012P\r", "N4012PY\r"), ONLY_OWN, "set 2 is incomplete"),
        (lambda t: t.replace("N4003P4103", "N4003P4110"), ONLY_OWN, "cannot be kept"),
        (
            lambda t: t.replace("N4035P4416", "N4035P4416").replace("N4034P4401", "N4034P4105"),
            ONLY_OWN,
            "4105 to 4416; 4101 to 4109",
        ),
        (lambda t: t.replace("MITSUBISHI", "M\u00dcLLER"), ONLY_OWN, "not ASCII"),
        (lambda t: t.replace("%", ""), ONLY_OWN, "not a parameter file"),
    ],
)
def test_a_file_of_the_control_that_does_not_fit_is_refused(tmp_path, backup_file, make_errors, change, options, words):
    backup_file.write_bytes(change(backup(sets=SETS, values=VALUES)).encode("latin-1"))
    with pytest.raises(InputError, match=words):
        machine = following(tmp_path, options)
        export(machine, make_errors(machine), "mitsubishi")


def test_unit_and_last_number_follow_the_file(tmp_path):
    (tmp_path / "ALL.PRM").write_bytes(backup(sets=SETS, unit="C").encode())
    chosen = CONTROL.read_settings(following(tmp_path))
    assert (chosen.setting_unit_um, chosen.last_number, chosen.absolute) == (0.1, 5999, True)
    assert CONTROL.read_settings(machine_of(tmp_path, "last_number = 5999")).last_number == 5999


def test_file_and_sheet_that_differ_are_refused(tmp_path, backup_file, make_errors):
    machine = following(tmp_path)
    made = export(machine, make_errors(machine, squareness_rad=(0.0, 0.0, 0.0)), "mitsubishi")
    text = made.files["ALL-NEW.PRM"]
    row = next(row for row in text.split("\r\n") if row.startswith("N4105P"))
    damaged = {**made.files, "ALL-NEW.PRM": text.replace(row, "N4105P77")}
    sources = [SourceFile(Path(name), text) for name, text in damaged.items()]
    with pytest.raises(InputError, match="does not contain the same tables as SETSHEET.CSV"):
        CONTROL(machine).parse(sources)


PIECES = ["#", "4101", ",", "\n", "-", "128", "0", "X", ".", "e", " ", "9" * 12, "\u0663"]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cut=st.tuples(st.integers(0, len(SAMPLE)), st.integers(0, 12)),
    put=st.lists(st.sampled_from(PIECES), max_size=4).map("".join),
)
def test_any_text_is_read_or_refused(tmp_path, cut, put):
    machine = machine_of(tmp_path)
    try:
        tables = parse(machine, SAMPLE[: cut[0]] + put + SAMPLE[cut[0] + cut[1] :])
    except (InputError, CompgenWarning):
        return
    assert np.all(np.isfinite(added(machine, tables, [[0.0, 50.0, 0.0]])))
