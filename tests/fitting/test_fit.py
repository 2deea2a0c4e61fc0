"""The fit stage: endpoint zeroing, smoothing, bounds, uncertainty."""

import importlib
import json
import math
import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal

import machines
from compgen.data.error_table import Curve, ErrorTable, format_errors, read_errors
from compgen.data.machine import CHAINS
from compgen.data.names import CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.errors import CompgenWarning, InputError
from compgen.fitting import FitOptions, fit, zero_ends
from compgen.fitting.bounds import constraint_rows, fit_bounded
from compgen.fitting.smoother import Smoother, choose, eliminate, gcv_criterion, reml_criterion, second_difference
from compgen.fitting.zeroing import interpolation_row
from compgen.kinematics import volumetric_error

UM, URAD = 1e-3, 1e-6
SAME_ERROR_MM = 1e-9
RANGES_MM = ((-800.0, 0.0), (-1000.0, 0.0), (-350.0, 0.0))


def machine_of(chain="WFYXZT", ranges=RANGES_MM, **settings):
    return machines.machine_of(ranges, 11, chain, name="test", **settings)


def random_table(machine, seed, nodes=9):
    """Every curve with a random shape, offset and slope, on uneven nodes; all three squareness errors."""
    rng = np.random.default_rng(seed)
    curves = {}
    for name in CURVE_NAMES:
        low, high = machine.axes[error_named(name).axis].range_mm
        inner = np.sort(rng.uniform(low + 1, high - 1, nodes - 2))
        position = np.concatenate([[low], inner, [high]])
        line = rng.normal() * 50 + rng.normal() * 50 * position / 1000
        curves[name] = Curve(
            position, (line + rng.normal(size=nodes) * 5) * error_named(name).si_per_unit, np.full(nodes, np.nan)
        )
    return ErrorTable(curves, {name: (rng.normal() * 40 * URAD, 1 * URAD) for name in SQUARENESS_NAMES})


def volume_points(machine, seed=0, count=300):
    return np.random.default_rng(seed).uniform(machine.lower_mm, machine.upper_mm, (count, 3))


def after_rigid_motion(points, difference):
    """Residual of a small displacement field after the best translation and rotation, by least squares."""
    design = np.zeros((len(points), 3, 6))
    design[:, :, :3] = np.eye(3)
    for axis in range(3):
        design[:, :, 3 + axis] = np.cross(np.eye(3)[axis], points)
    flat = design.reshape(-1, 6)
    motion = np.linalg.lstsq(flat, difference.ravel(), rcond=None)[0]
    return np.abs(difference.ravel() - flat @ motion).max()


def one_curve(name, position, value_um, u_um=None):
    unit = error_named(name).si_per_unit
    u = np.full(len(position), np.nan) if u_um is None else np.broadcast_to(u_um, len(position)) * unit
    return ErrorTable({name: Curve(np.asarray(position, float), np.asarray(value_um, float) * unit, np.array(u))})


def cubic_bump(position):
    """A smooth curve in um that is zero at -800 and 0."""
    t = np.asarray(position) / 800
    return 20 * np.sin(np.pi * t) + 6 * np.sin(3 * np.pi * t)


# --- the frame ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reference", ["X", "Y"])
@pytest.mark.parametrize("tool", [(0.0, 0.0, 0.0), (30.0, -70.0, -210.0)])
@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.filterwarnings("ignore:a rotation is removed")
def test_zeroing_leaves_e_unchanged_but_for_the_reported_rigid_motion(chain, tool, reference):
    machine = machine_of(
        chain, tool_offset_mm=tool, squareness_reference=reference, reference_point_mm=(-120.0, -1000.0, -33.0)
    )
    errors = random_table(machine, seed=len(chain) + CHAINS.index(chain))
    zeroed = zero_ends(machine, errors)
    points = volume_points(machine)
    difference = volumetric_error(machine, errors, points) - volumetric_error(machine, zeroed.table(), points)
    assert np.abs(difference).max() > 0.01  # something was moved
    assert after_rigid_motion(points, difference) < SAME_ERROR_MM
    assert np.abs(difference - zeroed.change.field(points)).max() < SAME_ERROR_MM


@pytest.mark.filterwarnings("ignore:a rotation is removed")
def test_a_fit_without_smoothing_changes_e_by_the_reported_rigid_motion_only():
    machine = machine_of("WXFYZT", tool_offset_mm=(0.0, 0.0, -150.0), reference_point_mm=(-300.0, -250.0, -100.0))
    errors = random_table(machine, seed=5)
    result = fit(machine, errors, FitOptions(smoothness=0.0))
    points = volume_points(machine)
    difference = volumetric_error(machine, errors, points) - volumetric_error(machine, result.errors, points)
    assert np.abs(difference - result.change.field(points)).max() < SAME_ERROR_MM


def test_another_tool_sees_the_further_constant_that_the_frame_change_states():
    machine = machine_of("WFYXZT", tool_offset_mm=(0.0, 0.0, -150.0))
    errors = random_table(machine, seed=6)
    with pytest.warns(CompgenWarning, match="EAZ.*refer to"):
        zeroed = zero_ends(machine, errors)
    other = np.array([20.0, 5.0, 10.0])
    points = volume_points(machine, count=20)
    tool = np.array(machine.tool_offset_mm) + other
    table = zeroed.table()
    difference = volumetric_error(machine, errors, points, tool) - volumetric_error(machine, table, points, tool)
    further = np.cross(zeroed.change.tool_rotation_rad, other)
    assert np.abs(difference - zeroed.change.field(points) - further).max() < SAME_ERROR_MM


