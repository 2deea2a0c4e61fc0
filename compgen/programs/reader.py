"""NC programs read into moves of the machine axes, in batches of blocks: words, modal state, positions.

A position here is that of the machine axes as the control counts them, mm: program position + work offset + G92 + tool
length. Blocks in a row that have nothing but plain words (lines, arcs, G90, G91, planes, M codes that move nothing, comments)
are read many at a time by numpy, others one by one; both ways give the same moves.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import MM_PER_UNIT, Machine, Vector3
from compgen.errors import InputError, visible_line
from compgen.programs import klartext, sinumerik
from compgen.programs.compensation import centre_path, peaks
from compgen.programs.cycles import DrillingCycle, defines_hole
from compgen.programs.dialects import MARK, REFUSED, VALUE, Dialect, codes_that_stay, written_offset
from compgen.programs.path import (
    CCW,
    CONTOUR,
    CW,
    ENTRY,
    EXIT,
    FEED,
    PLAIN,
    PLANE_AXES,
    RAPID,
    STILL,
    IntArray,
    Moves,
    reach_of,
)
from compgen.programs.runs import (
    LONGEST_BLOCK,
    MOST_TURNS,
    P_WORD,
    R_WORD,
    RADIUS_TOLERANCE_MM,
    Run,
    Words,
    carried,
    centres_and_sweeps,
)
from compgen.programs.subprograms import Linked, Pointed, WrittenOut, written_out

MM_PER_INCH = 25.4
#: Bytes that are read at a time, and the fewest blocks in a row that are read together.
BATCH_BYTES, LEAST_RUN = 1 << 18, 12
#: What a block has where its numbers come from variables or expressions, and those of HEIDENHAIN in addition: Q1, Q2 ...
_VARIABLE = re.compile(
    r"[A-Z]++\d*+\s*+(?:=\s*+)?(?:[-+]\s*+)?[#\[]|R\d++\s*+=|[A-Z]++\s*+=\s*+[-+]?[A-Z(]|=", re.IGNORECASE
)
_VARIABLE_Q = re.compile(r"[A-Z]+\s*+[-+]?Q\d|Q\d++\s*+=|D\d++\s*+Q", re.IGNORECASE)
_ALLOWED = bytes([9, 10, 13, *range(32, 256)])
#: How many lines of a code are said.
MOST_LINES = 30
#: Functions of DIN/ISO programs of HEIDENHAIN that change no Q parameter: error messages, output, signals to the PLC.
_Q_FUNCTIONS_THAT_STAY = (14.0, 15.0, 16.0, 19.0, 20.0, 29.0)
#: What LinuxCNC leaves between a peck and the depth reached before, mm.
_PECK_CLEARANCE_MM = 0.254
#: X and Y that differ by less are one place, mm: such a move is none of a contour.
SAME_PLACE_MM = 1e-7
#: Where X and Y are with radius compensation: not at all, before the move to the contour, on it, before the move away from it.
_OUTSIDE, _ENTERING, _ON, _LEAVING = range(4)
#: Codes with which the control goes to a contour in a straight line, and about outer corners on an arc.
_AS_JUDGED = {"way": ("NORM", "G460"), "corner": ("G450",)}
_TO_THE_CONTOUR = (
    "the control comes to the contour and leaves it about its first and last point, where a straight line is judged"
)
_TO_THE_CORNER = (
    "outer corners lead beyond the arc that is judged, at most to where the paths beside both moves meet; "
    "the tool is in the air there"
)
_TO_THE_END = (
    "at an inner corner the tool goes to the end of the move, beyond where the paths beside both moves meet; "
    "that is not judged"
)
_GOES_AROUND = {
    **dict.fromkeys(("KONT", "KONTC", "KONTT", "G461", "G462"), _TO_THE_CONTOUR),
    **dict.fromkeys(("G451", "DISC", "M97"), _TO_THE_CORNER),
    "M98": _TO_THE_END,
}
#: A rest of a hole below which no further peck is made: the rounding of sums, mm.
PECK_REST_MM = 1e-9


@dataclass(frozen=True)
class Setup:
    """What a program needs beside its text: work offsets and tools (mm), blocks with ``/``, codes that move nothing.

    ``work_offsets_mm`` by name (``G54``), ``tools_mm`` the offsets that the control adds for a tool, by its number or name.
    ``integers`` says what a number without a decimal point is where controls differ (FANUC): mm, or increments of
    ``increment_mm``.
    ``subprograms`` are the folders in which files that the program calls are looked for.
    ``radii_mm`` are those that radius compensation takes, by the number of D or of the tool; ``stated_radii_mm`` go before them,
    that of ``""`` for all.
    ``gauge_mm`` is the tool offset of the model for a tool of length 0: from the origin of the tool carriage to the gauge point.
    """

    work_offsets_mm: Mapping[str, Vector3] = field(default_factory=dict)
    tools_mm: Mapping[str, Vector3] = field(default_factory=dict)
    skip_deleted: bool = False
    keep_unknown: frozenset[str] = frozenset()
    gauge_mm: Vector3 = (0.0, 0.0, 0.0)
    integers: str | None = None
    increment_mm: float | None = None
    subprograms: tuple[Path, ...] = ()
    radii_mm: Mapping[str, float] = field(default_factory=dict)
    stated_radii_mm: Mapping[str, float] = field(default_factory=dict)

    def radius_mm(self, key: str, in_program_mm: float | None = None, more_mm: float = 0.0) -> float:
        """Return the radius of D or of a tool: as stated, or of program or table with ``more_mm`` (DR); inf if unknown."""
        stated = self.stated_radii_mm.get(key, self.stated_radii_mm.get(""))
        if stated is not None:
            return stated
        return (self.radii_mm.get(key, math.inf) if in_program_mm is None else in_program_mm) + more_mm


@dataclass(frozen=True)
class SingleBlock:
    """A block that was read by itself: its words (address, value text, first and last column), moves and modal state.

    ``kind`` says how it is rewritten: ``line``, ``arc``, ``cycle``, ``hole`` (by the cycle ``drilling``), ``preset`` (G92), or
    as it is: ``keep``, ``no preset`` (G92.1), ``store`` (a cycle without a hole).
    """

    number: int
    text: str
    words: list[tuple[str, str, int, int]]
    first: int
    count: int
    kind: str
    absolute: bool
    scale: float
    centre_absolute: bool
    inverse_time: bool
    #: Addresses that say for themselves whether they are absolute: X=IC(5), I=AC(5).
    modes: Mapping[str, bool] = field(default_factory=dict)
    drilling: DrillingCycle | None = None
    #: The blocks by which a drilling cycle in increments is replaced: one for each hole, in absolute.
    parts: tuple[SingleBlock, ...] = ()
    #: Whether a series of holes begins here, whose initial level G98 returns to.
    begins_series: bool = False
    #: The axis that the plane does not contain: that of the tool in a drilling cycle.
    plane: int = 2


@dataclass(frozen=True)
class Batch:
    """Blocks in a row: their text and words, moves, and how the blocks were read, in order."""

    first_line: int
    text: str
    words: Words
    moves: Moves
    segments: list[SingleBlock | Run]


def number_of(text: str) -> float:
    """Return the value of a word; blanks between its sign and its digits do not count."""
    return float(text.replace(" ", "").replace("\t", ""))


_SIDE = re.compile(rb"(?<![A-Z])G[ \t]*0*4(0|[12](?:\.1)?)(?![\d.])", re.IGNORECASE)
#: As they are without blanks and zeros: most programs have neither.
_MAY_TURN = re.compile(rb"G4[12]|g4[12]")
_SIDE_KLARTEXT = re.compile(rb"(?<![A-Z0-9])R(0|[LR])(?![\w.+-])", re.IGNORECASE)


def _whole_lines(content: bytes) -> tuple[bytes, bytes]:
    """Whole lines, and the rest."""
    whole = content.rfind(b"\n") + 1
    return content[:whole], content[whole:]


def _within_contour(content: bytes, dialect: Dialect, inside: bool) -> bool:
    """Whether radius compensation is active after some lines, before which it is if ``inside``."""
    pattern = _SIDE_KLARTEXT if dialect.klartext else _SIDE
    if not (inside or dialect.klartext or _MAY_TURN.search(content.translate(None, b" \t0"))):
        return False
    if not inside and not any(found[1] != b"0" for found in pattern.finditer(content)):
        return False
    code = re.sub(dialect.comments.encode(), b" ", content, flags=re.IGNORECASE)
    for found in pattern.finditer(code):
        inside = found[1] != b"0"
    return inside


class Reader:
    """Reads the blocks of one program in order and keeps its modal state."""

    def __init__(self, machine: Machine, dialect: Dialect, setup: Setup, source: str | Path) -> None:
        kept = codes_that_stay(dialect, setup.keep_unknown)
        self.machine, self.dialect, self.source = machine, dialect, source
        self.setup = replace(setup, keep_unknown=kept)
        self._pattern = dialect.word_pattern()
        self._sentences, self._pole_plane = klartext.Sentences(), 2
        self._name = re.compile(r"\s*([A-Z_][A-Z_0-9]+)\s*(\([^()\n]*\))?", re.IGNORECASE)
        #: How far corrected positions may leave the travel, mm.
        self.travel_slack_mm = machine.travel_margin_mm + 1e-6
        self.used_offsets: dict[str, Vector3] = {}
        #: Work offsets that the program has written (G10).
        self.written: dict[str, Vector3] = {}
        self.used_tools: dict[str, Vector3] = {}
        self.assumed: dict[str, None] = {}
        self._tools = dict(setup.tools_mm)
        self.motion: int | None = 0 if dialect.name == "grbl" else None
        self.cycle: int | None = None
        #: Depth and R level of the drilling cycle, mm above the zero of the program: a shift within the cycle moves both.
        #: Along Z; in the planes G18 and G19 along Y and X.
        self.cycle_z = self.cycle_r = math.nan
        #: Z and R of the drilling cycle as they were given last, in the unit ``cycle_scale`` of the program.
        self.cycle_given, self.cycle_scale = [math.nan, math.nan], 1.0
        #: Machine position of the axis of the tool and its offset where the series of holes began, and the plane of the series.
        self.initial_z, self.initial_offset, self.cycle_plane = math.nan, 0.0, 2
        self._begins_series = False
        self.cycle_peck, self.to_r_level = 0.0, dialect.name == "linuxcnc"
        self.plane, self.absolute, self.centre_absolute = 2, True, False
        #: mm per unit of length of the program: that of the control until G20 or G21.
        self.scale = MM_PER_UNIT[machine.units] if dialect.starts_in_its_units else 1.0
        self.feed, self.offset_name = "minute", ""
        #: Whether G94 or G95 has ended G93 and no F has been given since.
        self._feed_lost = False
        self._unit_known = False
        self.work, self.preset, self.length = (0.0,) * 3, (0.0,) * 3, (0.0,) * 3
        #: Shift of the coordinates by the program: G52, TRANS, G54 of HEIDENHAIN.
        self.shift: Vector3 = (0.0,) * 3
        #: Where the reference points are, mm of the machine: the second is not known; G28.1 and G30.1 store others.
        self._reference = list(machine.reference_place_mm)
        self.home = {"G28": self._reference, "G30": [math.nan] * 3}
        #: Rotary axes that the program names, with their only position.
        self.rotary: dict[str, float] = {}
        self.last_arc: int | None = None
        #: The drilling cycle that a block has defined, and whether all positions call it (MCALL, M89).
        self.drilling: DrillingCycle | None = None
        self.calling = self._defining = self._ends_calls = self._probing = False
        self._drilling_scale = 1.0
        self._preset_number = ""
        self._modes: dict[str, str] = {}
        self.selected = self.loaded = ""
        self.length_on = self.tool_on = False
        self.pole: list[float] = [math.nan] * 3
        self.position: list[float] = [math.nan] * 3
        #: Which axes blocks have named since their offset changed or they went to a machine position: only these are corrected,
        #: so that no word is added for an axis whose place at the control depends on numbers that were not used yet.
        self.named = [False] * 3
        #: Least and largest machine positions of moves that are corrected, (2, 3); nan before there are any.
        self.reached_mm = np.full((2, 3), np.nan)
        #: Codes that probe, with their lines.
        self.probed: dict[str, dict[int, None]] = {}
        #: M codes that are not known, with their lines: all are said at the end.
        self.unknown: dict[str, dict[int, None]] = {}
        #: Radius compensation: side (1 left, -1 right, 0 off), radius (inf: not known), where X and Y are, how it is named.
        self.side, self.radius_mm, self.contour, self.side_code = 0, 0.0, _OUTSIDE, ""
        self.used_radii: dict[str, float] = {}
        self._left_aside_mm = 0.0
        self._turned: tuple[str, int] | None = None
        #: Whether DEP has led to where only the control knows, and no move has placed X and Y since.
        self._departed = False
        self._d_number = self._tool_key = ""
        #: Radii of tools that the program defines, and what it adds to that of the tool (DR), mm.
        self._defined_radii: dict[str, float] = {}
        self._more_radius_mm = 0.0
        self.ended = self.seen_percent = self.started = False
        self.closed_by_percent = False
        self._line, self._text = 0, ""
        self.line_in_file: IntArray | None = None
        #: The program with its calls written out, if it has any.
        self.written_out: WrittenOut | None = None
        #: A program of Klartext with the programs that it calls behind it.
        self.linked: Linked | None = None
        #: How the control comes to contours and goes about outer corners, and the lines of what is another way than is judged.
        self._around: dict[str, str] = {}
        self._around_lines: dict[str, dict[int, None]] = {}
        self._integers: tuple[Pointed, str] | None = None
        self._rows: list[tuple[float, ...]] = []

    # Streams of blocks.

    def opened(self) -> BinaryIO | Pointed:
        """Open the program; calls of subprograms that are in its file are written out."""
        path = Path(self.source)
        found = None
        if self.dialect.name in ("fanuc", "linuxcnc"):
            setup = self.setup
            found = written_out(path, self.dialect.name, skip_deleted=setup.skip_deleted, folders=setup.subprograms)
        if self.dialect.name == "siemens":
            names = {*self.dialect.codes, *self.dialect.refused} - {"DEF", "CALL", "EXTCALL", "PROC"}
            setup = self.setup
            found = sinumerik.called_and_computed(
                path, names, skip_deleted=setup.skip_deleted, folders=setup.subprograms
            )
        if self.dialect.name == "heidenhain-iso":
            found = klartext.iso_computed(path, skip_deleted=self.setup.skip_deleted)
        if self.dialect.klartext:
            self.linked = klartext.linked(path, self.setup.subprograms)
            found = klartext.lowered(path, self.linked, skip_deleted=self.setup.skip_deleted)
            if found is not None and not found.called:
                self.line_in_file, self.written_out = found.line, found
                return BytesIO(found.content)
        if found is None:
            return self._pointed(path.open("rb"))
        self.line_in_file, self.written_out = found.line, found
        if found.called:
            said = f"calls are written out where they are, so that each is corrected: {', '.join(found.called)}"
            self.assumed[said] = None
        if found.variables:
            self.assumed[f"variables have the values that the program gives them: {', '.join(found.variables)}"] = None
        return self._pointed(BytesIO(found.content))

    def _pointed(self, stream: BinaryIO) -> BinaryIO | Pointed:
        """Give numbers their decimal point as the setup says what they are without."""
        setup, dialect = self.setup, self.dialect
        if not dialect.point_needed or setup.integers is None:
            return stream
        said = "mm (G20: inch)" if setup.integers == "mm" else f"increments of {setup.increment_mm:g} mm"
        plain = {code for code, meaning in dialect.codes.items() if meaning.startswith(("setting", "dwell"))}
        increment_mm = setup.increment_mm if setup.integers == "increments" else None
        found = Pointed(stream, increment_mm, plain, inch=self.scale == MM_PER_INCH)
        self._integers = found, f"numbers without a decimal point are {said}; the corrected program has them with it"
        return found

    def numbered_as_in_file(self, moves: Moves) -> Moves:
        """Return moves with the lines of the file in which their blocks are."""
        return moves if self.line_in_file is None else replace(moves, line=self.line_in_file[moves.line - 1])

    def in_file(self, line: int) -> int:
        """Return the line of the file that a line of the program as it was opened is from."""
        return line if self.line_in_file is None or not line else int(self.line_in_file[line - 1])

    def place_of(self, line: int) -> tuple[str | Path, int]:
        """Return the file and the line in it that a line of the program as it was opened is from."""
        places = self.written_out.places if self.written_out else ()
        return places[line - 1] if places and line else (self.source, self.in_file(line))

    def batches(self, stream: BinaryIO | Pointed) -> Iterator[Batch]:
        """Yield the batches of a program; the last one is followed by the check that the program was whole."""
        number, rest, inside = 1, b"", False
        while chunk := stream.read(BATCH_BYTES):
            content, rest = _whole_lines(rest + chunk)
            parts, inside = [content], _within_contour(content, self.dialect, inside)
            # a contour with radius compensation is corrected as a whole: each corner depends on the move after it
            while inside and (chunk := stream.read(BATCH_BYTES)):
                content, rest = _whole_lines(rest + chunk)
                parts.append(content)
                inside = _within_contour(content, self.dialect, inside)
            content = b"".join(parts)
            if content:
                if self.contour == _ON and not self.ended:
                    self._line, self._text = number, ""
                    self._fail(
                        f"{self.side_code} is hidden from the search for the end of its contour; post it in its own block"
                    )
                yield self.batch(content, number)
                number += content.count(b"\n")
            if len(rest) > LONGEST_BLOCK:
                self._refuse_bytes(rest, number)
                self._line, self._text = number, ""
                self._fail(f"the block is longer than {LONGEST_BLOCK} characters; expected one block in a line")
        if rest:
            yield self.batch(rest, number)
            number += 1
        self.finish(number - 1)

    def batch(self, content: bytes, first_line: int) -> Batch:
        """Read whole lines, the first with the number ``first_line``."""
        self._refuse_bytes(content, first_line)
        text, words = content.decode("latin-1"), Words(content, self.dialect, self.setup.keep_unknown)
        self._rows = []
        parts: list[Moves] = []
        count, k = 0, 0
        segments: list[SingleBlock | Run] = []
        start, run_end = words.start.tolist(), words.run_end.tolist()
        while k < len(run_end):
            if run_end[k] - k >= LEAST_RUN and self._takes_run():
                many = self._run(words, range(k, run_end[k]), first_line, count)
                if many is not None:
                    if self._rows:
                        parts.append(Moves.of_rows(self._rows))
                        self._rows = []
                    segments.append(many[0])
                    parts.append(many[1])
                    count, k = count + len(many[1]), many[0].lines.stop
                    continue
            if self.cycle is not None and words.places_end[k] - k >= LEAST_RUN:
                holes = self._holes(words, text, k, first_line, count)
                if holes is not None:
                    parts += [Moves.of_rows(self._rows), holes[1]]
                    self._rows = []
                    segments += holes[0]
                    count, k = count + len(holes[1]), k + len(holes[0])
                    continue
            if start[k + 1] - start[k] > LONGEST_BLOCK:
                self._line, self._text = first_line + k, ""
                self._fail(f"the block is longer than {LONGEST_BLOCK} characters; expected one block in a line")
            block = self._block(first_line + k, text[start[k] : start[k + 1]], count)
            segments.append(block)
            count += block.count
            k += 1
        parts.append(Moves.of_rows(self._rows))
        moves = Moves.joined(parts)
        self._check(moves)
        return Batch(first_line, text, words, moves, segments)

    def finish(self, last_line: int) -> None:
        """Refuse a program that ends in the middle, or has M codes that are not known."""
        if self._integers and self._integers[0].used:
            self.assumed[self._integers[1]] = None
        self._say_probed()
        self._say_around()
        if self.unknown:
            first = min(map(self.in_file, next(iter(self.unknown.values()))))
            raise InputError(self._said_unknown(), file=self.source, line=first)
        self._line, self._text = max(last_line, 1), ""
        if not self.started:
            self._fail("the program has no moves; expected an NC program")
        whole = self.ended or ("%" in self.dialect.end and self.closed_by_percent)
        if self.dialect.end_needed and not whole:
            codes = " or ".join(sorted(self.dialect.end))
            self._fail(f"the program ends without {codes}: it may have been cut; give the whole program")
        if self.dialect.name == "fanuc" and self.seen_percent and not self.closed_by_percent:
            self._fail(
                "the program begins with % and does not end with it: it may have been cut; give the whole program"
            )

    def _refuse_bytes(self, content: bytes, first_line: int) -> None:
        if first_line == 1 and content[:3] == b"\xef\xbb\xbf":
            self._line = 1
            self._fail("the program begins with a byte-order mark, which controls do not read; save it as plain text")
        if not content.translate(None, _ALLOWED) and content.count(b"\r") == content.count(b"\r\n"):
            return
        found = re.search(rb"[\x00-\x08\x0b\x0c\x0e-\x1f]|\r(?!\n)", content)
        if found and found.end() < len(content):
            self._line = first_line + content[: found.start()].count(b"\n")
            what = (
                "a carriage return within a line" if found[0] == b"\r" else f"the control character 0x{found[0][0]:02x}"
            )
            self._fail(f"contains {what}; expected a text file with one block in a line")

    def _fail(self, message: str, field: str | None = None) -> NoReturn:
        text = visible_line(self._text)[:60]
        shown = f" (block: {text})" if text else ""
        if self.unknown:
            shown += f"; before that, {self._said_unknown()}"
        file, line = self.place_of(self._line)
        raise InputError(message + shown, file=file, line=line, field=field)

    # Many blocks at a time.

    def _takes_run(self) -> bool:
        """Whether blocks of plain words are now moves and nothing else, from a known position."""
        known = not any(math.isnan(value) for value in self.position) and all(self.named) and bool(self.offset_name)
        modal = self.cycle is None and not self.calling and self.feed != "inverse" and self._unit_known
        modal = modal and self.contour in (_OUTSIDE, _ON) and not self._feed_lost
        return known and modal and not (self.ended or self.closed_by_percent)

    def _run(self, words: Words, lines: range, first_line: int, first: int) -> tuple[Run, Moves] | None:
        """Read blocks together, as :meth:`_block` reads each; up to one that cannot be followed, None if that is the first."""
        rows, pole = slice(lines.start, lines.stop), self.dialect.pole
        offset, value = np.array(self._offset()), words.value[rows]
        named, given = ~np.isnan(value[:, :3]), ~np.isnan(value[:, 3:6])
        motion = carried(words.motion[rows], -1 if self.motion is None else self.motion)
        absolute = carried(words.absolute[rows], int(self.absolute)) > 0
        plane = carried(words.plane[rows], self.plane)
        if self.contour == _ON and (plane != 2).any():
            return None  # it is refused block by block
        moving = named.any(axis=1)
        arc = (motion >= CW) & (moving if pole else moving | given.any(axis=1))
        at = self._places(named, value[:, :3] * self.scale, absolute, offset)
        stopped = (moving | arc) & (motion < 0)
        poles = np.zeros((len(value), 3))
        if pole:
            centre = np.where(absolute[:, None], offset, at[:-1]) + value[:, 3:6] * self.scale
            for k in range(3):
                poles[:, k] = np.concatenate([[self.pole[k]], centre[:, k]])[
                    carried(np.where(given[:, k], np.arange(1, len(value) + 1), -1), 0)
                ]
        arcs = np.flatnonzero(arc)
        if len(arcs):
            if pole:
                centre = poles[arcs]
            elif self.centre_absolute:
                centre = offset + value[arcs, 3:6] * self.scale
            else:
                centre = at[arcs] + np.where(given[arcs], value[arcs, 3:6], 0.0) * self.scale
                none = ~given[arcs[:, None], np.array(PLANE_AXES)[plane[arcs]]].any(axis=1)
                centre[none] = np.nan
            turns = np.where(
                np.isnan(value[arcs, P_WORD]) | (self.dialect.name != "linuxcnc"), 1.0, value[arcs, P_WORD]
            )
            centre, sweep, wrong = centres_and_sweeps(
                at[arcs],
                at[arcs + 1],
                centre,
                value[arcs, R_WORD] * self.scale,
                plane[arcs],
                motion[arcs] == CCW,
                turns - 1.0,
            )
            stopped[arcs[wrong]] = True
        if stopped.any():
            stop = int(np.argmax(stopped))
            return self._run(words, lines[:stop], first_line, first) if stop else None
        row = np.flatnonzero(moving | arc)
        n = len(row)
        centres, sweeps = np.full((n, 3), np.nan), np.zeros(n)
        if len(arcs):
            centres[arc[row]], sweeps[arc[row]] = centre, sweep
        tool = np.array(self._tool())
        moves = Moves(
            line=first_line + lines.start + row,
            kind=motion[row],
            start_mm=at[row],
            end_mm=at[row + 1],
            centre_mm=centres,
            plane=plane[row],
            sweep_rad=sweeps,
            offset_mm=np.broadcast_to(offset, (n, 3)),
            tool_mm=np.broadcast_to(tool, (n, 3)),
            at_mm=at[row + 1],
            corrected=np.ones((n, 3), dtype=bool),
            **self._phases(at[row], at[row + 1], sweeps),
        )
        self.position, self.motion = at[-1].tolist(), int(motion[-1]) if motion[-1] >= 0 else None
        turning = motion[motion >= CW]
        self.last_arc = int(turning[-1]) if len(turning) else self.last_arc
        self.absolute, self.plane, self.started = bool(absolute[-1]), int(plane[-1]), self.started or n > 0
        only_pole = np.zeros(0, dtype=np.int64)
        if pole:
            self.pole = poles[-1].tolist()
            only_pole = np.searchsorted(row, np.flatnonzero(given.any(axis=1) & ~moving))
        run = Run(lines, first, lines.start + row, absolute[row], self.scale, self.centre_absolute, only_pole)
        return run, moves

    def _places(
        self, named: NDArray[np.bool_], value_mm: FloatArray, absolute: NDArray[np.bool_], offset: FloatArray
    ) -> FloatArray:
        """Machine positions before the first of some blocks and after each, (n + 1, 3), mm."""
        at = np.vstack([self.position, np.where(named, value_mm + offset, np.nan)])
        changes = [0, *(np.flatnonzero(np.diff(absolute)) + 1).tolist(), len(absolute)]
        for first, stop in itertools.pairwise(changes):
            part = at[first : stop + 1]
            if absolute[first]:
                last = np.maximum.accumulate(np.where(np.isnan(part), 0, np.arange(len(part))[:, None]))
                part[:] = np.take_along_axis(part, last, axis=0)
            else:  # one after the other: increments add up with the rounding of single blocks
                part[1:] = np.where(named[first:stop], value_mm[first:stop], 0.0)
                np.add.accumulate(part, out=part)
        return at

    def _holes(
        self, words: Words, text: str, line: int, first_line: int, first: int
    ) -> tuple[list[SingleBlock], Moves] | None:
        """Read blocks from ``line`` on that place holes of the active cycle, as :meth:`_cycle` does; None if they do more."""
        linuxcnc = self.dialect.name == "linuxcnc"
        modal = self.absolute and self.plane == self.cycle_plane == 2 and self.feed != "inverse" and all(self.named)
        modal = modal and not (self.ended or self.closed_by_percent) and self.contour == _OUTSIDE
        offset = np.array(self._offset())
        zero, initial = float(offset[2]), self._initial_level(float(offset[2]))
        known = not any(math.isnan(value) for value in (*self.position, self.cycle_z, self.cycle_r, initial))
        if not modal or not known or (linuxcnc and self.cycle in (73, 83)) or self.scale != self.cycle_scale:
            return None
        rows = slice(line, int(words.places_end[line]))
        given = words.value[rows][:, [0, 1, 2, R_WORD]]
        before = [*self.position[:2], zero + self.cycle_z, zero + self.cycle_r]
        value = np.vstack([before, given * self.scale + offset[[0, 1, 2, 2]]])
        every = np.arange(len(value))[:, None]
        value = np.take_along_axis(value, np.maximum.accumulate(np.where(np.isnan(value), 0, every)), axis=0)
        wrong = np.flatnonzero(value[1:, 3] < value[1:, 2])
        n = int(wrong[0]) if len(wrong) else len(given)
        if n < LEAST_RUN:
            return None
        (x, y, depth, level), (before_x, before_y) = value[1 : n + 1].T, value[:n, :2].T
        left = level if self.to_r_level else np.maximum(initial, level)
        height = np.concatenate([[self.position[2]], left[:-1]])
        below = (initial if linuxcnc else height) < level
        back = FEED if self.cycle in (84, 85, 89) else RAPID
        # up to the R level where the tool is, over the hole, to the R level, to the depth, back, and where the next begins
        over = np.where(below, level, height)
        over = np.where(over > level, over, left if linuxcnc else level)
        ends = np.array([[before_x, before_y, level], *([x, y, z] for z in (over, level, depth, level, left))])
        ends = ends.transpose(2, 0, 1)
        used = np.full((n, 6), True)
        used[:, 0], used[:, 4] = below, not linuxcnc or self.cycle == 85
        end, own, step = ends[used], *np.nonzero(used)
        start = np.vstack([self.position, end[:-1]])
        moved = (end != start).any(axis=1)
        start, end, own, step = start[moved], end[moved], own[moved], step[moved]
        kind, at_level = (
            np.array([RAPID, RAPID, RAPID, FEED, back, FEED if linuxcnc and self.cycle == 89 else RAPID])[step],
            end[:, 2] == level[own],
        )
        there, deep = step > 0, at_level | ((kind == FEED) & (end[:, 2] == depth[own]))
        moves = Moves(
            line=first_line + line + own,
            kind=kind,
            start_mm=start,
            end_mm=end,
            centre_mm=np.full(end.shape, np.nan),
            plane=np.full(len(end), self.plane),
            sweep_rad=np.zeros(len(end)),
            offset_mm=np.broadcast_to(offset, end.shape),
            tool_mm=np.broadcast_to(np.array(self._tool()), end.shape),
            at_mm=np.stack([x[own], y[own], np.where(at_level, end[:, 2], depth[own])], axis=1),
            corrected=np.stack([there, there, deep], axis=1),
        )
        self.position, self.started = [float(x[-1]), float(y[-1]), float(left[-1])], True
        for k, column in enumerate(given[:n, 2:].T):
            last = np.flatnonzero(~np.isnan(column))
            self._give_height(k, float(column[last[-1]]) if len(last) else None)
        counts = np.bincount(own, minlength=n)
        numbered = zip(counts.tolist(), (first + np.cumsum(counts) - counts).tolist(), strict=True)
        zeros = words.start[line : line + n + 1].tolist()
        begins, stops = (item[line : line + n].tolist() for item in (words.begin, words.end))
        letters, blocks = ((0, "X"), (1, "Y"), (2, "Z"), (R_WORD, "R")), []
        for j, (many, number) in enumerate(numbered):
            zero, begin, stop = zeros[j], begins[j], stops[j]
            found = [
                (name, text[begin[k] : stop[k]], begin[k] - zero, stop[k] - zero) for k, name in letters if stop[k]
            ]
            head = (first_line + line + j, text[zero : zeros[j + 1]], found, number, many, "cycle")
            blocks.append(SingleBlock(*head, True, self.scale, self.centre_absolute, False))
        return blocks, moves

    # One block.

    def _block(self, number: int, text: str, first: int) -> SingleBlock:
        self._line, self._text = number, text
        self._modes, self._begins_series, self._turned = {}, False, None
        inside, state = self.contour in (_ENTERING, _ON), (self._offset(), self._tool(), self.scale)
        before, words = len(self._rows), self._words(text)
        if parts := self._holes_in_absolute(number, text, words, first):
            count = sum(part.count for part in parts)
            return replace(parts[0], text=text, words=words, count=count, parts=parts)
        kind = self._act(words) if words else "keep"
        if inside and self.side and state != (self._offset(), self._tool(), self.scale):
            self._fail(
                f"changes zero, tool or unit while {self.side_code} is active; end the compensation before (G40, R0)"
            )
        return SingleBlock(
            number,
            text,
            words,
            first,
            len(self._rows) - before,
            kind,
            self.absolute,
            self.scale,
            self.centre_absolute or (self.dialect.pole and self.absolute),
            self.feed == "inverse",
            {letter: mode == "AC" for letter, mode in self._modes.items()},
            self.drilling if kind == "hole" else None,
            begins_series=self._begins_series,
            plane=self.plane,
        )

    def _holes_in_absolute(
        self, number: int, text: str, words: list[tuple[str, str, int, int]], first: int
    ) -> tuple[SingleBlock, ...]:
        """Read a drilling cycle in increments as blocks in absolute, one for each hole; none if the block is no such cycle.

        R counts from where Z was before the cycle, Z from R; X and Y count from hole to hole. In G18 Y is the depth, in G19 X.
        """
        numbers = {letter: number_of(value) for letter, value, *_ in words if value and value[0] != '"'}
        codes = [f"{letter}{number_of(value):g}" for letter, value, *_ in words if letter == "G"]
        meanings = [self.dialect.codes.get(code, "") for code in codes]
        begins = next((meaning for meaning in meanings if meaning.startswith("cycle")), "")
        on = self.cycle is not None and not any(
            meaning.startswith(("motion", "no motion", "home")) for meaning in meanings
        )
        incremental = "G91" in codes or (not self.absolute and "G90" not in codes)
        own = {"shift", "preset", "store", "machine", "setting", "dwell"}  # take the words of their block
        # and these move the zero from which the holes before were counted
        own |= {"work", "tool", "inch", "mm", *(("no",) if begins or on else ())}
        if (
            not incremental
            or not (begins or on)
            or not numbers.keys() & set("XYZR")
            or own & {m.split()[0] for m in meanings if m}
            or "H" in numbers
        ):
            return ()
        letters = [letter for letter, value, *_ in words if value and letter not in "GM"]
        for letter in numbers.keys() & set(letters):
            if letters.count(letter) > 1:
                self._fail(f"{letter} is given twice in a block")
        offset, scale, given = self._offset(), self.scale, list(self.cycle_given)
        deep = next((int(meaning[6:]) for meaning in meanings if meaning.startswith("plane")), self.plane)
        letter_deep, sides = "XYZ"[deep], [k for k in range(3) if k != deep]
        place = [(here - zero) / scale for here, zero in zip(self.position, offset, strict=True)]
        z = place[deep]
        if self.cycle is not None:
            z = (self._initial_level(offset[deep]) - offset[deep]) / scale
        if math.isnan(z) or any(math.isnan(value) for value in place):
            self._fail(
                "a drilling cycle in incremental from a position that is not known; position it in absolute first"
            )
        if self.dialect.name == "linuxcnc":  # keeps the numbers, whatever they meant when they were given
            raw = dict(zip((letter_deep, "R"), given, strict=True)) | numbers
            level = z + raw["R"]
            depth = level + raw[letter_deep]
        elif {letter_deep, "R"} <= numbers.keys():
            level = z + numbers["R"]
            depth = level + numbers[letter_deep]
        elif {letter_deep, "R"} & numbers.keys():
            self._fail(f"a drilling cycle in incremental with one of {letter_deep} and R; give both")
        else:
            level, depth = self.cycle_r / scale, self.cycle_z / scale
        if math.isnan(level + depth):
            self._fail(f"a drilling cycle without {letter_deep} or R")
        repeats = self._repeats(numbers)
        if repeats == 0:
            self._fail("a drilling cycle in incremental that is only stored is not followed; post each hole")
        digits = self.dialect.decimals[scale == MM_PER_INCH] + 2

        def word(letter: str, value: float) -> str:
            return f"{letter}{round(value, digits) + 0.0:.{digits}f}".rstrip("0")

        end, body = text[len(text.rstrip()) :] or "\n", text.rstrip()
        drop = {"X", "Y", "Z", "R", "L", *("K" if "I" not in numbers and "J" not in numbers else "")}
        for letter, value, begin, stop in reversed(words):
            mode = letter == "G" and number_of(value) in (90.0, 91.0)
            if mode or letter in drop:
                begin = body.upper().rindex(letter, 0, begin)
                body = body[:begin].rstrip(" ") + (" " if " " in body.strip() else "") + body[stop:].lstrip(" ")
        step = [numbers.get("XYZ"[k], 0.0) for k in sides]
        first_words = [word("XYZ"[k], place[k] + way) for k, way in zip(sides, step, strict=True)]
        first_words += [word(letter_deep, depth), word("R", level)]
        body = body.lstrip()
        head = re.match(r"(?:/\d?\s*)?(?:N\d+\s*)?", body)
        at = head.end() if head else 0
        texts = [" ".join([f"{body[:at]}G90", *first_words, body[at:]]).rstrip()]
        for k in range(2, int(repeats) + 1):
            texts.append(" ".join(word("XYZ"[n], place[n] + k * way) for n, way in zip(sides, step, strict=True)))
        texts.append("G91")
        parts: list[SingleBlock] = []
        for one in texts:
            parts.append(self._block(number, one + end, first + sum(part.count for part in parts)))
        self._text = text
        if self.dialect.name == "linuxcnc":
            for k, letter in enumerate((letter_deep, "R")):
                self._give_height(k, numbers.get(letter, given[k]))
        return tuple(parts)

    def _repeats(self, values: Mapping[str, float]) -> float:
        """How often a drilling cycle is executed: L, or K of FANUC, which is a peck where I or J is given (Haas)."""
        by_letter = self.dialect.name == "fanuc" and "I" not in values and "J" not in values
        repeats = values.get("L", values.get("K", 1.0) if by_letter else 1.0)
        if repeats != int(repeats) or not 0 <= repeats <= 9999:
            self._fail("expected a whole number of repeats of the drilling cycle")
        return repeats

    def _words(self, text: str) -> list[tuple[str, str, int, int]]:
        """Split a block into words; empty where it has nothing to do: comments, program numbers, % and skipped blocks."""
        body = text.rstrip()
        at = len(body) - len(body.lstrip())
        dialect = self.dialect
        if at == len(body):
            return []
        if dialect.klartext:
            return self._sentence(text)
        if body[at] == "/":
            if self.setup.skip_deleted:
                return []
            self.assumed["blocks with / are executed"] = None
            at += 2 if body[at + 1 : at + 2].isdigit() else 1
        percent = re.match(r"\s*(?:N\d+\s*)?%(.*)", body)
        if percent:
            return self._percent(percent[1])
        named = re.match(r"\s*(?:[O:]\d+|<[^<>]*>)", body, re.IGNORECASE)
        alone = named and not re.sub(r"\([^()]*\)", "", body[named.end() :]).strip()
        if named and (dialect.name in ("fanuc", "siemens") or (dialect.name == "linuxcnc" and alone)):
            if self.started:
                self._fail("a second program begins here; give one program at a time")
            at = named.end()
        if dialect.pole:
            body = re.sub(r"\*(\s*;)", r" \1", body.rstrip("*").rstrip(), count=1)
            if re.match(r"\s*(?:N\d+\s*)?\*", body):  # a heading within the program
                return []
            if self._takes_definition(body):
                return []
        label = re.match(r"\s*(?:N\d+\s*)?[A-Z_]{2}\w*\s*:(?!=)", body, re.IGNORECASE)
        if label and dialect.name == "siemens":
            at = label.end()
        words: list[tuple[str, str, int, int]] = []
        while at < len(body):
            found = self._pattern.match(body, at)
            if found is None:
                at = self._unread(body, at, words)
                continue
            if found["comment"] is not None:
                if MARK in found["comment"]:
                    self._fail("the program has been corrected before; give the program as it comes from CAM")
            else:
                address = found["address"].upper()
                if address == "O":
                    self._fail(
                        "subprograms and loops are not followed; post one program without calls (O1234: --dialect fanuc)"
                    )
                words.append((address, found["value"], found.start("value"), found.end("value")))
                if mode := found.groupdict().get("mode"):
                    self._modes[address] = mode.upper()
            at = found.end()
            if not body[at:].strip():
                break
        return words

    def _sentence(self, text: str) -> list[tuple[str, str, int, int]]:
        """Read a line of Klartext; empty where it has nothing to do, or has been done."""
        if MARK in text:
            self._fail("the program has been corrected before; give the program as it comes from CAM")
        said = self._sentences.of(text)
        what, words = said.what, said.words
        if said.deleted:
            if self.setup.skip_deleted:
                return []
            self.assumed["blocks with / are executed"] = None
        if what == "refused":
            self._fail(said.number)
        if what in ("begin", "end"):
            self._begin_or_end(what, said.number)
        elif self.seen_percent and self.closed_by_percent and what != "keep":
            self._fail("blocks after END PGM, which the control does not read; give one program at a time")
        elif what == "preset":
            self._use_preset(said.number)
        elif what in ("cycle", "more"):
            self._take_cycle(what, said.number)
        elif what == "probe":
            self._note_probe(said.number)
            self.position, self.named = [math.nan] * 3, [False] * 3
        elif what == "lost":
            self.assumed["PLANE leaves the rotary axes where the errors were measured"] = None
            if said.number != "stays":
                self.position, self.named = [math.nan] * 3, [False] * 3
        elif what == "shift":
            self._modes = dict(said.modes)
            self._shift_by_words(words)
        elif what == "tool definition":
            numbers = {letter: value for letter, value, *_ in words}
            self._tools[numbers.get("T", "0")] = (0.0, 0.0, number_of(numbers.get("L", "0")) * self.scale)
            if "R" in numbers:
                self._defined_radii[numbers.get("T", "0")] = number_of(numbers["R"]) * self.scale
        elif what == "tool":
            return words
        elif what == "move":
            self._modes = dict(said.modes)
            return self._in_its_plane(words)
        return []

    def _begin_or_end(self, what: str, unit: str) -> None:
        if what == "end":
            self.ended = self.closed_by_percent = True
            return
        if self.seen_percent or self.started:
            self._fail("a second program begins here; give one program at a time")
        if not unit:
            self._fail("BEGIN PGM without MM or INCH; give the whole first block")
        self.seen_percent, self._unit_known, self.scale = True, True, MM_PER_INCH if unit == "INCH" else 1.0

    def _use_preset(self, number: str) -> None:
        """Choose a preset of the table: PRESET1, or PRESET if the program uses this one only."""
        given, usual = self.setup.work_offsets_mm, self.dialect.work_offset
        name = f"{usual}{number}"
        if (
            name not in given
            and usual in given
            and self._preset_number in ("", number)
            and self.offset_name in ("", usual)
        ):
            self._preset_number, name = number, usual
            self.assumed[f"{usual} is preset {number}, which cycle 247 activates"] = None
        self.shift = (0.0,) * 3
        self.named = [False] * 3
        self._use_offset(name)

    def _take_cycle(self, what: str, code: str) -> None:
        if what == "cycle":
            if not defines_hole(code, klartext=True):
                why = ": back boring moves aside within the hole and cuts upwards" if code == "G204" else ""
                self._fail(
                    f"cycle {code[1:]} is not followed{why} (200 to 203, 205 to 209, 240, 241 are); post its moves"
                )
            self.drilling, self.calling = DrillingCycle(code, (), {}), False
            self._drilling_scale = self.scale
            if code == "G208":
                self.assumed["of bore milling (cycle 208) the place and the heights of the hole are corrected"] = None
        if self.drilling is not None:
            self.drilling = self.drilling.defined_further(self._text)

    def _shift_by_words(self, words: list[tuple[str, str, int, int]]) -> None:
        shift = list(self.shift)
        for letter, value, *_ in words:
            if letter in "ABC":
                if number_of(value):
                    self._fail(f"{letter}{value}: shifts of rotary axes are not followed")
                continue
            k = "XYZ".index(letter)
            shift[k] = number_of(value) * self.scale + (shift[k] if self._incremental(letter) else 0.0)
        self.shift = (shift[0], shift[1], shift[2])

    def _in_its_plane(self, words: list[tuple[str, str, int, int]]) -> list[tuple[str, str, int, int]]:
        """Choose the plane of an arc: that of the pole (CC X Z), or of the axes that CR names."""
        letters = {letter for letter, *_ in words}
        axes = {"XZ": 1, "YZ": 0, "IK": 1, "JK": 0}
        of_words = axes.get("".join(sorted(letters & set("XYZIJK"))), 2)
        if "CC" in letters:
            self._pole_plane = of_words
            if not letters & set("IJK"):
                words = [("CC here", "", 0, 0), *words]
        self.plane = self._pole_plane if letters & {"C", "CP"} else of_words if "CR" in letters else 2
        return words

    def _percent(self, rest: str) -> list[tuple[str, str, int, int]]:
        if self.dialect.name == "siemens" and self.started and rest.strip():
            self._fail("a second program begins here; give one program at a time")
        if self.dialect.pole and re.search(r"\bG7[01]\b", rest):  # name of the program, with its unit of length
            self.scale = MM_PER_INCH if re.search(r"\bG70\b", rest) else 1.0
            self._unit_known = True
            self.ended = self.ended or self.started
        if self.seen_percent or self.started:
            self.closed_by_percent = True
        self.seen_percent = True
        return []

    def _takes_definition(self, body: str) -> bool:
        """Take a block that defines a cycle from G200, or goes on doing so: ``G200 DRILLING``, ``Q200=2 ;SET-UP CLEARANCE``."""
        begun = re.match(r"\s*(?:N\d+\s*)?(G[24]\d\d)\b", body, re.IGNORECASE)
        self._probing = bool(begun and begun[1][1] == "4") or (self._probing and not begun)
        if self._probing and begun:
            self._note_probe(begun[1].upper())
            self.position, self.named, self._defining = [math.nan] * 3, [False] * 3, True
            return True
        if begun:
            code = begun[1].upper()
            if not defines_hole(code):
                reason = self.dialect.refused.get(code, "is no cycle that is followed; post its moves")
                self._fail(f"{code}: {reason}")
            self.drilling, self.calling, self._defining = DrillingCycle(code, (), {}), False, True
            self._drilling_scale = self.scale
        elif not self._defining or not re.match(r"\s*(?:N\d+\s*)?Q\d+\s*=", body, re.IGNORECASE):
            self._defining = self._defining and body.lstrip().startswith(";")
            return False
        elif self._probing:
            return True
        assert self.drilling is not None
        self.drilling = self.drilling.defined_further(self._text)
        return True

    def _unread(self, body: str, at: int, words: list[tuple[str, str, int, int]]) -> int:
        """Refuse what is no word, or take a code in letters; returns where the block goes on."""
        rest, dialect = body[at:].strip(), self.dialect
        name = self._name.match(body, at)
        if name:
            code = name[1].upper()
            if code == "CYCLE800" and name[2] and not re.search("[1-9A-Z]", ",".join(name[2].split(",")[4:13]).upper()):
                # all shifts and angles are 0: the plane is not turned, but the cycle may draw the tool back
                self.position, self.named = [math.nan] * 3, [False] * 3
                self.assumed["CYCLE800 without angles leaves the rotary axes where the errors were measured"] = None
                return name.end()
            if dialect.name == "siemens" and name[2] and dialect.codes.get(code) == "probe":
                self._note_probe(code)
                self.position, self.named = [math.nan] * 3, [False] * 3
                return name.end()
            if dialect.name == "siemens" and name[2] and defines_hole(code):
                self.drilling = DrillingCycle.called(code, self._text, name.start(2), name[2])
                self._drilling_scale = self.scale
                words.append((code, "", at, at))
                return name.end()
            if code in dialect.codes and not name[2]:
                words.append((code, "", at, at))
                assigned = re.compile(rf"(?<!\s)\s*+=\s*+{VALUE}").match(body, name.end(1)) if code == "DISC" else None
                return assigned.end() if assigned else name.end(1)
            if code in dialect.refused:
                self._fail(f"{code}: {dialect.refused[code]}")
        if rest[0] == ",":
            self._fail(f"{rest[:20]!r}: {dialect.refused['M98' if dialect.pole else ',']}")
        if rest[0] in "@^":
            self._fail(f"{rest[:20]!r}: {dialect.refused['G16']}")
        if rest[0] == ";":
            self._fail(
                f"{rest[:20]!r}: ; ends a block in this dialect; write comments in parentheses, one block in a line"
            )
        if rest[0] == "$":
            self._fail(f"{rest[:20]!r} is a command for the control, none of a program; give the program alone")
        if rest[0] in "#[" or _VARIABLE.match(rest) or (dialect.pole and _VARIABLE_Q.match(rest)):
            self._fail(f"{rest[:20]!r}: variables and expressions are not followed; post the program with numbers")
        if rest[0] in "oO":
            self._fail(
                f"{rest[:20]!r}: the subprogram is not known; give the folder of its file with --subprograms, or post one "
                "program without calls: subprograms and loops are not followed otherwise"
            )
        if name:
            self._fail(
                f"{name[1]} is not known in the dialect {dialect.name}, and may call a program or move; post the moves themselves"
                + (", or give the folder of its file with --subprograms" if dialect.name == "siemens" else "")
            )
        self._fail(f"{rest[:20]!r} cannot be read; expected words such as X10.5")

    def _act(self, words: list[tuple[str, str, int, int]]) -> str:
        """Change the modal state, then move; returns how the block is rewritten."""
        dialect, values = self.dialect, dict[str, float]()
        codes: list[str] = []
        name = ""
        for letter, text, _, _ in words:
            if not text:
                codes.append(letter)
            elif text[0] == '"':
                if letter != "T":
                    self._fail(f"{letter}={text} cannot be read; expected a number")
                name = text.strip('"').upper()
            elif letter in "GM":
                codes.append(f"{letter}{number_of(text):g}")
        self._ends_calls = "M99" in codes
        setting = [code for code in codes if self._is_setting(code)]
        cycles = self.cycle is not None or any(dialect.codes.get(code, "").startswith("cycle") for code in codes)
        lengths = "XYZIJRQ" if cycles else "XYZIJKR"
        for letter, text, _, _ in words:
            if not text or text[0] == '"' or letter in "GM":
                continue
            value = number_of(text)
            if letter in ("X1", "Y1", "Z1"):
                if not {"G74", "G75"} & set(codes):
                    self._fail(f"{letter}: machine axes are not followed; post X, Y and Z")
                letter = letter[0]
            dwells = letter == "U" and "G4" in codes and dialect.name == "fanuc"
            if letter in "ABCUVWE" and not setting and not dwells:
                self._further_axis(letter, text, value, codes)
                continue
            if letter == "D" and dialect.pole and value not in _Q_FUNCTIONS_THAT_STAY:
                self._fail(
                    f"D{text}: of Q parameters only what is constant is followed (D00 to D08 with numbers); post the program "
                    "without jumps, conditions and what it reads from the control"
                )
            if letter in values:
                self._fail(f"{letter} is given twice in a block")
            plain = setting or "G4" in codes
            if letter in lengths and dialect.point_needed and not plain and "." not in text and value != 0.0:
                self._ask_integers(letter, text)
            values[letter] = value
        if self.closed_by_percent and dialect.name in ("fanuc", "linuxcnc"):
            self._fail("blocks after the closing %, which the control does not read; give one program, within % and %")
        if self.ended and (values.keys() - {"N"} or any(code not in dialect.end for code in codes)):
            self._fail("blocks after the end of the program; give one program without subprograms")
        if {"G90", "G91"} <= set(codes):
            self._fail("G90 and G91 in one block: which coordinates are incremental is not clear; divide the block")
        if "M6" in codes and not (setting and dialect.pole):
            # the tool is changed before its length is called in the same block, wherever that stands
            self.loaded = self.selected = f"{values['T']:g}" if "T" in values else name or self.selected
        if "M61" in codes and dialect.name == "linuxcnc":
            self.loaded = ""
        actions: list[str] = []
        first = ("absolute", "incremental", "inch", "mm")  # before what they are about
        for code in sorted(codes, key=lambda code: dialect.codes.get(code) not in first):
            meaning = dialect.codes.get(code)
            if meaning is None and code[0] == "M" and code[1:].isdigit():
                self._m_code(code)
                continue
            if code in setting:
                _, *needed = (meaning or "").split()
                if needed and not any(f"{letter}{value:g}" in needed for letter, value in values.items()):
                    self._fail(f"{code} is followed with {' or '.join(needed)} only; post the program without it")
            elif meaning is None:
                unknown = (
                    f"is not known in the dialect {dialect.name}, and may move the machine; post the program without it"
                )
                self._fail(f"{code}: {dialect.refused[code]}" if code in dialect.refused else f"{code} {unknown}")
            elif meaning.startswith(("motion", "cycle")):
                actions.insert(0, meaning)
            else:
                self._modal(code, meaning, values, actions)
        if "write offset" in actions:
            return self._write_offset(values)
        if "modal call" in actions:
            self.calling = "drill here" in actions
            if self.calling and (problem := self.drilling.problem() if self.drilling else "no cycle is called"):
                self._fail(problem)
            return "keep"
        if setting:
            motions = [int(action[7:]) for action in actions if action.startswith("motion")]
            if len(motions) != len(actions) or (motions and values.keys() & set("XYZ")):
                self._fail(
                    f"{setting[0]} and a move are in one block, so that the words are ambiguous; divide the block"
                )
            if self._turned and self._turned[1] != self.side:
                self._fail(f"{setting[0]} and {self._turned[0]} are in one block; divide the block")
            if motions:
                self.motion = motions[0]
                self._end_cycle()
            if not dialect.pole:  # there T is a tolerance (G62) or the next tool (G51)
                self._tool_words(values, codes, name)
            return "keep"
        self._tool_words(values, codes, name)
        if "R" in values and dialect.name == "siemens":
            self._fail("R is a variable; write a radius as CR=")
        self._compensate(values)
        return self._execute(actions, [values.get(letter) for letter in "XYZ"], values)

    def _ask_integers(self, letter: str, text: str) -> NoReturn:
        unit = "inch" if self.scale == MM_PER_INCH else "mm"
        least = 1e-4 if unit == "inch" else 1e-3
        large = number_of(text)
        small, word = large * least, f"{letter}{text}"
        self._fail(
            f"{word} has no decimal point: {large:g} {unit}, or {small:g} {unit} "
            f"({text} increments of {least:g} {unit})? "
            'State [programs] integers = "mm" or "increments" (with increment_mm = 0.001) in the machine file, or --integers mm '
            "or --integers increments --increment-mm 0.001; or post it with a decimal point",
            letter,
        )

    def _is_setting(self, code: str) -> bool:
        """Whether the words of a block with ``code`` belong to it and move nothing."""
        return self.dialect.codes.get(code, "").startswith("setting")

    def _further_axis(self, letter: str, text: str, value: float, codes: list[str]) -> None:
        """Take a rotary axis that stays where it is; refuse what moves."""
        if letter == "E" and {"M67", "M68"} & set(codes):
            return
        incremental = not self.absolute if letter not in self._modes else self._modes[letter] == "IC"
        if "G90" in codes or "G91" in codes:
            incremental = "G91" in codes
        if letter == "E" and re.match(r"[+-]\d\d", text):
            self._fail(f"{letter}{text}: numbers with an exponent are not read by controls; post plain decimals")
        if letter in "UVWE":
            self._fail(f"{letter}{text}: further axes are not followed; correct a program with X, Y and Z")
        moving = next((code for code in codes if code in ("G0", "G1", "G2", "G3", "G28")), f"G{self.motion}")
        if letter not in self.rotary and not incremental and moving in ("G1", "G2", "G3"):
            self._fail(f"{letter}{text}: the rotary axis may turn while the tool cuts; position it with G0 before")
        place = self.rotary.setdefault(letter, 0.0 if incremental else value)
        if value != (0.0 if incremental else place):
            self._fail(
                f"{letter}{text}: the rotary axis turns, from {place:g}; correct a program for each of its positions"
            )
        self.assumed[f"the rotary axis {letter} stays at {place:g} deg, where the errors were measured"] = None

    def _m_code(self, code: str) -> None:
        if code in self.dialect.end:
            self.ended = True
        elif code in ("M97", "M98") and code in self.dialect.m_codes:
            if self._turned[1] if self._turned else self.side:
                self._around_lines.setdefault(code, {})[self._line] = None
        elif code not in self.dialect.m_codes and code not in self.setup.keep_unknown:
            if code in self.dialect.refused:
                self._fail(f"{code}: {self.dialect.refused[code]}")
            self.unknown.setdefault(code, {})[self._line] = None

    def _said_unknown(self) -> str:
        """Say which M codes are not known, each with its lines."""
        texts = []
        for code, found in self.unknown.items():
            lines = list(dict.fromkeys(map(self.in_file, found)))
            shown = [str(line) for line in lines[:MOST_LINES]]
            more = f" and {len(lines) - MOST_LINES} more" if len(lines) > MOST_LINES else ""
            texts.append(f"{code} ({'line' if len(lines) == 1 else 'lines'} {', '.join(shown)}{more})")
        is_not, they = ("is not", "it moves") if len(texts) == 1 else ("are not", "they move")
        return f"{', '.join(texts)} {is_not} known; if {they} nothing, add --keep-unknown {','.join(self.unknown)}"

    def _modal(self, code: str, meaning: str, values: dict[str, float], actions: list[str]) -> None:
        """Take over a code that is no motion; what acts in this block only is added to ``actions``."""
        what, _, argument = meaning.partition(" ")
        if what == "plane":
            self.plane = int(argument)
        elif what == "compensation":
            self._turned = code, int(argument)
        elif meaning in ("way", "corner"):
            self._around[meaning] = code
            if self.side:
                self._note_around(meaning)
        elif meaning == "arc about the corner":
            if values.keys() - {"N"}:
                self._fail(
                    f"{code} with other words gives the corner another direction; post {code} in a block of its own"
                )
        elif meaning == "departure":
            self._turned = code, 0
            actions.append(meaning)
        elif meaning in ("inch", "mm"):
            self.scale, self._unit_known = (MM_PER_INCH if meaning == "inch" else 1.0), True
        elif meaning in ("absolute", "incremental"):
            self.absolute = meaning == "absolute"
        elif what == "centre":
            self.centre_absolute = argument == "absolute"
        elif what == "feed":
            self._feed_lost = argument != "inverse" and (self._feed_lost or self.feed == "inverse")
            self.feed = argument
        elif meaning == "work offset":
            if code in ("G54", "G54.1", "G154") and "P" in values and self.dialect.name == "fanuc":
                code = f"{'G154' if code == 'G154' else 'G54.1'}P{values['P']:g}"
            if code in self.dialect.refused and values.keys() & set("XYZ"):
                self._fail(f"{code}: {self.dialect.refused[code]}")
            self._use_offset(code)
        elif meaning == "no work offset":
            self.offset_name, self.work, self.named = "none", (0.0,) * 3, [False] * 3
        elif meaning in ("initial level", "R level"):
            self.to_r_level = meaning == "R level"
        elif meaning == "no tool":
            self._set_length((0.0,) * 3, on=False)
            self.length_on = False
        elif meaning == "tool":
            self.length_on = True
            linuxcnc = self.dialect.name == "linuxcnc"
            key = f"{values['H']:g}" if "H" in values else self.loaded if linuxcnc else ""
            if not key:
                self._fail(
                    f"{code} without H, and the tool in the spindle is not known; add the number of the tool offset"
                )
            if linuxcnc and key == "0":
                self._fail(
                    f"{code} H0 is another length with each kind of tool changer; post {code} H and the tool, or G49"
                )
            self._use_tool(key)
        elif meaning == "tool offset":
            given = [values.get(letter, math.nan) * self.scale for letter in "XYZ"]
            x, y, z = (old if math.isnan(new) else new for new, old in zip(given, self.length, strict=True))
            self._set_length((x, y, z))
            self.used_tools[f"{code} in line {self._line}"] = self.length
            actions.append("done")
        elif meaning == "no preset":
            self._end_preset(code, values)
            actions.append(meaning)
        elif what in ("shift", "preset") and argument:
            self._shift(code, argument, values)
            actions.append("done")
        elif meaning == "shift":
            self._shift(code, "more" if self.dialect.pole and not self.absolute else "", values)
            actions.append("done")
        elif meaning == "store home":
            self.home[code[:-2]] = list(self.position)
            actions.append("done")
        elif meaning == "definition":
            self.drilling, self.calling = DrillingCycle(code, (), {}).defined_further(self._text), False
            self._drilling_scale = self.scale
            actions.append("done")
        elif meaning == "calls":
            self.calling = True
        elif meaning == "probe":
            self._note_probe(code)
            actions.append("unknown position")
            if self.dialect.name in ("linuxcnc", "grbl"):  # there it stays in force like G1
                self.motion = None
        elif meaning == "last arc":
            if self.last_arc is None:
                self._fail(f"{code} goes on in the direction of the last arc, and there is none before; post G2 or G3")
            actions.insert(0, f"motion {self.last_arc}")
        elif meaning == "no motion":
            if self.dialect.name != "fanuc":
                self.motion = None
            self._end_cycle()
        elif meaning == "tool definition":
            self._tools[f"{values.get('T', 0):g}"] = (0.0, 0.0, values.get("L", 0.0) * self.scale)
            if "R" in values:
                self._defined_radii[f"{values.get('T', 0):g}"] = values["R"] * self.scale
            actions.append("done")
        elif meaning == "home":
            actions.append(f"home {code}")
        elif meaning != "nothing":
            actions.append(meaning)

    def _note_around(self, what: str) -> None:
        """Keep where the control goes to a contour, or about its corners, in another way than the path that is judged."""
        code = self._around.get(what, _AS_JUDGED[what][0])
        if code not in _AS_JUDGED[what]:
            self._around_lines.setdefault(code, {})[self._line] = None

    def _say_around(self) -> None:
        """Say how the control goes beside a contour where that is not the path that is judged."""
        for code, found in self._around_lines.items():
            lines = ", ".join(map(str, self._lines_said(found)))
            self.assumed[f"{code} in line {lines}: {_GOES_AROUND[code]}"] = None

    def _note_probe(self, code: str) -> None:
        """Keep where the program probes: its block stays as it is, and where the tool is after it is not known."""
        self.probed.setdefault(code, {})[self._line] = None

    def _say_probed(self) -> None:
        texts = [
            f"{code} in line {', '.join(map(str, self._lines_said(lines)))}" for code, lines in self.probed.items()
        ]
        if texts:
            said = (
                f"probing is not corrected ({'; '.join(texts)}): what it measures is where the control counts to be, with the "
                "errors of the machine at that place; a work offset or tool length that is set from it is the one that was given"
            )
            self.assumed[said] = None

    def _lines_said(self, lines: Mapping[int, None]) -> list[int]:
        return list(dict.fromkeys(map(self.in_file, lines)))[:MOST_LINES]

    def _end_preset(self, code: str, values: dict[str, float]) -> None:
        """End G92: FANUC names the axes, which end G52 as well; in other dialects axis words beside it are a move."""
        named, fanuc = {"XYZ".index(letter) for letter in values.keys() & set("XYZ")}, self.dialect.name == "fanuc"
        if named and not fanuc:
            self._fail(f"{code} and a move are in one block; divide the block")
        if named and any((self.preset[k] or self.shift[k]) and k not in named for k in range(3)):
            self._fail(f"{code} ends the offsets of some axes only; name X, Y and Z")
        self.preset = (0.0,) * 3
        self.shift = (0.0,) * 3 if fanuc else self.shift

    def _shift(self, code: str, how: str, values: dict[str, float]) -> None:
        """Shift the coordinates: the axes that are named, all (``all``), further (``more``), or not at all (``off``)."""
        given = [values[letter] * self.scale if letter in values else None for letter in "XYZ"]
        if how == "off" and any(value is not None for value in given):
            self._fail(f"{code}: {self.dialect.refused[code]}")
        if how == "shift":  # G52 of LinuxCNC is kept where G92 is
            x, y, z = (old if new is None else new for new, old in zip(given, self.preset, strict=True))
            self.preset = (x, y, z)
            return
        if how == "" and not self.absolute:
            self._fail(f"{code} in incremental blocks is not followed; post G90 before it")
        kept = [0.0 if how in ("all", "off") else old for old in self.shift]
        x, y, z = (
            old if new is None else new + (old if how == "more" else 0.0) for new, old in zip(given, kept, strict=True)
        )
        self.shift = (x, y, z)

    def _tool_words(self, values: dict[str, float], codes: list[str], name: str) -> None:
        """Follow T, D and H: which tool's length the control adds."""
        number = f"{values['T']:g}" if "T" in values else name
        if number:
            self.selected = number
        if not self.dialect.tool_by_number:
            if "H" in values and "G43" not in codes and self.dialect.name == "linuxcnc":
                self._fail(f"H{values['H']:g} without G43, which the control refuses; post G43 with it")
            if self.length_on and "H" in values and "G43" not in codes:
                self._use_tool(f"{values['H']:g}")
        elif self.dialect.pole:
            if number and "G99" not in codes:
                self._use_tool(number, values.get("DL", 0.0) * self.scale)
                self._tool_key, self._more_radius_mm = number, values.get("DR", 0.0) * self.scale
        elif "D" in values and values["D"] != 1.0:
            self._d_number = f"{values['D']:g}"
            key = f"{self.loaded or self.selected}D{values['D']:g}"
            self._use_tool("0" if values["D"] == 0.0 else key)
        elif "D" in values or ("M6" in codes and self.loaded):
            self._d_number = "1"
            self._use_tool(self.loaded or self.selected)

    def _use_tool(self, key: str, longer_mm: float = 0.0) -> None:
        if key == "0":
            self._set_length((0.0,) * 3, on=False)
            return
        if key not in self._tools:
            some = sorted(self._tools)[:12]
            known = f"; the table has {', '.join(some)}{', ...' * (len(some) < len(self._tools))}" if some else ""
            self._fail(f"the length of tool {key} is not known{known}; give it with --tools FILE (tool, length_mm)")
        x, y, z = self._tools[key]
        self._set_length((x, y, z + longer_mm))
        self.used_tools[key] = self.length

    def _set_length(self, length: Vector3, *, on: bool = True) -> None:
        self.tool_on = on
        self.named = [n and a == b for n, a, b in zip(self.named, self.length, length, strict=True)]
        self.length = length

    def _use_offset(self, name: str) -> None:
        if name not in self.setup.work_offsets_mm and name not in self.written:
            given = ", ".join(self.setup.work_offsets_mm) or "none"
            self._fail(f"the work offset {name} is not known (given: {given}); add --wcs {name}=X,Y,Z in mm")
        if name != self.offset_name:
            if self.dialect.name == "siemens" and any(self.shift):
                self._fail(
                    f"{name} while TRANS is active: controls keep or end the shift; post TRANS without axes before"
                )
            self.named = [False] * 3
        self.offset_name, self.work = name, self.written.get(name) or self.setup.work_offsets_mm[name]
        if name not in self.written:
            self.used_offsets[name] = self.work

    def _write_offset(self, values: dict[str, float]) -> str:
        """G10: a work offset is what the program says, from here on; L20 of LinuxCNC and grbl: at the place where the tool is."""
        dialect = self.dialect.name
        name = written_offset(dialect, values, self.offset_name)
        if self.cycle is not None:
            self._fail(f"G10 within a drilling cycle {REFUSED['G10']}, or end the cycle by G80 before")
        if name is None or not self.absolute:
            why = "in incremental blocks its numbers are added to what the control has" if name else REFUSED["G10"]
            self._fail(f"G10: {why}; L2 and L20 with P of a work offset are followed in absolute")
        here = values["L"] == 20.0 and dialect != "fanuc"
        known = self.written.get(name) or self.setup.work_offsets_mm.get(name)
        given = [values.get(letter) for letter in "XYZ"]
        if known is None and any(value is None for value in given):
            self._use_offset(name)  # says how it is given
        place = list(known or (0.0,) * 3)
        for k, value in enumerate(given):
            if value is not None and here and math.isnan(self.position[k]):
                self._fail(f"G10 L20 {'XYZ'[k]} at a position that is not known; position it in absolute first")
            if value is not None:
                beside = self.length[k] + self.preset[k] + self.shift[k]
                place[k] = value * self.scale if not here else self.position[k] - beside - value * self.scale
        self.written[name] = (place[0], place[1], place[2])
        if name == (self.offset_name or self.dialect.work_offset):
            self.offset_name, self.work = name, self.written[name]
            self.named = [known and value is None for known, value in zip(self.named, given, strict=True)]
        x, y, z = (round(value, 6) + 0.0 for value in place)
        self.assumed[f"{name} is X{x:g} Y{y:g} Z{z:g} mm of the machine, as the program writes it (G10)"] = None
        return "preset" if here and any(value is not None for value in given) else "keep"

    def _offset(self) -> Vector3:
        x, y, z = map(sum, zip(self.work, self.shift, self.preset, self.length, strict=True))
        return x, y, z

    def _incremental(self, letter: str) -> bool:
        """Whether the word of an axis in this block is a distance, by the block or by itself (X=IC(5))."""
        mode = self._modes.get(letter)
        if mode not in (None, "AC", "IC"):
            self._fail(f"{letter}={mode}(...) is for rotary axes; expected AC or IC")
        return not self.absolute if mode is None else mode == "IC"

    def _tool(self) -> Vector3:
        if not self.tool_on:
            return self.machine.tool_offset_mm
        x, y, z = (a - b for a, b in zip(self.setup.gauge_mm, self.length, strict=True))
        return x, y, z

    # Radius compensation.

    def _compensate(self, values: Mapping[str, float]) -> None:
        """Begin or end radius compensation, once the block has named its tool and its D."""
        code, side = self._turned or ("", self.side)
        if "D" in values and self.dialect.name == "fanuc":
            if self.side and side and f"{values['D']:g}" != self._d_number:
                self._fail(f"D changes while {self.side_code} is active; end the compensation by G40 before")
            self._d_number = f"{values['D']:g}"
        if not self._turned or (side == self.side and not (side and self.dialect.name == "linuxcnc")):
            return
        if side and self.side:
            self._fail(
                f"{code} while {self.side_code} is active: the side within a contour does not change; post G40 before"
            )
        if not side:
            self.contour = _OUTSIDE if self.contour == _ENTERING else _LEAVING
        elif self.contour == _LEAVING:
            self._fail(f"{code} before a move in X and Y that ends the compensation before; post that move")
        elif self.plane != 2 or self.cycle is not None or self.calling:
            self._fail(
                f"{code} is followed in the plane XY (G17), outside of drilling cycles; post the path of the tool centre"
            )
        else:
            self.contour, self.side_code = _ENTERING, code
            self._note_around("way")
            self._note_around("corner")
            self.radius_mm = self._radius(code, values)
        self.side = side

    def _radius(self, code: str, values: Mapping[str, float]) -> float:
        """Radius that the control takes for the compensation, mm; inf if it is not known."""
        name, given = self.dialect.name, None
        if name == "fanuc":
            key, said = self._d_number, f"D{self._d_number}"
            given = 0.0 if key == "0" else None
        elif name == "linuxcnc":
            if code in ("G41.1", "G42.1"):
                if "D" not in values:
                    self._fail(f"{code} needs the diameter of the tool: D")
                given = 0.5 * values["D"] * self.scale
            elif values.get("D") == 0.0:
                self._fail(f"{code} D0 is another radius with each kind of tool changer; post the number of the tool")
            key = "" if given is not None else f"{values['D']:g}" if "D" in values else self.loaded
            said = f"{code} in line {self.in_file(self._line)}" if given is not None else f"tool {key}"
        elif name == "siemens":
            key = self.loaded or self.selected
            key += "" if self._d_number in ("", "1") else f"D{self._d_number}"
            given, said = (0.0 if self._d_number == "0" else None), f"tool {key}"
        else:
            key, said = self._tool_key, f"tool {self._tool_key}"
            given = self._defined_radii.get(key)
        radius = self.setup.radius_mm(key, given, self._more_radius_mm)
        if radius < 0.0:
            self._fail(
                f"the radius of {said} is {radius:g} mm, which changes the side; state it as 0 if the control has the wear alone"
            )
        self.used_radii[said] = radius
        return radius

    def _phase_of(self, end: list[float], sweep: float) -> tuple[int, float]:
        """What the next move is to the compensation, and how far the tool centre is beside the contour at its end."""
        if self.contour == _OUTSIDE:
            return PLAIN, 0.0
        aside = self.side * self.radius_mm if self.side else self._left_aside_mm
        ways = [there - here for there, here in zip(end[:2], self.position[:2], strict=True) if there == there]
        planar = sweep != 0.0 or not all(abs(way) <= SAME_PLACE_MM for way in ways)
        planar = planar or (self.contour == _LEAVING and not ways)  # to where only the control knows
        if not planar:
            return STILL, 0.0 if self.contour == _ENTERING else aside
        if self.contour == _ON:
            self._left_aside_mm = aside
            return CONTOUR, aside
        if sweep:
            self._fail(
                "radius compensation begins or ends on an arc, which controls refuse; post a line before or after it"
            )
        enters = self.contour == _ENTERING
        self.contour, self._left_aside_mm = (_ON, aside) if enters else (_OUTSIDE, 0.0)
        return (ENTRY, aside) if enters else (EXIT, 0.0)

    def _phases(self, start: FloatArray, end: FloatArray, sweep: FloatArray) -> dict[str, Any]:
        """The same of moves that are read together, as columns of :class:`Moves`."""
        if self.contour == _OUTSIDE:
            return {}
        planar = (sweep != 0) | (np.abs(end - start)[:, :2] > SAME_PLACE_MM).any(axis=1)
        aside = np.full(len(sweep), self.side * self.radius_mm)
        return {"phase": np.where(planar, CONTOUR, STILL), "aside_mm": aside}

    # Moves of a block.

    def _execute(self, actions: list[str], axes: list[float | None], values: dict[str, float]) -> str:
        motion = next((action for action in actions if action.startswith(("motion", "cycle"))), "")
        if motion.startswith("motion"):
            self.motion = int(motion[7:])
            self._end_cycle()
            self.last_arc = self.motion if self.motion in (CW, CCW) else self.last_arc
        named = any(axis is not None for axis in axes)
        if named and self.feed == "inverse" and self.motion in (FEED, CW, CCW) and "F" not in values:
            self._fail("a move in inverse time (G93) needs F in its block")
        self._feed_lost = self._feed_lost and "F" not in values
        if named and self._feed_lost and (motion.startswith("cycle") or self.motion != RAPID):
            self._fail("a move at feed after G93 has ended, without F since: controls keep the number, or stop; post F")
        single = [action for action in actions if not action.startswith(("motion", "cycle"))]
        if sum(action.startswith(("motion", "cycle")) for action in actions) > 1:
            self._fail("two motion codes in a block")
        moving = any(axis is not None for axis in axes)
        if moving or any(letter in values for letter in "IJK"):
            if not self.offset_name:
                self._use_offset(self.dialect.work_offset)
                self.assumed[f"the work offset {self.dialect.work_offset} is active at the start"] = None
            if not self.tool_on and any(self.machine.tool_offset_mm):
                self.assumed["without a tool length the tool is that of the machine file"] = None
            if not self._unit_known:
                self._unit_known = True
                self.assumed[f"lengths are in {'inch' if self.scale == MM_PER_INCH else 'mm'}"] = None
        if {"done", "dwell", "blank"} & set(single):
            return "keep"
        if self.dialect.pole and "L" in values and not {"label", "tool definition"} & set(single):
            self._fail(f"L{values['L']:g}: {self.dialect.refused['M98']}")
        if "no preset" in single:
            return "no preset"
        if {"approach", "departure"} & set(single):
            return self._approach(axes, departs="departure" in single, away="departs" in single)
        if self.contour in (_ENTERING, _ON):
            self._hold_contour(motion, single, moving)
        for action in single:
            if action.startswith("home ") or action == "unknown position":
                return self._home(axes, self.home.get(action[5:]))
        if "preset" in single:
            return self._preset(axes)
        if "lost height" in single:
            return self._lose_height(axes)
        if "drill here" in single or (self.calling and moving):
            return self._hole(axes, single, moving)
        if "machine coordinates" in single:
            return self._machine_move(axes)
        if "tap" in single:
            return self._tap(axes, values)
        self.named = [known or axis is not None for known, axis in zip(self.named, axes, strict=True)]
        if motion.startswith("cycle") or (self.cycle is not None and (moving or "R" in values)):
            return self._cycle(motion, axes, values)
        if self.dialect.pole:
            self._set_pole(values, "pole here" in single)
        if "helix" in single:
            return self._helix(axes, values)
        arc = (
            self.motion in (CW, CCW)
            and "rapid once" not in single
            and (moving or "full circle" in single or (any(c in values for c in "IJK") and not self.dialect.pole))
        )
        if not moving and not arc:
            return "keep"
        if self.motion is None:
            self._fail("axis words before any of G0, G1, G2, G3; post the motion code")
        end = self._target(axes)
        if arc:
            self._arc(end, values)
            return "arc"
        # the control alone knows where DEP has led; a line from there is in the air
        lost = self._departed and any(math.isnan(value) for value in self.position[:2])
        self._departed = lost
        self._move(RAPID if "rapid once" in single or lost else self.motion, end)
        return "line"

    def _approach(self, axes: list[float | None], *, departs: bool, away: bool) -> str:
        """APPR and DEP: to the first point of the contour, or from the last; the line or arc between is the control's own."""
        if self.contour == _ON:
            self._fail(f"APPR while {self.side_code} is active; end the compensation before (DEP, R0)")
        if self.calling:
            self._fail("APPR and DEP while M89 calls a cycle at all positions are not followed; end it by M99 before")
        self.assumed[
            "the line or arc of APPR and DEP is that of the control beside the corrected contour; it is neither judged nor held "
            "against the travel"
        ] = None
        self.named = [known or axis is not None for known, axis in zip(self.named, axes, strict=True)]
        end = self._target(axes)
        if away:
            end[:2] = math.nan, math.nan
        self._move(RAPID, end)
        if self.contour == _ENTERING:
            self._fail("APPR to where the tool is, so that it makes no approach; post the position before it")
        if away:
            self.named[:2] = False, False
        self._departed = away
        return "line" if any(axis is not None for axis in axes) else "keep"

    def _hold_contour(self, motion: str, single: list[str], moving: bool) -> None:
        """Refuse what controls do not do, or each in its way, while radius compensation is active."""
        refused = ("home", "unknown", "preset", "lost", "drill", "machine", "tap", "no preset")
        wrong = motion.startswith("cycle") or any(action.startswith(refused) for action in single) or self.calling
        if wrong or self.plane != 2 or (self.cycle is not None and moving):
            self._fail(
                f"only lines and arcs in the plane XY are followed while {self.side_code} is active; end the compensation before "
                "(G40, R0)"
            )

    def _target(self, axes: list[float | None]) -> list[float]:
        """Machine position that axis words ask for."""
        offset, end = self._offset(), list(self.position)
        for k, value in enumerate(axes):
            if value is not None:
                end[k] = (end[k] if self._incremental("XYZ"[k]) else offset[k]) + value * self.scale
                if math.isnan(end[k]):
                    self._fail(
                        f"{'XYZ'[k]} moves by an increment from a position that is not known; post it in absolute"
                    )
        return end

    def _move(
        self,
        kind: int,
        end: list[float],
        *,
        arc: tuple[float, ...] = (math.nan,) * 3,
        sweep: float = 0.0,
        at: list[float] | None = None,
        corrected: tuple[int, int, int] | None = None,
    ) -> None:
        if kind != RAPID and any(math.isnan(value) for value in (*self.position, *end)):
            missing = "XYZ"[next(k for k in range(3) if math.isnan(self.position[k]) or math.isnan(end[k]))]
            self._fail(
                f"moves at feed while the position of {missing} is not known; position it with G0 in absolute first"
            )
        head = (self._line, kind, self.plane, sweep)
        allowed = corrected or self.named
        if corrected == (0, 0, 0):
            pairs = zip(self.named, self.position, end, strict=True)
            self.named = [known and there == here for known, there, here in pairs]
        phase = self._phase_of(end, sweep)
        self._rows.append(
            (*head, *self.position, *end, *arc, *self._offset(), *self._tool(), *(at or end), *allowed, *phase)
        )
        self.position = list(end)
        self.started = True

    def _machine_move(self, axes: list[float | None]) -> str:
        if not self.absolute:
            self._fail("machine coordinates in incremental blocks are not followed; post G90")
        if self.motion not in (RAPID, FEED):
            self._fail("machine coordinates need G0 or G1")
        places = [None if value is None else value * self.scale for value in axes]
        self._assume_reached(places)
        pairs = zip(places, self.position, strict=True)
        self._move(RAPID, [p if v is None else v for v, p in pairs], corrected=(0, 0, 0))
        return "keep"

    def _assume_reached(self, places: list[float | None]) -> None:
        """Say what is taken for granted where a move in machine coordinates, which stays as it is, leaves the travel."""
        for letter, place, axis in zip("XYZ", places, self.machine.axes, strict=True):
            low, high = axis.range_mm
            if place is not None and not low - self.travel_slack_mm <= place <= high + self.travel_slack_mm:
                text = f"{letter} can go to {place:g} mm of the machine, outside its travel {low:g} to {high:g} mm"
                self.assumed.setdefault(f"{text}, as the move in machine coordinates asks", None)

    def _tap(self, axes: list[float | None], values: dict[str, float]) -> str:
        """G33.1: to the end and back in step with the spindle, as one block."""
        if "K" not in values or not any(axis is not None for axis in axes):
            self._fail("G33.1 needs a place and its pitch K")
        self.named = [known or axis is not None for known, axis in zip(self.named, axes, strict=True)]
        start = list(self.position)
        self._move(FEED, self._target(axes))
        self._move(FEED, start)
        self.motion = None
        return "tap"

    def _home(self, axes: list[float | None], home: list[float] | None) -> str:
        """Go through an intermediate point to the reference point ``home``: that of the machine, or one that was stored."""
        known = home is not None
        named = [axis is not None for axis in axes]
        if not any(named):
            if self.dialect.name == "fanuc" or not known:
                return "keep"
            named = [True] * 3
        if known:
            # an increment from a position that is not known is no move
            pairs = zip(axes, self.position, strict=True)
            moving = [axis if self.absolute or not math.isnan(place) else None for axis, place in pairs]
            self._move(RAPID, self._target(moving), corrected=(0, 0, 0))
        places = zip(named, home or [math.nan] * 3, self.position, strict=True)
        self._move(RAPID, [there if name else here for name, there, here in places], corrected=(0, 0, 0))
        if home is self._reference:
            self._assume_reference(named)
        return "keep"

    def _assume_reference(self, named: list[bool]) -> None:
        """Say what is taken for the reference point of G28 along axes for which the machine file does not state it."""
        stated = self.machine.reference_position_mm or (None,) * 3
        left = [k for k in range(3) if named[k] and stated[k] is None]
        lost = ", ".join("XYZ"[k] for k in left if math.isnan(self._reference[k]))
        if any(not math.isnan(self._reference[k]) for k in left):
            self.assumed["the reference point of G28 is machine zero"] = None
        if lost:
            self.assumed[
                f"it does not matter where G28 leads {lost}: machine zero is outside the travel, and the machine file has no "
                "reference_position_mm"
            ] = None

    def _preset(self, axes: list[float | None]) -> str:
        work, preset, shift = self._offset(), list(self.preset), list(self.shift)
        for k, value in enumerate(axes):
            if value is not None:
                if math.isnan(self.position[k]):
                    self._fail(f"G92 {'XYZ'[k]} at a position that is not known; position it in absolute first")
                preset[k] += self.position[k] - work[k] - value * self.scale + shift[k]
                shift[k] = 0.0  # G92 ends the shift of its axes
        self.preset, self.shift = (preset[0], preset[1], preset[2]), (shift[0], shift[1], shift[2])
        return "preset" if any(axis is not None for axis in axes) else "keep"

    def _set_pole(self, values: dict[str, float], here: bool) -> None:
        offset = self._offset()
        for k, letter in enumerate("IJK"):
            if letter in values:
                self.pole[k] = (self.position[k] if self._incremental(letter) else offset[k]) + values[
                    letter
                ] * self.scale
            elif here:
                self.pole[k] = self.position[k]

    def _lose_height(self, axes: list[float | None]) -> str:
        """M140: the tool goes back along its axis, to where the program does not say."""
        if any(axis is not None for axis in axes):
            self._fail("M140 and a move are in one block; divide the block")
        self._move(RAPID, [*self.position[:2], math.nan], corrected=(0, 0, 0))
        self.named[2] = False
        return "keep"

    def _helix(self, axes: list[float | None], values: dict[str, float]) -> str:
        """CP: about the pole by an angle (IPA), or to one (PA), and along the axis of the plane."""
        a, b = PLANE_AXES[self.plane]
        if any(axes[k] is not None for k in (a, b)):
            self._fail("CP with a coordinate in the plane of its pole; post the angle alone")
        u, v = self.pole[a] - self.position[a], self.pole[b] - self.position[b]
        if math.isnan(u + v) or math.hypot(u, v) == 0.0:
            self._fail("CP needs a pole (CC), and a position that is known and not in it")
        ccw, start = self.motion == CCW, math.atan2(-v, -u)
        if "IPA" in values:
            sweep = math.radians(values["IPA"])
            if sweep == 0.0 or (sweep > 0) != ccw:
                self._fail("CP: IPA and DR have to have one sign, and IPA is not 0")
        else:
            turn = (math.radians(values["PA"]) - start) * (1.0 if ccw else -1.0) % (2.0 * math.pi)
            turn = 2.0 * math.pi if turn < 1e-9 or 2.0 * math.pi - turn < 1e-9 else turn
            sweep = turn if ccw else -turn
        if abs(sweep) > 2.0 * math.pi * MOST_TURNS:
            self._fail(f"expected at most {MOST_TURNS} turns")
        end, radius = self._target(axes), math.hypot(u, v)
        end[a], end[b] = (
            self.pole[a] + radius * math.cos(start + sweep),
            self.pole[b] + radius * math.sin(start + sweep),
        )
        centre = [math.nan] * 3
        centre[a], centre[b] = self.pole[a], self.pole[b]
        self.named = [known or k in (a, b) for k, known in enumerate(self.named)]
        self._move(CCW if ccw else CW, end, arc=tuple(centre), sweep=sweep)
        return "arc"

    def _arc(self, end: list[float], values: dict[str, float]) -> None:
        start, (a, b) = self.position, PLANE_AXES[self.plane]
        ccw = self.motion == CCW
        radius = values.get("CR", values.get("R"))
        if any(math.isnan(value) for value in (*start, *end)):
            self._move(CCW, end)  # says what is missing
        dx, dy = end[a] - start[a], end[b] - start[b]
        if radius is not None:
            r, chord = radius * self.scale, math.hypot(dx, dy)
            square = r * r - 0.25 * chord * chord
            if chord == 0.0 or square < -RADIUS_TOLERANCE_MM * abs(r):
                self._fail(f"radius {abs(radius):g} and a chord of {chord / self.scale:g} give no arc")
            side = math.sqrt(max(square, 0.0)) / chord * (1.0 if (r > 0) == ccw else -1.0)
            u, v = 0.5 * (start[a] + end[a]) - side * dy, 0.5 * (start[b] + end[b]) + side * dx
        else:
            u, v = self._centre(values, a), self._centre(values, b)
        centre = [math.nan] * 3
        centre[a], centre[b] = u, v
        first, second = math.hypot(start[a] - u, start[b] - v), math.hypot(end[a] - u, end[b] - v)
        if abs(first - second) > RADIUS_TOLERANCE_MM or first == 0.0:
            self._fail(
                f"start and end of the arc are {first:.4f} and {second:.4f} mm from its centre; expected one radius"
            )
        turn = math.atan2(end[b] - v, end[a] - u) - math.atan2(start[b] - v, start[a] - u)
        turn = (turn if ccw else -turn) % (2.0 * math.pi)
        if (radius is None and math.hypot(dx, dy) < 1e-9) or turn == 0.0:
            turn = 2.0 * math.pi
        more = values.get("TURN", values.get("P", 1.0) - 1.0 if self.dialect.name == "linuxcnc" else 0.0)
        if not 0 <= more <= MOST_TURNS or more != int(more):
            self._fail(f"expected a whole number of turns, at most {MOST_TURNS}")
        turn += 2.0 * math.pi * more
        self._move(CCW if ccw else CW, end, arc=tuple(centre), sweep=turn if ccw else -turn)

    def _centre(self, values: dict[str, float], axis: int) -> float:
        letter = "IJK"[axis]
        if self.dialect.pole:
            if math.isnan(self.pole[axis]):
                self._fail(f"an arc without a centre: {letter} has not been given")
            return self.pole[axis]
        others = {"IJK"[k] for k in PLANE_AXES[self.plane]}
        if not others & values.keys():
            self._fail(f"an arc without centre or radius; expected {' and '.join(sorted(others))}, or a radius")
        if self.centre_absolute if letter not in self._modes else not self._incremental(letter):
            if letter not in values:
                self._fail(f"an arc with its centre in absolute needs {letter}")
            return self._offset()[axis] + values[letter] * self.scale
        return self.position[axis] + values.get(letter, 0.0) * self.scale

    def _cycle(self, motion: str, axes: list[float | None], values: dict[str, float]) -> str:
        """Expand a drilling cycle: over the hole, to the R level, to the depth at feed, back."""
        if not self.absolute:
            self._fail(
                "a drilling cycle in incremental with other codes in its block is not followed; divide the block"
            )
        offset, scale, deep = self._offset(), self.scale, self.plane
        if motion:
            if self.cycle is None:
                self.initial_z, self.initial_offset = self.position[deep], offset[deep]
                self.cycle_scale, self.cycle_plane, self._begins_series = scale, deep, True
            self.cycle = int(motion[6:])
        if scale != self.cycle_scale:
            self._fail("the unit changes within a drilling cycle; end the cycle by G80 before, and give Z and R again")
        if deep != self.cycle_plane:
            self._fail("the plane changes within a drilling cycle; end the cycle by G80 before")
        if deep != 2:
            self._assume_tool_axis(deep)
        repeats = self._repeats(values)
        self._give_height(0, axes[deep])
        self._give_height(1, values.get("R"))
        if "Q" in values:
            self.cycle_peck = values["Q"] * scale
        if repeats == 0.0 or not any(axis is not None for axis in axes):
            return "store"
        if math.isnan(self.cycle_z) or math.isnan(self.cycle_r):
            self._fail(f"a drilling cycle without {'XYZ'[deep]} or R")
        if self.cycle_r < self.cycle_z:
            self._fail("the R level of the drilling cycle is below its depth")
        self.named[deep] = True  # by Z and R of the cycle, which count from the offset that is now in force
        self._drill(self._target(axes), offset[deep], int(repeats))
        return "cycle"

    def _assume_tool_axis(self, deep: int) -> None:
        """Say what the control has to be set to, so that a cycle drills along Y or X."""
        if self.dialect.name == "fanuc":
            plane, axis = f"G{19 - deep}", "XY"[deep]
            self.assumed[
                f"a drilling cycle in {plane} drills along {axis} (parameter 5101 FXY = 1; with 0 it drills along Z)"
            ] = None
        if self.tool_on:
            self.assumed["the tool length is added along Z in all planes (FANUC: tool length offset A)"] = None

    def _drill(self, place: list[float], zero: float, repeats: int) -> None:
        """Move as the cycle does at one place; ``zero`` is the machine position of 0 of the program along the tool."""
        linuxcnc, initial, deep = self.dialect.name == "linuxcnc", self._initial_level(zero), self.plane
        bottom, level = zero + self.cycle_z, zero + self.cycle_r

        def at_height(sides: list[float], height: float) -> list[float]:
            return [height if k == deep else value for k, value in enumerate(sides)]

        def go(kind: int, z: float, *, there: bool = True) -> None:
            # place and depth are corrected at the bottom, the R level where it is, what is between by neither
            end, at_level = at_height(place if there else self.position, z), z == level
            if end != self.position:
                own = [there] * 3
                own[deep] = at_level or (kind == FEED and z == bottom)
                x_too, y_too, z_too = (int(o and known) for o, known in zip(own, self.named, strict=True))
                at = at_height(place, z if at_level else bottom)
                self._move(kind, end, at=at, corrected=(x_too, y_too, z_too))

        known_z = not math.isnan(self.position[deep])
        # from below the R level up at first; LinuxCNC asks where the series of holes began, not where the tool is
        if known_z and (initial if linuxcnc else self.position[deep]) < level:
            go(RAPID, level, there=False)
        clear = level if self.to_r_level else initial if math.isnan(initial) else max(initial, level)
        for _ in range(repeats):  # in the same place
            over = clear if linuxcnc and self.position[deep] <= level else max(self.position[deep], level)
            go(RAPID, over if known_z else math.nan)
            go(RAPID, level)
            pecking = self.cycle in (73, 83) and linuxcnc
            depth = level
            while pecking and depth - self.cycle_peck > bottom + PECK_REST_MM and self.cycle_peck > 0:
                depth -= self.cycle_peck
                go(FEED, depth)
                go(RAPID, level if self.cycle == 83 else depth + _PECK_CLEARANCE_MM)
                if self.cycle == 83:
                    go(RAPID, depth + _PECK_CLEARANCE_MM)
            go(FEED, bottom)
            back = FEED if self.cycle in (84, 85, 89) else RAPID
            if not linuxcnc or self.cycle == 85:  # the others of LinuxCNC go to the initial level at once
                go(back, level)
            go(back if linuxcnc and self.cycle == 89 else RAPID, clear)

    def _give_height(self, k: int, value: float | None) -> None:
        """Take over the depth (``k`` 0) or R (1) of a drilling cycle, if the block gives it."""
        if value is not None:
            self.cycle_given[k] = value
            if k == 0:
                self.cycle_z = value * self.scale
            else:
                self.cycle_r = value * self.scale

    def _initial_level(self, zero: float) -> float:
        """Machine position of Z to which G98 returns while the machine position of Z = 0 is ``zero``.

        LinuxCNC keeps the number that Z had in the program, and so goes elsewhere after a shift. Of FANUC no document says
        whether it keeps that or the place: the level is not known until the cycle ends.
        """
        moved = zero - self.initial_offset
        return self.initial_z + moved if self.dialect.name == "linuxcnc" or moved == 0.0 else math.nan

    def _end_cycle(self) -> None:
        """End a drilling cycle: its numbers have to be given again."""
        if self.cycle is not None:
            self.cycle, self.cycle_peck = None, 0.0
            self.cycle_z = self.cycle_r = math.nan
            self.cycle_given = [math.nan, math.nan]

    def _hole(self, axes: list[float | None], single: list[str], moving: bool) -> str:
        """Move to a hole, if its block does, and execute the cycle that is defined there: R level, depth, and back."""
        cycle = self.drilling
        if cycle is None:
            self._fail("calls a drilling cycle, and none is defined before")
        if problem := cycle.problem():
            self._fail(problem)
        own = cycle.lines[0] == self._text
        if own and self.calling:
            self._fail(f"{cycle.name} while MCALL calls a cycle at all positions; end it by MCALL alone before")
        if "drill here" in single and self._ends_calls:
            self.calling = False
        if self.scale != self._drilling_scale:
            self._fail(f"the unit has changed since {cycle.name} was defined; define it again")
        elsewhere = "machine coordinates" in single or (own and moving)
        if elsewhere or self.plane != 2 or (moving and self.motion not in (RAPID, FEED)):
            self._fail("a hole is drilled where G0 or G1 led, in the plane G17, not in machine coordinates; post moves")
        offset, scale = self._offset()[2], self.scale
        end = self._target(axes) if moving else list(self.position)
        self.named = [known or axis is not None for known, axis in zip(self.named, axes, strict=True)]
        level, depth, left = (offset + height * scale for height in cycle.heights((end[2] - offset) / scale))
        if math.isnan(level):
            self._fail(
                f"{cycle.name} begins where the tool is, and the position of Z is not known; post it in absolute"
            )
        x, y = end[:2]
        sides = [int(moving and known) for known in self.named[:2]]
        if moving:
            kind = RAPID if "rapid once" in single or self.motion is None else self.motion
            self._move(kind, end, at=[x, y, depth], corrected=(sides[0], sides[1], int(self.named[2])))
        for kind, height, at in (
            (RAPID, level, level),
            (FEED, depth, depth),
            (FEED if cycle.back_at_feed else RAPID, level, level),
            (RAPID, left, level),
        ):
            self._move(kind, [x, y, height], at=[x, y, at], corrected=(sides[0], sides[1], 1))
        return "hole"

    def _note_peaks(self, corners: Moves) -> None:
        """Say where an outer corner leads beyond the travel, if the control does not go about it on an arc."""
        places = peaks(corners)
        beyond = np.fmax(self.machine.lower_mm - places, places - self.machine.upper_mm).max(axis=1)
        row, k = np.unravel_index(np.argmax(beyond), beyond.shape)
        if beyond[row, k] > self.travel_slack_mm:
            self.assumed[
                f"line {self.in_file(int(corners.line[row]))}: a control that does not round the outer corner there goes "
                f"{beyond[row, k]:.3f} mm beyond the travel of {'XYZ'[k]}"
            ] = None

    def _check(self, moves: Moves) -> None:
        """Refuse positions outside the travel, at ends of moves and along arcs: usually the work offset is wrong."""
        path = centre_path(moves)
        if len(path.corners) and (self.dialect.name == "fanuc" or self._around_lines):
            self._note_peaks(path.corners)
        moves = Moves.joined([path.moves, path.corners]) if len(path.corners) else path.moves
        least, most = reach_of(moves)
        found = np.vstack([self.reached_mm, least, most])
        self.reached_mm = np.stack([np.fmin.reduce(found), np.fmax.reduce(found)])
        beyond = np.fmax(self.machine.lower_mm - least, most - self.machine.upper_mm)
        row, k = (int(place[0]) if len(place) else -1 for place in np.nonzero(beyond > self.travel_slack_mm))
        if row < 0:
            return
        low, high = self.machine.axes[k].range_mm
        place = least[row, k] if least[row, k] < low else most[row, k]
        self._line, self._text = int(moves.line[row]), ""
        way = "" if place == moves.end_mm[row, k] else " within the arc"
        where = f"{'XYZ'[k]} goes to {place:.3f} mm of the machine{way}, outside its travel {low:g} to {high:g} mm"
        self._fail(f"{where}; check --wcs and --tools")
