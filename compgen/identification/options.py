"""Options of an identification: uncertainty of the readings, known stations, and numbers that are known without a file."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from compgen.data.arguments import of_kind, text_of
from compgen.data.csv_files import FloatArray, read_csv
from compgen.data.error_table import (
    ARMS,
    LARGEST_MM,
    LARGEST_RAD,
    SPANS_KEY,
    Curve,
    ErrorTable,
    ReversalCurves,
    format_spans,
)
from compgen.data.lengths import POSITION_COLUMNS, Lengths
from compgen.data.machine import MM_PER_UNIT, Machine
from compgen.data.names import (
    AXES,
    LARGEST,
    MM_PER_UM,
    RAD_PER_URAD,
    SMALLEST,
    SQUARENESS_NAMES,
    error_named,
)
from compgen.data.toml_files import flag, not_negative, option
from compgen.errors import InputError, Message, nearest
from compgen.identification.adjust.propagation import SystematicInputs
from compgen.identification.adjust.starts import station_start
from compgen.identification.adjust.unknowns import IntArray, KnownPositions, State
from compgen.kinematics.first_order import tool_of

if TYPE_CHECKING:
    from compgen.data.deviations import Artefact, Deviations

# Stations with known machine coordinates: from a file, or located with the machine assumed perfect.
#
# A known coordinate is one more observation, s = s0 with standard uncertainty u, and no more than that: the rank shows
# which errors one or two stations determine (``docs/method.md``, "One or two stations").


#: A station without a stated uncertainty is fixed within this: a nanometre is negligible for a tracer.
FIXED_MM = 1e-6

#: Columns of ``stations.csv`` of an identification.
U_OF_IDENTIFY = ("u_x_um", "u_y_um", "u_z_um")
OF_IDENTIFY = (*U_OF_IDENTIFY, "setup", "segment", "dead_length_mm", "u_dead_length_um", "readings", "residual_rms_um")


@dataclass(frozen=True)
class KnownStations:
    """Names (k), positions in the machine frame (k, 3) and standard uncertainty of each coordinate (k,), mm."""

    names: tuple[str, ...]
    position_mm: FloatArray
    u_mm: FloatArray

    def indices(self, stations: Sequence[str]) -> IntArray:
        """Return the indices of the known ones among ``stations``; InputError for an unknown name."""
        for name in self.names:
            if name not in stations:
                message = f"the stations file contains {name!r}, but the measurement has no such station"
                raise InputError(f"{message}; {nearest(name, stations)}")
        return np.array([list(stations).index(name) for name in self.names], dtype=np.int64)


def read_stations(path: str | Path) -> KnownStations:
    """Read known stations: CSV with ``station, x_mm, y_mm, z_mm`` and, if they are not exact, ``u_mm``.

    ``stations.csv`` of an identification is valid, with its uncertainties; several rows of a station are accepted.
    """
    optional = ("u_mm", *OF_IDENTIFY)
    table = read_csv(path, required=("station", *POSITION_COLUMNS), optional=optional)
    names = table.names("station")
    position_mm = np.column_stack([table.numbers(name) for name in POSITION_COLUMNS])
    kept: list[int] = []
    for row, name in enumerate(names):
        first = names.index(name)
        if first == row:
            kept.append(row)
        elif "dead_length_mm" not in table.columns or np.max(np.abs(position_mm[row] - position_mm[first])) > 1e-6:
            raise table.fail(row, "station", f"{name!r} is already in line {table.lines[first]}")
    u_mm = np.zeros(len(table))
    if "u_mm" in table.columns:
        u_mm = table.numbers("u_mm")
    elif all(name in table.columns for name in U_OF_IDENTIFY):
        u_mm = np.max([table.numbers(name) for name in U_OF_IDENTIFY], axis=0) * MM_PER_UM
    for row in np.flatnonzero(u_mm < 0)[:1]:
        raise table.fail(
            int(row), "u_mm", f"{u_mm[row]:g} is negative; expected a standard uncertainty of zero or more"
        )
    return KnownStations(tuple(names[row] for row in kept), position_mm[kept], np.maximum(u_mm[kept], FIXED_MM))


def locate_stations(machine: Machine, lengths: Lengths) -> KnownStations:
    """Locate every station with the machine assumed perfect (single-station method of Zha & Zhang 2024, section 1).

    The errors of the machine affect the positions. They are smooth over the volume, so more readings do not average
    them out: the uncertainty is the effect of errors of the size of the residual RMS if all act in the worst way,
    sqrt(n) times that of independent ones.
    """
    target = lengths.position_mm + tool_of(machine, lengths.tool_mm)
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    positions, u = [], []
    for k, name in enumerate(lengths.stations):
        rows = lengths.station == k
        _, group = np.unique(setup[rows], return_inverse=True)
        position, uncertainty = _locate(name, target[rows], lengths.length_mm[rows], group.ravel().astype(np.int64))
        positions.append(position)
        u.append(uncertainty)
    return KnownStations(lengths.stations, np.array(positions), np.array(u))


def _locate(name: str, target_mm: FloatArray, length_mm: FloatArray, group: IntArray) -> tuple[FloatArray, float]:
    groups = int(group.max()) + 1
    freedom = len(length_mm) - 3 - groups
    if freedom < 1:
        raise InputError(
            Message(
                "station-few-readings",
                "station {name!r} has only {length_mm} reading(s); it cannot be located",
                name=name,
                length_mm=len(length_mm),
            )
        )
    start = station_start(target_mm, length_mm, group, groups)
    unknowns = np.concatenate([start.position_mm, start.dead_length_mm])
    for _ in range(20):
        sight = target_mm - unknowns[:3]
        distance = np.linalg.norm(sight, axis=1)
        residual = distance - unknowns[3 + group] - length_mm
        jacobian = np.column_stack([-sight / distance[:, None], -(group[:, None] == np.arange(groups)).astype(float)])
        step = np.linalg.lstsq(jacobian, -residual, rcond=1e-12)[0]
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-9:
            break
    rms = float(np.sqrt(np.sum(residual**2) / freedom))
    cofactor = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14)
    worst = float(np.sqrt(len(length_mm) * np.linalg.eigvalsh(cofactor[:3, :3]).max()))
    return unknowns[:3], max(rms * worst, FIXED_MM)


def with_known_start(
    start: State, known: KnownStations, lengths: Lengths, target_mm: FloatArray, group: IntArray
) -> State:
    """Return the start with the known positions, and the dead lengths that go with them."""
    stations, dead = start.stations_mm.copy(), start.dead_length_mm.copy()
    for k, position in zip(known.indices(lengths.stations).tolist(), known.position_mm, strict=True):
        stations[k] = position
        rows = np.flatnonzero(lengths.station == k)
        rest = np.linalg.norm(target_mm[rows] - position, axis=1) - lengths.length_mm[rows]
        for own in np.unique(group[rows]).tolist():
            dead[own] = float(np.median(rest[group[rows] == own]))
    return State(start.errors, stations, dead)


def known_positions(known: KnownStations, stations: Sequence[str], sigma_mm: float) -> KnownPositions:
    """Return known stations as observations in a problem in which a reading of standard uncertainty ``sigma_mm`` has weight 1."""
    return KnownPositions(known.indices(stations), known.position_mm, (sigma_mm / known.u_mm) ** 2)


# The uncertainty of the readings: stated by the user, by the file, or assumed.


Method = Literal["joint", "two-step"]
METHODS: tuple[Method, ...] = ("joint", "two-step")

#: Standard uncertainty of a laser tracer's length if neither the file nor the user states one: half of the usual
#: statement 0.2 um + 0.3 um/m at k = 2.
ASSUMED_U_UM = 0.1
ASSUMED_U_UM_PER_M = 0.15
#: Standard uncertainty of a measured deviation if none is stated.
ASSUMED_U_DEVIATION_UM = 1.0


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of the user in addition to machine and readings.

    ``u_length_um`` and ``u_length_um_per_m`` are the standard uncertainty a + b L of a reading; without them the
    comments of that name in the file are used, otherwise the usual statement of a laser tracer. ``reject`` False keeps
    all readings. ``systematic`` are the uncertainties of inputs common to all readings.

    ``method`` is "joint" or "two-step" (:mod:`compgen.identification.two_step`). ``stations`` are the known ones, or located
    with the machine assumed perfect ("nominal"). ``u_deviation_um`` is the standard uncertainty of a measured
    deviation; it applies to deviations files only. ``temperature`` False leaves the scales at their measured
    temperature.

    ``part_scale`` "free" removes one scale from each set-up of a part (of unknown temperature), and ``travel``
    "from-data" limits the curves to the range of the readings; both apply to positions in frames of unknown pose
    (:mod:`compgen.identification.positions`). ``nodes`` "from-data" takes as many nodes as the readings of tracers determine.
    ``small_deviations`` accepts deviations that are all zero, or too small for a
    machine.

    Examples
    --------
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> lengths = compgen.read_lengths("examples/zha-gantry.lengths.csv")
    >>> options = compgen.IdentifyOptions(u_length_um=0.2, u_length_um_per_m=0.3)  # half as good as the file says
    >>> round(compgen.identify(machine, lengths, options).reduced_chi_square, 2)
    0.25
    """

    u_length_um: float | None = option(
        None, "Constant part of the standard uncertainty of a length, um.", in_job=not_negative
    )
    u_length_um_per_m: float | None = option(
        None, "Part of the standard uncertainty that grows with the length, um/m.", in_job=not_negative
    )
    reject: bool = option(True, "Reject no reading, however far it is from the model.", name="--keep-all")
    systematic: SystematicInputs = SystematicInputs()
    method: Method = option(
        "joint",
        "joint: errors and stations in one adjustment; two-step: the tracers first locate themselves and all points, "
        "which needs four stations at common points.",
    )
    stations: KnownStations | Literal["nominal"] | None = option(
        None,
        "CSV with known stations (station, x_mm, y_mm, z_mm; optional u_mm, exact without), or the word nominal: "
        "located with the machine assumed perfect.",
        metavar="FILE",
    )
    u_deviation_um: float | None = option(
        None,
        "Standard uncertainty of a measured deviation (*.deviations.csv), um; default: from the file, otherwise 1 um scaled by "
        "the residuals.",
        in_job=not_negative,
    )
    temperature: bool = option(
        True,
        "Leave the scales at their measured temperature; by default they are corrected to 20 degC if the file has "
        "temp_x_c, temp_y_c, temp_z_c and the machine file expansion_um_per_m_k.",
        name="--no-temperature",
        in_job=flag,
    )
    part_scale: Literal["known", "free"] = option(
        "known",
        "Scale of a measured part (*.part.csv): known (1, or by the temperatures in the file), or free: one unknown "
        "scale for each set-up, which absorbs the mean of the scale errors of the axes.",
    )
    travel: Literal["machine", "from-data"] = option(
        "machine",
        "machine: curves over the whole travel, with nodes beyond the readings tied by smoothness; from-data: over the "
        "range that the readings cover. For parts, and deviations at one height or without a component.",
        name="--range",
    )
    nodes: Literal["machine", "from-data"] = option(
        "machine",
        "Nodes of the curves identified from tracer lengths: those of the machine file, or from-data: at most "
        "as many of them as the readings determine.",
    )
    small_deviations: bool = option(
        False,
        "Accept deviations that are all zero, or all below 0.1 um; without it they are refused, because then "
        "nothing was measured, or the values are in mm.",
        in_job=flag,
    )

    def __post_init__(self) -> None:
        for name in ("u_length_um", "u_length_um_per_m", "u_deviation_um"):
            value = getattr(self, name)
            of_kind(name, value, float, int, np.floating, type(None))
            if value is not None and not 0.0 <= value < np.inf:
                text = f"{value:g} is not a standard uncertainty; give a finite number of zero or more, or leave it out"
                raise InputError(text, field=name)
        of_kind("systematic", self.systematic, SystematicInputs)
        for name, allowed in (
            ("method", METHODS), ("part_scale", ("known", "free")), ("travel", ("machine", "from-data")),
            ("nodes", ("machine", "from-data")),
        ):  # fmt: skip
            if text_of(name, getattr(self, name)) not in allowed:
                raise InputError(
                    Message(
                        "choice-unknown",
                        "{value!r} is not known; give {allowed}",
                        value=getattr(self, name),
                        allowed=" or ".join(allowed),
                    ),
                    field=name,
                )
        if not (isinstance(self.stations, str) and self.stations == "nominal"):
            of_kind("stations", self.stations, KnownStations, type(None))


