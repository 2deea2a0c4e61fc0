"""Linear maps about machine zero: skew factors (``klipper``, ``marlin``, ``reprapfirmware``, ``ucnc``), a matrix (LinuxCNC)."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeVar

import numpy as np

from compgen.controls.shared.base import Controller, Monomial, SourceFile, Term, Usage, parameter_row
from compgen.controls.shared.scanner import check_size, content_lines, floating
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray, fixed
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, SQUARENESS_NAMES
from compgen.data.toml_files import Section, choice, setting
from compgen.errors import InputError
from compgen.kinematics.first_order import coefficients

# All map the commanded position linearly about machine zero and then move the motors there:
#
#   Klipper, Marlin    x' = x - xy y - (xz - xy yz) z,  y' = y - yz z
#   RepRapFirmware     x' = x + XY y + XZ z,  y' = y + YZ z;  with P1 x' = x + XZ z,  y' = y + XY x' + YZ z
#   uCNC               x' = x - xy y - (xy - xz yz) z,  y' = y - yz z: xz has next to no effect, see format.toml
#   LinuxCNC           (x', y', z') = C (x, y, z), the module matrixkins
#
# A squareness EC0Y > 0 moves the tool by -EC0Y y in X (model: E = EC0Y z^ x y y^ + ...), so the control must add
# +EC0Y y: xy = -EC0Y for the first two, XY = +EC0Y for the third, C_xy = +EC0Y for the matrix.

#: Decimals of a factor; RepRapFirmware gets deviations in mm over ``HEIGHT_MM``.
DECIMALS = 9
HEIGHT_MM = 1000.0
#: Marlin refuses larger factors.
MARLIN_LARGEST = 1.0
#: A larger factor, axes at less than 45 degrees, is no skew of a machine but a wrong number.
LARGEST_SKEW = 1.0
#: Marlin corrects nothing within this distance of the lower end of X and Y.
MARLIN_MARGIN_MM = 1.0
SHEAR_WARNING = (
    "The shear acts about machine zero: home the axes before it is switched on, and set work offsets again afterwards, "
    "because it also moves the place of every old offset."
)
_MOST_CHARACTERS = 20_000_000
_FLOAT32 = float(np.finfo(np.float32).eps)

Settings = TypeVar("Settings")
Factors = TypeVar("Factors")


@dataclass(frozen=True)
class SkewFactors:
    """Factors of the planes XY, XZ and YZ as in the file, dimensionless.

    ``along_y``: the XY factor moves Y as a function of X (RepRapFirmware, P1) and not X as a function of Y.
    """

    xy: float
    xz: float = 0.0
    yz: float = 0.0
    along_y: bool = False


class LinearControl(Controller[Settings, Factors]):
    """What these controls have in common: factors of a linear map about machine zero, which hold no curve."""

    anchored = True
    #: Output axis and base axis of each factor that an export fits; the same axis twice is a scale.
    shears: tuple[tuple[int, int], ...] = ((0, 1), (0, 2), (1, 2))
    #: How a file of this control marks a comment; how many decimals of a factor it has.
    comment, decimals = ";", DECIMALS
    #: Axes that a factor may move.
    moved = "XY"

    @abstractmethod
    def shifted(self, factors: Factors, position_mm: FloatArray) -> FloatArray:
        """Return the positions (n, 3) to which the control drives its motors for commands (n, 3), mm: its formula."""

    @abstractmethod
    def factors_for(self, slopes: Mapping[tuple[int, int], float]) -> Factors:
        """Return the factors that add ``slopes[output, base]`` times the base axis' position to the output axis."""

    @abstractmethod
    def limits_of(self, letter: str) -> str:
        """Return what the user calls the limits of an axis."""

    @abstractmethod
    def words_of(self, source: SourceFile, strict: bool) -> Iterator[tuple[int, str, str]]:
        """Yield line, key and text of each number; ``strict``: nothing else may be there."""

    @abstractmethod
    def factors_from(self, values: Mapping[str, float]) -> Factors:
        """Return the factors from the numbers of a file, by key."""

    @abstractmethod
    def required_keys(self) -> tuple[str, ...]:
        """Return the keys that a file must have."""

    @abstractmethod
    def shown(self, factors: Factors) -> dict[str, float]:
        """Return the numbers as written, by key."""

    @abstractmethod
    def largest(self, factors: Factors) -> float:
        """Return the largest factor: how far, per mm of one axis, the map is from leaving everything where it is."""

    @abstractmethod
    def rounded(self, factors: Factors) -> Factors:
        """Return the factors as read back from the file."""

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return one constant per factor, in rad: what is added per mm of the base axis."""
        starts = dict.fromkeys(self.shears, 0.0)
        for part in coefficients(self.machine.chain, self.machine.squareness_reference):
            key = part.output, part.lever
            if part.error in SQUARENESS_NAMES and part.error in errors.squareness and key in starts:
                starts[key] -= part.sign * errors.squareness[part.error][0]
        return [
            Term(shear_name(*key), None, np.zeros(1), (Monomial(key[0], 1, key[1]),), np.array([start]))
            for key, start in starts.items()
        ]

    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> Factors:
        """Return the factors, rounded as written."""
        return self.rounded(self.factors_for({key: float(values[shear_name(*key)][0]) for key in self.shears}))

    def context(self, tables: Factors) -> dict[str, Any]:
        """Return the numbers as written, the sign with a worked position, and the range that the axes need."""
        return {
            "sign_statement": self._sign_statement(tables),
            "parameters": self.parameters(tables),
            "warnings": [SHEAR_WARNING],
            "factors": self.shown(tables),
            "checks": self._checks(tables),
            "settings": self.settings,
        }

    def parameters(self, tables: Factors) -> list[dict[str, str]]:
        """Return what must be set on the control besides the factors."""
        reached = self._reached_mm(tables)
        return [
            parameter_row(
                self.limits_of(letter),
                f"{fixed(float(low), 3)} ... {fixed(float(high), 3)} mm, or more",
                f"where {letter} goes for commands within its travel",
            )
            for letter, low, high in zip(self.moved, reached.min(axis=0), reached.max(axis=0), strict=False)
        ]

    def parse(self, files: Sequence[SourceFile]) -> Factors:
        """Read the factors strictly: each once, and nothing else in the file."""
        return self._read(files, strict=True)[0]

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[Factors, list[str]]:
        """Read the factors from a file of the control with anything else in it; of several the last one acts."""
        return self._read(files, strict=False)

    def _read(self, files: Sequence[SourceFile], *, strict: bool) -> tuple[Factors, list[str]]:
        values: dict[str, float] = {}
        remarks = []
        for source in files:
            check_size(source, _MOST_CHARACTERS)
            for line, key, word in self.words_of(source, strict):
                if key in values and strict:
                    raise source.fail(f"the factor {key} is given a second time", line)
                if key in values:
                    remarks.append(f"{source.path.name}, line {line}: {key} is given again; the last one acts")
                values[key] = floating(source, line, word, f"the factor {key}")
        missing = [key for key in self.required_keys() if key not in values]
        if missing:
            message = f"no factor {', '.join(missing)} was found; is it the right file, or is it truncated?"
            raise files[0].fail(message, 1) if files else InputError(message)
        factors = self.factors_from(values)
        largest = self.largest(factors)
        if not largest <= LARGEST_SKEW:
            message = (
                f"gives a skew factor of {largest:g}; no machine has one above {LARGEST_SKEW:g}: check number and unit"
            )
            raise files[0].fail(message, 1)
        return factors, remarks

    def emulate(self, tables: Factors, points: Points) -> FloatArray:
        """Return what the shears add to the commanded positions."""
        return self.shifted(tables, points.position_mm) - points.position_mm

    def violations(self, tables: Factors) -> list[str]:
        """Return none: a linear map acts everywhere."""
        return []

    def anchor_mm(self) -> FloatArray:
        """Return machine zero, where a linear map adds nothing."""
        return np.zeros(3)

    def resolution_mm(self) -> float:
        """Half of the last decimal of two factors at the ends of the travel."""
        return self._reach_of_two_mm() * 0.5 * 10.0**-self.decimals

    def _reach_of_two_mm(self) -> float:
        """Sum of the two largest distances from machine zero that the axes have, mm."""
        return float(np.sort(np.abs([self.machine.lower_mm, self.machine.upper_mm]).max(axis=0))[-2:].sum())

    def _reached_mm(self, tables: Factors) -> FloatArray:
        """Where the axes go for commands at the corners of the travel: it adds most there."""
        return self.shifted(tables, np.array(list(product(*(axis.range_mm for axis in self.machine.axes)))))

    def _checks(self, tables: Factors) -> list[dict[str, str]]:
        """What each factor does over the whole travel of its base axis, for the check at the machine."""
        found = []
        for output, base in self.shears:
            ends = np.tile(0.5 * (self.machine.lower_mm + self.machine.upper_mm), (2, 1))
            ends[:, base] = self.machine.axes[base].range_mm
            change = float(np.diff((self.shifted(tables, ends) - ends)[:, output])[0])
            low, high = (fixed(float(end), 3) for end in ends[:, base])
            found.append(
                {"base": AXES[base], "low": low, "high": high, "output": AXES[output], "change": f"{change:+.4f}"}
            )
        return found

    def _sign_statement(self, tables: Factors) -> str:
        corners = np.array(list(product(*(axis.range_mm for axis in self.machine.axes))))
        added = self._reached_mm(tables) - corners
        k = int(np.argmax(np.abs(added).max(axis=1)))
        to = ", ".join(f"{letter} {fixed(float(v), 4)}" for letter, v in zip(AXES, (corners + added)[k], strict=True))
        at = ", ".join(f"{letter} {fixed(float(v), 4)}" for letter, v in zip(AXES, corners[k], strict=True))
        return f"For the command {at} mm (machine coordinates) the motors go to {to} mm."


class SkewControl(LinearControl[Settings, SkewFactors]):
    """A firmware with three skew factors in single precision, which hold squareness and nothing else."""

    def factors_from(self, values: Mapping[str, float]) -> SkewFactors:
        """Return the factors from the numbers of a file, by key."""
        return SkewFactors(values["xy"], values.get("xz", 0.0), values.get("yz", 0.0))

    def required_keys(self) -> tuple[str, ...]:
        """Return the keys that a file must have."""
        return ("xy", "xz", "yz")

    def shown(self, factors: SkewFactors) -> dict[str, float]:
        """Return the numbers as written, by key."""
        return {key: getattr(factors, key) for key in ("xy", "xz", "yz")}

    def largest(self, factors: SkewFactors) -> float:
        """Return the largest of the three."""
        return max(abs(factors.xy), abs(factors.xz), abs(factors.yz))

    def rounded(self, factors: SkewFactors) -> SkewFactors:
        """Return the factors with the decimals of the file."""
        xy, xz, yz = (float(fixed(value, self.decimals)) for value in (factors.xy, factors.xz, factors.yz))
        return replace(factors, xy=xy, xz=xz, yz=yz)

    def context(self, tables: SkewFactors) -> dict[str, Any]:
        """Return also whether the XY factor moves Y."""
        return {**super().context(tables), "in_y": tables.along_y}

    def resolution_mm(self) -> float:
        """Half of the last decimal of two factors at the ends of the travel, and rounding of factors to float32."""
        return super().resolution_mm() + self._reach_of_two_mm() * 0.02 * _FLOAT32

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Say that curves stay, and a squareness to which no shear belongs."""
        found = []
        if errors.curves:
            found.append(
                f"three skew factors hold squareness alone: positioning, straightness and angles "
                f"({', '.join(errors.curves)}) stay as they are; the NC program can be corrected for them"
            )
        for part in coefficients(self.machine.chain, self.machine.squareness_reference):
            if part.error not in SQUARENESS_NAMES or part.error not in errors.squareness:
                continue
            if (part.output, part.lever) not in self.shears:
                text = f"{part.error} moves {AXES[part.output]} as a function of {AXES[part.lever or 0]}"
                turned = (part.output, part.lever) == (1, 0) and (0, 1) in self.shears
                found.append(
                    f"{text}; this control corrects it by moving X as a function of Y, so that Y keeps its direction and X "
                    "is turned: align the workpiece again"
                    if turned
                    else f"{text}, which this control cannot correct"
                )
        return found