#: A slope of +1 of one straightness: where it goes. From F = squareness + rotation x p, solved by hand:
#: squareness dX = -EC0Y y, dX = EB0Z z, dY = -EA0Z z (reference Y: dY = -EC0Y x); rotation about X: dY = -w z, dZ = w y;
#: about Y: dX = w z, dZ = -w x; about Z: dX = -w y, dY = w x.
SLOPES = [
    ("EYX", "X", "EC0Y", -1.0, (0, 0, 1)),
    ("EXY", "X", "EC0Y", -1.0, (0, 0, 0)),
    ("EXZ", "X", "EB0Z", +1.0, (0, 0, 0)),
    ("EYZ", "X", "EA0Z", -1.0, (0, 0, 0)),
    ("EZX", "X", "EB0Z", +1.0, (0, -1, 0)),
    ("EZY", "X", "EA0Z", -1.0, (1, 0, 0)),
    ("EYX", "Y", "EC0Y", -1.0, (0, 0, 0)),
    ("EXY", "Y", "EC0Y", -1.0, (0, 0, -1)),
]


@pytest.mark.parametrize(("name", "reference", "squareness", "factor", "rotation"), SLOPES)
def test_the_slope_of_a_straightness_goes_where_the_hand_calculation_puts_it(
    name, reference, squareness, factor, rotation
):
    machine = machine_of(squareness_reference=reference)
    low, high = machine.axes[error_named(name).axis].range_mm
    errors = one_curve(name, [low, high], [7.0 + 0.05 * low, 7.0 + 0.05 * high])  # 7 um and 50 um/m
    errors = errors.replace(squareness={squareness: (3 * URAD, 2 * URAD)})
    result = fit(machine, errors)
    assert result.errors.squareness[squareness][0] == pytest.approx((3 + factor * 50) * URAD, abs=1e-12)
    assert set(result.errors.squareness) == {squareness}
    assert result.change.rotation_rad == pytest.approx(np.array(rotation) * 50 * URAD, abs=1e-12)
    expected = np.zeros(3)
    expected[error_named(name).direction] = 7 * UM
    assert result.change.translation_mm == pytest.approx(expected, abs=1e-12)
    assert np.all(result.errors.curves[name].value == 0.0)


@pytest.mark.parametrize(
    ("name", "squareness", "rotation"),
    [
        ("EAX", ("EA0Z", 1.0), (0, 0, 0)),  # dY = -Z EAX is what EA0Z does
        ("EBY", None, (0, 1, 0)),  # dX = +Z EBY, dZ = -X EBY: a rotation about Y, nothing else
        ("EBX", ("EB0Z", 1.0), (0, 0, 0)),
    ],
)
def test_a_constant_angle_goes_into_the_squareness_that_acts_alike_in_zhas_gantry(name, squareness, rotation):
    machine = machine_of()
    axis = error_named(name).axis
    position = np.linspace(*machine.axes[axis].range_mm, 5)
    result = fit(machine, one_curve(name, position, np.full(5, 12.0)))
    moved = {name: value for name, (value, _) in result.errors.squareness.items()}
    assert moved == pytest.approx({} if squareness is None else {squareness[0]: squareness[1] * 12 * URAD}, abs=1e-14)
    assert result.change.rotation_rad == pytest.approx(np.array(rotation) * 12 * URAD, abs=1e-14)
    assert np.all(result.errors.curves[name].value == 0.0)


def test_a_constant_of_ecy_acts_as_a_line_of_eyx_and_needs_squareness_and_rotation_together():
    machine = machine_of()
    position = np.linspace(-1000, 0, 5)
    result = fit(machine, one_curve("ECY", position, np.full(5, 10.0)))  # dY = +X ECY: a line of EYX
    assert result.errors.squareness["EC0Y"][0] == pytest.approx(-10 * URAD, abs=1e-14)
    assert result.change.rotation_rad == pytest.approx((0, 0, 10 * URAD), abs=1e-14)


def test_positioning_at_the_reference_is_a_translation_and_its_slope_stays():
    machine = machine_of(reference_point_mm=(-200.0, 0.0, 0.0))
    position = np.linspace(-800, 0, 5)
    result = fit(machine, one_curve("EXX", position, 9.0 + 0.03 * position))
    assert result.change.translation_mm == pytest.approx((3 * UM, 0, 0), abs=1e-15)
    expected = 0.03 * (position + 200) * UM
    assert result.errors.curves["EXX"].value == pytest.approx(expected, abs=1e-12)
    assert not result.errors.squareness


def test_a_squareness_that_the_model_leaves_out_cannot_take_a_line_and_is_named():
    machine = machine_of(errors=("EXX", "EYX"))
    with pytest.raises(InputError, match=r"line or constant of EYX is -50\.000 urad of EC0Y"):
        fit(machine, one_curve("EYX", [-800, 0], [-40, 0]))
    fit(machine, one_curve("EYX", [-800, -400, 0], [5, 9, 5]))  # an offset alone is a translation


