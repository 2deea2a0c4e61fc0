"""FANUC straightness compensation: polylines of four knots, best knots, numbers, text."""

from __future__ import annotations

import json
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

import machines
from compgen.controls import SourceFile, controller_named
from compgen.controls.fanuc_straightness import best_polyline
from compgen.data.error_table import Curve, ErrorTable, hat_matrix
from compgen.data.lengths import Points
from compgen.errors import InputError
from compgen.tables import export, read_tables, verify

CONTROL = controller_named("fanuc-straightness")
UM = 1e-3
#: Points 33 to 49 of X, reference point 40, every 50 mm, as in the pitch example; Y moves with X.
SAMPLE = (Path(__file__).parents[1] / "golden" / "fanuc-straightness" / "STRAIGHT.TXT").read_text()


def machine_of(**options):
    fields = {"tool_offset_mm": (10.0, -20.0, -150.0), "reference_point_mm": (0.0, 0.0, -480.0)}
    ranges = ((-400.0, 450.0), (-600.0, 0.0), (-480.0, -20.0))
    return machines.machine_of(ranges, (18, 11, 9), "WXYFZT", settings={"fanuc-straightness": options}, **fields)


def parse(machine, text, name="STRAIGHT.TXT"):
    return CONTROL(machine).parse([SourceFile(Path(name), text)])


def all_texts(made):
    """Text of all FANUC files of an export."""
    return "".join(text for name, text in made.files.items() if name.endswith(".TXT"))


def added(machine, tables, position_mm):
    return CONTROL(machine).emulate(tables, Points(np.array(position_mm, dtype=float)))


# --- meaning ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("stores", "sign"), [("correction", 1.0), ("error", -1.0)])
def test_the_amount_is_linear_between_four_points_and_zero_outside(stores, sign):
    """Knots at -400, -200, 100 and 450 mm: 0, -6, +4, +10 um; half way 1 and so on, worked by hand."""
    machine = machine_of(stores=stores)
    tables = parse(machine, SAMPLE)
    x_mm = [-401.0, -400.0, -300.0, -200.0, -50.0, 100.0, 275.0, 450.0, 451.0]
    expected = [0.0, 0.0, -3.0, -6.0, -1.0, 4.0, 7.0, 10.0, 0.0]
    result = added(machine, tables, [[x, -77.0, -88.0] for x in x_mm])
    np.testing.assert_allclose(result[:, 1], sign * np.array(expected) * UM, atol=1e-12)
    assert not result[:, [0, 2]].any()


def test_a_machine_whose_y_runs_off_gets_the_opposite_and_no_other_axis_moves():
    """EYX = +5 um at X = -400 mm and -3 um at +450 mm, zero at the reference point: Y moves by -5 and +3 um."""
    machine = machine_of(pairs=["Y(x)"])
    nodes = machine.axes[0].nodes_mm
    value = np.interp(nodes, [-400.0, 0.0, 450.0], [5.0, 0.0, -3.0]) * UM
    made = export(
        machine,
        ErrorTable({"EYX": Curve(nodes, value, np.full(18, np.nan))}),
        "fanuc-straightness",
        allow_unverified=True,
    )
    tables = parse(machine, all_texts(made))
    (entry,) = tables.entries
    assert entry.amounts[0] == -5 and entry.amounts[-1] == 3
    result = added(machine, tables, [[-400.0, 0, 0], [0.0, -5, -100], [450.0, 0, 0]])
    np.testing.assert_allclose(result, [[0, -5 * UM, 0], [0, 0, 0], [0, 3 * UM, 0]], atol=0.5 * UM + 1e-12)
    assert made.violations == []


def test_squareness_fits_as_a_line(small_machine):
    errors = ErrorTable({}, {"EC0Y": (40e-6, np.nan)})
    machine = small_machine.with_setting("fanuc-straightness", "pairs", ["X(y)"])
    made = export(machine, errors, "fanuc-straightness", allow_unverified=True)
    tables = parse(machine, all_texts(made))
    y_mm = np.linspace(-100.0, 300.0, 41)
    position = np.column_stack([np.zeros(41), y_mm, np.full(41, -40.0)])
    # dX = -Y EC0Y, so the correction is + 40 um over a metre, zero at the reference point Y = 100 mm
    expected = 40e-6 * (y_mm - 100.0)
    assert np.abs(added(machine, tables, position)[:, 0] - expected).max() <= 0.5 * UM + 1e-5


