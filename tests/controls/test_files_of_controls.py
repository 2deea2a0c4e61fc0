"""Files that real controls hold: archives, programs and parameter files that this program did not write.

All texts are made up here in the form of the real ones; their numbers are worked by hand.
"""

import json
import re
import shutil

import numpy as np
import pytest

import compgen
from compgen.cli import cli, run_command
from compgen.data.error_table import ReversalCurves, format_errors
from compgen.data.lengths import Points
from compgen.data.machine import read_machine
from compgen.errors import CompgenWarning, InputError
from compgen.tables import read_tables
from compgen.tables.active import read_active
from compgen.tables.render import load_format, render_files

MACHINE = """\
name = "mill"
chain = "WXYFZT"
[axes.X]
range_mm = [0.0, 950.0]
nodes = 6
[axes.Y]
range_mm = [-850.0, 0.0]
nodes = 6
[axes.Z]
range_mm = [-650.0, 0.0]
nodes = 6
"""


def machine_with(folder, settings=""):
    path = folder / "machine.toml"
    path.write_text(MACHINE + settings)
    return read_machine(path)


def table(index, values, axes, step, start, end, more=("DIRECTION", "MULT_BY_TABLE", "IS_MODULO"), **others):
    """One cross table as a control saves it; ``values`` of all reserved nodes."""
    lines = [f"$AN_CEC[{index},{n}]={value}" for n, value in enumerate(values)]
    numbers = {"STEP": step, "MIN": start, "MAX": end, **dict.fromkeys(more, 0), **others}
    lines += [f"$AN_CEC_INPUT_NCU[{index}]=1", f"$AN_CEC_INPUT_AXIS[{index}]=({axes[0]})"]
    lines += [f"$AN_CEC_OUTPUT_NCU[{index}]=1", f"$AN_CEC_OUTPUT_AXIS[{index}]=({axes[1]})"]
    lines += [f"$AN_CEC_{key}[{index}]={value}" for key, value in numbers.items()]
    return "\n".join([*lines, f"$AN_CEC_TYPE[{index}]=0"]) + "\n"


STRAIGHT = [0, 0, 0.002, 0.005, 0.006, 0.003, 0, -0.001, -0.004, -0.002, 0, 0, 0.007]  # 13 reserved, 10 in 0 ... 950
NOTHING = table(8, [0, 0], ("X", "X"), 0, 0, 0)
CEC_INI = (
    "METRIC\n\nCHANDATA(1)\n"
    + table(0, [0] * 12, ("AX2", "AX1"), 100, -850, 0)
    + table(2, STRAIGHT, ("AX1", "AX2"), 100, 0, 950)
    + table(7, [0, 0.001, 0], ("AX5", "AX1"), 120, -120, 120)
    + NOTHING
    + "M17\n"
)
INITIAL = """\
METRIC

CHANDATA(1)
N10000 $MN_AXCONF_MACHAX_NAME_TAB[0]="X1"
N10240 $MN_SCALING_SYSTEM_IS_METRIC=1
N18342 $MN_MM_CEC_MAX_POINTS[2]=13
N32450 $MA_BACKLASH[0,AX1]=-0.0009
N32700 $MA_ENC_COMP_ENABLE[1,AX1]=1
N32710 $MA_CEC_ENABLE[AX1]=1
N32710 $MA_CEC_ENABLE[AX2]=1
N32720 $MA_CEC_MAX_SUM[AX2]=1
N41300 $SN_CEC_TABLE_ENABLE[2]=1
N41310 $SN_CEC_TABLE_WEIGHT[2]=1
M17
"""
PROGRAM = "; Durchhang \u00fcberpr\u00fcfen\nR816=$AN_CEC [6,16]\n$AN_CEC [2,3] = R816+_SAG\nIF R1==0 GOTOF ENDE\nM30\n"


def archive(parts):
    """A start-up archive: before each file NUL bytes with its name, and other bytes around them."""
    content = b"@@MMCIBN.002" + b"\0" * 80 + b";1476518513\n;---components---\n"
    for name, kind, text in parts:
        head = (
            f"_N_{name}_{kind}".encode() + b"\0" * 30 + f"{name}.{kind}".encode() + b"\0" * 9 + b"77777\0/_N_CMA_DIR/\0"
        )
        content += b"\0" * 50 + head + text.encode("latin-1")
    return content + b"\0" * 20 + b"\x02\x88\xff\0" + b"other data\n"


def cec_archive(cec=CEC_INI, initial=INITIAL):
    return archive([("CMA", "DEF", "DEF CHAN INT _X\n"), ("SAG", "SPF", PROGRAM), ("NC_CEC", "INI", cec),
                    ("INITIAL", "INI", initial), ("LAST", "MPF", "G0 X0\nM30\n")])  # fmt: skip


def read(folder, content, controller="siemens-cec", settings="", name="control.arc"):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_tables(machine_with(folder, settings), path, controller, foreign=True)


def added(machine, tables, positions):
    return tables.correction(machine, Points(np.array(positions, dtype=float))) * 1e3


