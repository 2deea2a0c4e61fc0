"""What each option of a control would buy: the residual that every level leaves, and every control's own exported table.

Levels are judged by the best tables in their basis, controls by the text of their files, read back and emulated.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controllers import CONTROLLERS, SourceFile, controller_named
from compgen.controllers.grids import curve_nodes_mm
from compgen.core import tomlio
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES
from compgen.core.points import Points
from compgen.core.reversal import ReversalCurves
from compgen.errors import CompgenError, CompgenWarning
from compgen.export import export
from compgen.model.exact import exact_error
from compgen.model.grid import volume_grid
from compgen.model.volumetric import tool_of
from compgen.verify.levels import LABELS, Level, Zone, in_zone, level_key, levels_of
from compgen.verify.residuals import Residuals, residuals, without_rigid_motion
from compgen.verify.reversal import in_both_directions, left_by_reversal

#: Tool lengths that are looked at beside the machine's own, along Z, mm.
TOOL_LENGTHS_MM = (0.0, -100.0, -200.0)
#: Options of a control that are looked at beside what the machine file says: words for them, and the settings.
VARIANTS: Mapping[str, Sequence[tuple[str, Mapping[str, Any]]]] = {
    "siemens-cec": (("without products", {"products": False}), ("with products", {"products": True}))
}
#: Settings that the machine file must state for an export, and what a comparison may take instead: in every mode the
#: products leave the same residual; of two systems of values the one that leaves less.
ASSUMED: Mapping[str, Mapping[str, Any]] = {"siemens-cec": {"mult_mode": "S1"}, "mitsubishi": {"mode": "incremental"}}


@dataclass(frozen=True)
class Left:
    """Residuals over the volume: as it stands with the reference point fixed, and without the best-fit rigid motion."""

    after: Residuals
    rigid_removed: Residuals

    def as_dict(self) -> dict[str, Any]:
        """Return both under their names."""
        return {"after": self.after.as_dict(), "after_rigid_motion_removed": self.rigid_removed.as_dict()}


@dataclass(frozen=True)
class LevelResult:
    """What the best tables of one level leave.

    ``by_tool`` has one entry per tool: residuals of all errors together, and the largest displacement in um that each
    error by itself leaves.
    """

    key: str
    left: Left
    by_tool: tuple[tuple[Left, Mapping[str, float]], ...]

    @property
    def label(self) -> str:
        """What the tables hold, in words."""
        return LABELS[self.key]


@dataclass(frozen=True)
class ControlResult:
    """What the exported file of one control leaves; ``problem`` says why there is none.

    ``level`` is the key of the level it belongs to, ``directional`` whether its tables know the direction of travel,
    ``own`` whether the settings are those of the machine file, ``broken`` how many limits of the control the tables break.
    """

    name: str
    variant: str
    own: bool
    level: str | None = None
    directional: bool = False
    left: Left | None = None
    broken: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    problem: str = ""

    @property
    def label(self) -> str:
        """Name with the variant."""
        return f"{self.name}, {self.variant}" if self.variant else self.name


@dataclass(frozen=True)
class Capability:
    """Result of :func:`capability`; ``tools_mm`` are the tool offsets looked at, the machine's own first."""

    machine: str
    errors: tuple[str, ...]
    tools_mm: tuple[tuple[float, float, float], ...]
    zone_mm: Zone | None
    points: int
    levels: tuple[LevelResult, ...]
    controls: tuple[ControlResult, ...]
    notes: tuple[str, ...] = field(default_factory=tuple)

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
            "levels": [self._level_dict(item) for item in self.levels],
            "controls": [_control_dict(item) for item in self.controls],
            "notes": list(self.notes),
        }

    def _level_dict(self, item: LevelResult) -> dict[str, Any]:
        tools = [
            {"tool_mm": list(tool), **left.as_dict(), "uncorrected_um": dict(alone)}
            for tool, (left, alone) in zip(self.tools_mm, item.by_tool, strict=True)
        ]
        return {"level": item.key, "holds": item.label, **item.left.as_dict(), "tools": tools}


def _control_dict(item: ControlResult) -> dict[str, Any]:
    figures = {} if item.left is None else item.left.as_dict()
    return {
        "controller": item.name,
        "variant": item.variant,
        "as_in_machine_file": item.own,
        "level": item.level,
        "direction_dependent": item.directional,
        **figures,
        "limits_broken": list(item.broken),
        "notes": list(item.notes),
        "problem": item.problem or None,
    }


def default_tools_mm(machine: Machine) -> tuple[tuple[float, float, float], ...]:
    """Return the machine's own tool offset, then 0, -100 and -200 mm along Z, each once."""
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
) -> Capability:
    """Say what every level of option and every control leaves of the errors.

    Parameters
    ----------
    machine, errors : what moves, and how wrong; the exact model judges.
    tools_mm : tool offsets to look at beside the machine's own; default 0, -100, -200 mm along Z.
    zone_mm : ranges of X, Y, Z that matter (None: all); levels are fitted to it, and controls' files with this work zone.
    reversal : difference between the directions of travel; then all points are looked at from both sides.
    templates : the user's own templates, searched first.
    controllers : names of the controls to look at, default all.
    """
    zone = in_zone(machine, zone_mm)
    if zone_mm is not None:
        machine = replace(machine, emphasis=replace(machine.emphasis, zone_mm=zone_mm))
    tools = tuple(dict.fromkeys([machine.tool_offset_mm, *tools_mm])) if tools_mm else default_tools_mm(machine)
    points = _points(zone, errors, reversal)
    levels = tuple(
        _level_result(zone, errors, item, points, reversal, tools) for item in levels_of(zone, errors, reversal)
    )
    controls = [
        _control_result(machine, errors, variant, points, reversal, templates)
        for name in (CONTROLLERS if controllers is None else controllers)
        for variant in _variants(machine, name)
    ]
    return Capability(
        machine=machine.name,
        errors=errors.names,
        tools_mm=tools,
        zone_mm=zone_mm,
        points=len(points),
        levels=levels,
        controls=tuple(controls),
        notes=tuple(_notes(errors, reversal)),
    )


