"""The fit: identified errors in, smooth errors within bounds out; robust weights and user constraints."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import of_kind
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import error_named
from compgen.errors import ConvergenceError, InputError, Message
from compgen.fitting.bounds import (
    ACTIVE_SET,
    ROUNDING,
    Bounds,
    CurveReport,
    CurveSolution,
    FitOptions,
    FitResult,
    active_bounds,
    constraint_rows,
    curvature_at,
    solve_curve,
)
from compgen.fitting.interior import Banded, BandedRows, bounded_curves, windows
from compgen.fitting.smoother import (
    REFINEMENTS,
    SETTLED,
    CorrelatedSmoother,
    Method,
    Smoother,
    choose,
    curve_covariances,
    propagated,
)
from compgen.fitting.zeroing import FixedCurve, zero_ends
from compgen.identification.covariance import Covariance
from compgen.kinematics.kernel_switch import lapack, one_thread

# Many curves in one banded system: their nodes are concatenated, and nothing couples one curve with the next.
#
# A = W + mu D2^T D2 of a curve with independent nodes that is fixed at nodes has half-bandwidth 2. Concatenated, such
# curves are one :class:`compgen.fitting.smoother.Smoother` whose second differences across two curves are zero. One
# factorisation serves all, whatever their nodes, weights and mu; each curve is refined separately and does not depend
# on the others. Curves that meet their bounds are finished; the others are solved by
# :func:`compgen.fitting.bounds.solve_curve`.

#: Half-bandwidth of A, plus one.
_DIAGONALS = 3
#: Appended to the second differences of a curve of n nodes: it has n - 2 of them, or none.
_NO_ROWS: FloatArray = np.zeros((2, 3))
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]


class CurveProblem(NamedTuple):
    """Data ``y`` (n,) at ``position_mm`` (n,), to be smoothed with weight ``mu`` within ``bounds`` in the unit of ``y``."""

    smoother: Smoother
    mu: float
    position_mm: FloatArray
    y: FloatArray
    bounds: Bounds = Bounds()


def solve_curves(problems: Sequence[CurveProblem]) -> list[CurveSolution]:
    """Minimise the cost of every curve within its bounds.

    Curves with independent nodes that are fixed at nodes are solved together first.

    Raises
    ------
    ConvergenceError
        when no solver's result for a curve that violates a bound passes the optimality conditions.
    """
    # curves with independent nodes (no subclass) whose fixed functionals are values at nodes
    chosen = [
        k
        for k, problem in enumerate(problems)
        if type(problem.smoother) is Smoother and all([other is None for _, other, _ in problem.smoother.steps])
    ]
    found: dict[int, CurveSolution] = {}
    if chosen:
        together = [problems[k] for k in chosen]
        stack = Stack.build(together)
        c = stack.solve(np.concatenate([problem.y for problem in together]))
        if c is not None:
            curves = np.split(c, stack.starts[1:])
            broken = _breaks(stack, together, c)
            found = {k: CurveSolution(own) for k, own, over in zip(chosen, curves, broken, strict=True) if not over}
            bounded = np.flatnonzero(broken)
            solved = _bounded([together[k] for k in bounded], [curves[k] for k in bounded])
            found |= {chosen[k]: own for k, own in zip(bounded, solved, strict=True) if own is not None}
    return [found[k] if k in found else solve_curve(*problem) for k, problem in enumerate(problems)]


def _bounded(problems: Sequence[CurveProblem], free: Sequence[FloatArray]) -> list[CurveSolution | None]:
    """Solve curves whose ``free`` optimum violates a bound together; None where the conditions were not met.

    Each in the unit of its largest data: solvers work best with numbers near 1.
    """
    if not problems:
        return []
    unit = [max(float(np.abs(problem.y).max()), float(np.finfo(float).tiny)) for problem in problems]
    stack = Stack.build(problems)
    inside = np.ones(len(stack.mu))
    inside[stack.fixed] = 0.0
    bend = np.zeros((3, len(inside)))
    bend[:, :-2] = stack.laid.rows.T
    bend *= windows(inside) * np.sqrt(stack.mu)
    weight = inside * stack.laid.weight
    y = np.concatenate([problem.y / size for problem, size in zip(problems, unit, strict=True)])
    system = Banded(stack.starts, stack.sizes, weight, inside, bend, weight * y)
    bounds = [problem.bounds.in_unit(size) for problem, size in zip(problems, unit, strict=True)]
    rows = BandedRows.of(system, np.concatenate([problem.position_mm for problem in problems]), bounds)
    start = np.concatenate([own / size for own, size in zip(free, unit, strict=True)])
    c, active, solved = bounded_curves(system, rows, start)
    result: list[CurveSolution | None] = []
    for k, (begin, n, size) in enumerate(zip(stack.starts.tolist(), stack.sizes.tolist(), unit, strict=True)):
        own = c[begin : begin + n]
        touched = np.zeros((3, n))
        touched[list(rows.kinds)] = active[:, begin : begin + n]
        flat = np.concatenate([touched[0], touched[1, : n - 1], touched[2, : max(n - 2, 0)]])
        curve = np.where(np.abs(own) > ROUNDING, own * size, 0.0)
        result.append(CurveSolution(curve, flat, ACTIVE_SET) if solved[k] else None)
    return result


@dataclass(frozen=True)
class Stack:
    """k curves with N nodes in all.

    ``starts`` and ``sizes`` (k,): location of the curves; ``laid``: one smoother of N nodes without eliminations;
    ``fixed``: the nodes at zero; ``mu`` (N,).
    """

    starts: IntArray
    sizes: IntArray
    laid: Smoother
    fixed: IntArray
    mu: FloatArray

    @classmethod
    def build(cls, problems: Sequence[CurveProblem]) -> Stack:
        """Concatenate the curves."""
        smoothers = [problem.smoother for problem in problems]
        sizes = np.array([len(smoother.weight) for smoother in smoothers])
        starts = np.cumsum(sizes) - sizes
        rows: list[FloatArray] = []
        fixed: list[int] = []
        for start, smoother in zip(starts.tolist(), smoothers, strict=True):
            rows += (smoother.rows, _NO_ROWS[: len(smoother.weight) - len(smoother.rows)])
            fixed += [start + node for node, _, _ in smoother.steps]
        laid = Smoother(
            weight=np.concatenate([smoother.weight for smoother in smoothers]),
            rows=np.asfortranarray(np.concatenate(rows)[:-2]),  # read by columns
            steps=(),
            free_weight=np.concatenate([smoother.free_weight for smoother in smoothers]),
            penalty=np.concatenate([smoother.penalty[:_DIAGONALS] for smoother in smoothers], axis=1),
        )
        mu = np.array([problem.mu for problem in problems]).repeat(sizes)
        return cls(starts, sizes, laid, np.array(fixed, dtype=np.intp), mu)

    def largest(self, values: FloatArray) -> FloatArray:
        """Largest magnitude of node values (N,) in each curve (k,)."""
        return np.asarray(np.maximum.reduceat(np.abs(values), self.starts))

    def solve(self, y: FloatArray) -> FloatArray | None:
        """Fitted curves (N,) for data (N,) without bounds; None if A is not positive definite.

        Refined against the product form of A as in :meth:`compgen.fitting.smoother.Smoother.inverse`, curve by curve.
        """
        band = self.mu * self.laid.penalty
        band[0] += self.laid.free_weight
        load = self._free(self.laid.load(y[:, None]))
        factor, x, info = lapack().dpbsv(band, load, lower=1)
        if info:
            return None
        rough, solved = np.ones(len(self.sizes), dtype=bool), lapack().dpbtrs
        weight, mu = self.laid.weight[:, None], self.mu[:, None]
        for _ in range(REFINEMENTS):
            # A x without forming the product of the second differences
            applied = self._free(weight * x + mu * self.laid.bend_transposed(self.laid.bend(x)))
            step = solved(factor, load - applied, lower=1)[0]
            x = x + (step if rough.all() else step * rough.repeat(self.sizes)[:, None])
            rough &= ~(self.largest(step[:, 0]) <= SETTLED * self.largest(x[:, 0]))
            if not rough.any():
                break
        return np.ascontiguousarray(self._free(x)[:, 0])

    def _free(self, values: FloatArray) -> FloatArray:
        """Put zeros at the fixed nodes of (N, 1)."""
        values[self.fixed] = 0.0
        return values


def _breaks(stack: Stack, problems: Sequence[CurveProblem], c: FloatArray) -> BoolArray:
    """Which curves (k,) of a stack (N,) violate a bound, as :meth:`compgen.fitting.bounds.Bounds.kept_by` does for one."""
    bounds = [problem.bounds for problem in problems]
    wrong: BoolArray = stack.largest(c) > [bound.max_abs for bound in bounds]
    steepest, bent = [bound.max_slope for bound in bounds], [bound.max_curvature for bound in bounds]
    direction = [bound.direction for bound in bounds]
    sloped, curved = any(direction) or min(steepest) < math.inf, min(bent) < math.inf
    if not (sloped or curved):
        return wrong
    position = np.concatenate([problem.position_mm for problem in problems])
    step = position[1:] - position[:-1]
    step[stack.starts[1:] - 1] = math.inf  # no slope from one curve to the next
    if sloped:
        slope = np.zeros(len(c))
        slope[:-1] = (c[1:] - c[:-1]) / step
        wrong |= stack.largest(slope) > steepest
        if any(direction):
            wrong |= stack.largest(np.maximum(-slope * np.array(direction).repeat(stack.sizes), 0.0)) > 0
    if curved:
        bend = np.zeros(len(c))
        bend[:-2] = (curvature_at(step) * np.stack([c[:-2], c[1:-1], c[2:]], axis=1)).sum(axis=1)
        wrong |= stack.largest(bend) > bent
    return wrong


# One curve from preparation to report, in um or urad: weights, smoothness, uncertainty; curves are solved together.


#: Lower limits of an uncertainty: this fraction of the curve's median one, and this value (um, urad), for exact data.
_LEAST_FRACTION, _LEAST = 1e-3, 1e-6
#: With fewer residual degrees of freedom than this, the residuals say nothing about the noise.
_LEAST_LEFT = 0.5


@dataclass(frozen=True)
class Prepared:
    """One curve ready to be fitted, everything in um or urad (``unit`` in mm or rad).

    ``y`` (n,) is the zeroed input, ``u0`` the scale of its uncertainty (None: unknown), ``smoother`` contains weights
    and zeros, ``trust`` (n,) is the fraction of each node's weight that a robust loss leaves, ``covariance`` (n, n) the
    covariance of the input if it is used.
    """

    name: str
    fixed: FixedCurve
    unit: float
    y: FloatArray
    u0: float | None
    smoother: Smoother
    bounds: Bounds
    trust: FloatArray
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class Weighted:
    """Smoothness and the method by which it was found."""

    mu: float
    method: Method


def weights(fixed: FixedCurve, unit: float) -> tuple[FloatArray, float | None]:
    """Dimensionless weights (u0/u)^2, shape (n,), and u0 in um or urad; ones and None if an uncertainty is unknown.

    Nodes that are fixed at zero do not count; u0 is the harmonic root mean square of the others.
    """
    weight = np.ones(len(fixed.value))
    free = np.ones(len(weight), dtype=bool)
    free[[row[0][0] for row in fixed.rows if len(row) == 1]] = False
    u = fixed.u[free] / unit
    if not np.isfinite(u).all() or not u.size:
        return weight, None
    u = np.maximum(u, _least(u))
    u0 = float(1 / np.sqrt(np.mean(1 / u**2)))
    weight[free] = (u0 / u) ** 2
    return weight, u0


def _least(u: FloatArray) -> float:
    positive = u[u > 0]
    return max(_LEAST, _LEAST_FRACTION * float(np.median(positive))) if positive.size else _LEAST


def prepare(name: str, fixed: FixedCurve, options: FitOptions, trust: FloatArray | None = None) -> Prepared:
    """Set up the smoother of one fixed curve; ``trust`` (n,) in (0, 1] divides the variance of each node."""
    unit = error_named(name).si_per_unit
    share = np.ones(len(fixed.value)) if trust is None else trust
    weight, u0 = weights(fixed, unit)
    smoother = Smoother.build(fixed.position_mm, weight * share, fixed.rows)
    covariance = None
    if fixed.covariance is not None and u0 is not None and smoother.unknowns:
        covariance = fixed.covariance / unit**2 / np.sqrt(share[:, None] * share)
        # the smallest variance that counts is added on the diagonal to make the matrix invertible
        least = _least(np.sqrt(np.diag(covariance))) ** 2 * np.eye(len(covariance))
        smoother = CorrelatedSmoother.of(smoother, (fixed.zeroing @ covariance @ fixed.zeroing.T + least) / u0**2)
    bounds = options.bounds(name).in_unit(unit)
    return Prepared(name, fixed, unit, fixed.value / unit, u0, smoother, bounds, share, covariance)


def smoothness(prepared: Prepared, options: FitOptions) -> Weighted:
    """Return the given smoothness, or the one chosen from the data."""
    if options.smoothness is not None:
        return Weighted(min(options.smoothness, prepared.smoother.largest_mu), "given")
    method: Method = "REML" if prepared.u0 is not None else "GCV"
    return Weighted(choose(prepared.smoother, prepared.y, prepared.u0), method)


def solve(prepared: Sequence[Prepared], mu: Sequence[float]) -> list[CurveSolution]:
    """Fit curves with given smoothness within their bounds."""
    return solve_curves(
        [
            CurveProblem(item.smoother, weight, item.fixed.position_mm, item.y, item.bounds)
            for item, weight in zip(prepared, mu, strict=True)
        ]
    )


def finish(prepared: Prepared, weighted: Weighted, solution: CurveSolution) -> tuple[Curve, CurveReport]:
    """Return the fitted curve in mm or rad with its uncertainty, and the report.

    The uncertainty of the input is propagated linearly through the zeroing and the smoother without bounds; it does not
    include the smoothing bias, which the report states.
    """
    smoother, fixed = prepared.smoother, prepared.fixed
    bias = smoother.solve(weighted.mu, solution.curve[:, None])[:, 0] - solution.curve
    if prepared.covariance is not None:
        u = propagated(smoother, weighted.mu, fixed, prepared.covariance) * prepared.unit
    else:
        u = propagate(smoother, weighted.mu, fixed, prepared.trust)
    curve = Curve(fixed.position_mm, solution.curve * prepared.unit + 0.0, u)
    residual, left = prepared.y - solution.curve, smoother.residual_degrees(weighted.mu)
    noise2 = smoother.misfit(residual) / left if left >= _LEAST_LEFT else math.nan
    report = CurveReport(
        error=prepared.name,
        unit=error_named(prepared.name).unit,
        smoothness=weighted.mu,
        method=weighted.method,
        half_gain_mm=half_gain_mm(weighted.mu, fixed.position_mm),
        degrees_of_freedom=smoother.degrees_of_freedom(weighted.mu),
        free_nodes=smoother.unknowns,
        rms_residual=float(np.sqrt(np.mean(residual**2))),
        reduced_chi_square=noise2 / prepared.u0**2 if prepared.u0 is not None else math.nan,
        noise=math.sqrt(noise2),
        smoothing_bias_max=float(np.abs(bias).max()),
        smoothing_bias_rms=float(np.sqrt(np.mean(bias**2))),
        smoothing_bias=bias,
        active_bounds=active_bounds(fixed.position_mm, solution.touched, prepared.bounds),
        solver=solution.solver,
        correlated=prepared.covariance is not None,
        distrusted_mm=tuple(float(fixed.position_mm[k]) for k in np.flatnonzero(prepared.trust < 1)),
    )
    return curve, report


def propagate(smoother: Smoother, mu: float, fixed: FixedCurve, trust: FloatArray) -> FloatArray:
    """Standard uncertainty (n,) of the fitted curve in mm or rad: sqrt of the diagonal of (S G) U^2 (S G)^T.

    G removes the line or constant that zeroing removed (G = 1 if nothing was removed), U contains the input's u over
    the root of ``trust`` (n,). An unknown u counts only if the fit uses it; the result is then nan.
    """
    if np.isnan(fixed.u).all():
        return np.where(smoother.expand(np.ones((len(fixed.u), 1)))[:, 0] == 0, 0.0, np.nan)
    smooth_shapes = smoother.solve(mu, fixed.shapes * fixed.moved)
    functional, variance = fixed.functional, fixed.u**2 / trust
    total = np.zeros(len(fixed.value))
    for picked, columns in smoother.columns(mu):
        gain = columns - smooth_shapes @ functional[:, picked]
        total += np.where(gain != 0, gain**2 * variance[picked], 0.0).sum(axis=1)
    return np.asarray(np.sqrt(total))


def half_gain_mm(mu: float, position_mm: FloatArray) -> float:
    """Wavelength L with 1/(1 + mu (2 sin(pi h/L))^4) = 1/2 at the mean spacing h; 0 if no wave is halved.

    >>> round(half_gain_mm(1.0, np.array([0.0, 10.0, 20.0])), 6)  # six nodes
    60.0
    """
    mean = float(np.mean(np.diff(position_mm)))
    return math.pi * mean / math.asin(0.5 * mu**-0.25) if mu > 1 / 16 else 0.0


# Huber's loss: nodes far from the curve pull with a constant force instead of a growing one (Huber 1964).
#
# Solved by reweighting: the weight of a node at distance r from the curve is multiplied by min(1, k u/r), k = 1.345,
# until nothing changes; the curve then minimises Huber's loss plus the smoothness term. Bounds are not included (they
# would make good data look like outliers): the fit within bounds uses the final weights. With correlated nodes the
# variance of a distrusted node and its covariances are inflated alike. The start compares each node with the median of
# five nodes around it, because a curve chosen from the data might follow an outlier and hide it.


#: Huber's constant: 95 % efficient for normal noise.
HUBER = 1.345
_SEARCHES, _ROUNDS, _SETTLED = 6, 400, 1e-8
_MAD = 1.4826
_NEIGHBOURS = 5
_LEAST_TRUST = 1e-9


def robust(curves: Mapping[str, FixedCurve], options: FitOptions) -> tuple[list[Prepared], list[Weighted]]:
    """Prepare every curve with the weights of Huber's loss and choose its smoothness.

    The smoothness follows the weights for the first rounds and is then kept.
    """
    prepared = [prepare(name, fixed, options) for name, fixed in curves.items()]
    scales = [_scale(item, item.y - running_median(item.y)) for item in prepared]
    trusts = [trust_of(item.y - running_median(item.y), scale) for item, scale in zip(prepared, scales, strict=True)]
    weighted: list[Weighted] = []
    for count in range(_ROUNDS):
        if count < _SEARCHES:
            # each node's variance is so large that it is within Huber's distance: the search sees no outliers
            weighted = [
                smoothness(prepare(item.name, item.fixed, options, trust**2), options)
                for item, trust in zip(prepared, trusts, strict=True)
            ]
        prepared = [
            prepare(item.name, item.fixed, options, trust) for item, trust in zip(prepared, trusts, strict=True)
        ]
        found = solve([replace(item, bounds=Bounds()) for item in prepared], [item.mu for item in weighted])
        residuals = [item.y - solution.curve for item, solution in zip(prepared, found, strict=True)]
        if count < _SEARCHES:
            scales = [_scale(item, residual) for item, residual in zip(prepared, residuals, strict=True)]
        fresh = [trust_of(residual, scale) for residual, scale in zip(residuals, scales, strict=True)]
        change = max(float(np.abs(new - old).max()) for new, old in zip(fresh, trusts, strict=True))
        if count >= _SEARCHES and change <= _SETTLED:
            return prepared, weighted
        trusts = fresh
    raise ConvergenceError(
        Message(
            "fit-robust-not-converged",
            "the robust fit did not converge in {value} rounds; fit without it or give a smoothness",
            value=_ROUNDS,
        )
    )


def running_median(y: FloatArray) -> FloatArray:
    """Median (n,) of each node and its two neighbours on either side, fewer at the ends."""
    reach = _NEIGHBOURS // 2
    return np.array([np.median(y[max(0, k - reach) : k + reach + 1]) for k in range(len(y))])


def trust_of(residual: FloatArray, scale: FloatArray) -> FloatArray:
    """Huber's weights (n,) in (0, 1] for residuals and standard uncertainties (n,)."""
    far = np.abs(residual) / (HUBER * scale)
    return np.maximum(1 / np.maximum(far, 1.0), _LEAST_TRUST)


