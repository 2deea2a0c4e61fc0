"""What a family of effects of a plug-in must be; said when it is registered."""

from __future__ import annotations

from typing import Any

from compgen.effects.base import ANY_STATION, Card, Effect, Family
from compgen.effects.catalogue import catalogue


def check_family(name: str, thing: Any) -> tuple[Any, list[str]]:
    """A family, or its class: its members are effects with complete cards, whose names are free."""
    family = thing() if isinstance(thing, type) and issubclass(thing, Family) else thing
    if not isinstance(family, Family):
        return thing, [f"{type(thing).__name__} is no compgen.effects.Family"]
    try:
        members = list(family.members((ANY_STATION,)))
    except Exception as error:  # code of others
        return family, [f"its members cannot be listed: {type(error).__name__}: {error}"]
    taken = set(catalogue((ANY_STATION,)))
    problems = [] if members else ["it has no members"]
    for effect in members:
        problems += _effect_problems(effect, taken)
    return family, problems


def _effect_problems(effect: Any, taken: set[str]) -> list[str]:
    if not isinstance(effect, Effect):
        return [f"{type(effect).__name__} is no compgen.effects.Effect"]
    card = getattr(effect, "card", None)
    if not isinstance(card, Card):
        return [f"{type(effect).__name__} has no card"]
    problems = [f"the name {card.name!r} is taken"] if card.name in taken else []
    lacking = [key for key in ("name", "title", "equation", "source", "parameters") if not getattr(card, key)]
    problems += [f"the card of {card.name!r} lacks {', '.join(lacking)}"] if lacking else []
    if card.scan and card.scan not in {setting.name for setting in card.settings}:
        problems.append(f"the card of {card.name!r} scans {card.scan!r}, which is none of its settings")
    return problems
