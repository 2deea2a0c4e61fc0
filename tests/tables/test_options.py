"""Levels of option, explanations, and reversal from its file into tables of one direction: signs and sizes by hand."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.controls import CONTROLLERS, SourceFile, controller_named
from compgen.controls.shared.grids import curve_nodes_mm
from compgen.data import toml_files
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves, format_errors, format_reversal, read_reversal
from compgen.data.lengths import Points
from compgen.data.machine import zone_of
from compgen.errors import InputError
from compgen.kinematics.many_points import volume_grid
from compgen.pipeline import export_and_verify, identified_reversal
from compgen.programs.dialects import DIALECTS
from compgen.programs.part import CompensatedModel
from compgen.programs.path import ExactModel
from compgen.report.options_text import options_markdown
from compgen.tables import ReadTables, export, read_tables, verify
from compgen.tables.judge import in_both_directions
from compgen.tables.options import (
    LABELS,
    PROGRAM_STEP_MM,
    PROGRAM_STEPS_MM,
    capability,
    explain,
    levels_of,
)
from compgen.tables.signs import check_program

NANOMETRE = 1e-6  # mm
ROUNDING_UM = 2e-3  # nine ordinary decimals of 1e-6 mm add up to less
SECOND_ORDER_UM = 0.02  # finite rotations and interpolation of levers, for errors of 30 um and 100 urad
UM = 1e-3


def reversal_of(**values_um):
    """Constant reversals in um by name: X, Y, Z along the axis, XY: travel of X, displacement in Y."""
    curves = {}
    for name, value in values_um.items():
        key = ("XYZ".index(name[0]), "XYZ".index(name[-1]))
        curves[key] = Curve(np.zeros(1), np.array([value * UM]), np.array([0.1 * UM]))
    return ReversalCurves(curves)


def with_settings(machine, name, **settings):
    section = toml_files.Section(settings, path=machine.source, name=f"controllers.{name}")
    return replace(machine, controllers={**machine.controllers, name: section})


def emulated(machine, exported, points):
    """What the control adds, from the text of the exported files."""
    control = controller_named(exported.controller)
    settings = control.read_settings(machine)
    sources = [SourceFile(Path(name), text) for name, text in exported.files.items()]
    return control(machine, settings).emulate(control(machine, settings).parse(sources), points)


def both_ways(position, approach):
    return Points(np.array([position] * 2, dtype=float), approach=np.array(approach, dtype=float))


def single(machine, name, value):
    """An errors table with one error; ``value`` is a function of the position on its axis, or a constant."""
    if callable(value):
        nodes = machine.axes["XYZ".index(name[-1])].nodes_mm
        return ErrorTable({name: Curve(nodes, value(nodes), np.full(len(nodes), np.nan))})
    return ErrorTable(squareness={name: (value, 0.0)})


@pytest.fixture
def call(call, monkeypatch, tmp_path):
    """The command line, with ``tmp_path`` as the working folder."""
    monkeypatch.chdir(tmp_path)
    return call


@pytest.fixture
def errors_file(small_errors, tmp_path):
    path = tmp_path / "small.errors.csv"
    path.write_text(format_errors(small_errors))
    return path


# --- the file --------------------------------------------------------------------------------------------------------


def test_a_reversal_file_reads_back_as_it_was_written(tmp_path):
    nodes = np.array([-300.0, -12.5, 200.0])
    given = ReversalCurves(
        {
            (0, 0): Curve(nodes, np.array([-8.0, -6.5, -7.25]) * UM, np.array([0.2, 0.3, 0.4]) * UM),
            (0, 1): Curve(np.zeros(1), np.array([1.5]) * UM, np.array([0.1]) * UM),
            (2, 2): Curve(np.zeros(1), np.array([3.0]) * UM, np.array([np.nan])),
        }
    )
    path = tmp_path / "a.reversal.csv"
    path.write_text(format_reversal(given))
    read = read_reversal(path)
    assert read.curves.keys() == given.curves.keys()
    for key, curve in given.curves.items():
        np.testing.assert_allclose(read.curves[key].value, curve.value, atol=1e-12)
        np.testing.assert_allclose(read.curves[key].u, curve.u, atol=1e-12)
    np.testing.assert_array_equal(read.curves[0, 0].position_mm, nodes)
    assert format_reversal(read) == path.read_text()


def test_without_a_component_a_reversal_lies_along_its_axis(tmp_path):
    path = tmp_path / "a.reversal.csv"
    path.write_text("axis,position_mm,value_um\nY,,-4\n")
    assert read_reversal(path).mean_mm(1) == pytest.approx(-0.004)


@pytest.mark.parametrize(
    ("rows", "line", "words"),
    [
        ("X,,\n", 2, "is empty"),
        ("U,,3\n", 2, "'U' is not an axis"),
        ("X,,1500\n", 2, "is not a reversal"),
        ("X,0,3\nX,,4\n", 3, "a constant has one row"),
        ("X,0,3\nX,0,4\n", 3, "already in line 2"),
        ("X,0,nan\n", 2, "not a finite number"),
    ],
)
def test_a_wrong_reversal_file_is_refused_with_its_line(tmp_path, rows, line, words):
    path = tmp_path / "a.reversal.csv"
    path.write_text("axis,position_mm,value_um\n" + rows)
    with pytest.raises(InputError, match=words) as caught:
        read_reversal(path)
    assert caught.value.line == line


def test_the_tool_stands_at_half_the_reversal_on_the_side_that_it_came_from():
    moved = reversal_of(X=-8.0, XY=3.0).displacement(np.zeros((3, 3)), np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 1]]))
    np.testing.assert_allclose(moved / UM, [[-4.0, 1.5, 0.0], [4.0, -1.5, 0.0], [0.0, 0.0, 0.0]], atol=1e-12)


# --- tables of one direction -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sign", "stored"), [("error", "-0.004000"), ("correction", "0.004000")])
def test_an_axis_that_stops_short_is_pushed_on_in_both_directions(small_machine, sign, stored):
    """B = -8 um: after positive travel the tool stands 4 um short, so 4 um are added; after negative travel the same."""
    machine = with_settings(small_machine, "siemens-cec", sign=sign)
    exported = export(machine, ErrorTable({}, {"EC0Y": (0.0, 0.0)}), "siemens-cec", reversal=reversal_of(X=-8.0))
    added = emulated(machine, exported, both_ways([40.0, 10.0, -20.0], [[1, 1, 1], [-1, 1, 1]]))
    np.testing.assert_allclose(added, [[0.004, 0, 0], [-0.004, 0, 0]], atol=1e-12)
    text = exported.files["NC_CEC.INI"]
    index = next(k for k in range(99) if f"$AN_CEC_DIRECTION[{k}]=1\n" in text)
    assert f"$AN_CEC[{index},0]={stored}\n" in text
    assert f"$AN_CEC_INPUT_AXIS[{index}]=(AX1)\n$AN_CEC_OUTPUT_AXIS[{index}]=(AX1)\n" in text
    assert f"$AN_CEC_DIRECTION[{index + 1}]=-1\n" in text


def test_a_reversal_across_and_along_a_curve_is_held_at_every_position(small_machine, small_errors):
    curve = Curve(np.array([-100.0, 50.0, 300.0]), np.array([2.0, 6.0, -3.0]) * UM, np.full(3, np.nan))
    reversal = ReversalCurves({(1, 1): curve, **reversal_of(ZX=-5.0).curves})
    exported = export(small_machine, small_errors, "siemens-cec", reversal=reversal)
    y = np.linspace(-100.0, 300.0, 33)
    position = np.column_stack([np.full(33, 12.0), y, np.full(33, -77.0)])
    ways = [Points(position, approach=np.tile([1.0, side, side], (33, 1))) for side in (1.0, -1.0)]
    up, down = (emulated(small_machine, exported, points) for points in ways)
    np.testing.assert_allclose((up - down)[:, 1], -np.interp(y, curve.position_mm, curve.value), atol=2 * NANOMETRE)
    np.testing.assert_allclose((up - down)[:, 0], 0.005, atol=2 * NANOMETRE)
    np.testing.assert_allclose((up - down)[:, 2], 0.0, atol=1e-12)
    plain = emulated(small_machine, export(small_machine, small_errors, "siemens-cec"), Points(position))
    np.testing.assert_allclose(0.5 * (up + down), plain, atol=2 * NANOMETRE)


def test_without_reversal_the_file_has_no_table_of_one_direction(small_machine, small_errors):
    plain = export(small_machine, small_errors, "siemens-cec").files["NC_CEC.INI"]
    assert "DIRECTION[" in plain
    assert all(line.endswith("=0") for line in plain.splitlines() if line.startswith("$AN_CEC_DIRECTION"))
    tiny = export(small_machine, small_errors, "siemens-cec", reversal=reversal_of(X=0.05)).files["NC_CEC.INI"]
    body = [[line for line in text.splitlines() if line.startswith("$")] for text in (plain, tiny)]
    assert body[0] == body[1]


def test_both_directions_are_verified_and_the_residual_of_the_files_holds_no_reversal(
    small_machine, small_errors, tmp_path
):
    reversal = reversal_of(X=-8.0, Y=5.0, ZX=4.0)
    result = export_and_verify(
        small_machine, small_errors, small_errors, "siemens-cec", tmp_path, reversal=reversal
    ).verification
    assert result.accepted, result.reasons
    without = export_and_verify(small_machine, small_errors, small_errors, "siemens-cec", tmp_path).verification
    assert result.points == 2 * without.points
    assert result.after.max_um < without.after.max_um + ROUNDING_UM
    assert result.before.max_um > without.before.max_um + 1.0


@pytest.mark.parametrize("wrong", ["flipped", "missing", "other axis"])
def test_wrong_tables_of_one_direction_are_rejected_by_name(small_machine, small_errors, tmp_path, wrong):
    exported = export(small_machine, small_errors, "siemens-cec", reversal=reversal_of(X=-8.0))
    text = exported.files["NC_CEC.INI"]
    if wrong == "flipped":
        text = text.replace("]=-1\n", "]=+1\n").replace("DIRECTION[", "D[")
        lines = [line.replace("D[", "DIRECTION[") for line in text.splitlines()]
        swap = {"=1": "=-1", "=+1": "=1"}
        for k, line in enumerate(lines):
            head, _, value = line.rpartition("=")
            if "DIRECTION" in head:
                lines[k] = head + swap.get(f"={value}", f"={value}")
        text = "\n".join(lines) + "\n"
    elif wrong == "missing":
        text = export(small_machine, small_errors, "siemens-cec").files["NC_CEC.INI"]
    else:
        blocks = text.split("; table ")
        blocks = [
            part.replace("_AXIS[", "_AXIS[").replace("(AX1)", "(AX2)") if "reversal" in part else part
            for part in blocks
        ]
        text = "; table ".join(blocks)
    path = tmp_path / "NC_CEC.INI"
    path.write_text(text)
    tables = read_tables(small_machine, path, "siemens-cec")
    judged = verify(small_machine, tables, small_errors, reversal=reversal_of(X=-8.0))
    assert not judged.accepted
    assert any(reason.startswith("reversal X at X") for reason in judged.reasons)


@pytest.mark.parametrize(
    ("controller", "name", "value"),
    [
        ("siemens-eec", "MD32450 $MA_BACKLASH[0,AX1]", "0.0080 mm"),
        ("fanuc-pitch", "1851 (X, A1)", "8"),
    ],
)
def test_a_control_without_such_tables_is_told_the_value_of_its_backlash_parameter(
    small_machine, small_errors, controller, name, value
):
    """The tool stops 8 um short of where it came from: a positive backlash in both vendors' parameters."""
    exported = export(small_machine, small_errors, controller, reversal=reversal_of(X=-8.0, XY=3.0))
    rows = {row["name"]: row["value"] for row in exported.manifest["parameters"]}
    assert rows[name] == value
    assert name in exported.preflight
    assert any("reversal X in Y is +3.0 um" in text for text in exported.warnings)
    plain = export(small_machine, small_errors, controller)
    where = Points(np.array([[10.0, 20.0, -30.0]]), approach=np.ones((1, 3)))
    np.testing.assert_array_equal(emulated(small_machine, exported, where), emulated(small_machine, plain, where))


