"""The joint covariance of identified errors and stations, in memory and as ``identified.covariance.npz``.

It is kept as a factor F with F F^T the covariance, one row for every value of the errors file, every station coordinate
and dead length. The uncertainty of E = C P at a point is then the length of a row of (C B) F: the covariance of E
itself is never formed.
"""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, hat_matrix
from compgen.data.files import read_bytes, sha256_of
from compgen.data.lengths import Lengths, Points
from compgen.data.machine import Machine
from compgen.data.names import ERROR_INDEX, LARGEST, SQUARENESS_NAMES, error_named
from compgen.drawing.display import Displayed, Overview
from compgen.errors import CompgenWarning, InputError, Message
from compgen.identification.adjust.propagation import Contribution, Systematic, SystematicInputs, responses
from compgen.identification.adjust.unknowns import ErrorParameters
from compgen.identification.result import Identification, table_of_values, worst_uncertainty
from compgen.kinematics.first_order import c_matrix
from compgen.kinematics.gauge import common_gauge_part

if TYPE_CHECKING:
    from compgen.identification.posterior import Posterior, StoredPosterior

FILE_NAME = "identified.covariance.npz"
FORMAT = "compgen covariance 1"
#: Comment of a file of fitted errors: the covariance file of the errors that were fitted; another one has its SHA-256.
OF_FITTED = "covariance_before_fit"
#: Least standard uncertainty of a stated value, um and urad.
FINEST = 1e-3
#: Positions closer than this are one, mm.
SAME_MM = 1e-4
#: Points whose rows of C B are computed together.
CHUNK = 1024
_MEMBERS = ("format", "machine", "errors_sha256", "error", "position_mm", "unit", "station", "setup", "factor")


@dataclass(frozen=True, repr=False)
class Covariance(Displayed):
    """Covariance of k error values, S stations and g dead lengths, all in mm and rad.

    Parameters
    ----------
    error, position_mm : name and position (k,) of each error value, in the order of the errors file; the position of a
        squareness error is nan.
    station, setup : name and set-up of each dead length (g,); the stations are in the order of first mention.
    factor : shape (k + 3 S + g, r); ``factor @ factor.T`` is the covariance: error values, then x, y, z of every
        station, then dead lengths.
    machine, errors_sha256 : name of the machine, and SHA-256 of its errors file ("" for none).
    posterior : what is known of every error, also of those that the errors file does not list; None if it follows from
        the errors file and the prior of the machine file (:func:`posterior_with`).
    rotary : constants of rotary axes that were adjusted together with these values: names, and their rows (m, r) of the factor.
    """

    error: tuple[str, ...]
    position_mm: FloatArray
    station: tuple[str, ...]
    setup: NDArray[np.int64]
    factor: FloatArray
    machine: str = ""
    errors_sha256: str = ""
    posterior: StoredPosterior | None = None
    rotary: tuple[tuple[str, ...], FloatArray] | None = None

    @property
    def stations(self) -> tuple[str, ...]:
        """Names of the stations, S of them."""
        return tuple(dict.fromkeys(self.station))

    @property
    def errors_factor(self) -> FloatArray:
        """Rows of the factor that belong to the error values, (k, r)."""
        return self.factor[: len(self.error)]

    @property
    def errors_covariance(self) -> FloatArray:
        """Covariance of the error values, (k, k), mm and rad."""
        return self.errors_factor @ self.errors_factor.T

    @property
    def stations_covariance(self) -> FloatArray:
        """Covariance of the station coordinates, (3 S, 3 S), mm^2."""
        first = len(self.error)
        rows = self.factor[first : first + 3 * len(self.stations)]
        return rows @ rows.T

    def overview(self) -> Overview:
        """How many values it covers."""
        machine = f"{self.machine}, " if self.machine else ""
        return Overview(
            f"{machine}{len(self.error)} error values, {len(self.stations)} stations, {len(self.station)} dead lengths"
        )