def shear_name(output: int, base: int) -> str:
    """Name of the term that moves ``output`` in proportion to the position of ``base``, e.g. ``X*y``."""
    return f"{AXES[output]}*{AXES[base].lower()}"


def klipper_shift(factors: SkewFactors, position_mm: FloatArray) -> FloatArray:
    """Return the positions (n, 3) of Klipper's and Marlin's formula.

    Golden values: Klipper's own module, see ``tests/golden/klipper/README.md``.
    """
    x, y, z = position_mm.T
    moved_x = x - y * factors.xy - z * (factors.xz - factors.xy * factors.yz)
    return np.stack([moved_x, y - z * factors.yz, z], axis=1)


def klipper_factors(slopes: Mapping[tuple[int, int], float]) -> SkewFactors:
    """Return the factors for which :func:`klipper_shift` adds these slopes."""
    xy, yz = -slopes[0, 1], -slopes.get((1, 2), 0.0)
    return SkewFactors(xy, -slopes.get((0, 2), 0.0) + xy * yz, yz)


@dataclass(frozen=True)
class KlipperSettings:
    """Settings ``[controllers.klipper]``."""

    profile: str = setting(
        toml_files.name, "volcomp", meaning="name of the profile: SKEW_PROFILE LOAD=<name> switches it on"
    )


