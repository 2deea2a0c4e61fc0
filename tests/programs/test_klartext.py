"""Klartext of HEIDENHAIN: what each sentence does, by hand; corrected programs, by a generator that knows its path; refusals."""

import math
import re

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import run, shift

from compgen.errors import InputError
from compgen.programs import Reader, Setup
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import read_twice
from compgen.programs.path import Moves

KLARTEXT, ZERO = "heidenhain-klartext", (0.0, 0.0, 0.0)
SETUP = Setup({"PRESET": ZERO}, {"1": ZERO, "MILL": (0.0, 0.0, 50.0)})
START = "0 BEGIN PGM P MM\n1 TOOL CALL 1 Z S900\n2 L X+0 Y+0 Z+0 R0 FMAX\n"
DRILL = (
    "CYCL DEF 200 DRILLING ~\n  Q200=+2 ;SET-UP CLEARANCE ~\n  Q201=-15 ;DEPTH ~\n  Q206=+100 ;FEED ~\n"
    "  Q203=+1 ;SURFACE ~\n  Q204=+20 ;2ND CLEARANCE\n"
)


def program(body, unit="MM"):
    return START.replace("MM", unit) + body + "M30\nEND PGM P " + unit + "\n"


def moves_of(tmp_path, text, setup=SETUP):
    """All moves of a program, which reader and follower have to agree on."""
    path = tmp_path / "p.h"
    path.write_text(text)
    return Moves.joined([b.moves for b in read_twice(Reader(mill(), DIALECTS[KLARTEXT], setup, path))])


def places(moves, start=1):
    return np.round(moves.end_mm[start:], 6).tolist()


LINES = {
    "lines": ("L X+10 Y-5 R0 F100\nL IX+2.5 Z-1\nL IY-1 FMAX M8\n", [[10, -5, 0], [12.5, -5, -1], [12.5, -6, -1]]),
    "arc": ("CC X+10 Y+0\nC X+10 Y-10 DR+ F100\nC IX+10 IY+10 DR+\n", [[10, -10, 0], [20, 0, 0]]),
    "radius": ("CR X+10 Y+10 R+10 DR- F9\nCR X+0 Y+0 R-10 DR+\n", [[10, 10, 0], [0, 0, 0]]),
    "full circle": ("CC IX+10 IY+0\nC X+0 Y+0 DR- F9\n", [[0, 0, 0]]),
    "pole here": ("L X+5 Y+5 F9\nCC\nLP PR+10 PA+90\nLP IPA-90\n", [[5, 5, 0], [5, 15, 0], [15, 5, 0]]),
    "polar": (
        "CC X+0 Y+0\nLP PR+20 PA+30 F9\nLP PA+90\nCP PA+180 DR+\n",
        [[20 * math.cos(math.pi / 6), 10, 0], [0, 20, 0], [-20, 0, 0]],
    ),
    "helix": ("CC X+10 Y+0\nCP IPA+720 IZ-3 DR+ F9\nCP IPA-90 Z-2 DR-\n", [[0, 0, -3], [10, 10, -2]]),
    "arc in ZX": ("CC X+8 Z+0\nCP IPA-90 DR- F9\n", [[8, 0, -8]]),
    "tangent": ("L X+10 F9\nCT X+20 Y+10\nCT X+10 Y+20\n", [[10, 0, 0], [20, 10, 0], [10, 20, 0]]),
    "tangent and polar": ("L X+10 F9\nCC X+10 Y+10\nCTP PR+10 PA+0\n", [[10, 0, 0], [20, 10, 0]]),
    "rounding": ("L X+20 F9\nRND R5\nL Y+20\n", [[15, 0, 0], [20, 5, 0], [20, 20, 0]]),
    "rounding in increments": (
        "L IX+20 F9\nRND R5 F50\nL IY-20\nL IX-1\n",
        [[15, 0, 0], [20, -5, 0], [20, -20, 0], [19, -20, 0]],
    ),
    "chamfer": (
        "L X+20 F9\nCHF 3\nL Y+20\nRND R2\nL X+0\n",
        [[17, 0, 0], [20, 3, 0], [20, 18, 0], [18, 20, 0], [0, 20, 0]],
    ),
    "machine": ("L X-5 Z-7 R0 FMAX M91\nL X+1 Y+1 Z+0 FMAX\n", [[-5, 0, -7], [1, 1, 0]]),
    "shift": (
        "CYCL DEF 7.0 DATUM SHIFT\nCYCL DEF 7.1 X+10\nCYCL DEF 7.2 Y-4\nL X+1 Y+1 F9\nCYCL DEF 7.0\nCYCL DEF 7.1 IX+5\nL X+1\n"
        "TRANS DATUM RESET\nL X+1 Y+1\nTRANS DATUM AXIS Z+3\nL Z+0\n",
        [[11, -3, 0], [16, -3, 0], [1, 1, 0], [1, 1, 3]],
    ),
    "parameters": (
        "FN 0: Q1 = +5\nQ2 = 2 * ( Q1 + 1.5 ) - 3\nFN 4: Q3 = +Q2 DIV +4\nQ4 = 10 * SIN 30 + SQRT 16\n"
        "L X+Q1 Y-Q2 F Q50\nL X+Q3 IY+Q4\n",
        [[5, -10, 0], [2.5, -1, 0]],
    ),
    "subprogram": ("CALL LBL 2\nL Y+3\nCALL LBL 2\nM30\nLBL 2\nL IX+5 F9\nLBL 0\n", [[5, 0, 0], [5, 3, 0], [10, 3, 0]]),
    "repeat": ("LBL 1\nL IX+5 F9\nCALL LBL 1 REP 2/2\nL Y+1\n", [[5, 0, 0], [10, 0, 0], [15, 0, 0], [15, 1, 0]]),
    "repeat in a subprogram": (
        'CALL LBL "A"\nL Y+1\nM30\nLBL "A"\nQ1 = 0\nLBL 3\nQ1 = Q1 + 2\nL X+Q1 F9\nCALL LBL 3 REP 1\nLBL 0\n',
        [[2, 0, 0], [4, 0, 0], [4, 1, 0]],
    ),
}


