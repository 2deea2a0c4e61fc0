"""Scenarios with the six-DOF instrument: what they make, and what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.error_table import read_errors
from compgen.data.machine import load_machine
from compgen.errors import InputError
from compgen.instruments.sixdof_instrument import SIGNALS, format_sixdof, read_instrument, read_sixdof
from compgen.simulation import read_scenario, simulate, simulate_sixdof
from compgen.simulation.sixdof import run_signals

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MACHINE = load_machine("jia-xytz")
UM, ARCSEC = 1e-3, np.pi / 648000
BASE = 'name = "s"\nseed = 1\n[errors]\nfile = "truth.csv"\n[instrument]\ntype = "sixdof"\nfile = "instrument.toml"\n'


@pytest.fixture
def folder(tmp_path):
    shutil.copy(EXAMPLES / "jia-xytz.instrument.toml", tmp_path / "instrument.toml")
    shutil.copy(EXAMPLES / "jia-xytz.truth.errors.csv", tmp_path / "truth.csv")
    return tmp_path


def scenario_of(folder, text):
    (folder / "s.scenario.toml").write_text(text)
    return read_scenario(folder / "s.scenario.toml")


QUIET = "runs = 1\n[instrument.noise]\ndisplacement_um = 0\nqd_um = 0\npsd_um = 0\n"


def test_without_noise_the_readings_are_the_traced_signals(folder):
    text = BASE + QUIET + "[instrument.positions_mm]\nX = { from = 0, to = 800, step = 100 }\nY = [0, 10, 400]\n"
    readings = simulate_sixdof(MACHINE, scenario_of(folder, text)).readings
    assert [len(rows) for _, _, rows in readings.runs()] == [9, 3, 17]
    truth, instrument = read_errors(folder / "truth.csv"), read_instrument(folder / "instrument.toml")
    traced = run_signals(MACHINE, truth, instrument, 0, np.arange(0.0, 801.0, 100.0))
    for k, name in enumerate(SIGNALS):
        assert np.abs(readings.signals_mm[name][:9] - traced[:, k]).max() <= 1e-12, name
    assert not readings.signals_mm["y_psd2_mm"].any()


def test_scatter_noise_and_drift_have_the_size_that_was_asked_for(folder):
    quiet = simulate_sixdof(MACHINE, scenario_of(folder, BASE + QUIET.replace("runs = 1", "runs = 8"))).readings
    noisy = QUIET.replace("runs = 1", "runs = 8").replace("qd_um = 0", "qd_um = 0.4")
    readings = simulate_sixdof(MACHINE, scenario_of(folder, BASE + noisy)).readings
    spread = np.std(readings.signals_mm["y_qd1_mm"] - quiet.signals_mm["y_qd1_mm"])
    assert spread == pytest.approx(0.4 * UM, rel=0.1)  # 408 readings: 3.5 % standard deviation
    moved = "runs = 8\n" + QUIET.partition("\n")[2] + "[instrument.scatter.X]\npositioning_um = 0.5\n"
    readings = simulate_sixdof(MACHINE, scenario_of(folder, BASE + moved)).readings
    difference = readings.signals_mm["displacement_mm"] - quiet.signals_mm["displacement_mm"]
    assert np.std(difference[readings.axis == 0]) == pytest.approx(0.5 * UM, rel=0.2)
    assert np.abs(difference[readings.axis != 0]).max() <= 1e-9
    drifting = "drift_arcsec_per_reading = 0.1\n" + QUIET.replace("runs = 1", "runs = 8")
    readings = simulate_sixdof(MACHINE, scenario_of(folder, BASE + drifting)).readings
    steps = np.diff(readings.signals_mm["y_psd2_mm"]) / 100.0  # also from axis to axis: one zero
    assert np.std(steps) == pytest.approx(0.1 * ARCSEC, rel=0.1)


def test_the_same_seed_gives_the_same_readings_and_another_one_does_not(folder):
    scenario = scenario_of(folder, BASE + 'scatter = "table3"\nruns = 1\n')
    one, same, other = (format_sixdof(simulate_sixdof(MACHINE, scenario, seed).readings) for seed in (5, 5, 6))
    assert one == same != other


def test_what_is_not_calibrated_acts_beside_what_is(folder):
    text = BASE + QUIET + "[instrument.uncalibrated]\neps_zir_arcsec = 1.0\n"
    plain = simulate_sixdof(MACHINE, scenario_of(folder, BASE + QUIET)).readings.signals_mm["y_qd1_mm"][17:34]
    moved = simulate_sixdof(MACHINE, scenario_of(folder, text)).readings.signals_mm["y_qd1_mm"][17:34]
    change = (moved - plain) - (moved - plain)[0]
    assert change[-1] == pytest.approx(4 * ARCSEC * 800.0, rel=1e-3)  # Jia et al. 2022, eq. 8


def test_files_come_back_as_they_were_written(folder):
    readings = simulate_sixdof(MACHINE, scenario_of(folder, BASE + "there_and_back = true\nruns = 1\n")).readings
    (folder / "back.sixdof.csv").write_text(format_sixdof(readings))
    back = read_sixdof(folder / "back.sixdof.csv")
    assert np.array_equal(back.direction, readings.direction)
    assert set(back.direction.tolist()) == {1.0, -1.0}
    for name, values in readings.signals_mm.items():
        assert np.abs(back.signals_mm[name] - values).max() <= 1e-9


def test_the_command_writes_readings_and_truth(folder, capsys):
    (folder / "s.scenario.toml").write_text(BASE + "runs = 1\n")
    words = [
        "simulate",
        "jia-xytz",
        "--scenario",
        str(folder / "s.scenario.toml"),
        "--out",
        str(folder / "o"),
        "--json",
    ]
    assert run_command(cli, words) == 0
    assert json.loads(capsys.readouterr().out)["readings"] == 51
    assert sorted(path.name for path in (folder / "o").iterdir()) == ["s.sixdof.csv", "truth.errors.csv"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BASE.replace('file = "instrument.toml"\n', ""), "file: is missing"),
        (BASE.replace("instrument.toml", "none.toml"), "no such file"),
        (BASE + "run = 3\n", "did you mean 'runs'"),
        (BASE + "runs = 0\n", "from 1 to 100"),
        (BASE + 'scatter = "table9"\n', "expected"),
        (BASE + "[instrument.scatter.X]\nroll_um = 1\n", "is not a known key"),
        (BASE + "[instrument.uncalibrated]\neps_zzz_arcsec = 1\n", "is not a systematic parameter"),
        (BASE + "[instrument.positions_mm]\nX = { from = 0, to = 800 }\n", "from = .., to = .., step = .."),
        (BASE + "[instrument.positions_mm]\nA = [0, 1]\n", "is not a known key"),
        (BASE + '[trajectory]\ntype = "grid"\n', "runs along the axes"),
        (BASE.replace('kind = "sixdof-laser"', ""), None),
    ],
)
def test_a_scenario_that_cannot_be_used_is_refused(folder, text, message):
    if message is None:
        (folder / "instrument.toml").write_text('kind = "other"\n')
        message = "sixdof-laser"
    with pytest.raises(InputError, match=message):
        scenario_of(folder, text)


def test_positions_outside_the_travel_and_the_wrong_function_are_refused(folder):
    scenario = scenario_of(folder, BASE + "[instrument.positions_mm]\nX = [0, 900]\n")
    with pytest.raises(InputError, match="exceed the travel of X"):
        simulate_sixdof(MACHINE, scenario)
    with pytest.raises(InputError, match="has no lengths"):
        simulate(MACHINE, scenario)
    with pytest.raises(InputError, match="is not a six-DOF instrument"):
        simulate_sixdof(load_machine("zha-gantry"), read_scenario(EXAMPLES / "zha-gantry.scenario.toml"))
