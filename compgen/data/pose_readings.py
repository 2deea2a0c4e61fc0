"""Readings at poses of a machine with rotary axes beside spheres: bars between two balls, positions, tracer lengths.

Files are in mm, degrees and um; ``# coordinates = joints`` or ``tip`` says what the positions are, as for spheres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import CsvTable, FloatArray, format_csv, names_in_header, read_csv
from compgen.data.files import read_text
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.data.records import (
    DEVIATION_COLUMNS,
    POSITION_COLUMNS,
    TEMPERATURES,
    TOOL_COLUMNS,
    detect_format,
    deviations_um,
    uncertainties,
    within,
)
from compgen.data.rotary import (
    ANGLE_COLUMNS,
    JOINTS,
    angles_of,
    check_other_angles,
    coordinates_of,
    is_rotary_runs,
    needs_rotary,
    tools_of,
)
from compgen.drawing.display import Displayed, Overview
from compgen.errors import InputError

BALL_COLUMNS = ("ball_x_mm", "ball_y_mm", "ball_z_mm")
_TOOLS = ("probe_length_mm", "tool", *TOOL_COLUMNS)
_length = within(1e6, "mm", "more than a kilometre; is the unit mm?")
#: A bar is no shorter than this, mm.
_SHORTEST_MM = 1.0


@dataclass(frozen=True, repr=False)
class _AtPoses(Displayed):
    """What every reading at a pose has: n rows.

    Parameters
    ----------
    found_mm : commanded positions (n, 3): of the axes, or of the tip, as ``coordinates`` says.
    coordinates : ``joints`` or ``tip``.
    angle_deg : commanded angles by rotary axis, each (n,).
    tool_mm : offset of the tip, (n, 3).
    setup : which set-up, (n,).
    u_mm : standard uncertainty of a reading, (n,); nan where unknown.
    """

    found_mm: FloatArray
    coordinates: str
    angle_deg: Mapping[str, FloatArray]
    tool_mm: FloatArray
    setup: NDArray[np.int64]
    u_mm: FloatArray
    metadata: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    origin: Sequence[tuple[str, int]] = field(default=(), kw_only=True)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.found_mm)

    @property
    def where(self) -> str | None:
        """The file, for messages."""
        return self.origin[0][0] if self.origin else None


@dataclass(frozen=True, repr=False)
class Bars(_AtPoses):
    """Lengths between a ball on the table and one in the spindle (ballbar with rotary axes, ISO 10791-6 BK and CK tests).

    Parameters
    ----------
    ball_mm : the ball on the table in the workpiece frame, (n, 3), nominal.
    nominal_mm, deviation_mm : nominal length, and actual minus nominal, (n,).
    u_nominal_mm : standard uncertainty of the nominal length; None: the length was not calibrated.
    """

    ball_mm: FloatArray
    nominal_mm: FloatArray
    deviation_mm: FloatArray
    u_nominal_mm: float | None = None

    def overview(self) -> Overview:
        """Number of readings and set-ups."""
        return Overview(f"{len(self)} lengths between balls in {len(np.unique(self.setup))} set-ups")


@dataclass(frozen=True, repr=False)
class PosedDeviations(_AtPoses):
    """Actual minus commanded position of the tip in the workpiece frame, which turns with the table; nan: not measured."""

    deviation_mm: FloatArray

    def overview(self) -> Overview:
        """Number of positions."""
        return Overview(f"{len(self)} positions measured with turned axes")


@dataclass(frozen=True, repr=False)
class PosedLengths(_AtPoses):
    """Displacements of tracer stations that stand on the table: the true distance minus a constant per station and set-up."""

    station: Sequence[str]
    length_mm: FloatArray

    def overview(self) -> Overview:
        """Number of readings and stations."""
        return Overview(f"{len(self)} lengths of {len(set(self.station))} stations, axes turned")


def has_angles(path: str | Path) -> bool:
    """Whether a file states positions of rotary axes."""
    return str(path).lower().endswith(".csv") and bool(set(ANGLE_COLUMNS) & names_in_header(read_text(path)))


def rotary_kind(path: Path) -> str | None:
    """What a file says of rotary axes: ``sphere``, ``bar``, ``runs``, ``deviations``, ``lengths``; None: nothing.

    Positions and lengths with all rotary axes at zero are those of the linear axes.
    """
    if path.suffix.lower() != ".csv":
        return None
    try:
        kind = detect_format(path)
    except InputError:  # no file of ours, e.g. in another encoding: the reader of such files says what it is
        return None
    if kind == "sphere" and path.name.lower().endswith(".deviations.csv"):
        kind = "deviations"
    if kind in ("sphere", "bar"):
        return kind
    if kind in (None, "axis"):
        return "runs" if is_rotary_runs(path) else None
    if kind in ("deviations", "lengths") and has_angles(path) and _turned(path):
        return kind
    return None


def _turned(path: Path) -> bool:
    """Whether a file has a rotary axis at another angle than zero."""
    table = read_csv(path, (), ANGLE_COLUMNS, ("",))
    return any(bool(np.any(table.numbers(name, empty=0.0))) for name in ANGLE_COLUMNS if name in table.columns)


def read_bars(machine: Machine, paths: Sequence[str | Path]) -> Bars:
    """Read ``*.bar.csv`` files.

    Raises
    ------
    InputError
        as :func:`compgen.data.rotary.read_spheres`; for a length that is not positive.
    """
    parts = [_bars_of(machine, Path(path)) for path in paths]
    if len({part.u_nominal_mm for part in parts}) > 1:
        raise InputError(
            "some files state u_nominal_um, others another or none; identify them separately", file=paths[-1]
        )
    return _joined(parts, ("ball_mm", "nominal_mm", "deviation_mm"))


def _bars_of(machine: Machine, path: Path) -> Bars:
    own = (*POSITION_COLUMNS, *BALL_COLUMNS, "nominal_mm", "deviation_um")
    table, common = _table_of(machine, path, own, ())
    nominal = _length(table, "nominal_mm")
    for row in np.flatnonzero(nominal < _SHORTEST_MM)[:1].tolist():
        raise table.fail(row, "nominal_mm", f"{nominal[row]:g} mm is no length of a bar; expected a positive number")
    stated = table.metadata.get("u_nominal_um")
    try:
        u = None if stated is None else float(stated)
    except ValueError:
        u = np.nan
    if u is not None and not 0.0 < u < 1e5:
        raise InputError(
            f"{str(stated)[:40]!r} is no standard uncertainty of the bar's length; expected um above zero, or no comment if "
            "its length was not calibrated",
            file=path,
            field="u_nominal_um",
        )
    return Bars(
        **common,
        ball_mm=np.column_stack([table.numbers(name) for name in BALL_COLUMNS]),
        nominal_mm=nominal,
        deviation_mm=deviations_um(table, "deviation_um") * MM_PER_UM,
        u_nominal_mm=None if u is None else u * MM_PER_UM,
    )


def read_posed_deviations(machine: Machine, paths: Sequence[str | Path]) -> PosedDeviations:
    """Read ``*.deviations.csv`` files with ``a_deg``, ``b_deg``, ``c_deg``; InputError as :func:`read_bars`."""
    parts = []
    for path in paths:
        table, common = _table_of(machine, Path(path), POSITION_COLUMNS, DEVIATION_COLUMNS)
        known = [name for name in DEVIATION_COLUMNS if name in table.columns]
        columns = [
            table.numbers(name, empty=np.nan) * MM_PER_UM if name in known else np.full(len(table), np.nan)
            for name in DEVIATION_COLUMNS
        ]
        if not known:
            raise InputError(f"has none of {', '.join(DEVIATION_COLUMNS)}", file=path)
        for name in known:
            values = table.numbers(name, empty=0.0)
            for row in np.flatnonzero(np.abs(values) > 1e5)[:1].tolist():
                raise table.fail(row, name, f"{values[row]:g} um is more than 100 mm; is the unit um?")
        parts.append(PosedDeviations(**common, deviation_mm=np.column_stack(columns)))
    return _joined(parts, ("deviation_mm",))


def read_posed_lengths(machine: Machine, paths: Sequence[str | Path]) -> PosedLengths:
    """Read ``*.lengths.csv`` files with ``a_deg``, ``b_deg``, ``c_deg``; InputError as :func:`read_bars`."""
    parts = []
    for path in paths:
        table, common = _table_of(machine, Path(path), (*POSITION_COLUMNS, "station", "length_mm"), ("point",))
        parts.append(PosedLengths(**common, station=table.text("station"), length_mm=_length(table, "length_mm")))
    return _joined(parts, ("length_mm",), ("station",))


def _table_of(
    machine: Machine, path: Path, required: Sequence[str], optional: Sequence[str]
) -> tuple[CsvTable, dict[str, Any]]:
    """The columns of a file, and what every reading at a pose has; an axis without a column is at its reference."""
    needs_rotary(machine, path)
    table = read_csv(
        path,
        (*required,),
        (*optional, *ANGLE_COLUMNS, *_TOOLS, "setup", "u_um", "run", "time_s", "sphere", "repeat", "block", "pose"),
        (TEMPERATURES,),
    )
    coordinates = coordinates_of(table)
    check_other_angles(machine, table)
    count = len(table)
    angle = {
        letter: angles_of(machine, table, letter)
        if f"{letter.lower()}_deg" in table.columns
        else np.full(count, axis.reference_deg)
        for letter, axis in machine.rotary.items()
    }
    u = uncertainties(table, "u_um") * MM_PER_UM if "u_um" in table.columns else np.full(count, np.nan)
    return table, {
        "found_mm": np.column_stack([table.numbers(name) for name in POSITION_COLUMNS]),
        "coordinates": coordinates,
        "angle_deg": angle,
        "tool_mm": tools_of(machine, table),
        "setup": table.labels("setup") if "setup" in table.columns else np.ones(count, dtype=np.int64),
        "u_mm": u,
        "metadata": {key: value for key, value in table.metadata.items() if key != "rows"},
        "origin": [(str(path), line) for line in table.lines],
    }


_R = TypeVar("_R", Bars, PosedDeviations, PosedLengths)


def _joined(parts: Sequence[_R], arrays: Sequence[str], lists: Sequence[str] = ()) -> _R:
    """Several files of a kind as one; InputError if they disagree on what their positions are."""
    if len({part.coordinates for part in parts}) > 1:
        raise InputError(
            "some files have coordinates = joints, others tip; identify them separately", file=parts[-1].where
        )
    first = parts[0]
    if len(parts) == 1:
        return first
    names = ("found_mm", "tool_mm", "setup", "u_mm", *arrays)
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    columns |= {name: [item for part in parts for item in getattr(part, name)] for name in (*lists, "origin")}
    return replace(
        first,
        **columns,
        angle_deg={letter: np.concatenate([part.angle_deg[letter] for part in parts]) for letter in first.angle_deg},
    )


def format_bars(bars: Bars) -> str:
    """Return the text of a ``*.bar.csv`` file."""
    columns: dict[str, Any] = {name: bars.found_mm[:, k] for k, name in enumerate(POSITION_COLUMNS)}
    columns |= {f"{letter.lower()}_deg": angle for letter, angle in bars.angle_deg.items()}
    columns |= {name: bars.ball_mm[:, k] for k, name in enumerate(BALL_COLUMNS)}
    columns |= {"nominal_mm": bars.nominal_mm, "deviation_um": bars.deviation_mm / MM_PER_UM}
    columns |= {name: bars.tool_mm[:, k] for k, name in enumerate(TOOL_COLUMNS)}
    columns["setup"] = [str(k) for k in bars.setup]
    if not np.isnan(bars.u_mm).any():
        columns["u_um"] = bars.u_mm / MM_PER_UM
    stated = {} if bars.u_nominal_mm is None else {"u_nominal_um": f"{bars.u_nominal_mm / MM_PER_UM:g}"}
    return format_csv(columns, {**bars.metadata, "coordinates": bars.coordinates or JOINTS, **stated})
