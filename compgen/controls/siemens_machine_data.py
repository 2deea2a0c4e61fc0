"""SINUMERIK models, settings and machine data: capacity, limits of CEC tables, and what to set to activate them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any, TypeVar

import numpy as np

from compgen.controls.shared.base import Usage, parameter_row
from compgen.controls.shared.grids import loss_setting
from compgen.controls.siemens_cec_tables import MULT_MODES, CecMap, sum_into_axes
from compgen.controls.siemens_text import POSITION_QUANTUM_MM, table_violations
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES
from compgen.data.toml_files import (
    Section,
    accepted,
    accepts,
    array_schema,
    axis_setting,
    choice,
    flag,
    multiple_of,
    positive,
    setting,
    table_schema,
    unless_stated,
    whole,
)

# Capacity of the SINUMERIK models: numbers of tables and nodes, and the usual values of limiting machine data.
#
# Sources: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 264 (828D), newer edition p. 277 (number
# of tables of the 840D sl); 802D sl Function Manual 11/2012, p. 215, 220; 808D Function Manual 01/2017, p. 106. The
# bounds of 2000 and 5000 nodes and the defaults of MD32720 and MD32730 do not come from an available manual.


@dataclass(frozen=True)
class Profile:
    """Capacity of one model.

    Parameters
    ----------
    cec_tables : number of CEC tables; None: depends on the number of axes, or not documented.
    cec_nodes : nodes per CEC table; None: not documented.
    eec_nodes : nodes per encoder table.
    eec_nodes_documented : False if ``eec_nodes`` is the smallest number documented for any model.
    tables_per_axis : CEC tables for each axis of the control, 0 if their number is fixed.
    """

    cec_tables: int | None
    cec_nodes: int | None
    eec_nodes: int = 5000
    eec_nodes_documented: bool = True
    tables_per_axis: int = 0


#: Models by their name in the machine file.
PROFILES = {
    "840D sl": Profile(None, 2000, tables_per_axis=2),
    "828D": Profile(8, 200),
    "808D": Profile(None, None, eec_nodes=200),
    "802D sl": Profile(2, 350, eec_nodes=200, eec_nodes_documented=False),
}
#: Fewest axes on the control of a machine with X, Y and Z.
FEWEST_AXES = 3
#: Model used where the machine file does not name one.
USUAL = "840D sl"
#: Defaults of MD32720 (mm) and MD32730 (%) as far as known, the same for all models.
DEFAULT_MAX_SUM_MM, DEFAULT_MAX_VELO_PERCENT = 1.0, 10.0

_NOT_DOCUMENTED = (
    "no public document says that this model has cross-error compensation; if yours has it, set tables_available and "
    "max_points to the numbers in its machine data"
)


# Settings of the SINUMERIK tables: axis names, node spacing, measuring systems, capacity, and the kind of file:
# "ini" (initialisation file with header, loaded as data) or "program" (sub-program that is run).


_NAME = re.compile(r"[A-Z_][A-Z0-9_]{0,31}")
#: The vendor's documents do not state the sign; two independent indications lead to this one (``format.toml``).
INFERRED_SIGN = "error"
_MODE_MISSING = (
    "is missing. With products = true the file multiplies tables, but no available document says whether the two factors "
    "also act directly: a file made for the wrong mode leaves several times the error. Do the test with constant tables "
    'of the preflight list (sum 0.56: "S1", 0.06: "S2", 0.26: "S3", 0.36: "S4") and set e.g. mult_mode = "S1", or set '
    "products = false"
)
_STEP, _STEP_MEANING = multiple_of(POSITION_QUANTUM_MM), "node spacing, e.g. { X = 50.0 }; at most 6 decimals"
_OF_AXIS = [{"enum": [0, 1]}, {**array_schema({"enum": [0, 1]}, 1), "uniqueItems": True}]
Encoders = tuple[tuple[int, ...], tuple[int, ...], tuple[int, ...]]


@accepts({"anyOf": [*_OF_AXIS, table_schema(dict.fromkeys(AXES, {"anyOf": _OF_AXIS}))]})
def _encoders(value: Any) -> Encoders:
    """Measuring systems of the axes: 0 or 1, a list of both, or a table of these by axis (0 for a missing axis)."""
    if isinstance(value, dict):
        if not set(value) <= set(AXES):
            raise ValueError("expected 0, 1, [0, 1], or a table of these with the keys X, Y, Z")
        x, y, z = (_encoders_of_axis(value.get(axis, 0)) for axis in AXES)
        return x, y, z
    all_axes = _encoders_of_axis(value)
    return all_axes, all_axes, all_axes


def _encoders_of_axis(value: Any) -> tuple[int, ...]:
    items = value if isinstance(value, list) else [value]
    whole = all(isinstance(item, int) and not isinstance(item, bool) and item in (0, 1) for item in items)
    if not items or not whole or len(set(items)) != len(items):
        raise ValueError("expected 0 (measuring system 1), 1 (measuring system 2) or [0, 1]")
    return tuple(sorted(items))


@accepts({"type": "string", "pattern": "^[A-Za-z_][A-Za-z0-9_]{0,31}$"})
def _axis_name(value: Any) -> str:
    if not isinstance(value, str) or not _NAME.fullmatch(value.upper()) or not value.isascii():
        raise ValueError("expected an axis name of letters, digits and '_', e.g. 'AX1' or 'X1'")
    return value.upper()


@accepts({**array_schema(accepted(whole(0, 999))), "uniqueItems": True})
def _table_indices(value: Any) -> tuple[int, ...]:
    index = whole(0, 999)
    if not isinstance(value, list) or len({index(item) for item in value}) != len(value):
        raise ValueError("expected a list of different table indices, e.g. [6, 7]")
    return tuple(sorted(value))


@accepts({"anyOf": [accepted(positive), table_schema(dict.fromkeys(AXES, accepted(positive)), AXES)]})
def _per_axis(value: Any) -> tuple[float, float, float]:
    """One number above zero for all axes, or a table with X, Y and Z."""
    if isinstance(value, dict):
        if set(value) != set(AXES):
            raise ValueError("expected one number, or a table { X = ..., Y = ..., Z = ... }")
        x, y, z = (positive(value[axis]) for axis in AXES)
        return x, y, z
    number = positive(value)
    return number, number, number


@dataclass(frozen=True)
class SiemensSettings:
    """Settings shared by encoder tables and cross tables."""

    profile: str = setting(
        choice(*PROFILES),
        USUAL,
        meaning='model, sets the capacity: "840D sl", "828D", "808D", "802D sl"; the keys below override it',
    )
    axis_names: tuple[str, str, str] = axis_setting(
        _axis_name,
        ("AX1", "AX2", "AX3"),
        differ="two axes have the same name ({}); each needs a different name",
        meaning="names of the axes on the control",
    )
    loss_mm: float = loss_setting()
    container: str = setting(
        choice("ini", "program"),
        "ini",
        meaning='"ini": initialisation files that are loaded; "program": sub-programs that are run',
    )
    program_enables: bool = setting(
        flag, False, meaning="the sub-program also switches the tables on at its end; do the sign check first"
    )


@dataclass(frozen=True)
class CecSettings(SiemensSettings):
    """``[controllers.siemens-cec]``.

    Parameters
    ----------
    sign_stated : False if the machine file does not state the sign and the inferred one is used.
    mode_stated : False if the machine file does not state the mode; then no file with products is written or read.
    tables_available : tables that the control has, or None if not known.
    max_sum_mm, max_velo_percent : None if not stated.
    """

    sign: str = setting(
        choice("error", "correction"),
        INFERRED_SIGN,
        meaning='"error": the control subtracts the sum of the tables (inferred); "correction": it adds it',
    )
    mult_mode: str = setting(
        choice(*MULT_MODES),
        None,
        meaning='what two multiplied tables A, B give: "S1" A + B + AB, "S2" AB, "S3" A + AB, "S4" B + AB',
    )
    products: bool = setting(
        flag, None, meaning="write angular errors as products of tables; default: true if mult_mode is set"
    )
    axis_style: str = setting(choice("paren", "quote"), "paren", meaning='"paren" writes (AX1), "quote" writes "AX1"')
    step_mm: tuple[float | None, float | None, float | None] = axis_setting(_STEP, meaning=_STEP_MEANING)
    nc_axes: int | None = setting(
        whole(FEWEST_AXES, 93), None, meaning="axes of the control (840D sl), which has two cross tables for each"
    )
    max_points: int = setting(whole(3, 100_000), PROFILES[USUAL].cec_nodes, meaning="nodes per table, at least 3")
    tables_available: int | None = setting(
        whole(1, 1000), None, meaning="number of tables of the control, a limit; default: that of the profile"
    )
    tables_reserved: int = setting(
        whole(0, 1000), 0, meaning="number of cross tables to keep free, e.g. two for each reversal"
    )
    kept_tables: tuple[int, ...] = setting(
        _table_indices, (), meaning="indices of cross tables of other axes, e.g. [6, 7]: never written"
    )
    max_sum_mm: tuple[float, float, float] | None = setting(
        _per_axis, None, meaning="MD32720: one number, or { X = ..., Y = ..., Z = ... }; if set, a limit"
    )
    max_velo_percent: tuple[float, float, float] | None = setting(
        _per_axis, None, meaning="MD32730: one number, or { X = ..., Y = ..., Z = ... }; if set, a limit"
    )
    max_speed_mm_min: tuple[float, float, float] = setting(
        _per_axis, (1.0, 1.0, 1.0), meaning="MD32000, largest speeds of the axes; only their ratio matters"
    )
    sign_stated: bool = False
    mode_stated: bool = False

    @property
    def subtracts(self) -> bool:
        """Whether the control subtracts the sum of the tables from the command."""
        return self.sign == "error"

    @property
    def tables_usable(self) -> int | None:
        """How many tables the errors may take, None if not known."""
        if self.tables_available is None:
            return None
        kept = sum(1 for index in self.kept_tables if index < self.tables_available)
        return max(self.tables_available - self.tables_reserved - kept, 1)


@dataclass(frozen=True)
class EncoderSettings(SiemensSettings):
    """Settings of encoder tables, with or without cross tables.

    Parameters
    ----------
    encoders : for X, Y, Z the measuring systems that get a table: 0 is measuring system 1, 1 is measuring system 2.
    active : for X, Y, Z the measuring system that the position control uses.
    eec_nodes_known : False if the number of nodes is neither documented for the model nor stated.
    """

    encoders: Encoders = setting(
        _encoders,
        ((0,), (0,), (0,)),
        key="encoder",
        meaning="measuring systems that get a table: 0 (system 1), 1 (system 2), [0, 1], or by axis, e.g. { X = [0, 1] }",
    )
    active: tuple[int, int, int] = setting(
        _encoders,
        None,
        key="active_encoder",
        meaning="measuring system that the position control uses, one number or by axis; default: the first",
    )
    eec_nodes_known: bool = True


@dataclass(frozen=True)
class EecSettings(EncoderSettings):
    """``[controllers.siemens-eec]``."""

    max_points: int = setting(whole(3, 100_000), PROFILES[USUAL].eec_nodes, meaning="nodes per axis, at least 3")
    step_mm: tuple[float | None, float | None, float | None] = axis_setting(_STEP, meaning=_STEP_MEANING)
    decimals: int = setting(whole(3, 9), 6, meaning="decimals of the values in mm, 3 to 9")


@dataclass(frozen=True)
class CecEecSettings(CecSettings, EncoderSettings):
    """``[controllers.siemens-cec-eec]``: keys of the encoder tables start with ``eec_``."""

    eec_max_points: int = setting(
        whole(3, 100_000), PROFILES[USUAL].eec_nodes, meaning="nodes per encoder table, at least 3"
    )
    eec_step_mm: tuple[float | None, float | None, float | None] = axis_setting(
        _STEP, meaning="node spacing of the encoder tables"
    )
    eec_decimals: int = setting(whole(3, 9), 6, meaning="decimals of the values of the encoder tables in mm, 3 to 9")

    @property
    def eec(self) -> EecSettings:
        """The settings of the encoder tables alone."""
        common = {item.name: getattr(self, item.name) for item in fields(EncoderSettings)}
        steps, decimals = self.eec_step_mm, self.eec_decimals
        return EecSettings(**common, max_points=self.eec_max_points, step_mm=steps, decimals=decimals)


Cec = TypeVar("Cec", bound=CecSettings)
Encoder = TypeVar("Encoder", bound=EncoderSettings)


def checked_cec_settings(settings: Cec, section: Section, machine: Machine) -> Cec:
    """Return the settings of cross tables, completed from the model and from ``mult_mode``.

    Without ``mult_mode`` and ``products`` no products are written: a wrong mode is worse than a wrong sign.
    """
    mode_stated, profile = "mult_mode" in section, PROFILES[settings.profile]
    tables = profile.cec_tables
    if profile.tables_per_axis and settings.nc_axes is not None:
        tables = profile.tables_per_axis * settings.nc_axes
    settings = unless_stated(settings, section, max_points=profile.cec_nodes, tables_available=tables)
    settings = unless_stated(settings, section, mult_mode=next(iter(MULT_MODES)), products=mode_stated)
    if settings.products and not mode_stated:
        raise section.fail("mult_mode", _MODE_MISSING)
    if settings.max_points is None or (settings.tables_available is None and not profile.tables_per_axis):
        raise section.fail("profile", _NOT_DOCUMENTED)
    _check_steps(settings, section, machine, "")
    return replace(settings, sign_stated="sign" in section, mode_stated=mode_stated)


def checked_encoder_settings(settings: Encoder, section: Section, machine: Machine, prefix: str = "") -> Encoder:
    """Return the settings of encoder tables, completed from the model; ``prefix`` is the prefix of their keys."""
    profile = PROFILES[settings.profile]
    settings = unless_stated(settings, section, **{f"{prefix}max_points": profile.eec_nodes})
    _check_steps(settings, section, machine, prefix)
    stated: Any = settings.active
    active = [systems[:1] for systems in settings.encoders] if stated is None else stated
    for letter, one, systems in zip(AXES, active, settings.encoders, strict=True):
        if len(one) != 1 or one[0] not in systems:
            raise section.fail("active_encoder", f"expected one of the encoders of {letter}, {list(systems)}")
    known = profile.eec_nodes_documented or f"{prefix}max_points" in section
    x, y, z = (one[0] for one in active)
    return replace(settings, active=(x, y, z), eec_nodes_known=known)


def _check_steps(settings: SiemensSettings, section: Section, machine: Machine, prefix: str) -> None:
    """Refuse steps that give more nodes than the control takes, and ``program_enables`` with an INI file."""
    if settings.program_enables and settings.container == "ini":
        raise section.fail("program_enables", 'needs container = "program": an INI file does not switch tables on')
    most, key = getattr(settings, f"{prefix}max_points"), f"{prefix}step_mm"
    for letter, axis, step in zip(AXES, machine.axes, getattr(settings, key), strict=True):
        if step is not None and axis.length_mm / step > most - 1:
            message = f"{step:g} mm gives more than the {most} nodes that max_points allows over {axis.length_mm:g} mm"
            raise section.section(key).fail(letter, message)


# Limits of SINUMERIK CEC tables: largest sum over the volume, its rate of change, and the rules for a set.
#
# Rules: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 245-249, 264.


_MOST_POSITIONS = 81
_MOST_ACROSS = 21


def _positions(machine: Machine, tables: CecMap, axis: int, most: int | None) -> FloatArray:
    """Nodes of all tables over an axis within its travel, plus the ends; thinned to ``most``, table extremes kept."""
    low, high = machine.axes[axis].range_mm
    over_axis = [entry.table for entry in tables.values() if entry.input_axis == axis]
    nodes = np.concatenate([[low, high], *(table.nodes_mm for table in over_axis)])
    nodes = np.unique(np.round(np.clip(nodes, low, high), 6))
    if most is None or len(nodes) <= most:
        return nodes
    extremes = [table.nodes_mm[[np.argmin(table.numbers), np.argmax(table.numbers)]] for table in over_axis]
    picked = nodes[np.unique(np.linspace(0, len(nodes) - 1, most).round().astype(int))]
    return np.unique(np.clip(np.concatenate([picked, *extremes]), low, high))


def _sums(tables: CecMap, mode: str, positions: Sequence[FloatArray], travel: Sequence[int]) -> list[FloatArray]:
    """Totals of the three axes over the grid of positions, each (nx, ny, nz), for one direction of travel per axis."""
    outputs = {}
    for index, entry in tables.items():
        axis = entry.input_axis
        acts = entry.direction in (0, travel[axis])
        value = entry.at(positions[axis]) * float(acts)
        outputs[index] = np.expand_dims(value, tuple(other for other in range(3) if other != axis))
    shape = tuple(len(along) for along in positions)
    return [np.broadcast_to(total, shape) for total in sum_into_axes(tables, mode, outputs)]


def _travels(tables: CecMap) -> list[tuple[int, ...]]:
    """Combinations of travel directions that make a difference to at least one table."""
    directed = {entry.input_axis for entry in tables.values() if entry.direction}
    return list(product(*[(1, -1) if axis in directed else (1,) for axis in range(3)]))


def largest_sums(machine: Machine, tables: CecMap, mode: str) -> list[tuple[float, tuple[float, float, float]]]:
    """Return for each output axis the largest sum in magnitude over the travel, with its sign (mm), and its position.

    Sums are multilinear between nodes, so the largest is at a node; all are searched, up to 81 positions per axis.
    """
    positions = [_positions(machine, tables, axis, _MOST_POSITIONS) for axis in range(3)]
    found = [(0.0, (0.0, 0.0, 0.0))] * 3
    for travel in _travels(tables):
        for output, total in enumerate(_sums(tables, mode, positions, travel)):
            x, y, z = np.unravel_index(int(np.argmax(np.abs(total))), total.shape)
            value = float(total[x, y, z])
            if abs(value) >= abs(found[output][0]):
                found[output] = value, (float(positions[0][x]), float(positions[1][y]), float(positions[2][z]))
    return found


def largest_slopes(machine: Machine, tables: CecMap, mode: str) -> FloatArray:
    """Return the largest slope of each output's sum along each base axis, shape (3 outputs, 3 bases), mm/mm."""
    slopes = np.zeros((3, 3))
    for base in range(3):
        most = [_MOST_ACROSS if axis != base else None for axis in range(3)]
        positions = [_positions(machine, tables, axis, most[axis]) for axis in range(3)]
        steps = np.expand_dims(np.diff(positions[base]), tuple(axis for axis in range(3) if axis != base))
        for travel in _travels(tables):
            for output, total in enumerate(_sums(tables, mode, positions, travel)):
                slope = float(np.max(np.abs(np.diff(total, axis=base) / steps), initial=0.0))
                slopes[output, base] = max(slopes[output, base], slope)
    return slopes


