"""A step in the lengths of one station: a beam that was broken and found again with other counts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.effects.base import Card, Effect, Parameter, Setting
from compgen.effects.motion import step_times_s
from compgen.effects.readings import Readings


class LengthStep(Effect):
    """dl = c H(t - tau) for the readings of one station, H = 1 from tau on."""

    def __init__(self, station: str) -> None:
        self.station = station
        self.card = Card(
            name=f"length_step_{station}",
            title=f"Step in the lengths of station {station}",
            equation="dl = c H(t - tau)",
            source="loss of counts after a beam break, as a change point",
            covariates=("time_s", "station"),
            parameters=(Parameter("c_um", MM_PER_UM, "height of the step", 1000.0),),
            aliases=("slowly varying noise", "machine_jump"),
            breaker="repeat the first point of every line at its end",
            kinds=("lengths",),
            settings=(Setting("time_s", "time of the step", needed=True),),
            scan="time_s",
            slow=True,
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Times between the runs of the station."""
        return () if "time_s" in self.settings else step_times_s(readings, readings.is_from(self.station))

    def columns(self, readings: Readings) -> FloatArray | None:
        """1 for the readings of the station after the step; None without a time of the step."""
        own, time_s = readings.is_from(self.station), readings.covariate("time_s")
        if "time_s" not in self.settings or time_s is None or not own.any():
            return None
        return np.asarray((own & (time_s >= self.settings["time_s"])).astype(np.float64)[:, None])
