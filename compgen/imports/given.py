"""Errors that another program identified, in place of an identification of our own."""

from __future__ import annotations

import numpy as np

from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES
from compgen.fit import FitOptions, fit
from compgen.identify import Identification
from compgen.identify.parameters import error_parameters
from compgen.identify.result import worst_uncertainty
from compgen.identify.tables import metadata_of


def given_errors(machine: Machine, table: ErrorTable) -> Identification:
    """Return errors of a foreign file as what an identification hands on.

    They are brought to the zeros that every identification has (positioning and angles at the reference point, straightness
    at both ends; squareness takes up the lines), without smoothing; what that moved stands in ``details``.

    Raises
    ------
    InputError
        for errors that the machine's travel or chain does not fit.
    """
    zeroed = fit(machine, table, FitOptions(smoothness=0.0))
    errors = zeroed.errors.replace(
        metadata={**metadata_of(machine, table.metadata), "source": "given by another program"}
    )
    missing = [name for name in ERROR_NAMES if name not in errors.names]
    values = sum(len(curve.value) for curve in errors.curves.values()) + len(errors.squareness)
    known = bool(errors.curves) and all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    return Identification(
        errors=errors,
        stations=(),
        residual_mm=np.zeros(values),
        accepted=np.ones(values, dtype=bool),
        rms_um=0.0,
        degrees_of_freedom=0,
        reduced_chi_square=1.0,
        u_source="given" if known else "unknown",
        u_length_um=0.0,
        u_length_um_per_m=0.0,
        u_scale=1.0,
        unobservable=tuple(f"{name}: not in the file" for name in missing),
        rejected=(),
        rank=values,
        unknowns=values,
        condition=1.0,
        iterations=0,
        worst_u=worst_uncertainty(errors) if known else {},
        layout=error_parameters(machine, errors.names),
        method="given",
        details={
            "file": table.metadata.get("source", ""),
            "values": values,
            "frame_change": zeroed.to_dict()["frame_change"],
        },
    )
