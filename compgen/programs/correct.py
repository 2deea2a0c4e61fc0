"""Correct an NC program for the errors of one machine: coordinates rewritten, read back, and judged on the exact model."""

from __future__ import annotations

import math
import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.files import REJECTED_PREFIX, OutputFolder, json_text, read_bytes, sha256_of_file, working_folder
from compgen.data.machine import MM_PER_UNIT, Machine
from compgen.data.names import AXES, MM_PER_UM, error_named
from compgen.data.toml_files import option
from compgen.errors import InputError
from compgen.programs.compensation import CentrePath, centre_path, unknown_radius
from compgen.programs.cycles import DrillingCycle
from compgen.programs.dialects import AT_THE_END, MARK, Dialect, dialect_named
from compgen.programs.follower import Follower, difference, read_twice
from compgen.programs.klartext import CALCULATED, arc_text, skips
from compgen.programs.path import (
    PLAIN,
    PLANE_AXES,
    RAPID,
    Corrector,
    ExactModel,
    IntArray,
    Moves,
    PathFigures,
    Pieces,
    directions_at,
    is_closed,
    kept_directions,
    lengths_of,
    path_deviations,
    reach_of,
)
from compgen.programs.reader import MM_PER_INCH, PECK_REST_MM, Batch, Reader, Setup, SingleBlock, number_of
from compgen.programs.runs import LONGEST_BLOCK, P_WORD, R_WORD, Run
from compgen.resources import LANGUAGES, program_version

if TYPE_CHECKING:
    from compgen.heat import Growth

#: G codes of drilling cycles.
_CYCLE_CODES = frozenset((73.0, 74.0, 76.0, *map(float, range(81, 90))))
#: A coordinate is rewritten if it changes by more than this part of its last decimal.
_HALF = 0.5 + 1e-6
#: Positions that differ by less are the same: sums of rounded numbers.
SAME_MM = 1e-6
#: How many blocks that lead beyond the travel are listed.
MOST_LISTED, MOST_IN_PREFLIGHT = 100, 20
#: A program that has grown by more than this many times, and by more than so many blocks, is said to have.
GROWTH, FEW_BLOCKS = 1, 200
#: Decimals of angles of Klartext, degrees.
_ANGLE_DIGITS = 4
#: Files beside a corrected program.
CORRECTION_FILE, PREFLIGHT_FILE = "correction.json", "preflight.md"
#: Characters of a comment in the first lines of a corrected program.
LONGEST_COMMENT = 90
_TENS = np.array([float(f"1e{k}") for k in range(16)])


@dataclass(frozen=True)
class CorrectOptions:
    """How a program is corrected."""

    dialect: str = option(
        "linuxcnc",
        "Dialect of the program.",
        choices=("fanuc", "siemens", "heidenhain-iso", "heidenhain-klartext", "linuxcnc", "grbl"),
    )
    tolerance_um: float = option(1.0, "Largest deviation of a corrected move from the correction within it, um.")
    shortest_mm: float = option(0.1, "Shortest move that the division of a move makes, mm.")
    decimals: int | None = option(
        None, "Decimals of rewritten coordinates (default: those of the dialect, 3 to 6).", within=(1, 9)
    )

    def check(self) -> None:
        """Raise InputError for numbers with which nothing can be corrected."""
        if not (self.tolerance_um > 0 and self.shortest_mm > 0):
            raise InputError("the tolerance and the shortest move have to be above 0")


@dataclass(frozen=True)
class BeyondTravel:
    """A block of a corrected program that leads beyond the travel: at its end, or within an arc."""

    line: int
    axis: str
    position_mm: float
    beyond_mm: float
    #: Whether the program leads beyond the travel there, too.
    by_program: bool
    block: str

    def __str__(self) -> str:
        return f"line {self.line}: {self.axis} {self.position_mm:.3f} mm of the machine"


@dataclass(frozen=True)
class ProgramCorrection:
    """What :func:`correct_program` found: figures before and after, counts, and what was assumed."""

    machine: str
    program: str
    dialect: str
    before: PathFigures
    after: PathFigures
    counts: Mapping[str, int]
    work_offsets_mm: Mapping[str, tuple[float, float, float]]
    tools_mm: Mapping[str, tuple[float, float, float]]
    assumed: tuple[str, ...]
    tolerance_um: float
    decimals: tuple[int, int]
    reasons: tuple[str, ...]
    file: str = ""
    errors: tuple[str, str] = ("", "")
    notes: tuple[str, ...] = ()
    #: Unit in which the control keeps its work offsets, and those that the program itself cannot check.
    machine_units: str = "mm"
    unchecked: tuple[str, ...] = ()
    #: How many blocks lead beyond the travel, and those that do by most.
    blocks_beyond: int = 0
    beyond: tuple[BeyondTravel, ...] = ()
    #: Radii of radius compensation by the D or tool that they are of, mm; inf: not known, and of no matter.
    radii_mm: Mapping[str, float] = field(default_factory=dict)
    #: What heat has moved, which is corrected, too.
    growth: Growth | None = None

    @property
    def accepted(self) -> bool:
        """Whether the corrected program leaves less error than the program as it was."""
        return not self.reasons

    def as_dict(self) -> dict[str, Any]:
        """Return the object of ``correction.json``."""
        return {
            "accepted": self.accepted,
            "reasons": list(self.reasons),
            "machine": self.machine,
            "program": self.program,
            "dialect": self.dialect,
            "errors": {"name": self.errors[0], "sha256": self.errors[1]},
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "path_mm": self.before.length_mm,
            **self.counts,
            "work_offsets_mm": {name: list(value) for name, value in self.work_offsets_mm.items()},
            "tools_mm": {name: list(value) for name, value in self.tools_mm.items()},
            "tool_radii_mm": {name: value if np.isfinite(value) else None for name, value in self.radii_mm.items()},
            "machine_units": self.machine_units,
            "offsets_not_checked": list(self.unchecked),
            "beyond_travel": {"blocks": self.blocks_beyond, "largest": [asdict(item) for item in self.beyond]},
            "assumed": list(self.assumed),
            "notes": list(self.notes),
            "tolerance_um": self.tolerance_um,
            **({} if self.growth is None else {"heat": self.growth.as_dict()}),
            "file": self.file,
        }


# Writing: the same blocks with other coordinates.


class _Piece(NamedTuple):
    """Piece ``number`` (from 0) ``of`` those into which a move is divided; ``share`` is the part of its time that it takes."""

    command_mm: FloatArray
    centre_mm: FloatArray
    sweep_rad: float
    share: float
    number: int
    of: int


