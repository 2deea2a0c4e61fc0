"""Readings of known temperatures: joined by time, corrected with the right sign, with an uncertainty that covers the truth."""

import json
import warnings
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import Circles
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.lengths import Lengths
from compgen.errors import CompgenWarning, InputError
from compgen.heat import read_heat
from compgen.heat.joining import moments_of, read_stretches, stretch_of
from compgen.identification import identify_measurement, joint_covariance
from compgen.identification.heat_of_readings import HeatSource, at_reference_heat, identified_at_reference
from machines import machine_of

BEGIN = datetime(2026, 3, 2, 7, 30, tzinfo=UTC)
#: dz = 4 um/K of the spindle, dx = -2 um/K; the coefficients are known to 0.4 and 0.2 um/K; the spindle was 18 to 30 degC.
MODEL = """format = 1
machine = "mill"
[[terms]]
sensor = "spindle"
lag_s = 0.0
start = "spindle"
dx_um_per_k = -2.0
dz_um_per_k = 4.0
[[hull]]
sensor = "spindle"
low_c = 18.0
high_c = 30.0
[left_out.dx]
before_rms = 5.0
after_rms = 0.1
covariance = [[0.04]]
[left_out.dz]
before_rms = 9.0
after_rms = 0.2
covariance = [[0.16]]
"""


@pytest.fixture
def machine():
    return machine_of(((0, 400), (0, 300), (-200, 0)), 3, name="mill")


@pytest.fixture
def model(tmp_path):
    (tmp_path / "mill.heat.toml").write_text(MODEL)
    return read_heat(tmp_path / "mill.heat.toml")


def log(path, minutes, celsius, begin=BEGIN, head=""):
    rows = [f"{(begin + timedelta(minutes=float(m))).isoformat()},{c}" for m, c in zip(minutes, celsius, strict=True)]
    path.write_text(head + "time,temp_spindle_c\n" + "\n".join(rows) + "\n")
    return path


def source_of(path, model, **more):
    return HeatSource(model, read_stretches(path), path, **more)


def deviations(n=60, metadata=None, time_s=None):
    """A grid that is measured for an hour, without any error of the machine."""
    rng = np.random.default_rng(3)
    position = np.column_stack([rng.uniform(*ends, n) for ends in ((0, 400), (0, 300), (-200, 0))])
    time_s = np.linspace(0, 3600, n) if time_s is None else time_s
    stated = {"time_zero": BEGIN.isoformat()} if metadata is None else metadata
    return Deviations(position, np.zeros((n, 3)), covariates={"time_s": time_s}, metadata=stated)


def test_growth_is_taken_out_with_its_sign_worked_by_hand(machine, model, tmp_path):
    # 2 K/h on straight lines, read every 10 min; after half an hour the spindle is 1 K warmer: dz = +4 um, dx = -2 um
    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 10), np.linspace(20, 22, 7))
    found = at_reference_heat(machine, deviations(61), source_of(file, model))
    assert found.measurement.deviation_mm[30] == pytest.approx([2e-3, 0, -4e-3], abs=1e-12)
    assert found.measurement.covariates["temp_spindle_c"][30] == pytest.approx(21.0)


def test_each_kind_of_reading_loses_its_own_component(machine, model, tmp_path):
    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 10), np.linspace(20, 22, 7))
    when, source = {"time_zero": BEGIN.isoformat()}, source_of(file, model)
    two, t = np.zeros(2), {"time_s": np.array([0.0, 3600.0])}  # 2 K: dx -4, dz +8 um
    runs = AxisRuns(np.array([0, 2]), two, np.ones(2, int), np.ones(2, int), two, t, when)
    assert at_reference_heat(machine, runs, source).measurement.deviation_mm == pytest.approx([0.0, -8e-3])
    # plane XY, 0 degrees is along +X: the circle is read 4 um too small there, so it becomes 4 um larger
    plane, ones = np.zeros(2, int), np.ones(2)
    circles = Circles(plane, two, 100 * ones, two, ones.astype(int), plane, plane, np.full((2, 3), 50.0), ones, t, when)
    assert at_reference_heat(machine, circles, source).measurement.deviation_mm == pytest.approx([0.0, 4e-3])
    # a tracer below the volume: a tool that has grown away from it by dz reads longer
    rng = np.random.default_rng(1)
    position = rng.uniform((0, 0, -200), (400, 300, 0), (40, 3))
    position[-1] = 200, 150, 0
    station = np.array([200.0, 150.0, -1000.0])
    tip = position + np.array([[0, 0, 0]])
    length = np.linalg.norm(tip - station, axis=1)
    time_s = np.concatenate([np.zeros(39), [3600.0]])
    own = {"tool_mm": np.zeros((40, 3)), "covariates": {"time_s": time_s}, "metadata": when}
    lengths = Lengths(("A",), np.zeros(40, int), ["p"] * 40, position, length, **own)
    change = at_reference_heat(machine, lengths, source).measurement.length_mm - length
    assert change[:39] == pytest.approx(0.0, abs=1e-12)
    assert change[-1] == pytest.approx(-8e-3, abs=1e-6)


