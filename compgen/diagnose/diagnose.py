"""Diagnose: find where model and measurement disagree, name the effect, add it, and see the gap shrink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from compgen.core.axis_runs import AxisRuns
from compgen.core.csvio import FloatArray
from compgen.core.deviations import Deviations
from compgen.core.error_table import ErrorTable
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM
from compgen.core.text import nearest
from compgen.core.threads import one_thread
from compgen.diagnose.advice import advice_of
from compgen.diagnose.against import compared
from compgen.diagnose.analysis import Analysis, analyse
from compgen.diagnose.axis_diagnosis import AxisDiagnosis, findings_of
from compgen.diagnose.axis_session import Order
from compgen.diagnose.base import BaseFit
from compgen.diagnose.base_choice import fit_smooth
from compgen.diagnose.classes import classes_of, disturbed_class, disturbed_readings, gross_readings
from compgen.diagnose.gap import gap_of
from compgen.diagnose.gross import correction_of, looks_gross
from compgen.diagnose.measurement import Measurement
from compgen.diagnose.observed import Observed, ObservedDeviations, ObservedLengths
from compgen.diagnose.refit import refit
from compgen.diagnose.result import Classed, Diagnosis
from compgen.diagnose.verdict import verdict_of
from compgen.effects import catalogue
from compgen.effects.of_machine import active_effects
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
    against : predicted errors that the measurement is compared with.
    leave_out_disturbed : leave out bursts of disturbed readings (lengths and deviations) once they are found.
    order : order of axis runs in time: as logged, else run by run, up then down; or what the user says.
    """

    max_effects: int = 4
    effects: tuple[str, ...] = ()
    add: tuple[str, ...] = ()
    u_um: float | None = None
    against: ErrorTable | None = None
    order: Order = "auto"
    leave_out_disturbed: bool = False


def diagnose(
    machine: Machine,
    measurement: Measurement,
    options: DiagnoseOptions | None = None,
    *,
    show: Show = lambda _: None,
) -> Diagnosis | AxisDiagnosis:
    """Diagnose a measurement.

    Parameters
    ----------
    machine : chain, travel and which errors its model contains.
    measurement : tracer lengths, measured deviations, or axis runs.
    options : what it may do.
    show : receives the stage in words.

    Raises
    ------
    InputError
        for names that are no effects, and for too few readings.
    """
    chosen = options or DiagnoseOptions()
    known = catalogue(measurement.stations if isinstance(measurement, Lengths) else ())
    for name in chosen.effects:
        if name not in known:
            raise InputError(
                f"{name!r} is not an effect of this measurement; {nearest(name, known)}", field="--effects"
            )
    if isinstance(measurement, AxisRuns):
        found = findings_of(
            machine, measurement, order=chosen.order, most=chosen.max_effects, only=chosen.effects, add=chosen.add,
            u_um=chosen.u_um, against=chosen.against, show=show,
        )  # fmt: skip
        return AxisDiagnosis(machine, measurement, tuple(found))
    if chosen.order != "auto":
        raise InputError("--order belongs to axis runs; the rows of other measurements are ordered by time_s")
    with one_thread():
        show("fitting the base model")
        observed = observed_of(machine, measurement)
        fit = _base(observed)
        classed: list[Classed] = []
        before = fit
        if isinstance(observed, ObservedLengths) and looks_gross(observed, fit.rms_mm):
            show("residuals are gross: trying other axes, signs and labels")
            corrected = correction_of(machine, observed.lengths, fit.rms_mm)
            if corrected is not None:
                classed.append(Classed("axis_mapping", {}, 1.0, corrected.text))
                measurement = corrected.lengths
                observed = observed_of(machine, measurement)
                fit = _base(observed)
        freedom = len(observed) - fit.jacobian.shape[1]
        if freedom < 20:
            raise InputError(
                f"{len(observed)} readings leave {freedom} degrees of freedom beside {fit.jacobian.shape[1]} unknowns; "
                "a diagnosis needs at least 20: measure more lines"
            )
        analysis = _analysed(measurement, observed, fit, chosen, show)
        before = analysis.fit if before is fit else before
        gross = gross_readings(analysis)
        if len(gross):
            show(f"leaving out {len(gross)} gross readings")
            observed = observed.part(np.setdiff1d(np.arange(len(observed)), gross))
            plain = before is analysis.fit
            analysis = _analysed(measurement, observed, _base(observed), chosen, show)
            before = analysis.fit if plain else before
        bursts = disturbed_readings(analysis)
        classed += disturbed_class(bursts, left_out=chosen.leave_out_disturbed)
        if bursts and chosen.leave_out_disturbed:
            show("leaving out disturbed readings")
            loud = np.concatenate([burst.rows for burst in bursts])
            observed = observed.part(np.setdiff1d(np.arange(len(observed)), loud))
            analysis = _analysed(measurement, observed, _base(observed), chosen, show)
        return _completed(machine, analysis, chosen, show, before, classed, len(gross))


