"""The diagnosis as a result: effects refitted in the full model, the misfit before and after, the JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.files import read_text
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.diagnose.analysis import Analysis
from compgen.diagnose.base_fit import BaseFit, fit_base
from compgen.diagnose.groups import Group
from compgen.diagnose.layout import IntArray
from compgen.diagnose.noise_model import TAU, Noise, difference_matrix
from compgen.diagnose.search import Design
from compgen.diagnose.verdict import DisplayedDiagnosis, Named, Unknown, Verdict
from compgen.effects import Card, Effect, Readings, catalogue
from compgen.effects.active import section_text
from compgen.effects.all_effects import belongs_to, what_to_do
from compgen.errors import one_line

# The full nonlinear model including the effects: their parameters with uncertainty, and the extended machine file.


class FixedColumns(Effect):
    """An unnamed smooth term, with its columns from the base fit."""

    def __init__(self, group: Group, mapping: FloatArray) -> None:
        self.card = Card(group.name, group.name, "", "", group.covariates, ())
        self._columns = group.columns @ mapping

    def columns(self, readings: Readings) -> FloatArray:
        """The columns from the base fit; station shifts of some um do not affect them."""
        return self._columns


@dataclass(frozen=True)
class Fitted:
    """A parameter in the unit of its name, with its standard uncertainty."""

    name: str
    value: float
    u: float


@dataclass(frozen=True)
class Refit:
    """The nonlinear fit including the effects, and the parameters of each effect, keyed by group."""

    fit: BaseFit
    parameters: dict[int, tuple[Fitted, ...]]


def refit(analysis: Analysis, members: Sequence[int]) -> Refit:
    """Fit base model and members together, weighted by the noise model."""
    design = analysis.design
    members = [g for g in members if design.size(g)]
    effects = [design.groups[g].effect or FixedColumns(design.groups[g], design.maps[g]) for g in members]
    fit = fit_base(
        analysis.fit.observed,
        analysis.fit.basis,
        effects,
        start=analysis.fit.unknowns,
        whiten=design.whiten,
        steps=3,
    )
    return Refit(fit, _parameters(design, fit, members))


def _parameters(design: Design, fit: BaseFit, members: Sequence[int]) -> dict[int, tuple[Fitted, ...]]:
    if not members:
        return {}
    white = design.whiten(fit.jacobian)
    residual = design.whiten(fit.residual_mm)
    norm = np.linalg.norm(white, axis=0)
    norm[norm == 0.0] = 1.0
    square, vectors = np.linalg.eigh((white / norm).T @ (white / norm))
    kept = square > 1e-10 * square[-1]
    inverse = (vectors[:, kept] / square[kept]) @ vectors[:, kept].T
    freedom = max(len(residual) - int(kept.sum()), 1)
    factor = max(1.0, float(residual @ residual) / freedom)
    u = np.sqrt(np.maximum(np.diag(inverse) * factor, 0.0)) / norm
    at, found = fit.base_size, {}
    for group, (effect, count) in zip(members, fit.effects, strict=True):
        values, own = fit.unknowns[at : at + count], u[at : at + count]
        names = effect.card.parameters
        if len(names) == count:
            fitted = [
                Fitted(p.name, float(v) / p.si_per_unit, float(w) / p.si_per_unit)
                for p, v, w in zip(names, values, own, strict=True)
            ]
        else:
            fitted = [Fitted(f"c{k + 1}", float(v), float(w)) for k, (v, w) in enumerate(zip(values, own, strict=True))]
        found[group] = tuple(fitted)
        at += count
    return found


def extended_toml(machine: Machine, analysis: Analysis, found: Refit, groups: Sequence[int]) -> str:
    """Return the machine file with a section ``[effects.NAME]`` for each of the named ``groups``."""
    text = read_text(machine.source) if machine.source is not None else ""
    lines = [text.rstrip("\n"), ""]
    for group in groups:
        item = analysis.design.groups[group]
        assert item.effect is not None
        fitted = found.parameters.get(group, ())
        values = [p.value * own.si_per_unit for p, own in zip(fitted, item.effect.card.parameters, strict=True)]
        u = ", ".join(f"{p.name} {p.u:.2g}" for p in fitted)
        lines += ["", f"# found by volcomp diagnose: {one_line(item.effect.card.title)}; standard uncertainty {u}"]
        lines.append(section_text(item.effect, found.fit.readings, np.array(values)).rstrip("\n"))
    return "\n".join(lines) + "\n"


def settings_of(analysis: Analysis, item: Group) -> dict[str, float]:
    """Settings of an effect that apply to the readings and must be stored in the machine file."""
    return {} if item.effect is None else item.effect.used(analysis.fit.readings)


# Does the misfit shrink? Residuals before and after, for the readings used and for left-out lines, stations and times.
#
# Unweighted least squares on all but the left-out part; columns that are zero on the rest (a dead length, a station)
# are fitted to the left-out part, because no other readings determine them.


FOLDS = 5
#: Least number of remaining stations that still determine the errors.
LEAST_STATIONS = 3
#: Eigenvalues of the scaled normal matrix below this contain no information.
LEAST_EIGENVALUE = 1e-9


@dataclass(frozen=True)
class BeforeAfter:
    """RMS of the residuals without and with the added columns, mm."""

    before_mm: float
    after_mm: float

    def to_dict(self) -> dict[str, float]:
        """Values in um, as in ``diagnosis.json``."""
        return {"before_rms_um": self.before_mm / MM_PER_UM, "after_rms_um": self.after_mm / MM_PER_UM}

    @property
    def shrinks(self) -> bool:
        """Whether the added columns make the residual smaller."""
        return self.after_mm < self.before_mm


@dataclass(frozen=True)
class MisfitBeforeAfter:
    """The misfit of the readings used and of left-out parts; None where it cannot be computed."""

    train: BeforeAfter
    lines: BeforeAfter | None
    stations: BeforeAfter | None
    times: BeforeAfter | None
    floor_mm: float
    floor_source: str
    residual_before_mm: FloatArray
    residual_after_mm: FloatArray


def misfit_before_after(
    fit: BaseFit,
    added: Sequence[FloatArray],
    predicting: Sequence[FloatArray],
    noise: Noise,
    base: Sequence[FloatArray] = (),
) -> MisfitBeforeAfter:
    """Compute the misfit.

    Parameters
    ----------
    fit : the base fit.
    added : columns (n, k) of everything that was added.
    predicting : the added columns that can predict left-out readings.
    noise : the noise model.
    base : further columns of the base model, included before and after.
    """
    count = len(fit.residual_mm)
    columns = np.hstack([fit.jacobian[:, : fit.base_size], *base])
    weight = 1.0 / noise.scale
    everything = _Problem(columns, _hstack(added, count), fit.residual_mm, weight)
    before, after = everything.fitted(False), everything.fitted(True)
    same = len(predicting) == len(added)
    some = everything if same else _Problem(columns, _hstack(predicting, count), fit.residual_mm, weight)
    layout = fit.observed.layout
    # whole conditions: both repeats of a line are left out together
    kinds, lines = int(layout.condition.max()) + 1, None
    if kinds >= 2 * FOLDS:
        order = np.random.default_rng(0).permutation(kinds)
        lines = np.asarray((order % FOLDS)[layout.condition[layout.stop]], dtype=np.int64)
    stations = layout.channel if len(fit.readings.stations) > LEAST_STATIONS else None
    # standard deviation from the repeats, otherwise from the noise model
    if noise.source == "repeats":
        squares, size = 0.0, 0
        for block in layout.blocks:
            values = difference_matrix(layout, block) @ after[block.rows]
            squares += float(np.sum(values**2))
            size += values.size
        floor = float(np.sqrt(squares / max(size, 1)))
    else:
        floor = float(np.sqrt(noise.variances.total))
    return MisfitBeforeAfter(
        _rms_pair(before, after),
        some.left_out(lines),
        None if stations is None else some.left_out(stations),
        some.left_out(_time_folds(fit)),
        floor,
        noise.source,
        before,
        after,
    )


def _hstack(columns: Sequence[FloatArray], count: int) -> FloatArray:
    return np.hstack(columns) if columns else np.zeros((count, 0))


def _time_folds(fit: BaseFit) -> IntArray | None:
    """Fold of each reading: time blocks of the file, otherwise quarters of the time."""
    block = fit.readings.labels.get("block")
    if block is not None and len(np.unique(block)) > 2:
        return np.unique(block, return_inverse=True)[1].ravel().astype(np.int64)
    layout = fit.observed.layout
    if layout.stops < 8:
        return None
    if fit.readings.kind == "axis":
        return (layout.run[layout.stop] % 4).astype(np.int64)
    return np.minimum(layout.stop * 4 // layout.stops, 3).astype(np.int64)


def _rms_pair(before: FloatArray, after: FloatArray) -> BeforeAfter:
    return BeforeAfter(float(np.sqrt(np.mean(before**2))), float(np.sqrt(np.mean(after**2))))


class _Problem:
    """Linear least squares with base columns and added columns, using one normal matrix."""

    def __init__(self, base: FloatArray, added: FloatArray, residual: FloatArray, weight: FloatArray) -> None:
        self.base = base.shape[1]
        columns = np.hstack([base, added])
        self.norm = np.linalg.norm(columns, axis=0)
        self.columns = columns / np.maximum(self.norm, 1e-300)
        self.residual, self.weight = residual, weight
        self._weighted = self.columns * weight[:, None]
        self._target = residual * weight
        self.normal, self.right = self._weighted.T @ self._weighted, self._weighted.T @ self._target

    def _sizes(self, added: bool) -> int:
        return int(self.columns.shape[1]) if added else self.base

    def fitted(self, added: bool) -> FloatArray:
        """Residuals after a fit to all readings, (n,)."""
        k = self._sizes(added)
        return np.asarray(self.residual - self.columns[:, :k] @ _solve(self.normal[:k, :k], self.right[:k]))

    def left_out(self, fold: IntArray | None) -> BeforeAfter | None:
        """RMS over all folds, each predicted from the others; None without folds."""
        if fold is None or len(np.unique(fold)) < 2:
            return None
        before, after = np.empty_like(self.residual), np.empty_like(self.residual)
        for k in np.unique(fold):
            rows = np.flatnonzero(fold == k)
            own, columns = self._weighted[rows], self.columns[rows]
            square, right = own.T @ own, own.T @ self._target[rows]
            for left, added in ((before, False), (after, True)):
                size = self._sizes(added)
                left[rows] = self._predicted(rows, columns[:, :size], square[:size, :size], right[:size])
        return _rms_pair(before, after)

    def _predicted(self, rows: IntArray, columns: FloatArray, square: FloatArray, seen: FloatArray) -> FloatArray:
        """Residuals of ``rows``, with ``columns`` (m, k), after a fit to the others; what these rows add to the normals."""
        k = columns.shape[1]
        normal, right = self.normal[:k, :k] - square, self.right[:k] - seen
        unseen = np.diag(normal) < 1e-9 * np.maximum(np.diag(self.normal)[:k], 1e-300)
        known = ~unseen
        solution = np.zeros(k)
        solution[known] = _solve(normal[np.ix_(known, known)], right[known])
        left = self.residual[rows] - columns @ solution
        if unseen.any():
            part = columns[:, unseen] * self.weight[rows][:, None]
            left = left - columns[:, unseen] @ _solve(part.T @ part, part.T @ (left * self.weight[rows]))
        return np.asarray(left)


def _solve(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of normal equations without the directions that contain no information."""
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    square, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    kept = square > LEAST_EIGENVALUE * max(float(square[-1]), 1e-300)
    turned = vectors[:, kept].T @ (right / scale)
    return np.asarray((vectors[:, kept] @ (turned / square[kept])) / scale)


