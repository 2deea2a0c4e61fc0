"""Names of columns, runs, directions and units in the notation of laboratories of several countries."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from compgen.data.csv_files import whole_number
from compgen.data.names import ERROR_NAMES
from compgen.errors import InputError, nearest

# Names of runs, directions and statistics as laboratories of several countries write them.
#
# A name is split into words, numbers and marks. It names a run only if all of them are understood; so a column with an
# unknown word is never mistaken for something else, and never ignored.


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
#: Statistics that laboratories print next to the runs; only those of kind mean and scatter are compared with them.
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
#: Single letters of ISO 230-2; they are statistics only as a complete name, with or without a direction.
_ISO_LETTERS = {"b": "other", "r": "other", "m": "other", "e": "other", "a": "other", "s": "scatter", "x": "mean"}
_UNITS = frozenset(["um", "mm", "nm", "in", "inch", "mil", "mm/m", "um/m", "urad", "mrad", "arcsec", "m"])
#: First letters of both directions, if a table has one of these pairs: forward and back in six languages.
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
    """The words of a name: numbers, directions, kinds of statistics, and unknown ones."""

    numbers: tuple[int, ...]
    ways: frozenset[int]
    statistics: tuple[str, ...]
    unknown: tuple[str, ...]
    names_run: bool


def unaccented(text: str) -> str:
    """Return lower case without accents; signs with several notations become one, a bar over x remains."""
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
    """Return words, numbers and marks; a minus within a name separates words, at its ends it is a direction."""
    found = [token for token in _TOKEN.findall(unaccented(text)) if token not in _SEPARATORS]
    while len(found) > 1 and found[-1] in _UNITS:
        found.pop()
    ends = {0, len(found) - 1}
    inside = re.findall(r"[(\[]\s*-\s*[)\]]", unaccented(text))
    return [token for k, token in enumerate(found) if token != "-" or k in ends or inside]


def _read(text: str, letters: str = "") -> _Words:
    """Classify the words of a name; ``letters`` are those of the two directions, positive first."""
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
                continue  # 2 s is not a second run
            whole = whole_number(token, 3)
            numbers += [] if whole is None else [whole]
            unknown += [token] if whole is None else []
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
    """Return the run of a name or a label, None if a word of it is not understood.

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
    """Whether a text is only about runs or directions, such as ``Lauf``, ``Run no.``, ``Richtung``."""
    words = _read(text)
    about = words.names_run or any(
        token in ("direction", "dir", "richtung", "sens", "direzione") for token in _tokens(text)
    )
    return about and not (words.unknown or words.statistics)


def is_deviation(text: str) -> bool:
    """Whether a name refers to deviations or errors, in one of the supported languages."""
    return any(token in _DEVIATIONS for token in _tokens(text))


def is_known_name(text: str) -> bool:
    """Whether every word of a text is one of runs, directions, deviations, statistics or units, and not only a number."""
    words = _read(text)
    return not words.unknown and not text.replace(".", "").replace(",", "").lstrip("+-").isdigit()