@dataclass
class ProgramWriter:
    """Rewrites blocks with corrected coordinates and keeps what the control then has, in mm of the machine axes.

    ``target_mm`` is the command for the last end, ``written_mm`` where the rounded numbers lead; ``shift_mm`` is what the
    rounding of G92 adds to the offset. ``depth``, ``level`` and ``peck`` (given, written) are those of a drilling cycle.
    """

    dialect: Dialect
    decimals: tuple[int, int]
    target_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    written_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    wanted_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    shift_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    depth: float = np.nan
    level: float = np.nan
    #: By how much the initial level of a series of holes is higher than in the program, mm.
    lift_mm: float = np.nan
    pecking: bool = False
    peck: tuple[float, float] = (np.nan, np.nan)
    pole_mm: list[float] = field(default_factory=lambda: [np.nan] * 3)
    #: The drilling cycle as the program defines it, and as it was written last.
    cycle: tuple[DrillingCycle, DrillingCycle] | None = None
    changed: int = 0
    added: int = 0

    def digits(self, scale: float) -> int:
        """Return the decimals of numbers in mm (``scale`` 1) or inch."""
        return self.decimals[scale == MM_PER_INCH]

    def rewrite(self, batch: Batch, pieces: Pieces, share_before: FloatArray) -> tuple[str, IntArray]:
        """Return the blocks of the corrected program, and for each the number of the block that it comes from."""
        bounds = np.searchsorted(pieces.move, np.arange(len(batch.moves) + 1))
        last, start = bounds[1:] - 1, batch.words.start
        edits, added = _Edits(), np.zeros(len(start) - 1, dtype=np.int64)
        for segment in batch.segments:
            rows = slice(int(bounds[segment.first]), int(bounds[segment.first + segment.count]))
            if isinstance(segment, Run):
                if segment.count:
                    _RunPieces(self, batch, segment, pieces, rows, share_before).write(edits, added)
                elif len(segment.pole_at):
                    self.pole_mm = [np.nan] * 3
            else:
                texts = self._block(batch, segment, pieces, rows, last, share_before)
                if texts[0] != segment.text or len(texts) > 1:
                    line = segment.number - batch.first_line
                    edits.add(int(start[line]), int(start[line + 1]), "".join(texts))
                    added[line] = len(texts) - 1
            if segment.count:
                self.wanted_mm = batch.moves.end_mm[segment.first + segment.count - 1]
        text, origins = edits.applied(batch.text), np.repeat(batch.first_line + np.arange(len(added)), 1 + added)
        self._hold_length(batch, text, origins)
        return text, origins

    def _hold_length(self, batch: Batch, text: str, origins: IntArray) -> None:
        """Refuse a block that the correction has made longer than the control takes."""
        most = self.dialect.longest_block
        if most is None or max(map(len, text.split("\n"))) <= most:
            return
        own = batch.text.split("\n")
        for line, number in zip(text.split("\n"), origins.tolist(), strict=False):
            length = self.dialect.length_of(line)
            if length > max(most, self.dialect.length_of(own[number - batch.first_line])):
                raise InputError(
                    f"the block is {length} characters long when it is corrected, and the control takes {most}; shorten its "
                    "comment, or divide the block",
                    line=number,
                )

    def held(self, value: float, digits: int) -> int:
        """Return the decimals that a number can have, ``digits`` or fewer, so that the control reads all its digits."""
        whole = len(str(int(abs(value)))) if abs(value) >= 1.0 else 0
        return max(min(digits, self.dialect.most_digits - whole), 0)

    def line_end(self, text: str) -> str:
        """Return the end of line of a block, with the * of HEIDENHAIN."""
        body = text.rstrip()
        return (" *" if self.dialect.pole and body.endswith("*") else "") + (text[len(text.rstrip("\r\n")) :] or "\n")

    def _number(self, value: float, digits: int, like: str = "") -> str:
        """Write a number with ``digits`` decimals; without trailing zeros where ``like``, the number before, has fewer."""
        text = f"{value + 0.0:.{digits}f}"
        if text.startswith("-") and not text.strip("-0."):
            text = text[1:]
        if self.dialect.klartext and len(like.partition(".")[2]) not in range(digits, CALCULATED):
            text = text.rstrip("0").rstrip(".") if "." in text else text
            return text if text[0] == "-" else f"+{text}"
        if len(like.partition(".")[2]) < digits:
            text = text.rstrip("0")
        if (like.lstrip()[:1] == "+" or (self.dialect.pole and not like)) and text[0] != "-":
            text = "+" + text
        return text

    def _block(
        self,
        batch: Batch,
        block: SingleBlock,
        pieces: Pieces,
        rows: slice,
        last: IntArray,
        share_before: FloatArray,
    ) -> list[str]:
        """Rewrite one block; moves of a block are one that is divided, or those of a drilling cycle.

        ``rows`` are its pieces, ``last`` the last piece of each move of the batch.
        """
        if block.parts:
            texts: list[str] = []
            for hole in block.parts:
                low, high = np.searchsorted(pieces.move, [hole.first, hole.first + hole.count]).tolist()
                texts += self._block(batch, hole, pieces, slice(low, high), last, share_before)
            self.changed, self.added = self.changed + 1, self.added + len(texts) - 1
            return texts
        offset = batch.moves.offset_mm[block.first] + self.shift_mm if block.count else self.shift_mm
        if block.kind == "preset":
            return [self._preset(block)]
        if block.kind == "no preset":
            self.shift_mm = np.zeros(3)
        if block.begins_series:
            self.depth = self.level = np.nan
            k = block.plane
            self.lift_mm = float(self.written_mm[k] - self.wanted_mm[k] - self.shift_mm[k])
        if block.kind == "store":
            deep = AXES[block.plane]
            values = {letter: number_of(text) for letter, text, *_ in block.words if letter in (deep, "R")}
            self.depth, self.level = values.get(deep, self.depth), values.get("R", self.level)
            self._note_peck(block)
        if block.kind == "tap":
            return [self._tapped(block, batch, pieces, rows, offset)]
        if block.kind not in ("line", "arc", "cycle", "hole"):
            if any(word[0] in ("I", "J", "K") for word in block.words):
                self.pole_mm = [np.nan] * 3  # the pole is again that of the program
                if self.dialect.klartext:
                    return [self._rounded(block)]
            if block.count:
                # axes that a move in machine coordinates does not name stay where they were written to go
                letters = {word[0][0] for word in block.words if word[0] in (*AXES, *(f"{axis}1" for axis in AXES))}
                codes = {word[0] for word in block.words}
                # M140 leads along Z alone, DEP in X and Y
                letters |= {"Z"} if "M140" in codes else {"X", "Y"} if "DEP" in codes else set()
                there = np.array([not letters or axis in letters for axis in AXES])
                self.target_mm = np.where(there, pieces.command_mm[rows][-1], self.target_mm)
                self.written_mm = np.where(there, pieces.command_mm[rows][-1], self.written_mm)
            return [block.text]
        if block.kind == "cycle":
            return [self._cycle(block, batch.moves, pieces.command_mm, last, offset)]
        move = batch.moves.part(slice(block.first, block.first + block.count))
        if block.drilling:
            ends = last[block.first : block.first + block.count]
            return self._hole(block, block.drilling, move, pieces.command_mm[ends], offset)
        count = rows.stop - rows.start
        texts = []
        total = share_before[rows]
        times = self._shares_of_time(block, move, pieces, rows, total) if block.inverse_time and count > 1 else total
        for piece in range(count):
            command, centre = pieces.command_mm[rows.start + piece], pieces.centre_mm[rows.start + piece]
            share = float(total[piece])
            part = _Piece(command, centre, float(move.sweep_rad[0]) * share, float(times[piece]), piece, count)
            texts.append(self._piece(block, move, part, offset))
            self.target_mm = np.array(command)
        if block.kind == "arc" and self.dialect.klartext:
            texts = [line for text in texts for line in text.splitlines(keepends=True)]
            count = len(texts)
        elif count > 1:
            moved = " ".join(
                letter + text
                for letter, text, *_ in block.words
                if text and letter in "GM" and f"{letter}{float(text):g}" in AT_THE_END
            )
            if moved:
                end = self.line_end(block.text)
                texts[-1] = f"{texts[-1].removesuffix(end)} {moved}{end}"
        self.added += max(count - 1, 0)
        self.changed += texts[0] != block.text
        return texts

    def _tapped(self, block: SingleBlock, batch: Batch, pieces: Pieces, rows: slice, offset: FloatArray) -> str:
        """Rewrite G33.1: its end is corrected, and the tool comes back to where it was."""
        move = batch.moves.part(slice(block.first, block.first + 1))
        written, target = np.array(self.written_mm), np.array(self.target_mm)
        part = _Piece(pieces.command_mm[rows.start], pieces.centre_mm[rows.start], 0.0, 1.0, 0, 1)
        text = self._piece(block, move, part, offset)
        self.written_mm, self.target_mm = written, target
        self.changed += text != block.text
        return text

    def _piece(self, block: SingleBlock, move: Moves, part: _Piece, offset: FloatArray) -> str:
        """Text of one piece of a move: the block with other numbers, or a new one with what differs."""
        if block.kind == "arc" and self.dialect.klartext:
            return self._arc_sentence(block, move, part, offset)
        command, centre, sweep, share, piece, count = part
        scale, digits = block.scale, self.digits(block.scale)
        unit = 10.0**-digits
        words = {letter: (text, start, stop) for letter, text, start, stop in block.words} if piece == 0 else {}
        modes = block.modes if piece == 0 else {}
        changes: list[tuple[int, int, str]] = []
        more: list[str] = []
        start_mm = np.array(self.written_mm)
        closed = block.kind == "arc" and bool(is_closed(sweep))

        def put(letter: str, value: float, needed: bool, always: bool = False) -> float | None:
            """Replace or add a word if its value differs; returns the value that the control then reads."""
            if letter in words:
                text, first, last = words[letter]
                places = len(text.partition(".")[2].strip())
                calculated = self.dialect.klartext and places >= CALCULATED
                given = float(text.replace(" ", ""))
                own = self.held(value, digits if calculated else max(digits, places))
                if count == 1 and abs(value - given) <= _HALF * 10.0**-own and not calculated:
                    return given
                changes.append((first, last, self._number(value, own, text)))
                return round(value, own)
            if needed or always:
                equals = "=" if len(letter) > 1 else ""  # CR= of SINUMERIK
                own = self.held(value, digits)
                more.append(f"{letter}{equals}{self._number(value, own)}")
                return round(value, own)
            return None

        plane = int(move.plane[0])
        for k, letter in enumerate(AXES):
            before = (self.target_mm[k] - offset[k]) / scale
            value = (command[k] - offset[k]) / scale
            if np.isnan(value) or not move.corrected[0, k]:
                continue
            in_arc = block.kind == "arc" and k != plane
            if closed and in_arc and not np.isnan(start_mm[k]):
                value = (start_mm[k] - offset[k]) / scale
                before = value
            if modes.get(letter, block.absolute):
                differs = bool(np.rint(value / unit) != np.rint(before / unit))
                got = put(letter, value, differs, always=piece > 0 and in_arc)
                if got is not None:
                    self.written_mm[k] = got * scale + offset[k]
            else:
                step = 0.0 if closed and in_arc else (command[k] - start_mm[k]) / scale
                got = put(letter, step, abs(step) > _HALF * unit, always=piece > 0 and in_arc)
                if got is not None:
                    self.written_mm[k] = start_mm[k] + got * scale
        if block.kind == "arc":
            self._arc_words(block, plane, centre, sweep, offset, start_mm, put, modes, move.centre_mm[0])
            if count > 1:
                for letter in ("P", "TURN"):
                    if letter in words:
                        _, first, last = words[letter]
                        begin = block.text.upper().rfind(letter, 0, first)
                        changes.append((begin, last, ""))
        elif piece > 0 and not more:
            more = (
                [f"{AXES[0]}{self._number((self.written_mm[0] - offset[0]) / scale, digits)}"]
                if block.absolute
                else ["X0."]
            )
        if block.inverse_time and count > 1:
            text, first, last = next((t, a, b) for letter, t, a, b in block.words if letter == "F")
            faster = self._inverse_time(block, text, share)
            if piece == 0:
                changes.append((first, last, faster))
            else:
                more.append(f"F{faster}")
        if piece > 0:
            skip = re.match(r"\s*(/\d?)", block.text)
            head = (skip[1] or "") if skip else ""
            if self.dialect.klartext:
                head = f"{'/' if skips(block.text) else ''}L "
            return head + " ".join(more) + self.line_end(block.text)
        if count > 1:
            for letter, text, first, last in block.words:
                if text and letter in "GM" and f"{letter}{float(text):g}" in AT_THE_END:
                    begin = block.text.upper().rfind(letter, 0, first)
                    changes.append((begin, last, ""))
        end = max((stop for letter, text, _, stop in block.words if letter in AXES), default=0)
        end = end or max(stop for _, _, _, stop in block.words)
        text = _spliced(block.text, changes, end, more)
        return text if count == 1 or text.endswith("\n") else text + "\n"

    def _shares_of_time(
        self, block: SingleBlock, move: Moves, pieces: Pieces, rows: slice, shares: FloatArray
    ) -> FloatArray:
        """Parts of the time of a block under G93 that its pieces take: as long as they are, so that the feed is one."""
        if block.kind == "arc" and self.dialect.name == "fanuc":
            raise InputError(
                "an arc under G93 has to be divided, and F counts per radius on FANUC, per block on Haas; post it with G94, or "
                "give a larger --tolerance-um",
                line=block.number,
            )
        way = np.diff(np.vstack([self.target_mm, pieces.command_mm[rows]]), axis=0)
        if move.sweep_rad[0]:
            a, b = PLANE_AXES[int(move.plane[0])]
            radius = np.hypot(*(pieces.command_mm[rows, k] - pieces.centre_mm[rows, k] for k in (a, b)))
            way[:, a], way[:, b] = radius * move.sweep_rad[0] * shares, 0.0
        length = np.linalg.norm(way, axis=1)
        total = float(length.sum())
        return length / total if np.isfinite(total) and total > 0.0 and length.all() else shares

    def _inverse_time(self, block: SingleBlock, text: str, share: float) -> str:
        """F of a piece that takes ``share`` of the time of its block, in plain decimals that the control reads."""
        given = number_of(text)
        if self.dialect.point_needed and "." not in text:
            raise InputError(
                f"F{text} under G93 has no decimal point, and the block has to be divided: FANUC reads {given:g} or "
                f"{given / 1000:g}; post it with a decimal point",
                line=block.number,
            )
        exact = given / share
        digits, most = self.dialect.inverse_time or (9, np.inf)
        digits = self.held(exact, min(digits, max(5 - int(np.floor(np.log10(exact))), 0))) if exact > 0 else 0
        found = self._number(exact, digits)
        if not 0.0 < given <= exact <= most or abs(float(found) / exact - 1.0) > 0.005:
            raise InputError(
                f"F{text} under G93 becomes {exact:.6g} in a piece of the block, which the control does not take; post feed per "
                "minute (G94), or give a larger --tolerance-um or --shortest-mm",
                line=block.number,
            )
        return found if "." in found or not self.dialect.point_needed else f"{found}."

    def _rounded(self, block: SingleBlock) -> str:
        """Write numbers that were calculated with the decimals of the dialect."""
        digits = self.digits(block.scale)
        changes = [
            (first, last, self._number(float(text), digits, text))
            for _, text, first, last in block.words
            if len(text.partition(".")[2]) >= CALCULATED
        ]
        return _spliced(block.text, changes, 0, ()) if changes else block.text

    def _arc_sentence(self, block: SingleBlock, move: Moves, part: _Piece, offset: FloatArray) -> str:
        """Text of one piece of an arc of Klartext: CC where the pole is another one, then C, CR or CP."""
        command, centre, sweep, _, piece, count = part
        scale, digits, plane = block.scale, self.digits(block.scale), int(move.plane[0])
        a, b = PLANE_AXES[plane]
        kind = next(letter for letter, *_ in block.words if letter in ("C", "CR", "CP"))
        start = np.array(self.written_mm)
        closed = bool(is_closed(sweep)) and kind != "CP"
        # the other axis moves as well: only CP can do that
        kind = "CP" if abs(command[plane] - start[plane]) > _HALF * 10.0**-digits * scale else kind
        words: list[str] = []
        lines: list[str] = []
        least_mm = _HALF * 10.0**-digits * scale
        if count == 1 and self._arc_stays(block, move, command, centre, start, least_mm):
            self.written_mm = np.where(np.isnan(move.end_mm[0]), start, move.end_mm[0] + self.shift_mm)
            return block.text

        def word(letter: str, value: float) -> float:
            words.append(f"{letter}{self._number(value, digits)}")
            return round(value, digits)

        if kind != "CR":
            known = [move.centre_mm[0, k] if np.isnan(self.pole_mm[k]) else self.pole_mm[k] for k in (a, b)]
            if (
                max(abs(centre[k] - place) for k, place in zip((a, b), known, strict=True))
                > _HALF * 10.0**-digits * scale
            ):
                for k in sorted((a, b)):
                    self.pole_mm[k] = word(AXES[k], (centre[k] - offset[k]) / scale) * scale + offset[k]
                lines.append(f"CC {' '.join(words)}")
                words.clear()
            else:
                for k, place in zip((a, b), known, strict=True):
                    self.pole_mm[k] = place
        if kind == "CP":
            self._helix_end(words, command, start, sweep, (a, b))
        else:
            for k in sorted((a, b)):
                value = start[k] if closed and not np.isnan(start[k]) else command[k]
                self.written_mm[k] = word(AXES[k], (value - offset[k]) / scale) * scale + offset[k]
        if not np.isnan(command[plane]) and (
            move.corrected[0, plane] and abs(command[plane] - start[plane]) > _HALF * 10.0**-digits * scale
        ):
            self.written_mm[plane] = word(AXES[plane], (command[plane] - offset[plane]) / scale) * scale + offset[plane]
        if kind == "CR":
            chord = float(np.hypot(self.written_mm[a] - start[a], self.written_mm[b] - start[b]))
            if chord == 0.0:
                raise InputError(
                    "the arc is shorter than the last decimal; give more with --decimals", line=block.number
                )
            radius = max(float(np.hypot(centre[a] - start[a], centre[b] - start[b])), 0.5 * chord) / scale
            word("R", radius if abs(sweep) <= np.pi else -radius)
        sense = "DR+" if sweep > 0 else "DR-"
        return arc_text(block.text, lines, [kind, *words, sense], piece, count, AT_THE_END)

    def _arc_stays(
        self,
        block: SingleBlock,
        move: Moves,
        command: FloatArray,
        centre: FloatArray,
        start: FloatArray,
        least_mm: float,
    ) -> bool:
        """Whether the text of an arc of Klartext leads where it should as it is."""
        if any(len(text.partition(".")[2]) >= CALCULATED for _, text, *_ in block.words):
            return False
        axes = list(PLANE_AXES[int(move.plane[0])])
        same = [np.abs(command - move.end_mm[0]), np.abs(start - move.start_mm[0])]
        same += [np.abs(np.where(np.isnan(self.pole_mm), 0.0, np.array(self.pole_mm) - move.centre_mm[0]))[axes]]
        same += [np.abs(centre - move.centre_mm[0])[axes]]
        return all(bool((one[~np.isnan(one)] <= least_mm).all()) for one in same)

    def _helix_end(
        self, words: list[str], command: FloatArray, start: FloatArray, sweep: float, axes: tuple[int, int]
    ) -> None:
        """Write the angle of CP, and keep where it leads: about the pole as written, as far as the tool is from it."""
        a, b = axes
        pole = np.array([self.pole_mm[a], self.pole_mm[b]])
        here, there = start[[a, b]] - pole, command[[a, b]] - pole
        exact = float(np.arctan2(there[1], there[0]) - np.arctan2(here[1], here[0]))
        exact += 2.0 * np.pi * np.rint((sweep - exact) / (2.0 * np.pi))
        degrees = round(float(np.degrees(exact)), _ANGLE_DIGITS)
        words.append(f"IPA{self._number(degrees, _ANGLE_DIGITS)}")
        turned = np.radians(degrees) + float(np.arctan2(here[1], here[0]))
        self.written_mm[[a, b]] = pole + np.hypot(*here) * np.array([np.cos(turned), np.sin(turned)])

    def _arc_words(
        self,
        block: SingleBlock,
        plane: int,
        centre: FloatArray,
        sweep: float,
        offset: FloatArray,
        start_mm: FloatArray,
        put: Callable[..., float | None],
        modes: Mapping[str, bool],
        wanted: FloatArray,
    ) -> None:
        a, b = PLANE_AXES[plane]
        end = self.written_mm
        chord = float(np.hypot(end[a] - start_mm[a], end[b] - start_mm[b]))
        if chord == 0.0 and not is_closed(sweep):
            raise InputError("the arc is shorter than the last decimal; give more with --decimals", line=block.number)
        radius_word = next((letter for letter in ("CR", "R") if any(w[0] == letter for w in block.words)), None)
        if radius_word:
            given = next(float(w[1].replace(" ", "")) for w in block.words if w[0] == radius_word)
            radius = max(float(np.hypot(centre[a] - start_mm[a], centre[b] - start_mm[b])), 0.5 * chord) / block.scale
            put(radius_word, radius if abs(sweep) <= np.pi or given > 0 else -radius, True)
            return
        for k in (a, b):
            letter = "IJK"[k]
            base = offset[k] if modes.get(letter, block.centre_absolute) else start_mm[k]
            value = (centre[k] - base) / block.scale
            differs = value
            if self.dialect.pole:
                known = wanted[k] if np.isnan(self.pole_mm[k]) else self.pole_mm[k]
                differs = (centre[k] - known) / block.scale
            got = put(letter, value, abs(differs) > _HALF * 10.0 ** -self.digits(block.scale))
            if self.dialect.pole and got is not None:
                self.pole_mm[k] = got * block.scale + base

    def _cycle(
        self, block: SingleBlock, moves: Moves, command_mm: FloatArray, last: IntArray, offset_mm: FloatArray
    ) -> str:
        """Rewrite a drilling block: place, depth, R level and pecks of the hole; ``last`` is the last piece of each move."""
        scale, digits, offset = block.scale, self.digits(block.scale), offset_mm.tolist()
        deep = int(moves.plane[block.first])
        sides = [k for k in range(3) if k != deep]
        rows = slice(block.first, block.first + block.count)
        kinds, may = moves.kind[rows].tolist(), moves.corrected[rows].tolist()
        begin_z, end_z = moves.start_mm[rows, deep].tolist(), moves.end_mm[rows, deep].tolist()
        strokes = [k for k, kind in enumerate(kinds) if kind != RAPID]
        depth = next((k for k in strokes if may[k][deep]), None)
        if depth is None:
            return block.text
        r_level, allowed = begin_z[strokes[0]], may[depth]
        reach_mm = r_level - end_z[depth]  # as programmed: a hole of five pecks stays one of five
        # the stroke to the depth may be several pieces; the hole is where the last ends
        target = command_mm[last[block.first + depth]].tolist()
        at_level = [k for k, z in enumerate(end_z) if z == r_level and may[k][deep]]
        level_z = float(command_mm[last[block.first + at_level[-1]], deep]) if at_level else math.nan
        words = {letter: (text, start, stop) for letter, text, start, stop in block.words}
        changes: list[tuple[int, int, str]] = []
        more: list[str] = []
        before = [*((self.target_mm - offset_mm) / scale).tolist(), self.level]
        before[deep] = self.depth
        wanted = [*((there - zero) / scale for there, zero in zip(target, offset, strict=True))]
        wanted.append((level_z - offset[deep]) / scale)
        found = list(before)
        for k, letter in enumerate("XYZR"):
            value, free = wanted[k], allowed[deep if k == 3 else k]
            if math.isnan(value):
                continue
            if letter in words:
                text, first, stop = words[letter]
                given = float(text.replace(" ", ""))
                own = self.held(value, max(digits, len(text.partition(".")[2].strip())))
                if abs(value - given) > _HALF * 10.0**-own and free:
                    changes.append((first, stop, self._number(value, own, text)))
                    found[k] = round(value, own)
                else:
                    found[k] = given
            elif free and math.isfinite(before[k]) and round(value * 10**digits) != round(before[k] * 10**digits):
                own = self.held(value, digits)
                more.append(f"{letter}{self._number(value, own)}")
                found[k] = round(value, own)
        self.depth, self.level = found[deep], found[3]
        self._note_peck(block)
        given, written = self.peck
        if self.pecking and given > 0.0 and np.isfinite(found[3] - found[deep]):
            peck, stroke, unit = given, found[3] - found[deep], 10.0**-digits
            strokes, now = (np.ceil((length - PECK_REST_MM / scale) / given) for length in (reach_mm / scale, stroke))
            if now > strokes:
                peck = (np.floor(stroke / strokes / unit + 1e-6) + 1.0) * unit
            elif now < strokes:
                peck = (np.ceil(stroke / (strokes - 1.0) / unit - 1e-6) - 1.0) * unit
            if abs(peck - written) > _HALF * unit:
                if "Q" in words:
                    text, first, stop = words["Q"]
                    changes.append((first, stop, self._number(peck, digits, text)))
                else:
                    more.append(f"Q{self._number(peck, digits)}")
                self.peck = given, peck
        for k in sides:
            if AXES[k] in words or any(word[0] == AXES[k] for word in more):
                self.written_mm[k] = found[k] * scale + offset[k]
        self.target_mm[sides] = np.array(target)[sides]
        if end_z[-1] == r_level:
            self.target_mm[deep] = level_z
            self.written_mm[deep] = found[3] * scale + offset[deep]
        else:  # at the initial level, whose number is that of the position written before the series
            self.target_mm[deep] = self.written_mm[deep] = end_z[-1] + self.lift_mm + self.shift_mm[deep]
        self.changed += bool(changes or more)
        end = max((stop for letter, (_, _, stop) in words.items() if letter in AXES), default=0)
        return _spliced(block.text, changes, end or max(w[3] for w in block.words), more)

    def _hole(
        self, block: SingleBlock, cycle: DrillingCycle, move: Moves, command: FloatArray, offset: FloatArray
    ) -> list[str]:
        """Rewrite the place of a hole; its cycle is defined again before it where the heights are other ones.

        ``command`` are those of the ends of its moves: to the place, to the R level, to the depth, and back.
        """
        scale, digits = block.scale, self.digits(block.scale)
        level, depth = command[-4], command[-3]
        text = block.text
        if len(move) == 5:
            named = any(word[0] == "Z" for word in block.words)
            place = np.array([*depth[:2], command[0, 2] if named else self.target_mm[2]])
            text = self._piece(block, move, _Piece(place, np.full(3, np.nan), 0.0, 1.0, 0, 1), offset)
            self.target_mm = place
        if self.cycle is None or self.cycle[0] is not cycle:
            self.cycle = (cycle, cycle)

        original, last = self.cycle

        def text_of(name: str, value: float) -> str:
            like, before = original.numbers[name][3], last.numbers[name][3]
            own = max(digits, len(like.partition(".")[2].strip()))
            if abs(value - float(before.replace(" ", "") or 0.0)) <= _HALF * 10.0**-own:
                return before
            text = self._number(value, own, like)
            return text if "." in like else text.rstrip(".")

        z = (np.array([level[2], depth[2], self.written_mm[2]]) - offset[2]) / scale
        now = last.with_heights(float(z[0]), float(z[1]), float(z[2]), text_of)
        lines = now.written() if now != last else []
        self.cycle = (cycle, now)
        if "P02" not in now:
            self.target_mm[2] = self.written_mm[2] = now.heights(0.0)[2] * scale + offset[2]
        if lines and cycle.lines[0] == block.text:
            self.changed += 1
            return lines
        codes = {f"{letter}{float(value):g}" for letter, value, *_ in block.words if value and letter in "GM"}
        codes |= {letter for letter, value, *_ in block.words if not value}
        if lines and self.dialect.pole and not codes & {"M89", "M99", "G79", "CYCL CALL"}:
            body = text.partition(";")[0].rstrip("* \t\r\n")
            text = f"{body} M89{text[len(body) :]}"  # a definition ends the calls by all positions
        self.changed += text != block.text
        self.added += len(lines)
        numbered = r"^(\s*)\d+\s+" if self.dialect.klartext else r"^(\s*)N\d+\s*"
        return [*(re.sub(numbered, r"\1", line, flags=re.IGNORECASE) for line in lines), text]

    def _note_peck(self, block: SingleBlock) -> None:
        """Remember whether the cycle pecks, and its Q."""
        for letter, text, *_ in block.words:
            if letter == "G" and float(text) in _CYCLE_CODES:
                self.pecking = float(text) in (73.0, 83.0)
            elif letter == "Q":
                self.peck = float(text), float(text)

    def _preset(self, block: SingleBlock) -> str:
        """Rewrite G92: the control sets it at its corrected position, the offset has to become that of the program."""
        changes = []
        for letter, text, first, last in block.words:
            if letter in AXES:
                k = AXES.index(letter)
                given = float(text.replace(" ", ""))
                exact = given + (self.written_mm[k] - self.shift_mm[k] - self.wanted_mm[k]) / block.scale
                own = max(self.digits(block.scale), len(text.partition(".")[2].strip()))
                got = given if abs(exact - given) <= _HALF * 10.0**-own else round(exact, own)
                self.shift_mm[k] = self.written_mm[k] - self.wanted_mm[k] - (got - given) * block.scale
                if got != given:
                    changes.append((first, last, self._number(got, own, text)))
        self.changed += bool(changes)
        return _spliced(block.text, changes, 0, ())


