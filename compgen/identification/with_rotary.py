"""A machine with rotary axes from files of any kinds: readings at poses, runs of rotary axes, measurements of the linear ones.

The linear axes are identified first, with the prior for what is not measured; then everything that was read at poses is
adjusted with that: the result is that of one adjustment, since normal knowledge adds up in any order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, format_errors
from compgen.data.machine import Machine
from compgen.data.pose_readings import (
    Bars,
    PosedDeviations,
    PosedLengths,
    read_bars,
    read_posed_deviations,
    read_posed_lengths,
    rotary_kind,
)
from compgen.data.rotary import (
    RotaryErrors,
    RotaryRuns,
    SphereCentres,
    format_machine_errors,
    read_rotary_runs,
    read_spheres,
)
from compgen.errors import InputError, Message
from compgen.identification import covariance
from compgen.identification.posterior import posterior_of_values
from compgen.identification.result import Identification, without_adjustment
from compgen.identification.rotary_linear import updated
from compgen.identification.rotary_runs import RotaryPositioning, identify_rotary_runs
from compgen.identification.spheres import SphereIdentification, identify_at_poses

if TYPE_CHECKING:
    from compgen.identification.options import IdentifyOptions

#: Files with the errors of the linear axes alone, for commands that know no rotary ones.
LINEAR_FILE, LINEAR_COVARIANCE = "linear.errors.csv", "linear.covariance.npz"
AtPoses = SphereCentres | Bars | PosedDeviations | PosedLengths


@dataclass(frozen=True)
class RotaryFiles:
    """Readings of rotary axes: runs, and readings at poses, spheres first; ``others`` are the files of the linear axes."""

    runs: RotaryRuns | None
    at_poses: tuple[AtPoses, ...]
    others: tuple[Path, ...]


def read_rotary_files(machine: Machine, paths: Sequence[Path]) -> RotaryFiles:
    """Read the files that say something of rotary axes; the others are left to those who read them."""
    kinds = {path: rotary_kind(path) for path in paths}

    def of(kind: str | None) -> list[Path]:
        return [path for path in paths if kinds[path] == kind]

    readers: tuple[tuple[str, Callable[[Machine, list[Path]], AtPoses]], ...] = (
        ("sphere", read_spheres),
        ("bar", read_bars),
        ("deviations", read_posed_deviations),
        ("lengths", read_posed_lengths),
    )
    runs = read_rotary_runs(machine, of("runs")) if of("runs") else None
    at_poses = tuple(read(machine, of(kind)) for kind, read in readers if of(kind))
    return RotaryFiles(runs, at_poses, tuple(of(None)))


@dataclass(frozen=True)
class RotaryResult:
    """What was found of a machine with rotary axes.

    Parameters
    ----------
    placed : from readings at poses; ``turned``: from runs of rotary axes.
    linear : the errors of the linear axes, with what the poses add; None if nothing was read of them.
    factor : of the joint covariance: rows of the linear values, then of the constants of ``placed``; None without ``linear``.
    """

    machine: Machine
    placed: SphereIdentification | None
    turned: RotaryPositioning | None
    linear: Identification | None = None
    factor: FloatArray | None = None

    @property
    def errors(self) -> RotaryErrors:
        """The errors of the rotary axes."""
        own = RotaryErrors() if self.placed is None else self.placed.errors
        runs = RotaryErrors() if self.turned is None else self.turned.errors
        return RotaryErrors({**own.curves, **runs.curves}, own.constants, runs.reversal)

    def summary(self) -> dict[str, Any]:
        """Contents of ``identify.json`` on the rotary axes; with linear axes theirs, too."""
        turned = {} if self.turned is None else self.turned.summary()
        own: dict[str, Any] = turned if self.placed is None else self.placed.summary()
        if self.placed is not None and turned:
            own["rotary_axis"] = turned
        if self.linear is None:
            return own
        linear = self.linear.summary()
        notes = [*self.linear.notes, *own.get("notes", ())]
        return {**linear, **own, "notes": notes}

    def files(self) -> dict[str, str | bytes]:
        """The errors files with their covariances."""
        said: list[str] = [] if self.placed is None else [_WORDS[kind] for kind in self.placed.kinds]
        if self.turned is not None:
            said.append("positioning runs of rotary axes")
        source = ", ".join(said)
        metadata = {"machine": self.machine.name, "source": source}
        if self.linear is None:
            return {"identified.errors.csv": format_machine_errors(ErrorTable(), self.errors, metadata)}
        joint = covariance.joint_covariance(self.linear)
        alone = format_errors(self.linear.errors, {"covariance": LINEAR_COVARIANCE})
        found: dict[str, str | bytes] = {
            LINEAR_FILE: alone,
            LINEAR_COVARIANCE: covariance.format_covariance(joint, alone),
        }
        if self.placed is None or self.factor is None:
            text = format_machine_errors(self.linear.errors, self.errors, metadata)
            return {**found, "identified.errors.csv": text}
        kept = {**self.linear.errors.metadata, **metadata, "covariance": covariance.FILE_NAME}
        text = format_machine_errors(self.linear.errors, self.errors, kept)
        first = len(joint.error)
        whole = replace(joint, station=(), factor=self.factor[:first], rotary=(self.placed.names, self.factor[first:]))
        return {**found, "identified.errors.csv": text, covariance.FILE_NAME: covariance.format_covariance(whole, text)}


_WORDS = {
    "spheres": "sphere centres",
    "bars": "bars between balls",
    "positions": "positions with turned axes",
    "lengths": "lengths with turned axes",
}


def identify_rotary(
    machine: Machine, files: RotaryFiles, options: IdentifyOptions, linear: Identification | None = None
) -> RotaryResult:
    """Identify the rotary axes from everything that was read of them, together with the linear ones.

    Parameters
    ----------
    linear : the identification of the linear axes from the other files; None if there are none.
    """
    turned = None if files.runs is None else identify_rotary_runs(machine, files.runs)
    if not files.at_poses:
        return RotaryResult(machine, None, turned, linear)
    if linear is None and any(isinstance(item, PosedDeviations | PosedLengths) for item in files.at_poses):
        linear = _unmeasured(machine)
    known = RotaryErrors() if turned is None else turned.errors
    before = None if linear is None else linear.posterior
    if linear is not None and before is None:
        raise InputError(
            Message(
                "joint-without-prior",
                "linear and rotary axes are adjusted together with what is assumed of errors that "
                "were not measured, and the class 'none' assumes nothing; state a class, or identify "
                "them separately",
            ),
            field="--prior",
        )
    placed = identify_at_poses(machine, files.at_poses, u_um=options.u_deviation_um, known=known, linear=before)
    if linear is None or placed.linear is None:
        return RotaryResult(machine, placed, turned)
    k, root = len(placed.names), placed.linear.root
    after, factor = updated(machine, linear, placed.linear.state, placed.linear.unknown, root[k:])
    own = np.zeros((k, factor.shape[1]))
    own[:, : root.shape[1]] = root[:k]
    return RotaryResult(machine, placed, turned, after, np.vstack([factor, own]))


def _unmeasured(machine: Machine) -> Identification | None:
    """Linear axes of which nothing was measured but at poses: their prior; None without one."""
    if machine.prior.is_none:
        return None
    prior = posterior_of_values(machine, (), np.zeros(0), np.zeros(0), np.zeros((0, 0)))
    plain = without_adjustment(machine, ErrorTable({}, {}, {}), np.zeros(1), "stated", "no reading shows it")
    nothing = np.zeros(0)
    return replace(
        plain,
        residual_mm=nothing,
        accepted=nothing.astype(bool),
        method="poses",
        posterior_source=lambda: prior,
        details={"posterior_means": []},
    )
