"""When the error over the volume leaves its tolerance: one line through the whole field, with its joint covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.identify.covariance import error_design
from compgen.recal.change import _grid, _without_rigid
from compgen.recal.drift_data import Aligned
from compgen.recal.drift_forecast import SEED, Forecast, exit_grid, first_exit, forecast_of
from compgen.recal.drift_trend import Series, regressors

#: Fields that are drawn.
DRAWS = 1000


def volume_forecast(
    data: Aligned,
    reference: int,
    steps: Sequence[int],
    temperature_k: FloatArray | None,
    limits: tuple[float, float, float],
) -> Forecast | None:
    """Forecast when the rms of E over the volume, minus what the active tables take out, exceeds the tolerance.

    Level and slope of all error values come from one weighted line with the same weights for each; the scatter about
    it, where it is more than the uncertainties say, widens the result. A random walk is not weighed here. None for too
    few calibrations.

    Parameters
    ----------
    data, reference, steps, temperature_k : calibrations, which one the tables hold, steps and temperatures of the trends.
    limits : tolerance in mm, horizon in days, confidence.
    """
    tolerance, horizon_days, confidence = limits
    root, pull, design = _regression(data, steps, temperature_k)
    if pull is None:
        return None
    state = pull[:2] @ data.value
    field = _field(data)
    excess = _excess(data, design, pull, root, field)
    generator = np.random.default_rng([SEED, 99])
    draws = np.zeros((2, DRAWS, data.value.shape[1]))
    for k, factor in enumerate(data.factor):
        noise = generator.standard_normal((DRAWS, factor.shape[1])) @ factor.T
        draws += excess * pull[:2, k, None, None] * noise
    level = (state[0] - data.value[reference] + draws[0]) @ field.T
    slope = (state[1] + draws[1]) @ field.T
    days = exit_grid(horizon_days)
    square, mixed, steep = (np.sum(a * b, axis=1) for a, b in ((level, level), (level, slope), (slope, slope)))
    at_once, growing, fast = _noise(data, reference, pull, field, excess)
    square, mixed, steep = square - at_once, mixed - growing, steep - fast
    count = field.shape[0] / 3.0
    rms = np.sqrt(np.maximum(square[:, None] + 2 * mixed[:, None] * days + steep[:, None] * days**2, 0.0) / count)
    return forecast_of(first_exit(rms, tolerance, days), horizon_days, confidence)


def _noise(
    data: Aligned, reference: int, pull: FloatArray, field: FloatArray, excess: float
) -> tuple[float, float, float]:
    """What noise adds to the square of a drawn field: parts constant, linear (half) and quadratic in time.

    A drawn square holds the variance twice, once from the estimate and once from the draw. The reading that the tables
    took out has noise which is real, and which the estimate shares by its weight.
    """
    spread = np.array([np.sum((field @ factor) ** 2) for factor in data.factor])
    parts = [excess**2 * float(np.sum(pull[i] * pull[j] * spread)) for i, j in ((0, 0), (0, 1), (1, 1))]
    shared = pull[:2, reference] * spread[reference]
    return 2.0 * parts[0] - 2.0 * float(shared[0]), 2.0 * parts[1] - float(shared[1]), 2.0 * parts[2]


def _regression(
    data: Aligned, steps: Sequence[int], temperature_k: FloatArray | None
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Weights (n,), matrix (p, n) that makes the coefficients from the readings, and the design (n, p)."""
    size = np.array([np.linalg.norm(factor) for factor in data.factor])
    series = Series(data.days, np.zeros(len(size)), size, temperature_k)
    design = regressors(series, steps)
    root = 1.0 / size
    if len(size) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        return root, None, design
    return root, np.linalg.pinv(root[:, None] * design) * root, design


def _field(data: Aligned) -> FloatArray:
    """E at the points of the volume without rigid motion, by the error values, (3 n, k)."""
    position_mm = _grid(data.machine)
    design = error_design(data.machine, data.field_covariance(0), position_mm)
    return np.asarray(_without_rigid(data.machine, position_mm) @ design.reshape(3 * len(position_mm), -1))


def _excess(data: Aligned, design: FloatArray, pull: FloatArray, root: FloatArray, field: FloatArray) -> float:
    """Factor, at least 1, by which the field scatters more about its line than the uncertainties say."""
    left = np.eye(len(root)) - design @ pull
    seen = float(np.sum((root[:, None] * ((left @ data.value) @ field.T)) ** 2))
    spread = np.array([np.sum((field @ factor) ** 2) for factor in data.factor])
    due = float(np.sum((root[:, None] * left) ** 2 @ spread))
    return max(1.0, float(np.sqrt(seen / due)))
