"""Noise families: white noise of a tracer, and what comes on top of it over the hours of a session."""

from __future__ import annotations

import numpy as np
from hidden.session import Session

FAMILIES = ("white", "ar1", "random_walk", "one_over_f", "common", "range")


def ar1(count: int, phi: float, rng: np.random.Generator) -> np.ndarray:
    """Stationary AR(1) of unit variance, (count,)."""
    out = np.empty(count)
    out[0] = rng.normal()
    drive = rng.normal(size=count) * np.sqrt(1.0 - phi**2)
    for k in range(1, count):
        out[k] = phi * out[k - 1] + drive[k]
    return out


def random_walk(count: int, rng: np.random.Generator) -> np.ndarray:
    """Random walk whose end has unit variance, (count,)."""
    return np.cumsum(rng.normal(size=count)) / np.sqrt(count)


def one_over_f(count: int, rng: np.random.Generator) -> np.ndarray:
    """Noise of density 1/f with unit RMS, (count,)."""
    spectrum = rng.normal(size=count // 2 + 1) + 1j * rng.normal(size=count // 2 + 1)
    spectrum[0] = 0.0
    spectrum[1:] /= np.sqrt(np.arange(1, len(spectrum)))
    out = np.fft.irfft(spectrum, count)
    return out / out.std()


def slow_part(family: str, count: int, size: float, phi: float, rng: np.random.Generator) -> np.ndarray:
    """One realisation of a slow family; ``size`` 0.5 ... 1.5 is its RMS over sigma (a walk ends at twice that)."""
    if family == "random_walk":
        return 2.0 * size * random_walk(count, rng)
    if family == "one_over_f":
        return size * one_over_f(count, rng)
    return size * ar1(count, phi, rng)


def noise_um(session: Session, family: str, sigma_um: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of every reading, (n,), um."""
    stop, station = session.reading_stop, session.reading_station
    white = rng.normal(size=len(stop))
    count, size, phi = len(session.t), float(rng.uniform(0.5, 1.5)), float(rng.uniform(0.8, 0.99))
    if family == "white":
        return sigma_um * white
    if family == "range":
        reach = session.beams()[1]
        share = rng.uniform(0.3, 0.7)
        level = np.sqrt((1.0 - share) + share * (reach / reach.mean()) ** 2 * rng.uniform(1.0, 2.0))
        return sigma_um * level * white
    if family == "common":
        kind = str(rng.choice(["ar1", "random_walk"]))
        return sigma_um * (white + slow_part(kind, count, size, phi, rng)[stop])
    slow = np.column_stack([slow_part(family, count, size, phi, rng) for _ in range(session.plan.stations)])
    return sigma_um * (white + slow[stop, station])
