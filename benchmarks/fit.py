"""The constrained fit against OSQP, cvxpy and Clarabel on the same problem (python benchmarks/fit.py).

Every side gets the same 18 curves (positions, data, weights, fixed nodes, smoothness, bounds) and returns 18 fitted
curves. compgen gets its smoothers (weights and the band of the penalty) ready made, as ``fit`` has them when it
comes to solve; timed is the rest: it lays the curves together, factors, solves, checks the bounds and, where one is broken,
solves the bounded problem to its optimality conditions. "with its smoothers" builds these from the arrays in the time
too. The others get their sparse matrices ready made, outside the time: OSQP sets up and solves from cold, curve by curve;
cvxpy builds, compiles and solves one problem per curve, written as a quadratic form (the form that suits it best). The
smoothness is given: finding it is no part of it.

"no bound active": bounds are there and none is touched. "active": 0.8 of the largest value and 0.6 of the largest slope
of each curve, so that every curve touches bounds.

"with covariance" is what ``volcomp run`` does: ``fit`` with the joint covariance of the nodes, the whole call (zeroing,
search for the smoothness, solution, uncertainties, report), and its solution at the smoothness found, alone. The others get
the programs of that smoothness and only solve.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import clarabel
import cvxpy as cp
import numpy as np
import osqp
import scipy.sparse as sp
import timing

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Chain, Machine
from compgen.data.names import CURVE_NAMES, SQUARENESS_NAMES, error_named
from compgen.fitting import FitOptions, fit, zero_ends
from compgen.fitting.bounds import Bounds, constraint_rows
from compgen.fitting.curve_fit import CurveProblem, prepare, smoothness, solve, solve_curves
from compgen.fitting.smoother import Smoother, second_difference
from compgen.kinematics import modelled_errors

OURS, OSQP, CVXPY = "compgen", "OSQP cold", "cvxpy+Clarabel"
FROM_ARRAYS = "compgen with its smoothers"
WHOLE = "compgen.fit, whole call"
#: More nodes than this no identification gives; the peers need minutes for them.
MOST_CORRELATED = 101
CURVES = 18
#: Bounds so wide that no curve touches them.
WIDE = 1.5


@dataclass(frozen=True)
class Case:
    """One curve with independent nodes, zero at the ``fixed`` nodes and within ``bounds``."""

    position_mm: FloatArray
    y: FloatArray
    weight: FloatArray
    fixed: tuple[int, ...]
    mu: float
    bounds: Bounds = Bounds()

    def problem(self) -> CurveProblem:
        """Build its smoother, as ``fit`` does before it chooses the smoothness."""
        smoother = Smoother.build(self.position_mm, self.weight, tuple(((node, 1.0),) for node in self.fixed))
        return CurveProblem(smoother, self.mu, self.position_mm, self.y, self.bounds)


def curves(n: int, *, active: bool, seed: int = 0) -> list[Case]:
    """18 curves like those of a machine: every third held at one node inside, the others at both ends."""
    rng = np.random.default_rng(seed)
    return [_curve(rng, n, k, active=active) for k in range(CURVES)]


def _curve(rng: np.random.Generator, n: int, k: int, *, active: bool) -> Case:
    position = np.cumsum(rng.uniform(4, 12, n))
    t = (position - position[0]) / np.ptp(position)
    y = 20 * np.sin(2 * np.pi * t + 0.1 * k) + 8 * np.sin(6 * np.pi * t + 0.3) + rng.normal(size=n) * 0.3
    fixed = (0, n - 1) if k % 3 else (n // 3,)
    y = y - (y[0] + (y[-1] - y[0]) * t if k % 3 else y[n // 3])
    y[list(fixed)] = 0.0
    mu = 10 ** rng.uniform(-1, 3)
    problem = Case(position, y, rng.uniform(0.5, 2, n), fixed, mu)
    free = solve_curves([problem.problem()])[0].curve
    largest, steepest = float(np.abs(free).max()), float(np.abs(np.diff(free) / np.diff(position)).max())
    share = (0.8, 0.6) if active else (WIDE, WIDE)
    return Case(position, y, problem.weight, fixed, mu, Bounds(share[0] * largest, share[1] * steepest))


#: P, q, A, limit of one curve.
Program = tuple[sp.csc_matrix, FloatArray, sp.csc_matrix, FloatArray]


def program(problem: Case) -> Program:
    """P, q, A, limit of min x^T P x / 2 + q^T x, |A x| <= limit, zeros eliminated; x are the free nodes."""
    n = len(problem.y)
    free = np.setdiff1d(np.arange(n), problem.fixed)
    rows = second_difference(problem.position_mm)
    bend = sp.diags_array([rows[:, 0], rows[:, 1], rows[:, 2]], offsets=[0, 1, 2], shape=(n - 2, n)).tocsc()[:, free]
    quadratic = sp.diags_array(problem.weight[free]) + problem.mu * (bend.T @ bend)
    step = np.diff(problem.position_mm)
    slope = sp.diags_array([-1 / step, 1 / step], offsets=[0, 1], shape=(n - 1, n)).tocsc()[:, free]
    limit = np.repeat([problem.bounds.max_abs, problem.bounds.max_slope], [len(free), n - 1])
    matrix = sp.csc_matrix(sp.vstack([sp.eye_array(len(free)), slope]))
    return sp.csc_matrix(quadratic), -problem.weight[free] * problem.y[free], matrix, limit


def _whole(problem: Case, x: FloatArray) -> FloatArray:
    curve = np.zeros(len(problem.y))
    curve[np.setdiff1d(np.arange(len(curve)), problem.fixed)] = x
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


def referee(programs: Sequence[Program]) -> list[FloatArray]:
    """Clarabel directly, unknowns scaled to 1 on the diagonal, as tight as it goes: the referee; returns the free nodes."""
    found = []
    for quadratic, linear, matrix, limit in programs:
        scale = 1 / np.sqrt(quadratic.diagonal())
        stretch = sp.diags_array(scale)
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-13
        rows = sp.csc_matrix(sp.vstack([matrix, -matrix]) / np.tile(limit, 2)[:, None] @ stretch)
        cone = [clarabel.NonnegativeConeT(2 * len(limit))]
        inner = sp.triu(sp.csc_matrix(stretch @ quadratic @ stretch), format="csc")
        solver = clarabel.DefaultSolver(inner, scale * linear, rows, np.ones(2 * len(limit)), cone, settings)
        found.append(scale * np.array(solver.solve().x))
    return found


def deviation(found: Sequence[FloatArray], expected: Sequence[FloatArray]) -> float:
    """Largest difference between two sets of curves."""
    return max(float(np.abs(one - other).max()) for one, other in zip(found, expected, strict=True))


def compare(n: int, runs: int, clock: timing.Clock, *, active: bool, slow: bool) -> None:
    """Time one case and print it; ``slow``: with the peers that need seconds here."""
    problems = curves(n, active=active)
    programs = [program(problem) for problem in problems]
    ready = [problem.problem() for problem in problems]
    functions: dict[str, Callable[[], list[FloatArray]]] = {
        OURS: lambda: ours(ready),
        FROM_ARRAYS: lambda: ours([problem.problem() for problem in problems]),
    }
    if slow or not active:
        functions[OSQP] = lambda: with_osqp(programs)
    if slow or n <= 301:
        functions[CVXPY] = lambda: with_cvxpy(programs)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        comparison = timing.alternate(functions, runs, clock)
        title = f"{CURVES} curves of {n} nodes, {'active bounds' if active else 'no bound active'}"
        timing.print_comparison(title, comparison, references=(OURS,))
        expected = [_whole(problem, x) for problem, x in zip(problems, referee(programs), strict=True)]
        far = {OURS: f"{deviation(ours(ready), expected):.1e}"}
        for name in [name for name in functions if name in (OSQP, CVXPY)]:
            whole = [_whole(problem, x) for problem, x in zip(problems, functions[name](), strict=True)]
            far[name] = f"{deviation(whole, expected):.1e}"
    touched = sum(bool(solution.touched.any()) for solution in solve_curves(ready))
    print(f"  curves at a bound: {touched}; deviation from the referee, um: {far}")


class Correlated:
    """14 curves of n nodes each whose errors are correlated along the axis, as ``run`` fits them."""

    def __init__(self, n: int, *, active: bool, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        travels = (800.0, 1000.0, 350.0)
        axes = tuple(Axis((-travel, 0.0), np.linspace(-travel, 0.0, n)) for travel in travels)
        self.machine = Machine("gantry", Chain("WFYXZT"), axes)
        t = np.linspace(0, 1, n)
        distance = np.abs(t[:, None] - t)
        covariance = 0.09 * np.exp(-distance / 0.2) + 0.02 * np.eye(n)
        root = np.linalg.cholesky(covariance)
        curves, self.covariance = {}, {}
        for k, name in enumerate(name for name in modelled_errors(self.machine) if name in CURVE_NAMES):
            error = error_named(name)
            unit = error.si_per_unit
            y = 20 * np.sin(2 * np.pi * t + 0.1 * k) + 8 * np.sin(6 * np.pi * t + 0.3) + root @ rng.normal(size=n)
            curves[name] = Curve(axes[error.axis].nodes_mm, unit * y, unit * np.sqrt(np.diag(covariance)))
            self.covariance[name] = unit**2 * covariance
        self.errors = ErrorTable(curves, {name: (0.0, 0.0) for name in SQUARENESS_NAMES})
        self.options = FitOptions()
        self.options = self._bounds((0.8, 0.6) if active else (WIDE, WIDE))
        zeroed = zero_ends(self.machine, self.errors, self.covariance).curves
        self.prepared = [prepare(name, fixed, self.options) for name, fixed in zeroed.items()]
        self.mu = [smoothness(item, self.options).mu for item in self.prepared]

    def _bounds(self, share: tuple[float, float]) -> FitOptions:
        free = self.whole()
        return FitOptions(
            max_abs={name: share[0] * np.abs(c.value).max() for name, c in free.items()},
            max_slope={
                name: share[1] * np.abs(np.diff(c.value) / np.diff(c.position_mm)).max() for name, c in free.items()
            },
        )

    def whole(self) -> dict[str, Curve]:
        """Fit as ``run`` does; every curve by its name."""
        found = fit(self.machine, self.errors, self.options, covariance=self.covariance)
        return dict(found.errors.curves)

    def at_smoothness(self) -> list[FloatArray]:
        """Solve at the smoothness that was found; um and urad."""
        return [solution.curve for solution in solve(self.prepared, self.mu)]

    def programs(self) -> list[Program]:
        """The same for the peers."""
        found = []
        for item, mu in zip(self.prepared, self.mu, strict=True):
            nodes = item.smoother.nodes
            rows = constraint_rows(item.fixed.position_mm, item.smoother, *item.bounds.limits, item.bounds.direction)
            used = np.flatnonzero(np.isfinite(rows.upper))
            quadratic = sp.csc_matrix(item.smoother.matrix(mu)[nodes][:, nodes])
            linear = -item.smoother.load(item.y[:, None])[nodes, 0]
            found.append((quadratic, linear, sp.csc_matrix(rows.matrix[used][:, nodes]), rows.upper[used]))
        return found


def compare_correlated(n: int, runs: int, clock: timing.Clock, *, active: bool) -> None:
    """Time the fit with covariance and print it."""
    case = Correlated(n, active=active)
    programs = case.programs()
    functions: dict[str, Callable[[], object]] = {
        WHOLE: case.whole,
        OURS: case.at_smoothness,
        OSQP: lambda: with_osqp(programs),
        CVXPY: lambda: with_cvxpy(programs),
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        comparison = timing.alternate(functions, runs, clock)
        title = (
            f"{len(programs)} curves of {n} nodes with covariance, {'active bounds' if active else 'no bound active'}"
        )
        timing.print_comparison(title, comparison, references=(WHOLE, OURS))
        expected = referee(programs)
        smoothers = [item.smoother for item in case.prepared]
        ours_free = [curve[s.nodes] for curve, s in zip(case.at_smoothness(), smoothers, strict=True)]
        far = {
            OURS: f"{deviation(ours_free, expected):.1e}",
            OSQP: f"{deviation(with_osqp(programs), expected):.1e}",
            CVXPY: f"{deviation(with_cvxpy(programs), expected):.1e}",
        }
    solvers = sorted({solution.solver for solution in solve(case.prepared, case.mu)})
    print(f"  solved by {', '.join(solvers)}; deviation from the referee, um: {far}")


def main() -> None:
    """Run all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5, help="rounds, at least 5")
    parser.add_argument("--nodes", type=int, nargs="*", default=[11, 51, 101, 301, 1001], help="nodes per curve")
    parser.add_argument("--slow", action="store_true", help="also the peers that need many seconds for a case")
    parser.add_argument("--cpu", action="store_true", help="processor time instead of time: for a busy computer")
    arguments = parser.parse_args()
    clock = time.process_time if arguments.cpu else time.perf_counter
    print(timing.machine_line(("numpy", "scipy", "osqp", "clarabel", "cvxpy")))
    for active in (False, True):
        for n in [nodes for nodes in arguments.nodes if nodes <= MOST_CORRELATED]:
            compare_correlated(n, arguments.runs, clock, active=active)
    for active in (False, True):
        for n in arguments.nodes:
            compare(n, arguments.runs, clock, active=active, slow=arguments.slow or n <= 101)


if __name__ == "__main__":
    main()
