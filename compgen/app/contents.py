"""What the pages show: a measurement and what it leaves open, the chain of a machine, settings of controls, results."""

from __future__ import annotations

import contextlib
import json
import re
import tomllib
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from compgen.app.asked import columns_shown, questions_shown
from compgen.app.project import Measurement, Project, ProjectState
from compgen.app.steps import CERTIFICATE_FIELDS, PROGRAM_FIELDS, Step, command_line
from compgen.controls import CONTROLLERS
from compgen.data import toml_files
from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Deviations
from compgen.data.error_table import ErrorTable, read_errors
from compgen.data.files import read_text
from compgen.data.machine import CHAINS, ROTARY, Chain, machine_files, read_machine
from compgen.data.names import AXES, SQUARENESS_NAMES
from compgen.data.prior import CLASS_WORDS
from compgen.drawing.charts import BOX, CYCLE, Picture, Plot, limits_of, svg
from compgen.drawing.display import Displayed, Overview
from compgen.errors import CompgenError, CompgenWarning, InputError
from compgen.foreign import ImportOptions, describe_native, import_file, native_format
from compgen.foreign.source import parse_number
from compgen.kinematics import exact_error
from compgen.kinematics.many_points import full_grid
from compgen.new_machine import in_words
from compgen.programs.dialects import DIALECTS
from compgen.report.html.folder import read_volume
from compgen.report.html.pictures import (
    VolumeOnGrid,
    draw_curve,
    draw_proposed,
    draw_slices,
    draw_space,
    grid_of,
    uncertainty_um,
)
from compgen.report.html.write import assumptions_of, judged, proposed_rows
from compgen.report.pdf import browser
from compgen.report.summary import Summary, draw_summary, summary_of
from compgen.tables import load_format
from compgen.tables.verification import MISFIT_CODES

#: Files larger than this are not drawn, bytes; so many pictures of one file at most.
LARGEST_DRAWN, MOST_PICTURES = 40_000_000, 12
#: Levels of each axis at which the error in the volume is calculated for its picture.
VOLUME_LEVELS = 9
#: More positions than this are drawn without arrows.
MOST_ARROWS = 2000

# Measurements: pictures, and questions with what each answer would mean.


def pictures_of(data: object, key: str) -> list[Picture]:
    """Return pictures of what a measurement file contains; ``key`` is unique on the page."""
    if isinstance(data, AxisRuns):
        return [_runs_picture(data, axis, f"{key}-{AXES[axis]}") for axis in data.axes]
    if isinstance(data, Circles):
        return [_circle_picture(data, plane, f"{key}-{plane}") for plane in data.planes]
    if isinstance(data, ErrorTable):
        names = list(data.curves)[:MOST_PICTURES]
        return [replace(draw_curve(name, data, None, {}), key=f"{key}-{name}") for name in names]
    if isinstance(data, Artefact):
        return _artefact_pictures(data, key)
    position_mm = getattr(data, "position_mm", None)
    if position_mm is None or np.ndim(position_mm) != 2:
        return []
    if isinstance(data, Deviations):
        return _deviation_pictures(data, key)
    pictures = []
    for first, second in ((0, 1), (0, 2)):
        x, y = position_mm[:, first], position_mm[:, second]
        plot = Plot(limits_of(x), limits_of(y), x_label=f"{AXES[first]} (mm)", y_label=f"{AXES[second]} (mm)")
        shown = np.unique(np.column_stack([x, y]), axis=0)
        plot.dots(shown[:, 0], shown[:, 1], "line", size=3.0)
        name = f"{key}-{AXES[first]}{AXES[second]}"
        title = f"Measured points in {AXES[first]} and {AXES[second]}"
        pictures.append(Picture(name, f"Points {AXES[first]}{AXES[second]}", svg(name, title, [plot])))
    return pictures


def _runs_picture(data: AxisRuns, axis: int, key: str) -> Picture:
    """Deviations over targets: each run, and the mean of each direction."""
    rows = data.axis == axis
    x, y = data.position_mm[rows], 1e3 * data.deviation_mm[rows]
    direction, run = data.direction[rows], data.run[rows]
    plot = Plot(limits_of(x, margin=0.02), limits_of(y, zero=True), x_label=f"{AXES[axis]} (mm)", y_label="µm")
    plot.across(0.0)
    for role, sign in (("c0", 1), ("c1", -1)):
        chosen = direction == sign
        for number in np.unique(run[chosen]):
            part = chosen & (run == number)
            order = np.argsort(x[part], kind="stable")
            plot.line(x[part][order], y[part][order], role, width=0.6)
        targets = np.unique(x[chosen])
        plot.line(targets, [y[chosen & (x == target)].mean() for target in targets], role, width=2.0)
    title = f"{AXES[axis]}: deviation over target; blue: positive direction, orange: negative; thick: means"
    note = f"blue: +{AXES[axis]}, orange: \N{MINUS SIGN}{AXES[axis]}"
    return Picture(key, f"Runs along {AXES[axis]}", svg(key, title, [plot]), note=note)


