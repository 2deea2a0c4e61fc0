"""What a folder of results contains, read back for the report, and the tables of each control in its own basis."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from compgen.controls import CONTROLLERS, controller_named
from compgen.controls.shared.base import Term
from compgen.data.circles import DIAGRAM, Circles, circles_of_columns
from compgen.data.csv_files import FloatArray, read_csv
from compgen.data.error_table import ErrorTable, read_errors
from compgen.data.files import REJECTED_PREFIX, read_bytes, read_text, sha256_of
from compgen.data.lengths import Points
from compgen.data.machine import Machine, read_machine
from compgen.data.names import AXES, CURVE_NAMES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.data.rotary import read_machine_errors
from compgen.errors import CompgenError, CompgenWarning, InputError, one_line
from compgen.identification.any_measurement import MEASURED_WITH
from compgen.pipeline import NOT_MADE
from compgen.report.rotary_axes import of_rotary_axes
from compgen.tables import ReadTables, read_tables
from compgen.tables.synthesis import projector
from compgen.tables.verification import ERROR_DECIMALS, POSITION_DECIMALS, Verification

if TYPE_CHECKING:
    from compgen.report.dcc.laboratory import Certificate

# The contents of a folder that ``run``, ``identify``, ``verify`` or ``compare`` wrote, read back for the report.


Kind = Literal["run", "identify", "verify", "compare", "accuracy"]

#: Files that show what the folder contains.
MARKS = ("result.json", "identify.json", "compare.json", "accuracy.json")
#: Lines and characters of a controller file that the report shows.
PREVIEW_LINES, PREVIEW_CHARACTERS = 40, 4000
#: Raised if machine file, errors and tables of a folder no longer match. The figures are in result.json; only what
#: needs the tables themselves is omitted.
UNFIT = (CompgenError, ValueError, ArithmeticError, LookupError, OSError)
#: A larger JSON file is not a result of compgen.
MOST_JSON = 50_000_000


@dataclass(frozen=True)
class Volume:
    """Error of the tool tip before and after, mm, shapes (n, 3), at commanded positions (n, 3), mm."""

    position_mm: FloatArray
    before_mm: FloatArray
    after_mm: FloatArray


@dataclass(frozen=True)
class ListedFile:
    """One file for the control as it is in the folder.

    ``preview`` is its beginning; ``intact`` is None if its hash is unknown.
    """

    name: str
    path: Path
    size: int
    sha256: str
    lines: int
    preview: str
    cut: bool
    intact: bool | None


@dataclass(frozen=True)
class ControlFolder:
    """What the folder contains for one control: ``result.json``, ``manifest.json``, ``preflight.md``, files and the volume.

    ``tables`` are the files read back with ``machine``, which has the settings of the export; None if they cannot be
    read with it.
    """

    name: str
    folder: Path
    result: Mapping[str, Any]
    manifest: Mapping[str, Any]
    preflight: str
    files: tuple[ListedFile, ...]
    volume: Volume | None
    machine: Machine | None = None
    tables: ReadTables | None = None

    def correction(self, points: Points) -> FloatArray:
        """Return what the tables add at points, (n, 3), mm."""
        assert self.machine is not None and self.tables is not None
        return self.tables.mean_correction(self.machine, points.position_mm)


@dataclass(frozen=True)
class ReadingResiduals:
    """Residuals of the readings, mm, shape (n,); ``station`` and commanded ``position_mm`` (n, 3) if known.

    ``stated`` is what the measurement states about instrument and operator.
    """

    residual_mm: FloatArray
    used: NDArray[np.bool_]
    station: tuple[str, ...] = ()
    position_mm: FloatArray | None = None
    stated: Mapping[str, str] = field(default_factory=dict)
    circles: Circles | None = None


@dataclass(frozen=True)
class ResultFolder:
    """All input of the report; what the folder does not contain is empty or None."""

    folder: Path
    kind: Kind
    identify: Mapping[str, Any] = field(default_factory=dict)
    identified: ErrorTable | None = None
    fitted: ErrorTable | None = None
    fit: Mapping[str, Any] = field(default_factory=dict)
    machine: Machine | None = None
    residuals: ReadingResiduals | None = None
    controls: tuple[ControlFolder, ...] = ()
    accuracy: Mapping[str, Any] = field(default_factory=dict)
    compare: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    certificate: Certificate | None = None


#: What only the laboratory knows; a copy lies in the folder, so that the report can be made again.
CERTIFICATE = "certificate.toml"
#: Tables as a run has read them back, and their verification, by control.
KnownTables = Mapping[str, tuple[ReadTables, Verification]]


def read_folder(
    folder: str | Path, known: KnownTables | None = None, certificate: str | Path | None = None
) -> ResultFolder:
    """Read the results in ``folder``; nothing outside it is read.

    ``known`` are tables and volumes that the run which wrote the folder still has: they are not read once more.
    ``certificate`` is the file that states customer, machine and instruments; by default ``certificate.toml`` of the folder.

    Raises
    ------
    InputError
        if the folder does not exist, has no result, or has a file that cannot be read.
    """
    base = Path(folder)
    if not base.is_dir():
        raise InputError("no such folder; the report needs one that run, identify, verify or compare wrote", file=base)
    # Folders of single controls that a run for several of them made.
    control_folders = (
        [base]
        if (base / "result.json").is_file()
        else sorted(path.parent for path in base.glob("*/result.json") if (path.parent / "manifest.json").is_file())
    )
    kind = _kind(base, control_folders)
    notes: list[str] = []
    machine = _machine(base, notes)
    for path in sorted(base.glob(f"*/{NOT_MADE}")):  # a control whose tables could not be made beside those of others
        notes.append(f"{path.parent.name}: no tables: {read_text(path).strip()}")
    identify = _json(base / "identify.json")
    read_identified = _linear_errors if of_rotary_axes(identify) else _errors
    # Accepted tables first, partial ones after those, rejected ones last.
    return ResultFolder(
        base,
        kind,
        identify=identify,
        identified=read_identified(base / "identified.errors.csv"),
        fitted=_errors(base / "fitted.errors.csv"),
        fit=_json(base / "fit.json"),
        machine=machine,
        residuals=_residuals(base / "residuals.csv"),
        controls=tuple(
            sorted(
                (_control(path, machine, known or {}) for path in control_folders),
                key=lambda c: (not c.result.get("accepted"), bool(c.result.get("partial")), c.name),
            )
        ),
        accuracy=_json(base / "accuracy.json"),
        compare=_json(base / "compare.json"),
        notes=tuple(notes),
        certificate=_certificate(base, certificate),
    )


def _certificate(base: Path, given: str | Path | None) -> Certificate | None:
    own = base / CERTIFICATE
    if given is None and not own.is_file():
        return None
    from compgen.report.dcc.laboratory import read_certificate

    return read_certificate(given or own, complete=False)


def _kind(base: Path, controls: list[Path]) -> Kind:
    if (base / "compare.json").is_file():
        return "compare"
    identified = (base / "identify.json").is_file()
    if controls and (identified or (base / "manifest.json").is_file()):
        return "run"
    if controls:
        return "verify"
    if identified:
        return "identify"
    if (base / "accuracy.json").is_file():
        return "accuracy"
    raise InputError(
        f"contains none of {', '.join(MARKS)}; give a folder that run, identify, verify or compare wrote", file=base
    )


def _json(path: Path) -> dict[str, Any]:
    """Return the contents of a JSON object; empty if there is no such file."""
    if not path.is_file():
        return {}
    content = read_bytes(path, MOST_JSON + 1)
    if len(content) > MOST_JSON:
        raise InputError(
            f"is larger than {MOST_JSON // 1_000_000} MB; compgen does not write files of that size", file=path
        )
    try:
        data = json.loads(content.decode("utf-8-sig"))
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {one_line(error)}", file=path) from error
    if not isinstance(data, dict):
        raise InputError("does not contain a JSON object", file=path)
    return data


def _errors(path: Path) -> ErrorTable | None:
    return read_errors(path) if path.is_file() else None


def _linear_errors(path: Path) -> ErrorTable | None:
    """The errors of X, Y, Z beside those of rotary axes; None if the file has none."""
    table = read_machine_errors(path)[0] if path.is_file() else None
    return table if table is not None and table.names else None


def _machine(base: Path, notes: list[str]) -> Machine | None:
    path = base / "machine.toml"
    if not path.is_file():
        return None
    try:
        return read_machine(path)
    except InputError as error:
        notes.append(f"machine.toml cannot be used: {error.message}")
        return None


def _residuals(path: Path) -> ReadingResiduals | None:
    if not path.is_file():
        return None
    table = read_csv(path, ("residual_um", "used"), ("station", "x_mm", "y_mm", "z_mm", *DIAGRAM))
    used = table.numbers("used") > 0.5
    residual_mm = table.numbers("residual_um") * 1e-3
    stated = {key: table.metadata[key] for key in MEASURED_WITH if table.metadata.get(key)}
    if "station" not in table.columns:
        return ReadingResiduals(residual_mm, used, stated=stated, circles=circles_of_columns(table))
    position_mm = np.column_stack([table.numbers(f"{axis}_mm") for axis in "xyz"])
    return ReadingResiduals(residual_mm, used, tuple(table.text("station")), position_mm, stated)


def read_volume(path: Path) -> Volume | None:
    """Return the contents of ``volume.csv``, None if there is no such file."""
    if not path.is_file():
        return None
    names = [f"{when}_{axis}_um" for when in ("before", "after") for axis in "xyz"]
    table = read_csv(path, ("x_mm", "y_mm", "z_mm", *names))
    position_mm = np.column_stack([table.numbers(f"{axis}_mm") for axis in "xyz"])
    values_mm = np.column_stack([table.numbers(name) for name in names]) * 1e-3
    return Volume(position_mm, values_mm[:, :3], values_mm[:, 3:])


def _as_written(result: Verification) -> Volume:
    """The numbers of ``volume.csv``."""
    before_um, after_um = (part / MM_PER_UM for part in (result.error_before_mm, result.error_after_mm))
    before_mm, after_mm = (np.round(part, ERROR_DECIMALS) * 1e-3 for part in (before_um, after_um))
    return Volume(np.round(result.position_mm, POSITION_DECIMALS), before_mm, after_mm)


def _control(folder: Path, machine: Machine | None, known: KnownTables) -> ControlFolder:
    result, manifest = _json(folder / "result.json"), _json(folder / "manifest.json")
    preflight = folder / "preflight.md"
    text = read_text(preflight) if preflight.is_file() else ""
    files, name = tuple(_files(folder, result)), str(result.get("controller", folder.name))
    volume = _as_written(known[name][1]) if name in known else read_volume(folder / "volume.csv")
    found = ControlFolder(name, folder, result, manifest, text, files, volume)
    if machine is None or not files or name not in CONTROLLERS:
        return found
    settings = manifest.get("settings")  # options of the run may differ from the machine file
    try:
        for key, value in (settings if isinstance(settings, dict) else {}).items():
            machine = machine.with_setting(name, key, value)
        if name in known:
            tables = replace(known[name][0], controller=controller_named(name)(machine))
        else:
            tables = read_tables(machine, [item.path for item in files], name)
    except UNFIT:
        return found
    return replace(found, machine=machine, tables=tables)


def _files(folder: Path, result: Mapping[str, Any]) -> list[ListedFile]:
    """Return the control's files that ``result.json`` lists and that are in its folder; never a path outside the folder."""
    found = []
    listed = result.get("files", [])
    if isinstance(listed, dict):  # of rotary axes: hash by name, the prefix of rejected files apart
        rejected = "" if result.get("accepted") else REJECTED_PREFIX
        listed = [{"name": f"{rejected}{name}", "sha256": digest} for name, digest in listed.items()]
    for item in listed:
        name = str(item.get("name", "")) if isinstance(item, dict) else ""
        path = folder / name
        if not name or Path(name).name != name or not path.is_file():
            continue
        content = read_bytes(path)
        lines = content.decode("utf-8", "replace").splitlines()
        preview = "\n".join(lines[:PREVIEW_LINES])[:PREVIEW_CHARACTERS]
        cut = len(lines) > PREVIEW_LINES or len("\n".join(lines[:PREVIEW_LINES])) > PREVIEW_CHARACTERS
        digest = sha256_of(content)
        known = item.get("sha256")
        intact = digest == known if isinstance(known, str) else None
        if intact is False:
            message = f"{path} is not the file that was verified: its SHA-256 differs from the one in result.json"
            warnings.warn(message, CompgenWarning, stacklevel=2)
        found.append(ListedFile(name, path, len(content), digest, len(lines), preview, cut, intact))
    return found


