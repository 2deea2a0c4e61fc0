"""Identification of real data: gross errors, beam breaks, reversal, temperature, air, residuals that are not noise."""

import json
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import chdtri

import machines
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Lengths, format_lengths, read_lengths
from compgen.data.machine import Chain
from compgen.data.names import SQUARENESS_NAMES, error_named
from compgen.data.records import approach_of
from compgen.errors import CompgenError, CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.identification import IdentifyOptions, identify
from compgen.identification.adjust.residual_tests import check_whiteness, chi_square_limit
from compgen.instruments.interferometer import refractive_index
from compgen.kinematics import modelled_errors
from compgen.kinematics.exact_chain import tip_position
from compgen.simulation.trajectory import serpentine

NANOMETRE = 1e-6  # mm
MICROMETRE = 1e-3
SIGMA_MM = 0.2 * MICROMETRE
#: Errors of the curves from noise of SIGMA_MM on this machine (largest of about 80 nodes), with a margin.
NOISE_LINEAR_MM = 0.5 * MICROMETRE
NOISE_ANGULAR = 1.5e-6
STATIONS = np.array([[400.0, -900.0, 50.0], [-700.0, -800.0, 100.0], [900.0, 700.0, -150.0], [-100.0, 1300.0, 600.0]])
DEAD_MM = np.array([310.0, 402.5, 250.25, 501.125])
EXPANSION = 11.5  # um/(m K)


def machine_of(ranges=((-420.0, 130.0), (50.0, 650.0), (-300.0, 0.0)), chain="WFYXZT", nodes=6, expansion=None):
    reference = (0.0, 50.0, -100.0) if ranges[0][1] == 130.0 else tuple(r[0] for r in ranges)
    return machines.machine_of(ranges, nodes, chain, expansion=expansion, reference_point_mm=reference)


MACHINE = machine_of()
CUBE = machine_of(((-300.0, 200.0),) * 3)


def truth_of(machine, squareness_urad=1000.0, seed=1):
    rng = np.random.default_rng(seed)
    curves, squareness = {}, {}
    for name in modelled_errors(machine):
        if name in SQUARENESS_NAMES:
            squareness[name] = (rng.normal(0, squareness_urad * 1e-6), 0.0)
            continue
        error = error_named(name)
        nodes = machine.axes[error.axis].nodes_mm
        value = rng.normal(0, 0.012 if error.kind == "linear" else 15e-6, len(nodes))
        if error.is_straightness:
            value = value - np.interp(nodes, nodes[[0, -1]], value[[0, -1]])
        else:
            value = value - np.interp(machine.reference_point_mm[error.axis], nodes, value)
        curves[name] = Curve(nodes, value, np.zeros(len(nodes)))
    return ErrorTable(curves, squareness)


TRUTH = truth_of(MACHINE)


def stops_of(machine):
    """Forward and back through a serpentine grid: positions, run, approach."""
    there = serpentine([axis.nodes_mm for axis in machine.axes])
    position = np.vstack([there, there[::-1]])
    moves = np.diff(position, axis=0, prepend=[[axis.range_mm[0] - 1.0 for axis in machine.axes]])
    return position, np.repeat([1, 2], len(there)), approach_of(moves)


def measured(machine, truth, *, sigma_mm=SIGMA_MM, reversal=None, growth_mm=0.0, stations=STATIONS, seed=1):
    """Readings of all stations at every stop; ``growth_mm`` is added to the travel, ``reversal`` rows by axis."""
    position, run, approach = stops_of(machine)
    count, rng = len(stations), np.random.default_rng(seed)
    tip = tip_position(machine, truth.at(position), position + growth_mm)
    if reversal is not None:
        tip = tip + 0.5 * approach @ reversal
    reading = np.linalg.norm(tip[:, None] - stations, axis=2) - DEAD_MM[:count]
    reading = reading + sigma_mm * rng.standard_normal(reading.shape)
    _, point = np.unique(position, axis=0, return_inverse=True)
    rows = count * len(position)
    return Lengths(
        stations=tuple(f"LT{k + 1}" for k in range(count)),
        station=np.tile(np.arange(count), len(position)),
        point=[f"P{p:03d}" for p in np.repeat(point.ravel(), count)],
        position_mm=np.repeat(position, count, axis=0),
        length_mm=reading.ravel(),
        approach=np.repeat(approach, count, axis=0),
        labels={"run": np.repeat(run, count)},
        metadata={"u_length_um": f"{sigma_mm * 1e3:g}", "u_length_um_per_m": "0"} if sigma_mm else {},
        origin=[("m.lengths.csv", row + 7) for row in range(rows)],
    )


