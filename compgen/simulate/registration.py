"""What an effect or an instrument of a plug-in must be; said when it is registered."""

from __future__ import annotations

import inspect
import typing
from typing import Any

from compgen.core.plugins import call_problem

#: How the methods of an instrument are called.
OBSERVE = ("stops", "tip_mm", "rng")


def check_effect(name: str, thing: Any) -> tuple[Any, list[str]]:
    """A reader: takes the section ``[[effects]]`` of a scenario and returns a function of machine and stops."""
    return thing, call_problem(thing, ["section"], f"its reader {_name_of(thing)}")


def check_instrument(name: str, thing: Any) -> tuple[Any, list[str]]:
    """A reader: takes the section ``[instrument]`` of a scenario and returns an object with passes and observe.

    A class that the reader names as what it returns is looked at here, the object itself when a scenario is read.
    """
    problems = call_problem(thing, ["section"], f"its reader {_name_of(thing)}")
    if not problems:
        try:
            made = typing.get_type_hints(thing).get("return")
        except (TypeError, NameError, AttributeError):
            made = None
        if inspect.isclass(made) and made is not object:
            problems += instrument_problems(made)
    return thing, problems


def instrument_problems(thing: Any) -> list[str]:
    """Say what an instrument, or its class, lacks."""
    is_class = inspect.isclass(thing)
    name = thing.__name__ if is_class else type(thing).__name__
    known = {*dir(thing), *(getattr(thing, "__annotations__", {}) if is_class else ())}
    problems = [] if "passes" in known else [f"{name} has no passes (how often the machine runs its trajectory)"]
    observe = getattr(thing, "observe", None)
    if is_class and inspect.isfunction(observe):
        observe = observe.__get__(object())
    return problems + call_problem(observe, OBSERVE, f"{name}.observe")


def _name_of(thing: Any) -> str:
    return getattr(thing, "__name__", type(thing).__name__)
