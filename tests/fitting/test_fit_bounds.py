"""Bounds of the fit against the readable reference: magnitude, slope, curvature, direction, outliers, correlation, own."""

import importlib
import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import scipy.sparse as sp
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, minimize, nnls
from scipy.stats import multivariate_normal

import compgen
import machines
from compgen.cli import cli
from compgen.data.error_table import Curve, ErrorTable, format_errors
from compgen.data.names import error_named
from compgen.errors import CompgenWarning, ConvergenceError, InputError
from compgen.fitting import FitOptions, fit
from compgen.fitting.bounds import SOLVERS, Bounds, constraint_rows, curvature, solve_curve
from compgen.fitting.curve_fit import HUBER, running_median
from compgen.fitting.smoother import CorrelatedSmoother, Smoother, reml_criterion, second_difference
from compgen.fitting.zeroing import interpolation_row
from compgen.identification import joint_covariance

UM, URAD = 1e-3, 1e-6
RANGES_MM = ((-800.0, 0.0), (-1000.0, 0.0), (-350.0, 0.0))
#: The reference is Clarabel at 1e-12 on a sum of squares: that good it is for curves of 20 um.
REFERENCE_UM = 1e-4
#: Bounds hold to this fraction of them.
KEPT = 1e-9


@dataclass(frozen=True)
class CurveProblem:
    """minimise sum w (c - y)^2 + mu |D2 c|^2 with c zero at the ``fixed`` nodes and within ``bounds``."""

    position_mm: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    fixed: tuple[int, ...]
    mu: float
    bounds: Bounds = Bounds()

    @property
    def smoother(self):
        return Smoother.build(self.position_mm, self.weight, tuple(((node, 1.0),) for node in self.fixed))

    def solve(self, smoother=None):
        return solve_curve(smoother or self.smoother, self.mu, self.position_mm, self.y, self.bounds)


def machine_of(**settings):
    return machines.machine_of(RANGES_MM, 11, name="test", **settings)


def one_curve(name, position, value, u):
    unit = error_named(name).si_per_unit
    return ErrorTable(
        {name: Curve(np.asarray(position, float), np.asarray(value) * unit, np.full(len(position), u * unit))}
    )