def _scale(prepared: Prepared, residual: FloatArray) -> FloatArray:
    """Standard uncertainty (n,) of each node: as given, or a common one from the residuals."""
    if prepared.u0 is not None:
        return prepared.u0 / np.sqrt(prepared.smoother.weight / prepared.trust)
    some = residual[residual != 0]
    spread = _MAD * float(np.median(np.abs(some))) if some.size else 0.0
    return np.full(len(residual), max(spread, 1e-9 * float(np.abs(prepared.y).max(initial=0.0)), 1e-12))


# User constraints: the whole problem, all curves together, in cvxpy.
#
# The sum of the curves' costs is a quadratic form (a sum of squares of differences would slow down every solver);
# zeros, bounds and the user's constraints are added unchanged. If no curves satisfy these, the elastic problem
# (smallest sum of violations, zeros and bounds kept) shows which user constraints to relax, and by how much.


#: Receives cvxpy variables by error name, returns cvxpy constraints, as a list or by name.
OwnConstraints = Callable[[Mapping[str, Any]], Iterable[Any] | Mapping[str, Any]]
#: Tolerance of the user's constraints, in um or urad.
TOLERANCE = 1e-6
_TIGHT = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
_STATES = ("optimal", "optimal_inaccurate")


def solve_constrained(
    prepared: Sequence[Prepared], mu: Sequence[float], constraints: OwnConstraints
) -> list[CurveSolution]:
    """Fit all curves with given smoothness within their bounds and the user's constraints.

    Raises
    ------
    InputError
        if what the callable returns is not a set of cvxpy constraints, or cannot be satisfied.
    ConvergenceError
        if the solver fails.
    """
    import scipy.sparse as sp  # imported here, like cvxpy: slow to load, and few fits have user constraints

    cp: Any = import_module("cvxpy")
    inner = {item.name: cp.Variable(len(item.y), name=item.name) for item in prepared}
    shown = {item.name: cp.Variable(len(item.y), name=item.name) for item in prepared}
    own = _named(cp, constraints(shown))
    rules = [rule for item in prepared for rule in _rules(item, inner[item.name], shown[item.name])]
    cost = 0.0
    for item, weight in zip(prepared, mu, strict=True):
        # c^T A c / 2 - c^T W y in units of the weight of its data, to give all curves equal weight
        x, matrix = inner[item.name], item.smoother.matrix(weight)
        form = 0.5 * cp.quad_form(x, cp.psd_wrap(sp.csc_array(0.5 * (matrix + matrix.T))))
        cost = cost + (form - item.smoother.load(item.y[:, None])[:, 0] @ x) / (
            item.u0**2 if item.u0 is not None else 1.0
        )
    problem = cp.Problem(cp.Minimize(cost), [*rules, *own.values()])
    _solve(cp, problem)
    if problem.status in ("infeasible", "infeasible_inaccurate"):
        raise InputError(_relaxation(cp, rules, own), field="constraints")
    if problem.status not in _STATES:
        raise ConvergenceError(
            Message(
                "constraints-solver-status",
                "the fit with your constraints ended with {status}; scale or loosen them",
                status=problem.status,
            )
        )
    for name, rule in own.items():
        broken = float(np.max(rule.violation(), initial=0.0))
        if not broken <= TOLERANCE:
            raise ConvergenceError(
                Message(
                    "constraint-violated",
                    "{name} is violated by {broken:.3g} in the solver's result; scale or loosen it",
                    name=name,
                    broken=broken,
                )
            )
    found = []
    for item in prepared:
        curve = item.smoother.expand(np.asarray(inner[item.name].value)[:, None])[:, 0]
        rows = constraint_rows(item.fixed.position_mm, item.smoother, *item.bounds.limits, item.bounds.direction)
        values = np.asarray(rows.matrix @ curve)
        near = np.where(values >= rows.upper - TOLERANCE, 1.0, np.where(values <= rows.lower + TOLERANCE, -1.0, 0.0))
        found.append(CurveSolution(curve, near, "cvxpy"))
    return found


