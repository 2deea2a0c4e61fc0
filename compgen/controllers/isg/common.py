"""Volumetric compensation of the ISG kernel (Beckhoff TwinCAT CNC TF5280): what its two file formats share.

The control reads ISO 230 errors and evaluates E = C P itself; it then takes the error off the command. The list file
says which chain, which axes and which sign. What no public document settles is a setting here and stands in the files.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from compgen.controllers.base import Controller, SourceFile, Term, Usage, coverage_violations, nodes_by_axis
from compgen.controllers.grids import uneven_nodes_mm
from compgen.controllers.isg.lis import ListFile, base_name, chain_of, is_list_file, parse_list
from compgen.controllers.isg.notes import notes
from compgen.controllers.isg.parameters import (
    CONTROL_NAMES,
    LOGICAL_NAMES,
    TOOL_NAMES,
    Field,
    ParameterFile,
    collect,
)
from compgen.controllers.isg.settings import IsgSettings, IsgTables, disagreements, list_of, read_isg_settings
from compgen.controllers.terms import error_terms
from compgen.core.csvio import FloatArray, fixed
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Chain, Machine
from compgen.core.names import AXES, ERROR_NAMES, error_named
from compgen.core.points import Points
from compgen.errors import InputError
from compgen.model.volumetric import coefficients, factor

LENGTH_DIGITS, ANGLE_DIGITS, POSITION_DIGITS = 9, 12, 6
LIST_NAME = "volcomp0.lis"
MOST_FILES = 10
#: Entries of a list file that the template writes without ``negate``.
LIST_ENTRIES = 9


def rounded(name: str, values: FloatArray) -> FloatArray:
    """Return values of an error (ISO name) rounded as they are written."""
    digits = LENGTH_DIGITS if error_named(name).kind == "linear" else ANGLE_DIGITS
    flat = [float(fixed(value, digits)) for value in np.ravel(values).tolist()]
    return np.array(flat).reshape(np.shape(values))


def term_field(term: Term, values: FloatArray) -> Field:
    """Return the control's table of one error: the term's values are the errors themselves."""
    if term.axis is None:
        return Field((), (), rounded(term.name, np.asarray(values, dtype=np.float64)[0]))
    nodes = np.array([float(fixed(node, POSITION_DIGITS)) for node in term.nodes_mm.tolist()])
    return Field((term.axis,), (nodes,), rounded(term.name, np.asarray(values, dtype=np.float64)))


def result_signs(settings: IsgSettings, listing: ListFile | None) -> FloatArray:
    """Sign, shape (3,), with which the error of each axis enters the command: -1, or +1, or 0 (set_to_zero)."""
    negate = settings.negate if listing is None else listing.negate
    blank = "" if listing is None else listing.set_to_zero
    signs = np.array([1.0 if letter in settings.reversed_axes else -1.0 for letter in AXES])
    signs[[letter in negate for letter in AXES]] *= -1.0
    signs[[letter in blank for letter in AXES]] = 0.0
    return signs


def error_of(chain: Chain, fields: Mapping[str, Field], position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
    """E = C P (squareness reference X) from parsed numbers, at positions (n, 3): shape (n, 3), mm."""
    values = {name: item.at(position_mm) for name, item in fields.items()}
    result = np.zeros((len(position_mm), 3))
    for part in coefficients(chain, "X"):
        if part.error in values:
            result[:, part.output] += part.sign * factor(part.lever, position_mm, tool_mm) * values[part.error]
    return result


class VolumetricController(Controller[IsgSettings, IsgTables]):
    """The kernel's volumetric compensation; a subclass knows one format of the parameter file.

    ``file_format`` is the control's word for it, ``parameter_file`` the name of the exported file.
    """

    file_format: str
    parameter_file: str
    tool_position: bool = False

    @abstractmethod
    def parse_parameters(self, source: SourceFile) -> ParameterFile:
        """Read one error-parameter file."""

    @abstractmethod
    def count_records(self, fields: Mapping[str, Field], constants: Mapping[str, float]) -> int:
        """Return how many rows of numbers the exported file has."""

    @abstractmethod
    def body(self, tables: IsgTables) -> dict[str, Any]:
        """Return what the template of the parameter file needs."""

    def read_settings(self, machine: Machine) -> IsgSettings:
        """Check the settings of the machine file."""
        return read_isg_settings(machine, self.name, self.tool_position)

    def basis(self, machine: Machine, settings: IsgSettings, errors: ErrorTable) -> list[Term]:
        """Return one term per error, with nodes where the curves need them; the control evaluates E = C P itself."""
        nodes = [uneven_nodes_mm(machine, errors, axis, loss_mm=settings.loss_mm) for axis in range(3)]
        return error_terms(machine, errors, nodes)

    def build(
        self, machine: Machine, settings: IsgSettings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> IsgTables:
        """Round the errors as they are written; the list file comes with them."""
        terms = {term.name: term for term in basis}
        fields = {name: term_field(terms[name], values[name]) for name in ERROR_NAMES if name in terms}
        tool = [float(fixed(value, POSITION_DIGITS)) for value in machine.tool_offset_mm]
        constants = dict(zip(TOOL_NAMES, tool, strict=True)) if settings.write_tool_position and any(tool) else {}
        return IsgTables(
            fields=fields,
            constants=constants,
            records=self.count_records(fields, constants),
            files=(self.parameter_file,),
            listing=list_of(machine, settings, self.parameter_file, self.file_format),
        )

    def parse(self, machine: Machine, settings: IsgSettings, files: Sequence[SourceFile]) -> IsgTables:
        """Read parameter files, and the list file if it is among them, in any order."""
        lists = [source for source in files if is_list_file(source)]
        sources = [source for source in files if source not in lists]
        if len(lists) > 1:
            raise lists[1].fail(f"is a second list file beside {lists[0].path.name}; give one compensation at a time")
        listing = parse_list(lists[0]) if lists else None
        if not sources:
            raise InputError(f"no error-parameter file was given; {self.parameter_file} is due, {LIST_NAME} may be too")
        parts = [self.parse_parameters(source) for source in sources]
        fields, constants = collect([item for part in parts for item in part.parameters])
        return IsgTables(
            fields=fields,
            constants=constants,
            records=sum(part.records for part in parts),
            files=tuple(source.path.name for source in sources),
            listing=listing,
            remarks=tuple(
                f"{source.path.name}:{part.exponent_line} has a number with an exponent; no public document says that "
                f"the control reads it: write plain decimals"
                for source, part in zip(sources, parts, strict=True)
                if part.exponent_line is not None
            ),
        )

    def emulate(self, machine: Machine, settings: IsgSettings, tables: IsgTables, points: Points) -> FloatArray:
        """Return minus E = C P of the parsed numbers with the chain of the list file (of the machine without one).

        The tool offset is the points', else P0X, P0Y, P0Z of the file, else the machine's. Sign: ``result_signs``.
        """
        listing = tables.listing
        chain = machine.chain if listing is None else chain_of(listing, settings.chain_direction)
        position = np.asarray(points.position_mm, dtype=np.float64)
        tool = points.tool_mm if points.tool_mm is not None else self.tool_of(machine, tables)
        return error_of(chain, tables.fields, position, np.asarray(tool)) * result_signs(settings, listing) + 0.0

    @staticmethod
    def tool_of(machine: Machine, tables: IsgTables) -> FloatArray:
        """Tool offset that the control uses without a tool of its own, shape (3,), mm."""
        if any(name in tables.constants for name in TOOL_NAMES):
            return np.array([tables.constants.get(name, 0.0) for name in TOOL_NAMES])
        return np.array(machine.tool_offset_mm)

    def violations(self, machine: Machine, settings: IsgSettings, tables: IsgTables) -> list[str]:
        """Return limits that are broken, travel that is not covered, and where list and machine file disagree."""
        found = list(tables.remarks)
        if tables.records > settings.max_records:
            found.append(
                f"{tables.records} records, max_records is {settings.max_records}: the control refuses the file; raise "
                f"vol_comp[0].max_records in the start-up list and max_records in the machine file"
            )
        found += _coverage(machine, tables.fields)
        for k, name in enumerate(LOGICAL_NAMES):
            if name in tables.constants and tables.constants[name] != settings.logical_axes[k]:
                found.append(f"{name} = {tables.constants[name]:g}, the machine file says {settings.logical_axes[k]}")
        return found + self._list_violations(machine, settings, tables)

    def _list_violations(self, machine: Machine, settings: IsgSettings, tables: IsgTables) -> list[str]:
        if tables.listing is None:
            return [f"{len(tables.files)} parameter files, the control takes {MOST_FILES}"] * (
                len(tables.files) > MOST_FILES
            )
        listing, wanted = tables.listing, list_of(machine, settings, self.parameter_file, self.file_format)
        found = disagreements(listing, wanted)
        if len(listing.files) > MOST_FILES or max(listing.files) >= MOST_FILES:
            found.append(f"list file: {len(listing.files)} files; the control takes {MOST_FILES}, file[0] ... file[9]")
        if listing.use_axis_offsets:
            found.append("list file: use_axis_offsets 1 shifts the positions in a way that is not documented in public")
        named = {base_name(path).lower(): index for index, path in listing.files.items()}
        given = {base_name(name).lower() for name in tables.files}
        found += [f"list file: file[{named[name]}] is {name}, which was not given" for name in sorted({*named} - given)]
        found += [f"{name} is not named in the list file: the control ignores it" for name in sorted(given - {*named})]
        for name in sorted(given & {*named}):
            declared = listing.formats.get(named[name], "ISG_CSV")
            if declared != self.file_format:
                found.append(f"list file: {name} is declared {declared}, it is {self.file_format}")
        return found

    def usage(self, machine: Machine, settings: IsgSettings, tables: IsgTables) -> list[Usage]:
        """Return the records of the parameter files against what the control takes."""
        return [Usage("records (max_records)", tables.records, settings.max_records, "records")]

    def resolution_mm(self, settings: IsgSettings) -> float:
        """Half a digit of three lengths, and of six angles and two squareness errors at the longest lever."""
        return 0.5 * (3 * 10.0**-LENGTH_DIGITS + 8 * 10.0**-ANGLE_DIGITS * settings.lever_mm)

    def table_nodes_mm(self, machine: Machine, settings: IsgSettings, tables: IsgTables) -> tuple[FloatArray, ...]:
        """Return the arguments of all parameters, by axis."""
        return nodes_by_axis(
            pair for item in tables.fields.values() for pair in zip(item.axes, item.nodes_mm, strict=True)
        )

    def context(self, machine: Machine, settings: IsgSettings, tables: IsgTables) -> dict[str, Any]:
        """Return what the templates need: numbers, list entries, the sign in words, parameters and checks."""
        listing = tables.listing or list_of(machine, settings, self.parameter_file, self.file_format)
        return {
            **notes(machine, settings, tables, listing),
            **self.body(tables),
            "tables": tables,
            "records": tables.records,
            "listing": listing,
            "list_entries": LIST_ENTRIES + (1 if listing.negate else 0),
            "axes": [
                {"letter": letter, "number": number} for letter, number in zip(AXES, listing.logical_axes, strict=True)
            ],
            "absent": [CONTROL_NAMES[name] for name in ERROR_NAMES if name not in tables.fields],
            "check": self._check_points(machine, settings, tables),
        }

    def _check_points(self, machine: Machine, settings: IsgSettings, tables: IsgTables) -> list[dict[str, Any]]:
        """For each axis the grid point of 3 x 3 x 3 with its largest correction."""
        lines = [(axis.range_mm[0], 0.5 * sum(axis.range_mm), axis.range_mm[1]) for axis in machine.axes]
        position = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        added = self.emulate(machine, settings, tables, Points(position))
        worst = np.argmax(np.abs(added), axis=0)
        return [
            {"axis": letter, "position": position[worst[k]].tolist(), "correction": float(added[worst[k], k])}
            for k, letter in enumerate(AXES)
        ]


def _coverage(machine: Machine, fields: Mapping[str, Field]) -> list[str]:
    """One message per axis and range, naming the errors that it holds for."""
    names: dict[str, list[str]] = {}
    for name, item in fields.items():
        for axis, nodes in zip(item.axes, item.nodes_mm, strict=True):
            for message in coverage_violations(machine, axis, float(nodes[0]), float(nodes[-1]), ""):
                names.setdefault(message, []).append(name)
    return [f"{', '.join(listed)}:{message}" for message, listed in names.items()]
