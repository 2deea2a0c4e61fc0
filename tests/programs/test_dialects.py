"""Constructs that programs of CAM systems contain, in each dialect: followed to the digit, or passed through."""

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import PLAIN, moves_of, run, shift

from compgen.data.error_table import Curve, ErrorTable
from compgen.errors import InputError
from compgen.programs import Reader, Setup, model_of, predict_part
from compgen.programs.dialects import DIALECTS
from compgen.tables.options import PROGRAM_STEP_MM, PROGRAM_STEPS_MM

ZERO = (0.0, 0.0, 0.0)
TOOLS = {"1": ZERO, "MILL 10": ZERO}


def followed(tmp_path, dialect, text, expected, setup=None, **errors):
    """The blocks of a corrected program that are not those of the original, and its result; the rest is the same."""
    setup = setup or Setup({"G54": ZERO, "PRESET": ZERO}, TOOLS)
    result, corrected = run(tmp_path, text, shift(**errors), dialect, setup)
    lines, more = corrected.splitlines(), len(corrected.splitlines()) - len(text.splitlines())
    head = next(k for k, line in enumerate(lines) if "CORRECTED BY" in line)
    del lines[head : head + more]
    changed = [new for new, old in zip(lines, text.splitlines(), strict=True) if new != old]
    assert changed == expected
    assert result.accepted
    assert result.after.largest_mm < 1e-3
    unchanged, same = run(tmp_path, text, shift(), dialect, setup)
    assert (same, unchanged.accepted) == (text, True)
    return result


# A scale error of 0.1 um/mm in X: what is written tells where the machine was thought to be.


def test_fanuc_local_shift_smoothing_and_a_rotary_axis_that_rests(tmp_path):
    """G52 counts from the work offset and replaces itself; G5.1, G8, G187, G103 take the words of their block."""
    result = followed(
        tmp_path,
        "fanuc",
        "%\n<PLATE>\nG21 G90 G17 G40 G49 G80 G94;\nG5.1 Q1 R5;\nG8 P1\nG187 P2 E0.02\nG103 P1\nN10020 G0 G54 X200. Y-.5 A0.;\n"
        "G43 H1 Z5. M8;\nG52 X100. Y50.;\nG1 X0. Y0. Z-1. F200. A0.;\nX100.;\nG52 X-100.;\nX300.;\nG52 X0. Y0.;\nX200.;\n"
        "G5.1 Q0;\nG91 G28 Z0. A0.;\nG90 G53 G0 X0. Y0.;\nM30;\n%\n",
        [
            "N10020 G0 G54 X199.98 Y-.5 A0.;",
            "G1 X-0.01 Y0. Z-1. F200. A0.;",
            "X99.98;",
            "X299.98;",
            "X199.98;",
        ],
        slope=0.1,
    )
    assert "the rotary axis A stays at 0 deg, where the errors were measured" in result.assumed


@pytest.mark.parametrize(("code", "name"), [("G54 P3", "G54.1P3"), ("G154 P12", "G154P12"), ("G110", "G110")])
def test_further_work_offsets_of_fanuc_and_haas(tmp_path, code, name):
    text = f"%\nO1\nG21 G90 G17 {code}\nG0 X0. Y0. Z0.\nG1 X10. F9\nM30\n%\n"
    setup = Setup({name: (190.0, 0.0, 0.0)})
    followed(tmp_path, "fanuc", text, ["G0 X-0.019 Y0. Z0.", "G1 X9.98 F9"], setup, slope=0.1)


def test_g92_ends_the_local_shift_of_its_axes(tmp_path):
    """At the machine position 100, X becomes 0: the zero is at 100 whatever G52 was."""
    moves = moves_of(
        "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG52 X40. Y7.\nG0 X60. Y0.\nG92 X0.\nG0 X5. Y1.\nM30\n", "fanuc", PLAIN
    )
    assert moves.end_mm[-1].tolist() == [105.0, 8.0, 0.0]


