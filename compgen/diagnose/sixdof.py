"""Six-DOF readings: what they say about the instrument that took them, in the form of a diagnosis.

An error of the instrument that depends on the distance alone is the same as a geometric error, so that no statistics
can name it; only what changes with direction, time or order shows. Hence names are tentative: a machine may bend so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from compgen.core.machine import Machine
from compgen.effects import catalogue
from compgen.sixdof.health import Suspicion, sixdof_health
from compgen.sixdof.instrument import Instrument
from compgen.sixdof.readings import SixDof

NOTE = (
    "an optical error that depends on the distance alone equals a geometric error: no statistics can tell the two apart"
)
#: What separates instrument and machine.
ADVICE = (
    "turn the target by 180 degrees and measure again: separates crosstalk fixed to the target from straightness",
    "measure with a second target offset: separates crosstalk and detector gains from straightness",
    "run forth and back three times: separates the drift of the beam from straightness",
)


@dataclass(frozen=True)
class SixDofDiagnosis:
    """What six-DOF readings show of their instrument."""

    machine: Machine
    suspicions: tuple[Suspicion, ...]

    @property
    def acceptable(self) -> bool:
        """Hints are no reason to refuse the readings."""
        return True

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        names = {item.name for item in self.suspicions}
        cards = {name: e.card for name, e in catalogue().items() if "sixdof" in e.card.kinds}
        empty = {"before_rms_um": None, "after_rms_um": None}
        return {
            "verdict": "named" if self.suspicions else "none",
            "effects": [_effect(item) for item in self.suspicions],
            "unknown": [],
            "invisible": [name for name in cards if name not in names and name != "beam_drift"],
            "secondary": [],
            "gap": {"train": empty, "noise_floor_um": None, "noise_floor_source": "assumed"},
            "advice": list(ADVICE),
            "reasons": [],
            "notes": [NOTE],
        }


def _effect(item: Suspicion) -> dict[str, Any]:
    return {
        "name": item.name,
        "alias_set": [{"name": item.name, "weight": 1.0}],
        "parameters": {key: {"value": value, "u": None} for key, value in item.evidence.items()},
        "confidence": 0.5,
        "grade": "tentative",
        "visible_fraction": None,
        "axis": item.axis,
        "reasons": [item.text],
    }


def diagnose_sixdof(machine: Machine, readings: SixDof, instrument: Instrument) -> SixDofDiagnosis:
    """Return what the readings say about the instrument."""
    return SixDofDiagnosis(machine, tuple(sixdof_health(machine, readings, instrument)))


def sixdof_text(found: SixDofDiagnosis) -> str:
    """Return the report as Markdown text."""
    lines = [f"# Diagnosis of the six-DOF readings of {found.machine.name}", ""]
    lines += [f"* **{item.name}** ({item.axis}): {item.text}" for item in found.suspicions] or ["* nothing stands out"]
    return "\n".join([*lines, "", f"Note: {NOTE}.", "", *[f"* {text}" for text in ADVICE]]) + "\n"