def reference(problem):
    """The bounded fit as it reads on paper, in cvxpy, solved by Clarabel."""
    cp = importlib.import_module("cvxpy")
    position, bounds = problem.position_mm, problem.bounds
    c = cp.Variable(len(problem.y))
    bend = [row @ c[k : k + 3] for k, row in enumerate(second_difference(position))]
    cost = cp.sum_squares(cp.multiply(np.sqrt(problem.weight), c - problem.y)) + problem.mu * cp.sum_squares(
        cp.hstack(bend)
    )
    rules = [c[node] == 0 for node in problem.fixed]
    step = np.diff(position)
    if math.isfinite(bounds.max_abs):
        rules.append(cp.abs(c) <= bounds.max_abs)
    if math.isfinite(bounds.max_slope):
        rules.append(cp.abs(cp.diff(c)) <= bounds.max_slope * step)
    if math.isfinite(bounds.max_curvature):
        slope = cp.multiply(cp.diff(c), 1 / step)
        rules.append(cp.abs(cp.diff(slope)) <= bounds.max_curvature * (step[:-1] + step[1:]) / 2)
    if bounds.direction:
        rules.append(bounds.direction * cp.diff(c) >= 0)
    cp.Problem(cp.Minimize(cost), rules).solve(solver="CLARABEL", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    return c.value


def cost_of(problem, c):
    bend = (second_difference(problem.position_mm) * np.stack([c[:-2], c[1:-1], c[2:]], axis=1)).sum(axis=1)
    return np.sum(problem.weight * (c - problem.y) ** 2) + problem.mu * np.sum(bend**2)


def bounds_of(position, c, shares=(), direction=0, held=None):
    """Bounds at the given shares of what a curve needs."""
    needs = {
        "max_abs": np.abs(c).max(),
        "max_slope": np.abs(np.diff(c) / np.diff(position)).max(),
        "max_curvature": np.abs((curvature(position) * np.stack([c[:-2], c[1:-1], c[2:]], 1)).sum(1)).max(),
    }
    limits = {name: share * needs[name] for name, share in dict(shares).items()}
    return Bounds(**limits, direction=direction)


def case(n, mu, seed, held=None, shares=(), direction=0):
    """A wavy curve with bounds at the given shares of what it needs without them."""
    rng = np.random.default_rng(seed)
    position = np.cumsum(rng.uniform(4, 12, n))
    t = (position - position[0]) / np.ptp(position)
    y = 20 * np.sin(2 * np.pi * t) + 8 * np.sin(6 * np.pi * t + 0.3) + 5 * np.sin(31 * t) + rng.normal(size=n) * 0.3
    held = (0, n - 1) if held is None else held
    y[list(held)] = 0
    problem = CurveProblem(position, y, rng.uniform(0.5, 2, n), held, mu)
    c = problem.solve().curve
    return CurveProblem(position, y, problem.weight, held, mu, bounds_of(position, c, shares, direction))


KINDS = [
    {"shares": {"max_abs": 0.6}},
    {"shares": {"max_slope": 0.5}},
    {"shares": {"max_curvature": 0.4}},
    {"shares": {"max_abs": 0.8, "max_slope": 0.6, "max_curvature": 0.5}},
    {"direction": 1, "held": (3,)},
    {"direction": -1, "held": (0,)},
    {"direction": 1, "held": (5,), "shares": {"max_slope": 0.3}},
]


# --- against the reference ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", range(len(KINDS)))
@pytest.mark.parametrize(("n", "mu"), [(11, 0.1), (11, 20.0), (41, 1.0), (41, 1e3)])
def test_each_kind_of_bound_gives_the_readable_reference(n, mu, kind):
    problem = case(n, mu, seed=n, **KINDS[kind])
    found = problem.solve()
    expected = reference(problem)
    assert found.touched.any()
    assert found.curve == pytest.approx(expected, abs=REFERENCE_UM)
    assert cost_of(problem, found.curve) <= cost_of(problem, expected) * (1 + 1e-7)
    over = problem.bounds.excess(problem.position_mm, found.curve)
    assert over[:3] == pytest.approx(
        (0, 0, 0), abs=KEPT * max(1, *(v for v in problem.bounds.limits if v < math.inf), 1)
    )
    assert all(excess <= KEPT * limit for excess, limit in zip(over[:3], problem.bounds.limits, strict=True) if excess)
    assert over[3] <= KEPT * np.abs(np.diff(found.curve)).max()


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_the_general_solvers_give_the_curve_of_the_active_set(kind, solver, monkeypatch):
    """The way for curves of many nodes, on curves that both can solve."""
    problem = case(21, 5.0, seed=kind, **KINDS[kind])
    found = problem.solve()
    monkeypatch.setattr(Smoother, "inverse_root", lambda self, mu: None)
    monkeypatch.setattr(importlib.import_module("compgen.fitting.bounds"), "SOLVERS", {solver: SOLVERS[solver]})
    general = problem.solve()
    assert (found.solver, general.solver) == ("active set", solver)
    assert general.curve == pytest.approx(found.curve, abs=1e-6)
    assert np.array_equal(general.touched, found.touched)


@pytest.mark.parametrize(("n", "mu", "fixed"), [(3, 0.0, (0,)), (5, 1e6, (2,)), (101, 0.0, (0, 100)), (40, 1e3, (0,))])
def test_the_root_of_the_inverse_gives_the_smoother(n, mu, fixed):
    """F F^T g solves A x = g; F has one column per free node and is zero at fixed ones."""
    problem = case(n, mu, n, held=fixed)
    root = problem.smoother.inverse_root(mu)
    assert root.shape == (n, n - len(fixed))
    assert not root[list(fixed)].any()
    load = problem.smoother.load(problem.y[:, None])[:, 0]
    assert root @ (root.T @ load) == pytest.approx(problem.solve().curve, abs=1e-9)


def test_curvature_is_the_second_derivative_of_a_parabola_on_uneven_nodes():
    position = np.array([0.0, 3.0, 4.0, 9.0, 20.0])
    rows = curvature(position)
    c = 0.7 * position**2 - 3 * position + 2
    assert [row @ c[k : k + 3] for k, row in enumerate(rows)] == pytest.approx([1.4] * 3)


def test_the_bounded_curve_meets_the_optimality_conditions_of_a_dense_program():
    """Dense Karush-Kuhn-Tucker check: the gradient is a combination of touched rows with the right signs."""
    problem = case(101, 30.0, 4, shares={"max_abs": 0.8, "max_slope": 0.6})
    found = problem.solve()
    smoother = problem.smoother
    rows = constraint_rows(problem.position_mm, smoother, *problem.bounds.limits)
    inner = np.setdiff1d(np.arange(101), problem.fixed)
    gradient = smoother.load(problem.y[:, None])[:, 0] - smoother.apply(problem.mu, found.curve[:, None])[:, 0]
    touched = np.flatnonzero(found.touched)
    signed = (rows.matrix[touched].toarray() * found.touched[touched, None])[:, inner]
    multiplier, *_ = np.linalg.lstsq(signed.T, gradient[inner], rcond=None)
    assert np.abs(signed.T @ multiplier - gradient[inner]).max() < 1e-8 * np.abs(gradient).max()
    assert multiplier.min() > -1e-7 * multiplier.max()
    # the reduced system is solved, so the distance to the optimum is that of a linear solve
    assert np.abs(rows.excess(found.curve)).max() <= KEPT


# --- random curves ------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(3, 60),
    size_um=st.floats(1e-3, 1e3),
    largest=st.floats(0.05, 2),
    steepest=st.floats(0.01, 5),
    bent=st.floats(0.001, 5),
    mu=st.one_of(st.none(), st.floats(0, 1e5)),
    known=st.booleans(),
)
def test_random_curves_keep_their_bounds_and_straightness_ends_are_exactly_zero(
    seed, n, size_um, largest, steepest, bent, mu, known
):
    rng = np.random.default_rng(seed)
    position = np.concatenate([[-800.0], np.sort(rng.choice(np.arange(-799, 0), n - 2, replace=False)), [0.0]])
    value = np.cumsum(rng.normal(size=n)) * size_um
    value -= np.interp(position, position[[0, -1]], value[[0, -1]])
    table = one_curve("EYX", position, value, 0.1 * size_um if known else np.nan)
    top = np.abs(value).max()
    limits = {"max_abs": largest * top, "max_slope": steepest * top / 0.8, "max_curvature": bent * top / 0.8**2}
    options = FitOptions.from_file_units(mu, *({"EYX": limit} for limit in limits.values()))
    curve = fit(machine_of(), table, options).errors.curves["EYX"]
    assert curve.value[0] == curve.value[-1] == 0.0
    bounds = options.bounds("EYX")
    over = bounds.excess(position, curve.value)
    assert all(excess <= KEPT * limit for excess, limit in zip(over[:3], bounds.limits, strict=True))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), n=st.integers(2, 40), direction=st.sampled_from(["increasing", "decreasing"]))
