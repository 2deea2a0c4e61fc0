"""The style of a file that was punched from the user's own control is found out, followed, and told."""

from __future__ import annotations

import re
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import grows_with_its_file

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import SourceFile, controller_named
from compgen.controls.fanuc_pitch_tables import PitchTables
from compgen.controls.fanuc_records import FanucStyle, style_of
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Axis, Chain, Machine
from compgen.errors import InputError
from compgen.tables import export, read_tables
from compgen.tables.render import load_format, render_files

SAMPLE = (Path(__file__).parents[1] / "golden" / "fanuc-pitch" / "PITCH.TXT").read_text()
CURVE_MM = np.array([0, 2, 3, 4, 2, 2, 1, 1, 0, 2, 3, 3, 2, 1, -1, -1, 0, 2]) * 1e-3
CONTROL = controller_named("fanuc-pitch")


def sample_machine(**options):
    """The machine of the manual's example: its table is the sample, number for number."""
    axes = tuple(Axis(r, np.linspace(*r, 3)) for r in ((-400.0, 450.0), (-1.0, 1.0), (-1.0, 1.0)))
    machine = Machine("sample", Chain("WXYFZT"), axes)
    defaults = {"first_number": 33, "interval_mm": {"X": 50.0, "Y": 1.0, "Z": 1.0}}
    for key, value in {**defaults, **options}.items():
        machine = machine.with_setting("fanuc-pitch", key, value)
    return machine


def written(machine):
    chosen = CONTROL.read_settings(machine)
    basis = CONTROL(machine, chosen).basis(ErrorTable())
    values = {term.name: term.start for term in basis} | {"X(x)": CURVE_MM}
    tables = PitchTables((CONTROL(machine, chosen).build(basis, values).blocks[0], None, None))
    context = {"machine_name": "m", "input_sha256": "0" * 64, **CONTROL(machine, chosen).context(tables)}
    return render_files(load_format("fanuc-pitch"), context)["PITCH.TXT"], context["warnings"]


def with_q_words(text):
    return re.sub(r"(?m)^N1(\d{4})", r"N1\1Q0", re.sub(r"(?m)^N0(\d{4})", r"N0\1Q1", text))


def spaced(text):
    return re.sub(r"(?m)(?<=[\d.])(?=[A-Z])", " ", text)


def points_first(text):
    lines = text.split()
    return "\n".join(["%", *lines[6:-1], *lines[1:6], "%", ""])


CLONES = {
    "as it is": lambda t: t,
    "Q words": with_q_words,
    "Q words behind": lambda t: re.sub(r"(?m)^(N\d+)(Q\d)(.+)$", r"\1\3\2", with_q_words(t)),
    "white space": spaced,
    "Q words and white space": lambda t: spaced(with_q_words(t)),
    "no leading zeros": lambda t: t.replace("N0", "N"),
    "more digits": lambda t: t.replace("N", "N000"),
    "CR LF": lambda t: t.replace("\n", "\r\n"),
    "LF CR CR": lambda t: t.replace("\n", "\n\r\r"),
    "CR": lambda t: t.replace("\n", "\r"),
    "semicolons": lambda t: t.replace("\n", ";\n"),
    "semicolons without those of the marks": lambda t: t.replace("\n", ";\n").replace("%;", "%"),
    "value word before axis word": lambda t: re.sub(r"A1P([\d.]+)", r"P\1A1", t),
    "metric lengths": lambda t: t.replace("P50.0", "M50.0"),
    "three decimals": lambda t: t.replace("P50.0", "P50.000"),
    "a bare point": lambda t: t.replace("P50.0", "P50."),
    "whole numbers with a point": lambda t: re.sub(r"P(-?\d+)$", r"P\1.", t, flags=re.M),
    "plus signs": lambda t: re.sub(r"P(\d+)$", r"P+\1", t, flags=re.M),
    "filled values": lambda t: re.sub(r"P(-?)(\d+)$", lambda m: f"P{m[1]}{int(m[2]):04d}", t, flags=re.M),
    "number base 20000": lambda t: t.replace("N10", "N20"),
    "points first": points_first,
    "two containers": lambda t: t.replace("N10033", "%\n%\nN10033"),
    "comments": lambda t: t.replace("%\nN03620", "%\n(PITCH; X 2024)\nN03620").replace("P2\n%", "P2\n(END)\n%"),
    "no last line end": lambda t: t.rstrip("\n"),
    "all of it": lambda t: spaced(with_q_words(points_first(t))).replace("P50.0", "M50.000").replace("\n", ";\r\n"),
}


