"""The simulator: exact lengths, stated noise, order of the visits, strict scenarios, the committed example."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from compgen.data.error_table import read_errors
from compgen.data.lengths import read_lengths
from compgen.data.machine import Machine, load_machine
from compgen.data.names import error_named
from compgen.data.records import approach_of
from compgen.errors import CompgenWarning, InputError
from compgen.kinematics import modelled_errors, volumetric_error
from compgen.simulation import (
    LaserTracer,
    Scenario,
    Station,
    Trajectory,
    TruthPlan,
    plan_stops,
    read_scenario,
    simulate,
    trajectory_points,
    write_simulation,
)

EXAMPLES = Path(__file__).parents[2] / "examples"
LENGTH_TOLERANCE_MM = 1e-9
FILE_LENGTH_MM = 0.5e-7  # half the last decimal of a lengths file
PICOMETRE = 1e-9  # in mm
CHI_SQUARE_LEVEL = 1e-3

BASE = """
seed = 7
[instrument]
type = "laser-tracer"
[[instrument.stations]]
name = "A"
position_mm = [-300.0, -200.0, -100.0]
dead_length_mm = 100.0
[[instrument.stations]]
name = "B"
position_mm = [900.0, -150.0, 50.0]
dead_length_mm = 250.0
"""


@pytest.fixture(scope="module")
def gantry() -> Machine:
    return load_machine("zha-gantry")


@pytest.fixture(scope="module")
def mill() -> Machine:
    return load_machine("moving-table-mill")


@pytest.fixture(scope="module")
def example() -> Scenario:
    return read_scenario(EXAMPLES / "zha-gantry.scenario.toml")


def scenario_of(tmp_path: Path, text: str) -> Scenario:
    path = tmp_path / "x.scenario.toml"
    path.write_text(text, encoding="utf-8")
    return read_scenario(path)


def without_noise(scenario: Scenario) -> Scenario:
    return replace(scenario, instrument=replace(scenario.instrument, noise_um=0.0, noise_um_per_m=0.0))


def same_truth(first, second) -> bool:
    return first.squareness == second.squareness and all(
        np.array_equal(curve.value, second.curves[name].value) for name, curve in first.curves.items()
    )


# --- lengths against an independent computation ------------------------------------------------------------------


def pose(shift, turn) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = shift
    return matrix


def curve_value(truth, name: str, position: float) -> float:
    curve = truth.curves.get(name)
    return 0.0 if curve is None else float(np.interp(position, curve.position_mm, curve.value))


def tip_by_matrices(chain: str, truth, position, tool) -> np.ndarray:
    """Tool tip in the workpiece frame: foundation to tool, and foundation to workpiece, as 4 x 4 matrices."""
    square = {name: value for name, (value, _) in truth.squareness.items()}
    turned = {
        "X": np.array([1.0, 0.0, 0.0]),
        "Y": Rotation.from_rotvec([0, 0, square.get("EC0Y", 0.0)]).apply([0, 1, 0]),
        "Z": Rotation.from_rotvec([square.get("EA0Z", 0.0), square.get("EB0Z", 0.0), 0]).apply([0, 0, 1]),
    }
    left, right = chain.strip("WT").split("F")
    workpiece, spindle = np.eye(4), np.eye(4)
    for side, axes, sign in (("w", left[::-1], -1), ("t", right, 1)):
        for axis in axes:
            q = position["XYZ".index(axis)]
            shift = q * turned[axis] + [curve_value(truth, f"E{d}{axis}", q) for d in "XYZ"]
            turn = np.array([curve_value(truth, f"E{d}{axis}", q) for d in "ABC"])
            if side == "t":
                spindle = spindle @ pose(sign * shift, sign * turn)
            else:
                workpiece = workpiece @ pose(sign * shift, sign * turn)
    return (np.linalg.inv(workpiece) @ spindle @ [*tool, 1.0])[:3]


@pytest.mark.parametrize("name", ["zha-gantry", "moving-table-mill"])
def test_noise_free_lengths_are_the_distances_of_an_independent_chain_of_matrices(name):
    machine = load_machine(name)
    scenario = without_noise(read_scenario(EXAMPLES / f"{name}.scenario.toml"))
    simulation = simulate(machine, scenario)
    lengths, truth = simulation.lengths, simulation.truth
    for k in range(0, len(lengths), 7):
        tool = (0.0, 0.0, 0.0) if lengths.tool_mm is None else lengths.tool_mm[k]
        tip = tip_by_matrices(machine.chain.name, truth, lengths.position_mm[k], tool)
        station = scenario.instrument.stations[lengths.station[k]]
        expected = np.linalg.norm(tip - station.position_mm) - station.dead_length_mm
        assert lengths.length_mm[k] == pytest.approx(expected, abs=LENGTH_TOLERANCE_MM)


def test_a_machine_without_errors_is_measured_at_its_nominal_distances(mill):
    station = Station("A", (-300.0, 0.0, 0.0), 50.0)
    trajectory = Trajectory(levels_mm=(np.array([0.0, 100.0]), np.array([0.0]), np.array([0.0])), there_and_back=False)
    scenario = Scenario(LaserTracer((station,), 0.0, 0.0), seed=1, errors=TruthPlan(), trajectory=trajectory)
    assert simulate(mill, scenario).lengths.length_mm == pytest.approx([250.0, 350.0], abs=LENGTH_TOLERANCE_MM)


def test_a_further_effect_moves_the_tip(mill):
    station = Station("A", (-300.0, 0.0, 0.0), 50.0)
    trajectory = Trajectory(levels_mm=(np.array([0.0, 100.0]), np.array([0.0]), np.array([0.0])), there_and_back=False)
    scenario = Scenario(LaserTracer((station,), 0.0, 0.0), seed=1, errors=TruthPlan(), trajectory=trajectory)

    def growth(_, stops):
        return np.outer(stops.position_mm[:, 0] * 1e-4, [1.0, 0.0, 0.0])

    moved = simulate(mill, scenario, effects=[growth]).lengths.length_mm
    assert moved == pytest.approx([250.0, 350.01], abs=LENGTH_TOLERANCE_MM)


def test_several_tools_are_visited_one_after_the_other_and_raise_the_number_of_errors(tmp_path, mill):
    text = BASE + "[trajectory]\nlevels = 2\ntools_mm = [[0, 0, -100], [0, 80, -150], [60.0, 0, -150]]\n"
    simulation = simulate(mill, scenario_of(tmp_path, text))
    tools = np.array([[0, 0, -100], [0, 80, -150], [60, 0, -150.0]])
    assert np.array_equal(simulation.lengths.tool_mm, np.repeat(tools, 8 * 2 * 2, axis=0))
    assert simulation.truth.names == modelled_errors(mill, tools)
    assert len(simulation.truth.names) == 21


# --- noise and seeds ---------------------------------------------------------------------------------------------


def test_noise_has_the_stated_standard_deviation(gantry, example):
    noisy = simulate(gantry, example).lengths
    clean = simulate(gantry, without_noise(example)).lengths
    dead_mm = np.array([station.dead_length_mm for station in example.instrument.stations])
    sigma_mm = (0.1 + 0.15 * (clean.length_mm + dead_mm[clean.station]) / 1000) * 1e-3
    z = (noisy.length_mm - clean.length_mm) / sigma_mm
    near, far = sigma_mm < np.quantile(sigma_mm, 0.2), sigma_mm > np.quantile(sigma_mm, 0.8)
    for part in (z, z[near], z[far]):
        low, high = stats.chi2.interval(1 - CHI_SQUARE_LEVEL, len(part))
        assert low < np.sum(part**2) < high
    assert abs(z.mean()) * np.sqrt(len(z)) < stats.norm.isf(CHI_SQUARE_LEVEL / 2)
    assert stats.kstest(z, "norm").pvalue > CHI_SQUARE_LEVEL


def test_the_seed_reproduces_a_simulation_and_another_one_changes_it(mill):
    scenario = read_scenario(EXAMPLES / "moving-table-mill.scenario.toml")
    first, again, other = simulate(mill, scenario), simulate(mill, scenario), simulate(mill, scenario, seed=5)
    assert np.array_equal(first.lengths.length_mm, again.lengths.length_mm)
    assert same_truth(first.truth, again.truth)
    assert not same_truth(first.truth, other.truth)
    assert other.lengths.metadata["seed"] == other.truth.metadata["seed"] == "5"


def test_the_callers_seed_takes_the_place_of_that_in_the_scenario(mill):
    scenario = read_scenario(EXAMPLES / "moving-table-mill.scenario.toml")
    by_caller, by_file = simulate(mill, scenario, seed=5), simulate(mill, replace(scenario, seed=5))
    assert np.array_equal(by_caller.lengths.length_mm, by_file.lengths.length_mm)


def test_changing_the_noise_leaves_the_truth_and_changing_the_truth_leaves_the_noise(mill):
    scenario = read_scenario(EXAMPLES / "moving-table-mill.scenario.toml")
    constant = replace(scenario, instrument=replace(scenario.instrument, noise_um=2.0, noise_um_per_m=0.0))
    perfect = replace(constant, errors=TruthPlan())
    noise = [
        simulate(mill, case).lengths.length_mm - simulate(mill, without_noise(case)).lengths.length_mm
        for case in (constant, perfect)
    ]
    assert noise[0] == pytest.approx(noise[1], abs=PICOMETRE)
    assert np.abs(noise[0]).max() > 2e-3
    assert same_truth(simulate(mill, scenario).truth, simulate(mill, constant).truth)


def test_giving_one_curve_leaves_the_drawn_ones(tmp_path, mill):
    given = '[errors]\n[[errors.curve]]\nname = "EYX"\nposition_mm = [0, 600]\nvalue_um = [0.0, 9.0]\n'
    drawn = simulate(mill, scenario_of(tmp_path, BASE)).truth
    partly = simulate(mill, scenario_of(tmp_path, BASE + given)).truth
    assert partly.curves["EYX"].value == pytest.approx([0.0, 9e-3])
    for name in set(drawn.curves) - {"EYX"}:
        assert np.array_equal(drawn.curves[name].value, partly.curves[name].value)
    assert drawn.squareness == partly.squareness


# --- the truth ---------------------------------------------------------------------------------------------------


def mill_with_reference(mill: Machine, reference_mm) -> Machine:
    return replace(mill, reference_point_mm=reference_mm)


@pytest.mark.parametrize("reference_mm", [(0.0, 0.0, 0.0), (600.0, 400.0, 500.0), (300.0, 130.0, 77.0)])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_drawn_curves_have_the_gauge_of_the_model_and_the_peaks_asked_for(mill, reference_mm, seed):
    machine = mill_with_reference(mill, reference_mm)
    scenario = Scenario(LaserTracer((Station("A", (0.0, -500.0, 0.0), 0.0),)), seed=seed)
    truth = simulate(machine, scenario).truth
    assert truth.names == modelled_errors(machine)
    for name, curve in truth.curves.items():
        error = error_named(name)
        unit = 1e-3 if error.kind == "linear" else 1e-6
        assert 10 * unit <= np.abs(curve.value).max() <= 30 * unit * (1 + 1e-12)
        if error.is_straightness:
            assert curve.value[0] == curve.value[-1] == 0.0
        else:
            assert curve.at(np.array([reference_mm[error.axis]]))[0] == pytest.approx(0.0, abs=1e-15)
    assert all(10e-6 <= abs(value) <= 30e-6 for value, _ in truth.squareness.values())


def test_peaks_and_nodes_of_the_scenario_are_used(tmp_path, mill):
    text = "[errors]\nlinear_peak_um = [5, 5]\nangular_peak_urad = [2, 2]\nsquareness_peak_urad = [0, 0]\n"
    text += "nodes = [21, 9, 2]\n"
    truth = simulate(mill, scenario_of(tmp_path, BASE + text)).truth
    assert np.abs(truth.curves["EXX"].value).max() == pytest.approx(5e-3)
    assert np.abs(truth.curves["EAX"].value).max() == pytest.approx(2e-6)
    for name, curve in truth.curves.items():
        assert len(curve.value) == {"X": 21, "Y": 9, "Z": 2}[name[2]]
    assert np.array_equal(truth.curves["EXX"].position_mm, np.linspace(0, 600, 21))
    assert np.array_equal(truth.curves["EXZ"].value, [0.0, 0.0])  # two nodes leave no straightness
    assert all(value == 0 for value, _ in truth.squareness.values())


def test_a_file_of_errors_is_the_truth_and_what_the_scenario_gives_wins(tmp_path, mill):
    rows = "error,position_mm,value\nEXX,0,0\nEXX,600,12\nEAZ,0,3\nEAZ,500,5\nEC0Y,,40\nEB0Z,,-7\n"
    (tmp_path / "x.errors.csv").write_text(rows, encoding="utf-8")
    text = BASE + '[errors]\nfile = "x.errors.csv"\n[errors.squareness_urad]\nEC0Y = 11.0\n'
    truth = simulate(mill, scenario_of(tmp_path, text)).truth
    assert truth.names == ("EXX", "EAZ", "EC0Y", "EB0Z")
    assert truth.curves["EXX"].value == pytest.approx([0.0, 12e-3])
    assert truth.curves["EAZ"].value == pytest.approx([3e-6, 5e-6])
    assert truth.squareness["EC0Y"][0] == pytest.approx(11e-6)
    assert truth.squareness["EB0Z"][0] == pytest.approx(-7e-6)


def test_errors_that_do_not_reach_over_the_trajectory_are_reported(tmp_path, mill):
    text = BASE + '[[errors.curve]]\nname = "EXX"\nposition_mm = [0, 300]\nvalue_um = [0, 6]\n'
    scenario = scenario_of(tmp_path, text)
    with pytest.warns(CompgenWarning, match="EXX is known from 0 to 300 mm"):
        simulate(mill, scenario)


# --- trajectory --------------------------------------------------------------------------------------------------


def test_a_grid_is_run_in_serpentines_there_and_back(mill):
    levels = (np.array([0.0, 10.0, 20.0]), np.array([0.0, 5.0]), np.array([1.0, 2.0]))
    stops = plan_stops(Trajectory(levels_mm=levels), mill)
    there = [
        *[(0, 0, 1), (10, 0, 1), (20, 0, 1), (20, 5, 1), (10, 5, 1), (0, 5, 1)],
        *[(0, 5, 2), (10, 5, 2), (20, 5, 2), (20, 0, 2), (10, 0, 2), (0, 0, 2)],
    ]
    assert [tuple(row) for row in stops.position_mm] == there + there[::-1]
    assert list(stops.run) == [1] * 12 + [2] * 12
    assert stops.point[:12] == tuple(f"P{k:04d}" for k in range(1, 13))
    assert stops.point[12:] == stops.point[:12][::-1]


@pytest.mark.parametrize("counts", [(2, 3, 4), (3, 3, 3), (4, 2, 3), (3, 4, 2)])
def test_a_serpentine_visits_every_point_once_and_moves_to_neighbours_only(mill, counts):
    trajectory = Trajectory(levels_mm=tuple(np.arange(float(count)) for count in counts))
    points = trajectory_points(trajectory, mill)
    assert len({tuple(point) for point in points.tolist()}) == len(points) == np.prod(counts)
    assert (np.abs(np.diff(points, axis=0)).sum(axis=1) == 1).all()


def test_approach_is_the_last_direction_of_travel_kept_while_the_axis_rests(mill):
    levels = (np.array([0.0, 10.0]), np.array([0.0, 5.0]), np.array([1.0, 2.0]))
    stops = plan_stops(Trajectory(levels_mm=levels, start_mm=(0.0, 9.0, 0.0)), mill)
    # X: does not move to the first point; Y comes from above; Z from below
    there = [(0, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1), (-1, 1, 1), (1, 1, 1), (1, -1, 1), (-1, -1, 1)]
    back = [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1), (-1, 1, -1), (1, 1, -1), (1, -1, -1), (-1, -1, -1)]
    assert [tuple(row) for row in stops.approach] == there + back


def test_approach_follows_each_axis_through_many_moves():
    rng = np.random.default_rng(3)
    moves = rng.choice([-2.5, 0.0, 0.0, 1.0], size=(200, 3))
    expected, last = [], [0, 0, 0]
    for move in moves:
        last = [int(np.sign(step)) or before for step, before in zip(move, last, strict=True)]
        expected.append(last)
    assert np.array_equal(approach_of(moves), expected)


def test_the_clock_counts_travel_at_feed_and_dwell(mill):
    levels = (np.array([0.0, 100.0]), np.array([0.0]), np.array([0.0]))
    stops = plan_stops(Trajectory(levels_mm=levels, feed_mm_min=1200.0, dwell_s=2.0), mill)
    assert stops.time_s == pytest.approx([2.0, 9.0, 11.0, 18.0])  # 100 mm at 20 mm/s take 5 s


def test_the_frame_holds_the_twelve_edges_of_the_box(mill):
    points = trajectory_points(Trajectory("frame", counts=(4, 5, 6)), mill)
    on_end = (points == mill.lower_mm) | (points == mill.upper_mm)
    assert (on_end.sum(axis=1) >= 2).all()
    assert len({tuple(point) for point in points.tolist()}) == 8 + 4 * (2 + 3 + 4)


def test_the_faces_hold_the_surface_of_the_box(mill):
    points = trajectory_points(Trajectory("faces", counts=(4, 5, 6)), mill)
    assert len({tuple(point) for point in points.tolist()}) == 4 * 5 * 6 - 2 * 3 * 4


def test_lines_are_given_by_their_ends(tmp_path, mill):
    line = "[[trajectory.lines]]\nfrom_mm = {}\nto_mm = {}\npoints = 4\n"
    text = BASE + '[trajectory]\ntype = "lines"\nruns = "once"\n'
    text += line.format([0, 0, 0], [600, 300, 0]) + line.format([600, 300, 0], [600, 0, 0])
    simulation = simulate(mill, scenario_of(tmp_path, text))
    points = simulation.lengths.position_mm[::2]
    expected = [(0, 0), (200, 100), (400, 200), (600, 300), (600, 200), (600, 100), (600, 0)]
    assert [tuple(row[:2]) for row in points] == expected  # the shared corner is visited once
    assert set(simulation.lengths.labels["run"]) == {1}


def test_commanded_positions_keep_no_more_decimals_than_the_file(tmp_path, mill):
    simulation = simulate(mill, scenario_of(tmp_path, BASE + "[trajectory]\nlevels = 8\n"))
    paths = write_simulation(simulation, tmp_path)
    assert np.array_equal(read_lengths(paths["simulated.lengths.csv"]).position_mm, simulation.lengths.position_mm)


def test_stations_read_at_once_or_in_turn(tmp_path, mill):
    levels = "[trajectory]\nlevels = 2\n"
    at_once = simulate(mill, without_noise(scenario_of(tmp_path, BASE + levels))).lengths
    text = BASE.replace('"laser-tracer"\n', '"laser-tracer"\nreading = "in-turn"\n') + levels
    in_turn = simulate(mill, without_noise(scenario_of(tmp_path, text))).lengths
    assert list(at_once.station) == [0, 1] * 16
    assert list(in_turn.station) == [0] * 16 + [1] * 16
    assert (np.diff(in_turn.covariates["time_s"]) > 0).all()
    for station in (0, 1):
        first, second = at_once.station == station, in_turn.station == station
        assert np.array_equal(at_once.length_mm[first], in_turn.length_mm[second])


# --- files -------------------------------------------------------------------------------------------------------


def test_written_files_read_back_and_do_not_give_the_truth_away(tmp_path, mill):
    scenario = read_scenario(EXAMPLES / "moving-table-mill.scenario.toml")
    simulation = simulate(mill, scenario)
    paths = write_simulation(simulation, tmp_path / "new")
    assert set(paths) == {"moving-table-mill.lengths.csv", "truth.errors.csv"}
    lengths, truth = read_lengths(paths["moving-table-mill.lengths.csv"]), read_errors(paths["truth.errors.csv"])
    assert lengths.length_mm == pytest.approx(simulation.lengths.length_mm, abs=FILE_LENGTH_MM * 1.001)
    assert lengths.metadata == {
        "machine": "moving-table-mill",
        "seed": "20240611",
        "instrument": "laser-tracer",
        "u_length_um": "0.1",
        "u_length_um_per_m": "0.15",
    }
    assert np.array_equal(lengths.approach, simulation.lengths.approach)
    assert np.array_equal(lengths.tool_mm, simulation.lengths.tool_mm)
    assert (np.ptp(lengths.tool_mm, axis=0) == 0).all() and lengths.tool_mm[0, 2] == -120
    assert truth.names == simulation.truth.names
    assert truth.metadata["reference_point_mm"] == "0 0 0"


def test_columns_are_those_of_the_contract_with_tools_only_if_given(tmp_path, mill):
    tool_columns = ["tool_x_mm", "tool_y_mm", "tool_z_mm"]
    for text, expected in (("", []), ("tools_mm = [[0, 0, -90]]\n", tool_columns)):
        simulation = simulate(mill, scenario_of(tmp_path, BASE + "[trajectory]\nlevels = 2\n" + text))
        path = write_simulation(simulation, tmp_path)["simulated.lengths.csv"]
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
        header = next(csv.reader(lines))
        usual = ["station", "point", "x_mm", "y_mm", "z_mm", "length_mm", "run", "time_s"]
        assert sorted(header) == sorted([*usual, "approach_x", "approach_y", "approach_z", *expected])
        assert len(lines) == 1 + 8 * 2 * 2


# --- the committed example ---------------------------------------------------------------------------------------


def test_the_committed_example_is_what_its_scenario_generates(tmp_path, gantry, example):
    paths = write_simulation(simulate(gantry, example), tmp_path)
    assert paths["zha-gantry.lengths.csv"].read_bytes() == (EXAMPLES / "zha-gantry.lengths.csv").read_bytes()
    assert paths["truth.errors.csv"].read_bytes() == (EXAMPLES / "zha-gantry.truth.errors.csv").read_bytes()


def test_the_example_is_the_measurement_of_the_paper():
    # Zha & Zhang 2024, Tables 6 and 7, section 6.1
    scenario = read_scenario(EXAMPLES / "zha-gantry.scenario.toml")
    assert {station.name: station.position_mm for station in scenario.instrument.stations} == {
        "LT1": (158.8075, -1456.6824, -349.7023),
        "LT2": (-113.1165, -1671.7155, -349.3517),
        "LT3": (-468.6489, -1563.1627, -349.4140),
        "LT4": (-769.8987, -1599.5469, -208.9567),
    }
    truth = read_errors(EXAMPLES / "zha-gantry.truth.errors.csv")
    printed = {"EC0Y": 2903.269e-6, "EB0Z": -61.431e-6, "EA0Z": 22.856e-6}
    assert {name: value for name, (value, _) in truth.squareness.items()} == pytest.approx(printed, abs=1e-15)
    lengths = read_lengths(EXAMPLES / "zha-gantry.lengths.csv")
    assert len(lengths) == 11**3 * 4 * 2
    assert (EXAMPLES / "zha-gantry.lengths.csv").stat().st_size < 1.2e6
    assert (scenario.trajectory.feed_mm_min, scenario.trajectory.dwell_s) == (1000.0, 3.0)


def test_the_curves_of_the_example_are_smooth():
    truth = read_errors(EXAMPLES / "zha-gantry.truth.errors.csv")
    for name, curve in truth.curves.items():
        unit = 1e-3 if error_named(name).kind == "linear" else 1e-6
        assert np.abs(np.diff(curve.value)).max() < 10 * unit
        turns = np.count_nonzero(np.diff(np.sign(np.diff(curve.value))))
        assert turns <= 3


def test_compensating_positioning_alone_is_not_adverse_in_the_example(gantry):
    truth = read_errors(EXAMPLES / "zha-gantry.truth.errors.csv")
    points = np.array(np.meshgrid(*(axis.nodes_mm for axis in gantry.axes))).reshape(3, -1).T

    def rms_without(*names: str) -> float:
        kept = truth.replace(curves={name: curve for name, curve in truth.curves.items() if name not in names})
        return float(np.sqrt(np.mean(np.sum(volumetric_error(gantry, kept, points) ** 2, axis=1))))

    raw = rms_without()
    assert truth.curves["EXX"].value.mean() > 0
    for names in (("EXX",), ("EYY",), ("EZZ",), ("EXX", "EYY", "EZZ")):
        assert rms_without(*names) < raw


# --- strict scenarios --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BASE + "sede = 3\n", r"\[instrument.stations\] sede: is not a known key"),
        ("colour = 1\n" + BASE, r":1: colour: is not a known key"),
        (BASE.replace("seed = 7", "name = 'x'"), "seed: is missing"),
        (BASE.replace("seed = 7", "seed = -1"), r":2: seed: expected a whole number of at least 0"),
        (BASE.replace("seed = 7", "seed = 7\nname = '../x'"), r":3: name: expected a file name of letters"),
        (
            BASE.replace('"laser-tracer"', '"laser-tracker"'),
            "type: expected one of 'laser-tracer', 'sixdof', 'axis-laser', 'diagonal-laser'",
        ),
        (BASE.replace('"laser-tracer"\n', '"laser-tracer"\nnoise_nm = 1\n'), "did you mean 'noise_um'"),
        (BASE.replace('"laser-tracer"\n', '"laser-tracer"\nnoise_um = -1\n'), "not negative"),
        (BASE.replace('"B"', '"A"'), "names A, A must differ"),
        (BASE.replace("dead_length_mm = 250.0", "dead_length_um = 250.0"), "dead_length_mm: is missing"),
        ("seed = 7\n[instrument]\ntype = 'laser-tracer'\n", "at least one"),
        (BASE + "[errors]\nlinear_peak_um = [30, 10]\n", "smallest, largest"),
        (BASE + "[errors]\nnodes = 1\n", "from 2 to 10001"),
        (BASE + "[errors]\nnodes = [3, 3]\n", "three for X, Y and Z"),
        (BASE + "[errors]\nfile = 'missing.errors.csv'\n", "missing.errors.csv: no such file"),
        (BASE + "[errors]\nrandom = false\nlinear_peak_um = [1, 2]\n", "linear_peak_um: is not a known key"),
        (BASE + "[errors.squareness_urad]\nEC0X = 1\n", "EC0X: is not a known key; did you mean 'EC0Y'"),
        (BASE + "[[errors.curve]]\nname = 'EC0Y'\n", "give it in .errors.squareness_urad"),
        (BASE + "[[errors.curve]]\nname = 'EXW'\n", "one of the 18 error curves"),
        (
            BASE + "[[errors.curve]]\nname = 'EXX'\nposition_mm = [0, 600]\nvalue_urad = [0, 1]\n",
            "EXX is given in um; write value_um",
        ),
        (
            BASE + "[[errors.curve]]\nname = 'EAX'\nposition_mm = [0, 600]\nvalue_urad = [0]\n",
            "1 values for 2 positions",
        ),
        (BASE + "[[errors.curve]]\nname = 'EAX'\nposition_mm = [0, 6]\nvalue_urad = [0, 1]\n" * 2, "given twice"),
        (BASE + "[trajectory]\ntype = 'spiral'\n", "'grid', 'frame', 'faces', 'lines'"),
        (BASE + "[trajectory]\ntype = 'lines'\n", "needs .*trajectory.lines"),
        (BASE + "[trajectory]\nruns = 'twice'\n", "'there-and-back', 'once'"),
        (BASE + "[trajectory]\nx_mm = [3, 2]\n", "ascending"),
        (BASE + "[trajectory]\ntools_mm = [0, 0, 1]\n", "three numbers, for X, Y and Z"),
        (BASE + "[trajectory]\ntools_mm = [[0, 0, 1], [0, 0, 1.0]]\n", "may be given only once"),
        (BASE + "[trajectory]\nfeed_mm_min = 0\n", "above zero"),
    ],
)
def test_a_scenario_that_cannot_be_used_is_refused_with_the_place(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        scenario_of(tmp_path, text)
    assert str(tmp_path) in str(caught.value)


def test_a_file_of_errors_and_random_errors_exclude_each_other(tmp_path):
    (tmp_path / "x.errors.csv").write_text("error,position_mm,value\nEC0Y,,4\n", encoding="utf-8")
    with pytest.raises(InputError, match="either file or random"):
        scenario_of(tmp_path, BASE + "[errors]\nfile = 'x.errors.csv'\nrandom = true\n")


def test_a_trajectory_outside_the_travel_is_refused_with_file_axis_and_travel(tmp_path, mill):
    scenario = scenario_of(tmp_path, BASE + "[trajectory]\ny_mm = [0, 450]\n")
    with pytest.raises(InputError, match=r"x.scenario.toml: \[trajectory\]: Y = 450 mm is outside .* 0 ... 400 mm"):
        simulate(mill, scenario)