def test_errors_are_those_of_a_cold_machine_and_u_has_the_coefficients(machine, model, tmp_path):
    """Readings warm by 6 K along X: without correction EZX is a slope; the coefficient is 1.5 u wrong, and u covers it."""
    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 5), np.linspace(20, 26, 13))
    cold = deviations(90)
    order = np.argsort(cold.position_mm[:, 0])
    cold = replace(cold, position_mm=cold.position_mm[order])
    noise = np.random.default_rng(5).normal(0, 0.1e-3, (90, 3))
    warm_k = 6.0 * cold.covariates["time_s"] / 3600
    true = np.column_stack([-2.3 * warm_k, 0 * warm_k, 4.6 * warm_k]) * 1e-3  # the model says -2 and 4 um/K
    warm = replace(cold, deviation_mm=noise + true)

    def identify(readings):
        return identify_measurement(machine, readings)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        right = identify(replace(cold, deviation_mm=noise))
        wrong = identify(warm)
        found = identified_at_reference(
            at_reference_heat(machine, warm, source_of(file, model, u_clock_s=0.0)), identify
        )
        plain = identify(at_reference_heat(machine, warm, source_of(file, model)).measurement)
    off = found.errors.values() - right.errors.values()
    u, u_plain = found.errors.uncertainties(), plain.errors.uncertainties()
    assert np.abs(wrong.errors.values() - right.errors.values()).max() > 5 * np.abs(off).max()
    assert (np.abs(off) <= 2 * u + 1e-9).all()
    assert (np.abs(off) > 3 * u_plain).any()  # without the coefficients u would have been too small
    assert (u >= u_plain * (1 - 1e-9) - 1e-12).all()
    assert np.linalg.norm(joint_covariance(found).errors_factor, axis=1) == pytest.approx(u)
    assert found.corrections["heat"]["corrected"] is True


def test_outside_the_hull_nothing_is_corrected_and_it_is_said(machine, model, tmp_path):
    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 10), np.linspace(29, 32, 7))  # learned up to 30
    readings = deviations()
    noise = np.random.default_rng(4).normal(0, 0.5e-3, (60, 3))
    readings = replace(readings, deviation_mm=noise)
    found = at_reference_heat(machine, readings, source_of(file, model))
    assert found.measurement.deviation_mm == pytest.approx(readings.deviation_mm)
    assert "spindle" in found.says()
    assert "nothing is taken out" in found.says()
    result = identified_at_reference(found, lambda m: identify_measurement(machine, m))
    assert any("nothing is taken out" in text for text in result.doubts)
    cold = identify_measurement(machine, readings)
    assert result.errors.uncertainties().max() > 1.2 * cold.errors.uncertainties().max()


@pytest.mark.parametrize(
    ("minutes", "words"),
    [
        (range(10, 90, 10), "the measurement was taken from 2026-03-02T07:30"),  # begins after the measurement
        ([0, 10, 20, 60, 70], "across a gap of more than 15 min"),
    ],
)
def test_moments_without_temperatures_are_refused(machine, model, tmp_path, minutes, words):
    file = log(tmp_path / "a.temperatures.csv", minutes, [20.0 + 0.01 * m for m in minutes])
    with pytest.raises(InputError, match=words):
        at_reference_heat(machine, deviations(), source_of(file, model))


