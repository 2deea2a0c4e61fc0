"""Accuracy figures against worked numbers, brute force and sampling; wrong rules give other numbers."""

import csv
import io
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from compgen.accuracy import (
    SetupBudget,
    accuracy_of_errors,
    accuracy_of_runs,
    aligned,
    error_source,
    positioning_test,
    run_statistics,
    straightness,
    vdi_3441,
    volume_figures,
)
from compgen.accuracy.evaluate import diagonal_deviation, diagonal_points, squareness_figure, volume_fields
from compgen.accuracy.field import ErrorField, ErrorSource, grid_points, unknown_spread
from compgen.data.error_table import Curve, ErrorTable, fitted_line
from compgen.data.machine import read_machine
from compgen.data.names import CURVE_NAMES, error_named
from compgen.data.prior import PriorSettings
from compgen.errors import InputError
from compgen.kinematics import c_matrix, volumetric_error
from compgen.kinematics.first_order import observable_errors
from compgen.report.terminal import accuracy_table

EXACT = 1e-9

#: Deviations in um at 0, 100 ... 400 mm: mean + s (-1, -1, 0, 1, 1), so that means and estimators are whole numbers.
GOLDEN_UP = [(2, 1), (6, 2), (0, 1), (-2, 2), (5, 3)]
GOLDEN_DOWN = [(-1, 1), (2, 1), (-3, 2), (-6, 1), (2, 2)]


def pairs_by_hand(tip, error):
    """Largest difference of vectors and largest error of a distance, um, by trying every pair."""
    every = []
    for i, j in itertools.combinations(range(len(tip)), 2):
        line, apart = tip[i] - tip[j], error[i] - error[j]
        every.append((np.linalg.norm(apart), abs(np.linalg.norm(line + apart) - np.linalg.norm(line))))
    return [1e3 * max(values) for values in zip(*every, strict=True)]


@pytest.mark.parametrize("kind", ["random", "sheared", "turned", "measured twice", "ties", "one place", "none"])
def test_the_largest_pairs_are_those_of_all_pairs(kind):
    rng = np.random.default_rng(5)
    tip, error = rng.uniform(-900.0, 0.0, (90, 3)), rng.normal(0.0, 0.01, (90, 3))
    if kind == "sheared":
        error += tip[:, [1]] * [3e-3, 0.0, 0.0]
    elif kind == "turned":  # a rigid rotation to first order: no distance changes, but by its square
        error = np.cross([1e-4, -2e-4, 5e-4], tip)
    elif kind == "measured twice":
        tip[45:] = tip[:45]
    elif kind == "ties":
        error = np.round(error, 2)
    elif kind == "one place":
        tip[:] = tip[0]
    elif kind == "none":
        error[:] = 0.0
    figures = volume_figures(ErrorField(tip, tip, error, unknown_spread))
    found = [figures["difference"].value, figures["length"].value]
    assert found == pytest.approx(pairs_by_hand(tip, error), rel=1e-9, abs=1e-9)


def golden_readings():
    rows = [
        (100.0 * k, sign, (mean + s * step) * 1e-3)
        for sign, table in ((1, GOLDEN_UP), (-1, GOLDEN_DOWN))
        for k, (mean, s) in enumerate(table)
        for step in (-1, -1, 0, 1, 1)
    ]
    return tuple(np.array(column, dtype=float) for column in zip(*rows, strict=True))


@pytest.fixture
def golden():
    return run_statistics(*golden_readings())


def values_of(figures):
    return {key: item.value for key, item in figures.items()}


def test_iso_230_2_gives_the_worked_numbers(golden):
    expected = {
        "B": 4, "B_mean": 3.4, "M": 8, "R": 13, "R_up": 12, "R_down": 8,
        "E": 12, "E_up": 8, "E_down": 8, "A": 19, "A_up": 17, "A_down": 14,
    }  # fmt: skip
    assert values_of(positioning_test(golden).figures) == pytest.approx(expected, abs=EXACT)


def test_iso_230_2_gives_the_worked_values_at_each_target(golden):
    targets = positioning_test(golden).targets
    assert targets["B_um"] == pytest.approx([3, 4, 3, 4, 3], abs=EXACT)
    assert targets["mean_um"] == pytest.approx([0.5, 4, -1.5, -4, 3.5], abs=EXACT)
    assert targets["R_um"] == pytest.approx([7, 10, 9, 10, 13], abs=EXACT)


