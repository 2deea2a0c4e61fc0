"""Growth of the scale of an axis with its temperature, about the point where the scale is fixed."""

from __future__ import annotations

from collections.abc import Sequence

from compgen.core.csvio import FloatArray
from compgen.core.names import AXES
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting, along
from compgen.effects.readings import Readings


class ThermalScale(DisplacementEffect):
    """d_a = c (p_a - p_fixed) (T_a - T_ref)."""

    def __init__(self, axis: int) -> None:
        letter = AXES[axis]
        self.axis = axis
        self.card = Card(
            name=f"thermal_scale_{letter}",
            title=f"Thermal growth of the scale of {letter}",
            equation=f"d_{letter} = c ({letter.lower()} - fixed) (T_{letter} - reference)",
            source="ISO 230-3; Mayr et al., CIRP Annals 61/2 (2012) 771",
            covariates=(f"temp_{letter.lower()}_c",),
            parameters=(Parameter("c_um_per_m_k", 1e-6, "expansion that is left of the scale", 30.0),),
            aliases=("refractive_index", f"spindle_growth_{letter}", f"E{letter}{letter} (its constant part)"),
            breaker="measure again at another temperature of the axis, with the temperatures logged",
            settings=(
                Setting("fixed_mm", "position at which the scale is fixed"),
                Setting("reference_c", "temperature that counts as zero; default: the mean of the readings"),
            ),
            scan="fixed_mm",
            slow=True,
        )

    def positions(self, readings: Readings) -> Sequence[float]:
        """Where scales are fixed: at the reference point, in the middle, at either end, at zero of the axis."""
        if "fixed_mm" in self.settings:
            return ()
        low, high = readings.machine.axes[self.axis].range_mm
        reference = readings.machine.reference_point_mm[self.axis]
        return list(dict.fromkeys((reference, 0.5 * (low + high), low, high, 0.0)))

    def used(self, readings: Readings) -> dict[str, float]:
        """The fixed point and the reference temperature."""
        logged = readings.covariate(self.card.covariates[0])
        fixed = {"fixed_mm": readings.machine.reference_point_mm[self.axis]}
        return {**fixed, **({} if logged is None else {"reference_c": float(logged.mean())}), **self.settings}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Distance from the fixed point times the temperature."""
        warm = readings.temperature_k(AXES[self.axis].lower(), self.settings.get("reference_c"))
        if warm is None:
            return None
        fixed_mm = self.settings.get("fixed_mm", readings.machine.reference_point_mm[self.axis])
        return along(self.axis, (readings.position_mm[:, self.axis] - fixed_mm) * warm)