def _base(observed: Observed) -> BaseFit:
    """Fit the base model, with what the machine file switches on taken off the readings."""
    fit = fit_smooth(observed)
    known = [effect.change_mm(fit.readings) for effect in active_effects(observed.machine)]
    present = [change for change in known if change is not None]
    if not present:
        return fit
    observed.value_mm = observed.value_mm - sum(present)
    return fit_smooth(observed)


def _analysed(
    measurement: Lengths | Deviations, observed: Observed, fit: BaseFit, options: DiagnoseOptions, show: Show
) -> Analysis:
    return analyse(
        fit,
        most_named=options.max_effects,
        only=(*options.effects, *options.add) if options.effects else (),
        sigma_mm=_sigma_mm(measurement, observed, options),
        show=show,
    )


def observed_of(machine: Machine, measurement: Lengths | Deviations) -> Observed:
    """Return the measurement as scalar readings."""
    if isinstance(measurement, Lengths):
        return ObservedLengths(machine, measurement)
    return ObservedDeviations(machine, measurement)


def _sigma_mm(measurement: Lengths | Deviations, observed: Observed, options: DiagnoseOptions) -> FloatArray | None:
    """Standard uncertainty of every reading if it was stated."""
    if options.u_um is not None:
        if not options.u_um > 0:
            raise InputError(f"an uncertainty of {options.u_um:g} um was given; it must be above zero")
        return np.full(len(observed), options.u_um * MM_PER_UM)
    if isinstance(observed, ObservedLengths):
        own = observed.lengths.covariates.get("u_length_um")
        return None if own is None or np.isnan(own).any() else own * MM_PER_UM
    if not isinstance(observed, ObservedDeviations) or not isinstance(measurement, Deviations):
        return None
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
    removed: int,
) -> Diagnosis:
    """Verdict, refit and gap; ``before`` is the fit to the file as it stands."""
    verdict = verdict_of(analysis)
    show("fitting the model with what was found")
    added = [*verdict.added, *_wanted(analysis, options.add, verdict.added)]
    found = refit(analysis, added)
    show("testing on lines, stations and times left out")
    scene = analysis.scene
    seen = {g: scene.groups[g].columns @ scene.maps[g] for g in added if scene.size(g)}
    base = [columns for g, columns in seen.items() if scene.groups[g].tier == "base"]
    columns = [columns for g, columns in seen.items() if scene.groups[g].tier != "base"]
    predicting = [columns for g, columns in seen.items() if scene.groups[g].tier != "base" and scene.groups[g].predicts]
    gap = gap_of(analysis.fit, columns, predicting, analysis.noise, base)
    if before is not analysis.fit:
        gap = replace(gap, train=replace(gap.train, before_mm=before.rms_mm))
    if analysis.fit.rms_mm > HOPELESS_MM:
        text = f"the readings do not fit the commanded positions: {analysis.fit.rms_mm:.3g} mm rms"
        verdict = replace(verdict, word="not_decidable", reasons=(*verdict.reasons, text))
    advice = advice_of(analysis, verdict)
    observed = analysis.fit.observed
    classes = [*classed, *classes_of(analysis, removed)]
    done = Diagnosis(machine, analysis, verdict, found, gap, tuple(classes), advice)
    if options.against is not None:
        against = compared(observed, analysis, options.against)
        done = replace(done, changes=against.changes, against_rms_mm=against.rms_mm)
    return done


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
