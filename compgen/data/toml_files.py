"""Strict reading of TOML: every key is read by a reader; any other is an error that proposes the nearest known key.

A :class:`Section` is one table of a file. A dataclass whose fields are declared with :func:`setting` is read by
:func:`read_settings`; a reader with rules of its own takes key by key. :func:`section_schema` makes a JSON schema of what is
declared, :func:`problems_of` lists everything that a reader would refuse. The checks at the end say what a value may be, to
the reader and, by :func:`accepts`, to the schema.
"""

from __future__ import annotations

import difflib
import inspect
import math
import os
import re
import tomllib
import warnings
from collections.abc import Callable, Container, Mapping, Sequence
from copy import deepcopy
from dataclasses import Field, dataclass, field, fields, is_dataclass, replace
from decimal import Decimal
from operator import ge, gt, le, lt
from pathlib import Path
from typing import Any, Literal, TypeVar, cast, overload

from compgen.data.files import read_text
from compgen.data.names import AXES, LARGEST, SMALLEST
from compgen.errors import CompgenWarning, InputError, Message, nearest, visible_line


def option(
    default: Any = None,
    text: str = "",
    *,
    name: str = "",
    metavar: str | None = None,
    choices: tuple[Any, ...] = (),
    within: tuple[int, int] | None = None,
    factory: Callable[[], Any] | None = None,
    required: bool = False,
    in_job: Callable[[Any], Any] | None = None,
) -> Any:
    """Return the field of an options dataclass; it becomes an option of the command line.

    Parameters
    ----------
    default, factory : value if nothing is given; ``factory`` makes a mutable one.
    text : meaning and unit, one or two sentences. A default that is a number or a word is added to it.
    name : of the option, if not that of the field; required for a flag that is True by default, to switch it off.
    metavar : placeholder of the value in the help.
    choices : the allowed values, if the type of the field does not list them.
    within : the lowest and the highest whole number.
    required : the field has no default, and the option must be given.
    in_job : check of the value in a job file, where the field is also a key of a machine; None: it is not.
    """
    words: Mapping[str, Any] = {"text": text, "name": name, "metavar": metavar}
    declared: Mapping[str, Any] = {**words, "choices": choices, "within": within, "in_job": in_job}
    start: dict[str, Any] = {} if required else {"default": default}
    return field(metadata=declared, **({"default_factory": factory} if factory is not None else start))


T = TypeVar("T")
D = TypeVar("D")
C = TypeVar("C", bound=Callable[..., Any])
_REQUIRED = object()
#: Variable of the environment with the only folder in which files may be that a TOML file names; without it any.
WITHIN = "COMPGEN_FILES_WITHIN"
#: A JSON schema (draft 2020-12), or a part of one.
Schema = Mapping[str, Any]
#: Where a key is in a file: keys of tables, and numbers in arrays of tables.
Place = tuple[str | int, ...]

#: What is wrong with a key: the reader does not know it, it is missing, its value is wrong, or does not go with others.
ProblemKind = Literal["unknown", "missing", "value", "others"]


def accepts(schema: Schema) -> Callable[[C], C]:
    """Say as a JSON schema what a check takes, as far as a schema can; a check without one takes anything there."""

    def declare(check: C) -> C:
        check.json_schema = schema  # type: ignore[attr-defined]
        return check

    return declare


def accepted(check: Callable[[Any], Any]) -> Schema:
    """Return the JSON schema of what a check takes."""
    return cast(Schema, getattr(check, "json_schema", {}))


class SettingError(InputError):
    """An InputError about one key of a TOML file.

    Parameters
    ----------
    place : where the key is in the file, or would be.
    kind : "unknown" to the reader, "missing", of a wrong "value", or wrong together with "others".
    instead : a value with which reading can go on where the key may not be left out; None: there is none.
    meant : the key of the file that was probably meant, if it is missing under its right name.
    """

    place: Place = ()
    kind: ProblemKind = "others"
    instead: Any = None
    meant: str = ""


@dataclass(frozen=True)
class DeclaredKey:
    """A key of a section as declared: with the names of sub-sections, its default unless required, its check."""

    key: str
    required: bool
    default: Any
    check: Callable[[Any], Any]

    @property
    def shown(self) -> Any:
        """The default if it can be written in a file, otherwise None."""
        value = list(self.default) if isinstance(self.default, tuple) else self.default
        try:
            self.check(value)
        except (ValueError, TypeError):
            return None
        return value

    @property
    def allowed(self) -> str:
        """What the check expects: its message about an invalid value."""
        message = _refusal(self.check, object())
        if message == _refusal(number, object()):
            message = _refusal(self.check, -1.0) or message
        return re.sub(r"^expected |\s+(is|are) expected\b", "", message).rstrip(",")


