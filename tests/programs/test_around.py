"""How controls go to contours and about their corners: what is another way than is judged is said with its line, or refused."""

import re

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Chain, Machine
from compgen.errors import InputError
from compgen.programs import CorrectOptions, Setup, correct_program, model_of

NODES_MM = np.linspace(-500.0, 500.0, 11)
LINE = Axis((-500.0, 500.0), NODES_MM)
GANTRY = Machine("gantry", Chain("WFYXZT"), (LINE, LINE, LINE))
#: X is 0.05 um/mm too long.
ERRORS = ErrorTable(curves={"EXX": Curve(NODES_MM, 5e-5 * NODES_MM, 0.0 * NODES_MM)})
SIEMENS = (
    "G17 G71 G90 G54\nT1 M6 D1\nG0 X-10 Y-20 Z5\nG1 Z-2 F200\n{0}\nG41 X0 Y0\nY50\nX60\nY0\nX0\nG40 X-10 Y-20\n"
    "G0 Z50\nM30\n"
)
FANUC = (
    "G17 G21 G90 G54\nT1 M6\nG0 X-10. Y-20. Z5.\nG1 Z-2. F200.\nG41 D1 X0. Y0.\nY50.\n{0}\nX60.\nY0.\nX0.\n"
    "G40 X-10. Y-20.\nG0 Z50.\nM30\n"
)
KLARTEXT = (
    "BEGIN PGM A MM\nTOOL CALL 1 Z S1000\nL X-10 Y-20 Z+5 R0 FMAX\nL Z-2 F200\nL X+0 Y+0 RL\nL Y+50{0}\nL X+60\nL Y+0\nL X+0\n"
    "L X-10 Y-20 R0\nL Z+50 FMAX M2\nEND PGM A MM\n"
)
ISO = (
    "%A G71 *\nT1 G17 S1000 *\nG00 G90 X-10 Y-20 Z+5*\nG01 Z-2 F200*\nG41 X+0 Y+0*\nY+50{0}*\nX+60*\nY+0*\nX+0*\nG40 X-10 Y-20*\n"
    "G00 Z+50 M2*\nN9 %A G71 *\n"
)
TEXTS = {"siemens": SIEMENS, "fanuc": FANUC, "heidenhain-klartext": KLARTEXT, "heidenhain-iso": ISO}


def corrected(tmp_path, dialect, text, radius_mm=5.0):
    program = tmp_path / "p.nc"
    program.write_text(text)
    zero = {"G54": (0.0, 0.0, 0.0), "PRESET": (0.0, 0.0, 0.0)}
    setup = Setup(
        work_offsets_mm=zero,
        tools_mm={"1": (0.0, 0.0, 0.0)},
        stated_radii_mm={"": radius_mm},
        integers="mm" if dialect == "fanuc" else None,
    )
    found = correct_program(
        model_of(GANTRY, ERRORS, None), program, tmp_path / "out", CorrectOptions(dialect=dialect), setup
    )
    return found, (tmp_path / "out" / found.file).read_text()


# Programming Manual Fundamentals of SINUMERIK (NORM, KONT, G450, G451, DISC, G460 to G462), Klartext of HEIDENHAIN (M97, M98).
@pytest.mark.parametrize(
    ("dialect", "code", "line", "said"),
    [
        ("siemens", "KONT", 6, "first and last point"),
        ("siemens", "G461", 6, "first and last point"),
        ("siemens", "G451", 6, "beyond the arc"),
        ("siemens", "G450 DISC=50", 6, "beyond the arc"),
        ("heidenhain-klartext", " M97", 6, "beyond the arc"),
        ("heidenhain-klartext", " M98", 6, "end of the move"),
        ("heidenhain-iso", " M97", 6, "beyond the arc"),
        ("heidenhain-iso", " M98", 6, "end of the move"),
    ],
)
def test_another_way_is_said_with_its_line(tmp_path, dialect, code, line, said):
    """A straight line to the contour and an arc about a corner are judged: other ways are named, the code stays."""
    found, text = corrected(tmp_path, dialect, TEXTS[dialect].format(code))
    assert found.accepted and code in text
    assert any(f"in line {line}: " in item and said in item for item in found.assumed), found.assumed


@pytest.mark.parametrize(
    ("dialect", "code"),
    [
        *(("siemens", code) for code in ("NORM", "G450", "G460", "CDOF2", "CUT2D", "G143", "G340")),
        ("fanuc", "G39"),
        ("heidenhain-klartext", ""),
        ("heidenhain-klartext", " M120 LA5"),
        ("heidenhain-iso", " M109"),
    ],
)
def test_the_judged_way_says_nothing(tmp_path, dialect, code):
    """A straight line to the contour and an arc about the corner (G39 of FANUC) are what is judged."""
    found, text = corrected(tmp_path, dialect, TEXTS[dialect].format(code))
    assert found.accepted and code in text
    assert not any("judged" in item for item in found.assumed)