def test_the_uncertainties_at_each_target_are_those_of_means_of_five(golden):
    found = accuracy_of_runs({"X": golden}).summary()["targets"]["X"]
    assert found["position_mm"] == [0.0, 100.0, 200.0, 300.0, 400.0]
    assert found["u_mean_up_um"] == pytest.approx([s / np.sqrt(5.0) for _, s in GOLDEN_UP], abs=EXACT)
    expected = [np.hypot(u[1], d[1]) / np.sqrt(5.0) for u, d in zip(GOLDEN_UP, GOLDEN_DOWN, strict=True)]
    assert found["u_B_um"] == pytest.approx(expected, abs=EXACT)
    text = io.StringIO()
    Console(file=text, width=130).print(accuracy_table(accuracy_of_runs({"X": golden})))
    row = next(line.split() for line in text.getvalue().splitlines() if line.split()[:1] == ["400.00"])
    assert " ".join(row) == "400.00 5.00 +/- 2.68 2.00 +/- 1.79 3.00 +/- 3.22 3.00 2.00 13.00"


def test_vdi_3441_gives_the_worked_numbers(golden):
    expected = {"P_a": 8, "U_max": 4, "U_mean": 3.4, "P_s_max": 15, "P_s_mean": 9.6, "P": 23}
    assert values_of(vdi_3441(golden)) == pytest.approx(expected, abs=EXACT)


def test_the_wrong_rules_of_public_programs_are_not_followed(golden):
    found = values_of(positioning_test(golden).figures)
    assert max(found["R_up"], found["R_down"]) == pytest.approx(12, abs=EXACT)
    assert found["R"] > max(found["R_up"], found["R_down"]) + 0.5
    assert min(found["E_up"], found["E_down"]) == pytest.approx(8, abs=EXACT)
    assert found["E"] > max(found["E_up"], found["E_down"]) + 0.5
    assert found["A"] > max(found["A_up"], found["A_down"]) + 0.5
    means = positioning_test(golden).targets
    up, down = means["mean_up_um"], means["mean_down_um"]
    assert max(up.max(), down.max()) - max(up.min(), down.min()) == pytest.approx(8, abs=EXACT)


def test_the_editions_differ_in_the_factor_of_s_only(golden):
    old, new = (positioning_test(golden, year).figures for year in (1988, 2014))
    assert old["R_up"].value == pytest.approx(1.5 * new["R_up"].value, abs=EXACT)
    assert old["A"].value == pytest.approx(14 - (-9), abs=EXACT)  # 5 + 3 * 3 at 400 up, -6 - 3 * 1 at 300 down
    assert old["R"].value == pytest.approx(18, abs=EXACT)  # 6 * 3, above 3 * (3 + 2) + 3 at 400
    same = ("B", "B_mean", "M", "E", "E_up", "E_down")
    assert [old[key].value for key in same] == [new[key].value for key in same]
    for year in (1997, 2006):
        assert values_of(positioning_test(golden, year).figures) == values_of(new)
    with pytest.raises(InputError, match="1999"):
        positioning_test(golden, 1999)


def literal_iso_230_2(up, down):
    """The definitions written once more, row by row: runs (m, n) of both directions."""
    m_u, m_d, s_u, s_d = up.mean(1), down.mean(1), up.std(1, ddof=1), down.std(1, ddof=1)
    r_i = [max(2 * a + 2 * b + abs(u - d), 4 * a, 4 * b) for a, b, u, d in zip(s_u, s_d, m_u, m_d, strict=True)]
    tops, bottoms = np.r_[m_u + 2 * s_u, m_d + 2 * s_d], np.r_[m_u - 2 * s_u, m_d - 2 * s_d]
    both = np.r_[m_u, m_d]
    return {"B": max(abs(m_u - m_d)), "R": max(r_i), "E": both.max() - both.min(), "A": tops.max() - bottoms.min()}