def test_a_gap_before_the_measurement_does_not_matter_without_lags_and_does_with_them(machine, model, tmp_path):
    minutes = [-90, -80, -10, 0, 10, 20, 30, 40, 50, 60, 70]  # a gap of 70 min that ends 10 min before
    file = log(tmp_path / "a.temperatures.csv", minutes, [20.0 + 0.01 * m for m in minutes])
    found = at_reference_heat(machine, deviations(), source_of(file, model))
    assert found.corrected
    slow = replace(model, terms=(replace(model.terms[0], lag_s=600.0),))
    with pytest.raises(InputError, match="30 min after it"):
        at_reference_heat(machine, deviations(), source_of(file, slow))


def test_zones_and_clocks_that_differ(machine, model, tmp_path):
    berlin = BEGIN.astimezone().replace(tzinfo=UTC)  # the same digits as UTC
    minutes, celsius = range(0, 61, 10), np.linspace(20, 22, 7)
    here = log(tmp_path / "a.temperatures.csv", minutes, celsius)
    text = here.read_text().replace("+00:00", "+01:00")  # the logger said Berlin for times of UTC: an hour off
    (tmp_path / "b.temperatures.csv").write_text(text)
    with pytest.raises(InputError, match="do the clocks agree"):
        at_reference_heat(machine, deviations(), source_of(tmp_path / "b.temperatures.csv", model))
    (tmp_path / "c.temperatures.csv").write_text("# clock_offset_s = 3600\n" + text)
    found = at_reference_heat(machine, deviations(61), source_of(tmp_path / "c.temperatures.csv", model))
    assert found.measurement.deviation_mm[30] == pytest.approx([2e-3, 0, -4e-3], abs=1e-12)
    # the computer of the measurement is 1800 s slow: its comment says what to add
    said = {"time_zero": (berlin - timedelta(seconds=1800)).isoformat(), "clock_offset_s": "1800"}
    found = at_reference_heat(machine, deviations(61, said), source_of(here, model))
    assert found.measurement.deviation_mm[30] == pytest.approx([2e-3, 0, -4e-3], abs=1e-12)


def test_a_column_of_the_same_sensor_shows_clocks_that_differ(machine, model, tmp_path):
    minutes = np.arange(-120, 181, 10)
    swing = 24 + 5 * np.sin(minutes / 30)
    file = log(tmp_path / "a.temperatures.csv", minutes, swing)
    readings = deviations()
    seen = np.interp(readings.covariates["time_s"] / 60 + 60, minutes, swing)  # what was read an hour later
    readings = replace(readings, covariates={**readings.covariates, "temp_spindle_c": seen})
    with pytest.raises(InputError, match="clocks or time zones"):
        at_reference_heat(machine, readings, source_of(file, model))


def test_u_has_both_moments_that_measured_at_may_mean(machine, model, tmp_path):
    """measured_at is the first or the last reading: in between the spindle warms at another rate."""
    minutes = np.arange(-70, 71, 10)
    file = log(tmp_path / "a.temperatures.csv", minutes, 21 + 4 * np.maximum(minutes, 0) / 70)
    stated = at_reference_heat(machine, deviations(), source_of(file, model, u_clock_s=0.0))
    either = at_reference_heat(
        machine, deviations(metadata={"measured_at": BEGIN.isoformat()}), source_of(file, model, u_clock_s=0.0)
    )
    assert either.measurement.deviation_mm == pytest.approx(stated.measurement.deviation_mm)
    more = either.joined[0].patterns_mm[:, 2, -1]  # half of 4 um/K x 4 K x 60/70, since none of it happened before
    assert np.abs(more).max() == pytest.approx(0.5 * 4 * 4 * 60 / 70 * 1e-3, rel=1e-6)


@pytest.mark.parametrize(
    ("comments", "words"),
    [
        ({}, "does not say when its time_s was 0"),
        ({"time_zero": "2026-03-02T07:30:00"}, "has no zone"),
        ({"time_zero": "monday"}, "is not a time"),
        ({"temperatures_offset_s": "soon"}, "is not a number of seconds"),
    ],
)
def test_a_moment_that_is_not_known_is_refused(comments, words):
    with pytest.raises(InputError, match=words):
        moments_of(np.zeros(3), comments, "a.lengths.csv")


