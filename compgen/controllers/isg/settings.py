"""What the machine file says to the ISG kernel's volumetric compensation, and what the control has loaded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np

from compgen.controllers.grids import take_loss_mm
from compgen.controllers.isg.lis import Direction, ListFile, axis_letters, chain_text
from compgen.controllers.isg.parameters import MOST_LINES, Field
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES


@dataclass(frozen=True)
class IsgSettings:
    """``[controllers.isg-csv]`` or ``[controllers.etalon-exchange]`` of a machine file.

    Parameters
    ----------
    logical_axes : logical axis numbers of X, Y, Z in the control.
    reversed_axes : axes where the sign check at the machine found that the control ADDS the error.
    negate : axes that the list file negates; by default the reversed ones.
    chain_direction : in which order the control reads ``chain``.
    use_axis_offsets, max_records, path : as the control has them; ``path`` is the folder on the control.
    write_tool_position : whether the CSV file gives the tool offset as P0X, P0Y, P0Z.
    lever_mm : longest lever arm of an angle on this machine.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    """

    logical_axes: tuple[int, int, int]
    reversed_axes: str
    negate: str
    chain_direction: Direction
    use_axis_offsets: int
    max_records: int
    path: str
    write_tool_position: bool
    lever_mm: float
    loss_mm: float


@dataclass(frozen=True)
class IsgTables:
    """What the control has loaded: errors by ISO name, other constants, and the list file if there is one.

    ``records`` counts rows of numbers over ``files`` (names of the parameter files); ``remarks`` are findings about
    the text that the control's documents do not cover.
    """

    fields: Mapping[str, Field]
    constants: Mapping[str, float]
    records: int
    files: tuple[str, ...]
    listing: ListFile | None = None
    remarks: tuple[str, ...] = ()


def read_isg_settings(machine: Machine, name: str, tool_position: bool) -> IsgSettings:
    """Check the settings of one of the two formats; ``tool_position``: the format may carry P0X, P0Y, P0Z."""
    section = machine.controller_settings(name)
    axes = section.section("logical_axes", required=False)
    numbers = tuple(axes.take(letter, tomlio.whole(1, 65535), k + 1) for k, letter in enumerate(AXES))
    axes.finish()
    if len(set(numbers)) != 3:
        raise section.fail("logical_axes", f"gives {numbers} for X, Y, Z; three different numbers are needed")
    reversed_axes = section.take("reversed_axes", axis_letters, "")
    directions = tomlio.choice("workpiece_to_tool", "tool_to_workpiece")
    tool = np.abs(machine.tool_offset_mm)
    settings = IsgSettings(
        logical_axes=(numbers[0], numbers[1], numbers[2]),
        reversed_axes=reversed_axes,
        negate=section.take("negate", axis_letters, reversed_axes),
        chain_direction=cast(Direction, section.take("chain_direction", directions, "workpiece_to_tool")),
        use_axis_offsets=section.take("use_axis_offsets", tomlio.whole(0, 1), 0),
        max_records=section.take("max_records", tomlio.whole(1, MOST_LINES), 2000),
        path=section.take("path", _folder, ""),
        write_tool_position=tool_position and section.take("write_tool_position", tomlio.flag, False),
        lever_mm=float(np.max(np.maximum(np.abs(machine.lower_mm), np.abs(machine.upper_mm)) + tool)),
        loss_mm=take_loss_mm(section),
    )
    section.finish()
    return settings


def _folder(value: object) -> str:
    if not isinstance(value, str) or len(value) > 200 or any(not "!" <= char <= "~" or char == "#" for char in value):
        raise ValueError("a folder on the control is expected: printable ASCII without blanks and '#'")
    if not value or value[-1] in "\\/":
        return value
    return value + ("\\" if "\\" in value or ":" in value else "/")


def list_of(machine: Machine, settings: IsgSettings, parameter_file: str, file_format: str) -> ListFile:
    """Return the list file that the export writes."""
    return ListFile(
        logical_axes=settings.logical_axes,
        chain=chain_text(machine.chain, settings.chain_direction),
        workpiece_axes=len(machine.chain.workpiece_side),
        negate=settings.negate,
        use_axis_offsets=settings.use_axis_offsets,
        files={0: settings.path + parameter_file},
        formats={0: file_format},
    )


def disagreements(listing: ListFile, wanted: ListFile) -> list[str]:
    """Return where a list file differs from the one that the machine file asks for, in words."""
    pairs: list[tuple[str, object, object]] = [
        ("chain", listing.chain, wanted.chain),
        ("workpiece_axes", listing.workpiece_axes, wanted.workpiece_axes),
        ("negate", listing.negate or "nothing", wanted.negate or "nothing"),
        *zip(AXES, listing.logical_axes, wanted.logical_axes, strict=True),
    ]
    return [
        f"list file: {key} is {given if given is not None else 'missing'}, the machine file makes it {due}"
        for key, given, due in pairs
        if given != due
    ]