@pytest.mark.parametrize("seed", range(20))
def test_any_readings_give_what_the_definitions_say_in_any_order(seed):
    rng = np.random.default_rng(seed)
    m, n = int(rng.integers(2, 9)), int(rng.integers(2, 7))
    up, down = rng.normal(0.0, 5e-3, (2, m, n)) + rng.normal(0.0, 5e-3, (2, m, 1))
    position = np.tile(np.repeat(np.sort(rng.uniform(-500, 0, m)), n), 2)
    direction = np.repeat([1.0, -1.0], m * n)
    values = np.concatenate([up.ravel(), down.ravel()])
    order = rng.permutation(len(values))
    found = positioning_test(run_statistics(position[order], direction[order], values[order])).figures
    for key, value in literal_iso_230_2(up, down).items():
        assert found[key].value == pytest.approx(value * 1e3, abs=1e-9)


def test_one_direction_or_single_runs_give_only_the_figures_that_they_show():
    position, direction, value = golden_readings()
    up = direction > 0
    one_way = positioning_test(run_statistics(position[up], direction[up], value[up])).figures
    assert set(one_way) == {"E_up", "R_up", "A_up"}
    single = np.r_[0:25:5, 25:50:5]
    once = positioning_test(run_statistics(position[single], direction[single], value[single])).figures
    assert set(once) == {"B", "B_mean", "M", "E", "E_up", "E_down"}
    assert np.isnan(once["E"].u)
    with pytest.raises(InputError, match="VDI"):
        vdi_3441(run_statistics(position[single], direction[single], value[single]))


def test_a_target_without_its_second_direction_is_refused():
    position, direction, value = golden_readings()
    kept = ~((position == 200) & (direction < 0))
    with pytest.raises(InputError, match=r"200 mm in direction -1"):
        run_statistics(position[kept], direction[kept], value[kept])


def test_the_uncertainty_from_scatter_is_what_repeated_tests_scatter():
    """Targets far apart keep the extreme ones the same, so that the linear uncertainty is exact."""
    rng = np.random.default_rng(5)
    means = np.array([[0.0, 30.0, 5.0], [-8.0, 24.0, -1.0]]) * 1e-3
    sigma = np.array([[1.0, 1.5, 0.7], [0.8, 1.2, 0.9]]) * 1e-3
    position, direction = np.tile(np.repeat([0.0, 100.0, 200.0], 5), 2), np.repeat([1.0, -1.0], 15)
    found, stated = [], []
    for _ in range(1500):
        readings = means[..., None] + sigma[..., None] * rng.normal(size=(2, 3, 5))
        figures = positioning_test(run_statistics(position, direction, readings.ravel())).figures
        found.append([figures[key].value for key in ("E", "A", "B_mean")])
        stated.append([figures[key].u ** 2 for key in ("E", "A", "B_mean")])
    assert np.sqrt(np.mean(stated, axis=0)) == pytest.approx(np.std(found, axis=0), rel=0.06)


def test_length_proportional_sources_act_on_e_by_the_distance_of_its_targets_and_not_on_reversal(golden):
    budget = SetupBudget(
        device_ppm=2.0, temperature_k=0.5, expansion_um_per_m_k=12.0, misalignment_mrad=1.0, drift_um=0.3
    )
    figures = positioning_test(golden, budget=budget).figures
    parts = figures["E"].contributions  # +6 at 100 mm up, -6 at 300 mm down: 0.2 m apart
    assert parts["device"] == pytest.approx(0.2 * 2.0, abs=EXACT)
    assert parts["temperature"] == pytest.approx(0.2 * 12.0 * 0.5, abs=EXACT)
    assert parts["misalignment"] == pytest.approx(0.2e6 * np.sqrt(2.0) * 1e-6, abs=EXACT)
    assert parts["drift"] == pytest.approx(0.3 * np.sqrt(2.0), abs=EXACT)
    assert figures["E"].u == pytest.approx(np.sqrt(sum(value**2 for value in parts.values())), abs=EXACT)
    assert set(figures["B"].contributions) == {"repeatability", "drift"}
    assert figures["R_up"].contributions.keys() == {"repeatability"}


# --- volume --------------------------------------------------------------------------------------------------------


def machine_of(tmp_path, travel, chain="WFYXZT", tool=(0.0, 0.0, 0.0), reference=(0.0, 0.0, 0.0), square="X"):
    axes = "\n".join(
        f"[axes.{a}]\nrange_mm = [{low}, {high}]\nnodes = 5" for a, (low, high) in zip("XYZ", travel, strict=True)
    )
    text = f'name = "box"\nchain = "{chain}"\nsquareness_reference = "{square}"\n'
    text += f"tool_offset_mm = {list(tool)}\nreference_point_mm = {list(reference)}\n{axes}\n"
    path = tmp_path / "box.toml"
    path.write_text(text)
    return read_machine(path)