@pytest.fixture(scope="module")
def clean():
    return measured(MACHINE, TRUTH)


def disturbed(lengths, change):
    reading = lengths.length_mm.copy()
    change(reading)
    return replace(lengths, length_mm=reading)


def worst(found, truth=TRUTH):
    """Largest deviation of linear curves in mm and of rotations in rad."""
    linear, angular = 0.0, 0.0
    for name, curve in found.errors.curves.items():
        size = np.abs(curve.value - truth.curves[name].at(curve.position_mm)).max()
        linear, angular = (max(linear, size), angular) if name[1] in "XYZ" else (linear, max(angular, size))
    for name, (value, _) in found.errors.squareness.items():
        angular = max(angular, abs(value - truth.squareness[name][0]))
    return linear, angular


def assert_as_good_as_undisturbed(found, truth=TRUTH):
    linear, angular = worst(found, truth)
    assert linear < NOISE_LINEAR_MM
    assert angular < NOISE_ANGULAR
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.12)


def row_of(lengths, station, point, run=1):
    at = (lengths.station == station) & (lengths.labels["run"] == run) & (np.array(lengths.point) == point)
    return int(np.flatnonzero(at)[0])


# --- gross errors ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("probability", [1e-6, 0.001, 0.05, 0.3])
def test_the_limit_of_chi_square_is_that_of_scipy(probability):
    for freedom in (1, 2, 3, 5, 30, 1000, 10_495, 10**7):
        assert chi_square_limit(freedom, probability) == pytest.approx(chdtri(freedom, probability), rel=2e-11)


@pytest.mark.parametrize("share", [0.01, 0.05, 0.1])
def test_gross_errors_of_millimetres_are_all_found_and_no_other(clean, share):
    rng = np.random.default_rng(4)
    rows = rng.choice(len(clean), int(share * len(clean)), replace=False)
    size = rng.choice([-1, 1], len(rows)) * rng.uniform(0.01, 2.0, len(rows))
    found = identify(MACHINE, disturbed(clean, lambda reading: np.add.at(reading, rows, size)))
    assert {item.row for item in found.rejected} == set(rows.tolist())
    assert_as_good_as_undisturbed(found)
    for item in found.rejected:
        assert item.line == item.row + 7
        assert item.residual_um == pytest.approx(1e3 * size[rows == item.row][0], abs=3.0)


def test_errors_of_metres_do_not_move_the_start(clean):
    rng = np.random.default_rng(5)
    rows = rng.choice(len(clean), 120, replace=False)
    found = identify(MACHINE, disturbed(clean, lambda r: np.add.at(r, rows, rng.uniform(500, 3000, len(rows)))))
    assert {item.row for item in found.rejected} == set(rows.tolist())
    assert_as_good_as_undisturbed(found)


@pytest.mark.parametrize(
    ("first", "last", "offset_mm"),
    [(100, 180, 1.253), (150, 432, 1.253), (216, 432, -0.8), (60, 276, 300.0), (120, 200, 0.05), (300, 432, -45.0)],
)
def test_a_long_beam_break_is_one_segment_with_a_dead_length_of_its_own(clean, first, last, offset_mm):
    own = np.flatnonzero(clean.station == 1)
    found = identify(MACHINE, disturbed(clean, lambda r: np.add.at(r, own[first:last], offset_mm)))
    assert_as_good_as_undisturbed(found)
    assert not found.rejected
    (segment,) = found.segments
    inside = last - first <= 216
    low, high, sign = (first, last, 1.0) if inside else (0, first, -1.0)  # the shorter part is the displaced one
    if last - first == 216:  # two halves: either may be reported as displaced
        low, high, sign = (first, last, 1.0) if set(segment.rows) == set(own[first:last]) else (0, 0, -1.0)
    if high:
        assert segment.rows == tuple(own[low:high].tolist())
        assert (segment.line, segment.last_line) == (own[low] + 7, own[high - 1] + 7)
    assert segment.kept
    assert segment.station == "LT2"
    assert segment.offset_mm == pytest.approx(sign * offset_mm, abs=0.3 * MICROMETRE)
    assert len(found.stations) == 5
    assert [s.segment for s in found.stations if s.station == "LT2"] == [0, 1]


