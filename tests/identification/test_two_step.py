"""Self-calibration, placement, separation: the paper's route, measured positions as input, and known stations."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import compgen
import machines
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.deviations import Deviations, format_deviations, read_deviations
from compgen.data.lengths import Lengths, format_lengths
from compgen.data.names import error_named
from compgen.data.records import detect_format
from compgen.errors import CompgenWarning, InputError, UndeterminedError
from compgen.identification import (
    IdentifyOptions,
    KnownStations,
    identify,
    joint_covariance,
    locate_stations,
    read_stations,
)
from compgen.identification.adjust.problem import SeparationProblem
from compgen.identification.adjust.solver import step_levers
from compgen.identification.adjust.unknowns import State, error_parameters
from compgen.identification.positions import identify_deviations
from compgen.identification.two_step import Frame, Sightings, place, placed_covariance, self_calibrate
from compgen.kinematics import c_matrix, exact_error, modelled_errors

NANOMETRE = 1e-6  # mm
NANORADIAN = 1e-9
MICROMETRE = 1e-3
SIGMA_MM = 0.2 * MICROMETRE
STATIONS = np.array([[620.0, -750.0, 50.0], [-700.0, -600.0, 120.0], [500.0, 900.0, -380.0], [-500.0, 800.0, 500.0]])
DEAD_MM = np.array([310.0, 402.5, 250.25, 501.125])
EC0Y_OF_THE_PAPER = 2903e-6
TWO_STEP = IdentifyOptions(method="two-step")


def machine_of(chain="WFYXZT", counts=(5, 4, 4), **fields):
    ranges = ((-420.0, 130.0), (50.0, 650.0), (-300.0, 0.0))
    return machines.machine_of(ranges, counts, chain, reference_point_mm=(130.0, 50.0, 0.0), **fields)


GANTRY = machine_of(tool_offset_mm=(0.0, 0.0, -120.0))
TABLE = machine_of("WXYFZT", squareness_reference="Y", tool_offset_mm=(20.0, -30.0, -150.0))


def grid_of(machine):
    return np.stack(np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij"), -1).reshape(-1, 3)


def measured(machine, truth, *, sigma_mm=0.0, seed=2, stations=STATIONS, runs=1, seen=None):
    """Lengths by the exact model; ``seen`` (points, stations): which station reads which point."""
    rng = np.random.default_rng(seed)
    position = grid_of(machine)
    tip = position + np.array(machine.tool_offset_mm) + exact_error(machine, truth, position)
    seen = np.ones((len(position), len(stations)), dtype=bool) if seen is None else seen
    point, station = (np.tile(index, runs) for index in np.nonzero(seen))
    dead = np.resize(DEAD_MM, len(stations))
    length = np.linalg.norm(tip[point] - stations[station], axis=1) - dead[station]
    return Lengths(
        stations=tuple(f"LT{k + 1}" for k in range(len(stations))),
        station=station,
        point=[str(k) for k in point],
        position_mm=position[point],
        length_mm=length + sigma_mm * rng.standard_normal(len(length)),
        labels={"run": np.repeat(np.arange(runs), np.count_nonzero(seen))},
        metadata={"u_length_um": str(sigma_mm / MICROMETRE)} if sigma_mm else {},
    )


def all_values(errors):
    """Values and uncertainties of all curves and squareness errors one after another, and which are translations."""
    values, u, linear = [], [], []
    for name in errors.names:
        curve = errors.curves.get(name)
        value, uncertainty = (curve.value, curve.u) if curve else ([errors.squareness[name][k]] for k in (0, 1))
        values += list(value)
        u += list(uncertainty)
        linear += [error_named(name).kind == "linear"] * len(value)
    return np.array(values), np.array(u), np.array(linear)


def assert_errors_equal(found, truth, *, linear=NANOMETRE, angular=NANORADIAN):
    value, _, is_linear = all_values(found)
    expected, _, _ = all_values(truth)
    assert np.abs(value - expected)[is_linear].max() < linear
    assert np.abs(value - expected)[~is_linear].max() < angular


def leaning(machine, make_errors, seed=5):
    return make_errors(machine, seed=seed, squareness_rad=(EC0Y_OF_THE_PAPER, -61e-6, 23e-6))


# --- self-calibration ------------------------------------------------------------------------------------------------


def sightings_of(points, stations, sigma_mm=0.0, seed=3):
    rng = np.random.default_rng(seed)
    count = len(stations)
    point, station = np.repeat(np.arange(len(points)), count), np.tile(np.arange(count), len(points))
    length = np.linalg.norm(points[point] - stations[station], axis=1) - np.resize(DEAD_MM, count)[station]
    length = length + sigma_mm * rng.standard_normal(len(point))
    return Sightings(point, station, station, length, np.full(len(point), sigma_mm or SIGMA_MM))


def rough(points, stations, away_mm=5.0):
    rng = np.random.default_rng(9)
    return Frame(
        stations + rng.normal(0, away_mm, stations.shape),
        np.resize(DEAD_MM, len(stations)) + rng.normal(0, away_mm, len(stations)),
        points + rng.normal(0, away_mm, points.shape),
    )


def test_self_calibration_finds_the_tracers_in_the_frame_of_the_paper():
    points = grid_of(GANTRY)
    found = self_calibrate(sightings_of(points, STATIONS), rough(points, STATIONS)).frame
    lt1, lt2, lt3, _ = found.stations_mm
    assert np.array_equal(lt1, [0.0, 0.0, 0.0])
    assert np.array_equal(lt2[1:], [0.0, 0.0])
    assert lt2[0] > 0
    assert lt3[2] == 0.0
    assert lt3[1] > 0
    distances = np.linalg.norm(STATIONS[:, None] - STATIONS, axis=2)
    assert np.allclose(
        np.linalg.norm(found.stations_mm[:, None] - found.stations_mm, axis=2), distances, rtol=0, atol=NANOMETRE
    )
    assert np.allclose(found.dead_length_mm, DEAD_MM, rtol=0, atol=NANOMETRE)
    away = np.linalg.norm(found.points_mm[:, None] - found.stations_mm, axis=2)
    assert np.allclose(away, np.linalg.norm(points[:, None] - STATIONS, axis=2), rtol=0, atol=NANOMETRE)
    handed = np.linalg.det(STATIONS[1:] - STATIONS[0])
    assert np.sign(np.linalg.det(found.stations_mm[1:] - found.stations_mm[0])) == np.sign(handed)


def test_self_calibration_meets_the_optimum_of_an_independent_solver():
    points = np.random.default_rng(4).uniform(-400, 400, (25, 3))
    data = sightings_of(points, STATIONS, SIGMA_MM)
    found = self_calibrate(data, rough(points, STATIONS, 0.5))
    held = np.array([0, 1, 2, 4, 5, 8])
    free = np.setdiff1d(np.arange(12), held)

    def residual(x):
        stations = np.zeros(12)
        stations[free] = x[:6]
        away = np.linalg.norm(x[10:].reshape(-1, 3)[data.point] - stations.reshape(4, 3)[data.station], axis=1)
        return (away - x[6:10][data.station] - data.length_mm) / SIGMA_MM

    frame = found.frame
    start = np.concatenate([frame.stations_mm.ravel()[free], frame.dead_length_mm, frame.points_mm.ravel()])
    other = least_squares(residual, start + 1e-3, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.chi_square == pytest.approx(2 * other.cost, rel=1e-7)
    covariance = np.linalg.inv(other.jac.T @ other.jac)
    u = np.sqrt(np.diag(covariance))
    assert np.abs((start - other.x) / u).max() < 1e-3
    assert found.degrees_of_freedom == len(data.point) - len(start)
    assert np.allclose(np.sqrt(np.diag(found.station_covariance())), u[:10], rtol=1e-4)
    by_point = np.sqrt(np.diagonal(found.covariance(), axis1=1, axis2=2))
    assert np.allclose(by_point.ravel(), u[10:], rtol=1e-4)


def test_the_mirrored_calibration_is_the_one_that_a_mirrored_start_finds():
    points = np.random.default_rng(4).uniform(-400, 400, (25, 3))
    data, start = sightings_of(points, STATIONS, SIGMA_MM), rough(points, STATIONS, 0.5)
    flip = np.array([1.0, 1.0, -1.0])
    found = self_calibrate(data, start).mirrored()
    other = self_calibrate(data, Frame(start.stations_mm * flip, start.dead_length_mm, start.points_mm * flip))
    assert found.chi_square == pytest.approx(other.chi_square, rel=1e-12)
    assert np.allclose(found.frame.points_mm, other.frame.points_mm, rtol=0, atol=NANOMETRE)
    assert np.allclose(found.lever, other.lever, rtol=1e-6, atol=1e-9)
    assert np.allclose(found.covariance(), other.covariance(), rtol=1e-6, atol=1e-15)
    nominal = points + 0.001
    assert place(other.frame.points_mm, nominal).mirrored
    assert not place(other.mirrored().frame.points_mm, nominal).mirrored


def test_stations_in_a_plane_cannot_locate_themselves():
    flat = STATIONS * [1.0, 1.0, 0.0] + [0.0, 0.0, -600.0]
    points = grid_of(GANTRY)
    with pytest.raises(UndeterminedError, match=r"plane.*joint"):
        self_calibrate(sightings_of(points, flat), Frame(flat, DEAD_MM, points))


def test_too_few_points_are_counted():
    points = grid_of(GANTRY)[::9][:9]
    with pytest.raises(UndeterminedError, match="36 readings for 27 coordinates of points and 10 unknowns"):
        self_calibrate(sightings_of(points, STATIONS), Frame(STATIONS, DEAD_MM, points))


def test_three_stations_on_a_line_leave_the_plane_to_a_later_one():
    in_line = np.vstack([STATIONS[0], STATIONS[0] + [400.0, 0, 0], STATIONS[0] + [900.0, 0, 0], STATIONS[1:]])
    points = grid_of(GANTRY)
    found = self_calibrate(sightings_of(points, in_line), rough(points, in_line)).frame
    assert found.stations_mm[3][2] == 0.0
    away = np.linalg.norm(found.points_mm[:, None] - found.stations_mm, axis=2)
    assert np.allclose(away, np.linalg.norm(points[:, None] - in_line, axis=2), rtol=0, atol=NANOMETRE)


# --- placement -------------------------------------------------------------------------------------------------------


def test_the_placement_is_that_of_an_independent_routine():
    rng = np.random.default_rng(5)
    target = rng.uniform(-500, 500, (40, 3))
    weight = rng.uniform(0.2, 3.0, 40)
    turn = Rotation.from_rotvec([0.7, -1.9, 0.4]).as_matrix()
    points = (target + rng.normal(0, 0.05, target.shape) - [12.0, -900.0, 33.0]) @ turn
    found = place(points, target, weight)
    centred = [array - weight @ array / weight.sum() for array in (target, points)]
    expected, _ = Rotation.align_vectors(*centred, weights=weight)
    assert np.allclose(found.rotation, expected.as_matrix(), rtol=0, atol=1e-12)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    assert not found.mirrored
    assert np.allclose(weight @ (found.apply(points) - target), 0, atol=1e-9)


def test_a_mirror_image_is_told_and_never_made_by_a_reflection():
    target = grid_of(GANTRY)
    found = place(target * [1.0, 1.0, -1.0], target)
    assert found.mirrored
    assert np.linalg.det(found.rotation) == pytest.approx(1.0, abs=1e-12)
    flat = target[np.isclose(target[:, 2], 0.0)]
    assert not place(flat * [1.0, -1.0, 1.0], flat).mirrored  # points in a plane have no handedness


def test_an_anchor_is_met_exactly():
    target = grid_of(GANTRY)
    points = target + np.random.default_rng(6).normal(0, 0.1, target.shape)
    found = place(points, target, anchor=7)
    assert np.allclose(found.apply(points)[7], target[7], rtol=0, atol=1e-9)


def test_points_on_a_line_cannot_be_placed():
    line = np.linspace(0, 1, 9)[:, None] * [100.0, 200.0, 300.0]
    with pytest.raises(UndeterminedError, match="one line"):
        place(line, line)


def test_the_covariance_after_placement_is_that_of_dense_algebra():
    rng = np.random.default_rng(7)
    points = rng.uniform(-300, 300, (12, 3))
    weight = rng.uniform(0.5, 2.0, 12)
    own = np.array([a @ a.T for a in rng.normal(0, 1, (12, 3, 3))])
    lever, root = rng.normal(0, 1, (12, 3, 4)), rng.normal(0, 1, (4, 4))
    flat = lever.reshape(36, 4)
    full = flat @ root @ root.T @ flat.T
    for k in range(12):
        full[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += own[k]
    centre = weight @ points / weight.sum()
    rigid = np.vstack([np.hstack([np.eye(3), -np.cross(np.eye(3), p - centre).T]) for p in points])
    rigid[:, 3:] = np.vstack([np.cross(np.eye(3), p - centre).T for p in points])  # e x arm, component by component
    w = np.repeat(weight, 3)
    keep = np.eye(36) - rigid @ np.linalg.solve(rigid.T * w @ rigid, rigid.T * w)
    expected = keep @ full @ keep.T
    found = placed_covariance(own, lever, root @ root.T, points, weight)
    for k in range(12):
        assert np.allclose(found[k], expected[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-9, atol=1e-12)


# --- separation ------------------------------------------------------------------------------------------------------


def separation_problem(machine, stations=3):
    rng = np.random.default_rng(8)
    position = rng.uniform(machine.lower_mm, machine.upper_mm, (60, 3))
    layout = error_parameters(machine, modelled_errors(machine))
    tool = np.broadcast_to(np.array(machine.tool_offset_mm), position.shape)
    root = rng.normal(0, 1, (stations, stations))
    return SeparationProblem(
        layout,
        tuple(layout.basis(axis, position[:, axis]) for axis in range(3)),
        position,
        tool,
        position + tool + rng.normal(0, 0.5, position.shape),
        np.array([a @ a.T for a in rng.normal(0, 1, (60, 3, 3))]),
        rng.normal(0, 1, (60, 3, stations)),
        root @ root.T,
    )


@pytest.mark.parametrize("machine", [GANTRY, TABLE])
def test_gradient_and_normal_matrix_are_those_of_differences(machine):
    problem = separation_problem(machine)
    rng = np.random.default_rng(1)
    scale = np.full(problem.size, 0.02)
    scale[: problem.parameters.size] = 2e-5
    state = problem.start.moved(scale * rng.normal(0, 1, problem.size))
    state = State(state.errors, state.stations_mm + [[0, 0, 0], [15.0, -9.0, 20.0]], state.dead_length_mm)
    whitened = np.linalg.cholesky(problem.information).transpose(0, 2, 1)
    root = np.linalg.cholesky(problem.station_information).T

    def residual(step):
        moved = state.moved(step)
        rest = np.einsum("mij,mj->mi", whitened, problem.residuals(moved).reshape(-1, 3))
        return np.concatenate([rest.ravel(), root @ moved.dead_length_mm])

    steps = np.diag(1e-3 / step_levers(problem.parameters, problem.size))
    jacobian = np.column_stack([(residual(h) - residual(-h)) / (2 * h.sum()) for h in steps])
    here = residual(np.zeros(problem.size))
    cost, gradient = problem.evaluate(state)
    assert cost == pytest.approx(0.5 * float(here @ here), rel=1e-12)
    size = np.sqrt(np.sum(jacobian**2, axis=0))
    cosine = 1e-7 * np.linalg.norm(here)
    assert np.allclose(gradient / size, jacobian.T @ here / size, rtol=0, atol=cosine)
    matrix = problem.normal_matrix(state)
    assert np.allclose(matrix / np.outer(size, size), jacobian.T @ jacobian / np.outer(size, size), rtol=0, atol=1e-7)


# --- the whole route -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("machine", [GANTRY, TABLE], ids=["gantry", "table"])
def test_noise_free_lengths_give_errors_stations_and_positions_back(machine, make_errors):
    truth = leaning(machine, make_errors)
    result = identify(machine, measured(machine, truth), TWO_STEP)
    assert_errors_equal(result.errors, truth)
    for k, station in enumerate(result.stations):
        assert np.allclose(station.position_mm, STATIONS[k], rtol=0, atol=10 * NANOMETRE)
        assert station.dead_length_mm == pytest.approx(DEAD_MM[k], abs=10 * NANOMETRE)
    found, position = result.positions.deviation_mm, result.positions.position_mm
    at_reference = np.flatnonzero(np.all(np.isclose(position, machine.reference_point_mm), axis=1))
    assert np.allclose(found[at_reference], 0, atol=1e-9)  # eq. 20: the translation of the machine origin
    true = exact_error(machine, truth, position)
    tip = position + np.array(machine.tool_offset_mm) + true
    rest = compgen.without_rigid_motion(tip, found - true)
    assert np.abs(rest).max() < 10 * NANOMETRE
    assert result.method == result.summary()["method"] == "two-step"


@pytest.mark.parametrize("machine", [GANTRY, TABLE], ids=["gantry", "table"])
def test_joint_and_two_step_agree_and_both_cover_the_truth(machine, make_errors):
    truth = leaning(machine, make_errors)
    lengths = measured(machine, truth, sigma_mm=SIGMA_MM, runs=2)
    joint, two = identify(machine, lengths), identify(machine, lengths, TWO_STEP)
    values, u, _ = all_values(joint.errors)
    others, other_u, _ = all_values(two.errors)
    expected, _, _ = all_values(truth)
    known = u > 0
    assert np.abs((values - others)[known] / u[known]).max() < 0.05
    assert np.all(u[known] <= 1.01 * other_u[known])
    for found, its_u in ((values, u), (others, other_u)):
        standardised = (found - expected)[known] / its_u[known]
        assert np.abs(standardised).max() < 4.0
        assert 0.6 < np.mean(standardised**2) < 1.5
    assert two.degrees_of_freedom == joint.degrees_of_freedom
    assert two.reduced_chi_square == pytest.approx(joint.reduced_chi_square, abs=1e-4)
    for a, b in zip(joint.stations, two.stations, strict=True):
        assert np.allclose(a.position_mm, b.position_mm, rtol=0, atol=0.05 * min(a.u_position_mm))
        assert np.allclose(a.u_position_mm, b.u_position_mm, rtol=0.01)


def test_chi_square_is_split_into_the_tracers_and_the_machine(make_errors):
    """An effect missing in the model appears only in the separation: the tracers still agree with each other."""
    truth = leaning(GANTRY, make_errors)
    lengths = measured(GANTRY, truth, sigma_mm=SIGMA_MM)
    whole = identify(GANTRY, lengths, TWO_STEP)
    fewer = replace(GANTRY, errors=tuple(name for name in modelled_errors(GANTRY) if name != "EBX"))
    with pytest.warns(CompgenWarning, match="does not describe"):
        without = identify(fewer, lengths, replace(TWO_STEP, reject=False))
    steps, poor = whole.steps, without.steps
    total = sum(
        steps[step]["reduced_chi_square"] * steps[step]["degrees_of_freedom"]
        for step in ("self_calibration", "separation")
    )
    assert total == pytest.approx(whole.reduced_chi_square * whole.degrees_of_freedom, rel=1e-4)
    assert steps["self_calibration"]["degrees_of_freedom"] == 80 * 4 - 80 * 3 - 10
    assert poor["self_calibration"] == steps["self_calibration"]
    assert steps["separation"]["reduced_chi_square"] < 1.5
    assert poor["separation"]["reduced_chi_square"] > 20


def test_disturbed_readings_are_found_and_points_without_three_stations_are_named(make_errors):
    truth = leaning(GANTRY, make_errors)
    count = len(grid_of(GANTRY))
    seen = np.ones((count, 4), dtype=bool)
    seen[5, 1] = False
    seen[40, 1:3] = False
    lengths = measured(GANTRY, truth, sigma_mm=SIGMA_MM, seen=seen)
    row = 201
    reading = lengths.length_mm.copy()
    reading[row] += 2.5
    result = identify(GANTRY, replace(lengths, length_mm=reading), TWO_STEP)
    reasons = {item.row: item.reason for item in result.rejected}
    lonely = np.flatnonzero(np.array(lengths.point) == "40").tolist()
    assert set(reasons) == {row, *lonely}
    assert all("fewer than three stations" in reasons[k] for k in lonely)
    assert len(result.positions) == count - 1
    value, u, _ = all_values(result.errors)
    expected, _, _ = all_values(truth)
    assert np.abs((value - expected)[u > 0] / u[u > 0]).max() < 4.0


def test_three_stations_are_sent_to_the_joint_method(make_errors):
    lengths = measured(GANTRY, leaning(GANTRY, make_errors), stations=STATIONS[:3])
    with pytest.raises(InputError, match=r"no point is seen by more than 3 of 3 stations.*--method joint"):
        identify(GANTRY, lengths, TWO_STEP)
    assert identify(GANTRY, lengths).rank == identify(GANTRY, lengths).unknowns


def test_one_tracer_at_three_places_with_points_of_their_own_is_for_the_joint_method(make_errors):
    """Sequential stations with separate points: no point is seen twice, but the machine links them."""
    machine = machine_of(counts=(7, 6, 6), tool_offset_mm=(0.0, 0.0, -120.0))
    truth = leaning(machine, make_errors)
    owner = np.random.default_rng(3).integers(0, 3, len(grid_of(machine)))
    lengths = measured(machine, truth, stations=STATIONS[:3], seen=owner[:, None] == np.arange(3))
    result = identify(machine, lengths)
    assert result.rank == result.unknowns
    assert_errors_equal(result.errors, truth, linear=10 * NANOMETRE, angular=10 * NANORADIAN)
    with pytest.raises(InputError, match="no point is seen by more than 1 of 3 stations"):
        identify(machine, lengths, TWO_STEP)


@pytest.mark.parametrize("method", ["joint", "two-step"])
def test_there_and_back_gives_the_same_as_its_mean(method, make_errors):
    lengths = measured(GANTRY, leaning(GANTRY, make_errors), sigma_mm=SIGMA_MM, runs=2)
    there, back = (lengths.part(lengths.labels["run"] == run) for run in (0, 1))
    mean = replace(there, length_mm=0.5 * (there.length_mm + back.length_mm), metadata={})
    options = IdentifyOptions(method=method, reject=False)
    both = identify(GANTRY, lengths, options)
    averaged = identify(GANTRY, mean, replace(options, u_length_um=SIGMA_MM / MICROMETRE / np.sqrt(2)))
    assert_errors_equal(averaged.errors, both.errors)
    u, other = (all_values(result.errors)[1] / result.u_scale for result in (both, averaged))
    assert np.allclose(u, other, rtol=1e-4)


# --- known stations --------------------------------------------------------------------------------------------------


def known(stations=(0,), u_mm=1e-6, at=STATIONS):
    names = tuple(f"LT{k + 1}" for k in stations)
    return KnownStations(names, at[list(stations)], np.full(len(names), u_mm))


def test_a_known_station_is_held_and_sharpens_the_rest(make_errors):
    lengths = measured(GANTRY, leaning(GANTRY, make_errors), sigma_mm=SIGMA_MM)
    free, held = identify(GANTRY, lengths), identify(GANTRY, lengths, IdentifyOptions(stations=known()))
    assert np.allclose(held.stations[0].position_mm, STATIONS[0], rtol=0, atol=2 * NANOMETRE)
    assert held.degrees_of_freedom == free.degrees_of_freedom + 3
    assert np.all(all_values(held.errors)[1] <= all_values(free.errors)[1] * held.u_scale / free.u_scale + 1e-15)


def test_a_known_station_counts_as_an_observation(make_errors):
    """Information of the free solution plus information of the known coordinates, in dense algebra."""
    lengths = measured(GANTRY, leaning(GANTRY, make_errors), sigma_mm=SIGMA_MM)
    u_mm, away = 0.3 * MICROMETRE, np.array([0.4, -0.2, 0.1]) * MICROMETRE
    free = identify(GANTRY, lengths, IdentifyOptions(reject=False))
    held = identify(GANTRY, lengths, IdentifyOptions(stations=known(u_mm=u_mm, at=STATIONS + away), reject=False))
    factor = free.adjustment.covariance_factor() / free.u_scale
    covariance = factor @ factor.T
    columns = slice(free.layout.size, free.layout.size + 3)
    gain = covariance[:, columns] @ np.linalg.inv(covariance[columns, columns] + u_mm**2 * np.eye(3))
    step = gain @ (STATIONS[0] + away - free.stations[0].position_mm)
    errors = free.layout.size
    moved = held.adjustment.state.errors - free.adjustment.state.errors
    u = np.sqrt(np.diag(covariance))
    assert np.abs(step[:errors] / u[:errors]).max() > 0.1
    assert np.allclose(moved / u[:errors], step[:errors] / u[:errors], rtol=0, atol=1e-3)
    expected = (covariance - gain @ covariance[columns])[:errors, :errors]
    assert np.allclose(np.diag(held.covariance) / held.u_scale**2, np.diag(expected), rtol=0.01)


def test_one_known_station_leaves_turns_about_it_open_and_says_so(make_errors):
    """Every carriage position of Y may rotate about the station: EAY with matching EYY and EZY is invisible."""
    truth = leaning(GANTRY, make_errors)
    y = GANTRY.axes[1].nodes_mm
    turn = np.array([0.0, 1e-6, -2e-6, 0.0])
    added = {"EAY": turn, "EYY": turn * STATIONS[0, 2], "EZY": turn * (y - STATIONS[0, 1])}
    changed = {name: replace(curve, value=curve.value + added.get(name, 0.0)) for name, curve in truth.curves.items()}
    lengths = measured(GANTRY, truth, stations=STATIONS[:1])
    other = measured(GANTRY, truth.replace(curves=changed), stations=STATIONS[:1])
    assert np.abs(lengths.length_mm - other.length_mm).max() < 20 * NANOMETRE
    assert np.abs(added["EZY"]).max() > MICROMETRE
    with pytest.raises(UndeterminedError, match=r"determine 36 of 48 unknowns") as caught:
        identify(GANTRY, lengths, IdentifyOptions(stations=known()))
    assert any("EAY" in text and "EZY" in text for text in caught.value.combinations)


def test_two_known_stations_leave_the_turn_about_their_line_open(make_errors):
    lengths = measured(GANTRY, leaning(GANTRY, make_errors), stations=STATIONS[:2])
    with pytest.raises(UndeterminedError, match=r"50 of 52 unknowns.*EZY and EAY and EYY"):
        identify(GANTRY, lengths, IdentifyOptions(stations=known((0, 1))))


def test_one_known_station_is_enough_for_a_model_that_it_determines(make_errors):
    names = ("EXX", "EYY", "EZZ", "EC0Y", "EB0Z", "EA0Z")
    machine = replace(GANTRY, errors=names)
    truth = leaning(machine, make_errors)
    lengths = measured(machine, truth, stations=STATIONS[:1])
    result = identify(machine, lengths, IdentifyOptions(stations=known()))
    assert_errors_equal(result.errors, truth)
    with pytest.raises(InputError, match=r"1 station\(s\).*at least 3.*known stations"):
        identify(machine, lengths)


def test_the_nominal_machine_locates_a_station_as_an_independent_solver_does(make_errors):
    lengths = measured(GANTRY, make_errors(GANTRY), stations=STATIONS[:1])
    found = locate_stations(GANTRY, lengths)
    target = lengths.position_mm + np.array(GANTRY.tool_offset_mm)

    def residual(x):
        return np.linalg.norm(target - x[:3], axis=1) - x[3] - lengths.length_mm

    other = least_squares(residual, [*(STATIONS[0] + 20.0), 300.0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.allclose(found.position_mm[0], other.x[:3], rtol=0, atol=1e-5)
    assert np.linalg.norm(found.position_mm[0] - STATIONS[0]) < 3 * found.u_mm[0]


def test_stations_located_with_the_nominal_machine_are_weighted_by_what_they_are_worth(make_errors):
    machine = replace(GANTRY, errors=("EXX", "EYY"))
    truth = make_errors(machine)
    lengths = measured(machine, truth, sigma_mm=SIGMA_MM, stations=STATIONS[:1])
    with pytest.warns(CompgenWarning, match="assumed perfect"):
        result = identify(machine, lengths, IdentifyOptions(stations="nominal"))
    value, u, _ = all_values(result.errors)
    exact = all_values(identify(machine, lengths, IdentifyOptions(stations=known())).errors)[1]
    assert np.all(u[u > 0] > 3 * exact[u > 0])
    assert np.abs((value - all_values(truth)[0])[u > 0] / u[u > 0]).max() < 4.0


def test_known_stations_are_read_strictly(tmp_path):
    path = tmp_path / "known.csv"
    path.write_text("station,x_mm,y_mm,z_mm,u_mm\nLT1,1,2,3,0.01\nLT2,4,5,6,0\n")
    found = read_stations(path)
    assert found.names == ("LT1", "LT2")
    assert np.array_equal(found.position_mm, [[1, 2, 3], [4, 5, 6]])
    assert found.u_mm[0] == 0.01
    path.write_text("station,x_mm,y_mm,z_mm\nLT1,1,2,3\nLT1,4,5,6\n")
    with pytest.raises(InputError, match=r"known.csv:3: column station: 'LT1' is already in line 2"):
        read_stations(path)
    path.write_text("station,x_mm,y_mm,z_mm,u_mm\nLT1,1,2,3,-1\n")
    with pytest.raises(InputError, match="negative"):
        read_stations(path)
    with pytest.raises(InputError, match=r"the stations file contains 'LX', but the measurement has no such station"):
        KnownStations(("LX",), np.zeros((1, 3)), np.ones(1)).indices(("LT1", "LT2"))


def test_two_steps_take_no_known_station(make_errors):
    lengths = measured(GANTRY, make_errors(GANTRY))
    with pytest.raises(InputError, match="joint method"):
        identify(GANTRY, lengths, replace(TWO_STEP, stations=known()))


# --- measured positions ----------------------------------------------------------------------------------------------


def deviations_of(machine, truth, *, sigma_mm=0.0, turn=(0.0, 0.0, 0.0), shift_mm=(0.0, 0.0, 0.0)):
    """Positions in a frame rotated (rotation vector, rad) and shifted relative to the machine's."""
    position = grid_of(machine)
    tool = np.array(machine.tool_offset_mm)
    tip = position + tool + exact_error(machine, truth, position)
    seen = tip @ Rotation.from_rotvec(turn).as_matrix().T + np.array(shift_mm)
    noise = sigma_mm * np.random.default_rng(4).standard_normal(seen.shape)
    return Deviations(position, seen + noise - position - tool)