@dataclass(frozen=True)
class ReadingNoise:
    """Standard uncertainty a + b L of a reading; ``source`` is "stated" or "assumed".

    ``column_um`` (n,) replaces it for readings that state their own; nan for the others.
    """

    source: str
    constant_um: float
    proportional_um_per_m: float
    column_um: FloatArray | None = None

    @property
    def uniform_mm(self) -> float | None:
        """Standard uncertainty in mm if it is the same for all readings, otherwise None."""
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

    The order of precedence is: options, the column ``u_length_um``, the comments of the file, the usual statement.
    """
    column = _column(lengths) if options.u_length_um is None and options.u_length_um_per_m is None else None
    if column is not None and np.isfinite(column).all():
        return ReadingNoise("stated", float(np.median(column)), 0.0, column)
    constant, proportional = options.u_length_um, options.u_length_um_per_m
    constant = number_in_comment(lengths, "u_length_um") if constant is None else constant
    proportional = number_in_comment(lengths, "u_length_um_per_m") if proportional is None else proportional
    if constant is None and proportional is None:
        return ReadingNoise("assumed", ASSUMED_U_UM, ASSUMED_U_UM_PER_M, column)
    values = (constant or 0.0, proportional or 0.0)
    if min(values) < 0 or not sum(values) > 0 or not np.isfinite(sum(values)):
        raise InputError(
            Message(
                "u-length-not-positive",
                "the uncertainty of a length is {values:g} um + {values2:g} um/m; it must be above zero",
                values=values[0],
                values2=values[1],
            )
        )
    return ReadingNoise("stated", *values, column)


def _column(lengths: Lengths) -> FloatArray | None:
    column = lengths.covariates.get("u_length_um")
    if column is None:
        return None
    wrong = np.flatnonzero(np.isfinite(column) & ~(column > 0))
    if wrong.size:
        file, line = lengths.origin[int(wrong[0])] if lengths.origin else (None, None)
        message = f"{column[wrong[0]]:g} is not a standard uncertainty; give a number above zero"
        raise InputError(message, file=file, line=line, field="column u_length_um")
    return column


def number_in_comment(readings: Lengths | Deviations | Artefact, key: str) -> float | None:
    """Return the number in the comment ``# key = ...`` of the readings; None without one, InputError if not a number."""
    text = readings.metadata.get(key)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError:
        file = readings.origin[0][0] if readings.origin else None
        raise InputError(
            Message("comment-not-number", "the comment {key} = {text!r} is not a number", key=key, text=text), file=file
        ) from None