class Klipper(SkewControl[KlipperSettings]):
    """``klipper``: a profile of ``[skew_correction]``."""

    name = "klipper"
    settings_class = KlipperSettings
    comment = "#"
    #: What Klipper puts before the lines that SAVE_CONFIG writes.
    SAVED = "#*#"

    def shifted(self, factors: SkewFactors, position_mm: FloatArray) -> FloatArray:
        """Apply ``calc_skew`` of klippy/extras/skew_correction.py."""
        return klipper_shift(factors, position_mm)

    def limits_of(self, letter: str) -> str:
        """Return the settings of the firmware."""
        return f"[stepper_{letter.lower()}] position_min ... position_max"

    def factors_for(self, slopes: Mapping[tuple[int, int], float]) -> SkewFactors:
        """Return ``xy_skew``, ``xz_skew`` and ``yz_skew``."""
        return klipper_factors(slopes)

    def words_of(self, source: SourceFile, strict: bool) -> Iterator[tuple[int, str, str]]:
        """Yield the keys of the profile; in a printer.cfg only that of ``profile`` counts, or the only one there is."""
        found: dict[str, list[tuple[int, str, str]]] = {}
        section = None
        for line, text in self._lines(source, strict):
            if head := re.fullmatch(r"\[skew_correction(?:\s++([^\]]{1,80}))?\]", text):
                section = head.group(1) or ""
                if section in found and strict:
                    raise source.fail(f"the section {text} is given a second time", line)
                found.setdefault(section, [])
            elif text.startswith("["):
                section = None
                if strict:
                    raise source.fail(f"expected [skew_correction {self.settings.profile}], got {text[:40]!r}", line)
            elif section is not None:
                pair = re.fullmatch(r"(xy|xz|yz)_skew\s*[:=]\s*(\S+)", text)
                if pair is None or not section:
                    raise source.fail(f"expected xy_skew, xz_skew or yz_skew of a profile, got {text[:40]!r}", line)
                found[section].append((line, pair.group(1), pair.group(2)))
            elif strict:
                raise source.fail(f"expected a section [skew_correction ...], got {text[:40]!r}", line)
        profiles = [name for name in found if name]
        if self.settings.profile in profiles:
            yield from found[self.settings.profile]
        elif len(profiles) == 1 and not strict:
            yield from found[profiles[0]]
        elif profiles:
            message = f'there is no profile {self.settings.profile!r} but {", ".join(profiles)}; set profile = "..."'
            raise source.fail(
                f"{message} in [controllers.klipper] of the machine file",
                found[profiles[0]][0][0] if found[profiles[0]] else 1,
            )

    def _lines(self, source: SourceFile, strict: bool) -> Iterator[tuple[int, str]]:
        if strict:
            yield from content_lines(source, self.comment)
            return
        for number, raw in enumerate(source.text.splitlines(), start=1):
            text = raw.removeprefix(self.SAVED).partition(self.comment)[0].strip()
            if text:
                yield number, text


