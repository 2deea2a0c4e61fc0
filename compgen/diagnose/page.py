"""The files of a diagnosis: JSON, text, extended machine file, and the HTML page with its pictures."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from html import escape
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.files import json_text
from compgen.data.names import MM_PER_UM
from compgen.diagnose.axis_diagnosis import AxisDiagnosis, AxisFindings
from compgen.diagnose.diagnosis import Diagnosis
from compgen.diagnose.layout import IntArray
from compgen.diagnose.search import gains, remainder_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Pictures of a diagnosis as SVG: residuals before and after over everything that they may depend on, and the suspects.


BEFORE, AFTER = "#c1440e", "#1f6fb2"
BINS = 24
#: Readings drawn in a panel; more do not show.
MOST_DOTS = 1500
MOST_SUSPECTS = 12
PICTURE_STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "compgen", "font.size": 8, "axes.titlesize": 9}


def pictures_of(found: Diagnosis) -> dict[str, str]:
    """Return the SVG texts by name: ``where``, ``volume``, ``suspects``."""
    import matplotlib  # imported here: slow to load, and only the pages need it

    matplotlib.use("svg")
    with matplotlib.rc_context(PICTURE_STYLE):
        return {"where": _where(found), "volume": _volume(found), "suspects": _suspects_picture(found)}


def axis_pictures(found: AxisDiagnosis) -> dict[str, str]:
    """Return a picture of the runs of every axis by its letter."""
    import matplotlib  # imported here: slow to load, and only the pages need it

    matplotlib.use("svg")
    with matplotlib.rc_context(PICTURE_STYLE):
        return {part.session.letter: _runs(part) for part in found.axes}


def _runs(part: AxisFindings) -> str:
    """Scatter within the cells over time, and all runs over the targets, before and after."""
    from matplotlib import pyplot

    session = part.session
    measured, without = session.deviation_mm / MM_PER_UM, (session.deviation_mm - part.removed_mm) / MM_PER_UM
    kept = ~np.isin(np.arange(len(session)), part.left_out)
    count = np.maximum(np.bincount(session.cell[kept], minlength=int(session.cell.max()) + 1), 1)
    figure, axes = pyplot.subplots(1, 3, figsize=(10, 3.2))
    figure.subplots_adjust(left=0.06, right=0.99, top=0.92, bottom=0.14, wspace=0.25)
    for values, colour, rows in ((measured, BEFORE, np.ones_like(kept)), (without, AFTER, kept)):
        means = np.bincount(session.cell[kept], values[kept], len(count)) / count
        left = values - means[session.cell]
        axes[0].plot(session.time[rows], left[rows], ".-", color=colour, lw=0.5, ms=4)
    axes[0].plot(session.time[~kept], (measured - means[session.cell])[~kept], "o", mfc="none", color=BEFORE, ms=5)
    axes[0].set_xlabel("time in s" if session.timed else "number of the reading in time")
    axes[0].set_ylabel("deviation less its mean, um")
    for panel, title, values, colour, rows in (
        (axes[1], "as measured", measured, BEFORE, np.ones_like(kept)),
        (axes[2], "without", without, AFTER, kept),
    ):
        for run in np.unique(session.leg):
            own = (session.leg == run) & rows
            marker = "^" if own.any() and session.direction[own][0] > 0 else "v"
            panel.plot(session.position_mm[own], values[own], marker + "-", color=colour, lw=0.5, ms=3, alpha=0.8)
        panel.set_title(title)
        panel.set_xlabel(f"{session.letter} in mm")
    axes[2].sharey(axes[1])
    return _text_of(figure)


def _text_of(figure: Any) -> str:
    from matplotlib import pyplot

    stream = StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    pyplot.close(figure)
    text = stream.getvalue()
    return text[text.index("<svg") :]


def _where(found: Diagnosis) -> str:
    """Residuals before and after against every covariate."""
    from matplotlib import pyplot

    panels = _covariates(found)
    columns = 3
    rows = -(-len(panels) // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(10, 2.3 * rows), squeeze=False)
    figure.subplots_adjust(left=0.07, right=0.99, top=1 - 0.1 / rows, bottom=0.22 / rows, hspace=0.45, wspace=0.28)
    for k, (label, values) in enumerate(panels):
        _panel(axes.flat[k], label, values, found)
    for k in range(len(panels), rows * columns):
        axes.flat[k].axis("off")
    return _text_of(figure)


def _covariates(found: Diagnosis) -> list[tuple[str, FloatArray]]:
    """What residuals are drawn against: label and values (n,)."""
    readings, layout = found.analysis.fit.readings, found.analysis.fit.observed.layout
    panels = [(f"{'XYZ'[k]} in mm", readings.position_mm[:, k]) for k in range(3) if np.ptp(readings.position_mm[:, k])]
    if len(readings.stations) > 1:
        panels.append(("station", readings.station.astype(np.float64)))
        panels.append(("range in mm", readings.range_mm))
    panels.append(("time in s" if layout.timed else "order of stops", layout.time[layout.stop]))
    if readings.approach is not None:
        for k in range(3):
            if np.ptp(readings.approach[:, k]):
                panels.append((f"direction of {'XYZ'[k]}", readings.approach[:, k]))
    for name, values in readings.covariates.items():
        if name != "time_s" and np.isfinite(values).all() and np.ptp(values):
            panels.append((name, values))
    return panels


def _panel(axes: Axes, label: str, values: FloatArray, found: Diagnosis) -> None:
    """Mean and scatter of the residuals in bins of a covariate."""
    few = len(np.unique(values)) <= BINS
    edges = np.unique(values) if few else np.quantile(values, np.linspace(0, 1, BINS + 1))
    index = np.searchsorted(edges, values) if few else np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    centres = edges if few else 0.5 * (edges[1:] + edges[:-1])
    width = np.ptp(centres) / 120 if len(centres) > 1 else 0.01
    for shift, colour, residual in (
        (-width, BEFORE, found.gap.residual_before_mm),
        (width, AFTER, found.gap.residual_after_mm),
    ):
        count = np.maximum(np.bincount(index, minlength=len(centres)), 1)
        mean = np.bincount(index, residual, len(centres)) / count
        square = np.bincount(index, residual**2, len(centres)) / count
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))
        axes.errorbar(
            centres + shift, mean / MM_PER_UM, spread / MM_PER_UM, fmt=".", color=colour, lw=0.7, ms=4, alpha=0.9
        )
    axes.axhline(0.0, color="#888888", lw=0.5)
    axes.set_xlabel(label)
    axes.set_ylabel("residual in um")


def _volume(found: Diagnosis) -> str:
    """Residuals over the volume, seen from three sides: left before, right after."""
    from matplotlib import pyplot

    position = found.analysis.fit.readings.position_mm
    rows = _some(len(position))
    figure, axes = pyplot.subplots(2, 3, figsize=(10, 5.2))
    figure.subplots_adjust(left=0.07, right=0.93, top=0.94, bottom=0.1, hspace=0.4, wspace=0.3)
    largest = float(np.quantile(np.abs(found.gap.residual_before_mm), 0.99)) / MM_PER_UM or 1.0
    shown: Any = None
    for row, (title, residual) in enumerate(
        (("before", found.gap.residual_before_mm), ("after", found.gap.residual_after_mm))
    ):
        for column, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            panel = axes[row, column]
            shown = panel.scatter(
                position[rows, a], position[rows, b], c=residual[rows] / MM_PER_UM, s=6, cmap="coolwarm",
                vmin=-largest, vmax=largest, rasterized=True,
            )  # fmt: skip
            panel.set_xlabel(f"{'XYZ'[a]} in mm")
            panel.set_ylabel(f"{'XYZ'[b]} in mm")
            panel.set_title(title)
    figure.colorbar(shown, ax=axes, label="residual in um", shrink=0.8, pad=0.02)
    return _text_of(figure)


def _some(count: int) -> IntArray:
    if count <= MOST_DOTS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, MOST_DOTS, replace=False))


def suspects_of(found: Diagnosis) -> list[tuple[str, float, float]]:
    """Name, chi-square on its own and visible share of the strongest suspects."""
    design = found.analysis.design
    wanted = [g for g, group in enumerate(design.groups) if group.tier == "named" and design.size(g)]
    alone = gains(design, remainder_of(design, []), wanted) if wanted else np.zeros(0)
    best: dict[str, tuple[float, float]] = {}
    for g, chi2 in zip(wanted, alone, strict=True):
        name = design.groups[g].name
        if float(chi2) > best.get(name, (-1.0, 0.0))[0]:
            best[name] = (float(chi2), float(design.visible[g]))
    ranked = sorted(best.items(), key=lambda item: -item[1][0])[:MOST_SUSPECTS]
    return [(name, chi2, share) for name, (chi2, share) in ranked]


def _suspects_picture(found: Diagnosis) -> str:
    """Ranked suspects: what each would explain by itself; those of the verdict in another colour."""
    from matplotlib import pyplot

    ranked = suspects_of(found)
    chosen = {item.name for item in found.verdict.named}
    figure, axes = pyplot.subplots(figsize=(7, 0.35 * len(ranked) + 1.0))
    figure.subplots_adjust(left=0.28, right=0.97, top=0.97, bottom=0.15)
    names: Sequence[str] = [name for name, _, _ in ranked]
    colours = [AFTER if name in chosen else "#bbbbbb" for name in names]
    axes.barh(range(len(ranked)), [max(chi2, 0.5) for _, chi2, _ in ranked], color=colours)
    axes.set_yticks(range(len(ranked)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("chi-square that it explains by itself")
    return _text_of(figure)


# The page of a diagnosis: one self-contained HTML file with its pictures.


PAGE_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:64rem;margin:2rem auto;padding:0 1rem;color:#222}"
    "table{border-collapse:collapse}td,th{padding:.2rem .8rem;text-align:left;border-bottom:1px solid #ddd}"
    "svg{max-width:100%;height:auto}.grade{color:#666}"
)


def page_of(found: Diagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html``; ``data`` is the content of ``diagnosis.json``."""
    pictures = pictures_of(found)
    title = f"Diagnosis of {found.machine.name}: {data['verdict'].replace('_', ' ')}"
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{chi2:.1f}</td><td>{100 * share:.1f} %</td></tr>"
        for name, chi2, share in suspects_of(found)
    )
    parts = [
        _effects(data),
        _gap(data),
        "<h2>Where model and measurement disagree</h2><p>Mean and scatter of the residuals: red before, blue after.</p>",
        pictures["where"],
        "<h2>Over the volume</h2>",
        pictures["volume"],
        "<h2>Suspects</h2>",
        pictures["suspects"],
        f"<table><tr><th>suspect</th><th>chi-square by itself</th><th>visible</th></tr>{rows}</table>",
    ]
    return _page(title, parts, data)


