"""Words for the people at the machine: what the exported files of the ISG kernel say, and what must be set and checked."""

from __future__ import annotations

from typing import Any

from compgen.controllers.isg.lis import ListFile
from compgen.controllers.isg.settings import IsgSettings, IsgTables
from compgen.core.machine import Machine

_DIRECTIONS = {
    "workpiece_to_tool": "from the workpiece to the tool",
    "tool_to_workpiece": "from the tool to the workpiece",
}


def notes(machine: Machine, settings: IsgSettings, tables: IsgTables, listing: ListFile) -> dict[str, Any]:
    """Return the texts of the context: sign_statement, chain_statement, parameters, warnings."""
    return {
        "sign_statement": _sign_statement(settings, listing),
        "chain_statement": _chain_statement(settings, listing),
        "reference_statement": _reference_statement(machine),
        "parameters": _parameters(settings, tables, listing),
        "warnings": _warnings(machine, settings, listing),
    }


def _sign_statement(settings: IsgSettings, listing: ListFile) -> str:
    text = (
        "Values are errors as ISO 230-1 defines them (actual minus commanded tool position relative to the workpiece), "
        "in mm and rad; the control takes them off its command. EXX = 0.005 mm at X = 100 mm says that the tool stands "
        "0.005 mm too far in +X there, and the control must then command X = 99.995 mm."
    )
    if settings.reversed_axes:
        text += f" On {settings.reversed_axes} the check at the machine found the opposite."
    return text + (f" The list file negates {listing.negate}." if listing.negate else "")


def _chain_statement(settings: IsgSettings, listing: ListFile) -> str:
    return (
        f"chain {listing.chain} is meant {_DIRECTIONS[settings.chain_direction]}, {listing.workpiece_axes} of these axes "
        f"carry the workpiece"
    )


def _reference_statement(machine: Machine) -> str:
    if machine.squareness_reference == "Y":
        return (
            "the machine file takes Y as the reference: its squareness of X and Y is a slope in EYX here, C0Y is zero"
        )
    return "the reference direction is X, as in the machine file"


def _parameters(settings: IsgSettings, tables: IsgTables, listing: ListFile) -> list[dict[str, object]]:
    rows: list[tuple[str, object, str]] = [
        ("vol_comp[0].file_name", f"{settings.path}volcomp0.lis", "start-up list: the list file"),
        ("vol_comp[0].max_records", settings.max_records, f"start-up list: at least the {tables.records} records here"),
        *(
            (letter, number or "", f"list file: logical axis number of {letter}")
            for letter, number in zip("XYZ", listing.logical_axes, strict=True)
        ),
        ("chain", listing.chain, f"list file: order of the axes {_DIRECTIONS[settings.chain_direction]}"),
        ("workpiece_axes", listing.workpiece_axes, "list file: how many axes of the chain carry the workpiece"),
        ("negate", listing.negate or "not set", "list file: axes whose compensation is turned around"),
        ("interpolation", listing.interpolation, "list file: linear between the positions of the grid"),
        ("use_axis_offsets", listing.use_axis_offsets, "list file: 0, positions are machine coordinates"),
    ]
    return [{"name": name, "value": value, "meaning": meaning} for name, value, meaning in rows]


def _warnings(machine: Machine, settings: IsgSettings, listing: ListFile) -> list[str]:
    found = [
        f"{_chain_statement(settings, listing)}. The documents do not say which end comes first; check it at the "
        f"machine, and set chain_direction in the machine file if it is the other one."
    ]
    if any(machine.tool_offset_mm) and not settings.write_tool_position:
        offset = ", ".join(f"{value:g}" for value in machine.tool_offset_mm)
        found.append(
            f"The lever arms hold the tool offset ({offset}) mm. The control must know it too, from its tool data or "
            f"from P0X, P0Y, P0Z in a parameter file of format ISG_CSV; which of them acts is not documented in public."
        )
    turned = "".join(letter for letter in "XYZ" if (letter in listing.negate) != (letter in settings.reversed_axes))
    if turned:
        found.append(
            f"negate and reversed_axes in the machine file differ on {turned}: the control then moves WITH the error. "
            f"Set reversed_axes to what the check at the machine showed and leave negate out."
        )
    if settings.use_axis_offsets:
        found.append("use_axis_offsets 1: what the control then shifts is not documented in public and not emulated.")
    return found
