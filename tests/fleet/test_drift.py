"""Drift: gauge, changes, trends, temperature, steps, and whether the truth lies inside the stated intervals."""

import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from compgen.data.error_table import Curve
from compgen.data.names import ERROR_INDEX
from compgen.errors import InputError
from compgen.fleet.change import Calibration, aligned, changes, holm
from compgen.fleet.drift import WALKS, DriftSettings, TimeSeries, drift_report, first_exit, fit_trend, forecast
from compgen.identification.covariance import Covariance, covariance_or_independent
from compgen.kinematics.gauge import gauge_directions
from compgen.kinematics.many_points import volumetric_error

DAY = datetime(2026, 1, 5, 8, tzinfo=UTC)
URAD, UM = 1e-6, 1e-3
#: Standard uncertainty of every identified value of the simulated calibrations.
NOISE_UM = 0.3


def moved(errors, *, amounts=None, machine=None, **changed):
    """The errors plus changes: squareness by name in rad, curves by name as a function of position; along the gauge."""
    shift = np.zeros((21, 2))
    if amounts is not None:
        directions = gauge_directions(machine, errors.names)
        shift = np.tensordot(amounts[: len(directions)], directions, axes=1)
    curves, constants = {}, {}
    for name, curve in errors.curves.items():
        constant, slope = shift[ERROR_INDEX[name]]
        extra = changed.get(name, np.zeros_like)(curve.position_mm)
        curves[name] = Curve(curve.position_mm, curve.value + constant + slope * curve.position_mm + extra, curve.u)
    for name, (value, u) in errors.squareness.items():
        constants[name] = (value + shift[ERROR_INDEX[name], 0] + changed.get(name, 0.0), u)
    return errors.replace(curves=curves, squareness=constants)


def measured(errors, generator, day, temperature_c=None):
    """A calibration of these errors: independent noise on every value, covariance as it is."""
    curves, constants = {}, {}
    for name, curve in errors.curves.items():
        u = np.full(len(curve.value), NOISE_UM * (UM if ERROR_INDEX[name] % 6 < 3 else URAD))
        curves[name] = Curve(curve.position_mm, curve.value + generator.normal(size=len(u)) * u, u)
    for name, (value, _) in errors.squareness.items():
        constants[name] = (value + generator.normal() * NOISE_UM * URAD, NOISE_UM * URAD)
    noisy = errors.replace(curves=curves, squareness=constants)
    logged = {} if temperature_c is None else {"ambient": temperature_c}
    return Calibration(DAY + timedelta(days=float(day)), noisy, covariance_or_independent(noisy, None), logged)


def year(machine, errors, *, seed=0, drift=1.5, step=0.0, per_kelvin=0.0):
    """Twelve months: EC0Y drifts by ``drift`` urad a month, EXX is stretched by a ``step`` um after the fifth, warm summer."""
    generator = np.random.default_rng(seed)
    low, high = machine.axes[0].range_mm
    history = []
    for month in range(12):
        warm = 20.0 + 4.0 * np.sin(2 * np.pi * month / 12)
        crash = step * UM if month > 4 else 0.0

        def stretched(x, size=crash):
            return size * (x - low) / (high - low)

        square = (drift * month + per_kelvin * (warm - 20.0)) * URAD
        truth = moved(errors, EC0Y=square, EXX=stretched)
        history.append(measured(truth, generator, 30.4375 * month, warm if per_kelvin else None))
    return history


def left_rms_mm(machine, truth, held):
    """Rms over the volume of the true errors minus those that tables hold, after the best rigid motion."""
    levels = [np.linspace(*axis.range_mm, 6) for axis in machine.axes]
    place = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)
    field = volumetric_error(machine, truth, place) - volumetric_error(machine, held, place)
    turns = [np.cross(axis, place).ravel() for axis in np.eye(3)]
    rigid = np.column_stack([*(np.tile(axis, len(place)) for axis in np.eye(3)), *turns])
    left = field.ravel() - rigid @ np.linalg.lstsq(rigid, field.ravel(), rcond=None)[0]
    return np.sqrt(left @ left / len(place))


def figure(drift, name):
    return next(item for item in drift.figures if item.figure.name == name)


def test_changes_along_the_gauge_change_nothing(small_machine, small_errors):
    generator = np.random.default_rng(3)
    first = measured(small_errors, generator, 0)
    amounts = generator.normal(size=40) * 1e-4
    same = Calibration(DAY, moved(first.errors, amounts=amounts, machine=small_machine), first.covariance)
    data = aligned(small_machine, [first, same])
    assert np.abs(data.value[0]).max() > 1e-3
    assert data.value[1] == pytest.approx(data.value[0], abs=1e-12)
    assert all(item.p_value == pytest.approx(1.0) for item in changes(data, 1, 0))


