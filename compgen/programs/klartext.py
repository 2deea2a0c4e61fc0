"""Klartext programs of HEIDENHAIN as their control executes them: what a correction cannot keep is written as plain moves.

Calls of labels and repeats are written out; Q parameters that are constant become numbers; polar lines, tangent arcs, roundings,
chamfers and patterns of holes become lines, arcs and holes, since each place needs its own correction. All else stays as it is.
The text that remains (L, CC, C, CR, CP, cycles with M99, M89, CYCL CALL) is that which :class:`compgen.programs.reader.Reader`
reads. Sources: HEIDENHAIN Klartext Programming and Cycle Programming manuals.
"""

from __future__ import annotations

import ast
import cmath
import math
import operator
import re
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

import numpy as np

from compgen.errors import InputError, visible_line
from compgen.programs.cycles import OLD_CYCLES
from compgen.programs.dialects import VALUE
from compgen.programs.runs import RADIUS_TOLERANCE_MM
from compgen.programs.subprograms import DEEPEST, Linked, WrittenOut, file_of, mentions

#: Numbers that are calculated here have so many decimals; the writer gives them those of the dialect.
CALCULATED = 8
_DEEPEST, _MOST_LINES, _MOST_HOLES, _MOST_JUMPS = 20, 2_000_000, 100_000, 100_000
#: FN 9: IF +Q1 EQU +5 GOTO LBL 2, and FN 10 (NE), FN 11 (GT), FN 12 (LT).
_JUMP = (
    r"FN\s*(?:9|10|11|12)\s*:\s*IF(?P<one>(?:(?!\bEQU|\bNE|\bGT|\bLT).)++)(?P<how>EQU|NE|GT|LT)\b(?P<other>(?:(?!GOTO).)++)GOTO\s*LBL\s*"
    r"(?P<label>\"[^\"]+\"|\d+)"
)
_NEEDED = re.compile(
    rb"CALL|\b(?:LP|CT|CTP|RND|CHF)\b|\b(?:APPR|DEP)\s*+P|PATTERN|PLANE\s*+(?!\s*RESET)|TRANS\s*+ROT[A-Z]{0,5}+\s*+I?ROT"
    rb"|DEF\s*+(?:22[01]|10)\b|FN\s*+\d|(?<=[A-Z=+*/(\s-])Q[LR]?\d++(?!\s*+=)",
    re.IGNORECASE,
)
#: What stands before the code of a block: its number, and a slash if the control may skip it, before or after the number.
_HEAD = r"\s*+(?:(?P<first>/)\s*+\d++(?=\s)|\d++(?=[\s/*;]|$))?+\s*+(?P<skip>/\d?)?\s*+"
_STATEMENT = re.compile(rf"{_HEAD}(?P<code>.*)", re.DOTALL)
_USED = re.compile(
    r"(?<![A-Z0-9_])(?P<word>I?[XYZABC]|I?P[RA]|REP\s*+|R|Q\d++\s*+=|(?:NUM|ROT|D|DX|DY|START|STEP)[XY]?)\s*+"
    r"(?P<sign>[+-]?)\s*+(?P<name>Q[LR]?\d++)",
    re.IGNORECASE,
)
_WORD = re.compile(
    rf"(?<![A-Z])(I?(?:[XYZ]|PR|PA)|R(?=\s*(?:[+\-.1-9]|0\.))|NUM[XY]?|ROT[XY]?|D[XY]?|START|STEP|F)\s*({VALUE})",
    re.IGNORECASE,
)
_TAIL = re.compile(
    rf"(?<![A-Z])(?:R0|R[LR]|F\s*MAX|F\s*AUTO|F[ZU]?\s*(?:{VALUE}|Q[LR]?\d+)|M\d+)(?![\w.])", re.IGNORECASE
)
_FEED = re.compile(rf"(?<![A-Z])F(?:[ZU]?\s*(?:{VALUE}|[+-]?Q[LR]?\d+)|\s*AUTO)(?![\w.])", re.IGNORECASE)
_MOTION = re.compile(r"(LP|L|CTP|CT|CP|CR|CC|C|RND|CHF)(?![A-Z])", re.IGNORECASE)
_CYCLE_NUMBER = re.compile(rf"(Q\d+)(\s*=\s*)({VALUE})", re.IGNORECASE)
_ASSIGNS = re.compile(r"(?:FN\s*\d+\s*:\s*)?(Q[LRS]?\d+)\s*=\s*(.+)", re.IGNORECASE | re.DOTALL)
_PATTERN = re.compile(r"(POS|ROW|PAT|FRAME|CIRC|PITCHCIRC)\d+\s*\(([^()]*)\)", re.IGNORECASE)


#: Words of a move, and what follows them.
_MOVE_WORD = re.compile(
    rf"\s*+(?:(?P<machine>M\s*140)\s*+(?:MB\s*+(?:MAX|{VALUE}))?"
    rf"|(?P<beside>M\s*118(?:\s*+[XYZABC]\s*+{VALUE})*+|M\s*120\s*+LA\s*+{VALUE}|M\s*124\s*+T\s*+{VALUE}|M\s*101\s*+BT\s*+{VALUE})"
    rf"|(?P<inc>I)?(?P<axis>[XYZABCUVW])\s*+(?P<value>{VALUE})|(?P<polar>I?P[AR])\s*+(?P<angle>{VALUE})"
    rf"|(?P<turn>DR\s*[+-])|(?P<side>R[LR](?![A-Z])|R0(?![.\d]))|R\s*+(?P<radius>{VALUE})|(?P<max>F\s*+MAX)|F\s*+AUTO"
    rf"|F[ZU]?\s*+(?:{VALUE}|[+-]?Q[LR]?\d+)|M\s*+(?P<m>\d+)|(?P<bare>R[+-](?=\s|$))"
    rf"|(?P<way>LEN|CCA)\s*+(?:{VALUE}|[+-]?Q[LR]?\d+))",
    re.IGNORECASE,
)
#: Approaches and departures, and what each needs beside coordinates.
_APPROACH = r"(APPR|DEP)\s*+(P?)(LT|LN|CT|LCT)(?![A-Z])"
_NEEDS = {"LT": ("LEN",), "LN": ("LEN",), "CT": ("CCA", "R"), "LCT": ("R",)}
_SETTINGS = re.compile(
    r"BLK\s+FORM|\*|LBL\s*(?:\"|\d)|FUNCTION\s+RESET|FUNCTION\s+MODE\s+MILL|TRANS\s+(?:DATUM|ROTATION)\s+RESET\s*$"
    r"|TRANS\s+ROTATION\s+I?ROT\s*[+-]?[0.]+\s*$"
    r"|FN\s*(?:[0-8]|14|15|16|18|20|26|27|28|38)\b|Q[LRS]?\d+\s*=|ADP\b|SPINDLE\b|SECTION\b|END\s+SECTION\b",
    re.IGNORECASE,
)
#: Cycles that move nothing of X, Y and Z: dwell, spindle, tolerance; those with nothing in their lines end a turn.
_STILL, _TURNED = (9, 13, 32), (8, 10, 11, 19, 26)
_REFUSED = (
    (
        r"APPR|DEP",
        "is no approach or departure of Klartext; expected APPR LT, LN, CT or LCT (PLT ... with a pole), DEP LT, LN, CT, LCT or "
        "PLCT",
    ),
    (r"F(?:POL|L|LT|C|CT|SELECT)\b", "free contours (FK) are not followed; post lines and arcs"),
    (
        r"FUNCTION|M128|LN\b|SPL\b",
        "TCPM, normals and splines are not followed; post a program with X, Y and Z",
    ),
    (
        r"CALL\s*(?:PGM|LBL|SELECTED)|SEL\b|CYCLE?\s*DEF\s*12\b",
        "calls another program: give its folder with --subprograms (CALL PGM), or post one program without calls of files",
    ),
    (r"CYCLE?\s*CALL\s*P|PATTERN|LP|CTP?|RND|CHF", "is not followed where it stands; post lines and arcs"),
    (
        r"FN|IF\b|FOR\b|WHILE\b",
        "conditions, jumps and readings of the control are not followed; post the program without them",
    ),
)


def _without_side(text: str) -> str:
    """A block without R0, RL and RR."""
    return re.sub(r"(?<![A-Z])R(?:[LR](?![A-Z])|0(?![.\d]))", " ", text.upper())


@dataclass
class Sentence:
    """What a line of a program says: what to do, its words and their modes, and which number it has (cycle, preset)."""

    what: str
    words: list[tuple[str, str, int, int]] = field(default_factory=list)
    modes: dict[str, str] = field(default_factory=dict)
    number: str = ""
    #: Whether a block with / that the control may skip.
    deleted: bool = False