# --- best knots ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_the_knots_are_those_of_a_search_through_all(seed):
    generator = np.random.default_rng(seed)
    candidates = np.cumsum(generator.uniform(5.0, 60.0, 11)) - 200.0
    position = np.unique(np.concatenate([candidates, generator.uniform(candidates[0], candidates[-1], 40)]))
    wanted = np.cumsum(generator.normal(size=len(position)))
    weight = generator.uniform(0.1, 3.0, len(position))
    squares = {}
    for b, c in combinations(range(1, 10), 2):
        matrix = hat_matrix(candidates[[0, b, c, 10]], position) * np.sqrt(weight)[:, None]
        rest = matrix @ np.linalg.lstsq(matrix, wanted * np.sqrt(weight), rcond=None)[0] - wanted * np.sqrt(weight)
        squares[b, c] = float(rest @ rest)
    found = best_polyline(candidates, position, wanted, weight)
    assert found.knots[1:3] == min(squares, key=squares.get)
    assert found.square == pytest.approx(min(squares.values()), rel=1e-9)


def test_a_polyline_of_three_pieces_is_found_exactly():
    position = np.linspace(-400.0, 450.0, 171)
    wanted = np.interp(position, [-400.0, -150.0, 200.0, 450.0], [3.0, -2.0, 5.0, 1.0])
    found = best_polyline(position[::2], position, wanted, np.ones(171))
    assert [position[::2][k] for k in found.knots] == [-400.0, -150.0, 200.0, 450.0]
    np.testing.assert_allclose(found.values, [3.0, -2.0, 5.0, 1.0], atol=1e-9)


def test_the_four_knots_of_a_line_differ_from_each_other():
    """Any inner knots hold a line; the control wants four different points in ascending order."""
    position = np.linspace(-400.0, 450.0, 69)
    for slope in np.linspace(-3e-5, 3e-5, 41):
        knots = best_polyline(position[::4], position, slope * position + 1e-3, np.ones(69)).knots
        assert knots[0] == 0 and knots[-1] == 17 and np.all(np.diff(knots) > 0)


# --- round trip ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stores", ["correction", "error"])
def test_the_text_means_the_best_table_within_half_a_count(small_machine, small_errors, stores, tmp_path):
    machine = small_machine.with_setting("fanuc-straightness", "stores", stores)
    machine = machine.with_setting("fanuc-straightness", "detection_unit_um", 0.5)
    made = export(machine, small_errors, "fanuc-straightness", allow_unverified=True)
    text = all_texts(made)
    values = {int(n): int(v) for n, v in re.findall(r"^N0(57\d\d)P(-?\d+)$", text, re.M)}
    grids = {
        int(n): [float(v) for v in re.findall(r"A\dP(-?[\d.]+)", rest)]
        for n, rest in re.findall(r"^N0(362\d)(.*)$", text, re.M)
    }
    points = np.random.default_rng(3).uniform(machine.lower_mm, machine.upper_mm, (400, 3))
    expected = np.zeros((400, 3))
    for k in range(3):  # an emulator of its own, from the numbers of the page
        moving, output = values[5711 + k] - 1, values[5721 + k] - 1
        at = [
            machine.reference_point_mm[moving] + (values[5731 + 10 * k + j] - grids[3620][moving]) * grids[3624][moving]
            for j in range(4)
        ]
        amounts = [values[5761 + 10 * k + j] for j in range(4)]
        expected[:, output] += (
            (1 if stores == "correction" else -1) * 0.5 * UM * np.interp(points[:, moving], at, amounts)
        )
    tables = read_tables(machine, made.write(tmp_path), "fanuc-straightness")
    np.testing.assert_allclose(tables.correction(machine, Points(points)), expected, atol=1e-12)
    judged = verify(machine, tables, small_errors)
    assert judged.accepted, judged.reasons
    assert judged.after_rigid_removed.rms_um < judged.before_rigid_removed.rms_um
    assert np.abs(expected).max() > 5 * UM