@pytest.mark.parametrize("name", CLONES)
def test_the_example_is_written_byte_for_byte_as_the_sample_that_was_punched(tmp_path, name):
    text = CLONES[name](SAMPLE)
    assert (text == SAMPLE) == (name == "as it is")
    path = tmp_path / "PUNCH.TXT"
    path.write_bytes(text.encode("ascii"))
    own, warnings = written(sample_machine(style_from=str(path)))
    assert own == text
    assert any(warning.startswith("The style was taken from the sample") for warning in warnings)
    chosen = CONTROL.read_settings(sample_machine(style_from=str(path)))
    back = CONTROL(sample_machine(), chosen).parse([SourceFile(path, own)])
    assert np.array_equal(back.blocks[0].curve, np.rint(CURVE_MM * 1e3))


def test_numbers_without_a_point_need_their_unit(tmp_path):
    path = tmp_path / "PUNCH.TXT"
    path.write_text(SAMPLE.replace("P50.0", "P50000"))
    with pytest.raises(InputError, match="interval_unit_mm"):
        CONTROL.read_settings(sample_machine(style_from=str(path)))
    own, _ = written(sample_machine(style_from=str(path), interval_unit_mm=0.001))
    assert own == path.read_text()


def test_what_the_user_states_stands_before_what_the_sample_shows(tmp_path):
    path = tmp_path / "PUNCH.TXT"
    path.write_text(with_q_words(SAMPLE))
    own, _ = written(sample_machine(style_from=str(path), q_word=False, eol="crlf"))
    assert own == SAMPLE.replace("\n", "\r\n")


def test_one_record_per_axis_is_followed_and_told_in_preflight(tmp_path, small_machine, small_errors):
    """The sample is of a control without tables, so that no points are kept."""
    path = tmp_path / "PUNCH.TXT"
    rows = [f"N0{n}A{a}P{v}" for n, v in ((3620, 0), (3621, 0), (3622, 0), (3623, 0), (3624, "0.0")) for a in (1, 2)]
    path.write_text("\n".join(["%", *rows, "N10005P1", "N10006P-1", "%", ""]))
    made = export(small_machine.with_setting("fanuc-pitch", "style_from", str(path)), small_errors, "fanuc-pitch")
    text = made.files["PITCH.TXT"]
    assert re.findall(r"(?m)^N03620.*$", text) == [m[0] for m in re.finditer(r"(?m)^N03620A[123]P\d+$", text)]
    assert text.count("N03620A") == 3
    assert "one record per axis" in made.preflight and "compensation point 0 is record N10000" in made.preflight
    assert made.violations == []


def test_what_a_sample_does_not_show_is_said():
    _, notes = style_of(SourceFile(Path("p"), "%\nN10041P2\n%\n"))
    assert any("no parameter 3624" in note and "NOT confirmed" in note for note in notes)
    _, notes = style_of(SourceFile(Path("p"), "%\nN03620A1P40\nN03624A1P50.0\n%\n"))
    assert any("no compensation point" in note and "NOT confirmed" in note for note in notes)


# --- points and parameters of the control ---------------------------------------------------------------------------

#: A control with five axes: X, Y, Z and a rotary axis A4 have points, A5 has none. Reference point of the machine: 0.
PARAMETERS = """%
N01001Q1L1P00000000L2P00000000
N03605Q1A1P00000010A2P00000010A3P00000010A4P00000010A5P00000000
N03620Q1A1P40A2P140A3P240A4P300A5P0
N03621Q1A1P32A2P131A3P231A4P301A5P0
N03622Q1A1P49A2P145A3P245A4P312A5P0
N03623Q1A1P10A2P10A3P8A4P1A5P0
N03624Q1A1P50.0A2P40.0A3P25.0A4P30.0A5P0.0
N03625Q1A1P0.0A2P0.0A3P0.0A4P360.0A5P0.0
N10900Q1P3
%
"""
POINTS = "\n".join(["%", *(f"N{10000 + k}Q0P{3 if k == 310 else -3 if k == 311 else 0}" for k in range(400)), "%", ""])


