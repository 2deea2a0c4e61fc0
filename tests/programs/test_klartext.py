"""Klartext of HEIDENHAIN: what each sentence does, by hand; corrected programs, by a generator that knows its path; refusals."""

import math
import re

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import run, shift

from compgen.data.error_table import Curve, ErrorTable
from compgen.errors import InputError
from compgen.programs import Reader, Setup
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import read_twice
from compgen.programs.path import CONTOUR, ENTRY, EXIT, FEED, PLAIN, RAPID, Moves

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


# Approaches, departures and turned coordinates.


@pytest.mark.parametrize(
    "way", ["LT X+10 Y+20 LEN7", "LN X+10 Y+20 LEN7", "CT X+10 Y+20 CCA90 R+6", "LCT X+10 IY+20 R6"]
)
@pytest.mark.parametrize("side", ["RL", "RR", "R0", ""])
def test_an_approach_leads_to_the_contour_and_its_path_stays(tmp_path, way, side):
    """The tool is 10 um too far in X and 20 in Y: the first point of the contour goes by as much, LEN, CCA, R and F stay."""
    body = f"L X-9 Y+0 Z+2 R0 FMAX\nAPPR {way} Z-3 {side} F300 M8 ; to it\nL Y+60\nL X+50\nDEP LT LEN20 F900\nL Z+50 R0 FMAX\n"
    setup = Setup({"PRESET": ZERO}, {"1": ZERO}, radii_mm={"1": 4.0})
    moves = moves_of(tmp_path, program(body), setup)
    assert places(moves, 2)[:3] == [[10, 20, -3], [10, 60, -3], [50, 60, -3]]
    assert moves.phase[2:6].tolist() == ([PLAIN] * 4 if side in ("R0", "") else [ENTRY, CONTOUR, CONTOUR, EXIT])
    assert moves.kind[2] == RAPID and np.isnan(moves.end_mm[5, :2]).all()
    result, found = corrected(tmp_path, program(body), setup, x=10.0, y=20.0)
    assert result.accepted
    word = way.replace("X+10", "X+9.99").replace(" Y+20", " Y+19.98")  # an increment from a corrected place stays
    assert f"APPR {word} Z-3 {side} F300 M8 ; to it\nL Y+59.98\nL X+49.99\nDEP LT LEN20 F900\nL Z+50 R0 FMAX\n" in found


def test_departures_and_what_follows_them(tmp_path):
    """DEP LCT says where it ends; where the others do only the control knows: a line from there is not judged."""
    for way, end in (("DEP LCT X+60 Y+70 R5", [60, 70, 0]), ("DEP CT CCA90 R-4", None), ("DEP LN LEN+8", None)):
        moves = moves_of(tmp_path, program(f"APPR LT X+5 Y+5 LEN4 R0 F9\nL X+40\n{way}\nL Z+5\nL X+1 Y+2\nL X+3\n"))
        assert (places(moves, 3)[0] == end) == (end is not None)
        assert moves.kind[4:].tolist() == ([FEED] * 3 if end else [RAPID, RAPID, FEED])
        assert places(moves, 5) == [[1, 2, 5], [3, 2, 5]]


def test_polar_approaches_become_those_in_x_and_y(tmp_path):
    body = "CC X+10 Y+10\nAPPR PLCT PR+20 PA+90 R3 RR F9 ; up\nL X+40\nDEP PLCT PR+50 PA+0 R3 F8\nL Z+5 FMAX\n"
    setup = Setup({"PRESET": ZERO}, {"1": ZERO}, stated_radii_mm={"": 2.0})
    moves = moves_of(tmp_path, program(body), setup)
    assert places(moves) == [[10, 30, 0], [40, 30, 0], [60, 10, 0], [60, 10, 5]]
    _, found = corrected(tmp_path, program(body), setup, x=10.0)
    assert "APPR LCT X+9.99 Y+30 R3 RR F9 ; up\nL X+39.99\nDEP LCT X+59.99 Y+10 R3 F8\n" in found


