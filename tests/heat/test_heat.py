"""The model of heat against machines with hidden lags and coefficients, integrated here by small steps."""

import json
from dataclasses import replace

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.errors import CompgenWarning, InputError
from compgen.heat import DriftSession, Temperatures, learn_heat, read_drift, read_heat, read_temperatures
from compgen.heat.etve import etve_figures, warm_up
from compgen.heat.model import Term, lagged, states_of

STEP_S = 5


def day(seed, *, hidden=0.0, noise_um=0.3, minutes=300, rise_k=None):
    """One day: a spindle that is switched, air that drifts; dz = 9 L_40min(spindle), dy = -6 L_90min(air) + 2 spindle.

    The lags are integrated by steps of five seconds, otherwise than in the program.
    """
    rng = np.random.default_rng(seed)
    seconds = np.arange(0, 60 * minutes + 1, STEP_S)
    duty = np.repeat(rng.random(minutes // 50 + 1), 3000 // STEP_S)[: len(seconds)]
    air = 20 + rng.normal(0, 1.5) + rng.normal(0, 3) * seconds / seconds[-1] + np.sin(seconds / 4000 + rng.random())
    spindle, slow, slow_air = np.empty((3, len(seconds)))
    warm, l_spindle, l_air, source = air[0] + rng.random(), None, air[0], 0.0
    l_spindle = warm
    unseen = np.empty(len(seconds))
    secret = np.repeat(rng.uniform(-1, 1, minutes // 37 + 1), 2220 // STEP_S)[: len(seconds)]
    for k in range(len(seconds)):
        spindle[k], slow[k], slow_air[k], unseen[k] = warm, l_spindle, l_air, source
        warm += (air[k] + (rise_k or 14) * duty[k] - warm) * STEP_S / 900
        l_spindle += (spindle[k] - l_spindle) * STEP_S / 2400
        l_air += (air[k] - l_air) * STEP_S / 5400
        source += (secret[k] - source) * STEP_S / 1500
    bed = slow_air + 0.2
    rows = slice(0, None, 60 // STEP_S)
    t = seconds[rows].astype(float)
    read = {"air": air[rows], "spindle": spindle[rows], "bed": bed[rows]}
    moved = {
        "dz": 9 * (slow - slow[0])[rows] + hidden * (unseen - unseen[0])[rows],
        "dy": (-6 * (slow_air - slow_air[0]) + 2 * (spindle - spindle[0]))[rows] + hidden * (unseen - unseen[0])[rows],
    }
    read = {k: np.round(v + rng.normal(0, 0.02, len(t)), 2) for k, v in read.items()}
    moved = {k: v + rng.normal(0, noise_um, len(t)) for k, v in moved.items()}
    return DriftSession(f"day{seed}", Temperatures(t, read), moved)


@pytest.fixture(scope="module")
def days():
    return [day(seed) for seed in range(1, 7)]


@pytest.fixture(scope="module")
def learned(days):
    return learn_heat("mill", days[:5])


def test_hidden_lags_and_coefficients_are_found(learned):
    model = learned.model
    assert not learned.reasons
    spindle = [item for item in model.terms if item.sensor == "spindle" and abs(item.per_k["dz"]) > 3]
    (term,) = spindle
    assert term.lag_s == pytest.approx(2400, rel=0.06)
    assert term.per_k["dz"] == pytest.approx(9, rel=0.05)
    assert all(after < 0.15 * before for before, after in model.rms.values())


def test_a_day_of_which_nothing_was_learned_is_predicted(learned, days):
    found = learned.model.predict(days[5].temperatures)
    for name in ("dz", "dy"):
        truth = days[5].moved[name] - days[5].moved[name][0]
        rest = truth - found.moved[name]
        assert np.sqrt(np.mean(rest[found.weight == 1] ** 2)) < 0.25 * np.sqrt(np.mean(truth**2))
        assert (np.abs(rest) < 4 * found.u[name])[found.weight == 1].mean() > 0.9


def test_a_lag_is_exact_for_a_straight_line_and_a_step():
    t = np.array([0.0, 10.0, 35.0, 100.0, 400.0])
    ramp = lagged(t, 0.1 * t, 50.0, 0.0)  # of a ramp r t: r (t - tau (1 - exp(-t / tau)))
    assert ramp == pytest.approx(0.1 * (t - 50 * (1 - np.exp(-t / 50))), abs=1e-12)
    step = lagged(t, np.full(5, 3.0), 50.0, 1.0)
    assert step == pytest.approx(3 - 2 * np.exp(-t / 50), abs=1e-12)


def test_a_lag_may_start_at_the_temperature_of_another_sensor():
    read = Temperatures(np.array([0.0, 60.0]), {"a": np.array([30.0, 30.0]), "bed": np.array([20.0, 20.0])})
    states = states_of([Term("a", 60.0, "bed")], read)
    assert states[:, 0] == pytest.approx([20.0, 30 - 10 * np.exp(-1)])


def test_heat_that_no_sensor_sees_is_refused():
    found = learn_heat("mill", [day(seed, hidden=400.0) for seed in range(1, 6)])
    assert found.reasons
    assert "do not express" in found.reasons[0]


def test_too_few_sessions_are_refused(days):
    found = learn_heat("mill", days[:2])
    assert found.model is None
    assert "3 sessions" in found.reasons[0]


def test_noise_alone_gives_no_model(days):
    rng = np.random.default_rng(0)
    noise = [replace(item, moved={"dx": rng.normal(0, 1, len(item.temperatures))}) for item in days[:4]]
    assert learn_heat("mill", noise).reasons


def test_only_the_direction_that_the_model_expresses_is_kept(days):
    rng = np.random.default_rng(0)
    mixed = [replace(item, moved={**item.moved, "dx": rng.normal(0, 1, len(item.temperatures))}) for item in days[:5]]
    found = learn_heat("mill", mixed)
    assert found.model.directions == ("dy", "dz")
    assert any(text.startswith("dx: no model") for text in found.notes)


def room_day(seed):
    """239 minutes in which the tool follows the air at once, 5 um/K; spindle and bed (100 min behind the air) are read, too."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 239 * 60 + 1, 60.0)
    air = 20 + rng.normal(0, 1.5) + rng.normal(0, 2) * t / t[-1] + 0.8 * np.sin(t / 3000 + 6 * rng.random())
    spindle = air + 8 * (1 - np.exp(-t / 2500)) * rng.uniform(0.5, 1.2)
    bed = np.empty_like(t)
    bed[0] = air[0]
    for k in range(1, len(t)):
        bed[k] = bed[k - 1] + (air[k - 1] - bed[k - 1]) * 60 / 6000
    celsius = {"air": air, "spindle": spindle, "bed": bed}
    read = {name: np.round(v + rng.normal(0, 0.02, len(t)), 2) for name, v in celsius.items()}
    return DriftSession(f"d{seed}", Temperatures(t, read), {"dz": 5 * (air - air[0]) + rng.normal(0, 0.3, len(t))})


@pytest.mark.parametrize("first", [0, 16, 24, 32])
def test_noise_of_the_first_reading_does_not_become_terms_with_lags(first):
    """A sensor without lag was learned as 7.4 um/K after 4 min and -2.4 um/K after 12 min."""
    model = learn_heat("mill", [room_day(seed) for seed in range(first, first + 6)]).model
    assert {term.sensor for term in model.terms} == {"air"}
    largest, *others = sorted((term.per_k["dz"] for term in model.terms), key=abs, reverse=True)
    assert largest == pytest.approx(5, rel=0.06)
    assert all(abs(k) < 0.4 for k in others)
    assert sum(term.per_k["dz"] for term in model.terms) == pytest.approx(5, rel=0.03)


def test_outside_the_hull_the_model_fades_to_zero(learned, days):
    read = days[5].temperatures
    hot = Temperatures(read.time_s, {name: values + 40 for name, values in read.celsius.items()})
    found = learned.model.predict(hot)
    assert (found.weight == 0).all()
    assert not np.any(found.moved["dz"])
    assert "spindle" in found.left
    edge = next(item for item in learned.model.hull if item.sensor == "spindle" and not item.minus)
    outside = {"spindle": np.array([edge.high + 0.5 * edge.margin_k])}
    assert edge.outside_k(outside) == pytest.approx(0.5 * edge.margin_k)


def test_the_file_reads_back_as_it_was_written(learned, tmp_path, days):
    path = tmp_path / "m.heat.toml"
    path.write_text(learned.model.text({}))
    again = read_heat(path)
    assert again.sensors == learned.model.sensors
    before, after = (model.predict(days[5].temperatures) for model in (learned.model, again))
    for name in before.moved:
        assert after.moved[name] == pytest.approx(before.moved[name], abs=1e-5)
        assert after.u[name] == pytest.approx(before.u[name], abs=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("format = 1", "format = 2", "format"),
        ("lag_s = ", "lag_s = -", "lag_s"),
        ('start = "', 'start = "no', "start"),
        ("low_c = ", "low_c = 9", "low_c"),
        ("covariance = [[", "covariance = [[1.0, ", "covariance"),
        ("dz_um_per_k", "dz_um_per_c", "dz_um_per_c"),
    ],
)
def test_a_changed_file_is_refused_with_its_key(learned, tmp_path, old, new, named):
    path = tmp_path / "m.heat.toml"
    text = learned.model.text({})
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        read_heat(path)
    assert named in str(caught.value)
    assert caught.value.file == path


# --- files -----------------------------------------------------------------------------------------------------------


def written(tmp_path, text, name="a.drift.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_drift_file_with_iso_times_and_gaps_is_read(tmp_path):
    text = (
        "# clock_offset_s = 2.5\ntime,temp_bed_c,dx_um,spindle_rpm\n2026-03-02T07:30:00+01:00,20,0,0\n"
        "2026-03-02T06:31:00Z,,1,5000\n2026-03-02T06:32:00Z,21,,5000\n"
    )
    with pytest.warns(CompgenWarning, match="1 empty cells"):
        found = read_drift(written(tmp_path, text))
    assert found.temperatures.time_s.tolist() == [0, 60, 120]
    assert found.temperatures.since == pytest.approx(1772433002.5)
    assert found.temperatures.celsius["bed"].tolist() == [20, 20.5, 21]
    assert np.isnan(found.moved["dx"][2])


@pytest.mark.parametrize(
    ("text", "line", "named"),
    [
        ("time,temp_a_c\n2026-03-02T07:30:00,20\n", 2, "no zone"),
        ("time,temp_a_c\nyesterday,20\n", 2, "not a time"),
        ("time_s,temp_a_c\n0,20\n60,21\n60,21\n", 4, "does not rise"),
        ("time_s,temp_a_c\n0,20\n60,-273.1\n", 3, "outside"),
        ("time_s,temp_a_c\n0,20\n60,warm\n", 3, "not a number"),
        ("time_s,temp_a_c\n0,20\n60,nan\n", 3, "not a finite"),
        ("time_s,temp_a_c\n0,\n60,\n", 2, "every row"),
        ("time_s,dx_um\n0,1\n", None, "no temperatures"),
        ("temp_a_c\n20\n", None, "no time"),
        ("time,time_s,temp_a_c\n2026-03-02T07:30:00Z,0,20\n", None, "leave out one"),
        ("# clock_offset_s = late\ntime,temp_a_c\n2026-03-02T07:30:00Z,20\n", None, "clock_offset_s"),
        ("time_s,temp_a_c,temp_b_c\n0,20,20\n600,20,\n1200,20,\n1800,20,\n2400,20,20\n", None, "bridged"),
    ],
)
@pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")
def test_a_wrong_file_is_refused_with_its_line(tmp_path, text, line, named):
    path = written(tmp_path, text, "a.temperatures.csv")
    with pytest.raises(InputError, match=named) as caught:
        read_temperatures(path)
    assert caught.value.file == path
    if line:
        assert caught.value.line == line


def test_a_drift_file_needs_a_displacement(tmp_path):
    with pytest.raises(InputError, match="no displacement"):
        read_drift(written(tmp_path, "time_s,temp_a_c\n0,20\n60,21\n"))


def test_rows_after_a_long_gap_are_not_used(tmp_path):
    rows = "".join(f"{t},20,{t / 60}\n" for t in [0, 60, 120, 7200, 7260])
    with pytest.warns(CompgenWarning, match="a gap of 118 min"):
        found = read_drift(written(tmp_path, "time_s,temp_a_c,dz_um\n" + rows))
    assert len(found.temperatures) == len(found.moved["dz"]) == 3


@pytest.mark.parametrize(
    ("rows", "named"),
    [
        (["0,20,1"], "at least 3 rows without a long gap, this one 1;"),
        (["0,20,1", "7200,20,2", "7260,20,2", "7320,21,2"], "at least 3 rows without a long gap, this one 1;"),
        (["0,20,", "60,20,", "120,20,", "7200,20,2", "7260,20,2"], "dz_um: is empty in every row of the 3 before"),
        (["0,,1", "60,,1", "120,,1", "7200,20,2", "7260,20,2"], "temp_a_c: is empty in every row of the 3 before"),
    ],
)
@pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")
def test_a_session_of_which_too_little_is_left_is_refused_by_name(tmp_path, rows, named):
    """One row in one of four sessions had made the figures of all of them nan, and the reason a wrong one."""
    text = "time_s,temp_a_c,dz_um\n" + "\n".join(rows) + "\n"
    with pytest.raises(InputError, match=named) as caught:
        read_drift(written(tmp_path, text))
    assert caught.value.file.name == "a.drift.csv"


def test_a_sensor_that_reads_one_value_all_day_is_said(tmp_path):
    rows = "".join(f"{60 * k},21,{20 + k / 10},{k}\n" for k in range(40))
    with pytest.warns(CompgenWarning, match="temp_bed_c is 21 degC in all 40 rows"):
        read_drift(written(tmp_path, "time_s,temp_bed_c,temp_air_c,dz_um\n" + rows))


def test_a_sensor_that_jumps_is_not_used(tmp_path, days):
    celsius = dict(days[0].temperatures.celsius)
    celsius["air"] = np.where(np.arange(len(celsius["air"])) > 100, 35.0, celsius["air"])
    lines = ["time_s,temp_air_c,temp_spindle_c,dz_um"]
    columns = (days[0].temperatures.time_s, celsius["air"], celsius["spindle"], days[0].moved["dz"])
    lines += [",".join(f"{v:.3f}" for v in row) for row in zip(*columns, strict=True)]
    with pytest.warns(CompgenWarning, match="temp_air_c jumps"):
        assert read_drift(written(tmp_path, "\n".join(lines) + "\n")).temperatures.broken == ("air",)


def test_the_figures_of_iso_230_3():
    t = np.arange(0, 4 * 3600 + 1, 60.0)
    item = DriftSession("a", Temperatures(t, {"a": 20 + t / 3600}), {"dz": 40 * (1 - np.exp(-t / 3000))})
    found = etve_figures(item, 2.0)
    assert found["dz_range_first_60_min_um"] == pytest.approx(40 * (1 - np.exp(-1.2)))
    assert found["dz_range_um"] == pytest.approx(40 * (1 - np.exp(-4.8)))
    assert found["temp_a_range_k"] == pytest.approx(4)
    # 40 (exp(-t/3000) - exp(-4.8)) = 2: t = -3000 ln(0.05 + exp(-4.8)) = 8530 s, the next reading is at 143 min
    assert found["wait_min"] == 143


def test_warm_up_of_another_day_by_hand():
    """20, 30, 40 min: mean 30, s 10; t(0.95, 2) = 2.920 of the tables, so 30 + 2.920 * 10 * sqrt(4/3) = 63.7 min."""
    found = warm_up([20.0, 30.0, 40.0])
    assert (found["mean_min"], found["s_min"], found["sessions"]) == (30.0, 10.0, 3)
    assert found["enough_min"] == pytest.approx(63.72, abs=0.02)
    assert warm_up([20.0, None, 40.0]) is None
    assert warm_up([20.0]) is None


# --- the command -----------------------------------------------------------------------------------------------------


def saved(item, folder):
    columns = {"time_s": item.temperatures.time_s}
    columns |= {f"temp_{k}_c": v for k, v in item.temperatures.celsius.items()}
    columns |= {f"{k}_um": v for k, v in item.moved.items()}
    rows = [",".join(f"{v:.4f}" for v in row) for row in zip(*columns.values(), strict=True)]
    path = folder / f"{item.name}.drift.csv"
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    return str(path)


def test_the_command_writes_a_model_with_its_figures(tmp_path, days, capsys):
    files = [saved(item, tmp_path) for item in days[:4]]
    assert run_command(cli, ["heat", "zha-gantry", *files, "--out", str(tmp_path / "out"), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["accepted"]
    assert read_heat(tmp_path / "out" / data["files"][0]).directions == ("dy", "dz")
    assert len(data["sessions"]) == len(data["etve"]) == 4
    assert data["warm_up"] is None or data["warm_up"]["sessions"] == 4
    assert {"heat.json", "heat.md"} < {path.name for path in (tmp_path / "out").iterdir()}


def test_the_command_refuses_what_the_model_does_not_express(tmp_path, capsys):
    files = [saved(day(seed, hidden=400.0, minutes=200), tmp_path) for seed in range(1, 5)]
    assert run_command(cli, ["heat", "zha-gantry", *files, "--out", str(tmp_path / "out")]) == 1
    assert "refused" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*.heat.toml"))


def test_the_same_session_twice_is_refused(tmp_path, days, capsys):
    file = saved(days[0], tmp_path)
    assert run_command(cli, ["heat", "zha-gantry", file, file, file, "--out", str(tmp_path / "out")]) == 2
    assert "twice" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