class Section:
    """One table of a TOML file whose keys are read one by one.

    ``take`` checks and returns a value, ``section`` descends, ``finish`` raises for a key that nobody took. A key that
    the section does not have is taken from that of its ``defaults``, where these are given.
    """

    def __init__(
        self,
        data: Mapping[str, Any],
        *,
        path: Path | None,
        text: str = "",
        name: str = "",
        place: Place | None = None,
        defaults: Section | None = None,
    ) -> None:
        self.data, self.path, self.text, self.name, self.defaults = dict(data), path, text, name, defaults
        self.place: Place = (tuple(name.split(".")) if name else ()) if place is None else place
        self._nth = 0  # which of the tables of that name, for an array of tables
        self._known: set[str] = set()

    def again(self, data: Mapping[str, Any] | None = None, defaults: Section | None = None) -> Section:
        """Return the section as if nothing had been taken from it, or with other ``data`` or ``defaults``."""
        return Section(
            self.data if data is None else data,
            path=self.path,
            text=self.text,
            name=self.name,
            place=self.place,
            defaults=defaults or self.defaults,
        )

    def fail(self, key: str, message: str, *, kind: ProblemKind = "others", instead: Any = None) -> SettingError:
        """Return the error that points at ``key`` of this section, "" for the section itself (:class:`SettingError`)."""
        full = f"{self.name}.{key}" if self.name else key
        # the line of the key, or of its table's header if the file does not have the key
        inside, count, own = not self.name, -1, None
        table, inline, depth = "", None, 0  # a table may be the value of a key: last = { key = ... }, or a dotted key
        for number, line in enumerate(self.text.split("\n"), start=1):
            header = re.match(r"\s*\[\[?\s*([^\[\],]+?)\s*\]\]?\s*(#.*)?$", line)
            if header:
                table = re.sub(r"[\"' ]", "", header.group(1))
                count += table == self.name
                inside = table == self.name and count == self._nth
                own = number if inside else own
                if table == full and max(count, 0) == self._nth:
                    own = number
                    break
            elif inside and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", line):
                own = number
                break
            elif self.name and (given := re.match(r"\s*([\w.\"' -]+?)\s*=", line)):
                dotted = ".".join(filter(None, (table, re.sub(r"[\"' ]", "", given.group(1)))))
                if f"{full}.".startswith(f"{dotted}.") and len(dotted) > depth:
                    inline, depth = number, len(dotted)
        place = f"[{self.name}] {key}" if self.name else key
        error = SettingError(message, file=self.path, line=own or inline, field=visible_line(place))
        error.place, error.kind, error.instead = (*self.place, key), kind, instead
        return error

    def __contains__(self, key: str) -> bool:
        """Whether the file has ``key``; the key counts as known from then on."""
        self._known.add(key)
        usual = self.defaults is not None and key in self.defaults
        return usual or key in self.data

    @overload
    def take(self, key: str, check: Callable[[Any], T]) -> T: ...
    @overload
    def take(self, key: str, check: Callable[[Any], T], default: D) -> T | D: ...
    def take(self, key: str, check: Callable[[Any], Any], default: Any = _REQUIRED) -> Any:
        """Return the checked value of ``key``; ``check`` raises ValueError with what is expected."""
        self._known.add(key)
        if self.defaults is not None and key in self.defaults:  # checked even if the section has a value of its own
            default = self.defaults.take(key, check)
        if key not in self.data:
            if default is _REQUIRED:
                # a key of the file that was probably meant: different case, missing unit, typing error
                present = [name for name in self.data if name not in self._known]
                alike = [name for name in present if f"{key}_".lower().startswith(f"{name}_".lower())]
                alike = alike or difflib.get_close_matches(key, present, n=1, cutoff=0.6)
                hint = f"; {visible_line(alike[0])!r} is not a key here, did you mean {key!r}?" if alike else ""
                missing = self.fail(key, f"is missing{hint}", kind="missing", instead=example_of(accepted(check)))
                missing.meant = alike[0] if alike else ""
                raise missing
            return default
        try:
            return check(self.data[key])
        except ValueError as error:
            instead = example_of(accepted(check)) if default is _REQUIRED else None
            got = visible_line(repr(self.data[key]))[:80]
            message = Message("value-refused", "{error}; got {got}", error=error, got=got)
            raise self.fail(key, message, kind="value", instead=instead) from None

    def section(self, key: str, *, required: bool = True) -> Section:
        """Return the sub-section ``key`` (an empty one if it is absent and not required)."""
        full = f"{self.name}.{key}" if self.name else key
        value = self.take(key, table) if required else self.take(key, table, {})
        usual = None
        if self.defaults is not None:
            usual, value = self.defaults.section(key, required=False), self.data.get(key, {})
        return Section(value, path=self.path, text=self.text, name=full, place=(*self.place, key), defaults=usual)

    def sections(self, key: str) -> list[Section]:
        """Return the sub-sections of an array of tables (``[[key]]``), empty if absent."""
        full = f"{self.name}.{key}" if self.name else key
        tables = self.take(key, _tables, [])
        found = [
            Section(table, path=self.path, text=self.text, name=full, place=(*self.place, key, nth))
            for nth, table in enumerate(tables)
        ]
        for nth, section in enumerate(found):
            section._nth = nth
        return found

    def file(self, key: str) -> Path | None:
        """Return the path of an existing file, None if ``key`` is absent; relative to the folder of the TOML file."""
        name = self.take(key, text_of_path, None)
        return None if name is None else self._existing(key, name)

    def files(self, key: str) -> tuple[Path, ...]:
        """Return the paths of existing files, from one path or a list of paths; none if ``key`` is absent."""
        return tuple(self._existing(key, name) for name in self.take(key, texts_of_paths, ()))

    def _existing(self, key: str, name: str) -> Path:
        path = (self.path.parent if self.path else Path()) / name
        folder = os.environ.get(WITHIN)
        if folder and not path.resolve().is_relative_to(folder):
            raise self.fail(key, f"{name} is not in the folder of the project; a project must not name files elsewhere")
        if not path.is_file():
            raise self.fail(key, f"no such file: {path}; give the path of a file")
        return path

    def finish(self) -> None:
        """Raise InputError for the first key that was not read."""
        for key in self.data:
            if key not in self._known:
                raise self.fail(key, f"is not a known key; {nearest(key, self._known)}", kind="unknown")
        if self.defaults is not None:
            self.defaults.finish()


