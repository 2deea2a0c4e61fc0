"""The few exceptions of compgen, each with the data that a caller needs to react; helpers for messages and texts of users."""

from __future__ import annotations

import difflib
import math
import re
import unicodedata
from collections.abc import Hashable, Iterable, Mapping
from pathlib import Path
from string import Formatter
from typing import Any, TypeVar

Item = TypeVar("Item", bound=Hashable)
#: Characters that a terminal interprets instead of showing, or that change the direction of a line; not line end and
#: tab.
_OBEYED = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]"
)


class Message(str):
    """A sentence for people as data: the English text, the code that programs may rely on, its template and its values.

    It is the text wherever a text is due. What shows it in another language translates the template and fills in the values,
    so that a path or a name of the user's is never taken for words; JSON lists code and values beside the text. Texts may
    change, codes do not.

    Parameters
    ----------
    code : words joined by hyphens, e.g. ``"file-not-found"``.
    template : the English sentence with named places as in :meth:`str.format`, e.g. ``"{path}: expected {count:d} rows"``.
    values : what is filled in; another message is translated with the sentence around it.

    Examples
    --------
    >>> said = Message("row-count", "{path}: expected {count:d} rows", path="new data.csv", count=7)
    >>> said, said.code, said.values["path"]
    ('new data.csv: expected 7 rows', 'row-count', 'new data.csv')
    >>> said.filled("{path}: {count} Zeilen erwartet")
    'new data.csv: 7 Zeilen erwartet'
    """

    code: str
    template: str
    values: dict[str, Any]

    def __new__(cls, code: str, template: str, /, **values: Any) -> Message:
        """Fill the values into the template."""
        made = super().__new__(cls, template.format(**values))
        made.code, made.template, made.values = code, template, values
        return made

    def __getnewargs_ex__(self) -> tuple[tuple[str, str], dict[str, Any]]:
        """Let worker processes send messages: values as they are shown."""
        literal = "".join(
            text.replace("{", "{{").replace("}", "}}") + (f"{{{name}}}" if name is not None else "")
            for text, name, _, _ in Formatter().parse(self.template)
        )
        return (self.code, literal), self.shown()

    @property
    def sentence(self) -> str:
        """The template as catalogues of texts list it: places without formats, braces of the text as they are read."""
        return "".join(
            text + (f"{{{name}}}" if name is not None else "") for text, name, _, _ in Formatter().parse(self.template)
        )

    def shown(self) -> dict[str, Any]:
        """Return each value as it stands in the text; messages, and errors that carry one, stay messages."""
        return {
            name: message_of(self.values[name])
            or (f"{{0!{how}:{form}}}" if how else f"{{0:{form}}}").format(self.values[name])
            for _, name, form, how in Formatter().parse(self.template)
            if name is not None
        }

    def filled(self, sentence: str, **translated: str) -> str:
        """Return another sentence with the same values; ``translated`` replaces some of them."""
        values = {**self.shown(), **translated}
        return re.sub(r"\{(\w+)\}", lambda place: str(values.get(place[1], place[0])), sentence)

    def data(self) -> dict[str, Any]:
        """Return code, text and values as JSON lists them."""
        return {"code": self.code, "text": str(self), "values": {name: str(v) for name, v in self.shown().items()}}


def message_of(value: object) -> Message | None:
    """Return a message, or the one that an exception carries; None for anything else."""
    if isinstance(value, CompgenError | ValueError | CompgenWarning):
        value = value.said if isinstance(value, InputError) else value.args[0] if value.args else None
    return value if isinstance(value, Message) else None


def messages_of(texts: Iterable[object]) -> dict[str, Any]:
    """Return the entry ``messages`` of a JSON object: code, text and values of each text that is a message.

    >>> messages_of(["a plain text", Message("no-file", "no file {path}", path="a.csv")])
    {'messages': [{'code': 'no-file', 'text': 'no file a.csv', 'values': {'path': 'a.csv'}}]}
    """
    found = []
    for said in filter(None, map(message_of, texts)):
        core = message_of(said.values["message"]) if said.code == "at-place" else said
        where = {
            name: said.values[name] for name in ("place", "field") if said.code == "at-place" and name in said.values
        }
        if core is not None:
            found.append({**core.data(), "text": str(said), "values": {**where, **core.data()["values"]}})
    return {"messages": found} if found else {}


class CompgenError(Exception):
    """Base of every error that compgen raises on purpose; the command line turns it into ``exit_code``.

    Examples
    --------
    >>> import compgen
    >>> try:
    ...     compgen.load_machine("no-such-machine")
    ... except compgen.CompgenError as error:
    ...     print(type(error).__name__, error.exit_code)
    InputError 2
    """

    exit_code = 2