def test_seconds_and_times_of_the_day_are_not_mixed(tmp_path):
    (tmp_path / "s.temperatures.csv").write_text("time_s,temp_a_c\n0,20\n60,21\n120,22\n")
    stretches = read_stretches(tmp_path / "s.temperatures.csv")
    moments = moments_of(np.array([0.0, 30.0]), {"time_zero": BEGIN.isoformat()}, None)
    with pytest.raises(InputError, match="no time of the day"):
        stretch_of(stretches, [moments], "s.temperatures.csv")
    moments = moments_of(np.array([0.0, 30.0]), {"temperatures_offset_s": "60"}, None)
    part, begins = stretch_of(stretches, [moments], "s.temperatures.csv")
    assert len(part) == 3
    assert begins


def test_a_broken_sensor_is_refused(machine, model, tmp_path):
    celsius = np.linspace(20, 22, 61)
    celsius[30:] += 6.0  # jumps
    file = log(tmp_path / "a.temperatures.csv", range(61), celsius)
    with pytest.warns(CompgenWarning, match="jumps"), pytest.raises(InputError, match="temp_spindle_c jumps"):
        at_reference_heat(machine, deviations(), source_of(file, model))
    file = log(tmp_path / "f.temperatures.csv", range(61), np.linspace(300, 310, 61))
    with pytest.raises(InputError, match="broken sensor, or another unit"):
        at_reference_heat(machine, deviations(), source_of(file, model))


def test_identify_run_and_diagnose_take_temperatures(tmp_path):
    """The commands: what they say, what identify.json has, and that the slope of heat is gone from the tables' errors."""
    from compgen.data.machine import load_machine

    machine = load_machine("zha-gantry")
    (tmp_path / "zha-gantry.heat.toml").write_text(MODEL.replace('"mill"', '"zha-gantry"'))
    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 5), np.linspace(20, 26, 13))
    rng = np.random.default_rng(2)
    ends = np.array([axis.range_mm for axis in machine.axes])
    position = rng.uniform(ends[:, 0], ends[:, 1], (400, 3))
    position = position[np.argsort(position[:, 0])]
    time_s = np.linspace(0, 3600, 400)
    growth = np.outer(6 * time_s / 3600, [-2e-3, 0, 4e-3])
    warm = Deviations(position, growth + rng.normal(0, 2e-4, (400, 3)), covariates={"time_s": time_s})
    text = f"# time_zero = {BEGIN.isoformat()}\n" + format_deviations(warm)
    (tmp_path / "m.deviations.csv").write_text(text)
    heat = ["--heat", str(tmp_path / "zha-gantry.heat.toml"), "--temperatures", str(file)]
    slopes = []
    for name, more in (("plain", []), ("warm", heat)):
        out = tmp_path / name
        assert run_command(
            cli, ["identify", "zha-gantry", str(tmp_path / "m.deviations.csv"), *more, "--out", str(out)]
        ) in (0, 1)
        data = json.loads((out / "identify.json").read_text())
        rows = [
            line.split(",")
            for line in (out / "identified.errors.csv").read_text().splitlines()
            if line.startswith(("EXX", "EZX"))
        ]
        slopes.append(max(abs(float(row[2])) for row in rows))
    assert data["corrections"]["heat"]["corrected"] is True
    assert data["corrections"]["heat"]["largest_um"]["dz"] == pytest.approx(24.0)
    assert {item["name"] for item in data["inputs"]} >= {"a.temperatures.csv", "zha-gantry.heat.toml"}
    assert slopes[1] < 0.2 * slopes[0]
    out = str(tmp_path / "diagnosis")
    assert run_command(cli, ["diagnose", "zha-gantry", str(tmp_path / "m.deviations.csv"), *heat, "--out", out]) in (
        0,
        1,
    )


# Tracer lengths and axis runs with a growth of a formula of their own: the lag is that of the closed form, not of a filter.

#: The spindle warms from 20 degC towards 28 with 5400 s, from half an hour before the first reading; its lag is 1200 s.
WARMS_S, LAG_S, BEFORE_S = 5400.0, 1200.0, 1800.0


