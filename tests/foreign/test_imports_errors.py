"""Sheets of squareness, straightness, pitch, yaw and roll: signs and units worked by hand, and what is never guessed."""

import json

import numpy as np
import openpyxl
import pytest

from compgen.data.error_table import read_errors
from compgen.data.machine import load_machine
from compgen.errors import InputError
from compgen.foreign import ImportOptions, import_file
from compgen.kinematics import exact_error

#: One second of arc, pi / 648000 rad.
ARCSEC_URAD = 4.84813681109536
MACHINE = """\
name = "{chain}"
chain = "{chain}"
axes.X = {{range_mm = [0.0, 400.0], nodes = 5}}
axes.Y = {{range_mm = [0.0, 300.0], nodes = 5}}
axes.Z = {{range_mm = [-200.0, 0.0], nodes = 5}}
"""


def written(tmp_path, text, name="sheet.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def workbook(tmp_path, sheets, name="lab.xlsx"):
    book = openpyxl.Workbook()
    book.remove(book.active)
    for title, rows in sheets.items():
        own = book.create_sheet(title)
        for row in rows:
            own.append(row)
    book.save(tmp_path / name)
    return tmp_path / name


def axis_sheet(axis, slope_um_per_m, start_mm, end_mm):
    """Two runs each way of a scale error, with a repeatability of 0.2 um."""
    names = ["Position [mm]", "Run 1 + [um]", "Run 1 - [um]", "Run 2 + [um]", "Run 2 - [um]"]
    targets = [start_mm + k * (end_mm - start_mm) / 4 for k in range(5)]
    rows = [[t, *(slope_um_per_m * t / 1000 + d for d in (0.1, 0.1, -0.1, -0.1))] for t in targets]
    return [[f"{axis}-axis, deviation"], names, *rows]


def squareness_urad(item):
    return {name: (1e6 * value, 1e6 * u) for name, (value, u) in item.data.squareness.items()}


#: Text, and EC0Y, EB0Z, EA0Z in urad with the standard uncertainty: the words and units of several laboratories.
NAMED = {
    "unit above": ("Error;Value [arcsec]\nEC0Y;2\nEB0Z;-1,5\n",
                   {"EC0Y": (2 * ARCSEC_URAD, None), "EB0Z": (-1.5 * ARCSEC_URAD, None)}),
    "expanded": ("Squareness,um/m,U (k=2) um/m\nC0Y,12,4\nEA0Z,-7,3\n", {"EC0Y": (12, 2), "EA0Z": (-7, 1.5)}),
    "k elsewhere": ("k = 2\nName;Wert;Einheit;Unsicherheit\nEC0Y;0,012;mm/m;0,004\n", {"EC0Y": (12, 2)}),
    "standard": ("No;Name;Value [urad];u [urad]\n1;EC0Y;12;4\n2;EB0Z;3;1\n", {"EC0Y": (12, 4), "EB0Z": (3, 1)}),
    # 9 um over 300 mm: 30 urad; 1.5 um of U at k = 2 over 300 mm: 2.5 urad
    "over a length": ("Rechtwinkligkeit;Abweichung [µm];Messlänge [mm];U (k=2) [µm]\nEC0Y;9;300;1,5\nEA0Z;-6;200;1,5\n",
                      {"EC0Y": (30, 2.5), "EA0Z": (-30, 3.75)}),
    "ratio": ("Rechtwinkligkeit\nEC0Y;0,009/300\nEB0Z;-6 µm / 200 mm\n", {"EC0Y": (30, None), "EB0Z": (-30, None)}),
    "unit in the cell": ("Squareness (k = 2)\nEC0Y;12 ± 3 µrad\nEA0Z;-5 arcsec\n",
                         {"EC0Y": (12, 1.5), "EA0Z": (-5 * ARCSEC_URAD, None)}),
    "columns": ("Name;Description;Value;Unit;U;k\nEC0Y;Y with respect to X;2;arcsec;1;2\n",
                {"EC0Y": (2 * ARCSEC_URAD, ARCSEC_URAD / 2)}),
    "units of U": ("Squareness;Value [arcsec];U (k=2) [urad]\nEC0Y;2;2\n", {"EC0Y": (2 * ARCSEC_URAD, 1)}),
    "certificate": ("Certificate no. 12\nDate;12.03.2025\nTemperature;20.1;C\nSquareness;Value [urad]\nEC0Y;12\n",
                    {"EC0Y": (12, None)}),
    # the angle itself: +Y leans to -X where EC0Y > 0 (more than 90); +Z leans to +X where EB0Z > 0 (less than 90)
    "angles": ("Angle;deg\nEC0Y;90.001\nXZ;89.999\n", {"EC0Y": (17.4532925, None), "EB0Z": (17.4532925, None)}),
}  # fmt: skip


@pytest.mark.parametrize("case", NAMED)
def test_squareness_by_its_name_with_units_uncertainty_and_length(tmp_path, case):
    text, expected = NAMED[case]
    item = import_file(written(tmp_path, text))
    assert (item.doubts, item.kind) == ((), "errors")
    found = squareness_urad(item)
    assert list(found) == list(expected)
    for name, (value, u) in expected.items():
        assert found[name] == pytest.approx((value, np.nan if u is None else u), abs=1e-6, nan_ok=True)


PAIRS = (
    "Squareness [urad]\nXY;10\nZ to X;20\nY-Z;30\n",
    "Rechtwinkligkeit [µrad]\nX/Y;10\nRechtwinkligkeit XZ;20\nZ-Achse zu Y-Achse;30\n",
)


@pytest.mark.parametrize("text", PAIRS)
@pytest.mark.parametrize(
    ("sign", "expected_urad"),
    [
        # EC0Y and EA0Z are positive above 90 degrees, EB0Z below (docs/instruments.md)
        ("angle-above-90", (10, -20, 30)),
        ("angle-below-90", (-10, 20, -30)),
        ("rotation", (10, 20, 30)),
    ],
)
def test_the_sign_of_pairs_of_axes_is_asked_for_and_answered(tmp_path, text, sign, expected_urad):
    path = written(tmp_path, text)
    doubts = import_file(path).doubts
    (doubt,) = doubts
    assert "line 3: the sign of 'Z to X' is not clear" in doubt or "Rechtwinkligkeit XZ" in doubt
    assert "EB0Z > 0: the angle between the positive axes is less than 90 degrees" in doubt
    assert "--sign angle-above-90" in doubt
    assert "docs/instruments.md" in doubt
    item = import_file(path, ImportOptions(sign=sign))
    assert item.doubts == ()
    found = squareness_urad(item)
    assert [found[name][0] for name in ("EC0Y", "EB0Z", "EA0Z")] == pytest.approx(expected_urad, abs=1e-9)


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WZFXYT", "WYFZXT"])
@pytest.mark.parametrize(("sign", "side"), [("angle-above-90", 1.0), ("angle-below-90", -1.0)])
def test_the_axes_of_the_machine_enclose_the_angle_that_was_stated(tmp_path, chain, sign, side):
    file = tmp_path / "machine.toml"
    file.write_text(MACHINE.format(chain=chain))
    errors = import_file(written(tmp_path, PAIRS[0]), ImportOptions(sign=sign)).data
    corners_mm = np.array([[0.0, 0.0, -200.0], [400.0, 0.0, -200.0], [0.0, 300.0, -200.0], [0.0, 0.0, 0.0]])
    tip_mm = corners_mm + exact_error(load_machine(str(file)), errors, corners_mm)
    along = [tip_mm[k] - tip_mm[0] for k in (1, 2, 3)]
    for (a, b), stated_urad in {(0, 1): 10, (0, 2): 20, (1, 2): 30}.items():
        cosine = along[a] @ along[b] / np.linalg.norm(along[a]) / np.linalg.norm(along[b])
        assert 1e6 * (np.arccos(cosine) - np.pi / 2) == pytest.approx(side * stated_urad, abs=1e-2)


def test_neither_error_nor_correction_says_which_angle_a_pair_means(tmp_path):
    for sign in ("error", "correction"):
        assert import_file(written(tmp_path, PAIRS[0]), ImportOptions(sign=sign)).doubts
    item = import_file(written(tmp_path, "Name;urad\nEC0Y;10\nEB0Z;5\n"), ImportOptions(sign="correction"))
    assert [value for value, _ in squareness_urad(item).values()] == pytest.approx([-10, -5])


WRONG = {
    "Squareness [urad]\nXY;10\nXA;20\n": ("line 3", "'XA' is not a pair of axes"),
    "Squareness [urad]\nEC0Y;10\nEC0X;20\n": ("line 3", "EC0X, is -EC0Y"),
    "Squareness [urad]\nEC0Y;10\nEC0Y;12\n": ("line 3", "appears again"),
    "Squareness [urad]\nEC0Y;10\nX-Y;12\n": ("line 3", "appears again"),
    "Squareness [urad]\nEC0Y;10\nEB0Z;about 5\n": ("line 3", "the number beside 'EB0Z' is not understood"),
    "Squareness;urad\nEC0Y;10\nEB0Z;\n": ("line 3", "the number beside 'EB0Z' is not understood"),
    "Squareness;urad\nEC0Y;10\nXZ;inf\n": ("line 3", "the number beside 'XZ' is not understood"),
    "Squareness;urad;u [urad]\nEC0Y;10;2\nEB0Z;;2\n": ("line 3", "contains no value"),
    "Name;Pair;Squareness [urad]\nEC0Y;XZ;10\n": ("line 2", "'EC0Y' is not a pair of axes"),
    "Squareness;urad;U (k=0)\nEC0Y;10;2\n": ("line 2", "states no coverage factor k"),
    "Squareness\nEC0Y;10\nEB0Z;5 urad\n": ("line 2", "states no unit of 'EC0Y'"),
    "Squareness;urad;U [urad]\nEC0Y;10;2\nEB0Z;5;2\n": ("line 2", "states no coverage factor k of 'EC0Y'"),
    "Squareness;urad;Limit [urad]\nEC0Y;10;50\nEB0Z;5;50\n": ("line 2", "contains several numbers"),
    "Squareness;um;Length\nEC0Y;9;300\nEB0Z;6;300\n": ("line 2", "the length has no unit"),
    "Squareness;mrad\nEC0Y;10\nEB0Z;500\n": ("line 3", "too large"),
}


@pytest.mark.parametrize("text", WRONG)
def test_wrong_tables_of_squareness_write_nothing(call, tmp_path, listing, text):
    path = written(tmp_path, text)
    before = listing(tmp_path)
    code, out, err = call("import", path, "--out", tmp_path / "o")
    assert code == 2
    line, message = WRONG[text]
    assert message in out + err
    assert line in out + err or f"sheet.csv:{line.split()[1]}" in out + err
    assert listing(tmp_path) == before


def test_an_answer_about_angles_is_refused_where_there_is_no_squareness(tmp_path):
    path = written(tmp_path, "X deviation\nPosition [mm];Deviation [um]\n0;0\n100;1\n200;3\n")
    with pytest.raises(InputError, match="rotation applies to squareness"):
        import_file(path, ImportOptions(sign="rotation"))


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
def test_axes_and_squareness_of_one_workbook_in_one_command(call, tmp_path, chain):
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.format(chain=chain))
    square = [["Rechtwinkligkeit", "Wert [µrad]", "U (k=2) [µrad]"], ["EC0Y", 25, 6], ["EB0Z", -15, 6], ["EA0Z", 10, 6]]
    sheets = {"X": axis_sheet("X", 20, 0, 400), "Y": axis_sheet("Y", -30, 0, 300), "Rechtwinkligkeit": square}
    path = workbook(tmp_path, sheets)
    code, _, err = call("identify", machine, path, "--prior", "none", "--out", tmp_path / "o", "--json")
    assert code == 0, err
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    found = {name: (1e6 * value, 1e6 * u) for name, (value, u) in errors.squareness.items()}
    for name, value in {"EC0Y": 25, "EB0Z": -15, "EA0Z": 10}.items():
        assert found[name] == pytest.approx((value, 3), abs=1e-3)
    # 20 um/m over 400 mm, -30 um/m over 300 mm, both zero at the reference point 0
    assert 1e3 * errors.curves["EXX"].at(400.0) == pytest.approx(8, abs=1e-6)
    assert 1e3 * errors.curves["EYY"].at(300.0) == pytest.approx(-9, abs=1e-6)
    code, out, err = call(
        "run", machine, path, "--prior", "none", "--controller", "isg-csv", "--out", tmp_path / "t", "--json"
    )
    assert code == 0, err
    assert json.loads(out)["accepted"] is True


