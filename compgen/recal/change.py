"""Whether a machine has changed between two measurements, against the uncertainty of both.

The change is E = C P of the new errors minus that of the old ones at points of the volume, with the best-fit rigid
motion taken out: so the gauge directions, which no measurement shows, do not count. If nothing changed, its covariance
is the sum of both, and the sum of squares T over the points is a weighted sum of chi-squares with the eigenvalues of
that covariance as weights; its distribution is taken as that of a scaled chi-square with the same mean and variance
(Satterthwaite 1946, Biometrics Bulletin 2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import chi2

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.identify.covariance import Covariance, error_design
from compgen.model.gauge import rigid_fields
from compgen.model.volumetric import volumetric_error

#: Points along each axis of the grid on which the change is looked at.
POINTS = 6
#: A change is like a field if it differs from it by at most the first share of the field (rms) beyond the noise, or by at
#: most the second one where it holds the field just once, give or take the third: then a drift of another shape came on top.
ALIKE, DRIFTED, ONCE = 0.25, 0.5, 0.1
#: Probabilities below this are said as that: the number of independent directions is hardly known.
LEAST_P = 1e-9


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


@dataclass(frozen=True)
class Likeness:
    """A change that equals plus or minus a known field, both over the volume without rigid motion.

    ``field`` is the key of that field, ``sign`` +1 or -1, ``correlation`` that of the two, ``size`` the factor by which
    the field fits the change best. ``p_value``: the probability that a change drawn evenly from all those of at most
    twice the size of the field comes as close to any of the fields that were looked at, each with its sign.
    """

    field: str
    sign: int
    correlation: float
    size: float
    p_value: float

    def words(self) -> str:
        """Say the figures, e.g. ``correlation +0.990, size 1.02; an arbitrary change comes as close with probability 1e-07``."""
        by_chance = f"{self.p_value:.1g}" if self.p_value >= LEAST_P else f"below {LEAST_P:g}"
        return (
            f"correlation {self.correlation:+.3f}, size {abs(self.size):.2f}; an arbitrary change comes as close with "
            f"probability {by_chance}"
        )

    def summary(self) -> dict[str, object]:
        """Return the figures by name."""
        return asdict(self)


def likeness(
    machine: Machine,
    new: tuple[ErrorTable, Covariance | None],
    old: tuple[ErrorTable, Covariance | None],
    added: Mapping[str, FloatArray],
    missing: Mapping[str, FloatArray],
) -> Likeness | None:
    """Return the field that the change equals, with its sign; None if it equals none.

    Readings of a machine whose tables were on, but are not taken out, change by what the tables add; readings of the
    bare machine from which tables are taken out change by the opposite. That looks like a drift, and tables made of it
    undo the compensation.

    Parameters
    ----------
    new, old : identified errors and, where it is known, their covariance.
    added : fields that may have acted without being counted, at the points of :func:`volume_points`, (n, 3), mm.
    missing : fields that may have been counted without acting.
    """
    position_mm = _grid(machine)
    keep = _without_rigid(machine, position_mm)
    difference = volumetric_error(machine, new[0], position_mm) - volumetric_error(machine, old[0], position_mm)
    moved = keep @ difference.ravel()
    factors = [_spread(machine, spread, position_mm) for _, spread in (new, old) if spread is not None]
    noise = sum(float(np.sum((keep @ factor) ** 2)) for factor in factors)
    free = _directions(machine, new[0], position_mm, keep)
    best: Likeness | None = None
    nearest = DRIFTED
    signed = [
        *((name, 1, field) for name, field in added.items()),
        *((name, -1, field) for name, field in missing.items()),
    ]
    for name, sign, field in signed:
        known = keep @ field.ravel()
        square, product = float(known @ known), float(known @ moved)
        if square <= 4.0 * noise or sign * product <= 0.0:
            continue  # too small to be told from nothing, or the other way round
        apart = float(np.sum((moved - sign * known) ** 2))
        share = float(np.sqrt(max(apart - noise, 0.0) / square))
        once = abs(sign * product / square - 1.0) <= ONCE
        if share <= (nearest if once else min(nearest, ALIKE)):
            nearest = share
            correlation = product / float(np.sqrt(square * (moved @ moved)))
            p_value = min(1.0, len(signed) * (0.5 * min(float(np.sqrt(apart / square)), 2.0)) ** free)
            best = Likeness(name, sign, correlation, product / square, p_value)
    return best


def volume_points(machine: Machine) -> FloatArray:
    """Return the points at which changes are looked at, (n, 3), mm."""
    return _grid(machine)


def _directions(machine: Machine, errors: ErrorTable, position_mm: FloatArray, keep: FloatArray) -> float:
    """Number of independent directions that low-order changes of the errors span over the volume.

    Each error may change by its value (squareness), or by a line and a bow; fields that nearly coincide count once: n^2
    over the sum of squares of the eigenvalues of their correlation matrix (participation ratio), at least 1.
    """
    layout = _layout(errors)
    design = error_design(machine, layout, position_mm).reshape(3 * len(position_mm), -1)
    names = np.array(layout.error)
    columns = []
    for name in errors.names:
        own = np.flatnonzero(names == name)
        at = layout.position_mm[own]
        if len(own) < 2:
            shapes = np.ones((1, len(own)))
        else:
            share = np.interp(at, (at.min(), at.max()), (-1.0, 1.0))
            shapes = np.array([share, share**2 - 1.0 / 3.0])
        columns += [keep @ (design[:, own] @ shape) for shape in shapes]
    fields = np.column_stack(columns)
    length = np.linalg.norm(fields, axis=0)
    fields = fields[:, length > 1e-6 * length.max()] / length[length > 1e-6 * length.max()]
    if fields.shape[1] == 0:
        return 1.0
    gram = fields.T @ fields
    return float(max(1.0, fields.shape[1] ** 2 / np.sum(gram**2)))


def spread_of(errors: ErrorTable, covariance: Covariance | None) -> Covariance | None:
    """Return the covariance; without one that of the standard uncertainties as independent; None if those are unknown."""
    if covariance is not None:
        return covariance
    found = _layout(errors)
    return found if found.error and np.isfinite(found.errors_factor).all() else None


def _layout(errors: ErrorTable) -> Covariance:
    """Return the values of a table of errors with their standard uncertainties as independent; nan where unknown."""
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
    factor = np.diag(np.concatenate(u)) if u else np.zeros((0, 0))
    positions = positions or [np.zeros(0)]
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
    rigid, _ = np.linalg.qr(rigid_fields(tip))
    return np.asarray(np.eye(tip.size) - rigid @ rigid.T)


def _p_value(total: float, factor: FloatArray) -> float:
    """Probability that the squares of a normal vector with covariance F F^T add up to ``total`` or more."""
    gram = factor.T @ factor if factor.shape[1] < factor.shape[0] else factor @ factor.T
    mean, squares = float(np.trace(gram)), float(np.sum(gram**2))
    if mean <= 0.0:
        return 0.0 if total > 0.0 else 1.0
    return float(chi2.sf(total * mean / squares, mean * mean / squares))
