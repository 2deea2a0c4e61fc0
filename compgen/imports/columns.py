"""What the columns of a foreign table are: fields by the words of their names, units by what stands in brackets."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from compgen.core.names import ERROR_NAMES
from compgen.core.text import nearest
from compgen.errors import InputError
from compgen.imports.run_names import run_in
from compgen.imports.units import Quantity, further_unit

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
    "direction": ("direction", "dir", "richtung", "approach", "fahrtrichtung", "way", "anfahrrichtung",
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
#: A channel of temperature that the user names by --map temp_NAME=COLUMN.
CHANNEL = re.compile(r"temp_[a-z0-9_]{1,30}")
#: A column of one run that the user names by --map run3-=COLUMN: number, and direction if one is given.
RUN_FIELD = re.compile(r"run(\d{1,3})([+\-]?)")
_TEMPERATURE = re.compile(r"(?<!at)temp(?!o|late|s$)|\u6e29\u5ea6")
_BRACKETS = re.compile(r"\s*[\[(<{]\s*([^\])>}]{1,20}?)\s*[\])>}]\s*")
_SUFFIX = re.compile(r"^(.*?\w)[\s_/,]+([a-zA-Z\u00b0\u00b5\u03bc\"']{1,12}|um/m|mm/m|m{1,2}/min|m{1,2}/s)$")


@dataclass(frozen=True)
class Column:
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


def split_name(name: str) -> Column:
    """Split a column's name into words and unit.

    >>> split_name("Pos. [mm]"), split_name("dx_um").unit, split_name("Abweichung / µm").unit
    (Column(name='Pos. [mm]', word='pos', unit='mm'), 'um', 'um')
    """
    if name.lower().endswith("_mm_min"):
        return Column(name, _word(name[: -len("_mm_min")]), "mm/min")
    bracket = _BRACKETS.search(name)
    unit = bracket and (known_unit(bracket.group(1)) or further_unit(bracket.group(1)))
    if bracket and unit:
        return Column(name, _word(f"{name[: bracket.start()]} {name[bracket.end() :]}"), unit)
    suffix = _SUFFIX.match(name.strip())
    if suffix:
        word = _word(suffix.group(1))
        quantity = quantity_of(word)
        unit = known_unit(suffix.group(2)) or (further_unit(suffix.group(2), quantity) if quantity else None)
        if unit:
            return Column(name, word, unit)
    return Column(name, _word(name), None)


def quantity_of(word: str) -> Quantity | None:
    """Return what a column beside the readings holds, by the word of its name; None if the word does not say it.

    >>> quantity_of("airtemp"), quantity_of("vorschub"), quantity_of("timestamp"), quantity_of("position")
    ('temperature', 'feed', 'time', None)
    """
    quantities: tuple[Quantity, ...] = ("time", "feed", "load")
    for key in quantities:
        if word in FIELDS[key]:
            return key
    return "temperature" if _TEMPERATURE.search(word) else None


def _word(text: str) -> str:
    flat = unicodedata.normalize("NFKD", text).lower().replace("x\u0304", "mean")  # x with a bar is no coordinate
    return re.sub(r"[^a-z0-9\u4e00-\u9fff]", "", flat)


def fields_of(header: Sequence[str], given: Mapping[str, str], ignored: Sequence[str] = ()) -> dict[str, Column]:
    """Return the column of each field: those that the user gave, then those whose name says so, but none of ``ignored``.

    Raises InputError for a field or column that does not exist.
    """
    columns = [split_name(name) for name in header if name not in ignored]
    found: dict[str, Column] = {}
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
        if key in ("actual", "deviation", "value"):  # one way of several, "Deviation +", is a run
            matching = [column for column in matching if (run := run_in(column.name)) is None or not run.direction]
        if matching:
            found[key] = min(matching, key=lambda column: words.index(column.word))
            taken.add(found[key].name)
    return found


def is_index(name: str) -> bool:
    """Whether a column with this name counts the rows."""
    return split_name(name).word in _INDEX


def check_field(key: str, option: str) -> None:
    """Raise InputError for a name that is no field of a table."""
    if key not in FIELDS and key != "temperature" and not CHANNEL.fullmatch(key) and not RUN_FIELD.fullmatch(key):
        known = [*FIELDS, "temperature", "temp_NAME", "run1+", "run1-"]
        raise InputError(f"{key!r} is no field; {nearest(key, known)}", field=option)


def error_columns(header: Sequence[str]) -> dict[str, Column]:
    """Return the columns that are called like the errors of ISO 230-1."""
    columns = [split_name(name) for name in header]
    return {column.word.upper(): column for column in columns if column.word.upper() in ERROR_NAMES}
