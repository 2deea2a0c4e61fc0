"""Reading foreign files: limits of size, encodings, and what a file is that cannot be read at all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from compgen.core.files import read_bytes
from compgen.errors import InputError

MEGABYTE = 1_000_000
#: Larger files are no measurement in text form: a million tracer lengths have 80 MB.
MOST_BYTES = 128 * MEGABYTE
#: The project's own files are read faster, but they too fit into the memory of a workstation.
MOST_OWN_BYTES = 256 * MEGABYTE
#: Larger numbers are none (a number of 400 digits becomes infinite).
LARGEST = 1e300
#: So much of a file says what it is.
HEAD_BYTES = 65_536
#: Encodings that are tried in turn when there is no mark; the last one reads everything.
ENCODINGS = ("utf-8", "cp1252", "latin-1")
#: Instruments of one maker write user text in the code page of the computer (see :mod:`compgen.imports.renishaw`).
ENCODINGS_EAST = ("utf-8", "gbk", "latin-1")
#: Position, deviation, error, forward, backward, temperature, positioning; two characters are not met by chance.
_CHINESE = (
    "\u4f4d\u7f6e",
    "\u504f\u5dee",
    "\u8bef\u5dee",
    "\u6b63\u5411",
    "\u53cd\u5411",
    "\u6e29\u5ea6",
    "\u5b9a\u4f4d",
)
_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_BINARY = (
    (b"\xd0\xcf\x11\xe0", "an old Excel workbook (.xls) or one with a password; save it as .xlsx without a password"),
    (b"%PDF", "a PDF; export the numbers as text or .xlsx"),
    (b"\x1f\x8b", "compressed (gzip); unpack it first"),
    (b"7z\xbc\xaf", "compressed (7z); unpack it first"),
    (b"Rar!", "compressed (rar); unpack it first"),
    (b"\x89PNG", "a picture; the numbers themselves are needed"),
    (b"\xff\xd8\xff", "a picture; the numbers themselves are needed"),
)
_MARKUP = ("<?xml", "<!doctype", "<html", "<svg")


@dataclass(frozen=True)
class Text:
    """A text file as it was read, its line ends made line feeds, and the encoding that it turned out to have."""

    path: Path
    text: str
    encoding: str

    def fail(self, message: str, line: int | None = None, field: str | None = None) -> InputError:
        """Return the error that points at a line of this file (counting from 1)."""
        return InputError(message, file=self.path, line=line, field=field)

    @property
    def ended(self) -> bool:
        """Whether the last line has a line end."""
        return self.text.endswith("\n")


def check_size(path: Path, most: int = MOST_BYTES) -> int:
    """Return the size in bytes; InputError for a file that is missing, no file, empty or too large to be meant."""
    if path.is_dir():
        raise InputError("is a folder; a file is needed", file=path)
    try:
        size = os.stat(path).st_size
    except FileNotFoundError:
        raise InputError("no such file", file=path) from None
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror or error}", file=path) from error
    if size > most:
        raise InputError(
            f"has {size / MEGABYTE:.0f} MB; at most {most / MEGABYTE:.0f} MB are read, more than a million readings need; "
            "is it the right file? If so, thin it out or split it",
            file=path,
        )
    if size == 0:
        raise InputError("is empty", file=path)
    return size


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file; InputError for kinds of file that hold no readable numbers."""
    head = read_bytes(path, HEAD_BYTES)
    for mark, what in _BINARY:
        if head.startswith(mark):
            raise InputError(f"is {what}", file=path)
    return head


def decode_head(head: bytes) -> str:
    """Return the beginning of a file as text for a look at what it is; nothing is refused here."""
    encoding = next((name for mark, name in _MARKS if head.startswith(mark)), None) or _without_mark(head) or "utf-8"
    return head.decode(encoding, errors="replace").replace("\r\n", "\n").replace("\r", "\n")


def read_source(path: Path, encodings: Sequence[str] = ENCODINGS, most: int = MOST_BYTES) -> Text:
    """Read a text file in whatever encoding it has.

    A byte-order mark counts; zero bytes in every second place mean UTF-16; then ``encodings`` in turn.
    """
    check_size(path, most)
    content = read_bytes(path)
    encoding, text = _decode(path, content, encodings)
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    if text.lstrip().lower().startswith(_MARKUP):
        raise InputError("is XML or HTML; export the numbers as text (CSV) or .xlsx", file=path)
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise InputError("holds NUL bytes: it is no text, or was not written to its end", file=path, line=line)
    return Text(path, text, encoding)


def _decode(path: Path, content: bytes, encodings: Sequence[str]) -> tuple[str, str]:
    marked = next((name for mark, name in _MARKS if content.startswith(mark)), None)
    chosen = [marked] if marked else [_without_mark(content[:HEAD_BYTES]) or "", *encodings]
    for encoding in filter(None, chosen):
        try:
            if encoding == "cp1252" and _is_chinese(content[:HEAD_BYTES]):
                return "gb18030", content.decode("gb18030")
            return encoding, content.decode(encoding).lstrip("\ufeff")
        except UnicodeDecodeError as error:
            if encoding.startswith("utf-16"):
                raise InputError(f"is cut or damaged UTF-16 text: {error.reason}", file=path) from error
            if encoding == chosen[-1]:
                line = content[: error.start].count(b"\n") + 1
                raise InputError("is not UTF-8 text though its mark says so", file=path, line=line) from error
    raise InputError("is text in no known encoding; save it as UTF-8", file=path)


def _is_chinese(head: bytes) -> bool:
    """Whether text that is not UTF-8 shows words of a measurement in the code page of China."""
    text = head.decode("gb18030", errors="ignore")
    return sum(text.count(word) for word in _CHINESE) >= 1


def _without_mark(head: bytes) -> str | None:
    """UTF-16 without a mark: Latin letters and digits leave every second byte zero."""
    if len(head) < 4 or b"\0" not in head:
        return None
    even, odd = head[0::2].count(0) / len(head[0::2]), head[1::2].count(0) / len(head[1::2])
    if odd > 0.6 and even < 0.2:
        return "utf-16-le"
    return "utf-16-be" if even > 0.6 and odd < 0.2 else None


def parse_number(word: str) -> float | None:
    """Return a plain finite number, decimal point or comma, or None for anything else.

    >>> parse_number("-.0033"), parse_number("1,25"), parse_number("1_0"), parse_number("inf")
    (-0.0033, 1.25, None, None)
    """
    try:
        plain = float(word)
    except ValueError:
        plain = LARGEST
    if abs(plain) < LARGEST and word.isascii() and "_" not in word:
        return plain
    text = word.strip().replace("\u2212", "-")
    if text.count(",") == 1 and "." not in text:
        text = text.replace(",", ".")
    if not text.isascii() or not any(char.isdigit() for char in text) or "_" in text:
        return None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if abs(value) < LARGEST else None


def shown(word: object, most: int = 40) -> str:
    """Return a cell of a user's file for a message: one line, short, in its own script; repr escapes what is not printable."""
    return repr(" ".join(str(word).split())[:most])
