"""Programs corrected and parts predicted at stated temperatures: growth by hand, from a model of two sensors."""

import json

import numpy as np
import pytest
from programs.make import mill

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.error_table import Curve, ErrorTable, format_errors
from compgen.errors import CompgenWarning, InputError
from compgen.heat import HeatModel, growth_at, read_heat
from compgen.heat.model import Range, Term

#: dz = 2 um/K of the spindle behind 1200 s, dx = -3 um/K of the bed at once.
TERMS = (Term("spindle", 1200.0, "spindle", {"dx": 0.0, "dz": 2.0}), Term("bed", 0.0, "bed", {"dx": -3.0, "dz": 0.0}))
HULL = (Range("spindle", "", 18.0, 40.0), Range("bed", "", 18.0, 26.0), Range("spindle", "bed", -2.0, 16.0))
COVARIANCE = {"dx": np.diag([0.0, 0.01]), "dz": np.diag([0.04, 0.0])}
RMS = {"dx": (9.0, 0.5), "dz": (20.0, 1.0)}
PROGRAM = "G21 G90 G17 G94 G54\nG0 X0.000 Y0.000 Z5.000\nG1 Z-1.000 F200\nG1 X50.000 F500\nG1 Y40.000\nM2\n"
VALUES = ["--temperatures", "spindle=30,bed=22", "--heat-zero", "spindle=20,bed=20"]


@pytest.fixture
def shop(tmp_path):
    """A mill with errors of 0, its model of heat, a program; returns the words that all commands share."""
    model = HeatModel("mill", TERMS, COVARIANCE, HULL, RMS)
    (tmp_path / "mill.heat.toml").write_text(model.text({}))
    axes = "".join(
        f"[axes.{axis}]\nrange_mm = [{low}, {high}]\nnodes = 5\n"
        for axis, low, high in (("X", -600.0, 600.0), ("Y", -500.0, 500.0), ("Z", -400.0, 200.0))
    )
    (tmp_path / "mill.toml").write_text(f'name = "mill"\nchain = "WFYXZT"\n{axes}')
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EXX": Curve(ends, np.zeros(2), np.full(2, 1e-4))})
    (tmp_path / "mill.errors.csv").write_text(format_errors(errors))
    (tmp_path / "p.nc").write_text(PROGRAM)
    return tmp_path


def read_model(shop):
    return read_heat(shop / "mill.heat.toml")


def words(shop, command, *more):
    given = [command, str(shop / "mill.toml"), str(shop / "p.nc"), "--errors", str(shop / "mill.errors.csv")]
    return [*given, "--wcs", "G54=0,0,0", *more]


def correct(shop, *more):
    code = run_command(cli, words(shop, "correct", "--out", str(shop / "out"), "--decimals", "4", *more))
    return code, shop / "out"


@pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")
def test_a_program_goes_where_heat_has_not_moved_the_tool(shop):
    """The spindle is 10 K warmer: dz = +20 um, so Z is commanded 20 um lower; the bed 2 K: dx = -6 um, X 6 um higher."""
    code, out = correct(shop, *VALUES)
    assert code == 0
    text = (out / "p.nc").read_text()
    assert "Z-1.0200" in text or "Z-1.02" in text
    assert "X50.006" in text
    assert "Y40.000" in text
    found = json.loads((out / "correction.json").read_text())
    assert found["heat"]["dz_um"] == pytest.approx(20.0)
    assert found["heat"]["dx_um"] == pytest.approx(-6.0)
    assert found["heat"]["u_dz_um"] == pytest.approx(np.hypot(10 * 0.2, 1.0))
    assert found["before"]["max_um"] == pytest.approx(np.hypot(20, 6), abs=0.1)
    assert found["after"]["max_um"] < 0.2
    assert any("dy" in note and "not known" in note for note in found["notes"])
    assert "HEAT OF MILL.HEAT.TOML" in text


@pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")
def test_a_part_shows_what_heat_moves(shop, capsys):
    """Without temperatures nothing; with them the path is off by 20 um along Z and -6 um along X."""
    assert run_command(cli, words(shop, "part", "--json")) == 0
    plain = json.loads(capsys.readouterr().out)
    assert "heat" not in plain
    assert plain["path"]["max_um"] == pytest.approx(0.0, abs=1e-6)
    assert run_command(cli, words(shop, "part", "--json", *VALUES)) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["path"]["max_um"] == pytest.approx(np.hypot(20, 6), abs=1e-3)
    assert found["path_best_fit"]["max_um"] == pytest.approx(0.0, abs=1e-3)
    assert found["heat"]["dx_um"] == pytest.approx(-6.0)


def log_of(shop, seconds, spindle, bed):
    rows = "".join(f"{t},{a},{b}\n" for t, a, b in zip(seconds, spindle, bed, strict=True))
    file = shop / "day.temperatures.csv"
    file.write_text(f"time_s,temp_spindle_c,temp_bed_c\n{rows}")
    return str(file)


def test_lags_follow_a_file_of_temperatures(shop):
    """A ramp r of the spindle behind a lag tau: r (t - tau (1 - exp(-t / tau))); between readings on the straight line."""
    seconds = np.arange(0, 1201, 60)
    file = log_of(shop, seconds, 20 + seconds / 120, [20] * len(seconds))

    def dz(t):
        return 2 * (t - 1200 * (1 - np.exp(-t / 1200))) / 120

    assert growth_at(read_model(shop), file, None, None).moved["dz"] == pytest.approx(dz(1200), rel=1e-6)
    assert growth_at(read_model(shop), file, "600", None).moved["dz"] == pytest.approx(dz(600), rel=1e-6)
    later = growth_at(read_model(shop), file, None, "630").moved["dz"]
    assert later == pytest.approx(dz(1200) - (dz(600) + dz(660)) / 2, rel=1e-6)