SIEMENS = """%_N_PLATE_MPF
;$PATH=/_N_WKS_DIR/_N_PLATE_WPD
GROUP_BEGIN(0,"HEAD (1)",0,0)
WORKPIECE(,"",,"BOX",112,0,-20,-80,0,0,100,100)
N10 G17 G71 G90 G94 G54 ; start
N20 T="MILL 10" M6 D1
CYCLE832(0.01,_FINISH,1)
G642 FFWON SOFT COMPCAD UPATH ORIAXES DYNFINISH FNORM FLIN FGROUP(X,Y,Z)
N30 S1=5000 M1=3 SPOS[2]=ACN(90) CTOL=0.02
START:
CYCLE800()
N40 G0 X=200 Y=0 Z=AC(5)
TRANS X100 Y50
N50 G1 X0 Y0 Z-2 F200
ATRANS X50 Z1
N60 X=AC(50) Y=IC(-10)
N70 G2 X=IC(20) I=AC(60) J0
N80 G91 X20 I=AC(80) J0
G90
TRANS
N90 G1 X200 F=100 M8
N100 SUPA G0 Z0 D0
N110 G74 Z1=0
N120 M30
GROUP_END(0,0)
"""


def test_siemens_words_with_their_own_mode_shifts_and_settings(tmp_path):
    """TRANS counts from the work offset and forgets axes that it does not name; ATRANS adds.

    The error is 0.05 um/mm. N50: machine X 100, 5 um. N60: 200, 10 um; N70 to 220 about 210 mm: 11 and 10.5 um. N80 to 240.
    """
    followed(
        tmp_path,
        "siemens",
        SIEMENS,
        [
            "N40 G0 X=199.99 Y=0 Z=AC(5)",
            "N50 G1 X-0.005 Y0 Z-2 F200",
            "N60 X=AC(49.99) Y=IC(-10)",
            "N70 G2 X=IC(19.999) I=AC(59.99) J0",
            "N80 G91 X19.999 I=AC(79.989) J0",
            "N90 G1 X199.99 F=100 M8",
        ],
        slope=0.05,
    )


def test_a_word_is_added_after_the_parenthesis_of_a_mode(tmp_path):
    """EZX is 50 um at X 500: the block that names X alone moves Z, too."""
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EZX": Curve(ends, 1e-4 * ends, np.zeros(2))})
    text = "G71 G90 G17 G54\nG0 X0 Y0 Z5\nG1 X=AC(200) F200\nX=IC(300)\nM30\n"
    result, corrected = run(tmp_path, text, errors, "siemens", PLAIN)
    assert "G1 X=AC(200) Z4.98 F200\nX=IC(300)Z4.95\n" in corrected
    assert result.accepted


def test_heidenhain_shift_tool_call_and_the_direction_of_the_last_arc(tmp_path):
    """G54 replaces the shift, in G91 it adds; DL makes the tool longer; G05 goes on as G02 did; M91 is not moved.

    A quarter of a circle that is 0.1 um/mm smaller in X has a mean radius that is 0.05 um/mm smaller.
    """
    text = (
        "%PART G71 *\nN10 * - FACE OF A PLATE*\nN20 G30 G17 X+0 Y+0 Z-40*\nN30 G31 G90 X+100 Y+100 Z+0*\nN35 G99 T2 L+0 R+5*\n"
        "N40 T1 G17 S3000 DL+0.5 DR+0*\nN45 G51 T2* ;next*\nN50 G00 G40 G90 Z+50 M3*\nN55 G62 T0.02 P01 1 P02 5*\n"
        "N60 G54 X+100 Y+20*\nN70 X+0 Y+0 M8*\nN80 G54 G91 X+50*\nN90 G90 G01 X+50 Z-2 F200*\nN100 G98 L1*\n"
        "N110 G02 X+60 Y+10 R+10*\nN120 G05 X+50 Y+0 R+10*\nN130 G54 X+0 Y+0*\nN140 G01 X+200 FMAX*\nN150 G00 Z+0 M91*\n"
        "N160 M2*\n"
        "N99999999 %PART G71 *\n"
    )
    setup = Setup({"PRESET": ZERO}, TOOLS)
    result = followed(
        tmp_path,
        "heidenhain-iso",
        text,
        [
            "N70 X-0.01 Y+0 M8*",
            "N90 G90 G01 X+49.98 Z-2 F200*",
            "N110 G02 X+59.979 Y+10 R+9.9995*",
            "N120 G05 X+49.98 Y+0 R+9.9995*",
            "N140 G01 X+199.98 FMAX*",
        ],
        setup,
        slope=0.1,
    )
    assert result.tools_mm["1"] == (0.0, 0.0, 0.5)