def test_the_uncertainty_that_moves_with_a_line_is_added_to_the_squareness():
    machine = machine_of()
    table = one_curve("EXZ", [-350, -100, 0], [3, 4, -4], u_um=[0.6, 0.5, 0.8])
    result = fit(machine, table.replace(squareness={"EB0Z": (0.0, 2 * URAD), "EC0Y": (1 * URAD, 1 * URAD)}))
    value, u = result.errors.squareness["EB0Z"]
    assert value == pytest.approx(-7 * UM / 350)
    assert u == pytest.approx(math.hypot(2 * URAD, math.hypot(0.6, 0.8) * UM / 350))
    assert result.errors.squareness["EC0Y"] == (1 * URAD, 1 * URAD)
    unknown = fit(machine, one_curve("EXZ", [-350, 0], [3, -4]).replace(squareness={"EB0Z": (0.0, URAD)}))
    assert math.isnan(unknown.errors.squareness["EB0Z"][1])


# --- zeros --------------------------------------------------------------------------------------------------------


def test_straightness_ends_and_reference_values_are_exactly_zero_after_writing_and_reading(tmp_path):
    machine = machine_of(reference_point_mm=(-800.0, 0.0, -350.0))
    rng = np.random.default_rng(1)
    curves = {}
    for name in ("EYX", "EZX", "EXY", "EXX", "EAX", "EXZ"):
        low, high = machine.axes[error_named(name).axis].range_mm
        position = np.linspace(low, high, 11)
        value = (rng.normal() * 10 + rng.normal() * position / 10 + rng.normal(size=11)) * error_named(name).si_per_unit
        curves[name] = Curve(position, value, np.full(11, 1.0) * error_named(name).si_per_unit)
    result = fit(machine, ErrorTable(curves))
    path = tmp_path / "fitted.errors.csv"
    path.write_text(format_errors(result.errors))
    for table in (result.errors, read_errors(path)):
        for name, curve in table.curves.items():
            if error_named(name).is_straightness:
                assert curve.value[0] == curve.value[-1] == 0.0
                assert curve.u[0] == curve.u[-1] == 0.0
                assert not np.signbit(curve.value[[0, -1]]).any()
            else:
                at = machine.reference_point_mm[error_named(name).axis]
                assert curve.at(np.array([at]))[0] == 0.0


@pytest.mark.parametrize("smoothness", [0.0, 3.0, 1e5, None])
def test_nodes_that_miss_the_ends_and_the_reference_are_held_by_interpolation(smoothness):
    machine = machine_of(reference_point_mm=(-333.0, 0.0, 0.0))
    position = np.array([-870.0, -790.0, -600, -410, -300, -111, -5, 40])
    table = one_curve("EYX", position, cubic_bump(position) + 3)
    table = table.replace(curves={**table.curves, **one_curve("EXX", position, cubic_bump(position)).curves})
    result = fit(machine, table, FitOptions(smoothness=smoothness))
    ends = result.errors.curves["EYX"].at(np.array([-800.0, 0.0]))
    assert np.abs(ends).max() < 1e-15
    assert abs(result.errors.curves["EXX"].at(np.array([-333.0]))[0]) < 1e-15
    assert np.array_equal(result.errors.curves["EYX"].position_mm, position)


def test_a_curve_that_ends_within_the_travel_is_extended_by_its_end_values():
    machine = machine_of()
    position = np.array([-700.0, -400.0, -100.0])
    with pytest.warns(CompgenWarning, match="EXX is known from -700 to -100 mm.*travels from -800 to 0"):
        result = fit(machine, one_curve("EXX", position, [4, 3, 1]), FitOptions(smoothness=0))
    fitted = result.errors.curves["EXX"]
    assert np.array_equal(fitted.position_mm, [-800, -700, -400, -100, 0])
    assert fitted.value == pytest.approx(np.array([3, 3, 2, 0, 0]) * UM, abs=1e-15)


def test_a_node_that_file_rounding_moved_off_the_end_counts_as_the_end():
    machine = machine_of(ranges=((-1000 / 3, 0.0), (-10, 0), (-10, 0)))
    position = np.array([-333.333333, -200.0, 0.0])  # within the travel by 3e-7 mm: must not get a neighbour there
    result = fit(machine, one_curve("EYX", position, [1.0, 5.0, 2.0]), FitOptions(smoothness=1.0))
    assert len(result.errors.curves["EYX"].position_mm) == 3
    assert result.errors.curves["EYX"].value[0] == 0.0


@pytest.mark.parametrize(
    ("nodes", "held", "expected"),
    [
        ([-900.0, 100.0], (-800.0, 0.0), 0),  # both ends between the same two nodes: only zero is left
        ([-900.0, -400.0, 100.0], (-800.0, 0.0), 1),
        ([-900.0, -700.0, -300.0, 100.0], (-800.0, 0.0), 2),
    ],
)
def test_held_functionals_that_share_nodes_are_eliminated_together(nodes, held, expected):
    position = np.array(nodes)
    rows = tuple(interpolation_row(position, at) for at in held)
    smoother = Smoother.build(position, np.ones(len(nodes)), rows)
    assert smoother.unknowns == expected
    c = smoother.solve(0.5, np.random.default_rng(0).normal(size=(len(nodes), 1)))[:, 0]
    assert [sum(factor * c[node] for node, factor in row) for row in rows] == pytest.approx([0, 0], abs=1e-15)
    assert len(eliminate(rows)) == len(nodes) - expected


