"""Which further measurement would decide: for alias sets, for near relatives, and for what this plan never shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compgen.diagnose.analysis import Analysis
from compgen.diagnose.scene import Scene
from compgen.diagnose.verdict import Verdict
from compgen.effects import catalogue

#: Correlation above which a relative is printed beside a name, however decisive the criterion looks.
NEAR = 0.9


def advice_of(analysis: Analysis, verdict: Verdict) -> tuple[str, ...]:
    """Return the advice, the most useful first."""
    cards = {name: effect.card for name, effect in catalogue(analysis.fit.readings.stations).items()}
    found: list[str] = []
    for item in verdict.named:
        others = [other.name for other in item.alternatives if other.name != item.name]
        for other in [*others, *relatives(analysis.scene, item.group, others)]:
            breaker = cards[item.name].breaker or cards[other].breaker
            if breaker:
                found.append(f"{breaker}: separates {item.name} from {other}")
    if analysis.noise.source != "repeats":
        found.append("measure every line at least twice, in random order: only repeats tell noise from effects")
    if verdict.unknown and verdict.unknown[0].covariates:
        depends = ", ".join(verdict.unknown[0].covariates)
        found.append(f"vary {depends} by themselves, each line twice: shows the law of what has no name")
    shown: dict[str, list[str]] = {}
    for name in verdict.invisible:
        if name in cards and cards[name].breaker:
            shown.setdefault(cards[name].breaker, []).append(name)
    found += [f"{how}: would show {', '.join(names)}, which this measurement cannot" for how, names in shown.items()]
    return tuple(dict.fromkeys(found))


def relatives(scene: Scene, group: int, known: Sequence[str]) -> list[str]:
    """Names whose visible part is nearly that of a member."""
    rows = scene.rows([group])
    found: dict[str, float] = {}
    for g, other in enumerate(scene.groups):
        if other.tier != "named" or other.name in known or other.name == scene.groups[group].name or not scene.size(g):
            continue
        between = np.linalg.svd(rows[:, scene.place(g)], compute_uv=False)
        found[other.name] = max(
            found.get(other.name, 0.0), float(between[: min(scene.size(g), scene.size(group))].min())
        )
    return [name for name, value in sorted(found.items(), key=lambda item: -item[1]) if value > NEAR][:2]
