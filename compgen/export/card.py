"""The card of a control: what it can express, its settings, limits and sources, and what no document settles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from compgen.controllers import AnyController, controller_named
from compgen.core import tomlio
from compgen.core.machine import Machine, load_machine
from compgen.errors import InputError
from compgen.export.render import Format, load_format

#: A shipped machine with settings for every control; its travel stands where a default depends on one.
EXAMPLE_MACHINE = "zha-gantry"


@dataclass(frozen=True)
class Setting:
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
    settings: tuple[Setting, ...]
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
    section: tomlio.Section

    def controller_settings(self, name: str) -> tomlio.Section:
        return self.section if name == self.controller else super().controller_settings(name)


def control_card(name: str, templates: Path | None = None) -> ControlCard:
    """Return the card of control ``name``; its settings are those that its reader asks for."""
    control, card = controller_named(name), load_format(name, templates)
    asked, problem = asked_settings(control, card.example_settings)
    settings = tuple(
        Setting(item.key, item.required, _default(item), item.allowed, _meaning(card.settings, item.key))
        for item in asked
    )
    return ControlCard(card, settings, control.anchored, control.bidirectional, problem)


def _default(item: tomlio.Asked) -> Any:
    """The default if a machine file could hold it; a reader may take others, in a form of its own."""
    value = list(item.default) if isinstance(item.default, tuple) else item.default
    try:
        item.check(value)
    except (ValueError, TypeError):
        return None
    return value


def _meaning(meanings: Mapping[str, str], key: str) -> str:
    return meanings.get(key, meanings.get(key.partition(".")[0], ""))


def asked_settings(control: AnyController, example: Mapping[str, Any]) -> tuple[list[tomlio.Asked], str]:
    """Return every key that the control asks for on the example machine, and what it complains about."""
    machine = load_machine(EXAMPLE_MACHINE)
    data = {**machine.controller_settings(control.name).data, **example}
    section = tomlio.Section(data, path=None, name=f"controllers.{control.name}")
    own = {item.name: getattr(machine, item.name) for item in fields(Machine)}
    try:
        control.read_settings(_Watching(**own, controller=control.name, section=section))
    except InputError as error:
        return section.asked, str(error)
    return section.asked, ""
