"""What is read is read twice: a follower that shares nothing with the reader finds the same moves, and judges what is written."""

import re
import time

import pytest
from programs.make import G_CODE, OFFSETS_MM, TOOLS_MM, mill, mixed_program, random_holes
from programs.test_correct import run, shift
from programs.test_dialects import cycle_errors

from compgen.errors import InputError
from compgen.programs import Reader, Setup, model_of, predict_part
from compgen.programs.correct import ProgramWriter
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import Follower, difference, read_twice

ZERO = (0.0, 0.0, 0.0)
#: The shop of the reports: Z of G55 is 10 mm higher, tools 2 and 3 have other lengths.
SHOP = Setup(
    {"G54": (-500.0, -400.0, -330.0), "G55": (-480.0, -390.0, -320.0), "PRESET": (-500.0, -400.0, -330.0)},
    {"1": (0.0, 0.0, 80.0), "2": (0.0, 0.0, 55.5), "3": (0.0, 0.0, 121.234), "1D2": (0.0, 0.0, 81.0)},
)


def moves_of(text, dialect, setup=SHOP):
    """All moves of a program, by the reader; the follower has to agree."""
    read = Reader(mill(), DIALECTS[dialect], setup, "p").batch(text.encode(), 1).moves
    followed = Follower(dialect, setup, mill()).follow(text, range(1, text.count("\n") + 2))
    assert difference(read, followed) is None
    return read


def heights(moves, line):
    """Z of the machine where feed ends in a line, without what goes up."""
    return moves.end_mm[(moves.line == line) & moves.cutting & (moves.end_mm[:, 2] < moves.start_mm[:, 2]), 2].tolist()


# Shifts, offsets and lengths within a series of holes, in every dialect: depths by hand. The zero of Z is at -330 + 80 = -250.

START = {
    "fanuc": "G21 G90 G17 G54\nG43 H1\nG0 X0. Y0. Z50.\nF100\n",
    "linuxcnc": "G21 G90 G17 G54\nT1 M6 G43\nG0 X0. Y0. Z50.\nF100\n",
    "siemens": "G71 G90 G17 G54\nT1 M6 D1\nG0 X0 Y0 Z50\nF100\n",
    "heidenhain-iso": "%P G71 *\nT1 G17 S900*\nG00 G90 X+0 Y+0 Z+50*\n;*\n",
}
DRILL = {"fanuc": "G81 X10. Y10. Z20. R40.\n", "linuxcnc": "G81 X10. Y10. Z20. R40.\n"}
MCALL = "MCALL CYCLE81(50,38,2,20)\nX10 Y10\n"
G200 = "G200 Q200=2 Q201=-18 Q203=+38 Q204=12*\nX+10 Y+10 M89*\n"
SHIFTS = [
    *[
        (dialect, f"G99 {DRILL[dialect]}{change}\nX30. Y10.\nG80\nM30\n", depth)
        for dialect in ("fanuc", "linuxcnc")
        for change, depth in (
            ("G52 X50. Z5.", -225.0),
            ("G92 Z45.", -235.0),  # Z is 40 there: the zero is 5 lower
            ("G55", -220.0),
            ("G43 H3", -188.766),
            ("G43 H3 G55", -178.766),
            ("G49", -310.0),
            ("G52 Z5.\nG52 Z0.", -230.0),
            ("G92 Z45.\nG92.1", -230.0),
            ("G92 Z45.\nG55", -225.0),
        )
    ],
    ("linuxcnc", f"G98 {DRILL['linuxcnc']}G43.1 Z90.\nX30. Y10.\nG80\nM30\n", -220.0),
    ("linuxcnc", f"G98 {DRILL['linuxcnc']}G52 Z5.\nG92.2\nX30. Y10.\nG80\nM30\n", -230.0),
    ("fanuc", f"G98 {DRILL['fanuc']}G54.1 P1\nX30. Y10.\nG80\nM30\n", -229.0),
    ("fanuc", f"G98 {DRILL['fanuc']}H2\nX30. Y10.\nG80\nM30\n", -254.5),
    ("siemens", f"{MCALL}TRANS X50 Z5\nX30 Y10\nMCALL\nM30\n", -225.0),
    ("siemens", f"{MCALL}TRANS Z5\nATRANS Z2\nX30 Y10\nMCALL\nM30\n", -223.0),
    ("siemens", f"{MCALL}G55\nX30 Y10\nMCALL\nM30\n", -220.0),
    ("siemens", f"{MCALL}D2\nX30 Y10\nMCALL\nM30\n", -229.0),
    ("siemens", f"{MCALL}T2 M6 D1\nX30 Y10\nMCALL\nM30\n", -254.5),
    ("siemens", f"{MCALL}TRANS X5 Z5\nTRANS\nX30 Y10\nMCALL\nM30\n", -230.0),
    (
        "siemens",
        'MCALL CYCLE81(50,38,2,20)\nX10 Y10\nTRANS Z5 ; MCALL ; M30\nMSG("MCALL ; Z9")\nX30 Y10\nM30\n',
        -225.0,
    ),
    ("heidenhain-iso", f"{G200}G54 X+50 Z+5*\nX+30 Y+10 M99*\nM2*\n", -225.0),
    ("heidenhain-iso", f"{G200}G54 Z+5*\nG54 G91 Z+2*\nG90 X+30 Y+10*\nM2*\n", -223.0),
    ("heidenhain-iso", f"{G200}T3 G17 S900*\nX+30 Y+10*\nM2*\n", -188.766),
    ("heidenhain-iso", f"{G200}T1 G17 DL+0.5*\nX+30 Y+10 M99 ; M30*\nM2*\n", -229.5),
]
FURTHER = Setup({**SHOP.work_offsets_mm, "G54.1P1": (-500.0, -400.0, -329.0)}, SHOP.tools_mm)


