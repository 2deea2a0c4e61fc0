"""Subprograms in the file of their program: every call is written out, since each place needs its own correction.

``M98 P1001 L3`` calls the blocks from ``O1001`` to ``M99`` three times, as does ``M98 P31001`` of FANUC; ``M97 P100`` of
Haas those from ``N100``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgen.errors import InputError
from compgen.programs.path import IntArray

#: Calls within calls, and blocks of a program that is written out.
_DEEPEST, _MOST_BLOCKS = 10, 5_000_000
_CALL = re.compile(rb"M0*9([78])(?!\d)", re.IGNORECASE)
_WORDS = re.compile(rb"\s*(?:M0*9[789](?!\d)|[PL]\s*\d+)", re.IGNORECASE)
_RETURN = re.compile(rb"M0*99(?!\d)", re.IGNORECASE)
_COMMENT = re.compile(rb"\([^()\n]*\)")


@dataclass(frozen=True)
class WrittenOut:
    """A program with its calls written out; ``line`` (n,) is for each of its lines the one in the file it is from."""

    content: bytes
    line: IntArray
    called: tuple[str, ...]


def written_out(source: Path) -> WrittenOut | None:
    """Return a program of FANUC, Haas or LinuxCNC with its calls written out; None if it calls nothing that is in its file.

    The corrected program has no calls left. Calls of programs in other files stay for the reader to refuse.
    """
    with source.open("rb") as stream:
        before = b""
        while chunk := stream.read(1 << 20):
            if _CALL.search(before + chunk + b" "):
                break
            before = chunk[-16:]
        else:
            return None
    lines = source.read_bytes().splitlines(keepends=True)
    plain = [_COMMENT.sub(b"", line) for line in lines]
    found = [(re.match(rb"\s*[O:]\s*0*(\d+)", line, re.IGNORECASE), k) for k, line in enumerate(plain)]
    begin = {b"O" + name[1]: k + 1 for name, k in found if name}
    labels = [(re.match(rb"\s*N\s*0*(\d+)(?=\D)", line, re.IGNORECASE), k) for k, line in enumerate(plain)]
    for name, k in labels:
        if name:
            begin.setdefault(b"N" + name[1], k)
    numbers = [k for name, k in found if name]
    last = (k + 1 for k, line in enumerate(plain) if re.search(rb"M0*(2|30)(?!\d)", line, re.IGNORECASE))
    first = next(last, len(lines))
    out: list[bytes] = []
    origin: list[int] = []
    called: dict[str, int] = {}

    def body(name: bytes, number: int) -> range:
        """Lines of a subprogram, from its number to its M99."""
        for k in range(begin[name], len(lines)):
            if _RETURN.search(plain[k]):
                return range(begin[name], k + 1)
            if k in numbers:
                break
        said = name.decode()
        raise InputError(f"calls {said}, which does not end with M99; give the whole program", file=source, line=number)

    def add(block: bytes, k: int) -> None:
        if len(out) > _MOST_BLOCKS:
            raise InputError("calls make the program longer than 5e6 blocks; divide it", file=source, line=k + 1)
        out.append(block)
        origin.append(k + 1)

    def follow(rows: range, depth: int) -> None:
        for k in rows:
            call = _CALL.search(plain[k])
            back = depth > 0 and _RETURN.search(plain[k]) is not None
            if not call and not back:
                add(lines[k], k)
                continue
            name, repeats = _called(plain[k], begin) if call else (b"", 0)
            if call and plain[k].lstrip().startswith(b"/"):
                raise InputError("calls a subprogram in a block with /; post it without", file=source, line=k + 1)
            if call and name not in begin:
                add(lines[k], k)
                continue
            rest = _WORDS.sub(b"", lines[k])
            if back and re.search(rb"P\s*\d", plain[k]) and not call:
                raise InputError("returns to another block than that of its call; post M99", file=source, line=k + 1)
            if call:
                said = name.decode() + (f" {repeats} times" if repeats != 1 else "")
                head = rest.rstrip(b"\r\n; ")
                rest = head + b" " * bool(head.strip()) + f"({said})".encode() + rest[len(head) :]
            if re.sub(rb"\s*/?\s*(N\d+)?[\s;]*", b"", rest):
                add(rest, k)
            if call:
                if depth == _DEEPEST:
                    raise InputError(f"calls are deeper than {_DEEPEST}, or call themselves", file=source, line=k + 1)
                called[name.decode()] = called.get(name.decode(), 0) + repeats
                rows_called = body(name, k + 1)
                for _ in range(repeats):
                    follow(rows_called, depth + 1)

    follow(range(first), 0)
    if not called:
        return None
    for k in range(first, len(lines)):
        if plain[k].strip() == b"%":
            add(lines[k], k)
    said = tuple(f"{name} ({count} times)" if count > 1 else name for name, count in called.items())
    return WrittenOut(b"".join(out), np.array(origin), said)


def _called(block: bytes, begin: dict[bytes, int]) -> tuple[bytes, int]:
    """Name of what a block with a call executes, and how often: P1001 L3, or P31001 for 3 times O1001."""
    kind = b"N" if re.search(rb"M0*97", block, re.IGNORECASE) else b"O"
    given = [re.search(letter + rb"\s*0*(\d+)", block, re.IGNORECASE) for letter in (b"P", b"L")]
    number, repeats = given[0][1] if given[0] else b"", int(given[1][1]) if given[1] else 1
    if kind + number not in begin and kind == b"O" and len(number) > 4 and not given[1]:
        repeats, number = int(number[:-4]), number[-4:].lstrip(b"0") or b"0"
    return kind + number, repeats
