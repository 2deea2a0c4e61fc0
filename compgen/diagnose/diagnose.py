"""Diagnose: find where model and measurement disagree, name the effect, add it, and see the misfit shrink."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from compgen.data.axis_runs import AxisRuns
from compgen.data.circles import Circles
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Deviations
from compgen.data.error_table import ErrorTable
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.messages import nearest
from compgen.data.names import MM_PER_UM
from compgen.data.toml_files import option
from compgen.diagnose.analysis import Analysis, analyse
from compgen.diagnose.axis_diagnosis import LEAST_FREEDOM, AxisDiagnosis, findings_of
from compgen.diagnose.axis_session import Order
from compgen.diagnose.base_fit import BaseFit
from compgen.diagnose.circle_diagnosis import CircleDiagnosis, diagnose_circles
from compgen.diagnose.diagnosis import Classed, Diagnosis, misfit_before_after, refit
from compgen.diagnose.gross import (
    classes_of,
    correction_of,
    disturbed_class,
    disturbed_readings,
    gross_readings,
    looks_gross,
)
from compgen.diagnose.groups import fit_smooth
from compgen.diagnose.observed import Measurement, Observed, ObservedDeviations, ObservedLengths
from compgen.diagnose.verdict import advice_of, compared, verdict_of
from compgen.effects import catalogue
from compgen.effects.active import active_effects
from compgen.errors import InputError
from compgen.instruments.sixdof_health import Suspicion, sixdof_health
from compgen.instruments.sixdof_instrument import SixDofInstrument
from compgen.instruments.sixdof_readings import SixDof
from compgen.kinematics.kernel_switch import one_thread

# The steps of a diagnosis, and the diagnosis of six-DOF readings.


Show = Callable[[str], None]

#: Residuals of the base model larger than this, mm, are not machine errors.
HOPELESS_MM = 1.0


@dataclass(frozen=True)
class DiagnoseOptions:
    """What a diagnosis may do.

    Parameters
    ----------
    max_effects : maximum number of named effects.
    effects : names to look for; default the whole catalogue.
    add : names to add whether found or not.
    u_um : standard uncertainty of a reading in um, if known; used without repeats.
    against : predicted errors that the measurement is compared with.
    leave_out_disturbed : leave out bursts of disturbed readings (lengths and deviations) that are found.
    order : time order of axis runs: as logged, otherwise run by run, up then down; or as requested by the user.
    """

    max_effects: int = option(4, "Largest number of effects to name.", within=(0, 6))
    effects: tuple[str, ...] = option(
        (), "Look only for these effects; default: the whole catalogue.", metavar="NAME,..."
    )
    add: tuple[str, ...] = option((), "Add this effect whether it was found or not.", metavar="NAME")
    u_um: float | None = option(None, "Standard uncertainty of a reading, um; used if no line was repeated.")
    against: ErrorTable | None = option(
        None,
        "Errors (*.errors.csv) to compare the measurement with, to show which have changed.",
        metavar="ERRORS",
    )
    order: Order = option(
        "auto",
        "Time order of axis runs: by time_s or the column order, else run by run, up then down (auto); or as named. The "
        "order of the rows is used only with 'rows'.",
    )
    leave_out_disturbed: bool = option(False, "Leave out short bursts of disturbed readings once they are found.")


def diagnose(
    machine: Machine,
    measurement: Measurement,
    options: DiagnoseOptions | None = None,
    *,
    show: Show = lambda _: None,
) -> Diagnosis | AxisDiagnosis | CircleDiagnosis:
    """Diagnose a measurement.

    Parameters
    ----------
    machine : kinematic chain, travel, and the errors that its model contains.
    measurement : tracer lengths, measured deviations, axis runs, or circles.
    options : options of the diagnosis.
    show : called with a description of each step.

    Raises
    ------
    InputError
        for names that are not effects, and for too few readings.
    """
    chosen = options or DiagnoseOptions()
    if chosen.order != "auto" and not isinstance(measurement, AxisRuns):
        raise InputError("--order applies to axis runs only; other measurements are ordered by time_s")
    if isinstance(measurement, Circles):
        if chosen.against is not None:
            raise InputError("--against cannot be used with circles; identify them, and compare the errors")
        return diagnose_circles(
            machine,
            measurement,
            most=chosen.max_effects,
            only=chosen.effects,
            add=chosen.add,
            u_um=chosen.u_um,
            show=show,
        )
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
    with one_thread():
        show("fitting the base model")
        observed = observed_of(machine, measurement)
        fit = _base(observed)
        classed: list[Classed] = []
        before = fit
        _refuse_too_few(fit)  # before the search, which is slow
        if isinstance(observed, ObservedLengths) and looks_gross(observed, fit.rms_mm):
            show("residuals are very large: trying other axes, signs and labels")
            corrected = correction_of(machine, observed.lengths, fit.rms_mm)
            if corrected is not None:
                classed.append(Classed("axis_mapping", {}, 1.0, corrected.text))
                measurement = corrected.lengths
                observed = observed_of(machine, measurement)
                fit = _base(observed)
        _refuse_too_few(fit)
        analysis = _analysed(observed, fit, chosen, show)
        before = analysis.fit if before is fit else before
        gross = gross_readings(analysis)
        if len(gross):
            show(f"leaving out {len(gross)} gross readings")
            observed = observed.part(np.setdiff1d(np.arange(len(observed)), gross))
            plain = before is analysis.fit
            analysis = _analysed(observed, _base(observed), chosen, show)
            before = analysis.fit if plain else before
        bursts = disturbed_readings(analysis)
        classed += disturbed_class(bursts, left_out=chosen.leave_out_disturbed)
        if bursts and chosen.leave_out_disturbed:
            show("leaving out disturbed readings")
            loud = np.concatenate([burst.rows for burst in bursts])
            observed = observed.part(np.setdiff1d(np.arange(len(observed)), loud))
            analysis = _analysed(observed, _base(observed), chosen, show)
        return _completed(machine, analysis, chosen, show, before, classed, len(gross))


def _refuse_too_few(fit: BaseFit) -> None:
    freedom = len(fit.observed) - fit.jacobian.shape[1]
    if freedom < LEAST_FREEDOM:
        raise InputError(
            f"{len(fit.observed)} readings with {fit.jacobian.shape[1]} unknowns leave {freedom} degrees of freedom; "
            f"a diagnosis needs at least {LEAST_FREEDOM}: measure more lines"
        )


def _base(observed: Observed) -> BaseFit:
    """Fit the base model after subtracting the effects enabled in the machine file from the readings."""
    fit = fit_smooth(observed)
    known = [effect.change_mm(fit.readings) for effect in active_effects(observed.machine)]
    present = [change for change in known if change is not None]
    if not present:
        return fit
    return fit_smooth(observed.minus(np.sum(present, axis=0)))


def _analysed(observed: Observed, fit: BaseFit, options: DiagnoseOptions, show: Show) -> Analysis:
    # standard uncertainty of every reading, if stated
    sigma_mm: FloatArray | None = None
    if options.u_um is not None:
        if not options.u_um > 0:
            raise InputError(f"an uncertainty of {options.u_um:g} um was given; it must be above zero")
        sigma_mm = np.full(len(observed), options.u_um * MM_PER_UM)
    elif isinstance(observed, ObservedLengths) and "u_length_um" in observed.lengths.covariates:
        sigma_mm = observed.lengths.covariates["u_length_um"] * MM_PER_UM
    elif isinstance(observed, ObservedDeviations) and observed.deviations.u_mm is not None:
        sigma_mm = observed.deviations.u_mm[observed.place, observed.component]
    if sigma_mm is not None and np.isnan(sigma_mm).any():
        sigma_mm = None
    return analyse(
        fit,
        most_named=options.max_effects,
        only=(*options.effects, *options.add) if options.effects else (),
        sigma_mm=sigma_mm,
        show=show,
    )


def observed_of(machine: Machine, measurement: Lengths | Deviations) -> Observed:
    """Return the measurement as scalar readings."""
    if isinstance(measurement, Lengths):
        return ObservedLengths(machine, measurement)
    return ObservedDeviations(machine, measurement)


def _completed(
    machine: Machine,
    analysis: Analysis,
    options: DiagnoseOptions,
    show: Show,
    before: BaseFit,
    classed: Sequence[Classed],
    removed: int,
) -> Diagnosis:
    """Verdict, refit and misfit; ``before`` is the fit to the unchanged file."""
    verdict = verdict_of(analysis)
    show("fitting the model with what was found")
    added, design = list(verdict.added), analysis.design
    for name in options.add:
        groups = [g for g, group in enumerate(design.groups) if group.name == name and group.tier == "named"]
        if not groups:
            known = sorted({group.name for group in design.groups if group.tier == "named"})
            raise InputError(f"{name!r} cannot be added to this measurement; possible are {', '.join(known)}")
        if not set(groups) & set(verdict.added):  # requested by the user: use its best scan position
            added.append(max(groups, key=lambda g: float(np.sum(design.score[design.place(g)] ** 2))))
    found = refit(analysis, added)
    show("testing on lines, stations and times left out")
    seen = {g: design.groups[g].columns @ design.maps[g] for g in added if design.size(g)}
    base = [columns for g, columns in seen.items() if design.groups[g].tier == "base"]
    columns = [columns for g, columns in seen.items() if design.groups[g].tier != "base"]
    predicting = [
        columns for g, columns in seen.items() if design.groups[g].tier != "base" and design.groups[g].predicts
    ]
    misfit = misfit_before_after(analysis.fit, columns, predicting, analysis.noise, base)
    if before is not analysis.fit:
        misfit = replace(misfit, train=replace(misfit.train, before_mm=before.rms_mm))
    if analysis.fit.rms_mm > HOPELESS_MM:
        text = f"the readings do not fit the commanded positions: {analysis.fit.rms_mm:.3g} mm rms"
        verdict = replace(verdict, word="not_decidable", reasons=(*verdict.reasons, text))
    advice = advice_of(analysis, verdict)
    observed = analysis.fit.observed
    classes = [*classed, *classes_of(analysis, removed)]
    done = Diagnosis(machine, analysis, verdict, found, misfit, tuple(classes), advice)
    if options.against is not None:
        against = compared(observed, analysis, options.against)
        done = replace(done, changes=against.changes, against_rms_mm=against.rms_mm)
    return done


# Six-DOF readings: what they show about the instrument, in the form of a diagnosis.
#
# An instrument error that depends only on distance is indistinguishable from a geometric error, and statistics cannot
# identify it; only changes with direction, time or order are visible. Names are tentative: a machine may bend that way.


NOTE = "an optical error that depends only on the distance equals a geometric error: no statistical test can distinguish the two"
#: How to separate instrument and machine.
ADVICE = (
    "turn the target by 180 degrees and measure again: separates crosstalk fixed to the target from straightness",
    "measure with a second target offset: separates crosstalk and detector gains from straightness",
    "measure forth and back three times: separates the drift of the beam from straightness",
)


@dataclass(frozen=True)
class SixDofDiagnosis:
    """What six-DOF readings show about their instrument."""

    machine: Machine
    suspicions: tuple[Suspicion, ...]

    @property
    def acceptable(self) -> bool:
        """Hints are not a reason to reject the readings."""
        return True

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        names = {item.name for item in self.suspicions}
        cards = {name: e.card for name, e in catalogue().items() if "sixdof" in e.card.kinds}
        empty = {"before_rms_um": None, "after_rms_um": None}
        return {
            "verdict": "named" if self.suspicions else "none",
            "effects": [_effect(item) for item in self.suspicions],
            "unknown": [],
            "invisible": [name for name in cards if name not in names and name != "beam_drift"],
            "secondary": [],
            "gap": {"train": empty, "noise_floor_um": None, "noise_floor_source": "assumed"},
            "advice": list(ADVICE),
            "reasons": [],
            "notes": [NOTE],
        }


def _effect(item: Suspicion) -> dict[str, Any]:
    return {
        "name": item.name,
        "alias_set": [{"name": item.name, "weight": 1.0}],
        "parameters": {key: {"value": value, "u": None} for key, value in item.evidence.items()},
        "confidence": 0.5,
        "grade": "tentative",
        "visible_fraction": None,
        "axis": item.axis,
        "reasons": [item.text],
    }


def diagnose_sixdof(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> SixDofDiagnosis:
    """Return what the readings show about the instrument."""
    return SixDofDiagnosis(machine, tuple(sixdof_health(machine, readings, instrument)))


def sixdof_text(found: SixDofDiagnosis) -> str:
    """Return the report as Markdown text."""
    lines = [f"# Diagnosis of the six-DOF readings of {found.machine.name}", ""]
    lines += [f"* **{item.name}** ({item.axis}): {item.text}" for item in found.suspicions] or ["* nothing significant"]
    return "\n".join([*lines, "", f"Note: {NOTE}.", "", *[f"* {text}" for text in ADVICE]]) + "\n"