def read_toml(path: str | Path) -> Section:
    """Read a TOML file as the root :class:`Section`; a syntax error or a duplicate key or table is an InputError."""
    return parse_toml(read_text(path), Path(path))


def parse_toml(text: str, source: Path) -> Section:
    """Read the text of the TOML file ``source`` like :func:`read_toml`."""
    if not text.strip():
        raise InputError(Message("value-empty", "is empty"), file=source)
    try:
        return Section(tomllib.loads(text), path=source, text=text)
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        found = re.search(r"line (\d+)", str(error))
        line = int(found.group(1)) if found else len(text.splitlines())
        raise InputError(
            Message("toml-invalid", "is not valid TOML: {error}", error=error), file=source, line=line
        ) from error


def _refusal(check: Callable[[Any], Any], value: Any) -> str:
    """Return the message of a check about a value, empty if it accepts the value or fails otherwise."""
    try:
        check(value)
    except ValueError as error:
        return str(error)
    except Exception:  # a check that assumes a text
        return ""
    return ""


# --- settings: declared once as fields of a dataclass, read from a section ---------------------------------------


def setting(
    check: Callable[[Any], Any],
    default: Any = _REQUIRED,
    *,
    key: str = "",
    unit: float = 1.0,
    required: bool = False,
    stated: Any = None,
    meaning: str = "",
    name: str = "",
    metavar: str | None = None,
) -> Any:
    """Declare a field of a dataclass as a setting.

    Parameters
    ----------
    check : returns the clean value of the file or raises ValueError with what is expected.
    default : value of the field if the file does not have the key; without one the key is required.
    stated : the default as written in a file, instead of ``default``.
    meaning : for the card of a control, in a few words.
    key : the key of the file if it is not the name of the field.
    unit : factor from the numbers of the file to those of the field.
    required : the file must have the key although the field has a default for programs.
    name, metavar : as for :func:`option`, where a command takes the setting; the option gives the value as the file
        would have it.
    """
    if stated is not None:
        default = _scaled(check(stated), unit)
    metadata = {"check": check, "key": key, "unit": unit, "required": required or default is _REQUIRED}
    metadata |= {"stated": default if stated is None and unit == 1.0 else stated, "meaning": meaning}
    metadata |= {"text": meaning, "name": name, "metavar": metavar, "choices": (), "within": None}
    return field(metadata=metadata) if default is _REQUIRED else field(default=default, metadata=metadata)


def _scaled(value: Any, unit: float) -> Any:
    """A value of the file in the unit of its field, number by number."""
    if unit == 1.0:
        return value
    return tuple(unit * item for item in value) if isinstance(value, tuple) else unit * value


def axis_setting(
    check: Callable[[Any], Any],
    defaults: tuple[Any, Any, Any] = (None, None, None),
    *,
    key: str = "",
    unit: float = 1.0,
    differ: str = "",
    meaning: str = "",
) -> Any:
    """Declare a field with a value for each of X, Y and Z, from a sub-section with these keys.

    ``differ`` is the message if two axes have the same value, with ``{}`` for the three values; by default they may be
    the same. The other parameters are those of :func:`setting`.
    """
    metadata = {"check": check, "key": key, "unit": unit, "axes": defaults, "differ": differ, "meaning": meaning}
    return field(default=defaults, metadata=metadata)


