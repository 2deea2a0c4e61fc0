"""Effects that show in the noise of the readings, not in their mean: found by tests of the residuals, no columns."""

from __future__ import annotations

from collections.abc import Sequence

from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES
from compgen.effects.base import Card, Effect, Family
from compgen.effects.readings import Readings


class NoiseClass(Effect):
    """A class of noise; it has a card but no columns."""

    def __init__(self, card: Card) -> None:
        self.card = card

    def columns(self, readings: Readings) -> FloatArray | None:
        """None: there is no mean to fit."""
        return None


def _card(name: str, title: str, equation: str, covariates: tuple[str, ...], breaker: str) -> Card:
    source = "tests of whitened residuals: docs/effects.md"
    return Card(name, title, equation, source, covariates, (), ("every weak effect",), breaker, ("noise",))


def noise_cards() -> list[Card]:
    """Cards of the noise classes."""
    cards = [
        _card(
            "outliers", "Gross errors of single readings", "readings far outside the rest", (), "measure these again"
        ),
        _card(
            "variance_trend",
            "Noise that changes with time, range or position",
            "sigma depends on a covariate",
            ("time_s",),
            "repeat lines at the beginning and at the end",
        ),
        _card(
            "autocorrelated_noise",
            "Noise that is correlated between neighbouring readings",
            "autocorrelated noise (random walk, drift of the air)",
            ("time_s", "repeat"),
            "measure every line at least twice, in random order",
        ),
        _card(
            "quantisation",
            "Coarse resolution of the readings",
            "readings are multiples of a step",
            (),
            "log more decimals",
        ),
        _card(
            "axis_mapping",
            "Swapped axes, signs or stations",
            "columns of the file exchanged or of the other sign",
            (),
            "check the file: residuals are millimetres, not micrometres",
        ),
    ]
    stick_slip = [
        _card(
            f"stick_slip_{letter}",
            f"Stick-slip of {letter}",
            f"d_{letter} jumps by steps of one size at random after reversals",
            (f"approach_{letter.lower()}",),
            "approach every target slowly and fast, several times each",
        )
        for letter in AXES
    ]
    return cards + stick_slip


class ListedEffects(Family):
    """Listed effects without columns: noise classes, and what shows only in the signals of an instrument."""

    def __init__(self, name: str, cards: Sequence[Card]) -> None:
        self.name, self._cards = name, tuple(cards)

    def members(self, stations: object) -> list[Effect]:
        """One effect per card."""
        return [NoiseClass(card) for card in self._cards]
