"""FANUC straightness compensation: polylines of four knots, best knots, numbers, text."""

from __future__ import annotations

import json
import re
import time
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgen.controllers import SourceFile, controller_named
from compgen.controllers.fanuc.polyline import best_polyline
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Axis, Chain, Machine
from compgen.core.points import Points
from compgen.errors import InputError
from compgen.export import export
from compgen.model.basis import hat_matrix
from compgen.verify import read_tables, verify

CONTROL = controller_named("fanuc-straightness")
UM = 1e-3
#: Points 33 to 49 of X, reference point 40, every 50 mm, as in the pitch example; Y moves with X.
SAMPLE = (Path(__file__).parent / "golden" / "fanuc-straightness" / "STRAIGHT.TXT").read_text()


def machine_of(**options):
    axes = tuple(
        Axis(r, np.linspace(*r, n)) for r, n in (((-400.0, 450.0), 18), ((-600.0, 0.0), 11), ((-480.0, -20.0), 9))
    )
    machine = Machine("m", Chain("WXYFZT"), axes, "X", (10.0, -20.0, -150.0), (0.0, 0.0, -480.0))
    for key, value in options.items():
        machine = machine.with_setting("fanuc-straightness", key, value)
    return machine


def parse(machine, text, name="STRAIGHT.TXT"):
    return CONTROL.parse(machine, CONTROL.read_settings(machine), [SourceFile(Path(name), text)])


def added(machine, tables, position_mm):
    return CONTROL.emulate(machine, CONTROL.read_settings(machine), tables, Points(np.array(position_mm, dtype=float)))


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
    tables = parse(machine, made.files["STRAIGHT.TXT"])
    (entry,) = tables.entries
    assert entry.amounts[0] == -5 and entry.amounts[-1] == 3
    result = added(machine, tables, [[-400.0, 0, 0], [0.0, -5, -100], [450.0, 0, 0]])
    np.testing.assert_allclose(result, [[0, -5 * UM, 0], [0, 0, 0], [0, 3 * UM, 0]], atol=0.5 * UM + 1e-12)
    assert made.violations == []


def test_squareness_fits_as_a_line(small_machine):
    errors = ErrorTable({}, {"EC0Y": (40e-6, np.nan)})
    machine = small_machine.with_setting("fanuc-straightness", "pairs", ["X(y)"])
    made = export(machine, errors, "fanuc-straightness", allow_unverified=True)
    tables = parse(machine, made.files["STRAIGHT.TXT"])
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


# --- round trip ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stores", ["correction", "error"])
def test_the_text_means_the_best_table_within_half_a_count(small_machine, small_errors, stores, tmp_path):
    machine = small_machine.with_setting("fanuc-straightness", "stores", stores)
    machine = machine.with_setting("fanuc-straightness", "detection_unit_um", 0.5)
    made = export(machine, small_errors, "fanuc-straightness", allow_unverified=True)
    text = made.files["STRAIGHT.TXT"]
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
    assert any(
        "not those of the machine file" in m for m in CONTROL.violations(machine, CONTROL.read_settings(machine), other)
    )


def test_travel_beyond_the_outer_points_and_large_amounts_are_violations():
    machine = machine_of(amount_limit=9)
    chosen = CONTROL.read_settings(machine)
    messages = CONTROL.violations(machine, chosen, parse(machine, SAMPLE.replace("N05731P32", "N05731P33")))
    assert any("an amount of 10 counts, the limit is 9" in m for m in messages)
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


def test_a_sample_of_the_users_control_is_followed(tmp_path, small_machine, small_errors):
    path = tmp_path / "PUNCH.TXT"
    path.write_bytes(b"%\r\nN3620 Q1 A1 P40\r\nN3624 Q1 A1 P50.000\r\nN10040 Q0 P1\r\n%\r\n")
    machine = small_machine.with_setting("fanuc-straightness", "style_from", str(path))
    made = export(machine, small_errors, "fanuc-straightness", allow_unverified=True)
    text = made.files["STRAIGHT.TXT"]
    assert re.search(r"(?m)^N5711 Q1 P1\r$", text) and re.search(
        r"(?m)^N3624 Q1 A1 P5\.000 A2 P4\.000 A3 P2\.400\r$", text
    )
    plain = export(small_machine, small_errors, "fanuc-straightness", allow_unverified=True)
    assert parse(machine, text) == parse(small_machine, plain.files["STRAIGHT.TXT"])
    assert "What was inferred from the sample" in made.preflight


MALFORMED = [
    (lambda t: t[: t.rindex("%")], "last '%' is missing", None),
    (lambda t: t.replace("N05711P1\n", ""), "holds no moving axis", None),
    (lambda t: t.replace("N05763P4\n", ""), "parameter 5763 is missing", 6),
    (lambda t: t.replace("N05763P4", "N05763P4\nN05763P5"), r"second time \(first in", 15),
    (lambda t: t.replace("N05763P4", "N05763P4.5"), "whole number", 14),
    (lambda t: t.replace("N05763P4", "N05763P4E1"), "single value word", 14),
    (lambda t: t.replace("N05763P4", "N05763P4,5"), "no place", 14),
    (lambda t: t.replace("N05763P4", "N05763PNAN"), "not a word", 14),
    (lambda t: t.replace("N05763P4", "N05763A1P4"), "single value word", 14),
    (lambda t: t.replace("N05732P36", "N05732P32"), "a < b < c < d", 9),
    (lambda t: t.replace("N05734P49", "N05734P50"), "not within those of X", 8),
    (lambda t: t.replace("N05721P2", "N05721P1"), "both moving and compensated", 7),
    (lambda t: t.replace("N05721P2", "N05721P7"), "axis 7 is none of X, Y, Z", 7),
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
def test_huge_garbage_is_refused_within_a_second(seed):
    start = time.process_time()
    for text in ("%\n" + seed * (3_900_000 // len(seed)), seed * (100_000_000 // len(seed))):
        with pytest.raises(InputError):
            parse(machine_of(), text)
    assert time.process_time() - start < 2.0


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
        ({"pairs": ["X(x)"]}, "a list of 'X(y)'"),
        ({"pairs": ["Y(x)", "Z(x)"]}, "each moving axis may stand once"),
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