class Sentences:
    """Reads lines of a program; keeps whether a line goes on in the next one, and in what cycle lines with Q stand."""

    def __init__(self) -> None:
        self._continues, self._comment, self._cycle = False, False, ""

    def of(self, line: str) -> Sentence:
        """Return what a line says; "refused" with the reason as its number."""
        body = line.rstrip()
        goes_on, bare = body.endswith("~"), body.removesuffix("~")
        code = bare.partition(";")[0].rstrip()
        continued, self._continues = self._continues, goes_on
        if continued and self._comment:
            return Sentence("keep")
        head = re.match(_HEAD, code)
        at = head.end() if head and not continued else len(code) - len(code.lstrip())
        self._comment = not code[at:].strip() and ";" in bare
        found = self._said(code, at)
        found.deleted = bool(head and (head["first"] or head["skip"])) and not continued
        return found

    def _said(self, code: str, at: int) -> Sentence:
        text = code[at:].upper()
        if not text.strip():
            return Sentence("keep")
        if self._cycle and re.match(r"Q\d+\s*=", text):
            return self._more(text)
        cycle, self._cycle = self._cycle, ""
        if found := re.match(r"TCH\s*PROBE\s*(\d+)(?:\s*\.\s*(\d+))?", text):
            self._cycle = "probe"
            return Sentence("probe", number=f"TCH PROBE {found[1]}") if found[2] in (None, "0") else Sentence("keep")
        if found := re.match(r"(BEGIN|END)\s++PGM\b", text):
            unit = next((name for name in ("MM", "INCH") if text.rstrip().endswith(name)), "")
            return Sentence(found[1].lower(), number=unit)
        if found := re.match(r"CYCLE?\s*DEF\s*(\d+)(?:\s*\.\s*(\d+))?", text):
            return self._defined(code, at, at + found.end(), int(found[1]), found[2])
        del cycle
        if re.match(r"CYCLE?\s*CALL(?!\s*P)", text):
            return self._move(code, at + text.index("CALL") + 4, "CYCL CALL")
        if found := re.match(r"TOOL\s+(CALL|DEF)", text):
            return self._tool(code, at + found.end(), found[1])
        if found := re.match(r"TRANS\s+DATUM\s+AXIS", text):
            return self._shifted(code, at + found.end())
        if text.startswith("PLANE"):
            return self._plane(text)
        if re.match(r"TRANS\s+DATUM\s+RESET", text):
            return Sentence("shift", [(letter, "0", at, at) for letter in "XYZ"], dict.fromkeys("XYZ", "AC"))
        if _SETTINGS.match(text):
            return Sentence("keep")
        if found := re.match(r"(L|CC|CR|CP|C)(?![A-Z])", text):
            return self._move(code, at + found.end(), found[1])
        if found := re.match(_APPROACH, text):
            return self._approach(code, at + found.end(), found)
        if found := re.match(r"STOP\b|(?=M\d)", text):
            return self._move(code, at + found.end(), "STOP")
        for pattern, reason in _REFUSED:
            if re.match(pattern, text):
                return Sentence("refused", number=f"{text[:20].strip()}: {reason}")
        return Sentence(
            "refused",
            number=f"{text[:20].strip()!r} is not known in Klartext, and may move the machine; post lines and arcs",
        )

    def _more(self, text: str) -> Sentence:
        """A further line of a cycle that is defined."""
        number = re.match(rf"Q(\d+)\s*=\s*({VALUE})?", text)
        if self._cycle == "probe":
            return Sentence("keep")
        if self._cycle == "247":
            if not number or number[1] != "339" or not number[2]:
                return Sentence("refused", number="cycle 247 needs the number of the preset: Q339=1")
            return Sentence("preset", number=f"{float(number[2].replace(' ', '')):g}")
        return Sentence("more")

    def _defined(self, code: str, at: int, end: int, number: int, part: str | None) -> Sentence:
        text = code[end:].upper()
        if number == 7:
            return self._shifted(code, end) if part not in (None, "0") else Sentence("keep")
        if number in _STILL:
            return Sentence("keep")
        if number in _TURNED:
            turned = part not in (None, "0") and any(float(value.replace(" ", "")) for value in re.findall(VALUE, text))
            turned = turned or (number == 8 and bool(re.search("[XYZ]", text)) and part not in (None, "0"))
            if number in (11, 26) and part not in (None, "0"):
                turned = any(float(value.replace(" ", "")) != 1.0 for value in re.findall(VALUE, text))
            if not turned:
                return Sentence("keep")
            return Sentence(
                "refused",
                number=f"cycle {number}: turned, scaled or mirrored coordinates are not followed; post without them",
            )
        if number == 247:
            self._cycle = "247"
            q = re.search(rf"Q339\s*=\s*({VALUE})", text)
            return Sentence("preset", number=f"{float(q[1].replace(' ', '')):g}") if q else Sentence("keep")
        if number in OLD_CYCLES:
            return Sentence("more" if part not in (None, "0") else "cycle", number=OLD_CYCLES[number])
        self._cycle = str(number)
        return Sentence("cycle", number=f"G{number}")

    @staticmethod
    def _plane(text: str) -> Sentence:
        """PLANE RESET, or PLANE SPATIAL without angles: the plane is not turned; TURN and MOVE may draw the tool back."""
        if re.search(r"TABLE\s+ROT|\bQ[LRS]?\d", text) or plane_turn_deg(text) != 0.0:
            return Sentence(
                "refused",
                number=f"{text[:20].strip()}: only PLANE RESET, and PLANE SPATIAL with SPA+0 SPB+0 and without TABLE ROT, keep "
                "the tool axis; post a program with X, Y and Z",
            )
        return Sentence("lost", number="stays" if re.search(r"\bSTAY\b", text) else "")

    @staticmethod
    def _shifted(code: str, at: int) -> Sentence:
        found = Sentence("shift")
        for word in re.finditer(rf"(I?)([XYZABC])\s*({VALUE})|#\s*\d+|([A-Z#]\S*)", code[at:], re.IGNORECASE):
            if word[2] is None:
                return Sentence(
                    "refused", number=f"{word[0]}: datums of a table are not known; post the shift with X, Y and Z"
                )
            letter = word[2].upper()
            found.words.append((letter, word[3], at + word.start(3), at + word.end(3)))
            found.modes[letter] = "IC" if word[1] else "AC"
        return found

    @staticmethod
    def _tool(code: str, at: int, kind: str) -> Sentence:
        text = code[at:]
        if axis := re.search(r"(?<![A-Z\"])([XYUVW])(?=\s|$)", text, re.IGNORECASE):
            return Sentence("refused", number=f"the tool axis {axis[1].upper()} is not followed; expected Z")
        if re.search(r"Q[LRS]?\d", text):
            return Sentence("refused", number="the number of the tool is not constant; post it")
        found, name = (
            Sentence("tool" if kind == "CALL" else "tool definition"),
            re.match(r"\s*(\"[^\"]*\"|\d+(?:\.\d+)?)", text),
        )
        if name:
            found.words.append(("T", name[1], at + name.start(1), at + name.end(1)))
        if not name and re.search(r"(?<![A-Z])D[LR](?!2)", text, re.IGNORECASE):
            return Sentence(
                "refused",
                number="TOOL CALL with DL or DR and without a tool is not followed; post it with the number of the tool",
            )
        for word in re.finditer(
            rf"\b(DL|DR(?!2)|L|R(?!2))\s*({VALUE})", text[name.end() if name else 0 :], re.IGNORECASE
        ):
            found.words.append((word[1].upper(), word[2], at, at))
        return found

    def _approach(self, code: str, at: int, kind: re.Match[str]) -> Sentence:
        """Split APPR or DEP into words: those of its line or arc stay with the control."""
        what, polar, way = kind[1].upper(), kind[2], kind[3].upper()
        found = self._move(code, at, what)
        if found.what == "refused":
            return found
        letters = {letter for letter, *_ in found.words}
        given = {
            name
            for name in ("LEN", "CCA", "R")
            if re.search(rf"(?<![A-Z]){name}\s*+[-+.\dQ]", _without_side(code[at:]))
        }
        missing = [name for name in _NEEDS[way] if name not in given]
        leads = what == "APPR" or way == "LCT"
        if missing or (leads and not letters & {"X", "Y"}) or (not leads and letters & {"X", "Y"}) or polar:
            needs = " and ".join([*(["X or Y"] if leads else []), *_NEEDS[way]])
            return Sentence("refused", number=f"{what} {polar}{way}: expected {needs}")
        found.words = [word for word in found.words if word[0] != "R"]
        if not leads:
            found.words.append(("DEP away", "", at, at))
        return found

    def _move(self, code: str, at: int, kind: str) -> Sentence:
        """Split a move into words: codes have no text."""
        found, start = Sentence("move"), at
        if kind != "STOP":
            found.words.append((kind, "", at, at))
        while code[at:].strip():
            word = _MOVE_WORD.match(code, at)
            if word is None:
                return Sentence(
                    "refused",
                    number=f"{code[at:].strip()[:20]!r} cannot be read; expected words such as X+10.5, R0, F500 or M3",
                )
            part, at = word.groupdict(), word.end()
            if part["bare"]:
                return Sentence(
                    "refused",
                    number=f"{word[0].strip()}: radius compensation along an axis is not followed; post the path of the tool "
                    "centre from CAM (R0)",
                )
            if part["side"]:
                found.words.append((part["side"].upper(), "", *word.span("side")))
            elif part["axis"]:
                letter = part["axis"].upper()
                letter = "IJK"["XYZ".index(letter)] if kind == "CC" and letter in "XYZ" else letter
                found.words.append((letter, part["value"], *word.span("value")))
                found.modes[letter] = "IC" if part["inc"] else "AC"
            elif part["polar"]:
                found.words.append((part["polar"].upper(), part["angle"], *word.span("angle")))
            elif part["turn"]:
                found.words.append((re.sub(r"\s", "", part["turn"].upper()), "", *word.span("turn")))
            elif part["radius"]:
                found.words.append(("R", part["radius"], *word.span("radius")))
            elif part["max"]:
                found.words.append(("FMAX", "", *word.span("max")))
            elif part["machine"]:
                found.words.append(("M140", "", *word.span("machine")))
            elif part["m"]:
                found.words.append(("M", part["m"], *word.span("m")))
        return self._whole(found, kind, code[start:])

    @staticmethod
    def _whole(found: Sentence, kind: str, text: str) -> Sentence:
        """Refuse moves that lack what says where they lead."""
        letters = [letter for letter, *_ in found.words]
        axes = set(letters) & set("XYZ")
        approach = kind in ("APPR", "DEP")
        if not approach and ("LEN" in text.upper() or "CCA" in text.upper()):
            return Sentence("refused", number=f"{kind}{text.rstrip()[:30]}: LEN and CCA belong to APPR and DEP")
        if kind in ("C", "CR", "CP") and not {"DR+", "DR-"} & set(letters):
            return Sentence("refused", number=f"{kind} without DR+ or DR-; post the sense of the arc")
        if kind == "CR" and not axes:
            return Sentence("refused", number="CR without the coordinates of its end; post them")
        if kind == "C" and not axes:  # it ends where it begins
            found.words.append(("C round", "", 0, 0))
        if (
            ((kind == "CR") != ("R" in letters) and not approach)
            or (kind == "CP") != bool({"PA", "IPA"} & set(letters))
            or {"PR", "IPR"} & set(letters)
        ):
            return Sentence(
                "refused",
                number=f"{kind}{text.rstrip()[:30]} has words that do not belong together; post L, C, CR, CP or LP",
            )
        for letter in set(letters):
            if letters.count(letter) > 1 and letter != "M":
                return Sentence("refused", number=f"{letter} is given twice in a block")
        return found


@dataclass
class _Statement:
    """A block with the lines that continue it: its lines in the file, its code without comments, and whether it is skipped."""

    first: int
    lines: list[str]
    code: str = ""
    deleted: bool = False


def _statements(lines: list[str]) -> Iterator[_Statement]:
    k = 0
    while k < len(lines):
        found = _Statement(k, [lines[k]])
        while lines[k].rstrip().endswith("~") and k + 1 < len(lines):
            k += 1
            found.lines.append(lines[k])
        k += 1
        head = _STATEMENT.match(found.lines[0].partition(";")[0].rstrip().rstrip("~"))
        found.code, found.deleted = (head["code"].strip(), bool(head["first"] or head["skip"])) if head else ("", False)
        comment = not found.code and ";" in found.lines[0]
        if not comment:
            more = (line.partition(";")[0].rstrip().rstrip("~").strip() for line in found.lines[1:])
            found.code = " ".join([found.code, *more]).strip()
        yield found


