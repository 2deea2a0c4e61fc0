"""What controls keep about rotary axes: where an axis line lies and how it points, as numbers with a name.

A control believes in a machine whose axes have no errors; its transformation (RTCP, TCPC, TRAORI, trt kinematics) turns tips
into positions of X, Y, Z with the axis lines that its parameters state. So a target is a pair of functions between the axis
lines of such a machine and the numbers of the control, and a text for them. Axis lines here are relative to the gauge point of
the spindle with all axes at zero: points of the machine file minus its tool offset.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.machine import MM_PER_UNIT, ROTARY, Machine, Vector3
from compgen.data.names import AXES
from compgen.errors import InputError, nearest

#: Largest difference from a direction that a control takes for granted, and smallest number that counts.
_SAME = 1e-6
Numbers = Mapping[str, float]
Lines = Mapping[str, tuple[FloatArray, FloatArray]]  # by letter: point and direction of an axis line, each (3,)


def table_axes(machine: Machine) -> tuple[str, ...]:
    """Rotary axes that carry the workpiece, from the foundation outwards."""
    return tuple(letter for letter, tool_side in machine.chain.passed if letter in ROTARY and not tool_side)


def head_axes(machine: Machine) -> tuple[str, ...]:
    """Rotary axes that carry the tool, from the foundation outwards."""
    return tuple(reversed([letter for letter, tool_side in machine.chain.passed if letter in ROTARY and tool_side]))


def lines_of(machine: Machine) -> Lines:
    """Axis lines of a machine relative to its gauge point."""
    gauge = np.array(machine.tool_offset_mm)
    return {
        letter: (np.array(axis.point_mm) - gauge, np.array(axis.direction)) for letter, axis in machine.rotary.items()
    }


def with_lines(machine: Machine, lines: Lines) -> Machine:
    """Return the machine with other axis lines."""
    gauge = np.array(machine.tool_offset_mm)
    rotary = {}
    for letter, axis in machine.rotary.items():
        point, direction = lines.get(letter, (np.array(axis.point_mm) - gauge, np.array(axis.direction)))
        rotary[letter] = replace(axis, point_mm=_vector(point + gauge), direction=_vector(direction))
    return replace(machine, rotary=rotary)


def _vector(values: FloatArray) -> Vector3:
    x, y, z = (float(value) for value in values)
    return x, y, z


#: A number as each kind of control writes it: a pin of LinuxCNC, a datum of a toolholder, a parameter of FANUC.
SETP = r"setp\s++(?P<name>[\w.-]++)\s++(?P<value>\S++)"
CARRIER = r"(?P<name>\$TC_CARR\d++\[\d++\])\s*+=\s*+(?P<value>\S++)"
PARAMETER = r"(?P<name>N\d{5})\s*+(?:Q1\s*+)?+(?:L1\s*+)?+P(?P<value>\S++)"


@dataclass(frozen=True)
class Target:
    """Parameters of one control for machines of one kind.

    Parameters
    ----------
    name, title : as ``--controller``, and in words.
    file : name of the file that is written.
    numbers : the control's numbers (mm, or without unit) for axis lines.
    lines : axis lines for the control's numbers, from those of the machine where the control has none.
    free : components that the numbers express: letter, "point" or "direction", component.
    line, pattern : how a number is written, and read: name and value are its groups.
    digits : decimals of a length that are written.
    before, after : lines of the file around the numbers.
    stated : what is said of signs and meaning: "documented", "inferred" or "unknown", and the statement.
    sense : what the control calls +1 degree of each axis, relative to the machine file (ISO 841).
    """

    name: str
    title: str
    file: str
    numbers: Callable[[Lines], dict[str, float]]
    lines: Callable[[Numbers, Lines], dict[str, tuple[FloatArray, FloatArray]]]
    free: tuple[tuple[str, str, int], ...]
    line: str
    pattern: str
    digits: int
    stated: tuple[tuple[str, str], ...]
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()
    sense: Mapping[str, float] = field(default_factory=dict)
    unitless: tuple[str, ...] = ()

    def text(self, machine: Machine, numbers: Numbers) -> str:
        """The text of the file, in the unit of the machine."""
        unit = MM_PER_UNIT[machine.units]
        rows = []
        for name, value in numbers.items():
            digits = self._digits(name)
            shown = round(value if name in self.unitless else value / unit, digits) + 0.0  # no -0
            rows.append(self.line.format(name=name, value=f"{shown:.{digits}f}"))
        return "\n".join([*self.before, *rows, *self.after]) + "\n"

    def _digits(self, name: str) -> int:
        return 9 if name in self.unitless else self.digits

    def parse(self, machine: Machine, text: str, path: Path) -> dict[str, float]:
        """The numbers of a file, mm; every one must be there once, and any other line that sets something is refused."""
        unit, wanted = MM_PER_UNIT[machine.units], list(self.numbers(lines_of(machine)))
        found: dict[str, float] = {}
        for number, line in enumerate(text.splitlines(), start=1):
            plain = line.split("#")[0].split(";")[0].strip()
            if not plain or plain in ("%", *(row.strip() for row in (*self.before, *self.after))):
                continue
            match = re.fullmatch(self.pattern, plain)
            if match is None or match["name"] not in wanted:
                what = (
                    nearest(match["name"], wanted)
                    if match
                    else f"expected {self.line.format(name=wanted[0], value='1.5')!r}"
                )
                raise InputError(f"{plain[:60]!r} is not understood; {what}", file=path, line=number)
            name = match["name"]
            if name in found:
                raise InputError(f"{name} is given a second time", file=path, line=number)
            value = _number(match["value"], path, number)
            found[name] = value * (1.0 if name in self.unitless else unit)
        missing = [name for name in wanted if name not in found]
        if missing:
            raise InputError(f"lacks {', '.join(missing)}; is the file whole?", file=path)
        return found


def _number(text: str, path: Path, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value) or abs(value) > 1e6:
        raise InputError(f"{text[:40]!r} is no length", file=path, line=line)
    return value


# LinuxCNC: kinematics modules with their pins.


@dataclass(frozen=True)
class TrtSettings:
    """Settings of ``linuxcnc-trt``."""

    conventional_directions: bool = toml_files.setting(
        toml_files.flag,
        meaning="true: A, B, C of the control turn as in ISO 841 and in machine files (pin conventional-directions, LinuxCNC "
        "after 2.9); false: its default, each the other way round",
    )


def _straight(machine: Machine, name: str) -> None:
    """Refuse directions that a control takes for granted to be those of the letters."""
    for letter, axis in machine.rotary.items():
        if abs(axis.direction[ROTARY.index(letter)] - 1.0) > _SAME:
            raise InputError(
                f"{name} has no parameter for the direction of {letter}, {list(axis.direction)}; it turns about "
                f"{AXES[ROTARY.index(letter)]} there",
                file=machine.source,
                field=f"axes.{letter}",
            )


def _unfit(machine: Machine, name: str, needs: str) -> InputError:
    return InputError(f"chain {machine.chain.name} is not one of {name}: {needs}", file=machine.source, field="chain")


def _linuxcnc_trt(machine: Machine) -> Target:
    """``xyzac-trt-kins`` and ``xyzbc-trt-kins``: a table C on a tilting table A or B."""
    on_table, name = table_axes(machine), "linuxcnc-trt"
    if head_axes(machine) or on_table not in (("A", "C"), ("B", "C")) or not machine.chain.name.startswith("WC"):
        raise _unfit(
            machine, name, "it needs the table C on the tilting table A (WCA...) or B (WCB...), and no rotary head"
        )
    if not machine.chain.name.startswith(f"WC{on_table[0]}"):
        raise _unfit(machine, name, "no linear axis may be between C and the tilting table")
    _straight(machine, name)
    section = machine.controller_settings(name)
    if "conventional_directions" not in section.data:
        raise section.fail(
            "conventional_directions",
            "is missing: LinuxCNC turns A, B, C of trt kinematics the other way round than ISO 841 unless its pin "
            "conventional-directions is 1 (LinuxCNC after 2.9 has it). State true if that pin is 1, else false; a wrong one "
            "doubles the error",
            kind="missing",
        )
    settings = toml_files.read_settings(TrtSettings, section)
    tilting = on_table[0]
    module, across = f"xyz{tilting.lower()}c-trt-kins", 1 if tilting == "A" else 0

    def numbers(lines: Lines) -> dict[str, float]:
        tilt, table = lines[tilting][0], lines["C"][0]
        apart = tilt - table
        offsets = [0.0, 0.0, apart[2]]
        offsets[across] = apart[across]
        names = (
            *(f"{module}.{axis.lower()}-rot-point" for axis in AXES),
            *(f"{module}.{axis.lower()}-offset" for axis in AXES),
        )
        return dict(zip(names, [*table.tolist(), *offsets], strict=True))

    def lines(found: Numbers, usual: Lines) -> dict[str, tuple[FloatArray, FloatArray]]:
        table = np.array([found[f"{module}.{axis.lower()}-rot-point"] for axis in AXES])
        tilt = usual[tilting][0].copy()
        tilt[across] = table[across] + found[f"{module}.{AXES[across].lower()}-offset"]
        tilt[2] = table[2] + found[f"{module}.z-offset"]
        return {tilting: (tilt, usual[tilting][1]), "C": (table, usual["C"][1])}

    turned = settings.conventional_directions
    pin = f"setp {module}.conventional-directions {int(turned)}"
    return Target(
        name=name,
        title=f"LinuxCNC, {module}: places of the axis lines",
        file="trt.hal",
        numbers=numbers,
        lines=lines,
        free=(("C", "point", 0), ("C", "point", 1), (tilting, "point", across), (tilting, "point", 2)),
        line="setp {name} {value}",
        pattern=SETP,
        digits=6,
        stated=(
            (
                "documented",
                "places and offsets: source of LinuxCNC (trtfuncs.c), compared with its own module by calling it",
            ),
            (
                "documented",
                f"conventional-directions = {str(turned).lower()}: A, B, C of the control are "
                + ("those of the machine file" if turned else "minus those of the machine file: its default"),
            ),
        ),
        before=(
            f"# {module}: places of the rotary axes of {machine.name}; read after loadrt {module}",
            f"# unit: {machine.units}; the pin {module}.tool-offset stays connected to motion.tooloffset.z",
            *(
                (pin,)
                if turned
                else (f"# without the pin conventional-directions, or with 0: {tilting} and C turn against ISO 841",)
            ),
        ),
        sense=dict.fromkeys((tilting, "C"), 1.0 if turned else -1.0),
    )


def _linuxcnc_tdr(machine: Machine) -> Target:
    """``xyzab_tdr_kins``: a table A on a tilting table B."""
    name, module = "linuxcnc-tdr", "xyzab_tdr_kins"
    if head_axes(machine) or not machine.chain.name.startswith("WAB") or len(machine.rotary) != 2:
        raise _unfit(machine, name, "it needs the table A on the table B (WAB...), and no rotary head")
    _straight(machine, name)

    def numbers(lines: Lines) -> dict[str, float]:
        inner, outer = lines["A"][0], lines["B"][0]
        values = (outer[0], inner[1], outer[2], inner[2] - outer[2])
        names = ("x-rot-point", "y-rot-point", "z-rot-point", "z-offset")
        return {f"{module}.{key}": float(value) for key, value in zip(names, values, strict=True)}

    def lines(found: Numbers, usual: Lines) -> dict[str, tuple[FloatArray, FloatArray]]:
        x, y, z, offset = (
            found[f"{module}.{key}"] for key in ("x-rot-point", "y-rot-point", "z-rot-point", "z-offset")
        )
        inner, outer = usual["A"][0].copy(), usual["B"][0].copy()
        inner[1:], outer[0], outer[2] = (y, z + offset), x, z
        return {"A": (inner, usual["A"][1]), "B": (outer, usual["B"][1])}

    return Target(
        name=name,
        title=f"LinuxCNC, {module}: places of the axis lines",
        file="tdr.hal",
        numbers=numbers,
        lines=lines,
        free=(("B", "point", 0), ("B", "point", 2), ("A", "point", 1), ("A", "point", 2)),
        line="setp {name} {value}",
        pattern=SETP,
        digits=6,
        stated=(("documented", "source of LinuxCNC (xyzab_tdr_kins.comp), compared with its own module by calling it: A and B "
                 "turn as in ISO 841"),),
        before=(
            f"# {module}: places of the rotary axes of {machine.name}; they act in kinematics type 1",
            f"# unit: {machine.units}; the pin {module}.tool-offset-z stays connected to motion.tooloffset.z",
        ),
        sense={"A": 1.0, "B": 1.0},
    )  # fmt: skip


def _linuxcnc_5axis(machine: Machine) -> Target:
    """``5axiskins``: a fork head, B on C, with the pivot length."""
    name, module = "linuxcnc-5axis", "5axiskins"
    if table_axes(machine) or head_axes(machine) != ("C", "B") or not machine.chain.name.endswith("CBT"):
        raise _unfit(machine, name, "it needs a head with B on C (...CBT), and no rotary table")
    _straight(machine, name)
    pin = "compgen-pivot.in1"
    return Target(
        name=name,
        title="LinuxCNC, 5axiskins: pivot length",
        file="pivot.hal",
        numbers=lambda lines: {pin: float(lines["B"][0][2])},
        lines=lambda found, usual: {
            "B": (np.array([0.0, usual["B"][0][1], found[pin]]), usual["B"][1]),
            "C": (np.array([0.0, 0.0, usual["C"][0][2]]), usual["C"][1]),
        },
        free=(("B", "point", 2),),
        line="setp {name} {value}",
        pattern=SETP,
        digits=6,
        stated=(
            (
                "documented",
                "source of LinuxCNC (5axiskins.c), compared with its own module by calling it: C turns as in ISO 841",
            ),
            (
                "documented",
                "B of the control is minus B of the machine file; B and C intersect in the spindle axis for the control",
            ),
        ),
        before=(
            f"# 5axiskins: pivot length of {machine.name}, B axis to gauge point of the spindle, plus the tool length",
            f"# unit: {machine.units}; replaces the connection of {module}.pivot-length; read after loadrt {module}",
            "loadrt sum2 names=compgen-pivot",
            "addf compgen-pivot servo-thread",
        ),
        after=(
            "net compgen-tool-length motion.tooloffset.z => compgen-pivot.in0",
            f"net compgen-pivot-length compgen-pivot.out => {module}.pivot-length",
        ),
        sense={"B": -1.0, "C": 1.0},
    )


# SINUMERIK: orientable toolholder ($TC_CARR), and FANUC: parameters 19700 to 19714.


def _across(letters: tuple[str, ...], lines: Lines, what: tuple[str, ...]) -> tuple[tuple[str, str, int], ...]:
    """Components across each axis: the two that are least along its direction."""
    found = []
    for letter in letters:
        along = int(np.argmax(np.abs(lines[letter][1])))
        found += [(letter, kind, k) for kind in what for k in range(3) if k != along]
    return tuple(found)


def _siemens_toolcarrier(machine: Machine) -> Target:
    """``$TC_CARR1`` to ``$TC_CARR23`` of the orientable toolholder: vectors I1 to I4, V1, V2."""
    name, on_head, on_table = "siemens-toolcarrier", head_axes(machine), table_axes(machine)
    kind = {(2, 0): "T", (0, 2): "P", (1, 1): "M", (1, 0): "T", (0, 1): "P"}.get((len(on_head), len(on_table)))
    if kind is None:
        raise _unfit(machine, name, "it needs one or two rotary axes")
    first, second = ((*on_head, *on_table) + (None,))[:2]
    side = {letter: 1.0 if letter in on_head else -1.0 for letter in machine.rotary}
    number = 1

    def key(start: int, k: int) -> str:
        return f"$TC_CARR{start + k}[{number}]"

    def numbers(lines: Lines) -> dict[str, float]:
        zero = np.zeros(3)
        one, two = lines[str(first)][0], zero if second is None else lines[second][0]
        if kind == "T":
            i3, i2 = (two, one - two) if second is not None else (one, zero)
            vectors = {1: -(i2 + i3), 4: i2, 15: i3, 18: zero}
        elif kind == "P":
            i2, i3 = one, two - one if second is not None else zero
            vectors = {1: zero, 4: i2, 15: i3, 18: -(i2 + i3)}
        else:
            vectors = {1: -one, 4: one, 15: two, 18: -two}
        turned = {7: side[str(first)] * lines[str(first)][1]}
        turned |= {} if second is None else {10: side[second] * lines[second][1]}
        return {
            key(start, k): float(vector[k]) for start, vector in sorted({**vectors, **turned}.items()) for k in range(3)
        }

    def lines(found: Numbers, usual: Lines) -> dict[str, tuple[FloatArray, FloatArray]]:
        def vector(start: int) -> FloatArray:
            return np.array([found[key(start, k)] for k in range(3)])

        i2, i3 = vector(4), vector(15)
        if kind == "T":
            one, two = (i3 + i2, i3) if second is not None else (i3, None)
        elif kind == "P":
            one, two = i2, i2 + i3
        else:
            one, two = i2, i3
        result = {str(first): (one, side[str(first)] * vector(7))}
        if second is not None and two is not None:
            result[second] = (two, side[second] * vector(10))
        return result

    order = tuple(str(letter) for letter in (first, second) if letter is not None)
    return Target(
        name=name,
        title=f"SINUMERIK, orientable toolholder, type {kind}: vectors I1 to I4 and V1, V2",
        file="TOOLCARRIER.SPF",
        numbers=numbers,
        lines=lines,
        free=_across(order, lines_of(machine), ("point", "direction")),
        line="{name}={value}",
        pattern=CARRIER,
        digits=6,
        stated=(
            ("documented", f"which vector is which, type {kind}, closed chain, and that V of a table axis is reversed "
             "(commissioning manual SINUMERIK Operate, swivel data)"),
            ("inferred", "I2 and I3 of a head lead from the tool adapter towards the machine, those of a table from machine zero "
             "towards the table; the manual says from where to where, and gives no worked number"),
            ("unknown", "fine offsets $TC_CARR41 to 60 are taken as zero; with kinematic chains ($NK_) other data may hold"),
        ),
        before=(
            f"; orientable toolholder of {machine.name}; lengths in {machine.units}",
            f"$TC_CARR23[{number}]=\"{kind}\"",
        ),
        after=("M17",),
        sense=dict.fromkeys(order, 1.0),
        unitless=tuple(key(start, k) for start in (7, 10) for k in range(3)),
    )  # fmt: skip


def _fanuc_5axis(machine: Machine) -> Target:
    """FANUC parameters 19700 to 19714: rotary table position and intersection offsets."""
    name, on_head, on_table = "fanuc-5axis", head_axes(machine), table_axes(machine)
    kind = {(2, 0): 2, (0, 2): 12, (1, 1): 21}.get((len(on_head), len(on_table)))
    if kind is None:
        raise _unfit(
            machine, name, "parameter 19680 needs two rotary axes: two of the tool, two of the table, or one of each"
        )
    _straight(machine, name)
    order = (*on_head, *on_table)
    first, second = order

    def numbers(lines: Lines) -> dict[str, float]:
        one, two = lines[first][0], lines[second][0]
        starts = {
            2: {19709: two, 19712: one - two},
            12: {19700: one, 19703: two - one},
            21: {19700: two, 19709: one},
        }[kind]
        return {f"N{start + k}": float(vector[k]) for start, vector in sorted(starts.items()) for k in range(3)}

    def lines(found: Numbers, usual: Lines) -> dict[str, tuple[FloatArray, FloatArray]]:
        def vector(start: int) -> FloatArray:
            return np.array([found[f"N{start + k}"] for k in range(3)])

        if kind == 2:
            one, two = vector(19709) + vector(19712), vector(19709)
        elif kind == 12:
            one, two = vector(19700), vector(19700) + vector(19703)
        else:
            one, two = vector(19709), vector(19700)
        return {first: (one, usual[first][1]), second: (two, usual[second][1])}

    return Target(
        name=name,
        title=f"FANUC, 5-axis machining, parameter 19680 = {kind}: rotary table position and intersection offset vectors",
        file="FIVEAXIS.PRM",
        numbers=numbers,
        lines=lines,
        free=_across(order, lines_of(machine), ("point",)),
        line="{name}P{value}",
        pattern=PARAMETER,
        digits=3 if machine.units == "mm" else 4,
        stated=(
            ("documented", "from which point to which each vector leads (additional manual of the 30i, tool center point "
             "control)"),
            ("documented", "19684 and 19689: 0 for an axis of the tool, 1 for one of the table, if it turns as in ISO 841"),
            ("inferred", "the rotary table position is counted from machine zero to the gauge point of the spindle (19666 = 0)"),
            ("unknown", "increment system IS-B is assumed; pocket parameters of the machine builder are not looked at"),
        ),
        before=("%",),
        after=("%",),
        sense=dict.fromkeys(order, 1.0),
    )  # fmt: skip


TARGETS: Mapping[str, Callable[[Machine], Target]] = {
    "linuxcnc-trt": _linuxcnc_trt,
    "linuxcnc-tdr": _linuxcnc_tdr,
    "linuxcnc-5axis": _linuxcnc_5axis,
    "siemens-toolcarrier": _siemens_toolcarrier,
    "fanuc-5axis": _fanuc_5axis,
}


#: What each target is, for lists.
ABOUT: Mapping[str, Mapping[str, str]] = {
    "linuxcnc-trt": {
        "title": "LinuxCNC, trt kinematics (xyzac, xyzbc): rotary table on a tilting table",
        "expresses": "two places of the C line, two of the tilting line (mm); no tilts, no zeros",
        "evidence": "documented",
        "file": "trt.hal",
        "settings": "[controllers.linuxcnc-trt] conventional_directions = true or false, mandatory",
    },
    "linuxcnc-tdr": {
        "title": "LinuxCNC, xyzab_tdr_kins: table A on a tilting table B",
        "expresses": "two places of each line (mm); no tilts, no zeros",
        "evidence": "documented",
        "file": "tdr.hal",
        "settings": "none",
    },
    "linuxcnc-5axis": {
        "title": "LinuxCNC, 5axiskins: fork head, B on C",
        "expresses": "the pivot length (mm)",
        "evidence": "documented",
        "file": "pivot.hal",
        "settings": "none",
    },
    "siemens-toolcarrier": {
        "title": "SINUMERIK, orientable toolholder $TC_CARR: vectors I1 to I4, V1, V2",
        "expresses": "places (mm) and directions of one or two axis lines; no zeros",
        "evidence": "documented, senses of I2 and I3 inferred",
        "file": "TOOLCARRIER.SPF",
        "settings": "none",
    },
    "fanuc-5axis": {
        "title": "FANUC, parameters 19700 to 19714: rotary table position, intersection offset vectors",
        "expresses": "places of two axis lines (mm, three decimals); no tilts, no zeros",
        "evidence": "documented, origin inferred",
        "file": "FIVEAXIS.PRM",
        "settings": "none",
    },
}


def target_of(machine: Machine, name: str) -> Target:
    """The target of a machine; InputError for a machine of another kind, or a setting that must be stated."""
    if not machine.rotary:
        raise InputError(
            f"{name} is for rotary axes; the machine {machine.name} has none", file=machine.source, field="chain"
        )
    return TARGETS[name](machine)


def believed(target: Target, machine: Machine, numbers: Numbers) -> Machine:
    """The machine that the control believes in with these numbers."""
    return with_lines(machine, target.lines(numbers, lines_of(machine)))


def as_written(target: Target, machine: Machine, numbers: Numbers) -> dict[str, float]:
    """Numbers as they are in the file, rounded, mm."""
    return target.parse(machine, target.text(machine, numbers), Path(target.file))
