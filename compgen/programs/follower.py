"""A second reading of NC programs: where a control goes by a text, from that text and what is set at the control alone.

It shares no state, no table of codes and no splitting into words with :mod:`compgen.programs.reader`, by which programs are
corrected: what that takes a program for, and what was written from it, is held against the moves that are found here. It
explains nothing: what cannot be followed has been refused by the reader before. Numbers of drilling cycles are kept as the
program gives them, and become heights when a hole is drilled.
"""

from __future__ import annotations

import cmath
import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine, Vector3
from compgen.errors import InputError
from compgen.programs.path import CCW, CONTOUR, CW, ENTRY, EXIT, FEED, PLAIN, RAPID, STILL, IntArray, Moves, in_all
from compgen.programs.reader import Batch, Reader, Setup

Place = list[float]
_NOWHERE = (math.nan,) * 3
#: X and Y with radius compensation: where the program says, on the way to the contour, beside it, on the way from it.
_FREE, _COMING, _BESIDE, _GOING = range(4)
#: A move along X and Y of less than that is none, mm.
_RESTS_MM = 1e-7
#: Heights that differ by less are one, mm: sums of the same numbers in another order.
_ROUNDED_MM = 1e-7
#: Dialects that begin a program in mm, whatever the unit of the machine is.
_STARTS_IN_MM = ("heidenhain-iso", "heidenhain-klartext", "grbl")
_NUMBER = r"(?:[-+]\s*+)?(?:\d++\.?\d*+|\.\d++)"

# Words: name and value. What is no word (comments, texts) is left out. Blanks and digits are taken once and for all (possessive).

_PLAIN = re.compile(rf"\([^()\n]*+\)|;[^\n]*+|(?P<name>[A-Z])\s*+(?P<number>{_NUMBER})")
_HEIDENHAIN = re.compile(
    rf";[^\n]*+|(?P<name>Q\d++(?=\s*+=)|P\d\d(?=[\s+-])|D[LR](?=\s*+[-+])|[A-Z])\s*+=?\s*+"
    rf"(?:(?P<number>{_NUMBER})|\"(?P<text>[^\"\n]*+)\")"
    r"|(?P<word>[A-Z_]\w*+)",
    re.IGNORECASE,
)
_SIEMENS = re.compile(
    r";[^\n]*+"
    r"|(?P<name>[XYZ]1(?=\s*+=)|[SM]\d++(?=\s*+=)|[A-Z_]{2}\w*+\s*+(?:\[[^\[\]\n]*+\]\s*+)?(?==)|[A-Z](?=\s*+[-+=.\d\"]))\s*+=?\s*+"
    rf"(?:(?P<mode>AC|IC|DC|ACP|ACN)\s*+\(\s*+(?P<inner>{_NUMBER})\s*+\)|\"(?P<text>[^\"\n]*+)\"|(?P<number>{_NUMBER}))"
    r"|(?P<call>[A-Z_]\w*+)\s*+\((?P<inside>(?:\"[^\"\n]*+\"|[^()\"\n]|\([^()\n]*+\))*+)\)"
    r"|(?P<word>[A-Z_]\w*+)",
    re.IGNORECASE,
)
#: Numbers of codes that are written as they are named.
_SHORT = frozenset(str(k) for k in range(1000))
_LEXERS = {"siemens": _SIEMENS, "heidenhain-iso": _HEIDENHAIN}


@dataclass
class _Words:
    """The words of a block: codes in order, numbers by address, addresses with a mode of their own, calls with their text."""

    codes: list[str] = field(default_factory=list)
    number: dict[str, float] = field(default_factory=dict)
    mode: dict[str, str] = field(default_factory=dict)
    name: str = ""
    #: Addresses whose number has no decimal point.
    whole: list[str] = field(default_factory=list)
    call: tuple[str, str] | None = None

    @staticmethod
    def of(text: str, dialect: str) -> _Words:
        """Split a block."""
        found = _Words()
        if dialect not in _LEXERS:
            for name, value in _PLAIN.findall(text.upper()):
                if name:
                    found._put(name, value)
            return found
        for word in _LEXERS[dialect].finditer(text):
            part = word.groupdict()
            if part.get("call"):
                found.call = part["call"].upper(), part["inside"]
                found.codes.append(found.call[0])
            elif part.get("word"):
                found.codes.append(part["word"].upper())
            elif part["name"]:
                found._take(part["name"].upper(), part)
        return found

    def _take(self, name: str, part: dict[str, str | None]) -> None:
        if part.get("text") is not None:
            self.name = str(part["text"]).upper() if name == "T" else self.name
            return
        if part.get("mode") and name not in self.number:
            self.mode[name] = str(part["mode"]).upper()
        self._put(name, part["number"] or part.get("inner") or "nan")

    def _put(self, name: str, text: str) -> None:
        try:
            value = float(text)
        except ValueError:  # a blank between the sign and the digits
            value = float("".join(text.split()))
        if name in ("G", "M"):
            self.codes.append(name + (text if text in _SHORT else f"{value:g}"))
        elif name not in self.number:
            self.number[name] = value
            if "." not in text:
                self.whole.append(name)

    def axes(self) -> list[float | None]:
        """Numbers of X, Y and Z."""
        get = self.number.get
        return [get("X", get("X1")), get("Y", get("Y1")), get("Z", get("Z1"))]


# Blocks in a row of nothing but places, and the fewest that are followed together.

_LEAST_RUN = 8

_COMMENTS = {"fanuc": r"\([^()\n]*+\)", "siemens": r";[^\n]*+", "heidenhain-iso": r";[^\n]*+"}
_OTHER_COMMENTS = r"\([^()\n]*+\)|;[^\n]*+"


def _runs(dialect: str, *, pointed: bool = False) -> re.Pattern[str]:
    """The pattern of such blocks; of HEIDENHAIN without arcs, whose centre is a pole. ``pointed``: without increments."""
    straight = dialect == "heidenhain-iso"
    number = r"(?:\d++\.\d*+|\.\d++|0++(?![\d.]))" if pointed else r"(?:\d++\.?\d*+|\.\d++)"
    place = (
        rf"(?:[XYZ{'' if straight else 'IJKR'}][+-]?{number}|[FS][+-]?(?:\d++\.?\d*+|\.\d++)|M0?[345789](?![\d.]))[ ]*+"
    )
    head = rf"(?:N\d++[ ]*+)?(?:G(?:0?[0-{1 if straight else 3}]|9[01])(?![\d.])[ ]*+)*+"
    tail = rf"(?:[*;][ ]*+)?(?:(?:{_COMMENTS.get(dialect, _OTHER_COMMENTS)})[ ]*+)*+"
    return re.compile(rf"(?:^{head}(?:{place})*+{tail}\r?\n)+", re.MULTILINE | re.IGNORECASE)


_BLANK_LETTERS = bytes(32 if chr(k).isalpha() or chr(k) in "*;" else k for k in range(256))
_COLUMN_OF = np.array([b"XYZIJKR".find(bytes([k])) for k in range(256)])


def _places(given_mm: FloatArray, at: FloatArray, zero: FloatArray, relative: NDArray[np.bool_]) -> FloatArray:
    """Places (n + 1, 3) before the first block and after each, from the numbers (n, 3) of the blocks.

    An axis is where its last number in absolute says, or where it was at first, and by all increments since then farther.
    """
    every = np.vstack([at, np.where(relative[:, None], np.nan, given_mm + zero)])
    last = np.maximum.accumulate(np.where(np.isnan(every), 0, np.arange(len(every))[:, None]))
    found = np.take_along_axis(every, last, axis=0)
    if relative.any():
        steps = np.where(relative[:, None], np.nan_to_num(given_mm), 0.0)
        way = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        found += way - np.take_along_axis(way, last, axis=0)
    return found


def _carried(given: IntArray, before: int) -> IntArray:
    """The last of some modal numbers at each block, -1 where a block gives none; ``before`` that at the first."""
    last = np.maximum.accumulate(np.where(given >= 0, np.arange(1, len(given) + 1), 0))
    return np.asarray(np.append(before, given)[last])


# What the codes of each dialect do to a position, with a number. A code that is not here does nothing to it.

_Does = dict[str, tuple[str, float]]


def _each(what: str, *codes: object, number: float = 0.0) -> _Does:
    """Codes that do the same; a number is that of a G code."""
    return {code if isinstance(code, str) else f"G{code}": (what, number) for code in codes}


_EVERYWHERE: _Does = {
    **{f"G{k}": ("go", float(k)) for k in range(4)},
    **{"G17": ("plane", 2.0), "G18": ("plane", 1.0), "G19": ("plane", 0.0)},
    **{"G90": ("relative", 0.0), "G91": ("relative", 1.0), "G4": ("dwell", 0.0)},
    **{"G40": ("side", 0.0), "G41": ("side", 1.0), "G42": ("side", -1.0)},
}
_COMMON: _Does = {
    **_EVERYWHERE,
    **{"G20": ("unit", 25.4), "G21": ("unit", 1.0)},
    **_each("fixture", *range(54, 60)),
    **_each("machine", 53),
    **_each("home", 28, 30),
    **_each("no length", 49),
    **_each("end", 80),
    **_each("preset", 92),
    **_each("no preset", 92.1),
}
_GRBL: _Does = {
    **_COMMON,
    **_each("store", 28.1, 30.1),
    **_each("typed length", 43.1),
    **_each("lost", 38.2, 38.3, 38.4, 38.5),
    **_each("datum", 10),
}
_CYCLES: _Does = {
    **{f"G{k}": ("cycle", float(k)) for k in (73, 81, 82, 83, 85, 86, 89)},
    **{"G98": ("to R", 0.0), "G99": ("to R", 1.0), "G43": ("length", 0.0)},
}
#: How a shift counts: in place of that of the named axes, of all axes, further, or not at all.
_NAMED, _ANEW, _MORE, _OFF = range(4)
_TABLES: dict[str, _Does] = {
    "heidenhain-klartext": {},
    "grbl": _GRBL,
    "linuxcnc": {
        **_GRBL,
        **_CYCLES,
        **_each("no preset", 92.2),
        **_each("offset", 52),
        **_each("tap", 33.1),
        **{"G41.1": ("side", 1.0), "G42.1": ("side", -1.0)},
        **{"G90.1": ("centre", 1.0), "G91.1": ("centre", 0.0)},
        **_each("fixture", 59.1, 59.2, 59.3),
    },
    "fanuc": {
        **_COMMON,
        **_CYCLES,
        **{"G74": ("cycle", 84.0), "G84": ("cycle", 84.0), "G76": ("cycle", 86.0), "G88": ("cycle", 86.0)},
        **_each("fixture", *range(110, 130), 154, 54.1),
        **_each("frame", 52),
        **_each("lost", 31),
        **_each("datum", 10),
        **_each("quiet", 5, 5.1, 8, 103, 187, 22, 23, 25, 26, 54.2, 54.4),
    },
    "siemens": {
        **_EVERYWHERE,
        **{"G70": ("unit", 25.4), "G700": ("unit", 25.4), "G71": ("unit", 1.0), "G710": ("unit", 1.0)},
        **_each("fixture", *range(54, 60), *range(505, 600)),
        **_each("no fixture", 500),
        **_each("machine", 53, 153, "SUPA"),
        **_each("lost", 74, 75),
        **_each("quiet", 25, 26),
        **_each("modally", "MCALL"),
        **_each("turn", "CYCLE800", *(f"CYCLE{k}" for k in range(971, 998))),
        **_each("frame", "TRANS", number=_ANEW),
        **_each("frame", "ATRANS", number=_MORE),
        **_each("frame", "ROT", "SCALE", "MIRROR", number=_OFF),
        **_each("define", *(f"CYCLE{k}" for k in (*range(81, 90), 840))),
    },
    "heidenhain-iso": {
        **_EVERYWHERE,
        **{"G70": ("unit", 25.4), "G71": ("unit", 1.0)},
        **_each("pole", 29),
        **_each("again", 5),
        **_each("once", "FMAX"),
        **_each("quiet", 30, 31, 62, 36, 51, 98),
        **_each("frame", 54),
        **_each("tool", 99),
        **_each("hole", 79, "M99"),
        **_each("modally", "M89"),
        **_each("machine", "M91"),
        **_each("define", 83, 84, 85, *range(200, 300)),
        **_each("turn", *range(400, 500)),
    },
}
#: What takes the words of its block for itself, so that they are no move.
_TAKES_WORDS = {"quiet", "dwell", "frame", "offset", "typed length", "store", "turn", "tool", "datum"}
_ENDS = {"siemens": ("M2", "M17", "M30")}
#: Cycles that leave the depth at feed, and where the arguments of a cycle of SINUMERIK say what its depth counts from.
_BACK_AT_FEED = {"CYCLE84", "CYCLE840", "CYCLE85", "CYCLE89", "G84", "G85", "G201", "G202", "G206", "G207", "G209"}
_DEPTH_MODE = {"CYCLE81": 8, "CYCLE82": 8, "CYCLE83": 19, "CYCLE84": 23, "CYCLE840": 19, "CYCLE85": 10, "CYCLE86": 13}


