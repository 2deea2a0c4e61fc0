"""Measured diagonals (ISO 230-6): worked numbers, what is refused, before against after, and the simulated instrument."""

import json
import math
from itertools import product

import numpy as np
import pytest

from compgen.accuracy import SetupBudget, accuracy_of_errors, compare_sides, error_source, read_side
from compgen.accuracy.compare import CompareOptions
from compgen.accuracy.evaluate import KnownReversal
from compgen.accuracy.positioning import accuracy_of_diagonals, diagonal_runs
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import DIAGONALS, Diagonals, format_diagonals, read_diagonals
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves, format_errors, format_reversal
from compgen.data.machine import read_machine
from compgen.data.names import BODY_DIAGONALS
from compgen.errors import InputError
from compgen.kinematics import volumetric_error
from compgen.simulation import read_scenario, simulate_axis_runs

EXACT = 1e-9
BOX_MM = (300.0, 400.0, 1200.0)
LENGTH_MM = 1300.0
#: The worked example: mean and s (um) at five targets; readings are mean + s (-1, -1, 0, 1, 1).
GOLDEN_UP = [(2, 1), (6, 2), (0, 1), (-2, 2), (5, 3)]
GOLDEN_DOWN = [(-1, 1), (2, 1), (-3, 2), (-6, 1), (2, 2)]
STEPS = (-1, -1, 0, 1, 1)


def machine_file(folder, chain="WFYXZT", square="X", tool=(0.0, 0.0, 0.0), low=(0.0, 0.0, 0.0)):
    axes = "\n".join(
        f"[axes.{a}]\nrange_mm = [{start}, {start + edge}]\nnodes = 5"
        for a, start, edge in zip("XYZ", low, BOX_MM, strict=True)
    )
    text = f'name = "box"\nchain = "{chain}"\nsquareness_reference = "{square}"\ntool_offset_mm = {list(tool)}\n'
    path = folder / "box.toml"
    path.write_text(f"{text}reference_point_mm = {list(low)}\n{axes}\n")
    return path


@pytest.fixture
def machine(tmp_path):
    return read_machine(machine_file(tmp_path))


def line_of(name, count=5, share=1.0):
    """Positions (count, 3) from the start of a diagonal of the box."""
    ends = [(0.0, edge) if sign > 0 else (edge, 0.0) for sign, edge in zip(DIAGONALS[name], BOX_MM, strict=True)]
    columns = [np.linspace(a, a + share * (b - a), count) for a, b in ends]
    return np.column_stack(
        [c if sign else np.full(count, 100.0) for c, sign in zip(columns, DIAGONALS[name], strict=True)]
    )


def box_error_um(p):
    """Error vector of the worked box: EXX +10 at 300, EYY -20 at 400, EZZ +30 at 1200, EC0Y 10 urad."""
    x, y, z = p
    return np.array([10.0 * x / 300.0 - 10e-6 * 1e3 * y, -20.0 * y / 400.0, 30.0 * z / 1200.0])


def rows_of(name, up, down, count=5, runs=1):
    """Rows of a file: ``up`` and ``down`` give the deviation in um for (position, distance, run)."""
    points = line_of(name, count)
    for run, (way, value) in product(range(1, runs + 1), ((1, up), (-1, down))):
        for point in points[::way]:
            yield [name, *point, way, run, value(point, float(np.linalg.norm(point - points[0])), run)]


def written(path, rows, extra=""):
    lines = ["diagonal,x_mm,y_mm,z_mm,direction,run,deviation_um"]
    lines += [",".join(str(cell) if isinstance(cell, str | int) else repr(float(cell)) for cell in row) for row in rows]
    path.write_text("# source = made up\n" + "\n".join(lines) + "\n" + extra)
    return path


def projected(name, reversal_um=0.0, way=1):
    points = line_of(name)
    unit = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])
    return lambda p, s, run: float(unit @ (box_error_um(p) - box_error_um(points[0]))) + 0.5 * way * reversal_um


def box_file(path, names=tuple(BODY_DIAGONALS), reversal_um=None, runs=1):
    given = reversal_um or {}
    rows = []
    for name in names:
        b = given.get(name, 0.0)
        rows += rows_of(name, projected(name, b), projected(name, b, -1), runs=runs)
    return written(path, rows)


def accuracy_of(machine, path, **options):
    return accuracy_of_diagonals(machine, diagonal_runs(machine, read_diagonals(path)), **options)


