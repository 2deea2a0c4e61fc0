"""Planning: rank and uncertainty against dense algebra and identification, known facts, and the search."""

import json
from dataclasses import replace

import numpy as np
import pytest

from compgen.data.error_table import read_errors
from compgen.data.lengths import Lengths, Points, read_points
from compgen.data.machine import Axis, load_machine
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError
from compgen.identification import IdentifyOptions, identify
from compgen.kinematics.first_order import c_matrix
from compgen.planning import (
    Box,
    box_from_text,
    candidate_trajectories,
    format_stations,
    judge_trajectories,
    plan,
    planned,
    planned_noise,
    planned_stations,
    read_boxes,
    read_stations,
    regions_of,
    shell_around,
    suggest,
)
from compgen.planning.suggestions import _Search
from compgen.simulation.trajectory import Trajectory, trajectory_points

#: Four places around the gantry, at four heights.
PLACES = {
    "A": [400.0, -1900.0, 50.0],
    "B": [-700.0, -1800.0, 100.0],
    "C": [900.0, 700.0, -150.0],
    "D": [-100.0, 1300.0, 600.0],
}
NOISE = IdentifyOptions(u_length_um=0.2, u_length_um_per_m=0.0)
NO_PRIOR = PriorSettings(class_name="none")
UNEVEN_NOISE = IdentifyOptions(u_length_um=0.2, u_length_um_per_m=0.3)


def gantry(nodes=5, **fields):
    machine = load_machine("zha-gantry")
    axes = tuple(Axis(axis.range_mm, np.linspace(*axis.range_mm, nodes)) for axis in machine.axes)
    return replace(machine, axes=axes, **fields)


def stations_of(count=4):
    return planned_stations(dict(list(PLACES.items())[:count]))


def points_of(machine, kind="grid"):
    return Points(trajectory_points(Trajectory(kind), machine))


def lines(*ends, count=5):
    return Points(np.concatenate([np.linspace(first, last, count) for first, last in ends]))


def body_diagonals(machine, count=5):
    corners = np.array([[0, 0, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]], dtype=bool)
    low, high = machine.lower_mm, machine.upper_mm
    return lines(*[(np.where(c, high, low), np.where(c, low, high)) for c in corners], count=count)


def corner_lines(machine, count=5):
    """Along the three axes from machine zero."""
    low, high = machine.lower_mm, machine.upper_mm
    return lines(*[(high, np.where(np.arange(3) == k, low, high)) for k in range(3)], count=count)


def dense_jacobian(machine, stations, points, options):
    """Weighted Jacobian of all readings, one pass of each station, straight from the definition of a row."""
    found = planned(machine, stations, points, planned_noise(options))
    layout = found.problem.parameters
    bases = [layout.basis(axis, points.position_mm[:, axis]) for axis in range(3)]
    design = layout.design(c_matrix(machine, points.position_mm, points.tool_mm), bases)
    tool = np.array(machine.tool_offset_mm) if points.tool_mm is None else points.tool_mm
    blocks, distances = [], []
    for k, centre in enumerate(stations.position_mm):
        sight = points.position_mm + tool - centre
        distance = np.linalg.norm(sight, axis=1)
        unit = sight / distance[:, None]
        own = np.zeros((len(points), 4 * len(stations)))
        own[:, 3 * k : 3 * k + 3], own[:, 3 * len(stations) + k] = -unit, -1.0
        row = np.hstack([np.einsum("nc,nck->nk", unit, design), own])
        sigma = 1e-3 * (options.u_length_um + options.u_length_um_per_m * distance / 1000.0)
        blocks.append(row / sigma[:, None])
        distances.append(distance / sigma)
    return np.concatenate(blocks), np.concatenate(distances), layout.size