# --- the smoother against definitions -----------------------------------------------------------------------------


def test_the_second_difference_is_the_plain_one_on_even_nodes_and_approaches_the_integral_on_uneven_ones():
    assert second_difference(np.arange(5) * 20.0) == pytest.approx(np.array([[1.0, -2.0, 1.0]] * 3))
    rng = np.random.default_rng(2)
    t = np.sort(np.concatenate([[0, 1], rng.uniform(0, 1, 3000)]))
    position = 900 * t**1.5  # three times denser at one end
    rows = second_difference(position)
    assert rows.sum(axis=1) == pytest.approx(np.zeros(len(rows)), abs=1e-6 * np.abs(rows).max())
    even = np.linspace(0, 900, 400)
    c = lambda p: np.sin(2 * np.pi * p / 900)  # noqa: E731
    for nodes in (even, position):
        rows = second_difference(nodes)
        total = np.sum((rows * np.stack([c(nodes)[:-2], c(nodes)[1:-1], c(nodes)[2:]], 1)).sum(1) ** 2)
        h = np.mean(np.diff(nodes))
        integral = h**3 * (2 * np.pi / 900) ** 4 * 450
        assert total == pytest.approx(integral, rel=0.02)


def dense(smoother, held, n):
    """Null-space basis, weights and D2 as dense matrices, by SVD."""
    d2 = np.zeros((max(n - 2, 0), n))
    for k in range(n - 2):
        d2[k, k : k + 3] = smoother.rows[k]
    b = np.zeros((len(held), n))
    for i, row in enumerate(held):
        for node, factor in row:
            b[i, node] += factor
    return np.linalg.svd(b)[2][len(held) :].T, np.diag(smoother.weight), d2


@pytest.mark.parametrize("mu", [1e-3, 1.0, 1e6])
@pytest.mark.parametrize("n", [5, 11, 101])
def test_the_banded_solution_is_the_dense_least_squares_one(n, mu):
    rng = np.random.default_rng(n)
    position = np.cumsum(rng.uniform(5, 20, n))
    weight = rng.uniform(0.3, 3, n)
    for at in ((position[0], position[-1]), (position[2] + 1.3,), (position[0] + 1, position[1] + 2)):
        held = tuple(interpolation_row(position, point) for point in at)
        smoother = Smoother.build(position, weight, held)
        basis, w, d2 = dense(smoother, held, n)
        y = rng.normal(size=n)
        stacked = np.vstack([np.sqrt(w) @ basis, np.sqrt(mu) * d2 @ basis])
        expected = basis @ np.linalg.lstsq(stacked, np.r_[np.sqrt(w) @ y, np.zeros(n - 2)], rcond=None)[0]
        assert smoother.solve(mu, y[:, None])[:, 0] == pytest.approx(expected, abs=1e-10)
        hat = basis @ np.linalg.solve(basis.T @ (w + mu * d2.T @ d2) @ basis, basis.T @ w)
        assert smoother.degrees_of_freedom(mu) == pytest.approx(np.trace(hat), rel=1e-5)
        ours = np.hstack([columns for _, columns in smoother.columns(mu)])
        assert ours == pytest.approx(hat, abs=1e-9)


def test_the_smoothness_halves_the_wave_that_the_report_names():
    n = 2001  # long, so that ends do not matter in the middle
    position = np.arange(n) * 10.0
    machine = machine_of(ranges=((0.0, 20000.0), (-10, 0), (-10, 0)))
    wave = np.sin(2 * np.pi * position / 200.0)
    result = fit(machine, one_curve("EYX", position, wave), FitOptions(smoothness=1 / (2 * np.sin(np.pi / 20)) ** 4))
    assert result.report["EYX"].half_gain_mm == pytest.approx(200.0)
    assert result.report["EYX"].method == "given"
    middle = slice(900, 1100)
    gain = result.errors.curves["EYX"].value[middle] @ wave[middle] / (wave[middle] @ wave[middle]) / UM
    assert gain == pytest.approx(0.5, abs=1e-6)
    assert fit(machine, one_curve("EYX", position, wave), FitOptions(smoothness=0.01)).report["EYX"].half_gain_mm == 0


def test_reml_is_the_likelihood_of_a_gaussian_process_with_both_ends_held():
    n, u = 9, 0.4
    position = np.cumsum(np.random.default_rng(0).uniform(5, 20, n))
    held = tuple(interpolation_row(position, at) for at in position[[0, -1]])
    u_nodes = u * np.linspace(0.5, 2, n)
    u0 = 1 / np.sqrt(np.mean(1 / u_nodes**2))
    smoother = Smoother.build(position, (u0 / u_nodes) ** 2, held)
    d2 = dense(smoother, held, n)[2][:, 1:-1]
    y = np.random.default_rng(1).normal(size=n)
    y[[0, -1]] = 0
    criterion = reml_criterion(smoother, y, u0)

    def likelihood(mu):
        prior = np.linalg.inv(d2.T @ d2) * u0**2 / mu
        return -2 * multivariate_normal.logpdf(y[1:-1], cov=prior + np.diag(u_nodes[1:-1] ** 2))

    differences = [criterion(mu) - likelihood(mu) for mu in (1e-3, 0.1, 1.0, 30.0, 1e4)]
    assert differences == pytest.approx([differences[0]] * 5, abs=1e-7)