class _RunPieces:
    """The pieces of blocks that were read together, rewritten as :meth:`ProgramWriter._piece` does it for each.

    Numbers are found for all pieces (rows) and the words X Y Z I J K and the radius (columns): those of a block that has the
    word replace it, others are added where they are needed, in the block or in a new one. ``reached_mm`` is where the numbers
    lead, before the first piece and after each.
    """

    def __init__(
        self, writer: ProgramWriter, batch: Batch, run: Run, pieces: Pieces, rows: slice, share_before: FloatArray
    ) -> None:
        self.writer, self.batch, self.run, self.words = writer, batch, run, batch.words
        self.moves = batch.moves.part(slice(run.first, run.first + run.count))
        self.command_mm, self.centre_mm = pieces.command_mm[rows], pieces.centre_mm[rows]
        self.move = pieces.move[rows] - run.first
        self.line, self.absolute = run.row[self.move], run.absolute[self.move]
        self.begins = np.diff(self.move, prepend=-1) > 0
        self.whole = self.begins & np.append(self.begins[1:], True)
        self.digits, self.offset_mm = writer.digits(run.scale), self.moves.offset_mm[0] + writer.shift_mm
        self.given = np.where(self.begins[:, None], self.words.value[self.line, : R_WORD + 1], np.nan)
        self.named = ~np.isnan(self.given)
        self.decimals = self.words.decimals[self.line, : R_WORD + 1]
        self.own = np.where(self.named, np.maximum(self.decimals, self.digits), self.digits)
        self.value = np.full(self.given.shape, np.nan)
        self.same, self.added = np.zeros((2, *self.given.shape), dtype=bool)
        self.sweep = self.moves.sweep_rad[self.move] * share_before[rows]
        self.arc = self.sweep != 0
        self.closed = self.arc & is_closed(self.sweep)
        self.in_plane = self.arc[:, None] & (np.arange(3) != self.moves.plane[self.move][:, None])
        self.reached_mm = np.zeros((0, 3))

    def write(self, edits: _Edits, added: IntArray) -> None:
        """Find the numbers, edit the text, and tell the writer where the control then is; counts new blocks in ``added``."""
        self._ends()
        if self.arc.any():
            self._arcs()
        writer = self.writer
        writer.target_mm, writer.written_mm = np.array(self.command_mm[-1]), np.array(self.reached_mm[-1])
        added += np.bincount(self.line[~self.begins], minlength=len(added))
        writer.added += int(np.sum(~self.begins))
        self._edit(edits)

    def _settle(self, columns: slice, exact: FloatArray, needed: NDArray[np.bool_]) -> None:
        """Round numbers; those of words that change by less than half their last decimal stay, others are added if ``needed``."""
        own = self.own[:, columns] = self._held(exact, self.own[:, columns])
        given, named = self.given[:, columns], self.named[:, columns]
        same = named & self.whole[:, None] & (np.abs(exact - given) <= _HALF / _TENS[own])
        added = ~named & needed & ~np.isnan(exact)
        rounded = np.where(named | added, np.rint(exact * _TENS[own]) / _TENS[own], np.nan)
        self.value[:, columns], self.same[:, columns], self.added[:, columns] = (
            np.where(same, given, rounded),
            same,
            added,
        )

    def _held(self, exact: FloatArray, own: NDArray[Any]) -> NDArray[Any]:
        """:meth:`ProgramWriter.held` of many numbers."""
        most, largest = self.writer.dialect.most_digits, float(np.fmax.reduce(np.abs(exact), axis=None, initial=0.0))
        if int(own.max(initial=0)) + len(str(int(largest))) <= most:
            return own
        size = np.nan_to_num(np.abs(exact))
        whole = np.where(size >= 1.0, np.floor(np.log10(np.maximum(size, 1.0))) + 1.0, 0.0)
        return np.asarray(np.maximum(np.minimum(own, most - whole), 0)).astype(own.dtype)

    def _ends(self) -> None:
        scale, offset, later = self.run.scale, self.offset_mm, ~self.begins[:, None]
        value = (self.command_mm - offset) / scale
        grid = np.rint(np.vstack([(self.writer.target_mm - offset) / scale, value]) * _TENS[self.digits])
        self._settle(np.s_[:3], value, (grid[1:] != grid[:-1]) | (self.in_plane & later))
        self.reached_mm = np.vstack([self.writer.written_mm, self.value[:, :3] * scale + offset])
        # ends of increments and of full circles depend on where the numbers before led
        chained = ~self.absolute[:, None] | (self.closed[:, None] & self.in_plane)
        every = np.arange(len(self.reached_mm))
        for k in range(3):
            known = ~np.isnan(self.reached_mm[:, k])
            known[1:] |= chained[:, k]
            last = np.maximum.accumulate(np.where(known, every, 0))
            if chained[:, k].any():
                self._follow(k, np.flatnonzero(chained[:, k]), last)
            self.reached_mm[:, k] = self.reached_mm[last, k]
        # a piece that is nowhere else still is a block
        alone = ~self.begins & ~self.arc & ~self.added.any(axis=1)
        self.added[alone, 0] = True
        self.value[alone, 0] = np.where(self.absolute, (self.reached_mm[:-1, 0] - offset[0]) / scale, 0.0)[alone]

    def _follow(self, k: int, rows: IntArray, last: IntArray) -> None:
        """Ends of the pieces ``rows`` along one axis: an increment leads on from where the written numbers led.

        ``last`` is the piece whose number says where the axis is before each.
        """
        zero, scale, least, tens = float(self.offset_mm[k]), self.run.scale, _HALF / _TENS[self.digits], _TENS.tolist()
        held, always = self.closed & self.in_plane[:, k], self.in_plane[:, k] & ~self.begins
        columns = (self.absolute, held, always, self.whole, self.named[:, k], self.given[:, k], self.own[:, k])
        found: list[tuple[float, bool, bool]] = []
        place, before = 0.0, -2
        for p, absolute, stays, needed, whole, named, given, own, command in zip(
            *(column[rows].tolist() for column in (np.arange(len(held)), *columns, self.command_mm[:, k])), strict=True
        ):
            if p != before + 1:
                place = float(self.reached_mm[last[p], k])
            way = place - zero if absolute else 0.0
            exact = (way if stays else command - place) / scale
            same = named and whole and abs(exact - given) <= _HALF / tens[own]
            added = not named and (needed or (not absolute and abs(exact) > least))
            got = given if same else round(exact * tens[own]) / tens[own] if named or added else np.nan
            if got == got:
                place = got * scale + (zero if absolute else place)
            found.append((got, same, added))
            self.reached_mm[p + 1, k], before = place, p
        self.value[rows, k], self.same[rows, k], self.added[rows, k] = zip(*found, strict=True)

    def _arcs(self) -> None:
        """Numbers of centres and radii, as seen from where the written numbers lead."""
        scale, pole, rows = self.run.scale, self.writer.dialect.pole, np.arange(len(self.move))
        (a, b), centre = np.array(PLANE_AXES)[self.moves.plane[self.move]].T, self.centre_mm
        start, end = self.reached_mm[:-1], self.reached_mm[1:]
        chord = np.hypot(end[rows, a] - start[rows, a], end[rows, b] - start[rows, b])
        lost = np.flatnonzero(self.arc & (chord == 0.0) & ~self.closed)
        if len(lost):
            line = self.batch.first_line + int(self.line[lost[0]])
            raise InputError("the arc is shorter than the last decimal; give more with --decimals", line=line)
        size = np.hypot(centre[rows, a] - start[rows, a], centre[rows, b] - start[rows, b])
        programmed = self.words.value[self.line, R_WORD]
        by_radius = self.arc & ~np.isnan(programmed)
        sign = np.where((np.abs(self.sweep) <= np.pi) | (programmed > 0), 1.0, -1.0)
        radius = np.where(by_radius, sign * np.maximum(size, 0.5 * chord) / scale, np.nan)
        self._settle(np.s_[R_WORD : R_WORD + 1], radius[:, None], by_radius[:, None])
        from_zero = self.run.centre_absolute | (self.absolute & pole)
        base = np.where(from_zero[:, None], self.offset_mm, start)
        exact = np.where(self.in_plane & ~by_radius[:, None], (centre - base) / scale, np.nan)
        least = _HALF / _TENS[self.digits]
        self._settle(np.s_[3:6], exact, np.ones_like(self.in_plane) if pole else np.abs(exact) > least)
        if not pole:
            return
        known, lost_at = self.writer.pole_mm, self.run.pole_at.tolist()
        for p in np.flatnonzero(self.arc).tolist():
            move = int(self.move[p])
            while lost_at and lost_at[0] <= move:
                known = [np.nan] * 3  # the pole is again that of the program
                lost_at.pop(0)
            for k in (int(a[p]), int(b[p])):
                before = self.moves.centre_mm[move, k] if np.isnan(known[k]) else known[k]
                self.added[p, 3 + k] &= bool(abs(centre[p, k] - before) / scale > least)
                if self.named[p, 3 + k] or self.added[p, 3 + k]:
                    known[k] = float(self.value[p, 3 + k] * scale + base[p, k])
        self.writer.pole_mm = [np.nan] * 3 if lost_at else known

    def _edit(self, edits: _Edits) -> None:
        """Put the numbers into the text: words replaced, words added after the axis words, and new blocks."""
        words, text, line = self.words, self.batch.text, self.line
        row, column = np.nonzero(self.named & ~self.same & ~np.isnan(self.value))
        more, letter = np.nonzero(self.added)
        # the first axis of a plane goes first: K before I in G18
        order = np.where((letter == 5) & (self.moves.plane[self.move[more]] == 1), 2.5, letter)
        sorted_ = np.lexsort((order, more))
        more, letter, order = more[sorted_], letter[sorted_], order[sorted_]
        begin, end = words.begin[line[row], column], words.end[line[row], column]
        numbers = _numbers(
            np.concatenate([self.value[row, column], self.value[more, letter]]),
            np.concatenate([self.own[row, column], self.own[more, letter]]),
            np.append(self.decimals[row, column] < self.own[row, column], np.full(len(more), True)),
            np.append(words.code[begin] == ord("+"), np.full(len(more), self.writer.dialect.pole)),
        )
        axes = words.end[line, :3].max(axis=1)
        place = np.where(self.begins, np.where(axes > 0, axes, words.last[line]), words.start[line + 1])[more]
        texts = self._added_words(more, letter, place, numbers[len(row) :])
        # the pieces of a divided arc have no number of turns
        turns = np.flatnonzero(self.arc & self.begins & ~self.whole & ~np.isnan(words.value[line, P_WORD]))
        begin = np.concatenate([begin, place, words.begin[line[turns], P_WORD] - 1])
        end = np.concatenate([end, place, words.end[line[turns], P_WORD]])
        every = [*numbers[: len(row)], *texts, *[""] * len(turns)]
        owner = np.concatenate([row, more, turns])
        chosen = np.lexsort((np.concatenate([column, 10 + order, np.full(len(turns), 20)]), owner, begin))
        edits.starts += begin[chosen].tolist()
        edits.stops += end[chosen].tolist()
        edits.texts += [every[k] for k in chosen.tolist()]
        touched = np.zeros(len(line), dtype=bool)
        touched[row[self.whole[row]]] = touched[more] = touched[turns] = True
        for k in np.flatnonzero(~self.whole[row]).tolist():  # a divided block may end with the same numbers
            touched[row[k]] |= text[begin[k] : end[k]] != numbers[k]
        self.writer.changed += int(np.sum(touched & self.begins))

    def _added_words(self, more: IntArray, letter: IntArray, place: IntArray, numbers: list[str]) -> list[str]:
        """Texts of words that pieces ``more`` get: with a blank before where their block has blanks, or a block of their own."""
        names = [*"XYZIJK", "CR=" if self.writer.dialect.name == "siemens" else "R"]
        text, start, code = self.batch.text, self.words.start[self.line[more]], self.words.code
        between = self.words.blanks[place - 1] > self.words.blanks[start]
        for k in np.flatnonzero(code[start] <= ord(" ")).tolist():
            between[k] = " " in text[start[k] : place[k]].strip()
        texts = [
            (" " if blank else "") + names[k] + number
            for blank, k, number in zip(between.tolist(), letter.tolist(), numbers, strict=True)
        ]
        for k in np.flatnonzero(~self.begins[more]).tolist():
            p, block = more[k], text[start[k] : place[k]]
            first, last = k == 0 or more[k - 1] != p, k + 1 == len(more) or more[k + 1] != p
            before = "\n" if first and self.begins[p - 1] and not block.endswith("\n") else "" if first else " "
            texts[k] = before + names[letter[k]] + numbers[k] + (self.writer.line_end(block) if last else "")
        return texts


