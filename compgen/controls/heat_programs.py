"""Models of heat as programs of the control: synchronized actions of SINUMERIK, a function block for TwinCAT.

Both hold the same steps, every two seconds: lags follow the temperatures, the share of the hull, what heat has moved since the
first readings, and an offset that follows it at a limited rate. They are read back statement by statement, and run over a file of
temperatures as the control runs them.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from compgen.controls.heat_outputs import ALONG, HeatOutput, needed, rate_setting
from compgen.controls.shared.base import SourceFile
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.machine import MM_PER_UNIT
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import choice, setting
from compgen.errors import InputError
from compgen.heat import HeatModel, Temperatures

#: Period of the programs, s.
PERIOD_S = 2.0
Value = Callable[[dict[str, float]], float]


@dataclass(frozen=True)
class Words:
    """How a language writes a state, a sensor, an assignment, and its functions."""

    state: Callable[[int], str]
    sensor: Callable[[str], str]
    assign: str
    bound: Callable[[str, str, str], str]
    least: Callable[[str, str], str]


@dataclass(frozen=True)
class Steps:
    """Assignments at the start, and in each period."""

    begin: tuple[str, ...]
    each: tuple[str, ...]
    offsets: Mapping[str, str]


def steps_of(model: HeatModel, words: Words, rate: float, per_um: float) -> Steps:
    """The steps of a model; ``per_um`` is what 1 um of displacement asks for in the unit of the offset, ``rate`` units/s."""
    count = len(model.terms)
    states = [words.state(k) for k in range(count)]
    zeros = [words.state(count + k) for k in range(count)]
    share = words.state(2 * count)
    starts = [words.sensor(t.start if t.lag_s else t.sensor) for t in model.terms]
    begin = [f"{state}{words.assign}{start}" for state, start in zip(states, starts, strict=True)]
    begin += [f"{zero}{words.assign}{start}" for zero, start in zip(zeros, starts, strict=True)]
    each = []
    for term, state in zip(model.terms, states, strict=True):
        read = words.sensor(term.sensor)
        part = -np.expm1(-PERIOD_S / term.lag_s) if term.lag_s else 1.0
        each.append(
            f"{state}{words.assign}{state}+({read}-{state})*{part:.9f}"
            if term.lag_s
            else f"{state}{words.assign}{read}"
        )
    each.append(f"{share}{words.assign}1.0")
    for item in model.hull:
        value = words.sensor(item.sensor) + (f"-{words.sensor(item.minus)}" if item.minus else "")
        for beyond in (f"{item.low:.4f}-({value})", f"{value}-({item.high:.4f})"):
            inside = words.bound("0.0", "1.0", f"1.0-({beyond})/{item.margin_k:.4f}")
            each.append(f"{share}{words.assign}{words.least(share, inside)}")
    offsets = {}
    for k, axis in enumerate(axis for axis in AXES if ALONG[axis] in model.directions):
        target, offset = words.state(2 * count + 1 + 2 * k), words.state(2 * count + 2 + 2 * k)
        moved = "".join(
            f"{per_um * term.per_k.get(ALONG[axis], 0.0):+.9f}*({state}-{zero})"
            for term, state, zero in zip(model.terms, states, zeros, strict=True)
        )
        step = f"{rate * PERIOD_S:.9f}"
        each.append(f"{target}{words.assign}({moved.removeprefix('+')})*{share}")
        each.append(f"{offset}{words.assign}{offset}+{words.bound(f'-{step}', step, f'{target}-{offset}')}")
        begin.append(f"{offset}{words.assign}0.0")
        offsets[axis] = offset
    return Steps(tuple(begin), tuple(each), offsets)


# Reading: an expression of a control as a function of its variables.

_FUNCTIONS: Mapping[str, Callable[..., float]] = {
    "BOUND": lambda low, high, value: min(max(value, low), high),
    "LIMIT": lambda low, value, high: min(max(value, low), high),
    "MINVAL": min,
    "MIN": min,
}
_OPERATORS: Mapping[type, Callable[[float, float], float]] = {
    ast.Add: lambda a, b: a + b,
    ast.Sub: lambda a, b: a - b,
    ast.Mult: lambda a, b: a * b,
    ast.Div: lambda a, b: a / b,
}


def _value_of(node: ast.expr) -> Value:
    """A function of the variables for a node; ValueError for anything but arithmetic and the known functions."""
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        number = float(node.value)
        return lambda _: number
    if isinstance(node, ast.Name):
        name = node.id
        return lambda known: known[name]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        inner, sign = _value_of(node.operand), -1.0 if isinstance(node.op, ast.USub) else 1.0
        return lambda known: sign * inner(known)
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        act, left, right = _OPERATORS[type(node.op)], _value_of(node.left), _value_of(node.right)
        return lambda known: act(left(known), right(known))
    if (
        isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in _FUNCTIONS
        and not node.keywords
    ):
        function, given = _FUNCTIONS[node.func.id], [_value_of(item) for item in node.args]
        return lambda known: function(*(item(known) for item in given))
    raise ValueError("not arithmetic")


def _without_comments(line: str) -> str:
    """Return a line of structured text without its comments (* ... *), in one pass."""
    kept, at = [], 0
    while (begin := line.find("(*", at)) >= 0 and (end := line.find("*)", begin + 2)) >= 0:
        kept.append(line[at:begin])
        at = end + 2
    return "".join([*kept, line[at:]])


_VARIABLE = re.compile(r"(?<![\w$])\$?\$?[A-Z]++_\w++\[\w++\]")


def _as_name(variable: str) -> str:
    return "v" + "".join(char if char.isalnum() else f"_{ord(char):02x}_" for char in variable)


@dataclass(frozen=True)
class Statement:
    """``target`` becomes ``value``; ``line`` of the file."""

    target: str
    value: Value
    line: int


def statement(source: SourceFile, line: int, target: str, expression: str) -> Statement:
    """Read one assignment; variables with an index are names, too."""
    plain = _VARIABLE.sub(lambda match: _as_name(match[0]), expression)
    try:
        return Statement(_as_name(target) if _VARIABLE.fullmatch(target) else target,
                         _value_of(ast.parse(plain.strip(), mode="eval").body), line)  # fmt: skip
    except (SyntaxError, ValueError, RecursionError):
        raise source.fail(f"{expression[:60]!r} is not understood", line) from None


@dataclass(frozen=True)
class HeatProgram:
    """Statements of a control: at the start, in each period; where each sensor is read and each offset goes (mm per unit)."""

    source: SourceFile
    begin: tuple[Statement, ...]
    each: tuple[Statement, ...]
    sensors: Mapping[str, tuple[str, float]]
    offsets: Mapping[str, tuple[str, float]]

    def added(self, temperatures: Temperatures) -> FloatArray:
        """Run the program every two seconds over temperatures: what it adds to the commands at each reading, mm, (n, 3)."""
        needed(temperatures, tuple(self.sensors))
        time_s = temperatures.time_s
        ticks = np.arange(time_s[0], time_s[-1] + PERIOD_S, PERIOD_S)
        read = {
            name: (np.interp(ticks, time_s, temperatures.celsius[sensor]) / scale).tolist()
            for sensor, (name, scale) in self.sensors.items()
        }
        found = np.zeros((len(ticks), 3))
        known: dict[str, float] = {name: 0.0 for name, _ in self.offsets.values()}
        for k in range(len(ticks)):
            for name, values in read.items():
                known[name] = values[k]
            for item in (*self.begin, *self.each) if k == 0 else self.each:
                try:
                    known[item.target] = item.value(known)
                except KeyError as error:
                    raise self.source.fail(f"uses {error.args[0]}, which has no value before", item.line) from None
                except ZeroDivisionError:
                    raise self.source.fail("divides by zero", item.line) from None
            for axis, (name, unit_mm) in self.offsets.items():
                found[k, AXES.index(axis)] = known[name] * unit_mm
        return np.stack([np.interp(time_s, ticks, column) for column in found.T], axis=1)


# SINUMERIK.

#: Where a synchronized action reads a temperature: a number of the PLC or an analog input, times or divided by a number.
_READ = re.compile(r"(\$A_(?:DBR|DBW|DBSW|INA)\[\d{1,4}\])(?:([*/])(\d+(?:\.\d+)?))?")


def _reads(value: object) -> dict[str, str]:
    """Variables by sensor."""
    found = toml_files.table(value)
    if not found or any(not isinstance(item, str) or not _READ.fullmatch(item) for item in found.values()):
        raise ValueError('expected where each sensor is read, e.g. { spindle = "$A_DBR[0]", bed = "$A_DBW[4]/10" }')
    return found


def _axis_names(value: object) -> dict[str, str]:
    found = toml_files.table(value)
    if any(
        axis not in AXES or not isinstance(name, str) or not re.fullmatch(r"[A-Z]\w{0,15}", name)
        for axis, name in found.items()
    ):
        raise ValueError('expected names of axes, e.g. { X = "AX1", Y = "AX2", Z = "AX3" }')
    return {**dict(zip(AXES, ("AX1", "AX2", "AX3"), strict=True)), **found}


def _numbers_of_axes(value: object) -> dict[str, int]:
    found = toml_files.table(value)
    if any(
        axis not in AXES or not isinstance(n, int) or isinstance(n, bool) or not 1 <= n <= 255
        for axis, n in found.items()
    ):
        raise ValueError("expected logical numbers of axes, e.g. { X = 1, Y = 2, Z = 3 }")
    return {**dict(zip(AXES, (1, 2, 3), strict=True)), **found}


def sign_setting(name: str) -> Any:
    """Declare ``sign``, which the documents leave open."""
    return setting(
        choice("error", "correction"),
        meaning=f"whether {name} takes what heat has moved (error), or what is added to the command (correction); mandatory: the "
        "documents leave it open. Try it as preflight.md says: a wrong one doubles the error",
    )


@dataclass(frozen=True)
class SiemensHeatSettings:
    """Settings of ``siemens-heat``."""

    sign: str = sign_setting("SD43900")
    temperatures: Mapping[str, str] = setting(
        _reads, meaning='where each sensor is read, degC: { spindle = "$A_DBR[0]" }'
    )
    axis_names: Mapping[str, str] | None = setting(
        _axis_names, None, meaning="machine axes; AX1, AX2, AX3 if not stated"
    )
    first_ids: int = setting(toml_files.whole(1, 200), 40, meaning="number of the first synchronized action")
    first_parameter: int = setting(toml_files.whole(0, 900), 20, meaning="number of the first $AC_PARAM")
    timer: int = setting(toml_files.whole(0, 99), 1, meaning="number of $AC_TIMER")
    rate_um_s: float = rate_setting()


_SIGNS = {"error": 1.0, "correction": -1.0}


@dataclass(frozen=True)
class SiemensHeat(HeatOutput):
    """Synchronized actions that write SD43900 $SA_TEMP_COMP_ABS_VALUE."""

    name: ClassVar[str] = "siemens-heat"
    settings_class: ClassVar[type[Any]] = SiemensHeatSettings
    read_files: ClassVar[tuple[str, ...]] = ("VOLHEAT.SPF",)

    @property
    def _axes(self) -> Mapping[str, str]:
        return self.settings.axis_names or _axis_names({})

    def _words(self) -> Words:
        own = self.settings
        return Words(
            lambda k: f"$AC_PARAM[{own.first_parameter + k}]",
            lambda name: own.temperatures[name],
            "=",
            lambda low, high, value: f"BOUND({low},{high},{value})",
            lambda a, b: f"MINVAL({a},{b})",
        )

    def files(self, model: HeatModel) -> dict[str, str]:
        """The subprogram that starts the actions."""
        missing = [name for name in model.sensors if name not in self.settings.temperatures]
        if missing:
            raise self.machine.controller_settings(self.name).fail(
                "temperatures", f"does not say where sensor {missing[0]} is read, which the model needs"
            )
        own, unit = self.settings, MM_PER_UNIT[self.machine.units]
        per_um = _SIGNS[own.sign] * MM_PER_UM / unit
        steps = steps_of(model, self._words(), own.rate_um_s * MM_PER_UM / unit, per_um)
        when = f"WHENEVER $AC_TIMER[{own.timer}]>={PERIOD_S:.1f} DO"
        rows = [f"WHEN TRUE DO {' '.join((*steps.begin, f'$AC_TIMER[{own.timer}]=0'))}"]
        rows += [f"{when} {item}" for item in steps.each]
        rows += [
            f"{when} $$SA_TEMP_COMP_ABS_VALUE[{self._axes[axis]}]={offset}" for axis, offset in steps.offsets.items()
        ]
        rows.append(f"{when} $AC_TIMER[{own.timer}]=0")
        head = [
            f"; thermal growth, sign {own.sign}, {self.machine.units}: start once after power on, e.g. from PROG_EVENT",
            *(f"; sensor {name} = {own.temperatures[name]}" for name in model.sensors),
            *(f"; axis {axis} = {self._axes[axis]}" for axis in steps.offsets),
        ]
        lines = [f"N{10 * (k + 1)} IDS={own.first_ids + k} {row}" for k, row in enumerate(rows)]
        return {"VOLHEAT.SPF": "\n".join([*head, *lines, "M17", ""])}

    def parse(self, sources: Sequence[SourceFile]) -> HeatProgram:
        """Read the subprogram: comments name sensors and axes, every other line is a synchronized action."""
        (source,) = sources
        begin: list[Statement] = []
        each: list[Statement] = []
        offsets: dict[str, tuple[str, float]] = {}
        unit = MM_PER_UNIT[self.machine.units]
        axes = {name: axis for axis, name in self._axes.items()}
        last = 0
        for number, line in enumerate(source.text.splitlines(), start=1):
            plain = line.split(";")[0].strip()
            if not plain or plain == "M17":
                continue
            match = re.fullmatch(r"N\d+ IDS=(\d+) (WHEN TRUE|WHENEVER \$AC_TIMER\[\d+\]>=2\.0) DO (.+)", plain)
            if match is None or int(match[1]) <= last:
                raise source.fail(
                    f"{plain[:60]!r} is no synchronized action of this program, in order of numbers", number
                )
            last = int(match[1])
            for target, value in re.findall(r"(?<![$\w])([$\w]++\[\w++\])=(\S++)", match[3]):
                if target.startswith("$AC_TIMER"):
                    continue
                if written := re.fullmatch(r"\$\$SA_TEMP_COMP_ABS_VALUE\[(\w+)\]", target):
                    if written[1] not in axes:
                        raise source.fail(f"{written[1]} is no axis of [controllers.{self.name}] axis_names", number)
                    offsets[axes[written[1]]] = _as_name(value), -_SIGNS[self.settings.sign] * unit
                    continue
                (begin if match[2] == "WHEN TRUE" else each).append(statement(source, number, target, value))
        if not offsets or not begin or "\nM17" not in source.text:
            raise source.fail("the program is not whole: it starts lags, writes offsets, and ends with M17")
        sensors = {}
        for name, text in self.settings.temperatures.items():
            variable, act, factor = _READ.fullmatch(text).groups()  # type: ignore[union-attr]
            scale = float(factor or 1.0)
            if f"; sensor {name} = {text}" in source.text:
                sensors[name] = _as_name(variable), 1 / scale if act == "/" else scale
        return HeatProgram(source, tuple(begin), tuple(each), sensors, offsets)

    def stated(self) -> tuple[tuple[str, str], ...]:
        """See :class:`HeatOutput`."""
        return (
            ("documented", "MD32750 bit 0 lets SD43900 act on an axis, whatever its position; MD32760 limits how fast (K3)"),
            ("documented", "setting data are written in the main run with $$; actions run in the order of their numbers (PGA)"),
            ("stated", f"sign = {self.settings.sign!r}: the manual draws an error line (error), and says "
            f"nowhere in words which way the "
             "axis goes"),
            ("unknown", "whether $AC_PARAM survive a reset on your control; if not, growth counts from the reset"),
            ("unknown", "that your software level takes BOUND and MINVAL in synchronized actions, and so many of them"),
        )  # fmt: skip

    def before_use(self, model: HeatModel) -> tuple[str, ...]:
        """See :class:`HeatOutput`."""
        own = self.settings
        axes = ", ".join(self._axes[axis] for axis in self.expressed(model))
        ids = f"{own.first_ids} to {own.first_ids + 99}"
        return (
            f"Set bit 0 of MD32750 $MA_TEMP_COMP_TYPE of {axes} (power on), and check the numbers IDS {ids} and $AC_PARAM from "
            f"{own.first_parameter} for use by others (MD28252, MD28254).",
            "SD43910 $SA_TEMP_COMP_SLOPE stays 0: growth of a scale is not in the model. MD32760 may stay as it is.",
            "Let the PLC write the temperatures in degC, and 0 offset where a sensor is broken: jumps and stuck "
            "sensors are not found "
            "here.",
            "Sign: with a dial indicator at rest, write 0.02 to SD43900 of one axis by hand. If the tool moves in the negative "
            'direction of the axis, sign is "error"; if in the positive, "correction". Write 0 again.',
            "Probe work offsets after the program was started: growth counts from its first readings.",
        )


# TwinCAT.


@dataclass(frozen=True)
class TwincatHeatSettings:
    """Settings of ``twincat-heat``."""

    sign: str = sign_setting("P-AXIS-00273")
    axis_numbers: Mapping[str, int] | None = setting(
        _numbers_of_axes, None, meaning="logical axis numbers; 1, 2, 3 if not stated"
    )
    rate_um_s: float = rate_setting()


#: Lines of a function block that calculate nothing.
_AROUND = re.compile(
    r"FUNCTION_BLOCK \w+|END_FUNCTION_BLOCK|VAR(_INPUT|_OUTPUT)?|END_VAR|\w+ : (BOOL|LREAL|DINT)( := FALSE)?;|begun := TRUE;"
)
#: Unit of P-AXIS-00273, um.
_TENTH_UM = 0.1


@dataclass(frozen=True)
class TwincatHeat(HeatOutput):
    """A function block that calculates P-AXIS-00273, and the lines of the axis lists."""

    name: ClassVar[str] = "twincat-heat"
    settings_class: ClassVar[type[Any]] = TwincatHeatSettings
    read_files: ClassVar[tuple[str, ...]] = ("FB_VolHeat.st",)

    @property
    def _axes(self) -> Mapping[str, int]:
        return self.settings.axis_numbers or _numbers_of_axes({})

    def files(self, model: HeatModel) -> dict[str, str]:
        """Function block and axis lines."""
        for name in model.sensors:
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
                raise InputError(f"sensor {name!r} cannot be a variable of a PLC; call it by letters, digits and _")
        own = self.settings
        words = Words(
            lambda k: f"s{k}",
            lambda name: f"temp_{name}",
            " := ",
            lambda low, high, value: f"LIMIT({low}, {value}, {high})",
            lambda a, b: f"MIN({a}, {b})",
        )
        steps = steps_of(model, words, own.rate_um_s / _TENTH_UM, _SIGNS[own.sign] / _TENTH_UM)
        used = sorted({int(found) for item in (*steps.begin, *steps.each) for found in re.findall(r"\bs(\d+)\b", item)})
        lines = [
            f"(* thermal growth, sign {own.sign}: call every two seconds; write the offsets by ADS to "
            f"TEMPC::offset_0 of the axes *)",
            "FUNCTION_BLOCK FB_VolHeat",
            "VAR_INPUT",
            *(f"  temp_{name} : LREAL; (* degC *)" for name in model.sensors),
            "END_VAR",
            "VAR_OUTPUT",
            *(f"  offset_{axis} : DINT; (* 0.1 um, axis {self._axes[axis]} *)" for axis in steps.offsets),
            "END_VAR",
            "VAR",
            "  begun : BOOL := FALSE;",
            *(f"  s{k} : LREAL;" for k in used),
            "END_VAR",
            "IF NOT begun THEN",
            *(f"  {item};" for item in steps.begin),
            "  begun := TRUE;",
            "END_IF",
            *(f"{item};" for item in steps.each),
            *(f"offset_{axis} := LREAL_TO_DINT({offset});" for axis, offset in steps.offsets.items()),
            "END_FUNCTION_BLOCK",
            "",
        ]
        rows = []
        for axis in steps.offsets:
            rows += [
                f"kopf.achs_nr                      {self._axes[axis]}",
                "lr_param.temp_comp                1",
                "lr_param.temp_comp_position_0     0",
                "lr_param.temp_comp_offset_0       0",
                "lr_param.temp_comp_coefficient    0",
            ]
        head = "# P-AXIS-00271 to 00274: take the lines into the list of each axis"
        return {"FB_VolHeat.st": "\n".join(lines), "volheat.lis": "\n".join([head, *rows, ""])}

    def parse(self, sources: Sequence[SourceFile]) -> HeatProgram:
        """Read the function block: declarations, the block that runs once, and assignments."""
        (source,) = sources
        begin: list[Statement] = []
        each: list[Statement] = []
        sensors: dict[str, tuple[str, float]] = {}
        offsets: dict[str, tuple[str, float]] = {}
        first, ended = False, False
        for number, line in enumerate(source.text.splitlines(), start=1):
            plain = _without_comments(line).strip()
            ended |= plain == "END_FUNCTION_BLOCK"
            if found := re.fullmatch(r"temp_(\w+) : LREAL;", plain):
                sensors[found[1]] = f"temp_{found[1]}", 1.0
            elif plain in ("IF NOT begun THEN", "END_IF"):
                first = plain.startswith("IF")
            elif found := re.fullmatch(r"offset_([XYZ]) := LREAL_TO_DINT\((\w+)\);", plain):
                offsets[found[1]] = found[2], -_SIGNS[self.settings.sign] * _TENTH_UM * MM_PER_UM
            elif found := re.fullmatch(r"(s\d+) := (.+);", plain):
                (begin if first else each).append(statement(source, number, found[1], found[2]))
            elif plain and not _AROUND.fullmatch(plain):
                raise source.fail(f"{plain[:60]!r} is not understood", number)
        if not (ended and begin and offsets and sensors):
            raise source.fail("the function block is not whole; export it again")
        return HeatProgram(source, tuple(begin), tuple(each), sensors, offsets)

    def stated(self) -> tuple[tuple[str, str], ...]:
        """See :class:`HeatOutput`."""
        return (
            ("documented", "P-AXIS-00271 switches it on, 00272 position and 00273 offset in 0.1 um, 00274 in "
            "um/m; it acts once the axis "
             "is referenced; the PLC may write them by ADS, task GEO, index group 0x120300 (TF5200)"),
            ("stated", f"sign = {self.settings.sign!r}: the document calls it the deviation at the reference "
            f"position (error), and says "
             "that the reference variable is corrected; it has no worked number"),
            ("unknown", "how fast the control takes up a new offset: here it changes by at most "
             f"{self.settings.rate_um_s:g} um/s"),
        )  # fmt: skip

    def before_use(self, model: HeatModel) -> tuple[str, ...]:
        """See :class:`HeatOutput`."""
        return (
            "Take the lines of volheat.lis into the axis lists, and FB_VolHeat into the PLC; call it every two seconds.",
            "Write each offset by ADS to TEMPC::offset_0 of its axis (its index offset stands in the "
            "documentation of your version).",
            "Let the PLC write 0 where a sensor is broken: jumps and stuck sensors are not found here.",
            "Sign: with a dial indicator at rest, write 200 (20 um) to the offset of one axis. If the tool moves in the negative "
            'direction of the axis, sign is "error"; if in the positive, "correction". Write 0 again.',
            "Probe work offsets after the block has begun: growth counts from its first call.",
        )
