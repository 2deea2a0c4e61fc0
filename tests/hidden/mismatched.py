"""Effects of the named families whose law is not quite that of any catalogue."""

from __future__ import annotations

import numpy as np
from hidden.change import Change, along, first_stop_at, of_station, p2, share_of_time
from hidden.session import Session, first_order

AXES = "XYZ"


def lagging_growth(session: Session, rng: np.random.Generator) -> Change:
    """Spindle growth that follows its sensor with a lag of some minutes."""
    return along(session, 2, first_order(session.t, session.temp["spindle"] - 20.0, float(rng.uniform(200, 700))))


def lagging_scale(session: Session, rng: np.random.Generator) -> Change:
    """Expansion of X that follows its sensor with a lag."""
    warm = first_order(session.t, session.temp["x"] - session.temp["x"][0], float(rng.uniform(200, 700)))
    return along(session, 0, session.q[:, 0] * (warm - warm.mean()))


def wrong_pitch(session: Session, rng: np.random.Generator) -> Change:
    """Periodic error of Y with a pitch that is off by 0.03 %."""
    return along(session, 1, np.sin(2 * np.pi * session.q[:, 1] / (session.machine.pitch_mm[1] * 1.0003) + 1.0))


def uneven_expansion(session: Session, rng: np.random.Generator) -> Change:
    """Expansion of Y that is not the same along the scale."""
    s, warm = session.s[:, 1], session.temp["y"] - session.temp["y"].mean()
    return along(session, 1, warm * (session.q[:, 1] + 0.08 * np.ptp(session.machine.range_mm[1]) * p2(s)))


def saturating_lag(session: Session, rng: np.random.Generator) -> Change:
    """Lag of X that saturates with speed."""
    return along(session, 0, np.tanh(session.velocity[:, 0] / 90.0))


def soft_backlash(session: Session, rng: np.random.Generator) -> Change:
    """Backlash of Y that is not taken up fully at the first stop of a run."""
    return along(session, 1, session.direction[:, 1] * np.where(session.k == 0, 0.75, 1.0))


def cubic_lost_motion(session: Session, rng: np.random.Generator) -> Change:
    """Lost motion of X with a third order in position."""
    s = session.s[:, 0]
    return along(session, 0, session.direction[:, 0] * (s + 0.25 * (2.5 * s**3 - 1.5 * s)))


def bowed_growth(session: Session, rng: np.random.Generator) -> Change:
    """Spindle growth of X, not quite linear in temperature."""
    warm = session.temp["spindle"] - 20.0
    return along(session, 0, warm + 0.015 * warm**2)


def slow_step(session: Session, rng: np.random.Generator) -> Change:
    """A step of one station's length that takes four runs."""
    first = first_stop_at(session, float(rng.uniform(0.2, 0.8)))
    ramp = np.clip((session.reading_stop - first) / (4 * session.plan.points), 0.0, 1.0)
    return of_station(session, 1, ramp)


def settling_station(session: Session, rng: np.random.Generator) -> Change:
    """A station that drifts fast at first and slower later."""
    moved = session.beams()[0] @ np.array([0.6, -0.5, 0.62])
    return of_station(session, 2, -moved * -np.expm1(-2.0 * share_of_time(session)[session.reading_stop]))


def skewed_load(session: Session, rng: np.random.Generator) -> Change:
    """Deflection under load that is not quite even in X."""
    x, y = session.s[:, 0], session.s[:, 1]
    return along(session, 2, session.load * (1.0 + 0.6 * p2(x) + 0.4 * p2(y) + 0.1 * x))


def tilted_bending(session: Session, rng: np.random.Generator) -> Change:
    """Bending of the column with another exponent."""
    gradient = session.temp["column_front"] - session.temp["column_rear"]
    height = (session.q[:, 2] - session.machine.range_mm[2, 0]) / np.ptp(session.machine.range_mm[2])
    return along(session, 1, gradient * height**2.3)


def mismatched(session: Session) -> dict[str, tuple[str, object]]:
    """Kind -> (name of the family that is right, function)."""
    names = session.station_names
    return {
        "lagging_growth": ("spindle_growth_Z", lagging_growth),
        "lagging_scale": ("thermal_scale_X", lagging_scale),
        "wrong_pitch": ("periodic_Y", wrong_pitch),
        "uneven_expansion": ("thermal_scale_Y", uneven_expansion),
        "saturating_lag": ("servo_lag_X", saturating_lag),
        "soft_backlash": ("backlash_Y", soft_backlash),
        "cubic_lost_motion": ("lost_motion_X", cubic_lost_motion),
        "bowed_growth": ("spindle_growth_X", bowed_growth),
        "slow_step": (f"length_step_{names[1]}", slow_step),
        "settling_station": (f"station_drift_{names[2]}", settling_station),
        "skewed_load": ("load_deflection", skewed_load),
        "tilted_bending": ("column_bending", tilted_bending),
    }