def test_random_monotone_curves_go_one_way_and_are_zero_at_the_reference(seed, n, direction):
    rng = np.random.default_rng(seed)
    position = np.concatenate([[-800.0], np.sort(rng.choice(np.arange(-799, 0), n - 2, replace=False)), [0.0]])
    table = one_curve("EXX", position, np.cumsum(rng.normal(size=n)), 0.3)
    result = fit(machine_of(), table, FitOptions(monotone={"EXX": direction}))
    step = np.diff(result.errors.curves["EXX"].value) * {"increasing": 1, "decreasing": -1}[direction]
    assert step.min() >= -1e-9 * UM
    assert result.errors.curves["EXX"].value[-1] == 0.0


def test_a_thousand_nodes_with_every_kind_of_bound_end_within_them_or_with_an_error():
    problems = [case(1001, 10.0**k, k, shares={"max_abs": 0.8, "max_slope": 0.6}) for k in range(6)]
    problems.append(case(1001, 100.0, 7, shares={"max_curvature": 0.5}))
    for problem in problems:
        found = problem.solve()
        assert found.touched.any()
        over = problem.bounds.excess(problem.position_mm, found.curve)
        assert all(excess <= KEPT * limit for excess, limit in zip(over[:3], problem.bounds.limits, strict=True))
        assert np.isfinite(found.curve).all()


# --- options ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mu", [0.1, 100.0])
@pytest.mark.parametrize("kind", [2, 3, 4, 5, 6])
def test_a_thousand_nodes_are_solved_by_sparse_matrices_and_no_curve_within_the_bounds_is_downhill(kind, mu):
    """The referee is a linear program: over all curves within the bounds the gradient is least at the optimum."""
    problem = case(1001, mu, seed=kind, **KINDS[kind])
    found = problem.solve()
    assert found.solver == "Clarabel"
    n, c, bounds, step = len(problem.y), found.curve, problem.bounds, np.diff(problem.position_mm)
    bend = sp.diags_array(second_difference(problem.position_mm).T, offsets=[0, 1, 2], shape=(n - 2, n))
    gradient = problem.weight * (c - problem.y) + mu * (bend.T @ (bend @ c))
    slope = sp.diags_array([-1 / step, 1 / step], offsets=[0, 1], shape=(n - 1, n))
    bent = sp.diags_array(curvature(problem.position_mm).T, offsets=[0, 1, 2], shape=(n - 2, n))
    parts = [(sign * rows / limit, 1.0) for rows, limit in ((slope, bounds.max_slope), (bent, bounds.max_curvature))
             for sign in (1, -1) if limit < math.inf]  # fmt: skip
    if bounds.direction:
        parts.append((-bounds.direction * slope * np.ptp(problem.position_mm), 0.0))
    largest = np.full(n, min(bounds.max_abs, 2 * np.abs(c).max()))
    largest[list(problem.fixed)] = 0.0
    matrix, limit = (
        sp.vstack([rows for rows, _ in parts]),
        np.repeat([top for _, top in parts], [rows.shape[0] for rows, _ in parts]),
    )
    least = linprog(gradient, A_ub=matrix, b_ub=limit, bounds=np.stack([-largest, largest], axis=1), method="highs")
    assert least.status == 0
    rounding = np.finfo(float).eps * np.abs(problem.weight * problem.y) @ largest  # of the gradient, a difference
    assert gradient @ c <= least.fun + 1e-6 * np.abs(gradient * c).sum() + rounding