def numerical_rank(matrix):
    size = np.linalg.norm(matrix, axis=0)
    values = np.linalg.svd(matrix / np.where(size > 0, size, 1.0), compute_uv=False)
    rank = int(np.count_nonzero(values > 1e-6 * values[0]))
    assert rank == matrix.shape[1] or values[rank - 1] > 30 * values[rank], "no gap"
    return rank


# --- numbers against independent ones ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["grid", "frame"])
def test_the_prediction_is_the_inverse_of_the_dense_normal_matrix(kind):
    machine = gantry(4, reference_point_mm=(-300.0, -200.0, -100.0), tool_offset_mm=(10.0, -20.0, -90.0))
    points = points_of(machine, kind)
    result = plan(machine, stations_of(), points, UNEVEN_NOISE)
    jacobian, _, size = dense_jacobian(machine, stations_of(), points, UNEVEN_NOISE)
    scale = 1.0 / np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.inv((jacobian * scale).T @ (jacobian * scale)) * scale * scale[:, None]
    layout = result.planned.problem.parameters
    for curve in layout.curves:
        block = curve.free @ covariance[curve.columns, curve.columns] @ curve.free.T
        assert np.allclose(result.errors.curves[curve.error.name].u, np.sqrt(np.maximum(np.diag(block), 0)), rtol=1e-6)
    for k, name in enumerate(layout.squareness):
        place = size - len(layout.squareness) + k
        assert result.errors.squareness[name][1] == pytest.approx(np.sqrt(covariance[place, place]), rel=1e-6)
    chosen = result.from_readings.position_mm[::7]
    bases = [layout.basis(axis, chosen[:, axis]) for axis in range(3)]
    design = layout.design(c_matrix(machine, chosen), bases)
    expected = np.sqrt(np.maximum(np.einsum("nij,jk,nik->ni", design, covariance[:size, :size], design), 0.0))
    assert np.allclose(result.from_readings.u_mm[::7], expected, rtol=1e-5, atol=1e-9)
    assert result.volume.rms_um > result.from_readings.rms_um  # with what the curves do between their nodes
    without = plan(replace(machine, prior=NO_PRIOR), stations_of(), points, UNEVEN_NOISE)
    assert np.array_equal(without.volume.u_mm, result.from_readings.u_mm)


def test_identification_has_the_uncertainty_that_was_planned():
    machine, stations = gantry(4), stations_of()
    points = points_of(machine)
    distance = np.linalg.norm(points.position_mm[:, None] - stations.position_mm, axis=2)
    lengths = Lengths(
        stations=stations.names,
        station=np.tile(np.arange(4), len(points)),
        point=[str(k) for k in range(4 * len(points))],
        position_mm=np.repeat(points.position_mm, 4, axis=0),
        length_mm=distance.ravel() - 250.0,
    )
    with pytest.warns(CompgenWarning, match="EZZ is weakly determined"):  # the truth is zero, and noise is stated
        found = identify(machine, lengths, UNEVEN_NOISE).errors
    expected = plan(machine, stations, points, UNEVEN_NOISE).errors
    for name, curve in found.curves.items():
        assert np.allclose(curve.u, expected.curves[name].u, rtol=1e-6, atol=1e-15), name
    for name, (_, u) in found.squareness.items():
        assert u == pytest.approx(expected.squareness[name][1], rel=1e-6)


def test_points_that_stand_twice_are_read_twice():
    machine = gantry(4)
    points = points_of(machine)
    once = plan(machine, stations_of(), points, NOISE)
    twice = plan(machine, stations_of(), Points(np.tile(points.position_mm, (2, 1))), NOISE)
    assert twice.from_readings.worst_um == pytest.approx(once.from_readings.worst_um / np.sqrt(2), rel=1e-6)
    assert (
        once.volume.worst_um > twice.volume.worst_um > once.volume.worst_um / np.sqrt(2)
    )  # what is between the nodes stays
    assert twice.readings == 2 * once.readings