def test_linuxcnc_outputs_messages_and_lower_case(tmp_path):
    followed(
        tmp_path,
        "linuxcnc",
        "%\n(MSG, start)\n(debug, now)\ng21 g90 g17 g54 g64 p0.01 q0.01\nm62 p1\nM67 E0 Q12.5\nG00 X 200 y0 z 0\nM64 P3\n"
        "g 1 x 100 f 100 m03 ; a comment\nM50 P0\nM53 P1\nM2\n%\n",
        ["G00 X 199.98 y0 z 0", "g 1 x 99.99 f 100 m03 ; a comment"],
        slope=0.1,
    )


def test_a_part_that_a_rotary_axis_turns_is_refused_before_it_turns():
    start = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\n"
    for text in ("G0 A5.\nG91\nG0 A0.\nG90 G0 X1. A5.\n", "G28 G91 A0.\nG90 G0 A0.\n"):
        moves_of(f"{start}{text}M30\n", "fanuc", PLAIN)
        with pytest.raises(InputError, match="the rotary axis turns"):
            moves_of(f"{start}{text}G0 A90.\nM30\n", "fanuc", PLAIN)


# Drilling cycles that are defined once: EZZ is 1 um/mm of Z, and EXX 0.1 um/mm of X, by hand.


def cycle_errors(slope_z=1e-3, slope_x=1e-4, squareness=0.0):
    """Errors that grow with the position: Z by ``slope_z`` (mm/mm), X by ``slope_x``, Z by ``squareness`` along X."""
    ends = np.array([-600.0, 600.0])
    curves = {"EZZ": slope_z * ends, "EXX": slope_x * ends, "EZX": squareness * ends}
    return ErrorTable({name: Curve(ends, value, np.zeros(2)) for name, value in curves.items()})


MCALL = """N10 G17 G71 G90 G94 G54
N20 T1 M6 D1
N30 G0 X100 Y10 Z100
N40 F200
N50 MCALL CYCLE81(10,0,2,-20) ; four holes
N60 X100 Y10
N70 X200
N80 MCALL CYCLE83(50,-5,1,,30,,5,0,,,1,0)
N90 G91 X100
N100 Y20
N110 MCALL
N120 G90 G0 X0 Y0 Z100
CYCLE85(10,,2,-8.5,,0.5,100,200)
N130 G1 Z-50
N140 M30
"""


def test_holes_of_mcall_have_their_places_and_their_heights(tmp_path):
    """At the depth -20 the machine is 20 um too low, at the level 2 it is 2 um too high: -19.98 (rounded) and 1.998.

    The cycle is written again where these change, here once for each definition. CYCLE83: level -4, depth -35: RFP is -5 + 4 um,
    DPR 30 less 35 - 4 = 31 um. CYCLE85: level 2, depth -8.5: RFP, which is empty, becomes -2 um.
    """
    setup = Setup({"G54": ZERO}, TOOLS)
    result, corrected = run(tmp_path, MCALL, cycle_errors(), "siemens", setup)
    body = corrected[corrected.index("N10 ") :]
    assert body == MCALL.replace("N30 G0 X100 Y10 Z100", "N30 G0 X99.99 Y10 Z99.9").replace(
        "N60 X100 Y10\nN70 X200", "MCALL CYCLE81(10,-0.002,2,-19.98) ; four holes\nN60 X99.99 Y10\nN70 X199.98"
    ).replace("N90 G91 X100\n", "MCALL CYCLE83(50,-4.996,1,,29.969,,5,0,,,1,0)\nN90 G91 X99.99\n").replace(
        "G0 X0 Y0 Z100\nCYCLE85(10,,2,-8.5,", "G0 X0 Y0 Z99.9\nCYCLE85(10,-0.002,2,-8.492,"
    ).replace("G1 Z-50", "G1 Z-49.95")
    assert result.after.ends_mm < 1e-3 < 0.04 < result.before.ends_mm
    assert result.counts["added_blocks"] == 2
    unchanged, same = run(tmp_path, MCALL, shift(), "siemens", setup)
    assert (same, unchanged.accepted) == (MCALL, True)


