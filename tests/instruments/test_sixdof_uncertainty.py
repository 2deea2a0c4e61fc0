"""Uncertainties of the six-DOF errors: they cover, they come from where they should, and the tables of the paper."""

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable, fitted_line
from compgen.data.machine import load_machine
from compgen.data.names import error_named
from compgen.instruments.sixdof_evaluation import (
    axis_runs,
    each_run,
    evaluate_readings,
    format_table,
    half_ranges,
    in_table_units,
    largest_differences,
)
from compgen.instruments.sixdof_instrument import known_systematics, read_instrument
from compgen.instruments.sixdof_uncertainty import uncertainty_budget
from compgen.simulation import SimulatedSixDof, draw_truth
from compgen.simulation.sixdof import HALF_RANGE, TABLE_3
from compgen.simulation.truth import RandomErrors, TruthPlan

ARCSEC, UM = np.pi / 648000, 1e-3
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
MACHINE = load_machine("jia-xytz")
INSTRUMENT = read_instrument(EXAMPLES / "jia-xytz.instrument.toml")
AT = np.linspace(0.0, 800.0, 9)
SCATTER = np.array(TABLE_3) * np.array([UM, UM, UM, ARCSEC, ARCSEC, ARCSEC]) / HALF_RANGE
SQUARENESS = {"EC0Y": (5.0 * ARCSEC, np.nan), "EB0Z": (-6.7 * ARCSEC, np.nan), "EA0Z": (31.1 * ARCSEC, np.nan)}


@cache
def truth():
    random = RandomErrors((5 * UM, 10 * UM), (10e-6, 30e-6), (0.0, 0.0), (9, 9, 9))
    return draw_truth(TruthPlan(ErrorTable({}, SQUARENESS), random), MACHINE, np.random.SeedSequence(3))


def expected(found):
    """The truth as the instrument's errors have it: straightness without its line, which goes into squareness."""
    true, curves, slope = truth(), {}, {}
    for name in found.curves:
        value = true.curves[name].at(AT) if name in true.curves else np.zeros(len(AT))
        if error_named(name).is_straightness:
            constant, slope[name] = fitted_line(AT, value)
            value = value - constant - slope[name] * AT
        curves[name] = Curve(AT, value - value[0], np.zeros(len(AT)))
    moved = {"EC0Y": -slope["EYX"] - slope["EXY"], "EB0Z": slope["EZX"] + slope["EXZ"]}
    moved["EA0Z"] = -slope["EZY"] - slope["EYZ"]
    return ErrorTable(curves, {name: (SQUARENESS[name][0] + moved[name], 0.0) for name in SQUARENESS})


def measured(rng, **changes):
    """Readings of the machine with the noise of Table 3; what is calibrated is off by its stated uncertainty."""
    off = {name: INSTRUMENT.u_systematics.get(name, 0.0) * rng.standard_normal() for name in known_systematics()}
    simulated = SimulatedSixDof(
        INSTRUMENT,
        off,
        positions_mm=(AT, AT, AT),
        scatter=SCATTER,
        noise_mm=np.array([0.01, *[0.05] * 4, *[0.02] * 4]) * UM,
        drift_rad=0.05 * ARCSEC,
        **changes,
    )
    return simulated.measure(MACHINE, truth(), rng)


def test_stated_uncertainties_cover_with_the_noise_of_table_3():
    """Differences to the truth over u: root mean square 1 within its scatter, and 95 % within two u.

    Of 36 squareness values fewer than 31 within two u would be rarer than 1 in 100.
    """
    ratios = {"curves": [], "squareness": []}
    for seed in range(12):
        budget = uncertainty_budget(MACHINE, measured(np.random.default_rng([7, seed])), INSTRUMENT)
        target = expected(budget.errors)
        for name, curve in budget.errors.curves.items():
            known = curve.u > 1e-12
            ratios["curves"] += list((curve.value - target.curves[name].value)[known] / curve.u[known])
        for name, (value, u) in budget.errors.squareness.items():
            ratios["squareness"].append((value - target.squareness[name][0]) / u)
    for kind, low, high, within in (("curves", 0.85, 1.15, 0.92), ("squareness", 0.7, 1.35, 31 / 36)):
        values = np.array(ratios[kind])
        assert low <= np.sqrt(np.mean(values**2)) <= high, kind
        assert np.mean(np.abs(values) < 2.0) >= within, kind