def lowered(source: Path, program: Linked | None, *, skip_deleted: bool = False) -> WrittenOut | None:
    """Return a program with what the module's text names written as plain moves; None if there is nothing of it.

    ``program`` is what :func:`linked` has found.
    """
    content = source.read_bytes() if program is None else b"".join(program.lines)
    if not _NEEDED.search(content):
        return None
    lines = content.decode("latin-1").splitlines(keepends=True)
    numbers = list(range(1, len(lines) + 1))
    program = program or Linked([], [(source, k) for k in numbers], numbers)
    return _Program(program, lines, skip_deleted).written()


_PGM = re.compile(r"(\s*+\d*+\s*+)CALL\s++PGM\s++(\"[^\"]++\"|[^\s;]++)\s*+(;.*)?$", re.IGNORECASE | re.DOTALL)
_ANY_LABEL = re.compile(r"((?:CALL\s*)?LBL\s*)(\"[^\"]+\"|\d+)", re.IGNORECASE)


def linked(source: Path, folders: Collection[Path]) -> Linked | None:
    """Put the programs that are called (CALL PGM) behind M30 of a program, with labels of their own; None without calls."""
    lines = source.read_bytes().decode("latin-1").splitlines(keepends=True) if folders else []
    if not any(map(_PGM.match, lines)):
        return None
    found = Linked([], [(source, k + 1) for k in range(len(lines))], list(range(1, len(lines) + 1)))
    _Linker(found, list(folders), lines).link()
    found.lines = [line.encode("latin-1") for line in lines]
    return found


@dataclass
class _Linker:
    """What is put behind a program: lines of the programs that are called, each as a label by the name of its file."""

    program: Linked
    folders: list[Path]
    lines: list[str]
    known: dict[Path, str] = field(default_factory=dict)
    behind: list[tuple[str, tuple[Path, int], int]] = field(default_factory=list)

    def link(self) -> None:
        """Change calls to those of labels, and put the programs before END PGM."""
        lines, places = self.lines, self.program.places
        end = next(
            (k for k, line in enumerate(lines) if re.match(r"\s*+\d*+\s*+END\s++PGM", line, re.IGNORECASE)), len(lines)
        )
        unit = self._unit(lines)
        for k in range(end):
            lines[k] = self._called(lines[k], places[k], k + 1, unit, 1)
        if not self.behind:
            return
        if not any(_Program.ends(line.partition(";")[0]) for line in lines[:end]):
            what = "calls a program and has no M30 before END PGM; post it with M30"
            raise InputError(what, file=places[0][0], line=min(end + 1, len(lines)))
        lines[end:end] = [text for text, _, _ in self.behind]
        places[end:end] = [place for _, place, _ in self.behind]
        self.program.main_lines[end:end] = [main for _, _, main in self.behind]

    @staticmethod
    def _unit(lines: list[str]) -> str:
        first = next((line for line in lines if re.match(r"\s*+\d*+\s*+BEGIN\s++PGM", line, re.IGNORECASE)), "")
        return "INCH" if first.rstrip().upper().endswith("INCH") else "MM"

    def _called(self, line: str, place: tuple[Path, int], main: int, unit: str, depth: int) -> str:
        call = _PGM.match(line)
        if call is None:
            return line
        if depth > DEEPEST:
            raise InputError(f"calls are deeper than {DEEPEST}, or call themselves", file=place[0], line=place[1])
        name = re.split(r"[/\\:]", call[2].strip('"'))[-1]
        stem = re.escape(re.sub(r"\.H$", "", name, flags=re.IGNORECASE))
        path = file_of(rf"{stem}\.h", self.folders, name, place)
        if path is None:
            return line
        if path not in self.known:
            self.known[path] = f'"PGM {path.name}"'
            self._put(path, main, unit, depth)
        rest = line[len(line.rstrip("\r\n")) :]
        return f"{call[1]}CALL LBL {self.known[path]}{' ' + call[3].rstrip() if call[3] else ''}{rest}"

    def _put(self, path: Path, main: int, unit: str, depth: int) -> None:
        lines = path.read_bytes().decode("latin-1").splitlines(keepends=True)
        if self._unit(lines) != unit:
            raise InputError(
                f"is in {self._unit(lines)}, and the program that calls it in {unit}; post both alike", file=path
            )
        own = [f"LBL {self.known[path]}\n"]
        where = [(path, 1)]
        ended = False
        for k, line in enumerate(lines, 1):
            code = line.partition(";")[0]
            ended = ended or re.match(r"\s*+\d*+\s*+END\s++PGM", code, re.IGNORECASE) is not None
            if _Program.ends(code):
                raise InputError(
                    "ends the program by M2 or M30, and is called by another; post it without", file=path, line=k
                )
            if re.match(r"\s*+\d*+\s*+(?:BEGIN|END)\s++PGM", code, re.IGNORECASE):
                continue
            line = self._called(line, (path, k), main, unit, depth + 1)
            if not re.search(r'LBL\s*"PGM ', line):
                line = _ANY_LABEL.sub(lambda one: self._label(one, path), line.partition(";")[0]) + line[len(code) :]
            own.append(re.sub(r"^(\s*)\d+\s+", r"\1", line))
            where.append((path, k))
        if not ended:
            raise InputError("has no END PGM: it may have been cut; give all of it", file=path, line=max(len(lines), 1))
        own.append("LBL 0\n")
        where.append((path, len(lines)))
        self.behind += [
            (text if text.endswith("\n") else f"{text}\n", at, main) for text, at in zip(own, where, strict=True)
        ]

    @staticmethod
    def _label(found: re.Match[str], path: Path) -> str:
        label = found[2].strip('"')
        return found[0] if re.fullmatch("0+", label) else f'{found[1]}"{label} {path.name}"'


def plane_turn_deg(text: str) -> float | None:
    """By what angle about Z a block with PLANE turns the coordinates; None if it turns the tool axis, or in another way."""
    if re.match(r"PLANE\s+RESET\b", text):
        return 0.0
    angles = dict(re.findall(rf"\b(SP[ABC])\s*+({VALUE})", text))
    if not re.match(r"PLANE\s+SPATIAL\b", text) or len(angles) != 3:
        return None
    a, b, c = (float(angles[name].replace(" ", "")) for name in ("SPA", "SPB", "SPC"))
    return c if a == b == 0.0 else None


def holes_of_circle(q: dict[str, float]) -> list[complex]:
    """Places of cycle 220: on a pitch circle, by the stepping angle or from the starting to the stopping angle."""
    count, start, step = int(q["Q241"]), q["Q245"], q.get("Q247", 0.0)
    if step == 0.0 and count > 1:
        span = q["Q246"] - start
        step = span / count if abs(abs(span) - 360.0) < 1e-9 else span / (count - 1)
    centre = complex(q["Q216"], q["Q217"])
    return [centre + cmath.rect(0.5 * q["Q244"], math.radians(start + k * step)) for k in range(count)]


def holes_of_grid(
    start: complex, step: tuple[float, float], count: tuple[int, int], turn_deg: float, *, frame: bool = False
) -> list[complex]:
    """Places of cycle 221 and of PAT: line by line, every other one backwards, turned about the first place."""
    turn, places = cmath.rect(1.0, math.radians(turn_deg)), []
    for line in range(count[1]):
        columns = range(count[0]) if line % 2 == 0 else reversed(range(count[0]))
        for column in columns:
            if not frame or line in (0, count[1] - 1) or column in (0, count[0] - 1):
                places.append(start + turn * complex(column * step[0], line * step[1]))
    return places


@dataclass
class _Element:
    """The last move of a contour, as a rounding needs it: where it begins, and its place in the output."""

    start: list[float]
    end: list[float]
    straight: bool
    place: int
    tail: str
    line: int
    #: Of an arc in X and Y its centre, and 1 if it turns to the left (DR+), -1 to the right.
    centre: complex = 0j
    sense: float = 0.0

    def offset(self, side: float, radius: float) -> tuple[complex, complex, float]:
        """The curve ``radius`` to the left (``side`` 1) or right: (a point, the direction, 0) of a line, (centre, 0, radius)."""
        begin, end = complex(*self.start[:2]), complex(*self.end[:2])
        if not self.sense:
            along = (end - begin) / abs(end - begin)
            return begin + 1j * side * radius * along, along, 0.0
        return self.centre, 0j, abs(end - self.centre) - side * self.sense * radius

    def along(self, place: complex) -> complex:
        """Direction of the tool at a place."""
        if not self.sense:
            way = complex(*self.end[:2]) - complex(*self.start[:2])
            return way / abs(way)
        way = 1j * self.sense * (place - self.centre)
        return way / abs(way)

    def foot(self, place: complex) -> complex:
        """The nearest point of its line or circle."""
        begin, end = complex(*self.start[:2]), complex(*self.end[:2])
        if not self.sense:
            along = (end - begin) / abs(end - begin)
            return begin + ((place - begin) * along.conjugate()).real * along
        return self.centre + abs(end - self.centre) * (place - self.centre) / abs(place - self.centre)

    def length_to(self, place: complex, *, backward: bool) -> float:
        """How far it is from its end back to a place (``backward``), or from its start on to it."""
        begin, end = complex(*self.start[:2]), complex(*self.end[:2])
        first, last = (place, end) if backward else (begin, place)
        if not self.sense:
            return ((last - first) * self.along(end).conjugate()).real
        turn = cmath.phase((last - self.centre) / (first - self.centre)) * self.sense
        return abs(end - self.centre) * (turn if turn > -1e-9 else turn + 2.0 * math.pi)

    def length(self) -> float:
        """Length of its path."""
        begin, end = complex(*self.start[:2]), complex(*self.end[:2])
        if not self.sense:
            return abs(end - begin)
        turn = cmath.phase((end - self.centre) / (begin - self.centre)) * self.sense
        return abs(end - self.centre) * (turn if turn > 1e-9 else turn + 2.0 * math.pi)


