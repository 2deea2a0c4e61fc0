"""Positioning of rotary axes over their own angle: tables of LinuxCNC (COMP_FILE) and SINUMERIK (encoder compensation), degrees.

Errors are actual minus commanded angle, positive as in ISO 841. A control may call the opposite sense of an axis positive:
then angles and values of its table have the opposite sign.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from compgen.controls.linuxcnc_comp import parse_comp
from compgen.controls.shared.base import SourceFile
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
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


@dataclass(frozen=True)
class PitchSettings:
    """Settings of tables of rotary axes."""

    reversed_axes: tuple[str, ...] = setting(
        _letters, (), meaning="axes whose positive sense on the control is opposite to ISO 841 and the machine file"
    )
    axis_names: dict[str, str] | None = setting(
        _names, None, meaning='names of the machine axes of a SINUMERIK, e.g. { A = "AX4", C = "AX5" }'
    )
    encoder: int = setting(toml_files.whole(0, 1), 0, meaning="encoder of a SINUMERIK axis that the table belongs to")


@dataclass(frozen=True)
class AngleTable:
    """Nodes ascending and what the control adds to the command there, degrees, in the sense of the machine file, (n,)."""

    angle_deg: FloatArray
    added_deg: FloatArray

    def at(self, angle_deg: FloatArray, axis: RotaryAxis) -> FloatArray:
        """What is added at commanded angles: linear between nodes, constant outside; an endless axis repeats."""
        return np.interp(angle_deg, self.angle_deg, self.added_deg, period=axis.modulo_deg)


Tables = Mapping[str, AngleTable]


@dataclass(frozen=True)
class PitchFormat:
    """The tables of one control as text, and back."""

    name: str
    title: str
    machine: Machine
    settings: PitchSettings

    def sense(self, letter: str) -> float:
        """Sign from the machine file to the control."""
        return -1.0 if letter in self.settings.reversed_axes else 1.0

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
        return AngleTable(-table.angle_deg[::-1], -table.added_deg[::-1])

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """What has to be done with the files of these axes, and what is known of their signs."""
        raise NotImplementedError


class LinuxcncRotary(PitchFormat):
    """COMP_FILE of LinuxCNC, type 1, one for each rotary joint."""

    def files(self, tables: Tables) -> dict[str, str]:
        """One file for each axis; an endless axis gets a turn before and after, since its joint goes on counting."""
        return {f"rotary-{letter.lower()}.comp": self._text(letter, table) for letter, table in tables.items()}

    def _text(self, letter: str, table: AngleTable) -> str:
        shown, turn = self.turned(letter, table), self.machine.rotary[letter].modulo_deg
        angle, added = shown.angle_deg, shown.added_deg
        if turn is not None:
            if abs(angle[-1] - angle[0] - turn) < 1e-9:
                angle, added = angle[:-1], added[:-1]
            turns = (-1.0, 0.0, 1.0) if 3 * len(angle) < _MOST_ROWS else (0.0,)
            angle = np.concatenate([angle + k * turn for k in turns] + [angle[:1] + (turns[-1] + 1.0) * turn])
            added = np.concatenate([added] * len(turns) + [added[:1]])
        if len(angle) > _MOST_ROWS:
            raise InputError(
                f"{letter} has {len(angle)} nodes; LinuxCNC reads at most {_MOST_ROWS}", field=f"axes.{letter}"
            )
        return "".join(f"{at:.9f} {value:.9f} {value:.9f}\n" for at, value in zip(angle, added + 0.0, strict=True))

    def parse(self, contents: Mapping[Path, str]) -> dict[str, AngleTable]:
        """Rows as LinuxCNC reads them; the letter is in the name of the file."""
        found: dict[str, AngleTable] = {}
        for path, text in contents.items():
            match = re.search(r"-([abc])\.comp$", path.name)
            letter = match[1].upper() if match else ""
            if letter not in self.machine.rotary or letter in found:
                raise InputError("the name does not say which axis it belongs to; expected rotary-c.comp", file=path)
            rows = parse_comp(SourceFile(path, text), 1)
            found[letter] = self.turned(letter, AngleTable(rows.nominal, rows.forward))
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
            "A reversal of the axis belongs into BACKLASH of its joint, or into both columns.",
            "A joint that turns on beyond the table keeps its last value: home it again, or unwind it.",
        ]


_EEC = re.compile(r"\$AA_ENC_COMP(?P<key>_STEP|_MIN|_MAX|_IS_MODULO|)\[(?P<index>[^\]]+)\]\s*=\s*(?P<value>\S+)")


class SiemensRotary(PitchFormat):
    """``$AA_ENC_COMP`` of SINUMERIK for rotary axes: measured errors, degrees."""

    @property
    def names(self) -> dict[str, str]:
        """Names of the machine axes; they must be stated."""
        stated = self.settings.axis_names or {}
        missing = [letter for letter in self.machine.rotary if letter not in stated]
        if missing:
            raise self.machine.controller_settings(self.name).fail(
                "axis_names",
                f'is missing for {", ".join(missing)}: state the machine axes, e.g. {{ A = "AX4", C = "AX5" }}',
            )
        return stated

    def files(self, tables: Tables) -> dict[str, str]:
        """One file with all axes; the nodes are equidistant."""
        rows = [";degrees; value = measured error (actual - nominal); the control adds it to the actual position"]
        for letter, table in tables.items():
            shown, place = self.turned(letter, table), f"{self.settings.encoder},{{}}{self.names[letter]}"
            turn = self.machine.rotary[letter].modulo_deg
            grid = np.linspace(shown.angle_deg[0], shown.angle_deg[-1], len(shown.angle_deg))
            values = -np.interp(grid, shown.angle_deg, shown.added_deg) + 0.0
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
                key = int(parts[1]) if wanted == 3 else match["key"]
                if key in own:
                    raise InputError(f"{plain[:60]!r} is given a second time", file=path, line=number)
                own[key] = _angle(match["value"], path, number)  # type: ignore[index]
        return {letters[name]: self._table(letters[name], rows, ends.get(name, {})) for name, rows in values.items()}

    def _table(self, letter: str, rows: Mapping[int, float], ends: Mapping[str, float]) -> AngleTable:
        if set(ends) != {"_STEP", "_MIN", "_MAX", "_IS_MODULO"} or sorted(rows) != list(range(len(rows))):
            raise InputError(f"the table of {letter} lacks nodes, or STEP, MIN, MAX, IS_MODULO", field=letter)
        angle = np.asarray(ends["_MIN"] + ends["_STEP"] * np.arange(len(rows)), dtype=np.float64)
        if abs(angle[-1] - ends["_MAX"]) > 1e-4 * len(rows):
            raise InputError(
                f"the table of {letter} has {len(rows)} nodes; MIN, MAX and STEP say otherwise", field=letter
            )
        return self.turned(letter, AngleTable(angle, -np.array([rows[k] for k in range(len(rows))])))

    def instructions(self, letters: Iterable[str]) -> list[str]:
        """Machine data."""
        return [
            "Documented: the value is the measured error; the control adds it to the actual position: the axis moves against it.",
            "Inferred: as for linear axes, in degrees; no manual that was found has a worked number for a rotary axis.",
            "Load with MD32700 $MA_ENC_COMP_ENABLE = 0 only; MD38000 must be at least the number of nodes.",
        ]


def _angle(text: str, path: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not abs(value) < 1e5:
        raise InputError(f"{text[:40]!r} is no angle", file=path, line=line)
    return value


_FORMATS = {
    "linuxcnc-rotary-comp": (LinuxcncRotary, "LinuxCNC, COMP_FILE of rotary joints"),
    "siemens-rotary-eec": (SiemensRotary, "SINUMERIK, encoder error compensation of rotary axes"),
}


def format_of(machine: Machine, name: str) -> PitchFormat:
    """The format of a control for a machine with rotary axes."""
    if not machine.rotary:
        raise InputError(
            f"{name} is for rotary axes; the machine {machine.name} has none", file=machine.source, field="chain"
        )
    kind, title = _FORMATS[name]
    settings = toml_files.read_settings(PitchSettings, machine.controller_settings(name))
    unknown = [letter for letter in settings.reversed_axes if letter not in machine.rotary]
    if unknown:
        raise machine.controller_settings(name).fail("reversed_axes", f"the machine has no axis {', '.join(unknown)}")
    if name == "linuxcnc-rotary-comp":
        settings = _as_kinematics(machine, settings)
    found = kind(name, title, machine, settings)
    if isinstance(found, SiemensRotary):
        _ = found.names
    return found


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
}
