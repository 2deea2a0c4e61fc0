"""Outputs of a model of heat, read back and run over a day that goes through what was trained, and beyond it."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from compgen.controls.heat_outputs import ALONG, HeatOutput, without_tilt
from compgen.controls.shared.base import SourceFile
from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES, MM_PER_UM
from compgen.errors import InputError
from compgen.heat import HeatModel, Temperatures

#: The day on which outputs are tried: places within the hull, minutes from one to the next, minutes between readings.
_PLACES, _LEG_MIN, _STEP_MIN = 5, 30, 1
#: How far beyond the hull the last leg goes, of the margin.
_BEYOND = 2.0
#: What may be left of the growth, of its rms, and at least, um.
_MOST_LEFT, _LEAST_UM = 0.03, 0.2


@dataclass(frozen=True)
class HeatExport:
    """Files, what they leave of the growth of the model on the day of the trial, and what the control cannot express.

    ``before`` and ``after`` are by axis: rms and largest, um, within the hull; ``beyond_um`` is the largest offset where the
    model is silent.
    """

    output: HeatOutput
    files: Mapping[str, str]
    before: Mapping[str, tuple[float, float]]
    after: Mapping[str, tuple[float, float]]
    beyond_um: float
    not_expressed: tuple[str, ...]

    @property
    def reasons(self) -> list[str]:
        """Why the files are not acceptable; none if they are."""
        found = []
        for axis, (rms, _) in self.after.items():
            allowed = max(_MOST_LEFT * self.before[axis][0], _LEAST_UM)
            if axis in self.output_axes and rms > allowed:
                found.append(
                    f"{axis}: of {self.before[axis][0]:.2f} um rms of growth {rms:.2f} are left; at most {allowed:.2f} should be"
                )
        if self.output.fades and self.beyond_um > _LEAST_UM:
            found.append(f"far outside of what was trained it still adds up to {self.beyond_um:.2f} um")
        return found

    @property
    def output_axes(self) -> tuple[str, ...]:
        """Axes of which the model says something that the output holds."""
        return tuple(axis for axis in self.before if axis not in self.not_expressed)

    def summary(self) -> dict[str, Any]:
        """Plain values for ``result.json``."""

        def figures(by_axis: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
            return {axis: {"rms_um": rms, "max_um": most} for axis, (rms, most) in by_axis.items()}

        return {
            "controller": self.output.name,
            "accepted": not self.reasons,
            "reasons": self.reasons,
            "before": figures(self.before),
            "after": figures(self.after),
            "beyond_hull_um": self.beyond_um,
            "not_expressed": list(self.not_expressed),
            "stated": [{"evidence": how, "text": text} for how, text in self.output.stated()],
            "files": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in self.files.items()},
        }


def trial_day(model: HeatModel, seed: int = 7) -> Temperatures:
    """Temperatures that go from place to place within the hull, then beyond it and rest there; the hull is convex."""
    rng = np.random.default_rng(seed)
    sensors = model.sensors
    places = [_place(model, rng) for _ in range(_PLACES)]
    ends = next(item for item in model.hull if item.sensor == sensors[0] and not item.minus)
    middle = {item.sensor: (item.low + item.high) / 2 for item in model.hull if not item.minus}
    beyond = {name: value + 0.1 * (middle[name] - value) for name, value in places[-1].items()}
    beyond[sensors[0]] = ends.high + _BEYOND * ends.margin_k
    places += [beyond, beyond]
    at = np.arange(len(places)) * _LEG_MIN * 60.0
    time_s = np.arange(0.0, at[-1] + 1.0, _STEP_MIN * 60.0)
    read = {name: np.interp(time_s, at, [place[name] for place in places]) for name in sensors}
    return Temperatures(time_s, read)


def _place(model: HeatModel, rng: np.random.Generator) -> dict[str, float]:
    """Draw a place in the hull: by rejection, then nearer to the middle until it is inside."""
    middle = {item.sensor: (item.low + item.high) / 2 for item in model.hull if not item.minus}
    found = {item.sensor: rng.uniform(item.low, item.high) for item in model.hull if not item.minus}
    for _ in range(60):
        if all(
            float(item.outside_k({name: np.array([value]) for name, value in found.items()})[0]) <= 0
            for item in model.hull
        ):
            return found
        found = {name: value + 0.1 * (middle[name] - value) for name, value in found.items()}
    return found


def judged_output(output: HeatOutput, model: HeatModel, sources: Sequence[SourceFile]) -> HeatExport:
    """Read files back, run them over the trial day, and compare with the model."""
    own = without_tilt(model)
    if not own.directions:
        raise InputError(
            "the model has no displacement of X, Y or Z, only tilts, which no control takes", file=model.source
        )
    day = trial_day(own)
    share, _ = own.weight(day)
    predicted = own.predict(day)
    moved = np.zeros((len(day), 3))
    for axis, name in ALONG.items():
        if name in own.directions:
            moved[:, AXES.index(axis)] = predicted.moved[name]
    left = moved + output.parse(sources).added(day) / MM_PER_UM
    inside, silent = share == 1.0, share == 0.0
    inside[:2] = False  # an offset begins at its limited rate
    axes = [axis for axis, name in ALONG.items() if name in own.directions]
    before, after = ({axis: _figures(field[inside, AXES.index(axis)]) for axis in axes} for field in (moved, left))
    rest = np.flatnonzero(silent)[-_LEG_MIN // 2 :]
    beyond = float(np.abs(left[rest]).max()) if rest.size else 0.0
    lost = tuple(axis for axis in axes if axis not in output.expressed(own))
    return HeatExport(output, {source.path.name: source.text for source in sources}, before, after, beyond, lost)


def _figures(values: FloatArray) -> tuple[float, float]:
    return float(np.sqrt(np.mean(values**2))), float(np.abs(values).max())


def export_heat(output: HeatOutput, model: HeatModel) -> HeatExport:
    """Files of an output, read back and judged."""
    files = output.files(without_tilt(model))
    sources = [SourceFile(Path(name), files[name]) for name in output.read_files]
    found = judged_output(output, model, sources)
    return HeatExport(output, files, found.before, found.after, found.beyond_um, found.not_expressed)
