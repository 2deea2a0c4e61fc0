"""The fast path on grids: compiled loops against numpy, and both against plain algebra."""

import warnings

import numpy as np
import pytest
from scipy.linalg import LinAlgError

import machines
from compgen.data.lengths import Lengths
from compgen.identification import identify
from compgen.identification.adjust.grid_problem import MOST_LEVELS, grid_problem, levels_of
from compgen.identification.adjust.problem import length_problem
from compgen.identification.adjust.solver import factorise
from compgen.identification.adjust.starts import start_moments
from compgen.identification.adjust.unknowns import State, error_parameters, parameters_for_tools
from compgen.identification.options import IdentifyOptions
from compgen.kinematics import modelled_errors

STATIONS = np.array([[120.0, -900.0, -260.0], [-90.0, -700.0, -310.0], [-500.0, 150.0, -120.0], [60.0, 90.0, 140.0]])
DEAD_MM = np.array([400.0, 500.0, 600.0, 700.0])


@pytest.fixture(params=[False, True], ids=["numpy", "compiled"])
def compiled(request, monkeypatch):
    """Whether the compiled loops are used."""
    if request.param:
        pytest.importorskip("numba", reason="the compiled loops are an optional extra")
    monkeypatch.setenv("COMPGEN_KERNELS", "compiled" if request.param else "plain")
    return request.param


def machine_of(chain="WFYXZT", counts=(5, 4, 3), **options):
    ranges = ((-400.0, 0.0), (-500.0, 0.0), (-200.0, 0.0))
    return machines.machine_of(ranges, counts, chain, name="grid", **options)


def readings_on(machine, levels=(6, 5, 4), repeats=2, tools_mm=None, seed=0):
    """Shuffled readings on most cells of a grid with levels between the nodes; some cells are read twice."""
    rng = np.random.default_rng(seed)
    steps = [np.linspace(*axis.range_mm, n) for axis, n in zip(machine.axes, levels, strict=True)]
    grid = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    position = np.repeat(grid, 4, axis=0)
    station = np.tile(np.arange(4), len(grid))
    rows = rng.permutation(np.concatenate([np.arange(len(position))] * repeats))[: int(1.5 * len(position))]
    tool = None if tools_mm is None else tools_mm[rng.integers(0, len(tools_mm), len(rows))]
    reading = np.linalg.norm(position - STATIONS[station], axis=1) - DEAD_MM[station]
    reading = reading[rows] + 1e-3 * rng.standard_normal(len(rows))
    return Lengths(tuple("abcd"), station[rows], ["p"] * len(rows), position[rows], reading, tool_mm=tool)


def both_problems(machine, lengths):
    """The same readings point by point and on the grid."""
    tool = np.array(machine.tool_offset_mm) if lengths.tool_mm is None else lengths.tool_mm
    layout = parameters_for_tools(machine, tool)
    plain = length_problem(machine, lengths, layout, lengths.station)
    return plain, grid_problem(layout, lengths.position_mm, tool, lengths.station, lengths.station, lengths.length_mm)


TOOLS = np.array([[0.0, 0.0, -100.0], [50.0, 0.0, -120.0], [0.0, 60.0, -150.0]])


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("tools", [None, TOOLS], ids=["one tool", "three tools"])
@pytest.mark.parametrize("curves", ["linear", "cubic"])
@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WZYXFT", "WFZXYT"])
def test_grid_and_points_pose_the_same_problem(chain, curves, tools):
    machine = machine_of(chain, counts=(5, 4, 4), curves=curves, tool_offset_mm=(10.0, -20.0, -150.0))
    lengths = readings_on(machine, tools_mm=tools)
    plain, fast = both_problems(machine, lengths)
    weight = np.random.default_rng(1).uniform(0.5, 2.0, len(lengths))
    plain, fast = plain.weighted(weight), fast.weighted(weight)
    rng = np.random.default_rng(2)
    state = State(rng.normal(0, 1e-4, plain.parameters.size), STATIONS.copy(), DEAD_MM.copy())
    (cost, gradient), (fast_cost, fast_gradient) = plain.evaluate(state), fast.evaluate(state)
    assert fast_cost == pytest.approx(cost, rel=1e-12)
    assert np.max(np.abs(fast_gradient - gradient)) < 1e-11 * np.max(np.abs(gradient))
    assert np.allclose(fast.residuals(state), plain.residuals(state), rtol=0, atol=1e-11)
    assert np.allclose(fast.distances(state), plain.distances(state), rtol=0, atol=1e-11)
    upright = State(np.zeros(plain.parameters.size), STATIONS.copy(), DEAD_MM.copy())
    matrix, fast_matrix = plain.normal_matrix(upright), fast.normal_matrix(upright)
    root = np.sqrt(np.diag(matrix))
    assert np.max(np.abs(matrix - fast_matrix) / root / root[:, None]) < 1e-12


