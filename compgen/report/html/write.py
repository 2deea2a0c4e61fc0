"""The report of a folder, from its files alone."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from compgen.core.files import OutputFolder
from compgen.export import REPORT_FILES
from compgen.report.html.certificate import calibration_record
from compgen.report.html.content import content
from compgen.report.html.curves import Picture, draw_curves, draw_squareness, draw_tables
from compgen.report.html.dossier import dossier_data, dossier_text
from compgen.report.html.folder import ResultFolder, read_folder
from compgen.report.html.measurement import draw_residuals, draw_stations
from compgen.report.html.page import render_page
from compgen.report.html.svg import drawing
from compgen.report.html.tables import TableCurve, table_curves
from compgen.report.html.volume import draw_slices, draw_space, grid_of

#: The files of a report.
FILES = REPORT_FILES
Further = Callable[[Mapping[str, Any]], Mapping[str, bytes]]


@dataclass(frozen=True)
class Report:
    """A report in memory: the texts by file name, and the numbers that they hold."""

    files: Mapping[str, str]
    data: Mapping[str, Any]


def build_report(folder: str | Path) -> Report:
    """Read what stands in ``folder`` and make its report; nothing is written.

    Raises
    ------
    InputError
        where the folder holds no results, or one of its files cannot be read.
    """
    source = read_folder(folder)
    data = plain(content(source))
    page = render_page(source, data, draw(source, data))
    record = calibration_record(data)
    dossier = dossier_data(data)
    return Report(
        {
            "report.html": page,
            "report.json": _json(data),
            "dossier.md": dossier_text(dossier),
            "dossier.json": _json(dossier),
            "calibration.json": _json(record),
        },
        data,
    )


def write_report(
    folder: str | Path, out: str | Path | None = None, also: Further | None = None
) -> tuple[Report, dict[str, Path]]:
    """Make the report of ``folder`` and write its files there, or to ``out``: all or none.

    ``also`` makes further files, by name, from the numbers of the report.
    """
    target = OutputFolder(out if out is not None else folder)
    report = build_report(folder)
    further = also(report.data) if also is not None else {}
    for name, text in report.files.items():
        target.add(name, text)
    for name, document in further.items():
        target.add(name, document)
    return report, target.commit()


def draw(source: ResultFolder, data: Mapping[str, Any]) -> dict[str, list[Picture]]:
    """Return the pictures of a report by group, see :func:`compgen.report.html.page.render_page`."""
    errors = source.fitted or source.identified
    tables: dict[str, tuple[TableCurve, ...]] = {
        item.name: table_curves(source.machine, errors, item) for item in source.controls
    }
    found: dict[str, list[Picture]] = {"curves": [], "squareness": [], "measurement": []}
    with drawing():
        if source.identified is not None:
            found["curves"] = draw_curves(source.identified, source.fitted, tables)
            found["squareness"] = _some(draw_squareness(source.identified, source.fitted))
        if source.residuals is not None:
            found["measurement"] += _some(draw_residuals(source.residuals))
        found["measurement"] += _some(draw_stations(source.identify.get("stations", []), source.residuals))
        for k, item in enumerate(source.controls):
            grid = grid_of(item.volume)
            found[f"space-{k}"] = [draw_space(grid, k)] if grid is not None else []
            found[f"slices-{k}"] = [draw_slices(grid, k)] if grid is not None else []
            found[f"tables-{k}"] = draw_tables(item.name, k, tables[item.name])
    return found


def _some(picture: Picture | None) -> list[Picture]:
    return [] if picture is None else [picture]


def plain(value: Any) -> Any:
    """Return data with None for every number that is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def _json(data: Any) -> str:
    return json.dumps(data, indent=2, allow_nan=False) + "\n"