def test_curvature_bounds_and_directions_come_in_file_units_and_are_reported():
    machine, position = machine_of(), np.linspace(-800, 0, 11)
    table = one_curve("EXX", position, 12 * np.sin(position / 130) + 0.01 * position, 0.2)
    free = fit(machine, table)
    options = FitOptions.from_file_units(max_curvature_um_m2_urad_m2={"linear": 300.0}, monotone={"EXX": "increasing"})
    result = fit(machine, table, options)
    c = result.errors.curves["EXX"].value
    bent = (curvature(position) * np.stack([c[:-2], c[1:-1], c[2:]], axis=1)).sum(axis=1)
    assert np.abs(bent).max() == pytest.approx(300e-9, rel=1e-8)  # 300 um/m^2
    assert np.diff(c).min() >= -1e-15 > np.diff(free.errors.curves["EXX"].value).min()
    touched = {bound.bound: bound.to_mm - bound.from_mm for bound in result.report["EXX"].active_bounds}
    assert touched == {"max_curvature": pytest.approx(160), "monotone": pytest.approx(80)}


def test_a_monotone_straightness_is_refused_with_the_relaxation_that_it_needs():
    position = np.linspace(-800, 0, 11)
    table = one_curve("EYX", position, -0.01 * np.minimum(position + 800, -3 * position), 0.0)  # falls 10 um/m
    with pytest.raises(InputError, match=r"monotone: EYX is zero at both ends.*slopes of 10 um/m against"):
        fit(machine_of(), table, FitOptions(smoothness=0.0, monotone={"EYX": "increasing"}))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_curvature": {"EXX": -1.0}}, "max_curvature: -1.0 for EXX is not a possible bound"),
        ({"monotone": {"linear": "increasing"}}, "monotone: 'linear' is not one of the curves"),
        ({"monotone": {"EXX": "up"}}, "monotone: 'up' for EXX is not allowed; give one of increasing, decreasing"),
    ],
)
def test_impossible_bounds_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        FitOptions(**settings)


# --- robust -------------------------------------------------------------------------------------------------------


def test_the_robust_fit_is_the_minimum_of_hubers_loss():
    n, u, mu = 15, 0.4, 3.0
    position = np.linspace(-800, 0, n)
    rng = np.random.default_rng(1)
    y = 10 * np.sin(position / 200) + rng.normal(size=n) * u
    y[[4, 9]] += (15, -30)
    y[-1] = 0
    result = fit(machine_of(), one_curve("EXX", position, y, u), FitOptions(smoothness=mu, robust=True))

    def loss(x):
        c = np.append(x, 0.0)
        r = np.abs(c - y) / u
        bend = np.diff(c, 2) / u
        return np.sum(np.where(r <= HUBER, r**2, 2 * HUBER * r - HUBER**2)) + mu * np.sum(bend**2)

    best = minimize(loss, y[:-1], method="BFGS", options={"gtol": 1e-9, "maxiter": 5000}).x
    assert result.errors.curves["EXX"].value[:-1] / UM == pytest.approx(best, abs=1e-5)
    assert set(position[[4, 9]]) <= set(result.report["EXX"].distrusted_mm)


@pytest.mark.parametrize("u", [0.3, math.nan])
def test_single_outliers_do_not_bend_a_robust_curve(u):
    position = np.linspace(-800, 0, 41)
    truth = 12 * np.sin(position / 200)
    rng = np.random.default_rng(2)
    y = truth + rng.normal(size=41) * 0.3
    y[-1] = 0
    y[[7, 22, 30]] += (60, -45, 80)
    worst = [
        np.abs(
            fit(machine_of(), one_curve("EXX", position, y, u), FitOptions(robust=on)).errors.curves["EXX"].value / UM
            - truth
        ).max()
        for on in (False, True)
    ]
    assert worst[0] > 3  # squares follow them, or are so smooth that they miss the curve
    assert worst[1] < 1.0


def test_without_outliers_the_robust_fit_is_nearly_the_plain_one():
    position = np.linspace(-800, 0, 41)
    y = 12 * np.sin(position / 200) + np.random.default_rng(3).normal(size=41) * 0.3
    plain, robust = (
        fit(machine_of(), one_curve("EXX", position, y, 0.3), FitOptions(robust=on)).errors.curves["EXX"].value / UM
        for on in (False, True)
    )
    assert np.abs(plain - robust).max() < 0.3


def test_the_running_median_takes_fewer_neighbours_at_the_ends():
    assert running_median(np.array([0.0, 5.0, 1.0, 9.0, 2.0, 3.0])) == pytest.approx([1, 3, 2, 3, 2.5, 3])


# --- correlated nodes ---------------------------------------------------------------------------------------------


def random_covariance(n, seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) * 0.3 + np.eye(n)
    return root @ root.T * 0.1


def correlated_case(n=9, seed=0, mu=2.0):
    rng = np.random.default_rng(seed)
    position = np.cumsum(rng.uniform(5, 20, n))
    held = tuple(interpolation_row(position, at) for at in (position[0], position[-1]))
    covariance = random_covariance(n, seed)
    y = rng.normal(size=n) * 3
    y[[0, -1]] = 0
    simple = Smoother.build(position, np.ones(n), held)
    return position, y, covariance, CorrelatedSmoother.of(simple, covariance / 0.25), mu