@pytest.mark.parametrize("name", LINES)
def test_where_sentences_lead(tmp_path, name):
    body, expected = LINES[name]
    np.testing.assert_allclose(places(moves_of(tmp_path, program(body)), 0), [*([[0, 0, 0]]), *expected], atol=2e-6)


def test_inch(tmp_path):
    found = moves_of(tmp_path, program("L X+1 Y-0.5 F9\nCC X+2 Y-0.5\nC X+2 Y-1.5 DR+\n", "INCH"))
    np.testing.assert_allclose(places(found), [[25.4, -12.7, 0], [50.8, -38.1, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("body", "sweep"),
    [
        ("CC X+10 Y+0\nC X+10 Y-10 DR+ F9\n", 90),
        ("CC X+10 Y+0\nC X+10 Y-10 DR- F9\n", -270),
        ("CR X+10 Y+10 R+10 DR+ F9\n", 90),
        ("CR X+10 Y+10 R-10 DR+ F9\n", 270),
        ("CR X+10 Y+10 R-10 DR- F9\n", -270),
        ("CC X+10 Y+0\nCP IPA-765 DR- F9\n", -765),
        ("L X+10 F9\nCT X+10 Y+20\n", 180),
        ("L X+10 F9\nCT X+0 Y+10\n", 270),
        ("L X+20 F9\nRND R5\nL X+0 Y+20\n", 135),
    ],
)
def test_how_far_arcs_turn(tmp_path, body, sweep):
    found = moves_of(tmp_path, program(body))
    assert [round(math.degrees(turn), 6) for turn in found.sweep_rad if turn] == [sweep]


# Holes: where they are, and Z at their depth and after.


def holes_of(moves):
    deep = moves.cutting & (moves.end_mm[:, 2] < moves.start_mm[:, 2])
    return np.round(moves.end_mm[deep], 6).tolist()


HOLES = {
    "M99": (f"{DRILL}L X+5 Y+6 FMAX M99\nL FMAX IX+1 M99\n", [[5, 6, -14], [6, 6, -14]]),
    "CYCL CALL": (f"{DRILL}L X+5 Y+6 FMAX\nCYCL CALL M3\n", [[5, 6, -14]]),
    "M89": (f"{DRILL}L X+5 Y+6 FMAX M89\nL X+7\nL X+8 M99\nL X+9\n", [[5, 6, -14], [7, 6, -14], [8, 6, -14]]),
    "POS": (f"{DRILL}CYCL CALL POS X+5 Y+6 Z+2 FMAX\n", [[5, 6, -12]]),
    "circle of 220": (
        f"{DRILL}CYCL DEF 220 PATTERN ~\n Q216=+10 ~\n Q217=+20 ~\n Q244=+10 ~\n Q245=+0 ~\n Q246=+360 ~\n Q247=+0 ~\n Q241=4 ~\n"
        " Q200=2 ~\n Q203=+0 ~\n Q204=50 ~\n Q301=1\n",
        [[15, 20, -15], [10, 25, -15], [5, 20, -15], [10, 15, -15]],
    ),
    "part of a circle of 220": (
        f"{DRILL}CYCL DEF 220 PATTERN ~\n Q216=+0 ~\n Q217=+0 ~\n Q244=+20 ~\n Q245=+0 ~\n Q246=+90 ~\n Q247=+0 ~\n Q241=2\n",
        [[10, 0, -14], [0, 10, -14]],
    ),
    "grid of 221": (
        f"{DRILL}CYCL DEF 221 PATTERN ~\n Q225=+1 ~\n Q226=+2 ~\n Q237=+10 ~\n Q238=+5 ~\n Q242=2 ~\n Q243=2 ~\n"
        " Q224=+90 ~\n Q200=2\n",
        [[1, 2, -14], [1, 12, -14], [-4, 12, -14], [-4, 2, -14]],
    ),
    "PATTERN DEF": (
        f"{DRILL}PATTERN DEF ~\n POS1( X+5 Y+6 Z+0 ) ~\n ROW1( X+0 Y+0 D+4 NUM2 ROT+90 Z-1 )\nCYCL CALL PAT FMAX M3\n",
        [[5, 6, -14], [0, 0, -15], [0, 4, -15]],
    ),
    "PATTERN DEF, grids and circles": (
        f"{DRILL}PATTERN DEF PAT1( X+1 Y+1 DX+2 DY+3 NUMX2 NUMY1 ROT+0 ) CIRC1( X+0 Y+0 D20 START+0 NUM2 Z+0 ) "
        "PITCHCIRC1( X+0 Y+0 D20 START+90 STEP+90 NUM2 Z+0 ) FRAME1( X+0 Y+0 DX+1 DY+1 NUMX3 NUMY3 ROT+0 )\nCYCL CALL PAT FMAX\n",
        [
            *([x, y, -14] for x, y in ((1, 1), (3, 1), (10, 0), (-10, 0), (0, 10), (-10, 0))),
            *([x, y, -14] for x, y in ((0, 0), (1, 0), (2, 0), (2, 1), (0, 1), (0, 2), (1, 2), (2, 2))),
        ],
    ),
}


@pytest.mark.parametrize("name", HOLES)
def test_holes(tmp_path, name):
    body, expected = HOLES[name]
    found = moves_of(tmp_path, program("L Z+60 FMAX\n" + body))
    np.testing.assert_allclose(holes_of(found), expected, atol=1e-6)


@pytest.mark.parametrize("cycle", [200, 201, 202, 203, 205, 206, 207, 208, 209, 240, 241])
def test_every_cycle_has_its_depth(tmp_path, cycle):
    body = DRILL.replace("200 DRILLING", f"{cycle} X") + "L X+5 Y+6 FMAX M99\nL Z+60 FMAX\n"
    found = moves_of(tmp_path, program("L Z+60 FMAX\n" + body))
    assert holes_of(found) == [[5, 6, -14]]


def test_preset_and_tool_length(tmp_path):
    setup = Setup({"PRESET": (5.0, 0.0, 0.0), "PRESET2": (7.0, 0.0, 0.0)}, {"1": ZERO, "MILL": (0.0, 0.0, 50.0)})
    body = (
        'CYCL DEF 247 DATUM SETTING ~\n Q339=+2 ;NUMBER\nL X+0 FMAX\nTOOL CALL "MILL" Z S9 DL+0.5\nL X+0 Y+0 Z+1 FMAX\n'
    )
    found = moves_of(tmp_path, program(body), setup)
    np.testing.assert_allclose(found.end_mm[[0, 1, -1]], [[5, 0, 0], [7, 0, 0], [7, 0, 51.5]])
    assert found.tool_mm[-1].tolist() == [0.0, 0.0, -50.5]


# Corrected programs.


def corrected(tmp_path, text, setup=SETUP, **errors):
    result, found = run(tmp_path, text, shift(**errors), KLARTEXT, setup)
    return result, re.sub(r"; CORRECTED BY(.|\n)*CLAMPING POSITION\n", "", found)


def test_the_rest_of_the_text_stays(tmp_path):
    """A scale of 0.1 um/mm in X: 100 mm become 99.99. Numbers, comments, order and words that move nothing stay."""
    text = (
        "0  BEGIN PGM P MM\n1 BLK FORM 0.1 Z X+0 Y+0 Z-20\n2 BLK FORM 0.2 X+100 Y+100 Z+0\n3 ; on the~\n Head\n4 * - Contour\n"
        "5 TOOL CALL 1 Z S900\n6 L X+100 Y+0 Z+5 R0 FMAX M3 ; go\n7 CYCL DEF 32.0 TOLERANCE\n8 CYCL DEF 32.1 T0.01\n"
        "9 L IX+100 F500\n10 STOP M8\n11 L Z+50 R0 FMAX\n12 L Z-5 R0 FMAX M91\n13 M30\n14 END PGM P MM\n"
    )
    result, found = corrected(tmp_path, text, slope=0.1)
    assert result.accepted
    assert found == text.replace("X+100 Y+0 Z+5", "X+99.99 Y+0 Z+5").replace("IX+100", "IX+99.99")


def test_without_errors_the_program_is_the_same(tmp_path):
    text = program(
        "L X+10 R0 F100\nCC X+20 Y+0\nC X+30 Y+0 DR+\nCR X+40 Y+0 R+5 DR-\nCC X+40 Y+9\nCP IPA+360 IZ-5 DR+\n"
        + DRILL
        + "L X+5 FMAX M99\n"
    )
    _, found = corrected(tmp_path, text)
    assert found == text


def test_an_arc_gets_its_own_centre(tmp_path):
    """The tool is 10 um too far in X and 20 um in Y everywhere: end and centre move by as much."""
    text = program("L X+10 R0 F100\nCC X+20 Y+0\nC X+30 Y+0 DR+ M8 ; half\nCR X+40 Y+0 R+5 DR-\n")
    result, found = corrected(tmp_path, text, x=10.0, y=20.0)
    assert result.accepted
    assert "CC X+20 Y+0\nCC X+19.99 Y-0.02\nC X+29.99 Y-0.02 DR+ M8 ; half\n" in found
    assert "CR X+39.99 Y-0.02 R+5 DR-" in found or re.search(
        r"CR X\+\d+\.\d+ Y-0\.02 R\+\d.*DR-\nCR X\+39\.99 Y-0\.02 R", found
    )


def random_contour(seed):
    """A program in many words, of which each is drawn at random, and the points that it has to pass."""
    rng = np.random.default_rng(seed)
    at, lines, ends = np.array([0.0, 0.0, 0.0]), [], []

    def text(value):
        return f"{value:+.3f}"

    for _ in range(40):
        to = np.round(at + rng.uniform(-15, 15, 3) * [1, 1, 0.1], 3)
        to[:2] = np.clip(to[:2], -150, 150)
        kind = rng.integers(6)
        if kind == 0:
            lines.append(f"L X{text(to[0])} Y{text(to[1])} Z{text(to[2])} R0 F500")
        elif kind == 1:
            step = round(to[0] - at[0], 3)
            to[0] = at[0] + step
            lines.append(f"L IX{text(step)} Y{text(to[1])} Z{text(to[2])} R0 FMAX")
        elif kind == 2:
            to[2] = at[2]
            radius = round(float(np.hypot(*(to - at)[:2])) * rng.uniform(0.6, 2.0), 3)
            lines.append(
                f"CR X{text(to[0])} Y{text(to[1])} R{text(radius * rng.choice([-1, 1]))} DR{rng.choice(['+', '-'])}"
            )
        elif kind == 3:
            turn = float(np.round(rng.uniform(20, 500), 1))
            centre = np.round(at[:2] + rng.uniform(3, 9, 2), 3)
            left = rng.choice([-1, 1])
            spoke = complex(*(at[:2] - centre)) * np.exp(1j * np.radians(left * turn))
            to[:2] = centre + [spoke.real, spoke.imag]
            sign = "+" if left > 0 else "-"
            lines += [f"CC X{text(centre[0])} Y{text(centre[1])}", f"CP IPA{left * turn:+.1f} Z{text(to[2])} DR{sign}"]
        elif kind == 4:
            pole, radius, angle = (
                np.round(at[:2] + rng.uniform(-9, 9, 2), 3),
                round(rng.uniform(1, 15), 3),
                round(rng.uniform(0, 360), 1),
            )
            to[:2] = pole + radius * np.array([math.cos(math.radians(angle)), math.sin(math.radians(angle))])
            to[2] = at[2]
            lines += [f"CC X{text(pole[0])} Y{text(pole[1])}", f"LP PR{text(radius)} PA{angle:+.1f} F300"]
        else:
            lines.append(f"L X{text(to[0])} Y{text(to[1])} F700 M8")
            to[2] = at[2]
        at = to
        ends.append(to.tolist())
    return program("\n".join(f"{k} {line}" for k, line in enumerate(lines, 3)) + "\n"), ends


@pytest.mark.parametrize("seed", range(6))
def test_random_contours(tmp_path, seed):
    """Reader and follower pass the points that the generator knows; the corrected program passes the corrected ones."""
    text, ends = random_contour(seed)
    np.testing.assert_allclose(places(moves_of(tmp_path, text)), ends, atol=2e-5)
    result, found = corrected(tmp_path, text, slope=0.5, y=30.0)
    assert result.accepted, result.reasons
    assert result.after.largest_mm < 3e-3 < result.before.largest_mm
    again = moves_of(tmp_path, found)
    for x, y, z in ends:  # X = c + 0.0005 c, Y = c + 0.03, in that order of the program
        assert np.min(np.abs(again.end_mm - [x / 1.0005, y - 0.03, z]).max(axis=1)) < 4e-4


def test_patterns_and_calls_are_written_out(tmp_path):
    body = f"L Z+60 FMAX\n{DRILL}PATTERN DEF POS1( X+100 Y+6 Z+0 )\nCYCL CALL PAT FMAX\nL Z+60 FMAX\n"
    body += "CALL LBL 1\nM30\nLBL 1\nL X+100 F9\nLBL 0\n"
    result, found = corrected(tmp_path, program(body), slope=0.1)
    assert result.accepted
    assert "; CYCL CALL PAT FMAX\nL X+99.99 Y+6 R0 FMAX M99\n" in found
    assert "; CALL LBL 1\nL X+99.99 F9\n; LBL 0\n" in found
    assert "; L X+100 F9" in found  # the subprogram itself, which is called no more
    assert not re.search(r"^(?!;).*(LBL|PATTERN)", found, re.MULTILINE)


REFUSED = [
    ("X+10 R+ F100", 4, "is not known in Klartext"),
    ("X+10 R- F100", 4, "is not known in Klartext"),
    ("L X+1\nAPPR LT X+1 Y+1 LEN5 RL", 5, "APPR"),
    ("CYCL DEF 251 POCKET ~\n Q215=0", 4, "cycle 251"),
    ("CYCL DEF 204 BACK ~\n Q200=2", 4, "cycle 204"),
    ("CYCL DEF 1.0 PECKING", 4, "cycle 1"),
    ("CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+35", 5, "cycle 10"),
    ("CYCL DEF 8.0 MIRROR\nCYCL DEF 8.1 X", 5, "cycle 8"),
    ("CYCL DEF 7.0\nCYCL DEF 7.1 #5", 5, "table"),
    ("L X+Q7 F9", 4, "Q7"),
    ("FN 18: SYSREAD Q5 = ID210\nL X+Q5", 5, "Q5"),
    ("FN 9: IF +Q1 EQU +1 GOTO LBL 5", 4, "FN 9"),
    ("CALL LBL 9", 4, "LBL 9"),
    ("CALL PGM TNC:\\A.H", 4, "another program"),
    ("TCH PROBE 410 DATUM\nL X+5 F9", 5, "position of X is not known"),
    ("PLANE SPATIAL SPA+0 SPB+10 SPC+0 STAY", 4, "plane"),
    ("FUNCTION TCPM F TCP", 4, "TCPM"),
    ("FC DR- R5", 4, "FK"),
    ("TOOL CALL 2 Z S9", 4, "length of tool 2"),
    ("TOOL CALL 1 Y S9", 4, "tool axis"),
    ("L X+5 M128", 4, "M128"),
    ("C X+5 Y+5", 4, "DR"),
    ("CP IPA+90 DR-", 4, "pole|sign"),
    ("L X+5 Q+7", 4, "cannot be read"),
    ("CT X+5 Y+5", 4, "CT needs"),
    ("L X+10\nRND R20\nL Y+10", 5, "RND needs"),
    ("RND R5", 4, "RND"),
    ("HOLD X+5", 4, "not known"),
    ("L FMAX M99", 4, "none is defined"),
    ("LP PR+5 PA+0", 4, "pole"),
    ("L X+5,5", 4, "cannot be read"),
    (f"{DRILL}Q201 = -30\nL X+5 M99", 10, "number of the cycle"),
    ("L A+10 F100", 4, "rotary|turn"),
    ("SPL X+5", 4, "spline"),
    ("LBL 4\nLBL 4\nCALL LBL 4", 5, "twice"),
    ("CC X+0 Y+5\nL X+1\nL M140 MB MAX\nL X+5 F9", 7, "position of Z"),
]


@pytest.mark.parametrize(("body", "line", "words"), REFUSED)
def test_what_is_not_followed_is_refused_with_its_line(tmp_path, body, line, words):
    with pytest.raises(InputError, match=words) as refused:
        moves_of(tmp_path, program(body + "\n"))
    assert refused.value.line == line


def test_a_cut_program_is_refused(tmp_path):
    with pytest.raises(InputError, match="may have been cut"):
        moves_of(tmp_path, START + "L X+5 F9\n")


def test_a_label_without_end_of_calls_is_refused(tmp_path):
    with pytest.raises(InputError, match="depth"):
        moves_of(tmp_path, program("LBL 1\nL IX+1 F9\nCALL LBL 1\n"))


#: A rounding beside arcs: what leads to the corner in (20, 0), its radius, and what leads away; all in X and Y.
BESIDE_ARCS = {
    "line, arc": ("L X+20 Y+0 F9", 2, "CC X+30 Y+0\nC X+30 Y+10 DR-"),
    "line, arc to the right": ("L X+20 Y+0 F9", 1, "CC X+28 Y-6\nC X+38 Y-6 DR+"),
    "arc, line": ("CC X+10 Y+0\nC X+20 Y+0 DR- F9", 1.5, "L X+30 Y+5"),
    "arc, arc": ("CC X+10 Y+0\nC X+20 Y+0 DR+ F9", 2, "CC X+32 Y+9\nC X+32 Y+24 DR-"),
    "by radius": ("CR X+20 Y+0 R+15 DR- F9", 2, "CR X+40 Y+0 R+12 DR-"),
    "by radius, the long way": ("CR X+20 Y+0 R-15 DR+ F9", 2, "CR X+40 Y+0 R-12 DR+"),
    "polar": ("CC X+10 Y+0\nCP PA+0 DR- F9", 1, "CC X+20 Y+8\nCP IPA+90 DR+"),
    "inside": ("CC X+10 Y+0\nC X+20 Y+0 DR- F9", 1, "L X+0 Y-3"),
}  # fmt: skip


def directions(moves, k):
    """Direction of the tool at the start and at the end of a move in X and Y."""
    start, end, centre = (complex(*place[k, :2]) for place in (moves.start_mm, moves.end_mm, moves.centre_mm))
    sweep = moves.sweep_rad[k]
    ways = [1j * np.sign(sweep) * (place - centre) if sweep else end - start for place in (start, end)]
    return [way / abs(way) for way in ways]


@pytest.mark.parametrize("case", BESIDE_ARCS)
@pytest.mark.parametrize("unit", ["MM", "INCH"])
def test_a_rounding_beside_an_arc_touches_both(tmp_path, case, unit):
    """The arc has the radius, no move has a kink, and both moves stay on their curves; reader and follower agree."""
    first, radius, last = BESIDE_ARCS[case]
    scale = 25.4 if unit == "INCH" else 1.0
    setup = Setup({"PRESET": ZERO}, {"1": ZERO})
    machine_text = program(f"{first}\nRND R{radius}\n{last}\n", unit)
    if unit == "INCH":  # within the travel
        machine_text = re.sub(r"([XYR])([+-]?)(\d[\d.]*)", lambda w: f"{w[1]}{w[2]}{float(w[3]) / 10:g}", machine_text)
        machine_text, scale = machine_text.replace("R0 FMAX", "FMAX"), 2.54
    sharp = moves_of(tmp_path, re.sub(r"RND.*\n", "", machine_text), setup)
    moves = moves_of(tmp_path, machine_text, setup)
    a, corner, b = len(moves) - 3, len(moves) - 2, len(moves) - 1
    assert abs(abs(complex(*(moves.start_mm - moves.centre_mm)[corner, :2])) - radius * scale) < 1e-6
    for one, two in ((a, corner), (corner, b)):
        assert abs(directions(moves, one)[1] - directions(moves, two)[0]) < 1e-6
    for k, own in ((a, len(sharp) - 2), (b, len(sharp) - 1)):
        assert np.allclose(moves.centre_mm[k], sharp.centre_mm[own], atol=1e-6, equal_nan=True)
        assert abs(moves.sweep_rad[k]) <= abs(sharp.sweep_rad[own]) + 1e-9
    assert np.allclose(moves.start_mm[a], sharp.start_mm[-2], atol=1e-6)
    assert np.allclose(moves.end_mm[b], sharp.end_mm[-1], atol=1e-6)


def test_a_rounding_between_a_line_and_an_arc_by_hand(tmp_path):
    """Its centre is 2 above the line and 12 from the centre of the arc: X 30 - sqrt(140)."""
    x = 30 - math.sqrt(140)
    found = places(moves_of(tmp_path, program("L X+20 F9\nRND R2\nCC X+30 Y+0\nC X+30 Y+10 DR-\n")))
    assert np.allclose(found, [[x, 0, 0], [30 - math.sqrt(140) * 10 / 12, 20 / 12, 0], [30, 10, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("L X+20 F9\nRND R60\nCC X+30 Y+0\nC X+30 Y+10 DR-\n", "than there is|no arc"),
        ("L X+20 F9\nCHF 2\nCC X+30 Y+0\nC X+30 Y+10 DR-\n", "two straight moves"),
        ("L X+20 F9\nRND R2\nCC X+30 Y+0\nCP IPA-90 IZ+5 DR-\n", "X and Y"),
        ("L X+0 F9\nRND R2\nCC X+30 Y+0\nC X+60 Y+0 DR-\n", "leads nowhere"),
        ("L X+20 F9\nRND R2\nCC X+20 Y+0\nC X+30 Y+0 DR-\n", "0.0000 and 10.0000 from"),
        ("L X+20 F9\nRND R2\nCC X+30 Y+0\nC X+30 Y+11 DR-\n", "10.0000 and 11.0000 from"),
        ("L X+20 F9\nRND R2\nTCH PROBE 410\nL X+30\n", "else than a move"),
        ("L X+20 F9\nRND R2\nCC X+20 Y-10\nC X+10 Y-10 DR+\n", "turns back"),
    ],
)
def test_a_rounding_that_does_not_fit_is_refused(tmp_path, body, words):
    with pytest.raises(InputError, match=words):
        moves_of(tmp_path, program(body))


def test_a_program_with_roundings_beside_arcs_is_corrected(tmp_path):
    """10 um in X: every X is 0.01 less, with the roundings as arcs of the same radius; comments and blocks stay in order."""
    body = "4 L X+20 Y+0 F9\n5 RND R2 ;corner\nCC X+30 Y+0\n6 C X+30 Y+10 DR- F12\n7 RND R1\n8 L X+60 Y+12 ;out\n"
    result, text = run(tmp_path, program(body), shift(x=10.0), KLARTEXT, SETUP)
    assert result.accepted
    assert result.after.worst_mm < 2e-4
    assert (
        text.index("RND R2 ;corner")
        < text.index("CR X")
        < text.index("; C X+30")
        < text.index("RND R1")
        < text.index(";out")
    )
    assert "F12" in text
