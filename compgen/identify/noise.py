"""The uncertainty of the readings: stated by the user, by the file, or assumed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.lengths import Lengths
from compgen.core.names import MM_PER_UM
from compgen.errors import InputError
from compgen.identify.known_stations import KnownStations
from compgen.identify.systematic import SystematicInputs

Method = Literal["joint", "two-step"]
METHODS: tuple[Method, ...] = ("joint", "two-step")

#: Standard uncertainty of a laser tracer's length when neither the file nor the user states one: half of the usual
#: statement 0.2 um + 0.3 um/m at k = 2.
ASSUMED_U_UM = 0.1
ASSUMED_U_UM_PER_M = 0.15


@dataclass(frozen=True)
class IdentifyOptions:
    """What the user may say beyond the machine and the readings.

    ``u_length_um`` and ``u_length_um_per_m`` are the standard uncertainty a + b L of a reading; without them the
    comments of that name in the file count, else the usual statement of a laser tracer. ``reject`` False keeps all
    readings. ``systematic`` are the uncertainties of inputs that all readings share.

    ``method`` is "joint" or "two-step" (:mod:`compgen.identify.two_step`). ``stations`` are known beforehand, or located
    with the machine taken as perfect ("nominal"). ``u_deviation_um`` is the standard uncertainty of a measured deviation;
    it belongs to deviations files only. ``temperature`` False leaves the scales at the temperature that they had.

    ``part_scale`` "free" takes one scale out of each set-up of a part (its temperature is not known), and ``travel``
    "from-data" lets the curves end where the readings do; both belong to positions in frames of unknown pose
    (:mod:`compgen.identify.free_pose`).
    ``small_deviations`` takes deviations that are all zero, or smaller than any machine's, as they are.
    """

    u_length_um: float | None = None
    u_length_um_per_m: float | None = None
    reject: bool = True
    systematic: SystematicInputs = SystematicInputs()
    method: Method = "joint"
    stations: KnownStations | Literal["nominal"] | None = None
    u_deviation_um: float | None = None
    temperature: bool = True
    part_scale: Literal["known", "free"] = "known"
    travel: Literal["machine", "from-data"] = "machine"
    small_deviations: bool = False


@dataclass(frozen=True)
class ReadingNoise:
    """Standard uncertainty a + b L of a reading; ``source`` is "stated" or "assumed".

    ``column_um`` (n,) takes its place for readings that state their own; nan for the others.
    """

    source: str
    constant_um: float
    proportional_um_per_m: float
    column_um: FloatArray | None = None

    @property
    def uniform_mm(self) -> float | None:
        """Standard uncertainty in mm where it is the same for all readings, else None."""
        if self.proportional_um_per_m or self.column_um is not None:
            return None
        return self.constant_um * MM_PER_UM

    def sigma_mm(self, distance_mm: FloatArray) -> FloatArray:
        """Standard uncertainty in mm of readings over the given distances."""
        common = (self.constant_um + self.proportional_um_per_m * distance_mm / 1000.0) * MM_PER_UM
        if self.column_um is None:
            return common
        return np.where(np.isfinite(self.column_um), self.column_um * MM_PER_UM, common)


def reading_noise(lengths: Lengths, options: IdentifyOptions) -> ReadingNoise:
    """Return the uncertainty of the readings.

    Options count first, then the column ``u_length_um``, then the file's comments, then the usual statement.
    """
    column = _column(lengths) if options.u_length_um is None and options.u_length_um_per_m is None else None
    if column is not None and np.isfinite(column).all():
        return ReadingNoise("stated", float(np.median(column)), 0.0, column)
    noise = _common_noise(lengths, options)
    return noise if column is None else replace(noise, column_um=column)


def _column(lengths: Lengths) -> FloatArray | None:
    column = lengths.covariates.get("u_length_um")
    if column is None:
        return None
    wrong = np.flatnonzero(np.isfinite(column) & ~(column > 0))
    if wrong.size:
        file, line = lengths.origin[int(wrong[0])] if lengths.origin else (None, None)
        message = f"{column[wrong[0]]:g} is no standard uncertainty; a number above zero is due"
        raise InputError(message, file=file, line=line, field="column u_length_um")
    return column


def _common_noise(lengths: Lengths, options: IdentifyOptions) -> ReadingNoise:
    """Uncertainty a + b L of all readings."""
    constant = _stated(lengths, "u_length_um", options.u_length_um)
    proportional = _stated(lengths, "u_length_um_per_m", options.u_length_um_per_m)
    if constant is None and proportional is None:
        return ReadingNoise("assumed", ASSUMED_U_UM, ASSUMED_U_UM_PER_M)
    noise = ReadingNoise("stated", constant or 0.0, proportional or 0.0)
    values = (noise.constant_um, noise.proportional_um_per_m)
    if min(values) < 0 or not sum(values) > 0 or not np.isfinite(sum(values)):
        raise InputError(f"the uncertainty of a length is {values[0]:g} um + {values[1]:g} um/m; it must be above zero")
    return noise


def _stated(lengths: Lengths, key: str, option: float | None) -> float | None:
    if option is not None:
        return option
    text = lengths.metadata.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        file = lengths.origin[0][0] if lengths.origin else None
        raise InputError(f"the comment {key} = {text!r} is not a number", file=file) from None
