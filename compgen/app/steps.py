"""The steps of a project as data that may come from anybody: what each kind contains, and the words of its commands.

Projects are exchanged between people, so ``project.json`` is read like a measurement: every key, type and length is checked, a
path stays in the folder of the project, and a command has only the options that the pages of the workbench give it. What
the pages themselves write passes the same checks before it is written.
"""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from compgen.data.toml_files import Section, flag, not_negative, whole
from compgen.errors import InputError, visible_line
from compgen.fitting.bounds import FitOptions
from compgen.foreign import ImportOptions
from compgen.resources import LANGUAGES
from compgen.units import UNITS

Check = Callable[[Any], Any]

#: A project file of another program version with another form is refused.
FORM = 1
#: Largest numbers of steps, of commands of a step, of words of a command, of entries of a list; longest texts.
MOST_STEPS, MOST_COMMANDS, MOST_WORDS, MOST_ITEMS = 99_999, 20, 10_000, 10_000
LONGEST_WORD, LONGEST_LINE, LONGEST_TEXT = 2_000, 10_000, 1_000_000
#: Deepest lists and tables within each other that a summary of a file may have.
DEEPEST = 20


@dataclass(frozen=True)
class Step:
    """One step: its command lines (words after ``volcomp``), its folder, the exit code, and facts of its kind."""

    number: int
    kind: str
    title: str
    commands: Sequence[Sequence[str]] = ()
    folder: str = ""
    exit_code: int = 0
    seconds: float = 0.0
    time: str = ""
    warnings: Sequence[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)


# Words: what may stand in a command, and in the facts of a step.


def line(value: Any) -> str:
    """A text on one line, which may be empty."""
    if (
        not isinstance(value, str)
        or len(value) > LONGEST_LINE
        or any(ord(char) < 32 or ord(char) == 127 for char in value)
    ):
        raise ValueError(f"expected one line of at most {LONGEST_LINE} characters")
    return value


def text(value: Any) -> str:
    """A text of any number of lines."""
    if not isinstance(value, str) or len(value) > LONGEST_TEXT or "\0" in value:
        raise ValueError(f"expected a text of at most {LONGEST_TEXT} characters")
    return value


def inside(value: Any) -> str:
    """A path within the folder of the project: parts that begin with a letter, a digit or ``_``, separated by ``/``."""
    if not isinstance(value, str) or len(value) > LONGEST_WORD or not re.fullmatch(r"\w[\w. -]*(/\w[\w. -]*)*", value):
        raise ValueError("is not in the folder of the project: expected a path such as 02-measurement/x.axis.csv")
    return value


def name(value: Any) -> str:
    """A name of a control, a dialect, a machine or an instrument."""
    if not isinstance(value, str) or not re.fullmatch(r"\w[\w. -]{0,199}", value):
        raise ValueError("expected a name of letters, digits, blanks, dots and hyphens")
    return value


def machine_word(value: Any) -> str:
    """A machine file in the folder of the project, or the name of a shipped machine."""
    return inside(value) if isinstance(value, str) and value.endswith(".toml") else name(value)


def typed(value: Any) -> str:
    """What somebody typed: any printed characters, one word of a command behind an equals sign."""
    if len(line(value)) > LONGEST_WORD:
        raise ValueError(f"expected one line of at most {LONGEST_WORD} characters")
    return str(value)


def language(value: Any) -> str:
    """A language of the pages."""
    if value not in LANGUAGES:
        raise ValueError(f"expected one of {', '.join(LANGUAGES)}")
    return str(value)


def units(value: Any) -> str:
    """Units of the pages."""
    if value not in UNITS:
        raise ValueError(f"expected one of {', '.join(UNITS)}")
    return str(value)


# Commands: which words the pages give them.


@dataclass(frozen=True)
class Syntax:
    """Words of a command: checks of its positional words (the last one may be repeated) and of the values of its options.

    An option with the check None has no value. ``several``: the last positional word may be there any number of times,
    or not at all.
    """

    words: tuple[Check, ...]
    options: Mapping[str, Check | None]
    several: bool = False


def _option_names(kind: type) -> list[str]:
    """Return the options that a dataclass declares, without their hyphens."""
    names = [item.metadata["name"] or f"--{item.name.replace('_', '-')}" for item in fields(kind) if item.metadata]
    return [name.removeprefix("--") for name in names]