def test_each_source_of_the_budget_is_the_change_that_it_makes():
    """Independent: the readings are reduced with a prism that is off by its uncertainty, and squareness by twice that."""
    readings = measured(np.random.default_rng(1))
    budget = uncertainty_budget(MACHINE, readings, INSTRUMENT).contributions()
    u = INSTRUMENT.u_systematics
    assert budget["EC0Y"]["eps_zir of Y"] == pytest.approx(2.0 * u["eps_zir"], rel=1e-6)
    assert budget["EB0Z"]["eps_yir of Z"] == pytest.approx(2.0 * u["eps_yir"], rel=1e-6)
    assert budget["EA0Z"]["eps_xir of Y"] == pytest.approx(u["eps_xir"], rel=1e-6)
    assert budget["EC0Y"]["eps_zmrs1"] == pytest.approx(
        (INSTRUMENT.optics.glass_index - 1.0) * u["eps_zmrs1"], rel=1e-6
    )
    travel = AT[-1] - AT[0]
    for roll in ("EAX", "EBY", "ECZ"):
        bias = u["eps_PEy"] * travel / INSTRUMENT.optics.beam_separation_mm
        assert budget[roll]["eps_PEy"] == pytest.approx(bias, rel=1e-6)
    assert "eps_PEy" not in {source for source, value in budget["EYX"].items() if value > 1e-9}


def test_stated_noise_propagates_as_many_simulated_sets_scatter():
    """Detector noise alone, one run: standard deviations over 150 sets within 15 % (three times their own scatter)."""
    noisy = dataclasses.replace(
        INSTRUMENT, noise={"displacement": 0.02 * UM, "qd": 0.2 * UM, "psd": 0.1 * UM}, u_constants={}, u_systematics={}
    )
    simulated = SimulatedSixDof(noisy, runs=1, positions_mm=(AT, AT, AT))
    quiet = simulated.measure(MACHINE, truth(), np.random.default_rng(0))
    stated = uncertainty_budget(MACHINE, quiet, noisy)
    kinds = {name: 0.2 * UM if "qd" in name else 0.1 * UM if "psd" in name else 0.02 * UM for name in quiet.signals_mm}
    rng, sets = np.random.default_rng(5), []
    for _ in range(150):
        signals = {n: v + kinds[n] * rng.standard_normal(len(v)) for n, v in quiet.signals_mm.items()}
        drawn = dataclasses.replace(quiet, signals_mm=signals)
        sets.append(evaluate_readings(MACHINE, drawn, noisy).errors.values())
    found, u = np.std(sets, axis=0), np.sqrt(np.sum(stated.factor**2, axis=1))
    known = u > 1e-12
    assert np.sqrt(np.mean((found[known] / u[known]) ** 2)) == pytest.approx(1.0, abs=0.03)
    assert np.abs(found[known] / u[known] - 1.0).max() <= 0.25


def test_an_uncertainty_without_repeats_and_without_stated_noise_comes_from_neighbours():
    bare = dataclasses.replace(INSTRUMENT, noise={}, u_constants={}, u_systematics={})
    simulated = SimulatedSixDof(bare, runs=1, positions_mm=(AT, AT, AT), scatter=5 * SCATTER)
    readings = simulated.measure(MACHINE, truth(), np.random.default_rng(2))
    budget = uncertainty_budget(MACHINE, readings, bare)
    assert set(budget.sources) == {"repeatability"}
    u = budget.errors.curves["EAX"].u.max()
    assert 0.5 <= u / (np.sqrt(2.0) * 5 * SCATTER[0, 5]) <= 2.0  # zero at the first position: the root of two


