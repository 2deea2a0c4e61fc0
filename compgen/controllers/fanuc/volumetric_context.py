"""What the templates of three-dimensional compensation show: vertices, plan, what to set, worked numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from compgen.controllers.fanuc.style import Punched
from compgen.controllers.fanuc.volumetric_settings import VolumeSettings
from compgen.controllers.fanuc.volumetric_style import PARAMETERS
from compgen.controllers.fanuc.volumetric_tables import COLUMNS, VolumeTable
from compgen.core.csvio import fixed
from compgen.core.machine import Machine
from compgen.core.names import AXES

MEANINGS = ("axis", "vertices along", "number of the reference vertex of", "magnification of", "interval of, mm,")


def volume_context(machine: Machine, settings: VolumeSettings, table: VolumeTable) -> dict[str, Any]:
    """Return the context beyond the common one."""
    vertices = [(number, index, table.counts[index].tolist()) for number, index in table.numbered(settings.order)]
    parameters = _parameters(machine, settings, table)
    sample = settings.sample
    return {
        "sign_statement": _sign_statement(settings, table),
        "parameters": [
            {
                "name": str(number),
                "value": text,
                "meaning": f"{MEANINGS[(number - PARAMETERS[0]) // 3]} {AXES[(number - PARAMETERS[0]) % 3]} (number unverified)",
            }
            for number, text in parameters.items()
        ],
        "warnings": _warnings(settings),
        "overwrites": [
            "Of other axes: nothing, if the numbers below are right. The table of three-dimensional compensation that the "
            "control has for its axes is lost as a whole.",
            f"Parameters {', '.join(map(str, parameters))}",
            f"Points 1 to {len(vertices)}, three values each",
        ],
        "settings": settings,
        "order": "".join(AXES[axis] for axis in settings.order),
        "magnification": " ".join(map(str, table.magnification)),
        "columns": COLUMNS,
        "vertices": [
            {"number": number, "place": _place(table, index), "values": ",".join(map(str, values))}
            for number, index, values in vertices
        ],
        "grids": [
            {
                "axis": AXES[axis],
                "count": grid.count,
                "first": fixed(float(grid.start), 4),
                "last": fixed(float(grid.last), 4),
                "step": fixed(float(grid.step), 4),
                "low": int(table.counts[..., axis].min()),
                "high": int(table.counts[..., axis].max()),
            }
            for axis, grid in enumerate(table.grids)
        ],
        "plan": {
            "parameters": parameters,
            "points": {number: values for number, _, values in vertices},
            "stores": settings.stores,
            "detection_unit_um": settings.detection_unit_um,
        },
        "style_notes": list(sample.notes) if sample else [],
        "has_sample": sample is not None,
        "container": "records" if sample is not None else "grid",
        "file": _punched(settings, parameters, [values for _, _, values in vertices]),
        "check": _check(settings, table),
    }


def _place(table: VolumeTable, index: tuple[int, int, int]) -> str:
    return ",".join(f"{grid.start + k * grid.step:.4f}" for grid, k in zip(table.grids, index, strict=True))


def _parameters(machine: Machine, settings: VolumeSettings, table: VolumeTable) -> dict[int, str]:
    """Parameters 10800 ... 10814 as text."""
    reference = [
        round((machine.reference_point_mm[axis] - float(grid.start)) / float(grid.step)) + 1
        for axis, grid in enumerate(table.grids)
    ]
    texts = [
        *map(str, settings.axis_numbers),
        *(str(grid.count) for grid in table.grids),
        *map(str, reference),
        *map(str, table.magnification),
        *(f"{grid.step:.4f}" for grid in table.grids),
    ]
    return dict(zip(PARAMETERS, texts, strict=True))


def _punched(settings: VolumeSettings, parameters: dict[int, str], values: list[list[int]]) -> Punched | None:
    """Text in the style of the sample, None without one."""
    sample = settings.sample
    if sample is None:
        return None
    records = [sample.style.record(number, [f"P{text}"], 1) for number, text in parameters.items()]
    return Punched(
        sample.style.file(records if sample.with_parameters else [], sample.records(settings.axis_numbers, values))
    )


def _sign_statement(settings: VolumeSettings, table: VolumeTable) -> str:
    stored = "the correction, which the control is taken to add" if settings.stores == "correction" else "the error"
    place = tuple(int(k) for k in np.unravel_index(int(np.argmax(np.abs(table.counts))), table.counts.shape))
    index, axis = (place[0], place[1], place[2]), place[3]
    value = int(table.counts[place])
    moved = settings.sign * value * table.magnification[axis] * settings.detection_unit_um
    at = _place(table, index).replace(",", ", ")
    return (
        f"The values are {stored}; one count is magnification times {settings.detection_unit_um:g} um. At the vertex X, Y, Z "
        f"= {at} mm the value {value:+d} of {AXES[axis]} moves {AXES[axis]} by {moved:+g} um. Between vertices trilinear, "
        "outside the grid held (assumed)."
    )


def _warnings(settings: VolumeSettings) -> list[str]:
    found = [
        "Sign, order of the points, parameter numbers and what lies outside the grid are not settled by public documents: "
        "check single vertices first (part 3), and read the applied compensation back (FOCAS cnc_rdvolccomp).",
        "These files replace stored pitch error and straightness compensation: X, Y and Z must not be corrected twice.",
    ]
    if settings.sample is not None:
        found.append("The style was taken from the sample: " + "; ".join(settings.sample.notes) + ".")
    return found


def _check(settings: VolumeSettings, table: VolumeTable) -> dict[str, Any]:
    """A trial: one value at the farthest vertex of each axis from the reference vertex, what must be seen there."""
    counts = 10
    last = (table.counts.shape[0] - 1, 0, 0)
    numbers = {index: number for number, index in table.numbered(settings.order)}
    return {
        "number": numbers[last],
        "place": _place(table, last).replace(",", ", "),
        "counts": counts,
        "change_um": settings.sign * counts * table.magnification[0] * settings.detection_unit_um,
        "second": numbers[0, table.counts.shape[1] - 1, 0],
        "second_place": _place(table, (0, table.counts.shape[1] - 1, 0)).replace(",", ", "),
    }
