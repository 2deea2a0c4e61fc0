"""Diagnosis of axis runs (ISO 230-2): changes during the session, the reversal, and the figures without the changes.

Changes with time come first, from the scatter within the cells (one target in one direction), where everything static
cancels. The reversal follows from the means of the cells, with the noise and the changes already found. The changes are
subtracted from the readings together, and B, M, E, R and A are computed from the same readings before and after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc, fdtrc, stdtr

from compgen.accuracy import positioning_test, run_statistics
from compgen.data.axis_runs import AxisRuns
from compgen.data.csv_files import FloatArray, format_csv
from compgen.data.error_table import ErrorTable
from compgen.data.files import read_text
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_NAMES, MM_PER_UM
from compgen.diagnose.axis_model import (
    DRIFTS,
    OF_RUNS,
    AxisFit,
    AxisSearch,
    candidates_of,
    invisible_of,
    noise_of,
    paused_warmups,
)
from compgen.diagnose.axis_session import ORDER_TEXTS, AxisSession, Order, sessions_of
from compgen.diagnose.engine import ALIAS, LEAST_BESIDE, LEAST_GAIN, SMALL_BESIDE, Candidate, NoiseGrid
from compgen.diagnose.layout import IntArray
from compgen.diagnose.verdict import DisplayedDiagnosis
from compgen.effects import Effect, active_effects, catalogue, section_text
from compgen.effects.all_effects import belongs_to, what_to_do
from compgen.errors import InputError, Message
from compgen.kinematics.kernel_switch import one_thread

Grade = Literal["confirmed", "beside_unknown", "tentative"]
Show = Callable[[str], None]

#: What statistics cannot decide.
WARM_UP_NOTE = Message(
    "warm-up-of-what",
    "a warm-up of the machine and one of the sensor look alike: only a stationary drift test distinguishes them",
)
NO_REPEATS = Message(
    "noise-assumed", "no repeats and no stated uncertainty: the noise is assumed, so no name is confirmed"
)
#: Figures shown, um: reversal, range of mean bidirectional deviation, systematic deviation, repeatability, accuracy.
SHOWN = ("B", "M", "E", "R", "A")
#: Least degrees of freedom after fitting the means of the targets, and after fitting those of the cells.
LEAST_FREEDOM, LEAST_REPEATS = 20, 8
#: p-value required for backlash and for a reversal that varies along the axis.
REVERSAL_P = 1.5e-3
#: A reversal within this many standard uncertainties of zero at an end of the axis is taken to start from zero there.
ZERO_AT_END = 2.5
#: The same within this share of its largest value: the law of a worn screw is no exact parabola.
ZERO_SHARE = 0.08
#: The smooth part must explain this share of a varying reversal; otherwise its law is unknown.
SMOOTH_SHARE = 0.7
#: A named effect that explains less than this share of what the unnamed terms explain is tentative.
LEAST_SHARE = 0.5
#: The same for a drift found together with a smooth term in time, of which it could be a part.
LEAST_SHARE_OF_DRIFT = 2.0
#: Chi-square that a reversal needs if something unnamed was found, and if the runs do not repeat.
LEAST_WITH_UNKNOWN, LEAST_WITH_UNKNOWN_RUNS = 40.0, 200.0
#: An effect may vary with position, direction or time by at most this share of itself; p-value of the test.
UNEVEN_SHARE, UNEVEN_P = 0.05, 1e-3
#: Time constant of a fading step, as a share of the session; least readings of a disturbance to test it for fading.
FADES, LEAST_WINDOW = 0.15, 4
#: A warm-up whose time constant exceeds this multiple of the session has hardly begun to level off.
HARDLY_LEVELS = 1.5
#: A tentative drift is subtracted if the means of the runs move in the second half by no more than this share of their
#: movement in the first half, and if no more than this share of their movement remains.
LEVELS_OFF, LEAST_FOLLOWED = 0.8, 0.5
#: Why a drift is tentative if part of it differs along the axis or by direction.
NOT_THE_SAME = Message("drift-not-the-same", "the drift is not the same at all positions and in both directions")
PAUSE = Message(
    "pause-as-good",
    "a pause during the drift looks the same, and no times are logged (time_s): it is no step if there was one",
)
#: Limits for the whitened residuals to count as noise: excess kurtosis (the largest in 200 sessions with noise of
#: memory up to 0.85 was 2.0), and skewness over its standard error.
JUMPS, LEANS = 3.0, 4.5
#: Standard uncertainties below which an amount is not confirmed.
LEAST_SIZE = 2.0
#: A disturbance of no more readings than this may be a rounding.
FEW_READINGS = 3
#: So many names that explain a change nearly as well, and the gain from which it is told apart from them all the same: in 480
#: sessions with nuisances, 5 of 7 such names were wrong, of those with fewer names 4 of 49.
MANY_NAMES, TOLD_APART = 4, 25.0
#: Chi-square that a small reversal needs beside a change whose chi-square is this many times larger.
LEAST_REVERSAL_BESIDE, LARGER = 30.0, 4.0
#: Gain that disturbed readings need beside something unnamed, of which they could be a part.
LEAST_DISTURBED = 100.0
#: A constant reversal is named from this share of the scatter of a reading.
LEAST_OF_SCATTER = 0.1
#: Largest plausible parameter, as a multiple of what the catalogue gives.
PLAUSIBLE = 3.0
#: Usual upper limit of the memory of measurement noise; gain in twice the log likelihood that shows a longer memory;
#: memory above which the readings count as wandering in any case.
USUAL_MEMORY, WANDERS, MOST_MEMORY = 0.9, 5.0, 0.94
#: Gain in twice the log likelihood required for a scatter that changes with time, and with position or direction; trial
#: values of the natural logarithm of the scatter ratio of the two ends (the largest gain in 20 sessions was 8.1).
SCATTER_GROWS, SCATTER_CHANGES, SCATTERS = 10.0, 13.0, (-2.0, -1.4, -0.8, 0.8, 1.4, 2.0)
#: Memory above which a note reports it.
MEMORY = 0.5
#: Correlation of time and position above which a session measured target by target cannot separate the two.
ALIKE = 0.7
#: Weight above which one effect of whole runs could equally be the other.
AS_WELL = 0.2
#: Effects whose readings are left out of the figures; all other changes are subtracted.
LEFT_OUT = ("bad_run", "disturbed_readings")
#: Effects of a logged column.
LOGGED = ("thermal_scale", "spindle_growth", "settling", "servo_lag")
#: Effects that are stored in a machine file; the warm-up of one session is not one of them.
MACHINE_EFFECTS = ("thermal_scale", "spindle_growth", "servo_lag")


@dataclass(frozen=True)
class AxisEffect:
    """A named effect: parameters (value, u) keyed by name, in the unit of the name; ``shift_mm`` (n,) is what it adds.

    ``left_out`` are readings (numbers in time) that it makes unusable. ``remains`` says which part of a tentative drift
    is subtracted anyway and which part stays; empty for all other effects. ``clear`` is the gain beyond the penalty.
    """

    name: str
    grade: Grade
    text: str
    parameters: Mapping[str, tuple[float, float | None]]
    alias: tuple[tuple[str, float], ...]
    gain: float
    p: float
    reasons: tuple[str, ...]
    shift_mm: FloatArray
    left_out: IntArray
    static: bool
    effect: Effect
    values: FloatArray
    homogeneity_p: float = 1.0
    remains: str = ""
    clear: float = np.inf

    @property
    def wald(self) -> float:
        """Largest of the squares of the parameters over their uncertainties."""
        return max(((value / u) ** 2 for value, u in self.parameters.values() if u), default=0.0)


@dataclass(frozen=True)
class AxisUnknown:
    """An unnamed effect: description, what it depends on, RMS, and the name that it resembles, if any."""

    text: str
    covariates: tuple[str, ...]
    rms_mm: float
    resembles: str = ""


@dataclass(frozen=True)
class AxisFindings:
    """Findings for one axis; ``phi`` is the correlation of neighbouring readings, ``sigma_mm`` their scatter."""

    session: AxisSession
    effects: tuple[AxisEffect, ...]
    unknown: tuple[AxisUnknown, ...]
    invisible: tuple[str, ...]
    sigma_mm: float
    phi: float
    noise_source: str
    removed_mm: FloatArray
    left_out: IntArray
    taken_off: tuple[str, ...]
    figures: Mapping[str, Mapping[str, float]]
    residual_before_mm: FloatArray
    residual_after_mm: FloatArray
    left_out_rms_mm: tuple[float, float] | None
    suspects: tuple[tuple[str, float], ...]
    notes: tuple[str, ...]
    against: Mapping[str, Any] | None = None

    @property
    def word(self) -> str:
        """Verdict on this axis."""
        if any(item.grade != "tentative" for item in self.effects):
            return "named"
        return "unknown" if self.unknown or self.effects else "none"


def check_axis_names(machine: Machine, runs: AxisRuns, names: Sequence[str]) -> None:
    """Raise InputError for names that axis runs cannot show."""
    letters = {AXES[axis] for axis in runs.axes}
    known = [
        name for name, effect in catalogue().items()
        if "axis" in effect.card.kinds and (name[-2:-1] != "_" or name[-1] in letters)
    ]  # fmt: skip
    for name in names:
        if name not in known:
            raise InputError(f"{name!r} cannot be added to this measurement; possible are {', '.join(sorted(known))}")


def findings_of(
    machine: Machine,
    runs: AxisRuns,
    *,
    order: Order = "auto",
    most: int = 4,
    only: Sequence[str] = (),
    add: Sequence[str] = (),
    u_um: float | None = None,
    against: ErrorTable | None = None,
    show: Show = lambda _: None,
) -> list[AxisFindings]:
    """Diagnose each axis separately.

    Parameters
    ----------
    machine, runs : the machine and its runs.
    order : how the readings are ordered in time.
    most : maximum number of changes with time.
    only : names to look for; default all.
    add : names to add whether found or not.
    u_um : standard uncertainty of a reading; used where nothing was repeated.
    against : errors that the mean curve is compared with.
    """
    check_axis_names(machine, runs, add)
    if u_um is not None and not u_um > 0:
        raise InputError(f"an uncertainty of {u_um:g} um was given; it must be above zero")
    found = []
    value, active = runs.deviation_mm.copy(), active_effects(machine)
    for session in sessions_of(machine, runs, order) if active else ():
        for item in active:  # subtract the effects that are already in the machine file
            change = item.change_mm(session.readings)
            if change is not None:
                value[session.row] -= change
    for session in sessions_of(machine, replace(runs, deviation_mm=value), order):
        freedom = len(session) - len(session.targets_mm)
        if freedom < LEAST_FREEDOM:
            raise InputError(
                f"{session.letter}: {len(session)} readings leave {freedom} degrees of freedom after the mean of each "
                f"target is fitted; a diagnosis needs at least {LEAST_FREEDOM}: measure more runs"
            )
        show(f"comparing candidate effects of {session.letter}")
        with one_thread():
            found.append(_findings(session, most, only, add, u_um, against))
    return found


def _findings(
    session: AxisSession,
    most: int,
    only: Sequence[str],
    add: Sequence[str],
    u_um: float | None,
    against: ErrorTable | None,
) -> AxisFindings:
    names = (*only, *add) if only else ()
    grid = noise_of(session)
    repeated = session.repeated and grid.freedom >= LEAST_REPEATS
    search = AxisSearch(session, grid, candidates_of(session, names) if repeated else [])
    members = _added(search, _seen(search, search.run(most)) if repeated else [], add)
    changes = AxisFit(search, members)
    source = "repeats" if repeated else "stated" if u_um is not None else "assumed"
    reversal = _Reversal(changes, None if repeated else u_um)
    effects, unknown = _changes_found(changes, most)
    if repeated and not unknown:
        unknown = _restless(changes)
    static, irregular = reversal.found(names, add, source)
    if repeated:
        static = [_instead(changes, item) if item.name.startswith("backlash") else item for item in static]
    # a reversal is doubtful if it changes with time; a small one also if anything else is unnamed
    if any("approach" in other.covariates and {"time", "run"} & set(other.covariates) for other in unknown):
        static = [_doubted(item, "the reversal changes with time") for item in static]
    elif unknown:
        least = LEAST_WITH_UNKNOWN_RUNS if any("run" in other.covariates for other in unknown) else LEAST_WITH_UNKNOWN
        static = [
            _doubted(i, Message("small-beside-unknown", "small compared with the unexplained part"))
            if i.gain < least
            else i
            for i in static
        ]
    largest = max((item.gain for item in effects), default=0.0)
    static = [
        _doubted(item, "it is small beside what changes with time")
        if min(item.gain, item.wald) < LEAST_REVERSAL_BESIDE and min(item.gain, item.wald) * LARGER < largest
        else item
        for item in static
    ]
    effects, unknown = [*effects, *static], [*unknown, *irregular]
    if unknown:
        text = "what has no name may be the cause"
        effects = [
            _doubted(e, text) if e.name == "disturbed_readings" and e.gain < LEAST_DISTURBED else e for e in effects
        ]
        effects = [replace(e, grade="beside_unknown") if e.grade == "confirmed" else e for e in effects]
    if not unknown and effects and all(e.grade == "tentative" for e in effects) and repeated:
        first = effects[0]
        unknown = [
            AxisUnknown(
                Message("resembles", "resembles {name} but {reasons}", name=first.name, reasons=first.reasons[0]),
                (),
                np.nan,
                first.name,
            )
        ]
    effects = [_common_part(session, item, effects, changes) for item in effects]
    removed, left_out, taken, figures, notes = _removal(session, effects)
    effects = [item if item.name in taken else replace(item, remains="") for item in effects]
    before, after = _residuals(session, grid, effects)
    return AxisFindings(
        session, tuple(effects), tuple(unknown), invisible_of(session),
        changes.sigma_mm if repeated else reversal.sigma_mm, changes.phi if repeated else 0.0, source,
        removed, left_out, taken, figures, before, after, _left_out_rms(session, effects, left_out),
        search.suspects() if repeated else (), tuple(notes),
        None if against is None else _compared(changes, against),
    )  # fmt: skip


def _changes_found(changes: AxisFit, most: int) -> tuple[list[AxisEffect], list[AxisUnknown]]:
    """The changes with time: named ones, the strongest first, and unnamed ones.

    Of the effects on whole runs (a bad run, a step), one of each kind is accepted; if there are more, the runs do not
    repeat. A bad last run and a step before it affect the same readings: it counts as the kind not found yet.
    """
    search, members = changes.search, changes.members
    generic = [k for k in members if search.candidates[k].tier == "generic"]
    unknown = [_unknown_of(changes, k) for k in generic]
    if len(members) >= most > 0 and search.criteria(members)[1].max() >= LEAST_GAIN:
        unknown.append(AxisUnknown(f"more than {most} changes: the session does not repeat", ("time", "run"), np.nan))
    effects = [_change(changes, k, generic) for k in members if k not in generic]
    largest = max((item.gain for item in effects), default=0.0)
    effects = [
        _doubted(item, "it is small beside the others")
        if item.gain < SMALL_BESIDE * largest and item.clear < LEAST_BESIDE
        else item
        for item in effects
    ]
    effects = [
        _doubted(item, "several other effects explain it nearly as well")
        if len(item.alias) >= MANY_NAMES and item.gain < TOLD_APART
        else item
        for item in effects
    ]
    of_runs = [item for item in effects if item.name in OF_RUNS]
    may_be = [{name for name, weight in item.alias if weight > AS_WELL} for item in of_runs]
    one_of_each = len(of_runs) == 2 and any(set(OF_RUNS) <= names for names in may_be)
    if len({item.name for item in of_runs}) < len(of_runs) and not one_of_each:
        effects = [_doubted(item, "the runs do not repeat") for item in effects]
        text = "the runs do not repeat: more than one run deviates, or more than two are separated by steps"
        covariates = ("run", *_one_way(changes.session, effects))
        unknown.append(AxisUnknown(text, covariates, np.nan, of_runs[0].name))
    effects = [_doubted(item, PAUSE) if _may_be_pause(changes, item, effects) else item for item in effects]
    return sorted(effects, key=lambda item: -item.gain), unknown


def _may_be_pause(changes: AxisFit, step: AxisEffect, effects: Sequence[AxisEffect]) -> bool:
    """Whether a step is what a drift does while nobody measures: only without times, and in the drift's own sense.

    During a pause a warm-up goes on, and afterwards it is slower than before. So one warm-up with a pause, of any length, is
    compared with the drift and the step.
    """
    search, session = changes.search, changes.session
    drift = next((item for item in effects if item.name in DRIFTS), None)
    if session.timed or step.name != "step_between_runs" or drift is None:
        return False
    rises, steps = (item.shift_mm[-1] - item.shift_mm[0] for item in (drift, step))
    if rises * steps <= 0:
        return False
    own = [search.candidates[k] for k in changes.members]
    kept = [c for c in own if c.name not in (*DRIFTS, step.name)]
    both = [c for c in own if c.name in (*DRIFTS, step.name)]
    at = next(c.effect.settings["at"] for c in own if c.name == step.name and c.effect is not None)
    paused = paused_warmups(session, int(at))
    again = AxisSearch(session, search.grid, [*kept, *both, *paused])
    first = list(range(len(kept)))
    as_steps = again.total([*first, *range(len(kept), len(own))])
    as_pause = max(again.total([*first, k]) for k in range(len(own), len(own) + len(paused)))
    return as_pause > as_steps - ALIAS


def _one_way(session: AxisSession, effects: Sequence[AxisEffect]) -> tuple[str, ...]:
    """("time", "approach") if all bad runs have the same direction: then the reversal changes."""
    off = [session.direction[item.left_out] for item in effects if item.name == "bad_run"]
    alike = off and np.ptp(np.concatenate(off)) == 0
    return ("time", "approach") if alike else ()


def _instead(changes: AxisFit, item: AxisEffect) -> AxisEffect:
    """Backlash, or the servo lag or settling that explains the reversal and its change with feed or dwell better."""
    session, point = changes.session, int(np.argmax(changes.weights))
    if item.grade == "tentative" or any(e.startswith(("servo_lag", "settling")) for e in changes.names):
        return item
    base = np.hstack([np.eye(len(session.targets_mm))[session.target], changes.columns])

    def left(columns: FloatArray) -> float:
        design = np.hstack([base, columns])
        pulled = changes.grid.solve(point, np.column_stack([changes.search.y, design]))
        right = design.T @ pulled[:, 0]
        inverse = np.linalg.pinv(design.T @ pulled[:, 1:], rcond=1e-10, hermitian=True)
        return max(float(changes.search.y @ pulled[:, 0] - right @ inverse @ right), session.least_mm**2)

    own = left(session.direction[:, None].astype(np.float64))
    others = [(left(c.columns), c) for c in changes.search.candidates if c.name.startswith(("servo_lag", "settling"))]
    if not others:
        return item
    least, best = min(others, key=lambda entry: entry[0])
    gain = changes.freedom * float(np.log(own / least)) - 2.0 * float(np.log(best.scans))
    if gain < ALIAS or best.effect is None:
        weight = 1.0 / (1.0 + float(np.exp(np.clip(-0.5 * gain, -50.0, 50.0))))
        return item if weight < 0.01 else replace(item, alias=((item.name, 1.0 - weight), (best.name, weight)))
    value, covariance = changes.estimate(base, best.columns)
    own_parameter = best.effect.card.parameters[0]
    parameters: dict[str, tuple[float, float | None]] = {
        own_parameter.name: (
            float(value[0]) / own_parameter.si_per_unit, float(np.sqrt(covariance[0, 0])) / own_parameter.si_per_unit
        )
    } | {key: (number, None) for key, number in best.effect.used(session.readings).items()}  # fmt: skip
    return replace(
        item, name=best.name, text=best.text, parameters=parameters, alias=((best.name, 1.0),),
        shift_mm=best.columns @ value, effect=best.effect, values=value, static=False,
    )  # fmt: skip


def _doubted(item: AxisEffect, reason: str) -> AxisEffect:
    return replace(item, grade="tentative", reasons=(*item.reasons, reason))


def _common_part(session: AxisSession, item: AxisEffect, effects: Sequence[AxisEffect], changes: AxisFit) -> AxisEffect:
    """Add to a tentative drift the statement that it is subtracted, if the means of the runs show it."""
    if item.name not in DRIFTS or item.grade != "tentative" or not session.in_runs:
        return item
    off = [other.left_out for other in effects if other.grade != "tentative"]
    used = np.isin(np.arange(len(session)), np.concatenate([np.zeros(0, dtype=np.int64), *off]), invert=True)
    drift = session.run_means_mm(item.shift_mm, used)
    memory = (1.0 + changes.phi) / (1.0 - changes.phi)
    u = changes.sigma_mm * float(np.sqrt(min(memory / len(session.targets_mm), 1.0)))
    if not _levels_off(session.run_means_mm(session.deviation_mm, used), drift, u):
        return item
    stays = "part of the drift is not the same at all positions or in both directions and is not removed"
    if NOT_THE_SAME not in item.reasons and item.homogeneity_p >= UNEVEN_P:
        stays = "the unexplained part is not removed"
    moves = "rise" if item.shift_mm[0] < 0 else "fall"
    ways = "both directions" if len(drift) > 1 else "the one direction that was measured"
    text = (
        f"the means of the runs {moves} and level off in {ways}: the part common to all positions is removed; {stays}"
    )
    return replace(item, remains=text)


def _levels_off(means: FloatArray, drift: FloatArray, u_mm: float) -> bool:
    """Whether the means of the runs (ways, runs) move in one sense and level off, up and down alike, as the drift does.

    A single way (one direction) may deviate from this within the uncertainty: twice that of each difference of means,
    where one mean has the uncertainty ``u_mm``.
    """
    runs = means.shape[1]
    if runs < 3 or not np.isfinite(means).all():
        return False
    sense, half = np.sign(drift[:, -1].sum() - drift[:, 0].sum()), (runs - 1) // 2
    up, left = sense * means, (sense * (means - drift)).mean(axis=0)
    first, second = up[:, half] - up[:, 0], up[:, -1] - up[:, -1 - half]
    # twice the uncertainty of a difference of means, and of the difference of two of these with one mean in common
    step, turn = 2.0 * 2.0**0.5 * u_mm, 2.0 * 6.0**0.5 * u_mm
    return bool(
        np.diff(up).min() > -step
        and (up[:, -1] - up[:, 0]).min() > step
        and second.sum() <= LEVELS_OFF * first.sum()
        and (second - first).max() <= turn
        and np.ptp(left) <= LEAST_FOLLOWED * np.ptp(up.mean(axis=0))
    )


def _added(search: AxisSearch, members: list[int], add: Sequence[str]) -> list[int]:
    """Members plus the best scan position of every name requested by the user."""
    for name in add:
        own = [k for k, c in enumerate(search.candidates) if c.name == name]
        if own and not any(search.candidates[k].name == name for k in members):
            criteria = search.criteria(members)[1]
            members = [*members, max(own, key=lambda k: criteria[k])]
    return members


def _seen(search: AxisSearch, members: list[int]) -> list[int]:
    """Members without those that are smaller than the step of the readings, or than their own uncertainty, allows.

    Readings that are rounded alike repeat without scatter, and one that is rounded the other way is a step off.
    """
    for k in sorted(members, key=lambda k: search.criteria([other for other in members if other != k])[0][k]):
        item, changes = search.candidates[k], AxisFit(search, members)
        if item.tier != "named" or not changes.freedom or not (item.free or item.columns.shape[1] == 1):
            continue
        rest = [other for other in members if other != k]
        value, covariance = changes.estimate(np.hstack([changes.grid.base, search.columns_of(rest)]), item.columns)
        size = float(np.abs(item.columns @ value).max())
        step_mm = search.session.step_mm * (1.5 if np.count_nonzero(item.columns) <= FEW_READINGS else 0.5)
        uncertain = len(value) == 1 and value[0] ** 2 < LEAST_SIZE**2 * covariance[0, 0]
        if uncertain or size < max(step_mm, 1.5 * search.session.step_mm * item.free):
            members = rest
    return members


def _restless(changes: AxisFit) -> list[AxisUnknown]:
    """Residuals that jump, are skewed, wander, or scatter unequally, more than noise does."""
    session, point = changes.session, int(np.argmax(changes.weights))
    design = np.hstack([changes.grid.base, changes.columns])
    inverse = changes.grid.inverse(point)
    value = np.linalg.pinv(design.T @ inverse @ design, rcond=1e-10, hermitian=True) @ (
        design.T @ inverse @ changes.search.y
    )
    left = changes.search.y - design @ value
    white = np.linalg.cholesky(inverse).T @ left
    scale = float(np.sqrt(np.mean(white**2)))
    rms = float(np.sqrt(np.mean(left**2)))
    if scale <= max(session.least_mm, session.step_mm) or len(session) < 30:
        return []
    if float(np.mean(white**4)) / scale**4 - 3.0 > JUMPS:
        text = "the readings occasionally jump by more than their scatter, and do not repeat"
        return [AxisUnknown(text, ("time",), rms)]
    if abs(float(np.mean(white**3))) / scale**3 > LEANS * np.sqrt(6.0 / len(session)):
        text = "the readings creep to one side and slip back, and do not repeat"
        return [AxisUnknown(text, ("time",), rms)]
    memory = np.array([phi for phi, _ in changes.grid.points])
    fits = 2.0 * (changes.grid.log_likelihoods(changes.square) - changes.grid.prior)
    if changes.phi > MOST_MEMORY or fits[memory > USUAL_MEMORY].max() - fits[memory <= USUAL_MEMORY].max() > WANDERS:
        return [AxisUnknown("the readings wander from one to the next and do not repeat", ("time",), rms)]
    return _uneven_scatter(changes, rms)


def _uneven_scatter(changes: AxisFit, rms: float) -> list[AxisUnknown]:
    """A scatter that changes during the session, along the axis, or with direction."""
    session, search = changes.session, changes.search
    chosen = np.flatnonzero(changes.weights > 0.1 * changes.weights.max())
    points = [changes.grid.points[k] for k in chosen]
    base = 2.0 * float(changes.grid.log_likelihoods(changes.square)[chosen].max())
    t = (session.time - session.time[0]) / (session.time[-1] - session.time[0])
    of: list[tuple[str, tuple[str, ...], FloatArray]] = [
        ("time", ("time",), t),
        ("the position", ("x",), 0.5 * (1.0 + session.s)),
        ("the direction", ("approach",), np.asarray(0.5 * (1.0 + session.direction), dtype=np.float64)),
    ]
    for what, covariates, shape in of:
        if np.ptp(shape) == 0.0:
            continue
        gains = {}
        for change in SCATTERS:
            scatter = np.exp(change * (shape - shape.mean()))
            grid = noise_of(session, scatter, points)
            columns = changes.columns / scatter[:, None]
            square = np.array([_left(grid, k, search.y / scatter, columns) for k in range(len(points))])
            square = np.maximum(square, grid.freedom * session.least_mm**2)
            own = 2.0 * float(grid.log_likelihoods(square).max()) - 2.0 * float(np.sum(np.log(scatter)))
            gains[change] = own - base
        best = max(gains, key=lambda change: gains[change])
        if gains[best] > (SCATTER_GROWS if what == "time" else SCATTER_CHANGES):
            factor = float(np.exp(abs(best)))
            if what == "time" and abs(float(np.corrcoef(t, session.s)[0, 1])) > ALIKE:
                what, covariates = "time or the position, which cannot be separated here", ("time", "x")
            text = f"the scatter of the readings changes with {what}, by a factor of about {factor:.1f}"
            return [AxisUnknown(text, covariates, rms)]
    return []


def _left(grid: NoiseGrid, point: int, y: FloatArray, columns: FloatArray) -> float:
    """Return y'Py with columns (n, k) fitted."""
    pulled = grid.free(point, np.column_stack([y, columns]))
    gram = columns.T @ pulled[:, 1:]
    right = columns.T @ pulled[:, 0]
    return float(y @ pulled[:, 0] - right @ np.linalg.pinv(gram, rcond=1e-10, hermitian=True) @ right)


