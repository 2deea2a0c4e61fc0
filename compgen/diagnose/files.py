"""The files of a diagnosis: JSON, text, extended machine."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Mapping
from typing import Any

from compgen.diagnose.axis_diagnosis import AxisDiagnosis
from compgen.diagnose.pages import axis_page, page_of
from compgen.diagnose.result import Diagnosis


def diagnosis_files(found: Diagnosis | AxisDiagnosis) -> dict[str, str]:
    """Return the content of every file by its name."""
    data = found.to_dict()
    files = {"diagnosis.json": json_text(data), "diagnosis.md": summary(found.machine.name, data, markdown=True)}
    if isinstance(found, AxisDiagnosis):
        files["index.html"] = axis_page(found, data)
        files["removed.csv"] = found.removed_csv()
    else:
        files["index.html"] = page_of(found, data)
    extended = found.extended()
    if extended:
        files["extended.toml"] = extended
    return files


def next_steps(files: Container[str], machine: str, measurement: str, out: str) -> str:
    """Say which command uses ``extended.toml``; nothing without it."""
    if "extended.toml" not in files:
        return ""
    return (
        f"{out}/extended.toml is the machine file with these effects; it takes them off the next measurement, for example\n"
        f"  volcomp run {out}/extended.toml {measurement} --controller NAME --out tables/\n"
        f"in place of\n  volcomp run {machine} {measurement} --controller NAME --out tables/"
    )


def json_text(data: Mapping[str, Any]) -> str:
    """Return JSON text with null for numbers that are not known."""
    return json.dumps(_strict(data), indent=2, allow_nan=False) + "\n"


def _strict(value: Any) -> Any:
    """Return the value with None for numbers that JSON cannot hold."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {key: _strict(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_strict(item) for item in value]
    return value


def summary(machine: str, data: Mapping[str, Any], *, markdown: bool) -> str:
    """Return the report of a diagnosis (the content of ``diagnosis.json``), as Markdown or as plain text."""
    title = f"Diagnosis of {machine}: {data['verdict'].replace('_', ' ')}"
    lines = [f"# {title}" if markdown else title, ""]
    several = len(data.get("iso_230_2", {})) > 1
    for item in data["effects"]:
        lines += _effect_lines(item, markdown=markdown, several=several)
    for item in data["unknown"]:
        depends = ", ".join(item["covariates"]) or "nothing that was logged"
        size = "" if item["rms_um"] is None else f", {item['rms_um']:.2f} um rms"
        name = "**unknown**" if markdown else "unknown"
        lines.append(f"* {name}: {item['text']} (depends on {depends}; acts in {item['direction'] or '?'}{size})")
        if item.get("resembles"):
            lines.append(f"  * resembles {item['resembles']}, without being certain")
    lines += [f"* possible secondary effect: {item['name']}" for item in data["secondary"]]
    lines += _gap_lines(data, markdown=markdown)
    if "against" in data:
        lines += ["", f"Against the given errors: {data['against']['rms_um']:.3f} um rms. Errors that have changed:"]
        for item in data["against"]["changes"]:
            size = item.get("largest", item.get("value"))
            lines.append(f"* {item['error']}: {size:.2f} {item['unit']} (chi-square {item['chi2']:.0f})")
        if not data["against"]["changes"]:
            lines.append("* none")
    lines += _figure_lines(data, markdown=markdown)
    lines += ["", f"Noise floor {data['gap']['noise_floor_um']:.3f} um ({data['gap']['noise_floor_source']})."]
    lines += [f"Note: {text}." for text in (*data["reasons"], *data["notes"])]
    if data["advice"]:
        lines += ["", "What would decide or show more:", *[f"* {text}" for text in data["advice"]]]
    if data["invisible"]:
        lines += ["", f"This measurement cannot show: {', '.join(data['invisible'])}."]
    text = "\n".join(lines) + "\n"
    return text if markdown else text.replace("  * ", "    ").replace("\n* ", "\n- ")


def _effect_lines(item: Mapping[str, Any], *, markdown: bool, several: bool) -> list[str]:
    grade = item["grade"].replace("_", " ")
    name = f"**{item['name']}**" if markdown else item["name"]
    axis = f"{item['axis']}, " if several and "axis" in item else ""
    lines = [f"* {name} ({axis}{grade}, weight {item['confidence']:.2f})"]
    if item.get("text"):
        lines.append(f"  * {item['text']}")
    for key, entry in item["parameters"].items():
        u = "" if entry["u"] is None else f" +- {entry['u']:.2g}"
        lines.append(f"  * {key} = {entry['value']:.4g}{u}")
    others = [f"{o['name']} {o['weight']:.2f}" for o in item["alias_set"] if o["name"] != item["name"]]
    if others:
        lines.append(f"  * cannot be told from: {', '.join(others)}")
    lines += [f"  * {reason}" for reason in item.get("reasons", [])]
    if item.get("what_to_do"):
        lines.append(f"  * what to do: {item['what_to_do']}")
    return lines


def _gap_lines(data: Mapping[str, Any], *, markdown: bool) -> list[str]:
    rows = [
        (key.replace("_", " "), pair["before_rms_um"], pair["after_rms_um"])
        for key in ("train", "heldout_lines", "heldout_stations", "heldout_times")
        if (pair := data["gap"][key])
    ]
    if markdown:
        head = ["", "| | before (um rms) | after |", "|---|---|---|"]
        return head + [f"| {name} | {before:.3f} | {after:.3f} |" for name, before, after in rows]
    head = ["", f"{'residual, um rms':20s} {'before':>10s} {'after':>10s}"]
    return head + [f"{name:20s} {before:10.3f} {after:10.3f}" for name, before, after in rows]


def _figure_lines(data: Mapping[str, Any], *, markdown: bool) -> list[str]:
    """Figures of ISO 230-2 before and after, a row for each axis and figure."""
    lines: list[str] = []
    for axis, figures in data.get("iso_230_2", {}).items():
        taken = ", ".join(data.get("taken_off", {}).get(axis, ()))
        lines += ["", f"ISO 230-2, axis {axis}, as measured and without {taken or 'anything (nothing was taken off)'}:"]
        if markdown:
            lines += ["", "| | as measured, um | without |", "|---|---|---|"]
            lines += [f"| {key} | {pair['before']:.2f} | {pair['after']:.2f} |" for key, pair in figures.items()]
        else:
            lines += [f"{key:20s} {pair['before']:10.2f} {pair['after']:10.2f}" for key, pair in figures.items()]
    return lines