def test_the_archive_of_a_control_gives_the_tables_that_act(tmp_path):
    tables = read(tmp_path, cec_archive())
    machine = machine_with(tmp_path)
    # Y as a function of X, subtracted; 12.5 % of the way from node 8 to node 9, and what MAX cuts off the last interval
    moved = added(machine, tables, [[300, -400, -300], [812.5, -400, -300], [950, -400, -300]])
    np.testing.assert_allclose(moved, [[0, -5, 0], [0, 3.75, 0], [0, 1, 0]], atol=1e-9)
    said = "\n".join(tables.remarks)
    assert "table 7 (AX5 into AX1, up to 0.001 mm or degrees)" in said
    for words in (
        "other files of the archive",
        "SAG.SPF",
        "$MA_BACKLASH",
        "reserved nodes beyond MAX",
        "unused tables (step 0)",
    ):
        assert words in said
    assert "table 2: MIN + k STEP does not meet MAX" in said  # 950 of 0, 100, ... 1000: half of 2 um
    assert "up to 1.0 um" in said
    assert len(tables.remarks) <= 4


@pytest.mark.parametrize(
    ("line", "instead", "moved_um"),
    [
        ("N32710 $MA_CEC_ENABLE[AX2]=1", "N32710 $MA_CEC_ENABLE[AX2]=0", 0.0),
        ("N41300 $SN_CEC_TABLE_ENABLE[2]=1", "N41300 $SN_CEC_TABLE_ENABLE[2]=0", 0.0),
        ("N41310 $SN_CEC_TABLE_WEIGHT[2]=1", "N41310 $SN_CEC_TABLE_WEIGHT[2]=0.5", -2.5),
    ],
)
def test_what_the_archive_switches_off_does_not_act(tmp_path, line, instead, moved_um):
    assert line in INITIAL
    tables = read(tmp_path, cec_archive(initial=INITIAL.replace(line, instead)))
    assert added(machine_with(tmp_path), tables, [[300, -400, -300]])[0, 1] == pytest.approx(moved_um, abs=1e-9)
    assert (moved_um == 0.0) == any("switched off" in remark for remark in tables.remarks)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("$AN_CEC[2,3]=0.005", "$AN_CEC[2,3]=R816+1", r"AN_CEC\[2,3\].*not a number"),
        ("$AN_CEC[2,3]=0.005", "$AN_CEC[2,3] 0.005", "not understood, and it could change a table"),
        ("$AN_CEC[2,3]=0.005\n", "", "node 3 of 0 ... 10 is missing"),
        ("$AN_CEC[2,3]=0.005", "$AN_CEC[2,3]=0.005\n$AN_CEC[2,3]=0.004", "second value"),
        ("$AN_CEC_TYPE[2]=0", "$AN_CEC_TYPE[2]=1", "is not supported; expected 0"),
        ("$AN_CEC_TYPE[2]=0", "$AN_CEC_MAGIC[2]=1", "could change a table"),
        ("$AN_CEC_MULT_BY_TABLE[2]=0", "$AN_CEC_MULT_BY_TABLE[2]=8", "multiplied by table 7.*not in the machine file"),
        ("$AN_CEC_IS_MODULO[2]=0", "$AN_CEC_IS_MODULO[2]=7", "IS_MODULO"),
        ("METRIC\n\nCHANDATA", "INCH\n\nCHANDATA", "the file is in inch"),
        ("M17\n", "", "truncated"),
        ("(AX1)\n$AN_CEC_OUTPUT_NCU[2]=1\n$AN_CEC_OUTPUT_AXIS[2]=(AX2)",
         "(AX4)\n$AN_CEC_OUTPUT_NCU[2]=1\n$AN_CEC_OUTPUT_AXIS[2]=(AX5)", None),
    ],
)  # fmt: skip
def test_what_could_change_a_table_and_is_not_understood_is_refused_with_its_line(tmp_path, old, new, words):
    assert old in CEC_INI
    content = cec_archive(cec=CEC_INI.replace(old, new))
    if words is None:  # all tables but those of zeros are of other axes: read, and said
        assert "table 2 (AX4 into AX5" in "\n".join(read(tmp_path, content).remarks)
        return
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, content)
    assert caught.value.line and caught.value.file.name == "control.arc"


def test_an_archive_that_was_cut_within_its_machine_data_is_refused(tmp_path):
    content = cec_archive()
    cut = content[: content.index(b"N32710 $MA_CEC_ENABLE[AX2]")]
    with pytest.raises(InputError, match="the archive ends within INITIAL.INI: it is truncated") as caught:
        read(tmp_path, cut)
    assert caught.value.line


def test_an_inch_control_is_refused(tmp_path):
    with pytest.raises(InputError, match="SCALING_SYSTEM_IS_METRIC"):
        read(tmp_path, cec_archive(initial=INITIAL.replace("IS_METRIC=1", "IS_METRIC=0")))


SPF = """\
%_N_KOMP_SPF
; Kompensation gepr\u00fcft am 3.4.  ; zweiter
$MA_CEC_ENABLE[AX1] = FALSE
$SN_CEC_TABLE_ENABLE[7] = FALSE
NEWCONF
STOPRE
METRIC
$AN_CEC_INPUT_AXIS[2] = (AX1) ; Basisachse
$AN_CEC_OUTPUT_AXIS[2] = (AX1)
$AN_CEC_STEP [2] = 475
$AN_CEC_MIN[2] = 0
$AN_CEC_MAX[2] = 950
$AN_CEC_DIRECTION[2] = 1
$AN_CEC_IS_MODULO[2] = -1
$AN_CEC [2,0] = 0.000   ; -120 [Bei MKS Anzeige]
$AN_CEC [2,1] = 0,004
$AN_CEC [2,2] = 2EX-3
M0
M30
"""


