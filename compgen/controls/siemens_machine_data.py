"""SINUMERIK models, settings and machine data: capacity, limits of CEC tables, and what to set before they act."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import product
from typing import Any

import numpy as np

from compgen.controls.shared.base import Usage
from compgen.controls.shared.grids import take_loss_mm
from compgen.controls.siemens_cec_tables import MULT_MODES, CecMap, CecTable, sum_into_axes
from compgen.controls.siemens_text import POSITION_QUANTUM_MM, table_violations
from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES

# What the SINUMERIK models can hold: numbers of tables and nodes, and the usual values of limiting machine data.
#
# Sources: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 264 (828D), newer edition p. 277 (number of
# tables of the 840D sl); 802D sl Function Manual 11/2012, p. 215, 220; 808D Function Manual 01/2017, p. 106. The bounds of
# 2000 and 5000 nodes and the defaults of MD32720 and MD32730 are not from a manual that could be read.


@dataclass(frozen=True)
class Profile:
    """Capacity of one model.

    Parameters
    ----------
    cec_tables : number of CEC tables; None: it follows from the number of axes, or is not documented.
    cec_nodes : nodes per CEC table; None: not documented.
    eec_nodes : nodes per encoder table.
    eec_nodes_documented : False if ``eec_nodes`` is the smallest number that is documented for any model.
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
#: Axes that a control of a machine with X, Y and Z has at least.
FEWEST_AXES = 3
#: What counts where the machine file names no model.
USUAL = "840D sl"
#: Defaults of MD32720 (mm) and MD32730 (%) as far as they are known, the same for all models.
DEFAULT_MAX_SUM_MM, DEFAULT_MAX_VELO_PERCENT = 1.0, 10.0

_NOT_DOCUMENTED = (
    "no public document says that this model has cross-error compensation; if yours has, state tables_available and "
    "max_points as its start-up list shows them"
)


def take_profile(section: toml_files.Section) -> Profile:
    """Take ``profile``, the model of the control; the limits of an 840D sl count where it is not stated."""
    return PROFILES[section.take("profile", toml_files.choice(*PROFILES), USUAL)]


def take_cec_capacity(section: toml_files.Section, profile: Profile) -> tuple[int, int | None]:
    """Take ``max_points`` and ``tables_available`` (None: not known); what is stated overrides the profile."""
    own_axes = section.take("nc_axes", toml_files.whole(FEWEST_AXES, 93), None)
    tables = profile.cec_tables
    if profile.tables_per_axis and own_axes is not None:
        tables = profile.tables_per_axis * own_axes
    nodes = section.take("max_points", toml_files.whole(3, 100_000), profile.cec_nodes)
    available = section.take("tables_available", toml_files.whole(1, 1000), tables)
    if nodes is None or (available is None and not profile.tables_per_axis):
        raise section.fail("profile", _NOT_DOCUMENTED)
    return nodes, available


# Settings of the SINUMERIK tables: names of the axes, node distances, measuring systems, capacity, container.


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
    mult_mode : S1 to S4, see :mod:`compgen.controls.siemens_cec_tables`.
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


def take_cec_settings(section: toml_files.Section, machine: Machine) -> CecSettings:
    """Take the settings of CEC tables from a section; ``mult_mode`` is mandatory where ``products = true`` is stated.

    Without ``mult_mode`` and ``products`` no products are written: a wrong mode is worse than a wrong sign.
    """
    mode = section.take("mult_mode", toml_files.choice(*MULT_MODES), None)
    products = section.take("products", toml_files.flag, mode is not None)
    if products and mode is None:
        raise section.fail("mult_mode", _MODE_MISSING)
    max_points, tables_available = take_cec_capacity(section, take_profile(section))
    return CecSettings(
        sign=section.take("sign", toml_files.choice("error", "correction"), INFERRED_SIGN),
        sign_stated="sign" in section,
        mult_mode=mode or next(iter(MULT_MODES)),
        mode_stated=mode is not None,
        products=products,
        axis_names=take_axis_names(section),
        axis_style=section.take("axis_style", toml_files.choice("paren", "quote"), "paren"),
        step_mm=take_steps(section, machine, max_points),
        loss_mm=take_loss_mm(section),
        max_points=max_points,
        tables_available=tables_available,
        tables_reserved=section.take("tables_reserved", toml_files.whole(0, 1000), 0),
        kept_tables=section.take("kept_tables", _check_indices, ()),
        max_sum_mm=section.take("max_sum_mm", _per_axis, None),
        max_velo_percent=section.take("max_velo_percent", _per_axis, None),
        max_speed_mm_min=section.take("max_speed_mm_min", _per_axis, (1.0, 1.0, 1.0)),
        container=take_container(section),
    )