def _rules(item: Prepared, x: Any, shown: Any) -> list[Any]:
    """Zeros and bounds: ``x`` contains the smoother's unknowns (eliminated ones zero), ``shown`` the node values."""
    from scipy.sparse import csr_array

    turn = csr_array(item.smoother.expand(np.eye(len(item.y))))
    rows = constraint_rows(item.fixed.position_mm, item.smoother, *item.bounds.limits, item.bounds.direction)
    high, low = np.flatnonzero(np.isfinite(rows.upper)), np.flatnonzero(np.isfinite(rows.lower))
    rules = [shown == turn @ x]
    gone = [node for node, _, _ in item.smoother.steps]
    if gone:
        rules.append(x[gone] == 0)
    if len(high):
        rules.append(rows.matrix[high] @ x <= rows.upper[high])
    if len(low):
        rules.append(rows.matrix[low] @ x >= rows.lower[low])
    return rules


def _named(cp: Any, given: Any) -> dict[str, Any]:
    """The user's constraints by name; those in a list are named by their position and text."""
    if isinstance(given, Mapping):
        own = {str(name): rule for name, rule in given.items()}
    elif isinstance(given, Iterable):
        own = {f"constraint {k} ({str(rule)[:80]})": rule for k, rule in enumerate(given, 1)}
    else:
        raise InputError(
            Message(
                "constraints-no-list",
                "the callable returned {kind}; return a list of cvxpy constraints",
                kind=type(given).__name__,
            )
        )
    for name, rule in own.items():
        if not isinstance(rule, cp.constraints.constraint.Constraint):
            raise InputError(
                Message(
                    "constraint-not-cvxpy",
                    "{name} is a {kind}; return cvxpy constraints",
                    name=name,
                    kind=type(rule).__name__,
                ),
                field="constraints",
            )
        if not rule.is_dcp():
            raise InputError(
                Message("constraint-not-convex", "{name} is not convex; write it as a convex one", name=name),
                field="constraints",
            )
    return own


