"""Plug-ins: extensions of third parties, checked when they are registered.

A plug-in is a Python file, a package folder, or an entry point of an installed distribution. A file or folder contains
the same dicts as compgen itself, e.g. ``CONTROLLERS = {"my-csv": MyCsv()}``. All problems are reported when it is
registered, with the place; nothing is registered then.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from compgen.errors import CompgenWarning, InputError, Message, one_line

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Item = TypeVar("Item")
_NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
#: What the code of a plug-in may raise while it is imported; ``sys.exit`` in it must not end the program.
_FAULTS = (Exception, SystemExit)
#: Prefix of the origin of a plug-in from a path.
PATH_ORIGIN = "plug-in "


class Registry(MutableMapping[str, Item]):
    """The items of the program and its plug-ins by name.

    Attributes
    ----------
    origins : the source of each item of a plug-in, by name.
    broken : why an entry point of an installed distribution is unavailable, by name.
    """

    def __init__(self, built_in: Mapping[str, Item] | None = None) -> None:
        self._items: dict[str, Item] = dict(built_in or {})
        self.origins: dict[str, str] = {}
        self.broken: dict[str, str] = {}

    def __getitem__(self, name: str) -> Item:
        return self._items[name]

    def __setitem__(self, name: str, item: Item) -> None:
        self._items[name] = item

    def __delitem__(self, name: str) -> None:
        del self._items[name]

    def __contains__(self, name: object) -> bool:
        return name in self._items

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(self)}>"


def why_missing(broken: Mapping[str, str], name: str) -> str:
    """Return the reason, for the end of a message, if the entry point of ``name`` is broken."""
    return f"; {broken[name]}" if name in broken else ""


@dataclass(frozen=True)
class Kind:
    """One kind of item that plug-ins may add.

    Parameters
    ----------
    word : its name in messages, e.g. ``"control"``.
    attribute : name of the dict in a plug-in's file, e.g. ``"CONTROLLERS"``.
    group : group of entry points, e.g. ``"compgen.controllers"``.
    registry : the registry for it.
    check : takes name and item, returns the item to register and all its problems, in words.
    """

    word: str
    attribute: str
    group: str
    registry: Registry[Any]
    check: Callable[[str, Any], tuple[Any, list[str]]]

    def register(self, name: str, thing: Any, origin: str) -> None:
        """Add an item of the plug-in ``origin``; InputError with all its problems."""
        thing, problems = self.check(name, thing) if isinstance(name, str) else (thing, [])
        if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name) > 40:
            text = "its name must be lower-case letters and digits with single '-' between them, e.g. 'my-csv'"
            problems = [text, *problems]
        elif name in self.registry:
            problems = [
                f"the name is already used by {self.registry.origins.get(name, 'a built-in one')}; choose another",
                *problems,
            ]
        if problems:
            code = thing if inspect.isclass(thing) or inspect.isroutine(thing) else type(thing)
            try:  # where the code of the item begins, if known
                file, line = inspect.getsourcefile(code), inspect.getsourcelines(code)[1]
            except (OSError, TypeError):
                file, line = None, None
            what = f"{origin}: the {self.word} {name!r} cannot be registered: {'; '.join(problems)}"
            raise InputError(what, file=file, line=line)
        self.registry[name] = thing
        self.registry.origins[name] = origin


def call_problem(function: Any, arguments: Sequence[str], what: str) -> list[str]:
    """Return what is wrong if ``function`` cannot be called with these arguments, in order and by name."""
    expected = f"{what}({', '.join(arguments)})"
    if not callable(function):
        return [f"{expected} is missing" if function is None else f"{what} is not a function; expected {expected}"]
    try:
        signature = inspect.signature(function)
        signature.bind(*arguments)
        return []
    except (TypeError, ValueError):
        return [f"{what}{signature} cannot be called as {expected}"]


def load_file(path: str | Path, kinds: Sequence[Kind]) -> None:
    """Import the plug-in in a ``.py`` file or package folder and register its contents; a second call does nothing."""
    source = Path(path).resolve()
    file = source / "__init__.py" if source.is_dir() else source
    if not file.is_file():
        raise InputError(
            Message("plugin-missing", "no such plug-in; give a .py file or a folder with an __init__.py"), file=file
        )
    if file.suffix != ".py":
        raise InputError(
            Message(
                "plugin-no-python", "is not a Python file; a plug-in is a .py file or a folder with an __init__.py"
            ),
            file=file,
        )
    origin = f"{PATH_ORIGIN}{source}"
    if any(origin in kind.registry.origins.values() for kind in kinds):
        return
    name = f"compgen_plugin_{hashlib.sha256(str(file).encode()).hexdigest()[:12]}"
    module = _import(name, file, source.is_dir(), origin)
    found: list[tuple[Kind, str, Any]] = []
    for kind in kinds:
        things = getattr(module, kind.attribute, None)
        if things is not None and not isinstance(things, Mapping):
            raise InputError(
                Message(
                    "plugin-no-dict",
                    "{origin}: {attribute} must be a dict from names to {word}s",
                    origin=origin,
                    attribute=kind.attribute,
                    word=kind.word,
                ),
                file=file,
            )
        found += [(kind, name, thing) for name, thing in (things or {}).items()]
    if not found:
        dicts = ", ".join(f"{kind.attribute} ({kind.word}s by name)" for kind in kinds)
        raise InputError(
            Message(
                "plugin-empty",
                "{origin} contains nothing to register; expected at least one dict: {dicts}",
                origin=origin,
                dicts=dicts,
            ),
            file=file,
        )
    with restored(kinds, only_after_errors=True):
        for kind, name, thing in found:
            kind.register(name, thing, origin)


def _import(name: str, file: Path, package: bool, origin: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        name, file, submodule_search_locations=[str(file.parent)] if package else None
    )
    assert isinstance(spec, ModuleSpec) and spec.loader is not None  # true for every .py file
    module = importlib.util.module_from_spec(spec)
    _forget(name)
    sys.modules[name] = module  # needed by dataclasses and relative imports
    try:
        spec.loader.exec_module(module)
    except _FAULTS as error:
        _forget(name)
        raise _import_error(error, origin, file) from error
    return module


def _forget(name: str) -> None:
    """Remove a plug-in and its parts from the loaded modules, so that they are read again."""
    for loaded in [key for key in sys.modules if key == name or key.startswith(f"{name}.")]:
        del sys.modules[loaded]


def _import_error(error: BaseException, origin: str, file: Path | None) -> InputError:
    """Return the error with file and line: of the syntax error, otherwise the innermost line of the plug-in's code."""
    message = f"{origin} cannot be imported: {type(error).__name__}: {one_line(error)}"
    if isinstance(error, SyntaxError) and error.filename:
        return InputError(message, file=error.filename, line=error.lineno)
    folder = file.parent if file else None
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if path.is_file() and (folder is None or path.resolve().is_relative_to(folder)):
            return InputError(message, file=path, line=frame.lineno)
    return InputError(message, file=file)


