"""FANUC pitch compensation in both directions of travel, and the plan of point numbers."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.controls import SourceFile, controller_named
from compgen.controls.shared.integers import lowest_free
from compgen.data.error_table import Curve, ReversalCurves
from compgen.data.lengths import Points
from compgen.errors import CompgenWarning, InputError
from compgen.tables import export, read_tables, verify

CONTROL = controller_named("fanuc-pitch")
UM = 1e-3
SAMPLE = Path(__file__).parents[1] / "golden" / "fanuc-pitch" / "PITCH.TXT"


def with_settings(machine, **settings):
    for key, value in settings.items():
        machine = machine.with_setting("fanuc-pitch", key, value)
    return machine


def reversal_um(**values):
    nan = np.array([np.nan])
    pairs = {name: ("XYZ".index(name[0]), "XYZ".index(name[-1])) for name in values}
    return ReversalCurves({pairs[n]: Curve(np.zeros(1), np.array([v]) * UM, nan) for n, v in values.items()})


def numbers_of(text):
    """Parameters {number: {axis: value}} and points {number: value} of the text, by patterns of this test's own."""
    parameters = {
        int(n): {int(a): float(p) for a, p in re.findall(r"A(\d+)P(-?[\d.]+)", rest)}
        for n, rest in re.findall(r"^N0(\d{4})(A.*)$", text, re.M)
    }
    points = {int(n) - 10000: int(v) for n, v in re.findall(r"^N(1\d{4})P(-?\d+)$", text, re.M)}
    return parameters, points


def emulated(text, axis, along_mm, direction, towards):
    """Counts that a control outputs at section ends: the rule of 1.3 and 3626, 3627, worked anew from the text."""
    parameters, points = numbers_of(text)
    reference, first, last = (int(parameters[n][axis]) for n in (3620, 3621, 3622))
    shift = int(parameters[3626][axis]) - first if direction < 0 else 0
    total = {reference: parameters[3627][axis] if direction != towards else 0.0}
    for n in range(reference + 1, last + 1):
        total[n] = total[n - 1] + points[n + shift]
    for n in range(reference, first - 1, -1):
        total[n - 1] = total[n] - points[n + shift]
    numbers = np.array(sorted(total))
    return np.interp(along_mm, (numbers - reference) * parameters[3624][axis], [total[n] for n in numbers])


@pytest.mark.parametrize("stores", ["correction", "error"])
@pytest.mark.parametrize("towards", ["positive", "negative"])
def test_both_directions_follow_their_own_curve_within_half_a_count(small_machine, small_errors, stores, towards):
    machine = with_settings(small_machine, bidirectional=True, stores=stores, reference_return={"X": towards})
    curve = Curve(np.array([-300.0, 200.0]), np.array([-9.0, -4.0]) * UM, np.full(2, np.nan))
    reversal = ReversalCurves({**reversal_um(Y=6.3).curves, (0, 0): curve})
    made = export(machine, small_errors, "fanuc-pitch", reversal=reversal)
    assert made.violations == []
    text = made.files["PITCH.TXT"]
    mean = export(with_settings(small_machine, stores=stores), small_errors, "fanuc-pitch")
    chosen = CONTROL.read_settings(machine)
    tables = CONTROL(machine, chosen).parse([SourceFile(Path("PITCH.TXT"), text)])
    sign = 1.0 if stores == "correction" else -1.0
    for axis, way in ((0, 1 if towards == "positive" else -1), (1, 1)):
        low, high = machine.axes[axis].range_mm
        at_mm = np.linspace(low, high, 101)
        position = np.tile(np.array(machine.reference_point_mm), (101, 1))
        position[:, axis] = at_mm
        up, down = (
            emulated(text, axis + 1, at_mm - machine.reference_point_mm[axis], d, way) * sign * UM for d in (1, -1)
        )
        needed = -reversal.displacement(position, np.ones((101, 3)))[:, axis] * 2.0
        assert np.abs(up - down - needed).max() <= 1.0 * UM + 1e-12  # each of the two curves half a count
        home = (up if way > 0 else down)[np.argmin(np.abs(at_mm - machine.reference_point_mm[axis]))]
        assert abs(home) <= 1.0 * UM
        for direction, expected in ((1, up), (-1, down)):
            own = CONTROL(machine, chosen).emulate(tables, Points(position, approach=np.full((101, 3), direction)))
            np.testing.assert_allclose(own[:, axis], expected, atol=1e-12)
    assert "1851 (X, A1)" in made.preflight and made.preflight != mean.preflight