def test_the_correlated_smoother_is_generalised_least_squares():
    position, y, covariance, smoother, mu = correlated_case()
    inner = slice(1, -1)
    weight = 0.25 * np.linalg.inv(covariance[inner, inner])
    d2 = np.array([np.pad(row, (k, 6 - k)) for k, row in enumerate(second_difference(position))])[:, inner]
    a = weight + mu * d2.T @ d2
    expected = np.linalg.solve(a, weight @ y[inner])
    assert smoother.solve(mu, y[:, None])[inner, 0] == pytest.approx(expected, abs=1e-10)
    load = smoother.load(y[:, None])
    assert smoother.inverse(mu, load)[inner, 0] == pytest.approx(expected, abs=1e-10)
    assert smoother.apply(mu, smoother.solve(mu, y[:, None])) == pytest.approx(load, abs=1e-9)
    assert smoother.matrix(mu).toarray()[inner, inner] == pytest.approx(a, abs=1e-9)
    assert smoother.degrees_of_freedom(mu) == pytest.approx(np.trace(np.linalg.solve(a, weight)), abs=1e-9)
    assert smoother.misfit(y) == pytest.approx(y[inner] @ weight @ y[inner])


def test_restricted_likelihood_with_correlated_nodes_is_that_of_the_gaussian_process():
    position, y, covariance, smoother, _ = correlated_case(seed=3)
    d2 = np.array([np.pad(row, (k, 6 - k)) for k, row in enumerate(second_difference(position))])[:, 1:-1]
    criterion = reml_criterion(smoother, y, 0.5)

    def likelihood(mu):
        prior = np.linalg.inv(d2.T @ d2) * 0.25 / mu
        return -2 * multivariate_normal.logpdf(y[1:-1], cov=prior + covariance[1:-1, 1:-1])

    differences = [criterion(mu) - likelihood(mu) for mu in (1e-3, 0.1, 1.0, 30.0, 1e4)]
    assert differences == pytest.approx([differences[0]] * 5, abs=1e-6)


def test_a_diagonal_covariance_is_the_fit_with_independent_nodes():
    position = np.linspace(-800, 0, 11)
    y = 10 * np.sin(position / 150)
    y[-1] = 0
    u = np.linspace(0.2, 0.6, 11)
    table = ErrorTable({"EXX": Curve(position, y * UM, u * UM)})
    plain = fit(machine_of(), table)
    full = fit(machine_of(), table, covariance={"EXX": np.diag((u * UM) ** 2)})
    assert full.report["EXX"].correlated and not plain.report["EXX"].correlated
    assert full.errors.curves["EXX"].value == pytest.approx(plain.errors.curves["EXX"].value, abs=1e-4 * UM)
    assert full.errors.curves["EXX"].u == pytest.approx(plain.errors.curves["EXX"].u, rel=1e-3)


@pytest.mark.parametrize("name", ["EXX", "EYX"])
def test_the_uncertainty_of_correlated_nodes_is_the_scatter_of_fits_of_correlated_noise(name):
    position = np.linspace(-800, 0, 7)
    covariance = random_covariance(7, 5) * UM**2
    base = 8 * np.sin(position / 150) * UM + 3 * UM
    rng = np.random.default_rng(6)
    root = np.linalg.cholesky(covariance)
    fits = [
        fit(
            machine_of(),
            ErrorTable({name: Curve(position, base + root @ rng.normal(size=7), np.sqrt(np.diag(covariance)))}),
            FitOptions(smoothness=0.5),
            covariance={name: covariance},
        ).errors
        for _ in range(600)
    ]
    stated = fits[0].curves[name].u
    scatter = np.std([table.curves[name].value for table in fits], axis=0)
    assert scatter == pytest.approx(stated, rel=0.12, abs=1e-12)
    if name == "EYX":
        slopes = np.array([table.squareness["EC0Y"][0] for table in fits])
        assert fits[0].curves[name].u[[0, -1]] == pytest.approx([0, 0], abs=1e-9 * UM)
        variance = covariance[0, 0] + covariance[6, 6] - 2 * covariance[0, 6]
        assert np.std(slopes) == pytest.approx(math.sqrt(variance) / 800, rel=0.12)


def test_squareness_gains_the_variance_of_the_correlated_line():
    position = np.linspace(-800, 0, 5)
    covariance = random_covariance(5, 1) * UM**2
    table = ErrorTable(
        {"EXY": Curve(position * 1.25, np.array([3.0, 1, 4, 1, 5]) * UM, np.full(5, UM))}, {"EC0Y": (0.0, 0.0)}
    )
    result = fit(machine_of(), table, covariance={"EXY": covariance})
    variance = covariance[0, 0] + covariance[4, 4] - 2 * covariance[0, 4]
    assert result.errors.squareness["EC0Y"][1] == pytest.approx(math.sqrt(variance) / 1000, rel=1e-9)


