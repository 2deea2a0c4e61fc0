"""E = C P and the exact model at many points: every path against cross products, and against the model body by body."""

import importlib.util
import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import machines
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import CHAINS
from compgen.data.names import ERRORS
from compgen.errors import InputError
from compgen.kinematics import exact_chain as exact_points
from compgen.kinematics import exact_error, kernel_switch, volumetric_error
from compgen.kinematics import many_points as evaluate
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.many_points import NodeIndex, volumetric_error_on_grid
from compgen.resources import cache_folder

ROUNDING_MM = 1e-12
RANGES_MM = ((-800.0, 0.0), (-300.0, 500.0), (0.0, 400.0))
TOOL_MM = (12.0, -7.0, -150.0)
COMPILED = "compgen.kinematics.compiled_kernels"
NUMBA = importlib.util.find_spec("numba") is not None


def machine_of(chain="WFYXZT", reference="X", tool_mm=TOOL_MM):
    fields = {"squareness_reference": reference, "tool_offset_mm": tool_mm}
    return machines.machine_of(RANGES_MM, 6, chain, name="test", **fields)


def errors_of(seed=0, nodes="uneven", scale=1.0):
    """All 21 errors: 30 um and 60 urad in size; uneven nodes differ from curve to curve and leave parts uncovered."""
    rng = np.random.default_rng(seed)
    curves = {}
    for error in ERRORS[:18]:
        low, high = RANGES_MM[error.axis]
        count = 6 if nodes == "even" else int(rng.integers(1, 9))
        position = np.linspace(low, high, 6) if nodes == "even" else np.sort(rng.uniform(low + 40, high - 20, count))
        size = scale * (0.03 if error.kind == "linear" else 60e-6)
        curves[error.name] = Curve(position, rng.uniform(-size, size, count), np.full(count, np.nan))
    squareness = {error.name: (scale * rng.uniform(-3e-3, 3e-3), np.nan) for error in ERRORS[18:]}
    return ErrorTable(curves, squareness)


def points_of(count, seed=1, beyond_mm=100.0):
    """Points over the travel and beyond it, among them nodes and ends."""
    low, high = np.array(RANGES_MM).T
    points = np.random.default_rng(seed).uniform(low - beyond_mm, high + beyond_mm, (count, 3))
    points[:2] = (low, high)[:count]
    return points


def tools_of(kind, count):
    return {"machine": None, "one": np.array([3.0, 40.0, -90.0]), "each": points_of(count, seed=2)}[kind]


def by_cross_products(machine, errors, position, tool):
    """E = sum of delta + eps x lever + squareness, as docs/conventions.md has it, without C."""
    tool = np.broadcast_to(np.array(machine.tool_offset_mm) if tool is None else tool, position.shape)
    travel = [position[:, [k]] * np.eye(3)[k] for k in range(3)]
    value = {
        name: np.interp(position[:, ERRORS_AXIS[name]], c.position_mm, c.value) for name, c in errors.curves.items()
    }
    value |= {name: np.full(len(position), constant) for name, (constant, _) in errors.squareness.items()}
    none = np.zeros(len(position))
    total = np.zeros_like(position)
    before, after = machine.chain.name[1:-1].split("F")
    for axis in "XYZ":
        delta, eps = (np.stack([value.get(f"E{d}{axis}", none) for d in row], axis=1) for row in ("XYZ", "ABC"))
        counted = after.partition(axis)[2] if axis in after else after + before[before.index(axis) :]
        lever = tool + sum((travel["XYZ".index(other)] for other in counted), np.zeros_like(position))
        total += delta + np.cross(eps, lever)
    c0y, b0z, a0z = (value.get(name, none) for name in ("EC0Y", "EB0Z", "EA0Z"))
    if machine.squareness_reference == "Y":
        total[:, 1] -= position[:, 0] * c0y
    else:
        total[:, 0] -= position[:, 1] * c0y
    total += np.cross(np.stack([a0z, b0z, none], axis=1), travel[2])
    return total


ERRORS_AXIS = {error.name: error.axis for error in ERRORS[:18]}


