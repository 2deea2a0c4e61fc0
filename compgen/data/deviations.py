"""Positions measured against commanded ones: deviations, features of parts, and of artefacts under the machine's own probe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from compgen.data.arguments import numbers
from compgen.data.comparison import best_rotation
from compgen.data.csv_files import CsvTable, FloatArray
from compgen.data.names import MM_PER_UM
from compgen.data.records import (
    APPROACH,
    COVARIATES,
    DEVIATION_COLUMNS,
    LABELS,
    MEASURED_COLUMNS,
    POSITION,
    POSITION_COLUMNS,
    TOOL,
    Field,
    Schema,
    check_rows,
    deviations_um,
    uncertainties,
)
from compgen.drawing.display import Displayed, Overview, Tabular, ranges_of
from compgen.errors import InputError

__all__ = [
    "Artefact",
    "DEVIATION_COLUMNS",
    "PART",
    "Part",
    "Deviations",
    "RoughPose",
    "aligned",
    "format_artefact",
    "format_deviations",
    "format_part",
    "join_artefacts",
    "read_artefacts",
    "read_deviations",
    "read_parts",
    "setups_of",
]

# Measured against commanded positions: ``*.deviations.csv``.


@dataclass(frozen=True)
class RoughPose:
    """Pose of a frame in another: measured - ``measured_mm`` = ``rotation`` (nominal - ``nominal_mm``), (3,), (3, 3)."""

    nominal_mm: FloatArray
    measured_mm: FloatArray
    rotation: FloatArray


@dataclass(frozen=True, repr=False)
class Deviations(Displayed, Tabular):
    """Actual minus commanded position of the tool tip, at n positions.

    Parameters
    ----------
    position_mm : commanded positions, shape (n, 3).
    deviation_mm : actual tip minus (position + tool offset), shape (n, 3); nan for a component that was not measured.
    u_mm : standard uncertainty of each component, shape (n, 3), or None if unknown.
    tool_mm : tool offset of each row, shape (n, 3), or None for that of the machine file.
    approach : last direction of travel of each axis (+1, -1, 0 unknown), shape (n, 3), or None.
    labels : whole-number labels by column name (run, line, repeat, block, setup, pose), each of shape (n,).
    covariates : other numbers by column name (``time_s``, ``temp_...``, ...), each of shape (n,).
    metadata : comments ``key = value`` of the file.
    origin : (file, line) of each row, for messages.
    poses : by set-up, the pose removed from the coordinates of a part; empty for measured deviations.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> deviations = compgen.Deviations(np.zeros((1, 3)), np.array([[2e-3, np.nan, 0.0]]))  # dy was not measured
    >>> deviations
    <Deviations: 1 positions with dx, dz>
    """

    position_mm: FloatArray
    deviation_mm: FloatArray
    u_mm: FloatArray | None = None
    tool_mm: FloatArray | None = None
    approach: FloatArray | None = None
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    covariates: Mapping[str, FloatArray] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()
    poses: Mapping[int, RoughPose] = field(default_factory=dict)

    def __post_init__(self) -> None:
        numbers("deviation_mm", self.deviation_mm, None, 3, unknown=True)
        check_rows(self, unknown=("deviation_mm", "u_mm"))
        if self.u_mm is not None and (self.u_mm <= 0.0).any():
            text = f"contains {np.nanmin(self.u_mm):g}; expected standard uncertainties above zero (nan: not measured)"
            raise InputError(text, field="u_mm")

    def __len__(self) -> int:
        """Return the number of positions."""
        return len(self.position_mm)

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.deviations.csv``, each (n,)."""
        return _DEVIATIONS.cells(_with_measured_u(self))

    def overview(self) -> Overview:
        """Number of positions, the measured components, and the bounding box."""
        found = [
            f"d{letter}"
            for letter, column in zip("xyz", self.deviation_mm.T, strict=True)
            if not np.isnan(column).all()
        ]
        title = f"{len(self)} positions with {', '.join(found)}"
        return Overview(title, ("axis", "from (mm)", "to (mm)"), ranges_of(self.position_mm))


_DEVIATIONS = Schema(
    (
        POSITION,
        Field("deviation_mm", DEVIATION_COLUMNS, deviations_um, MM_PER_UM, digits=4, presence="filled"),
        Field("u_mm", ("u_dx_um", "u_dy_um", "u_dz_um"), uncertainties, MM_PER_UM, digits=4, presence="optional"),
        LABELS,
        APPROACH,
        TOOL,
        COVARIATES,
    ),
    keys=POSITION_COLUMNS,
)