@pytest.fixture
def box(tmp_path):
    return machine_of(tmp_path, [(0.0, 300.0), (0.0, 400.0), (0.0, 1200.0)])


def ramp(end_mm, value_um, u_um=np.nan):
    at = np.linspace(0.0, end_mm, 5)
    return Curve(at, value_um * 1e-3 * at / end_mm, np.full(5, u_um * 1e-3))


def box_errors(u_um=np.nan):
    curves = {"EXX": ramp(300.0, 10.0, u_um), "EYY": ramp(400.0, -20.0, u_um), "EZZ": ramp(1200.0, 30.0, u_um)}
    return ErrorTable(curves, {"EC0Y": (10e-6, u_um * 1e-6)})


def test_the_box_has_the_worked_volumetric_ranges_diagonals_and_squareness(box):
    groups = accuracy_of_errors(error_source(box, box_errors())).groups
    volume = values_of(groups["volume"])
    assert [volume[key] for key in ("V_X", "V_Y", "V_Z")] == pytest.approx([14.0, 20.0, 30.0], abs=EXACT)
    assert volume["max"] == pytest.approx(np.sqrt(6.0**2 + 20.0**2 + 30.0**2), abs=EXACT)
    assert volume["max"] == pytest.approx(36.5513, abs=5e-5)
    assert volume["difference"] == pytest.approx(np.sqrt(14.0**2 + 20.0**2 + 30.0**2), abs=EXACT)
    assert volume["difference"] == pytest.approx(38.6782, abs=5e-5)
    assert values_of(groups["orientation"]) == {"V_A": 0.0, "V_B": 0.0, "V_C": 0.0}
    diagonals = values_of(groups["diagonals"])
    x, y, length = 300.0, 400.0, 1300.0
    straight = (300.0 * 10.0 - 400.0 * 20.0 + 1200.0 * 30.0) / length
    tilt = 10e-6 * x * y / length * 1e3  # EC0Y X Y / L
    expected = {"PPP": straight - tilt, "NNP": straight - tilt, "NPP": straight + tilt, "PNP": straight + tilt}
    assert {name: diagonals[name] for name in expected} == pytest.approx(expected, abs=EXACT)
    assert diagonals["NPP"] - diagonals["PPP"] == pytest.approx(1.8462, abs=5e-5)
    assert diagonals["Ed"] == pytest.approx(24.7692, abs=5e-5)
    assert groups["errors"]["EC0Y"].value == pytest.approx(10.0, abs=EXACT)


def test_the_diagonal_of_a_measured_field_is_the_projection_from_its_start(box):
    points = diagonal_points(box, (-1, 1, 1))
    deviation = diagonal_deviation(box, volumetric_error(box, box_errors(), points), points)
    assert deviation[0] == 0.0
    assert deviation[-1] * 1e3 == pytest.approx(24.7692, abs=5e-5)


def random_errors(machine, seed, u_um=np.nan, names=CURVE_NAMES):
    rng = np.random.default_rng(seed)
    curves = {}
    for name in names:
        nodes = machine.axes[error_named(name).axis].nodes_mm
        unit = error_named(name).si_per_unit
        curves[name] = Curve(nodes, rng.normal(0.0, 10.0, len(nodes)) * unit, np.full(len(nodes), u_um * unit))
    square = {name: (float(rng.normal(0.0, 20.0)) * 1e-6, u_um * 1e-6) for name in ("EC0Y", "EB0Z", "EA0Z")}
    return ErrorTable(curves, square)


@pytest.fixture
def mill(tmp_path):
    travel = [(-300.0, 200.0), (-100.0, 300.0), (-240.0, 0.0)]
    return machine_of(tmp_path, travel, "WYFXZT", (10.0, -20.0, -80.0), (-50.0, 100.0, -40.0))