def test_a_program_of_a_machine_builder_is_read(tmp_path):
    for content in (SPF.encode("latin-1"), SPF.encode(), SPF.replace("\n", "\r\n").encode("latin-1")):
        tables = read(tmp_path, content, name="KOMP.SPF")
        up = Points(np.array([[237.5, -400.0, 0.0], [950.0, -400.0, 0.0]]), approach=np.ones((2, 3)))
        np.testing.assert_allclose(tables.correction(machine_with(tmp_path), up)[:, 0] * 1e3, [-2.0, -2.0], atol=1e-9)
        said = " ".join(tables.remarks)
        for words in ("decimal commas (1)", "numbers with an exponent (1)", "without MULT_BY_TABLE", "IS_MODULO = -1"):
            assert words in said
    with pytest.raises(InputError, match="not understood"):
        read(tmp_path, SPF.replace("STOPRE", "IF R1 == 1 GOTOF ENDE"), name="KOMP.SPF")
    with pytest.raises(InputError, match="neither 0 nor 1"):
        read(tmp_path, SPF.replace("MAX[2] = 950", "MAX[2] = 949.9"), name="KOMP.SPF")
    with pytest.raises(InputError):  # verify reads what this program writes, and nothing else
        read_tables(machine_with(tmp_path), tmp_path / "KOMP.SPF", "siemens-cec")


def eec_text(values, step, start, end, encoder=0, axis="AX1"):
    lines = [f"$AA_ENC_COMP[{encoder},{n},{axis}]={value}" for n, value in enumerate(values)]
    numbers = {"STEP": step, "MIN": start, "MAX": end, "IS_MODULO": 0}
    lines += [f"$AA_ENC_COMP_{key}[{encoder},{axis}]={value}" for key, value in numbers.items()]
    return "\n".join(lines) + "\n"


def test_a_step_that_was_rounded_gives_all_nodes(tmp_path):
    """39 steps of 24.3590 mm are 950.0010 mm: the 40 values belong to 0 ... 950."""
    values = [f"{0.0001 * n:.4f}".replace(".", ",") for n in range(40)]
    text = "CHANDATA(1)\n" + eec_text(values, 24.3590, 0, 950) + "$MA_BACKLASH[0,AX1]=n/a\nNEWCONF\nM30\n"
    tables = read(tmp_path, text, "siemens-eec", name="eec.spf")
    moved = added(machine_with(tmp_path), tables, [[0, 0, 0], [24.359, 0, 0], [950, 0, 0]])[:, 0]
    np.testing.assert_allclose(moved, [0.0, -0.1, -3.9], atol=1e-5)
    assert not any("does not meet" in remark for remark in tables.remarks)


def test_tables_of_another_measuring_system_are_asked_about_if_they_act(tmp_path):
    text = (
        "METRIC\nCHANDATA(1)\n"
        + eec_text([0, 0.003, 0], 475, 0, 950, 1)
        + eec_text([0, 0.1], 360, 0, 360, 1, "AX4")
        + "M17\n"
    )
    content = archive([("AX_EEC", "INI", text), ("INITIAL", "INI", INITIAL)])
    with pytest.raises(InputError, match="for encoder 1 of AX1, but the machine file has encoder = .0.") as caught:
        read(tmp_path, content, "siemens-eec")
    assert caught.value.line
    own = "[controllers.siemens-eec]\nencoder = { X = 1 }\n"
    tables = read(tmp_path, content, "siemens-eec", own)
    assert added(machine_with(tmp_path, own), tables, [[475, 0, 0]])[0, 0] == pytest.approx(-3.0)
    assert any("encoder table of AX4" in remark for remark in tables.remarks)
    off = archive([("AX_EEC", "INI", text), ("INITIAL", "INI", INITIAL.replace("ENABLE[1,AX1]=1", "ENABLE[1,AX1]=0"))])
    with pytest.raises(InputError, match="its table has no effect"):
        read(tmp_path, off, "siemens-eec", own)


def test_an_archive_written_back_in_our_form_holds_the_same_numbers(tmp_path):
    tables = read(tmp_path, cec_archive())
    common = {"version": "1", "machine_name": "mill", "chain": "WXYFZT", "input_sha256": "0" * 64}
    context = {**common, **tables.controller.context(tables.tables)}
    text = render_files(load_format("siemens-cec"), context)["NC_CEC.INI"]
    for n, value in enumerate(STRAIGHT[:11]):
        assert f"$AN_CEC[2,{n}]={value:.6f}\n" in text
    assert "$AN_CEC_INPUT_AXIS[2]=(AX1)" in text and "$AN_CEC_OUTPUT_AXIS[2]=(AX2)" in text


# --- the commands, and the folder of an export -----------------------------------------------------------------------


@pytest.fixture
def exported(tmp_path, small_machine_file, small_errors):
    errors = tmp_path / "small.errors.csv"
    errors.write_text(format_errors(small_errors))
    out = tmp_path / "tables"
    words = ["export", str(small_machine_file), str(errors), "--controller", "siemens-cec", "--out", str(out)]
    assert run_command(cli, words) == 0
    return small_machine_file, errors, out


