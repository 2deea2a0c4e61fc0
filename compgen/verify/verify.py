"""The round trip: parse the written text, emulate the control, and look at what the exact machine then does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controllers import AnyController, SourceFile, controller_named
from compgen.controllers.grids import curve_nodes_mm
from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.files import read_bytes, sha256_of
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.points import Points
from compgen.errors import InputError
from compgen.export.synthesis import Projector, projector, wanted_correction
from compgen.model.exact import exact_error
from compgen.model.grid import VolumeGrid, volume_grid
from compgen.model.volumetric import tool_of, volumetric_error
from compgen.verify.components import components, rms
from compgen.verify.residuals import Residuals, residuals, without_rigid_motion
from compgen.verify.scan import displacement_uncertainty, point_reasons, scan_lines

#: A component of the correction may miss the best possible one by this share of it ...
COMPONENT_SHARE = 0.3
#: ... or by this much, whichever is larger; the quantum of the format comes on top, and this many standard
#: uncertainties of the errors (what smoothing may take away), up to COMPONENT_SHARE of the whole correction.
COMPONENT_FLOOR_MM = 0.2 * MM_PER_UM
COMPONENT_UNCERTAINTIES = 0.5
#: Errors that stay uncorrected by less than this are not named.
NAMED_FROM_MM = 0.1 * MM_PER_UM

#: A control that cannot express more than this share of the largest error gives a partial compensation.
PARTIAL_SHARE = 0.1


@dataclass(frozen=True)
class ReadTables:
    """Controller tables as they were parsed from text, with the control that understands them."""

    controller: AnyController
    settings: Any
    tables: Any
    files: tuple[tuple[str, str], ...]

    def correction(self, machine: Machine, points: Points) -> FloatArray:
        """Return what the control adds to the command at each point, shape (n, 3), mm."""
        return np.asarray(self.controller.emulate(machine, self.settings, self.tables, points))


def read_tables(machine: Machine, paths: Sequence[str | Path] | str | Path, controller: str) -> ReadTables:
    """Parse controller files.

    Parameters
    ----------
    machine : its ``[controllers.<name>]`` settings say how the control reads them.
    paths : the files.
    controller : name of the control.

    Raises
    ------
    InputError
        with file and line for whatever is malformed.
    """
    control = controller_named(controller)
    settings = control.read_settings(machine)
    files = [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]
    if not files:
        raise InputError("no table file was given")
    contents = [(path, read_bytes(path)) for path in files]
    sources = [SourceFile(path, _decode(path, content)) for path, content in contents]
    tables = control.parse(machine, settings, sources)
    return ReadTables(control, settings, tables, tuple((path.name, sha256_of(content)) for path, content in contents))


def _decode(path: Path, content: bytes) -> str:
    try:
        return content.decode("ascii")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(
            "holds a byte that is not ASCII; controller tables are ASCII text", file=path, line=line
        ) from None


@dataclass(frozen=True)
class Verification:
    """Result of :func:`verify`; residuals of the exact model over the same points before and after.

    ``reasons`` says why the tables are not accepted (empty: accepted). ``unrepresentable_um`` is the largest residual
    that the best table of this control leaves (a constant offset is left out if the control cannot hold one), and
    ``uncorrected_um`` names the errors behind it with the largest displacement that stays.
    """

    controller: str
    before: Residuals
    after: Residuals
    before_rigid_removed: Residuals
    after_rigid_removed: Residuals
    unrepresentable_um: float
    uncorrected_um: dict[str, float]
    points: int
    files: tuple[tuple[str, str], ...]
    reasons: tuple[str, ...]
    position_mm: FloatArray = field(repr=False)
    error_before_mm: FloatArray = field(repr=False)
    error_after_mm: FloatArray = field(repr=False)

    @property
    def accepted(self) -> bool:
        """Whether the tables may be loaded."""
        return not self.reasons

    @property
    def partial(self) -> bool:
        """Whether the control cannot express a good part of the error: the table is right, but much stays."""
        return self.unrepresentable_um > PARTIAL_SHARE * self.before.max_um

    @property
    def notes(self) -> tuple[str, ...]:
        """What else the user should know of accepted tables."""
        notes = []
        if self.partial:
            share = 100.0 * self.after_rigid_removed.rms_um / max(self.before_rigid_removed.rms_um, 1e-12)
            notes.append(
                f"partial: this control cannot express {self.unrepresentable_um:.0f} um of the error; "
                f"{share:.0f} % of the rms stays (rigid motion taken out)"
            )
        if self.after.max_um > self.before.max_um + 0.05 or self.after.rms_um > self.before.rms_um + 0.05:
            notes.append(
                f"as it stands the error grows from {self.before.max_um:.1f} to {self.after.max_um:.1f} um max, "
                f"{self.before.rms_um:.1f} to {self.after.rms_um:.1f} um rms, by a rigid motion of the workpiece"
            )
        return tuple(notes)

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``result.json``."""
        return {
            "accepted": self.accepted,
            "partial": self.partial,
            "notes": list(self.notes),
            "reasons": list(self.reasons),
            "controller": self.controller,
            "points": self.points,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "before_rigid_motion_removed": self.before_rigid_removed.as_dict(),
            "after_rigid_motion_removed": self.after_rigid_removed.as_dict(),
            "unrepresentable_um": self.unrepresentable_um,
            "uncorrected_um": self.uncorrected_um,
            "files": [{"name": name, "sha256": digest} for name, digest in self.files],
        }


