"""Cards: what a control can express, its settings and limits; and the catalogue of effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from compgen.controls import AnyController, controller_named
from compgen.data import toml_files
from compgen.data.machine import Machine, load_machine
from compgen.effects import Card, Effect
from compgen.errors import InputError
from compgen.tables.render import Format, load_format

# The card of a control: what it can express, its settings, limits and sources, and what no document settles.


#: A shipped machine with settings for every control; its travel is used where a default depends on one.
EXAMPLE_MACHINE = "zha-gantry"


@dataclass(frozen=True)
class ControlSetting:
    """One key of ``[controllers.<name>]``.

    ``default`` is as a machine file would have it, None if there is none or the meaning says what it is;
    ``allowed`` is what its check expects.
    """

    key: str
    required: bool
    default: Any
    allowed: str
    meaning: str


@dataclass(frozen=True)
class ControlCard:
    """Everything that ``volcomp controllers NAME`` says; ``problem`` is why not all settings could be found."""

    format: Format
    settings: tuple[ControlSetting, ...]
    anchored: bool
    bidirectional: bool
    problem: str = ""

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


@dataclass(frozen=True, kw_only=True)
class _Watching(Machine):
    """A machine that hands out one section for the settings of ``controller``, so that what is taken can be seen."""

    controller: str
    section: toml_files.Section

    def controller_settings(self, name: str) -> toml_files.Section:
        return self.section if name == self.controller else super().controller_settings(name)


def control_card(name: str, templates: Path | None = None) -> ControlCard:
    """Return the card of control ``name``; its settings are those that its reader asks for."""
    control, card = controller_named(name), load_format(name, templates)
    declared = toml_files.declared_settings(getattr(control, "settings_class", object))
    meanings = {**{key.key: meaning for key, meaning in declared}, **card.settings}
    asked, problem = asked_settings(control, card.example_settings)
    settings = tuple(
        ControlSetting(
            item.key,
            item.required,
            _default(item),
            item.allowed,
            meanings.get(item.key, meanings.get(item.key.partition(".")[0], "")),
        )
        for item in asked
    )
    return ControlCard(card, settings, control.anchored, control.bidirectional, problem)


def _default(item: toml_files.RequestedKey) -> Any:
    """The default if a machine file could hold it; a reader may take others, in a form of its own."""
    value = list(item.default) if isinstance(item.default, tuple) else item.default
    try:
        item.check(value)
    except (ValueError, TypeError):
        return None
    return value


def asked_settings(
    control: type[AnyController], example: Mapping[str, Any]
) -> tuple[list[toml_files.RequestedKey], str]:
    """Return every key that the control asks for on the example machine, and what it complains about."""
    machine = load_machine(EXAMPLE_MACHINE)
    data = {**machine.controller_settings(control.name).data, **example}
    section = toml_files.Section(data, path=None, name=f"controllers.{control.name}")
    own = {item.name: getattr(machine, item.name) for item in fields(Machine)}
    try:
        control.read_settings(_Watching(**own, controller=control.name, section=section))
    except InputError as error:
        return section.asked, str(error)
    return section.asked, ""


# The card of a control for the terminal.


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


# The catalogue of effects as text: one card, and the page ``docs/effects.md``.


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