def test_an_open_sign_on_one_sheet_stops_the_whole_workbook(call, tmp_path, listing):
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.format(chain="WFYXZT"))
    path = workbook(tmp_path, {"X": axis_sheet("X", 20, 0, 400), "Squareness": [["X-Y", 25, "urad"]]})
    before = listing(tmp_path)
    code, _, err = call("run", machine, path, "--controller", "isg-csv", "--out", tmp_path / "t")
    assert code == 2
    assert "the sign of 'X-Y' is not clear" in err
    assert listing(tmp_path) == before
    code, _, err = call("import", path, "--sign", "angle-below-90", "--out", tmp_path / "o")
    assert code == 0, err
    assert read_errors(tmp_path / "o" / "lab.errors.csv").squareness["EC0Y"][0] == pytest.approx(-25e-6)


#: Straightness and angles of X, worked by hand: targets, and for each error the two runs forth and back.
ENGLISH = """\
Axis;X
Position [mm];Straightness Y fwd 1 [um];Straightness Y bwd 1 [um];Straightness Y fwd 2 [um];\
Straightness Y bwd 2 [um];Pitch [arcsec];Yaw (arcsec);Roll [um/m]
0;0;3;0,4;3,4;0;0;0
200;2;5;2,4;5,4;1;-2;5
400;1;4;1,4;4,4;2;-3;4
"""
GERMAN = """\
X-Achse
Position [mm];Geradheit Y vor 1 [µm];Geradheit Y zurück 1 [µm];Geradheit Y vor 2 [µm];Geradheit Y zurück 2 [µm];Nicken [arcsec];\
Gieren [arcsec];Rollen [µm/m]
0;0;3;0,4;3,4;0;0;0
200;2;5;2,4;5,4;1;-2;5
400;1;4;1,4;4,4;2;-3;4
"""
#: Mean over both directions and runs, um and urad.
MEANS = {
    "EYX": (1.7, 3.7, 2.7),
    "EBX": (0, ARCSEC_URAD, 2 * ARCSEC_URAD),
    "ECX": (0, -2 * ARCSEC_URAD, -3 * ARCSEC_URAD),
    "EAX": (0, 5, 4),
}