def take_eec_settings(section: toml_files.Section, machine: Machine, prefix: str = "") -> EecSettings:
    """Take the settings of encoder tables; ``prefix`` stands before the keys that CEC tables have as well."""
    profile = take_profile(section)
    max_points = section.take(f"{prefix}max_points", toml_files.whole(3, 100_000), profile.eec_nodes)
    encoders = section.take("encoder", _encoders, ((0,), (0,), (0,)))
    return EecSettings(
        encoders=encoders,
        active=_take_active(section, encoders),
        axis_names=take_axis_names(section),
        step_mm=take_steps(section, machine, max_points, f"{prefix}step_mm"),
        loss_mm=take_loss_mm(section),
        max_points=max_points,
        max_points_known=profile.eec_nodes_documented or f"{prefix}max_points" in section,
        decimals=section.take(f"{prefix}decimals", toml_files.whole(3, 9), 6),
        container=take_container(section),
    )


def take_container(section: toml_files.Section) -> Container:
    """Take ``container`` and ``program_enables``."""
    kind = section.take("container", toml_files.choice("ini", "program"), "ini")
    enables = section.take("program_enables", toml_files.flag, False)
    if enables and kind == "ini":
        raise section.fail("program_enables", 'needs container = "program": an INI file switches nothing on')
    return Container(kind, enables)


def _check_indices(value: Any) -> tuple[int, ...]:
    """A list of different indices of tables."""
    whole = toml_files.whole(0, 999)
    if not isinstance(value, list) or len({whole(item) for item in value}) != len(value):
        raise ValueError("a list of different table indices, e.g. [6, 7], is expected")
    return tuple(sorted(value))


def _per_axis(value: Any) -> tuple[float, float, float]:
    """One number above zero for all axes, or a table with X, Y and Z."""
    if isinstance(value, dict):
        if set(value) != set(AXES):
            raise ValueError("one number, or a table { X = ..., Y = ..., Z = ... }, is expected")
        x, y, z = (toml_files.positive(value[axis]) for axis in AXES)
        return x, y, z
    number = toml_files.positive(value)
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


def _take_active(section: toml_files.Section, encoders: Encoders) -> tuple[int, int, int]:
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


def take_axis_names(section: toml_files.Section) -> tuple[str, str, str]:
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


def take_steps(
    section: toml_files.Section, machine: Machine, most: int, key: str = "step_mm"
) -> tuple[float | None, ...]:
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
    step = toml_files.positive(value)
    if Decimal(repr(step)) % POSITION_QUANTUM_MM or step > 1e6:
        raise ValueError("a step in mm with at most 6 decimals is expected")
    return step


# Limits of SINUMERIK CEC tables: what the sum reaches over the volume, how fast it changes, and the rules of a set.
#
# Rules: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 245-249, 264.


_MOST_POSITIONS = 81
_MOST_ACROSS = 21


def _positions(machine: Machine, tables: CecMap, axis: int, most: int | None) -> FloatArray:
    """Nodes of all tables over an axis within its travel and the ends; thinned to ``most``, extremes of tables kept."""
    low, high = machine.axes[axis].range_mm
    own = [entry.table for entry in tables.values() if entry.input_axis == axis]
    nodes = np.concatenate([[low, high], *(table.nodes_mm for table in own)])
    nodes = np.unique(np.round(np.clip(nodes, low, high), 6))
    if most is None or len(nodes) <= most:
        return nodes
    extremes = [table.nodes_mm[[np.argmin(table.numbers), np.argmax(table.numbers)]] for table in own]
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
    """Directions of travel that make a difference to some table."""
    directed = {entry.input_axis for entry in tables.values() if entry.direction}
    return list(product(*[(1, -1) if axis in directed else (1,) for axis in range(3)]))


def largest_sums(machine: Machine, tables: CecMap, mode: str) -> list[tuple[float, tuple[float, float, float]]]:
    """Return for each output axis the sum of largest size over the travel, with its sign (mm), and where it stands.

    Sums are multilinear between nodes, so the largest stands on nodes; all are searched, up to 81 positions per axis.
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
    """Return the largest change of each output's sum per travel of each base axis, shape (3 outputs, 3 bases), mm/mm."""
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
    """Return broken rules of single tables and of the set: grid, travel, numbers of tables and nodes, references."""
    found: list[str] = []
    for index, entry in sorted(tables.items()):
        what = f"table {index} ({AXES[entry.output_axis]} over {AXES[entry.input_axis]})"
        found += table_violations(machine, entry.input_axis, entry.table, max_points, what)
        found += _reference_violations(tables, index, entry, what)
    needed = max(tables) + 1
    if tables_available is not None and needed > tables_available:
        found.append(f"{needed} tables are needed, the control has {tables_available}")
    return found