def file_setting(
    load: Callable[[Any], Any] | None = None, *, several: bool = False, key: str = "", meaning: str = ""
) -> Any:
    """Declare a field as the path of a file (``several``: one or more), relative to the folder of the TOML file.

    The value is the path (a tuple of paths), or the result of ``load``; without the key it is None (``load`` of no
    path).
    """
    check = texts_of_paths if several else text_of_path
    metadata: dict[str, Any] = {"check": check, "key": key, "load": load, "several": several}
    metadata |= {"unit": 1.0, "required": False, "stated": None, "meaning": meaning}
    return field(default=(load(()) if load else ()) if several else None, metadata=metadata, compare=False)


def table_setting(kind: type[T], *, key: str = "", meaning: str = "") -> Any:
    """Declare a field with the settings that the dataclass ``kind`` declares, from a sub-section."""
    return field(default_factory=kind, metadata={"check": kind, "key": key, "kind": kind, "meaning": meaning})


def part_setting(
    schema: Callable[[], Schema] | Mapping[str, Schema] | None = None,
    default: Any = _REQUIRED,
    *,
    factory: Callable[[], Any] | None = None,
    key: str = "",
    required: bool = False,
    meaning: str = "",
) -> Any:
    """Declare a field whose keys a reader with rules of its own takes.

    Parameters
    ----------
    schema : what the key may hold, as a JSON schema made when it is asked for, or what each of several keys may hold;
        without one a table of any content.
    key : the key of the file if it is not the name of the field.
    default, factory : value of the field for programs.
    required : the file must have the key.
    """
    data = {"part": schema or (lambda: {"type": "object"}), "key": key, "required": required, "meaning": meaning}
    if factory is not None:
        return field(default_factory=factory, metadata=data)
    return field(metadata=data) if default is _REQUIRED else field(default=default, metadata=data)


def take_axes(section: Section, item: Field[Any]) -> tuple[Any, Any, Any]:
    """Return the values of X, Y and Z of a field that :func:`axis_setting` declares."""
    data, key = item.metadata, item.metadata["key"] or item.name
    part = section.section(key, required=False)
    found = tuple(part.take(letter, data["check"], default) for letter, default in zip(AXES, data["axes"], strict=True))
    part.finish()
    if data["differ"] and len(set(found)) < 3:
        raise section.fail(key, data["differ"].format(", ".join(map(str, found))), kind="value")
    x, y, z = (value if value is None or data["unit"] == 1.0 else data["unit"] * value for value in found)
    return x, y, z


def declared_settings(kind: type) -> list[tuple[DeclaredKey, str]]:
    """Return the keys that a dataclass declares, as in a file, each with its meaning, in the order of the fields."""
    found = []
    for item in fields(kind) if is_dataclass(kind) else ():
        data, key = item.metadata, item.metadata.get("key") or item.name
        if "kind" in data:
            inner = declared_settings(data["kind"])
            found += [(replace(part, key=f"{key}.{part.key}"), said or data["meaning"]) for part, said in inner]
            continue
        if "axes" in data:
            parts = [(f"{key}.{letter}", False, default) for letter, default in zip(AXES, data["axes"], strict=True)]
        else:
            parts = [(key, data["required"], None if data["required"] else data["stated"])] if "check" in data else []
        found += [(DeclaredKey(*part, data["check"]), data["meaning"]) for part in parts]
    return found


def take_settings(kind: type[T], section: Section, /, **given: Any) -> T:
    """Return a ``kind`` with the settings that it declares from a section, and the fields that are ``given``."""
    return kind(**given, **stated_settings(kind, section, given))


def stated_settings(kind: type, section: Section, without: Container[str] = ()) -> dict[str, Any]:
    """Return the values by field that a section states of what ``kind`` declares, but for the fields ``without``."""
    values: dict[str, Any] = {}
    for item in fields(cast(Any, kind)):
        if "check" not in item.metadata or item.name in without:
            continue
        if "axes" in item.metadata:
            values[item.name] = take_axes(section, item)
            continue
        if "kind" in item.metadata:
            part = section.section(item.metadata["key"] or item.name, required=False)
            values[item.name] = read_settings(item.metadata["kind"], part)
            continue
        key, check, unit = (item.metadata[name] for name in ("key", "check", "unit"))
        key, default = key or item.name, item.metadata["stated"]
        if "load" in item.metadata:
            paths = section.files(key) if item.metadata["several"] else section.file(key)
            load = item.metadata["load"]
            values[item.name] = load(paths) if load and paths is not None else paths
            continue
        found = section.take(key, check, *(() if item.metadata["required"] else (default,)))
        if key in section:
            values[item.name] = _scaled(found, unit)
    return values


