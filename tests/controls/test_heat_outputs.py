"""Outputs of a model of heat: numbers by hand, files read back and run, the C of the component against the "
"model, sensors that fail."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import HEAT_OUTPUTS
from compgen.controls.heat_outputs import ABOUT, output_of
from compgen.controls.shared.base import SourceFile
from compgen.data.machine import load_machine
from compgen.errors import InputError
from compgen.heat import HeatModel, Temperatures
from compgen.heat.model import Range, Term
from compgen.resources import data_folder
from compgen.tables.heat_outputs import export_heat, trial_day

#: dz = 2 um/K of the spindle behind 1200 s, dx = -3 um/K of the bed at once, as in tests/programs/test_heat.py.
TERMS = (Term("spindle", 1200.0, "bed", {"dx": 0.0, "dz": 2.0}), Term("bed", 0.0, "bed", {"dx": -3.0, "dz": 0.0}))
HULL = (Range("spindle", "", 18.0, 40.0), Range("bed", "", 18.0, 26.0), Range("spindle", "bed", -2.0, 16.0))
MODEL = HeatModel(
    "mill", TERMS, {"dx": np.eye(2) * 1e-2, "dz": np.eye(2) * 1e-2}, HULL, {"dx": (9.0, 0.5), "dz": (20.0, 1.0)}
)
ONE = HeatModel(
    "mill", (Term("spindle", 1200.0, "spindle", {"dz": 2.0}),), {"dz": np.eye(1)}, HULL[:1], {"dz": (20.0, 1.0)}
)
SETTINGS = """
[controllers.linuxcnc-heat]
rate_um_s = 1.0
[controllers.siemens-heat]
sign = "error"
temperatures = { spindle = "$A_DBR[0]", bed = "$A_DBW[4]/10" }
axis_names = { X = "X1", Y = "Y1", Z = "Z1" }
[controllers.twincat-heat]
sign = "correction"
"""


@pytest.fixture
def shop(tmp_path):
    axes = "".join(
        f"[axes.{axis}]\nrange_mm = [{low}, {high}]\nnodes = 5\n"
        for axis, low, high in (("X", -600.0, 600.0), ("Y", -500.0, 500.0), ("Z", -400.0, 200.0))
    )
    (tmp_path / "mill.toml").write_text(f'name = "mill"\nchain = "WFYXZT"\n{axes}{SETTINGS}')
    (tmp_path / "mill.heat.toml").write_text(MODEL.text({}))
    (tmp_path / "one.heat.toml").write_text(ONE.text({}))
    return tmp_path


def machine_of(shop, *replaced):
    text = (shop / "mill.toml").read_text()
    for old, new in replaced:
        assert old in text
        text = text.replace(old, new)
    (shop / "mill.toml").write_text(text)
    return load_machine(str(shop / "mill.toml"))


def warming(minutes=60):
    """The spindle rises by 0.1 K a minute for an hour from 20 degC, the bed from 20 to 21 degC."""
    t = np.arange(0.0, 60 * minutes + 1, 60)
    return Temperatures(t, {"spindle": 20 + t / 600, "bed": 20 + t / 3600})


def by_hand(t):
    """Minus dx = 3 um per K of the bed at once; minus dz = -2 r (t - tau (1 - exp(-t / tau))) of the spindle's ramp r, um."""
    r, tau = 1 / 600, 1200.0
    return 3 * t / 3600, -2 * r * (t - tau * (1 - np.exp(-t / tau)))


@pytest.mark.parametrize("name", ["linuxcnc-heat", "siemens-heat", "twincat-heat"])
def test_what_a_control_adds_is_minus_the_growth_by_hand(shop, name):
    output = output_of(machine_of(shop), name)
    files = output.files(MODEL)
    day = warming()
    added = output.parse([SourceFile(Path(f), files[f]) for f in output.read_files]).added(day)
    x, z = by_hand(day.time_s)
    assert added[:, 0] * 1e3 == pytest.approx(x, abs=0.02)
    assert added[:, 2] * 1e3 == pytest.approx(z, abs=0.02)
    assert not added[:, 1].any()


