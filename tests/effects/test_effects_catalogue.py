"""The catalogue as users meet it: list, page, machine files, scenarios, plug-ins."""

import json
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest

from compgen.data.axis_runs import read_axis_runs
from compgen.data.lengths import Points
from compgen.data.machine import load_machine
from compgen.effects import (
    active_effects,
    advice_of_effects,
    catalogue,
    displacement_of,
    effects_reversal,
    listed,
    readings_of_points,
    section_text,
)
from compgen.errors import InputError
from compgen.plugins import KINDS
from compgen.registry import restored
from compgen.report.cards import catalogue_markdown

DOCS = Path(__file__).resolve().parents[2] / "docs" / "effects.md"
EFFECTS = """
[effects.backlash_X]
c_um = 4.0
[effects.lost_motion_X]
c1_um = 1.0
c2_um = -2.0
[effects.spindle_growth_Z]
c_um_per_k = 3.0
reference_c = 20.0
[effects."station_drift_LT 1"]
vx_um_per_h = 2.0
[effects.dead_path]
c_LT2_um_per_k = 0.5
[effects.lever_ECX]
degree = 1
p1_urad = 10.0
"""


@pytest.fixture(autouse=True)
def registries_as_before():
    with restored(KINDS):
        yield


@pytest.fixture
def extended(small_machine_file, tmp_path):
    def make(text=EFFECTS):
        path = tmp_path / "extended.toml"
        path.write_text(Path(small_machine_file).read_text() + text)
        return path

    return make


def test_the_page_of_the_docs_holds_the_catalogue():
    assert DOCS.read_text().endswith(catalogue_markdown(listed()))


def test_a_machine_file_switches_effects_on(extended):
    effects = {active.name: active for active in active_effects(load_machine(extended()))}
    np.testing.assert_allclose(effects["backlash_X"].values, [4e-3])
    np.testing.assert_allclose(effects["station_drift_LT 1"].values, [2e-3 / 3600.0, 0.0, 0.0])
    assert effects["dead_path"].summary() == {"c_LT2_um_per_k": pytest.approx(0.5)}
    assert effects["lever_ECX"].summary() == {"p0_urad": 0.0, "p1_urad": pytest.approx(10.0), "degree": 1.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[effects.backlsh_X]\nc_um = 1.0\n", "unknown effect 'backlsh_X'; did you mean 'backlash_X'"),
        ("[effects.backlash_X]\nc_mm = 1.0\n", "c_mm: is not a known key; did you mean 'c_um'"),
        ("[effects.backlash_X]\n", "c_um: is missing"),
        ("[effects.backlash_X]\nc_um = '4'\n", "expected a finite number"),
        ("[effects.outliers]\n", "cannot be switched on"),
        ("[effects.machine_jump]\ncx_um = 1.0\n", "time_s: is missing"),
        ("[effects.periodic_X]\ns1_um = 1.0\n", "pitch_mm: is missing"),
        ("[effects.lever_ECX]\ndegree = 1\np2_urad = 1.0\n", "p2_urad: is not a known key"),
    ],
)
def test_wrong_sections_are_errors_with_file_and_line(extended, text, message):
    path = extended(text)
    with pytest.raises(InputError) as caught:
        active_effects(load_machine(path))
    assert re.search(re.escape(message), str(caught.value))
    line = next(k for k, row in enumerate(path.read_text().splitlines(), start=1) if row.startswith("[effects."))
    assert caught.value.line in (line, line + 1, line + 2)


def test_a_section_that_is_written_reads_back_with_the_same_meaning(extended, small_machine):
    rng = np.random.default_rng(5)
    warm = {"temp_spindle_c": rng.uniform(20, 25, 40), "temp_x_c": rng.uniform(20, 22, 40)}
    where = Points(rng.uniform(small_machine.lower_mm, small_machine.upper_mm, (40, 3)), None, None, warm)
    readings = readings_of_points(small_machine, where)
    for name in ("spindle_growth_Z", "thermal_scale_X", "beam_sag", "cosine_error_Y"):
        effect = catalogue()[name]
        values = rng.uniform(-1e-3, 1e-3, len(effect.card.parameters))
        machine = load_machine(extended("\n" + section_text(effect, readings, values)))
        part = readings_of_points(
            machine, Points(where.position_mm[:7], None, None, {k: v[:7] for k, v in warm.items()})
        )
        moved, missing = displacement_of(active_effects(machine), part)
        assert not missing
        np.testing.assert_allclose(moved, effect.displacement(readings)[:7] @ values, atol=1e-12, rtol=1e-8)