def test_bounds_hold_with_correlated_nodes_and_the_optimum_is_clarabels():
    cp = importlib.import_module("cvxpy")
    position, y, covariance, smoother, mu = correlated_case(n=15, seed=2)
    problem = CurveProblem(position, y, np.ones(15), (0, 14), mu, Bounds(max_abs=0.8, max_slope=0.05))
    found = problem.solve(smoother)
    c = cp.Variable(15)
    misfit = cp.quad_form((c - y)[1:-1], cp.psd_wrap(0.25 * np.linalg.inv(covariance[1:-1, 1:-1])))
    bend = cp.hstack([row @ c[k : k + 3] for k, row in enumerate(second_difference(position))])
    rules = [c[0] == 0, c[14] == 0, cp.abs(c) <= 0.8, cp.abs(cp.diff(c)) <= 0.05 * np.diff(position)]
    cp.Problem(cp.Minimize(misfit + mu * cp.sum_squares(bend)), rules).solve(
        solver="CLARABEL", tol_gap_rel=1e-12, tol_gap_abs=1e-12
    )
    assert found.touched.any()
    assert found.curve == pytest.approx(c.value, abs=1e-5)


def correlated_with_bounds(kind, seed):
    """A curve with correlated nodes within bounds that it touches: held at both ends, at a node, or between two."""
    rng = np.random.default_rng(100 * kind + seed)
    n = (4, 9, 15, 31, 60)[seed % 5]
    position = np.cumsum(rng.uniform(5, 20, n))
    ends = ((position[0], position[-1]), (position[n // 2],), (0.3 * position[1] + 0.7 * position[2],))[seed % 3]
    if "direction" in KINDS[kind]:
        ends = ends[-1:]
    held = tuple(interpolation_row(position, at) for at in ends)
    distance = np.abs(position[:, None] - position)
    covariance = (np.exp(-distance / 60) + 0.2 * np.eye(n)) * rng.uniform(0.05, 0.5)
    smoother = CorrelatedSmoother.of(Smoother.build(position, np.ones(n), held), covariance / 0.25)
    mu = min(10.0 ** rng.uniform(-2, 3), smoother.largest_mu)
    wave = 10 * np.sin(3 * position / np.ptp(position) + seed) + rng.normal(size=n)
    y = smoother.expand(wave[:, None])[:, 0]
    problem = CurveProblem(position, y, np.ones(n), (), mu, Bounds())
    free = smoother.solve(mu, y[:, None])[:, 0]
    return replace(problem, bounds=bounds_of(position, free, **KINDS[kind])), smoother, covariance


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_correlated_curves_within_bounds_meet_the_optimality_conditions_and_the_general_solver(kind, seed, monkeypatch):
    problem, smoother, covariance = correlated_with_bounds(kind, seed)
    found = problem.solve(smoother)
    assert found.solver in ("direct", "active set")
    monkeypatch.setattr(CorrelatedSmoother, "inverse_root", lambda self, mu: None)
    general = problem.solve(smoother)
    assert general.solver == ("direct" if found.solver == "direct" else "Clarabel")
    assert found.curve == pytest.approx(general.curve, abs=1e-8)
    excess = problem.bounds.excess(problem.position_mm, found.curve)
    limits = (*problem.bounds.limits, np.abs(problem.y).max() / np.ptp(problem.position_mm))
    assert all(over <= KEPT * limit for over, limit in zip(excess, limits, strict=True) if over)
    # the gradient by the free nodes, with the inverse of the covariance, is a sum of active rows with multipliers >= 0
    nodes = smoother.nodes
    weight = 0.25 * np.linalg.inv(covariance[np.ix_(nodes, nodes)])
    d2 = np.zeros((len(problem.y) - 2, len(problem.y)))
    for k, row in enumerate(second_difference(problem.position_mm)):
        d2[k, k : k + 3] = row
    turned = d2 @ smoother.turn
    gradient = weight @ (found.curve - problem.y)[nodes] + problem.mu * turned.T @ (turned @ found.curve[nodes])
    rows = constraint_rows(problem.position_mm, smoother, *problem.bounds.limits, problem.bounds.direction)
    touched = np.flatnonzero(found.touched)
    signed = rows.matrix.toarray()[touched][:, nodes] * found.touched[touched, None]
    left = nnls(signed.T, -gradient)[1] if len(touched) else np.linalg.norm(gradient)
    assert left <= 1e-7 * np.linalg.norm(weight @ problem.y[nodes])


def test_misfit_and_bending_of_correlated_nodes_are_those_of_the_fitted_curve():
    for held_at_one in (False, True):
        _, y, covariance, smoother, _ = correlated_case(n=12, seed=4)
        if held_at_one:
            position = np.cumsum(np.random.default_rng(4).uniform(5, 20, 12))
            at = interpolation_row(position, 0.4 * position[3] + 0.6 * position[4])
            smoother = CorrelatedSmoother.of(Smoother.build(position, np.ones(12), (at,)), covariance)
            y = smoother.expand(y[:, None])[:, 0]
        costs = smoother.costs(y)
        for mu in (0.0, 1e-3, 1.0, 1e4):
            curve = smoother.solve(mu, y[:, None])[:, 0]
            expected = smoother.misfit(y - curve), float(np.sum(smoother.bend(curve[:, None]) ** 2))
            assert costs(mu) == pytest.approx(expected, rel=1e-9, abs=1e-9)
            root = smoother.inverse_root(mu)
            load = np.random.default_rng(1).normal(size=(12, 1))
            assert root @ (root.T @ smoother.load(load)) == pytest.approx(smoother.solve(mu, load), abs=1e-9)


@pytest.mark.parametrize(
    ("covariance", "message"),
    [
        ({"EXQ": np.eye(5)}, "'EXQ' is not one of the 18 curves"),
        ({"EXX": np.eye(4)}, r"EXX has 5 nodes and a covariance of shape \(4, 4\)"),
        ({"EXX": np.triu(np.ones((5, 5)))}, "not finite and symmetric"),
        ({"EXX": np.diag([1.0, 1, -1, 1, 1])}, "negative variance"),
        ({"EXX": np.full((5, 5), np.nan)}, "not finite and symmetric"),
    ],
)
def test_what_is_no_covariance_of_the_curve_is_refused(covariance, message):
    table = one_curve("EXX", np.linspace(-800, 0, 5), np.zeros(5), 1.0)
    with pytest.raises(InputError, match=message):
        fit(machine_of(), table, covariance=covariance)


def test_the_covariance_of_an_identification_counts_and_must_have_the_nodes_of_the_table(example):
    joint = joint_covariance(example.identified)
    errors = example.identified.errors
    result = fit(example.machine, errors, covariance=joint)
    assert all(report.correlated for report in result.report.values())
    names = np.array(joint.error)
    block = joint.errors_covariance[np.ix_(names == "EAX", names == "EAX")]
    alone = fit(example.machine, errors.only("EAX", "EA0Z"), covariance={"EAX": block})
    assert alone.errors.curves["EAX"].value == pytest.approx(result.errors.curves["EAX"].value, abs=1e-12)
    moved = Curve(errors.curves["EXX"].position_mm * 0.999, errors.curves["EXX"].value, errors.curves["EXX"].u)
    with pytest.raises(InputError, match="covariance of EXX belongs to other nodes"):
        fit(example.machine, errors.replace(curves={**errors.curves, "EXX": moved}), covariance=joint)


# --- own constraints ----------------------------------------------------------------------------------------------


def two_curves():
    position = np.linspace(-800, 0, 11)
    first = one_curve("EXX", position, 0.02 * position + 3 * np.sin(position / 200), 0.3)
    second = one_curve("EYX", position, 5 * np.sin(np.pi * position / 800), 0.3)
    third = one_curve("EAX", position, 20 * np.sin(position / 300), 0.5)
    return ErrorTable({**first.curves, **second.curves, **third.curves}, {"EA0Z": (0.0, URAD)})


def test_own_constraints_that_are_not_active_leave_the_fit_as_it_is():
    machine, options = machine_of(), FitOptions.from_file_units(max_abs_um_urad={"linear": 4.0})
    plain = fit(machine, two_curves(), options)
    own = fit(machine, two_curves(), options, constraints=lambda c: [c["EXX"] <= 1e3])
    for name, curve in plain.errors.curves.items():
        assert own.errors.curves[name].value == pytest.approx(curve.value, abs=1e-5 * error_named(name).si_per_unit)
        assert own.report[name].solver == "cvxpy"
    assert own.errors.curves["EYX"].value[0] == own.errors.curves["EYX"].value[-1] == 0.0


def test_own_constraints_couple_curves_in_file_units():
    def tie(c):
        return {"tie": c["EXX"][5] == 2 * c["EYX"][5] + 1, "angle": c["EAX"][3] == -7.5}

    result = fit(machine_of(), two_curves(), constraints=tie)
    exx, eyx, eax = (result.errors.curves[name].value for name in ("EXX", "EYX", "EAX"))
    assert exx[5] / UM == pytest.approx(2 * eyx[5] / UM + 1, abs=1e-6)
    assert eax[3] / URAD == pytest.approx(-7.5, abs=1e-6)


def test_a_coupled_fit_weighs_curves_by_their_uncertainty():
    """Two single values with a given sum: the correction is shared in the ratio of the variances."""
    position = np.array([-800.0, 0.0])
    table = ErrorTable(
        {**one_curve("EXX", position, [4.0, 0], 1.0).curves, **one_curve("EAX", position, [6.0, 0], 2.0).curves}
    )
    result = fit(machine_of(), table, constraints=lambda c: [c["EXX"][0] + c["EAX"][0] == 15])
    assert result.errors.curves["EXX"].value[0] / UM == pytest.approx(4 + 5 * 1 / 5, abs=1e-5)
    assert result.errors.curves["EAX"].value[0] / URAD == pytest.approx(6 + 5 * 4 / 5, abs=1e-5)


@pytest.mark.parametrize(
    ("constraints", "message"),
    [
        (lambda c: {"end": c["EYX"][0] >= 1.5}, "least relaxation that helps: end relaxed by 1.5$"),
        (
            lambda c: {"high": c["EXX"][3] >= 5, "fine": c["EAX"] <= 100},
            "least relaxation that helps: high relaxed by 1$",
        ),
        (lambda c: [c["EYX"][0] + c["EYX"][10] == 2], r"constraint 1 \(EYX\[0\] \+ EYX\[10\] == 2.0\) relaxed by 2"),
        (lambda c: {"all": c["EYX"] >= 0.5}, r"all relaxed by 0.5 \(largest of 2 of its 11 entries\)"),
        (lambda c: 3, "the callable returned int; return a list"),
        (lambda c: [True], "constraint 1 .* is a bool; return cvxpy constraints"),
        (lambda c: {"bent": c["EXX"][0] ** 2 >= 1}, "bent is not convex"),
    ],
)
def test_own_constraints_that_cannot_be_are_named_with_the_least_relaxation(constraints, message):
    options = FitOptions.from_file_units(max_abs_um_urad={"linear": 4.0})
    with pytest.raises(InputError, match=message):
        fit(machine_of(), two_curves(), options, constraints=constraints)


def test_the_relaxation_that_the_message_names_is_enough_and_less_is_not():
    machine, options = machine_of(), FitOptions.from_file_units(max_abs_um_urad={"linear": 4.0})
    fit(machine, two_curves(), options, constraints=lambda c: [c["EXX"][3] >= 5 - 1])
    with pytest.raises(InputError, match="by 0.001"):
        fit(machine, two_curves(), options, constraints=lambda c: {"high": c["EXX"][3] >= 5 - 0.999})


# --- command line -------------------------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments], standalone_mode=False)


def test_the_command_takes_bounds_in_file_units(tmp_path, small_machine, small_machine_file, small_errors):
    path = tmp_path / "identified.errors.csv"
    path.write_text(format_errors(small_errors))
    bounds = ["--max-abs", "linear=6", "--max-abs", "EXX=8", "--max-slope", "angular=100", "--max-curvature", "EAX=500"]
    done = run(
        "fit", small_machine_file, path, *bounds, "--monotone", "EZZ=increasing", "--robust", "--out", tmp_path / "o"
    )
    assert done.exception is None and done.return_value == 0
    curves = compgen.read_errors(tmp_path / "o" / "fitted.errors.csv").curves
    top = {name: np.abs(curve.value).max() / error_named(name).si_per_unit for name, curve in curves.items()}
    assert top["EXX"] == pytest.approx(8, abs=1e-6)
    assert all(top[name] <= 6 + 1e-6 for name in top if name != "EXX" and error_named(name).kind == "linear")
    slopes = [
        np.abs(np.diff(c.value) / np.diff(c.position_mm)).max()
        for n, c in curves.items()
        if error_named(n).kind == "angular"
    ]
    assert max(slopes) == pytest.approx(100e-9, rel=1e-6)
    assert np.diff(curves["EZZ"].value).min() >= 0
    report = json.loads((tmp_path / "o" / "fit.json").read_text())["curves"]
    assert {bound["bound"] for bound in report["EXX"]["active_bounds"]} == {"max_abs"}


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--max-abs", "EXX", "--max-abs: 'EXX' is not of the form NAME=LIMIT"),
        ("--max-slope", "EXX=steep", "--max-slope: 'steep' for EXX is not a number"),
        ("--max-abs", "EXX=-3", "max_abs: -0.003 for EXX is not a possible bound"),
        ("--monotone", "EXX=up", "'up' for EXX is not allowed"),
    ],
)
def test_wrong_bounds_on_the_command_line_are_explained(
    tmp_path, small_machine_file, small_errors, option, value, message
):
    path = tmp_path / "identified.errors.csv"
    path.write_text(format_errors(small_errors))
    done = run("fit", small_machine_file, path, option, value, "--out", tmp_path / "o")
    assert isinstance(done.exception, InputError)
    assert message in str(done.exception)
    assert not (tmp_path / "o").exists()


def test_the_command_uses_the_covariance_that_belongs_to_the_errors_and_no_other(
    tmp_path, small_machine, small_machine_file, small_lengths_file
):
    run("identify", small_machine_file, small_lengths_file, "--out", tmp_path)
    errors = tmp_path / "identified.errors.csv"

    def correlated(*options):
        done = run("fit", small_machine_file, errors, *options, "--out", tmp_path / "fitted")
        assert done.exception is None
        report = json.loads((tmp_path / "fitted" / "fit.json").read_text())["curves"]
        return {entry["correlated"] for entry in report.values()}

    assert correlated() == {True}
    assert correlated("--covariance", tmp_path / "identified.covariance.npz") == {True}
    assert correlated("--independent") == {False}
    errors.write_text(errors.read_text() + "# edited\n")
    with pytest.warns(CompgenWarning, match="belongs to another version of identified.errors.csv"):
        assert correlated() == {False}


def test_a_solver_that_cannot_finish_is_an_error_and_not_a_curve(monkeypatch):
    bounds = importlib.import_module("compgen.fitting.bounds")
    problem = case(11, 1.0, 0, shares={"max_abs": 0.5})
    monkeypatch.setattr(bounds, "SOLVERS", {"none": lambda *program: None})
    monkeypatch.setattr(bounds, "_active_set", lambda *start: None)
    with pytest.raises(ConvergenceError, match="no optimum that passes its check"):
        problem.solve()
