"""What the installed package has on disk: shipped folders, its version, and the public names of its rooms."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any


def data_folder(kind: str) -> Path:
    """Return the folder of shipped data, ``kind`` being ``"templates"`` or ``"machines"``.

    In a wheel it is inside the package (``_data``), in a checkout or an editable install next to it.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "_data" / kind, package.parent / kind)
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no folder {kind!r} in {candidates[0]} or {candidates[1]}: the installation is incomplete")


def cache_folder(kind: str) -> Path:
    """Folder for what can be made again, in the user's cache folder; nothing is written next to the program.

    Some of it is code that is loaded again, so the environment cannot name a folder below the working folder.
    """
    if sys.platform == "win32":
        base, usual = Path(os.environ.get("LOCALAPPDATA", "")), Path.home() / "AppData" / "Local"
    else:
        base, usual = Path(os.environ.get("XDG_CACHE_HOME", "")), Path.home() / ".cache"
    return (base if base.is_absolute() else usual) / "compgen" / kind


def _languages() -> tuple[str, ...]:
    """Return English, the language of the program, and every language that has a compiled catalogue."""
    catalogues = data_folder("templates") / "_language"
    return ("en", *sorted(path.stem for path in catalogues.glob("*.mo")))


#: Languages of pages and of lists for the machine; the first one is that of the program. A catalogue adds one, nothing else.
LANGUAGES = _languages()

#: The only place of the version: the metadata of the package and the documentation take it from here.
VERSION = "0.1.0"


def program_version() -> str:
    """Return the version of the running compgen."""
    return VERSION


def on_first_use(name: str, home: str) -> property:
    """Return a public name of a package as a property that imports its ``home`` when it is used.

    A property, and not the ``__getattr__`` of a module: importing the sub-module ``compgen.fit`` must not hide the
    function ``fit``.
    """

    def load(package: ModuleType) -> Any:
        return getattr(import_module(home), name)

    def keep(package: ModuleType, value: Any) -> None:
        # the import system sets every sub-module as an attribute of its package; the public name must keep its meaning
        if not isinstance(value, ModuleType):
            raise AttributeError(f"{package.__name__}.{name} cannot be replaced; it belongs to {home}")

    return property(load, keep)


def load_on_first_use(package: str, names: Iterable[str]) -> None:
    """Let a room import its public names on first use; a command should not wait for what it does not need.

    The ``if TYPE_CHECKING`` block of its ``__init__`` gives the modules of the names.
    """
    import ast

    module = sys.modules[package]
    imports = [node for node in ast.walk(ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")))
               if isinstance(node, ast.ImportFrom)]  # fmt: skip
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}
    module.__class__ = type("Room", (ModuleType,), {name: on_first_use(name, homes[name]) for name in names})
