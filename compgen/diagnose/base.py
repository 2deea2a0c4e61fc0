"""The nonlinear base fit: error curves, squareness, stations and dead lengths together, with the exact machine model.

Gauss-Newton steps by QR and a truncated SVD, so that directions that the data do not determine stay where they are.
Effects of the catalogue may take part with parameters of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import error_named
from compgen.diagnose.basis import (
    CurveBasis,
    Part,
    names_of,
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
#: Curves are taken to be about this small, mm and rad, against readings good to ``READING_MM``: far too loose to matter
#: where the data say anything, but what they hardly determine stays put instead of running away.
LIKELY, READING_MM = 0.1, 1e-3
LIKELY_RAD = 1e-4


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
    hold = _hold(parts)
    for _ in range(steps):
        residual = observed.value_mm - now.model
        design, target = now.jacobian, residual
        if whiten is not None:
            both = whiten(np.column_stack([design, target]))
            design, target = both[:, :-1], both[:, -1]
        step = _step(design, target, unknowns, hold if whiten is None else hold / READING_MM)
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


def _hold(parts: Sequence[Part]) -> FloatArray:
    """Weight that holds each coefficient of the curves near zero, (k,): accuracy of a reading over its likely size."""
    found = np.empty(size_of(parts))
    for part in parts:
        found[part.place] = READING_MM / (LIKELY if error_named(part.name).kind == "linear" else LIKELY_RAD)
    return found


def _step(design: FloatArray, target: FloatArray, unknowns: FloatArray, hold: FloatArray) -> FloatArray:
    """Least-squares step with the first unknowns held near zero by weights ``hold`` (k,)."""
    held = np.zeros((len(hold), design.shape[1]))
    held[:, : len(hold)] = np.diag(hold)
    return least_norm(np.vstack([design, held]), np.concatenate([target, -hold * unknowns[: len(hold)]]))


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


def error_columns(observed: Observed, basis: CurveBasis, unknowns: FloatArray) -> FloatArray:
    """Derivative of the readings by the coefficients of the curves alone, (n, k), at ``unknowns``."""
    parts = basis.parts(observed.poses.position_mm)
    return _linearise(observed, parts, unknowns, (), []).jacobian[:, : size_of(parts)]
