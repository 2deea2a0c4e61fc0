"""Positioning of rotary axes over their own angle: what all tables share, COMP_FILE of LinuxCNC, encoder tables of SINUMERIK.

Errors are actual minus commanded angle, positive as in ISO 841, degrees. A control may call the opposite sense of an axis
positive: then angles and values of its table have the opposite sign. Other controls are in :mod:`compgen.controls.rotary_lists`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from compgen.controls.linuxcnc_comp import parse_comp
from compgen.controls.shared.base import SourceFile
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, whole_number
from compgen.data.machine import ROTARY, Machine, RotaryAxis
from compgen.data.toml_files import setting
from compgen.errors import InputError

#: Rows that LinuxCNC reads of a COMP_FILE.
_MOST_ROWS = 256


@toml_files.accepts({"type": "array", "items": {"enum": list(ROTARY)}, "uniqueItems": True})
def _letters(value: object) -> tuple[str, ...]:
    """Rotary axes by letter, each once."""
    if not isinstance(value, list) or any(item not in ROTARY for item in value) or len(set(value)) != len(value):
        raise ValueError("expected a list of rotary axes, each once, such as ['A', 'C']")
    return tuple(value)


@toml_files.accepts({"type": "object", "additionalProperties": {"type": "string", "pattern": "^[A-Za-z]\\w*$"}})
def _names(value: object) -> dict[str, str]:
    """Names of axes by letter."""
    found = toml_files.table(value)
    for letter, name in found.items():
        if letter not in ROTARY or not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name):
            raise ValueError('expected names by letter, such as { A = "AX4", C = "AX5" }')
    return found


def letters_setting() -> Any:
    """Declare ``reversed_axes``."""
    return setting(
        _letters, (), meaning="axes whose positive sense on the control is opposite to ISO 841 and the machine file"
    )


def names_setting() -> Any:
    """Declare ``axis_names``."""
    return setting(_names, None, meaning='names of the rotary axes on the control, e.g. { A = "AX4", C = "AX5" }')


@dataclass(frozen=True)
class PitchSettings:
    """Settings of tables of rotary axes."""

    reversed_axes: tuple[str, ...] = letters_setting()
    axis_names: Mapping[str, str] | None = names_setting()
    encoder: int = setting(toml_files.whole(0, 1), 0, meaning="encoder of a SINUMERIK axis that the table belongs to")


@dataclass(frozen=True)
class AngleTable:
    """Nodes ascending and what the control adds to the command there, degrees, in the sense of the machine file, (n,).

    ``negative_deg`` is what it adds after travel in negative direction; None: the same. A table that was read says in
    ``turn_deg`` after which angle it repeats (None: end values hold outside), and in ``faults`` what is wrong with it.
    """

    angle_deg: FloatArray
    added_deg: FloatArray
    negative_deg: FloatArray | None = None
    turn_deg: float | None = None
    faults: tuple[str, ...] = ()

    def at(self, angle_deg: FloatArray, axis: RotaryAxis) -> FloatArray:
        """What should be added at commanded angles: linear between nodes, constant outside; an endless axis repeats."""
        return np.interp(angle_deg, self.angle_deg, self.added_deg, period=axis.modulo_deg)

    def emulated(self, angle_deg: FloatArray, direction: int = 1) -> FloatArray:
        """What a control with this table adds after travel in a direction: it knows of the axis only what the table says."""
        column = self.added_deg if direction > 0 or self.negative_deg is None else self.negative_deg
        first, where = self.angle_deg[0], np.asarray(angle_deg, dtype=np.float64)
        if self.turn_deg is not None:
            where = first + np.mod(where - first, self.turn_deg)
        return np.interp(where, self.angle_deg, column)

    @property
    def columns(self) -> tuple[FloatArray, FloatArray]:
        """Values after travel in positive and in negative direction."""
        return self.added_deg, self.added_deg if self.negative_deg is None else self.negative_deg

    def on(self, angle_deg: FloatArray, turn_deg: float | None) -> AngleTable:
        """The table with other nodes; beyond its own it repeats after a turn, or keeps its end values."""
        both = [np.interp(angle_deg, self.angle_deg, column, period=turn_deg) for column in self.columns]
        return replace(
            self, angle_deg=angle_deg, added_deg=both[0], negative_deg=None if self.negative_deg is None else both[1]
        )


#: Largest deviation of an evenly spaced table from the requested one between the nodes of both, degrees: 0.02 arcsec.
_EVEN_LOSS_DEG = 0.02 / 3600.0


def even_table(table: AngleTable, most: int) -> AngleTable:
    """The table on evenly spaced nodes, at most ``most``; spacings of whole 1e-6 degrees first, since files have 6 decimals."""
    first, last = table.angle_deg[0], table.angle_deg[-1]
    whole = round((last - first) * 1e6)
    best: tuple[float, AngleTable] | None = None
    for count in range(max(2, len(table.angle_deg)), most + 1):
        if whole % (count - 1):
            continue
        found = table.on(np.linspace(first, last, count), None)
        loss = deviation(table, found)
        if best is None or loss < best[0] - 1e-12:
            best = loss, found
        if loss <= _EVEN_LOSS_DEG:
            return found
    return table.on(np.linspace(first, last, min(most, 10 * len(table.angle_deg))), None) if best is None else best[1]


def deviation(wanted: AngleTable, found: AngleTable) -> float:
    """Largest difference of two polylines over the nodes of both, degrees: it lies at a node of one of them."""
    at = np.union1d(wanted.angle_deg, found.angle_deg)
    pairs = zip(wanted.columns, found.columns, strict=True)
    return max(
        float(np.abs(np.interp(at, wanted.angle_deg, one) - np.interp(at, found.angle_deg, other)).max())
        for one, other in pairs
    )


def with_turns(table: AngleTable, turn_deg: float, most: int) -> AngleTable:
    """The table of one turn with a turn before and after, if so many nodes are allowed: its axis may go on counting."""
    start, columns = table.angle_deg, [table.added_deg, *([] if table.negative_deg is None else [table.negative_deg])]
    if abs(start[-1] - start[0] - turn_deg) < 1e-9:
        start, columns = start[:-1], [column[:-1] for column in columns]
    turns = (-1.0, 0.0, 1.0) if 3 * len(start) < most else (0.0,)
    angle = np.concatenate([start + k * turn_deg for k in turns] + [start[:1] + (turns[-1] + 1.0) * turn_deg])
    columns = [np.concatenate([column] * len(turns) + [column[:1]]) for column in columns]
    return replace(
        table, angle_deg=angle, added_deg=columns[0], negative_deg=None if table.negative_deg is None else columns[1]
    )


Tables = Mapping[str, AngleTable]


@dataclass(frozen=True)
class PitchFormat:
    """The tables of one control as text, and back."""

    name: str
    title: str
    machine: Machine
    settings: Any
    settings_class: ClassVar[type[Any]] = PitchSettings
    #: Whether tables act by direction of travel; endings of the files; whether no document settles the format as a whole.
    both_ways: ClassVar[bool] = False
    endings: ClassVar[tuple[str, ...]] = (".ini", ".spf")

    def sense(self, letter: str) -> float:
        """Sign from the machine file to the control."""
        return -1.0 if letter in self.settings.reversed_axes else 1.0

    def check(self) -> None:
        """Raise InputError for settings that do not fit the machine."""

    def stated(self, key: str, what: str) -> Any:
        """A setting with a value for each rotary axis of the machine, which must all be given and differ."""
        found = getattr(self.settings, key) or {}
        missing = [letter for letter in self.machine.rotary if letter not in found]
        section = self.machine.controller_settings(self.name)
        if missing:
            raise section.fail(key, f"is missing for {', '.join(missing)}: {what}")
        if len(set(found.values())) < len(found):
            raise section.fail(key, f"has the same value twice: {', '.join(map(str, found.values()))}")
        return found

    def files(self, tables: Tables) -> dict[str, str]:
        """Text by name of file."""
        raise NotImplementedError

    def parse(self, contents: Mapping[Path, str]) -> dict[str, AngleTable]:
        """Tables by letter; InputError for anything that is not understood."""
        raise NotImplementedError

    def turned(self, letter: str, table: AngleTable) -> AngleTable:
        """The table in the sense of the other side: of the control, or of the machine file."""
        if self.sense(letter) > 0.0:
            return table
        positive, negative = (-column[::-1] for column in reversed(table.columns))
        return replace(
            table,
            angle_deg=-table.angle_deg[::-1],
            added_deg=positive,
            negative_deg=None if table.negative_deg is None else negative,
        )

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """What has to be done with the files of these axes, and what is known of their signs."""
        raise NotImplementedError

    def backlash(self, letter: str, reversal_deg: float) -> str:
        """What the control's own backlash parameter needs where the tables act alike in both directions.

        ``reversal_deg`` is the angle reached in positive travel minus that in negative travel, in the sense of the control.
        """
        return ""


class LinuxcncRotary(PitchFormat):
    """COMP_FILE of LinuxCNC, type 1, one for each rotary joint."""

    both_ways = True
    endings = (".comp",)

    def files(self, tables: Tables) -> dict[str, str]:
        """One file for each axis; an endless axis gets a turn before and after, since its joint goes on counting."""
        return {f"rotary-{letter.lower()}.comp": self._text(letter, table) for letter, table in tables.items()}

    def _text(self, letter: str, table: AngleTable) -> str:
        shown, turn = self.turned(letter, table), self.machine.rotary[letter].modulo_deg
        if turn is not None:
            shown = with_turns(shown, turn, _MOST_ROWS)
        if len(shown.angle_deg) > _MOST_ROWS:
            raise InputError(
                f"{letter} has {len(shown.angle_deg)} nodes; LinuxCNC reads at most {_MOST_ROWS}",
                field=f"axes.{letter}",
            )
        forward, reverse = (column + 0.0 for column in shown.columns)
        rows = zip(shown.angle_deg, forward, reverse, strict=True)
        return "".join(f"{at:.9f} {one:.9f} {other:.9f}\n" for at, one, other in rows)

    def parse(self, contents: Mapping[Path, str]) -> dict[str, AngleTable]:
        """Rows as LinuxCNC reads them; the letter is in the name of the file."""
        found: dict[str, AngleTable] = {}
        for path, text in contents.items():
            match = re.search(r"-([abc])\.comp$", path.name)
            letter = match[1].upper() if match else ""
            if letter not in self.machine.rotary or letter in found:
                raise InputError("the name does not say which axis it belongs to; expected rotary-c.comp", file=path)
            rows = parse_comp(SourceFile(path, text), 1)
            found[letter] = self.turned(letter, AngleTable(rows.nodes, *rows.columns))
        return found

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """COMP_FILE lines."""
        joints = "XYZABC"
        return [
            "Documented, and verified by running LinuxCNC for linear joints: the trim is added to the command; degrees.",
            *(
                f"[JOINT_{joints.index(letter)}] (or the number of joint {letter}): COMP_FILE = rotary-{letter.lower()}.comp, "
                "COMP_FILE_TYPE = 1"
                for letter in letters
            ),
            "The columns are the trims in positive and in negative travel: they contain the reversal of the axis, if known. "
            "LinuxCNC ignores BACKLASH of a joint with a COMP_FILE.",
            "A step at a reversal between 0.25 and 0.5 times MAX_ACCELERATION times the square of the servo period may never be "
            "applied (seen by running LinuxCNC).",
            "A joint that turns on beyond the table keeps its last value: home it again, or unwind it.",
        ]


#: Nodes of one table of encoder compensation that are written at most; MD38000 reserves them.
_MOST_ENC_COMP = 1000

_EEC = re.compile(r"\$AA_ENC_COMP(?P<key>_STEP|_MIN|_MAX|_IS_MODULO|)\[(?P<index>[^\]]+)\]\s*=\s*(?P<value>\S+)")


def md32450(encoder: int, name: str, reversal_deg: float) -> str:
    """The backlash of a SINUMERIK axis: positive if the encoder leads the table, the usual case."""
    return (
        f"MD32450 $MA_BACKLASH[{encoder},{name}] = {-reversal_deg:.6f} degrees, plus what it was during the measurement"
    )


class SiemensRotary(PitchFormat):
    """``$AA_ENC_COMP`` of SINUMERIK for rotary axes: measured errors, degrees."""

    @property
    def names(self) -> dict[str, str]:
        """Names of the machine axes; they must be stated."""
        found: dict[str, str] = self.stated("axis_names", 'state the machine axes, e.g. { A = "AX4", C = "AX5" }')
        return found

    def check(self) -> None:
        """Names must be stated."""
        _ = self.names

    def files(self, tables: Tables) -> dict[str, str]:
        """One file with all axes; the nodes are equidistant."""
        rows = [";degrees; value = measured error (actual - nominal); the control adds it to the actual position"]
        for letter, table in tables.items():
            shown, place = self.turned(letter, table), f"{self.settings.encoder},{{}}{self.names[letter]}"
            turn = self.machine.rotary[letter].modulo_deg
            shown = even_table(shown, _MOST_ENC_COMP)
            grid, values = shown.angle_deg, -shown.added_deg + 0.0
            rows += [f"$AA_ENC_COMP[{place.format(f'{k},')}]={value:.6f}" for k, value in enumerate(values)]
            step = (grid[-1] - grid[0]) / (len(grid) - 1)
            ends = {
                "STEP": f"{step:.6f}",
                "MIN": f"{grid[0]:.6f}",
                "MAX": f"{grid[-1]:.6f}",
                "IS_MODULO": str(int(turn is not None)),
            }
            rows += [f"$AA_ENC_COMP_{key}[{place.format('')}]={value}" for key, value in ends.items()]
        return {"ROTARY_EEC.INI": "\n".join(["%_N_AX_EEC_INI", "CHANDATA(1)", *rows, "M17"]) + "\n"}

    def parse(self, contents: Mapping[Path, str]) -> dict[str, AngleTable]:
        """Assignments of the axes, every node once."""
        letters = {name: letter for letter, name in self.names.items()}
        values: dict[str, dict[int, float]] = {}
        ends: dict[str, dict[str, float]] = {}
        for path, text in contents.items():
            for number, line in enumerate(text.splitlines(), start=1):
                plain = line.split(";")[0].strip()
                if not plain or plain.startswith("%") or plain in ("CHANDATA(1)", "M17"):
                    continue
                match = _EEC.fullmatch(plain)
                parts = match["index"].replace(" ", "").split(",") if match else []
                wanted = 3 if match and not match["key"] else 2
                if (
                    match is None
                    or len(parts) != wanted
                    or parts[0] != str(self.settings.encoder)
                    or parts[-1] not in letters
                ):
                    raise InputError(f"{plain[:60]!r} is not understood", file=path, line=number)
                own = (values if wanted == 3 else ends).setdefault(parts[-1], {})
                if wanted == 3 and whole_number(parts[1], 5) is None:
                    raise InputError(
                        f"{plain[:60]!r}: {parts[1][:20]!r} is no number of a node", file=path, line=number
                    )
                key = int(parts[1]) if wanted == 3 else match["key"]
                if key in own:
                    raise InputError(f"{plain[:60]!r} is given a second time", file=path, line=number)
                own[key] = _angle(match["value"], path, number)  # type: ignore[index]
        return {letters[name]: self._table(letters[name], rows, ends.get(name, {})) for name, rows in values.items()}

    def _table(self, letter: str, rows: Mapping[int, float], ends: Mapping[str, float]) -> AngleTable:
        if set(ends) != {"_STEP", "_MIN", "_MAX", "_IS_MODULO"} or sorted(rows) != list(range(len(rows))):
            raise InputError(f"the table of {letter} lacks nodes, or STEP, MIN, MAX, IS_MODULO", field=letter)
        angle = np.asarray(ends["_MIN"] + ends["_STEP"] * np.arange(len(rows)), dtype=np.float64)
        if ends["_STEP"] <= 0.0 or len(rows) < 2:
            raise InputError(f"the table of {letter} needs two nodes and STEP above zero", field=letter)
        if abs(angle[-1] - ends["_MAX"]) > 1e-4 * len(rows):
            raise InputError(
                f"the table of {letter} has {len(rows)} nodes; MIN, MAX and STEP say otherwise", field=letter
            )
        values = -np.array([rows[k] for k in range(len(rows))])
        return self.turned(letter, modulo_table(letter, angle, values, bool(ends["_IS_MODULO"])))

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """Machine data."""
        return [
            "Documented: the value is the measured error; the control adds it to the actual position: the axis moves against it.",
            "Inferred: as for linear axes, in degrees; no manual that was found has a worked number for a rotary axis.",
            "Load with MD32700 $MA_ENC_COMP_ENABLE = 0 only; MD38000 must be at least the number of nodes.",
        ]

    def backlash(self, letter: str, reversal_deg: float) -> str:
        """MD32450, positive where the axis stops short."""
        return md32450(self.settings.encoder, self.names[letter], reversal_deg)


def modulo_table(
    letter: str, angle_deg: FloatArray, added_deg: FloatArray, repeats: bool, negative_deg: FloatArray | None = None
) -> AngleTable:
    """A table of SINUMERIK: with IS_MODULO it repeats after MAX - MIN, where both ends must be alike."""
    both = (added_deg, added_deg if negative_deg is None else negative_deg)
    jump = max(abs(float(column[-1] - column[0])) for column in both)
    faults = (
        (f"{letter}: first and last value of the modulo table differ by {jump * 3600.0:.2f} arcsec",)
        if repeats and jump > 1e-6
        else ()
    )
    turn = float(angle_deg[-1] - angle_deg[0]) if repeats else None
    return AngleTable(angle_deg, added_deg, negative_deg, turn, faults)


def _angle(text: str, path: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) < 1e5:
        raise InputError(f"{text[:40]!r} is no angle", file=path, line=line)
    return value


def format_of(machine: Machine, name: str) -> PitchFormat:
    """The format of a control for a machine with rotary axes."""
    if not machine.rotary:
        raise InputError(
            f"{name} is for rotary axes; the machine {machine.name} has none", file=machine.source, field="chain"
        )
    kind = _kinds()[name]
    settings = toml_files.read_settings(kind.settings_class, machine.controller_settings(name))
    unknown = [letter for letter in settings.reversed_axes if letter not in machine.rotary]
    if unknown:
        raise machine.controller_settings(name).fail("reversed_axes", f"the machine has no axis {', '.join(unknown)}")
    if name == "linuxcnc-rotary-comp":
        settings = _as_kinematics(machine, settings)
    found = kind(name, ABOUT[name]["title"], machine, settings)
    found.check()
    return found


def _kinds() -> Mapping[str, type[PitchFormat]]:
    from compgen.controls import rotary_lists as lists

    return {
        "linuxcnc-rotary-comp": LinuxcncRotary,
        "siemens-rotary-eec": SiemensRotary,
        "siemens-rotary-cec": lists.SiemensRotaryCec,
        "fanuc-rotary-pitch": lists.FanucRotary,
        "heidenhain-rotary-com": lists.HeidenhainRotary,
        "twincat-rotary-list": lists.TwincatRotary,
        "aerotech-rotary": lists.AerotechRotary,
    }


def _as_kinematics(machine: Machine, settings: PitchSettings) -> PitchSettings:
    """Senses of LinuxCNC as the section of its kinematics states them; InputError if both sections disagree."""
    if "linuxcnc-trt" not in machine.controllers:
        return settings
    from compgen.controls.rotary_parameters import target_of

    against = {letter for letter, sense in target_of(machine, "linuxcnc-trt").sense.items() if sense < 0.0}
    section = machine.controller_settings("linuxcnc-rotary-comp")
    if "reversed_axes" in section.data and set(settings.reversed_axes) != against:
        raise section.fail(
            "reversed_axes",
            f"is {list(settings.reversed_axes)}; [controllers.linuxcnc-trt] conventional_directions says {sorted(against)}",
        )
    return replace(settings, reversed_axes=tuple(sorted(against)))


#: What each format is, for lists.
ABOUT: Mapping[str, Mapping[str, str]] = {
    "linuxcnc-rotary-comp": {
        "title": "LinuxCNC, COMP_FILE of rotary joints",
        "expresses": "positioning of A, B, C over their own angle (degrees)",
        "evidence": "documented",
        "file": "rotary-a.comp ...",
        "settings": "reversed_axes: axes that turn against ISO 841 on the control, e.g. with trt kinematics by default",
    },
    "siemens-rotary-eec": {
        "title": "SINUMERIK, encoder error compensation of rotary axes",
        "expresses": "positioning of A, B, C over their own angle (degrees)",
        "evidence": "documented, for rotary axes inferred",
        "file": "ROTARY_EEC.INI",
        "settings": "axis_names, mandatory; encoder; reversed_axes",
    },
    "siemens-rotary-cec": {
        "title": "SINUMERIK, sag compensation (CEC) with a rotary base axis",
        "expresses": "positioning of A, B, C over their own angle (degrees), by direction of travel",
        "evidence": "documented; sign inferred",
        "file": "ROTARY_CEC.INI",
        "settings": 'axis_names, mandatory; first_table; sign = "error" (default) or "correction"; reversed_axes',
    },
    "fanuc-rotary-pitch": {
        "title": "FANUC, stored pitch error compensation of rotary axes",
        "expresses": "positioning of A, B, C over their own angle, whole detection units at the ends of equal sections of a turn",
        "evidence": "documented (worked example of the 0i-PB manual); sign from shop practice, records of 15i",
        "file": "ROTARYPITCH.TXT",
        "settings": "axis_numbers, mandatory; detection_unit_deg, magnification, interval_deg, first_number, "
        "reference_position_deg, increment_limit, number_base, q_word; reversed_axes",
    },
    "heidenhain-rotary-com": {
        "title": "HEIDENHAIN, .COM table of rotary axes",
        "expresses": "positioning of A, B, C over their own angle, 0 to 360 degrees",
        "evidence": "documented (columns, 0 to 360 degrees); sign probable, unit degrees inferred",
        "file": "AXIS_C.COM ...",
        "settings": 'sign = "error" (default) or "correction"; axis_names; decimals; negative_as_turn; reversed_axes',
    },
    "twincat-rotary-list": {
        "title": "TwinCAT and ISG kernel, leadscrew table (kw.ssfk) of rotary axes",
        "expresses": "positioning of A, B, C over their own angle (0.0001 degrees), by direction of travel",
        "evidence": "documented; modulo is not used, since no document says which node closes the turn",
        "file": "rotary-c.lis ...",
        "settings": "axis_numbers, mandatory; reversed_axes",
    },
    "aerotech-rotary": {
        "title": "Aerotech, one-dimensional axis calibration of rotary axes",
        "expresses": "positioning of A, B, C over their own angle (degrees), the same in both directions",
        "evidence": "unverified",
        "file": "rotary.cal",
        "settings": "axis_numbers, mandatory; reversed_axes (also for ReverseMotionDirection: tables follow the encoder)",
    },
}
