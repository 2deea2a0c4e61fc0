"""Tables of rotary axes over their own angle: values by hand, wrap, reversal, senses, faults, for every control by command."""

import json
from pathlib import Path

import numpy as np
import pytest

from compgen.controls import ROTARY_PITCH
from compgen.controls.rotary_pitch import AngleTable, format_of
from compgen.data.error_table import ErrorTable
from compgen.data.machine import parse_machine
from compgen.data.rotary import RAD_PER_ARCSEC, RotaryCurve, RotaryErrors, format_machine_errors, read_machine_errors
from compgen.errors import InputError
from compgen.tables.rotary_pitch import export_pitch, judged_pitch, pitch_tables

MACHINE = """name = "trunnion"
chain = "WCAYFXZT"
axes.X = { range_mm = [-400.0, 400.0], nodes = 3 }
axes.Y = { range_mm = [-400.0, 400.0], nodes = 3 }
axes.Z = { range_mm = [-300.0, 400.0], nodes = 3 }
axes.A = { point_mm = [0.0, 0.0, -50.0], range_deg = [-110.0, 30.0], nodes = 8 }
axes.C = { point_mm = [0.0, 0.0, 0.0], modulo_deg = 360.0, nodes = 13 }
"""
NEEDED = {
    "linuxcnc-rotary-comp": "",
    "siemens-rotary-eec": 'axis_names = { A = "AX4", C = "AX5" }',
    "siemens-rotary-cec": 'axis_names = { A = "AX4", C = "AX5" }',
    "fanuc-rotary-pitch": "axis_numbers = { A = 4, C = 5 }\ndetection_unit_deg = 0.0001",
    "heidenhain-rotary-com": "negative_as_turn = true",
    "twincat-rotary-list": "axis_numbers = { A = 4, C = 5 }",
    "aerotech-rotary": "axis_numbers = { A = 4, C = 5 }",
}
BOTH_WAYS = ("linuxcnc-rotary-comp", "siemens-rotary-cec", "twincat-rotary-list")
#: Coarsest step of each file, arcsec: six decimals, counts of 0.0001 degrees, four decimals, 0.01 of 0.0001 degrees.
STEP = {"fanuc-rotary-pitch": 0.36, "heidenhain-rotary-com": 0.36}


def form_of(name, more="", sense=""):
    section = f"[controllers.{name}]\n{NEEDED[name]}\n{sense}\n{more}\n"
    return format_of(parse_machine(MACHINE + section, Path("m.toml")), name)


def errors():
    """C: 8 arcsec sin at uneven angles, a turn; A: steep on one side; zero at 0; reversals of C +2, of A -3 arcsec."""
    c = np.array([0.0, 20.0, 50.0, 90.0, 150.0, 200.0, 270.0, 310.0, 360.0])
    a = np.array([-110.0, -60.0, -25.0, 0.0, 30.0])
    curves = {
        "ECC": RotaryCurve(c, 8.0 * RAD_PER_ARCSEC * np.sin(np.radians(c)), np.full(9, np.nan)),
        "EAA": RotaryCurve(a, RAD_PER_ARCSEC * np.array([9.0, -4.0, 1.5, 0.0, -6.0]), np.full(5, np.nan)),
    }
    return RotaryErrors(curves, {}, {"A": -3.0 * RAD_PER_ARCSEC, "C": 2.0 * RAD_PER_ARCSEC})


