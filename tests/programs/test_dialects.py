"""Constructs that programs of CAM systems contain, in each dialect: followed to the digit, or passed through."""

import pytest
from programs.test_correct import PLAIN, moves_of, run, shift

from compgen.errors import InputError
from compgen.programs import Setup

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


def test_heidenhain_shift_tool_call_and_the_direction_of_the_last_arc(tmp_path):
    """G54 replaces the shift, in G91 it adds; DL makes the tool longer; G05 goes on as G02 did; M91 is not moved.

    A quarter of a circle that is 0.1 um/mm smaller in X has a mean radius that is 0.05 um/mm smaller.
    """
    text = (
        "%PART G71 *\nN10 * - FACE OF A PLATE*\nN20 G30 G17 X+0 Y+0 Z-40*\nN30 G31 G90 X+100 Y+100 Z+0*\nN35 G99 T2 L+0 R+5*\n"
        "N40 T1 G17 S3000 DL+0.5 DR+0*\nN45 G51 T2*\nN50 G00 G40 G90 Z+50 M3*\nN55 G62 T0.02 P01 1 P02 5*\n"
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
