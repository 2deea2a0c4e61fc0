"""The report of a folder as files: HTML page, dossier, calibration record, and the lines for the terminal."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from rich.console import Group
from rich.text import Text

from compgen.data.charts import LABEL, Picture, page_assets
from compgen.data.files import OutputFolder, json_text, json_values
from compgen.data.messages import number_text, one_line
from compgen.data.names import COVERAGE
from compgen.report.html.content import FIGURES, content, um
from compgen.report.html.folder import ResultFolder, TableCurve, read_folder, table_curves
from compgen.report.html.pictures import (
    draw_curves,
    draw_residuals,
    draw_slices,
    draw_space,
    draw_squareness,
    draw_stations,
    draw_tables,
    grid_of,
    thousands,
)
from compgen.resources import data_folder
from compgen.tables import REPORT_FILES

# The HTML page: Jinja2 with every text escaped, one style sheet, one script, and a policy that forbids the network.


#: Markdown that the preflight lists are made of; no raw HTML, links or pictures.
_OFF = ("html_block", "html_inline", "link", "image", "autolink", "reference")


def render_page(
    source: ResultFolder,
    data: Mapping[str, Any],
    pictures: Mapping[str, Sequence[Picture]],
    seconds: float | None = None,
) -> str:
    """Return the text of ``report.html``.

    Parameters
    ----------
    source : the folder, for the beginnings of the files and the preflight lists.
    data : from :func:`compgen.report.html.content.content`.
    pictures : by group: ``curves``, ``squareness``, ``measurement``, and ``space-K``, ``slices-K``, ``tables-K`` for
        control K.
    seconds : how long the drawing took; None leaves it out.
    """
    environment = _environment()
    style, script, policy = page_assets("charts.js", "script.js")
    drawn = [picture for group in pictures.values() for picture in group]
    return environment.get_template("page.html.j2").render(
        data=data,
        controls=list(zip(data["controls"], source.controls, strict=True)),
        pictures=pictures,
        has_fit=source.fitted is not None,
        has_named=any(item["series"][-1]["name"].startswith("table ") for item in (p.data for p in pictures["curves"])),
        figures=FIGURES,
        policy=policy,
        style=style,
        script=script,
        payload=script_data({picture.key: dict(picture.data) for picture in drawn if picture.data}),
        seconds=seconds,
    )


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(data_folder("templates") / "_report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "um": um,
        "number": number_text,
        "known": lambda value: number_text(value, missing="not known"),
        "markdown": markdown,
        "unit": lambda name: LABEL.get(name, name),
        "thousands": thousands,
    }
    return environment


def script_data(value: Any) -> Markup:
    r"""Return data as JSON that stays data inside a script element, whatever texts it holds.

    >>> print(script_data({"a": "</script><!--"}))
    {"a":"\u003c/script\u003e\u003c!--"}
    """
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)  # ASCII, so U+2028 and U+2029 are escaped
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))


def markdown(text: str) -> Markup:
    """Return the HTML of Markdown without raw HTML, links and pictures; the check boxes of lists become marks."""
    from markdown_it import MarkdownIt

    html = MarkdownIt("commonmark", {"html": False}).enable("table").disable(list(_OFF)).render(text)
    html = re.sub(r"<(/?)h([1-3])>", lambda found: f"<{found.group(1)}h{int(found.group(2)) + 3}>", html)
    return Markup(html.replace("<li>[ ] ", "<li class='check'>"))


# The documentation of a compensation in the spirit of ISO/TR 16907, clause 12: what was done, with what, and its limits.
#
# The clauses of the report were not at hand; the sections follow its published contents (kinematic representation,
# geometric errors, determination, compensation, validation, documentation).


#: Characters that mean something in Markdown or HTML.
_SPECIAL = "\\`*_{}[]<>()#+!|&~"


#: What the dossier says of the tables of a control, and of their verification.
TABLES = ("name", "format", "evidence", "settings", "sign_statement", "parameters", "files")
VERIFICATION = (
    "name", "state", "headline", "measured", "objections", "points", "before", "after", "before_rigid", "after_rigid",
    "unrepresentable_um", "uncorrected", "reasons", "notes",
)  # fmt: skip


def dossier_data(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sections of the dossier from the numbers of the report (:func:`compgen.report.html.content.content`)."""
    return {
        "format": "compgen dossier 1",
        "machine": data["machine"] or {"name": data["title"]},
        "measured": {"inputs": data["provenance"]["inputs"], "date": data["provenance"]["date"]},
        "model": {
            "kinematic_chain": data["machine"].get("chain"),
            "errors": [item["error"] for item in data["errors"]],
            "convention": "names and signs of ISO 230-1: actual minus commanded, tool relative to workpiece",
        },
        "identification": data["measurement"],
        "identified_errors": data["errors"],
        "tables": [{key: item[key] for key in TABLES} for item in data["controls"]],
        "verification": [{key: item[key] for key in VERIFICATION} for item in data["controls"]],
        "accuracy": data["accuracy"],
        "comparison": data["compare"],
        "limits": data["limitations"],
        "provenance": data["provenance"],
    }


