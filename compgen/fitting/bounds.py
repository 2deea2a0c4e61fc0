"""Options and report of the fit, bounds as rows of inequalities, and one curve solved within its bounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import of_kind
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.names import CURVE_NAMES, error_named
from compgen.data.toml_files import option
from compgen.drawing.display import Drawable, Overview, Panel, shortened
from compgen.errors import ConvergenceError, InputError, Message, nearest
from compgen.fitting.smoother import Method, Smoother
from compgen.fitting.zeroing import FrameChange
from compgen.kinematics.kernel_switch import lapack

if TYPE_CHECKING:
    import scipy.sparse as sp

# Result of the fit: the fitted table, a report per curve, and what was moved out of the curves.


@dataclass(frozen=True)
class ActiveBound:
    """A bound that the fitted curve touches, positions in mm.

    ``max_abs`` at one node, ``max_slope`` and ``monotone`` between two, ``max_curvature`` over three.
    """

    bound: str
    from_mm: float
    to_mm: float


@dataclass(frozen=True)
class CurveReport:
    """How one curve was fitted; amounts are in ``unit`` (um or urad).

    Parameters
    ----------
    smoothness : the dimensionless weight used (defined in :class:`compgen.fitting.FitOptions`).
    method : how the weight was found: ``REML`` (uncertainties known), ``GCV`` (unknown) or ``given``.
    half_gain_mm : wavelength that the smoothing halves, on evenly spaced nodes; 0 if none is.
    degrees_of_freedom : effective ones, trace of the smoother without bounds; ``free_nodes`` is their largest number.
    rms_residual : root mean square of data minus fit, over all nodes, after zeroing the data.
    reduced_chi_square : weighted sum of squared residuals over its expectation, trace of (1 - S)^2 (Buckley,
        Eagleson & Silverman 1988, Biometrika 75, 189): near 1 if the uncertainties are right; nan if they are
        unknown or if less than half a degree of freedom is left.
    noise : standard deviation of the data's noise at unit weight, from the same quotient; nan if too little is left.
    smoothing_bias_max, smoothing_bias_rms : how much the smoothing flattens a curve like the fitted one, S c - c.
    smoothing_bias : the same per position, shape (n,).
    active_bounds : where the curve touches a bound.
    solver : ``direct``; ``active set`` when a bound is active (``Clarabel`` or ``OSQP`` if only these find the active
        bounds); ``cvxpy`` with user constraints.
    correlated : whether the covariance of the nodes was used.
    distrusted_mm : nodes to which a robust loss gave less than their full weight.
    """

    error: str
    unit: str
    smoothness: float
    method: Method
    half_gain_mm: float
    degrees_of_freedom: float
    free_nodes: int
    rms_residual: float
    reduced_chi_square: float
    noise: float
    smoothing_bias_max: float
    smoothing_bias_rms: float
    smoothing_bias: FloatArray = field(repr=False, compare=False)
    active_bounds: tuple[ActiveBound, ...] = ()
    solver: str = "direct"
    correlated: bool = False
    distrusted_mm: tuple[float, ...] = ()

    def to_dict(self) -> dict[str, object]:
        """Return plain values for JSON; None for unknown numbers."""
        plain = {**asdict(self), "smoothing_bias": self.smoothing_bias.tolist()}
        return {key: None if isinstance(value, float) and math.isnan(value) else value for key, value in plain.items()}


@dataclass(frozen=True, repr=False)
class FitResult(Drawable):
    """Fitted ``errors`` with their uncertainty, the ``report`` by error name, and the frame ``change``.

    E of the input and E of the zeroed input differ by ``change``; the fit itself then only smooths.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> fitted: compgen.FitResult = compgen.fit(machine, errors)
    >>> fitted
    <FitResult: 14 fitted curves: EXX, EYX, EZX, EAX, EBX, EXY and 8 more>
    >>> fitted.report["EXX"].unit
    'um'
    """

    errors: ErrorTable
    report: Mapping[str, CurveReport]
    change: FrameChange

    def to_dict(self) -> dict[str, object]:
        """Return reports and frame change as plain values for JSON."""
        reports = {name: report.to_dict() for name, report in self.report.items()}
        return {"curves": reports, "frame_change": self.change.to_dict()}

    def overview(self) -> Overview:
        """How each curve was smoothed."""
        rows = tuple(
            (
                name,
                f"{item.smoothness:.2g}",
                item.method,
                f"{item.rms_residual:.3f}",
                f"{item.smoothing_bias_max:.3f}",
                item.unit,
            )
            for name, item in self.report.items()
        )
        header = ("error", "smoothness", "chosen by", "residual rms", "bias max", "unit")
        return Overview(f"{len(self.report)} fitted curves: {shortened(tuple(self.report))}", header, rows)

    def panels(self) -> Sequence[Panel]:
        """The fitted curves."""
        return self.errors.panels()


# Bounds on one curve: magnitude, slope, curvature, monotonicity; as numbers and as rows of linear inequalities.


BoolArray = NDArray[np.bool_]
#: Bounds are met to within this fraction of their value.
KEPT = 1e-9
#: Names of the bounds in the order of their rows: values (over one node), slopes (two), curvatures (three).
BOUND_KINDS = ("max_abs", "max_slope", "max_curvature")
MONOTONE = "monotone"


@dataclass(frozen=True)
class Bounds:
    """Bounds of one curve in its unit (of the curve, per mm, per mm^2); inf and direction 0 mean no bound.

    ``direction`` is +1 for a curve that must not fall, -1 for one that must not rise. The zero curve meets every bound.
    """

    max_abs: float = math.inf
    max_slope: float = math.inf
    max_curvature: float = math.inf
    direction: int = 0

    @property
    def none(self) -> bool:
        """Whether there are no bounds."""
        return math.isinf(self.max_abs) and math.isinf(self.max_slope + self.max_curvature) and not self._some

    @property
    def _some(self) -> bool:
        return self.direction != 0 or math.isfinite(self.max_slope) or math.isfinite(self.max_curvature)

    @property
    def limits(self) -> tuple[float, float, float]:
        """Magnitude, slope, curvature."""
        return self.max_abs, self.max_slope, self.max_curvature

    def in_unit(self, unit: float) -> Bounds:
        """Return the same bounds for a curve in multiples of ``unit``."""
        return Bounds(self.max_abs / unit, self.max_slope / unit, self.max_curvature / unit, self.direction)

    def excess(self, position_mm: FloatArray, curve: FloatArray) -> tuple[float, float, float, float]:
        """Amounts by which a curve (n,) violates magnitude, slope, curvature and direction; 0 if it meets them."""
        slope = np.diff(curve) / np.diff(position_mm)
        bent = 0.0
        if math.isfinite(self.max_curvature):
            windows = np.stack([curve[:-2], curve[1:-1], curve[2:]], axis=1)
            bent = np.abs((curvature(position_mm) * windows).sum(axis=1)).max(initial=0.0)
        found = (np.abs(curve).max(), np.abs(slope).max(initial=0.0), bent)
        over = [max(0.0, float(value - limit)) for value, limit in zip(found, self.limits, strict=True)]
        backward = float(np.max(-self.direction * slope, initial=0.0)) if self.direction else 0.0
        return over[0], over[1], over[2], backward

    def kept_by(self, position_mm: FloatArray, curve: FloatArray) -> bool:
        """Whether a curve (n,) meets its bounds at every node and between nodes."""
        return self.none or not any(self.excess(position_mm, curve))


@dataclass(frozen=True)
class Rows:
    """lower <= dense @ x <= upper for the smoother's unknowns: dense (m, n), limits (m,).

    n values come first, then n - 1 slopes, then n - 2 curvatures, each over its bound; rows without limits are zero.
    ``step`` (n - 1,) are the distances between nodes in mm, ``scale`` the bounds of values, slopes and curvatures.
    """

    dense: FloatArray
    lower: FloatArray
    upper: FloatArray
    step: FloatArray
    scale: tuple[float, float, float]

    def times(self, curves: FloatArray) -> FloatArray:
        """Values (m, k) of the rows for curves (n, k), zero at the fixed nodes."""
        return _bounded_values(self.step, self.scale, curves)

    @cached_property
    def matrix(self) -> sp.csr_array:
        """The rows as a sparse matrix, as the general solvers need them."""
        import scipy.sparse as sp  # imported here and below: slow to load, needed only by general solvers

        return sp.csr_array(self.dense)

    def excess(self, curve: FloatArray) -> FloatArray:
        """Amount (m,) by which a curve is above (positive) or below (negative) its limits, else 0."""
        values = self.times(curve[:, None])[:, 0]
        return np.maximum(values - self.upper, 0.0) + np.minimum(values - self.lower, 0.0)


def curvature(position_mm: FloatArray) -> FloatArray:
    """Coefficients (n - 2, 3) of c'' at the inner nodes: (slope after - slope before) over half the two steps, 1/mm^2."""
    return curvature_at(np.diff(position_mm))


def curvature_at(step: FloatArray) -> FloatArray:
    """Return the same from the steps (n - 1,) between nodes in mm; zero next to an infinite step."""
    before, after = step[:-1], step[1:]
    scale = 2 / (before + after)
    return np.stack([scale / before, -scale / before - scale / after, scale / after], axis=1)


def slope_limits(bounds: Bounds, typical: float) -> tuple[float, float, float]:
    """Scale, lower and upper limit of the slope rows; without a slope bound the scale is ``typical``."""
    bounded = math.isfinite(bounds.max_slope)
    scale, top = (bounds.max_slope, 1.0) if bounded else (typical, math.inf)
    return scale, 0.0 if bounds.direction > 0 else -top, 0.0 if bounds.direction < 0 else top


def constraint_rows(
    position_mm: FloatArray,
    smoother: Smoother,
    largest: float,
    steepest: float,
    most_bent: float = math.inf,
    direction: int = 0,
) -> Rows:
    """Rows of a curve's bounds in the smoother's unknowns."""
    n = len(position_mm)
    bounds = Bounds(largest, steepest, most_bent, direction)
    turn = smoother.expand(np.eye(n))
    step = np.diff(position_mm)
    typical = 1.0 / float(np.ptp(position_mm)) if n > 1 else 1.0
    scale, low, high = slope_limits(bounds, typical)
    if math.isinf(low) and math.isinf(high):
        scale = math.inf
    dense = _bounded_values(step, (largest, scale, most_bent), turn)
    dense[np.abs(dense) < 1e-13 * np.abs(dense).max(initial=0.0)] = 0.0
    count = (n, max(n - 1, 0), max(n - 2, 0))
    lower = np.repeat([-1.0, low, -1.0], count)
    upper = np.repeat([1.0, high, 1.0], count)
    empty = ~dense.any(axis=1)
    lower, upper = np.where(empty, -math.inf, lower), np.where(empty, math.inf, upper)
    return Rows(dense, lower, upper, step, (largest, scale, most_bent))


def _bounded_values(step: FloatArray, scale: tuple[float, float, float], curves: FloatArray) -> FloatArray:
    """Values, slopes and curvatures (3 n - 3, k) of curves (n, k), over their bounds."""
    first, middle, last = (curvature_at(step) / scale[2]).T[:, :, None]
    bends = first * curves[:-2] + middle * curves[1:-1] + last * curves[2:]
    return np.concatenate([curves / scale[0], np.diff(curves, axis=0) / (step[:, None] * scale[1]), bends])


def active_bounds(position_mm: FloatArray, active: FloatArray, bounds: Bounds) -> tuple[ActiveBound, ...]:
    """Name the active rows (-1, 0, 1), shape (3 n - 3,) or less, in the order of :class:`Rows`."""
    n = len(position_mm)
    found = []
    for row in np.flatnonzero(active):
        kind, node = (0, row) if row < n else (1, row - n) if row < 2 * n - 1 else (2, row - 2 * n + 1)
        monotone = kind == 1 and bounds.direction != 0 and active[row] == -bounds.direction
        name = MONOTONE if monotone else BOUND_KINDS[kind]
        found.append(ActiveBound(name, float(position_mm[node]), float(position_mm[node + kind])))
    return tuple(found)


# Options of the fit: smoothness and bounds.


ERROR_KINDS = ("linear", "angular")
DIRECTIONS = {"increasing": 1, "decreasing": -1}
_PER_M = 1e-3  # 1/m in 1/mm


@dataclass(frozen=True)
class FitOptions:
    """Smoothness and bounds of the fit; all optional.

    Parameters
    ----------
    smoothness : dimensionless weight mu of the squared second differences in
        ``sum((u0/u)^2 (c - y)^2) + mu |D2 c|^2``, with ``u0`` the harmonic root mean square of the uncertainties u
        (all weights 1 if u is not known) and D2 the second difference over nodes at their mean spacing h. On evenly
        spaced nodes a wave of length L keeps the fraction ``1/(1 + mu (2 sin(pi h/L))^4)``: 0 keeps the data, 1 halves
        waves of 6 nodes, 100 of 20 nodes, and mu much above (number of nodes/pi)^4 leaves a straight line (mu is
        limited to the value that needs). None: chosen from the data.
    max_abs : largest magnitude of a fitted curve in mm or rad, by error name or by ``"linear"``, ``"angular"``; the
        name takes precedence over the kind.
    max_slope : largest magnitude of its slope in mm/mm or rad/mm, likewise.
    max_curvature : largest magnitude of its second derivative at the inner nodes (difference of the slopes on either
        side of a node over half the distance between its neighbours) in mm/mm^2 or rad/mm^2, likewise.
    monotone : ``"increasing"`` or ``"decreasing"`` by error name. Not for straightness, which is zero at both ends.
    robust : Huber's loss instead of squares, for data with outliers: a node pulls at most as if it deviated by 1.345
        times its uncertainty. If uncertainties are not known, their scale comes from the residuals.

    Raises
    ------
    InputError
        for a negative smoothness, a bound that is not positive, an unknown name.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> fitted = compgen.fit(machine, errors, compgen.FitOptions(smoothness=1.0, max_abs={"linear": 0.02}))
    >>> round(float(abs(fitted.errors.curves["EZZ"].value).max()), 6)  # 30 um without the bound
    0.02
    """

    smoothness: float | None = option(
        None, "Dimensionless weight of the second differences (0 keeps the data); default: chosen from the data."
    )
    max_abs: Mapping[str, float] = option(
        factory=dict,
        text="Largest magnitude of a fitted curve, um or urad. NAME is an error (EXX), or linear or angular for all of "
        "that kind; may be given several times.",
        metavar="NAME=LIMIT",
    )
    max_slope: Mapping[str, float] = option(
        factory=dict, text="Largest slope of a fitted curve, um/m or urad/m. NAME as above.", metavar="NAME=LIMIT"
    )
    max_curvature: Mapping[str, float] = option(
        factory=dict,
        text="Largest second derivative of a fitted curve, um/m^2 or urad/m^2. NAME as above.",
        metavar="NAME=LIMIT",
    )
    monotone: Mapping[str, str] = option(
        factory=dict,
        text="NAME=increasing or NAME=decreasing: the fitted curve is monotone. NAME is an error, but not a "
        "straightness.",
        metavar="NAME=WAY",
    )
    robust: bool = option(False, "Huber loss instead of least squares: single outlying nodes do not bend the curve.")

    def __post_init__(self) -> None:
        for name in ("max_abs", "max_slope", "max_curvature", "monotone"):
            of_kind(name, getattr(self, name), Mapping)
        of_kind("smoothness", self.smoothness, float, int, type(None))
        if self.smoothness is not None and not (math.isfinite(self.smoothness) and self.smoothness >= 0):
            message = f"{self.smoothness!r} is not allowed; give a number >= 0, or omit it to choose it from the data"
            raise InputError(message, field="smoothness")
        for bound in ("max_abs", "max_slope", "max_curvature"):
            for key, limit in getattr(self, bound).items():
                _check_key(bound, key)
                of_kind(f"{bound}[{key}]", limit, float, int, np.floating)
                if not limit > 0:
                    message = f"{limit!r} for {key} is not a possible bound; give a positive number, or omit it"
                    raise InputError(message, field=bound)
        for key, direction in self.monotone.items():
            if key not in CURVE_NAMES:
                raise InputError(
                    Message(
                        "curve-unknown",
                        "{key!r} is not one of the curves; {key2}",
                        key=key,
                        key2=nearest(key, CURVE_NAMES),
                    ),
                    field="monotone",
                )
            if direction not in DIRECTIONS:
                allowed = ", ".join(DIRECTIONS)
                raise InputError(
                    Message(
                        "direction-unknown",
                        "{direction!r} for {key} is not allowed; give one of {allowed}",
                        direction=direction,
                        key=key,
                        allowed=allowed,
                    ),
                    field="monotone",
                )

    @classmethod
    def from_file_units(
        cls,
        smoothness: float | None = None,
        max_abs_um_urad: Mapping[str, float] | None = None,
        max_slope_um_m_urad_m: Mapping[str, float] | None = None,
        max_curvature_um_m2_urad_m2: Mapping[str, float] | None = None,
        monotone: Mapping[str, str] | None = None,
        *,
        robust: bool = False,
    ) -> FitOptions:
        """Build the options from um and urad, um/m and urad/m, um/m^2 and urad/m^2.

        >>> FitOptions.from_file_units(max_abs_um_urad={"EXX": 20.0}).max_abs
        {'EXX': 0.02}
        """
        slopes, bends = max_slope_um_m_urad_m or {}, max_curvature_um_m2_urad_m2 or {}
        return cls(
            smoothness,
            {key: limit * _unit("max_abs", key) for key, limit in (max_abs_um_urad or {}).items()},
            {key: limit * _unit("max_slope", key) * _PER_M for key, limit in slopes.items()},
            {key: limit * _unit("max_curvature", key) * _PER_M**2 for key, limit in bends.items()},
            dict(monotone or {}),
            robust,
        )

    def limits(self, name: str) -> tuple[float, float]:
        """Return the bounds (magnitude, slope) of one curve in mm or rad and per mm, inf if there is none."""
        bounds = self.bounds(name)
        return bounds.max_abs, bounds.max_slope

    def bounds(self, name: str) -> Bounds:
        """Return all bounds of one curve, in mm or rad."""
        kind = error_named(name).kind
        magnitude, slope, bend = (
            limits.get(name, limits.get(kind, math.inf))
            for limits in (self.max_abs, self.max_slope, self.max_curvature)
        )
        return Bounds(magnitude, slope, bend, DIRECTIONS.get(self.monotone.get(name, ""), 0))


def _unit(bound: str, key: str) -> float:
    _check_key(bound, key)
    name = key if key in CURVE_NAMES else {"linear": "EXX", "angular": "EAX"}[key]
    return error_named(name).si_per_unit


def _check_key(bound: str, key: str) -> None:
    if key not in CURVE_NAMES and key not in ERROR_KINDS:
        known = (*ERROR_KINDS, *CURVE_NAMES)
        raise InputError(
            Message(
                "bound-name-unknown",
                "{key!r} is neither a curve nor a kind of error; {key2}",
                key=key,
                key2=nearest(key, known),
            ),
            field=bound,
        )


# One curve with a given smoothness within its bounds.
#
# minimise x^T A x / 2 - x^T g   subject to   lower <= G x <= upper
#
# in the unknowns of the smoother, with g = Z^T W y. The zero curve satisfies every bound, so the program always has a
# solution. A free optimum within its bounds is the solution. Otherwise a root F of the inverse of A turns the program
# into finding the point nearest to the free optimum, x = free + F d with minimum |d|, by exchange of its active bounds.
# These become equations and are corrected one by one until the Karush-Kuhn-Tucker conditions (every bound satisfied,
# every multiplier of the right sign) prove that the curve is optimal. Curves with too many nodes for dense matrices
# start with the active bounds from a general solver. If active bounds are dependent, their multipliers are not unique;
# the general solver's curve is then accepted if its duality gap is closed.


DIRECT, ACTIVE_SET = "direct", "active set"
#: Multipliers with the wrong sign up to this fraction of the largest are rounding errors.
_ACTIVE_SET_SIGN = 1e-9
#: Most exchanges of active rows; an excess below this fraction of the largest of the free optimum does not count.
_EXCHANGES, _OUTSIDE = 60, 1e-10
#: Combinations of active rows with a reach below this fraction of the largest are ignored.
_DEPENDENT = 1e-13
#: Largest duality gap, as a fraction of the cost of the bounds, of a solution with dependent active rows.
_GAP = 1e-8
#: Less than this fraction of the data is zero: rounding errors of a curve that its bounds keep at zero.
ROUNDING = 1e-15
_UNTOUCHED: FloatArray = np.zeros(0)


class CurveSolution(NamedTuple):
    """A fitted ``curve`` (n,) in the unit of its data, the bounds that it touches, and the solver that found it.

    ``touched`` contains -1, 0, 1 for n values, n - 1 slopes and n - 2 curvatures; empty if no bound is touched.
    """

    curve: FloatArray
    touched: FloatArray = _UNTOUCHED
    solver: str = DIRECT


def solve_curve(smoother: Smoother, mu: float, position_mm: FloatArray, y: FloatArray, bounds: Bounds) -> CurveSolution:
    """Minimise the smoother's cost for data (n,) within bounds in the unit of ``y``.

    A free optimum within its bounds is the solution; only curves that violate a bound need more work.
    """
    curve = smoother.solve(mu, y[:, None])[:, 0]
    if bounds.kept_by(position_mm, curve):
        return CurveSolution(curve)
    unit = max(float(np.abs(y).max()), float(np.finfo(float).tiny))  # solvers work best with numbers near 1
    rows = constraint_rows(position_mm, smoother, *bounds.in_unit(unit).limits, bounds.direction)
    found = fit_bounded(smoother, mu, y / unit, rows)
    return found._replace(curve=np.where(np.abs(found.curve) > ROUNDING, found.curve * unit, 0.0))


def fit_bounded(smoother: Smoother, mu: float, y: FloatArray, rows: Rows) -> CurveSolution:
    """Solve the program for data (n,); ``rows`` from :func:`compgen.fitting.bounds.constraint_rows`.

    Raises
    ------
    ConvergenceError
        when no solver's result passes the optimality conditions.
    """
    free = smoother.solve(mu, y[:, None])[:, 0]
    root = smoother.inverse_root(mu)
    if root is not None:
        found = _active_set(smoother, mu, free, rows, _nearest(root, free, rows))
        if found is not None:
            return CurveSolution(*found, ACTIVE_SET)
    for solver, call in SOLVERS.items():
        start = _general(smoother, mu, y, rows, call)
        if start is None:
            continue
        curve, multiplier = start
        size = np.abs(multiplier)
        touched = np.where(size > 1e-6 * size.max(initial=0.0), np.sign(multiplier), 0.0)
        found = _active_set(smoother, mu, free, rows, touched)
        if found is None and _is_optimal(smoother, mu, free, rows, curve, multiplier):
            found = curve, touched
        if found is not None:
            return CurveSolution(*found, solver)
    raise ConvergenceError(
        Message(
            "fit-no-optimum",
            "the bounded fit found no optimum that passes its check; loosen the bounds or the smoothness",
        )
    )


def _nearest(root: FloatArray, free: FloatArray, rows: Rows) -> FloatArray:
    """Active rows (-1, 0, 1) of the point within the bounds nearest to the free optimum; at least a good guess.

    With R = G F, the multipliers of the active rows R_a solve R_a R_a^T v = their excess at the free optimum. Rows with
    a multiplier of the wrong sign leave; of the rows beyond their limit the furthest of each run of neighbours enters
    (neighbours are nearly dependent: all of them at once would go round in a circle).
    """
    reach, value = rows.times(root), rows.times(free[:, None])[:, 0]
    length = np.linalg.norm(reach, axis=1)
    used = (length > 0) & (np.isfinite(rows.upper) | np.isfinite(rows.lower))
    length[~used] = 1.0
    above, below = (np.where(used, value - limit, -sign * math.inf) / length
                    for sign, limit in ((1.0, rows.upper), (-1.0, rows.lower)))  # fmt: skip
    reach /= length[:, None]
    active, moved = np.zeros(len(value)), np.zeros(len(value))
    largest = max(float(above.max(initial=0.0)), float(-below.min(initial=0.0)))
    for _ in range(_EXCHANGES):
        excess = np.maximum(above - moved, 0.0) + np.maximum(moved - below, 0.0)
        excess[active != 0] = 0.0
        enters = _peaks(excess, len(free)) & (excess > _OUTSIDE * largest)
        if not enters.any():
            return active
        active[enters] = np.where(above[enters] > moved[enters], 1.0, -1.0)
        while True:
            picked = np.flatnonzero(active)
            own = reach[picked]
            _, multiplier, failed = lapack().dposv(
                own @ own.T, np.where(active[picked] > 0, above[picked], below[picked]), lower=1
            )
            if failed:
                return _by_least_squares(reach, above, below)
            pull = active[picked] * multiplier
            wrong = pull < -_ACTIVE_SET_SIGN * np.abs(pull).max(initial=0.0)
            if not wrong.any():
                break
            active[picked[wrong]] = 0.0
        moved = reach @ (own.T @ multiplier)
    return _by_least_squares(reach, above, below)


def _peaks(excess: FloatArray, n: int) -> BoolArray:
    """Where values of n nodes, n - 1 slopes and n - 2 curvatures are larger than those beside them."""
    kinds = np.zeros((3, n + 2))
    kinds[0, 1:-1], kinds[1, 1:n], kinds[2, 1 : max(n - 1, 1)] = np.split(excess, [n, max(2 * n - 1, n)])
    peak = (kinds[:, 1:-1] >= kinds[:, :-2]) & (kinds[:, 1:-1] > kinds[:, 2:])
    return np.concatenate([peak[0], peak[1, : n - 1], peak[2, : max(n - 2, 0)]])


def _by_least_squares(reach: FloatArray, above: FloatArray, below: FloatArray) -> FloatArray:
    """The same active rows by non-negative least squares (Lawson & Hanson 1974, chapter 23), which always ends.

    With d in units of the largest excess and right-hand sides h = excess, min |d| subject to -R d >= h has the
    multipliers u of min |(-R)^T u|^2 + (h^T u - 1)^2, u >= 0.
    """
    from scipy.optimize import nnls  # imported here: slow to load

    high, low = np.flatnonzero(np.isfinite(above)), np.flatnonzero(np.isfinite(below))
    row, sign = np.concatenate([high, low]), np.repeat([1.0, -1.0], [len(high), len(low)])
    excess = np.concatenate([above[high], -below[low]])
    active = np.zeros(len(reach))
    if not excess.max(initial=0.0) > 0.0:
        return active
    excess /= excess.max()
    system = np.vstack([-sign * reach[row].T, excess])
    try:
        multiplier = nnls(system, np.append(np.zeros(reach.shape[1]), 1.0))[0]
    except RuntimeError:  # too many steps: start the search with the rows furthest outside their limits
        multiplier = np.maximum(excess, 0.0)
    chosen = multiplier > _ACTIVE_SET_SIGN * multiplier.max()
    active[row[chosen]] = sign[chosen]
    return active


#: Solves min x^T P x / 2 + q^T x, lower <= A x <= upper for (P, q, A, lower, upper): x and multipliers, or None.
_Solver = Callable[
    ["sp.csc_array", FloatArray, "sp.csc_array", FloatArray, FloatArray], tuple[FloatArray, FloatArray] | None
]


def _general(
    smoother: Smoother, mu: float, y: FloatArray, rows: Rows, call: _Solver
) -> tuple[FloatArray, FloatArray] | None:
    """Curve (n,) of a general solver, scaled to meet its bounds, and multipliers (m,), positive at upper limits."""
    import scipy.sparse as sp

    # unknowns scaled to 1 on the diagonal of A, and only rows with a limit
    quadratic = smoother.matrix(mu)
    scale = 1 / np.sqrt(quadratic.diagonal())
    stretch: Any = sp.diags_array(scale)
    used = np.flatnonzero(np.isfinite(rows.lower) | np.isfinite(rows.upper))
    matrix = sp.csc_array(rows.matrix[used] @ stretch)
    linear = -scale * smoother.load(y[:, None])[:, 0]
    found = call(sp.csc_array(stretch @ quadratic @ stretch), linear, matrix, rows.lower[used], rows.upper[used])
    if found is None or not np.isfinite(found[0]).all():
        return None
    multiplier = np.zeros(rows.matrix.shape[0])
    multiplier[used] = found[1]
    curve = smoother.expand((scale * found[0])[:, None])[:, 0]
    # every smaller multiple of a curve also meets the bounds
    values = rows.dense @ curve
    limit = np.where(values > 0, rows.upper, -rows.lower)
    share = np.where((limit > 0) & np.isfinite(limit), np.abs(values) / np.where(limit > 0, limit, 1.0), 0.0)
    return curve / max(1.0, float(share.max())), multiplier


def _clarabel(
    quadratic: sp.csc_array, linear: FloatArray, matrix: sp.csc_array, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    import scipy.sparse as sp

    clarabel: Any = import_module("clarabel")
    high, low = np.isfinite(upper), np.isfinite(lower)
    one_sided = sp.csc_matrix(sp.vstack([matrix[high], -matrix[low]]))
    limit = np.concatenate([upper[high], -lower[low]])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
    cones = [clarabel.NonnegativeConeT(len(limit))]
    half = sp.csc_matrix(sp.triu(quadratic))
    result = clarabel.DefaultSolver(half, linear, one_sided, limit, cones, settings).solve()
    if "Solved" not in str(result.status):
        return None
    dual, multiplier = np.array(result.z), np.zeros(len(high))
    multiplier[high] += dual[: int(high.sum())]
    multiplier[low] -= dual[int(high.sum()) :]
    return np.array(result.x), multiplier


def _osqp(
    quadratic: sp.csc_array, linear: FloatArray, matrix: sp.csc_array, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    import scipy.sparse as sp

    osqp: Any = import_module("osqp")
    solver = osqp.OSQP()
    settings = {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000, "verbose": False}
    solver.setup(sp.csc_matrix(sp.triu(quadratic)), linear, sp.csc_matrix(matrix), lower, upper, **settings)
    result = solver.solve(raise_error=False)
    return (result.x, result.y) if result.info.status in ("solved", "solved inaccurate") else None


#: General solvers in the order of trial.
SOLVERS: dict[str, _Solver] = {"Clarabel": _clarabel, "OSQP": _osqp}


def _is_optimal(
    smoother: Smoother, mu: float, free: FloatArray, rows: Rows, curve: FloatArray, multiplier: FloatArray
) -> bool:
    """Whether the curve meets its bounds and its duality gap is closed.

    With e = x - free, cost e^T A e / 2 and the dual value for multipliers v (both from the free optimum), half the
    squared distance to the optimum in the norm of A is at most their difference (A is the program's only curvature).
    """
    if np.abs(rows.excess(curve)).max(initial=0.0) > KEPT:
        return False
    e, v = curve - free, multiplier
    cost = 0.5 * float(e @ smoother.apply(mu, e[:, None])[:, 0])
    pull = rows.dense.T @ v
    reach = smoother.inverse(mu, pull[:, None])[:, 0]
    limit = np.where(v > 0, rows.upper, rows.lower)
    value = float(pull @ free - np.sum(np.where(v != 0, v * limit, 0.0)) - 0.5 * pull @ reach)
    return cost - value <= _GAP * cost


def _active_set(
    smoother: Smoother, mu: float, free: FloatArray, rows: Rows, active: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Curve and active rows that satisfy the optimality conditions, from a guess of the active rows; None if not found.

    One row at a time enters (the furthest outside its bound) or leaves (the multiplier with the largest wrong sign).
    """
    active = active.copy()
    for _ in range(20 + 4 * len(free)):
        picked = np.flatnonzero(active)
        sign = active[picked]
        target = np.where(sign > 0, rows.upper[picked], -rows.lower[picked])
        if not np.isfinite(target).all():
            return None
        signed = rows.dense[picked] * sign[:, None]
        curve, multiplier = _equalities(smoother, mu, free, signed, target)
        if len(picked) and multiplier.min() < -_ACTIVE_SET_SIGN * np.abs(multiplier).max():
            active[picked[np.argmin(multiplier)]] = 0.0
            continue
        excess = rows.excess(curve)
        worst = int(np.argmax(np.abs(excess)))
        if abs(excess[worst]) <= KEPT:
            return curve, active
        if active[worst] != 0:
            return None
        active[worst] = np.sign(excess[worst])
    return None


def _equalities(
    smoother: Smoother, mu: float, free: FloatArray, signed: FloatArray, target: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Curve (n,) with ``signed`` rows (k, n) at ``target`` (k,), and their multipliers times the root of their reach.

    Solved by the Schur complement of A, each row scaled to 1 on its diagonal, and refined with the residuals.
    """
    if not len(signed):
        return free, np.zeros(0)
    reach = smoother.inverse(mu, signed.T)
    schur = signed @ reach
    scale = 1 / np.sqrt(np.maximum(np.diag(schur), np.finfo(float).tiny))
    spread = reach * scale
    value, vector = np.linalg.eigh(schur * scale * scale[:, None])
    used = value > _DEPENDENT * value[-1]
    value, vector = value[used], vector[:, used]
    curve, multiplier = free, np.zeros(len(signed))
    for _ in range(3):
        more = vector @ (vector.T @ (scale * (signed @ curve - target)) / value)
        curve = smoother.expand((curve - spread @ more)[:, None])[:, 0]
        multiplier = multiplier + more
    return curve, multiplier
