"""Gauge alignment: two tables of the same machine may differ by changes that no measurement can show.

A constant or a line in a curve acts, through C, as an affine field of the commanded position. Combinations of them
and of squareness whose fields add up to zero, or to a rigid motion of the workpiece, leave the machine as it is.
For the 17 errors of one tool these are the 20 directions of ``docs/conventions.md``. An angular error without a
lever arm may change freely; one whose only lever arm is the tool offset may change together with the straightness and
positioning of its axis.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from compgen.data.comparison import rigid_fields
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable, hat_matrix
from compgen.data.machine import Machine
from compgen.data.names import CURVE_NAMES, ERROR_INDEX, ERROR_NAMES, error_named
from compgen.kinematics.first_order import c_matrix, observable_errors, tool_of
from compgen.kinematics.many_points import full_grid

#: Lever arm at which an angle counts: 1 urad is equivalent to 1 um.
LEVER_MM = 1000.0
#: Singular value below which a combination has no effect; coordinates and levers are scaled to about 1.
NO_EFFECT = 1e-9


def gauge_directions(
    machine: Machine, names: Sequence[str] | None = None, tools_mm: FloatArray | None = None
) -> FloatArray:
    """Return the changes of constants, slopes and squareness that leave E unchanged up to a rigid motion.

    Parameters
    ----------
    machine : chain, tool offset, squareness reference and travel.
    names : the errors that may change, by default all 21.
    tools_mm : tool offsets (n, 3) that the table is used with; default the machine's own.

    Returns
    -------
    array (k, 21, 2): for each of k directions the constant and the slope per mm of every error, mm and rad; the slope
    counts from machine zero.
    """
    chosen = [name for name in ERROR_NAMES if names is None or name in names]
    position, tool = _sample(machine, tools_mm)
    columns, slots = _effects(machine, chosen, position, tool)
    rigid = rigid_fields(position + tool)
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0] = 1.0
    everything = np.hstack([columns / scale, rigid / np.linalg.norm(rigid, axis=0)])
    _, singular, directions = np.linalg.svd(everything)
    rank = int(np.count_nonzero(singular > NO_EFFECT * singular[0]))
    found = directions[rank:, : len(slots)] / scale
    result = np.zeros((len(found), len(ERROR_NAMES), 2))
    for column, (name, power) in enumerate(slots):
        result[:, ERROR_INDEX[name], power] = found[:, column]
    return result


def _sample(machine: Machine, tools_mm: FloatArray | None) -> tuple[FloatArray, FloatArray]:
    """Positions and tool offsets (n, 3) at which two fields of low degree are the same only if they are everywhere."""
    levels = [np.linspace(*axis.range_mm, 4) for axis in machine.axes]
    position = full_grid(levels).reshape(-1, 3)
    tools = np.atleast_2d(tool_of(machine, None) if tools_mm is None else tools_mm)
    return np.tile(position, (len(tools), 1)), np.repeat(tools, len(position), axis=0)


def _effects(
    machine: Machine, names: Sequence[str], position: FloatArray, tool: FloatArray
) -> tuple[FloatArray, list[tuple[str, int]]]:
    """Fields of unit constants and slopes at points (n, 3), one column each, and the meaning of each column."""
    matrix = c_matrix(machine, position, tool)
    columns, slots = [], []
    for name in names:
        effect = matrix[:, :, ERROR_INDEX[name]]
        columns.append(effect.ravel())
        slots.append((name, 0))
        if name in CURVE_NAMES:
            columns.append((effect * position[:, [error_named(name).axis]]).ravel())
            slots.append((name, 1))
    return np.column_stack(columns), slots


def gauge_changes(directions: FloatArray, error: Sequence[str], position_mm: FloatArray) -> FloatArray:
    """Return gauge directions (d, 21, 2) as changes of error values, (k, d).

    ``error`` and ``position_mm`` (k,) are the name and position of each value; nan for squareness.
    """
    index = [ERROR_INDEX[name] for name in error]
    return np.asarray((directions[:, index, 0] + directions[:, index, 1] * np.nan_to_num(position_mm)).T)


def gauge_part(changes: FloatArray, conditions: FloatArray) -> FloatArray:
    """Matrix (k, k) that gives the part of values (k,) to be removed along ``changes`` (k, d): G (W G)^+ W.

    Without that part, the ``conditions`` W (m, k) on the values are as small as possible (least squares). This is the
    choice of a gauge: which values are to be zero or small. It is linear, so it also applies to a covariance.
    """
    effect = conditions @ changes
    scale = np.linalg.norm(effect, axis=0)
    used = scale > 1e-12 * scale.max(initial=0.0)
    amounts = np.linalg.pinv(effect[:, used] / scale[used], rcond=1e-10) / scale[used][:, None]
    return np.asarray(changes[:, used] @ (amounts @ conditions))


def common_gauge_part(machine: Machine, errors: ErrorTable) -> FloatArray:
    """Matrix (k, k) that gives the part of a table's values (k,) to be removed so that it is in the gauge of all results.

    Straightness is then zero at both ends of the travel, positioning and angles are zero at the reference point, and the rest
    is in the squareness. Angular errors that one tool does not show stay: they are known from another source.
    """
    shown = observable_errors(machine)
    names = [n for n in errors.names if n in shown and (n in errors.squareness or len(errors.curves[n].value) > 1)]
    changes = gauge_changes(gauge_directions(machine, names), *errors.labels())
    # what the gauge makes zero; angles times a lever, mm
    blocks = [np.zeros((0, len(errors.values())))]
    for name in (name for name in names if name in errors.curves):
        error, axis = error_named(name), machine.axes[error_named(name).axis]
        where = axis.range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)
        block = np.zeros((len(where), len(errors.values())))
        lever = 1.0 if error.kind == "linear" else LEVER_MM
        block[:, errors.rows()[name]] = lever * hat_matrix(errors.curves[name].position_mm, np.array(where))
        blocks.append(block)
    return gauge_part(changes, np.vstack(blocks))


def curve_weights(error: Sequence[str]) -> FloatArray:
    """Weights (k,) of error values: every curve counts equally whatever its number of nodes, angles at ``LEVER_MM``."""
    counts = Counter(error)
    reach = {name: 1.0 if error_named(name).kind == "linear" else LEVER_MM for name in counts}
    return np.array([reach[name] / np.sqrt(counts[name]) for name in error])


def align(
    machine: Machine, errors: ErrorTable, reference: ErrorTable, tools_mm: FloatArray | None = None
) -> ErrorTable:
    """Change ``errors`` along the gauge directions so that it is as close to ``reference`` as possible.

    E stays the same up to a rigid motion, to first order. Close means least squares over the nodes of all curves, each
    curve with the same weight, 1 um counting as much as 1 urad. Curves that only the reference has are added where a
    gauge direction needs them. The uncertainties stay.

    Parameters
    ----------
    machine : chain, tool offset, squareness reference and travel.
    errors, reference : tables of the same machine.
    tools_mm : tool offsets (n, 3) that the tables are used with; default the machine's own.
    """
    full = _completed(errors, reference)
    error, position_mm = full.labels()
    names = [name for name in full.names if name in full.squareness or len(full.curves[name].value) > 1]
    changes = gauge_changes(gauge_directions(machine, names, tools_mm), error, position_mm)
    changes = np.hstack([changes, *_free_changes(machine, full, tools_mm)])
    there = np.zeros(len(error))  # an error missing in the reference is brought close to zero
    for name, rows in full.rows().items():
        if name in reference.curves:
            there[rows] = reference.curves[name].at(position_mm[rows])
        elif name in reference.squareness:
            there[rows] = reference.squareness[name][0]
    change = gauge_part(changes, np.diag(curve_weights(error))) @ (there - full.values())
    kept = [name for name, rows in full.rows().items() if name in errors.names or change[rows].any()]
    return full.with_values(full.values() + change).only(*kept)


def _completed(errors: ErrorTable, reference: ErrorTable) -> ErrorTable:
    """Return ``errors`` with zero instead of the errors that only the reference has."""
    curves = dict(errors.curves)
    for name, curve in reference.curves.items():
        zero = np.zeros(len(curve.value))
        curves.setdefault(name, Curve(curve.position_mm, zero, np.full(len(zero), np.nan)))
    squareness = {**dict.fromkeys(reference.squareness, (0.0, float("nan"))), **errors.squareness}
    return ErrorTable(curves, squareness, errors.metadata)


def _free_changes(machine: Machine, full: ErrorTable, tools_mm: FloatArray | None) -> list[FloatArray]:
    """Changes (k, nodes) of angular errors that no travel shows, node by node, with compensating changes elsewhere."""
    tools = np.atleast_2d(tool_of(machine, None) if tools_mm is None else tools_mm)
    if len(tools) > 1 and np.ptp(tools, axis=0).max() > 0:
        return []
    found, rows = [], full.rows()
    for name in (name for name in full.curves if error_named(name).kind == "angular"):
        error = error_named(name)
        if machine.chain.lever_axes(error.axis):
            continue
        moves = np.cross(np.eye(3)[error.direction], tools[0])
        partners = {f"E{'XYZ'[k]}{'XYZ'[error.axis]}": moves[k] for k in range(3) if moves[k]}
        curve = full.curves[name]
        if not all(
            p in full.curves and np.array_equal(full.curves[p].position_mm, curve.position_mm) for p in partners
        ):
            continue
        nodes = np.eye(len(curve.value))
        changes = np.zeros((len(full.values()), len(nodes)))
        changes[rows[name]] = nodes
        for partner, arm in partners.items():
            changes[rows[partner]] = -arm * nodes
        found.append(changes)
    return found
