"""Positioning runs of rotary axes: figures by hand, the error motion, tables read back, and all of it by command."""

import json
from pathlib import Path

import numpy as np
import pytest

from compgen.controls.rotary_pitch import AngleTable, format_of
from compgen.data.machine import parse_machine
from compgen.data.rotary import RAD_PER_ARCSEC, RotaryRuns, read_machine_errors, read_rotary_runs
from compgen.errors import InputError
from compgen.identification.rotary_runs import identify_rotary_runs

MACHINE = """name = "trunnion"
chain = "WCAYFXZT"
axes.X = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Y = { range_mm = [-400.0, 400.0], nodes = 7 }
axes.Z = { range_mm = [-300.0, 400.0], nodes = 7 }
axes.A = { point_mm = [0.0, 0.0, -50.0], range_deg = [-110.0, 30.0], nodes = 8 }
axes.C = { point_mm = [0.0, 0.0, 0.0], modulo_deg = 360.0, nodes = 13 }
[controllers.siemens-rotary-eec]
axis_names = { A = "AX4", C = "AX5" }
"""


def machine_of(more=""):
    return parse_machine(MACHINE + more, Path("m.toml"))


def wave(letter, angle_deg):
    """True error of the angle, arcsec: zero at zero."""
    if letter == "C":
        return 8.0 * np.sin(np.radians(angle_deg)) + 3.0 * (np.cos(np.radians(2.0 * angle_deg)) - 1.0)
    return 0.1 * angle_deg


def runs_text(letter, targets, rng, *, reversal=2.0, noise=0.3, runs=3):
    rows = ["axis,position_deg,direction,run,deviation_arcsec"]
    for run in range(1, runs + 1):
        for direction in (1, -1):
            for at in targets:
                value = wave(letter, at) + direction * reversal / 2.0 + noise * rng.normal()
                rows.append(f"{letter},{at},{direction},{run},{value:.3f}")
    return "\n".join(rows) + "\n"


def test_figures_by_hand():
    """Targets 0, 90, 180: means up 1, 3, 5 and down 0, 1, 4; scatter 1 (k = 2)."""
    letters, angle, way, run, value = [], [], [], [], []
    for direction, means in ((1, (1.0, 3.0, 5.0)), (-1, (0.0, 1.0, 4.0))):
        for at, mean in zip((0.0, 90.0, 180.0), means, strict=True):
            for number, off in ((1, -1.0), (2, 0.0), (3, 1.0)):
                letters.append("C")
                angle.append(at)
                way.append(direction)
                run.append(number)
                value.append(mean + off)
    runs = RotaryRuns(letters, np.array(angle), np.array(way), np.array(run), np.array(value) * RAD_PER_ARCSEC)
    found = identify_rotary_runs(machine_of(), runs)
    # B = 2, M of the means 0.5, 2, 4.5 = 4, E = 5 - 0, A = (5 + 2) - (0 - 2), R = 2 + 2 + 2
    assert found.figures["C"] == pytest.approx(
        {"E": 5.0, "M": 4.0, "B": 2.0, "mean_reversal": 4.0 / 3.0, "A": 9.0, "R": 6.0}
    )
    curve = found.errors.curves["ECC"]
    assert curve.value / RAD_PER_ARCSEC == pytest.approx([0.0, 1.5, 4.0, 0.0])  # zero at its reference; it closes
    assert curve.u[0] / RAD_PER_ARCSEC == pytest.approx((1.0 / 6.0 + 0.0625) ** 0.5)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(4)
    Path("five.toml").write_text(MACHINE)
    Path("c.axis.csv").write_text(runs_text("C", np.arange(0.0, 360.0, 30.0), rng))
    Path("a.axis.csv").write_text(runs_text("A", np.arange(-110.0, 31.0, 20.0), rng))
    return tmp_path


def exported(call, name, out="tables"):
    code, text, err = call("run", "five.toml", "c.axis.csv", "a.axis.csv", "--controller", name, "--out", out, "--json")
    return code, (json.loads(text) if code in (0, 1) else {}), " ".join(err.split())


def test_runs_become_an_error_motion(folder, call):
    code, out, err = call("identify", "five.toml", "c.axis.csv", "a.axis.csv", "--out", "found", "--json")
    assert code == 0, err
    summary = json.loads(out)
    assert summary["figures_arcsec"]["C"]["mean_reversal"] == pytest.approx(2.0, abs=0.3)
    _, rotary = read_machine_errors("found/identified.errors.csv")
    assert set(rotary.curves) == {"EAA", "ECC"} and not rotary.constants
    for letter, name in (("A", "EAA"), ("C", "ECC")):
        curve = rotary.curves[name]
        truth = wave(letter, curve.angle_deg) * RAD_PER_ARCSEC
        assert np.abs(curve.value - truth).max() < 4.0 * curve.u.max()


@pytest.mark.parametrize("name", ["linuxcnc-rotary-comp", "siemens-rotary-eec"])
def test_the_tables_take_the_error_away_in_angle_and_tip(folder, call, name):
    code, summary, err = exported(call, name)
    assert code == 0, err
    for own in summary["angle_arcsec"].values():  # read back and emulated; between the nodes what 30 degrees leave
        assert own["after_rms"] < 0.2 * own["before_rms"]
    assert summary["after"]["rms_um"] < 0.2 * summary["before"]["rms_um"] and summary["before"]["rms_um"] > 3.0
    assert summary["after"]["rms_urad"] < 0.3 * summary["before"]["rms_urad"]
    code, out, err = call(
        "verify",
        "five.toml",
        "tables",
        "--controller",
        name,
        "--errors",
        "tables/identified.errors.csv",
        "--out",
        "v",
        "--json",
    )
    assert code == 0 and json.loads(out)["angle_arcsec"] == summary["angle_arcsec"], err
    # against the truth, which the tables have never seen
    at = np.linspace(0.0, 360.0, 73)
    form = format_of(machine_of(), name)
    path = next(
        path for path in Path("tables").iterdir() if path.suffix in (".comp", ".INI") and "-a." not in path.name
    )
    table = form.parse({path: path.read_text()})["C"]
    left = wave("C", at) + 3600.0 * table.at(at, machine_of().rotary["C"])
    assert np.abs(left).max() < 1.6 < 10.0 < np.abs(wave("C", at)).max()


