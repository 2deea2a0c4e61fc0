"""The documentation of a compensation in the spirit of ISO/TR 16907, clause 12: what was done, with what, and its limits.

The clauses of the report were not at hand; the sections follow its published contents (kinematic representation,
geometric errors, determination, compensation, validation, documentation).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compgen.core.text import one_line
from compgen.report.html.content import FIGURES, um

#: Characters that mean something in Markdown or HTML.
_SPECIAL = "\\`*_{}[]<>()#+!|&~"


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
        "tables": [
            {
                key: item[key]
                for key in ("name", "format", "evidence", "settings", "sign_statement", "parameters", "files")
            }
            for item in data["controls"]
        ],
        "verification": [
            {
                key: item[key]
                for key in (
                    "name",
                    "state",
                    "headline",
                    "measured",
                    "objections",
                    "points",
                    "before",
                    "after",
                    "before_rigid",
                    "after_rigid",
                    "unrepresentable_um",
                    "uncorrected",
                    "reasons",
                    "notes",
                )
            }
            for item in data["controls"]
        ],
        "accuracy": data["accuracy"],
        "comparison": data["compare"],
        "limits": data["limitations"],
        "provenance": data["provenance"],
    }


def plain_markdown(value: Any) -> str:
    r"""Return a value as one line of Markdown that says just that, whatever stands in it.

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
    lines += _section("3. Identification", [*_pairs(dossier["identification"]), "", *_errors(dossier)])
    lines += _section("4. Tables", [line for item in dossier["tables"] for line in _control_tables(item)])
    lines += _section("5. Verification", [line for item in dossier["verification"] for line in _verified(item)])
    lines += _section(
        "6. Accuracy figures and comparison", [*_accuracy(dossier["accuracy"]), *_compared(dossier["comparison"])]
    )
    lines += _section("7. Limits", [f"- {plain_markdown(text)}" for text in dossier["limits"]])
    lines += _section("8. Provenance", _pairs(dossier["provenance"]))
    return "\n".join(lines).rstrip() + "\n"


def _section(title: str, lines: list[str]) -> list[str]:
    return [f"## {title}", "", *(lines if any(lines) else ["Nothing of this stands in the folder."]), ""]


def _pairs(data: Mapping[str, Any]) -> list[str]:
    """Values as a list; longer parts (stations, rejected readings) are counted, their numbers stand in the JSON files."""
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


def _errors(dossier: Mapping[str, Any]) -> list[str]:
    rows = []
    for item in dossier["identified_errors"]:
        at = "" if item["at_mm"] is None else f"{item['at_mm']:g}"
        known = "–" if item["U"] is None else f"{item['U']:.3f}"
        rows.append([item["error"], item["meaning"], f"{item['largest']:+.3f}", at, known, item["unit"]])
    return _table(["error", "meaning", "largest", "at (mm)", "U (k = 2)", "unit"], rows)


def _figure(value: Any, u: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if u is None else f"{value:.2f} ± {u:.2f}"


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


def _control_tables(item: Mapping[str, Any]) -> list[str]:
    lines = [f"### {plain_markdown(item['name'])}", ""]
    lines += _pairs({key: item[key] for key in ("format", "evidence", "settings", "sign_statement")})
    rows = [[f["name"], f"`{one_line(f['sha256'])}`", f["bytes"], f["lines"]] for f in item["files"]]
    return [*lines, "", *_table(["file", "SHA-256", "bytes", "lines"], rows, raw=1)]


def _verified(item: Mapping[str, Any]) -> list[str]:
    lines = [f"### {plain_markdown(item['name'])}: {item['state']}, {item['points']} points", ""]
    parts = ("before", "after", "before_rigid", "after_rigid")
    rows = [[text, *(um(item[part].get(key)) for part in parts)] for key, text in FIGURES]
    lines += _table(["um", "before", "after", "before, rigid motion removed", "after, rigid motion removed"], rows)
    lines += [f"- {plain_markdown(text)}" for text in (item["headline"], *item["objections"]) if text]
    lines += [f"- Cannot be expressed by this control: {um(item['unrepresentable_um'])} um"]
    lines += [f"- Stays: {item['error']} {um(item['um'])} um; {item['why']}" for item in item["uncorrected"]]
    return [*lines, *(f"- {plain_markdown(text)}" for text in (*item["reasons"], *item["notes"])), ""]
