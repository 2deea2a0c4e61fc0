"""The verdict: names in three grades, what has no name, what the plan cannot see."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from compgen.core.names import SQUARENESS_NAMES
from compgen.diagnose.alternatives import Alternative, alternatives
from compgen.diagnose.analysis import Analysis
from compgen.diagnose.evidence import HOMOGENEITY_P, contribution
from compgen.diagnose.groups import Group
from compgen.diagnose.search import beside, gains, plain_covariates
from compgen.effects import catalogue

Grade = Literal["confirmed", "beside_unknown", "tentative"]
Word = Literal["named", "none", "unknown", "not_decidable"]

#: Names of which less than this is left beside the base model are never confirmed.
LEAST_VISIBLE = 0.05
#: A name is not confirmed if its chi-square is below this share of that of all members without a (firm) name.
LEAST_SHARE = 0.1
#: The same for a jump of the whole machine: among many times one suits any slow change a little.
LEAST_JUMP_SHARE = 0.5
#: p-value of the homogeneity below which a name is not confirmed beside something that has no name.
HOMOGENEITY_BESIDE_P = 0.01
#: Unevenness that explains less than this share of the chi-square of a name is its inexact shape, not another effect.
SLIGHTLY_UNEVEN = 0.03
#: A further name whose chi-square is below this share of the largest one is listed as a possible secondary one.
SECONDARY_SHARE = 0.005
#: A generic group in the covariates of a name, with less than this share of its chi-square, is its inexact shape.
SHAPE_SHARE = 0.1
RUNOUT = "tracer_runout_"
#: A name that explains this share of what has no name resembles it.
RESEMBLES = 0.3
#: What is visible of an effect below this counts as invisible.
INVISIBLE = 0.05
#: Names of what the readings' scale does, which any misfit can be reshaped into.
NEVER_CONFIRMED = ("laser_scale",)


@dataclass(frozen=True)
class Named:
    """One named effect of the verdict; ``reasons`` say why the grade is not better."""

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
    """Something without a name: what it depends on, how it acts, its RMS in mm (nan if unknown), in words.

    ``resembles`` is the name that explains most of it in its place, if one explains enough.
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
    """Draw the verdict."""
    scene, evidence = analysis.scene, analysis.evidence
    members = analysis.chosen.members
    names = [g for g in members if scene.groups[g].tier == "named"]
    generic = [g for g in members if scene.groups[g].tier == "generic"]
    jumps = _common_jumps(analysis, names)
    names = [g for g in names if g not in jumps]
    names.sort(key=lambda g: -evidence.chi2[g])
    shapes = {g: owner for g in generic if (owner := _owner(analysis, g, names)) is not None}
    leftover = [g for g in generic if g not in shapes]
    owners = {*shapes.values(), *(_owner(analysis, d.group, names, d.evidence) for d in analysis.evidence.directed)}
    graded = [_graded(analysis, g, leftover, g in owners) for g in names]
    largest = max((item.chi2 for item in graded), default=0.0)
    secondary = [item for item in graded if item.chi2 < SECONDARY_SHARE * largest]
    graded = [item for item in graded if item not in secondary]
    unknown = _unknown(analysis, leftover, jumps, names)
    firm = [item for item in graded if item.grade != "tentative"]
    repeats = analysis.noise.source != "assumed"
    if not repeats:
        firm = [item for item in graded if not _doubtful(item)]
    word: Word = "named" if firm else "unknown" if unknown or graded else "none"
    if word == "unknown" and not unknown:
        unknown = [_resembling(analysis, graded[0])]
    if unknown:
        graded = [_beside(item) for item in graded]
    reasons = [] if repeats else ["no repeats and no stated uncertainty: the noise is assumed, so no name is confirmed"]
    return Verdict(
        word,
        tuple(graded),
        tuple(unknown),
        tuple(secondary),
        _invisible(analysis),
        tuple(reasons),
        tuple(g for g in members if g not in {item.group for item in secondary}),
    )


def _doubtful(item: Named) -> bool:
    return any(not reason.startswith("the noise is assumed") for reason in item.reasons)