def _crossings(one: tuple[complex, complex, float], other: tuple[complex, complex, float]) -> list[complex]:
    """Where two curves cross, each a line (point, direction, 0) or a circle (centre, 0, radius)."""
    if one[1] and other[1]:
        across = (one[1].conjugate() * other[1]).imag
        if abs(across) < 1e-12:
            return []
        return [one[0] + one[1] * ((other[0] - one[0]).conjugate() * other[1]).imag / across]
    if one[1] or other[1]:
        line, circle = (one, other) if one[1] else (other, one)
        foot = line[0] + line[1] * ((circle[0] - line[0]) * line[1].conjugate()).real
        square = circle[2] ** 2 - abs(foot - circle[0]) ** 2
        return [] if square < 0.0 else [foot + line[1] * side * math.sqrt(square) for side in (1.0, -1.0)]
    apart = other[0] - one[0]
    if abs(apart) < 1e-12:
        return []
    reach = (abs(apart) ** 2 + one[2] ** 2 - other[2] ** 2) / (2.0 * abs(apart))
    square = one[2] ** 2 - reach**2
    return (
        []
        if square < 0.0
        else [one[0] + apart / abs(apart) * complex(reach, side * math.sqrt(square)) for side in (1, -1)]
    )


@dataclass
class _Program:
    """Executes a program statement by statement; places are in its own coordinates and unit."""

    program: Linked
    lines: list[str]
    skip_deleted: bool
    out: list[tuple[str, int]] = field(default_factory=list)
    q: dict[str, float | None] = field(default_factory=dict)
    at: list[float] = field(default_factory=lambda: [math.nan] * 3)
    pole: list[float] = field(default_factory=lambda: [math.nan] * 3)
    axes: tuple[int, int] = (0, 1)
    tangent: complex | None = None
    cycle: dict[str, float] = field(default_factory=dict)
    cycle_lines: list[str] = field(default_factory=list)
    points: list[tuple[float, float, float]] = field(default_factory=list)
    element: _Element | None = None
    corner: tuple[str, float, int] | None = None
    polar: float = math.nan
    shift: list[float] = field(default_factory=lambda: [0.0] * 3)
    #: By what the coordinates are turned about Z (cycle 10, TRANS ROTATION, PLANE SPATIAL): all places here are in turned ones.
    turn: complex = 1 + 0j
    angles_deg: dict[str, float] = field(default_factory=dict)
    heading: _Statement | None = None
    called: dict[str, None] = field(default_factory=dict)
    written_lines: set[int] = field(default_factory=set)
    #: F in force, that of a rounding or chamfer (in its block only), and the one that the move after it needs again.
    feed: str = ""
    corner_feed: str = ""
    feed_again: str = ""
    jumps: int = 0

    def written(self) -> WrittenOut:
        """Execute from the first statement to the end."""
        every = list(_statements(self.lines))
        labels: dict[str, int] = {}
        for k, item in enumerate(every):
            if label := re.match(r"LBL\s*(\"[^\"]+\"|\d+)", item.code, re.IGNORECASE):
                if label[1] in labels and label[1] != "0":
                    self._fail(item, f"LBL {label[1]} is given twice; give each its own number")
                labels[label[1]] = k
        self.calls = any(re.match(rf"CALL\s*LBL|{_JUMP}", item.code, re.IGNORECASE) for item in every)
        stack: list[int] = []
        left: dict[int, int] = {}
        k = 0
        while k < len(every):
            item, k = every[k], k + 1
            if len(self.out) > _MOST_LINES:
                self._fail(
                    item,
                    f"the program has more than {_MOST_LINES} lines when its calls are written out; post it in parts",
                )
            if item.deleted and self.skip_deleted:
                self._keep(item)
                continue
            call = re.match(r"CALL\s*LBL\s*(\"[^\"]+\"|\d+)(?:\s*REP\s*(\S+))?", item.code, re.IGNORECASE)
            jump = re.match(_JUMP, item.code, re.IGNORECASE)
            if call:
                k = self._call(item, call, k, labels, stack, left)
            elif jump:
                k = self._jump(item, jump, k, labels, every)
            elif re.match(r"LBL\s*(?:\"|\d)", item.code, re.IGNORECASE):
                self._comment(item) if self.calls else self._keep(item)
                if re.match(r"LBL\s*0+\b", item.code, re.IGNORECASE) and stack:
                    k = stack.pop()
            else:
                self._execute(item)
                if self.ends(item.code) and self.calls:
                    for rest in every[k:]:
                        self._keep(rest) if not rest.code or self._closes(rest.code) else self._comment(rest)
                    break
        if self.corner:
            path, line = self.program.places[self.corner[2]]
            raise InputError("a rounding or chamfer without a move after it", file=path, line=line)
        text, main_lines = "".join(text for text, _ in self.out), self.program.main_lines
        lines = np.array([main_lines[line] for _, line in self.out])
        places = [self.program.places[line] for _, line in self.out]
        return WrittenOut(text.encode("latin-1"), lines, tuple(self.called), places)

    def _fail(self, item: _Statement, message: str) -> NoReturn:
        text = visible_line(item.lines[0].strip())[:60]
        path, line = self.program.places[item.first]
        raise InputError(f"{message} (block: {text})", file=path, line=line)

    @staticmethod
    def ends(code: str) -> bool:
        """Whether a block ends the program."""
        return re.search(r"(?<![A-Z])M0*(?:2|30)(?!\d)", code, re.IGNORECASE) is not None

    @staticmethod
    def _closes(code: str) -> bool:
        return re.match(r"END\s+PGM", code, re.IGNORECASE) is not None

    def _call(
        self,
        item: _Statement,
        call: re.Match[str],
        k: int,
        labels: dict[str, int],
        stack: list[int],
        left: dict[int, int],
    ) -> int:
        """Follow a call of a label: a subprogram to LBL 0, or with REP the part of the program from the label again."""
        name = call[1]
        if name not in labels or name == "0":
            self._fail(item, f"CALL LBL {name}: the label is not in this program; give one program with all its labels")
        self._comment(item)
        if call[2] is None:
            if len(stack) >= _DEEPEST:
                self._fail(item, f"calls within calls are followed to a depth of {_DEEPEST}")
            stack.append(k)
            self.called[f"LBL {name}"] = None
            return labels[name] + 1
        text = call[2].partition("/")[0]
        times = self._value(item, text)
        if times != int(times) or not 0 <= times <= 65534:
            self._fail(item, f"REP {text}: expected a whole number of repeats")
        if labels[name] >= k:
            self._fail(item, f"REP of LBL {name}, which begins after the call, is not followed; post it without REP")
        self.called[f"LBL {name} REP {int(times)}"] = None
        remaining = left.pop(k, int(times))
        if remaining:
            left[k] = remaining - 1
            return labels[name] + 1
        return k

    def _jump(
        self, item: _Statement, jump: re.Match[str], k: int, labels: dict[str, int], every: list[_Statement]
    ) -> int:
        """Follow FN 9 to FN 12: where both sides are constant the control jumps, or it does not."""
        both = [self._evaluated(jump[name].strip()) for name in ("one", "other")]
        if None in both:
            self._fail(
                item, "a jump (FN 9 to FN 12) that depends on what is known when the program runs; post it without"
            )
        one, other = (float(value) for value in both if value is not None)
        holds = {"EQU": one == other, "NE": one != other, "GT": one > other, "LT": one < other}[jump["how"].upper()]
        self._comment(item)
        if not holds:
            return k
        name = jump["label"]
        if name not in labels or re.fullmatch("0+", name):
            self._fail(item, f"GOTO LBL {name}: the label is not in this program; give one program with all its labels")
        self.jumps += 1
        if self.jumps > _MOST_JUMPS:
            self._fail(item, f"more than {_MOST_JUMPS} jumps: the program may never end; post it in parts")
        for skipped in every[k : labels[name]]:
            self._comment(skipped) if skipped.code and not self._closes(skipped.code) else self._keep(skipped)
        self.element, self.tangent = None, None if self.element is None else self.tangent
        return labels[name]

    # Output.

    def _keep(self, item: _Statement) -> None:
        lines = list(item.lines)
        if item.first in self.written_lines:  # a block has its number once
            lines[0] = re.sub(r"^(\s*)\d+\s+", r"\1", lines[0])
        self.written_lines.add(item.first)
        self.out += [(line, item.first + k) for k, line in enumerate(lines)]

    def _comment(self, item: _Statement) -> None:
        """Keep a statement that is written out as a comment."""
        for k, line in enumerate(item.lines):
            bare = re.sub(r"^\s*\d*\s*", "", line) if not k else line.lstrip()
            self._put(f"; {bare.rstrip().rstrip('~').rstrip()}", item, k)

    def _put(self, text: str, item: _Statement, k: int = 0) -> None:
        line, text = item.lines[0], self._turned(text)
        self.out.append((text + (line[len(line.rstrip("\r\n")) :] or "\n"), item.first + k))

    # Turned coordinates.

    def _turned(self, text: str) -> str:
        """A line with X and Y of the coordinates that are not turned."""
        if self.turn == 1.0 or text.startswith(";"):
            return text
        code, mark, comment = text.partition(";")

        def put(found: re.Match[str]) -> str:
            place = complex(float(found[1]), float(found[2])) * self.turn
            return f"{self._word(0, place.real)} {self._word(1, place.imag)}"

        return re.sub(r"(?<![A-Z])X([+-][\d.]+) Y([+-][\d.]+)", put, code) + mark + comment

    def _turn_by(self, item: _Statement, what: str, angle_deg: float) -> None:
        """Turn the coordinates about their zero: cycle 10 and PLANE add up."""
        if self.corner:
            self._fail(item, f"turned coordinates behind {self.corner[0]}, which needs a move of the contour")
        if angle_deg and not any(self.angles_deg.values()) and any(one != one for one in self.shift):
            self._fail(item, "turned coordinates after a shift that is not known")
        self.angles_deg[what] = angle_deg
        before, self.turn = self.turn, cmath.rect(1.0, math.radians(sum(self.angles_deg.values()) % 360.0))
        if not sum(self.angles_deg.values()) % 360.0:
            self.turn = 1 + 0j
        if self.turn != before:
            for place in (self.at, self.pole):
                here = complex(place[0], place[1]) * before / self.turn
                place[0], place[1] = here.real, here.imag
            self.element, self.tangent, self.polar = None, None, math.nan

    def _rotate(self, item: _Statement, code: str) -> None:
        """Cycle 10 and TRANS ROTATION: what they turn is written out, and they become comments."""
        if re.match(r"CYCLE?\s*DEF\s*10\s*\.\s*0", code):
            self.heading = item
            return
        heading, self.heading = self.heading, None
        found = re.search(rf"(?<![A-Z])(I?)ROT\s*+({VALUE})", code)
        reset = re.match(r"TRANS\s+ROTATION\s+RESET", code)
        if not found and not reset:
            self._fail(item, "a rotation without ROT or IROT; expected a number of degrees")
        before = self.angles_deg.get("10", 0.0)
        angle = float(found[2].replace(" ", "")) if found else 0.0
        angle += before if found and found[1] else 0.0
        for one in filter(None, (heading, item)):
            self._comment(one) if angle or before else self._keep(one)
        self._turn_by(item, "10", angle)

    def _plane(self, item: _Statement, code: str) -> None:
        """PLANE SPATIAL about Z turns the coordinates; the block stays, without its angle, since it may draw the tool back."""
        angle = plane_turn_deg(code)
        if angle is None or re.search(r"TABLE\s+ROT", code):
            self._keep(item)  # it is refused where it stands
            return
        self._turn_by(item, "PLANE", angle)
        if not re.search(r"\bSTAY\b", code):
            self.at, self.element, self.tangent = [math.nan] * 3, None, None
        lines = [
            re.sub(rf"(SPC\s*+){VALUE}", r"\1+0", line, count=1, flags=re.IGNORECASE) if angle else line
            for line in item.lines
        ]
        self._keep(_Statement(item.first, lines, item.code, item.deleted))

    def _shift_turned(self, item: _Statement) -> None:
        if self.turn != 1.0:
            self._fail(item, "a datum shift or preset in turned coordinates is not followed; turn them back before")

    # Numbers.

    def _value(self, item: _Statement, text: str) -> float:
        """The value of a number or an expression; refused if it is not constant."""
        found = self._evaluated(text)
        if found is None:
            self._fail(
                item,
                f"{text.strip()!r} is not known before the program runs: only Q parameters that are constant are followed",
            )
        return found

    def _evaluated(self, text: str) -> float | None:
        known = {name: value for name, value in self.q.items() if value is not None}
        try:
            return evaluated(text, known)
        except (ValueError, SyntaxError, ArithmeticError, KeyError, RecursionError, MemoryError):
            return None

    def _assign(self, item: _Statement, name: str, text: str) -> None:
        name = name.upper()
        if name in self.cycle:
            self._fail(item, f"{name} is a number of the cycle that is defined; define the cycle again with it")
        number = re.match(r"FN\s*(\d+)", item.code, re.IGNORECASE)
        if number and int(number[1]) == 4:
            text = re.sub(r"\bDIV\b", "/", text, flags=re.IGNORECASE)
        if number and int(number[1]) == 5:
            text = re.sub(r"\bSQRT\b", "SQRT ", text, flags=re.IGNORECASE)
        followed = not number or int(number[1]) <= 8
        self.q[name] = self._evaluated(text) if followed else None

    def _substituted(self, item: _Statement) -> _Statement:
        """The statement with numbers in place of Q parameters; those of feeds stay."""

        def put(found: re.Match[str]) -> str:
            value = self._value(item, found["name"]) * (-1.0 if found["sign"] == "-" else 1.0)
            sign = "" if found["word"].strip().upper() in ("NUM", "NUMX", "NUMY", "REP") else "+"
            return f"{found['word']}{value:{sign}.10g}"

        lines = []
        for line in item.lines:
            code, mark, comment = line.partition(";")
            lines.append(_USED.sub(put, code) + mark + comment)
        return _Statement(item.first, lines, _USED.sub(put, item.code), item.deleted) if lines != item.lines else item

    # Statements.

    def _execute(self, item: _Statement) -> None:
        code = item.code.upper()
        if code.startswith("*") or not code:
            return self._keep(item)
        if (assigned := _ASSIGNS.fullmatch(item.code)) and not code.startswith("CYCL"):
            self._assign(item, assigned[1], assigned[2])
            return self._keep(item)
        item = self._substituted(item)
        code = item.code.upper()
        motion = _MOTION.match(code)
        if code.startswith("TOOL") and _FEED.search(code):
            self.feed = "F AUTO"
        if code.startswith("CYCL") and "DEF" in code[:10]:
            return self._define(item, code)
        if code.startswith("TCH"):
            return self._probe(item)
        if code.startswith("PLANE"):
            return self._plane(item, code)
        if re.match(r"TRANS\s+ROT", code):
            return self._rotate(item, code)
        if shifted := re.match(r"TRANS\s+DATUM\s+(AXIS|RESET)", code):
            words = self._words(code[shifted.end() :]) if shifted[1] == "AXIS" else dict.fromkeys("XYZ", 0.0)
            return self._shift_by(item, words)
        if code.startswith("PATTERN"):
            self.points = self._points(item)
            return self._comment(item)
        if re.match(r"CYCLE?\s*CALL\s*PAT", code):
            return self._drill(item, self.points, code)
        if re.match(r"CYCLE?\s*CALL\s*POS", code):
            words = self._words(code)
            if not {"X", "Y"} <= words.keys():
                self._fail(item, "CYCL CALL POS without X and Y; post both")
            return self._drill(item, [(words["X"], words["Y"], words.get("Z", 0.0))], code)
        if approach := re.match(_APPROACH, code):
            return self._approach(item, approach, code)
        if motion:
            return self._move(item, motion[1].upper(), code)
        if re.match(r"FN\s*(?:9|10|11|12)\b", code):
            self._fail(item, "jumps (FN 9 to FN 12) are not followed; post the program without conditions")
        if unknown := re.match(r"FN\s*\d+\s*:\s*\w+\s+(Q[LR]?\d+)", code):
            self.q[unknown[1]] = None
        self._keep(item)
        return None

    def _probe(self, item: _Statement) -> None:
        """Keep a block that probes: where the tool is after it, and what it has found, is not known."""
        self.q |= {key.upper(): float(value.replace(" ", "")) for key, _, value in _CYCLE_NUMBER.findall(item.code)}
        results = re.findall(r"\bQ[LR]?\d+\b(?!\s*=)", item.code.upper())
        self.q |= dict.fromkeys((*results, *(f"Q{k}" for k in (*range(115, 120), *range(150, 200)))))
        self.at, self.element, self.tangent = [math.nan] * 3, None, None
        self._keep(item)

    @staticmethod
    def _words(code: str) -> dict[str, float]:
        return {name.upper(): float(value.replace(" ", "")) for name, value in _WORD.findall(code)}

    def _define(self, item: _Statement, code: str) -> None:
        """Take a definition of a cycle; patterns are drilled at once."""
        number = re.match(r"CYCLE?\s*DEF\s*(\d+)(?:\s*\.\s*(\d+))?", code)
        name = int(number[1]) if number else 0
        if name == 10:
            return self._rotate(item, code)
        numbers = {key.upper(): float(value.replace(" ", "")) for key, _, value in _CYCLE_NUMBER.findall(item.code)}
        self.q |= numbers
        if name in (220, 221):
            return self._pattern(item, name, numbers)
        if name == 7 and number and number[2] not in (None, "0"):
            return self._shift_by(item, self._words(code[number.end() :]))
        elif name == 247:
            self._shift_turned(item)
            self.shift, self.at = [0.0] * 3, [math.nan] * 3
        elif name >= 200 or name in OLD_CYCLES:
            self.cycle, self.cycle_lines = numbers, item.lines
        self._keep(item)
        return None

    def _shift_by(self, item: _Statement, words: dict[str, float]) -> None:
        self._shift_turned(item)
        for k, letter in enumerate("XYZ"):
            new = words.get(letter, self.shift[k] + words.get(f"I{letter}", 0.0))
            self.at[k] += self.shift[k] - new
            self.pole[k] += self.shift[k] - new
            self.shift[k] = new
        self._keep(item)

    def _pattern(self, item: _Statement, name: int, q: dict[str, float]) -> None:
        needed = (
            ("Q216", "Q217", "Q244", "Q245", "Q241")
            if name == 220
            else ("Q225", "Q226", "Q237", "Q238", "Q242", "Q243")
        )
        if missing := [key for key in needed if key not in q] + ["Q246"] * (
            name == 220 and not q.get("Q247") and "Q246" not in q
        ):
            self._fail(item, f"cycle {name} without {missing[0]}; give it")
        for key in ("Q241", "Q242", "Q243"):
            if key in q and not 1 <= q[key] == int(q[key]):
                self._fail(item, f"{key}={q[key]:g}: expected a whole number of holes")
        if name == 220:
            places = holes_of_circle(q)
        else:
            count = int(q["Q242"]), int(q["Q243"])
            places = holes_of_grid(complex(q["Q225"], q["Q226"]), (q["Q237"], q["Q238"]), count, q.get("Q224", 0.0))
        for key in ("Q200", "Q203", "Q204"):
            if key in q:
                self.cycle = self.cycle | {key: q[key]} if self.cycle else {}
        self._drill(item, [(place.real, place.imag, 0.0) for place in places], "FMAX", again=True)

    def _points(self, item: _Statement) -> list[tuple[float, float, float]]:
        """Places of PATTERN DEF, with what each adds to the surface."""
        found: list[tuple[float, float, float]] = []
        rest = re.sub(r"^PATTERN\s*DEF", "", _PATTERN.sub("", item.code), flags=re.IGNORECASE)
        if rest.strip():
            self._fail(
                item,
                f"PATTERN DEF with {rest.strip()[:20]!r} is not followed; post POS, ROW, PAT, FRAME, CIRC or PITCHCIRC",
            )
        for kind, inside in _PATTERN.findall(item.code.upper()):
            w = self._words(inside)
            if w.get("ROTX") or w.get("ROTY"):
                self._fail(item, f"{kind} with ROTX or ROTY is not followed; post the places with POS")
            counts = [w.get(key, 1.0) for key in ("NUM", "NUMX", "NUMY")]
            if "X" not in w or "Y" not in w or any(not 1 <= one == int(one) <= _MOST_HOLES for one in counts):
                self._fail(item, f"{kind} needs X, Y and whole numbers of places")
            start, (count, columns, rows) = complex(w["X"], w["Y"]), map(int, counts)
            if kind == "POS":
                places = [start]
            elif kind == "ROW":
                places = holes_of_grid(start, (w.get("D", 0.0), 0.0), (count, 1), w.get("ROT", 0.0))
            elif kind in ("PAT", "FRAME"):
                step = w.get("DX", 0.0), w.get("DY", 0.0)
                places = holes_of_grid(start, step, (columns, rows), w.get("ROT", 0.0), frame=kind == "FRAME")
            else:
                step_deg = w.get("STEP", 0.0) if kind == "PITCHCIRC" else 360.0 / count
                angles = (math.radians(w.get("START", 0.0) + k * step_deg) for k in range(count))
                places = [start + cmath.rect(0.5 * w.get("D", 0.0), angle) for angle in angles]
            found += [(place.real, place.imag, w.get("Z", 0.0)) for place in places]
        return found

    def _drill(
        self, item: _Statement, places: list[tuple[float, float, float]], code: str, *, again: bool = False
    ) -> None:
        """Write holes of a pattern, with the cycle defined anew where its surface or clearances are others."""
        if not self.cycle or "Q203" not in self.cycle:
            self._fail(item, "calls a drilling cycle at places, and none is defined before")
        if not places:
            self._fail(item, "calls a pattern, and none is defined before (PATTERN DEF)")
        if len(places) > _MOST_HOLES:
            self._fail(item, f"a pattern of more than {_MOST_HOLES} holes; post it in parts")
        self._comment(item)
        surface, now = self.cycle["Q203"], math.nan if again else self.cycle["Q203"]
        feed = found[0] if (found := re.search(rf"F\s*{VALUE}", code)) else "FMAX"
        more = "".join(f" {word}" for word in re.findall(r"M\d+", code) if int(word[1:]) not in (89, 99))
        for x, y, z in places:
            if surface + z != now:
                now = surface + z
                self._define_again(item, {**self.cycle, "Q203": now})
            self._put(f"L X{x:+.{CALCULATED}f} Y{y:+.{CALCULATED}f} R0 {feed}{more} M99", item)
            more = ""
        if now != surface:
            self._define_again(item, self.cycle)
        clear = max(self.cycle.get("Q200", 0.0), self.cycle.get("Q204", 0.0))
        self.at, self.element, self.tangent = [x, y, now + clear], None, None

    def _define_again(self, item: _Statement, numbers: dict[str, float]) -> None:
        def put(found: re.Match[str]) -> str:
            name, value = found[1].upper(), numbers[found[1].upper()]
            return (
                found[0]
                if float(found[3].replace(" ", "")) == value
                else f"{found[1]}{found[2]}{value:+.10g}"
                if name
                else ""
            )

        for k, line in enumerate(self.cycle_lines):
            code, mark, comment = line.partition(";")
            text = _CYCLE_NUMBER.sub(put, re.sub(r"^(\s*)\d+\s+", r"\1", code) if not k else code) + mark + comment
            self.out.append((text, item.first))

    # Moves.

    def _approach(self, item: _Statement, kind: re.Match[str], code: str) -> None:
        """Keep APPR and DEP, whose line or arc the control makes; polar coordinates of the contour become those in X and Y."""
        if self.corner:
            self._fail(
                item, f"{kind[0]} behind {self.corner[0]}, which needs a move of the contour; post its lines and arcs"
            )
        rest = re.sub(r"(?<![A-Z])(?:LEN|CCA)\s*+[-+]?[\d.]++", " ", _without_side(code[kind.end() :]))
        words = self._words(re.sub(r"(?<![A-Z])R(?=\s*[-+\d.])", "r", rest))
        end = [words.get(axis, self.at[k] + words.get(f"I{axis}", 0.0)) for k, axis in enumerate("XYZ")]
        _, item = self._with_feed(item, "", code)
        leads = kind[1] == "APPR" or kind[3] == "LCT"
        if kind[2]:
            if "PR" not in words and "IPR" not in words:
                self._fail(item, f"{kind[0]} without PR; give the radius from the pole")
            self._polar_end(item, kind[0], words, end)
            a, b = sorted(self.axes)
            if (a, b) != (0, 1):
                self._fail(item, f"{kind[0]} about a pole outside the plane XY is not followed; post X and Y")
        if kind[2] or (leads and self.turn != 1.0):
            if any(math.isnan(value) for value in end[:2]):
                self._fail(item, f"{kind[0]} from a position that is not known; post X and Y in absolute")
            place = self._turned(" ".join(self._word(k, end[k]) for k in (0, 1)))
            lines = [
                re.sub(r"(?<![A-Z])I?(?:P[RA]|[XY])\s*+[-+]?\s*+[\d.]++\s*+", "", line, flags=re.IGNORECASE)
                for line in item.lines
            ]
            lines[0] = re.sub(
                r"(APPR|DEP)\s*+P?(LCT|LT|LN|CT)", rf"\1 \2 {place}", lines[0], count=1, flags=re.IGNORECASE
            )
            item = _Statement(item.first, lines, item.code, item.deleted)
        self._keep(item)
        away = kind[1] == "DEP" and kind[3] != "LCT"
        self.at = [math.nan, math.nan, end[2]] if away else end
        self.element, self.tangent, self.polar = None, None, math.nan

    def _move(self, item: _Statement, kind: str, code: str) -> None:
        words, (a, b) = self._words(code[len(kind) :]), self.axes
        if kind in ("RND", "CHF"):
            return self._corner(item, kind, words, code)
        if kind == "CC":
            return self._set_pole(item, words)
        end = list(self.at)
        for k, letter in enumerate("XYZ"):
            end[k] = words.get(letter, end[k] + words.get(f"I{letter}", 0.0))
        polar = kind in ("LP", "CTP")
        if kind in ("LP", "CTP", "CP"):
            self._polar_end(item, kind, words, end)
        else:
            self.polar = math.nan
        machine = re.search(r"(?<![A-Z])M(?:91|92|140)(?!\d)", code) is not None
        if machine:
            end = [
                math.nan if letter in words or f"I{letter}" in words or "140" in code else end[k]
                for k, letter in enumerate("XYZ")
            ]
        if kind in ("CR", "CT", "CTP"):
            named = [k for k, letter in enumerate("XYZ") if letter in words or f"I{letter}" in words]
            a, b = (2, 0) if named == [0, 2] else (1, 2) if named == [1, 2] else (0, 1) if kind != "CTP" else (a, b)
        start = list(self.at)
        straight = kind in ("L", "LP")
        around, sense = self._centre_of(kind, start, end, words, code, (a, b))
        if self.corner:
            self._round(item, kind, end, around, sense)
            start = list(self.at)
        tail = " ".join(re.sub(r"\s+", "", word) for word in _TAIL.findall(code))
        tail, item = self._with_feed(item, tail, code)
        turned = self.turn != 1.0 and not machine and self._holds_turned(item, kind, words)
        if self.turn != 1.0 and machine and any(end[k] != end[k] for k in (0, 1)):
            end[:2] = math.nan, math.nan  # which of the turned coordinates that leaves is not known
        rounded = self.rounded or turned
        self.rounded = False
        place = len(self.out)
        if kind in ("CT", "CTP"):
            self._tangent_arc(item, start, end, (a, b), tail)
        elif polar or (rounded and straight):
            named_z = "Z" in words or "IZ" in words
            letters = [k for k in range(3) if k in (a, b) or (k == 2 and named_z) or (rounded and k < 2)]
            if any(math.isnan(end[k]) for k in letters):
                self._fail(item, "X and Y have to be placed together in absolute, once the coordinates are turned")
            number = None if item.first in self.written_lines else re.match(r"\s*\d+\s+", item.lines[0])
            self.written_lines.add(item.first)
            text = " ".join(["L", *(self._word(k, end[k]) for k in letters), tail]).rstrip()
            comment = item.lines[0].partition(";")
            said = f" ;{comment[2].rstrip()}" if comment[1] else ""
            self._put(f"{number[0] if number else ''}{text}{said}", item)
            self.tangent = self._direction(start, end)
        elif rounded:
            way = 1j * sense * (complex(*end[:2]) - around)
            if cmath.isnan(way) or abs(way) < 1e-9:
                self._fail(item, f"{kind} needs a pole (CC), and a position that is known and not in it")
            self._comment(item)
            lines = self._arc_lines(around, end, sense, tail)
            if turned and kind == "CP":
                lines[1] = self._helix(words, start, around, sense, tail)
            for text in lines:
                self._put(text, item)
            place = len(self.out) - 2 if len(self.out) > place + 2 else place
            self.tangent = way / abs(way)
        else:
            self._keep(item)
            self.tangent = self._tangent_after(kind, start, end, words, code, (a, b))
        tested = straight and not machine and "M99" not in code and self.corner is None
        flat = start[2] == end[2] and kind in ("C", "CR", "CP") and not machine and not cmath.isnan(around) and sense
        whole = tested or flat
        self.element = (
            _Element(start, end, straight, place, tail, item.first, around, 0.0 if straight else sense)
            if whole
            else None
        )
        self.at = end
        if re.search(r"(?<![A-Z])M(?:99|89)(?!\d)", code) and self.cycle:
            self.at[2] = math.nan
        return None

    rounded = False

    def _holds_turned(self, item: _Statement, kind: str, words: dict[str, float]) -> bool:
        """Whether a move in turned coordinates has to be written out; refused if that cannot be done."""
        named = {word[-1] for word in words if word[-1] in "XYZ"}
        if kind in ("L", "LP"):
            return kind == "LP" or bool(named & {"X", "Y"})
        if self.axes != (0, 1) and kind != "CR" or (kind != "CP" and "Z" in named):
            self._fail(item, f"{kind} outside the plane XY in turned coordinates is not followed; post lines")
        return kind in ("C", "CR", "CP")

    def _helix(self, words: dict[str, float], start: list[float], around: complex, sense: float, tail: str) -> str:
        """CP by its angle from where it begins: that does not depend on how the coordinates are turned."""
        if "IPA" in words:
            angle = words["IPA"]
        else:
            begins = math.degrees(cmath.phase(complex(*start[:2]) - around))
            angle = sense * (((words["PA"] - begins) * sense) % 360.0 or 360.0)
        rise = "".join(f" {name}{words[name]:+.{CALCULATED}f}" for name in ("Z", "IZ") if name in words)
        return f"CP IPA{angle:+.{CALCULATED}f}{rise} {'DR+' if sense > 0 else 'DR-'} {tail}".rstrip()

    def _with_feed(self, item: _Statement, tail: str, code: str) -> tuple[str, _Statement]:
        """Give a move behind a rounding with its own F the one that was in force before; keep which F is in force."""
        if given := _FEED.search(code):
            self.feed, self.feed_again = given[0], ""
        elif self.feed_again and not re.search(r"(?<![A-Z])F\s*MAX", code):
            again, self.feed_again = self.feed_again, ""
            body = item.lines[0].partition(";")[0].rstrip("\r\n")
            rest = item.lines[0][len(body) :]
            lines = [f"{body.rstrip()} {again}{' ' if rest[:1] == ';' else ''}{rest}", *item.lines[1:]]
            return f"{tail} {again}".strip(), _Statement(item.first, lines, f"{item.code} {again}", item.deleted)
        return tail, item

    @staticmethod
    def _word(k: int, value: float) -> str:
        return f"{'XYZ'[k]}{value:+.{CALCULATED}f}"

    @staticmethod
    def _direction(start: list[float], end: list[float]) -> complex | None:
        way = complex(end[0] - start[0], end[1] - start[1])
        return way / abs(way) if abs(way) > 1e-9 else None

    def _set_pole(self, item: _Statement, words: dict[str, float]) -> None:
        named = [k for k, letter in enumerate("XYZ") if letter in words or f"I{letter}" in words]
        self.axes = (2, 0) if named == [0, 2] else (1, 2) if named == [1, 2] else (0, 1)
        for k, letter in enumerate("XYZ"):
            if letter in words:
                self.pole[k] = words[letter]
            elif f"I{letter}" in words:
                self.pole[k] = self.at[k] + words[f"I{letter}"]
            elif not named:
                self.pole[k] = self.at[k]
        if self.turn == 1.0:
            return self._keep(item)
        if self.axes != (0, 1) or cmath.isnan(complex(*self.pole[:2])):
            self._fail(item, "CC in turned coordinates needs X and Y; post both")
        self._put(f"CC {self._word(0, self.pole[0])} {self._word(1, self.pole[1])}", item)
        return None

    def _polar_end(self, item: _Statement, kind: str, words: dict[str, float], end: list[float]) -> None:
        """Find where polar words lead: about the pole, by the radius and the angle."""
        a, b = self.axes
        pole = complex(self.pole[a], self.pole[b])
        if cmath.isnan(pole):
            self._fail(item, f"{kind} without a pole before it; post CC")
        here = complex(self.at[a], self.at[b]) - pole
        radius = abs(here) if kind == "CP" or "IPR" in words else words.get("PR", self.polar)
        radius = words.get("PR", radius) + words.get("IPR", 0.0)
        if math.isnan(radius):
            self._fail(item, f"{kind} without PR; give the radius from the pole")
        turned = cmath.phase(here) + math.radians(words.get("IPA", 0.0))
        angle = math.radians(words["PA"]) if "PA" in words else turned
        there = pole + cmath.rect(radius, angle)
        if cmath.isnan(there):
            self._fail(item, f"{kind} from a position that is not known; post it in absolute")
        end[a], end[b], self.polar = there.real, there.imag, radius

    def _centre_of(
        self, kind: str, start: list[float], end: list[float], words: dict[str, float], code: str, axes: tuple[int, int]
    ) -> tuple[complex, float]:
        """Centre and sense of an arc in X and Y; nan and 0 of any other move."""
        if kind not in ("C", "CR", "CP") or axes != (0, 1):
            return complex(math.nan, math.nan), 0.0
        sense = 1.0 if "DR+" in re.sub(r"\s", "", code) else -1.0
        if kind != "CR":
            return complex(*self.pole[:2]), sense
        here, there, radius = complex(*start[:2]), complex(*end[:2]), words.get("R", math.nan)
        chord = there - here
        height = math.sqrt(max(radius * radius - 0.25 * abs(chord) ** 2, 0.0))
        side = sense if radius > 0 else -sense
        return 0.5 * (here + there) + 1j * side * height * chord / (abs(chord) or 1.0), sense

    def _arc_lines(self, centre: complex, end: list[float], sense: float, tail: str) -> list[str]:
        """An arc about its own centre, and the pole of the program again."""
        lines = [f"CC {self._word(0, centre.real)} {self._word(1, centre.imag)}"]
        direction = "DR+" if sense > 0 else "DR-"
        lines.append(f"C {self._word(0, end[0])} {self._word(1, end[1])} {direction} {tail}".rstrip())
        if not any(math.isnan(value) for value in self.pole[:2]):
            lines.append(f"CC {self._word(0, self.pole[0])} {self._word(1, self.pole[1])}")
        return lines

    def _tangent_after(
        self, kind: str, start: list[float], end: list[float], words: dict[str, float], code: str, axes: tuple[int, int]
    ) -> complex | None:
        """Direction of the tool in XY at the end of a move that stays as it is."""
        if kind == "L":
            return self._direction(start, end)
        there = complex(*end[:2])
        centre, sense = self._centre_of(kind, start, end, words, code, axes)
        way = 1j * sense * (there - centre)
        return None if cmath.isnan(way) or abs(way) < 1e-9 else way / abs(way)

    def _tangent_arc(
        self, item: _Statement, start: list[float], end: list[float], axes: tuple[int, int], tail: str
    ) -> None:
        """Write CT as CC and C: the centre is where the normal at the start meets the bisector of the chord."""
        if axes != (0, 1) or self.tangent is None:
            self._fail(item, "CT needs a move in X and Y before it, from a known position; post CR or CC and C")
        if end[2] != start[2] and not (math.isnan(end[2]) and math.isnan(start[2])):
            self._fail(item, "CT that moves Z as well is not followed; post CP")
        here, there, along = complex(*start[:2]), complex(*end[:2]), self.tangent
        chord = there - here
        side = (along.conjugate() * chord).imag  # of the chord, left of the tangent
        if cmath.isnan(chord) or abs(chord) < 1e-9:
            self._fail(item, "CT from a position that is not known, or to where the tool is; post CR")
        if abs(side) < 1e-9 * abs(chord):
            self._put(" ".join(["L", self._word(0, end[0]), self._word(1, end[1]), tail]).rstrip(), item)
            return
        radius = 0.5 * abs(chord) ** 2 / side
        centre = here + 1j * along * radius
        sense = 1.0 if radius > 0 else -1.0
        self._comment(item)
        self._put(f"CC {self._word(0, centre.real)} {self._word(1, centre.imag)}", item)
        direction = "DR+" if sense > 0 else "DR-"
        self._put(f"C {self._word(0, end[0])} {self._word(1, end[1])} {direction} {tail}".rstrip(), item)
        if not any(math.isnan(value) for value in self.pole[:2]):
            self._put(f"CC {self._word(0, self.pole[0])} {self._word(1, self.pole[1])}", item)
        way = 1j * sense * (there - centre)
        self.tangent = way / abs(way)

    def _corner(self, item: _Statement, kind: str, words: dict[str, float], code: str) -> None:
        size = words.get("R") if kind == "RND" else None
        if size is None and (bare := re.match(rf"{kind}\s*({VALUE})", code)):
            size = float(bare[1].replace(" ", ""))
        if size is None or not size > 0:
            self._fail(item, f"{kind} without a {'radius' if kind == 'RND' else 'length'} above 0")
        if self.element is None or any(math.isnan(value) for value in (*self.element.start[:2], *self.element.end[:2])):
            self._fail(
                item, f"{kind} is followed between moves in X and Y from known positions; post its lines and arcs"
            )
        if self.corner:
            self._fail(item, f"{kind} after {self.corner[0]} without a move between them")
        self.corner = kind, size, item.first
        given = _FEED.search(code)
        self.corner_feed = f" {given[0]}" if given else ""
        if given and not self.feed:
            self._fail(item, f"{kind} with its own F before any other F; post F in the block before")
        if given:
            self.feed_again = self.feed
        self._comment(item)

    def _round(self, item: _Statement, kind: str, end: list[float], around: complex, sense: float) -> None:
        """Shorten the move before a corner, and write the arc or chamfer in its place."""
        assert self.corner is not None
        if self.element is None:
            self._fail(item, f"{self.corner[0]} with something else than a move after it; post the move behind it")
        (what, size, line), before = self.corner, self.element
        item = _Statement(line, [self.lines[line], *item.lines[:1]])
        self.corner, self.rounded = None, True
        here, corner, there = complex(*before.start[:2]), complex(*before.end[:2]), complex(*end[:2])
        flat = before.start[2] == before.end[2] == end[2]
        if (before.sense or sense) and what == "RND" and flat and not cmath.isnan(there):
            after = _Element(before.end, end, not sense, 0, "", item.first, around, sense)
            try:
                self._round_arcs(item, size, before, after)
            except ArithmeticError:
                self._fail(item, "RND beside a move that leads nowhere, or about the place where the tool is")
            return
        if kind not in ("L", "LP") or before.sense or cmath.isnan(there) or not flat:
            self._fail(
                item,
                f"{what} is followed between two straight moves in X and Y (RND beside arcs, too); post its lines and arcs",
            )
        back, on = here - corner, there - corner
        if not (back and on):
            self._fail(item, f"{what} beside a move that leads nowhere")
        back, on, lengths = back / abs(back), on / abs(on), (abs(back), abs(on))
        cosine = (back.conjugate() * on).real
        if what == "RND":
            half = 0.5 * math.acos(max(-1.0, min(1.0, cosine)))
            if half > 0.5 * math.pi - 1e-9:
                return  # straight on: nothing to round
            if half < 1e-6:
                self._fail(item, f"{what} where the contour turns back")
            size, radius = size / math.tan(half), size
        if size > min(lengths) + 1e-9:
            self._fail(
                item,
                f"{what} needs {size:.4g} of a move that is {min(lengths):.4g} long; the control refuses it as well",
            )
        first, second = corner + size * back, corner + size * on
        eol = re.search(r"[\r\n]*$", self.out[before.place][0])
        number = re.match(r"\s*\d+\s+", self.out[before.place][0])
        words = [self._word(0, first.real), self._word(1, first.imag), before.tail]
        if before.start[2] != before.start[2]:
            self._fail(item, f"{what} while the position of Z is not known")
        self.out[before.place] = (
            self._turned(f"{number[0] if number else ''}L {' '.join(words)}".rstrip()) + (eol[0] if eol else "\n"),
            before.line,
        )
        marker = item
        if what == "RND":
            turn = "DR+" if (back.conjugate() * on).imag < 0 else "DR-"
            words = [self._word(0, second.real), self._word(1, second.imag), f"R{radius:+.{CALCULATED}f}", turn]
            self._put(f"CR {' '.join(words)}{self.corner_feed}", marker)
        else:
            self._put(f"L {self._word(0, second.real)} {self._word(1, second.imag)}{self.corner_feed}", marker)
        self.at = [second.real, second.imag, before.end[2]]

    def _round_arcs(self, item: _Statement, radius: float, before: _Element, after: _Element) -> None:
        """Round a corner beside an arc: the circle that touches both curves, nearest to the corner."""
        corner = complex(*before.end[:2])
        for arc in (before, after):
            radii = [abs(complex(*place[:2]) - arc.centre) for place in (arc.start, arc.end)]
            if arc.sense and abs(radii[0] - radii[1]) > RADIUS_TOLERANCE_MM:
                self._fail(
                    item, f"RND beside an arc whose start and end are {radii[0]:.4f} and {radii[1]:.4f} from its centre"
                )
        turn = (before.along(corner).conjugate() * after.along(corner)).imag
        if abs(turn) < 1e-9:
            if (before.along(corner).conjugate() * after.along(corner)).real > 0.0:
                return  # it goes on without a corner
            self._fail(item, "RND where the contour turns back")
        side = 1.0 if turn > 0 else -1.0
        centres = _crossings(before.offset(side, radius), after.offset(side, radius))
        if not centres:
            self._fail(item, "RND: no arc of this radius touches both moves; the control refuses it as well")
        centre = min(centres, key=lambda place: abs(place - corner))
        first, second = before.foot(centre), after.foot(centre)
        fits = before.length_to(first, backward=True) < before.length() + 1e-9
        fits = fits and after.length_to(second, backward=False) < after.length() + 1e-9
        touches = all(abs(abs(place - centre) - radius) < 1e-6 for place in (first, second))
        if not (fits and touches):
            self._fail(item, "RND needs more of a move than there is; the control refuses it as well")
        number = re.match(r"\s*\d+\s+", self.out[before.place][0])
        text = self.out[before.place][0]
        end = text[len(text.rstrip("\r\n")) :] or "\n"
        if before.sense:
            lines = self._arc_lines(before.centre, [first.real, first.imag], before.sense, before.tail)
        else:
            lines = [f"L {self._word(0, first.real)} {self._word(1, first.imag)} {before.tail}".rstrip()]
        lines[0] = (number[0] if number else "") + lines[0]
        self.out[before.place : before.place + 1] = [(self._turned(line) + end, before.line) for line in lines]
        direction = "DR+" if side > 0 else "DR-"
        words = [self._word(0, second.real), self._word(1, second.imag), f"R{radius:+.{CALCULATED}f}", direction]
        self._put(f"CR {' '.join(words)}{self.corner_feed}", item)
        self.at = [second.real, second.imag, before.end[2]]