def deviation_sigma(deviations: Deviations, options: IdentifyOptions) -> tuple[FloatArray, str]:
    """Standard uncertainty of each component (n, 3) in mm, and "stated" or "assumed".

    The order of precedence is: the option, the columns of the file, its comment, the usual uncertainty.
    """
    if options.u_deviation_um is None and deviations.u_mm is not None:
        return deviations.u_mm, "stated"
    stated = stated_deviation_um(deviations, options, "u_deviation_um")
    u_um = ASSUMED_U_DEVIATION_UM if stated is None else stated
    return np.full(deviations.deviation_mm.shape, u_um * MM_PER_UM), "assumed" if stated is None else "stated"


def stated_deviation_um(readings: Deviations | Artefact, options: IdentifyOptions, key: str) -> float | None:
    """Standard uncertainty of a deviation by the option, else by the comment ``key`` of the file, um; None without both."""
    stated = options.u_deviation_um
    stated = number_in_comment(readings, key) if stated is None else stated
    if stated is not None and not 0 < stated < np.inf:
        raise InputError(
            Message(
                "u-deviation-not-positive",
                "the uncertainty of a deviation is {stated:g} um; it must be above zero",
                stated=stated,
            )
        )
    return stated


# Numbers that somebody read from a granite square, a dial gauge or a certificate: squareness, backlash, scale of an axis.


