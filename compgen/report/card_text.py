"""The card of a control for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from compgen.export.card import ControlCard, Setting


def card_text(card: ControlCard, origin: str | None) -> RenderableType:
    """Return the card: what it expresses, files, settings, limits, open points, sources."""
    about = card.format
    offset = "no: the tables are zero at the reference point" if card.anchored else "yes"
    direction = "yes" if card.bidirectional else "no: a reversal goes into the control's backlash parameters"
    return Group(
        Text(f"{about.name}: {about.title}", style="bold"),
        *([Text(f"from {origin}")] if origin else []),
        *_paragraph(None, about.summary),
        *_paragraph("What it can express", about.expresses),
        *_list("Properties", [f"constant offset: {offset}", f"tables of one direction of travel: {direction}"]),
        *_list("Files", [spec.name for spec in about.files]),
        *_settings(about.name, card.settings),
        *([Text(f"  not all settings could be found: {card.problem}", style="yellow")] if card.problem else []),
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


def _settings(name: str, settings: Sequence[Setting]) -> list[RenderableType]:
    if not settings:
        return _list(f"Settings in [controllers.{name}]", [])
    table = Table("key", "default", "allowed", "meaning", box=box.SIMPLE, pad_edge=False)
    table.columns[0].overflow = table.columns[1].overflow = "fold"
    for item in settings:
        default = "required" if item.required else _toml(item.default)
        table.add_row(Text(item.key), Text(default), Text(item.allowed), Text(item.meaning))
    return [*_heading(f"Settings in [controllers.{name}] of the machine file"), table]


def _toml(value: Any) -> str:
    """A default as a machine file would have it."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    return f"{value:g}" if isinstance(value, float) else str(value)
