"""Effects: what acts on a simulated machine and its tracers in addition to the geometric errors, as forward formulas."""

from compgen.simulate.effects.forward import (
    EFFECTS,
    Displacement,
    LengthEffect,
    RunEffect,
    Sights,
    SimulatedEffect,
    effects_schema,
    read_effects,
)

#: An effect that moves the tip; plug-ins return one.
Effect = Displacement

__all__ = [
    "EFFECTS",
    "Displacement",
    "Effect",
    "LengthEffect",
    "RunEffect",
    "Sights",
    "SimulatedEffect",
    "effects_schema",
    "read_effects",
]