def test_a_control_without_a_backlash_parameter_warns(small_machine, small_errors):
    exported = export(small_machine, small_errors, "isg-csv", reversal=reversal_of(X=-8.0))
    assert any("reversal X is -8.0 um" in text for text in exported.warnings)


def test_a_simulated_reversal_goes_through_run_into_tables_of_one_direction(
    small_machine, small_machine_file, tmp_path
):
    """The machine stands 3 um behind on X and 2 um ahead on Y; readings know from where each stop was approached."""
    true_um = {"X": -6.0, "Y": 4.0}
    scenario = compgen.read_scenario(_scenario(tmp_path))

    def lag(_, stops):
        approach = np.asarray(stops.approach)
        return 0.5 * UM * approach * np.array([true_um["X"], true_um["Y"], 0.0])

    simulated = compgen.simulate(small_machine, scenario, effects=[lag])
    compgen.write_simulation(simulated, tmp_path)
    result = compgen.run(small_machine, [tmp_path / "lagging.lengths.csv"], ["siemens-cec"], tmp_path / "out")
    assert result.accepted
    found = identified_reversal(result.identification)
    for axis, value in true_um.items():
        assert found.mean_mm("XYZ".index(axis)) / UM == pytest.approx(value, abs=0.2)
    assert read_reversal(tmp_path / "out" / "identified.reversal.csv").curves.keys() == found.curves.keys()
    tables = read_tables(small_machine, tmp_path / "out" / "NC_CEC.INI", "siemens-cec")
    points = both_ways([-100.0, 50.0, -90.0], [[1, 1, 1], [-1, -1, 1]])
    up, down = tables.correction(small_machine, points) / UM
    np.testing.assert_allclose(up - down, [6.0, -4.0, 0.0], atol=0.3)