def test_commands_take_the_folder_of_an_export(exported, tmp_path, capsys):
    machine, errors, folder = exported
    points = tmp_path / "p.points.csv"
    points.write_text("x_mm,y_mm,z_mm\n0,0,-100\n")
    cec = ["--controller", "siemens-cec"]
    for source, name in ((folder, "a.csv"), (folder / "NC_CEC.INI", "b.csv")):
        words = ["read", str(machine), str(source), *cec, "--points", str(points), "--out", str(tmp_path / name)]
        assert run_command(cli, words) == 0
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()
    judged = ["verify", str(machine), str(folder), *cec, "--errors", str(errors), "--out", str(tmp_path / "v")]
    assert run_command(cli, judged) == 0
    against = [
        "diff",
        str(machine),
        str(folder),
        "--against",
        str(folder / "NC_CEC.INI"),
        *cec,
        "--out",
        str(tmp_path / "d"),
    ]
    assert run_command(cli, against) == 0
    assert json.loads((tmp_path / "d" / "diff.json").read_text())["same"]
    merged = ["merge", str(machine), str(folder), *cec, "--errors", str(errors), "--out", str(tmp_path / "m")]
    assert run_command(cli, merged) == 0
    assert read_active(read_machine(machine), [folder], "siemens-cec").paths == (folder / "NC_CEC.INI",)
    capsys.readouterr()


def test_a_folder_that_does_not_fit_is_refused_and_a_changed_table_is_said(exported, tmp_path, capsys):
    machine, errors, folder = exported

    def judged(source, controller="siemens-cec"):
        words = ["verify", str(machine), str(source), "--controller", controller, "--errors", str(errors)]
        code = run_command(cli, [*words, "--out", str(tmp_path / "v")])
        return code, capsys.readouterr().err

    assert judged(folder, "isg-csv")[0] == 2
    (tmp_path / "empty").mkdir()
    code, said = judged(tmp_path / "empty")
    assert code == 2 and "without manifest.json" in said
    several = tmp_path / "several"
    several.mkdir()
    shutil.copytree(folder, several / "siemens-cec")
    assert judged(several)[0] == 0
    text = (folder / "NC_CEC.INI").read_text()
    (folder / "NC_CEC.INI").write_text(text.replace("0.0", "0.1", 1))
    assert "changed after the export" in judged(folder)[1]
    for bad in (
        "{",
        '{"controller": "siemens-cec", "files": []}',
        '{"controller": "siemens-cec", "files": [{"name": "../x"}]}',
    ):
        (folder / "manifest.json").write_text(bad)
        assert judged(folder)[0] == 2


