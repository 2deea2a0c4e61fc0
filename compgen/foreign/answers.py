"""What the user says about a foreign file: kind, columns, units, sign, and where the part was."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from math import isfinite
from typing import Literal

from compgen.data.circles import PLANES
from compgen.data.names import AXES
from compgen.data.toml_files import option
from compgen.errors import InputError
from compgen.foreign.column_names import MM_PER_LENGTH, RAD_PER_ANGLE, covariate_unit, known_unit

Kind = Literal["axis", "lengths", "deviations", "errors", "capture", "circle", "artefact", "part", "sphere"]
KINDS: tuple[Kind, ...] = ("axis", "lengths", "deviations", "errors", "capture", "circle", "artefact", "part")
#: Answers to ``--sign`` for all tables; the others are for squareness.
TABLE_SIGNS = ("error", "correction")


@dataclass(frozen=True)
class ImportOptions:
    """Input of the user about a file; None or empty: take it from the file.

    Parameters
    ----------
    kind : contents of the file.
    columns : column of the file by field (position, deviation, direction, ...).
    units : unit by field; the field "value" is for deviations, lengths and errors.
    axis : X, Y or Z, for files that measure along one axis and do not state it.
    error : name of the error (EYX, ECX, ...) in the file, for straightness and angles.
    sign : "error" (measured minus commanded) or "correction" (what is to be added; the sign is reversed on import); of
        squareness by pairs of axes "angle-above-90", "angle-below-90" or "rotation" (as EC0Y, EB0Z, EA0Z).
    plane, radius_mm : XY, YZ or ZX, and the nominal radius, of a circular test that does not state them.
    directions : "labels", "motion" (from the order of the rows) or "alternate" (odd runs up, even runs down).
    sheet : name of the sheet of a workbook.
    decimal : decimal mark of a table, if its numbers do not show it.
    zero_runs : treatment of laser runs that are zero at every target.
    dates : order of day, month and year if they are numbers.
    ignore : columns, or sheets of a workbook, to exclude although they contain numbers.
    base_length_mm : straightness consists of differences over this length, step by step, which are summed.
    origin : machine coordinates, mm, of the zero from which the coordinates of a part or artefact count ("X,Y,Z").
    calibrated : whether the nominal places of an artefact are those of a calibration ("yes") or of a drawing ("no").
    mounted : body on which a level was.
    line : machine coordinates, mm, of the axes that stood while an axis was measured ("Y=-250,Z=-100").
    clamping : several tables of one report are features of "one" set-up, or "each" has its own.
    """

    kind: Kind | None = option(None, "What the file contains; default: recognised by its columns.")
    columns: Mapping[str, str] = option(
        factory=dict,
        text="FIELD=COLUMN: position, actual, deviation, correction, direction, run, axis; x, y, z, length, station, "
        "point; dx, dy, dz, xa, ya, za; angle, radius, plane; "
        "error, value, EBX (an error); temperature, temp_NAME, time, date, feed, load, tool_x, "
        "approach_x, repeat, line, block, setup, pose, u_value; run1+, run1-, run2 (a column of one run). May be given "
        "several times.",
        name="--map",
        metavar="FIELD=COLUMN",
    )
    units: Mapping[str, str] = option(
        factory=dict,
        text="FIELD=UNIT, e.g. deviation=um, position=mm, or UNIT alone for the values; linear=, angle= of errors. um, "
        "mm, nm, m, in; urad, mrad, arcsec, rad, deg; temp_NAME=degC, K, degF; time=s, ms, min, h; feed=mm/min; load=kg.",
        name="--unit",
        metavar="[FIELD=]UNIT",
    )
    axis: str | None = option(None, "The axis that moved.", choices=AXES)
    error: str | None = option(
        None, "Name of the error in the file (EYX, ECX, ...), for straightness and angles.", metavar="NAME"
    )
    sign: Literal["error", "correction", "angle-above-90", "angle-below-90", "rotation"] | None = option(
        None,
        "error: measured minus commanded (default if the format defines it); correction: the sign is to be reversed. Of "
        "squareness by pairs of axes, what a positive number means: angle-above-90, angle-below-90 (between the positive "
        "axes), rotation (EC0Y, EB0Z, EA0Z of ISO 230-1).",
    )
    plane: str | None = option(None, "Plane of a circular test.", choices=tuple(PLANES))
    radius_mm: float | None = option(None, "Nominal radius of a circular test, mm.")
    directions: Literal["labels", "motion", "alternate"] | None = option(
        None,
        "labels: as in the file; motion: from the order of the rows; alternate: odd runs up, even down.",
    )
    sheet: str | None = option(None, "Sheet of a workbook.", metavar="NAME")
    dates: Literal["dmy", "mdy", "ymd"] | None = option(
        None, "Order of dates such as 03/04/2025 (never guessed): day, month, year."
    )
    decimal: Literal["comma", "point"] | None = option(
        None, "Decimal mark of a table; the other one separates thousands (needed if 1,000 is ambiguous)."
    )
    zero_runs: Literal["drop", "keep"] | None = option(
        None, "Laser runs that are zero at every target: not measured (drop) or measured (keep)."
    )
    ignore: Sequence[str] = option(
        (),
        "Column, or sheet of a workbook, to exclude although it contains numbers (may be given several times).",
        metavar="NAME",
    )

    base_length_mm: float | None = option(
        None,
        "Columns of straightness contain differences (or slopes, in um/m or arcsec) over the base of a level or mirror, mm, step "
        "by step, each from its position on; they are summed.",
        name="--base-length",
        metavar="MM",
    )
    origin: str | None = option(
        None,
        "Machine coordinates (mm) of the zero from which the coordinates of a part or artefact count, such as those of "
        "G54; 0,0,0 if they are machine coordinates.",
        metavar="X,Y,Z",
    )
    calibrated: Literal["yes", "no"] | None = option(
        None, "Nominal places of an artefact: yes: from its calibration; no: from a drawing only."
    )
    clamping: Literal["one", "each"] | None = option(
        None, "Several tables of one report: features of one set-up, or each table a set-up of its own."
    )

    mounted: Literal["spindle", "table"] | None = option(
        None, "Body on which a level was: on the spindle side, or on the table; the signs are opposite."
    )

    line: str | None = option(
        None,
        "Where the laser was: machine coordinates (mm) of the axes that stood while an axis moved, such as Y=-250,Z=-100. Not "
        "stated, the run may have been anywhere in the travel, and angles add to its uncertainty.",
        metavar="Y=MM,Z=MM",
    )

    def line_mm(self) -> dict[str, float]:
        """Return where axes stood, by their letters; empty if it was not given."""
        found: dict[str, float] = {}
        for word in filter(None, (self.line or "").replace(";", ",").split(",")):
            letter, _, text = (part.strip() for part in word.partition("="))
            try:
                place = float(text)
            except ValueError:
                place = float("nan")
            if letter.upper() not in AXES or letter.upper() in found or not abs(place) < 1e5:
                message = (
                    f"{self.line!r} is not the place of a run: give each axis that stood once, in mm: Y=-250,Z=-100"
                )
                raise InputError(message, field="--line")
            found[letter.upper()] = place
        return found

    def origin_mm(self) -> tuple[float, float, float] | None:
        """Return the origin as three numbers; None if it was not given."""
        if self.origin is None:
            return None
        try:
            x, y, z = (float(word) for word in self.origin.replace(";", ",").split(","))
        except ValueError:
            x = y = z = float("nan")
        if not (isfinite(x) and isfinite(y) and isfinite(z)):
            message = f"{self.origin!r} is not X,Y,Z: three numbers in mm with decimal points, such as 175,-325,-320"
            raise InputError(message, field="--origin")
        return x, y, z

    def given(self) -> tuple[str, ...]:
        """Return the names of the fields that the user filled."""
        return tuple(item.name for item in fields(self) if getattr(self, item.name))

    @classmethod
    def flag(cls, name: str) -> str:
        """Return the option of a field."""
        (item,) = (item for item in fields(cls) if item.name == name)
        return item.metadata["name"] or f"--{name.replace('_', '-')}"

    def given_unit(
        self, *keys: str, among: Collection[str] = (*MM_PER_LENGTH, *RAD_PER_ANGLE), what: str = "length or angle"
    ) -> str | None:
        """Return the unit that the user gave for the first of some fields that has one, or None."""
        key = next((key for key in keys if self.units.get(key)), None)
        if key is None:
            return None
        given = self.units[key]
        unit = next((name for name in (known_unit(given), covariate_unit(given)) if name in among), None)
        if unit is None:
            raise InputError(f"{given!r} is not a unit of {what}; use {', '.join(among)}", field=f"--unit {key}")
        return unit
