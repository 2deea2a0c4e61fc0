"""Programs as their control executes them: calls are written out, and numbers without a decimal point get it.

Subprograms are those in the file of their program: each place that they lead to needs its own correction.

``M98 P1001 L3`` calls the blocks from ``O1001`` to ``M99`` three times, as does ``M98 P31001`` of FANUC; ``M97 P100`` of
Haas those from ``N100``. What stands in comments, or in blocks that the control skips, calls nothing and ends nothing.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np

from compgen.errors import InputError
from compgen.programs.path import IntArray

#: Calls within calls, and blocks of a program that is written out.
_DEEPEST, _MOST_BLOCKS = 10, 5_000_000
_MENTIONED = re.compile(rb"M[ \t]*+(?:\+[ \t]*+)?0*+9[78]", re.IGNORECASE)
_WORD = re.compile(rb"([A-Z])[ \t]*+((?:[+-][ \t]*+)?(?:\d++(?:\.\d*+)?|\.\d++))", re.IGNORECASE)
#: What is no code: comments, program names; of FANUC what follows a semicolon is another block, which is refused later.
_LATER = {
    "fanuc": re.compile(rb"\([^()\n]*\)|<[^<>\n]*>|;[^\n]*"),
    "linuxcnc": re.compile(rb"\([^()\n]*\)|;[^\n]*"),
}
#: Words with a number without a decimal point that may be a length or an angle, and codes that matter to it.
_INTEGER = re.compile(rb"([XYZUVWABCIJKQR])[ \t]*+((?:[+-][ \t]*+)?\d++)(?![\d.])", re.IGNORECASE)
_G_CODE = re.compile(rb"G[ \t]*+(\d++(?:\.\d*+)?)", re.IGNORECASE)
_DRILLS = frozenset(f"G{k}" for k in (73, 74, 76, *range(81, 90)))
_ENDS_DRILLING = frozenset(("G0", "G1", "G2", "G3", "G80"))
#: A line is read no further, bytes.
_LONGEST_LINE = 1 << 16
_SKIPPED = re.compile(rb"\s*/")


@dataclass(frozen=True)
class WrittenOut:
    """A program with its calls written out; ``line`` (n,) is for each of its lines the one in the file it is from."""

    content: bytes
    line: IntArray
    called: tuple[str, ...]


@dataclass(frozen=True)
class _Block:
    """One line of a program: its text, its code without comments, and whether it is one with ``/``."""

    text: bytes
    code: bytes
    slash: bool

    @cached_property
    def words(self) -> list[tuple[bytes, float]]:
        """Its words; none where a parenthesis is open, which the reader refuses."""
        if b"(" in self.code or b")" in self.code:
            return []
        found = _WORD.finditer(self.code)
        return [(word[1].upper(), float(re.sub(rb"\s", b"", word[2]))) for word in found]

    def has(self, *codes: float) -> bool:
        """Whether it has one of the M codes."""
        return b"M" in self.code.upper() and any(letter == b"M" and value in codes for letter, value in self.words)

    def given(self, letter: bytes) -> float | None:
        """The value of a word."""
        return next((value for found, value in self.words if found == letter), None)

    def number(self, letters: bytes) -> bytes | None:
        """The number of a program or block that begins here, after one of ``letters``."""
        found = re.match(rb"\s*(?:N\s*\d+\s*)?[" + letters + rb"]\s*0*(\d+)(?!\d)", self.code, re.IGNORECASE)
        return found[1] if found else None

    def without(self, letters: bytes) -> bytes:
        """Its text without its M97 to M99 and the words of ``letters``; comments stay."""
        text = self.text
        for word in reversed(list(_WORD.finditer(self.code))):
            letter, value = word[1].upper(), float(re.sub(rb"\s", b"", word[2]))
            if letter in letters or (letter == b"M" and value in (97, 98, 99)):
                start = len(text[: word.start()].rstrip(b" \t"))
                text = text[:start] + text[word.end() :]
        return text


class Pointed:
    """A program of FANUC whose numbers without a decimal point are given it: read in parts, as a stream.

    ``X500`` is ``X500.`` where integers are mm (inch in G20). Where they are increments it is ``X0.5`` with increments of 0.001
    mm, which are 0.0001 inch and 0.001 deg. Lengths, angles, radii and pecks are such numbers; G, M, T, H, D, N, O, P, S, F, L,
    repeats (K of a drilling cycle), and the words of dwells and of settings (``plain`` codes) are not. Zero stays as it is.
    """

    def __init__(self, stream: BinaryIO, increment_mm: float | None, plain: Collection[str], *, inch: bool) -> None:
        self._stream, self._plain, self._inch, self._drills = stream, plain, inch, False
        self._increment = None if increment_mm is None else Decimal(repr(increment_mm))
        #: Whether a number has been given its point.
        self.used = False

    def __enter__(self) -> Pointed:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()

    def read(self, size: int) -> bytes:
        """Return the next lines, at least ``size`` bytes of the program if there are so many."""
        text = self._stream.read(size)
        text += self._stream.readline(_LONGEST_LINE) if text and not text.endswith(b"\n") else b""
        return b"".join(map(self._line, text.splitlines(keepends=True)))

    def _line(self, line: bytes) -> bytes:
        code = _LATER["fanuc"].sub(lambda part: b" " * len(part[0]), line)
        codes = [f"G{float(found[1]):g}" for found in _G_CODE.finditer(code)]
        for name in codes:
            self._inch = name == "G20" or (self._inch and name != "G21")
            self._drills = name in _DRILLS or (self._drills and name not in _ENDS_DRILLING)
        if any(name in self._plain for name in codes):
            return line
        counts = self._drills and not re.search(rb"[IJ]\s*[-+.\d]", code, re.IGNORECASE)
        for word in reversed(list(_INTEGER.finditer(code))):
            letter, number = word[1].upper(), re.sub(rb"\s", b"", word[2])
            if int(number) and not (counts and letter == b"K"):
                self.used = True
                line = line[: word.start(2)] + self._pointed(letter, number.decode()) + line[word.end(2) :]
        return line

    def _pointed(self, letter: bytes, number: str) -> bytes:
        if self._increment is None:
            return f"{number}.".encode()
        tenth = self._inch and letter not in b"ABC"
        text = f"{Decimal(number) * self._increment * (Decimal('0.1') if tenth else 1):f}"
        text = text.rstrip("0") if "." in text else f"{text}."
        return (f"+{text}" if number[0] == "+" else text).encode()


def written_out(source: Path, dialect: str, *, skip_deleted: bool = False) -> WrittenOut | None:
    """Return a program of FANUC, Haas or LinuxCNC with its calls written out; None if it calls nothing that is in its file.

    The corrected program has no calls left. Calls of programs in other files stay for the reader to refuse.
    ``skip_deleted``: the control skips blocks with ``/``.
    """
    with source.open("rb") as stream:
        before = b""
        while chunk := stream.read(1 << 20):
            if _MENTIONED.search(before + chunk):
                break
            before = chunk[-64:]
        else:
            return None
    return _Program(source, dialect, skip_deleted).written_out()


class _Program:
    """The blocks of a file, where its subprograms begin, and what is written while calls are followed."""

    def __init__(self, source: Path, dialect: str, skip_deleted: bool) -> None:
        self.source, self.haas = source, dialect == "fanuc"
        self.blocks: Sequence[_Block] = []
        for text in source.read_bytes().splitlines(keepends=True):
            slash = _SKIPPED.match(text) is not None
            code = b"" if slash and skip_deleted else _LATER[dialect].sub(lambda part: b" " * len(part[0]), text)
            self.blocks.append(_Block(text, code, slash))
        self.starts: dict[bytes, list[int]] = {}
        for k, block in enumerate(self.blocks):
            if (name := block.number(b"O:")) is not None:
                self.starts.setdefault(b"O" + name, []).append(k)
        self.ends = [k for k, block in enumerate(self.blocks) if block.has(2, 30)]
        self.out: list[bytes] = []
        self.origin: list[int] = []
        self.called: dict[str, int] = {}

    def written_out(self) -> WrittenOut | None:
        """Follow the program from its first block to the one that ends it."""
        stop = self.ends[0] + 1 if self.ends else len(self.blocks)
        self._follow(range(stop), 0)
        if not self.called:
            return None
        for k in range(stop, len(self.blocks)):
            if self.blocks[k].code.strip() == b"%":
                self._add(self.blocks[k].text, k)
        said = tuple(f"{name} ({count} times)" if count > 1 else name for name, count in self.called.items())
        return WrittenOut(b"".join(self.out), np.array(self.origin), said)

    def _fail(self, message: str, k: int) -> NoReturn:
        raise InputError(message, file=self.source, line=k + 1)

    def _add(self, text: bytes, k: int) -> None:
        if len(self.out) > _MOST_BLOCKS:
            self._fail("calls make the program longer than 5e6 blocks; divide it", k)
        self.out.append(text)
        self.origin.append(k + 1)

    def _follow(self, rows: range, depth: int) -> None:
        for k in rows:
            block = self.blocks[k]
            back = depth > 0 and block.has(99)
            target = self._target(k) if block.has(97, 98) else None
            if target is None and not back:
                self._add(block.text, k)
                continue
            if block.slash:
                what = "returns from" if back else "calls"
                self._fail(f"{what} a subprogram in a block with /; post it without", k)
            if back and target is None and block.given(b"P") is not None:
                self._fail("returns to another block than that of its call; post M99", k)
            name, first, repeats = target or (b"", 0, 0)
            self._write_rest(k, name, repeats)
            if target is None:
                continue
            if depth == _DEEPEST:
                self._fail(f"calls are deeper than {_DEEPEST}, or call themselves", k)
            rows_called = self._body(first, name, k)
            self.called[name.decode()] = self.called.get(name.decode(), 0) + repeats
            for _ in range(repeats):
                self._follow(rows_called, depth + 1)

    def _write_rest(self, k: int, name: bytes, repeats: int) -> None:
        """Write what a block with a call or return does beside it, and what it called as a comment."""
        rest = self.blocks[k].without(b"PL" if name else b"")
        if name:
            said = name.decode() + (f" {repeats} times" if repeats != 1 else "")
            head = rest.rstrip(b"\r\n; ")
            rest = head + b" " * bool(head.strip()) + f"({said})".encode() + rest[len(head) :]
        if re.sub(rb"\s*/?\s*(N\d+)?[\s;]*", b"", rest):
            self._add(rest, k)

    def _target(self, k: int) -> tuple[bytes, int, int] | None:
        """Name of what a block calls, the block with which that begins, and how often; None if it is not in the file.

        ``P1001 L3``, or ``P31001`` of FANUC for 3 times O1001.
        """
        block = self.blocks[k]
        local, given, times = block.has(97), block.given(b"P"), block.given(b"L")
        if (local and not self.haas) or given is None or given != int(given) or given < 0:
            return None
        if times is not None and (times != int(times) or times < 0 or (times == 0 and self.haas)):
            self._fail(
                f"L{times:g} is no number of repeats that is followed; post the call without L, or with L1 or more", k
            )
        number, repeats = b"%d" % int(given), 1 if times is None else int(times)
        found = self._labels(number, k) if local else self.starts.get(b"O" + number, [])
        if not local and times is None and len(number) > 4:
            short = number[-4:].lstrip(b"0") or b"0"
            others = self.starts.get(b"O" + short, [])
            if others and found:
                self._fail(f"P{int(given)} may be O{int(given)}, or O{short.decode()} several times; post L", k)
            if others:
                repeats, number, found = int(number[:-4]), short, others
        if not found:
            return None
        self._check_call(k, local, number, found)
        return (b"N" if local else b"O") + number, found[0] + (not local), repeats

    def _check_call(self, k: int, local: bool, number: bytes, found: list[int]) -> None:
        name = f"{'N' if local else 'O'}{number.decode()}"
        if len(found) > 1:
            self._fail(
                f"calls {name}, which begins in lines {found[0] + 1} and {found[1] + 1}; give each its own number", k
            )
        others = {letter for letter, _ in self.blocks[k].words} - {b"N", b"M", b"P", b"L"}
        codes = [value for letter, value in self.blocks[k].words if letter == b"M"]
        if others & {b"Q", b"H"}:
            self._fail("calls a block within a subprogram; post M98 with P and L alone", k)
        if not self.haas and (others or len(codes) > 1):
            self._fail("has other words beside M98, which the control does not execute; divide the block", k)

    def _labels(self, number: bytes, k: int) -> list[int]:
        """Blocks with a number in the program, between two O numbers, that block ``k`` belongs to."""
        heads = sorted(start for starts in self.starts.values() for start in starts)
        low = max((head for head in heads if head <= k), default=0)
        high = min((head for head in heads if head > k), default=len(self.blocks))
        return [j for j in range(low, high) if self.blocks[j].number(b"N") == number]

    def _body(self, first: int, name: bytes, k: int) -> range:
        """Lines of a subprogram, from its number to its M99."""
        for j in self._rows_of(first):
            if self.blocks[j].has(99):
                return range(first, j + 1)
        self._fail(f"calls {name.decode()}, which does not end with M99; give the whole program", k)

    def _rows_of(self, first: int) -> Iterator[int]:
        for j in range(first, len(self.blocks)):
            if j > first and self.blocks[j].number(b"O:") is not None:
                return
            yield j