@pytest.mark.parametrize("machine", [GANTRY, TABLE], ids=["gantry", "table"])
def test_positions_in_any_frame_give_the_errors_back(machine, make_errors):
    truth = leaning(machine, make_errors)
    data = deviations_of(machine, truth, turn=(0.02, -0.01, 0.03), shift_mm=(4.0, -7.0, 2.0))
    result = identify_deviations(machine, data)
    assert_errors_equal(result.errors, truth)
    assert result.method == "deviations"
    assert result.stations == ()


def test_noisy_positions_meet_the_dense_linear_solution(make_errors):
    """First-order least squares with the placement as six columns, without the program's solver."""
    truth = make_errors(GANTRY)
    sigma_mm = 1.5 * MICROMETRE
    data = deviations_of(GANTRY, truth, sigma_mm=sigma_mm)
    result = identify_deviations(GANTRY, data, IdentifyOptions(u_deviation_um=1.5, reject=False))
    layout = result.layout
    bases = [layout.basis(axis, data.position_mm[:, axis]) for axis in range(3)]
    design = layout.design(c_matrix(GANTRY, data.position_mm), bases).reshape(-1, layout.size)
    arms = data.position_mm - data.position_mm.mean(axis=0)
    rigid = np.stack([np.hstack([np.eye(3), np.cross(np.eye(3), arm).T]) for arm in arms]).reshape(-1, 6)
    full = np.hstack([design, rigid])
    unknowns = np.linalg.lstsq(full, data.deviation_mm.ravel(), rcond=None)[0][: layout.size]
    covariance = sigma_mm**2 * np.linalg.inv(full.T @ full)[: layout.size, : layout.size]
    u = np.sqrt(np.diag(covariance))
    assert np.allclose(result.adjustment.state.errors / u, unknowns / u, rtol=0, atol=0.01)
    assert np.allclose(np.sqrt(np.diag(result.covariance)) / result.u_scale, u, rtol=1e-3)
    value, its_u, _ = all_values(result.errors)
    expected, _, _ = all_values(truth)
    standardised = (value - expected)[its_u > 0] / its_u[its_u > 0]
    assert 0.6 < np.mean(standardised**2) < 1.5
    assert result.degrees_of_freedom == 3 * len(data) - layout.size - 6
    assert joint_covariance(result).errors_covariance.shape[0] == len(value)