def error_values(layout: ErrorParameters) -> Iterator[tuple[str, FloatArray, slice, FloatArray]]:
    """Yield name, positions (m,), columns and matrix (m, columns) that make the values in the errors file."""
    positions = [layout.output_positions_mm(axis) for axis in range(3)]
    bases = [layout.basis(axis, positions[axis]) for axis in range(3)]
    for curve in layout.curves:
        axis = curve.error.axis
        yield curve.error.name, positions[axis], curve.columns, bases[axis] @ curve.free
    first = layout.size - len(layout.squareness)
    for k, name in enumerate(layout.squareness):
        yield name, np.array([np.nan]), slice(first + k, first + k + 1), np.eye(1)


def covariance_from_factor(
    layout: ErrorParameters, factor: FloatArray, stations: Sequence[tuple[str, int]]
) -> Covariance:
    """Build a :class:`Covariance` from a factor (unknowns, r) of the covariance of all unknowns.

    ``stations`` holds name and set-up of each dead length; the unknowns are errors, stations, dead lengths.
    """
    names: list[str] = []
    positions, rows = [], []
    for name, position_mm, columns, matrix in error_values(layout):
        names += [name] * len(position_mm)
        positions.append(position_mm)
        rows.append(matrix @ factor[columns])
    return Covariance(
        error=tuple(names),
        position_mm=np.concatenate(positions),
        station=tuple(name for name, _ in stations),
        setup=np.array([setup for _, setup in stations], dtype=np.int64),
        factor=np.vstack([*rows, factor[layout.size :]]),
        machine=layout.machine.name,
    )


def joint_covariance(result: Identification) -> Covariance:
    """Return the covariance of all identified values, including systematic inputs."""
    own = "posterior_means" in result.details and result.posterior is not None
    posterior = result.posterior.stored() if own and result.posterior is not None else None
    if result.values_factor is not None:
        found = covariance_of_values(result.errors, result.values_factor, result.layout.machine.name)
        return replace(found, posterior=posterior)
    if result.adjustment is None:
        raise ValueError("this identification has no joint covariance")
    factor = result.adjustment.covariance_factor()
    if result.systematic is not None:
        factor = np.hstack([factor, result.systematic.response])
    stations = [(item.station, item.setup) for item in result.stations]
    return replace(covariance_from_factor(result.layout, factor, stations), posterior=posterior)


def covariance_of_values(errors: ErrorTable, factor: FloatArray, machine: str = "") -> Covariance:
    """Covariance of error values that a factor (k, r) in the order of the errors file describes; no stations."""
    return Covariance(*errors.labels(), (), np.zeros(0, dtype=np.int64), factor, machine)


def values_with_factor(
    layout: ErrorParameters, unknowns: FloatArray, factor: FloatArray
) -> tuple[ErrorTable, FloatArray]:
    """Return the errors of a layout, and a factor of the covariance of their values in the order of the errors file."""
    values, rows = [], {}
    for name, position_mm, columns, matrix in error_values(layout):
        rows[name] = matrix @ factor[columns]
        values.append((name, position_mm, matrix @ unknowns[columns], np.linalg.norm(rows[name], axis=1)))
    errors = table_of_values(values)
    return errors, np.vstack([rows[name] for name in errors.names])


def values_at_nodes(errors: ErrorTable, names: Sequence[str], position_mm: FloatArray) -> FloatArray:
    """Values of a table by name and position, (k,), mm and rad."""
    label, result = np.array(names), np.zeros(len(names))
    for name in dict.fromkeys(names):
        rows = label == name
        result[rows] = (
            errors.squareness[name][0] if name in SQUARENESS_NAMES else errors.curves[name].at(position_mm[rows])
        )
    return result


def covariance_or_independent(
    errors: ErrorTable, covariance: Covariance | None, machine: str = ""
) -> Covariance | None:
    """Return the covariance; without one that of independent values from their u; None if a u is unknown."""
    if covariance is not None:
        return covariance
    u = errors.uncertainties()
    return covariance_of_values(errors, np.diag(u), machine) if len(u) and np.isfinite(u).all() else None