class InputError(CompgenError, ValueError):
    """Something that the user gave cannot be used.

    Parameters
    ----------
    message : what was given, what is allowed, what to do.
    file, line, field : where it is, as far as known; they are put in front of the message.

    Examples
    --------
    >>> import compgen
    >>> error = compgen.InputError("expected a number, found 'ten'", file="mill.toml", line=7, field="nodes")
    >>> print(error)
    mill.toml:7: nodes: expected a number, found 'ten'
    """

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        line: int | None = None,
        field: str | None = None,
    ) -> None:
        self.message, self.file, self.line, self.field = message, file, line, field
        place = visible(str(file), flat=True) if file is not None else ""
        if line is not None:
            place += f":{line}" if place else f"line {line}"
        parts = {"place": place, "field": field or "", "message": message}
        used = [name for name in parts if parts[name] or name == "message"]
        template = ": ".join(f"{{{name}}}" for name in used)
        #: The whole sentence: the message, behind place and field as far as they are known.
        self.said = Message("at-place", template, **{name: parts[name] for name in used}) if len(used) > 1 else message
        super().__init__(self.said)


class UndeterminedError(CompgenError):
    """The data do not determine the requested unknowns; ``combinations`` says in words what is missing.

    Examples
    --------
    >>> import numpy as np
    >>> import compgen
    >>> machine, r = compgen.load_machine("zha-gantry"), compgen.read_lengths("examples/zha-gantry.lengths.csv")
    >>> k = np.flatnonzero((r.position_mm[:, 1:] == 0.0).all(axis=1))  # readings along one line only
    >>> few = compgen.Lengths(r.stations, r.station[k], tuple(r.point[i] for i in k), r.position_mm[k], r.length_mm[k])
    >>> try:
    ...     compgen.identify(machine, few)
    ... except compgen.UndeterminedError as error:
    ...     print(len(error.combinations) > 0)
    True
    """

    exit_code = 1

    def __init__(self, message: str, combinations: list[str]) -> None:
        self.combinations = combinations
        super().__init__(message)


class ConvergenceError(CompgenError):
    """An iteration did not converge; its result must not be used.

    Examples
    --------
    >>> import compgen
    >>> issubclass(compgen.ConvergenceError, compgen.CompgenError)
    True
    """

    exit_code = 1


class CompgenWarning(UserWarning):
    """Something the user should know that does not stop the work.

    Examples
    --------
    >>> import warnings
    >>> import numpy as np
    >>> import compgen
    >>> machine = compgen.load_machine("zha-gantry")
    >>> errors = compgen.read_errors("examples/zha-gantry.truth.errors.csv")
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", compgen.CompgenWarning)
    ...     try:
    ...         compgen.predict(machine, errors, compgen.Points(np.array([[50.0, 0.0, 0.0]])))
    ...     except compgen.CompgenWarning as warning:
    ...         print("outside the travel:", str(warning)[:3])
    outside the travel: EXX
    """


# Helpers for messages, and for texts from users.


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


def program_text(text: object) -> str:
    """Return ``text`` with what may stand in a comment or message of an NC program: nothing that ends it or acts.

    >>> program_text("mill (5%) G0; #1=2")
    'mill  5   G0   1=2'
    """
    plain = unicodedata.normalize("NFKD", str(text)).encode("ascii", "ignore").decode()
    return "".join(char if char.isalnum() or char in " .,:=+-_/" else " " for char in plain)


def number_text(value: object, digits: int = 3, missing: str = "–") -> str:
    """A number with ``digits`` decimals; ``missing`` for None, nan, infinity and non-numbers.

    >>> number_text(1.5), number_text(None), number_text(float("nan"), missing="not known")
    ('1.500', '–', 'not known')
    """
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        return missing
    return f"{value:.{digits}f}"


def um_text(value: float | None, whole_from: float = 1000.0, u_um: float | None = None) -> str:
    """A figure in um: two decimals below 10, none from ``whole_from`` on, a dash for None.

    With an expanded uncertainty ``u_um``, of which two digits count, no more decimals than these; a figure that is then zero
    is said to be smaller than the last digit.

    >>> um_text(0.157), um_text(42.34), um_text(1714.6), um_text(None)
    ('0.16', '42.3', '1715', '–')
    >>> um_text(42.34, u_um=16.3), um_text(0.157, u_um=3.26), um_text(0.002, u_um=6.1)
    ('42', '0.2', '<0.1')
    """
    size = 0.0 if value is None else abs(value)
    digits = 2 if size < 9.995 else 1 if size < whole_from - 0.05 else 0
    if value is None or u_um is None or not (math.isfinite(u_um) and u_um > 0.0):
        return number_text(value, digits)
    digits = min(digits, max(0, 1 - math.floor(math.log10(u_um))))
    if 0.0 < size < 0.5 * 10.0**-digits:
        return f"<{10.0**-digits:g}"
    return number_text(value, digits)
