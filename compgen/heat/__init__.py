"""Heat: temperatures and drift of a machine, the model that follows from them, and what it says of the tool tip."""

from compgen.heat.growth import Growth, growth_at
from compgen.heat.learn import Learned, learn_heat
from compgen.heat.model import HeatModel, read_heat
from compgen.heat.sessions import DriftSession, Temperatures, read_drift, read_temperatures

__all__ = [
    "DriftSession",
    "Growth",
    "HeatModel",
    "Learned",
    "Temperatures",
    "growth_at",
    "learn_heat",
    "read_drift",
    "read_heat",
    "read_temperatures",
]