@dataclass
class _Edits:
    """Replacements in a text, in order: from ``starts`` to ``stops`` by ``texts``."""

    starts: list[int] = field(default_factory=list)
    stops: list[int] = field(default_factory=list)
    texts: list[str] = field(default_factory=list)

    def add(self, start: int, stop: int, text: str) -> None:
        """Append one."""
        self.starts.append(start)
        self.stops.append(stop)
        self.texts.append(text)

    def applied(self, text: str) -> str:
        """Return the edited text."""
        parts = [""] * (2 * len(self.texts) + 1)
        parts[::2] = [text[at:start] for at, start in zip([0, *self.stops], [*self.starts, len(text)], strict=True)]
        parts[1::2] = self.texts
        return "".join(parts)


def _numbers(value: FloatArray, digits: IntArray, stripped: NDArray[np.bool_], signed: NDArray[np.bool_]) -> list[str]:
    """Write many numbers as :meth:`ProgramWriter._number` does: ``stripped`` without trailing zeros, ``signed`` with a plus."""
    digits = np.where(stripped, digits - _trailing_zeros(value, digits), digits)
    forms = [f"%.{k}f" if k else "%.0f." for k in range(len(_TENS))]
    # adding 0 makes -0 a 0
    texts = ("\n".join([forms[k] for k in digits.tolist()]) % tuple((value + 0.0).tolist())).split("\n")
    for k in np.flatnonzero(~stripped & (digits == 0)).tolist():
        texts[k] = texts[k].rstrip(".")
    for k in np.flatnonzero(signed).tolist():
        if texts[k][0] != "-":
            texts[k] = "+" + texts[k]
    return texts if len(value) else []