def test_our_own_tables_stay_strict(exported, tmp_path, capsys):
    machine, _, folder = exported
    path = folder / "NC_CEC.INI"
    text = path.read_text()
    points = tmp_path / "p.points.csv"
    points.write_text("x_mm,y_mm,z_mm\n0,0,-100\n")
    words = ["read", str(machine), str(path), "--controller", "siemens-cec", "--points", str(points)]
    for old, new in (
        ("M17", "STOPRE\nM17"),
        ("$AN_CEC_MULT_BY_TABLE[0]=0\n", ""),
        ("$AN_CEC[0,1]=", "$AN_CEC [0,1]=0,"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
        assert run_command(cli, [*words, "--out", str(tmp_path / "o.csv")]) == 2
        assert not (tmp_path / "o.csv").exists()
    capsys.readouterr()


def test_the_active_tables_of_an_archive_are_said_once(tmp_path):
    (tmp_path / "control.arc").write_bytes(cec_archive())
    with pytest.warns(CompgenWarning) as said:
        active = read_active(machine_with(tmp_path), [tmp_path / "control.arc"], "siemens-cec")
    assert sum("kept separate: table 7" in str(warning.message) for warning in said) == 1
    assert active.paths == (tmp_path / "control.arc",)


# --- PMAC ------------------------------------------------------------------------------------------------------------

PMAC_FILE = """\
; \u30d4\u30c3\u30c1\u88dc\u6b63 table
CLOSE
DELETE GATHER
#1->1000X
I100=1 ; motor on
P1=0
OPEN PLC 1 CLEAR
IF (P1=1) CMD"I51=0"
CLOSE
#4 DEFINE COMP 8 #20,#20,8000000
-16000,0,0,0,0,0,0,0
#1 DEFINE COMP 8 #1,#1,8000000 // pitch
-16000,-8000 , 0,0
0,0,0,0
"""
PMAC = "[controllers.pmac]\ncounts_per_mm = 8000.0\n"


def test_a_pmac_backup_is_read_and_other_motors_are_kept_apart(tmp_path):
    tables = read(tmp_path, PMAC_FILE, "pmac", PMAC, "comp.pmc")
    # 8 entries over 1000 mm: -16000 / 16 = -1000 counts at 125 mm, which are -125 um; half of it at 250 mm
    moved = added(machine_with(tmp_path, PMAC), tables, [[125, 0, 0], [62.5, 0, 0], [250, 0, 0]])[:, 0]
    np.testing.assert_allclose(moved, [-125.0, -62.5, -62.5], atol=1e-9)
    said = " ".join(tables.remarks)
    assert "motor 4 (uses #20)" in said and "(8 lines)" in said and "no file sets I51" in said
    assert "motor 1 (uses" not in said
    off = read(tmp_path, PMAC_FILE + "I51=0\n", "pmac", PMAC, "comp.pmc")
    assert not np.any(added(machine_with(tmp_path, PMAC), off, [[125, 0, 0]]))


def test_the_backlash_of_a_pmac_backup_is_that_of_the_axes(tmp_path):
    """Entries of the motor's own table: 160 / 16 = 10 counts at 125 mm, which are 1.25 um after negative travel."""
    blcomp = "#4 DEFINE BLCOMP 8,8000000\n1600 0 0 0 0 0 0 0\n#1 DEFINE BLCOMP 8,8000000\n160 0 0 0 0 0 0 0\n"
    tables = read(tmp_path, PMAC_FILE + blcomp + "I51=1\n", "pmac", PMAC, "comp.pmc")
    at = np.array([[125.0, 0.0, 0.0]])
    up, down = (
        tables.correction(machine_with(tmp_path, PMAC), Points(at, approach=np.full((1, 3), sign)))[0, 0]
        for sign in (1.0, -1.0)
    )
    assert up - down == pytest.approx(1.25e-3, abs=1e-12)
    assert "motor 4 (uses #4)" in " ".join(tables.remarks)


def test_a_pmac_backup_without_tables_of_the_axes_is_refused_with_those_that_it_has(tmp_path):
    with pytest.raises(InputError, match=r"no table for the motors #1, #2, #3; .*: motor 4 \(uses #20\)$"):
        read(tmp_path, PMAC_FILE.partition("#1 DEFINE")[0], "pmac", PMAC, "comp.pmc")


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("-8000 , 0", "-8000.5 , 0", 13, "not a whole number"),
        (" 0,0\n0,0,0,0\n", " 0,0\n0,0,0\n", None, "the file is truncated"),
        ("P1=0", "I51=P1", 6, "not understood"),
        ("P1=0", "DEFINE COMP ALL", 6, "not understood"),
        ("P1=0", "I51..53=0", 6, "not understood"),
        ("#1 DEFINE", "#2 DEFINE", None, None),
    ],
)
def test_what_could_change_a_pmac_table_is_refused(tmp_path, old, new, line, words):
    text = PMAC_FILE.replace(old, new)
    if words is None:  # the table of motor 2 acts on motor 1
        assert added(machine_with(tmp_path, PMAC), read(tmp_path, text, "pmac", PMAC, "c.pmc"), [[125, 0, 0]])[0, 0] < 0
        return
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path, text, "pmac", PMAC, "comp.pmc")
    assert line is None or caught.value.line == line


# --- TwinCAT ---------------------------------------------------------------------------------------------------------

AXIS_LIST = """\
# Achskompensationsdaten gepr\u00fcft
kopf.achs_nr            1
kopf.log_achs_name      X
lr_param.ssfk           1
kw.ssfk.unit            0      /* Inkremente f\u00fcr die Werte */
kw.ssfk.interval        4750000
kw.ssfk.kw_startpos     0
kw.ssfk.kw_nr_max       3
kw.ssfk.bilateral       0
kw.ssfk.res1            0
kw.ssfk.table[0].pos    0
kw.ssfk.table[1].pos    40
kw.ssfk.table[2].pos    -20
"""


def test_a_list_in_encoder_increments_needs_their_length(tmp_path):
    with pytest.raises(InputError, match=r"unit: 0 means .*increment_um = \{ X = 0.1 \}") as caught:
        read(tmp_path, AXIS_LIST.encode("latin-1"), "twincat-lists", name="achskw1.lis")
    assert caught.value.line == 5
    own = "[controllers.twincat-lists]\nincrement_um = { X = 0.25 }\n"
    tables = read(tmp_path, AXIS_LIST.encode("latin-1"), "twincat-lists", own, "achskw1.lis")
    moved = added(machine_with(tmp_path, own), tables, [[475, 0, 0], [950, 0, 0], [237.5, 0, 0]])[:, 0]
    np.testing.assert_allclose(moved, [-10.0, 5.0, -5.0], atol=1e-9)  # actual minus nominal: taken off
    said = " ".join(tables.remarks)
    assert "reserved entries of kw.ssfk (1)" in said and "entries of lr_param (1)" in said


def test_axis_lists_of_other_axes_are_kept_apart_and_unknown_entries_refused(tmp_path):
    own = "[controllers.twincat-lists]\nincrement_um = { X = 0.25 }\n"
    machine = machine_with(tmp_path, own)
    first, other = tmp_path / "a1.lis", tmp_path / "a5.lis"
    first.write_text(AXIS_LIST, encoding="utf-8")
    other.write_text(AXIS_LIST.replace("achs_nr            1", "achs_nr            5"), encoding="utf-8")
    tables = read_tables(machine, [first, other], "twincat-lists", foreign=True)
    assert any("the list of axis 5 (a5.lis)" in remark for remark in tables.remarks)
    with pytest.raises(InputError, match="contains no table for an axis of the machine file"):
        read_tables(machine, other, "twincat-lists", foreign=True)
    first.write_text(AXIS_LIST.replace("kw.ssfk.res1 ", "kw.ssfk.gain "), encoding="utf-8")
    with pytest.raises(InputError, match="not a parameter of these lists") as caught:
        read_tables(machine, first, "twincat-lists", foreign=True)
    assert caught.value.line == 10


