"""What controls take of a model of heat: a component with its table, a program of the control, or one coefficient.

Every output is text that is read back and emulated: :meth:`HeatOutput.parse` gives an object whose ``added`` says what the
control adds to the commands of X, Y and Z over a file of temperatures, mm. It counts from the first reading, as the model does.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from compgen.controls.heat_cards import ABOUT
from compgen.controls.linuxcnc_comp import units_setting, with_units
from compgen.controls.linuxcnc_volumetric import checksum
from compgen.controls.shared.base import SourceFile
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.machine import MM_PER_UNIT, Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import setting
from compgen.errors import InputError
from compgen.heat import HeatModel, Temperatures
from compgen.heat.model import Range, Term, lagged
from compgen.resources import data_folder

#: Direction of the model along each axis.
ALONG = {"X": "dx", "Y": "dy", "Z": "dz"}
#: Offsets move this fast unless the machine file says otherwise, um/s: heat itself is a hundred times slower.
RATE_UM_S = 1.0
#: A word of a file: a name of a sensor without blanks.
_WORD = re.compile(r"[A-Za-z][\w.-]{0,30}")


class Emulated(Protocol):
    """What was read back from the files of an output."""

    def added(self, temperatures: Temperatures) -> FloatArray:
        """What the control adds to the commands of X, Y, Z at each reading, mm, (n, 3)."""
        ...


@dataclass(frozen=True)
class HeatOutput(ABC):
    """The output of one control for one machine."""

    machine: Machine
    settings: Any
    name: ClassVar[str]
    settings_class: ClassVar[type[Any]]
    #: Whether it falls silent outside of what was trained.
    fades: ClassVar[bool] = True

    @abstractmethod
    def files(self, model: HeatModel) -> dict[str, str]:
        """Text of each file by name.

        Raises
        ------
        InputError
            for a model that the control cannot express.
        """

    @abstractmethod
    def parse(self, sources: Sequence[SourceFile]) -> Emulated:
        """Read the files back, strictly."""

    @abstractmethod
    def stated(self) -> tuple[tuple[str, str], ...]:
        """What is said of signs and meaning: "documented", "inferred" or "unknown", and the statement."""

    @abstractmethod
    def before_use(self, model: HeatModel) -> tuple[str, ...]:
        """What to do at the control, in order."""

    def expressed(self, model: HeatModel) -> tuple[str, ...]:
        """Axes that the output moves."""
        return tuple(axis for axis, name in ALONG.items() if name in model.directions)

    def belongs(self, name: str) -> bool:
        """Whether a file in the folder of an export is one of those that are read back."""
        return name in self.read_files

    read_files: ClassVar[tuple[str, ...]] = ()


def rate_setting() -> Any:
    """Declare ``rate_um_s``."""
    return setting(toml_files.positive, RATE_UM_S, meaning="fastest change of the offset, um/s")


def limited(time_s: FloatArray, target_mm: FloatArray, rate_mm_s: float) -> FloatArray:
    """Follow targets (n, 3) from 0 at a limited rate: what is added at each time, mm."""
    found = np.zeros_like(target_mm)
    for k, step in enumerate(np.diff(time_s, prepend=time_s[0])):
        before = found[k - 1] if k else np.zeros(target_mm.shape[1])
        found[k] = before + np.clip(target_mm[k] - before, -rate_mm_s * step, rate_mm_s * step)
    return found


def needed(temperatures: Temperatures, sensors: Sequence[str]) -> None:
    """Refuse a file that lacks a sensor of the output."""
    missing = [name for name in sensors if name not in temperatures.celsius]
    if missing:
        raise InputError(f"the temperatures have no column temp_{missing[0]}_c, which the output reads")


# LinuxCNC: the component volheat and its table.


@dataclass(frozen=True)
class LinuxcncHeatSettings:
    """Settings of ``linuxcnc-heat``."""

    machine_units: str = units_setting("[TRAJ] LINEAR_UNITS of the machine")
    rate_um_s: float = rate_setting()
    jump_k: float = setting(toml_files.positive, 1.5, meaning="a reading is a jump if it changes by more at once, K")
    stuck_s: float = setting(
        toml_files.not_negative,
        1800.0,
        meaning="a sensor is stuck if it rests for so long while another one moves, s; 0: not watched",
    )
    moved_k: float = setting(toml_files.positive, 5.0, meaning="how far another sensor must have moved for that, K")


@dataclass(frozen=True)
class HeatTable:
    """A table of ``volheat`` as read back, in mm and K."""

    sensors: tuple[str, ...]
    terms: tuple[tuple[int, int, float, tuple[float, ...]], ...]
    ranges: tuple[tuple[int, int, float, float, float], ...]
    rate_mm_s: float

    def added(self, temperatures: Temperatures) -> FloatArray:
        """See :class:`Emulated`."""
        needed(temperatures, self.sensors)
        read = [temperatures.celsius[name] for name in self.sensors]
        moved = np.zeros((len(temperatures), 3))
        for sensor, start, lag_s, per_k in self.terms:
            state = lagged(temperatures.time_s, read[sensor], lag_s, float(read[start][0]))
            moved += np.outer(state - state[0], per_k)
        share = np.ones(len(temperatures))
        for sensor, minus, low, high, margin in self.ranges:
            value = read[sensor] - (read[minus] if minus >= 0 else 0.0)
            beyond = np.maximum(0.0, np.maximum(low - value, value - high))
            share = np.minimum(share, np.clip(1 - beyond / margin, 0.0, 1.0))
        return limited(temperatures.time_s, -share[:, None] * moved, self.rate_mm_s)


@dataclass(frozen=True)
class LinuxcncHeat(HeatOutput):
    """The HAL component ``volheat``: temperatures in, offsets between motion and drives."""

    name: ClassVar[str] = "linuxcnc-heat"
    settings_class: ClassVar[type[Any]] = LinuxcncHeatSettings
    read_files: ClassVar[tuple[str, ...]] = ("volheat.tab",)

    def files(self, model: HeatModel) -> dict[str, str]:
        """Table, sample HAL lines, and the sources of the component with their licence."""
        for name in model.sensors:
            if not _WORD.fullmatch(name):
                raise InputError(
                    f"sensor {name!r} cannot be named in a table of LinuxCNC; call it by letters, digits, . _ - without blanks"
                )
        if len(model.sensors) > 16 or len(model.terms) > 16:
            raise InputError("volheat takes at most 16 sensors and 16 terms; learn a model of fewer")
        sources = data_folder("templates") / self.name
        found = {"volheat.tab": self._table(model), "volheat.hal": self._hal(model)}
        return found | {name: (sources / name).read_text() for name in ("volheat.comp", "volheat.h", "COPYING")}

    def _table(self, model: HeatModel) -> str:
        unit = MM_PER_UNIT[self.settings.machine_units]
        number = {name: k for k, name in enumerate(model.sensors)}
        own = self.settings
        lines = [
            f"volheat 1 {own.machine_units}",
            f"rate {own.rate_um_s * MM_PER_UM / unit:.9g} jump {own.jump_k:.9g} stuck {own.stuck_s:.9g} moved {own.moved_k:.9g}",
            f"sensors {len(number)} {' '.join(number)}",
            f"terms {len(model.terms)}",
        ]
        for term in model.terms:
            per_k = [term.per_k.get(ALONG[axis], 0.0) * MM_PER_UM / unit for axis in AXES]
            numbers = " ".join(f"{value:.9g}" for value in (term.lag_s, *per_k))
            lines.append(f"{number[term.sensor]} {number[term.start]} {numbers}")
        lines.append(f"ranges {len(model.hull)}")
        for item in model.hull:
            ends = " ".join(f"{value:.9g}" for value in (item.low, item.high, item.margin_k))
            lines.append(f"{number[item.sensor]} {number[item.minus] if item.minus else -1} {ends}")
        lines.append("end")
        text = "\n".join(lines)
        return f"{text}\ncrc32 {checksum(text.split())}\n"

    def _hal(self, model: HeatModel) -> str:
        lines = [
            f"# Sample HAL lines for volheat, machine {_plain(self.machine.name)}: copy them to where its drives are connected.",
            "loadrt volheat file=volheat.tab units=[TRAJ]LINEAR_UNITS",
            "# Functions in this order; a table of volcomp comes between motion and volheat:",
            "#   addf (function that reads the drives)   servo-thread",
            "#   addf volheat.feedback                   servo-thread",
            "#   addf motion-command-handler             servo-thread",
            "#   addf motion-controller                  servo-thread",
            "#   addf volheat.command                    servo-thread",
            "#   addf (function that writes to drives)   servo-thread",
        ]
        for joint, axis in enumerate(AXES):
            letter = axis.lower()
            lines += [
                f"# {axis}: volheat.drive-{letter} goes to the drive, and its position comes to volheat.drive-fb-{letter}",
                f"net volheat-motor-{letter} joint.{joint}.motor-pos-cmd => volheat.motor-{letter}",
                f"net volheat-motor-fb-{letter} volheat.motor-fb-{letter} => joint.{joint}.motor-pos-fb",
            ]
        lines.append("# temperatures, degC: connect the pins of the sensors to these signals")
        lines += [f"net heat-{name.replace('.', '-')} volheat.temp-{k:02}" for k, name in enumerate(model.sensors)]
        return "\n".join(
            [*lines, "net volheat-enable motion.is-all-homed => volheat.enable", "# end of volheat.hal", ""]
        )

    def parse(self, sources: Sequence[SourceFile]) -> HeatTable:
        """Read ``volheat.tab``."""
        (source,) = sources
        words = source.text.split()
        if words[:2] != ["volheat", "1"] or len(words) < 3 or words[2] not in MM_PER_UNIT:
            raise source.fail("is no table of volheat: it begins with 'volheat 1' and the unit", 1)
        if "end" not in words or words[words.index("end") + 1 :] != [
            "crc32",
            checksum(words[: words.index("end") + 1]),
        ]:
            raise source.fail("the table is not whole: its checksum does not match; export it again")
        if words[2] != self.settings.machine_units:
            raise source.fail(f"is in {words[2]}, and the machine in {self.settings.machine_units}", 1)
        return _Reader(source, words[3:]).table(MM_PER_UNIT[words[2]])

    def stated(self) -> tuple[tuple[str, str], ...]:
        """See :class:`HeatOutput`."""
        return (
            (
                "documented",
                "the offset is added to the command: source of the component; tried in a running LinuxCNC 2.9",
            ),
            ("unknown", "LinuxCNC 2.10 and later: its HAL interface has changed; the component must be adapted"),
        )

    def before_use(self, model: HeatModel) -> tuple[str, ...]:
        """See :class:`HeatOutput`."""
        return (
            "`sudo halcompile --install volheat.comp` (volheat.h beside it), and take the lines of volheat.hal over.",
            "Warm one sensor by hand: the pin of its number in volheat.hal must follow, and no other.",
            "Home while the pin at-zero is TRUE: what is added while a joint homes stays in its position.",
            "Offsets count from the first readings after LinuxCNC was started. Probe work offsets again after each start.",
            "If it is started on a warm machine, set the pin warm first: nothing is added until the lags are known.",
            "The pin fault says that a sensor failed, fault-code why. Mend it, then let the pin reset rise.",
        )


def _plain(text: str) -> str:
    """Text for a comment: printable ASCII."""
    return "".join(char if " " <= char <= "~" else "?" for char in text)


@dataclass
class _Reader:
    """The words of a table from the settings on."""

    source: SourceFile
    words: Sequence[str]
    at: int = 0

    def _word(self) -> str:
        if self.at >= len(self.words):
            raise self.source.fail("the table ends too early")
        self.at += 1
        return self.words[self.at - 1]

    def _named(self, name: str) -> float:
        if (word := self._word()) != name:
            raise self.source.fail(f"expected {name!r}, found {word[:40]!r}")
        return self._number()

    def _number(self) -> float:
        word = self._word()
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self.source.fail(f"{word[:40]!r} is no number")
        return value

    def _index(self, count: int, least: int = 0) -> int:
        value = self._number()
        if value != int(value) or not least <= value < count:
            raise self.source.fail(f"{value:g} is no number of a sensor")
        return int(value)

    def table(self, unit_mm: float) -> HeatTable:
        """The whole table; lengths in mm."""
        rate, _, _, _ = (self._named(name) for name in ("rate", "jump", "stuck", "moved"))
        sensors = tuple(self._word() for _ in range(int(self._named("sensors"))))
        terms, ranges = [], []
        for _ in range(int(self._named("terms"))):
            sensor, start, lag_s = self._index(len(sensors)), self._index(len(sensors)), self._number()
            terms.append((sensor, start, lag_s, tuple(self._number() * unit_mm for _ in AXES)))
        for _ in range(int(self._named("ranges"))):
            pair = self._index(len(sensors)), self._index(len(sensors), -1)
            ranges.append((*pair, self._number(), self._number(), self._number()))
        if self._word() != "end":
            raise self.source.fail("expected 'end'")
        return HeatTable(sensors, tuple(terms), tuple(ranges), rate * unit_mm)


# Klipper: one coefficient of one thermistor.


@dataclass(frozen=True)
class KlipperHeatSettings:
    """Settings of ``klipper-heat``."""

    sensor_type: str | None = setting(toml_files.text, None, meaning="sensor_type of the thermistor, as in printer.cfg")
    sensor_pin: str | None = setting(toml_files.text, None, meaning="sensor_pin of the thermistor, as in printer.cfg")


@dataclass(frozen=True)
class ZAdjust:
    """``[z_thermal_adjust]`` as Klipper acts on it."""

    sensor: str
    mm_per_k: float
    smooth_s: float
    most_mm: float

    def added(self, temperatures: Temperatures) -> FloatArray:
        """See :class:`Emulated`; steps of the motor are not rounded."""
        needed(temperatures, (self.sensor,))
        read = temperatures.celsius[self.sensor]
        smooth = lagged(temperatures.time_s, read, self.smooth_s, float(read[0]))
        found = np.zeros((len(temperatures), 3))
        found[:, 2] = np.clip(-self.mm_per_k * (smooth - smooth[0]), -self.most_mm, self.most_mm)
        return found


@dataclass(frozen=True)
class KlipperHeat(HeatOutput):
    """``[z_thermal_adjust]``: Z over one temperature behind one lag."""

    name: ClassVar[str] = "klipper-heat"
    settings_class: ClassVar[type[Any]] = KlipperHeatSettings
    fades: ClassVar[bool] = False
    read_files: ClassVar[tuple[str, ...]] = ("z_thermal_adjust.cfg",)
    #: Smoothing of Klipper where the model has no lag, s: its default.
    usual_s: ClassVar[float] = 2.0

    def expressed(self, model: HeatModel) -> tuple[str, ...]:
        """Z alone."""
        return ("Z",) if "dz" in model.directions else ()

    def files(self, model: HeatModel) -> dict[str, str]:
        """The section."""
        terms = [term for term in model.terms if term.per_k.get("dz", 0.0)]
        if len(terms) != 1 or terms[0].start != terms[0].sensor:
            what = ", ".join(term.text for term in terms) or "no term along Z"
            raise InputError(
                f"[z_thermal_adjust] holds one coefficient of one sensor, and the model has {what}; leave the "
                f"other sensors out of "
                "the sessions and learn again, or correct programs with volcomp correct --temperatures",
                file=model.source,
            )
        (term,) = terms
        per_k = term.per_k["dz"] * MM_PER_UM
        if abs(per_k) > 1:
            raise InputError("Klipper takes at most 1 mm/K", file=model.source)
        seen = next(item for item in model.hull if item.sensor == term.sensor and not item.minus)
        own = self.settings
        lines = [
            f"# model of heat of {_plain(self.machine.name)}, sensor {_plain(term.sensor)}",
            "[z_thermal_adjust]",
            f"temp_coeff: {per_k:.7f}",
            f"smooth_time: {term.lag_s or self.usual_s:.3f}",
            f"max_z_adjustment: {abs(per_k) * (seen.high - seen.low):.4f}",
            f"sensor_type: {own.sensor_type}" if own.sensor_type else "# sensor_type: that of your thermistor",
            f"sensor_pin: {own.sensor_pin}" if own.sensor_pin else "# sensor_pin: that of your thermistor",
            "# min_temp and max_temp: Klipper shuts down beyond them; they are no range of the model",
        ]
        return {"z_thermal_adjust.cfg": "\n".join(lines) + "\n"}

    def parse(self, sources: Sequence[SourceFile]) -> ZAdjust:
        """Read the section as ConfigParser does: ``key: value``, comments with ``#``."""
        (source,) = sources
        found: dict[str, tuple[str, int]] = {}
        named = re.search(r"^# model of heat of .*, sensor (.*)$", source.text, re.MULTILINE)
        lines = [line.split("#")[0].strip() for line in source.text.splitlines()]
        if lines.count("[z_thermal_adjust]") != 1 or named is None:
            raise source.fail("expected one section [z_thermal_adjust] below the comment that names its sensor")
        for number, line in enumerate(lines, start=1):
            if line in ("", "[z_thermal_adjust]"):
                continue
            match = re.fullmatch(r"(\w+)\s*[:=]\s*(\S.*)", line)
            if match is None or match[1] in found:
                raise source.fail(f"{line[:60]!r} is not understood", number)
            found[match[1]] = match[2], number
        values = [self._number(source, found, key) for key in ("temp_coeff", "smooth_time", "max_z_adjustment")]
        return ZAdjust(named[1], *values)

    def _number(self, source: SourceFile, found: Mapping[str, tuple[str, int]], key: str) -> float:
        if key not in found:
            raise source.fail(f"has no {key}")
        text, line = found[key]
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key != "temp_coeff" and value <= 0):
            raise source.fail(f"{key}: {text[:40]!r} is no number that Klipper takes", line)
        return value

    def stated(self) -> tuple[tuple[str, str], ...]:
        """See :class:`HeatOutput`."""
        return (
            (
                "documented",
                "Z is lowered by temp_coeff for each K: klippy/extras/z_thermal_adjust.py; so temp_coeff is dz per K",
            ),
            (
                "documented",
                "smooth_time acts as a first-order lag, and the reference is the temperature when Z was homed",
            ),
            ("documented", "it acts outside of what was trained, too: only max_z_adjustment limits it"),
            (
                "inferred",
                "the machine had settled when Z is homed: the smoothed temperature begins at the first reading",
            ),
        )

    def before_use(self, model: HeatModel) -> tuple[str, ...]:
        """See :class:`HeatOutput`."""
        unknown = [axis for axis in ("X", "Y") if ALONG[axis] in model.directions]
        lost = (f"Klipper holds nothing for {', '.join(unknown)}: heat moves them as before.",) if unknown else ()
        return (
            *lost,
            "Include the file in printer.cfg; sensor_type, sensor_pin, min_temp and max_temp are those of your thermistor.",
            "Z changes only in moves along X or Y, by whole steps. SET_Z_THERMAL_ADJUST shows what is applied.",
            "Home Z, warm the frame by 1 K: the adjustment shown must be minus temp_coeff.",
        )


