"""What a program needs of its machine: tool tables, travel, reference point, units, and the block that checks the set-up."""

import pytest

from compgen.errors import InputError
from compgen.programs import read_tools


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