def read_settings(kind: type[T], section: Section, /, **given: Any) -> T:
    """Return a ``kind`` like :func:`take_settings`; an unknown key of the section is an error."""
    result = take_settings(kind, section, **given)
    section.finish()
    return result


def read_each(kind: type[T], section: Section, key: str) -> tuple[T, ...]:
    """Return a ``kind`` for each table of an array of tables; an error if there is none."""
    found = tuple(read_settings(kind, entry) for entry in section.sections(key))
    if not found:
        needed = ", ".join(item.key for item, _ in declared_settings(kind) if item.required)
        message = f"is missing; give at least one [[{f'{section.name}.{key}'.lstrip('.')}]] with {needed}"
        raise section.fail(key, message, kind="missing", instead=[example_of(section_schema(kind))])
    return found


def unless_stated(settings: T, section: Section, **usual: Any) -> T:
    """Return settings with the ``usual`` values, by field, for keys missing in the section (axis by axis)."""
    found = {}
    for item in fields(cast(Any, settings)):
        key = item.metadata.get("key") or item.name
        if item.name in usual and "axes" in item.metadata:
            pairs = zip(AXES, getattr(settings, item.name), usual[item.name], strict=True)
            stated = section.data.get(key, {})
            found[item.name] = tuple(own if letter in stated else other for letter, own, other in pairs)
        elif item.name in usual and key not in section:
            found[item.name] = usual[item.name]
    return cast(T, replace(cast(Any, settings), **found))


# --- JSON schemas of what is declared -----------------------------------------------------------------------------


def section_schema(*kinds: type, **more: Schema) -> dict[str, Any]:
    """Return the JSON schema of a section with the keys that dataclasses declare, and ``more`` properties by key.

    The description of a key is its declared meaning, else what the docstring of its dataclass says of the field. A
    property of ``more`` with ``"required": True`` instead of its list of keys is a key that the section must have.
    """
    properties: dict[str, Any] = {}
    required = [key for key, schema in more.items() if schema.get("required") is True]
    for kind in kinds:
        # the section "Parameters" of the docstrings of the dataclass and its bases, each field on one line
        described: dict[str, str] = {}
        for doc in (inspect.cleandoc(base.__doc__ or "") for base in reversed(kind.__mro__)):
            for names, text in re.findall(r"^(\w+(?:, \w+)*) : (.+(?:\n {4}.*)*)", doc, re.M):
                described |= dict.fromkeys(names.split(", "), " ".join(text.replace("``", "").split()))
        for item in fields(cast(Any, kind)):
            data = item.metadata
            key, said = data.get("key") or item.name, data.get("meaning") or described.get(item.name, "")
            if isinstance(data.get("part"), Mapping):
                properties |= {each: {"description": said, **schema} for each, schema in data["part"].items()}
            elif {"check", "part"} & set(data):
                properties[key] = _property(item, said)
                required += [key] if data.get("required") else []
    properties |= {
        key: {word: value for word, value in schema.items() if word != "required" or value is not True}
        for key, schema in more.items()
    }
    return table_schema(properties, required)


def table_schema(properties: Mapping[str, Schema], required: Sequence[str] = ()) -> dict[str, Any]:
    """Return the JSON schema of a table with these keys and no others."""
    needed = {"required": list(required)} if required else {}
    return {"type": "object", "additionalProperties": False, "properties": dict(properties), **needed}


def array_schema(items: Schema, least: int = 0) -> dict[str, Any]:
    """Return the JSON schema of an array."""
    return {"type": "array", "items": items, **({"minItems": least} if least else {})}


def _property(item: Field[Any], meaning: str) -> dict[str, Any]:
    """The schema of the keys of one field."""
    data = item.metadata
    described = {"description": meaning} if meaning else {}
    if "part" in data:
        return {**data["part"](), **described}
    if "kind" in data:
        return {**section_schema(data["kind"]), **described}
    if "axes" in data:
        one = accepted(data["check"])
        pairs = zip(AXES, data["axes"], strict=True)
        found = {letter: {**one, **({} if default is None else {"default": default})} for letter, default in pairs}
        return {**table_schema(found), **described}
    shown = DeclaredKey(item.name, data["required"], data["stated"], data["check"]).shown
    default = {} if data["required"] or shown is None else {"default": shown}
    return {**accepted(data["check"]), **described, **default}