def test_backlash_and_lost_motion_become_the_reversal_of_iso_230_2(extended):
    machine = load_machine(extended())
    curve = effects_reversal(machine).curves[0, 0]
    low, high = machine.axes[0].range_mm
    for s in (-1.0, -0.5, 0.0, 1.0):  # B = 2 (c + c1 s + c2 (3 s^2 - 1) / 2)
        expected = 2e-3 * (4.0 + 1.0 * s - 2.0 * (1.5 * s**2 - 0.5))
        at = np.array([0.5 * (low + high) + 0.5 * (high - low) * s])
        np.testing.assert_allclose(curve.at(at), [expected], atol=1e-12)
    advice = " ".join(advice_of_effects(machine))
    assert "spindle" in advice and "backlash" not in advice


def simulated(call, machine_file, tmp_path, effects, out, machine_text=""):
    """Simulate a session on the small machine and return the paths of machine and lengths."""
    scenario = tmp_path / "s.toml"
    low, high = load_machine(machine_file).lower_mm, load_machine(machine_file).upper_mm
    corners = [low + (high - low) * np.array(c) for c in np.ndindex(2, 2, 2)]
    stations = [(f"LT{k + 1}", corners[j] + np.array([-300.0, -200.0, 150.0 * k])) for k, j in enumerate((0, 3, 5, 6))]
    text = 'seed = 3\n[instrument]\ntype = "laser-tracer"\nnoise_um = 0.01\nnoise_um_per_m = 0.0\n'
    for name, place in stations:
        text += f'[[instrument.stations]]\nname = "{name}"\nposition_mm = {place.tolist()}\ndead_length_mm = 100.0\n'
    text += "[trajectory]\n[session]\nrepeats = 1\n[temperatures.ambient]\nramp_k_per_h = 2.0\n"
    scenario.write_text(text + effects)
    assert call("simulate", machine_file, "--scenario", scenario, "--out", tmp_path / out)[0] == 0
    return tmp_path / out / "simulated.lengths.csv"


def test_identify_takes_the_effects_out_that_the_machine_file_names(call, small_machine_file, extended, tmp_path):
    play, air = "c_um = 4.0\n", "c_ppm_per_k = 3.0\nreference_c = 20.0\n"
    scenario = f'[[effects]]\nname = "backlash_X"\n{play}[[effects]]\nname = "refractive_index"\n{air}'
    known = f"\n[effects.backlash_X]\n{play}[effects.refractive_index]\n{air}"
    with_effects = simulated(call, small_machine_file, tmp_path, scenario, "with")
    plain = simulated(call, small_machine_file, tmp_path, "", "plain")
    for machine, lengths, out in ((extended(known), with_effects, "a"), (small_machine_file, plain, "b")):
        code, _, err = call("identify", machine, lengths, "--out", tmp_path / out)
        assert code == 0, err
    found = json.loads((tmp_path / "a" / "identify.json").read_text())
    assert set(found["effects"]) == {"backlash_X", "refractive_index"}
    a = np.genfromtxt(tmp_path / "a" / "identified.errors.csv", delimiter=",", comments="#", skip_header=0, usecols=2)
    b = np.genfromtxt(tmp_path / "b" / "identified.errors.csv", delimiter=",", comments="#", skip_header=0, usecols=2)
    assert (
        np.nanmax(np.abs(a - b)) < 0.02
    )  # um and urad: noise is 0.01 um and the same, effects of second order are left
    reversal = (tmp_path / "a" / "identified.reversal.csv").read_text().splitlines()[-1].split(",")
    assert reversal[:2] == ["X", "X"] and abs(float(reversal[3]) - 8.0) < 0.01


def test_predict_adds_effects_where_the_points_hold_the_columns(call, extended, tmp_path):
    (tmp_path / "e.errors.csv").write_text("error,position_mm,value,u_value\nEXX,0,0,\nEXX,1,0,\n")
    machine = load_machine(extended())
    low = machine.lower_mm
    row = ",".join(f"{value:g}" for value in low)
    (tmp_path / "p.csv").write_text(
        "x_mm,y_mm,z_mm,approach_x,approach_y,approach_z,temp_spindle_c\n" + f"{row},1,1,1,22\n{row},-1,1,1,20\n"
    )
    code, _, _ = call(
        "predict",
        extended(),
        tmp_path / "e.errors.csv",
        "--points",
        tmp_path / "p.csv",
        "--exact",
        "--out",
        tmp_path / "o.csv",
    )
    rows = np.genfromtxt(tmp_path / "o.csv", delimiter=",", comments="#", skip_header=4)
    assert code == 0
    # at the lower end s = -1: backlash 4, lost motion -1 - 2 = -3; spindle 3 um/K
    np.testing.assert_allclose(rows[:, 7], [1.0, -1.0], atol=0.02)
    np.testing.assert_allclose(rows[:, 9], [6.0, 0.0], atol=0.02)


