"""Judges a diagnosis (the content of ``diagnosis.json``) against the key of a hidden set."""

from __future__ import annotations

import math
from dataclasses import dataclass

#: Names that describe noise or a gross error, not an effect.
NOISE_NAMES = ("outliers", "variance_trend", "autocorrelated_noise", "quantisation", "disturbed_readings")
#: Effects outside the lists for which a name is right all the same.
RIGHT_NAMES = {"table_jump": "machine_jump"}
NORMAL_95 = 1.959964


@dataclass(frozen=True)
class Said:
    """What a diagnosis said: names without noise classes, in its order."""

    verdict: str
    first: str | None
    confirmed: tuple[str, ...]
    tentative: tuple[str, ...]
    noise: tuple[str, ...]
    sets: dict[str, dict[str, float]]
    unknown: bool
    invisible: tuple[str, ...]


def said(diagnosis: dict) -> Said:
    """Read a diagnosis."""
    effects = diagnosis["effects"]
    real = [e for e in effects if e["name"] not in NOISE_NAMES]
    return Said(
        verdict=diagnosis["verdict"],
        first=effects[0]["name"] if effects else None,
        confirmed=tuple(e["name"] for e in real if e["grade"] != "tentative"),
        tentative=tuple(e["name"] for e in real if e["grade"] == "tentative"),
        noise=tuple(e["name"] for e in effects if e["name"] in NOISE_NAMES),
        sets={e["name"]: {a["name"]: a["weight"] for a in e["alias_set"]} for e in effects},
        unknown=diagnosis["verdict"] == "unknown" or bool(diagnosis["unknown"]),
        invisible=tuple(diagnosis["invisible"]),
    )


def of_null(given: Said) -> str:
    """``clean``, or what was alarmed."""
    if given.confirmed or given.tentative:
        return "false name"
    if given.unknown:
        return "false unknown"
    if given.noise:
        return "noise named"
    return "clean" if given.verdict == "none" else given.verdict


def of_named(given: Said, truth: set[str]) -> str:
    """``exact``, or what is missing or too much."""
    confirmed = set(given.confirmed)
    if not confirmed and set(given.tentative) == truth and given.verdict == "named":
        return "exact, tentative"
    if confirmed == truth:
        if given.unknown or given.tentative:
            return "exact, but flagged"
        return "exact"
    if confirmed - truth:
        in_sets = set().union(*(set(given.sets[name]) for name in confirmed - truth))
        return "alias set holds it" if truth - confirmed <= in_sets and len(confirmed) == len(truth) else "wrong name"
    if confirmed:
        return "part, unknown flagged" if given.unknown else "part"
    return "unknown flagged" if given.unknown or given.tentative else "silent"


def of_unlisted(given: Said, label: str) -> str:
    """``unknown``, ``misnamed``, ``tentative`` or ``silent``; ``right name`` where there is one after all."""
    if given.confirmed:
        return "right name" if set(given.confirmed) == {RIGHT_NAMES.get(label)} else "misnamed"
    if given.unknown:
        return "unknown"
    return "tentative" if given.tentative else "silent"


def of_mixed(given: Said, truth: set[str], label: str) -> str:
    """A named effect beside an unlisted one."""
    confirmed, right = set(given.confirmed), {RIGHT_NAMES.get(label, "")}
    if confirmed - truth - right:
        return "wrong name"
    unlisted_found = given.unknown or bool(confirmed & right)
    if truth <= confirmed:
        return "both" if unlisted_found else "unknown missed"
    return "name missed" if unlisted_found else "silent"


def of_alias(given: Said, truth: str) -> str:
    """``set`` if the two that cannot be told apart come as a set of two with about equal weights."""
    family, axis = truth.rsplit("_", 1)
    pair = {f"backlash_{axis}", f"servo_lag_{axis}"}
    names = [*given.confirmed, *given.tentative]
    if len(names) != 1:
        return "silent" if not names else "more names"
    weights = given.sets[names[0]]
    if set(weights) != pair:
        return "other set"
    return "set" if min(weights.values()) > 0.3 else "lopsided"


def of_invisible(given: Said, truth: str) -> str:
    """``listed`` if nothing is said but that the plan cannot see it."""
    if given.confirmed:
        return "right name" if set(given.confirmed) == {truth} else "wrong name"
    if given.tentative or given.unknown:
        return "alarm"
    return "listed" if truth in given.invisible else "silent, not listed"


def outcome(key: dict, diagnosis: dict, family: str | None = None) -> str:
    """Judge one set in a word; ``family`` is the right name of a mismatched effect."""
    given = said(diagnosis)
    names = [effect["name"] for effect in key["effects"]]
    kind = key["kind"]
    if kind == "null":
        return of_null(given)
    if kind in ("single", "double", "triple"):
        return of_named(given, set(names))
    if kind == "mismatch":
        return of_named(given, {family or ""})
    if kind in ("inside", "outside"):
        return of_unlisted(given, names[0])
    if kind == "mixed":
        return of_mixed(given, set(names[:-1]), names[-1])
    if kind == "alias":
        return of_alias(given, names[0])
    if kind == "invisible":
        return of_invisible(given, names[0])
    return "found" if given.first == "axis_mapping" else "missed"


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    if count == 0:
        return 0.0, 1.0
    z2 = NORMAL_95**2
    middle = (hits + z2 / 2) / (count + z2)
    half = NORMAL_95 / (count + z2) * math.sqrt(hits * (count - hits) / count + z2 / 4)
    return max(middle - half, 0.0), min(middle + half, 1.0)
