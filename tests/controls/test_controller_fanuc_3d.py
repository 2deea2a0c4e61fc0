"""FANUC three-dimensional compensation: a trilinear grid as neutral CSV, as a plan, and in the style of a sample."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from steps import grows_with_its_file

import machines
from compgen.controls import SourceFile, controller_named
from compgen.data.lengths import Points
from compgen.errors import InputError
from compgen.tables import export, read_tables, verify

CONTROL = controller_named("fanuc-3d")
UM = 1e-3
#: The nodes of the errors: nothing is lost between the vertices.
COARSE_MM = {"X": 100.0, "Y": 100.0, "Z": 50.0}
HEADER = "point,x_mm,y_mm,z_mm,x_counts,y_counts,z_counts"


def machine_of(chain="WXYFZT", **options):
    fields = {"tool_offset_mm": (12.0, -25.0, -90.0), "reference_point_mm": (-50.0, 100.0, -150.0)}
    ranges = ((-350.0, 450.0), (-200.0, 300.0), (-400.0, 50.0))
    return machines.machine_of(ranges, (9, 6, 10), chain, settings={"fanuc-3d": options}, **fields)


def box(corner_values, order=(0, 1, 2), ends=((-350.0, 450.0), (-200.0, 300.0), (-400.0, 50.0))):
    """Text of one box; ``corner_values`` maps vertex (i, j, l) to its three counts."""
    rows = []
    for number in range(8):
        bits = [(number >> k) & 1 for k in range(3)]
        index = [0, 0, 0]
        for axis, bit in zip(order, bits, strict=True):
            index[axis] = bit
        place = ",".join(f"{ends[k][index[k]]:.4f}" for k in range(3))
        rows.append(f"{number + 1},{place},{','.join(map(str, corner_values[tuple(index)]))}")
    return "\n".join(["# magnification = 1 1 1", "# rows = 8", HEADER, *rows, ""])


#: Different in every vertex and every axis.
CORNERS = {(i, j, k): (1 + 2 * i, -3 + 5 * j + i, 10 * k - j) for i in (0, 1) for j in (0, 1) for k in (0, 1)}
SAMPLE = (Path(__file__).parents[1] / "golden" / "fanuc-3d" / "VOLUME.csv").read_text()


def parse(machine, text, name="VOLUME.csv"):
    return CONTROL(machine).parse([SourceFile(Path(name), text)])


def added(machine, tables, position_mm):
    return CONTROL(machine).emulate(tables, Points(np.array(position_mm, dtype=float)))


def test_the_golden_file_is_the_box_of_these_corners():
    assert box(CORNERS) == SAMPLE


# --- meaning ---------------------------------------------------------------------------------------------------------


def test_the_golden_box_gives_36_and_2():
    """C1 ... C8 = 0, 8, ... 56 in the order 000, 100, 110, 010, 001, 101, 111, 011 at (0.25, 0.5, 0.75); C2 = 8 alone."""
    ring = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    machine = machine_of()
    ramp = parse(machine, box({corner: (8 * k, 0, -8 * k) for k, corner in enumerate(ring)}))
    inside = [[-350.0 + 0.25 * 800.0, -200.0 + 0.5 * 500.0, -400.0 + 0.75 * 450.0]]
    np.testing.assert_allclose(added(machine, ramp, inside), [[36 * UM, 0.0, -36 * UM]], atol=1e-12)
    second = parse(machine, box({corner: (8 * (k == 1), 0, 0) for k, corner in enumerate(ring)}))
    np.testing.assert_allclose(added(machine, second, [[-150.0, -200.0, -400.0]])[0, 0], 2 * UM, atol=1e-12)


@pytest.mark.parametrize(("stores", "sign"), [("correction", 1), ("error", -1)])
def test_vertices_hold_their_values_and_the_surface_holds_outside(stores, sign):
    machine = machine_of(stores=stores)
    tables = parse(machine, SAMPLE)
    ends = ((-350.0, 450.0), (-200.0, 300.0), (-400.0, 50.0))
    for index, values in CORNERS.items():
        at = np.array([ends[k][index[k]] for k in range(3)])
        beyond = at + np.array([1 if k else -1 for k in index]) * 999.0
        for position in (at, beyond):
            np.testing.assert_allclose(added(machine, tables, [position])[0], sign * np.array(values) * UM, atol=1e-12)


def test_a_magnification_of_the_file_counts():
    text = SAMPLE.replace("magnification = 1 1 1", "magnification = 2 3 10")
    machine = machine_of()
    corner = added(machine, parse(machine, text), [[450.0, 300.0, 50.0]])[0]
    np.testing.assert_allclose(corner, np.array([2 * 3, 3 * 3, 10 * 9]) * UM, atol=1e-12)


# --- round trip ------------------------------------------------------------------------------------------------------


def own_emulator(text, position_mm):
    """What the CSV says, by scipy, in counts; positions are clamped to the grid."""
    rows = [row for row in csv.reader(line for line in text.splitlines() if not line.startswith("#"))][1:]
    numbers = np.array(rows, dtype=float)
    levels = [np.unique(numbers[:, k]) for k in (1, 2, 3)]
    grid = np.full((*map(len, levels), 3), np.nan)
    for row in numbers:
        grid[tuple(int(np.searchsorted(levels[k], row[k + 1])) for k in range(3))] = row[4:]
    inside = np.clip(position_mm, [level[0] for level in levels], [level[-1] for level in levels])
    return RegularGridInterpolator(tuple(levels), grid)(inside), grid


@pytest.mark.parametrize("chain", ["WXYFZT", "WFYXZT"])
@pytest.mark.parametrize(
    "options", [{}, {"stores": "error", "detection_unit_um": 0.5, "magnification": {"Y": 3, "Z": 2}}]
)
def test_the_text_holds_the_best_field_within_half_a_count(chain, options, make_errors, tmp_path):
    machine = machine_of(chain, interval_mm=COARSE_MM, **options)
    errors = make_errors(machine)
    made = export(machine, errors, "fanuc-3d", allow_unverified=True)
    assert made.violations == [] and list(made.files) == ["VOLUME.csv", "VOLUME.plan.json"]
    points = np.random.default_rng(2).uniform(machine.lower_mm, machine.upper_mm, (500, 3))
    counts, _ = own_emulator(made.files["VOLUME.csv"], points)
    size = np.array([1, 3, 2]) * 0.5 * UM * -1 if options else np.full(3, UM)
    tables = read_tables(machine, made.write(tmp_path), "fanuc-3d")
    np.testing.assert_allclose(tables.correction(machine, Points(points)), counts * size, atol=1e-12)
    judged = verify(machine, tables, errors)
    assert judged.accepted, judged.reasons
    # all of the error goes but half a count at most, the loss between nodes, and a constant
    assert judged.after_rigid_removed.max_um < 1.6 * 0.5 * np.linalg.norm(size) / UM + 1.0
    assert judged.before_rigid_removed.max_um > 20.0


def test_no_vertex_is_rounded_by_more_than_half_a_count_and_the_reference_point_is_zero(small_machine, small_errors):
    chosen = CONTROL.read_settings(small_machine)
    basis = CONTROL(small_machine, chosen).basis(small_errors)
    values = {term.name: term.start for term in basis}
    tables = CONTROL(small_machine, chosen).build(basis, values)
    points = np.random.default_rng(6).uniform(small_machine.lower_mm, small_machine.upper_mm, (2000, 3))
    tool = np.array(small_machine.tool_offset_mm)
    wanted = sum(term.carrier_field(points, tool) * term.curve(term.start, points)[:, None] for term in basis)
    assert np.abs(added(small_machine, tables, points) - wanted).max() <= 0.5 * UM + 1e-12
    assert not added(small_machine, tables, [small_machine.reference_point_mm]).any()


def test_plan_and_csv_hold_the_same_numbers_in_the_stated_order(small_machine, small_errors):
    machine = small_machine.with_setting("fanuc-3d", "order", "ZXY")
    made = export(machine, small_errors, "fanuc-3d", allow_unverified=True)
    plan = json.loads(made.files["VOLUME.plan.json"])
    rows = [line.split(",") for line in made.files["VOLUME.csv"].splitlines() if line[0].isdigit()]
    assert {row[0]: [int(value) for value in row[4:]] for row in rows} == plan["points"]
    assert rows[0][1:3] == rows[1][1:3] and rows[0][3] != rows[1][3]  # Z runs fastest
    counts = [int(plan["parameters"][str(10803 + k)]) for k in range(3)]
    assert np.prod(counts) == len(rows) and plan["order"] == "ZXY"
    reference = [int(plan["parameters"][str(10806 + k)]) - 1 for k in range(3)]
    steps = [float(plan["parameters"][str(10812 + k)]) for k in range(3)]
    first = np.array([min(float(row[k]) for row in rows) for k in (1, 2, 3)])
    np.testing.assert_allclose(first + np.multiply(reference, steps), machine.reference_point_mm, atol=1e-9)


def test_limits_are_named_with_what_helps(make_errors):
    machine = machine_of(value_high=20, value_low=-20, interval_mm={**COARSE_MM, "X": 20.0})
    made = export(machine, make_errors(machine), "fanuc-3d", allow_unverified=True)
    text = " | ".join(made.violations)
    assert "set magnification." in text and "vertices along X; at most 25" in text
    cover = parse(machine_of(), box(CORNERS, ends=((-350.0, 400.0), (-200.0, 300.0), (-400.0, 50.0))))
    assert "covers -350 ... 400 mm of X" in CONTROL(machine, CONTROL.read_settings(machine_of())).violations(cover)[0]


def test_the_suggested_magnification_is_enough(make_errors):
    machine = machine_of(value_high=20, value_low=-20, interval_mm=COARSE_MM)
    errors = make_errors(machine)
    found = export(machine, errors, "fanuc-3d", allow_unverified=True).violations
    needed = dict(re.findall(r"magnification\.([XYZ]) = (\d+)", " ".join(found)))
    assert needed
    again = machine.with_setting("fanuc-3d", "magnification", {axis: int(value) for axis, value in needed.items()})
    assert export(again, errors, "fanuc-3d", allow_unverified=True).violations == []


def test_the_grid_keeps_within_25_vertices_an_axis_and_the_format_must_be_allowed(make_errors):
    machine = machine_of()
    nodes = np.linspace(-350.0, 450.0, 301)
    wave = make_errors(machine)
    curves = {**wave.curves, "EXX": type(wave.curves["EXX"])(nodes, 5 * UM * np.sin(nodes / 9.0), np.full(301, np.nan))}
    made = export(machine, type(wave)(curves, wave.squareness), "fanuc-3d", allow_unverified=True)
    plan = json.loads(made.files["VOLUME.plan.json"])
    assert int(plan["parameters"]["10803"]) <= 25 and made.violations == []
    with pytest.raises(InputError, match="not public.*--allow-unverified"):
        export(machine, wave, "fanuc-3d")


# --- the style of a sample -------------------------------------------------------------------------------------------

PUNCHED = {
    "axis words": "%\nN20001Q0A1P1A2P-2A3P0\nN20002Q0A1P0A2P0A3P5\n%\n",
    "axis letters": "%\r\nN1 X+01 Y-02 Z+00\r\nN2 X+00 Y+00 Z+05\r\n%\r\n",
    "a record per value": "%\nN00101P1\nN00102P-2\nN00103P0\n%\n",
    "with parameters": "%\nN10803Q1P5\nN10804Q1P3\nN30000Q0A1P1A2P-2A3P0\n%\n",
}


@pytest.mark.parametrize("name", PUNCHED)
@pytest.mark.parametrize("order", ["XYZ", "YZX"])
def test_records_follow_the_sample_and_hold_what_the_csv_holds(name, order, small_machine, small_errors, tmp_path):
    path = tmp_path / "PUNCH.TXT"
    path.write_bytes(PUNCHED[name].encode())
    machine = small_machine.with_setting("fanuc-3d", "style_from", str(path)).with_setting("fanuc-3d", "order", order)
    made = export(machine, small_errors, "fanuc-3d", allow_unverified=True)
    text = made.files["VOLUME.TXT"]
    data = [line for line in text.splitlines() if line.startswith("N") and not re.match(r"N108(0\d|1[0-4])\D", line)]
    first = next(
        line
        for line in PUNCHED[name].splitlines()
        if line.startswith("N") and not re.match(r"N108(0\d|1[0-4])\D", line)
    )
    shapes = [re.sub(r"[-+]?\d+", "0", line) for line in (data[0], first)]
    assert shapes[0] == shapes[1]
    assert re.match(r"N(\d+)", data[0])[1] == re.match(r"N(\d+)", first)[1]
    plan = json.loads(made.files["VOLUME.plan.json"])
    expected = [value for number in sorted(plan["points"], key=int) for value in plan["points"][number]]
    written = [int(v) for line in data for v in re.findall(r"[PXYZ]([+-]?\d+)", re.sub(r"^N\d+\s?(Q\d)?", "", line))]
    assert written == expected
    chosen = CONTROL.read_settings(machine)
    files = [SourceFile(Path(n), t) for n, t in made.files.items()]
    both = CONTROL(machine, chosen).parse(files)
    assert both == CONTROL(machine, chosen).parse(files[:1])
    if name == "with parameters":
        assert CONTROL(machine, chosen).parse(files[2:]) == both
    else:
        with pytest.raises(InputError, match=r"also give VOLUME\.csv"):
            CONTROL(machine, chosen).parse(files[2:])
    wrong = data[0][:-1] + ("7" if data[0][-1] != "7" else "6")
    with pytest.raises(InputError, match=r"vertex \(0, 0, 0\) has"):
        CONTROL(machine, chosen).parse([files[0], SourceFile(Path("VOLUME.TXT"), text.replace(data[0], wrong))])
    cut = text.replace(data[-1], "")
    with pytest.raises(InputError, match="truncated|missing"):
        CONTROL(machine, chosen).parse([files[0], SourceFile(Path("VOLUME.TXT"), cut)])
    assert "cannot be determined from the sample" in made.preflight


@pytest.mark.parametrize(
    ("text", "words", "line"),
    [
        ("", "contains no '%'", None),
        ("%\n%\n", "no compensation data", 1),
        ("%\nN1P1\nN3P1\n%\n", "does not follow N1", 3),
        ("%\nN1P1\nN2X1Y1Z1\n%\n", "differ from those of line 2", 3),
        ("%\nN1P1P2\n%\n", "are not understood", 2),
        ("%\nN1P1.5\n%\n", "whole number", 2),
        ("%\nG10L50\n%\n", "is not a block", 2),
    ],
)
def test_a_sample_that_is_not_understood_is_refused_with_its_line(text, words, line, tmp_path):
    path = tmp_path / "PUNCH.TXT"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        CONTROL.read_settings(machine_of(style_from=str(path)))
    assert caught.value.file == path and (caught.value.line == line or line is None)


# --- malformed -------------------------------------------------------------------------------------------------------

MALFORMED = [
    (lambda t: "", "contains no vertex", 1),
    (lambda t: t.replace(HEADER, "x,y,z"), "header", 3),
    (lambda t: "\n".join(t.split("\n")[:-2]) + "\n", "declares 8 rows but contains 7", 2),
    (lambda t: t.rstrip("\n"), "no line end", 11),
    (lambda t: t.replace("# rows = 8\n", ""), "declares none rows", None),
    (lambda t: t.replace("# magnification = 1 1 1\n", ""), "magnification", None),
    (lambda t: t.replace("2,450.0000", "1,450.0000"), "second time", 5),
    (lambda t: t.replace("2,450.0000", "9,450.0000"), "point 2 is missing", None),
    (lambda t: t.replace("2,450.0000,-200", "2,450.0000,300"), "second time", 7),
    (lambda t: t.replace("2,450.0000", "2,460.0000"), "not evenly spaced|do not fill", None),
    (lambda t: t.replace("2,450.0000", "2,4.5e2"), "is not a row", 5),
    (lambda t: t.replace("2,450.0000", "2,nan"), "is not a row", 5),
    (lambda t: t.replace("2,450.0000", "2;450,0000"), "is not a row", 5),
    (lambda t: t.replace("2,450.0000", "2,450.0000,1"), "is not a row", 5),
    (lambda t: t.replace("2,450.0000", "Ä"), "is not a row", 5),
    (lambda t: t.replace(",3,", ",3.5,", 1), "is not a row", 5),
]


@pytest.mark.parametrize(("damage", "words", "line"), MALFORMED)
def test_a_damaged_table_is_refused_with_file_line_and_reason(damage, words, line):
    text = damage(SAMPLE)
    assert text != SAMPLE
    with pytest.raises(InputError, match=words) as caught:
        parse(machine_of(), text)
    assert caught.value.file == Path("VOLUME.csv")
    assert caught.value.line == line or line is None


def test_points_in_another_order_than_stated_are_refused_and_read_where_it_is_stated():
    text = box(CORNERS, order=(2, 0, 1))
    with pytest.raises(InputError, match="order = 'XYZ'"):
        parse(machine_of(), text)
    assert np.array_equal(parse(machine_of(order="ZXY"), text).counts, parse(machine_of(), SAMPLE).counts)
    shuffled = SAMPLE.splitlines()
    again = "\n".join([*shuffled[:3], *shuffled[:2:-1], ""])
    assert parse(machine_of(), again.replace("\n", "\r\n")) == parse(machine_of(), SAMPLE)


@pytest.mark.parametrize("seed", ["A", "1,2\n", "# a = b\n", "1,0,0,0,0,0,0\n", "\0", ","])
def test_huge_garbage_is_refused_at_a_cost_that_grows_with_it(seed):
    def read(text):
        with pytest.raises(InputError):
            parse(machine_of(), text)

    head = "# rows = 8\n" + HEADER + "\n"
    assert grows_with_its_file(read, seed, head)
    read(head + seed * (3_900_000 // len(seed)))
    read(seed * (100_000_000 // len(seed)))


@given(st.lists(st.one_of(st.sampled_from(SAMPLE.splitlines()), st.text(max_size=8)), max_size=25))
@settings(max_examples=120, deadline=None)
def test_any_text_is_parsed_or_refused_but_never_crashes(lines):
    try:
        tables = parse(machine_of(), "\n".join(lines) + "\n")
    except InputError as error:
        assert str(error).isprintable()
    else:
        assert tables.counts.size


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"order": "XXY"}, "'XYZ'"),
        ({"magnification": {"X": 0}}, "from 1 to 100"),
        ({"interval_mm": {"X": 0.00001}}, "a multiple of 0.0001 mm"),
        ({"axis_numbers": {"Y": 3}}, "same number"),
        ({"points": 3}, "not a known key"),
    ],
)
def test_a_wrong_setting_is_refused_with_the_reason(options, words):
    with pytest.raises(InputError, match=re.escape(words)):
        CONTROL.read_settings(machine_of(**options))