def values_of(figures):
    return {key: item.value for key, item in figures.items()}


def test_the_worked_box_has_its_diagonals_and_its_squareness_exactly(machine, tmp_path):
    found = accuracy_of(machine, box_file(tmp_path / "b.diagonals.csv"))
    straight = (300.0 * 10.0 - 400.0 * 20.0 + 1200.0 * 30.0) / LENGTH_MM
    tilt = 10e-6 * 300.0 * 400.0 / LENGTH_MM * 1e3
    expected = {"PPP": straight - tilt, "NPP": straight + tilt, "PNP": straight + tilt, "NNP": straight - tilt}
    assert expected["PPP"] == pytest.approx(22.9231, abs=5e-5)
    assert expected["NPP"] - expected["PPP"] == pytest.approx(1.8462, abs=5e-5)
    for name, value in expected.items():
        for key in ("D", "E", "M", "E_up", "E_down"):
            assert found.groups[name][key].value == pytest.approx(value, abs=EXACT)
        assert found.groups[name]["B"].value == pytest.approx(0.0, abs=EXACT)
    assert found.groups["diagonals"]["Ed"].value == pytest.approx(24.769230769230770, abs=EXACT)
    assert values_of(found.groups["squareness indication"]) == pytest.approx(
        {"EC0Y": 10.0, "EB0Z": 0.0, "EA0Z": 0.0}, abs=1e-8
    )


def test_bd_is_the_largest_reversal_of_the_body_diagonals_by_size(machine, tmp_path):
    given = {"PPP": 1.0, "NPP": -3.5, "PNP": 2.0, "NNP": 0.0}
    found = accuracy_of(machine, box_file(tmp_path / "b.diagonals.csv", reversal_um=given)).groups
    for name, value in given.items():
        assert found[name]["B_mean"].value == pytest.approx(value, abs=EXACT)
        assert found[name]["B"].value == pytest.approx(abs(value), abs=EXACT)
    assert found["diagonals"]["Bd"].value == pytest.approx(3.5, abs=EXACT)
    assert "NPP" in found["diagonals"]["Bd"].meaning
    # E counts both directions: the mean range and half the reversal at either end
    assert found["NPP"]["E"].value == pytest.approx(found["NPP"]["M"].value + 3.5, abs=EXACT)


def golden_file(path, names=tuple(BODY_DIAGONALS)):
    rows = []
    for name in names:
        for way, table in ((1, GOLDEN_UP), (-1, GOLDEN_DOWN)):
            for run, step in enumerate(STEPS, start=1):
                for point, (mean, s) in zip(line_of(name), table, strict=True):
                    rows.append([name, *point, way, run, mean + s * step])
    return written(path, rows)


def test_a_diagonal_is_evaluated_as_iso_230_2_has_it_and_not_by_the_wrong_rules(machine, tmp_path):
    own = values_of(accuracy_of(machine, golden_file(tmp_path / "g.diagonals.csv")).groups["PNP"])
    expected = {"B": 4, "B_mean": 3.4, "M": 8, "R": 13, "R_up": 12, "R_down": 8, "E": 12, "E_up": 8, "E_down": 8}
    assert {key: own[key] for key in expected} == pytest.approx(expected, abs=EXACT)
    assert not {"A", "A_up", "A_down"} & set(own), "ISO 230-6 has no accuracy A"
    assert own["R"] > max(own["R_up"], own["R_down"]) + 0.5
    largest, smallest = 6.0, (-2.0, -6.0)
    assert own["E"] > largest - max(smallest) + 0.5
    assert own["E"] > max(own["E_up"], own["E_down"]) + 0.5


def test_every_figure_has_an_uncertainty_and_those_of_all_four_that_of_their_diagonal(machine, tmp_path):
    expansions = {"X": 8.0, "Y": 10.0, "Z": 12.0}
    budgets = {axis: SetupBudget(temperature_k=0.5, expansion_um_per_m_k=alpha) for axis, alpha in expansions.items()}
    found = accuracy_of(machine, golden_file(tmp_path / "g.diagonals.csv"), budgets=budgets).groups
    for group in found.values():
        assert all(math.isfinite(item.u) and item.u > 0.0 for item in group.values())
    assert found["diagonals"]["Bd"].u == found["PPP"]["B"].u
    alpha = (8 * 300.0**2 + 10 * 400.0**2 + 12 * 1200.0**2) / LENGTH_MM**2
    assert found["PPP"]["D"].contributions["temperature"] == pytest.approx(alpha * LENGTH_MM * 1e-3 * 0.5, abs=EXACT)