def test_a_cycle_is_written_again_for_each_hole_where_the_heights_differ(tmp_path):
    """EZX of 0.1 um/mm: 10 um at X 100, 20 um at X 200, and the same again at X 201."""
    text = "G17 G71 G90 G54\nG0 X0 Y0 Z50\nF200\nMCALL CYCLE82(10,0,2,-20,,0.5)\nX100\nX200\nX201\nX0\nMCALL\nM30\n"
    _, corrected = run(
        tmp_path, text, cycle_errors(0.0, 0.0, 1e-4), "siemens", Setup({"G54": ZERO}, TOOLS), tolerance_um=5
    )
    assert corrected.endswith(
        "F200\nMCALL CYCLE82(10,0,2,-20,,0.5)\nMCALL CYCLE82(10,-0.01,2,-20.01,,0.5)\nX100\n"
        "MCALL CYCLE82(10,-0.02,2,-20.02,,0.5)\nX200\nX201\nMCALL CYCLE82(10,0,2,-20,,0.5)\nX0\nMCALL\nM30\n"
    )


def drilled(text, dialect, setup):
    """The moves of the holes of a program as letters (g: rapid, f: feed) with the end in X and Z."""
    moves = moves_of(text, dialect, setup)
    return [("gf"[int(k)], x, z) for k, (x, _, z) in zip(moves.kind, moves.end_mm.tolist(), strict=True)]


def test_the_moves_of_a_sinumerik_cycle(tmp_path):
    """CYCLE81 approaches RFP + SDIS, drills to DP at feed, and goes back to RTP; CYCLE85 goes back to RFP + SDIS at feed."""
    setup = Setup({"G54": (0.0, 0.0, 1.0)}, TOOLS)
    start = "G17 G71 G90 G54\nG0 X0 Y0 Z50\n"
    assert drilled(f"{start}MCALL CYCLE81(10,1,2,-20)\nX5\nM30\n", "siemens", setup)[1:] == [
        ("g", 5.0, 51.0),
        ("g", 5.0, 4.0),
        ("f", 5.0, -19.0),
        ("g", 5.0, 4.0),
        ("g", 5.0, 11.0),
    ]
    # DPR counts from the reference plane; with _AMODE ending in 1 it does, ending in 2 the depth is absolute
    for call, depth in (
        ("CYCLE85(10,1,2,,15,0,100,200)", -13.0),
        ("CYCLE85(10,1,2,-20,15,0,100,200,0,1,1)", -13.0),
        ("CYCLE85(10,1,2,-20,15,0,100,200,0,1,12)", -19.0),
    ):
        assert drilled(f"{start}{call}\nM30\n", "siemens", setup)[1:] == [
            ("g", 0.0, 4.0),
            ("f", 0.0, depth),
            ("f", 0.0, 4.0),
            ("g", 0.0, 11.0),
        ]


HOLES_HEIDENHAIN = """%HOLES G71 *
N10 G30 G17 X+0 Y+0 Z-40*
N20 G31 G90 X+100 Y+100 Z+0*
N30 T1 G17 S3000*
N40 G00 G40 G90 Z+100 M3*
N50 G200 DRILLING
 Q200=2 ;SET-UP CLEARANCE
 Q201=-20 ;DEPTH
 Q206=150 ;FEED RATE FOR PLNGNG
 Q202=5 ;PLUNGING DEPTH
 Q203=+10 ;SURFACE COORDINATE
 Q204=50 ;2ND SET-UP CLEARANCE
 Q211=0 ;DWELL TIME AT DEPTH*
N60 X+100 Y+20 M99*
N70 X+200 M8*
N80 G79*
N90 G83 P01 -2 P02 -20 P03 -10 P04 0 P05 500*
N100 Z+2*
N110 X+0 M89*
N120 X+100 M99*
N130 G00 Z+100 M2*
N99999999 %HOLES G71 *
"""


