"""Programs of SINUMERIK as their control executes them: calls of files written out, variables that are constant as numbers.

``HOLE``, ``L10 P2``, ``CALL "HOLE"``, ``EXTCALL "HOLE.SPF"`` and ``STEP(R1, 5)`` call a file of a folder that is given, to its
M17, RET, M2 or M30. R parameters belong to all, names of DEF and PROC to the file. What is not found, or not known before the
program runs, stays for :class:`compgen.programs.reader.Reader` to refuse. Source: SIEMENS, SINUMERIK Programming Manual.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from compgen.errors import InputError, visible_line
from compgen.programs.dialects import VALUE
from compgen.programs.subprograms import (
    DEEPEST,
    FUNCTIONS,
    MOST_BLOCKS,
    MOST_NESTED,
    NotKnown,
    Turn,
    WrittenOut,
    file_of,
    mentions,
)

_FUNCTIONS: dict[str, Callable[..., float]] = {
    **{name: FUNCTIONS[name] for name in ("ABS", "ACOS", "ASIN", "COS", "EXP", "LN", "ROUND", "SIN", "SQRT", "TAN")},
    "ATAN2": lambda y, x: math.degrees(math.atan2(y, x)),
    "POT": lambda x: x * x,
    "TRUNC": lambda x: float(math.trunc(x)),
}
_LEVELS: tuple[dict[str, Callable[[float, float], float]], ...] = (
    {"+": operator.add, "-": operator.sub},
    {"*": operator.mul, "/": operator.truediv, "DIV": lambda a, b: float(math.trunc(a / b)), "MOD": math.fmod},
)
_TOKEN = re.compile(r"\s*+([-+*/(),]|[A-Z_][A-Z_0-9]*+|\d++\.?\d*+|\.\d++)", re.IGNORECASE)
_HEAD = re.compile(r"\s*+(?:/\d?\s*+)?(?:N\s*+\d++\s*+)?", re.IGNORECASE)
_NOT_CODE = re.compile(r"\"[^\"\n]*+\"|;[^\n]*+")
_R_ASSIGNMENT = re.compile(r"(R\s*+\d++|[A-Z_]{2}[A-Z_0-9]*+|[A-Z])\s*+=(?!=)", re.IGNORECASE)
_ADDRESS = re.compile(r"(?<![A-Z0-9_.])([A-Z_][A-Z_0-9]*+(?:\s*+\[[^\[\]\n]*+\])?)\s*+=(?!=)\s*+", re.IGNORECASE)
_WITH_ARGUMENTS = re.compile(r"(?<![A-Z0-9_])(M?CALL\s++)?([A-Z_][A-Z_0-9]++)\s*+\(", re.IGNORECASE)
_MODES = frozenset(("AC", "IC", "DC", "ACP", "ACN"))
_DEFINED = re.compile(r"DEF\s++(?:REAL|INT)\s++(.+)", re.IGNORECASE)
_CALL = re.compile(
    r"(?:CALL\s*+(?P<call>\"[^\"\n]++\")|EXTCALL\s*+\(?\s*+(?P<external>\"[^\"\n]++\")\s*+\)?"
    r"|(?P<name>L\d++|[A-Z_]{2}[A-Z_0-9]*+))\s*+(?:\((?P<inside>[^()\n]*+)\))?\s*+(?:P\s*+=?\s*+(?P<times>\d++))?\s*+",
    re.IGNORECASE,
)
_PROCEDURE = re.compile(r"PROC\s++([A-Z_][A-Z_0-9]*+)\s*+(?:\(([^()\n]*+)\))?\s*+(.*)", re.IGNORECASE)
_ENDS = re.compile(r"(?<![A-Z0-9_])(?:M0*(?:17|2|30)(?![\d.=])|RET(?![A-Z_]))", re.IGNORECASE)
#: What makes a program one that is followed here: variables, formulas, and names that begin a block.
_COMPUTES = (
    re.compile(rb"R\s*+\d++\s*+="),
    re.compile(
        rb"=[ \t]*+[-+]?[ \t]*+(?:\(|R\d|[\d.]++[ \t]*+[-+*/]|(?:"
        + "|".join([*FUNCTIONS, "ATAN2", "POT", "TRUNC"]).encode()
        + rb")[ \t]*+\()"
    ),
    re.compile(rb"DEF\s"),
    re.compile(rb"ROT[ \t]++[A-Z]"),
)
_BEGINS = re.compile(
    rb"^[ \t]*+(?:/\d?[ \t]*+)?(?:N[ \t]*+\d++[ \t]*+)?(L\d++|[A-Z_]{2}[A-Z_0-9]*+)", re.IGNORECASE | re.MULTILINE
)


#: Rotation about Z: in the plane G17 as RPL.
_ROTATION = re.compile(rf"(A?ROT)(?:\s*+RPL\s*+=\s*+({VALUE})|\s*+Z\s*+=?\s*+({VALUE}))?")


def _blanked(text: str) -> str:
    """The text with blanks in place of comments."""
    return _NOT_CODE.sub(lambda part: part[0] if part[0][0] == '"' else " " * len(part[0]), text)


@dataclass
class _Formula:
    """An expression of SINUMERIK, read from ``at`` on; ``known`` are its variables."""

    text: str
    at: int
    known: Callable[[str], float]
    depth: int = 0

    def value(self, level: int = 0) -> float:
        """Read what operators of this level and those that bind more leave."""
        if level == len(_LEVELS):
            return self._single()
        found = self.value(level + 1)
        while (word := self._next()) in _LEVELS[level]:
            self._take()
            found = _LEVELS[level][word](found, self.value(level + 1))
        return found

    def _next(self) -> str:
        word = _TOKEN.match(self.text, self.at)
        return word[1].upper() if word else ""

    def _take(self) -> None:
        word = _TOKEN.match(self.text, self.at)
        self.at = word.end() if word else self.at

    def _single(self) -> float:
        word = self._next()
        self._take()
        if word in ("+", "-"):
            return self._single() * (-1.0 if word == "-" else 1.0)
        self.depth += 1
        if not word or self.depth > 20 * MOST_NESTED:
            raise NotKnown(f"{self.text[self.at :].strip()[:20]!r} is no number")
        if word[0].isdigit() or word[0] == ".":
            return float(word)
        if word == "(":
            found = self.value()
            self._close()
            return found
        if word in _FUNCTIONS and self._next() == "(":
            self._take()
            given = [self.value()]
            while self._next() == ",":
                self._take()
                given.append(self.value())
            self._close()
            if len(given) != 1 + (word == "ATAN2"):
                raise NotKnown(f"{word} has {len(given)} numbers")
            return float(_FUNCTIONS[word](*given))
        return self.known(word)

    def _close(self) -> None:
        if self._next() != ")":
            raise NotKnown("a parenthesis is not closed")
        self._take()


def called_and_computed(
    source: Path, names: Collection[str], *, skip_deleted: bool = False, folders: Sequence[Path] = ()
) -> WrittenOut | None:
    """Return a program of SINUMERIK with calls of files written out and variables as numbers; None if it has none.

    ``names`` are those that the dialect knows and that call nothing. What is not found, or not known before the program runs,
    stays for the reader to refuse.
    """
    computes = mentions(source, _COMPUTES)
    begins = {name.upper().decode() for name in _BEGINS.findall(source.read_bytes())} if folders else set()
    if not computes and not begins - set(names):
        return None
    program = _Program(source, names, skip_deleted, folders)
    program.follow(source, program.lines_of(source), 0)
    if not program.changed:
        return None
    places, text = program.places, "".join(program.out).encode("latin-1")
    return WrittenOut(
        text, np.array(program.main_lines), tuple(program.called), places, resolved=True, variables=tuple(program.used)
    )


class _Program:
    """What is written while a program of SINUMERIK and the files that it calls are followed."""

    def __init__(self, source: Path, names: Collection[str], skip_deleted: bool, folders: Sequence[Path]) -> None:
        self.source, self.names, self.skip_deleted, self.folders = source, names, skip_deleted, folders
        self.out: list[str] = []
        self.places: list[tuple[Path, int]] = []
        self.main_lines: list[int] = []
        self.parameters: dict[str, float] = {}
        self.local: dict[str, float] = {}
        self.used: dict[str, None] = {}
        self.called: dict[str, None] = {}
        self.changed = False
        self.turn = Turn(self._fail_here, 5)
        self._main_line = 1
        self.at: tuple[Path, int] = (source, 1)

    def lines_of(self, path: Path) -> list[str]:
        """Lines of a file, bytes as characters."""
        return path.read_bytes().decode("latin-1").splitlines(keepends=True) if path else []

    def fail(self, message: str, text: str = "") -> NoReturn:
        """Refuse what is in the block that is followed."""
        shown = f" (block: {visible_line(text.strip())[:60]})" if text else ""
        raise InputError(message + shown, file=self.at[0], line=self.at[1])

    def _fail_here(self, message: str) -> NoReturn:
        self.fail(message)

    def follow(self, path: Path, lines: Sequence[str], depth: int) -> None:
        """Follow blocks of a file; of one that is called to its end."""
        for number, text in enumerate(lines, 1):
            self.at = path, number
            if path == self.source:
                self._main_line = number
            # a text or comment leaves a mark of its length, so that places stay
            code = _NOT_CODE.sub(lambda part: part[0] if part[0][0] == '"' else " " * len(part[0]), text)
            if depth and re.match(r"\s*(?:%|;\$)", text):
                continue
            head = _HEAD.match(code)
            start = head.end() if head else 0
            slash = code.lstrip().startswith("/")
            if not code.strip() or (slash and self.skip_deleted) or code.lstrip().startswith("%"):
                self.add(text)
            elif not self._call(code, start, text, depth, slash):
                body = self._with_numbers(code, start, text, slash)
                body = None if body is None else self._turned(body, start, slash)
                ends = depth and _ENDS.search(code, start)
                if body is not None:
                    self.add(self._without_end(body) if ends else body)
                if ends:
                    return
        if depth:
            self.fail("the subprogram ends without M17 or RET: it may have been cut; give all of it")

    def _turned(self, text: str, start: int, slash: bool) -> str | None:
        """The block without the rotation that is in force: ROT RPL=30, AROT Z45, to ROT or TRANS; None if it is that."""
        code = _blanked(text)
        bare = code[start:].strip().upper()
        codes = self.turn.codes(code[start:])
        found = _ROTATION.fullmatch(bare)
        if found is None:
            if re.match(r"TRANS\b", bare):
                self.turn.end()
            elif self.turn.on and re.match(r"(?:A?(?:ROT|SCALE|MIRROR)|ATRANS|ROTS|AROTS|CYCLE800)\b", bare):
                self.fail("changes coordinates that are turned; end the turn by ROT before", text)
            if self.turn.on:
                self.changed = True
                return self.turn.block(text, code, codes)
            return text
        if slash:
            self.fail("turns coordinates in a block with /; post it without", text)
        kind, number = found[1], found[2] or found[3]
        if number is None and not self.turn.on and kind == "ROT":
            return text
        if kind == "ROT":  # ends the shift as well
            self.turn.end()
            self.add(f"TRANS{text[len(text.rstrip()) :]}")
        if number is not None:
            self.turn.begin(float(re.sub(r"\s", "", number)) + (self.turn.angle_deg if self.turn.on else 0.0), 0j)
        self._comment(text)
        return None

    @staticmethod
    def _without_end(text: str) -> str:
        code, mark, comment = text.partition(";")
        return _ENDS.sub("", code) + mark + comment

    def add(self, text: str) -> None:
        """Write a line."""
        if len(self.out) > MOST_BLOCKS:
            self.fail("calls make the program longer than 5e6 blocks; divide it")
        if text.strip():
            self.out.append(text if text.endswith("\n") else f"{text}\n")
            self.places.append(self.at)
            self.main_lines.append(self._main_line)

    def _comment(self, text: str) -> None:
        self.changed = True
        self.add(f"; {text.strip()}{text[len(text.rstrip()) :]}")

    def _call(self, code: str, start: int, text: str, depth: int, slash: bool) -> bool:
        """Follow a call of a file; whether the block is one."""
        found = _CALL.fullmatch(code.rstrip(), start)
        if found is None or (found["name"] and found["name"].upper() in self.names):
            return False
        given = found["name"] or found["call"] or found["external"]
        name = re.split(r"[/\\:]", given.strip('"'))[-1].upper()
        name = re.sub(r"^_N_(\w+)_(?:SPF|MPF)$", r"\1", name)
        stem = re.escape(re.sub(r"\.(?:SPF|MPF)$", "", name))
        path = file_of(rf"(?:_N_)?{stem}(?:[._](?:SPF|MPF))?", self.folders, name, self.at)
        if path is None:
            return False
        if slash:
            self.fail("calls a subprogram in a block with /; post it without", text)
        if depth == DEEPEST:
            self.fail(f"calls are deeper than {DEEPEST}, or call themselves", text)
        times = int(found["times"]) if found["times"] else 1
        if not 1 <= times <= 9999:
            self.fail(f"P{times} is no number of repeats", text)
        values = [self._argument(part, text) for part in self._parts(found["inside"])]
        self._comment(text)
        said = f"{stem} of {path.name}" + (f" ({times} times)" if times > 1 else "")
        self.called[said] = None
        lines, kept, here = self.lines_of(path), self.local, self.at
        for _ in range(times):
            self.local = {}
            first = self._procedure(path, lines, values, text)
            padded = [*("\n" for _ in range(first)), *lines[first:]]
            self.follow(path, padded, depth + 1)
        self.local, self.at = kept, here
        return True

    def _parts(self, inside: str | None) -> list[str]:
        return [part.strip() for part in inside.split(",")] if inside and inside.strip() else []

    def _argument(self, part: str, text: str) -> float | None:
        return self._evaluated(part, text) if part else None

    def _procedure(self, path: Path, lines: Sequence[str], values: Sequence[float | None], text: str) -> int:
        """Give the names of PROC their values; returns how many lines are its head."""
        for k, line in enumerate(lines):
            code = _NOT_CODE.sub("", line).strip()
            if not code or code.startswith("%"):
                continue
            found = _PROCEDURE.match(code[_HEAD.match(code).end() :])  # type: ignore[union-attr]
            if found is None:
                break
            if re.search(r"\bSAVE\b", found[3], re.IGNORECASE):
                self.fail(
                    f"calls {path.name}, whose PROC has SAVE: modal codes that are kept and restored are not followed",
                    text,
                )
            given = list(values)
            for part in self._parts(found[2]):
                one = re.fullmatch(r"(?:REAL|INT)\s+([A-Z_]\w*)\s*(?:=\s*(.+))?", part, re.IGNORECASE)
                if one is None:
                    self.fail(
                        f"calls {path.name}, whose parameter {part[:30]!r} is not followed (REAL and INT are)", text
                    )
                value = given.pop(0) if given else None
                if value is None:
                    value = self._evaluated(one[2], text) if one[2] else 0.0
                self.local[one[1].upper()] = value
            if given:
                self.fail(f"calls {path.name} with more parameters than it has", text)
            return k + 1
        if values:
            self.fail(f"calls {path.name} with parameters, and it has no PROC", text)
        return 0

    # Values.

    def _known(self, name: str) -> float:
        key = re.sub(r"^R0*(?=\d)", "R", name.upper())
        for home in (self.local, self.parameters):
            if key in home:
                self.used[key] = None
                return home[key]
        raise NotKnown(f"{name} is not known before the program runs")

    def _evaluated(self, part: str, text: str) -> float:
        formula = _Formula(part, 0, self._known)
        found = self._read(formula, text)
        if formula.text[formula.at :].strip():
            self.fail(f"{part.strip()[:20]!r}: variables and expressions are followed where they are constant", text)
        return found

    def _read(self, formula: _Formula, text: str) -> float:
        try:
            found = formula.value()
            if not math.isfinite(found) or abs(found) >= 1e9:
                raise NotKnown("it has no value")
            return found
        except (NotKnown, ArithmeticError, ValueError, TypeError, RecursionError) as error:
            why = str(error) if isinstance(error, NotKnown) else "it has no value"
            self.fail(
                f"{why}: variables and expressions are followed where they are constant; post the program with numbers",
                text,
            )

    def _with_numbers(self, code: str, start: int, text: str, slash: bool) -> str | None:
        """The block with numbers in place of variables; None if it only assigns some, and is written as a comment."""
        bare = code[start:].strip()
        if found := _DEFINED.fullmatch(bare):
            self._define(found[1], text)
            return None
        if (head := _R_ASSIGNMENT.match(code, start)) and self._is_variable(head[1]):
            if slash:
                self.fail("variables in a block with /: whether it counts is not known; post it without", text)
            self._assign(code, start, text)
            return None
        return self._arguments_as_numbers(*self._words_as_numbers(code, start, text))

    def _is_variable(self, name: str) -> bool:
        key = re.sub(r"\s", "", name).upper()
        return key in self.local or re.fullmatch(r"R\d+", key) is not None

    def _define(self, names: str, text: str) -> None:
        for part in names.split(","):
            one = re.fullmatch(r"\s*([A-Z_]\w*)\s*(?:=\s*(.+))?", part.strip(), re.IGNORECASE)
            if one is None:
                self.fail(
                    "DEF of what is no single number: variables are followed as REAL and INT with constant values", text
                )
            self.local[one[1].upper()] = self._evaluated(one[2], text) if one[2] else 0.0
        self._comment(text)

    def _assign(self, code: str, at: int, text: str) -> None:
        new: dict[str, float] = {}
        while code[at:].strip():
            word = _R_ASSIGNMENT.match(code, at)
            if word is None or not self._is_variable(word[1]):
                self.fail("variables and expressions: assigns a variable beside other words; divide the block", text)
            formula = _Formula(code, word.end(), self._known)
            key = re.sub(r"\s", "", word[1]).upper()
            new[re.sub(r"^R0*(?=\d)", "R", key)] = self._read(formula, text)
            at = formula.at
            at += len(code[at:]) - len(code[at:].lstrip())
        for key, value in new.items():
            (self.local if key in self.local else self.parameters)[key] = value
        self._comment(text)

    def _words_as_numbers(self, code: str, start: int, text: str) -> tuple[str, str, str]:
        """Put numbers for expressions after ``=``: X=R1+5, CR=R2, X=IC(R3), F=R4."""
        pieces, at = [text[:start]], start
        for word in _ADDRESS.finditer(code, start):
            if word.start() < at:
                continue
            begin = word.end()
            mode = re.match(r"([A-Z]+)\s*\(", code[begin:], re.IGNORECASE)
            inside = mode is not None and mode[1].upper() in _MODES
            if not inside and not re.match(r"[-+]?\s*(?:[\d.(]|[A-Z_])", code[begin:], re.IGNORECASE):
                continue
            formula = _Formula(code, begin + (mode.end() if mode and inside else 0), self._known)
            first = formula.at
            value = self._read(formula, text)
            if re.fullmatch(r"\s*+[-+]?\s*+[\d.]++\s*+", code[first : formula.at]):
                continue
            self.changed = True
            pieces += [text[at:first], self._said(value)]
            at = formula.at
        pieces.append(text[at:])
        whole = "".join(pieces)
        return _NOT_CODE.sub(lambda p: p[0] if p[0][0] == '"' else " " * len(p[0]), whole), whole, text

    def _arguments_as_numbers(self, code: str, body: str, text: str) -> str:
        """Put numbers for expressions among the arguments of a cycle: CYCLE81(R1, 0, 2, R5)."""
        call = _WITH_ARGUMENTS.search(code)
        if call is None or call[2].upper() in _MODES or call[2].upper() not in self.names or '"' in code[call.end() :]:
            return body
        depth, stop = 1, call.end()
        while stop < len(code) and depth:
            depth += {"(": 1, ")": -1}.get(code[stop], 0)
            stop += 1
        inside = code[call.end() : stop - 1]
        if depth or not re.search(r"[A-Z*/(]|\d\s*[-+]", inside, re.IGNORECASE):
            return body
        parts = [
            self._said(self._evaluated(part, text))
            if re.search(r"[A-Z*/(]|\d\s*[-+]", part, re.IGNORECASE)
            else part.strip()
            for part in _split(inside)
        ]
        self.changed = True
        return body[: call.end()] + ",".join(parts) + body[stop - 1 :]

    @staticmethod
    def _said(value: float) -> str:
        return f"{round(value, 8) + 0.0:.8f}".rstrip("0").rstrip(".")


def _split(text: str) -> list[str]:
    """Arguments, at the commas outside of parentheses."""
    parts, depth = [""], 0
    for sign in text:
        depth += {"(": 1, ")": -1}.get(sign, 0)
        if sign == "," and not depth:
            parts.append("")
        else:
            parts[-1] += sign
    return parts
