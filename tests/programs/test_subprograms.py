"""Subprograms in files of their own, and variables that are constant: what is written is what the control executes.

The truth of LinuxCNC is its own interpreter, that of the others the same moves written by hand.
"""

import re
import shutil

import numpy as np
import pytest
from programs.make import mill
from programs.test_correct import PLAIN, shift
from programs.test_rs274 import SETUP, assert_same, canonical, ours

from compgen.errors import InputError
from compgen.programs import CorrectOptions, correct_program, model_of
from compgen.programs.dialects import DIALECTS
from compgen.programs.follower import read_twice
from compgen.programs.path import Moves
from compgen.programs.reader import Reader, Setup

needs_linuxcnc = pytest.mark.skipif(shutil.which("rs274") is None, reason="LinuxCNC is not installed (rs274 missing)")
HEAD = "%\nO1\nG21 G90 G17 G54\nG0 X0. Y0. Z5.\nG1 Z0. F100\n"


def at(folder, **more):
    return Setup({"G54": (0.0, 0.0, 0.0), "PRESET": (0.0, 0.0, 0.0)}, subprograms=(folder,), **more)


def written(program, dialect, setup):
    with Reader(mill(), DIALECTS[dialect], setup, program).opened() as stream:
        return stream.read(1 << 20).decode()


def ends(program, dialect, setup):
    """Ends of moves, after both readings agree."""
    reader = Reader(mill(), DIALECTS[dialect], setup, program)
    return Moves.joined([batch.moves for batch in read_twice(reader)]).end_mm.round(6).tolist()


LINUXCNC = {
    "functions": "#1=[fix[-2.5]] #2=[fup[-2.5]] #3=[round[-2.5]] #4=[-7 mod 3] #5=[2**3**2/10] #6=[-2**2]\nG1 X#1 Y#2 Z#3\n"
    "X#4 Y#5 Z#6\n#7=[1+2*3 gt 5 and 1] #8=[atan[1]/[-1]/10] #9=[5-3-1]\nX#7 Y#8 Z#9\nX-#9 Y-[1+1] Z sin[30]\nX sqrt[abs[-2]]",
    "order": "#1=3\nG1 F100\n#2=[#1+4] #1=9 X#1\nX[#2] Y#1\n#<a b>=4\nY#<ab>\n#10=#[1+1]\n#11=12\n##11=8\nX#12\nX##11",
    "file": "#1=7\nM98 P1001 L2\nG1 X#2\no<foo> call [5] [6]\nX#1 Y#2 Z#<_value>",
    "sub": "o100 sub\nG1 X#1 Y#3\no100 return [#1+1]\nX99\no100 endsub\no100 call [8] [2]\nY#<_value>\nX#31",
    "loops": "#1=0\no1 while [#1 lt 3]\n#1=[#1+1]\nG1 X#1\no2 if [#1 eq 2]\nY5\no2 elseif [#1 eq 3]\nY7\no2 else\nY3\no2 endif\n"
    "o1 endwhile\no3 repeat [2]\nG91\nY1\nG90\no3 endrepeat\no4 do\n#1=[#1-1]\nZ[#1/10]\no4 while [#1 gt 0.5]",
    "codes": "#1=1 #2=55\nG#1 X2\nG#2 X1 Y1\nG54 G0 X0 Y0\nG2 X[1+2] Y0 I1.5 J#31 F[100/3]\nG91.1 G81 X4 Y1 Z[-#1] R#1\nG80",
}  # fmt: skip