def _scenario(folder):
    """Four tracers on the small machine, there and back."""
    corners = [(-420, -210, -420), (330, -190, -405), (310, 410, -415), (-400, 430, -90)]
    stations = "".join(
        f'[[instrument.stations]]\nname = "S{k}"\nposition_mm = [{x}.0, {y}.0, {z}.0]\ndead_length_mm = 15{k}.25\n'
        for k, (x, y, z) in enumerate(corners)
    )
    path = folder / "lagging.toml"
    path.write_text(
        'name = "lagging"\nseed = 11\n[errors]\n[instrument]\ntype = "laser-tracer"\n'
        f'noise_um = 0.1\nnoise_um_per_m = 0.15\n{stations}[trajectory]\ntype = "grid"\n'
    )
    return path


def test_the_check_program_reads_nothing_of_a_reversal_that_the_tables_take_out(small_machine):
    """Only a reversal that grows along Y, from 0 to 20 um: positions are approached upwards in Y, so half of it shows."""
    errors = single(small_machine, "EXX", lambda x: 2e-5 * (x + 50.0))
    curve = Curve(np.array([-100.0, 300.0]), np.array([0.0, 20.0]) * UM, np.full(2, np.nan))
    reversal = ReversalCurves({(1, 1): curve})
    exported = export(small_machine, errors, "siemens-cec", reversal=reversal)
    control = controller_named("siemens-cec")(small_machine)
    sources = [SourceFile(Path(name), text) for name, text in exported.files.items()]
    tables = ReadTables(control, control.parse(sources), ())
    program = check_program(small_machine, tables, errors, reversal)
    y = program.position_mm[:, 1]
    np.testing.assert_allclose(program.off_mm[:, 1] / UM, 10.0 * (y - y[0]) / 400.0, atol=ROUNDING_UM)
    np.testing.assert_allclose(program.on_mm / UM, 0.0, atol=2 * ROUNDING_UM)