def _beside(item: Named) -> Named:
    if item.grade != "confirmed":
        return item
    return Named(**{**item.__dict__, "grade": "beside_unknown"})


def _common_jumps(analysis: Analysis, names: list[int]) -> list[int]:
    """Steps of two or more stations at the same time: the machine or the target jumped, not the stations."""
    steps = [g for g in names if analysis.scene.groups[g].name.startswith("length_step_")]
    spacing = 12 * analysis.noise.spacing
    together = []
    for g in steps:
        at = analysis.scene.groups[g].position
        near = [
            h
            for h in steps
            if h != g and at is not None and abs((analysis.scene.groups[h].position or 0) - at) < spacing
        ]
        if near:
            together.append(g)
    return together


def _owner(analysis: Analysis, generic: int, names: list[int], gain: float | None = None) -> int | None:
    """The named member whose inexact shape a generic group is, if there is one; ``gain`` if it is no member."""
    scene, evidence = analysis.scene, analysis.evidence
    gain = evidence.chi2[generic] if gain is None else gain
    own = plain_covariates(scene.groups[generic].covariates) - {"x", "y", "z"}
    for g in names:
        covariates = plain_covariates(scene.groups[g].covariates)
        if scene.groups[g].name.startswith(RUNOUT):  # a runout of any law is a matter of the angles of its own beam
            covariates |= {"azimuth", "elevation", f"station_{scene.groups[g].name.removeprefix(RUNOUT)}"}
        if own and own <= covariates and gain < SHAPE_SHARE * evidence.chi2[g]:
            return g
    return None


def _graded(analysis: Analysis, group: int, generic: list[int], inexact: bool) -> Named:
    scene, evidence = analysis.scene, analysis.evidence
    name, chi2, p = scene.groups[group].name, evidence.chi2[group], evidence.homogeneity_p[group]
    visible = float(scene.visible[group])
    reasons = []
    slight = evidence.uneven[group] < SLIGHTLY_UNEVEN * chi2
    inexact = inexact or (p < HOMOGENEITY_P and slight)
    if p < (HOMOGENEITY_BESIDE_P if generic else HOMOGENEITY_P) and not (inexact or slight):
        reasons.append(f"does not behave like it everywhere (p = {p:.1e})")
    if evidence.misfits and chi2 < evidence.excess:
        reasons.append("explains less than what remains unexplained")
    failed = [g for g, own in evidence.homogeneity_p.items() if g != group and own < HOMOGENEITY_P]
    share = LEAST_JUMP_SHARE if name == "machine_jump" else LEAST_SHARE
    if generic and chi2 < share * sum(evidence.chi2[g] for g in (*generic, *failed)):
        reasons.append("small beside what has no name")
    if name in NEVER_CONFIRMED or visible < LEAST_VISIBLE:
        reasons.append(f"the plan shows {100 * visible:.1f} % of it only: any misfit could be reshaped into it")
    if excess := _beyond_plausible(analysis, group):
        reasons.append(excess)
    if analysis.noise.source == "assumed":
        reasons.append("the noise is assumed, not measured")
    others = tuple(alternatives(scene, analysis.rules, analysis.chosen, group))
    weight = next((item.weight for item in others if item.name == name), 0.0)
    first = others[0].name if others else name
    return Named(
        first, group, "tentative" if reasons else "confirmed", others[0].weight if others else weight, others, visible,
        chi2, p, tuple(reasons), not inexact,
    )  # fmt: skip


def _beyond_plausible(analysis: Analysis, group: int) -> str:
    """Say that a fitted parameter is far larger than on any machine."""
    item = analysis.scene.groups[group]
    if item.effect is None:
        return ""
    values, covariance, _ = contribution(analysis.scene, analysis.chosen, group)
    u = np.sqrt(np.diag(covariance))
    for parameter, value, own in zip(item.effect.card.parameters, values, u, strict=False):
        size = (abs(value) - 2 * own) / parameter.si_per_unit
        if parameter.plausible > 0 and size > 3 * parameter.plausible:
            return f"its size, {parameter.name} = {value / parameter.si_per_unit:.3g}, is not plausible"
    return ""


