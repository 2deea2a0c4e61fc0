"""Diagnose: find where model and measurement disagree, name the effect, add it, and see the gap shrink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.threads import one_thread
from compgen.diagnose.advice import advice_of
from compgen.diagnose.analysis import Analysis, analyse
from compgen.diagnose.base import BaseFit, fit_chosen_base
from compgen.diagnose.gap import gap_of
from compgen.diagnose.gross import correction_of, looks_gross
from compgen.diagnose.measurement import Measurement
from compgen.diagnose.observed import Observed, ObservedDeviations, ObservedLengths
from compgen.diagnose.refit import refit
from compgen.diagnose.result import Classed, Diagnosis
from compgen.diagnose.verdict import verdict_of
from compgen.errors import InputError

Show = Callable[[str], None]

#: Residuals of the base model beyond this, mm, are no errors of a machine.
HOPELESS_MM = 1.0


@dataclass(frozen=True)
class DiagnoseOptions:
    """What a diagnosis may do.

    Parameters
    ----------
    max_effects : most named effects at once.
    effects : names to look for; default the whole catalogue.
    add : names that are added whether they were found or not.
    u_um : standard uncertainty of a reading in um, if it is known; used without repeats.
    """

    max_effects: int = 4
    effects: tuple[str, ...] = ()
    add: tuple[str, ...] = ()
    u_um: float | None = None


def diagnose(
    machine: Machine,
    measurement: Measurement,
    options: DiagnoseOptions | None = None,
    *,
    show: Show = lambda _: None,
) -> Diagnosis:
    """Diagnose a measurement.

    Parameters
    ----------
    machine : chain, travel and which errors its model contains.
    measurement : tracer lengths or measured deviations.
    options : what it may do.
    show : receives the stage in words.

    Raises
    ------
    InputError
        for names that are no effects, and for too few readings.
    """
    chosen = options or DiagnoseOptions()
    with one_thread():
        show("fitting the base model")
        observed = observed_of(machine, measurement)
        fit = fit_chosen_base(observed)
        classed: list[Classed] = []
        before = fit
        if isinstance(observed, ObservedLengths) and looks_gross(observed, fit.rms_mm):
            show("residuals are gross: trying other axes, signs and labels")
            corrected = correction_of(machine, observed.lengths, fit.rms_mm)
            if corrected is not None:
                classed.append(Classed("axis_mapping", {}, 1.0, corrected.text))
                measurement = corrected.lengths
                observed = observed_of(machine, measurement)
                fit = fit_chosen_base(observed)
        freedom = len(observed) - fit.jacobian.shape[1]
        if freedom < 20:
            raise InputError(
                f"{len(observed)} readings leave {freedom} degrees of freedom beside {fit.jacobian.shape[1]} unknowns; "
                "a diagnosis needs at least 20: measure more lines"
            )
        analysis = analyse(
            fit,
            most_named=chosen.max_effects,
            only=(*chosen.effects, *chosen.add) if chosen.effects else (),
            sigma_mm=_sigma_mm(measurement, observed, chosen),
            show=show,
        )
        return _completed(machine, analysis, chosen, show, before, classed)


def observed_of(machine: Machine, measurement: Measurement) -> Observed:
    """Return the measurement as scalar readings."""
    if isinstance(measurement, Lengths):
        return ObservedLengths(machine, measurement)
    return ObservedDeviations(machine, measurement)


def _sigma_mm(measurement: Measurement, observed: Observed, options: DiagnoseOptions) -> FloatArray | None:
    """Standard uncertainty of every reading if it was stated."""
    if options.u_um is not None:
        if not options.u_um > 0:
            raise InputError(f"an uncertainty of {options.u_um:g} um was given; it must be above zero")
        return np.full(len(observed), options.u_um * MM_PER_UM)
    if isinstance(measurement, Lengths):
        own = measurement.covariates.get("u_length_um")
        return None if own is None or np.isnan(own).any() else own * MM_PER_UM
    assert isinstance(observed, ObservedDeviations)
    if measurement.u_mm is None:
        return None
    u = measurement.u_mm[observed.place, observed.component]
    return None if np.isnan(u).any() else np.asarray(u)


def _completed(
    machine: Machine,
    analysis: Analysis,
    options: DiagnoseOptions,
    show: Show,
    before: BaseFit,
    classed: Sequence[Classed],
) -> Diagnosis:
    """Verdict, refit and gap; ``before`` is the fit to the file as it stands."""
    verdict = verdict_of(analysis)
    show("fitting the model with what was found")
    added = [*verdict.added, *_wanted(analysis, options.add, verdict.added)]
    found = refit(analysis, added)
    show("testing on lines, stations and times left out")
    scene = analysis.scene
    columns = [scene.groups[g].columns @ scene.maps[g] for g in added if scene.size(g)]
    predicting = [scene.groups[g].columns @ scene.maps[g] for g in added if scene.groups[g].predicts and scene.size(g)]
    gap = gap_of(analysis.fit, columns, predicting, analysis.noise)
    if before is not analysis.fit:
        gap = replace(gap, train=replace(gap.train, before_mm=before.rms_mm))
    if analysis.fit.rms_mm > HOPELESS_MM:
        text = f"the readings do not fit the commanded positions: {analysis.fit.rms_mm:.3g} mm rms"
        verdict = replace(verdict, word="not_decidable", reasons=(*verdict.reasons, text))
    return Diagnosis(machine, analysis, verdict, found, gap, tuple(classed), advice_of(analysis, verdict))


def _wanted(analysis: Analysis, names: Sequence[str], present: Sequence[int]) -> list[int]:
    """Groups of the names that the user wants added, at their best scan position."""
    scene = analysis.scene
    found = []
    for name in names:
        groups = [g for g, group in enumerate(scene.groups) if group.name == name and group.tier == "named"]
        if not groups:
            known = sorted({group.name for group in scene.groups if group.tier == "named"})
            raise InputError(f"{name!r} cannot be added to this measurement; possible are {', '.join(known)}")
        if not set(groups) & set(present):
            found.append(max(groups, key=lambda g: float(np.sum(scene.score[scene.place(g)] ** 2))))
    return found