def test_holes_of_heidenhain_cycles_new_and_old(tmp_path):
    """G200: level 12, depth -10: surface 10 - 12 um, depth 10 + 12 um less. G83: from Z 2 (-2 um) to -20 (+20 um): 22 um less.

    The cycle leaves the tool at the second set-up clearance, 12 um too low: the next move takes it to the corrected height.
    G79 has no words for a place: the hole stays where the block before has led.
    """
    setup = Setup({"PRESET": ZERO}, TOOLS)
    result, corrected = run(tmp_path, HOLES_HEIDENHAIN, cycle_errors(), "heidenhain-iso", setup)
    again = (
        HOLES_HEIDENHAIN[HOLES_HEIDENHAIN.index("G200") : HOLES_HEIDENHAIN.index("N60")]
        .replace("Q203=+10", "Q203=+9.988")
        .replace("Q201=-20", "Q201=-19.978")
    )
    expected = HOLES_HEIDENHAIN.replace("Z+100 M3", "Z+99.9001 M3").replace("N60 X+100", f"{again}N60 X+99.99")
    expected = expected.replace("N70 X+200", "N70 X+199.98 Z+59.9401").replace("N100 Z+2*", "N100 Z+1.998*")
    expected = expected.replace("N110 X+0", "G83 P01 -2 P02 -19.978 P03 -10 P04 0 P05 500*\nN110 X+0")
    expected = expected.replace("N120 X+100", "N120 X+99.99").replace("N130 G00 Z+100", "N130 G00 Z+99.9001")
    assert corrected[corrected.index("N10 ") :] == expected[expected.index("N10 ") :]
    assert result.after.ends_mm < 1e-3 < 0.009 < result.before.ends_mm
    unchanged, same = run(tmp_path, HOLES_HEIDENHAIN, shift(), "heidenhain-iso", setup)
    assert (same, unchanged.accepted) == (HOLES_HEIDENHAIN, True)
    # at the place of the second hole with G79, and old cycles return to where they began
    ways = drilled(HOLES_HEIDENHAIN, "heidenhain-iso", setup)
    assert [way for way in ways if way[0] == "f"] == [
        ("f", 100.0, -10.0),
        ("f", 200.0, -10.0),
        ("f", 0.0, -20.0),
        ("f", 100.0, -20.0),
    ]
    assert ways[-2:] == [("g", 100.0, 2.0), ("g", 100.0, 100.0)]
    assert ("g", 200.0, 60.0) in ways  # the second set-up clearance above the surface


@pytest.mark.parametrize(
    ("dialect", "text", "words"),
    [
        ("siemens", "MCALL CYCLE81(10,0,2,R5)", "'R5': variables"),
        ("siemens", "CYCLE81(10,0,2)", "neither DP nor DPR"),
        ("siemens", "CYCLE81(10,0,2,-20,15)", "different depths"),
        ("siemens", "CYCLE82(10,0,2,-20,,0,10,1,12)", "diameter"),
        ("siemens", "CYCLE81(10,0,2,20)", "goes up"),
        ("siemens", "MCALL HOLES1(0,0,0,5,5,5)", "patterns of holes"),
        ("siemens", "MCALL CYCLE81(10,0,2,-9)\nG2 X5 Y5 CR=9", "after|where G0 or G1 led"),
        ("siemens", "MCALL CYCLE81(10,0,2,-9)\nSUPA G0 X5", "not in machine coordinates"),
        ("siemens", "MCALL CYCLE81(10,0,2,-9)\nX5\nCYCLE82(10,0,2,-9)", "MCALL alone before"),
        ("heidenhain-iso", "G208 Q200=2*", "milling"),
        ("heidenhain-iso", "G79*", "none is defined"),
        ("heidenhain-iso", "G200 Q200=2 Q201=-5*\nG79*", "without Q203"),
        ("heidenhain-iso", "G240 Q200=2 Q201=-5 Q203=0 Q343=1*\nG79*", "from a diameter"),
        ("heidenhain-iso", "Q200=2*", "variables"),
    ],
)
def test_cycles_that_are_refused(dialect, text, words):
    with pytest.raises(InputError, match=words):
        moves_of(
            f"G71 G17 G90 {'G54' * (dialect == 'siemens')}\nG00 X+0 Y+0 Z+50\n{text}\nM30\n",
            dialect,
            Setup({"G54": ZERO, "PRESET": ZERO}, TOOLS),
        )


