"""Diagnosis of features: parts measured elsewhere, and artefacts under the machine's own probe.

The pose of the part (of every set-up of an artefact), a squareness, the difference of the scales, and bows of the guides
are free: they are errors of the machine, and `identify` shows them. Beside these are compared

    part_temperature    d = c p                     all lengths are too long or too short alike
    tool_wear           d = c k, k the order        the same drift from feature to feature (wear, or warm-up)
    clamp_slip          d = H(k - at) (c + r x p)   everything after one feature is shifted and turned
    setup_step          the same from set-up to set-up, of a part in one frame
    probe_lobing        d = c cos 3a + s sin 3a     three lobes along a ring of features (a its angle)
    outliers            single features that are off

and smooth fields without a name. The order of the features is that of the rows. Few features show little: every column
pays its price, and what is named must also hold on features left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from compgen.data.comparison import best_rotation
from compgen.data.csv_files import FloatArray
from compgen.data.deviations import Artefact, Deviations
from compgen.data.machine import Machine
from compgen.data.names import MM_PER_UM
from compgen.diagnose.verdict import DisplayedDiagnosis
from compgen.errors import InputError

#: Degrees of freedom beside pose and machine that a diagnosis needs.
LEAST_FREEDOM = 8
#: Gain beyond the price that a name needs; criteria closer than this are alternatives (99 %).
LEAST_GAIN, ALIAS = 9.0, 9.2
#: What every name beyond the first must gain in addition.
MORE_NAMES = 6.0
#: Share of a column that must be left beside pose, machine and scales.
LEAST_VISIBLE = 0.15
#: An alternative moves the features by at most this multiple of the range of their deviations.
PLAUSIBLE = 1.5
#: Scales that differ by less than this share of their mean have a common cause.
COMMON = 0.35
#: What a field without a name must gain in addition.
HANDICAP = 4.0
#: p-value of the residuals against the stated uncertainty, below which something has no name.
MISFIT_P = 1e-4
#: Set-ups whose frames are further apart than this have poses of their own, mm.
OWN_POSE_MM = 0.2
#: A ring of features: largest share by which their distances from the centre differ.
ROUND = 0.05
#: Scales of the axes that differ: errors of the machine, which are not reported here.
SCALES = "scales"
#: Waves from the first feature to the last that are tried as fields without a name.
WAVES = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
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
MISSING = {
    "tool_wear": "repeat the first feature at the end: shows a drift (tool_wear)",
    "clamp_slip": "repeat the first feature at the end: shows a clamp that slipped",
    "setup_step": "measure one feature in both set-ups: shows a step between them",
    "part_temperature": "log temp_part_c and temp_machined_c: tells the temperature of the part from the scales",
    "probe_lobing": "probe a ring of at least 12 features or points: shows lobes of the probe",
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
class FeatureCandidate:
    """Columns (n, k) with a name, or a field without one; ``scans`` places at which it was tried."""

    name: str
    columns: FloatArray
    parameters: tuple[tuple[str, float], ...]
    scans: float = 1.0
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


def base_of(f: Features) -> FloatArray:
    """Pose of the part (of every set-up), squareness, difference of the scales, bows and cubic parts of the guides, (n, k)."""
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
    axes = [i for i in range(3) if np.ptp(p[:, i]) > 1e-6 and (f.component == i).any()]
    columns += [f.field(_vector(i, s[:, i] ** 2))[:, None] for i in axes if len(np.unique(np.round(p[:, i], 3))) > 3]
    return np.hstack(columns)


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


def candidates_of(f: Features) -> tuple[list[FeatureCandidate], list[FeatureCandidate]]:
    """Effects with a name, and fields without one."""
    p = f.position_mm - f.position_mm.mean(axis=0)
    number = np.arange(len(p), dtype=np.float64)
    order = number / max(len(p) - 1, 1)
    letters = [k for k in range(3) if (f.component == k).any()]
    named = [FeatureCandidate("part_temperature", f.field(p)[:, None], (("c_um_per_m", 1e-6),))]
    if len(axes := [k for k in letters if np.ptp(p[:, k]) > 1e-6]) > 1:
        scales = np.column_stack([f.field(_vector(k, p[:, k])) for k in axes])
        named.append(FeatureCandidate(SCALES, scales, tuple((f"c_{'xyz'[k]}_um_per_m", 1e-6) for k in axes)))
    wear = np.column_stack([f.field(_vector(k, order)) for k in letters])
    names = tuple((f"c{'xyz'[k]}_um", MM_PER_UM) for k in letters)
    named.append(FeatureCandidate("tool_wear", wear, names))
    for at in range(2, len(p) - 1):
        after = number >= at
        step = np.column_stack([f.field(_vector(k, after.astype(np.float64))) for k in letters])
        named.append(FeatureCandidate("clamp_slip", step, names, float(len(p) - 3), float(at + 1)))
    labels = np.unique(f.setup)
    if f.one_frame and len(labels) > 1:
        for label in labels[1:]:
            own = (f.setup == label).astype(np.float64)
            step = np.column_stack([f.field(_vector(k, own)) for k in letters])
            named.append(FeatureCandidate("setup_step", step, names, float(len(labels) - 1), float(label)))
    flat = p[:, :2]
    radius = np.linalg.norm(flat, axis=1)
    if len(p) >= 9 and radius.min() > 0 and np.ptp(radius) < ROUND * radius.mean():
        angle = np.arctan2(flat[:, 1], flat[:, 0])
        unit = np.column_stack([flat / radius[:, None], 0 * radius])
        lobes = np.column_stack(
            [f.field(unit * np.cos(3 * angle)[:, None]), f.field(unit * np.sin(3 * angle)[:, None])]
        )
        named.append(FeatureCandidate("probe_lobing", lobes, (("c3_um", MM_PER_UM), ("s3_um", MM_PER_UM))))
    for k in range(len(p)):
        own = np.column_stack([f.field(_vector(j, (number == k).astype(np.float64))) for j in letters])
        named.append(FeatureCandidate("outliers", own, names, float(len(p)), float(k + 1), f.names[k]))
    s = p / np.maximum(np.abs(p).max(axis=0), 1e-9)
    fields = []
    for what, shape in (
        ("x with y", s[:, 0] * s[:, 1]),
        ("the cube of x", s[:, 0] ** 3),
        ("the cube of y", s[:, 1] ** 3),
    ):
        columns = np.column_stack([f.field(_vector(k, shape)) for k in letters])
        fields.append(FeatureCandidate(what, columns, ()))
    for waves in WAVES:
        turn = 2 * np.pi * waves * order
        text = f"the order, about {waves:g} waves"
        each = [
            np.column_stack([f.field(_vector(k, np.sin(turn))), f.field(_vector(k, np.cos(turn)))]) for k in letters
        ]
        fields += [FeatureCandidate(text, columns, (), float(len(WAVES))) for columns in (*each, np.hstack(each))]
    return named, fields


class _Fit:
    """Least squares with base columns, and what further columns explain beside them."""

    def __init__(self, f: Features, base: FloatArray, sigma_mm: float | None) -> None:
        self.f, self.base, self.weight = f, base, 1.0 if f.u_mm is None else np.mean(f.u_mm) / f.u_mm
        self.sigma_mm = sigma_mm

    def left(self, items: Sequence[FeatureCandidate], rows: NDArray[np.bool_] | None = None) -> tuple[FloatArray, int]:
        """Weighted residuals (n,) and the rank; fitted to ``rows`` only, if given."""
        columns = np.hstack([self.base, *(item.columns for item in items)])
        wide = columns * np.broadcast_to(self.weight, len(columns))[:, None]
        value = self.f.deviation_mm * self.weight
        size = np.linalg.norm(wide, axis=0)
        wide = wide / np.where(size > 1e-12, size, 1.0)
        chosen = np.ones(len(value), dtype=bool) if rows is None else rows
        found, _, rank, _ = np.linalg.lstsq(wide[chosen], value[chosen], rcond=1e-8)
        return value - wide @ found, int(rank)

    def shows(self, item: FeatureCandidate, others: Sequence[FeatureCandidate]) -> bool:
        """Whether enough of an effect is left beside pose and machine, and beside the scales unless it is one itself.

        Features in rows, one after another, drift with their order as they do with their place.
        """
        scales = [one.columns for one in others if one.name == SCALES and item.name not in (SCALES, "part_temperature")]
        columns = np.hstack([self.base, *scales])
        size = np.linalg.norm(columns, axis=0)
        columns = columns / np.where(size > 1e-12, size, 1.0)
        left = item.columns - columns @ np.linalg.lstsq(columns, item.columns, rcond=1e-8)[0]
        own = np.linalg.norm(item.columns - item.columns.mean(axis=0), axis=0)
        return bool((np.linalg.norm(left, axis=0) > LEAST_VISIBLE * own).any())

    def plausible(self, items: Sequence[FeatureCandidate]) -> bool:
        """Whether the last effect moves no feature by more than all features are off together."""
        columns = np.hstack([self.base, *(item.columns for item in items)])
        size = np.linalg.norm(columns, axis=0)
        size = np.where(size > 1e-12, size, 1.0)
        value = np.linalg.lstsq(columns / size, self.f.deviation_mm, rcond=1e-8)[0] / size
        moved = items[-1].columns @ value[-items[-1].columns.shape[1] :]
        return float(np.ptp(moved)) <= PLAUSIBLE * float(np.ptp(self.f.deviation_mm))

    def criterion(self, items: Sequence[FeatureCandidate], extra: float = 0.0) -> float:
        """-2 log likelihood with the price of every column."""
        left, rank = self.left(items)
        n, square = len(left), float(left @ left)
        if n - rank < 2:
            return math.inf
        if self.sigma_mm is not None:
            fit = square / self.sigma_mm**2
        else:  # the variance is estimated: every column also takes a degree of freedom
            fit = n * math.log(max(square, 1e-18 * n) / n) + n * math.log(n / (n - rank))
        return fit + rank * math.log(n) + sum(2.0 * math.log(item.scans) for item in items) + extra


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
            "advice": [MISSING[name] for name in self.missing if name in MISSING],
            "reasons": list(self.reasons),
            "notes": [
                "the order of the features in time is taken as that of the rows",
                "squareness, difference of the scales and bows of the guides are errors of the machine: identify shows them",
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
    base = base_of(f)
    stated = None if u_um is None else u_um * MM_PER_UM
    if stated is None and f.u_mm is not None and np.isfinite(f.u_mm).all():
        stated = float(np.mean(f.u_mm))
    fit = _Fit(f, base, stated)
    before, rank = fit.left([])
    if len(before) - rank < LEAST_FREEDOM:
        reason = (
            f"{len(before)} measured coordinates of {len(f.position_mm)} features leave {max(len(before) - rank, 0)} degrees of "
            f"freedom beside pose and machine; a diagnosis needs at least {LEAST_FREEDOM}: measure more features, or an "
            "uncalibrated artefact in more set-ups"
        )
        if len(before) <= rank:
            raise InputError(reason)
        rms = float(np.sqrt(np.mean(before**2)))
        return FeatureDiagnosis(
            machine, f, (), (), (before, before), (rms, rms), rms, "assumed", tuple(MISSING), (reason,)
        )
    show("comparing candidate effects")
    named, fields = candidates_of(f)
    hidden = {item.name for item in named if not fit.shows(item, named)}
    faint = [item for item in named if item.name in hidden]
    named = [item for item in named if item.name not in hidden]
    members, unnamed = _searched(fit, named, fields, most)
    members = _common_scale(fit, members, named)
    scales = [item for item in members if item.name == SCALES]
    fit.base = np.hstack([fit.base, *(item.columns for item in scales)])
    members = [item for item in members if item.name != SCALES]
    before, _ = fit.left([])
    named = [item for item in named if item.name != SCALES]
    after, rank = fit.left(members)
    freedom = len(after) - rank
    sigma_mm = stated if stated is not None else float(np.sqrt(after @ after / max(freedom, 1)))
    unknown = [f"a field that depends on {item.name}" for item in unnamed]
    if stated is not None and not unknown and float(chdtrc(freedom, float(after @ after) / stated**2)) < MISFIT_P:
        unknown.append("the features scatter by more than their uncertainty")
    effects = tuple(_graded(fit, members, k, [*named, *faint], sigma_mm) for k in range(len(members)))
    show("testing on features left out")
    shown = {item.name for item in named} - hidden
    missing = [name for name in MISSING if name not in shown]
    return FeatureDiagnosis(
        machine, f, effects, tuple(unknown), (before, after), _left_out(fit, members), sigma_mm,
        "stated" if stated is not None else "residuals", tuple(missing),
    )  # fmt: skip


def _searched(
    fit: _Fit, named: Sequence[FeatureCandidate], fields: Sequence[FeatureCandidate], most: int
) -> tuple[list[FeatureCandidate], list[FeatureCandidate]]:
    """Names that improve the criterion, one after another, and fields without a name that compete with them."""
    members: list[FeatureCandidate] = []
    unnamed: list[FeatureCandidate] = []
    while len(members) < most + 1:
        now = fit.criterion([*members, *unnamed])
        scored = [(fit.criterion([*members, *unnamed, item]), 0, item) for item in named if item not in members]
        scored += [
            (fit.criterion([*members, *unnamed, item]) + HANDICAP, 1, item) for item in fields if item not in unnamed
        ]
        value, kind, best = min(scored, key=lambda entry: entry[:2])
        if now - value < LEAST_GAIN + MORE_NAMES * len(members):
            break
        (unnamed if kind else members).append(best)
        if len(unnamed) > 2:
            break
    # an effect that another one made superfluous
    for item in list(members):
        rest = [one for one in members if one is not item]
        if fit.criterion([*rest, *unnamed]) - fit.criterion([*members, *unnamed]) < LEAST_GAIN:
            members = rest
    return members, unnamed


def _common_scale(
    fit: _Fit, members: list[FeatureCandidate], named: Sequence[FeatureCandidate]
) -> list[FeatureCandidate]:
    """Members with a temperature in place of scales that are nearly alike; their difference is left to the machine."""
    scales = next((item for item in members if item.name == SCALES), None)
    warm = next((item for item in named if item.name == "part_temperature"), None)
    if scales is None or warm is None or warm in members:
        return members
    columns = np.hstack([fit.base, *(one.columns for one in members if one is not scales), scales.columns])
    size = np.linalg.norm(columns, axis=0)
    value = np.linalg.lstsq(columns / np.where(size > 1e-12, size, 1.0), fit.f.deviation_mm, rcond=1e-8)[0]
    value = (value / np.where(size > 1e-12, size, 1.0))[-scales.columns.shape[1] :]
    if float(np.abs(value - value.mean()).max()) > COMMON * abs(float(value.mean())):
        return members
    fit.base = np.hstack([fit.base, scales.columns[:, 1:]])
    return [warm, *(one for one in members if one is not scales)]


def _graded(
    fit: _Fit, members: Sequence[FeatureCandidate], number: int, named: Sequence[FeatureCandidate], sigma_mm: float
) -> NamedFeatureEffect:
    item, rest = members[number], [one for k, one in enumerate(members) if k != number]
    columns = np.hstack([fit.base, *(one.columns for one in rest), item.columns])
    columns = columns * np.broadcast_to(fit.weight, len(columns))[:, None]
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 1e-12, size, 1.0)
    inverse = np.linalg.pinv(columns / size, rcond=1e-8) / size[:, None]
    found = inverse @ (fit.f.deviation_mm * fit.weight)
    u = sigma_mm * np.linalg.norm(inverse, axis=1)
    k = item.columns.shape[1]
    values = tuple(
        (name, float(v) / unit, float(w) / unit)
        for (name, unit), v, w in zip(item.parameters, found[-k:], u[-k:], strict=True)
    )
    own = fit.criterion([*rest, item])
    best: dict[str, float] = {}
    for one in named:
        if one not in rest and (one is item or fit.plausible([*rest, one])):
            best[one.name] = min(best.get(one.name, math.inf), fit.criterion([*rest, one]))
    weights = {name: math.exp(-0.5 * (value - own)) for name, value in best.items() if value - own < ALIAS}
    weights[item.name] = 1.0
    total = sum(weights.values())
    reasons = []
    if max(abs(v) / w if w else math.inf for _, v, w in values) < LEAST_SIZE:
        reasons.append(f"it is smaller than {LEAST_SIZE:g} times its standard uncertainty")
    rival = max(
        ((name, weight) for name, weight in weights.items() if name != item.name), key=lambda e: e[1], default=None
    )
    if rival is not None and rival[1] > 1.0 / 3.0:
        reasons.append(f"{rival[0]} explains the features nearly as well")
    before, after = _left_out(fit, rest), _left_out(fit, members)
    if item.name != "outliers" and after[1] >= before[1]:
        reasons.append("it does not hold on features left out")
    moved = item.columns @ found[-k:]
    largest = float(np.abs(moved).max()) if k == 1 else float(np.linalg.norm(found[-k:]))
    alias = tuple(sorted(((name, weight / total) for name, weight in weights.items()), key=lambda e: -e[1]))
    return NamedFeatureEffect(item, values, fit.criterion(rest) - own, alias, tuple(reasons), largest)


def _left_out(fit: _Fit, members: Sequence[FeatureCandidate]) -> tuple[float, float]:
    """RMS of features left out, one in turn, without and with the members, mm; outliers do not count."""
    alone = {int(item.at) - 1 for item in members if item.name == "outliers"}
    found = []
    for items in ([], [item for item in members if item.name != "outliers"]):
        square, count = 0.0, 0
        for feature in np.unique(fit.f.row):
            if int(feature) in alone:
                continue
            out = fit.f.row == feature
            keep = ~out & ~np.isin(fit.f.row, list(alone))
            left = fit.left(items, keep)[0][out]
            square, count = square + float(left @ left), count + len(left)
        found.append(math.sqrt(square / max(count, 1)))
    return found[0], found[1]