def test_a_squareness_change_stays_in_its_error_also_where_another_gauge_hides_it_in_a_slope(
    small_machine, small_errors
):
    generator = np.random.default_rng(4)
    first = measured(small_errors, generator, 0)
    # EXY slope of -10 um/m is EC0Y of +10 urad: both give dX = -1e-5 y
    slope = Calibration(DAY, moved(first.errors, EXY=lambda y: -10e-6 * y), first.covariance)
    data = aligned(small_machine, [first, slope])
    change = {item.error: item for item in changes(data, 1, 0)}
    assert change["EC0Y"].largest == pytest.approx(10e-6, rel=1e-9)
    assert abs(change["EXY"].largest) < 1e-12
    line, bow = (next(f for f in data.figures if f.name == name) for name in ("EXX line", "EXX bow"))
    assert (line.unit, bow.unit) == ("um", "um")
    assert "EXY line" not in [item.name for item in data.figures]


def test_the_figures_of_a_known_parabola(small_machine, small_errors):
    generator = np.random.default_rng(5)
    first = measured(small_errors, generator, 0)
    low, high = small_machine.axes[0].range_mm

    def added(x):
        share = (x - low) / (high - low)
        return 4 * UM * share + 3 * UM * 4 * share * (1 - share)

    data = aligned(small_machine, [first, Calibration(DAY, moved(first.errors, EXX=added), first.covariance)])
    names = [item.name for item in data.figures]
    change = np.diff(data.figure_values(), axis=0)[0]
    assert change[names.index("EXX line")] == pytest.approx(4 * UM)
    assert change[names.index("EXX bow")] == pytest.approx(3 * UM)


def test_the_adjusted_probabilities_count_all_that_were_looked_at():
    assert holm([0.04, 0.01, 0.03]) == pytest.approx([0.06, 0.03, 0.06])


def test_without_change_the_probabilities_are_even_and_few_are_called_significant(small_machine, small_errors):
    generator = np.random.default_rng(6)
    p_values, alarms = [], 0
    for _ in range(25):
        data = aligned(small_machine, [measured(small_errors, generator, k) for k in range(2)])
        found = changes(data, 1, 0)
        p_values += [item.p_value for item in found]
        alarms += min(item.adjusted for item in found) < 0.05
    assert np.mean(p_values) == pytest.approx(0.5, abs=0.05)
    assert np.mean(np.array(p_values) < 0.05) == pytest.approx(0.05, abs=0.03)
    assert alarms <= 5  # binomial (25, 0.05): more than 5 in 0.1 % of all cases


def test_a_slow_drift_is_named_and_forecast(small_machine, small_errors):
    settings = DriftSettings({"EC0Y": 20 * URAD, "volume": 2 * UM}, walk=False)
    drift = drift_report(small_machine, year(small_machine, small_errors), settings)
    found = figure(drift, "EC0Y")
    per_month, u = (30.4375 * value / URAD for value in found.trend.slope)
    assert abs(per_month - 1.5) < 3 * u
    assert not drift.gaps
    truth_days = 20 / 1.5 * 30.4375 - found.series.days[-1]  # crosses 20 urad after 13.33 months
    assert found.forecast.low_days < truth_days < found.forecast.high_days
    assert re.fullmatch(r"EC0Y leaves tolerance in about \d+ weeks, 95 % \d+-\d+", found.forecast.words("EC0Y"))
    assert drift.since_first[[c.error for c in drift.since_first].index("EC0Y")].adjusted < 1e-6
    assert drift.volume_since_first.significant
    significant = [item.figure.name for item in drift.figures if item.adjusted < 0.05]
    assert significant == ["EC0Y"]
    later = np.arange(0.0, 400.0, 2.0)
    held = year(small_machine, small_errors)[0].errors
    left = [left_rms_mm(small_machine, moved(small_errors, EC0Y=1.5 * URAD * (11 + d / 30.4375)), held) for d in later]
    assert left[0] < 2 * UM < left[-1]
    truth_days = later[np.argmax(np.array(left) > 2 * UM)]
    assert drift.volume_forecast.low_days < truth_days < drift.volume_forecast.high_days < 730.0
    assert drift.summary()["figures"][0]["trend"] is not None


def test_a_crash_is_told_from_a_drift(small_machine, small_errors):
    drift = drift_report(small_machine, year(small_machine, small_errors, step=6.0, seed=2))
    assert list(drift.gaps) == [5]
    ((hit, step),) = drift.gaps[5]
    assert hit.name == "EXX line"
    assert abs(step.size - 6 * UM) < 3 * step.u
    assert any(text.startswith("step between 2026-05-07") and "EXX line" in text for text in drift.sentences())


