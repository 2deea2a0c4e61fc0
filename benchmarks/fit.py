"""The constrained fit against OSQP, cvxpy and Clarabel on the same problem (python benchmarks/fit.py).

Every side gets the same 18 curves as arrays (positions, data, weights, held nodes, smoothness, bounds) and returns 18
fitted curves. Timed with compgen is all of it: it lays out the band, factors, solves, checks the bounds and, where one
is broken, solves the bounded problem to its optimality conditions. The others get their sparse matrices ready made,
outside the time: OSQP sets up and solves from cold, curve by curve; cvxpy builds, compiles and solves one problem per
curve, written as a quadratic form (the form that suits it best). The smoothness is given: finding it is no part of it.

"no bound active": bounds are there and none is touched. "active": 0.8 of the largest value and 0.6 of the largest slope
of each curve, so that every curve touches bounds.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable, Sequence

import clarabel
import cvxpy as cp
import numpy as np
import osqp
import scipy.sparse as sp
import timing

from compgen.core.csvio import FloatArray
from compgen.fit.bounds import Bounds
from compgen.fit.smooth import second_difference
from compgen.fit.solve import solve_curves
from compgen.fit.stacked import CurveProblem, Stack
from compgen.model.evaluate import load_kernels

OURS, OSQP, CVXPY = "compgen", "OSQP cold", "cvxpy+Clarabel"
CURVES = 18
#: Bounds so wide that no curve touches them.
WIDE = 1.5


def curves(n: int, *, active: bool, seed: int = 0) -> list[CurveProblem]:
    """18 curves like those of a machine: every third held at one node inside, the others at both ends."""
    rng = np.random.default_rng(seed)
    return [_curve(rng, n, k, active=active) for k in range(CURVES)]


def _curve(rng: np.random.Generator, n: int, k: int, *, active: bool) -> CurveProblem:
    position = np.cumsum(rng.uniform(4, 12, n))
    t = (position - position[0]) / np.ptp(position)
    y = 20 * np.sin(2 * np.pi * t + 0.1 * k) + 8 * np.sin(6 * np.pi * t + 0.3) + rng.normal(size=n) * 0.3
    held = (0, n - 1) if k % 3 else (n // 3,)
    y = y - (y[0] + (y[-1] - y[0]) * t if k % 3 else y[n // 3])
    y[list(held)] = 0.0
    mu = 10 ** rng.uniform(-1, 3)
    problem = CurveProblem(position, y, rng.uniform(0.5, 2, n), held, mu)
    free = Stack.build([problem]).solve()
    largest, steepest = float(np.abs(free).max()), float(np.abs(np.diff(free) / np.diff(position)).max())
    share = (0.8, 0.6) if active else (WIDE, WIDE)
    return CurveProblem(position, y, problem.weight, held, mu, Bounds(share[0] * largest, share[1] * steepest))


#: P, q, A, limit of one curve.
Program = tuple[sp.csc_matrix, FloatArray, sp.csc_matrix, FloatArray]


def program(problem: CurveProblem) -> Program:
    """P, q, A, limit of min x^T P x / 2 + q^T x, |A x| <= limit, zeros eliminated; x are the free nodes."""
    n = len(problem.y)
    free = np.setdiff1d(np.arange(n), problem.held)
    rows = second_difference(problem.position_mm)
    bend = sp.diags_array([rows[:, 0], rows[:, 1], rows[:, 2]], offsets=[0, 1, 2], shape=(n - 2, n)).tocsc()[:, free]
    quadratic = sp.diags_array(problem.weight[free]) + problem.mu * (bend.T @ bend)
    step = np.diff(problem.position_mm)
    slope = sp.diags_array([-1 / step, 1 / step], offsets=[0, 1], shape=(n - 1, n)).tocsc()[:, free]
    limit = np.repeat([problem.bounds.max_abs, problem.bounds.max_slope], [len(free), n - 1])
    matrix = sp.csc_matrix(sp.vstack([sp.eye_array(len(free)), slope]))
    return sp.csc_matrix(quadratic), -problem.weight[free] * problem.y[free], matrix, limit


def _whole(problem: CurveProblem, x: FloatArray) -> FloatArray:
    curve = np.zeros(len(problem.y))
    curve[np.setdiff1d(np.arange(len(curve)), problem.held)] = x
    return curve


def ours(problems: Sequence[CurveProblem]) -> list[FloatArray]:
    """Fit with compgen."""
    return [solution.curve for solution in solve_curves(problems)]


def with_osqp(programs: Sequence[Program], tolerance: float = 1e-6) -> list[FloatArray]:
    """Fit with OSQP, set up afresh for every curve; returns the free nodes."""
    found = []
    for quadratic, linear, matrix, limit in programs:
        upper = sp.triu(quadratic, format="csc")
        solver = osqp.OSQP()
        solver.setup(
            upper, linear, matrix, -limit, limit,
            eps_abs=tolerance, eps_rel=tolerance, max_iter=20000, verbose=False,
        )  # fmt: skip
        found.append(solver.solve().x)
    return found


def with_cvxpy(programs: Sequence[Program]) -> list[FloatArray]:
    """Fit with cvxpy and Clarabel at its own tolerances; returns the free nodes."""
    found = []
    for quadratic, linear, matrix, limit in programs:
        x = cp.Variable(len(linear))
        values = matrix @ x
        cost = 0.5 * cp.quad_form(x, cp.psd_wrap(quadratic)) + linear @ x
        cp.Problem(cp.Minimize(cost), [values <= limit, values >= -limit]).solve(solver="CLARABEL")
        found.append(x.value)
    return found


def referee(problems: Sequence[CurveProblem]) -> list[FloatArray]:
    """Clarabel directly, unknowns scaled to 1 on the diagonal, as tight as it goes: the referee of the solution."""
    found = []
    for problem in problems:
        quadratic, linear, matrix, limit = program(problem)
        scale = 1 / np.sqrt(quadratic.diagonal())
        stretch = sp.diags_array(scale)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
        rows = sp.csc_matrix(sp.vstack([matrix, -matrix]) / np.tile(limit, 2)[:, None] @ stretch)
        cone = [clarabel.NonnegativeConeT(2 * len(limit))]
        inner = sp.triu(sp.csc_matrix(stretch @ quadratic @ stretch), format="csc")
        solver = clarabel.DefaultSolver(inner, scale * linear, rows, np.ones(2 * len(limit)), cone, settings)
        found.append(_whole(problem, scale * np.array(solver.solve().x)))
    return found


def deviation(found: Sequence[FloatArray], expected: Sequence[FloatArray]) -> float:
    """Largest difference between two sets of curves."""
    return max(float(np.abs(one - other).max()) for one, other in zip(found, expected, strict=True))


def compare(n: int, runs: int, *, active: bool, slow: bool) -> None:
    """Time one case and print it; ``slow``: with the peers that need seconds here."""
    problems = curves(n, active=active)
    programs = [program(problem) for problem in problems]
    functions: dict[str, Callable[[], list[FloatArray]]] = {OURS: lambda: ours(problems)}
    if slow or not active:
        functions[OSQP] = lambda: with_osqp(programs)
    if slow or n <= 301:
        functions[CVXPY] = lambda: with_cvxpy(programs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        comparison = timing.alternate(functions, runs)
        title = f"{CURVES} curves of {n} nodes, {'active bounds' if active else 'no bound active'}"
        timing.print_comparison(title, comparison, references=(OURS,))
        expected = referee(problems)
        far = {OURS: f"{deviation(ours(problems), expected):.1e}"}
        for name in [name for name in functions if name != OURS]:
            whole = [_whole(problem, x) for problem, x in zip(problems, functions[name](), strict=True)]
            far[name] = f"{deviation(whole, expected):.1e}"
    touched = sum(bool(solution.touched.any()) for solution in solve_curves(problems))
    print(f"  curves at a bound: {touched}; deviation from the referee, um: {far}")


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="rounds, at least 5")
    parser.add_argument("--nodes", type=int, nargs="*", default=[11, 51, 101, 301, 1001], help="nodes per curve")
    parser.add_argument("--slow", action="store_true", help="also the peers that need many seconds for a case")
    arguments = parser.parse_args()
    print(timing.machine_line(("numpy", "scipy", "osqp", "clarabel", "cvxpy")))
    print("  compiled loops loaded beforehand, as after an identification:", load_kernels())
    for active in (False, True):
        for n in arguments.nodes:
            compare(n, arguments.runs, active=active, slow=arguments.slow or n <= 101)


if __name__ == "__main__":
    main()
