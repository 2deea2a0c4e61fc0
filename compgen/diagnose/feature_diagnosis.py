"""Diagnosis of features: parts measured elsewhere, and artefacts under the machine's own probe.

The pose of the part (of every set-up of an artefact), a squareness, the difference of the scales, and bows of the guides
are free: they are errors of the machine, and `identify` shows them. They are the base of the engine; its candidates are

    part_temperature    d = c p                     all lengths are too long or too short alike
    tool_wear           d = c k, k the order        the same drift from feature to feature (wear, or warm-up)
    clamp_slip          d = H(k - at) (c + r x p)   everything after one feature is shifted and turned
    setup_step          the same from set-up to set-up, of a part in one frame
    probe_lobing        d = c cos 3a + s sin 3a     three lobes along a ring of features (a its angle)
    outliers            single features that are off

and, without a name, smooth fields over the part (a Gaussian process in the place), what changes with the order (one in
the order), and features that are off along one slanting line, each by itself. The order of the features is that of the
rows. Few features show little: what is named must also hold on features left out, and nothing smooth without a name may
explain them nearly as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from compgen.data.comparison import best_rotation
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Deviations
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.diagnose.axis_session import LEAST_MM
from compgen.diagnose.engine import LEAST_BESIDE, SMALL_BESIDE, Candidate, Fit, NoiseGrid, Search
from compgen.diagnose.verdict import DisplayedDiagnosis
from compgen.errors import InputError, Message
from compgen.kinematics.kernel_switch import one_thread

#: Degrees of freedom beside pose and machine that a diagnosis needs.
LEAST_FREEDOM = 8
#: Share of a column that must be left beside pose, machine and scales.
LEAST_VISIBLE = 0.15
#: An alternative moves the features by at most this multiple of the range of their deviations.
PLAUSIBLE = 1.5
#: Scales that differ by less than this share of their mean have a common cause.
COMMON = 0.35
#: Lengths over which fields without a name change: shares of the half width of the part, and of the order.
FIELD_LENGTHS, ORDER_LENGTHS = (0.5, 1.0), (0.05, 0.15)
#: Waves from the first feature to the last that are tried.
WAVES = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
#: Directions along which features may be off by themselves, degrees: between those of the axes, which may repeat unequally.
SLANTING_DEG = (22.5, 45.0, 67.5, -22.5, -45.0, -67.5)
#: Parts of a field below this share of its variance are left out.
LEAST_OF_FIELD = 1e-3
#: A name that explains less than this share of what the fields without a name explain is tentative.
LEAST_OF_UNKNOWN = 1.0
#: Gain in twice the log likelihood of a field, and of features off along a line, from which a name beside it is tentative.
LEFT_OVER, LEFT_OVER_LINE = 5.0, 9.0
#: The same as a share of what the name gains; criterion within which a field replaces a name.
LEFT_OVER_SHARE, AS_GOOD = 0.12, 5.0
#: Scan positions charged for the direction of a line: neighbours are nearly alike.
LINE_SCANS = 2.0
#: Why a name is tentative that a field without a name could replace.
OF_FIELD = Message("field-as-good", "a smooth field without a name explains the features nearly as well")
#: p-value of the residuals against the stated uncertainty, below which something has no name.
MISFIT_P = 1e-4
#: Set-ups whose frames are further apart than this have poses of their own, mm.
OWN_POSE_MM = 0.2
#: A ring of features: largest share by which their distances from the centre differ.
ROUND = 0.05
#: Standard uncertainties below which an amount is not confirmed.
LEAST_SIZE = 2.0

WORDS = {
    "part_temperature": (
        "all lengths are {sign} by {size:.3g} um per m: the part was warmer or colder than assumed when it was made or measured, "
        "or all scales of the machine are",
        "measure part and scales at 20 degC, and log temp_part_c and temp_machined_c; if it remains, measure one length of "
        "each axis (axis runs) and export the scales",
    ),
    "tool_wear": (
        "the features drift by {size:.3g} um from the first to the last: a tool that wears, or a machine that warms up",
        "make (or probe) the first feature again at the end: if it is off, too, the machine drifts; otherwise change the tool "
        "earlier, or correct its offset with the number of features",
    ),
    "clamp_slip": (
        "from feature {at:.0f} on everything is shifted by {size:.3g} um: the part or the artefact slipped, or a zero was set "
        "again",
        "check clamping and work offset at this feature, and measure the features after it again",
    ),
    "setup_step": (
        "the set-ups are shifted against each other by {size:.3g} um",
        "align both set-ups to the same features, or measure a common feature in each and enter the difference as the work "
        "offset; the machine's tables cannot correct it",
    ),
    "probe_lobing": (
        "the features of the ring are off with three waves a turn, {size:.3g} um: the probe triggers later in some directions",
        "calibrate the probe in the directions in which it measures, or probe slowly; it is not an error of the axes",
    ),
    "outliers": (
        "a single feature is off by {size:.3g} um: {which}",
        "look for a burr or a chip, and measure this feature again; it is left out of everything else",
    ),
}
#: What separates the machine from the part, if something has no name.
TURNED = Message(
    "turn-the-part",
    "measure it once more, turned by 90 degrees: what turns with it belongs to the part, what stays to the machine",
)
MISSING = {
    "tool_wear": Message("repeat-first-drift", "repeat the first feature at the end: shows a drift (tool_wear)"),
    "clamp_slip": Message("repeat-first-clamp", "repeat the first feature at the end: shows a clamp that slipped"),
    "setup_step": Message("measure-in-both-setups", "measure one feature in both set-ups: shows a step between them"),
    "part_temperature": Message(
        "log-temperatures", "log temp_part_c and temp_machined_c: tells the temperature of the part from the scales"
    ),
    "probe_lobing": Message("probe-a-ring", "probe a ring of at least 12 features or points: shows lobes of the probe"),
}


@dataclass(frozen=True)
class Features:
    """n measured coordinates: feature, component, position of the feature (n, 3), deviation (n,), mm, order, set-up."""

    row: NDArray[np.int64]
    component: NDArray[np.int64]
    position_mm: FloatArray
    deviation_mm: FloatArray
    u_mm: FloatArray | None
    setup: NDArray[np.int64]
    names: Sequence[str]
    own: FloatArray
    one_frame: bool

    def field(self, vectors: FloatArray) -> FloatArray:
        """The measured components (n,) of vectors (features, 3)."""
        return np.asarray(vectors[self.row, self.component])


@dataclass(frozen=True, eq=False)
class FeatureCandidate(Candidate):
    """A candidate with its parameters (name, mm per unit of it for a column of one), the feature ``at``, and ``which`` it is."""

    parameters: tuple[tuple[str, float], ...] = ()
    at: float = math.nan
    which: str = ""


@dataclass(frozen=True)
class NamedFeatureEffect:
    """An effect with its parameters (value, u), what it explains, and names that explain nearly as much."""

    candidate: FeatureCandidate
    values: tuple[tuple[str, float, float], ...]
    gain: float
    alias: tuple[tuple[str, float], ...]
    reasons: tuple[str, ...]
    size_mm: float
    clear: float = math.inf


def features_of_part(deviations: Deviations) -> Features:
    """Features of a part in the frame of the machine, all set-ups in one pose if they are close enough to it."""
    measured = ~np.isnan(deviations.deviation_mm)
    row, component = np.nonzero(measured)
    setup = deviations.labels.get("setup", np.zeros(len(deviations), dtype=np.int64))
    u_mm = None if deviations.u_mm is None else deviations.u_mm[row, component]
    names = [f"row {k + 1}" for k in range(len(deviations))]
    value = deviations.deviation_mm.copy()
    one = True
    if len(np.unique(setup)) > 1 and deviations.poses:
        first = next(iter(deviations.poses.values()))
        for (
            label,
            pose,
        ) in deviations.poses.items():  # every set-up was aligned by itself: back to the pose of the first
            own = setup == label
            at = deviations.position_mm[own]
            actual = (np.nan_to_num(value[own]) + at - pose.nominal_mm) @ pose.rotation.T + pose.measured_mm
            value[own] = (actual - first.measured_mm) @ first.rotation + first.nominal_mm - at
        one = bool(np.abs(value[measured]).max() < OWN_POSE_MM)
        value = value if one else deviations.deviation_mm
    return Features(
        row, component, deviations.position_mm, value[row, component], u_mm, setup, names,
        np.zeros((len(row), 0)), one,
    )  # fmt: skip


def features_of_artefact(artefact: Artefact) -> Features:
    """Features of an artefact in the frame of the machine, each set-up in its own pose."""
    flat = np.isnan(artefact.measured_mm)
    measured = np.where(flat, 0.0, artefact.measured_mm)
    nominal = np.nan_to_num(artefact.nominal_mm)
    place, turned = np.zeros_like(measured), np.zeros((len(artefact), 3, 3))
    for label in np.unique(artefact.setup):
        rows = artefact.setup == label
        centred = (values[rows] - values[rows].mean(axis=0) for values in (measured, nominal))
        there, here = centred
        rotation = best_rotation(there.T @ here)
        turned[rows] = rotation
        place[rows] = (nominal[rows] - nominal[rows].mean(axis=0)) @ rotation.T + measured[rows].mean(axis=0)
    row, component = np.nonzero(~flat)
    names, number = np.unique(np.asarray(artefact.feature), return_inverse=True)
    own = np.zeros((len(row), 0))
    free = ~artefact.calibrated
    if free.any():  # the own place of an uncalibrated feature is the same in every set-up
        own = np.zeros((len(row), 3 * len(names)))
        for k in range(3):
            own[np.arange(len(row)), 3 * number[row] + k] = turned[row, component, k] * free[row]
    return Features(
        row,
        component,
        place,
        (measured - place)[row, component],
        None,
        artefact.setup,
        list(artefact.feature),
        own,
        False,
    )


def pose_of(f: Features) -> FloatArray:
    """Pose of the part (of every set-up), squareness, bows and cubic parts of the guides, (n, k)."""
    p = f.position_mm - f.position_mm.mean(axis=0)
    s = p / np.maximum(np.abs(p).max(axis=0), 1e-9)
    columns = [f.own]
    groups = [np.ones(len(p), dtype=bool)] if f.one_frame else [f.setup == label for label in np.unique(f.setup)]
    columns += [rigid(f, own) for own in groups]
    for i in range(3):
        for j in range(3):
            if i == j or np.ptp(p[:, j]) < 1e-6:
                continue
            for power in range(1, min(2, len(np.unique(np.round(p[:, j], 3))) - 1) + 1):
                columns.append(f.field(_vector(i, s[:, j] ** power))[:, None])
    columns += [
        f.field(_vector(i, s[:, i] ** 2))[:, None] for i in axes_of(f) if len(np.unique(np.round(p[:, i], 3))) > 3
    ]
    return np.hstack(columns)


def scales_of(f: Features) -> FloatArray:
    """The scale of each axis along which the features lie, (n, axes)."""
    p = f.position_mm - f.position_mm.mean(axis=0)
    return np.column_stack([np.zeros((len(f.row), 0)), *(f.field(_vector(i, p[:, i])) for i in axes_of(f))])


def base_of(f: Features) -> FloatArray:
    """Pose and machine: what is in :func:`pose_of`, and the differences of the scales, (n, k)."""
    scales = scales_of(f)
    return np.hstack([pose_of(f), scales[:, 1:] - scales[:, :1]])


def axes_of(f: Features) -> list[int]:
    """Axes along which the features lie and were measured."""
    return [i for i in range(3) if np.ptp(f.position_mm[:, i]) > 1e-6 and (f.component == i).any()]


def _vector(axis: int, values: FloatArray) -> FloatArray:
    found = np.zeros((len(values), 3))
    found[:, axis] = values
    return found


def rigid(f: Features, own: NDArray[np.bool_]) -> FloatArray:
    """Translation and rotation of the features ``own`` (features,), (n, 6)."""
    p = (f.position_mm - f.position_mm.mean(axis=0)) * own[:, None]
    shifts = [f.field(_vector(k, own.astype(np.float64))) for k in range(3)]
    turns = [f.field(np.cross(np.eye(3)[k], p)) for k in range(3)]
    return np.column_stack([*shifts, *turns])


def candidates_of(f: Features) -> list[FeatureCandidate]:
    """Effects with a name, and fields without one."""
    p = f.position_mm - f.position_mm.mean(axis=0)
    number = np.arange(len(p), dtype=np.float64)
    order = number / max(len(p) - 1, 1)
    letters = [k for k in range(3) if (f.component == k).any()]
    found = []

    def add(
        name: str,
        columns: FloatArray,
        parameters: tuple[tuple[str, float], ...],
        scans: float = 1.0,
        at: float = math.nan,
        which: str = "",
    ) -> None:
        found.append(FeatureCandidate(name, "named", columns, scans, parameters=parameters, at=at, which=which))

    def shifted(shape: FloatArray) -> FloatArray:
        return np.column_stack([f.field(_vector(k, shape)) for k in letters])

    size = float(np.abs(p).max())
    add("part_temperature", f.field(p / size)[:, None], (("c_um_per_m", 1e-6 * size),))
    names = tuple((f"c{'xyz'[k]}_um", MM_PER_UM) for k in letters)
    add("tool_wear", shifted(order), names)
    for at in range(2, len(p) - 1):
        add("clamp_slip", shifted((number >= at).astype(np.float64)), names, float(len(p) - 3), float(at + 1))
    labels = np.unique(f.setup)
    if f.one_frame and len(labels) > 1:
        for label in labels[1:]:
            add(
                "setup_step",
                shifted((f.setup == label).astype(np.float64)),
                names,
                float(len(labels) - 1),
                float(label),
            )
    flat = p[:, :2]
    radius = np.linalg.norm(flat, axis=1)
    if len(p) >= 9 and radius.min() > 0 and np.ptp(radius) < ROUND * radius.mean():
        angle = np.arctan2(flat[:, 1], flat[:, 0])
        unit = np.column_stack([flat / radius[:, None], 0 * radius])
        lobes = [f.field(unit * wave(3 * angle)[:, None]) for wave in (np.cos, np.sin)]
        add("probe_lobing", np.column_stack(lobes), (("c3_um", MM_PER_UM), ("s3_um", MM_PER_UM)))
    for k in range(len(p)):
        add("outliers", shifted((number == k).astype(np.float64)), names, float(len(p)), float(k + 1), f.names[k])
    return [*found, *_fields(f, p, order[:, None], letters)]


def _fields(f: Features, p: FloatArray, order: FloatArray, letters: Sequence[int]) -> list[FeatureCandidate]:
    """What has no name: fields over the place and the order, in each component and in all, and features off along a line."""
    found = []
    kinds = [
        (what, place, length, float(len(lengths)))
        for what, place, lengths in (
            ("the place", p / np.maximum(np.abs(p).max(axis=0), 1e-9), FIELD_LENGTHS),
            ("the order", order, ORDER_LENGTHS),
        )
        for length in lengths
    ]
    for what, place, length, scans in kinds:
        smooth = _process(place, length)[:, : max(len(p) // 2, 1)]
        each = [np.column_stack([f.field(_vector(k, shape)) for shape in smooth.T]) for k in letters]
        for columns in (*each, np.hstack(each)) if len(each) > 1 else each:
            found.append(FeatureCandidate(what, "generic", columns, scans, covariates=("feature",), process=True))
    q = p / np.maximum(np.abs(p).max(axis=0), 1e-9)
    shapes = [
        ("x with y", q[:, [0]] * q[:, [1]], 1.0),
        ("the cube of x", q[:, [0]] ** 3, 1.0),
        ("the cube of y", q[:, [1]] ** 3, 1.0),
    ]
    far = f.field(q * np.sum(q**2, axis=1, keepdims=True))[:, None]
    text = "the distance from the middle, not linearly"
    found.append(FeatureCandidate(text, "generic", far, 1.0, covariates=("feature",), process=True))
    for waves in WAVES:
        turn = 2 * np.pi * waves * order[:, 0]
        text = f"the order, about {waves:g} waves"
        shapes.append((text, np.column_stack([np.sin(turn), np.cos(turn)]), float(len(WAVES))))
    for what, shape, scans in shapes:
        columns = np.hstack([f.field(_vector(k, one))[:, None] for k in letters for one in shape.T])
        found.append(FeatureCandidate(what, "generic", columns, scans, covariates=("feature",), process=True))
    if not {0, 1} - set(letters):
        for degrees in SLANTING_DEG:
            along = np.array([math.cos(math.radians(degrees)), math.sin(math.radians(degrees)), 0.0])
            own = np.column_stack([f.field(np.outer(one, along)) for one in np.eye(len(p))])
            text = f"a line at {degrees:g} degrees, each by itself"
            line = FeatureCandidate(text, "generic", own, LINE_SCANS, covariates=("feature",), process=True)
            found.append(replace(line, only_one="line"))
    return found


def _process(place: FloatArray, length: float) -> FloatArray:
    """Columns (n, k) whose random sums are a smooth process of unit variance over ``place`` (n, d)."""
    apart = np.sum((place[:, None, :] - place[None, :, :]) ** 2, axis=2)
    value, vector = np.linalg.eigh(np.exp(-0.5 * apart / length**2))
    value, vector = value[::-1], vector[:, ::-1]
    kept = value > LEAST_OF_FIELD * value[0]
    return np.asarray(vector[:, kept] * np.sqrt(value[kept]))


class FeatureSearch(Search):
    """The engine for features: white noise, weighted by the uncertainties; ``scale`` (n,) multiplies all readings."""

    def __init__(self, f: Features, candidates: Sequence[FeatureCandidate], sigma_mm: float | None) -> None:
        self.f, self.of = f, list(candidates)
        self.scale = np.ones(len(f.row)) if f.u_mm is None else np.asarray(np.mean(f.u_mm) / f.u_mm)
        base = base_of(f) * self.scale[:, None]
        size = np.linalg.norm(base, axis=0)
        turn, singular, _ = np.linalg.svd(base / np.where(size > 1e-12, size, 1.0), full_matrices=False)
        grid = NoiseGrid(np.ones(len(f.row) - 1), turn[:, singular > 1e-8 * singular[0]], ((0.0, 0.0),), sigma_mm)
        weighted = [replace(item, columns=item.columns * self.scale[:, None]) for item in candidates]
        super().__init__(f.deviation_mm * self.scale, grid, weighted, LEAST_MM)

    def left(self, members: Sequence[int], rows: NDArray[np.bool_] | None = None) -> FloatArray:
        """Residuals (n,) as weighted; fitted to ``rows`` only, if given."""
        wide = np.hstack([self.grid.base, self.columns_of(members)])
        chosen = np.ones(len(self.y), dtype=bool) if rows is None else rows
        found = np.linalg.lstsq(wide[chosen], self.y[chosen], rcond=1e-8)[0]
        return np.asarray(self.y - wide @ found)

    def moves(self, rest: Sequence[int], member: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values and covariance of a member beside others, and by how much it moves each coordinate (n,), mm."""
        own = self.candidates[member].columns
        known = np.hstack([self.grid.base, self.columns_of(rest)])
        value, covariance = Fit(self, [*rest, member]).estimate(known, own)
        return value, covariance, self.of[member].columns @ value

    def plausible(self, rest: Sequence[int], member: int) -> bool:
        """Whether it moves no feature by more than all features are off together."""
        moved = self.moves(rest, member)[2]
        return float(np.ptp(moved)) <= PLAUSIBLE * float(np.ptp(self.f.deviation_mm))


