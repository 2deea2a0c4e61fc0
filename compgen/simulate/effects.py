"""Effects: what moves the tool tip of a simulated machine besides its geometric errors."""

from __future__ import annotations

from collections.abc import Callable

from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.machine import Machine
from compgen.core.plugins import call_problem, why_missing
from compgen.core.text import nearest
from compgen.simulate.trajectory import Stops

#: An effect: displacement of the tip in the workpiece frame at the stops, shape (n, 3), mm.
Effect = Callable[[Machine, Stops], FloatArray]

#: Reader of a section ``[[effects]]`` of a scenario by its ``name``; plug-ins add to it.
EFFECTS: dict[str, Callable[[tomlio.Section], Effect]] = {}


def read_effects(sections: list[tomlio.Section]) -> tuple[Effect, ...]:
    """Read the effects of a scenario in their order; InputError for an unknown name, key or value."""
    return tuple(_read_effect(section) for section in sections)


def _read_effect(section: tomlio.Section) -> Effect:
    name = section.take("name", tomlio.text)
    if name not in EFFECTS:
        reason = why_missing("effect", name)
        raise section.fail("name", f"is no effect; {nearest(name, EFFECTS)}; --plugin PATH adds some{reason}")
    effect = EFFECTS[name](section)
    section.finish()
    problems = call_problem(effect, ["machine", "stops"], f"the effect {name}")
    if problems:
        raise section.fail("name", "; ".join(problems))
    return effect