@dataclass
class _Hole:
    """A cycle that one block defines: its name and numbers."""

    name: str
    number: dict[str, float]

    @staticmethod
    def of_call(name: str, inside: str) -> _Hole:
        """Return a cycle of SINUMERIK from the text between its parentheses."""
        parts = [part.strip() for part in inside.split(",")]
        given = {k: float(re.sub(r"\s", "", part)) for k, part in enumerate(parts) if re.fullmatch(_NUMBER, part)}
        names = {0: "RTP", 1: "RFP", 2: "SDIS", 3: "DP", 4: "DPR", _DEPTH_MODE.get(name, -1): "AMODE"}
        return _Hole(name, {names[k]: value for k, value in given.items() if k in names})

    def heights(self, start: float) -> tuple[float, float, float]:
        """Where feed begins and ends, and where the tool is left; ``start`` is where it is before."""
        n = self.number
        if self.name.startswith("CYCLE"):
            from_plane = "DPR" in n if n.get("AMODE", 0.0) % 10 == 0 else n["AMODE"] % 10 == 1
            reference = n.get("RFP", 0.0)
            depth = reference - abs(n.get("DPR", 0.0)) if from_plane else n.get("DP", 0.0)
            return reference + abs(n.get("SDIS", 0.0)), depth, n.get("RTP", 0.0)
        if "P02" in n:
            return start, start + math.copysign(n.get("P01", 0.0), n["P02"]) + n["P02"], start
        top = n.get("Q203", 0.0)
        return top + n.get("Q200", 0.0), top + n.get("Q201", 0.0), top + max(n.get("Q200", 0.0), n.get("Q204", 0.0))


@dataclass
class _Series:
    """Numbers of a drilling cycle of G codes, as the program gives them, from its first block to its end."""

    kind: int
    #: Z of the program at the first hole (Y in G18, X in G19), and the machine position of its zero there (mm).
    level: float
    zero: float
    z: float = math.nan
    r: float = math.nan
    q: float = 0.0


@dataclass(frozen=True)
class _Plan:
    """What the codes of a block do, whether it then moves, ends the program, and leaves zero and tool as they are."""

    does: list[tuple[str, str, float]]
    kinds: frozenset[str]
    executes: bool
    ends: bool
    only_goes: bool