@pytest.mark.parametrize(
    ("stated", "at", "zero", "said"),
    [
        ("spindle=45,bed=30", None, "spindle=20,bed=20", "spindle is 45.00"),
        ("spindle=30,bed=22", None, "spindle=17,bed=20", "spindle is 17.00"),
        ("spindle=39,bed=20", None, "spindle=20,bed=20", "spindle - bed is 19.00 K"),
        ("spindle=30,bed=22", None, None, "growth counts from a state"),
        ("spindle=30", None, "spindle=20,bed=20", "bed is missing"),
        ("spindle=30,bed=22,oil=3", None, "spindle=20,bed=20", "no sensor oil"),
        ("spindle=30,bed=nan", None, "spindle=20,bed=20", "no temperature"),
        ("spindle=30,bed=22,bed=22", None, "spindle=20,bed=20", "twice"),
        ("spindle=30,bed=22", "5", "spindle=20,bed=20", "belongs to a file"),
    ],
)
def test_values_that_say_nothing_are_refused(shop, stated, at, zero, said):
    with pytest.raises(InputError, match=said):
        growth_at(read_model(shop), stated, at, zero)


@pytest.mark.parametrize(
    ("at", "zero", "said"),
    [
        ("9999", None, "outside the readings"),
        ("60", "120", "before the zero"),
        ("nan", None, "outside the readings"),
        ("noon", None, "no moment"),
        ("2026-03-02T07:30:00", None, "no zone"),
        ("2026-03-02T07:30:00Z", None, "which has time_s"),
    ],
)
def test_moments_that_the_file_does_not_have_are_refused(shop, at, zero, said):
    file = log_of(shop, range(0, 301, 60), [20] * 6, [20] * 6)
    with pytest.raises(InputError, match=said):
        growth_at(read_model(shop), file, at, zero)


def test_moments_with_zones_are_found_on_the_clock_of_the_file(shop):
    rows = "".join(f"2026-03-02T07:{30 + k}:00+01:00,20,{20 + k}\n" for k in range(5))
    (shop / "clock.csv").write_text(f"time,temp_spindle_c,temp_bed_c\n{rows}")
    found = growth_at(read_model(shop), str(shop / "clock.csv"), "2026-03-02T06:31:30Z", None)
    assert found.moved["dx"] == pytest.approx(-3 * 1.5)


def test_a_sensor_that_jumps_and_a_gap_are_refused(shop):
    bed = [20.0, 20.01] * 20
    bed[20] = 24.0
    file = log_of(shop, range(0, 2400, 60), [20] * 40, bed)
    with pytest.warns(CompgenWarning), pytest.raises(InputError, match="temp_bed_c jumps"):
        growth_at(read_model(shop), file, None, None)
    file = log_of(shop, [0, 60, 120, 180, 9000, 9060], [20] * 6, [20] * 6)
    with pytest.warns(CompgenWarning), pytest.raises(InputError, match="gap"):
        growth_at(read_model(shop), file, None, None)


@pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")
def test_commands_refuse_what_does_not_fit_and_write_nothing(shop, capsys):
    assert correct(shop, "--heat", str(shop / "mill.heat.toml"))[0] == 2
    assert "add --temperatures" in capsys.readouterr().err
    assert correct(shop, "--temperatures", "spindle=45,bed=30", "--heat-zero", "spindle=20,bed=20")[0] == 2
    assert "says nothing of this state" in capsys.readouterr().err
    other = (shop / "mill.heat.toml").read_text().replace('machine = "mill"', 'machine = "lathe"')
    (shop / "lathe.heat.toml").write_text(other)
    assert correct(shop, "--heat", str(shop / "lathe.heat.toml"), *VALUES)[0] == 2
    assert "of lathe, not of mill" in capsys.readouterr().err
    (shop / "mill.heat.toml").unlink()
    assert correct(shop, *VALUES)[0] == 2
    assert "name it with --heat" in capsys.readouterr().err
    assert run_command(cli, words(shop, "part", *VALUES, "--also", "a=b")) == 2
    assert "those of one machine" in capsys.readouterr().err
    assert not (shop / "out").exists()


def test_the_uncertainty_of_a_place_has_that_of_the_growth_and_a_size_does_not():
    """Weights of two samples: a place counts both alike, a length takes one from the other."""
    from types import SimpleNamespace

    from compgen.heat import Growth
    from compgen.programs.part import _u_of_feature
    from compgen.programs.path import ExactModel

    growth = Growth({"dx": 5.0}, {"dx": 3.0}, {}, {}, ("m", ""))
    model = ExactModel(mill(), ErrorTable(), None, growth=growth)
    field = SimpleNamespace(u_of=lambda _: 4e-3)
    machine = SimpleNamespace(model=model, covariance=1, posterior=SimpleNamespace(field=lambda *_: field))
    samples = SimpleNamespace(position_mm=np.zeros((2, 3)), tool_mm=None)
    place, length = np.zeros((2, 2, 3))
    place[:, 0], length[:, 0] = 0.5, [-1.0, 1.0]
    assert _u_of_feature(machine, samples, place) == pytest.approx(5e-3)
    assert _u_of_feature(machine, samples, length) == pytest.approx(4e-3)