@dataclass(frozen=True)
class MarlinSettings:
    """Settings ``[controllers.marlin]``."""

    for_z: bool = setting(
        toml_files.flag, True, meaning="SKEW_CORRECTION_FOR_Z is compiled in; without it the firmware ignores J and K"
    )
    x_limits_mm: tuple[float, float] | None = setting(
        toml_files.interval, None, meaning="X_MIN_POS and X_MAX_POS: outside Marlin switches the correction off"
    )
    y_limits_mm: tuple[float, float] | None = setting(
        toml_files.interval, None, meaning="Y_MIN_POS and Y_MAX_POS, likewise"
    )


class GcodeSkew(SkewControl[Settings]):
    """A firmware whose factors are the words of one G-code command, with other commands around it."""

    #: The command, its words by key, and commands that may stand in our own file besides.
    command, letters = "", {"xy": "", "xz": "", "yz": ""}
    besides: Sequence[str] = ()

    def words_of(self, source: SourceFile, strict: bool) -> Iterator[tuple[int, str, str]]:
        """Yield the words of the command; each has a letter and a number."""
        lines = content_lines(source, self.comment) if strict else list(enumerate(source.text.splitlines(), start=1))
        for line, raw in lines:
            words = raw.partition(self.comment)[0].split()
            if not words or words[0] != self.command:
                if words[:1] == ["G20"]:
                    raise source.fail("G20: in inches the firmware scales the numbers; expected G21", line)
                if strict and words != [*self.besides]:
                    raise source.fail(f"expected {self.command} with its factors, got {raw[:40]!r}", line)
                continue
            for word in words[1:]:
                key = next((key for key, letter in self.letters.items() if letter == word[0]), None)
                if key is None:
                    raise source.fail(f"{word[:40]!r} is not a word of {self.command}", line)
                yield line, key, word[1:]


