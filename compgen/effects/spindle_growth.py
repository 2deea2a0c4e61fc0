"""Displacement of the tool by a warm spindle or column, proportional to the temperature of the spindle."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting, along
from compgen.effects.readings import Readings


class SpindleGrowth(DisplacementEffect):
    """d_a = c (T_spindle - T_ref)."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"spindle_growth_{letter}",
            title=f"Growth of spindle or column along {letter}",
            equation=f"d_{letter} = c (T_spindle - reference)",
            source="ISO 230-3 (thermal distortion by the rotating spindle)",
            covariates=("temp_spindle_c",),
            parameters=(Parameter("c_um_per_k", MM_PER_UM, "growth for each K of the spindle", 30.0),),
            aliases=("dead_path", "station_drift", f"thermal_scale_{letter}"),
            breaker="switch the spindle on and off in cycles while measuring, in place of one warm-up",
            settings=(Setting("reference_c", "temperature that counts as zero; default: the mean of the readings"),),
            slow=True,
        )

    def used(self, readings: Readings) -> dict[str, float]:
        """The reference temperature."""
        logged = readings.covariate("temp_spindle_c")
        return {**({} if logged is None else {"reference_c": float(logged.mean())}), **self.settings}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Temperature of the spindle."""
        warm = readings.temperature_k("spindle", self.settings.get("reference_c"))
        return None if warm is None else along(self.axis, warm)