def test_a_component_that_nothing_measured_leaves_its_errors_out(make_errors):
    """Without dz the translations in Z are not identified, and reported as such; all others are the same as with dz."""
    truth = make_errors(GANTRY)
    data = deviations_of(GANTRY, truth)
    without = data.deviation_mm.copy()
    without[:, 2] = np.nan
    result = identify_deviations(GANTRY, replace(data, deviation_mm=without))
    assert not {"EZX", "EZY", "EZZ"} & set(result.errors.names)
    assert {"EZX", "EZY", "EZZ"} <= {text.split(":")[0] for text in result.unobservable}
    left = compgen.volumetric_error(GANTRY, result.errors, data.position_mm) - compgen.volumetric_error(
        GANTRY, truth, data.position_mm
    )
    left[:, 2] = 0.0  # dZ is unknown; a rotation of the frame about X and Y still appears in dX and dY
    turned = np.cross(np.eye(3)[:, None, :], data.position_mm[None]).transpose(1, 2, 0)
    design = np.concatenate([np.broadcast_to(np.eye(3), turned.shape), turned], axis=2)[:, :2].reshape(-1, 6)
    rest = left[:, :2].ravel() - design @ np.linalg.lstsq(design, left[:, :2].ravel(), rcond=None)[0]
    assert np.abs(rest).max() < 1e-4


