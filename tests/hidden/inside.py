"""Effects without a name that a generic tier of smooth terms should be able to express."""

from __future__ import annotations

import numpy as np
from hidden.change import Change, Hidden, along, of_station, share_of_time
from hidden.session import Session


def bump_x(session: Session, rng: np.random.Generator) -> Change:
    """A narrow hill in X."""
    return along(session, 1, np.exp(-(((session.s[:, 0] - rng.uniform(-0.6, 0.6)) / 0.15) ** 2)))


def joint_xz(session: Session, rng: np.random.Generator) -> Change:
    """dY by x and z jointly."""
    return along(session, 1, session.s[:, 0] ** 2 * session.s[:, 2] + 0.5 * session.s[:, 0] * session.s[:, 2] ** 2)


def joint_yz(session: Session, rng: np.random.Generator) -> Change:
    """dX by y and z jointly."""
    return along(session, 0, session.s[:, 1] * session.s[:, 2] ** 2)


def time_dx(session: Session, rng: np.random.Generator) -> Change:
    """dX that wanders smoothly over the day."""
    return along(session, 0, np.sin(2 * np.pi * share_of_time(session) * rng.uniform(0.8, 1.6) + rng.uniform(0, 6)))


def time_by_x(session: Session, rng: np.random.Generator) -> Change:
    """dZ by x, growing with time."""
    return along(session, 2, session.s[:, 0] * share_of_time(session))


def reversal_of_other(session: Session, rng: np.random.Generator) -> Change:
    """dY by the direction of X times x."""
    return along(session, 1, session.direction[:, 0] * (0.4 + session.s[:, 0]))


def station_wave(session: Session, rng: np.random.Generator) -> Change:
    """One station's length goes up and down over the day."""
    wave = np.sin(2 * np.pi * share_of_time(session) * 1.5 + rng.uniform(0, 6))
    return of_station(session, int(rng.integers(session.plan.stations)), wave[session.reading_stop])


def range_squared(session: Session, rng: np.random.Generator) -> Change:
    """Lengths by the square of the range, at one station."""
    reach = session.beams()[1]
    return of_station(session, int(rng.integers(session.plan.stations)), (reach / reach.max()) ** 3)


def range_by_time(session: Session, rng: np.random.Generator) -> Change:
    """The scale of the laser drifts."""
    return Change(reading=session.beams()[1] * share_of_time(session)[session.reading_stop])


def angle_harmonic(session: Session, rng: np.random.Generator) -> Change:
    """Fifth harmonic of the azimuth at one station."""
    u = session.beams()[0]
    wave = np.sin(5 * np.arctan2(u[:, 1], u[:, 0]) + rng.uniform(0, 6))
    return of_station(session, int(rng.integers(session.plan.stations)), wave)


def load_by_x(session: Session, rng: np.random.Generator) -> Change:
    """dX by load and x."""
    return along(session, 0, session.load * session.s[:, 0])


def warm_by_y(session: Session, rng: np.random.Generator) -> Change:
    """dZ by the spindle's temperature and y."""
    return along(session, 2, (session.temp["spindle"] - 20.0) * session.s[:, 1])


INSIDE: dict[str, tuple[Hidden, tuple[str, ...]]] = {
    "bump_x": (bump_x, ("x",)),
    "joint_xz": (joint_xz, ("x", "z")),
    "joint_yz": (joint_yz, ("y", "z")),
    "time_dx": (time_dx, ("time",)),
    "time_by_x": (time_by_x, ("time", "x")),
    "reversal_of_other": (reversal_of_other, ("direction",)),
    "station_wave": (station_wave, ("time", "station")),
    "range_squared": (range_squared, ("range", "station")),
    "range_by_time": (range_by_time, ("range", "time")),
    "angle_harmonic": (angle_harmonic, ("angle", "station")),
    "load_by_x": (load_by_x, ("load", "x")),
    "warm_by_y": (warm_by_y, ("temp_spindle", "y")),
}
