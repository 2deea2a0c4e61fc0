"""One gauge for all tables that are compared: what no measurement shows must not count as a change.

Constants and slopes of curves can be traded for squareness and a placement of the workpiece without any effect on the
machine (:mod:`compgen.model.gauge`). Both sides of a comparison are brought to the same choice, each by itself: straightness
zero at both ends of the travel, positioning and angular errors zero at the reference point, the rest in the squareness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from compgen.accuracy.source import ErrorSource
from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_INDEX, error_named
from compgen.model.basis import hat_matrix
from compgen.model.gauge import LEVER_MM, gauge_directions
from compgen.model.observability import observable_errors


def in_common_gauge(source: ErrorSource) -> ErrorSource:
    """Return the source in the common gauge: the same E = C P up to a rigid motion; the covariance follows.

    Angular errors that one tool does not show are left alone: who states them knows them from elsewhere.
    """
    machine, errors = source.machine, source.errors
    shown = observable_errors(machine)
    names = [n for n in errors.names if n in shown and (n in errors.squareness or len(errors.curves[n].value) > 1)]
    directions = _as_values(errors, gauge_directions(machine, names))
    if not directions.shape[1]:
        return source
    conditions = _conditions(machine, errors, names)
    effect = conditions @ directions
    scale = np.linalg.norm(effect, axis=0)
    used = scale > 1e-12 * scale.max(initial=0.0)
    amounts = np.linalg.pinv(effect[:, used] / scale[used], rcond=1e-10) / scale[used][:, None]
    change = -directions[:, used] @ amounts @ conditions
    values = _values(errors)
    factor = None if source.factor is None else source.factor + change @ source.factor
    return replace(source, errors=_with_values(errors, values + change @ values), factor=factor)


def _as_values(errors: ErrorTable, directions: FloatArray) -> FloatArray:
    """Directions (d, 21, 2) of constants and slopes as changes of the table's values (k, d)."""
    rows = []
    for name in errors.names:
        constant, slope = directions[:, ERROR_INDEX[name]].T
        nodes = np.zeros(1) if name in errors.squareness else errors.curves[name].position_mm
        rows.append(constant + nodes[:, None] * slope)
    return np.vstack(rows)


def _conditions(machine: Machine, errors: ErrorTable, names: Sequence[str]) -> FloatArray:
    """Matrix (c, k) that takes from the values of a table what the common gauge makes zero; angles times a lever, mm."""
    count = len(_values(errors))
    rows, first = [], 0
    for name in errors.names:
        if name in errors.squareness:
            first += 1
            continue
        error, nodes = error_named(name), errors.curves[name].position_mm
        if name not in names:
            first += len(nodes)
            continue
        axis = machine.axes[error.axis]
        where = axis.range_mm if error.is_straightness else (machine.reference_point_mm[error.axis],)
        block = np.zeros((len(where), count))
        lever = 1.0 if error.kind == "linear" else LEVER_MM
        block[:, first : first + len(nodes)] = lever * hat_matrix(nodes, np.array(where))
        rows.append(block)
        first += len(nodes)
    return np.vstack(rows) if rows else np.zeros((0, count))


def _values(errors: ErrorTable) -> FloatArray:
    parts = [
        np.array([errors.squareness[name][0]]) if name in errors.squareness else errors.curves[name].value
        for name in errors.names
    ]
    return np.concatenate(parts)


def _with_values(errors: ErrorTable, values: FloatArray) -> ErrorTable:
    curves, squareness, first = {}, {}, 0
    for name in errors.names:
        if name in errors.squareness:
            squareness[name] = (float(values[first]), errors.squareness[name][1])
            first += 1
        else:
            old = errors.curves[name]
            curves[name] = Curve(old.position_mm, values[first : first + len(old.value)], old.u)
            first += len(old.value)
    return ErrorTable(curves, squareness, errors.metadata)