def test_signs_and_units_of_each_text_by_hand(shop):
    """+2 um/K of growth along Z: SINUMERIK in mm as an error, TwinCAT in 0.1 um as a correction, Klipper as a coefficient."""
    machine = machine_of(shop)
    siemens = output_of(machine, "siemens-heat").files(MODEL)["VOLHEAT.SPF"]
    assert "=(0.002000000*($AC_PARAM[20]-$AC_PARAM[22])" in siemens
    assert "$$SA_TEMP_COMP_ABS_VALUE[Z1]=$AC_PARAM[28]" in siemens
    assert "$AC_PARAM[21]=$A_DBW[4]/10" in siemens
    twincat = output_of(machine, "twincat-heat").files(MODEL)["FB_VolHeat.st"]
    assert "-20.000000000*(s0-s2)" in twincat
    assert "temp_comp_offset_0       0" in output_of(machine, "twincat-heat").files(MODEL)["volheat.lis"]
    klipper = output_of(machine, "klipper-heat").files(ONE)["z_thermal_adjust.cfg"]
    assert "temp_coeff: 0.0020000\n" in klipper
    assert "smooth_time: 1200.000\n" in klipper
    assert "max_z_adjustment: 0.0440\n" in klipper


def test_klipper_lowers_z_where_heat_has_raised_it(shop):
    """z_thermal_adjust.py: adjust = -temp_coeff (T - T at homing), T behind smooth_time."""
    output = output_of(machine_of(shop), "klipper-heat")
    files = output.files(ONE)
    added = output.parse([SourceFile(Path("z_thermal_adjust.cfg"), files["z_thermal_adjust.cfg"])]).added(warming())
    assert added[:, 2] * 1e3 == pytest.approx(by_hand(warming().time_s)[1], abs=1e-3)


def test_a_stated_sign_turns_the_value_and_not_the_effect(shop):
    day = warming()
    found = []
    for sign in ("error", "correction"):
        machine = machine_of(shop) if sign == "error" else machine_of(shop, ('sign = "error"', 'sign = "correction"'))
        output = output_of(machine, "siemens-heat")
        text = output.files(MODEL)["VOLHEAT.SPF"]
        found.append((text, output.parse([SourceFile(Path("VOLHEAT.SPF"), text)]).added(day)))
    assert "-0.002000000*(" in found[1][0]
    assert found[0][1] == pytest.approx(found[1][1])


def test_a_missing_sign_is_asked_for(shop):
    with pytest.raises(InputError, match="sign"):
        output_of(machine_of(shop, ('sign = "error"\n', "")), "siemens-heat")


@pytest.mark.parametrize("name", ["marlin-heat", "fanuc-heat", "heidenhain-heat"])
def test_a_control_that_takes_no_file_refuses_and_says_what_is_known(shop, name, capsys):
    code = run_command(
        cli,
        [
            "export",
            str(shop / "mill.toml"),
            str(shop / "mill.heat.toml"),
            "--controller",
            name,
            "--out",
            str(shop / "out"),
        ],
    )
    assert code == 2
    assert "correct --temperatures" in capsys.readouterr().err.replace("\n", " ").replace("  ", " ")
    assert not (shop / "out").exists()


def test_klipper_refuses_what_one_coefficient_cannot_hold(shop):
    several = HeatModel(
        "mill", (*ONE.terms, Term("bed", 0.0, "bed", {"dz": 1.0})), {"dz": np.eye(2)}, HULL, {"dz": (20.0, 1.0)}
    )
    with pytest.raises(InputError, match="one coefficient"):
        output_of(machine_of(shop), "klipper-heat").files(several)


