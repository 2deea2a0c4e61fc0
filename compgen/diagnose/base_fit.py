"""The base model (smooth error curves, squareness, stations) and its nonlinear least-squares fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.sparse import csr_array

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import hat_matrix, spline_matrix
from compgen.data.machine import Machine
from compgen.data.names import ERROR_INDEX, SQUARENESS_NAMES, error_named
from compgen.diagnose.observed import Observed
from compgen.effects import Effect, Readings
from compgen.errors import InputError
from compgen.identification.adjust.unknowns import DistinctPoses
from compgen.kinematics.exact_chain import exact_columns, tip_position
from compgen.kinematics.first_order import modelled_errors
from compgen.kinematics.kernel_switch import lapack

# Base model of a diagnosis: smooth curves for the errors of the machine file, rich enough for the data.
#
# Legendre polynomials, because the positions of lines and diagonals do not form a grid; if the data require more,
# higher degrees or the nodal curves of the machine file are added. The rank test removes what cannot be distinguished.


T = TypeVar("T")

#: Degree of the curves if there are enough levels, and of the curves of an axis that requires more.
DEGREE, HIGHER_DEGREE = 7, 11
#: Readings at distinct poses for each unknown of the curves; a lower degree would leave machine errors unexplained.
READINGS_PER_UNKNOWN = 2
#: A position this close to a node is at the node, mm.
SAME_MM = 1e-3
#: A nodal basis with more nodes than this is not tried.
MOST_NODES = 40


def legendre(s: FloatArray, degree: int) -> FloatArray:
    """Legendre polynomials P0 ... P_degree at ``s`` (m,), shape (m, degree + 1)."""
    return np.asarray(np.polynomial.legendre.legvander(s, degree))


@dataclass(frozen=True)
class CurveBasis:
    """Basis of the curves of the three axes: ``degree`` of the polynomials, ``nodal`` if nodes are added.

    ``span_mm``: range of positions of each axis over which the polynomials are defined; default its travel. Within a
    part of the travel, polynomials over the whole travel would be nearly collinear.
    """

    machine: Machine
    errors: tuple[str, ...]
    degree: tuple[int, int, int]
    nodal: tuple[bool, bool, bool] = (False, False, False)
    span_mm: tuple[tuple[float, float], ...] = ()

    def _span(self, axis: int) -> tuple[float, float]:
        return self.span_mm[axis] if self.span_mm else self.machine.axes[axis].range_mm

    def with_axis(self, axis: int, other: CurveBasis) -> CurveBasis:
        """Return the basis with the curves of one axis as in another basis."""
        degree = _with(self.degree, axis, other.degree[axis])
        return replace(self, degree=degree, nodal=_with(self.nodal, axis, other.nodal[axis]))

    def of_axis(self, axis: int, position_mm: FloatArray) -> FloatArray:
        """Basis of an axis at positions (m,): polynomials P1, P2 ..., then nodal curves, (m, k)."""
        item = self.machine.axes[axis]
        low, high = self._span(axis)
        s = (2.0 * position_mm - low - high) / (high - low)
        columns = legendre(s, self.degree[axis])[:, 1:]
        if not self.nodal[axis]:
            return columns
        build = spline_matrix if self.machine.curves == "cubic" else hat_matrix
        return np.hstack([columns, build(item.nodes_mm, position_mm)])

    def parts(self, position_mm: FloatArray) -> list[Part]:
        """Name, place in the vector of unknowns and basis (m, k) of every error at positions (m, 3)."""
        bases = []  # per axis: zero at the reference point, and zero at both ends of the span
        for axis in range(3):
            start, end = self._span(axis)
            fixed = np.array([np.clip(self.machine.reference_point_mm[axis], start, end), start, end])
            whole = self.of_axis(axis, np.concatenate([fixed, position_mm[:, axis]]))
            reference, low, high, columns = whole[0], whole[1], whole[2], whole[3:]
            share = ((position_mm[:, axis] - start) / (end - start))[:, None]
            bases.append((columns - reference, (columns - (1.0 - share) * low - share * high)[:, 1:]))
        parts: list[Part] = []
        at = 0
        for name in self.errors:
            if name in SQUARENESS_NAMES:
                part = np.ones((len(position_mm), 1))
            else:
                error = error_named(name)
                part = bases[error.axis][1 if error.is_straightness else 0]
            parts.append(Part(name, slice(at, at + part.shape[1]), part))
            at += part.shape[1]
        return parts


@dataclass(frozen=True)
class Part:
    """One error: name, place in the vector of unknowns, basis at the poses (m, k)."""

    name: str
    place: slice
    basis: FloatArray


def size_of(parts: Sequence[Part]) -> int:
    """Number of unknowns of all errors."""
    return parts[-1].place.stop if parts else 0


def names_of(parts: Sequence[Part]) -> list[str]:
    """Name of the error that each unknown belongs to."""
    return [part.name for part in parts for _ in range(part.basis.shape[1])]


def values_of(parts: Sequence[Part], unknowns: FloatArray, poses: int) -> FloatArray:
    """All 21 errors (poses, 21) for the unknowns, mm and rad."""
    values = np.zeros((poses, len(ERROR_INDEX)))
    for part in parts:
        values[:, ERROR_INDEX[part.name]] = part.basis @ unknowns[part.place]
    return values


def tip_columns(parts: Sequence[Part], columns: FloatArray) -> FloatArray:
    """Derivative of the tip by the unknowns, (3, m, k); ``columns`` (m, 3, 21) is its derivative by the errors."""
    design = np.empty((3, len(columns), size_of(parts)))
    for part in parts:
        own = columns[:, :, ERROR_INDEX[part.name]]
        for k in range(3):
            np.multiply(own[:, k, None], part.basis, out=design[k, :, part.place])
    return design


def base_errors(machine: Machine) -> tuple[str, ...]:
    """Errors of the base model: those of the machine file with its tool; what other tools show is an effect."""
    return modelled_errors(machine)


def first_basis(machine: Machine, position_mm: FloatArray, readings: int, poses: int) -> CurveBasis:
    """Return the smooth basis that ``readings`` at ``poses`` distinct positions can support."""
    errors = base_errors(machine)
    curves = sum(name not in SQUARENESS_NAMES for name in errors)
    most = max(2, int(min(readings, 3 * poses) / READINGS_PER_UNKNOWN / max(curves, 1)))
    degree, nodal, span = [], [], []
    for axis in range(3):
        levels = np.unique(np.round(position_mm[:, axis], 3))
        degree.append(max(1, min(DEGREE, len(levels) - 1, most)))
        nodal.append(len(levels) <= min(most, MOST_NODES) and _at_nodes(machine, axis, levels))
        moved = len(levels) > 1
        span.append((float(levels[0]), float(levels[-1])) if moved else machine.axes[axis].range_mm)
    return CurveBasis(machine, errors, (degree[0], degree[1], degree[2]), (nodal[0], nodal[1], nodal[2]), tuple(span))


def _at_nodes(machine: Machine, axis: int, levels_mm: FloatArray) -> bool:
    """Whether an axis was measured only at nodes of the machine file: then its curves are free at every level."""
    nodes = machine.axes[axis].nodes_mm
    return len(levels_mm) > 2 and bool(np.all(np.abs(levels_mm[:, None] - nodes).min(axis=1) < SAME_MM))


def wider_bases(basis: CurveBasis, axis: int, position_mm: FloatArray, readings: int) -> list[CurveBasis]:
    """Wider bases of one axis that ``readings`` can support: higher degree, or with the nodes of the machine file."""
    if basis.nodal[axis]:
        return []
    levels = len(np.unique(np.round(position_mm[:, axis], 3)))
    curves = sum(name not in SQUARENESS_NAMES for name in basis.errors)
    most = int(min(readings, 3 * len(position_mm)) / READINGS_PER_UNKNOWN / max(curves, 1))
    found = []
    if basis.degree[axis] == DEGREE and levels > HIGHER_DEGREE and most >= HIGHER_DEGREE:
        found.append(replace(basis, degree=_with(basis.degree, axis, HIGHER_DEGREE)))
    nodes = len(basis.machine.axes[axis].nodes_mm)
    if basis.degree[axis] + 1 < nodes <= MOST_NODES:
        found.append(replace(basis, nodal=_with(basis.nodal, axis, True)))
    return found


def _with(values: tuple[T, T, T], axis: int, value: T) -> tuple[T, T, T]:
    """Return three values with the value of one axis changed."""
    changed = list(values)
    changed[axis] = value
    return changed[0], changed[1], changed[2]


# The nonlinear base fit: error curves, squareness, stations and dead lengths together, with the exact machine model.
#
# Gauss-Newton steps by QR and a truncated SVD: directions that the data do not determine stay unchanged.
# Effects of the catalogue can be included, with their parameters as unknowns.


Whiten = Callable[[FloatArray], FloatArray]

STEPS = 12
#: Singular values below this share of the largest, with columns scaled to 1, are directions without information.
LEAST_SINGULAR = 1e-9
#: A step that changes the readings by less than this, mm, ends the iteration.
SMALL_MM = 1e-8
#: After a step that changes the readings by more than this, mm, or by more than this share of the step before, the
#: derivative is calculated again; otherwise it has changed by less than 1e-6.
NEAR_MM, SHRINKING = 1e-3, 1e-2
#: Curves are assumed to be about this small, mm and rad, and readings accurate to ``READING_MM``: too loose to matter
#: where the data are informative, but what the data hardly determine stays near zero instead of diverging.
LIKELY, READING_MM = 0.1, 1e-3
LIKELY_RAD = 1e-4
#: Columns of a panel of :class:`TallQR`.
PANEL = 32


@dataclass(frozen=True)
class BaseFit:
    """A fit of the base model, with effects if there are any; n readings, p unknowns.

    Parameters
    ----------
    observed : the measurement.
    basis : the curves.
    unknowns : curve and squareness coefficients, placement, then the parameters of the effects in SI units, (p,).
    residual_mm : reading minus model, (n,).
    jacobian : derivative of the model by the unknowns, (n, p); the parameters of effects come last.
    names : what each unknown is.
    readings : the readings in the form that effects use, at this fit.
    effects : the effects included, with the number of their parameters.
    """

    observed: Observed
    basis: CurveBasis
    unknowns: FloatArray
    residual_mm: FloatArray
    jacobian: FloatArray
    names: tuple[str, ...]
    readings: Readings
    effects: tuple[tuple[Effect, int], ...] = ()

    @property
    def rms_mm(self) -> float:
        """RMS of the residuals."""
        return float(np.sqrt(np.mean(self.residual_mm**2)))

    @property
    def base_size(self) -> int:
        """Number of unknowns without the parameters of effects."""
        return len(self.unknowns) - sum(count for _, count in self.effects)


@dataclass(frozen=True)
class _Linearised:
    model: FloatArray
    jacobian: FloatArray
    readings: Readings


class TallQR:
    """QR of columns (n, p): ``factor`` R (r, p), r = min(n, p), and products with Q (n, r), which is never formed.

    LAPACK's recursive panels: numpy's QR of a matrix with many more rows than columns takes three times as long.
    ``overwrite``: the columns, in Fortran order, may be destroyed.
    """

    def __init__(self, columns: FloatArray, *, overwrite: bool = False) -> None:
        self._count, self._rank = len(columns), min(columns.shape)
        panel = min(PANEL, self._rank)
        self._compact, self._blocks, _ = lapack().dgeqrt(panel, columns, overwrite_a=int(overwrite))
        self.factor = np.triu(self._compact[: self._rank])

    def of_basis(self, small: FloatArray) -> FloatArray:
        """Q times a matrix (r, k)."""
        padded = np.zeros((self._count, small.shape[1]), order="F")
        padded[: self._rank] = small
        return np.ascontiguousarray(lapack().dgemqrt(self._compact, self._blocks, padded, overwrite_c=1)[0])

    def on_basis(self, target: FloatArray) -> FloatArray:
        """Q' times a vector (n,)."""
        turned = lapack().dgemqrt(self._compact, self._blocks, target[:, None].copy(), trans="T", overwrite_c=1)[0]
        return np.asarray(turned[: self._rank, 0])