def test_part_measures_the_holes_of_called_cycles(tmp_path):
    """Four holes of MCALL at X 100, 200, 300, 300: 10 um wider per 100 mm; the one of CYCLE85 at 0."""
    program = tmp_path / "p.mpf"
    program.write_text(MCALL)
    setup = Setup({"G54": ZERO}, TOOLS)
    found = predict_part(model_of(mill(), cycle_errors(), None), program, "siemens", setup).features
    across = sorted(f.error for f in found if f.name.startswith("hole") and f.quantity == "position X")
    assert across == pytest.approx([0.0, 10.0, 20.0, 30.0, 30.0], abs=0.1)


def test_calls_of_fanuc_and_haas_in_the_same_file(tmp_path):
    """M98 P with the repeats before its last four digits, M97 to a block number; the lines of messages are those of the file."""
    text = (
        "%\nO1\nG21 G90 G17 G54\nG0 X0. Y0. Z0.\nG52 X100.\nM98 P20010\nG52 X200. M98 P10\nG52 X0.\nM97 P500\nM30\n"
        "N500 G1 Y7. F9\nM99\nO0010 (POCKET)\nG1 X10. F9\nX0.\nM99\n%\n"
    )
    result, corrected = run(tmp_path, text, shift(slope=0.1), "fanuc", PLAIN)
    assert corrected[corrected.index("G21") :] == (
        "G21 G90 G17 G54\nG0 X0. Y0. Z0.\nG52 X100.\n(O10 2 times)\nG1 X9.989 F9\nX-0.01\nG1 X9.989 F9\nX-0.01\n"
        "G52 X200. (O10)\nG1 X9.979 F9\nX-0.02\nG52 X0.\n(N500)\nN500 G1 Y7. F9\nM30\n%\n"
    )
    assert result.accepted
    with pytest.raises(InputError, match="outside its travel") as caught:
        run(tmp_path, text.replace("X10. F9", "X900. F9"), shift(), "fanuc", PLAIN)
    assert caught.value.line == 14
    for wrong, words in (
        ("M98 P99", "in the same file"),
        ("M98 P10 (no end)", "does not end with M99"),
        ("/M98 P10", "block with /"),
    ):
        broken = text.replace("M98 P20010", wrong)
        if "no end" in wrong:
            broken = broken.replace("X0.\nM99\n%", "X0.\n%")
        with pytest.raises(InputError, match=words) as caught:
            run(tmp_path, broken, shift(), "fanuc", PLAIN)
        assert caught.value.line == 6
    loop = text.replace("X0.\nM99\n%", "M98 P10\nM99\n%")
    with pytest.raises(InputError, match="call themselves"):
        run(tmp_path, loop, shift(), "fanuc", PLAIN)


CALLS = "G21 G90 G17 G54\nG0 X0. Y0. Z0.\n{}\nG1 X50. F9\nM30\nO10\nG1 X10. F9\nM99\nO10010\nG1 X20. F9\nM99\n"


def called_moves(tmp_path, block, dialect, *, skip=False):
    """Places in X of a program with a block that may call."""
    program = tmp_path / "p.nc"
    program.write_text(f"%\nO1\n{CALLS.format(block)}%\n")
    setup = Setup({"G54": ZERO}, TOOLS, skip_deleted=skip)
    return run_file(program, dialect, setup)


def run_file(program, dialect, setup=PLAIN):
    """Places in X to which the moves of a program lead, with its calls."""
    reader = Reader(mill(), DIALECTS[dialect], setup, program)
    with reader.opened() as stream:
        return [x for batch in reader.batches(stream) for x in batch.moves.end_mm[:, 0].tolist()]


