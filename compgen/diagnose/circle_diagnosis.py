"""Diagnosis of circular tests (ISO 230-4): which effects make the circle, how large they are, and what is left.

At angle t on a circle of radius R, run in the direction d = +1 or -1 at the angular speed w, with unit vector n:

    scale mismatch      R/2 cos 2t (s1 - s2)
    squareness          n . C S                             +-R/2 sin 2t, alike in both directions
    servo mismatch      d R/2 sin 2t w (tau1 - tau2)        opposite in both directions
    servo delay         -R/2 w^2 tau^2                      the radius shrinks with the feed: needs two feeds
    backlash            n_i dir_i c                         steps at the quadrants; the reversal is 2 c
    reversal spike      -n_i dir_i c exp(-time since the reversal / T)
    periodic error      n_i (s sin + c cos)(2 pi x_i / pitch)
    straightness        cos 3t, sin 3t, cos 4t, sin 4t      bows and waves of both guides, and scales that are not linear

The centre of each set-up and the constant of the gauge are free. Names are taken one after another, the one that explains
most first. What counts as significant is fixed beforehand, by the residuals of the model with all effects and by their
correlation along the path; so an effect that is none of these makes the names less likely, not more.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, stdtr

from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.files import read_text
from compgen.data.machine import Machine
from compgen.data.names import AXES, ERROR_INDEX, MM_PER_UM, SECONDS_PER_MIN
from compgen.diagnose.circle_shapes import best_shapes
from compgen.diagnose.verdict import DisplayedDiagnosis
from compgen.effects import Readings, active_effects, catalogue, section_text
from compgen.effects.all_effects import belongs_to
from compgen.errors import InputError, Message, nearest
from compgen.identification.axis_tests import SQUARENESS_OF, circle_positions, correlated
from compgen.kinematics.first_order import c_matrix

Show = Callable[[str], None]

#: Degrees of freedom that a diagnosis needs.
LEAST_FREEDOM = 20
#: Chi-square from which an effect of one parameter is named, before the number of places is counted at which it was tried.
NAMED_CHI2 = 30.0
#: Root mean square of what an effect explains of the readings that it acts on, below which it has no name, mm: a fifth of
#: the resolution of a ballbar. Many readings show less, but also what the equations above leave out.
NAMED_MM = 2e-5
#: Chi-square that a shape without a name has to explain in addition to what a name must.
SHAPE_HANDICAP = 8.0
#: A shape that explains the readings as well as a name but for this chi-square leaves the name tentative (99 %).
AS_GOOD_CHI2 = 9.2
#: Shapes that are taken into the model of which the rest is the noise, at most.
MOST_SHAPES = 3
#: Share of what is left that a spike or a periodic error has to explain.
SEARCHED_SHARE = 0.2
#: Names in each plane for each one of ``--max-effects``: a plane has two axes.
NAMES_PER_MOST = 2
#: Share of its columns that has to be left beside centre, radius and other names.
LEAST_VISIBLE = 0.05
#: An alternative with a smaller weight is not listed.
LEAST_WEIGHT = 0.02
#: Standard uncertainties below which an amount is not confirmed; squared time by which a drive may lead its command, ms^2.
LEAST_SIZE, MOST_LEAD_MS2 = 2.0, 25.0
#: An effect may differ by direction and quadrant by at most this share of its square; p-value of the test.
UNEVEN_SHARE, UNEVEN_P = 0.1, 1e-3
#: What an effect must explain beside a structure without a name, as a multiple of it: of one law, and of any curve.
LEAST_OF_UNKNOWN, LEAST_OF_ANY_CURVE = 0.8, 30.0
#: p-value from which what two passes leave over is the same.
REPEATS_P = 1e-4
#: Shares of the session that are tried as time constants of a drift; passes that show a level of each.
DRIFT_SHARES, LEAST_PASSES, MOST_PASSES = (0.1, 0.2, 0.4, 0.8, 1.6, 10.0), 3, 12
#: Chi-squares that differ by less than this are equal.
ALIKE_CHI2 = 1e-6
#: Rounds in which every name is exchanged for a better one beside the others.
MOST_SWAPS = 3
#: Share of the readings that lie exactly where an axis reverses, from which they are kept.
MOST_AT_REVERSALS = 0.1
#: Canonical correlation from which two effects are not told apart.
ALIKE = 0.95
#: A structure in the residuals is unknown from this share of the noise, and from this size, mm.
UNKNOWN_SHARE, UNKNOWN_MM = 0.5, 1e-4
#: Successive residuals that count as one, from which they are a structure.
UNKNOWN_CORRELATED = 3.0
#: Times in which a spike may decay (ms), or angles if the feed is not known (degrees).
SPIKE_MS = (4.0, 8.0, 15.0, 30.0, 60.0, 120.0, 240.0)
MOST_SPIKE_RAD = 0.2
SPIKE_DEG = (0.2, 0.4, 0.8, 1.6, 3.2)
#: A pitch is looked for from this many readings to this share of the radius: a longer one imitates any few lobes.
PITCH_STEPS, PITCH_SHARE = 4.0, 0.3
#: The shortest pitch is no less than this share of the longest one: more readings would not make the search longer.
MOST_PITCHES = 100.0
#: Harmonics of the residuals that are looked at.
HARMONICS = range(2, 61)
#: Sectors that are left out together, degrees, and the number of groups of them.
SECTOR_DEG, FOLDS = 30.0, 4

WORDS = {
    "squareness": (
        "the axes of {of} are out of square: an ellipse at 45 degrees, alike in both directions",
        "export the squareness (volcomp run), or align the axes; it is that within the circle: where guides are bent, it differs "
        "over the whole travel",
    ),
    "servo_mismatch": (
        "the axes of {of} follow their commands with different delays: an ellipse at 45 degrees that turns with the direction",
        "match the position loops (KV, feed-forward) of both axes; tables cannot correct it",
    ),
    "scale_mismatch": (
        "one axis of {of} travels further than the other: an ellipse along the axes",
        "measure the positioning of both axes (axis runs), and export it: a circle shows only the difference",
    ),
    "servo_delay": (
        "the circle in {of} shrinks with the square of the feed",
        "raise the gain or velocity feed-forward of the position loops, or mill circles more slowly; tables cannot correct it",
    ),
    "straightness": (
        "the circle in {of} has three or four lobes: guides that are not straight, or scales that are not linear",
        "measure the straightness and the positioning of both axes; a circle shows only part of them",
    ),
    "radius_drift": (
        "all radii in {of} change with time: the gauge, the spindle or the machine warms up",
        "warm up spindle and gauge, and repeat the circles; measure the drift with the axes at rest: the gauge alone, then "
        "with the spindle running",
    ),
    "radius_level": (
        "every pass in {of} has another radius: the gauge was set again, or something slipped between the passes",
        "check ball seats, magnets and clamping, and repeat the circles without touching the gauge",
    ),
    "backlash": (
        "{of} is late after each reversal: steps where it turns",
        "enter the reversal (twice c) in the control, or export it (volcomp run); look for play in screw and bearings",
    ),
    "reversal_spike": (
        "{of} sticks when it reverses: spikes that decay (negative: it jumps ahead)",
        "adjust the friction (quadrant error) compensation of the control; check lubrication and guides",
    ),
    "periodic": (
        "{of} has an error that repeats with the pitch",
        "check screw run-out, coupling and encoder; use table positions at a fraction of the pitch",
    ),
}


@dataclass(frozen=True, eq=False)
class CircleCandidate:
    """An effect that may be named: its columns (n, k), a parameter each with the SI unit of its name.

    ``trials`` counts the places at which it was tried; ``settings`` are the ones found, ``slope`` the derivative of the
    columns by the logarithm of the setting (n, k), ``make`` the same effect with another setting. ``shape`` describes one
    that has no name.
    """

    name: str
    of: str
    columns: FloatArray
    parameters: tuple[tuple[str, float], ...]
    trials: int = 1
    settings: Mapping[str, float] = field(default_factory=dict)
    slope: FloatArray | None = None
    make: Callable[[float], CircleCandidate] | None = None
    shape: str = ""

    @property
    def words(self) -> tuple[str, str]:
        """What it is, and what to do."""
        what, todo = next(words for family, words in WORDS.items() if self.name.startswith(family))
        return what.format(of=self.of), todo


@dataclass(frozen=True)
class NamedCircleEffect:
    """A named effect with value and standard uncertainty of each parameter, in the unit of its name."""

    candidate: CircleCandidate
    values: Mapping[str, tuple[float, float]]
    chi2: float
    alias: tuple[tuple[str, float], ...]
    visible: float
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class CircleSpace:
    """Orthonormal basis of the columns that are in the model, (n, r), and the readings without it, (n,)."""

    basis: FloatArray
    left: FloatArray

    @classmethod
    def of(cls, columns: FloatArray, value: FloatArray) -> CircleSpace:
        """The space of columns (n, k)."""
        size = np.linalg.norm(columns, axis=0)
        basis, singular, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
        basis = basis[:, singular > 1e-7 * singular[0]]
        return cls(basis, value - basis @ (basis.T @ value))

    def without(self, columns: FloatArray) -> FloatArray:
        """Columns (n, k) without their part in the space."""
        return np.asarray(columns - self.basis @ (self.basis.T @ columns))

    def gain(self, columns: FloatArray) -> float:
        """By how much columns reduce the sum of squares; 0 for columns that are hardly seen."""
        seen = self.without(columns)
        if np.linalg.norm(seen) < LEAST_VISIBLE * np.linalg.norm(columns):
            return 0.0
        value, turn = np.linalg.eigh(seen.T @ seen)
        along = (turn.T @ (seen.T @ self.left)) ** 2
        kept = value > 1e-12 * value[-1]
        return float(np.sum(along[kept] / value[kept]))

    def are_alike(self, first: FloatArray, second: FloatArray) -> bool:
        """Whether two sets of columns (n, k) say the same outside the space; not if the second is hardly seen there."""
        seen = self.without(second)
        if np.linalg.norm(seen) < LEAST_VISIBLE * np.linalg.norm(second):
            return False
        a, b = np.linalg.qr(self.without(first))[0], np.linalg.qr(seen)[0]
        return float(np.linalg.svd(a.T @ b, compute_uv=False).min()) > ALIKE


def candidates_of(machine: Machine, circles: Circles, position_mm: FloatArray) -> list[CircleCandidate]:
    """All effects without settings, in the order in which one of two equal ones is preferred."""
    radial, travel, angle = circles.radial(), circles.travel(), circles.angle_rad
    half, speed = 0.5 * circles.radius_mm, angular_speed(circles)
    both = c_matrix(machine, position_mm)
    found = []
    for k, plane in enumerate(PLANES):
        own = (circles.plane == k).astype(np.float64)
        if not own.any():
            continue
        name = SQUARENESS_OF[plane]
        square = own * np.einsum("ij,ij->i", radial, both[:, :, ERROR_INDEX[name]])
        found.append(CircleCandidate(f"squareness_{name[1:]}", plane, square[:, None], (("c_urad", 1e-6),)))
        scales = own * half * np.cos(2 * angle)
        found.append(CircleCandidate(f"scale_mismatch_{plane}", plane, scales[:, None], (("c_um_per_m", 1e-6),)))
        mismatch = own * half * np.sin(2 * angle) * circles.direction
        if speed is None:
            found.append(CircleCandidate(f"servo_mismatch_{plane}", plane, mismatch[:, None], (("c_um_per_m", 1e-6),)))
        else:
            lag, shrink = (mismatch * speed)[:, None], (-own * half * speed**2)[:, None]
            found.append(CircleCandidate(f"servo_mismatch_{plane}", plane, lag, (("tau_ms", 1e-3),)))
            found.append(CircleCandidate(f"servo_delay_{plane}", plane, shrink, (("tau_squared_ms2", 1e-6),)))
        waves = [own * wave(n * angle) for n in (3, 4) for wave in (np.cos, np.sin)]
        names = tuple((f"{letter}{n}_um", MM_PER_UM) for n in (3, 4) for letter in "cs")
        found.append(CircleCandidate(f"straightness_{plane}", plane, np.column_stack(waves), names))
    for axis, letter in enumerate(AXES):
        column = radial[:, [axis]] * travel[:, [axis]]
        if column.any():
            found.append(CircleCandidate(f"backlash_{letter}", letter, column, (("c_um", MM_PER_UM),)))
    return found


def angular_speed(circles: Circles) -> FloatArray | None:
    """Angular speed of every reading (n,), rad/s; None if a feed is not known."""
    feed = circles.covariates.get("feed_mm_min")
    if feed is None or not np.all(np.nan_to_num(feed) > 0):
        return None
    return np.asarray(feed / SECONDS_PER_MIN / circles.radius_mm)


def base_columns(circles: Circles) -> FloatArray:
    """Centre and constant of the gauge of every circle that was set up, (n, 3 m)."""
    keys = np.column_stack([circles.plane, circles.setup, circles.radius_mm, np.nan_to_num(circles.centre_mm)])
    _, number = np.unique(keys, axis=0, return_inverse=True)
    own = np.eye(int(number.max()) + 1)[number.ravel()]
    cosine, sine = np.cos(circles.angle_rad)[:, None], np.sin(circles.angle_rad)[:, None]
    return np.hstack([own, own * cosine, own * sine])


@dataclass(frozen=True)
class AxisOnCircles:
    """What spikes and periods of one axis depend on, (n,) each: computed once, since many settings are tried.

    ``along`` is the share of a displacement of the axis in the radius, ``late`` the same with the sign of its travel,
    ``since`` the angle since its last reversal, rad, ``speed`` the angular speed, rad/s.
    """

    axis: int
    along: FloatArray
    late: FloatArray
    since: FloatArray
    position_mm: FloatArray
    speed: FloatArray | None

    @classmethod
    def of(cls, circles: Circles, position_mm: FloatArray, axis: int) -> AxisOnCircles:
        """The first axis of a plane reverses at 0 and 180 degrees, the second at 90 and 270."""
        second = np.array(list(PLANES.values()))[circles.plane, 1] == axis
        since = circles.direction * (circles.angle_rad - 0.5 * np.pi * second) % np.pi
        along = circles.radial()[:, axis]
        late = along * circles.travel()[:, axis]
        return cls(axis, along, late, since, position_mm[:, axis], angular_speed(circles))


def spike(own: AxisOnCircles, trials: int, decay: float) -> CircleCandidate:
    """Spikes of one axis that decay in ``decay`` ms, or degrees without feeds."""
    angle, key = (math.radians(decay), "decay_deg") if own.speed is None else (own.speed * decay * 1e-3, "decay_ms")
    stuck = -own.late * np.exp(-own.since / angle)
    slope = (stuck * own.since / angle)[:, None]
    letter, parameters = AXES[own.axis], (("c_um", MM_PER_UM),)
    return CircleCandidate(f"reversal_spike_{letter}", letter, stuck[:, None], parameters, trials, {key: decay}, slope)


def periodic(own: AxisOnCircles, trials: int, found: bool, pitch_mm: float) -> CircleCandidate:
    """A periodic error of one axis, of a known pitch or one that was ``found``."""
    turn = 2 * np.pi * own.position_mm / pitch_mm
    columns = np.column_stack([own.along * np.sin(turn), own.along * np.cos(turn)])
    phase = turn - turn.mean()  # about the middle of the circle, so that the pitch does not shift the phase
    slope = np.column_stack([-columns[:, 1] * phase, columns[:, 0] * phase]) if found else None
    letter, parameters = AXES[own.axis], (("s1_um", MM_PER_UM), ("c1_um", MM_PER_UM))
    return CircleCandidate(f"periodic_{letter}", letter, columns, parameters, trials, {"pitch_mm": pitch_mm}, slope)


def sharpened(make: Callable[[float], CircleCandidate], space: CircleSpace, at: float, ratio: float) -> CircleCandidate:
    """The candidate with the setting near ``at`` (within a factor ``ratio``) that explains most, by golden section."""
    low, high = math.log(at / ratio), math.log(at * ratio)
    share = 0.5 * (math.sqrt(5.0) - 1.0)
    for _ in range(24):
        first, second = high - share * (high - low), low + share * (high - low)
        if space.gain(make(math.exp(first)).columns) < space.gain(make(math.exp(second)).columns):
            low = first
        else:
            high = second
    return replace(make(math.exp(0.5 * (low + high))), make=make)


def _explained(make: Callable[[float], CircleCandidate], space: CircleSpace, setting: float) -> float:
    return space.gain(make(setting).columns)


def searched(machine: Machine, circles: Circles, position_mm: FloatArray, space: CircleSpace) -> list[CircleCandidate]:
    """Spikes and periodic errors of every axis, with the settings that explain most beside ``space``."""
    found: list[CircleCandidate] = []
    radial = circles.radial()
    axes = {axis: AxisOnCircles.of(circles, position_mm, axis) for axis in range(3) if np.any(radial[:, axis])}
    speed = angular_speed(circles)
    grid: tuple[float, ...] = SPIKE_DEG if speed is None else SPIKE_MS
    if speed is not None:  # the slower the circle, the longer a spike of the same angle
        longer = [SPIKE_MS[-1] * 2.0**k for k in range(1, 9)]
        grid = (*SPIKE_MS, *(ms for ms in longer if float(speed.min()) * ms * 1e-3 < MOST_SPIKE_RAD))
    for own in axes.values():
        make = partial(spike, own, len(grid))
        best = max(grid, key=partial(_explained, make, space))
        found.append(sharpened(make, space, best, 2.0))
    # with the spikes that matter, so that a short period does not take their place
    strong = [item.columns for item in found if space.gain(item.columns) > 0.1 * float(space.left @ space.left)]
    left = CircleSpace.of(np.hstack([space.basis, *strong]), space.left)
    path = np.diff(np.sort(circles.angle_rad[circles.run == circles.run[0]]))
    step_mm = float(np.median(path[path > 1e-9])) * float(circles.radius_mm.max()) if np.any(path > 1e-9) else 0.0
    for axis, own in axes.items():
        extent = float(np.ptp(position_mm[:, axis]))
        longest, known = PITCH_SHARE * float(circles.radius_mm.max()), machine.axes[axis].screw_pitch_mm
        shortest = max(PITCH_STEPS * step_mm, longest / MOST_PITCHES)
        # a quarter of a period more or less over the circle does not hide a period
        pitches = [known] if known else (1.0 / np.arange(1.0 / longest, 1.0 / shortest, 0.25 / extent)).tolist()
        if pitches:
            make = partial(periodic, own, len(pitches), not known)
            best = max(pitches, key=lambda pitch, make=make: left.gain(make(pitch).columns))
            found.append(make(best) if known else sharpened(make, left, best, 1.0 + 0.25 * best / extent))
    return found


# The steps: all candidates, the noise, names one after another, what is left.


def noise_floor(circles: Circles, residual_mm: FloatArray, u_um: float | None) -> tuple[float, str]:
    """Standard deviation of a reading by itself, mm, and where it is from: stated, repeats, or neighbouring readings."""
    if u_um is not None:
        return u_um * MM_PER_UM, "stated"
    keys = [circles.plane, circles.setup, circles.direction, circles.covariates.get("feed_mm_min", 0 * residual_mm)]
    _, path = np.unique(np.column_stack(keys), axis=0, return_inverse=True)
    places = np.column_stack([path.ravel(), np.round(np.degrees(circles.angle_rad), 3)])
    _, place, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    freedom = len(residual_mm) - len(count)
    if freedom >= LEAST_FREEDOM:
        mean = np.bincount(place.ravel(), residual_mm) / count
        return float(np.sqrt(np.sum((residual_mm - mean[place.ravel()]) ** 2) / freedom)), "repeats"
    order = np.lexsort((circles.angle_rad, circles.run, path.ravel()))
    second = np.diff(residual_mm[order], 2)
    # white noise has six times its variance in second differences; the median leaves out ends of paths and spikes
    return float(np.median(np.abs(second)) / 0.6745 / np.sqrt(6.0)), "neighbouring readings"


def _structure(left: FloatArray, floor_mm: float) -> float:
    """Root mean square of residuals (n,) beyond the noise of single readings, mm; 0 if that is too little."""
    structure = math.sqrt(max(float(np.mean(left**2)) - floor_mm**2, 0.0))
    return structure if structure >= max(UNKNOWN_SHARE * floor_mm, UNKNOWN_MM) else 0.0


def _repeats(own: Circles, left: FloatArray) -> bool:
    """Whether two passes leave the same over: alike in one direction, alike or opposite in both.

    Noise that wanders from reading to reading has as much structure as an effect, but it is another one in each pass.
    """
    keys = np.column_stack([own.setup, own.radius_mm, own.run, own.direction])
    _, number = np.unique(keys, axis=0, return_inverse=True)
    passes = []
    for k in range(int(number.max()) + 1):
        rows = np.flatnonzero(number.ravel() == k)
        passes.append(rows[np.argsort(own.angle_rad[rows])])
    for i, first in enumerate(passes):
        for second in passes[i + 1 :]:
            if len(second) < 8 or len(first) < 8:
                continue
            angle = own.angle_rad[first]
            inside = (angle >= own.angle_rad[second[0]]) & (angle <= own.angle_rad[second[-1]])
            a, b = left[first][inside], np.interp(angle[inside], own.angle_rad[second], left[second])
            same_way = own.direction[first[0]] == own.direction[second[0]]
            if len(a) >= 8 and _p_alike(a, b, one_sided=bool(same_way)) < REPEATS_P:
                return True
    return False


def _p_alike(a: FloatArray, b: FloatArray, *, one_sided: bool) -> float:
    """p-value of the correlation of two series (n,), each of them correlated along itself."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    if not size:
        return 1.0
    together = 1.0
    for lag in range(1, len(a) // 4):
        product = float(a[:-lag] @ a[lag:]) * float(b[:-lag] @ b[lag:]) / size**2
        if product <= 0 or float(a[:-lag] @ a[lag:]) < 0:
            break
        together += 2.0 * product
    freedom = len(a) / together - 2.0
    if freedom < 2.0:
        return 1.0
    r = min(float(a @ b) / size, 1.0 - 1e-12)
    t = r * math.sqrt(freedom / (1.0 - min(r**2, 1.0 - 1e-12)))
    return float(stdtr(freedom, -t)) if one_sided else 2.0 * float(stdtr(freedom, -abs(t)))


def unknown_of(circles: Circles, residual_mm: FloatArray, floor_mm: float) -> list[dict[str, Any]]:
    """Structures in the residuals that none of the effects explains, by plane, as in ``diagnosis.json``."""
    found = []
    for k, plane in enumerate(PLANES):
        rows = np.flatnonzero(circles.plane == k)
        if not rows.size:
            continue
        own, left = circles.part(rows), residual_mm[rows]
        structure = _structure(left, floor_mm)
        if not structure or not _repeats(own, left):
            continue
        power = {}
        for n in HARMONICS:
            wave = np.exp(1j * n * own.angle_rad)
            alike, opposite = (2.0 * abs(np.mean(left * way * wave)) for way in (1.0, own.direction))
            power[n, "alike in both directions"], power[n, "opposite in both directions"] = alike, opposite
        one_way = len(np.unique(own.direction)) == 1
        (n, how), size = max(power.items(), key=lambda item: item[1])
        text = f"{plane}: a pattern that none of the effects explains; strongest: {n} waves a turn"
        text += f", {size / MM_PER_UM:.2g} um" + ("" if one_way else f", {how}")
        found.append(
            {"covariates": ["angle_deg"], "direction": plane, "rms_um": structure / MM_PER_UM, "text": text,
             "resembles": None, "plane": plane}
        )  # fmt: skip
    return found


@dataclass(frozen=True, repr=False)
class CircleDiagnosis(DisplayedDiagnosis):
    """Diagnosis of circular tests.

    Parameters
    ----------
    machine, circles : what was diagnosed.
    effects : the named effects, the one that explains most first.
    unknown : structures without a name, as in ``diagnosis.json``.
    invisible : effects that these circles cannot show.
    residual_before_mm, residual_after_mm : readings without centre and radius, and also without the named effects, (n,).
    left_out_rms_mm : rms of sectors left out, before and after.
    floor_mm, floor_source : standard deviation of a reading by itself.
    """

    machine: Machine
    circles: Circles
    effects: tuple[NamedCircleEffect, ...]
    unknown: tuple[dict[str, Any], ...]
    invisible: tuple[str, ...]
    residual_before_mm: FloatArray
    residual_after_mm: FloatArray
    left_out_rms_mm: tuple[float, float]
    floor_mm: float
    floor_source: str
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def acceptable(self) -> bool:
        """Whether it is decided, and the misfit of the sectors left out shrinks, if something was named."""
        if self.word == "not_decidable":
            return False
        return not self.effects or self.left_out_rms_mm[1] < self.left_out_rms_mm[0]

    @property
    def word(self) -> str:
        """The verdict."""
        if any(self.grade(item) != "tentative" for item in self.effects):
            return "named"
        if self.unknown or self.effects:
            return "unknown" if self.unknown or any(item.reasons for item in self.effects) else "named"
        return "not_decidable" if self.reasons else "none"

    def grade(self, item: NamedCircleEffect) -> str:
        """How sure a name is."""
        if len(item.alias) > 1 or item.reasons:
            return "tentative"
        return "beside_unknown" if self.unknown else "confirmed"

    def extended(self) -> str:
        """The machine file with the effects that belong to the machine and are not errors of its tables; empty without."""
        if self.machine.file is None:
            return ""
        readings, known, sections = readings_of_circles(self.machine, self.circles), catalogue(), []
        for item in self.effects:
            name = item.candidate.name
            if self.grade(item) == "tentative" or not name.startswith(("backlash", "periodic")):
                continue
            effect = known[name].with_settings(dict(item.candidate.settings))
            units = {one.name: one.si_per_unit for one in effect.card.parameters}
            values = np.array([item.values.get(key, (0.0, 0.0))[0] * unit for key, unit in units.items()])
            sections.append(section_text(effect, readings, values))
        if not sections:
            return ""
        text = read_text(self.machine.file).rstrip("\n")
        return "\n".join([text, "", "", "# found by volcomp diagnose in circles", *sections])

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        rms = [float(np.sqrt(np.mean(values**2))) for values in (self.residual_before_mm, self.residual_after_mm)]
        return {
            "verdict": self.word,
            "effects": [self._effect(item) for item in self.effects],
            "unknown": list(self.unknown),
            "invisible": list(self.invisible),
            "secondary": [],
            "gap": {
                "train": _um(rms),
                "heldout_lines": _um(self.left_out_rms_mm),
                "heldout_stations": None,
                "heldout_times": None,
                "noise_floor_um": self.floor_mm / MM_PER_UM,
                "noise_floor_source": self.floor_source,
            },
            "advice": self._advice(),
            "reasons": list(self.reasons),
            "notes": [
                *self.notes,
                Message(
                    "left-out-sectors",
                    "lines left out: sectors of {SECTOR_DEG:g} degrees, a quarter of them at a time",
                    SECTOR_DEG=SECTOR_DEG,
                ),
            ],
            "evidence": {"readings": len(self.circles), "planes": list(self.circles.planes)},
        }

    def _effect(self, item: NamedCircleEffect) -> dict[str, Any]:
        what, todo = item.candidate.words
        amount = ""
        if item.candidate.name.startswith("backlash"):
            value, u = item.values["c_um"]
            amount = f"; reversal {2 * value:+.2f} um, u {2 * u:.2g}"
        elif item.candidate.name.startswith("periodic"):
            amount = f"; amplitude {math.hypot(item.values['s1_um'][0], item.values['c1_um'][0]):.2f} um"
        elif item.values.get("tau_squared_ms2", (0.0, 0.0))[0] < 0:
            amount = "; here it grows: the feed-forward is too strong"
        return {
            "name": item.candidate.name,
            "belongs_to": belongs_to(item.candidate.name),
            "alias_set": [{"name": name, "weight": round(weight, 4)} for name, weight in item.alias],
            "parameters": {key: {"value": value, "u": u} for key, (value, u) in item.values.items()},
            "settings": dict(item.candidate.settings),
            "confidence": round(next(weight for name, weight in item.alias if name == item.candidate.name), 4),
            "grade": self.grade(item),
            "reasons": list(item.reasons),
            "visible_fraction": item.visible,
            "chi2": item.chi2,
            "text": what + amount,
            "what_to_do": todo,
        }

    def _advice(self) -> list[str]:
        found: list[str] = []
        others = {
            item.candidate.name: [name for name, _ in item.alias if name != item.candidate.name]
            for item in self.effects
        }
        alike = [f"{name} from {', '.join(same)}" for name, same in others.items() if same]
        if alike:
            found.append(
                Message(
                    "measure-both-directions",
                    "measure whole circles in both directions: separates {alike}",
                    alike="; ".join(alike),
                )
            )
        delay = [name for name in self.invisible if name.startswith("servo_delay")]
        if delay:
            found.append(
                Message(
                    "measure-two-feeds",
                    "measure at two feeds (feed_mm_min), one of them high: would show {delay}, which these circles cannot",
                    delay=", ".join(delay),
                )
            )
        if self.floor_source == "neighbouring readings":
            found.append(
                Message(
                    "measure-circles-twice",
                    "measure each circle twice (column run): only repeats separate noise from short patterns",
                )
            )
        return found


def _um(pair: Sequence[float]) -> dict[str, float]:
    return {"before_rms_um": pair[0] / MM_PER_UM, "after_rms_um": pair[1] / MM_PER_UM}


def diagnose_circles(
    machine: Machine,
    circles: Circles,
    *,
    most: int,
    only: Sequence[str] = (),
    add: Sequence[str] = (),
    u_um: float | None = None,
    show: Show = lambda _: None,
) -> CircleDiagnosis:
    """Diagnose circular tests.

    Parameters
    ----------
    machine : chain, travel, and pitches of the screws if they are known.
    circles : readings in one or more planes.
    most : half the largest number of names in each plane.
    only, add : names to look for, and names to add whether they are found or not.
    u_um : standard uncertainty of a reading, if it is known.
    show : called with a description of each step.

    Raises
    ------
    InputError
        for unknown names and too few readings.
    """
    circles = without_reversals(circles)
    position_mm = circle_positions(machine, circles)
    active = [effect.change_mm(readings_of_circles(machine, circles)) for effect in active_effects(machine)]
    for change in active:  # subtract the effects that are already in the machine file
        if change is not None:
            circles = replace(circles, deviation_mm=circles.deviation_mm - change)
    # each feed is a path of its own
    feed = circles.covariates.get("feed_mm_min", np.zeros(len(circles)))
    _, path = np.unique(np.column_stack([circles.run, feed]), axis=0, return_inverse=True)
    circles, value = replace(circles, run=path.ravel().astype(np.int64)), circles.deviation_mm
    base = base_columns(circles)
    start = CircleSpace.of(base, value)
    fixed = candidates_of(machine, circles, position_mm)
    show("searching for spikes and periods")
    linear = CircleSpace.of(np.hstack([base, *(item.columns for item in fixed)]), value)
    every = fixed + searched(machine, circles, position_mm, linear) + changing(circles, linear)
    for name in (*only, *add):
        if name not in [item.name for item in every]:
            message = f"{name!r} is not an effect of these circles; {nearest(name, [item.name for item in every])}"
            raise InputError(message, field="--effects" if name in only else "--add")
    full = CircleSpace.of(np.hstack([base, *(item.columns for item in every)]), value)
    freedom = len(circles) - full.basis.shape[1]
    if freedom < LEAST_FREEDOM:
        raise InputError(
            f"{len(circles)} readings with {full.basis.shape[1]} unknowns leave {freedom} degrees of freedom; a diagnosis "
            f"needs at least {LEAST_FREEDOM}: record more readings on each circle"
        )
    show("naming effects")
    floor_mm, source = noise_floor(circles, full.left, u_um)
    shapes = shapes_of(circles, (start, linear))
    if source == "repeats":  # otherwise a shape may be noise that wanders, and has to be large beside it
        full = _with_shapes(full, shapes, floor_mm**2 * correlated(circles, full.left))
    freedom = max(len(circles) - full.basis.shape[1], 1)
    variance = max(float(full.left @ full.left) / freedom, floor_mm**2) * correlated(circles, full.left)
    most_named = NAMES_PER_MOST * most * len(circles.planes)
    allowed = [item for item in every if (not only or item.name in only) and item.name not in add]
    forced = [item for item in every if item.name in add]
    choose = partial(chosen_of, circles, base, forced=forced, noise=(variance, floor_mm), most=most_named)
    # many names at once look like a shape before all of them are found: so also names first, and shapes beside them
    named = choose(allowed)
    sets = (named, choose([*allowed, *shapes], begin=named), choose([*allowed, *shapes]))
    members = max(sets, key=partial(criterion, circles, base, variance=variance))
    chi2 = {}
    for item in members:
        others = CircleSpace.of(np.hstack([base, *(one.columns for one in members if one is not item)]), value)
        chi2[item.name] = others.gain(item.columns) / variance
    effects, after, parts = solved(circles, base, members, every, chi2)
    effects = [_without_rival(circles, base, item, members, shapes, variance) for item in effects]
    found_shapes = [(item.shape, item.of, part) for item, part in zip(members, parts, strict=True) if item.shape]
    unknown = [_shape_dict(*one) for one in found_shapes] + unknown_of(circles, after, floor_mm)
    after = after + sum((part for _, _, part in found_shapes), np.zeros(len(circles)))
    curves = [item for item in effects if item.candidate.columns.shape[1] > 1]
    effects = [_beside(circles, item, unknown, (after, floor_mm), variance) for item in effects]
    doubtful = [item.chi2 * variance for item in curves if item not in effects]
    effects = [_beside(circles, item, unknown, (after, floor_mm), variance, sum(doubtful)) for item in effects]
    named = [item for item in members if not item.shape]
    reasons = [] if unknown or source != "neighbouring readings" else undecided(circles, after, floor_mm)
    show("testing on sectors left out")
    return CircleDiagnosis(
        machine, circles, tuple(effects), tuple(unknown), invisible_of(circles, start, every), start.left, after,
        left_out(circles, base, named), floor_mm, source, tuple(reasons),
    )  # fmt: skip


def _with_shapes(full: CircleSpace, shapes: Sequence[CircleCandidate], variance: float) -> CircleSpace:
    """The space of all names with the shapes that are plainly there, so that what is left is noise."""
    for _ in range(MOST_SHAPES):
        gains = [full.gain(item.columns) for item in shapes]
        if max(gains, default=0.0) <= max(SEARCHED_SHARE * float(full.left @ full.left), NAMED_CHI2 * variance):
            break
        full = CircleSpace.of(np.hstack([full.basis, shapes[int(np.argmax(gains))].columns]), full.left)
    return full


def _without_rival(
    circles: Circles,
    base: FloatArray,
    item: NamedCircleEffect,
    members: Sequence[CircleCandidate],
    shapes: Sequence[CircleCandidate],
    variance: float,
) -> NamedCircleEffect:
    """A name, tentative if a shape without a name explains the readings as well in its place."""
    rest = [one.columns for one in members if one is not item.candidate]
    space = CircleSpace.of(np.hstack([base, *rest]), circles.deviation_mm)
    own = space.gain(item.candidate.columns) / variance - price(circles, item.candidate)
    rivals = [one for one in shapes if one.of == item.candidate.of or len(item.candidate.of) == 1]
    worth = [space.gain(one.columns) / variance - price(circles, one) for one in rivals]
    if worth and max(worth) > own - AS_GOOD_CHI2:
        text = rivals[int(np.argmax(worth))].shape
        return replace(
            item,
            reasons=(
                *item.reasons,
                Message("unnamed-shape-as-good", "what has no name explains the readings as well: {text}", text=text),
            ),
        )
    return item


def _shape_dict(text: str, plane: str, part_mm: FloatArray) -> dict[str, Any]:
    """A shape without a name as in ``diagnosis.json``; the size of waves is their amplitude, of others all their height."""
    own = part_mm[part_mm != 0]
    height = float(np.ptp(own)) / MM_PER_UM if len(own) else 0.0
    what, comma, how = text.partition(", ")
    if "waves a turn" in text:
        said = f"strongest: {what}, {0.5 * height:.2g} um{comma}{how}"
    else:
        said = f"it looks like {text}, {height:.2g} um"
    return {
        "covariates": ["angle_deg"], "direction": plane,
        "rms_um": float(np.sqrt(np.mean(own**2))) / MM_PER_UM if len(own) else 0.0,
        "text": f"{plane}: a pattern that none of the effects explains; {said}", "resembles": None, "plane": plane,
    }  # fmt: skip


def _beside(
    circles: Circles,
    item: NamedCircleEffect,
    unknown: Sequence[Mapping[str, Any]],
    left: tuple[FloatArray, float],
    variance: float,
    doubtful: float = 0.0,
) -> NamedCircleEffect:
    """An effect beside a structure without a name: it may be a part of that, if it does not explain more.

    ``doubtful`` is the sum of squares that curves explain which may be part of it, too.
    """
    if not unknown or any("unexplained" in reason for reason in item.reasons):
        return item
    after, floor_mm = left
    planes = [list(PLANES).index(entry["plane"]) for entry in unknown]
    rows = np.isin(circles.plane, planes) & item.candidate.columns.any(axis=1)
    structure = float(np.sum(after[rows] ** 2)) - np.count_nonzero(rows) * floor_mm**2 + doubtful
    any_curve = item.candidate.columns.shape[1] > 1
    if item.chi2 * variance < (LEAST_OF_ANY_CURVE if any_curve else LEAST_OF_UNKNOWN) * structure:
        return replace(
            item, reasons=(*item.reasons, Message("small-beside-unknown", "small compared with the unexplained part"))
        )
    return item


def undecided(circles: Circles, left: FloatArray, floor_mm: float) -> list[str]:
    """Planes in which one pass leaves a structure over that may be noise: only a repeat would show it."""
    found: list[str] = []
    for k, plane in enumerate(PLANES):
        rows = np.flatnonzero(circles.plane == k)
        if (
            rows.size
            and _structure(left[rows], floor_mm)
            and correlated(circles.part(rows), left[rows]) >= UNKNOWN_CORRELATED
        ):
            size = float(np.sqrt(np.mean(left[rows] ** 2))) / MM_PER_UM
            found.append(
                Message(
                    "noise-or-unknown",
                    "{plane}: {size:.2g} um rms are left over that change slowly along the path; without repeats noise of the "
                    "gauge cannot be told from an effect without a name",
                    plane=plane,
                    size=size,
                )
            )
    return found


def without_reversals(circles: Circles) -> Circles:
    """Circles without the readings exactly where an axis reverses: they belong to neither side of it."""
    at = (np.abs(circles.radial()) > 0.5) & (circles.travel() == 0)
    rows = np.flatnonzero(~at.any(axis=1))
    return circles if len(circles) - len(rows) > MOST_AT_REVERSALS * len(circles) else circles.part(rows)


def readings_of_circles(machine: Machine, circles: Circles) -> Readings:
    """Circles in the form that the effects of the catalogue use: displacements along the radius."""
    count = len(circles)
    return Readings(
        machine=machine,
        kind="deviations",
        position_mm=circle_positions(machine, circles),
        direction=circles.radial(),
        tool_mm=np.tile(np.asarray(machine.tool_offset_mm, dtype=np.float64), (count, 1)),
        stations=(),
        station=np.zeros(count, dtype=np.int64),
        range_mm=np.zeros(count),
        approach=circles.travel(),
        covariates=circles.covariates,
        labels={"run": circles.run, "setup": circles.setup},
    )


def time_of(circles: Circles) -> FloatArray:
    """Time of each reading (n,): as logged, else its number, pass after pass as in the file, each in its direction."""
    logged = circles.covariates.get("time_s")
    if logged is not None and np.isfinite(logged).all() and np.ptp(logged) > 0:
        return logged
    keys = np.column_stack([circles.plane, circles.setup, circles.radius_mm, circles.run, circles.direction])
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    time, at = np.zeros(len(circles)), 0
    for k in np.argsort(first):
        rows = np.flatnonzero(number.ravel() == k)
        way = circles.direction[rows] * circles.angle_rad[rows]
        if np.count_nonzero(np.diff(way) < 0) > 1:  # more than the one jump of a circle that does not begin at zero
            rows = rows[np.argsort(way)]
        time[rows] = at + np.arange(len(rows))
        at += len(rows)
    return time


def drift(plane: str, own: NDArray[np.bool_], share: FloatArray, tau: float) -> CircleCandidate:
    """Radii ``own`` that drift with the time constant ``tau``, a share of the session, and are 1 at its end."""
    column = np.where(own, np.expm1(-share / tau) / math.expm1(-1.0 / tau), 0.0)[:, None]
    settings = {"time_constant_share": tau}
    return CircleCandidate(f"radius_drift_{plane}", plane, column, (("c_um", MM_PER_UM),), len(DRIFT_SHARES), settings)


def changing(circles: Circles, space: CircleSpace) -> list[CircleCandidate]:
    """What happens to the radius in time: a drift, and a level of each pass."""
    time, found = time_of(circles), []
    for k, plane in enumerate(PLANES):
        own = circles.plane == k
        if not own.any():
            continue
        share = (time - time[own].min()) / max(float(np.ptp(time[own])), 1e-9)
        make = partial(drift, plane, own, share)
        best = max(DRIFT_SHARES, key=partial(_explained, make, space))
        worth = space.gain(make(best).columns) > SEARCHED_SHARE * float(space.left @ space.left)
        found.append(sharpened(make, space, best, 2.0) if worth else make(best))
        keys = np.column_stack([circles.setup, circles.radius_mm, circles.run, circles.direction])[own]
        _, number = np.unique(keys, axis=0, return_inverse=True)
        passes = int(number.max()) + 1
        feed = circles.covariates.get("feed_mm_min")
        if LEAST_PASSES <= passes <= MOST_PASSES and (feed is None or np.ptp(feed[own]) == 0):
            levels = np.zeros((len(circles), passes - 1))
            levels[own] = np.eye(passes)[number.ravel()][:, 1:]
            names = tuple((f"c{j + 1}_um", MM_PER_UM) for j in range(1, passes))
            found.append(CircleCandidate(f"radius_level_{plane}", plane, levels, names))
    return found


def price(circles: Circles, item: CircleCandidate) -> float:
    """Chi-square that every parameter beyond the first has to bring: four columns always fit better than one.

    A shape without a name was tried at many places, and must be better than a name.
    """
    own = float((item.columns.shape[1] - 1) * math.log(len(circles)))
    return own + (2.0 * math.log(item.trials) + SHAPE_HANDICAP if item.shape else 0.0)


def shapes_of(circles: Circles, spaces: Sequence[CircleSpace]) -> list[CircleCandidate]:
    """Shapes without a name, the best of each kind beside each of the spaces."""
    found = []
    for shape in best_shapes(circles, [(space.basis, space.left) for space in spaces]):
        names = tuple((f"c{k + 1}_um", MM_PER_UM) for k in range(shape.columns.shape[1]))
        name = f"{shape.plane}: {shape.text}"
        found.append(CircleCandidate(name, shape.plane, shape.columns, names, shape.trials, shape=shape.text))
    return found


def chosen_of(
    circles: Circles,
    base: FloatArray,
    allowed: Sequence[CircleCandidate],
    forced: Sequence[CircleCandidate],
    noise: tuple[float, float],
    most: int,
    begin: Sequence[CircleCandidate] = (),
) -> list[CircleCandidate]:
    """The effects that the readings show: ``forced`` ones, then the one that explains most, and so on, at most ``most``.

    The search begins with ``forced``, or with ``begin``, which contains these. Names that are no longer needed beside later
    ones are taken back. ``noise`` is the variance (mm^2) that stands for one in chi-square, and the standard deviation of a
    reading by itself (mm).
    """
    variance, floor_mm = noise
    named, value, kept = list(begin or forced), circles.deviation_mm, {item.name for item in forced}

    def but(items: Sequence[CircleCandidate]) -> list[CircleCandidate]:
        names = {item.name for item in items}
        return [item for item in allowed if item.name not in names]

    def worth(item: CircleCandidate, space: CircleSpace) -> float:
        """Chi-square of an effect beside ``space``; 0 if that is too little for a name."""
        gain = space.gain(item.columns)
        scans = 0.0 if item.shape else 2.0 * math.log(item.trials)  # those of a shape are in its price
        least = variance * (NAMED_CHI2 + scans + price(circles, item))
        least = max(least, NAMED_MM**2 * np.count_nonzero(item.columns.any(axis=1)))
        if item.settings:  # of many settings one always imitates a part of what has no name
            least = max(least, SEARCHED_SHARE * (float(space.left @ space.left) - len(value) * floor_mm**2))
        return gain / variance - price(circles, item) if gain > least else 0.0

    def beside(items: Sequence[CircleCandidate]) -> CircleSpace:
        return CircleSpace.of(np.hstack([base, *(item.columns for item in items)]), value)

    while len(named) < most + len(forced):
        space = beside(named)
        others = but(named)
        gains = [worth(item, space) for item in others]
        if max(gains, default=0.0) <= 0.0:
            break
        # of two that explain the same, the first
        named.append(next(item for item, gain in zip(others, gains, strict=True) if gain > max(gains) * (1 - 1e-9)))
    # what was taken first may have stood for two of the others
    for _ in range(MOST_SWAPS if any(item.columns.shape[1] > 1 for item in named) else 0):
        before = [item.name for item in named]
        for item in [one for one in named if one.name not in kept]:
            rest = [one for one in named if one is not item]
            space, others = beside(rest), but(rest)
            own = worth(item, space)
            best = max(others, key=partial(worth, space=space))
            named = [*rest, best if worth(best, space) > own + ALIKE_CHI2 else item]
        space, others = beside(named), but(named)
        more = max(others, key=partial(worth, space=space), default=None)
        if more is not None and worth(more, space) > 0.0 and len(named) < most + len(forced):
            named.append(more)
        if [item.name for item in named] == before:
            break
    for item in [one for one in reversed(named) if one.name not in kept]:
        rest = [one for one in named if one is not item]
        if worth(item, beside(rest)) <= 0.0:
            named = rest
    # the settings were found before the other effects were known: once more beside these
    for _ in range(2):
        for k, item in enumerate(named):
            if item.make is not None:
                rest = [one for one in named if one is not item]
                key, setting = next(iter(item.settings.items()))
                named[k] = sharpened(item.make, beside(rest), setting, 1.01 if key == "pitch_mm" else 1.5)
    return named


def criterion(circles: Circles, base: FloatArray, members: Sequence[CircleCandidate], variance: float) -> float:
    """What a set of effects explains, as chi-square less the price of its parameters and of the places tried."""
    left = CircleSpace.of(np.hstack([base, *(item.columns for item in members)]), circles.deviation_mm).left
    own = math.log(len(circles))
    paid = sum(own + price(circles, item) + (0.0 if item.shape else 2.0 * math.log(item.trials)) for item in members)
    return -float(left @ left) / variance - paid


def solved(
    circles: Circles,
    base: FloatArray,
    named: Sequence[CircleCandidate],
    every: Sequence[CircleCandidate],
    chi2: Mapping[str, float],
) -> tuple[list[NamedCircleEffect], FloatArray, list[FloatArray]]:
    """Values and uncertainties of the named effects in one adjustment, residuals (n,), and what each member adds (n,), mm."""
    blocks, names = [item.columns for item in named], {item.name for item in named}
    columns = np.hstack([base, *blocks])
    value = circles.deviation_mm
    found = np.linalg.lstsq(columns, value, rcond=1e-9)[0]
    after = value - columns @ found
    # settings that were searched for are unknowns, too: their slopes at the solution widen the uncertainties
    starts = base.shape[1] + np.cumsum([0, *(block.shape[1] for block in blocks)])
    slopes = [
        (item.slope @ found[at : at + item.slope.shape[1]])[:, None]
        for item, at in zip(named, starts, strict=False)
        if item.slope is not None
    ]
    wide = np.hstack([columns, *slopes])
    size = np.linalg.norm(wide, axis=0)
    size[size == 0] = 1.0
    inverse = np.linalg.pinv(wide / size, rcond=1e-7) / size[:, None]
    variance = float(after @ after) / max(len(value) - wide.shape[1], 1) * correlated(circles, after)
    u = np.sqrt(variance) * np.linalg.norm(inverse, axis=1)
    effects, parts = [], []
    for item, at in zip(named, starts, strict=False):
        parts.append(item.columns @ found[at : at + item.columns.shape[1]])
        if item.shape:
            continue
        values = {
            key: (float(found[at + k]) / unit, float(u[at + k]) / unit) for k, (key, unit) in enumerate(item.parameters)
        }
        square, u_square = values.get("tau_squared_ms2", (0.0, 0.0))
        if square > 0:
            values = {"tau_ms": (math.sqrt(square), u_square / (2.0 * math.sqrt(square)))}
        others = CircleSpace.of(np.hstack([base, *(one.columns for one in named if one is not item)]), value)
        own = others.without(item.columns)
        alike = [one for one in every if one.name not in names and others.are_alike(item.columns, one.columns)]
        criteria = {one.name: others.gain(one.columns) / variance - price(circles, one) for one in (item, *alike)}
        weights = {name: math.exp(min(0.5 * (value - criteria[item.name]), 50.0)) for name, value in criteria.items()}
        total = sum(weights.values())
        alias = [
            (name, weight / total)
            for name, weight in weights.items()
            if weight / total >= LEAST_WEIGHT or name == item.name
        ]
        visible = float(np.linalg.norm(own) / np.linalg.norm(item.columns))
        reasons = [*_implausible(item, values), *_uneven(circles, item, wide, after, parts[-1], variance)]
        effects.append(NamedCircleEffect(item, values, chi2[item.name], tuple(alias), visible, tuple(reasons)))
    return effects, after, parts


def _implausible(item: CircleCandidate, values: Mapping[str, tuple[float, float]]) -> list[str]:
    """Why the amount speaks against an effect: smaller than its uncertainty allows, or no drive does that."""
    reasons: list[str] = []
    if max(abs(value) / u if u else math.inf for value, u in values.values()) < LEAST_SIZE:
        reasons.append(
            Message(
                "within-its-uncertainty",
                "it is smaller than {LEAST_SIZE:g} times its standard uncertainty",
                LEAST_SIZE=LEAST_SIZE,
            )
        )
    square = values.get("tau_squared_ms2", (0.0, 0.0))[0]
    if square < -MOST_LEAD_MS2:
        reasons.append(
            Message(
                "size-not-plausible-lead",
                "its size, tau_squared_ms2 = {square:.3g}, is not plausible: no drive leads by so much",
                square=square,
            )
        )
    return reasons


def _uneven(
    circles: Circles, item: CircleCandidate, columns: FloatArray, left: FloatArray, shape: FloatArray, variance: float
) -> list[str]:
    """Whether the size of an effect differs by direction and by half of the circle: then it imitates something else.

    Not for reversals, which may differ at the two ends of a circle.
    """
    if item.name.startswith(("backlash", "reversal_spike", "radius")):
        return []
    ways = [np.sign(np.cos(circles.angle_rad)), np.sign(np.sin(circles.angle_rad))]
    if len(np.unique(circles.direction)) == 2:
        ways.append(circles.direction.astype(np.float64))
    ways.append(ways[0] * ways[1])
    space = CircleSpace.of(columns, left)
    extra = np.column_stack([shape * way for way in ways])
    own = space.without(extra)
    kept = np.linalg.norm(own, axis=0) > LEAST_VISIBLE * np.linalg.norm(extra, axis=0)
    if not kept.any():
        return []
    value = np.linalg.lstsq(own[:, kept], space.left, rcond=1e-6)[0]
    moved = own[:, kept] @ value
    p = float(chdtrc(int(kept.sum()), float(moved @ moved) / variance))
    varies = extra[:, kept] @ value
    if p < UNEVEN_P and float(varies @ varies) > UNEVEN_SHARE * float(shape @ shape):
        return [
            Message("not-alike-on-circle", "it is not alike in all quadrants and both directions (p = {p:.1e})", p=p)
        ]
    return []


def invisible_of(circles: Circles, start: CircleSpace, every: Sequence[CircleCandidate]) -> tuple[str, ...]:
    """Effects that these circles cannot show, whatever their size."""
    found = [
        item.name
        for item in every
        if np.linalg.norm(start.without(item.columns)) < LEAST_VISIBLE * np.linalg.norm(item.columns)
    ]
    names = [item.name for item in every]
    return (*found, *(f"servo_delay_{plane}" for plane in circles.planes if f"servo_delay_{plane}" not in names))


def left_out(circles: Circles, base: FloatArray, named: Sequence[CircleCandidate]) -> tuple[float, float]:
    """Rms of the readings in sectors that the fit did not see, mm: without the named effects, and with them."""
    fold = (np.degrees(circles.angle_rad) // SECTOR_DEG).astype(np.int64) % FOLDS
    squares = []
    for columns in (base, np.hstack([base, *(item.columns for item in named)])):
        left = np.zeros(len(circles))
        for k in range(FOLDS):
            out = fold == k
            if out.any() and not out.all():
                found = np.linalg.lstsq(columns[~out], circles.deviation_mm[~out], rcond=1e-7)[0]
                left[out] = circles.deviation_mm[out] - columns[out] @ found
        squares.append(float(np.sqrt(np.mean(left**2))))
    return squares[0], squares[1]
