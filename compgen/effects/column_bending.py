"""Bending of a column whose front is warmer than its rear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting, along
from compgen.effects.readings import Readings

Y, Z = 1, 2
CHANNELS = ("temp_column_front_c", "temp_column_rear_c")


class ColumnBending(DisplacementEffect):
    """d_Y = c G (z - z0)^2, G the temperature of the front less that of the rear, less its reference."""

    def __init__(self) -> None:
        self.card = Card(
            name="column_bending",
            title="Bending of the column by a temperature gradient",
            equation="d_Y = c (T_front - T_rear - reference) (z - z0)^2",
            source="bending of a free beam under a linear temperature gradient; Mayr et al., CIRP Annals 61/2 (2012) 771",
            covariates=CHANNELS,
            parameters=(Parameter("c_um_per_k_m2", 1e-9, "deflection for each K at 1 m from the foot", 200.0),),
            aliases=("spindle_growth_Y", "EYZ (its constant part)"),
            breaker="let the gradient cycle while measuring over the whole stroke of Z",
            settings=(
                Setting("z0_mm", "position of Z at which the column is clamped"),
                Setting("reference_k", "gradient that counts as zero; default: the mean of the readings"),
            ),
            scan="z0_mm",
            slow=True,
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Foot of the column: either end, the middle or the reference point of Z."""
        if "z0_mm" in self.settings:
            return ()
        low, high = readings.machine.axes[Z].range_mm
        return list(dict.fromkeys((low, high, 0.5 * (low + high), readings.machine.reference_point_mm[Z])))

    def _gradient_k(self, readings: Readings) -> FloatArray | None:
        front, rear = (readings.covariate(channel) for channel in CHANNELS)
        return None if front is None or rear is None else front - rear

    def used(self, readings: Readings) -> dict[str, float]:
        """The foot and the reference gradient."""
        gradient = self._gradient_k(readings)
        mean = {} if gradient is None else {"reference_k": float(gradient.mean())}
        return {"z0_mm": readings.machine.axes[Z].range_mm[0], **mean, **self.settings}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Gradient times the squared distance from the foot."""
        gradient = self._gradient_k(readings)
        if gradient is None or ("reference_k" not in self.settings and np.ptp(gradient) == 0.0):
            return None
        used = self.used(readings)
        lever_mm = readings.position_mm[:, Z] - used["z0_mm"]
        return along(Y, (gradient - used["reference_k"]) * lever_mm**2)
