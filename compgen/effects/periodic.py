"""Periodic errors of a screw or an encoder: first and second harmonic of the pitch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting, along
from compgen.effects.readings import Readings

#: Nominal leads of ball screws in mm (ISO 3408-2, table 1, and usual ones besides): tried where no pitch is known.
LEADS_MM = (4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 12.5, 15.0, 16.0, 20.0, 24.0, 25.0, 30.0, 32.0, 40.0, 50.0)


class Periodic(DisplacementEffect):
    """d_a = s1 sin w + c1 cos w + s2 sin 2w + c2 cos 2w with w = 2 pi p_a / pitch."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        shapes = (("s1", "sine"), ("c1", "cosine"), ("s2", "sine of twice the angle"), ("c2", "cosine of it"))
        self.card = Card(
            name=f"periodic_{letter}",
            title=f"Periodic error of {letter}",
            equation=f"d_{letter} = s1 sin w + c1 cos w + s2 sin 2w + c2 cos 2w,  w = 2 pi {letter.lower()} / pitch",
            source="ISO 230-2 (targets spread against the pitch); Fourier series of the pitch, two terms",
            covariates=(),
            parameters=tuple(
                Parameter(f"{name}_um", MM_PER_UM, f"amplitude of the {what}", 20.0) for name, what in shapes
            ),
            breaker="steps that are no multiple of the pitch, with a few targets spread over one pitch",
            settings=(Setting("pitch_mm", "pitch; default: screw_pitch_mm of the axis"),),
            scan="pitch_mm",
        )

    def pitch_mm(self, machine: Machine) -> float | None:
        """Pitch in mm: the setting, else that of the machine file; None if neither is known."""
        return self.settings.get("pitch_mm", machine.axes[self.axis].screw_pitch_mm)

    def positions(self, readings: Readings) -> Sequence[float]:
        """Usual leads, where neither a setting nor the machine file gives the pitch."""
        if self.pitch_mm(readings.machine) is not None:
            return ()
        return [lead for lead in LEADS_MM if lead < readings.machine.axes[self.axis].length_mm / 6.0]

    def used(self, readings: Readings) -> dict[str, float]:
        """The pitch."""
        pitch_mm = self.pitch_mm(readings.machine)
        return {} if pitch_mm is None else {"pitch_mm": pitch_mm}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Sine and cosine of the angle of the screw and of twice that angle."""
        pitch_mm = self.pitch_mm(readings.machine)
        if pitch_mm is None:
            return None
        angle = 2.0 * np.pi * readings.position_mm[:, self.axis] / pitch_mm
        waves = [np.sin(angle), np.cos(angle), np.sin(2.0 * angle), np.cos(2.0 * angle)]
        return along(self.axis, np.column_stack(waves))