#: What to use where a control takes no file.
INSTEAD = "correct the programs for the temperatures of the day with volcomp correct --temperatures"


def output_of(machine: Machine, name: str) -> HeatOutput:
    """The output of a machine; InputError for a control that takes no file, or a setting that must be stated."""
    from compgen.controls.heat_programs import SiemensHeat, TwincatHeat

    kinds: dict[str, type[HeatOutput]] = {
        kind.name: kind for kind in (LinuxcncHeat, KlipperHeat, SiemensHeat, TwincatHeat)
    }
    if name not in kinds:
        about = ABOUT[name]
        raise InputError(
            f"{about['title']}. It expresses {about['expresses']}. Evidence: {about['evidence']}. Instead, {INSTEAD}"
        )
    section = machine.controller_settings(name)
    settings = toml_files.read_settings(kinds[name].settings_class, section)
    if isinstance(settings, LinuxcncHeatSettings):
        settings = with_units(settings, section, machine)
    return kinds[name](machine, settings)


def from_folder(output: HeatOutput, paths: Sequence[Path]) -> list[SourceFile]:
    """The files that are read back: given, or in the folder of an export; a name may say that it was not accepted."""
    from compgen.data.files import REJECTED_PREFIX, read_text

    files = [file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    found = [path for path in files if output.belongs(path.name.removeprefix(REJECTED_PREFIX))]
    if len(found) != len(output.read_files):
        raise InputError(f"expected {' and '.join(output.read_files)}, or the folder of the export", file=paths[0])
    return [SourceFile(path, read_text(path)) for path in found]


def without_tilt(model: HeatModel) -> HeatModel:
    """The model without its tilts, which no control takes."""
    kept = [name for name in model.directions if name in ALONG.values()]
    terms = tuple(Term(t.sensor, t.lag_s, t.start, {k: t.per_k.get(k, 0.0) for k in kept}) for t in model.terms)
    return replace(model, terms=terms, rms={name: model.rms[name] for name in kept})


__all__ = ["ABOUT", "ALONG", "Emulated", "HeatOutput", "Range", "fixed", "from_folder", "output_of", "without_tilt"]
