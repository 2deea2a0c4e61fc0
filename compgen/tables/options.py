"""What each option of a control would gain: from the levels on the market to the explanation of one control's table."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls import CONTROLLERS, AnyController, SourceFile, Term, controller_named
from compgen.controls.shared.base import Usage
from compgen.controls.shared.grids import curve_nodes_mm
from compgen.controls.shared.terms import error_terms, one_dimensional_terms, product_terms
from compgen.data.comparison import Residuals, residuals_twice
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Emphasis, Interval, Machine
from compgen.data.names import AXES, COVERAGE, ERROR_NAMES, MM_PER_UM, error_named
from compgen.errors import CompgenError, CompgenWarning, InputError
from compgen.identification.covariance import Covariance
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.first_order import tool_of
from compgen.kinematics.many_points import full_grid, volume_grid, volumetric_error
from compgen.tables import Export, export
from compgen.tables.judge import (
    LargestStep,
    in_both_directions,
    left_by_reversal,
    safety_of,
)
from compgen.tables.synthesis import Projector, basis_field, placed_terms, projector, wanted_correction
from compgen.tables.verification import FigureUncertainty, assumed_lines, volume_uncertainty

# Levels of compensation that controls offer, as bases of terms, and the best that each could do for given errors.
#
# A level has neither quantum nor limits: it is the best that any control of that kind can reach. Each level includes
# the one before it.


Zone = tuple[Interval | None, Interval | None, Interval | None]

#: Levels in their order: key and contents of the tables of that level.
LABELS = {
    "nothing": "no table",
    "pitch": "positioning",
    "straightness": "+ straightness",
    "squareness": "+ squareness",
    "products": "+ angles, as products of tables",
    "volumetric": "full volumetric",
    "directional": "+ direction-dependent",
}
#: The bases get additional nodes between the nodes of the curves, as long as an axis has no more than this many:
#:
#: an angular error times the position of its own axis is not linear between its nodes.
MOST_NODES = 81
MOST_PARTS = 4


@dataclass(frozen=True)
class Level:
    """The best tables of one level: ``values`` of the terms in ``solver``; no solver: no tables.

    Only tables without squareness have ``pitch``: it fits the positioning again after the lines are removed.
    """

    key: str
    solver: Projector | None = None
    values: FloatArray | None = None
    pitch: Projector | None = None
    reversal: ReversalCurves | None = None

    @property
    def label(self) -> str:
        """Contents of the tables in words."""
        return LABELS[self.key]

    def correction(self, position_mm: FloatArray, approach: FloatArray, tool_mm: FloatArray) -> FloatArray:
        """Return what such a control would add at points (n, 3), reached in directions (n, 3), with a tool (3,): mm.

        Only the volumetric levels take account of the tool in use; the others are made for the tool of the machine
        file.
        """
        added = np.zeros_like(position_mm)
        if self.solver is not None and self.values is not None:
            added += basis_field(self.solver.basis, self.values, position_mm, tool_mm)
        if self.reversal is not None:
            added -= self.reversal.displacement(position_mm, approach)
        return added

    def left_alone_um(
        self, machine: Machine, errors: ErrorTable, tools_mm: Sequence[FloatArray], *, anchored: bool = False
    ) -> list[dict[str, float]]:
        """Return the largest displacement (um, first order) left by each single error, for each tool (3,).

        With ``anchored`` the mean over the volume is ignored: such tables cannot express a constant.
        """
        if self.key in ("volumetric", "directional"):  # the control evaluates E = C P with the tool in use
            return [dict.fromkeys(errors.names, 0.0) for _ in tools_mm]
        if self.solver is None:
            levels = [curve_nodes_mm(machine, errors, axis, most=25) for axis in range(3)]
            position_mm, weight = full_grid(levels).reshape(-1, 3), None
        else:
            position_mm, weight = self.solver.position_mm, self.solver.weight
        found: list[dict[str, float]] = [{} for _ in tools_mm]
        for name in errors.names:
            part = errors.only(name)
            added = np.zeros_like(position_mm)
            if self.solver is not None:
                required = -volumetric_error(machine, part, position_mm)
                added = self.solver.field(_best(self.solver, self.pitch, required))
            for tool, left in zip(tools_mm, found, strict=True):
                rest = volumetric_error(machine, part, position_mm, tool) + added
                rest = rest - np.average(rest, axis=0, weights=weight) if anchored else rest
                left[name] = float(np.sqrt(np.max(np.einsum("ij,ij->i", rest, rest)))) / MM_PER_UM
        return found


def in_zone(machine: Machine, zone_mm: Zone | None) -> Machine:
    """Return the machine with its travel cut to a zone (ranges of X, Y, Z, None: all); InputError if it leaves it."""
    if zone_mm is None:
        return machine
    axes = []
    for letter, axis, part in zip(AXES, machine.axes, zone_mm, strict=True):
        low, high = axis.range_mm if part is None else part
        if not axis.range_mm[0] <= low < high <= axis.range_mm[1]:
            raise InputError(
                f"the zone ranges from {low:g} to {high:g} mm in {letter}; it must be within the travel "
                f"{axis.range_mm[0]:g} ... {axis.range_mm[1]:g} mm, the lower end first"
            )
        inside = axis.nodes_mm[(axis.nodes_mm > low) & (axis.nodes_mm < high)]
        axes.append(replace(axis, range_mm=(low, high), nodes_mm=np.array([low, *inside, high])))
    x, y, z = axes
    return replace(machine, axes=(x, y, z), emphasis=Emphasis())


def level_nodes_mm(machine: Machine, errors: ErrorTable) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the nodes of the bases, by axis: those of the curves within the travel, and some between them."""
    x, y, z = (_refined(curve_nodes_mm(machine, errors, axis)) for axis in range(3))
    return x, y, z