@pytest.mark.parametrize(("dialect", "text", "depth"), SHIFTS)
def test_a_hole_is_as_deep_as_the_offset_in_force_says(tmp_path, dialect, text, depth):
    """The numbers of a cycle stay; their zero moves. The correction is by the errors at that depth."""
    text = START[dialect] + text
    moves = moves_of(text, dialect, FURTHER)
    lines = sorted({int(line) for line in moves.line[moves.cutting]})
    assert heights(moves, lines[0]) == pytest.approx([-230.0], abs=1e-9)
    assert heights(moves, lines[-1]) == pytest.approx([depth], abs=1e-9)
    result, corrected = run(tmp_path, text, cycle_errors(1e-3, 1e-4), dialect, FURTHER)
    assert result.accepted, result.reasons
    assert result.after.ends_mm < 1.5e-3 < 0.1 < result.before.ends_mm
    assert not result.notes  # what is not corrected would be said
    # EZZ is 1 um/mm: the machine is 0.23 mm too low at the first hole, at the second as its depth says
    first, second = text.splitlines()[:2]
    again = moves_of(f"{first}\n{corrected[corrected.index(second) :]}", dialect, FURTHER)
    lines = sorted({int(line) for line in again.line[again.cutting]})
    assert heights(again, lines[0])[0] == pytest.approx(-230.0 / 1.001, abs=2e-3)
    assert heights(again, lines[-1])[0] == pytest.approx(depth / 1.001, abs=2e-3)


def test_the_level_of_g98_after_a_shift(tmp_path):
    """LinuxCNC returns to the number that Z had; of FANUC no document says where to, so that Z has to be given again."""
    text = f"G98 {DRILL['fanuc']}G52 Z5.\nX30. Y10.\nG80\n{{}}M30\n"
    moves = moves_of(START["linuxcnc"] + text.format("G1 X40. F9\n"), "linuxcnc")
    assert moves.end_mm[-1, 2] == -195.0  # 50 above -245
    with pytest.raises(InputError, match="position of Z is not known"):
        moves_of(START["fanuc"] + text.format("G1 X40. F9\n"), "fanuc")
    moves = moves_of(START["fanuc"] + text.format("G0 Z50.\nG1 X40. F9\n"), "fanuc")
    assert moves.end_mm[-1, 2] == -195.0
    # a shift in X alone leaves the level
    moves = moves_of(START["fanuc"] + text.replace("Z5.", "X5.").format("G1 X40. F9\n"), "fanuc")
    assert moves.end_mm[-1, 2] == -200.0
    with pytest.raises(InputError, match="not known"):
        moves_of(START["fanuc"] + text.replace("X30.", "G91 X30. Z-20. R-10.").format("G90\n"), "fanuc")


def test_the_program_of_the_report(tmp_path):
    """`Z15.04664 R35.04016` stood there: 5 mm too deep. All Z and R are those of the program, but for the errors."""
    for dialect in ("fanuc", "linuxcnc"):
        text = START[dialect] + "G99 G81 X10. Y10. Z20. R40. F100\nG52 X50. Z5.\nX10. Y10.\nX30.\nG80\nM30\n"
        result, corrected = run(tmp_path, text, cycle_errors(1e-4, 1e-4, 1e-4), dialect, SHOP)
        assert result.accepted
        body = corrected[corrected.index("G81") :]
        assert all(abs(float(z) - 20.0) < 0.1 for z in re.findall(r"Z([\d.]+)", body.replace("Z5.", "")))
        assert all(abs(float(r) - 40.0) < 0.1 for r in re.findall(r"R([\d.]+)", body))


