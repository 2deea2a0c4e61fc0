"""Effects of heat, air and instruments that no catalogue has."""

from __future__ import annotations

import numpy as np
from hidden.change import Change, Hidden, along, of_station, share_of_time, stop_noise
from hidden.session import Session, first_order, telegraph
from hidden.unlisted_machine import MECHANICS


def gradient_twist(session: Session, rng: np.random.Generator) -> Change:
    """The column twists with the gradient, by x and z."""
    gradient = session.temp["column_front"] - session.temp["column_rear"]
    return along(session, 1, gradient * session.s[:, 0] * session.s[:, 2])


def gradient_squared(session: Session, rng: np.random.Generator) -> Change:
    """Buckling: the square of the gradient."""
    gradient = session.temp["column_front"] - session.temp["column_rear"]
    return along(session, 0, (gradient - gradient.mean()) ** 2 * (session.s[:, 2] + 1.0))


def coolant(session: Session, rng: np.random.Generator) -> Change:
    """Coolant goes on and off, which nobody logged."""
    on = telegraph(session.t, float(np.ptp(session.t)) / 12, rng)
    return along(session, 2, on * (1.0 + 0.5 * session.s[:, 0]))


def coolant_soak(session: Session, rng: np.random.Generator) -> Change:
    """The coolant's heat soaks into the scale of Y, slowly."""
    on = telegraph(session.t, float(np.ptp(session.t)) / 8, rng)
    return along(session, 1, first_order(session.t, on, 1500.0) * session.s[:, 1])


def heat_flow(session: Session, rng: np.random.Generator) -> Change:
    """Rate of change of the temperature of X, by y."""
    return along(session, 0, np.gradient(session.temp["x"], session.t) * 1e3 * session.s[:, 1])


def threshold_scale(session: Session, rng: np.random.Generator) -> Change:
    """The scale of X slips in its clamp above some temperature."""
    warm = session.temp["x"]
    return along(session, 0, np.maximum(warm - np.quantile(warm, 0.6), 0.0) * session.s[:, 0] ** 3)


def two_heats(session: Session, rng: np.random.Generator) -> Change:
    """Product of two temperatures."""
    a, b = (session.temp[name] - session.temp[name].mean() for name in ("spindle", "y"))
    return along(session, 2, a * b)


def vibration(session: Session, rng: np.random.Generator) -> Change:
    """A vibration, sampled far too slowly."""
    return along(session, 0, np.sin(2 * np.pi * session.t * rng.uniform(5.0, 20.0)))


def vibration_by_reach(session: Session, rng: np.random.Generator) -> Change:
    """A vibration that grows towards the end of the ram."""
    return along(session, 1, np.sin(2 * np.pi * session.t * rng.uniform(5.0, 20.0)) * (1.0 - session.s[:, 2]))


def draught(session: Session, rng: np.random.Generator) -> Change:
    """The index of air differs from run to run."""
    return Change(reading=session.beams()[1] * stop_noise(session, rng)[session.reading_stop])


def pressure_of_air(session: Session, rng: np.random.Generator) -> Change:
    """A pressure wave of some 40 minutes that nobody logged."""
    wave = np.sin(2 * np.pi * session.t / rng.uniform(2000.0, 4000.0) + rng.uniform(0, 6))
    return Change(reading=session.beams()[1] * wave[session.reading_stop])


def layered_air(session: Session, rng: np.random.Generator) -> Change:
    """Air is warmer up high: range times slope of the beam, by the air's temperature."""
    u, reach = session.beams()
    air = session.temp["ambient"][session.reading_stop] - 18.0
    return Change(reading=air * reach * u[:, 2])


def lagging_air(session: Session, rng: np.random.Generator) -> Change:
    """The beam's air changes before its sensor does."""
    rate = np.gradient(session.temp["ambient"], session.t) * 1e3
    return Change(reading=session.beams()[1] * rate[session.reading_stop])


def warm_head(session: Session, rng: np.random.Generator) -> Change:
    """The head of one tracer wobbles with three lobes, more when warm."""
    u = session.beams()[0]
    warm = (session.temp["ambient"] - session.temp["ambient"].min())[session.reading_stop]
    wave = np.sin(3 * np.arctan2(u[:, 1], u[:, 0])) * warm
    return of_station(session, int(rng.integers(session.plan.stations)), wave)


def rocking_station(session: Session, rng: np.random.Generator) -> Change:
    """A station's stand rocks with the crane's schedule."""
    beat = np.sign(np.sin(2 * np.pi * session.t / rng.uniform(3000.0, 6000.0)))
    side = session.beams()[0] @ np.array([0.8, 0.6, 0.0])
    return of_station(session, int(rng.integers(session.plan.stations)), side * beat[session.reading_stop])


def bent_beam(session: Session, rng: np.random.Generator) -> Change:
    """One tracer's length depends on elevation and range together."""
    u, reach = session.beams()
    return of_station(session, int(rng.integers(session.plan.stations)), reach**2 * u[:, 2] * 1e-6)


def off_centre_target(session: Session, rng: np.random.Generator) -> Change:
    """The retroreflector is not round: third order of the angle to its own axis, turned between set-ups."""
    axes = rng.normal(size=(session.plan.setups, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    c = np.sum(session.beams()[0] * axes[session.setup[session.reading_stop] - 1], axis=1)
    return Change(reading=2.5 * c**3 - 1.5 * c)


def tracking_lag(session: Session, rng: np.random.Generator) -> Change:
    """The beam lags behind a fast target, squared with the speed across it."""
    u, _ = session.beams()
    v = session.velocity[session.reading_stop]
    across = v - u * np.sum(u * v, axis=1)[:, None]
    return Change(reading=np.sum(across**2, axis=1))


def crosswise_range(session: Session, rng: np.random.Generator) -> Change:
    """The target turns towards one tracer, and the others see its flank."""
    u, _ = session.beams()
    leader = session.s[session.reading_stop] @ np.array([0.7, 0.7, 0.1])
    return Change(reading=np.abs(u[:, 0]) * leader**2)


def dirty_optics(session: Session, rng: np.random.Generator) -> Change:
    """A smear on a window: a narrow sector of the azimuth of one tracer."""
    u = session.beams()[0]
    azimuth = np.arctan2(u[:, 1], u[:, 0])
    station = int(rng.integers(session.plan.stations))
    centre = np.median(azimuth[session.reading_station == station])
    return of_station(session, station, np.exp(-(((azimuth - centre) / 0.12) ** 2)))


def mode_hops(session: Session, rng: np.random.Generator) -> Change:
    """The laser hops between two wavelengths."""
    hop = telegraph(session.t, float(np.ptp(session.t)) / 15, rng)
    return Change(reading=session.beams()[1] * hop[session.reading_stop])


def evening_bend(session: Session, rng: np.random.Generator) -> Change:
    """The hall's floor bends towards the evening, by x squared."""
    return along(session, 2, share_of_time(session) ** 3 * session.s[:, 0] ** 2)


HEAT_AND_LIGHT: dict[str, Hidden] = {
    effect.__name__: effect
    for effect in (
        gradient_twist, gradient_squared, coolant, coolant_soak, heat_flow, threshold_scale, two_heats, vibration,
        vibration_by_reach, draught, pressure_of_air, layered_air, lagging_air, warm_head, rocking_station, bent_beam,
        off_centre_target, tracking_lag, crosswise_range, dirty_optics, mode_hops, evening_bend,
    )
}  # fmt: skip

#: Every effect without a name that lies outside smooth generic terms, or at their edge.
UNLISTED: dict[str, Hidden] = MECHANICS | HEAT_AND_LIGHT