def test_the_uncertainty_of_the_indicated_squareness_is_its_scatter(machine):
    rng = np.random.default_rng(4)
    names = tuple(BODY_DIAGONALS)
    points = np.concatenate([line_of(name) for name in names])
    runs = 5
    common = {
        "name": tuple(name for _ in range(2 * runs) for name in names for _ in range(5)),
        "position_mm": np.tile(points, (2 * runs, 1)),
        "direction": np.repeat([1, -1] * runs, len(points)),
        "run": np.repeat(np.arange(runs), 2 * len(points)),
    }
    found, stated = [], []
    for _ in range(400):
        readings = Diagonals(deviation_mm=1e-3 * rng.normal(size=len(common["name"])), **common)
        figures = accuracy_of_diagonals(machine, diagonal_runs(machine, readings)).groups["squareness indication"]
        found.append([figures[key].value for key in figures])
        stated.append([figures[key].u ** 2 for key in figures])
    assert np.sqrt(np.mean(stated, axis=0)) == pytest.approx(np.std(found, axis=0), rel=0.1)


@pytest.mark.parametrize(
    ("chain", "square", "tool"),
    [
        ("WFYXZT", "X", (0, 0, 0)),
        ("WXYFZT", "X", (10.0, -20.0, -80.0)),
        ("WXFYZT", "Y", (0, 0, 50.0)),
        ("WZFYXT", "Y", (5, 0, 0)),
    ],
)
def test_squareness_is_indicated_with_its_sign_on_every_chain(tmp_path, chain, square, tool):
    machine = read_machine(machine_file(tmp_path, chain, square, tool, low=(-100.0, 50.0, -800.0)))
    given = {"EC0Y": (12e-6, math.nan), "EB0Z": (-7e-6, math.nan), "EA0Z": (4e-6, math.nan)}
    at = {name: np.array(axis.range_mm) for name, axis in zip(("EXX", "EYY", "EZZ"), machine.axes, strict=True)}
    curves = {name: Curve(ends, np.array([0.0, 0.02]), np.full(2, np.nan)) for name, ends in at.items()}
    parts = []
    for name in BODY_DIAGONALS:
        points = line_of(name) + np.array([-100.0, 50.0, -800.0])
        error = volumetric_error(machine, ErrorTable(curves, given), points)
        parts.append((points, (error - error[0]) @ (points[-1] - points[0]) / LENGTH_MM))
    readings = Diagonals(
        name=tuple(name for _ in range(2) for name in BODY_DIAGONALS for _ in range(5)),
        position_mm=np.tile(np.concatenate([points for points, _ in parts]), (2, 1)),
        direction=np.repeat([1, -1], 20),
        run=np.ones(40, dtype=np.int64),
        deviation_mm=np.tile(np.concatenate([values for _, values in parts]), 2),
    )
    found = values_of(accuracy_of_diagonals(machine, diagonal_runs(machine, readings)).groups["squareness indication"])
    assert found == pytest.approx({name: value * 1e6 for name, (value, _) in given.items()}, abs=1e-6)


def test_half_a_set_gives_single_diagonals_and_says_what_is_missing(machine, tmp_path):
    found = accuracy_of(machine, box_file(tmp_path / "b.diagonals.csv", ("PPP", "PNP")))
    assert found.groups["PPP"]["E"].value == pytest.approx(22.9231, abs=5e-5)
    assert set(found.groups) == {"PPP", "PNP"}
    assert any("Ed, Bd: not given; all four body diagonals are needed, NPP, NNP missing" in t for t in found.statements)


def test_one_direction_gives_no_ed_and_says_whose(machine, tmp_path):
    rows = []
    for name in BODY_DIAGONALS:
        own = list(rows_of(name, projected(name), projected(name)))
        rows += [row for row in own if name != "NPP" or row[4] == 1]
    found = accuracy_of(machine, written(tmp_path / "b.diagonals.csv", rows))
    assert found.groups["diagonals"] == {}
    assert set(found.groups["NPP"]) == {"E_up", "D"}
    assert any("Ed, Bd: not given; NPP measured in only one direction" in text for text in found.statements)
    assert found.groups["squareness indication"]["EC0Y"].value == pytest.approx(10.0, abs=1e-8)