def test_the_report_of_a_segment_is_a_sentence(clean):
    own = np.flatnonzero(clean.station == 1)
    found = identify(MACHINE, disturbed(clean, lambda r: np.add.at(r, own[100:180], 1.253)))
    lines = f"line {own[100] + 7} to {own[179] + 7}"
    assert found.segments[0].text == (
        f"station LT2: +1.253 mm from {lines}: beam break, dead length changed; 80 readings kept with a separate dead "
        "length"
    )
    assert json.loads(json.dumps(found.summary()["segments"]))[0]["text"] == found.segments[0].text


@pytest.mark.parametrize("count", [3, 10])
def test_a_short_beam_break_is_one_segment_and_rejected(clean, count):
    own = np.flatnonzero(clean.station == 2)[300 : 300 + count]
    found = identify(MACHINE, disturbed(clean, lambda r: np.add.at(r, own, -0.4)))
    (segment,) = found.segments
    assert not segment.kept
    assert segment.rows == tuple(own.tolist())
    assert segment.offset_mm == pytest.approx(-0.4, abs=MICROMETRE)
    assert {item.row for item in found.rejected} == set(own.tolist())
    assert all(f"one of {count} readings off by -0.400 mm" in item.reason for item in found.rejected)
    assert_as_good_as_undisturbed(found)


def test_two_exchanged_points_are_named(clean):
    def exchange(reading):
        for station in range(4):
            a, b = row_of(clean, station, "P010"), row_of(clean, station, "P057")
            reading[a], reading[b] = reading[b], reading[a]

    found = identify(MACHINE, disturbed(clean, exchange))
    reasons = {(item.station, item.point): item.reason for item in found.rejected}
    assert set(reasons) == {(f"LT{k + 1}", p) for k in range(4) for p in ("P010", "P057")}
    assert all("the two points are exchanged" in reason for reason in reasons.values())
    assert "fits point P057" in reasons["LT1", "P010"]
    assert_as_good_as_undisturbed(found)


def test_a_point_measured_twice_is_named(clean):
    def repeat(reading):
        for station in range(4):
            reading[row_of(clean, station, "P030")] = reading[row_of(clean, station, "P099")]

    found = identify(MACHINE, disturbed(clean, repeat))
    assert len(found.rejected) == 4
    assert all("fits point P099" in item.reason and "duplicated" in item.reason for item in found.rejected)


def test_wrong_station_labels_are_named(clean):
    rows = np.random.default_rng(3).choice(len(clean), 20, replace=False)
    station = clean.station.copy()
    station[rows] = (station[rows] + 1) % 4
    found = identify(MACHINE, replace(clean, station=station))
    assert {item.row for item in found.rejected} == set(rows.tolist())
    for item in found.rejected:
        assert f"fits station 'LT{clean.station[item.row] + 1}'" in item.reason
    assert_as_good_as_undisturbed(found)


@pytest.mark.parametrize(
    ("factor", "stations", "what"),
    [
        (1e-3, [2], "metres"),
        (1e-3, [0, 1, 2, 3], "metres"),
        (1e3, [0, 1, 2, 3], "micrometres"),
        (1 / 25.4, [1], "inches"),
        (-1.0, [0, 1, 2, 3], "opposite sign"),
    ],
)
def test_a_slip_of_unit_or_sign_is_named(clean, factor, stations, what):
    wrong = disturbed(clean, lambda r: np.multiply.at(r, np.isin(clean.station, stations), factor))
    with pytest.raises(InputError, match=rf"length_mm.*station 'LT[{''.join(str(k + 1) for k in stations)}]'.*{what}"):
        identify(MACHINE, wrong)


