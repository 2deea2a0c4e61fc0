"""The verdict on tables and on the measurement behind them: one state, one headline, and what speaks against it.

``reasons`` are about the tables, objections about the measurement: how well the model describes its readings, and how
much of the machine it shows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import ErrorTable
from compgen.core.machine import Machine
from compgen.core.names import ERROR_NAMES, MM_PER_UM, error_named
from compgen.core.text import um_text
from compgen.identify.covariance import Covariance, covariance_of_values, error_design
from compgen.identify.result import Identification
from compgen.model.gauge import rigid_fields
from compgen.model.observability import observable_errors
from compgen.model.volumetric import tool_of

State = Literal["accepted", "partial", "accepted_with_reservations", "better_after_new_setup", "not_accepted"]
#: From the best to the worst; where several apply the last one is the verdict.
STATES: tuple[State, ...] = (
    "accepted",
    "partial",
    "accepted_with_reservations",
    "better_after_new_setup",
    "not_accepted",
)
#: Residuals of the readings above this share of what the tables take away (rms) leave nothing to be sure of.
RESIDUAL_SHARE = 1.0 / 3.0
#: The error as it stands counts as worse from this growth of its rms on.
WORSE_FROM_UM = 0.01
#: Coverage factor of the expanded uncertainty.
COVERAGE = 2.0
#: Points at which the uncertainty over the volume is looked at, and numbers that may be held for it.
UNCERTAINTY_POINTS, MOST_NUMBERS = 1500, 20_000_000
#: Codes of the objections that `--allow-misfit` overrides.
MISFIT_CODES = ("residual_too_large", "step_between_runs", "step_between_blocks", "step_between_files", "step", "drift")


@dataclass(frozen=True)
class Objection:
    """What speaks against the measurement: ``code`` for programs, ``text`` for people.

    ``blocking`` ones leave the tables not accepted, the others lead to reservations.
    """

    code: str
    text: str
    blocking: bool = False

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of ``result.json``."""
        return {"code": self.code, "text": self.text, "blocking": self.blocking}


@dataclass(frozen=True)
class Coverage:
    """How many of the errors that the machine's chain shows are known.

    Parameters
    ----------
    observable : names of the errors that can be told apart on this machine with one tool.
    determined : those of them that the errors file holds.
    left_out : those that the machine file's ``errors`` leaves out of the model.
    """

    observable: tuple[str, ...]
    determined: tuple[str, ...]
    left_out: tuple[str, ...] = ()

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the observable errors that are not known."""
        return tuple(name for name in self.observable if name not in self.determined)

    @property
    def text(self) -> str:
        """Say what was measured, and what was not."""
        kinds = list(dict.fromkeys(_kind(name) for name in self.determined))
        only = f"{' and '.join(kinds)} only, " if 0 < len(kinds) <= 2 else ""
        return f"{only}{len(self.determined)} of {len(self.observable)} errors measured"

    def as_dict(self) -> dict[str, Any]:
        """Return the object ``measured`` of ``result.json``."""
        return {
            "determined": len(self.determined),
            "observable": len(self.observable),
            "text": self.text,
            "errors": list(self.determined),
            "missing": list(self.missing),
            "left_out_by_machine_file": list(self.left_out),
        }


def _kind(name: str) -> str:
    error = error_named(name)
    if error.kind == "linear":
        return "straightness" if error.is_straightness else "positioning"
    return "angles" if error.kind == "angular" else "squareness"


def coverage_of(machine: Machine, errors: ErrorTable) -> Coverage:
    """Return how many of the machine's observable errors a table of errors holds."""
    observable = observable_errors(machine)
    known = tuple(name for name in observable if name in errors.names)
    listed = machine.errors if isinstance(machine.errors, tuple) else ERROR_NAMES
    return Coverage(observable, known, tuple(name for name in observable if name not in listed))


# --- uncertainty ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FigureUncertainty:
    """What the uncertainty of the measurement adds to the figures after compensation: expanded, k = 2, um.

    The files hold what was identified; the machine differs from that by the uncertainty of the errors, which no
    verification of the files can show.
    """

    rms_um: float
    max_um: float
    rms_rigid_removed_um: float
    max_rigid_removed_um: float

    def as_dict(self) -> dict[str, float]:
        """Return the object ``after_uncertainty`` of ``result.json``."""
        return {
            "coverage_factor": COVERAGE,
            "U_rms_um": self.rms_um,
            "U_max_um": self.max_um,
            "U_rms_rigid_motion_removed_um": self.rms_rigid_removed_um,
            "U_max_rigid_motion_removed_um": self.max_rigid_removed_um,
        }


