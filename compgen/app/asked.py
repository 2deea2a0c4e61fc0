"""Questions about a file on page Measurement: each answer with a drawing of what it means, and a chooser for columns.

The questions are those of :mod:`compgen.foreign.questions`, as ``volcomp import --json`` prints them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgen.data.names import AXES, CURVE_NAMES, describe_error
from compgen.drawing.charts import Picture, Plot, svg
from compgen.errors import CompgenError, InputError
from compgen.foreign.cells import grid_of_text, read_sheets
from compgen.foreign.columns import Preview, guessed_field, preview_of
from compgen.foreign.source import read_source

#: Box of a drawing without axes, in units of the picture.
_BARE = (5.0, 5.0, 243.0, 145.0)


@dataclass(frozen=True)
class Answer:
    """One answer: the word that the command takes, what it means, its drawing, and whether it is the likeliest."""

    word: str
    label: str
    pictures: Sequence[Picture]
    likely: bool


@dataclass(frozen=True)
class Asked:
    """A question as a page shows it: its words, the option, answers; fields to type where there are none."""

    text: str
    option: str
    answers: Sequence[Answer]
    fields: Sequence[str]
    pictures: Sequence[Picture]
    required: bool


def questions_shown(
    summary: Mapping[str, Any], key: str, given: Callable[[str, str], Sequence[Picture]]
) -> list[Asked]:
    """Return the questions of a file; ``given(word, key)`` draws the file as an answer would read it.

    A file that an earlier version read has its questions as lines without answers.
    """
    listed = summary.get("questions")
    if listed is None:
        return [Asked(str(text), "", (), (), (), True) for text in summary.get("doubts", ())]
    found = []
    for number, asked in enumerate(listed):
        if asked["option"] == "--map" and not asked["choices"]:
            continue  # the chooser of columns asks it
        drawn = DRAWINGS.get(str(asked["picture"]).partition(" ")[0], _nothing)
        meant = drawn(f"{key}-{number}", str(asked["picture"]).partition(" ")[2])
        answers = []
        for k, choice in enumerate(asked["choices"]):
            pictures = meant.get(choice["value"])
            if pictures is None:
                pictures = given(choice["word"], f"{key}-{number}-{k}") if len(asked["choices"]) <= 6 else ()
            label = choice["meaning"] or choice["value"]
            answers.append(Answer(choice["word"], label, pictures, choice["value"] == asked["default"]))
        fields = asked["key"].split(",") if asked["option"] == "--line" else [""]
        found.append(
            Asked(
                asked["reason"],
                asked["option"],
                answers,
                () if answers else fields,
                meant.get("", ()),
                asked["required"],
            )
        )
    return found


# The chooser of columns.


@dataclass(frozen=True)
class ColumnChoice:
    """A column of a table: its name, what it is taken for ("" for nothing), and its cells in the first rows."""

    name: str
    field: str
    cells: Sequence[str]


@dataclass(frozen=True)
class Chooser:
    """The first rows of a table with a chooser for each column: what it may be, in words, by field."""

    lines: Sequence[int]
    columns: Sequence[ColumnChoice]
    fields: Sequence[tuple[str, str]]
    needed: bool
    text: str


#: What a column may be: fields of ``--map``, in words.
FIELD_WORDS = {
    "position": "position of the axis (target)",
    "deviation": "deviation: measured minus target",
    "actual": "reading: measured position",
    "correction": "correction: target minus measured",
    "direction": "direction of travel (+, −)",
    "run": "number of the run",
    "axis": "axis (X, Y, Z)",
    "x": "X, commanded or nominal", "y": "Y, commanded or nominal", "z": "Z, commanded or nominal",
    "dx": "deviation in X", "dy": "deviation in Y", "dz": "deviation in Z",
    "xa": "X, measured", "ya": "Y, measured", "za": "Z, measured",
    "feature": "name of the feature",
    "setup": "number of the set-up",
    "station": "station of the tracer",
    "point": "number of the point",
    "length": "length to the station",
    "angle": "angle on the circle",
    "radius": "radius",
    "temperature": "temperature",
    "time": "time",
    **{name: f"{name}: {describe_error(name)}" for name in CURVE_NAMES},
}  # fmt: skip
#: A column of one run, and its direction.
RUN_WORDS = {
    f"run{n}{way}": f"run {n}, {'forward (+)' if way == '+' else 'back (−)'}" for n in range(1, 6) for way in "+-"
}


def columns_shown(path: Path, answers: Sequence[str], summary: Mapping[str, Any]) -> Chooser | None:
    """Return the chooser of columns for a table; None for other files, and for one whose rows are not found."""
    if summary.get("format") not in ("table", "xlsx"):
        return None
    needed = any(item["picture"] == "columns" for item in summary.get("questions") or ())
    preview: Preview | None = None
    with contextlib.suppress(CompgenError, OSError):
        preview = _preview(path, answers)
    if preview is None:
        return None
    said = dict(word.partition("=")[2].partition("=")[::2] for word in answers if word.startswith("--map="))
    taken = {name: key for key, name in said.items()}
    left = {word.removeprefix("--ignore=") for word in answers if word.startswith("--ignore=")}
    understood = summary.get("understood", {}).get("columns", {})
    read = {str(name): str(key) for key, name in understood.items()} if isinstance(understood, dict) else {}
    columns = []
    for k, name in enumerate(preview.header):
        known = "ignore" if name in left else taken.get(name) or read.get(name, "") or guessed_field(name)
        cells = [row[k] if k < len(row) else "" for row in preview.rows]
        columns.append(ColumnChoice(name, known if known in (*FIELD_WORDS, *RUN_WORDS, "ignore") else "", cells))
    text = next((item["reason"] for item in summary.get("questions") or () if item["option"] == "--map"), "")
    return Chooser(preview.lines, columns, [*FIELD_WORDS.items(), *RUN_WORDS.items()], needed, text)


#: Units that a column may be given.
COLUMN_UNITS = ("um", "mm", "m", "in", "nm", "urad", "arcsec", "mrad", "deg", "mm/m")


def with_column(answers: Sequence[str], column: ColumnChoice, field: str, unit: str) -> list[str]:
    """Return the answers with what a column is; what the file or an earlier answer says already stays as it is.

    >>> named = ColumnChoice("Wert", "", ())
    >>> with_column(["--axis=X", "--ignore=Wert"], named, "deviation", "um")
    ['--axis=X', '--map=deviation=Wert', '--unit=deviation=um']
    >>> with_column([], ColumnChoice("Ort", "position", ()), "position", "")
    []
    """
    found = list(answers)
    if field != column.field:
        found = [
            word
            for word in found
            if word != f"--ignore={column.name}"
            and not (word.startswith("--map=") and word.partition("=")[2].partition("=")[2] == column.name)
        ]
        if field:
            found.append(f"--ignore={column.name}" if field == "ignore" else f"--map={field}={column.name}")
    if unit and (key := _unit_key(field)):
        found = [word for word in found if not word.startswith(f"--unit={key}=")] + [f"--unit={key}={unit}"]
    return found


def with_columns(answers: Sequence[str], chosen: Sequence[tuple[ColumnChoice, str, str]]) -> list[str]:
    """Return the answers with what each column is, as (column, field, unit).

    Raises
    ------
    InputError
        for two columns that share a unit and are given different ones: the last one would count for both.
    """
    found, said = list(answers), dict[str, tuple[str, str]]()
    for column, field, unit in chosen:
        found = with_column(found, column, field, unit)
        if unit and (key := _unit_key(field)):
            name, first = said.setdefault(key, (column.name, unit))
            if first != unit:
                raise InputError(
                    f"{name!r} is in {first} and {column.name!r} in {unit}; both need the same unit: "
                    "convert one column in the file"
                )
    return found


def _unit_key(field: str) -> str:
    """Return what ``--unit`` calls a field: all runs share a unit, all linear and all angular errors; "" without a unit."""
    if field in RUN_WORDS:
        return "deviation"
    if field in CURVE_NAMES:
        return "angle" if field[1] in "ABC" else "linear"
    return "" if field == "ignore" else field


def _preview(path: Path, answers: Sequence[str]) -> Preview | None:
    sheet = next((word.removeprefix("--sheet=") for word in answers if word.startswith("--sheet=")), None)
    if path.read_bytes()[:4] == b"PK\x03\x04":
        sheets, _ = read_sheets(path, sheet)
        grids = [grid for name, grid in sheets if sheet in (None, name)]
    else:
        grids = [grid_of_text(read_source(path))]
    return next(filter(None, map(preview_of, grids)), None)


# Drawings of what an answer means.


def _angle(key: str, lean: float) -> Picture:
    """Two axes whose angle is not 90 degrees, much enlarged."""
    plot = Plot((-0.9, 1.5), (-0.25, 1.2), _BARE, bare=True)
    turn = np.linspace(0.0, np.pi / 2 + lean, 30)
    tip = np.array([np.cos(turn[-1]), np.sin(turn[-1])])
    plot.line([0.0, 1.0], [0.0, 0.0], "ink")
    plot.line([0.0, 0.0], [0.0, 1.0], "grid", dash="4 3")
    plot.line([0.0, tip[0]], [0.0, tip[1]], "ink")
    plot.line(0.3 * np.cos(turn), 0.3 * np.sin(turn), "c0")
    for x, y, text in (
        (1.1, 0.0, "+"),
        (1.1 * tip[0], 1.1 * tip[1], "+"),
        (0.55, 0.35, "> 90°" if lean > 0 else "< 90°"),
    ):
        plot.text(x, y, text)
    return Picture(key, "Positive number", svg(key, "Angle of the axes", [plot]))


def _nothing(key: str, name: str) -> dict[str, Sequence[Picture]]:
    """No drawing: the file as the answer would read it is shown instead."""
    return {}


def _squareness(key: str, _: str) -> dict[str, Sequence[Picture]]:
    above, below = _angle(f"{key}-above", 0.2), _angle(f"{key}-below", -0.2)
    return {"angle-above-90": (above,), "angle-below-90": (below,), "rotation": ()}


def _arrow(plot: Plot, start: tuple[float, float], end: tuple[float, float], role: str = "ink") -> None:
    """An arrow in a bare drawing whose units are those of the picture."""
    (x, y), (dx, dy) = end, np.subtract(end, start)
    along = np.array([dx, dy]) / max(float(np.hypot(dx, dy)), 1e-9) * 0.07
    across = np.array([-along[1], along[0]])
    head = np.array([end - along + 0.5 * across, end, end - along - 0.5 * across])
    plot.line([start[0], x], [start[1], y], role)
    plot.line(head[:, 0], head[:, 1], role)


def _frame(plot: Plot, right: str, up: str) -> None:
    """Arrows of two positive axes in the lower left corner."""
    _arrow(plot, (0.0, 0.0), (0.32, 0.0))
    _arrow(plot, (0.0, 0.0), (0.0, 0.32))
    plot.text(0.35, -0.03, f"+{right}")
    plot.text(-0.03, 0.37, f"+{up}", anchor="middle")


def _plot() -> Plot:
    return Plot((-0.12, 2.0), (-0.12, 1.14), _BARE, bare=True)


def _bulge(key: str, name: str, way: float) -> Picture:
    """The path of the tool beside the straight line where the number is positive."""
    plot = _plot()
    _frame(plot, name[2], name[1])
    x = np.linspace(0.55, 1.85, 40)
    plot.line([0.55, 1.85], [0.55, 0.55], "muted", dash="4 3")
    plot.line(x, 0.55 + way * 0.34 * np.sin(np.pi * (x - 0.55) / 1.3), "c0", width=2.2)
    _arrow(plot, (1.2, 0.55), (1.2, 0.55 + way * 0.30), "c1")
    plot.text(1.2, 0.55 + way * 0.46 - 0.03, "+", anchor="middle")
    title = f"Where the number is positive the tool is too far towards {'+' if way > 0 else '−'}{name[1]} ({name})"
    return Picture(
        key, "Positive number", svg(key, title, [plot]), note="thick: path of the tool; dashed: straight line"
    )


def _straightness(key: str, name: str) -> dict[str, Sequence[Picture]]:
    shown = name if name in CURVE_NAMES else "EYX"
    return {"error": (_bulge(f"{key}-e", shown, 1.0),), "correction": (_bulge(f"{key}-c", shown, -1.0),)}


def _turned(key: str, name: str, way: float) -> Picture:
    """A body that turns about an axis that points to the reader: counter-clockwise is right-handed."""
    plot = _plot()
    letter = AXES["ABC".index(name[1])]
    plot.line(
        0.95 + 0.05 * np.cos(np.linspace(0, 2 * np.pi, 20)), 0.5 + 0.05 * np.sin(np.linspace(0, 2 * np.pi, 20)), "ink"
    )
    plot.dots([0.95], [0.5], "ink", size=3.0)
    plot.text(0.95, 0.32, f"+{letter}", anchor="middle")
    turn = np.linspace(0.15, 1.75 * np.pi, 40) if way > 0 else np.linspace(1.85 * np.pi, 0.25 * np.pi, 40)
    x, y = 0.95 + 0.38 * np.cos(turn), 0.5 + 0.38 * np.sin(turn)
    plot.line(x, y, "c0", width=2.2)
    _arrow(plot, (float(x[-3]), float(y[-3])), (float(x[-1]), float(y[-1])), "c0")
    title = (
        f"Where the number is positive the tool turns {'right' if way > 0 else 'left'}-handed about +{letter} ({name})"
    )
    note = f"+{letter} points towards you"
    return Picture(key, "Positive number", svg(key, title, [plot]), note=note)


def _rotation(key: str, name: str) -> dict[str, Sequence[Picture]]:
    shown = name if name in CURVE_NAMES else "ECX"
    return {"error": (_turned(f"{key}-e", shown, 1.0),), "correction": (_turned(f"{key}-c", shown, -1.0),)}


def _beyond(key: str, way: float) -> Picture:
    """Where the tool stands beside its target where the number is positive."""
    plot = _plot()
    _arrow(plot, (0.1, 0.25), (1.85, 0.25))
    plot.text(1.9, 0.22, "+")
    plot.line([1.0, 1.0], [0.2, 0.75], "muted", dash="4 3")
    plot.text(1.0, 0.84, "target", anchor="middle")
    at = 1.0 + 0.3 * way
    plot.line([at - 0.06, at, at + 0.06, at - 0.06], [0.5, 0.28, 0.5, 0.5], "c0", width=2.2)
    plot.text(at, 0.55, "tool", anchor="middle")
    title = f"Where the number is positive the tool is {'beyond' if way > 0 else 'short of'} its target"
    return Picture(key, "Positive number", svg(key, title, [plot]))


def _position(key: str, _: str) -> dict[str, Sequence[Picture]]:
    return {"error": (_beyond(f"{key}-e", 1.0),), "correction": (_beyond(f"{key}-c", -1.0),)}


def _mounted(key: str, on_table: bool) -> Picture:
    """A machine from the side with a level on the spindle side or on the table."""
    plot = _plot()
    plot.line([0.2, 1.8, 1.8, 0.2, 0.2], [0.1, 0.1, 0.3, 0.3, 0.1], "ink")
    plot.line(
        [0.75, 1.25, 1.25, 1.06, 1.06, 0.94, 0.94, 0.75, 0.75],
        [1.0, 1.0, 0.75, 0.75, 0.55, 0.55, 0.75, 0.75, 1.0],
        "ink",
    )
    x, y = (0.3, 0.34) if on_table else (1.3, 0.84)
    plot.line([x, x + 0.4, x + 0.4, x, x], [y, y, y + 0.12, y + 0.12, y], "c0", width=2.2)
    plot.dots([x + 0.2], [y + 0.06], "c0", size=5.0)
    if not on_table:
        plot.line([1.25, 1.3], [0.9, 0.9], "ink")
    where = "on the table" if on_table else "on the spindle side"
    return Picture(key, f"Level {where}", svg(key, f"The level is {where}", [plot]))


def _level(key: str, _: str) -> dict[str, Sequence[Picture]]:
    return {"spindle": (_mounted(f"{key}-s", False),), "table": (_mounted(f"{key}-t", True),)}


def _one_plane(key: str, name: str) -> Picture:
    plot = _plot()
    plot.line(
        0.9 + 0.45 * np.cos(np.linspace(0, 2 * np.pi, 60)), 0.5 + 0.45 * np.sin(np.linspace(0, 2 * np.pi, 60)), "grid"
    )
    _arrow(plot, (0.9, 0.5), (1.55, 0.5))
    _arrow(plot, (0.9, 0.5), (0.9, 1.08))
    plot.text(1.6, 0.47, f"+{name[0]}")
    plot.text(1.0, 1.02, f"+{name[1]}")
    turn = np.linspace(0.0, 1.2, 20)
    x, y = 0.9 + 0.3 * np.cos(turn), 0.5 + 0.3 * np.sin(turn)
    plot.line(x, y, "c0", width=2.2)
    _arrow(plot, (float(x[-3]), float(y[-3])), (float(x[-1]), float(y[-1])), "c0")
    return Picture(key, f"Angles in {name}", svg(key, f"Angles count from +{name[0]} to +{name[1]}", [plot]))


def _planes(key: str, _: str) -> dict[str, Sequence[Picture]]:
    return {name: (_one_plane(f"{key}-{name}", name),) for name in ("XY", "YZ", "ZX")}


def _origin(key: str, _: str) -> dict[str, Sequence[Picture]]:
    """Machine zero, and the zero of the part with its machine coordinates."""
    plot = _plot()
    _frame(plot, "X", "Y")
    plot.dots([0.0], [0.0], "ink", size=6.0)
    plot.text(0.06, -0.11, "machine zero")
    plot.line([0.9, 1.8, 1.8, 0.9, 0.9], [0.5, 0.5, 1.05, 1.05, 0.5], "c0", width=2.0)
    plot.dots([0.9], [0.5], "c1", size=7.0)
    plot.text(0.94, 0.55, "zero of the part")
    plot.line([0.0, 0.9], [0.5, 0.5], "muted", dash="4 3")
    plot.line([0.9, 0.9], [0.0, 0.5], "muted", dash="4 3")
    plot.text(0.5, 0.53, "X", anchor="middle")
    plot.text(0.94, 0.2, "Y")
    title = "X, Y and Z of the zero of the part, in machine coordinates"
    return {"": (Picture(key, "Zero of the coordinates", svg(key, title, [plot])),)}


def _line(key: str, _: str) -> dict[str, Sequence[Picture]]:
    """The beam along the moving axis, with where the others stood."""
    plot = _plot()
    plot.line([0.0, 1.5, 1.5, 0.0, 0.0], [0.0, 0.0, 0.75, 0.75, 0.0], "muted")
    plot.line([1.5, 1.85, 1.85, 0.35, 0.0], [0.75, 1.0, 0.25, 1.0, 0.75], "grid")
    plot.line([0.15, 1.6], [0.5, 0.5], "c1", width=2.4)
    plot.text(0.85, 0.55, "beam", anchor="middle")
    _arrow(plot, (0.85, 0.0), (0.85, 0.47), "c0")
    plot.text(0.9, 0.2, "where the other axes stood")
    return {"": (Picture(key, "Line of the runs", svg(key, "The beam, and where the other axes stood", [plot])),)}


def _measured_by(key: str, _: str) -> dict[str, Sequence[Picture]]:
    def drawn(name: str, own: bool) -> Picture:
        plot = _plot()
        plot.line([0.5, 1.4, 1.4, 0.5, 0.5], [0.1, 0.1, 0.45, 0.45, 0.1], "c0", width=2.0)
        plot.line([0.95, 0.95], [0.52, 0.85], "ink", width=2.0)
        plot.dots([0.95], [0.52], "c1", size=7.0)
        plot.text(0.95, 0.95, "spindle of this machine" if own else "measuring machine (CMM)", anchor="middle")
        title = "This machine's own probe touches the features" if own else "Another machine measures the finished part"
        return Picture(f"{key}-{name}", "Measured by", svg(f"{key}-{name}", title, [plot]))

    return {"part": (drawn("part", False),), "artefact": (drawn("artefact", True),)}


#: Drawings by their name: of the key of the picture and what follows the name, pictures by answer ("": of the question).
DRAWINGS: Mapping[str, Callable[[str, str], dict[str, Sequence[Picture]]]] = {
    "squareness": _squareness, "straightness": _straightness, "rotation": _rotation, "position": _position, "level": _level,
    "plane": _planes, "origin": _origin, "line": _line, "measured-by": _measured_by,
}  # fmt: skip
