"""The registries that plug-ins add to."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from compgen.controls import CONTROLLERS, Controller
from compgen.data.arguments import paths_of
from compgen.effects import FAMILIES
from compgen.effects.all_effects import check_family
from compgen.errors import InputError
from compgen.registry import PATH_ORIGIN, Kind, call_problem, load_entry_points, load_file
from compgen.simulation import EFFECTS, INSTRUMENTS
from compgen.simulation.run import check_effect, check_instrument
from compgen.tables.render import check_templates


def check_control(name: str, thing: Any) -> tuple[Any, list[str]]:
    """Return the class of the control and its problems."""
    code: Any = thing if inspect.isclass(thing) else type(thing)
    if not issubclass(code, Controller):
        return thing, ["it is not a subclass of compgen.controls.Controller"]
    problems = _method_problems(code)
    own = getattr(code, "name", None)
    if own != name:
        problems.append(f"{code.__name__}.name must be {name!r}, but is {'missing' if own is None else repr(own)}")
    for item in ("anchored", "bidirectional"):
        if not isinstance(getattr(code, item), bool):
            problems.append(f"{code.__name__}.{item} must be True or False")
    if code.bidirectional is True and code.with_reversal is Controller.with_reversal:
        arguments = ", ".join(_arguments("with_reversal"))
        problems.append(f"{code.__name__} is bidirectional, so it needs with_reversal({arguments})")
    if problems:
        return code, problems
    if code.templates is None:
        file = inspect.getsourcefile(code)
        code.templates = Path(file).resolve().parent / "templates" if file else None
    if not isinstance(code.templates, Path) or not (code.templates / name / "format.toml").is_file():
        place = f"{code.templates}/{name}" if code.templates else f"templates/{name}"
        return code, [f"its folder {place} with format.toml and the templates is missing"]
    try:
        check_templates(name, code.templates)
    except InputError as error:
        return code, [str(error)]
    return code, []


def _method_problems(code: type) -> list[str]:
    """Return the methods that the class lacks, or that cannot be called like those of the interface."""
    problems = []
    abstract: frozenset[str] = getattr(code, "__abstractmethods__", frozenset())
    missing = [item for item in vars(Controller) if item in abstract]
    further = sorted(abstract - set(missing))  # what a base class between asks for, such as read_file
    if missing or further:
        texts = [f"{item}({', '.join(_arguments(item))})" for item in missing]
        texts += [
            f"{item}({', '.join(list(inspect.signature(getattr(code, item)).parameters)[1:])})" for item in further
        ]
        problems.append(f"{code.__name__} has no {', '.join(texts)}")
    for item in vars(Controller):
        method = getattr(code, item, None)
        if item not in missing and item[0] != "_" and callable(getattr(Controller, item)):
            bound = method.__get__(object()) if inspect.isfunction(method) else method
            problems += call_problem(bound, _arguments(item), f"{code.__name__}.{item}")
    own = code.__mro__[: code.__mro__.index(Controller)]
    if not hasattr(code, "settings_class") and not any("read_settings" in vars(item) for item in own):
        problems.append(f"{code.__name__} has no settings_class, the dataclass of its settings")
    return problems + call_problem(code, _BINDING, code.__name__)


#: The arguments of the class of a control.
_BINDING = ("machine", "settings")


def _arguments(method: str) -> list[str]:
    return [key for key in inspect.signature(getattr(Controller, method)).parameters if key != "self"]


#: What plug-ins may add: word, name of the dict in a file, group of entry points, registry, check.
KINDS = (
    Kind("control", "CONTROLLERS", "compgen.controllers", CONTROLLERS, check_control),
    Kind("effect", "EFFECTS", "compgen.effects", EFFECTS, check_effect),
    Kind("effect family", "FAMILIES", "compgen.effect_families", FAMILIES, check_family),
    Kind("instrument", "INSTRUMENTS", "compgen.instruments", INSTRUMENTS, check_instrument),
)
CONTROLS, SIMULATED_EFFECTS, EFFECT_FAMILIES, SIMULATED_INSTRUMENTS = KINDS


def load_plugins(paths: Sequence[str | Path] = (), *, installed: bool = True) -> None:
    """Register plug-ins for this process.

    Parameters
    ----------
    paths : ``.py`` files or package folders that hold ``CONTROLLERS``, ``EFFECTS``, ``FAMILIES`` or
        ``INSTRUMENTS``.
    installed : also those of installed distributions; a broken one is skipped with a warning.

    Raises
    ------
    InputError
        with file and line for a plug-in among ``paths`` that cannot be imported or is not complete.

    Examples
    --------
    >>> from pathlib import Path
    >>> import compgen
    >>> try:
    ...     compgen.load_plugins(["my_control.py"], installed=False)
    ... except compgen.InputError as error:
    ...     print(Path(error.file).name)
    my_control.py
    """
    given = paths_of("paths", paths)
    if installed:
        load_entry_points(KINDS)
    for path in given:
        load_file(path, KINDS)


@dataclass(frozen=True)
class WithPlugins:
    """A function that another process calls with the plug-ins of this one."""

    function: Callable[[Any], Any]
    paths: tuple[str, ...]

    def __call__(self, item: Any) -> Any:
        """Load the plug-ins unless they are loaded, and call the function."""
        _load_once(self.paths)
        return self.function(item)


@cache
def _load_once(paths: tuple[str, ...]) -> None:
    load_plugins(paths)


def with_plugins(function: Callable[[Any], Any]) -> WithPlugins:
    """Wrap the function with the plug-ins that were loaded from paths."""
    origins = {origin for kind in KINDS for origin in kind.registry.origins.values() if origin.startswith(PATH_ORIGIN)}
    return WithPlugins(function, tuple(sorted(origin.removeprefix(PATH_ORIGIN) for origin in origins)))
