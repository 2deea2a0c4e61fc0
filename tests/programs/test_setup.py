"""What a program needs of its machine: tool tables, travel, reference point, units, and the block that checks the set-up."""

import re

import numpy as np
import pytest
from programs.test_correct import moves_of, run, shift

from compgen.errors import InputError
from compgen.programs import Setup, read_tools
from compgen.programs.path import points_of
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