# --- levels ----------------------------------------------------------------------------------------------------------


def alone(machine, errors, tool_mm=None):
    """Largest displacement left by the single error of a table, by level, um."""
    tool = np.array(machine.tool_offset_mm if tool_mm is None else tool_mm, dtype=float)
    (name,) = errors.names
    return {level.key: level.left_alone_um(machine, errors, [tool])[0][name] for level in levels_of(machine, errors)}


def test_positioning_is_taken_out_by_every_level(small_machine):
    errors = single(small_machine, "EXX", lambda x: 1e-5 * (x + 50.0) * UM * 100)
    left = alone(small_machine, errors)
    assert left.pop("nothing") == pytest.approx(0.25, rel=1e-9)
    assert max(left.values()) < ROUNDING_UM


def test_straightness_needs_tables_across_and_its_largest_value_stays_without(small_machine):
    """A triangle of 10 um over Z: without tables across 5 um stay, since an axis may be shifted by a constant."""
    low, high = small_machine.axes[2].range_mm
    errors = single(small_machine, "EXZ", lambda z: 10 * UM * (1 - np.abs(2 * (z - low) / (high - low) - 1)))
    left = alone(small_machine, errors)
    assert left["nothing"] == pytest.approx(10.0 * 2 / 2, rel=1e-9)
    assert left["pitch"] == pytest.approx(5.0, abs=0.4)  # least squares, not the smallest maximum
    assert max(left[key] for key in ("straightness", "squareness", "products")) < ROUNDING_UM