@pytest.mark.parametrize("sense", ["", 'reversed_axes = ["A", "C"]'])
@pytest.mark.parametrize("name", ROTARY_PITCH)
def test_read_back_the_tables_leave_their_last_digit(name, sense):
    """Against the curves themselves, between all nodes, in the turns before and after, in both directions of travel."""
    form, truth = form_of(name, sense=sense), errors()
    found = export_pitch(form, truth)
    assert not found.reasons, found.reasons
    tables = form.parse({Path(key): text for key, text in found.files.items()})
    for letter, at in (("A", np.linspace(-110.0, 30.0, 577)), ("C", np.linspace(-359.0, 719.0, 1079))):
        axis, curve = form.machine.rotary[letter], truth.curves[f"E{letter}{letter}"]
        true = curve.at(at, axis.modulo_deg) / RAD_PER_ARCSEC
        half = truth.reversal[letter] / RAD_PER_ARCSEC / 2.0 if name in BOTH_WAYS else 0.0
        for way in (1, -1):
            left = true + way * half + 3600.0 * tables[letter].emulated(at, way)
            assert np.abs(left).max() < 0.03 + 1.3 * STEP.get(name, 0.0), (letter, way)
    if name not in BOTH_WAYS:
        assert sum("Reversal of" in text for text in found.instructions) == 2
        assert found.angle_arcsec["C"]["reversal_after"] == pytest.approx(2.0)
    else:
        assert found.angle_arcsec["A"]["reversal_before"] == pytest.approx(-3.0)
        assert abs(found.angle_arcsec["A"]["reversal_after"]) < 0.01


@pytest.mark.parametrize("name", ROTARY_PITCH)
def test_a_table_for_the_opposite_error_doubles_it_and_is_not_accepted(name):
    form, truth = form_of(name), errors()
    opposite = {key: RotaryCurve(own.angle_deg, -own.value, own.u) for key, own in truth.curves.items()}
    files = form.files(pitch_tables(form.machine, RotaryErrors(opposite)))
    wrong = judged_pitch(form, truth, {Path(key): text for key, text in files.items()})
    assert sum("does not shrink" in text for text in wrong.reasons) == 2
    assert wrong.angle_arcsec["A"]["after_max"] == pytest.approx(2.0 * wrong.angle_arcsec["A"]["before_max"], rel=0.03)


def test_a_file_made_for_the_other_sense_is_not_accepted():
    other = form_of("linuxcnc-rotary-comp", sense='reversed_axes = ["A", "C"]')
    files = other.files(pitch_tables(other.machine, errors()))
    wrong = judged_pitch(form_of(other.name), errors(), {Path(key): text for key, text in files.items()})
    assert any(text.startswith("A: the error of the angle does not shrink") for text in wrong.reasons)


def square():
    """C: 0, +7.2, 0, -7.2 arcsec (0.002 degrees) too far at 0, 90, 180, 270 degrees; 3.6 arcsec more in positive travel."""
    at = np.array([0.0, 90.0, 180.0, 270.0, 360.0])
    curve = RotaryCurve(at, RAD_PER_ARCSEC * np.array([0.0, 7.2, 0.0, -7.2, 0.0]), np.full(5, np.nan))
    return RotaryErrors({"ECC": curve}, {}, {"C": 3.6 * RAD_PER_ARCSEC})


def written(name, more="", sense=""):
    found = export_pitch(form_of(name, more, sense), square())
    (text,) = found.files.values()
    return text, found


def test_fanuc_by_hand():
    """2 counts of 0.001 degrees too far at 90: -2 over the section before it, +2 over the next; the first is the last."""
    more = "[controllers.fanuc-rotary-pitch]\naxis_numbers = { A = 4, C = 5 }\ninterval_deg = 90.0\nfirst_number = 60\n"
    form = format_of(parse_machine(MACHINE + more, Path("m.toml")), "fanuc-rotary-pitch")
    found = export_pitch(form, square())
    (text,) = found.files.values()
    assert text.split() == [
        *("%", "N03620A5P60", "N03621A5P60", "N03622A5P64", "N03623A5P1", "N03624A5P90.000", "N03625A5P360.000"),
        *("N10060P-2", "N10061P-2", "N10062P2", "N10063P2", "N10064P-2", "%"),
    ]
    assert (
        "parameter 1851 of A5 = -1 detection units" in found.instructions[-1]
    )  # 3.6 arcsec further in positive travel
    quick = format_of(parse_machine(MACHINE + more + "q_word = true\n", Path("m.toml")), form.name)
    text = export_pitch(quick, square()).files["ROTARYPITCH.TXT"]
    assert "N03620Q1A5P60\n" in text and "N10062Q0P2\n" in text


