"""One door for both kinds of measurement: tracer lengths and measured positions, told apart by their columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from compgen.core.deviations import Deviations, holds_deviations, read_deviations
from compgen.core.lengths import Lengths, read_lengths
from compgen.core.machine import Machine
from compgen.errors import InputError
from compgen.identify.deviations import identify_deviations
from compgen.identify.identify import identify
from compgen.identify.noise import IdentifyOptions
from compgen.identify.result import Identification
from compgen.identify.systematic import SystematicInputs

Measurement = Lengths | Deviations


def read_measurement(paths: Sequence[str | Path]) -> Measurement:
    """Read measurement files of one kind: ``*.lengths.csv`` or ``*.deviations.csv``, by their columns."""
    kinds = [holds_deviations(path) for path in paths]
    if any(kinds) and not all(kinds):
        message = "holds tracer lengths, and another file deviations; identify them one after the other"
        raise InputError(message, file=paths[kinds.index(False)])
    return read_deviations(paths) if any(kinds) else read_lengths(paths)


def describe(measurement: Measurement) -> str:
    """Say in words what was measured."""
    if isinstance(measurement, Deviations):
        return f"{len(measurement)} measured positions"
    return f"{len(measurement)} lengths of {len(measurement.stations)} stations"


def identify_measurement(
    machine: Machine, measurement: Measurement, options: IdentifyOptions | None = None
) -> Identification:
    """Identify from either kind; InputError for options that belong to the other kind."""
    chosen = options or IdentifyOptions()
    if isinstance(measurement, Lengths):
        if chosen.u_deviation_um is not None:
            raise InputError("an uncertainty of deviations (--u-deviation-um) was given, but the files hold lengths")
        return identify(machine, measurement, chosen)
    stated = chosen.u_length_um is not None or chosen.u_length_um_per_m is not None
    if stated or chosen.method != "joint" or chosen.stations is not None or chosen.systematic != SystematicInputs():
        raise InputError(
            "--method, --stations, --u-length-... and the systematic inputs belong to tracer lengths; the files hold "
            "deviations, for which --u-deviation-um counts"
        )
    return identify_deviations(machine, measurement, chosen)