def test_plan_text_and_preflight_hold_the_same_numbers(small_machine, small_errors):
    made = export(small_machine, small_errors, "fanuc-straightness", allow_unverified=True)
    plan = json.loads(made.files["STRAIGHT.plan.json"])
    in_text = {n: int(v) for n, v in re.findall(r"^N0(57\d\d)P(-?\d+)$", made.files["STRAIGHT.TXT"], re.M)}
    assert plan["parameters"] == in_text and len(in_text) == 30
    assert all(f"| `{number}` | {value} |" in made.preflight for number, value in in_text.items())
    assert plan["evidence"] == "unverified"


def test_the_points_of_the_user_are_taken_and_a_file_with_others_is_refused():
    points = {"X": {"reference": 40, "first": 32, "last": 49, "interval_mm": 50.0}}
    machine = machine_of(points=points, pairs=["Y(x)"])
    nodes = machine.axes[0].nodes_mm
    errors = ErrorTable({"EYX": Curve(nodes, 6 * UM * np.sin(nodes / 150.0), np.full(18, np.nan))})
    made = export(machine, errors, "fanuc-straightness", allow_unverified=True)
    text = made.files["STRAIGHT.TXT"]
    assert "N03620A1P40\nN03621A1P32\nN03622A1P49\nN03624A1P50.0\n" in text
    assert made.violations == []
    other = parse(machine, text.replace("P50.0", "P60.0"))
    assert any("which differ from those of the machine file" in m for m in CONTROL(machine).violations(other))


def test_travel_beyond_the_outer_points_and_large_amounts_are_violations():
    machine = machine_of(amount_limit=9)
    chosen = CONTROL.read_settings(machine)
    messages = CONTROL(machine, chosen).violations(parse(machine, SAMPLE.replace("N05731P32", "N05731P33")))
    assert any("an amount is 10 counts; the limit is 9" in m for m in messages)
    assert any("covers -350 ... 450 mm of X" in m for m in messages)


def test_the_format_needs_to_be_allowed_and_says_why(small_machine, small_errors):
    with pytest.raises(InputError, match="5761 is elsewhere called a magnification.*--allow-unverified"):
        export(small_machine, small_errors, "fanuc-straightness")


# --- text ------------------------------------------------------------------------------------------------------------

VARIANTS = {
    "Q words": lambda t: re.sub(r"(?m)^(N\d+)", r"\1Q1", t),
    "CR LF": lambda t: t.replace("\n", "\r\n"),
    "semicolons and white space": lambda t: t.replace("\n", ";\n").replace("P", " P"),
    "any order": lambda t: "\n".join(["%", *t.split()[-2:0:-1], "%", ""]),
    "other parameters": lambda t: t.replace("N05711", "N00010P00000001\nN10041P2\nN05712P0\nN05711"),
    "points of another axis": lambda t: t.replace("A1P40", "A1P40A4P7"),
}


@pytest.mark.parametrize("name", VARIANTS)
def test_every_style_of_the_sample_means_the_same(name):
    machine = machine_of()
    text = VARIANTS[name](SAMPLE)
    assert text != SAMPLE
    assert parse(machine, text) == parse(machine, SAMPLE)


def punched(path, *rows):
    path.write_bytes("\r\n".join(["%", *rows, "%", ""]).encode("ascii"))
    return str(path)


def test_a_sample_of_the_users_control_is_followed(tmp_path, small_machine, small_errors):
    """The points of X, Y and Z are those that stored pitch error compensation has, not others: these would shift it."""
    rows = ["N3620 Q1 A1 P90 A2 P200 A3 P400", "N3621 Q1 A1 P1 A2 P160 A3 P320", "N3622 Q1 A1 P133 A2 P240 A3 P416"]
    path = punched(tmp_path / "PUNCH.TXT", *rows, "N3624 Q1 A1 P6.000 A2 P5.000 A3 P2.500", "N10040 Q0 P1")
    machine = small_machine.with_setting("fanuc-straightness", "style_from", path)
    made = export(machine, small_errors, "fanuc-straightness", allow_unverified=True)
    text = made.files["STRAIGHT.TXT"]
    assert text.split("\r\n")[1:5] == [*rows, "N3624 Q1 A1 P6.000 A2 P5.000 A3 P2.500"]
    assert re.search(r"(?m)^N5711 Q1 P1\r$", text)
    assert "Inferred from the sample" in made.preflight
    assert made.violations == []


