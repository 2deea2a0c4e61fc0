"""Sheets of tests as people print them: one page an axis (ISO 230-2) or a circle (ISO 230-4), as one HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.accuracy.circularity import circle_groups
from compgen.accuracy.evaluate import Accuracy
from compgen.accuracy.field import Figure
from compgen.accuracy.positioning import EDITIONS
from compgen.accuracy.sides import Side
from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import Circles
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.drawing.charts import DASHED, Picture, Plot, legend, limits_of, page_assets, svg
from compgen.errors import InputError
from compgen.report.dcc.laboratory import Certificate, Condition
from compgen.report.html.pictures import draw_circle
from compgen.report.html.write import page_environment
from compgen.resources import LANGUAGES

#: Targets that a page has room for; more are in ``accuracy.json`` only.
MOST_TARGETS = 24
#: Picture of an axis, and the part of it for the deviations; the ranges of A, E and M are drawn to the right of it.
WIDE, WIDE_BOX = (680.0, 300.0), (50.0, 14.0, 556.0, 262.0)


@dataclass(frozen=True)
class SheetRow:
    """One figure of a sheet with its tolerance in um; ``verdict`` is empty without a tolerance."""

    key: str
    figure: Figure
    tolerance: float | None = None

    @property
    def verdict(self) -> str:
        """Whether the tolerance is kept."""
        return "" if self.tolerance is None else self.figure.against(self.tolerance)


def rows_with_tolerance(found: Accuracy, tolerances: Mapping[str, float]) -> dict[str, list[SheetRow]]:
    """Return the figures of each group with the tolerances (um) of the figures that have one.

    ``"A"`` is the tolerance of A of every axis, ``"X A"`` that of X alone and comes before it.

    Raises
    ------
    InputError
        for a tolerance of a figure that this measurement does not have.
    """
    known = {key for name, group in found.groups.items() for figure in group for key in (figure, f"{name} {figure}")}
    for key in tolerances:
        if key not in known:
            figures = dict.fromkeys(figure for group in found.groups.values() for figure in group)
            text = f"{key} is not a figure of this measurement; use one of {', '.join(figures)}"
            raise InputError(text, field="--tolerance")
    return {
        name: [SheetRow(key, item, tolerances.get(f"{name} {key}", tolerances.get(key))) for key, item in group.items()]
        for name, group in found.groups.items()
    }


def sheet_page(
    machine: Machine,
    side: Side,
    found: Accuracy,
    rows: Mapping[str, list[SheetRow]],
    edition: int,
    certificate: Certificate | None = None,
    language: str = LANGUAGES[0],
) -> str:
    """Return the text of ``sheet.html``: one printed page for each axis of axis runs, or each circle.

    Parameters
    ----------
    machine : the machine.
    side : the measurement, axis runs or circles.
    found : its figures.
    rows : the figures of each page with their tolerances (:func:`rows_with_tolerance`).
    edition : of ISO 230-2.
    certificate : laboratory, customer, persons and conditions, if known.
    language : of the page.
    """
    sheets = []
    for name, group in rows.items():
        sheet: dict[str, Any] = {"name": name, "rows": group, "targets": (), "omitted": 0}
        if side.readings is not None:
            own = side.readings.axis == AXES.index(name)
            targets = found.targets[name]
            count = len(targets["position_mm"])
            sheet["title"] = f"Positioning of {name}, ISO 230-2:{edition}"
            sheet["picture"] = draw_positioning(name, side.readings, own, targets, EDITIONS[edition])
            sheet["omitted"] = count if count > MOST_TARGETS else 0
            if not sheet["omitted"]:
                sheet["targets"] = [{key: float(v[k]) for key, v in targets.items()} for k in range(count)]
            measured: AxisRuns | Circles = side.readings
        else:
            assert side.circles is not None
            own = circle_groups(side.circles)[name]
            sheet["title"] = f"Circular test {name}, radius {side.circles.radius_mm[own][0]:g} mm, ISO 230-4"
            sheet["picture"] = draw_circle(name, side.circles, own)
            measured = side.circles
        if language != LANGUAGES[0]:
            from compgen.language import texts_of

            sheet["picture"] = texts_of(language).picture(sheet["picture"])
        sheet["facts"] = [*facts_of(machine, certificate), *conditions_of(measured, own, certificate)]
        sheets.append(sheet)
    style, _, policy = page_assets()
    return page_environment("sheet", language).get_template("sheet.html.j2").render(
        sheets=sheets, title=f"{machine.name}: {side.path.name}", file=side.path.name, statements=found.statements,
        certificate=certificate, style=style, policy=policy,
    )  # fmt: skip


# What the head of a sheet says: machine, people, instruments and conditions.


def facts_of(machine: Machine, certificate: Certificate | None) -> list[tuple[str, str]]:
    """Return machine, laboratory, customer, persons and instruments as (name, text)."""
    if certificate is None:
        return [("Machine", machine.name)]
    thing = certificate.machine
    serial = f"serial number {thing.serial_number}"
    facts = [
        ("Machine", _joined(thing.name or machine.name, thing.manufacturer, thing.model, serial)),
        ("Customer", _joined(certificate.customer.name, certificate.customer.city)),
        ("Laboratory", _joined(certificate.laboratory.name, certificate.laboratory.city, certificate.laboratory_code)),
        ("Carried out by", "; ".join(_joined(person.name, person.role) for person in certificate.persons)),
        ("Number and dates", f"{certificate.number}; {span(certificate.begin, certificate.end)}"),
    ]  # fmt: skip
    for item in certificate.equipment:
        of = item.certificate_number and f"certificate {item.certificate_number}"
        facts.append(("Instrument", _joined(item.name, item.model, f"serial number {item.serial_number}", of)))
    return facts


def _joined(*parts: str) -> str:
    return ", ".join(part for part in parts if part)


def conditions_of(
    measured: AxisRuns | Circles, own: NDArray[np.bool_], certificate: Certificate | None
) -> list[tuple[str, str]]:
    """Return what the files say about the measurement, temperatures at its begin and end, and stated conditions."""
    stated = {key: value for key, value in measured.metadata.items() if value and key not in ("machine", "seed")}
    facts = [(key.replace("_", " ").capitalize(), value) for key, value in stated.items()]
    for name, values in measured.covariates.items():
        known = values[own][np.isfinite(values[own])]
        if len(known) and name.startswith("temp_"):
            place = name.removeprefix("temp_").removesuffix("_c").replace("_", " ")
            text = f"{known[0]:.2f} °C before, {known[-1]:.2f} °C after"
            facts.append((f"Temperature {place}", f"{text}; {known.min():.2f} to {known.max():.2f} °C"))
        elif len(known) and name == "feed_mm_min":
            facts.append(("Feed", f"{span(f'{known.min():g}', f'{known.max():g}')} mm/min"))
    return [*facts, *((item.name, range_of(item)) for item in (certificate.conditions if certificate else ()))]


def range_of(item: Condition) -> str:
    """Return a condition with its unit, e.g. ``"19.6 to 20.4 °C"``."""
    signs = {"\\degreeCelsius": "°C", "\\percent": "%", "\\hecto\\pascal": "hPa"}
    return f"{span(f'{item.lowest:g}', f'{item.highest:g}')} {signs.get(item.unit, item.unit)}"


def span(first: object, last: object) -> str:
    """Return ``"first to last"``, or one of them if they are the same."""
    return " to ".join(dict.fromkeys((str(first), str(last))))


# Deviations over the targets, with the means, the band of k s, and the ranges that the figures are.


def draw_positioning(
    axis: str, runs: AxisRuns, own: NDArray[np.bool_], targets: Mapping[str, FloatArray], k: float
) -> Picture:
    """Return the picture of one axis: readings, means of both directions, mean +- k s, and where A, E, M, B, R come from."""
    x = targets["position_mm"]
    means = {way: targets[f"mean_{way}_um"] for way in ("up", "down")}
    spread = {way: k * np.nan_to_num(targets[f"s_{way}_um"]) for way in means}
    reading = runs.deviation_mm[own] / MM_PER_UM
    edges = [means[way] + sign * spread[way] for way in means for sign in (-1, 1)]
    limits = limits_of(reading, *edges, margin=0.1, zero=True)
    plot = Plot(limits_of(x, margin=0.04), limits, WIDE_BOX, x_label=f"{axis} (mm)", y_label="deviation (µm)")
    plot.across(0.0)
    shift = 0.004 * (plot.x[1] - plot.x[0])  # the directions side by side
    for way, role, side in (("up", "c0", -shift), ("down", "c1", shift)):
        chosen = own & (np.sign(runs.direction) == (1 if way == "up" else -1))
        plot.dots(runs.position_mm[chosen] + side, runs.deviation_mm[chosen] / MM_PER_UM, role, size=2.2)
        if np.isfinite(means[way]).any():
            plot.line(x, means[way], role, width=1.8)
            plot.spread(x + side, means[way] - spread[way], means[way] + spread[way], role)
            for sign in (-1, 1):
                plot.line(x, means[way] + sign * spread[way], role, width=0.7, dash=DASHED)
    ranges = Plot((0.0, 3.0), limits, (WIDE_BOX[2] + 6.0, WIDE_BOX[1], WIDE[0] - 4.0, WIDE_BOX[3]), bare=True)
    middle = targets["mean_um"]
    shown = {"E": list(means.values()), "M": [middle]}
    if np.isfinite([targets[f"s_{way}_um"] for way in means]).any():
        shown = {"A": edges, **shown}
    for place, (name, values) in enumerate(shown.items()):
        known = np.concatenate(values)
        known = known[np.isfinite(known)]
        if not len(known):
            continue
        low, high = float(known.min()), float(known.max())
        for value in (low, high):
            ranges.line((place + 0.3, place + 0.7), (value, value), "ink", width=1.0)
            plot.across(value, "grid", dash=DASHED)
        ranges.spread([place + 0.5], [low], [high], "ink")
        ranges.text(place + 0.5, high, f"{name} {high - low:.1f}", anchor="middle", shift=(0.0, -4.0), unit="um")
    if np.isfinite(targets["B_um"]).all():
        at = int(np.argmax(np.abs(targets["B_um"])))
        plot.spread(x[[at]] - 3 * shift, [means["up"][at]], [means["down"][at]], "ink", width=1.6)
        plot.text(float(x[at]) - 3 * shift, float(middle[at]), "B ", anchor="end", shift=(-2.0, 3.0))
    if np.isfinite(targets["R_um"]).all():
        at = int(np.argmax(targets["R_um"]))
        ends = widest_at(means, spread, at)
        plot.spread(x[[at]] + 3 * shift, [ends[0]], [ends[1]], "ink", width=1.6)
        plot.text(float(x[at]) + 3 * shift, ends[1], "R", shift=(2.0, 8.0))
    names = legend(WIDE_BOX[0] + 4, WIDE[1] - 6, [("c0", f"positive approach, mean and ±{k:g} s")])
    names += legend(WIDE_BOX[0] + 330, WIDE[1] - 6, [("c1", f"negative approach, mean and ±{k:g} s")])
    key, title = f"positioning-{axis}", f"Deviation of {axis} over its targets"
    note = f"right: the ranges A, E and M; in the picture: the positions of B and R; ± {k:g} s dashed"
    return Picture(key, title, svg(key, f"{title}; {note}", [plot, ranges], WIDE, more=names), note=note)


def widest_at(means: Mapping[str, FloatArray], spread: Mapping[str, FloatArray], at: int) -> tuple[float, float]:
    """Return the ends of the interval whose length is R_i: of both directions together, or of one that is wider."""
    ends = {way: (float(means[way][at] - spread[way][at]), float(means[way][at] + spread[way][at])) for way in means}
    low, high = sorted(ends.values(), key=sum)
    return max([(low[0], high[1]), *ends.values()], key=lambda pair: pair[1] - pair[0])
