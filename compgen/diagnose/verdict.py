"""The verdict: named effects in three grades, unnamed effects, effects the plan hides, and what to measure next."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc

from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM, RAD_PER_URAD, SQUARENESS_NAMES, error_named
from compgen.diagnose.analysis import HOMOGENEITY_P, Analysis, contribution
from compgen.diagnose.base_fit import Part, least_norm, orthonormal, size_of
from compgen.diagnose.observed import Observed
from compgen.diagnose.search import (
    Alternative,
    Design,
    alternatives,
    gains,
    plain_covariates,
    remainder_of,
)
from compgen.drawing.display import Bars, Drawable, Overview, Panel
from compgen.effects import catalogue
from compgen.errors import Message
from compgen.kinematics.exact_chain import tip_position

# The verdict: named effects in three grades, unnamed effects, and effects the plan cannot show.


Grade = Literal["confirmed", "beside_unknown", "tentative"]
Word = Literal["named", "none", "unknown", "not_decidable"]


class DisplayedDiagnosis(Drawable):
    """Display of a diagnosis of any measurement, from the content of its ``diagnosis.json``."""

    machine: Machine

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""

    def overview(self) -> Overview:
        """The verdict, and each name with its grade and parameters."""
        found = self.to_dict()
        rows = []
        for effect in found["effects"]:
            texts = [
                f"{name} = {item['value']:.4g}" + ("" if item["u"] is None else f" +- {item['u']:.2g}")
                for name, item in effect["parameters"].items()
            ]
            rows.append((effect["name"], effect["grade"], ", ".join(texts)))
        names = f": {', '.join(name for name, _, _ in rows)}" if rows else ""
        title = f"{self.machine.name}: {found['verdict'].replace('_', ' ')}{names}"
        notes = (*(item["text"] for item in found["unknown"]), *found["reasons"])
        return Overview(title, ("effect", "grade", "parameters"), tuple(rows), notes)

    def panels(self) -> Sequence[Panel]:
        """RMS of the residuals before and after, for the readings used and the readings left out."""
        misfit = self.to_dict()["gap"]
        shown = {key.removeprefix("heldout_"): pair for key, pair in misfit.items() if isinstance(pair, dict)}
        before = Bars("before", tuple(shown), tuple(pair["before_rms_um"] for pair in shown.values()))
        after = Bars("after", tuple(shown), tuple(pair["after_rms_um"] for pair in shown.values()))
        return [Panel("residuals of the readings used and left out", "rms (um)", bars=(before, after))]


#: Standard uncertainties below which an amount is not confirmed.
LEAST_SIZE = 2.0
#: Names with less than this left after projecting out the base model are never confirmed.
LEAST_VISIBLE = 0.05
#: A name is not confirmed if its chi-square is below this share of the total of all members without a (firm) name.
LEAST_SHARE = 0.1
#: The same for a jump of the whole machine: of many possible times, one always fits a slow change to some extent.
LEAST_JUMP_SHARE = 0.5
#: Homogeneity p-value below which a name is not confirmed if something unnamed was also found.
HOMOGENEITY_WITH_UNKNOWN_P = 0.01
#: Unevenness that explains less than this share of the chi-square of a name is due to its inexact shape.
SLIGHTLY_UNEVEN = 0.03
#: A further name with a chi-square below this share of the largest is listed as a possible secondary effect.
SECONDARY_SHARE = 0.005
#: A generic group in the covariates of a name, with less than this share of its chi-square, reflects its inexact shape.
SHAPE_SHARE = 0.1
RUNOUT = "tracer_runout_"
#: An unnamed effect resembles a name that explains this share of it.
RESEMBLES = 0.3
#: An effect with a visible share below this counts as invisible.
INVISIBLE = 0.05
#: Names of scale effects of the readings, into which any misfit can be reshaped.
NEVER_CONFIRMED = ("laser_scale",)


@dataclass(frozen=True)
class Named:
    """One named effect of the verdict; ``reasons`` explain why the grade is not better."""

    name: str
    group: int
    grade: Grade
    confidence: float
    alternatives: tuple[Alternative, ...]
    visible: float
    chi2: float
    homogeneity_p: float
    reasons: tuple[str, ...] = ()
    shape_exact: bool = True


@dataclass(frozen=True)
class Unknown:
    """An unnamed effect: what it depends on, how it acts, its RMS in mm (nan if unknown), description.

    ``resembles`` is the name that explains most of it instead, if any explains enough.
    """

    covariates: tuple[str, ...]
    direction: str
    rms_mm: float
    text: str
    group: int | None = None
    resembles: str = ""


@dataclass(frozen=True)
class Verdict:
    """The verdict of a diagnosis."""

    word: Word
    named: tuple[Named, ...]
    unknown: tuple[Unknown, ...]
    secondary: tuple[Named, ...]
    invisible: tuple[str, ...]
    reasons: tuple[str, ...]
    added: tuple[int, ...]


def verdict_of(analysis: Analysis) -> Verdict:
    """Return the verdict."""
    design, support = analysis.design, analysis.support
    members = analysis.chosen.members
    names = [g for g in members if design.groups[g].tier == "named"]
    generic = [g for g in members if design.groups[g].tier == "generic"]
    jumps = _common_jumps(analysis, names)
    names = [g for g in names if g not in jumps]
    names.sort(key=lambda g: -support.chi2[g])
    shapes = {g: owner for g in generic if (owner := _owner(analysis, g, names)) is not None}
    leftover = [g for g in generic if g not in shapes]
    owners = {*shapes.values(), *(_owner(analysis, d.group, names, d.log_ratio) for d in analysis.support.directed)}
    graded = [_graded(analysis, g, leftover, g in owners) for g in names]
    largest = max((item.chi2 for item in graded), default=0.0)
    secondary = [item for item in graded if item.chi2 < SECONDARY_SHARE * largest]
    graded = [item for item in graded if item not in secondary]
    unknown = _unknown(analysis, leftover, jumps, names)
    firm = [item for item in graded if item.grade != "tentative"]
    repeats = analysis.noise.source != "assumed"
    if not repeats:
        firm = [
            item for item in graded if not any(not reason.startswith("the noise is assumed") for reason in item.reasons)
        ]
    word: Word = "named" if firm else "unknown" if unknown or graded else "none"
    if word == "unknown" and not unknown:
        first = graded[0]
        text = Message(
            "resembles",
            "resembles {name} but {reasons}",
            name=first.name,
            reasons=first.reasons[0] if first.reasons else Message("not-certain", "is not certain"),
        )
        covariates = tuple(sorted(plain_covariates(design.groups[first.group].covariates)))
        unknown = [Unknown(covariates, "", float("nan"), text, None, first.name)]
    if unknown:
        graded = [replace(item, grade="beside_unknown") if item.grade == "confirmed" else item for item in graded]
    reasons = (
        []
        if repeats
        else [
            Message(
                "noise-assumed", "no repeats and no stated uncertainty: the noise is assumed, so no name is confirmed"
            )
        ]
    )
    return Verdict(
        word,
        tuple(graded),
        tuple(unknown),
        tuple(secondary),
        _invisible(analysis),
        tuple(reasons),
        tuple(g for g in members if g not in {item.group for item in secondary}),
    )


def _common_jumps(analysis: Analysis, names: list[int]) -> list[int]:
    """Simultaneous steps of two or more stations: the machine or the target jumped, not the stations."""
    steps = [g for g in names if analysis.design.groups[g].name.startswith("length_step_")]
    spacing = 12 * analysis.noise.spacing
    together = []
    for g in steps:
        at = analysis.design.groups[g].position
        near = [
            h
            for h in steps
            if h != g and at is not None and abs((analysis.design.groups[h].position or 0) - at) < spacing
        ]
        if near:
            together.append(g)
    return together


def _owner(analysis: Analysis, generic: int, names: list[int], gain: float | None = None) -> int | None:
    """Named member whose inexact shape a generic group reflects, if any; ``gain`` if the group is not a member."""
    design, support = analysis.design, analysis.support
    gain = support.chi2[generic] if gain is None else gain
    own = plain_covariates(design.groups[generic].covariates) - {"x", "y", "z"}
    for g in names:
        covariates = plain_covariates(design.groups[g].covariates)
        if design.groups[g].name.startswith(RUNOUT):  # any runout depends on the angles of its station's beam
            covariates |= {"azimuth", "elevation", f"station_{design.groups[g].name.removeprefix(RUNOUT)}"}
        if own and own <= covariates and gain < SHAPE_SHARE * support.chi2[g]:
            return g
    return None


def _graded(analysis: Analysis, group: int, generic: list[int], inexact: bool) -> Named:
    design, support = analysis.design, analysis.support
    name, chi2, p = design.groups[group].name, support.chi2[group], support.homogeneity_p[group]
    visible = float(design.visible[group])
    reasons: list[str] = []
    slight = support.uneven[group] < SLIGHTLY_UNEVEN * chi2
    inexact = inexact or (p < HOMOGENEITY_P and slight)
    if p < (HOMOGENEITY_WITH_UNKNOWN_P if generic else HOMOGENEITY_P) and not (inexact or slight):
        reasons.append(Message("not-alike-everywhere", "does not behave like it everywhere (p = {p:.1e})", p=p))
    if support.misfits and chi2 < support.excess:
        reasons.append(Message("less-than-unexplained", "explains less than what remains unexplained"))
    failed = [g for g, own in support.homogeneity_p.items() if g != group and own < HOMOGENEITY_P]
    share = LEAST_JUMP_SHARE if name == "machine_jump" else LEAST_SHARE
    if generic and chi2 < share * sum(support.chi2[g] for g in (*generic, *failed)):
        reasons.append(Message("small-beside-unknown", "small compared with the unexplained part"))
    if name in NEVER_CONFIRMED or visible < LEAST_VISIBLE:
        reasons.append(
            f"the measurement shows only {100 * visible:.1f} % of it: almost any misfit could be explained by it"
        )
    if (effect := design.groups[group].effect) is not None:
        values, covariance, _ = contribution(design, analysis.chosen, group)
        if float(values @ np.linalg.pinv(covariance, hermitian=True) @ values) < LEAST_SIZE**2 * len(values):
            reasons.append(
                Message(
                    "within-its-uncertainty",
                    "it is smaller than {LEAST_SIZE:g} times its standard uncertainty",
                    LEAST_SIZE=LEAST_SIZE,
                )
            )
        for parameter, value, u in zip(effect.card.parameters, values, np.sqrt(np.diag(covariance)), strict=False):
            size = (abs(value) - 2 * u) / parameter.si_per_unit
            if parameter.plausible > 0 and size > 3 * parameter.plausible:
                reasons.append(f"its size, {parameter.name} = {value / parameter.si_per_unit:.3g}, is not plausible")
                break
    if analysis.noise.source == "assumed":
        reasons.append(Message("noise-not-measured", "the noise is assumed, not measured"))
    others = tuple(alternatives(design, analysis.rules, analysis.chosen, group))
    weight = next((item.weight for item in others if item.name == name), 0.0)
    return Named(  # the name of what was fitted and is added, whatever else explains the readings as well
        name, group, "tentative" if reasons else "confirmed", weight, others, visible,
        chi2, p, tuple(reasons), not inexact,
    )  # fmt: skip


def _unknown(analysis: Analysis, generic: list[int], jumps: list[int], names: list[int]) -> list[Unknown]:
    design, support = analysis.design, analysis.support
    strongest = max((support.chi2[g] for g in names), default=0.0)
    directed = [d for d in support.directed if _owner(analysis, d.group, names, d.log_ratio) is None]
    shaped = len(directed) < len(support.directed) or len(generic) < sum(
        design.groups[g].tier == "generic" for g in analysis.chosen.members
    )
    shaped = shaped and not directed and support.excess < SHAPE_SHARE * strongest
    found = []
    for g in sorted(generic, key=lambda g: -support.chi2[g]):
        group, shape = design.groups[g], contribution(design, analysis.chosen, g)[2]
        rms_mm, nearest = float(np.sqrt(np.mean(shape**2))), _nearest(analysis, g, support.chi2[g])
        found.append(Unknown(group.covariates, group.direction, rms_mm, group.name, g, nearest))
    if jumps:
        at = design.groups[jumps[0]].position
        found.append(Unknown(("time",), "length", float("nan"), f"common jump of several stations at {at:g} s"))
    if not found and directed:
        for item in directed[:3]:
            group = design.groups[item.group]
            nearest = _nearest(analysis, item.group, item.log_ratio)
            found.append(Unknown(group.covariates, group.direction, float("nan"), group.name, item.group, nearest))
    if not found and support.lack_of_fit_z > 3.0 and not shaped:
        found.append(
            Unknown(
                (),
                "",
                float("nan"),
                Message("lack-of-fit", "lines disagree with the model by more than their repeats do"),
            )
        )
    if support.changes_between_runs:
        found.append(Unknown(("run",), "", float("nan"), Message("not-repeatable", "not repeatable from run to run")))
    return found


def _nearest(analysis: Analysis, generic: int, chi2: float) -> str:
    """Name that explains most instead of a generic group; empty if it explains too little or is already a member."""
    design = analysis.design
    rest = [g for g in analysis.chosen.members if g != generic]
    present = {design.groups[g].name for g in rest}
    named = [
        g for g, group in enumerate(design.groups)
        if group.tier == "named" and design.size(g) and group.name not in present
    ]  # fmt: skip
    if not named:
        return ""
    own = gains(design, remainder_of(design, rest), named)
    best = int(np.argmax(own))
    return design.groups[named[best]].name if own[best] > RESEMBLES * chi2 else ""


def _invisible(analysis: Analysis) -> tuple[str, ...]:
    """Names that this plan hides: covariate missing or constant, or nothing left after the base model."""
    design = analysis.design
    best: dict[str, float] = {}
    for g, group in enumerate(design.groups):
        if group.tier == "named":
            best[group.name] = max(best.get(group.name, 0.0), float(design.visible[g]))
    of_base = {f"squareness_{name[1:]}" for name in SQUARENESS_NAMES if name in analysis.fit.basis.errors}
    hidden = [name for name, share in best.items() if share < INVISIBLE]
    readings = analysis.fit.readings
    effects = catalogue(readings.stations)
    lacking = []
    for (
        name
    ) in analysis.missing:  # effects that would have columns at other positions, or if more had been logged or varied
        every = [effects[name].at(position) for position in effects[name].positions(readings)] or [effects[name]]
        if all(effect.shown(readings) is None for effect in every):
            lacking.append(name)
            continue
        if name.startswith("lever_"):
            if name.removeprefix("lever_") not in analysis.fit.basis.errors:
                lacking.append(name)
            continue
        for covariate in effects[name].card.covariates:
            logged = readings.covariates.get(covariate)
            known = covariate in readings.covariates or covariate.startswith(("temp_", "feed", "load", "time"))
            constant = known and (logged is None or np.isnan(logged).any() or np.ptp(logged) == 0.0)
            if constant or (covariate.startswith("approach") and readings.approach is None):
                lacking.append(name)
                break
    return tuple(name for name in (*hidden, *lacking) if name not in of_base)


# Further measurements that would decide: for alias sets, for similar effects, and for effects hidden by this plan.


#: Correlation above which a similar effect is printed with a name, however decisive the criterion is.
NEAR = 0.9


def advice_of(analysis: Analysis, verdict: Verdict) -> tuple[str, ...]:
    """Return the advice, most useful first."""
    cards = {name: effect.card for name, effect in catalogue(analysis.fit.readings.stations).items()}
    found: list[str] = []
    for item in verdict.named:
        others = [other.name for other in item.alternatives if other.name != item.name]
        for other in [*others, *relatives(analysis.design, item.group, others)]:
            breaker = cards[item.name].breaker or cards[other].breaker
            if breaker:
                found.append(
                    Message(
                        "measure-to-separate",
                        "{breaker}: separates {name} from {other}",
                        breaker=breaker,
                        name=item.name,
                        other=other,
                    )
                )
    if analysis.noise.source != "repeats":
        found.append(
            Message(
                "measure-lines-twice",
                "measure every line at least twice, in random order: only repeats separate noise from effects",
            )
        )
    if verdict.unknown and verdict.unknown[0].covariates:
        depends = ", ".join(verdict.unknown[0].covariates)
        found.append(
            Message(
                "vary-separately",
                "vary {depends} separately, each line twice: shows how the unexplained part depends on them",
                depends=depends,
            )
        )
    shown: dict[str, list[str]] = {}
    for name in verdict.invisible:
        if name in cards and cards[name].breaker:
            shown.setdefault(cards[name].breaker, []).append(name)
    found += [
        Message(
            "measure-to-show",
            "{how}: would show {names}, which this measurement cannot",
            how=how,
            names=", ".join(names),
        )
        for how, names in shown.items()
    ]
    return tuple(dict.fromkeys(found))


def relatives(design: Design, group: int, known: Sequence[str]) -> list[str]:
    """Names whose visible part is nearly the same as a member's."""
    rows = design.rows([group])
    found: dict[str, float] = {}
    for g, other in enumerate(design.groups):
        if (
            other.tier != "named"
            or other.name in known
            or other.name == design.groups[group].name
            or not design.size(g)
        ):
            continue
        between = np.linalg.svd(rows[:, design.place(g)], compute_uv=False)
        found[other.name] = max(
            found.get(other.name, 0.0), float(between[: min(design.size(g), design.size(group))].min())
        )
    return [name for name, value in sorted(found.items(), key=lambda item: -item[1]) if value > NEAR][:2]


