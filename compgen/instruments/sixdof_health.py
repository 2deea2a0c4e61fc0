"""Checks of the instrument from its readings alone, without reference values (``docs/sixdof.md``, "Health")."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.instruments.sixdof_instrument import (
    DIRECTIONS,
    HANDEDNESS,
    RAD_PER_ARCSEC,
    ROTATIONS,
    SetUp,
    SixDof,
    SixDofInstrument,
    cross_talk_arm_mm,
    path_mm,
)
from compgen.instruments.sixdof_reduction import RelativeRun, drift_of, errors_of_run, expected_away, reduce_runs

#: A regression counts if its slope is at least this many standard errors and it explains this share of the variance.
SIGNIFICANT, EXPLAINED = 6.0, 0.5
#: If one curve causes the other, the slopes of their coarse and fine parts differ by less than this share.
ALIKE = 0.25
#: A larger offset of L is a different set-up, not a mistake, mm.
LARGEST_OFFSET_MM = 300.0
#: A larger deviation of the reduced depth is impossible for such a target, mm.
LARGEST_DEPTH_MM = 60.0
#: Largest share of noise in the variance of a drift monitor that is still used for comparison.
NOISY = 0.2
#: Fewest readings of a run for a regression.
LEAST = 8
#: Smaller curvature of Y_QD2 - Y_QD1 is not reported, mm.
STRAIGHT_MM = 0.2 * MM_PER_UM
#: A beam that turns by less within a run is steady, rad.
STEADY_RAD = 1.5 * RAD_PER_ARCSEC
#: Spots that move by less tell nothing about their channel, mm; a difference below this share is small.
SPREAD_MM, SWAPPED = 3.0 * MM_PER_UM, 0.3
#: Share of one PSD2 step that counts as "the same zero".
ZERO_MM = 1e-9


@dataclass(frozen=True)
class Suspicion:
    """A suspected fault of the instrument or its set-up.

    Parameters
    ----------
    name : ``crosstalk_yaw``, ``crosstalk_pitch``, ``beam_drift``, ``distance_offset``, ``detector_swap``, ``mode``,
        ``second_beam``, ``drift_zero``.
    axis : letter of the axis.
    text : what was seen and its possible cause.
    evidence : the numbers.
    """

    name: str
    axis: str
    text: str
    evidence: dict[str, float]

    def summary(self) -> dict[str, object]:
        """Plain numbers for JSON."""
        return {"name": self.name, "axis": self.axis, "text": self.text, "evidence": self.evidence}


def sixdof_health(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> list[Suspicion]:
    """Return all suspicions; the readings must contain true displacements.

    A correlation of straightness with an angle of the same axis is a hint, not a proof: a machine may bend that way.
    The evidence states how well the suspected cause would explain it.
    """
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    found: list[Suspicion] = []
    for axis in sorted({run.axis for run in reduced}):
        runs = [run for run in reduced if run.axis == axis]
        found += _second_beam(readings, runs)
        found += _contradiction(machine, instrument, runs)
        found += _swapped(readings, runs)
        found += _drift(readings, instrument, runs)
        found += _crosstalk(machine, instrument, runs)
    # PSD2 must keep one zero for all axes: readings that restart at zero in every run lose the common reference
    for name in ("y_psd2_mm", "z_psd2_mm"):
        monitor = readings.signals_mm[name]
        starts = np.array([monitor[run.rows[0]] for run in reduced])
        if len(reduced) > 1 and np.abs(starts).max() < ZERO_MM and np.ptp(monitor) > 0.1 * MM_PER_UM:
            text = (
                f"{name} starts at zero in every run although it drifts: it was zeroed again. For squareness it must keep "
                "one zero for all axes"
            )
            found.append(Suspicion("drift_zero", "", text, {"range_um": float(np.ptp(monitor)) / MM_PER_UM}))
    return found


def turning_beams(machine: Machine, readings: SixDof, instrument: SixDofInstrument) -> list[Suspicion]:
    """Axes during which the beam turned more than one that has warmed up, although the drift monitor takes it off."""
    reduced = reduce_runs(readings, instrument, expected_away(machine, instrument))
    axes = sorted({run.axis for run in reduced})
    return [item for axis in axes for item in _turning(readings, instrument, [r for r in reduced if r.axis == axis])]


def _letter(runs: Sequence[RelativeRun]) -> str:
    return AXES[runs[0].axis]


def second_beam_lines(readings: SixDof, runs: Sequence[RelativeRun]) -> dict[str, float]:
    """Slope (mm/mm of L) of Y_QD2 - Y_QD1 and its largest distance from the straight line (mm); empty without Y_QD2."""
    second = readings.signals_mm.get("y_qd2_mm")
    if second is None:
        return {}
    slopes, bows = [], []
    for run in runs:
        difference = second[run.rows] - readings.signals_mm["y_qd1_mm"][run.rows]
        if np.isnan(difference).any() or len(difference) < 3:
            return {}
        line = np.polyfit(run.distance_mm, difference, 1)
        slopes.append(float(line[0]))
        bows.append(difference - np.polyval(line, run.distance_mm))
    bow = np.mean(bows, axis=0) if len({len(part) for part in bows}) == 1 else bows[0]
    return {"slope": float(np.mean(slopes)), "bow_mm": float(np.abs(bow).max())}


def _second_beam(readings: SixDof, runs: Sequence[RelativeRun]) -> Iterator[Suspicion]:
    """Check that Y_QD2 - Y_QD1 is a straight line in L: it depends neither on the errors nor on drift."""
    lines = second_beam_lines(readings, runs)
    if not lines:
        return
    differences = [
        readings.signals_mm["y_qd2_mm"][run.rows] - readings.signals_mm["y_qd1_mm"][run.rows] for run in runs
    ]
    noise = float(np.sqrt(np.mean([np.mean(np.diff(part, n=2) ** 2) / 6.0 for part in differences])))
    limit = max(STRAIGHT_MM, 5.0 * noise / np.sqrt(len(runs)))
    if lines["bow_mm"] > limit:
        text = (
            f"Y_QD2 - Y_QD1 bends by {lines['bow_mm'] / MM_PER_UM:.2f} um, but must be a straight line in L whatever the axis "
            "does: a clipped beam, a spot that crosses an edge of its cube corner, or detectors that do not agree"
        )
        evidence = {"bow_um": lines["bow_mm"] / MM_PER_UM, "limit_um": limit / MM_PER_UM, "slope": lines["slope"]}
        yield Suspicion("second_beam", _letter(runs), text, evidence)


def _contradiction(machine: Machine, instrument: SixDofInstrument, runs: Sequence[RelativeRun]) -> Iterator[Suspicion]:
    """Find displacements whose sign contradicts chain, mode and beam direction."""
    expected = expected_away(machine, instrument)[runs[0].axis]
    wrong = [run.run for run in runs if run.away != expected]
    if wrong:
        text = (
            "the displacement is opposite to chain, mode and beam_direction: one of them is wrong, or "
            "the axis is commanded the other way"
        )
        yield Suspicion("mode", _letter(runs), text, {"expected": float(expected), "runs": float(len(wrong))})


def _swapped(readings: SixDof, runs: Sequence[RelativeRun]) -> Iterator[Suspicion]:
    """Find two exchanged channels: angles and drift monitor are small, the spots of a long run are not."""
    spots = readings.signals_mm

    def size(first: str, second: str | None = None) -> float:
        """Root mean square of a signal, or of the difference of two, about its line in L."""
        parts = []
        for run in runs:
            value = spots[first][run.rows] - (0.0 if second is None else spots[second][run.rows])
            parts.append(value - np.polyval(np.polyfit(run.distance_mm, value, 1), run.distance_mm))
        return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

    second = spots.get("y_qd2_mm")
    seen = second is not None and not np.isnan(second).any()
    own, wrong, by = ("y_qd1_mm", "z_qd1_mm", "y_qd2_mm") if seen else ("z_qd1_mm", "y_qd1_mm", "z_qd2_mm")
    same, other, spread = size(own, by), size(wrong, by), size(by)
    if spread > SPREAD_MM and other < SWAPPED * min(same, spread):
        names = [name.removesuffix("_mm").upper() for name in (wrong, own, by)]
        text = f"{names[0]}, not {names[1]}, follows {names[2]}: the channels of the first detector are swapped"
        yield Suspicion("detector_swap", _letter(runs), text, {"own_um": same * 1e3, "other_um": other * 1e3})


def _turning(readings: SixDof, instrument: SixDofInstrument, runs: Sequence[RelativeRun]) -> Iterator[Suspicion]:
    """Find a beam that turns more within a run than one that has warmed up."""
    axis, focal_mm = runs[0].axis, instrument.optics.focal_length_mm
    fixed = SetUp(axis, 1, instrument.axes[axis].set_up.beam_direction)
    drift = [drift_of(readings, run.rows, focal_mm) for run in runs]
    largest = float(max(np.ptp(own, axis=0).max() for own in drift))
    if largest <= STEADY_RAD:
        return
    paths = [path_mm(instrument.optics, fixed, run.distance_mm) for run in runs]
    moved_mm = float(max(np.ptp(own * path[:, None], axis=0).max() for own, path in zip(drift, paths, strict=True)))
    text = (
        f"the beam turns by up to {largest / RAD_PER_ARCSEC:.2g} arcsec within a run, {moved_mm / MM_PER_UM:.2g} um at the "
        "target; the drift monitor takes it off, as far as its gain is right: let the laser warm up and shield the beam"
    )
    evidence = {"range_arcsec": largest / RAD_PER_ARCSEC, "at_target_um": moved_mm / MM_PER_UM}
    yield Suspicion("beam_drift", AXES[axis], text, evidence)


def _drift(readings: SixDof, instrument: SixDofInstrument, runs: Sequence[RelativeRun]) -> Iterator[Suspicion]:
    """Find residual drift: angle or straightness, about the mean of the runs, follows the drift monitor."""
    if len(runs) < 2 or len({len(run.rows) for run in runs}) != 1:
        return
    axis, fixed = runs[0].axis, SetUp(runs[0].axis, 1, instrument.axes[runs[0].axis].set_up.beam_direction)
    drift = np.array([drift_of(readings, run.rows, instrument.optics.focal_length_mm) for run in runs])
    if np.ptp(drift) < 0.1 * RAD_PER_ARCSEC:
        return
    path = path_mm(instrument.optics, fixed, runs[0].distance_mm)
    for channel, name in ((0, "yaw"), (1, "pitch")):
        noise = float(np.mean(np.diff(drift[:, :, channel], n=2, axis=1) ** 2)) / 6.0
        if noise > NOISY * float(np.mean(_free(drift[:, :, channel]) ** 2)):
            continue  # what the correction took over from a noisy monitor would be seen, not drift
        turn = np.array([run.turn_rad[:, ROTATIONS[axis][channel]] for run in runs])
        found = _regression(_free(drift[:, :, channel]), _free(turn))
        if found and abs(found["slope"]) > 0.1:
            text = f"{name} follows the drift monitor with slope {found['slope']:.2f}: gain, sign or channel of PSD2"
            yield Suspicion("beam_drift", AXES[axis], text, found)
        shift = np.array([run.shift_mm[:, DIRECTIONS[axis][1 + channel]] for run in runs])
        found = _regression(_free(drift[:, :, channel] * path), _free(shift))
        if found and abs(found["slope"]) > 0.1:
            text = f"straightness follows PSD2 times the path with slope {found['slope']:.2f}: gain or sign of PSD2"
            yield Suspicion("beam_drift", AXES[axis], text, found)


def _free(values: FloatArray) -> FloatArray:
    """Values (runs, n) about the mean of the runs, each run without its mean, flattened."""
    rest = values - values.mean(axis=0)
    return np.asarray((rest - rest.mean(axis=1, keepdims=True)).ravel())


def _crosstalk(machine: Machine, instrument: SixDofInstrument, runs: Sequence[RelativeRun]) -> Iterator[Suspicion]:
    """Find straightness in proportion to an angle of the same axis: an incorrect arm, t or L."""
    if any(run.away != expected_away(machine, instrument)[run.axis] for run in runs):
        return
    errors = [errors_of_run(machine, instrument, run) for run in runs]
    if len({len(run.position_mm) for run in errors}) != 1:
        return
    axis, set_up, optics = runs[0].axis, instrument.axes[runs[0].axis].set_up, instrument.optics
    delta, eps = (np.mean([getattr(run, name) for run in errors], axis=0) for name in ("delta_mm", "eps_rad"))
    position = errors[0].position_mm
    along = (position - position.mean()) / np.ptp(position)
    kappa = HANDEDNESS[axis]
    at_tool = runs[0].away < 0  # only then does L enter the straightness
    largest = LARGEST_OFFSET_MM if at_tool else LARGEST_DEPTH_MM
    arm = float(np.abs(cross_talk_arm_mm(optics, set_up, runs[0].distance_mm)).mean())
    for channel, (name, sign) in enumerate((("yaw", kappa), ("pitch", -kappa))):
        straight, angle = delta[:, DIRECTIONS[axis][1 + channel]], eps[:, ROTATIONS[axis][channel]]
        # the regression without lines must agree with that without cubics: smooth curves are often alike by chance
        found, fine = (
            _regression(*(value - np.polyval(np.polyfit(along, value, order), along) for value in (angle, straight)))
            for order in (1, 3)
        )
        if not found or not fine or abs(found["slope"] - fine["slope"]) > ALIKE * abs(found["slope"]):
            continue
        if not 1.0 < abs(found["slope"]) < largest:
            continue
        found |= {"arm_mm": arm, "expected_arm_sign": float(sign)}
        which = "distance_offset" if at_tool else f"crosstalk_{name}"
        text = f"straightness is {found['slope']:+.1f} mm times {name} ({100 * found['explained']:.0f} % of it): " + (
            "the distance L may be wrong by this amount" if at_tool else "a wrong t or mode, or a bend of the axis"
        )
        yield Suspicion(which, AXES[axis], text, found)


def _regression(cause: FloatArray, effect: FloatArray) -> dict[str, float] | None:
    """Slope of effect against cause, both centred, its standard error, the explained share; None if insignificant."""
    square = float(cause @ cause)
    if len(cause) < LEAST or square == 0.0:
        return None
    slope = float(cause @ effect) / square
    rest = effect - slope * cause
    total = float(effect @ effect)
    error = float(np.sqrt(rest @ rest / (len(cause) - 2) / square))
    explained = 1.0 - float(rest @ rest) / total if total > 0 else 0.0
    if abs(slope) < SIGNIFICANT * error or explained < EXPLAINED:
        return None
    return {"slope": slope, "standard_error": error, "explained": explained}
