"""The text of a machine file with one key changed: comments, order and form of everything else stay.

tomlkit knows where a key stands (arrays over several lines, quoted names, dotted keys, sections apart from each other). A
shipped file also has keys and sections in comments, which no parser knows: they are used where they stand. Every change is
read back, and the file must hold what it held before, apart from the key.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from copy import deepcopy
from typing import Any

import tomlkit
from tomlkit.container import Container
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Comment, InlineTable, Item, Table

from compgen.errors import InputError

_HEADER = re.compile(r"#\s*\[\s*([\w.-]+)\s*\]\s*(?:#.*)?$")
#: A line that no file contains; it marks the place of a change in the text.
_MARK = "volcomp-change-f3a1"


def with_section(text: str, section: str) -> str:
    """Return the text with the table ``section``: as it is, with its header no longer in a comment, or added at the end."""
    path = section.split(".")
    before = tomllib.loads(text)
    if _value_at(before, path) is not None:
        return text
    wanted = deepcopy(before)
    table = wanted
    for part in path:
        table = table.setdefault(part, {})
    lines = text.splitlines(keepends=True)
    for k, line in enumerate(lines):
        found = _HEADER.match(line.strip())
        if found and found[1] == section:
            changed = "".join([*lines[:k], line.replace("#", "", 1).lstrip(), *lines[k + 1 :]])
            if _reads_as(changed, wanted):
                return changed
    return f"{text.rstrip()}\n\n[{section}]\n"


def with_value(text: str, section: str, key: str, value: str) -> str:
    r"""Return the text of a machine file with one key changed; an empty ``value`` makes a comment of the key.

    Raises
    ------
    InputError
        for a value that is no TOML, and a file in which the key cannot be changed alone.

    >>> print(with_value("# [a]\n# k = 1 # meaning", "a", "k", "2"), end="")
    [a]
    k = 2                                     # meaning
    """
    name = f"{section}.{key}".strip(".")
    if value:
        text = with_section(text, section) if section else text
    path = section.split(".") if section else []
    wanted = tomllib.loads(text)
    table = _value_at(wanted, path)
    if value and isinstance(table, dict):
        try:
            table[key] = tomllib.loads(f"k = {value}\n")["k"] if "\n" not in value else tomlkit.value(value).unwrap()
        except (tomllib.TOMLDecodeError, TOMLKitError, ValueError) as error:
            message = f"{value!r} is no TOML value; write a number, a text in quotation marks or [1.0, 2.0]"
            raise InputError(message, field=name) from error
    elif not isinstance(table, dict) or key not in table:
        return text
    else:
        del table[key]
    for changed in _forms(text, path, key, value):
        if _reads_as(changed, wanted):
            return changed
    raise InputError("this key cannot be changed without another one; edit the text of the file", field=name)


def _value_at(data: Any, path: Sequence[str]) -> Any:
    for part in path:
        data = data.get(part) if isinstance(data, dict) else None
    return data


def _reads_as(text: str, wanted: dict[str, Any]) -> bool:
    try:
        return tomllib.loads(text) == wanted
    except tomllib.TOMLDecodeError:
        return False


def _forms(text: str, path: Sequence[str], key: str, value: str) -> Iterator[str]:
    """The text with the key changed, in the forms that a section may have; the first that reads as wanted is taken."""
    yield (changed := _changed(text, path, key, value, key))
    if path and value:
        yield _changed(text, path, key, value, ".".join([*path, key]))  # the section consists of dotted keys
    elif path:
        yield with_section(changed, ".".join(path))  # it was the only one of them


def _changed(text: str, path: Sequence[str], key: str, value: str, written: str) -> str:
    document = tomlkit.parse(text)
    pieces = list(_pieces(document, path))  # several: dotted keys, and sections apart from each other
    for piece in pieces:
        if key in piece:
            return _replaced(document, piece, key, value)
    if isinstance(pieces[0], InlineTable):
        pieces[0][key] = tomlkit.value(value)
        return tomlkit.dumps(document)
    container = next(
        (piece for piece in pieces if not (isinstance(piece, Table) and piece.is_super_table())), pieces[0]
    )
    return _added(document, container, key, f"{written} = {value}")


def _pieces(container: Any, path: Sequence[str]) -> Iterator[Any]:
    """Tables of the document at ``path``, as objects of the document itself."""
    if not path:
        yield container
        return
    body = container.body if isinstance(container, Container) else container.value.body
    for key, item in body:
        if key is not None and key.key == path[0] and isinstance(item, Table | InlineTable):
            yield from _pieces(item, path[1:])


def _replaced(document: Any, table: Any, key: str, value: str) -> str:
    """The text with a key that is set: another value, or all its lines as a comment."""
    old: Item = table.item(key) if hasattr(table, "item") else table[key]
    if value:
        new = tomlkit.value(value)
        new.trivia.comment_ws, new.trivia.comment, new.trivia.trail = (
            old.trivia.comment_ws, old.trivia.comment, old.trivia.trail,
        )  # fmt: skip
        new.trivia.indent = old.trivia.indent
        table[key] = new
        return tomlkit.dumps(document)
    if isinstance(table, InlineTable):
        del table[key]
        return tomlkit.dumps(document)
    before = tomlkit.dumps(document)
    mark = tomlkit.value(f'"{_MARK}"')
    mark.trivia.indent, mark.trivia.trail = old.trivia.indent, old.trivia.trail
    table[key] = mark
    head, _, tail = tomlkit.dumps(document).partition(f'"{_MARK}"')
    start = head.rfind("\n") + 1
    lines = before[start : len(before) - len(tail)].rstrip("\n").split("\n")
    return before[:start] + "\n".join(f"# {line}" for line in lines) + tail


def _added(document: Any, table: Any, key: str, line: str) -> str:
    """The text with a key that was not set: where a comment has it, otherwise behind the last one of its section."""
    body = table.body if isinstance(table, Container) else table.value.body
    last: Item | None = table if isinstance(table, Table) else None
    for own, item in body:
        if isinstance(item, Comment):
            comment = item.trivia.comment
            if _HEADER.match(comment):
                break
            found = re.match(rf"#\s*{re.escape(key)}\s*=\s*(.*)$", comment)
            if found:
                remark = _remark(found[1])
                item.trivia.comment = f"#{_MARK}"
                return tomlkit.dumps(document).replace(f"#{_MARK}", f"{line:<41} {remark}".rstrip())
            last = item
        elif own is not None:
            if isinstance(item, Table) and not item.is_super_table():
                break
            last = item
    if last is None:
        return f"{line}\n" + tomlkit.dumps(document)
    last.trivia.trail = f"\n#{_MARK}\n"
    return tomlkit.dumps(document).replace(f"#{_MARK}\n", f"{line}\n")


def _remark(text: str) -> str:
    """The comment behind the value of a line."""
    quote = ""
    for k, char in enumerate(text):
        if char in "\"'" and quote in ("", char):
            quote = "" if quote else char
        elif char == "#" and not quote:
            return text[k:]
    return ""