#: Answers to what a file leaves open, and what a form says about smoothing and bounds: options of ``import`` and ``fit``.
ANSWERS, FIT_FIELDS = tuple(_option_names(ImportOptions)), tuple(_option_names(FitOptions))
#: What one types for an NC program, and which of it only its correction takes: options of ``volcomp correct``.
CORRECT_FIELDS = ("tolerance-um", "shortest-mm", "decimals", "only")
PROGRAM_FIELDS = ("dialect", "wcs", "gauge", "keep-unknown", "integers", "increment-mm", "tables", *CORRECT_FIELDS)
#: Numbers known without a file.
NUMBERS = ("squareness", "backlash", "scale")
#: What the form for the report asks, with section and key of ``certificate.toml``.
CERTIFICATE_FIELDS = {
    "customer": ("customer", "name"), "customer_city": ("customer", "city"), "order": ("certificate", "order"),
    "number": ("certificate", "number"), "laboratory": ("laboratory", "name"), "laboratory_city": ("laboratory", "city"),
    "manufacturer": ("machine", "manufacturer"), "model": ("machine", "model"), "serial": ("machine", "serial_number"),
    "place": ("certificate", "place"), "person": ("person", "name"),
}  # fmt: skip
#: Further fields of that form: instruments, a line for each with name; serial number; certificate, and conditions.
CERTIFICATE_LISTS = ("instruments", "air_low", "air_high", "machine_low", "machine_high")
_OUT: dict[str, Check | None] = {"out": inside}
_PAGES: dict[str, Check | None] = {**_OUT, "language": language, "units": units}
_READINGS: dict[str, Check | None] = {**dict.fromkeys(NUMBERS, typed), "instrument": inside}
_FIT: dict[str, Check | None] = {**dict.fromkeys(FIT_FIELDS, typed), "robust": None}
_PROGRAM: dict[str, Check | None] = {
    **_PAGES, **dict.fromkeys(("gauge", "keep-unknown", "wcs", "increment-mm"), typed), "integers": name,
    **dict.fromkeys(("errors", "reversal", "tools"), inside),
    "dialect": name, "block-delete": None,
}  # fmt: skip
COMMANDS: Mapping[str, Syntax] = {
    "init": Syntax((name,), {**_OUT, "chain": typed, "travel": typed, "control": name, "json": None}),
    "check": Syntax((inside,), {"kind": name, "json": None}),
    "plan": Syntax((machine_word,), {**_PAGES, "circle": typed, "poses": typed, "grid": None,
                                     **dict.fromkeys(("artefact", "stations", "points"), inside)}),
    "import": Syntax((inside,), {**_OUT, **dict.fromkeys(ANSWERS, typed), "machine": machine_word, "json": None}),
    "accuracy": Syntax((machine_word, inside), _PAGES),
    "identify": Syntax((machine_word, inside), {**_OUT, **_READINGS}, several=True),
    "report": Syntax((inside,), {"language": language, "units": units, "dcc": inside, "certificate": inside}),
    "diagnose": Syntax((machine_word, inside), {**_PAGES, "instrument": inside}, several=True),
    "options": Syntax((machine_word, inside), _PAGES),
    "run": Syntax((machine_word, inside), {
        **_PAGES, **_READINGS, **_FIT, "controller": name, "certificate": inside, "allow-unverified": None, "allow-misfit": None,
        **dict.fromkeys(("active", "style-from", "template-from"), inside)}, several=True),
    "verify": Syntax((machine_word, inside), {**_OUT, "controller": name, "errors": inside}, several=True),
    "part": Syntax((machine_word, inside), {**_PROGRAM, "tables": inside, "controller": name}),
    "fit": Syntax((machine_word, inside), {**_OUT, **_FIT}),
    "correct": Syntax((machine_word, inside), {
        **_PROGRAM, **dict.fromkeys(CORRECT_FIELDS, typed), "active": inside, "active-controller": name}),
    "compare": Syntax((machine_word, inside, inside), {**_PAGES, "instrument": inside, "align": name}),
    "recal add": Syntax((name,), {"machine": machine_word, "inbox": inside, "controller": name, "out": inside,
                                  "measured-with": name, "job": inside}),
}  # fmt: skip


