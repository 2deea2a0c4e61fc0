"""Effects of the machine's mechanics that no catalogue has."""

from __future__ import annotations

import numpy as np
from hidden.change import Change, Hidden, along, first_stop_at, share_of_time, stop_noise
from hidden.session import Session


def play(drive: np.ndarray, width: float) -> np.ndarray:
    """Play operator: the output follows the input once it has pushed through the width, (P,)."""
    out = np.empty(len(drive))
    state = drive[0]
    for k, value in enumerate(drive):
        state = min(max(state, value - width), value + width)
        out[k] = state
    return out


def memory_hysteresis(session: Session, rng: np.random.Generator) -> Change:
    """X remembers its way: several plays of different widths."""
    x = session.s[:, 0]
    return along(session, 0, sum(play(x, w) - x for w in (0.15, 0.4, 0.9)))


def remembered_cross(session: Session, rng: np.random.Generator) -> Change:
    """The way of Y leaves a memory in X."""
    y = session.s[:, 1]
    return along(session, 0, play(y, 0.7) - y)


def direction_by_heat(session: Session, rng: np.random.Generator) -> Change:
    """Friction of X that changes with its temperature acts across, in Z."""
    warm = session.temp["x"] - session.temp["x"].mean()
    return along(session, 2, session.direction[:, 0] * (0.5 + warm) * warm)


def load_history(session: Session, rng: np.random.Generator) -> Change:
    """The bed recovers from earlier loads only slowly."""
    memory = np.zeros(len(session.t))
    for k in range(1, len(memory)):
        share = np.exp(-(session.t[k] - session.t[k - 1]) / 900.0)
        memory[k] = memory[k - 1] * share + (1.0 - share) * session.load[k - 1]
    return along(session, 2, memory)


def table_jump(session: Session, rng: np.random.Generator) -> Change:
    """The workpiece table slips once."""
    first = first_stop_at(session, float(rng.uniform(0.2, 0.8)))
    return Change(tip=np.outer(np.arange(len(session.t)) >= first, rng.normal(size=3)))


def table_tilt(session: Session, rng: np.random.Generator) -> Change:
    """The table tilts a little at some moment."""
    after = np.arange(len(session.t)) >= first_stop_at(session, float(rng.uniform(0.2, 0.8)))
    return Change(tip=np.cross(after[:, None] * rng.normal(size=3), session.q - session.machine.range_mm.mean(axis=1)))


def magnetic_spot(session: Session, rng: np.random.Generator) -> Change:
    """A magnetised spot disturbs the scale of Y."""
    s = (session.s[:, 1] - rng.uniform(-0.6, 0.6)) / 0.08
    return along(session, 1, s / (1.0 + s**2))


def cable_drag(session: Session, rng: np.random.Generator) -> Change:
    """The cable chain pulls harder towards one end, with the direction of travel; acts across."""
    pull = np.exp(1.5 * session.s[:, 0]) * (session.direction[:, 0] + 0.3)
    return along(session, 1, pull)


def pressure_wave(session: Session, rng: np.random.Generator) -> Change:
    """Waves in the weight compensation, one way up and another way down."""
    wave = np.sin(2.0 * np.pi * session.s[:, 2] * 1.3 + session.direction[:, 2] * 0.9)
    return along(session, 2, wave)


def preload_steps(session: Session, rng: np.random.Generator) -> Change:
    """A bearing changes its seat once the spindle is warm enough."""
    warm = session.temp["spindle"]
    return along(session, 0, (warm > np.quantile(warm, rng.uniform(0.3, 0.7))) * session.s[:, 2])


def windup(session: Session, rng: np.random.Generator) -> Change:
    """The screw of X winds up under load, more so far from its bearing."""
    return along(session, 0, session.direction[:, 0] * session.load * (1.0 + session.s[:, 0]))


def clamping(session: Session, rng: np.random.Generator) -> Change:
    """The pallet seats a little differently for every run."""
    return along(session, 0, stop_noise(session, rng))


def random_yaw(session: Session, rng: np.random.Generator) -> Change:
    """The cross slide yaws by another angle in every run."""
    return along(session, 1, stop_noise(session, rng) * session.s[:, 0])


def speed_squared(session: Session, rng: np.random.Generator) -> Change:
    """Accelerations tilt the column with the square of the speed of Y."""
    return along(session, 2, session.velocity[:, 1] ** 2 / 1e3)


def crossed_speed(session: Session, rng: np.random.Generator) -> Change:
    """Coupling of two drives."""
    return along(session, 0, session.velocity[:, 1] * session.s[:, 2])


def both_directions(session: Session, rng: np.random.Generator) -> Change:
    """Friction of two axes acts only together."""
    return along(session, 1, session.direction[:, 0] * session.direction[:, 2])


def side_of_guide(session: Session, rng: np.random.Generator) -> Change:
    """A joint in the guide way of Y that tips over on the way forth and not on the way back."""
    beyond = session.s[:, 1] > rng.uniform(-0.4, 0.4)
    return along(session, 2, beyond * (session.direction[:, 1] > 0) * 1.0)


def worn_zone(session: Session, rng: np.random.Generator) -> Change:
    """A worn part of the rack."""
    return along(session, 0, (np.abs(session.s[:, 0] - rng.uniform(-0.4, 0.4)) < 0.2) * 1.0)


def latched_tilt(session: Session, rng: np.random.Generator) -> Change:
    """The bridge tips to the side of the last long way of X and stays there."""
    state, sign = np.zeros(len(session.t)), 1.0
    for k in range(1, len(state)):
        moved = session.s[k, 0] - session.s[k - 1, 0]
        sign = np.sign(moved) if abs(moved) > 1.0 else sign
        state[k] = sign
    return along(session, 0, state * (session.s[:, 2] + 1.0))


def counterweight(session: Session, rng: np.random.Generator) -> Change:
    """A swing that dies away within a run."""
    return along(session, 0, np.exp(-session.k / 1.5) * np.cos(2.0 * session.k) * session.velocity[:, 0])


def alternating_clamp(session: Session, rng: np.random.Generator) -> Change:
    """A brake engages in every other run."""
    return along(session, 1, (session.run % 2) * (1.0 + session.s[:, 2]))


def warm_up(session: Session, rng: np.random.Generator) -> Change:
    """The head leans until the machine is warm, anew in each set-up."""
    begin = np.array([session.t[session.setup == number].min() for number in session.setup])
    return along(session, 1, np.exp(-(session.t - begin) / 2400.0) * session.s[:, 2])


def creep(session: Session, rng: np.random.Generator) -> Change:
    """The foundation settles after the crane has been there."""
    since = share_of_time(session) - rng.uniform(0.2, 0.6)
    return along(session, 2, np.where(since > 0, 1.0 - np.exp(-np.maximum(since, 0) / 0.1), 0.0) * session.s[:, 1])


MECHANICS: dict[str, Hidden] = {
    effect.__name__: effect
    for effect in (
        memory_hysteresis, remembered_cross, direction_by_heat, load_history, table_jump, table_tilt, magnetic_spot,
        cable_drag, pressure_wave, preload_steps, windup, clamping, random_yaw, speed_squared, crossed_speed,
        both_directions, side_of_guide, worn_zone, latched_tilt, counterweight, alternating_clamp, warm_up, creep,
    )
}  # fmt: skip