# --- LinuxCNC --------------------------------------------------------------------------------------------------------

POSITIONS = "0 -0.003 0.002\n500 499.998 500.004\n950 950.001 950\n"


@pytest.mark.parametrize(
    ("name", "axis"), [("screwcompX.dat", 0), ("screwcompZ.dat", 2), ("comp_y.txt", 1), ("joint1.comp", 1)]
)
def test_a_comp_file_of_any_name_is_read(tmp_path, name, axis):
    own = "[controllers.linuxcnc-comp]\ncomp_file_type = 0\n"
    tables = read(tmp_path, POSITIONS, "linuxcnc-comp", own, name)
    up = Points(np.full((1, 3), 500.0), approach=np.ones((1, 3)))
    moved = tables.correction(machine_with(tmp_path, own), up)[0] * 1e3
    assert moved[axis] == pytest.approx(2.0, abs=1e-4)  # nominal minus actual
    assert not np.any(np.delete(moved, axis))


def test_a_comp_file_without_a_letter_is_asked_about_and_a_wrong_type_is_refused(tmp_path):
    own = "[controllers.linuxcnc-comp]\ncomp_file_type = 0\n"
    with pytest.raises(InputError, match=r'comp_files = \{ X = "screw.dat" \}'):
        read(tmp_path, POSITIONS, "linuxcnc-comp", own, "screw.dat")
    stated = own + 'comp_files = { Y = "screw.dat" }\n'
    tables = read(tmp_path, POSITIONS, "linuxcnc-comp", stated, "screw.dat")
    assert list(tables.tables.tables) == [1]
    with pytest.raises(InputError, match="nominal and actual positions .file type 0."):
        read(tmp_path, POSITIONS, "linuxcnc-comp", "", "screwcompX.dat")
    with pytest.raises(InputError, match="these are trims .file type 1."):
        read(tmp_path, "0 0 0\n500 0.002 0.004\n950 0.001 0\n", "linuxcnc-comp", own, "screwcompX.dat")


# --- ISG -------------------------------------------------------------------------------------------------------------


def test_comments_of_any_language_do_not_keep_a_table_from_being_read(tmp_path):
    text = "// gepr\u00fcft\nX EXX\n0.0 0.0\n950.0 0.019\n"
    tables = read(tmp_path, text.encode("latin-1"), "isg-csv", name="volcomp0.csv")
    assert added(machine_with(tmp_path), tables, [[475, 0, 0]])[0, 0] == pytest.approx(-9.5, abs=0.01)
    assert any("not ASCII" in remark for remark in tables.remarks)
    with pytest.raises(InputError):
        read(tmp_path, text.replace("950.0 ", "950.0\u00a0").encode("latin-1"), "isg-csv", name="volcomp0.csv")
    with pytest.raises(InputError, match="ASCII"):
        read_tables(machine_with(tmp_path), tmp_path / "volcomp0.csv", "isg-csv")


# --- tables of other axes stay where they are ------------------------------------------------------------------------


def test_new_tables_keep_off_the_indices_of_other_axes(tmp_path, small_machine, small_errors):
    """An archive with a table of a rotary axis at index 7 says so; with kept_tables nothing is written there."""
    assert "kept_tables = [7]" in "\n".join(read(tmp_path, cec_archive()).remarks)
    own = "[controllers.siemens-cec]\nkept_tables = [7, 1]\n"
    assert "kept_tables = " not in "\n".join(read(tmp_path, cec_archive(), settings=own).remarks)
    plain = compgen.export(small_machine, small_errors, "siemens-cec").files["NC_CEC.INI"]
    kept = small_machine.with_setting("siemens-cec", "kept_tables", [0, 3, 7])
    made = compgen.export(kept, small_errors, "siemens-cec")
    text = made.files["NC_CEC.INI"]
    assert not re.search(r"\$[A-Z_]+\[[037][],]", text)
    assert len(re.findall("STEP", text)) == len(re.findall("STEP", plain))
    paths = made.write(tmp_path / "out")
    result = compgen.verify(kept, read_tables(kept, paths, "siemens-cec"), small_errors)
    assert result.accepted and result.after.max_um < 1.0
    other = small_machine.with_setting("siemens-cec", "kept_tables", [5])
    judged = compgen.verify(other, read_tables(other, paths, "siemens-cec"), small_errors)
    assert any("table 5" in reason and "kept_tables" in reason for reason in judged.reasons)


def test_a_pair_of_one_direction_keeps_off_them_too(small_machine, small_errors):
    reversal = ReversalCurves({(0, 0): compgen.Curve(np.zeros(1), np.array([-8e-3]), np.zeros(1))})
    plain = compgen.export(small_machine, small_errors, "siemens-cec", reversal=reversal).files["NC_CEC.INI"]
    last = max(int(index) for index in re.findall(r"STEP\[(\d+)\]", plain))
    machine = small_machine.with_setting("siemens-cec", "kept_tables", [last])
    text = compgen.export(machine, small_errors, "siemens-cec", reversal=reversal).files["NC_CEC.INI"]
    assert f"$AN_CEC_STEP[{last}]" not in text and f"$AN_CEC_STEP[{last + 1}]" in text


