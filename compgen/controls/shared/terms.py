"""Bases that several controls share, built from the term list of C (:mod:`compgen.kinematics.first_order`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from compgen.controls.shared.base import Monomial, Term
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import AXES, SQUARENESS_NAMES, error_named
from compgen.kinematics.first_order import coefficients

#: A straightness error is taken as zero at its ends below this (rounding of the fit).
ZERO_END_MM = 1e-9


def one_dimensional_name(output: int, axis: int) -> str:
    """Name of the table that corrects ``output`` as a function of ``axis``, e.g. ``X(y)``."""
    return f"{AXES[output]}({AXES[axis].lower()})"


#: (output, base axis) of the tables of one axis as a function of another, by table name.
ACROSS = {
    one_dimensional_name(output, base): (output, base) for base in range(3) for output in range(3) if output != base
}


def product_name(output: int, axis: int, lever: int) -> str:
    """Name of the table that corrects ``output`` by a function of ``axis`` times the lever, e.g. ``X(y)*z``."""
    return f"{one_dimensional_name(output, axis)}*{AXES[lever].lower()}"


def one_dimensional_terms(
    machine: Machine,
    errors: ErrorTable,
    nodes_mm: Sequence[FloatArray],
    pairs: Iterable[tuple[int, int]],
    *,
    anchored: bool = False,
    lever_origin_mm: Sequence[float] | None = None,
) -> list[Term]:
    """Return one term per (output, axis) pair: corrections of one axis as a function of one axis.

    Parameters
    ----------
    machine, errors : start values are minus the errors with this effect: straightness and positioning, squareness as
        a line, levers of the axis itself and of the tool, and angular errors at ``lever_origin_mm``.
    nodes_mm : table nodes of the three axes.
    pairs : (output, axis) of the requested tables.
    anchored : True if the tables are zero at the reference point.
    lever_origin_mm : where angular errors are taken as one-dimensional; default: mid-travel.
    """
    middle = 0.5 * (machine.lower_mm + machine.upper_mm)
    origin = np.asarray(middle if lever_origin_mm is None else lever_origin_mm, dtype=np.float64)
    terms = []
    for output, axis in pairs:
        start = np.zeros(len(nodes_mm[axis]))
        for part in coefficients(machine.chain, machine.squareness_reference):
            if part.output != output:
                continue
            if part.error in SQUARENESS_NAMES:
                if part.lever == axis and part.error in errors.squareness:
                    start -= part.sign * errors.squareness[part.error][0] * nodes_mm[axis]
            elif error_named(part.error).axis == axis and part.error in errors.curves:
                lever: FloatArray | float = 1.0
                if part.lever is not None and part.lever >= 3:
                    lever = machine.tool_offset_mm[part.lever - 3]
                elif part.lever is not None:  # the travel of the axis itself, or the fixed position of another one
                    lever = nodes_mm[axis] if part.lever == axis else float(origin[part.lever])
                start -= part.sign * errors.curves[part.error].at(nodes_mm[axis]) * lever
        reference = machine.reference_point_mm[axis] if anchored else None
        if reference is not None:
            start = start - np.interp(reference, nodes_mm[axis], start)
        terms.append(
            Term(
                one_dimensional_name(output, axis),
                axis,
                nodes_mm[axis],
                (Monomial(output),),
                start,
                reference,
                _kept_mm(machine, axis, straightness=output != axis),
            )
        )
    return terms


def product_terms(
    machine: Machine, errors: ErrorTable, nodes_mm: Sequence[FloatArray], lever_origin_mm: Sequence[float]
) -> list[Term]:
    """Return the terms (function of one axis times lever of another) that the chain's angular errors need.

    Levers are measured from ``lever_origin_mm``; values are rotations in rad, start is minus the sum of the errors.
    """
    found: dict[tuple[int, int, int], FloatArray] = {}
    for part in coefficients(machine.chain, machine.squareness_reference):
        if part.lever is None or part.lever >= 3 or part.error in SQUARENESS_NAMES:
            continue
        axis = error_named(part.error).axis
        if part.lever != axis and part.error in errors.curves:
            key = (part.output, axis, part.lever)
            start = found.setdefault(key, np.zeros(len(nodes_mm[axis])))
            start -= part.sign * errors.curves[part.error].at(nodes_mm[axis])
    return [
        Term(
            product_name(output, axis, lever),
            axis,
            nodes_mm[axis],
            (Monomial(output, 1, lever, float(lever_origin_mm[lever])),),
            start,
            keep_mm=_kept_mm(machine, axis, straightness=False),
        )
        for (output, axis, lever), start in sorted(found.items())
    ]


def error_terms(machine: Machine, errors: ErrorTable, nodes_mm: Sequence[FloatArray]) -> list[Term]:
    """Return one term per error for controls that evaluate E = C P themselves in the convention of ISO 230-1.

    Values are the errors (mm, rad); the carrier is minus the column of C. These controls know X as the only squareness
    reference: for a machine with reference Y the squareness EC0Y is taken as the slope of EYX, with EC0Y = 0.
    """
    carriers: dict[str, list[Monomial]] = {}
    for part in coefficients(machine.chain, "X"):
        carriers.setdefault(part.error, []).append(Monomial(part.output, -part.sign, part.lever))
    fold = errors.squareness.get("EC0Y", (0.0, 0.0))[0] if machine.squareness_reference == "Y" else 0.0
    names = set(errors.names) | ({"EYX"} if fold else set())
    terms = []
    for name, carrier in carriers.items():
        if name not in names:
            continue
        axis = None if name in SQUARENESS_NAMES else error_named(name).axis
        if axis is None:
            value = 0.0 if name == "EC0Y" and fold else errors.squareness[name][0]
            terms.append(Term(name, None, np.zeros(1), tuple(carrier), np.array([value])))
            continue
        nodes = nodes_mm[axis]
        start = errors.curves[name].at(nodes) if name in errors.curves else np.zeros(len(nodes))
        if name == "EYX":
            start = start - fold * nodes
        straightness = error_named(name).is_straightness
        keep_mm = _kept_mm(machine, axis, straightness=straightness)
        # a straightness that is zero at both ends: its slope is in the squareness, which the control has
        at_ends = straightness and set(SQUARENESS_NAMES) <= names and len(nodes) >= 3
        at_ends = at_ends and np.max(np.abs(start[[0, -1]])) <= ZERO_END_MM
        zeros_mm = (float(nodes[0]), float(nodes[-1])) if at_ends else ()
        if at_ends:
            start = np.concatenate([[0.0], start[1:-1], [0.0]])
        terms.append(Term(name, axis, nodes, tuple(carrier), start, keep_mm=keep_mm, zeros_mm=zeros_mm))
    return terms


def _kept_mm(machine: Machine, axis: int, *, straightness: bool) -> tuple[float, ...]:
    """Where the fitted curves are zero: straightness at both travel ends, the others at the reference point."""
    return machine.axes[axis].range_mm if straightness else (machine.reference_point_mm[axis],)


def continued(term: Term, range_mm: tuple[float, float]) -> Term:
    """Return a term whose start is extrapolated linearly to a node far beyond the travel, like synthesised values.

    Curves are constant outside their positions, so a start taken from them has a kink there. A node is far out
    if less than half of its interval is within the travel (``LEAST_SHARE`` of ``compgen.tables.synthesis``).
    """
    nodes, start = term.nodes_mm, np.array(term.start)
    if len(nodes) < 3:
        return term
    low, high = range_mm
    for out, inner, third, inside in ((0, 1, 2, nodes[1] - low), (-1, -2, -3, high - nodes[-2])):
        if inside < 0.5 * abs(nodes[out] - nodes[inner]):
            ratio = (nodes[out] - nodes[inner]) / (nodes[inner] - nodes[third])
            start[out] = start[inner] + ratio * (start[inner] - start[third])
    return replace(term, start=start)


def field_on_grid(
    terms: Iterable[Term], values: Mapping[str, FloatArray], lines_mm: Mapping[int, FloatArray], tool_mm: FloatArray
) -> FloatArray:
    """Return what terms with these values add at the vertices of a grid, mm.

    ``lines_mm`` has the positions along each axis 0..2, in the order of the dimensions of the result, (n0, n1[, n2], 3); an
    axis without a line is at zero. ``tool_mm`` is the tool offset, shape (3,).
    """
    mesh = np.meshgrid(*lines_mm.values(), indexing="ij")
    position_mm = np.zeros((mesh[0].size, 3))
    for axis, along_mm in zip(lines_mm, mesh, strict=True):
        position_mm[:, axis] = along_mm.ravel()
    field = np.zeros_like(position_mm)
    for term in terms:
        along = term.curve(np.asarray(values[term.name]), position_mm)
        field += term.carrier_field(position_mm, tool_mm) * along[:, None]
    return field.reshape(*mesh[0].shape, 3)