def test_reml_leaves_straight_lines_without_a_prior_when_one_point_is_held():
    n, u = 10, 0.7
    position = np.arange(n) * 12.0
    held = (((3, 1.0),),)
    smoother = Smoother.build(position, np.ones(n), held)
    free = [k for k in range(n) if k != 3]
    d2 = dense(smoother, held, n)[2][:, free]
    line = (position - position[3])[free][:, None]
    contrast = np.linalg.svd(line)[0][:, 1:]  # orthogonal to the straight line: what restricted likelihood sees
    y = np.random.default_rng(4).normal(size=n)
    y[3] = 0

    def likelihood(mu):
        cov = contrast.T @ (np.linalg.pinv(d2.T @ d2) * u**2 / mu + u**2 * np.eye(n - 1)) @ contrast
        # pinv is the prior only across the line; the contrast of any other choice on the line is the same
        return -2 * multivariate_normal.logpdf(contrast.T @ y[free], cov=cov)

    criterion = reml_criterion(smoother, y, u)
    differences = [criterion(mu) - likelihood(mu) for mu in (1e-3, 0.1, 1.0, 30.0, 1e3)]
    assert differences == pytest.approx([differences[0]] * 5, abs=1e-7)


def test_gcv_is_craven_and_wahbas_formula_and_the_search_finds_its_minimum():
    n = 21
    position = np.linspace(-800, 0, n)
    held = tuple(interpolation_row(position, at) for at in (-800.0, 0.0))
    smoother = Smoother.build(position, np.ones(n), held)
    y = cubic_bump(position) + np.random.default_rng(8).normal(size=n) * 0.5
    y[[0, -1]] = 0
    basis, w, d2 = dense(smoother, held, n)

    def formula(mu):
        hat = np.linalg.solve(basis.T @ (w + mu * d2.T @ d2) @ basis, basis.T)
        m = n - 2
        return m * np.sum((y - basis @ hat @ y) ** 2) / (m - np.trace(hat @ basis)) ** 2

    for mu in (1e-2, 1.0, 50.0):
        assert gcv_criterion(smoother, y)(mu) == pytest.approx(formula(mu), rel=1e-9)
    grid = 10 ** np.linspace(-8, 6, 561)
    best = grid[np.argmin([formula(mu) for mu in grid])]
    polished = minimize_scalar(lambda e: formula(10**e), bounds=np.log10([best / 2, best * 2]), method="bounded")
    assert math.log10(choose(smoother, y, None)) == pytest.approx(polished.x, abs=0.01)


def test_reml_recovers_the_smoothness_that_the_data_were_drawn_with():
    n, u, tau = 201, 0.2, 0.05
    position = np.linspace(-800, 0, n)
    held = tuple(interpolation_row(position, at) for at in (-800.0, 0.0))
    smoother = Smoother.build(position, np.ones(n), held)
    d2 = dense(smoother, held, n)[2][:, 1:-1]
    rng = np.random.default_rng(3)
    found = []
    for _ in range(20):
        y = np.zeros(n)
        y[1:-1] = np.linalg.solve(d2, rng.normal(size=n - 2) * tau) + rng.normal(size=n - 2) * u
        found.append(math.log10(choose(smoother, y, u)))
    assert np.mean(found) == pytest.approx(math.log10(u**2 / tau**2), abs=0.1)


@pytest.mark.parametrize("known", [True, False])
def test_smoothing_lowers_the_noise_and_the_stated_uncertainty_is_the_scatter(known):
    machine = machine_of()
    position = np.linspace(-800, 0, 41)
    truth = cubic_bump(position)
    rng = np.random.default_rng(11)
    noise_um, errors, results = 0.5, [], []
    for _ in range(60):
        noise = rng.normal(size=41) * noise_um
        noise[[0, -1]] = 0
        u = np.full(41, noise_um)
        u[[0, -1]] = 0
        results.append(fit(machine, one_curve("EYX", position, truth + noise, u if known else None)))
        errors.append(results[-1].errors.curves["EYX"].value / UM - truth)
    rms = np.sqrt(np.mean(np.array(errors)[:, 1:-1] ** 2))
    assert rms < 0.75 * noise_um
    report = results[0].report["EYX"]
    assert report.method == ("REML" if known else "GCV")
    assert np.nanmean([r.report["EYX"].noise for r in results]) == pytest.approx(noise_um, rel=0.05)
    if known:
        stated = np.sqrt(np.mean([r.errors.curves["EYX"].u[1:-1] ** 2 for r in results])) / UM
        assert rms == pytest.approx(stated, rel=0.1)
        assert np.mean([r.report["EYX"].reduced_chi_square for r in results]) == pytest.approx(1, abs=0.1)
        assert all(r.report["EYX"].smoothing_bias_max < noise_um for r in results)
    else:
        assert np.isnan(results[0].errors.curves["EYX"].u[1:-1]).all()
        assert math.isnan(report.reduced_chi_square)