def _solve(cp: Any, problem: Any) -> None:
    """Solve with tight tolerances, with looser ones if that fails."""
    for settings in (_TIGHT, {}):
        try:
            with warnings.catch_warnings():  # inaccurate results are checked against the constraints
                warnings.simplefilter("ignore")
                problem.solve(solver="CLARABEL", **settings)
        except cp.error.SolverError:
            continue
        if problem.status != "user_limit":
            return
    if problem.status is None:
        raise ConvergenceError(
            Message("constraints-no-solver", "no solver could handle your constraints; scale or loosen them")
        )


def _relaxation(cp: Any, rules: Sequence[Any], own: Mapping[str, Any]) -> str:
    """Name the constraints to relax and by how much: smallest sum of violations, zeros and bounds kept."""
    slack, elastic = {}, []
    for name, rule in own.items():
        if isinstance(rule, cp.constraints.Inequality):
            slack[name] = cp.Variable(rule.expr.shape, nonneg=True)
            elastic.append(rule.expr <= slack[name])
        elif isinstance(rule, cp.constraints.Equality | cp.constraints.Zero):
            slack[name] = cp.Variable(rule.expr.shape, nonneg=True)
            elastic.append(cp.abs(rule.expr) <= slack[name])
        else:
            elastic.append(rule)
    beginning = "no curves satisfy zeros, bounds and your constraints together; "
    if not slack:
        return beginning + "none of them can be relaxed by an amount; remove one"
    problem = cp.Problem(cp.Minimize(sum(cp.sum(amount) for amount in slack.values())), [*rules, *elastic])
    _solve(cp, problem)
    if problem.status not in _STATES:
        return beginning + f"those that can be relaxed by an amount ({', '.join(slack)}) do not help; remove one"
    amounts = {name: np.atleast_1d(np.asarray(amount.value)) for name, amount in slack.items()}
    named = []
    for name, amount in amounts.items():
        over = amount[amount > TOLERANCE]
        if over.size:
            entries = "" if amount.size == 1 else f" (largest of {over.size} of its {amount.size} entries)"
            named.append(f"{name} relaxed by {math.ceil(over.max() * 1e6) / 1e6:.6g}{entries}")
    return beginning + "the least relaxation that helps: " + "; ".join(named)