def test_a_disturbed_component_is_rejected_and_named(make_errors):
    data = deviations_of(GANTRY, make_errors(GANTRY), sigma_mm=0.5 * MICROMETRE)
    deviation = data.deviation_mm.copy()
    deviation[17, 1] += 0.2
    result = identify_deviations(GANTRY, replace(data, deviation_mm=deviation))
    assert [(item.row, item.station) for item in result.rejected] == [(17, "dy_um")]
    assert result.rejected[0].residual_um == pytest.approx(200.0, abs=5.0)
    assert result.u_source == "assumed"


def test_deviations_outside_the_travel_are_refused(make_errors):
    data = deviations_of(GANTRY, make_errors(GANTRY))
    with pytest.raises(InputError, match="outside the travel"):
        identify_deviations(GANTRY, replace(data, position_mm=data.position_mm * 2))


def test_a_deviations_file_comes_back(tmp_path):
    path = tmp_path / "a.deviations.csv"
    rng = np.random.default_rng(2)
    data = Deviations(
        np.round(rng.uniform(-100, 100, (5, 3)), 6),
        np.round(rng.normal(0, 20, (5, 3)), 4) * MICROMETRE,
        u_mm=np.full((5, 3), 0.5 * MICROMETRE),
        tool_mm=np.tile([0.0, 1.0, 2.0], (5, 1)),
        labels={"run": np.arange(5)},
        metadata={"date": "2024-05-17"},
    )
    path.write_text(format_deviations(data))
    assert detect_format(path) == "deviations"
    found = read_deviations(path)
    for name in ("position_mm", "deviation_mm", "u_mm", "tool_mm"):
        assert np.allclose(getattr(found, name), getattr(data, name), rtol=0, atol=1e-12)
    assert np.array_equal(found.labels["run"], np.arange(5))
    assert found.metadata == {"date": "2024-05-17"}