def lagged_c(time_s):
    """A first-order lag of an exponential approach: 20 + 8 (1 - (b exp(-t/b) - a exp(-t/a)) / (b - a))."""
    t = time_s + BEFORE_S
    slow, fast = WARMS_S * np.exp(-t / WARMS_S), LAG_S * np.exp(-t / LAG_S)
    return 20.0 + 8.0 * (1.0 - (slow - fast) / (WARMS_S - LAG_S))


def hidden_growth(time_s, times=1.0):
    """dx = -2.2, dz = 4.5 um/K of the lagged spindle since the first reading, in mm; the model says -2 and 4."""
    change = lagged_c(time_s) - lagged_c(time_s[:1])
    return times * 1e-3 * np.outer(change, [-2.2, 0.0, 4.5])


def lagged_source(tmp_path):
    (tmp_path / "mill.heat.toml").write_text(MODEL.replace("lag_s = 0.0", f"lag_s = {LAG_S}"))
    minutes = np.arange(-BEFORE_S / 60, 151)
    file = log(tmp_path / "a.temperatures.csv", minutes, 28.0 - 8.0 * np.exp(-(60.0 * minutes + BEFORE_S) / WARMS_S))
    return source_of(file, read_heat(tmp_path / "mill.heat.toml"))


def tracer_lengths(grow):
    levels = [np.linspace(*ends, n) for ends, n in (((0, 400), 5), ((0, 300), 5), ((-200, 0), 4))]
    grid = np.array(np.meshgrid(*levels, indexing="ij")).reshape(3, -1).T
    seen_from = np.array([[-150, -100, -320], [550, -80, -330], [520, 420, -310], [-120, 400, 60.0]])
    position, station = np.tile(grid, (4, 1)), np.repeat(np.arange(4), len(grid))
    time_s = np.linspace(0.0, 7200.0, len(position))
    length = np.linalg.norm(position + grow(time_s) - seen_from[station], axis=1)
    length += np.random.default_rng(1).normal(0, 1e-4, len(length))
    points = [f"p{k}" for k in np.tile(np.arange(len(grid)), 4)]
    more = {"covariates": {"time_s": time_s}, "metadata": {"time_zero": BEGIN.isoformat()}}
    return Lengths(tuple("ABCD"), station, points, position, length, tool_mm=np.zeros_like(position), **more)


def axis_runs(grow):
    """Three runs upwards along each axis, with an error of the machine of 4 um."""
    axis = np.repeat([0, 1, 2], 27)
    position = np.concatenate([np.tile(np.linspace(*ends, 9), 3) for ends in ((0, 400), (0, 300), (-200, 0))])
    time_s = np.linspace(0.0, 7200.0, 81)
    deviation = 4e-3 * np.sin(position / 60) + grow(time_s)[np.arange(81), axis]
    deviation += np.random.default_rng(1).normal(0, 1e-4, 81)
    run, up = np.tile(np.repeat([1, 2, 3], 9), 3), np.ones(81, int)
    return AxisRuns(axis, position, up, run, deviation, {"time_s": time_s}, {"time_zero": BEGIN.isoformat()})


@pytest.mark.parametrize(("measured", "nodes"), [(tracer_lengths, (5, 5, 4)), (tracer_lengths, 4), (axis_runs, 9)])
def test_lengths_and_runs_come_to_the_cold_machine_within_u(tmp_path, measured, nodes):
    """With four nodes the targets are off the nodes: u of the shape between them stays in u."""
    machine = machine_of(((0, 400), (0, 300), (-200, 0)), nodes, name="mill")
    source = lagged_source(tmp_path)

    def identify(readings):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            return identify_measurement(machine, readings)

    cold = identify(measured(lambda time_s: np.zeros((len(time_s), 3)))).errors
    warm = identify(measured(hidden_growth)).errors
    twice = identify(measured(lambda time_s: hidden_growth(time_s, 2.0))).errors
    found = at_reference_heat(machine, measured(hidden_growth), source)
    plain = identify(found.measurement).errors
    result = identified_at_reference(found, identify).errors
    off = np.abs(result.values() - cold.values())
    by_heat = np.abs(warm.values() - cold.values())
    u, u_plain = result.uncertainties(), plain.uncertainties()
    of_heat = np.sqrt(np.maximum(u**2 - u_plain**2, 0.0))
    counts = by_heat > 0.2 * by_heat.max()
    assert off.max() < 0.3 * by_heat.max() < 0.2 * np.abs(twice.values() - cold.values()).max()
    assert (off <= 2 * of_heat + 2e-5 * (u > 0))[counts].all()  # of the heat alone, whatever the noise
    assert (of_heat < 2 * by_heat)[counts].all()  # and not absurd
    assert (u >= u_plain * (1 - 1e-9) - 1e-12).all()