PATHS = ["N05711Q1L1P{}L2P0L3P2", "N05712Q1L1P4L2P0L3P0", "N05722Q1L1P2L2P0L3P0", "N05713Q1L1P0L2P1L3P0"]
GRIDS = [
    "N03620Q1A1P90A2P200A3P400A4P500",
    "N03621Q1A1P1A2P160A3P320A4P501",
    "N03622Q1A1P133A2P240A3P416A4P512",
    "N03624Q1A1P6.0A2P5.0A3P2.5A4P30.0",
]


def test_parameters_of_a_path_have_the_word_L_of_the_sample_and_entries_of_other_axes_stay(
    tmp_path, small_machine, small_errors
):
    """The rotary axis A4 moves Y in the second entry: written are the first and the third one, of path 1 alone."""
    path = punched(tmp_path / "PUNCH.TXT", *GRIDS, *(row.format(0) for row in PATHS), "N05723Q1L1P0L2P1L3P0")
    machine = small_machine.with_setting("fanuc-straightness", "style_from", path)
    made = export(machine, small_errors, "fanuc-straightness", allow_unverified=True)
    text = made.files["STRAIGHT.TXT"]
    assert re.search(r"(?m)^N05711Q1L1P[123]\r$", text) and re.search(r"(?m)^N05713Q1L1P[123]\r$", text)
    assert not re.search(r"(?m)^N0(5712|5722|574\d|577\d)", text)
    assert not re.search(r"L[23]", text)
    assert len(parse(machine, text).entries) == 2
    assert "Of other axes: nothing. Kept: entry 2 (A4 moves, 5722 = 2)." in made.preflight
    other = parse(machine.with_setting("fanuc-straightness", "path", 2), text.replace("L1P", "L1P9L2P"))
    assert other == parse(machine, text)


def test_an_entry_that_is_no_longer_used_is_switched_off(tmp_path, small_machine, small_errors):
    path = punched(tmp_path / "PUNCH.TXT", *GRIDS, "N05713Q1P2", "N05723Q1P3")
    machine = small_machine.with_setting("fanuc-straightness", "style_from", path)
    made = export(
        machine.with_setting("fanuc-straightness", "pairs", ["Y(x)"]),
        small_errors,
        "fanuc-straightness",
        allow_unverified=True,
    )
    assert "N05713Q1P0" in made.files["STRAIGHT.TXT"].split()


def test_assumed_points_are_in_a_file_of_their_own(small_machine, small_errors):
    """STRAIGHT.TXT never changes 3620 to 3624 of a control that nobody has looked at: that would shift its pitch table."""
    made = export(small_machine, small_errors, "fanuc-straightness", allow_unverified=True)
    assert "N0362" not in made.files["STRAIGHT.TXT"] and "N05711" not in made.files["POINTS-ASSUMED.TXT"]
    told = made.preflight
    assert "- NOT written: 3620, 3621, 3622 and 3624 of X, Y, Z, which belong to pitch error compensation" in told
    assert "Only on a control whose pitch error compensation has no points" in told and "POINTS-ASSUMED.TXT" in told
    with pytest.raises(
        InputError, match="3620, 3621, 3622, 3624 is missing for .*; also give the file that contains it"
    ):
        parse(small_machine, made.files["STRAIGHT.TXT"])


