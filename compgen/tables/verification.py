"""The round trip: read the written text back, emulate the control, and state the verdict on tables and measurement."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import erf, nan, sqrt
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from compgen.controls import AnyController, SourceFile, controller_named
from compgen.controls.shared.base import Monomial, Term
from compgen.data.arguments import of_kind, paths_of, text_of
from compgen.data.comparison import Difference, Residuals, residuals_twice, rms, small_motion
from compgen.data.csv_files import FloatArray, format_csv
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.files import check_lines, read_bytes, sha256_of
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.data.names import AXES, COVERAGE, ERROR_NAMES, MM_PER_UM, error_named
from compgen.drawing.display import Displayed, Drawable, Overview, Panel, PlottedLine, Tabular, package, shortened
from compgen.errors import CompgenWarning, InputError, one_line, um_text
from compgen.identification.covariance import Covariance, covariance_or_independent, error_design, posterior_with
from compgen.identification.posterior import Posterior, assumed_text, not_determined_um, not_measured, worse_text
from compgen.identification.result import Identification
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.first_order import coefficients, observable_errors, tool_of
from compgen.kinematics.many_points import blocks, volumetric_error
from compgen.tables.entries import EntryCheck, entry_check
from compgen.tables.judge import (
    Judge,
    Safety,
    SafetyLimits,
    in_both_directions,
    judge_of,
    left_by_reversal,
    mean_correction,
    residuals_before,
    reversal_reasons,
    safety_of,
)
from compgen.tables.synthesis import Projector, error_at, kept, placed_terms, wanted_correction

# The verdict on tables and on the measurement behind them: one state, one headline, and the objections.
#
# ``reasons`` are about the tables, objections about the measurement: how well the model describes its readings, and how
# much of the machine it covers.


State = Literal["accepted", "partial", "accepted_with_reservations", "better_after_new_setup", "not_accepted"]
#: From best to worst; if several apply, the last one is the verdict.
STATES: tuple[State, ...] = (
    "accepted",
    "partial",
    "accepted_with_reservations",
    "better_after_new_setup",
    "not_accepted",
)
#: With residuals of the readings above this share of what the tables correct (rms), nothing is certain.
RESIDUAL_SHARE = 1.0 / 3.0
#: The error with the reference point fixed counts as worse if its rms grows by this much.
WORSE_FROM_UM = 0.01
#: Points at which the uncertainty over the volume is evaluated, and numbers kept in memory for it.
UNCERTAINTY_POINTS, MOST_NUMBERS = 1500, 20_000_000
#: Verdicts on accepted tables in words.
VERDICT_WORDS = {
    "accepted": "accepted",
    "partial": "partial",
    "accepted_with_reservations": "accepted with reservations",
    "better_after_new_setup": "better only after the workpiece is set up again",
}
#: Codes of what is said against tables because too little was measured.
DOUBT_CODES = ("doubtful", "bounds_overlap", "worse_eighth", "short_span")
#: Codes of the objections that `--allow-misfit` overrides.
MISFIT_CODES = ("residual_too_large", "step_between_runs", "step_between_blocks", "step_between_files", "step", "drift")


@dataclass(frozen=True)
class Objection:
    """An objection to the measurement: ``code`` for programs, ``text`` for people.

    With a ``blocking`` one the tables are not accepted; the others are reservations.
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
    observable : names of the errors that can be distinguished on this machine with one tool.
    determined : those of them in the errors file, known to a third of what is assumed without a measurement.
    left_out : those that ``errors`` in the machine file excludes from the model.
    partly : those in the errors file of which more than a third of what was assumed is still unknown.
    """

    observable: tuple[str, ...]
    determined: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    partly: tuple[str, ...] = ()

    @property
    def missing(self) -> tuple[str, ...]:
        """Names of the observable errors that are unknown."""
        return tuple(name for name in self.observable if name not in self.determined)

    @property
    def text(self) -> str:
        """Return in words what was measured."""
        kinds = list(dict.fromkeys(_kind(name) for name in self.determined))
        known, observable = len(self.determined), len(self.observable)
        if len(kinds) in (1, 2):
            text = f"{' and '.join(kinds)} only, {known} of {observable} errors measured"
        else:
            text = f"{known} of {observable} errors measured"
        return text + (f", {len(self.partly)} more in part" if self.partly else "")

    def as_dict(self) -> dict[str, Any]:
        """Return the object ``measured`` of ``result.json``."""
        return {
            "determined": len(self.determined),
            "observable": len(self.observable),
            "text": self.text,
            "errors": list(self.determined),
            "missing": list(self.missing),
            "in_part": list(self.partly),
            "left_out_by_machine_file": list(self.left_out),
        }


def _kind(name: str) -> str:
    error = error_named(name)
    if error.kind == "linear":
        return "straightness" if error.is_straightness else "positioning"
    return "angles" if error.kind == "angular" else "squareness"


def coverage_of(machine: Machine, errors: ErrorTable, posterior: Posterior | None = None) -> Coverage:
    """Return how many of the machine's observable errors an error table contains, and the posterior counts as determined."""
    observable = observable_errors(machine)
    enough = errors.names if posterior is None else posterior.determined
    known = tuple(name for name in observable if name in errors.names and name in enough)
    listed = machine.errors if isinstance(machine.errors, tuple) else ERROR_NAMES
    partly = tuple(name for name in observable if name in errors.names and name not in known)
    return Coverage(observable, known, tuple(name for name in observable if name not in listed), partly)


