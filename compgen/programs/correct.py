"""Correct an NC program for the errors of one machine: coordinates rewritten, read back, and judged on the exact model."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.files import REJECTED_PREFIX, OutputFolder, json_text, read_bytes, sha256_of_file, working_folder
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import option
from compgen.errors import InputError
from compgen.programs.dialects import AT_THE_END, Dialect, dialect_named
from compgen.programs.path import (
    PLANE_AXES,
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
)
from compgen.programs.reader import MARK, MM_PER_INCH, Batch, Reader, Setup, SingleBlock
from compgen.programs.runs import PlainRun
from compgen.resources import LANGUAGES, program_version

#: A coordinate is rewritten if it changes by more than this part of its last decimal.
_HALF = 0.5 + 1e-6


@dataclass(frozen=True)
class CorrectOptions:
    """How a program is corrected."""

    dialect: str = option(
        "linuxcnc", "Dialect of the program.", choices=("fanuc", "siemens", "heidenhain-iso", "linuxcnc", "grbl")
    )
    tolerance_um: float = option(1.0, "Largest deviation of a corrected move from the correction within it, um.")
    shortest_mm: float = option(0.1, "Shortest move that the division of a move makes, mm.")
    decimals: int | None = option(
        None, "Decimals of rewritten coordinates (default: those of the dialect, 3 to 6).", within=(1, 9)
    )


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
            "assumed": list(self.assumed),
            "tolerance_um": self.tolerance_um,
            "file": self.file,
        }


# Writing: the same blocks with other coordinates.


@dataclass
class ProgramWriter:
    """Rewrites blocks with corrected coordinates and keeps what the control then has, in mm of the machine axes.

    ``target_mm`` is the command for the last end, ``written_mm`` where the rounded numbers lead; ``shift_mm`` is what the
    rounding of G92 adds to the offset.
    """

    dialect: Dialect
    decimals: tuple[int, int]
    target_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    written_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    wanted_mm: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    shift_mm: FloatArray = field(default_factory=lambda: np.zeros(3))
    depth: float = np.nan
    level: float = np.nan
    pole_mm: list[float] = field(default_factory=lambda: [np.nan] * 3)
    changed: int = 0
    added: int = 0

    def digits(self, scale: float) -> int:
        """Return the decimals of numbers in mm (``scale`` 1) or inch."""
        return self.decimals[scale == MM_PER_INCH]

    def rewrite(self, batch: Batch, pieces: Pieces, share_before: FloatArray) -> Iterator[tuple[int, str]]:
        """Yield the blocks of the corrected program, each with the number of the block that it comes from."""
        bounds = np.searchsorted(pieces.move, np.arange(len(batch.moves) + 1))
        for segment in batch.segments:
            if isinstance(segment, PlainRun):
                yield from self._plain(batch, segment, pieces, bounds)
            else:
                rows = slice(int(bounds[segment.first]), int(bounds[segment.first + segment.count]))
                yield from ((segment.number, text) for text in self._block(batch, segment, pieces, rows, share_before))
                if segment.count:
                    self.wanted_mm = batch.moves.end_mm[segment.first + segment.count - 1]

    def _plain(self, batch: Batch, run: PlainRun, pieces: Pieces, bounds: Any) -> Iterator[tuple[int, str]]:
        n = len(run.row)
        if not n:
            for k in run.lines:
                yield batch.first_line + k, batch.lines[k]
            return
        rows = slice(int(bounds[run.first]), int(bounds[run.first + n]))
        move = pieces.move[rows] - run.first
        offset = batch.moves.offset_mm[run.first] + self.shift_mm
        digits = self.digits(run.scale)
        value = (pieces.command_mm[rows] - offset) / run.scale
        grid = np.rint(np.vstack([(self.target_mm - offset) / run.scale, value]) * 10.0**digits)
        moves_on = grid[1:] != grid[:-1]
        first = np.concatenate([[True], move[1:] != move[:-1]])
        single = first & np.concatenate([first[1:], [True]])
        named = ~np.isnan(run.value[move]) & first[:, None]
        own = np.where(named, np.maximum(run.decimals, digits)[move], digits)
        same = named & single[:, None] & (np.abs(value - run.value[move]) <= _HALF * 10.0**-own)
        rounded = np.rint(value * 10.0**own) / 10.0**own
        rounded[same] = run.value[move][same]
        add = moves_on & ~named
        alone = ~first & ~add.any(axis=1)
        add[alone] = True
        last = np.where(named | add, np.arange(len(value))[:, None], -1).max(axis=0)
        for k in range(3):
            if last[k] >= 0:
                self.written_mm[k] = rounded[last[k], k] * run.scale + offset[k]
        self.target_mm, self.wanted_mm = pieces.command_mm[rows][-1], batch.moves.end_mm[run.first + n - 1]
        renew = named & ~same
        touched = (renew.any(axis=1) | add.any(axis=1)).tolist()
        # the usual numbers have the decimals of the dialect: they are written in one go
        form = f"%.{digits}f\n" * 3 * len(rounded)
        usual = (form % tuple((rounded + 0.0).ravel().tolist())).split("\n")
        plain = ((run.decimals == digits)[move] | ~named).tolist()
        order, spans = np.argsort(run.span[:, :, 0], axis=1).tolist(), run.span.tolist()
        rows_of, owns, firsts, adds = run.row.tolist(), own.tolist(), first.tolist(), add.tolist()
        at, lines, base = run.lines.start, batch.lines, batch.first_line
        for p, (m, begins, renewed) in enumerate(zip(move.tolist(), firsts, renew.tolist(), strict=True)):
            here = run.lines.start + rows_of[m]
            more = [f"{AXES[k]}{self._number(rounded[p, k], digits)}" for k in range(3) if adds[p][k]]
            if not begins:
                self.added += 1
                yield base + here, " ".join(more) + self._line_end(lines[here])
                continue
            while at < here:
                yield base + at, lines[at]
                at += 1
            at = here + 1
            text = lines[here]
            if touched[p]:
                self.changed += 1
                parts: list[str] = []
                done = 0
                for k in order[m]:
                    start, stop = spans[m][k]
                    if renewed[k]:
                        old = text[start:stop]
                        new = usual[3 * p + k]
                        if not plain[p][k] or old[0] == "+":
                            new = self._number(rounded[p, k], owns[p][k], old)
                        parts += text[done:start], new
                        done = stop
                end = spans[m][order[m][2]][1]
                if more:
                    parts += text[done:end], _joined(more, text[:end])
                    done = end
                parts.append(text[done:])
                text = "".join(parts)
            yield base + here, text
        for k in range(at, run.lines.stop):
            yield base + k, lines[k]

    def _line_end(self, text: str) -> str:
        body = text.rstrip()
        return (" *" if self.dialect.pole and body.endswith("*") else "") + (text[len(text.rstrip("\r\n")) :] or "\n")

    def _number(self, value: float, digits: int, like: str = "") -> str:
        """Write a number with ``digits`` decimals; without trailing zeros where ``like``, the number before, has fewer."""
        text = f"{value + 0.0:.{digits}f}"
        if text.startswith("-") and not text.strip("-0."):
            text = text[1:]
        if len(like.partition(".")[2]) < digits:
            text = text.rstrip("0")
        if (like.lstrip()[:1] == "+" or (self.dialect.pole and not like)) and text[0] != "-":
            text = "+" + text
        return text

    def _block(
        self, batch: Batch, block: SingleBlock, pieces: Pieces, rows: slice, share_before: FloatArray
    ) -> list[str]:
        """Rewrite one block; moves of a block are one that is divided, or those of a drilling cycle."""
        offset = batch.moves.offset_mm[block.first] + self.shift_mm if block.count else self.shift_mm
        if block.kind == "preset":
            return [self._preset(block)]
        if block.kind == "no preset":
            self.shift_mm = np.zeros(3)
        if block.kind == "store":
            values = {letter: float(text) for letter, text, *_ in block.words if letter in "ZR"}
            self.depth, self.level = values.get("Z", self.depth), values.get("R", self.level)
        if block.kind not in ("line", "arc", "cycle"):
            if any(word[0] in ("I", "J", "K") for word in block.words):
                self.pole_mm = [np.nan] * 3  # the pole is again that of the program
            if block.count:
                self.target_mm = np.array(pieces.command_mm[rows][-1])
                self.written_mm = np.array(self.target_mm)
            return [block.text]
        move = batch.moves.part(slice(block.first, block.first + block.count))
        if block.kind == "cycle":
            depth = np.flatnonzero((move.kind != 0) & move.corrected[:, 2])
            if not len(depth):
                return [block.text]
            # the stroke to the depth may be several pieces; the hole is where the last ends
            stroke = np.flatnonzero(pieces.move[rows] == block.first + depth[0])
            target, allowed = pieces.command_mm[rows][stroke[-1]], move.corrected[int(depth[0])]
            at_level = np.flatnonzero((move.end_mm[:, 2] == move.start_mm[move.kind != 0][0, 2]) & move.corrected[:, 2])
            level = pieces.command_mm[rows][np.isin(pieces.move[rows] - block.first, at_level)]
            ends_there = move.end_mm[-1, 2] == move.start_mm[move.kind != 0][0, 2]
            level_z = float(level[-1, 2]) if len(level) else np.nan
            return [self._cycle(block, target, offset, level_z, bool(ends_there), allowed)]
        count = rows.stop - rows.start
        texts = []
        total = share_before[rows]
        for piece in range(count):
            command, centre = pieces.command_mm[rows.start + piece], pieces.centre_mm[rows.start + piece]
            part = float(total[piece])
            sweep = float(move.sweep_rad[0]) * part
            texts.append(self._piece(block, move, command, centre, sweep, offset, (piece, count), part))
            self.target_mm = np.array(command)
        if count > 1:
            moved = " ".join(
                letter + text
                for letter, text, *_ in block.words
                if text and letter in "GM" and f"{letter}{float(text):g}" in AT_THE_END
            )
            if moved:
                body = texts[-1].rstrip("\r\n")
                texts[-1] = f"{body} {moved}{texts[-1][len(body) :]}"
            self.added += count - 1
        self.changed += texts[0] != block.text
        return texts

    def _piece(
        self,
        block: SingleBlock,
        move: Moves,
        command: FloatArray,
        centre: FloatArray,
        sweep: float,
        offset: FloatArray,
        number: tuple[int, int],
        part: float,
    ) -> str:
        """Text of one piece of a move: the block with other numbers, or a new one with what differs."""
        piece, count = number
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
                given, own = float(text.replace(" ", "")), max(digits, len(text.partition(".")[2].strip()))
                if count == 1 and abs(value - given) <= _HALF * 10.0**-own:
                    return given
                changes.append((first, last, self._number(value, own, text)))
                return round(value, own)
            if needed or always:
                equals = "=" if len(letter) > 1 else ""  # CR= of SINUMERIK
                more.append(f"{letter}{equals}{self._number(value, digits)}")
                return round(value, digits)
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
            faster = f"{float(text) / part:.6g}"
            if piece == 0:
                changes.append((first, last, faster))
            else:
                more.append(f"F{faster}")
        if piece > 0:
            skip = re.match(r"\s*(/\d?)", block.text)
            return (skip[1] if skip else "") + " ".join(more) + self._line_end(block.text)
        if count > 1:
            for letter, text, first, last in block.words:
                if text and letter in "GM" and f"{letter}{float(text):g}" in AT_THE_END:
                    begin = block.text.upper().rfind(letter, 0, first)
                    changes.append((begin, last, ""))
        end = max((stop for letter, text, _, stop in block.words if letter in AXES), default=0)
        end = end or max(stop for _, _, _, stop in block.words)
        text = _spliced(block.text, changes, end, more)
        return text if count == 1 or text.endswith("\n") else text + "\n"

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
        self,
        block: SingleBlock,
        target: FloatArray,
        offset: FloatArray,
        level_z: float,
        ends_there: bool,
        allowed: NDArray[np.bool_],
    ) -> str:
        """Rewrite a drilling block: place, depth and R level of the hole; ``ends_there``: the tool stays at the R level."""
        scale, digits = block.scale, self.digits(block.scale)
        words = {letter: (text, start, stop) for letter, text, start, stop in block.words}
        changes: list[tuple[int, int, str]] = []
        more: list[str] = []
        before = [*((self.target_mm[:2] - offset[:2]) / scale), self.depth, self.level]
        wanted = [*((target - offset) / scale), (level_z - offset[2]) / scale]
        found = list(before)
        for k, letter in enumerate("XYZR"):
            value, may = float(wanted[k]), bool(allowed[min(k, 2)])
            if np.isnan(value):
                continue
            if letter in words:
                text, first, stop = words[letter]
                given, own = float(text.replace(" ", "")), max(digits, len(text.partition(".")[2].strip()))
                if abs(value - given) > _HALF * 10.0**-own and may:
                    changes.append((first, stop, self._number(value, own, text)))
                    found[k] = round(value, own)
                else:
                    found[k] = given
            elif may and np.isfinite(before[k]) and np.rint(value * 10**digits) != np.rint(before[k] * 10**digits):
                more.append(f"{letter}{self._number(value, digits)}")
                found[k] = round(value, digits)
        self.depth, self.level = found[2], found[3]
        for k in range(2):
            if AXES[k] in words or any(word[0] == AXES[k] for word in more):
                self.written_mm[k] = found[k] * scale + offset[k]
        self.target_mm[:2] = target[:2]
        if ends_there:
            self.target_mm[2] = level_z
            self.written_mm[2] = found[3] * scale + offset[2]
        self.changed += bool(changes or more)
        end = max((stop for letter, (_, _, stop) in words.items() if letter in AXES), default=0)
        return _spliced(block.text, changes, end or max(w[3] for w in block.words), more)

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


def _joined(words: Sequence[str], before: str) -> str:
    """Return words that follow ``before`` in a block, without blanks where the block has none."""
    blank = " " if " " in before.strip() else ""
    return "".join(blank + word for word in words)


def _spliced(text: str, changes: list[tuple[int, int, str]], end: int, more: Sequence[str]) -> str:
    """Replace columns of a block and put the words ``more`` after column ``end``."""
    for start, stop, new in sorted([*changes, (end, end, _joined(more, text[:end]))], reverse=True):
        text = text[:start] + new + text[stop:]
    return text


# Reading back: the tool on the exact machine against the path that the program wanted.


@dataclass
class _ReadBack:
    """Adds up the deviations of the program and of the corrected one, batch by batch."""

    model: ExactModel
    reader: Reader
    step_mm: float
    before: PathFigures = field(default_factory=PathFigures)
    after: PathFigures = field(default_factory=PathFigures)
    lines: int = 0
    direction: FloatArray = field(default_factory=lambda: np.zeros(3))
    broken: str = ""

    def add(self, wanted: Moves, texts: list[str], origins: list[int]) -> None:
        """Read the corrected blocks ``texts`` and compare them with the moves that are wanted."""
        read = self.reader.batch("".join(texts).encode("latin-1"), self.lines + 1).moves
        origin = np.array(origins, dtype=np.int64)[read.line - self.lines - 1] if len(read) else read.line
        self.lines += len(texts)
        ended = kept_directions(directions_at(wanted, np.full(len(wanted), 1.0 - 1e-7)), self.direction)
        if len(wanted):
            self.direction = ended[-1]
        rows = np.flatnonzero(wanted.cutting)
        zero, one = np.zeros(len(rows)), np.ones(len(rows))
        self._add(self.before, wanted, rows, wanted.part(rows), (zero, one), ended)
        back = np.flatnonzero(read.cutting)
        owner, low, high = self._owners(wanted, rows, read.part(back), origin[back])
        if owner is not None:
            self._add(self.after, wanted, owner, read.part(back), (low, high), ended)

    def _add(
        self,
        figures: PathFigures,
        wanted: Moves,
        owner: IntArray,
        driven: Moves,
        shares: tuple[FloatArray, FloatArray],
        ended: FloatArray,
    ) -> None:
        for found in path_deviations(self.model, self.step_mm, wanted, owner, driven, shares, ended):
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
            self.broken = "the corrected program has other moves than the program"
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
    offsets = [f"{name} = {x:.4f} {y:.4f} {z:.4f}" for name, (x, y, z) in result.work_offsets_mm.items()]
    tools = [f"{name} = {z:.4f}" for name, (_, _, z) in result.tools_mm.items()]
    said = [
        f"{MARK} {program_version()} FOR MACHINE {result.machine}",
        f"ERRORS {result.errors[0]} SHA256 {result.errors[1][:16]}",
        f"WORK OFFSETS MM {', '.join(offsets) or 'none'}",
        f"TOOL LENGTHS MM {', '.join(tools) or 'none'}",
        f"TOLERANCE UM {result.tolerance_um:g}",
        "ONLY FOR THIS MACHINE AND THIS CLAMPING POSITION",
    ]
    blocks = [dialect.said(text) for text in said]
    label = 9000
    for name, offset in result.work_offsets_mm.items():
        number = re.fullmatch(r"G5([4-9])", name)
        if not (dialect.check and number):
            continue
        for k, value in enumerate(offset):
            label += 1
            variable = 5221 + 20 * (int(number[1]) - 4) + k
            names = {"variable": variable, "value": f"{value:.4f}", "label": label, "name": name}
            names |= {"number": int(number[1]) - 3, "axis": AXES[k]}
            blocks += [line.format(**names) for line in dialect.check]
    return [block + end for block in blocks]


def correct_program(
    model: ExactModel,
    program: str | Path,
    out: str | Path,
    options: CorrectOptions = CorrectOptions(),  # noqa: B008 -- frozen
    setup: Setup = Setup(),  # noqa: B008 -- frozen
    *,
    errors_file: tuple[str, str] = ("", ""),
    show: Callable[[str], None] = lambda _: None,
    language: str = LANGUAGES[0],
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
    """
    source, dialect = Path(program), dialect_named(options.dialect)
    decimals = dialect.decimals if options.decimals is None else (options.decimals, options.decimals)
    if not (options.tolerance_um > 0 and options.shortest_mm > 0):
        raise InputError("the tolerance and the shortest move have to be above 0")
    read_bytes(source, 1)
    folder = OutputFolder(out)
    reader = Reader(model.machine, dialect, setup, source)
    resolution_mm = 10.0 ** -decimals[0]
    corrector = Corrector(model, options.tolerance_um * MM_PER_UM, options.shortest_mm, resolution_mm)
    writer = ProgramWriter(dialect, decimals)
    again = Reader(model.machine, dialect, setup, f"{source.name} as corrected")
    check = _ReadBack(model, again, 2.0 * corrector.step_mm)
    again.travel_slack_mm = 10.0
    blocks = 0
    with working_folder("correct-") as work:
        body = work / "body"
        with source.open("rb") as stream, body.open("wb") as target:
            for batch in reader.batches(stream):
                by_radius = np.zeros(len(batch.moves), dtype=bool)
                for segment in batch.segments:
                    if isinstance(segment, SingleBlock) and segment.kind == "arc":
                        by_radius[segment.first] = any(word[0] in ("R", "CR") for word in segment.words)
                pieces = corrector.pieces(batch.moves, by_radius)
                begin = np.where(np.diff(pieces.move, prepend=-1) > 0, 0.0, np.roll(pieces.share, 1))
                origins, texts = [], []
                try:
                    for origin, text in writer.rewrite(batch, pieces, pieces.share - begin):
                        origins.append(origin)
                        texts.append(text)
                except InputError as error:
                    raise InputError(error.message, file=source, line=error.line) from error
                target.write("".join(texts).encode("latin-1"))
                check.add(batch.moves, texts, origins)
                blocks += len(batch.lines)
                show(f"{blocks} blocks corrected and read back")
        model.errors.warn_outside(reader.reached_mm)
        unchanged = not writer.changed and not writer.added
        reasons = []
        before, after = check.before, check.after
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
        )
        final = work / "program"
        with source.open("rb") as stream:
            head = stream.readline(4096)
        eol = "\r\n" if head.endswith(b"\r\n") else "\n"
        with body.open("rb") as stream, final.open("wb") as target:
            if not unchanged:
                for _ in range(2):  # the header follows % and the number of the program
                    place = stream.tell()
                    line = stream.readline()
                    if not re.match(rb"\s*(%|[O:]\d|N\d+\s*%)", line):
                        stream.seek(place)
                        break
                    target.write(line)
                target.write("".join(header_lines(dialect, result, eol)).encode("latin-1"))
            shutil.copyfileobj(stream, target)
        folder.add_file(result.file, final)
        folder.add("correction.json", json_text({**result.as_dict(), "sha256": sha256_of_file(final)}))
        listed = preflight(result)
        if language != LANGUAGES[0]:
            from compgen.data.language import texts_of, wrapped

            listed = wrapped(texts_of(language).lines(listed))
        folder.add("preflight.md", listed)
        folder.commit()
    return result