def example_of(schema: Schema) -> Any:
    """Return a simple value that a schema takes, None for a schema that says nothing."""
    for key in ("const", "default"):
        if key in schema:
            return schema[key]
    for key in ("examples", "enum"):
        if key in schema:
            return schema[key][0]
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return example_of(schema[key][0])
    kind, least = schema.get("type"), schema.get("minItems", 0)
    if kind in ("number", "integer"):
        low, above = schema.get("minimum", 0), schema.get("exclusiveMinimum")
        return above + 1 if above is not None else max(low, 0)
    if kind == "array":
        return [example_of(schema.get("items", {})) for _ in range(least)]
    if kind == "object":
        return {key: example_of(schema["properties"][key]) for key in schema.get("required", ())}
    return {"string": "x", "boolean": False}.get(str(kind))


# --- every problem of a file at once ------------------------------------------------------------------------------


@dataclass(frozen=True)
class FileProblems:
    """What speaks against a file: what its reader refuses, in the order of the file, and what it warns of.

    ``unsure`` says that more may be wrong with what depends on the keys that are.
    """

    problems: tuple[InputError, ...]
    warnings: tuple[str, ...] = ()
    unsure: bool = False


def problems_of(path: str | Path, read: Callable[[Section], object], apart: Sequence[str] = ()) -> FileProblems:
    """Return everything in a TOML file that ``read`` refuses: it reads again and again, each time without what was wrong.

    A key that is unknown or wrong is left out for the next time, one that must be there gets a value that its check
    takes. What several keys do wrong together is not said where one of them was wrong by itself. ``apart`` names the
    tables whose entries have nothing to do with each other.
    """
    try:
        root = read_toml(path)
    except InputError as error:
        return FileProblems((error,))
    attempt = _Attempt(deepcopy(root.data), tuple(apart))
    while True:
        try:
            with warnings.catch_warnings(record=True) as heard:
                warnings.simplefilter("always", CompgenWarning)
                read(Section(deepcopy(attempt.data), path=root.path, text=root.text))
            break
        except InputError as error:
            if not attempt.without(error, root.path):
                attempt.unsure = True
                break
    ordered = sorted(attempt.found, key=lambda error: (error.file != root.path, error.line or 0))
    said = [str(item.message) for item in heard if issubclass(item.category, CompgenWarning)]
    return FileProblems(tuple(ordered), tuple(dict.fromkeys(said)), attempt.unsure)


class _Attempt:
    """The data of a file on the way to what its reader takes, and the problems found so far."""

    def __init__(self, data: dict[str, Any], apart: tuple[str, ...]) -> None:
        self.data, self.apart = data, apart
        self.found: list[InputError] = []
        self.unsure = False
        self.left_out: set[Place] = set()
        self.replaced: set[Place] = set()

    def without(self, error: InputError, path: Path | None) -> bool:
        """Keep a problem, and change the data so that reading gets past it; False if that cannot be."""
        own = isinstance(error, SettingError) and error.file == path
        key_error = error if isinstance(error, SettingError) and own else None
        place = _place_naming(self.data, path, error.file) if key_error is None else key_error.place
        altered = self.left_out | self.replaced
        follows = any(place[: len(known)] == known for known in altered)
        # what keys do wrong together is known only where none of them was changed
        depends = key_error is not None and key_error.kind == "others"
        touched = any(self._entry(known) in ((), self._entry(place)) for known in altered)
        if not follows and depends and touched:
            self.unsure = True
        elif not follows:
            self.found.append(error)
        if key_error is not None and self._mended(key_error):
            return True
        # leave out the key at the place, or the smallest table around it
        for length in range(len(place), 0, -1):
            table, key = self._table(place[: length - 1]), place[length - 1]
            if table is not None and key in table:
                del table[key]
                self.left_out.add(place[:length])
                return True
        return False

    def _mended(self, error: SettingError) -> bool:
        """Take an unknown key away, put a key under its right name, or give it a value that would do."""
        table, key = self._table(error.place[:-1]), error.place[-1]
        if table is None:
            return False
        if error.kind == "unknown":
            return table.pop(key, None) is not None
        if error.meant in table:
            table[key] = table.pop(error.meant)
        elif error.instead is not None and error.place not in self.replaced:
            table[key] = deepcopy(error.instead)
            self.replaced.add(error.place)
        else:
            return False
        return True

    def _table(self, place: Place) -> dict[Any, Any] | None:
        """The table at a place, None if there is none."""
        found: Any = self.data
        for key in place:
            try:
                found = found[key]
            except (KeyError, IndexError, TypeError):
                return None
        return found if isinstance(found, dict) else None

    def _entry(self, place: Place) -> Place:
        """The entry that a place is in, of those that have nothing to do with each other; none: the file as a whole."""
        return place[:2] if place and place[0] in self.apart else ()