class Follower:
    """Follows the blocks of a program in order: ``at`` is where the axes of the machine are (mm), nan if that is not known.

    Of the machine it takes where G28 leads, and the tool while no tool length is active.
    """

    def __new__(cls, dialect: str, *_: object) -> Follower:
        """Klartext has a follower of its own."""
        return super().__new__(KlartextFollower if dialect == "heidenhain-klartext" else cls)

    def __init__(self, dialect: str, setup: Setup, machine: Machine) -> None:
        self.dialect, self.setup, self.bare_tool_mm = dialect, setup, machine.tool_offset_mm
        self.table = _TABLES[dialect]
        self.linuxcnc, self.heidenhain = dialect == "linuxcnc", dialect.startswith("heidenhain")
        self.at: Place = [math.nan] * 3
        self.homes = {"G28": list(machine.reference_place_mm), "G30": [math.nan] * 3}
        self.fixture: Sequence[float] = setup.work_offsets_mm.get("PRESET" if self.heidenhain else "G54", _NOWHERE)
        #: Work offsets as they are now, and which of them is in force.
        self.datums: dict[str, Sequence[float]] = dict(setup.work_offsets_mm)
        self.datum = "G54"
        self.preset, self.frame, self.length = [0.0] * 3, [0.0] * 3, [0.0] * 3
        self.lengthened = False
        self.lengths = dict(setup.tools_mm)
        self.spindle = self.chosen = ""
        self.unit = 25.4 if dialect not in _STARTS_IN_MM and machine.units == "inch" else 1.0
        self.relative, self.plane, self.centre_from_zero = False, 2, False
        self.motion: int | None = 0 if dialect == "grbl" else None
        self.turned: int | None = None
        self.pole: Place = [math.nan] * 3
        self.series: _Series | None = None
        self.to_r = self.linuxcnc
        self.hole: _Hole | None = None
        self.modally = False
        self.done = self.moved = self.percent = False
        self.number = 0
        counted = dialect == "fanuc" and setup.integers == "increments" and setup.increment_mm is not None
        #: Length of an increment in mm, where numbers without a decimal point are increments.
        self.increment_mm = float(setup.increment_mm or 0.0) if counted else 0.0
        self.runs, self.comments = _runs(dialect, pointed=counted), re.compile(_COMMENTS.get(dialect, _OTHER_COMMENTS))
        #: Moves, and the zeros and tools in force, of which each move has the number.
        self.rows: list[tuple[float, ...]] = []
        self.zeros: list[tuple[float, ...]] = []
        self.zero_changed = True
        self.plans: dict[tuple[str, ...], _Plan] = {}
        #: Radius compensation: its side, how far to the left the tool is, where X and Y are with it, and D or the tool it is of.
        self.side, self.aside_mm, self.beside = 0, 0.0, _FREE
        self.d_word, self.tool_called, self.wider_mm = "", "", 0.0
        self.own_radii: dict[str, float] = {}

    def follow(self, text: str, numbers: Sequence[int]) -> Moves:
        """Follow blocks, each with its number; returns their moves."""
        parts: list[Moves] = []
        at = line = 0
        for run in self.runs.finditer(text):
            if run[0].count("\n") < _LEAST_RUN:
                continue
            line = self._singles(text[at : run.start()], numbers, line)
            at, rest = run.end(), run[0]
            for _ in range(min(3, rest.count("\n"))):  # the first blocks may place the axes
                found = self._run(rest, np.asarray(numbers[line : line + rest.count("\n")]))
                if found is not None:
                    parts += [self._taken(), found]
                    line, rest = line + rest.count("\n"), ""
                    break
                first, newline, rest = rest.partition("\n")
                line = self._singles(first + newline, numbers, line)
            line = self._singles(rest, numbers, line)
        self._singles(text[at:], numbers, line)
        return Moves.joined([*parts, self._taken()])

    def _singles(self, text: str, numbers: Sequence[int], line: int) -> int:
        """Follow blocks one by one, of which ``line`` is the index of the first; returns that of the next."""
        every = text.split("\n")
        if not every[-1]:
            every.pop()
        for k, block in enumerate(every, line):
            if not self.done and block.strip():
                self.number = numbers[k]
                try:
                    self._block(block)
                except (ArithmeticError, ValueError):  # an arc about nowhere: the reader says why it refuses it
                    self.done = True
        return line + len(every)

    def _taken(self) -> Moves:
        """Moves of the rows since the last call."""
        data = np.array(self.rows).reshape(len(self.rows), 16)
        known = np.array(self.zeros).reshape(len(self.zeros), 6)
        self.rows, self.zeros = [], []
        zero, tool = np.split(known[data[:, 13].astype(np.int64)], 2, axis=1)
        start, end, centre = (data[:, k : k + 3] for k in (4, 7, 10))
        number, kind, plane = data[:, :3].astype(np.int64).T
        every = np.ones((len(data), 3), dtype=bool)
        phase, aside = data[:, 14].astype(np.int64), data[:, 15]
        return Moves(number, kind, start, end, centre, plane, data[:, 3], zero, tool, end, every, phase, aside)

    # Where the zero of the program is, and moves from where the machine is.

    def _zero(self, k: int) -> float:
        return self.fixture[k] + self.frame[k] + self.preset[k] + self.length[k]

    def _tool(self) -> Vector3:
        if not self.lengthened:
            return self.bare_tool_mm
        x, y, z = (gauge - length for gauge, length in zip(self.setup.gauge_mm, self.length, strict=True))
        return x, y, z

    def _to(self, kind: int, end: Sequence[float], centre: Sequence[float] = _NOWHERE, sweep: float = 0.0) -> None:
        if self.zero_changed or not self.zeros:
            self.zeros.append((self._zero(0), self._zero(1), self._zero(2), *self._tool()))
            self.zero_changed = False
        place = len(self.zeros) - 1
        phase = self._phase(end, sweep)
        self.rows.append((self.number, kind, self.plane, sweep, *self.at, *end, *centre, place, *phase))
        self.at, self.moved = list(end), True

    def _phase(self, end: Sequence[float], sweep: float) -> tuple[int, float]:
        """What a move is to radius compensation, and how far beside its end the tool is."""
        if self.beside == _FREE:
            return PLAIN, 0.0
        far = [abs(b - a) for a, b in zip(self.at[:2], end[:2], strict=True) if not math.isnan(b)]
        if not sweep and all(way <= _RESTS_MM for way in far) and (far or self.beside != _GOING):
            return STILL, 0.0 if self.beside == _COMING else self.aside_mm
        phase = {_COMING: ENTRY, _BESIDE: CONTOUR, _GOING: EXIT}[self.beside]
        self.beside = _FREE if phase == EXIT else _BESIDE
        return phase, 0.0 if phase == EXIT else self.aside_mm

    def _turn_aside(self, side: int, code: str, numbers: dict[str, float]) -> None:
        """Begin radius compensation to one side, or end it."""
        if side and not self.side:
            self.beside, self.aside_mm = _COMING, side * self._radius(code, numbers)
        elif not side and self.side:
            self.beside = _FREE if self.beside == _COMING else _GOING
        self.side = side

    def _radius(self, code: str, numbers: dict[str, float]) -> float:
        if self.dialect == "fanuc":
            return self.setup.radius_mm(self.d_word, 0.0 if self.d_word == "0" else None)
        if self.linuxcnc and code.endswith(".1"):
            return self.setup.radius_mm("", numbers.get("D", math.nan) / 2.0 * self.unit)
        if self.linuxcnc:
            return self.setup.radius_mm(f"{numbers['D']:g}" if "D" in numbers else self.spindle)
        if self.dialect == "siemens":
            tool = self.spindle or self.chosen
            edge = "" if self.d_word in ("", "1") else f"D{self.d_word}"
            return self.setup.radius_mm(tool + edge, 0.0 if edge == "D0" else None)
        return self.setup.radius_mm(self.tool_called, self.own_radii.get(self.tool_called), self.wider_mm)

    def _reached(self, words: _Words, axes: Sequence[float | None]) -> Place:
        """Where axis words lead."""
        end = list(self.at)
        for k, value in enumerate(axes):
            if value is not None:
                mode = words.mode.get("XYZ"[k])
                from_here = self.relative if mode is None else mode == "IC"
                end[k] = (self.at[k] if from_here else self._zero(k)) + value * self.unit
        return end

    # Blocks.

    def _block(self, text: str) -> None:
        body = text.strip()
        if body[0] == "/":
            if self.setup.skip_deleted:
                return
            body = re.sub(r"^/\d?\s*", "", body)
        if body[0] in "<N:%*n" if body else False:
            bare = re.sub(r"^(?:N\s*\d+|<[^<>\n]*>)\s*", "", body, flags=re.IGNORECASE)
            if bare.startswith("%"):
                return self._percent(bare)
            if self.heidenhain and bare.startswith("*"):
                return None
            body = bare
        words = _Words.of(body, self.dialect)
        if self.heidenhain and any(name[0] == "Q" and name[1:].isdigit() for name in words.number):
            return self._definition(words)
        if words.codes or "T" in words.number or "D" in words.number or "H" in words.number or words.name:
            return self._act(words)
        self._count(words, frozenset())
        return self._execute(words, frozenset())

    def _count(self, words: _Words, kinds: frozenset[str]) -> None:
        """Turn increments into lengths and angles, once the unit is known: 0.001 mm, 0.0001 inch and 0.001 deg are one."""
        if not self.increment_mm or kinds & {"quiet", "dwell"}:
            return
        drilling = "cycle" in kinds or (self.series is not None and not kinds & {"go", "end"})
        repeats = drilling and not words.number.keys() & {"I", "J"}
        for name in words.whole:
            if name in "ABC":
                words.number[name] *= self.increment_mm
            elif name in "XYZUVWIJQR" or (name == "K" and not repeats):
                words.number[name] *= self.increment_mm if self.unit == 1.0 else self.increment_mm / 10.0

    def _percent(self, body: str) -> None:
        if self.heidenhain:
            unit = re.search(r"\bG7([01])\b", body)
            self.unit = self.unit if unit is None else (25.4 if unit[1] == "0" else 1.0)
            self.done = self.moved
        elif self.dialect in ("fanuc", "linuxcnc"):
            self.done = self.percent or self.moved
        self.percent = True

    def _definition(self, words: _Words) -> None:
        """A cycle from G200, or more of its numbers."""
        code = next((code for code in words.codes if re.fullmatch(r"G2\d\d", code)), None)
        if code:
            self.hole, self.modally = _Hole(code, {}), False
        if self.hole is not None:
            self.hole = _Hole(self.hole.name, {**self.hole.number, **words.number})

    def _act(self, words: _Words) -> None:
        plan = self.plans.get(tuple(words.codes)) or self._plan(tuple(words.codes))
        for _, kind, number in plan.does:
            if kind == "unit":
                self.unit = number
            elif kind == "relative":
                self.relative = number > 0
        self._count(words, plan.kinds)
        if not plan.only_goes or "T" in words.number or "D" in words.number or "H" in words.number or words.name:
            self.zero_changed = True
            self._change_tool(words)
        for code, kind, number in plan.does:
            self._state(code, kind, number, words)
        if self.zero_changed and not (self.heidenhain and plan.kinds & {"quiet", "tool"}):
            self._call_length(words)
        if "D" in words.number and not self.heidenhain:
            self.d_word = f"{words.number['D']:g}"
        elif self.dialect == "siemens" and "M6" in words.codes and self.spindle:
            self.d_word = "1"
        for code, kind, number in plan.does:
            if kind == "side":
                self._turn_aside(int(number), code, words.number)
        if plan.executes:
            self._execute(words, plan.kinds)
        self.done = self.done or plan.ends

    def _plan(self, codes: tuple[str, ...]) -> _Plan:
        """What the codes of a block do."""
        does = [(code, *self.table[code]) for code in codes if code in self.table]
        does.sort(key=lambda what: what[1] != "end")  # a move in the block of G80 comes after it
        kinds = frozenset(kind for _, kind, _ in does)
        takes = _TAKES_WORDS | ({"no preset"} if self.dialect == "fanuc" else set())
        executes = not kinds & takes and (self.heidenhain or "modally" not in kinds)
        ends = bool(set(codes) & set(_ENDS.get(self.dialect, ("M2", "M30"))))
        self.plans[codes] = _Plan(
            does, kinds, executes, ends, kinds <= {"go", "plane", "relative", "quiet", "dwell"} and "M6" not in codes
        )
        return self.plans[codes]

    def _change_tool(self, words: _Words) -> None:
        if self.heidenhain:
            return
        self.chosen = f"{words.number['T']:g}" if "T" in words.number else words.name or self.chosen
        if "M6" in words.codes:
            self.spindle = self.chosen

    def _state(self, code: str, kind: str, number: float, words: _Words) -> None:
        """Take over what a code changes without a move."""
        if kind == "plane":
            self.plane = int(number)
        elif kind == "centre":
            self.centre_from_zero = number > 0
        elif kind == "to R":
            self.to_r = number > 0
        elif kind in ("fixture", "no fixture"):
            self.fixture = (0.0, 0.0, 0.0) if kind == "no fixture" else self._fixture(code, words.number.get("P"))
        elif kind == "datum":
            self._set_datum(words)
        elif kind.endswith("length"):
            self._set_length(kind, words)
        elif kind in ("frame", "offset", "no preset", "store"):
            self._set_zero(code, kind, number, words)
        elif kind == "turn" and (self.heidenhain or (words.call and words.call[1].strip())):
            self.at = [math.nan] * 3
        elif kind in ("define", "modally", "tool"):
            self._set_hole(code, kind, words)
        elif kind == "end":
            self.series, self.motion = None, self.motion if self.dialect == "fanuc" else None
        elif kind == "again":
            self.motion = self.turned
        elif kind == "go":
            self.motion, self.series = int(number), None
            self.turned = self.motion if self.motion in (CW, CCW) else self.turned

    def _fixture(self, code: str, given: float | None) -> Sequence[float]:
        if self.dialect == "fanuc" and given is not None and code in ("G54", "G54.1", "G154"):
            code = f"{'G154' if code == 'G154' else 'G54.1'}P{given:g}"
        self.datum = code
        return self.datums.get(code, _NOWHERE)

    def _set_datum(self, words: _Words) -> None:
        """G10 L2: the zero of a work offset; L20: the zero from which the tool is where its words say (of FANUC G54.1)."""
        number, row = words.number, int(words.number.get("P", 0.0))
        names = ["G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3"]
        here = number.get("L") == 20.0 and self.dialect != "fanuc"
        extra = number.get("L") == 20.0 and not here
        name = f"G54.1P{row}" if extra else names[row - 1] if row else self.datum
        place = list(self.datums.get(name, _NOWHERE))
        for k, value in enumerate(words.axes()):
            if value is not None:
                from_there = self.at[k] - self.frame[k] - self.preset[k] - self.length[k]
                place[k] = (from_there if here else 0.0) + (-value if here else value) * self.unit
        self.datums[name] = place
        if name == self.datum:
            self.fixture = place

    def _set_length(self, kind: str, words: _Words) -> None:
        if kind == "no length":
            self._lengthen("0")
        elif kind == "length":
            self._lengthen(f"{words.number['H']:g}" if "H" in words.number else self.spindle)
        else:
            typed = zip(words.axes(), self.length, strict=True)
            self.length, self.lengthened = [old if v is None else v * self.unit for v, old in typed], True

    def _set_zero(self, code: str, kind: str, number: float, words: _Words) -> None:
        if kind == "no preset":
            self.preset = [0.0] * 3
            self.frame = [0.0] * 3 if self.dialect == "fanuc" else self.frame
        elif kind == "store":
            self.homes[code[:3]] = list(self.at)
        elif kind == "offset":
            self.preset = [
                old if v is None else v * self.unit for v, old in zip(words.axes(), self.preset, strict=True)
            ]
        else:
            self._shift(_MORE if self.heidenhain and self.relative else int(number), words.axes())

    def _set_hole(self, code: str, kind: str, words: _Words) -> None:
        if kind == "tool":
            self.lengths[f"{words.number.get('T', 0.0):g}"] = (0.0, 0.0, words.number.get("L", 0.0) * self.unit)
            if "R" in words.number:
                self.own_radii[f"{words.number.get('T', 0.0):g}"] = words.number["R"] * self.unit
        elif kind == "modally":
            self.modally = self.heidenhain or words.call is not None
        else:
            self.hole = _Hole.of_call(*words.call) if words.call else _Hole(code, dict(words.number))
            self.modally = self.modally and not self.heidenhain

    def _shift(self, how: int, axes: Sequence[float | None]) -> None:
        kept = [0.0] * 3 if how in (_ANEW, _OFF) else self.frame
        added = kept if how == _MORE else [0.0] * 3
        self.frame = [
            old if v is None else v * self.unit + more for v, old, more in zip(axes, kept, added, strict=True)
        ]

    def _call_length(self, words: _Words) -> None:
        """Lengths that come with a tool, and with H alone."""
        numbers = words.number
        if self.heidenhain:
            tool = f"{numbers['T']:g}" if "T" in numbers else words.name
            if tool:
                self._lengthen(tool, numbers.get("DL", 0.0) * self.unit)
                self.tool_called, self.wider_mm = tool, numbers.get("DR", 0.0) * self.unit
        elif self.dialect == "siemens":
            tool, edge = self.spindle or self.chosen, numbers.get("D")
            if edge is not None:
                self._lengthen(tool if edge == 1.0 else "0" if edge == 0.0 else f"{tool}D{edge:g}")
            elif "M6" in words.codes and self.spindle:
                self._lengthen(self.spindle)
        elif "H" in numbers and "G43" not in words.codes and self.lengthened:
            self._lengthen(f"{numbers['H']:g}")

    def _lengthen(self, tool: str, longer_mm: float = 0.0) -> None:
        if tool == "0":
            self.length, self.lengthened = [0.0] * 3, False
        else:
            x, y, z = self.lengths.get(tool, _NOWHERE)
            self.length, self.lengthened = [x, y, z + longer_mm], True

    # Moves.

    def _run(self, text: str, numbers: IntArray) -> Moves | None:
        """Follow many blocks that have nothing but numbers of places, G0 to G3, G90 and G91; None if that cannot be done now."""
        at, zero, before = np.array(self.at), np.array([self._zero(k) for k in range(3)]), self.motion
        blocked = self.series is not None or self.modally or self.done or before is None
        blocked = blocked or self.beside not in (_FREE, _BESIDE)
        if blocked or before is None or np.isnan([at, zero]).any() or (self.heidenhain and before > FEED):
            return None
        if "(" in text or ";" in text:
            text = self.comments.sub(lambda comment: " " * len(comment[0]), text)
        raw = text.upper().encode("latin-1")
        code = np.frombuffer(raw, dtype=np.uint8)
        where = np.flatnonzero((code >= ord("A")) & (code <= ord("Z")))
        value, name, line = (
            np.array(raw.translate(_BLANK_LETTERS).split(), dtype=np.float64),
            code[where],
            np.cumsum(code == 10)[where],
        )
        given = np.full((len(numbers), 7), np.nan)
        column = _COLUMN_OF[name]
        given[line[column >= 0], column[column >= 0]] = value[column >= 0]
        own, mode = np.full((2, len(numbers)), -1)
        goes, selects = ((name == ord("G")) & found for found in (value < 90.0, value >= 90.0))
        own[line[goes]], mode[line[selects]] = value[goes], value[selects] - 90.0
        motion, relative = _carried(own, before), _carried(mode, int(self.relative)) > 0
        place = _places(given[:, :3] * self.unit, at, zero, relative)
        moving, centred = ~np.isnan(given[:, :3]).all(axis=1), ~np.isnan(given[:, 3:6]).all(axis=1)
        rows = np.flatnonzero(moving | (centred & (motion >= CW)))
        start, end = place[:-1][rows], place[1:][rows]
        centre, sweep = np.full((len(rows), 3), np.nan), np.zeros(len(rows))
        arcs = np.flatnonzero(motion[rows] >= CW)
        if len(arcs):
            centre[arcs], sweep[arcs] = self._turns(
                motion[rows][arcs], start[arcs], end[arcs], given[rows[arcs], 3:], zero
            )
        self.at, self.motion, self.moved = place[-1].tolist(), int(motion[-1]), self.moved or len(rows) > 0
        self.relative = bool(relative[-1])
        turned = motion[own >= CW]
        self.turned = int(turned[-1]) if len(turned) else self.turned
        same = [np.broadcast_to(np.array(one), end.shape) for one in (zero, self._tool(), np.ones(3, dtype=bool))]
        phase = np.zeros(len(rows), dtype=np.int64)
        if self.beside == _BESIDE:
            phase[:] = np.where((sweep != 0) | (np.abs(end - start)[:, :2] > _RESTS_MM).any(axis=1), CONTOUR, STILL)
        return Moves(
            numbers[rows],
            motion[rows],
            start,
            end,
            centre,
            np.full(len(rows), self.plane),
            sweep,
            same[0],
            same[1],
            end,
            same[2],
            phase,
            np.where(phase > 0, self.aside_mm, 0.0),
        )

    def _turns(
        self, motion: IntArray, start: FloatArray, end: FloatArray, given: FloatArray, zero: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Centres (n, 3) and signed angles (n,) of arcs; ``given`` are I, J, K and R. As :meth:`_turn` does one."""
        first, second = (self.plane + 1) % 3, (self.plane + 2) % 3
        a, b = start[:, first] + 1j * start[:, second], end[:, first] + 1j * end[:, second]
        sense, radius = np.where(motion == CCW, 1.0, -1.0), given[:, 3]
        base = np.broadcast_to(zero, start.shape) if self.centre_from_zero else start
        middle = base[:, [first, second]] + np.nan_to_num(given[:, [first, second]]) * self.unit
        centre = middle[:, 0] + 1j * middle[:, 1]
        by_radius = np.flatnonzero(~np.isnan(radius))
        chord, r = (b - a)[by_radius], radius[by_radius]
        height = np.sqrt(np.maximum((r * self.unit) ** 2 - 0.25 * np.abs(chord) ** 2, 0.0))
        side = np.where(r > 0.0, sense[by_radius], -sense[by_radius])
        centre[by_radius] = 0.5 * (a + b)[by_radius] + 1j * side * height * chord / np.abs(chord)
        angle = np.angle((b - centre) / (a - centre)) * sense % (2.0 * np.pi)
        angle[(np.abs(b - a) < 1e-9) | (angle == 0.0)] = 2.0 * np.pi
        found = np.full(start.shape, np.nan)
        found[:, first], found[:, second] = centre.real, centre.imag
        return found, sense * angle

    def _execute(self, words: _Words, kinds: frozenset[str]) -> None:
        axes = words.axes()
        moving = any(axis is not None for axis in axes)
        if "home" in kinds or "lost" in kinds:
            self._go_home(words, axes)
        elif "preset" in kinds:
            self._take_as(axes)
        elif "tap" in kinds:
            back = list(self.at)
            self._to(FEED, self._reached(words, axes))
            self._to(FEED, back)
        elif "hole" in kinds or ("define" in kinds and words.call is not None) or (self.modally and moving):
            self._drill_there(words, axes, moving)
            self.modally = self.modally and "M99" not in words.codes
        elif "machine" in kinds:
            if moving:
                self._to(RAPID, [here if v is None else v * self.unit for v, here in zip(axes, self.at, strict=True)])
        elif "cycle" in kinds or (self.series is not None and (moving or "R" in words.number)):
            self._drill(words, axes, moving)
        else:
            self._go(words, axes, moving, kinds)

    def _go(self, words: _Words, axes: Sequence[float | None], moving: bool, kinds: frozenset[str]) -> None:
        centred = [words.number.get(letter) for letter in "IJK"]
        if self.heidenhain:
            for k, value in enumerate(centred):
                if value is not None:
                    self.pole[k] = (self.at[k] if self.relative else self._zero(k)) + value * self.unit
                elif "pole" in kinds:
                    self.pole[k] = self.at[k]
            centred = [None] * 3
        turning = self.motion in (CW, CCW) and "once" not in kinds
        if turning and (moving or any(value is not None for value in centred)):
            self._turn(words, self._reached(words, axes), centred)
        elif moving and self.motion is not None:
            self._to(RAPID if "once" in kinds else self.motion, self._reached(words, axes))

    def _turn(self, words: _Words, end: Place, centred: Sequence[float | None]) -> None:
        """An arc, as complex numbers in its plane."""
        first, second = (self.plane + 1) % 3, (self.plane + 2) % 3
        start, stop = complex(self.at[first], self.at[second]), complex(end[first], end[second])
        sense = 1.0 if self.motion == CCW else -1.0
        radius = words.number.get("CR", words.number.get("R"))
        if radius is not None:
            chord = stop - start
            height = math.sqrt(max((radius * self.unit) ** 2 - 0.25 * abs(chord) ** 2, 0.0))
            side = sense if radius > 0.0 else -sense
            middle = 0.5 * (start + stop) + 1j * side * height * chord / abs(chord)
        else:
            middle = complex(*(self._centre(words, centred[k], k) for k in (first, second)))
        angle = cmath.phase((stop - middle) / (start - middle)) * sense % (2.0 * math.pi)
        if abs(stop - start) < 1e-9 or angle == 0.0:
            angle = 2.0 * math.pi
        turns = words.number.get("TURN", words.number.get("P", 1.0) - 1.0 if self.linuxcnc else 0.0)
        centre = list(_NOWHERE)
        centre[first], centre[second] = middle.real, middle.imag
        self._to(CCW if sense > 0 else CW, end, centre, sense * (angle + 2.0 * math.pi * turns))

    def _centre(self, words: _Words, value: float | None, k: int) -> float:
        if self.heidenhain:
            return self.pole[k]
        mode = words.mode.get("IJK"[k])
        from_zero = self.centre_from_zero if mode is None else mode == "AC"
        return (self._zero(k) if from_zero else self.at[k]) + (value or 0.0) * self.unit

    def _go_home(self, words: _Words, axes: Sequence[float | None]) -> None:
        code = next((code for code in ("G28", "G30") if code in words.codes), "")
        named = [axis is not None for axis in axes]
        if not any(named):
            if self.dialect == "fanuc" or not code:
                return
            named = [True] * 3
        if code:
            known = [
                axis if not (self.relative and math.isnan(here)) else None
                for axis, here in zip(axes, self.at, strict=True)
            ]
            self._to(RAPID, self._reached(words, known))
        home = self.homes.get(code, [math.nan] * 3)
        self._to(RAPID, [there if name else here for name, there, here in zip(named, home, self.at, strict=True)])

    def _take_as(self, axes: Sequence[float | None]) -> None:
        """G92: the position is given its number; a shift of the axis ends."""
        for k, value in enumerate(axes):
            if value is not None:
                self.frame[k] = 0.0
                self.preset[k] = self.at[k] - self.fixture[k] - self.length[k] - value * self.unit

    # Holes.

    def _drill_there(self, words: _Words, axes: Sequence[float | None], moving: bool) -> None:
        """Move as the block says, then execute the cycle that is defined."""
        if self.hole is None:
            return
        if moving:
            self._to(RAPID if "FMAX" in words.codes or self.motion is None else self.motion, self._reached(words, axes))
        zero = self._zero(2)
        level, depth, left = (
            zero + height * self.unit for height in self.hole.heights((self.at[2] - zero) / self.unit)
        )
        back = FEED if self.hole.name in _BACK_AT_FEED else RAPID
        for kind, height in ((RAPID, level), (FEED, depth), (back, level), (RAPID, left)):
            self._to(kind, [self.at[0], self.at[1], height])

    def _drill(self, words: _Words, axes: Sequence[float | None], moving: bool) -> None:
        """A drilling cycle of G codes: take its numbers, then drill where the block says, as often as it says."""
        axis, numbers = self.plane, words.number
        zero, sides = self._zero(axis), [k for k in range(3) if k != axis]
        kind = next((int(self.table[c][1]) for c in words.codes if self.table.get(c, ("", 0.0))[0] == "cycle"), None)
        if self.series is None:
            self.series = _Series(kind or 0, (self.at[axis] - zero) / self.unit, zero)
        series = self.series
        series.kind = series.kind if kind is None else kind
        series.q = numbers.get("Q", series.q)
        times = numbers.get("L", math.nan)
        if math.isnan(times):
            times = numbers.get("K", 1.0) if self.dialect == "fanuc" and not numbers.keys() & {"I", "J"} else 1.0
        self._give(series, numbers, zero)
        if times == 0 or not moving:
            return
        across = [(k, axes[k]) for k in sides]
        step = [0.0 if v is None or not self.relative else v * self.unit for _, v in across]
        place = [self.at[k] if v is None or self.relative else self._zero(k) + v * self.unit for k, v in across]
        if self.linuxcnc:
            base = series.level if self.relative else 0.0
            level = base + series.r
            depth = (level if self.relative else 0.0) + series.z
            self._as_linuxcnc(series, place, step, int(times), (level, depth, series.level))
        else:
            level, depth = zero + series.r * self.unit, zero + series.z * self.unit
            initial = zero + series.level * self.unit if zero == series.zero else math.nan
            self._as_fanuc(series.kind, place, step, int(times), (level, depth, initial))

    def _give(self, series: _Series, numbers: dict[str, float], zero: float) -> None:
        """Z and R of a block: LinuxCNC keeps the numbers, FANUC the heights that they mean in G91."""
        z, r = numbers.get("XYZ"[self.plane]), numbers.get("R")
        if self.relative and not self.linuxcnc and z is not None and r is not None:
            series.r = r + (series.level if zero == series.zero else math.nan)
            series.z = series.r + z
        else:
            series.z, series.r = series.z if z is None else z, series.r if r is None else r

    def _as_linuxcnc(
        self, series: _Series, place: Place, step: Place, times: int, heights: tuple[float, float, float]
    ) -> None:
        """The moves of LinuxCNC: it compares R with the level before the series, and pecks by Q."""
        zero, unit = self._zero(self.plane), self.unit
        level, depth, initial = heights
        here = (self.at[self.plane] - zero) / unit
        here = level if abs(here - level) < _ROUNDED_MM / unit else here
        if initial < level:
            self._to(RAPID, self._at_height(self._beside_tool(), zero + level * unit))
            initial = here = level
        clear = level if self.to_r else initial
        for number in range(times):
            place = [a + b for a, b in zip(place, step, strict=True)]

            def go(kind: int, height: float, there: Place = place) -> None:
                self._to(kind, self._at_height(there, zero + height * unit))

            go(RAPID, here if math.isnan(here) or (number == 0 and here > level) else clear)
            go(RAPID, level)
            self._peck(go, series, level, depth)
            go(FEED, depth)
            if series.kind == 85:
                go(FEED, level)
            go(FEED if series.kind == 89 else RAPID, clear)

    def _peck(self, go: Callable[[int, float], None], series: _Series, level: float, depth: float) -> None:
        """Strokes of G73 and G83 before the last one: back by 0.01 inch, or out and again to 0.01 inch above."""
        gap, at = 0.254 / self.unit, level - series.q
        while series.kind in (73, 83) and series.q > 0.0 and at > depth + 1e-9 / self.unit:
            go(FEED, at)
            if series.kind == 83:
                go(RAPID, level)
            go(RAPID, at + gap)
            at -= series.q

    def _as_fanuc(self, kind: int, place: Place, step: Place, times: int, heights: tuple[float, float, float]) -> None:
        """The moves of FANUC: over the hole at the height where the tool is, and back to R or to the initial level."""
        level, depth, initial = heights
        if self.at[self.plane] < level:
            self._to(RAPID, self._at_height(self._beside_tool(), level))
        clear, unknown = level if self.to_r or initial < level else initial, math.isnan(self.at[self.plane])
        for _ in range(times):
            place = [a + b for a, b in zip(place, step, strict=True)]
            here = self.at[self.plane]
            over = math.nan if unknown else level if here < level else here
            for how, height in (
                (RAPID, over),
                (RAPID, level),
                (FEED, depth),
                (FEED if kind in (84, 85, 89) else RAPID, level),
            ):
                self._to(how, self._at_height(place, height))
            self._to(RAPID, self._at_height(place, clear))

    def _at_height(self, place: Place, height: float) -> Place:
        """A place in the two axes of the plane, and along the third."""
        return [*place[: self.plane], height, *place[self.plane :]]

    def _beside_tool(self) -> Place:
        """Where the tool is in the two axes of the plane, in the order of X, Y, Z."""
        return [value for k, value in enumerate(self.at) if k != self.plane]


# Klartext: sentences, not words with a letter.

_MOST_STEPS = 5_000_000
_SYMBOL = re.compile(r"(\d++\.?\d*+|\.\d++|Q[LR]?\d++|(?<![A-Z])[A-Z]++|\*\*|[-+*/^()])")


def _worth(text: str, known: dict[str, float]) -> float:
    """The value of an expression, from left to right by precedence; nan if something in it is not known."""
    symbols = _SYMBOL.findall(text.upper())
    if not symbols or re.sub(r"\s", "", "".join(symbols)) != re.sub(r"\s", "", text.upper()):
        return math.nan
    place = 0

    def next_is(*those: str) -> str:
        nonlocal place
        if place < len(symbols) and symbols[place] in those:
            place += 1
            return str(symbols[place - 1])
        return ""

    def total() -> float:
        found = product()
        while sign := next_is("+", "-"):
            found += product() * (1.0 if sign == "+" else -1.0)
        return found

    def product() -> float:
        found = power()
        while sign := next_is("*", "/", "DIV"):
            other = power()
            found = found * other if sign == "*" else found / other if other else math.nan
        return found

    def power() -> float:
        if sign := next_is("+", "-"):
            return power() * (1.0 if sign == "+" else -1.0)
        found = atom()
        return float(found ** power()) if next_is("^") else found

    def atom() -> float:
        nonlocal place
        if next_is("("):
            found = total()
            next_is(")")
            return found
        if name := next_is("SIN", "COS", "TAN", "SQRT", "SQ", "ABS", "INT", "NEG"):
            value = atom() if not (sign := next_is("+", "-")) else atom() * (1.0 if sign == "+" else -1.0)
            turn = math.radians(value)
            if name in ("SIN", "COS", "TAN"):
                return {"SIN": math.sin, "COS": math.cos, "TAN": math.tan}[name](turn)
            return {
                "SQRT": math.sqrt(abs(value)), "SQ": value**2, "ABS": abs(value), "INT": float(int(value)), "NEG": -value
            }[name]  # fmt: skip
        place += 1
        symbol = symbols[place - 1] if place <= len(symbols) else ""
        if symbol == "PI":
            return math.pi
        return known.get(symbol, math.nan) if symbol[:1] == "Q" else float(symbol)

    try:
        return total()
    except (ValueError, ArithmeticError):
        return math.nan


@dataclass
class _Line:
    """A sentence: the number of its line, its text without comment and number, and whether it has a slash."""

    number: int
    text: str
    slash: bool


#: Words that belong to an M code: ways of the handwheel, look-ahead, shortest element, latest tool change.
_OF_M_CODES = re.compile(
    rf"(M\s*(?:118(?=\s*[A-Z])|120(?=\s*LA)|124(?=\s*T)|101(?=\s*BT)))(?:\s*(?:[XYZABC]|LA|BT|T)\s*{_NUMBER})+"
)


def _sentences_of(text: str, numbers: Sequence[int]) -> list[_Line]:
    found: list[_Line] = []
    goes_on = remark = False
    for number, raw in zip(numbers, text.split("\n"), strict=False):
        line = raw.strip()
        said = line.rstrip("~").split(";")[0].strip().upper()
        if goes_on:
            if not remark and said:
                found[-1].text += f" {said}"
        else:
            head = re.match(r"(?:/\s*\d+\s+|\d+(?=[\s/*;]|$)\s*)?(?:/\d?\s*)?", said)
            bare = said[head.end() :] if head else said
            bare = bare.replace("CYCLE", "CYCL", 1) if bare.startswith("CYCLE ") else bare
            bare = _OF_M_CODES.sub(r"\1", bare)
            found.append(_Line(number, bare, bool(head and "/" in head[0])))
            remark = not bare and ";" in line
        goes_on = line.endswith("~")
    return found


class KlartextFollower(Follower):
    """Follows Klartext: it executes labels, repeats, patterns and roundings itself, from the text as it is."""

    def __init__(self, dialect: str, setup: Setup, machine: Machine) -> None:
        super().__init__(dialect, setup, machine)
        self.known: dict[str, float] = {}
        self.cycle: dict[str, float] = {}
        self.cycle_name = ""
        self.way = complex(math.nan)
        self.spots: list[tuple[complex, float]] = []
        self.arm = math.nan
        self.corner: tuple[str, float, int] | None = None
        #: The side that a sentence asks for, until it is taken.
        self.new_side: int | None = None
        self.around = (0, 1)
        self.departed = False
        #: By what the coordinates are turned about their zero, by what has done so, and for each of ``zeros``.
        self.angles: dict[str, float] = {}
        self.turn = 1 + 0j
        self.turn_of: list[complex] = []

    def _to(self, kind: int, end: Sequence[float], centre: Sequence[float] = _NOWHERE, sweep: float = 0.0) -> None:
        """A move in the coordinates of the program, which may be turned."""
        super()._to(kind, end, centre, sweep)
        if len(self.zeros) > len(self.turn_of):
            self.turn_of.append(self.turn)

    def _taken(self) -> Moves:
        turns = np.array([self.turn_of[int(row[13])] for row in self.rows], dtype=complex)
        moves, self.turn_of = super()._taken(), []
        for places in (moves.start_mm, moves.end_mm, moves.centre_mm) if (turns != 1.0).any() else ():
            rows = np.flatnonzero(turns != 1.0)
            zero = moves.offset_mm[rows, 0] + 1j * moves.offset_mm[rows, 1]
            there = zero + (places[rows, 0] + 1j * places[rows, 1] - zero) * turns[rows]
            places[rows, 0], places[rows, 1] = there.real, there.imag
        return moves

    def _turned(self, place: Place, turn: complex) -> Place:
        """A place turned about the zero of the program."""
        zero = complex(self._zero(0), self._zero(1))
        there = zero + (complex(place[0], place[1]) - zero) * turn
        return [there.real, there.imag, place[2]]

    def _turn_to(self, what: str, degrees: float) -> None:
        """Turn the coordinates: the tool stays where it is."""
        self.angles[what] = degrees
        new = cmath.exp(1j * math.radians(sum(self.angles.values()))) if sum(self.angles.values()) % 360.0 else 1 + 0j
        if new != self.turn:
            self.at, self.pole = (self._turned(place, self.turn / new) for place in (self.at, self.pole))
            self.way, self.turn, self.zero_changed = complex(math.nan), new, True

    def follow(self, text: str, numbers: Sequence[int]) -> Moves:
        """Follow blocks, each with its number; calls lead to labels among them."""
        every = _sentences_of(text, numbers)
        places: dict[str, int] = {}
        for k, line in enumerate(every):
            if label := re.match(r"LBL\s*(\"[^\"]+\"|\d+)", line.text):
                places.setdefault(label[1], k)
        back: list[int] = []
        again: dict[int, int] = {}
        k = steps = 0
        while k < len(every) and not self.done and steps < _MOST_STEPS:
            line, k, steps = every[k], k + 1, steps + 1
            if not line.text or (line.slash and self.setup.skip_deleted):
                continue
            self.number = line.number
            call = re.match(r"CALL\s*LBL\s*(\"[^\"]+\"|\d+)\s*(?:REP\s*([^\s/]+))?", line.text)
            asks = None
            if line.text.startswith("FN"):
                asks = re.match(
                    r"FN ?(?:9|1[0-2]) ?: ?IF ?(.+?) ?\b(EQU|NE|GT|LT)\b ?(.+?) ?GOTO ?LBL ?(\"[^\"]+\"|\d+)", line.text
                )
            if asks:
                gap = _worth(asks[1], self.known) - _worth(asks[3], self.known)
                if {"EQU": gap == 0.0, "NE": abs(gap) > 0.0, "GT": gap > 0.0, "LT": gap < 0.0}[asks[2]]:
                    k = places.get(asks[4], len(every))
                continue
            if call and call[2]:
                again.setdefault(k, round(_worth(call[2], self.known)))
                again[k] -= 1
                if again[k] < 0:
                    del again[k]
                else:
                    k = places[call[1]]
            elif call:
                back.append(k)
                k = places.get(call[1], len(every))
            elif re.match(r"LBL\s*0\b", line.text):
                k = back.pop() if back else k
            else:
                try:
                    self._say(line.text)
                except (ArithmeticError, ValueError, KeyError):  # the reader says why it refuses it
                    self.done = True
        return self._taken()

    def _say(self, text: str) -> None:
        text = re.sub(r"\s+", " ", text)
        if set_to := re.match(r"(?:FN ?(\d+) ?: ?)?(Q[LR]?\d+) ?= ?(.*)", text):
            if set_to[1] is None and self.cycle_name and set_to[2] in self.cycle:
                self.cycle[set_to[2]] = _worth(
                    set_to[3], self.known
                )  # a definition that was cut between two parts of the text
            value = _worth(set_to[3], self.known) if not set_to[1] or int(set_to[1]) < 9 else math.nan
            self.known[set_to[2]] = value
        elif text.startswith("BEGIN PGM"):
            self.unit = 25.4 if text.endswith("INCH") else 1.0
        elif text.startswith("END PGM"):
            self.done = True
        elif define := re.match(r"CYCL ?DEF ?(\d+)(?:[ .]*\. ?(\d+))?", text):
            self._take(int(define[1]), define[2], text[define.end() :])
        elif text.startswith("TCH"):
            self.at, self.way = [math.nan] * 3, complex(math.nan)
        elif text.startswith("TOOL"):
            self._take_tool(text)
        elif re.match(r"(?:STOP |M ?\d+ )*M ?140(?!\d)", text):
            self._to(RAPID, [*self.at[:2], math.nan])
        elif text.startswith("TRANS ROTATION"):
            self._rotate(text)
        elif text.startswith("PLANE"):
            if not re.search(r"\bSTAY\b", text):
                self.at = [math.nan] * 3
            about_z = re.search(r"SPC ?([-+]? ?[\d.]+)", text)
            self._turn_to("PLANE", float(about_z[1].replace(" ", "")) if about_z else 0.0)
        elif text.startswith("TRANS DATUM"):
            self._take(7, "1", text[17:] if "AXIS" in text else " X0 Y0 Z0")
        elif text.startswith("PATTERN"):
            self.spots = [
                spot
                for kind, inside in re.findall(r"(?<![A-Z])([A-Z]++)\d++ ?\(([^()]*+)\)", text)
                for spot in self._spots(kind, inside)
            ]
        elif text.startswith("CYCL CALL PAT"):
            self._drill_spots(self.spots, "F MAX" in text or "FMAX" in text or not re.search(r"F ?\d", text))
        elif text.startswith("CYCL CALL POS"):
            n = self._numbers(text[13:])
            self._drill_spots(
                [(complex(n["X"], n["Y"]), n.get("Z", 0.0))],
                "F MAX" in text or "FMAX" in text or not re.search(r"F ?\d", text),
            )
        elif text.startswith("CYCL CALL"):
            self._hole_here()
        elif found := re.match(r"(APPR|DEP) ?(P?)(LT|LN|CT|LCT)(?![A-Z])", text):
            self._come_or_go(found[1] == "DEP", bool(found[2]), found[3], text[found.end() :])
        elif found := re.match(r"(LP|L|CTP|CT|CP|CR|CC|C|RND|CHF)(?![A-Z])", text):
            self._step(found[1], text[found.end() :])
        if re.search(r"(?<![A-Z])M0?(?:2|30)(?!\d)", text):
            self.done = True

    def _numbers(self, text: str) -> dict[str, float]:
        """Numbers of a sentence by their names; Q parameters are looked up."""
        found: dict[str, float] = {}
        for name, sign, value in re.findall(
            r"(?<![A-Z])(I?P[AR]|I?[XYZ]|NUM[XY]?|ROT|D[XY]?|START|STEP|R) ?([-+]?) ?(Q[LR]?\d+|\d*\.?\d+)(?![\d.])",
            text,
        ):
            if name != "R" or value != "0" or sign:
                number = self.known.get(value, math.nan) if value[0] == "Q" else float(value)
                found.setdefault(name, -number if sign == "-" else number)
        return found

    def _take(self, number: int, part: str | None, text: str) -> None:
        """Definitions of cycles."""
        given = {name: _worth(value, self.known) for name, value in re.findall(r"(Q\d+) ?= ?([-+]? ?[\w.]+)", text)}
        self.known |= {name: value for name, value in given.items() if not math.isnan(value)}
        self.zero_changed = True
        if number == 7 and part not in (None, "0"):
            n = self._numbers(text)
            for k, letter in enumerate("XYZ"):
                self.frame[k] = (
                    n[letter] * self.unit if letter in n else self.frame[k] + n.get("I" + letter, 0.0) * self.unit
                )
        elif number == 10 and part not in (None, "0"):
            self._rotate(text)
        elif number == 247:
            name = f"PRESET{given.get('Q339', math.nan):g}"
            offsets = self.setup.work_offsets_mm
            self.fixture, self.frame = offsets.get(name, offsets.get("PRESET", _NOWHERE)), [0.0] * 3
        elif number in (220, 221):
            self._take_pattern(number, given)
        elif number >= 200:
            self.cycle, self.cycle_name, self.modally = given, f"G{number}", False
        elif number in (1, 2, 17):
            if part in (None, "0"):
                self.cycle, self.cycle_name, self.modally = {}, "G83" if number == 1 else "G84", False
            elif part in ("1", "2") and (last := re.search(r"(?<![\d.])([-+]? ?[\d.]++)$", text.strip())):
                self.cycle |= {f"P0{part}": float(last[1].replace(" ", ""))}

    def _rotate(self, text: str) -> None:
        found = re.search(r"(I?)ROT ?([-+]? ?\d*\.?\d+)", text)
        angle = float(found[2].replace(" ", "")) if found else 0.0
        self._turn_to("10", angle + (self.angles.get("10", 0.0) if found and found[1] else 0.0))

    def _take_pattern(self, number: int, q: dict[str, float]) -> None:
        self.cycle |= {name: q[name] for name in ("Q200", "Q203", "Q204") if name in q}
        if number == 221:
            turn = cmath.exp(1j * math.radians(q.get("Q224", 0.0)))
            columns, rows = int(q["Q242"]), int(q["Q243"])
            self._drill_spots(
                [
                    (complex(q["Q225"], q["Q226"]) + turn * complex(x * q["Q237"], y * q["Q238"]), 0.0)
                    for y in range(rows)
                    for x in (range(columns) if y % 2 == 0 else range(columns - 1, -1, -1))
                ]
            )
            return
        count, step = int(q["Q241"]), q.get("Q247", 0.0)
        if not step:
            whole = math.isclose(abs(q["Q246"] - q["Q245"]), 360.0)
            step = (q["Q246"] - q["Q245"]) / max(count if whole else count - 1, 1) if count > 1 else 0.0
        self._drill_spots(
            [
                (
                    complex(q["Q216"], q["Q217"]) + q["Q244"] / 2 * cmath.exp(1j * math.radians(q["Q245"] + step * k)),
                    0.0,
                )
                for k in range(count)
            ]
        )

    def _spots(self, kind: str, inside: str) -> list[tuple[complex, float]]:
        n = self._numbers(inside)
        first, turn, z = complex(n["X"], n["Y"]), cmath.exp(1j * math.radians(n.get("ROT", 0.0))), n.get("Z", 0.0)
        count, wide, high = (int(n.get(name, 1)) for name in ("NUM", "NUMX", "NUMY"))
        if kind in ("CIRC", "PITCHCIRC"):
            step = n.get("STEP", 0.0) if kind[0] == "P" else 360.0 / count
            start = n.get("START", 0.0)
            return [
                (first + n.get("D", 0.0) / 2 * cmath.exp(1j * math.radians(start + step * k)), z) for k in range(count)
            ]
        if kind == "ROW":
            return [(first + turn * n.get("D", 0.0) * k, z) for k in range(count)]
        if kind == "POS":
            return [(first, z)]
        grid = [(x if y % 2 == 0 else wide - 1 - x, y) for y in range(high) for x in range(wide)]
        return [
            (first + turn * complex(x * n.get("DX", 0.0), y * n.get("DY", 0.0)), z)
            for x, y in grid
            if kind == "PAT" or x in (0, wide - 1) or y in (0, high - 1)
        ]

    def _take_tool(self, text: str) -> None:
        name = re.match(r"TOOL (?:CALL|DEF) ?(?:\"([^\"]*)\"|(\d+(?:\.\d+)?))", text)
        if not name:
            return
        rest, tool = text[name.end() :], name[1] if name[1] is not None else f"{float(name[2]):g}"
        if text.startswith("TOOL DEF"):
            if length := re.search(r"(?<!D)L ?([-+]? ?[\d.]+)", rest):
                self.lengths[tool] = (0.0, 0.0, float(length[1].replace(" ", "")) * self.unit)
            if radius := re.search(r"(?<![A-Z])R(?!2) ?([-+]? ?[\d.]+)", rest):
                self.own_radii[tool] = float(radius[1].replace(" ", "")) * self.unit
            return
        longer = re.search(r"DL ?([-+]? ?[\d.]+)", rest)
        self._lengthen(tool, float(longer[1].replace(" ", "")) * self.unit if longer else 0.0)
        wider = re.search(r"DR(?!2) ?([-+]? ?[\d.]+)", rest)
        self.tool_called, self.wider_mm = tool, float(wider[1].replace(" ", "")) * self.unit if wider else 0.0
        self.zero_changed = True

    def _hole_here(self) -> None:
        hole, zero = _Hole(self.cycle_name, self.cycle), self._zero(2)
        level, depth, left = (zero + height * self.unit for height in hole.heights((self.at[2] - zero) / self.unit))
        back = FEED if self.cycle_name in _BACK_AT_FEED else RAPID
        self.plane = 2
        for kind, height in ((RAPID, level), (FEED, depth), (back, level), (RAPID, left)):
            self._to(kind, [*self.at[:2], height])

    def _drill_spots(self, spots: Sequence[tuple[complex, float]], fast: bool = True) -> None:
        surface = self.cycle["Q203"]
        for spot, higher in spots:
            there = [self._zero(0) + spot.real * self.unit, self._zero(1) + spot.imag * self.unit, self.at[2]]
            self._to(RAPID if fast else FEED, there)
            self.cycle["Q203"] = surface + higher
            self._hole_here()
        self.cycle["Q203"] = surface

    def _step(self, kind: str, text: str) -> None:
        n, codes = self._numbers(text), {int(code) for code in re.findall(r"(?<![A-Z])M(\d+)", text.replace("M ", "M"))}
        end = [
            self._zero(k) + n[letter] * self.unit if letter in n else self.at[k] + n.get("I" + letter, 0.0) * self.unit
            for k, letter in enumerate("XYZ")
        ]
        turn = re.search(r"(?<![A-Z])R([LR0])(?![\w.])", text) if kind not in ("RND", "CHF", "CC") else None
        self.new_side = None if turn is None else "R0L".index(turn[1]) - 1
        if not self.corner:  # else its arc comes before
            self._take_side()
        if kind in ("RND", "CHF"):
            size = n.get("R", math.nan)
            bare = re.match(r" ?([-+]? ?\d*\.?\d+)", text)
            self.corner = kind, (float(bare[1]) if bare else size) * self.unit, self.number
        elif kind == "CC":
            self._take_pole(n)
        elif 140 in codes:
            self._to(RAPID, [*self.at[:2], math.nan])
        elif 91 in codes:
            here = self._turned(self.at, self.turn) if self.turn != 1.0 else self.at
            there = [n[letter] * self.unit if letter in n else here[k] for k, letter in enumerate("XYZ")]
            self._to(RAPID, self._turned(there, 1.0 / self.turn) if self.turn != 1.0 else there)
        elif 92 in codes:
            self._to(
                RAPID, [math.nan if letter in n or "I" + letter in n else self.at[k] for k, letter in enumerate("XYZ")]
            )
        else:
            if kind != "L" or n:  # L M3 leads nowhere
                self._draw(kind, n, end, text)
            self.modally = self.modally or 89 in codes
            if self.cycle_name and (99 in codes or (self.modally and kind in ("L", "LP") and n.keys() & set("XYZ"))):
                self._hole_here()
                self.modally = self.modally and 99 not in codes

    def _come_or_go(self, goes: bool, polar: bool, way: str, text: str) -> None:
        """APPR: to the first point of a contour; DEP: from the last one, to where only the control knows unless it is said."""
        n = self._numbers(text)
        end = [
            self._zero(k) + n[letter] * self.unit if letter in n else self.at[k] + n.get("I" + letter, 0.0) * self.unit
            for k, letter in enumerate("XYZ")
        ]
        if polar:
            pole = complex(self.pole[0], self.pole[1])
            arm = complex(self.at[0], self.at[1]) - pole
            size = n["PR"] * self.unit if "PR" in n else abs(arm) + n["IPR"] * self.unit
            angle = math.radians(n["PA"]) if "PA" in n else cmath.phase(arm) + math.radians(n.get("IPA", 0.0))
            end[0], end[1] = (pole + size * cmath.exp(1j * angle)).real, (pole + size * cmath.exp(1j * angle)).imag
        elif goes and way != "LCT":
            end[0] = end[1] = math.nan
        side = re.search(r"(?<![A-Z])R([LR0])(?![\w.])", text)
        if goes:
            self._turn_aside(0, "", {})
        elif side:
            self._turn_aside("R0L".index(side[1]) - 1, "", {})
        self.plane = 2
        self._to(RAPID, end)
        self.way, self.arm, self.departed = complex(math.nan), math.nan, goes and way != "LCT"

    def _take_side(self) -> None:
        if self.new_side is not None:
            self._turn_aside(self.new_side, "", {})
        self.new_side = None

    def _take_pole(self, n: dict[str, float]) -> None:
        named = {name[-1] for name in n}
        self.around = (2, 0) if named == {"X", "Z"} else (1, 2) if named == {"Y", "Z"} else (0, 1)
        for k, letter in enumerate("XYZ"):
            if letter in n:
                self.pole[k] = self._zero(k) + n[letter] * self.unit
            elif "I" + letter in n or not named:
                self.pole[k] = self.at[k] + n.get("I" + letter, 0.0) * self.unit

    def _draw(self, kind: str, n: dict[str, float], end: Place, text: str) -> None:
        """A move, straight or round."""
        axes = self.around if kind in ("C", "CP", "LP", "CTP") else (0, 1)
        if kind == "CR":
            named = {name[-1] for name in n if name != "R"}
            axes = (2, 0) if named == {"X", "Z"} else (1, 2) if named == {"Y", "Z"} else (0, 1)
        a, b = axes
        self.plane = 3 - a - b
        pole, sweep, centre = complex(self.pole[a], self.pole[b]), 0.0, complex(math.nan)
        here = complex(self.at[a], self.at[b])
        left = "DR+" in text.replace(" ", "")
        if kind in ("LP", "CTP", "CP"):
            arm = abs(here - pole) if kind == "CP" else n["PR"] * self.unit if "PR" in n else self.arm
            arm = abs(here - pole) + n["IPR"] * self.unit if "IPR" in n else arm
            angle = math.radians(n["PA"]) if "PA" in n else cmath.phase(here - pole) + math.radians(n.get("IPA", 0.0))
            there = pole + arm * cmath.exp(1j * angle)
            end[a], end[b], self.arm = there.real, there.imag, arm
        else:
            self.arm = math.nan
        there = complex(end[a], end[b])
        if kind == "CP" and "IPA" in n:
            centre, sweep = pole, math.radians(n["IPA"])
        elif kind in ("C", "CP"):
            centre, sweep = pole, self._turn_between(here - pole, there - pole, left)
        elif kind == "CR":
            half = (there - here) / 2
            rise = math.sqrt(max((n["R"] * self.unit) ** 2 - abs(half) ** 2, 0.0)) * half / abs(half) * 1j
            centre = here + half + (rise if (n["R"] > 0) == left else -rise)
            sweep = self._turn_between(here - centre, there - centre, left)
        elif kind in ("CT", "CTP"):
            # the angle between tangent and chord is half of that of the arc
            half_turn = cmath.phase((there - here) / self.way)
            if abs(math.sin(half_turn)) > 1e-9:
                radius = abs(there - here) / (2.0 * math.sin(half_turn))
                centre, sweep = here + 1j * self.way * radius, 2.0 * half_turn
        straight = not sweep
        fast = straight and re.search(r"F ?MAX", text) is not None
        if self.corner and self.rows and (sweep or self.rows[-1][3]) and self.corner[0] == "RND":
            self._round_corner(there, centre, math.copysign(1.0, sweep) if sweep else 0.0)
            if sweep:
                begin = complex(self.at[0], self.at[1]) - centre
                sweep = self._turn_between(begin, there - centre, sweep > 0)
            here = complex(self.at[0], self.at[1])
        elif self.corner and straight:
            self._cut_corner(end)
            here = complex(self.at[0], self.at[1])
        self._take_side()
        if straight:
            lost = self.departed and math.isnan(self.at[0] + self.at[1])
            self._to(RAPID if fast or lost else FEED, end)
            moved = there - here
            self.way = moved / abs(moved) if (a, b) == (0, 1) and abs(moved) > 1e-9 else complex(math.nan)
            return
        middle = list(_NOWHERE)
        middle[a], middle[b] = centre.real, centre.imag
        self._to(CCW if sweep > 0 else CW, end, middle, sweep)
        out = (there - centre) * (1j if sweep > 0 else -1j)
        self.way = out / abs(out) if (a, b) == (0, 1) else complex(math.nan)

    @staticmethod
    def _turn_between(first: complex, second: complex, left: bool) -> float:
        turn = cmath.phase(second / first)
        if abs(second - first) < 1e-9 or turn == 0.0:
            return 2.0 * math.pi if left else -2.0 * math.pi
        return turn % (2.0 * math.pi) if left else -((-turn) % (2.0 * math.pi))

    def _round_corner(self, there: complex, centre: complex, sense: float) -> None:
        """Round a corner beside an arc: Newton's method for how far from it the arc begins and ends, both from its centre."""
        assert self.corner is not None
        (_, size, number), self.corner = self.corner, None
        last = self.rows[-1]
        begin, corner = complex(*last[4:6]), complex(*self.at[:2])
        turned, about = last[3], complex(*last[10:12])

        def arriving(way: float) -> tuple[complex, complex]:
            if not turned:
                along = (corner - begin) / abs(corner - begin)
                return corner - way * along, along
            arm = (corner - about) * cmath.exp(-1j * math.copysign(1.0, turned) * way / abs(corner - about))
            return about + arm, 1j * math.copysign(1.0, turned) * arm / abs(arm)

        def leaving(way: float) -> tuple[complex, complex]:
            if not sense:
                along = (there - corner) / abs(there - corner)
                return corner + way * along, along
            arm = (corner - centre) * cmath.exp(1j * sense * way / abs(corner - centre))
            return centre + arm, 1j * sense * arm / abs(arm)

        left = (arriving(0.0)[1].conjugate() * leaving(0.0)[1]).imag > 0
        if abs((arriving(0.0)[1].conjugate() * leaving(0.0)[1]).imag) < 1e-9:
            return
        offset = 1j * size * (1.0 if left else -1.0)

        def apart(u: float, v: float) -> complex:
            (one, way), (other, out) = arriving(u), leaving(v)
            return one + offset * way - other - offset * out

        u = v = 0.0
        for _ in range(60):
            gap, step = apart(u, v), 1e-6
            by_u, by_v = (apart(u + step, v) - gap) / step, (apart(u, v + step) - gap) / step
            det = by_u.real * by_v.imag - by_u.imag * by_v.real
            du = -(gap.real * by_v.imag - gap.imag * by_v.real) / det
            dv = -(by_u.real * gap.imag - by_u.imag * gap.real) / det
            u, v = u + du, v + dv
            if abs(du) + abs(dv) < 1e-11:
                break
        (first, way), (second, _) = arriving(u), leaving(v)
        row = list(last)
        row[7:9] = [first.real, first.imag]
        if turned:
            row[3] = self._turn_between(begin - about, first - about, turned > 0)
        self.rows[-1] = tuple(row)
        middle = first + offset * way
        self.number, now = number, self.number
        self.at = [first.real, first.imag, self.at[2]]
        sweep = self._turn_between(first - middle, second - middle, left)
        self._to(
            CCW if left else CW, [second.real, second.imag, self.at[2]], [middle.real, middle.imag, math.nan], sweep
        )
        self.number = now

    def _cut_corner(self, end: Place) -> None:
        """Shorten the last move, and go round the corner or across it."""
        assert self.corner is not None
        (kind, size, number), self.corner = self.corner, None
        last = list(self.rows.pop())
        begin, corner, there = complex(*last[4:6]), complex(*self.at[:2]), complex(*end[:2])
        arriving, leaving = (corner - begin) / abs(corner - begin), (there - corner) / abs(there - corner)
        bend = cmath.phase(leaving / arriving)
        reach = size if kind == "CHF" else size * abs(math.tan(bend / 2))
        first, second = corner - reach * arriving, corner + reach * leaving
        self.at = last[4:7]
        self.beside = _COMING if last[14] == ENTRY else self.beside
        own, self.number = self.number, int(last[0])
        self._to(int(last[1]), [first.real, first.imag, last[9]])
        self.number = number
        if kind == "CHF":
            self._to(FEED, [second.real, second.imag, last[9]])
        elif reach:
            centre = first + 1j * arriving * math.copysign(size, bend)
            self._to(
                CCW if bend > 0 else CW, [second.real, second.imag, last[9]], [centre.real, centre.imag, math.nan], bend
            )
        self.number = own


# Programs: blocks in the order in which the control executes them.


#: Characters of a program, and blocks of one with calls, that are followed at a time.
_AT_A_TIME, _BLOCKS_AT_A_TIME = 1 << 18, 8192
_CALLS = re.compile(rb"[Mm][^\S\n+]*+\+?[^\S\n]*+0*+9[78]")


def executed(source: Path, dialect: str, *, skip_deleted: bool = False) -> Iterator[tuple[str, Sequence[int]]]:
    """Yield the text of a file, a part at a time, with the line of each block, as the control executes it: calls are followed."""
    with source.open(encoding="latin-1", newline="\n") as stream:
        if dialect == "heidenhain-klartext":  # its labels are anywhere
            text = stream.read()
            yield text, range(1, text.count("\n") + 2)
            return
        if dialect in ("fanuc", "linuxcnc") and _may_call(source):
            blocks = _with_calls(stream.readlines(), dialect, skip_deleted)
            while some := list(itertools.islice(blocks, _BLOCKS_AT_A_TIME)):
                yield "".join(text for _, text in some), [number for number, _ in some]
            return
        number = 1
        while text := stream.read(_AT_A_TIME):
            text += stream.readline()
            count = text.count("\n") + (text[-1] != "\n")
            yield text, range(number, number + count)
            number += count


def _may_call(source: Path) -> bool:
    with source.open("rb") as stream:
        while part := stream.readlines(_AT_A_TIME):
            if _CALLS.search(b"".join(part)):
                return True
    return False


def _with_calls(lines: Sequence[str], dialect: str, skip_deleted: bool) -> Iterator[tuple[int, str]]:
    """Execute blocks, with a stack of calls: (block to return to, calls left, first block of the subprogram)."""
    every = [_Words() if skip_deleted and line.lstrip().startswith("/") else _Words.of(line, dialect) for line in lines]
    heads = [_head(line) for line in lines]
    stack: list[tuple[int, int, int]] = []
    k = 0
    while k < len(lines):
        words = every[k]
        number, codes = words.number.get("P"), set(words.codes)
        first, times = None, 1
        if number is not None and codes & {"M97", "M98"}:
            first, times = _called(int(number), words, heads, every, k, "M97" in codes)
        back = "M99" in codes and stack
        yield k + 1, lines[k] if first is None else re.sub(r"[PL]\s*\d+", "", lines[k], flags=re.IGNORECASE)
        if codes & {"M2", "M30"}:
            return
        k += 1
        if first is not None and times:
            stack.append((k, times - 1, first))
            k = first
        elif back:
            then, left, begin = stack.pop()
            if left:
                stack.append((then, left - 1, begin))
            k = begin if left else then
        if len(stack) > 10:
            return


def _head(line: str) -> int | None:
    found = re.match(r"\s*(?:N\s*\d+\s*)?[O:]\s*(\d+)", line, re.IGNORECASE)
    return int(found[1]) if found else None


def _called(
    number: int, words: _Words, heads: Sequence[int | None], every: Sequence[_Words], k: int, local: bool
) -> tuple[int | None, int]:
    """Where what a block calls begins, and how often; None if it is not in the file."""
    times = int(words.number.get("L", 1.0))
    if local:
        return next((j for j, other in enumerate(every) if other.number.get("N") == number and j != k), None), times
    if number in heads:
        return heads.index(number) + 1, times
    if "L" not in words.number and number % 10000 in heads:
        return heads.index(number % 10000) + 1, number // 10000
    return None, times


# Two readings held against each other.

#: Places that differ by less are the same, mm: holes in increments are rewritten with two more decimals than the dialect has.
_SAME_MM = 1e-4


def difference(read: Moves, followed: Moves) -> tuple[int, str] | None:
    """Return the first line at which two readings of a program differ, and how; None if they agree.

    Where the reader does not know a position there is nothing to differ. Moves that lead nowhere do not count.
    """
    first, second = (moves.only(_moving(moves)) for moves in (read, followed))
    count = min(len(first), len(second))
    a, b = first.part(slice(0, count)), second.part(slice(0, count))
    wrong = (a.kind != b.kind) | (a.line != b.line) | (a.phase != b.phase)
    for mine, theirs in ((a.end_mm, b.end_mm), (a.centre_mm, b.centre_mm), (a.tool_mm, b.tool_mm)):
        wrong |= ~in_all(np.isnan(mine) | (np.abs(mine - theirs) <= _SAME_MM))
    wrong |= ~np.isclose(a.aside_mm, b.aside_mm, rtol=0.0, atol=_SAME_MM)
    arcs = np.flatnonzero(a.sweep_rad != b.sweep_rad)
    if len(arcs):
        radius_mm = np.nanmax(np.abs(a.start_mm[arcs] - a.centre_mm[arcs]), axis=1, initial=0.0)
        wrong[arcs] |= np.abs(a.sweep_rad[arcs] - b.sweep_rad[arcs]) * radius_mm > _SAME_MM
    if wrong.any():
        k = int(np.argmax(wrong))
        return int(a.line[k]), f"{_told(a, k)}, or {_told(b, k)}"
    if len(first) != len(second):
        longer = first if len(first) > count else second
        return int(longer.line[count]), f"{_told(longer, count)}, or no move"
    return None


def _moving(moves: Moves) -> NDArray[np.bool_]:
    unknown = np.isnan(moves.start_mm) & np.isnan(moves.end_mm)
    return np.asarray(~in_all(unknown | (np.abs(moves.end_mm - moves.start_mm) < 1e-6)) | (moves.sweep_rad != 0))


def _told(moves: Moves, k: int) -> str:
    kind = ("rapid", "at feed", "clockwise", "counterclockwise")[int(moves.kind[k])]
    place = " ".join(f"{letter}{value:.4f}" for letter, value in zip("XYZ", moves.end_mm[k], strict=True))
    return f"{kind} to {place} of the machine in line {int(moves.line[k])}"


class Agreement:
    """Follows a file beside its reader and refuses the first move on which the two differ."""

    def __init__(self, reader: Reader) -> None:
        source, dialect, found = Path(reader.source), reader.dialect.name, reader.written_out
        self.reader = reader
        self._follower = Follower(dialect, reader.setup, reader.machine)
        if found is not None and found.resolved:
            self._blocks: Iterator[tuple[str, Sequence[int]]] = iter(
                [(found.content.decode("latin-1"), found.line.tolist())]
            )
        elif reader.linked is not None:
            self._blocks = iter([(reader.linked.text(), reader.linked.main_lines)])
        else:
            self._blocks = executed(source, dialect, skip_deleted=reader.setup.skip_deleted)
        self._ahead = Moves.of_rows([])

    def hold(self, moves: Moves) -> None:
        """Take the next moves of the reader, with the lines of the file."""
        moves = moves.only(_moving(moves))
        parts = [self._ahead]
        while sum(map(len, parts)) < len(moves):
            some = next(self._blocks, None)
            if some is None:
                break
            found = self._follower.follow(*some)
            parts.append(found.only(_moving(found)))
        every = Moves.joined(parts)
        self._compare(moves, every.part(slice(0, len(moves))))
        self._ahead = every.part(slice(len(moves), None))

    def finish(self) -> None:
        """Take the end of the program."""
        rest = [self._ahead, *(self._follower.follow(*some) for some in self._blocks)]
        self._compare(Moves.of_rows([]), Moves.joined(rest))

    def _compare(self, read: Moves, followed: Moves) -> None:
        if found := difference(read, followed):
            line, how = found
            raise InputError(
                f"can be read in two ways: {how}; post moves that leave no doubt, and please report this program",
                file=self.reader.source,
                line=line,
            )


def read_twice(reader: Reader) -> Iterator[Batch]:
    """Yield the batches of a reader's program, each held against the moves of a follower of the same file."""
    with reader.opened() as stream:
        second = Agreement(reader)
        for batch in reader.batches(stream):
            if not reader.unknown:  # codes that are not known are refused at the end
                second.hold(reader.numbered_as_in_file(batch.moves))
            yield batch
    second.finish()
