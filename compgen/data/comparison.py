"""Comparison of two error fields: rigid motion between them, figures, and how much the uncertainty explains.

All comparisons of two sets of errors are made here: tables against the best possible ones, two sets of
tables, predicted against measured errors, two calibrations of one machine, two instruments, a part against its drawing.
A field is errors (n, 3) at points (n, 3); where its covariance is known it is written as a factor F (3 n, r) with the
components of the points one after another, F F^T. Nothing here knows a machine.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import numbers
from compgen.data.csv_files import FloatArray
from compgen.data.names import MM_PER_UM

# Rigid motion: the position and orientation of the workpiece are not errors of the machine.
#
# It is removed in two ways. ``without_rigid_motion`` removes the best-fit finite motion, for figures of one field.
# ``small_motion`` removes the motion to first order in the angles, t + w x p. This is a projection: it acts in the same
# way on errors, columns of a design and a covariance, and it removes the same from a sum as from its parts. A finite
# rotation (``scipy.spatial.transform.Rotation``) has none of these properties, so it cannot be used for uncertainties
# and tests. For angles w the two differ by w^2 / 2 times the distance: 0.05 nm for 10 urad at 1 m.


def best_rotation(moment: FloatArray) -> FloatArray:
    """Return the rotation R (3, 3) with the least sum of w |target - R point|^2; never a reflection.

    The points enter only through their ``moment`` (3, 3), the sum of w target point^T, both relative to the points that
    are made to coincide (Kabsch 1976, Acta Crystallographica A32). For points on a line the rotation about it is free.
    """
    left, _, right = np.linalg.svd(moment)
    left[:, 2] *= np.sign(
        np.linalg.det(left) * np.linalg.det(right)
    )  # as scipy's Rotation.align_vectors, which is slow to load
    return np.asarray(left @ right)


def without_rigid_motion(position_mm: FloatArray, error_mm: FloatArray) -> FloatArray:
    """Remove the best-fit rigid motion (least squares, finite rotation) from errors (n, 3) at points (n, 3).

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> position_mm = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]])
    >>> shifted = np.tile([0.01, 0.0, 0.0], (4, 1))
    >>> float(np.abs(compgen.without_rigid_motion(position_mm, shifted)).max()) < 1e-12
    True
    """
    position_mm = numbers("position_mm", position_mm, None, 3)
    error_mm = numbers("error_mm", error_mm, len(position_mm), 3)
    if not len(position_mm):
        return error_mm
    actual = position_mm + error_mm
    nominal, moved = position_mm - position_mm.mean(axis=0), actual - actual.mean(axis=0)
    return np.asarray(moved @ best_rotation(moved.T @ nominal) - nominal)


def rigid_fields(tip_mm: FloatArray) -> FloatArray:
    """Fields of three translations and three small rotations about the origin at tips (n, 3): columns, (3 n, 6)."""
    unit = np.eye(3)
    fields = [np.broadcast_to(unit[k], tip_mm.shape) for k in range(3)]
    fields += [np.cross(unit[k], tip_mm) for k in range(3)]
    return np.column_stack([field.ravel() for field in fields])


@dataclass(frozen=True)
class SmallMotion:
    """A rigid motion to first order: six ``fields``, (3 n, 6), and the matrix that extracts their amounts, (6, 3 n)."""

    fields: FloatArray
    reading: FloatArray

    def taken_out(self, values: FloatArray) -> FloatArray:
        """Remove the motion from a field (n, 3) or (3 n,), or from each of k fields, (3 n, k)."""
        flat = values.reshape(len(self.fields), -1)
        motion = self.fields @ (self.reading @ flat)
        return np.subtract(flat, motion, out=motion).reshape(values.shape)

    def taken_out_of_weights(self, weight: FloatArray) -> FloatArray:
        """Return weights that give on a field what ``weight`` (n, 3) gives on it without the motion (transpose)."""
        return np.asarray(weight - ((weight.ravel() @ self.fields) @ self.reading).reshape(weight.shape))


def small_motion(tip_mm: FloatArray, weight: FloatArray | None = None) -> SmallMotion:
    """Return the best-fit small rigid motion at points (n, 3), by weighted least squares.

    If the points do not determine all six amounts (fewer than three, or on one line), the determined part is removed.

    Parameters
    ----------
    tip_mm : where the errors act.
    weight : of each point, (n,); default 1.
    """
    fields = rigid_fields(tip_mm - tip_mm.mean(axis=0))
    fields = fields / np.maximum(np.linalg.norm(fields, axis=0), 1e-300)  # translation and rotation of equal size
    root = np.ones(len(fields)) if weight is None else np.repeat(np.sqrt(weight), 3)
    return SmallMotion(fields, np.linalg.pinv(root[:, None] * fields, rcond=1e-12) * root)


# Figures of a field over the volume.


class Sizes(NamedTuple):
    """Largest, root mean square and 95th percentile of magnitudes, in their unit."""

    largest: float
    rms: float
    p95: float


def sizes_of(magnitude: FloatArray) -> Sizes:
    """Return the sizes of values (n,); the sign does not count."""
    size = np.abs(magnitude)
    return Sizes(float(size.max()), rms(size), float(np.percentile(size, 95)))


def rms(values: FloatArray) -> float:
    """Root mean square of values of any shape."""
    return float(np.sqrt(np.mean(values**2)))


@dataclass(frozen=True)
class Residuals:
    """Figures of a field of position errors: largest, root mean square, 95th percentile of the length of the vector.

    ``v_x_um`` ... are the ranges (max - min) of the components over the volume (ISO 230-1 volumetric accuracy).
    """

    max_um: float
    rms_um: float
    p95_um: float
    v_x_um: float
    v_y_um: float
    v_z_um: float

    def as_dict(self) -> dict[str, float]:
        """Return the figures by name."""
        return asdict(self)


def figures_of(size_mm: FloatArray) -> dict[str, float]:
    """Return the largest, the root mean square and the 95th percentile of magnitudes (n,), by name, um."""
    return dict(zip(("max_um", "rms_um", "p95_um"), sizes_of(size_mm / MM_PER_UM), strict=True))


def residuals(error_mm: FloatArray) -> Residuals:
    """Return the figures of errors (n, 3)."""
    columns = np.ascontiguousarray(error_mm.T)  # several times as fast as along rows of three
    x, y, z = (float(np.ptp(part)) / MM_PER_UM for part in columns)
    return Residuals(**figures_of(np.sqrt(np.sum(columns**2, axis=0))), v_x_um=x, v_y_um=y, v_z_um=z)


def residuals_twice(tip_mm: FloatArray, error_mm: FloatArray) -> tuple[Residuals, Residuals]:
    """Return the figures of errors (n, 3) as they are, and with the best-fit rigid motion about tips (n, 3) removed."""
    return residuals(error_mm), residuals(without_rigid_motion(tip_mm, error_mm))


# Difference of two sets of numbers compared with the uncertainty of both.


#: Numbers (m,) and a factor (m, r) of their covariance.
Uncertain = tuple[FloatArray, FloatArray]
#: Directions of the covariance with less than this share of the largest standard uncertainty are rounding.
ROUNDING = 1e-7


@dataclass(frozen=True)
class Difference:
    """First minus second of m numbers, ``value`` (m,), with a factor F (m, r) of its covariance F F^T.

    The numbers are the values of errors, or a field with the three components of each point one after another.
    """

    value: FloatArray
    factor: FloatArray

    def part(self, rows: NDArray[Any]) -> Difference:
        """Return the difference of some of the numbers."""
        return Difference(self.value[rows], self.factor[rows])

    @property
    def u(self) -> FloatArray:
        """Standard uncertainties, (m,)."""
        return np.asarray(np.sqrt(np.einsum("ij,ij->i", self.factor, self.factor)))

    @property
    def size(self) -> FloatArray:
        """Lengths of the vectors of a field, (n,)."""
        return np.asarray(np.linalg.norm(self.value.reshape(-1, 3), axis=1))

    @property
    def u_size(self) -> FloatArray:
        """Root of the summed variances of the components at each point of a field, (n,)."""
        return np.asarray(np.linalg.norm(self.u.reshape(-1, 3), axis=1))

    @property
    def noise(self) -> float:
        """Expected sum of squares if nothing differs: the trace of the covariance."""
        return float(np.sum(self.factor**2))

    def p_of_sum(self) -> float:
        """Probability of at least this sum of squares if nothing differs.

        The sum is one of chi-squares weighted with the eigenvalues of the covariance; its distribution is approximated
        by a scaled chi-square with the same mean and variance (Satterthwaite 1946, Biometrics Bulletin 2).
        """
        from scipy.special import chdtrc  # imported here: few comparisons are tests

        total, wide = float(self.value @ self.value), self.factor.shape[1] >= self.factor.shape[0]
        gram = self.factor @ self.factor.T if wide else self.factor.T @ self.factor
        mean, squares = float(np.trace(gram)), float(np.sum(gram**2))
        if mean <= 0.0:
            return 0.0 if total > 0.0 else 1.0
        return float(chdtrc(mean * mean / squares, total * mean / squares))

    def p_of_pattern(self) -> float:
        """Probability of at least this difference, given its covariance (chi-square), if nothing differs.

        Directions that the covariance excludes, apart from rounding, do not count.
        """
        from scipy.special import chdtrc  # imported here: few comparisons are tests

        vectors, sizes, _ = np.linalg.svd(self.factor, full_matrices=False)
        kept = sizes > ROUNDING * sizes.max(initial=0.0)
        if not kept.any():
            return 1.0
        score = vectors[:, kept].T @ self.value / sizes[kept]
        return float(chdtrc(int(np.count_nonzero(kept)), score @ score))


def compare(first: Uncertain, second: Uncertain, motion: SmallMotion | None = None) -> Difference:
    """Return first minus second with the covariance of both, which are independent.

    Parameters
    ----------
    first, second : numbers (m,) and a factor (m, r) of their covariance; r = 0 for exact ones.
    motion : the rigid motion to remove from a field and its covariance; default none.
    """
    value, factor = first[0] - second[0], np.hstack([first[1], second[1]])
    if motion is None:
        return Difference(value, factor)
    return Difference(motion.taken_out(value), motion.taken_out(factor))


def normalized_error(difference: FloatArray, expanded: FloatArray) -> FloatArray:
    """E_n number of each difference (ISO/IEC 17043): its absolute value over its expanded uncertainty; 0 for 0/0."""
    size, expanded = np.abs(difference), np.asarray(expanded, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where((size == 0.0) & (expanded == 0.0), 0.0, size / expanded))
