"""Whether a machine has changed, given how well it repeats: worked numbers, and how often the decision is right."""

import sys
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from test_recal import drifted
from test_recal_active import site, site_in, site_with_tables  # noqa: F401  (fixtures)

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.repeatability import Repeatability
from compgen.fleet import change
from compgen.fleet.job import read_job

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def bench():
    """The module of the benchmark, which draws calibrations."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield __import__("recal_changes")
    finally:
        sys.path.remove(str(BENCHMARKS))
        sys.modules.pop("recal_changes", None)


def compared(value, levels=None, *, window=1, s0=1.0, prior=(None, 0.0), others=()):
    """Error probability, size, and variance of one value."""
    value = np.array(value, dtype=float)
    level = np.zeros(len(value), dtype=int) if levels is None else np.array(levels)
    last = np.arange(len(value))[-window:]
    before = np.ones(len(value), dtype=bool)
    before[last] = False
    step = change._step(change.Series(value, s0, *prior), level, before, last)
    near = [change._step(change.Series(np.array(item, dtype=float), s0), level, before, last) for item in others]
    p_value, variance = change._t_test(step, s0, near)
    return p_value, step.size, variance


# --- worked numbers --------------------------------------------------------------------------------------------------


def test_one_value_against_equal_ones_before():
    """Four zeros, then 5: s^2 = (4 + 0) / (4 + 3), t = 5 / sqrt(s^2 (1 + 1/4)) = 5.916 with 7 degrees of freedom."""
    p_value, size, variance = compared([0, 0, 0, 0, 5])
    assert (size, variance) == (5.0, pytest.approx(4.0 / 7.0))
    assert p_value == pytest.approx(2.0 * stats.t.sf(5.0 / np.sqrt(4.0 / 7.0 * 1.25), 7))
    assert p_value == pytest.approx(5.86e-4, rel=1e-2)


def test_the_mean_of_the_last_two_against_three_that_scatter():
    """1, 2, 3 | 6, 8: means 2 and 7; SS = 2; s^2 = (4 * 0.25 + 2) / (4 + 2) = 0.5, t = 5 / sqrt(0.5 (1/2 + 1/3))."""
    p_value, size, variance = compared([1, 2, 3, 6, 8], window=2, s0=0.5)
    assert (size, variance) == (pytest.approx(5.0), pytest.approx(0.5))
    assert p_value == pytest.approx(2.0 * stats.t.sf(5.0 / np.sqrt(0.5 * (0.5 + 1.0 / 3.0)), 6))


def test_measurements_of_earlier_tables_count_about_their_own_mean():
    """An earlier state at 100 +- 1 tells how the machine repeats, not where it is: SS = 2, N = 1 + 0."""
    p_value, size, variance = compared([99, 101, 0, 3], [0, 0, 1, 1])
    assert (size, variance) == (pytest.approx(3.0), pytest.approx((4.0 + 2.0) / (4.0 + 1.0)))
    assert p_value == pytest.approx(2.0 * stats.t.sf(3.0 / np.sqrt(1.2 * 2.0), 5))


def test_other_directions_tell_how_the_machine_repeats():
    """Two others with SS' = 2 + 6 from N' = 4: r = (4 + 8) / 8 = 1.5 counts as 8; s^2 = (8 * 1.5 + 2) / (8 + 2) = 1.4."""
    p_value, size, variance = compared([1, 2, 3, 7], others=([0, 1, 2, 0], [0, 0, 3, 9]))
    assert (size, variance) == (pytest.approx(5.0), pytest.approx(1.4))
    assert p_value == pytest.approx(2.0 * stats.t.sf(5.0 / np.sqrt(1.4 * 4.0 / 3.0), 10))
    longer = [0, 1, 0, 1, 0, 1, 0, 1, 4]  # N' = 14: no more than 10; r = (4 + 2 * 2) / 18, SS = 2
    assert compared(longer, others=(longer, longer))[2] == pytest.approx((10.0 * 8.0 / 18.0 + 2.0) / (10.0 + 7.0))


def test_a_coefficient_that_is_known_exactly_changes_nothing_and_an_unknown_one_explains_the_warmth():
    warm = np.array([0.0, 1.0, -1.0, 2.0, -2.0, 6.0])
    value = np.array([0.1, 2.0, -2.1, 4.1, -4.0, 12.2])  # 2 for each kelvin
    exact = compared(value, prior=(warm, 1e9))
    assert exact == pytest.approx(compared(value), rel=1e-6)
    p_value, size, _ = compared(value, prior=(warm, 1.0 / 3.0))
    assert p_value > 0.2 and abs(size) < 1.0 < 12.0 < compared(value)[1] + 0.3
    design = np.vstack([np.column_stack([np.ones(5), warm[:5]]), [0.0, 1.0 / 3.0]])
    found = np.linalg.lstsq(design, np.append(value[:5], 0.0), rcond=None)[0]
    assert size == pytest.approx(value[5] - found @ [1.0, 6.0])


def test_windows_grow_with_the_history():
    assert [list(change._windows(n)) for n in (2, 3, 4, 6)] == [[1], [1, 2], [1, 2, 3], [1, 2, 3]]
    assert (len(change._windows(12)), len(change._windows(21)), len(change._windows(40))) == (5, 10, 10)


# --- how often it is right -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "expansion"),
    [
        ("0.3 K + 1 urad", None),
        ("the same, coefficient 20 % wrong, hall +- 3 K", 11.5),
        ("0.3 K + 1 urad, hall +- 2 K that nobody reads", None),
    ],
)
def test_an_unchanged_machine_is_rarely_proposed(bench, row, expansion):
    """At most 2 % of the measurements; the benchmark counts 300 machines."""
    machine = bench.machine_of(expansion=expansion)
    assert bench.false_share(machine, bench.ROWS[row], 6, 10, np.random.default_rng(3)) <= 2.0


def test_five_urad_are_found_by_the_second_measurement(bench):
    machine, rng = bench.machine_of(), np.random.default_rng(4)
    found = bench.found_share(machine, bench.ROWS["0.3 K + 1 urad"], bench.SQUARENESS, 8, 2, 16, rng)
    assert found[1] >= 80.0  # of 16; 90 % of many


def test_a_bump_that_is_no_scale_and_no_squareness_is_found_at_once(bench):
    machine, rng = bench.machine_of(), np.random.default_rng(5)
    assert bench.found_share(machine, bench.ROWS["0.3 K + 1 urad"], {"bump": 1e-3}, 5, 1, 6, rng)[0] == 100.0


def test_what_changed_is_named_with_its_size(bench):
    machine, rng = bench.machine_of(), np.random.default_rng(6)
    made = bench.Simulated(machine, bench.Repeats(), rng)
    known = [made.calibration() for _ in range(6)]
    made.step = {"EYY": 44e-6}
    known.append(made.calibration())
    found = change.change_since(machine, known, [0] * 7, 0.98, corrected=False)
    assert found.significant and found.largest.startswith("scale of Y +4") and found.largest.endswith("um/m")


def test_one_scale_is_told_from_a_hall_that_nobody_reads(bench):
    """The hall is 2 K warmer: 23 um/m in all scales, which is no change; 20 um/m in X alone is one, and is named."""
    machine, rng = bench.machine_of(), np.random.default_rng(8)
    made = bench.Simulated(machine, bench.Repeats(), rng)
    known = [made.calibration() for _ in range(6)]
    made.step = dict.fromkeys(("EXX", "EYY", "EZZ"), 23e-6)
    warm = change.change_since(machine, [*known, made.calibration()], [0] * 7, 0.98, corrected=False)
    assert not warm.significant
    still = machine_with(machine, Repeatability(season_k=0.0))
    assert change.change_since(still, [*known, made.calibration()], [0] * 7, 0.98, corrected=False).significant
    made.step["EXX"] += 30e-6
    found = change.change_since(machine, [*known, made.calibration()], [0] * 7, 0.98, corrected=False)
    assert found.significant
    assert found.largest.startswith("scale of X +")


def machine_with(machine, repeatability):
    return replace(machine, repeatability=repeatability)


# --- through the commands --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("where", "held"), [("", False), ("machine", True), ("job", True)])
def test_the_stated_repeatability_decides(site, small_errors, where, held):  # noqa: F811
    """12 urad after one calibration: beyond 1 urad, within 4 urad."""
    site.measure("first", active_table="none")
    assert site.run().active == 1
    if where == "machine":
        path = site.folder / "mill.toml"
        path.write_text(path.read_text() + "\n[repeatability]\nsquareness_urad = 4.0\n")
    if where == "job":
        path = site.folder / "recal.toml"
        path.write_text(path.read_text() + "\n[machines.mill.repeatability]\nsquareness_urad = 4.0\n")
        site.job = read_job(path)
    site.now += timedelta(days=9)
    site.measure("second", drifted(small_errors, 12.0), on=site.on(), seed=2, shown=True)
    outcome = site.run()
    said = " ".join(site.tables()[-1].reasons)
    assert ("is within its uncertainty" in said) == held, said
    assert (outcome.state, outcome.active) == (("held", 1) if held else ("ok", 2))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("squareness_urad = 0", "from 0.001 to 10000"),
        ("squareness_urad = -1", "from 0.001 to 10000"),
        ('scale_um_per_m = "3.5"', "expected a finite number"),
        ("squarness_urad = 1", "squareness_urad"),
    ],
)
def test_wrong_keys_are_refused_in_both_files(site, capsys, text, said):  # noqa: F811
    job, machine = site.folder / "recal.toml", site.folder / "mill.toml"
    whole = job.read_text()
    job.write_text(f"{whole}\n[machines.mill.repeatability]\n{text}\n")
    assert run_command(cli, ["recal", "status", "--job", str(job)]) == 2
    assert said in capsys.readouterr().err
    job.write_text(whole)
    machine.write_text(f"{machine.read_text()}\n[repeatability]\n{text}\n")
    assert run_command(cli, ["check", str(machine)]) == 2
    assert said in " ".join(capsys.readouterr())


def test_the_uncertainty_of_an_expansion_coefficient():
    from compgen.data.machine import Axis

    ends, nodes = (0.0, 100.0), np.linspace(0.0, 100.0, 5)
    assert Axis(ends, nodes).u_expansion == 0.0
    assert Axis(ends, nodes, 10.0).u_expansion == pytest.approx(2e-6)
    assert Axis(ends, nodes, 10.0, u_expansion_um_per_m_k=0.5).u_expansion == pytest.approx(0.5e-6)
    assert Repeatability().scale(temperatures=False) == 3.5e-6 and Repeatability().scale(temperatures=True) == 1e-6
