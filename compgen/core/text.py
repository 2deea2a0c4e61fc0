"""Small helpers for messages and for text that came from a user."""

from __future__ import annotations

import difflib
from collections.abc import Hashable, Iterable
from typing import TypeVar

Item = TypeVar("Item", bound=Hashable)


def nearest(word: str, known: Iterable[str]) -> str:
    """Return a hint such as ``did you mean 'range_mm'? Known: ...`` for a misspelt ``word``."""
    choices = sorted(known)
    lowered = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(word.lower(), lowered, n=1, cutoff=0.5)
    hint = f"did you mean {lowered[close[0]]!r}? " if close else ""
    return f"{hint}Known: {', '.join(choices) if choices else 'none'}"


def doubled(items: Iterable[Item]) -> Item | None:
    """Return the first item that came before, None if all differ; one look at each, however many there are."""
    seen: set[Item] = set()
    for item in items:
        if item in seen:
            return item
        seen.add(item)
    return None


def one_line(text: object) -> str:
    """Return ``text`` as printable ASCII on one line, so that it is safe in a comment of a controller file."""
    flat = " ".join(str(text).split())
    return "".join(char if " " <= char <= "~" else "?" for char in flat)
