"""What every method of identification hands on: error curves with uncertainties, and what is said about them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES
from compgen.identify.parameters import ErrorParameters
from compgen.model.observability import observable_errors


def error_table(layout: ErrorParameters, unknowns: FloatArray, factor: FloatArray) -> ErrorTable:
    """Return curves and squareness for the unknown errors (size,), mm and rad.

    ``factor`` (size, r) times its transpose is their covariance.
    """
    positions = [layout.output_positions_mm(axis) for axis in range(3)]
    plain = layout.machine.curves == "linear"  # written at the nodes, where coefficients are values
    bases = [np.zeros((0, 0)) if plain else layout.basis(axis, positions[axis]) for axis in range(3)]
    variance = np.einsum("ij,ij->i", factor, factor)
    curves = {}
    for curve in layout.curves:
        axis, free = curve.error.axis, curve.free
        kept = free.argmax(axis=0)
        if plain and np.count_nonzero(free) == free.shape[1] == free[kept, np.arange(free.shape[1])].sum():
            value, square = np.zeros(len(free)), np.zeros(len(free))
            value[kept], square[kept] = unknowns[curve.columns], variance[curve.columns]
        else:
            reduced = free if plain else bases[axis] @ free
            value = reduced @ unknowns[curve.columns]
            spread = reduced @ factor[curve.columns]
            square = np.einsum("ij,ij->i", spread, spread)
        curves[curve.error.name] = Curve(positions[axis], value, np.sqrt(square))
    first = layout.size - len(layout.squareness)
    squareness = {
        name: (float(unknowns[first + k]), float(np.sqrt(variance[first + k])))
        for k, name in enumerate(layout.squareness)
    }
    return ErrorTable(curves, squareness)


def metadata_of(machine: Machine, metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the comments of the errors file; ``metadata`` is that of the measurement."""
    reference = " ".join(f"{value:g}" for value in machine.reference_point_mm)
    kept = {key: metadata[key] for key in ("date",) if key in metadata}
    return {"machine": machine.name, **kept, "source": "compgen identify", "reference_point_mm": reference}


def unobservable(layout: ErrorParameters) -> tuple[str, ...]:
    """Say in words which of the 21 errors the model leaves out, and why."""
    machine = layout.machine
    identified = {curve.error.name for curve in layout.curves} | set(layout.squareness)
    shown = observable_errors(machine)
    return tuple(
        f"{name}: left out of the machine file's errors, although it is observable on chain {machine.chain.name}"
        if name in shown
        else f"{name}: no lever arm but its own axis' travel or one tool offset on chain {machine.chain.name}"
        for name in ERROR_NAMES
        if name not in identified
    )