@pytest.fixture
def controls_files(tmp_path):
    """Parameters and pitch data as the control keeps them: in two files."""
    (tmp_path / "CNC-PARA.TXT").write_text(PARAMETERS)
    (tmp_path / "PITCH.TXT").write_text(POINTS)
    return [str(tmp_path / "CNC-PARA.TXT"), str(tmp_path / "PITCH.TXT")]


def controls_machine(files, **options):
    axes = tuple(Axis(r, np.linspace(*r, 5)) for r in ((-400.0, 450.0), (-400.0, 200.0), (-225.0, 125.0)))
    machine = Machine("m", Chain("WXYFZT"), axes)
    for key, value in {"style_from": files, "detection_unit_um": 0.1, **options}.items():
        machine = machine.with_setting("fanuc-pitch", key, value)
    return machine


def test_points_and_magnification_of_the_sample_are_kept(controls_files, make_errors):
    """3620 to 3624 are those of the sample, and no point of the rotary axis A4 (300 to 312) is written."""
    machine = controls_machine(controls_files)
    made = export(machine, make_errors(machine), "fanuc-pitch")
    assert made.violations == []
    rows = made.files["PITCHPRM.TXT"].split("\n")
    assert rows[1:6] == [
        "N03620Q1A1P40A2P140A3P240",
        "N03621Q1A1P32A2P131A3P231",
        "N03622Q1A1P49A2P145A3P245",
        "N03623Q1A1P10A2P10A3P8",
        "N03624Q1A1P50.0A2P40.0A3P25.0",
    ]
    written = [int(row[3:6]) for row in made.files["PITCH.TXT"].split("\n")[1:-2]]
    assert written == [*range(32, 50), *range(131, 146), *range(231, 246)]
    assert "Of other axes: nothing. Kept: A4: points 300 to 312." in made.preflight
    assert "3605" in made.preflight and "X 00000010, Y 00000010, Z 00000010" in made.preflight


def test_both_files_are_read_back_as_they_act(controls_files, make_errors, tmp_path):
    """One count of X is 10 x 0.1 um, of Z 8 x 0.1 um."""
    machine = controls_machine(controls_files)
    errors = make_errors(machine)
    made = export(machine, errors, "fanuc-pitch")
    paths = made.write(tmp_path / "out")
    tables = read_tables(machine, paths, "fanuc-pitch")
    found = tables.correction(machine, Points(np.array([[450.0, 200.0, 125.0], [0.0, 0.0, 0.0]])))
    sums = [sum(block.values[start:]) for block, start in zip(tables.tables.blocks, (9, 10, 10), strict=True)]
    np.testing.assert_allclose(found[0] * 1e3, np.array(sums) * [1.0, 1.0, 0.8], atol=1e-9)
    assert not found[1].any()
    backup = read_tables(machine, controls_files, "fanuc-pitch")
    assert backup.tables.others == ((4, 301, 312),)
    assert any("axis A4 (not X, Y or Z of the machine file)" in text for text in backup.remarks)
    assert backup.remarks[0].startswith("unit: the machine is metric (1001#0, INM)")
    assert backup.remarks[-1] == "skipped: 1 record that cannot change a pitch table"


