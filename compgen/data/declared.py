"""Options of a computation, each declared once: the field of a dataclass says its default, meaning, unit and choices."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import field
from typing import Any


def option(
    default: Any = None,
    text: str = "",
    *,
    name: str = "",
    metavar: str | None = None,
    choices: tuple[Any, ...] = (),
    within: tuple[int, int] | None = None,
    factory: Callable[[], Any] | None = None,
) -> Any:
    """Return the field of an options dataclass; the command line makes an option of it.

    Parameters
    ----------
    default, factory : value where nothing is given; ``factory`` makes one that can be changed.
    text : meaning and unit, one or two sentences. A default that is a number or a word is added to it.
    name : of the option, where it is not that of the field; a flag that is True by default needs one that denies it.
    metavar : what the help shows for the value.
    choices : the values that the command line allows, where the type of the field does not list them.
    within : the lowest and the highest whole number.
    """
    declared: Mapping[str, Any] = {"text": text, "name": name, "metavar": metavar, "choices": choices, "within": within}
    return field(metadata=declared, **({"default_factory": factory} if factory is not None else {"default": default}))
