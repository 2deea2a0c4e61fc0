"""Hidden sets: a kind and a seed give a machine, a session, its lengths and the key.

Kinds: ``null``, ``single``, ``double``, ``triple``, ``inside``, ``outside``, ``mixed`` (a named effect and one from
outside), ``alias``, ``invisible``, ``mismatch``, ``gross`` (two axes swapped). Everything else is drawn.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from hidden.change import Change, Hidden
from hidden.inside import INSIDE
from hidden.kinematics import HiddenMachine, Truth, random_truth, tip
from hidden.mismatched import mismatched
from hidden.named import named
from hidden.noise import FAMILIES, noise_um
from hidden.session import Plan, Session, draw_session
from hidden.unlisted_rest import UNLISTED
from hidden.visible import base_space, centred, rms, visible_part
from hidden.write import lengths_text, machine_text

KINDS = (
    "null", "single", "double", "triple", "inside", "outside", "mixed", "alias", "invisible", "mismatch", "gross",
)  # fmt: skip
CHAINS = ("WFYXZT", "WXFYZT", "WXYFZT", "WYFXZT", "WFXYZT", "WYXFZT")
STATION_NAMES = (("LT1", "LT2", "LT3", "LT4"), ("1", "2", "3", "4"), ("north", "east", "south", "west"))
#: Least visible size, in sigma, of an effect that is to be found.
LEAST_VISIBLE = 0.1
#: Least visible share of an effect that is drawn as one to be found.
LEAST_SHARE = 0.05


@dataclass(frozen=True)
class Options:
    """What is asked of a set; ``None`` leaves it to chance.

    ``size``: RMS of each effect in the readings over sigma. ``plan``: ``"standard"``, or a name of ``VARIANTS``.
    """

    family: str | None = None
    size: float | None = None
    effects: tuple[str, ...] = ()
    plan: str = "standard"
    chain: str | None = None
    lines: int | None = None


@dataclass(frozen=True)
class Case:
    """A hidden set: what a user has (``machine``, ``lengths``: text of the files), and what is true."""

    machine: str
    lengths: str
    key: dict
    session: Session
    effect_um: np.ndarray
    noise_um: np.ndarray


#: Changes of the plan by name.
VARIANTS: dict[str, dict] = {
    "standard": {},
    "natural": {"approach": "natural"},
    "in_turn": {"in_turn": True, "lines": 18},
    "no_repeats": {"repeats": 1, "lines": 40},
    "fewer_lines": {"lines": 15},
    "three_stations": {"stations": 3},
    "thrice": {"repeats": 3, "lines": 16},
    "one_load": {"loads_kg": (250.0,), "lines": 40},
    "one_feed": {"feeds_mm_min": (2000.0,)},
    "one_tool": {"setups": 1, "lines": 40},
    "axis_one_feed": {"axis_only": True, "feeds_mm_min": (2000.0,), "approach": "unknown"},
    "slanted_one_feed": {"slanted": True, "feeds_mm_min": (2000.0,), "lines": 28},
    "on_pitch": {"on_pitch": True},
}
#: Variants with which named effects are drawn now and then.
OTHER_PLANS = ("natural", "in_turn", "no_repeats", "fewer_lines", "three_stations", "thrice")


#: Effects that nobody can see, and the plan with which that is so.
UNSEEN = (
    {"load_deflection": "one_load", "laser_scale": "one_tool"}
    | {f"cosine_error_{a}": "standard" for a in "XYZ"}
    | {f"periodic_{a}": "on_pitch" for a in "XYZ"}
    | {f"lever_{error}": "one_tool" for error in ("ECX", "EAZ", "EBZ", "ECZ")}
)


def draw_machine(rng: np.random.Generator, chain: str | None) -> HiddenMachine:
    """A machine of random travel."""
    size = np.round(rng.uniform([500.0, 500.0, 300.0], [1400.0, 1800.0, 700.0]), -1)
    low = -np.round(size * rng.choice([0.0, 0.5, 1.0], 3), -1)
    pitch = rng.choice([5.0, 10.0, 12.0, 16.0, 20.0, 25.0], 3)
    name = f"m{int(rng.integers(1000, 9999))}"
    return HiddenMachine(name, chain or "WFYXZT", np.column_stack([low, low + size]), pitch)


def length_mm(
    session: Session, truth: Truth, tip_um: np.ndarray, reading_um: np.ndarray, dead: np.ndarray
) -> np.ndarray:
    """Readings of the interferometers, (n,): distance of the displaced tip less the dead length, plus what is added."""
    place = tip(session.machine, truth, session.q, session.tool) + tip_um * 1e-3
    stop, station = session.reading_stop, session.reading_station
    distance = np.linalg.norm(place[stop] - session.station_mm[station], axis=1)
    return distance - dead[station, session.setup[stop] - 1] + reading_um * 1e-3


def draw_effects(
    session: Session, kind: str, names: Sequence[str], rng: np.random.Generator
) -> list[tuple[str, Hidden]]:
    """Labels and functions of the hidden effects of a set."""
    have = named(session)
    special = {"alias": ["backlash", "servo_lag"], "mismatch": list(mismatched(session))}
    if kind == "alias":
        family = str(rng.choice(special["alias"]))
        names = names or (f"{family}_{rng.choice(list('XYZ'))}",)
    if kind == "mismatch":
        name = names[0] if names else str(rng.choice(special["mismatch"]))
        return [(name, mismatched(session)[name][1])]
    if kind in ("inside", "outside", "mixed"):
        table = {k: v[0] for k, v in INSIDE.items()} if kind == "inside" else dict(UNLISTED)
        own = [name for name in names if name in table]
        name = own[0] if own else str(rng.choice(list(table)))
        others = [n for n in names if n in have] if kind == "mixed" else []
        if kind == "mixed" and not others:
            others = [str(rng.choice(candidates(session)))]
        return [(n, have[n]) for n in others] + [(name, table[name])]
    count = {"single": 1, "double": 2, "triple": 3}.get(kind, 0)
    drawn = names or tuple(str(n) for n in rng.choice(candidates(session), count, replace=False))
    return [(name, have[name]) for name in drawn]


def candidates(session: Session) -> list[str]:
    """Names that a session of this plan can be expected to show."""
    plan, hidden = session.plan, {"laser_scale"}
    found = []
    for name in named(session):
        lost = name in hidden or name.startswith("cosine_error")
        lost |= name.startswith("lever_") and plan.setups < 2
        lost |= name == "tool_offset_error" and plan.setups < 2
        lost |= name == "load_deflection" and len(plan.loads_kg) < 2
        lost |= name.startswith("periodic") and plan.on_pitch
        lost |= plan.in_turn and name.startswith("station_drift")
        if not lost:
            found.append(name)
    return found


def make(kind: str, seed: int, options: Options = Options()) -> Case:  # noqa: B008 - frozen
    """Return the hidden set of a kind and a seed."""
    rng = np.random.default_rng([seed, zlib.crc32(kind.encode())])
    family = options.family or str(rng.choice(FAMILIES))
    plan_name, names = options.plan, options.effects
    if kind == "alias":
        plan_name = str(rng.choice(["axis_one_feed", "slanted_one_feed"]))
    if kind == "invisible":
        names = names or (str(rng.choice(list(UNSEEN))),)
        plan_name = UNSEEN[names[0]]
    changes = VARIANTS[plan_name] | ({"lines": options.lines} if options.lines else {})
    machine = draw_machine(rng, options.chain)
    session = draw_session(machine, Plan(**changes), STATION_NAMES[int(rng.integers(3))], rng)
    sigma_um = float(rng.uniform(0.2, 1.0))
    added, facts = draw_changes(session, kind, names, options.size, sigma_um, rng)
    noise = noise_um(session, family, sigma_um, rng)
    key = {"kind": kind, "seed": seed, "family": family, "plan": plan_name, "chain": machine.chain}
    key |= {"sigma_um": sigma_um, "noise_rms_um": rms(noise), "effects": facts}
    return assemble(session, added, noise, key, rng)


def draw_changes(
    session: Session, kind: str, names: Sequence[str], size: float | None, sigma_um: float, rng: np.random.Generator
) -> tuple[list[Change], list[dict]]:
    """Effects in um, and the facts about each."""
    changes, facts = [], []
    effects = draw_effects(session, kind, names, rng) if kind not in ("null", "gross") else []
    space = base_space(session) if effects else np.zeros((len(session.reading_stop), 0))
    taken: list[str] = []
    for label, effect in effects:
        change = effect(session, rng)
        name = label
        if kind in ("single", "double", "triple", "mixed") and label in named(session) and not names:
            name, change = enough_visible(session, space, label, change, taken, rng)
        taken.append(name)
        raw = change.readings(session)
        share = rms(visible_part(space, raw)) / max(rms(centred(session, raw)), 1e-12)
        wanted = size or drawn_size(kind, share, rng)
        change = change.scaled(wanted * sigma_um / rms(centred(session, raw)) * float(rng.choice([-1, 1])))
        changes.append(change)
        facts.append({"name": name, "size": wanted, "visible": wanted * share, "visible_fraction": share})
    return changes, facts


def enough_visible(
    session: Session, space: np.ndarray, name: str, change: Change, taken: Sequence[str], rng: np.random.Generator
) -> tuple[str, Change]:
    """The effect, or another one if the plan hardly shows this one."""
    for _ in range(50):
        raw = change.readings(session)
        if name not in taken and rms(visible_part(space, raw)) >= LEAST_SHARE * rms(centred(session, raw)):
            return name, change
        name = str(rng.choice(candidates(session)))
        change = named(session)[name](session, rng)
    raise ValueError("the plan shows none of the effects")


def drawn_size(kind: str, share: float, rng: np.random.Generator) -> float:
    """RMS over sigma: 0.3 ... 3 log-uniform, 0.5 ... 3 for several; at least visible by ``LEAST_VISIBLE``."""
    low = 0.3 if kind in ("single", "mismatch") else 0.5
    size = float(np.exp(rng.uniform(np.log(low), np.log(3.0))))
    if kind == "invisible":
        return 1.0 + size
    return max(size, LEAST_VISIBLE / share) if kind in ("single", "double", "triple", "mixed") else size


def assemble(
    session: Session, changes: Sequence[Change], noise: np.ndarray, key: dict, rng: np.random.Generator
) -> Case:
    """Put truth, effects and noise together and write both files as text."""
    degree = int(rng.integers(6, 8))
    truth = random_truth(session.machine, rng, degree)
    tip_um = np.zeros((len(session.t), 3))
    reading_um = noise.copy()
    for change in changes:
        tip_um += 0.0 if change.tip is None else change.tip
        reading_um += 0.0 if change.reading is None else change.reading
    dead = rng.uniform(50.0, 400.0, (session.plan.stations, session.plan.setups))
    lengths = length_mm(session, truth, tip_um, reading_um, dead)
    written = session
    if key["kind"] == "gross":
        key["effects"] = [{"name": "axis_mapping"}]
        written = replace(session, q=session.q[:, [1, 0, 2]])
    effect = sum((change.readings(session) for change in changes), np.zeros(len(noise)))
    key["degree"] = degree
    return Case(machine_text(session.machine), lengths_text(written, lengths, rng), key, session, effect, noise)