def _change(changes: AxisFit, member: int, generic: Sequence[int]) -> AxisEffect:
    """Grade and parameters of a named change with time."""
    search, session = changes.search, changes.session
    item = search.candidates[member]
    assert item.effect is not None
    rest = [k for k in changes.members if k != member]
    gains, criteria = search.criteria(rest)
    alias = search.alternatives(criteria, member)
    values, covariance = changes.estimate(np.hstack([changes.grid.base, search.columns_of(rest)]), item.columns)
    shift = item.columns @ values
    reasons: list[str] = []
    p = 1.0
    lost = item.name in LEFT_OUT
    of_generic = set[str]().union(*(search.candidates[k].covariates for k in generic))
    if item.name in DRIFTS and "time" in of_generic and of_generic & {"x", "approach"}:
        reasons.append(NOT_THE_SAME)
    if item.name in (*OF_RUNS, *DRIFTS) and "run" in of_generic:
        reasons.append(Message("every-run-differs", "every run differs from the others"))
    if item.columns.shape[1] == 1:
        p, share = _uneven(changes, member, shift)
        if p < UNEVEN_P and share > UNEVEN_SHARE:
            reasons.append(
                Message(
                    "not-alike-in-session",
                    "does not behave like it at all positions, directions and times (p = {p:.1e})",
                    p=p,
                )
            )
    unnamed = sum(float(search.criteria([k for k in changes.members if k != g])[0][g]) for g in generic)
    share = LEAST_SHARE_OF_DRIFT if item.name in DRIFTS and "time" in of_generic else LEAST_SHARE
    if unnamed and gains[member] < share * unnamed:
        reasons.append(Message("small-beside-unknown", "small compared with the unexplained part"))
    own = np.array([float(values.mean())]) if item.free else values
    u = np.sqrt(np.diag(covariance))
    first = float(np.mean(u)) if item.free else float(u[0])
    parameters: dict[str, tuple[float, float | None]] = {
        parameter.name: (float(v) / parameter.si_per_unit, first / parameter.si_per_unit)
        for parameter, v in zip(item.effect.card.parameters, own, strict=False)
    }
    parameters |= {key: (value, None) for key, value in item.effect.used(session.readings).items()}
    reasons += _size_reasons(item, own, parameters, covariance if len(own) == len(covariance) else np.diag(u[:1] ** 2))
    if item.name.rpartition("_")[0] in LOGGED and not _holds(changes, member):
        reasons.append(Message("fails-left-out-runs", "it does not hold in runs left out of the fit"))
    if item.name in DRIFTS:  # refer the readings to the end of the session, the warm state
        shift = shift - shift[-1]
    window = np.arange(item.first, item.last + 1) if lost else np.zeros(0, dtype=np.int64)
    return AxisEffect(
        item.name, "tentative" if reasons else "confirmed", _text(session, item, parameters, alias), parameters, alias,
        float(gains[member]), float(chdtrc(item.columns.shape[1], gains[member])), tuple(reasons), shift, window,
        False, item.effect, own, p, clear=float(criteria[member]),
    )  # fmt: skip