def test_diagonals_of_another_box_are_no_set(machine, tmp_path):
    path = box_file(tmp_path / "b.diagonals.csv", ("PPP", "NPP", "PNP"))
    points = line_of("NNP", share=0.9)
    rows = [["NNP", *point, way, 1, 0.0] for way in (1, -1) for point in points]
    other = written(tmp_path / "c.diagonals.csv", rows)
    found = accuracy_of(machine, [path, other])
    assert any("NNP belong to a different box than PPP" in text for text in found.statements)
    assert "diagonals" not in found.groups


def test_face_diagonals_stand_by_themselves(machine, tmp_path):
    path = box_file(tmp_path / "b.diagonals.csv")
    far = written(tmp_path / "f.diagonals.csv", rows_of("N0P", lambda p, s, r: 0.2 * s, lambda p, s, r: 0.2 * s + 50.0))
    alone, beside = accuracy_of(machine, path), accuracy_of(machine, [path, far])
    length = math.hypot(300.0, 1200.0)
    assert beside.groups["N0P"]["M"].value == pytest.approx(0.2 * length, abs=EXACT)
    assert beside.groups["N0P"]["B"].value == pytest.approx(50.0, abs=EXACT)
    assert values_of(beside.groups["diagonals"]) == values_of(alone.groups["diagonals"])


def good_row(**change):
    row = {"diagonal": "PPP", "x": 0.0, "y": 0.0, "z": 0.0, "direction": 1, "run": 1, "value": 0.0, **change}
    return list(row.values())


END = {"x": 300.0, "y": 400.0, "z": 1200.0}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (
            [good_row(), good_row(**END, diagonal="PPN")],
            "2?.*'PPN' is not a diagonal; use PPP, NPP, PNP, NNP; of faces",
        ),
        ([good_row(), good_row(**END, direction=0)], "0 is not a direction"),
        ([good_row(), good_row(**END, value=2e5)], "is the unit um"),
        ([good_row(diagonal="NPP"), good_row(**END, diagonal="NPP")], "NPP runs from .* its letters are"),
        ([good_row(), good_row(x=150.0, y=201.0, z=600.0), good_row(**END)], "off the line between the ends of PPP"),
        ([good_row(), good_row(**END), good_row(**END)], ":5: .*PPP at \\(300, 400, 1200\\) mm.* already appears in"),
        ([good_row(diagonal="PP0"), good_row(**END, diagonal="PP0")], "PP0 runs from"),
    ],
)
def test_what_is_no_diagonal_is_refused_with_its_place(tmp_path, rows, message):
    with pytest.raises(InputError, match=message):
        read_diagonals(written(tmp_path / "b.diagonals.csv", rows))


def test_positions_outside_the_travel_and_half_measured_directions_are_refused(machine, tmp_path):
    outside = [good_row(), good_row(x=330.0, y=440.0, z=1320.0)]
    with pytest.raises(InputError, match=r"b\.diagonals\.csv:4: column x_mm: X = 330 mm is outside the travel"):
        diagonal_runs(machine, read_diagonals(written(tmp_path / "b.diagonals.csv", outside)))
    half = [good_row(), good_row(**END), good_row(**END, direction=-1)]
    with pytest.raises(InputError, match="PPP, distance along it: no reading at 0 mm in direction -1"):
        diagonal_runs(machine, read_diagonals(written(tmp_path / "b.diagonals.csv", half)))


def test_a_file_survives_the_round_trip(tmp_path):
    first = read_diagonals(box_file(tmp_path / "b.diagonals.csv", reversal_um={"PPP": 1.5}))
    again = tmp_path / "again.diagonals.csv"
    again.write_text(format_diagonals(first))
    second = read_diagonals(again)
    assert second.name == first.name
    np.testing.assert_array_equal(second.direction, first.direction)
    np.testing.assert_allclose(second.deviation_mm, first.deviation_mm, atol=0.5e-7)
    assert second.metadata == {"source": "made up"}


# --- before against after ------------------------------------------------------------------------------------------


def scaled_file(path, share, names=tuple(BODY_DIAGONALS), count=5, noise_um=0.05, seed=1):
    rng = np.random.default_rng(seed)
    rows = []
    for name in names:
        value = projected(name)
        rows += rows_of(
            name,
            lambda p, s, run, value=value: share * value(p, s, run) + noise_um * rng.normal(),
            lambda p, s, run, value=value: share * (value(p, s, run) - 4.0) + noise_um * rng.normal(),
            count,
            runs=3,
        )
    return written(path, rows)