def _circle_picture(data: Circles, plane: str, key: str) -> Picture:
    """A polar diagram; the deviations are enlarged until the largest takes a third of the radius."""
    part = data.part(np.flatnonzero(data.plane == list(PLANES).index(plane)))
    deviation_um = 1e3 * (part.deviation_mm - part.deviation_mm.mean())
    largest = float(np.abs(deviation_um).max()) or 1.0
    plot = Plot((-1.5, 1.5), (-1.5, 1.5), (55.0, 5.0, 195.0, 145.0), bare=True)
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    for radius, role in ((1.0, "muted"), (1.0 + 1 / 3, "grid"), (1.0 - 1 / 3, "grid")):
        plot.line(radius * np.cos(turn), radius * np.sin(turn), role, width=0.8)
    for role, sign in (("c0", 1), ("c1", -1)):
        for number in np.unique(part.run[part.direction == sign]):
            rows = np.flatnonzero((part.direction == sign) & (part.run == number))
            rows = rows[np.argsort(part.angle_rad[rows], kind="stable")]
            radius = 1.0 + deviation_um[rows] / (3.0 * largest)
            angle = part.angle_rad[rows]
            plot.line(radius * np.cos(angle), radius * np.sin(angle), role)
    note = f"grey circles: ±{largest:.3g} µm; blue: counter-clockwise, orange: clockwise"
    return Picture(key, f"Circle {plane}", svg(key, f"Circle in {plane}, radial deviation", [plot]), note=note)


def _deviation_pictures(data: Deviations, key: str) -> list[Picture]:
    """Arrows in the plane, and each measured component over the axis along which the points extend farthest."""
    axis = int(np.argmax(np.ptp(data.position_mm, axis=0)))
    pictures = []
    if np.isfinite(data.deviation_mm[:, :2]).all() and len(data.position_mm) <= MOST_ARROWS:
        x, y = data.position_mm[:, 0], data.position_mm[:, 1]
        largest = float(np.hypot(*data.deviation_mm[:, :2].T).max()) or 1.0
        times = 10.0 ** np.floor(np.log10(0.15 * max(np.ptp(x), np.ptp(y), 1.0) / largest))
        tip = data.position_mm[:, :2] + times * data.deviation_mm[:, :2]
        plot = _in_plane(np.concatenate([x, tip[:, 0]]), np.concatenate([y, tip[:, 1]]))
        plot.line(np.column_stack([x, tip[:, 0]]), np.column_stack([y, tip[:, 1]]), "c0", width=1.2)
        plot.dots(x, y, "line", size=3.0)
        note = f"enlarged {times:g} times; the largest {1e3 * largest:.3g} µm"
        picture = svg(f"{key}-plane", "Deviations in X and Y", [plot])
        pictures.append(Picture(f"{key}-plane", "Deviations in X and Y", picture, note=note))
    for component in range(3):
        y = 1e3 * data.deviation_mm[:, component]
        if not np.isfinite(y).any():
            continue
        name, letter = f"{key}-d{AXES[component]}", AXES[component].lower()
        x = data.position_mm[:, axis]
        plot = Plot(limits_of(x, margin=0.02), limits_of(y, zero=True), x_label=f"{AXES[axis]} (mm)", y_label="µm")
        plot.across(0.0)
        plot.dots(x, y, CYCLE[component], size=3.0)
        title = f"Deviation d{letter} over {AXES[axis]}"
        pictures.append(Picture(name, f"d{letter}", svg(name, title, [plot]), note=f"over {AXES[axis]}"))
    return pictures


def _in_plane(x: FloatArray, y: FloatArray) -> Plot:
    """Axes X and Y with the same scale that show all points."""
    (left, right), (low, high) = limits_of(x), limits_of(y)
    spare = 0.5 * ((high - low) * (BOX[2] - BOX[0]) / (BOX[3] - BOX[1]) - (right - left))
    across, up = max(spare, 0.0), max(-spare, 0.0) * (BOX[3] - BOX[1]) / (BOX[2] - BOX[0])
    return Plot((left - across, right + across), (low - up, high + up), x_label="X (mm)", y_label="Y (mm)")


def _artefact_pictures(data: Artefact, key: str) -> list[Picture]:
    """Where the probe found the features in the machine, in a colour for each set-up."""
    x, y = data.measured_mm[:, 0], data.measured_mm[:, 1]
    if not np.isfinite(x + y).any():
        return []
    plot = _in_plane(x, y)
    for number, setup in enumerate(np.unique(data.setup)):
        rows = data.setup == setup
        plot.dots(x[rows], y[rows], CYCLE[number % len(CYCLE)], size=3.0)
    picture = svg(f"{key}-XY", "Measured positions in X and Y", [plot])
    return [Picture(f"{key}-XY", "Measured positions", picture, note="one colour for each set-up")]


