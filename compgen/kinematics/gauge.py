"""Gauge alignment: two tables that describe the same machine differ by changes that no measurement shows.

A constant or a line in a curve acts, through C, as an affine field of the commanded position. Combinations of them
and of squareness whose fields add up to nothing, or to a rigid motion of the workpiece, leave the machine as it is.
For the 17 errors of one tool these are the 20 directions of ``docs/conventions.md``. An angular error without any
lever arm may change altogether; one whose only lever arm is the tool offset may change together with the straightness
and positioning of its axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import CURVE_NAMES, ERROR_INDEX, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.kinematics.first_order import c_matrix, tool_of

#: 1 um counts as much as 1 urad: an angle counts at this lever.
LEVER_MM = 1000.0
#: Singular value below which a combination has no effect; coordinates and levers are scaled to about 1.
NO_EFFECT = 1e-9


#: Change of the values of some errors, by name: at the positions of a curve, or of a squareness error (1,).
Change = Mapping[str, FloatArray]


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
    position = np.stack(np.meshgrid(*levels, indexing="ij"), axis=-1).reshape(-1, 3)
    tools = np.atleast_2d(tool_of(machine, None) if tools_mm is None else tools_mm)
    return np.tile(position, (len(tools), 1)), np.repeat(tools, len(position), axis=0)


def _effects(
    machine: Machine, names: Sequence[str], position: FloatArray, tool: FloatArray
) -> tuple[FloatArray, list[tuple[str, int]]]:
    """Fields of unit constants and slopes at points (n, 3), one column each, and what each column is."""
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


def rigid_fields(tip_mm: FloatArray) -> FloatArray:
    """Fields of three translations and three small rotations about the origin at tips (n, 3): columns, (3 n, 6)."""
    unit = np.eye(3)
    fields = [np.broadcast_to(unit[k], tip_mm.shape) for k in range(3)]
    fields += [np.cross(unit[k], tip_mm) for k in range(3)]
    return np.column_stack([field.ravel() for field in fields])


def without_rigid_motion(position_mm: FloatArray, error_mm: FloatArray) -> FloatArray:
    """Take the best-fit rigid motion (least squares, finite rotation by SVD) out of errors (n, 3) at points (n, 3).

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> position_mm = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]])
    >>> shifted = np.tile([0.01, 0.0, 0.0], (4, 1))
    >>> float(np.abs(compgen.without_rigid_motion(position_mm, shifted)).max()) < 1e-12
    True
    """
    actual = position_mm + error_mm
    centre, moved_centre = position_mm.mean(axis=0), actual.mean(axis=0)
    left, _, right = np.linalg.svd((actual - moved_centre).T @ (position_mm - centre))
    sign = np.sign(np.linalg.det(left @ right))
    rotation = left @ np.diag([1.0, 1.0, sign]) @ right  # nominal -> actual
    return np.asarray((actual - moved_centre) @ rotation - (position_mm - centre))


def align(
    machine: Machine, errors: ErrorTable, reference: ErrorTable, tools_mm: FloatArray | None = None
) -> ErrorTable:
    """Change ``errors`` along the gauge directions so that it comes as close to ``reference`` as it can.

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
    names = [name for name in full.names if name in full.squareness or len(full.curves[name].value) > 1]
    directions = gauge_directions(machine, names, tools_mm)
    changes: list[Change] = []
    for direction in directions:  # constants and slopes (21, 2) as changes of node values
        parts = {name: direction[ERROR_INDEX[name]] for name in full.names}
        along = {name: full.curves[name].position_mm if name in full.curves else np.zeros(1) for name in full.names}
        changes.append({name: part[0] + part[1] * along[name] for name, part in parts.items() if part.any()})
    changes += _free_changes(machine, full, tools_mm)
    if not changes:
        return errors
    design = np.column_stack([_stacked(full, change) for change in changes])
    target = _stacked(full, _differences(full, reference))
    scale = np.linalg.norm(design, axis=0)
    amounts = np.linalg.lstsq(design / scale, target, rcond=1e-13)[0] / scale
    return _changed(errors, full, changes, amounts)


def _completed(errors: ErrorTable, reference: ErrorTable) -> ErrorTable:
    """Return ``errors`` with zero in place of the errors that only the reference has."""
    curves = dict(errors.curves)
    for name, curve in reference.curves.items():
        zero = np.zeros(len(curve.value))
        curves.setdefault(name, Curve(curve.position_mm, zero, np.full(len(zero), np.nan)))
    squareness = {**dict.fromkeys(reference.squareness, (0.0, float("nan"))), **errors.squareness}
    return ErrorTable(curves, squareness, errors.metadata)


def _free_changes(machine: Machine, full: ErrorTable, tools_mm: FloatArray | None) -> list[Change]:
    """Changes of single nodes of angular errors that no travel shows, with what makes up for them in other curves."""
    tools = np.atleast_2d(tool_of(machine, None) if tools_mm is None else tools_mm)
    if len(tools) > 1 and np.ptp(tools, axis=0).max() > 0:
        return []
    found: list[Change] = []
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
        for node in np.eye(len(curve.value)):
            found.append({name: node, **{p: -arm * node for p, arm in partners.items()}})
    return found


def _stacked(full: ErrorTable, values: Change) -> FloatArray:
    """Node values of all errors one after another, zero where ``values`` has none; every curve counts alike."""
    parts = []
    for name in full.names:
        count = len(full.curves[name].value) if name in full.curves else 1
        lever = 1.0 if error_named(name).kind == "linear" else LEVER_MM
        parts.append(lever / np.sqrt(count) * values.get(name, np.zeros(count)))
    return np.concatenate(parts)


def _differences(full: ErrorTable, reference: ErrorTable) -> dict[str, FloatArray]:
    """Reference minus table at the nodes of the table; nothing for errors that the reference lacks."""
    found = {}
    for name in full.names:
        if name in full.curves:
            curve = full.curves[name]
            other = reference.curves[name].at(curve.position_mm) if name in reference.curves else 0.0
            found[name] = other - curve.value
        else:
            found[name] = np.array([reference.squareness.get(name, (0.0, 0.0))[0] - full.squareness[name][0]])
    return found


def _changed(errors: ErrorTable, full: ErrorTable, changes: Sequence[Change], amounts: FloatArray) -> ErrorTable:
    """Add the changes times their amounts (k,); what was completed and did not change is left out again."""
    change: dict[str, FloatArray] = {}
    for part, amount in zip(changes, amounts.tolist(), strict=True):
        for name, values in part.items():
            change[name] = change.get(name, np.zeros(len(values))) + amount * values
    curves = {
        name: Curve(curve.position_mm, curve.value + change.get(name, 0.0), curve.u)
        for name, curve in full.curves.items()
        if name in errors.curves or np.any(change.get(name, np.zeros(1)) != 0.0)
    }
    squareness = {
        name: (value + float(change[name][0]) if name in change else value, u)
        for name, (value, u) in full.squareness.items()
        if name in errors.squareness or name in change
    }
    assert set(squareness) <= set(SQUARENESS_NAMES)
    return ErrorTable(curves, squareness, errors.metadata)
