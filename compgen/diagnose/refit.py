"""The full nonlinear model with the effects inside: their parameters with uncertainty, and the extended machine file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.files import read_text
from compgen.core.machine import Machine
from compgen.core.text import one_line
from compgen.diagnose.analysis import Analysis
from compgen.diagnose.base import BaseFit, fit_base
from compgen.diagnose.groups import Group
from compgen.diagnose.scene import Scene
from compgen.effects import Card, Effect, Readings
from compgen.effects.of_machine import section_text


class FixedColumns(Effect):
    """A smooth term without a name, with the columns that it had at the base fit."""

    def __init__(self, group: Group, mapping: FloatArray) -> None:
        self.card = Card(group.name, group.name, "", "", group.covariates, ())
        self._columns = group.columns @ mapping

    def columns(self, readings: Readings) -> FloatArray:
        """The columns of the base fit; a change of the stations by um does not matter to them."""
        return self._columns


@dataclass(frozen=True)
class Fitted:
    """A parameter in the unit of its name, with its standard uncertainty."""

    name: str
    value: float
    u: float


@dataclass(frozen=True)
class Refit:
    """The nonlinear fit with the effects inside, and the parameters of each by its group."""

    fit: BaseFit
    parameters: dict[int, tuple[Fitted, ...]]


def refit(analysis: Analysis, members: Sequence[int]) -> Refit:
    """Fit base model and members together with the noise model as weight."""
    scene = analysis.scene
    members = [g for g in members if scene.size(g)]
    effects = [_effect_of(scene, g) for g in members]
    fit = fit_base(
        analysis.fit.observed,
        analysis.fit.basis,
        effects,
        start=analysis.fit.unknowns,
        whiten=scene.whiten,
        steps=3,
    )
    return Refit(fit, _parameters(scene, fit, members))


def _effect_of(scene: Scene, group: int) -> Effect:
    item = scene.groups[group]
    return item.effect if item.effect is not None else FixedColumns(item, scene.maps[group])


def _parameters(scene: Scene, fit: BaseFit, members: Sequence[int]) -> dict[int, tuple[Fitted, ...]]:
    if not members:
        return {}
    white = scene.whiten(fit.jacobian)
    residual = scene.whiten(fit.residual_mm)
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
        item = analysis.scene.groups[group]
        assert item.effect is not None
        fitted = found.parameters.get(group, ())
        values = [p.value * own.si_per_unit for p, own in zip(fitted, item.effect.card.parameters, strict=True)]
        u = ", ".join(f"{p.name} {p.u:.2g}" for p in fitted)
        lines += ["", f"# found by volcomp diagnose: {one_line(item.effect.card.title)}; standard uncertainty {u}"]
        lines.append(section_text(item.effect, found.fit.readings, np.array(values)).rstrip("\n"))
    return "\n".join(lines) + "\n"


def settings_of(analysis: Analysis, item: Group) -> dict[str, float]:
    """Settings of an effect that hold for the readings: what a machine file has to keep."""
    return {} if item.effect is None else item.effect.used(analysis.fit.readings)
