"""Effects that have a name, written from their equations (section 2 of the survey): forward only, nothing is fitted.

``named(session)`` maps each name to a function that draws the effect's coefficients and returns what it does.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from hidden.change import Change, Hidden, along, first_stop_at, of_station, p2, share_of_time
from hidden.kinematics import without_lever
from hidden.session import Session

AXES = "XYZ"


def thermal_scale(axis: int) -> Hidden:
    """d_a = c p_a (T_a - mean)."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        warm = session.temp["xyz"[axis]]
        return along(session, axis, session.q[:, axis] * (warm - warm.mean()))

    return effect


def spindle_growth(axis: int) -> Hidden:
    """d_a = c T_spindle."""
    return lambda session, rng: along(session, axis, session.temp["spindle"] - 20.0)


def column_bending(session: Session, rng: np.random.Generator) -> Change:
    """d_Y = c (T_front - T_rear) (z - z0)^2, z0 at the lower end of the travel."""
    gradient = session.temp["column_front"] - session.temp["column_rear"]
    return along(session, 1, gradient * (session.q[:, 2] - session.machine.range_mm[2, 0]) ** 2)


def backlash(axis: int) -> Hidden:
    """d_a = c dir_a."""
    return lambda session, rng: along(session, axis, session.direction[:, axis])


def lost_motion(axis: int) -> Hidden:
    """d_a = dir_a (c1 P1 + c2 P2)."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        s, c = session.s[:, axis], rng.normal(size=2)
        return along(session, axis, session.direction[:, axis] * (c[0] * s + c[1] * p2(s)))

    return effect


def periodic(axis: int) -> Hidden:
    """Fundamental and second harmonic of the pitch."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        phase = 2.0 * np.pi * session.q[:, axis] / session.machine.pitch_mm[axis]
        start, second = rng.uniform(0, 2 * np.pi, 2), rng.uniform(0.0, 0.6)
        return along(session, axis, np.sin(phase + start[0]) + second * np.sin(2.0 * phase + start[1]))

    return effect


def servo_lag(axis: int) -> Hidden:
    """d_a = tau v_a."""
    return lambda session, rng: along(session, axis, session.velocity[:, axis])


def lever_arm(error: str) -> Hidden:
    """Rotation about one axis, a smooth function of another, acting on the tool offset."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        s = session.s[:, AXES.index(error[2])]
        turn = np.polynomial.legendre.legval(s, rng.normal(size=4) / np.array([1.0, 1.0, 1.5, 2.0]))
        return Change(tip=turn[:, None] * np.cross(np.eye(3)["ABC".index(error[1])], session.tool))

    return effect


def beam_sag(session: Session, rng: np.random.Generator) -> Change:
    """d_Z = sum c_ij P_i(x) P_j(y), i and j 1, 2."""
    x, y = session.s[:, 0], session.s[:, 1]
    c = rng.normal(size=(2, 2))
    return along(session, 2, sum(c[i, j] * (x, p2(x))[i] * (y, p2(y))[j] for i in range(2) for j in range(2)))


def ram_droop(session: Session, rng: np.random.Generator) -> Change:
    """d_Y = P2(z) (c1 P1(y) + c2 P2(y))."""
    y, c = session.s[:, 1], rng.normal(size=2)
    return along(session, 1, p2(session.s[:, 2]) * (c[0] * y + c[1] * p2(y)))


def load_deflection(session: Session, rng: np.random.Generator) -> Change:
    """d_Z = m (c0 + c1 P2(x) + c2 P2(y))."""
    c = rng.normal(size=3)
    return along(session, 2, session.load * (c[0] + c[1] * p2(session.s[:, 0]) + c[2] * p2(session.s[:, 1])))


def air_warming(session: Session) -> np.ndarray:
    """Air temperature less its mean, for every reading, (n,)."""
    return (session.temp["ambient"] - session.temp["ambient"].mean())[session.reading_stop]


def refractive_index(session: Session, rng: np.random.Generator) -> Change:
    """dl = c l T_air."""
    return Change(reading=session.beams()[1] * air_warming(session))


def dead_path(session: Session, rng: np.random.Generator) -> Change:
    """dl = c_i T_air, one coefficient for each station."""
    return Change(reading=rng.normal(size=session.plan.stations)[session.reading_station] * air_warming(session))


def laser_scale(session: Session, rng: np.random.Generator) -> Change:
    """dl = c l."""
    return Change(reading=session.beams()[1])


def station_drift(station: int) -> Hidden:
    """dl = -u . v (t - t0)."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        speed = rng.normal(size=3)
        moved = session.beams()[0] @ (speed / np.linalg.norm(speed)) * share_of_time(session)[session.reading_stop]
        return of_station(session, station, -moved)

    return effect