def set_violations(machine: Machine, tables: CecMap, max_points: int, tables_available: int | None) -> list[str]:
    """Return broken rules of single tables and of the set: grid, travel, number of tables and nodes, references."""
    found: list[str] = []
    factors = {entry.multiplier - 1 for entry in tables.values() if entry.multiplier}
    for index, entry in sorted(tables.items()):
        what = f"table {index} ({AXES[entry.output_axis]} over {AXES[entry.input_axis]})"
        found += table_violations(machine, entry.input_axis, entry.table, max_points, what)
        if entry.direction not in (-1, 0, 1):
            found.append(f"{what}: DIRECTION is {entry.direction}; expected 0, 1 or -1")
        other = tables.get(entry.multiplier - 1)
        if entry.multiplier and other is None:
            found.append(f"{what}: MULT_BY_TABLE names table number {entry.multiplier}, which does not exist")
        elif other is not None and other.table.modulo != entry.table.modulo:
            found.append(
                f"{what}: either this table or its multiplier {entry.multiplier - 1} is cyclic; both must be, or neither"
            )
        if (entry.multiplier or index in factors) and (entry.weight != 1 or not entry.enabled):
            found.append(
                f"{what} is a factor of a product, with SD41300 = {int(entry.enabled)} and SD41310 = {entry.weight}; this "
                "case is not documented: both must be 1"
            )
    needed = max(tables) + 1
    if tables_available is not None and needed > tables_available:
        found.append(f"{needed} tables are needed, but the control has only {tables_available}")
    return found


