"""A machine file from a few answers: the chain from words, and the commented text of the file.

Words such as "table moves in X and Y, head in Z" say which side carries each axis and in which order the carriages are
stacked: :func:`chains_of`. English and German words are known.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt

from compgen.data import toml_files
from compgen.data.machine import CHAINS, ROTARY, Axis, Chain, Emphasis, Interval, Machine, RotaryAxis, Vector3
from compgen.data.names import AXES
from compgen.data.prior import CLASS_WORDS, USUAL_CLASS
from compgen.errors import InputError, Message

#: What carries an axis: words (beginnings, umlauts spelt out), whether it is on the side of the tool (None: either), and how
#: far it is from the foundation on its side.
_CARRIERS: tuple[tuple[str, bool | None, int], ...] = (
    ("table|workpiece|work piece|part|pallet|tisch|werkstueck|palette|aufspann|trunnion|cradle|wiege", False, 2),
    ("knee|konsole", False, 0),
    ("gantry|bridge|portal|bruecke", True, 0),
    ("column|staender|saeule", True, 0),
    ("crossbeam|cross beam|crossrail|cross rail|beam|querbalken|traverse|querhaupt", True, 1),
    (r"head|spindle|\bram\b|quill|tool|kopf|spindel|pinole|stoessel|werkzeug|\bfork|gabel", True, 2),
    ("saddle|slide|carriage|cross slide|schlitten|kreuzschlitten|support|sattel", None, 1),
)
_WORD = re.compile(
    "|".join(rf"(?P<c{k}>\b\w*(?:{words})\w*)" for k, (words, _, _) in enumerate(_CARRIERS))
    + r"|(?P<axes>\b[xyz]{1,3}\b|\bq[abc]q\b)"
)
#: A, B, C as axes: capitals that are no article, groups with other axes, and small letters that can only be axes.
_ROTARY_WORDS = re.compile(
    r"(?<!\w)(?:(?!A\s+(?!by\b|on\b|in\b|and\b|und\b|of\b|ax|turns\b|tilts\b)[a-z])[A-C](?!\w)"
    r"|(?=[XYZ]*[ABC])[A-CXYZ]{2,6}(?!\w)|[bc](?!\w)|[abc](?=[- ]?(?:axis|axes|achse))|(?<=/)a(?!\w)"
    r"|a(?=\s*(?:[,;/+]|and\b|und\b|$)))"
)
#: What a word says of rotary axes if no letter does: words, axes of the table, axes of the head, the usual chain.
_KINDS = (
    ("nutat|taumel", "C", "B", "WCYFXZBT"),
    (r"\bfork|gabel", "", "CB", "WXYFZCBT"),
    ("trunnion|cradle|wiege", "CA", "", "WCAYFXZT"),
    (r"\btable and head\b|\bhead and table\b|\btisch und kopf\b|\bkopf und tisch\b", "C", "B", "WCYFXZBT"),
    (r"(?:tilting|swivel\w*|pivoting|schwenk)[ -]?(?:head|kopf)", "", "B", "WCYFXZBT"),
    (r"rotary table|rundtisch|drehtisch", "C", "", "WCYFXZT"),
)
_SHARE = round(sqrt(0.5), 10)
#: Directions of an axis of a nutating head at 45 degrees.
_NUTATING: Mapping[str, Vector3] = {
    "A": (_SHARE, 0.0, _SHARE), "B": (0.0, _SHARE, _SHARE), "C": (0.0, _SHARE, _SHARE)
}  # fmt: skip
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
EXAMPLES = (
    '"table moves in X and Y, head in Z", "Tisch in X, Ständer in Y, Kopf in Z", "gantry in Y, head in X and Z", '
    'WFYXZT; with rotary axes "trunnion in A and C, table in Y, head in X and Z", WCAYFXZT'
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
    if code in CHAINS or re.fullmatch(r"[Ww](?=.*[Ff])[A-CFXYZa-cfxyz-]{4,}[Tt]", words.strip()):
        return (Chain(code),)
    pairs, waiting = _pairs(_marked(words))
    turning = [(letter, carrier) for letter, carrier in pairs if letter in ROTARY]
    moving = [(letter, carrier) for letter, carrier in pairs if letter not in ROTARY]
    lost = [letter for letter in waiting if letter in ROTARY]
    if lost:
        raise InputError(
            Message(
                "chain-carrier-missing",
                "{words!r} names {lost}, and not what carries it: table or head",
                words=words,
                lost=", ".join(lost),
            ),
            field="--chain",
        )
    table, head, usual = _rotary_of(words, turning)
    if usual and not moving:
        return (Chain(usual),)
    fits = _linear_chains(words, moving, [carrier for _, carrier in turning])
    return tuple(Chain(f"W{table}{chain.name[1:-1]}{head}T") for chain in fits)


def _linear_chains(
    words: str, pairs: Sequence[tuple[str, re.Match[str]]], turning: Sequence[re.Match[str]]
) -> tuple[Chain, ...]:
    """The chains of linear axes that the words can mean, the likeliest first; ``turning`` carry rotary axes."""
    found: dict[str, Carried] = {}
    for letter, carrier in pairs:
        _add(found, words, letter, carrier)
    # a slide is on a gantry if there is one, moving or not; else below the table or on the column, if only one moves
    table = any(item.tool_side is False for item in found.values()) or any(carrier.group("c0") for carrier in turning)
    column = any(item.tool_side and item.level < 2 for item in found.values())
    gantry = re.search(_CARRIERS[2][0], _plain(words)) is not None
    carried = {
        letter: replace(item, tool_side=gantry or column)
        if item.tool_side is None and (gantry or table != column)
        else item
        for letter, item in found.items()
    }
    if not carried:
        raise InputError(
            Message(
                "chain-no-axes",
                "{words!r} names no axes that move; write for example {value}",
                words=words,
                value=EXAMPLES,
            ),
            field="--chain",
        )
    fits = [Chain(name) for name in CHAINS if _allows(Chain(name), carried)]
    return tuple(sorted(fits, key=lambda chain: _turned(chain, carried)))


def _add(found: dict[str, Carried], words: str, letter: str, carrier: re.Match[str]) -> None:
    """Take what carries an axis; InputError if it is on the other side already."""
    _, side, level = next(kind for k, kind in enumerate(_CARRIERS) if carrier.group(f"c{k}"))
    known = found.get(letter)
    if known is not None and known.tool_side != side:
        message = f"{words!r}: {letter} is carried by {known.word!r} and by {carrier.group()!r}; name one of them"
        raise InputError(message, field="--chain")
    found[letter] = Carried(letter, carrier.group(), side, level)


def _rotary_of(words: str, pairs: Sequence[tuple[str, re.Match[str]]]) -> tuple[str, str, str]:
    """Rotary axes of the table from the workpiece, those of the head towards the tool, and the usual chain of such a machine.

    C of a table is next to the workpiece, C of a head next to the foundation; of others the first named is nearer to the
    foundation.
    """
    kind = next((kind for kind in _KINDS if re.search(kind[0], _plain(words))), None)
    if not pairs:
        return ("", "", "") if kind is None else kind[1:]
    found: dict[str, Carried] = {}
    for letter, carrier in pairs:
        _add(found, words, letter, carrier)
        if found[letter].tool_side is None:
            raise InputError(
                Message(
                    "chain-table-or-head",
                    "{words!r}: is {letter} an axis of the table or of the head?",
                    words=words,
                    letter=letter,
                ),
                field="--chain",
            )
    order = sorted(found, key=lambda letter: letter != "C")
    table = "".join(letter for letter in order if not found[letter].tool_side)
    head = "".join(letter for letter in order if found[letter].tool_side)
    if len(table) > 1:  # the first named carries the next
        table = ("C" if "C" in table else "") + table.replace("C", "")[::-1]
    usual = next((kind[3] for kind in _KINDS if {*table} == {*kind[1]} and {*head} == {*kind[2]}), "")
    return table, head, usual


def rotary_directions(words: str, chain: Chain) -> dict[str, Vector3]:
    """Directions of rotary axes that are not those of their letters: of a nutating head (or table), at 45 degrees.

    >>> rotary_directions("nutating head in B, table in C and Y, head in X and Z", Chain("WCYFXZBT"))
    {'B': (0.0, 0.7071067812, 0.7071067812)}
    """
    if not re.search(_KINDS[0][0], _plain(words)):
        return {}
    head = [letter for letter in chain.rotary if (letter, True) in chain.passed]
    tilting = [letter for letter in head or chain.rotary if letter != "C"] or list(head)
    return {tilting[-1]: _NUTATING[tilting[-1]]} if tilting else {}


def _plain(words: str) -> str:
    return words.lower().translate(_UMLAUTS).replace("schwenkbruecke", "wiege")


def _marked(words: str) -> str:
    """The words in small letters, each rotary axis as a word of its own: an article is none."""

    def each(match: re.Match[str]) -> str:
        linear = "".join(letter for letter in match.group() if letter in "XYZ")
        turning = [letter.lower() for letter in match.group() if letter not in "XYZ"]
        return f" {linear} {' '.join(f'q{letter}q' for letter in turning)} "

    text = re.sub(r"(?<=[A-C])-(?=(?i:axis|axes|achse))", " ", words)
    return _plain(_ROTARY_WORDS.sub(each, text))


def _pairs(plain: str) -> tuple[list[tuple[str, re.Match[str]]], list[str]]:
    """Each axis with the word for what carries it, and axes without; within a part of the sentence either may come first."""
    pairs: list[tuple[str, re.Match[str]]] = []
    carrier: re.Match[str] | None = None
    waiting: list[str] = []  # axes whose carrier is still to come: "X and Y by the table"
    axes_first = True
    for part in re.split(r"[,;]|\band\b|\bund\b", plain):
        found = list(_WORD.finditer(part))
        if any(match.group("axes") is None for match in found):
            axes_first = found[0].group("axes") is not None
        for match in found:
            letters = (match.group("axes") or "").strip("q").upper()
            if not letters:
                pairs += [(letter, match) for letter in waiting]
                carrier, waiting = match, []
            elif carrier is not None and not axes_first:
                pairs += [(letter, carrier) for letter in letters]
            else:
                waiting += letters
    return pairs, waiting


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

    said = f"{side('table', chain.workpiece_side[::-1])}; {side('head', chain.tool_side[::-1])}"
    return said if not chain.rotary else f"{said}; {_turning_in_words(chain)}"


def _turning_in_words(chain: Chain) -> str:
    """What turns, from the workpiece and from the tool."""
    tool_side = dict(chain.passed)
    table = [letter for letter in chain.rotary if not tool_side[letter]]
    head = [letter for letter in reversed(chain.rotary) if tool_side[letter]]
    parts = []
    for what, letters in (("workpiece", table), ("tool", head)):
        if letters:
            parts.append(f"{what} turns in {letters[0]}{''.join(f', carried by {letter}' for letter in letters[1:])}")
    return "; ".join(parts)


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
    rotary: Mapping[str, RotaryAxis] | None = None,
) -> str:
    """Return the text of a machine file with a comment on every key, followed by ``sections`` for the controls.

    ``rotary`` are the rotary axes of the chain; ``class_name`` is the class of the machine, which says what is assumed of
    errors that are not measured.
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
    of_rotary = toml_files.section_schema(RotaryAxis)["properties"]
    for letter, axis in (rotary or {}).items():
        plain = tuple(float(other == letter) for other in ROTARY)
        travel = ("range_deg", list(axis.range_deg)) if axis.range_deg else ("modulo_deg", axis.modulo_deg)
        lines += [
            "",
            f"[axes.{letter}]",
            line("point_mm", list(axis.point_mm), of_rotary),
            line(travel[0], travel[1], of_rotary),
            line("nodes", len(axis.nodes_deg), of_rotary),
            line(
                "direction",
                [round(part, 10) for part in axis.direction],
                of_rotary,
                "# " if axis.direction == plain else "",
            ),
            line("reference_deg", axis.reference_deg, of_rotary, "# " if not axis.reference_deg else ""),
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