@pytest.mark.parametrize("dialect", ["fanuc", "linuxcnc"])
def test_what_the_control_skips_calls_nothing_and_ends_nothing(tmp_path, dialect):
    """With --block-delete, blocks with / do nothing; without, M30 in one ends the program, and calls are refused."""
    for block in ("/M30", "/M98 P10", "/ N5 M98 P10 L3", "(M98 P10) M8", "/M2 (M30)"):
        assert called_moves(tmp_path, f"M98 P10\n{block}", dialect, skip=True) == [0.0, 10.0, 50.0], block
    assert called_moves(tmp_path, "M98 P10\n/M30", dialect) == [0.0, 10.0]
    for block in ("/M98 P10", "/ M 98 P10"):
        with pytest.raises(InputError, match="block with /"):
            called_moves(tmp_path, block, dialect)


@pytest.mark.parametrize(
    ("dialect", "block", "words"),
    [
        ("fanuc", "G1 X5. F9 ; M98 P10", "; ends a block"),
        ("fanuc", "M98 P10 ; M30", "; ends a block"),
        ("fanuc", "M98 P10 Q5", "within a subprogram"),
        ("fanuc", "M98 P10 L0", "L0 is no number"),
        ("fanuc", "M98 P10 L1.5", "L1.5 is no number"),
        ("fanuc", "M98 P10010", "may be O10010"),
        ("fanuc", "M98 P10 (open", "cannot be read"),
        ("fanuc", "M198 P10", "subprograms"),
        ("linuxcnc", "X5. M98 P10", "divide the block"),
        ("linuxcnc", "M98 P10 M8", "divide the block"),
        ("linuxcnc", "M97 P10", "subprograms"),
    ],
)
def test_calls_that_are_refused(tmp_path, dialect, block, words):
    with pytest.raises(InputError, match=words) as caught:
        called_moves(tmp_path, block, dialect)
    assert caught.value.line == 5


def test_calls_of_numbers_that_are_given_twice_are_refused(tmp_path):
    program = tmp_path / "p.nc"
    for text, words in (
        (f"%\nO1\n{CALLS.format('M98 P10')}O10\nG1 X1. F9\nM99\n%\n", "lines 8 and 14"),
        (f"%\nO1\n{CALLS.format('M97 P5')}N5 G1 X1. F9\nM99\n%\n", "subprograms"),  # in another program of the file
    ):
        program.write_text(text)
        with pytest.raises(InputError, match=words):
            run_file(program, "fanuc")


def test_fanuc_drilling_in_increments(tmp_path):
    """Depth and R level of a cycle in G90 stay when G91 moves on; given in G91, R counts from the initial level, Z from R."""
    text = (
        "%\nO1\nG21 G90 G17 G54\nG0 X100. Y0. Z50.\nG98 G81 Z-20. R5. F90\nN2 G91 X100. K2\nG90 X0. K2\nG80\n"
        "G91 G99 G83 X100. Y10. Z-30. R-45. Q2. F50\nG80\nG90 G0 Z50.\nM30\n%\n"
    )
    result, corrected = run(tmp_path, text, shift(slope=0.1), "fanuc", PLAIN)
    assert corrected[corrected.index("G98") :] == (
        "G98 G81 Z-20. R5. F90\nN2 G90 X199.98 Y0. Z-20. R5.\nX299.97 Y0.\nG91\nG90 X0. K2\nG80\n"
        "G90 X99.99 Y10. Z-25. R5. G99 G83 Q2. F50\nG91\nG80\nG90 G0 Z50.\nM30\n%\n"
    )
    assert result.accepted
    for wrong, words in (
        (
            "R-45.",
            "",
        ),
        ("K2\nG90", "K0\nG90"),
    ):
        with pytest.raises(InputError, match="give both|only stored"):
            moves_of(text.replace(wrong, words), "fanuc", PLAIN)