def test_the_largest_length_error_is_that_of_brute_force(mill):
    source = error_source(mill, random_errors(mill, 3))
    points = grid_points(mill, tuple(np.linspace(*axis.range_mm, 4) for axis in mill.axes))
    field = source.field(points)
    figures = volume_figures(field)
    tips, actual = field.tip_mm, field.tip_mm + field.error_mm
    lengths, apart = [], []
    for i, j in itertools.combinations(range(len(points)), 2):
        lengths.append(abs(np.linalg.norm(actual[i] - actual[j]) - np.linalg.norm(tips[i] - tips[j])))
        apart.append(np.linalg.norm(field.error_mm[i] - field.error_mm[j]))
    assert figures["length"].value == pytest.approx(1e3 * max(lengths), abs=1e-8)
    assert figures["difference"].value == pytest.approx(1e3 * max(apart), abs=1e-8)


def test_a_rigid_motion_changes_no_figure_of_the_alignment_to_the_axes_or_of_the_best_fit(mill):
    """Also the largest length error does not see it; the figures as given do."""
    rotation, shift = np.array([30e-6, -20e-6, 50e-6]), np.array([0.02, -0.01, 0.03])
    source = error_source(mill, random_errors(mill, 4))
    points = grid_points(mill, tuple(np.linspace(*axis.range_mm, 5) for axis in mill.axes))
    field = source.field(points)
    moved = type(field)(
        field.position_mm, field.tip_mm, field.error_mm + shift + np.cross(rotation, field.tip_mm), field.spread
    )
    second_order_um = 0.5 * float(rotation @ rotation) * 1000.0 * 1e3 + 60e-6 * 60e-6 * 1e6 + 60e-6 * 40.0
    for alignment in ("axes", "best-fit"):
        first, second = (values_of(volume_figures(aligned(mill, item, alignment))) for item in (field, moved))
        tolerance = 1e-8 if alignment == "axes" else second_order_um
        for key in ("V_X", "V_Y", "V_Z", "max", "rms", "p95"):
            assert second[key] == pytest.approx(first[key], abs=tolerance)
    as_given = [volume_figures(item)["max"].value for item in (field, moved)]
    assert abs(as_given[1] - as_given[0]) > 1.0
    lengths = [volume_figures(item)["length"].value for item in (field, moved)]
    assert lengths[1] == pytest.approx(lengths[0], abs=second_order_um)


@pytest.mark.parametrize("square", ["X", "Y"])
def test_aligned_axes_are_straight_between_their_ends_and_zero_at_the_reference(tmp_path, square):
    travel = [(-300.0, 200.0), (-100.0, 300.0), (-240.0, 0.0)]
    machine = machine_of(tmp_path, travel, tool=(10.0, -20.0, -80.0), reference=(-50.0, 100.0, -40.0), square=square)
    source = error_source(machine, random_errors(machine, 6))
    points = grid_points(machine, tuple(np.linspace(*axis.range_mm, 3) for axis in machine.axes))
    field = aligned(machine, source.field(points), "axes")

    def at(x, y, z):
        return field.error_mm[np.flatnonzero(np.all(field.position_mm == [x, y, z], axis=1))[0]]

    assert at(-50.0, 100.0, -40.0) == pytest.approx(np.zeros(3), abs=1e-12)
    ends_x, ends_y = (at(-300, 100, -40), at(200, 100, -40)), (at(-50, -100, -40), at(-50, 300, -40))
    assert ends_x[0][2] == pytest.approx(ends_x[1][2], abs=1e-12)
    assert ends_y[0][2] == pytest.approx(ends_y[1][2], abs=1e-12)
    across = (ends_x[0][1], ends_x[1][1]) if square == "X" else (ends_y[0][0], ends_y[1][0])
    assert across[0] == pytest.approx(across[1], abs=1e-12)


def test_orientation_ranges_are_those_of_the_summed_angles(mill):
    errors = random_errors(mill, 8)
    found = values_of(accuracy_of_errors(error_source(mill, errors)).groups["orientation"])
    grid = np.stack(np.meshgrid(*(axis.nodes_mm for axis in mill.axes), indexing="ij"), axis=-1).reshape(-1, 3)
    values = errors.at(grid)
    for k, letter in enumerate("ABC"):
        turn = values[:, 3 + k] + values[:, 9 + k] + values[:, 15 + k]
        assert found[f"V_{letter}"] == pytest.approx(1e6 * np.ptp(turn), abs=1e-8)


