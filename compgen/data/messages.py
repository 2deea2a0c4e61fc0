"""Helpers for messages and for text from users."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Hashable, Iterable, Mapping
from typing import TypeVar

Item = TypeVar("Item", bound=Hashable)
#: Characters that a terminal interprets instead of showing, or that change the direction of a line; not line end and
#: tab.
_OBEYED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


def nearest(word: str, known: Iterable[str], described: Mapping[str, str] | None = None, alike: float = 0.5) -> str:
    """Return a hint such as ``did you mean 'range_mm'? Known: ...`` for a misspelt ``word``.

    All known words that contain ``word`` are proposed; if there are none, those whose ``described`` text has it as a
    word, and otherwise the most similar one (``alike``: minimum similarity, 0 to 1).
    """
    choices = sorted(known)
    proposed = [choice for choice in choices if len(word) > 2 and word.lower() in choice.lower()]
    if not proposed and len(word) > 2 and described:
        whole = re.compile(rf"(?<![a-z0-9]){re.escape(word)}", re.IGNORECASE)
        proposed = [choice for choice in choices if whole.search(described.get(choice, ""))]
    if not proposed:
        lowered = {choice.lower(): choice for choice in choices}
        proposed = [lowered[close] for close in difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=alike)]
    hint = f"did you mean {' or '.join(map(repr, proposed))}? " if proposed else ""
    return f"{hint}Known: {', '.join(choices) if choices else 'none'}"


def repeated(items: Iterable[Hashable]) -> tuple[int, int] | None:
    """Return where an item occurs first and again, None if all differ, in a single pass."""
    seen: dict[Hashable, int] = {}
    for k, item in enumerate(items):
        first = seen.setdefault(item, k)
        if first != k:
            return first, k
    return None


def doubled(items: Iterable[Item]) -> Item | None:
    """Return the first duplicate item, None if all differ."""
    kept = list(items)
    found = repeated(kept)
    return None if found is None else kept[found[1]]


def visible(text: str, *, flat: bool = False) -> str:
    r"""Return ``text`` with escapes such as ``\x1b`` for what a terminal would interpret; with ``flat`` also for line ends.

    >>> print(visible("a\x1b[2J"))
    a\x1b[2J
    """
    shown = _OBEYED.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
    return shown.replace("\n", "\\n") if flat else shown


def visible_line(text: object) -> str:
    """Return ``text`` on one line in its own script, with escapes for what a terminal would interpret.

    >>> visible_line("20  °C ") == "20 °C"
    True
    """
    return visible(" ".join(str(text).split()), flat=True)


def one_line(text: object) -> str:
    """Return ``text`` as printable ASCII on one line, so that it is safe in a comment of a controller file."""
    flat = " ".join(str(text).split())
    if flat.isascii() and flat.isprintable():  # the usual case, and much faster
        return flat
    return "".join(char if " " <= char <= "~" else "?" for char in flat)


def number_text(value: object, digits: int = 3, missing: str = "–") -> str:
    """A number with ``digits`` decimals; ``missing`` for None, nan, infinity and non-numbers.

    >>> number_text(1.5), number_text(None), number_text(float("nan"), missing="not known")
    ('1.500', '–', 'not known')
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return missing
    return f"{value:.{digits}f}"


def um_text(value: float | None, whole_from: float = 1000.0) -> str:
    """A figure in um: two decimals below 10, none from ``whole_from`` on, a dash for None.

    >>> um_text(0.157), um_text(42.34), um_text(1714.6), um_text(None)
    ('0.16', '42.3', '1715', '–')
    """
    size = 0.0 if value is None else abs(value)
    return number_text(value, 2 if size < 9.995 else 1 if size < whole_from - 0.05 else 0)