def verify(machine: Machine, tables: ReadTables, errors: ErrorTable, points: Points | None = None) -> Verification:
    """Judge parsed tables against the errors of the machine.

    Parameters
    ----------
    machine : the machine.
    tables : from :func:`read_tables`.
    errors : usually the identified errors; the exact model moves with them.
    points : where the residuals are reported; default the grid of the nodes of curves and tables and the middles
        between them. The judgement itself is always made on that grid and on lines along the axes.
    """
    control = tables.controller
    solver = projector(machine, control.basis(machine, tables.settings, errors), anchored=control.anchored)
    nodes = _nodes(machine, errors, solver)
    grid = volume_grid(machine, nodes)
    where = points or Points(grid.position_mm)
    before, after = _errors_before_after(machine, tables, errors, where)
    nominal = where.position_mm + tool_of(machine, where.tool_mm)
    wanted = wanted_correction(machine, errors, grid.position_mm)
    values = _best_values(machine, errors, solver)
    best = solver.field(values, grid.position_mm)
    rest = wanted - best
    if control.anchored:
        rest = rest - rest.mean(axis=0)
    correction = tables.correction(machine, Points(grid.position_mm))
    reasons = [
        *control.violations(machine, tables.settings, tables.tables),
        *_shrink_reasons(machine, tables, errors, Points(grid.position_mm)),
        *_component_reasons(grid, correction, best, _slack(machine, tables, errors, best, grid.position_mm)),
        *_scan_reasons(machine, tables, errors, solver, values, nodes),
    ]
    return Verification(
        controller=control.name,
        before=residuals(before),
        after=residuals(after),
        before_rigid_removed=residuals(without_rigid_motion(nominal, before)),
        after_rigid_removed=residuals(without_rigid_motion(nominal, after)),
        unrepresentable_um=float(np.max(np.linalg.norm(rest, axis=1))) / MM_PER_UM,
        uncorrected_um=_uncorrected(machine, errors, solver),
        points=len(where),
        files=tables.files,
        reasons=tuple(dict.fromkeys(reasons)),
        position_mm=where.position_mm,
        error_before_mm=before,
        error_after_mm=after,
    )


def _errors_before_after(
    machine: Machine, tables: ReadTables, errors: ErrorTable, points: Points
) -> tuple[FloatArray, FloatArray]:
    """Exact errors of the tip without and with the correction; it is looked up at the commanded position."""
    correction = tables.correction(machine, points)
    before = exact_error(machine, errors, points.position_mm, points.tool_mm)
    after = exact_error(machine, errors, points.position_mm + correction, points.tool_mm) + correction
    return before, after


def _nodes(machine: Machine, errors: ErrorTable, solver: Projector) -> tuple[FloatArray, ...]:
    """Return the positions of the curves and of the control's tables, by axis."""
    return tuple(
        np.unique(
            np.concatenate(
                [curve_nodes_mm(machine, errors, axis), *(t.nodes_mm for t in solver.basis if t.axis == axis)]
            ).round(6)
        )
        for axis in range(3)
    )