def posterior_with(machine: Machine, errors: ErrorTable, covariance: Covariance | None) -> Posterior | None:
    """Return what is known of every error of a machine: what was identified with a table, or the table and the prior.

    None without a prior (``class = "none"``), and if an uncertainty of the table is unknown: then nothing can be said.
    """
    if machine.prior.is_none:
        return None
    if covariance is not None and covariance.posterior is not None:
        found = covariance.posterior.of(machine)
        if replace(found.prior, factor=machine.prior.factor) != machine.prior:
            warnings.warn(
                Message(
                    "prior-stays",
                    "the errors were identified with the prior of class {stated_class!r}, which stays; "
                    "that stated now ({stated_class2!r}, [prior] of the machine file or --prior) counts "
                    "when they are identified again",
                    stated_class=found.prior.stated_class,
                    stated_class2=machine.prior.stated_class,
                ),
                CompgenWarning,
                stacklevel=2,
            )
        return found
    known = covariance_or_independent(errors, covariance, machine.name)
    if known is None:
        return None
    from compgen.identification.posterior import posterior_of_values  # not needed where errors are only identified

    factor = known.errors_factor
    if covariance is None:
        unit = np.array([error_named(name).si_per_unit for name in known.error])
        factor = np.diag(np.maximum(errors.uncertainties(), FINEST * unit))
    # a table of another program may have another gauge
    part, values = common_gauge_part(machine, errors), errors.values()
    values, factor = values - part @ values, factor - part @ factor
    return posterior_of_values(machine, known.error, known.position_mm, values, factor, taken_off=part)


# --- systematic inputs on top of the random part -------------------------------------------------------------------


def with_systematic(
    machine: Machine, lengths: Lengths, result: Identification, inputs: SystematicInputs
) -> Identification:
    """Return the identification with the contributions of systematic inputs added to all standard uncertainties."""
    if result.adjustment is None or not inputs:
        return result
    found = responses(machine, lengths, result.layout, result.adjustment, inputs)
    given = dict(inputs.items())
    contributions = []
    for name, response in found.items():
        rows = [matrix @ response[columns] for _, _, columns, matrix in error_values(result.layout)]
        worst = worst_uncertainty(_with_u(result.errors, np.vstack(rows)))
        contributions.append(Contribution(name, given[name], response, worst))
    return _including(result, Systematic(tuple(contributions), result.worst_u))


def _including(result: Identification, systematic: Systematic, errors: ErrorTable | None = None) -> Identification:
    """Return the identification with these contributions in its standard uncertainties; ``errors`` may have them already."""
    joint = joint_covariance(replace(result, systematic=systematic))
    if errors is None:
        errors = _with_u(result.errors, joint.errors_factor)
    u = np.sqrt(np.einsum("ij,ij->i", joint.factor, joint.factor))[len(joint.error) :]
    order, first = {name: k for k, name in enumerate(joint.stations)}, 3 * len(joint.stations)
    stations = tuple(
        replace(
            item,
            u_position_mm=tuple(u[3 * order[item.station] : 3 * order[item.station] + 3].tolist()),
            u_dead_length_mm=float(u[first + k]),
        )
        for k, item in enumerate(result.stations)
    )
    return replace(
        result,
        errors=errors,
        stations=stations,
        worst_u=worst_uncertainty(errors),
        systematic=systematic,
    )


def with_response(result: Identification, others: Sequence[Identification], name: str, share: float) -> Identification:
    """Return the identification with the contribution ``name`` added to all standard uncertainties.

    Parameters
    ----------
    others : the same readings, each with one cause larger by ``share`` of its standard uncertainty.
    """
    if not others:
        return result
    moved = np.array([item.errors.values() - result.errors.values() for item in others]).T / share
    if result.values_factor is not None or result.adjustment is None:
        factor = moved if result.values_factor is None else np.hstack([result.values_factor, moved])
        errors = _with_u(result.errors, factor)
        found = replace(result, errors=errors, values_factor=factor, worst_u=worst_uncertainty(errors))
    else:
        columns = np.array([_unknowns(item) - _unknowns(result) for item in others]).T / share
        of_cause = _with_u(result.errors, moved)
        worst = worst_uncertainty(of_cause)
        # u of the errors may hold more than the adjustment knows, such as the shape of a curve between the targets
        u = np.hypot(result.errors.uncertainties(), of_cause.uncertainties())
        known = () if result.systematic is None else result.systematic.contributions
        before = result.worst_u if result.systematic is None else result.systematic.random_worst
        systematic = Systematic((*known, Contribution(name, 1.0, columns, worst)), before)
        found = _including(result, systematic, result.errors.with_values(u=u))
    if result.posterior_source is None:
        return found

    def later() -> Posterior:
        own = result.posterior
        assert own is not None
        moved = [item.posterior.state - own.state for item in others if item.posterior is not None]
        return replace(own, factor=np.hstack([own.factor, np.array(moved).T / share]))

    return replace(found, posterior_source=later)


