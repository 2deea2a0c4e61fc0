"""The files of a diagnosis: JSON, text, extended machine file, and the HTML page with figures."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from compgen.data.circles import PLANES
from compgen.data.files import json_text
from compgen.data.names import MM_PER_UM
from compgen.diagnose.axis_diagnosis import AxisDiagnosis, AxisFindings
from compgen.diagnose.circle_diagnosis import CircleDiagnosis
from compgen.diagnose.control_settings import settings_of
from compgen.diagnose.diagnosis import Diagnosis
from compgen.diagnose.feature_diagnosis import FeatureDiagnosis
from compgen.diagnose.search import gains, remainder_of
from compgen.drawing.charts import (
    BOX,
    DIVERGING,
    Picture,
    Plot,
    colour_bar,
    limits_of,
    page_assets,
    picture_grid,
    svg,
)
from compgen.errors import Message, messages_of

# Figures of a diagnosis: residuals before and after over all quantities they may depend on, and the suspects.


BINS = 24
#: Maximum number of readings drawn in a figure; more would not be visible.
MOST_DOTS = 1500
MOST_SUSPECTS = 12


def axis_pictures(part: AxisFindings) -> list[Picture]:
    """Return scatter within the cells over time, and all runs over the targets, as measured and after subtraction."""
    session = part.session
    measured, without = session.deviation_mm / MM_PER_UM, (session.deviation_mm - part.removed_mm) / MM_PER_UM
    kept = ~np.isin(np.arange(len(session)), part.left_out)
    every = np.ones_like(kept)
    count = np.maximum(np.bincount(session.cell[kept], minlength=int(session.cell.max()) + 1), 1)
    scatter = []
    for values, role, rows in ((measured, "before", every), (without, "after", kept)):
        means = np.bincount(session.cell[kept], values[kept], len(count)) / count
        scatter.append((values - means[session.cell], role, rows))
    letter, time = session.letter, "time (s)" if session.timed else "number of the reading in time"
    plot = Plot(
        limits_of(session.time, margin=0.03), limits_of(*(left[rows] for left, _, rows in scatter)),
        x_label=time, y_label="µm",
    )  # fmt: skip
    for left, role, rows in scatter:
        plot.line(session.time[rows], left[rows], role, width=0.7)
        plot.dots(session.time[rows], left[rows], role)
    plot.dots(session.time[~kept], scatter[0][0][~kept], "before", size=6.0)
    plot.dots(session.time[~kept], scatter[0][0][~kept], "page", size=3.5)
    title = "Deviation minus the mean of its target and direction, over time"
    pictures = [Picture(f"time-{letter}", "Scatter", svg(f"time-{letter}", title, [plot]), note="over time")]
    for name, values, role, rows in (("As measured", measured, "before", every), ("Without", without, "after", kept)):
        limits = limits_of(measured, without[kept])
        plot = Plot(limits_of(session.position_mm, margin=0.03), limits, x_label=f"{letter} (mm)", y_label="µm")
        for run in np.unique(session.leg):
            chosen = (session.leg == run) & rows
            upwards = bool(chosen.any() and session.direction[chosen][0] > 0)
            plot.line(session.position_mm[chosen], values[chosen], role, width=0.7)
            plot.dots(session.position_mm[chosen], values[chosen], role, square=not upwards)
        key = f"{role}-{letter}"
        drawn = svg(key, f"All runs over the targets, {name.lower()}", [plot])
        pictures.append(Picture(key, name, drawn, note="all runs over the targets"))
    return pictures


def residual_pictures(found: Diagnosis) -> list[Picture]:
    """Return mean and scatter of the residuals, before and after, over each quantity they may depend on."""
    readings, layout = found.analysis.fit.readings, found.analysis.fit.observed.layout
    over = [(f"{'XYZ'[k]} (mm)", readings.position_mm[:, k]) for k in range(3) if np.ptp(readings.position_mm[:, k])]
    if len(readings.stations) > 1:
        over += [("number of the station", readings.station.astype(np.float64)), ("range (mm)", readings.range_mm)]
    over.append(("time (s)" if layout.timed else "order of stops", layout.time[layout.stop]))
    if readings.approach is not None:
        over += [(f"direction of {'XYZ'[k]}", values) for k, values in enumerate(readings.approach.T) if np.ptp(values)]
    over += [
        (name, values)
        for name, values in readings.covariates.items()
        if name != "time_s" and np.isfinite(values).all() and np.ptp(values)
    ]
    pictures = []
    for number, (label, values) in enumerate(over):
        edges = np.unique(values)
        if few := len(edges) <= BINS:
            index, centres = np.searchsorted(edges, values), edges
        else:
            edges = np.quantile(values, np.linspace(0, 1, BINS + 1))
            index, centres = np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1), 0.5 * (edges[1:] + edges[:-1])
        shift = np.ptp(centres) / 120 if len(centres) > 1 else 0.01
        count = np.maximum(np.bincount(index, minlength=len(centres)), 1)
        drawn = []
        for side, role, residual_mm in (
            (-1.0, "before", found.misfit.residual_before_mm), (1.0, "after", found.misfit.residual_after_mm),
        ):  # fmt: skip
            mean = np.bincount(index, residual_mm, len(centres)) / count
            square = np.bincount(index, residual_mm**2, len(centres)) / count
            spread = np.sqrt(np.maximum(square - mean**2, 0.0))
            drawn.append((role, centres + side * shift, mean / MM_PER_UM, spread / MM_PER_UM))
        limits = limits_of(*(mean + side * spread for _, _, mean, spread in drawn for side in (-1, 1)), zero=True)
        plot = Plot(limits_of(centres, margin=0.05 if not few else 0.1), limits, x_label=label, y_label="µm")
        plot.across(0.0)
        for role, at, mean, spread in drawn:
            plot.spread(at, mean - spread, mean + spread, role)
            plot.dots(at, mean, role)
        key = f"where-{number}"
        pictures.append(Picture(key, f"Over {label}", svg(key, f"Residuals over {label}, before and after", [plot])))
    return pictures


def volume_pictures(found: Diagnosis) -> list[Picture]:
    """Return the residuals over the volume from three sides, before and after, with a common colour scale."""
    position = found.analysis.fit.readings.position_mm
    rows = np.arange(len(position))
    if len(position) > MOST_DOTS:
        rows = np.sort(np.random.default_rng(0).choice(rows, MOST_DOTS, replace=False))
    largest = float(np.quantile(np.abs(found.misfit.residual_before_mm), 0.99)) / MM_PER_UM or 1.0
    pictures = []
    for when, residual_mm in (("before", found.misfit.residual_before_mm), ("after", found.misfit.residual_after_mm)):
        for a, b in ((0, 1), (0, 2), (1, 2)):
            x, y = position[rows, a], position[rows, b]
            limits = limits_of(x, margin=0.03), limits_of(y, margin=0.03)
            plot = Plot(
                *limits, (BOX[0], BOX[1], 200.0, BOX[3]), x_label=f"{'XYZ'[a]} (mm)", y_label=f"{'XYZ'[b]} (mm)"
            )
            shares = 0.5 + 0.5 * residual_mm[rows] / MM_PER_UM / largest
            plot.coloured_dots(x, y, shares, DIVERGING)
            bar = colour_bar(210.0, BOX[1], BOX[3], (-largest, largest), "µm", DIVERGING)
            key = f"volume-{when}-{a}{b}"
            drawn = svg(key, f"Residuals {when}, in {'XYZ'[a]} and {'XYZ'[b]}", [plot], more=bar)
            pictures.append(Picture(key, when.capitalize(), drawn))
    return pictures


def suspects_picture(ranked: Sequence[tuple[str, float, float]], chosen: Container[str]) -> Picture:
    """Return bars of the logarithm of what each suspect would explain on its own; those in the verdict are coloured."""
    size = np.log10([max(chi2, 0.5) for _, chi2, _ in ranked])
    ends = float(np.floor(size.min(initial=0.0))), float(np.ceil(size.max(initial=1.0)))
    height, count = 14.0 * len(ranked), len(ranked)
    marks = [(float(k), f"{10.0**k:g}") for k in range(int(ends[0]), int(ends[1]) + 1)]
    names = [(float(count - k), name) for k, (name, _, _) in enumerate(ranked)]
    plot = Plot(
        ends, (0.5, count + 0.5), (150.0, 8.0, 600.0, 8.0 + height),
        x_label="chi-square explained by this effect alone", x_ticks=marks, y_ticks=names,
    )  # fmt: skip
    for (at, name), length in zip(names, size.tolist(), strict=True):
        plot.bars(ends[0], length, at - 0.4, at + 0.4, "after" if name in chosen else "muted")
    drawn = svg(
        "suspects", "Candidate effects by the chi-square that each explains alone", [plot], (620.0, height + 36.0)
    )
    return Picture("suspects", "Suspects", drawn)


def suspects_of(found: Diagnosis) -> list[tuple[str, float, float]]:
    """Name, chi-square on its own, and visible share of the strongest suspects."""
    design = found.analysis.design
    candidates = [g for g, group in enumerate(design.groups) if group.tier == "named" and design.size(g)]
    alone = gains(design, remainder_of(design, []), candidates) if candidates else np.zeros(0)
    best: dict[str, tuple[float, float]] = {}
    for g, chi2 in zip(candidates, alone, strict=True):
        name = design.groups[g].name
        if float(chi2) > best.get(name, (-1.0, 0.0))[0]:
            best[name] = (float(chi2), float(design.visible[g]))
    ranked = sorted(best.items(), key=lambda item: -item[1][0])[:MOST_SUSPECTS]
    return [(name, chi2, share) for name, (chi2, share) in ranked]


#: Keys and grades of ``diagnosis.json`` in words.
IN_WORDS = {
    "train": "readings used",
    "heldout_lines": "lines left out",
    "heldout_stations": "stations left out",
    "heldout_times": "times left out",
    "beside_unknown": "confirmed, with an unknown effect",
    "none": "none of the known effects",
    "not_decidable": "not decidable",
}


# The page of a diagnosis: one self-contained HTML file with figures.


def page_of(found: Diagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html``; ``data`` is the content of ``diagnosis.json``."""
    title = f"Diagnosis of {found.machine.name}: {IN_WORDS.get(data['verdict'], data['verdict'])}"
    ranked = suspects_of(found)
    rows = "".join(
        f"<tr><td>{escape(name)}</td><td>{chi2:.1f}</td><td>{100 * share:.1f} %</td></tr>"
        for name, chi2, share in ranked
    )
    legend = '<span class="key before"></span> before <span class="key after"></span> after'
    parts = [
        _effects(data),
        _misfit(data),
        "<h2>Where model and measurement disagree</h2>",
        f'<p class="legend"><span>Mean and scatter of the residuals:</span> {legend}</p>',
        picture_grid(residual_pictures(found)),
        "<h2>Over the volume</h2>",
        picture_grid(volume_pictures(found)),
        _folded(
            "Statistics: what each candidate explains by itself",
            [
                picture_grid([suspects_picture(ranked, {item.name for item in found.verdict.named})], "wide")
                if ranked
                else "",
                f"<table><tr><th>candidate effect</th><th>chi-square alone</th><th>visible</th></tr>{rows}</table>",
            ],
        ),
    ]
    return _page(title, parts, data)