@pytest.mark.parametrize("first", [{}, {"X": 300, "Y": 700, "Z": 500}])
def test_the_points_are_those_that_a_pitch_export_of_the_same_machine_file_gives(
    small_machine, small_errors, first, tmp_path
):
    pitch = {"interval_mm": {"X": 10.0, "Y": 8.0, "Z": 5.0}, "detection_unit_um": 0.5, "first_numbers": first}
    pitch["axis_numbers"] = {"X": 2, "Y": 1, "Z": 5}
    machine = small_machine
    for key, value in pitch.items():
        machine = machine.with_setting("fanuc-pitch", key, value)
    made = export(machine, small_errors, "fanuc-straightness", allow_unverified=True)
    assert "N0362" not in all_texts(made) and "POINTS-ASSUMED.TXT" not in made.files
    settings = CONTROL.read_settings(machine)
    assert (settings.detection_unit_um, settings.axis_numbers) == (0.5, (2, 1, 5))
    punched_pitch = export(machine, small_errors, "fanuc-pitch").files["PITCH.TXT"]
    alone = parse(machine, made.files["STRAIGHT.TXT"])
    both = parse(machine, made.files["STRAIGHT.TXT"] + punched_pitch)
    assert alone == both and len(alone.entries) == 3
    assert sum("are not in the file; the points" in remark for remark in alone.remarks) == 3


def test_the_trial_and_the_way_back_leave_entries_of_other_axes_alone(tmp_path, small_machine, small_errors):
    path = punched(tmp_path / "PUNCH.TXT", *GRIDS, "N05711Q1P4", "N05721Q1P2", "N05712Q1P0", "N05713Q1P0")
    machine = small_machine.with_setting("fanuc-straightness", "style_from", path)
    told = export(machine, small_errors, "fanuc-straightness", allow_unverified=True).preflight
    assert "Set the amounts 5771 to 5774 to 0, then only parameter 5772" in told
    assert "To switch only these tables off, set\n5712, 5713 to 0" in told


def test_points_that_differ_from_the_sample_are_refused(tmp_path, small_machine):
    path = punched(tmp_path / "PUNCH.TXT", *GRIDS)
    machine = small_machine.with_setting("fanuc-straightness", "style_from", path)
    other = {"X": {"reference": 90, "first": 1, "last": 133, "interval_mm": 5.0}}
    with pytest.raises(InputError, match="3624 = 6.0 there; other values would shift its pitch table"):
        CONTROL.read_settings(machine.with_setting("fanuc-straightness", "points", other))
    same = {"X": {"reference": 90, "first": 1, "last": 133, "interval_mm": 6.0}}
    assert CONTROL.read_settings(machine.with_setting("fanuc-straightness", "points", same)).grids[0].reference == 90


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([*GRIDS[:3], "N03624Q1A1P0.0A2P0.0A3P0.0A4P30.0"], "a moving axis needs compensation points"),
        ([*GRIDS, *(f"N0571{k}Q1P4" for k in (1, 2, 3))], "entries of other axes are never overwritten"),
        ([*GRIDS[:2], "N03622Q1A1P133A2P240A3P501A4P512", GRIDS[3]], "axis A4 uses the compensation points 500 to 512"),
        (["N01001Q1P00000001", *GRIDS], "an inch machine"),
    ],
)
def test_a_sample_that_leaves_no_room_is_refused(tmp_path, small_machine, small_errors, rows, words):
    machine = small_machine.with_setting("fanuc-straightness", "style_from", punched(tmp_path / "P.TXT", *rows))
    with pytest.raises(InputError, match=words):
        export(machine, small_errors, "fanuc-straightness", allow_unverified=True)


def test_reading_says_what_was_assumed_kept_apart_and_skipped():
    machine = machine_of()
    tables = parse(machine, SAMPLE.replace("%\nN03620", "%\nN00010P00000001\nN05712P7\nN05722P1\nN03620"))
    with pytest.raises(InputError, match="parameter 5741"):  # an entry that is cut
        parse(machine, SAMPLE.replace("N05711", "N05712P1\nN05722P1\nN05711"))
    said = CONTROL(machine).remarks(tables, [])
    assert "assumed to be metric" in said[0] and "axis 7 is not X, Y or Z" in said[1]
    assert said[2] == "skipped: 1 record that cannot change a straightness table"
    with pytest.raises(InputError, match="a fourth moving axis") as caught:
        parse(machine, SAMPLE.replace("N05711", "N05714P1\nN05711"))
    assert caught.value.line == 6
    with pytest.raises(InputError, match="an inch machine"):
        parse(machine, SAMPLE.replace("N03620", "N01001P00000001\nN03620", 1))


