"""What a foreign file leaves open, as a question: which option answers it, the answers, what each means, which drawing helps.

Terminal, workbench and programs ask from the same object: the terminal prints :attr:`Question.text`, the workbench shows
:attr:`Question.reason` with a field for each of :attr:`Question.choices`, ``--json`` contains :meth:`Question.to_dict`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from compgen.data.names import AXES, CURVE_NAMES, describe_error, error_named
from compgen.errors import InputError
from compgen.foreign.answers import ImportOptions


@dataclass(frozen=True)
class Choice:
    """One answer: the value of the option, and what it means in words ("" if the value says it)."""

    value: str
    meaning: str = ""


@dataclass(frozen=True)
class Question:
    """Something that only the user knows about a file.

    Parameters
    ----------
    reason : what is open, in words without options.
    option : field of :class:`ImportOptions` that answers it; "" if the file has to be changed.
    choices : the answers; empty if it is typed.
    how : how it is answered on the command line.
    key : what stands before ``=`` in the option (``--unit deviation=um``: deviation), "" without.
    default : the likeliest of the choices, "" for none: nothing is chosen without the user.
    picture : name of the drawing that shows what the choices mean, "" for none.
    required : False if the file is used without an answer, too; the reason says what that costs.

    >>> asked = Question("the axis is not stated", "axis", choices_of(AXES), "give --axis X, Y or Z")
    >>> print(asked.text)
    the axis is not stated; give --axis X, Y or Z
    >>> asked.word(asked.choices[1])
    '--axis=Y'
    """

    reason: str
    option: str = ""
    choices: tuple[Choice, ...] = ()
    how: str = ""
    key: str = ""
    default: str = ""
    picture: str = ""
    required: bool = True

    @property
    def text(self) -> str:
        """The question on one line, with how it is answered on the command line."""
        return f"{self.reason}; {self.how}" if self.how else self.reason

    @property
    def flag(self) -> str:
        """The option as one types it, "" if none answers it."""
        return ImportOptions.flag(self.option) if self.option else ""

    def word(self, choice: Choice) -> str:
        """Return an answer as one word of a command."""
        return f"{self.flag}={self.key}={choice.value}" if self.key else f"{self.flag}={choice.value}"

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of ``--json``."""
        choices = [{"value": item.value, "meaning": item.meaning, "word": self.word(item)} for item in self.choices]
        return {
            "reason": self.reason, "option": self.flag, "key": self.key, "choices": choices, "default": self.default,
            "picture": self.picture, "required": self.required, "text": self.text,
        }  # fmt: skip


def choices_of(values: Sequence[str], meanings: Mapping[str, str] | None = None) -> tuple[Choice, ...]:
    """Return answers with what they mean."""
    return tuple(Choice(value, (meanings or {}).get(value, "")) for value in values)


class OpenColumnsError(InputError):
    """A table of which it is not clear which column is what: it is read once the user says that (``--map``)."""


@dataclass
class Asking:
    """Collects the questions about one file."""

    questions: list[Question] = field(default_factory=list, kw_only=True)

    def ask(
        self, reason: str, option: str = "", choices: Sequence[Choice] = (), how: str = "", *, key: str = "",
        default: str = "", picture: str = "", required: bool = True,
    ) -> None:  # fmt: skip
        """Add a question, once."""
        asked = Question(reason, option, tuple(choices), how, key, default, picture, required)
        if asked not in self.questions:
            self.questions.append(asked)


# Questions that several formats ask.

AXIS = choices_of(AXES)
_DIRECTIONS = {
    "labels": "as the file labels them",
    "motion": "from the order of the rows",
    "alternate": "odd runs upwards, even runs downwards",
}
_DATES = {"dmy": "day, month, year", "mdy": "month, day, year", "ymd": "year, month, day"}


def directions(*values: str) -> tuple[Choice, ...]:
    """Answers to how the direction of a run is known."""
    return choices_of(values, _DIRECTIONS)


def date_orders() -> tuple[Choice, ...]:
    """Answers to the order of day, month and year."""
    return choices_of(tuple(_DATES), _DATES)


def signs() -> tuple[Choice, ...]:
    """Answers to the sign of deviations."""
    return (
        Choice("error", "error: measured minus commanded"),
        Choice("correction", "correction: what has to be added"),
    )


def unit_choices(*names: str) -> tuple[Choice, ...]:
    """Answers to a unit."""
    return choices_of(names)


def errors_along(axis: str, *, angular: bool | None = None) -> tuple[Choice, ...]:
    """Answers to which error of an axis a file contains ("" for any axis): angles, lengths (``angular`` False) or both."""
    names = [name for name in CURVE_NAMES if name.endswith(axis or "")]
    return tuple(
        Choice(name, f"{name}: {describe_error(name)}")
        for name in names
        if angular is None or (error_named(name).kind == "angular") == angular
    )


LENGTH_UNITS, ANGLE_UNITS = ("um", "mm", "in"), ("urad", "arcsec", "mrad")