def test_a_station_of_nonsense_is_named(clean):
    rng = np.random.default_rng(1)
    own = clean.station == 3
    wrong = disturbed(clean, lambda r: r.__setitem__(own, rng.uniform(200, 900, own.sum())))
    with pytest.raises(ConvergenceError, match="station 'LT4' fit no position"):
        identify(MACHINE, wrong)


def test_too_many_misfits_end_in_an_error_that_names_the_station(clean):
    rng = np.random.default_rng(2)
    rows = rng.choice(np.flatnonzero(clean.station == 2), 240, replace=False)  # 56 % of one station
    with pytest.raises(ConvergenceError, match=r"most suspicious station is 'LT3' \(LT1 \d+ %.*check station 'LT3'"):
        identify(MACHINE, disturbed(clean, lambda r: np.add.at(r, rows, rng.normal(0, 1, len(rows)))))
    rows = rng.choice(len(clean), int(0.4 * len(clean)), replace=False)
    with pytest.raises(ConvergenceError, match=r"\d+ of 1728 readings do not fit.*most stations are affected"):
        identify(MACHINE, disturbed(clean, lambda r: np.add.at(r, rows, rng.normal(0, 1, len(rows)))))


def test_exchanged_labels_of_many_readings_end_in_an_error(clean):
    station = clean.station.copy()
    exchanged = np.array([int(point[1:]) < 90 for point in clean.point])
    station[exchanged] = np.array([1, 0, 3, 2])[station[exchanged]]
    with pytest.raises(ConvergenceError, match="fit no position.*station labels|most suspicious station"):
        identify(MACHINE, replace(clean, station=station))


def test_readings_of_another_station_under_the_same_name_are_rejected_with_a_warning(clean):
    station = clean.station.copy()
    station[(clean.station == 1) & (clean.labels["run"] == 2)] = 0
    with pytest.warns(CompgenWarning, match="most suspicious station is 'LT1'"):
        found = identify(MACHINE, replace(clean, station=station))
    assert len(found.rejected) == 216
    assert all("fits station 'LT2'" in item.reason for item in found.rejected)


def test_everything_at_once(clean):
    rng = np.random.default_rng(8)
    rows = rng.choice(len(clean), 90, replace=False)
    own = np.flatnonzero(clean.station == 1)

    def disturb(reading):
        reading[own[150:300]] += 2.5
        reading[rows] += rng.normal(0, 1, len(rows))
        reading[rows[:10]] += 700.0

    found = identify(MACHINE, disturbed(clean, disturb))
    large = {item.row for item in found.rejected}
    assert large <= set(rows.tolist())
    assert len(large) >= 88  # an offset below 1 um is not a gross error
    assert sum(s.kept for s in found.segments) == 1
    assert_as_good_as_undisturbed(found)


def test_without_gross_errors_nothing_is_rejected_or_split():
    for seed in range(6):
        found = identify(MACHINE, measured(MACHINE, TRUTH, seed=seed))
        assert not found.rejected
        assert not found.segments


# --- hard cases: an error or a warning, never a silent wrong answer -------------------------------------------------


CUBE_TRUTH = truth_of(CUBE, squareness_urad=30.0)


@pytest.mark.parametrize("chain", ["WFXYZT", "WFXZYT", "WFYZXT", "WZFXYT", "WXYZFT"])
def test_a_wrong_chain_is_warned_of(chain):
    with pytest.warns(CompgenWarning, match="the model does not describe the readings.*chain"):
        found = identify(replace(CUBE, chain=Chain(chain)), measured(CUBE, CUBE_TRUTH))
    assert found.reduced_chi_square > 25.0


@pytest.mark.parametrize("order", [[1, 0, 2], [2, 1, 0]])
def test_exchanged_columns_within_the_travel_are_warned_of(order):
    lengths = measured(CUBE, CUBE_TRUTH)
    wrong = replace(lengths, position_mm=lengths.position_mm[:, order], approach=None, labels={})
    with pytest.warns(CompgenWarning, match="order and the signs of the axes"):
        identify(CUBE, wrong)


def test_positions_of_another_scale_fit_no_place():
    lengths = measured(CUBE, CUBE_TRUTH)
    with pytest.raises(ConvergenceError, match="4 of 4 stations.*fit no position.*check axis order"):
        identify(CUBE, replace(lengths, position_mm=0.5 * lengths.position_mm))


