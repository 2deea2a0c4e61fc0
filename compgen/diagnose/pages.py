"""The page of a diagnosis: one self-contained HTML file with its pictures."""

from __future__ import annotations

from html import escape
from typing import Any

from compgen.diagnose.axis_diagnosis import AxisDiagnosis
from compgen.diagnose.pictures import axis_pictures, pictures_of, suspects_of
from compgen.diagnose.result import Diagnosis

STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}"
    "table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:left;border-bottom:1px solid #ddd}"
    "svg{max-width:100%;height:auto}.grade{color:#666}"
)


def page_of(found: Diagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html``; ``data`` is the content of ``diagnosis.json``."""
    pictures = pictures_of(found)
    title = f"Diagnosis of {found.machine.name}: {data['verdict'].replace('_', ' ')}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        _effects(data),
        _gap(data),
        "<h2>Where model and measurement disagree</h2><p>Mean and scatter of the residuals: red before, blue after.</p>",
        pictures["where"],
        "<h2>Over the volume</h2>",
        pictures["volume"],
        "<h2>Suspects</h2>",
        pictures["suspects"],
        _suspects(found),
        _list("What would decide or show more", data["advice"]),
        _list("What this measurement cannot show", data["invisible"]),
        _list("Notes", [*data["reasons"], *data["notes"]]),
    ]
    return _page(title, parts)


def axis_page(found: AxisDiagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html`` of axis runs."""
    title = f"Diagnosis of {found.machine.name}: {data['verdict'].replace('_', ' ')}"
    parts = [f"<h1>{escape(title)}</h1>", _effects(data), _figures(data), _gap(data)]
    for letter, text in axis_pictures(found).items():
        parts += [
            f"<h2>Axis {escape(letter)}</h2><p>Left: deviation less the mean of its target and direction, in the order of "
            "time; red as measured, blue without what was taken off, hollow: left out. Right: all runs over the targets, "
            "upwards (triangles up) and downwards, as measured and without.</p>",
            text,
        ]
    parts += [
        _list("What would decide or show more", data["advice"]),
        _list("What this measurement cannot show", data["invisible"]),
        _list("Notes", [*data["reasons"], *data["notes"]]),
    ]
    return _page(title, parts)


def _page(title: str, parts: list[str]) -> str:
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{STYLE}</style>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n' + "\n".join(parts) + "\n</body></html>\n"


def _effects(data: dict[str, Any]) -> str:
    lines = []
    for item in data["effects"]:
        values = ", ".join(
            f"{name} = {entry['value']:.4g}" + ("" if entry["u"] is None else f" ± {entry['u']:.2g}")
            for name, entry in item["parameters"].items()
        )
        others = ", ".join(f"{o['name']} {o['weight']:.2f}" for o in item["alias_set"] if o["name"] != item["name"])
        text = f"<b>{escape(item['name'])}</b> <span class=grade>{escape(item['grade'].replace('_', ' '))}</span> "
        text += escape(values) + (f"; cannot be told from {escape(others)}" if others else "")
        text += escape("".join(f"; {reason}" for reason in item.get("reasons", [])))
        if item.get("text"):
            text += f"<br>{escape(item['text'])}"
        if item.get("what_to_do"):
            text += f"<br><i>What to do:</i> {escape(item['what_to_do'])}"
        lines.append(text)
    for item in data["unknown"]:
        depends = ", ".join(item["covariates"]) or "nothing that was logged"
        lines.append(
            f"<b>unknown</b>: {escape(item['text'])}, depends on {escape(depends)}"
            + (f"; resembles {escape(item['resembles'])}" if item.get("resembles") else "")
        )
    if not lines:
        return "<p>Model and measurement agree within the noise.</p>"
    return "<ul>" + "".join(f"<li>{line}</li>" for line in lines) + "</ul>"


def _figures(data: dict[str, Any]) -> str:
    """Figures of ISO 230-2 as measured and without what was taken off."""
    parts = []
    for axis, figures in data["iso_230_2"].items():
        taken = ", ".join(data["taken_off"][axis]) or "nothing was taken off"
        rows = "".join(
            f"<tr><td>{key}</td><td>{pair['before']:.2f}</td><td>{pair['after']:.2f}</td></tr>"
            for key, pair in figures.items()
        )
        parts.append(
            f"<h2>ISO 230-2, axis {escape(axis)}</h2><table><tr><th>figure in um</th><th>as measured</th>"
            f"<th>without ({escape(taken)})</th></tr>{rows}</table>"
        )
    return "".join(parts)


def _gap(data: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{escape(key.replace('_', ' '))}</td><td>{pair['before_rms_um']:.3f}</td>"
        f"<td>{pair['after_rms_um']:.3f}</td></tr>"
        for key, pair in data["gap"].items()
        if isinstance(pair, dict)
    )
    floor = f"{data['gap']['noise_floor_um']:.3f} um ({data['gap']['noise_floor_source']})"
    return (
        "<h2>Does the gap shrink?</h2><table><tr><th>residual rms in um</th><th>before</th><th>after</th></tr>"
        f"{rows}</table><p>Noise floor {escape(floor)}.</p>"
    )


def _suspects(found: Diagnosis) -> str:
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{chi2:.1f}</td><td>{100 * share:.1f} %</td></tr>"
        for name, chi2, share in suspects_of(found)
    )
    return f"<table><tr><th>suspect</th><th>chi-square by itself</th><th>visible</th></tr>{rows}</table>"


def _list(title: str, items: list[str]) -> str:
    if not items:
        return ""
    return f"<h2>{escape(title)}</h2><ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"
