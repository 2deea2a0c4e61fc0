"""The result of a diagnosis, and the JSON that holds it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.diagnose.analysis import Analysis
from compgen.diagnose.gap import Gap
from compgen.diagnose.noise import TAU
from compgen.diagnose.refit import Refit, extended_toml, settings_of
from compgen.diagnose.verdict import Named, Unknown, Verdict
from compgen.effects import Card, catalogue
from compgen.effects.what_to_do import what_to_do


@dataclass(frozen=True)
class Classed:
    """Something about the noise or the file that has a name of the catalogue: outliers, a trend of the variance ..."""

    name: str
    parameters: dict[str, float]
    confidence: float
    text: str


@dataclass(frozen=True)
class Diagnosis:
    """What a diagnosis found.

    Parameters
    ----------
    machine : the machine.
    analysis, verdict, refit, gap : the stages; all None if only a gross error was found.
    classed : noise classes and gross errors.
    advice : measurements that would decide or separate, in words.
    changes, against_rms_mm : errors that differ from those that were compared with, and the residual against them.
    notes : what was assumed or left out, in words.
    """

    machine: Machine
    analysis: Analysis
    verdict: Verdict
    refit: Refit
    gap: Gap
    classed: tuple[Classed, ...] = ()
    advice: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    changes: tuple[dict[str, Any], ...] = ()
    against_rms_mm: float | None = None

    @property
    def acceptable(self) -> bool:
        """Whether it is decided, and the gap shrinks on readings left out if something was added."""
        if self.verdict.word == "not_decidable":
            return False
        held_out = self.gap.lines or self.gap.times
        return not self.verdict.named or held_out is None or held_out.shrinks

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        verdict, analysis = self.verdict, self.analysis
        cards = self._cards
        effects = [self._named(item) for item in verdict.named] + [
            {**_classed(item), "what_to_do": what_to_do(cards[item.name])} for item in self.classed
        ]
        word = "named" if verdict.word == "none" and self.classed else verdict.word
        gap: dict[str, Any] = {"train": self.gap.train.to_dict()}
        for key, pair in (
            ("heldout_lines", self.gap.lines),
            ("heldout_stations", self.gap.stations),
            ("heldout_times", self.gap.times),
        ):
            gap[key] = None if pair is None else pair.to_dict()
        gap |= {"noise_floor_um": self.gap.floor_mm / MM_PER_UM, "noise_floor_source": self.gap.floor_source}
        return {
            "verdict": word,
            "effects": effects,
            "unknown": [_unknown(item) for item in verdict.unknown],
            "invisible": list(verdict.invisible),
            "secondary": [self._named(item) for item in verdict.secondary],
            "gap": gap,
            "advice": list(self.advice),
            "reasons": list(verdict.reasons),
            "notes": list(self.notes),
            "noise": self._noise(),
            "evidence": {
                "lack_of_fit_z": analysis.evidence.lack_of_fit_z,
                "run_ratio": analysis.evidence.run_ratio,
                "readings": len(analysis.fit.residual_mm),
                "unknowns": analysis.fit.base_size,
                "groups": len({group.name for group in analysis.scene.groups}),
            },
            **self._against(),
        }

    @cached_property
    def _cards(self) -> dict[str, Card]:
        return {name: effect.card for name, effect in catalogue(self.analysis.fit.readings.stations).items()}

    def _named(self, item: Named) -> dict[str, Any]:
        group = self.analysis.scene.groups[item.group]
        parameters: dict[str, dict[str, float | None]] = {
            p.name: {"value": p.value, "u": p.u} for p in self.refit.parameters.get(item.group, ())
        }
        if item.name != group.name:
            parameters = {}
        for key, value in settings_of(self.analysis, group).items():
            parameters[key] = {"value": value, "u": None}
        return {
            "name": item.name,
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

    def _against(self) -> dict[str, Any]:
        if self.against_rms_mm is None:
            return {}
        return {"against": {"rms_um": self.against_rms_mm / MM_PER_UM, "changes": list(self.changes)}}

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
        """The machine file with the effects that were found; empty without a name or a file."""
        if not self.verdict.named or self.machine.source is None:
            return ""
        groups = [i.group for i in self.verdict.named if i.name == self.analysis.scene.groups[i.group].name]
        return extended_toml(self.machine, self.analysis, self.refit, groups)


def _unknown(item: Unknown) -> dict[str, Any]:
    return {
        "covariates": list(item.covariates),
        "direction": item.direction,
        "rms_um": item.rms_mm / MM_PER_UM if np.isfinite(item.rms_mm) else None,
        "text": item.text,
        "resembles": item.resembles or None,
    }


def _classed(item: Classed) -> dict[str, Any]:
    return {
        "name": item.name,
        "alias_set": [{"name": item.name, "weight": 1.0}],
        "parameters": {key: {"value": value, "u": None} for key, value in item.parameters.items()},
        "confidence": item.confidence,
        "grade": "confirmed",
        "visible_fraction": 1.0,
        "text": item.text,
    }