@pytest.mark.parametrize(
    "stations",
    [
        [[500.0, -600.0 + 400.0 * k, 100.0 + 50.0 * k] for k in range(4)],
        [[500.0, -600.0 + 400.0 * k, 100.0] for k in range(3)],
        [[500.0, -600.0, -300.0], [-600.0, -500.0, -300.0], [600.0, 400.0, -300.0], [-500.0, 600.0, -300.0]],
        [STATIONS[0], STATIONS[1], STATIONS[1]],
    ],
)
def test_stations_on_a_line_or_in_a_plane_with_an_end_of_the_travel_are_refused(stations):
    with pytest.raises((UndeterminedError, ConvergenceError), match="distinguished"):
        identify(CUBE, measured(CUBE, CUBE_TRUTH, stations=np.array(stations)))


def test_stations_almost_in_a_plane_with_an_end_of_the_travel_are_warned_of():
    height = -301.0
    stations = np.array(
        [[500.0, -600.0, height], [-600.0, -500.0, height], [600.0, 400.0, height], [-500.0, 600.0, height]]
    )
    with pytest.warns(CompgenWarning, match="EZZ is weakly determined.*different heights"):
        found = identify(CUBE, measured(CUBE, CUBE_TRUTH, stations=stations))
    curve = found.errors.curves["EZZ"]
    deviation = np.abs(curve.value - CUBE_TRUTH.curves["EZZ"].value)
    assert np.all(deviation <= 3.0 * curve.u + NANOMETRE)


def test_coplanar_stations_and_trajectory_are_refused():
    stations = np.array([[500.0, -600.0, 0.0], [-600.0, -500.0, 0.0], [600.0, 400.0, 0.0], [-500.0, 600.0, 0.0]])
    lengths = measured(CUBE, CUBE_TRUTH, stations=stations)
    in_plane = np.flatnonzero(np.isclose(lengths.position_mm[:, 2], 0.0) & (lengths.labels["run"] == 1))
    with pytest.raises(UndeterminedError, match="no data at all for: E"):
        identify(CUBE, lengths.part(in_plane))


@pytest.mark.parametrize("seed", range(4))
def test_gross_errors_in_hard_cases_never_end_in_a_silent_wrong_answer(seed):
    """Random disturbances: results accepted without a warning are correct within the noise; others raise an error."""
    rng = np.random.default_rng(100 + seed)
    lengths = measured(MACHINE, TRUTH, seed=seed)
    own = np.flatnonzero(lengths.station == rng.integers(4))
    rows = rng.choice(len(lengths), int(rng.uniform(0.0, 0.3) * len(lengths)), replace=False)
    shift = int(rng.integers(1, 4))

    def disturb(reading):
        reading[rows] += rng.normal(0, 10.0 ** rng.uniform(-2, 3), len(rows))
        if seed % 2:
            reading[own] = np.roll(reading[own], shift)  # every reading is shifted by one or a few points

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CompgenWarning)
        try:
            found = identify(MACHINE, disturbed(lengths, disturb))
        except CompgenError as error:
            assert "LT" in str(error)
            return
    if not caught:
        assert_as_good_as_undisturbed(found)


# --- reversal -------------------------------------------------------------------------------------------------------


REVERSAL_MM = np.array([[10.0, -3.0, 2.0], [1.0, 8.0, 0.0], [0.0, -2.0, 5.0]]) * MICROMETRE


@pytest.fixture(scope="module")
def backlash():
    return measured(MACHINE, TRUTH, reversal=REVERSAL_MM)


def assert_reversal(found, reversal_mm=REVERSAL_MM):
    assert found.reversal.removed
    for k, name in enumerate("XYZ"):
        axis = found.reversal.axes[name]
        assert np.all(np.array(axis.u_mm) < 0.1 * MICROMETRE)
        assert np.all(np.abs(np.array(axis.vector_mm) - reversal_mm[k]) < 4.0 * np.array(axis.u_mm))