class Marlin(GcodeSkew[MarlinSettings]):
    """``marlin``: the command M852."""

    name = "marlin"
    settings_class = MarlinSettings
    command, letters, besides = "M852", {"xy": "I", "xz": "J", "yz": "K"}, ("G21",)

    def __init__(self, machine: Machine, settings: MarlinSettings | None = None) -> None:
        super().__init__(machine, settings)
        self.shears = ((0, 1), (0, 2), (1, 2)) if self.settings.for_z else ((0, 1),)

    def shifted(self, factors: SkewFactors, position_mm: FloatArray) -> FloatArray:
        """Apply ``skew`` of Marlin/src/module/planner.h, which is Klipper's formula with factors in float32."""
        xy, xz, yz = (float(np.float32(value)) for value in (factors.xy, factors.xz, factors.yz))
        return klipper_shift(SkewFactors(xy, xz, yz), position_mm)

    def limits_of(self, letter: str) -> str:
        """Return the settings of the firmware."""
        return f"{letter}_MIN_POS ... {letter}_MAX_POS"

    def factors_for(self, slopes: Mapping[tuple[int, int], float]) -> SkewFactors:
        """Return I, J and K."""
        return klipper_factors(slopes)

    def required_keys(self) -> tuple[str, ...]:
        """Return the keys of the factors that the firmware was compiled with."""
        return ("xy", "xz", "yz") if self.settings.for_z else ("xy",)

    def parameters(self, tables: SkewFactors) -> list[dict[str, str]]:
        """Return the limits of X and Y: one millimetre more at the lower end, see :meth:`violations`."""
        low, high = self._least_limits_mm(tables)
        rows = [
            parameter_row(
                self.limits_of(letter),
                f"at most {fixed(float(low[k]), 3)}, at least {fixed(float(high[k]), 3)} mm",
                "beyond them, and within 1 mm of the lower one, Marlin does not correct X and Y at all",
            )
            for k, letter in enumerate("XY")
        ]
        if self.settings.for_z:
            rows.append(parameter_row("SKEW_CORRECTION_FOR_Z", "defined", "else the firmware ignores J and K"))
        return [*rows, parameter_row("SKEW_CORRECTION_GCODE", "defined", "else the firmware does not know M852")]

    def violations(self, tables: SkewFactors) -> list[str]:
        """Return factors that Marlin refuses, and stated limits of an axis at which it switches the correction off."""
        found = [
            f"the factor {key} is {value:g}; Marlin takes -1 ... 1"
            for key, value in self.shown(tables).items()
            if abs(value) > MARLIN_LARGEST
        ]
        low, high = self._least_limits_mm(tables)
        for k, (letter, limits) in enumerate(
            zip("XY", (self.settings.x_limits_mm, self.settings.y_limits_mm), strict=True)
        ):
            if limits is not None and (limits[0] > low[k] or limits[1] < high[k]):
                found.append(
                    f"{letter}_MIN_POS ... {letter}_MAX_POS is {limits[0]:g} ... {limits[1]:g} mm: where {letter} leaves it, "
                    f"Marlin does not correct; it must reach from {low[k]:.3f} to {high[k]:.3f} mm"
                )
        return found

    def usage(self, tables: SkewFactors) -> list[Usage]:
        """Return the largest factor against the one that Marlin takes."""
        return [Usage("largest skew factor", max(map(abs, self.shown(tables).values())), MARLIN_LARGEST, "1")]

    def _least_limits_mm(self, tables: SkewFactors) -> tuple[FloatArray, FloatArray]:
        """Least and largest positions (3,) that the limits of the axes must include."""
        reached = self._reached_mm(tables)
        low = np.minimum(self.machine.lower_mm - MARLIN_MARGIN_MM, reached.min(axis=0))
        return low, np.maximum(self.machine.upper_mm, reached.max(axis=0))


