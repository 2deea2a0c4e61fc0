"""What an import hands on: the object of the project, what was understood, and what is in doubt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from compgen.core.axis_runs import AxisRuns, format_axis_runs
from compgen.core.deviations import Deviations, format_deviations
from compgen.core.error_table import ErrorTable, format_errors
from compgen.core.lengths import Lengths, format_lengths
from compgen.core.reversal import ReversalCurves, format_reversal
from compgen.errors import InputError
from compgen.imports.capture import Capture, format_capture
from compgen.imports.dates import Order

Kind = Literal["axis", "lengths", "deviations", "errors", "capture"]
KINDS: tuple[Kind, ...] = ("axis", "lengths", "deviations", "errors", "capture")
SUFFIXES = {
    "axis": ".axis.csv",
    "lengths": ".lengths.csv",
    "deviations": ".deviations.csv",
    "errors": ".errors.csv",
    "capture": ".capture.csv",
}
Data = AxisRuns | Lengths | Deviations | ErrorTable | Capture


@dataclass(frozen=True)
class ImportOptions:
    """What the user says about a file; None or empty: take it from the file.

    Parameters
    ----------
    kind : what the file holds.
    columns : column of the file by field (position, deviation, direction, ...).
    units : unit by field; the field "value" stands for deviations, lengths and errors.
    axis : X, Y or Z, for files that measure along one axis and do not say which.
    error : name of the error (EYX, ECX, ...) that the values of a file are, for straightness and angles.
    sign : "error" (measured minus commanded) or "correction" (what is to be added; turned round on import).
    directions : "labels", "motion" (from the order of the rows) or "alternate" (odd runs up, even runs down).
    sheet : name of the sheet of a workbook.
    decimal : decimal mark of a table, where its numbers do not show it.
    zero_runs : what becomes of laser runs that are zero at every target.
    dates : order of day, month and year where the file writes them as numbers.
    ignore : columns, or sheets of a workbook, that are left out though they hold numbers.
    """

    kind: Kind | None = None
    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    axis: str | None = None
    error: str | None = None
    sign: Literal["error", "correction"] | None = None
    directions: Literal["labels", "motion", "alternate"] | None = None
    sheet: str | None = None
    dates: Order | None = None
    decimal: Literal["comma", "point"] | None = None
    zero_runs: Literal["drop", "keep"] | None = None
    ignore: Sequence[str] = ()


@dataclass(frozen=True)
class Imported:
    """A foreign file as an object of the project.

    Parameters
    ----------
    path, format : the file, and the name of its format.
    kind : which contract file it becomes.
    data : the object, mm and rad.
    understood : what was read from the file or inferred, in words and numbers.
    doubts : what the file does not settle; until the user has said it, no other command takes the file as it is.
    notes : remarks that do not stand in the way.
    reversal : difference of both directions, where ``data`` holds only their mean.
    beside : errors on other sheets of a workbook of axis runs (squareness, straightness).
    """

    path: Path
    format: str
    kind: Kind
    data: Data
    understood: Mapping[str, Any]
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    reversal: ReversalCurves | None = None
    beside: ErrorTable | None = None

    @property
    def file_name(self) -> str:
        """Name of the contract file that it becomes."""
        return f"{self.path.stem}{SUFFIXES[self.kind]}"

    def check_settled(self) -> None:
        """Raise InputError if something is in doubt, or the file holds two measurements."""
        if self.doubts:
            raise InputError(
                f"leaves open: {'; '.join(self.doubts)}. 'volcomp import' shows what was understood and takes what is "
                "missing; give its result to this command",
                file=self.path,
            )

        if self.beside is not None:
            names = ", ".join(self.beside.names)
            raise InputError(
                f"holds runs of axes and errors as well ({names}): 'volcomp import --out DIR' writes a file of each; or take one "
                "of them, with --ignore SHEET for the other",
                file=self.path,
            )

    def files(self) -> dict[str, str]:
        """Return the texts of the contract files by name."""
        found = {self.file_name: _text_of(self.data)}
        if self.reversal is not None:
            found[f"{self.path.stem}.reversal.csv"] = format_reversal(self.reversal)
        if self.beside is not None:
            found[f"{self.path.stem}{SUFFIXES['errors']}"] = format_errors(self.beside)
        return found

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``--json``."""
        return {
            "file": str(self.path),
            "format": self.format,
            "kind": self.kind,
            "understood": dict(self.understood),
            "doubts": list(self.doubts),
            "notes": list(self.notes),
        }


def _text_of(data: Data) -> str:
    if isinstance(data, AxisRuns):
        return format_axis_runs(data)
    if isinstance(data, Lengths):
        return format_lengths(data)
    if isinstance(data, Deviations):
        return format_deviations(data)
    if isinstance(data, Capture):
        return format_capture(data)
    return format_errors(data)
