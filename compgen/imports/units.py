"""Units of what stands beside the readings: temperatures, times, feeds, masses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

Quantity = Literal["temperature", "time", "feed", "load"]
#: degC = factor * value + offset.
CELSIUS: Mapping[str, tuple[float, float]] = {
    "degC": (1.0, 0.0),
    "K": (1.0, -273.15),
    "degF": (5.0 / 9.0, -160.0 / 9.0),
}
S_PER_TIME = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
MM_MIN_PER_FEED = {"mm/min": 1.0, "m/min": 1e3, "mm/s": 60.0, "m/s": 6e4, "in/min": 25.4}
KG_PER_MASS = {"kg": 1.0, "g": 1e-3, "t": 1e3, "lb": 0.45359237}
_BY_QUANTITY: Mapping[Quantity, tuple[str, ...]] = {
    "temperature": tuple(CELSIUS),
    "time": tuple(S_PER_TIME),
    "feed": tuple(MM_MIN_PER_FEED),
    "load": tuple(KG_PER_MASS),
}
_WORDS = {
    "c": "degC",
    "\u00b0c": "degC",
    "\u00bac": "degC",
    "\u2103": "degC",
    "degc": "degC",
    "celsius": "degC",
    "gradc": "degC",
    "gradcelsius": "degC",
    "degreescelsius": "degC",
    "degreesc": "degC",
    "k": "K",
    "kelvin": "K",
    "\u00b0k": "K",
    "f": "degF",
    "\u00b0f": "degF",
    "\u2109": "degF",
    "degf": "degF",
    "fahrenheit": "degF",
    "sec": "s",
    "secs": "s",
    "second": "s",
    "seconds": "s",
    "sek": "s",
    "sekunden": "s",
    "msec": "ms",
    "minutes": "min",
    "minuten": "min",
    "hours": "h",
    "hour": "h",
    "std": "h",
    "stunden": "h",
    "mmpm": "mm/min",
    "mm/minute": "mm/min",
    "inch/min": "in/min",
    "ipm": "in/min",
    "lbs": "lb",
    "tonnes": "t",
}


def further_unit(text: str, quantity: Quantity | None = None) -> str | None:
    """Return the name of such a unit as it is used here, of one quantity if that is given; None if it is none.

    >>> further_unit("°C"), further_unit("Kelvin"), further_unit("m/min"), further_unit("um"), further_unit("s", "load")
    ('degC', 'K', 'm/min', None, None)
    """
    word = text.strip().lower().replace("\u00c2", "").replace(" ", "").replace(".", "")
    allowed = [unit for name, units in _BY_QUANTITY.items() if quantity in (None, name) for unit in units]
    unit = _WORDS.get(word, word)
    return unit if unit in allowed else None


def units_of(quantity: Quantity) -> tuple[str, ...]:
    """Return the units that are known for a quantity."""
    return _BY_QUANTITY[quantity]