@lru_cache(maxsize=64)
def _drawn(
    path: Path, _stamp: tuple[int, int], answers: tuple[str, ...], key: str
) -> tuple[Sequence[Picture], Overview | None]:
    with warnings.catch_warnings():  # the command that reads the file shows them
        warnings.simplefilter("ignore", CompgenWarning)
        kind = native_format(path)
        data = describe_native(path, kind)[1] if kind else import_file(path, options_from(answers)).data
    seen = _overview_of_runs(data) if isinstance(data, AxisRuns) else None
    return pictures_of(data, key), data.overview() if isinstance(data, Displayed) else seen


def _overview_of_runs(data: AxisRuns) -> Overview:
    """What was measured along each axis."""
    rows = []
    for axis in data.axes:
        part = data.axis == axis
        targets, runs = np.unique(data.position_mm[part]), len(np.unique(data.run[part]))
        both = "both" if len(np.unique(data.direction[part])) == 2 else "one"
        rows.append((AXES[axis], str(len(targets)), f"{targets[0]:g}", f"{targets[-1]:g}", str(runs), both))
    header = ("axis", "targets", "from (mm)", "to (mm)", "runs", "directions")
    return Overview(f"{len(data)} readings along {', '.join(AXES[axis] for axis in data.axes)}", header, tuple(rows))


def measurement_shown(path: Path, answers: Sequence[str], key: str) -> tuple[Sequence[Picture], Overview | None]:
    """Return pictures of a measurement file and what was measured; nothing of one that is too large or cannot be read."""
    try:
        stat = path.stat()
        if stat.st_size > LARGEST_DRAWN or not path.is_file():  # a pipe has no end
            return (), None
        return _drawn(path, (stat.st_mtime_ns, stat.st_size), tuple(answers), key)
    except (OSError, CompgenError):
        return (), None


def options_from(answers: Sequence[str]) -> ImportOptions:
    """Return import options from words such as ``--axis=X`` and ``--unit=deviation=um``."""
    given: dict[str, Any] = {}
    named = {item.metadata["name"] or f"--{item.name.replace('_', '-')}": item.name for item in fields(ImportOptions)}
    for word in answers:
        option, _, value = word.partition("=")
        name = named[option]
        if name in ("units", "columns"):
            key, equals, right = value.partition("=")
            given.setdefault(name, {})[key if equals else "value"] = right if equals else key
        elif name == "ignore":
            given[name] = (*given.get(name, ()), value)
        else:
            given[name] = float(value) if name in ("radius_mm", "base_length_mm") else value
    return ImportOptions(**given)


# The machine: its chain as a drawing, the settings of its controls, and its file with some values changed.


def _box(corner: tuple[float, float, float], size: tuple[float, float, float], kind: str) -> str:
    """Three faces of a block in an oblique view: X to the right, Y to the back, Z up."""
    (x, y, z), (w, d, h) = corner, size

    def at(*point: float) -> str:
        return "{:.1f},{:.1f}".format(*_view(*point))

    front = [at(x, y, z), at(x + w, y, z), at(x + w, y, z + h), at(x, y, z + h)]
    top = [at(x, y, z + h), at(x + w, y, z + h), at(x + w, y + d, z + h), at(x, y + d, z + h)]
    side = [at(x + w, y, z), at(x + w, y + d, z), at(x + w, y + d, z + h), at(x + w, y, z + h)]
    faces = zip(("front", "top", "side"), (front, top, side), strict=True)
    return "".join(f'<polygon class="{kind} {face}" points="{" ".join(points)}"/>' for face, points in faces)


def _view(x: float, y: float, z: float) -> tuple[float, float]:
    return 20.0 + x + 0.55 * y, 262.0 - z - 0.4 * y


#: Half the arrow of each axis in the view, units of the picture.
_ARROWS = ((30.0, 0.0), (16.0, -11.6), (0.0, -26.0))


def _arrow(x: float, y: float, axis: int) -> str:
    """An arrow with two heads along an axis, with its letter."""
    dx, dy = _ARROWS[axis]
    letter = f'<text x="{x + dx + 5:.1f}" y="{y + dy + 5:.1f}">{AXES[axis]}</text>'
    return f'<path class="arrow" d="M{x - dx:.1f} {y - dy:.1f}L{x + dx:.1f} {y + dy:.1f}"/>{letter}'


#: Half the axes of the ellipse of a turn about X, Y, Z in the view, units of the picture.
_TURNS = ((7.0, 14.0), (15.0, 14.0), (20.0, 8.0))


def _turn(x: float, y: float, letter: str) -> str:
    """An arrow around a rotary axis, with its letter."""
    rx, ry = _TURNS[ROTARY.index(letter)]
    arc = f"M{x - 0.94 * rx:.1f} {y + 0.34 * ry:.1f}A{rx} {ry} 0 1 1 {x + 0.94 * rx:.1f} {y + 0.34 * ry:.1f}"
    return f'<path class="arrow" d="{arc}"/><text x="{x + rx + 5:.1f}" y="{y + 5:.1f}">{letter}</text>'


def _along(chain: Chain) -> tuple[list[str], list[str]]:
    """Axes that carry the tool, and axes that carry the workpiece, each from the foundation outwards."""
    tool = [letter for letter, tool_side in reversed(chain.passed) if tool_side]
    return tool, [letter for letter, tool_side in chain.passed if not tool_side]


