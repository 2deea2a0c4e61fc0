"""Features of parts that the machine made, measured elsewhere: ``*.part.csv`` (nominal and measured coordinates)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compgen.core.csvio import CsvTable, FloatArray, header_columns, read_csv
from compgen.core.deviations import Deviations, RoughPose
from compgen.core.lengths import (
    POSITION_COLUMNS,
    TOOL_COLUMNS,
    check_distinct,
    common_covariates,
    common_labels,
    common_metadata,
    common_tool,
    origins,
)
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError

MEASURED_COLUMNS = ("mx_mm", "my_mm", "mz_mm")
UNCERTAINTY_COLUMNS = ("u_mx_um", "u_my_um", "u_mz_um")
#: Coordinates further from their nominal ones than this, rms after the best pose, belong to something else.
FAR_MM = 1.0
#: What :attr:`Deviations.metadata` says under ``measured`` where the positions are features of a part.
PART = "part"


def holds_parts(path: str | Path) -> bool:
    """Tell by the columns of a measurement file whether it holds features of parts (``mx_mm`` ...)."""
    return not header_columns(path).isdisjoint(MEASURED_COLUMNS)


def read_parts(paths: str | Path | Sequence[str | Path]) -> Deviations:
    """Read one or more ``*.part.csv`` files: measured minus nominal coordinates, each set-up in a frame of its own.

    A feature lies where the tool stood when it was made, so that its deviation is the error of the machine at the
    nominal position, seen from the unknown pose of the part. The nominal coordinates are those of the machine; a comment
    ``# origin_mm = X, Y, Z`` says where the part's origin was in them. Without ``z_mm`` all features lie at one height:
    that of the origin.

    Returns
    -------
    Deviations
        aligned: see :func:`aligned`; nan for what was not measured.

    Raises
    ------
    InputError
        for a file without a measured coordinate, uncertainties for other coordinates than are measured, features that do
        not lie where they should.
    """
    files = [paths] if isinstance(paths, str | Path) else list(paths)
    if not files:
        raise InputError("no measurement file was given")
    tables = [_read_table(path) for path in files]
    check_distinct(tables)
    nominal_mm = np.concatenate([_nominal(table) for table in tables])
    measured_mm = np.concatenate([_columns(table, MEASURED_COLUMNS) for table in tables])
    u_mm = np.concatenate([_columns(table, UNCERTAINTY_COLUMNS) for table in tables]) * MM_PER_UM
    own = np.concatenate([np.broadcast_to(_origin(table), (len(table), 3)) for table in tables])
    raw = Deviations(
        position_mm=nominal_mm + own,
        deviation_mm=measured_mm - nominal_mm,
        u_mm=None if np.isnan(u_mm).all() else u_mm,
        tool_mm=common_tool(tables),
        labels=common_labels(tables),
        covariates=common_covariates(tables),
        metadata={**common_metadata(tables), "measured": PART},
        origin=origins(tables),
    )
    return aligned(raw)


def _read_table(path: str | Path) -> CsvTable:
    optional = ("z_mm", *MEASURED_COLUMNS, *UNCERTAINTY_COLUMNS, *TOOL_COLUMNS, "setup")
    table = read_csv(path, POSITION_COLUMNS[:2], optional, ("temp_*_c",))
    measured = [name for name in MEASURED_COLUMNS if name in table.columns]
    if not measured:
        raise InputError(f"has none of {', '.join(MEASURED_COLUMNS)}; at least one is needed", file=table.path)
    given = [name for name in UNCERTAINTY_COLUMNS if name in table.columns]
    needed = [f"u_{name.removesuffix('_mm')}_um" for name in measured]
    if given and given != needed:
        raise InputError(
            f"has {', '.join(given)}; give an uncertainty for each of {', '.join(needed)}", file=table.path
        )
    for name in given:
        values = table.numbers(name)
        for row in np.flatnonzero(values <= 0)[:1].tolist():
            raise table.fail(row, name, f"{values[row]:g} um is not a standard uncertainty; it must be above zero")
    _check_alike(table, measured)
    return table


def _check_alike(table: CsvTable, measured: Sequence[str]) -> None:
    """Nominal and measured coordinates must be of one size, however the part was turned: an inch or a metre shows here."""
    nominal = [table.numbers(f"{name[1]}_mm") for name in measured if f"{name[1]}_mm" in table.columns]
    spans = [float(np.linalg.norm([np.ptp(column) for column in columns], axis=0))
             for columns in (nominal, [table.numbers(name) for name in measured]) if len(columns) > 1]  # fmt: skip
    if len(spans) == 2 and not 0.5 < (spans[1] + 1e-9) / (spans[0] + 1e-9) < 2.0:
        text = (
            f"the nominal features span {spans[0]:g}, the measured ones {spans[1]:g}; both are in mm: check the units"
        )
        raise InputError(text, file=table.path, field=f"columns {', '.join(measured)}")


def _nominal(table: CsvTable) -> FloatArray:
    columns = [table.numbers(name) if name in table.columns else np.zeros(len(table)) for name in POSITION_COLUMNS]
    return np.column_stack(columns)


def _columns(table: CsvTable, names: Sequence[str]) -> FloatArray:
    """Columns (rows, 3), nan where the file lacks one."""
    return np.column_stack([table.numbers(n) if n in table.columns else np.full(len(table), np.nan) for n in names])


def _origin(table: CsvTable) -> FloatArray:
    """The part's origin in machine coordinates, mm, from the comment ``origin_mm``; zeros without it."""
    text = table.metadata.get("origin_mm", "0, 0, 0")
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(f"the comment origin_mm = {text!r} is not three numbers X, Y, Z in mm", file=table.path)
    return values


