"""What a program needs of its machine: tool tables, travel, reference point, units, and the block that checks the set-up."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from programs import test_rs274 as rs274
from programs.make import G_CODE, mill
from programs.test_correct import PLAIN, moves_of, run, shift

from compgen.controls import CONTROLLERS
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import read_machine
from compgen.errors import InputError
from compgen.programs import Reader, Setup, read_tools
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import read_twice
from compgen.programs.path import Moves, points_of
from machines import machine_of


@pytest.mark.parametrize(
    ("text", "message", "line"),
    [
        ("T1 P1 Z50\nT2 P2 Z11x\n", "'Z11X' is not understood", 2),  # it was read as a tool of length 0
        ("T1 P1 Z50\nT2 P2 Z=11\n", "'Z=11' is not understood", 2),
        ("T1 P1 Z50\n\nP2 Z5\n", "the number of a tool", 3),
        ("T1 P1 Z50\nT1 P2 Z51\n", "tool 1 appears twice", 2),
        ("T1 P1 Z50 Z51\n", "'Z51' is not understood", 1),
        (f"T1 P1 Z{'1' * 5000}\n", "is not understood", 1),
        (f"T{'1' * 5000} P1 Z1\n", "expected", 1),
        ("tool,length_mm\n\u00b2,50\n1,x\n", "length_mm", 3),
        (f"tool,length_mm\n{'1' * 5000},50\n", "at most 80", 2),
        ("tool,length_mm\n1,inf\n", "length_mm", 2),
    ],
)
def test_tool_tables_that_are_refused(tmp_path, text, message, line):
    path = tmp_path / "tools"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_tools(path)
    assert caught.value.line == line


def test_a_tool_table_of_linuxcnc_is_in_units_of_its_machine(tmp_path):
    path = tmp_path / "tool.tbl"
    path.write_text("; mill\nP1 T1 X0.1 Z+2.0 D0.25 Q1 ;a (b\n")
    assert read_tools(path, 25.4) == {"1": (pytest.approx(2.54), 0.0, pytest.approx(50.8))}


# --- reference point and travel ----------------------------------------------------------------------------------------

NEAR = Setup({"G54": (0.0, 0.0, 300.0), "PRESET": (0.0, 0.0, 300.0)}, {"1": (0.0, 0.0, 0.0)})


def high_mill(**more):
    """A machine whose Z counts from the table: 100 to 500 mm, and whose reference point is at the top."""
    return machine_of([(-600.0, 600.0), (-500.0, 500.0), (100.0, 500.0)], 9, **more)


def positions(text, dialect="fanuc", machine=None, setup=NEAR):
    return moves_of(text, dialect, setup, machine or high_mill()).end_mm.tolist()


HOME = (
    "G21 G90 G17 G54\nG0 X10. Y0. Z50.\nG91 G28 Z0.\nG90 G0 X20. Y5.\nG43 H1 Z40.\nG1 Z10. F100\nX60.\nG91 G28 Z0.\n"
    "G28 X0. Y0.\nM30\n"
)


@pytest.mark.parametrize("dialect", ["fanuc", "linuxcnc", "grbl"])
@pytest.mark.parametrize("code", ["G28", "G30"])
def test_a_program_goes_to_a_reference_point_that_is_not_machine_zero(tmp_path, dialect, code):
    text = HOME.replace("G28", code)
    text = text.replace("G43 H1", "G43.1 Z0.\nG0") if dialect == "grbl" else text
    result, corrected = run(tmp_path, text, shift(x=10.0), dialect, NEAR, high_mill())
    assert result.accepted and "X59.99" in corrected
    lost = [text for text in result.assumed if "it does not matter where G28 leads Z: machine zero" in text]
    assert len(lost) == (code == "G28")
    stated, same = run(tmp_path, text, shift(x=10.0), dialect, NEAR, high_mill(reference_position_mm=(0.0, 0.0, 500.0)))
    assert (stated.accepted, same.partition("POSITION")[2]) == (True, corrected.partition("POSITION")[2])
    assert not any("G28" in text for text in stated.assumed)


def test_the_reference_point_is_where_increments_begin():
    """From Z 500 down by 60 and by 90 mm: 350 mm of the machine, wherever the work offset is."""
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG91 G28 Z0.\nZ-60.\nG1 Z-90. F100\nM30\n"
    machine = high_mill(reference_position_mm=(None, None, 500.0))
    assert [z for _, _, z in positions(text, machine=machine)][-3:] == [500.0, 440.0, 350.0]
    with pytest.raises(InputError, match="increment from a position that is not known") as caught:
        positions(text)
    assert caught.value.line == 4
    stored = text.replace("G91 G28", "G0 Z100.\nG28.1\nG0 Z0.\nG91 G28")
    assert positions(stored, "linuxcnc", machine)[-1][2] == 250.0  # what G28.1 stores is where G28 leads then


def test_a_cut_from_the_reference_point_needs_to_know_it():
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG91 G28 Z0.\nG90 G1 X5. F100\nM30\n"
    with pytest.raises(InputError, match="at feed while the position of Z is not known"):
        positions(text)
    assert positions(text, machine=high_mill(reference_position_mm=(0.0, 0.0, 480.0)))[-1] == [5.0, 0.0, 480.0]


def test_moves_in_machine_coordinates_stay_and_what_they_ask_is_said(tmp_path):
    """G53 Z0 on a machine whose Z begins at 100 mm: the block stays, and the next cut is from where the program has placed Z."""
    text = "G21 G90 G17 G54\nG0 X10. Y0. Z50.\nG53 G0 Z0.\nG0 X20.\nZ40.\nG1 X60. F100\nM30\n"
    result, corrected = run(tmp_path, text, shift(x=10.0), "fanuc", NEAR, high_mill())
    assert result.accepted and "G53 G0 Z0.\nG0 X19.99\nZ40.\nG1 X59.99 F100" in corrected
    said = "Z can go to 0 mm of the machine, outside its travel 100 to 500 mm, as the move in machine coordinates asks"
    assert result.assumed == (said,)


@pytest.mark.parametrize(
    ("blocks", "leaves"),
    [
        ("G3 X580. Y10. R20. F100", False),
        ("G3 X570. Y50. I0. J30. F100", False),  # as far as X 600
        ("G3 X570. Y50. R-30.5 F100", True),
        ("G3 X570. Y-9.9 R-31. F100", True),  # nearly a full circle
        ("G2 X570. Y-9.9 R-31. F100", False),  # to the other side
        ("G18 G2 X570. Z40. R-31. F100", True),
        ("G18 G3 X570. Z40. R-31. F100", False),
        ("G3 I-10. F100", False),
        ("G3 I21. F100", True),
        ("G3 I21. Z9. F100", True),
    ],
)
def test_an_arc_may_leave_the_travel_between_its_ends(blocks, leaves):
    """X ends at 600 mm, the arcs begin at X 570; the point farthest out is found on the arc itself."""
    text = f"G21 G90 G17 G54\nG0 X570. Y-10. Z0.\n{blocks}\nM30\n"
    machine = high_mill()
    moves = moves_of(text, "fanuc", NEAR, high_mill(travel_margin_mm=100.0))
    farthest = points_of(moves.part(np.full(4001, 1)), np.linspace(0.0, 1.0, 4001)).max(axis=0)[0]
    assert (farthest > 600.0 + 1e-6) == leaves
    if not leaves:
        assert positions(text, machine=machine)
        return
    with pytest.raises(InputError, match=r"within the arc, outside its travel -600 to 600 mm; check --wcs") as caught:
        positions(text, machine=machine)
    said = float(re.search(r"X goes to ([\d.]+) mm", caught.value.message)[1])
    assert said == pytest.approx(farthest, abs=2e-3)
    assert caught.value.line == 3


# --- the block that checks the set-up: units, place, further work offsets --------------------------------------------

needs_rs274 = pytest.mark.skipif(shutil.which("rs274") is None, reason="LinuxCNC is not installed (rs274 missing)")
INCH = {"machine_units": "inch"}


@needs_rs274
@pytest.mark.parametrize("unit", ["G20", "G21", "", "%\nO12 (PLATE)\nG20"])
@pytest.mark.parametrize("stated", [INCH, {"settings": {"linuxcnc-volumetric": INCH}}])
def test_a_corrected_program_runs_on_a_machine_in_inch(tmp_path, unit, stated):
    """The interpreter without INI file is in inches; a program that does not say its unit is then, too."""
    scale = 1.0 if "G21" in unit else 25.4
    text = f"{unit} G90 G17 G54\nG0 X0 Y0 Z1\nG1 X{50 / scale:.6f} F100\nG55\nG0 X0 Y0 Z0\nG1 X{60 / scale:.6f}\nM2\n"
    text = text.replace("G20 G90", "G20\nG90") + "%\n" * unit.startswith("%")
    machine = machine_of([(-600.0, 600.0), (-500.0, 500.0), (-400.0, 200.0)], 9, **stated)
    result, corrected = run(tmp_path, text, shift(x=254.0), setup=rs274.SETUP, machine=machine)
    assert result.accepted
    program = tmp_path / "out" / "p.nc"
    ends = [end[0] for feed, end, _ in rs274.canonical(program, tmp_path) if feed]
    assert ends == pytest.approx([(50 - 0.254) / scale, (60 - 0.254) / scale], abs=1e-4)
    assert any("lengths are in inch" in text for text in result.assumed) == (not unit)
    # 2.5 um beside: stopped; 0.5 um: what a control keeps in its last decimal
    for k, moved in ((0, 12.7025), (1, 12.7005)):
        program.write_text(corrected.replace(f"[{12.7 / 25.4:.6f}]", f"[{moved / 25.4:.6f}]"))
        rs274.canonical(program, tmp_path, stopped=k == 0)


@needs_rs274
@pytest.mark.parametrize("name", ["G56", "G59.1", "G59.3"])
def test_all_work_offsets_of_linuxcnc_are_checked(tmp_path, monkeypatch, name):
    names = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3")
    offsets = {one: (2.0 * k, 1.0, -50.0) for k, one in enumerate(names)}
    text = f"G21 G90 G17 {name}\nG0 X0 Y0 Z1\nG1 X50 F100\nM2\n"
    machine = machine_of([(-600.0, 600.0), (-500.0, 500.0), (-400.0, 200.0)], 9, **INCH)
    result, _ = run(tmp_path, text, shift(x=10.0), setup=Setup(offsets), machine=machine)
    assert result.unchecked == ()
    monkeypatch.setattr(rs274, "OFFSETS_MM", offsets)
    rs274.canonical(tmp_path / "out" / "p.nc", tmp_path)
    monkeypatch.setattr(rs274, "OFFSETS_MM", {**offsets, name: (*offsets[name][:2], -50.01)})
    rs274.canonical(tmp_path / "out" / "p.nc", tmp_path, stopped=True)


@needs_rs274
def test_many_tools_and_offsets_do_not_make_a_line_too_long(tmp_path, monkeypatch):
    """LinuxCNC takes 255 characters in a line; a machine and a file may have any name."""
    names = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3")
    offsets, tools = {name: (1.0, 1.0, -150.0) for name in names}, {f"{k}": (0.0, 0.0, 50.0 + k) for k in range(1, 41)}
    blocks = [f"T{k} M6\nG43 H{k}\n{names[k % 9]}\nG0 X0 Y0 Z9\nG1 X5 F100" for k in range(1, 41)]
    machine = machine_of([(-600.0, 600.0)] * 3, 9, name="Fräse 加工中心 (1)", **INCH)
    text = "\n".join(["G21 G90 G17 G54", *blocks, "M2", ""])
    _, corrected = run(tmp_path, text, shift(x=10.0), setup=Setup(offsets, tools), machine=machine)
    head = corrected[: corrected.index("o<volcomp9001>")]
    assert max(map(len, head.splitlines())) <= 110
    assert "FOR MACHINE FRASE" in head and "40 = 90.0000" in head.replace("T40", "40")
    assert re.findall(r"G59\.3 = [\d. -]+", head) == [
        "G59.3 = 1.0000 1.0000 -150.0000",
        "G59.3 = 0.039370 0.039370 -5.905512",
    ]
    monkeypatch.setattr(rs274, "OFFSETS_MM", offsets)
    monkeypatch.setattr(rs274, "TOOLS_MM", tools)
    rs274.interpreted(tmp_path / "out" / "p.nc", tmp_path)


BODY = "G90 G17\nG0 X0. Y0. Z0.\nG1 X50. F100\nM30\n"
HEADS = {
    "fanuc": [
        "%\nO12(PLATE)\n", "%\n\n(PLATE)\n(OF 1998)\nO0012\n", "\n%\n", "%\n<PLATE>\n", "O12\n", ":12;\n", "%\no12\n",
        "%PLATE\nO12;\n", "N1 %\nO3\n", "",
    ],
    "linuxcnc": ["%\n", "\n\n%\n", "%\nO12 (PLATE)\n", "\n%\n(PLATE) ; of 1998\nO12\n", ""],
    "siemens": [
        "%_N_PLATE_MPF\n;$PATH=/_N_WKS_DIR\n", "%_N_PLATE_MPF\n\n; PLATE\n; $PATH=/_N_MPF_DIR\n", ";$PATH=/_N_MPF_DIR\n",
        "%_N_PLATE_MPF\n", "",
    ],
    "heidenhain-iso": ["%PLATE G71 *\n", "N0 %PLATE G71 *\n"],
    "grbl": ["%\n", ""],
}  # fmt: skip


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(("dialect", "head"), [(dialect, head) for dialect, heads in HEADS.items() for head in heads])
def test_what_a_control_demands_to_be_first_stays_first(tmp_path, dialect, head, end):
    """% and the number of the program, the path of an archive; comments after them follow the header, as does the program."""
    comment = "; a" if dialect in ("siemens", "heidenhain-iso") else "(a)"
    unit = {"siemens": "G71 ", "heidenhain-iso": ""}.get(dialect, "G21 ")
    text = f"{head}{comment}\n{unit}{BODY}" + "%\n" * ("%" in head and dialect == "fanuc")
    text = text.replace("M30", "N9 %PLATE G71 *") if dialect == "heidenhain-iso" else text
    result, corrected = run(tmp_path, text.replace("\n", end), shift(x=10.0), dialect, PLAIN)
    assert result.accepted
    first = head.replace("\n", end)
    assert corrected.startswith(first + DIALECTS[dialect].comment.format("CORRECTED BY VOLCOMP")[:-1])
    assert corrected.index("CORRECTED BY") < corrected.index(comment) < corrected.index("X49.99")
    assert end == "\n" or corrected.count("\n") == corrected.count("\r\n")


CHECKED = [
    ("fanuc", "G54.1 P1", "G54.1P1", 7001), ("fanuc", "G54.1 P48", "G54.1P48", 7941),
    ("fanuc", "G54 P49", "G54.1P49", 14961), ("fanuc", "G54.1 P300", "G54.1P300", 19981),
    ("fanuc", "G110", "G110", 7001), ("fanuc", "G129", "G129", 7381),
    ("fanuc", "G154 P20", "G154P20", 7381), ("fanuc", "G154 P21", "G154P21", 14401), ("fanuc", "G154 P99", "G154P99", 15961),
    ("fanuc", "G59", "G59", 5321), ("fanuc", "G54.1 P301", "G54.1P301", None),
    ("siemens", "G54", "G54", 1), ("siemens", "G57", "G57", 4), ("siemens", "G505", "G505", 5), ("siemens", "G599", "G599", 99),
    ("linuxcnc", "G59.2", "G59.2", 5361),
    ("heidenhain-iso", "", "PRESET", None), ("grbl", "G55", "G55", None),
]  # fmt: skip


@pytest.mark.parametrize(("dialect", "code", "name", "register"), CHECKED)
@pytest.mark.parametrize("units", ["mm", "inch"])
def test_every_work_offset_is_checked_or_said_not_to_be(tmp_path, dialect, code, name, register, units):
    """By hand: -19.685039 inch are -500 mm. The variables are those of the manuals."""
    unit = {"siemens": "G71", "heidenhain-iso": "%A G71 *\n"}.get(dialect, "G21")
    text = f"{unit} {code} {BODY}".replace("M30", "N9 %A G71 *" if unit[0] == "%" else "M30")
    machine = machine_of([(-600.0, 600.0)] * 3, 9, machine_units=units)
    result, corrected = run(tmp_path, text, shift(x=10.0), dialect, Setup({name: (-500.0, 0.0, 6.35)}), machine=machine)
    listed = (tmp_path / "out" / "preflight.md").read_text()
    found = result.as_dict()
    assert (found["machine_units"], found["offsets_not_checked"]) == (units, [] if register else [name])
    assert f"WORK OFFSETS MM {name} = -500.0000 0.0000 6.3500" in corrected
    assert (f"WORK OFFSETS INCH {name} = -19.685039 0.000000 0.250000" in corrected) == (units == "inch")
    if register is None:
        assert f"NOT CHECKED BY THIS PROGRAM {name}" in corrected
        assert f"Compare by hand, since the program does not check it: {name}." in listed
        assert not re.search(r"^(IF|o<)", corrected, re.MULTILINE)
        return
    x, z = ("-19.685039", "0.250000") if units == "inch" else ("-500.0000", "6.3500")
    within = {"mm": "0.001", "inch": "0.00006" if dialect == "fanuc" else "0.00004"}[units]
    expected = {
        "fanuc": [f"IF[ABS[#{register}-[{x}]]LE{within}]GOTO9001", f"IF[ABS[#{register + 2}-[{z}]]LE{within}]GOTO9003"],
        "linuxcnc": [f"o<volcomp9001> if [ABS[#{register}-[{x}]] GT {within}]"],
        "siemens": [
            f"IF ABS($P_UIFR[{register},X,TR]-({x}))<={within} GOTOF VC9001",
            f"$P_UIFR[{register},Z,TR]-({z}))",
        ],
    }[dialect]
    assert all(line in corrected for line in expected), corrected
    assert f"where X, Y or Z of {name} differ by more than {within} {units}" in listed


def test_units_of_a_machine_rule_its_tables_and_contradictions_are_refused(tmp_path):
    file = tmp_path / "m.toml"
    axes = "".join(f"[axes.{axis}]\nrange_mm = [0, 100]\nnodes = 3\n" for axis in "XYZ")
    for top, own, expected in (
        ("", {}, "mm"),
        ('machine_units = "inch"\n', {}, "inch"),
        ("", {"linuxcnc-comp": "inch"}, "inch"),
        ('machine_units = "inch"\n', {"linuxcnc-comp": "inch"}, "inch"),
    ):
        sections = "".join(f'[controllers.{name}]\nmachine_units = "{unit}"\n' for name, unit in own.items())
        file.write_text(f'name = "m"\nchain = "WXYFZT"\n{top}{axes}{sections}')
        machine = read_machine(file)
        assert machine.units == expected
        assert CONTROLLERS["linuxcnc-comp"].read_settings(machine).machine_units == expected
        units = CONTROLLERS["linuxcnc-volumetric"].read_settings(machine).machine_units
        assert units == ("inch" if top else "mm")
    two = (
        '[controllers.linuxcnc-comp]\nmachine_units = "mm"\n[controllers.linuxcnc-volumetric]\nmachine_units = "inch"\n'
    )
    file.write_text(f'name = "m"\nchain = "WXYFZT"\nmachine_units = "inch"\n{axes}{two}')
    with pytest.raises(InputError, match="the machine states 'inch'"):
        read_machine(file)
    file.write_text(f'name = "m"\nchain = "WXYFZT"\n{axes}{two}')
    with pytest.raises(InputError, match=r"\[controllers.linuxcnc-comp\] is in mm, .* state it for the machine"):
        read_machine(file).units  # noqa: B018


# --- what the correction moves beyond the travel ----------------------------------------------------------------------

EDGE = (-600.0, 0.0, 0.0)


def at_the_edge(dialect, blocks, setup=EDGE):
    """A program whose X 0 is the end of the travel, in a dialect."""
    unit, end = {"siemens": ("G71", "M30"), "heidenhain-iso": ("%A G71 *\n", "N9 %A G71 *")}.get(
        dialect, ("G21", "M30")
    )
    offset = "" if dialect == "heidenhain-iso" else "G54"
    text = f"{unit} G90 G17 {offset}\nG0 X50. Y0. Z0.\n{blocks}\n{end}\n"
    return text.replace("\n\n", "\n"), Setup({"G54": setup, "PRESET": setup}, {"1": (0.0, 0.0, 0.0)})


@pytest.mark.parametrize("dialect", G_CODE)
@pytest.mark.parametrize("blocks", ["G1 X10. F100\nX0.\nY20.", "G0 X0.\nG1 Y20. F100"])
def test_a_program_that_the_correction_takes_beyond_the_travel_is_refused(tmp_path, dialect, blocks):
    """The machine goes 129 um too far to plus, so that X 0 of the program becomes -600.129 mm: by cuts and by rapid moves."""
    text, setup = at_the_edge(dialect, blocks)
    result, _ = run(tmp_path, text, shift(x=129.0), dialect, setup)
    assert not result.accepted and result.file == "NOT-ACCEPTED-p.nc"
    line = next(k for k, block in enumerate(text.splitlines(), 1) if "X0." in block)
    assert result.reasons == (
        f"1 block leads beyond the travel, by up to 0.129 mm (line {line}: X -600.129 mm of the machine): clamp the workpiece "
        "farther inside, leave an axis as it is (--only), or state travel_margin_mm in the machine file (now 0) if the software "
        "limits of the control are farther out",
    )
    listed = (tmp_path / "out" / "preflight.md").read_text()
    assert f"line {line}: X -600.1290 mm of the machine, 0.1290 mm beyond the travel, by the correction: `" in listed
    assert result.as_dict()["beyond_travel"]["largest"][0]["block"].split("X")[1].startswith("-0.129")
    # to the other side the correction leads inward, and an axis that is not corrected stays
    assert run(tmp_path, text, shift(x=-129.0), dialect, setup)[0].accepted
    stays, _ = run(tmp_path, text, shift(x=129.0, y=50.0), dialect, setup, only="Y,Z")
    assert stays.blocks_beyond == 0


def test_a_margin_of_the_machine_lets_them_pass_and_they_are_listed(tmp_path):
    text, setup = at_the_edge("fanuc", "G1 X10. F100\nX0.\nY20.\nX0.05 Y30.\nX30.")
    errors = ErrorTable({"EXX": Curve(np.array([-700.0, 700.0]), np.full(2, 0.129), np.zeros(2))})
    machine = machine_of([(-600.0, 600.0), (-500.0, 500.0), (-400.0, 200.0)], 9, travel_margin_mm=0.2)
    result, _ = run(tmp_path, text, errors, "fanuc", setup, machine=machine)
    assert result.accepted and result.blocks_beyond == 2
    found = [(item.line, round(item.beyond_mm, 3), item.by_program) for item in result.beyond]
    assert found == [(4, 0.129, False), (6, 0.079, False)]
    assert result.notes[0] == (
        "2 blocks lead beyond the travel, by up to 0.129 mm (line 4: X -600.129 mm of the machine, line 6: X -600.079 mm of the "
        "machine), within travel_margin_mm = 0.2 of the machine file"
    )
    # the program itself may use the margin, too
    result, _ = run(tmp_path, text.replace("X0.\n", "X-0.05\n"), errors, "fanuc", setup, machine=machine)
    assert result.accepted and [item.by_program for item in result.beyond] == [True, False]
    assert (
        "beyond the travel, where the program leads, too: `X-0.179`" in (tmp_path / "out" / "preflight.md").read_text()
    )
    with pytest.raises(InputError, match="outside its travel -600 to 600 mm"):
        run(tmp_path, text.replace("X0.\n", "X-0.21\n"), errors, "fanuc", setup, machine=machine)
    result, _ = run(tmp_path, text.replace("X0.\n", "X-0.1\n"), errors, "fanuc", setup, machine=machine)
    assert result.reasons[0].startswith("2 blocks lead beyond the travel, by up to 0.229 mm (line 4: X -600.229")


@pytest.mark.parametrize("dialect", G_CODE)
def test_an_arc_whose_ends_stay_inside_may_leave_the_travel_by_its_correction(tmp_path, dialect):
    """A semicircle about X 30 with the radius 30 touches the end of the travel; the correction moves it 10 um beyond."""
    centre = "I+30. J+0.\nG3 X30. Y-30." if dialect == "heidenhain-iso" else "G3 X30. Y-30. I0. J-30."
    text, setup = at_the_edge(dialect, f"G0 X30. Y30.\n{centre} F100\nG1 X50.")
    result, _ = run(tmp_path, text, shift(x=10.0), dialect, setup)
    assert len(result.reasons) == 1 and result.blocks_beyond == 1
    assert (result.beyond[0].axis, round(result.beyond[0].position_mm, 3)) == ("X", -600.010)
    assert "G3" in text.splitlines()[result.beyond[0].line - 1]


def test_holes_and_all_axes_are_held_against_the_travel(tmp_path):
    """Z from -400 mm: the depth of a hole; Y by an increment; the many blocks of a face, of which some are listed."""
    text, setup = at_the_edge(
        "fanuc", "G99 G81 X20. Z-100. R5. F90\nX30.\nG80\nG0 Z10.\nG91 G1 Y-500. F9\nG90 Y0.", (0.0, 0.0, -300.0)
    )
    result, _ = run(tmp_path, text, shift(y=7.0, z=33.0), "fanuc", setup)
    assert {(item.axis, item.line, round(item.beyond_mm, 3)) for item in result.beyond} == {
        ("Z", 3, 0.033),
        ("Z", 4, 0.033),
        ("Y", 7, 0.007),
    }
    many = "\n".join(f"G1 X1. Y{k}. F90\nX0." for k in range(135))
    text, setup = at_the_edge("linuxcnc", many)
    result, _ = run(tmp_path, text, shift(x=20.0), setup=setup)
    assert (result.blocks_beyond, len(result.beyond)) == (135, 100)
    assert (
        "    - and 115 more blocks; correction.json lists up to 100" in (tmp_path / "out" / "preflight.md").read_text()
    )


def test_blocks_of_a_subprogram_have_the_lines_of_the_file(tmp_path):
    text, setup = at_the_edge("fanuc", "M98 P7 L2\nM30\nO7\nG1 X5. F90\nX0.\nX9.\nM99")
    result, _ = run(tmp_path, text.replace("M99\nM30", "M99"), shift(x=10.0), "fanuc", setup)
    assert {item.line for item in result.beyond} == {7} and "line 7: X -600.010 mm" in result.reasons[0]


# --- what is said about the program ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dialect", G_CODE)
def test_m_codes_that_are_not_known_are_listed_all_at_once(tmp_path, dialect):
    """With their lines; the first is the line of the message. M88 in a comment and M8 are none of them."""
    comment = "; M88" if dialect in ("siemens", "heidenhain-iso") else "(M88)"
    blocks = f"M177\nG1 X10. F100 M200\nM8\nM177\nX20.\n\nM300 {comment}\nY5. M177"
    text, setup = at_the_edge(dialect, blocks, (0.0, 0.0, 0.0))
    first = text.splitlines().index("M177") + 1
    with pytest.raises(InputError) as caught:
        run(tmp_path, text, shift(x=10.0), dialect, setup)
    assert caught.value.message == (
        f"M177 (lines {first}, {first + 3}, {first + 6}), M200 (line {first + 1}), M300 (line {first + 5}) are not known; if "
        "they move nothing, add --keep-unknown M177,M200,M300"
    )
    assert (caught.value.line, (tmp_path / "out").exists()) == (first, False)
    known = replace(setup, keep_unknown=frozenset({"M177", "M200", "M300"}))
    assert run(tmp_path, text, shift(x=10.0), dialect, known)[0].accepted
    known = replace(setup, keep_unknown=frozenset({"M177", "M200"}))
    with pytest.raises(InputError, match=rf"M300 \(line {first + 5}\) is not known; .* --keep-unknown M300$"):
        run(tmp_path, text, shift(), dialect, known)
    # what stops the reading before its end says them, too
    with pytest.raises(InputError, match=rf"G999.*; before that, M177 \(line {first}\), M200 .* are not") as caught:
        run(tmp_path, text.replace("M8\n", "G999\n"), shift(), dialect, setup)
    assert caught.value.line == first + 2


def test_the_lines_of_m_codes_are_those_of_the_file(tmp_path):
    text, setup = at_the_edge("fanuc", "M98 P7 L40\nM30\nO7\nG1 X5. F90 M123\nX0.\nM99", (0.0, 0.0, 0.0))
    text = text.replace("M99\nM30", "M99")
    with pytest.raises(InputError) as caught:
        run(tmp_path, text, shift(x=10.0), "fanuc", setup)
    assert (caught.value.line, caught.value.message.startswith("M123 (line 6) is not known")) == (6, True)
    many = "\n".join(["M123"] * 50)
    with pytest.raises(InputError, match=r"31, 32 and 20 more\) is not known"):
        run(tmp_path, at_the_edge("fanuc", many)[0], shift(x=10.0), "fanuc", setup)


def test_a_program_that_grows_much_is_said_to(tmp_path):
    """Nodes of 2 mm with a scatter of 2 um, as unfiltered measurements have: some hundred pieces for each cut of 500 mm."""
    at = np.arange(-600.0, 602.0, 2.0)
    value = np.random.default_rng(5).normal(0.0, 2e-3, len(at))
    rough = ErrorTable({"EYX": Curve(at, value, np.zeros(len(at))), "EXX": Curve(at[::50], value[::50], np.zeros(13))})
    blocks = "\n".join(f"G1 X{500 * (k % 2)}. Y{k}. F900" for k in range(3))
    text, setup = at_the_edge("fanuc", blocks, (-250.0, 0.0, 0.0))
    result, _ = run(tmp_path, text, rough, "fanuc", setup)
    count, added = result.counts["blocks"], result.counts["added_blocks"]
    assert added > 200 and len(result.notes) == 1
    found = re.fullmatch(
        r"the corrected program has (\d+) blocks for (\d+): a piece at feed is ([\d.]+) mm long on average, "
        r"(\d+) blocks a second at 1000 mm/min\. EYX has nodes 2 mm apart, whose values scatter by about ([\d.]+) um; "
        r"smooth errors \(volcomp fit\), a larger --tolerance-um \(1\) or --shortest-mm \(0\.1\) make it shorter",
        result.notes[0],
    )
    assert (int(found[1]), int(found[2])) == (count + added, count)
    piece_mm = result.after.length_mm / (added + 3)
    assert float(found[3]) == pytest.approx(piece_mm, abs=0.006) and int(found[4]) == round(1000 / 60 / piece_mm)
    assert float(found[5]) == pytest.approx(2.0, abs=0.25)
    assert result.notes[0][1:] in (tmp_path / "out" / "preflight.md").read_text()
    coarse, _ = run(tmp_path, text, rough, "fanuc", setup, tolerance_um=20.0)
    assert coarse.notes == () and coarse.counts["added_blocks"] < 20


# --- probing: blocks stay, and where the tool is after them is not known ----------------------------------------------

PROBED = {
    "fanuc": ("G21 G90 G17 G54\nG0 X1. Y1. Z5.\n", "G31 Z-5. F50\n", "G0 Z5.\nX2.\n", "G1 X9. F90\nM30\n", "G31 in line 3"),
    "linuxcnc": ("G21 G90 G17 G54\nG0 X1 Y1 Z5\n", "G38.2 Z-5 F50\n", "G0 Z5\nX2\n", "G1 X9 F90\nM2\n", "G38.2 in line 3"),
    "grbl": ("G21 G90 G17 G54\nG0 X1 Y1 Z5\n", "G38.3 Z-5 F50\n", "G0 Z5\nX2\n", "G1 X9 F90\n", "G38.3 in line 3"),
    "siemens": (
        "G71 G90 G17 G54\nG0 X1 Y1 Z5\n", "CYCLE978(100,10001,,1,10,5,2)\n", "G0 X2 Y1 Z5\n", "G1 X9 F90\nM30\n",
        "CYCLE978 in line 3",
    ),
    "heidenhain-iso": (
        "%A G71 *\nN1 G00 G90 G40 X+1 Y+1 Z+5*\n", "N2 G419 Q263=+5 ;1ST POINT\nQ261=-5 ;HEIGHT\n", "N3 G00 X+2 Y+1 Z+5*\n",
        "N4 G01 X+9 F90*\nN5 M30*\nN99 %A G71 *\n", "G419 in line 3",
    ),
    "heidenhain-klartext": (
        "0 BEGIN PGM A MM\nTOOL CALL 1 Z S9\nL X+1 Y+1 Z+5 R0 FMAX\n",
        "TCH PROBE 419 DATUM ~\n  Q263=+5 ;1ST POINT ~\n  Q261=-5 ;HEIGHT\nTCH PROBE 0.0 REF. PLANE Q5 Z-\n"
        "TCH PROBE 0.1 X+1 Y+1 Z-5\n",
        "L X+2 Y+1 Z+5 R0 FMAX\n", "L X+9 F90\nM30\nEND PGM A MM\n", "TCH PROBE 419 in line 4; TCH PROBE 0 in line 7",
    ),
}  # fmt: skip


@pytest.mark.parametrize("dialect", PROBED)
def test_probing_passes_uncorrected_and_says_what_it_measures(tmp_path, dialect):
    """The machine is 10 um off in X: the block that probes keeps its bytes, moves that are placed after it are corrected."""
    begin, probe, placed, cut, said = PROBED[dialect]
    setup = Setup({"G54": (0.0, 0.0, 0.0), "PRESET": (0.0, 0.0, 0.0)}, {"1": (0.0, 0.0, 0.0)})
    result, corrected = run(tmp_path, begin + probe + placed + cut, shift(x=10.0), dialect, setup)
    assert result.accepted
    assert probe in corrected
    assert re.search(r"X\+?8\.99 ", corrected)
    (note,) = [text for text in result.assumed if "probing is not corrected" in text]
    assert said in note
    with pytest.raises(InputError, match="not known"):  # a cut from where the probe stopped
        run(tmp_path, begin + probe + cut, shift(x=10.0), dialect, setup)


def test_what_a_probe_has_found_is_no_constant(tmp_path):
    begin, probe, placed, cut, _ = PROBED["heidenhain-klartext"]
    setup = Setup({"PRESET": (0.0, 0.0, 0.0)}, {"1": (0.0, 0.0, 0.0)})
    for name in ("Q5", "Q160"):
        with pytest.raises(InputError, match=name):
            run(
                tmp_path,
                begin + probe + placed + cut.replace("X+9", f"X+{name}"),
                shift(),
                "heidenhain-klartext",
                setup,
            )


WRITTEN = {
    "fanuc": "G21 G90 G17\nG10 L2 P2 X-10. Y0. Z0.\nG55 G0 X30. Y0. Z0.\nG1 X40. F90\nG10 L20 P1 X5. Y0. Z0.\n"
    "G54.1 P1 G0 X15. Y0. Z0.\nG1 X40. F90\nM30\n",
    "grbl": "G21 G90 G17\nG10 L2 P2 X-10 Y0 Z0\nG55 G0 X30 Y0 Z0\nG1 X40 F90\nG10 L20 P2 X25\nG0 X15\nG1 X40 F90\n",
}


@pytest.mark.parametrize("dialect", WRITTEN)
def test_a_work_offset_that_the_program_writes_needs_no_wcs(tmp_path, dialect):
    """Both cuts go from X 20 to X 30 and from X 20 to X 45 of the machine, which is 10 um too far."""
    path = tmp_path / "p.nc"
    path.write_text(WRITTEN[dialect])
    reader = Reader(mill(), DIALECTS[dialect], Setup(), path)
    moves = Moves.joined([batch.moves for batch in read_twice(reader)])
    assert moves.end_mm[moves.kind == 1][:, 0].tolist() == [30.0, 45.0]
    result, corrected = run(tmp_path, WRITTEN[dialect], shift(x=10.0), dialect, Setup())
    assert result.accepted
    assert re.search(r"G1 X39\.99 F90", corrected)
    assert "IS NOT THAT OF" not in corrected  # nothing was given that could be another
    assert "G55 is X-10 Y0 Z0 mm of the machine, as the program writes it (G10)" in result.assumed


@pytest.mark.parametrize(
    ("dialect", "block", "words"),
    [
        ("fanuc", "G10 L2 P0 X1.", "set them at the control"),
        ("fanuc", "G10 L10 P1 R5.", "set them at the control"),
        ("fanuc", "G91 G10 L2 P1 X1.", "incremental"),
        ("fanuc", "G10 L2 P3 X1.", "--wcs G56"),
        ("linuxcnc", "G10 L2 P1 X1 R30", "set them at the control"),
        ("linuxcnc", "G30 Z5\nG10 L20 P1 Z0", "not known"),
        ("linuxcnc", "G10 L1 P1 Z5", "set them at the control"),
    ],
)
def test_what_g10_writes_beside_work_offsets_is_refused(tmp_path, dialect, block, words):
    text = f"G21 G90 G17 G54\nG0 X0. Y0. Z0.\n{block}\nG1 X9. F9\nM30\n"
    with pytest.raises(InputError, match=words):
        run(tmp_path, text, shift(), dialect, Setup({"G54": (0.0, 0.0, 0.0)}))