# --- uncertainty of fields -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("alignment", ["as-given", "axes", "best-fit"])
def test_uncertainties_of_a_volume_are_what_sampled_errors_scatter(mill, alignment):
    """Sampling knows nothing of derivatives: figures of 400 drawn machines, their errors small against the field."""
    errors, u_um = random_errors(mill, 11), 0.02
    known = random_errors(mill, 11, u_um)
    rng = np.random.default_rng(12)
    source = error_source(mill, known, prior=False)
    points = grid_points(mill, tuple(np.linspace(*axis.range_mm, 4) for axis in mill.axes))
    stated = volume_figures(aligned(mill, source.field(points), alignment))
    keys = ("V_X", "V_Y", "V_Z", "max", "rms", "difference", "length")
    found = []
    for _ in range(400):
        curves = {
            name: Curve(c.position_mm, c.value + rng.normal(0.0, known.curves[name].u), c.u)
            for name, c in errors.curves.items()
        }
        square = {
            name: (value + rng.normal(0.0, known.squareness[name][1]), u)
            for name, (value, u) in errors.squareness.items()
        }
        drawn = error_source(mill, ErrorTable(curves, square)).field(points)
        figures = volume_figures(aligned(mill, drawn, alignment))
        found.append([figures[key].value for key in keys])
    scatter = np.std(found, axis=0, ddof=1)
    four_sigma = 4.0 / np.sqrt(2.0 * 399)
    assert np.array([stated[key].u for key in keys]) == pytest.approx(scatter, rel=four_sigma)


def test_the_covariance_of_values_counts_not_only_their_own_uncertainties(box):
    errors = box_errors(0.5)
    count = 16
    together = error_source(box, errors, prior=False)
    common = type(together)(box, errors, np.full((count, 1), 0.5e-3))  # all values move as one
    assert together.u_of(together.value_gradient("EXX", np.array([-1.0, 0, 0, 0, 1.0]))) == pytest.approx(
        0.5e-3 * 2**0.5
    )
    assert common.u_of(common.value_gradient("EXX", np.array([-1.0, 0, 0, 0, 1.0]))) == pytest.approx(0.0, abs=1e-15)


# --- straightness and squareness -----------------------------------------------------------------------------------


def brute_minimum_zone(position, value):
    """Narrowest strip over all slopes through two of the points."""
    slopes = [
        (value[j] - value[i]) / (position[j] - position[i]) for i, j in itertools.combinations(range(len(value)), 2)
    ]
    return min(np.ptp(value - slope * position) for slope in slopes)


@pytest.mark.parametrize("seed", range(10))
def test_straightness_by_three_lines_is_that_of_the_definitions(seed):
    rng = np.random.default_rng(seed)
    position = np.sort(rng.uniform(-500.0, 300.0, 12))
    value = rng.normal(0.0, 5e-3, 12) + 40e-6 * position
    through = value[0] + (value[-1] - value[0]) * (position - position[0]) / (position[-1] - position[0])
    fitted = np.polyval(np.polyfit(position, value, 1), position)
    assert straightness(position, value, "end-point")[0] == pytest.approx(np.ptp(value - through), abs=1e-12)
    assert straightness(position, value, "ls")[0] == pytest.approx(np.ptp(value - fitted), abs=1e-12)
    assert straightness(position, value, "minzone")[0] == pytest.approx(brute_minimum_zone(position, value), abs=1e-12)
    zone = straightness(position, value, "minzone")[0]
    assert zone <= min(straightness(position, value, line)[0] for line in ("end-point", "ls")) + 1e-12


@pytest.mark.parametrize("line", ["end-point", "ls", "minzone"])
def test_derivatives_of_straightness_are_difference_quotients(line):
    rng = np.random.default_rng(21)
    position, value = np.linspace(0.0, 500.0, 9), rng.normal(0.0, 5e-3, 9)
    step = 1e-8
    numeric = [
        (straightness(position, value + step * unit, line)[0] - straightness(position, value - step * unit, line)[0])
        / (2 * step)
        for unit in np.eye(9)
    ]
    assert straightness(position, value, line)[1] == pytest.approx(numeric, abs=1e-6)