def setups_of(deviations: Deviations) -> NDArray[np.int64]:
    """Return the number of the set-up of every position, (n,); 0 without the label."""
    return np.asarray(deviations.labels.get("setup", np.zeros(len(deviations), dtype=np.int64)))


def aligned(deviations: Deviations) -> Deviations:
    """Take the pose that fits best out of every set-up, so that what is left is small; in the plane for two components.

    Raises
    ------
    InputError
        where what is left is no error of a machine (axes exchanged or mirrored, features in another order).
    """
    setups, turned = setups_of(deviations), deviations.deviation_mm.copy()
    poses = {}
    for setup in np.unique(setups).tolist():
        own = setups == setup
        nominal = deviations.position_mm[own]
        actual = nominal + deviations.deviation_mm[own]
        rotation = _best_rotation(nominal, actual)
        seen = np.isfinite(actual)
        middle, there = _centres(nominal, actual)
        poses[setup] = RoughPose(middle, there, rotation)
        back = np.where(seen, actual - there, 0.0) @ rotation
        turned[own] = np.where(seen, back + middle - nominal, np.nan)
        rms_mm = float(np.sqrt(np.nanmean(turned[own] ** 2)))
        if rms_mm > FAR_MM:
            raise InputError(
                f"set-up {setup}: after the best pose the coordinates are {rms_mm:.3g} mm rms from their nominal ones; are two "
                "axes exchanged, one mirrored, the unit wrong, or the features numbered otherwise?",
                file=deviations.origin[0][0] if deviations.origin else None,
            )
    return replace(deviations, deviation_mm=turned, poses=poses)


def _centres(nominal_mm: FloatArray, actual_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Means (3,) of the nominal and the measured coordinates over what was measured; 0 for a component that was not."""
    seen = np.isfinite(actual_mm)
    count = np.maximum(seen.sum(axis=0), 1)
    return np.where(seen, nominal_mm, 0.0).sum(axis=0) / count, np.where(seen, actual_mm, 0.0).sum(axis=0) / count


def _best_rotation(nominal_mm: FloatArray, actual_mm: FloatArray) -> FloatArray:
    """The proper rotation from nominal to measured coordinates (Kabsch), in the plane or the space that was measured."""
    rows = np.isfinite(actual_mm)
    components = np.flatnonzero(rows.any(axis=0))
    complete = rows[:, components].all(axis=1)
    if len(components) < 2 or np.count_nonzero(complete) < len(components):
        return np.eye(3)
    first, second = nominal_mm[complete][:, components], actual_mm[complete][:, components]
    moment = (second - second.mean(axis=0)).T @ (first - first.mean(axis=0))
    left, size, right = np.linalg.svd(moment)
    if size[-2] < 1e-9 * max(size[0], 1e-9):  # all on one line: its rotation about itself is not seen
        return np.eye(3)
    guard = np.ones(len(components))
    guard[-1] = np.sign(np.linalg.det(left @ right))  # a reflection would fit data with a sign error, silently
    matrix = np.eye(3)
    matrix[np.ix_(components, components)] = (left * guard) @ right
    return matrix
