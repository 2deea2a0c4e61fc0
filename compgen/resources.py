"""Where the shipped ``templates/`` and ``machines/`` folders are."""

from __future__ import annotations

from pathlib import Path


def data_folder(kind: str) -> Path:
    """Return the folder of shipped data, ``kind`` being ``"templates"`` or ``"machines"``.

    In a wheel it lies inside the package (``_data``), in a checkout or an editable install next to it.
    """
    package = Path(__file__).resolve().parent
    candidates = (package / "_data" / kind, package.parent / kind)
    for folder in candidates:
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"no folder {kind!r} in {candidates[0]} or {candidates[1]}: the installation is incomplete")


def program_version() -> str:
    """Return the version of compgen that runs."""
    from importlib.metadata import PackageNotFoundError, version  # takes as long to load as the rest of the help

    try:
        return version("compgen")
    except PackageNotFoundError:
        return "unknown"
