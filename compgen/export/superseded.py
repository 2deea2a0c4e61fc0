"""What an earlier export left in a folder: kept as ``PREVIOUS-...``, so that no old table is taken for one of the new."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence, Set
from pathlib import Path, PurePosixPath

from compgen.controllers import CONTROLLERS
from compgen.core.files import OutputFolder, sha256_of
from compgen.errors import CompgenWarning
from compgen.export.render import load_format

#: Put in front of the name of a table that was not accepted.
REJECTED_PREFIX = "NOT-ACCEPTED-"
MANIFEST = "manifest.json"
#: Files that belong to the tables that a manifest names.
COMPANY = (
    MANIFEST,
    "preflight.md",
    "result.json",
    "volume.csv",
    "explain.md",
    "check/check-program.md",
    "check/check-program.nc",
)
#: Files of a report (``dcc.xml`` is made on request); they say something about all tables of a folder.
REPORT_FILES = ("report.html", "report.json", "dossier.md", "dossier.json", "calibration.json")


def set_aside_superseded(output: OutputFolder, targets: Sequence[str] = ("",)) -> list[Path]:
    """Set aside the files of earlier exports that the new ones in ``output`` replace or contradict.

    These are tables that an earlier manifest names and that are not written now (another control, another verdict) with
    what belongs to them; tables that are no longer as their manifest says (somebody edited them); and the report. Tables
    that no manifest names stay where they are, and a warning names them.

    Parameters
    ----------
    output : holds all new files.
    targets : the sub-folders that get tables; ``""`` is the folder itself.

    Returns
    -------
    list of Path
        where the report of the earlier tables is kept.
    """
    if not output.folder.is_dir():
        return []
    names = {spec.name for control in CONTROLLERS for spec in load_format(control).files}
    new = {PurePosixPath(name): content for name, content in output.contents.items()}
    for target in dict.fromkeys(["", *targets, *_other_targets(output, targets)]):
        base = PurePosixPath(target)
        beside = {str(path.relative_to(base)): text for path, text in new.items() if path.is_relative_to(base)}
        if (output.folder / base).is_dir():
            _set_aside_in(output, base, beside, names)
    report = [
        name for name in (*REPORT_FILES, "dcc.xml") if (output.folder / name).is_file() and name not in output.contents
    ]
    return [output.set_aside(name) for name in report]


def _other_targets(output: OutputFolder, targets: Sequence[str]) -> list[str]:
    """Sub-folders with tables that an earlier run wrote for controls that this run leaves out.

    A sub-folder with an identification of its own is not part of a run in the folder above.
    """
    if "identify.json" not in output.contents:
        return []
    found = (path.parent for path in sorted(output.folder.glob(f"*/{MANIFEST}")))
    return [path.name for path in found if path.name not in targets and not (path / "identify.json").exists()]


def _set_aside_in(output: OutputFolder, base: PurePosixPath, new: Mapping[str, bytes], names: Set[str]) -> None:
    """Sort the tables in one folder, where ``new`` are the files that it gets; ``names`` are those of all controls' tables."""
    folder = output.folder / base
    known = _known_hashes(folder)
    tables = {*known, *names, *(REJECTED_PREFIX + name for name in names)}
    kept, strangers = [], []
    for path in sorted(path for path in folder.iterdir() if path.name in tables and path.is_file()):
        name, content = path.name, path.read_bytes()
        untouched = known.get(name) == sha256_of(content)
        if new.get(name) == content or (name in new and untouched):
            continue
        if name in new or name in known or _twin(name) in new:
            target = output.set_aside(str(base / name))
            if not untouched or _twin(name) not in new:
                changed = "not as an export wrote it" if not untouched else "of an earlier export"
                kept.append(f"{name} ({changed}) as {target.name}")
        else:
            strangers.append(name)
    for name in COMPANY if known else ():
        if name not in new and (folder / name).is_file():
            output.set_aside(str(base / name))
    if kept:
        warnings.warn(f"{folder}: kept {', '.join(kept)}", CompgenWarning, stacklevel=4)
    if strangers:
        text = f"{folder}: {', '.join(strangers)} are tables that this export did not write; do not load them with it"
        warnings.warn(text, CompgenWarning, stacklevel=4)


def _twin(name: str) -> str:
    """The name of the same table with the other verdict."""
    return name.removeprefix(REJECTED_PREFIX) if name.startswith(REJECTED_PREFIX) else REJECTED_PREFIX + name


def _known_hashes(folder: Path) -> dict[str, str]:
    """SHA-256 of every table by name as the manifest in ``folder`` has it; empty if there is none that can be read."""
    try:
        manifest = json.loads((folder / MANIFEST).read_bytes())
        prefix = str(manifest.get("file_prefix", ""))
        items = [*manifest["files"], *manifest.get("companions", ())]
        hashes = {prefix + str(item["name"]): str(item["sha256"]) for item in items}
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return {}
    return {name: digest for name, digest in hashes.items() if PurePosixPath(name).name == name}