#: Radians in each unit of an angle or a ratio; the first is meant where none is given.
ANGLES = {"urad": RAD_PER_URAD, "um/m": RAD_PER_URAD, "µrad": RAD_PER_URAD, "µm/m": RAD_PER_URAD, "mrad": 1e-3, "mm/m": 1e-3,
          "arcsec": np.pi / 648000.0, '"': np.pi / 648000.0, "ppm": 1e-6}  # fmt: skip
#: mm in each unit of a length; the first is meant where none is given.
LENGTHS = {"um": MM_PER_UM, "µm": MM_PER_UM, "mm": 1.0}
_NUMBER = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?"
_STATED = re.compile(
    rf"({_NUMBER})(?:\s*/\s*({_NUMBER}))?(?:\s*(?:±|\+-|\+/-)\s*({_NUMBER}))?\s*([a-zA-Zµ\"]+(?:/[a-z]+)?)?"
)
_SPAN = re.compile(r"(\d{1,6}(?:\.\d{1,6})?)(?:\s?[x×]\s?(\d{1,6}(?:\.\d{1,6})?))?\s?(mm|in|\")?")
#: What each squareness error is, and what a positive one looks like.
SQUARENESS = {
    "EC0Y": ("Y to X", "the angle between +X and +Y is larger than 90 degrees"),
    "EB0Z": ("Z to X", "the angle between +X and +Z is smaller than 90 degrees"),
    "EA0Z": ("Z to Y", "the angle between +Y and +Z is larger than 90 degrees"),
}
#: The comment ``source`` of errors that are numbers of the command line.
STATED_SOURCE = "numbers of the command line"
#: What says that a number is a reversal value B of ISO 230-2.
_REVERSAL = re.compile(r"[Bb]\s*=\s*")
#: A number without a unit that is below this was hardly read in the unit that is meant then, but in the other one.
_LEAST = {"urad": (1.0, "mm/m"), "um": (0.5, "mm")}
_ABOUT = {
    key: name for name, keys in (("EC0Y", "C XY YX"), ("EB0Z", "B XZ ZX"), ("EA0Z", "A YZ ZY")) for key in keys.split()
}