@dataclass(frozen=True)
class Command:
    """A command whose words have been checked: its name, its options with their values, its positional words."""

    name: str
    options: Sequence[tuple[str, str | None]]
    words: Sequence[str]

    @classmethod
    def of(cls, words: Sequence[str]) -> Command:
        """Check the words of a command; ValueError for any that the pages do not give it."""
        size = 2 if words[:1] == ["recal"] else 1
        called = " ".join(words[:size])
        syntax = COMMANDS.get(called)
        if syntax is None:
            raise ValueError(f"{visible_line(called)[:40]!r} is not a command of the workbench")
        options: list[tuple[str, str | None]] = []
        found: list[str] = []
        rest = iter(words[size:])
        for word in rest:
            if not word.startswith("-"):
                found.append(word)
                continue
            option, equals, value = word.removeprefix("--").partition("=")
            if option not in syntax.options or not word.startswith("--"):
                raise ValueError(f"{visible_line(word)[:40]!r} is not an option that the workbench gives to {called}")
            check = syntax.options[option]
            if check is None:
                if equals:
                    raise ValueError(f"--{option} has no value")
                options.append((option, None))
                continue
            given = value if equals else next(rest, "")
            if not equals and given.startswith("-"):
                raise ValueError(f"--{option} needs a value")
            options.append((option, check(given)))
        checks = [*syntax.words, *[syntax.words[-1]] * (len(found) - len(syntax.words))]
        least, most = len(syntax.words) - syntax.several, len(found) if syntax.several else len(syntax.words)
        if not least <= len(found) <= most:
            raise ValueError(f"{called} has {len(found)} words; expected {len(syntax.words)}")
        return cls(called, options, [check(word) for check, word in zip(checks, found, strict=False)])

    @property
    def started(self) -> list[str]:
        """The words as the command is started: no positional word can be taken for an option."""
        options = [f"--{option}" if value is None else f"--{option}={value}" for option, value in self.options]
        return [*self.name.split(), *options, *(["--", *self.words] if self.words else [])]

    @property
    def paths(self) -> list[str]:
        """The words that are paths in the project."""
        syntax = COMMANDS[self.name]
        checks = [*syntax.words, *[syntax.words[-1]] * len(self.words)]
        found = [word for check, word in zip(checks, self.words, strict=False) if _is_path(check, word)]
        return found + [value for option, value in self.options if value and _is_path(syntax.options[option], value)]


def _is_path(check: Check | None, word: str) -> bool:
    return check is inside or (check is machine_word and word.endswith(".toml"))


def command_line(words: Sequence[str]) -> str:
    """Return a command as one would type it."""
    return shlex.join(["volcomp", *words])


def words_of_command(value: Any) -> list[str]:
    """The words of a command of the workbench."""
    if not isinstance(value, list) or not 0 < len(value) <= MOST_WORDS:
        raise ValueError("expected a list of words")
    Command.of([typed(item) for item in value])
    return value


# Facts: what each kind of step keeps.


def listed(check: Check) -> Check:
    """A list of values."""

    def each(value: Any) -> list[Any]:
        if not isinstance(value, list) or len(value) > MOST_ITEMS:
            raise ValueError(f"expected a list of at most {MOST_ITEMS} entries")
        return [check(item) for item in value]

    return each


def named(keys: Sequence[str], check: Check) -> Check:
    """A table with some of these keys."""

    def each(value: Any) -> dict[str, Any]:
        if not isinstance(value, dict) or not set(value) <= set(keys):
            raise ValueError(f"expected a table with keys of {', '.join(keys)}")
        return {key: check(item) for key, item in value.items()}

    return each


def anything(value: Any, depth: int = DEEPEST) -> Any:
    """Values of any kind, not too deep within each other."""
    if depth == 0:
        raise ValueError(f"expected at most {DEEPEST} lists and tables within each other")
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        anything(item, depth - 1)
    return value


def summary(value: Any) -> Any:
    """What ``volcomp import`` says about a file: the pages read some of its keys, the others are shown as they are."""
    if not isinstance(value, dict):
        raise ValueError("expected a table")
    known: dict[str, Check] = {"kind": line, "doubts": listed(text), "notes": listed(text)}
    for key, check in known.items():
        check(value.get(key))
    understood, machine = value.get("understood"), value.get("machine")
    if not isinstance(understood, dict) or not isinstance(machine, dict | None):
        raise ValueError("expected what was understood of the file, as a table")
    if machine is not None:
        listed(text)(machine.get("outside", []))
    listed(_question)(value.get("questions", []))
    if not isinstance(understood.get("columns", {}), dict):
        raise ValueError("expected the columns of the file as a table")
    return anything(value)


def _question(value: Any) -> Any:
    """A question about a file as ``volcomp import --json`` writes it; its answers are options of that command."""
    if not isinstance(value, dict) or not isinstance(value.get("required"), bool):
        raise ValueError("expected a question about a file")
    for key in ("reason", "option", "key", "default", "picture"):
        text(value.get(key))
    for choice in listed(_table)(value.get("choices")):
        text(choice.get("value"))
        text(choice.get("meaning"))
        answer(choice.get("word"))
    return value


def answer(value: Any) -> str:
    """An option of ``volcomp import`` that answers what a file leaves open, with its value."""
    option, equals, _ = typed(value).partition("=")
    if not equals or option.removeprefix("--") not in ANSWERS or not option.startswith("--"):
        raise ValueError("expected an option of volcomp import with its value")
    return str(value)


def option_text(value: Any) -> str:
    """A file in the folder of the project, or nothing."""
    return "" if value == "" else inside(value)


@dataclass(frozen=True)
class Kind:
    """A kind of step: the commands that it may have, and the facts that it needs and may have, with their checks."""

    commands: Sequence[str] = ()
    needs: Mapping[str, Check] = field(default_factory=dict)
    may: Mapping[str, Check] = field(default_factory=dict)