def _trailing_zeros(value: FloatArray, digits: IntArray) -> IntArray:
    """How many of the decimals of rounded values are zeros at the end."""
    found, scaled = np.zeros(len(value), dtype=np.int64), np.rint(np.abs(value) * _TENS[digits])
    rows = np.flatnonzero(digits > 0)
    while len(rows):
        rows = rows[scaled[rows] % 10.0 == 0.0]
        scaled[rows] /= 10.0
        found[rows] += 1
        rows = rows[found[rows] < digits[rows]]
    return found


def _joined(words: Sequence[str], before: str) -> str:
    """Return words that follow ``before`` in a block, without blanks where the block has none."""
    blank = " " if " " in before.strip() else ""
    return "".join(blank + word for word in words)


def _spliced(text: str, changes: list[tuple[int, int, str]], end: int, more: Sequence[str]) -> str:
    """Replace columns of a block and put the words ``more`` after column ``end``."""
    if closing := re.match(r"\s*\)", text[end:]):  # of X=AC(10.5)
        end += closing.end()
    for start, stop, new in sorted([*changes, (end, end, _joined(more, text[:end]))], reverse=True):
        text = text[:start] + new + text[stop:]
    return text


# Reading back: the tool on the exact machine against the path that the program wanted.


#: Receives, batch by batch, the moves of a program, and of the corrected one those at feed: their wanted moves, the moves as
#: read back, and the shares of the wanted ones between which they are.
Follow = Callable[[Moves, IntArray, Moves, FloatArray, FloatArray], None]


