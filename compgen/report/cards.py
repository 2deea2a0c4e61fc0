"""Cards: what a control can express, its settings and limits; and the catalogue of effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from compgen.controls import controller_named
from compgen.data import toml_files
from compgen.effects import Card, Effect
from compgen.tables.render import Format, load_format

# The card of a control: what it can express, its settings, limits and sources, and what no document settles.


@dataclass(frozen=True)
class ControlSetting:
    """One key of ``[controllers.<name>]``.

    ``default`` is written as in a machine file, None if there is none or the meaning states it; ``allowed`` is what its
    check expects.
    """

    key: str
    required: bool
    default: Any
    allowed: str
    meaning: str


@dataclass(frozen=True)
class ControlCard:
    """Everything that ``volcomp controllers NAME`` shows."""

    format: Format
    settings: tuple[ControlSetting, ...]
    anchored: bool
    bidirectional: bool

    def summary(self) -> dict[str, Any]:
        """Return the object that ``--json`` prints."""
        card = self.format
        return {
            "name": card.name,
            "title": card.title,
            "summary": card.summary,
            "expresses": card.expresses,
            "evidence": card.evidence,
            "files": [spec.name for spec in card.files],
            "constant_offset": not self.anchored,
            "tables_of_one_direction": self.bidirectional,
            "settings": [vars(setting) for setting in self.settings],
            "limits": list(card.limits),
            "unverified": list(card.unverified),
            "sources": list(card.sources),
        }


def control_card(name: str, templates: Path | None = None) -> ControlCard:
    """Return the card of control ``name``; its settings are those that its ``settings_class`` declares.

    A plug-in that reads its section key by key describes its keys in ``[settings]`` of its ``format.toml``.
    """
    control, card = controller_named(name), load_format(name, templates)
    declared = toml_files.declared_settings(getattr(control, "settings_class", object))
    settings = [ControlSetting(key.key, key.required, key.shown, key.allowed, meaning) for key, meaning in declared]
    known = {item.key.partition(".")[0] for item in settings}
    settings += [ControlSetting(key, False, None, "", text) for key, text in card.settings.items() if key not in known]
    return ControlCard(card, tuple(settings), control.anchored, control.bidirectional)


# The card of a control for the terminal.


def card_text(card: ControlCard, origin: str | None) -> RenderableType:
    """Return the card: what it expresses, files, settings, limits, open points, sources."""
    about = card.format
    offset = "no: the tables are zero at the reference point (or machine zero)" if card.anchored else "yes"
    direction = "yes" if card.bidirectional else "no: a reversal goes into the control's backlash parameters"
    return Group(
        Text(f"{about.name}: {about.title}", style="bold"),
        *([Text(f"from {origin}")] if origin else []),
        *_paragraph(None, about.summary),
        *_paragraph("What it can express", about.expresses),
        *_list("Properties", [f"constant offset: {offset}", f"direction-dependent tables: {direction}"]),
        *_list("Files", [spec.name for spec in about.files]),
        *_settings(about.name, card.settings),
        *_list("Limits", about.limits),
        *_list(f"Format {about.evidence}; what no public document settles", about.unverified),
        *_list("Sources", about.sources),
    )


def _heading(title: str) -> list[RenderableType]:
    return [Text(""), Text(title, style="bold")]


def _paragraph(title: str | None, text: str) -> list[RenderableType]:
    return [*(_heading(title) if title else []), Padding(Text(text), (0, 0, 0, 2))]


def _list(title: str, items: Sequence[str]) -> list[RenderableType]:
    grid = Table.grid(padding=(0, 1))
    for item in items or ["nothing"]:
        grid.add_row(Text(" -"), Text(item, overflow="fold"))
    return [*_heading(title), grid]


def _settings(name: str, settings: Sequence[ControlSetting]) -> list[RenderableType]:
    if not settings:
        return _list(f"Settings in [controllers.{name}]", [])
    table = Table("key", "default", "allowed", "meaning", box=box.SIMPLE, pad_edge=False)
    table.columns[0].overflow = table.columns[1].overflow = "fold"
    for item in settings:
        default = "required" if item.required else _toml(item.default)
        table.add_row(Text(item.key), Text(default), Text(item.allowed), Text(item.meaning))
    return [*_heading(f"Settings in [controllers.{name}] of the machine file"), table]


def _toml(value: Any) -> str:
    """Return a default as it is written in a machine file."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


# The catalogue of effects as text: one card, and the page ``docs/effects.md``.


UNITS = "The names of the parameters end with their unit (um, urad, ppm, K, h, kg, ms)."


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
    # effects whose names differ only in the last part share a row, with the card of the first
    families: dict[str, tuple[list[str], Card]] = {}
    for name, effect in effects.items():
        family, _, member = name.rpartition("_")
        key = family if member[:1].isupper() or member.startswith("<") else name
        families.setdefault(key, ([], effect.card))[0].append(name)
    for names, card in families.values():
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