@pytest.mark.parametrize("text", [ENGLISH, GERMAN])
def test_straightness_pitch_yaw_and_roll_of_an_axis_in_one_table(tmp_path, text):
    path = written(tmp_path, text)
    (doubt,) = import_file(path).doubts
    for words in (
        "is EYX",
        "is EBX",
        "is ECX",
        "is EAX",
        "--sign error",
        "right-handed",
        "docs/instruments.md",
        "--map",
    ):
        assert words in doubt
    for sign, factor in (("error", 1.0), ("correction", -1.0)):
        item = import_file(path, ImportOptions(sign=sign))
        assert item.doubts == ()
        curves = item.data.curves
        assert set(curves) == set(MEANS)
        for name, values in MEANS.items():
            scale = 1e-3 if name == "EYX" else 1e-6
            assert curves[name].position_mm.tolist() == [0, 200, 400]
            assert curves[name].value == pytest.approx([factor * scale * v for v in values], abs=1e-15)
        # runs 0.4 apart: variance 0.08 um^2 in each of 6 cells; mean of two cells of two runs: sqrt(0.08 / 4)
        assert curves["EYX"].u == pytest.approx([1e-3 * np.sqrt(0.02)] * 3)
        assert np.isnan(curves["EBX"].u).all()
        # backwards 3 um more than forth
        assert item.reversal.curves[0, 1].value == pytest.approx([-3e-3 * factor] * 3)