def chain_picture(chain: Chain) -> Markup:
    """Draw which body carries which: the table side in front, the tool side on the column, an arrow for each axis."""
    bodies, arrows = [_box((0, 0, 0), (270, 130, 16), "bed"), _box((110, 96, 16), (56, 30, 172), "bed")], []
    on_tool, on_table = _along(chain)
    x, y, z, w, h = 104.0, 96.0, 112.0, 68.0, 60.0
    deep, apart = (22.0, 62.0) if len(on_tool) < 4 else (80.0 / len(on_tool), 212.0 / len(on_tool))
    for row, letter in enumerate(on_tool):  # each shows its top right edge beside the next, where its line begins
        y -= deep
        axis = (*AXES, *ROTARY).index(letter)
        bodies.append(_box((x, y, z), (w, deep, h), f"axis{axis}"))
        (px, py), (ax, ay) = _view(x + w, y + 0.64 * deep, z + h - 4.0), (326.0, 46.0 + apart * row)
        end = ax - (_ARROWS[axis][0] if axis < 3 else _TURNS[axis - 3][0]) - 7.0
        arrow = _arrow(ax, ay, axis) if axis < 3 else _turn(ax, ay, letter)
        arrows.append(f'<path class="leader" d="M{px:.1f} {py:.1f}L{end:.1f} {ay:.1f}"/>{arrow}')
        x, w, h = x + 6.0, w - 12.0, h - 8.0
    px, py = _view(x + 0.5 * w, y, z)
    bodies.append(f'<path class="tool" d="M{px - 6:.1f} {py:.1f}v14h12v-14zM{px - 2:.1f} {py + 14:.1f}v18h4v-18z"/>')
    left, front, z, width, depth = 24.0, 6.0, 16.0, 216.0, 66.0
    inset, low = (14.0, 17.0) if len(on_table) < 4 else (9.0, 16.0)
    for letter in on_table:
        axis = (*AXES, *ROTARY).index(letter)
        height = (30.0 if len(on_table) < 4 else 24.0) if axis in (2, 3, 4) else low
        bodies.append(_box((left, front, z), (width, depth, height), f"axis{axis}"))
        px, py = _view(left, front, z + 0.5 * height)
        right = px + (44.0, width - 20.0, 0.62 * width, 20.0, 0.42 * width, 0.7 * width)[axis]
        arrows.append(_arrow(right, py, axis) if axis < 3 else _turn(right, py, letter))
        left, front, width, depth, z = left + inset, front + 5.0, width - 2.0 * inset, depth - 10.0, z + height
    bodies.append(_box((left + 0.5 * width - 24.0, front + 6.0, z), (48, max(18.0, depth - 14.0), 16), "work"))
    title = f"{chain.name}: {in_words(chain)}"
    marker = (
        '<defs><marker id="head" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="7" markerHeight="7" '
        'orient="auto-start-reverse"><path class="head" d="M0 0L8 4L0 8z"/></marker></defs>'
    )
    drawn = f"{marker}{''.join([*bodies, *arrows])}"
    return Markup(f'<svg class="chain" viewBox="0 0 380 280" role="img" aria-label="{escape(title)}">{drawn}</svg>')


@dataclass(frozen=True)
class SettingField:
    """A key of a control as a field of a form: how it is given, its choices, meaning, present value and default.

    ``first`` are the keys that are set, and those that the open points of the control name.
    """

    key: str
    choices: Sequence[str]
    meaning: str
    value: str
    default: str
    kind: str
    first: bool


def settings_of(text: str, control: str) -> list[SettingField]:
    """Return the settings that a control declares, with the values of a machine file."""
    present = tomllib.loads(text).get("controllers", {}).get(control, {})
    declared = toml_files.section_schema(getattr(CONTROLLERS[control], "settings_class", object)).get("properties", {})
    found, points = [], " ".join(open_points(control))
    for key, about in declared.items():
        kind, choices = str(about.get("type", "")), [str(item) for item in about.get("enum", ())]
        if kind == "boolean":
            choices = ["true", "false"]
        value = "" if key not in present else toml_value(present[key], plain=True)
        default = "" if about.get("default") is None else toml_value(about["default"], plain=True)
        shown = "text" if all(isinstance(item, str) for item in about.get("enum", ("",))) and (
            choices or kind == "string"
        ) and kind != "boolean" else "toml"  # fmt: skip
        first = bool(value) or re.search(rf"\b{re.escape(key)}\b", points) is not None
        found.append(SettingField(key, choices, str(about.get("description", "")), value, default, shown, first))
    return found


def toml_value(value: Any, *, plain: bool = False) -> str:
    """Return a value as TOML writes it; with ``plain`` a text without its quotation marks."""
    if isinstance(value, str):
        return value if plain else json.dumps(value, ensure_ascii=False)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    return json.dumps(value)