def _unknowns(result: Identification) -> FloatArray:
    """All unknowns of an adjustment: errors, stations, dead lengths."""
    assert result.adjustment is not None
    state = result.adjustment.state
    return np.concatenate([state.errors, state.stations_mm.ravel(), state.dead_length_mm])


def _with_u(errors: ErrorTable, factor: FloatArray) -> ErrorTable:
    """Return the table with the uncertainties of a factor (values, r) whose rows are in the order of the table."""
    return errors.with_values(u=np.sqrt(np.einsum("ij,ij->i", factor, factor)))


# --- uncertainty of E ----------------------------------------------------------------------------------------------


def predict_uncertainty(machine: Machine, covariance: Covariance, points: Points) -> FloatArray:
    """Return the standard uncertainty of E = C P at commanded points, shape (n, 3), mm (``docs/method.md``).

    Parameters
    ----------
    machine : chain, tool offset and squareness reference are taken from it.
    covariance : of the identified errors.
    points : the points, with their tool offsets if they have any.
    """
    u = np.empty((len(points), 3))
    if covariance.posterior is not None:
        known = covariance.posterior.of(machine)
        for first in range(0, len(points), CHUNK):
            rows = slice(first, first + CHUNK)
            u[rows] = np.sqrt(known.field(points.position_mm[rows], points.tools(rows)).variance)
        return u
    factor = covariance.errors_factor
    for first in range(0, len(points), CHUNK):
        rows = slice(first, first + CHUNK)
        spread = error_design(machine, covariance, points.position_mm[rows], points.tools(rows)) @ factor
        u[rows] = np.sqrt(np.einsum("nij,nij->ni", spread, spread))
    return u


def error_design(
    machine: Machine, covariance: Covariance, position_mm: FloatArray, tool_mm: FloatArray | None = None
) -> FloatArray:
    """Return C B at points (n, 3): derivative of E by the error values of the file, shape (n, 3, k)."""
    matrix = c_matrix(machine, position_mm, tool_mm)
    names = np.array(covariance.error)
    design = np.zeros((len(position_mm), 3, len(names)))
    for name in dict.fromkeys(covariance.error):
        columns = np.flatnonzero(names == name)
        column = matrix[:, :, ERROR_INDEX[name]]
        if name in SQUARENESS_NAMES:
            design[:, :, columns] = column[:, :, None]
        else:
            basis = hat_matrix(covariance.position_mm[columns], position_mm[:, error_named(name).axis])
            for output in np.flatnonzero(column.any(axis=0)):
                design[:, output, columns] = column[:, output, None] * basis
    return design


# --- file ----------------------------------------------------------------------------------------------------------


