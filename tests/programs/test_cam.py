"""Programs as CAM systems post them: nothing but coordinates changes, and every other word and comment survives in order.

The programs are written for these tests, in the forms of the posts of Autodesk Fusion (FANUC, Haas, SINUMERIK, HEIDENHAIN),
FreeCAD (LinuxCNC, grbl, HEIDENHAIN), Mastercam (FANUC), Vectric (Mach, grbl), Easel (grbl) and hyperMILL (DIN/ISO).
"""

import re

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable
from compgen.errors import InputError
from compgen.programs import CorrectOptions, Setup, correct_program, model_of
from machines import machine_of

NODES_MM = np.linspace(-500.0, 500.0, 11)
#: X is 0.05 um/mm too long and bent, Y leans.
ERRORS = ErrorTable(
    curves={
        "EXX": Curve(NODES_MM, 5e-5 * NODES_MM, 0.0 * NODES_MM),
        "EYX": Curve(NODES_MM, 1e-8 * NODES_MM**2, 0.0 * NODES_MM),
    },
    squareness={"EC0Y": (5e-5, 0.0)},
)
#: Words that a correction may change: coordinates, and pecks.
CHANGED = {"X", "Y", "Z", "I", "J", "K", "R", "CR", "Q", "IX", "IY", "IZ", "IPA"}
COMMENTS = {"fanuc": r"\([^()\n]*\)", "linuxcnc": r"\([^()\n]*\)|;[^\n]*", "grbl": r"\([^()\n]*\)|;[^\n]*"}
PROGRAMS = {
    ("fusion-fanuc", "fanuc"): """\
%
O01001 (PLATE 7)
(USING HIGH FEED G1 F5000. INSTEAD OF G0.)
(T1 D=10. CR=0. - ZMIN=-5. - FLAT END MILL)
(T2 D=5. CR=0. TAPER=118DEG - ZMIN=-14. - DRILL)
N10 G90 G94 G17 G49 G40 G80
N15 G21
N20 G28 G91 Z0.
N25 G90

(2D CONTOUR1)
N30 T1 M6
N35 T2
N40 S5000 M3
N45 G54
N50 M8
N55 G0 X-20. Y10.
N60 G43 Z15. H1
N65 G1 Z1. F333.
N70 G18 G3 X-19. Z0. I1. K0. F1000.
N75 G1 X40.
N80 G17 G2 X45. Y5. I0. J-5.
N85 G3 X45. Y5. Z-1. I-10. J0.
N90 G3 X25. I-10. J0.
N95 G3 X45. I10. J0.
N100 G1 Y-20.
N105 G18 G3 X44. Z0. I-1. K0.
N110 G0 Z15.
N115 G17
N120 M9
N125 G28 G91 Z0.
N130 G90
N135 G49
(DRILL1)
N140 M5
N145 M1
N150 T2 M6
N155 S3000 M3
N160 G54
N165 M8
N170 G0 X10. Y10.
N175 G43 Z15. H2
N180 G98 G83 X10. Y10. Z-14. R5. Q2. F250.
N185 X30.
N190 Y-10. K1
N195 G80
N200 G98 G82 X-10. Y-10. Z-4. R5. P500 F250.
N205 G80
N210 Z15.
N215 M9
N220 G28 G91 Z0.
N225 G90
N230 G49
N235 G28 G91 X0. Y0.
N240 G90
N245 M30
%
""",
    ("fusion-haas", "fanuc"): """\
%
O01002 (BRACKET)
(T1 D=0.5 CR=0. - ZMIN=-0.25 - FLAT END MILL)
N10 G90 G94 G17
N15 G20
N20 G53 G0 Z0.
N25 G187 P2
(ADAPTIVE1)
N30 T1 M6
N35 S8000 M3
N40 G54
N45 M8 (FLOOD)
N50 G0 X1.5 Y.25
N55 G43 Z.6 H1
N60 G1 Z.04 F40.
N65 G1 X2. Y.5 F100.
N70 G2 X2.5 Y.75 Z-.1 R.5
N75 G1 G41 X2.75 D1
N80 Y1.5
N85 X1.5
N90 G1 G40 X1.25 Y1.25
N95 G0 Z.6
N100 G84 X1. Y1. Z-.5 R.2 F20.
N105 G80
N110 M5
N115 M9
N120 G53 G0 Z0.
N125 G53 G0 X-10. Y0.
N130 M30
%
""",
    ("freecad-linuxcnc", "linuxcnc"): """\
(Exported by FreeCAD)
(Post Processor: linuxcnc_post)
(Output Time:2026-01-03 10:11:12.123456)
(begin preamble)
G17 G54 G40 G49 G80 G90
G21
(begin operation: Fixture)
(machine units: mm/min)
G54
(finish operation: Fixture)
(begin operation: T1)
(machine units: mm/min)
(T1)
M5
M6 T1
G43 H1
M3 S10000
(finish operation: T1)
(begin operation: Profile)
(Profile)
(Compensated Tool Path. Diameter: 5.0)
G0 Z15.000
G0 X-2.500 Y0.000
G0 Z13.000
G1 X-2.500 Y0.000 Z-1.000 F600.000
G1 X-2.500 Y20.000 Z-1.000 F1200.000
G2 X0.000 Y22.500 Z-1.000 I2.500 J0.000 K0.000 F1200.000
G1 X40.000 Y22.500 Z-1.000 F1200.000
G0 Z15.000
(finish operation: Profile)
(begin operation: Drilling)
(Begin Drilling)
G0 Z15.000
G90
G98
G81 X10.000 Y10.000 Z-3.000 R5.000 F300.000
G81 X30.000 Y10.000 Z-3.000 R5.000 F300.000
G80
G0 Z15.000
(finish operation: Drilling)
(begin postamble)
M05
G17 G54 G90 G80 G40
M2
""",
    ("mastercam", "fanuc"): """\
%
O0000(LEVER - T)
(DATE=DD-MM-YY - 03-01-26 TIME=HH:MM - 10:21)
(MCX FILE - C:\\PARTS\\LEVER.MCAM)
(NC FILE - C:\\NC\\LEVER.NC)
(MATERIAL - ALUMINUM MM - 2024)
( T1 | 10. FLAT ENDMILL | H1 | D1 | WEAR COMP | TOOL DIA. - 10. )
N100 G21
N102 G0 G17 G40 G49 G80 G90
N104 T1 M6
N106 G0 G90 G54 X-30. Y-12.5 A0. S4500 M3
N108 G43 H1 Z25. M8
N110 Z5.
N112 G1 Z-3. F300.
N114 G41 D1 X-20. F800.
N116 G3 X-10. Y-2.5 R10.
N118 G1 Y20.
N120 G2 X0. Y30. R10.
N122 G1 X30.
N124 G40 X40. Y40.
N126 G0 Z25.
N128 M5
N130 G91 G28 Z0. M9
N132 G28 X0. Y0. A0.
N134 M01
N136 T2 M6
N138 G0 G90 G54 X5. Y5. A0. S2000 M3
N140 G43 H2 Z25.
N142 G99 G73 Z-12. R2. Q3. F150.
N144 X15.
N146 G98 X25.
N148 G80
N150 M5
N152 G91 G28 Z0.
N154 G28 X0. Y0. A0.
N156 M30
%
""",
    ("vectric-mach", "linuxcnc"): """\
( Sign )
( File created: Saturday January 03 2026 - 10:12 AM)
( for Mach2/3 from Vectric )
( Material Size)
( X= 300.000, Y= 200.000, Z= 18.000)
()
(Toolpaths used in this file:)
(Profile 1)
(Tools used in this file: )
(1 = End Mill {6 mm})
N100G00G21G17G90G40G49G80
N110G91.1
N120T1M06
N130 (End Mill {6 mm})
N140G00G43Z20.000H1
N150S12000M03
N160(Toolpath:- Profile 1)
N170()
N180G94
N190X0.000Y0.000F1800.0
N200G00X12.345Y23.456Z6.000
N210G1Z-3.000F600.0
N220G3X22.345Y23.456I5.000J0.000F1800.0
N230G1X40.000
N240G2X50.000Y13.456I0.000J-10.000
N250G00Z6.000
N260G00Z20.000
N270G00X0.000Y0.000
N280M09
N290M30
%
""",
    ("vectric-grbl", "grbl"): """\
T1
G17
G21
G90
G0Z5.0800
G0X0.0000Y0.0000S12000M3
G0X10.0000Y10.0000Z5.0800
G1Z-1.0000F300.0
G1X50.0000F900.0
G2X60.0000Y20.0000I0.0000J10.0000
G1Y40.0000
G0Z5.0800
G0X0.0000Y0.0000
M30
""",
    ("easel-grbl", "grbl"): """\
G21
G90
(Move to safe Z to avoid workholding)
G53G0Z-5.000
M05
(TOOL/MILL,3.175,0,0.00,0)
(COLOR,0,0,0)
M03 S10000
G0 X10.5 Y3.2
G1 Z-0.71 F228.6
G1 X20.5 Y3.2 F762
G1 X20.51 Y13.2
G0 Z5
M05
G53G0Z-5.000
M30
""",
    ("fusion-siemens", "siemens"): """\
; %_N_PLATE_MPF
; T1 D=10 CR=0 - ZMIN=-5 - flat end mill
N10 G90 G94 G71 G64 G17
N11 CYCLE832(0.1,0,1)
N12 WORKPIECE(,"",,"BOX",0,0,-10,-80,-50,-30,50,30)
; 2D Contour1
N13 T="1"
N14 M6
N15 S5000 M3 D1
N16 G54
N17 M8
N18 G0 SUPA Z0 D0
N19 G0 X-20 Y10 D1
N20 G0 Z15
N21 G1 Z-1 F333
N22 G1 X40 F1000
N23 G2 X45 Y5 I0 J-5
N24 G3 X45 Y5 I-10 J0 TURN=1 Z-3
N25 G3 X35 Y15 CR=10
N26 G1 Y-20
N27 G0 Z15
N28 MCALL CYCLE83(15,0,5,-14,,-3,,2,0,0,1,0)
N29 X10 Y10
N30 X30 Y10
N31 MCALL
N32 M9 MSG("READY")
N33 G0 SUPA Z0 D0
N34 M30
""",
    ("fusion-klartext", "heidenhain-klartext"): """\
0 BEGIN PGM 1001 MM
1 ; PLATE
2 BLK FORM 0.1 Z X-50 Y-30 Z-10
3 BLK FORM 0.2 X+50 Y+30 Z+0
4 ; T1 D=10 CR=0 - ZMIN=-5 - FLAT END MILL
5 * - 2D CONTOUR1
6 TOOL CALL 1 Z S5000 DL+0.0 DR+0.0 ; FLAT END MILL
7 TOOL DEF 2
8 M3
9 L Z+15 R0 FMAX
10 L X-20 Y+10 R0 FMAX M8
11 L Z-1 F333
12 L X+40 F1000
13 CC X+40 Y+5
14 CR X+45 Y+5 R+5 DR-
15 L Y+0 RL
16 L Y-10
17 L X+60 Y-20 R0
18 L M140 MB MAX
19 CYCL DEF 203 UNIVERSAL DRILLING ~
    Q200=+5 ;SET-UP CLEARANCE ~
    Q201=-14 ;DEPTH ~
    Q206=+250 ;FEED RATE FOR PLNGNG ~
    Q202=+2 ;PLUNGING DEPTH ~
    Q210=+0 ;DWELL TIME AT TOP ~
    Q203=+0 ;SURFACE COORDINATE ~
    Q204=+15 ;2ND SET-UP CLEARANCE ~
    Q212=+0 ;DECREMENT ~
    Q213=+0 ;BREAKS ~
    Q205=+0 ;MIN. PLUNGING DEPTH ~
    Q211=+0 ;DWELL TIME AT DEPTH ~
    Q208=+9999 ;RETRACTION FEED RATE ~
    Q256=+0.2 ;DIST FOR CHIP BRKNG
20 L Z+15 R0 FMAX
21 L X+10 Y+10 R0 FMAX M99
22 L X+30 Y+10 R0 FMAX M99
23 L Z+15 R0 FMAX
24 M9
25 M5
26 L Z-5 R0 FMAX M91
27 M30
28 END PGM 1001 MM
""",
    ("freecad-heidenhain", "heidenhain-klartext"): """\
0 BEGIN PGM TEST MM
1 BLK FORM 0.1 Z X-10.000 Y-10.000 Z-20.000
2 BLK FORM 0.2 X+110.000 Y+110.000 Z+0.000
3 TOOL CALL 1 Z S6000 F600
4 L Z+20.000 R0 FMAX M3
5 L X+0.000 Y+0.000 R0 FMAX
6 L Z-1.000 R0 F300
7 L X+20.000 Y+0.000 R0 F600
8 CC X+20.000 Y+10.000
9 L X+30.000 Y+10.000 R0
10 L X+30.000 Y+30.000
11 L Z+20.000 R0 FMAX
12 M30
13 END PGM TEST MM
""",
    ("freecad-grbl", "grbl"): """\
(Exported by FreeCAD)
(Post Processor: grbl_post)
(Output Time: 2026-01-03 10:00:00)
(Begin preamble)
G17 G90
G21
(Begin operation: Fixture)
(Path: Fixture)
G54
(Finish operation: Fixture)
(Begin operation: TC: 3mm Endmill)
(TC: 3mm Endmill)
(Begin toolchange)
( M6 T1 )
M3 S12000
(Finish operation: TC: 3mm Endmill)
(Begin operation: Profile)
G0 Z5.000
G0 X10.000 Y10.000
G0 Z3.000
G1 X10.000 Y10.000 Z-1.000 F300.000
G2 X20.000 Y20.000 Z-1.000 I10.000 J0.000 K0.000 F600.000
G1 X40.000 Y20.000 Z-1.000
G0 Z5.000
(Begin postamble)
M5
G17 G90
M2
""",
    ("hypermill-iso", "heidenhain-iso"): """\
%1001 G71 *
N10 G30 G17 X-50 Y-30 Z-10 *
N20 G31 G90 X+50 Y+30 Z+0 *
N30 ; FLAT END MILL *
N40 T1 G17 S5000 *
N50 G00 G40 G90 Z+15 M3 *
N60 X-20 Y+10 M8 *
N70 G01 Z-1 F333 *
N80 G41 X-10 F1000 *
N90 X+40 *
N100 I+40 J+5 G02 X+45 Y+5 *
N110 G01 Y-20 *
N120 G40 X+60 Y-25 *
N130 G00 Z+15 *
N140 G200 DRILLING Q200=+5 Q201=-14 Q206=+250 Q202=+14 Q210=+0 Q203=+0 Q204=+15 Q211=+0 *
N150 G79 *
N160 X+10 Y+10 M99 *
N170 G00 Z+15 M9 *
N180 G00 Z-5 M91 *
N190 M30 *
N99999999 %1001 G71 *
""",
}


