"""The catalogue of effects as text: one card, and the page ``docs/effects.md``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compgen.effects import Card, Effect

UNITS = "Parameters carry their unit in the name (um, urad, ppm, K, h, kg, ms)."


def card_summary(card: Card) -> dict[str, Any]:
    """Return a card for JSON."""
    return {
        "title": card.title,
        "equation": card.equation,
        "source": card.source,
        "covariates": list(card.covariates),
        "parameters": {p.name: {"meaning": p.meaning, "plausible": p.plausible} for p in card.parameters},
        "settings": {s.name: s.meaning for s in card.settings},
        "scan": card.scan or None,
        "aliases": list(card.aliases),
        "breaker": card.breaker,
        "readings": list(card.kinds),
    }


def effect_card_text(card: Card, origin: str | None = None) -> str:
    """Return a card as text for the terminal."""
    lines = [f"{card.name}: {card.title}", "", f"  {card.equation}", ""]
    lines += [f"source      {card.source}", f"readings    {', '.join(card.kinds)}"]
    lines.append(f"columns     {', '.join(card.covariates) or 'none'}")
    lines += [f"parameter   {p.name}: {p.meaning}; at most about {p.plausible:g}" for p in card.parameters]
    lines += [
        f"setting     {s.name}: {s.meaning}{' (searched for)' if s.name == card.scan else ''}" for s in card.settings
    ]
    lines.append(f"resembles   {', '.join(card.aliases) or 'nothing'}")
    lines.append(f"separate by {card.breaker}")
    return "\n".join([*lines, *([f"from        {origin}"] if origin else [])]) + "\n"


def catalogue_markdown(effects: Mapping[str, Effect]) -> str:
    """Return the table of ``docs/effects.md``: one row for each family of effects of equal text."""
    rows = ["| effect | equation | columns | parameters | resembles | what separates |", "|---|---|---|---|---|---|"]
    for names, card in _families(effects):
        parameters = ", ".join(f"`{p.name}`" for p in card.parameters)
        settings = "".join(f"; `{s.name}`" for s in card.settings)
        aliases = ", ".join(f"`{a}`" if " " not in a else a for a in card.aliases)
        cells = [
            ", ".join(f"`{name}`" for name in names),
            f"`{card.equation}`" if card.parameters else card.equation,
            ", ".join(card.covariates),
            f"{parameters}{settings}",
            aliases,
            card.breaker,
        ]
        rows.append("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def _families(effects: Mapping[str, Effect]) -> list[tuple[list[str], Card]]:
    """Effects whose names differ in the last part only, with the card of the first."""
    found: dict[str, tuple[list[str], Card]] = {}
    for name, effect in effects.items():
        family, _, member = name.rpartition("_")
        key = family if member[:1].isupper() or member.startswith("<") else name
        found.setdefault(key, ([], effect.card))[0].append(name)
    return list(found.values())