TURNABLE = {
    **{
        name: body
        for name, (body, _) in LINES.items()
        if "Z" not in name and "M30" not in body and "DEF 7" not in body and "M91" not in body
    },
    "roundings": "L X+50 Y+1 F9\nRND R5 F3\nL Y+30\nRND R2\nCC X+20 Y+30\nC X+20 Y+60 DR+ M8\nRND R3\nL X+0\nCHF 2\nL Y+1\n",
    "helix with absolute angle": "L X+20 F9\nCC X+10 Y+0\nCP PA+200 Z-5 DR-\nCP PA+200 IZ+2 DR+\n",
    "holes": f"{DRILL}L X+7 Y+8 FMAX M99\nL IX+9 M99\n"
    "PATTERN DEF POS1 (X+1 Y+2 Z+1) CIRC1 (X+9 Y+9 D30 START+10 NUM4 Z+0)\nCYCL CALL PAT\n"
    "CYCL CALL POS X+3 Y+4 Z+0 FMAX\n",
    "calls": "LBL 1\nL IX+5 F9\nL IY+2\nCALL LBL 1 REP 3\nL Z+5\n",
    "approaches": "APPR LT X+10 Y+20 LEN7 RL F9\nL Y+60\nRND R9\nL X+50\nDEP LCT X+90 Y+70 R5\n"
    "CC X+9 Y+9\nAPPR PCT PR+5 PA+9 CCA9 R4 R0\nL X+70\n",
    "compensated": "L X+10 Y+5 RR F9\nL X+40\nCR X+60 Y+25 R+20 DR+\nL Y+60\nL X+90 R0\n",
}
#: What turns the coordinates, with the angle in the end and the words that turn them back.
TURNS = {
    "CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+30\n": (30.0, "CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+0\n"),
    "TRANS ROTATION ROT-75\nTRANS ROTATION IROT+15.5\n": (-59.5, "TRANS ROTATION RESET\n"),
    "PLANE SPATIAL SPA+0 SPB+0 SPC+90 STAY COORD ROT\n": (90.0, "PLANE RESET STAY\n"),
}


@pytest.mark.parametrize("name", TURNABLE)
@pytest.mark.parametrize("turn", TURNS)
def test_turned_coordinates_lead_where_the_turned_path_does(tmp_path, name, turn):
    """The moves of a program, turned about the datum, are those of the program in turned coordinates; then it is turned back."""
    angle, back = TURNS[turn]
    setup = Setup({"PRESET": (3.0, -4.0, 0.0)}, {"1": ZERO}, radii_mm={"1": 2.0})
    shift = "CYCL DEF 7.0 DATUM SHIFT\nCYCL DEF 7.1 X+5\nCYCL DEF 7.2 Y+7\n"
    body = TURNABLE[name] + "L X+1 Y+2 Z+9 R0 FMAX\n"
    straight = moves_of(tmp_path, program(f"{shift}L X+0 Y+0 FMAX\n{body}"), setup)
    turned = moves_of(
        tmp_path, program(f"{shift}{turn}L X+0 Y+0 FMAX\n{body}{back}L X+4 Y+4 FMAX\nL X+4.5 F9\n"), setup
    )
    assert len(turned) == len(straight) + 2
    zero, way = complex(8.0, 3.0), np.exp(1j * math.radians(angle))
    for which in ("end_mm", "centre_mm"):
        there, here = getattr(turned, which)[1:-2], getattr(straight, which)[1:]
        expected = zero + (here[:, 0] + 1j * here[:, 1] - zero) * way
        np.testing.assert_allclose(there[:, 0] + 1j * there[:, 1], expected, atol=2e-7)
        np.testing.assert_allclose(there[:, 2], here[:, 2], atol=1e-9)
    np.testing.assert_allclose(turned.sweep_rad[1:-2], straight.sweep_rad[1:], atol=1e-9)
    assert (turned.kind[:-2] == straight.kind).all() and (turned.phase[:-2] == straight.phase).all()
    assert turned.end_mm[-1].tolist() == [12.5, 7.0, 9.0]