def plain_markdown(value: Any) -> str:
    r"""Return a value as one line of Markdown that says just that, whatever it contains.

    >>> plain_markdown("a|b <img>")
    'a\\|b \\<img\\>'
    """
    text = " ".join(str(value).split())
    return "".join(f"\\{char}" if char in _SPECIAL else char for char in text)


def dossier_text(dossier: Mapping[str, Any]) -> str:
    """Return ``dossier.md`` from :func:`dossier_data`."""
    machine = dossier["machine"]
    lines = [f"# Documentation of the compensation of {plain_markdown(machine.get('name', ''))}", ""]
    lines += ["Lengths in mm, errors in um and urad. Expanded uncertainties with k = 2.", ""]
    lines += _section("1. Machine and model", [*_pairs(machine), *_pairs(dossier["model"])])
    inputs = [[item["name"], f"`{one_line(item['sha256'])}`"] for item in dossier["measured"]["inputs"]]
    lines += _section("2. What was measured", _table(["file", "SHA-256"], inputs, raw=1))
    rows = []
    for item in dossier["identified_errors"]:
        at = "" if item["at_mm"] is None else f"{item['at_mm']:g}"
        rows.append(
            [item["error"], item["meaning"], f"{item['largest']:+.3f}", at, number_text(item["U"]), item["unit"]]
        )
    errors = _table(["error", "meaning", "largest", "at (mm)", "U (k = 2)", "unit"], rows)
    lines += _section("3. Identification", [*_pairs(dossier["identification"]), "", *errors])
    tables: list[str] = []
    for item in dossier["tables"]:
        tables += [f"### {plain_markdown(item['name'])}", ""]
        tables += _pairs({key: item[key] for key in ("format", "evidence", "settings", "sign_statement")})
        files = [[f["name"], f"`{one_line(f['sha256'])}`", f["bytes"], f["lines"]] for f in item["files"]]
        tables += ["", *_table(["file", "SHA-256", "bytes", "lines"], files, raw=1)]
    lines += _section("4. Tables", tables)
    verified: list[str] = []
    for item in dossier["verification"]:
        verified += [f"### {plain_markdown(item['name'])}: {item['state']}, {item['points']} points", ""]
        parts = ("before", "after", "before_rigid", "after_rigid")
        figures = [[text, *(um(item[part].get(key)) for part in parts)] for key, text in FIGURES]
        headings = ["um", "before", "after", "before, rigid motion removed", "after, rigid motion removed"]
        verified += _table(headings, figures)
        verified += [f"- {plain_markdown(text)}" for text in (item["headline"], *item["objections"]) if text]
        verified += [f"- Cannot be expressed by this control: {um(item['unrepresentable_um'])} um"]
        verified += [f"- Remains: {row['error']} {um(row['um'])} um; {row['why']}" for row in item["uncorrected"]]
        verified += [*(f"- {plain_markdown(text)}" for text in (*item["reasons"], *item["notes"])), ""]
    lines += _section("5. Verification", verified)
    lines += _section(
        "6. Accuracy figures and comparison", [*_accuracy(dossier["accuracy"]), *_compared(dossier["comparison"])]
    )
    lines += _section("7. Limits", [f"- {plain_markdown(text)}" for text in dossier["limits"]])
    lines += _section("8. Provenance", _pairs(dossier["provenance"]))
    return "\n".join(lines).rstrip() + "\n"


def _section(title: str, lines: list[str]) -> list[str]:
    return [f"## {title}", "", *(lines if any(lines) else ["The folder contains nothing about this."]), ""]