def _scaled(columns: FloatArray, scale: FloatArray) -> FloatArray:
    """Columns over their scale, in the order of LAPACK."""
    return np.divide(columns, scale, out=np.empty(columns.shape, order="F"))


def orthonormal(columns: FloatArray, least: float = 1e-9) -> FloatArray:
    """Orthonormal basis of the span of columns (n, p)."""
    norm = np.sqrt(np.einsum("nk,nk->k", columns, columns))
    kept = norm > 0
    qr = TallQR(_scaled(columns if kept.all() else columns[:, kept], norm[kept]), overwrite=True)
    u, singular, _ = np.linalg.svd(qr.factor, full_matrices=False)
    return qr.of_basis(u[:, singular > least * singular[0]])


def least_norm_of(design: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return the function from a target (n,) to the solution of :func:`least_norm`; ``design`` is factorised once."""
    scale = np.sqrt(np.einsum("nk,nk->k", design, design))
    scale[scale == 0.0] = 1.0
    qr = TallQR(_scaled(design, scale), overwrite=True)
    u, singular, vt = np.linalg.svd(qr.factor, full_matrices=False)
    kept = singular > LEAST_SINGULAR * singular[0]
    u, weighted = u[:, kept], vt[kept].T / singular[kept]
    return lambda target: np.asarray(weighted @ (u.T @ qr.on_basis(target)) / scale)


def least_norm(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least-squares solution with scaled columns; directions without information get zero."""
    return least_norm_of(design)(target)


def fit_base(
    observed: Observed,
    basis: CurveBasis,
    effects: Sequence[Effect] = (),
    *,
    start: FloatArray | None = None,
    whiten: Whiten | None = None,
    steps: int = STEPS,
) -> BaseFit:
    """Fit errors, placement and effects to the readings.

    Parameters
    ----------
    observed : the measurement.
    basis : curves of the errors.
    effects : effects to include, with their scan position fixed.
    start : start values of curves, squareness and placement.
    whiten : maps columns (n, k) to columns with white noise; default: all readings have equal weight.
    steps : maximum number of Gauss-Newton steps.
    """
    parts = basis.parts(observed.poses.position_mm)
    unknowns = np.concatenate([np.zeros(size_of(parts)), observed.start()]) if start is None else start.copy()
    counts: list[int] = [0] * len(effects)
    now = _linearise(observed, parts, unknowns, effects, counts)
    unknowns = np.concatenate([unknowns, np.zeros(sum(counts))])
    # weight that keeps each curve coefficient near zero: accuracy of a reading over the likely size of the coefficient
    likely = [LIKELY if error_named(name).kind == "linear" else LIKELY_RAD for name in names_of(parts)]
    hold = READING_MM / np.array(likely) if whiten is None else 1.0 / np.array(likely)
    solve: Callable[[FloatArray], FloatArray] | None = None
    model, last = now.model, np.inf
    for _ in range(steps):
        if solve is None:  # one factorisation serves all steps from nearly the same point
            held = np.zeros((len(hold), now.jacobian.shape[1]))
            held[:, : len(hold)] = np.diag(hold)
            solve = least_norm_of(np.vstack([now.jacobian if whiten is None else whiten(now.jacobian), held]))
        target = observed.value_mm - model
        target = target if whiten is None else whiten(target)
        step = solve(np.concatenate([target, -hold * unknowns[: len(hold)]]))
        unknowns = unknowns + step
        change = float(np.sqrt(np.mean((now.jacobian @ step) ** 2)))
        if change < SMALL_MM:
            break
        if change > min(NEAR_MM, SHRINKING * last):
            now, solve = _linearise(observed, parts, unknowns, effects, counts), None
            model = now.model
        else:
            model = _model(observed, parts, unknowns, effects)
        last = change
    now = _linearise(observed, parts, unknowns, effects, counts)
    names = [*names_of(parts), *observed.placement_names]
    names += [f"{e.card.name} {k}" for e, count in zip(effects, counts, strict=True) for k in range(count)]
    taken = tuple(zip(effects, counts, strict=True))
    residual = observed.value_mm - now.model
    return BaseFit(observed, basis, unknowns, residual, now.jacobian, tuple(names), now.readings, taken)


def _model(observed: Observed, parts: Sequence[Part], unknowns: FloatArray, effects: Sequence[Effect]) -> FloatArray:
    """Readings (n,) that the model predicts at ``unknowns``."""
    poses, size = observed.poses, size_of(parts)
    errors = values_of(parts, unknowns, len(poses.position_mm))
    tip = tip_position(observed.machine, errors, poses.position_mm, poses.tool_mm)
    placement, of_effects = np.split(unknowns[size:], [len(observed.placement_names)])
    model = observed.placed(tip, placement)[0]
    if not effects:
        return model
    readings = observed.readings(tip, placement)
    return np.asarray(model + np.hstack([_columns(effect, readings) for effect in effects]) @ of_effects)


def _linearise(
    observed: Observed, parts: Sequence[Part], unknowns: FloatArray, effects: Sequence[Effect], counts: list[int]
) -> _Linearised:
    """Model and derivative at ``unknowns``; the number of parameters of each effect is appended to ``counts``."""
    poses = observed.poses
    size = size_of(parts)
    tip, columns = exact_columns(
        observed.machine, values_of(parts, unknowns, len(poses.position_mm)), poses.position_mm, poses.tool_mm
    )
    placement = unknowns[size : size + len(observed.placement_names)]
    model, direction, placing = observed.placed(tip, placement)
    moved = tip_columns(parts, columns)
    readings = observed.readings(tip, placement)
    changes = [_columns(effect, readings) for effect in effects]
    counts[:] = [change.shape[1] for change in changes]
    jacobian = np.empty((len(observed), size + len(placement) + sum(counts)))
    if size:  # a list of errors may contain none that this measurement moves
        jacobian[:, :size] = along(direction, poses) @ moved.reshape(-1, size)
    jacobian[:, size:] = np.hstack([placing, *changes])
    if changes and len(unknowns) == jacobian.shape[1]:
        model = model + np.hstack(changes) @ unknowns[-sum(counts) :]
    return _Linearised(model, jacobian, readings)


def _columns(effect: Effect, readings: Readings) -> FloatArray:
    change = effect.columns(readings)
    if change is None:
        raise InputError(f"the measurement lacks what {effect.card.name} needs: {', '.join(effect.card.covariates)}")
    return change


def along(direction: FloatArray, poses: DistinctPoses) -> csr_array:
    """Sparse matrix (n, 3 m) that projects the three components at all poses on the readings' ``direction`` (n, 3)."""
    count, size = len(direction), len(poses.position_mm)
    rows, columns = np.tile(np.arange(count), 3), np.concatenate([poses.of + k * size for k in range(3)])
    return csr_array((direction.T.ravel(), (rows, columns)), shape=(count, 3 * size))