def test_a_corrected_program_in_turned_coordinates(tmp_path):
    """Cycle 10 becomes a comment; PLANE stays without its angle, since it draws the tool back."""
    body = "CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+90\nL X+10 Y+0 F100\nL X+20 ; out\n"
    body += "CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+0\n"
    body += (
        "PLANE SPATIAL SPA+0 SPB+0 SPC-90 TURN MB MAX FMAX\nL X+0 Y+5 FMAX\nL Z-1 FMAX\nL X+8 F50\nPLANE RESET STAY\n"
    )
    result, found = corrected(tmp_path, program(body), x=10.0, y=20.0)
    assert result.accepted
    assert (
        "; CYCL DEF 10.0 ROTATION\n; CYCL DEF 10.1 ROT+90\nL X-0.01 Y+9.98 F100\nL X-0.01 Y+19.98 ; out\n; CYCL"
        in found.replace("L Y+19.98", "L X-0.01 Y+19.98")
    )
    assert (
        "PLANE SPATIAL SPA+0 SPB+0 SPC+0 TURN MB MAX FMAX\nL X+4.99 Y-0.02 FMAX\nL Z-1 FMAX\n"
        "L X+4.99 Y-8.02 F50\nPLANE RESET STAY\n" in found
    )
    assert "PLANE leaves the rotary axes where the errors were measured" in result.assumed
    unturned = program("CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+0\nTRANS ROTATION RESET\nL X+5 F9\n")
    assert corrected(tmp_path, unturned)[1] == unturned


# What programs of others have.

FOLLOWED = {
    "a slash before the number": ("/ 13 L X+5 F9\n/7 L X+6 M8\n15 / L X+7\n", [[5, 0, 0], [6, 0, 0], [7, 0, 0]]),
    "a full circle without its end": ("CC X+5 Y+0\nC DR+ F9\nC DR-\n", [[0, 0, 0], [0, 0, 0]]),
    "codes alone": ("L X+5 F9\nL M8\nL M3\nL R0\nL Y+1\n", [[5, 0, 0], [5, 1, 0]]),
    "a loop": ("Q1 = 2\nLBL 1\nL IX+Q1 F9\nFN 1: Q1 = +Q1 + +1\nFN 12: IF +Q1 LT +4.5 GOTO LBL1\nL Y+1\n",
               [[2, 0, 0], [5, 0, 0], [9, 0, 0], [9, 1, 0]]),
    "a part that is left out": ('FN 0: Q1 = +5\nFN9: IF +Q1 EQU 5 GOTO LBL "end"\nL X+50 F9\nLBL "end"\nL Y+1 F9\n', [[0, 1, 0]]),
    "a jump that is not made": ('FN 10: IF 2 NE 2 GOTO LBL "end"\nL X+50 F9\nLBL "end"\nL Y+1 F9\n', [[50, 0, 0], [50, 1, 0]]),
    "messages": ("FN 15: PRINT 20\nFN 14: ERROR = 1000\nCYCLE DEF 9.0 DWELL TIME\nCYCLE DEF 9.1 5\nL X+5 F9\n", [[5, 0, 0]]),
}  # fmt: skip


@pytest.mark.parametrize("name", FOLLOWED)
def test_what_programs_of_others_have(tmp_path, name):
    body, ends = FOLLOWED[name]
    assert places(moves_of(tmp_path, program(body))) == ends
    result, found = corrected(tmp_path, program(body), x=10.0)
    assert result.accepted
    assert all(
        line.strip() in found
        for line in body.splitlines()
        if line.startswith((";", "CYCLE", "FN 1", "L M")) and "IF" not in line
    )


def test_a_part_that_a_jump_leaves_out_stays_as_comments(tmp_path):
    body = "Q1 = 5\nFN 9: IF +Q1 EQU +5 GOTO LBL 2 ; on\nL X+50 F9 ; not\nLBL 2\nL Y+1 F9\n"
    _, found = corrected(tmp_path, program(body), x=10.0)
    assert "Q1 = 5\n; FN 9: IF +Q1 EQU +5 GOTO LBL 2 ; on\n; L X+50 F9 ; not\n; LBL 2\nL Y+1 F9\n" in found


def test_pieces_of_a_block_with_a_slash_have_one(tmp_path):
    errors = ErrorTable({"EYX": Curve(np.array([-600.0, 50.0, 600.0]), np.array([0.0, 0.02, 0.0]), np.zeros(3))})
    for head in ("/ 13 ", "13 /", "/"):
        text = program(f"L X-100 FMAX\n{head}L X+200 F9\n")
        _, found = run(tmp_path, text, errors, KLARTEXT, SETUP)
        pieces = [line for line in found.splitlines() if re.search(r"L X\+[1-9]", line)]
        assert len(pieces) == 3 and all("/" in line for line in pieces)
        skipped = Setup(SETUP.work_offsets_mm, SETUP.tools_mm, skip_deleted=True)
        assert places(moves_of(tmp_path, found.replace("CORRECTED BY VOLCOMP", ""), skipped))[-1][0] == pytest.approx(
            -100, abs=0.1
        )