def _best_values(machine: Machine, errors: ErrorTable, solver: Projector) -> FloatArray:
    """Return all values of the best table within the control's basis, before rounding."""
    start = np.concatenate([term.start for term in solver.basis])
    return solver.project(wanted_correction(machine, errors, solver.position_mm), start)


def _scan_reasons(
    machine: Machine,
    tables: ReadTables,
    errors: ErrorTable,
    solver: Projector,
    values: FloatArray,
    nodes_mm: tuple[FloatArray, ...],
) -> list[str]:
    """Name points on densely sampled lines along the axes where the correction misses the best possible one."""
    position_mm = scan_lines(machine, nodes_mm)
    correction_mm, best_mm = tables.correction(machine, Points(position_mm)), solver.field(values, position_mm)
    u_mm = displacement_uncertainty(machine, errors, position_mm)
    return point_reasons(position_mm, correction_mm, best_mm, u_mm, tables.controller.resolution_mm(tables.settings))


def _slack(
    machine: Machine, tables: ReadTables, errors: ErrorTable, best_mm: FloatArray, position_mm: FloatArray
) -> FloatArray:
    """What the quantum of the format and the uncertainty of the errors explain of a component, shape (3,), mm."""
    u = COMPONENT_UNCERTAINTIES * displacement_uncertainty(machine, errors, position_mm)
    most = COMPONENT_SHARE * np.std(best_mm, axis=0)
    return np.asarray(tables.controller.resolution_mm(tables.settings) + np.minimum(u, most))


def _component_reasons(
    grid: VolumeGrid, correction_mm: FloatArray, best_mm: FloatArray, slack_mm: FloatArray
) -> list[str]:
    """Name every component of the correction that misses the best possible one by more than its share."""
    miss, best, own = (components(grid, part) for part in (correction_mm - best_mm, best_mm, correction_mm))
    reasons = []
    for name in miss:
        limit = max(COMPONENT_SHARE * rms(best[name]), COMPONENT_FLOOR_MM) + slack_mm["XYZ".index(name[0])]
        if rms(miss[name]) > limit:
            ratio = np.sum(own[name] * best[name]) / max(float(np.sum(best[name] ** 2)), 1e-30)
            hint = "; its sign is reversed" if abs(ratio + 1) < 0.1 else ""
            reasons.append(
                f"correction {name}: {rms(own[name]) / MM_PER_UM:.2f} um rms in the table, "
                f"{rms(best[name]) / MM_PER_UM:.2f} um rms needed, they differ by {rms(miss[name]) / MM_PER_UM:.2f} um{hint}"
            )
    return reasons


def _shrink_reasons(machine: Machine, tables: ReadTables, errors: ErrorTable, points: Points) -> list[str]:
    before, after = _errors_before_after(machine, tables, errors, points)
    nominal = points.position_mm + tool_of(machine, None)
    rms_before, rms_after = (
        residuals(without_rigid_motion(nominal, error)).rms_um * MM_PER_UM for error in (before, after)
    )
    if rms_after <= rms_before + 1e-9 or rms_after <= tables.controller.resolution_mm(tables.settings):
        return []
    return [
        f"the residual does not shrink: {rms_before / MM_PER_UM:.2f} um rms before, {rms_after / MM_PER_UM:.2f} um rms "
        "after (rigid motion taken out)"
    ]


def _uncorrected(machine: Machine, errors: ErrorTable, solver: Projector) -> dict[str, float]:
    """Largest displacement in um that the best table leaves of each error alone (first order), where it matters."""
    names = errors.names
    wanted = np.stack([-volumetric_error(machine, errors.only(name), solver.position_mm) for name in names])
    found = {}
    for name, field_mm, values in zip(names, wanted, solver.project_all(wanted), strict=True):
        rest = field_mm - solver.field(values)
        if solver.offsets:
            rest = rest - rest.mean(axis=0)
        largest = float(np.max(np.linalg.norm(rest, axis=1)))
        if largest > NAMED_FROM_MM:
            found[name] = round(largest / MM_PER_UM, 3)
    return dict(sorted(found.items(), key=lambda item: -item[1]))
