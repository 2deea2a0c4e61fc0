"""What a file is, by its first bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from compgen.controllers.isg.etalon_exchange import is_exchange_text
from compgen.core.axis_runs import AxisRuns
from compgen.core.deviations import Deviations
from compgen.core.parts import MEASURED_COLUMNS
from compgen.errors import CompgenError, InputError
from compgen.imports.capture import MOST_BYTES as MOST_CAPTURE
from compgen.imports.capture import is_capture
from compgen.imports.columns import check_field
from compgen.imports.ecmc import is_ecmc
from compgen.imports.grid import grid_of_text, holds_readings
from compgen.imports.instruments import import_capture, import_ecmc, import_exchange, import_renishaw
from compgen.imports.renishaw import REFUSED, is_renishaw_text
from compgen.imports.result import Imported, ImportOptions
from compgen.imports.sheet import chosen_sheet, read_sheets
from compgen.imports.source import MOST_BYTES, MOST_OWN_BYTES, check_size, decode_head, read_head, read_source, shown
from compgen.imports.table_points import check_largest
from compgen.imports.tables import import_table, merged_sheets

#: Columns that make a file one of the project's own.
OWN = {
    "lengths": {"station", "point", "x_mm", "y_mm", "z_mm", "length_mm"},
    "axis": {"axis", "position_mm", "direction", "run", "deviation_um"},
    "diagonals": {"diagonal", "x_mm", "y_mm", "z_mm", "deviation_um"},
    "errors": {"error", "position_mm", "value"},
    "sixdof": {"axis", "position_mm", "displacement_mm"},
    "deviations": {"x_mm", "y_mm", "z_mm"},
}
_DEVIATIONS = {"dx_um", "dy_um", "dz_um"}
_FLAGS = {
    "columns": "--map",
    "units": "--unit",
    "axis": "--axis",
    "error": "--error",
    "sign": "--sign",
    "directions": "--directions",
    "sheet": "--sheet",
    "dates": "--dates",
    "decimal": "--decimal",
    "zero_runs": "--zero-runs",
    "ignore": "--ignore",
}
_ONE_AXIS = ("axis", "error", "sign", "directions", "dates")
#: What each format leaves to the user.
_TAKES: dict[str, tuple[str, ...]] = {
    "renishaw": ("units", *_ONE_AXIS, "zero_runs"),
    "renishaw-capture": ("dates",),
    "ecmc-iso230": _ONE_AXIS[:-1],
    "etalon-exchange": ("sign", "units"),
    "table": tuple(name for name in _FLAGS if name not in ("sheet", "zero_runs")),
    "xlsx": tuple(name for name in _FLAGS if name != "zero_runs"),
}


def own_kind(path: Path) -> str | None:
    """Return the kind of a file in the project's own format, None for a foreign one; InputError for what is no data."""
    check_size(path, MOST_CAPTURE)
    head = read_head(path)
    if head.startswith((b"PK\x03\x04", b"HEADER::", b"\xff\xfe", b"\xfe\xff")):
        return None
    lines = (line.strip() for line in decode_head(head).lstrip("\ufeff").split("\n"))
    header = next((line for line in lines if line and not line.startswith("#")), "")
    names = {name.strip().strip('"') for name in header.split(",")}
    if "y_qd1_mm" in names or "y_psd1_mm" in names:
        return "sixdof"
    if {"x_mm", "y_mm"} <= names and names & set(MEASURED_COLUMNS):
        return "part"
    for kind, needed in OWN.items():
        if needed <= names and (kind != "deviations" or names & _DEVIATIONS):
            check_size(path, MOST_OWN_BYTES)
            return kind
    return None


def form_of(path: Path) -> str:
    """Return the name of a foreign file's format."""
    check_size(path, MOST_CAPTURE)
    head = read_head(path)
    if head.startswith(b"PK\x03\x04"):
        return "xlsx"
    if is_capture(head) or path.suffix.lower() == ".rtx":
        return "renishaw-capture"
    text = decode_head(head)
    if is_renishaw_text(text) or path.suffix.lower() in REFUSED:
        return "renishaw"
    if is_ecmc(text):
        return "ecmc-iso230"
    if is_exchange_text(text.lstrip("\ufeff")):
        return "etalon-exchange"
    check_size(path, MOST_BYTES)
    return "table"