def read_deviations(files: str | Path | Sequence[str | Path]) -> Deviations:
    r"""Read one or more ``*.deviations.csv`` files into one :class:`Deviations`, um to mm.

    Files may measure different components; labels that only some of the files have are 0 in the others.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import compgen
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "mill.deviations.csv"
    ...     with path.open("w") as file:
    ...         print("x_mm,y_mm,z_mm,dx_um", "0,0,0,2.0", "100,0,0,3.5", sep="\n", file=file)
    ...     deviations = compgen.read_deviations(path)
    >>> deviations.deviation_mm[:, 0].tolist()
    [0.002, 0.0035]
    """
    tables = _DEVIATIONS.read_tables(files)
    for table in tables:
        _check_components(table, *_DEVIATIONS.fields[1:3])
    return join_deviations([Deviations(**_DEVIATIONS.values(table)) for table in tables])


def _check_components(table: CsvTable, measured: Field, u: Field) -> list[str]:
    """Check that a component is measured, and that uncertainties are given for all components or none."""
    found = [name for name in measured.columns if name in table.columns]
    if not found:
        raise InputError(f"has none of {', '.join(measured.columns)}; at least one is required", file=table.path)
    given = [name for name in u.columns if name in table.columns]
    needed = [u_name for name, u_name in zip(measured.columns, u.columns, strict=True) if name in found]
    if given and given != needed:
        message = f"has {', '.join(given)}; give an uncertainty for each of {', '.join(needed)}"
        raise InputError(message, file=table.path)
    return found


def join_deviations(parts: Sequence[Deviations]) -> Deviations:
    """Return several records as one; InputError if only some have uncertainties."""
    return _DEVIATIONS.joined(parts)


def format_deviations(deviations: Deviations) -> str:
    """Return the text of a ``*.deviations.csv`` file: positions with 6 decimals (1 nm), deviations in um with 4.

    A component must be measured everywhere or nowhere; where it was not measured it has no uncertainty either.
    """
    return _DEVIATIONS.format(_with_measured_u(deviations), deviations.metadata)


def _with_measured_u(deviations: Deviations) -> Deviations:
    if deviations.u_mm is None:
        return deviations
    nowhere = np.isnan(deviations.deviation_mm).all(axis=0)
    return replace(deviations, u_mm=np.where(nowhere, np.nan, deviations.u_mm))


# Features of parts made on the machine and measured elsewhere: ``*.part.csv`` (nominal and measured coordinates).


#: Coordinates further from their nominal ones than this, rms after the best pose, are not those of the part.
FAR_MM = 1.0
#: Value of ``measured`` in :attr:`Deviations.metadata` if the positions are features of a part.
PART = "part"
_PARTS = Schema(
    (
        Field("xy_mm", POSITION_COLUMNS[:2]),
        Field("z_mm", POSITION_COLUMNS[2:], presence="filled", fill=0.0),
        Field("measured_mm", MEASURED_COLUMNS, presence="filled"),
        Field("u_mm", ("u_mx_um", "u_my_um", "u_mz_um"), uncertainties, MM_PER_UM, presence="filled"),
        TOOL,
        replace(LABELS, columns=("setup",)),
        replace(COVARIATES, columns=()),
        Field("feature", ("feature",), CsvTable.words, presence="optional"),  # a name for people, not evaluated
    )
)


def read_parts(files: str | Path | Sequence[str | Path]) -> Deviations:
    """Read one or more ``*.part.csv`` files: measured minus nominal coordinates, each set-up in its own frame.

    A feature is where the tool was when it was made, so its deviation is the error of the machine at the nominal
    position, seen from the unknown pose of the part. The comment ``# origin_mm = X, Y, Z`` says where the zero of the nominal
    coordinates was in machine coordinates (0, 0, 0 if they are machine coordinates). Without ``z_mm`` all features are at the
    height of the origin.

    Returns
    -------
    Deviations
        aligned: see :func:`aligned`; nan for components that were not measured.

    Raises
    ------
    InputError
        for a file without a measured coordinate or without ``origin_mm``, uncertainties for other coordinates than the
        measured ones, features far from their nominal places.
    """
    tables = _PARTS.read_tables(files)
    for table in tables:
        # both have the same size, whatever the orientation: this detects inches and metres
        measured = _check_components(table, *_PARTS.fields[2:4])
        nominal = [f"{name[1]}_mm" for name in measured if f"{name[1]}_mm" in table.columns]
        spans = [
            float(np.linalg.norm([np.ptp(table.numbers(name)) for name in names], axis=0))
            for names in (nominal, measured)
            if len(names) > 1
        ]
        if len(spans) == 2 and not 0.5 < (spans[1] + 1e-9) / (spans[0] + 1e-9) < 2.0:
            text = f"the nominal features span {spans[0]:g}, the measured ones {spans[1]:g}; both are in mm: check the units"
            raise InputError(text, file=table.path, field=f"columns {', '.join(measured)}")
    found = join_deviations([_part(table) for table in tables])
    unknown = found.u_mm is None or bool(np.isnan(found.u_mm).all())
    return aligned(replace(found, u_mm=None if unknown else found.u_mm))


