"""What every control has in common: a basis of tables, building, parsing and emulating their text, transfer plans."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Self, TypeVar

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.errors import InputError
from compgen.kinematics.first_order import factor

# What every control has in common: a basis of tables, and building, parsing and emulating their text.
#
# A control is described by its **basis**: a list of :class:`Term`, each one table (a curve over one axis, or a
# constant) times a carrier field. The export step finds the table values whose correction field comes closest to
# the required one; the control turns them into its numbers, parses them back from text, and emulates what it does.


Settings = TypeVar("Settings")
Tables = TypeVar("Tables")


@dataclass(frozen=True)
class Monomial:
    """Carrier: ``sign`` times (factor minus ``origin_mm``) on axis ``output``.

    ``lever``: as in :class:`compgen.kinematics.first_order.Coefficient`: None for factor 1, 0..2 an axis coordinate,
    3..5 a component of the tool offset.
    """

    output: int
    sign: int = 1
    lever: int | None = None
    origin_mm: float = 0.0


@dataclass(frozen=True)
class Term:
    """One table of a control: values at ``nodes_mm`` over ``axis`` (None: one constant), times its carrier.

    Parameters
    ----------
    name : unique within the basis, e.g. ``"X(y)"``, ``"X(y)*z"``, ``"EXX"``.
    axis : 0..2, or None for a constant.
    nodes_mm : positions of the values, shape (n,); a constant has one (any) position.
    carrier : the correction in mm is the value times the sum of these monomials.
    start : natural values, shape (n,); kept where the required correction does not determine the values.
    zero_at_mm : position where the interpolated value must be zero, or None.
    keep_mm : positions where the value should keep its start value where the required correction leaves a choice (a
        line can go into a straightness or a squareness); this preserves the zeros of the fitted curves.
    zeros_mm : positions of nodes whose values are exactly zero, as in ``start``.
    """

    name: str
    axis: int | None
    nodes_mm: FloatArray
    carrier: tuple[Monomial, ...]
    start: FloatArray
    zero_at_mm: float | None = None
    keep_mm: tuple[float, ...] = ()
    zeros_mm: tuple[float, ...] = ()

    def curve(self, values: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Interpolated values (n,) at commanded positions (m, 3): shape (m,)."""
        if self.axis is None:
            return np.full(len(position_mm), values[0])
        return np.interp(position_mm[:, self.axis], self.nodes_mm, values)

    def carriers(self, position_mm: FloatArray, tool_mm: FloatArray) -> dict[int, FloatArray | float]:
        """Carrier by output axis, (m,) or constant, at commanded positions (m, 3) with tool offset (3,) or (m, 3)."""
        found: dict[int, FloatArray | float] = {}
        for part in self.carrier:
            lever = 1.0 if part.lever is None else factor(part.lever, position_mm, tool_mm)
            added = part.sign * (lever - part.origin_mm)
            found[part.output] = found[part.output] + added if part.output in found else added
        return found

    def carrier_field(self, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Carrier at commanded positions (m, 3) with tool offset (3,) or (m, 3): shape (m, 3)."""
        field = np.zeros((len(position_mm), 3))
        for output, carrier in self.carriers(position_mm, tool_mm).items():
            field[:, output] = carrier
        return field


@dataclass(frozen=True)
class SourceFile:
    """A file to be parsed as controller data: its path and its text."""

    path: Path
    text: str

    def fail(self, message: str, line: int | None = None) -> InputError:
        """Return the error that points at a line of this file (counting from 1)."""
        return InputError(message, file=self.path, line=line)


@dataclass(frozen=True)
class Usage:
    """Use of one limit, in ``unit``: ``used`` of ``allowed``; ``stated`` is False for a typical default."""

    name: str
    used: float
    allowed: float
    unit: str
    stated: bool = True

    @property
    def share(self) -> float:
        """Used share of the limit; 1 when it is reached."""
        return self.used / self.allowed if self.allowed else float(self.used > 0)


class Controller(ABC, Generic[Settings, Tables]):
    """One control: everything specific to its files and what it does with them.

    An instance is the control of one machine: it has read its section ``[controllers.<name>]`` of the machine file.
    Corrections are in mm: what the control ADDS to the commanded position, shape (n, 3); the sign convention of the
    stored numbers depends on the control and is handled in its ``build``, ``parse`` and ``emulate``.

    Parameters
    ----------
    machine : the machine.
    settings : None: read from the machine file; otherwise used instead of those.
    """

    #: Name on the command line and of the folder in ``templates/``.
    name: str
    #: Settings dataclass; its fields declare key, check, default and meaning (``compgen.data.toml_files.setting``).
    settings_class: type[Settings]
    #: True if every table is zero at the reference point by definition: a constant offset cannot be corrected.
    anchored: bool = False
    #: True if tables may act in one direction of travel only and can thus contain a reversal.
    bidirectional: bool = False
    #: True if tables are looked up at the actual (corrected) axis positions, not at the command.
    at_axes: bool = False
    #: True if the correction is not the sum of the tables: the control moves the chain by finite rotations.
    finite_rotations: bool = False
    #: True if a plan for a binary transfer (``plan`` of the context, a ``.json`` file) is also written.
    has_plan: bool = False
    #: Folder containing the template sub-folder of a plug-in control; None: the shipped templates.
    templates: Path | None = None
    #: Setting that names a file from the user's control to follow: "style_from", "template_from", or None.
    sample_setting: str | None = None

    def __init__(self, machine: Machine, settings: Settings | None = None) -> None:
        self.machine = machine
        self.settings = self.read_settings(machine) if settings is None else settings

    @classmethod
    def read_settings(cls, machine: Machine) -> Settings:
        """Read ``[controllers.<name>]`` of the machine file; InputError for missing, unknown or wrong keys.

        The keys are the fields declared in ``settings_class``.
        """
        section = cls.settings_section(machine)
        settings = cls.check_settings(toml_files.take_settings(cls.settings_class, section), section, machine)
        section.finish()
        return settings

    @classmethod
    def settings_section(cls, machine: Machine) -> toml_files.Section:
        """Return the section of the machine file from which the settings are read."""
        return machine.controller_settings(cls.name)

    @classmethod
    def check_settings(cls, settings: Settings, section: toml_files.Section, machine: Machine) -> Settings:
        """Check what depends on several keys or on the machine; return the settings with such defaults filled in."""
        return settings

    def missing(self) -> InputError | None:
        """Return the error for a setting needed for export but not for reading; ``build`` raises it. None: complete."""
        return None

    @abstractmethod
    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return the tables that the control would get for these errors, in correction space (mm added per unit)."""

    def basis_of(self, errors: ErrorTable, tables: Tables) -> list[Term]:
        """Return the basis for judging parsed tables: by default the basis for these errors.

        A control that has room for only some of its tables may use those in ``tables`` if they are as good.
        """
        return self.basis(errors)

    @abstractmethod
    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> Tables:
        """Turn term values (by name, shape of the term's nodes) into the control's numbers, rounded as written."""

    @abstractmethod
    def context(self, tables: Tables) -> dict[str, Any]:
        """Return what the Jinja2 templates of the control need beyond the common context."""

    @abstractmethod
    def parse(self, files: Sequence[SourceFile]) -> Tables:
        """Read the control's numbers back from text; InputError with file and line if malformed."""

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[Tables, list[str]] | None:
        """Read files not written by this program (an archive of a control): the active tables, and remarks.

        The text may contain any character. Content unrelated to tables is skipped and counted in the remarks; tables of
        axes not in the machine file are named there. Anything not understood that could change a table is an
        InputError with its line. None (the default): this control has only the strict reader :meth:`parse`.
        """
        return None

    @abstractmethod
    def emulate(self, tables: Tables, points: Points) -> FloatArray:
        """Return what the control adds to the command at each point, shape (n, 3), mm."""

    @abstractmethod
    def violations(self, tables: Tables) -> list[str]:
        """Return, in words, every limit of the control that the tables exceed and any travel they do not cover."""

    def contradictions(self, tables: Tables, files: Sequence[SourceFile]) -> list[str]:
        """Return where files not needed to read the tables (a transfer plan) contradict them."""
        return plan_contradictions(files, lambda: self.context(tables)["plan"]) if self.has_plan else []

    def remarks(self, tables: Tables, files: Sequence[SourceFile]) -> list[str]:
        """Return, in words, what was assumed, skipped or kept separate (tables of other axes) when reading these files.

        For someone reading the backup of a control. Lines not understood that could change a table are not
        remarks: ``parse`` rejects them. The default is the ``remarks`` of the tables, if any.
        """
        return list(getattr(tables, "remarks", ()))

    def keeping_others(self, tables: Tables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return settings that make an export keep the data of other axes in these files of the user's control.

        Keyed by control name and section key. Empty if there is nothing to keep, or the settings already
        ensure it.
        """
        return {}

    @abstractmethod
    def resolution_mm(self) -> float:
        """Return the largest correction error that rounding to the format's quantum may cause on one axis, mm."""

    def anchor_mm(self) -> FloatArray:
        """Return where tables of an ``anchored`` control are zero by definition, shape (3,): the reference point."""
        return np.array(self.machine.reference_point_mm, dtype=np.float64)

    def table_nodes_mm(self, tables: Tables) -> tuple[FloatArray, ...]:
        """Return the node positions of parsed tables in X, Y and Z, ascending, including those outside the travel.

        An axis without a table has none. The default returns none at all.
        """
        return (np.zeros(0), np.zeros(0), np.zeros(0))

    def by_direction(self, tables: Tables) -> bool:
        """Return whether what parsed tables add depends on the direction of travel; True if the control cannot say."""
        return self.bidirectional

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Return the part of a reversal that goes into direction-dependent tables; ``with_reversal`` gets only this."""
        return reversal if self.bidirectional else ReversalCurves({})

    def with_reversal(self, tables: Tables, reversal: ReversalCurves) -> Tables:
        """Return the tables including the reversal; only for ``bidirectional`` controls."""
        raise TypeError(f"{self.name} has no direction-dependent tables")

    def backlash_parameters(self, reversal: ReversalCurves) -> list[dict[str, str]]:
        """Return the control's backlash parameters (name, value, meaning) for a reversal that is in no table."""
        return []

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Return, in words, the errors for which the tables have no room, with the remaining error in um."""
        return []

    def reservations(self, tables: Tables) -> list[str]:
        """Return what the verdict must state about tables within all limits: what is inferred, missing or unknown."""
        return []

    def other_readings(self, tables: Tables) -> dict[str, Self]:
        """Return the control with other settings that may apply to the same tables, keyed by what it then does.

        Only where no document settles the interpretation: the check program gets a point that distinguishes them.
        """
        return {}

    def usage(self, tables: Tables) -> list[Usage]:
        """Return how much of each limit of the control the tables use."""
        return []


AnyController = Controller[Any, Any]


def nodes_by_axis(nodes_mm: Iterable[tuple[int, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the union of the table nodes of X, Y and Z, ascending, from pairs (axis, positions in mm)."""
    found: list[list[FloatArray]] = [[np.zeros(0)], [np.zeros(0)], [np.zeros(0)]]
    for axis, positions in nodes_mm:
        found[axis].append(np.asarray(positions, dtype=np.float64))
    x, y, z = (np.unique(np.concatenate(parts).round(6)) for parts in found)
    return x, y, z


def travel_of(points: Points, axis: int) -> FloatArray:
    """Return the direction of the last travel of an axis at each point: +1, -1, or 0 if unknown; shape (n,)."""
    return np.zeros(len(points)) if points.approach is None else np.sign(points.approach[:, axis])


def by_travel(travel: FloatArray, positive: FloatArray, negative: FloatArray) -> FloatArray:
    """Return the value after positive or negative travel (n,), the mean of both if the direction is unknown."""
    return np.select([travel > 0, travel < 0], [positive, negative], 0.5 * (positive + negative))


def parameter_row(name: str, value: str, meaning: str) -> dict[str, str]:
    """Return a control parameter with the value that the tables need, as shown in templates and reports."""
    return {"name": name, "value": value, "meaning": meaning}


def coverage_violations(machine: Machine, axis: int, first_mm: float, last_mm: float, what: str) -> list[str]:
    """Return a message if a table from ``first_mm`` to ``last_mm`` leaves part of the axis travel uncovered."""
    low, high = machine.axes[axis].range_mm
    if first_mm <= low + 1e-6 and last_mm >= high - 1e-6:
        return []
    return [f"{what} covers {first_mm:g} ... {last_mm:g} mm of {'XYZ'[axis]}; the travel is {low:g} ... {high:g} mm"]


# Plans for a binary transfer (``*.plan.json``) in addition to the control's text: both must contain the same numbers.


def plan_contradictions(files: Sequence[SourceFile], expected: Callable[[], Mapping[str, Any]]) -> list[str]:
    """Say where a ``.json`` file differs from the plan made from the tables in the text exported with it.

    Parameters
    ----------
    files : all files of one export; nothing is compared if none is a plan.
    expected : returns the plan of the parsed tables, by the keys of the file; other keys of the file are notes.

    Returns
    -------
    One sentence for each unusable plan: not JSON, not an object, or the first number that differs, with its place.
    """
    plans = [file for file in files if file.path.suffix.lower() == ".json"]
    of_tables = json.loads(json.dumps(dict(expected()))) if plans else {}
    return [f"{file.path.name}: {text}" for file in plans if (text := _contradiction(file.text, of_tables))]


def _contradiction(text: str, expected: Mapping[str, Any]) -> str:
    try:
        found = json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as problem:
        return f"is not JSON: {problem}"
    if not isinstance(found, dict):
        return f"contains {_short(found)}; expected an object with {', '.join(expected)}"
    differing = list(_differences({key: found.get(key) for key in expected}, expected, ""))
    if not differing:
        return ""
    where, given, right = differing[0]
    more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
    says = f"{where} is {_short(given)}, but the tables of the same export give {_short(right)}{more}"
    return f"{says}. Leave the plan out, or export again"


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is given twice in one object")
    return found


def _differences(given: Any, expected: Any, where: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(given, dict) and isinstance(expected, dict):
        for key in [*expected, *(key for key in given if key not in expected)]:
            yield from _differences(given.get(key), expected.get(key), f"{where}.{key}" if where else key)
    elif isinstance(given, list) and isinstance(expected, list) and len(given) == len(expected):
        for place, (one, other) in enumerate(zip(given, expected, strict=True)):
            yield from _differences(one, other, f"{where}[{place}]")
    elif given != expected or isinstance(given, bool) != isinstance(expected, bool):
        yield where, given, expected


def _short(value: Any) -> str:
    text = "missing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