_NUMBER = whole(1, MOST_STEPS)
KINDS: Mapping[str, Kind] = {
    "machine": Kind(("init", "check"), {"machine": machine_word},
                    {"meaning": text, "by_hand": listed(text), "remarks": listed(text)}),
    "instrument": Kind(("check",), {"file": inside}, {"remarks": listed(text)}),
    "plan": Kind(("plan",), {"typed": named(("circles", "poses"), line)}),
    "measurement": Kind(("import",), {"file": inside, "used": listed(inside), "summary": summary, "answers": listed(answer)},
                        {"after": flag, "answers_to": _NUMBER}),
    "removed": Kind((), {"measurement": _NUMBER}, {"after": flag}),
    "numbers": Kind((), {"numbers": named(NUMBERS, listed(typed))}),
    "accuracy": Kind(("accuracy",), {}, {"sheet_of": _NUMBER}),
    "identify": Kind(("identify", "report")),
    "diagnose": Kind(("diagnose",)),
    "options": Kind(("options",)),
    "certificate": Kind(("report",), {"certificate": inside, "stated": named((*CERTIFICATE_FIELDS, *CERTIFICATE_LISTS), text)}),
    "run": Kind(("run",), {"control": name}, {"fit": named(FIT_FIELDS, line)}),
    "verify": Kind(("verify",), {"control": name}),
    "program": Kind((), {"program": inside, "typed": named(PROGRAM_FIELDS, line)},
                    {"tools": option_text, "block-delete": flag, "by_hand": listed(text)}),
    "part": Kind(("part",)),
    "correct": Kind(("fit", "correct")),
    "compare": Kind(("identify", "compare", "report")),
    "recal": Kind(("recal add",), {}, {"added": text, "machine_there": line}),
}  # fmt: skip


def _kind(value: Any) -> str:
    if not isinstance(value, str) or value not in KINDS:
        raise ValueError(f"expected a kind of step: {', '.join(KINDS)}")
    return value


def _folder(value: Any) -> str:
    if value != "" and not re.fullmatch(r"[0-9]{2,6}-[a-z]+", inside(value)):
        raise ValueError("expected the folder of a step, such as 03-identify")
    return str(value)


# The whole list.


def read_steps(content: bytes, path: Path) -> tuple[int, tuple[Step, ...]]:
    """Return the revision of a project and its steps; InputError with step and key for whatever the pages do not write."""
    try:
        found = json.loads(content, parse_constant=_no_number)
        if not isinstance(found, dict) or "form" not in found:
            raise ValueError("it has no form")
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not the list of steps of a project: {error}", file=path) from error
    root = Section(found, path=path)
    if root.take("form", anything) != FORM:
        raise InputError(f"has the form {str(found['form'])[:20]}; this program reads form {FORM}", file=path)
    revision, steps = root.take("revision", whole(0, 2**53)), root.take("steps", listed(_table))
    root.finish()
    made: list[Step] = []
    for place, item in enumerate(steps, start=1):
        section = Section(item, path=path, name=f"step {place}")
        made.append(_step(section))
        if len(made) > 1 and made[-1].number <= made[-2].number:
            raise section.fail("number", "expected numbers that grow from step to step")
    return revision, tuple(made)


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not a number")


def _table(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("expected a table")
    return value


def _step(section: Section) -> Step:
    step = Step(
        number=section.take("number", _NUMBER),
        kind=section.take("kind", _kind),
        title=section.take("title", text),
        commands=section.take("commands", listed(words_of_command), []),
        folder=section.take("folder", _folder, ""),
        exit_code=section.take("exit_code", whole(0, 255), 0),
        seconds=section.take("seconds", not_negative, 0.0),
        time=section.take("time", line, ""),
        warnings=section.take("warnings", listed(text), []),
        data=section.take("data", _table, {}),
    )
    section.finish()
    if step.folder and int(step.folder.partition("-")[0]) != step.number:
        raise section.fail("folder", "expected the folder with the number of the step")
    kind = KINDS[step.kind]
    for words in step.commands:
        if Command.of(words).name not in kind.commands:
            raise section.fail("commands", f"volcomp {words[0]} does not belong to a step of the kind {step.kind}")
    _check_facts(Section(step.data, path=section.path, name=f"{section.name} data"), kind, step)
    return step


def _check_facts(data: Section, kind: Kind, step: Step) -> None:
    """Check the facts of a step; a measurement that nobody has read has none."""
    if step.kind == "measurement" and not step.data:
        return
    for key, check in kind.needs.items():
        data.take(key, check)
    for key, check in kind.may.items():
        data.take(key, check, None)
    data.finish()