@dataclass
class _Travel:
    """Collects the blocks of a corrected program that lead beyond the travel, those that do by most first."""

    machine: Machine
    count: int = 0
    found: list[BeyondTravel] = field(default_factory=list)

    def add(self, wanted: Moves, read: Moves, origin: IntArray, text: bytes, first: int) -> None:
        """Look at moves as they were read back from a text that begins in line ``first``; ``origin`` is that of the program."""
        beyond, place = self._beyond(read)
        leads = (np.abs(read.end_mm - read.start_mm) > SAME_MM) | (place != read.end_mm)  # along the axis, or by an arc
        rows, axes = np.nonzero((beyond > SAME_MM) & (leads | np.isnan(read.start_mm)))
        if not len(rows):
            return
        self.count += len(np.unique(origin[rows]))
        before = self._beyond(wanted)[0] > SAME_MM
        own = {(int(wanted.line[row]), int(k)) for row, k in zip(*np.nonzero(before), strict=True)}
        blocks, taken = text.decode("latin-1").split("\n"), set[tuple[int, int]]()
        for j in np.argsort(-beyond[rows, axes], kind="stable").tolist():
            row, k = int(rows[j]), int(axes[j])
            if len(taken) >= MOST_LISTED or (at := (int(origin[row]), k)) in taken:
                continue
            taken.add(at)
            far = float(beyond[row, k]), float(place[row, k])
            block = blocks[int(read.line[row]) - first].strip()
            self.found.append(BeyondTravel(at[0], AXES[k], far[1], far[0], at in own, block))
        self.found = sorted(self.found, key=lambda item: -item.beyond_mm)[:MOST_LISTED]

    def _beyond(self, moves: Moves) -> tuple[FloatArray, FloatArray]:
        """How far each move leads beyond the travel of each axis, and where to, (n, 3), mm; nan for what is not corrected."""
        least, most = reach_of(moves)
        low, high = self.machine.lower_mm - least, most - self.machine.upper_mm
        return np.fmax(low, high), np.where(low > high, least, most)

    def said(self) -> tuple[str, str]:
        """Why the corrected program is refused, and what else to know; nothing for either if there is nothing to say."""
        if not self.found:
            return "", ""
        margin_mm, worst = self.machine.travel_margin_mm, self.found[0]
        listed = ", ".join(map(str, self.found[:3])) + (", ..." if self.count > 3 else "")
        what = "1 block leads" if self.count == 1 else f"{self.count} blocks lead"
        text = f"{what} beyond the travel, by up to {worst.beyond_mm:.3f} mm ({listed})"
        if worst.beyond_mm <= margin_mm + SAME_MM:
            return "", f"{text}, within travel_margin_mm = {margin_mm:g} of the machine file"
        return (
            f"{text}: clamp the workpiece farther inside, leave an axis as it is (--only), or state travel_margin_mm in the "
            f"machine file (now {margin_mm:g}) if the software limits of the control are farther out",
            "",
        )


