"""What differs between the controls: codes, comments, decimals, the block that checks the work offset; tool tables."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from compgen.data.csv_files import csv_table
from compgen.data.files import read_text
from compgen.data.machine import Vector3
from compgen.errors import InputError

#: What a G code does, in words that the reader knows; codes that only change how the control moves do "nothing".
_COMMON = {
    **{f"G{k}": f"motion {k}" for k in range(4)},
    "G4": "dwell",
    **{"G17": "plane 2", "G18": "plane 1", "G19": "plane 0"},
    **{"G20": "inch", "G21": "mm", "G90": "absolute", "G91": "incremental"},
    **{"G94": "feed minute", "G95": "feed turn"},
    **{f"G{k}": "work offset" for k in range(54, 60)},
    **dict.fromkeys(("G9", "G40", "G61", "G64", "G97"), "nothing"),
}
_CYCLES = {f"G{k}": f"cycle {k}" for k in (81, 82, 83, 85, 86, 89)}
_GRBL = {
    **_COMMON,
    **{"G28": "home", "G30": "home", "G53": "machine coordinates", "G80": "no motion", "G93": "feed inverse"},
    **{"G43.1": "tool offset", "G49": "no tool", "G92": "preset", "G92.1": "no preset", "G91.1": "centre incremental"},
}
_LENGTH = {"G43": "tool", "G49": "no tool", "G98": "initial level", "G99": "R level", "G73": "cycle 73"}
_LINUXCNC = {
    **_GRBL,
    **_CYCLES,
    **_LENGTH,
    **{"G90.1": "centre absolute", "G92.2": "no preset", "G43.1": "tool offset", "G8": "nothing"},
    **dict.fromkeys(("G59.1", "G59.2", "G59.3"), "work offset"),
    **dict.fromkeys(("G7", "G61.1"), "nothing"),
}
del _LINUXCNC["G7"]  # lathe diameter mode
_FANUC = {
    **_COMMON,
    **_CYCLES,
    **_LENGTH,
    **{"G28": "home", "G30": "home", "G53": "machine coordinates", "G80": "no motion", "G93": "feed inverse"},
    **{"G54.1": "work offset", "G84": "cycle 84", "G74": "cycle 84", "G92": "preset", "G92.1": "no preset"},
    # G50, G50.1, G69, G15, G67: scaling, mirror image, rotation, polar coordinates, macro calls off; G60: from one side
    **dict.fromkeys(("G8", "G15", "G50", "G50.1", "G60", "G61.1", "G62", "G63", "G67", "G69", "G13.1"), "nothing"),
}
_SIEMENS = {
    **_COMMON,
    **{"G70": "inch", "G700": "inch", "G71": "mm", "G710": "mm", "G500": "no work offset", "G93": "feed inverse"},
    **{"G53": "machine coordinates", "G153": "machine coordinates", "SUPA": "machine coordinates"},
    **{"G74": "unknown position", "G75": "unknown position"},
    **{f"G{k}": "work offset" for k in range(505, 600)},
    **dict.fromkeys(("G60", "G601", "G602", "G603", "G641", "G642", "G643", "G644", "G645"), "nothing"),
    **dict.fromkeys(
        ("FFWON", "FFWOF", "SOFT", "BRISK", "DRIVE", "COMPOF", "CFC", "CFTCP", "CFIN", "STOPRE"), "nothing"
    ),
    **dict.fromkeys(
        ("NORM", "ROTOF", "TRAFOOF", "DIAMOF", "CDOF", "KONT", "KONTC", "KONTT", "G450", "G451"), "nothing"
    ),
}
for _code in ("G20", "G21"):
    del _SIEMENS[_code]
_HEIDENHAIN = {
    **_COMMON,
    **{"G70": "inch", "G71": "mm", "G29": "pole here", "G30": "blank", "G31": "blank", "G99": "tool definition"},
    **dict.fromkeys(("G51",), "nothing"),
}
for _code in ("G20", "G21", "G94", "G95", "G61", "G64", "G97", "G9", *(f"G{k}" for k in range(54, 60))):
    del _HEIDENHAIN[_code]

_CAM = "post the path of the tool centre from CAM and correct that"
#: Why a code is refused, and what to do; the same in all dialects unless a dialect gives the code a meaning.
REFUSED = {
    **dict.fromkeys(("G41", "G42", "G41.1", "G42.1"), f"cutter radius compensation is not followed; {_CAM}"),
    **dict.fromkeys(("G68", "G68.2", "G16", "G51", "G51.1", "G24", "G52"), "turned, scaled, mirrored or shifted coordinates "
                    "are not followed; post the program without them"),
    **dict.fromkeys(("G5", "G5.1", "G5.2", "G5.3", "G6", "G6.1", "G6.2"), "splines are not followed; post lines and arcs"),
    **dict.fromkeys(("G65", "G66", "M98", "M97", "M198"), "subprograms and macros are not followed; post one program "
                    "without calls"),
    "G10": "writes offsets while the program runs, so that they are not known; set them at the control",
    "G44": "negative tool length is not followed; use G43",
    "M99": "a program that repeats itself is not followed; end it with M30",
    "G96": "constant surface speed belongs to turning",
}  # fmt: skip
_M_CODES = (*range(10), 10, 11, 13, 14, 19, 29, 30, *range(40, 46), 48, 49, 60)
#: The M codes that act when the block ends, so that they follow the last piece of a divided block.
AT_THE_END = {"M0", "M1", "M2", "M5", "M9", "M30", "M60", "G9"}

_VALUE = r"[+-]?\s*(?:\d+\.?\d*|\.\d+)"
_PARENTHESES = r"\([^()\n]*\)"


@dataclass(frozen=True)
class Dialect:
    """How programs of a control are written.

    ``codes`` gives the meaning of G codes (and of words in letters), ``end`` the codes that end a program; ``decimals``
    those of mm and inch. ``point_needed``: whole numbers without a decimal point may be increments.
    """

    name: str
    codes: Mapping[str, str]
    comments: str
    comment: str
    decimals: tuple[int, int] = (3, 4)
    words: str = rf"([A-Z])\s*({_VALUE})"
    m_codes: frozenset[str] = frozenset(f"M{k}" for k in _M_CODES)
    end: frozenset[str] = frozenset(("M2", "M30"))
    end_needed: bool = True
    point_needed: bool = False
    work_offset: str = "G54"
    pole: bool = False
    tool_by_number: bool = False
    check: Sequence[str] = ()

    def word_pattern(self) -> re.Pattern[str]:
        """Return the pattern of one word: its address and value, or a comment."""
        return re.compile(rf"\s*(?:{self.words}|({self.comments}))", re.IGNORECASE)

    def said(self, text: str) -> str:
        """Return ``text`` as a comment block."""
        clean = "".join(c if c.isalnum() or c in " .,:;=+-_/%" else " " for c in text)
        return self.comment.format(clean.replace(";", ",").upper())


#: An address of more than one letter needs its equals sign; CR5 is none.
_SIEMENS_WORDS = rf"((?:CR|TURN)(?=\s*=)|[A-Z])\s*=?\s*({_VALUE}|\"[^\"]*\")"
DIALECTS = {
    item.name: item
    for item in (
        Dialect(
            "fanuc",
            _FANUC,
            _PARENTHESES,
            "({})",
            point_needed=True,
            # custom macro: system variables 5221 ... are the offsets of G54
            check=(
                "IF[ABS[#{variable}-[{value}]]LE0.001]GOTO{label}",
                "#3000=1({name} IS NOT THAT OF THE CORRECTION)",
                "N{label}",
            ),
        ),
        Dialect(
            "siemens",
            _SIEMENS,
            r"\bMSG\s*\([^\n]*\)|;[^\n]*",
            "; {}",
            words=_SIEMENS_WORDS,
            m_codes=frozenset(f"M{k}" for k in (*_M_CODES, 17, 70)),
            end=frozenset(("M2", "M17", "M30")),
            tool_by_number=True,
            check=(
                "IF ABS($P_UIFR[{number},{axis},TR]-({value}))<=0.001 GOTOF VC{label}",
                'MSG("{name} is not that of the correction")',
                "M30",
                "VC{label}:",
            ),
        ),
        Dialect(
            "heidenhain-iso",
            _HEIDENHAIN,
            r";[^\n]*",
            "; {}",
            decimals=(4, 5),
            m_codes=frozenset(f"M{k}" for k in (*_M_CODES, 15, 16, 90)),
            end=frozenset(("M2", "M30", "%")),
            work_offset="PRESET",
            pole=True,
            tool_by_number=True,
        ),
        Dialect(
            "linuxcnc",
            _LINUXCNC,
            _PARENTHESES + r"|;[^\n]*",
            "({})",
            decimals=(5, 6),
            end=frozenset(("M2", "M30", "%")),
            check=(
                "o<volcomp{label}> if [ABS[#{variable}-[{value}]] GT 0.001]",
                "(abort, {name} is not that of the correction)",
                "o<volcomp{label}> endif",
            ),
        ),
        Dialect("grbl", _GRBL, _PARENTHESES + r"|;[^\n]*", "({})", end_needed=False),
    )
}  # fmt: skip


def dialect_named(name: str) -> Dialect:
    """Return a dialect by its name."""
    if name not in DIALECTS:
        raise InputError(f"dialect {name!r} is not known; use {', '.join(DIALECTS)}")
    return DIALECTS[name]


def read_tools(path: str | Path) -> dict[str, Vector3]:
    """Read a tool table: offsets X, Y, Z in mm that the control adds, by number or name of the tool.

    A CSV file with the columns ``tool, length_mm`` and, if the tool is off-centre, ``x_mm, y_mm``; or a tool table of
    LinuxCNC in mm (``T1 P1 X0 Y0 Z101.5 D6``).
    """
    text = read_text(path)
    first = next((line for line in text.splitlines() if line.strip() and line.strip()[0] not in "#;"), "")
    if re.match(r"\s*T\d+\s", first):
        tools = {}
        for number, line in enumerate(text.splitlines(), 1):
            words = dict(re.findall(rf"([A-Z])({_VALUE})(?=\s|$)", line.split(";")[0].upper()))
            if "T" not in words:
                if line.split(";")[0].strip():
                    raise InputError("expected a line such as T1 P1 Z101.5 D6", file=path, line=number)
                continue
            x, y, z = (float(words.get(letter, 0.0)) for letter in "XYZ")
            tools[str(int(words["T"]))] = (x, y, z)
        return tools
    table = csv_table(Path(path), text, required=("tool", "length_mm"), optional=("x_mm", "y_mm"))
    names, columns = table.text("tool"), [table.numbers("length_mm")]
    columns += [table.numbers(name) if name in table.columns else 0.0 * columns[0] for name in ("x_mm", "y_mm")]
    found: dict[str, Vector3] = {}
    for row, name in enumerate(names):
        key = str(int(name)) if name.isdigit() else name.upper()
        if key in found:
            raise table.fail(row, "tool", f"tool {name} appears twice")
        found[key] = (float(columns[1][row]), float(columns[2][row]), float(columns[0][row]))
    return found