def shown(f: Features, base: FloatArray, candidates: Sequence[FeatureCandidate]) -> list[FeatureCandidate]:
    """The candidates, those ``hidden`` of which too little is left beside pose and machine, and beside the scales.

    Features in rows, one after another, drift with their order as they do with their place.
    """
    p = f.position_mm - f.position_mm.mean(axis=0)
    scale, found = f.field(p / float(np.abs(p).max()))[:, None], []
    for item in candidates:
        known = base if item.name == "part_temperature" else np.hstack([base, scale])
        size = np.linalg.norm(known, axis=0)
        known = known / np.where(size > 1e-12, size, 1.0)
        left = item.columns - known @ np.linalg.lstsq(known, item.columns, rcond=1e-8)[0]
        own = np.linalg.norm(item.columns - item.columns.mean(axis=0), axis=0)
        seen = bool((np.linalg.norm(left, axis=0) > LEAST_VISIBLE * own).any())
        found.append(item if seen or item.tier == "generic" else replace(item, tier="hidden"))
    return found


@dataclass(frozen=True, repr=False)
class FeatureDiagnosis(DisplayedDiagnosis):
    """Diagnosis of the features of a part or an artefact."""

    machine: Machine
    features: Features
    effects: tuple[NamedFeatureEffect, ...]
    unknown: tuple[str, ...]
    residuals_mm: tuple[FloatArray, FloatArray]
    left_out_rms_mm: tuple[float, float]
    sigma_mm: float
    source: str
    missing: tuple[str, ...]
    reasons: tuple[str, ...] = ()

    @property
    def word(self) -> str:
        """The verdict."""
        if self.reasons:
            return "not_decidable"
        firm = any(not item.reasons for item in self.effects)
        return "named" if firm else "unknown" if self.unknown or self.effects else "none"

    @property
    def acceptable(self) -> bool:
        """Whether it is decided, and what was named also holds on features left out."""
        return not self.reasons and (not self.effects or self.left_out_rms_mm[1] < self.left_out_rms_mm[0])

    def to_dict(self) -> dict[str, Any]:
        """The content of ``diagnosis.json``."""
        before, after = (float(np.sqrt(np.mean(values**2))) / MM_PER_UM for values in self.residuals_mm)
        left_out = [value / MM_PER_UM for value in self.left_out_rms_mm]
        return {
            "verdict": self.word,
            "effects": [self._effect(item) for item in self.effects],
            "unknown": [
                {"covariates": ["feature"], "direction": "position", "rms_um": None, "text": text, "resembles": None}
                for text in self.unknown
            ],
            "invisible": list(self.missing),
            "secondary": [],
            "gap": {
                "train": {"before_rms_um": before, "after_rms_um": after},
                "heldout_lines": {"before_rms_um": left_out[0], "after_rms_um": left_out[1]},
                "heldout_stations": None,
                "heldout_times": None,
                "noise_floor_um": self.sigma_mm / MM_PER_UM,
                "noise_floor_source": self.source,
            },
            "advice": [
                *([TURNED] if self.unknown else []),
                *(MISSING[name] for name in self.missing if name in MISSING),
            ],
            "reasons": list(self.reasons),
            "notes": [
                Message("order-of-rows", "the order of the features in time is taken as that of the rows"),
                Message(
                    "errors-of-machine",
                    "squareness, difference of the scales and bows of the guides are errors of the machine: identify shows them",
                ),
            ],
            "evidence": {"readings": len(self.features.row), "features": len(self.features.position_mm)},
        }

    def _effect(self, item: NamedFeatureEffect) -> dict[str, Any]:
        what, todo = WORDS[item.candidate.name]
        sign = "too long" if item.values[0][1] > 0 else "too short"
        size = abs(item.values[0][1]) if item.candidate.name == "part_temperature" else item.size_mm / MM_PER_UM
        return {
            "name": item.candidate.name,
            "belongs_to": "session",
            "text": what.format(sign=sign, size=size, at=item.candidate.at, which=item.candidate.which),
            "what_to_do": todo,
            "alias_set": [{"name": name, "weight": round(weight, 4)} for name, weight in item.alias],
            "parameters": {name: {"value": value, "u": u} for name, value, u in item.values}
            | ({} if math.isnan(item.candidate.at) else {"at": {"value": item.candidate.at, "u": None}}),
            "confidence": round(next(weight for name, weight in item.alias if name == item.candidate.name), 4),
            "grade": "tentative" if item.reasons else "beside_unknown" if self.unknown else "confirmed",
            "visible_fraction": 1.0,
            "chi2": item.gain,
            "reasons": list(item.reasons),
        }