def _part(table: CsvTable) -> Deviations:
    """Return measured minus nominal coordinates of one file at the nominal positions in the machine."""
    values = _PARTS.values(table)
    del values["feature"]
    nominal_mm = np.column_stack([values.pop("xy_mm"), values.pop("z_mm")])
    values["metadata"]["measured"] = PART
    origin_mm = _origin(table)
    if origin_mm is None:
        raise InputError(
            "does not say where the part was: its coordinates count from a zero of the part, and the errors depend on the place "
            "in the machine. Add the comment '# origin_mm = X, Y, Z' with the machine coordinates of that zero (the work offset, "
            "e.g. of G54), or '# origin_mm = 0, 0, 0' if the nominal coordinates are machine coordinates",
            file=table.path,
            field="comment origin_mm",
        )
    return Deviations(nominal_mm + origin_mm, values.pop("measured_mm") - nominal_mm, **values)


def _origin(table: CsvTable) -> FloatArray | None:
    """Return the origin of a part or artefact in machine coordinates, mm, from the comment ``origin_mm``; None without it."""
    text = table.metadata.get("origin_mm")
    if text is None:
        return None
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise InputError(f"the comment origin_mm = {text!r} is not three numbers X, Y, Z in mm", file=table.path)
    return values


@dataclass(frozen=True, repr=False)
class Part(Displayed, Tabular):
    """Features of a part as another machine measured them, n rows: what ``*.part.csv`` contains.

    Parameters
    ----------
    feature : name of the feature of each row.
    nominal_mm : its nominal place, from a zero of the part, (n, 3).
    measured_mm : its measured place in any frame, (n, 3); nan for a component that was not measured.
    setup : number of the clamping in which it was made, (n,).
    origin_mm : machine coordinates of the zero of the nominal places, (3,).
    metadata, origin : comments ``key = value``; file and line of each row.
    """

    feature: Sequence[str]
    nominal_mm: FloatArray
    measured_mm: FloatArray
    setup: NDArray[np.int64]
    origin_mm: FloatArray
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.feature)

    @property
    def position_mm(self) -> FloatArray:
        """Nominal places in machine coordinates, (n, 3)."""
        return self.nominal_mm + self.origin_mm

    def deviations(self) -> Deviations:
        """Return what :func:`read_parts` returns of the file: aligned deviations at the places in the machine."""
        found = Deviations(
            self.position_mm,
            self.measured_mm - self.nominal_mm,
            labels={"setup": self.setup},
            metadata={**self.metadata, "measured": PART},
            origin=self.origin,
        )
        return aligned(found)

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.part.csv``, each (n,)."""
        return _PARTS.cells(_part_columns(self))

    def overview(self) -> Overview:
        """Numbers of features and set-ups, and the box of the machine that they cover."""
        title = f"{len(self)} features of a part in {len(np.unique(self.setup))} set-ups"
        return Overview(title, ("axis", "from (mm)", "to (mm)"), ranges_of(self.position_mm))


def format_part(part: Part) -> str:
    """Return the text of a ``*.part.csv`` file: coordinates in mm with 6 decimals (1 nm)."""
    origin = ", ".join(f"{value:.6g}" for value in part.origin_mm)
    return _PARTS.format(_part_columns(part), {**part.metadata, "origin_mm": origin})


def _part_columns(part: Part) -> SimpleNamespace:
    return SimpleNamespace(
        **vars(part),
        xy_mm=part.nominal_mm[:, :2],
        z_mm=part.nominal_mm[:, 2:],
        u_mm=np.full(part.nominal_mm.shape, np.nan),
        tool_mm=None,
        labels={"setup": part.setup},
        covariates={},
    )


# An artefact (plate, ring, step gauge) measured by the machine's own probe: ``*.artefact.csv``.


@dataclass(frozen=True, repr=False)
class Artefact(Displayed, Tabular):
    """Features of artefacts as the machine's own probe measured them, n rows.

    Parameters
    ----------
    feature : name of the feature of each row; the same name in several set-ups is the same feature.
    nominal_mm : its place in the artefact, (n, 3); that of a calibration where ``calibrated``.
    u_nominal_mm : standard uncertainty of the calibrated place (n, 3); nan or zero: exact.
    measured_mm : machine coordinates at which the probe found it, (n, 3); nan for a component that was not measured.
    setup : number of the set-up, (n,); the artefact lies anew in each.
    calibrated : whether the nominal places are calibrated, (n,); else every feature's own place is unknown.
    tool_mm : offset of the probe, (n, 3), or None for the machine's tool.
    metadata, origin : comments ``key = value`` of the file; file and line of each row.
    """

    feature: Sequence[str]
    nominal_mm: FloatArray
    u_nominal_mm: FloatArray
    measured_mm: FloatArray
    setup: NDArray[np.int64]
    calibrated: NDArray[np.bool_]
    tool_mm: FloatArray | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    origin: Sequence[tuple[str, int]] = ()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.feature)

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``*.artefact.csv``, each (n,)."""
        return _ARTEFACTS.cells(_artefact_columns(self))

    def overview(self) -> Overview:
        """Numbers of features and set-ups, and the box of the machine that they cover."""
        kind = (
            "calibrated" if self.calibrated.all() else "uncalibrated" if not self.calibrated.any() else "both kinds of"
        )
        title = f"{len(set(self.feature))} {kind} features in {len(np.unique(self.setup))} set-ups"
        known = np.where(np.isnan(self.measured_mm).all(axis=0), self.nominal_mm, self.measured_mm)
        return Overview(title, ("axis", "from (mm)", "to (mm)"), ranges_of(known))