def compared(machine, before, after, align=None):
    sides = [read_side(machine, path) for path in (before, after)]
    return compare_sides(*sides, CompareOptions(align))


def test_a_machine_with_a_fifth_of_its_errors_is_better_by_five(machine, tmp_path):
    before, after = (
        scaled_file(tmp_path / "b.diagonals.csv", 1.0),
        scaled_file(tmp_path / "a.diagonals.csv", 0.2, seed=2),
    )
    found = compared(machine, before, after)
    assert found.verdict == "better"
    assert found.decisive == (("diagonals", "Ed"), ("diagonals", "Bd"))
    assert found.groups["diagonals"]["Ed"].factor == pytest.approx(5.0, rel=0.05)
    assert found.groups["diagonals"]["Bd"].factor == pytest.approx(5.0, rel=0.15)
    assert compared(machine, after, before).verdict == "worse"


def test_other_positions_or_diagonals_are_refused_unless_aligned(machine, tmp_path):
    before = scaled_file(tmp_path / "b.diagonals.csv", 1.0)
    more = scaled_file(tmp_path / "m.diagonals.csv", 0.2, count=9)
    with pytest.raises(InputError, match="do not have the same targets of PPP"):
        compared(machine, before, more)
    assert compared(machine, before, more, "common").verdict == "better"
    few = scaled_file(tmp_path / "f.diagonals.csv", 0.2, names=("PPP", "NPP"))
    with pytest.raises(InputError, match="BEFORE has PPP, NPP, PNP, NNP, AFTER PPP, NPP"):
        compared(machine, before, few)
    found = compared(machine, before, few, "common")
    assert found.decisive == (("PPP", "E"), ("NPP", "E"))
    assert any("Ed, Bd: not given" in text for text in found.statements)


def test_a_diagonal_that_starts_elsewhere_on_the_same_line_is_compared_at_the_same_places(machine, tmp_path):
    """The reading is 10 um per m of the way from the corner in both files, AFTER without the first position."""
    line = line_of("PPP")
    marks = list(product((1, -1), (1, 2)))
    rows = [["PPP", *p, way, run, 0.01 * np.linalg.norm(p) + 0.1 * run * way] for p in line for way, run in marks]
    before = written(tmp_path / "b.diagonals.csv", rows)
    after = written(tmp_path / "a.diagonals.csv", [row for row in rows if row[1] > 0.0])
    found = compared(machine, before, after, "common")
    pair = found.groups["PPP"]["M"]
    assert pair.before.value == pytest.approx(pair.after.value, abs=EXACT)
    assert pair.before.value == pytest.approx(0.01 * LENGTH_MM * 0.75, abs=EXACT)
    shifted = [[*row[:1], row[1] + 5.0, *row[2:]] for row in rows if row[1] < 290.0]
    with pytest.raises(InputError, match="PPP is a different line in AFTER"):
        compared(machine, before, written(tmp_path / "s.diagonals.csv", shifted), "common")


def test_diagonals_compare_with_diagonals_only(machine, tmp_path):
    path = box_file(tmp_path / "b.diagonals.csv")
    errors = tmp_path / "e.errors.csv"
    errors.write_text(format_errors(ErrorTable({}, {"EC0Y": (1e-5, 1e-7)})))
    with pytest.raises(InputError, match="measured diagonals can only be compared with measured diagonals"):
        compared(machine, path, errors)


def test_the_commands_evaluate_and_compare_diagonals(tmp_path):
    box = machine_file(tmp_path)
    before, after = scaled_file(tmp_path / "b.diagonals.csv", 1.0), scaled_file(tmp_path / "a.diagonals.csv", 0.2)
    out = tmp_path / "out"
    assert run_command(cli, ["accuracy", str(box), str(before), "--out", str(out)]) == 0
    data = json.loads((out / "accuracy.json").read_text())
    assert {"PPP", "NPP", "PNP", "NNP", "diagonals", "squareness indication"} == data["figures"].keys()
    for group in data["figures"].values():
        assert all(item["U_k2"] > 0.0 for item in group.values())
    assert "Ed" in (out / "accuracy.txt").read_text()
    assert run_command(cli, ["compare", str(box), str(before), str(after), "--out", str(out)]) == 0
    assert json.loads((out / "compare.json").read_text())["verdict"] == "better"
    assert run_command(cli, ["compare", str(box), str(after), str(before), "--out", str(out)]) == 1