@pytest.mark.parametrize(
    ("dialect", "code", "why"),
    [
        ("siemens", "G147 DISR=5", "soft approaches"),
        ("siemens", "CUTCONON", "suppressed"),
        ("siemens", "CUT2DF", "turned frame"),
        ("siemens", "OFFN=2", "allowance"),
        ("fanuc", "G39 I1. J0.", "another direction"),
        ("fanuc", "G38", "vector"),
        ("fanuc", "G45", "tool offset"),
        ("heidenhain-iso", " M118 Z1", "handwheel"),
        ("heidenhain-iso", "*\nG25 R3", "roundings"),
        ("heidenhain-iso", "*\nG26 R3", "tangent arc"),
    ],
)
def test_what_goes_elsewhere_is_refused_with_its_line(tmp_path, dialect, code, why):
    """What changes the contour itself is refused where it stands."""
    text = TEXTS[dialect].format(code)
    with pytest.raises(InputError, match=why) as caught:
        corrected(tmp_path, dialect, text)
    word = code.split("\n")[-1].split()[0]
    assert text.split("\n")[caught.value.line - 1].find(word) >= 0
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("block", ["L X+3 M118 X1", "L X+3 M118 Z1", "M118 X1 Y1 Z1", "L M118 Z1"])
def test_ways_of_the_handwheel_are_no_moves(tmp_path, block):
    """X, Y and Z after M118 limit the handwheel: the block stays as it is, and leads where it would without them."""
    text = KLARTEXT.replace("L Y+50{0}", f"{block}\nL Y+50")
    found, written = corrected(tmp_path, "heidenhain-klartext", text, 0.0)
    assert found.accepted and block[block.index("M118") :] in written
    without, _ = corrected(
        tmp_path, "heidenhain-klartext", text.replace(block[block.index("M118") :], "").replace("\nL \n", "\n"), 0.0
    )
    assert found.before.length_mm == without.before.length_mm


@pytest.mark.parametrize(
    ("dialect", "code", "says"), [("siemens", "G451", True), ("siemens", "G450", False), ("fanuc", "", True)]
)
def test_corners_beyond_the_travel(tmp_path, dialect, code, says):
    """By hand: a right angle at X 492 and a tool of 7 mm: the paths beside it meet at 492 + 7 sqrt(2) = 501.899."""
    start = (
        "G17 G90 G54 {0}\nT1 M6\nG0 X460. Y-20. Z5.\nG1 Z-2. F200.\nG42 D1 X470. Y0.\nX480.\nX492. Y12.\nX480. Y24.\n"
        "X460.\nG40 X450. Y-20.\nG0 Z50.\nM30\n"
    )
    found, _ = corrected(tmp_path, dialect, start.format({"siemens": f"G71 {code}", "fanuc": "G21"}[dialect]), 7.0)
    assert found.accepted
    assert any("line 7: " in item and "1.899 mm beyond the travel of X" in item for item in found.assumed) == says


def test_no_piece_ends_where_an_inner_corner_cuts_it_off(tmp_path):
    """By hand: sides of a triangle turn by 120 deg, so that a tool of 4 mm inside leaves 4 tan(60 deg) = 6.93 mm of each out.

    The straightness of X has a kink 3 mm before the corner, where a division would leave a piece without a path beside it.
    """
    nodes = np.array([-500.0, 47.0, 60.0, 500.0])
    kink = Curve(nodes, np.array([0.0, 0.0, 0.05, 0.05]), 0.0 * nodes)
    bent = ErrorTable(curves={"EYX": kink, "EXX": ERRORS.curves["EXX"]})
    program = tmp_path / "p.ngc"
    program.write_text(
        "G17 G21 G90 G54\nT1 M6\nG0 X20 Y10 Z5\nG1 Z-2 F200\nG41 D1 X25 Y0\nX50\nX25 Y43.301\nX0 Y0\nX25\nG40 X20 Y10\n"
        "G0 Z50\nM2\n"
    )
    setup = Setup(work_offsets_mm={"G54": (0.0, 0.0, 0.0)}, stated_radii_mm={"": 4.0})
    found = correct_program(model_of(GANTRY, bent, None), program, tmp_path / "out", CorrectOptions(), setup)
    assert found.accepted and found.after.worst_mm < 0.001
    ends = [float(x) for x in re.findall(r"^(?:G1 )?X([\d.]+)", (tmp_path / "out" / "p.ngc").read_text(), re.MULTILINE)]
    assert not [x for x in ends if 50.0 - 6.9 < x < 49.9]