@dataclass
class _ReadBack:
    """Adds up the deviations of the program and of the corrected one, batch by batch.

    The corrected text is read twice: by ``follower``, whose moves are judged, and by ``reader``, which has to agree.
    ``least_mm`` is what rounding and tolerance may change.
    """

    model: ExactModel
    reader: Reader
    follower: Follower
    step_mm: float
    tolerance_mm: float
    least_mm: float
    before: PathFigures = field(default_factory=PathFigures)
    after: PathFigures = field(default_factory=PathFigures)
    travel: _Travel = field(init=False)
    lines: int = 0
    #: Moves at feed of the corrected program.
    cuts: int = 0
    direction: FloatArray = field(default_factory=lambda: np.zeros(3))
    largest_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    broken: str = ""
    follow: Follow | None = None
    #: For each axis that moves at feed left uncorrected, the first line and how many moves.
    unplaced: dict[str, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.travel = _Travel(self.model.machine)

    def add(self, wanted: Moves, text: bytes, origins: IntArray, pieces: Pieces, drilled: NDArray[np.bool_]) -> None:
        """Read corrected blocks and compare them with the moves that are wanted.

        ``origins`` are the numbers of the blocks that they come from, ``pieces`` how the moves were meant to be divided,
        ``drilled`` which are those of a cycle.
        """
        expected = self.reader.batch(text, self.lines + 1).moves
        read = self.follower.follow(text.decode("latin-1"), range(self.lines + 1, self.lines + 1 + len(origins)))
        if found := difference(expected, read):
            line, how = found
            self._break(int(origins[line - self.lines - 1]), f"what was written can be read in two ways: {how}")
        origin = origins[read.line - self.lines - 1]
        path = self._path(wanted, wanted.line)
        expected_path = centre_path(expected)
        expected_origin = origins[expected.line - self.lines - 1]
        self.travel.add(path.moves, expected_path.moves, expected_origin, text, self.lines + 1)
        self.lines += len(origins)
        contour, wanted = wanted, path.moves
        ended = np.zeros((len(wanted), 3))
        if self.model.by_direction:
            ended = kept_directions(directions_at(wanted, np.full(len(wanted), 1.0 - 1e-7)), self.direction)
        directions = np.vstack([self.direction, ended[:-1]])[: len(wanted)], ended
        if len(wanted):
            self.direction = ended[-1]
        rows = np.flatnonzero(wanted.cutting)
        zero, one = np.zeros(len(rows)), np.ones(len(rows))
        self._add(self.before, wanted, rows, wanted.part(rows), (zero, one), directions)
        self._note_unplaced(contour)
        self._hold_places(contour, read, origin, pieces)
        back = np.flatnonzero(read.cutting)
        self.cuts += len(back)
        driven = self._path(read, origin, pieces)
        owner, low, high = self._owners(wanted, rows, driven.moves.part(back), origin[back])
        if owner is not None:
            meant = np.flatnonzero(wanted.cutting[pieces.move])
            if np.array_equal(pieces.move[meant], owner):  # else shares by length, which slack makes longer
                beside = contour.phase[owner] != PLAIN  # corners shorten the path of the tool centre
                low = np.where(beside, low, pieces.begins()[meant])
                high = np.where(beside, high, pieces.share[meant])
                self._hold_ends(contour, read.part(back), owner, pieces.command_mm[meant], drilled)
            self._add(self.after, wanted, owner, driven.moves.part(back), (low, high), directions)
            self._add_corners(path, driven, back, owner)
            if self.follow is not None:
                self.follow(wanted, owner, driven.moves.part(back), low, high)

    def _path(self, moves: Moves, origin: IntArray, pieces: Pieces | None = None) -> CentrePath:
        """The path of the tool centre; InputError with the line of the program for a contour that has none."""
        owner = None
        if pieces is not None and len(pieces.move) == len(moves):
            owner = pieces.move
        path = centre_path(moves, owner)
        if path.problem:
            row, why = path.problem
            what = "" if pieces is None else "as corrected, "
            raise InputError(f"radius compensation: {what}{why}", line=int(origin[row]))
        return path

    def _add_corners(self, path: CentrePath, driven: CentrePath, back: IntArray, owner: IntArray) -> None:
        """Add the arcs about outer corners; ``owner`` is for each corrected move at feed ``back`` that of the program."""
        if not len(path.corners):
            return
        own = dict(zip(back.tolist(), owner.tolist(), strict=True))
        known = {own[row]: k for k, row in enumerate(driven.after.tolist()) if row in own}  # the last piece counts
        both = [(k, known[row]) for k, row in enumerate(path.after.tolist()) if row in known]
        if not both:
            return
        before, after = (np.array(column, dtype=np.int64) for column in zip(*both, strict=True))
        wanted, arcs, rows = path.corners.part(before), driven.corners.part(after), np.arange(len(both))
        shares, still = (np.zeros(len(both)), np.ones(len(both))), np.zeros((len(both), 3))
        self._add(self.before, wanted, rows, wanted, shares, (still, still))
        self._add(self.after, wanted, rows, arcs, shares, (still, still))

    def _note_unplaced(self, wanted: Moves) -> None:
        ends = wanted.cutting & wanted.corrected_there
        for k, axis in enumerate(AXES):
            lines = wanted.line[ends & ~wanted.corrected[:, k]]
            if len(lines):
                first, count = self.unplaced.get(axis, (int(lines[0]), 0))
                self.unplaced[axis] = first, count + len(lines)

    def notes(self) -> list[str]:
        """Say where an axis stays as the program has it, because its place depends on numbers that were not used yet."""
        why = "because no block has named it since its work offset or tool length changed; name all axes after such a change"
        return [
            f"line {self.reader.in_file(first)}: {axis} is not corrected in {count} move{'s' * (count > 1)} at feed, {why}"
            for axis, (first, count) in self.unplaced.items()
        ]

    def _break(self, line: int, message: str) -> None:
        self.broken = self.broken or f"line {self.reader.in_file(line)}: {message}"

    def _hold_places(self, wanted: Moves, read: Moves, origin: IntArray, pieces: Pieces) -> None:
        """Hold where each block leads against the program: no place is farther off than twice the largest correction."""
        change = np.abs(pieces.command_mm[pieces.share == 1.0] - wanted.end_mm)
        self.largest_mm = np.fmax(self.largest_mm, np.fmax.reduce(change, axis=0, initial=0.0))
        most_mm = 2.0 * self.largest_mm + self.least_mm
        last = [
            np.append(np.flatnonzero(np.diff(line)), len(line) - 1) if len(line) else line
            for line in (wanted.line, origin)
        ]
        known = np.intersect1d(wanted.line[last[0]], origin[last[1]], assume_unique=True)
        places = [
            moves.end_mm[index[np.searchsorted(line[index], known)]]
            for moves, line, index in ((wanted, wanted.line, last[0]), (read, origin, last[1]))
        ]
        off = np.where(np.isnan(places[0]), 0.0, np.nan_to_num(np.abs(places[1] - places[0]), nan=np.inf))
        new = np.flatnonzero(~np.isin(origin, wanted.line))
        way = np.abs(read.end_mm - read.start_mm)[new]
        for numbers, far in ((known, off), (origin[new], way)):
            worst = np.flatnonzero((far > most_mm).any(axis=1))
            if len(worst):
                far_mm = float(far[worst[0]].max())
                self._break(
                    int(numbers[worst[0]]), f"the corrected program leads {far_mm:.3f} mm away from the program"
                )

    def _hold_ends(
        self, wanted: Moves, read: Moves, owner: IntArray, command_mm: FloatArray, drilled: NDArray[np.bool_]
    ) -> None:
        """Hold the ends of moves at feed against the commands that were meant; of a cycle the depth of each hole."""
        rows, along = np.arange(len(wanted)), np.where(drilled, wanted.plane, 2)
        deep = wanted.end_mm[rows, along] < wanted.start_mm[rows, along]
        deep &= wanted.corrected_there
        meant = wanted.corrected & (~drilled | (deep & wanted.corrected[rows, along]))[:, None]
        off = np.where(meant[owner], np.nan_to_num(np.abs(read.end_mm - command_mm), nan=np.inf), 0.0)
        worst = np.flatnonzero((off > self.least_mm).any(axis=1))
        if len(worst):
            far_mm = float(off[worst[0]].max())
            self._break(
                int(wanted.line[owner[worst[0]]]),
                f"the corrected program leads {far_mm:.4f} mm away from what is right",
            )

    def _add(
        self,
        figures: PathFigures,
        wanted: Moves,
        owner: IntArray,
        driven: Moves,
        shares: tuple[FloatArray, FloatArray],
        directions: tuple[FloatArray, FloatArray],
    ) -> None:
        within_mm = 0.5 * self.tolerance_mm
        for found in path_deviations(self.model, self.step_mm, wanted, owner, driven, shares, directions, within_mm):
            figures.add(found)

    def _owners(self, wanted: Moves, rows: Any, read: Moves, origin: Any) -> tuple[Any, FloatArray, FloatArray]:
        """Which wanted move each corrected move belongs to, and the shares of it where that begins and ends."""
        lines, first, count = np.unique(wanted.line[rows], return_index=True, return_counts=True)
        found_lines, found_first, found_count = np.unique(origin, return_index=True, return_counts=True)
        if (
            len(lines) != len(found_lines)
            or not (lines == found_lines).all()
            or ((count > 1) & (count != found_count)).any()
        ):
            self._break(
                int(wanted.line[0]) if len(wanted) else 1, "the corrected program has other moves than the program"
            )
            return None, np.zeros(0), np.zeros(0)
        index = np.searchsorted(found_lines, origin)
        rank = np.arange(len(origin)) - found_first[index]
        several = count[index] > 1
        owner = rows[first[index] + np.where(several, rank, 0)]
        length = np.maximum(lengths_of(read), 1e-9)
        total = np.bincount(index, length)[index]
        passed = np.cumsum(length) - length
        low = np.where(several, 0.0, (passed - passed[found_first[index]]) / total)
        high = np.where(several, 1.0, low + length / total)
        high[np.concatenate([np.flatnonzero(np.diff(index)), [len(index) - 1]]) if len(index) else []] = 1.0
        return owner, low, high


# The whole program.


def header_lines(dialect: Dialect, result: ProgramCorrection, end: str) -> list[str]:
    """Return the comment blocks of a corrected program, and blocks that stop it where a work offset is another one."""
    said = [
        f"{MARK} {program_version()} FOR MACHINE {result.machine}",
        f"ERRORS {result.errors[0]} SHA256 {result.errors[1][:16]}",
        *_offsets_said(result.work_offsets_mm, result.machine_units),
        *_listed("TOOL LENGTHS MM", [f"{name} = {z:.4f}" for name, (_, _, z) in result.tools_mm.items()]),
        *(
            _listed("TOOL RADII MM", [f"{name} = {radius_text(r)}" for name, r in result.radii_mm.items()])
            if result.radii_mm
            else ()
        ),
        f"TOLERANCE UM {result.tolerance_um:g}",
        *(_listed("NOT CHECKED BY THIS PROGRAM", result.unchecked) if result.unchecked else ()),
        "ONLY FOR THIS MACHINE AND THIS CLAMPING POSITION",
    ]
    blocks = [dialect.said(text) for text in said]
    inch = result.machine_units == "inch"
    label = 9000
    for name, offset in result.work_offsets_mm.items():
        register = dialect.register(name)
        if name in result.unchecked or register is None:
            continue
        for k, value in enumerate(offset):
            label += 1
            own = f"{value / MM_PER_INCH:.6f}" if inch else f"{value:.4f}"
            names = {"variable": register + k, "value": own, "within": dialect.check_within[inch], "label": label}
            names |= {"name": name, "number": register, "axis": AXES[k]}
            blocks += [line.format(**names) for line in dialect.check]
    return [block + end for block in blocks]


def _offsets_said(offsets_mm: Mapping[str, tuple[float, float, float]], units: str) -> list[str]:
    """Work offsets in mm, and as a control in inch shows them."""
    lines = []
    for unit in dict.fromkeys(("mm", units)):
        scale, digits = MM_PER_UNIT[unit], 4 if unit == "mm" else 6
        texts = [
            f"{name} = {' '.join(f'{value / scale:.{digits}f}' for value in offset)}"
            for name, offset in offsets_mm.items()
        ]
        lines += _listed(f"WORK OFFSETS {unit.upper()}", texts)
    return lines


def _listed(what: str, texts: Sequence[str]) -> list[str]:
    """Texts after what they are, in lines that no control finds too long."""
    lines = [what]
    for k, text in enumerate(texts or ["none"]):
        if k and len(lines[-1]) + len(text) > LONGEST_COMMENT:
            lines.append(what)
        lines[-1] += (", " if lines[-1] != what else " ") + text
    return lines


def _head_of(stream: BinaryIO, dialect: Dialect) -> int:
    """Where the lines end that a control demands before all others; comments may stand between them."""
    head, plain, place = dialect.head(), dialect.without_words(), stream.tell()
    while line := stream.readline(LONGEST_BLOCK):
        if head.match(line):
            place = stream.tell()
        elif not plain.fullmatch(line):
            break
    return place


def _growth_said(blocks: int, added: int, piece_mm: float, errors: ErrorTable, options: CorrectOptions) -> str:
    """Say by how much a program has grown, why, and what makes it shorter; nothing for one that has not much."""
    if added <= max(GROWTH * blocks, FEW_BLOCKS) or not piece_mm:
        return ""
    said = (
        f"the corrected program has {blocks + added} blocks for {blocks}: a piece at feed is {piece_mm:.2f} mm long on average, "
        f"{1000.0 / 60.0 / piece_mm:.0f} blocks a second at 1000 mm/min"
    )
    # where a curve bends, the length of a piece goes with the root of the tolerance
    enough_um = options.tolerance_um * (added / max(blocks, 1)) ** 2
    cure = (
        f"a larger --tolerance-um ({options.tolerance_um:g}) or --shortest-mm ({options.shortest_mm:g}) make it shorter"
    )
    if enough_um <= 10.0 * options.tolerance_um:
        cure += f"; at about {float(f'{enough_um:.2g}'):g} um it has twice the blocks"
    if not errors.curves:
        return f"{said}; {cure}"
    name, curve = min(errors.curves.items(), key=lambda item: float(np.diff(item[1].position_mm).min(initial=np.inf)))
    apart_mm = float(np.diff(curve.position_mm).min(initial=np.inf))
    # the second difference of independent values has six times their variance
    scatter = float(np.sqrt(np.mean(np.diff(curve.value, 2) ** 2) / 6.0)) if len(curve.value) > 2 else 0.0
    unit, per = ("um", MM_PER_UM) if error_named(name).kind == "linear" else ("urad", 1e-6)
    return (
        f"{said}. {name} has nodes {apart_mm:g} mm apart, whose values scatter by about {scatter / per:.2f} {unit}; smooth "
        f"errors (volcomp fit), {cure}"
    )


def correct_program(  # noqa: PLR0913  (options by keyword)
    model: ExactModel,
    program: str | Path,
    out: str | Path,
    options: CorrectOptions = CorrectOptions(),  # noqa: B008 -- frozen
    setup: Setup = Setup(),  # noqa: B008 -- frozen
    *,
    errors_file: tuple[str, str] = ("", ""),
    show: Callable[[str], None] = lambda _: None,
    language: str = LANGUAGES[0],
    follow: Follow | None = None,
    remarks: Sequence[str] = (),
) -> ProgramCorrection:
    """Correct an NC program for one machine and write it to the folder ``out``, with ``correction.json``.

    Every coordinate is replaced by the command at which the tool of the exact model is where the program wants it. The
    corrected text is read again by the reader of the dialect, and the tool's path on the exact model is compared with the
    path of the program: a result that is not smaller is written as ``NOT-ACCEPTED-...``.

    Parameters
    ----------
    model : the machine with its errors, its reversal, and the axes that may be corrected.
    program : the NC program; InputError with its line for all that cannot be followed.
    out : folder for the corrected program, ``correction.json`` and ``preflight.md``.
    options, setup : how to correct; work offsets and tools that the program uses.
    errors_file : name and SHA-256 of the file of the errors, for the header.
    show : called with the step that is running.
    language : of the preflight list, ``"en"`` or ``"de"``; program and JSON stay in English.
    follow : called with the moves of each batch, wanted and as read back, see :data:`Follow`.
    remarks : further notes, such as what was not measured and is therefore not corrected.
    """
    source, dialect = Path(program), dialect_named(options.dialect)
    decimals = dialect.decimals if options.decimals is None else (options.decimals, options.decimals)
    options.check()
    if source.name in (CORRECTION_FILE, PREFLIGHT_FILE):
        raise InputError("the corrected program would have the name of another result; rename the program", file=source)
    read_bytes(source, 1)
    folder = OutputFolder(out)
    reader = Reader(model.machine, dialect, setup, source)
    resolution_mm = 10.0 ** -decimals[0]
    corrector = Corrector(model, options.tolerance_um * MM_PER_UM, options.shortest_mm, resolution_mm)
    writer = ProgramWriter(dialect, decimals)
    again = Reader(model.machine, dialect, setup, f"{source.name} as corrected")
    follower = Follower(dialect.name, reader.setup, model.machine)
    rounding_mm = 3.0 * max(10.0 ** -decimals[0], MM_PER_INCH * 10.0 ** -decimals[1])
    check = _ReadBack(
        model,
        again,
        follower,
        2.0 * corrector.step_mm,
        corrector.tolerance_mm,
        rounding_mm + corrector.tolerance_mm,
        follow=follow,
    )
    again.travel_slack_mm = 10.0
    blocks, in_cycle = 0, False
    with working_folder("correct-") as work:
        body = work / "body"
        with body.open("wb") as target:
            for batch in read_twice(reader):
                if reader.unknown:
                    continue  # it is refused at its end, with all that is not known
                by_radius, drilled = np.zeros((2, len(batch.moves)), dtype=bool)
                for segment in batch.segments:
                    if isinstance(segment, Run):
                        rows = slice(segment.first, segment.first + segment.count)
                        by_radius[rows] = ~np.isnan(batch.words.value[segment.row, R_WORD])
                    elif segment.kind == "arc":
                        by_radius[segment.first] = any(word[0] in ("R", "CR") for word in segment.words)
                    elif segment.kind in ("cycle", "hole", "tap"):
                        drilled[segment.first : segment.first + segment.count] = True
                if unknown := unknown_radius(model, batch.moves, options.tolerance_um * MM_PER_UM):
                    raise InputError(unknown.message, file=source, line=reader.in_file(unknown.line or 0))
                pieces = corrector.pieces(batch.moves, by_radius, drilled)
                try:
                    text, origins = writer.rewrite(batch, pieces, pieces.share - pieces.begins())
                except InputError as error:
                    raise InputError(error.message, file=source, line=reader.in_file(error.line or 0)) from error
                corrected = text.encode("latin-1")
                target.write(corrected)
                try:
                    check.add(batch.moves, corrected, origins, pieces, drilled)
                except InputError as error:
                    if not error.message.startswith("radius compensation: "):
                        raise
                    raise InputError(error.message, file=source, line=reader.in_file(error.line or 0)) from error
                if check.after.normal_line > blocks:  # the farthest so far is in this batch
                    in_cycle = bool(drilled[batch.moves.line == check.after.normal_line].any())
                blocks += len(batch.words.start) - 1
                show(f"{blocks} blocks corrected and read back")
        model.errors.warn_outside(reader.reached_mm)
        unchanged = not writer.changed and not writer.added
        reasons = []
        before, after = check.before, check.after
        for figures in (before, after):
            figures.line, figures.normal_line = reader.in_file(figures.line), reader.in_file(figures.normal_line)
        enough_mm = max(options.tolerance_um * MM_PER_UM, resolution_mm)
        if check.broken:
            reasons.append(check.broken)
        elif not before.length_mm:
            reasons.append("the program has no moves at feed, so that nothing can be judged")
        elif unchanged:
            if before.worst_mm > enough_mm:
                reasons.append("nothing was changed although the program deviates by more than the tolerance")
        elif after.worst_mm >= before.worst_mm:
            reasons.append(
                f"the deviation is not smaller: {before.worst_mm / MM_PER_UM:.2f} um before, "
                f"{after.worst_mm / MM_PER_UM:.2f} um after"
            )
        elif after.normal_rms_mm >= before.normal_rms_mm and after.normal_mm > enough_mm:
            reasons.append(
                f"the deviation is not smaller: {before.normal_rms_mm / MM_PER_UM:.2f} um rms before, "
                f"{after.normal_rms_mm / MM_PER_UM:.2f} um rms after"
            )
        check.travel.found = [replace(item, line=reader.in_file(item.line)) for item in check.travel.found]
        refused, note = check.travel.said()
        reasons += [refused] if refused else []
        grown = _growth_said(blocks, writer.added, after.length_mm / max(check.cuts, 1), model.errors, options)
        notes = [*([] if unchanged else check.notes()), *(text for text in (note, grown) if text)]
        if in_cycle and after.normal_mm > enough_mm:
            notes.append(
                f"line {after.normal_line}: a drilling cycle has one X and Y, here those that are right at its depth; the stroke "
                f"above is up to {after.normal_mm / MM_PER_UM:.2f} um from the axis of the hole"
            )
        result = ProgramCorrection(
            model.machine.name,
            source.name,
            dialect.name,
            before,
            after,
            {"blocks": blocks, "changed_blocks": writer.changed, "added_blocks": writer.added},
            reader.used_offsets,
            reader.used_tools,
            tuple(reader.assumed),
            options.tolerance_um,
            decimals,
            tuple(reasons),
            ("" if not reasons else REJECTED_PREFIX) + source.name,
            errors_file,
            (*notes, *([] if model.growth is None else model.growth.lines()), *remarks),
            model.machine.units,
            tuple(name for name in reader.used_offsets if not dialect.check or dialect.register(name) is None),
            check.travel.count,
            tuple(check.travel.found),
            reader.used_radii,
            model.growth,
        )
        final = work / "program"
        with source.open("rb") as stream:
            head = stream.readline(4096)
        eol = "\r\n" if head.endswith(b"\r\n") else "\n"
        with body.open("rb") as stream, final.open("wb") as target:
            if not unchanged:
                place = _head_of(stream, dialect)
                stream.seek(0)
                target.write(stream.read(place))
                target.write("".join(header_lines(dialect, result, eol)).encode("latin-1"))
            shutil.copyfileobj(stream, target)
        folder.add_file(result.file, final)
        folder.add(CORRECTION_FILE, json_text({**result.as_dict(), "sha256": sha256_of_file(final)}))
        listed = preflight(result)
        if language != LANGUAGES[0]:
            from compgen.language import texts_of, wrapped

            listed = wrapped(texts_of(language).lines(listed))
        folder.add(PREFLIGHT_FILE, listed)
        folder.commit()
    return result


def preflight(result: ProgramCorrection) -> str:
    """Return what to check at the machine before the corrected program runs, as Markdown."""
    offsets = [f"{name}: X {x:g}, Y {y:g}, Z {z:g} mm" for name, (x, y, z) in result.work_offsets_mm.items()]
    tools = [f"tool {name}: {z:g} mm" for name, (_, _, z) in result.tools_mm.items()]
    points = [
        f"This program is for the machine {result.machine} and this clamping position only.",
        f"Work offsets at the control are those of the correction: {'; '.join(offsets) or 'none was used'}.",
        *_checks_said(result),
        f"Tool lengths at the control are those of the correction: {'; '.join(tools) or 'none was used'}.",
        *_radii_said(result),
        "Tables of the control that correct the same errors are switched off, were active during the measurement, or were "
        "given with --active.",
        "The machine is warm, as it was during the measurement.",
        *(f"It was assumed that {text}." for text in result.assumed),
        *(text[0].upper() + text[1:] + "." for text in result.notes),
        *_beyond_said(result),
        "Compare with the original by `diff`, and let the program run in the air first.",
    ]
    before, after = result.before.as_dict(), result.after.as_dict()
    figures = (
        f"Largest distance of the tool from the path: {before['normal_max_um']:.2f} um before, "
        f"{after['normal_max_um']:.2f} um after; at the ends of moves {before['ends_max_um']:.2f} and "
        f"{after['ends_max_um']:.2f} um."
    )
    return "\n".join([f"# Before you run {result.file}", "", figures, "", *(f"- [ ] {text}" for text in points), ""])


def radius_text(radius_mm: float) -> str:
    """Say a radius of radius compensation."""
    return f"{radius_mm:g}" if np.isfinite(radius_mm) else "not stated"


def _radii_said(result: ProgramCorrection) -> list[str]:
    """Say which radii the correction assumes, and what follows from others."""
    if not result.radii_mm:
        return []
    named = "; ".join(
        f"{name}: {radius:g} mm" if np.isfinite(radius) else f"{name}: not stated"
        for name, radius in result.radii_mm.items()
    )
    return [
        "Radius compensation stays with the control. The correction is that of a tool centre beside the contour by the radius: "
        f"{named} (0: the contour is the path of the tool centre, and the control has the wear alone). Wear of some 0.1 mm does "
        "not matter; with a tool of another radius the correction is that of another place. Outer corners are judged with an arc."
    ]


def _beyond_said(result: ProgramCorrection) -> list[str]:
    """List blocks that lead beyond the travel, each with its text."""
    if not result.beyond:
        return []
    rows = [
        f"    - line {item.line}: {item.axis} {item.position_mm:.4f} mm of the machine, {item.beyond_mm:.4f} mm beyond the travel"
        f"{', where the program leads, too' if item.by_program else ', by the correction'}: `{item.block.replace('`', ' ')}`"
        for item in result.beyond[:MOST_IN_PREFLIGHT]
    ]
    more = result.blocks_beyond - len({item.line for item in result.beyond[:MOST_IN_PREFLIGHT]})
    rows += [f"    - and {more} more blocks; correction.json lists up to {MOST_LISTED}"] if more > 0 else []
    head = "The software limits of the control let these blocks pass, which lead beyond the travel of the machine file:"
    return ["\n".join([head, *rows])]


def _checks_said(result: ProgramCorrection) -> list[str]:
    """Say which work offsets the program checks, and what else must not shift its coordinates."""
    dialect = dialect_named(result.dialect)
    checked = [name for name in result.work_offsets_mm if name not in result.unchecked]
    texts = []
    if checked:
        within = dialect.check_within[result.machine_units == "inch"]
        texts.append(
            f"The first blocks of the program stop it where X, Y or Z of {', '.join(checked)} differ by more than {within} "
            f"{result.machine_units}; the control keeps them in {result.machine_units} (machine_units of the machine file)."
        )
    if result.unchecked:
        texts.append(f"Compare by hand, since the program does not check it: {', '.join(result.unchecked)}.")
    return [*texts, f"Nothing else shifts the coordinates: {dialect.beside}."]


def model_of(
    machine: Machine, errors: ErrorTable, reversal: ReversalCurves | None, only: str | None = None
) -> ExactModel:
    """Return the exact model for a correction; ``only`` names the axes that may be corrected, e.g. ``X,Y``."""
    chosen = AXES if only is None else tuple(part.strip().upper() for part in only.split(","))
    if not set(chosen) <= set(AXES):
        raise InputError(f"{only!r} does not name axes; expected some of X,Y,Z", field="--only")
    return ExactModel(machine, errors, reversal, ("X" in chosen, "Y" in chosen, "Z" in chosen))
