"""What the installed package has on disk: shipped folders, its version, and the public names of its rooms."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
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


def homes_of(package: str) -> dict[str, str]:
    """Public names of a package -> the module that defines each: the imports below ``if TYPE_CHECKING`` of its source."""
    import ast  # here: `import compgen` alone needs none of it

    source = Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8")
    blocks = [node for node in ast.parse(source).body
              if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]  # fmt: skip
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def on_first_use(package: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package that imports its public names on first use.

    A command should not wait for what it does not need. The block ``if TYPE_CHECKING`` of the package says which module each
    name comes from, for type checkers and for this function. No module below the package may have the name of a function:
    its import would hide the function.
    """
    homes: dict[str, str] = {}

    def load(name: str) -> Any:
        if not homes:
            homes.update(homes_of(package))
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, found)
        return found

    return load