# Changes: a measurement against an earlier prediction, error by error.
#
# The prediction (an error file, with effects if the machine file has any) replaces the unknown errors; the base model
# is then fitted to the difference and shows which errors differ by more than the noise.


#: p-value (over the number of errors) below which an error has changed.
SIGNIFICANT = 1e-3


@dataclass(frozen=True)
class Against:
    """Residuals against a prediction with only the placement free, (n,), the errors that changed, and the RMS, mm."""

    residual_mm: FloatArray
    changes: tuple[dict[str, Any], ...]
    rms_mm: float


def compared(observed: Observed, analysis: Analysis, errors: ErrorTable) -> Against:
    """Compare a measurement with a prediction.

    Parameters
    ----------
    observed : the measurement.
    analysis : its diagnosis, for the noise and the placement.
    errors : the predicted errors.
    """
    fit = analysis.fit
    # Reading minus prediction, with stations and dead lengths (or the rigid motion) fitted, (n,).
    poses = observed.poses
    tip = tip_position(observed.machine, errors.at(poses.position_mm), poses.position_mm, poses.tool_mm)
    at = size_of(fit.basis.parts(poses.position_mm))
    placement = fit.unknowns[at : at + len(observed.placement_names)].copy()
    for _ in range(8):
        model, _, columns = observed.placed(tip, placement)
        placement += least_norm(columns, observed.value_mm - model)
    residual = np.asarray(observed.value_mm - observed.placed(tip, placement)[0])
    # errors whose curve, fitted to the difference with all others, is significant; strongest first
    white = analysis.design.whiten(fit.jacobian)
    target = analysis.design.whiten(residual)
    solution = least_norm(white, target)
    left = target - white @ solution
    factor = max(1.0, float(left @ left) / max(len(left) - white.shape[1], 1))
    found = []
    parts = fit.basis.parts(fit.observed.poses.position_mm)
    for part in parts:
        place = np.arange(part.place.start, part.place.stop)
        others = orthonormal(np.delete(white, place, axis=1))
        own = white[:, place] - others @ (others.T @ white[:, place])
        basis = orthonormal(own, least=1e-6)
        chi2 = float(np.sum((basis.T @ target) ** 2)) / factor
        p = float(chdtrc(basis.shape[1], chi2)) * len(parts)
        if p < SIGNIFICANT:
            found.append(_change(part, solution[place], chi2, p))
    found.sort(key=lambda item: -item["chi2"])
    return Against(residual, tuple(found), float(np.sqrt(np.mean(residual**2))))


def _change(part: Part, coefficients: FloatArray, chi2: float, p: float) -> dict[str, Any]:
    error = error_named(part.name)
    curve = part.basis @ coefficients
    unit = MM_PER_UM if error.kind == "linear" else RAD_PER_URAD
    largest = float(np.abs(curve).max()) / unit
    what = "value" if part.name in SQUARENESS_NAMES else "largest"
    return {"error": part.name, what: largest, "unit": error.unit, "chi2": chi2, "p": min(p, 1.0)}
