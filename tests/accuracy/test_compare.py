"""Before against after: what counts as better, what is refused, and what the commands write."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from compgen.accuracy import ComparedFigure, CompareOptions, Figure, compare_errors, error_source, read_side
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.error_table import Curve, ErrorTable, format_errors
from compgen.data.lengths import Points, format_lengths, format_points, read_lengths
from compgen.data.machine import read_machine
from compgen.data.names import CURVE_NAMES, ERROR_NAMES, error_named
from compgen.errors import InputError
from compgen.kinematics import gauge_directions, observable_errors, volumetric_error
from compgen.kinematics.exact_chain import exact_error
from compgen.tables import export, read_tables

TOML = """\
name = "mill"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [-50.0, 100.0, -40.0]
[axes.X]
range_mm = [-300.0, 200.0]
nodes = 6
[axes.Y]
range_mm = [-100.0, 300.0]
nodes = 5
[axes.Z]
range_mm = [-240.0, 0.0]
nodes = 4
"""


@pytest.fixture
def machine(tmp_path):
    path = tmp_path / "mill.toml"
    path.write_text(TOML)
    return read_machine(path)


def errors_of(machine, size_um=10.0, u_um=0.2, seed=1):
    rng = np.random.default_rng(seed)
    curves = {}
    for name in CURVE_NAMES:
        error, nodes = error_named(name), machine.axes[error_named(name).axis].nodes_mm
        bump = np.sin(np.pi * (nodes - nodes[0]) / (nodes[-1] - nodes[0])) + 0.3 * rng.normal(size=len(nodes))
        bump[[0, -1]] = 0.0
        if not error.is_straightness:
            bump = bump - np.interp(machine.reference_point_mm[error.axis], nodes, bump)
        curves[name] = Curve(nodes, size_um * error.si_per_unit * bump, np.full(len(nodes), u_um * error.si_per_unit))
    square = {name: (size_um * 1e-6, u_um * 1e-6) for name in ("EC0Y", "EB0Z", "EA0Z")}
    return ErrorTable(curves, square, {"machine": machine.name})


def save(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def figure(value, u):
    return Figure(value, u, "um", "")


# --- significance --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [
        ((10.0, 1.0), (3.0, 1.0), "better"),  # 8 ... 12 and 1 ... 5
        ((3.0, 1.0), (10.0, 1.0), "worse"),
        ((10.0, 1.0), (6.5, 1.0), "not separated"),  # En = 1.24, but 8 ... 12 and 4.5 ... 8.5 meet
        ((10.0, 1.0), (9.0, 1.0), "not separated"),
        ((-12.0, 1.0), (3.0, 1.0), "better"),  # sizes count
        ((3.0, 1.0), (-12.0, 1.0), "worse"),
        ((10.0, math.nan), (3.0, 1.0), "smaller"),
        ((3.0, 1.0), (10.0, math.nan), "larger"),
        ((3.0, math.nan), (3.0, math.nan), "same"),
    ],
)
def test_better_and_worse_need_bands_that_separate(before, after, verdict):
    assert ComparedFigure(figure(*before), figure(*after)).verdict == verdict


def test_separated_bands_always_have_en_above_one_and_not_the_other_way_round():
    rng = np.random.default_rng(0)
    for b, ub, a, ua in rng.uniform(0.1, 10.0, (500, 4)):
        item = ComparedFigure(figure(b, ub), figure(a, ua))
        assert not item.separated or item.en > 1.0
    close = ComparedFigure(figure(10.0, 1.0), figure(6.5, 1.0))
    assert close.en == pytest.approx(3.5 / math.sqrt(8.0))
    assert close.en > 1.0
    assert not close.separated


def test_the_uncertainty_of_a_factor_is_what_sampling_gives():
    rng = np.random.default_rng(2)
    item = ComparedFigure(figure(20.0, 0.4), figure(5.0, 0.1))
    drawn = rng.normal(20.0, 0.4, 200_000) / rng.normal(5.0, 0.1, 200_000)
    assert item.factor == pytest.approx(4.0)
    assert item.u_factor == pytest.approx(drawn.std(), rel=0.02)


# --- errors --------------------------------------------------------------------------------------------------------


def scaled(errors, factor):
    curves = {name: Curve(c.position_mm, factor * c.value, c.u) for name, c in errors.curves.items()}
    return errors.replace(
        curves=curves, squareness={name: (factor * value, u) for name, (value, u) in errors.squareness.items()}
    )


def test_errors_that_shrink_fivefold_improve_every_figure_fivefold(machine):
    errors = errors_of(machine)
    found = compare_errors(error_source(machine, errors), error_source(machine, scaled(errors, 0.2)))
    assert found.verdict == "better"
    for group in ("volume", "orientation", "axes", "diagonals", "errors"):
        for key, item in found.groups[group].items():
            tolerance = 1e-4 if key == "length" else 1e-9  # a length is not linear in the errors
            assert item.factor == pytest.approx(5.0, rel=tolerance), (group, key)


def gauge_moved(machine, errors, tools, seed=3, size_um=20.0):
    """Same machine, other constants and slopes."""
    rng = np.random.default_rng(seed)
    directions = gauge_directions(machine, errors.names, tools)
    levers = np.array([1.0 if error_named(name).kind == "linear" else 1000.0 for name in ERROR_NAMES])
    sizes = np.abs(levers[:, None] * directions * [1.0, 300.0]).max(axis=(1, 2))
    change = np.tensordot(rng.uniform(-1.0, 1.0, len(directions)) * size_um * 1e-3 / sizes, directions, axes=1)
    turn, shift = 40e-6, 0.02  # a rotation about z and a translation of the workpiece
    change[ERROR_NAMES.index("EYX"), 1] += turn
    change[ERROR_NAMES.index("EXY"), 1] -= turn
    change[ERROR_NAMES.index("EZZ"), 0] += shift
    curves, square = {}, {}
    for k, name in enumerate(ERROR_NAMES):
        if name in errors.curves:
            c = errors.curves[name]
            curves[name] = Curve(c.position_mm, c.value + change[k, 0] + change[k, 1] * c.position_mm, c.u)
        elif name in errors.squareness:
            square[name] = (errors.squareness[name][0] + change[k, 0], errors.squareness[name][1])
    return errors.replace(curves=curves, squareness=square)


@pytest.mark.parametrize("everything", [True, False])
def test_a_change_of_gauge_is_no_change_of_the_machine(machine, everything):
    """All 21 errors, with what several tools would not show; and the observable ones, with what one tool does not show."""
    errors, tools = errors_of(machine), np.array(machine.tool_offset_mm) + 50.0 * np.vstack([np.zeros(3), np.eye(3)])
    if not everything:
        errors, tools = errors.only(*observable_errors(machine)), None
    moved = gauge_moved(machine, errors, tools)
    points = np.array([[0.0, 0.0, 0.0], [-200.0, 250.0, -200.0], [150.0, -50.0, -100.0], [-100.0, 200.0, -10.0]])
    change = volumetric_error(machine, moved, points) - volumetric_error(machine, errors, points)
    assert np.abs(change).max() > 1e-3  # the frame did move
    found = compare_errors(error_source(machine, errors), error_source(machine, moved))
    assert any("gauge-aligned" in text for text in found.statements)
    for group, items in found.groups.items():
        for key, item in items.items():
            tolerance = 1e-2 if group == "diagonals" or key == "length" else 1e-6  # turned frames, second order
            assert item.after.value == pytest.approx(item.before.value, abs=tolerance), (group, key)
    given = compare_errors(
        error_source(machine, errors), error_source(machine, moved), CompareOptions(alignment="as-given")
    )
    assert abs(given.groups["volume"]["max"].gain) > 0.1


def test_the_best_fit_motion_stays_unless_it_is_asked_for(machine):
    errors = errors_of(machine)
    tilted = errors.replace(
        curves={
            **errors.curves,
            "EXX": Curve(errors.curves["EXX"].position_mm, errors.curves["EXX"].value + 0.05, errors.curves["EXX"].u),
        }
    )
    pair = error_source(machine, errors), error_source(machine, tilted)
    stays = compare_errors(*pair, CompareOptions(alignment="as-given"))
    assert stays.verdict == "worse"
    gone = compare_errors(*pair, CompareOptions(alignment="best-fit"))
    assert gone.groups["volume"]["rms"].gain == pytest.approx(0.0, abs=1e-6)
    assert any("rigid motion removed" in text for text in gone.statements)
    assert not any("rigid motion removed" in text for text in stays.statements)


def finer(errors, name, count=11):
    old = errors.curves[name]
    nodes = np.linspace(old.position_mm[0], old.position_mm[-1], count)
    u = np.interp(nodes, old.position_mm, old.u)
    return errors.replace(curves={**errors.curves, name: Curve(nodes, old.at(nodes), u)})


def test_different_positions_are_refused_and_interpolated_only_when_told(machine):
    errors = errors_of(machine)
    other = finer(errors, "EYX")  # X has 6 nodes: every second of 11 is one of them, so the curve is the same
    pair = error_source(machine, errors), error_source(machine, other)
    with pytest.raises(InputError, match=r"do not have the same positions of EYX.*-250 mm.*--align interpolate"):
        compare_errors(*pair)
    for align in ("interpolate", "common"):
        found = compare_errors(*pair, CompareOptions(align=align))
        assert found.groups["volume"]["rms"].gain == pytest.approx(0.0, abs=1e-9)
    fewer = error_source(machine, errors.only(*[name for name in errors.names if name != "EBX"]))
    with pytest.raises(InputError, match=r"same errors.*EBX.*--align common"):
        compare_errors(pair[0], fewer)
    common = compare_errors(pair[0], fewer, CompareOptions(align="common"))
    assert "EBX" not in common.groups["errors"]
    assert common.groups["volume"]["max"].gain == pytest.approx(0.0, abs=1e-9)


def test_interpolated_uncertainties_follow_the_covariance(machine):
    from compgen.accuracy.compare import resampled

    source = error_source(machine, errors_of(machine, u_um=0.4), prior=False)
    nodes = {"EXX": np.array([-250.0])}  # half way between -300 and -200
    middle = resampled(source, ["EXX"], nodes)
    assert middle.errors.curves["EXX"].u[0] == pytest.approx(0.4e-3 / math.sqrt(2.0))
    assert middle.u_of(np.ones(1)) == pytest.approx(0.4e-3 / math.sqrt(2.0))


# --- commands ------------------------------------------------------------------------------------------------------


def call(*words):
    return run_command(cli, [str(word) for word in words])


@pytest.fixture
def error_files(machine, tmp_path):
    errors = errors_of(machine)
    return [
        save(tmp_path / f"{name}.errors.csv", format_errors(scaled(errors, factor)))
        for name, factor in (("before", 1.0), ("after", 0.1), ("same", 0.99))
    ]


def test_compare_of_error_files_exits_by_the_verdict(machine, error_files, tmp_path, capsys):
    before, after, same = error_files
    out = tmp_path / "out"
    assert call("compare", machine.source, before, after, "--out", out) == 0
    data = json.loads((out / "compare.json").read_text())
    assert data["accepted"] is True
    assert data["verdict"] == "better"
    assert data["figures"]["volume"]["rms"]["factor"] == pytest.approx(10.0, rel=1e-6)
    assert {item["name"] for item in data["inputs"]} == {"mill.toml", "before.errors.csv", "after.errors.csv"}
    assert "better" in (out / "compare.txt").read_text().splitlines()[0]
    assert call("compare", machine.source, after, before, "--out", out) == 1
    assert json.loads((out / "compare.json").read_text())["verdict"] == "worse"
    assert call("compare", machine.source, before, same, "--out", out) == 1
    assert call("compare", machine.source, before, same, "--out", out, "--expect", "not-worse") == 0
    assert call("compare", machine.source, after, before, "--out", out, "--expect", "not-worse") == 1
    capsys.readouterr()
    call("compare", machine.source, before, after, "--out", out, "--json")
    printed = capsys.readouterr()
    assert json.loads(printed.out) == json.loads((out / "compare.json").read_text())


def test_without_uncertainties_smaller_is_accepted_but_never_called_better(machine, tmp_path):
    bare = [
        save(tmp_path / f"{k}.errors.csv", format_errors(scaled(errors_of(machine, u_um=np.nan), factor)))
        for k, factor in enumerate((1.0, 0.1))
    ]
    assert call("compare", machine.source, *bare, "--out", tmp_path / "out") == 0
    text = (tmp_path / "out" / "compare.json").read_text()
    data = json.loads(text)
    assert data["verdict"] == "smaller"
    assert "NaN" not in text
    assert data["figures"]["volume"]["max"]["en"] is None
    assert call("compare", machine.source, *bare[::-1], "--out", tmp_path / "out") == 1


def runs_file(path, factor=1.0, count=5, shift=0.0):
    rng = np.random.default_rng(8)
    targets = np.linspace(-300.0, 200.0, count) + shift
    rows = [(t, d, r) for t in targets for d in (1, -1) for r in range(1, 6)]
    position, direction, run = (np.array(column) for column in zip(*rows, strict=True))
    value = factor * (30e-6 * position + 2e-3 * direction + rng.normal(0.0, 0.5e-3, len(rows)))
    return save(path, format_axis_runs(AxisRuns(np.zeros(len(rows), int), position, direction, run, value)))


def test_axis_runs_compare_at_the_same_targets_only(machine, tmp_path, capsys):
    before, after = runs_file(tmp_path / "b.axis.csv"), runs_file(tmp_path / "a.axis.csv", 0.1)
    out = tmp_path / "out"
    assert call("compare", machine.source, before, after, "--out", out) == 0
    data = json.loads((out / "compare.json").read_text())
    assert data["figures"]["X"]["A"]["factor"] == pytest.approx(10.0, rel=1e-3)
    assert data["decided_by"] == ["X A"]
    more = runs_file(tmp_path / "m.axis.csv", 0.1, 6)
    capsys.readouterr()
    assert call("compare", machine.source, before, more, "--out", tmp_path / "none") == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "targets of X" in message
    assert "only BEFORE has -175 mm, -50 mm, 75 mm" in message
    assert not (tmp_path / "none").exists()
    assert call("compare", machine.source, before, more, "--out", out, "--align", "interpolate") == 0
    assert call("compare", machine.source, before, more, "--out", out, "--align", "common") == 0
    assert call("compare", machine.source, before, more, "--out", out, "--remove-rigid-motion") == 2
    assert call("compare", machine.source, before, tmp_path / "missing.csv", "--out", out) == 2


def grid_of(machine, count):
    levels = [np.linspace(*axis.range_mm, count) for axis in machine.axes]
    return np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)


NOISE_MM = 0.2e-3


def deviations_file(path, position, error, seed=0):
    rng = np.random.default_rng(seed)
    noisy = error + rng.normal(0.0, NOISE_MM, error.shape)
    return save(path, format_deviations(Deviations(position, noisy, np.full(error.shape, NOISE_MM))))


@pytest.fixture
def compensated(machine, tmp_path):
    """Measured positions before and after, the tables that were active then, and the errors behind them."""
    errors = errors_of(machine, size_um=20.0, u_um=0.02)
    exported = export(machine, errors, "isg-csv")
    paths = [path for path in exported.write(tmp_path / "tables") if path.name.endswith(".csv")]
    tables = read_tables(machine, paths, "isg-csv")
    position = grid_of(machine, 4)
    added = tables.correction(machine, Points(position))
    after = exact_error(machine, errors, position + added) + added
    return {
        "errors": save(tmp_path / "known.errors.csv", format_errors(errors)),
        "before": deviations_file(tmp_path / "b.deviations.csv", position, exact_error(machine, errors, position), 1),
        "after": deviations_file(tmp_path / "a.deviations.csv", position, after, 2),
        "wrong": deviations_file(tmp_path / "w.deviations.csv", position, after + 2e-6 * position, 3),
        "some": deviations_file(tmp_path / "s.deviations.csv", position[:40], after[:40], 4),
        "tables": paths[0],
    }


def test_measured_positions_compare_point_by_point(machine, compensated, tmp_path, capsys):
    out = tmp_path / "out"
    assert call("compare", machine.source, compensated["before"], compensated["after"], "--out", out) == 0
    data = json.loads((out / "compare.json").read_text())
    assert data["kind"] == "positions"
    assert data["figures"]["volume"]["rms"]["factor"] > 10.0
    assert any("as given" in text for text in data["statements"])
    capsys.readouterr()
    assert call("compare", machine.source, compensated["before"], compensated["some"], "--out", tmp_path / "no") == 2
    assert "--align common" in capsys.readouterr().err
    assert (
        call("compare", machine.source, compensated["before"], compensated["some"], "--out", out, "--align", "common")
        == 0
    )
    assert any("40 points" in text for text in json.loads((out / "compare.json").read_text())["statements"])


def test_points_in_another_order_are_the_same_points(machine, compensated, tmp_path):
    lines = compensated["after"].read_text().splitlines()
    head = next(k for k, line in enumerate(lines) if not line.startswith("#")) + 1
    shuffled = save(tmp_path / "r.deviations.csv", "\n".join([*lines[:head], *lines[head:][::-1]]) + "\n")
    found = []
    for k, after in enumerate((compensated["after"], shuffled)):
        call("compare", machine.source, compensated["before"], after, "--out", tmp_path / str(k))
        found.append(
            json.loads((tmp_path / str(k) / "compare.json").read_text())["figures"]["volume"]["rms"]["after"]["value"]
        )
    assert found[0] == pytest.approx(found[1])


def test_what_the_emulator_predicts_is_held_against_what_was_measured(machine, compensated, tmp_path):
    out = tmp_path / "out"
    words = ("--tables", compensated["tables"], "--controller", "isg-csv", "--out", out)
    assert call("compare", machine.source, compensated["errors"], compensated["after"], *words) == 0
    prediction = json.loads((out / "compare.json").read_text())["prediction"]
    assert prediction["verdict"] == "agrees"
    assert prediction["difference"]["rms"]["value"] == pytest.approx(1e3 * NOISE_MM * math.sqrt(3.0), rel=0.2)
    assert call("compare", machine.source, compensated["errors"], compensated["wrong"], *words) == 1
    assert json.loads((out / "compare.json").read_text())["prediction"]["verdict"] == "disagrees"
    # without its tables the machine is not what the tables' emulation predicts
    assert call("compare", machine.source, compensated["errors"], compensated["before"], *words) == 1


def test_a_prediction_is_judged_by_its_agreement(machine, compensated, tmp_path):
    out, errors = tmp_path / "out", compensated["errors"]
    words = ("--predicted", "--out", out)
    assert call("compare", machine.source, errors, compensated["before"], *words) == 0
    assert call("compare", machine.source, errors, compensated["after"], *words) == 1
    position = grid_of(machine, 4)
    exact = exact_error(machine, read_side(machine, errors).source.errors, position)
    columns = {f"e{axis}_um": 1e3 * exact[:, k] for k, axis in enumerate("xyz")}
    points = save(tmp_path / "p.csv", format_points(Points(position), columns))
    assert call("compare", machine.source, points, compensated["before"], *words) == 0
    few = {name: values[:10] for name, values in columns.items()}
    points = save(tmp_path / "f.csv", format_points(Points(position[:10]), few))
    assert call("compare", machine.source, points, compensated["before"], *words) == 2


@pytest.mark.parametrize(
    "words",
    [
        ("--predicted", "--tables", "x.csv", "--controller", "isg-csv"),
        ("--controller", "isg-csv"),
        ("--alignment", "axes", "--remove-rigid-motion"),
        ("--u-drift-um", "-1"),
        ("--align", "somehow"),
    ],
)
def test_contradictory_options_are_wrong_usage(machine, error_files, tmp_path, words):
    assert call("compare", machine.source, *error_files[:2], "--out", tmp_path / "out", *words) == 2
    assert not (tmp_path / "out").exists()


def test_unlike_kinds_are_refused(machine, error_files, tmp_path):
    runs = runs_file(tmp_path / "b.axis.csv")
    assert call("compare", machine.source, error_files[0], runs, "--out", tmp_path / "out") == 2


def test_accuracy_evaluates_runs_and_errors(machine, error_files, tmp_path):
    out = tmp_path / "out"
    assert call("accuracy", machine.source, runs_file(tmp_path / "b.axis.csv"), "--out", out, "--edition", "1988") == 0
    data = json.loads((out / "accuracy.json").read_text())
    assert {"B", "R", "E", "M", "A", "VDI P"} <= data["figures"]["X"].keys()
    assert any("1988" in text for text in data["statements"])
    assert call("accuracy", machine.source, error_files[0], "--out", out, "--line", "minzone") == 0
    data = json.loads((out / "accuracy.json").read_text())
    assert {"volume", "orientation", "axes", "diagonals", "errors", "straightness"} == data["figures"].keys()
    assert data["figures"]["straightness"]["EYX minzone"] == data["figures"]["errors"]["EYX"]


STATIONS_MM = {
    "S1": (-420.0, -210.0, -420.0),
    "S2": (330.0, -190.0, -405.0),
    "S3": (310.0, 410.0, -415.0),
    "S4": (-400.0, 430.0, -90.0),
}


def lengths_file(path, machine, template, errors, seed):
    """Readings of the template's targets for the given errors; the exact distances with noise."""
    lengths = read_lengths(template)
    station = np.array([STATIONS_MM[lengths.stations[k]] for k in lengths.station])
    tip = lengths.position_mm + np.array(machine.tool_offset_mm)
    actual = tip + exact_error(machine, errors, lengths.position_mm)
    noise = np.random.default_rng(seed).normal(0.0, 0.2e-3, len(lengths))
    reading = np.linalg.norm(actual - station, axis=1) - 150.0 + noise
    return save(path, format_lengths(replace(lengths, length_mm=reading)))