# The whole fit: identified errors in, smooth and endpoint-zeroed errors out.


_DEFAULT = FitOptions()


def fit(
    machine: Machine,
    errors: ErrorTable,
    options: FitOptions = _DEFAULT,
    *,
    covariance: Covariance | Mapping[str, FloatArray] | None = None,
    constraints: OwnConstraints | None = None,
) -> FitResult:
    """Smooth every curve of a table, with zeros at its fixed points, within bounds if given.

    First the curves are zeroed at their fixed points without changing the machine (:func:`compgen.fitting.zero_ends`); each
    fitted curve then minimises ``sum((u0/u)^2 (c - y)^2) + mu |D2 c|^2`` and stays zero there (Zha & Zhang 2024,
    section 5).

    Parameters
    ----------
    machine : its travel, reference point, chain, tool offset and modelled errors are used.
    errors : curves on any nodes, in mm and rad; the result has the same nodes, plus the travel ends if these were
        missing. Uncertainties may be nan (unknown).
    options : smoothness, bounds, robust loss.
    covariance : from an identification (:func:`compgen.identification.joint_covariance`), or the covariance (n, n) of a
        curve's nodes by error name, mm and rad: (y - c)^T V^-1 (y - c) replaces the sum. Curves without one have
        independent nodes with the table's uncertainties.
    constraints : a callable. It receives the node values of every curve as cvxpy variables in um or urad, by error
        name, and returns cvxpy constraints, as a list or by name; they may couple curves. The whole problem is then
        solved by cvxpy, with the smoothness chosen from the data without the constraints.

    Raises
    ------
    InputError
        for values that are not finite, a squareness that is needed but not in the machine's model, a covariance that
        does not match, or constraints that cannot be satisfied: the message names them and the smallest relaxation.
    ConvergenceError
        when the bounded fit does not pass its check.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> fitted = compgen.fit(machine, errors)
    >>> curve = fitted.errors.curves["EYX"]  # a straightness error: zero at both ends
    >>> bool(abs(curve.value[[0, -1]]).max() < 1e-12)
    True
    """
    for name, value, kind in (
        ("machine", machine, Machine),
        ("errors", errors, ErrorTable),
        ("options", options, FitOptions),
    ):
        of_kind(name, value, kind)
    with one_thread():
        return _fit(machine, errors, options, covariance, constraints)


