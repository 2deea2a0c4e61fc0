"""The files of a diagnosis: JSON, text, extended machine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from compgen.diagnose.pages import page_of
from compgen.diagnose.result import Diagnosis


def diagnosis_files(found: Diagnosis) -> dict[str, str]:
    """Return the content of every file by its name."""
    files = {
        "diagnosis.json": json_text(found.to_dict()),
        "diagnosis.md": summary(found),
        "index.html": page_of(found),
    }
    if found.verdict.named and found.machine.source is not None:
        files["extended.toml"] = found.extended()
    return files


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


def summary(found: Diagnosis) -> str:
    """Return the report as Markdown text."""
    data = found.to_dict()
    lines = [f"# Diagnosis of {found.machine.name}: {data['verdict'].replace('_', ' ')}", ""]
    for item in data["effects"]:
        lines.append(f"* **{item['name']}** ({item['grade'].replace('_', ' ')}, weight {item['confidence']:.2f})")
        for name, entry in item["parameters"].items():
            u = "" if entry["u"] is None else f" +- {entry['u']:.2g}"
            lines.append(f"  * {name} = {entry['value']:.4g}{u}")
        others = [f"{o['name']} {o['weight']:.2f}" for o in item["alias_set"] if o["name"] != item["name"]]
        if others:
            lines.append(f"  * cannot be told from: {', '.join(others)}")
        lines += [f"  * {reason}" for reason in item.get("reasons", [])]
    for item in data["unknown"]:
        depends = ", ".join(item["covariates"]) or "nothing that was logged"
        size = "" if item["rms_um"] is None else f", {item['rms_um']:.2f} um rms"
        lines.append(f"* **unknown**: {item['text']} (depends on {depends}; acts in {item['direction'] or '?'}{size})")
    for item in data["secondary"]:
        lines.append(f"* possible secondary effect: {item['name']}")
    lines += ["", "| | before (um rms) | after |", "|---|---|---|"]
    for key in ("train", "heldout_lines", "heldout_stations", "heldout_times"):
        pair = data["gap"][key]
        if pair:
            lines.append(f"| {key.replace('_', ' ')} | {pair['before_rms_um']:.3f} | {pair['after_rms_um']:.3f} |")
    if "against" in data:
        lines += ["", f"Against the given errors: {data['against']['rms_um']:.3f} um rms. Errors that have changed:"]
        for item in data["against"]["changes"]:
            size = item.get("largest", item.get("value"))
            lines.append(f"* {item['error']}: {size:.2f} {item['unit']} (chi-square {item['chi2']:.0f})")
        if not data["against"]["changes"]:
            lines.append("* none")
    for axis, figures in data.get("iso_230_2", {}).items():
        shown = ", ".join(f"{key} {pair['before']:.2f} -> {pair['after']:.2f} um" for key, pair in figures.items())
        lines += ["", f"ISO 230-2, axis {axis}: {shown}"]
    lines += ["", f"Noise floor {data['gap']['noise_floor_um']:.3f} um ({data['gap']['noise_floor_source']})."]
    lines += [f"Note: {text}." for text in (*data["reasons"], *data["notes"])]
    if data["advice"]:
        lines += ["", "What would decide or show more:", *[f"* {text}" for text in data["advice"]]]
    if data["invisible"]:
        lines += ["", f"This measurement cannot show: {', '.join(data['invisible'])}."]
    return "\n".join(lines) + "\n"
