"""The nonlinear base fit: error curves, squareness, stations and dead lengths together, with the exact machine model.

Gauss-Newton steps by QR and a truncated SVD, so that directions that the data do not determine stay where they are.
Effects of the catalogue may take part with parameters of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.diagnose.basis import (
    CurveBasis,
    Part,
    first_basis,
    names_of,
    richer,
    size_of,
    tip_columns,
    values_of,
)
from compgen.diagnose.observed import Observed
from compgen.effects import Effect, Readings
from compgen.errors import InputError
from compgen.model.exact import exact_columns

Whiten = Callable[[FloatArray], FloatArray]

STEPS = 12
#: Singular values below this share of the largest, with columns scaled to 1, are directions without information.
LEAST_SINGULAR = 1e-9
#: A step that changes the readings by less than this, mm, ends the iteration.
SMALL_MM = 1e-8


@dataclass(frozen=True)
class BaseFit:
    """A fit of the base model, and of effects if there were any; n readings, p unknowns.

    Parameters
    ----------
    observed : the measurement.
    basis : the curves.
    unknowns : curve and squareness coefficients, placement, then the parameters of the effects in SI units, (p,).
    residual_mm : reading minus model, (n,).
    jacobian : derivative of the model by the unknowns, (n, p); those of the effects come last.
    names : what each unknown is.
    readings : the readings as effects see them, at this fit.
    effects : effects that took part, with the number of their parameters.
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
        """Number of unknowns without those of the effects."""
        return len(self.unknowns) - sum(count for _, count in self.effects)


@dataclass(frozen=True)
class _Linearised:
    model: FloatArray
    jacobian: FloatArray
    readings: Readings


def least_norm(design: FloatArray, target: FloatArray) -> FloatArray:
    """Least-squares solution with scaled columns; directions without information get zero."""
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0.0] = 1.0
    q, r = np.linalg.qr(design / scale)
    u, singular, vt = np.linalg.svd(r, full_matrices=False)
    kept = singular > LEAST_SINGULAR * singular[0]
    return np.asarray((vt[kept].T @ ((u[:, kept].T @ (q.T @ target)) / singular[kept])) / scale)


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
    effects : effects with their scan position fixed that take part.
    start : start values of curves, squareness and placement.
    whiten : takes columns (n, k) to those whose noise is white; default: all readings alike.
    steps : most Gauss-Newton steps.
    """
    parts = basis.parts(observed.poses.position_mm)
    unknowns = np.concatenate([np.zeros(size_of(parts)), observed.start()]) if start is None else start.copy()
    counts: list[int] = [0] * len(effects)
    now = _linearise(observed, parts, unknowns, effects, counts)
    unknowns = np.concatenate([unknowns, np.zeros(sum(counts))])
    for _ in range(steps):
        residual = observed.value_mm - now.model
        design, target = now.jacobian, residual
        if whiten is not None:
            both = whiten(np.column_stack([design, target]))
            design, target = both[:, :-1], both[:, -1]
        step = least_norm(design, target)
        unknowns = unknowns + step
        change = now.jacobian @ step
        now = _linearise(observed, parts, unknowns, effects, counts)
        if float(np.sqrt(np.mean(change**2))) < SMALL_MM:
            break
    names = [*names_of(parts), *observed.placement_names]
    names += [f"{e.card.name} {k}" for e, count in zip(effects, counts, strict=True) for k in range(count)]
    taken = tuple(zip(effects, counts, strict=True))
    residual = observed.value_mm - now.model
    return BaseFit(observed, basis, unknowns, residual, now.jacobian, tuple(names), now.readings, taken)


def _linearise(
    observed: Observed, parts: Sequence[Part], unknowns: FloatArray, effects: Sequence[Effect], counts: list[int]
) -> _Linearised:
    """Model and derivative at ``unknowns``; ``counts`` receives the number of parameters of every effect."""
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
    jacobian[:, :size] = direction[:, [0]] * moved[0][poses.of]
    for k in (1, 2):
        jacobian[:, :size] += direction[:, [k]] * moved[k][poses.of]
    jacobian[:, size:] = np.hstack([placing, *changes])
    if changes and len(unknowns) == jacobian.shape[1]:
        model = model + np.hstack(changes) @ unknowns[-sum(counts) :]
    return _Linearised(model, jacobian, readings)


def _columns(effect: Effect, readings: Readings) -> FloatArray:
    change = effect.columns(readings)
    if change is None:
        raise InputError(f"the measurement lacks what {effect.card.name} needs: {', '.join(effect.card.covariates)}")
    return change


def fit_chosen_base(observed: Observed) -> BaseFit:
    """Fit the smooth base model, with the nodes of the machine file on the axes whose readings ask for them (BIC)."""
    poses = observed.poses
    basis = first_basis(observed.machine, poses.position_mm, len(observed), len(poses.position_mm))
    fit = fit_base(observed, basis)
    for axis in range(3):
        wider = richer(basis, axis)
        if wider is None:
            continue
        start = _extended(fit, wider)
        gain, added = _gain(fit, wider, start)
        if added and gain > added * np.log(len(observed)):
            basis = wider
            fit = fit_base(observed, basis, start=start)
    return fit


def _gain(fit: BaseFit, wider: CurveBasis, start: FloatArray) -> tuple[float, int]:
    """chi-square that a wider basis gains at the present linearisation, and the columns that it adds."""
    parts = wider.parts(fit.observed.poses.position_mm)
    extra = _linearise(fit.observed, parts, start, (), []).jacobian[:, : size_of(parts)]
    extra = extra / np.maximum(np.linalg.norm(extra, axis=0), 1e-300)
    q = np.linalg.qr(fit.jacobian / np.maximum(np.linalg.norm(fit.jacobian, axis=0), 1e-300))[0]
    left = extra - q @ (q.T @ extra)
    left -= q @ (q.T @ left)
    square, vectors = np.linalg.eigh(left.T @ left)
    kept = square > 1e-6
    new = left @ (vectors[:, kept] / np.sqrt(square[kept]))
    explained = float(np.sum((new.T @ fit.residual_mm) ** 2))
    freedom = len(fit.observed) - fit.jacobian.shape[1] - new.shape[1]
    left_over = float(np.sum(fit.residual_mm**2)) - explained
    return explained / max(left_over / max(freedom, 1), 1e-300), new.shape[1]


def _extended(fit: BaseFit, wider: CurveBasis) -> FloatArray:
    """Start values for a wider basis: the present ones, zero for what is new."""
    position_mm = fit.observed.poses.position_mm[:1]
    old, new = fit.basis.parts(position_mm), wider.parts(position_mm)
    values = np.zeros(size_of(new))
    for before, after in zip(old, new, strict=True):
        count = before.basis.shape[1]
        values[after.place.start : after.place.start + count] = fit.unknowns[before.place]
    return np.concatenate([values, fit.unknowns[size_of(old) :]])
