"""Identification: against independent least squares with scipy, for any chain, with tools, gaps and bad readings."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import machines
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import CHAINS, Axis, Chain, Machine
from compgen.data.names import CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.errors import CompgenWarning, ConvergenceError, InputError, UndeterminedError
from compgen.identification import IdentifyOptions, identify
from compgen.identification.adjust.grid_problem import GridProblem, grid_problem
from compgen.identification.adjust.problem import length_problem
from compgen.identification.adjust.unknowns import State, error_parameters
from compgen.kinematics import exact_error, modelled_errors
from compgen.kinematics.exact_chain import tip_position

NANOMETRE = 1e-6  # mm
MICROMETRE = 1e-3
STATIONS = np.array([[400.0, -900.0, 50.0], [-700.0, -800.0, 100.0], [900.0, 700.0, -150.0], [-100.0, 1300.0, 600.0]])
DEAD_MM = np.array([310.0, 402.5, 250.25, 501.125])


def machine_of(chain="WFYXZT", counts=(5, 4, 6), **fields):
    ranges = ((-420.0, 130.0), (50.0, 650.0), (-300.0, 0.0))
    return machines.machine_of(ranges, counts, chain, reference_point_mm=(0.0, 50.0, -100.0), **fields)


def truth_of(machine, seed=1, names=None, squareness_urad=300.0):
    """Errors in the gauge of the model: straightness zero at both ends, the others at the reference point."""
    rng = np.random.default_rng(seed)
    curves, squareness = {}, {}
    for name in names or modelled_errors(machine):
        if name in SQUARENESS_NAMES:
            squareness[name] = (rng.normal(0, squareness_urad * 1e-6), 0.0)
            continue
        error = error_named(name)
        nodes = machine.axes[error.axis].nodes_mm
        value = rng.normal(0, 1.0, len(nodes))
        if error.is_straightness:
            line = np.interp(nodes, [nodes[0], nodes[-1]], [value[0], value[-1]])
            value = value - line
        else:
            value = value - np.interp(machine.reference_point_mm[error.axis], nodes, value)
        curves[name] = Curve(nodes, value * (0.012 if error.kind == "linear" else 15e-6), np.zeros(len(nodes)))
    return ErrorTable(curves, squareness)


def grid_of(machine):
    return np.stack(np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij"), -1).reshape(-1, 3)


def measured(machine, truth, *, sigma_mm=0.0, seed=2, stations=STATIONS, positions=None, tools=None, keep=1.0, runs=1):
    rng = np.random.default_rng(seed)
    positions = grid_of(machine) if positions is None else positions
    tools = [None] if tools is None else tools
    blocks = []
    for run in range(runs):
        for tool in tools:
            tool_mm = np.array(machine.tool_offset_mm if tool is None else tool)
            tip = positions + tool_mm + exact_error(machine, truth, positions, tool_mm)
            distance = np.linalg.norm(tip[:, None] - stations, axis=2)
            for k in range(len(stations)):
                reading = distance[:, k] - DEAD_MM[k % 4] + sigma_mm * rng.standard_normal(len(tip))
                blocks.append((np.full(len(tip), k), np.arange(len(tip)), positions, reading, tool_mm, run))
    station = np.concatenate([block[0] for block in blocks])
    point = np.concatenate([block[1] for block in blocks])
    tool = np.concatenate([np.broadcast_to(block[4], block[2].shape) for block in blocks])
    lengths = Lengths(
        stations=tuple(f"LT{k + 1}" for k in range(len(stations))),
        station=station,
        point=[str(p) for p in point],
        position_mm=np.concatenate([block[2] for block in blocks]),
        length_mm=np.concatenate([block[3] for block in blocks]),
        tool_mm=tool if tools != [None] else None,
        labels={"run": np.concatenate([np.full(len(block[0]), block[5]) for block in blocks])},
        metadata={"u_length_um": str(sigma_mm * 1e3)} if sigma_mm else {},
    )
    if keep < 1.0:
        rows = np.flatnonzero(rng.random(len(station)) < keep)
        lengths = lengths.part(rows)
    return lengths


def deviations(found, truth):
    """Largest deviation of linear curves in mm and of rotations in rad, and all |deviation|/u."""
    linear, angular, standardised = [0.0], [0.0], []
    for name in found.names:
        if name in found.curves:
            curve = found.curves[name]
            difference = curve.value - truth.curves[name].at(curve.position_mm)
            standardised += list(np.abs(difference)[curve.u > 0] / curve.u[curve.u > 0])
        else:
            value, u = found.squareness[name]
            difference = np.array([value - truth.squareness[name][0]])
            standardised += [abs(difference[0]) / u]
        (linear if error_named(name).kind == "linear" else angular).append(np.abs(difference).max())
    return max(linear), max(angular), np.array(standardised)


@pytest.mark.parametrize("chain", CHAINS)
def test_noise_free_lengths_give_the_errors_back_on_every_chain(chain):
    machine = machine_of(chain, counts=(4, 4, 4), tool_offset_mm=(20.0, -30.0, -150.0))
    truth = truth_of(machine, squareness_urad=2900.0)
    result = identify(machine, measured(machine, truth))
    linear, angular, _ = deviations(result.errors, truth)
    assert set(result.errors.names) == set(modelled_errors(machine))
    assert linear < NANOMETRE
    assert angular < 1e-9
    assert result.rank == result.unknowns


@pytest.mark.parametrize("reference", ["X", "Y"])
def test_stations_and_dead_lengths_come_back_as_well(reference):
    machine = machine_of(squareness_reference=reference)
    result = identify(machine, measured(machine, truth_of(machine)))
    for k, station in enumerate(result.stations):
        assert np.allclose(station.position_mm, STATIONS[k], rtol=0, atol=NANOMETRE)
        assert station.dead_length_mm == pytest.approx(DEAD_MM[k], abs=NANOMETRE)


def independent_optimum(machine, lengths, names):
    """The same sum of squares with scipy's solver, numeric derivative and a readable parametrisation."""
    poses, pose = np.unique(lengths.position_mm, axis=0, return_inverse=True)
    slots = []
    for name in names:
        if name in CURVE_NAMES:
            nodes = machine.axes[error_named(name).axis].nodes_mm
            held = [0, len(nodes) - 1] if error_named(name).is_straightness else [0]
            slots += [(name, k) for k in range(len(nodes)) if k not in held]
        else:
            slots.append((name, None))
    unit = np.array([1.0 if name[1] in "XYZ" else 1e-3 for name, _ in slots])

    def table(x):
        curves = {n: np.zeros(len(machine.axes[error_named(n).axis].nodes_mm)) for n in names if n in CURVE_NAMES}
        squareness = {}
        for (name, k), value in zip(slots, x * unit, strict=True):
            if k is None:
                squareness[name] = (value, 0.0)
            else:
                curves[name][k] = value
        nodes = {n: machine.axes[error_named(n).axis].nodes_mm for n in curves}
        return ErrorTable({n: Curve(nodes[n], v, 0 * v) for n, v in curves.items()}, squareness)

    def residual(x):
        tip = tip_position(machine, table(x[: len(slots)]).at(poses), poses)
        stations = x[len(slots) : len(slots) + 12].reshape(4, 3)
        distance = np.linalg.norm(tip[pose.ravel()] - stations[lengths.station], axis=1)
        return distance - x[len(slots) + 12 :][lengths.station] - lengths.length_mm

    x0 = np.concatenate([np.zeros(len(slots)), STATIONS.ravel() + 0.3, DEAD_MM - 0.2])
    found = least_squares(residual, x0, method="lm", jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    return table(found.x[: len(slots)]), found.cost


def test_the_optimum_is_that_of_scipy():
    ranges = ((-400.0, 0.0), (-500.0, 0.0), (-300.0, 0.0))
    axes = tuple(Axis(r, np.linspace(*r, 4)) for r in ranges)
    machine = Machine("m", Chain("WXFYZT"), axes, reference_point_mm=tuple(r[0] for r in ranges))
    truth = truth_of(machine, squareness_urad=2900.0)
    lengths = measured(machine, truth, sigma_mm=0.3 * MICROMETRE)
    result = identify(machine, lengths, IdentifyOptions(u_length_um=0.3, u_length_um_per_m=0.0, reject=False))
    reference, cost = independent_optimum(machine, lengths, result.errors.names)
    assert 0.5 * np.sum(result.residual_mm**2) == pytest.approx(cost, rel=1e-9)
    for name in result.errors.names:
        if name in result.errors.curves:
            difference = result.errors.curves[name].value - reference.curves[name].value
        else:
            difference = result.errors.squareness[name][0] - reference.squareness[name][0]
        assert np.max(np.abs(difference)) < NANOMETRE * (1 if error_named(name).kind == "linear" else 1e-3), name


@pytest.mark.parametrize("chain", CHAINS[::3])
@pytest.mark.parametrize("several_tools", [False, True])
def test_the_grid_path_has_cost_gradient_and_matrix_of_the_plain_one(chain, several_tools):
    rng = np.random.default_rng(5)
    machine = machine_of(chain, tool_offset_mm=(10.0, -20.0, -150.0))
    tools = np.array([[0.0, 0.0, -100.0], [50.0, 0.0, -100.0], [0.0, 60.0, -150.0]])
    layout = error_parameters(
        machine, modelled_errors(machine, tools if several_tools else None), several_tools=several_tools
    )
    position = np.repeat(grid_of(machine)[rng.permutation(120)[:70]], 8, axis=0)
    station = np.tile(np.arange(4), len(position) // 4)
    tool = tools[rng.integers(0, 3, len(position))] if several_tools else None
    reading = rng.uniform(500, 900, len(position))
    lengths = Lengths(tuple("abcd"), station, ["p"] * len(position), position, reading, tool_mm=tool)
    weight = rng.uniform(0.5, 2.0, len(position))
    plain = length_problem(machine, lengths, layout)
    used = np.array(machine.tool_offset_mm) if tool is None else tool
    fast = grid_problem(layout, position, used, station, plain.group, reading)
    assert isinstance(fast, GridProblem)
    plain, fast = plain.weighted(weight), fast.weighted(weight)
    state = State(rng.normal(0, 1e-3, layout.size), STATIONS, DEAD_MM)
    (cost, gradient), (fast_cost, fast_gradient) = plain.evaluate(state), fast.evaluate(state)
    assert fast_cost == pytest.approx(cost, rel=1e-12)
    assert np.max(np.abs(fast_gradient - gradient)) < 1e-12 * np.max(np.abs(gradient))
    assert np.allclose(plain.residuals(state), fast.residuals(state), rtol=0, atol=1e-11)
    start = State(np.zeros(layout.size), STATIONS, DEAD_MM)
    matrix, fast_matrix = plain.normal_matrix(start), fast.normal_matrix(start)
    root = np.sqrt(np.diag(matrix))
    assert np.max(np.abs(matrix - fast_matrix) / root / root[:, None]) < 1e-12


def test_scattered_points_give_the_same_errors_as_a_grid():
    machine = machine_of(counts=(4, 4, 4))
    truth = truth_of(machine)
    rng = np.random.default_rng(3)
    scattered = rng.uniform(machine.lower_mm, machine.upper_mm, (300, 3))
    linear, angular, _ = deviations(identify(machine, measured(machine, truth, positions=scattered)).errors, truth)
    assert linear < NANOMETRE
    assert angular < 1e-9


def test_uneven_nodes_missing_readings_and_repeats():
    machine = machine_of()
    uneven = Axis((-420.0, 130.0), np.array([-420.0, -350.0, -200.0, 10.0, 130.0]))
    machine = replace(machine, axes=(uneven, *machine.axes[1:]))
    truth = truth_of(machine)
    result = identify(machine, measured(machine, truth, keep=0.6, runs=2))
    linear, angular, _ = deviations(result.errors, truth)
    assert linear < NANOMETRE
    assert angular < 1e-9
    assert np.array_equal(result.errors.curves["EXX"].position_mm, uneven.nodes_mm)


def test_the_stated_uncertainty_covers_and_chi_square_is_one():
    machine = machine_of()
    truth = truth_of(machine)
    inside, chi_squares = [], []
    for seed in range(12):
        result = identify(machine, measured(machine, truth, sigma_mm=0.2 * MICROMETRE, seed=seed, runs=2))
        inside.append(np.mean(deviations(result.errors, truth)[2] < 1.96))
        chi_squares.append(result.reduced_chi_square)
        assert result.u_source == "stated"
    assert 0.92 < np.mean(inside) < 0.98
    assert np.mean(chi_squares) == pytest.approx(1.0, abs=0.03)


def test_unstated_noise_is_taken_from_the_residuals():
    machine = machine_of()
    lengths = measured(machine, truth_of(machine), sigma_mm=0.5 * MICROMETRE)
    stated = identify(machine, lengths)
    assumed = identify(machine, replace(lengths, metadata={}), IdentifyOptions())
    assert assumed.u_source == "assumed"
    ratio = assumed.errors.curves["EXX"].u.max() / stated.errors.curves["EXX"].u.max()
    assert ratio == pytest.approx(1.0, abs=0.15)


def test_three_tools_show_all_21_errors_without_bias_on_the_constants():
    tools = [(0.0, 0.0, -100.0), (80.0, 0.0, -100.0), (0.0, 90.0, -180.0)]
    machine = machine_of(counts=(4, 4, 4), errors=21, tool_offset_mm=tools[0])
    truth = truth_of(machine)
    shifted = dict(truth.curves)
    for name, constant in (("EAZ", 21e-6), ("EBZ", -13e-6), ("ECZ", 8e-6)):
        curve = shifted[name]
        shifted[name] = Curve(curve.position_mm, curve.value + constant, curve.u)
    truth = ErrorTable(shifted, truth.squareness)
    result = identify(machine, measured(machine, truth, tools=tools))
    linear, angular, _ = deviations(result.errors, truth)
    assert len(result.errors.names) == 21
    assert linear < NANOMETRE
    assert angular < 1e-9


def test_set_ups_have_dead_lengths_of_their_own():
    machine = machine_of()
    lengths = measured(machine, truth_of(machine), runs=2)
    setup = lengths.labels["run"]
    moved = replace(lengths, length_mm=lengths.length_mm + 7.5 * setup, labels={"setup": setup})
    result = identify(machine, moved)
    assert len(result.stations) == 8
    by_key = {(item.station, item.setup): item.dead_length_mm for item in result.stations}
    assert by_key["LT2", 0] - by_key["LT2", 1] == pytest.approx(7.5, abs=NANOMETRE)


def test_stations_may_be_metres_away_and_points_of_one_station_in_a_plane():
    machine = machine_of()
    far = STATIONS * 4.0
    truth = truth_of(machine)
    lengths = measured(machine, truth, stations=far)
    in_plane = np.abs(lengths.position_mm[:, 2] + 300.0) < 1e-9
    lengths = lengths.part(np.flatnonzero((lengths.station != 3) | in_plane))
    result = identify(machine, lengths)
    assert np.allclose(result.stations[0].position_mm, far[0], rtol=0, atol=1e-4)
    assert deviations(result.errors, truth)[0] < 0.05 * MICROMETRE


def test_disturbed_readings_are_listed_with_the_reason_and_do_no_harm():
    machine = machine_of()
    truth = truth_of(machine)
    lengths = measured(machine, truth, sigma_mm=0.2 * MICROMETRE, runs=2)
    clean = identify(machine, lengths)
    reading, station = lengths.length_mm.copy(), lengths.station.copy()
    broken = [11, 300]
    reading[broken] += [2.5, -0.004]
    station[77] = (station[77] + 1) % 4
    result = identify(machine, replace(lengths, length_mm=reading, station=station))
    reasons = {item.row: item.reason for item in result.rejected}
    assert set(reasons) == {11, 77, 300}
    assert "beam break" in reasons[11]
    assert "station" in reasons[77]
    assert result.reduced_chi_square == pytest.approx(clean.reduced_chi_square, abs=0.05)
    with pytest.warns(CompgenWarning, match="does not describe the readings"):
        kept = identify(machine, replace(lengths, length_mm=reading, station=station), IdentifyOptions(reject=False))
    assert not kept.rejected
    assert kept.reduced_chi_square > 100 * result.reduced_chi_square


def test_cubic_curves_come_back_between_the_nodes():
    machine = machine_of(counts=(7, 7, 7), curves="cubic")
    fine = machine_of(counts=(25, 25, 25))
    shapes = {"EXX": 0.01, "EYX": 0.008, "EBY": 2e-5}
    curves = {}
    for name, size in shapes.items():
        nodes = fine.axes[error_named(name).axis].nodes_mm
        s = (nodes - nodes[0]) / np.ptp(nodes)
        value = size * (s**3 - s) if error_named(name).is_straightness else size * s**2
        value = value - (0 if error_named(name).is_straightness else np.interp(*_reference(machine, name), value))
        curves[name] = Curve(nodes, value, 0 * nodes)
    truth = ErrorTable(curves)
    result = identify(machine, measured(machine, truth))
    for name in shapes:
        curve = result.errors.curves[name]
        difference = np.abs(curve.value - truth.curves[name].at(curve.position_mm)).max()
        assert difference < 0.01 * shapes[name]


def _reference(machine, name):
    axis = error_named(name).axis
    nodes = machine_of(counts=(25, 25, 25)).axes[axis].nodes_mm
    return machine.reference_point_mm[axis], nodes


def test_two_stations_are_refused():
    machine = machine_of()
    with pytest.raises(InputError, match=r"2 station.*at least 3"):
        identify(machine, measured(machine, truth_of(machine), stations=STATIONS[:2]))


def test_nodes_without_data_are_named():
    machine = machine_of(counts=(5, 4, 6))
    coarse = machine_of(counts=(3, 4, 6))
    lengths = measured(machine, truth_of(machine), positions=grid_of(coarse))
    with pytest.raises(UndeterminedError, match="no data at all") as caught:
        identify(machine, lengths)
    assert "EXX at -282.5 mm" in str(caught.value)


def test_nodes_that_the_readings_determine_are_proposed_and_taken():
    """A machine file with more nodes than measured positions: the fewer ones give the errors that were measured."""
    machine, coarse = machine_of(counts=(9, 4, 11)), machine_of(counts=(3, 4, 6))
    truth = truth_of(coarse)
    lengths = measured(coarse, truth, positions=grid_of(coarse))
    with pytest.raises(UndeterminedError, match="no data at all") as caught:
        identify(machine, lengths)
    assert str(caught.value).startswith(
        "X = 3, Y = 4, Z = 6 nodes fit these readings (the machine file has 9, 4, 11): set nodes"
    )
    found = identify(machine, lengths, IdentifyOptions(nodes="from-data"))
    for name in truth.curves:
        np.testing.assert_allclose(found.errors.curves[name].value, truth.curves[name].value, atol=NANOMETRE)
    # where the nodes of the machine file fit, they stay
    again = identify(coarse, lengths, IdentifyOptions(nodes="from-data"))
    np.testing.assert_array_equal(
        again.errors.curves["EXX"].value, identify(coarse, lengths).errors.curves["EXX"].value
    )


def test_fewer_nodes_are_at_measured_positions_where_equal_steps_do_not_fit():
    coarse = machine_of(counts=(5, 4, 6))
    positions = grid_of(coarse)
    uneven = {-282.5: -400.0, -145.0: -380.0, -7.5: -350.0}  # X was measured near its lower end, and at both ends
    positions[:, 0] = [uneven.get(round(x, 6), x) for x in positions[:, 0]]
    lengths = measured(coarse, truth_of(machine_of(counts=(2, 4, 6))), positions=positions)
    found = identify(machine_of(counts=(9, 4, 6)), lengths, IdentifyOptions(nodes="from-data"))
    np.testing.assert_allclose(found.errors.curves["EXX"].position_mm, [-420.0, -400.0, -380.0, -350.0, 130.0])
    assert found.rms_um < 1e-3


def test_an_axis_that_did_not_move_is_named_first():
    machine = machine_of()
    positions = grid_of(machine)
    with pytest.raises(
        UndeterminedError, match=r"^Z did not move \(all readings at -300 mm\): measure at several positions"
    ):
        identify(machine, measured(machine, truth_of(machine), positions=positions[positions[:, 2] == -300.0]))


def test_two_stations_in_one_place_are_named_first():
    machine = machine_of()
    stations = STATIONS.copy()
    stations[1] = stations[0]
    lengths = measured(machine, truth_of(machine), stations=stations[:3])
    first, second, _ = lengths.stations
    with pytest.raises((UndeterminedError, ConvergenceError)) as caught:
        identify(machine, lengths)
    assert f"the stations {first} and {second} are in one place (0.0 mm apart), which counts once" in str(caught.value)


def test_positions_in_metres_are_recognised():
    machine = machine_of()
    machine = replace(machine, axes=tuple(replace(axis, range_mm=(-420.0, 650.0)) for axis in machine.axes))
    lengths = measured(machine, truth_of(machine))
    with pytest.raises(InputError, match=r"look like metres: they span 0\.6 of 1070 mm of Y; convert them to mm"):
        identify(machine, replace(lengths, position_mm=lengths.position_mm / 1000.0))


def test_three_lines_through_a_corner_do_not_determine_the_errors():
    machine = machine_of(counts=(4, 4, 4))
    lines = [p for p in grid_of(machine) if np.count_nonzero(np.isclose(p, machine.lower_mm)) >= 2]
    with pytest.raises(UndeterminedError, match="distinguished|no data"):
        identify(machine, measured(machine, truth_of(machine), positions=np.array(lines)))


def test_positions_outside_the_travel_point_at_the_axis():
    machine = machine_of()
    lengths = measured(machine, truth_of(machine))
    swapped = replace(lengths, position_mm=lengths.position_mm[:, [1, 0, 2]])
    with pytest.raises(InputError, match="outside the travel"):
        identify(machine, swapped)


def test_the_input_is_not_changed():
    machine = machine_of()
    lengths = measured(machine, truth_of(machine))
    before = lengths.length_mm.copy(), lengths.position_mm.copy()
    identify(machine, lengths)
    assert np.array_equal(before[0], lengths.length_mm)
    assert np.array_equal(before[1], lengths.position_mm)


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WZYXFT"])
def test_compiled_loops_and_numpy_agree(chain, monkeypatch):
    pytest.importorskip("numba", reason="the compiled loops are an optional extra")
    machine = machine_of(chain, tool_offset_mm=(10.0, -20.0, -150.0))
    lengths = measured(machine, truth_of(machine), sigma_mm=0.2 * MICROMETRE, keep=0.8)
    results = []
    for form in ("plain", "compiled"):
        monkeypatch.setenv("COMPGEN_KERNELS", form)
        problem = grid_problem(
            error_parameters(machine, modelled_errors(machine)),
            lengths.position_mm,
            np.array(machine.tool_offset_mm),
            lengths.station,
            lengths.station,
            lengths.length_mm,
        )
        assert problem.compiled == (form == "compiled")
        state = State(np.random.default_rng(4).normal(0, 1e-4, problem.parameters.size), STATIONS, DEAD_MM)
        results.append((*problem.evaluate(state), problem.normal_matrix(state)))
    (cost, gradient, matrix), (fast_cost, fast_gradient, fast_matrix) = results
    assert fast_cost == pytest.approx(cost, rel=1e-13)
    assert np.max(np.abs(fast_gradient - gradient)) < 1e-12 * np.max(np.abs(gradient))
    root = np.sqrt(np.diag(matrix))
    assert np.max(np.abs(fast_matrix - matrix) / root / root[:, None]) < 1e-13
