"""What has changed: a measurement against an earlier prediction, error by error.

The prediction (an error file, with its effects if the machine file has some) takes the place of the unknown errors; the
base model then fits the difference, and says which errors differ by more than the noise allows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.names import MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES, error_named
from compgen.diagnose.analysis import Analysis
from compgen.diagnose.base import BaseFit, least_norm
from compgen.diagnose.basis import Part, size_of
from compgen.diagnose.observed import Observed
from compgen.diagnose.scene import Scene, orthonormal
from compgen.model.exact import tip_position

#: p-value (over the number of errors) below which an error has changed.
SIGNIFICANT = 1e-3


@dataclass(frozen=True)
class Against:
    """Residuals of the measurement against a prediction with only the placement free: before and after the change, mm."""

    residual_mm: FloatArray
    changes: tuple[dict[str, Any], ...]
    rms_mm: float


def compared(observed: Observed, analysis: Analysis, errors: ErrorTable) -> Against:
    """Compare a measurement with a prediction.

    Parameters
    ----------
    observed : the measurement.
    analysis : its diagnosis, for the noise and the placement.
    errors : the predicted errors.
    """
    fit = analysis.fit
    residual = _against_prediction(observed, fit, errors)
    return Against(residual, _changes(fit, analysis.scene, residual), float(np.sqrt(np.mean(residual**2))))


def _against_prediction(observed: Observed, fit: BaseFit, errors: ErrorTable) -> FloatArray:
    """Reading minus prediction with stations and dead lengths (or the rigid motion) fitted, (n,)."""
    poses = observed.poses
    tip = tip_position(observed.machine, errors.at(poses.position_mm), poses.position_mm, poses.tool_mm)
    at = size_of(fit.basis.parts(poses.position_mm))
    placement = fit.unknowns[at : at + len(observed.placement_names)].copy()
    for _ in range(8):
        model, _, columns = observed.placed(tip, placement)
        placement += least_norm(columns, observed.value_mm - model)
    return np.asarray(observed.value_mm - observed.placed(tip, placement)[0])


def _changes(fit: BaseFit, scene: Scene, residual: FloatArray) -> tuple[dict[str, Any], ...]:
    """Errors whose curve, fitted to the difference, is significant beside all others; strongest first."""
    from scipy.stats import chi2 as chi2_distribution  # imported here: slow to load

    white = scene.whiten(fit.jacobian)
    target = scene.whiten(residual)
    solution = least_norm(white, target)
    left = target - white @ solution
    factor = max(1.0, float(left @ left) / max(len(left) - white.shape[1], 1))
    found = []
    parts = fit.basis.parts(fit.observed.poses.position_mm)
    for part in parts:
        place = np.arange(part.place.start, part.place.stop)
        others = orthonormal(np.delete(white, place, axis=1))
        own = white[:, place] - others @ (others.T @ white[:, place])
        basis = orthonormal(own, least=1e-6)
        chi2 = float(np.sum((basis.T @ target) ** 2)) / factor
        p = float(chi2_distribution.sf(chi2, basis.shape[1])) * len(parts)
        if p < SIGNIFICANT:
            found.append(_change(part, solution[place], chi2, p))
    return tuple(sorted(found, key=lambda item: -item["chi2"]))


def _change(part: Part, coefficients: FloatArray, chi2: float, p: float) -> dict[str, Any]:
    error = error_named(part.name)
    curve = part.basis @ coefficients
    unit = MM_PER_UM if error.kind == "linear" else RAD_PER_URAD
    largest = float(np.abs(curve).max()) / unit
    what = "value" if part.name in SQUARENESS_NAMES else "largest"
    return {"error": part.name, what: largest, "unit": error.unit, "chi2": chi2, "p": min(p, 1.0)}