@needs_linuxcnc
@pytest.mark.parametrize("case", LINUXCNC)
def test_linuxcnc_executes_what_is_written(tmp_path, case, make_errors):
    program = tmp_path / "p.ngc"
    program.write_text(f"G21 G90 G17 G54\nT1 M6\nG43 H1\n#31=0\nG0 X0 Y0 Z3\nF100\n{LINUXCNC[case]}\nG0 Z9\nM2\n")
    (tmp_path / "1001.ngc").write_text("%\no1001 (a step)\nG1 Y#1\n#2=4\nG91\nY1\nG90\nM99\n%\n")
    (tmp_path / "foo.ngc").write_text("o<foo> sub\nG1 Z#1 Y#2 (deep)\n#3=9\nM98 P1001\no<foo> endsub [#1+3]\nM2\n")
    truth = canonical(program, tmp_path)
    setup = Setup(SETUP.work_offsets_mm, SETUP.tools_mm, subprograms=(tmp_path,))
    plain = tmp_path / "plain.ngc"
    plain.write_text(written(program, "linuxcnc", setup))
    assert not re.search(r"^[^(]*(#|\bo\d|o<|M98)", plain.read_text(), re.MULTILINE)
    assert_same(ours(plain), truth)
    result = correct_program(
        model_of(mill(), make_errors(mill(), 3), None), program, tmp_path / "out", CorrectOptions(), setup
    )
    assert result.accepted


FANUC = {
    "file": ("M98 P7001 L2", [[0, 3, 0], [0, 6, 0]]),
    "nested": ("M98 P0042", [[9, 0, 0], [9, 3, 0]]),
    "variables": ("#100=2.5\n#101=#100*2+1\nG1 X#101 Y-#100\nX[#100+#101]", [[6, -2.5, 0], [8.5, -2.5, 0]]),
    "rounded": ("#1=1./3.\nG1 X#1\nG20 Y#1\nG21", [[0.333, 0, 0], [0.333, 0.3333 * 25.4, 0]]),
    "macro": ("#1=4.\nG65 P9810 X5. Z-2. H2\nG1 X#1", [[5, 0, -2], [5, 2, -2], [4, 2, -2]]),
    "macro ijk": ("G65 P9811 I1. J2. I3. K4.", [[1, 2, 3], [4, 2, 3]]),
    "loop": ("#100=0\nWHILE[#100LT3]DO1\n#100=#100+1\nG1 X#100\nEND1", [[1, 0, 0], [2, 0, 0], [3, 0, 0]]),
    "atan": ("#100=ATAN[1]/[-1]\nG1 X#100 Y[ROUND[2.5]]", [[135, 3, 0]]),
}  # fmt: skip


@pytest.mark.parametrize("case", FANUC)
def test_fanuc_by_hand(tmp_path, case):
    """Files of one program each, numbered in their names, as a control and a post keep them."""
    (tmp_path / "O7001.NC").write_text("%\n\nO7001 (STEP)\nG91 G1 Y3.\nG90\nM99\n%\n")
    (tmp_path / "0042.nc").write_text("G1 X9.\nM98 P7001\nM99\n")
    (tmp_path / "O9810").write_text("%\nO9810\nG1 X#24 Z#26\nY#11\n#24=77.\nM99\n%\n")
    (tmp_path / "O9811").write_text("%\nO9811\nG1 X#4 Y#5 Z#7\nX#9\nM99\n%\n")
    blocks, expected = FANUC[case]
    program = tmp_path / "p.nc"
    program.write_text(f"{HEAD}{blocks}\nM30\n%\n")
    assert np.allclose(ends(program, "fanuc", at(tmp_path))[2:], expected, atol=1e-6)