# What the tables of a control contain, in its own basis, from the files of the folder.


@dataclass(frozen=True)
class TableCurve:
    """Values of one table of a control over its axis, ``unit`` um or urad.

    ``error`` is True if the table contains one of the 21 errors, otherwise it contains a correction. A constant has no
    axis and one value.
    """

    name: str
    axis: str | None
    position_mm: FloatArray
    value: FloatArray
    unit: str
    error: bool


def table_curves(errors: ErrorTable | None, control: ControlFolder) -> tuple[TableCurve, ...]:
    """Return the tables of a control as they act: its emulation, expressed in the basis of its tables.

    The values reproduce the emulated correction over the volume best, which is all that can be known if one table of a
    control can replace another. Empty if errors are missing or the files cannot be read.
    """
    machine, tables = control.machine, control.tables
    if machine is None or tables is None or errors is None:
        return ()
    try:
        basis = tables.controller.basis_of(errors, tables.tables)
        solver = projector(machine, basis, anchored=tables.controller.anchored)
        start = np.concatenate([term.start for term in basis])
        values = solver.by_name(solver.project(tables.mean_correction(machine, solver.position_mm), start))
        return tuple(_curve(term, values[term.name]) for term in basis)
    except UNFIT:
        return ()


def _curve(term: Term, values: FloatArray) -> TableCurve:
    axis = None if term.axis is None else AXES[term.axis]
    named = term.name in CURVE_NAMES or term.name in SQUARENESS_NAMES
    if named:
        unit, scale = error_named(term.name).unit, 1.0 / error_named(term.name).si_per_unit
    else:
        angular = any(part.lever is not None for part in term.carrier)
        unit, scale = ("urad", 1e6) if angular else ("um", 1e3)
    return TableCurve(term.name, axis, np.asarray(term.nodes_mm), np.asarray(values) * scale, unit, named)