# --- uncertainty ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FigureUncertainty:
    """What the uncertainty of the measurement adds to the figures after compensation: expanded, k = 2, um.

    The files contain what was identified; the machine differs from that by the uncertainty of the errors, which no
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


#: Points of the volume over which the joint draws are made, and how many draws.
DRAWN_POINTS, DRAWS = 400, 400
#: Seed of the draws: the same tables have the same verdict.
DRAW_SEED = 20_261_123
#: The probability of a smaller error from which tables are accepted, and from which they are accepted as doubtful.
PROBABLE, DOUBTFUL = 0.975, 0.8
#: An eighth of the volume counts as worse if its error grows by this share and this much, um, with this probability.
WORSE_SHARE, WORSE_UM, WORSE_PROBABILITY = 0.1, 0.5, 0.05
#: Share of the travel that the readings of an axis with tables must span.
SPANNED = 0.8
#: Errors that are not known, of which more are counted only.
NAMED = 3


@dataclass(frozen=True)
class ProbableGain:
    """How the machine will be with and without tables, as far as readings and prior tell: from joint draws of its errors.

    Parameters
    ----------
    probability_as_it_stands, probability_rigid_removed : that the error (rms over the volume) is smaller with the tables,
        with the reference point fixed, and with the best-fit rigid motion removed.
    before_um, after_um : rms of the error over the volume: median, and limits that it is below and above with 97.5 %.
    worse_eighths : eighths of the volume, by their place, that probably get worse.
    short_axes : axes with tables of which the readings span too little, with the share of the travel.
    assumed, machine_worse : what was assumed of errors that no reading determines; in words.
    prior, not_measured : the sizes assumed, and the errors that are not listed, with what is assumed of them.
    before_rigid_um, after_rigid_um : as ``before_um`` and ``after_um``, with the best-fit rigid motion removed.
    open_um : what is not known of the errors that are not determined: rms over the volume, um, the largest first.
    """

    probability_as_it_stands: float
    probability_rigid_removed: float
    before_um: tuple[float, float, float]
    after_um: tuple[float, float, float]
    worse_eighths: tuple[str, ...]
    short_axes: tuple[tuple[str, float], ...]
    assumed: str
    machine_worse: str = ""
    prior: Mapping[str, Any] = field(default_factory=dict)
    not_measured: Mapping[str, Any] = field(default_factory=dict)
    before_rigid_um: tuple[float, float, float] = (nan, nan, nan)
    after_rigid_um: tuple[float, float, float] = (nan, nan, nan)
    open_um: Mapping[str, float] = field(default_factory=dict)

    @property
    def probability_better(self) -> float:
        """Probability that the machine gets better, the smaller of both frames."""
        return min(self.probability_as_it_stands, self.probability_rigid_removed)

    @property
    def only_after_new_setup(self) -> bool:
        """Whether the machine gets better for sure only if the workpiece is set up again."""
        return self.probability_as_it_stands < PROBABLE <= self.probability_rigid_removed

    @property
    def reservations(self) -> Iterator[Objection]:
        """Why tables that probably make the machine better are accepted with reservations only."""
        p = self.probability_better
        if p < PROBABLE and not self.only_after_new_setup:
            text = (
                f"whether the machine gets better is doubtful (probability {100.0 * p:.0f} %): too little was measured"
            )
            yield Objection("doubtful", text)
        elif self.after_um[2] >= self.before_um[1]:
            _, low, _, _, most = self.rounded
            text = (
                f"the error may be {most} um rms after and {low} before (97.5 % limits): what was not measured is as large as "
                "what the tables correct"
            )
            yield Objection("bounds_overlap", text)
        if self.worse_eighths:
            places = "; ".join(self.worse_eighths[:3]) + (" and more" if len(self.worse_eighths) > 3 else "")
            yield Objection("worse_eighth", f"a part of the volume probably gets worse: {places}")
        if self.short_axes:
            parts = ", ".join(f"{axis} {100.0 * share:.0f} %" for axis, share in self.short_axes)
            text = f"the readings span too little of the travel of axes with tables ({parts}; {100.0 * SPANNED:.0f} % needed)"
            yield Objection("short_span", text)

    @property
    def reason(self) -> str:
        """Why the tables are not accepted; empty if they probably make the machine better."""
        p = self.probability_better
        if p >= DOUBTFUL or self.only_after_new_setup:
            return ""
        return (
            f"the machine probably does not get better (probability {100.0 * p:.0f} %, {100.0 * DOUBTFUL:.0f} % needed): "
            f"{self.text}; measure more of it"
        )

    @property
    def text(self) -> str:
        """Before and after with their limits, in one clause."""
        before, low, high, after, most = self.rounded
        return f"before {before} um rms ({low} to {high} um), after {after} um, at most {most} um"

    @property
    def rounded(self) -> tuple[str, str, str, str, str]:
        """Before, its limits, after and its upper limit, um rms, as far as they are known."""
        return rounded_limits(self.before_um, self.after_um)

    @property
    def rounded_rigid(self) -> tuple[str, str, str, str, str]:
        """The same with the best-fit rigid motion removed."""
        return rounded_limits(self.before_rigid_um, self.after_rigid_um)

    @property
    def open_text(self) -> str:
        """What is not known, the most expensive first; empty if every error is determined."""
        return open_text(self.open_um)

    def as_dict(self) -> dict[str, Any]:
        """Return the object ``probable`` of ``result.json``."""
        return {
            "probability_as_it_stands": self.probability_as_it_stands,
            "probability_rigid_motion_removed": self.probability_rigid_removed,
            "before_rms_um": dict(zip(("median", "low", "high"), self.before_um, strict=True)),
            "after_rms_um": dict(zip(("median", "low", "high"), self.after_um, strict=True)),
            "before_rms_rigid_motion_removed_um": dict(
                zip(("median", "low", "high"), self.before_rigid_um, strict=True)
            ),
            "after_rms_rigid_motion_removed_um": dict(zip(("median", "low", "high"), self.after_rigid_um, strict=True)),
            "not_determined_rms_um": dict(self.open_um),
            "worse_eighths": list(self.worse_eighths),
            "short_axes": dict(self.short_axes),
            "assumed": self.assumed,
            "machine_worse_than_class": self.machine_worse or None,
        }


def open_text(open_um: Mapping[str, float]) -> str:
    """Return what is not known of a machine, the most expensive first; empty if every error is determined."""
    if not open_um:
        return ""
    named = ", ".join(f"{name} {um_text(value)} um" for name, value in list(open_um.items())[:NAMED])
    if len(open_um) > NAMED:
        named = f"{named} and {len(open_um) - NAMED} more"
    return f"not known: {named} (u, rms over the volume)"


def rounded_limits(
    before: tuple[float, float, float], after: tuple[float, float, float]
) -> tuple[str, str, str, str, str]:
    """Median and limits of before, median and upper limit of after: as many digits as the width of each says something."""
    of_before, of_after = before[2] - before[1], after[2] - after[1]
    one, low, high = (um_text(value, u_um=of_before) for value in before)
    return one, low, high, um_text(after[0], u_um=of_after), um_text(after[2], u_um=of_after)


#: Points of a calculation that depends on none.
_NO_POINTS = np.zeros((0, 3))


@kept
def _known(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, covariance: Covariance | None = None
) -> Posterior | None:
    """:func:`posterior_with`, once for all controls."""
    return posterior_with(machine, errors, covariance)


def _some(position_mm: FloatArray, most: int) -> NDArray[np.int64]:
    """Up to ``most`` of the points (n, 3); by chance, because every k-th point of a grid may lie on a few planes."""
    if len(position_mm) <= most:
        return np.arange(len(position_mm))
    return np.sort(np.random.default_rng(DRAW_SEED).choice(len(position_mm), most, replace=False))


@kept
def figure_uncertainty(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, covariance: Covariance | None = None
) -> FigureUncertainty | None:
    """Return the uncertainty of the figures over points (n, 3) due to all errors of the machine; None if it is unknown.

    With a prior it includes errors that nobody measured, and what the curves do between the readings and beyond them.
    Without one it is that of the errors of the table; their values are independent where there is no joint covariance.
    """
    known = covariance_or_independent(errors, covariance, machine.name)
    if known is None:
        return None
    posterior = _known(machine, errors, _NO_POINTS, covariance)
    if posterior is not None:
        return _posterior_uncertainty(machine, posterior, position_mm)
    most = max(50, min(UNCERTAINTY_POINTS, MOST_NUMBERS // (3 * max(len(known.error), 1))))
    chosen = position_mm[_some(position_mm, most)]
    design, factor = error_design(machine, known, chosen), known.errors_factor
    spread = np.empty((len(chosen), 3, factor.shape[1]))
    for output in range(3):  # most errors move one axis
        used = design[:, output].any(axis=0)
        spread[:, output] = design[:, output, used] @ factor[used]
    flat = spread.reshape(3 * len(chosen), -1)
    found: list[float] = []
    for factor in (flat, small_motion(chosen + tool_of(machine, None)).taken_out(flat)):
        u_um = Difference(np.zeros(len(flat)), factor).u_size / MM_PER_UM
        found += [COVERAGE * rms(u_um), COVERAGE * float(u_um.max())]
    return FigureUncertainty(*found)


def known_errors(machine: Machine, errors: ErrorTable, covariance: Covariance | None = None) -> Posterior | None:
    """:func:`posterior_with`, kept for all controls of a run."""
    return _known(machine, errors, _NO_POINTS, covariance)


#: What is said where nothing is assumed of what was not measured.
WITHOUT_PRIOR = "no prior: what was not measured is not determined, and no uncertainty has it in"


def volume_uncertainty(
    machine: Machine, errors: ErrorTable, position_mm: FloatArray, covariance: Covariance | None = None
) -> FigureUncertainty | None:
    """:func:`figure_uncertainty` of the whole error of the machine: None without a prior if errors were not measured."""
    if machine.prior.is_none and coverage_of(machine, errors).missing:
        return None
    return figure_uncertainty(machine, errors, position_mm, covariance)


def assumed_lines(machine: Machine, errors: ErrorTable, covariance: Covariance | None = None) -> tuple[str, ...]:
    """Return what is assumed of what was not measured, what is not known, and whether the machine is worse than its class."""
    posterior = known_errors(machine, errors, covariance)
    if posterior is None:
        return (WITHOUT_PRIOR,) if machine.prior.is_none else ("the uncertainty of the errors is not known",)
    said = assumed_text(posterior), open_text(not_determined_um(posterior)), worse_text(posterior)
    return tuple(text for text in said if text)


def _posterior_uncertainty(machine: Machine, posterior: Posterior, position_mm: FloatArray) -> FigureUncertainty:
    """Expanded uncertainty of the figures from the posterior; a rigid motion takes nothing from what is between levels."""
    chosen = position_mm[_some(position_mm, DRAWN_POINTS)]
    spread = posterior.field(chosen)
    flat = spread.factor.reshape(3 * len(chosen), -1)
    left = small_motion(chosen + tool_of(machine, None)).taken_out(flat).reshape(spread.factor.shape)
    found: list[float] = []
    for part in (spread, replace(spread, factor=left)):
        u_um = np.sqrt(part.variance.sum(axis=1)) / MM_PER_UM
        found += [COVERAGE * rms(u_um), COVERAGE * float(u_um.max())]
    return FigureUncertainty(*found)


def probable_gain(
    machine: Machine,
    errors: ErrorTable,
    posterior: Posterior,
    position_mm: FloatArray,
    before_mm: FloatArray,
    after_mm: FloatArray,
    rms_um: Sequence[float] = (),
) -> ProbableGain:
    """Return how the errors of a machine with and without tables compare, over joint draws of its posterior.

    Parameters
    ----------
    errors : those that were identified; the tables compensate them.
    posterior : of all errors of the machine.
    position_mm : n points over the volume (n, 3), with the errors of the tool tip that the identified errors cause there
        without and with the tables, ``before_mm`` and ``after_mm`` (n, 3).
    rms_um : of these over all points, before and after, then both with the best-fit rigid motion removed: the draws are
        made at some of the points only.
    """
    some = _some(position_mm, DRAWN_POINTS)
    at_mm = position_mm[some]
    draws = posterior.field(at_mm).draws(DRAWS, DRAW_SEED) + posterior.mean_beyond(errors, at_mm)
    before, after = before_mm[some] + draws, after_mm[some] + draws
    # the squares of both differ by a linear function of the errors, so the probability follows from mean and variance
    motion = small_motion(at_mm + tool_of(machine, None))
    frames: list[float] = []
    sizes: list[tuple[float, float, float]] = []
    for remove in (False, True):
        one, two = before.reshape(DRAWS, -1), after.reshape(DRAWS, -1)
        if remove:
            one, two = motion.taken_out(one.T).T, motion.taken_out(two.T).T
        for drawn, own in ((one, before_mm[some]), (two, after_mm[some])):
            left = own.reshape(1, -1)
            left = motion.taken_out(left.T).T if remove else left
            beside = rms_um[len(sizes)] ** 2 - _squares_um(left)[0] if rms_um else 0.0
            sizes.append(_limits_um(_squares_um(drawn) + beside))
        gain = np.sum(one**2, axis=1) - np.sum(two**2, axis=1)
        spread = float(gain.std())
        frames.append(
            0.5 * (1.0 + erf(float(gain.mean()) / (spread * sqrt(2.0)))) if spread > 0 else float(gain.mean() > 0)
        )

    return ProbableGain(
        frames[0],
        frames[1],
        sizes[0],
        sizes[1],
        tuple(_worse_eighths(machine, at_mm, before, after)),
        tuple(_short_axes(machine, errors, posterior)),
        assumed_text(posterior),
        worse_text(posterior),
        posterior.prior.as_dict(),
        not_measured(posterior, errors.names),
        sizes[2],
        sizes[3],
        not_determined_um(posterior),
    )


def _squares_um(errors_mm: FloatArray) -> FloatArray:
    """Mean squares over the points of errors (draws, 3 n), um^2."""
    return np.asarray(3.0 * np.mean(errors_mm**2, axis=1) / MM_PER_UM**2)


def _limits_um(squares_um: FloatArray) -> tuple[float, float, float]:
    """Median and limits (97.5 % each) of the rms of draws, um, from their mean squares."""
    each = np.sqrt(np.maximum(squares_um, 0.0))
    low, median, high = np.quantile(each, [0.025, 0.5, 0.975]).tolist()
    return median, low, high


def _worse_eighths(machine: Machine, at_mm: FloatArray, before_mm: FloatArray, after_mm: FloatArray) -> Iterator[str]:
    """Name the eighths of the volume whose error grows by more than a tenth with more than 5 % probability."""
    middle = 0.5 * (machine.lower_mm + machine.upper_mm)
    for corner in product((False, True), repeat=3):
        rows = ((at_mm > middle) == np.array(corner)).all(axis=1)
        if not rows.any():
            continue
        one, two = (
            np.sqrt(np.mean(np.sum(part[:, rows] ** 2, axis=2), axis=1)) / MM_PER_UM for part in (before_mm, after_mm)
        )
        share = float(np.mean(two > (1.0 + WORSE_SHARE) * one + WORSE_UM))
        if share > WORSE_PROBABILITY:
            place = ", ".join(
                f"{axis} {'above' if high else 'below'} {at:g}"
                for axis, high, at in zip(AXES, corner, middle, strict=True)
            )
            yield f"{place} mm ({100.0 * share:.0f} %)"


def _short_axes(machine: Machine, errors: ErrorTable, posterior: Posterior) -> Iterator[tuple[str, float]]:
    """Axes with curves of whose travel the readings span too little, with the share."""
    for axis in sorted({error_named(name).axis for name in errors.curves}):
        low, high = posterior.spans_mm[axis].tolist()
        share = (high - low) / machine.axes[axis].length_mm if high >= low else 1.0
        if share < SPANNED:
            yield AXES[axis], share


# --- the measurement -----------------------------------------------------------------------------------------------


def measurement_objections(
    result: Identification, taken_away_um: float | None, *, allow_misfit: bool = False
) -> tuple[Objection, ...]:
    """Return the objections to a measurement.

    Parameters
    ----------
    result : what was identified.
    taken_away_um : rms of what the tables correct of the error over the volume; None for wrong tables.
    allow_misfit : whether a misfit that would block the tables is only a reservation.
    """
    return tuple(
        replace(item, blocking=False) if allow_misfit and item.code in MISFIT_CODES else item
        for item in _objections(result, taken_away_um)
    )


def _objections(result: Identification, taken_away_um: float | None) -> Iterator[Objection]:
    for text in result.objections:
        yield Objection("contradiction", text, blocking=True)
    for text in result.doubts:
        yield Objection("disagreement", text)
    misfit = result.misfit
    if misfit is not None:
        for cause in misfit.causes:
            text = f"{cause.text} explains {100.0 * cause.share:.0f} % of the residuals of the readings"
            yield Objection(cause.code, text, blocking=True)
    if taken_away_um is not None and result.degrees_of_freedom > 0 and result.rms_um > RESIDUAL_SHARE * taken_away_um:
        text = (
            f"the residuals of the readings, {um_text(result.rms_um)} um rms, are more than a third of the "
            f"{um_text(taken_away_um)} um rms that the tables correct"
        )
        yield Objection("residual_too_large", text, blocking=True)
    if misfit is not None and misfit.beyond:
        yield Objection("misfit", misfit.text)


def blocking_reasons(objections: Sequence[Objection]) -> list[str]:
    """Return why objections block the tables, and what to do."""
    hint = "; `volcomp diagnose` searches for the missing effect, --allow-misfit accepts the tables nevertheless"
    return [item.text + (hint if item.code in MISFIT_CODES else "") for item in objections if item.blocking]


def taken_away_um(before_rms_um: float, after_rms_um: float) -> float:
    """Return the rms of what tables correct in a field of errors, from the rms before and after, um.

    What remains is independent of the tables, so the squares of both parts add up.
    """
    return float(np.sqrt(max(before_rms_um**2 - after_rms_um**2, 0.0)))


# --- the verdict ---------------------------------------------------------------------------------------------------


def worst(states: Sequence[State]) -> State:
    """Return the worst of some states; "accepted" for none."""
    return max(states, key=STATES.index, default="accepted")


# The round trip: parse the written text, emulate the control, and move the exact machine with it.


#: Errors of which less than this remains uncorrected are not listed.
NAMED_FROM_MM = 0.1 * MM_PER_UM

#: Largest controller file that is read; the largest tables of the controls have about 200 000 rows.
MOST_BYTES, MOST_LINES = 20_000_000, 250_000

#: Share of an error by which table values may miss it and still contain it exactly, but for rounding.
IN_TABLES = 1e-9
#: A smaller correction counts as none; 1e-9 mm is far below what any control resolves.
ZERO_MM = 1e-9
#: Points that are tried at a time for a correction that is not zero.
FEW_POINTS = 512
#: A constant of the tables is said where it exceeds this share of the error without rigid motion, and where the share of the
#: error that is left grows by so much without it.
SHIFT_SHARE, SHIFT_GAIN = 0.25, 0.03
#: A control that cannot express more than this share of the largest error gives a partial compensation.
PARTIAL_SHARE = 0.1


@dataclass(frozen=True, repr=False)
class ReadTables(Displayed):
    """Controller tables as parsed from text, with their control.

    ``files`` are names and SHA-256; ``contradictions`` list where a plan next to the tables has other numbers;
    ``remarks`` list what reading assumed, ignored and kept apart.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> leaning = compgen.ErrorTable(squareness={"EC0Y": (30e-6, 1e-6)})  # dX = -Y EC0Y: +15 um at Y = -500
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = compgen.export(machine, leaning, "isg-csv").write(folder)
    ...     tables: compgen.ReadTables = compgen.read_tables(machine, paths, "isg-csv")
    >>> added = tables.correction(machine, compgen.Points(np.array([[-400.0, -500.0, -100.0]])))
    >>> (1e3 * added).round(3).tolist()  # the control adds minus the error
    [[-15.0, 0.0, 0.0]]
    """

    controller: AnyController
    tables: Any
    files: tuple[tuple[str, str], ...]
    contradictions: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def correction(self, machine: Machine, points: Points) -> FloatArray:
        """Return what the control adds to the command at each point, shape (n, 3), mm."""
        return np.asarray(self.controller.emulate(self.tables, points))

    def mean_correction(
        self, machine: Machine, position_mm: FloatArray, tool_mm: FloatArray | None = None
    ) -> FloatArray:
        """Return what the control adds at positions (n, 3), the mean of both directions of travel, shape (n, 3), mm.

        ``tool_mm`` are the tool offsets (n, 3), None for that of the machine file.
        """
        if not self.controller.by_direction(self.tables):
            return self.correction(machine, Points(position_mm, tool_mm)) - self.anchor_offset_mm(machine)

        def added(points: Points) -> FloatArray:
            return self.correction(machine, points)

        return mean_correction(added, position_mm, tool_mm) - self.anchor_offset_mm(machine)

    def anchor_offset_mm(self, machine: Machine) -> FloatArray:
        """Return the mean of both directions at the zero point of an anchored control's tables, shape (3,), mm.

        They are zero there in one direction only; the difference is a constant, which is harmless.
        """
        if not (self.controller.bidirectional and self.controller.anchored):
            return np.zeros(3)
        anchor_mm = self.controller.anchor_mm()[None]
        return np.asarray(mean_correction(lambda points: self.correction(machine, points), anchor_mm)[0])

    def overview(self) -> Overview:
        """The control and the files."""
        names = tuple(name for name, _ in self.files)
        return Overview(f"{self.controller.name}: {shortened(names)}", notes=(*self.contradictions, *self.remarks))


def read_tables(
    machine: Machine, paths: Sequence[str | Path] | str | Path, controller: str, *, foreign: bool = False
) -> ReadTables:
    """Parse controller files.

    Parameters
    ----------
    machine : its ``[controllers.<name>]`` settings define how the control reads them.
    paths : the files, or the folder of an export, whose manifest lists them.
    controller : name of the control.
    foreign : read archives and files of other programs, too, with remarks on what was ignored. Files that this program
        wrote are still read strictly.

    Raises
    ------
    InputError
        with file and line for whatever is malformed.

    Examples
    --------
    >>> import tempfile
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = compgen.export(machine, errors, "isg-csv").write(folder)
    ...     tables = compgen.read_tables(machine, paths, "isg-csv")
    >>> tables
    <ReadTables: isg-csv: volcomp0.csv, volcomp0.lis>
    """
    of_kind("machine", machine, Machine)
    text_of("controller", controller)
    control = controller_named(controller)(machine)
    files = table_files(paths_of("paths", paths), controller)
    if not files:
        raise InputError("no table file was given")
    contents = []
    for path in files:
        content = read_bytes(path, MOST_BYTES + 1)
        lines = content.count(b"\n")
        if len(content) > MOST_BYTES or lines > MOST_LINES:  # too large for a table
            if not foreign:
                _decode(path, content)
            what = f"{MOST_LINES} lines" if lines > MOST_LINES else f"{MOST_BYTES // 1_000_000} MB"
            message = f"is longer than {what}, too long for a controller table"
            raise InputError(message, file=path, line=min(lines, MOST_LINES) + 1)
        contents.append((path, content))
    return _parsed(control, contents, foreign=foreign)


def parse_tables(machine: Machine, contents: Mapping[str, bytes], controller: str) -> ReadTables:
    """Parse the contents of controller files by their names as strictly as :func:`read_tables` does."""
    named = [(Path(name), content) for name, content in contents.items()]
    return _parsed(controller_named(controller)(machine), named, foreign=False)


def _parsed(control: AnyController, contents: Sequence[tuple[Path, bytes]], *, foreign: bool) -> ReadTables:
    hashes = tuple((path.name, sha256_of(content)) for path, content in contents)
    for path, content in contents:
        if content.lstrip()[:1] != b"{":  # JSON may be on one line
            check_lines(content.decode("latin-1"), path)
    try:
        sources = [SourceFile(path, _decode(path, content)) for path, content in contents]
        tables = control.parse(sources)
    except InputError:
        # Files of this program are read strictly. In others, comments may contain any character in any encoding.
        if not foreign or any(_OWN_FILE.search(content[:4000]) for _, content in contents):
            raise
        sources = []
        for path, content in contents:
            try:
                utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
                text = content.decode("utf-16", "replace") if utf16 else content.decode("utf-8-sig")
            except UnicodeDecodeError:
                text = content.decode("latin-1")
            sources.append(SourceFile(path, text))
        other = control.parse_foreign(sources)
        if other is None and all(source.text.isascii() for source in sources):
            raise
        if other is None:  # a control without a reader of other files: everything but the comments is read strictly
            plain = [SourceFile(source.path, source.text.encode("ascii", "replace").decode()) for source in sources]
            other = control.parse(plain), ["comments contain characters that are not ASCII: ignored"]
        return ReadTables(control, other[0], hashes, (), tuple(other[1]))
    others = tuple(control.contradictions(tables, sources))
    remarks = tuple(control.remarks(tables, sources))
    return ReadTables(control, tables, hashes, others, remarks)


def table_files(paths: Sequence[str | Path], controller: str) -> list[Path]:
    """Return the files, for a folder those that its manifest lists; InputError if it does not match."""
    found: list[Path] = []
    for given in map(Path, paths):
        if not given.is_dir():
            found.append(given)
            continue
        # of an export that was made for several controls, the sub-folder of this control
        place = next((place for place in (given, given / controller) if (place / "manifest.json").is_file()), None)
        if place is None:
            message = "is a folder without manifest.json; give the table files, or the folder of an export"
            raise InputError(message, file=given)
        path = place / "manifest.json"
        try:
            manifest = json.loads(read_bytes(path, MOST_BYTES))
            made_for, prefix = manifest["controller"], manifest.get("file_prefix", "")
            names = [(item["name"], item.get("sha256")) for item in manifest["files"]]
            if not names or not all(isinstance(name, str) and name == Path(name).name for name, _ in names):
                raise ValueError("no file")
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError("is not the manifest of an export", file=path) from error
        if made_for != controller:
            message = f"lists tables of {one_line(made_for)[:40]}, but {controller} was requested"
            raise InputError(message, file=path, field="controller")
        for name, digest in names:
            table = place / f"{prefix}{name}"
            if digest != sha256_of(read_bytes(table, MOST_BYTES + 1)):
                message = f"{table.name} was changed after the export that wrote {path}"
                warnings.warn(message, CompgenWarning, stacklevel=4)
        found += [place / f"{prefix}{name}" for name, _ in names]
    return found


#: Every file of this program says so in one of its first lines.
_OWN_FILE = re.compile(rb"\b(?:compgen|volcomp) (?:\d+\.\d|unknown)")


def _decode(path: Path, content: bytes) -> str:
    try:
        text = content.decode("ascii")
        at = text.find("\0")
    except UnicodeDecodeError as error:
        text, at = "", error.start
    if at < 0:
        return text
    what = "a NUL character" if text else "a byte that is not ASCII"
    line = content[:at].count(b"\n") + 1
    raise InputError(f"contains {what}; controller tables are ASCII text", file=path, line=line)


#: Smaller errors of the tool tip are drawn with this value: the reference point has none, and the axis is logarithmic.
LEAST_DRAWN_UM = 1e-3


@dataclass(frozen=True, repr=False)
class Verification(Drawable, Tabular):
    """Result of :func:`verify`; residuals of the exact model over the same points before and after.

    ``reasons`` says why the tables are not accepted (empty: accepted). ``unrepresentable_um`` is the largest residual
    that the best table of this control leaves (without a constant offset if the control cannot apply one), and
    ``uncorrected_um`` gives the errors behind it with the largest displacement that remains. ``reservations`` are
    remarks of the control on tables that exceed no limit: what is inferred, has no room, or is unknown. ``remarks`` are those
    on the measurement, and ``proposed`` the keys of ``result.json`` on what to measure next. ``frame_shift_um`` is what the
    tables add at the reference point: the constant by which a control that can add one shifts the whole frame.

    Examples
    --------
    >>> import tempfile
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = compgen.export(machine, errors, "isg-csv").write(folder)
    ...     tables = compgen.read_tables(machine, paths, "isg-csv")
    >>> result: compgen.Verification = compgen.verify(machine, tables, errors)
    >>> result.controller, result.state
    ('isg-csv', 'accepted')
    >>> result.before.max_um > 1000 * result.after.max_um
    True
    """

    controller: str
    before: Residuals
    after: Residuals
    before_rigid_removed: Residuals
    after_rigid_removed: Residuals
    unrepresentable_um: float
    uncorrected_um: dict[str, float]
    points: int
    files: tuple[tuple[str, str], ...]
    reasons: tuple[str, ...]
    reservations: tuple[str, ...]
    measured: Coverage
    safety: Safety = field(repr=False)
    position_mm: FloatArray = field(repr=False)
    error_before_mm: FloatArray = field(repr=False)
    error_after_mm: FloatArray = field(repr=False)
    machine: str = ""
    objections: tuple[Objection, ...] = ()
    uncertainty: FigureUncertainty | None = None
    next_command: str = ""
    tools: str = ""
    gain: ProbableGain | None = None
    remarks: tuple[str, ...] = ()
    proposed: Mapping[str, Any] = field(default_factory=dict)
    frame_shift_um: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def to_columns(self) -> dict[str, Sequence[str] | FloatArray]:
        """Return the columns of ``volume.csv``: error of the tool tip before and after at every point, um, each (n,)."""
        columns: dict[str, Sequence[str] | FloatArray] = {
            f"{axis}_mm": self.position_mm[:, k] for k, axis in enumerate("xyz")
        }
        for prefix, values in (("before", self.error_before_mm), ("after", self.error_after_mm)):
            columns |= {f"{prefix}_{axis}_um": values[:, k] / MM_PER_UM for k, axis in enumerate("xyz")}
        return columns

    def to_xarray(self) -> Any:
        """Return the error before and after as an ``xarray.Dataset`` over ``x_mm``, ``y_mm``, ``z_mm``, um.

        Points that fill no grid, or are listed once for each direction of travel, are over ``point``, with the positions as
        coordinates.

        Raises
        ------
        ImportError
            if xarray is not installed.
        """
        xarray = package("xarray", "to_xarray()")
        columns = {name: np.asarray(values) for name, values in self.to_columns().items()}
        places = [columns.pop(f"{axis}_mm") for axis in "xyz"]
        names, levels = ("x_mm", "y_mm", "z_mm"), [np.unique(place) for place in places]
        shape, size = tuple(map(len, levels)), len(places[0])
        if int(np.prod(shape)) == size == len(np.unique(np.column_stack(places), axis=0)):
            order = np.lexsort(places[::-1])
            columns = {name: values[order].reshape(shape) for name, values in columns.items()}
            dimensions: tuple[str, ...] = names
            coordinates: dict[str, Any] = dict(zip(names, levels, strict=True))
        else:
            dimensions = ("point",)
            coordinates = {name: ("point", place) for name, place in zip(names, places, strict=True)}
        made = {name: (dimensions, values, {"units": "um"}) for name, values in columns.items()}
        return xarray.Dataset(made, coords=coordinates, attrs={"machine": self.machine, "controller": self.controller})

    @property
    def accepted(self) -> bool:
        """Whether the tables may be loaded, whatever reservations the verdict has."""
        return not self.reasons

    @property
    def volumetric(self) -> bool:
        """Whether figures over the volume can be stated: every observable error of the machine's chain is known."""
        return not self.measured.missing

    @property
    def worse_as_it_stands(self) -> bool:
        """Whether the tables increase the rms error for a workpiece whose set-up is not changed."""
        return self.after.rms_um > self.before.rms_um + WORSE_FROM_UM

    @property
    def state(self) -> State:
        """The verdict in one word."""
        found: list[State] = []
        if self.partial or not self.volumetric:
            found.append("partial")
        if self.objections or self.reservations:
            found.append("accepted_with_reservations")
        if self.worse_as_it_stands or (self.gain is not None and self.gain.only_after_new_setup):
            found.append("better_after_new_setup")
        if not self.accepted:
            found.append("not_accepted")
        return worst(found)

    @property
    def headline(self) -> str:
        """The verdict in one sentence, with its decisive figure."""
        if not self.accepted:
            first, more = self.reasons[0], len(self.reasons) - 1
            return f"not accepted: {first} (and {more} more)" if more else f"not accepted: {first}"
        if self.worse_as_it_stands:
            before, after = self.before_rigid_removed, self.after_rigid_removed
            said = (
                f"better only after the workpiece is set up again: without that the error grows from "
                f"{um_text(self.before.rms_um)} to {um_text(self.after.rms_um)} um rms; with the best-fit rigid motion of the "
                f"workpiece removed it goes from {um_text(before.rms_um)} to {um_text(after.rms_um)} um rms"
            )
            return said if self.volumetric else f"{said}; {self.measured.text}"
        if self.gain is not None and self.gain.only_after_new_setup:
            verdict = (
                "better only after the workpiece is set up again (as it stands with a probability of "
                f"{100.0 * self.gain.probability_as_it_stands:.0f} %)"
            )
        else:
            verdict = VERDICT_WORDS[self.state]
        parts = [] if self.volumetric else [self.measured.text]
        parts += [self.figure, *([self._beyond_text] if self.partial else [])]
        against = self.said_against
        if against:
            parts.append(against[0] + (f" (and {len(against) - 1} more)" if len(against) > 1 else ""))
        return f"{verdict}: {'; '.join(parts)}"

    @property
    def said_against(self) -> tuple[str, ...]:
        """Why accepted tables are accepted with reservations: what speaks against the measurement first."""
        objections = [item for item in self.objections if not item.blocking]
        objections.sort(key=lambda item: item.code in DOUBT_CODES)
        return tuple(dict.fromkeys((*(item.text for item in objections), *self.reservations)))

    @property
    def figure(self) -> str:
        """What the tables do, in one figure: rms over the volume, with its limits, and how much of it is a shift of the frame."""
        return self._as_it_stands + (f"; {self._shift_text}" if self._shift_text else "")

    @property
    def _shift_text(self) -> str:
        """That a constant of the tables is no gain; empty if it is none of what they gain, or not worth a word."""
        before, after = self.before_rigid_removed.rms_um, self.after_rigid_removed.rms_um
        left, left_as_it_stands = after / max(before, 1e-12), self.after.rms_um / max(self.before.rms_um, 1e-12)
        small = float(np.linalg.norm(self.frame_shift_um)) < max(WORSE_FROM_UM, SHIFT_SHARE * before)
        if small or left < left_as_it_stands + SHIFT_GAIN:
            return ""
        parts = [
            f"{letter} {um:+.1f} um" for letter, um in zip(AXES, self.frame_shift_um, strict=True) if abs(um) >= 0.05
        ]
        return (
            f"a part of that is a constant of the tables ({', '.join(parts)} at the reference point), which shifts the frame "
            "and is no gain: with the best-fit rigid motion removed, what is known of the errors goes from "
            f"{um_text(before)} to {um_text(after)} um rms"
        )

    @property
    def _as_it_stands(self) -> str:
        """What the tables do with the reference point fixed."""
        if self.gain is not None:
            before, low, high, after, most = self.gain.rounded
            return f"the error over the volume goes from {before} um rms ({low} to {high} um) to {after} um, at most {most} um"
        change = f"{um_text(self.before.rms_um)} to {um_text(self.after.rms_um)} um rms"
        known = "not known" if self.uncertainty is None else f"{um_text(self.uncertainty.rms_um)} um"
        bounds = f"uncertainty of the measurement U = {known}" + ("" if self.uncertainty is None else ", k = 2")
        if self.volumetric:
            return f"the error over the volume goes from {change} ({bounds})"
        return f"the effect of the measured errors alone goes from {change} ({bounds}); the error over the volume is unknown"

    @property
    def _beyond_text(self) -> str:
        share = 100.0 * self.after_rigid_removed.rms_um / max(self.before_rigid_removed.rms_um, 1e-12)
        return (
            f"this control cannot express {um_text(self.unrepresentable_um)} um of the error; {share:.0f} % of the rms remains "
            "with the best-fit rigid motion removed"
        )

    @property
    def partial(self) -> bool:
        """Whether the control cannot express a large part of the error: the table is right, but much remains."""
        return self.unrepresentable_um > PARTIAL_SHARE * self.before.max_um

    @property
    def notes(self) -> tuple[str, ...]:
        """What else the user should know about accepted tables."""
        notes = [*self.reservations, *self.safety.warnings]
        notes += self.assumptions
        if self.partial:
            notes.append(self._beyond_text)
        if self.after.max_um > self.before.max_um + 0.05 and not self.worse_as_it_stands:
            notes.append(
                f"with the present set-up the largest error grows from {self.before.max_um:.1f} to {self.after.max_um:.1f} um, "
                "by a rigid motion of the workpiece"
            )
        return (*notes, *self.remarks)

    @property
    def known_lines(self) -> list[str]:
        """What a person should know before loading the tables: verdict, uncertainty, what was assumed."""
        found = self.uncertainty
        text = "what the machine will do with the tables is not determined"
        if found is not None and self.gain is None and self.measured.missing:
            text = f"{text}; what was measured has U = {um_text(found.rms_um)} um rms over the volume (k = 2)"
        elif found is not None:
            text = (
                f"whatever the files say, the machine may be U = {um_text(found.rms_um)} um rms over the volume from it, "
                f"{um_text(found.max_um)} um where it is largest (k = 2)"
            )
        return [self.headline, text, *(self.assumptions or [WITHOUT_PRIOR])]

    @property
    def assumptions(self) -> list[str]:
        """What is assumed, what is not known, and whether the machine is worse than its class: the same for every control."""
        if self.gain is None:
            return []
        return [text for text in (self.gain.assumed, self.gain.open_text, self.gain.machine_worse) if text]

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``result.json``."""
        return {
            "accepted": self.accepted,
            "verdict": self.state,
            "headline": self.headline,
            "objections": [item.as_dict() for item in self.objections],
            "measured": self.measured.as_dict(),
            "volumetric": self.volumetric,
            "partial": self.partial,
            "notes": list(self.notes),
            "reasons": list(self.reasons),
            "controller": self.controller,
            "machine": self.machine,
            "points": self.points,
            "before": self.before.as_dict(),
            "after": self.after.as_dict(),
            "before_rigid_motion_removed": self.before_rigid_removed.as_dict(),
            "after_rigid_motion_removed": self.after_rigid_removed.as_dict(),
            "probability_better": None if self.gain is None else self.gain.probability_better,
            "probable": None if self.gain is None else self.gain.as_dict(),
            "prior": {"class": "none"} if self.gain is None else dict(self.gain.prior),
            "not_measured": {} if self.gain is None else dict(self.gain.not_measured),
            "after_uncertainty": None if self.uncertainty is None else self.uncertainty.as_dict(),
            "unrepresentable_um": self.unrepresentable_um,
            "uncorrected_um": self.uncorrected_um,
            "frame_shift_um": list(self.frame_shift_um),
            "next_command": self.next_command or None,
            **self.proposed,
            "judged_with_tools": self.tools,
            "safety": self.safety.summary(),
            "files": [{"name": name, "sha256": digest} for name, digest in self.files],
        }

    def overview(self) -> Overview:
        """Verdict, and the error of the tool tip over the volume before and after."""
        fields = {
            "before": self.before,
            "after": self.after,
            "before, rigid motion removed": self.before_rigid_removed,
            "after, rigid motion removed": self.after_rigid_removed,
        }
        rows = tuple((name, um_text(x.max_um), um_text(x.rms_um), um_text(x.p95_um)) for name, x in fields.items())
        change = f"{um_text(self.before.rms_um)} to {um_text(self.after.rms_um)} um rms"
        title = f"{self.controller}: {self.state.replace('_', ' ')}, tool-tip error {change}"
        return Overview(title, ("tool-tip error (um)", "max", "rms", "95 %"), rows, (self.headline, *self.notes))

    def panels(self) -> Sequence[Panel]:
        """Share of the points with an error of the tool tip below each size."""
        lines = []
        for name, error_mm in (("before", self.error_before_mm), ("after", self.error_after_mm)):
            size_um = np.maximum(np.sort(np.linalg.norm(error_mm, axis=1)) / MM_PER_UM, LEAST_DRAWN_UM)
            lines.append(PlottedLine(name, size_um, np.linspace(0.0, 100.0, len(size_um))))
        x_label = "error of the tool tip (um)"
        return [Panel(self.controller, "points below (%)", tuple(lines), x_label=x_label, x_scale="log")]


def verify(
    machine: Machine,
    tables: ReadTables,
    errors: ErrorTable,
    points: Points | None = None,
    limits: SafetyLimits | None = None,
    reversal: ReversalCurves | None = None,
    covariance: Covariance | None = None,
) -> Verification:
    """Judge parsed tables against the errors of the machine.

    Parameters
    ----------
    machine : the machine.
    tables : from :func:`read_tables`.
    errors : usually the identified errors; the exact model moves with them.
    points : where the residuals are reported; default: the grid of the nodes of curves and tables and the middles
        between them. The judgement itself is always made on that grid and on lines along the axes.
    limits : for the steps of the tables, see :func:`compgen.tables.judge.safety_of`.
    reversal : the reversal of each axis, in addition to the errors (the mean of both directions); points without a
        direction of approach are then evaluated from both sides.
    covariance : joint covariance of the errors, for the uncertainty of the figures; by default from the uncertainties
        of the single values.

    Examples
    --------
    >>> import tempfile
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = compgen.export(machine, errors, "isg-csv").write(folder)
    ...     tables = compgen.read_tables(machine, paths, "isg-csv")
    >>> result = compgen.verify(machine, tables, errors)
    >>> result.accepted, result.after.max_um < 0.5
    (True, True)
    """
    for name, value, kind in (
        ("machine", machine, Machine),
        ("tables", tables, ReadTables),
        ("errors", errors, ErrorTable),
    ):
        of_kind(name, value, kind)
    control = tables.controller
    judge = judge_of(machine, control, errors, tables.tables)
    grid_mm, solver = judge.grid.position_mm, judge.solver
    where = points or Points(grid_mm)
    if reversal is not None and where.approach is None:
        where = in_both_directions(where)
    # the exact model without and with the correction, which is looked up at the commanded position
    correction = tables.correction(machine, where)
    before = error_at(machine, errors, where.position_mm, where.tool_mm)
    after = exact_error(machine, errors, where.position_mm + correction, where.tool_mm) + correction
    not_in_tables = None
    if reversal is not None:
        # it is added to both, by the direction of approach of each point
        moved = 0.0 if where.approach is None else reversal.displacement(where.position_mm, where.approach)
        before, after = before + moved, after + moved
        not_in_tables = reversal.without(control.reversal_in_tables(reversal))
    nominal = where.position_mm + tool_of(machine, where.tool_mm)
    rest = wanted_correction(machine, errors, grid_mm) - judge.best_mm
    if control.anchored:
        rest = rest - rest.mean(axis=0)
    twice_before = (
        residuals_twice(nominal, before)
        if reversal is not None
        else residuals_before(machine, errors, where.position_mm, where.tool_mm)
    )
    figures, rigid_removed = zip(twice_before, residuals_twice(nominal, after), strict=True)
    # on the grid, tables of both directions say the same to the judge
    same = points is None and reversal is None and not control.by_direction(tables.tables)
    on_grid = (correction, rigid_removed[1]) if same else None
    safety, reasons = reasons_against(machine, tables, judge, limits, reversal, on_grid=on_grid)
    posterior = _known(machine, errors, _NO_POINTS, covariance)
    sizes = [item.rms_um for item in (*figures, *rigid_removed)]
    gain = (
        None
        if posterior is None
        else probable_gain(machine, errors, posterior, where.position_mm, before, after, sizes)
    )
    improbable = [gain.reason] if gain is not None and gain.reason else []
    useless = _useless_reasons(
        machine, tables, points_mm=(grid_mm, judge.line_mm), figures=figures, removed=rigid_removed
    )
    return Verification(
        controller=control.name,
        before=figures[0],
        after=figures[1],
        before_rigid_removed=rigid_removed[0],
        after_rigid_removed=rigid_removed[1],
        unrepresentable_um=float(np.max(np.linalg.norm(rest, axis=1))) / MM_PER_UM,
        uncorrected_um={
            **_uncorrected(machine, errors, solver.position_mm, solver),
            **left_by_reversal(not_in_tables, corrected=False),
        },
        points=len(where),
        files=tables.files,
        reasons=tuple(dict.fromkeys([*useless, *reasons, *improbable])),
        reservations=(
            *control.reservations(tables.tables),
            *control.left_out(errors),
        ),
        measured=coverage_of(machine, errors, posterior),
        safety=safety,
        position_mm=where.position_mm,
        error_before_mm=before,
        error_after_mm=after,
        machine=machine.name,
        uncertainty=figure_uncertainty(machine, errors, where.position_mm, covariance),
        tools=machine.tool_range_text,
        objections=() if gain is None else tuple(gain.reservations),
        gain=gain,
        frame_shift_um=_frame_shift_um(machine, tables),
    )


def _frame_shift_um(machine: Machine, tables: ReadTables) -> tuple[float, float, float]:
    """Return what tables add at the reference point, X, Y, Z: the constant in them, which shifts the whole frame."""
    place_mm = np.array([machine.reference_point_mm])
    x, y, z = (tables.mean_correction(machine, place_mm)[0] / MM_PER_UM).tolist()
    return x, y, z


def reasons_against(
    machine: Machine,
    tables: ReadTables,
    judge: Judge,
    limits: SafetyLimits | None = None,
    reversal: ReversalCurves | None = None,
    check: EntryCheck | None = None,
    on_grid: tuple[FloatArray, Residuals] | None = None,
) -> tuple[Safety, tuple[str, ...]]:
    """Return what parsed tables would make the axes do, and every reason not to accept them, each once.

    ``check`` is that of other tables of the same control, errors and reversal, if there is one; ``on_grid`` what the
    tables add on the judge's grid (n, 3), and the figures of what they leave there without rigid motion, where known.
    """
    control = tables.controller
    added, left = on_grid or (tables.mean_correction(machine, judge.grid.position_mm), None)
    on_lines = tables.mean_correction(machine, judge.line_mm)
    safety = safety_of(machine, control, tables.tables, lambda part: judge.solver.field(judge.values, part), limits)
    turned: list[str] = []
    if reversal is not None and control.bidirectional:
        in_tables = control.reversal_in_tables(reversal)
        rounding_mm = 2.0 * control.resolution_mm()  # of both directions
        turned = reversal_reasons(machine, lambda points: tables.correction(machine, points), in_tables, rounding_mm)
    against_best = judge.reasons(added, on_lines, left)
    if not against_best:
        check = entry_check(machine, judge, tables, reversal) if check is None else check.of(tables)
        against_best = check.reasons()
    reasons = [
        *control.violations(tables.tables),
        *against_best,
        *turned,
        *tables.contradictions,
        *safety.reasons,
    ]
    return safety, tuple(dict.fromkeys(reasons))


def _useless_reasons(
    machine: Machine,
    tables: ReadTables,
    *,
    points_mm: Sequence[FloatArray],
    figures: Sequence[Residuals],
    removed: Sequence[Residuals],
) -> list[str]:
    """Return a reason against tables that contain only zeros, or make the machine worse whatever the set-up.

    ``figures`` are before and after with the reference point fixed, ``removed`` with the best-fit rigid motion removed.
    """
    step_um = tables.controller.resolution_mm() / MM_PER_UM
    parts = (
        Points(position_mm[part], approach=np.full_like(position_mm[part], side))
        for position_mm in points_mm
        for part in blocks(len(position_mm), FEW_POINTS)  # tables that do something show it at the first points
        for side in ((1.0, -1.0) if tables.controller.by_direction(tables.tables) else (1.0,))
    )
    if all((np.abs(tables.correction(machine, points)) < ZERO_MM).all() for points in parts):
        return [
            f"the tables contain only zeros, while the errors reach {um_text(figures[0].max_um)} um: either this "
            f"control has no table for them, or its smallest step is too coarse (rounding of an entry: up to {step_um:.3g} um)"
        ]
    if figures[1].rms_um > figures[0].rms_um + WORSE_FROM_UM and removed[1].rms_um > removed[0].rms_um:
        return [
            f"the tables make the machine worse: {um_text(figures[0].rms_um)} um rms before, {um_text(figures[1].rms_um)} "
            f"after; with the best-fit rigid motion removed {um_text(removed[0].rms_um)} before, "
            f"{um_text(removed[1].rms_um)} after"
        ]
    return []


@kept
def _single_errors(machine: Machine, errors: ErrorTable, position_mm: FloatArray) -> FloatArray:
    """Corrections of the single errors to first order at positions (n, 3): (errors, n, 3), mm."""
    return np.stack([-volumetric_error(machine, errors.only(name), position_mm) for name in errors.names])


@kept
def _uncorrected(machine: Machine, errors: ErrorTable, position_mm: FloatArray, solver: Projector) -> dict[str, float]:
    """Return the largest displacement in um that the best table leaves of each single error (first order), if relevant.

    ``position_mm`` are the sample points of the ``solver``.
    """
    # beside rotations that are fitted together with the tables, the tables are not unique
    given = _in_tables(machine, errors, solver) if solver.offsets <= 3 else set()
    rest_of = errors.only(*(name for name in errors.names if name not in given))
    if not rest_of.names:
        return {}
    found = {}
    required = _single_errors(machine, rest_of, position_mm)
    for name, rest in zip(rest_of.names, solver.left_of(required), strict=True):
        if solver.offsets:
            rest = rest - np.average(rest, axis=0, weights=solver.weight)
        x, y, z = rest.T
        largest = float(np.sqrt(np.max(x * x + y * y + z * z)))
        if largest > NAMED_FROM_MM:
            found[name] = round(largest / MM_PER_UM, 3)
    return dict(sorted(found.items(), key=lambda item: -item[1]))


def _in_tables(machine: Machine, errors: ErrorTable, solver: Projector) -> set[str]:
    """Return the errors whose displacement (first order) some table values give exactly: the best leave nothing of them.

    The displacement by a curve c over an axis is c times monomials (1, x, y, z, by output). It is a sum of tables over
    the same axis that contain multiples of c, if the monomials are that sum of their carriers. That by a squareness is
    such a sum of constants, or of straight lines over the axes of its levers.
    """
    carried: dict[int | None, list[tuple[Term, slice, FloatArray]]] = {}
    for term, place in placed_terms(solver.basis):
        carried.setdefault(term.axis, []).append((term, place, _monomials(term.carrier, solver.tool_mm)))

    def given(pieces: Sequence[tuple[int | None, Curve, FloatArray]]) -> bool:
        """Whether table values give the sum of curves over an axis (None: constants), each times monomials (12,)."""
        values = np.zeros(len(solver.freedom.free) + len(solver.freedom.bound))
        for axis, curve, wanted in pieces:
            able = []
            for term, place, carrier in carried.get(axis, ()):
                at_nodes = curve.at(term.nodes_mm)
                if axis is not None:
                    ends_mm = machine.axes[axis].range_mm
                    kinks_mm = np.clip(np.concatenate([term.nodes_mm, curve.position_mm, ends_mm]), *ends_mm)
                    miss = np.interp(kinks_mm, term.nodes_mm, at_nodes) - curve.at(kinks_mm)
                    if np.max(np.abs(miss)) > IN_TABLES * np.max(np.abs(at_nodes)):
                        continue
                if solver.offsets and term.zero_at_mm is not None and not carrier.reshape(3, 4)[:, 1:].any():
                    at_nodes = at_nodes - np.interp(term.zero_at_mm, term.nodes_mm, at_nodes)  # a constant is free
                able.append((place, at_nodes, carrier))
            if not able:
                return False
            columns = np.stack([carrier for *_, carrier in able], axis=1)
            share = np.linalg.lstsq(columns, wanted, rcond=None)[0]
            if np.max(np.abs(columns @ share - wanted)) > IN_TABLES * np.max(np.abs(wanted)):
                return False
            for (place, at_nodes, _), part in zip(able, share, strict=True):
                values[place] += part * at_nodes
        broken = values[solver.freedom.bound] - solver.freedom.rows @ values[solver.freedom.free]
        return bool(np.max(np.abs(broken), initial=0.0) <= IN_TABLES * np.max(np.abs(values)))

    found = set()
    for name in errors.names:
        of_matrix = [part for part in coefficients(machine.chain, machine.squareness_reference) if part.error == name]
        parts = [Monomial(part.output, part.sign, part.lever) for part in of_matrix]
        whole = _monomials(parts, solver.tool_mm)
        ways: list[list[tuple[int | None, Curve, FloatArray]]]
        if name in errors.curves:
            ways = [[(error_named(name).axis, errors.curves[name], whole)]]
        else:
            rad, far_mm = errors.squareness[name][0], np.array([-1e6, 1e6])
            ways = [[(None, Curve(np.zeros(1), np.full(1, rad), np.zeros(1)), whole)]]
            if all(part.lever in (0, 1, 2) for part in parts):
                line = Curve(far_mm, rad * far_mm, np.zeros(2))
                plain = [_monomials([replace(part, lever=None)], solver.tool_mm) for part in parts]
                ways.append([(part.lever, line, carrier) for part, carrier in zip(parts, plain, strict=True)])
        if any(given(pieces) for pieces in ways):
            found.add(name)
    return found


def _monomials(parts: Sequence[Monomial], tool_mm: FloatArray) -> FloatArray:
    """A sum of monomials as twelve factors: for each output those of 1, x, y and z."""
    factors = np.zeros((3, 4))
    for part in parts:
        if part.lever in (0, 1, 2):
            factors[part.output, 1 + part.lever] += part.sign
        else:
            factors[part.output, 0] += part.sign * (1.0 if part.lever is None else float(tool_mm[part.lever - 3]))
        factors[part.output, 0] -= part.sign * part.origin_mm
    return factors.ravel()


# The files of a verification: its figures, and the points behind them.


#: Decimals of ``volume.csv``: of positions in mm, and of errors in um.
POSITION_DECIMALS, ERROR_DECIMALS = 6, 4


def verification_files(result: Verification) -> dict[str, str]:
    """Return the texts of ``result.json`` and ``volume.csv``."""
    return {"result.json": json.dumps(result.summary(), indent=2) + "\n", "volume.csv": format_volume(result)}


def format_volume(result: Verification) -> str:
    """Return the text of ``volume.csv``: error of the tool tip before and after at every point of the figures, um.

    If a reversal is known, every point is listed twice, reached in positive and in negative direction.
    """
    columns = result.to_columns()
    digits = {name: POSITION_DECIMALS if name.endswith("_mm") else ERROR_DECIMALS for name in columns}
    return format_csv(columns, {"controller": result.controller}, digits)