def _place_naming(data: Any, path: Path | None, file: str | Path | None, at: Place = ()) -> Place:
    """Where the data of the file ``path`` name another ``file``; () if they do not."""
    if isinstance(data, str):
        return at if file is not None and path is not None and path.parent / data == Path(file) else ()
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    places = (_place_naming(value, path, file, (*at, key)) for key, value in inside)
    return next((place for place in places if place), ())


# --- checks: each returns the clean value or raises ValueError with what is expected -----------------------------


@accepts({"type": "number", "minimum": -LARGEST, "maximum": LARGEST})
def number(value: Any) -> float:
    """A finite number: zero, or of magnitude SMALLEST to LARGEST, so that its square is finite, too."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < math.inf:
        raise ValueError(Message("value-not-finite", "expected a finite number"))
    if not (value == 0 or SMALLEST <= abs(value) <= LARGEST):
        raise ValueError(
            Message(
                "value-magnitude",
                "expected a finite number: 0, or a magnitude from {smallest:g} to {largest:g}",
                smallest=SMALLEST,
                largest=LARGEST,
            )
        )
    return float(value)


@accepts({"type": "number", "exclusiveMinimum": 0, "maximum": LARGEST})
def positive(value: Any) -> float:
    """A finite number above zero."""
    result = number(value)
    if result <= 0:
        raise ValueError(Message("value-not-positive", "expected a number above zero"))
    return result


def multiple_of(quantum: Decimal) -> Callable[[Any], float]:
    """A positive length in whole multiples of ``quantum``, mm."""

    @accepts(accepted(positive))
    def check(value: Any) -> float:
        if Decimal(repr(positive(value))) % quantum:
            raise ValueError(Message("value-not-multiple", "expected a multiple of {quantum} mm", quantum=quantum))
        return float(value)

    return check


@accepts({"type": "number", "minimum": 0, "maximum": LARGEST})
def not_negative(value: Any) -> float:
    """A finite number, zero or more."""
    result = number(value)
    if result < 0:
        raise ValueError(Message("value-negative", "expected a number that is not negative"))
    return result


def whole(minimum: int, maximum: int | None = None) -> Callable[[Any], int]:
    """A whole number within limits."""
    limits = {"minimum": minimum} if maximum is None else {"minimum": minimum, "maximum": maximum}

    @accepts({"type": "integer", **limits})
    def check(value: Any) -> int:
        upper = math.inf if maximum is None else maximum
        if isinstance(value, bool) or not isinstance(value, int) or not minimum <= value <= upper:
            limits = f"from {minimum} to {maximum}" if maximum is not None else f"of at least {minimum}"
            raise ValueError(Message("value-not-whole", "expected a whole number {limits}", limits=limits))
        return value

    return check


@accepts({"type": "boolean"})
def flag(value: Any) -> bool:
    """``true`` or ``false``."""
    if not isinstance(value, bool):
        raise ValueError(Message("value-not-boolean", "expected true or false"))
    return value


@accepts({"type": "string", "maxLength": 200, "pattern": r"^[^\u0000-\u001f]*\S[^\u0000-\u001f]*$"})
def text(value: Any) -> str:
    """One line of text, at most 200 characters."""
    if not isinstance(value, str) or not value.strip() or len(value) > 200 or any(ord(char) < 32 for char in value):
        raise ValueError(Message("value-not-text", "expected one line of text"))
    return value


@accepts({"type": "string", "maxLength": 200, "pattern": r"^[^\u0000-\u001f=]*[^\s=][^\u0000-\u001f=]*$"})
def name(value: Any) -> str:
    """A text without "=", which separates a name from its value in comments and commands."""
    if "=" in text(value):
        raise ValueError(Message("value-not-name", "expected a name without '='"))
    return str(value)


@accepts({"type": "string", "pattern": r"^[^\u0000-\u001f]*\S[^\u0000-\u001f]*$"})
def text_of_path(value: Any) -> str:
    """A path as text: not empty, without control characters."""
    if not isinstance(value, str) or not value.strip() or any(ord(char) < 32 for char in value):
        raise ValueError(Message("value-not-path", "expected the path of a file"))
    return value


@accepts({"anyOf": [accepted(text_of_path), array_schema(accepted(text_of_path), 1)]})
def texts_of_paths(value: Any) -> tuple[str, ...]:
    """A path, or a list of paths, as text."""
    if isinstance(value, list) and value:
        return tuple(text_of_path(item) for item in value)
    if not isinstance(value, str):
        raise ValueError(Message("value-not-paths", "expected the path of a file, or a list of paths"))
    return (text_of_path(value),)


def choice(*allowed: str) -> Callable[[Any], str]:
    """One of the given words."""

    @accepts({"enum": list(allowed)})
    def check(value: Any) -> str:
        if value not in allowed:
            raise ValueError(
                Message("value-not-a-choice", "expected one of {choices}", choices=", ".join(map(repr, allowed)))
            )
        return str(value)

    return check


def word_for(values: Mapping[str, T]) -> Callable[[Any], T]:
    """One of the given words, converted to its value."""
    check = choice(*values)
    return accepts(accepted(check))(lambda value: values[check(value)])


def several_of(values: Mapping[str, T], what: str) -> Callable[[Any], tuple[T, ...]]:
    """A list of different words of the given ones, converted to their values; ``what`` names them in the plural."""

    @accepts({**array_schema({"enum": list(values)}, 1), "uniqueItems": True})
    def check(value: Any) -> tuple[T, ...]:
        if (
            not isinstance(value, list)
            or not value
            or any(item not in [*values] for item in value)
            or len(set(value)) < len(value)
        ):
            raise ValueError(Message("value-not-a-list", "expected a list of different {what}", what=what))
        return tuple(values[item] for item in value)

    return check


def bounded(expected: str, **limits: float) -> Callable[[Any], float]:
    """A number within limits, which have their names in a JSON schema (``minimum``, ``exclusiveMaximum``, ...)."""
    holds = {"minimum": ge, "exclusiveMinimum": gt, "maximum": le, "exclusiveMaximum": lt}

    @accepts({"type": "number", **limits})
    def check(value: Any) -> float:
        result = number(value)
        if not all(holds[name](result, limit) for name, limit in limits.items()):
            raise ValueError(Message("value-unexpected", "expected {expected}", expected=expected))
        return result

    return check


def share(most: float, whole: str) -> Callable[[Any], float]:
    """A number from 0 to ``most``, which is a share of ``whole`` (for the message)."""

    @accepts({"type": "number", "minimum": 0, "maximum": most})
    def check(value: Any) -> float:
        result = not_negative(value)
        if result > most:
            raise ValueError(
                Message("value-not-share", "expected a share of {whole} from 0 to {most:g}", whole=whole, most=most)
            )
        return result

    return check


@accepts(array_schema(accepted(number)))
def numbers(value: Any) -> tuple[float, ...]:
    """A list of finite numbers."""
    if not isinstance(value, list):
        raise ValueError(Message("value-not-numbers", "expected a list of numbers"))
    return tuple(number(item) for item in value)


def one_or_more(check: Callable[[Any], float]) -> Callable[[Any], float | tuple[float, ...]]:
    """A number that ``check`` accepts, or a list of them."""

    @accepts({"anyOf": [accepted(check), array_schema(accepted(check))]})
    def check_each(value: Any) -> float | tuple[float, ...]:
        return tuple(check(item) for item in value) if isinstance(value, list) else check(value)

    return check_each


@accepts({**array_schema(accepted(number), 3), "maxItems": 3})
def vector3(value: Any) -> tuple[float, float, float]:
    """Three finite numbers, for X, Y and Z."""
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(Message("value-not-three-numbers", "expected three numbers, for X, Y and Z"))
    x, y, z = (number(item) for item in value)
    return x, y, z


@accepts(array_schema(accepted(vector3), 1))
def vectors3(value: Any) -> tuple[tuple[float, float, float], ...]:
    """A list of tool offsets, each three finite numbers."""
    if not isinstance(value, list) or not value:
        raise ValueError(Message("value-not-offsets", "expected a list of tool offsets [[x, y, z], ...]"))
    return tuple(vector3(item) for item in value)


@accepts({**array_schema(accepted(number), 2), "maxItems": 2, "examples": [[0.0, 1.0]]})
def interval(value: Any) -> tuple[float, float]:
    """Two finite numbers, the lower one first."""
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(Message("value-not-two-numbers", "expected two numbers [lower, upper]"))
    lower, upper = number(value[0]), number(value[1])
    if lower >= upper:
        raise ValueError(Message("value-not-range", "expected a range [lower, upper] with the lower number first"))
    return lower, upper


@accepts({**array_schema(accepted(number), 2), "examples": [[0.0, 1.0]]})
def ascending(value: Any) -> tuple[float, ...]:
    """At least two numbers in ascending order."""
    items = numbers(value)
    if len(items) < 2 or any(b <= a for a, b in zip(items, items[1:], strict=False)):
        raise ValueError(Message("value-not-ascending", "expected at least two numbers in ascending order"))
    return items


@accepts({"type": "object"})
def table(value: Any) -> dict[str, Any]:
    """A table of keys and values."""
    if not isinstance(value, dict):
        raise ValueError(Message("value-not-section", "expected a table ([section])"))
    return value


@accepts({"type": "array", "items": {"type": "object"}})
def _tables(value: Any) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise ValueError(Message("value-not-sections", "expected an array of tables ([[section]])"))
    return value