def _reference_violations(tables: CecMap, index: int, entry: CecTable, what: str) -> list[str]:
    found = []
    if entry.direction not in (-1, 0, 1):
        found.append(f"{what}: DIRECTION is {entry.direction}; 0, 1 and -1 are allowed")
    if entry.multiplier:
        other = tables.get(entry.multiplier - 1)
        if other is None:
            found.append(f"{what}: MULT_BY_TABLE names table number {entry.multiplier}, which does not exist")
        elif other.table.modulo != entry.table.modulo:
            found.append(f"{what}: it and its multiplier {entry.multiplier - 1} are not both cyclic or both not")
    factors = {other.multiplier - 1 for other in tables.values() if other.multiplier}
    if (entry.multiplier or index in factors) and (entry.weight != 1 or not entry.enabled):
        found.append(
            f"{what} is a factor of a product, with SD41300 = {int(entry.enabled)} and SD41310 = {entry.weight}; what "
            "the product is then is not documented: both must be 1"
        )
    return found


def speed_percent(slopes: FloatArray, output: int, max_speed_mm_min: Sequence[float]) -> float:
    """Return how fast the sum into an axis changes, in % of the axis' own largest speed, all bases at theirs.

    Rule: largest change per travel, times the speed of the base, against MD32730 / 100 times MD32000 of the output.
    """
    speeds = np.asarray(max_speed_mm_min, dtype=np.float64)
    return float(100.0 * np.sum(slopes[output] * speeds) / speeds[output])


def stated_limit_violations(machine: Machine, tables: CecMap, settings: CecSettings) -> list[str]:
    """Return where the sums exceed MD32720, or change faster than MD32730, as far as these are stated."""
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
                    f"the sum into {settings.axis_names[axis]} changes by up to {percent:.4f} % of the axis' largest "
                    f"speed; MD32730 allows {allowed:g} %"
                )
    return found


def cec_usage(machine: Machine, tables: CecMap, settings: CecSettings) -> list[Usage]:
    """Return nodes of the longest table, number of tables, largest sums and their largest change against the limits."""
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


# What must be set on a SINUMERIK before CEC tables act: sign in words, machine data with values, warnings.


Sums = Sequence[tuple[float, tuple[float, float, float]]]


#: A jump of an axis at switch-on below this is not worth a warning.
NOTICEABLE_JUMP_MM = 5e-4


def cec_sign_statement(names: Sequence[str], subtracts: bool, sums: Sums, *, stated: bool) -> str:
    """Return the sign convention in words with the largest sum of the file as a worked number.

    ``stated`` is False where the machine file leaves the sign to what is inferred.
    """
    output = max(range(3), key=lambda axis: abs(sums[axis][0]))
    value, place = sums[output]
    rule = (
        'sign = "error": the sum of the tables is the error of the axis, the control SUBTRACTS it from the command.'
        if subtracts
        else 'sign = "correction": the sum of the tables is the correction, the control ADDS it to the command.'
    )
    rule += "" if stated else " This sign is inferred, not stated in the machine file: check it at the machine first."
    moved = -value if subtracts else value
    return (
        f"{rule} Values in mm. Here: at X {place[0]:.3f} Y {place[1]:.3f} Z {place[2]:.3f} mm the sum into "
        f"{names[output]} is {value:+.6f} mm, the axis is moved by {moved:+.6f} mm."
    )


def cec_parameters(
    machine: Machine, names: Sequence[str], tables: CecMap, mode: str, sums: Sums
) -> list[dict[str, str]]:
    """Return the machine and setting data with the values that these tables need."""
    rows = [
        _row(f"MD18342 $MN_MM_CEC_MAX_POINTS[{index}]", str(len(entry.table.values)), "nodes of the table, exactly")
        for index, entry in sorted(tables.items())
    ]
    rows += [
        _row(f"SD41300 $SN_CEC_TABLE_ENABLE[{_indices_in_words(tables)}]", "1", "every table is evaluated"),
        _row(f"SD41310 $SN_CEC_TABLE_WEIGHT[{_indices_in_words(tables)}]", "1.0", "weights stay 1"),
        _row("MD10240, MD10260, MD32711", "metric", "the tables are in mm"),
    ]
    slopes = largest_slopes(machine, tables, mode)
    for output in sorted({entry.output_axis for entry in tables.values()}):
        rows += _axis_rows(names, output, abs(sums[output][0]), slopes[output].tolist())
    return rows