def test_new_points_avoid_those_of_every_axis_of_the_sample(controls_files, make_errors):
    """The user wants other sections of X: they may not meet those of Y, Z and A4, and not their own old ones."""
    machine = controls_machine(controls_files, interval_mm={"X": 5.0})
    made = export(machine, make_errors(machine), "fanuc-pitch")
    numbers = [int(row[1:6]) - 10000 for row in made.files["PITCH.TXT"].split("\n")[1:-2]]
    assert numbers == [*range(131, 146), *range(231, 246), *range(313, 313 + 170)]
    assert "3620 = 392 (sample: 40)" in made.preflight


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"first_numbers": {"Z": 290}}, "A4 uses the compensation points 300 to 312; the points 290 to .* of Z"),
        ({"first_numbers": {"X": 120}, "interval_mm": {"X": 50.0}}, "axis A2 uses the compensation points 131 to 145"),
    ],
)
def test_points_that_meet_those_of_another_axis_are_refused(controls_files, make_errors, options, words):
    machine = controls_machine(controls_files, **options)
    with pytest.raises(InputError, match=words) as caught:
        export(machine, make_errors(machine), "fanuc-pitch")
    assert (caught.value.file.name, caught.value.line) == ("CNC-PARA.TXT", 5)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("N03605Q1A1P00000010", "N03605Q1A1P00000011", "a table for each direction of travel"),
        ("N01001Q1L1P00000000", "N01001Q1L1P00000001", "an inch machine"),
        ("N03605Q1A1", "N03602Q1P00000001\nN03605Q1A1", "of this control are total values"),
        ("A4P301A5P0\n", "A4P242A5P0\n", "axis A4 uses the compensation points 242 to 312"),
        ("N03620Q1A1P40", "N03620Q1A1P55", "cannot be kept"),
    ],
)
def test_a_control_that_the_files_would_not_suit_is_refused(controls_files, make_errors, before, after, words):
    path = Path(controls_files[0])
    assert before in PARAMETERS
    path.write_text(PARAMETERS.replace(before, after))
    machine = controls_machine(controls_files)
    with pytest.raises(InputError, match=words):
        export(machine, make_errors(machine), "fanuc-pitch")


@pytest.mark.parametrize("number", [3620, 3621, 3622])
def test_an_axis_whose_points_are_not_known_is_refused(controls_files, make_errors, number):
    """Without its 3621 the rotary axis A4 would seem to have no points, and lose those that it has."""
    path = Path(controls_files[0])
    path.write_text(re.sub(rf"(N0{number}.*)A4P\d+", r"\1", PARAMETERS))
    machine = controls_machine(controls_files)
    with pytest.raises(InputError, match=f"axis A4 has a value here, but none for {number}") as caught:
        export(machine, make_errors(machine), "fanuc-pitch")
    assert caught.value.line
    path.write_text("\n".join(row for row in PARAMETERS.split("\n") if f"N0{number}" not in row))
    with pytest.raises(InputError, match="could be overwritten. Punch all parameters"):
        export(machine, make_errors(machine), "fanuc-pitch")


def test_points_of_an_axis_without_an_interval_are_kept(controls_files, make_errors):
    Path(controls_files[0]).write_text(re.sub(r"(N03624.*)A4P[\d.]+", r"\1", PARAMETERS))
    machine = controls_machine(controls_files)
    assert "Kept: A4: points 300 to 312." in export(machine, make_errors(machine), "fanuc-pitch").preflight


def test_comments_of_the_sample_may_be_in_any_language(controls_files, make_errors):
    path = Path(controls_files[0])
    for comment in (
        "(GEPR\u00dcFT)".encode("latin-1"),
        "(\u041f\u0420\u041e\u0412\u0415\u0420\u0415\u041d\u041e)".encode(),
    ):
        path.write_bytes(PARAMETERS.encode().replace(b"%\n", b"%\n" + comment + b"\n", 1))
        machine = controls_machine(controls_files)
        assert export(machine, make_errors(machine), "fanuc-pitch").violations == []
    path.write_bytes(PARAMETERS.encode().replace(b"A4P301", b"A4P\xa0301"))
    with pytest.raises(InputError, match="not ASCII"):
        export(machine, make_errors(machine), "fanuc-pitch")


def test_reading_asks_where_the_file_has_a_table_of_each_direction(controls_files):
    Path(controls_files[0]).write_text(PARAMETERS.replace("N03605Q1A1P00000010", "N03605Q1A1P00000011"))
    machine = controls_machine(controls_files)
    machine.controllers["fanuc-pitch"].data.pop("style_from")
    with pytest.raises(InputError, match="set bidirectional = true"):
        read_tables(machine, controls_files, "fanuc-pitch")