def speed_percent(slopes: FloatArray, output: int, max_speed_mm_min: Sequence[float]) -> float:
    """Return how fast the sum into an axis changes, in % of that axis' maximum speed, all bases at their maximum speed.

    Rule: largest change per travel, times the speed of the base, against MD32730 / 100 times MD32000 of the output.
    """
    speeds = np.asarray(max_speed_mm_min, dtype=np.float64)
    return float(100.0 * np.sum(slopes[output] * speeds) / speeds[output])


def stated_limit_violations(machine: Machine, tables: CecMap, settings: CecSettings) -> list[str]:
    """Return where the sums exceed MD32720 or change faster than MD32730, if these are stated."""
    found = []
    if settings.max_sum_mm is not None:
        for axis, (value, place) in enumerate(largest_sums(machine, tables, settings.mult_mode)):
            if abs(value) > settings.max_sum_mm[axis]:
                found.append(
                    f"the sum into {settings.axis_names[axis]} reaches {value:+.6f} mm at X {place[0]:g} Y {place[1]:g} "
                    f"Z {place[2]:g}; MD32720 clips it at {settings.max_sum_mm[axis]:g} mm"
                )
    if settings.max_velo_percent is not None:
        slopes = largest_slopes(machine, tables, settings.mult_mode)
        for axis, allowed in enumerate(settings.max_velo_percent):
            percent = speed_percent(slopes, axis, settings.max_speed_mm_min)
            if percent > allowed:
                found.append(
                    f"the sum into {settings.axis_names[axis]} changes by up to {percent:.4f} % of the axis' maximum "
                    f"speed; MD32730 allows {allowed:g} %"
                )
    return found