def skips(text: str) -> bool:
    """Whether the control may skip a block: it has a slash before or after its number."""
    head = re.match(_HEAD, text)
    return bool(head and (head["first"] or head["skip"]))


def arc_text(text: str, before: list[str], words: list[str], piece: int, count: int, last: Collection[str]) -> str:
    """Return the lines of one piece of an arc: the first has the words that are no coordinates, the last the M codes ``last``."""
    end = text[len(text.rstrip()) :] or "\n"
    code, mark, comment = text.rstrip().partition(";")
    head = re.match(_HEAD, code)
    assert head is not None
    tail = [re.sub(r"\s+", "", word) for word in _TAIL.findall(code)]
    moved = [word for word in tail if word[0] in "Mm" and f"M{int(word[1:])}" in last]
    words = [
        *words,
        *(word for word in tail if piece == 0 and word not in moved),
        *(moved if piece == count - 1 else []),
    ]
    first = head[0] if piece == 0 else ""
    skip = "/" if "/" in head[0] else ""
    lines = [f"{skip}{line}{end}" for line in before]
    said = f" {mark}{comment}" if mark and piece == 0 else ""
    return "".join(lines) + first + " ".join(words) + said + end


# Programs in DIN/ISO: Q parameters that are constant become numbers.

_ISO_NEEDED = (re.compile(rb"[A-Z=][ \t]*+[-+]?[ \t]*+Q[LR]?\d"), re.compile(rb"\bD\d{1,2}[ \t]*+Q"))
_ISO_HEAD = re.compile(r"\s*+(?P<skip>/\d?\s*+)?(?:N\s*+\d++\s*+)?(?P<slash>/\d?\s*+)?")
_ISO_FUNCTION = re.compile(
    r"D(?P<code>\d{1,2})\s*+(?P<name>Q[LR]?\d++)\s*+(?P<rest>(?:P0[12]\s*+\S++\s*+)++)$", re.IGNORECASE
)
_ISO_FORMULA = re.compile(r"(?P<name>Q[LR]?\d++)\s*+=\s*+(?P<value>.+)$", re.IGNORECASE)
_ISO_USED = re.compile(
    r"(?<![A-Z0-9])(?P<word>[A-CF-JKL-PR-Z]|D[LR]|P\d\d|Q\d++\s*+=)\s*+(?P<sign>[-+]?)\s*+(?P<name>Q[LR]?\d++)",
    re.IGNORECASE,
)
#: What the functions D00 to D08 make of their numbers.
_ISO_RESULT: dict[int, Callable[..., float]] = {
    0: lambda a: a,
    1: operator.add,
    2: operator.sub,
    3: operator.mul,
    4: operator.truediv,
    5: math.sqrt,
    6: lambda a: math.sin(math.radians(a)),
    7: lambda a: math.cos(math.radians(a)),
    8: math.hypot,
}
#: Q parameters of cycles: what a program assigns to them by itself may change the cycle that is defined.
_OF_CYCLES = range(200, 500)