def _indices_in_words(tables: CecMap) -> str:
    """Indices in words: ``0 ... 4, 6``; those between that belong to other axes are not named."""
    found = sorted(tables)
    ends = [index for index in found if index - 1 not in tables or index + 1 not in tables]
    parts: list[str] = []
    for index in ends:
        alone, begins = index - 1 not in tables and index + 1 not in tables, index - 1 not in tables
        if alone or begins:
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
            "Of other axes: NOT KNOWN. A table of a rotary or further axis that has one of the indices below is lost: give "
            "the archive of the control with --active, or state kept_tables in the machine file."
        )
    return [first, f"Tables {_indices_in_words(tables)}, whatever they hold now."]


def _axis_rows(names: Sequence[str], output: int, needed_mm: float, slopes: Sequence[float]) -> list[dict[str, str]]:
    name = names[output]
    by_base = ", ".join(f"{names[base]} {slope:.3g}" for base, slope in enumerate(slopes))
    return [
        _row(f"MD32710 $MA_CEC_ENABLE[{name}]", "0, then 1", "0 while the file is loaded; 1 enables the sum"),
        _row(
            f"MD32720 $MA_CEC_MAX_SUM[{name}]",
            f">= {np.ceil(needed_mm * 1e4) / 1e4:.4f} mm",
            f"the sum reaches {needed_mm:.6f} mm; what is above this limit is cut off (alarm 20124)",
        ),
        _row(
            f"MD32730 $MA_CEC_MAX_VELO[{name}]",
            f">= {100.0 * sum(slopes):.4f} %",
            f"largest change of the sum, mm per mm of travel of the base axes: {by_base}; the percentage holds if all "
            "bases run as fast as this axis' own maximum MD32000, else scale it by v_base / MD32000",
        ),
    ]


def _row(name: str, value: str, meaning: str) -> dict[str, str]:
    return {"name": name, "value": value, "meaning": meaning}


def cec_warnings(
    machine: Machine, names: Sequence[str], tables: CecMap, settings: CecSettings, sums: Sums
) -> list[str]:
    """Return what the user must know: limits that are not stated but would be exceeded, a jump at the reference."""
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
    return found + _jumps(machine, names, tables, settings.mult_mode)


def cec_reservations(tables: CecMap, settings: CecSettings) -> list[str]:
    """Return what the verdict must say: an inferred sign, products that are missing, a number of tables not known."""
    found = []
    if not settings.sign_stated:
        found.append(
            'sign = "error" (the control subtracts the tables) is inferred from two traces, not stated in the machine file '
            "nor by the vendor: do the dial-gauge check of preflight.md first, then state sign"
        )
    if not settings.products and not settings.mode_stated:
        found.append(
            "mult_mode is not stated: what the control makes of two multiplied tables is not known, so none are multiplied "
            "and angular errors stay. Find it with the test of preflight.md and state it, or write products = false"
        )
    small, usual = PROFILES["828D"], PROFILES[USUAL]
    needed, nodes = max(tables) + 1, max(len(entry.table.values) for entry in tables.values())
    sure = usual.tables_per_axis * FEWEST_AXES
    if settings.tables_available is None and (needed > sure or nodes > (small.cec_nodes or 0)):
        found.append(
            f"these are {needed} tables with up to {nodes} nodes, and how many the control has is not stated: an 840D sl "
            f"has two for each of its axes ({sure} with {FEWEST_AXES}), an 828D {small.cec_tables} of {small.cec_nodes} "
            "nodes; what has no room does not act. State nc_axes or tables_available"
        )
    return found


def _jumps(machine: Machine, names: Sequence[str], tables: CecMap, mode: str) -> list[str]:
    at_reference = {
        index: entry.at(np.array(machine.reference_point_mm[entry.input_axis])) for index, entry in tables.items()
    }
    totals = [float(total) for total in sum_into_axes(tables, mode, at_reference)]
    return [
        f"{names[axis]}: the sum at the reference point is {total:+.6f} mm ({AXES[axis]}); the axis jumps by it when "
        "the compensation is enabled"
        for axis, total in enumerate(totals)
        if abs(total) > NOTICEABLE_JUMP_MM
    ]