def test_without_files_of_the_control_preflight_says_that_other_axes_are_not_known(small_machine, small_errors):
    made = export(small_machine, small_errors, "fanuc-pitch")
    first = made.preflight.split("## What the files overwrite")[1].strip().split("\n")[0]
    assert first.startswith("- Of other axes: NOT KNOWN") and "PITCHPRM.TXT" not in made.files
    assert "metric only: on an inch machine" in made.preflight


def test_what_is_active_comes_back_where_nothing_is_left_to_correct(tmp_path):
    """Backup -> active tables -> merged with errors of zero: the same points, parameters and values."""
    shape = [2, 1, -1, 0, 3, -2, 0, 1]  # ends where it began, so that nothing is lost with the frame
    tables = {start + k: value for start in (32, 131, 231) for k, value in enumerate(shape)}
    rows = [f"N{10000 + k}Q0P{tables.get(k, 0)}" for k in range(400)]
    (tmp_path / "PITCH.TXT").write_text("\n".join(["%", *rows, "%", ""]))
    numbers = [
        "N03620Q1A1P36A2P135A3P235A4P300",
        "N03621Q1A1P32A2P131A3P231A4P301",
        "N03622Q1A1P39A2P138A3P238A4P312",
        "N03623Q1A1P10A2P10A3P10A4P1",
        "N03624Q1A1P50.0A2P50.0A3P50.0A4P30.0",
    ]
    (tmp_path / "CNC-PARA.TXT").write_text("\n".join(["%", "N00020Q1P17", *numbers, "N05711Q1L1P0L2P0", "%", ""]))
    travels = "\n".join(f"[axes.{n}]\nrange_mm = [-250.0, 150.0]\nnodes = 5" for n in "XYZ")
    (tmp_path / "m.toml").write_text(
        f'name = "m"\nchain = "WXYFZT"\n{travels}\n[controllers.fanuc-pitch]\ndetection_unit_um = 0.1\n'
    )
    zeros = [f"{name},{position},0.0," for name in ("EXX", "EYY", "EZZ") for position in (-250.0, 150.0)]
    (tmp_path / "zero.errors.csv").write_text("\n".join(["error,position_mm,value,u_value", *zeros, ""]))
    files = [tmp_path / "PITCH.TXT", tmp_path / "CNC-PARA.TXT"]
    words = ["merge", tmp_path / "m.toml", *files, "--style-from", files[0], "--style-from", files[1]]
    words += ["--controller", "fanuc-pitch", "--errors", tmp_path / "zero.errors.csv", "--out", tmp_path / "out"]
    assert run_command(cli, [str(word) for word in words]) == 0
    written = (tmp_path / "out" / "PITCH.TXT").read_text().split()[1:-1]
    assert written == [f"N{10000 + number}Q0P{value}" for number, value in tables.items()]
    own = [row.split("A4")[0] for row in numbers]
    assert (tmp_path / "out" / "PITCHPRM.TXT").read_text().split()[1:-1] == own


def test_points_alone_do_not_say_which_axis_has_them(controls_files, make_errors):
    machine = controls_machine(controls_files[1:])
    made = export(machine, make_errors(machine), "fanuc-pitch")
    assert "Of other axes: NOT KNOWN, the sample has no parameters 3620 to 3622" in made.preflight
    with pytest.raises(InputError, match="second time; give each file once"):
        CONTROL.read_settings(controls_machine([*controls_files, controls_files[1]]))


def test_total_values_are_read_only_where_they_are_stated(controls_files):
    Path(controls_files[0]).write_text(PARAMETERS.replace("N03605Q1A1", "N03602Q1P00000001\nN03605Q1A1", 1))
    machine = controls_machine(controls_files, value_type="total")
    machine.controllers["fanuc-pitch"].data.pop("style_from")
    assert read_tables(machine, controls_files, "fanuc-pitch").tables.blocks[0].total
    machine.controllers["fanuc-pitch"].data["value_type"] = "incremental"
    with pytest.raises(InputError, match="total values; set value_type"):
        read_tables(machine, controls_files, "fanuc-pitch")