def test_rows_of_runs_with_directions_are_averaged(tmp_path):
    rows = [
        f"{x};{way};{pitch}" for way, add in (("+", 0), ("-", 4)) for x in (0, 100, 200) for pitch in (x / 100 + add,)
    ]
    path = written(tmp_path, "Y axis\nPosition [mm];Direction;Pitch [urad]\n" + "\n".join(rows) + "\n")
    curve = import_file(path, ImportOptions(sign="error")).data.curves["EAY"]
    assert curve.value == pytest.approx([2e-6, 3e-6, 4e-6])


@pytest.mark.parametrize(
    ("axis", "heading", "error"),
    [
        # Z vertical: pitch turns about the horizontal axis across the travel, yaw about the vertical, roll about the travel
        ("X", "Pitch [urad]", "EBX"),
        ("X", "Gieren [urad]", "ECX"),
        ("X", "Rollwinkel [urad]", "EAX"),
        ("Y", "Nickwinkel [urad]", "EAY"),
        ("Y", "Yaw [urad]", "ECY"),
        ("Y", "Roll [urad]", "EBY"),
        ("Z", "Roll [urad]", "ECZ"),
        ("X", "Geradheit vertikal [um]", "EZX"),
        ("Y", "Straightness horizontal [um]", "EXY"),
        ("X", "Straightness V (um)", "EZX"),
        ("X", "Straightness H (um)", "EYX"),
        ("Z", "Straightness X [um]", "EXZ"),
        ("Y", "Geradheitsabweichung Z [um]", "EZY"),
    ],
)
def test_words_and_the_axis_name_the_error(tmp_path, axis, heading, error):
    path = written(tmp_path, f"Achse: {axis}\nPosition [mm];{heading}\n0;0\n100;2\n200;3\n")
    assert f"is {error}" in import_file(path).doubts[0]
    assert set(import_file(path, ImportOptions(sign="error")).data.curves) == {error}