# --- facts about stations and trajectories -------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "determined"), [(1, False), (2, False), (3, True), (4, True)])
def test_three_stations_are_enough_and_fewer_are_not(count, determined):
    machine = gantry()
    result = plan(machine, stations_of(count), points_of(machine), NOISE)
    jacobian, _, _ = dense_jacobian(machine, stations_of(count), points_of(machine), NOISE)
    assert result.determined is determined
    assert result.rank.rank == numerical_rank(jacobian)
    assert result.rank.size == jacobian.shape[1]


def test_with_one_or_two_stations_the_ambiguity_is_a_function():
    """It has more directions the more nodes the curves have."""
    for count, growth in ((1, 4), (2, 1)):
        open_directions = []
        for nodes in (4, 5, 6):
            machine = gantry(nodes)
            rank = plan(machine, stations_of(count), points_of(machine), NOISE).rank
            open_directions.append(rank.size - rank.rank)
        assert np.array_equal(np.diff(open_directions), [growth, growth])


def test_a_fourth_station_cuts_the_worst_uncertainty_by_more_than_two():
    machine = gantry(11)
    three, four = (plan(machine, stations_of(count), points_of(machine), NOISE) for count in (3, 4))
    worst = [max(np.max(curve.u) for name, curve in p.errors.curves.items() if name[1] in "XYZ") for p in (three, four)]
    assert 2.0 < worst[0] / worst[1] < 5.0
    assert three.from_readings.worst_um > 2.0 * four.from_readings.worst_um


@pytest.mark.parametrize("kind", ["frame", "faces"])
def test_twelve_edges_or_six_faces_determine_everything(kind):
    machine = gantry(11)
    result = plan(machine, stations_of(), points_of(machine, kind), NOISE)
    assert result.determined
    assert np.isfinite(result.volume.u_mm).all()


def test_three_lines_through_a_corner_leave_twenty_node_values_untouched():
    machine = gantry(5, prior=NO_PRIOR)
    result = plan(machine, stations_of(), corner_lines(machine), NOISE)
    assert result.rank.size - result.rank.rank == 20
    open_nodes = {name: np.count_nonzero(np.isnan(curve.u)) for name, curve in result.errors.curves.items()}
    assert {name: count for name, count in open_nodes.items() if count} == dict.fromkeys(
        ("EAX", "EBX", "EAY", "EBY", "ECY"), 4
    )
    assert "no data at all for: EAX at -800 mm" in result.reasons[0]
    assert not result.nodes_without_data  # every node is visited; those errors have no lever arm there


@pytest.mark.parametrize("count", [5, 9, 17])
def test_four_body_diagonals_alone_do_not_determine_the_errors(count):
    machine = gantry(5)
    points = body_diagonals(machine, count)
    result = plan(machine, stations_of(), points, NOISE)
    jacobian, _, _ = dense_jacobian(machine, stations_of(), points, NOISE)
    assert not result.determined
    assert result.rank.size - result.rank.rank == jacobian.shape[1] - numerical_rank(jacobian) > 10


def test_an_unknown_length_scale_adds_exactly_one_direction():
    machine = gantry(4)
    jacobian, distance, _ = dense_jacobian(machine, stations_of(), points_of(machine), NOISE)
    size = jacobian.shape[1]
    assert numerical_rank(jacobian) == size
    assert numerical_rank(np.column_stack([jacobian, distance])) == size


def test_all_21_errors_need_three_tools():
    machine = gantry(4, errors=21, tool_offset_mm=(0.0, 0.0, -100.0))
    grid = points_of(machine).position_mm
    tools = np.array([[0.0, 0.0, -100.0], [80.0, 0.0, -100.0], [0.0, 90.0, -180.0]])
    ranks = []
    for count in (1, 2, 3):
        points = Points(np.tile(grid, (count, 1)), np.repeat(tools[:count], len(grid), axis=0))
        ranks.append(plan(machine, stations_of(), points, NOISE).determined)
    assert ranks == [False, False, True]