@pytest.mark.parametrize("number", [1, 2, 17])
@pytest.mark.parametrize("clearance", ["ABST 2", "SET UP -2", "DIST+2.000"])
def test_cycles_before_200_count_from_where_the_tool_is(tmp_path, number, clearance):
    """From Z 3 by 2 to the surface at 1, 10 into it: the depth is -9, and the tool goes back to 3."""
    more = {
        1: "CYCL DEF 1.3 ZUSTLG 5\nCYCL DEF 1.4 V.ZEIT 0.1\nCYCL DEF 1.5 F100\n",
        2: "CYCL DEF 2.3 V.ZEIT 0\nCYCL DEF 2.4 F90\n",
    }
    define = f"CYCL DEF {number}.0 CYCLE\n7 CYCL DEF {number}.1 {clearance}\nCYCL DEF {number}.2 TIEFE -10\n"
    define += more.get(number, "CYCL DEF 17.3 STEIGUNG+1\n")
    body = f"L Z+3 FMAX\n{define}L X+7 Y+8 FMAX M99\nL X+9 FMAX\nCYCL CALL\n"
    moves = moves_of(tmp_path, program(body))
    deep = moves.part(np.flatnonzero(moves.cutting & (moves.end_mm[:, 2] < moves.start_mm[:, 2])))
    assert places(deep, 0) == [[7, 8, -9], [9, 8, -9]]
    assert moves.end_mm[-1].tolist() == [9, 8, 3]
    result, found = corrected(tmp_path, program(body), x=10.0, z=30.0)
    assert result.accepted
    assert "L X+6.99 Y+8 Z+2.97 FMAX M99" in found.replace(" Z+2.97 ", " Z+2.97 ") or "L X+6.99 Y+8 FMAX M99" in found


@pytest.mark.parametrize("way", ["L M140 MB MAX\nL Z+0 FMAX M91\n", "M140 MB MAX\nL Z+0 FMAX M91\n"])
def test_increments_after_m140_count_from_where_the_tool_is(tmp_path, way):
    """M140 leads along Z alone: X and Y stay where the corrected block before has led."""
    result, found = corrected(tmp_path, program(f"{way}L IY+3 F9\nL IX+2\n"), x=10.0, y=20.0, slope=0.1)
    assert result.accepted, result.reasons
    assert re.search(r"L IY\+3 (?:IX\S+ )?F9\nL IX\+1\.999\d*\n", found)


def test_the_height_after_dep_is_the_one_that_was_written(tmp_path):
    body = "APPR LT X+5 Y+5 LEN4 R0 F9\nL X+40\nDEP LT LEN5\nL IZ+7\nL X+1 Y+2\nL X+3\n"
    result, found = corrected(tmp_path, program(body), x=10.0, z=30.0)
    assert result.accepted, result.reasons
    assert "DEP LT LEN5\nL IZ+7\nL X+0.99 Y+2" in found


