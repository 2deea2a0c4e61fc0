"""What a control of a plug-in must have; everything that is missing is said at once, when it is registered."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from compgen.controllers import Controller
from compgen.core.plugins import call_problem
from compgen.errors import InputError
from compgen.export.render import check_templates

#: Methods without and with a default in the base class.
_REQUIRED = tuple(name for name in vars(Controller) if name in Controller.__abstractmethods__)
_OPTIONAL = tuple(
    name
    for name, item in vars(Controller).items()
    if inspect.isfunction(item) and not name.startswith("_") and name not in _REQUIRED
)


def check_control(name: str, thing: Any) -> tuple[Any, list[str]]:
    """Return the control (an instance, made of a class if need be) and what is wrong with it."""
    code = thing if inspect.isclass(thing) else type(thing)
    if not issubclass(code, Controller):
        return thing, ["it is no subclass of compgen.controllers.Controller"]
    problems = _method_problems(code)
    if inspect.isclass(thing) and not problems:
        try:
            thing = code()
        except Exception as error:  # code of a third party
            return code, [f"{code.__name__}() fails: {type(error).__name__}: {error}"]
    problems += _attribute_problems(name, code)
    if not problems:
        if thing.templates is None:
            thing.templates = _folder_beside(code)
        problems += _template_problems(name, thing.templates)
    return thing, problems


def _method_problems(code: type) -> list[str]:
    problems = []
    missing = [f"{item}({', '.join(_arguments(item))})" for item in _REQUIRED if item in _abstract(code)]
    if missing:
        problems.append(f"{code.__name__} has no {', '.join(missing)}")
    for item in (*_REQUIRED, *_OPTIONAL):
        if item not in _abstract(code):
            method = getattr(code, item, None)
            bound = method.__get__(object()) if inspect.isfunction(method) else method
            problems += call_problem(bound, _arguments(item), f"{code.__name__}.{item}")
    return problems


def _abstract(code: type) -> frozenset[str]:
    return getattr(code, "__abstractmethods__", frozenset())


def _arguments(method: str) -> list[str]:
    return list(inspect.signature(getattr(Controller, method)).parameters)[1:]


def _attribute_problems(name: str, code: type) -> list[str]:
    problems = []
    own = getattr(code, "name", None)
    if own != name:
        problems.append(f"{code.__name__}.name has to be {name!r}, it is {'missing' if own is None else repr(own)}")
    for item in ("anchored", "bidirectional"):
        if not isinstance(getattr(code, item), bool):
            problems.append(f"{code.__name__}.{item} has to be True or False")
    if code.bidirectional is True and code.with_reversal is Controller.with_reversal:  # type: ignore[attr-defined]
        problems.append(
            f"{code.__name__} is bidirectional, so it needs with_reversal({', '.join(_arguments('with_reversal'))})"
        )
    return problems


def _folder_beside(code: type) -> Path | None:
    file = inspect.getsourcefile(code)
    return Path(file).resolve().parent / "templates" if file else None


def _template_problems(name: str, folder: Any) -> list[str]:
    if not isinstance(folder, Path) or not (folder / name / "format.toml").is_file():
        place = f"{folder}/{name}" if folder else f"templates/{name}"
        return [f"its folder {place} with format.toml and the templates is missing"]
    try:
        check_templates(name, folder)
    except InputError as error:
        return [str(error)]
    return []