def test_fanuc_example_of_the_manual():
    """45 degrees, reference 60: points 60 to 68; a section is before its point; the sum repeats every turn."""
    values = {60: 1, 61: -2, 62: 0, 63: 3, 64: 1, 65: -1, 66: -2, 67: 0, 68: 1}
    head = "%\nN03620A5P60\nN03621A5P60\nN03622A5P68\nN03623A5P2\nN03624A5P45.0\nN03625A5P360.0\n"
    text = head + "".join(f"N{10000 + k}P{v}\n" for k, v in values.items()) + "%\n"
    form = form_of("fanuc-rotary-pitch")
    table = form.parse({Path("x.txt"): text})["C"]
    # one count is 2 x 0.0001 degrees; sums -2, -2, 1, 2, 1, -1, -1, 0 at 45, 90, ..., 360
    at = np.array([0.0, 45.0, 67.5, 112.5, 135.0, 180.0, 360.0, -45.0, -180.0, 405.0])
    counts = np.array([0.0, -2.0, -2.0, -0.5, 1.0, 2.0, 0.0, -1.0, 2.0, -2.0])
    assert table.emulated(at) == pytest.approx(2e-4 * counts) and not table.faults
    drifting = form.parse({Path("x.txt"): text.replace("N10067P0", "N10067P1")})["C"]
    assert "sum to 1 counts over a turn" in drifting.faults[0]
    with pytest.raises(InputError, match="are not one revolution"):
        form.parse({Path("x.txt"): text.replace("N03622A5P68", "N03622A5P67")})
    with pytest.raises(InputError, match="point 66 is missing"):
        form.parse({Path("x.txt"): text.replace("N10066P-2\n", "")})
    again = form_of("fanuc-rotary-pitch", "reference_position_deg = { C = 90.0 }").parse({Path("x.txt"): text})["C"]
    assert again.emulated(at + 90.0) == pytest.approx(2e-4 * counts)


def test_twincat_by_hand():
    """Stored is actual minus nominal in 0.0001 degrees: at 90 degrees 20, and 5 more or less by direction."""
    text, found = written("twincat-rotary-list")
    for row in (
        "[5].setpoint 900000.00",
        "[5].pos 25.00",
        "[5].neg 15.00",
        "[1].setpoint -2700000.00",
        "[12].pos 5.00",
    ):
        assert f"kw.ssfk.table{row}\n" in text
    assert "kw.ssfk.bilateral 1\n" in text and "kw.ssfk.modulo 0\n" in text and "kopf.achs_nr 5\n" in text
    with pytest.raises(InputError, match="no document says which node closes"):
        form_of("twincat-rotary-list").parse({Path("c.lis"): text.replace("modulo 0", "modulo 1")})
    even = "kopf.achs_nr 5\nkw.ssfk.unit 1\nkw.ssfk.interval 900000\nkw.ssfk.kw_startpos 0\nkw.ssfk.kw_nr_max 2\n"
    even += "kw.ssfk.bilateral 0\nkw.ssfk.table[0].pos 0\nkw.ssfk.table[1].pos 36\n"
    table = form_of("twincat-rotary-list").parse({Path("c.lis"): even})["C"]
    assert table.emulated(np.array([45.0, 90.0, 200.0])) == pytest.approx([-0.0018, -0.0036, -0.0036])