@pytest.mark.parametrize("line", ["end-point", "ls", "minzone"])
@pytest.mark.parametrize(("square", "curve", "axis"), [("EC0Y", "EXY", 1), ("EB0Z", "EXZ", 2), ("EA0Z", "EYZ", 2)])
def test_moving_a_reference_line_into_squareness_leaves_volume_and_figures(mill, line, square, curve, axis):
    errors = random_errors(mill, 31)
    old = errors.curves[curve]
    constant, slope = fitted_line(old.position_mm, old.value, line)
    column = c_matrix(mill, np.eye(3)[[axis]], np.zeros(3))[0, error_named(curve).direction]
    sign = column[[18, 19, 20][["EC0Y", "EB0Z", "EA0Z"].index(square)]]
    moved = errors.replace(
        curves={**errors.curves, curve: Curve(old.position_mm, old.value - slope * old.position_mm, old.u)},
        squareness={**errors.squareness, square: (errors.squareness[square][0] + slope / sign, np.nan)},
    )
    points = grid_points(mill, tuple(axis.nodes_mm for axis in mill.axes))
    before, after = volumetric_error(mill, errors, points), volumetric_error(mill, moved, points)
    assert after == pytest.approx(before, abs=1e-12)
    first, second = (error_source(mill, table) for table in (errors, moved))
    assert squareness_figure(second, square, line).value == pytest.approx(
        squareness_figure(first, square, line).value, abs=1e-8
    )
    if line == "end-point":  # the line is gone from the curve, so the table's value is the figure but for X's line
        assert abs(squareness_figure(first, square, line).value - errors.squareness[square][0] * 1e6) > 0.1


def test_squareness_is_the_angle_between_the_lines_that_the_machine_moves(tmp_path):
    """Directions of the X and Y motion from the field itself, for curves that are straight lines."""
    machine = machine_of(tmp_path, [(0.0, 300.0), (0.0, 400.0), (0.0, 200.0)])
    slopes = {"EYX": 7e-6, "EZX": -4e-6, "EXY": 3e-6, "EZY": 9e-6, "EXZ": -6e-6, "EYZ": 2e-6}
    curves = {
        name: Curve(machine.axes[error_named(name).axis].nodes_mm, slope * machine.axes[error_named(name).axis].nodes_mm,
                    np.full(5, np.nan))
        for name, slope in slopes.items()
    }  # fmt: skip
    table = ErrorTable(curves, {"EC0Y": (10e-6, np.nan), "EB0Z": (-5e-6, np.nan), "EA0Z": (8e-6, np.nan)})
    source = error_source(machine, table)
    ends = np.diag([300.0, 400.0, 200.0])
    motion = ends + volumetric_error(machine, table, ends)
    x, y, z = motion / np.linalg.norm(motion, axis=1)[:, None]
    second_order = 1e-3
    # EC0Y > 0 turns Y about +Z: away from X. EB0Z > 0 turns Z towards +X, EA0Z > 0 turns Z towards -Y.
    assert squareness_figure(source, "EC0Y").value == pytest.approx(-1e6 * x @ y, abs=second_order)
    assert squareness_figure(source, "EB0Z").value == pytest.approx(+1e6 * x @ z, abs=second_order)
    assert squareness_figure(source, "EA0Z").value == pytest.approx(-1e6 * y @ z, abs=second_order)


def test_the_golden_file_holds_the_same_readings():
    path = Path(__file__).parents[1] / "golden" / "accuracy" / "iso230_2_constructed_golden.csv"
    rows = [row for row in csv.reader(path.read_text().splitlines()) if not row[0].startswith("#")][1:]
    readings = sorted((float(t), float(d), float(v) * 1e-3) for t, d, *runs in rows for v in runs)
    expected = sorted(zip(*(column.tolist() for column in golden_readings()), strict=True))
    assert np.array(readings) == pytest.approx(np.array(expected), abs=1e-15)


def test_all_volume_fields_of_a_comparison_stand_at_the_same_points(mill):
    sources = (error_source(mill, random_errors(mill, 1)), error_source(mill, random_errors(mill, 2)))
    (first, _), (second, _) = volume_fields(mill, sources, "axes")
    assert np.array_equal(first.position_mm, second.position_mm)


# --- errors that were not measured ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def squareness_only(tmp_path_factory):
    """A machine of which three squareness errors were measured, to 2 urad, and its figures."""
    machine = machine_of(tmp_path_factory.mktemp("open"), [(0.0, 400.0), (0.0, 300.0), (0.0, 200.0)])
    known = ErrorTable({}, {"EC0Y": (30e-6, 2e-6), "EB0Z": (-20e-6, 2e-6), "EA0Z": (10e-6, 2e-6)})
    return machine, known, accuracy_of_errors(error_source(machine, known))