def import_file(path: str | Path, options: ImportOptions | None = None) -> Imported:
    """Import any foreign file that is known.

    Raises
    ------
    InputError
        with file, line and column for one that is damaged, cut, too large or not known.
    """
    source, chosen = Path(path), options or ImportOptions()
    form = form_of(source)
    _check_options(source, form, chosen)
    item = READERS[form](source, chosen)
    if not item.doubts and isinstance(item.data, AxisRuns | Deviations):
        check_largest(item.data.deviation_mm, item.data.origin)
    _check_ignored(source, chosen, item)
    if chosen.kind is not None and item.kind != chosen.kind:
        raise InputError(f"holds {item.kind}, not {chosen.kind}", file=source, field="--kind")
    return item


def _check_ignored(path: Path, options: ImportOptions, item: Imported) -> None:
    """Refuse a name after --ignore that is neither a column nor a sheet: it would hide what the user meant."""
    text = f"{item.understood} {item.notes}"
    for name in options.ignore:
        if name not in text:
            raise InputError(f"there is no column or sheet {name!r}", file=path, field="--ignore")


def _check_options(path: Path, form: str, options: ImportOptions) -> None:
    """Refuse what a format cannot take, and names that are none: an option that is silently ignored misleads."""
    for name, flag in _FLAGS.items():
        if getattr(options, name) and name not in _TAKES[form]:
            taken = ", ".join(_FLAGS[key] for key in _TAKES[form]) or "none"
            raise InputError(f"does not apply to a file of the format {form}; {taken} do", file=path, field=flag)
    for key in options.units:
        if form == "renishaw" and key not in ("value", "deviation"):
            raise InputError("of this format only the unit of the values is open", file=path, field=f"--unit {key}")
        if form == "etalon-exchange" and key not in ("linear", "angle"):
            raise InputError("say linear= or angle= for this format", file=path, field=f"--unit {key}")
        if key not in ("value", "linear", "angle"):
            check_field(key, "--unit")


def _import_text(path: Path, options: ImportOptions) -> Imported:
    return import_table(grid_of_text(read_source(path)), options)


def _import_workbook(path: Path, options: ImportOptions) -> Imported:
    sheets, hidden = read_sheets(path, options.sheet)
    aside = tuple(f"sheet {shown(name)} is hidden and was left out; --sheet takes it" for name in hidden)
    left_out = [name for name, _ in sheets if name in options.ignore]
    aside += tuple(f"sheet {shown(name)} was left out by --ignore" for name in left_out)
    sheets = [sheet for sheet in sheets if sheet[0] not in left_out]
    if not sheets:
        raise InputError("no sheet is left to read", file=path, field="--ignore")
    one = chosen_sheet(path, sheets, options.sheet)
    if one is not None:
        item = _of_sheet(import_table(one[1], options, "xlsx"), one[0])
        return replace(item, notes=(*item.notes, *aside))
    read, reasons, open_sheets = [], [], []
    for name, grid in sheets:
        try:
            read.append((name, _of_sheet(import_table(grid, options, "xlsx"), name)))
        except CompgenError as error:
            reason = f"sheet left out: {shown(name)}: {error}"
            if holds_readings(grid):
                reason = (
                    f"sheet {shown(name)} holds numbers that are not understood ({error}); take one sheet with --sheet, or "
                    f"leave it out: --ignore {shown(name)}"
                )
                open_sheets.append(reason)
            else:
                reasons.append(reason)
    if not read:
        raise InputError(
            f"no sheet holds a table that can be read: {'; '.join([*reasons, *open_sheets])}"[:1000], file=path
        )
    item = merged_sheets(read)
    return replace(item, doubts=(*item.doubts, *open_sheets), notes=(*item.notes, *aside, *reasons))


def _of_sheet(item: Imported, name: str) -> Imported:
    return replace(item, understood={"sheet": name, **item.understood})


READERS: dict[str, Callable[[Path, ImportOptions], Imported]] = {
    "renishaw": import_renishaw,
    "renishaw-capture": import_capture,
    "ecmc-iso230": import_ecmc,
    "etalon-exchange": import_exchange,
    "xlsx": _import_workbook,
    "table": _import_text,
}