def test_runs_whose_slopes_differ_make_squareness_as_uncertain_as_they_differ():
    """Straightness of X of three runs leans by -12, 0 and 12 urad more: their mean has 12 urad / sqrt(3)."""
    readings = measured(np.random.default_rng(8))
    lean = 12e-6 * (readings.run - 2.0) * (readings.axis == 0) * readings.position_mm
    signals = {**readings.signals_mm}
    for name in ("y_qd1_mm", "y_qd2_mm"):
        signals[name] = signals[name] + 2.0 * lean
    leaning = dataclasses.replace(readings, signals_mm=signals)
    plain, found = (uncertainty_budget(MACHINE, r, INSTRUMENT).contributions() for r in (readings, leaning))
    assert plain["EC0Y"].get("run to run", 0.0) == 0.0
    assert found["EC0Y"]["run to run"] == pytest.approx(12e-6 / np.sqrt(3.0), rel=0.3)
    assert found["EA0Z"]["run to run"] == 0.0


def test_the_half_range_of_three_runs_is_the_papers_metric():
    """T10: half of max minus min at each position, the worst one counts."""
    runs = axis_runs(MACHINE, measured(np.random.default_rng(4)), INSTRUMENT)
    tables = [item.errors for item in each_run(MACHINE, INSTRUMENT, runs)]
    found = half_ranges(each_run(MACHINE, INSTRUMENT, runs))
    assert len(tables) == 3
    for name in ("EXX", "EAX", "EYX"):
        values = np.array([table.curves[name].value for table in tables])
        assert found[name] == max((column.max() - column.min()) / 2 for column in values.T)
    s_xy = [table.squareness["EC0Y"][0] for table in tables]
    assert found["EC0Y"] == (max(s_xy) - min(s_xy)) / 2
    assert half_ranges(each_run(MACHINE, INSTRUMENT, [run for run in runs if run.run == 1])) == {}


def test_the_scatter_of_a_simulation_gives_back_the_half_ranges_of_table_3():
    """Drawn straight from the definition: the worst half range of 3 runs at 17 positions is 1.75 standard deviations."""
    drawn = np.random.default_rng(6).standard_normal((4000, 3, 17))
    worst = 0.5 * np.ptp(drawn, axis=1).max(axis=1)
    assert worst.mean() == pytest.approx(HALF_RANGE, abs=0.02)


def test_the_comparison_takes_out_the_line_and_the_zero_of_the_reference():
    at = np.array([0.0, 100.0, 200.0, 300.0])
    u = np.zeros(4)
    own = ErrorTable(
        {"EYX": Curve(at, np.array([0, 1, 0, 1]) * UM, u), "EAX": Curve(at, np.arange(4) * 1e-6, u)},
        {"EC0Y": (3e-6, 0.0)},
    )
    line = 4 * UM + 1e-5 * at
    other = ErrorTable(
        {"EYX": Curve(at, np.array([0, 1, 0, 1]) * UM + line, u), "EAX": Curve(at, np.arange(4) * 3e-6 + 9e-6, u)},
        {"EC0Y": (1e-6, 0.0)},
    )
    found = largest_differences(own, other)
    assert found["EYX"] == pytest.approx(0.0, abs=1e-15)
    assert found["EAX"] == pytest.approx(6e-6)
    assert found["EC0Y"] == pytest.approx(2e-6)


def test_the_table_has_the_units_of_the_paper():
    values = {
        "EXX": 90e-6,
        "EXY": 0.33 * UM,
        "EXZ": 0.84 * UM,
        "EBX": 0.53 * ARCSEC,
        "EBY": 1.19 * ARCSEC,
        "EB0Z": ARCSEC,
    }
    table = in_table_units(values)
    assert table["positioning (nm)"] == {"X": pytest.approx(90.0)}
    assert table["horizontal straightness (um)"] == {"Y": pytest.approx(0.33)}
    assert table["vertical straightness (um)"] == {"Z": pytest.approx(0.84)}
    assert table["pitch (arcsec)"] == {"X": pytest.approx(0.53)}
    assert table["roll (arcsec)"] == {"Y": pytest.approx(1.19)}
    assert table["squareness (arcsec)"] == {"S_xz": pytest.approx(1.0)}
    text = format_table({"6DOF": values, "standard": {"EXX": 30e-6}})
    assert text.splitlines()[1].split() == ["positioning", "(nm)", "X", "90.000", "30.000"]
    assert text.splitlines()[2].split()[-1] == "-"