REFUSED = [
    ("X+10 R+ F100", 4, "is not known in Klartext"),
    ("X+10 R- F100", 4, "is not known in Klartext"),
    ("L X+1\nAPPR LT X+1 Y+1 RL", 5, "APPR LT: expected X or Y and LEN"),
    ("APPR CT X+1 Y+1 CCA90 RL", 4, "CCA and R"),
    ("APPR CT X+1 Y+1 R5 RL", 4, "CCA and R"),
    ("APPR LCT R5 RL", 4, "X or Y and R"),
    ("APPR LX X+1 Y+1 LEN5 RL", 4, "APPR LX"),
    ("DEP LT X+5 LEN5", 4, "DEP LT: expected LEN"),
    ("DEP CT CCA90", 4, "CCA and R"),
    ("DEP LCT R4", 4, "X or Y and R"),
    ("L X+5 LEN5", 4, "belong to APPR"),
    ("APPR PLT PA+10 LEN5 RL", 4, "pole"),
    ("CC X+0 Y+0\nAPPR PLT PA+10 LEN5 RL", 5, "PR"),
    ("L X+9 Y+9\nAPPR LT X+9 Y+9 LEN4 RL F9\nL X+20", 5, "where the tool is"),
    ("L X+9 RL F9\nL X+20\nAPPR LT X+30 Y+9 LEN4 RL F9\nL X+40", 6, "while RL is active"),
    ("L X+9 F9\nRND R2\nDEP LT LEN5", 6, "behind RND"),
    ("APPR LT X+9 Y+9 LEN4 F9\nL X+20\nDEP LT LEN5\nCC X+0 Y+0\nC X+5 Y+5 DR+", 8, "position"),
    ("APPR LT X+9 Y+9 LEN4 F9\nL X+20\nDEP LT LEN5\nL IX+5", 7, "increment"),
    ("CYCL DEF 251 POCKET ~\n Q215=0", 4, "cycle 251"),
    ("CYCL DEF 204 BACK ~\n Q200=2", 4, "cycle 204"),
    ("CYCL DEF 3.0 SLOT", 4, "cycle 3"),
    ("CYCL DEF 1.0 PECKING\nCYCL DEF 1.1 SET UP 2\nL X+5 M99", 6, "P02"),
    ("CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+Q9", 5, "Q9"),
    ("CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+35\nCYCL DEF 7.0\nCYCL DEF 7.1 X+5", 7, "turned"),
    ("CYCL DEF 10.0 ROTATION\nCYCL DEF 10.1 ROT+35\nCYCL DEF 247 DATUM Q339=+1", 6, "turned"),
    ("TRANS ROTATION ROT+35\nTRANS DATUM AXIS X+5", 5, "turned"),
    ("TRANS ROTATION ROT+35\nCC X+0 Z+5\nC X+5 Z+5 DR+", 5, "turned"),
    ("TRANS ROTATION ROT+35\nCR X+5 Y+5 Z+5 R9 DR+", 5, "turned"),
    ("L X+9 F9\nRND R2\nTRANS ROTATION ROT+35\nL Y+9", 6, "behind RND"),
    ("TCH PROBE 410 DATUM\nTRANS ROTATION ROT+35\nL X+5", 6, "together"),
    ("TRANS ROTATION ROT+9\nCC\nCP IPA+90 DR+", 6, "not in it"),
    ("TRANS ROTATION ROT+9\nC X+5 Y+5 DR+", 5, "pole"),
    ("PLANE SPATIAL SPA+0 SPB+0 SPC+30 TURN FMAX TABLE ROT", 4, "TABLE ROT"),
    ("PLANE SPATIAL SPB+0 SPC+30 STAY", 4, "PLANE"),
    ("PLANE VECTOR BX0.8 BY-0.4 BZ-0.4 NX0.2 NY0.2 NZ0.9 STAY", 4, "PLANE"),
    ("PLANE RELATIV SPC+10 STAY", 4, "PLANE"),
    ("PLANE SPATIAL SPA+0 SPB+0 SPC+0 MOVE DIST5 F9\nL X+5 F9", 5, "position of X is not known|position of Y"),
    ("PLANE RESET TURN MB MAX FMAX\nL X+5 Y+5 FMAX\nL X+6 F9", 6, "position of Z"),
    ("CYCL DEF 8.0 MIRROR\nCYCL DEF 8.1 X", 5, "cycle 8"),
    ("CYCL DEF 7.0\nCYCL DEF 7.1 #5", 5, "table"),
    ("L X+Q7 F9", 4, "Q7"),
    ("FN 18: SYSREAD Q5 = ID210\nL X+Q5", 5, "Q5"),
    ("FN 9: IF +Q1 EQU +1 GOTO LBL 5", 4, "jump"),
    ("FN 18: SYSREAD Q5 = ID210\nFN 11: IF Q5 GT 3 GOTO LBL 5\nLBL 5", 5, "jump"),
    ("FN 9: IF +1 EQU +1 GOTO LBL 5", 4, "label is not in this program"),
    ("LBL 1\nFN 10: IF +1 NE +2 GOTO LBL 1", 5, "never end"),
    ("CALL LBL 9", 4, "LBL 9"),
    ("CALL PGM TNC:\\A.H", 4, "another program"),
    ("TCH PROBE 410 DATUM\nL X+5 F9", 5, "position of X is not known"),
    ("PLANE SPATIAL SPA+0 SPB+10 SPC+0 STAY", 4, "PLANE"),
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