def _unknown(analysis: Analysis, generic: list[int], jumps: list[int], names: list[int]) -> list[Unknown]:
    scene, evidence = analysis.scene, analysis.evidence
    strongest = max((evidence.chi2[g] for g in names), default=0.0)
    directed = [d for d in evidence.directed if _owner(analysis, d.group, names, d.evidence) is None]
    shaped = len(directed) < len(evidence.directed) or len(generic) < sum(
        scene.groups[g].tier == "generic" for g in analysis.chosen.members
    )
    shaped = shaped and not directed and evidence.excess < SHAPE_SHARE * strongest
    found = [_of_group(analysis, g) for g in sorted(generic, key=lambda g: -evidence.chi2[g])]
    if jumps:
        at = scene.groups[jumps[0]].position
        found.append(Unknown(("time",), "length", float("nan"), f"common jump of several stations at {at:g} s"))
    if not found and directed:
        for item in directed[:3]:
            group = scene.groups[item.group]
            nearest = _nearest(analysis, item.group, item.evidence)
            found.append(Unknown(group.covariates, group.direction, float("nan"), group.name, item.group, nearest))
    if not found and evidence.lack_of_fit_z > 3.0 and not shaped:
        found.append(Unknown((), "", float("nan"), "lines disagree with the model by more than their repeats do"))
    if evidence.changes_between_runs:
        found.append(Unknown(("run",), "", float("nan"), "not repeatable from run to run"))
    return found


def _of_group(analysis: Analysis, g: int) -> Unknown:
    group: Group = analysis.scene.groups[g]
    shape = contribution(analysis.scene, analysis.chosen, g)[2]
    nearest = _nearest(analysis, g, analysis.evidence.chi2[g])
    return Unknown(group.covariates, group.direction, float(np.sqrt(np.mean(shape**2))), group.name, g, nearest)


def _nearest(analysis: Analysis, generic: int, chi2: float) -> str:
    """Name that explains most in the place of a generic group; none if it explains too little or is there already."""
    scene = analysis.scene
    rest = [g for g in analysis.chosen.members if g != generic]
    present = {scene.groups[g].name for g in rest}
    named = [
        g for g, group in enumerate(scene.groups)
        if group.tier == "named" and scene.size(g) and group.name not in present
    ]  # fmt: skip
    if not named:
        return ""
    own = gains(scene, beside(scene, rest), named)
    best = int(np.argmax(own))
    return scene.groups[named[best]].name if own[best] > RESEMBLES * chi2 else ""


def _resembling(analysis: Analysis, item: Named) -> Unknown:
    group = analysis.scene.groups[item.group]
    text = f"resembles {item.name} but {item.reasons[0] if item.reasons else 'is not certain'}"
    return Unknown(tuple(sorted(plain_covariates(group.covariates))), "", float("nan"), text, None, item.name)


def _invisible(analysis: Analysis) -> tuple[str, ...]:
    """Names that this plan hides: covariate missing or constant, or nothing left beside the base model."""
    scene = analysis.scene
    best: dict[str, float] = {}
    for g, group in enumerate(scene.groups):
        if group.tier == "named":
            best[group.name] = max(best.get(group.name, 0.0), float(scene.visible[g]))
    of_base = {f"squareness_{name[1:]}" for name in SQUARENESS_NAMES if name in analysis.fit.basis.errors}
    hidden = [name for name, share in best.items() if share < INVISIBLE]
    lacking = [name for name in analysis.missing if _applies(analysis, name)]
    return tuple(name for name in (*hidden, *lacking) if name not in of_base)


def _applies(analysis: Analysis, name: str) -> bool:
    """Whether an effect without columns would have some if more had been logged or varied."""
    if name.startswith("lever_"):
        return name.removeprefix("lever_") not in analysis.fit.basis.errors
    readings = analysis.fit.readings
    for covariate in catalogue(readings.stations)[name].card.covariates:
        logged = readings.covariates.get(covariate)
        known = covariate in readings.covariates or covariate.startswith(("temp_", "feed", "load", "time"))
        if known and (logged is None or np.isnan(logged).any() or np.ptp(logged) == 0.0):
            return True
        if covariate.startswith("approach") and readings.approach is None:
            return True
    return False