def _points(machine: Machine, errors: ErrorTable, reversal: ReversalCurves | None) -> Points:
    nodes = tuple(curve_nodes_mm(machine, errors, axis) for axis in range(3))
    points = Points(volume_grid(machine, nodes).position_mm)
    return points if reversal is None else in_both_directions(points)


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
    return Left(residuals(error), residuals(without_rigid_motion(nominal, error)))


def _level_result(
    machine: Machine,
    errors: ErrorTable,
    level: Level,
    points: Points,
    reversal: ReversalCurves | None,
    tools_mm: Sequence[tuple[float, float, float]],
) -> LevelResult:
    approach = np.zeros_like(points.position_mm) if points.approach is None else points.approach
    by_tool = []
    reversed_um = left_by_reversal(reversal, corrected=False)
    left_um = left_by_reversal(reversal, corrected=level.reversal is not None)
    tools = [np.array(item, dtype=np.float64) for item in tools_mm]
    for tool, alone in zip(tools, level.left_alone_um(machine, errors, tools), strict=True):
        correction = level.correction(points.position_mm, approach, tool)
        left = _left(machine, errors, points, correction, reversal, tool)
        by_tool.append((left, {**alone, **dict.fromkeys(reversed_um, 0.0), **left_um}))
    return LevelResult(level.key, by_tool[0][0], tuple(by_tool))


@dataclass(frozen=True)
class _Variant:
    """A control with the settings of the machine file or others."""

    name: str
    words: str
    machine: Machine
    own: bool
    notes: tuple[str, ...]


def _settings(machine: Machine, name: str) -> Any:
    """Settings of a control, or None if the machine file does not say all that an export must know."""
    control = controller_named(name)
    try:
        settings = control.read_settings(machine)
    except CompgenError:
        return None
    return settings if control.missing(machine, settings) is None else None


def _variants(machine: Machine, name: str) -> list[_Variant]:
    given = _settings(machine, name)
    found = []
    for words, changes in VARIANTS.get(name, (("", {}),)):
        other, notes = _with_settings(machine, name, changes), tuple[str, ...]()
        if _settings(other, name) is None:
            stated = machine.controller_settings(name).data
            assumed = {key: value for key, value in ASSUMED.get(name, {}).items() if key not in stated}
            other = _with_settings(machine, name, {**assumed, **changes})
            notes = tuple(f"{key} is not stated in the machine file; {assumed[key]!r} is taken here" for key in assumed)
        own = given is not None and all(getattr(given, key) == value for key, value in changes.items())
        found.append(_Variant(name, words, other, own or not changes, notes))
    return found


def _with_settings(machine: Machine, name: str, changes: Mapping[str, Any]) -> Machine:
    section = machine.controller_settings(name)
    data = {**section.data, **changes}
    changed = tomlio.Section(data, path=section.path, text=section.text, name=section.name)
    return replace(machine, controllers={**machine.controllers, name: changed})


def _control_result(
    machine: Machine,
    errors: ErrorTable,
    variant: _Variant,
    points: Points,
    reversal: ReversalCurves | None,
    templates: Path | None,
) -> ControlResult:
    """Export, read the text back, emulate it at the points; a control that cannot be exported says why."""
    control = controller_named(variant.name)
    result = ControlResult(variant.name, variant.words, variant.own, notes=variant.notes)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)
            settings = control.read_settings(variant.machine)
            made = export(
                variant.machine, errors, variant.name, templates=templates, allow_unverified=True, reversal=reversal
            )
            texts = [SourceFile(Path(name), text) for name, text in made.files.items()]
            tables = control.parse(variant.machine, settings, texts)
            correction = np.asarray(control.emulate(variant.machine, settings, tables, points))
            level = level_key(control.basis(variant.machine, settings, errors))
    except CompgenError as error:
        return replace(result, problem=str(error))
    left = _left(machine, errors, points, correction, reversal, tool_of(machine, None))
    directional = reversal is not None and bool(control.reversal_in_tables(settings, reversal).curves)
    return replace(result, level=level, directional=directional, left=left, broken=tuple(made.violations))


def missing_notes(errors: ErrorTable) -> list[str]:
    """Say which of the 21 errors are not known, and when that matters."""
    missing = [name for name in ERROR_NAMES if name not in errors.names]
    if not missing:
        return []
    return [
        f"not in the errors file, so taken as zero: {', '.join(missing)}; with a tool of another offset than the one "
        "measured with, some of them act too"
    ]


def _notes(errors: ErrorTable, reversal: ReversalCurves | None) -> list[str]:
    if reversal is None:
        return [*missing_notes(errors), "no reversal was given: both directions of travel are taken as equal"]
    return [
        *missing_notes(errors),
        "controls without tables of one direction are shown with the whole reversal left; their backlash parameter "
        "takes out what lies along the axis",
    ]