def test_a_component_that_was_not_measured_has_no_uncertainty_in_the_file(tmp_path):
    path = tmp_path / "a.deviations.csv"
    deviation_mm = np.array([[1e-3, np.nan, 2e-3], [3e-3, np.nan, 4e-3]])
    path.write_text(format_deviations(Deviations(np.eye(3)[:2], deviation_mm, np.full((2, 3), 5e-4))))
    found = read_deviations(path)
    assert np.allclose(found.deviation_mm, deviation_mm, rtol=0, atol=1e-12, equal_nan=True)
    assert np.allclose(found.u_mm, [[5e-4, np.nan, 5e-4]] * 2, rtol=0, atol=1e-12, equal_nan=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_mm,y_mm,z_mm\n1,2,3\n", "has none of dx_um, dy_um, dz_um"),
        ("x_mm,y_mm,dx_um\n1,2,3\n", "column 'z_mm' is missing"),
        ("x_mm,y_mm,z_mm,dx_um\n1,2,3,\n", r":2: column dx_um: is empty"),
        ("x_mm,y_mm,z_mm,dx_um\n1,2,3,250000\n", r":2: column dx_um: 250000 um is more than 100 mm"),
        ("x_mm,y_mm,z_mm,dx_um\n1,2,3,4\n1,2,3,5\n", r":3: .*already appear in line 2"),
        ("x_mm,y_mm,z_mm,dx_um,u_dy_um\n1,2,3,4,1\n", "give an uncertainty for each of u_dx_um"),
        ("x_mm,y_mm,z_mm,dx_um,u_dx_um\n1,2,3,4,0\n", r":2: column u_dx_um: 0 um is not a standard uncertainty"),
    ],
)
def test_a_malformed_deviations_file_says_where(tmp_path, text, message):
    path = tmp_path / "bad.deviations.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_deviations(path)