def test_a_cycle_that_is_defined_again_is_called_on_by_all_positions(tmp_path):
    """A definition ends M89, so that it is given again; EZX of 0.1 um/mm needs other depths at each hole."""
    text = (
        "%A G71 *\nG00 G40 G90 Z+100*\nX+0 Y+0*\nG200 Q200=2 Q201=-20 Q203=+0 Q204=50*\nX+100 M89*\nX+200 M8*\nX+300 ; last\n"
        "X+400 M99*\nX+0 M2*\nN9 %A G71 *\n"
    )
    setup = Setup({"PRESET": ZERO}, TOOLS)
    result, corrected = run(tmp_path, text, cycle_errors(0.0, 0.0, 1e-4), "heidenhain-iso", setup)
    assert result.accepted
    again = "G200 Q200=2 Q201=-20 Q203=-0.0{}0 Q204=50*\n".replace("0 Q204", " Q204")
    expected = "".join(again.format(k) + f"X+{k}00 {m}\n" for k, m in ((1, "M89*"), (2, "M8 M89*"), (3, "M89 ; last")))
    assert expected in corrected
    assert again.format(4) + "X+400 M99*\n" in corrected


def test_a_shift_within_a_series_of_holes_is_no_hole(tmp_path):
    """G52 takes its X; a change of the work offset under TRANS is refused."""
    text = "G21 G90 G17 G54\nG0 X0. Y0. Z9.\nG91 G99 G81 X10. Z-9. R-4. F9\nG52 X5.\nM30\n"
    with pytest.raises(InputError, match="incremental blocks"):
        moves_of(text, "fanuc", PLAIN)
    moves = moves_of(text.replace("M30", "M2"), "linuxcnc", PLAIN)
    assert moves.line.max() == 3
    with pytest.raises(InputError, match="while TRANS is active"):
        moves_of("G71 G90 G54\nTRANS X5\nG55\nM30\n", "siemens", Setup({"G54": ZERO, "G55": ZERO}))


def test_a_plane_that_is_turned_by_nothing(tmp_path):
    """CYCLE800 with angles and shifts 0 may draw the tool back: the program has to position all axes again."""
    text = 'G71 G90 G17 G54\nCYCLE800(4,"TC1",200000,57,0,0,0,0,0,0,0,0,0,1,,1)\nG0 X100 Y0\nZ5\nG1 X200 F9\nM30\n'
    result = followed(tmp_path, "siemens", text, ["G0 X99.99 Y0", "G1 X199.98 F9"], slope=0.1)
    assert any("CYCLE800" in words for words in result.assumed)
    for angle in ("0,0,0,0,0,0.5,0,0,0", "0,0,25,0,0,0,0,0,0", "0,0,0,A,0,0,0,0,0"):
        with pytest.raises(InputError, match="a turned plane"):
            moves_of(text.replace("0,0,0,0,0,0,0,0,0", angle), "siemens", PLAIN)
    with pytest.raises(InputError, match="position of Z is not known"):
        moves_of(text.replace("Z5\n", ""), "siemens", PLAIN)


def test_options_round_as_the_dialects_do():
    """The steps in which ``volcomp options`` rounds a corrected program are the last decimals of the dialects, in mm."""

    last_mm = {name: 10.0 ** -dialect.decimals[0] for name, dialect in DIALECTS.items()}
    for control, dialect in (
        ("heidenhain-com", "heidenhain-iso"),
        ("heidenhain-kinematics", "heidenhain-iso"),
        ("linuxcnc-comp", "linuxcnc"),
        ("linuxcnc-volumetric", "linuxcnc"),
        ("siemens-cec", "siemens"),
        ("fanuc-pitch", "fanuc"),
        ("klipper", "grbl"),
    ):
        assert PROGRAM_STEPS_MM.get(control, PROGRAM_STEP_MM) == pytest.approx(last_mm[dialect]), control


def test_the_clearance_of_g83_counts_by_the_sign_of_the_depth():
    """Programs for the TNC 407 give P01 the sign of P02, those since the TNC 426 none: both go 22 mm down."""
    setup = Setup({"PRESET": ZERO}, {"1": ZERO})
    deep = [
        moves_of(HOLES_HEIDENHAIN.replace("P01 -2", clearance), "heidenhain-iso", setup).end_mm[:, 2].min()
        for clearance in ("P01 -2", "P01 +2", "P01 2")
    ]
    assert deep == [-20.0] * 3