def iso_computed(source: Path, *, skip_deleted: bool = False) -> WrittenOut | None:
    """Return a DIN/ISO program with numbers in place of its Q parameters; None if it has none.

    What is not known before the program runs stays, and is refused where it is read.
    """
    if not mentions(source, _ISO_NEEDED):
        return None
    found = _IsoProgram(skip_deleted)
    lines = source.read_bytes().decode("latin-1").splitlines(keepends=True)
    content = "".join(map(found.line, lines)).encode("latin-1")
    if not found.used and not found.assigned:
        return None
    return WrittenOut(content, np.arange(1, len(lines) + 1), (), resolved=True, variables=tuple(found.used))


@dataclass
class _IsoProgram:
    """Follows the Q parameters of a DIN/ISO program line by line."""

    skip_deleted: bool
    known: dict[str, float] = field(default_factory=dict)
    used: dict[str, None] = field(default_factory=dict)
    assigned: bool = False
    defining: bool = False

    def line(self, text: str) -> str:
        """The line with numbers; an assignment becomes a comment."""
        code, mark, comment = text.rstrip("\r\n").partition(";")
        end = text[len(text.rstrip("\r\n")) :]
        head = _ISO_HEAD.match(code)
        assert head is not None
        body = code[head.end() :].rstrip().rstrip("*").rstrip()
        if self.skip_deleted and (head["skip"] or head["slash"]):
            return text
        if re.match(r"G[24]\d\d\b", body, re.IGNORECASE):
            self.defining = True
        elif body and not re.match(r"Q\d+\s*=", body, re.IGNORECASE):
            self.defining = False
        if not self.defining and (name := self._assigned(body)):
            self.assigned = True
            self.used.setdefault(name)
            return f"{code[: head.start()]}; {text.rstrip().rstrip('*').strip()}{end}"
        code = _ISO_USED.sub(self._number, code)
        if self.defining:
            given = re.findall(rf"(Q\d+)\s*=\s*({VALUE})", code, re.IGNORECASE)
            self.known |= {key.upper(): float(value.replace(" ", "")) for key, value in given}
        elif re.search(r"(?<![A-Z])(?:L\d+,|%|G4\d\d|D\d+)", code.upper()) and not code.lstrip().startswith("%"):
            self.known.clear()  # what is called, measured or read may change them; it is refused where it is read
        return code + mark + comment + end

    def _assigned(self, body: str) -> str | None:
        """The parameter that a block assigns and whose value is known after it."""
        found = _ISO_FUNCTION.match(body) or _ISO_FORMULA.match(body)
        if not found:
            return None
        name, code = found["name"].upper(), int(found["code"]) if "code" in found.groupdict() else None
        try:
            if code is None:
                value = evaluated(found["value"], self.known)
            else:
                numbers = [
                    evaluated(text, self.known)
                    for text in re.findall(r"P0[12]\s*+(\S++)", found["rest"], re.IGNORECASE)
                ]
                value = float(_ISO_RESULT[code](*numbers))
        except (ValueError, SyntaxError, ArithmeticError, KeyError, TypeError, RecursionError, MemoryError):
            self.known.pop(name, None)
            return None
        if int(re.sub(r"\D", "", name)) in _OF_CYCLES:
            return None
        self.known[name] = value
        return name

    def _number(self, found: re.Match[str]) -> str:
        name = found["name"].upper()
        if name not in self.known:
            return found[0]
        self.used.setdefault(name)
        value = self.known[name] * (-1.0 if found["sign"] == "-" else 1.0)
        whole = found["word"].upper() in ("T", "S", "M", "G", "N", "L", "F")
        text = f"{value:.{CALCULATED}f}".rstrip("0").rstrip(".")
        return f"{found['word']}{'' if whole or text.startswith('-') else '+'}{'0' if text == '-0' else text}"


