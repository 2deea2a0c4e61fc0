"""Readings of dial gauges and levels as a shop writes them down: squares, straightedges, tramming over a span, levels.

What moves, and where the plunger points, is in the names of the columns (``X arm (plunger +Y) [um]``). A growing reading means
that the tool moves towards what is touched, so the error is the reading along the direction of the plunger. Arms and
straightedges that were measured turned over as well are averaged, which takes out their own errors.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ARMS, SPANS_KEY, Curve, ErrorTable, format_spans, marked_apart
from compgen.data.names import MM_PER_UM
from compgen.errors import InputError
from compgen.foreign.answers import ImportOptions
from compgen.foreign.cells import CellGrid, Table, find_table
from compgen.foreign.column_names import (
    FIELDS,
    MM_PER_LENGTH,
    RAD_PER_ANGLE,
    known_unit,
    motions_in,
    split_name,
    unaccented,
)
from compgen.foreign.findings import Imported
from compgen.foreign.questions import AXIS, Asking, Choice
from compgen.foreign.source import parse_number, shown

_PLUNGER_WORDS = r"plunger|taster|messtaster|stylus|fuhler|messuhr|dial|gauge|indicator|palpeur|tastatore"
_LEVEL_WORDS = r"level|wasserwaage|richtwaage|libelle|neigung\w{0,20}+|niveau|livella"
_SOME = re.compile(rf"(?i)(?<![a-zü])(?:{_PLUNGER_WORDS}|fühler|{_LEVEL_WORDS})")
_PLUNGER = re.compile(rf"(?:{_PLUNGER_WORDS})[^xyz+-]{{0,60}}+([+-]?)\s{{0,9}}+([xyz])\b")
_DIRECTION = re.compile(r"([+-])\s*([xyz])")
_TRAVEL = re.compile(
    r"\b([xyz])[\s-]*(?:arm|schenkel|travel|achse|axis|verfahr\w*|weg|branche|braccio)\b|"
    r"\b(?:along|entlang|la?e?ngs|travel|arm|schenkel|verfahrweg|axis|achse|le long de)\s+([xyz])\b"
)
_TURNED = re.compile(r"reversed|turned|umgeschlagen|umschlag|gedreht|gewendet|retourne|capovolt")
_LEVEL = re.compile(
    rf"(?:{_LEVEL_WORDS})\s{{0,9}}+(?:(?:along|entlang|la?e?ngs|in|le long de|lungo)\s{{0,9}}+)?+([xyz])\b"
)
#: Columns of a list of arms.
_SPAN = frozenset(
    [
        "span",
        "lange",
        "messlange",
        "length",
        "base",
        "basis",
        "weg",
        "messweg",
        "abstand",
        "distance",
        "longueur",
        "durchmesser",
        "diameter",
    ]
)
_READING = frozenset(
    [
        "reading",
        "deviation",
        "difference",
        "anzeige",
        "ablesung",
        "abweichung",
        "differenz",
        "change",
        "lecture",
        "lettura",
    ]
)
_WAY = frozenset(["travel", "axis", "achse", "verfahrweg", "arm", "schenkel", "along", "bewegung", "verfahrachse"])
_TOUCH = frozenset(
    ["plunger", "taster", "messtaster", "stylus", "fuhler", "messuhr", "dial", "gauge", "indicator", "touching"]
)
_STATE = frozenset(["state", "setup", "lage", "stellung", "square", "winkel", "position", "orientation"])
#: Standard uncertainty of a reading, um, and of a square, urad, where the file states none.
USUAL_READING_UM, USUAL_SQUARE_URAD = 1.0, 5.0
#: Rotation of a moving body by a level along X or Y: error, and sign where it is on the spindle side (ISO 841, right-handed).
_TILT = {"X": ("B", -1.0), "Y": ("A", 1.0)}


@dataclass
class _Arm:
    """Readings along one axis, towards another: positions, and the error of the machine as each set-up shows it, mm."""

    position_mm: FloatArray
    plain: list[FloatArray] = field(default_factory=list)
    turned: list[FloatArray] = field(default_factory=list)

    def mean_mm(self) -> FloatArray:
        """Return the mean of both set-ups, or of the only one."""
        found = [np.mean(values, axis=0) for values in (self.plain, self.turned) if values]
        return np.asarray(np.mean(found, axis=0))

    @property
    def both(self) -> bool:
        return bool(self.plain and self.turned)

    @property
    def readings(self) -> int:
        return len(self.plain) + len(self.turned)


def dial_readings(grid: CellGrid, options: ImportOptions, form: str) -> Imported | None:
    """Return the errors that readings of dial gauges or levels show; None for any other table.

    Raises
    ------
    InputError
        for a plunger without a direction, spans without a length, units that are none of length or angle.
    """
    if options.kind not in (None, "errors") or not any(
        _SOME.search(cell) for row in grid.rows[:60] for cell in row if parse_number(cell) is None
    ):
        return None
    listed = _listed(grid, options)
    if listed is not None:
        return _squares(grid, form, listed, *_above(grid.rows), ["the file is a list of arms"])
    try:
        table = find_table(grid, options.decimal)
    except InputError:
        return None
    names = [name for name in table.header if name not in options.ignore]
    levels = [name for name in names if _level(name)]
    plungers = [name for name in names if re.search(rf"(?:{_PLUNGER_WORDS})", unaccented(name))]
    if levels and not plungers:
        return _levels(table, levels, options, form)
    return _edges(table, plungers, options, form) if plungers else None


def _level(name: str) -> re.Match[str] | None:
    flat = re.sub(r"[\[(][^\[(\])]*+[\])]", " ", unaccented(name))
    return None if motions_in(name) else _LEVEL.search(flat)


# Arms of squares, and straightedges: a column for each over the position.


def _edges(table: Table, names: Sequence[str], options: ImportOptions, form: str) -> Imported:
    place = _position(table, names)
    position_mm = np.array(table.numbers(place)) * _mm_of_place(table.grid, place, table.header_line)
    arms: dict[str, _Arm] = {}
    _nothing_left(table, [place, *names], options)
    for name in names:
        error, sign, turned = _meaning(table, name)
        values = np.array(table.numbers(name, empty=True)) * sign * _mm_of(table.grid, name, table.metadata)
        known = np.isfinite(values)
        if known.sum() < 2:
            raise table.grid.fail("has fewer than two readings", table.header_line, name)
        if len(np.unique(position_mm[known])) < known.sum():
            raise table.grid.fail("has a position twice; give the mean of repeats", table.header_line, place)
        arm = arms.setdefault(error, _Arm(position_mm[known]))
        if not np.array_equal(arm.position_mm, position_mm[known]):
            text = f"the columns of {error} have readings at different positions; measure both set-ups at the same ones"
            raise table.grid.fail(text, table.header_line)
        (arm.turned if turned else arm.plain).append(values[known])
    said = {key.lower(): value for key, value in table.metadata.items()}
    return _squares(table.grid, form, arms, said, table.grid.notes, [])


def _position(table: Table, names: Sequence[str]) -> str:
    rest = [name for name in table.header if name not in names]
    words = (*FIELDS["position"], *FIELDS["x"], *FIELDS["y"], *FIELDS["z"], "weg", "stelle")
    found = [name for name in rest if split_name(name).word in words]
    if not found:
        raise table.grid.fail(
            f"no column of positions beside {', '.join(map(repr, names))}; name it Position [mm]", table.header_line
        )
    return found[0]


def _nothing_left(table: Table, used: Sequence[str], options: ImportOptions) -> None:
    for name in table.header:
        cells = [cell for cell in table.column(name) if cell]
        numeric = cells and sum(parse_number(cell) is not None for cell in cells) * 2 >= len(cells)
        if numeric and name not in used and name not in options.ignore and split_name(name).word not in ("nr", "no"):
            text = f"the column of numbers {name!r} is not understood: state travel and plunger in its name, or --ignore {name!r}"
            raise table.grid.fail(text, table.header_line)


def _meaning(table: Table, name: str) -> tuple[str, float, bool]:
    """Return the error of a column, the sign of its readings, and whether the edge was turned over."""
    flat = unaccented(name)
    plunger = _PLUNGER.search(flat)
    if plunger is None or not plunger[1]:
        text = "does not say where the plunger points: write plunger +Y or plunger -Y (towards what it touches)"
        raise table.grid.fail(text, table.header_line, name)
    travel = _TRAVEL.search(re.sub(_PLUNGER, " ", flat)) or _TRAVEL.search(
        unaccented(" ".join([*table.metadata, *table.metadata.values()]))
    )
    if travel is None:
        raise table.grid.fail("does not say which axis moves: write X arm, or along X", table.header_line, name)
    return (
        _error(table.grid, travel[1] or travel[2], plunger[2], table.header_line),
        _sign(plunger[1]),
        bool(_TURNED.search(flat)),
    )


def _error(grid: CellGrid, travel: str, towards: str, line: int | None) -> str:
    if travel == towards:
        raise grid.fail(f"a plunger along {towards.upper()} does not read the straightness of {travel.upper()}", line)
    return f"E{towards}{travel}".upper()


def _sign(text: str) -> float:
    return -1.0 if text == "-" else 1.0


def _mm_of(grid: CellGrid, name: str, metadata: Mapping[str, str]) -> float:
    unit = split_name(name).unit or next(
        (known_unit(value) for key, value in metadata.items() if key in ("unit", "units", "einheit")), None
    )
    if unit not in MM_PER_LENGTH:
        what = f"{unit} is not a unit of length" if unit else "has no unit"
        raise grid.fail(f"{what}: write the unit of the readings, for example [um] or [mm]", None, name)
    return MM_PER_LENGTH[unit]


def _mm_of_place(grid: CellGrid, name: str, line: int | None) -> float:
    """Return the unit of positions or spans in mm; mm where the column names none."""
    unit = split_name(name).unit or "mm"
    if unit not in MM_PER_LENGTH:
        raise grid.fail(f"{unit} is not a unit of length: where the reading was taken is in mm or in", line, name)
    return MM_PER_LENGTH[unit]


def _squares(
    grid: CellGrid,
    form: str,
    arms: Mapping[str, _Arm],
    said: Mapping[str, str],
    notes: Sequence[str],
    more: Sequence[str],
) -> Imported:
    """Return squareness of pairs of arms, straightness of edges; each with what was assumed."""
    notes = [*notes, *more, "a growing reading is counted as: the tool moves towards what the plunger touches"]
    u_mm, about_u = _u_reading(said)
    notes.append(about_u)
    understood: dict[str, object] = {}
    squareness: dict[str, tuple[float, float]] = {}
    spans_mm: dict[str, tuple[float, float]] = {}
    used: set[str] = set()
    for name, (first, second) in ARMS.items():
        if first not in arms or second not in arms:
            continue
        value, u, text = _squareness(name, arms[first], arms[second], u_mm, said)
        squareness[name] = value, u
        used |= {first, second}
        notes.append(text)
        spans_mm[name] = (float(np.ptp(arms[first].position_mm)), float(np.ptp(arms[second].position_mm)))
        spans = " and ".join(f"{span:g}" for span in spans_mm[name])
        understood[name] = f"{1e6 * value:.4g} urad, u {1e6 * u:.3g} urad, over {spans} mm ({first}, {second})"
    curves = {}
    for error, arm in arms.items():
        if error in used:
            continue
        if len(arm.position_mm) < 3:
            pair = next(pair for pair in ARMS.values() if error in pair)
            other = pair[1] if pair[0] == error else pair[0]
            text = (
                f"{error} at two places shows how the edge lay: it is no squareness without the other arm ({other}); give "
                "both arms, or 0 for the one that was aligned"
            )
            raise grid.fail(text)
        order = np.argsort(arm.position_mm)
        values = arm.mean_mm()
        u_each = np.full(len(order), u_mm / np.sqrt(arm.readings))
        curves[error] = Curve(arm.position_mm[order], values[order] - values[order][0], u_each)
        reversal = "the errors of the straightedge are taken out by its reversal" if arm.both else (
            "the straightedge counts as straight: measure it turned over as well (column with the word reversed)"
        )  # fmt: skip
        notes.append(f"{error}: {reversal}; the slope is how it lay")
        understood[error] = f"{len(order)} positions, up to {np.abs(curves[error].value).max() / MM_PER_UM:.4g} um"
    metadata = {"source": grid.path.name, "instrument": "dial gauge"}
    if spans_mm:
        metadata[SPANS_KEY] = format_spans(spans_mm)
    table = marked_apart(ErrorTable(curves, squareness, metadata))
    return Imported(grid.path, form, "errors", table, understood, (), tuple(dict.fromkeys(notes)))


def _squareness(name: str, first: _Arm, second: _Arm, u_mm: float, said: Mapping[str, str]) -> tuple[float, float, str]:
    """Return a squareness error, its standard uncertainty (rad), and what was assumed of the square.

    The X arm turned by a slope a (EYX) and the Y arm by b (EXY): EC0Y = -b - a + s, where s is what the square has more than 90
    degrees; likewise EA0Z, and EB0Z = b + a - s, which is positive below 90 degrees.
    """
    sign = 1.0 if name == "EB0Z" else -1.0
    reversal = first.both and second.both
    slopes, variance = [], 0.0
    for arm in (first, second):
        order = np.argsort(arm.position_mm)
        span = float(np.ptp(arm.position_mm))
        values = arm.mean_mm()[order]
        slopes.append(float(values[-1] - values[0]) / span)
        variance += 2.0 * u_mm**2 / arm.readings / span**2
    square, u_square, text = (
        (0.0, 0.0, "the error of the square is taken out by its reversal") if reversal else _square(said)
    )
    value = sign * (sum(slopes) - square)
    return value, float(np.sqrt(variance + u_square**2)), f"{name}: {text}"


_STATED = re.compile(
    r"(?<![\d.,])([-+]?\d++(?:[.,]\d++)?+)\s*+(?:(?:\u00b1|\+-|\+/-)\s*+(\d++(?:[.,]\d++)?+)\s*+)?+"
    r"([a-z\u00b5\u03bc\"]++(?:/[a-z\u00b5\u03bc]++)*+)?+\s*+(?:/\s*+(\d++(?:[.,]\d++)?+)\s*+(?:mm)?+)?+\s*+$"
)
_SQUARE_KEYS = re.compile(
    r"square.{0,60}(error|deviation)|(error|deviation).{0,60}square|winkelfehler|abweichung.{0,60}winkel|winkel.{0,60}abweichung"
)


def _square(said: Mapping[str, str]) -> tuple[float, float, str]:
    """Return what the square has more than 90 degrees, its standard uncertainty, rad, and the words for it."""
    for key, text in said.items():
        if not _SQUARE_KEYS.search(unaccented(key)):
            continue
        found = _STATED.search(unaccented(text).strip())
        unit = known_unit(found[3] or "") if found else None
        over = _number(found[4]) if found and found[4] else None
        scale = RAD_PER_ANGLE.get(unit or "") or (
            MM_PER_LENGTH[unit] / over if unit in MM_PER_LENGTH and over else None
        )
        if found is None or scale is None or unaccented(text).strip()[: found.start()].strip():
            raise InputError(
                f"{shown(text)} is not an angle such as 3 urad, 0.5 \u00b1 0.2 arcsec or 1.5 um/300 mm", field=key
            )
        u = _number(found[2]) * scale if found[2] else USUAL_SQUARE_URAD * 1e-6
        stated = "" if found[2] else f", u {USUAL_SQUARE_URAD:g} urad assumed"
        return _number(found[1]) * scale, u, f"the square has {text} more than 90 degrees as stated{stated}"
    text = (
        f"the square counts as exact within u = {USUAL_SQUARE_URAD:g} urad (assumed): state 'Square error: 0 \u00b1 2 urad', or "
        "turn it over"
    )
    return 0.0, USUAL_SQUARE_URAD * 1e-6, text


def _number(text: str) -> float:
    return float(text.replace(",", "."))


_U_KEYS = re.compile(
    r"(?:(?:expanded|standard|erweiterte|elargie|estesa)\s+)?+(?:mess)?+(?:u\b|uncertainty|unsicherheit|incertitude|incertezza)"
)
_U_STATED = re.compile(r"\s*+(\d++(?:[.,]\d++)?+)\s*+([a-z\u00b5\u03bc\"]++(?:/[a-z]++)?+)?+\s*+(?:$|[(;,]|k\b)")
_EXPANDED = re.compile(r"k\s*=\s*2|95\s*%|expanded|erweiterte|elargie|estesa")


def _u_stated(said: Mapping[str, str], units: Mapping[str, float], usual: str) -> float | None:
    """Return the standard uncertainty of one reading that a record states, in the unit of ``units``; None if it states none."""
    for key, text in said.items():
        flat = unaccented(key)
        if not _U_KEYS.match(flat):
            continue
        found = _U_STATED.match(unaccented(text))
        unit = known_unit(found[2]) if found and found[2] else usual
        if found is None or unit is None or unit not in units or _number(found[1]) == 0.0:
            raise InputError(
                f"{shown(text)} is not the uncertainty of a reading, such as 0.5 {usual} or 1 {usual} (k = 2)",
                field=key,
            )
        expanded = bool(_EXPANDED.search(f"{flat} {unaccented(text)}"))
        return _number(found[1]) * units[unit] / (2.0 if expanded else 1.0)
    return None


def _u_reading(said: Mapping[str, str]) -> tuple[float, str]:
    """Return the standard uncertainty of one reading, mm, and the words for it."""
    value = _u_stated(said, MM_PER_LENGTH, "um")
    if value is not None:
        return value, f"standard uncertainty of a reading {value / MM_PER_UM:g} um, as stated"
    return (
        USUAL_READING_UM * MM_PER_UM,
        f"no uncertainty is stated: u = {USUAL_READING_UM:g} um assumed for a reading (line 'u: 0.5 um')",
    )


# A list of arms: what moves, where the plunger points, over which span, and how much the reading grew.


def _listed(grid: CellGrid, options: ImportOptions) -> dict[str, _Arm] | None:
    for k, row in enumerate(grid.rows[:60]):
        words = [re.sub(r"[^a-z]", "", split_name(unaccented(cell)).word) for cell in row]
        at = {
            what: next((n for n, word in enumerate(words) if word in known), None)
            for what, known in (("way", _WAY), ("touch", _TOUCH), ("span", _SPAN), ("reading", _READING))
        }
        if None not in at.values():
            return _list(grid, k, {key: int(n) for key, n in at.items() if n is not None}, words)
    return None


def _list(grid: CellGrid, k: int, at: Mapping[str, int], words: Sequence[str]) -> dict[str, _Arm]:
    state = next((n for n, word in enumerate(words) if word in _STATE and n not in at.values()), None)
    scale = _mm_of(grid, grid.rows[k][at["reading"]], {})
    span_unit = _mm_of_place(grid, grid.rows[k][at["span"]], grid.lines[k])
    arms: dict[str, _Arm] = {}
    for row, line in zip(grid.rows[k + 1 :], grid.lines[k + 1 :], strict=True):
        cells = [*row, *[""] * (len(grid.rows[k]) - len(row))]
        if not any(cells):
            continue
        travel = re.search(r"([xyz])\b", unaccented(cells[at["way"]]))
        touch = _DIRECTION.search(unaccented(cells[at["touch"]]))
        span, reading = (parse_number(cells[at[key]]) for key in ("span", "reading"))
        if travel is None or touch is None or span is None or reading is None or span == 0:
            text = f"{shown(' '.join(cells), 60)} is not an arm: travel X, plunger +Y, a span above zero and a reading"
            raise grid.fail(text, line)
        error = _error(grid, travel[1], touch[2], line)
        arm = arms.setdefault(error, _Arm(np.array([0.0, span * span_unit])))
        if arm.position_mm[1] != span * span_unit:
            raise grid.fail(
                f"{error} was read over {arm.position_mm[1]:g} mm above; give both set-ups over one span", line
            )
        values = np.array([0.0, reading * scale * _sign(touch[1])])
        turned = state is not None and _TURNED.search(unaccented(cells[state])) is not None
        (arm.turned if turned else arm.plain).append(values)
    return arms


def _above(rows: Sequence[Sequence[str]]) -> tuple[dict[str, str], list[str]]:
    """Return lines such as ``u: 0.5 um`` of a file, by their key."""
    said: dict[str, str] = {}
    for row in rows:
        text = " ".join(cell for cell in row if cell).lstrip("# ")
        key, mark, value = text.partition(":" if ":" in text else "=")
        if mark and value.strip():
            said.setdefault(key.strip().lower(), value.strip())
    return said, []


# Levels: the angle of a moving body over the position of its axis.


def _levels(table: Table, names: Sequence[str], options: ImportOptions, form: str) -> Imported:
    """Return the angles that a level along X or Y shows on the body that moves; a positive number: the end at + rises."""
    place = _position(table, names)
    _nothing_left(table, [place, *names], options)
    said = {key.lower(): value for key, value in table.metadata.items()}
    letters = re.findall(r"(?<![a-z])([xyz])(?![a-z])", unaccented(split_name(place).name).replace("_", " "))
    lines = unaccented(" ; ".join([f"{key} {value}" for key, value in said.items()]))
    travel = _TRAVEL.search(lines)
    axis = options.axis or (letters[0] if letters else (travel[1] or travel[2]) if travel else "")
    asking = Asking()
    if not axis:
        asking.ask("the file does not state which axis moved", "axis", AXIS, "give --axis")
    side = _side(said) or options.mounted
    if side is None:
        asking.ask(
            "the file does not state whether the level was on the spindle side or on the table (the signs are opposite)",
            "mounted",
            (
                Choice("spindle", "on the spindle side: it moves with the tool"),
                Choice("table", "on the table, with the workpiece"),
            ),
            "give --mounted spindle or table",
            picture="level",
        )
    position_mm = np.array(table.numbers(place)) * _mm_of_place(table.grid, place, table.header_line)
    if len(np.unique(position_mm)) < max(2, len(position_mm)):
        text = "needs two positions or more, each once; give the mean of repeats"
        raise table.grid.fail(text, table.header_line, place)
    order = np.argsort(position_mm)
    stated = _u_stated(said, RAD_PER_ANGLE, "urad")
    curves, understood = {}, {}
    for name in names:
        found = _level(name)
        assert found is not None  # the caller chose these
        along = found[1].upper()
        if along not in _TILT:
            raise table.grid.fail("a level lies along X or Y", table.header_line, name)
        unit = split_name(name).unit
        if unit not in RAD_PER_ANGLE:
            raise table.grid.fail("write the unit of the level: mm/m, um/m, arcsec or urad", table.header_line, name)
        letter, sign = _TILT[along]
        error = f"E{letter}{(axis or 'X').upper()}"
        values = np.array(table.numbers(name)) * RAD_PER_ANGLE[unit] * sign * (-1.0 if side == "table" else 1.0)
        digits = max((len(cell.partition(".")[2]) for cell in table.column(name)), default=0)
        u = stated or max(10.0**-digits * RAD_PER_ANGLE[unit] / np.sqrt(12.0), 1e-6)
        curves[error] = Curve(position_mm[order], values[order] - values[order][0], np.full(len(order), u))
        understood[error] = (
            f"level along {along}: {len(order)} positions, up to {1e6 * np.abs(curves[error].value).max():.4g} urad"
        )
    notes = [
        *table.grid.notes,
        "a positive number is counted as: the end at + of the level rises",
        f"standard uncertainty of a reading {stated / 1e-6:g} urad, as stated"
        if stated
        else "u of a reading: a digit / sqrt(12), at least 1 urad",
    ]
    data = marked_apart(ErrorTable(curves, {}, {"source": table.grid.path.name, "instrument": "level"}))
    return Imported(table.grid.path, form, "errors", data, understood, tuple(asking.questions), tuple(notes))


def _side(said: Mapping[str, str]) -> str | None:
    """Return on which body a level was, by a line such as ``Level on: table``."""
    for key, value in said.items():
        text = unaccented(f"{key} {value}")
        if not re.search(rf"{_LEVEL_WORDS}|mounted|sitzt|steht", text):
            continue
        if re.search(r"\b(?:spindle|spindel|head|kopf|ram|pinole|spindelstock)\b", text):
            return "spindle"
        if re.search(r"\b(?:table|tisch|workpiece|werkstuck)\b", text):
            return "table"
    return None