def test_the_uncertainty_holds_what_the_zeroing_of_noisy_ends_adds():
    machine = machine_of()
    position = np.linspace(-800, 0, 7)
    rng = np.random.default_rng(0)
    u = np.array([1.0, 0.5, 0.7, 0.3, 0.6, 0.9, 2.0])
    options = FitOptions(smoothness=0.8)
    base = one_curve("EYX", position, cubic_bump(position) + 5, u)
    stated = fit(machine, base, options).errors.curves["EYX"].u / UM
    samples = [
        fit(machine, one_curve("EYX", position, cubic_bump(position) + 5 + rng.normal(size=7) * u, u), options)
        for _ in range(700)
    ]
    scatter = np.std([sample.errors.curves["EYX"].value / UM for sample in samples], axis=0)
    assert stated[[0, -1]] == pytest.approx([0, 0], abs=0)
    assert scatter[1:-1] == pytest.approx(stated[1:-1], rel=0.1)


def test_the_smoothing_bias_is_the_flattening_of_a_known_wave():
    n = 801
    machine = machine_of(ranges=((0.0, 8000.0), (-10, 0), (-10, 0)))
    position = np.arange(n) * 10.0
    mu = 1e3
    wave = 30 * np.sin(np.pi * position * 10 / 8000)  # zero ends and zero curvature there: an eigenvector of D2
    report = fit(machine, one_curve("EYX", position, wave), FitOptions(smoothness=mu)).report["EYX"]
    gain = 1 / (1 + mu * (2 * np.sin(np.pi * 10 / 8000 * 10 / 2)) ** 4)
    middle = slice(200, 600)
    assert report.smoothing_bias[middle] == pytest.approx(wave[middle] * gain * (gain - 1), abs=1e-4)
    assert report.smoothing_bias_max == np.abs(report.smoothing_bias).max()


# --- awkward data -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("u", [None, 0.0, 0.2])
@pytest.mark.parametrize("nodes", [1, 2, 3, 4, 11, 101])
def test_exact_data_come_back_for_any_number_of_nodes(nodes, u):
    machine = machine_of()
    position = np.linspace(-800, 0, nodes) if nodes > 1 else np.array([0.0])
    for name in ("EYX", "EXX", "ECX"):
        value = cubic_bump(position) if name != "EXX" else 0.01 * position
        with warnings.catch_warnings():
            warnings.simplefilter("ignore" if nodes == 1 else "error", CompgenWarning)
            result = fit(machine, one_curve(name, position, value, u))
        difference = result.errors.curves[name].at(position) / error_named(name).si_per_unit - value
        if name == "EXX" or u is None or u == 0:
            assert np.abs(difference).max() < 1e-5
        else:
            assert np.abs(difference).max() < 2.5 * u
        json.dumps(result.to_dict(), allow_nan=False)


def test_a_straight_line_stays_exact_and_gets_the_largest_weight():
    machine = machine_of()
    position = np.linspace(-800, 0, 1001)
    result = fit(machine, one_curve("EXX", position, 0.1 * position, 0.2))
    assert result.errors.curves["EXX"].value == pytest.approx(0.1 * position * UM, abs=1e-9 * UM)
    assert result.report["EXX"].degrees_of_freedom == pytest.approx(1, abs=0.6)
    assert result.errors.curves["EXX"].u.max() / UM < 0.05


def test_weights_follow_the_uncertainties_and_a_single_bad_node_is_ignored():
    machine = machine_of()
    position = np.linspace(-800, 0, 21)
    value = cubic_bump(position)
    value[10] += 500
    u = np.full(21, 0.1)
    u[10] = 1e3
    result = fit(machine, one_curve("EYX", position, value, u))
    assert np.abs(result.errors.curves["EYX"].value / UM - cubic_bump(position)).max() < 0.2


def test_the_same_curve_in_other_units_of_length_is_smoothed_alike():
    position = np.linspace(-800, 0, 21)
    noisy = cubic_bump(position) + np.random.default_rng(7).normal(size=21)
    wide = machine_of()
    narrow = machine_of(ranges=((-8.0, 0.0), (-10, 0), (-10, 0)))
    first = fit(wide, one_curve("EYX", position, noisy, 1.0))
    second = fit(narrow, one_curve("EYX", position / 100, noisy, 1.0))
    assert second.report["EYX"].smoothness == pytest.approx(first.report["EYX"].smoothness, rel=1e-6)
    assert second.errors.curves["EYX"].value == pytest.approx(first.errors.curves["EYX"].value, abs=1e-9)


def test_nearly_coinciding_nodes_do_not_break_the_fit():
    machine = machine_of()
    position = np.sort(np.concatenate([np.linspace(-800, 0, 15), [-399.9999, -400.0002]]))
    value = cubic_bump(position)
    for u in (None, 0.3):
        result = fit(machine, one_curve("EYX", position, value, u))
        assert np.abs(result.errors.curves["EYX"].value / UM - value).max() < 0.5


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused_by_name(bad):
    with pytest.raises(InputError, match="value.*not finite"):
        fit(machine_of(), one_curve("EXX", [-800, -400, 0], [1, bad, 0]))
    with pytest.raises(InputError, match="u: contains -0.001; expected numbers of at least 0"):
        fit(machine_of(), one_curve("EXX", [-800, -400, 0], [1, 2, 0], [-1, 1, 1]))