_OPERATORS: dict[type, Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,
}
_FUNCTIONS: dict[str, Callable[[float], float]] = {
    "SIN": lambda x: math.sin(math.radians(x)),
    "COS": lambda x: math.cos(math.radians(x)),
    "TAN": lambda x: math.tan(math.radians(x)),
    "ASIN": lambda x: math.degrees(math.asin(x)),
    "ACOS": lambda x: math.degrees(math.acos(x)),
    "ATAN": lambda x: math.degrees(math.atan(x)),
    "SQRT": math.sqrt,
    "SQ": lambda x: x * x,
    "ABS": abs,
    "INT": math.trunc,
    "NEG": operator.neg,
    "LN": math.log,
    "EXP": math.exp,
}


def evaluated(text: str, known: dict[str, float]) -> float:
    """The value of an expression of HEIDENHAIN; KeyError, ValueError or SyntaxError if it has none."""
    text = re.sub(r"(?<!\s)\s++DIV\s++", "/", text.upper()).replace("^", "**")
    if len(text) > 500:
        raise ValueError("too long")
    # a function takes the number or parenthesis after it
    text = re.sub(
        r"\b(SIN|COS|TAN|ASIN|ACOS|ATAN|SQRT|SQ|ABS|INT|NEG|LN|EXP)\s*+([-+]?\s*+(?:Q[LR]?\d++|[\d.]++))",
        r"\1(\2)",
        text,
    )

    def value(node: ast.expr) -> float:
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](value(node.left), value(node.right))
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.UAdd | ast.USub):
            return value(node.operand) * (-1.0 if isinstance(node.op, ast.USub) else 1.0)
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return float(node.value)
        if isinstance(node, ast.Name):
            return math.pi if node.id == "PI" else known[node.id]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1:
            return float(_FUNCTIONS[node.func.id](value(node.args[0])))
        raise ValueError("no number")

    found = value(ast.parse(re.sub(r"(?<![\w.])0+(?=\d)", "", text.strip()), mode="eval").body)
    if not math.isfinite(found):
        raise ValueError("no finite number")
    return found