def test_the_part_of_the_temperature_is_separated(small_machine, small_errors):
    history = year(small_machine, small_errors, per_kelvin=2.0, seed=3)
    drift = drift_report(small_machine, history, DriftSettings(walk=False))
    trend = figure(drift, "EC0Y").trend
    value, u = trend.per_kelvin
    assert abs(value - 2.0 * URAD) < 3 * u
    assert abs(30.4375 * trend.slope[0] - 1.5 * URAD) < 3 * 30.4375 * trend.slope[1]
    without = [Calibration(item.at, item.errors, item.covariance) for item in history]
    blind = figure(drift_report(small_machine, without, DriftSettings(walk=False)), "EC0Y").trend
    assert abs(blind.slope[0] - trend.slope[0]) > 5 * trend.slope[1]


def test_the_line_is_that_of_weighted_least_squares():
    generator = np.random.default_rng(7)
    days, u = np.cumsum(generator.uniform(10, 40, 9)), generator.uniform(0.5, 2.0, 9)
    value = 3.0 + 0.05 * days + generator.normal(size=9) * u
    trend = fit_trend(TimeSeries(days, value, u), walk=False)
    coefficients, covariance = np.polyfit(days, value, 1, w=1 / u, cov="unscaled")
    assert trend.slope == pytest.approx((coefficients[0], np.sqrt(covariance[0, 0])))
    assert trend.components[0].state[0] == pytest.approx(np.polyval(coefficients, days[-1]))


def test_paths_leave_the_tolerance_where_they_cross_it():
    days = np.array([0.0, 10.0, 20.0])
    path = np.array([[0.0, 1.0, 3.0], [5.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -4.0, 0.0]])
    assert first_exit(path, 2.0, days).tolist() == [15.0, 0.0, np.inf, 5.0]


def coverage(count, seed, *, walk):
    """Share of seeded histories whose true exit lies inside the 95 % interval; the walk is drawn from its prior."""
    generator, hits = np.random.default_rng(seed), 0
    grid = np.arange(0.0, 2500.0, 2.0)
    for _ in range(count):
        days = np.cumsum(generator.uniform(20.0, 40.0, 8))
        u, slope = generator.uniform(0.7, 1.3, 8), generator.uniform(0.08, 0.15)
        chosen = generator.choice(WALKS) if walk and generator.random() < 0.75 else 0.0
        q = (chosen * np.median(u)) ** 2 / np.ptp(days)
        wander = np.append(0.0, np.cumsum(generator.normal(size=7) * np.sqrt(q * np.diff(days))))
        true = slope * days + wander
        tolerance = slope * days[-1] + generator.uniform(8.0, 16.0)
        path = true[-1] + slope * grid
        path[1:] += np.cumsum(generator.normal(size=len(grid) - 1) * np.sqrt(q * 2.0))
        exit_days = first_exit(path[None], tolerance, grid)[0]
        trend = fit_trend(TimeSeries(days, true + generator.normal(size=8) * u, u), walk=walk, level=1e-9)
        found = forecast(trend, 0.0, tolerance, horizon_days=2000.0)
        hits += found.low_days <= min(exit_days, 1e9) <= found.high_days or (
            exit_days > 2000.0 and not np.isfinite(found.high_days)
        )
    return hits / count


@pytest.mark.parametrize("walk", [False, True])
def test_the_truth_lies_inside_the_interval_as_often_as_stated(walk):
    assert 0.93 <= coverage(200, 2026, walk=walk) <= 0.97


def test_few_calibrations_give_changes_but_no_trend(small_machine, small_errors):
    history = year(small_machine, small_errors)[:2]
    drift = drift_report(small_machine, history, DriftSettings({"EC0Y": 5 * URAD}))
    assert all(item.trend is None and item.forecast is None for item in drift.figures)
    assert "a trend needs three calibrations" in drift.notes
    one = drift_report(small_machine, history[:1])
    assert (one.since_last, one.volume_since_last) == ((), None)
    with pytest.raises(InputError, match="must be in chronological order"):
        drift_report(small_machine, history[::-1])
    with pytest.raises(InputError, match="needs at least one calibration"):
        drift_report(small_machine, [])


def test_calibrations_on_other_nodes_are_brought_to_those_of_the_newest(small_machine, small_errors):
    first, second = (measured(small_errors, np.random.default_rng(k), k) for k in range(2))
    nodes = {axis: small_machine.axes[k].nodes_mm[::2] for k, axis in enumerate("XYZ")}
    curves = {name: Curve(nodes[name[2]], c.at(nodes[name[2]]), c.u[::2]) for name, c in second.errors.curves.items()}
    coarse = second.errors.replace(curves=curves)
    data = aligned(small_machine, [first, Calibration(second.at, coarse, covariance_or_independent(coarse, None))])
    assert data.columns("EXX").size == len(nodes["X"])
    assert isinstance(data.field_covariance(0), Covariance)
    assert min(item.p_value for item in changes(data, 1, 0)) > 1e-6