@dataclass(frozen=True)
class StatedNumbers:
    """Squareness, backlash and scale as given: ``VALUE[±U][UNIT]`` by name; U is the standard uncertainty.

    Signs are those of the errors: of the tool relative to the workpiece, actual minus commanded.

    Examples
    --------
    >>> import compgen
    >>> stated = StatedNumbers(squareness={"EC0Y": "25±3"}, scale={"Y": "-12um/m"})
    >>> errors = stated.errors(compgen.load_machine("zha-gantry"))
    >>> errors
    <ErrorTable: 2 errors of zha-gantry: EYY, EC0Y>
    """

    squareness: Mapping[str, str] = option(
        None,
        "Squareness error, urad unless another unit follows (um/m, mm/m, arcsec, or a ratio such as 0.02/300), with its "
        "standard uncertainty: EC0Y=25±3. @ and the length of the arms of the square, mm, where they are shorter than the "
        "travel: EC0Y=25±3@300, or 25±3@300x200. Positive: EC0Y and EA0Z, angle above 90 degrees between +X and +Y, +Y and +Z; "
        "EB0Z, angle below 90 degrees between +X and +Z. May be given several times.",
        metavar="NAME=VALUE[±U][UNIT][@SPAN]",
        factory=dict,
    )
    backlash: Mapping[str, str] = option(
        None,
        "Lost motion of an axis at reversal, um: X=6, X=6±1, X=0.006mm. Positive where the axis stays behind. As the reversal "
        "value of ISO 230-2, which is negative there: X=B=-6.",
        metavar="AXIS=[B=]VALUE[±U][UNIT]",
        factory=dict,
    )
    scale: Mapping[str, str] = option(
        None,
        "Scale error of an axis, um/m: Y=-12±2. Positive where the axis travels too far.",
        metavar="AXIS=VALUE[±U][UNIT]",
        factory=dict,
    )

    def errors(self, machine: Machine) -> ErrorTable | None:
        """Return squareness and scale as errors of a machine, mm and rad; an uncertainty that is not given is nan.

        None without either.

        Raises
        ------
        InputError
            for names, numbers and units that are not understood.
        """
        if not (self.squareness or self.scale):
            return None
        squareness, curves = self.squarenesses(), {}
        for letter, (value, u) in self.scales().items():
            axis = AXES.index(letter)
            reference = machine.reference_point_mm[axis]
            at = np.unique([*machine.axes[axis].range_mm, reference])
            curves[f"E{letter}{letter}"] = Curve(at, value * (at - reference), np.abs(u * (at - reference)))
        metadata = {"machine": machine.name, "source": STATED_SOURCE}
        if spans := self.spans_mm(machine):
            metadata[SPANS_KEY] = format_spans(spans)
        return ErrorTable(curves, squareness, metadata)

    def spans_mm(self, machine: Machine) -> dict[str, tuple[float, float]]:
        """Return the lengths of the arms of the squares that the squareness errors were read from, where they are given.

        Raises
        ------
        InputError
            for lengths that are not understood, or longer than the travel of both axes.
        """
        found = {}
        for name, text in self.squareness.items():
            _, mark, span = text.partition("@")
            if not mark:
                continue
            match = _SPAN.fullmatch(span.strip())
            scale = MM_PER_UNIT["inch"] if match and match[3] in ("in", '"') else 1.0
            arms = tuple(float(match[k] or match[1]) * scale for k in (1, 2)) if match else (0.0, 0.0)
            if not min(arms) > 0.0:
                raise InputError(
                    Message(
                        "arms-no-length",
                        "{text!r} for {name}: {span!r} is no length of arms; give it in mm, such as "
                        "25±3@300, or that of both arms, 25±3@300x200",
                        text=text,
                        name=name,
                        span=span.strip(),
                    ),
                    field="--squareness",
                )
            axes = [machine.axes[error_named(curve).axis] for curve in ARMS[name]]
            if all(arm > axis.length_mm + 1.0 for arm, axis in zip(arms, axes, strict=True)):
                travels = " and ".join(f"{axis.length_mm:g}" for axis in axes)
                raise InputError(
                    Message(
                        "arms-too-long",
                        "{text!r} for {name}: the arms are longer than the travel of both axes ({travels} "
                        "mm); give the length over which the square was read, mm",
                        text=text,
                        name=name,
                        travels=travels,
                    ),
                    field="--squareness",
                )
            found[name] = (arms[0], arms[1])
        return found

    def squarenesses(self) -> dict[str, tuple[float, float]]:
        """Return squareness errors with their standard uncertainty, rad; InputError for what is not understood."""
        found = {}
        for name, text in self.squareness.items():
            if name not in SQUARENESS_NAMES:
                axes = re.search(r"([XYZ])\W?([XYZ])$", name.upper())
                key = "".join(axes.groups()) if axes else name.upper().removeprefix("E")[:1]
                meant = [_ABOUT[key]] if key in _ABOUT else list(SQUARENESS)
                shown = [
                    f"{item}, squareness of {SQUARENESS[item][0]}, positive where {SQUARENESS[item][1]}"
                    for item in meant
                ]
                what = f"{name!r} is not a squareness error; {'this may be' if key in _ABOUT else 'these are'} {'; '.join(shown)}"
                what += " (drawings: docs/instruments.md)"
                raise InputError(what, field="--squareness")
            found[name] = _value(text.partition("@")[0], ANGLES, "--squareness", name)
        return found

    def scales(self) -> dict[str, tuple[float, float]]:
        """Return scale errors by axis with their standard uncertainty, rad; InputError for what is not understood."""
        return {
            _axis(letter, "--scale"): _value(text, ANGLES, "--scale", letter) for letter, text in self.scale.items()
        }

    def backlashes(self) -> dict[str, tuple[float, float]]:
        """Return reversal values B by axis with their standard uncertainty, mm: minus the backlash, or as stated with B=.

        InputError for what is not understood.
        """
        found = {}
        for letter, text in self.backlash.items():
            name, own = _axis(letter, "--backlash"), _REVERSAL.sub("", text.strip())
            value, u = _value(own, LENGTHS, "--backlash", letter)
            found[name] = (value if self.says_reversal_value(letter) else -value), u
        return found

    def says_reversal_value(self, letter: str) -> bool:
        """Whether a number is given as reversal value of ISO 230-2 (X=B=-6), not as backlash."""
        return _REVERSAL.match(self.backlash[letter].strip()) is not None

    def reversal(self) -> ReversalCurves | None:
        """Return the backlash as reversals (positive minus negative approach), mm; None without any.

        Raises
        ------
        InputError
            for axes, numbers and units that are not understood.
        """
        curves = {
            (AXES.index(letter), AXES.index(letter)): Curve(np.zeros(1), np.array([value]), np.array([u]))
            for letter, (value, u) in self.backlashes().items()
        }
        return ReversalCurves(curves) if curves else None


