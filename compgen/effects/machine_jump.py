"""A jump of the workpiece against the tool that all stations see at once: the table, a clamp, a bumped spindle."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting
from compgen.effects.motion import step_times_s
from compgen.effects.readings import Readings


class MachineJump(DisplacementEffect):
    """d = c H(t - tau), c a vector, H = 1 from tau on."""

    def __init__(self) -> None:
        self.card = Card(
            name="machine_jump",
            title="Jump of the machine that all stations see",
            equation="d = c H(t - tau)",
            source="change point common to all stations: what repeated single jumps of stations cannot be by chance",
            covariates=("time_s",),
            parameters=tuple(Parameter(f"c{a.lower()}_um", MM_PER_UM, f"jump along {a}", 1000.0) for a in AXES),
            aliases=("tool_offset_error", "length_step"),
            breaker="return to the first set-up, and to one reference point from time to time",
            settings=(Setting("time_s", "time of the jump", needed=True),),
            scan="time_s",
            slow=True,
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Times between the runs."""
        return () if "time_s" in self.settings else step_times_s(readings)

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Unit vectors after the jump; None without a time of the jump."""
        time_s = readings.covariate("time_s")
        if "time_s" not in self.settings or time_s is None:
            return None
        return np.asarray((time_s >= self.settings["time_s"])[:, None, None] * np.eye(3))