@pytest.mark.parametrize(
    ("dialect", "block", "words"),
    [
        ("fanuc", "G20\nX1.", "unit changes"),
        ("linuxcnc", "G20\nX1.", "unit changes"),
        ("fanuc", "G80\nG81 X20.", "without Z or R"),
        ("fanuc", "G0 X1.\nG82 X20. R40.", "without Z or R"),
        ("linuxcnc", "G92.1 X5.", "divide the block"),
        ("fanuc", "G92 X5. Z5.\nG92.1 X0.", "name X, Y and Z"),
        ("fanuc", "G10 L2 P1 Z5.", "writes offsets"),
        ("linuxcnc", "G10 L2 P1 Z5.", "writes offsets"),
        ("linuxcnc", "M61 Q3\nG43", "tool in the spindle is not known"),
        ("linuxcnc", "G43 H0", "another length"),
        ("linuxcnc", "X5. H2", "without G43"),
        ("linuxcnc", "G91 X5. R-10. Z-2. R-3.", "R is given twice"),
        ("linuxcnc", "G91\nG55 X5. R-10. Z-2.", "divide the block"),
        ("fanuc", "G91\nG43 H2 X5. R-10. Z-2.", "divide the block"),
        ("fanuc", "G91 X5. R-10. Z-2. H2", "divide the block"),
    ],
)
def test_changes_that_are_refused_within_a_cycle(dialect, block, words):
    with pytest.raises(InputError, match=words):
        moves_of(f"{START[dialect]}G99 {DRILL[dialect]}{block}\nG80\nM30\n", dialect)


def test_a_unit_that_changes_after_a_cycle_was_defined_is_refused():
    with pytest.raises(InputError, match="define it again"):
        moves_of(f"{START['siemens']}{MCALL}G70\nX1\nMCALL\nM30\n", "siemens")


@pytest.mark.parametrize(
    ("dialect", "home"),
    [
        ("fanuc", "G91 G28 Z0."),
        ("fanuc", "G53 G0 Z0.\nG91"),
        ("linuxcnc", "G53 G0 Z0.\nG91"),
        ("grbl", "G53 G0 Z0.\nG91"),
        ("siemens", "SUPA G0 Z0\nG91"),
        ("heidenhain-iso", "G00 Z+0 M91*\nG91*"),
    ],
)
def test_axes_that_stay_while_another_goes_to_a_place_of_the_machine_stay_corrected(tmp_path, dialect, home):
    """X is written 10 um less and stays so while Z goes to machine zero: an increment after that is no longer by 10 um."""
    mark = "*" if dialect == "heidenhain-iso" else ""
    start = {"siemens": "G71 G90 G17 G54", "heidenhain-iso": "%P G71 *\nG90 G17*"}.get(dialect, "G21 G90 G17 G54")
    text = f"{start}\nG0 X5. Y5. Z5.{mark}\n{home}\nG0 X5.{mark}\nG90 Z5.{mark}\nG1 X50. F9{mark}\nM30{mark}\n"
    result, corrected = run(tmp_path, text, shift(x=10.0, y=20.0), dialect, SHOP)
    assert result.accepted, result.reasons
    assert re.findall(r"G0 X[+]?([\d.]+)", corrected) == ["4.99", "5."]


def test_an_axis_that_no_block_has_named_since_is_said(tmp_path):
    """After G55 only X is named: Y stays where it is, uncorrected there, and that is said with the line."""
    text = START["fanuc"] + f"G99 {DRILL['fanuc']}G55\nX30.\nX40.\nG80\nM30\n"
    result, _ = run(tmp_path, text, shift(x=10.0, y=20.0), "fanuc", SHOP)
    (note,) = result.notes
    assert note.startswith("line 7: Y is not corrected in 2 moves at feed")


# Where the two readings differ, or what was written does, nothing is accepted.


@pytest.mark.parametrize("dialect", G_CODE)
def test_the_two_readings_agree_on_mixed_programs(tmp_path, dialect, monkeypatch):
    setup = Setup({**OFFSETS_MM, "PRESET": (1.5, 2.5, -60.0)}, TOOLS_MM)
    text, found = mixed_program(7, dialect, 900), []
    for least in (1, 8, 10**9):
        monkeypatch.setattr("compgen.programs.follower._LEAST_RUN", least)
        program = tmp_path / "p.nc"
        program.write_text(text)
        reader = Reader(mill(), DIALECTS[dialect], setup, program)
        assert sum(len(batch.moves) for batch in read_twice(reader)) > 500
        found.append(Follower(dialect, setup, mill()).follow(text, range(1, 2000)))
    for other in found[1:]:
        assert difference(found[0], other) is None