def _fit(
    machine: Machine,
    errors: ErrorTable,
    options: FitOptions,
    covariance: Covariance | Mapping[str, FloatArray] | None,
    constraints: OwnConstraints | None,
) -> FitResult:
    blocks = curve_covariances(errors, covariance) if covariance is not None else {}
    zeroed = zero_ends(machine, _as_independent(machine, errors, blocks), blocks)
    if options.robust and zeroed.curves:
        prepared, weighted = robust(zeroed.curves, options)
    else:
        prepared = [prepare(name, fixed, options) for name, fixed in zeroed.curves.items()]
        weighted = [smoothness(item, options) for item in prepared]
    mu = [item.mu for item in weighted]
    for item, weight in zip(prepared, mu, strict=True):
        # a monotone curve that is zero at two points is zero between them
        if item.bounds.direction and len(item.fixed.rows) > 1:
            free = item.smoother.solve(weight, item.y[:, None])[:, 0]
            backward = item.bounds.excess(item.fixed.position_mm, free)[3]
            unit = error_named(item.name).unit
            raise InputError(
                Message(
                    "monotone-zero-ends",
                    "{name} is zero at both ends of the travel, so a monotone one would be zero "
                    "everywhere; remove the direction of {name2} (least relaxation: its fit has slopes "
                    "of {backward:.4g} {unit}/m against it)",
                    name=item.name,
                    name2=item.name,
                    backward=1000.0 * backward,
                    unit=unit,
                ),
                field="monotone",
            )
    solved = solve(prepared, mu) if constraints is None else solve_constrained(prepared, mu, constraints)
    fitted = {
        item.name: finish(item, how, solution) for item, how, solution in zip(prepared, weighted, solved, strict=True)
    }
    reference = ", ".join(f"{value:g}" for value in machine.reference_point_mm)
    kept = {
        key: text for key, text in errors.metadata.items() if not key.startswith("covariance")
    }  # of unfitted values
    table = ErrorTable(
        curves={name: curve for name, (curve, _) in fitted.items()},
        squareness=zeroed.squareness,
        metadata={**kept, "reference_point_mm": reference},
    )
    return FitResult(table, {name: report for name, (_, report) in fitted.items()}, zeroed.change)


def _as_independent(machine: Machine, errors: ErrorTable, known: Container[str]) -> ErrorTable:
    """Give the points of cubic curves the uncertainty that independent points with the same information would have.

    A cubic curve is given at more positions than it has coefficients, so its points are redundant; taken as independent
    they would overstate the information, and the smoothing would trust them too much. Curves whose covariance is
    ``known`` are not changed.
    """
    if machine.curves != "cubic":
        return errors
    curves = {}
    for name, curve in errors.curves.items():
        if name in known:
            curves[name] = curve
            continue
        surplus = len(curve.position_mm) / len(machine.axes[error_named(name).axis].nodes_mm)
        curves[name] = Curve(curve.position_mm, curve.value, curve.u * max(1.0, surplus) ** 0.5)
    return errors.replace(curves=curves)