def drawn_machine(machine, known, rng):
    """The squareness as measured, all curves drawn from the prior of class general, as docs/method.md states it."""
    curves = {}
    for name in observable_errors(machine):
        error = error_named(name)
        if error.kind == "squareness":
            continue
        axis = machine.axes[error.axis]
        x, length = axis.nodes_mm, axis.length_mm
        size = 12e-6 if error.kind == "angular" else 2.5e-3 if error.is_straightness else 6e-3
        d = np.sqrt(5.0) * np.abs(x[:, None] - x[None, :]) / (0.3 * length)
        rough = 0.01 * np.exp(-np.abs(x[:, None] - x[None, :]) / (0.03 * length))
        kernel = size**2 * ((1.0 + d + d * d / 3.0) * np.exp(-d) + rough)
        value = np.linalg.cholesky(kernel + 1e-12 * size**2 * np.eye(len(x))) @ rng.standard_normal(len(x))
        if error.is_straightness:
            share = (x - x[0]) / length
            value = value - (1.0 - share) * value[0] - share * value[-1]
        else:
            value = value - value[0]  # the reference point is the lower end
            if error.kind == "linear":
                value = value + 15e-6 * rng.standard_normal() * x
        curves[name] = Curve(x, value, np.zeros(len(x)))
    square = {name: (value + u * rng.standard_normal(), 0.0) for name, (value, u) in known.squareness.items()}
    return ErrorTable(curves, square)


def test_figures_of_a_machine_that_was_hardly_measured_hold_what_the_class_lets_expect(squareness_only):
    """Z from three squareness errors alone was 0.00 +- 0.00; figures of drawn machines lie within U."""
    machine, known, found = squareness_only
    volume, rng = found.groups["volume"], np.random.default_rng(8)
    points = grid_points(machine, tuple(np.linspace(*axis.range_mm, 5) for axis in machine.axes))
    within = dict.fromkeys(("V_X", "V_Y", "V_Z", "rms", "max", "difference"), 0)
    count = 150
    for _ in range(count):
        source = ErrorSource(machine, drawn_machine(machine, known, rng))
        figures = volume_figures(aligned(machine, source.field(points), "axes"))
        for key in within:
            within[key] += abs(figures[key].value - volume[key].value) <= volume[key].expanded
    assert all(number >= 0.9 * count for number in within.values()), within
    assert volume["V_Z"].value > 1.0 and volume["V_Z"].u > 1.0
    assert set(found.groups["errors"]) == {"EC0Y", "EB0Z", "EA0Z"}, "errors that nobody measured are not listed"
    assert found.groups["errors"]["EC0Y"].value == pytest.approx(30.0)
    assert found.groups["errors"]["EC0Y"].u == pytest.approx(2.0, rel=0.05)
    assert any(text.startswith("assumed for what was not measured") for text in found.statements)


def test_without_a_prior_only_the_table_counts(squareness_only):
    machine, known, _ = squareness_only
    bare = replace(machine, prior=PriorSettings(class_name="none"))
    found = accuracy_of_errors(error_source(bare, known))
    assert found.groups["volume"]["rms"].u < 1.0
    assert not any("assumed" in text for text in found.statements)


def test_a_machine_that_was_measured_keeps_its_values(mill):
    """Values as those of the table; the uncertainty also has what a curve does between its nodes."""
    errors = random_errors(mill, 21, 0.1)
    plain, whole = (accuracy_of_errors(error_source(mill, errors, prior=prior)) for prior in (False, True))
    assert {group: set(part) for group, part in plain.groups.items()} == {g: set(p) for g, p in whole.groups.items()}
    for group, part in plain.groups.items():
        for key, item in part.items():
            found = whole.groups[group][key]
            off = abs(found.value - item.value)
            if "mean over what" in found.meaning:  # a range: what curves do between their nodes makes it larger
                assert 0.0 < off < found.u, (group, key)
            else:
                assert off < 1e-9 * max(1.0, abs(item.value)), (group, key)
    assert whole.groups["volume"]["rms"].u >= 0.5 * plain.groups["volume"]["rms"].u