@pytest.mark.parametrize(
    ("where", "wrong"),
    [
        ("_offset", lambda reader: tuple(map(sum, zip(reader.work, reader.shift, reader.length, strict=True)))),
        ("_initial_level", lambda reader, zero: reader.initial_z),
        ("_repeats", lambda reader, values: 1.0),
    ],
)
def test_a_reader_that_is_wrong_is_found_out(tmp_path, monkeypatch, where, wrong):
    """Faults are put into the reader; the follower of the file does not share them, in `correct` and in `part`."""
    program = tmp_path / "p.ngc"
    program.write_text(random_holes(3))
    setup, model = Setup(OFFSETS_MM, TOOLS_MM), model_of(mill(), shift(slope=0.1), None)
    predict_part(model, program, "linuxcnc", setup)
    monkeypatch.setattr(Reader, where, wrong)
    for read in (
        lambda: predict_part(model, program, "linuxcnc", setup),
        lambda: run(tmp_path, program.read_text(), shift(slope=0.1), "linuxcnc", setup),
    ):
        with pytest.raises(InputError, match="read in two ways") as caught:
            read()
        assert caught.value.line


#: Holes in mm.
METRIC = 4


@pytest.mark.parametrize(
    ("letter", "by_mm", "words"),
    [
        ("Z", 0.05, "away from what is right"),
        ("R", 1.0, "away from the program"),
        ("X", 0.008, "away from what is right"),
    ],
)
def test_a_writer_that_is_wrong_is_not_accepted(tmp_path, monkeypatch, letter, by_mm, words):
    """A number of a hole is written wrong: the place that it leads to is held against what was meant."""
    cycle = ProgramWriter._cycle

    def wrong(self, *args):
        return re.sub(
            rf"{letter}(-?[\d.]+)", lambda found: f"{letter}{float(found[1]) - by_mm:.5f}", cycle(self, *args)
        )

    monkeypatch.setattr(ProgramWriter, "_cycle", wrong)
    result, _ = run(tmp_path, random_holes(METRIC), shift(slope=0.3), "linuxcnc", Setup(OFFSETS_MM, TOOLS_MM))
    assert not result.accepted
    assert any(words in reason for reason in result.reasons), result.reasons
    assert result.file.startswith("NOT-ACCEPTED-")


@pytest.mark.parametrize("end", ["", "\n"])
@pytest.mark.parametrize(
    ("arc", "words"),
    [
        ("G2 X60. Y30.", "without centre or radius"),
        ("G3 X60.", "without centre or radius"),
        ("G2 X60. Y30. I0. J0.", "expected one radius"),
        ("G2 X50. Y20. R5.", "give no arc"),
        ("G2 X60. Y30. R0.", "give no arc"),
    ],
)
@pytest.mark.parametrize("dialect", ["grbl", "linuxcnc", "fanuc"])
def test_an_arc_about_nowhere_is_refused_also_as_the_last_line(tmp_path, dialect, arc, words, end):
    """The follower is ahead of the reader by a last line without an end: it divided by zero, exit code 3."""
    program = tmp_path / "p.nc"
    program.write_text(f"G21 G90 G54\nG0 Z50.\nG0 X10. Y10.\nG1 X50. Y20. F500.\n{arc}{end}")
    with pytest.raises(InputError, match=words) as found:
        predict_part(model_of(mill(), cycle_errors(), None), program, dialect, SHOP)
    assert found.value.line == 5


@pytest.mark.parametrize(
    ("turns", "refused"), [("3", False), ("1001", False), ("1002", True), ("1000000", True), ("1e30", True)]
)
def test_an_arc_of_a_million_turns_is_refused(tmp_path, turns, refused):
    """P1000000 of LinuxCNC (TURN of SINUMERIK): the corrected program would have had hundreds of millions of blocks."""
    turns = f"{float(turns):.0f}"
    program = tmp_path / "p.nc"
    program.write_text(f"G21 G90 G54 G17\nG0 X10 Y10 Z50\nG1 X50 Y20 F500\nG2 X50 Y20 I5 J0 P{turns}\nM2\n")
    reader = Reader(mill(), DIALECTS["linuxcnc"], SHOP, str(program))
    if refused:
        with pytest.raises(InputError, match="whole number of turns, at most 1000"):
            reader.batch(program.read_bytes(), 1)
    else:
        assert len(reader.batch(program.read_bytes(), 1).moves)


def test_lines_that_are_made_to_last_take_a_time_that_grows_with_them():
    """Blanks, digits, signs and open brackets: twice as many take about twice as long, not four times."""
    for dialect in DIALECTS:
        for part in (
            "G" + " " * 40,
            "X1" * 40,
            "X" + "1" * 40,
            "A(" * 20,
            "((" * 20,
            '"' * 40,
            "[" * 40,
            "AB " * 20,
            "- " * 20,
        ):
            times = []
            for count in (100, 400):
                text = part * count + "nan\n"
                begin = time.process_time()
                for _ in range(3):
                    Follower(dialect, SHOP, mill()).follow(text, range(1, 3))
                times.append(time.process_time() - begin)
            assert times[1] < 10.0 * times[0] + 0.05, (dialect, part[:9], times)