# --- reports -------------------------------------------------------------------------------------------------------


def test_nodes_without_data_are_named_and_the_rest_is_predicted():
    machine = gantry(5, prior=NO_PRIOR)
    grid = points_of(machine).position_mm
    points = Points(grid[np.abs(grid[:, 0] + 400.0) > 1.0])
    result = plan(machine, stations_of(), points, NOISE)
    assert result.nodes_without_data == {"X": [-400.0]}
    assert result.rank.size - result.rank.rank == 5  # the five curves of X
    for name, curve in result.errors.curves.items():
        expected = [-400.0] if name[2] == "X" else []
        assert curve.position_mm[np.isnan(curve.u)].tolist() == expected
    report = result.summary()
    assert report["determined"] is False
    assert report["curves"]["EXX"]["u_max"] is None
    assert report["curves"]["EYY"]["u_max"] > 0
    assert report["volume"]["undetermined_points"] == 3 * 9 * 9
    assert report["volume"]["u_max_um"] is None


def test_with_a_prior_what_the_readings_do_not_determine_has_what_is_assumed_of_it():
    """No u is missing or zero: along three lines through a corner, angles have no lever, and keep the size of their class."""
    machine = gantry(5, prior=PriorSettings(class_name="large", learn="no"))
    result = plan(machine, stations_of(), corner_lines(machine), NOISE)
    assert not result.determined
    assert set(result.open_errors) == {"EAX", "EBX", "EAY", "EBY", "ECY"}
    report = result.summary()
    assert report["prior"]["class"] == "large"
    assert "angles up to 72 urad" in report["assumed"]
    far = machine.axes[0].range_mm[
        0
    ]  # two correlation lengths and more from the reference point, where the curve is zero
    assert report["curves"]["EAX"]["determined"] is False
    assert report["curves"]["EAX"]["at_mm"] == far
    assert report["curves"]["EAX"]["u_max"] == pytest.approx(36.0 * np.sqrt(2.0), rel=0.02)
    assert report["curves"]["EXX"]["determined"] is True
    assert report["volume"]["undetermined_points"] == 0
    assert report["volume"]["u_rms_um"] > 20.0


def test_as_many_readings_as_unknowns_leave_nothing_to_check():
    machine = gantry(2)
    result = plan(machine, stations_of(3), points_of(machine), NOISE)
    assert (result.readings, result.rank.rank, result.rank.size) == (24, 23, 23)
    assert result.determined
    full = replace(result, rank=replace(result.rank, rank=24, size=24))
    assert not full.determined
    assert "no redundancy" in full.reasons[0]


def test_every_set_up_adds_an_unknown_constant():
    machine = gantry(4)
    one = stations_of()
    passes = np.concatenate([one.passes, [[2, 1]]])
    two = replace(one, passes=passes)
    first, second = (plan(machine, stations, points_of(machine), NOISE) for stations in (one, two))
    assert second.rank.size == first.rank.size + 1
    assert second.determined
    assert second.volume.worst_um < first.volume.worst_um


def test_points_outside_the_travel_and_stations_in_the_target_are_refused():
    machine = gantry(4)
    with pytest.raises(InputError, match=r"point 2\) is outside the travel"):
        plan(machine, stations_of(), Points(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])))
    with pytest.raises(InputError, match="'A' coincides with the target"):
        plan(machine, planned_stations({**PLACES, "A": [0.0, 0.0, 0.0]}), points_of(machine))


# --- regions and search --------------------------------------------------------------------------------------------