# --- simulated, and the reversal beside errors ----------------------------------------------------------------------

#: Half the play of each axis, um.
BACKLASH_UM = {"X": -1.5, "Y": 1.0, "Z": 0.5}


def scenario_file(folder, diagonals, inside=0.0):
    errors = folder / "true.errors.csv"
    curves = {}
    for name, edge, value in zip(("EXX", "EYY", "EZZ"), BOX_MM, (0.010, -0.020, 0.030), strict=True):
        curves[name] = Curve(np.array([0.0, edge]), np.array([0.0, value]), np.full(2, np.nan))
    errors.write_text(format_errors(ErrorTable(curves, {"EC0Y": (10e-6, math.nan)})))
    effects = "".join(f'[[effects]]\nname = "backlash_{a}"\nc_um = {c}\n' for a, c in BACKLASH_UM.items())
    path = folder / "s.toml"
    path.write_text(
        f'name = "s"\nseed = 1\n[errors]\nfile = "{errors.name}"\nrandom = false\n[instrument]\ntype = "diagonal-laser"\n'
        f"diagonals = {json.dumps(list(diagonals))}\ntargets = 5\ncycles = 2\nnoise_um = 0.0\ninside = {inside}\n{effects}"
    )
    return path


#: The exact model moves the tip by products of errors (1e-5 of an error).
SECOND_ORDER_UM = 1e-3
#: Along every diagonal an axis adds |u_k| times its own reversal, twice its half play.
REVERSAL_UM = (300.0 * -3.0 + 400.0 * 2.0 + 1200.0 * 1.0) / LENGTH_MM


def test_a_simulated_machine_gives_its_worked_diagonals_and_its_reversal(machine, tmp_path):
    path = scenario_file(tmp_path, BODY_DIAGONALS)
    assert (
        run_command(cli, ["simulate", str(machine.source), "--scenario", str(path), "--out", str(tmp_path / "sim")])
        == 0
    )
    found = accuracy_of(machine, tmp_path / "sim" / "s.diagonals.csv").groups
    for name, value in {"PPP": 22.9231, "NPP": 24.7692, "PNP": 24.7692, "NNP": 22.9231}.items():
        assert found[name]["D"].value == pytest.approx(value, abs=SECOND_ORDER_UM)
        assert found[name]["B_mean"].value == pytest.approx(REVERSAL_UM, abs=SECOND_ORDER_UM)
    assert found["diagonals"]["Bd"].value == pytest.approx(REVERSAL_UM, abs=SECOND_ORDER_UM)
    assert found["squareness indication"]["EC0Y"].value == pytest.approx(10.0, abs=0.01)


def test_simulated_face_diagonals_stay_inside_the_travel(machine, tmp_path):
    simulation = simulate_axis_runs(machine, read_scenario(scenario_file(tmp_path, ("PP0", "0NP"), 0.1)))
    readings = simulation.readings
    points = readings.position_mm[readings.rows("0NP")]
    assert points[:, 0].tolist() == [0.0] * len(points)
    assert (points[:, 1].min(), points[:, 1].max()) == (40.0, 360.0)
    first = points[readings.direction[readings.rows("0NP")] == 1][0]
    assert first.tolist() == [0.0, 360.0, 120.0]


def constant_reversal():
    curves = {}
    for axis, c_um in enumerate(BACKLASH_UM.values()):
        curves[axis, axis] = Curve(np.zeros(1), np.array([2e-3 * c_um]), np.array([1e-4]))
    return ReversalCurves(curves)


def box_source(machine):
    curves = {}
    for name, edge, value in zip(("EXX", "EYY", "EZZ"), BOX_MM, (0.010, -0.020, 0.030), strict=True):
        curves[name] = Curve(np.array([0.0, edge]), np.array([0.0, value]), np.full(2, 1e-4))
    return error_source(machine, ErrorTable(curves, {"EC0Y": (10e-6, 1e-7)}), prior=False)