def diagnose_features(
    machine: Machine,
    measured: Deviations | Artefact,
    *,
    most: int = 4,
    u_um: float | None = None,
    show: Callable[[str], None] = lambda _: None,
) -> FeatureDiagnosis:
    """Diagnose the features of a part (as read) or of an artefact.

    Raises
    ------
    InputError
        for too few features.
    """
    f = features_of_artefact(measured) if isinstance(measured, Artefact) else features_of_part(measured)
    stated = None if u_um is None else u_um * MM_PER_UM
    if stated is None and f.u_mm is not None and np.isfinite(f.u_mm).all():
        stated = float(np.mean(f.u_mm))
    rank = int(np.linalg.matrix_rank(base_of(f)))
    if len(f.row) - rank < LEAST_FREEDOM:
        reason = (
            f"{len(f.row)} measured coordinates of {len(f.position_mm)} features leave {max(len(f.row) - rank, 0)} degrees of "
            f"freedom beside pose and machine; a diagnosis needs at least {LEAST_FREEDOM}: measure more features, or an "
            "uncalibrated artefact in more set-ups"
        )
        if len(f.row) <= rank:
            raise InputError(reason)
        before = FeatureSearch(f, [], stated).left([])
        rms = float(np.sqrt(np.mean(before**2)))
        return FeatureDiagnosis(
            machine, f, (), (), (before, before), (rms, rms), rms, "assumed", tuple(MISSING), (reason,)
        )
    show("comparing candidate effects")
    candidates = shown(f, base_of(f), candidates_of(f))
    with one_thread():
        search = FeatureSearch(f, candidates, stated)
        members = search.run(most + 1)
        scales = [
            k for k in members if search.candidates[k].name == "part_temperature" and not _common(search, members, k)
        ]
        named = [k for k in members if search.candidates[k].tier == "named" and k not in scales][:most]
        fields = [k for k in members if search.candidates[k].tier == "generic"]
        always = [*scales, *fields]
        effects = tuple(_graded(search, always, named, k, fields) for k in named)
    largest = max((item.gain for item in effects), default=0.0)
    effects = tuple(
        replace(item, reasons=(*item.reasons, Message("small-beside-others", "it is small beside the others")))
        if item.gain < SMALL_BESIDE * largest and item.clear < LEAST_BESIDE
        else item
        for item in effects
    )
    before, after = search.left(scales), search.left([*scales, *named])
    freedom = max(len(after) - rank - search.columns_of([*scales, *named]).shape[1], 1)
    sigma_mm = stated if stated is not None else Fit(search, members).sigma_mm
    unknown = [_text(search.candidates[k].name) for k in fields]
    doubted = [item for item in effects if OF_FIELD in item.reasons]
    if not unknown and doubted and all(item.reasons for item in effects):
        unknown.append(f"a pattern that {doubted[0].candidate.name} explains in part")
    if stated is not None and not unknown and float(chdtrc(freedom, float(after @ after) / stated**2)) < MISFIT_P:
        unknown.append("the features scatter by more than their uncertainty")
    show("testing on features left out")
    visible = {item.name for item in candidates if item.tier == "named"}
    missing = [name for name in MISSING if name not in visible]
    return FeatureDiagnosis(
        machine, f, effects, tuple(unknown), (before, after), _left_out(search, scales, named), sigma_mm,
        "stated" if stated is not None else "residuals", tuple(missing),
    )  # fmt: skip


