"""Curves that are solved together: each as if it were alone, and as it reads on paper."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compgen.fitting import curve_fit
from compgen.fitting.bounds import Bounds, curvature, solve_curve
from compgen.fitting.curve_fit import CurveProblem, solve_curves
from compgen.fitting.smoother import CorrelatedSmoother, Smoother, second_difference
from compgen.fitting.zeroing import interpolation_row

NO_BOUNDS = Bounds()


def problem_of(position, weight, rows, mu, y, bounds=NO_BOUNDS):
    smoother = Smoother.build(position, weight, tuple(rows))
    return CurveProblem(smoother, min(mu, smoother.largest_mu), position, y, bounds)


def random_problem(rng, n, *, weights=3.0, mu=12.0, size=3.0):
    """Uneven nodes, weights over ``weights`` decades either way, mu over ``mu`` and data over ``size`` likewise."""
    position = np.cumsum(10 ** rng.uniform(-1, 2, n)) - rng.uniform(0, 1000)
    fixed = rng.choice(n, size=int(rng.integers(0, min(n, 3))), replace=False)
    y = np.cumsum(rng.normal(size=n)) * 10 ** rng.uniform(-size, size)
    weight = 10 ** rng.uniform(-weights, weights, n)
    exponent = rng.uniform(-mu, mu)
    return problem_of(position, weight, [((int(k), 1.0),) for k in fixed], 10**exponent, y)


def alone(problems):
    return [solve_curve(*problem) for problem in problems]


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        assert one.curve == pytest.approx(other.curve, rel=0, abs=1e-12 * np.abs(other.curve).max())
        assert one.solver == other.solver
        assert np.array_equal(one.touched, other.touched)


@pytest.fixture
def one_by_one(monkeypatch):
    """Nodes of the curves that were not finished together."""
    seen = []

    def counted(smoother, *rest):
        seen.append(len(smoother.weight))
        return solve_curve(smoother, *rest)

    monkeypatch.setattr(curve_fit, "solve_curve", counted)
    return seen


@pytest.fixture
def bounded(monkeypatch):
    """Nodes of the curves that were solved within their bounds, together."""
    seen, whole = [], curve_fit._bounded

    def counted(problems, free):
        seen.extend(len(problem.y) for problem in problems)
        return whole(problems, free)

    monkeypatch.setattr(curve_fit, "_bounded", counted)
    return seen


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), sizes=st.lists(st.integers(1, 40), min_size=1, max_size=18))
def test_random_curves_solved_together_are_those_solved_alone(seed, sizes):
    rng = np.random.default_rng(seed)
    problems = [random_problem(rng, n) for n in sizes]
    assert_same(solve_curves(problems), alone(problems))


def test_fixed_nodes_are_exactly_zero_and_nothing_is_left_for_one_by_one(one_by_one):
    rng = np.random.default_rng(1)
    problems = [random_problem(rng, n) for n in (11, 1, 2, 3, 50, 21)]
    for problem, solution in zip(problems, solve_curves(problems), strict=True):
        assert not solution.curve[[node for node, _, _ in problem.smoother.steps]].any()
    assert one_by_one == []


def test_no_curve_changes_with_the_company_it_has():
    rng = np.random.default_rng(7)
    problems = [random_problem(rng, n) for n in (11, 21, 31, 41) * 5]
    for problem, solution in zip(problems, solve_curves(problems), strict=True):
        assert np.array_equal(solution.curve, solve_curves([problem])[0].curve)


def test_a_small_curve_is_as_exact_beside_one_that_is_a_million_million_times_as_large():
    rng = np.random.default_rng(2)
    small = random_problem(rng, 31, mu=4.0)
    large = small._replace(y=1e12 * small.y[::-1])
    together = solve_curves([large, small, large])
    assert np.array_equal(together[1].curve, solve_curves([small])[0].curve)
    assert_same(together, alone([large, small, large]))


def dense(problem):
    """The minimum from its definition, all nodes in one least-squares problem."""
    n, fixed = len(problem.y), [node for node, _, _ in problem.smoother.steps]
    bend = np.zeros((max(n - 2, 0), n))
    for k, row in enumerate(second_difference(problem.position_mm)):
        bend[k, k : k + 3] = row
    root = np.sqrt(problem.smoother.weight)
    free = np.setdiff1d(np.arange(n), fixed)
    matrix = np.vstack([np.diag(root), math.sqrt(problem.mu) * bend])[:, free]
    c = np.zeros(n)
    c[free] = np.linalg.lstsq(matrix, np.concatenate([root * problem.y, np.zeros(len(bend))]))[0]
    return c


def test_curves_are_the_minimum_of_their_definition():
    rng = np.random.default_rng(3)
    problems = [random_problem(rng, n, weights=1.0, mu=3.0) for n in (1, 2, 3, 11, 21, 40, 11)]
    for problem, solution in zip(problems, solve_curves(problems), strict=True):
        expected = dense(problem)
        assert solution.curve == pytest.approx(expected, rel=0, abs=1e-9 * np.abs(expected).max())


def needs(problem):
    """Largest magnitude, slope and curvature of the curve without bounds."""
    position, c = problem.position_mm, solve_curve(*problem).curve
    bent = (curvature(position) * np.stack([c[:-2], c[1:-1], c[2:]], axis=1)).sum(axis=1)
    return np.abs(c).max(), np.abs(np.diff(c) / np.diff(position)).max(), np.abs(bent).max()


@pytest.mark.parametrize("kind", ["max_abs", "max_slope", "max_curvature"])
def test_only_curves_that_break_their_bound_are_solved_again(kind, bounded, one_by_one):
    rng = np.random.default_rng(4)
    problems = []
    for k, n in enumerate((11, 12, 13, 14, 15)):
        problem = random_problem(rng, n, weights=0.5, mu=1.0, size=1.0)
        need = dict(zip(("max_abs", "max_slope", "max_curvature"), needs(problem), strict=True))[kind]
        share = 1 - 1e-6 if k % 2 else 1 + 1e-6
        problems.append(problem._replace(bounds=Bounds(**{kind: share * need})))
    found = solve_curves(problems)
    assert (bounded, one_by_one) == ([12, 14], [])
    assert [solution.solver for solution in found] == ["direct", "active set"] * 2 + ["direct"]
    assert_same(found, alone(problems))


def test_a_direction_is_checked_within_each_curve_and_not_from_one_to_the_next(bounded):
    """Two rising curves, the second far below the end of the first; one that falls once."""
    position, rise = np.linspace(-800, 0, 9), np.linspace(-40.0, 0.0, 9)
    dip = rise - 9.0 * (np.arange(9) == 4)
    up, down = Bounds(direction=1), Bounds(direction=-1)
    cases = [(rise, up), (rise, up), (dip, up), (-rise, down), (-dip, down), (dip, down)]
    problems = [
        problem_of(position + 1000.0 * k, np.ones(9), [((8, 1.0),)], 1e-3, y, bounds)
        for k, (y, bounds) in enumerate(cases)
    ]
    found = solve_curves(problems)
    assert len(bounded) == 3
    assert [solution.solver == "direct" for solution in found] == [True, True, False, True, False, False]
    assert_same(found, alone(problems))


LIMITS = st.fixed_dictionaries(
    {
        "max_abs": st.sampled_from([math.inf, 0.9, 0.5, 0.1]),
        "max_slope": st.sampled_from([math.inf, 0.9, 0.5, 0.2]),
        "max_curvature": st.sampled_from([math.inf, 0.8, 0.3]),
        "direction": st.sampled_from([0, 0, 0, 1, -1]),
    }
)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), chosen=st.lists(st.tuples(st.integers(4, 40), LIMITS), min_size=1, max_size=6))
def test_bounded_curves_solved_together_are_those_solved_alone(seed, chosen):
    """Two methods, one optimum: interior points on the band of all curves, and exchange of rows for each alone."""
    rng = np.random.default_rng(seed)
    problems = []
    for n, share in chosen:
        problem = random_problem(rng, n, weights=0.7, mu=3.0, size=1.0)
        own = [
            share[kind] * need
            for kind, need in zip(("max_abs", "max_slope", "max_curvature"), needs(problem), strict=True)
        ]
        problems.append(problem._replace(bounds=Bounds(*own, share["direction"])))
    found = solve_curves(problems)
    for problem, one, other in zip(problems, found, alone(problems), strict=True):
        assert one.curve == pytest.approx(other.curve, rel=0, abs=1e-7 * np.abs(problem.y).max())
        assert max(problem.bounds.excess(problem.position_mm, one.curve)) <= 2e-9 * np.abs(problem.y).max()
    for problem, one in zip(problems, found, strict=True):
        assert one.curve == pytest.approx(solve_curves([problem])[0].curve, rel=0, abs=1e-9 * np.abs(problem.y).max())


def test_a_bounded_curve_on_which_the_corrector_alone_goes_round_in_a_circle():
    """18 curves of 101 nodes at bounds: one of these took 60 steps without a result while its corrector had no limit."""
    rng = np.random.default_rng(1)
    problems = []
    for _ in range(18):
        problem = random_problem(rng, 101, weights=0.3, mu=2.0, size=0.5)
        largest, steepest, _ = needs(problem)
        problems.append(problem._replace(bounds=Bounds(0.8 * largest, 0.6 * steepest)))
    for one, other in zip(solve_curves(problems), alone(problems), strict=True):
        assert one.solver == "active set"
        assert one.curve == pytest.approx(other.curve, rel=0, abs=1e-7 * np.abs(other.curve).max())


def test_correlated_curves_and_those_fixed_between_nodes_are_solved_by_themselves(one_by_one):
    rng = np.random.default_rng(5)
    position = np.cumsum(rng.uniform(4, 12, 9))
    between = interpolation_row(position, 0.3 * position[2] + 0.7 * position[3])
    plain = random_problem(rng, 7)
    held = problem_of(position, np.ones(9), [between], 1.0, rng.normal(size=9))
    wide = Smoother.build(np.arange(8.0), np.ones(8), (((0, 1.0),),))
    covariance = np.eye(8) + 0.3 * np.exp(-np.abs(np.subtract.outer(range(8), range(8))))
    correlated = CurveProblem(CorrelatedSmoother.of(wide, covariance), 1.0, np.arange(8.0), rng.normal(size=8))
    problems = [held, plain, correlated, plain]
    assert_same(solve_curves(problems), alone(problems))
    assert one_by_one == [9, 8]
    assert solve_curves([]) == []


def test_a_matrix_that_is_not_positive_definite_is_an_error_as_alone():
    rng = np.random.default_rng(6)
    good = random_problem(rng, 11, weights=0.5, mu=1.0)
    bad = CurveProblem(Smoother.build(good.position_mm, np.full(11, -1.0), ()), 0.0, good.position_mm, good.y)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        solve_curves([good, bad])