@pytest.mark.parametrize(
    "heading", ["Pitch [urad]", "Yaw [urad]", "Straightness vertical [um]", "Straightness Z [um]", "Straightness [um]"]
)
def test_what_the_words_do_not_say_is_named_by_the_user(call, tmp_path, listing, heading):
    path = written(tmp_path, f"Axis: Z\nPosition [mm];{heading}\n0;0\n100;2\n200;3\n")
    before = listing(tmp_path)
    code, _, err = call("import", path, "--sign", "error", "--out", tmp_path / "o")
    assert code == 2
    assert "sheet.csv:2" in err
    assert "which error of Z this is remains open; name it by --map" in err
    assert listing(tmp_path) == before
    error = "EBZ" if "urad" in heading else "EXZ"
    curves = import_file(path, ImportOptions(columns={error: heading})).data.curves
    assert {name: curve.value[1] for name, curve in curves.items()} == pytest.approx(
        {error: 2e-6 if "urad" in heading else 2e-3}
    )


def test_what_stands_beside_the_errors_is_never_left_out(tmp_path):
    path = written(
        tmp_path, "X axis\nPosition [mm];Pitch [urad];Yaw [urad];Pitch mean [urad];Nonsense\n0;0;1;0;1\n100;2;1;2;5\n"
    )
    (doubt,) = import_file(path, ImportOptions(sign="error")).doubts
    assert "'Nonsense'" in doubt
    item = import_file(path, ImportOptions(sign="error", ignore=["Nonsense"]))
    assert (item.doubts, set(item.data.curves)) == ((), {"EBX", "ECX"})
    assert any("'Pitch mean [urad]' is a statistic" in note for note in item.notes)
    path.write_text(path.read_text().replace("100;2;1;2;5", "100;2;1;9;5"))
    assert "states 9" in " ".join(import_file(path, ImportOptions(sign="error", ignore=["Nonsense"])).doubts)