def test_a_thousand_nodes_are_fitted_to_their_truth():
    machine = machine_of()
    position = np.linspace(-800, 0, 1001)
    noise = np.random.default_rng(0).normal(size=1001)
    for u in (1.0, None):
        result = fit(machine, one_curve("EYX", position, cubic_bump(position) + noise, u))
        fitted = result.errors.curves["EYX"].at(position) / UM
        line = cubic_bump(position) - np.interp(position, [-800, 0], [noise[0], noise[-1]])
        assert np.sqrt(np.mean((fitted - line) ** 2)) < 0.4


def test_the_input_is_not_changed_and_the_metadata_names_the_reference():
    machine = machine_of()
    errors = random_table(machine, 0).replace(metadata={"machine": "m", "reference_point_mm": "old"})
    before = format_errors(errors)
    with pytest.warns(CompgenWarning):
        result = fit(machine, errors)
    assert format_errors(errors) == before
    assert result.errors.metadata == {"machine": "m", "reference_point_mm": "0, 0, 0"}
    assert result.errors.names == errors.names


# --- bounds -------------------------------------------------------------------------------------------------------


def bounded_case(n, mu, seed=0):
    rng = np.random.default_rng(seed)
    position = np.cumsum(rng.uniform(4, 12, n))
    t = (position - position[0]) / np.ptp(position)
    y = 20 * np.sin(2 * np.pi * t) + 8 * np.sin(6 * np.pi * t + 0.3) + 5 * np.sin(31 * t) + rng.normal(size=n) * 0.3
    y -= y[0] + (y[-1] - y[0]) * t
    held = tuple(interpolation_row(position, at) for at in position[[0, -1]])
    smoother = Smoother.build(position, rng.uniform(0.5, 2, n), held)
    free = smoother.solve(mu, y[:, None])[:, 0]
    limits = (0.8 * np.abs(free).max(), 0.6 * np.abs(np.diff(free) / np.diff(position)).max())
    return position, y, held, smoother, free, limits


