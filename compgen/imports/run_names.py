"""Names of runs, directions and statistics as laboratories of several countries write them.

A name is cut into words, numbers and marks. It names a run only if every one of them is understood; so a column with a
word that is not known is never taken for something else, and never for nothing.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


#: Words for travel in positive and in negative direction, without accents, in lower case.
_UP = _words(
    """+ > \u2191 \u2192 \u2197 up upward upwards fwd forward forwards positive pos plus ascending asc increasing outward
    vor vorwarts vorwaerts hin hinweg hinfahrt hinlauf auf aufwarts aufwaerts steigend positiv positiver positiven plusrichtung
    aller avant montee montant croissant positif
    andata avanti salita crescente positivo positiva
    ida avance adelante subida subiendo creciente
    \u6b63 \u6b63\u5411 \u6b63\u65b9\u5411 \u53bb\u7a0b \u53bb \u5f80
    \u524d\u8fdb \u5411\u524d \u4e0a\u884c \u4e0a\u5347"""
)
_DOWN = _words(
    """- < \u2193 \u2190 \u2198 down downward downwards bwd bkwd backward backwards back reverse rev rtn ret return negative neg
    minus descending desc decreasing inward
    ruck rueck ruckwarts rueckwaerts zuruck zurueck ruckweg ruckfahrt rucklauf her ab abwarts abwaerts fallend negativ
    negativer negativen minusrichtung
    retour arriere descente descendant decroissant negatif
    ritorno indietro discesa decrescente negativo negativa
    vuelta regreso atras retroceso bajada bajando decreciente
    \u8d1f \u8ca0 \u8d1f\u5411 \u8d1f\u65b9\u5411 \u53cd \u53cd\u5411 \u56de\u7a0b \u56de \u8fd4\u56de \u540e\u9000 \u5411\u540e
    \u4e0b\u884c \u4e0b\u964d"""
)
_RUN = _words(
    """run runs cycle cyc pass trial test repeat rep repetition measurement meas series nr no number sample j
    lauf laufe messlauf messfahrt fahrt zyklus messung messreihe reihe durchgang durchlauf versuch wiederholung wdh
    essai passage mesure serie course releve
    prova ciclo corsa misura ripetizione passata
    ensayo medida medicion recorrido pasada repeticion carrera
    \u6b21 \u7b2c \u7b2c\u4e00\u6b21 \u6d4b\u91cf \u6d4b\u8bd5 \u5faa\u73af \u7ec4 \u8f6e \u8fd0\u884c \u884c\u7a0b"""
)
#: Words for measured minus target.
_DEVIATIONS = _words(
    """deviation deviations dev error err errors abweichung abweichungen abw positionsabweichung fehler messabweichung ecart
    ecarts erreur erreurs scarto scarti scostamento errore errori desviacion desviaciones \u504f\u5dee \u8bef\u5dee"""
)
#: Words that say only that readings or deviations follow, or that a direction does.
_FILLERS = _DEVIATIONS | _words(
    """position positioning positional systematic bidirectional unidirectional bi uni directional two one value values werte
    wert systematische systematisch beidseitig beidseitige einseitig einseitige actual reading measured laser ist istwert
    istposition mesuree misurato medido lecture lettura lectura
    direction dir richtung sens direzione direccion in im de du di en der den the of and st nd rd th er eme way
    \u5b9e\u6d4b \u503c \u65b9\u5411"""
)
#: Statistics that laboratories print beside the runs; only those of kind mean and scatter are held against them.
_STATISTICS = {
    "mean": """mean means average avg mittel mittelwert mittelwerte mittlere mittlerer durchschnitt moyenne moyen media medio
    promedio x\u0304 \u00d8 \u00f8 \u5e73\u5747 \u5e73\u5747\u503c \u5747\u503c""",
    "scatter": """std stddev stdev stdabw standard standardabweichung deviationstandard sigma \u03c3 scatter streuung ecarttype
    deviazione estandar type tipo stdv \u6807\u51c6\u5dee \u6807\u51c6\u504f\u5dee""",
    "other": """min max minimum maximum minimo maximo massimo range span spanne spannweite reversal umkehrspanne umkehrfehler
    umkehr backlash lose hysteresis hysterese inversion isteresi histeresis repeatability wiederholprazision
    wiederholgenauigkeit repetibilite ripetibilita repetibilidad accuracy genauigkeit rms sum summe somme somma suma total
    gesamt median count anzahl u unsicherheit uncertainty incertitude incertezza incertidumbre limit grenze toleranz tolerance
    \u6700\u5927\u503c \u6700\u5c0f\u503c \u6700\u5927 \u6700\u5c0f \u53cd\u5411\u5dee\u503c \u91cd\u590d\u7cbe\u5ea6""",
}
_STATISTIC = {word: kind for kind, words in _STATISTICS.items() for word in words.split()}
#: Single letters of ISO 230-2; they are statistics only as a whole name, with or without a direction.
_ISO_LETTERS = {"b": "other", "r": "other", "m": "other", "e": "other", "a": "other", "s": "scatter", "x": "mean"}
_UNITS = frozenset(["um", "mm", "nm", "in", "inch", "mil", "mm/m", "um/m", "urad", "mrad", "arcsec", "m"])
#: First letters that stand for the two ways, where a table has one of these pairs: forward and back in six languages.
_LETTERS = ("vr", "vz", "hr", "fb", "fr", "ar", "ud", "pn", "iv", "ai")
_LONG = sorted(
    (w for w in {*_UP, *_DOWN, *_RUN, *_FILLERS, *_STATISTIC} if re.search(r"[\u4e00-\u9fff]", w)),
    key=lambda w: -len(w),
)
_TOKEN = re.compile(
    "|".join([*_LONG, r"x\u0304", r"mm/m|um/m", r"[a-z]+", r"[\u4e00-\u9fff]", r"\d+(?:[.,]\d+)?", r"\S"])
)
_SEPARATORS = frozenset("_./,:;#()[]{}|\u00b0\u00ba'\"*=~")


@dataclass(frozen=True)
class RunColumn:
    """A column of readings of one run: its name, number (0: not in the name), and direction (0: not in the name)."""

    name: str
    number: int
    direction: int


@dataclass(frozen=True)
class _Words:
    """What the words of a name are: numbers, ways, kinds of statistics, and those that are not known."""

    numbers: tuple[int, ...]
    ways: frozenset[int]
    statistics: tuple[str, ...]
    unknown: tuple[str, ...]
    names_run: bool


def unaccented(text: str) -> str:
    """Return lower case without accents; signs that are written in several ways become one, a bar over x stays."""
    text = (
        text.replace("\u2212", "-")
        .replace("\u2013", "-")
        .replace("\u2014", "-")
        .replace("\u00b5", "u")
        .replace("\u03bc", "u")
    )
    flat = unicodedata.normalize("NFKD", text.lower()).replace("\u03bc", "u").replace("\u0142", "l")
    return (
        "".join(c for c in flat if not unicodedata.combining(c) or c == "\u0304")
        .replace("ecart type", "ecarttype")
        .replace("ecart-type", "ecarttype")
    )


def _tokens(text: str) -> list[str]:
    """Return words, numbers and marks; a minus within a name parts words, at its ends it is a direction."""
    found = [token for token in _TOKEN.findall(unaccented(text)) if token not in _SEPARATORS]
    while len(found) > 1 and found[-1] in _UNITS:
        found.pop()
    ends = {0, len(found) - 1}
    inside = re.findall(r"[(\[]\s*-\s*[)\]]", unaccented(text))
    return [token for k, token in enumerate(found) if token != "-" or k in ends or inside]


def _read(text: str, letters: str = "") -> _Words:
    """Say what the words of a name are; ``letters`` are the two that stand for the ways, positive first."""
    numbers: list[int] = []
    ways: set[int] = set()
    statistics: list[str] = []
    unknown: list[str] = []
    names_run = False
    tokens = _tokens(text)
    for k, token in enumerate(tokens):
        following = tokens[k + 1] if k + 1 < len(tokens) else ""
        if token[0].isdigit():
            if following in ("s", "sigma", "\u03c3"):
                continue  # 2 s is no second run
            whole = token.isdigit() and len(token) <= 3
            numbers += [int(token)] if whole else []
            unknown += [] if whole else [token]
        elif token in letters:
            ways.add(1 if token == letters[0] else -1)
        elif token in _UP:
            ways.add(1)
        elif token in _DOWN:
            ways.add(-1)
        elif token in _STATISTIC:
            statistics.append(_STATISTIC[token])
        elif token in _RUN or (token in ("r", "m", "n", "l") and following.isdigit()):
            names_run = True
        elif token == "s" and k and tokens[k - 1][0].isdigit():
            statistics.append("scatter")
        elif token not in _FILLERS and not (token in _UNITS and k):
            unknown.append(token)
    return _Words(tuple(numbers), frozenset(ways), tuple(statistics), tuple(unknown), names_run)


def way(text: str) -> int | None:
    """Return the direction that a cell names, +1 or -1; None if it names none.

    >>> way("forward"), way("-"), way("1"), way("x"), way("zurück"), way("X-"), way("2")
    (1, -1, 1, None, -1, -1, None)
    """
    cell = text.strip()
    if re.fullmatch(r"[+\-\u2212]?1(?:\.0+)?", cell):
        return -1 if cell[0] in "-\u2212" else 1
    if cell.lower() in ("u", "d"):
        return 1 if cell.lower() == "u" else -1
    words = _read(re.sub(r"(?i)^([+\-\u2212])?[xyz]([+\-\u2212])?$", r"\1\2", cell))
    alone = len(words.ways) == 1 and not (words.unknown or words.statistics or words.numbers)
    return next(iter(words.ways)) if alone else None


def run_in(text: str, letters: str = "") -> RunColumn | None:
    """Return the run that a name or a label names, None if a word of it is not understood.

    >>> run_in("Lauf 1 zurück [µm]"), run_in("bwd2"), run_in("Dead path 1")
    (RunColumn(name='Lauf 1 zurück [µm]', number=1, direction=-1), RunColumn(name='bwd2', number=2, direction=-1), None)
    """
    words = _read(text, letters)
    if words.unknown or words.statistics or len(words.numbers) > 1 or len(words.ways) > 1:
        return None
    if not words.numbers and not words.ways:
        return None
    return RunColumn(text, words.numbers[0] if words.numbers else 0, next(iter(words.ways), 0))


def names_run(text: str) -> bool:
    """Whether a text is about runs or directions and nothing else, such as ``Lauf``, ``Run no.``, ``Richtung``."""
    words = _read(text)
    about = words.names_run or any(
        token in ("direction", "dir", "richtung", "sens", "direzione") for token in _tokens(text)
    )
    return about and not (words.unknown or words.statistics)


def is_deviation(text: str) -> bool:
    """Whether a name speaks of deviations or errors, in one of the languages that are known."""
    return any(token in _DEVIATIONS for token in _tokens(text))


def is_known_name(text: str) -> bool:
    """Whether every word of a text is one of runs, directions, deviations, statistics or units, and not only a number."""
    words = _read(text)
    return not words.unknown and not text.replace(".", "").replace(",", "").lstrip("+-").isdigit()


def statistic_in(text: str) -> tuple[str, int] | None:
    """Return the kind of a statistic ("mean", "scatter", "other") that a name names, and its direction (0: of both).

    A number in the name makes it that of one run, which is none over the runs.

    >>> statistic_in("Mittelwert vor [µm]"), statistic_in("x\u0304 \u2193"), statistic_in("2s"), statistic_in("mean run 1")
    (('mean', 1), ('mean', -1), ('scatter', 0), None)
    """
    words = _read(text)
    direction = next(iter(words.ways)) if len(words.ways) == 1 else 0
    if words.statistics and not words.numbers:
        odd = next((kind for kind in ("other", "scatter") if kind in words.statistics), "mean")
        return odd, direction
    letters = [token for token in words.unknown if token in _ISO_LETTERS]
    if len(words.unknown) == 1 and letters and not words.numbers and not words.names_run:
        return _ISO_LETTERS[letters[0]], direction
    return None


def run_columns(header: Sequence[str], taken: Sequence[str]) -> list[RunColumn]:
    """Return the columns that hold one run each, such as ``Run 1 +``, ``fwd2``, ``r3``, ``V1`` beside ``R1``.

    Names without a number are counted for each direction as they come.

    >>> run_columns(["target", "Run 1+", "Run 1-", "bwd 2"], ["target"])[1:]
    [RunColumn(name='Run 1-', number=1, direction=-1), RunColumn(name='bwd 2', number=2, direction=-1)]
    """
    names = [name for name in header if name not in taken]
    letters = _pair_of_letters(names)
    found = [column for name in names if (column := run_in(name, letters)) is not None]
    count: Counter[int] = Counter()
    numbered = []
    for column in found:
        if column.number == 0 and not any(other.number for other in found):
            count[column.direction] += 1
            column = RunColumn(column.name, count[column.direction], column.direction)
        numbered.append(column)
    return numbered


def _pair_of_letters(names: Sequence[str]) -> str:
    """Return the two letters of names such as V1, R1, V2, R2, positive first; empty where they are no pair of ways."""
    first = [
        tokens[0] for name in names if len(tokens := _tokens(name)) >= 2 and len(tokens[0]) == 1 and tokens[1].isdigit()
    ]
    return next((pair for pair in _LETTERS if set(first) == set(pair)), "")