def test_a_reversal_beside_errors_gives_both_directions_of_axes_and_diagonals(machine):
    known = KnownReversal(constant_reversal(), "reversal: made up")
    found = accuracy_of_errors(box_source(machine), reversal=known)
    figures = values_of(found.groups["reversal"])
    for letter, size in (("X", 10.0), ("Y", 20.0), ("Z", 30.0)):
        b = 2.0 * BACKLASH_UM[letter]
        assert figures[f"B_mean_{letter}"] == pytest.approx(b, abs=EXACT)
        assert figures[f"B_{letter}"] == pytest.approx(abs(b), abs=EXACT)
        assert figures[f"E_{letter}"] == pytest.approx(size + abs(b), abs=EXACT)
    for name in BODY_DIAGONALS:
        assert figures[f"B {name}"] == pytest.approx(REVERSAL_UM, abs=EXACT)
    assert figures["Bd"] == pytest.approx(REVERSAL_UM, abs=EXACT)
    assert figures["Ed"] == pytest.approx(24.769230769230770 + REVERSAL_UM, abs=EXACT)
    assert all(item.u > 0.0 for item in found.groups["reversal"].values())
    # E_X: two ends of the error (0.1 um each) and twice half the one reversal (0.1 um)
    assert found.groups["reversal"]["E_X"].u == pytest.approx(0.1 * math.sqrt(3.0), abs=1e-9)
    assert "reversal: made up" in found.statements


def test_a_reversal_over_the_position_is_largest_where_it_is(machine):
    curve = Curve(np.array([0.0, 100.0, 300.0]), np.array([1e-3, -4e-3, 2e-3]), np.array([1e-4, 2e-4, 3e-4]))
    known = KnownReversal(ReversalCurves({(0, 0): curve}), "")
    figures = accuracy_of_errors(box_source(machine), reversal=known).groups["reversal"]
    assert figures["B_X"].value == pytest.approx(4.0, abs=EXACT)
    assert figures["B_X"].u == pytest.approx(0.2, abs=EXACT)
    assert figures["B_mean_X"].value == pytest.approx(-1.0 / 3.0, abs=EXACT)
    # 10 um at 300 mm plus half of 2, 0 um at 0 mm minus half of 1; at 100 mm: 10/3 - 2 = 1.33
    assert figures["E_X"].value == pytest.approx(11.0 + 0.5, abs=EXACT)
    assert "B_Y" not in figures


def test_the_command_says_where_the_reversal_comes_from_or_that_it_is_not_known(machine, tmp_path):
    errors, out = tmp_path / "m.errors.csv", tmp_path / "out"
    errors.write_text(format_errors(box_source(machine).errors))
    words = ["accuracy", str(machine.source), str(errors), "--out", str(out)]
    assert run_command(cli, words) == 0
    data = json.loads((out / "accuracy.json").read_text())
    assert "reversal" not in data["figures"]
    assert any("reversal: unknown" in text and "m.reversal.csv does not exist" in text for text in data["statements"])
    (tmp_path / "m.reversal.csv").write_text(format_reversal(constant_reversal()))
    assert run_command(cli, words) == 0
    data = json.loads((out / "accuracy.json").read_text())
    assert data["figures"]["reversal"]["Bd"]["value"] == pytest.approx(REVERSAL_UM, abs=1e-5)
    assert any("reversal: m.reversal.csv" in text for text in data["statements"])


def test_a_folder_of_identified_errors_stands_for_its_errors_and_their_reversal(machine, tmp_path):
    folder, out = tmp_path / "identified", tmp_path / "out"
    folder.mkdir()
    words = ["accuracy", str(machine.source), str(folder), "--out", str(out)]
    assert run_command(cli, words) == 2
    (folder / "identified.errors.csv").write_text(format_errors(box_source(machine).errors))
    (folder / "identified.reversal.csv").write_text(format_reversal(constant_reversal()))
    assert run_command(cli, words) == 0
    data = json.loads((out / "accuracy.json").read_text())
    assert {"B_X", "E_Z", "Bd", "Ed"} <= data["figures"]["reversal"].keys()
    assert "identified.errors.csv" in [item["name"] for item in data["inputs"]]


def test_the_reversal_before_and_after_is_compared_where_both_know_it(machine, tmp_path):
    paths = []
    for name, factor in (("before", 1.0), ("after", 0.1)):
        path = tmp_path / f"{name}.errors.csv"
        path.write_text(format_errors(box_source(machine).errors))
        curves = {k: Curve(c.position_mm, factor * c.value, c.u) for k, c in constant_reversal().curves.items()}
        (tmp_path / f"{name}.reversal.csv").write_text(format_reversal(ReversalCurves(curves)))
        paths.append(path)
    found = compared(machine, *paths)
    assert found.groups["reversal"]["B_X"].factor == pytest.approx(10.0, rel=1e-9)
    assert found.groups["reversal"]["Bd"].verdict == "better"
    (tmp_path / "after.reversal.csv").unlink()
    found = compared(machine, *paths)
    assert "reversal" not in found.groups
    assert any(text.startswith("after.errors.csv: reversal: unknown") for text in found.statements)