def reference_curve(position, y, weight, fixed, mu, limits=(math.inf, math.inf)):
    """The definition as it reads on paper: sum(w (c - y)^2) + mu |D2 c|^2, functionals zero, |c| and |slope| in limits."""
    cp = importlib.import_module("cvxpy")
    c = cp.Variable(len(y))
    cost = cp.sum_squares(cp.multiply(np.sqrt(weight), c - y))
    for k, (first, middle, last) in enumerate(second_difference(position)):
        cost = cost + mu * cp.square(first * c[k] + middle * c[k + 1] + last * c[k + 2])
    rules = [sum(factor * c[node] for node, factor in row) == 0 for row in fixed]
    largest, steepest = limits
    if math.isfinite(largest):
        rules.append(cp.abs(c) <= largest)
    if math.isfinite(steepest):
        rules.append(cp.abs(cp.diff(c)) <= steepest * np.diff(position))
    problem = cp.Problem(cp.Minimize(cost), rules)
    problem.solve(solver="CLARABEL", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    assert c.value is not None, problem.status
    return c.value


@pytest.mark.parametrize("mu", [0.05, 20.0, 1e4])
def test_without_bounds_the_direct_solution_is_the_readable_reference(mu):
    position, y, held, smoother, free, _ = bounded_case(31, mu)
    expected = reference_curve(position, y, smoother.weight, held, mu)
    assert free == pytest.approx(expected, abs=1e-5)
    loose = reference_curve(position, y, smoother.weight, held, mu, (1e3, 1e3))
    assert free == pytest.approx(loose, abs=1e-5)


@pytest.mark.parametrize(("n", "mu"), [(11, 0.1), (11, 5.0), (51, 1.0), (51, 1e3), (101, 0.1), (301, 1e5)])
def test_with_bounds_the_fit_is_the_readable_reference(n, mu):
    position, y, held, smoother, _, limits = bounded_case(n, mu, seed=n)
    found = fit_bounded(smoother, mu, y, constraint_rows(position, smoother, *limits))
    expected = reference_curve(position, y, smoother.weight, held, mu, limits)
    assert np.abs(found.touched).sum() >= 2
    assert found.curve == pytest.approx(expected, abs=1e-4)
    assert np.abs(found.curve).max() <= limits[0] * (1 + 1e-8)
    assert (np.abs(np.diff(found.curve)) / np.diff(position)).max() <= limits[1] * (1 + 1e-8)
    assert found.curve[0] == found.curve[-1] == 0.0

    def cost(c):
        return np.sum(smoother.weight * (c - y) ** 2) + mu * np.sum(smoother.bend(c[:, None]) ** 2)

    assert cost(found.curve) <= cost(expected) * (1 + 1e-7)


@pytest.mark.parametrize("seed", range(12))
def test_bounds_far_inside_wild_data_where_nearly_all_are_active_still_give_the_optimum(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(5, 40))
    position = np.sort(rng.choice(np.arange(-800.0, 1.0), n, replace=False))
    held = (interpolation_row(position, rng.uniform(position[0], position[-1])),)
    smoother = Smoother.build(position, rng.uniform(0.5, 2, n), held)
    y = rng.normal(size=n) * 50
    limits = (10 ** rng.uniform(0, 1.5), 10 ** rng.uniform(-2.5, -0.5))
    mu = float(rng.choice([0.0, 1e-3, 1.0, smoother.largest_mu]))
    found = fit_bounded(smoother, mu, y, constraint_rows(position, smoother, *limits))
    expected = reference_curve(position, y, smoother.weight, held, mu, limits)

    def cost(c):
        return np.sum(smoother.weight * (c - y) ** 2) + mu * np.sum(smoother.bend(c[:, None]) ** 2)

    assert cost(found.curve) == pytest.approx(cost(expected), rel=1e-6)
    assert np.abs(found.curve).max() <= limits[0] * (1 + 1e-8)
    assert (np.abs(np.diff(found.curve)) / np.diff(position)).max() <= limits[1] * (1 + 1e-8)


def test_bounds_of_kind_and_name_are_kept_and_reported_in_file_units():
    machine = machine_of()
    position = np.linspace(-800, 0, 11)
    table = one_curve("EYX", position, cubic_bump(position), 0.2)
    for name in ("EXX", "EZX", "EAX"):
        table = table.replace(curves={**table.curves, **one_curve(name, position, cubic_bump(position), 0.2).curves})
    options = FitOptions.from_file_units(
        max_abs_um_urad={"linear": 15.0, "EXX": 40.0, "angular": 10.0}, max_slope_um_m_urad_m={"EZX": 30.0}
    )
    result = fit(machine, table, options)
    top = {n: np.abs(c.value).max() / error_named(n).si_per_unit for n, c in result.errors.curves.items()}
    assert top["EYX"] == pytest.approx(15.0, rel=1e-8)
    assert top["EAX"] == pytest.approx(10.0, rel=1e-8)
    assert top["EXX"] > 15.1
    steepest = np.abs(np.diff(result.errors.curves["EZX"].value) / np.diff(position)).max()
    assert steepest == pytest.approx(30e-6, rel=1e-8)
    assert {name: report.solver for name, report in result.report.items()} == {
        "EYX": "active set",
        "EXX": "direct",
        "EZX": "active set",
        "EAX": "active set",
    }
    touched = {(b.bound, b.from_mm, b.to_mm) for b in result.report["EYX"].active_bounds}
    at_top = position[np.abs(result.errors.curves["EYX"].value) > 15 * UM * (1 - 1e-7)]
    assert touched == {("max_abs", at, at) for at in at_top}
    assert all(
        b.bound == "max_slope" and b.to_mm - b.from_mm == pytest.approx(80) for b in result.report["EZX"].active_bounds
    )
    assert not result.report["EXX"].active_bounds
    json.dumps(result.to_dict(), allow_nan=False)


def test_a_thousand_nodes_with_bounds_are_solved_within_them():
    machine = machine_of()
    position = np.linspace(-800, 0, 1001)
    noise = np.random.default_rng(0).normal(size=1001)
    noise[[0, -1]] = 0
    table = one_curve("EYX", position, cubic_bump(position) + noise, 1.0)
    report = fit(machine, table, FitOptions(max_abs={"EYX": 12 * UM})).report["EYX"]
    assert len(report.active_bounds) >= 1
    assert report.solver == "active set"


def test_cvxpy_is_imported_only_when_a_bound_is_active():
    script = (
        "import sys, numpy as np; from compgen.fitting import fit, FitOptions; from compgen.data.machine import *;"
        "from compgen.data.error_table import Curve, ErrorTable; p = np.linspace(-1, 0, 9);"
        "m = Machine('m', Chain('WFYXZT'), tuple(Axis((-1.0, 0.0), p) for _ in range(3)));"
        "t = ErrorTable({'EXX': Curve(p, 1e-3 * p**2, 0 * p + 1e-4)});"
        "fit(m, t, FitOptions(max_abs={'EXX': 1.0})); print('cvxpy' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"smoothness": -1.0}, "smoothness: -1.0 is not allowed"),
        ({"smoothness": math.nan}, "smoothness: nan is not allowed"),
        ({"max_abs": {"EXQ": 1.0}}, "max_abs: 'EXQ' is neither a curve.*did you mean"),
        ({"max_abs": {"EC0Y": 1.0}}, "max_abs: 'EC0Y' is neither a curve"),
        ({"max_slope": {"EXX": 0.0}}, "max_slope: 0.0 for EXX is not a possible bound"),
        ({"max_abs": {"linear": -2.0}}, "max_abs: -2.0 for linear is not a possible bound"),
    ],
)
def test_impossible_options_are_refused_with_the_error_and_the_bound(settings, message):
    with pytest.raises(InputError, match=message):
        FitOptions(**settings)


def test_the_name_goes_before_the_kind():
    options = FitOptions(max_abs={"linear": 0.02, "EXX": 0.05})
    assert options.limits("EXX") == (0.05, math.inf)
    assert options.limits("EYX") == (0.02, math.inf)
    assert options.limits("EAX") == (math.inf, math.inf)
    assert replace(options, max_slope={"angular": 1e-6}).limits("EAX") == (math.inf, 1e-6)