def certificate_text(stated: Mapping[str, str]) -> str:
    """Return ``certificate.toml`` from what was typed into the form for the report.

    Raises
    ------
    InputError
        for a temperature that is no number.

    >>> print(certificate_text({"customer": "Muster", "instruments": "XL-80; 99AZ; D-1", "air_low": "19.8", "air_high": "20.6"}))
    [customer]
    name = "Muster"
    <BLANKLINE>
    [[equipment]]
    name = "XL-80"
    serial_number = "99AZ"
    certificate_number = "D-1"
    <BLANKLINE>
    [conditions]
    air_temperature_c = [19.8, 20.6]
    <BLANKLINE>
    """
    sections: dict[str, dict[str, str]] = {}
    for field, (section, key) in CERTIFICATE_FIELDS.items():
        if stated.get(field):
            sections.setdefault(f"[[{section}]]" if section == "person" else f"[{section}]", {})[key] = stated[field]
    blocks = [[head, *(f"{key} = {toml_value(text)}" for key, text in own.items())] for head, own in sections.items()]
    for row in filter(None, map(str.strip, stated.get("instruments", "").splitlines())):
        parts = zip(("name", "serial_number", "certificate_number"), map(str.strip, row.split(";", 2)), strict=False)
        blocks.append(["[[equipment]]", *(f"{key} = {toml_value(text)}" for key, text in parts if text)])
    known = {"air": "air_temperature_c", "machine": "machine_temperature_c"}
    ranges = {
        key: [stated[n] for n in (f"{place}_low", f"{place}_high") if stated.get(n)] for place, key in known.items()
    }
    lines = [
        f"{key} = [{_degrees(texts[0], key)}, {_degrees(texts[-1], key)}]" for key, texts in ranges.items() if texts
    ]
    blocks += [["[conditions]", *lines]] if lines else []
    return "\n\n".join("\n".join(block) for block in blocks) + "\n"


def _degrees(text: str, field: str) -> float:
    value = parse_number(text.replace(",", "."))
    if value is None:
        raise InputError(f"{text!r} is no temperature; write e.g. 20.4", field=field)
    return value


def open_points(control: str) -> Sequence[str]:
    """Return what no public document of the vendor settles about a control."""
    return [" ".join(text.split()) for text in load_format(control).unverified]


# Results.


def error_pictures(path: Path, fitted: Path | None = None) -> list[Picture]:
    """Return a picture of each identified error with its uncertainty, and smoothed if there is such a file."""
    errors = read_errors(path)
    smooth = None if fitted is None else read_errors(fitted)
    return [draw_curve(name, errors, smooth, {}) for name in errors.curves]


def volume_pictures(step: Step, folder: Path) -> Sequence[Picture]:
    """Return the error in the volume, in space and in slices: of tables before and after, otherwise of errors.

    ``folder`` is that of the step, or contains the folders ``before`` and ``after`` of two identifications; without
    machine and errors there is no picture.
    """
    sides = [side for side in (folder / "before", folder / "after") if side.is_dir()] or [folder]
    paths = [path for path in (folder / "volume.csv",) if path.is_file()]
    paths = paths or [path for side in sides for path in (side / "machine.toml", side / "identified.errors.csv")]
    try:
        if not all(path.is_file() for path in paths):
            return ()
        stats = [path.stat() for path in paths]
        return _volume_drawn(tuple(paths), tuple((stat.st_mtime_ns, stat.st_size) for stat in stats), step.number)
    except (OSError, ValueError, CompgenError):
        return ()


@lru_cache(maxsize=16)
def _volume_drawn(paths: Sequence[Path], _stamps: tuple[tuple[int, int], ...], number: int) -> Sequence[Picture]:
    if paths[0].name == "volume.csv":
        stated = paths[0].parent / "result.json"
        grid = grid_of(
            read_volume(paths[0]), uncertainty_um(json.loads(stated.read_text())) if stated.is_file() else None
        )
    else:
        machine = read_machine(paths[0])
        levels_mm = [np.linspace(*axis.range_mm, VOLUME_LEVELS) for axis in machine.axes]
        points_mm = full_grid(levels_mm)
        sides = [
            exact_error(machine, read_errors(path), points_mm.reshape(-1, 3)).reshape(points_mm.shape)
            for path in paths[1::2]
        ]
        grid = VolumeOnGrid((levels_mm[0], levels_mm[1], levels_mm[2]), sides[0], sides[1] if len(sides) > 1 else None)
    return () if grid is None else (draw_space(grid, number), *draw_slices(grid, number, {}))


def summary_shown(files: Mapping[str, Path], facts: Mapping[str, Any]) -> Summary | None:
    """Return what matters of an identification; None if its machine or errors cannot be read."""
    machine, errors = files.get("machine.toml"), files.get("identified.errors.csv")
    if machine is None or errors is None:
        return None
    try:
        with warnings.catch_warnings():  # the command that wrote the files showed them
            warnings.simplefilter("ignore", CompgenWarning)
            return summary_of(read_machine(machine), read_errors(errors), facts)
    except (OSError, ValueError, LookupError, CompgenError):
        return None