def test_an_axis_that_stops_farther_after_positive_travel_gets_plus_in_3627(small_machine):
    """B = +8 um, return in positive direction: nothing to add after positive travel, +8 um after negative travel."""
    machine = with_settings(small_machine, bidirectional=True)
    made = export(machine, compgen.ErrorTable(), "fanuc-pitch", reversal=reversal_um(X=8.0))
    parameters, points = numbers_of(made.files["PITCH.TXT"])
    assert parameters[3627] == {1: 8.0, 2: 0.0, 3: 0.0}
    assert parameters[3626][1] == 3000 and not any(points.values())
    assert "gets +1 in 3627" in made.manifest["sign_statement"]
    other = with_settings(machine, reference_return={"X": "negative"})
    text = export(other, compgen.ErrorTable(), "fanuc-pitch", reversal=reversal_um(X=8.0)).files["PITCH.TXT"]
    assert numbers_of(text)[0][3627][1] == -8.0  # zero after negative travel, -8 um after positive travel


def test_the_written_file_is_accepted_and_the_reversal_across_is_left_and_said(small_machine, small_errors, tmp_path):
    machine = with_settings(small_machine, bidirectional=True)
    reversal = reversal_um(X=-8.0, Z=5.0, XY=3.0)
    made = export(machine, small_errors, "fanuc-pitch", reversal=reversal)
    judged = verify(machine, read_tables(machine, made.write(tmp_path), "fanuc-pitch"), small_errors, reversal=reversal)
    assert judged.accepted, judged.reasons
    assert judged.uncorrected_um["reversal X in Y"] == 1.5 and "reversal X" not in judged.uncorrected_um
    assert any("reversal X in Y is +3.0 um" in text for text in made.warnings)
    assert not any(text.startswith("reversal X is") for text in made.warnings)
    plain = export(with_settings(small_machine, bidirectional=True), small_errors, "fanuc-pitch")
    path = tmp_path / "plain.TXT"
    path.write_text(plain.files["PITCH.TXT"])
    missing = verify(machine, read_tables(machine, path, "fanuc-pitch"), small_errors, reversal=reversal)
    assert any(reason.startswith("reversal X at X") for reason in missing.reasons)


def test_without_the_setting_the_backlash_parameters_hold_the_reversal(small_machine, small_errors):
    made = export(small_machine, small_errors, "fanuc-pitch", reversal=reversal_um(X=-8.0))
    rows = {row["name"]: row["value"] for row in made.manifest["parameters"]}
    assert rows["1851 (X, A1)"] == rows["1852 (X, A1)"] == "8" and rows["3605#0"] == "0"
    assert "N03627" not in made.files["PITCH.TXT"]


