"""Positioning tables of rotary axes of further controls: SINUMERIK CEC, FANUC, HEIDENHAIN, TwinCAT, Aerotech.

Each class knows how its control stores and applies such a table (``parse`` reads what the control would do from the text
alone); where no document says it, nothing is written and the message says so.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from compgen.controls.fanuc_records import Record, axis_values, read_records, type_word
from compgen.controls.heidenhain_text import default_layout, read_table
from compgen.controls.rotary_pitch import (
    AngleTable,
    PitchFormat,
    Tables,
    even_table,
    letters_setting,
    md32450,
    modulo_table,
    names_setting,
    with_turns,
)
from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.scanner import content_lines, fixed_point
from compgen.controls.siemens_text import read_assignments
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.machine import ROTARY
from compgen.data.toml_files import setting, whole
from compgen.errors import InputError

Contents = Mapping[Path, str]


def _sources(contents: Contents) -> list[SourceFile]:
    return [SourceFile(path, text) for path, text in contents.items()]


def _by_letter(check: Any) -> Any:
    """A setting with a value for each of some rotary axes."""

    @toml_files.accepts({"type": "object", "additionalProperties": toml_files.accepted(check)})
    def read(value: object) -> dict[str, Any]:
        found = toml_files.table(value)
        if any(letter not in ROTARY for letter in found):
            raise ValueError("expected values by rotary axis, such as { A = 4, C = 5 }")
        return {letter: check(item) for letter, item in found.items()}

    return read


def _axis_numbers(low: int, high: int) -> Any:
    return setting(_by_letter(whole(low, high)), None, meaning="numbers of the rotary axes, e.g. { A = 4, C = 5 }")


def _sign() -> Any:
    return setting(
        toml_files.choice("error", "correction"),
        "error",
        meaning='what the values are: "error", which the control subtracts, or "correction", which it adds',
    )


# SINUMERIK: sag compensation (CEC) whose base axis is the rotary axis itself.


@dataclass(frozen=True)
class CecSettings:
    """Settings ``[controllers.siemens-rotary-cec]``."""

    reversed_axes: tuple[str, ...] = letters_setting()
    axis_names: Mapping[str, str] | None = names_setting()
    first_table: int = setting(whole(0, 60), 0, meaning="number t of the first table $AN_CEC[t, ...] that is written")
    sign: str = _sign()


#: Nodes of one table at most; the 828D has 200.
_MOST_CEC = 200
_CEC_INDICES = {
    "AN_CEC": 2,
    **{
        f"AN_CEC_{name}": 1
        for name in (
            "INPUT_AXIS", "OUTPUT_AXIS", "STEP", "MIN", "MAX", "DIRECTION", "MULT_BY_TABLE", "IS_MODULO",
        )
    },
    "MA_CEC_ENABLE": 1,
    "SN_CEC_TABLE_ENABLE": 1,
}  # fmt: skip


class SiemensRotaryCec(PitchFormat):
    """``$AN_CEC``: base axis and output axis are the rotary axis; one table for each direction if a reversal is known."""

    settings_class: ClassVar[type[Any]] = CecSettings
    both_ways = True
    names = property(lambda self: self.stated("axis_names", 'state the machine axes, e.g. { A = "AX4", C = "AX5" }'))

    def check(self) -> None:
        """Names must be stated."""
        _ = self.names

    @property
    def factor(self) -> float:
        """From what is added to the command to the value of the table."""
        return -1.0 if self.settings.sign == "error" else 1.0

    def files(self, tables: Tables) -> dict[str, str]:
        """One file with all tables."""
        rows = [f";degrees; values are the {self.settings.sign}, and the control "
                f"{'subtracts' if self.settings.sign == 'error' else 'adds'} them"]  # fmt: skip
        number = self.settings.first_table
        for letter, table in tables.items():
            shown = even_table(self.turned(letter, table), _MOST_CEC)
            ways = (0,) if shown.negative_deg is None else (1, -1)
            for way, column in zip(ways, shown.columns, strict=False):
                rows += self._rows(number, letter, way, shown.angle_deg, self.factor * column + 0.0)
                number += 1
        return {"ROTARY_CEC.INI": "\n".join(["%_N_NC_CEC_INI", "CHANDATA(1)", *rows, "M17"]) + "\n"}

    def _rows(self, number: int, letter: str, way: int, at: FloatArray, values: FloatArray) -> list[str]:
        name = self.names[letter]
        ends = {
            "INPUT_AXIS": f"({name})",
            "OUTPUT_AXIS": f"({name})",
            "STEP": f"{(at[-1] - at[0]) / (len(at) - 1):.6f}",
            "MIN": f"{at[0]:.6f}",
            "MAX": f"{at[-1]:.6f}",
            "DIRECTION": str(way),
            "MULT_BY_TABLE": "0",
            "IS_MODULO": str(int(self.machine.rotary[letter].modulo_deg is not None)),
        }
        return [
            *(f"$AN_CEC[{number},{k}]={value:.6f}" for k, value in enumerate(values)),
            *(f"$AN_CEC_{key}[{number}]={value}" for key, value in ends.items()),
        ]

    def parse(self, contents: Contents) -> dict[str, AngleTable]:
        """Tables from and into one axis each; the sum of those of an axis."""
        letters = {name: letter for letter, name in self.names.items()}
        nodes: dict[int, dict[int, float]] = {}
        ends: dict[int, dict[str, Any]] = {}
        for item in read_assignments(_sources(contents), _CEC_INDICES):
            if item.variable == "AN_CEC":
                values = nodes.setdefault(item.index_number(0, 999), {})
                values[item.index_number(1, 9999)] = float(item.number())
            elif item.variable.startswith("AN_CEC_"):
                own = ends.setdefault(item.index_number(0, 999), {})
                key = item.variable[7:]
                if not key.endswith("AXIS"):
                    own[key] = float(item.number())
                    continue
                name = item.value.strip("()\"' ")
                if name not in letters:
                    raise item.fail(f"{name[:20]} is no rotary axis of this machine ({', '.join(letters)})")
                own[key] = letters[name]
        found: dict[str, list[tuple[int, AngleTable]]] = {}
        for number in sorted(nodes.keys() | ends.keys()):
            letter, way, table = self._table(number, nodes.get(number, {}), ends.get(number, {}))
            found.setdefault(letter, []).append((way, table))
        return {letter: self.turned(letter, _joined(letter, parts)) for letter, parts in found.items()}

    def _table(self, number: int, rows: Mapping[int, float], ends: Mapping[str, Any]) -> tuple[str, int, AngleTable]:
        needed = {"INPUT_AXIS", "OUTPUT_AXIS", "STEP", "MIN", "MAX", "DIRECTION", "MULT_BY_TABLE", "IS_MODULO"}
        if set(ends) != needed or sorted(rows) != list(range(len(rows))) or len(rows) < 2:
            lacking = ", ".join(sorted(needed - set(ends))) or "nodes"
            raise InputError(f"table {number} lacks {lacking}", field=f"$AN_CEC[{number}]")
        if ends["INPUT_AXIS"] != ends["OUTPUT_AXIS"] or ends["MULT_BY_TABLE"]:
            raise InputError("acts from one axis on another, or multiplies: only a rotary axis over its own angle is read",
                             field=f"$AN_CEC[{number}]")  # fmt: skip
        if ends["DIRECTION"] not in (-1.0, 0.0, 1.0) or ends["IS_MODULO"] not in (0.0, 1.0):
            raise InputError("DIRECTION must be -1, 0 or 1, IS_MODULO 0 or 1", field=f"$AN_CEC[{number}]")
        at = np.asarray(ends["MIN"] + ends["STEP"] * np.arange(len(rows)), dtype=np.float64)
        if ends["STEP"] <= 0.0 or abs(at[-1] - ends["MAX"]) > 1e-6 * len(rows):
            raise InputError(f"{len(rows)} nodes; MIN, MAX and STEP say otherwise", field=f"$AN_CEC[{number}]")
        values = self.factor * np.array([rows[k] for k in range(len(rows))])
        letter = str(ends["INPUT_AXIS"])
        return letter, int(ends["DIRECTION"]), modulo_table(letter, at, values, bool(ends["IS_MODULO"]))

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """Machine data and setting data."""
        return [
            "Documented: base axis and output axis may be the same; the base is the set point; DIRECTION 1 and -1 act in one "
            "direction of travel only; modulo tables repeat after MAX - MIN.",
            f'Inferred: the sign (sign = "{self.settings.sign}"). Check it: one table with the same value at all nodes; the axis '
            f"must move {'against' if self.settings.sign == 'error' else 'with'} it.",
            "Load with MD32710 $MA_CEC_ENABLE = 0 for the axes; then 1, and SD41300 $SN_CEC_TABLE_ENABLE[t] = 1 for each table. "
            "MD18342[t] must be at least the number of nodes (changing it formats the memory).",
            "Tables with these numbers t that are on the control are overwritten: set first_table to the first free one.",
            "MD32720 limits the sum into an axis (usually 1 degree), MD32730 its rate.",
            "MD32450 $MA_BACKLASH must be 0 for axes with DIRECTION 1 and -1. Do not use the encoder compensation for the same "
            "error.",
        ]

    def backlash(self, letter: str, reversal_deg: float) -> str:
        """MD32450 if the tables act in both directions."""
        return md32450(0, self.names[letter], reversal_deg)


def _joined(letter: str, parts: Sequence[tuple[int, AngleTable]]) -> AngleTable:
    """The tables of one axis as one: those of both directions, or one for each."""
    by_way = dict(parts)
    if len(by_way) < len(parts) or (0 in by_way and len(by_way) > 1):
        raise InputError(f"{letter} has several tables for one direction", field="$AN_CEC_DIRECTION")
    if 0 in by_way:
        return by_way[0]
    if set(by_way) != {1, -1}:
        only = next(iter(by_way))
        return replace(by_way[only], faults=(f"{letter} has a table for DIRECTION {only} only",))
    positive, negative = by_way[1], by_way[-1]
    if len(positive.angle_deg) != len(negative.angle_deg) or positive.turn_deg != negative.turn_deg:
        raise InputError(f"the two tables of {letter} have different nodes", field="$AN_CEC_DIRECTION")
    if np.abs(positive.angle_deg - negative.angle_deg).max() > 1e-6:
        raise InputError(f"the two tables of {letter} have different nodes", field="$AN_CEC_DIRECTION")
    return replace(positive, negative_deg=negative.added_deg, faults=(*positive.faults, *negative.faults))


# FANUC: stored pitch error compensation over one revolution.


@toml_files.accepts({"type": "number", "exclusiveMinimum": 0, "maximum": 90})
def _interval(value: object) -> float:
    """A section that divides a turn and can be written with three decimals."""
    found = toml_files.positive(value)
    exact = Decimal(repr(found))
    if exact % Decimal("0.001") or 360 % exact or exact > 90:
        raise ValueError("expected an angle with at most 3 decimals that divides 360 degrees, at most 90")
    return found


@dataclass(frozen=True)
class FanucRotarySettings:
    """Settings ``[controllers.fanuc-rotary-pitch]``."""

    reversed_axes: tuple[str, ...] = letters_setting()
    axis_numbers: Mapping[str, int] | None = _axis_numbers(1, 32)
    detection_unit_deg: float = setting(
        toml_files.positive, 0.001, meaning="detection unit of the rotary axes, degrees (IS-B: 0.001)"
    )
    magnification: int = setting(
        whole(1, 100), 1, meaning="parameter 3623; one count is magnification times detection unit"
    )
    interval_deg: float | None = setting(_interval, None, meaning="length of a section, degrees; default: chosen")
    first_number: int = setting(
        whole(1, 1400), 500, meaning="first compensation point number; the axes follow each other"
    )
    last_number: int = setting(whole(1, 1535), 1023, meaning="last compensation point number of the control")
    reference_position_deg: Mapping[str, float] | None = setting(
        _by_letter(toml_files.number), None, meaning="machine angle of the reference position of each axis, default 0"
    )
    increment_limit: int = setting(whole(1, 127), 7, meaning="largest change over a section in counts")
    number_base: int = setting(whole(10000, 90000), 10000, meaning="record number of compensation point 0")
    q_word: bool = setting(
        toml_files.flag, False, meaning="write Q1 (parameter) and Q0 (pitch data), as the 30i family does"
    )

    @property
    def count_deg(self) -> float:
        """One count, degrees."""
        return self.magnification * self.detection_unit_deg


#: Sections of a turn that are tried; all can be written with three decimals.
_SECTIONS = (8, 12, 18, 24, 30, 36, 40, 45, 60, 72, 90, 120, 144, 180, 240, 360)
_POINT, _FIRST, _LAST, _MAGNIFICATION, _INTERVAL, _TURN = range(3620, 3626)


class FanucRotary(PitchFormat):
    """Parameters 3620 to 3625 and increments over one revolution from the reference position."""

    settings_class: ClassVar[type[Any]] = FanucRotarySettings
    endings = (".txt",)

    def check(self) -> None:
        """Axis numbers must be stated."""
        _ = self.numbers

    @property
    def numbers(self) -> Mapping[str, int]:
        """Controlled axis numbers by letter."""
        found: Mapping[str, int] = self.stated("axis_numbers", "state the controlled axes, e.g. { A = 4, C = 5 }")
        return found

    def files(self, tables: Tables) -> dict[str, str]:
        """One file with parameters and points between one pair of ``%``."""
        own, number, parameters, points = self.settings, self.settings.first_number, [], []
        kinds = ("Q1", "Q0") if own.q_word else ("", "")
        for letter, table in tables.items():
            counts, interval = self._counts(letter, self.turned(letter, table))
            last, axis = number + len(counts) - 1, self.numbers[letter]
            if last > own.last_number:
                raise self.machine.controller_settings(self.name).fail(
                    "first_number",
                    f"{letter} would need the points {number} to {last}; the last is {own.last_number} (last_number)",
                )
            values = (number, number, last, own.magnification, f"{interval:.3f}", "360.000")
            parameters += [f"N{_POINT + k:05d}{kinds[0]}A{axis}P{value}" for k, value in enumerate(values)]
            steps = np.diff(counts)
            stored = [int(steps[-1]), *(int(step) for step in steps)]  # the first is the last: it is the same section
            points += [f"N{own.number_base + number + k}{kinds[1]}P{value}" for k, value in enumerate(stored)]
            number = last + 1
        return {"ROTARYPITCH.TXT": "\n".join(["%", *parameters, *points, "%"]) + "\n"}

    def _zero(self, letter: str) -> float:
        """Angle of the reference position in the sense of the control."""
        return float((self.settings.reference_position_deg or {}).get(letter, 0.0)) * self.sense(letter)

    def _counts(self, letter: str, table: AngleTable) -> tuple[FloatArray, float]:
        """Whole counts at the ends of the sections of a turn from the reference position, and the length of a section."""
        own = self.settings
        turn = self.machine.rotary[letter].modulo_deg
        if turn not in (None, 360.0):
            raise InputError(f"is {turn:g}; a table of FANUC covers 360 degrees", field=f"axes.{letter}.modulo_deg")
        if turn is None and np.ptp(self.machine.rotary[letter].ends_deg) > 360.0 + 1e-9:
            raise InputError("is more than a turn; a table of FANUC covers one", field=f"axes.{letter}.range_deg")
        zero = self._zero(letter)
        best: tuple[float, FloatArray, float] | None = None
        steepest = 0
        for sections in _SECTIONS if own.interval_deg is None else (round(360.0 / own.interval_deg),):
            at = zero + 360.0 / sections * np.arange(sections + 1)
            wanted = np.interp(at, *_closed(table), period=360.0)
            counts = np.round((wanted - wanted[0]) / own.count_deg)
            counts[-1] = counts[0]
            steepest = int(np.abs(np.diff(counts)).max())
            if steepest > own.increment_limit:
                continue
            fine = zero + np.linspace(0.0, 360.0, 1441)
            left = (
                np.interp(fine, *_closed(table), period=360.0) - wanted[0] - np.interp(fine, at, counts * own.count_deg)
            )
            worst = float(np.abs(left).max())
            if best is None or worst < best[0] - 1e-9:
                best = worst, counts, 360.0 / sections
            if worst <= own.count_deg:
                break
        if best is None:
            raise self.machine.controller_settings(self.name).fail(
                "magnification",
                f"{letter} changes by {steepest} counts of {own.count_deg:g} degrees over a section; at most "
                f"{own.increment_limit} are possible (increment_limit): set a larger magnification",
            )
        return best[1], best[2]

    def parse(self, contents: Contents) -> dict[str, AngleTable]:
        """What the control adds at the ends of its sections: sums of increments from the reference position."""
        parameters: dict[tuple[int, int], tuple[str, Record]] = {}
        points: dict[int, tuple[str, Record]] = {}
        for source in _sources(contents):
            for record in read_records(source):
                kind, words = type_word(record, record.words())
                if record.number >= self.settings.number_base and kind != 1:
                    if len(words) != 1 or words[0][0] != "P":
                        raise record.fail("expected one value word P, e.g. P-2")
                    _once(points, record.number - self.settings.number_base, words[0][1], record)
                elif _POINT <= record.number <= _TURN:
                    for axis, text in axis_values(record, words):
                        _once(parameters, (record.number, axis), text, record)
        found = {
            letter: self.turned(letter, self._table(letter, axis, parameters, points))
            for letter, axis in self.numbers.items()
            if (_POINT, axis) in parameters
        }
        if not found:
            raise InputError(
                "contains no parameters 3620 to 3625 of these axes; punch them as well", file=next(iter(contents))
            )
        return found

    def _table(self, letter: str, axis: int, parameters: Mapping[Any, Any], points: Mapping[int, Any]) -> AngleTable:
        numbers = []
        for parameter in (_POINT, _FIRST, _LAST, _MAGNIFICATION):
            text, record = self._parameter(parameters, parameter, letter, axis)
            numbers.append(record.whole(text, 0, 9999))
        reference, first, last, magnification = numbers
        interval, turn = (Decimal(self._parameter(parameters, key, letter, axis)[0]) for key in (_INTERVAL, _TURN))
        record = parameters[_POINT, axis][1]
        if first != reference or (last - first) * interval != turn or turn <= 0:
            raise record.fail(
                f"{letter} (A{axis}): points {first} to {last} from {reference} with sections of {interval} degrees are not "
                f"one revolution of {turn} degrees from the reference position; other numberings are not documented"
            )
        values = []
        for number in range(first, last + 1):
            if number not in points:
                raise record.fail(f"{letter} (A{axis}): point {number} is missing")
            text, place = points[number]
            values.append(place.whole(text, -32768, 32767))
        position = [0]
        for value in values[1:]:
            position.append(position[-1] + value)
        faults = []
        if position[-1]:
            faults.append(
                f"{letter}: the values sum to {position[-1]} counts over a turn; every turn adds to the error"
            )
        if values[0] != values[-1]:
            faults.append(f"{letter}: the values of point {first} and {last} differ; they are the same section")
        most = max(map(abs, values))
        if most > self.settings.increment_limit:
            faults.append(f"{letter}: a change of {most} counts; at most {self.settings.increment_limit} are possible")
        if not magnification:
            faults.append(f"{letter}: the magnification 3623 is 0: the table is off")
        zero = self._zero(letter)
        at = zero + float(interval) * np.arange(len(position))
        added = magnification * self.settings.detection_unit_deg * np.array(position, dtype=np.float64)
        return AngleTable(np.asarray(at, dtype=np.float64), added, turn_deg=float(turn), faults=tuple(faults))

    def _parameter(self, parameters: Mapping[Any, Any], number: int, letter: str, axis: int) -> tuple[str, Record]:
        if (number, axis) not in parameters:
            raise InputError(f"parameter {number} is missing for {letter} (axis A{axis})", field=f"N{number:05d}")
        found: tuple[str, Record] = parameters[number, axis]
        return found

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """Parameters, and what no document settles."""
        unit = self.settings.detection_unit_deg
        return [
            "Documented (parameter manual of the 0i-PB, p. 100): a rotary axis has its points over one revolution from the "
            "reference position; their values sum to zero; the first equals the last.",
            "From shop practice, in no manual seen: the values are the correction, which the control adds.",
            "Records (%, N, A, P) as in the manual of the 15i; record number of point 0 and the words Q of other models: compare "
            "with a file punched from the control.",
            f"One count is {self.settings.count_deg:g} degrees ({self.settings.count_deg * 3600.0:.2f} arcsec): check the "
            f"detection unit of the axes, {unit:g} degrees, and that no other axis has these point numbers "
            "([controllers.fanuc-pitch] reserved_numbers).",
            "The table is zero at the reference position: a constant error of the angle belongs into that position.",
            "A section is taken as interpolated; the plain type outputs the change somewhere within it.",
            "Angles count from the reference position: state reference_position_deg if it is not at machine angle 0.",
            "3605#0 must be 0 (one table for both directions). Power off and on, then return to the reference position.",
        ]

    def backlash(self, letter: str, reversal_deg: float) -> str:
        """Parameter 1851, positive where the axis stops short."""
        value = round(-reversal_deg / self.settings.detection_unit_deg)
        return f"parameter 1851 of A{self.numbers[letter]} = {value} detection units, plus what it was during the measurement"


def _closed(table: AngleTable) -> tuple[FloatArray, FloatArray]:
    """Nodes within one turn; between the ends of an axis that turns less, ``np.interp`` with a period closes it linearly."""
    within = table.angle_deg < table.angle_deg[0] + 360.0 - 1e-9
    return table.angle_deg[within], table.added_deg[within]


def _once(found: dict[Any, tuple[str, Record]], key: Any, text: str, record: Record) -> None:
    if key in found:
        raise record.fail(f"is given a second time; the first is in line {found[key][1].line}")
    found[key] = text, record


# HEIDENHAIN: .COM of the rotary axis into itself.


@dataclass(frozen=True)
class HeidenhainRotarySettings:
    """Settings ``[controllers.heidenhain-rotary-com]``."""

    reversed_axes: tuple[str, ...] = letters_setting()
    axis_names: Mapping[str, str] | None = names_setting()
    sign: str = _sign()
    decimals: int = setting(whole(4, 6), 4, meaning="decimals of the entries in degrees")
    negative_as_turn: bool = setting(
        toml_files.flag,
        False,
        meaning="whether the control reads the table at 350 degrees where the axis is at -10; no document says so",
    )


#: Entries of one .COM file (module 9095, error 3).
_MOST_COM = 256


class HeidenhainRotary(PitchFormat):
    """``AXIS_C.COM`` with the columns AXISPOS and C: entries from 0 to 360 degrees."""

    settings_class: ClassVar[type[Any]] = HeidenhainRotarySettings
    endings = (".com",)

    def name_of(self, letter: str) -> str:
        """Column of an axis."""
        return str((self.settings.axis_names or {}).get(letter, letter))

    @property
    def factor(self) -> float:
        """From what is added to the command to the entry."""
        return -1.0 if self.settings.sign == "error" else 1.0

    def files(self, tables: Tables) -> dict[str, str]:
        """One file for each axis."""
        return {f"AXIS_{letter}.COM": self._text(letter, table) for letter, table in tables.items()}

    def _text(self, letter: str, table: AngleTable) -> str:
        shown, axis, name = self.turned(letter, table), self.machine.rotary[letter], self.name_of(letter)
        low, high = sorted(self.sense(letter) * end for end in axis.ends_deg)
        if axis.modulo_deg not in (None, 360.0) or (axis.modulo_deg is None and high - low > 360.0 + 1e-9):
            raise InputError("turns by another angle than 360 degrees; the control uses entries from 0 to 360 only",
                             field=f"axes.{letter}")  # fmt: skip
        if axis.modulo_deg is None and (low < -1e-9 or high > 360.0 + 1e-9) and not self.settings.negative_as_turn:
            raise self.machine.controller_settings(self.name).fail(
                "negative_as_turn",
                f"{letter} travels from {low:g} to {high:g} degrees on the control, which uses entries from 0 to 360 only; no "
                "document says that it reads them at 350 where the axis is at -10. Set negative_as_turn = true if yours does",
            )
        nodes, _ = _closed(shown)
        whole_turn = axis.modulo_deg is not None or self.settings.negative_as_turn
        at = np.unique(
            np.round(np.append(np.mod(nodes, 360.0) if whole_turn else nodes, (0.0, 360.0)), self.settings.decimals)
        )
        values = self.factor * np.interp(at, *_closed(shown), period=360.0 if whole_turn else None) + 0.0
        if len(at) > _MOST_COM:
            raise InputError(
                f"{letter} has {len(at)} nodes; a .COM file has at most {_MOST_COM} entries", field=f"axes.{letter}"
            )
        layout = default_layout(f"AXIS_{letter}", "COM", [("NR", 5), ("AXISPOS", 13), ("BACKLASH", 11), (name, 12)])
        places = self.settings.decimals
        rows = [
            f"{k:<5d}{where:<13.{places}f}{0.0:<11.4f}{value:.{places}f}"
            for k, (where, value) in enumerate(zip(at, values, strict=True))
        ]
        return "\n".join([*layout.before, *rows, *layout.after]).rstrip("\n") + "\n"

    def parse(self, contents: Contents) -> dict[str, AngleTable]:
        """Entries of each file; its name says over which axis it is."""
        found: dict[str, AngleTable] = {}
        for source in _sources(contents):
            match = re.fullmatch(r"(?:NOT-ACCEPTED-)?AXIS_([ABC])\.COM", source.path.name.upper())
            letter = match[1] if match else ""
            if letter not in self.machine.rotary or letter in found:
                raise source.fail("the name does not say which axis it belongs to; expected AXIS_C.COM")
            found[letter] = self.turned(letter, self._table(letter, source))
        return found

    def _table(self, letter: str, source: SourceFile) -> AngleTable:
        table, name = read_table(source), self.name_of(letter)
        columns = {column.name for column in table.columns}
        if not {"AXISPOS", name} <= columns:
            raise source.fail(f"needs the columns AXISPOS and {name}", table.header_line)
        rows: list[tuple[float, float]] = []
        for row in table.rows:
            for other in columns - {"NR", "AXISPOS", name}:
                if row.cells.get(other) and table.number(row, other):
                    raise source.fail(f"column {other} is not zero: only {name} over its own angle is read", row.line)
            where, value = float(table.number(row, "AXISPOS")), float(table.number(row, name))
            if not 0.0 <= where <= 360.0:
                raise source.fail(
                    f"AXISPOS is {where:g}; the control uses entries from 0 to 360 degrees only", row.line
                )
            if rows and where <= rows[-1][0]:
                raise source.fail(f"AXISPOS {where:g} is not above {rows[-1][0]:g} before it", row.line)
            rows.append((where, value))
        if len(rows) < 2:
            raise source.fail("has fewer than two entries")
        at, values = np.array(rows).T
        axis = self.machine.rotary[letter]
        whole_turn = axis.modulo_deg is not None or self.settings.negative_as_turn
        faults = []
        if whole_turn and (at[0] > 1e-9 or at[-1] < 360.0 - 1e-9 or abs(values[-1] - values[0]) > 1e-9):
            faults.append(
                f"{letter}: the entries do not close: they must reach from 0 to 360 degrees with the same value"
            )
        if len(at) > _MOST_COM:
            faults.append(f"{letter}: {len(at)} entries; at most {_MOST_COM} are possible")
        closed = whole_turn and not faults
        return AngleTable(at, self.factor * values, turn_deg=360.0 if closed else None, faults=tuple(faults))

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """How the table is named, and what no document settles."""
        return [
            "Documented: the column of an axis in a .COM file that is named in the column of the same axis of the active line of "
            "the .CMA file corrects it over its own position; of a rotary axis entries from 0 to 360 are used.",
            *(
                f"Write AXIS_{letter}.COM into column {self.name_of(letter)} of the active line (ACTIVE = *) of your "
                ".CMA file; no .CMA is written, since it also names the tables of the linear axes."
                for letter in letters
            ),
            f'Probable, in no manual seen as a sentence: the sign ("{self.settings.sign}"). Inferred: entries in degrees, linear '
            "between them. Check both with one table of the same value everywhere.",
            "Column widths are not documented: compare with an empty table saved on the control.",
        ]

    def backlash(self, letter: str, reversal_deg: float) -> str:
        """The parameter, whose sign no document states."""
        return (
            f"MP_backLash (older controls: MP710, MP750) of {self.name_of(letter)}: {abs(reversal_deg):.4f} degrees in size; the "
            f"angle reached in positive travel minus that in negative travel is {reversal_deg:+.4f}; which sign corrects it is "
            "not documented"
        )


# TwinCAT and the ISG kernel: leadscrew list of a rotary axis, in 0.0001 degrees.


@dataclass(frozen=True)
class NumberedSettings:
    """Settings of controls that name axes by number."""

    reversed_axes: tuple[str, ...] = letters_setting()
    axis_numbers: Mapping[str, int] | None = _axis_numbers(1, 65535)


#: Points of one list (before V3.1.3079.06), and degrees in one unit of the file.
_MOST_SSFK, _SSFK_DEG = 1500, 1e-4
_SSFK = re.compile(r"kw\.ssfk\.table\[(\d{1,5})\]\.(setpoint|pos|neg)")


class TwincatRotary(PitchFormat):
    """``kw.ssfk``: stored is actual minus nominal, which the control subtracts; a table for each direction."""

    settings_class: ClassVar[type[Any]] = NumberedSettings
    both_ways = True
    endings = (".lis",)

    def check(self) -> None:
        """Axis numbers must be stated."""
        self.stated("axis_numbers", "state the logical axes, e.g. { A = 4, C = 5 }")

    def files(self, tables: Tables) -> dict[str, str]:
        """One list for each axis."""
        return {f"rotary-{letter.lower()}.lis": self._text(letter, table) for letter, table in tables.items()}

    def _text(self, letter: str, table: AngleTable) -> str:
        shown, turn = self.turned(letter, table), self.machine.rotary[letter].modulo_deg
        if turn is not None:
            shown = with_turns(shown, turn, _MOST_SSFK)
        if len(shown.angle_deg) > _MOST_SSFK:
            raise InputError(
                f"{letter} has {len(shown.angle_deg)} nodes; at most {_MOST_SSFK} are possible", field=f"axes.{letter}"
            )
        columns = {"setpoint": shown.angle_deg, "pos": -shown.added_deg}
        if shown.negative_deg is not None:
            columns["neg"] = -shown.negative_deg
        head = {
            "kopf.achs_nr": self.settings.axis_numbers[letter],
            "kopf.log_achs_name": letter,
            "kw.ssfk.unit": 1,
            "kw.ssfk.interval": 0,
            "kw.ssfk.kw_nr_max": len(shown.angle_deg),
            "kw.ssfk.bilateral": int("neg" in columns),
            "kw.ssfk.modulo": 0,
        }
        rows = [
            f"kw.ssfk.table[{k}].{key} {values[k] / _SSFK_DEG + 0.0:.2f}"
            for k in range(len(shown.angle_deg))
            for key, values in columns.items()
        ]
        notes = [
            "# positions and values in 0.0001 degrees (unit 1); value = actual - nominal, which the control subtracts"
        ]
        return "\n".join([*notes, *(f"{key} {value}" for key, value in head.items()), *rows]) + "\n"

    def parse(self, contents: Contents) -> dict[str, AngleTable]:
        """Lists by their axis number."""
        letters = {number: letter for letter, number in (self.settings.axis_numbers or {}).items()}
        found: dict[str, AngleTable] = {}
        for source in _sources(contents):
            entries, table = self._entries(source)
            number = entries.get("kopf.achs_nr", -1.0)
            if number not in letters or letters[number] in found:
                raise source.fail(
                    f"kopf.achs_nr is {number:g}; expected each of {', '.join(map(str, letters))} at most once"
                )
            found[letters[number]] = self.turned(letters[number], self._table(source, entries, table))
        return found

    def _entries(self, source: SourceFile) -> tuple[dict[str, float], dict[str, dict[int, float]]]:
        known = ("achs_nr", "unit", "interval", "kw_startpos", "kw_nr_max", "bilateral", "modulo")
        entries: dict[str, float] = {}
        table: dict[str, dict[int, float]] = {}
        for line, text in content_lines(source, "#"):
            words = text.partition("/*")[0].split()
            if words and words[0] == "kopf.log_achs_name":
                continue
            match = _SSFK.fullmatch(words[0]) if words else None
            if len(words) != 2 or (match is None and words[0].rpartition(".")[2] not in known):
                raise source.fail(f"{text[:50]!r} is not an entry of a leadscrew list", line)
            value = float(fixed_point(source, line, words[1], words[0]))
            own, key = (entries, words[0]) if match is None else (table.setdefault(match[2], {}), int(match[1]))
            if key in own:
                raise source.fail(f"{words[0]} is given a second time", line)
            own[key] = value  # type: ignore[index]
        return entries, table

    def _table(
        self, source: SourceFile, entries: Mapping[str, float], table: Mapping[str, Mapping[int, float]]
    ) -> AngleTable:
        def number(name: str, default: float | None = None) -> float:
            found = entries.get(f"kw.ssfk.{name}", default)
            if found is None:
                raise source.fail(f"kw.ssfk.{name} is missing; is the file truncated?")
            return found

        if number("modulo", 0.0):
            raise source.fail(
                "kw.ssfk.modulo is 1: no document says which node closes the turn; use 0 and a turn before and after"
            )
        if number("unit") != 1.0:
            raise source.fail("kw.ssfk.unit must be 1 (0.0001 degrees); increments of an encoder are not known here")
        count = int(number("kw_nr_max"))
        if not 2 <= count <= 100_000 or count != number("kw_nr_max"):
            raise source.fail(f"kw.ssfk.kw_nr_max is {number('kw_nr_max'):g}; expected a whole number of at least 2")

        def column(name: str) -> FloatArray:
            own = table.get(name, {})
            if sorted(own) != list(range(count)):
                raise source.fail(f"kw.ssfk.table[].{name} has {len(own)} entries; kw_nr_max is {count}")
            return np.array([own[k] for k in range(count)]) * _SSFK_DEG

        interval = number("interval")
        even = number("kw_startpos", 0.0) + interval * np.arange(count)
        at = np.asarray(_SSFK_DEG * even if interval else column("setpoint"), dtype=np.float64)
        if (np.diff(at) <= 0.0).any():
            raise source.fail("the positions of kw.ssfk must ascend")
        return AngleTable(at, -column("pos"), -column("neg") if number("bilateral", 0.0) else None)

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """Switches, and what no document settles."""
        return [
            "Documented: unit 1 is 0.0001 degrees for rotary axes; stored is actual minus nominal; linear between points, end "
            "values outside; pos and neg act in positive and negative travel.",
            "Check the sign at one position: the example of the manual has a misprint in a position.",
            "kw.ssfk.modulo is 0, since no document says which node closes the turn: an endless axis has a turn before and "
            "after.",
            "Set lr_param.ssfk = 1 in the axis parameters. With bilateral = 1 the table contains the reversal: the backlash "
            "compensation of the axis must be off.",
        ]


# Aerotech: one-dimensional axis calibration in primary units.


#: Values of one table, and degrees of the last decimal.
_MOST_AEROTECH = 1000


class AerotechRotary(PitchFormat):
    """``:START`` tables of a rotary axis: corrections in degrees, evenly spaced, six a line."""

    settings_class: ClassVar[type[Any]] = NumberedSettings
    endings = (".cal",)

    def check(self) -> None:
        """Axis numbers must be stated."""
        self.stated("axis_numbers", "state the axes, numbered from 1, e.g. { A = 4, C = 5 }")

    def files(self, tables: Tables) -> dict[str, str]:
        """One file with all tables."""
        rows = [f"' {self.machine.name}: corrections of rotary axes, degrees".encode("ascii", "replace").decode()]
        for letter, table in tables.items():
            shown, turn = self.turned(letter, table), self.machine.rotary[letter].modulo_deg
            shown = even_table(shown, _MOST_AEROTECH // 3)
            if turn is not None:
                shown = with_turns(shown, turn, _MOST_AEROTECH)
            values = [f"{value + 0.0:.7f}" for value in shown.added_deg]
            step = (shown.angle_deg[-1] - shown.angle_deg[0]) / (len(values) - 1)
            rows += [
                f":START {self.settings.axis_numbers[letter]} SAMPLEDIST={step:.6f} POSUNIT=PRIMARY CORUNIT=PRIMARY",
                f":START OFFSET={-shown.angle_deg[0] + 0.0:.6f}",
                *(" ".join(values[k : k + 6]) for k in range(0, len(values), 6)),
                ":END",
            ]
        return {"rotary.cal": "\n".join(rows) + "\n"}

    def parse(self, contents: Contents) -> dict[str, AngleTable]:
        """Tables by axis number."""
        letters = {number: letter for letter, number in (self.settings.axis_numbers or {}).items()}
        found: dict[str, AngleTable] = {}
        for source in _sources(contents):
            for line, keys, values in _calibrations(source):
                number = int(keys.get("AXIS", -1.0))
                if number not in letters or letters[number] in found:
                    raise source.fail(
                        f"axis {number}: expected each of {', '.join(map(str, letters))} at most once", line
                    )
                if not {"SAMPLEDIST", "OFFSET"} <= keys.keys() or keys["SAMPLEDIST"] <= 0.0 or len(values) < 2:
                    raise source.fail("the table needs SAMPLEDIST above zero, OFFSET and two values", line)
                at = np.asarray(keys["SAMPLEDIST"] * np.arange(len(values)) - keys["OFFSET"], dtype=np.float64)
                added = keys.get("CORUNIT", 1.0) * np.array(values)
                found[letters[number]] = self.turned(letters[number], AngleTable(at, added))
        return found

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """What is documented, and what is not."""
        return [
            "Documented: linear between points, end values outside, the same in both directions, tables follow the encoder.",
            "Not documented: the header, the sign (the values are corrections, minus the measured error, as public writers of "
            "such files have it), primary units of a rotary axis as degrees, and whether an endless axis rolls over: it has a "
            "turn before and after, which serves both.",
            "HOMEDIRECTION and HOMEOFFSET are not written: angles are assumed to count from machine zero.",
        ]


def _calibrations(source: SourceFile) -> Iterator[tuple[int, dict[str, float], list[float]]]:
    """The tables of a file: line of their end, keys of their heads, values."""
    keys: dict[str, float] = {}
    values: list[float] = []
    open_since = 0
    for line, text in content_lines(source, "'"):
        words = text.upper().split()
        if words[0] == ":START" and not values:
            open_since = line
            for word in words[1:]:
                key, _, number = word.partition("=")
                if not number and key.isdigit() and len(key) < 4:
                    key, value = "AXIS", float(key)
                elif key in ("POSUNIT", "CORUNIT") and number in ("PRIMARY", "PRIMARY/1000"):
                    value = 1e-3 if number.endswith("/1000") else 1.0
                    if key == "POSUNIT" and value != 1.0:
                        raise source.fail("POSUNIT must be PRIMARY", line)
                elif key in ("SAMPLEDIST", "OFFSET"):
                    value = float(fixed_point(source, line, number, key))
                else:
                    raise source.fail(f"{word[:40]!r} is not understood; it may change the table", line)
                if key in keys:
                    raise source.fail(f"{key} is given a second time", line)
                keys[key] = value
        elif words == [":END"] and open_since:
            yield line, keys, values
            keys, values, open_since = {}, [], 0
        elif open_since and words[0] != ":START":
            values += [float(fixed_point(source, line, word, "a correction value")) for word in words]
        else:
            raise source.fail(f"expected :START or values, got {text[:40]!r}", line)
    if open_since:
        raise source.fail("the table that begins here has no :END; is the file truncated?", open_since)