# --- what --active shows of other axes is kept -----------------------------------------------------------------------

SMALL_ERRORS = "error,position_mm,value,u_value\n" + "".join(
    f"{name},{at},{value},\n"
    for name, ends in (("EXX", (0, 950)), ("EYY", (-850, 0)), ("EZZ", (-650, 0)), ("EYX", (0, 950)))
    for at, value in zip(ends, (0.0, 9.0), strict=True)
)


def export_with_active(folder, active, controller, settings="", more=()):
    machine_with(folder, settings)
    (folder / "e.errors.csv").write_text(SMALL_ERRORS)
    words = ["export", folder / "machine.toml", folder / "e.errors.csv", "--controller", controller]
    words += [word for path in active for word in ("--active", path)]
    out = folder / "out"
    code = run_command(cli, [str(word) for word in (*words, "--out", out, "--allow-unverified", *more)])
    return code, out


@pytest.mark.parametrize("controller", ["siemens-cec", "siemens-cec-eec"])
def test_an_active_archive_keeps_the_tables_of_other_axes(tmp_path, controller):
    """Table 1 goes from A into Y: the file has tables 0 and 2, ..., and nothing tells to switch table 1 off."""
    cec = CEC_INI.replace("M17\n", table(1, [0, 0.001, 0], ("AX4", "AX2"), 90, 0, 180) + "M17\n")
    encoder = "CHANDATA(1)\n" + "".join(
        f"$AA_ENC_COMP[0,{n},{axis}]=0\n" for axis in ("AX1", "AX2", "AX3") for n in range(2)
    )
    for axis, low, high in (("AX1", 0, 950), ("AX2", -850, 0), ("AX3", -650, 0)):
        values = {"STEP": high - low, "MIN": low, "MAX": high, "IS_MODULO": 0}
        encoder += "".join(f"$AA_ENC_COMP_{key}[0,{axis}]={value}\n" for key, value in values.items())
    content = archive([("NC_CEC", "INI", cec), ("AX_EEC", "INI", encoder + "M17\n"), ("INITIAL", "INI", INITIAL)])
    (tmp_path / "control.arc").write_bytes(content)
    own = '[controllers.siemens-cec-eec]\nmult_mode = "S1"\nsign = "error"\n'
    own += '[controllers.siemens-cec]\nmult_mode = "S1"\nsign = "error"\n'
    code, out = export_with_active(tmp_path, [tmp_path / "control.arc"], controller, own)
    assert code == 0
    text = (out / "NC_CEC.INI").read_text()
    assert "$AN_CEC_STEP[0]" in text and "$AN_CEC_STEP[1]" not in text and "$AN_CEC_STEP[2]" in text
    assert "$AN_CEC_STEP[7]" not in text
    told = (out / "preflight.md").read_text()
    assert "Tables kept (kept_tables): 1, 7" in told
    assert "SD41300 = 0 for every other one except 1, 7" in told
    assert "index 0, input" in told and "table 2 with both nodes 0.3" in told and "MULT_BY_TABLE[0] = 3" in told
    assert "$SN_CEC_TABLE_ENABLE[0, 2" in told


def test_without_an_archive_preflight_says_that_tables_of_other_axes_are_not_known(small_machine, small_errors):
    told = compgen.export(small_machine, small_errors, "siemens-cec").preflight
    first = told.split("## What the files overwrite")[1].strip().split("\n")[0]
    assert first.startswith("- Of other axes: NOT KNOWN")


FANUC_BACKUP = """%
N03620Q1A1P40A2P140A3P240A4P1
N03621Q1A1P40A2P131A3P231A4P1
N03622Q1A1P59A2P145A3P245A4P30
N03623Q1A1P1A2P1A3P1A4P1
N03624Q1A1P50.0A2P100.0A3P100.0A4P12.0
N05711Q1P0
N05712Q1P0
N05713Q1P0
%
"""


def test_an_active_backup_of_a_fanuc_keeps_the_points_of_other_axes(tmp_path):
    """The rotary axis A4 has points 1 to 30, where the points of X would begin otherwise."""
    (tmp_path / "PRM.TXT").write_text(FANUC_BACKUP)
    rows = [f"N{10000 + k}Q0P0" for k in range(300)]
    (tmp_path / "PITCH.TXT").write_text("\n".join(["%", *rows, "%", ""]))
    code, out = export_with_active(tmp_path, [tmp_path / "PRM.TXT", tmp_path / "PITCH.TXT"], "fanuc-pitch")
    assert code == 0
    told = (out / "preflight.md").read_text()
    assert "Of other axes: nothing. Kept: A4: points 1 to 30." in told
    written = {int(n) - 10000 for n in re.findall(r"(?m)^N(1\d{4})Q0", (out / "PITCH.TXT").read_text())}
    assert not written & set(range(1, 31)) and written >= set(range(41, 60))