def test_squareness_needs_more_than_straightness(small_machine):
    """dX = -EC0Y y: the shift of the best constant leaves EC0Y times half the travel of Y."""
    left = alone(small_machine, single(small_machine, "EC0Y", 40e-6))
    half_um = 40e-6 * 0.5 * 400.0 / UM
    assert left["nothing"] == pytest.approx(40e-6 * 300.0 / UM, rel=1e-9)
    assert left["pitch"] == pytest.approx(half_um, rel=1e-6)
    assert left["straightness"] == pytest.approx(half_um, rel=1e-6)
    assert max(left[key] for key in ("squareness", "products")) < ROUNDING_UM


def test_an_angle_leaves_its_deviation_times_half_the_travel_of_its_lever(small_machine):
    """WFYXZT: ECY acts as x ECY(y) on dY. With ECY linear from -50 to +50 urad the best tables of one axis leave
    (x - x_middle) ECY(y), at most 250 mm times 50 urad; products leave nothing."""
    machine = replace(small_machine, tool_offset_mm=(0.0, 0.0, 0.0))
    errors = single(machine, "ECY", lambda y: 50e-6 * (y - 100.0) / 200.0)
    left = alone(machine, errors)
    assert left["squareness"] == pytest.approx(250.0 * 50e-6 / UM, rel=1e-3)
    assert left["products"] < ROUNDING_UM
    assert left["volumetric"] == 0.0


def test_a_longer_tool_brings_back_the_angle_times_the_change_of_length(small_machine):
    """EBX acts on dX at the tool's length: tables made for -80 mm leave 120 mm times the angle at -200 mm."""
    errors = single(small_machine, "EBX", lambda x: 60e-6 * (x + 50.0) / 250.0)
    left = alone(small_machine, errors, (0.0, 0.0, -200.0))
    assert left["products"] == pytest.approx(120.0 * 60e-6 / UM, rel=1e-3)
    assert left["volumetric"] == 0.0


@pytest.fixture(scope="module")
def offered(small_machine, small_errors):
    return capability(small_machine, small_errors)


def test_each_level_leaves_less_than_the_one_before(offered):
    keys = [item.key for item in offered.levels]
    assert keys == [key for key in LABELS if key != "directional"]
    rms = {item.key: item.left.after.rms_um for item in offered.levels}
    assert rms["pitch"] < rms["nothing"]
    assert rms["squareness"] < rms["straightness"]
    assert rms["products"] < 0.5 * rms["squareness"]
    assert rms["volumetric"] < SECOND_ORDER_UM