def squareness_rows(path: Path) -> list[tuple[str, float, float]]:
    """Return name, value and standard uncertainty (urad, nan if unknown) of the squareness errors of a file."""
    return [(name, 1e6 * value, 1e6 * u) for name, (value, u) in read_errors(path).squareness.items()]


def shrink_picture(rows: Sequence[tuple[str, FloatArray | Sequence[float]]]) -> Markup:
    """Draw bars of the residual before and after, one pair for each name; um rms."""
    top = max((max(values) for _, values in rows), default=1.0) or 1.0
    drawn = []
    for k, (name, (before, after)) in enumerate(rows):
        y = 8 + 44 * k
        drawn.append(f'<text x="0" y="{y + 18}">{escape(name)}</text>')
        for shift, value, role in ((0, before, "before"), (18, after, "after")):
            width = 240.0 * value / top
            drawn.append(f'<rect class="{role}" x="150" y="{y + shift}" width="{width:.1f}" height="14"/>')
            drawn.append(f'<text x="{156 + width:.1f}" y="{y + shift + 12}">{value:.3g} µm</text>')
    return Markup(
        f'<svg class="shrink" viewBox="0 0 480 {16 + 44 * len(rows)}" role="img" aria-label="Residual before and after">'
        f"{''.join(drawn)}</svg>"
    )


def machine_problem(path: Path) -> str:
    """Return why a machine file cannot be read, "" if it can."""
    try:
        tomllib.loads(machine_text(path))
    except (InputError, ValueError, RecursionError) as error:
        return str(error)
    return ""


def machine_text(path: Path) -> str:
    """Return the text of a machine file; InputError if there is none, or something that is not a file."""
    if not path.is_file():
        raise InputError("no such file; choose the machine again", file=path)
    return read_text(path)


def gap_picture(diagnosis: Mapping[str, Any]) -> Markup:
    """Draw how much of the residual a named effect explains, on the readings used and on those left out."""
    names = {"train": "readings used", "heldout_lines": "lines left out", "heldout_stations": "stations left out",
             "heldout_times": "times left out"}  # fmt: skip
    rows = [
        (words, (float(part["before_rms_um"]), float(part["after_rms_um"])))
        for name, words in names.items()
        if isinstance(part := (diagnosis.get("gap") or {}).get(name), Mapping)
        and all(isinstance(part.get(key), int | float) for key in ("before_rms_um", "after_rms_um"))
    ]
    return shrink_picture(rows) if rows else Markup("")


def proposed_measurements(facts: Mapping[str, Any]) -> list[tuple[dict[str, Any], Picture]]:
    """What to measure next, with how each instrument stands."""
    rows = list(proposed_rows(facts.get("next_measurements")))
    pictures = {picture.key: picture for picture in draw_proposed(rows)}
    return [(row, pictures[f"next-{k}"]) for k, row in enumerate(rows) if f"next-{k}" in pictures]


# What each page of a project shows.


def machine_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return the machine, its settings with what is open, and the machines to choose from."""
    machine, text, problem = state.machine, "", ""
    path = machine_file(project, state)
    if path is not None:
        problem = machine_problem(path)
        with contextlib.suppress(InputError):  # the problem says so
            text = machine_text(path)
    parsed = {} if problem or not text else tomllib.loads(text)
    chain = str(parsed.get("chain", ""))
    controls = [name for name in parsed.get("controllers", {}) if name in CONTROLLERS]
    return {
        "machine": machine, "text": text, "parsed": parsed,
        "chain": Chain(chain) if chain and not problem else None, "in_words": in_words, "picture": chain_picture,
        "shipped": sorted(machine_files(())), "example": Chain("WXYFZT"), "chains": [Chain(name) for name in CHAINS],
        "cards": [load_format(name) for name in sorted(CONTROLLERS)], "classes": CLASS_WORDS,
        "controls": [(load_format(name), settings_of(text, name), open_points(name))
                     for name in controls],
        "checked": state.last("machine"),
    }  # fmt: skip


def machine_file(project: Project, state: ProjectState) -> Path | None:
    """Return the file of the machine of a project."""
    machine = state.machine
    if machine is None:
        return None
    return project.path(machine) if machine.endswith(".toml") else machine_files(()).get(machine)


def plan_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return the plans of a measurement with the predicted uncertainty of each error, the latest first."""
    found = []
    for step in (other for other in reversed(state.steps) if other.kind == "plan"):
        facts = project.facts(step, "plan.json")
        predicted = facts.get("u") or {**facts.get("curves", {}), **facts.get("squareness", {})}
        rows = [
            (name, item.get("u_max_where_read") or item.get("u_max", item.get("u")), item.get("unit", ""))
            for name, item in predicted.items()
        ]
        views = list(project.pages_of(step))
        proposed = proposed_measurements(facts)
        current = state.is_current(step)
        found.append(
            {"step": step, "facts": facts, "rows": rows, "views": views, "current": current, "proposed": proposed}
        )
    last = state.last("plan")
    return {"results": found, "typed": {"circles": "", "poses": ""} if last is None else last.data["typed"]}