def test_no_other_command_identifies_from_diagonals(machine, tmp_path, capsys):
    path = box_file(tmp_path / "b.diagonals.csv")
    assert run_command(cli, ["identify", str(machine.source), str(path), "--out", str(tmp_path / "out")]) == 2
    assert "contains measured diagonals" in " ".join(capsys.readouterr().err.split())
    assert run_command(cli, ["import", str(path)]) == 0  # shows what it holds, and converts nothing
    assert "diagonals" in capsys.readouterr().out


def test_a_diagonals_file_without_its_columns_is_told_what_is_missing(machine, tmp_path):
    path = tmp_path / "b.diagonals.csv"
    path.write_text("diagonal,s_mm,direction,run,deviation_um\nPPP,0,1,1,0\n")
    with pytest.raises(InputError, match="x_mm"):
        read_side(machine, path)


def test_axis_names_the_axis_of_an_instrument_file_and_no_other(machine, tmp_path):
    names = product(("FWD", "BWD"), (1, 2, 3), (1, 2))
    rows = [f"REF_DATA_{way}[{i},{j}]={100 * (i - 1) + 0.001 * i * j}" for way, i, j in names]
    path = tmp_path / "run7.dat"
    path.write_text("\n".join([*(f"TGT_DATA[{i}]={100 * (i - 1)}" for i in (1, 2, 3)), *rows]) + "\n")
    words = ["accuracy", str(machine.source), str(path), "--out", str(tmp_path / "out")]
    assert run_command(cli, words) == 2
    assert run_command(cli, [*words, "--axis", "y"]) == 0
    figures = json.loads((tmp_path / "out" / "accuracy.json").read_text())["figures"]
    assert list(figures) == ["Y"]
    assert figures["Y"]["M"]["value"] == pytest.approx(3.0, abs=EXACT)  # mean of 1 and 2 um per target number
    own = golden_file(tmp_path / "g.diagonals.csv")
    known = tmp_path / "x.axis.csv"
    known.write_text("axis,position_mm,direction,run,deviation_um\nX,0,1,1,1\nX,100,1,1,2\n")
    for file in (known, own):
        wrong = ["accuracy", str(machine.source), str(file), "--axis", "Y", "--out", str(tmp_path / "out")]
        assert run_command(cli, wrong) == 2


def test_a_reversal_that_is_not_worth_a_table_is_taken_from_the_summary_of_the_identification(machine, tmp_path):
    errors = tmp_path / "identified.errors.csv"
    errors.write_text(format_errors(box_source(machine).errors))
    summary = {"reversal": {"axes": {"X": {"vector_um": [-0.04, 0.0, 0.01], "u_um": [0.03, 0.02, 0.02]}}}}
    (tmp_path / "identify.json").write_text(json.dumps(summary))
    side = read_side(machine, errors)
    found = accuracy_of_errors(side.source, reversal=side.reversal).groups["reversal"]
    assert found["B_mean_X"].value == pytest.approx(-0.04, abs=EXACT)
    assert found["B_X"].u == pytest.approx(0.03, abs=EXACT)
    assert found["B PPP"].value == pytest.approx(abs(-0.04 * 300.0 + 0.01 * 1200.0) / LENGTH_MM, abs=EXACT)
    assert found["B NPP"].value == pytest.approx((0.04 * 300.0 + 0.01 * 1200.0) / LENGTH_MM, abs=EXACT)
    (tmp_path / "identified.reversal.csv").write_text(format_reversal(constant_reversal()))
    side = read_side(machine, errors)
    found = accuracy_of_errors(side.source, reversal=side.reversal).groups["reversal"]
    assert found["B_mean_X"].value == pytest.approx(2.0 * BACKLASH_UM["X"], abs=1e-6)
    for text in ("[1]", "{", '{"reversal": {"axes": {"Q": 1}}}', '{"reversal": null}'):
        (tmp_path / "identify.json").write_text(text)
        (tmp_path / "identified.reversal.csv").unlink(missing_ok=True)
        assert read_side(machine, errors).reversal.curves is None
