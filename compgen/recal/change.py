"""Whether a machine has changed between two measurements, against the uncertainty of both.

The change is E = C P of the new errors minus that of the old ones at points of the volume, with the best-fit rigid
motion taken out: so the gauge directions, which no measurement shows, do not count. If nothing changed, its covariance
is the sum of both, and the sum of squares T over the points is a weighted sum of chi-squares with the eigenvalues of
that covariance as weights; its distribution is taken as that of a scaled chi-square with the same mean and variance
(Satterthwaite 1946, Biometrics Bulletin 2).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import chi2

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.identify.covariance import Covariance, error_design
from compgen.model.volumetric import volumetric_error

#: Points along each axis of the grid on which the change is looked at.
POINTS = 6


@dataclass(frozen=True)
class Change:
    """Change of the machine over its volume, rigid motion taken out, um.

    ``expected_rms_um`` is the rms that the uncertainties alone make; ``p_value`` the probability of at least this change
    if there was none.
    """

    rms_um: float
    max_um: float
    expected_rms_um: float
    p_value: float
    confidence: float

    @property
    def significant(self) -> bool:
        """Whether the change exceeds its uncertainty with the wanted confidence."""
        return self.p_value < 1.0 - self.confidence

    def summary(self) -> dict[str, object]:
        """Return the figures by name."""
        return {**asdict(self), "significant": self.significant}


def spread_of(errors: ErrorTable, covariance: Covariance | None) -> Covariance | None:
    """Return the covariance; without one that of the standard uncertainties as independent; None if those are unknown."""
    if covariance is not None:
        return covariance
    names: list[str] = []
    positions, u = [], []
    for name in errors.names:
        if name in errors.squareness:
            at, spread = np.array([np.nan]), np.array([errors.squareness[name][1]])
        else:
            at, spread = errors.curves[name].position_mm, errors.curves[name].u
        names += [name] * len(at)
        positions.append(at)
        u.append(spread)
    if not names or not np.isfinite(np.concatenate(u)).all():
        return None
    factor = np.diag(np.concatenate(u))
    return Covariance(tuple(names), np.concatenate(positions), (), np.zeros(0, dtype=np.int64), factor)


def change_between(
    machine: Machine,
    new: tuple[ErrorTable, Covariance],
    old: tuple[ErrorTable, Covariance],
    confidence: float,
) -> Change:
    """Compare two identifications (errors with covariance) of one machine over its volume."""
    position_mm = _grid(machine)
    difference = volumetric_error(machine, new[0], position_mm) - volumetric_error(machine, old[0], position_mm)
    keep = _without_rigid(machine, position_mm)
    moved = keep @ difference.ravel()
    factors = [_spread(machine, covariance, position_mm) for _, covariance in (new, old)]
    factor = keep @ np.hstack(factors)
    count = len(position_mm)
    p_value = _p_value(float(moved @ moved), factor)
    return Change(
        rms_um=float(np.sqrt(moved @ moved / count)) / MM_PER_UM,
        max_um=float(np.max(np.linalg.norm(moved.reshape(-1, 3), axis=1))) / MM_PER_UM,
        expected_rms_um=float(np.sqrt(np.sum(factor**2) / count)) / MM_PER_UM,
        p_value=p_value,
        confidence=confidence,
    )


def _grid(machine: Machine) -> FloatArray:
    levels = [np.linspace(*axis.range_mm, POINTS) for axis in machine.axes]
    return np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)


def _spread(machine: Machine, covariance: Covariance, position_mm: FloatArray) -> FloatArray:
    """Factor of the covariance of E at all points one after another, (3 n, r), mm."""
    design = error_design(machine, covariance, position_mm)
    return np.asarray(design.reshape(3 * len(position_mm), -1) @ covariance.errors_factor)


def _without_rigid(machine: Machine, position_mm: FloatArray) -> FloatArray:
    """Projector (3 n, 3 n) that takes translations and rotations out of a field at points (n, 3)."""
    tip = (position_mm - position_mm.mean(axis=0)) / 1000.0
    unit = np.eye(3)
    fields = [np.broadcast_to(unit[k], tip.shape) for k in range(3)] + [np.cross(unit[k], tip) for k in range(3)]
    rigid, _ = np.linalg.qr(np.column_stack([field.ravel() for field in fields]))
    return np.asarray(np.eye(tip.size) - rigid @ rigid.T)


def _p_value(total: float, factor: FloatArray) -> float:
    """Probability that the squares of a normal vector with covariance F F^T add up to ``total`` or more."""
    gram = factor.T @ factor if factor.shape[1] < factor.shape[0] else factor @ factor.T
    mean, squares = float(np.trace(gram)), float(np.sum(gram**2))
    if mean <= 0.0:
        return 0.0 if total > 0.0 else 1.0
    return float(chi2.sf(total * mean / squares, mean * mean / squares))