@dataclass(frozen=True)
class RepRapFirmwareSettings:
    """Settings ``[controllers.reprapfirmware]``."""

    moves: str = setting(
        choice("X", "Y"),
        "",
        meaning="axis that the XY factor moves: X (P0) or Y (P1, from firmware 3.2-b4 on); "
        "default: the one that is not the squareness reference",
    )


class RepRapFirmware(GcodeSkew[RepRapFirmwareSettings]):
    """``reprapfirmware``: the command M556."""

    name = "reprapfirmware"
    settings_class = RepRapFirmwareSettings
    command = "M556"
    letters = {"height": "S", "xy": "X", "yz": "Y", "xz": "Z", "along_y": "P"}

    def __init__(self, machine: Machine, settings: RepRapFirmwareSettings | None = None) -> None:
        super().__init__(machine, settings)
        self.shears = ((1, 0) if self.settings.moves == "Y" else (0, 1), (0, 2), (1, 2))

    @classmethod
    def check_settings(
        cls, settings: RepRapFirmwareSettings, section: Section, machine: Machine
    ) -> RepRapFirmwareSettings:
        """Move the axis that is not the squareness reference, unless the file says otherwise."""
        usual = "Y" if machine.squareness_reference == "Y" else "X"
        return settings if settings.moves else replace(settings, moves=usual)

    def shifted(self, factors: SkewFactors, position_mm: FloatArray) -> FloatArray:
        """Apply ``AxisTransform`` of src/Movement/Move.cpp with tangents in float32: X first, then Y with the moved X."""
        x, y, z = position_mm.T
        xy, xz, yz = (float(np.float32(value)) for value in (factors.xy, factors.xz, factors.yz))
        moved_x = x + (0.0 if factors.along_y else xy * y) + xz * z
        return np.stack([moved_x, y + (xy * moved_x if factors.along_y else 0.0) + yz * z, z], axis=1)

    def limits_of(self, letter: str) -> str:
        """Return the settings of the firmware."""
        return f"M208 {letter}"

    def factors_for(self, slopes: Mapping[tuple[int, int], float]) -> SkewFactors:
        """Return the three tangents; with P1 that of YZ makes up for Y following the moved X."""
        xz, yz = slopes[0, 2], slopes[1, 2]
        if self.settings.moves == "Y":
            return SkewFactors(slopes[1, 0], xz, yz - slopes[1, 0] * xz, along_y=True)
        return SkewFactors(slopes[0, 1], xz, yz)

    def required_keys(self) -> tuple[str, ...]:
        """Return all words but P."""
        return ("height", "xy", "yz", "xz")

    def factors_from(self, values: Mapping[str, float]) -> SkewFactors:
        """Divide the deviations by the height over which they were measured."""
        if values["height"] <= 0.0:
            raise InputError(f"M556 S{values['height']:g}: the height must be above zero")
        xy, xz, yz = (values[key] / values["height"] for key in ("xy", "xz", "yz"))
        return SkewFactors(xy, xz, yz, values.get("along_y", 0.0) > 0.0)

    def shown(self, factors: SkewFactors) -> dict[str, float]:
        """Return the deviations in mm over the height."""
        return {"height": HEIGHT_MM} | {key: HEIGHT_MM * getattr(factors, key) for key in ("xy", "yz", "xz")}


@dataclass(frozen=True)
class UcncSettings:
    """Settings ``[controllers.ucnc]``."""

    build: str = setting(
        choice("xy-only", "three"),
        meaning='how the firmware was compiled: "xy-only" with SKEW_COMPENSATION_XY_ONLY (only $37 acts), "three" without',
    )


