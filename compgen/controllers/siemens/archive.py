"""What a SINUMERIK really holds: start-up archives, punched files and sub-programs that this program did not write.

An archive is a chain of files. In the binary form (``.arc``) NUL bytes with the name ``_N_NC_CEC_INI`` stand before each,
in the text form a line ``%_N_NC_CEC_INI``. The tables are those of its initialisation files; part programs that
write the same variables are no part of what acts, and are passed over. Where a file holds one part only, that part is
read, program or not.

Nothing that could change a table is passed over: a line of tables that is not understood is an error with its number.
Everything else is counted, and said in one line.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal

from compgen.controllers.base import SourceFile
from compgen.controllers.siemens.syntax import SWITCHES, Assignment, LinearTable, TableParts
from compgen.core.text import one_line

#: What is not known of a table of a real control is said from here on, um.
WORTH_SAYING_UM = 0.1
#: Kinds of files whose assignments are data of the control, by the last word of their name.
DATA_KINDS = ("INI", "TEA", "SEA", "EEC", "CEC")
#: Machine data and variables beside the tables that do not change what a table holds; None: any value.
HARMLESS: Mapping[str, tuple[str, ...] | None] = {
    "MN_MM_CEC_MAX_POINTS": None,
    "MA_MM_ENC_COMP_MAX_POINTS": None,
    "MA_CEC_MAX_SUM": None,
    "MA_CEC_MAX_VELO": None,
    "MA_CEC_SCALING_SYSTEM_METRIC": ("1", "TRUE"),
    "MN_SCALING_SYSTEM_IS_METRIC": ("1", "TRUE"),
    "AN_CEC_INPUT_NCU": ("0", "1"),
    "AN_CEC_OUTPUT_NCU": ("0", "1"),
    "AN_CEC_TYPE": ("0",),
}
#: Cylinder error compensation has the same three letters; where it is zero it does nothing.
_OTHER_CEC = re.compile(r"SN_CEC_(?:\d|BAS|COMP|CALC)[A-Z0-9_]*")
#: Words of a program that have no bearing on a table: units, path and display modes, dwells, messages, labels (what jumps
#: to them is refused), declarations without a table in them.
_MODE = r"(?:G(?!70|700)\d{1,3}|D0|SUPA|DISPLOF|DISPLON|SBLOF|SBLON)"
_IDLE_WORD = re.compile(
    r"METRIC|NEWCONF|STOPRE|M0?[01]|MSG ?\(.*\)|G0?4 ?[FS] ?=?[\d.]+|CHANDATA ?\( ?\d{1,3} ?\)|"
    rf"PROC [A-Z0-9_]+.*|REDEF .*|%|{_MODE}(?: {_MODE})*|[A-Z_][A-Z0-9_]{{1,31}}:|"
    r"DEF (?:INT|REAL|BOOL|CHAR|AXIS|STRING ?\[\d{1,3}\]) [A-Z0-9_, ]+|EXTERN [A-Z0-9_]+(?: ?\([A-Z, ]*\))?"
)
_END_WORD = re.compile(r"M17|M30|M0?2|RET")
_INCH_WORD = re.compile(r"INCH|G70|G700")
_NAME = re.compile(r"(?<!/)_N_([A-Z0-9_]{1,80})_([A-Z0-9]{2,4})(?![A-Z0-9_])")
_TEXT_HEADER = re.compile(r"%_N_([A-Z0-9_]{1,80})_([A-Z0-9]{2,4})(?![A-Z0-9_])")
_ASSIGNMENT = re.compile(r"\$ ?([A-Z0-9_]{1,60}) ?(?:\[([^\[\]=]{0,100})\])? ?= ?(.*)")
_BLOCK_NUMBER = re.compile(r"N ?\d{1,8}\s+")
_COMMA_NUMBER = re.compile(r"[+-]?\d{1,12},\d{1,15}")
_EXPONENT = re.compile(r"([+-]?(?:\d{1,12}\.?\d{0,15}|\.\d{1,15})) ?EX?([+-]?\d{1,3})")
_LONGEST_EXPONENT = 12
_MENTIONS_TABLE = re.compile(r"A[NA]_(?:CEC|ENC_COMP)")
_WRITES_TABLE = re.compile(r"\s*(?:N\d{1,8}\s+)?\$(?:AN_CEC|AA_ENC_COMP)\s*\[")
_TRUTH = {"TRUE": "1", "FALSE": "0"}


@dataclass
class Findings:
    """What was read beside the tables, for one line of summary.

    ``counts`` are by what was passed over, ``apart`` the tables of axes that the machine file lacks, ``notes`` what the
    user should know in words of their own.
    """

    counts: dict[str, int] = field(default_factory=dict)
    apart: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def count(self, what: str, number: int = 1) -> None:
        """Count something that was passed over or filled in."""
        self.counts[what] = self.counts.get(what, 0) + number

    def table(self, part: TableParts, prefix: str, travel_mm: tuple[float, float]) -> LinearTable:
        """Return the table of a real control, and note what is unusual about it; ``travel_mm`` of its input axis."""
        table, surplus, doubt_um = part.foreign_table(prefix)
        modulo = part.scalars.get(f"{prefix}_IS_MODULO")
        if modulo is None:
            self.count("tables without IS_MODULO (0 taken)")
        elif modulo.number() == -1:
            inside = float(table.start_mm) <= travel_mm[0] and travel_mm[1] <= float(table.last_mm)
            if not (inside or part.is_zero):
                raise modulo.fail(
                    f"-1 is neither 0 nor 1, and the travel {travel_mm[0]:g} ... {travel_mm[1]:g} mm leaves the table, so "
                    "that it matters: write what the control has"
                )
            self.count("times IS_MODULO = -1 (taken as 0)")
        if surplus:
            self.count("reserved nodes beyond MAX", surplus)
        if doubt_um >= WORTH_SAYING_UM:
            self.notes.append(
                f"{part.what}: MIN + k STEP does not meet MAX; between the last node before MAX and MAX the control may do "
                f"up to {doubt_um:.1f} um else than the straight line taken here"
            )
        return table

    def statements(self) -> list[str]:
        """Return the summary in at most one line of each kind."""
        found = []
        if self.counts:
            found.append(
                "passed over or filled in: " + ", ".join(f"{what} ({number})" for what, number in self.counts.items())
            )
        if self.apart:
            found.append("tables of axes that the machine file does not have, kept apart: " + "; ".join(self.apart))
        return found + list(dict.fromkeys(self.notes))


@dataclass(frozen=True)
class _Part:
    """One file of an archive: its name, its kind (``INI``, ``SPF``; empty: not said), and its numbered lines."""

    name: str
    kind: str
    lines: tuple[tuple[int, str], ...]

    @property
    def has_end(self) -> bool:
        """Whether some line is an end mark."""
        return any(_END_WORD.fullmatch(line.partition(";")[0].strip().upper()) for _, line in self.lines)

    @property
    def writes_tables(self) -> bool:
        """Whether some line, comments aside, gives a table a value."""
        return any(_WRITES_TABLE.match(line.upper()) for _, line in self.lines)


@dataclass(frozen=True)
class Foreign:
    """Assignments of a real file: those of the tables, and switches that stand elsewhere in an archive."""

    items: list[Assignment]
    machine_data: dict[tuple[str, tuple[str, ...]], Assignment]

    def switched_off(self, variable: str, index: tuple[str, ...]) -> bool:
        """Whether the machine data of an archive say 0 for a switch; False where they do not say it."""
        item = self.machine_data.get((variable, index))
        return item is not None and item.number() == 0


def foreign_assignments(files: Sequence[SourceFile], tables: Mapping[str, int], findings: Findings) -> Foreign:
    """Return the assignments of tables and switches of real files; InputError with the line for what is not understood.

    Parameters
    ----------
    files : archives, punched files, sub-programs; text as it was decoded, NUL bytes included.
    tables : the variables that are wanted, without ``$``, and how many indices each has.
    findings : gets what is passed over.
    """
    items: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    machine_data: dict[tuple[str, tuple[str, ...]], Assignment] = {}
    for source in files:
        parts = _parts(source)
        archive = len(parts) > 1
        for part in _with_data(source, parts, findings):
            beside = archive and not part.writes_tables
            if archive and part is parts[-1] and part.kind == "INI" and not part.has_end:
                message = (
                    f"the archive ends within {part.name}.{part.kind}: it was cut, and its switches are not all there"
                )
                raise source.fail(message, part.lines[-1][0])
            for item in _assignments(source, part, tables, findings, archive=archive):
                key = item.variable, item.index
                if item.variable in SWITCHES:
                    (machine_data if beside else items)[key] = item
                    continue
                first = items.setdefault(key, item)
                if first is not item and first.value != item.value:
                    raise item.fail(
                        f"is given a second value; the first is in {first.source.path.name}, line {first.line}"
                    )
    if not any(item.variable not in SWITCHES for item in items.values()):
        wanted = " or ".join(f"${name}" for name in tables if name in ("AN_CEC", "AA_ENC_COMP"))
        raise files[0].fail(f"holds no table ({wanted})")
    return Foreign(list(items.values()), machine_data)


def _with_data(source: SourceFile, parts: list[_Part], findings: Findings) -> list[_Part]:
    """The parts to be read: the only one, or the initialisation files of an archive; the others are counted."""
    if len(parts) == 1:
        return parts
    chosen = [part for part in parts if part.kind in DATA_KINDS]
    others = [part for part in parts if part.kind not in DATA_KINDS]
    writing = [f"{part.name}.{part.kind}" for part in others if part.writes_tables]
    if writing and not any(part.writes_tables for part in chosen):
        raise source.fail(f"tables stand in programs only ({_few(writing)}): give such a program as a file of its own")
    if others := [part for part in others if part.name]:
        named = f" (programs that write tables, not run here: {_few(writing)})" if writing else ""
        findings.count(f"other files of the archive{named}", len(others))
    return chosen


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _parts(source: SourceFile) -> list[_Part]:
    """The files that a text holds, split where NUL bytes or ``%_N_..`` lines name the next one."""
    found: list[_Part] = []
    name, kind = "", ""
    lines: list[tuple[int, str]] = []
    text = source.text.replace("\r\n", "\n").replace("\r", "\n")
    for number, line in enumerate(text.split("\n"), start=1):
        head, nul, rest = line.rpartition("\0")
        names = _NAME.findall(head) if nul else _TEXT_HEADER.findall(line.upper()[:120])
        if names or nul:  # NUL bytes without a name stand before what is no file of the control's memory (drives)
            found.append(_Part(name, kind, tuple(lines)))
            (name, kind), lines = names[-1] if names else ("", ""), []
        if nul or not names:
            code = rest if nul else line
            if code.strip():
                lines.append((number, code))
    found.append(_Part(name, kind, tuple(lines)))
    return [part for part in found if any(not code.lstrip().startswith(";") for _, code in part.lines)]


def _assignments(
    source: SourceFile, part: _Part, tables: Mapping[str, int], findings: Findings, *, archive: bool
) -> Iterator[Assignment]:
    """Assignments of one part that matter; the others are counted, what is not understood is refused."""
    ended, any_table, number = False, False, 0
    for number, line in part.lines:
        code = _BLOCK_NUMBER.sub("", line.partition(";")[0].strip().upper(), count=1)
        if not code or _TEXT_HEADER.match(code):
            continue
        if _END_WORD.fullmatch(code):
            ended = True
            continue
        match = _ASSIGNMENT.fullmatch(" ".join(code.split())) if code.startswith("$") else None
        if match is None:
            _check_word(source, number, code, archive=archive)
            if archive:
                findings.count("other lines")
            continue
        item = _item(source, number, match, tables, findings)
        if item is not None:
            if item.variable not in SWITCHES:
                any_table, ended = True, False
            yield item
    if any_table and not ended:
        raise source.fail("the end mark (M17, M30) behind the tables is missing: the file is truncated", number)


def _check_word(source: SourceFile, number: int, code: str, *, archive: bool) -> None:
    """Refuse what is no assignment and could change a table: inch, jumps, calculations, anything with a table in it."""
    if _INCH_WORD.fullmatch(code):
        raise source.fail(f"{code!r}: the file is in inch; tables are read in mm only", number)
    if _IDLE_WORD.fullmatch(code):
        return
    if not archive or _MENTIONS_TABLE.search(code):
        raise source.fail(
            f"{one_line(code)[:60]!r} is not understood, and it could change a table; give the archive of the control, or "
            "its NC_CEC.INI or AX_EEC.INI, or take the line out if it has no bearing on the tables",
            number,
        )


def _item(
    source: SourceFile, number: int, match: re.Match[str], tables: Mapping[str, int], findings: Findings
) -> Assignment | None:
    """One assignment if it is of the wanted tables; None for what is passed over."""
    variable, index_text, value = match.group(1), match.group(2) or "", match.group(3).strip()
    index = tuple(_plain(word) for word in re.split(r"[,.]", index_text)) if index_text.strip() else ()
    item = Assignment(variable, index, _plain_value(value)[0], source, number)
    if variable in tables or variable in SWITCHES:
        count = tables.get(variable) or SWITCHES[variable]
        if len(index) != count or not all(index):
            raise source.fail(f"${variable} has {count} indices; got [{one_line(index_text)[:40]}]", number)
        if variable in tables:
            if what := _plain_value(value)[1]:
                findings.count(what)
            return item
        findings.count("switches of other tables")
        return None
    if variable in HARMLESS:
        allowed = HARMLESS[variable]
        if allowed is not None and item.value not in allowed and value not in allowed:
            raise item.fail(f"{one_line(value)[:30]!r} is not understood; {' or '.join(allowed[:1])} is")
        findings.count("machine data beside the tables")
        return None
    if _OTHER_CEC.fullmatch(variable) and item.value in ("0", "0.0", "FALSE"):
        findings.count("machine data beside the tables")
        return None
    other_table = variable.startswith(("AN_CEC", "AA_ENC_COMP"))
    if other_table and _is_table(variable):
        findings.count("values of tables of the other kind (CEC, EEC)")
        return None
    if "CEC" in variable or "ENC_COMP" in variable:
        raise item.fail("is not known here, and it could change a table")
    if variable.startswith("MA_BACKLASH"):
        findings.count("lines of $MA_BACKLASH, which is no table and is not taken out")
        return None
    findings.count("other machine data")
    return None


_TABLE_VARIABLES = (
    "",
    "_STEP",
    "_MIN",
    "_MAX",
    "_IS_MODULO",
    "_INPUT_AXIS",
    "_OUTPUT_AXIS",
    "_DIRECTION",
    "_MULT_BY_TABLE",
)


def _is_table(variable: str) -> bool:
    """Whether a variable is one of the tables of either kind."""
    return any(variable == head + tail for head in ("AN_CEC", "AA_ENC_COMP") for tail in _TABLE_VARIABLES)


def _plain(word: str) -> str:
    """An index without blanks and leading zeros."""
    text = word.strip()
    return str(int(text)) if text.isdigit() and len(text) < 10 else text


def _plain_value(value: str) -> tuple[str, str]:
    """A value as the control writes it (1 for TRUE, a point, no exponent), and what was unusual about it."""
    if value in _TRUTH:
        return _TRUTH[value], ""
    if _COMMA_NUMBER.fullmatch(value):
        return value.replace(",", "."), "decimal commas"
    exponent = _EXPONENT.fullmatch(value)
    if exponent and abs(int(exponent.group(2))) <= _LONGEST_EXPONENT:
        return f"{Decimal(exponent.group(1)).scaleb(int(exponent.group(2))):f}", "numbers with an exponent"
    return value, ""