def test_named_errors_with_directions_state_their_sign_unless_corrections_are_mentioned(tmp_path):
    text = "X axis\nPosition [mm];EYX + [um];EYX - [um]\n0;1;3\n100;2;4\n"
    item = import_file(written(tmp_path, text))
    assert item.doubts == ()
    assert item.data.curves["EYX"].value == pytest.approx([2e-3, 3e-3])
    path = written(tmp_path, "Korrekturwerte\n" + text)
    assert "mentions corrections" in import_file(path).doubts[0]
    assert import_file(path, ImportOptions(sign="correction")).data.curves["EYX"].value == pytest.approx([-2e-3, -3e-3])


def test_the_question_lists_the_columns_whose_sign_is_known_but_would_be_reversed_too(tmp_path):
    path = written(tmp_path, "X axis\nPosition [mm];Deviation [um];EYX [um];Pitch [urad]\n0;0;0;0\n100;1;2;3\n")
    (doubt,) = import_file(path).doubts
    assert "the answer applies to 'EYX [um]', 'Deviation [um]' as well" in doubt
    curves = import_file(path, ImportOptions(sign="error")).data.curves
    found = {name: curve.value[1] for name, curve in curves.items()}
    assert found == pytest.approx({"EXX": 1e-3, "EYX": 2e-3, "EBX": 3e-6})


def test_two_rows_of_names_give_error_and_direction(tmp_path):
    path = written(tmp_path, "Y axis\nPosition [mm];Pitch [urad];;Yaw [urad];\n;+;-;+;-\n0;0;2;2;4\n100;1;3;3;5\n")
    curves = import_file(path, ImportOptions(sign="error")).data.curves
    assert curves["EAY"].value == pytest.approx([1e-6, 2e-6])
    assert curves["ECY"].value == pytest.approx([3e-6, 4e-6])


def test_a_unit_of_length_is_no_angle(tmp_path):
    path = written(tmp_path, "X axis\nPosition [mm];Pitch [um]\n0;0\n100;2\n")
    with pytest.raises(InputError, match="expected a unit of angle"):
        import_file(path, ImportOptions(sign="error"))


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
def test_a_workbook_of_runs_angles_and_squareness_in_one_command(call, tmp_path, chain):
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.format(chain=chain))
    angles = [["X axis"], ["Position [mm]", "EBX + [urad]", "EBX - [urad]"], [0, 1, 3], [200, 5, 7], [400, 9, 11]]
    sheets = {"X": axis_sheet("X", 20, 0, 400), "Winkel": angles, "Rechtwinkligkeit": [["EC0Y", "25 urad"]]}
    code, _, err = call("identify", machine, workbook(tmp_path, sheets), "--prior", "none", "--out", tmp_path / "o")
    assert code == 0, err
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    # the mean of both directions, 2, 6, 10 urad, zero at the reference point
    assert 1e6 * errors.curves["EBX"].at(400.0) == pytest.approx(8, abs=1e-6)
    assert 1e6 * errors.squareness["EC0Y"][0] == pytest.approx(25, abs=1e-3)
    assert 1e3 * errors.curves["EXX"].at(400.0) == pytest.approx(8, abs=1e-6)