def test_cec_by_hand():
    """Error, which the control subtracts: +0.0025 and +0.0015 at 90 degrees; as correction with the opposite sign."""
    text, found = written("siemens-rotary-cec", "first_table = 6")
    assert "$AN_CEC[6,1]=0.002500\n" in text and "$AN_CEC[7,1]=0.001500\n" in text
    assert "$AN_CEC_DIRECTION[6]=1\n" in text and "$AN_CEC_DIRECTION[7]=-1\n" in text
    assert "$AN_CEC_INPUT_AXIS[6]=(AX5)\n" in text and "$AN_CEC_IS_MODULO[6]=1\n" in text
    text, _ = written("siemens-rotary-cec", 'sign = "correction"')
    assert "$AN_CEC[0,1]=-0.002500\n" in text
    text, _ = written("siemens-rotary-cec", sense='reversed_axes = ["C"]')
    assert "$AN_CEC_MIN[0]=-360.000000" in text  # at -90, travelling up is travelling down: -0.0015
    assert "$AN_CEC[0,3]=-0.001500\n" in text and "$AN_CEC[1,3]=-0.002500\n" in text


def test_heidenhain_by_hand():
    """Entries are errors in degrees; the turn closes; a column that acts on something else is refused."""
    text, found = written("heidenhain-rotary-com")
    rows = [line.split() for line in text.splitlines()]
    assert rows[0] == ["BEGIN", "AXIS_C", ".COM", "MM"] and rows[1] == ["NR", "AXISPOS", "BACKLASH", "C"]
    assert rows[3] == ["1", "90.0000", "0.0000", "0.0020"] and rows[6] == ["4", "360.0000", "0.0000", "0.0000"]
    form = form_of("heidenhain-rotary-com")
    with pytest.raises(InputError, match="column BACKLASH is not zero"):
        form.parse({Path("AXIS_C.COM"): text.replace("90.0000      0.0000", "90.0000      0.0010")})
    open_turn = form.parse({Path("AXIS_C.COM"): text.replace("360.0000", "359.0000")})["C"]
    assert "do not close" in open_turn.faults[0]
    with pytest.raises(InputError, match="no document says"):
        plain = parse_machine(MACHINE, Path("m.toml"))
        export_pitch(format_of(plain, form.name), errors())


def test_aerotech_by_hand():
    """Corrections: minus the error, from one turn before zero on."""
    text, found = written("aerotech-rotary")
    assert ":START 5 SAMPLEDIST=90.000000 POSUNIT=PRIMARY CORUNIT=PRIMARY\n:START OFFSET=360.000000\n" in text
    assert "0.0000000 -0.0020000 0.0000000 0.0020000 0.0000000 -0.0020000\n" in text
    third = form_of("aerotech-rotary").parse({Path("r.cal"): text.replace("CORUNIT=PRIMARY", "CORUNIT=PRIMARY/1000")})
    assert third["C"].emulated(np.array([90.0])) == pytest.approx([-2e-6])


def test_between_nodes_the_largest_deviation_is_found_where_it_is():
    """A peak of the error between two nodes of a coarse table, at no angle of a raster, counts with its whole height."""
    at = np.array([0.0, 100.123, 100.623, 101.123, 360.0])
    peak = RotaryCurve(at, RAD_PER_ARCSEC * np.array([0.0, 0.0, 30.0, 0.0, 0.0]), np.full(5, np.nan))
    form = form_of("linuxcnc-rotary-comp")
    coarse = form.files({"C": AngleTable(np.array([0.0, 180.0, 360.0]), np.zeros(3))})
    found = judged_pitch(form, RotaryErrors({"ECC": peak}), {Path(key): text for key, text in coarse.items()})
    assert found.angle_arcsec["C"]["after_max"] == pytest.approx(30.0, abs=1e-3) and found.reasons


def test_half_a_turn_of_an_endless_axis_is_judged_over_all_of_it():
    """COMP_FILE knows no turn: beyond its last row the last trim stays."""
    form, truth = form_of("linuxcnc-rotary-comp"), square()
    text = "0 0 0\n90 -0.002 -0.002\n"
    found = judged_pitch(form, truth, {Path("rotary-c.comp"): text})
    # at 270: 7.2 of the error and 7.2 of the last trim, less what the error changes over these 0.002 degrees
    assert found.angle_arcsec["C"]["after_max"] == pytest.approx(14.4 - 0.002 * 7.2 / 90.0)


