"""Old tables: active during the measurement and removed, merged with new errors into one, or compared with new tables."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.shared.base import Monomial, Term
from compgen.controls.shared.grids import curve_nodes_mm
from compgen.data.circles import Circles
from compgen.data.comparison import figures_of, rms
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Lengths, Points
from compgen.data.machine import Axis, Machine
from compgen.data.names import AXES, MM_PER_UM, SQUARENESS_NAMES, error_named
from compgen.errors import CompgenWarning, ConvergenceError, InputError
from compgen.identification.adjust.unknowns import check_travel
from compgen.identification.covariance import (
    Covariance,
    covariance_of_values,
    covariance_or_independent,
    posterior_with,
)
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.first_order import coefficients, modelled_errors, observable_errors
from compgen.kinematics.many_points import volume_grid
from compgen.tables import wanted_correction
from compgen.tables.judge import components, node_positions
from compgen.tables.synthesis import Projector, projector
from compgen.tables.verification import ReadTables, read_tables, table_files

# Double compensation: a table was active during the measurement, and its effect is removed.
#
# With the correction c of the active table, a machine commanded to p was where the bare machine is at the command q = p
# + c(p), so readings are identified at q. Errors M that were identified without regard to the table, and the errors P
# of the bare machine, are related by
#
#     e(q; P) + c(p) = e(p; M)
#
# with the exact error e; this is solved for P by least squares over the volume, repeated until it converges.


Measurement = Lengths | Deviations | Circles

#: A larger correction means a wrong table or a wrong unit, mm.
LARGEST_CORRECTION_MM = 20.0
#: The iteration has converged when the errors change the tip by less than this, mm.
CONVERGED_MM = 1e-9
MOST_PASSES = 30


@dataclass(frozen=True)
class ActiveTables:
    """Tables that were active while the machine was measured; ``controller`` is the control that they belong to."""

    tables: ReadTables
    paths: tuple[Path, ...] = ()

    @property
    def names(self) -> str:
        """Return the names of the files, for comments."""
        return ", ".join(name for name, _ in self.tables.files)

    @property
    def controller(self) -> str:
        """Name of the control."""
        return self.tables.controller.name

    def correction(self, machine: Machine, points: Points) -> FloatArray:
        """Return what they added to the commands, shape (n, 3), mm; InputError if too large for a compensation."""
        added = self.tables.correction(machine, points)
        largest = float(np.max(np.abs(added), initial=0.0))
        if largest > LARGEST_CORRECTION_MM:
            raise InputError(
                f"the active tables move an axis by {largest:g} mm, too far for a compensation; check the control, "
                "the file and the unit"
            )
        return added

    def summary(self, machine: Machine, points: Points) -> dict[str, object]:
        """Return what goes into reports: control, files, and the largest correction at the measured points, um."""
        return {
            "controller": self.controller,
            "files": [{"name": name, "sha256": digest} for name, digest in self.tables.files],
            "remarks": list(self.tables.remarks),
            "largest_correction_um": float(np.max(np.abs(self.correction(machine, points)))) / MM_PER_UM,
        }


def read_active(machine: Machine, paths: Sequence[str | Path], controller: str) -> ActiveTables:
    """Parse tables that were active while the machine was measured; raises InputError like :func:`read_tables`.

    What reading assumed or kept apart is a CompgenWarning: the file of a control contains more than these tables.
    """
    files = table_files(paths, controller)
    tables = read_tables(machine, files, controller, foreign=True)
    for text in tables.remarks:
        warnings.warn(text, CompgenWarning, stacklevel=2)
    return ActiveTables(tables, tuple(files))


def keeping_others(machine: Machine, targets: Sequence[str], active: ActiveTables) -> Machine:
    """Return the machine with settings that keep what the active files contain of other axes, for controls ``targets``.

    A CompgenWarning says what is kept; a machine whose file already does so is returned unchanged.
    """
    read = active.tables
    found = read.controller.keeping_others(read.tables, active.paths)
    for name in dict.fromkeys(targets):
        for key, value in found.get(name, {}).items():
            machine = machine.with_setting(name, key, value)
            shown = [Path(part).name for part in value] if key == "style_from" and isinstance(value, list) else value
            shown = Path(shown).name if isinstance(shown, str) else shown
            text = f"{name}: the entries of other axes in the --active file are kept, as with {key} = {shown} in the machine file"
            warnings.warn(text, CompgenWarning, stacklevel=2)
    return machine


def without_active(
    machine: Machine, measurement: Measurement, active: ActiveTables
) -> tuple[Machine, Measurement, dict[str, object]]:
    """Return machine, measurement and report as if the bare machine had been measured; exact, nothing is fitted.

    The commanded positions become p + c(p), the actual commands of the axes; deviations refer to these. The travel of
    the returned machine is wider if a corrected position is outside; its nodes, and therefore the curves, are
    unchanged. Circles stay where they are: their radii lose what c adds to them, in the direction of travel.
    """
    if isinstance(measurement, Circles):
        return _circles_without(machine, measurement, active)
    # Commanded positions outside the travel are refused before the tables widen it.
    check_travel(machine, measurement.position_mm, measurement.origin)
    points = Points(measurement.position_mm, measurement.tool_mm, measurement.approach)
    added = active.correction(machine, points)
    shifted = measurement.position_mm + added
    report = active.summary(machine, points)
    if isinstance(measurement, Deviations):
        moved = replace(measurement, position_mm=shifted, deviation_mm=measurement.deviation_mm - added)
        return _widened(machine, shifted), moved, report
    return _widened(machine, shifted), replace(measurement, position_mm=shifted), report


def _circles_without(
    machine: Machine, circles: Circles, active: ActiveTables
) -> tuple[Machine, Circles, dict[str, object]]:
    """Subtract from each radius by how much the point p + c(p) is farther from the centre than p.

    The errors are then those at p + c(p), taken as at p: they differ by about 1e-4 of c.
    """
    from compgen.identification.axis_tests import circle_positions

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)  # said when the circles are identified
        position_mm = circle_positions(machine, circles)
    points = Points(position_mm, approach=circles.travel())
    added, outward = active.correction(machine, points), circles.radius_mm[:, None] * circles.radial()
    farther = np.linalg.norm(outward + added, axis=1) - circles.radius_mm
    moved = replace(circles, deviation_mm=circles.deviation_mm - farther)
    return machine, moved, active.summary(machine, points)


def _widened(machine: Machine, position_mm: FloatArray) -> Machine:
    axes: list[Axis] = []
    for k, axis in enumerate(machine.axes):
        low, high = axis.range_mm
        ends = (min(low, float(position_mm[:, k].min())), max(high, float(position_mm[:, k].max())))
        axes.append(replace(axis, range_mm=ends))
    return replace(machine, axes=(axes[0], axes[1], axes[2]))


def bare_errors(
    machine: Machine, errors: ErrorTable, active: ActiveTables, *, keep_nodes: bool = False
) -> tuple[ErrorTable, float]:
    """Return the errors of the bare machine from errors that were identified while tables were active.

    Parameters
    ----------
    machine : the machine.
    errors : of the machine with its active tables, mm and rad.
    active : these tables.
    keep_nodes : True to add the nodes of the active tables to the curves, so that a finer table loses nothing; by
        default only the nodes of the measured errors.

    Returns
    -------
    The errors, with the uncertainties of ``errors`` (a table's numbers are exact), and the largest displacement in um
    that the returned errors do not express: a correction that corresponds to no error of the chain, or what a finer
    table does between the nodes. The frame is kept: a correction at the reference point becomes a constant in the
    curves.
    """
    measured = [curve_nodes_mm(machine, errors, axis) for axis in range(3)]
    control = active.tables.controller
    own = control.table_nodes_mm(active.tables.tables)
    both = []
    for axis, nodes in enumerate(own):
        low, high = machine.axes[axis].range_mm
        both.append(np.unique(np.concatenate([measured[axis], nodes[(nodes >= low) & (nodes <= high)]])))
    terms = _model_terms(machine, errors, both if keep_nodes else measured)
    solver = projector(machine, terms, anchored=False)
    position_mm = solver.position_mm
    added = active.correction(machine, _upwards(position_mm))
    required = exact_error(machine, errors, position_mm) - added
    values = np.concatenate([term.start for term in solver.basis])
    for _ in range(MOST_PASSES):
        found = _table(machine, errors, solver, values)
        rest = required - exact_error(machine, found, position_mm + added)
        change = solver.project_all(-rest[None])[0]
        values = values + change
        if np.max(np.abs(solver.field(change))) < CONVERGED_MM:
            position_mm = volume_grid(machine, (both[0], both[1], both[2])).position_mm
            added = active.correction(machine, _upwards(position_mm))
            rest = exact_error(machine, errors, position_mm) - added - exact_error(machine, found, position_mm + added)
            return found, float(np.max(np.linalg.norm(rest, axis=1))) / MM_PER_UM
    raise ConvergenceError("the effect of the active tables cannot be removed: the iteration does not converge")


def _upwards(position_mm: FloatArray) -> Points:
    """Return points approached upwards on every axis, for direction-dependent tables."""
    return Points(position_mm, approach=np.ones_like(position_mm))


def _model_terms(machine: Machine, errors: ErrorTable, nodes_mm: Sequence[FloatArray]) -> list[Term]:
    """Return one term per error of the machine's model; values are the errors, carriers minus the columns of C.

    One field is that of many sets of errors; this is the set that is closest to ``errors`` in this sense: an end-to-end
    slope is a squareness error, so both ends of its straightness stay as they are, a constant angle is slopes, so angles
    stay at the reference point, and errors that only another tool would show stay as they are.
    """
    carriers: dict[str, list[Monomial]] = {}
    for part in coefficients(machine.chain, machine.squareness_reference):
        carriers.setdefault(part.error, []).append(Monomial(part.output, -part.sign, part.lever))
    names = dict.fromkeys([*modelled_errors(machine), *errors.names])
    seen = observable_errors(machine)
    slopes = {(part.output, part.lever) for name in names if name in SQUARENESS_NAMES for part in carriers[name]}
    terms = []
    for name in names:
        carrier = tuple(carriers[name])
        if name in SQUARENESS_NAMES:
            start = np.array([errors.squareness.get(name, (0.0, 0.0))[0]])
            terms.append(Term(name, None, np.zeros(1), carrier, start))
            continue
        error = error_named(name)
        nodes = nodes_mm[error.axis]
        start = errors.curves[name].at(nodes) if name in errors.curves else np.zeros(len(nodes))
        ends_mm, at_mm = machine.axes[error.axis].range_mm, (machine.reference_point_mm[error.axis],)
        zeros_mm: tuple[float, ...] = ()
        if set(seen) <= set(names):  # else a constant or a slope may have no other error to be in
            if name not in seen:
                zeros_mm = tuple(nodes.tolist())
            elif error.kind == "angular":
                zeros_mm = at_mm
            elif (error.direction, error.axis) in slopes:
                zeros_mm = ends_mm
        keep_mm = () if zeros_mm else ends_mm if error.is_straightness else at_mm
        terms.append(Term(name, error.axis, nodes, carrier, start, keep_mm=keep_mm, zeros_mm=zeros_mm))
    return terms


def _table(machine: Machine, errors: ErrorTable, solver: Projector, values: FloatArray) -> ErrorTable:
    """Return term values as errors; uncertainties and metadata are those of ``errors``."""
    curves, squareness = {}, {}
    for term, numbers in zip(solver.basis, solver.by_name(values).values(), strict=True):
        if term.axis is None:
            squareness[term.name] = (float(numbers[0]), errors.squareness.get(term.name, (0.0, np.nan))[1])
            continue
        old = errors.curves.get(term.name)
        u = np.full(len(numbers), np.nan) if old is None else np.interp(term.nodes_mm, old.position_mm, old.u)
        curves[term.name] = Curve(term.nodes_mm, numbers, u)
    return ErrorTable(curves, squareness, errors.metadata)


def bare_covariance(
    machine: Machine, errors: ErrorTable, known: Covariance | None, bare: ErrorTable
) -> Covariance | None:
    """Return what is known of the ``bare`` errors: as much as of those measured with the tables, whose numbers are exact.

    ``known`` is the joint covariance of the measured ``errors``; without it their values are independent. None if an
    uncertainty is unknown.
    """
    measured = covariance_or_independent(errors, known, machine.name)
    if measured is None:
        return None
    names, position_mm = bare.labels()
    rows = errors.rows()
    shares = np.zeros((len(names), len(measured.error)))
    for k, (name, at_mm) in enumerate(zip(names, position_mm.tolist(), strict=True)):
        if name in errors.squareness:
            shares[k, rows[name]] = 1.0
        elif name in errors.curves:
            nodes_mm = errors.curves[name].position_mm
            shares[k, rows[name]] = [np.interp(at_mm, nodes_mm, one) for one in np.eye(len(nodes_mm))]
    found = covariance_of_values(bare, shares @ measured.errors_factor, machine.name)
    posterior = posterior_with(machine, errors, known)
    # its mean is that of the machine with its tables, in another gauge than the bare errors
    return found if posterior is None else replace(found, posterior=replace(posterior.stored(), follows_table=False))


# One table instead of two: an old table that was active, and the errors measured with it.
#
# The machine with its old table c_old still has errors; c_new corrects what is left. Commanded to p it must go to
#
#     c_total(p) = c_new(p) + c_old(p + c_new(p))
#
# which is the correction of the bare machine, whose errors :func:`compgen.tables.active.bare_errors` gives.


@dataclass(frozen=True)
class MergeReport:
    """How closely the merged table reproduces old and new together, over the volume, um.

    ``total_max_um`` is the largest total correction, ``difference_max_um`` and ``difference_rms_um`` what the merged
    table misses of it, including all that the control cannot express; ``lost_um`` is the largest part of the old table
    that no error of the model expresses.
    """

    total_max_um: float
    difference_max_um: float
    difference_rms_um: float
    lost_um: float

    def summary(self) -> dict[str, float]:
        """Return the contents of ``merge.json``."""
        return dict(vars(self))


def total_correction(machine: Machine, errors: ErrorTable, active: ActiveTables, position_mm: FloatArray) -> FloatArray:
    """Return c_total at commanded positions (n, 3): the old correction plus that of the errors measured with it, mm."""
    new = wanted_correction(machine, errors, position_mm)
    moved = position_mm + new
    return np.asarray(new + active.correction(machine, Points(moved, approach=np.ones_like(moved))))


def merged_errors(machine: Machine, errors: ErrorTable, active: ActiveTables) -> tuple[ErrorTable, float]:
    """Return the errors of the bare machine at the nodes of old tables and new errors, and what is lost, um."""
    return bare_errors(machine, errors, active, keep_nodes=True)


def merge_report(
    machine: Machine, errors: ErrorTable, active: ActiveTables, merged: ReadTables, lost_um: float
) -> MergeReport:
    """Compare merged tables with the total correction at the nodes of old and merged tables and between them.

    Parameters
    ----------
    machine, errors : the errors measured with the old tables active.
    active : the old tables.
    merged : the new ones, as parsed.
    lost_um : from :func:`merged_errors`.
    """
    nodes = []
    for axis in range(3):
        parts = [
            node_positions(machine, read.controller.table_nodes_mm(read.tables)[axis], axis)
            for read in (active.tables, merged)
        ]
        nodes.append(np.unique(np.concatenate(parts)))
    position_mm = volume_grid(machine, (nodes[0], nodes[1], nodes[2])).position_mm
    required = total_correction(machine, errors, active, position_mm)
    miss = merged.correction(machine, Points(position_mm, approach=np.ones_like(position_mm))) - required
    if merged.controller.anchored:
        miss = miss - miss.mean(axis=0)
    figures = figures_of(np.linalg.norm(miss, axis=1))
    largest = float(np.max(np.linalg.norm(required, axis=1))) / MM_PER_UM
    return MergeReport(largest, figures["max_um"], figures["rms_um"], lost_um)


# The difference of two sets of tables: of their corrections at the tool, over the volume.


#: Smaller components, um rms, are not listed.
NAMED_FROM_UM = 0.001
#: Longer tuples are numbers of a table, whose difference is in the correction.
MOST_LISTED = 3


@dataclass(frozen=True)
class TableDifference:
    """Correction of A minus that of B at n points.

    Parameters
    ----------
    position_mm, first_mm, second_mm : points and the corrections of A and B there, shapes (n, 3).
    component_um : rms of every component of the difference over the volume, largest first, um.
    geometry : other differences, as (what, in A, in B) in words: nodes of the tables, settings.
    """

    controllers: tuple[str, str]
    position_mm: FloatArray
    first_mm: FloatArray
    second_mm: FloatArray
    component_um: Mapping[str, float]
    geometry: tuple[tuple[str, str, str], ...]

    @property
    def difference_mm(self) -> FloatArray:
        """Correction of A minus that of B, shape (n, 3)."""
        return self.first_mm - self.second_mm

    @property
    def size_mm(self) -> FloatArray:
        """Length of the difference, shape (n,)."""
        return np.asarray(np.linalg.norm(self.difference_mm, axis=1))

    @property
    def max_um(self) -> float:
        """Largest length of the difference."""
        return float(self.size_mm.max()) / MM_PER_UM

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``diff.json``."""
        worst = int(np.argmax(self.size_mm))
        axes = {f"d{axis.lower()}": figures_of(self.difference_mm[:, k]) for k, axis in enumerate(AXES)}
        return {
            "controllers": list(self.controllers),
            "points": len(self.position_mm),
            "same": self.max_um == 0.0 and not self.geometry,
            **figures_of(self.size_mm),
            "axes": axes,
            "largest_at_mm": self.position_mm[worst].tolist(),
            "largest_a_um": (self.first_mm[worst] / MM_PER_UM).tolist(),
            "largest_b_um": (self.second_mm[worst] / MM_PER_UM).tolist(),
            "components_rms_um": dict(self.component_um),
            "geometry": [{"what": what, "a": a, "b": b} for what, a, b in self.geometry],
        }


def difference(
    machine: Machine, first: ReadTables, second: ReadTables, points: Points | None = None
) -> TableDifference:
    """Compare two sets of tables by what their controls add to the commands.

    Parameters
    ----------
    machine : the machine; its settings say how each control reads its tables.
    first, second : the sets A and B, perhaps of different controls.
    points : where the figures are taken; default the nodes of both sets within the travel and the middles between
        them, all approached from the side (below or above) from which the sets differ more. The components are always
        taken there.
    """
    nodes = [_nodes(machine, tables) for tables in (first, second)]
    merged = [np.unique(np.concatenate([a, b]).round(6)) for a, b in zip(*nodes, strict=True)]
    grid = volume_grid(machine, (merged[0], merged[1], merged[2]))
    upward, downward = (
        Points(grid.position_mm, approach=side * np.ones_like(grid.position_mm)) for side in (1.0, -1.0)
    )
    miss = _miss(machine, first, second, upward)
    back = _miss(machine, first, second, downward)
    on_grid = upward if np.max(np.abs(miss)) >= np.max(np.abs(back)) else downward
    miss = miss if on_grid is upward else back
    named = {name: rms(part) / MM_PER_UM for name, part in components(grid, miss).items()}
    where = points or on_grid
    return TableDifference(
        controllers=(first.controller.name, second.controller.name),
        position_mm=where.position_mm,
        first_mm=first.correction(machine, where),
        second_mm=second.correction(machine, where),
        component_um=dict(sorted(((k, v) for k, v in named.items() if v >= NAMED_FROM_UM), key=lambda item: -item[1])),
        geometry=(*_geometry(machine, first, second), *_settings(first, second)),
    )


def _miss(machine: Machine, first: ReadTables, second: ReadTables, points: Points) -> FloatArray:
    return first.correction(machine, points) - second.correction(machine, points)


def _own_nodes(machine: Machine, tables: ReadTables) -> tuple[FloatArray, ...]:
    return tables.controller.table_nodes_mm(tables.tables)


def _nodes(machine: Machine, tables: ReadTables) -> list[FloatArray]:
    return [node_positions(machine, nodes, axis) for axis, nodes in enumerate(_own_nodes(machine, tables))]


def _geometry(machine: Machine, first: ReadTables, second: ReadTables) -> list[tuple[str, str, str]]:
    """Return the nodes that differ, axis by axis."""
    found = []
    for axis, pair in enumerate(zip(_own_nodes(machine, first), _own_nodes(machine, second), strict=True)):
        if len(pair[0]) != len(pair[1]) or np.max(np.abs(pair[0] - pair[1]), initial=0.0) > 1e-6:
            found.append((f"nodes over {AXES[axis]}", _spread(pair[0]), _spread(pair[1])))
    return found


def _spread(nodes_mm: FloatArray) -> str:
    if not len(nodes_mm):
        return "none"
    return f"{len(nodes_mm)} from {nodes_mm[0]:g} to {nodes_mm[-1]:g} mm"


def _settings(first: ReadTables, second: ReadTables) -> list[tuple[str, str, str]]:
    """Return the settings of the machine file, and other data of the files than their numbers, that differ."""
    if first.controller.name != second.controller.name:
        return [("control", first.controller.name, second.controller.name)]
    found = []
    for what, a, b in (
        ("setting", first.controller.settings, second.controller.settings),
        ("tables", first.tables, second.tables),
    ):
        one, two = _facts(a), _facts(b)
        for key in sorted({*one, *two}):
            if one.get(key) != two.get(key):
                found.append((f"{what} {key}", one.get(key, "absent"), two.get(key, "absent")))
    return found


def _facts(value: Any, name: str = "") -> dict[str, str]:
    """Flatten settings or tables to texts by name; arrays and the values of tables are excluded."""
    if is_dataclass(value) and not isinstance(value, type):
        compared = (item.name for item in fields(value) if item.compare)
        items: list[tuple[str, Any]] = [(key, getattr(value, key)) for key in compared]
    elif isinstance(value, Mapping):
        items = [(str(key), item) for key, item in value.items()]
    elif isinstance(value, tuple | list) and any(is_dataclass(item) for item in value):
        items = [(str(k), item) for k, item in enumerate(value)]
    elif isinstance(value, bool | str | int | float | Decimal) or value is None:
        return {name: str(value)}
    elif isinstance(value, tuple) and len(value) <= MOST_LISTED:
        return {name: ", ".join(map(str, value))}
    else:
        return {}
    found: dict[str, str] = {}
    for key, item in items:
        found |= _facts(item, f"{name}.{key}" if name else key)
    return found