def test_every_control_comes_within_5_percent_of_the_level_that_it_belongs_to(offered, small_machine):
    """The control's figure is that of its written text; beside the level it has its rounding and its own nodes."""
    expected = {
        "isg-csv": "volumetric",
        "etalon-exchange": "volumetric",
        "fanuc-pitch": "pitch",
        "siemens-eec": "pitch",
        "siemens-cec, with products": "products",
        "siemens-cec, without products": "squareness",
    }
    found = {item.label: item for item in offered.controls if item.label in expected}
    assert {label: item.level for label, item in found.items()} == expected
    for item in found.values():
        control = controller_named(item.name)
        resolution_um = control(small_machine).resolution_mm() / UM
        best = offered.level(item.level).left.rigid_removed.rms_um
        assert item.left.rigid_removed.rms_um < 1.05 * best + 2 * resolution_um + SECOND_ORDER_UM


def test_figures_of_a_level_are_those_of_the_exact_machine_at_its_points(small_machine, small_errors, offered):
    """Without tables: the plain error of the machine on the grid of nodes and middles, by the public functions."""
    levels = [
        np.unique(np.concatenate([a.nodes_mm, 0.5 * (a.nodes_mm[1:] + a.nodes_mm[:-1])])) for a in small_machine.axes
    ]
    position = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)
    size_um = np.linalg.norm(compgen.exact_error(small_machine, small_errors, position), axis=1) / UM
    figures = offered.level("nothing").left.after
    assert offered.points == len(position)
    assert figures.max_um == pytest.approx(size_um.max(), rel=1e-9)
    assert figures.rms_um == pytest.approx(np.sqrt(np.mean(size_um**2)), rel=1e-9)


def test_with_reversal_the_last_level_is_the_only_one_that_takes_it_out(small_machine, small_errors):
    result = capability(
        small_machine, small_errors, reversal=reversal_of(X=-8.0), controllers=("siemens-cec", "isg-csv")
    )
    assert result.level("volumetric").left.after.max_um == pytest.approx(4.0, abs=SECOND_ORDER_UM)
    assert result.level("directional").left.after.max_um < SECOND_ORDER_UM
    by_label = {item.label: item for item in result.controls}
    assert by_label["siemens-cec, with products"].directional
    assert by_label["siemens-cec, with products"].left.after.max_um < 0.5
    assert by_label["isg-csv"].left.after.max_um > 3.9


def test_a_zone_is_judged_by_itself_and_must_lie_within_the_travel(small_machine, small_errors, offered):
    travel = [axis.range_mm for axis in small_machine.axes]
    zone = zone_of("X=-100:100,Y=0:200", travel)
    result = capability(small_machine, small_errors, zone_mm=zone, controllers=())
    assert result.level("squareness").left.after.rms_um < 0.7 * offered.level("squareness").left.after.rms_um
    with pytest.raises(InputError, match="within the travel"):
        capability(small_machine, small_errors, zone_mm=((-400.0, 0.0), None, None), controllers=())


def test_a_control_whose_mode_of_products_is_not_stated_is_compared_all_the_same(small_machine, small_errors):
    machine = replace(small_machine, controllers={})
    without, products = capability(machine, small_errors, controllers=("siemens-cec",)).controls
    assert without.left is not None and products.left is not None
    assert not without.notes
    assert any("mult_mode is not stated" in note for note in products.notes)
    assert (without.own, products.own) == (True, False)


# --- explanation -----------------------------------------------------------------------------------------------------


def test_the_explanation_of_pitch_tables_names_what_stays_why_and_what_would_help(small_machine, small_errors):
    exported = export(small_machine, small_errors, "fanuc-pitch")
    found = explain(small_machine, small_errors, exported)
    fates = {fate.name: fate for fate in found.fates}
    assert fates["EXX"].after_um < 0.1
    assert fates["EXX"].why == ""
    assert "straightness" in fates["EYX"].why
    assert "squareness" in fates["EC0Y"].why
    assert "lever" in fates["EAY"].why
    assert {axis: node["nodes"] for axis, node in found.nodes.items()} == {
        axis: len(nodes) for axis, nodes in zip("XYZ", _pitch_nodes(small_machine, exported), strict=True)
    }
    shares = [usage.share for usage in found.usage]
    assert shares == sorted(shares, reverse=True)
    assert all(usage.used <= usage.allowed for usage in found.usage)
    assert found.options.after("pitch").key == "straightness"