def test_an_active_parameter_file_of_a_mitsubishi_is_followed(tmp_path):
    rows = ["%", ";M80", "N4000P0"]
    for k in range(10):
        own = {0: ("A", "A", 4101, 4101, 4150, 1, "7.200"), 1: ("X", "X", 4210, 4201, 4220, 1, "100.000")}
        own = own.get(k, ("", "", 0, 0, 0, 0, "0.000"))
        rows += [f"N{4001 + 10 * k + j}P{value}" for j, value in enumerate(own)]
    rows += [f"N{number}P0" for number in range(4101, 6000)]
    (tmp_path / "ALL.PRM").write_text("\n".join([*rows, "%", ""]))
    settings = "[controllers.mitsubishi]\nrelative_errors = false\nscale = 2\n"
    code, out = export_with_active(tmp_path, [tmp_path / "ALL.PRM"], "mitsubishi", settings)
    assert code == 0 and (out / "ALL-NEW.PRM").is_file()
    text = (out / "ALL-NEW.PRM").read_text()
    assert "\nN4001PA\n" in text and "\nN4000P0\n" in text


def test_merge_keeps_the_tables_of_other_axes_as_well(tmp_path):
    (tmp_path / "control.arc").write_bytes(cec_archive())
    machine_with(tmp_path, '[controllers.siemens-cec]\nmult_mode = "S1"\n')
    (tmp_path / "e.errors.csv").write_text(SMALL_ERRORS)
    words = ["merge", tmp_path / "machine.toml", tmp_path / "control.arc", "--controller", "siemens-cec"]
    words += ["--errors", tmp_path / "e.errors.csv", "--out", tmp_path / "out"]
    assert run_command(cli, [str(word) for word in words]) == 0
    assert "$AN_CEC_STEP[7]" not in (tmp_path / "out" / "NC_CEC.INI").read_text()


def test_diff_follows_a_file_of_the_control_and_shows_remarks(tmp_path, capsys):
    (tmp_path / "PRM.TXT").write_text(FANUC_BACKUP)
    rows = [f"N{10000 + k}Q0P0" for k in range(300)]
    (tmp_path / "PITCH.TXT").write_text("\n".join(["%", *rows, "%", ""]))
    machine_with(tmp_path)
    files = [tmp_path / "PRM.TXT", tmp_path / "PITCH.TXT"]
    words = ["diff", tmp_path / "machine.toml", *files, "--against", *files, "--controller", "fanuc-pitch"]
    words += ["--style-from", files[0], "--style-from", files[1], "--json", "--out", tmp_path / "out"]
    assert run_command(cli, [str(word) for word in words]) == 0
    data = json.loads(capsys.readouterr().out)
    assert any("axis A4" in remark for remark in data["remarks_a"]) and data["remarks_a"] == data["remarks_b"]


@pytest.mark.parametrize(
    "line",
    ["G90 G64 G500", "N10 G71 G40 D0", "SUPA", "ANFANG:", "DEF REAL _HUB, _SAG", "DEF STRING[32] _TEXT", "DISPLOF",
     "EXTERN L99 (REAL, INT)", "G4 F0.5", 'MSG("bitte warten")'],
)  # fmt: skip
def test_words_without_a_value_that_cannot_change_a_table_are_passed_over(tmp_path, line):
    read(tmp_path, SPF.replace("STOPRE", line), name="KOMP.SPF")


@pytest.mark.parametrize(
    "line",
    ["G70", "G90 G700", "$AN_CEC_STEP[2] 475", "$AN_CEC[2,1] 0.004", "GOTOF ENDE", "L99", "L99(0.5)", "DEF REAL _X=$AN_CEC[2,1]",
     "R1=5", "IF _X > 3", "G90 $AN_CEC[2,1]=0.1", "M55", "WHILE TRUE"],
)  # fmt: skip
def test_words_that_could_change_a_table_are_refused(tmp_path, line):
    with pytest.raises(InputError) as caught:
        read(tmp_path, SPF.replace("STOPRE", line), name="KOMP.SPF")
    assert caught.value.line == 6


@pytest.mark.parametrize(
    ("controller", "words"),
    [
        (
            "pmac",
            [
                "- Of motors that are not X, Y or Z: NOT KNOWN. These get a table: 4.",
                "an existing one is lost",
                "motors 1 (X), 2 (Y), 3 (Z)",
                "I51",
            ],
        ),
        ("twincat-lists", ["- Of other axes: nothing.", "The complete compensation lists of X, Y and Z"]),
        ("siemens-eec", ["of other axes: none", "The encoder table of AX1, measuring system 1"]),
        ("siemens-cec-eec", ["- Of other axes: NOT KNOWN", "- Tables 0 ... "]),
    ],
)
def test_preflight_says_what_the_files_overwrite(tmp_path, controller, words):
    settings = "[controllers.pmac]\ncounts_per_mm = 1000.0\n"
    settings += '[controllers.siemens-cec-eec]\nmult_mode = "S1"\nsign = "error"\n'
    machine_with(tmp_path, settings)
    (tmp_path / "e.errors.csv").write_text(SMALL_ERRORS)
    machine, errors = read_machine(tmp_path / "machine.toml"), compgen.read_errors(tmp_path / "e.errors.csv")
    told = compgen.export(machine, errors, controller, allow_unverified=True).preflight
    section = told.split("## What the files overwrite")[1].split("\n## ")[0]
    assert all(word in section for word in words), section