def preflight(result: ProgramCorrection) -> str:
    """Return what to check at the machine before the corrected program runs, as Markdown."""
    offsets = [f"{name}: X {x:g}, Y {y:g}, Z {z:g} mm" for name, (x, y, z) in result.work_offsets_mm.items()]
    tools = [f"tool {name}: {z:g} mm" for name, (_, _, z) in result.tools_mm.items()]
    points = [
        f"This program is for the machine {result.machine} and this clamping position only.",
        f"Work offsets at the control are those of the correction: {'; '.join(offsets) or 'none was used'}.",
        f"Tool lengths at the control are those of the correction: {'; '.join(tools) or 'none was used'}.",
        "Tables of the control that correct the same errors are switched off, were active during the measurement, or were "
        "given with --active.",
        "The machine is warm, as it was during the measurement.",
        *(f"It was assumed that {text}." for text in result.assumed),
        "Compare with the original by `diff`, and let the program run in the air first.",
    ]
    before, after = result.before.as_dict(), result.after.as_dict()
    figures = (
        f"Largest distance of the tool from the path: {before['normal_max_um']:.2f} um before, "
        f"{after['normal_max_um']:.2f} um after; at the ends of moves {before['ends_max_um']:.2f} and "
        f"{after['ends_max_um']:.2f} um."
    )
    return "\n".join([f"# Before you run {result.file}", "", figures, "", *(f"- [ ] {text}" for text in points), ""])


def model_of(
    machine: Machine, errors: ErrorTable, reversal: ReversalCurves | None, only: str | None = None
) -> ExactModel:
    """Return the exact model for a correction; ``only`` names the axes that may be corrected, e.g. ``X,Y``."""
    chosen = AXES if only is None else tuple(part.strip().upper() for part in only.split(","))
    if not set(chosen) <= set(AXES):
        raise InputError(f"{only!r} does not name axes; expected some of X,Y,Z", field="--only")
    return ExactModel(machine, errors, reversal, ("X" in chosen, "Y" in chosen, "Z" in chosen))
