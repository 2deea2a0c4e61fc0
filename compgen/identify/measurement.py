"""One door for all kinds of measurement, told by their columns: lengths, positions, axis runs, six-DOF readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from compgen.core.axis_runs import AxisRuns, holds_axis_runs, read_axis_runs
from compgen.core.deviations import Deviations, holds_deviations, read_deviations
from compgen.core.diagonals import holds_diagonals
from compgen.core.error_table import ErrorTable
from compgen.core.lengths import Lengths, read_lengths
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM
from compgen.core.parts import PART, holds_parts, read_parts
from compgen.errors import InputError
from compgen.identify.axis_runs import identify_axis_runs
from compgen.identify.deviations import identify_deviations
from compgen.identify.identify import identify
from compgen.identify.merging import merge
from compgen.identify.noise import IdentifyOptions
from compgen.identify.result import Identification
from compgen.identify.sixdof import SixDofMeasurement, identify_sixdof
from compgen.identify.systematic import SystematicInputs
from compgen.sixdof.instrument import read_instrument
from compgen.sixdof.readings import holds_sixdof, read_sixdof

#: Deviations that are all smaller than this are asked about: 100 um in the wrong unit, mm for um.
SMALLEST_UM = 0.1


@dataclass(frozen=True)
class MixedMeasurement:
    """Lengths or deviations, and six-DOF readings, of the same machine."""

    other: Lengths | Deviations
    sixdof: SixDofMeasurement


Measurement = Lengths | Deviations | AxisRuns | SixDofMeasurement | MixedMeasurement


@overload
def read_measurement(paths: Sequence[str | Path], instrument: None = None) -> Lengths | Deviations | AxisRuns: ...
@overload
def read_measurement(paths: Sequence[str | Path], instrument: str | Path | None) -> Measurement: ...
def read_measurement(paths: Sequence[str | Path], instrument: str | Path | None = None) -> Measurement:
    """Read measurement files by their columns: ``*.lengths.csv``, ``*.deviations.csv``, ``*.axis.csv``, ``*.sixdof.csv``.

    Parameters
    ----------
    paths : files; six-DOF readings may stand beside lengths or deviations.
    instrument : the instrument TOML of the six-DOF readings.

    Raises
    ------
    InputError
        for lengths beside deviations, six-DOF readings without an instrument file, or one without such readings.
    """
    posed = [path for path in paths if holds_sixdof(path)]
    others = [path for path in paths if path not in posed]
    if posed and instrument is None:
        message = "holds six-DOF readings, which need the constants of their instrument; give --instrument FILE (TOML)"
        raise InputError(message, file=posed[0])
    if instrument is not None and not posed:
        raise InputError(
            f"--instrument {instrument} was given, but no file holds six-DOF readings (*.sixdof.csv with axis, "
            "position_mm, y_qd1_mm, ...)"
        )
    if not posed:
        return _read_others(others)
    sixdof = SixDofMeasurement(read_sixdof(posed), read_instrument(str(instrument)))
    return MixedMeasurement(_beside(_read_others(others), others[0]), sixdof) if others else sixdof


def _beside(other: Lengths | Deviations | AxisRuns, path: str | Path) -> Lengths | Deviations:
    if isinstance(other, AxisRuns):
        raise InputError("holds axis runs, and another file six-DOF readings; take one of them", file=path)
    return other


def _read_others(paths: Sequence[str | Path]) -> Lengths | Deviations | AxisRuns:
    for path in paths:
        if holds_diagonals(path):
            text = "holds measured diagonals, from which no errors are identified; accuracy and compare evaluate them"
            raise InputError(text, file=path)
    parts = [holds_parts(path) for path in paths]
    if any(parts) and not all(parts):
        message = "holds no features of a part, and another file does; identify them one after the other"
        raise InputError(message, file=paths[parts.index(False)])
    if any(parts):
        return read_parts(paths)
    along = [holds_axis_runs(path) for path in paths]
    if any(along) and not all(along):
        message = "holds no axis runs, and another file does; identify them one after the other"
        raise InputError(message, file=paths[along.index(False)])
    if any(along):
        return read_axis_runs(paths)
    kinds = [holds_deviations(path) for path in paths]
    if any(kinds) and not all(kinds):
        message = "holds tracer lengths, and another file deviations; identify them one after the other"
        raise InputError(message, file=paths[kinds.index(False)])
    return read_deviations(paths) if any(kinds) else read_lengths(paths)


def describe(measurement: Measurement | ErrorTable) -> str:
    """Say in words what was measured."""
    if isinstance(measurement, ErrorTable):
        return f"{len(measurement.names)} errors of another program"
    if isinstance(measurement, MixedMeasurement):
        return f"{describe(measurement.other)}, {describe(measurement.sixdof)}"
    if isinstance(measurement, SixDofMeasurement):
        return f"{len(measurement)} six-DOF readings in {len(measurement.readings.runs())} runs"
    if isinstance(measurement, Deviations):
        what = "features of parts" if measurement.metadata.get("measured") == PART else "measured positions"
        return f"{len(measurement)} {what}"
    if isinstance(measurement, AxisRuns):
        return f"{len(measurement)} readings along {', '.join(AXES[axis] for axis in measurement.axes)}"
    return f"{len(measurement)} lengths of {len(measurement.stations)} stations"


def identify_measurement(
    machine: Machine, measurement: Measurement, options: IdentifyOptions | None = None
) -> Identification:
    """Identify from any kind; InputError for options that belong to another kind."""
    chosen = options or IdentifyOptions()
    if isinstance(measurement, MixedMeasurement):
        first = identify_measurement(machine, measurement.other, chosen)
        return merge(machine, first, identify_sixdof(machine, measurement.sixdof))
    if isinstance(measurement, Lengths):
        if chosen.u_deviation_um is not None:
            raise InputError("an uncertainty of deviations (--u-deviation-um) was given, but the files hold lengths")
        return identify(machine, measurement, chosen)
    if isinstance(measurement, Deviations | AxisRuns) and not chosen.small_deviations:
        _check_size(measurement)
    stated = chosen.u_length_um is not None or chosen.u_length_um_per_m is not None
    other = stated or chosen.method != "joint" or chosen.stations is not None
    other = other or chosen.systematic != SystematicInputs()
    if isinstance(measurement, SixDofMeasurement):
        if other or chosen.u_deviation_um is not None:
            raise InputError(
                "--method, --stations, --u-... belong to tracer lengths and deviations; the files hold six-DOF readings, "
                "whose uncertainties stand in the instrument file ([noise], [u_constants], [u_systematics])"
            )
        return identify_sixdof(machine, measurement)
    if isinstance(measurement, AxisRuns):
        if other or chosen.u_deviation_um is not None:
            raise InputError(
                "--method, --stations, --u-... belong to other kinds of measurement; the files hold axis runs, whose "
                "uncertainty is that of their scatter"
            )
        return identify_axis_runs(machine, measurement)
    if other:
        raise InputError(
            "--method, --stations, --u-length-... and the systematic inputs belong to tracer lengths; the files hold "
            "deviations, for which --u-deviation-um counts"
        )
    return identify_deviations(machine, measurement, chosen)


def _check_size(measurement: Deviations | AxisRuns) -> None:
    """Ask about deviations that are all zero, or so small that their unit must be another one."""
    values = measurement.deviation_mm
    largest_um = float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0)) / MM_PER_UM
    if largest_um >= SMALLEST_UM:
        return
    file = measurement.origin[0][0] if measurement.origin else None
    if largest_um == 0.0:
        message = "all deviations are zero; was nothing measured? Give the measured values"
    else:
        message = (
            f"the largest deviation is {largest_um:.3g} um, which no machine tool reaches; are the values in mm, a thousand "
            "times too small for um? Give them in um"
        )
    raise InputError(f"{message}, or say --small-deviations if they are right", file=file)
