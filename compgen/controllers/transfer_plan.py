"""Plans for a binary transfer (``*.plan.json``) beside the text of a control: both must hold the same numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from compgen.controllers.base import SourceFile
from compgen.errors import InputError


def check_plans(files: Sequence[SourceFile], expected: Callable[[], Mapping[str, Any]]) -> None:
    """Hold every ``.json`` file against what the tables in the text beside it make.

    Parameters
    ----------
    files : all files of one export; without a plan among them nothing is asked.
    expected : gives the plan of the parsed tables, by the keys of the file; other keys of the file are notes.

    Raises
    ------
    InputError
        for a file that is no JSON object, and at the first number that differs, with its place.
    """
    plans = [file for file in files if file.path.suffix.lower() == ".json"]
    if not plans:
        return
    wanted = json.loads(json.dumps(dict(expected())))
    for file in plans:
        try:
            found = json.loads(file.text, object_pairs_hook=_once)
        except (ValueError, RecursionError) as problem:
            raise InputError(f"is not JSON: {problem}", file=file.path) from None
        if not isinstance(found, dict):
            raise InputError(f"holds {_short(found)}, a plan is an object with {', '.join(wanted)}", file=file.path)
        for where, given, due in _differences({key: found.get(key) for key in wanted}, wanted, ""):
            raise InputError(
                f"{_short(given)}, but the tables beside it say {_short(due)}: what is sent from the plan would not be what was "
                "checked; export again, or leave the plan out",
                file=file.path,
                field=where,
            )


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