def _axis(letter: str, option_name: str) -> str:
    if letter not in AXES:
        raise InputError(
            Message("axis-unknown", "{letter!r} is not an axis; expected X, Y or Z", letter=letter), field=option_name
        )
    return letter


def _value(text: str, units: Mapping[str, float], option_name: str, name: str) -> tuple[float, float]:
    """Value and standard uncertainty (nan where none is given) of a text, in mm or rad."""
    found = _STATED.fullmatch(text.strip())
    unit = found[4] if found else None
    if found is None or (unit is not None and unit not in units) or (found[2] and (units is LENGTHS or unit)):
        ratio = ", or a ratio such as 0.02/300" if units is ANGLES else ""
        raise InputError(
            Message(
                "stated-not-understood",
                "{text!r} for {name} is not understood; give a number, ±U if it is known, and a unit "
                "({units}; {units2} without{ratio}), for example 25±3",
                text=text,
                name=name,
                units=", ".join(key for key in units if key.isascii()),
                units2=next(iter(units)),
                ratio=ratio,
            ),
            field=option_name,
        )
    if unit is None and not found[2]:
        _check_size(found, units, option_name, name)
    length = float(found[2]) if found[2] else 1.0
    if not SMALLEST < length < LARGEST:
        raise InputError(
            Message(
                "ratio-length-not-positive",
                "{text!r} for {name}: the length of a ratio is above zero, mm",
                text=text,
                name=name,
            ),
            field=option_name,
        )
    by = 1.0 / length if found[2] else units[unit or next(iter(units))]
    value, u = float(found[1]) * by, abs(float(found[3]) * by) if found[3] else np.nan
    most = LARGEST_MM if units is LENGTHS else LARGEST_RAD
    if not abs(value) <= most or u > most:
        raise InputError(
            Message(
                "stated-too-large",
                "{text!r} for {name} is too large to be an error of a machine; check the unit",
                text=text,
                name=name,
            ),
            field=option_name,
        )
    return value, float(u)


def _check_size(found: re.Match[str], units: Mapping[str, float], option_name: str, name: str) -> None:
    """Ask for the unit of a number without one that is far too small for the usual one: EC0Y=0.02 of a drawing is mm/m."""
    usual = next(iter(units))
    least, larger = _LEAST[usual]
    if 0.0 < max(abs(float(found[1])), abs(float(found[3] or 0.0))) < least:
        in_usual = float(found[1]) * units[larger] / units[usual]
        text = found[0].strip()
        usual = "um/m" if option_name == "--scale" else usual
        raise InputError(
            Message(
                "stated-unit-doubtful",
                "{name}={text}: a number without a unit is {usual}, and this one looks like "
                "{larger}; write {name2}={text2}{larger2} for {in_usual:g} {usual2}, or "
                "{name3}={text3}{usual3}",
                name=name,
                text=text,
                usual=usual,
                larger=larger,
                name2=name,
                text2=text,
                larger2=larger,
                in_usual=in_usual,
                usual2=usual,
                name3=name,
                text3=text,
                usual3=usual,
            ),
            field=option_name,
        )
