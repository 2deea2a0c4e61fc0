"""Drilling cycles of FANUC along Y (G18) and X (G19): the program of G17 with other axes leads to the same places, turned."""

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import body, run, shift

from compgen.errors import InputError
from compgen.programs import Reader, Setup
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import Follower, difference

SETUP = Setup({"G54": (0.0, 0.0, 0.0), "G55": (0.0, 0.0, 0.0)}, {"1": (0.0, 0.0, 0.0)})
#: Where the letters X, Y, Z of a program of G17 go, and where its axes do.
TURNED = {18: ("ZXY", [2, 0, 1]), 19: ("YZX", [1, 2, 0])}
HOLES = {
    "modal": "G98 G{c} X10. Y5. Z-10. R2.{q} F90\nX20.\nG99 X30. Y6.\nG98 Z-11. R3.\nY9.\nG52 X3. Z1.\nX1. Z-9. R2.\nG80\n",
    "increments": "G91 G99 G{c} X10. Y1. Z-9. R-18.{q} K3 F90\nX2.\nG90 X0. Y0. Z-4. R5.\nG80\n",
    "from below": "Z-1.\nG98 G{c} X4. Z-9. R3.{q} F90\nY4.\nG0 Z20.\n",
    "stored": "G99 G{c} Z-10. R2.{q} K0\nX5.\nY5.\nG80\n",
}


def turned(text, plane):
    return text.translate(str.maketrans("XYZ", TURNED[plane][0])).replace("G17", f"G{plane}")


def read(text):
    """Moves of a program by its reader, which the follower has to agree on."""
    content = text.encode()
    moves = Reader(mill(), DIALECTS["fanuc"], SETUP, "p").batch(content, 1).moves
    followed = Follower("fanuc", SETUP, mill()).follow(text, range(1, text.count("\n") + 2))
    assert difference(moves, followed) is None
    return moves


@pytest.mark.parametrize("plane", TURNED)
@pytest.mark.parametrize("name", HOLES)
@pytest.mark.parametrize("cycle", [73, 74, 76, 81, 82, 83, 84, 85, 86, 88, 89])
def test_a_cycle_in_another_plane_leads_where_the_turned_one_does(plane, name, cycle):
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z20.\n" + HOLES[name].format(c=cycle, q=" Q3." if cycle in (73, 83) else "")
    straight, there = read(text), read(turned(text, plane))
    axes = TURNED[plane][1]
    assert len(straight) == len(there) > 6
    for name_ in ("start_mm", "end_mm", "at_mm", "offset_mm", "corrected"):
        np.testing.assert_allclose(getattr(there, name_)[:, axes], getattr(straight, name_), atol=1e-9)
    assert (there.kind == straight.kind).all() and (there.line == straight.line).all()


def test_a_hole_along_y_is_corrected_by_hand(tmp_path):
    """The tool is 10 um too far in X, 20 um in Y, 30 um in Z: place, depth and R level go by as much."""
    text = "%\nO1\nG21 G90 G18 G54\nG0 X0. Y30. Z0.\nG99 G81 X10. Z5. Y-10. R2. F90\nX20.\nG80\nG0 Y30.\nM30\n%\n"
    result, corrected = run(tmp_path, text, shift(x=10.0, y=20.0, z=30.0), "fanuc", SETUP)
    assert result.accepted
    assert "G0 X-0.01 Y29.98 Z-0.03\nG99 G81 X9.99 Z4.97 Y-10.02 R1.98 F90\nX19.99\nG80\nG0 Y29.98\n" in body(corrected)
    assert "a drilling cycle in G18 drills along Y (parameter 5101 FXY = 1; with 0 it drills along Z)" in result.assumed


@pytest.mark.parametrize(
    ("blocks", "line", "words"),
    [
        ("G18\nG81 X1. Y-5. R2. F9\nG17\nX5. Z-5.\n", 6, "the plane changes within a drilling cycle"),
        ("G17\nG81 X1. Z-5. R2. F9\nG19 X5.\n", 5, "the plane changes"),
        ("G18\nG81 X1. Z-5. R2. F9\n", 4, "a drilling cycle without Y or R"),
        ("G19\nG81 Y1. X-5. F9\n", 4, "a drilling cycle without X or R"),
        ("G19\nG81 Y1. X-5. R-7. F9\n", 4, "below its depth"),
        ("G18\nG91 G81 X1. Y-5. F9\n", 4, "one of Y and R"),
        ("G18\nG87 X1. Y-5. R2. F9\n", 4, "back boring"),
        ("G18\nG83 X1. Y-5. R2. Q1. F9\nG20\nX2.\n", 6, "the unit changes"),
    ],
)
@pytest.mark.parametrize("dialect", ["fanuc", "linuxcnc"])
def test_what_is_not_followed_is_refused_with_its_line(tmp_path, blocks, line, words, dialect):
    if dialect == "linuxcnc" and "one of" in words:
        words = "without Y or R"
    text = f"G21 G90 G54\nG0 X0. Y30. Z30.\n{blocks}M30\n"
    with pytest.raises(InputError, match=words) as caught:
        run(tmp_path, text, shift(x=5.0), dialect, SETUP)
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("dialect", "cycle"), [("siemens", "MCALL CYCLE81(10,0,2,-5)"), ("heidenhain-iso", "G83 P01 -2 P02 -9")]
)
def test_cycles_of_other_dialects_stay_in_g17(tmp_path, dialect, cycle):
    head = "%P G71 *\n" if dialect == "heidenhain-iso" else ""
    text = f"{head}G90 G18\nT1\nG0 X0 Y0 Z30\n{cycle}\nG0 X5 M99\nM30\n"
    setup = Setup({"G54": (0.0,) * 3, "PRESET": (0.0,) * 3}, {"1": (0.0,) * 3})
    with pytest.raises(InputError) as caught:
        run(tmp_path, text.replace(" M99", "") if dialect == "siemens" else text, shift(x=5.0), dialect, setup)
    assert caught.value.line is not None
