"""Drilling cycles that one block defines and others execute, of SINUMERIK and HEIDENHAIN: their heights, and their text.

SINUMERIK: RTP, RFP, SDIS, DP and DPR of CYCLE81 to CYCLE89 (Programming Guide Cycles). HEIDENHAIN: Q200, Q201, Q203 and Q204 of
the cycles from 200, P01 and P02 of the cycles before, which count from where the tool is (User's Manual, DIN/ISO programming).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from compgen.programs.dialects import VALUE

#: Places of _AXN and _GMODE among the arguments of a cycle (_DMODE and _AMODE follow), and whether it goes back at feed.
_SINUMERIK: Mapping[str, tuple[int | None, int | None, bool]] = {
    "CYCLE81": (None, 6, False),
    "CYCLE82": (None, 6, False),
    "CYCLE83": (12, 17, False),
    "CYCLE84": (12, 21, True),
    "CYCLE840": (11, 17, True),
    "CYCLE85": (None, 8, True),
    "CYCLE86": (None, 11, False),
    "CYCLE87": (None, None, False),
    "CYCLE88": (None, None, False),
    "CYCLE89": (None, None, True),
}
#: Cycles of HEIDENHAIN, and whether they go back at feed.
_HEIDENHAIN = {
    "G83": False,
    "G84": True,
    "G85": True,
    "G200": False,
    "G201": True,
    "G202": True,
    "G203": False,
    "G205": False,
}
_HEIDENHAIN |= {"G206": True, "G207": True, "G209": True, "G240": False, "G241": False}
#: Of Klartext also bore milling: the control mills about the place of the hole.
#: Cycles of Klartext before 200 that are those of DIN/ISO by other numbers: pecking, tapping, rigid tapping.
OLD_CYCLES = {1: "G83", 2: "G84", 17: "G84"}
_KLARTEXT = frozenset(name for name in _HEIDENHAIN if name[1:].isdigit() and len(name) == 4) | {
    "G208",
    *OLD_CYCLES.values(),
}
_HEIDENHAIN |= {"G208": False}


@dataclass(frozen=True)
class DrillingCycle:
    """A cycle in the blocks that define it; heights are above the zero of the program, in its unit.

    ``numbers`` gives for the name of each number its line, first and last column in ``lines``, and its text.
    """

    name: str
    lines: tuple[str, ...]
    numbers: Mapping[str, tuple[int, int, int, str]]

    @staticmethod
    def called(name: str, line: str, first: int, arguments: str) -> DrillingCycle:
        """Return a cycle of SINUMERIK from its ``arguments`` in parentheses, which begin at the column ``first`` of a line."""
        axis, mode, _ = _SINUMERIK[name]
        names = {0: "RTP", 1: "RFP", 2: "SDIS", 3: "DP", 4: "DPR", axis: "_AXN", mode: "_GMODE"}
        if mode is not None:
            names |= {mode + 1: "_DMODE", mode + 2: "_AMODE"}
        numbers, at = {}, first + 1
        for place, text in enumerate(arguments[1:-1].split(",")):
            begin = at + len(text) - len(text.lstrip())
            if place in names:
                numbers[names[place]] = (0, begin, begin + len(text.strip()), text.strip())
            at += len(text) + 1
        return DrillingCycle(name, (line,), numbers)

    def defined_further(self, line: str) -> DrillingCycle:
        """Return the cycle with a further line of its definition, which gives numbers as in ``Q201=-15`` or ``P02 -15``."""
        code = line.partition(";")[0]
        found = list(re.finditer(rf"(Q\d++(?=\s*+=)|P\d\d(?=[\s+-]))\s*+(?:=\s*+)?({VALUE})", code, re.IGNORECASE))
        more = {match[1].upper(): (len(self.lines), *match.span(2), match[2]) for match in found}
        if old := re.search(rf"CYCLE?\s*DEF\s*\d+\s*\.\s*([12])\s[^\d+-]*({VALUE})\s*$", code, re.IGNORECASE):
            more = {f"P0{old[1]}": (len(self.lines), *old.span(2), old[2])}
        return replace(self, lines=(*self.lines, line), numbers={**self.numbers, **more})

    def __getitem__(self, name: str) -> float:
        """A number of the cycle, 0 if it is not given."""
        text = self.numbers.get(name, (0, 0, 0, ""))[3]
        return float(text.replace(" ", "") or 0.0)

    def __contains__(self, name: str) -> bool:
        """Whether the definition gives a number."""
        return self.numbers.get(name, (0, 0, 0, ""))[3] != ""

    @property
    def back_at_feed(self) -> bool:
        """Whether the tool goes back from the depth at feed: tapping, reaming, boring."""
        return _SINUMERIK[self.name][2] if self.name in _SINUMERIK else _HEIDENHAIN[self.name]

    @property
    def _relative(self) -> bool:
        if self.name not in _SINUMERIK:
            return True
        return "DPR" in self if self["_AMODE"] % 10 == 0 else self["_AMODE"] % 10 == 1

    @property
    def _clearance(self) -> float:
        """The way to the surface of a cycle before 200, by the sign of its depth: that alone gives the direction."""
        return math.copysign(self["P01"], self["P02"])

    def problem(self) -> str:
        """Return why the cycle cannot be followed, or nothing."""
        wrong = [text for *_, text in self.numbers.values() if text and not re.fullmatch(VALUE, text)]
        if wrong:
            return f"{self.name} with {wrong[0]!r}: variables and expressions are not followed; post numbers"
        if self.name in _SINUMERIK:
            if self["_GMODE"] or self["_DMODE"] % 10 > 1 or self["_AXN"] not in (0.0, 3.0) or self["_AMODE"] % 10 > 2:
                return (
                    f"{self.name} by a diameter, to the shank, or along another axis than Z is not followed; post moves"
                )
            if not {"DP", "DPR"} & {name for name in self.numbers if name in self}:
                return f"{self.name} has neither DP nor DPR; expected its depth"
            both = self["_AMODE"] % 10 == 0 and "DP" in self and "DPR" in self
            if both and abs(self["RFP"] - abs(self["DPR"]) - self["DP"]) > 1e-9:
                return f"{self.name}: DP and DPR give different depths; give one of them"
        needed = {"2": ("Q200", "Q201", "Q203"), "8": ("P01", "P02")}.get(self.name[1], ("RTP", "SDIS"))
        missing = [name for name in needed if name not in self]
        if missing:
            return f"{self.name} without {missing[0]}; expected {', '.join(needed)}"
        if self["Q343"]:
            return f"{self.name} with the depth from a diameter (Q343) is not followed; give Q201 with Q343=0"
        if self["Q395"]:
            return f"{self.name} with its depth to the cylinder of the tool (Q395=1) is not followed; give Q201 with Q395=0"
        level, depth, left = self.heights(0.0)
        if not (depth < level and (left >= level or self.name in _SINUMERIK and left >= self["RFP"])):
            return f"{self.name} goes up to its depth, or leaves the tool below where it begins; check its heights"
        return ""

    def heights(self, start: float) -> tuple[float, float, float]:
        """Return where feed begins, the depth, and where the tool is left; ``start`` is where it is when the cycle is called."""
        if self.name in _SINUMERIK:
            depth = self["RFP"] - abs(self["DPR"]) if self._relative else self["DP"]
            return self["RFP"] + abs(self["SDIS"]), depth, self["RTP"]
        if "P02" in self.numbers:
            return start, start + self._clearance + self["P02"], start
        surface = self["Q203"]
        return surface + self["Q200"], surface + self["Q201"], surface + max(self["Q200"], self["Q204"])

    def with_heights(
        self, level: float, depth: float, start: float, text_of: Callable[[str, float], str]
    ) -> DrillingCycle:
        """Return the cycle with other heights; ``text_of`` writes the number of a name."""
        numbers = dict(self.numbers)

        def put(name: str, value: float) -> float:
            line, first, last, _ = numbers[name]
            numbers[name] = (line, first, last, text_of(name, value))
            return float(numbers[name][3].replace(" ", "") or 0.0)

        if self.name in _SINUMERIK:
            reference = put("RFP", level - abs(self["SDIS"])) if "RFP" in numbers else 0.0
            put(*(("DPR", reference - depth) if self._relative else ("DP", depth)))
        elif "P02" in numbers:
            put("P02", depth - start - self._clearance)
        else:
            put("Q201", depth - put("Q203", level - self["Q200"]))
        return replace(self, numbers=numbers)

    def written(self) -> list[str]:
        """Return the lines of the definition with the numbers as they are now."""
        lines = list(self.lines)
        for line, first, last, text in sorted(self.numbers.values(), reverse=True):
            lines[line] = lines[line][:first] + text + lines[line][last:]
        return lines


def defines_hole(name: str, *, klartext: bool = False) -> bool:
    """Whether a name is that of a drilling cycle that is defined in one block and executed at others."""
    return name in (_KLARTEXT if klartext else _SINUMERIK.keys() | _HEIDENHAIN.keys() - {"G208", "G241"})