def measurement_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return the measurements of before the correction."""
    open_files = [item for item in state.measurements if not item.after and not item.used]
    return {
        "items": shown_measurements(project, state, after=False), "names": SQUARENESS_NAMES, "axes": AXES,
        "ready": state.machine is not None and not open_files, "current": state.current("identify") is not None,
    }  # fmt: skip


def shown_measurements(project: Project, state: ProjectState, *, after: bool) -> list[dict[str, Any]]:
    """Return each measurement with its pictures and questions."""
    shown = []
    for item in state.measurements:
        if item.after != after:
            continue
        path, key, answers = project.path(item.file), f"m{item.number}", item.step.data["answers"]

        def given(word: str, name: str, path: Path = path, answers: Sequence[str] = answers) -> Sequence[Picture]:
            return measurement_shown(path, (*answers, word), name)[0]

        pictures, overview = ((), None) if item.questions else measurement_shown(path, answers, key)
        shown.append(
            {
                "item": item,
                "summary": item.step.data["summary"],
                "pictures": pictures,
                "overview": overview,
                "sheet": next(
                    (step for step in reversed(state.steps) if step.data.get("sheet_of") == item.step.number), None
                ),
                "questions": questions_shown(item.step.data["summary"], f"q{item.number}", given),
                "columns": columns_shown(path, answers, item.step.data["summary"]),
            }
        )
    return shown


def can_be_diagnosed(state: ProjectState) -> bool:
    """Whether ``volcomp diagnose`` reads all measurements that a result is calculated from."""
    used = [item for item in state.measurements if item.used and not item.after]
    return bool(used) and all(item.step.data["summary"]["kind"] not in ("part", "artefact", "errors") for item in used)


def result_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return what was identified and diagnosed last, and whether it is up to date."""
    step = state.last("identify")
    files = {} if step is None else project.files_of(step)
    errors = files.get("identified.errors.csv")
    before = [
        other for other in state.steps if other.kind == "identify" and step is not None and other.number < step.number
    ]
    found, diagnosis = state.last("diagnose"), {}
    if found is not None:
        diagnosis = project.facts(found, "diagnosis.json")
    shown = state.current("run") or step
    volume = () if shown is None else volume_pictures(shown, project.path(shown.folder))
    applied = found is not None and state.machine == f"{found.folder}/extended.toml"
    earlier = project.facts(before[-1], "identify.json") if before and applied else {}
    seen = summary_shown(files, project.facts(step, "identify.json")) if step else None
    return {
        "summary": seen, "summary_pictures": [] if seen is None else draw_summary(seen),
        "step": step, "facts": project.facts(step, "identify.json"), "errors": errors, "earlier": earlier,
        "assumed": assumptions_of(project.facts(step, "identify.json")) if step else [],
        "pictures": (drawn := error_pictures(errors) if errors else []),
        "proposed": proposed_measurements(project.facts(step, "identify.json")),
        "volume": volume, "volume_tables": None if shown is step else shown,
        "values": {picture.key: picture.data for picture in (*drawn, *volume)},
        "squareness": squareness_rows(errors) if errors else [],
        "current": state.current("identify") is not None, "views": list(project.pages_of(step)),
        "handed": state.last("certificate"), "can_print": browser() is not None,
        "found": found, "diagnosis": diagnosis, "diagnosed_views": list(project.pages_of(found)),
        "gap": gap_picture(diagnosis), "applied": applied,
        "may_add": found is not None and "extended.toml" in project.files_of(found) and not applied,
        "current_diagnosis": state.current("diagnose") is not None, "diagnosable": can_be_diagnosed(state),
    }  # fmt: skip