def test_predict_says_which_effects_lack_their_columns(call, extended, tmp_path):
    (tmp_path / "e.errors.csv").write_text("error,position_mm,value,u_value\nEXX,0,0,\nEXX,1,0,\n")
    row = ",".join(f"{value:g}" for value in load_machine(extended()).lower_mm)
    (tmp_path / "p.csv").write_text(f"x_mm,y_mm,z_mm\n{row}\n")
    out = tmp_path / "o.csv"
    files = (tmp_path / "e.errors.csv", "--points", tmp_path / "p.csv", "--out", out)
    code, _, err = call("predict", extended(), *files, "--exact")
    assert code == 0 and "backlash_X, lost_motion_X, spindle_growth_Z" in " ".join(err.split())
    assert np.abs(np.genfromtxt(out, delimiter=",", comments="#", skip_header=4)[3:]).max() < 0.02


def test_the_list_shows_cards_and_what_comes_from_plug_ins(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, _ = call("effects", "--json")
    assert code == 0 and set(listed()) <= set(json.loads(out))
    block = re.search(r"```python\n(import numpy.*?)```", DOCS.read_text(), re.DOTALL).group(1)
    Path("own.py").write_text(textwrap.dedent(block))
    out = json.loads(call("effects", "table_tilt", "--json", "--plugin", "own.py")[1])
    assert out["equation"] == "d_Z = c load s_X" and "own.py" in out["plugin"]
    assert "backlash_X: Backlash of X" in call("effects", "backlash_X")[1]
    assert call("effects", "backlsh_X")[0] == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("FAMILIES = {'a': 3}", "int is not a compgen.effects.Family"),
        (
            "from compgen.effects import Single\nFAMILIES = {'a': Single('a', lambda: 1)}",
            "int is not a compgen.effects.Effect",
        ),
        (
            "from compgen.effects import PerAxis\nfrom compgen.effects.axes import Backlash\n"
            "FAMILIES = {'a': PerAxis('a', Backlash)}",
            "the name 'backlash_X' is already used",
        ),
    ],
)
def test_wrong_families_are_refused(call, tmp_path, text, message):
    (tmp_path / "p.py").write_text(text)
    code, _, err = call("effects", "--plugin", tmp_path / "p.py")
    assert code == 2 and message in " ".join(err.split())


def test_axis_runs_are_simulated_with_effects_of_their_axis(call, small_machine_file, tmp_path):
    scenario = tmp_path / "runs.toml"
    scenario.write_text(
        'seed = 1\n[errors]\nrandom = false\n[instrument]\ntype = "axis-laser"\naxes = ["X", "Z"]\ntargets = 5\n'
        "cycles = 3\nnoise_um = 0.0\n[temperatures.spindle]\nramp_k_per_h = 1.0\n"
        '[[effects]]\nname = "backlash_X"\nc_um = 2.0\n[[effects]]\nname = "warmup_drift"\nc_um = 10.0\ntau = 60.0\n'
    )
    code, _, err = call("simulate", small_machine_file, "--scenario", scenario, "--out", tmp_path / "o")
    assert code == 0, err
    runs = read_axis_runs(tmp_path / "o" / "simulated.axis.csv")
    time_s = runs.covariates["time_s"]
    expected = 10.0 * (1.0 - np.exp(-(time_s - time_s[0]) / 60.0)) + np.where(runs.axis == 0, 2.0 * runs.direction, 0.0)
    np.testing.assert_allclose(
        runs.deviation_mm * 1e3, expected, atol=1e-3
    )  # times are written to 1e-6, deviations to 1e-4 um
    assert len(runs) == 2 * 3 * 2 * 5 and "temp_spindle_c" in runs.covariates


def test_effects_that_an_instrument_cannot_show_are_refused(call, small_machine_file, tmp_path):
    scenario = tmp_path / "s.toml"
    for instrument, effect in (
        ('type = "axis-laser"\n', 'name = "laser_scale"\nc_ppm = 1.0\n'),
        (
            'type = "laser-tracer"\n[[instrument.stations]]\nname = "A"\nposition_mm = [900.0, 900.0, 900.0]\n'
            "dead_length_mm = 0.0\n",
            'name = "warmup_drift"\nc_um = 1.0\ntau = 5.0\n',
        ),
    ):
        scenario.write_text(f"seed = 1\n[instrument]\n{instrument}[[effects]]\n{effect}")
        code, _, err = call("simulate", small_machine_file, "--scenario", scenario, "--out", tmp_path / "o")
        assert code == 2 and "acts on" in " ".join(err.split())