# The result of a diagnosis, and its JSON.


@dataclass(frozen=True)
class Classed:
    """A property of the noise or the file with a name in the catalogue: outliers, a trend of the variance ..."""

    name: str
    parameters: dict[str, float]
    confidence: float
    text: str


@dataclass(frozen=True, repr=False)
class Diagnosis(DisplayedDiagnosis):
    """Findings of a diagnosis.

    Parameters
    ----------
    machine : the machine.
    analysis, verdict, refit, misfit : the results of the steps.
    classed : noise classes and gross errors.
    advice : texts on measurements that would decide between or separate effects.
    changes, against_rms_mm : errors that differ from the predicted ones, and the residual against the prediction.
    notes : texts on what was assumed or left out.
    """

    machine: Machine
    analysis: Analysis
    verdict: Verdict
    refit: Refit
    misfit: MisfitBeforeAfter
    classed: tuple[Classed, ...] = ()
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    changes: tuple[dict[str, Any], ...] = ()
    against_rms_mm: float | None = None

    @property
    def acceptable(self) -> bool:
        """Whether the verdict is decided and, if something was added, the misfit of left-out readings shrinks."""
        if self.verdict.word == "not_decidable":
            return False
        left_out = self.misfit.lines or self.misfit.times
        return not self.verdict.named or left_out is None or left_out.shrinks

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        verdict, analysis, against = self.verdict, self.analysis, self.against_rms_mm
        cards = self._cards
        effects = [self._named(item) for item in verdict.named] + [
            {
                "name": item.name,
                "alias_set": [{"name": item.name, "weight": 1.0}],
                "parameters": {key: {"value": value, "u": None} for key, value in item.parameters.items()},
                "confidence": item.confidence,
                "grade": "confirmed",
                "visible_fraction": 1.0,
                "text": item.text,
                "what_to_do": what_to_do(cards[item.name]),
            }
            for item in self.classed
        ]
        word = "named" if verdict.word == "none" and self.classed else verdict.word
        misfit: dict[str, Any] = {"train": self.misfit.train.to_dict()}
        for key, pair in (
            ("heldout_lines", self.misfit.lines),
            ("heldout_stations", self.misfit.stations),
            ("heldout_times", self.misfit.times),
        ):
            misfit[key] = None if pair is None else pair.to_dict()
        misfit |= {"noise_floor_um": self.misfit.floor_mm / MM_PER_UM, "noise_floor_source": self.misfit.floor_source}
        return {
            "verdict": word,
            "effects": effects,
            "unknown": [_unknown(item) for item in verdict.unknown],
            "invisible": list(verdict.invisible),
            "secondary": [self._named(item) for item in verdict.secondary],
            "gap": misfit,
            "advice": list(self.advice),
            "reasons": list(verdict.reasons),
            "notes": list(self.notes),
            "noise": self._noise(),
            "evidence": {
                "lack_of_fit_z": analysis.support.lack_of_fit_z,
                "run_ratio": analysis.support.run_ratio,
                "readings": len(analysis.fit.residual_mm),
                "unknowns": analysis.fit.base_size,
                "groups": len({group.name for group in analysis.design.groups}),
            },
            **({} if against is None else {"against": {"rms_um": against / MM_PER_UM, "changes": list(self.changes)}}),
        }

    @cached_property
    def _cards(self) -> dict[str, Card]:
        return {name: effect.card for name, effect in catalogue(self.analysis.fit.readings.stations).items()}

    def _named(self, item: Named) -> dict[str, Any]:
        group = self.analysis.design.groups[item.group]
        parameters: dict[str, dict[str, float | None]] = {
            p.name: {"value": p.value, "u": p.u} for p in self.refit.parameters.get(item.group, ())
        }
        for key, value in settings_of(self.analysis, group).items():
            parameters[key] = {"value": value, "u": None}
        return {
            "name": item.name,
            "belongs_to": belongs_to(item.name),
            "what_to_do": what_to_do(self._cards[item.name]),
            "alias_set": [{"name": other.name, "weight": round(other.weight, 4)} for other in item.alternatives],
            "parameters": parameters,
            "confidence": round(item.confidence, 4),
            "grade": item.grade,
            "visible_fraction": round(item.visible, 4),
            "chi2": item.chi2,
            "homogeneity_p": item.homogeneity_p,
            "shape_exact": item.shape_exact,
            "reasons": list(item.reasons),
        }

    def _noise(self) -> dict[str, Any]:
        noise = self.analysis.noise
        v = noise.variances
        return {
            "white_um": float(np.sqrt(v.white)) / MM_PER_UM,
            "own_slow_um": {
                f"{tau * noise.spacing:g} s": float(np.sqrt(x)) / MM_PER_UM for tau, x in zip(TAU, v.own, strict=False)
            },
            "common_slow_um": {
                f"{tau * noise.spacing:g} s": float(np.sqrt(x)) / MM_PER_UM
                for tau, x in zip(TAU, v.common, strict=False)
            },
            "run_to_run_um": float(np.sqrt(v.own[-2:].sum() + v.common[-2:].sum())) / MM_PER_UM,
            "grows_with_range": bool(np.ptp(noise.scale) > 0),
            "source": noise.source,
        }

    def extended(self) -> str:
        """The machine file with the effects of the machine; empty without any or without a file.

        Tentative ones are never written, nor what belongs to the instrument or to this session: in the next measurement it
        would be an error.
        """
        return self._written({"machine"})

    def session(self) -> str:
        """The same with everything that is in these readings, if anything of it belongs to instrument or session."""
        own = {belongs_to(item.name) for item in self.verdict.named if item.grade != "tentative"}
        return self._written({"machine", "setup", "session"}) if own & {"setup", "session"} else ""

    def _written(self, classes: set[str]) -> str:
        if self.machine.source is None:
            return ""
        groups = [
            item.group for item in self.verdict.named if item.grade != "tentative" and belongs_to(item.name) in classes
        ]
        return extended_toml(self.machine, self.analysis, self.refit, groups) if groups else ""


def _unknown(item: Unknown) -> dict[str, Any]:
    return {
        "covariates": list(item.covariates),
        "direction": item.direction,
        "rms_um": item.rms_mm / MM_PER_UM if np.isfinite(item.rms_mm) else None,
        "text": item.text,
        "resembles": item.resembles or None,
    }