_ARTEFACTS = Schema(
    (
        Field("feature", ("feature",), CsvTable.names),
        Field("xy_mm", POSITION_COLUMNS[:2]),
        Field("z_mm", POSITION_COLUMNS[2:], presence="filled", fill=0.0),
        Field("u_nominal_mm", ("u_x_um", "u_y_um", "u_z_um"), unit=MM_PER_UM, digits=4, presence="filled"),
        Field("measured_mm", MEASURED_COLUMNS, presence="filled"),
        Field("setup", ("setup",), CsvTable.labels, digits=0, presence="filled", fill=0),
        TOOL,
    )
)


def read_artefacts(files: str | Path | Sequence[str | Path]) -> Artefact:
    """Read one or more ``*.artefact.csv`` files into one :class:`Artefact`; each file has set-ups of its own.

    The comment ``# calibrated = false`` says that the nominal places are only nominal. Without ``z_mm`` all features lie in one
    plane. A component of the machine that was not measured counts as the nominal one plus the comment ``# origin_mm = X, Y, Z``.

    Raises
    ------
    InputError
        for a feature that is twice in a set-up, or a file without a measured coordinate.
    """
    parts, first = [], 0
    for table in _ARTEFACTS.read_tables(files):
        values = _ARTEFACTS.values(table)
        flag = table.metadata.get("calibrated", "true").lower()
        if flag not in ("true", "false"):
            raise InputError(f"the comment calibrated = {flag!r} is neither true nor false", file=table.path)
        nominal_mm = np.column_stack([values.pop("xy_mm"), values.pop("z_mm")])
        if np.isnan(values["measured_mm"]).all():
            raise InputError(f"has none of {', '.join(MEASURED_COLUMNS)}; at least one is needed", file=table.path)
        for row, column in np.argwhere(values["u_nominal_mm"] < 0)[:1].tolist():
            text = f"{values['u_nominal_mm'][row, column] / MM_PER_UM:g} um is not a standard uncertainty; 0 is exact"
            raise table.fail(row, f"u_{'xyz'[column]}_um", text)
        keys = list(zip(values["feature"], values["setup"].tolist(), strict=True))
        for row, key in enumerate(keys):
            if keys.index(key) < row:
                text = f"feature {key[0]!r} of set-up {int(key[1])} is already in line {table.lines[keys.index(key)]}"
                raise table.fail(row, "feature", f"{text}; number the set-ups, or take the mean of repeats")
        _, setup = np.unique(values.pop("setup"), return_inverse=True)
        known = np.full(len(table), flag == "true")
        found = Artefact(
            nominal_mm=nominal_mm, setup=setup.ravel().astype(np.int64) + first, calibrated=known, **values
        )
        missing = np.isnan(found.measured_mm).all(axis=0)
        origin_mm = _origin(table)
        place_mm = np.zeros(3) if origin_mm is None else origin_mm
        parts.append(replace(found, nominal_mm=np.where(missing, found.nominal_mm + place_mm, found.nominal_mm)))
        first = int(found.setup.max()) + 1
    return join_artefacts(parts)