def test_a_missing_reading_at_a_station_that_stands_on_a_grid_point_disturbs_nothing(compiled):
    machine = machine_of()
    lengths = readings_on(machine, repeats=1)
    inside = np.array([lengths.position_mm[:, axis].mean() for axis in range(3)])
    inside = lengths.position_mm[np.argmin(np.linalg.norm(lengths.position_mm - inside, axis=1))]
    kept = ~((lengths.station == 3) & np.all(lengths.position_mm == inside, axis=1))
    lengths = Lengths(
        lengths.stations,
        lengths.station[kept],
        ["p"] * int(kept.sum()),
        lengths.position_mm[kept],
        lengths.length_mm[kept],
    )
    plain, fast = both_problems(machine, lengths)
    state = State(np.zeros(plain.parameters.size), np.vstack([STATIONS[:3], inside]), DEAD_MM.copy())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # the numpy path computes 0/0 there
        values, matrix = fast.evaluate(state)[1], fast.normal_matrix(state)
    assert fast.compiled == compiled
    if compiled:
        assert np.allclose(values, plain.evaluate(state)[1], rtol=1e-9, atol=1e-9 * np.abs(values).max())
        assert np.isfinite(matrix).all()


@pytest.mark.parametrize(
    "values",
    [
        [3.0, 1.0, 2.0, 1.0, 3.0, 3.0, 2.0],
        [0.0],
        [-0.0, 0.0, 1e-300, -1e-300],
        list(np.random.default_rng(0).permutation(np.repeat(np.arange(40.0), 7))),
        list(np.random.default_rng(1).uniform(size=MOST_LEVELS + 10)),
    ],
    ids=["few", "one", "zeros", "shuffled", "very many"],
)
def test_levels_are_the_distinct_positions_in_order(compiled, values):
    column = np.column_stack([values, values, values])[:, 1]
    for position in (column, np.ascontiguousarray(column)):
        levels, index = levels_of(position, compiled=compiled)
        expected, inverse = np.unique(position, return_inverse=True)
        assert np.array_equal(levels, expected)
        assert np.array_equal(index, inverse)


@pytest.mark.usefixtures("compiled")
def test_start_moments_are_sums_over_the_readings():
    machine = machine_of(tool_offset_mm=(10.0, -20.0, -150.0))
    lengths = readings_on(machine, tools_mm=TOOLS)
    _, problem = both_problems(machine, lengths)
    sums, offset, centre, scale = start_moments(problem)
    expected = np.zeros((4, 6, 6))
    for data, tool in zip(problem.tools, TOOLS[np.lexsort(TOOLS.T[::-1])], strict=True):
        assert np.array_equal(data.tool_mm, tool)
        cells = np.stack(np.meshgrid(*problem.levels_mm, indexing="ij"), -1)  # x, y, z
        cells = cells.transpose(*problem.order, 3).reshape(-1, 3)
        for group in range(4):
            used = data.weight[group].ravel() > 0
            p = (cells[used] + tool - centre) / scale
            reach = data.length_mm[group].ravel()[used] / scale - offset[group]
            columns = np.column_stack([2 * p, 2 * reach, np.ones(len(p)), np.sum(p**2, axis=1) - reach**2])
            expected[group] += columns.T @ columns
    assert np.allclose(sums, expected, rtol=1e-12, atol=1e-9)
    mean = [np.concatenate([d.length_mm[g][d.weight[g] > 0] for d in problem.tools]).mean() / scale for g in range(4)]
    assert np.allclose(offset, mean, rtol=1e-13)


def test_compiled_loops_and_numpy_identify_the_same_errors(monkeypatch):
    pytest.importorskip("numba", reason="the compiled loops are an optional extra")
    machine = machine_of()
    lengths = readings_on(machine, levels=(7, 6, 5), repeats=1)
    found = []
    for form in ("plain", "compiled"):
        monkeypatch.setenv("COMPGEN_KERNELS", form)
        found.append(identify(machine, lengths, IdentifyOptions(u_length_um=1.0)))
    slow, fast = found
    for name, curve in slow.errors.curves.items():
        unit = 1e-3 if name[1] in "XYZ" else 1e-6
        assert np.max(np.abs(fast.errors.curves[name].value - curve.value)) < 1e-6 * unit
        assert np.allclose(fast.errors.curves[name].u, curve.u, rtol=1e-6)
    assert np.allclose(fast.covariance, slow.covariance, rtol=1e-5, atol=1e-9 * np.abs(slow.covariance).max())


@pytest.mark.parametrize("size", [1, 5, 64, 65, 200])
def test_the_root_of_the_inverse_is_upper_triangular_and_gives_the_inverse(size):
    rng = np.random.default_rng(size)
    rows = rng.normal(size=(3 * size, size)) * 10.0 ** rng.uniform(-3, 3, size)
    factor = factorise(rows.T @ rows)
    root = factor.inverse_root()
    assert np.array_equal(root, np.triu(root))
    scale = 1.0 / factor.scale
    product = (root @ root.T) * scale * scale[:, None]
    expected = np.linalg.inv(factor.matrix * factor.scale * factor.scale[:, None])
    assert np.allclose(product, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    with pytest.raises(LinAlgError):
        factorise(-np.eye(size))


def test_the_covariance_belongs_to_the_standard_uncertainties():
    machine = machine_of()
    result = identify(machine, readings_on(machine, repeats=1), IdentifyOptions(u_length_um=1.0))
    u = np.sqrt(np.diag(result.covariance))
    layout = error_parameters(machine, modelled_errors(machine))
    assert result.covariance.shape == (layout.size, layout.size)
    assert result.covariance is result.covariance
    for curve in layout.curves:
        expected = np.zeros(len(curve.nodes_mm))
        expected[curve.free.argmax(axis=0)] = u[curve.columns]
        assert np.allclose(result.errors.curves[curve.error.name].u, expected, rtol=1e-12)