def _size_reasons(
    item: Candidate, values: FloatArray, parameters: Mapping[str, tuple[float, float | None]], covariance: FloatArray
) -> list[str]:
    """Why the amount of an effect speaks against it: within its uncertainty, or beyond what machines do."""
    reasons: list[str] = []
    finite = bool(np.isfinite(covariance).all())
    if not finite or float(values @ np.linalg.pinv(covariance, hermitian=True) @ values) < LEAST_SIZE**2:
        reasons.append(
            Message(
                "within-its-uncertainty",
                "it is smaller than {LEAST_SIZE:g} times its standard uncertainty",
                LEAST_SIZE=LEAST_SIZE,
            )
        )
    for own in item.effect.card.parameters if item.effect is not None else ():
        value, u = parameters.get(own.name, (0.0, None))
        if own.plausible > 0 and abs(value) - LEAST_SIZE * (u or 0.0) > PLAUSIBLE * own.plausible:
            reasons.append(
                Message(
                    "size-not-plausible", "its size, {name} = {value:.3g}, is not plausible", name=own.name, value=value
                )
            )
    return reasons


def _holds(changes: AxisFit, member: int) -> bool:
    """Whether an effect, fitted to all runs but one, makes the readings of that one fit better, in all runs together."""
    session, search = changes.session, changes.search
    rest = [k for k in changes.members if k != member]
    known, own = np.hstack([changes.grid.base, search.columns_of(rest)]), search.candidates[member].columns
    before = after = 0.0
    for run in np.unique(session.cycle):
        out = session.cycle == run
        train, both = ~out, np.hstack([known, own])
        if not train.any():
            continue
        value = np.linalg.lstsq(both[train], search.y[train], rcond=1e-9)[0]
        # what only this run shows (its level) is fitted to it, with and without the effect
        shown = known[out][:, known[train].any(axis=0)]
        left = search.y[out] - shown @ value[: known.shape[1]][known[train].any(axis=0)]
        moved = left - own[out] @ value[known.shape[1] :]
        alone = (
            search.y[out]
            - shown @ np.linalg.lstsq(known[train], search.y[train], rcond=1e-9)[0][known[train].any(axis=0)]
        )
        before += float(np.sum(alone**2))
        after += float(np.sum(moved**2))
    return after < before