def cec_usage(machine: Machine, tables: CecMap, settings: CecSettings) -> list[Usage]:
    """Return nodes of the longest table, number of tables, largest sums and their rate of change against the limits."""
    nodes = max(len(entry.table.values) for entry in tables.values())
    found = [Usage("nodes of the longest table", nodes, settings.max_points, "nodes")]
    if settings.tables_available is not None:
        found.append(Usage("tables", max(tables) + 1, settings.tables_available, "tables"))
    sums = largest_sums(machine, tables, settings.mult_mode)
    slopes = largest_slopes(machine, tables, settings.mult_mode)
    for axis in sorted({entry.output_axis for entry in tables.values()}):
        name, stated = settings.axis_names[axis], settings.max_sum_mm is not None
        most_mm = DEFAULT_MAX_SUM_MM if settings.max_sum_mm is None else settings.max_sum_mm[axis]
        percent, velo = speed_percent(slopes, axis, settings.max_speed_mm_min), settings.max_velo_percent
        most_percent = DEFAULT_MAX_VELO_PERCENT if velo is None else velo[axis]
        found.append(Usage(f"sum into {name} (MD32720)", abs(sums[axis][0]), most_mm, "mm", stated))
        found.append(Usage(f"change of the sum of {name} (MD32730)", percent, most_percent, "%", velo is not None))
    return found