def test_blanks_that_fill_up_a_record_are_followed(tmp_path):
    text = SAMPLE.replace("N10036P-2", "N10036P-2 ")
    text = "\n".join(row if len(row) % 2 == 0 or row == "%" else row.rstrip() + " " for row in text.split("\n"))
    path = tmp_path / "PUNCH.TXT"
    path.write_text(text)
    assert written(sample_machine(style_from=str(path)))[0] == text


MALFORMED = [
    (lambda t: "", "contains no '%'", None),
    (lambda t: "%\n%\n", "contains no record", 1),
    (lambda t: t.replace("N10036P-2", "O1234"), "is not a block", 10),
    (lambda t: t.replace("N10036P-2", "N10036P-2,5"), "is not allowed in a block", 10),
    (lambda t: t.replace("N10036P-2", "N10036P-2E1"), "single value word", 10),
    (lambda t: t.replace("N10036P-2", "N10036P-2.5"), "whole number", 10),
    (lambda t: t.replace("N10036P-2", "N10036Q0P-2"), "some records have a type word", 10),
    (lambda t: t.replace("N10036P-2", "N10036 P-2"), "white space", 10),
    (lambda t: t.replace("N10036", "N010036"), "digits", None),
    (lambda t: t.replace("N03624A1P50.0", "N03624A1I2.0"), "inch", 6),
    (lambda t: t.replace("N03624A1P50.0", "N03624A1P50.0A2P50"), "some lengths", 6),
    (lambda t: t.replace("P2\n", "P2\r\n", 1), "does not end with", None),
    (lambda t: t[: t.rindex("%")], "last '%' is missing", None),
    (lambda t: t.replace("N03620A1P40", "N03620"), "no value", 2),
]


@pytest.mark.parametrize(("damage", "words", "line"), MALFORMED)
def test_a_sample_that_is_not_understood_is_refused_with_its_line(tmp_path, damage, words, line):
    path = tmp_path / "PUNCH.TXT"
    text = damage(SAMPLE)
    assert text != SAMPLE
    path.write_bytes(text.encode())
    with pytest.raises(InputError, match=words) as caught:
        CONTROL.read_settings(sample_machine(style_from=str(path)))
    assert caught.value.file == path
    assert caught.value.line == line or line is None


def test_bytes_that_are_no_ascii_and_files_that_are_not_there_are_refused(tmp_path):
    path = tmp_path / "PUNCH.TXT"
    path.write_bytes(b"%\nN03620A1P40\n\xff\xfe\n%\n")
    with pytest.raises(InputError, match="not ASCII") as caught:
        CONTROL.read_settings(sample_machine(style_from=str(path)))
    assert caught.value.line == 3
    with pytest.raises(InputError, match="no such file"):
        CONTROL.read_settings(sample_machine(style_from=str(tmp_path / "none.txt")))


def test_a_huge_sample_is_refused_at_a_cost_that_grows_with_it(tmp_path):
    path = tmp_path / "PUNCH.TXT"

    def read(text):
        path.write_text(text)
        with pytest.raises(InputError):
            CONTROL.read_settings(sample_machine(style_from=str(path)))

    assert grows_with_its_file(read, "N1P1\n", "%\n")
    read("%\n" + "N1P1\n" * 2_000_000)


@given(st.lists(st.one_of(st.sampled_from([*SAMPLE.split(), "%", "(x)", "N1", "N03620P1A1"]), st.text(max_size=8))))
@settings(max_examples=150, deadline=None)
def test_any_sample_is_understood_or_refused_but_never_crashes(lines):
    try:
        style, notes = style_of(SourceFile(Path("p"), "\n".join(["%", *lines, "%"])))
    except InputError as error:
        assert str(error).isprintable()
    else:
        assert notes and style.whole(-2).startswith("-")


@given(st.integers(-99999, 99999), st.booleans(), st.booleans(), st.integers(0, 6))
@settings(max_examples=60, deadline=None)
def test_whole_numbers_mean_the_same_in_every_style(value, point, plus, zeros):
    text = FanucStyle(whole_point=point, plus=plus, zeros=zeros).whole(value)
    assert Decimal(text) == value
