"""A tool or target offset that is not what the file says, in one set-up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting
from compgen.effects.readings import Readings


def setups_of(readings: Readings) -> NDArray[np.int64]:
    """Set-up of every reading, (n,): its label, else the number of its tool offset, from 1 in order of size."""
    label = readings.labels.get("setup")
    if label is not None and np.any(label != label[0]):
        return label
    _, number = np.unique(np.round(readings.tool_mm, 6), axis=0, return_inverse=True)
    return np.asarray(number.ravel().astype(np.int64) + 1)


class ToolOffsetError(DisplacementEffect):
    """d = c in one set-up, c a vector."""

    def __init__(self) -> None:
        self.card = Card(
            name="tool_offset_error",
            title="Wrong tool or target offset in one set-up",
            equation="d = c in set-up i, 0 in the others",
            source="offset of the target from the spindle, constant in the workpiece frame",
            covariates=("setup",),
            parameters=tuple(
                Parameter(f"c{a.lower()}_um", MM_PER_UM, f"error of the offset along {a}", 2000.0) for a in AXES
            ),
            aliases=("machine_jump", "laser_scale", "lever_ECX", "lever_EAZ", "lever_EBZ", "lever_ECZ"),
            breaker="measure with a third tool offset, and return to the first",
            kinds=("lengths", "deviations"),
            settings=(Setting("setup", "label of the set-up", needed=True),),
            scan="setup",
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """The second of two set-ups; every one if there are more."""
        if "setup" in self.settings:
            return ()
        known = np.unique(setups_of(readings))
        return [float(setup) for setup in (known[1:] if len(known) == 2 else known if len(known) > 2 else ())]

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Unit vectors in the set-up; None without one."""
        if "setup" not in self.settings:
            return None
        return np.asarray((setups_of(readings) == self.settings["setup"])[:, None, None] * np.eye(3))