def _pitch_nodes(machine, exported):
    plan = json.loads(exported.files["PITCH.plan.json"])
    parameters = {int(number): values for number, values in plan["parameters"].items()}
    for axis in ("1", "2", "3"):
        first, last = int(parameters[3621][axis]), int(parameters[3622][axis])
        yield range(first - 1, last + 1)  # section ends: one more than values


# --- commands --------------------------------------------------------------------------------------------------------


def test_options_prints_one_object_and_writes_both_files(call, small_machine_file, errors_file, tmp_path):
    out = tmp_path / "options"
    words = ("options", small_machine_file, errors_file, "--tool", "0,0,-150", "--out", out)
    code, stdout, _ = call(*words, "--json")
    assert code == 0
    data = json.loads(stdout)
    assert data == json.loads((out / "options.json").read_text())
    assert [item["level"] for item in data["levels"]] == [key for key in LABELS if key != "directional"]
    assert data["tools_mm"] == [[0.0, 0.0, -80.0], [0.0, 0.0, -150.0]]
    figures = data["levels"][3]["tools"][1]
    assert set(figures["uncorrected_um"]) == set(data["errors"])
    assert {"max_um", "rms_um", "p95_um"} <= set(figures["after_rigid_motion_removed"])
    text = (out / "options.md").read_text()
    assert "| + squareness |" in text
    assert "### Tool offset Z -150 mm" in text


def test_options_shows_a_table_and_refuses_a_wrong_tool_and_zone(call, small_machine_file, errors_file):
    code, stdout, _ = call("options", small_machine_file, errors_file)
    assert code == 0
    assert all(word in stdout for word in ("full volumetric", "siemens-cec", "Z -200", "gain"))
    for option, value in (("--tool", "1,2"), ("--tool", "0,0,x"), ("--zone", "X=5:1"), ("--zone", "X=-900:0")):
        code, _, stderr = call("options", small_machine_file, errors_file, option, value)
        assert code == 2
        assert option in stderr


def test_export_explains_beside_the_tables_only_when_asked(call, small_machine_file, errors_file, tmp_path):
    words = ("export", small_machine_file, errors_file, "--controller", "siemens-cec", "--out")
    assert call(*words, tmp_path / "plain")[0] == 0
    assert not (tmp_path / "plain" / "explain.md").exists()
    code, stdout, _ = call(*words, tmp_path / "told", "--explain")
    assert code == 0
    text = (tmp_path / "told" / "explain.md").read_text()
    assert text.strip() in stdout
    headings = ("What it corrects", "What remains, and why", "What the next option would gain", "Limits used")
    assert all(f"## {heading}\n" in text for heading in headings)
    same = "NC_CEC.INI"
    assert (tmp_path / "told" / same).read_bytes() == (tmp_path / "plain" / same).read_bytes()
    code, stdout, _ = call(*words, tmp_path / "json", "--explain", "--json")
    assert json.loads(stdout)["explain"]["level"] == "products"


def test_run_explains_every_control(call, small_machine_file, small_lengths_file, tmp_path):
    controls = ("--controller", "siemens-eec", "--controller", "isg-csv")
    out = tmp_path / "out"
    assert call("run", small_machine_file, small_lengths_file, *controls, "--out", out, "--explain")[0] == 0
    assert "positioning along each axis" in (out / "siemens-eec" / "explain.md").read_text()
    assert "volumetric model" in (out / "isg-csv" / "explain.md").read_text()