STEPS = {
    # 10, 30, -20 um/m over 200 mm: 2, 6, -4 um
    "slopes": "X axis\nPosition [mm];Straightness Z [um/m]\n0;10\n200;30\n400;-20\n",
    "differences": "X-Achse\nPosition [mm];Geradheit vertikal [µm]\n0;2\n200;6\n400;-4\n",
    # two runs, 1 um/m apart
    "runs": "X axis\nPosition [mm];Straightness Z run 1 [um/m];Straightness Z run 2 [um/m]\n"
    "0;9,5;10,5\n200;29,5;30,5\n400;-20,5;-19,5\n",
}


@pytest.mark.parametrize("case", STEPS)
def test_readings_of_a_level_step_by_step_are_summed_if_the_user_says_so(tmp_path, case):
    item = import_file(written(tmp_path, STEPS[case]), ImportOptions(sign="error", base_length_mm=200.0))
    assert item.doubts == ()
    curve = item.data.curves["EZX"]
    assert curve.position_mm.tolist() == [0, 200, 400, 600]
    assert curve.value == pytest.approx([0, 2e-3, 8e-3, 4e-3], abs=1e-15)
    if case == "runs":
        # variance of a reading 0.5 (um/m)^2, of the mean of two 0.25; times (0.2 m)^2; grows with the number of steps
        assert curve.u == pytest.approx(1e-3 * np.sqrt(0.25 * 0.04 * np.arange(4)))


def test_a_base_length_that_does_not_fit_is_refused(tmp_path):
    path = written(tmp_path, STEPS["slopes"])
    with pytest.raises(InputError, match="is in um/m, and EZX expected a unit of length"):
        import_file(path, ImportOptions(sign="error"))
    with pytest.raises(InputError, match="step from 0 mm on is not the base length of 100 mm"):
        import_file(path, ImportOptions(sign="error", base_length_mm=100.0))
    for text in (STEPS["slopes"].replace("Straightness Z", "Pitch"), "EC0Y;5 urad\nEB0Z;3 urad\n"):
        with pytest.raises(InputError, match="200 mm does not apply"):
            import_file(written(tmp_path, text), ImportOptions(sign="error", base_length_mm=200.0))


def test_runs_under_a_title_of_straightness_are_not_taken_for_positioning(tmp_path):
    text = "Geradheit X-Achse\nPosition [mm];Lauf 1 + [µm];Lauf 1 - [µm]\n0;0;1\n100;2;3\n200;1;1\n"
    path = written(tmp_path, text)
    assert "mention straightness; give --error NAME" in " ".join(import_file(path).doubts)
    assert set(import_file(path, ImportOptions(error="EYX", sign="error")).data.curves) == {"EYX"}
    assert import_file(path, ImportOptions(kind="axis", sign="error")).doubts == ()


def test_how_a_straightedge_lay_does_not_change_a_squareness_that_was_measured_apart(call, tmp_path):
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.format(chain="WFYXZT"))
    # a line of 100 um/m, and 2 um of straightness in the middle
    straight = [["X axis"], ["Position [mm]", "EYX [um]"], [0, 5], [200, 27], [400, 45]]
    square = [["EC0Y", "25 urad"]]
    for name, sheets in {
        "with runs": {"X": axis_sheet("X", 20, 0, 400), "Geradheit": straight, "Rechtwinkligkeit": square},
        "errors only": {"Geradheit": straight, "Rechtwinkligkeit": square},
    }.items():
        path = workbook(tmp_path, sheets, f"{name}.xlsx")
        out = tmp_path / name
        code, _, err = call("identify", machine, path, "--prior", "none", "--out", out / "direct")
        assert code == 0, err
        code, _, err = call("import", path, "--out", out)
        assert code == 0, err
        code, _, err = call(
            "identify", machine, *sorted(out.glob("*.csv")), "--prior", "none", "--out", out / "imported"
        )
        assert code == 0, err
        for folder in ("direct", "imported"):
            errors = read_errors(out / folder / "identified.errors.csv")
            assert 1e6 * errors.squareness["EC0Y"][0] == pytest.approx(25, abs=1e-3)
            assert 1e3 * errors.curves["EYX"].at(200.0) == pytest.approx(2, abs=1e-6)