def join_artefacts(parts: Sequence[Artefact]) -> Artefact:
    """Return several records as one, whose set-ups are numbered differently; InputError if only some state the probe's offset."""
    tools = [part.tool_mm for part in parts]
    if any(tool is None for tool in tools) and any(tool is not None for tool in tools):
        raise InputError("some files have tool_x_mm, tool_y_mm, tool_z_mm, others not; give them in every file")
    joined = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("nominal_mm", "u_nominal_mm", "measured_mm", "setup", "calibrated")
    }
    return Artefact(
        feature=[name for part in parts for name in part.feature],
        tool_mm=None if tools[0] is None else np.concatenate([tool for tool in tools if tool is not None]),
        metadata={key: value for part in parts for key, value in part.metadata.items()},
        origin=[place for part in parts for place in part.origin],
        **joined,
    )


def format_artefact(artefact: Artefact) -> str:
    """Return the text of an ``*.artefact.csv`` file: coordinates in mm with 6 decimals (1 nm), uncertainties in um with 4.

    A component must be measured everywhere or nowhere. InputError if some features are calibrated and others not, which
    one file cannot state.
    """
    if artefact.calibrated.any() != artefact.calibrated.all():
        raise InputError("calibrated and uncalibrated features need a file each; write them separately")
    calibrated = "true" if artefact.calibrated.all() else "false"
    # the place of a component that was not measured already contains the origin
    metadata = {key: value for key, value in artefact.metadata.items() if key != "origin_mm"}
    return _ARTEFACTS.format(_artefact_columns(artefact), {**metadata, "calibrated": calibrated})


def _artefact_columns(artefact: Artefact) -> SimpleNamespace:
    return SimpleNamespace(**vars(artefact), xy_mm=artefact.nominal_mm[:, :2], z_mm=artefact.nominal_mm[:, 2])


def setups_of(deviations: Deviations) -> NDArray[np.int64]:
    """Return the number of the set-up of every position, (n,); 0 without the label."""
    return np.asarray(deviations.labels.get("setup", np.zeros(len(deviations), dtype=np.int64)))


def aligned(deviations: Deviations) -> Deviations:
    """Remove the best-fit pose from every set-up, so that the rest is small; in the plane for two components.

    Raises
    ------
    InputError
        if the rest cannot be an error of a machine (axes exchanged or mirrored, features in another order).
    """
    setups, turned = setups_of(deviations), deviations.deviation_mm.copy()
    poses = {}
    for setup in np.unique(setups).tolist():
        own = setups == setup
        nominal = deviations.position_mm[own]
        actual = nominal + deviations.deviation_mm[own]
        rotation = _turn(nominal, actual)
        # means over the measured components; 0 for the others
        seen = np.isfinite(actual)
        count = np.maximum(seen.sum(axis=0), 1)
        middle, there = (np.where(seen, values, 0.0).sum(axis=0) / count for values in (nominal, actual))
        poses[setup] = RoughPose(middle, there, rotation)
        back = np.where(seen, actual - there, 0.0) @ rotation
        turned[own] = np.where(seen, back + middle - nominal, np.nan)
        rms_mm = float(np.sqrt(np.nanmean(turned[own] ** 2)))
        if rms_mm > FAR_MM:
            raise InputError(
                f"set-up {setup}: after the best pose the coordinates are {rms_mm:.3g} mm rms from their nominal ones; are two "
                "axes exchanged, one mirrored, the unit wrong, or the features numbered differently?",
                file=deviations.origin[0][0] if deviations.origin else None,
            )
    return replace(deviations, deviation_mm=turned, poses=poses)


def _turn(nominal_mm: FloatArray, actual_mm: FloatArray) -> FloatArray:
    """The rotation (3, 3) from nominal to measured coordinates, in the plane or the space that was measured."""
    rows = np.isfinite(actual_mm)
    components = np.flatnonzero(rows.any(axis=0))
    complete = rows[:, components].all(axis=1)
    if len(components) < 2 or np.count_nonzero(complete) < len(components):
        return np.eye(3)
    first, second = (values[complete][:, components] for values in (nominal_mm, actual_mm))
    moment = np.zeros((3, 3))
    moment[np.ix_(components, components)] = (second - second.mean(axis=0)).T @ (first - first.mean(axis=0))
    size = np.linalg.svd(moment, compute_uv=False)
    if size[len(components) - 2] < 1e-9 * max(
        size[0], 1e-9
    ):  # all on one line: the rotation about it is not observable
        return np.eye(3)
    if len(components) == 2:  # the component that was not measured stays: no turn out of the plane, no mirror image
        left = 3 - components.sum()
        moment[left, left] = size[0]
    return best_rotation(moment)
