"""Settings of the SINUMERIK tables: names of the axes, node distances, measuring systems, capacity, container."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import Any

from compgen.controllers.grids import take_loss_mm
from compgen.controllers.siemens.products import MULT_MODES
from compgen.controllers.siemens.profiles import take_cec_capacity, take_profile
from compgen.controllers.siemens.syntax import POSITION_QUANTUM_MM
from compgen.core import tomlio
from compgen.core.machine import Machine
from compgen.core.names import AXES

_NAME = re.compile(r"[A-Z_][A-Z0-9_]{0,31}")
#: No sentence of the vendor gives the sign; two independent traces lead to this one (``preflight.SIGN_TRACES``).
INFERRED_SIGN = "error"
_MODE_MISSING = (
    "is missing. With products = true the file multiplies tables, and no readable document says what the two factors do "
    "by themselves: a file made for another mode than that of the control leaves several times the error. Do the test "
    'with constants of the preflight list (sum 0.56: "S1", 0.06: "S2", 0.26: "S3", 0.36: "S4") and write e.g. '
    'mult_mode = "S1", or write products = false'
)
Encoders = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True)
class Container:
    """In which kind of file tables stand.

    Parameters
    ----------
    kind : ``"ini"`` (initialisation file with header, loaded as data) or ``"program"`` (sub-program that is run).
    enables : whether a program also switches the function on behind the tables.
    """

    kind: str = "ini"
    enables: bool = False


@dataclass(frozen=True)
class CecSettings:
    """Settings ``[controllers.siemens-cec]``.

    Parameters
    ----------
    sign : ``"error"`` (the control subtracts the sum) or ``"correction"`` (it adds it).
    sign_stated : False where the machine file does not say it and the inferred one is taken.
    mult_mode : S1 to S4, see :mod:`compgen.controllers.siemens.products`.
    mode_stated : False where the machine file does not say it: then no file with products is written or read.
    products : whether angular errors are exported as products of tables.
    axis_names : names of X, Y, Z on the control.
    axis_style : ``"paren"`` writes (AX1), ``"quote"`` writes "AX1".
    step_mm : node distances that the user asks for, or None.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    max_points : nodes that the control can hold per table.
    tables_available : tables that the control has, or None if that is not known.
    tables_reserved : tables of these that are kept free, e.g. for pairs of one direction.
    kept_tables : indices of tables of other axes, which are never written.
    max_sum_mm : MD32720 of X, Y, Z in mm, or None if that is not stated.
    max_velo_percent : MD32730 of X, Y, Z in % of MD32000, or None if that is not stated.
    max_speed_mm_min : MD32000 of X, Y, Z; only their ratio matters.
    container : kind of file.
    """

    sign: str
    sign_stated: bool
    mult_mode: str
    mode_stated: bool
    products: bool
    axis_names: tuple[str, str, str]
    axis_style: str
    step_mm: tuple[float | None, ...]
    loss_mm: float
    max_points: int
    tables_available: int | None
    tables_reserved: int
    kept_tables: tuple[int, ...]
    max_sum_mm: tuple[float, float, float] | None
    max_velo_percent: tuple[float, float, float] | None
    max_speed_mm_min: tuple[float, float, float]
    container: Container

    @property
    def subtracts(self) -> bool:
        """Whether the control subtracts the sum of the tables from the command."""
        return self.sign == "error"

    @property
    def tables_usable(self) -> int | None:
        """How many tables the errors may take, None if no number is known."""
        if self.tables_available is None:
            return None
        kept = sum(1 for index in self.kept_tables if index < self.tables_available)
        return max(self.tables_available - self.tables_reserved - kept, 1)


@dataclass(frozen=True)
class EecSettings:
    """Settings ``[controllers.siemens-eec]``.

    Parameters
    ----------
    encoders : for X, Y, Z the measuring systems that get a table: 0 is measuring system 1, 1 is measuring system 2.
    active : for X, Y, Z the one that the position control uses.
    axis_names : names of X, Y, Z on the control.
    step_mm : node distances that the user asks for, or None.
    loss_mm : loss by interpolation between nodes, as a displacement of the tool, that is worth no further node.
    max_points : nodes that the control can hold per axis and measuring system.
    max_points_known : False if that number is not documented for the model and not stated.
    decimals : digits after the point of the values in mm.
    container : kind of file.
    """

    encoders: Encoders
    active: tuple[int, int, int]
    axis_names: tuple[str, str, str]
    step_mm: tuple[float | None, ...]
    loss_mm: float
    max_points: int
    max_points_known: bool
    decimals: int
    container: Container


def take_cec_settings(section: tomlio.Section, machine: Machine) -> CecSettings:
    """Take the settings of CEC tables from a section; ``mult_mode`` is mandatory where ``products = true`` is stated.

    Without ``mult_mode`` and ``products`` no products are written: a wrong mode is worse than a wrong sign.
    """
    mode = section.take("mult_mode", tomlio.choice(*MULT_MODES), None)
    products = section.take("products", tomlio.flag, mode is not None)
    if products and mode is None:
        raise section.fail("mult_mode", _MODE_MISSING)
    max_points, tables_available = take_cec_capacity(section, take_profile(section))
    return CecSettings(
        sign=section.take("sign", tomlio.choice("error", "correction"), INFERRED_SIGN),
        sign_stated="sign" in section,
        mult_mode=mode or next(iter(MULT_MODES)),
        mode_stated=mode is not None,
        products=products,
        axis_names=take_axis_names(section),
        axis_style=section.take("axis_style", tomlio.choice("paren", "quote"), "paren"),
        step_mm=take_steps(section, machine, max_points),
        loss_mm=take_loss_mm(section),
        max_points=max_points,
        tables_available=tables_available,
        tables_reserved=section.take("tables_reserved", tomlio.whole(0, 1000), 0),
        kept_tables=section.take("kept_tables", _indices, ()),
        max_sum_mm=section.take("max_sum_mm", _per_axis, None),
        max_velo_percent=section.take("max_velo_percent", _per_axis, None),
        max_speed_mm_min=section.take("max_speed_mm_min", _per_axis, (1.0, 1.0, 1.0)),
        container=take_container(section),
    )


def take_eec_settings(section: tomlio.Section, machine: Machine, prefix: str = "") -> EecSettings:
    """Take the settings of encoder tables; ``prefix`` stands before the keys that CEC tables have as well."""
    profile = take_profile(section)
    max_points = section.take(f"{prefix}max_points", tomlio.whole(3, 100_000), profile.eec_nodes)
    encoders = section.take("encoder", _encoders, ((0,), (0,), (0,)))
    return EecSettings(
        encoders=encoders,
        active=_take_active(section, encoders),
        axis_names=take_axis_names(section),
        step_mm=take_steps(section, machine, max_points, f"{prefix}step_mm"),
        loss_mm=take_loss_mm(section),
        max_points=max_points,
        max_points_known=profile.eec_nodes_documented or f"{prefix}max_points" in section,
        decimals=section.take(f"{prefix}decimals", tomlio.whole(3, 9), 6),
        container=take_container(section),
    )


def take_container(section: tomlio.Section) -> Container:
    """Take ``container`` and ``program_enables``."""
    kind = section.take("container", tomlio.choice("ini", "program"), "ini")
    enables = section.take("program_enables", tomlio.flag, False)
    if enables and kind == "ini":
        raise section.fail("program_enables", 'needs container = "program": an INI file switches nothing on')
    return Container(kind, enables)


def _indices(value: Any) -> tuple[int, ...]:
    """A list of different indices of tables."""
    whole = tomlio.whole(0, 999)
    if not isinstance(value, list) or len({whole(item) for item in value}) != len(value):
        raise ValueError("a list of different table indices, e.g. [6, 7], is expected")
    return tuple(sorted(value))


def _per_axis(value: Any) -> tuple[float, float, float]:
    """One number above zero for all axes, or a table with X, Y and Z."""
    if isinstance(value, dict):
        if set(value) != set(AXES):
            raise ValueError("one number, or a table { X = ..., Y = ..., Z = ... }, is expected")
        x, y, z = (tomlio.positive(value[axis]) for axis in AXES)
        return x, y, z
    number = tomlio.positive(value)
    return number, number, number


def _encoders(value: Any) -> Encoders:
    """Measuring systems of the axes: 0 or 1, a list of both, or a table of these by axis (0 for one that is absent)."""
    if isinstance(value, dict):
        if not set(value) <= set(AXES):
            raise ValueError("0, 1, [0, 1], or a table of these with the keys X, Y, Z is expected")
        x, y, z = (_encoders_of_axis(value.get(axis, 0)) for axis in AXES)
        return x, y, z
    all_axes = _encoders_of_axis(value)
    return all_axes, all_axes, all_axes


def _encoders_of_axis(value: Any) -> tuple[int, ...]:
    items = value if isinstance(value, list) else [value]
    whole = all(isinstance(item, int) and not isinstance(item, bool) and item in (0, 1) for item in items)
    if not items or not whole or len(set(items)) != len(items):
        raise ValueError("0 (measuring system 1), 1 (measuring system 2) or [0, 1] is expected")
    return tuple(sorted(items))


def _take_active(section: tomlio.Section, encoders: Encoders) -> tuple[int, int, int]:
    """Take ``active_encoder``, one number or a table by axis; default the first one of each axis."""
    first = {letter: own[0] for letter, own in zip(AXES, encoders, strict=True)}
    stated = section.take("active_encoder", _encoders, None)
    found = []
    for axis, letter in enumerate(AXES):
        active = (first[letter],) if stated is None else stated[axis]
        if len(active) != 1 or active[0] not in encoders[axis]:
            raise section.fail(
                "active_encoder", f"one of the encoders of {letter}, {list(encoders[axis])}, is expected"
            )
        found.append(active[0])
    return found[0], found[1], found[2]


def take_axis_names(section: tomlio.Section) -> tuple[str, str, str]:
    """Take ``axis_names = { X = "AX1", ... }`` (default AX1, AX2, AX3) from a control's settings."""
    names_section = section.section("axis_names", required=False)
    names = [names_section.take(axis, _axis_name, f"AX{number}") for number, axis in enumerate(AXES, start=1)]
    names_section.finish()
    if len(set(names)) != 3:
        raise section.fail("axis_names", f"two axes have one name ({', '.join(names)}); each needs its own")
    return names[0], names[1], names[2]


def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value.upper()) or not value.isascii():
        raise ValueError("an axis name of letters, digits and '_', e.g. 'AX1' or 'X1', is expected")
    return value.upper()


def take_steps(section: tomlio.Section, machine: Machine, most: int, key: str = "step_mm") -> tuple[float | None, ...]:
    """Take ``step_mm = { X = 50.0, ... }``: the table steps that the user asks for, None where he does not."""
    steps_section = section.section(key, required=False)
    steps: list[float | None] = []
    for letter, axis in zip(AXES, machine.axes, strict=True):
        step = steps_section.take(letter, _step, None)
        if step is not None and axis.length_mm / step > most - 1:
            message = f"{step:g} mm gives more than the {most} nodes that max_points allows over {axis.length_mm:g} mm"
            raise steps_section.fail(letter, message)
        steps.append(step)
    steps_section.finish()
    return tuple(steps)


def _step(value: Any) -> float:
    step = tomlio.positive(value)
    if Decimal(repr(step)) % POSITION_QUANTUM_MM or step > 1e6:
        raise ValueError("a step in mm with at most 6 decimals is expected")
    return step