def by_the_whole_chain(machine, errors, position, tool):
    """The exact error as the tip of the chain minus the nominal one."""
    nominal = position + (np.array(machine.tool_offset_mm) if tool is None else tool)
    return tip_position(machine, errors.at(position), position, tool) - nominal


@pytest.fixture
def numpy_only(monkeypatch):
    monkeypatch.setenv("COMPGEN_KERNELS", "plain")


@pytest.fixture
def interpreted(monkeypatch):
    """The kernels as plain Python: every chain can be tried without compiling a kernel for it."""
    numba = pytest.importorskip("numba")
    monkeypatch.setattr(numba, "njit", lambda *args, **options: lambda function: function)
    monkeypatch.setenv("COMPGEN_KERNELS", "compiled")
    before = sys.modules.pop(COMPILED, None)
    importlib.import_module(COMPILED)
    yield
    del sys.modules[COMPILED]
    if before is not None:
        sys.modules[COMPILED] = before


@pytest.fixture
def compiled(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setenv("COMPGEN_KERNELS", "compiled")


@pytest.fixture(params=["numpy_only", "interpreted"])
def way(request):
    return request.getfixturevalue(request.param)


CASES = [
    (chain, "XY"[k % 2], ("machine", "one", "each")[k % 3], ("even", "uneven")[k // 2 % 2])
    for k, chain in enumerate([*CHAINS, *reversed(CHAINS)])
]


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(("chain", "reference", "tool", "nodes"), CASES)
def test_points_agree_with_cross_products_on_every_chain(chain, reference, tool, nodes):
    machine, errors, points = machine_of(chain, reference), errors_of(nodes=nodes), points_of(25)
    tool_mm = tools_of(tool, len(points))
    due = by_cross_products(machine, errors, points, tool_mm)
    np.testing.assert_allclose(volumetric_error(machine, errors, points, tool_mm), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(("chain", "reference", "tool", "nodes"), CASES)
def test_the_grid_agrees_with_cross_products_on_every_chain(chain, reference, tool, nodes):
    machine, errors = machine_of(chain, reference), errors_of(nodes=nodes)
    levels = [np.sort(points_of(count, seed=count)[:, k])[::-1] for k, count in enumerate((3, 5, 4))]
    tool_mm = None if tool == "machine" else tools_of("one", 1)
    points = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1)
    due = by_cross_products(machine, errors, points.reshape(-1, 3), tool_mm).reshape(points.shape)
    found = volumetric_error_on_grid(machine, errors, levels, tool_mm)
    np.testing.assert_allclose(found, due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("chain", ["WFYXZT", "WFZXYT"])  # the second has errors of Z whose lever is y
@pytest.mark.parametrize("count", [1, 3, 4, 5, 9, 13])
def test_rows_of_a_grid_along_z_may_have_any_length(chain, count):
    """Kernels write four points at a time, and what is left of a row one by one."""
    machine, errors = machine_of(chain), errors_of(6)
    levels = [np.linspace(*range_mm, n) for range_mm, n in zip(RANGES_MM, (2, 3, count), strict=True)]
    points = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1)
    due = by_cross_products(machine, errors, points.reshape(-1, 3), None).reshape(points.shape)
    np.testing.assert_allclose(volumetric_error_on_grid(machine, errors, levels), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(("chain", "reference", "tool", "nodes"), CASES)
def test_the_exact_model_agrees_with_the_whole_chain_on_every_chain(chain, reference, tool, nodes):
    machine, errors, points = machine_of(chain, reference), errors_of(nodes=nodes), points_of(25)
    tool_mm = tools_of(tool, len(points))
    due = by_the_whole_chain(machine, errors, points, tool_mm)
    np.testing.assert_allclose(exact_error(machine, errors, points, tool_mm), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("way")
def test_rotations_beyond_the_series_are_exact_too():
    machine, errors, points = machine_of(), errors_of(scale=2000.0), points_of(40)
    due = by_the_whole_chain(machine, errors, points, None)
    assert np.abs(due).max() > 100.0
    np.testing.assert_allclose(exact_error(machine, errors, points), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize(
    ("chain", "tool", "nodes"), [("WFYXZT", "machine", "even"), ("WZXFYT", "each", "uneven")], ids=str
)
def test_compiled_kernels_agree_with_cross_products(chain, tool, nodes):
    machine, errors, points = machine_of(chain), errors_of(nodes=nodes), points_of(1000)
    tool_mm = tools_of(tool, len(points))
    due = by_cross_products(machine, errors, points, tool_mm)
    np.testing.assert_allclose(volumetric_error(machine, errors, points, tool_mm), due, rtol=0, atol=ROUNDING_MM)
    due = by_the_whole_chain(machine, errors, points, tool_mm)
    np.testing.assert_allclose(exact_error(machine, errors, points, tool_mm), due, rtol=0, atol=ROUNDING_MM)
    points[5:7, 0] = np.nan  # no place of any table, and nothing is read outside one
    for model in (volumetric_error, exact_error):
        assert np.flatnonzero(np.isnan(model(machine, errors, points, tool_mm)).any(axis=1)).tolist() == [5, 6]
    levels = [points[7 : 7 + count, k].copy() for k, count in enumerate((7, 6, 13))]
    grid = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1)
    due = by_cross_products(machine, errors, grid.reshape(-1, 3), None).reshape(grid.shape)
    np.testing.assert_allclose(volumetric_error_on_grid(machine, errors, levels), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("numpy_only")
@pytest.mark.parametrize("count", [evaluate.BLOCK - 1, evaluate.BLOCK, 2 * evaluate.BLOCK + 1])
def test_block_ends_leave_no_trace(count):
    machine, errors, points = machine_of("WXFYZT"), errors_of(), points_of(count)
    tools = tools_of("each", count)
    due = by_cross_products(machine, errors, points, tools)
    np.testing.assert_allclose(volumetric_error(machine, errors, points, tools), due, rtol=0, atol=ROUNDING_MM)
    due = by_the_whole_chain(machine, errors, points, tools)
    np.testing.assert_allclose(exact_error(machine, errors, points, tools), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("numpy_only")
@pytest.mark.parametrize("shape", [(40, 3, 2), (3, 40, 2), (2, 3, 40), (9, 11, 10), (1, 1, 1), (1, 50, 1)])
def test_a_grid_in_small_blocks_is_the_same_grid(monkeypatch, shape):
    monkeypatch.setattr(evaluate, "BLOCK", 16)
    monkeypatch.setattr(evaluate, "_GRID_BLOCK", 20)
    monkeypatch.setattr(evaluate.blocks, "__defaults__", (16,))
    machine, errors = machine_of("WFZXYT"), errors_of(4)
    levels = [np.linspace(*range_mm, count) for range_mm, count in zip(RANGES_MM, shape, strict=True)]
    points = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)
    due = by_cross_products(machine, errors, points, None).reshape(*shape, 3)
    np.testing.assert_allclose(volumetric_error_on_grid(machine, errors, levels), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize(
    "names", [(), ("EC0Y",), ("EXX",), ("EB0Z", "EAX"), ("EBY", "EA0Z", "EZZ"), ("ECX", "ECY", "ECZ")]
)
def test_errors_that_are_absent_are_zero(names):
    machine, errors, points = machine_of("WYFXZT"), errors_of().only(*names), points_of(20)
    due = by_cross_products(machine, errors, points, None)
    np.testing.assert_allclose(volumetric_error(machine, errors, points), due, rtol=0, atol=ROUNDING_MM)
    due = by_the_whole_chain(machine, errors, points, None)
    np.testing.assert_allclose(exact_error(machine, errors, points), due, rtol=0, atol=ROUNDING_MM)


@pytest.mark.usefixtures("way")
def test_no_points_give_no_errors():
    machine, errors = machine_of(), errors_of()
    for model in (volumetric_error, exact_error):
        assert model(machine, errors, np.zeros((0, 3))).shape == (0, 3)
        assert model(machine, errors, np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 3)
    assert volumetric_error_on_grid(machine, errors, [np.zeros(2), np.zeros(0), np.zeros(3)]).shape == (2, 0, 3, 3)


@pytest.mark.usefixtures("numpy_only")
@pytest.mark.parametrize("nodes", ["even", "uneven"])
def test_infinite_positions_have_end_values_and_unknown_ones_unknown_errors(nodes):
    machine, errors = machine_of(tool_mm=(0.0, 0.0, 0.0)), errors_of(nodes=nodes).only("EXX", "EYX", "EZX")
    found = volumetric_error(machine, errors, np.array([[np.inf, 1, 2], [-np.inf, 1, 2], [np.nan, 1, 2]]))
    ends = [[errors.curves[name].value[end] for name in ("EXX", "EYX", "EZX")] for end in (-1, 0)]
    np.testing.assert_allclose(found[:2], ends, rtol=0, atol=ROUNDING_MM)
    assert np.isnan(found[2]).any()


@pytest.mark.usefixtures("way")
def test_the_result_goes_to_a_given_array_even_to_that_of_the_positions():
    machine, errors, points = machine_of(), errors_of(), points_of(50)
    for at in (volumetric_error, exact_error):
        due, out, same = at(machine, errors, points), np.empty((50, 3)), points.copy()
        assert at(machine, errors, points, out=out) is out
        assert at(machine, errors, same, out=same) is same
        np.testing.assert_array_equal(out, due)
        np.testing.assert_array_equal(same, due)
    levels = [np.linspace(*range_mm, 4) for range_mm in RANGES_MM]
    grid = np.empty((4, 4, 4, 3))
    assert volumetric_error_on_grid(machine, errors, levels, out=grid) is grid
    np.testing.assert_array_equal(grid, volumetric_error_on_grid(machine, errors, levels))


@pytest.mark.usefixtures("way")
def test_positions_may_be_views_integers_or_read_only():
    machine, errors, points = machine_of(), errors_of(), points_of(30)
    due = volumetric_error(machine, errors, points)
    frozen = points.copy()
    frozen.flags.writeable = False
    for same in (np.asfortranarray(points), np.repeat(points, 2, axis=0)[::2], frozen, points.tolist()):
        np.testing.assert_array_equal(volumetric_error(machine, errors, same), due)
    whole = np.array([[-100, 20, 30]])
    np.testing.assert_array_equal(
        volumetric_error(machine, errors, whole), volumetric_error(machine, errors, whole.astype(float))
    )


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda m, e: volumetric_error(m, e, np.zeros(3)), r"shape \(3,\); expected \(n, 3\)"),
        (lambda m, e: exact_error(m, e, np.zeros((4, 2))), r"shape \(4, 2\)"),
        (
            lambda m, e: volumetric_error(m, e, np.zeros((4, 3)), out=np.zeros((3, 3))),
            r"shape \(3, 3\) and type float64; expected .* \(4, 3\)",
        ),
        (lambda m, e: volumetric_error(m, e, np.zeros((4, 3)), out=np.zeros((4, 3), np.float32)), "float32"),
        (lambda m, e: volumetric_error_on_grid(m, e, [np.zeros(2)] * 2), "three lists of levels"),
        (lambda m, e: volumetric_error_on_grid(m, e, [np.zeros((2, 2))] * 3), "three lists of levels"),
        (lambda m, e: volumetric_error_on_grid(m, e, [np.zeros(2)] * 3, np.zeros((8, 3))), "a grid has one tool"),
    ],
)
def test_wrong_shapes_are_refused_with_what_is_due(call, message):
    with pytest.raises(InputError, match=message):
        call(machine_of(), errors_of())


@pytest.mark.parametrize("count", [2, 3, 9, 1001])
def test_even_nodes_are_seen_to_be_even_and_no_others(count):
    nodes = np.linspace(-300.1, 500.0, count)
    assert NodeIndex(nodes).even
    if count > 2:
        nodes[-2] += 1e-6
        assert not NodeIndex(nodes).even


@settings(max_examples=200, deadline=None)
@given(
    gaps=st.lists(st.floats(1e-6, 500.0), min_size=1, max_size=30),
    start=st.floats(-1000.0, 1000.0),
    seed=st.integers(0, 99),
)
def test_the_interval_of_a_position_is_found_among_any_nodes(gaps, start, seed):
    nodes = np.unique(start + np.concatenate([[0.0], np.cumsum(gaps)]))
    value = np.random.default_rng(seed).uniform(-1, 1, len(nodes))
    inside = np.random.default_rng(seed).uniform(nodes[0] - 10, nodes[-1] + 10, 50)
    position = np.concatenate([inside, nodes, np.nextafter(nodes, -np.inf), np.nextafter(nodes, np.inf)])
    cell, share = NodeIndex(nodes).locate(position)
    assert cell.min() >= 0 and cell.max() <= len(nodes) - 2
    assert share.min() >= -1e-12 and share.max() <= 1 + 1e-12
    found = (1 - share) * value[cell] + share * value[cell + 1]
    steepest = np.max(np.abs(np.diff(value)) / np.diff(nodes))
    allowed = 1e-12 + 4 * steepest * np.spacing(np.abs(nodes).max())
    np.testing.assert_allclose(found, np.interp(position, nodes, value), rtol=0, atol=allowed)


@pytest.mark.parametrize("model", [volumetric_error, exact_error])
@pytest.mark.usefixtures("numpy_only")
def test_memory_beyond_the_result_does_not_grow_with_the_points(model):
    machine, errors, points = machine_of(), errors_of(), points_of(300_000)
    tracemalloc.start()
    result = model(machine, errors, points)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (
        peak - result.nbytes < 60 * 8 * evaluate.BLOCK
    )  # 60 numbers per point of a block; 21 errors each would be 50 MB


def python(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **environment}, check=False
    )


SMALL_JOB = """
import sys, numpy as np, compgen
machine = compgen.load_machine("zha-gantry")
table = compgen.ErrorTable({}, {"EC0Y": (1e-3, 0.0)})
"""


def test_small_jobs_do_not_wait_for_numba():
    run = python(
        SMALL_JOB + "compgen.volumetric_error(machine, table, np.zeros((9, 3)))\nassert 'numba' not in sys.modules"
    )
    assert (run.returncode, run.stderr) == (0, "")


@pytest.mark.skipif(not NUMBA, reason="numba is not installed")
def test_kernels_work_where_no_cache_can_be_written(tmp_path):
    (tmp_path / "file").write_text("a file where a folder is due")
    code = SMALL_JOB + ("print(compgen.volumetric_error(machine, table, np.array([[0.0, -1000.0, 0.0]]))[0, 0])")
    folders = {"XDG_CACHE_HOME": str(tmp_path / "file"), "LOCALAPPDATA": str(tmp_path / "file"), "NUMBA_CACHE_DIR": ""}
    run = python(code, **folders, COMPGEN_KERNELS="compiled")
    assert (run.returncode, run.stdout.strip()) == (0, "1.0"), run.stderr


def test_without_numba_there_are_no_kernels(monkeypatch):
    monkeypatch.delitem(sys.modules, COMPILED, raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.setenv("COMPGEN_KERNELS", "auto")
    points = points_of(5)
    due = by_cross_products(machine_of(), errors_of(), points, None)
    monkeypatch.setattr(evaluate, "_POINTS_FOR_KERNELS", 1)
    monkeypatch.setattr(exact_points, "_POINTS_FOR_KERNELS", 1)
    np.testing.assert_allclose(volumetric_error(machine_of(), errors_of(), points), due, rtol=0, atol=ROUNDING_MM)
    assert exact_error(machine_of(), errors_of(), points).shape == (5, 3)


def test_machine_code_is_kept_where_the_environment_says_and_never_where_a_file_in_the_working_folder_does(monkeypatch):
    """Code that is loaded from there is run; numba takes a folder from `.numba_config.yaml` of the working folder, too."""
    numba = pytest.importorskip("numba")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(numba.config, "CACHE_DIR", "of-a-file")
    with kernel_switch._settings():
        assert str(cache_folder("numba")) == numba.config.CACHE_DIR
    assert numba.config.CACHE_DIR == "of-a-file"
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/named")
    with kernel_switch._settings():
        assert numba.config.CACHE_DIR == "/named"


@pytest.mark.parametrize("name", ["cache", "./cache", ""])
def test_the_cache_folder_is_never_below_the_working_folder(monkeypatch, name):
    for variable in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.setenv(variable, name)
    assert cache_folder("numba").is_absolute()