def test_files_with_different_components_go_together(tmp_path):
    first, second = tmp_path / "x.csv", tmp_path / "z.csv"
    first.write_text("x_mm,y_mm,z_mm,dx_um,dy_um\n1,2,3,4,5\n")
    second.write_text("x_mm,y_mm,z_mm,dz_um\n1,2,3,6\n")
    found = read_deviations([first, second])
    assert np.allclose(found.deviation_mm / MICROMETRE, [[4, 5, np.nan], [np.nan, np.nan, 6]], equal_nan=True)


# --- command line ----------------------------------------------------------------------------------------------------


@pytest.fixture
def gantry_file(tmp_path):
    path = tmp_path / "gantry.toml"
    path.write_text(
        'name = "m"\nchain = "WFYXZT"\ntool_offset_mm = [0.0, 0.0, -120.0]\nreference_point_mm = [130.0, 50.0, 0.0]\n'
        "[axes.X]\nrange_mm = [-420.0, 130.0]\nnodes = 5\n[axes.Y]\nrange_mm = [50.0, 650.0]\nnodes = 4\n"
        "[axes.Z]\nrange_mm = [-300.0, 0.0]\nnodes = 4\n"
    )
    return path


def test_two_step_writes_positions_that_identify_the_errors_again(tmp_path, gantry_file, make_errors):
    truth = leaning(GANTRY, make_errors)
    lengths = tmp_path / "m.lengths.csv"
    lengths.write_text(format_lengths(measured(GANTRY, truth, sigma_mm=SIGMA_MM)))
    first, second = tmp_path / "first", tmp_path / "second"
    words = ["identify", str(gantry_file), str(lengths), "--method", "two-step", "--out", str(first)]
    assert run_command(cli, words) == 0
    summary = json.loads((first / "identify.json").read_text())
    assert summary["method"] == "two-step"
    assert set(summary["steps"]) == {"self_calibration", "transformation", "separation"}
    positions = first / "measured.deviations.csv"
    assert run_command(cli, ["identify", str(gantry_file), str(positions), "--out", str(second)]) == 0
    summary = json.loads((second / "identify.json").read_text())
    assert summary["method"] == "deviations"
    assert summary["u_deviation"]["source"] == "stated"
    assert not (second / "stations.csv").exists()
    a, b = (compgen.read_errors(folder / "identified.errors.csv") for folder in (first, second))
    assert_errors_equal(b, a, linear=3 * MICROMETRE, angular=5e-6)


