"""The measurement order: one page to print for each proposed measurement, with places, drawing and an empty table to fill in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.drawing.charts import Picture, page_assets
from compgen.planning.next_measurement import ALONG, Candidate, NextBest, set_up_picture
from compgen.report.html.write import page_environment
from compgen.resources import LANGUAGES

#: Name of the page in the folder of a plan.
ORDER_NAME = "order.html"
#: Runs in each direction of a positioning test (ISO 230-2).
RUNS = 5
#: What is written down of every measurement, by hand.
CONDITIONS = (
    "Date, begin and end",
    "Carried out by",
    "Instrument, serial number",
    "Certificate and its date",
    "Machine, serial number",
    "Air, begin and end (°C)",
    "Machine, begin and end (°C)",
    "Warm-up before (min), feed (mm/min)",
    "Compensation of the control on or off",
    "Remarks",
)


@dataclass(frozen=True)
class OrderTable:
    """An empty table: its heading, names of columns, and the cells that are known; the others are filled in."""

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class OrderSheet:
    """One page: what is measured, how, what to watch, the set-up, and the tables to fill in."""

    title: str
    how: str
    watch: tuple[str, ...]
    picture: Picture
    tables: tuple[OrderTable, ...]
    command: str


def order_sheets(found: NextBest) -> list[OrderSheet]:
    """Return the pages of the measurements that are proposed, the most useful first."""
    sheets = []
    for k, item in enumerate(found.measurements):
        entry, own = item.summary(found.machine), item.candidate
        watch, tables, command = _filled(own, found.machine)
        title = own.what[:1].upper() + own.what[1:]
        sheets.append(OrderSheet(title, own.how, watch, set_up_picture(entry, f"order-{k}"), tables, command))
    return sheets


def order_page(found: NextBest, language: str = LANGUAGES[0]) -> str:
    """Return the text of ``order.html``: one page to print for each proposed measurement. It loads nothing.

    Examples
    --------
    >>> import compgen
    >>> from compgen.planning.next_measurement import next_best, unmeasured
    >>> page = order_page(next_best(unmeasured(compgen.load_machine("zha-gantry"))))
    >>> page.count('<section class="sheet">')
    8
    """
    style, _, policy = page_assets()
    return (
        page_environment("order", language)
        .get_template("order.html.j2")
        .render(
            sheets=order_sheets(found),
            machine=found.machine,
            conditions=CONDITIONS,
            travel=[(AXES[k], *axis.range_mm) for k, axis in enumerate(found.machine.axes)],
            style=style,
            policy=policy,
        )
    )


def _filled(own: Candidate, machine: Machine) -> tuple[tuple[str, ...], tuple[OrderTable, ...], str]:
    """Return what to watch, the tables to fill in, and the command that evaluates them."""
    run = f"volcomp run {machine.name}"
    if own.code == "axis_run":
        return (
            (
                "Sign: deviation = actual minus commanded position, positive where the axis travelled too far towards plus.",
                "Approach every target of a run from the same side; drive past the ends before the direction changes.",
            ),
            (_of_runs(own),),
            f"{run} {AXES[_along(own.lines_mm[0])[0]].lower()}.axis.csv --controller NAME --out tables/",
        )
    if own.code in ("straightedge", "square"):
        return (
            (
                "Sign: write what the dial shows; it grows where the plunger is pressed in. Note where the plunger points.",
                "Turn the straightedge or square over and read again: the mean is free of its own error.",
            ),
            tuple(_of_dial(line) for line in own.lines_mm[: 2 if own.code == "square" else 1]),
            f"{run} readings.csv --controller NAME --out tables/",
        )
    if own.code == "angles":
        return (
            ("Sign: right-handed about the axis; note which way the instrument counts, and on which body it stands.",),
            (_of_angles(own),),
            f"{run} angles.errors.csv --controller NAME --out tables/",
        )
    if own.code == "circle":
        return (
            (
                "Sign: positive where the circle is larger than its nominal radius.",
                "Both directions from the same start, with an angle of overshoot; note the calibrated length of the bar.",
            ),
            (_of_circle(),),
            f"{run} circle.txt --controller NAME --out tables/",
        )
    if own.code.startswith("plate"):
        return (
            ("Calibrate the probe first; write the temperature of the plate: its material goes into the evaluation.",),
            _of_plates(own),
            f"{run} plate.artefact.csv --controller NAME --out tables/",
        )
    return (
        (
            "Stations need not be known: set the tracer up near the places below and keep them free of vibration.",
            "Measure the first target again at the end of every station: what it moved is the drift.",
        ),
        _of_tracer(own),
        f"{run} tracer.lengths.csv --controller NAME --out tables/",
    )


def _number(value: float) -> str:
    return f"{round(float(value), 1) + 0.0:g}"


def _along(line_mm: FloatArray) -> tuple[int, FloatArray]:
    """Return the axis along which a line lies, and positions on it, mm."""
    axis = int(np.argmax(np.abs(line_mm[-1] - line_mm[0])))
    return axis, np.linspace(line_mm[0, axis], line_mm[-1, axis], ALONG)


def _others(line_mm: FloatArray, axis: int) -> str:
    return ", ".join(f"{AXES[k]} {_number(line_mm[0, k])}" for k in range(3) if k != axis)


def _of_runs(own: Candidate) -> OrderTable:
    axis, places = _along(own.lines_mm[0])
    ways = [f"{run} {way}" for run in range(1, RUNS + 1) for way in ("+", "−")]
    heading = f"Deviation of {AXES[axis]} in µm, at {_others(own.lines_mm[0], axis)} mm"
    return OrderTable(heading, (f"{AXES[axis]} mm", *ways), tuple((_number(place),) for place in places))


def _of_dial(line_mm: FloatArray) -> OrderTable:
    axis, places = _along(line_mm)
    heading = f"Readings along {AXES[axis]} in µm, at {_others(line_mm, axis)} mm; plunger towards: ____"
    columns = (f"{AXES[axis]} mm", "as set up, there", "as set up, back", "turned over, there", "turned over, back")
    return OrderTable(heading, columns, tuple((_number(place),) for place in places))


def _of_angles(own: Candidate) -> OrderTable:
    axis, places = _along(own.lines_mm[0])
    heading = f"Readings along {AXES[axis]}, at {_others(own.lines_mm[0], axis)} mm; unit: ____"
    return OrderTable(heading, (f"{AXES[axis]} mm", "1 +", "1 −", "2 +", "2 −"), tuple((_number(p),) for p in places))


def _of_circle() -> OrderTable:
    columns = ("run no.", "circle direction", "feed mm/min", "file name", "largest µm", "smallest µm")
    rows = tuple((f"{run}", way) for run in (1, 2, 3) for way in ("counter-clockwise", "clockwise"))
    return OrderTable("Circles in both directions", columns, rows)


def _of_plates(own: Candidate) -> tuple[OrderTable, ...]:
    """Return a table for each set-up: balls with the machine coordinates where the probe finds them."""
    places = own.readings.at_mm[np.isfinite(own.readings.at_mm).all(axis=1)]
    tables = []
    for k, part in enumerate(np.array_split(places, own.set_ups), 1):
        first = np.unique(np.round(part, 6), axis=0, return_index=True)[1]  # a ball has a row for each coordinate
        balls = part[np.sort(first)].tolist()
        rows = tuple((f"{n}", *(_number(value) for value in ball)) for n, ball in enumerate(balls, 1))
        columns = ("ball no.", "X mm", "Y mm", "Z mm", *(f"measured {axis} mm" for axis in AXES))
        tables.append(OrderTable(f"Set-up {k}", columns, rows))
    return tuple(tables)


def _of_tracer(own: Candidate) -> tuple[OrderTable, ...]:
    stations = tuple((f"{n}", *(_number(v) for v in place)) for n, place in enumerate(own.points_mm.tolist(), 1))
    places = own.readings.at_mm[np.isfinite(own.readings.at_mm).all(axis=1)]
    targets = places[: len(places) // own.set_ups]
    rows = tuple((f"{n}", *(_number(v) for v in place)) for n, place in enumerate(targets.tolist(), 1))
    return (
        OrderTable("Stations, about", ("station no.", "X mm", "Y mm", "Z mm", "set up at", "temperature °C"), stations),
        OrderTable(
            "Targets, in this order",
            ("target no.", "X mm", "Y mm", "Z mm", *(f"station {k}: length, mm" for k in range(1, own.set_ups + 1))),
            rows,
        ),
    )