def words_of(text, dialect):
    """Comments in order, and the words that are no coordinates, each with its number."""
    pattern = COMMENTS.get(dialect, r";[^\n]*")
    body = re.sub(pattern, " ", text)
    if dialect == "heidenhain-klartext":
        body = re.sub(r"(?m)^\d+ ", "", body)
    words = re.findall(r"([A-Z]+)=?(\s*[-+]?[\d.]*)|([^\sA-Z\d.+-])", body.upper())
    kept = [other or letter + number.strip() for letter, number, other in words if letter not in CHANGED]
    return [comment.strip() for comment in re.findall(pattern, text)], kept


def missing(before, after):
    """What of one list is not in the other in its order."""
    rest = iter(after)
    return [item for item in before if item not in rest]


def corrected(tmp_path, dialect, text):
    program = tmp_path / "p.nc"
    program.write_text(text)
    zero, tools = (0.0, 0.0, -100.0), {str(k): (0.0, 0.0, 80.0) for k in range(30)}
    setup = Setup(work_offsets_mm={"G54": zero, "PRESET": zero}, tools_mm=tools, stated_radii_mm={"": 5.0})
    machine = machine_of([(-500.0, 500.0)] * 3, 11)
    found = correct_program(
        model_of(machine, ERRORS, None), program, tmp_path / "out", CorrectOptions(dialect=dialect), setup
    )
    return found, (tmp_path / "out" / found.file).read_text()


@pytest.mark.parametrize(("name", "dialect"), list(PROGRAMS))
def test_words_and_comments_survive_in_order(tmp_path, name, dialect):
    """The program is followed and better after; what is no coordinate is all there, in the order in which it was posted."""
    text = PROGRAMS[name, dialect]
    found, written = corrected(tmp_path, dialect, text)
    assert found.accepted and found.after.worst_mm < found.before.worst_mm, found.reasons
    (comments, words), (comments_after, words_after) = words_of(text, dialect), words_of(written, dialect)
    assert len(words) > 15 and missing(words, words_after) == []
    assert missing(comments, comments_after) == []


def test_units_of_mach_are_named(tmp_path):
    """G71 in posts for Mach3 is mm; LinuxCNC takes it for a turning cycle."""
    with pytest.raises(InputError, match="Mach3.*G20 or G21") as caught:
        corrected(tmp_path, "linuxcnc", PROGRAMS["vectric-mach", "linuxcnc"].replace("N110G91.1", "N110G71"))
    assert caught.value.line == 12