def test_reversal_is_reported_and_the_curves_are_the_two_way_means(backlash):
    found = identify(MACHINE, backlash)
    assert_reversal(found)
    assert_as_good_as_undisturbed(found)
    text = json.loads(json.dumps(found.summary()["reversal"]))
    assert text["axes"]["X"]["vector_um"][0] == pytest.approx(10.0, abs=0.2)
    assert set(text["axes"]["X"]["stations_um"]) == {"LT1", "LT2", "LT3", "LT4"}


def test_the_mean_difference_of_a_station_is_that_of_its_readings(backlash):
    """Against a plain mean of the differences of pairs, when only one axis changes its direction."""
    found = identify(MACHINE, backlash)
    value, u = found.reversal.axes["X"].stations["LT1"]
    position, _, approach = stops_of(MACHINE)
    sight = position - STATIONS[0]
    sight = sight / np.linalg.norm(sight, axis=1)[:, None]
    per_stop = sight @ REVERSAL_MM.T  # effect of each axis' reversal on the reading, (n, 3)
    centred = 0.5 * approach * np.ones((len(position), 1))
    expected = np.linalg.lstsq(centred, np.sum(centred * per_stop, axis=1), rcond=None)[0][0]
    assert value == pytest.approx(expected, abs=5.0 * u + 0.05 * MICROMETRE)


def test_the_two_way_mean_does_not_need_both_directions_everywhere(backlash):
    rows = np.sort(np.random.default_rng(0).choice(len(backlash), int(0.6 * len(backlash)), replace=False))
    found = identify(MACHINE, backlash.part(rows))
    assert_reversal(found)
    assert worst(found)[0] < 1.5 * NOISE_LINEAR_MM


def test_directions_follow_from_the_runs_where_no_column_says_them(backlash):
    found = identify(MACHINE, replace(backlash, approach=None))
    assert_reversal(found)
    assert_as_good_as_undisturbed(found)


def test_reversal_beside_a_beam_break(backlash):
    own = np.flatnonzero(backlash.station == 1)
    found = identify(MACHINE, disturbed(backlash, lambda r: np.add.at(r, own[100:250], 1.253)))
    assert_reversal(found)
    assert [round(s.offset_mm, 3) for s in found.segments] == [1.253]
    assert_as_good_as_undisturbed(found)


def test_no_reversal_is_found_where_there_is_none(clean):
    found = identify(MACHINE, clean)
    assert not found.reversal.removed
    for axis in found.reversal.axes.values():
        assert np.all(np.abs(axis.vector_mm) < 4.0 * np.array(axis.u_mm))


def test_one_direction_only_says_nothing_of_reversal(clean):
    rows = np.flatnonzero(clean.labels["run"] == 1)
    assert identify(MACHINE, clean.part(rows)).reversal is None


# --- temperature, air, uncertainty by reading -------------------------------------------------------------------------


def temperatures(count):
    time = np.arange(count) / count
    return np.column_stack([22.0 + 2.0 * np.sin(6.0 * time), 21.0 + 3.0 * time, np.full(count, 19.5)])


def warm(sigma_mm):
    position, _, _ = stops_of(MACHINE)
    celsius = temperatures(len(position))
    growth = 1e-6 * EXPANSION * (celsius - 20.0) * (position - np.array(MACHINE.reference_point_mm))
    lengths = measured(MACHINE, TRUTH, growth_mm=growth, sigma_mm=sigma_mm)
    columns = {f"temp_{axis}_c": np.repeat(celsius[:, k], 4) for k, axis in enumerate("xyz")}
    return replace(lengths, covariates=columns)


def test_the_errors_hold_at_20_degrees():
    machine = machine_of(expansion=EXPANSION)
    found = identify(machine, warm(0.0))
    linear, angular = worst(found)
    assert linear < NANOMETRE
    assert angular < 1e-9
    assert found.summary()["corrections"]["temperature"]["Y"]["highest_c"] == pytest.approx(24.0, abs=0.01)
    assert_as_good_as_undisturbed(identify(machine, warm(SIGMA_MM)))


def test_the_temperature_can_be_left_alone():
    with pytest.warns(CompgenWarning, match="does not describe the readings"):
        found = identify(machine_of(expansion=EXPANSION), warm(SIGMA_MM), IdentifyOptions(temperature=False))
    assert worst(found)[0] > 5.0 * MICROMETRE
    assert not found.corrections


