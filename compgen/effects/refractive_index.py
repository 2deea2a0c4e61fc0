"""Lengths that follow the air temperature: a wavelength that was not compensated, or compensated wrongly."""

from __future__ import annotations

from compgen.core.csvio import FloatArray
from compgen.effects.base import Card, Effect, Parameter, Setting
from compgen.effects.readings import Readings


class RefractiveIndex(Effect):
    """dl = c l (T_air - T_ref)."""

    def __init__(self) -> None:
        self.card = Card(
            name="refractive_index",
            title="Refractive index of the air, not compensated",
            equation="dl = c l (T_ambient - reference)",
            source="Birch & Downs, Metrologia 30 (1993) 155: about -0.93 ppm of the index for each K",
            covariates=("temp_ambient_c",),
            parameters=(Parameter("c_ppm_per_k", 1e-6, "change of a length for each K of the air", 5.0),),
            aliases=("dead_path", "thermal_scale_X", "thermal_scale_Y", "thermal_scale_Z"),
            breaker="vary the range at constant air temperature, and the temperature at constant range",
            kinds=("lengths",),
            settings=(Setting("reference_c", "temperature that counts as zero; default: the mean of the readings"),),
            slow=True,
        )

    def used(self, readings: Readings) -> dict[str, float]:
        """The reference temperature."""
        logged = readings.covariate("temp_ambient_c")
        return {**({} if logged is None else {"reference_c": float(logged.mean())}), **self.settings}

    def columns(self, readings: Readings) -> FloatArray | None:
        """Range times the air temperature."""
        warm = readings.temperature_k("ambient", self.settings.get("reference_c"))
        return None if warm is None else (readings.range_mm * warm)[:, None]