class Ucnc(SkewControl[UcncSettings]):
    """``ucnc``: the settings $37, $38 and $39, as the firmware of 2026-08 uses them."""

    name = "ucnc"
    settings_class = UcncSettings
    finite_rotations = True  # the product of two factors is not in the terms

    @classmethod
    def settings_section(cls, machine: Machine) -> Section:
        """Return the section, which must state how the firmware was compiled."""
        section = super().settings_section(machine)
        if "build" not in section:
            raise section.fail(
                "build",
                'is missing: a factor acts otherwise in each; set build = "xy-only" ($I lists SKXY) or "three" ($I lists SK)',
                kind="missing",
                instead="xy-only",
            )
        return section

    KEYS = {"37": "xy", "38": "xz", "39": "yz"}

    def __init__(self, machine: Machine, settings: UcncSettings | None = None) -> None:
        super().__init__(machine, settings)
        self.shears = ((0, 1), (1, 2)) if self.settings.build == "three" else ((0, 1),)

    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return the shears that the firmware has; with three factors that of X along Y also acts along Z."""
        terms = super().basis(errors)
        if self.settings.build == "three":
            terms[0] = replace(terms[0], carrier=(Monomial(0, 1, 1), Monomial(0, 1, 2)))
        return terms

    def shifted(self, factors: SkewFactors, position_mm: FloatArray) -> FloatArray:
        """Apply ``kinematics_coordinates_to_steps`` of uCNC/src/hal/kinematics/kinematic.c with factors in float32."""
        x, y, z = position_mm.T
        xy, xz, yz = (float(np.float32(value)) for value in (factors.xy, factors.xz, factors.yz))
        if self.settings.build == "xy-only":
            return np.stack([x - y * xy, y, z], axis=1)
        return np.stack([x - y * xy - z * (xy - xz * yz), y - z * yz, z], axis=1)

    def limits_of(self, letter: str) -> str:
        """Return the settings of the firmware."""
        return f"soft limits of {letter} ($20, $130 ff.)"

    def factors_for(self, slopes: Mapping[tuple[int, int], float]) -> SkewFactors:
        """Return the factors; xz = xy is the only one for which the firmware's two directions are inverses."""
        xy = -slopes[0, 1]
        return SkewFactors(xy, xy, -slopes[1, 2]) if self.settings.build == "three" else SkewFactors(xy)

    def required_keys(self) -> tuple[str, ...]:
        """Return the keys of the factors that the firmware was compiled with."""
        return ("xy", "xz", "yz") if self.settings.build == "three" else ("xy",)

    def words_of(self, source: SourceFile, strict: bool) -> Iterator[tuple[int, str, str]]:
        """Yield the numbers of lines such as ``$37=-0.0029``; in a list of all settings the others are passed over."""
        lines = content_lines(source, self.comment) if strict else list(enumerate(source.text.splitlines(), start=1))
        for line, raw in lines:
            found = re.match(r"\s*\$(37|38|39)\s*=\s*([^\s;(]+)\s*(?:[;(].*)?$", raw)
            if found and (self.KEYS[found.group(1)] in self.required_keys() or not strict):
                yield line, self.KEYS[found.group(1)], found.group(2)
            elif strict or re.match(r"\s*\$(37|38|39)\b", raw):
                expected = ", ".join(f"${number}" for number, key in self.KEYS.items() if key in self.required_keys())
                raise source.fail(f"expected {expected} with a number, got {raw.strip()[:40]!r}", line)


@dataclass(frozen=True)
class MatrixkinsSettings:
    """Settings ``[controllers.linuxcnc-matrixkins]``."""

    scales: bool = setting(
        toml_files.flag,
        True,
        meaning="fit the mean scale of each axis, too; false: only the squarenesses, beside COMP_FILEs, which have the scale",
    )


@dataclass(frozen=True)
class Matrix:
    """The matrix of the kinematics, shape (3, 3): joint positions are ``matrix @ axis positions``."""

    matrix: FloatArray