def _uneven(changes: AxisFit, member: int, shift: FloatArray) -> tuple[float, float]:
    """p-value of the test whether an effect depends on position, direction or time, and the share that does."""
    session = changes.session
    item = changes.search.candidates[member]
    half = np.where(session.time > np.median(session.time), 1.0, -1.0)
    unit = shift / max(float(np.abs(shift).max()), 1e-12)
    columns = np.hstack([changes.grid.base, changes.columns])
    fading, number = [], np.arange(len(session), dtype=np.float64)
    # shape of a fading step or disturbance, in addition to the column of the effect
    if item.name == "step_between_runs":
        since = number - item.effect.settings["at"] if item.effect is not None else number
        fading = [np.where(since >= 0.0, np.exp(-np.maximum(since, 0.0) / (FADES * len(session))), 0.0)]
    elif item.name in LEFT_OUT and item.last - item.first >= LEAST_WINDOW - 1:
        inside, after = (number >= item.first) & (number <= item.last), number > item.last
        length = item.last - item.first + 1.0
        slope = np.where(inside, (number - 0.5 * (item.first + item.last)) / length, 0.0)
        fading = [slope, np.where(after, np.exp(-np.maximum(number - item.last, 0.0) / length), 0.0)]
    extra = np.column_stack([unit * session.s, unit * session.direction, unit * half, *fading])
    outside = extra - columns @ np.linalg.lstsq(columns, extra, rcond=None)[0]
    extra = extra[:, np.linalg.norm(outside, axis=0) > 0.05 * np.linalg.norm(extra, axis=0)]
    count = extra.shape[1]
    if not count or changes.freedom < count + 6:
        return 1.0, 0.0
    value, covariance = changes.estimate(columns, extra)
    wald = float(value @ np.linalg.pinv(covariance, rcond=1e-8, hermitian=True) @ value) / count
    own = (extra - columns @ np.linalg.lstsq(columns, extra, rcond=None)[0]) @ value
    share = float(np.sum((own - own.mean()) ** 2) / max(np.sum((shift - shift.mean()) ** 2), 1e-18))
    return float(fdtrc(count, changes.freedom - count, wald)), share


