"""Names that explain the readings almost as well as the one that won, with weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.diagnose.scene import Scene
from compgen.diagnose.search import Chosen, Rules, allowed_beside, beside, evaluate, gains, penalty


@dataclass(frozen=True)
class Alternative:
    """A name that explains the readings almost as well in place of a member, with its weight and correlation."""

    name: str
    weight: float
    group: int


#: Difference of the criterion within which a name belongs to the set of 99 %.
WITHIN = 9.2


def alternatives(scene: Scene, rules: Rules, chosen: Chosen, member: int) -> list[Alternative]:
    """Names that could stand in place of a named member, with weights that add up to 1; itself first among equals.

    What belongs to the base model and is fitted where the data ask for it (the tilt of the tools) may stand beside them.
    """
    rest = [g for g in chosen.members if g != member]
    allowed = [g for g in allowed_beside(scene, rules, rest) if scene.groups[g].tier == "named"]
    bases = [[g] for g, item in enumerate(scene.groups) if item.tier == "base" and g not in rest and scene.size(g)]
    rough: dict[int, tuple[float, list[int]]] = {}
    for base in ([], *bases):
        known = evaluate(scene, rules, [*rest, *base]).criterion
        for g, gain in zip(allowed, gains(scene, beside(scene, [*rest, *base]), allowed), strict=True):
            value = known + penalty(scene, rules, g, 0.0) - float(gain)
            if g not in rough or value < rough[g][0]:
                rough[g] = value, [*rest, *base]
    reference = rough[member][0] if member in rough else 0.0
    best: dict[str, int] = {}
    for g in sorted(rough, key=lambda g: rough[g][0]):
        if scene.groups[g].name not in best and rough[g][0] - reference < 3 * WITHIN:
            best[scene.groups[g].name] = g
    best[scene.groups[member].name] = member
    values = {name: evaluate(scene, rules, [*rough.get(g, (0.0, rest))[1], g]).criterion for name, g in best.items()}
    least = min(values.values())
    kept = {name: value for name, value in values.items() if value - least <= WITHIN}
    weights = {name: float(np.exp(-0.5 * (value - least))) for name, value in kept.items()}
    total = sum(weights.values())
    found = [Alternative(name, weight / total, best[name]) for name, weight in weights.items()]
    return sorted(found, key=lambda item: (-round(item.weight, 6), item.group != member))