def _refined(nodes_mm: FloatArray) -> FloatArray:
    parts = int(np.clip((MOST_NODES - 1) // (len(nodes_mm) - 1), 1, MOST_PARTS))
    where = np.arange(parts * (len(nodes_mm) - 1) + 1) / parts
    return np.asarray(np.interp(where, np.arange(len(nodes_mm)), nodes_mm))


def _best(solver: Projector, pitch: Projector | None, required_mm: FloatArray) -> FloatArray:
    """Return the table values (parameters,) closest to a target field (n, 3); with ``pitch`` those without squareness.

    Without squareness every straightness table is zero at both ends, since its slope is squareness; positioning is then
    fitted again to what is left.
    """
    values = solver.project(required_mm)
    if pitch is None:
        return values
    values, along = values.copy(), np.zeros(len(values), dtype=np.bool_)
    for term, place in placed_terms(solver.basis):
        if term.carrier[0].output == term.axis:
            values[place], along[place] = 0.0, True
        else:
            values[place] -= np.interp(term.nodes_mm, term.nodes_mm[[0, -1]], values[place][[0, -1]])
    values[along] = pitch.project(required_mm - solver.field(values))
    return values


def levels_of(machine: Machine, errors: ErrorTable, reversal: ReversalCurves | None = None) -> list[Level]:
    """Return the best tables of every level over the machine's travel; the last only if a reversal is known.

    The level without squareness has the straightness of the next level, zero at both ends of the travel.
    """
    nodes_mm = level_nodes_mm(machine, errors)
    origin_mm = (0.5 * (machine.lower_mm + machine.upper_mm)).tolist()
    pitch, squareness = (
        one_dimensional_terms(machine, errors, nodes_mm, pairs, lever_origin_mm=origin_mm)
        for pairs in ([(k, k) for k in range(3)], [(output, axis) for output in range(3) for axis in range(3)])
    )
    bases = {
        "pitch": pitch,
        "squareness": squareness,
        "products": squareness + product_terms(machine, errors, nodes_mm, origin_mm),
        "volumetric": error_terms(machine, errors, nodes_mm),
    }
    solvers = {key: projector(machine, basis, anchored=False) for key, basis in bases.items()}
    found = [Level("nothing")]
    for key, solver in solvers.items():
        required = wanted_correction(machine, errors, solver.position_mm)
        if key == "squareness":
            values = _best(solver, solvers["pitch"], required)
            found.append(Level("straightness", solver, values, solvers["pitch"]))
        start = np.concatenate([term.start for term in solver.basis])
        found.append(Level(key, solver, solver.project(required, start)))
    if reversal is not None:
        found.append(replace(found[-1], key="directional", reversal=reversal))
    return found


def level_key(basis: Sequence[Term]) -> str:
    """Return the level that a control's tables belong to, from its basis.

    ``"skew"`` (shears alone) and ``"matrix"`` (with scales) are on the way to none of them.
    """
    if any(term.name in ERROR_NAMES for term in basis):
        return "volumetric"
    if all(term.axis is None for term in basis):
        return "matrix" if any(part.lever == part.output for term in basis for part in term.carrier) else "skew"
    if any(part.lever is not None for term in basis for part in term.carrier):
        return "products"
    if any(part.output != term.axis for term in basis for part in term.carrier):
        return "squareness"
    return "pitch"


# What each option of a control would gain: the residual of every level, and of every control's exported tables.
#
# Levels are judged by the best tables in their basis, controls by the text of their files, read back and emulated.


#: Tool lengths that are evaluated in addition to the tool of the machine file, along Z, mm.
TOOL_LENGTHS_MM = (0.0, -100.0, -200.0)
#: Coordinates of a corrected NC program are written in steps of this length, mm; of controls whose programs have more decimals.
#: These are the last decimals of the dialects in compgen.programs, a later stage (a test holds both to the same).
PROGRAM_STEP_MM = 1e-3
PROGRAM_STEPS_MM: Mapping[str, float] = {
    **dict.fromkeys(("heidenhain-com", "heidenhain-kinematics"), 1e-4),
    **dict.fromkeys(("linuxcnc-comp", "linuxcnc-volumetric"), 1e-5),
}
#: The commands of a program are repeated until they change by less, mm; no more often than this: a table with steps may have
#: no command for a point.
_CONVERGED_MM, _MOST_PASSES = 1e-9, 30
#: Options of a control that are evaluated in addition to the machine file: their description and settings.
VARIANTS: Mapping[str, Sequence[tuple[str, Mapping[str, Any]]]] = {
    "siemens-cec": (("without products", {"products": False}), ("with products", {"products": True})),
    "ucnc": (("compiled for XY only", {"build": "xy-only"}), ("compiled for three", {"build": "three"})),
}
#: Settings that the machine file must state for an export, and what a comparison may assume: in every mode the products
#: leave the same residual, with either sign, too; of two systems of values the one that leaves less.
ASSUMED: Mapping[str, Mapping[str, Any]] = {
    "siemens-cec": {"mult_mode": "S1"},
    "mitsubishi": {"mode": "incremental"},
    "ecmc": {"version": "10.0.0"},
    "weihong": {"sign": "error"},
    "mach4": {"sign": "correction"},
    "fagor-8055": {"sign": "error"},
}


@dataclass(frozen=True)
class Left:
    """Residuals over the volume: with the reference point fixed, and with the best-fit rigid motion removed."""

    after: Residuals
    rigid_removed: Residuals

    def as_dict(self) -> dict[str, Any]:
        """Return both by name."""
        return {"after": self.after.as_dict(), "after_rigid_motion_removed": self.rigid_removed.as_dict()}


@dataclass(frozen=True)
class LevelResult:
    """What the best tables of one level leave.

    ``by_tool`` has one entry per tool: residuals of all errors together, and the largest displacement in um left by
    each single error.
    """

    key: str
    left: Left
    by_tool: tuple[tuple[Left, Mapping[str, float]], ...]

    @property
    def label(self) -> str:
        """Contents of the tables in words."""
        return LABELS[self.key]


@dataclass(frozen=True)
class ProgramResult:
    """What a corrected NC program leaves (``volcomp correct``), without tables or with those of a control active.

    ``left`` comes from the rounding of its coordinates to ``step_mm``, ``u_um`` is the largest standard uncertainty of the tool
    tip, with what was not measured; None if it is not determined.
    """

    left: Left
    step_mm: float
    u_um: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return the residuals, step and uncertainty by name."""
        return {**self.left.as_dict(), "step_um": self.step_mm / MM_PER_UM, "u_um": self.u_um}


@dataclass(frozen=True)
class ControlResult:
    """What the exported file of one control leaves; ``problem`` says why there is no file.

    ``level`` is the key of the level it belongs to, ``directional`` whether its tables depend on the direction of
    travel, ``own`` whether the settings are those of the machine file, ``broken`` how many limits of the control the
    tables exceed.
    """

    name: str
    variant: str
    own: bool
    level: str | None = None
    directional: bool = False
    left: Left | None = None
    both: ProgramResult | None = None
    broken: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problem: str = ""

    @property
    def label(self) -> str:
        """Name with the variant."""
        return f"{self.name}, {self.variant}" if self.variant else self.name


@dataclass(frozen=True)
class Capability:
    """Result of :func:`capability`; ``tools_mm`` are the evaluated tool offsets, that of the machine file first.

    ``uncertainty`` is that of every figure, whatever the tables contain: no table knows more than the measurement. It is
    None if it is not determined; ``assumed`` are the sentences about what was not measured.
    """

    machine: str
    errors: tuple[str, ...]
    tools_mm: tuple[tuple[float, float, float], ...]
    zone_mm: Zone | None
    points: int
    levels: tuple[LevelResult, ...]
    controls: tuple[ControlResult, ...]
    notes: tuple[str, ...] = field(default_factory=tuple)
    program: ProgramResult | None = None
    uncertainty: FigureUncertainty | None = None
    assumed: tuple[str, ...] = ()

    def with_unknown_um(self, left: Left) -> tuple[float, float] | None:
        """Return rms of what is left together with what is not known, um: as it stands, rigid motion removed."""
        if self.uncertainty is None:
            return None
        u = self.uncertainty.rms_um / COVERAGE, self.uncertainty.rms_rigid_removed_um / COVERAGE
        parts = zip((left.after, left.rigid_removed), u, strict=True)
        as_it_stands, rigid = (float(np.hypot(part.rms_um, own)) for part, own in parts)
        return as_it_stands, rigid

    def level(self, key: str) -> LevelResult:
        """Return one level."""
        return next(item for item in self.levels if item.key == key)

    def after(self, key: str) -> LevelResult | None:
        """Return the next level, None after the last."""
        keys = [item.key for item in self.levels]
        place = keys.index(key) + 1
        return self.levels[place] if place < len(keys) else None

    def as_dict(self) -> dict[str, Any]:
        """Return the contents of ``options.json``."""
        return {
            "machine": self.machine,
            "errors": list(self.errors),
            "tools_mm": [list(tool) for tool in self.tools_mm],
            "zone_mm": None if self.zone_mm is None else [part and list(part) for part in self.zone_mm],
            "points": self.points,
            "levels": [
                {
                    "level": item.key,
                    "holds": item.label,
                    **item.left.as_dict(),
                    "tools": [
                        {"tool_mm": list(tool), **left.as_dict(), "uncorrected_um": dict(alone)}
                        for tool, (left, alone) in zip(self.tools_mm, item.by_tool, strict=True)
                    ],
                }
                for item in self.levels
            ],
            "controls": [
                {
                    "controller": item.name,
                    "variant": item.variant,
                    "as_in_machine_file": item.own,
                    "level": item.level,
                    "direction_dependent": item.directional,
                    **({} if item.left is None else item.left.as_dict()),
                    "with_program": None if item.both is None else item.both.as_dict(),
                    "limits_broken": list(item.broken),
                    "notes": list(item.notes),
                    "problem": item.problem or None,
                }
                for item in self.controls
            ],
            "program": None if self.program is None else self.program.as_dict(),
            "after_uncertainty": None if self.uncertainty is None else self.uncertainty.as_dict(),
            "assumed": list(self.assumed),
            "notes": list(self.notes),
        }


def default_tools_mm(machine: Machine) -> tuple[tuple[float, float, float], ...]:
    """Return the tool offset of the machine file, then 0, -100 and -200 mm along Z, each once."""
    lengths = [(0.0, 0.0, length) for length in TOOL_LENGTHS_MM]
    return tuple(dict.fromkeys([machine.tool_offset_mm, *lengths]))


def capability(
    machine: Machine,
    errors: ErrorTable,
    *,
    tools_mm: Sequence[tuple[float, float, float]] = (),
    zone_mm: Zone | None = None,
    reversal: ReversalCurves | None = None,
    templates: Path | None = None,
    controllers: Sequence[str] | None = None,
    covariance: Covariance | None = None,
) -> Capability:
    """Return what every level of option and every control leaves of the errors.

    Parameters
    ----------
    machine, errors : the machine and its errors; evaluated with the exact model.
    tools_mm : tool offsets in addition to that of the machine file; default 0, -100, -200 mm along Z.
    zone_mm : ranges of X, Y, Z that matter (None: all); levels are fitted to it, and controls' files with this work zone.
    reversal : difference between the directions of travel; all points are then evaluated from both sides.
    templates : the user's templates, searched first.
    controllers : names of the controls, default all.
    covariance : of the errors, with what is known of those that were not measured; by default from their u.
    """
    whole = machine
    zone = in_zone(machine, zone_mm)
    if zone_mm is not None:
        machine = replace(machine, emphasis=replace(machine.emphasis, zone_mm=zone_mm))
    tools = tuple(dict.fromkeys([machine.tool_offset_mm, *tools_mm])) if tools_mm else default_tools_mm(machine)
    nodes = tuple(curve_nodes_mm(zone, errors, axis) for axis in range(3))
    points = Points(volume_grid(zone, nodes).position_mm)
    points = points if reversal is None else in_both_directions(points)
    approach = np.zeros_like(points.position_mm) if points.approach is None else points.approach
    offsets = [np.array(item, dtype=np.float64) for item in tools]
    reversed_um = left_by_reversal(reversal, corrected=False)
    levels = []
    for level in levels_of(zone, errors, reversal):
        left_um = left_by_reversal(reversal, corrected=level.reversal is not None)
        by_tool = []
        for tool, alone in zip(offsets, level.left_alone_um(zone, errors, offsets), strict=True):
            correction = level.correction(points.position_mm, approach, tool)
            left = _left(zone, errors, points, correction, reversal, tool)
            by_tool.append((left, {**alone, **dict.fromkeys(reversed_um, 0.0), **left_um}))
        levels.append(LevelResult(level.key, by_tool[0][0], tuple(by_tool)))
    unknown = volume_uncertainty(whole, errors, points.position_mm, covariance)
    u_um = None if unknown is None else unknown.max_um / COVERAGE
    program = _left_by_program(zone, errors, points, reversal, PROGRAM_STEP_MM)
    controls = [
        _control_result(variant, changed, errors, points, reversal, templates, u_um)
        for name in (CONTROLLERS if controllers is None else controllers)
        for variant, changed in _variants(machine, name)
    ]
    return Capability(
        machine=machine.name,
        errors=errors.names,
        tools_mm=tools,
        zone_mm=zone_mm,
        points=len(points),
        levels=tuple(levels),
        controls=tuple(controls),
        notes=tuple(_notes(machine, errors, reversal)),
        program=ProgramResult(program, PROGRAM_STEP_MM, u_um),
        uncertainty=unknown,
        assumed=assumed_lines(whole, errors, covariance),
    )


def _left(
    machine: Machine,
    errors: ErrorTable,
    points: Points,
    correction_mm: FloatArray,
    reversal: ReversalCurves | None,
    tool_mm: FloatArray,
) -> Left:
    """Residuals of the exact machine with a correction (n, 3) at the points and a tool (3,)."""
    error = exact_error(machine, errors, points.position_mm + correction_mm, tool_mm) + correction_mm
    if reversal is not None and points.approach is not None:
        error = error + reversal.displacement(points.position_mm, points.approach)
    nominal = points.position_mm + tool_mm
    return Left(*residuals_twice(nominal, error))


def _left_by_program(
    machine: Machine,
    errors: ErrorTable,
    points: Points,
    reversal: ReversalCurves | None,
    step_mm: float,
    tables: Callable[[Points], FloatArray] = lambda points: np.zeros_like(points.position_mm),
) -> Left:
    """Residuals with commands c that solve c + T(c) + E(c + T(c)) = p, rounded to ``step_mm``; T are active tables."""
    tool = tool_of(machine, None)

    def off(command: FloatArray) -> FloatArray:
        added = tables(replace(points, position_mm=command))
        error = exact_error(machine, errors, command + added, tool)
        if reversal is not None and points.approach is not None:
            error = error + reversal.displacement(command + added, points.approach)
        return np.asarray(command + added + error - points.position_mm)

    command = points.position_mm
    for _ in range(_MOST_PASSES):
        change = off(command)
        command = command - change
        if np.abs(change).max() < _CONVERGED_MM:
            break
    return Left(*residuals_twice(points.position_mm + tool, off(step_mm * np.round(command / step_mm))))


def _settings(machine: Machine, name: str) -> Any:
    """Return the settings of a control, or None if the machine file does not state all that an export needs."""
    try:
        control = controller_named(name)(machine)
    except CompgenError:
        return None
    return control.settings if control.missing() is None else None


def _variants(machine: Machine, name: str) -> list[tuple[ControlResult, Machine]]:
    """Return the variants of a control, still without a result, each with the machine that has its settings."""
    given = _settings(machine, name)
    found = []
    for words, changes in VARIANTS.get(name, (("", {}),)):
        other, notes = _with_settings(machine, name, changes), tuple[str, ...]()
        if _settings(other, name) is None:
            stated = machine.controller_settings(name).data
            assumed = {key: value for key, value in ASSUMED.get(name, {}).items() if key not in stated}
            other = _with_settings(machine, name, {**assumed, **changes})
            notes = tuple(
                f"{key} is not stated in the machine file; {assumed[key]!r} is assumed here" for key in assumed
            )
        own = given is not None and all(getattr(given, key) == value for key, value in changes.items())
        found.append((ControlResult(name, words, own or not changes, notes=notes), other))
    return found


def _with_settings(machine: Machine, name: str, changes: Mapping[str, Any]) -> Machine:
    section = machine.controller_settings(name)
    data = {**section.data, **changes}
    return replace(machine, controllers={**machine.controllers, name: section.again(data)})


def _control_result(
    variant: ControlResult,
    machine: Machine,
    errors: ErrorTable,
    points: Points,
    reversal: ReversalCurves | None,
    templates: Path | None,
    u_um: float | None,
) -> ControlResult:
    """Export, read the text back, emulate it at the points; if a control cannot be exported, say why.

    A program of the control is then made for the errors that these tables leave, so that nothing is corrected twice.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            control = controller_named(variant.name)(machine)
            made = export(machine, errors, variant.name, templates=templates, allow_unverified=True, reversal=reversal)
            texts = [SourceFile(Path(name), text) for name, text in made.files.items()]
            tables = control.parse(texts)
            correction = np.asarray(control.emulate(tables, points))
            level = level_key(control.basis(errors))
            step_mm = PROGRAM_STEPS_MM.get(variant.name, PROGRAM_STEP_MM)
            both = _left_by_program(
                machine, errors, points, reversal, step_mm, lambda at: np.asarray(control.emulate(tables, at))
            )
    except CompgenError as error:
        return replace(variant, problem=str(error))
    left = _left(machine, errors, points, correction, reversal, tool_of(machine, None))
    directional = reversal is not None and bool(control.reversal_in_tables(reversal).curves)
    program = ProgramResult(both, step_mm, u_um)
    broken = tuple(made.violations)
    return replace(variant, level=level, directional=directional, left=left, both=program, broken=broken)


def missing_notes(machine: Machine, errors: ErrorTable) -> list[str]:
    """Return which of the 21 errors are unknown, and when that matters."""
    missing = [name for name in ERROR_NAMES if name not in errors.names]
    if not missing:
        return []
    if machine.prior.is_none:
        return [f"not measured, so no table corrects them: {', '.join(missing)}; what they do is not determined"]
    return [
        f"not measured, so no table corrects them: {', '.join(missing)}; what they may do is in the uncertainty of run and "
        "verify, also with other tool offsets than the one used in the measurement"
    ]


def _notes(machine: Machine, errors: ErrorTable, reversal: ReversalCurves | None) -> list[str]:
    if reversal is None:
        return [*missing_notes(machine, errors), "no reversal was given: both directions of travel are assumed equal"]
    return [
        *missing_notes(machine, errors),
        "controls without direction-dependent tables are shown with the full reversal; their backlash parameter "
        "corrects the part along the axis",
    ]


# Explanation of a control's table: what it corrects, what remains, what the next option would gain, limits used.


#: Errors of which less than this remains count as corrected, um.
CORRECTED_UM = 0.1


@dataclass(frozen=True)
class Fate:
    """One error: the displacement in um that it causes by itself, how much of it remains, and why."""

    name: str
    before_um: float
    after_um: float
    why: str


@dataclass(frozen=True)
class Explanation:
    """Result of :func:`explain`.

    ``nodes`` has number, first and last node and smallest and largest step (mm) of the tables over each axis,
    ``rounding_um`` is the largest change of a correction by rounding, ``steps`` the largest steps between neighbouring
    nodes.
    """

    controller: str
    machine: str
    level: str
    fates: tuple[Fate, ...]
    nodes: Mapping[str, Mapping[str, float]]
    rounding_um: float
    steps: tuple[LargestStep, ...]
    usage: tuple[Usage, ...]
    violations: tuple[str, ...]
    options: Capability
    own: ControlResult | None
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "controller": self.controller,
            "level": self.level,
            "errors": [asdict(item) for item in self.fates],
            "nodes": {axis: dict(item) for axis, item in self.nodes.items()},
            "rounding_um": self.rounding_um,
            "steps": [asdict(item) for item in self.steps],
            "limits": [{**asdict(item), "share": item.share} for item in self.usage],
            "limits_broken": list(self.violations),
            "options": self.options.as_dict(),
        }


def explain(
    machine: Machine,
    errors: ErrorTable,
    exported: Export,
    *,
    reversal: ReversalCurves | None = None,
    templates: Path | None = None,
    covariance: Covariance | None = None,
) -> Explanation:
    """Explain exported files from their text; ``errors``, ``reversal`` and ``templates`` are those of the export.

    ``covariance`` is that of the errors, as for :func:`capability`.
    """
    control = controller_named(exported.controller)(machine)
    tables = control.parse([SourceFile(Path(name), text) for name, text in exported.files.items()])
    solver = projector(machine, control.basis(errors), anchored=control.anchored)
    values = np.concatenate([term.start for term in solver.basis])
    level = level_key(solver.basis)
    safety = safety_of(machine, control, tables, lambda part: solver.field(values, part))
    rest = None  # what direction-dependent tables do not correct
    if reversal is not None:
        rest = reversal.without(control.reversal_in_tables(reversal))
    known = rest if rest is not None and rest.curves else None
    options = capability(
        machine, errors, reversal=known, templates=templates, controllers=(control.name,), covariance=covariance
    )
    usage = sorted(control.usage(tables), key=lambda item: -item.share)
    before, after = (
        item.left_alone_um(machine, errors, [tool_of(machine, None)], anchored=control.anchored)[0]
        for item in (Level("nothing"), Level("own", solver))
    )
    fates = [
        Fate(name, before[name], after[name], _why(name, level) if after[name] > CORRECTED_UM else "")
        for name in sorted(before, key=lambda name: -after[name])
    ]
    turned_um, kept_um = (left_by_reversal(part, corrected=False) for part in (reversal, rest))
    why = "the tables act in the same way in both directions: the control's backlash parameter corrects the part along the axis"
    fates += [
        Fate(name, value, kept_um.get(name, 0.0), why if name in kept_um else "") for name, value in turned_um.items()
    ]
    return Explanation(
        controller=control.name,
        machine=machine.name,
        level=level,
        fates=tuple(fates),
        nodes=_nodes(control, tables),
        rounding_um=control.resolution_mm() / MM_PER_UM,
        steps=safety.steps,
        usage=tuple(usage),
        violations=tuple(exported.violations),
        options=options,
        own=next((item for item in options.controls if item.own), None),
        notes=tuple(missing_notes(machine, errors)),
    )


def _why(name: str, level: str) -> str:
    """Return why a control of this level leaves an error."""
    error = error_named(name)
    if level == "skew":
        return "skew factors hold squareness alone, as far as the control has them"
    if level == "matrix":
        return "a matrix holds squareness and the mean scale of each axis"
    if level in ("products", "volumetric"):
        return "the nodes of the tables do not follow it closely"
    if error.kind == "angular":
        return "its lever changes with another axis: products of tables or a volumetric function can correct it"
    if level == "pitch":
        across = "squareness" if error.kind == "squareness" else "straightness"
        return f"{across} moves the tool across the axis: tables of one axis over another can correct it"
    return "the nodes of the tables do not follow it closely"


def _nodes(control: AnyController, tables: Any) -> dict[str, dict[str, float]]:
    found = {}
    for letter, nodes in zip(AXES, control.table_nodes_mm(tables), strict=True):
        if len(nodes) > 1:
            steps = np.diff(nodes)
            found[letter] = {
                "nodes": len(nodes),
                "first_mm": float(nodes[0]),
                "last_mm": float(nodes[-1]),
                "smallest_step_mm": float(steps.min()),
                "largest_step_mm": float(steps.max()),
            }
    return found