MALFORMED = [
    (lambda t: t[: t.rindex("%")], "last '%' is missing", None),
    (lambda t: t.replace("N05711P1\n", ""), "contains no moving axis", None),
    (lambda t: t.replace("N05763P4\n", ""), "parameter 5763 is missing", 6),
    (lambda t: t.replace("N05763P4", "N05763P4\nN05763P5"), r"second time \(first in", 15),
    (lambda t: t.replace("N05763P4", "N05763P4.5"), "whole number", 14),
    (lambda t: t.replace("N05763P4", "N05763P4E1"), "single value word", 14),
    (lambda t: t.replace("N05763P4", "N05763P4,5"), "is not allowed in a block", 14),
    (lambda t: t.replace("N05763P4", "N05763PNAN"), "not a word", 14),
    (lambda t: t.replace("N05763P4", "N05763A1P4"), "single value word", 14),
    (lambda t: t.replace("N05732P36", "N05732P32"), "a < b < c < d", 9),
    (lambda t: t.replace("N05734P49", "N05734P50"), "not within those of X", 8),
    (lambda t: t.replace("N05721P2", "N05721P1"), "both moving and compensated", 7),
    (lambda t: t.replace("N05721P2", "N05721P7"), "axis 7 is not X, Y or Z", 7),
    (lambda t: t.replace("N03624A1P50.0\n", ""), "parameter 3624 is missing for X", None),
    (lambda t: t.replace("P50.0", "P-50.0"), "not possible", 5),
    (lambda t: t.replace("A1P40", "A1P40A1P41"), "second time", 2),
]


@pytest.mark.parametrize(("damage", "words", "line"), MALFORMED)
def test_a_damaged_file_is_refused_with_file_line_and_reason(damage, words, line):
    text = damage(SAMPLE)
    assert text != SAMPLE
    with pytest.raises(InputError, match=words) as caught:
        parse(machine_of(), text)
    assert caught.value.file == Path("STRAIGHT.TXT")
    assert caught.value.line == line or line is None


@pytest.mark.parametrize("seed", ["A", "N1P1\n", "%\n", "N05711P1\n", "\0"])
def test_huge_garbage_is_refused_at_a_cost_that_grows_with_it(seed):
    def read(text):
        with pytest.raises(InputError):
            parse(machine_of(), text)

    head = "%\n"
    assert grows_with_its_file(read, seed, head)
    read(head + seed * (3_900_000 // len(seed)))
    read(seed * (100_000_000 // len(seed)))


@given(
    st.lists(st.one_of(st.sampled_from([*SAMPLE.split(), "N05712P2", "N05711Q0P1"]), st.text(max_size=8)), max_size=40)
)
@settings(max_examples=120, deadline=None)
def test_any_text_is_parsed_or_refused_but_never_crashes(lines):
    try:
        tables = parse(machine_of(), "\n".join(["%", *lines, "%"]))
    except InputError as error:
        assert str(error).isprintable()
    else:
        assert tables.entries


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"pairs": ["X(x)"]}, "a list of 'Y(x)', 'Z(x)', 'X(y)', 'Z(y)', 'X(z)', 'Y(z)'"),
        ({"pairs": ["Y(x)", "Z(x)"]}, "each moving axis may be given only once"),
        ({"points": {"X": {"reference": 4, "first": 1, "last": 3, "interval_mm": 5.0}}}, "at least four"),
        ({"points": {"X": {"reference": 4, "first": 1, "last": 9}}}, "interval_mm"),
        ({"stores": "minus"}, "'correction', 'error'"),
        ({"amounts": 3}, "not a known key"),
        ({"axis_numbers": {"X": 2}}, "same number"),
    ],
)
def test_a_wrong_setting_is_refused_with_the_reason(options, words):
    with pytest.raises(InputError, match=re.escape(words)):
        CONTROL.read_settings(machine_of(**options))
