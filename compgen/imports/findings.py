"""What is found out about one table while it is read: the units that count, what was understood, what is in doubt."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.errors import InputError
from compgen.imports.columns import MM_PER_LENGTH, RAD_PER_ANGLE, Column, known_unit
from compgen.imports.grid import Table
from compgen.imports.hypotheses import ABSURD_DECADES, Verdict, decades_off, unit_of_deviations, unit_of_positions
from compgen.imports.result import ImportOptions
from compgen.imports.run_names import is_deviation
from compgen.imports.source import parse_number, shown

#: A unit in brackets, after the word "in" (en, em), or at the end of a line.
_UNIT_IN_TEXT = re.compile(r"[\[(]([^\])]{1,8})[\])]|\b(?:in|en|em)\s+(\S{1,6})|\s([u\u00b5\u03bc]m|mm)\s*$")
#: Units that are weighed when a file says none.
_LENGTHS = {name: MM_PER_LENGTH[name] for name in ("um", "mm", "nm", "in")}
_ANGLES = {name: RAD_PER_ANGLE[name] for name in ("urad", "mrad", "arcsec", "deg")}


@dataclass
class Findings:
    """One table being read; ``fields`` holds its columns by field, ``used`` the names of columns that gave values.

    ``letter`` is the axis by the names of the columns.
    ``checked_sign`` says that a second column has shown the sign of the values; ``runs`` are the columns of a run each.
    """

    table: Table
    fields: Mapping[str, Column]
    options: ImportOptions
    understood: dict[str, Any] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    letter: str | None = None
    checked_sign: bool = False
    runs: list[str] = field(default_factory=list)

    def numbers(self, key: str) -> FloatArray:
        """Return the column of a field as it stands (rows,)."""
        return np.array(self.table.numbers(self.fields[key].name))

    def is_numeric(self, name: str) -> bool:
        """Whether at least half of the filled cells of a column are numbers; False for an empty one."""
        filled = [cell for cell in self.table.column(name) if cell]
        return bool(filled) and 2 * sum(parse_number(cell) is not None for cell in filled) >= len(filled)

    def given_unit(self, key: str, *, value: bool = False) -> str | None:
        """Return the unit that the user gave for a field (``value``: also by the word value), or None."""
        given = self.options.units.get(key) or (self.options.units.get("value") if value else None)
        if given is None:
            return None
        unit = known_unit(given)
        if unit is None:
            allowed = ", ".join([*MM_PER_LENGTH, *RAD_PER_ANGLE])
            raise InputError(f"{given!r} is no unit; {allowed} are", field="--unit")
        return unit

    def positions_mm(self, key: str, values: FloatArray) -> FloatArray:
        """Return positions in mm: by the user's word, the column's name, else by their size."""
        unit = self.given_unit(key) or self.given_unit("position") or self.fields[key].unit
        if unit is None:
            judged = unit_of_positions(float(np.ptp(values)))
            inches = self._inches()
            if inches and judged.best != "in":
                self.doubts.append(
                    f"{inches} is in inches, and no unit of {key} stands in the file; give --unit {key}=in or mm"
                )
            unit = judged.best if inches else self._weighed(f"unit of {key}", judged)
        self._length(unit, key)
        self.understood.setdefault("position_unit", unit)
        return values * MM_PER_LENGTH[unit]

    def _inches(self) -> str | None:
        """Return the first field that is said to be in inches; positions are then probably so too."""
        said = {key: known_unit(unit) for key, unit in self.options.units.items()}
        said |= {shown(column.name): column.unit for column in self.fields.values() if column.unit}
        return next((key for key, unit in said.items() if unit in ("in", "mil")), None)

    def values_si(self, key: str, name: str, values: FloatArray, usual_si: float, *, angular: bool) -> FloatArray:
        """Return deviations in mm or rad: by the user's word, the column's name, else by their size.

        A declared unit is doubted where it makes the data absurdly large or small and another one does not.
        """
        units = RAD_PER_ANGLE if angular else MM_PER_LENGTH
        column = self.fields.get(key)
        given = self.given_unit(key, value=True)
        unit = given or (column.unit if column else None) or self._unit_in(name)
        judged = unit_of_deviations(values, _ANGLES if angular else _LENGTHS, usual_si)
        if unit is None:
            unit = self._weighed(f"unit of {key}", judged)
        elif unit not in units:
            raise InputError(
                f"{name!r} is in {unit}; a unit of {'angle' if angular else 'length'} is due", field="--unit"
            )
        elif given is None and abs(decades_off(values, units[unit], usual_si)) > ABSURD_DECADES and judged.best != unit:
            self.doubts.append(f"{name!r} says {unit}, but the numbers look like {judged.best}; give --unit {key}=...")
        self.understood["unit"] = unit
        return values * units[unit]

    def _unit_in(self, name: str) -> str | None:
        """Return the unit above the table: ``Unit: um``, or the one in a line that speaks of deviations, if it is one."""
        metadata = self.table.metadata
        from_metadata = next((v for k, v in metadata.items() if k in ("unit", "units", "einheit")), None)
        if from_metadata:
            return known_unit(from_metadata)
        lines = [f"{key} {text}" for key, text in metadata.items()]
        found = {
            known_unit("".join(part)) for line in lines if is_deviation(line) for part in _UNIT_IN_TEXT.findall(line)
        }
        return found.pop() if len(found - {None}) == 1 and len(found) == 1 else None

    def _weighed(self, what: str, judged: Verdict) -> str:
        key = what.rpartition(" ")[2]
        if judged.sure:
            self.notes.append(f"no {what} stands in the file; by the size of the numbers {judged.text()}")
        else:
            self.doubts.append(f"no {what} stands in the file ({judged.text()}); give --unit {key}=...")
        return judged.best

    def _length(self, unit: str, key: str) -> None:
        if unit not in MM_PER_LENGTH:
            raise self.table.grid.fail(
                f"{unit} is no length; positions of linear axes are due", None, self.fields[key].name
            )
