"""What is known of the errors of the linear axes while rotary axes are adjusted, and what the poses add to it.

Values of the errors at levels of each axis are mean + factor xi with xi normal, of unit size. Without a measurement of the
linear axes these are squareness and scales with the sizes of the class; with one, the posterior of everything that was
measured, whose curves that nobody measured have the sizes of the prior.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, hat_matrix
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.data.prior import USUAL_CLASS
from compgen.identification.posterior import Posterior
from compgen.identification.result import Identification, table_of_values, worst_uncertainty

#: Levels of an axis at which curves are known between those of the posterior.
_LEVELS = 25
#: Levels closer than this are one, mm.
_SAME_MM = 1e-3


@dataclass(frozen=True)
class LinearState:
    """Errors of the linear axes: values at ``levels_mm`` of each of ``names``, one after another.

    ``mean`` (p,) and ``factor`` (p, r) of their covariance, mm and rad; the first columns of the factor are those of the
    ``posterior``, if there is one.
    """

    names: tuple[str, ...]
    levels_mm: tuple[FloatArray, ...]
    mean: FloatArray
    factor: FloatArray
    posterior: Posterior | None = None

    @classmethod
    def usual(cls, machine: Machine) -> LinearState:
        """Squareness and scales of the class of the machine; nothing else."""
        prior = machine.prior
        prior = replace(prior, class_name=USUAL_CLASS) if prior.is_none else prior
        scales = [f"E{axis}{axis}" for axis in AXES]
        ends = [np.array(axis.range_mm) for axis in machine.axes]
        columns = np.zeros((9, 6))
        columns[[0, 1, 2], [0, 1, 2]] = [prior.size(name) for name in SQUARENESS_NAMES]
        for k, name in enumerate(scales):
            columns[3 + 2 * k : 5 + 2 * k, 3 + k] = prior.scale(name) * (ends[k] - machine.reference_point_mm[k])
        return cls((*SQUARENESS_NAMES, *scales), (*[np.array([np.nan])] * 3, *ends), np.zeros(9), columns)

    @classmethod
    def of_posterior(cls, machine: Machine, found: Posterior, joint_mm: FloatArray) -> LinearState:
        """The errors after a measurement of the linear axes, fine enough for positions (n, 3) of the axes."""
        levels = []
        for axis, at in enumerate(joint_mm.T):
            own = found.machine.axes[axis].nodes_mm
            low, high = (float(np.clip(end, own[0], own[-1])) for end in (at.min(), at.max()))
            more = np.linspace(low, high, _LEVELS)
            far = np.abs(more[:, None] - own).min(axis=1) > _SAME_MM
            levels.append(np.unique(np.concatenate([own, more[far] if high - low > _SAME_MM else more[:0]])))
        every = tuple(
            np.array([np.nan]) if name in SQUARENESS_NAMES else levels[error_named(name).axis] for name in found.names
        )
        places = [np.zeros(1) if name in SQUARENESS_NAMES else at for name, at in zip(found.names, every, strict=True)]
        mean = [found.curve(name, at).value for name, at in zip(found.names, places, strict=True)]
        return cls(found.names, every, np.concatenate(mean), found.values_factor(found.names, places), found)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return int(self.factor.shape[1])

    def at(self, position_mm: FloatArray) -> LinearAt:
        """The errors at positions (n, 3)."""
        means, columns, row = np.zeros((len(position_mm), len(ERROR_NAMES))), {}, 0
        for name, levels in zip(self.names, self.levels_mm, strict=True):
            rows = slice(row, row + len(levels))
            row += len(levels)
            axis = error_named(name).axis
            curve = name not in SQUARENESS_NAMES
            hat = hat_matrix(levels, position_mm[:, axis]) if curve else np.ones((len(position_mm), 1))
            means[:, ERROR_INDEX[name]] = hat @ self.mean[rows]
            columns[name] = hat @ self.factor[rows]
        return LinearAt(means, columns)


@dataclass(frozen=True)
class LinearAt:
    """Errors of the linear axes at n positions: ``mean`` (n, 21), and by name what each unknown adds, (n, r)."""

    mean: FloatArray
    columns: Mapping[str, FloatArray]

    def values(self, unknown: FloatArray) -> FloatArray:
        """The 21 errors (n, 21) for unknowns (r,)."""
        found = self.mean.copy()
        for name, own in self.columns.items():
            found[:, ERROR_INDEX[name]] += own @ unknown
        return found

    def design(self, matrix: FloatArray) -> FloatArray:
        """Derivative (n, j, r) by the unknowns of what ``matrix`` (n, j, 21) is by the errors."""
        parts = [matrix[:, :, ERROR_INDEX[name], None] * own[:, None, :] for name, own in self.columns.items()]
        return np.asarray(sum(parts[1:], parts[0]))


def updated(
    machine: Machine, found: Identification, state: LinearState, unknown: FloatArray, root: FloatArray
) -> tuple[Identification, FloatArray]:
    """The identification of the linear axes with what the poses add, and a factor (values, q + ...) of its values.

    Parameters
    ----------
    state : what was known of the linear axes before the poses, from the posterior of ``found``.
    unknown, root : its unknowns (r,) after the poses, and a factor (r, q) of their covariance.

    The first q columns of the factor are those of ``root``.
    """
    before = state.posterior
    if before is None:
        raise ValueError("the state has no posterior")
    first = before.factor.shape[1]
    after = replace(before, state=before.state + before.factor @ unknown[:first], factor=before.factor @ root[:first])
    listed = [name for name in ERROR_NAMES if name in found.errors.names or name in after.shown]
    values, places = [], []
    for name in listed:
        at = _positions(machine, found.errors, name)
        new, old = after.curve(name, np.nan_to_num(at)), before.curve(name, np.nan_to_num(at))
        value, u = new.value, new.u
        if name in found.errors.names:  # least-squares values move by what the poses add
            own = found.errors.squareness[name] if name in SQUARENESS_NAMES else found.errors.curves[name]
            kept, kept_u = (np.array([own[0]]), np.array([own[1]])) if isinstance(own, tuple) else (own.value, own.u)
            value = kept + (new.value - old.value)
            u = np.where(np.isfinite(kept_u), kept_u, old.u) * new.u / np.where(old.u > 0.0, old.u, 1.0)
        values.append((name, at, value, u))
        places.append(np.nan_to_num(at))
    errors = table_of_values(values).replace(metadata=found.errors.metadata)
    factor = after.values_factor(listed, places)
    size, known_u = np.linalg.norm(factor, axis=1), errors.uncertainties()
    factor = factor * np.where(size > 0, known_u / np.where(size > 0, size, 1.0), 1.0)[:, None]
    left = [text for text in found.unobservable if text.partition(":")[0] not in listed]
    return (
        replace(
            found,
            errors=errors,
            unobservable=tuple(left),
            worst_u=worst_uncertainty(errors),
            adjustment=None,
            systematic=None,
            values_factor=factor,
            posterior_source=lambda: after,
            details={**found.details, "posterior_means": _means(found, listed)},
        ),
        factor,
    )


def _means(found: Identification, listed: Sequence[str]) -> list[str]:
    """Names of the errors whose values are posterior means."""
    before = list(found.details.get("posterior_means", ()))
    return [*before, *(name for name in listed if name not in found.errors.names and name not in before)]


def _positions(machine: Machine, errors: ErrorTable, name: str) -> FloatArray:
    """Where an error is written: where it was, else at the nodes of the machine; nan for a squareness."""
    if name in SQUARENESS_NAMES:
        return np.array([np.nan])
    if name in errors.curves:
        return errors.curves[name].position_mm
    return machine.axes[error_named(name).axis].nodes_mm