def _pairs(data: Mapping[str, Any]) -> list[str]:
    """Values as a list; longer parts (stations, rejected readings) are counted, their numbers are in the JSON files."""
    lines = []
    for key, value in data.items():
        if value in (None, "", [], {}):
            continue
        many = isinstance(value, list) and value and isinstance(value[0], dict)
        text = f"{len(value)}, see dossier.json" if many else _value(value)
        lines.append(f"- {plain_markdown(str(key).replace('_', ' '))}: {plain_markdown(text)}")
    return lines


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_value(item)}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(_value(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _table(head: list[str], rows: list[list[Any]], raw: int | None = None) -> list[str]:
    """A Markdown table; column ``raw`` is Markdown already."""
    if not rows:
        return []
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for row in rows:
        cells = [str(value) if k == raw else plain_markdown(_value(value)) for k, value in enumerate(row)]
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def _figure(value: Any, u: Any) -> str:
    return number_text(value, 2) + ("" if value is None or u is None else f" ± {u:.2f}")


def _accuracy(accuracy: Mapping[str, Any]) -> list[str]:
    rows = [
        [row["key"], _figure(row["value"], row["U"]), row["unit"], row["meaning"]]
        for group in accuracy.get("groups", [])
        for row in group["rows"]
    ]
    return [*_table(["figure", "value", "unit", "meaning"], rows), *_statements(accuracy)]


def _compared(compare: Mapping[str, Any]) -> list[str]:
    rows = [
        [
            row["key"],
            _figure(row["before"], row["before_U"]),
            _figure(row["after"], row["after_U"]),
            row["unit"],
            row["verdict"] or "",
        ]
        for group in compare.get("groups", [])
        for row in group["rows"]
    ]
    return [*_table(["figure", "before", "after", "unit", "verdict"], rows), *_statements(compare)]


def _statements(data: Mapping[str, Any]) -> list[str]:
    return [*(f"- {plain_markdown(text)}" for text in data.get("statements", [])), ""]


# ``calibration.json``: the results in the order of a Digital Calibration Certificate, as documented JSON.
#
# It is not a DCC: that is an XML document of PTB's schema (namespace ``https://ptb.de/dcc``), issued and signed by a
# laboratory. Its parts and units are named alike, so that a laboratory can take the numbers over.


#: Share of values within the expanded uncertainty, for k = 2 and a normal distribution.
PROBABILITY = 0.9545
#: Units in the notation of the D-SI metadata model.
UNITS = {"um": "\\micro\\metre", "urad": "\\micro\\radian", "mm": "\\milli\\metre"}

STATEMENT = (
    "Documented JSON in the order of a Digital Calibration Certificate; not a DCC and not signed. Fields that only a "
    "laboratory can fill are null."
)


def calibration_record(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the contents of ``calibration.json`` from the numbers of the report."""
    results = [
        {
            "name": item["error"],
            "meaning": item["meaning"],
            "positions": _list(item["position_mm"], "mm"),
            "values": _list(item["value"], item["unit"], item["u"]),
        }
        for item in data["errors"]
    ]
    method = data["measurement"].get("method")
    errors = {"name": "geometric errors (ISO 230-1)", "usedMethod": method, "results": results}
    return {
        "format": "compgen calibration record 1",
        "statement": STATEMENT,
        "administrativeData": {
            "software": [{"name": "compgen", "release": data["provenance"]["report_made_by"].removeprefix("compgen ")}],
            "coreData": {
                "uniqueIdentifier": None,
                "beginPerformanceDate": data["provenance"]["date"] or None,
                "endPerformanceDate": data["provenance"]["date"] or None,
                "performanceLocation": None,
            },
            "items": [{"name": data["title"], "manufacturer": None, "serialNumber": None, "machine": data["machine"]}],
            "calibrationLaboratory": None,
            "respPersons": None,
            "customer": None,
        },
        "measurementResults": [errors, *(_verification(item) for item in data["controls"])],
        "comment": data["limitations"],
        "documents": data["provenance"]["inputs"],
    }


def _list(values: Sequence[Any], unit: str, standard: Sequence[Any] = ()) -> dict[str, Any]:
    """A list of real quantities as D-SI has it: values, one unit, expanded uncertainties where all are known."""
    found: dict[str, Any] = {"valueXMLList": list(values), "unitXMLList": [UNITS[unit]]}
    if standard and None not in standard:
        found["expandedUncXMLList"] = {
            "uncertaintyXMLList": [COVERAGE * u for u in standard],
            "coverageFactor": COVERAGE,
            "coverageProbability": PROBABILITY,
            "distribution": "normal",
        }
    return found


def _verification(item: Mapping[str, Any]) -> dict[str, Any]:
    results = [
        {"name": text, "when": when, "value": item[when].get(key), "unit": UNITS["um"]}
        for when in ("before", "after")
        for key, text in FIGURES
    ]
    what = "error of the tool tip over the volume"
    if not item["volumetric"]:
        what = "effect of the measured errors alone on the tool tip"
    return {
        "name": f"{what}, tables of {item['name']}",
        "usedMethod": "emulation of the files that were read back; computed, not measured",
        "conformity": {"accepted": item["state"] != "rejected", "reasons": [*item["reasons"], *item["objections"]]},
        "results": results,
        "files": item["files"],
    }


# The report of a folder, from its files alone.


#: The files of a report.
FILES = REPORT_FILES
Further = Callable[[Mapping[str, Any]], Mapping[str, bytes]]


@dataclass(frozen=True)
class Report:
    """A report in memory: the texts by file name, and the numbers that they hold."""

    files: Mapping[str, str]
    data: Mapping[str, Any]


def build_report(folder: str | Path) -> Report:
    """Read the results in ``folder`` and make their report; nothing is written.

    Raises
    ------
    InputError
        where the folder contains no results, or one of its files cannot be read.
    """
    source = read_folder(folder)
    data = json_values(content(source))
    page = render_page(source, data, draw(source, data))
    record = calibration_record(data)
    dossier = dossier_data(data)
    return Report(
        {
            "report.html": page,
            "report.json": json_text(data),
            "dossier.md": dossier_text(dossier),
            "dossier.json": json_text(dossier),
            "calibration.json": json_text(record),
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
    """Return the pictures of a report by group, see :func:`compgen.report.html.write.render_page`."""
    errors = source.fitted or source.identified
    tables: dict[str, tuple[TableCurve, ...]] = {item.name: table_curves(errors, item) for item in source.controls}
    found: dict[str, list[Picture]] = {"curves": [], "squareness": [], "measurement": []}
    if source.identified is not None:
        found["curves"] = draw_curves(source.identified, source.fitted, tables)
        found["squareness"] = draw_squareness(source.identified)
    if source.residuals is not None:
        found["measurement"] = draw_residuals(source.residuals)
    found["stations"] = draw_stations(source.identify.get("stations", []), source.residuals)
    for k, item in enumerate(source.controls):
        grid = grid_of(item.volume)
        found[f"space-{k}"] = [draw_space(grid, k)] if grid is not None else []
        found[f"slices-{k}"] = draw_slices(grid, k) if grid is not None else []
        found[f"tables-{k}"] = draw_tables(item.name, k, tables[item.name])
    return found


# The report in a few lines for the terminal.


STYLES = {"accepted": "bold green", "rejected": "bold red", "neutral": "bold"}


def short_text(data: Mapping[str, Any]) -> Group:
    """Return verdict, one line per control, the largest error that remains, and where to read on."""
    verdict = data["verdict"]
    lines = [Text(f"{data['title']}: {verdict['headline']}", STYLES.get(verdict["state"], "bold yellow"))]
    if verdict["text"]:
        lines.append(Text(verdict["text"]))
    for item in data["controls"]:
        before, after = item["before"], item["after"]
        what = "" if item["volumetric"] else "measured errors alone "
        figures = f"{what}{um(before.get('max_um'))} -> {um(after.get('max_um'))} um max, "
        figures += f"{um(before.get('rms_um'))} -> {um(after.get('rms_um'))} um rms"
        lines.append(Text(f"  {item['name']}: {item['verdict'].lower()}; {figures}"))
        lines += [Text(f"    {text}", "yellow") for text in item["objections"] if text not in item["reasons"]]
        if item["uncorrected"]:
            largest = item["uncorrected"][0]
            lines.append(Text(f"    remains: {largest['error']} {um(largest['um'])} um; {largest['why']}"))
        lines += [Text(f"    {reason}", "red") for reason in item["reasons"][:3]]
    return Group(*lines)