def test_places_of_the_shell_lie_around_the_table_and_come_back():
    machine = gantry(4, tool_offset_mm=(30.0, 0.0, -120.0))
    shell = shell_around(machine)
    rng = np.random.default_rng(3)
    for unit in rng.uniform(0.0, 1.0, (200, 3)):
        place = shell.place(unit)
        outside = np.max(np.abs(place[:2] - [-370.0, -500.0]) - [400.0, 500.0])
        assert 100.0 - 1e-9 <= outside <= 600.0 + 1e-9
        assert -470.0 <= place[2] <= -170.0
        assert np.allclose(shell.unit(place), unit, rtol=0, atol=1e-9)
    inside = shell.place(shell.unit(np.array([-380.0, -990.0, 0.0])))
    assert np.allclose(inside, [-380.0, -1100.0, -170.0], rtol=0, atol=30.0)  # out of the nearest side


def test_a_box_gives_its_own_places_only():
    box = Box(np.array([0.0, -5.0, 7.0]), np.array([10.0, 5.0, 7.0]))
    assert np.allclose(box.place(np.array([0.25, 1.0, 0.6])), [2.5, 5.0, 7.0])
    assert np.allclose(box.unit(np.array([2.5, 99.0, 3.0])), [0.25, 1.0, 0.0])


def search_setup(**places):
    machine = gantry(4)
    stations = planned_stations({**PLACES, **places})
    found = planned(machine, stations, points_of(machine), planned_noise(NOISE))
    return machine, stations, found


def test_the_criterion_of_the_search_is_that_of_the_plan():
    machine, stations, found = search_setup()
    search = _Search(found, regions_of(machine, stations, {}), "worst", 10)
    value = search.at(stations.position_mm)
    result = plan(machine, stations, points_of(machine), NOISE)
    on_grid = len(search.rows)
    assert on_grid <= 200
    assert value <= result.from_readings.worst_um * (1 + 1e-9)
    assert value == pytest.approx(result.from_readings.worst_um, rel=0.1)


@pytest.mark.parametrize("criterion", ["worst", "rms"])
def test_the_search_improves_a_poor_arrangement_within_its_boxes(criterion):
    poor = {"A": [300.0, -1500.0, -350.0], "B": [0.0, -1500.0, -350.0], "C": [-400.0, -1500.0, -349.0]}
    machine, stations, found = search_setup(**poor, D=[-800.0, -1500.0, -300.0])
    boxes = {"B": Box(np.array([-100.0, -1600.0, -350.0]), np.array([100.0, -1400.0, -100.0]))}
    regions = regions_of(machine, stations, boxes)
    result = suggest(found, regions, criterion=criterion, evaluations=80, seed=4)
    assert result.improved
    assert result.found_um < 0.5 * result.start_um
    assert result.evaluations <= 80
    before = plan(machine, stations, points_of(machine), NOISE).volume
    after = result.plan.volume
    assert (after.worst_um < before.worst_um) if criterion == "worst" else (after.rms_um < before.rms_um)
    places = result.plan.planned.stations.position_mm
    for region, place in zip(regions, places, strict=True):
        assert np.allclose(region.place(region.unit(place)), place, rtol=0, atol=1e-6)
    again = suggest(found, regions, criterion=criterion, evaluations=80, seed=4)
    assert np.array_equal(again.plan.planned.stations.position_mm, places)


def test_the_search_never_ends_worse_than_it_began():
    machine, stations, found = search_setup()
    tight = {name: Box(np.array(place) - 1.0, np.array(place) + 1.0) for name, place in PLACES.items() if name != "D"}
    tight["D"] = Box(np.array([0.0, -1900.0, -350.0]), np.array([10.0, -1890.0, -350.0]))
    result = suggest(found, regions_of(machine, stations, tight), evaluations=20)
    assert not result.improved
    assert result.found_um == result.start_um
    assert np.array_equal(result.plan.planned.stations.position_mm, stations.position_mm)