def test_identified_lengths_compare_and_other_targets_are_refused(
    small_machine, small_lengths_file, small_errors, tmp_path, capsys
):
    name = small_machine.source
    before, after = (
        lengths_file(tmp_path / f"{k}.lengths.csv", small_machine, small_lengths_file, scaled(small_errors, factor), k)
        for k, factor in enumerate((1.0, 0.1))
    )
    assert call("compare", name, before, after, "--out", tmp_path / "out") == 0
    data = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert data["verdict"] == "better"
    assert data["figures"]["errors"]["EXX"]["verdict"] == "better"
    assert data["figures"]["errors"]["EXX"]["factor"] == pytest.approx(10.0, rel=0.3)
    lengths = read_lengths(after)
    kept = np.flatnonzero(lengths.position_mm[:, 0] < 199.0)
    cut = save(tmp_path / "cut.lengths.csv", format_lengths(lengths.part(kept)))
    capsys.readouterr()
    assert call("compare", name, before, cut, "--out", tmp_path / "no") == 2
    assert "--align model" in capsys.readouterr().err


def test_foreign_files_are_evaluated_as_they_are(machine, tmp_path):
    """The ecmc file of the import tests holds the worked example of ISO 230-2 along X."""
    source = Path(__file__).parents[1] / "golden" / "imports" / "ecmc_ISO230.dat"
    assert call("import", source, "--axis", "X", "--out", tmp_path / "imported") == 0
    found = next((tmp_path / "imported").glob("*.axis.csv"))
    assert call("accuracy", machine.source, found, "--out", tmp_path / "out") == 0
    figures = json.loads((tmp_path / "out" / "accuracy.json").read_text())["figures"]["X"]
    worked = {"B": 4.0, "M": 8.0, "R": 13.0, "E": 12.0, "A": 19.0, "VDI P": 23.0}
    assert {key: figures[key]["value"] for key in worked} == pytest.approx(worked, abs=1e-6)