def _text(
    session: AxisSession,
    item: Candidate,
    parameters: Mapping[str, tuple[float, float | None]],
    alias: Sequence[tuple[str, float]],
) -> str:
    """Describe what was found."""
    size = next((value for key, (value, _) in parameters.items() if key.startswith("c")), float("nan"))
    span = float(session.time[-1] - session.time[0])
    if item.name == "warmup_drift":
        tau = parameters["tau"][0]
        cycles = tau / session.cycle_span
        unit = f"{tau:.3g} s" if session.timed else f"{tau:.3g} readings"
        inside = size * -np.expm1(-span / tau)
        moved = f"the readings {'rise' if size > 0 else 'fall'} by {abs(inside):.3g} um during the session"
        if tau > HARDLY_LEVELS * span:
            return (
                f"{moved}, nearly at a constant rate: a warm-up of machine or sensor whose time constant is longer than the "
                f"session (by this fit {cycles:.2g} runs there and back), or a drift"
            )
        return (
            f"{moved} and level off: {size:+.3g} um at the end, time constant {unit} ({cycles:.2g} runs there and back); "
            "machine or sensor"
        )
    if item.name == "linear_drift":
        return f"the readings drift by {size:+.3g} um from the first to the last; machine and sensor cannot be distinguished"
    if item.name == "step_between_runs":
        return (
            f"all readings from {item.text.removeprefix('step before ')} on are {size:+.3g} um off against those before"
        )
    if item.name == "bad_run":
        return f"{item.text} is {size:+.3g} um off against all others"
    if item.name == "disturbed_readings":
        return f"disturbed readings {item.text}: {size:+.3g} um against their repeats"
    return item.text


def _unknown_of(changes: AxisFit, member: int) -> AxisUnknown:
    """An unnamed smooth term, with the name that resembles it most."""
    search = changes.search
    item = search.candidates[member]
    rest = [k for k in changes.members if k != member]
    values, _ = changes.estimate(np.hstack([changes.grid.base, search.columns_of(rest)]), item.columns)
    shift = item.columns @ values
    means = np.bincount(changes.session.cell, shift) / np.bincount(changes.session.cell)
    gains = search.criteria(rest)[0]
    named = [k for k, c in enumerate(search.candidates) if c.tier == "named" and not c.free]
    nearest = max(named, key=lambda k: gains[k], default=None)
    resembles = ""
    if nearest is not None and gains[nearest] > 0.3 * gains[member]:
        resembles = search.candidates[nearest].name
    return AxisUnknown(
        item.text, item.covariates, float(np.sqrt(np.mean((shift - means[changes.session.cell]) ** 2))), resembles
    )


