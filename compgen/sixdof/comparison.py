"""Repeatability and comparison with reference instruments in the style of Tables 2 and 3 of Jia et al. 2022."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from compgen.core.error_table import ErrorTable
from compgen.core.lines import fitted_line
from compgen.core.machine import Machine
from compgen.core.names import AXES, MM_PER_UM, error_named
from compgen.errors import InputError
from compgen.sixdof.evaluation import Evaluation, evaluate
from compgen.sixdof.frames import AxisRun
from compgen.sixdof.instrument import RAD_PER_ARCSEC, Instrument
from compgen.sixdof.optics import ERRORS_OF_AXIS

#: Rows of the tables: title, unit, and how much of it 1 mm or 1 rad is; in the order of ROLES.
ROWS = (
    ("positioning", "nm", 1e6),
    ("horizontal straightness", "um", 1.0 / MM_PER_UM),
    ("vertical straightness", "um", 1.0 / MM_PER_UM),
    ("yaw", "arcsec", 1.0 / RAD_PER_ARCSEC),
    ("pitch", "arcsec", 1.0 / RAD_PER_ARCSEC),
    ("roll", "arcsec", 1.0 / RAD_PER_ARCSEC),
)
SQUARENESS_ROWS = (("EC0Y", "S_xy"), ("EB0Z", "S_xz"), ("EA0Z", "S_yz"))


def each_run(machine: Machine, instrument: Instrument, runs: Sequence[AxisRun]) -> list[Evaluation]:
    """Evaluate the first run of every axis together, then the second ones, and so on, as far as all axes have them."""
    by_axis = [[run for run in runs if run.axis == axis] for axis in sorted({run.axis for run in runs})]
    return [evaluate(machine, instrument, list(together)) for together in zip(*by_axis, strict=False)]


def half_ranges(evaluations: Sequence[Evaluation]) -> dict[str, float]:
    """Half of the range over repeated measurements by error, the worst position of a curve, mm and rad.

    Straightness is without its line, everything is zero at the reference point. Empty for a single measurement.
    """
    tables = [item.errors for item in evaluations]
    if len(tables) < 2:
        return {}
    result = {}
    for name in tables[0].names:
        if name in tables[0].squareness:
            values = np.array([table.squareness[name][0] for table in tables])[:, None]
        else:
            at = tables[0].curves[name].position_mm
            values = np.array([table.curves[name].at(at) for table in tables])
        result[name] = float(0.5 * np.ptp(values, axis=0).max())
    return result


def largest_differences(errors: ErrorTable, reference: ErrorTable, line: str = "ls") -> dict[str, float]:
    """Largest absolute difference to a reference by error, mm and rad; errors that only one of them has are left out.

    The reference is compared at its own positions within the travel of the errors. What the reference instrument has
    its own zero for is taken out: a line for straightness, the first value for the other curves.
    """
    result = {}
    for name in errors.names:
        if name in errors.squareness and name in reference.squareness:
            result[name] = abs(errors.squareness[name][0] - reference.squareness[name][0])
        elif name in errors.curves and name in reference.curves:
            own, other = errors.curves[name], reference.curves[name]
            within = (other.position_mm >= own.position_mm[0] - 1e-6) & (
                other.position_mm <= own.position_mm[-1] + 1e-6
            )
            at = other.position_mm[within]
            if len(at) < 2:
                raise InputError(f"the reference has fewer than two positions of {name} within the measured travel")
            difference = own.at(at) - other.at(at)
            if error_named(name).is_straightness:
                constant, slope = fitted_line(at, difference, line)
                difference = difference - constant - slope * at
            else:
                difference = difference - difference[0]
            result[name] = float(np.abs(difference).max())
    return result


def in_table_units(values: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Values by error (mm, rad) as the rows of the paper's tables: by row with its unit, then by axis or pair of axes."""
    table: dict[str, dict[str, float]] = {}
    for role, (title, unit, factor) in enumerate(ROWS):
        row = {
            AXES[axis]: factor * values[names[role]]
            for axis, names in enumerate(ERRORS_OF_AXIS)
            if names[role] in values
        }
        if row:
            table[f"{title} ({unit})"] = row
    pairs = {short: values[name] / RAD_PER_ARCSEC for name, short in SQUARENESS_ROWS if name in values}
    if pairs:
        table["squareness (arcsec)"] = pairs
    return table


def format_table(columns: Mapping[str, Mapping[str, float]]) -> str:
    """Text of a table whose columns are values by error (mm, rad), e.g. ``repeatability``, ``u (k = 1)``.

    One line for every error and axis, in the units of the paper.
    """
    cells = {title: in_table_units(values) for title, values in columns.items()}
    keys = list(
        dict.fromkeys((row, where) for table in cells.values() for row, part in table.items() for where in part)
    )
    width = max((len(f"{row} {where}") for row, where in keys), default=0)
    lines = [" " * width + "".join(f"  {title:>16}" for title in columns)]
    for row, where in keys:
        numbers = [cells[title].get(row, {}).get(where) for title in columns]
        texts = "".join("  " + ("-" if value is None else f"{value:.3f}").rjust(16) for value in numbers)
        lines.append(f"{row} {where}".ljust(width) + texts)
    return "\n".join(lines) + "\n"