def test_temperatures_that_are_not_of_this_machine_or_unit_are_refused_or_said(machine, model, tmp_path):
    from compgen.identification.heat_of_readings import heat_source

    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 10), np.linspace(20, 22, 7), head="# machine = lathe\n")
    with pytest.raises(InputError, match=r"a\.temperatures\.csv.*has temperatures of lathe, not of mill"):
        heat_source(machine, None, file)
    fahrenheit = log(tmp_path / "f.temperatures.csv", range(0, 61, 10), np.linspace(68, 71.6, 7))
    with pytest.warns(CompgenWarning, match="is the log in degF"):
        assert at_reference_heat(machine, deviations(), source_of(fahrenheit, model)).outside
    fahrenheit.write_text(fahrenheit.read_text().replace("temp_spindle_c", "temp_x_c"))
    with pytest.raises(InputError, match=r"f\.temperatures\.csv:2: column temp_x_c: is never below 68 degC"):
        at_reference_heat(machine, deviations(), source_of(fahrenheit, None))


def test_a_sensor_that_rests_after_it_moved_is_said(machine, model, tmp_path):
    celsius = np.minimum(np.linspace(20, 22, 81), 20.7)  # rests from row 29 on
    file = log(tmp_path / "a.temperatures.csv", range(81), celsius)
    with pytest.warns(CompgenWarning, match=r"is 20\.7 degC in 53 rows in succession \(lines 30 to 82\)"):
        at_reference_heat(machine, deviations(), source_of(file, model))
    coarse = np.round(np.linspace(20, 22, 201))  # steps of 1 K: 50 rows, 100 rows, 51 rows
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        file = log(tmp_path / "b.temperatures.csv", range(201), coarse)
        at_reference_heat(machine, deviations(), source_of(file, model))


@pytest.mark.parametrize("offset", ["1e15", "-1e300", "nan"])
def test_an_offset_beyond_the_calendar_is_refused(machine, model, tmp_path, offset):
    text = f"# clock_offset_s = {offset}\n"
    file = log(tmp_path / "a.temperatures.csv", range(0, 61, 10), np.linspace(20, 22, 7), head=text)
    with pytest.raises(InputError, match=r"a\.temperatures\.csv.*is not a number of seconds"):
        at_reference_heat(machine, deviations(), source_of(file, model))
    late = deviations(metadata={"time_zero": "9999-12-31T23:59:59-14:00"})
    file = log(tmp_path / "b.temperatures.csv", range(0, 61, 10), np.linspace(20, 22, 7))
    with pytest.raises(InputError, match="the year 10000"):
        at_reference_heat(machine, late, source_of(file, model))


def test_only_the_channels_of_scales_tell_how_warm_they_are():
    from compgen.fleet.change import axis_temperatures

    read = {"temp_spindle_c": {"mean": 35.0}, "temp_ambient_c": {"mean": 22.0}, "temp_y_c": {"mean": 21.0}}
    assert axis_temperatures(read) == pytest.approx([np.nan, 21.0, np.nan], nan_ok=True)


def test_the_spindle_does_not_count_as_the_temperature_of_an_axis_that_is_run(machine):
    from compgen.identification.axis_tests import u_scale_of

    runs = axis_runs(lambda time_s: np.zeros((len(time_s), 3)))
    ones = np.full(len(runs), 21.0)
    spindle = replace(runs, covariates={"temp_spindle_c": ones})
    assert u_scale_of(machine, spindle) == u_scale_of(machine, runs)
    own = replace(runs, covariates={f"temp_{axis}_c": ones for axis in "xyz"})
    assert u_scale_of(machine, own) < 0.6 * u_scale_of(machine, runs)