class _Reversal:
    """Half the difference up minus down at every target, with its covariance, fitted with the changes with time."""

    def __init__(self, changes: AxisFit, u_um: float | None) -> None:
        self.changes, self.session = changes, changes.session
        session = self.session
        self.targets = session.both
        self.known = changes.freedom >= LEAST_REPEATS
        self.sigma_mm = changes.sigma_mm
        self.half = np.zeros(0)
        if not len(self.targets):
            return
        self.s = session.s[[int(np.flatnonzero(session.target == k)[0]) for k in self.targets]]
        if self.known:
            base = np.eye(len(session.targets_mm))[session.target]
            extra = base[:, self.targets] * session.direction[:, None]
            self.half, self.covariance = changes.estimate(np.hstack([base, changes.columns, changes.slopes()]), extra)
            # where the scatter is smaller than the step, repeats are rounded alike, and their mean is no better than one
            self.covariance += np.eye(len(self.half)) * 0.5 * session.least_mm**2 * changes.rounded_alike
            self.freedom = changes.freedom
            return
        up, down = (
            np.array(
                [session.deviation_mm[(session.target == k) & (session.direction == way)].mean() for k in self.targets]
            )
            for way in (1, -1)
        )
        self.half = 0.5 * (up - down)
        shape = self._shapes(2)
        left = self.half - shape @ np.linalg.lstsq(shape, self.half, rcond=None)[0]
        self.freedom = max(len(self.half) - shape.shape[1], 1)
        own = max(float(np.sqrt(left @ left / self.freedom)), session.least_mm / 2.0**0.5)
        if u_um is not None:
            own, self.freedom = max(u_um * MM_PER_UM, session.least_mm) / 2.0**0.5, 10_000
        self.sigma_mm = own * 2.0**0.5
        self.covariance = np.eye(len(self.half)) * own**2

    def _shapes(self, degree: int) -> FloatArray:
        degree = min(degree, len(self.s) - 1)
        return np.asarray(np.polynomial.legendre.legvander(self.s, degree))

    def _fit(self, shapes: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Coefficients, covariance and remaining chi-square."""
        inverse = np.linalg.pinv(self.covariance, rcond=1e-10, hermitian=True)
        covariance = np.linalg.pinv(shapes.T @ inverse @ shapes, rcond=1e-12, hermitian=True)
        value = np.asarray(covariance @ (shapes.T @ inverse @ self.half))
        left = self.half - shapes @ value
        return value, np.asarray(covariance), float(left @ inverse @ left)

    def _p(self, chi2: float, count: int) -> float:
        return float(fdtrc(count, self.freedom, chi2 / count)) if count > 0 else 1.0

    def found(self, only: Sequence[str], add: Sequence[str], source: str) -> tuple[list[AxisEffect], list[AxisUnknown]]:
        """Backlash and lost motion, and a reversal without a smooth law."""
        backlash, lost = f"backlash_{self.session.letter}", f"lost_motion_{self.session.letter}"
        if not len(self.targets):
            return [], []
        count = len(self.targets)
        inverse = np.linalg.pinv(self.covariance, rcond=1e-10, hermitian=True)
        everything = float(self.half @ inverse @ self.half)
        constant, of_constant, left_0 = self._fit(self._shapes(0))
        smooth, covariance, left_2 = self._fit(self._shapes(2))
        varies = min(self._p(left_0 - left_2, len(smooth) - 1), self._p(left_0, count - 1)) < 0.5 * REVERSAL_P
        irregular = count > 3 and self._p(left_2, count - len(smooth)) < 0.5 * REVERSAL_P
        law = left_0 - left_2 >= SMOOTH_SHARE * left_0
        reasons = (Message("noise-not-measured", "the noise is assumed, not measured"),) if source == "assumed" else ()
        effects, unknown = [], []
        varies = (varies and (not only or lost in only)) or lost in add
        if varies:
            why = (
                reasons
                if law or not irregular
                else (*reasons, Message("reversal-irregular", "it does not vary smoothly along the axis"))
            )
            effects.append(self._lost_motion(lost, smooth, covariance, left_0, why, exact=not irregular))
        if irregular and (not varies or not law):
            rest = self.half - self._shapes(2) @ smooth
            text = "the reversal varies irregularly from target to target"
            size = float(np.sqrt(np.mean(rest**2)))
            unknown.append(AxisUnknown(text, ("x", "approach"), size, lost if varies else ""))
        if (
            self._constant(varies, smooth, covariance, everything - left_0, irregular)
            and (not only or backlash in only)
        ) or (backlash in add):
            mean, square = (smooth[:1], covariance[:1, :1]) if varies else (constant, of_constant)
            small = abs(float(mean[0])) < max(
                LEAST_SIZE * float(np.sqrt(square[0, 0])), LEAST_OF_SCATTER * self.sigma_mm
            )
            why = (
                (*reasons, Message("small-beside-scatter", "it is small compared with the scatter of the readings"))
                if small
                else reasons
            )
            item = self._backlash(backlash, mean, square, everything - left_0, why)
            effects.append(item if varies else replace(item, alias=self._alias(backlash, lost, left_0)))
        return effects, unknown

    def _alias(self, backlash: str, lost: str, left: float) -> tuple[tuple[str, float], ...]:
        """Backlash, and lost motion if one that is zero at an end (or both) explains the readings nearly as well."""
        shapes = (0.5 * (1.0 + self.s), 0.5 * (1.0 - self.s), 1.0 - self.s**2)
        other = min(self._fit(shape[:, None])[2] for shape in shapes)
        weight = 1.0 / (1.0 + np.exp(np.clip(0.5 * (left - other), -50.0, 50.0)))
        found = [(backlash, float(weight)), (lost, float(1.0 - weight))]
        return tuple(entry for entry in found if entry[0] == backlash or entry[1] >= 0.01)

    def _constant(self, varies: bool, smooth: FloatArray, covariance: FloatArray, gain: float, irregular: bool) -> bool:
        """Whether there is backlash: a mean reversal not explained by a reversal that starts from zero at an end."""
        if irregular:  # the scatter from target to target then determines the uncertainty of the mean
            spread = self.half.std(ddof=1) / np.sqrt(len(self.half))
            p = 2.0 * float(stdtr(len(self.half) - 1, -abs(self.half.mean()) / max(spread, 1e-12)))
            if p > 0.02:
                return False
        if not varies:
            return self._p(gain, 1) < REVERSAL_P
        if self._p(float(smooth[0] ** 2 / covariance[0, 0]), 1) >= REVERSAL_P:
            return False
        ends = np.polynomial.legendre.legvander(np.array([-1.0, 1.0]), len(smooth) - 1)
        at = ends @ smooth
        u = np.sqrt(np.einsum("ij,jk,ik->i", ends, covariance, ends))
        largest = float(np.abs(self._shapes(len(smooth) - 1) @ smooth).max())
        return bool(np.all(np.abs(at) > np.maximum(ZERO_AT_END * u, ZERO_SHARE * largest)))

    def _backlash(
        self, name: str, mean: FloatArray, covariance: FloatArray, gain: float, reasons: tuple[str, ...]
    ) -> AxisEffect:
        c, u = float(mean[0]) / MM_PER_UM, float(np.sqrt(covariance[0, 0])) / MM_PER_UM
        text = f"reversal of {2 * c:+.3g} um (mean of up minus down)"
        return self._effect(name, text, {"c_um": (c, u)}, gain, reasons, self.session.direction * mean[0], mean)

    def _lost_motion(
        self,
        name: str,
        smooth: FloatArray,
        covariance: FloatArray,
        gain: float,
        reasons: tuple[str, ...],
        *,
        exact: bool,
    ) -> AxisEffect:
        um, u = smooth / MM_PER_UM, np.sqrt(np.diag(covariance)) / MM_PER_UM
        low, high = self.session.targets_mm[[0, -1]]
        ends = 2 * np.polynomial.legendre.legvander(np.array([-1.0, 1.0]), len(smooth) - 1) @ um
        text = f"the reversal varies along the axis: {ends[0]:+.3g} um at {low:g} mm, {ends[1]:+.3g} um at {high:g} mm"
        parameters: dict[str, tuple[float, float | None]] = {
            f"c{k}_um": (float(um[k]), float(u[k])) for k in range(1, len(um))
        }
        shape = np.polynomial.legendre.legvander(self.session.s, len(smooth) - 1)
        shift = self.session.direction * (shape[:, 1:] @ smooth[1:])
        found = self._effect(name, text, parameters, gain, reasons, shift, smooth)
        return found if exact else replace(found, homogeneity_p=0.0)

    def _effect(
        self,
        name: str,
        text: str,
        parameters: Mapping[str, tuple[float, float | None]],
        gain: float,
        reasons: tuple[str, ...],
        shift: FloatArray,
        values: FloatArray,
    ) -> AxisEffect:
        nothing = np.zeros(0, dtype=np.int64)
        return AxisEffect(
            name, "tentative" if reasons else "confirmed", text, parameters, ((name, 1.0),), gain,
            float(chdtrc(1, gain)), reasons, shift, nothing, True, catalogue()[name], values,
        )  # fmt: skip


def figures_of(session: AxisSession, deviation_mm: FloatArray, kept: IntArray) -> dict[str, float]:
    """B, M, E, R, A of the readings ``kept`` in um, as far as they can be computed."""
    try:
        test = positioning_test(
            run_statistics(session.position_mm[kept], session.direction[kept].astype(np.float64), deviation_mm[kept])
        )
    except InputError:
        return {}
    figures = test.figures
    if not len(session.both):
        figures = {key.partition("_")[0]: value for key, value in figures.items()}
    return {key: float(figures[key].value) for key in SHOWN if key in figures}


def _removal(
    session: AxisSession, effects: Sequence[AxisEffect]
) -> tuple[FloatArray, IntArray, tuple[str, ...], dict[str, dict[str, float]], list[str]]:
    """What is subtracted from each reading, readings left out, names, figures before and after, and notes.

    Effects are dropped from the subtraction while it would make R or A larger: a small effect can do that by chance.
    """
    everything = np.arange(len(session))
    before = figures_of(session, session.deviation_mm, everything)
    sure = [e for e in effects if e.grade != "tentative" or e.remains]
    candidates = sorted((e for e in sure if not e.static), key=lambda e: (bool(e.remains), -e.gain))
    kept_effects = list(candidates)
    notes: list[str] = []
    while True:
        left_out: IntArray = np.zeros(0, dtype=np.int64)
        for item in kept_effects:  # leave out no readings of a cell that would keep fewer than two
            trial = np.union1d(left_out, item.left_out).astype(np.int64)
            rest = np.bincount(np.delete(session.cell, trial), minlength=int(session.cell.max()) + 1)
            if not len(item.left_out) or rest.min() >= 2:
                left_out = trial
        removed = np.zeros(len(session))
        for item in kept_effects:
            if not len(item.left_out) or not np.isin(item.left_out, left_out).all():
                removed = removed + item.shift_mm
        kept = np.setdiff1d(everything, left_out)
        after = figures_of(session, session.deviation_mm - removed, kept)
        grows = [key for key in ("R", "A") if after.get(key, 0.0) > before.get(key, np.inf) * (1 + 1e-9)]
        if not kept_effects or (after and not grows):
            break
        item = kept_effects.pop()
        notes.append(
            Message(
                "named-not-removed",
                "{name} is named but not removed: {grows} would not improve",
                name=item.name,
                grows=" and ".join(grows) or Message("the-figures", "the figures"),
            )
        )
    figures = {key: {"before": before[key], "after": after.get(key, before[key])} for key in before}
    return removed, left_out, tuple(item.name for item in kept_effects), figures, notes


def _residuals(session: AxisSession, grid: NoiseGrid, effects: Sequence[AxisEffect]) -> tuple[FloatArray, FloatArray]:
    """Readings minus the means of their targets, without and with the effects, (n,)."""
    base = np.eye(len(session.targets_mm))[session.target]

    def freed(values: FloatArray) -> FloatArray:
        means = np.linalg.lstsq(base, values, rcond=None)[0]
        return np.asarray(values - base @ means)

    shift = sum((item.shift_mm for item in effects), np.zeros(len(session)))
    return freed(session.deviation_mm), freed(session.deviation_mm - shift)


def _left_out_rms(
    session: AxisSession, effects: Sequence[AxisEffect], left_out: IntArray
) -> tuple[float, float] | None:
    """RMS of left-out readings minus their prediction, without and with the changes; one repeat per cell in turn."""
    changes = [item for item in effects if not item.static and not len(item.left_out)]
    if not changes or not session.repeated:
        return None
    kept = np.setdiff1d(np.arange(len(session)), left_out)
    columns = np.column_stack([item.shift_mm for item in changes])[kept]
    y, cell = session.deviation_mm[kept], session.cell[kept]
    number = np.array([np.count_nonzero(cell[:k] == cell[k]) for k in range(len(cell))])
    fold = (number + session.target[kept]) % max(int(number.max()) + 1, 2)
    squares: list[tuple[float, float]] = []
    for k in np.unique(fold):
        test = (fold == k) & np.isin(cell, cell[fold != k])
        train = fold != k
        base = np.eye(int(session.cell.max()) + 1)[cell]
        for_both = []
        for design in (base, np.hstack([base, columns / np.abs(columns).max()])):
            value = np.linalg.lstsq(design[train], y[train], rcond=None)[0]
            for_both.append(float(np.sum((y[test] - design[test] @ value) ** 2)))
        squares.append((for_both[0], for_both[1]))
    total = np.sum(squares, axis=0) / len(kept)
    return float(np.sqrt(total[0])), float(np.sqrt(total[1]))


def _compared(changes: AxisFit, errors: ErrorTable) -> dict[str, Any]:
    """Mean curve against predicted errors: RMS of the difference without its mean, and whether it exceeds the noise."""
    session = changes.session
    name = f"E{session.letter}{session.letter}"
    predicted = errors.at(session.readings.position_mm)[:, ERROR_NAMES.index(name)]
    base = np.eye(len(session.targets_mm))[session.target]
    reversal = session.direction[:, None] * base[:, session.both]
    curve, covariance = changes.estimate(np.hstack([changes.columns, reversal]), base)
    at = [int(np.flatnonzero(session.target == k)[0]) for k in range(base.shape[1])]
    difference = curve - predicted[at]
    middle = np.eye(len(curve)) - 1.0 / len(curve)
    difference = middle @ difference
    chi2 = float(difference @ np.linalg.pinv(middle @ covariance @ middle, rcond=1e-8, hermitian=True) @ difference)
    p = float(chdtrc(len(curve) - 1, chi2))
    largest = float(difference[np.argmax(np.abs(difference))])
    entry = {"error": name, "largest": largest / MM_PER_UM, "unit": "um", "chi2": chi2}
    return {"rms_um": float(np.sqrt(np.mean(difference**2))) / MM_PER_UM, "changes": [entry] if p < 1e-3 else []}


@dataclass(frozen=True, repr=False)
class AxisDiagnosis(DisplayedDiagnosis):
    """Diagnosis of axis runs, with one part per axis."""

    machine: Machine
    runs: AxisRuns
    axes: tuple[AxisFindings, ...]

    @property
    def word(self) -> str:
        """Overall verdict: "named" before "unknown" before "none" over all axes."""
        words = [part.word for part in self.axes]
        return next((word for word in ("named", "unknown") if word in words), "none")

    @property
    def acceptable(self) -> bool:
        """Whether the misfit of left-out readings shrinks wherever a named effect predicts them."""
        return all(
            part.left_out_rms_mm is None or part.left_out_rms_mm[1] < part.left_out_rms_mm[0] for part in self.axes
        )

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        several = len(self.axes) > 1
        effects = [_effect_dict(part, item) for part in self.axes for item in part.effects]
        unknown = [
            {
                "covariates": list(item.covariates),
                "direction": f"d{part.session.letter}",
                "rms_um": item.rms_mm / MM_PER_UM if np.isfinite(item.rms_mm) else None,
                "text": (f"{part.session.letter}: " if several else "") + item.text,
                "resembles": item.resembles or None,
                "axis": part.session.letter,
            }
            for part in self.axes
            for item in part.unknown
        ]
        against = [part.against for part in self.axes if part.against is not None]
        assumed = [part.session.letter for part in self.axes if part.noise_source == "assumed"]
        found = {
            "verdict": self.word,
            "effects": effects,
            "unknown": unknown,
            "invisible": list(dict.fromkeys(name for part in self.axes for name in part.invisible)),
            "secondary": [],
            "gap": self._misfit(),
            "advice": self._advice(),
            "reasons": [_on_axis(", ".join(assumed), NO_REPEATS)] if assumed else [],
            "notes": self._notes(),
            "noise": {part.session.letter: _noise_dict(part) for part in self.axes}
            if several
            else _noise_dict(self.axes[0]),
            "evidence": {
                "readings": len(self.runs),
                "unknowns": sum(int(part.session.cell.max()) + 1 for part in self.axes),
                "order": {part.session.letter: ORDER_TEXTS[part.session.order] for part in self.axes},
            },
            "iso_230_2": {part.session.letter: dict(part.figures) for part in self.axes},
            "taken_off": {part.session.letter: list(part.taken_off) for part in self.axes},
        }
        if against:
            rms = float(np.sqrt(np.mean([item["rms_um"] ** 2 for item in against])))
            found["against"] = {"rms_um": rms, "changes": [entry for item in against for entry in item["changes"]]}
        return found

    def _misfit(self) -> dict[str, Any]:
        before = np.concatenate([part.residual_before_mm for part in self.axes])
        after = np.concatenate([part.residual_after_mm for part in self.axes])
        left_out = [(part.left_out_rms_mm, len(part.session)) for part in self.axes if part.left_out_rms_mm is not None]
        times = None
        if left_out:
            total = sum(count for _, count in left_out)
            squares = [sum(pair[k] ** 2 * count for pair, count in left_out if pair) / total for k in (0, 1)]
            times = _pair(np.sqrt(squares[0]), np.sqrt(squares[1]))
        sources = {part.noise_source for part in self.axes}
        floor = np.sqrt(np.mean([part.sigma_mm**2 for part in self.axes]))
        return {
            "train": _pair(np.sqrt(np.mean(before**2)), np.sqrt(np.mean(after**2))),
            "heldout_lines": None,
            "heldout_stations": None,
            "heldout_times": times,
            "noise_floor_um": float(floor) / MM_PER_UM,
            "noise_floor_source": sources.pop() if len(sources) == 1 else "repeats and assumed",
        }

    def _advice(self) -> list[str]:
        known, found = catalogue(), []
        for part in self.axes:
            for item in part.effects:
                others = [name for name, _ in item.alias if name != item.name]
                if others and item.effect.card.breaker:
                    found.append(
                        Message(
                            "measure-to-separate",
                            "{breaker}: separates {name} from {other}",
                            breaker=item.effect.card.breaker,
                            name=item.name,
                            other=", ".join(others),
                        )
                    )
            if part.noise_source != "repeats":
                found.append(
                    Message(
                        "measure-three-runs",
                        "measure at least three runs in each direction: only repeats separate noise from effects",
                    )
                )
            if any(item.covariates for item in part.unknown):
                depends = ", ".join(part.unknown[0].covariates)
                found.append(
                    Message(
                        "measure-two-more-runs",
                        "two more runs with the temperatures logged: show whether the dependence on {depends} repeats",
                        depends=depends,
                    )
                )
            shown: dict[str, list[str]] = {}
            for name in part.invisible:
                shown.setdefault(known[name].card.breaker, []).append(name)
            found += [
                Message(
                    "measure-runs-to-show",
                    "{how}: would show {names}, which these runs cannot",
                    how=how,
                    names=", ".join(names),
                )
                for how, names in shown.items()
            ]
        return list(dict.fromkeys(found))

    def _notes(self) -> list[str]:
        found: list[str] = []
        for part in self.axes:
            letter = part.session.letter
            found.append(
                Message(
                    "time-order", "{letter}: time order: {order}", letter=letter, order=ORDER_TEXTS[part.session.order]
                )
            )
            found += [_on_axis(letter, text) for text in part.notes]
            if part.phi > MEMORY and part.noise_source == "repeats":
                found.append(
                    Message(
                        "scatter-autocorrelated",
                        "{letter}: the scatter is autocorrelated (neighbouring readings by {phi:.2f}, {sigma:.3g} um): repeats "
                        "do not agree, and no known effect explains it; check clamping, sensor and air before making tables",
                        letter=letter,
                        phi=part.phi,
                        sigma=part.sigma_mm / MM_PER_UM,
                    )
                )
            if any(item.name in ("warmup_drift", "linear_drift") for item in part.effects):
                found.append(_on_axis(letter, WARM_UP_NOTE))
            found += [
                Message(
                    "tentative-remains",
                    "{letter}: {name} is tentative; {remains}",
                    letter=letter,
                    name=item.name,
                    remains=item.remains,
                )
                for item in part.effects
                if item.remains
            ]
            grown = [key for key, pair in part.figures.items() if pair["after"] > pair["before"] * 1.001]
            if grown and part.taken_off:
                found.append(
                    Message(
                        "figures-grown",
                        "{letter}: {grown} are a little larger without the removed effects, which had hidden part of them",
                        letter=letter,
                        grown=", ".join(grown),
                    )
                )
            if part.taken_off:
                found.append(
                    Message(
                        "removed-listed",
                        "{letter}: removed.csv lists what was removed from each reading",
                        letter=letter,
                    )
                )
        return found

    def extended(self) -> str:
        """The machine file with the effects that belong to the machine; empty without such effects or a file."""
        sections = [text for part in self.axes for text in _sections(part)]
        if not sections or self.machine.file is None:
            return ""
        text = read_text(self.machine.file).rstrip("\n")
        return "\n".join([text, "", "", "# found by volcomp diagnose in axis runs", *sections])

    def removed_csv(self) -> str:
        """What was subtracted from each reading, um: one row per reading in time order."""
        rows: dict[str, list[Any]] = {}
        names = list(
            dict.fromkeys(item.name for part in self.axes for item in part.effects if item.name in part.taken_off)
        )
        for part in self.axes:
            session = part.session
            out = np.isin(np.arange(len(session)), part.left_out)
            columns: dict[str, Any] = {
                "axis": [session.letter] * len(session),
                "position_mm": session.position_mm,
                "direction": session.direction.astype(np.float64),
                "run": session.run.astype(np.float64),
                "order": np.arange(1.0, len(session) + 1),
                "deviation_um": session.deviation_mm / MM_PER_UM,
            }
            for name in names:
                own = [
                    i.shift_mm
                    for i in part.effects
                    if i.name == name and name in part.taken_off and not len(i.left_out)
                ]
                columns[f"{name}_um"] = sum(own, np.zeros(len(session))) / MM_PER_UM
            columns["removed_um"] = part.removed_mm / MM_PER_UM
            columns["left_out"] = out.astype(np.float64)
            columns["remaining_um"] = (session.deviation_mm - part.removed_mm) / MM_PER_UM
            for name, values in columns.items():
                rows.setdefault(name, []).extend(values)
        digits = {"position_mm": 6, "direction": 0, "run": 0, "order": 0, "left_out": 0}
        table = {
            name: values if name == "axis" else np.array(values, dtype=np.float64) for name, values in rows.items()
        }
        common = {
            f"{item.name}_{part.session.letter}": item.remains
            for part in self.axes
            for item in part.effects
            if item.remains
        }
        return format_csv(table, common, digits | {name: 4 for name in table if name.endswith("_um")})


def _on_axis(letter: str, said: str) -> str:
    """A note with the letter of its axis in front; a message keeps its code and values."""
    if not isinstance(said, Message):
        return f"{letter}: {said}"
    filled = partial(Message, said.code)
    return filled("{letter}: " + said.template, letter=letter, **said.values)


def _sections(part: AxisFindings) -> list[str]:
    """``[effects.NAME]`` sections: the reversal, normalised as in the machine file, and the effects of the machine."""
    session, found = part.session, []
    reversal = np.zeros(3)
    for item in part.effects:
        if item.grade == "tentative":
            continue
        if item.static and item.name.startswith("lost_motion"):
            reversal[1 : len(item.values)] += item.values[1:]
            if not any(e.name.startswith("backlash") for e in part.effects):
                reversal[0] += float(item.values[0])
        elif item.static:
            reversal[0] += float(item.values[0])
        elif item.name.rpartition("_")[0] in MACHINE_EFFECTS:
            found.append(section_text(item.effect, session.readings, item.values))
    if not reversal.any():
        return found
    low, high = session.machine.axes[session.axis].range_mm
    first, last = session.targets_mm[[0, -1]]
    middle, half = 0.5 * (first + last), max(0.5 * (last - first), 1e-9)
    mine = np.polynomial.Polynomial(np.polynomial.legendre.leg2poly(reversal))
    inner = np.polynomial.Polynomial([(0.5 * (low + high) - middle) / half, 0.5 * (high - low) / half])
    values = np.asarray(np.polynomial.legendre.poly2leg(mine(inner).coef), dtype=np.float64)
    values = np.pad(values, (0, 3 - len(values)))
    known = catalogue()
    found.append(section_text(known[f"backlash_{session.letter}"], session.readings, values[:1]))
    if values[1:].any():
        found.append(section_text(known[f"lost_motion_{session.letter}"], session.readings, values[1:]))
    return found


def _pair(before_mm: float, after_mm: float) -> dict[str, float]:
    return {"before_rms_um": float(before_mm) / MM_PER_UM, "after_rms_um": float(after_mm) / MM_PER_UM}


def _effect_dict(part: AxisFindings, item: AxisEffect) -> dict[str, Any]:
    return {
        "name": item.name,
        "axis": part.session.letter,
        "belongs_to": belongs_to(item.name),
        "text": item.text,
        "what_to_do": what_to_do(item.effect.card),
        "alias_set": [{"name": name, "weight": round(weight, 4)} for name, weight in item.alias],
        "parameters": {key: {"value": value, "u": u} for key, (value, u) in item.parameters.items()},
        "confidence": round(next((w for name, w in item.alias if name == item.name), 1.0), 4),
        "grade": item.grade,
        "visible_fraction": 1.0,
        "chi2": item.gain,
        "homogeneity_p": item.homogeneity_p,
        "shape_exact": item.homogeneity_p >= UNEVEN_P,
        "reasons": list(item.reasons),
    }


def _noise_dict(part: AxisFindings) -> dict[str, Any]:
    return {
        "sigma_um": part.sigma_mm / MM_PER_UM,
        "correlation_of_neighbours": part.phi,
        "source": part.noise_source,
    }