def test_signs_by_hand(folder, call):
    """C turned 8 arcsec too far at 90 degrees: the trim is -8, the measured error +8; reversed, the node is at -90."""
    form = format_of(machine_of(), "linuxcnc-rotary-comp")
    angle = np.array([0.0, 90.0, 180.0, 270.0, 360.0])
    table = AngleTable(angle, np.array([0.0, -8.0, 0.0, 0.0, 0.0]) / 3600.0)
    text = form.files({"C": table})["rotary-c.comp"]
    assert (
        f"90.000000000 {-8 / 3600:.9f} {-8 / 3600:.9f}\n" in text
        and "450.000000000" in text
        and "-270.000000000" in text
    )
    turned = format_of(machine_of('[controllers.linuxcnc-rotary-comp]\nreversed_axes = ["C"]\n'), form.name)
    text = turned.files({"C": table})["rotary-c.comp"]
    assert f"-90.000000000 {8 / 3600:.9f} {8 / 3600:.9f}\n" in text
    again = turned.parse({Path("rotary-c.comp"): text})["C"]
    at = np.array([0.0, 45.0, 90.0, 200.0])
    axis = machine_of().rotary["C"]
    assert again.at(at, axis) == pytest.approx(table.at(at, axis), abs=1e-9)
    text = format_of(machine_of(), "siemens-rotary-eec").files({"C": table})["ROTARY_EEC.INI"]
    assert "$AA_ENC_COMP[0,1,AX5]=0.002222\n" in text and "$AA_ENC_COMP_IS_MODULO[0,AX5]=1" in text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("C,0.0,1,1", "B,0.0,1,1", "is no rotary axis of trunnion"),
        ("C,30.0,1,1", "C,0.0,1,1", "already appears in"),
        ("C,0.0,1,1", "C,0.0,0,1", "0 is not a direction"),
        ("C,0.0,1,1,", "C,0.0,1,1,9999", "is the unit arcsec"),
        ("C,0.0,1,1,", "C,0.0,1,1,x", "deviation_arcsec"),
    ],
)
def test_readings_that_cannot_be_are_refused_with_their_line(folder, call, old, new, said):
    Path("x.axis.csv").write_text(Path("c.axis.csv").read_text().replace(old, new, 1))
    code, out, err = call("identify", "five.toml", "x.axis.csv", "--out", "found")
    assert code == 2 and said in " ".join(err.split()) and "x.axis.csv:" in err and not Path("found").exists()


def test_other_wrong_use_is_refused(folder, call):
    outside = Path("a.axis.csv").read_text().replace("A,-110.0", "A,-111.0", 1)
    Path("o.axis.csv").write_text(outside)
    with pytest.raises(InputError, match="-111 degrees is outside the travel"):
        read_rotary_runs(machine_of(), ["o.axis.csv"])
    code, out, err = call("identify", "zha-gantry", "c.axis.csv", "--out", "f")
    assert code == 2 and "no rotary axis of zha-gantry" in " ".join(err.split())
    Path("two.axis.csv").write_text("axis,position_deg,direction,run,deviation_arcsec\nC,0,1,1,0\nC,90,1,1,2\n")
    code, out, err = call("identify", "five.toml", "two.axis.csv", "--out", "f")
    assert code == 2 and "at least 3" in err
    code, summary, err = exported(call, "siemens-rotary-eec")
    text = Path("tables/ROTARY_EEC.INI").read_text()
    form = format_of(machine_of(), "siemens-rotary-eec")
    for change in (
        lambda text: text.replace("$AA_ENC_COMP[0,3,AX5]", "$AA_ENC_COMP[0,2,AX5]"),
        lambda text: text.replace("$AA_ENC_COMP_STEP[0,AX5]=30.000000\n", ""),
        lambda text: text.replace("$AA_ENC_COMP_MAX[0,AX5]=360.000000", "$AA_ENC_COMP_MAX[0,AX5]=350.000000"),
        lambda text: text.replace("AX5", "AX6"),
        lambda text: text.replace("$AA_ENC_COMP[0,3,AX5]", "$AA_ENC_COMP[0,x,AX5]"),
        lambda text: text.replace("STEP[0,AX5]=30.0", "STEP[0,AX5]=-30.0").replace("=360.0", "=-360.0"),
        lambda text: text.replace("=30.000000", "=x"),
    ):
        with pytest.raises(InputError):
            form.parse({Path("ROTARY_EEC.INI"): change(text)})
    Path("five.toml").write_text(MACHINE.replace(', C = "AX5"', ""))
    code, out, err = call("check", "five.toml")
    assert code == 2 and "axis_names" in out


def test_senses_follow_the_kinematics_of_linuxcnc():
    trt = "[controllers.linuxcnc-trt]\nconventional_directions = {}\n"
    name = "linuxcnc-rotary-comp"
    assert format_of(machine_of(trt.format("false")), name).settings.reversed_axes == ("A", "C")
    assert format_of(machine_of(trt.format("true")), name).settings.reversed_axes == ()
    both = trt.format("false") + f'[controllers.{name}]\nreversed_axes = ["C"]\n'
    with pytest.raises(InputError, match=r"conventional_directions says \['A', 'C'\]"):
        format_of(machine_of(both), name)