def test_verify_and_export_take_a_reversal_file(call, small_machine_file, errors_file, tmp_path):
    path, out = tmp_path / "a.reversal.csv", tmp_path / "tables"
    path.write_text(format_reversal(reversal_of(X=-8.0)))
    words = (small_machine_file, errors_file, "--controller", "siemens-cec", "--reversal", path, "--out", out)
    assert call("export", *words)[0] == 0
    manifest = json.loads((out / "manifest.json").read_text())
    assert "a.reversal.csv" in [item["name"] for item in manifest["inputs"]]
    judge = ("--controller", "siemens-cec", "--errors", errors_file, "--out", tmp_path / "judged")
    table = out / "NC_CEC.INI"
    assert call("verify", small_machine_file, table, *judge, "--reversal", path)[0] == 0
    path.write_text(format_reversal(reversal_of(X=8.0)))
    code, _, _ = call("verify", small_machine_file, table, *judge, "--reversal", path)
    assert code == 1


def test_a_corrected_program_leaves_half_a_step_and_the_uncertainty(small_machine, small_errors):
    """Rounding to 1 um: uniform, so 1/sqrt(12) um rms on each axis, at most half a step; no control is needed for it."""
    found = capability(small_machine, small_errors, controllers=("klipper",))
    left = found.program.left.after
    assert left.max_um <= 0.5 * np.sqrt(3) * 1.001
    assert left.rms_um == pytest.approx(np.sqrt(3 / 12), abs=0.1)
    u = [curve.u.max() for curve in small_errors.curves.values()]
    assert (found.program.u_um is None) == bool(np.all(np.isnan(u)))
    assert found.as_dict()["program"]["after"]["max_um"] == left.max_um
    assert "NC program corrected" in options_markdown(found)


def test_table_and_program_leave_what_the_model_of_correct_leaves(small_machine, small_errors, tmp_path):
    """The commands of `correct --active` at the same points, with the same table as its files say, in the same steps."""
    reversal = reversal_of(X=-8.0, YX=3.0)
    names = ("siemens-eec", "heidenhain-com", "klipper", "linuxcnc-comp")
    found = capability(small_machine, small_errors, controllers=names, reversal=reversal)
    nodes = [curve_nodes_mm(small_machine, small_errors, axis) for axis in range(3)]
    points = in_both_directions(Points(volume_grid(small_machine, nodes).position_mm))
    tool = np.array(small_machine.tool_offset_mm)
    for name in names:
        made = export(small_machine, small_errors, name, allow_unverified=True, reversal=reversal)
        for file, text in made.files.items():
            (tmp_path / file).write_text(text)
        tables = read_tables(small_machine, [tmp_path / file for file in made.files], name)
        model = CompensatedModel(small_machine, small_errors, reversal, tables=tables)
        both = next(item for item in found.controls if item.name == name and item.own).both
        command = model.command(points.position_mm, tool, points.approach)
        written = both.step_mm * np.round(command / both.step_mm)
        left = np.linalg.norm(written + model.error(written, tool, points.approach) - points.position_mm, axis=1)
        assert both.left.after.max_um == pytest.approx(1e3 * left.max(), abs=1e-6)
        assert both.left.after.max_um <= 0.5 * np.sqrt(3) * both.step_mm * 1e3 * 1.001
        # a program for the bare machine with the table active corrects part of the errors twice
        twice = ExactModel(small_machine, small_errors, reversal).command(points.position_mm, tool, points.approach)
        assert np.abs(twice + model.error(twice, tool, points.approach) - points.position_mm).max() > 5 * UM
        item = next(row for row in found.as_dict()["controls"] if row["controller"] == name)
        assert item["with_program"]["after"]["max_um"] == both.left.after.max_um
    assert "with program*, um" in options_markdown(found)


def test_programs_have_the_decimals_of_their_dialect():
    for name, dialect in (("siemens-cec", "siemens"), ("heidenhain-com", "heidenhain-iso"), ("fanuc-3d", "fanuc"),
                          ("heidenhain-kinematics", "heidenhain-iso"), ("linuxcnc-comp", "linuxcnc"),
                          ("linuxcnc-volumetric", "linuxcnc"), ("ucnc", "grbl")):  # fmt: skip
        step_mm = PROGRAM_STEPS_MM.get(name, PROGRAM_STEP_MM)
        assert step_mm == pytest.approx(10.0 ** -DIALECTS[dialect].decimals[0])
    assert set(PROGRAM_STEPS_MM) < set(CONTROLLERS)