@pytest.mark.parametrize("name", ["linuxcnc-heat", "siemens-heat", "twincat-heat", "klipper-heat"])
def test_export_read_and_verify_agree(shop, name, capsys):
    model = shop / ("one.heat.toml" if name == "klipper-heat" else "mill.heat.toml")
    out = shop / "out"
    words = [str(shop / "mill.toml"), str(model), "--controller", name, "--out", str(out), "--json"]
    assert run_command(cli, ["export", *words]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["accepted"]
    assert found["after"]["Z"]["rms_um"] < 0.02 * found["before"]["Z"]["rms_um"]
    again = [str(shop / "mill.toml"), str(out), "--controller", name]
    assert run_command(cli, ["verify", *again, "--errors", str(model), "--out", str(shop / "check"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["after"] == found["after"]
    day = warming()
    rows = "".join(
        f"{t},{a},{b}\n" for t, a, b in zip(day.time_s, day.celsius["spindle"], day.celsius["bed"], strict=True)
    )
    (shop / "day.temperatures.csv").write_text(f"time_s,temp_spindle_c,temp_bed_c\n{rows}")
    assert (
        run_command(cli, ["read", *again, "--points", str(shop / "day.temperatures.csv"), "--out", str(shop / "c.csv")])
        == 0
    )
    last = (shop / "c.csv").read_text().splitlines()[-1].split(",")
    expected = by_hand(3600.0)[1] + (0 if name != "klipper-heat" else 0)
    assert float(last[3]) == pytest.approx(expected, abs=0.02)
    assert "Before use" in (out / "preflight.md").read_text()


def test_a_model_in_place_of_errors_and_errors_in_place_of_a_model_are_named(shop, capsys):
    words = [
        "export",
        str(shop / "mill.toml"),
        str(shop / "mill.heat.toml"),
        "--controller",
        "neutral",
        "--out",
        str(shop / "o"),
    ]
    assert run_command(cli, words) == 2
    assert "linuxcnc-heat" in capsys.readouterr().err
    (shop / "mill.errors.csv").write_text("error,position_mm,value,u_value\nEXX,0,0,1\nEXX,1,0,1\n")
    words[2], words[4] = str(shop / "mill.errors.csv"), "linuxcnc-heat"
    assert run_command(cli, words) == 2
    assert "heat.toml" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("linuxcnc-heat", " 0.002", " -0.002"),
        ("siemens-heat", "=(0.002", "=(-0.002"),
        ("siemens-heat", "IDS=41", "IDS=40"),
        ("siemens-heat", "BOUND(", "BOUNDS("),
        ("siemens-heat", "M17", ""),
        ("twincat-heat", "-20.0", "20.0"),
        ("twincat-heat", "END_FUNCTION_BLOCK", ""),
        ("twincat-heat", "LIMIT(", "open("),
        ("klipper-heat", "temp_coeff: ", "temp_coeff: -"),
        ("klipper-heat", "smooth_time: ", "smooth_time: -"),
    ],
)
def test_a_changed_file_is_refused_or_not_accepted(shop, name, old, new):
    model = "one.heat.toml" if name == "klipper-heat" else "mill.heat.toml"
    out = shop / "out"
    words = [str(shop / "mill.toml"), str(shop / model), "--controller", name, "--out", str(out)]
    assert run_command(cli, ["export", *words]) == 0
    for file in output_of(machine_of(shop), name).read_files:
        text = (out / file).read_text()
        assert old in text
        (out / file).write_text(text.replace(old, new, 1))
    words = [str(shop / "mill.toml"), str(out), "--controller", name, "--errors", str(shop / model)]
    assert run_command(cli, ["verify", *words, "--out", str(shop / "check")]) in (1, 2)


def test_every_output_has_a_card():
    assert set(ABOUT) == set(HEAT_OUTPUTS)
    assert all({"title", "expresses", "evidence", "file", "settings"} == set(about) for about in ABOUT.values())


def test_inches_are_machine_units(shop):
    """0.002 mm per K are 0.0000787 inch, in the table and in the setting datum."""
    machine = machine_of(shop, ('name = "mill"', 'name = "mill"\nmachine_units = "inch"'))
    assert " 7.87401575e-05" in output_of(machine, "linuxcnc-heat").files(MODEL)["volheat.tab"]
    found = export_heat(output_of(machine, "siemens-heat"), MODEL)
    assert not found.reasons
    assert "=(0.000078740*(" in found.files["VOLHEAT.SPF"]


# --- the C of the component ------------------------------------------------------------------------------------------

DRIVER = r"""
#include "volheat.h"
static volheat_table table;
static volheat_state state;
// table units dt; then lines: t0 t1 on warm reset -> offsets, fault, sensor, share
int main(int count, char **word)
{
    double t[VOLHEAT_SENSORS] = {0}, dt = atof(word[3]);
    int on, warm, reset;
    volheat_load(&table, word[1], word[2]);
    if (!table.v_good) { printf("bad %s\n", table.v_message); return 0; }
    while (scanf("%lf %lf %d %d %d", &t[0], &t[1], &on, &warm, &reset) == 5) {
        volheat_step(&table, &state, t, on, warm, reset, dt);
        printf("%.12g %.12g %.12g %d %d %.9g\n", state.v_now[0], state.v_now[1], state.v_now[2], state.v_fault, state.v_broken,
               state.v_share);
    }
    return count > 4;
}
"""
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc is not installed")


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volheat")
    shutil.copy(data_folder("templates") / "linuxcnc-heat" / "volheat.h", folder)
    (folder / "driver.c").write_text(DRIVER)
    words = ["gcc", "-std=gnu11", "-Wall", "-Wextra", "-Werror", "-O2", "driver.c", "-lm", "-o", "driver"]
    subprocess.run(words, cwd=folder, check=True)
    return folder / "driver"


@pytest.fixture
def table(shop):
    path = shop / "volheat.tab"
    path.write_text(output_of(machine_of(shop), "linuxcnc-heat").files(MODEL)["volheat.tab"])
    return path


def stepped(driver, table, rows, dt=1.0, units="mm"):
    text = "\n".join(
        " ".join(f"{value:.6f}" if k < 2 else str(int(value)) for k, value in enumerate(row)) for row in rows
    )
    found = subprocess.run(
        [driver, table, units, str(dt)], input=text, capture_output=True, text=True, check=True
    ).stdout
    if found.startswith("bad"):
        return found
    return np.array([[float(word) for word in line.split()] for line in found.splitlines()])


def rows_of(spindle, bed, on=1, warm=0, reset=0):
    columns = [np.broadcast_to(np.asarray(item, float), np.shape(spindle)) for item in (spindle, bed, on, warm, reset)]
    return np.column_stack(columns)


@needs_gcc
def test_the_component_does_what_the_model_says(driver, table):
    """A day through the hull and beyond, a second a step: the C, and the prediction of the model."""
    day = trial_day(MODEL)
    t = np.arange(0.0, day.time_s[-1], 1.0)
    read = {name: np.interp(t, day.time_s, values) for name, values in day.celsius.items()}
    found = stepped(driver, table, rows_of(read["spindle"], read["bed"]))
    predicted = MODEL.predict(Temperatures(t, read))
    assert np.abs(found[60:, 2] * 1e3 + predicted.moved["dz"][60:]).max() < 0.05
    assert np.abs(found[60:, 0] * 1e3 + predicted.moved["dx"][60:]).max() < 0.05
    assert not found[:, 3].any()
    assert predicted.weight[-1] == 0
    assert not found[-1, :3].any()
    assert np.abs(np.diff(found[:, :3], axis=0)).max() <= 1e-3 * 1.0001


def broken(kind, count):
    """The spindle at 20, rising to 30 degC within the first half, then a fault; the bed follows."""
    spindle = 20 + 10 * np.minimum(np.arange(count) / (count / 2), 1)
    bed = 20 + 5 * np.minimum(np.arange(count) / count, 1)
    half = count // 2
    if kind == "nan":
        spindle[half:] = np.nan
    elif kind == "short":
        spindle[half:] = 999.0
    elif kind == "jump":
        spindle[half:] += 4.0
    return spindle, bed


@needs_gcc
@pytest.mark.parametrize(("kind", "code"), [("nan", 1), ("short", 1), ("jump", 2)])
def test_a_sensor_that_fails_takes_the_offset_back_to_zero_at_the_rate_and_says_why(driver, table, kind, code):
    found = stepped(driver, table, rows_of(*broken(kind, 7200)))
    assert np.abs(found[3599, 2]) > 0.005
    assert not found[3599, 3]
    assert (found[3600:, 3] == code).all()
    assert (found[3600:, 4] == 0).all()
    assert not found[-1, :3].any()
    assert np.abs(np.diff(found[:, :3], axis=0)).max() <= 1e-3 * 1.0001


@needs_gcc
def test_a_sensor_that_is_stuck_is_found_by_another_that_moves(driver, table):
    spindle = 20 + 15 * np.arange(9000) / 9000
    found = stepped(driver, table, rows_of(spindle, 21.0))
    first = int(np.argmax(found[:, 3] != 0))
    assert found[first, 3] == 3
    assert found[first, 4] == 1
    assert spindle[first] == pytest.approx(25, abs=0.01)  # another has moved by moved_k = 5 K, after more than stuck_s
    assert not stepped(driver, table, rows_of(20 + 4 * np.arange(9000) / 9000, 21.0))[:, 3].any()


@needs_gcc
def test_reset_accepts_a_mended_sensor_and_waits_if_the_lags_are_not_known(driver, table):
    spindle, bed = broken("nan", 7200)
    spindle[4000:] = 30.0
    reset = np.zeros(7200)
    reset[4100:] = 1  # after 500 s of fault: shorter than what lags are followed through
    found = stepped(driver, table, rows_of(spindle, bed, reset=reset))
    assert found[4099, 3] == 1
    assert not found[4100:, 3].any()
    assert np.abs(found[4200, 2]) > 0.005
    reset[:] = 0
    reset[5000:] = 1  # after 1400 s: nothing is added for three lags of 1200 s
    late = stepped(driver, table, rows_of(spindle, bed, reset=reset))
    assert not late[5000:, 3].any()
    assert not late[5100:, :3].any()


@needs_gcc
def test_nothing_is_added_while_not_enabled_and_off_goes_back_at_the_rate(driver, table):
    spindle, bed = broken("", 7200)
    on = np.ones(7200)
    on[:600], on[5000:6000] = 0, 0
    found = stepped(driver, table, rows_of(spindle, bed, on))
    assert not found[:600, :3].any()
    assert not found[5100:6000, :3].any()
    assert np.abs(found[6100, 2]) > 0.005
    assert np.abs(np.diff(found[:, :3], axis=0)).max() <= 1e-3 * 1.0001


@needs_gcc
def test_sensors_that_read_nothing_yet_are_waited_for_and_a_warm_start_waits_for_the_lags(driver, table):
    spindle = np.r_[np.zeros(10), np.full(50, 22.0)]
    found = stepped(driver, table, rows_of(spindle, 21.0))
    assert (found[:10, 3] == 4).all()
    assert not found[10:, 3].any()
    rising, bed = broken("", 7200)
    warm = stepped(driver, table, rows_of(rising, bed, warm=1))
    assert not warm[:3599, :3].any()  # 3 x 1200 s
    assert np.abs(warm[3700, 2]) > 0.005


@needs_gcc
@pytest.mark.parametrize("how", ["cut", "digit", "unit", "missing"])
def test_a_table_that_is_not_whole_is_not_used(driver, table, how):
    text = table.read_text()
    if how == "cut":
        table.write_text(text[: len(text) // 2])
    elif how == "digit":
        table.write_text(text.replace("0.002", "0.003"))
    elif how == "missing":
        table.unlink()
    found = stepped(driver, table, rows_of(np.full(3, 20.0), 20.0), units="inch" if how == "unit" else "mm")
    assert str(found).startswith("bad")