def test_a_called_file_is_corrected_in_its_place_and_the_call_is_gone(tmp_path):
    """The machine goes 10 um too far in X: X9 becomes 8.99 in both calls, at two work offsets. Notes say what was written out."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub/O20.nc").write_text("%\nO20\n(A HOLE)\nG1 X9. (deep)\nM99\n%\n")
    program = tmp_path / "p.nc"
    program.write_text(f"{HEAD}M98 P20\nX0.\nM98 P20\nM30\n%\n")
    setup = at(tmp_path / "sub")
    result = correct_program(
        model_of(mill(), shift(x=10.0), None), program, tmp_path / "out", CorrectOptions("fanuc"), setup
    )
    text = (tmp_path / "out/p.nc").read_text()
    assert result.accepted
    assert text.count("G1 X8.99 (deep)\n") == 2
    assert text.count("(A HOLE)") == 2
    assert "M98" not in text and "M99" not in text
    assert "O20 of O20.nc (2 times)" in result.assumed[0]


REFUSED = [
    ("fanuc", "M98 P99", 6, "p.nc", "--subprograms"),
    ("fanuc", "M98 P30", 3, "O30.nc", "milling cycles"),
    ("fanuc", "M98 P31", 6, "p.nc", "does not end with M99"),
    ("fanuc", "M98 P32", 2, "O32.nc", "begins with O33"),
    ("fanuc", "M98 P34", 6, "p.nc", "may be"),
    ("fanuc", "M98 P35", 2, "O35.nc", "call themselves"),
    ("fanuc", "G65 P9810 X5", 6, "p.nc", "no decimal point"),
    ("fanuc", "G65 P9812", 2, "O9812.nc", "#24 is not known before"),
    ("fanuc", "#100=#5021", 6, "p.nc", "#5021 is not known"),
    ("fanuc", "#5221=3.", 6, "p.nc", "variable of the control"),
    ("fanuc", "#3000=1", 6, "p.nc", "variable of the control"),
    ("fanuc", "#100=1.\n/#100=2.\nX#100", 7, "p.nc", "block with /"),
    ("fanuc", "IF[#100EQ1]GOTO9", 6, "p.nc", "jumps and conditions"),
    ("fanuc", "#100=0\nWHILE[#100LT1]DO1\nEND1", 7, "p.nc", "do not end"),
    ("fanuc", "#100=1./0", 6, "p.nc", "no value"),
    ("fanuc", "#100=1. G1 X5.", 6, "p.nc", "divide the block"),
    ("linuxcnc", "o<foo> call [1]", 6, "p.nc", "--subprograms"),
    ("linuxcnc", "o<bar> call [1]", None, "bar.ngc", "has no o<bar> sub"),
    ("linuxcnc", "#1=#<_x>", 6, "p.nc", "not known before"),
    ("linuxcnc", "#5220=2", 6, "p.nc", "variable of the control"),
    ("linuxcnc", "o1 if [1]", 6, "p.nc", "has no endif"),
    ("linuxcnc", "o1 if [#5399 eq 1]\nX1\no1 endif", 6, "p.nc", "#5399 is not known"),
    ("linuxcnc", "X[[[[1]", 6, "p.nc", "expected ]"),
    ("linuxcnc", f"X{'[' * 300}1{']' * 300}", 6, "p.nc", "too deep"),
]  # fmt: skip


@pytest.mark.parametrize(("dialect", "blocks", "line", "file", "words"), REFUSED)
def test_what_is_not_known_is_refused_where_it_is(tmp_path, monkeypatch, dialect, blocks, line, file, words):
    monkeypatch.setattr("compgen.programs.subprograms.MOST_TURNS", 1000)
    for name, text in {
        "O30.nc": "O30\nG1 X1.\nG12 I5.\nM99\n", "O31.nc": "%\nO31\nG1 X1.\n%\n", "O32.nc": "%\nO33\nM99\n%\n",
        "O34.nc": "M99\n", "0034.txt": "M99\n", "O35.nc": "O35\nM98 P35\nM99\n", "O9812.nc": "O9812\nX#24\nM99\n",
        "O9810.nc": "O9810\nX#24\nM99\n", "bar.ngc": "o<foo> sub\no<foo> endsub\n",
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text)
    program = tmp_path / "p.nc"
    program.write_text(f"{HEAD}{blocks}\nM30\n%\n")
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        correct_program(
            model_of(mill(), shift(x=10.0), None), program, tmp_path / "out", CorrectOptions(dialect), at(tmp_path)
        )
    assert (caught.value.file.name, caught.value.line) == (file, line)
    assert not (tmp_path / "out").exists()


def test_without_folders_nothing_is_looked_for(tmp_path):
    (tmp_path / "O20.nc").write_text("O20\nG1 X9.\nM99\n")
    (tmp_path / "p.nc").write_text(f"{HEAD}M98 P20\nM30\n%\n")
    with pytest.raises(InputError, match="--subprograms"):
        correct_program(
            model_of(mill(), shift(), None), tmp_path / "p.nc", tmp_path / "out", CorrectOptions("fanuc"), PLAIN
        )


SIEMENS = {
    "file": ("HOLE", [[9, 0, 0], [9, 3, 0]]),
    "number": ("L10 P2", [[0, 3, 0], [0, 6, 0]]),
    "call": ('CALL "HOLE.SPF"\nEXTCALL "/_N_SPF_DIR/_N_L10_SPF"', [[9, 0, 0], [9, 3, 0], [9, 6, 0]]),
    "procedure": ("R1=4\nSTEP(R1+1, -2)\nX=R1", [[5, 0, -2], [5, 8, -2], [4, 8, -2]]),
    "default": ("STEP(5, -2, 1)", [[5, 0, -2], [5, 1, -2]]),
    "variables": ("R1=2.5 R2=3\nR2=R1*2+R2\nG1 X=R1 Y=-R2\nX=(R1+R2)/2 Y=IC(R1)", [[2.5, -8, 0], [5.25, -5.5, 0]]),
    "names": ("DEF REAL LEN=5, ANG\nANG=ATAN2(1,-1)\nG1 X=LEN*SIN(30) Y=ANG/10", [[2.5, 13.5, 0]]),
    "cycle": (
        "R5=-4\nF100\nCYCLE81(10, 0, 2, R5)",
        [[0, 0, 2], [0, 0, -4], [0, 0, 2], [0, 0, 10]],
    ),
    "arc": ("R1=3\nG2 X=2*R1 Y0 CR=R1", [[6, 0, 0]]),
    "plain": ("R1=1\nG1 X=5 Y=-3 F=200 Z=-.5", [[5, -3, -0.5]]),
}  # fmt: skip


@pytest.mark.parametrize("case", SIEMENS)
def test_siemens_by_hand(tmp_path, case):
    (tmp_path / "HOLE.SPF").write_text("%_N_HOLE_SPF\n;$PATH=/_N_SPF_DIR\nG1 X9 ; deep\nL10\nM17\n")
    (tmp_path / "L10.SPF").write_text("G91 Y3\nG90\nRET\n")
    (tmp_path / "step.spf").write_text("; a step\nPROC STEP(REAL A, REAL D, REAL W=8)\nG1 X=A Z=D\nY=W M17\nX77\n")
    blocks, expected = SIEMENS[case]
    program = tmp_path / "p.mpf"
    program.write_text(f"G71 G90 G17 G54\nG0 X0 Y0 Z5\nG1 Z0 F100\n{blocks}\nM30\n")
    assert np.allclose(ends(program, "siemens", at(tmp_path))[2:], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("blocks", "line", "file", "words"),
    [
        ("NONE", 4, "p.mpf", "NONE is not known"),
        ("X=R5+1", 4, "p.mpf", "R5 is not known before"),
        ("R1=$AA_IW[X]", 4, "p.mpf", "is no number"),
        ("R1=5 X3", 4, "p.mpf", "divide the block"),
        ("/R1=5", 4, "p.mpf", "block with /"),
        ("CUT", 3, "CUT.SPF", "without M17"),
        ("LOOPS", 1, "LOOPS.SPF", "call themselves"),
        ("KEPT", 4, "p.mpf", "SAVE"),
        ("BAD", 2, "BAD.SPF", "milling cycles"),
        ("STEP(1,2,3)", 4, "p.mpf", "more parameters"),
        ("R1=1\nIF R1==1 GOTOF END", 5, "p.mpf", "IF"),
        ("R1=1/0", 4, "p.mpf", "no value"),
    ],
)  # fmt: skip
def test_what_is_not_known_of_siemens_is_refused_where_it_is(tmp_path, blocks, line, file, words):
    for name, text in {
        "CUT.SPF": "G1 X1\n\n\n", "LOOPS.SPF": "LOOPS\nM17\n", "KEPT.SPF": "PROC KEPT SAVE\nM17\n",
        "BAD.SPF": "G1 X1\nPOCKET3(1,2)\nM17\n", "STEP.SPF": "PROC STEP(REAL A, INT B)\nM17\n",
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text)
    program = tmp_path / "p.mpf"
    program.write_text(f"G71 G90 G17 G54\nG0 X0 Y0 Z5\nG1 Z0 F100\n{blocks}\nM30\n")
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        correct_program(
            model_of(mill(), shift(x=10.0), None), program, tmp_path / "out", CorrectOptions("siemens"), at(tmp_path)
        )
    assert (caught.value.file.name, caught.value.line) == (file, line)


KLARTEXT = {
    "plain": ("CALL PGM STEP\nCALL PGM TNC:\\NC\\step.h ; again", [[0, 3, 0], [0, 6, 0]]),
    "parameters": ('Q5=+4\nCALL PGM "DEEP.H"\nL X+Q6', [[4, 0, 0], [4, 3, 0], [7, 3, 0]]),
    "labels": ("CALL PGM REPS\nLBL 1\nL IX+1\nCALL LBL 1 REP 1", [[0, 2, 0], [0, 4, 0], [0, 6, 0], [1, 6, 0], [2, 6, 0]]),
}  # fmt: skip


@pytest.mark.parametrize("case", KLARTEXT)
def test_klartext_by_hand(tmp_path, case):
    """Labels belong to their program, Q parameters to all."""
    (tmp_path / "STEP.H").write_text("0 BEGIN PGM STEP MM\n1 L IY+3 F100\n2 END PGM STEP MM\n")
    (tmp_path / "deep.h").write_text(
        "0 BEGIN PGM DEEP MM\n1 L X+Q5 F100\n2 CALL PGM STEP\n3 Q6=+7\n4 END PGM DEEP MM\n"
    )
    (tmp_path / "reps.h").write_text(
        "0 BEGIN PGM REPS MM\n1 LBL 1\n2 L IY+2 F9\n3 CALL LBL 1 REP 2\n4 END PGM REPS MM\n"
    )
    program = tmp_path / "p.h"
    blocks, expected = KLARTEXT[case]
    program.write_text(f"0 BEGIN PGM P MM\n1 TOOL CALL 1 Z S9\nL X+0 Y+0 Z+0 R0 FMAX\n{blocks}\nM30\nEND PGM P MM\n")
    setup = at(tmp_path, tools_mm={"1": (0.0, 0.0, 0.0)})
    assert np.allclose(ends(program, "heidenhain-klartext", setup)[1:], expected, atol=1e-6)
    result = correct_program(
        model_of(mill(), shift(x=10.0), None), program, tmp_path / "out", CorrectOptions("heidenhain-klartext"), setup
    )
    assert result.accepted
    assert not re.search(r"^\d* ?CALL", (tmp_path / "out/p.h").read_text(), re.MULTILINE)


@pytest.mark.parametrize(
    ("blocks", "line", "file", "words"),
    [
        ("CALL PGM NONE", 4, "p.h", "--subprograms"),
        ("CALL PGM ENDS", 2, "ends.h", "M2 or M30"),
        ("CALL PGM INCH", None, "inch.h", "post both alike"),
        ("CALL PGM CUT", 2, "cut.h", "cut"),
        ("CALL PGM BAD", 3, "bad.h", "APPR"),
        ("CALL PGM SELF", 2, "self.h", "deeper|depth|themselves"),
    ],
)
def test_what_is_not_known_of_klartext_is_refused_where_it_is(tmp_path, blocks, line, file, words):
    for name, text in {
        "ends.h": "BEGIN PGM E MM\nM30\nEND PGM E MM\n", "inch.h": "BEGIN PGM E INCH\nEND PGM E INCH\n",
        "cut.h": "BEGIN PGM E MM\nL X+1 F9\n", "bad.h": "BEGIN PGM E MM\nL X+1 F9\nAPPR LT X+5\nEND PGM E MM\n",
        "self.h": "BEGIN PGM E MM\nCALL PGM SELF\nEND PGM E MM\n",
    }.items():  # fmt: skip
        (tmp_path / name).write_text(text)
    program = tmp_path / "p.h"
    program.write_text(f"0 BEGIN PGM P MM\n1 TOOL CALL 1 Z S9\nL X+0 Y+0 Z+0 R0 FMAX\n{blocks}\nM30\nEND PGM P MM\n")
    setup = at(tmp_path, tools_mm={"1": (0.0, 0.0, 0.0)})
    with pytest.raises(InputError, match=words) as caught:
        correct_program(
            model_of(mill(), shift(x=10.0), None),
            program,
            tmp_path / "out",
            CorrectOptions("heidenhain-klartext"),
            setup,
        )
    assert (caught.value.file.name, caught.value.line) == (file, line)


# --- coordinates that the program turns about Z -----------------------------------------------------------------------


def turned(x, y, angle_deg, centre=(0.0, 0.0)):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    u, v = x - centre[0], y - centre[1]
    return [centre[0] + c * u - s * v, centre[1] + s * u + c * v]


TURNED = {
    "fanuc": (
        "G68 X10. Y5. R30.\nG0 X20. Y5. Z1.\nG1 Z0. F100\nX30.\nG91 Y8.\nG90\nG2 X30. Y23. I5. J5.\nG69\nG0 X0. Y0.",
        [(20, 5), (20, 5), (30, 5), (30, 13), (30, 23)], (10.0, 5.0),
    ),
    "siemens": (
        "ROT RPL=20\nAROT Z10\nG0 X20 Y5 Z1\nG1 Z0 F100\nX=30\nG91 Y8\nG90\nG2 X30 Y23 I5 J5\nROT\nG0 X0 Y0",
        [(20, 5), (20, 5), (30, 5), (30, 13), (30, 23)], (0.0, 0.0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("dialect", TURNED)
def test_turned_coordinates_are_written_out(tmp_path, dialect):
    """30 degrees about the centre that the program states; the corrected program has no turn any more."""
    blocks, expected, centre = TURNED[dialect]
    head, last = (HEAD, "M30\n%\n") if dialect == "fanuc" else ("G71 G90 G17 G54\nG0 X0 Y0 Z5\nG1 Z0 F100\n", "M30\n")
    program = tmp_path / "p.nc"
    program.write_text(f"{head}{blocks}\n{last}")
    found = np.array(ends(program, dialect, PLAIN))[2:-1, :2]
    assert np.abs(found - [turned(x, y, 30.0, centre) for x, y in expected]).max() < 6e-4  # three decimals of FANUC
    result = correct_program(
        model_of(mill(), shift(x=10.0), None), program, tmp_path / "out", CorrectOptions(dialect), PLAIN
    )
    assert result.accepted
    text = (tmp_path / "out/p.nc").read_text()
    assert not re.search(r"^(N\d+ )?(G68|A?ROT)\b", text, re.MULTILINE)


@pytest.mark.parametrize(
    ("dialect", "blocks", "words"),
    [
        ("fanuc", "G68 X0. Y0. R30.\nG0 X5.", "place both"),
        ("fanuc", "G68 X0. Y0. R30.\nG91 X5.", "place both"),
        ("fanuc", "G68 X0. Y0. R30.\nG0 X5. Y5.\nG69\nX9.", "place both"),
        ("fanuc", "G68 X0. Y0. R30.\nG55", "end the turn"),
        ("fanuc", "G68 X0. Y0. R30.\nG18", "plane"),
        ("fanuc", "G68 X0. Y0. R30.\nG0 X5 Y5.", "decimal point"),
        ("fanuc", "G68 X0. Y0. Z0. I1. J0. K0. R30.", "turned"),
        ("fanuc", "G68 R30.", "turned"),
        ("siemens", "ROT RPL=30\nG0 X5", "place both"),
        ("siemens", "ROT RPL=30\nG0 X=IC(5) Y5", "IC"),
        ("siemens", "ROT RPL=30\nATRANS X5", "end the turn"),
        ("siemens", "ROT X30", "turned"),
        ("siemens", "G18\nROT RPL=30", "plane G17"),
    ],
)
def test_turns_that_are_not_clear_are_refused(tmp_path, dialect, blocks, words):
    head, last = (HEAD, "M30\n%\n") if dialect == "fanuc" else ("G71 G90 G17 G54\nG0 X0 Y0 Z5\nG1 Z0 F100\n", "M30\n")
    program = tmp_path / "p.nc"
    program.write_text(f"{head}{blocks}\n{last}")
    with pytest.raises(InputError, match=words):
        correct_program(
            model_of(mill(), shift(x=10.0), None), program, tmp_path / "out", CorrectOptions(dialect), PLAIN
        )