# What to set on a SINUMERIK before CEC tables act: sign in words, machine data with values, warnings.


Sums = Sequence[tuple[float, tuple[float, float, float]]]


#: Smallest jump of an axis at switch-on that gives a warning.
NOTICEABLE_JUMP_MM = 5e-4


def cec_sign_statement(names: Sequence[str], subtracts: bool, sums: Sums, *, stated: bool) -> str:
    """Return the sign convention in words, with the largest sum in the file as a worked example.

    ``stated`` is False if the machine file does not state the sign and the inferred one is used.
    """
    output = max(range(3), key=lambda axis: abs(sums[axis][0]))
    value, place = sums[output]
    rule = (
        'sign = "error": the sum of the tables is the error of the axis; the control SUBTRACTS it from the command.'
        if subtracts
        else 'sign = "correction": the sum of the tables is the correction; the control ADDS it to the command.'
    )
    rule += (
        "" if stated else " This sign is inferred; the machine file does not state it: check it at the machine first."
    )
    moved = -value if subtracts else value
    return (
        f"{rule} Values are in mm. Example: at X {place[0]:.3f} Y {place[1]:.3f} Z {place[2]:.3f} mm the sum into "
        f"{names[output]} is {value:+.6f} mm, so the control moves the axis by {moved:+.6f} mm."
    )