def test_known_stations_on_the_command_line(tmp_path, gantry_file, make_errors):
    truth = make_errors(GANTRY)
    lengths, stations = tmp_path / "m.lengths.csv", tmp_path / "known.csv"
    lengths.write_text(format_lengths(measured(GANTRY, truth, stations=STATIONS[:1])))
    stations.write_text("station,x_mm,y_mm,z_mm\nLT1,620,-750,50\n")
    words = ["identify", str(gantry_file), str(lengths), "--stations", str(stations), "--out", str(tmp_path / "out")]
    assert run_command(cli, words) == 1  # not determined: named, and no errors are written
    assert not (tmp_path / "out" / "identified.errors.csv").exists()
    text = gantry_file.read_text().replace("chain =", 'errors = ["EXX", "EYY", "EZZ", "EC0Y"]\nchain =')
    gantry_file.write_text(text)
    assert run_command(cli, words) == 0


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (["--method", "two-step"], "apply to tracer lengths"),
        (["--u-length-um", "1"], "apply to tracer lengths"),
    ],
)
def test_options_of_lengths_are_refused_for_deviations(tmp_path, gantry_file, capsys, extra, message):
    path = tmp_path / "a.deviations.csv"
    path.write_text("x_mm,y_mm,z_mm,dx_um\n0,100,-50,4\n")
    assert run_command(cli, ["identify", str(gantry_file), str(path), "--out", str(tmp_path / "out"), *extra]) == 2
    assert message in capsys.readouterr().err


def test_the_stations_file_of_an_identification_serves_as_known_stations(tmp_path):
    file = tmp_path / "stations.csv"
    file.write_text(
        "station,setup,segment,x_mm,y_mm,z_mm,u_x_um,u_y_um,u_z_um,dead_length_mm,u_dead_length_um,readings,residual_rms_um\n"
        "LT1,0,0,1.0,2.0,3.0,0.2,0.5,0.1,10.0,0.1,50,0.2\n"
        "LT1,0,1,1.0,2.0,3.0,0.2,0.5,0.1,11.5,0.1,20,0.2\n"
        "LT2,0,0,4.0,5.0,6.0,0.3,0.4,0.7,12.0,0.1,50,0.2\n"
    )
    known = read_stations(file)
    assert known.names == ("LT1", "LT2")
    assert known.position_mm.tolist() == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert known.u_mm.tolist() == pytest.approx([0.5e-3, 0.7e-3])
