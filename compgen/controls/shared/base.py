"""What every control has in common: a basis of tables, text that is built, parsed and emulated, transfer plans."""

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
from compgen.data.error_table import ErrorTable, ReversalCurves, hat_matrix
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.errors import InputError
from compgen.kinematics.first_order import factor

# What every control has in common: a basis of tables, and text that is built, parsed and emulated.
#
# A control is described by its **basis**: a list of :class:`Term`, each one table (a curve over one axis, or a
# constant) times a carrier field. The stage ``export`` finds the table values whose correction field comes closest to
# the required one; the control turns them into its own numbers, parses them back from text, and emulates what it does.


Settings = TypeVar("Settings")
Tables = TypeVar("Tables")


@dataclass(frozen=True)
class Monomial:
    """A carrier: ``sign`` times (factor minus ``origin_mm``) on axis ``output``.

    ``lever`` as in :class:`compgen.kinematics.first_order.Coefficient`: None for the factor 1, 0..2 an axis coordinate,
    3..5 the tool offset.
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
    start : natural values, shape (n,); kept in directions that the required correction does not determine.
    zero_at_mm : position where the interpolated value must be zero, or None.
    keep_mm : positions where the value should stay at its start as far as the required correction leaves a choice (a
        line may be in a straightness or in a squareness); this keeps the zeros of the fitted curves.
    zeros_mm : positions of nodes whose values are zero to the last digit, as in ``start``.
    """

    name: str
    axis: int | None
    nodes_mm: FloatArray
    carrier: tuple[Monomial, ...]
    start: FloatArray
    zero_at_mm: float | None = None
    keep_mm: tuple[float, ...] = ()
    zeros_mm: tuple[float, ...] = ()

    def curve_matrix(self, position_mm: FloatArray) -> FloatArray:
        """Interpolation matrix (m, n) at commanded positions (m, 3)."""
        if self.axis is None:
            return np.ones((len(position_mm), 1))
        return hat_matrix(self.nodes_mm, position_mm[:, self.axis])

    def curve(self, values: FloatArray, position_mm: FloatArray) -> FloatArray:
        """Interpolated values (n,) at commanded positions (m, 3): shape (m,)."""
        if self.axis is None:
            return np.full(len(position_mm), values[0])
        return np.interp(position_mm[:, self.axis], self.nodes_mm, values)

    def carrier_field(self, position_mm: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Carrier at commanded positions (m, 3) with tool offset (3,) or (m, 3): shape (m, 3)."""
        field = np.zeros((len(position_mm), 3))
        for part in self.carrier:
            field[:, part.output] += part.sign * (factor(part.lever, position_mm, tool_mm) - part.origin_mm)
        return field


@dataclass(frozen=True)
class SourceFile:
    """One file that is to be parsed as controller data: its path and its text."""

    path: Path
    text: str

    def fail(self, message: str, line: int | None = None) -> InputError:
        """Return the error that points at a line of this file (counting from 1)."""
        return InputError(message, file=self.path, line=line)


@dataclass(frozen=True)
class Usage:
    """How much of one limit is used, in ``unit``: ``used`` of ``allowed``; ``stated`` is False for a usual default."""

    name: str
    used: float
    allowed: float
    unit: str
    stated: bool = True

    @property
    def share(self) -> float:
        """Used part of the limit, 1 where it is reached."""
        return self.used / self.allowed if self.allowed else float(self.used > 0)


class Controller(ABC, Generic[Settings, Tables]):
    """One control: everything that is particular to its files and to what it does with them.

    An instance is the control of one machine: it has read its section ``[controllers.<name>]`` of the machine file.
    Corrections are in mm, what the control ADDS to the commanded position, shape (n, 3); the sign convention of the
    stored numbers is the control's own affair and lives in its ``build``, ``parse`` and ``emulate``.

    Parameters
    ----------
    machine : the machine.
    settings : None: those of the machine file; else the control as it would be with these.
    """

    #: Name on the command line, and of its folder below ``templates/``.
    name: str
    #: Dataclass of the settings; its fields say key, check, default and meaning (``compgen.data.toml_files.setting``).
    settings_class: type[Settings]
    #: True if a table is zero at the reference point by nature, so that a constant offset cannot be corrected.
    anchored: bool = False
    #: True if tables may act in one direction of travel only, so that a reversal goes into them.
    bidirectional: bool = False
    #: True if tables are looked up where the axes are, after the correction, and not at the command.
    at_axes: bool = False
    #: True if the correction is not the sum of the tables: the control moves the chain by finite rotations.
    finite_rotations: bool = False
    #: True if a plan for a binary transfer (``plan`` of the context, a ``.json`` file) is written beside the text.
    has_plan: bool = False
    #: Folder with the sub-folder of templates of a plug-in's control; None: the shipped templates.
    templates: Path | None = None
    #: Setting that names a file of the user's own control to follow: "style_from", "template_from", or None.
    sample_setting: str | None = None

    def __init__(self, machine: Machine, settings: Settings | None = None) -> None:
        self.machine = machine
        self.settings = self.read_settings(machine) if settings is None else settings

    @classmethod
    def read_settings(cls, machine: Machine) -> Settings:
        """Read ``[controllers.<name>]`` of the machine file; InputError for what is missing, unknown or wrong.

        The settings are those that the fields of ``settings_class`` declare.
        """
        section = cls.settings_section(machine)
        settings = cls.check_settings(toml_files.take_settings(cls.settings_class, section), section, machine)
        section.finish()
        return settings

    @classmethod
    def settings_section(cls, machine: Machine) -> toml_files.Section:
        """Return the section of the machine file that the settings are read from."""
        return machine.controller_settings(cls.name)

    @classmethod
    def check_settings(cls, settings: Settings, section: toml_files.Section, machine: Machine) -> Settings:
        """Check what depends on several keys or on the machine; return the settings with the defaults that do."""
        return settings

    def missing(self) -> InputError | None:
        """Return the error of a setting that an export needs and reading does not; ``build`` raises it. None: complete."""
        return None

    @abstractmethod
    def basis(self, errors: ErrorTable) -> list[Term]:
        """Return the tables that the control would get for these errors, in correction space (mm added per unit)."""

    def basis_of(self, errors: ErrorTable, tables: Tables) -> list[Term]:
        """Return the basis that parsed tables are judged by: that of these errors.

        A control with room for some of its tables only may take what the given tables hold, where that is as good.
        """
        return self.basis(errors)

    @abstractmethod
    def build(self, basis: Sequence[Term], values: Mapping[str, FloatArray]) -> Tables:
        """Turn term values (by name, shape of the term's nodes) into the control's own numbers, rounded as written."""

    @abstractmethod
    def context(self, tables: Tables) -> dict[str, Any]:
        """Return what the Jinja2 templates of the control need beyond the common context."""

    @abstractmethod
    def parse(self, files: Sequence[SourceFile]) -> Tables:
        """Read the control's numbers back from text; InputError with file and line for anything malformed."""

    def parse_foreign(self, files: Sequence[SourceFile]) -> tuple[Tables, list[str]] | None:
        """Read files that this program did not write (an archive of a control): the tables that act, and remarks.

        The text may hold any character. What has no bearing on a table is passed over and counted in the remarks, tables of
        axes that the machine file lacks are named there; what could change a table and is not understood is an
        InputError with its line. None (the default): this control has no reader but the strict :meth:`parse`.
        """
        return None

    @abstractmethod
    def emulate(self, tables: Tables, points: Points) -> FloatArray:
        """Return what the control adds to the command at each point, shape (n, 3), mm."""

    @abstractmethod
    def violations(self, tables: Tables) -> list[str]:
        """Return every limit of the control that the tables break, and travel that they do not cover, in words."""

    def contradictions(self, tables: Tables, files: Sequence[SourceFile]) -> list[str]:
        """Return where files that are not needed to read the tables (a plan for their transfer) say something else."""
        return plan_contradictions(files, lambda: self.context(tables)["plan"]) if self.has_plan else []

    def remarks(self, tables: Tables, files: Sequence[SourceFile]) -> list[str]:
        """Return what reading these files assumed, passed over, or kept apart (tables of other axes), in words.

        For a person who reads the backup of a control. Lines that could change a table and are not understood are not
        a remark: ``parse`` refuses them. The default are the ``remarks`` of the tables, if they have any.
        """
        return list(getattr(tables, "remarks", ()))

    def keeping_others(self, tables: Tables, files: Sequence[Path]) -> dict[str, dict[str, Any]]:
        """Return settings with which an export keeps what these files of the user's control hold of other axes.

        By the name of a control and the key of its section. Empty if nothing is there to be kept, or the settings see
        to it already.
        """
        return {}

    @abstractmethod
    def resolution_mm(self) -> float:
        """Return the largest correction error that rounding to the format's quantum may cause on one axis, mm."""

    def anchor_mm(self) -> FloatArray:
        """Return where the tables of an ``anchored`` control are zero by nature, shape (3,): the reference point."""
        return np.array(self.machine.reference_point_mm, dtype=np.float64)

    def table_nodes_mm(self, tables: Tables) -> tuple[FloatArray, ...]:
        """Return the positions of X, Y and Z at which parsed tables have a node, ascending, also outside the travel.

        An axis over which there is no table has none. The default knows none at all.
        """
        return (np.zeros(0), np.zeros(0), np.zeros(0))

    def reversal_in_tables(self, reversal: ReversalCurves) -> ReversalCurves:
        """Return the part of a reversal that goes into tables of one direction; ``with_reversal`` gets just this."""
        return reversal if self.bidirectional else ReversalCurves({})

    def with_reversal(self, tables: Tables, reversal: ReversalCurves) -> Tables:
        """Return the tables with the reversal in them; only for controls that are ``bidirectional``."""
        raise TypeError(f"{self.name} has no tables of one direction")

    def backlash_parameters(self, reversal: ReversalCurves) -> list[dict[str, str]]:
        """Return the control's backlash parameters (name, value, meaning) for a reversal that no table holds."""
        return []

    def left_out(self, errors: ErrorTable) -> list[str]:
        """Return what of these errors the tables could hold but have no room for, in words with what stays in um."""
        return []

    def reservations(self, tables: Tables) -> list[str]:
        """Return what the verdict must say of tables that break no limit: what is inferred, missing or not known."""
        return []

    def other_readings(self, tables: Tables) -> dict[str, Self]:
        """Return the control with other settings that may be true of the same tables, by what it then does, in words.

        Only where no document settles the reading: the check program gets a point that tells them apart.
        """
        return {}

    def usage(self, tables: Tables) -> list[Usage]:
        """Return how much of each limit of the control the tables use."""
        return []


AnyController = Controller[Any, Any]


def nodes_by_axis(nodes_mm: Iterable[tuple[int, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the union of table nodes for X, Y and Z, ascending, from pairs (axis, positions in mm)."""
    found: list[list[FloatArray]] = [[np.zeros(0)], [np.zeros(0)], [np.zeros(0)]]
    for axis, positions in nodes_mm:
        found[axis].append(np.asarray(positions, dtype=np.float64))
    x, y, z = (np.unique(np.concatenate(parts).round(6)) for parts in found)
    return x, y, z


def travel_of(points: Points, axis: int) -> FloatArray:
    """Return the direction of the last travel of an axis at each point, +1 or -1, 0 where it is not known: shape (n,)."""
    return np.zeros(len(points)) if points.approach is None else np.sign(points.approach[:, axis])


def by_travel(travel: FloatArray, positive: FloatArray, negative: FloatArray) -> FloatArray:
    """Return the value after positive or negative travel (n,), the mean of both where the direction is not known."""
    return np.select([travel > 0, travel < 0], [positive, negative], 0.5 * (positive + negative))


def parameter_row(name: str, value: str, meaning: str) -> dict[str, str]:
    """Return a parameter of the control with the value that the tables need, as the templates and reports show it."""
    return {"name": name, "value": value, "meaning": meaning}


def coverage_violations(machine: Machine, axis: int, first_mm: float, last_mm: float, what: str) -> list[str]:
    """Return a message if a table from ``first_mm`` to ``last_mm`` leaves a part of the axis' travel uncovered."""
    low, high = machine.axes[axis].range_mm
    if first_mm <= low + 1e-6 and last_mm >= high - 1e-6:
        return []
    return [f"{what} covers {first_mm:g} ... {last_mm:g} mm of {'XYZ'[axis]}, the travel is {low:g} ... {high:g} mm"]


# Plans for a binary transfer (``*.plan.json``) in addition to the text of a control: both must hold the same numbers.


def plan_contradictions(files: Sequence[SourceFile], expected: Callable[[], Mapping[str, Any]]) -> list[str]:
    """Say where a ``.json`` file differs from the plan that the tables in the text exported with it make.

    Parameters
    ----------
    files : all files of one export; without a plan among them nothing is compared.
    expected : gives the plan of the parsed tables, by the keys of the file; other keys of the file are notes.

    Returns
    -------
    One sentence for each plan that cannot be used: no JSON, no object, or the first number that differs, with its place.
    """
    plans = [file for file in files if file.path.suffix.lower() == ".json"]
    wanted = json.loads(json.dumps(dict(expected()))) if plans else {}
    return [f"{file.path.name}: {text}" for file in plans if (text := _contradiction(file.text, wanted))]


def _contradiction(text: str, wanted: Mapping[str, Any]) -> str:
    try:
        found = json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as problem:
        return f"is not JSON: {problem}"
    if not isinstance(found, dict):
        return f"contains {_short(found)}, a plan is an object with {', '.join(wanted)}"
    differing = list(_differences({key: found.get(key) for key in wanted}, wanted, ""))
    if not differing:
        return ""
    where, given, right = differing[0]
    more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
    says = f"{where} is {_short(given)}, but the tables exported with it say {_short(right)}{more}"
    return f"{says}: leave the plan out, or export again"


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is given twice in one object")
    return found


def _differences(given: Any, due: Any, where: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(given, dict) and isinstance(due, dict):
        for key in [*due, *(key for key in given if key not in due)]:
            yield from _differences(given.get(key), due.get(key), f"{where}.{key}" if where else key)
    elif isinstance(given, list) and isinstance(due, list) and len(given) == len(due):
        for place, (one, other) in enumerate(zip(given, due, strict=True)):
            yield from _differences(one, other, f"{where}[{place}]")
    elif given != due or isinstance(given, bool) != isinstance(due, bool):
        yield where, given, due


def _short(value: Any) -> str:
    text = "missing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