def length_step(station: int) -> Hidden:
    """dl = c from some run on."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        seen = session.reading_stop[session.reading_station == station]
        first = first_stop_at(session, 0.0)
        for _ in range(100):
            first = first_stop_at(session, rng.uniform(0.0, 1.0))
            if 0.15 < np.mean(seen >= first) < 0.85:
                break
        return of_station(session, station, (session.reading_stop >= first) * 1.0)

    return effect


def tracer_runout(station: int) -> Hidden:
    """Harmonics 2 and 3 of the azimuth of the beam."""

    def effect(session: Session, rng: np.random.Generator) -> Change:
        u = session.beams()[0]
        azimuth, c = np.arctan2(u[:, 1], u[:, 0]), rng.normal(size=4)
        wave = c[0] * np.cos(2 * azimuth) + c[1] * np.sin(2 * azimuth)
        return of_station(session, station, wave + c[2] * np.cos(3 * azimuth) + c[3] * np.sin(3 * azimuth))

    return effect


def target_angle(session: Session, rng: np.random.Generator) -> Change:
    """dl = c1 u_z^2 + c2 u_z^3."""
    u, c = session.beams()[0][:, 2], rng.normal(size=2)
    return Change(reading=c[0] * u**2 + c[1] * u**3)


def tool_offset_error(session: Session, rng: np.random.Generator) -> Change:
    """A constant vector in the second set-up."""
    return Change(tip=np.outer(session.setup == 2, rng.normal(size=3)))


def sign_eby(session: Session, rng: np.random.Generator) -> Change:
    """d_Z = x f(y): EBY acts on Z with the wrong sign."""
    c = rng.normal(size=4) / np.array([1.0, 1.0, 1.5, 2.0])
    return along(session, 2, session.q[:, 0] * np.polynomial.legendre.legval(session.s[:, 1], np.r_[0.0, c]))


def cosine_error(axis: int) -> Hidden:
    """d_a = -p theta^2 / 2."""
    return lambda session, rng: along(session, axis, -session.q[:, axis])


def named(session: Session) -> Mapping[str, Hidden]:
    """Every named effect of a session."""
    found: dict[str, Hidden] = {}
    families = {
        "thermal_scale": thermal_scale,
        "spindle_growth": spindle_growth,
        "backlash": backlash,
        "lost_motion": lost_motion,
        "periodic": periodic,
        "servo_lag": servo_lag,
        "cosine_error": cosine_error,
    }
    for family, make in families.items():
        found |= {f"{family}_{AXES[axis]}": make(axis) for axis in range(3)}
    found |= {f"lever_{error}": lever_arm(error) for error in without_lever(session.machine)}
    if session.machine.chain == "WFYXZT":
        found["sign_EBY"] = sign_eby
    for k, name in enumerate(session.station_names):
        found[f"station_drift_{name}"] = station_drift(k)
        found[f"length_step_{name}"] = length_step(k)
        found[f"tracer_runout_{name}"] = tracer_runout(k)
    return found | {
        "column_bending": column_bending,
        "beam_sag": beam_sag,
        "ram_droop": ram_droop,
        "load_deflection": load_deflection,
        "refractive_index": refractive_index,
        "dead_path": dead_path,
        "laser_scale": laser_scale,
        "target_angle": target_angle,
        "tool_offset_error": tool_offset_error,
    }
