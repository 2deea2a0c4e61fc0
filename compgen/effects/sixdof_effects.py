"""Effects of the six-DOF laser instrument; what the data of one axis can tell of them is found from its signals."""

from __future__ import annotations

from compgen.effects.base import Card, Effect, Family
from compgen.effects.noise_classes import NoiseClass

SOURCE = "Jia et al. 2022, section 4; docs/conventions.md"
REVERSAL = "turn the target by 180 degrees, measure with a second target offset, or calibrate the instrument"


def _card(name: str, title: str, equation: str, breaker: str = REVERSAL) -> Card:
    return Card(
        name, title, equation, SOURCE, (), (), ("the geometric error of the same signal",), breaker, ("sixdof",)
    )


def sixdof_cards() -> list[Card]:
    """Cards of the effects of the instrument."""
    detectors = [
        _card(f"detector_gain_{name}", f"Gain of the detector of {name}", f"the signal of {name} is scaled")
        for name in ("x", "y", "pitch", "yaw", "roll")
    ]
    return [
        _card("beam_drift", "Angle drift of the beam", "straightness signals = L times an angle that drifts with time",
              "run forth and back three times"),
        _card("crosstalk_yaw", "Crosstalk of yaw into straightness", "signal of straightness + k times yaw"),
        _card("crosstalk_pitch", "Crosstalk of pitch into straightness", "signal of straightness + k times pitch"),
        *detectors,
        _card("nonparallel_beams", "Beams that are not parallel", "roll signal = L times the angle between the beams"),
        _card("distance_offset", "Wrong distance between instrument and target", "L is off by a constant"),
    ]  # fmt: skip


class SixDofEffects(Family):
    """All effects of the six-DOF instrument."""

    name = "sixdof"

    def members(self, stations: object) -> list[Effect]:
        """One for each of them; they have no columns on lengths or deviations."""
        return [NoiseClass(card) for card in sixdof_cards()]