def test_a_constant_temperature_scales_the_positioning():
    """By hand: 5 K more than 20 degC are 57.5 um/m."""
    lengths = replace(measured(MACHINE, TRUTH, sigma_mm=0.0), metadata={})
    lengths = replace(lengths, covariates={"temp_x_c": np.full(len(lengths), 25.0)})
    plain = identify(MACHINE, lengths)
    found = identify(machine_of(expansion=EXPANSION), lengths)
    nodes = plain.errors.curves["EXX"].position_mm
    difference = found.errors.curves["EXX"].value - plain.errors.curves["EXX"].value
    assert np.allclose(difference, -57.5e-6 * (nodes - 0.0), rtol=0, atol=0.01 * MICROMETRE)


def test_temperatures_without_expansion_are_warned_of():
    with pytest.warns(CompgenWarning) as caught:
        identify(MACHINE, warm(SIGMA_MM))
    texts = [str(item.message) for item in caught]
    assert any("temperature of X varies by" in text and "expansion_um_per_m_k" in text for text in texts)
    assert not any("temperature of Z" in text for text in texts)


def test_a_temperature_that_some_readings_lack_is_an_error():
    lengths = warm(SIGMA_MM)
    lengths.covariates["temp_y_c"][5] = np.nan
    with pytest.raises(InputError, match=r"m.lengths.csv:12: column temp_y_c: is known for only some"):
        identify(machine_of(expansion=EXPANSION), lengths)


def test_the_refractive_index_agrees_with_that_of_ciddor():
    """Against Ciddor (1996), table 1, with a different equation: 633 nm, dry air, 450 ppm CO2, (n - 1) 1e8."""
    table = {(20.0, 800.0): 21458.0, (20.0, 1000.0): 26824.4, (20.0, 1200.0): 32191.6, (10.0, 1000.0): 27774.7}
    for (celsius, pressure_hpa), expected in table.items():
        index = float(refractive_index(np.array(celsius), pressure_hpa, 0.0, 633.0))
        assert (index - 1.0) * 1e8 == pytest.approx(expected, abs=0.5)  # 5 nm in a metre


def test_readings_are_brought_to_the_wavelength_in_the_air_that_was_there():
    lengths = measured(MACHINE, TRUTH, sigma_mm=0.0)
    count = len(lengths) // 4
    celsius = np.repeat(22.0 + 1.5 * np.sin(np.arange(count) / 100.0), 4)
    index, at_reset, assumed = refractive_index(celsius, 980.0, 40.0), 1.00027, 1.000271
    dead = DEAD_MM[lengths.station]
    raw = (index * (lengths.length_mm + dead) - at_reset * dead) / assumed  # fringes counted since the reset
    metadata = {"pressure_hpa": "980", "humidity_percent": "40", "refractive_index_used": str(assumed)}
    uncompensated = replace(
        lengths,
        length_mm=raw,
        covariates={"temp_ambient_c": celsius},
        metadata={**metadata, "wavelength_compensated": "false"},
    )
    linear, angular = worst(identify(MACHINE, uncompensated))
    assert linear < NANOMETRE
    assert angular < 1e-9
    untouched = replace(uncompensated, length_mm=lengths.length_mm, metadata=metadata)
    assert worst(identify(MACHINE, untouched))[0] < NANOMETRE


def test_air_that_is_not_described_is_an_error(clean):
    with pytest.raises(InputError, match="temp_ambient_c: is missing"):
        identify(MACHINE, replace(clean, metadata={**clean.metadata, "wavelength_compensated": "false"}))


def test_a_column_of_uncertainties_weights_the_readings():
    sigma = np.where(np.arange(4 * 432) % 8 < 4, 0.1, 2.0) * MICROMETRE
    lengths = measured(MACHINE, TRUTH, sigma_mm=0.0)
    noisy = lengths.length_mm + sigma * np.random.default_rng(6).standard_normal(len(lengths))
    lengths = replace(lengths, length_mm=noisy, covariates={"u_length_um": sigma * 1e3})
    found = identify(MACHINE, lengths)
    assert found.u_source == "stated"
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.12)
    assert not found.rejected
    flat = identify(MACHINE, replace(lengths, covariates={}, metadata={}))
    assert worst(found)[0] < 0.5 * worst(flat)[0]