def figure_uncertainty(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, covariance: Covariance | None = None
) -> FigureUncertainty | None:
    """Return the uncertainty that the errors give the figures over points (n, 3); None where it is not known.

    Without a joint covariance the standard uncertainties of the values count, taken as independent.
    """
    known = covariance or _independent(machine, errors)
    if known is None:
        return None
    most = max(50, min(UNCERTAINTY_POINTS, MOST_NUMBERS // (3 * max(len(known.error), 1))))
    places = np.unique(np.linspace(0, len(position_mm) - 1, most).astype(int))
    chosen = position_mm[places]
    spread = error_design(machine, known, chosen) @ known.errors_factor
    flat = spread.reshape(3 * len(chosen), -1)
    rigid, _ = np.linalg.qr(rigid_fields((chosen + tool_of(machine, None) - chosen.mean(axis=0)) / 1000.0))
    rest = flat - rigid @ (rigid.T @ flat)
    rms, largest = _size_um(flat)
    rms_rest, largest_rest = _size_um(rest)
    return FigureUncertainty(rms, largest, rms_rest, largest_rest)


def _size_um(flat: FloatArray) -> tuple[float, float]:
    variance = np.einsum("ij,ij->i", flat, flat).reshape(-1, 3).sum(axis=1)
    scale = COVERAGE / MM_PER_UM
    return scale * float(np.sqrt(variance.mean())), scale * float(np.sqrt(variance.max()))


def _independent(machine: Machine, errors: ErrorTable) -> Covariance | None:
    u = np.concatenate(
        [
            np.array([errors.squareness[name][1]]) if name in errors.squareness else errors.curves[name].u
            for name in errors.names
        ]
        or [np.zeros(0)]
    )
    if not len(u) or not np.isfinite(u).all():
        return None
    return covariance_of_values(errors, np.diag(u), machine.name)


# --- the measurement -----------------------------------------------------------------------------------------------


def measurement_objections(
    result: Identification, taken_away_um: float | None, *, allow_misfit: bool = False
) -> tuple[Objection, ...]:
    """Say what speaks against a measurement.

    Parameters
    ----------
    result : what was identified.
    taken_away_um : rms of what the tables take out of the error over the volume; None for tables that are wrong.
    allow_misfit : whether a misfit that would leave the tables not accepted is a reservation only.
    """
    return tuple(
        replace(item, blocking=False) if allow_misfit and item.code in MISFIT_CODES else item
        for item in _objections(result, taken_away_um)
    )


def _objections(result: Identification, taken_away_um: float | None) -> Iterator[Objection]:
    for text in result.objections:
        yield Objection("contradiction", text, blocking=True)
    misfit = result.misfit
    if misfit is not None:
        for cause in misfit.causes:
            text = f"{cause.text} explains {100.0 * cause.share:.0f} % of the residuals of the readings"
            yield Objection(cause.code, text, blocking=True)
    if taken_away_um is not None and result.degrees_of_freedom > 0 and result.rms_um > RESIDUAL_SHARE * taken_away_um:
        text = (
            f"the residuals of the readings, {um_text(result.rms_um)} um rms, are more than a third of the "
            f"{um_text(taken_away_um)} um rms that the tables take away"
        )
        yield Objection("residual_too_large", text, blocking=True)
    if misfit is not None and misfit.beyond:
        yield Objection("misfit", misfit.text)


def blocking_reasons(objections: Sequence[Objection]) -> list[str]:
    """Return why objections leave the tables not accepted, with what to do."""
    hint = "; `volcomp diagnose` looks for what the model lacks, --allow-misfit accepts the tables nevertheless"
    return [item.text + (hint if item.code in MISFIT_CODES else "") for item in objections if item.blocking]


def taken_away_um(before_rms_um: float, after_rms_um: float) -> float:
    """Return the rms of what tables take out of a field of errors, from the rms before and after, um.

    What stays is what the tables do not reach, so both parts add up by their squares.
    """
    return float(np.sqrt(max(before_rms_um**2 - after_rms_um**2, 0.0)))


# --- the verdict ---------------------------------------------------------------------------------------------------


def worst(states: Sequence[State]) -> State:
    """Return the worst of some states; "accepted" for none."""
    return max(states, key=STATES.index, default="accepted")