@pytest.mark.parametrize("name", ROTARY_PITCH)
def test_export_verify_and_read_by_command(name, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("m.toml").write_text(f"{MACHINE}[controllers.{name}]\n{NEEDED[name]}\n")
    Path("e.errors.csv").write_text(format_machine_errors(ErrorTable(), errors(), {"machine": "trunnion"}))
    assert read_machine_errors("e.errors.csv")[1].reversal["A"] == pytest.approx(-3.0 * RAD_PER_ARCSEC)
    words = ("--controller", name)
    code, out, err = call("export", "m.toml", "e.errors.csv", *words, "--out", "t", "--json")
    if name == "aerotech-rotary":
        assert code == 2 and "unverified" in err and not Path("t").exists()
        code, out, err = call("export", "m.toml", "e.errors.csv", *words, "--out", "t", "--json", "--allow-unverified")
    assert code == 0, err
    made = json.loads(out)
    code, out, err = call("verify", "m.toml", "t", *words, "--errors", "e.errors.csv", "--out", "v", "--json")
    assert code == 0 and json.loads(out)["angle_arcsec"] == made["angle_arcsec"], err
    Path("p.points.csv").write_text("x_mm,y_mm,z_mm,a_deg,c_deg\n0,0,0,-60,90\n0,0,0,30,0\n")
    code, out, err = call("read", "m.toml", "t", *words, "--points", "p.points.csv", "--out", "r.csv")
    assert code == 0, err
    header, *rows = [line.split(",") for line in Path("r.csv").read_text().splitlines() if not line.startswith("#")]
    got = {key: float(value) for key, value in zip(header, rows[0], strict=True)}
    half = (-1.5, 1.0) if name in BOTH_WAYS else (0.0, 0.0)
    assert got["ca_arcsec"] == pytest.approx(4.0 - half[0], abs=0.2)
    assert got["cc_arcsec"] == pytest.approx(-8.0 - half[1], abs=0.2)
    assert ("ca_negative_arcsec" in got) == (name in BOTH_WAYS)
    if name in BOTH_WAYS:
        assert got["ca_negative_arcsec"] == pytest.approx(4.0 + half[0], abs=0.01)


@pytest.mark.parametrize(
    ("name", "section", "said"),
    [
        ("fanuc-rotary-pitch", "axis_numbers = { C = 5 }", "axis_numbers: is missing for A"),
        ("fanuc-rotary-pitch", "axis_numbers = { A = 5, C = 5 }", "has the same value twice"),
        ("fanuc-rotary-pitch", "axis_numbers = { A = 4, C = 5 }\ninterval_deg = 7.0", "divides 360"),
        ("twincat-rotary-list", "", "axis_numbers: is missing for A, C"),
        ("aerotech-rotary", "axis_numbers = { A = 4, X = 5 }", "by rotary axis"),
        ("siemens-rotary-cec", "", "axis_names: is missing"),
        ("heidenhain-rotary-com", 'sign = "minus"', "expected one of 'error', 'correction'"),
    ],
)  # fmt: skip
def test_wrong_settings_are_found_by_check(name, section, said, call, tmp_path):
    path = tmp_path / "m.toml"
    path.write_text(f"{MACHINE}[controllers.{name}]\n{section}\n")
    code, out, err = call("check", str(path))
    assert code == 2 and said in " ".join((out + err).split())


def test_a_curve_too_steep_for_the_increments_says_what_helps():
    form = form_of("fanuc-rotary-pitch", "interval_deg = 90.0")
    with pytest.raises(InputError, match="changes by 20 counts of 0.0001 degrees over a section; at most 7"):
        export_pitch(form, square())