def load_entry_points(kinds: Sequence[Kind]) -> None:
    """Register the entry points of installed distributions; a broken one gives a warning, and its name is unavailable."""
    from importlib.metadata import entry_points  # imported here: slow to load, and few installations have plug-ins

    installed = entry_points()
    for kind in kinds:
        for entry in installed.select(group=kind.group):
            if kind.registry.origins.get(entry.name) != _origin(entry):
                origin = _origin(entry)
                try:
                    try:
                        thing = entry.load()
                    except _FAULTS as error:
                        raise _import_error(error, origin, None) from error
                    kind.register(entry.name, thing, origin)
                except InputError as error:
                    if entry.name not in kind.registry:
                        kind.registry.broken[entry.name] = str(error)
                    warnings.warn(
                        Message("plugin-left-out", "left out: {error}", error=error), CompgenWarning, stacklevel=4
                    )


def _origin(entry: EntryPoint) -> str:
    package = f" of {entry.dist.name} {entry.dist.version}" if entry.dist else ""
    return f"entry point {entry.name} = {entry.value}{package}"


@contextmanager
def restored(kinds: Sequence[Kind], *, only_after_errors: bool = False) -> Iterator[None]:
    """Remove what the block added to the registries, always or only after an error."""
    before = [(item, set(item)) for kind in kinds for item in (kind.registry, kind.registry.origins)]
    failed = True
    try:
        yield
        failed = False
    finally:
        if failed or not only_after_errors:
            for item, names in before:  # existing names are never replaced
                for added in set(item) - names:
                    del item[added]