def test_a_column_of_uncertainties_is_read_from_a_file(tmp_path, clean):
    path = tmp_path / "m.lengths.csv"
    columns = {"u_length_um": np.linspace(0.1, 0.3, len(clean))}
    path.write_text(format_lengths(replace(clean, covariates=columns)))
    assert np.allclose(read_lengths(path).covariates["u_length_um"], columns["u_length_um"], rtol=0, atol=1e-3)


def test_an_uncertainty_of_zero_is_an_error(clean):
    column = np.full(len(clean), 0.2)
    column[3] = 0.0
    with pytest.raises(InputError, match=r"m.lengths.csv:10: column u_length_um: 0 is not a standard uncertainty"):
        identify(MACHINE, replace(clean, covariates={"u_length_um": column}))


# --- whiteness --------------------------------------------------------------------------------------------------------


def whiteness_of(lengths, standardised):
    distance = np.linalg.norm(lengths.position_mm - STATIONS[lengths.station], axis=1)
    return check_whiteness(lengths, lengths.station, standardised, distance, 80)


def test_false_alarms_on_white_residuals_stay_below_one_percent(clean):
    rng = np.random.default_rng(11)
    alarms = sum(not whiteness_of(clean, rng.standard_normal(len(clean))).white for _ in range(1000))
    assert alarms <= 10


def test_residuals_of_a_right_model_are_white():
    for seed in range(20):
        assert identify(MACHINE, measured(MACHINE, TRUTH, seed=200 + seed)).whiteness.white


def test_alarm_for_a_process_with_memory(clean):
    rng = np.random.default_rng(12)
    noise = rng.standard_normal(len(clean))
    for k in range(4, len(noise)):  # each station's series with correlation 0.5
        noise[k] = 0.5 * noise[k - 4] + np.sqrt(0.75) * noise[k]
    found = whiteness_of(clean, noise)
    assert all(item.lag_1 == pytest.approx(0.5, abs=0.12) for item in found.stations.values())
    assert all(item.durbin_watson == pytest.approx(1.0, abs=0.25) for item in found.stations.values())
    assert all(any(f"station LT{k}" in text for text in found.messages) for k in range(1, 5))


def test_alarm_for_an_error_that_the_nodes_cannot_follow():
    """A sine of 120 mm along X on nodes 110 mm apart, seen at four positions between them."""
    fine = machine_of(nodes=21)
    lengths = measured(fine, truth_of(MACHINE), stations=STATIONS)
    lengths = lengths.part(np.flatnonzero((np.arange(len(lengths)) // 4) % 5 == 0))
    sight = lengths.position_mm - STATIONS[lengths.station]
    unit_x = sight[:, 0] / np.linalg.norm(sight, axis=1)
    wave = 1.0 * MICROMETRE * np.sin(2 * np.pi * lengths.position_mm[:, 0] / 120.0)
    disturbed = replace(lengths, length_mm=lengths.length_mm + unit_x * wave, approach=None, labels={})
    found = identify(MACHINE, disturbed)
    with pytest.warns(CompgenWarning, match="not white"):
        messages = found.whiteness.messages
    assert any("position of X" in text for text in messages)


def test_alarm_for_one_station_that_is_noisier(clean):
    rng = np.random.default_rng(13)
    found = whiteness_of(clean, rng.standard_normal(len(clean)) * np.where(clean.station == 2, 3.0, 1.0))
    assert any("station LT3" in text and "variance" in text for text in found.messages)


def test_alarm_for_noise_that_grows_with_distance(clean):
    rng = np.random.default_rng(14)
    distance = np.linalg.norm(clean.position_mm - STATIONS[clean.station], axis=1)
    found = whiteness_of(clean, rng.standard_normal(len(clean)) * (distance / distance.mean()) ** 3)
    assert any("far half" in text for text in found.messages)


def test_noise_free_residuals_raise_no_alarm():
    assert identify(MACHINE, measured(MACHINE, TRUTH, sigma_mm=0.0)).whiteness.white