def test_points_of_unknown_approach_get_the_mean_and_a_warning(small_machine):
    machine = with_settings(small_machine, bidirectional=True)
    made = export(machine, compgen.ErrorTable(), "fanuc-pitch", reversal=reversal_um(X=8.0))
    chosen = CONTROL.read_settings(machine)
    tables = CONTROL(machine, chosen).parse([SourceFile(Path("p"), made.files["PITCH.TXT"])])
    with pytest.warns(CompgenWarning, match="tables of X differ"):
        added = CONTROL(machine, chosen).emulate(tables, Points(np.zeros((1, 3))))
    assert added[0, 0] == pytest.approx(4 * UM)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"value_type": "total"}, "3627 counts with total values"),
        ({"magnification": 2}, "3627 is multiplied"),
        ({"reference_return": {"X": "up"}}, "'positive', 'negative'"),
        ({"negative_first_number": 50, "negative_last_number": 40}, "is below 50"),
    ],
)
def test_what_no_document_settles_is_refused(small_machine, settings, words):
    with pytest.raises(InputError, match=re.escape(words)):
        CONTROL.read_settings(with_settings(small_machine, bidirectional=True, **settings))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda t: re.sub(r"N03627.*\n", "", t), "parameter 3627 is missing for X"),
        (lambda t: re.sub(r"N13000P.*\n", "", t), r"gives points 3000 to \d+, but 3000"),
        (lambda t: t.replace("N03627A1P", "N03627A1P99999"), "whole number from -32768 to 32767"),
    ],
)
def test_a_damaged_file_of_both_directions_is_refused(small_machine, damage, words):
    machine = with_settings(small_machine, bidirectional=True)
    text = export(machine, compgen.ErrorTable(), "fanuc-pitch", reversal=reversal_um(X=8.0)).files["PITCH.TXT"]
    with pytest.raises(InputError, match=words) as caught:
        CONTROL(machine).parse([SourceFile(Path("p"), damage(text))])
    assert caught.value.line is not None or "missing for X" in words


# --- numbers ---------------------------------------------------------------------------------------------------------


def test_blocks_avoid_the_numbers_of_other_axes_and_keep_those_that_the_user_fixes(small_machine, small_errors):
    machine = with_settings(small_machine, first_numbers={"Y": 200}, reserved_numbers=[[1, 30], [195, 199]])
    made = export(machine, small_errors, "fanuc-pitch")
    parameters, _ = numbers_of(made.files["PITCH.TXT"])
    spans = sorted((int(parameters[3621][a]), int(parameters[3622][a])) for a in (1, 2, 3))
    assert parameters[3621][2] == 200
    taken = sorted([*spans, (1, 30), (195, 199)])
    assert all(a[1] < b[0] for a, b in zip(taken, taken[1:], strict=False))
    assert made.violations == []


def test_fixed_blocks_that_overlap_are_a_violation(small_machine, small_errors):
    machine = with_settings(small_machine, first_numbers={"X": 100, "Y": 101})
    assert any("overlap" in text for text in export(machine, small_errors, "fanuc-pitch").violations)


def test_the_lowest_free_number_is_that_of_a_search_through_all():
    generator = np.random.default_rng(4)
    for _ in range(200):
        taken = [(int(a), int(a) + int(b)) for a, b in generator.integers(0, 12, (4, 2))]
        start, count = int(generator.integers(0, 5)), int(generator.integers(1, 6))
        used = {n for low, high in taken for n in range(low, high + 1)}
        expected = next(n for n in range(start, 99) if not used & set(range(n, n + count)))
        assert lowest_free(taken, start, count) == expected


@pytest.mark.parametrize(("last_value", "words"), [(-3, None), (-2, "rotary axis A4 sum to 1 counts")])
def test_a_rotary_axis_of_45_degrees_has_numbers_60_to_68_that_sum_to_zero(small_machine, last_value, words):
    """Worked example of the manual: reference point 60, 360 degrees, farthest numbers 60 and 68."""
    values = [last_value, 1, 2, -1, 0, 3, -2, 0, last_value]  # number 60 is set equal to 68
    records = [f"N{10060 + k}P{value}" for k, value in enumerate(values)]
    text = SAMPLE.read_text().replace(
        "N10033", "N03620A4P60\nN03621A4P60\nN03622A4P68\nN03623A4P1\nN03624A4P45.0\nN03625A4P360.0\nN10033"
    )
    text = text.replace("N10049P2\n", "N10049P2\n" + "\n".join(records) + "\n")
    chosen = CONTROL.read_settings(small_machine)
    tables = CONTROL(small_machine, chosen).parse([SourceFile(Path("p"), text)])
    assert tables.others == ((4, 60, 68),)
    found = [m for m in CONTROL(small_machine, chosen).violations(tables) if "rotary" in m]
    assert (found == []) if words is None else (words in found[0])