def cec_parameters(
    machine: Machine, names: Sequence[str], tables: CecMap, mode: str, sums: Sums
) -> list[dict[str, str]]:
    """Return the machine data and setting data, with the values that these tables need."""
    rows = [
        parameter_row(
            f"MD18342 $MN_MM_CEC_MAX_POINTS[{index}]", str(len(entry.table.values)), "number of nodes, exactly"
        )
        for index, entry in sorted(tables.items())
    ]
    rows += [
        parameter_row(f"SD41300 $SN_CEC_TABLE_ENABLE[{_indices_in_words(tables)}]", "1", "every table is evaluated"),
        parameter_row(f"SD41310 $SN_CEC_TABLE_WEIGHT[{_indices_in_words(tables)}]", "1.0", "all weights are 1"),
        parameter_row("MD10240, MD10260, MD32711", "metric", "the tables are in mm"),
    ]
    slopes = largest_slopes(machine, tables, mode)
    for output in sorted({entry.output_axis for entry in tables.values()}):
        name, needed_mm = names[output], abs(sums[output][0])
        by_base = ", ".join(f"{names[base]} {slope:.3g}" for base, slope in enumerate(slopes[output].tolist()))
        rows += [
            parameter_row(
                f"MD32710 $MA_CEC_ENABLE[{name}]", "0, then 1", "0 while the file is loaded; 1 enables the sum"
            ),
            parameter_row(
                f"MD32720 $MA_CEC_MAX_SUM[{name}]",
                f">= {np.ceil(needed_mm * 1e4) / 1e4:.4f} mm",
                f"the sum reaches {needed_mm:.6f} mm; the control clips it at this limit (alarm 20124)",
            ),
            parameter_row(
                f"MD32730 $MA_CEC_MAX_VELO[{name}]",
                f">= {100.0 * sum(slopes[output].tolist()):.4f} %",
                f"largest change of the sum, mm per mm of travel of the base axes: {by_base}; the percentage assumes that "
                "all base axes run at the maximum speed MD32000 of this axis; otherwise scale it by v_base / MD32000",
            ),
        ]
    return rows