def _text(name: str) -> str:
    return f"the features are off along {name}" if name.startswith("a line") else f"a field that depends on {name}"


def _common(search: FeatureSearch, members: Sequence[int], member: int) -> bool:
    """Whether the scales of all axes are nearly alike: otherwise they are errors of the machine, and it is no temperature."""
    f, rest = search.f, search.columns_of([k for k in members if k != member])
    each = scales_of(f) * search.scale[:, None]
    wide = np.hstack([pose_of(f) * search.scale[:, None], rest, each])
    size = np.linalg.norm(wide, axis=0)
    value = np.linalg.lstsq(wide / np.where(size > 1e-12, size, 1.0), search.y, rcond=1e-8)[0][-each.shape[1] :]
    scales = value / size[-each.shape[1] :]
    return float(np.abs(scales - scales.mean()).max()) <= COMMON * abs(float(scales.mean()))


def _graded(
    search: FeatureSearch, always: Sequence[int], named: Sequence[int], member: int, fields: Sequence[int]
) -> NamedFeatureEffect:
    """Grade, parameters and alternatives of one of the ``named`` members; ``always`` are the others in the model."""
    item, rest = search.of[member], [k for k in (*always, *named) if k != member]
    value, covariance, moved = search.moves(rest, member)
    u = np.sqrt(np.diag(covariance))
    values = tuple(
        (name, float(v) / unit, float(w) / unit) for (name, unit), v, w in zip(item.parameters, value, u, strict=True)
    )
    gains, criteria = search.criteria(rest)
    alias = search.alternatives(criteria, member, lambda k: search.plausible(rest, k))
    reasons = []
    if not float(np.max(np.abs(value) / np.where(u > 0, u, np.inf))) >= LEAST_SIZE:
        reasons.append(
            Message(
                "within-its-uncertainty",
                "it is smaller than {LEAST_SIZE:g} times its standard uncertainty",
                LEAST_SIZE=LEAST_SIZE,
            )
        )
    own = dict(alias)[item.name]
    rival = next((name for name, weight in alias if name != item.name and weight > 0.5 * own), "")
    if rival:
        reasons.append(Message("rival-as-good", "{rival} explains the features nearly as well", rival=rival))
    smooth = [float(criteria[k]) for k, one in enumerate(search.candidates) if one.tier == "generic" and k not in rest]
    if max(smooth, default=-np.inf) > float(criteria[member]) - AS_GOOD:
        reasons.append(OF_FIELD)
    left_over = search.gains([*rest, member])
    limits = {
        line: max(least, LEFT_OVER_SHARE * gains[member])
        for line, least in ((True, LEFT_OVER_LINE), (False, LEFT_OVER))
    }
    for k, one in enumerate(search.candidates):
        if one.tier == "generic" and k not in rest and left_over[k] > limits[bool(one.only_one)] and not reasons:
            reasons.append(
                Message("unknown-left-over", "something without a name is left over, of which it may be a part")
            )
    unnamed = sum(float(search.gains([k for k in (*always, *named) if k != g])[g]) for g in fields)
    if fields and float(gains[member]) < LEAST_OF_UNKNOWN * unnamed:
        reasons.append(Message("small-beside-unknown", "small compared with the unexplained part"))
    others = [k for k in named if k != member]
    if item.name != "outliers" and _left_out(search, always, named)[1] >= _left_out(search, always, others)[1]:
        reasons.append(Message("fails-left-out-features", "it does not hold on features left out"))
    largest = float(np.abs(moved).max()) if len(value) == 1 else float(np.linalg.norm(value))
    return NamedFeatureEffect(
        item, values, float(gains[member]), alias, tuple(reasons), largest, float(criteria[member])
    )


def _left_out(search: FeatureSearch, always: Sequence[int], named: Sequence[int]) -> tuple[float, float]:
    """RMS of features left out, one in turn, without and with the named members, mm; outliers do not count."""
    alone = {int(search.of[k].at) - 1 for k in named if search.of[k].name == "outliers"}
    predicting = [k for k in always if search.of[k].tier == "named"]
    found = []
    for items in (predicting, [*predicting, *(k for k in named if search.of[k].name != "outliers")]):
        square, count = 0.0, 0
        for feature in np.unique(search.f.row):
            if int(feature) in alone:
                continue
            out = search.f.row == feature
            keep = ~out & ~np.isin(search.f.row, list(alone))
            left = search.left(items, keep)[out]
            square, count = square + float(left @ left), count + len(left)
        found.append(math.sqrt(square / max(count, 1)))
    return found[0], found[1]
