"""ISG_CSV: the ISG kernel's error parameters as white-space separated columns (kernel help, page 296429067).

A header names arguments and parameters, rows of numbers follow; ``//`` starts a comment, a line with ``#`` ends a
block. Several argument columns make a grid, e.g. errors of X at several Z.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from compgen.controls.isg_kernel import (
    ANGLE_DIGITS,
    ARGUMENTS,
    CONTROL_NAMES,
    LENGTH_DIGITS,
    POSITION_DIGITS,
    ErrorParameter,
    IsgCsvSettings,
    IsgTables,
    ParameterFile,
    VolumetricController,
    check_name,
    is_rotary,
)
from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.grids import ParameterGrid, grid_order
from compgen.controls.shared.scanner import check_complete, content_lines, floating, uses_exponent
from compgen.data.messages import doubled
from compgen.data.names import AXES, error_named
from compgen.errors import CompgenWarning

_Row = tuple[int, list[str]]


def parse_csv(source: SourceFile) -> ParameterFile:
    """Read an ISG_CSV file; InputError with file and line for anything that the grammar does not have."""
    parameters: list[ErrorParameter] = []
    records = 0
    exponent: int | None = None
    for block in _blocks(source):
        parameters += _block(source, block)
        records += len(block) - 1
        lines = (line for line, words in block[1:] if uses_exponent(words))
        exponent = next(lines, None) if exponent is None else exponent
    check_complete(source, records)
    return ParameterFile(tuple(parameters), records, exponent)


def _blocks(source: SourceFile) -> list[list[_Row]]:
    blocks: list[list[_Row]] = [[]]
    for line, text in content_lines(source):
        if text.startswith("#"):
            blocks.append([])
        elif "#" in text:
            raise source.fail("a '#' ends a block and must be at the start of its own line", line)
        else:
            blocks[-1].append((line, text.split()))
    filled = [block for block in blocks if block]
    if not filled:
        raise source.fail("holds no block; is it the right file, or was it cut?")
    return filled


def _block(source: SourceFile, block: list[_Row]) -> list[ErrorParameter]:
    """Return the parameters of one block: header and rows that form a grid over its arguments."""
    (header_line, names), rows = block[0], block[1:]
    _check_header(source, header_line, names)
    if not rows:
        raise source.fail(f"the block {' '.join(names)[:60]!r} has no rows; was the file cut?", header_line)
    for line, words in rows:
        if len(words) != len(names):
            raise source.fail(f"has {len(words)} columns, its header in line {header_line} has {len(names)}", line)
    matrix = np.array(
        [[floating(source, line, word, name) for word, name in zip(words, names, strict=True)] for line, words in rows]
    )
    columns = {name: matrix[:, k] for k, name in enumerate(names)}
    if any(name in "ABC" for name in names):
        mixed = [name for name in names if len(name) > 1 and not is_rotary(name)]
        if mixed:
            raise source.fail(f"{mixed[0]} depends on a rotary axis; the model has three linear axes", header_line)
        where = f"{source.path}:{header_line}"
        warnings.warn(f"{where}: the block belongs to a rotary axis and is left out", CompgenWarning, stacklevel=2)
        return []
    arguments = [name for name in names if name in ARGUMENTS]
    nodes, order = grid_order(source, [line for line, _ in rows], [columns[name] for name in arguments])
    axes = tuple(ARGUMENTS.index(name) for name in arguments)
    shape = tuple(len(line) for line in nodes)
    return [
        ErrorParameter(name, ParameterGrid(axes, nodes, column[order].reshape(shape)), source, header_line)
        for name, column in columns.items()
        if name not in ARGUMENTS
    ]


def _check_header(source: SourceFile, line: int, names: list[str]) -> None:
    for name in names:
        if name[0] in "+-.0123456789":
            raise source.fail(f"expected a header with names at the start of a block, found {name[:40]!r}", line)
        check_name(source, line, name)
    twice = doubled(names)
    if twice is not None:
        raise source.fail(f"the header names {twice} twice (the control's error 70469)", line)
    if all(len(name) == 1 for name in names):
        raise source.fail("the header has arguments only; expected at least one error parameter", line)


class IsgCsv(VolumetricController):
    """``isg-csv``: error parameters as columns, one block per axis."""

    name = "isg-csv"
    file_format = "ISG_CSV"
    parameter_file = "volcomp0.csv"
    settings_class = IsgCsvSettings

    def parse_parameters(self, source: SourceFile) -> ParameterFile:
        """Read one ISG_CSV file."""
        return parse_csv(source)

    def count_records(self, fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> int:
        """One row for the position errors, one for the tool, one per position of each axis."""
        return sum(len(block["rows"]) for block in _table_blocks(fields, constants))

    def body(self, tables: IsgTables) -> dict[str, Any]:
        """Return the blocks: title, names, rows and digits of each column."""
        return {"blocks": _table_blocks(tables.fields, tables.constants)}


def _table_blocks(fields: Mapping[str, ParameterGrid], constants: Mapping[str, float]) -> list[dict[str, Any]]:
    """Blocks in the order of the file: constants, tool position, then the curves of X, Y, Z that share their nodes."""
    groups: dict[tuple[Any, ...], dict[str, ParameterGrid]] = {}
    for name, item in sorted(fields.items(), key=lambda pair: pair[1].axes):
        key = (item.axes, *(nodes.tobytes() for nodes in item.nodes_mm))
        groups.setdefault(key, {})[name] = item
    blocks = [_rows(group) for group in groups.values()]
    if constants:
        row = {"names": list(constants), "digits": [POSITION_DIGITS] * len(constants), "rows": [[*constants.values()]]}
        first_curve = next((k for k, block in enumerate(blocks) if block["names"][0] in ARGUMENTS), len(blocks))
        blocks.insert(first_curve, {"title": "tool position at machine zero, mm", **row})
    return blocks


def _rows(group: Mapping[str, ParameterGrid]) -> dict[str, Any]:
    """Block of the parameters that share one grid: its names, rows, and digits of each column."""
    first = next(iter(group.values()))
    letters = [AXES[axis] for axis in first.axes]
    positions = itertools.product(*(nodes.tolist() for nodes in first.nodes_mm))
    columns = [np.ravel(item.values).tolist() for item in group.values()]
    linear = [error_named(name).kind == "linear" for name in group]
    return {
        "title": f"errors over {' and '.join(letters)}, mm and rad" if letters else "position errors, rad",
        "names": [*letters, *(CONTROL_NAMES[name] for name in group)],
        "digits": [POSITION_DIGITS] * len(letters) + [LENGTH_DIGITS if flag else ANGLE_DIGITS for flag in linear],
        "rows": [[*at, *values] for at, *values in zip(positions, *columns, strict=True)],
    }