def format_covariance(covariance: Covariance, errors_text: str) -> bytes:
    """Return the contents of a ``*.covariance.npz`` file that belongs to the errors file ``errors_text``."""
    units = ["mm" if error_named(name).kind == "linear" else "rad" for name in covariance.error]
    members: dict[str, NDArray[np.generic]] = {
        "format": np.array(FORMAT),
        "machine": np.array(covariance.machine),
        "errors_sha256": np.array(sha256_of(errors_text.encode("utf-8"))),
        "error": np.array(covariance.error),
        "position_mm": covariance.position_mm,
        "unit": np.array(units),
        "station": np.array(covariance.station),
        "setup": covariance.setup,
        "factor": covariance.factor,
        **({} if covariance.posterior is None else covariance.posterior.members()),
    }
    if covariance.rotary is not None:
        members |= {"rotary_error": np.array(covariance.rotary[0]), "rotary_factor": covariance.rotary[1]}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, array in members.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.ascontiguousarray(array).reshape(array.shape), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))  # a fixed date: same input, same bytes
            archive.writestr(entry, member.getvalue(), zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def read_covariance(path: str | Path, errors: str | Path | None = None) -> Covariance:
    """Read a ``*.covariance.npz`` file strictly.

    Parameters
    ----------
    path : the file.
    errors : the errors file that it must belong to; None accepts any.

    Raises
    ------
    InputError
        if it is another kind of file, truncated, damaged, inconsistent, or belongs to another errors file.
    """
    source = Path(path)
    covariance = parse_covariance(read_bytes(source), source)
    if errors is not None:
        digest = sha256_of(read_bytes(errors))
        if digest != covariance.errors_sha256:
            raise InputError(
                Message(
                    "covariance-other-errors",
                    "belongs to another errors file (SHA-256 {errors_sha256}...) than {errors} "
                    "({digest}...); give the errors file that was written with it, unchanged",
                    errors_sha256=covariance.errors_sha256[:12],
                    errors=errors,
                    digest=digest[:12],
                ),
                file=source,
            )
    return covariance


def uncertainty_of_fitted(name: str, content: bytes) -> dict[str, str]:
    """Return the comments with which a file of fitted errors names the covariance file of the errors that were fitted."""
    return {OF_FITTED: name, f"{OF_FITTED}_sha256": sha256_of(content)}


def covariance_file_of(path: Path, errors: ErrorTable) -> Path | None:
    """Return the covariance file that an errors file refers to, if it exists."""
    name = errors.metadata.get("covariance") or errors.metadata.get(OF_FITTED)
    return path.parent / name if name and (path.parent / name).is_file() else None


def covariance_named_by(path: Path, errors: ErrorTable) -> Covariance | None:
    """Return the covariance file that an errors file refers to, if it exists and matches; warn if it is missing or does not.

    Fitted errors have that of the errors that were fitted: smoothing adds no knowledge, and taken as independent from node
    to node, what was hardly measured would be counted as many readings.
    """
    covariance_file = covariance_file_of(path, errors)
    if covariance_file is None:
        if name := errors.metadata.get("covariance") or errors.metadata.get(OF_FITTED):
            message = (
                f"{path.name} refers to {name}, which is not beside it: u_value is used instead, independent from node to node, "
                f"and the uncertainties come out wrong; copy {name} into {path.parent}"
            )
            warnings.warn(message, CompgenWarning, stacklevel=2)
        return None
    found = read_covariance(covariance_file)
    if "covariance" in errors.metadata:
        if found.errors_sha256 == sha256_of(read_bytes(path)):
            return found
    elif errors.metadata.get(f"{OF_FITTED}_sha256") == sha256_of(read_bytes(covariance_file)):
        names, at_mm = errors.labels()
        if names == found.error and np.allclose(at_mm, found.position_mm, atol=SAME_MM, equal_nan=True):
            return found
        own = covariance_or_independent(errors, None, found.machine)  # fitting added a squareness
        return None if own is None else replace(own, posterior=found.posterior)
    message = f"{covariance_file} belongs to another version of {path.name}; u_value is used instead"
    warnings.warn(
        Message("node-independent", "{message}, independent from node to node", message=message),
        CompgenWarning,
        stacklevel=2,
    )
    return None


def parse_covariance(content: bytes, source: Path) -> Covariance:
    """Read the contents of a ``*.covariance.npz`` file; ``source`` is the name in messages."""
    if not content.startswith(b"PK"):
        raise InputError(
            Message(
                "covariance-file-unknown", "is not a covariance file (*.covariance.npz, written by volcomp identify)"
            ),
            file=source,
        )
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            members = {name: archive[name] for name in archive.files}
            for name, array in members.items():
                if not isinstance(array, np.ndarray):  # numpy returns the bytes of what does not begin as an array
                    raise ValueError(Message("covariance-no-array", "{name} is not an array", name=name))
    except Exception as error:  # what reads archives raises errors of many kinds: struct, tokenize, zlib
        raise InputError(
            Message("covariance-damaged", "cannot be read: is it truncated or damaged? ({error})", error=error),
            file=source,
        ) from error
    if str(members.get("format", "")) != FORMAT:
        raise InputError(
            Message("covariance-version", "is not a covariance file of this version (format {value!r})", value=FORMAT),
            file=source,
        )
    missing = [name for name in _MEMBERS if name not in members]
    if missing:
        raise InputError(
            Message(
                "covariance-incomplete",
                "lacks {missing}; write it again with volcomp identify",
                missing=", ".join(missing),
            ),
            file=source,
        )
    return _checked(source, members)


def _rotary_of(members: dict[str, NDArray[np.generic]]) -> tuple[tuple[str, ...], FloatArray] | None:
    """Constants of rotary axes and their rows of the factor; None if there are none; ValueError for parts that do not match."""
    if "rotary_error" not in members:
        return None
    names = tuple(str(name) for name in members["rotary_error"].ravel())
    rows = np.asarray(members.get("rotary_factor", np.zeros((0, 0))), dtype=np.float64)
    if rows.shape != (len(names), np.asarray(members["factor"]).shape[-1]) or not np.isfinite(rows).all():
        raise ValueError("the rows of rotary axes do not match the others")
    return names, rows


def _checked(source: Path, members: dict[str, NDArray[np.generic]]) -> Covariance:
    from compgen.identification.posterior import StoredPosterior  # not needed where errors are only identified

    try:
        covariance = Covariance(
            error=tuple(str(name) for name in members["error"].ravel()),
            position_mm=np.asarray(members["position_mm"], dtype=np.float64).ravel(),
            station=tuple(str(name) for name in members["station"].ravel()),
            setup=np.asarray(members["setup"], dtype=np.int64).ravel(),
            factor=np.asarray(members["factor"], dtype=np.float64),
            machine=str(members["machine"]),
            errors_sha256=str(members["errors_sha256"]),
            posterior=StoredPosterior.from_members(members) if "posterior_names" in members else None,
            rotary=_rotary_of(members),
        )
    except (ValueError, TypeError) as error:
        raise InputError(
            Message(
                "covariance-no-numbers",
                "contains something other than numbers where numbers are expected: {error}",
                error=error,
            ),
            file=source,
        ) from error
    unknown = [name for name in covariance.error if name not in ERROR_INDEX]
    if unknown:
        raise InputError(
            Message(
                "covariance-error-unknown",
                "contains {unknown!r}, which is not one of the 21 errors",
                unknown=unknown[0],
            ),
            file=source,
        )
    count = len(covariance.error)
    rows = count + 3 * len(covariance.stations) + len(covariance.station)
    shapes = (covariance.position_mm.shape, covariance.setup.shape, covariance.factor.shape[:1], covariance.factor.ndim)
    if shapes != ((count,), (len(covariance.station),), (rows,), 2):
        raise InputError(
            Message(
                "covariance-parts",
                "its parts do not match: {count} error values, shapes {shapes}",
                count=count,
                shapes=shapes,
            ),
            file=source,
        )
    if not (np.abs(covariance.factor) <= LARGEST).all():
        raise InputError(
            Message(
                "covariance-not-finite",
                "the factor contains numbers that are not finite, or above {value:g}",
                value=LARGEST,
            ),
            file=source,
        )
    for name in dict.fromkeys(covariance.error):
        position = covariance.position_mm[np.array(covariance.error) == name]
        if name in SQUARENESS_NAMES:
            right = len(position) == 1 and bool(np.isnan(position).all())
        else:
            right = bool(np.isfinite(position).all() and np.all(np.diff(position) > 0))
        if not right:
            raise InputError(
                Message(
                    "covariance-positions",
                    "the positions of {name} are not those of one error in ascending order",
                    name=name,
                ),
                file=source,
            )
    return covariance