def axis_page(found: AxisDiagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html`` for axis runs."""
    title = f"Diagnosis of {found.machine.name}: {IN_WORDS.get(data['verdict'], data['verdict'])}"
    parts = [_effects(data), _figures(data), _misfit(data)]
    for part in found.axes:
        parts += [
            f"<h2>Axis {escape(part.session.letter)}</h2><p>Scatter: deviation minus the mean of its target and direction, in "
            'chronological order; <span class="key before"></span> as measured, <span class="key after"></span> with the named '
            "effects removed; open points: left out. Then all runs over the targets, up (circles) and down (squares), "
            "as measured and with the effects removed.</p>",
            picture_grid(axis_pictures(part)),
        ]
    return _page(title, parts, data)


def circle_page(found: CircleDiagnosis, data: dict[str, Any]) -> str:
    """Return the text of ``index.html`` for circles."""
    title = f"Diagnosis of {found.machine.name}: {IN_WORDS.get(data['verdict'], data['verdict'])}"
    pictures, circles = [], found.circles
    angle = np.degrees(circles.angle_rad)
    for k, plane in enumerate(PLANES):
        for way, told in ((1, "counter-clockwise"), (-1, "clockwise")):
            rows = np.flatnonzero((circles.plane == k) & (circles.direction == way))
            if not rows.size:
                continue
            rows = rows[:: len(rows) // MOST_DOTS + 1]
            before, after = (values[rows] / MM_PER_UM for values in (found.residual_before_mm, found.residual_after_mm))
            limits = limits_of(before, after, zero=True)
            plot = Plot(limits_of(angle[rows], margin=0.03), limits, x_label="angle (degrees)", y_label="µm")
            plot.across(0.0)
            plot.dots(angle[rows], before, "before")
            plot.dots(angle[rows], after, "after")
            key = f"circle-{plane}-{way:+d}"
            drawn = svg(key, f"Radial deviation {plane}, {told}, before and after", [plot])
            pictures.append(Picture(key, f"{plane}, {told}", drawn))
    legend = '<span class="key before"></span> as measured, without centre and radius <span class="key after"></span> left over'
    parts = [
        _effects(data),
        _misfit(data),
        f'<h2>Radial deviations over the angle</h2><p class="legend">{legend}</p>',
        picture_grid(pictures),
    ]
    return _page(title, parts, data)


def _page(title: str, parts: list[str], data: dict[str, Any]) -> str:
    """The page with its parts and the common end of all pages."""
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p><b>{escape(data['headline'])}</b></p><p>{escape(data['left_over'])}</p>",
        _list("What to do next", data["next_steps"]),
        *parts,
        _list("Notes", [*data["reasons"], *data["notes"]]),
        _folded(
            "Further measurements, and what this one cannot show",
            [
                _list("Further measurements", [text for text in data["advice"] if text not in data["next_steps"]]),
                _list("What this measurement cannot show", data["invisible"]),
            ],
        ),
    ]
    style, script, policy = page_assets("charts.js")
    head = f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{policy}">'
    head += '<meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(title)}</title><style>{style}</style>"
    body = "\n".join(parts)
    return (
        f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>\n{body}\n<script>{script}</script></body></html>\n'
    )


def _folded(title: str, parts: list[str]) -> str:
    text = "".join(parts)
    return f"<details><summary>{escape(title)}</summary>{text}</details>" if text else ""


def _effects(data: dict[str, Any]) -> str:
    lines = []
    for item in data["effects"]:
        values = ", ".join(
            f"{name} = {entry['value']:.4g}" + ("" if entry["u"] is None else f" ± {entry['u']:.2g}")
            for name, entry in item["parameters"].items()
        )
        others = ", ".join(f"{o['name']} {o['weight']:.2f}" for o in item["alias_set"] if o["name"] != item["name"])
        text = f"<b>{escape(item['name'])}</b> <span class=note>{escape(IN_WORDS.get(item['grade'], item['grade']))}</span> "
        text += escape(values) + (f"; cannot be distinguished from {escape(others)}" if others else "")
        text += escape("".join(f"; {reason}" for reason in item.get("reasons", [])))
        if item.get("text"):
            text += f"<br>{escape(item['text'])}"
        if item.get("what_to_do"):
            text += f"<br><i>What to do:</i> {escape(item['what_to_do'])}"
        text += "".join(f"<br><span class=note>{escape(line)}</span>" for line in settings_of(item))
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
    """Figures of ISO 230-2 as measured and after subtraction of the changes."""
    parts = []
    for axis, figures in data["iso_230_2"].items():
        taken = ", ".join(data["taken_off"][axis]) or "nothing was removed"
        rows = "".join(
            f"<tr><td>{key}</td><td>{pair['before']:.2f}</td><td>{pair['after']:.2f}</td></tr>"
            for key, pair in figures.items()
        )
        parts.append(
            f"<h2>ISO 230-2, axis {escape(axis)}</h2><table><tr><th>figure in um</th><th>as measured</th>"
            f"<th>without ({escape(taken)})</th></tr>{rows}</table>"
        )
    return "".join(parts)


def _misfit(data: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{escape(IN_WORDS.get(key, key))}</td><td>{pair['before_rms_um']:.3f}</td>"
        f"<td>{pair['after_rms_um']:.3f}</td></tr>"
        for key, pair in data["gap"].items()
        if isinstance(pair, dict)
    )
    floor = f"{data['gap']['noise_floor_um']:.3f} um ({data['gap']['noise_floor_source']})"
    return (
        "<h2>Does the misfit shrink?</h2><table><tr><th>residual rms in um</th><th>before</th><th>after</th></tr>"
        f"{rows}</table><p>Noise floor {escape(floor)}.</p>"
    )


def _list(title: str, items: list[str]) -> str:
    if not items:
        return ""
    return f"<h2>{escape(title)}</h2><ul>" + "".join(f"<li>{escape(item)}</li>" for item in items) + "</ul>"


# What comes first: one sentence, what is left over against the noise, and at most three steps, the most useful first.


#: Names that a terminal lists.
MOST_HIDDEN = 6
#: Number of next steps.
MOST_STEPS = 3
#: Residuals within this factor of the noise are noise.
LIKE_NOISE = 1.15
SURE = {"confirmed": "sure", "beside_unknown": "sure, beside something without a name", "tentative": "not certain"}
SECONDS_PER_MIN = 60.0


def told(data: dict[str, Any]) -> dict[str, Any]:
    """The content of ``diagnosis.json`` with the sentence and the steps that a page begins with."""
    steps = [text for item in _ranked(data) if item["grade"] != "tentative" and (text := _action(item))]
    steps = list(dict.fromkeys([*steps[: MOST_STEPS - 1], *data["advice"], *steps]))[:MOST_STEPS]
    said = {"headline": _headline(data), "left_over": _left_over(data["gap"]), "next_steps": steps}
    return {**data, **said, **messages_of([said["headline"], said["left_over"], *_findings(data)])}


def _findings(data: Mapping[str, Any]) -> Iterator[str]:
    """Everything that was found, as messages: a program reads their codes and values in place of the sentences."""
    names = [item["name"] for item in _ranked(data) if item["grade"] != "tentative"]
    if names:
        yield Message("verdict-named", "named: {names}", names=", ".join(names))
    for item in data["effects"]:
        yield Message("effect-found", "effect {name}: {grade}", name=item["name"], grade=SURE[item["grade"]])
        yield from item.get("reasons", ())
    for item in data["unknown"]:
        yield Message("unknown-effect", "unknown: {text}", text=item["text"])
    for key in ("reasons", "advice", "notes"):
        yield from data.get(key, ())


def _ranked(data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The effects, sure ones first, in the order in which they were found."""
    return sorted(data["effects"], key=lambda item: list(SURE).index(item["grade"]))


def _headline(data: dict[str, Any]) -> str:
    if data["verdict"] == "not_decidable":
        return Message(
            "verdict-not-decidable", "Not decidable: {reasons}.", reasons="; ".join(data["reasons"]) or "see the notes"
        )
    effects = _ranked(data)
    firm = [item for item in effects if item["grade"] != "tentative"]
    if firm:
        rest = f", and {len(firm) - 1} more" if len(firm) > 1 else ""
        return f"{_what(firm[0])} ({SURE[firm[0]['grade']]}){rest}: {_briefly(_action(firm[0]))}."
    if data["unknown"]:
        step = data["advice"][0] if data["advice"] else "measure again, everything twice"
        return Message(
            "verdict-unknown",
            "Something that no known effect explains: {text}. Next: {step}.",
            text=data["unknown"][0]["text"],
            step=step,
        )
    if effects:
        reasons = "; ".join(effects[0].get("reasons", [])) or Message("no-repeats", "no repeats")
        return Message(
            "verdict-perhaps", "Perhaps {effects} (not certain: {reasons}).", effects=_what(effects[0]), reasons=reasons
        )
    return Message("verdict-none", "Nothing is wrong that these readings show beyond their noise.")


def _what(item: Mapping[str, Any]) -> str:
    """Name and amount of an effect in words."""
    if item.get("text"):
        return f"{item['name']}: {item['text']}"
    values = [
        f"{key} = {entry['value']:.3g} +- {entry['u']:.1g}" for key, entry in item["parameters"].items() if entry["u"]
    ]
    return f"{item['name']}, {', '.join(values[:2])}" if values else str(item["name"])


def _action(item: Mapping[str, Any]) -> str:
    """What to do about an effect, with the number for the control or the clock where there is one."""
    name, values = item["name"], {key: entry["value"] for key, entry in item["parameters"].items()}
    todo = str(item.get("what_to_do") or "")
    if name.startswith("backlash_") and "c_um" in values:
        number = -2.0 * values["c_um"]
        sense = "stops short of its target" if number > 0 else "goes beyond its target"
        play = f"{name[-1]} {sense} by {abs(number):.3g} um after each reversal: enter {number:+.3g} um as its backlash"
        return (
            f"{play} where the control counts play as positive (SINUMERIK MD32450, Fanuc 1851 in detection units), in addition "
            "to what is there; or export it (volcomp run); look for play in screw and bearings"
        )
    if name == "warmup_drift" and in_seconds(item):
        return f"warm up for {3 * values['tau'] / SECONDS_PER_MIN:.0f} minutes (three time constants); {todo}"
    return todo


def _briefly(action: str) -> str:
    """The first part of what to do; all of it is in the steps."""
    return re.split(r"; | where the control| \(", action)[0]


def in_seconds(item: Mapping[str, Any]) -> bool:
    """Whether the time constant of a warm-up is in seconds: its text says so where times were logged."""
    return "tau" in item["parameters"] and re.search(r"time constant [0-9.e+]+ s\b", item.get("text", "")) is not None


def _left_over(gap: Mapping[str, Any]) -> str:
    """Whether what is left equals the noise, and where that is from."""
    floor, after = gap["noise_floor_um"], gap["train"]["after_rms_um"]
    if not floor or after is None:
        return ""
    source = {"repeats": "from the repeats", "stated": "as stated", "residuals": "from what is left itself"}.get(
        gap["noise_floor_source"], f"{gap['noise_floor_source']}"
    )
    held = gap.get("heldout_lines") or gap.get("heldout_times")
    out = f", {held['after_rms_um']:.3g} um on readings left out" if held else ""
    if after <= LIKE_NOISE * floor:
        return Message(
            "left-over-is-noise",
            "What is left ({after:.3g} um rms{out}) is the noise of the instrument ({floor:.3g} um, {source}).",
            after=after,
            out=out,
            floor=floor,
            source=source,
        )
    return Message(
        "left-over-is-more",
        "What is left ({after:.3g} um rms{out}) is {after2:.1f} times the noise ({floor:.3g} um, {source}).",
        after=after,
        out=out,
        after2=after / floor,
        floor=floor,
        source=source,
    )


# The files of a diagnosis: JSON, text, extended machine.


def diagnosis_files(found: Diagnosis | AxisDiagnosis | CircleDiagnosis | FeatureDiagnosis) -> dict[str, str]:
    """Return the content of each file, keyed by file name."""
    data = told(found.to_dict())
    files = {"diagnosis.json": json_text(data), "diagnosis.md": summary(found.machine.name, data, markdown=True)}
    if isinstance(found, FeatureDiagnosis):
        title = f"Diagnosis of {found.machine.name}: {IN_WORDS.get(data['verdict'], data['verdict'])}"
        return {**files, "index.html": _page(title, [_effects(data), _misfit(data)], data)}
    if isinstance(found, CircleDiagnosis):
        extended = found.extended()
        return {**files, "index.html": circle_page(found, data), **({"extended.toml": extended} if extended else {})}
    if isinstance(found, AxisDiagnosis):
        files["index.html"] = axis_page(found, data)
        files["removed.csv"] = found.removed_csv()
    else:
        files["index.html"] = page_of(found, data)
    extended = found.extended()
    if extended:
        files["extended.toml"] = extended
    if isinstance(found, Diagnosis) and (session := found.session()):
        files["session.toml"] = session
    return files


def next_steps(files: Container[str], machine: str, measurement: str, out: str) -> str:
    """Tell which command uses ``extended.toml``; empty without that file."""
    if "session.toml" in files and "extended.toml" not in files:
        return (
            f"{out}/session.toml removes what belongs to instrument and session from these readings only:\n"
            f"  volcomp run {out}/session.toml {measurement} --controller NAME --out tables/"
        )
    if "extended.toml" not in files:
        return ""
    return (
        f"{out}/extended.toml is the machine file with these effects; it removes them from the next measurement, for example\n"
        f"  volcomp run {out}/extended.toml {measurement} --controller NAME --out tables/\n"
        f"instead of\n  volcomp run {machine} {measurement} --controller NAME --out tables/"
    )


def summary(machine: str, data: Mapping[str, Any], *, markdown: bool) -> str:
    """Return the report of a diagnosis (the content of ``diagnosis.json``), as Markdown or as plain text."""
    title = f"Diagnosis of {machine}: {IN_WORDS.get(data['verdict'], data['verdict'])}"
    lines = [f"# {title}" if markdown else title, "", data["headline"], data["left_over"], ""]
    several = len(data.get("iso_230_2", {})) > 1
    for item in data["effects"]:
        lines += _effect_lines(item, markdown=markdown, several=several)
    for item in data["unknown"]:
        depends = ", ".join(item["covariates"]) or "nothing that was logged"
        size = "" if item["rms_um"] is None else f", {item['rms_um']:.2f} um rms"
        name = "**unknown**" if markdown else "unknown"
        lines.append(f"* {name}: {item['text']} (depends on {depends}; acts in {item['direction'] or '?'}{size})")
        if item.get("resembles"):
            lines.append(f"  * resembles {item['resembles']}, but this is not certain")
    lines += [f"* possible secondary effect: {item['name']}" for item in data["secondary"]]
    misfit = [
        (IN_WORDS[key], pair["before_rms_um"], pair["after_rms_um"])
        for key in ("train", "heldout_lines", "heldout_stations", "heldout_times")
        if (pair := data["gap"][key])
    ]
    if markdown:
        lines += ["", "| | before (um rms) | after |", "|---|---|---|"]
        lines += [f"| {name} | {before:.3f} | {after:.3f} |" for name, before, after in misfit]
    else:
        lines += ["", f"{'residual, um rms':20s} {'before':>10s} {'after':>10s}"]
        lines += [f"{name:20s} {before:10.3f} {after:10.3f}" for name, before, after in misfit]
    if "against" in data:
        lines += ["", f"Against the given errors: {data['against']['rms_um']:.3f} um rms. Errors that have changed:"]
        for item in data["against"]["changes"]:
            size = item.get("largest", item.get("value"))
            lines.append(f"* {item['error']}: {size:.2f} {item['unit']} (chi-square {item['chi2']:.0f})")
        if not data["against"]["changes"]:
            lines.append("* none")
    # figures of ISO 230-2 before and after, one row per axis and figure
    for axis, figures in data.get("iso_230_2", {}).items():
        taken = ", ".join(data.get("taken_off", {}).get(axis, ()))
        lines += ["", f"ISO 230-2, axis {axis}, as measured and without {taken or 'anything (nothing was removed)'}:"]
        if markdown:
            lines += ["", "| | as measured, um | without |", "|---|---|---|"]
            lines += [f"| {key} | {pair['before']:.2f} | {pair['after']:.2f} |" for key, pair in figures.items()]
        else:
            lines += [f"{key:20s} {pair['before']:10.2f} {pair['after']:10.2f}" for key, pair in figures.items()]
    lines += ["", f"Noise floor {data['gap']['noise_floor_um']:.3f} um ({data['gap']['noise_floor_source']})."]
    lines += [f"Note: {text}." for text in (*data["reasons"], *data["notes"])]
    if data["next_steps"]:
        lines += ["", "What to do next:", *[f"* {text}" for text in data["next_steps"]]]
    further = [text for text in data["advice"] if text not in data["next_steps"]]
    if further and markdown:
        lines += ["", "Further measurements:", *[f"* {text}" for text in further]]
    hidden = data["invisible"]
    if hidden and (markdown or len(hidden) <= MOST_HIDDEN):
        lines += ["", f"This measurement cannot show: {', '.join(hidden)}."]
    elif hidden:
        lines += ["", f"This measurement cannot show {len(hidden)} of the effects; diagnosis.md lists them."]
    text = "\n".join(lines) + "\n"
    return text if markdown else text.replace("  * ", "    ").replace("\n* ", "\n- ")


def _effect_lines(item: Mapping[str, Any], *, markdown: bool, several: bool) -> list[str]:
    grade = IN_WORDS.get(item["grade"], item["grade"])
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
        lines.append(f"  * cannot be distinguished from: {', '.join(others)}")
    lines += [f"  * {reason}" for reason in item.get("reasons", [])]
    if item.get("what_to_do"):
        lines.append(f"  * what to do: {item['what_to_do']}")
    return [*lines, *(f"  * {line}" for line in settings_of(item))]