def axis_page(found: AxisDiagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html`` of axis runs."""
    title = f"Diagnosis of {found.machine.name}: {data['verdict'].replace('_', ' ')}"
    parts = [_effects(data), _figures(data), _gap(data)]
    for letter, text in axis_pictures(found).items():
        parts += [
            f"<h2>Axis {escape(letter)}</h2><p>Left: deviation less the mean of its target and direction, in the order of "
            "time; red as measured, blue without what was taken off, hollow: left out. Right: all runs over the targets, "
            "upwards (triangles up) and downwards, as measured and without.</p>",
            text,
        ]
    return _page(title, parts, data)


def _page(title: str, parts: list[str], data: dict[str, Any]) -> str:
    """The page with its parts and what every page ends with."""
    parts = [
        f"<h1>{escape(title)}</h1>",
        *parts,
        _list("What would decide or show more", data["advice"]),
        _list("What this measurement cannot show", data["invisible"]),
        _list("Notes", [*data["reasons"], *data["notes"]]),
    ]
    head = f'<meta charset="utf-8"><title>{escape(title)}</title><style>{PAGE_STYLE}</style>'
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


def _list(title: str, items: list[str]) -> str:
    if not items:
        return ""
    return f"<h2>{escape(title)}</h2><ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


# The files of a diagnosis: JSON, text, extended machine.


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
