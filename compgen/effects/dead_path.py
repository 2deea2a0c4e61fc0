"""Dead path of the interferometers: a part of the beam in air that no compensation reaches."""

from __future__ import annotations

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, Effect, Parameter, Setting
from compgen.effects.readings import Readings


class DeadPath(Effect):
    """dl = c_i (T_air - T_ref), c_i for each station i."""

    def __init__(self, stations: tuple[str, ...]) -> None:
        self.stations = stations
        self.card = Card(
            name="dead_path",
            title="Dead path of the interferometers",
            equation="dl = c_i (T_ambient - reference),  i the station",
            source="Steinmetz, Precision Engineering 12 (1990) 12; Birch & Downs, Metrologia 30 (1993) 155",
            covariates=("temp_ambient_c", "station"),
            parameters=tuple(
                Parameter(f"c_{name}_um_per_k", MM_PER_UM, f"change of the lengths of {name} for each K", 5.0)
                for name in stations
            ),
            aliases=("refractive_index", "station_drift", "spindle_growth_X", "spindle_growth_Y", "spindle_growth_Z"),
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
        """The air temperature, a column for each station."""
        warm = readings.temperature_k("ambient", self.settings.get("reference_c"))
        if warm is None:
            return None
        return np.column_stack([np.where(readings.is_from(name), warm, 0.0) for name in self.stations])
