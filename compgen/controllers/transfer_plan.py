"""Plans for a binary transfer (``*.plan.json``) beside the text of a control: both must hold the same numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from compgen.controllers.base import SourceFile


def plan_contradictions(files: Sequence[SourceFile], expected: Callable[[], Mapping[str, Any]]) -> list[str]:
    """Say where a ``.json`` file differs from the plan that the tables in the text beside it make.

    Parameters
    ----------
    files : all files of one export; without a plan among them nothing is asked.
    expected : gives the plan of the parsed tables, by the keys of the file; other keys of the file are notes.

    Returns
    -------
    One sentence for each plan that cannot be used: no JSON, no object, or the first number that differs, with its place.
    """
    plans = [file for file in files if file.path.suffix.lower() == ".json"]
    wanted = json.loads(json.dumps(dict(expected()))) if plans else {}
    return [f"{file.path.name}: {text}" for file in plans if (text := _contradiction(file.text, wanted))]


def _contradiction(text: str, wanted: Mapping[str, Any]) -> str:
    try:
        found = json.loads(text, object_pairs_hook=_once)
    except (ValueError, RecursionError) as problem:
        return f"is not JSON: {problem}"
    if not isinstance(found, dict):
        return f"holds {_short(found)}, a plan is an object with {', '.join(wanted)}"
    differing = list(_differences({key: found.get(key) for key in wanted}, wanted, ""))
    if not differing:
        return ""
    where, given, due = differing[0]
    more = f" (and {len(differing) - 1} more)" if len(differing) > 1 else ""
    return f"{where} is {_short(given)}, but the tables beside it say {_short(due)}{more}: leave the plan out, or export again"


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands twice in one object")
    return found


def _differences(given: Any, due: Any, where: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(given, dict) and isinstance(due, dict):
        for key in [*due, *(key for key in given if key not in due)]:
            yield from _differences(given.get(key), due.get(key), f"{where}.{key}" if where else key)
    elif isinstance(given, list) and isinstance(due, list) and len(given) == len(due):
        for place, (one, other) in enumerate(zip(given, due, strict=True)):
            yield from _differences(one, other, f"{where}[{place}]")
    elif given != due or isinstance(given, bool) != isinstance(due, bool):
        yield where, given, due


def _short(value: Any) -> str:
    text = "missing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
