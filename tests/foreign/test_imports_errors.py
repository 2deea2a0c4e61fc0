"""Sheets of squareness, straightness, pitch, yaw and roll: signs and units worked by hand, and what is never guessed."""

import json

import numpy as np
import openpyxl
import pytest

from compgen.data.error_table import read_errors
from compgen.errors import InputError
from compgen.foreign import ImportOptions, import_file

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
    assert len(doubts) == 4
    assert "line 3: the sign of 'Z to X' is not clear" in doubts[1] or "Rechtwinkligkeit XZ" in doubts[1]
    assert "EB0Z > 0: the angle between the positive axes is less than 90 degrees" in doubts[1]
    assert "--sign angle-above-90" in doubts[3]
    assert "docs/instruments.md" in doubts[3]
    item = import_file(path, ImportOptions(sign=sign))
    assert item.doubts == ()
    found = squareness_urad(item)
    assert [found[name][0] for name in ("EC0Y", "EB0Z", "EA0Z")] == pytest.approx(expected_urad, abs=1e-9)


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
    code, _, err = call("identify", machine, path, "--out", tmp_path / "o", "--json")
    assert code == 0, err
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    found = {name: (1e6 * value, 1e6 * u) for name, (value, u) in errors.squareness.items()}
    for name, value in {"EC0Y": 25, "EB0Z": -15, "EA0Z": 10}.items():
        assert found[name] == pytest.approx((value, 3), abs=1e-3)
    # 20 um/m over 400 mm, -30 um/m over 300 mm, both zero at the reference point 0
    assert 1e3 * errors.curves["EXX"].at(400.0) == pytest.approx(8, abs=1e-6)
    assert 1e3 * errors.curves["EYY"].at(300.0) == pytest.approx(-9, abs=1e-6)
    code, out, err = call("run", machine, path, "--controller", "isg-csv", "--out", tmp_path / "t", "--json")
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