class LinuxcncMatrixkins(LinearControl[MatrixkinsSettings, Matrix]):
    """``linuxcnc-matrixkins``: the parameters C_xx ... C_zz of the kinematics module of LinuxCNC."""

    name = "linuxcnc-matrixkins"
    settings_class = MatrixkinsSettings
    comment, decimals, moved = "#", 12, "XYZ"
    KEYS = tuple(f"{row}{column}" for row in "xyz" for column in "xyz")

    def __init__(self, machine: Machine, settings: MatrixkinsSettings | None = None) -> None:
        super().__init__(machine, settings)
        first = (1, 0) if machine.squareness_reference == "Y" else (0, 1)
        scales = ((0, 0), (1, 1), (2, 2)) if self.settings.scales else ()
        self.shears = (first, (0, 2), (1, 2), *scales)

    def shifted(self, factors: Matrix, position_mm: FloatArray) -> FloatArray:
        """Apply ``kinematicsInverse`` of src/hal/components/matrixkins.comp."""
        return np.asarray(position_mm @ factors.matrix.T)

    def limits_of(self, letter: str) -> str:
        """Return the limits of the joints: those of the axes stay."""
        return f"[JOINT_{AXES.index(letter)}] MIN_LIMIT ... MAX_LIMIT"

    def factors_for(self, slopes: Mapping[tuple[int, int], float]) -> Matrix:
        """Return the identity with the slopes added."""
        matrix = np.eye(3)
        for key, slope in slopes.items():
            matrix[key] += slope
        return Matrix(matrix)

    def factors_from(self, values: Mapping[str, float]) -> Matrix:
        """Return the matrix of nine numbers; one that a file does not set is that of the identity."""
        start = dict(zip(self.KEYS, np.eye(3).ravel().tolist(), strict=True)) | dict(values)
        return Matrix(np.array([start[key] for key in self.KEYS]).reshape(3, 3))

    def required_keys(self) -> tuple[str, ...]:
        """Return all nine: the module keeps what is not set at its start value, or at that of an old file."""
        return self.KEYS

    def shown(self, factors: Matrix) -> dict[str, float]:
        """Return the nine numbers by their letters."""
        return dict(zip(self.KEYS, factors.matrix.ravel().tolist(), strict=True))

    def largest(self, factors: Matrix) -> float:
        """Return the largest difference from the identity."""
        return float(np.abs(factors.matrix - np.eye(3)).max())

    def rounded(self, factors: Matrix) -> Matrix:
        """Return the matrix with the decimals of the file."""
        words = [float(fixed(value, self.decimals)) for value in factors.matrix.ravel().tolist()]
        return Matrix(np.array(words).reshape(3, 3))

    def words_of(self, source: SourceFile, strict: bool) -> Iterator[tuple[int, str, str]]:
        """Yield the numbers of lines such as ``setp matrixkins.C_xy 0.0029``; other lines of a HAL file are passed over."""
        lines = content_lines(source, self.comment) if strict else list(enumerate(source.text.splitlines(), start=1))
        for line, raw in lines:
            text = raw.partition(self.comment)[0].strip()
            found = re.fullmatch(r"setp\s+matrixkins\.C_([xyz]{2})\s+(\S{1,40})", text)
            if found:
                yield line, found.group(1), found.group(2)
            elif strict or "matrixkins.C_" in text:
                raise source.fail(f"expected setp matrixkins.C_xx ... C_zz with a number, got {text[:40]!r}", line)

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[Matrix, list[str]]:
        """Read the matrix from HAL files with anything else in them; a number that is not set is that of the identity."""
        text = "\n".join(source.text for source in files)
        absent = [key for key in self.KEYS if f"matrixkins.C_{key}" not in text]
        if len(absent) == len(self.KEYS):
            return super().parse_foreign(files)  # which says what is missing
        filled = "".join(f"setp matrixkins.C_{key} {float(key[0] == key[1]):g}\n" for key in absent)
        before = [SourceFile(files[0].path, filled)] if filled else []
        matrix, remarks = super().parse_foreign([*before, *files])
        if absent:
            names = ", ".join(f"C_{key}" for key in absent)
            remarks.append(f"{names}: not set, so 1 in the diagonal and 0 beside it, as at the start of the module")
        return matrix, remarks

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Say what of the curves stays."""
        if not errors.curves:
            return []
        held = "squareness and the mean scale of each axis" if self.settings.scales else "squareness"
        return [
            f"a matrix holds {held}: all else of the curves ({', '.join(errors.curves)}) stays as it is; "
            "linuxcnc-comp holds positioning, linuxcnc-volumetric all of it"
        ]