def test_trajectories_are_judged_from_the_smallest_on():
    machine = gantry(6)
    candidates = candidate_trajectories(machine)
    sizes = [len(points) for points in candidates.values()]
    assert sizes == sorted(sizes)
    assert len(candidates["12 edges"]) == 8 + 12 * 4
    assert len(candidates["full grid"]) == 6**3
    assert len(candidates["6 faces"]) == 6**3 - 4**3
    assert all(len(np.unique(points, axis=0)) == len(points) for points in candidates.values())
    noise = planned_noise(NOISE)
    judged, chosen = judge_trajectories(machine, stations_of(), noise, target_um=1e-3)
    assert chosen is None
    assert [item.name for item in judged] == list(candidates)
    target_um = judged[2].worst_um * 1.001
    judged, chosen = judge_trajectories(machine, stations_of(), noise, target_um=target_um)
    assert chosen is judged[-1]
    assert chosen.worst_um <= target_um
    assert all(item.worst_um > target_um for item in judged[:-1])
    with pytest.raises(InputError, match="the target is"):
        judge_trajectories(machine, stations_of(), noise, target_um=0.0)


# --- files ---------------------------------------------------------------------------------------------------------


def test_stations_survive_writing_with_their_set_ups(tmp_path):
    stations = replace(stations_of(), passes=np.array([[0, 0], [0, 1], [1, 0], [2, 5], [3, 0]]))
    path = tmp_path / "s.csv"
    path.write_text(format_stations(stations, gantry(4)))
    again = read_stations(path)
    assert again.names == stations.names
    assert np.array_equal(again.passes, stations.passes)
    assert np.allclose(again.position_mm, stations.position_mm)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("A,0,0,0,0\nA,0,0,0,0\n", "is listed twice"),
        ("A,0,0,0,0\nA,5,0,0,1\n", "at a different position than in line 2"),
        ("A,0,0,x,0\n", "column z_mm"),
    ],
)
def test_stations_that_contradict_themselves_are_refused(tmp_path, rows, message):
    path = tmp_path / "s.csv"
    path.write_text("station,x_mm,y_mm,z_mm,setup\n" + rows)
    with pytest.raises(InputError, match=message):
        read_stations(path)


def test_boxes_are_read_strictly(tmp_path):
    path = tmp_path / "b.csv"
    header = "station,x_min_mm,x_max_mm,y_min_mm,y_max_mm,z_min_mm,z_max_mm\n"
    path.write_text(header + "A,0,10,-5,5,7,7\n")
    assert np.array_equal(read_boxes(path)["A"].upper_mm, [10.0, 5.0, 7.0])
    path.write_text(header + "A,0,10,5,-5,7,7\n")
    with pytest.raises(InputError, match="column y_min_mm: 5 is above"):
        read_boxes(path)
    with pytest.raises(InputError, match="belongs to no station"):
        regions_of(gantry(4), stations_of(), {"AA": Box(np.zeros(3), np.ones(3))})
    label, box = box_from_text("LT:1:0,10,-5,5,7,8")
    assert (label, box.lower_mm.tolist()) == ("LT:1", [0.0, -5.0, 7.0])
    for text in ("A", "A:1,2,3", "A:1,2,3,4,5,nan", ":1,2,3,4,5,6", "A:2,1,3,4,5,6"):
        with pytest.raises(InputError, match="--box"):
            box_from_text(text)


# --- command line --------------------------------------------------------------------------------------------------


@pytest.fixture
def stations_file(call, small_machine_file, small_lengths_file, tmp_path):
    """What identify wrote about the stations."""
    out = tmp_path / "identified"
    assert call("identify", small_machine_file, small_lengths_file, "--out", out)[0] == 0
    return out / "stations.csv"


