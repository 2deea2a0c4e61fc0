"""A machine file from a few answers: the chain from words, and the commented text of the file.

Words such as "table moves in X and Y, head in Z" say which side carries each axis and in which order the carriages are
stacked: :func:`chains_of`. English and German words are known.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from compgen.data import toml_files
from compgen.data.machine import CHAINS, Axis, Chain, Emphasis, Interval, Machine
from compgen.data.names import AXES
from compgen.data.prior import CLASS_WORDS, USUAL_CLASS
from compgen.errors import InputError

#: What carries an axis: words (beginnings, umlauts spelt out), whether it is on the side of the tool (None: either), and how
#: far it is from the foundation on its side.
_CARRIERS: tuple[tuple[str, bool | None, int], ...] = (
    ("table|workpiece|work piece|part|pallet|tisch|werkstueck|palette|aufspann", False, 2),
    ("knee|konsole", False, 0),
    ("gantry|bridge|portal|bruecke", True, 0),
    ("column|staender|saeule", True, 0),
    ("crossbeam|cross beam|crossrail|cross rail|beam|querbalken|traverse|querhaupt", True, 1),
    (r"head|spindle|\bram\b|quill|tool|kopf|spindel|pinole|stoessel|werkzeug", True, 2),
    ("saddle|slide|carriage|cross slide|schlitten|kreuzschlitten|support|sattel", None, 1),
)
_WORD = re.compile(
    "|".join(rf"(?P<c{k}>\b\w*(?:{words})\w*)" for k, (words, _, _) in enumerate(_CARRIERS))
    + r"|(?P<axes>\b[xyz]{1,3}\b)"
)
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
EXAMPLES = (
    '"table moves in X and Y, head in Z", "Tisch in X, Ständer in Y, Kopf in Z", "gantry in Y, head in X and Z", WFYXZT'
)


@dataclass(frozen=True)
class Carried:
    """One axis as described: what carries it, on which side (None: not stated), and how far from the foundation."""

    axis: str
    word: str
    tool_side: bool | None
    level: int


def chains_of(words: str) -> tuple[Chain, ...]:
    """Return the chains that ``words`` can mean, the likeliest first: one of them if the words are clear.

    Of axes on one carriage, the first named is taken to be next to the workpiece (table) or next to the foundation
    (gantry, head); the other orders follow.

    Raises
    ------
    InputError
        for words without axes and carriages, and for an axis stated to be on both sides.

    Examples
    --------
    >>> [chain.name for chain in chains_of("table in X, saddle in Y, head in Z")]
    ['WXYFZT']
    >>> [chain.name for chain in chains_of("Tisch fährt in X und Y, Kopf in Z")]
    ['WXYFZT', 'WYXFZT']
    """
    code = re.sub(r"[\s-]", "", words).upper()
    if code in CHAINS:
        return (Chain(code),)
    found: dict[str, Carried] = {}
    for letter, carrier in _pairs(words):
        _, side, level = next(kind for k, kind in enumerate(_CARRIERS) if carrier.group(f"c{k}"))
        known = found.get(letter)
        if known is not None and known.tool_side != side:
            message = f"{words!r}: {letter} is carried by {known.word!r} and by {carrier.group()!r}; name one of them"
            raise InputError(message, field="--chain")
        found[letter] = Carried(letter, carrier.group(), side, level)
    # a slide is on a gantry if there is one, moving or not; else below the table or on the column, if only one moves
    table = any(item.tool_side is False for item in found.values())
    column = any(item.tool_side and item.level < 2 for item in found.values())
    gantry = re.search(_CARRIERS[2][0], words.lower().translate(_UMLAUTS)) is not None
    carried = {
        letter: replace(item, tool_side=gantry or column)
        if item.tool_side is None and (gantry or table != column)
        else item
        for letter, item in found.items()
    }
    if not carried:
        raise InputError(f"{words!r} names no axes that move; write for example {EXAMPLES}", field="--chain")
    fits = [Chain(name) for name in CHAINS if _allows(Chain(name), carried)]
    return tuple(sorted(fits, key=lambda chain: _turned(chain, carried)))


def _pairs(words: str) -> list[tuple[str, re.Match[str]]]:
    """Each axis with the word for what carries it; within a part of the sentence either may come first."""
    pairs: list[tuple[str, re.Match[str]]] = []
    carrier: re.Match[str] | None = None
    waiting: list[str] = []  # axes whose carrier is still to come: "X and Y by the table"
    axes_first = True
    for part in re.split(r"[,;]|\band\b|\bund\b", words.lower().translate(_UMLAUTS)):
        found = list(_WORD.finditer(part))
        if any(match.group("axes") is None for match in found):
            axes_first = found[0].group("axes") is not None
        for match in found:
            letters = (match.group("axes") or "").upper()
            if not letters:
                pairs += [(letter, match) for letter in waiting]
                carrier, waiting = match, []
            elif carrier is not None and not axes_first:
                pairs += [(letter, carrier) for letter in letters]
            else:
                waiting += letters
    return pairs


def _allows(chain: Chain, carried: Mapping[str, Carried]) -> bool:
    """Whether a chain has every axis on its side, and the carriages in their order from the foundation outwards."""
    for side, tool_side in ((chain.workpiece_side, False), (chain.tool_side, True)):
        named = [carried[AXES[axis]] for axis in side if AXES[axis] in carried]
        if any(item.tool_side is not None and item.tool_side != tool_side for item in named):
            return False
        levels = [item.level for item in named]
        if levels != sorted(levels):
            return False
    return True


def _turned(chain: Chain, carried: Mapping[str, Carried]) -> int:
    """How many pairs of axes on one side are not in the order of the words."""
    order = list(carried)
    outwards = [[AXES[axis] for axis in side] for side in (chain.tool_side, chain.workpiece_side[::-1])]
    ranks = [[order.index(letter) for letter in side if letter in carried] for side in outwards]
    return sum(a > b for side in ranks for k, a in enumerate(side) for b in side[k + 1 :])


def in_words(chain: Chain) -> str:
    """Describe a chain in words.

    >>> in_words(Chain("WXYFZT"))
    'table moves in X, on a carriage in Y, on the bed; head moves in Z'
    """

    def side(what: str, axes: Sequence[int]) -> str:
        letters = [AXES[axis] for axis in axes]
        if not letters:
            return f"{what} does not move"
        carried = "".join(f", on a carriage in {letter}" for letter in letters[1:])
        return f"{what} moves in {letters[0]}{carried}{', on the bed' if carried else ''}"

    return f"{side('table', chain.workpiece_side[::-1])}; {side('head', chain.tool_side[::-1])}"


def usual_nodes(travel: Interval) -> int:
    """Return a usual number of nodes: about one every 100 mm, at least five."""
    return max(5, min(101, round((travel[1] - travel[0]) / 100.0) + 1))


def machine_text(
    name: str,
    chain: Chain,
    travel_mm: Mapping[str, Interval],
    nodes: Mapping[str, int],
    sections: Sequence[str] = (),
    class_name: str | None = None,
) -> str:
    """Return the text of a machine file with a comment on every key, followed by ``sections`` for the controls.

    ``class_name`` is the class of the machine, which says what is assumed of errors that are not measured.
    """
    said = toml_files.section_schema(Machine, Emphasis)["properties"]
    of_axis = toml_files.section_schema(Axis)["properties"]
    at_zero = [min(max(0.0, travel_mm[letter][0]), travel_mm[letter][1]) for letter in AXES]

    def line(key: str, value: object, about: Mapping[str, toml_files.Schema] = said, open_point: str = "") -> str:
        text = f"{open_point}{key} = {value}"
        return f"{text:<41} # {about[key].get('description', '')}"

    lines = [
        f"# {name}: a machine file of volcomp. Lengths are in mm; a unit is part of its key. `volcomp check` checks it.",
        "# A line that begins with # and a key shows a default, or a value that you must give: remove the # and change it.",
        "",
        line("name", f'"{name}"'),
        line("chain", f'"{chain.name}"'),
        f"{'':41} # here: {in_words(chain)}",
        line("reference_point_mm", at_zero),
        line("tool_offset_mm", [0.0, 0.0, 0.0], open_point="# "),
        line("squareness_reference", '"X"', open_point="# "),
        line("errors", '"observable"', open_point="# "),
        line("curves", '"linear"', open_point="# "),
        line("tool_range_mm", "{ Z = [-250.0, 0.0] }", open_point="# "),
        line("work_zone_mm", "{ X = [0.0, 100.0] }", open_point="# "),
    ]
    for letter in AXES:
        lines += [
            "",
            f"[axes.{letter}]",
            line("range_mm", list(map(float, travel_mm[letter])), of_axis),
            line("nodes", nodes[letter], of_axis),
            line("expansion_um_per_m_k", 11.5, of_axis, "# "),
            line("screw_pitch_mm", 10.0, of_axis, "# "),
        ]
    classes = ", ".join(f"{key}: {words}" for key, words in CLASS_WORDS.items())
    of_class = f'class = "{class_name or USUAL_CLASS}"'
    lines += [
        "",
        "[prior]",
        f"{of_class if class_name else f'# {of_class}':<41} # class of the machine: how large errors are assumed that are not",
        f"{'':41} # measured; {classes}",
    ]
    return "\n".join([*lines, *(part for section in sections for part in ("", section))]) + "\n"
