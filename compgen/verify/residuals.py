"""Figures of a residual field over the volume, as it stands and after the best-fit rigid motion is taken out."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM


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


def residuals(error_mm: FloatArray) -> Residuals:
    """Return the figures of errors (n, 3)."""
    size = np.linalg.norm(error_mm, axis=1) / MM_PER_UM
    ranges = np.ptp(error_mm, axis=0) / MM_PER_UM
    return Residuals(
        max_um=float(size.max()),
        rms_um=float(np.sqrt(np.mean(size**2))),
        p95_um=float(np.percentile(size, 95)),
        v_x_um=float(ranges[0]),
        v_y_um=float(ranges[1]),
        v_z_um=float(ranges[2]),
    )


def without_rigid_motion(position_mm: FloatArray, error_mm: FloatArray) -> FloatArray:
    """Take the best-fit rigid motion (least squares, finite rotation by SVD) out of errors (n, 3) at points (n, 3)."""
    actual = position_mm + error_mm
    centre, moved_centre = position_mm.mean(axis=0), actual.mean(axis=0)
    left, _, right = np.linalg.svd((actual - moved_centre).T @ (position_mm - centre))
    sign = np.sign(np.linalg.det(left @ right))
    rotation = left @ np.diag([1.0, 1.0, sign]) @ right  # nominal -> actual
    return np.asarray((actual - moved_centre) @ rotation - (position_mm - centre))