def statistic_in(text: str) -> tuple[str, int] | None:
    """Return the kind of a statistic ("mean", "scatter", "other") that a name names, and its direction (0: of both).

    A number in the name makes it that of one run, so it is not a statistic over the runs.

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
    """Return the columns that hold one run each, such as ``Run 1 +``, ``fwd2``, ``r3``, ``V1`` next to ``R1``.

    Names without a number are counted for each direction in their order.

    >>> run_columns(["target", "Run 1+", "Run 1-", "bwd 2"], ["target"])[1:]
    [RunColumn(name='Run 1-', number=1, direction=-1), RunColumn(name='bwd 2', number=2, direction=-1)]
    """
    names = [name for name in header if name not in taken]
    # the two letters of names such as V1, R1, V2, R2, positive first; empty if they are not such a pair
    first = [
        tokens[0] for name in names if len(tokens := _tokens(name)) >= 2 and len(tokens[0]) == 1 and tokens[1].isdigit()
    ]
    letters = next((pair for pair in _LETTERS if set(first) == set(pair)), "")
    found = [column for name in names if (column := run_in(name, letters)) is not None]
    count: Counter[int] = Counter()
    numbered = []
    for column in found:
        if column.number == 0 and not any(other.number for other in found):
            count[column.direction] += 1
            column = RunColumn(column.name, count[column.direction], column.direction)
        numbered.append(column)
    return numbered


# Units of columns other than the readings: temperatures, times, feeds, masses.


Quantity = Literal["temperature", "time", "feed", "load"]
#: degC = factor * value + offset.
CELSIUS: Mapping[str, tuple[float, float]] = {
    "degC": (1.0, 0.0),
    "K": (1.0, -273.15),
    "degF": (5.0 / 9.0, -160.0 / 9.0),
}
S_PER_TIME = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
MM_MIN_PER_FEED = {"mm/min": 1.0, "m/min": 1e3, "mm/s": 60.0, "m/s": 6e4, "in/min": 25.4}
KG_PER_MASS = {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237}
_BY_QUANTITY: Mapping[Quantity, tuple[str, ...]] = {
    "temperature": tuple(CELSIUS),
    "time": tuple(S_PER_TIME),
    "feed": tuple(MM_MIN_PER_FEED),
    "load": tuple(KG_PER_MASS),
}
_WORDS = {
    word: unit
    for unit, words in {
        "degC": "c \u00b0c \u00bac \u2103 degc celsius gradc gradcelsius degreescelsius degreesc",
        "K": "k kelvin \u00b0k",
        "degF": "f \u00b0f \u2109 degf fahrenheit",
        "s": "sec secs second seconds sek sekunden",
        "ms": "msec",
        "min": "minutes minuten",
        "h": "hours hour std stunden",
        "mm/min": "mmpm mm/minute",
        "in/min": "inch/min ipm",
        "lb": "lbs",
        "t": "tonnes",
    }.items()
    for word in words.split()
}


def covariate_unit(text: str, quantity: Quantity | None = None) -> str | None:
    """Return the name of such a unit as it is used here, of one quantity if that is given; None for other units.

    >>> covariate_unit("°C"), covariate_unit("Kelvin"), covariate_unit("m/min"), covariate_unit("um"), covariate_unit("s", "load")
    ('degC', 'K', 'm/min', None, None)
    """
    word = text.strip().lower().replace("\u00c2", "").replace(" ", "").replace(".", "")
    allowed = [unit for name, units in _BY_QUANTITY.items() if quantity in (None, name) for unit in units]
    unit = _WORDS.get(word, word)
    return unit if unit in allowed else None


# The columns of a foreign table: fields by the words of their names, units by the text in brackets.


MM_PER_LENGTH = {"mm": 1.0, "um": 1e-3, "nm": 1e-6, "m": 1e3, "cm": 10.0, "in": 25.4, "mil": 0.0254, "0.1um": 1e-4}
RAD_PER_ANGLE = {
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "arcsec": 4.84813681109536e-6,
    "deg": 0.017453292519943295,
    "um/m": 1e-6,
    "mm/m": 1e-3,
}
_UNIT_WORDS = {
    "micron": "um",
    "microns": "um",
    "mikrometer": "um",
    "micrometer": "um",
    "inch": "in",
    "inches": "in",
    '"': "arcsec",
    "''": "arcsec",
    "sec": "arcsec",
    "as": "arcsec",
    "microrad": "urad",
    "millimeter": "mm",
    "degree": "deg",
    "\u00b0": "deg",
    "meter": "m",
}
#: Words of column names by field; the words are compared without case, accents, blanks and units.
FIELDS: Mapping[str, tuple[str, ...]] = {
    "position": ("position", "pos", "target", "targetposition", "nominal", "nominalposition", "soll", "sollposition",
                 "sollwert", "command", "commanded", "cmd", "setpoint", "targets", "zielposition", "axisposition",
                 "sollpos", "zielpos", "targetpos", "nominalpos", "sollpositionen", "positionen", "positions", "messposition",
                 "messpunkt", "stutzpunkt", "posizione", "posizionenominale", "quota", "posicion", "posicionnominal", "cota",
                 "positionnominale", "positioncible", "positioncommandee", "cible", "consigne", "cote", "objetivo",
                 "\u4f4d\u7f6e", "\u76ee\u6807\u4f4d\u7f6e", "\u6307\u4ee4\u4f4d\u7f6e", "\u5750\u6807",
                 "\u540d\u4e49\u4f4d\u7f6e", "\u7406\u8bba\u4f4d\u7f6e", "\u76ee\u6807"),
    "actual": ("actual", "actualposition", "measured", "measuredposition", "ist", "istposition", "istwert", "reading",
               "laserreading", "laserposition", "measurement", "mesure", "misura", "medida", "positionmesuree",
               "posizionemisurata", "posicionmedida", "gemessen", "messwert", "\u5b9e\u6d4b", "\u5b9e\u6d4b\u503c",
               "\u5b9e\u9645\u4f4d\u7f6e"),
    "deviation": ("deviation", "dev", "error", "err", "abweichung", "positionsabweichung", "fehler", "diff", "difference",
                  "delta", "poserror", "positionerror", "positioningerror", "positiondeviation", "ecart", "erreur", "scarto",
                  "scostamento", "errore", "desviacion", "abw", "positionsfehler", "positionierabweichung", "abweichungen",
                  "\u504f\u5dee", "\u8bef\u5dee"),
    "correction": ("correction", "compensation", "comp", "korrektur", "korrekturwert", "compensationvalue",
                   "correzione", "correccion"),
    "direction": ("direction", "dir", "richtung", "approach", "fahrtrichtung", "way", "anfahrrichtung", "drehrichtung",
                  "drehsinn", "senseofrotation", "rotation", "testdirection", "sensderotation", "sensodirotazione",
                  "sens", "direzione", "direccion", "\u65b9\u5411"),
    "run": ("run", "cycle", "lauf", "messlauf", "pass", "zyklus", "runno", "runnumber", "cycleno", "messreihe",
            "essai", "prova", "ciclo", "ensayo"),
    "axis": ("axis", "achse", "axe", "asse", "eje", "\u8f74"),
    "station": ("station", "tracer", "stationid", "trackerposition", "standpunkt"),
    "point": ("point", "pointid", "pt", "punkt", "pointno", "pointname", "target id", "id", "no", "nr"),
    "length": ("length", "displacement", "distance", "laenge", "lange", "laserlength", "laser", "range", "abstand",
               "longueur", "lunghezza", "longitud", "distanza"),
    "x": ("x", "xcmd", "xcommanded", "xnom", "xnominal", "xsoll", "xpos", "xposition", "commandedx", "nominalx", "xtarget",
          "xachse", "xaxis", "axex", "assex", "ejex", "positionx"),
    "y": ("y", "ycmd", "ycommanded", "ynom", "ynominal", "ysoll", "ypos", "yposition", "commandedy", "nominaly", "ytarget",
          "yachse", "yaxis", "axey", "assey", "ejey", "positiony"),
    "z": ("z", "zcmd", "zcommanded", "znom", "znominal", "zsoll", "zpos", "zposition", "commandedz", "nominalz", "ztarget",
          "zachse", "zaxis", "axez", "assez", "ejez", "positionz"),
    "dx": ("dx", "xdev", "xerror", "xdeviation", "deltax", "errorx", "ex", "devx", "xabweichung",
           "abweichungx", "deviationx", "positionsabweichungx",
           "fehlerx", "xfehler"),
    "dy": ("dy", "ydev", "yerror", "ydeviation", "deltay", "errory", "ey", "devy", "yabweichung",
           "abweichungy", "deviationy", "positionsabweichungy",
           "fehlery", "yfehler"),
    "dz": ("dz", "zdev", "zerror", "zdeviation", "deltaz", "errorz", "ez", "devz", "zabweichung",
           "abweichungz", "deviationz", "positionsabweichungz",
           "fehlerz", "zfehler"),
    "xa": ("xactual", "xmeasured", "xmeas", "xist", "actualx", "measuredx", "xact"),
    "ya": ("yactual", "ymeasured", "ymeas", "yist", "actualy", "measuredy", "yact"),
    "za": ("zactual", "zmeasured", "zmeas", "zist", "actualz", "measuredz", "zact"),
    "angle": ("angle", "winkel", "theta", "phi", "polarangle", "bahnwinkel", "angolo", "angulo", "\u89d2\u5ea6"),
    "radius": ("radius", "nominalradius", "sollradius", "rayon", "raggio", "radio", "\u534a\u5f84", "testradius", "circleradius",
               "ballbarlength", "ballbarradius", "nominalballbarlength", "barlength", "kreisradius", "prufradius", "messradius",
               "bahnradius", "nennradius", "rayonnominal", "raggionominale", "radionominal"),
    "plane": ("plane", "ebene", "plan", "piano", "plano", "\u5e73\u9762", "testplane", "planeoftest", "measuringplane",
              "measurementplane", "messebene", "prufebene", "testebene", "kreisebene", "plandemesure", "plandutest",
              "pianodimisura", "planodemedida"),
    "error": ("errorname", "parameter", "component", "parametername"),
    "value": ("value", "wert"),
    "u_value": ("uvalue", "ulength", "udeviation", "standarduncertainty", "standardunsicherheit"),
    "date": ("date", "datum", "messdatum", "measurementdate", "testdate", "fecha", "\u65e5\u671f"),
    "time": ("time", "zeit", "times", "timestamp", "elapsed", "datetime", "dateandtime", "datumzeit", "datumuhrzeit",
             "zeitstempel", "uhrzeit", "messzeit", "temps", "heure", "tempo", "ora", "tiempo", "hora"),
    "tool_x": ("toolx", "tooloffsetx", "xtool", "xtooloffset", "werkzeugx", "werkzeugversatzx"),
    "tool_y": ("tooly", "tooloffsety", "ytool", "ytooloffset", "werkzeugy", "werkzeugversatzy"),
    "tool_z": ("toolz", "tooloffsetz", "ztool", "ztooloffset", "werkzeugz", "werkzeugversatzz"),
    "approach_x": ("approachx", "xapproach", "directionx", "xdirection", "dirx", "richtungx"),
    "approach_y": ("approachy", "yapproach", "directiony", "ydirection", "diry", "richtungy"),
    "approach_z": ("approachz", "zapproach", "directionz", "zdirection", "dirz", "richtungz"),
    "feed": ("feed", "feedrate", "vorschub", "vorschubgeschwindigkeit", "velocity", "speed", "geschwindigkeit", "f",
             "avance", "avanzamento"),
    "load": ("load", "weight", "mass", "payload", "workpieceweight", "tableload", "gewicht", "masse", "last", "beladung",
             "werkstuckgewicht", "poids", "peso", "carico"),
    "repeat": ("repeat", "repetition", "wiederholung"),
    "line": ("line", "linie", "messlinie"),
    "block": ("block",),
    "setup": ("setup", "aufstellung", "setupno"),
    "pose": ("pose", "stop", "halt"),
}  # fmt: skip
#: Names of columns that count the rows.
_INDEX = ("i", "no", "nr", "n", "index", "count", "number", "nummer", "lfdnr", "posnr", "point", "pointno", "punkt", "punktnr",
          "zielnr", "targetno", "targetnumber", "step", "schritt", "sample", "row", "zeile", "numero", "num", "id",
          "\u5e8f\u53f7", "\u7f16\u53f7")  # fmt: skip
#: A channel of temperature given by --map temp_NAME=COLUMN.
CHANNEL = re.compile(r"temp_[a-z0-9_]{1,30}")
#: A column of one run given by --map run3-=COLUMN: number, and direction if given.
RUN_FIELD = re.compile(r"run(\d{1,3})([+\-]?)")
_TEMPERATURE = re.compile(r"(?<!at)temp(?!o|late|s$)|\u6e29\u5ea6")
_BRACKETS = re.compile(r"[\[(<{]\s*+([^\])>}]{1,20}?)\s*+[\])>}]")
#: A unit after the words of a name; tried where blanks begin, once for each.
_SUFFIX = re.compile(
    r"((?<=[^\W_])|(?<![\w\s/,])[\s/,]*+_)[\s_/,]++([a-zA-Z\u00b0\u00b5\u03bc\"']{1,12}|um/m|mm/m|m{1,2}/min|m{1,2}/s)$"
)


@dataclass(frozen=True)
class NamedColumn:
    """One column: its name in the file, the name without unit, and the unit if it says one."""

    name: str
    word: str
    unit: str | None


def known_unit(text: str) -> str | None:
    """Return the name of a unit of length or angle as it is used here; None if it is none.

    >>> known_unit("µm"), known_unit("Inch"), known_unit("arc sec"), known_unit("kg")
    ('um', 'in', 'arcsec', None)
    """
    word = text.strip().lower().replace("\u00c2", "").replace("\u00e2", "").replace(" ", "")
    word = word.replace("\u00b5", "u").replace("\u03bc", "u")
    word = _UNIT_WORDS.get(word, word)
    return word if word in MM_PER_LENGTH or word in RAD_PER_ANGLE else None


def split_name(name: str) -> NamedColumn:
    """Split a column's name into words and unit.

    >>> split_name("Pos. [mm]"), split_name("dx_um").unit, split_name("Abweichung / µm").unit
    (NamedColumn(name='Pos. [mm]', word='pos', unit='mm'), 'um', 'um')
    """
    if name.lower().endswith("_mm_min"):
        return NamedColumn(name, _word(name[: -len("_mm_min")]), "mm/min")
    for bracket in _BRACKETS.finditer(name):  # the first one with a unit: U (k=2) [um]
        unit = known_unit(bracket.group(1)) or covariate_unit(bracket.group(1))
        if unit is None:
            continue
        return NamedColumn(name, _word(f"{name[: bracket.start()]} {name[bracket.end() :]}"), unit)
    words, suffix = without_suffix(name)
    if suffix:
        word = _word(words)
        quantity = quantity_of(word)
        unit = known_unit(suffix) or (covariate_unit(suffix, quantity) if quantity else None)
        if unit:
            return NamedColumn(name, word, unit)
    return NamedColumn(name, _word(name), None)


def without_suffix(name: str) -> tuple[str, str]:
    """Return the words of a column's name and what may be its unit behind them; nothing for the unit if there is none.

    >>> without_suffix("Abweichung / \u00b5m"), without_suffix("straightness um/m"), without_suffix("Pos.")
    (('Abweichung', '\u00b5m'), ('straightness', 'um/m'), ('Pos.', ''))
    """
    text = name.strip()
    found = _SUFFIX.search(text)
    if found is None or "\n" in text[: found.end(1)]:
        return text, ""
    return text[: found.end(1)], found[2]


def quantity_of(word: str) -> Quantity | None:
    """Return what a column other than the readings contains, by the word of its name; None if the word is not clear.

    >>> quantity_of("airtemp"), quantity_of("vorschub"), quantity_of("timestamp"), quantity_of("position")
    ('temperature', 'feed', 'time', None)
    """
    quantities: tuple[Quantity, ...] = ("time", "feed", "load")
    for key in quantities:
        if word in FIELDS[key]:
            return key
    return "temperature" if _TEMPERATURE.search(word) else None


def _word(text: str) -> str:
    flat = unicodedata.normalize("NFKD", text).lower().replace("x\u0304", "mean")  # x with a bar is not a coordinate
    return re.sub(r"[^a-z0-9\u4e00-\u9fff]", "", flat)


def fields_of(header: Sequence[str], given: Mapping[str, str], ignored: Sequence[str] = ()) -> dict[str, NamedColumn]:
    """Return the column of each field: those given by the user, then those recognised by name, but none of ``ignored``.

    Raises InputError for a field or column that does not exist.
    """
    columns = [split_name(name) for name in header if name not in ignored]
    found: dict[str, NamedColumn] = {}
    for key, name in given.items():
        check_field(key, "--map")
        if name not in header:
            raise InputError(f"there is no column {name!r}; {nearest(name, header)}", field="--map")
        found[key] = split_name(name)
    taken = {column.name for column in found.values()}
    for key, words in FIELDS.items():
        if key in found:
            continue
        matching = [column for column in columns if column.name not in taken and column.word in words]
        if key in ("actual", "deviation", "value"):  # one direction of several, "Deviation +", is a run
            matching = [column for column in matching if (run := run_in(column.name)) is None or not run.direction]
        if matching:
            found[key] = min(matching, key=lambda column: words.index(column.word))
            taken.add(found[key].name)
    return found


def is_index(name: str) -> bool:
    """Whether a column with this name counts the rows."""
    return split_name(name).word in _INDEX


def check_field(key: str, option: str) -> None:
    """Raise InputError for a name that is not a field of a table."""
    if (
        key not in FIELDS
        and key not in ERROR_NAMES
        and key not in ("temperature", "feature")
        and not CHANNEL.fullmatch(key)
        and not RUN_FIELD.fullmatch(key)
    ):
        known = [*FIELDS, "temperature", "temp_NAME", "run1+", "run1-"]
        raise InputError(f"{key!r} is not a field; {nearest(key, known)}", field=option)


def error_columns(header: Sequence[str]) -> dict[str, NamedColumn]:
    """Return the columns named like the errors of ISO 230-1."""
    columns = [split_name(name) for name in header]
    return {column.word.upper(): column for column in columns if column.word.upper() in ERROR_NAMES}


# Names of error motions in words: straightness, pitch, yaw, roll.


_ENDING = r"(?:en|ing|winkel|bewegung|fehler|abweichung|error|angle)?(?![a-z])"
#: Parts of words without accents, in English, German, French, Italian and Spanish.
_MOTIONS = {
    "straightness": re.compile(r"straight[a-z]*|gerad[a-z]*|rectitud[a-z]*|rettiline[a-z]*"),
    "pitch": re.compile(rf"(?<![a-z])(?:pitch|nick|tangage|beccheggio|cabeceo){_ENDING}"),
    "yaw": re.compile(rf"(?<![a-z])(?:yaw|gier|lacet|imbardata|guinada){_ENDING}"),
    "roll": re.compile(rf"(?<![a-z])(?:roll|wank|roulis|rollio|alabeo){_ENDING}"),
    "error": re.compile(r"(?<![a-z])e_?([xyzabc])_?([xyz])(?![a-z0-9])"),
}
_SIDES = {
    "H": re.compile(r"(?<![a-z])h(?![a-z0-9])|horiz[a-z]*|waag[a-z]*|orizz[a-z]*"),
    "V": re.compile(r"(?<![a-z])v(?![a-z0-9])|verti[a-z]*|senkr[a-z]*"),
}
_LETTER = re.compile(r"(?<![a-z])([xyz])(?![a-z0-9])")
#: Words of such names that say nothing more.
_BESIDE_AXIS = re.compile(r"-?(?<![a-z])(?:axis|achse|axe|asse|eje|von|along|angle|winkel|level|libelle)(?![a-z/])")
#: Errors by words where Z is vertical; H and V are straightness, horizontal and vertical.
_BY_WORDS = {
    "X": {"pitch": "EBX", "yaw": "ECX", "roll": "EAX", "H": "EYX", "V": "EZX"},
    "Y": {"pitch": "EAY", "yaw": "ECY", "roll": "EBY", "H": "EXY", "V": "EZY"},
    "Z": {"roll": "ECZ"},
}


@dataclass(frozen=True)
class MotionColumn:
    """A column of one error motion: its run, the motion in words or as in ISO 230-1, and letters X, Y, Z, H, V of its name."""

    run: RunColumn
    motion: str
    letters: frozenset[str] = frozenset()

    @property
    def exact(self) -> bool:
        """Whether it is named as in ISO 230-1, which states the sign."""
        return self.motion in ERROR_NAMES

    def error(self, axis: str) -> str | None:
        """Return the name of the error of an axis, with Z vertical; None if the words do not say which one it is."""
        across = self.letters - {axis}
        if self.exact:
            return self.motion
        if self.motion != "straightness":
            return None if across else _BY_WORDS[axis].get(self.motion)
        if len(across) != 1:
            return None
        (side,) = across
        return _BY_WORDS[axis].get(side) if side in _SIDES else f"E{side}{axis}"


def motions_in(name: str) -> list[str]:
    """Return the error motions that a name mentions, whatever else it says."""
    flat = unaccented(name)
    return [motion for motion, pattern in _MOTIONS.items() if pattern.search(flat)]


def motion_in(name: str) -> MotionColumn | None:
    """Return the error motion of a column, None if a word of its name is not understood.

    >>> motion_in("Geradheit Y vor [\u00b5m]").error("X"), motion_in("Pitch run 2 - [arcsec]").run.number, motion_in("pitch mean")
    ('EYX', 2, None)
    """
    unit, (words_before, suffix) = split_name(name).unit, without_suffix(name)
    within = [bracket for bracket in _BRACKETS.finditer(name) if known_unit(bracket.group(1))]
    text = name
    if unit and within:
        text = f"{name[: within[0].start()]} {name[within[0].end() :]}"
    elif unit and suffix:
        text = words_before
    flat = unaccented(text)
    flat = flat if _MOTIONS["error"].search(flat) else flat.replace("_", " ")
    motions = motions_in(flat)
    if len(motions) != 1:
        return None
    # a dash between words is no direction
    rest = _BESIDE_AXIS.sub(" ", _MOTIONS[motions[0]].sub(" ", re.sub(r"(?<=\w)\s+-\s+(?=[a-z])", " ", flat)))
    letters = [letter.upper() for letter in _LETTER.findall(rest)]
    rest = _LETTER.sub(" ", rest)
    for side, pattern in _SIDES.items() if motions[0] == "straightness" else ():
        letters += [side] if pattern.search(rest) else []
        rest = pattern.sub(" ", rest)
    words = _read(rest)
    if words.unknown or words.statistics or len(words.numbers) > 1 or len(words.ways) > 1:
        return None
    run = RunColumn(name, next(iter(words.numbers), 0), next(iter(words.ways), 0))
    exact = _MOTIONS["error"].search(flat)
    return MotionColumn(run, f"E{exact[1]}{exact[2]}".upper() if exact else motions[0], frozenset(letters))