def tables_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return the tables that were made, the controls side by side, and verified backups."""
    path = machine_file(project, state)
    parsed = {} if path is None or machine_problem(path) else tomllib.loads(machine_text(path))
    runs = [step for step in state.steps if step.kind == "run"]
    results = [
        {
            "step": step, "result": project.facts(step, "result.json"), "files": project.files_of(step),
            "current": state.is_current(step),
            "views": list(project.pages_of(step)), "control": step.data["control"],
            "volume": volume_pictures(step, project.path(step.folder)) if step is runs[-1] else (),
            "judged": judged(step.data["control"], project.facts(step, "result.json")),
        }
        for step in reversed(runs)
    ]  # fmt: skip
    verified = [
        {"step": step, "result": project.facts(step, "result.json"), "control": step.data["control"],
         "judged": judged(step.data["control"], project.facts(step, "result.json"))}
        for step in reversed(state.steps)
        if step.kind == "verify"
    ]  # fmt: skip
    step = state.last("options")
    controls = list(parsed.get("controllers", {}))
    return {
        "values": {picture.key: picture.data for item in results for picture in item["volume"]},
        "options": project.facts(step, "options.json"), "options_step": step, "results": results, "verified": verified,
        "options_current": state.current("options") is not None,
        "controls": controls, "chosen": results[0]["control"] if results else next(iter(controls), ""),
        "identified": state.current("identify"),
        "misfit_codes": MISFIT_CODES, "diagnosable": can_be_diagnosed(state),
        "fit": dict(runs[-1].data.get("fit", {})) if runs else {},
        "sampled": sorted(name for name in CONTROLLERS if CONTROLLERS[name].sample_setting),
        "cards": [load_format(name) for name in sorted(CONTROLLERS)],
    }  # fmt: skip


def control_files(project: Project, step: Step) -> list[str]:
    """Return the files that a step wrote for the control, as paths in the project."""
    listed = [str(item.get("name")) for item in project.facts(step, "result.json").get("files", ())]
    return [f"{step.folder}/{name}" for name in project.files_of(step) if name in listed]


def program_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return the NC program with its set-up, and what was predicted and corrected with it, the latest first."""
    step = state.last("program")
    found = [
        {
            "step": other, "current": state.is_current(other), "views": list(project.pages_of(other)),
            "part": project.facts(other, "part.json"), "correction": project.facts(other, "correction.json"),
            "files": project.files_of(other),
        }
        for other in reversed(state.steps)
        if other.kind in ("part", "correct")
    ]  # fmt: skip
    tables = [
        other
        for other in state.steps
        if other.kind == "run" and project.facts(other, "result.json").get("accepted") and state.is_current(other)
    ]
    return {
        "identified": state.current("identify"), "results": found, "tables": tables, "dialects": list(DIALECTS),
        "typed": {name: "" for name in PROGRAM_FIELDS} | ({} if step is None else dict(step.data["typed"])),
        "kept": {} if step is None else step.data,
    }  # fmt: skip


#: What to do where the points of two measurements differ: the word that ``volcomp compare`` takes, and what it means.
ALIGN = {
    "": "refuse, and say which",
    "common": "only what both have",
    "interpolate": "interpolate both within the common range",
    "model": "compare the errors identified from each",
}


#: Kinds of files that are compared with the same axes only.
BY_AXIS = ("axis", "diagonals")


def kind_of(item: Measurement) -> str:
    """Return the kind of a measurement file as ``volcomp import`` names it."""
    return str(item.step.data["summary"]["kind"])


def pairs_of(before: Sequence[Measurement], after: Sequence[Measurement]) -> list[tuple[Measurement, Measurement]]:
    """Return the axis runs and diagonals that both sides have once: of one kind, along the same axes."""

    def key(item: Measurement) -> tuple[str, str]:
        found = item.step.data["summary"]["understood"]
        along = [found.get(name, found.get("columns", {}).get(name)) for name in ("axis", "diagonal")]
        return kind_of(item), json.dumps(along)

    sides = [[key(item) for item in side] for side in (before, after)]
    return [
        (item, after[sides[1].index(own)])
        for item, own in zip(before, sides[0], strict=True)
        if own[0] in BY_AXIS and [side.count(own) for side in sides] == [1, 1]
    ]


def after_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return the measurements of after the correction, and the comparisons, the latest first."""
    found: list[dict[str, Any]] = [
        {
            "step": step, "facts": project.facts(step, "compare.json"), "views": list(project.pages_of(step)),
            "current": (current := state.is_current(step)),
            "volume": volume_pictures(step, project.path(step.folder)) if current else (),
        }
        for step in reversed(state.steps)
        if step.kind == "compare"
    ]  # fmt: skip
    before, after = (
        [item for item in state.measurements if item.after == side and item.used] for side in (False, True)
    )
    pairs = pairs_of(before, after)
    paired = [item.number for pair in pairs for item in pair]
    return {
        "items": shown_measurements(project, state, after=True), "results": found, "align": ALIGN,
        "before": before, "after": after,
        # an axis that the other side does not have is left out unless the user chooses it
        "alone": [item.number for item in (*before, *after) if pairs and kind_of(item) in BY_AXIS and item.number not in paired],
        "values": {picture.key: picture.data for item in found for picture in item["volume"]},
    }  # fmt: skip


def project_page(project: Project, state: ProjectState) -> dict[str, Any]:
    """Return all steps with their commands and files, and what belongs to none."""
    recorded = {step.folder for step in state.steps}
    left = [item.name for item in sorted(project.folder.iterdir()) if re.match(r"\d+-", item.name)]
    path = machine_file(project, state)
    parsed = {} if path is None or machine_problem(path) else tomllib.loads(machine_text(path))
    return {
        "steps": [(step, [command_line(words) for words in step.commands]) for step in reversed(state.steps)],
        "files": {step.number: list(project.files_of(step)) for step in state.steps},
        "left": [name for name in left if name not in recorded], "script": project.script(),
        "controls": list(parsed.get("controllers", {})), "handed": state.last("recal"),
    }  # fmt: skip


#: What each page of a project shows, by its name.
SHOWN: dict[str, Callable[[Project, ProjectState], dict[str, Any]]] = {
    "machine": machine_page, "plan": plan_page, "measurement": measurement_page, "result": result_page, "tables": tables_page,
    "program": program_page, "after": after_page, "project": project_page,
}  # fmt: skip