def _indices_in_words(tables: CecMap) -> str:
    """Indices in words: ``0 ... 4, 6``; indices in between that belong to other axes are not listed."""
    found = sorted(tables)
    ends = [index for index in found if index - 1 not in tables or index + 1 not in tables]
    parts: list[str] = []
    for index in ends:
        if index - 1 not in tables:
            parts.append(str(index))
        else:
            parts[-1] += f" ... {index}"
    return ", ".join(parts)


def cec_overwrites(tables: CecMap, kept: Sequence[int]) -> list[str]:
    """Say which tables the file overwrites, other axes first."""
    if kept:
        first = f"Of other axes: nothing. Tables kept (kept_tables): {', '.join(map(str, sorted(kept)))}."
    else:
        first = (
            "Of other axes: NOT KNOWN. A table of a rotary or additional axis that has one of the indices below is lost: "
            "give the archive of the control with --active, or set kept_tables in the machine file."
        )
    return [first, f"Tables {_indices_in_words(tables)}, whatever they contain now."]


def cec_warnings(
    machine: Machine, names: Sequence[str], tables: CecMap, settings: CecSettings, sums: Sums
) -> list[str]:
    """Return warnings: usual limits that would be exceeded where none are stated, a jump at the reference point."""
    found = []
    for axis, (value, _) in enumerate(sums):
        if settings.max_sum_mm is None and abs(value) > DEFAULT_MAX_SUM_MM:
            found.append(
                f"{names[axis]}: the sum reaches {value:+.4f} mm; the usual MD32720 is {DEFAULT_MAX_SUM_MM:g} mm and "
                "would clip it"
            )
    slopes = largest_slopes(machine, tables, settings.mult_mode)
    for axis in range(3):
        percent = speed_percent(slopes, axis, settings.max_speed_mm_min)
        if settings.max_velo_percent is None and percent > DEFAULT_MAX_VELO_PERCENT:
            found.append(
                f"{names[axis]}: the sum changes by up to {percent / 100.0:.3g} mm per mm of travel; the usual "
                f"MD32730 is {DEFAULT_MAX_VELO_PERCENT:g} % and would make it lag behind"
            )
    at_reference = {
        index: entry.at(np.array(machine.reference_point_mm[entry.input_axis])) for index, entry in tables.items()
    }
    for axis, total in enumerate(map(float, sum_into_axes(tables, settings.mult_mode, at_reference))):
        if abs(total) > NOTICEABLE_JUMP_MM:
            found.append(
                f"{names[axis]}: the sum at the reference point is {total:+.6f} mm ({AXES[axis]}); the axis jumps by this "
                "amount when the compensation is enabled"
            )
    return found


