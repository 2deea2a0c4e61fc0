"""Logs of measuring cycles with several lines for each feature: those of HEIDENHAIN's cycles 421 ..., of CYCLE977, of FN 15.

Controls print a heading, then nominal and measured values in sections, in columns or one coordinate in a line. The log becomes a
table, one row for each feature; :mod:`compgen.foreign.coordinate_reports` reads that one, with its questions.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from compgen.data.names import AXES
from compgen.errors import InputError
from compgen.foreign.cells import CellGrid
from compgen.foreign.coordinate_reports import names_setting
from compgen.foreign.source import Text, shown

_NOMINAL, _ACTUAL, _DEVIATION = "Nominal", "Actual", "Deviation"
_WORDS = {
    _NOMINAL: "set\\W?points?|sollwerte?|soll|nominal|nom|target",
    _ACTUAL: "actual|act|istwerte?|ist|measured|meas|gemessen|messwerte?",
    _DEVIATION: "deviations?|dev|differences?|diff|abweichung(?:en)?|abw|differenz(?:en)?",
}
#: Names of axes in logs of HEIDENHAIN, with the tool along Z.
_BY_NAME = {"reference axis": "X", "hauptachse": "X", "minor axis": "Y", "nebenachse": "Y", "touch probe axis": "Z"}
_PLANE = re.compile(r"(?i)\b(reference axis|minor axis|hauptachse|nebenachse)\b")
_TOKEN = re.compile(
    "(?i)"
    + "|".join(rf"(?P<{role}>\b(?:{words})\b)" for role, words in _WORDS.items())
    + rf"|(?P<named>\b(?:{'|'.join(_BY_NAME)})\b)|(?P<axis>(?<![\w.])[XYZ](?![\w.]))"
    + r"|(?P<number>(?<![\w.,])[-+]?\d{1,7}+(?:[.,]\d{1,9}+)?+(?![\w.,]*\d))"
)
#: Lines about something else than a place.
_OTHER = re.compile(
    r"(?i)\b(?:max|min|limits?|grenz\w*|tol\w*|upper|lower|ober\w*|unter\w*|diamet\w*|durchm\w*|width|breite|angle|winkel|radius|"
    r"date|time|datum|zeit|uhrzeit|program\w*|messprogramm|height|h\u00f6he|maximum\w*|minimum\w*)\b|gr\u00f6\u00dft|kleinst"
)
_STAMP = re.compile(r"(?i)(?<![\s,;|])[\s,;|]*+\b(?:date|time|datum|zeit|uhrzeit)\b.*$")
_UNIT = re.compile(r"(?i)[.,]\d{1,9}\s?(mm|inch|in|\")(?!\w)")


@dataclass
class _Block:
    """The values of one feature: cells by role and axis, and the line where it begins."""

    name: str
    line: int
    cells: dict[tuple[str, str], str] = field(default_factory=dict)

    @property
    def axes(self) -> list[str]:
        return [axis for axis in AXES if any(key[1] == axis for key in self.cells)]

    def roles(self, axis: str) -> set[str]:
        return {role for role, own in self.cells if own == axis}

    @property
    def whole(self) -> bool:
        """Whether each coordinate has two values of three."""
        return bool(self.cells) and all(len(self.roles(axis)) > 1 for axis in self.axes)


@dataclass
class _Reading:
    """Where the reader of a log is: what the last heading said, the open feature, and those that are complete."""

    source: Text
    section: str | None = None
    columns: tuple[str, ...] = ()
    title: str = ""
    block: _Block | None = None
    found: list[_Block | tuple[int, str]] = field(default_factory=list)

    def close(self) -> None:
        if self.block is not None and self.block.cells:
            self.found.append(self.block)
        self.block = None

    def put(self, role: str, axis: str, number: str, line: int) -> None:
        """Add a value; one that the open feature has already begins the next feature."""
        if self.block is not None and (role, axis) in self.block.cells:
            self.close()
        if self.block is None:
            self.block = _Block(self.title or f"line {line}", line)
            self.title = ""
        self.block.cells[role, axis] = number


def grid_of_log(source: Text, ignore: Sequence[str] = ()) -> CellGrid | None:
    """Return a log with several lines for each feature as a table, or None for anything else.

    Raises
    ------
    InputError
        for a value that is named and has no number, a feature that has a nominal coordinate and none measured, and one that
        has other coordinates than the others, unless it is in ``ignore``.
    """
    reading = _Reading(source)
    problem: InputError | None = None
    for number, line in enumerate(source.text.split("\n"), start=1):
        try:
            if not _read_line(reading, line.strip(), number):
                return None
        except InputError as error:  # of a log only if there is one
            problem = problem or error
    reading.close()
    blocks = [item for item in reading.found if isinstance(item, _Block)]
    if not any(block.whole for block in blocks):
        return None
    if problem is not None:
        raise problem
    for block in blocks:
        for axis in block.axes:
            if len(block.roles(axis)) < 2:
                what = block.roles(axis).pop().lower()
                text = f"feature {shown(block.name)} has one {what} value of {axis} alone: complete it, or take it out"
                raise source.fail(text, block.line)
    names = _names(blocks)
    first = blocks[0]
    for block in blocks:
        if block.axes != first.axes and names[id(block)] not in ignore:
            name, mine, others = shown(names[id(block)]), " and ".join(block.axes), " and ".join(first.axes)
            text = f"feature {name} has a place in {mine}, and the first one in {others}: complete it, or give --ignore {name}"
            raise source.fail(text, block.line)
    return _as_grid(reading, blocks, names)


def _read_line(reading: _Reading, line: str, number: int) -> bool:
    """Take a line into account; False where the file is no such log."""
    if not re.search(r"\w", line):
        reading.section, reading.columns = (reading.section, reading.columns) if not line else (None, ())
        return True
    if names_setting(line):
        reading.close()
        reading.found.append((number, line))
        return True
    tokens = [(str(found.lastgroup), found[0]) for found in _TOKEN.finditer(line)]
    roles = [kind for kind, _ in tokens if kind in _WORDS]
    axes = [kind for kind, _ in tokens if kind in ("axis", "named")]
    if len(set(roles)) > 1 and len({text for kind, text in tokens if kind in ("axis", "named")}) > 1:
        return False  # a table, or all of a feature in one line
    if _OTHER.search(line):
        if not any(kind == "number" for kind, _ in tokens):
            reading.section, reading.columns = None, ()
        elif not axes and not roles and reading.block is None:
            _name(reading, line)
        return True
    if axes and any(kind == "number" for kind, _ in tokens) and (roles or reading.section or reading.columns):
        return _read_values(reading, tokens, line, number)
    if axes and (roles or (reading.section and re.search("[:=]", line))):
        raise reading.source.fail(f"{shown(line, 60)} names a value and has no number", number)
    if roles and not any(kind == "number" for kind, _ in tokens):
        reading.section, reading.columns = (roles[0], ()) if len(roles) == 1 else (None, tuple(roles))
        return True
    _name(reading, line)
    return True


def _name(reading: _Reading, line: str) -> None:
    """Take a line that holds no value of a place: it ends a feature, and the first one names the next."""
    if line.endswith(":"):
        reading.section, reading.columns = None, ()
        return
    if re.fullmatch(r"[^:=]*[:=]\s*[-+]?\d+[.,]\d+\s*\w{0,4}", line) or re.match(r"(?i)(end|ende)\b", line):
        return
    if reading.block is not None and reading.block.whole:
        reading.close()
    if reading.block is None and not reading.title:
        reading.title = " ".join(_STAMP.sub("", line).strip(" \t*-=#:;|").split())[:60]


def _read_values(reading: _Reading, tokens: list[tuple[str, str]], line: str, number: int) -> bool:
    """Read ``setpoint X= 1.0 actual X= 1.1``, ``SOLL X 1.0 Y 2.0``, ``X: nominal 1.0 actual 1.1``, or columns below names."""
    roles = {kind for kind, _ in tokens if kind in _WORDS}
    axes = {text.lower() for kind, text in tokens if kind in ("axis", "named")}
    if reading.columns and not roles:
        numbers = [text for kind, text in tokens if kind == "number"]
        if len(axes) != 1 or tokens[0][0] == "number" or len(numbers) != len(reading.columns):
            text = f"{shown(line, 60)} has not the columns of the line above: {', '.join(reading.columns)}"
            raise reading.source.fail(text, number)
        for column, text in zip(reading.columns, numbers, strict=True):
            reading.put(column, _axis(*tokens[0]), text, number)
        return True
    role: str | None = reading.section
    axis, open_ = "", False
    for kind, text in tokens:
        if kind == "number":
            if role is None or not axis or not open_:
                raise reading.source.fail(f"{shown(line, 60)} has a number {text} that nothing names", number)
            reading.put(role, axis, text, number)
            open_ = False
            continue
        fresh = _axis(kind, text) if kind in ("axis", "named") else axis
        if open_ and ((kind in _WORDS and role is not None and axis) or (kind not in _WORDS and fresh != axis != "")):
            raise reading.source.fail(f"{shown(line, 60)} names a value and has no number", number)
        role, axis, open_ = (kind if kind in _WORDS else role), fresh, True
    if open_:
        raise reading.source.fail(f"{shown(line, 60)} names a value and has no number", number)
    return True


def _axis(kind: str, text: str) -> str:
    return text.upper() if kind == "axis" else _BY_NAME[text.lower()]


def _as_grid(reading: _Reading, blocks: list[_Block], names: Mapping[int, str]) -> CellGrid:
    """Return the features as rows, with the lines about set-ups, zeros and units between them."""
    axes = [axis for axis in AXES if any(axis in block.axes for block in blocks)]
    roles = [
        role
        for role in (_NOMINAL, _ACTUAL, _DEVIATION)
        if all(role in block.roles(axis) for block in blocks for axis in block.axes)
    ]
    head = ["Feature", *(f"{role} {axis}" for axis in axes for role in roles)]
    rows, lines = [head], [blocks[0].line]
    units = {found[1].lower() for found in _UNIT.finditer(reading.source.text)} - {"mm"}
    if units:
        rows.append(["Units: inch"])
        lines.append(blocks[0].line)
    for item in reading.found:
        if isinstance(item, _Block):
            rows.append([names[id(item)], *(item.cells.get((role, axis), "") for axis in axes for role in roles)])
            lines.append(item.line)
        else:
            rows.append([item[1]])
            lines.append(item[0])
    notes = ["the log has several lines for each feature; lines about sizes, limits and angles are not used"]
    if _PLANE.search(reading.source.text):
        notes.append("reference and minor axis were read as X and Y: the tool along Z")
    return CellGrid(reading.source.path, rows, lines, tuple(notes))


def _names(blocks: list[_Block]) -> dict[int, str]:
    """Return the names of features; where one heading serves several places, each place has its number."""
    places: dict[str, list[tuple[str, ...]]] = {}
    found = {}
    for block in blocks:
        own = places.setdefault(block.name, [])
        place = tuple(block.cells.get((_NOMINAL, axis), "") for axis in AXES)
        if place not in own:
            own.append(place)
        found[id(block)] = (block.name, own.index(place) + 1)
    return {key: name if len(places[name]) == 1 else f"{name} {number}" for key, (name, number) in found.items()}