def test_plan_reads_the_stations_of_identify_and_predicts_its_uncertainties(
    call, small_machine_file, stations_file, tmp_path
):
    out = tmp_path / "plan"
    noise = ("--u-length-um", "0.1", "--u-length-um-per-m", "0.15")
    words = ("plan", small_machine_file, "--stations", stations_file, "--grid", "--out", out, *noise)
    code, stdout, stderr = call(*words, "--json")
    assert (code, stderr) == (0, "")
    assert sorted(path.name for path in out.iterdir()) == ["plan.errors.csv", "plan.json"]
    report = json.loads((out / "plan.json").read_text())
    assert report == json.loads(stdout)
    found = read_errors(stations_file.parent / "identified.errors.csv")
    predicted = read_errors(out / "plan.errors.csv")
    scaled = json.loads((stations_file.parent / "identify.json").read_text())["u_length"]["scaled_by"]
    assert predicted.names == found.names
    for name, curve in predicted.curves.items():  # there and back: two readings of every point
        expected = found.curves[name].u * np.sqrt(2) / scaled
        assert np.allclose(curve.u, expected, rtol=2e-3, atol=1e-9), name
        assert not curve.value.any()
    code, stdout, _ = call(*words)
    assert code == 0
    assert "u of E, max / rms" in stdout
    assert all(len(line.rstrip()) <= 130 for line in stdout.splitlines())


def test_plan_says_by_its_exit_code_what_is_not_determined(call, small_machine_file, stations_file, tmp_path):
    lines_kept = stations_file.read_text().splitlines()
    two = tmp_path / "two.csv"
    header, *rows = [line for line in lines_kept if not line.startswith("#")]
    two.write_text("\n".join([header, *rows[:2]]) + "\n")
    out = tmp_path / "plan"
    code, stdout, _ = call("plan", small_machine_file, "--stations", two, "--grid", "--out", out, "--json")
    report = json.loads(stdout)
    assert (code, report["determined"]) == (1, False)
    assert report["undetermined_directions"] > 0
    assert any("cannot be distinguished" in reason for reason in report["reasons"])
    assert (out / "plan.json").exists()
    assert "not determined" in call("plan", small_machine_file, "--stations", two, "--grid", "--out", out)[1]


def test_plan_suggests_and_proposes(call, small_machine_file, stations_file, tmp_path):
    out = tmp_path / "plan"
    words = ("plan", small_machine_file, "--stations", stations_file, "--grid", "--out", out)
    search = ("--suggest", "--evaluations", "40", "--box", "S1:-600,-420,-300,-210,-420,-100", "--target-um", "1.0")
    code, stdout, _ = call(*words, *search, "--json")
    report = json.loads(stdout)
    assert code == 0
    assert report["suggestion"]["criterion_after_um"] < report["suggestion"]["criterion_before_um"]
    first = read_stations(out / "suggested.stations.csv").position_mm[0]
    assert np.all(first >= [-600.001, -300.001, -420.001])
    assert np.all(first <= [-419.999, -209.999, -99.999])
    names = [item["name"] for item in report["trajectories"]]
    assert report["proposed"] == names[-1]
    assert report["trajectories"][-1]["u_max_um"] <= 1.0
    assert len(read_points(out / "proposed.points.csv")) == report["trajectories"][-1]["points"]
    code, stdout, _ = call(*words, "--target-um", "0.0001", "--json")
    assert (code, json.loads(stdout)["proposed"]) == (1, None)
    assert "suggested station positions" in call(*words, *search)[1]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ((), "either --points FILE or --grid"),
        (("--grid", "--points", "p.csv"), "either --points FILE or --grid"),
        (("--grid", "--box", "S1:0,1,0,1,0,1"), "--box and --boxes need --suggest"),
        (("--grid", "--suggest", "--box", "S9:0,1,0,1,0,1"), "belongs to no station"),
        (("--grid", "--u-length-um", "-1"), "-1 is not a standard uncertainty"),
        (("--grid", "--target-um", "-1"), "the target is -1"),
    ],
)
def test_wrong_usage_writes_nothing(call, small_machine_file, stations_file, tmp_path, extra, message):
    out = tmp_path / "plan"
    code, _, stderr = call("plan", small_machine_file, "--stations", stations_file, "--out", out, *extra)
    assert code == 2
    assert message in stderr
    assert not out.exists()