def cec_reservations(tables: CecMap, settings: CecSettings) -> list[str]:
    """Return what the verdict must say: an inferred sign, missing products, an unknown number of tables."""
    found = []
    if not settings.sign_stated:
        found.append(
            'sign = "error" (the control subtracts the tables) is inferred from two indications; neither the machine file '
            "nor the vendor states it: do the dial-gauge check in preflight.md first, then set sign"
        )
    if not settings.products and not settings.mode_stated:
        found.append(
            "mult_mode is not set: how the control combines two multiplied tables is not known, so none are multiplied "
            "and angular errors stay. Find the mode with the test in preflight.md and set it, or set products = false"
        )
    small, usual = PROFILES["828D"], PROFILES[USUAL]
    needed, nodes = max(tables) + 1, max(len(entry.table.values) for entry in tables.values())
    sure = usual.tables_per_axis * FEWEST_AXES
    if settings.tables_available is None and (needed > sure or nodes > (small.cec_nodes or 0)):
        found.append(
            f"{needed} tables with up to {nodes} nodes are needed, but the machine file does not say how many the control "
            f"has: an 840D sl has two for each of its axes ({sure} with {FEWEST_AXES} axes), an 828D has {small.cec_tables} "
            f"with {small.cec_nodes} nodes. Tables that do not fit have no effect. Set nc_axes or tables_available"
        )
    return found
