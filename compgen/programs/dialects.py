"""What differs between the controls: codes, comments, decimals, the block that checks the work offset; tool tables."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from compgen.data.csv_files import csv_table
from compgen.data.files import read_text
from compgen.data.machine import Vector3
from compgen.errors import InputError, program_text, visible_line

#: What a G code does, in words that the reader knows; codes that only change how the control moves do "nothing".
#: A "setting" takes all words of its block as its own; "setting P0" is one with P0 only.
_COMMON = {
    **{f"G{k}": f"motion {k}" for k in range(4)},
    "G4": "dwell",
    **{"G17": "plane 2", "G18": "plane 1", "G19": "plane 0"},
    **{"G20": "inch", "G21": "mm", "G90": "absolute", "G91": "incremental"},
    **{"G94": "feed minute", "G95": "feed turn"},
    **{f"G{k}": "work offset" for k in range(54, 60)},
    **dict.fromkeys(("G9", "G61", "G64", "G97"), "nothing"),
    "G40": "compensation 0",
}
_SIDES = {"G41": "compensation 1", "G42": "compensation -1"}
_CYCLES = {f"G{k}": f"cycle {k}" for k in (81, 82, 83, 85, 86, 89)}
_GRBL = {
    **_COMMON,
    **{"G28": "home", "G30": "home", "G53": "machine coordinates", "G80": "no motion", "G93": "feed inverse"},
    **{"G28.1": "store home", "G30.1": "store home"},
    **{"G43.1": "tool offset", "G49": "no tool", "G92": "preset", "G92.1": "no preset", "G91.1": "centre incremental"},
    **{f"G38.{k}": "probe" for k in range(2, 6)},
    "G10": "write offset",
}
_LENGTH = {"G43": "tool", "G49": "no tool", "G98": "initial level", "G99": "R level", "G73": "cycle 73"}
_LINUXCNC = {
    **_GRBL,
    **_SIDES,
    **{"G41.1": "compensation 1", "G42.1": "compensation -1"},
    **_CYCLES,
    **_LENGTH,
    **{"G90.1": "centre absolute", "G92.2": "no preset", "G43.1": "tool offset", "G8": "nothing"},
    **{"G52": "preset shift", "G33.1": "tap"},
    **dict.fromkeys(("G59.1", "G59.2", "G59.3"), "work offset"),
    **dict.fromkeys(("G61.1",), "nothing"),
}
_FANUC = {
    **_COMMON,
    **_SIDES,
    **_CYCLES,
    **_LENGTH,
    **{"G28": "home", "G30": "home", "G53": "machine coordinates", "G80": "no motion", "G93": "feed inverse"},
    **{"G54.1": "work offset", "G92": "preset", "G92.1": "no preset", "G52": "shift", "G31": "probe"},
    "G10": "write offset",
    # left-hand and right-hand tapping feed out, fine boring and boring by hand do not; Q of G76 is a way aside at the bottom
    **{"G74": "cycle 84", "G84": "cycle 84", "G76": "cycle 86", "G88": "cycle 86"},
    # Haas: offsets G110 to G129 and G154 P1 to P99
    **{f"G{k}": "work offset" for k in (*range(110, 130), 154)},
    "G39": "arc about the corner",
    # smoothing and look-ahead (G5, G5.1, G8; Haas G103, G187), supervision of travel and spindle, error of the workpiece off
    **{"G5": "setting P0 P10000", "G54.2": "setting P0", "G54.4": "setting P0"},
    **dict.fromkeys(("G5.1", "G8", "G103", "G187", "G22", "G23", "G25", "G26"), "setting"),
    # G50, G50.1, G69, G15, G67: scaling, mirror image, rotation, polar coordinates, macro calls off; G60: from one side
    **dict.fromkeys(("G11", "G15", "G50", "G50.1", "G60", "G61.1", "G62", "G63", "G67", "G69", "G13.1"), "nothing"),
}
_SIEMENS = {
    **_COMMON,
    **_SIDES,
    **{"G70": "inch", "G700": "inch", "G71": "mm", "G710": "mm", "G500": "no work offset", "G93": "feed inverse"},
    **{"G53": "machine coordinates", "G153": "machine coordinates", "SUPA": "machine coordinates"},
    **{"G74": "unknown position", "G75": "unknown position", "TRANS": "shift all", "ATRANS": "shift more"},
    **{"ROT": "shift off", "SCALE": "shift off", "MIRROR": "shift off", "MCALL": "modal call"},
    **dict.fromkeys((*(f"CYCLE{k}" for k in range(81, 90)), "CYCLE840"), "drill here"),
    **dict.fromkeys((f"CYCLE{k}" for k in range(971, 998)), "probe"),
    **{f"G{k}": "work offset" for k in range(505, 600)},
    **dict.fromkeys(("G60", "G601", "G602", "G603", "G641", "G642", "G643", "G644", "G645", "G290"), "nothing"),
    **dict.fromkeys(
        ("FFWON", "FFWOF", "SOFT", "SOFTA", "BRISK", "BRISKA", "DRIVE", "COMPON", "COMPOF", "COMPCAD"), "nothing"
    ),
    **dict.fromkeys(
        ("COMPCURV", "COMPSURF", "CFC", "CFTCP", "CFIN", "STOPRE", "UPATH", "SPATH", "FNORM", "FLIN"), "nothing"
    ),
    **dict.fromkeys(("DYNNORM", "DYNPOS", "DYNROUGH", "DYNSEMIFIN", "DYNFINISH", "DYNPREC"), "nothing"),
    **dict.fromkeys(("G25", "G26"), "setting"),
    **dict.fromkeys(("ORIAXES", "ORIVECT", "ORIMKS", "ORIWKS", "ORIEULER", "ORIRPY", "OSOF", "OSC", "OST"), "nothing"),
    **dict.fromkeys(("TRAFOOF", "DIAMOF", "CDOF", "CDOF2", "CDON", "CUT2D", "CUTCONOF"), "nothing"),
    # radius compensation: how the tool comes to a contour, and goes about an outer corner; settings of G147 and G148
    **dict.fromkeys(("NORM", "KONT", "KONTC", "KONTT", "G460", "G461", "G462"), "way"),
    **dict.fromkeys(("G450", "G451", "DISC"), "corner"),
    **dict.fromkeys(("G140", "G141", "G142", "G143", "G340", "G341"), "nothing"),
}
for _code in ("G20", "G21"):
    del _SIEMENS[_code]
_HEIDENHAIN = {
    **_COMMON,
    **_SIDES,
    **{"G70": "inch", "G71": "mm", "G29": "pole here", "G30": "blank", "G31": "blank", "G99": "tool definition"},
    **{"G5": "last arc", "G54": "shift", "G98": "label", "FMAX": "rapid once"},
    # a cycle is defined by its block and executed by G79, M99, or by all positions after M89
    **{"G79": "drill here", "M99": "drill here", "M89": "calls", "M91": "machine coordinates"},
    **dict.fromkeys(("G83", "G84", "G85"), "definition"),
    **{f"G{k}": "probe" for k in range(400, 500)},
    # G62 is the tolerance (cycle 32), G36 turns the spindle, G38 stops, G51 names the next tool
    **{"G62": "setting", "G36": "setting", "G38": "nothing", "G51": "setting"},
}
#: Words of Klartext: the letters that begin a move, its sense, and the M codes that change it.
_KLARTEXT = {
    **{"L": "motion 1", "DR-": "motion 2", "DR+": "motion 3", "FMAX": "rapid once"},
    **dict.fromkeys(("C", "CR", "CC"), "nothing"),
    **{"R0": "compensation 0", "RL": "compensation 1", "RR": "compensation -1"},
    **{"CC here": "pole here", "CP": "helix", "CYCL CALL": "drill here", "M99": "drill here", "M89": "calls"},
    **{"M91": "machine coordinates", "M92": "unknown position", "M140": "lost height"},
    **{"APPR": "approach", "DEP": "departure", "DEP away": "departs", "C round": "full circle"},
}
for _code in ("G20", "G21", "G94", "G95", "G61", "G64", "G97", "G9", *(f"G{k}" for k in range(55, 60))):
    del _HEIDENHAIN[_code]

_CAM = "post the path of the tool centre from CAM and correct that"
_TURNED = "turned, scaled or mirrored coordinates are not followed; post the program without them"
_CALLED = "post one program without calls"
_MACRO = f"subprograms and macros are not followed; {_CALLED}"
_MILLED = "milling cycles are not followed; post their moves"
_POLAR = "polar coordinates are not followed; post X and Y"
_ROUNDED = "chamfers and roundings that the control makes are not followed; post their lines and arcs"
_PROBED = "where a probe stops is not known; take probing out of the program"
_ROTARY = "moves of rotary axes and a turned plane are not followed; post a program with X, Y and Z"
_SPLINE = "splines are not followed; post lines and arcs"
_PATTERN = "patterns of holes are not followed; post X and Y of each hole"
_TURNING = "belongs to turning; correct programs for milling"
_TABLES = "writes offsets that the correction does not follow; set them at the control"
_UNITS_OF_MACH = "is inch or mm on Mach3 and Mach4, a turning cycle on LinuxCNC; post G20 or G21"
#: Why a code is refused, and what to do; the same in all dialects unless a dialect gives the code a meaning.
REFUSED = {
    **dict.fromkeys(("G41", "G42"), f"the control has no cutter radius compensation; {_CAM}"),
    **dict.fromkeys(("G41.1", "G42.1"), f"a direction that is kept normal to the contour is not followed; {_CAM}"),
    **dict.fromkeys(("G68", "G68.2", "G51", "G51.1", "G24"), _TURNED),
    ",": _ROUNDED,
    "G52": "shifts of coordinates are not known in this dialect; post the program without them",
    "G16": _POLAR,
    **dict.fromkeys(("G5", "G5.1", "G5.2", "G5.3", "G6", "G6.1", "G6.2"), _SPLINE),
    **dict.fromkeys(("M95", "M96", "M199"), f"jumps, or lets something interrupt the program; {_CALLED}"),
    **dict.fromkeys(("G65", "G66", "M98", "M97", "M198"), f"{_MACRO}, or M98 and G65 with "
                    "the subprogram in the same file, or in a folder that --subprograms names"),
    "G10": _TABLES,
    "G44": "negative tool length is not followed; use G43",
    **dict.fromkeys(("G43.4", "G43.5", "G12.1", "G7.1", "G107", "G143", "G53.1"), _ROTARY),
    **dict.fromkeys(("G54.2", "G54.4"), "the offset of a table or of a workpiece is not known; post the program without it"),
    **dict.fromkeys(("G12", "G13", "G47", "G150"), _MILLED),
    **dict.fromkeys(("G70", "G71", "G72"), _PATTERN),
    **dict.fromkeys(("G27", "G31", "G35", "G36", "G37", "G136", *(f"G38.{k}" for k in range(2, 8))), _PROBED),
    **dict.fromkeys(("G33", "G33.1", "G34", "G76"), "threads by a moving spindle are not followed; post a tapping cycle"),
    "G38": f"a vector of radius compensation that is kept is not followed; {_CAM}",
    **dict.fromkeys(("G45", "G46", "G48"), f"moves that are longer by a tool offset are not followed; {_CAM}"),
    "G87": "back boring moves aside within the hole and is not followed; post its moves",
    "G92.3": "restores an offset of another program, which is not known; post G92",
    "M99": "a program that repeats itself is not followed; end it with M30",
    **dict.fromkeys(("M70", "M71", "M72", "M73"), "modal states that are kept and restored are not followed; "
                    "post the codes themselves"),
    **dict.fromkeys(("G7", "G96"), f"constant surface speed and diameters: {_TURNING}"),
}  # fmt: skip
_HEIDENHAIN_REFUSED = {
    **dict.fromkeys(("G10", "G11", "G12", "G13", "G15", "G16"), _POLAR),
    **dict.fromkeys(("G24", "G25"), _ROUNDED),
    **dict.fromkeys(("G26", "G27"), "approaches on a tangent arc are not followed; post their lines and arcs"),
    **dict.fromkeys(("G43", "G44"), f"compensation along an axis is not followed; {_CAM}"),
    **dict.fromkeys(("G28", "G72", "G73", "G80"), _TURNED),
    "G6": "an arc on a tangent has no centre; post G2 or G3",
    "G7": "moves along single axes by G7 are not followed; post G1",
    "G39": _MACRO,
    "G53": "datums of a table are not known; post G54 with X, Y and Z",
    "G247": "the datum that the program chooses is not known; choose it at the control",
    **dict.fromkeys((f"G{k}" for k in (37, *range(56, 60), *range(74, 79), *range(120, 126), 127)), _MILLED),
    **dict.fromkeys((f"G{k}" for k in (204, 208, *range(210, 240), *range(251, 300))), _MILLED),
    "G55": _PROBED,
    **dict.fromkeys(("M92", "M104"), "positions from a point of the maker, and older datums, are not known; use M91"),
    **dict.fromkeys(("M112", "M113", "M114", "M115", "M128", "M130", "M138", "M144"), _ROTARY),
    **dict.fromkeys(("M142", "M143"), "deletes settings that the program does not show; post the program without it"),
    "M118": "X, Y and Z of M118 are ways of the handwheel, and read like a move; post the program without it",
    "M140": "how far the tool goes back is not known; post the move",
}  # fmt: skip
_SIEMENS_REFUSED = {
    **dict.fromkeys(("G58", "G59"), "G58 and G59 with X, Y, Z shift coordinates on some controls and choose offsets on others; "
                    "post TRANS and ATRANS, or G505"),
    **dict.fromkeys(("ROT", "AROT", "ROTS", "AROTS", "CROTS", "RPL", "SCALE", "ASCALE", "MIRROR", "AMIRROR"), _TURNED),
    **dict.fromkeys(("TRAORI", "TRANSMIT", "TRACYL", "TRAANG", "CYCLE800", "TOFRAME", "TOROT", "TCARR"), _ROTARY),
    **dict.fromkeys(("G110", "G111", "G112", "AP", "RP"), _POLAR),
    **dict.fromkeys(("CHF", "CHR", "RND", "RNDM"), _ROUNDED),
    **dict.fromkeys(("CIP", "CT", "AR", "I1", "J1", "K1"), "arcs through a point, on a tangent or by an angle are not followed; "
                    "post G2 and G3 with I, J, K or CR="),
    **dict.fromkeys(("ASPLINE", "BSPLINE", "CSPLINE", "POLY", "INVCW", "INVCCW"), _SPLINE),
    **dict.fromkeys(("G331", "G332"), "threads by a moving spindle are not followed; post CYCLE84"),
    **dict.fromkeys(("IF", "ELSE", "ENDIF", "GOTO", "GOTOF", "GOTOB", "GOTOC", "FOR", "WHILE", "LOOP", "REPEAT", "CASE", "DEF"),
                    "variables, conditions and loops are not followed; post the program with numbers"),
    **dict.fromkeys(("CALL", "PCALL", "EXTERN", "EXTCALL", "PROC", "EXECTAB", "SAVE"), _MACRO),
    **dict.fromkeys(("G147", "G148", "G247", "G248", "G347", "G348", "DISR", "DISCL"),
                    "soft approaches and retractions of the control are not followed; post their lines and arcs"),
    "CUTCONON": f"radius compensation that is suppressed within a contour is not followed; {_CAM}",
    "CUT2DF": f"radius compensation in the plane of a turned frame is not followed; {_CAM}",
    "OFFN": "an allowance on the contour (OFFN) is not known to the correction; post the contour with it",
    **dict.fromkeys(("HOLES1", "HOLES2", "CYCLE801", "CYCLE802"), _PATTERN),
    **dict.fromkeys(("LONGHOLE", "SLOT1", "SLOT2", "POCKET1", "POCKET2", "POCKET3", "POCKET4"), _MILLED),
    **dict.fromkeys((f"CYCLE{k}" for k in (*range(60, 65), *range(70, 80), 90, 899)), _MILLED),
    "G291": "programs in the ISO dialect are read with --dialect fanuc",
}  # fmt: skip
_M_CODES = (*range(10), 10, 11, 13, 14, 19, 29, 30, *range(40, 46), 48, 49, 60)
#: The M codes that act when the block ends, so that they follow the last piece of a divided block.
#: M97 and M98 of HEIDENHAIN are about the corner at the end of their block.
AT_THE_END = {"M0", "M1", "M2", "M5", "M9", "M30", "M60", "M97", "M98", "G9"}
#: Text in the first comment of a corrected program.
MARK = "CORRECTED BY VOLCOMP"

# what repeats keeps what it has taken (++, *+): a block that is no word is refused in a time that grows with its length
VALUE = r"(?:[+-]\s*+)?(?:\d++(?:\.\d*+)?|\.\d++)"
#: The end of a block within a line, and nothing after it.
_ENDS = r";[; \t\r]*+$"
_PARENTHESES = r"\([^()\n]*\)"
_WORDS = rf"(?P<address>[A-Z])\s*+(?P<value>{VALUE})"
#: A word of a tool table of LinuxCNC, and the longest name of a tool.
_TOOL_WORD = re.compile(r"([TPXYZABCUVWDIJQ])([+-]?(?:\d{1,9}(?:\.\d{0,20})?|\.\d{1,20}))", re.ASCII)
_LONGEST_NAME = 80


@dataclass(frozen=True)
class Dialect:
    """How programs of a control are written.

    ``codes`` gives the meaning of G codes (and of words in letters), ``refused`` says why others are not followed, ``end``
    names the codes that end a program; ``decimals`` are those of mm and inch. ``comments`` is the pattern of comments,
    ``settings`` of what moves nothing and is more than a word. ``point_needed``: whole numbers without a decimal point
    may be increments. ``semicolon_ends``: ``;`` begins no comment, it ends a block, and nothing follows it in a line.
    """

    name: str
    codes: Mapping[str, str]
    comments: str
    comment: str
    settings: str = ""
    decimals: tuple[int, int] = (3, 4)
    refused: Mapping[str, str] = field(default_factory=lambda: REFUSED)
    words: str = _WORDS
    m_codes: frozenset[str] = frozenset(f"M{k}" for k in _M_CODES)
    end: frozenset[str] = frozenset(("M2", "M30"))
    end_needed: bool = True
    point_needed: bool = False
    semicolon_ends: bool = False
    work_offset: str = "G54"
    pole: bool = False
    tool_by_number: bool = False
    check: Sequence[str] = ()
    #: What ``check`` asks for a work offset by its name: the variable of X, or the number of a frame; None if it has none.
    register: Callable[[str], int | None] = lambda _: None
    #: Largest difference that ``check`` lets pass, mm and inch.
    check_within: tuple[str, str] = ("0.001", "0.00004")
    #: Lines that a control demands before all others, beside % and the number of the program.
    first: str = ""
    #: Whether the control counts in the units of its machine until the program says which.
    starts_in_its_units: bool = True
    #: What else may shift the coordinates at the control, and is not checked.
    beside: str = ""
    #: Characters of a block that the control takes, without the end of line; None where no document says. ``bare``: blanks
    #: and comments do not count.
    longest_block: int | None = None
    bare: bool = False
    #: Digits of a number that the control reads.
    most_digits: int = 15
    #: Decimals of F under G93 and its largest value; None where no document says.
    inverse_time: tuple[int, float] | None = None

    def length_of(self, block: str) -> int:
        """Return how many characters of a block count for the control."""
        block = block.rstrip("\r\n")
        return len(re.sub(rf"{self.comments}|\s", "", block)) if self.bare else len(block)

    @property
    def klartext(self) -> bool:
        """Whether blocks are those of HEIDENHAIN in plain language: L X+10 R0 FMAX."""
        return self.name == "heidenhain-klartext"

    def word_pattern(self) -> re.Pattern[str]:
        """Return the pattern of one word: its address and value, or a comment."""
        comments = [
            self.comments,
            *([self.settings] if self.settings else []),
            *([_ENDS] if self.semicolon_ends else []),
        ]
        return re.compile(rf"\s*+(?:{self.words}|(?P<comment>{'|'.join(comments)}))", re.IGNORECASE)

    def said(self, text: str) -> str:
        """Return ``text`` as a comment block."""
        return self.comment.format(program_text(text.replace(";", ",")).upper())

    def head(self) -> re.Pattern[bytes]:
        """Return the pattern of a line that has to stay before all others: %, the number or name of the program."""
        first = rf"|{self.first}" if self.first else ""
        return re.compile(rf"\s*+(?:(?:N\d+\s*+)?%|[O:]\d|<[^<>]*+>{first})".encode(), re.IGNORECASE)

    def without_words(self) -> re.Pattern[bytes]:
        """Return the pattern of a line with nothing but comments."""
        end = "|;" if self.semicolon_ends else ""
        return re.compile(rf"(?:\s|{self.comments}{end})*+".encode(), re.IGNORECASE)


#: An address of more than one letter needs its equals sign; CR5 is none. X=IC(5) is 5 from where X is, X=AC(5) from its zero.
_SIEMENS_WORDS = (
    r"(?P<address>(?:CR|TURN|[XYZ]1)(?=\s*+=)|(?![SM]\d++\s*+=)[A-Z])\s*+(?:=\s*+(?:(?P<mode>AC|IC|DC|ACP|ACN)\s*+\(\s*+)?)?"
    rf"(?P<value>{VALUE}|\"[^\"]*\")(?(mode)\s*+\))"
)
_CALLS = "MSG|GROUP_BEGIN|GROUP_END|GROUP_ADDEND|WORKPIECE|CYCLE832|SETMS|FGROUP|PROTS"
_ASSIGNED = r"(?:SPOSA?|LIMS|OVR|OVRRAP|CTOL|OTOL|ATOL|ADIS|ADISPOS|ACC|VELOLIM|JERKLIM|FA|SCC|SVC|S\d|M\d+)"
#: Calls, axis functions and labels of SINUMERIK that move nothing of X, Y and Z.
_SIEMENS_SETTINGS = (
    r"\bMSG\s*+\((?:\"[^\"\n]*+\"|[^()\"\n]|\([^()\n]*+\))*+\)"
    rf"|\b(?:{_CALLS})\s*+\((?:\"[^\"\n]*\"|[^()\"\n])*+\)|\bCYCLE800\s*+\(\s*+\)|\bCYCLE832\b(?!\s*+\()"
    rf"|\b{_ASSIGNED}\s*+(?:\[\s*+\w++\s*+\]\s*+)?=\s*+(?:(?:AC|IC|DC|ACP|ACN)\s*+\(\s*+{VALUE}\s*+\)|{VALUE})"
)


def _register_of_fanuc(name: str) -> int | None:
    """System variable of X of a work offset: G54 to G59, G54.1 P1 to P300; of Haas G110 to G129 and G154 P1 to P99."""
    kind, _, text = name.partition("P")
    number = int(text) if text.isdigit() and len(text) < 5 else 0
    if kind == "G54.1" and 1 <= number <= 300:
        return (7001 if number <= 48 else 14001) + 20 * (number - 1)
    if kind == "G154" and 1 <= number <= 99:
        return 7001 + 20 * (number - 1) if number <= 20 else 14401 + 20 * (number - 21)
    names = {**{f"G{54 + k}": 5221 + 20 * k for k in range(6)}, **{f"G{110 + k}": 7001 + 20 * k for k in range(20)}}
    return names.get(name)


def written_offset(dialect: str, values: Mapping[str, float], active: str) -> str | None:
    """Return the name of the work offset that G10 writes; None if it writes anything else (tools, the external offset)."""
    what, number = values.get("L"), values.get("P")
    if what not in (2.0, 20.0) or number is None or number != int(number) or values.get("R", 0.0):
        return None
    k = int(number)
    if dialect == "fanuc":
        if what == 20.0:
            return f"G54.1P{k}" if 1 <= k <= 300 else None
        return f"G{53 + k}" if 1 <= k <= 6 else None
    names = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3")[: 6 if dialect == "grbl" else 9]
    return (active or "G54") if k == 0 else names[k - 1] if 1 <= k <= len(names) else None


def _register_of_linuxcnc(name: str) -> int | None:
    """Parameter of X of a work offset: G54 to G59.3."""
    names = ("G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3")
    return 5221 + 20 * names.index(name) if name in names else None


def _register_of_siemens(name: str) -> int | None:
    """Number of the settable frame: G54 to G57 (to G59 of small controls), G505 to G599."""
    number = int(name[1:]) if name[1:].isdigit() else 0
    return number - 53 if 54 <= number <= 59 else number - 500 if 505 <= number <= 599 else None


DIALECTS = {
    item.name: item
    for item in (
        Dialect(
            "fanuc",
            _FANUC,
            _PARENTHESES,
            "({})",
            semicolon_ends=True,
            point_needed=True,
            most_digits=8,  # alarm 003; operator's manual of Series 16/18/160/180, range of addresses
            inverse_time=(3, 9999.999),  # the same, G93
            # custom macro: system variables 5221 ... are the offsets of G54
            register=_register_of_fanuc,
            check_within=("0.001", "0.00006"),  # the last decimal of an offset is 0.0001 inch
            beside="the external offset (EXT, #5201 to #5203) is 0",
            check=(
                "IF[ABS[#{variable}-[{value}]]LE{within}]GOTO{label}",
                "#3000=1({name} IS NOT THAT OF THE CORRECTION)",
                "N{label}",
            ),
        ),
        Dialect(
            "siemens",
            _SIEMENS,
            r";[^\n]*",
            "; {}",
            settings=_SIEMENS_SETTINGS,
            refused={**REFUSED, **_SIEMENS_REFUSED},
            words=_SIEMENS_WORDS,
            m_codes=frozenset(f"M{k}" for k in (*_M_CODES, 17, 70)),
            end=frozenset(("M2", "M17", "M30")),
            tool_by_number=True,
            longest_block=511,  # 512 with the line feed: Programming Manual Fundamentals
            first=r";\s*+\$",  # the path of an archive: ;$PATH=/_N_WKS_DIR
            register=_register_of_siemens,
            beside="fine offsets, rotations and the basic offset are 0",
            check=(
                "IF ABS($P_UIFR[{number},{axis},TR]-({value}))<={within} GOTOF VC{label}",
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
            refused={**REFUSED, **_HEIDENHAIN_REFUSED},
            words=rf"(?P<address>D[LR](?=\s*+[+-])|P\d\d(?=\s|[+-])|[A-Z])\s*+(?P<value>{VALUE}|\"[^\"]*\")",
            m_codes=frozenset(f"M{k}" for k in (*_M_CODES, 15, 16, 89, 90, 91, 94, 97, 98, 101, 102, 103, 107, 108, 109, 110,
                                                111, 116, 117, 120, 124, 126, 127, 129, 136, 137, 141, 145, 148, 149)),
            end=frozenset(("M2", "M30", "%")),
            work_offset="PRESET",
            starts_in_its_units=False,
            beside="the datum has no basic rotation",
            pole=True,
            tool_by_number=True,
        ),
        Dialect(
            "heidenhain-klartext",
            _KLARTEXT,
            r";[^\n]*",
            "; {}",
            decimals=(4, 5),
            refused={**REFUSED, **_HEIDENHAIN_REFUSED},
            m_codes=frozenset(f"M{k}" for k in (*_M_CODES, 15, 16, 89, 90, 94, 97, 98, 101, 102, 103, 107, 108, 109, 110, 111,
                                                116, 117, 118, 120, 124, 126, 127, 129, 136, 137, 141, 145, 148, 149)),
            end=frozenset(("M2", "M30", "END PGM")),
            work_offset="PRESET",
            starts_in_its_units=False,
            beside="the preset has no basic rotation",
            first=r"\d*\s*+BEGIN\s",
            pole=True,
            tool_by_number=True,
        ),
        Dialect(
            "linuxcnc",
            _LINUXCNC,
            _PARENTHESES + r"|;[^\n]*",
            "({})",
            decimals=(5, 6),
            refused={**REFUSED, **dict.fromkeys(("G70", "G71"), _UNITS_OF_MACH)},
            longest_block=252,  # rs274 stops at 253: "Command too long"
            m_codes=frozenset(f"M{k}" for k in (*_M_CODES, *range(50, 54), *range(61, 69))),
            end=frozenset(("M2", "M30", "%")),
            register=_register_of_linuxcnc,
            beside="offsets of G92 and the rotation of the coordinate system (R of G10 L2) are 0",
            check=(
                "o<volcomp{label}> if [ABS[#{variable}-[{value}]] GT {within}]",
                "(abort, {name} is not that of the correction)",
                "o<volcomp{label}> endif",
            ),
        ),
        Dialect(
            "grbl",
            _GRBL,
            _PARENTHESES + r"|;[^\n]*",
            "({})",
            longest_block=79,  # LINE_BUFFER_SIZE 80 of protocol.h
            bare=True,
            most_digits=8,  # MAX_INT_DIGITS of nuts_bolts.c: further ones are cut
            end_needed=False,
            starts_in_its_units=False,
            beside="the offset of G92 is 0",
        ),
    )
}  # fmt: skip


def dialect_named(name: str) -> Dialect:
    """Return a dialect by its name."""
    if name not in DIALECTS:
        raise InputError(f"dialect {name!r} is not known; use {', '.join(DIALECTS)}")
    return DIALECTS[name]


def codes_that_stay(dialect: Dialect, given: Collection[str]) -> frozenset[str]:
    """Return the M codes among ``given`` that are not known and stay as they are; InputError for what may move, call or jump.

    What a builder of machines adds are M codes that switch something. A G code or a word that is not known may as well move.
    """
    kept, wrong = set[str](), []
    for text in sorted(given):
        found = re.fullmatch(r"([GM])\s*0*(\d{1,5}(?:\.\d+)?)", text.strip().upper())
        code = f"{found[1]}{float(found[2]):g}" if found else text.strip().upper()
        meaning = dialect.codes.get(code, "nothing" if code in dialect.m_codes | dialect.end else "")
        if meaning.startswith(("nothing", "setting")):
            continue
        if meaning:
            wrong.append(f"{code} (it is followed)")
        elif code in dialect.refused:
            wrong.append(f"{code} ({dialect.refused[code]})")
        elif found and found[1] == "M" and found[2].isdigit():
            kept.add(code)
        else:
            wrong.append(f"{visible_line(code)[:20]} (may move the machine or call a program)")
    if wrong:
        raise InputError(
            f"{'; '.join(wrong[:5])}: only M codes that move, call and change nothing may be kept; post the program without it",
            field="--keep-unknown",
        )
    return frozenset(kept)


def read_tools(path: str | Path, mm_per_unit: float = 1.0) -> dict[str, Vector3]:
    """Read a tool table: offsets X, Y, Z in mm that the control adds, by number or name of the tool.

    A CSV file with the columns ``tool, length_mm`` and, if the tool is off-centre, ``x_mm, y_mm``; or a tool table of
    LinuxCNC (``T1 P1 X0 Y0 Z101.5 D6``), whose numbers are in units of its machine of ``mm_per_unit``.
    """
    return {key: offsets for key, (offsets, _) in _tools_of(path, mm_per_unit).items()}


def read_radii(path: str | Path, mm_per_unit: float = 1.0) -> dict[str, float]:
    """Read the radii of a tool table that has them, mm: ``radius_mm`` or ``diameter_mm``, or D (the diameter) of LinuxCNC."""
    return {key: radius for key, (_, radius) in _tools_of(path, mm_per_unit).items() if radius == radius}


def _tools_of(path: str | Path, mm_per_unit: float) -> dict[str, tuple[Vector3, float]]:
    """Offsets and radius of each tool; nan where the table has no radius."""
    text = read_text(path)
    first = next((line for line in text.splitlines() if line.strip() and line.strip()[0] not in "#;"), "")
    if re.match(r"\s*[TP]\d", first):
        return _tools_of_linuxcnc(Path(path), text, mm_per_unit)
    optional = ("x_mm", "y_mm", "radius_mm", "diameter_mm")
    table = csv_table(Path(path), text, required=("tool", "length_mm"), optional=optional)
    names, columns = table.text("tool"), [table.numbers("length_mm")]
    columns += [table.numbers(name) if name in table.columns else 0.0 * columns[0] for name in ("x_mm", "y_mm")]
    radius = np.full(len(names), np.nan)
    for column, part in (("diameter_mm", 0.5), ("radius_mm", 1.0)):
        if column in table.columns:
            given = part * table.numbers(column, empty=np.nan)
            radius = np.where(np.isnan(given), radius, given)
    found: dict[str, tuple[Vector3, float]] = {}
    for row, name in enumerate(names):
        if len(name) > _LONGEST_NAME:
            raise table.fail(row, "tool", f"expected a number or a name of at most {_LONGEST_NAME} characters")
        key = str(int(name)) if name.isascii() and name.isdigit() else name.upper()
        if key in found:
            raise table.fail(row, "tool", f"tool {name} appears twice")
        found[key] = (float(columns[1][row]), float(columns[2][row]), float(columns[0][row])), float(radius[row])
    return found


def _tools_of_linuxcnc(path: Path, text: str, mm_per_unit: float) -> dict[str, tuple[Vector3, float]]:
    """Read lines such as ``T1 P1 X0 Y0 Z101.5 D6 ;comment``: words in any order, each a letter with its number."""
    tools: dict[str, tuple[Vector3, float]] = {}
    for number, line in enumerate(text.splitlines(), 1):
        words: dict[str, float] = {}
        for word in line.partition(";")[0].upper().split():
            known = _TOOL_WORD.fullmatch(word)
            if known is None or known[1] in words:
                raise InputError(
                    f"{visible_line(word)[:20]!r} is not understood; expected a line such as T1 P1 Z101.5 D6",
                    file=path,
                    line=number,
                )
            words[known[1]] = float(known[2])
        if words and ("T" not in words or words["T"] != int(words["T"])):
            raise InputError("expected the number of a tool, in a line such as T1 P1 Z101.5 D6", file=path, line=number)
        if words:
            key = f"{words['T']:.0f}"
            if key in tools:
                raise InputError(f"tool {key} appears twice", file=path, line=number)
            x, y, z = (words.get(letter, 0.0) * mm_per_unit for letter in "XYZ")
            tools[key] = (x, y, z), 0.5 * words["D"] * mm_per_unit if "D" in words else np.nan
    return tools
