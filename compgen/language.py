"""Texts of pages and lists in another language than English: its catalogue, sentences with values in them, templates.

Programs and files speak English; results are kept in English, too (every JSON file). Another language is needed only where
something is shown: a template is translated when it is loaded, and every text that is filled into it when it is filled
in. The catalogue is that of gettext. Nothing in this module is used, or imported, for English.

A message of the catalogue is a whole sentence with named places, ``"set {number} is incomplete"``, or a whole part of a
template (:func:`parts`), whose German form contains the same expressions.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, lru_cache
from gettext import GNUTranslations
from html import escape, unescape
from typing import TYPE_CHECKING, Any

from compgen.errors import InputError, Message, nearest
from compgen.resources import LANGUAGES, data_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from jinja2 import BaseLoader, Environment

    from compgen.drawing.charts import Picture

#: Context of single words in the catalogue. They are translated only where a page shows them as a word, because a word in a
#: text may be a key or a value that has to be typed as it is (``sign = "error"``).
WORD = "word"
#: Context of headings and names of facts, which are translated only as such: as the name of a key they must not be.
LABEL = "label"
#: Context of parts of templates: they are no values.
PART = "part"

_PLACE = re.compile(r"\{(\w+)\}")
_TOKEN = re.compile(
    r"(\{#.*?#\}|\{%.*?%\}|\{\{.*?\}\}|<!.*?>|<style.*?</style>|<script.*?</script>|</?[a-zA-Z][^>]*>)", re.DOTALL
)
_INLINE = re.compile(r"</?(strong|em|b|i|code|span|br|small|sub|sup)\b")
_BRANCH = re.compile(r"\{%-?\s*(if|elif|else|endif)\b")
_ONLY_STATEMENTS = re.compile(r"\s*(\{%((?!%\}).)*%\}\s*|\{#.*?#\}\s*)+$")
_MARKER = re.compile(r"\s*(#+ |\d+\. |[-*] (\[ \] )?|)")
#: What begins a line of a text for the terminal or of a list.
MARKER = re.compile(r"\s*(?:[-*#]+ (?:\[ \] )?)?")
#: What is the same in every language: code, units, names of standards.
_CODE = re.compile(r"`[^`]*`|<code>.*?</code>")
_UNREAD = re.compile(r"\b(mm|um|µm|ISO|SHA|En|rms)\b")
_WORDS = re.compile(r"[^\W\d_]{2,}")
_COUNTED = re.compile(r"([\d.]+ )?(.*)", re.DOTALL)
#: A message with fewer letters of its own is looked for only in texts that are shorter than this.
_SURE, _SHORT = 10, 120
#: A message with fewer letters, e.g. "{low} to {high}", is taken only if its values are numbers and names, or known.
_WEAK, _LOWER = 5, re.compile(r"(?:^|\s)[a-z]{3,}(?:$|[\s,;:.])")
_LETTERS = re.compile(r"[a-z]{2,}")
_SENTENCES, _CLAUSES = re.compile(r"(?<=[.!?]) (?=\S)"), re.compile(r"(?<=;) (?=\S)")
_COMMAS = re.compile(r"(?<=,) (?=\S)")
_REMARK = re.compile(r" (?=\([^()]*\)$)")
_AFTER_COLON = re.compile(r"(?<=:) (?=\S)")
#: Several words in small letters, as only sentences have them.
_PROSE = re.compile(r"\b[a-z]{2,},? [a-z]{2,}\b")
#: Lists are wrapped at this column; rows of tables and headings are not.
_COLUMN = 120


def checked_language(name: str) -> str:
    """Return the name of a language, e.g. ``"de"``; ValueError for one that has no catalogue.

    >>> checked_language("de")
    'de'
    """
    if name not in LANGUAGES:
        raise ValueError(f"is not a language of the pages; {nearest(name, LANGUAGES)}")
    return name


@lru_cache(maxsize=4)
def texts_of(language: str) -> Texts:
    """Return the texts of a language; InputError for one that has no catalogue."""
    try:
        path = data_folder("templates") / "_language" / f"{checked_language(language)}.mo"
    except ValueError as error:
        raise InputError(f"{language!r} {error}", field="language") from error
    with path.open("rb") as file:
        return Texts(vars(GNUTranslations(file))["_catalog"], language)


class Texts:
    """The catalogue of one language, from English messages to their translation.

    >>> german = Texts({"{count} points of {name}": "{count} Punkte von {name}", "the first axis": "die erste Achse"})
    >>> german.text("12 points of the first axis")
    '12 Punkte von die erste Achse'
    >>> german.text("a text without a translation")
    'a text without a translation'
    """

    def __init__(self, messages: dict[str, str], language: str = "de") -> None:
        self.language = language
        self.messages = {english: text for english, text in messages.items() if english and text}
        for end in ("; ", ", "):  # what is appended to a sentence is also found apart from it
            for english, text in tuple(self.messages.items()):
                if english.startswith(end) and text.startswith(end):
                    self.messages.setdefault(english.removeprefix(end), text.removeprefix(end))
        found = []
        for english in self.messages:
            literals = _PLACE.split(english)[::2]
            if len(literals) > 1 and "\x04" not in english and any(map(str.isalpha, english)):
                letters = sum(map(str.isalpha, "".join(literals)))
                found.append((letters, max(literals, key=len), english))
        # the more of a text is in the message itself, the surer is the message
        self._patterns = sorted(found, key=lambda item: (-item[0], -len(item[2])))
        self._known: dict[tuple[str, int], str | None] = {}

    def text(self, english: str, least: int = 0) -> str:
        """Return a text in this language; sentences that the catalogue does not contain stay in English.

        Values within a sentence are translated in the same way, and those that are sentences must be known, too: a
        sentence is never a mixture of two languages. Messages with fewer than ``least`` letters of their own are only
        looked for in values, and between numbers.
        """
        if isinstance(english, Message):
            return self.message(english)
        found = self._complete(english, least)
        if found is None:
            found = " ".join(self._part(piece, least) or piece for piece in _SENTENCES.split(english))
        name = english.partition(": ")[0]  # a heading before several sentences
        if found != english and name in self._headings and found.startswith(f"{name}: "):
            found = self._headings[name] + found[len(name) :]
        return found

    def message(self, said: Message) -> str:
        """Return a message in this language: its sentence is looked up, its values are filled in.

        What a user named (paths, columns, cells) stays as it is, whatever words it has.

        >>> german = Texts({"no file {path}": "keine Datei {path}"})
        >>> german.message(Message("no-file", "no file {path}", path="data of the last week.csv"))
        'keine Datei data of the last week.csv'
        """
        sentence = said.sentence
        known = self.messages.get(sentence)
        if known is None and _LETTERS.search(_PLACE.sub(" ", sentence)):  # in English, or known as parts
            return self.text(str(said))
        # the place is a path of the user's, whatever words it has
        values = {name: value if name == "place" else self._value(value) for name, value in said.shown().items()}
        return said.filled(sentence if known is None else known, **values)

    def _value(self, value: str) -> str:
        """Return what is filled into a message: messages and words of the program in this language, all else as it is."""
        if isinstance(value, Message):
            return self.message(value)
        return self._word(value) or self._complete(value) or value

    def label(self, english: str) -> str:
        """Return a text that may be a single word, e.g. of a picture or a verdict, a heading, or a number with one."""
        if isinstance(english, Message):
            return self.message(english)
        core = english.strip()
        known = self._word(core) or self.messages.get(f"{LABEL}\x04{core}")
        return self.text(english) if known is None else english.replace(core, known)

    def _word(self, english: str) -> str | None:
        number, word = _COUNTED.fullmatch(english).groups()  # type: ignore[union-attr]
        known = self.messages.get(f"{WORD}\x04{word.strip()}")
        return None if known is None or not word.strip() else (number or "") + word.replace(word.strip(), known)

    def _complete(self, english: str, least: int = 0) -> str | None:
        """Return a text in this language, as it is if it contains no sentence; None if a sentence has no translation."""
        if (english, least) not in self._known:
            if len(self._known) > 20_000:
                self._known.clear()
            core = english.strip()
            found = self._of_verdict(core, least) or self._whole(core, least) or self._by_parts(core, least)
            found = found or (None if _PROSE.search(core) else core)
            self._known[english, least] = None if found is None else english.replace(core, found) if core else english
        return self._known[english, least]

    def _whole(self, english: str, least: int) -> str | None:
        known = self.messages.get(english)
        if known is None and " " in english:
            known = self._matched(english, least)
        if (
            known is None and english[:1].isupper() and not english[1:2].isupper()
        ):  # a message that begins a line of a page
            known = self._whole(english[0].lower() + english[1:], least)
            return None if known is None else known[0].upper() + known[1:]
        return known

    def _matched(self, english: str, least: int) -> str | None:
        for letters, longest, message in self._patterns:
            if longest not in english or (letters < _SURE and len(english) > _SHORT):
                continue
            for pattern in _patterns(message):
                if match := pattern.fullmatch(english):
                    texts = match.groupdict()
                    if any(self._is_verdict(name) for text in texts.values() for name in text.split(": ")[:-1]):
                        continue  # a verdict and its sentence are translated one after the other
                    if (
                        message.endswith(("} um", "} urad"))
                        and letters < _WEAK
                        and any(", " in t for t in texts.values())
                    ):
                        continue  # each item of a list of sizes by itself
                    if letters < least and any(_LETTERS.search(text) for text in texts.values()):
                        continue
                    values = {name: self._word(text) or self._complete(text) for name, text in texts.items()}
                    if None in values.values():
                        continue
                    if letters < _WEAK and any(
                        not text or (values[name] == text and _LOWER.search(text)) for name, text in texts.items()
                    ):
                        continue
                    return _PLACE.sub(lambda place, values=values: values[place[1]], self.messages[message])  # type: ignore[misc]
        return None

    def _is_verdict(self, english: str) -> bool:
        return self._word(english) is not None

    @cached_property
    def _headings(self) -> dict[str, str]:
        """What stands before the colon of messages that are one value behind a heading, ``next measurement: {text}``."""
        both = ((english.rpartition(": {"), text.rpartition(": {")) for english, text in self.messages.items())
        return {
            one[0]: other[0]
            for one, other in both
            if one[1] and other[1] and "{" not in one[0] and re.fullmatch(r"\w+\}", one[2]) and "\x04" not in one[0]
        }

    def _of_verdict(self, english: str, least: int) -> str | None:
        """Translate a verdict of several words, e.g. "accepted with reservations", and what follows its colon."""
        verdict, _, rest = english.partition(": ")
        if rest and " " not in verdict and self._word(verdict) is None:  # the control before it
            found = self._of_verdict(rest, least)
            return None if found is None else f"{verdict}: {found}"
        if not rest or " " not in verdict or self._word(verdict) is None:
            return None
        found = self._complete(rest, least)
        return None if found is None else f"{self._word(verdict)}: {found}"

    def _by_parts(self, english: str, least: int) -> str | None:
        """Translate a name and what follows its colon, several sentences, or parts between semicolons or commas."""
        name, _, rest = english.partition(": ")
        known = self._of_verdict(rest, least) or self._whole(rest, least)
        if known is not None and not _PROSE.search(name):
            return f"{self._word(name) or self._headings.get(name, name)}: {known}"
        for end in (_SENTENCES, _REMARK, _CLAUSES, _AFTER_COLON, _COMMAS):
            pieces = end.split(english)
            found: list[str | None] = []
            first = 0
            while first < len(pieces) > 1 and None not in found:
                last = len(pieces) - (first == 0)
                while last > first + 1 and self._ended(" ".join(pieces[first:last]), least) is None:
                    last -= 1  # a message may have several sentences itself
                found.append(self._part(" ".join(pieces[first:last]), least))
                first = last
            if found and None not in found and found != pieces:
                return " ".join(found)  # type: ignore[arg-type]
        return None

    def _ended(self, english: str, least: int) -> str | None:
        """Return the translation of a whole message, also where its end is followed by what separates it from others."""
        found = self._word(english) or self._of_verdict(english, least) or self._whole(english, least)
        if found is None and english[-1:] in (".", ";", ":", ","):
            shorter = self._word(english[:-1]) or self._whole(english[:-1], least)
            return None if shorter is None else shorter + english[-1]
        return found

    def _part(self, english: str, least: int) -> str | None:
        found = self._ended(english, least) or self._complete(english, least)
        if found is None and english[-1:] in (".", ";", ":", ","):
            shorter = self._complete(english[:-1], least)
            return None if shorter is None else shorter + english[-1]
        return found

    def lines(self, english: str) -> str:
        r"""Return lines of a list or of the terminal in this language, each by itself; what marks an item stays.

        >>> Texts({"not used: {name}": "unbenutzt: {name}"}).lines("- not used: X.TAB\n  * a text of a user")
        '- unbenutzt: X.TAB\n  * a text of a user'
        """
        if isinstance(english, Message):
            return self.message(english)
        found = []
        for line in english.split("\n"):
            marker = MARKER.match(line)
            assert marker is not None
            whole = line[marker.end() :]
            cells = [whole] if self.text(whole) != whole else re.split(r"(\||(?<=\S) {2,}(?=\S))", whole)
            for k in range(0, len(cells), 2):
                given, cells[k] = cells[k], self._named(cells[k])
                if k + 1 < len(cells) and cells[k + 1] != "|":  # columns of a table stay where they are
                    cells[k + 1] = " " * max(len(cells[k + 1]) + len(given) - len(cells[k]), 2)
            found.append(marker[0] + "".join(cells))
        return "\n".join(found)

    def _named(self, english: str) -> str:
        """Return a cell of a table, a name and its value, or a message and its kind, in this language."""
        if isinstance(english, Message):
            return self.message(english)
        name, colon, value = english.partition(":")
        if colon and (
            kind := self.messages.get(f"{name}: {{message}}")
        ):  # of errors and warnings, also without a translation
            return kind.replace("{message}", self.label(value.strip()))
        whole = self.label(english)
        known = self.messages.get(f"{LABEL}\x04{name.replace('_', ' ')}")
        return whole if known is None or not colon or whole != english else f"{known}:{self.label(value)}"

    def page(self, html: str) -> str:
        """Return a finished page in this language: all texts between its tags, names of pictures, and its language."""
        whole = re.split(
            r"(<style.*?</style>|<script.*?</script>|<code.*?</code>|<pre.*?</pre>)", html, flags=re.DOTALL
        )
        for k in range(0, len(whole), 2):
            whole[k] = re.sub(r"(?<=>)[^<>]*[^\W\d_][^<>]*(?=<)", self._spaced, whole[k])
            whole[k] = re.sub(r'(?<=aria-label=")[^"]+', self._escaped, whole[k])
        return "".join(whole).replace('<html lang="en">', f'<html lang="{self.language}">')

    def _spaced(self, found: re.Match[str]) -> str:
        text = " ".join(found[0].split())
        return found[0].replace(found[0].strip(), escape(self.label(unescape(text)), quote=False))

    def picture(self, picture: Picture) -> Picture:
        """Return a picture with heading, note and texts in this language; names of series are for the script of its page."""
        from markupsafe import Markup

        data = dict(picture.data)
        if "series" in data:
            data["series"] = [{**item, "name": self.label(item["name"])} for item in data["series"]]
        said = {"title": self.label(picture.title), "note": self.label(picture.note)}
        return replace(picture, **said, svg=Markup(self.drawn(picture.svg)), data=data)

    def drawn(self, svg: str) -> str:
        """Return a picture (SVG) with its texts in this language."""
        found = re.sub(r"(?<=>)[^<>]+(?=</(?:text|title|desc|tspan)>)", self._escaped, svg)
        return re.sub(r'(?<=aria-label=")[^"]+', self._escaped, found)

    def _escaped(self, found: re.Match[str]) -> str:
        return escape(self.label(unescape(found[0])))

    def template(self, source: str, *, html: bool) -> str:
        """Return the source of a template in this language; parts that the catalogue does not contain stay in English."""
        found, end = [], 0
        for first, last in parts(source, html=html):
            message = " ".join(source[first:last].split())
            found += [source[end:first], self.messages.get(f"{PART}\x04{message}", source[first:last])]
            end = last
        text = "".join([*found, source[end:]])
        if html:
            said = lambda found: self.messages.get(f"{PART}\x04{found[0]}") or self.label(found[0])  # noqa: E731
            text = re.sub(r'(?<=aria-label=")[^"]+', said, text)
        return text.replace('<html lang="en">', f'<html lang="{self.language}">')

    def translate(self, environment: Environment, *, html: bool) -> Environment:
        """Let a Jinja environment load templates in this language, and translate what is filled into them."""
        assert environment.loader is not None
        environment.loader = _loader(environment.loader, lambda source: self.template(source, html=html))
        environment.finalize = self.filled
        environment.filters["word"] = lambda value: (
            self.label(value) if type(value) in (str, Message) else self.filled(str(value))
        )
        environment.globals["language"] = self.language
        if not html:  # in HTML this would switch off the escaping
            from markupsafe import Markup

            environment.filters["name"] = Markup
        return environment

    def filled(self, value: Any) -> Any:
        """Return a value that is filled into a template: a text in this language, lines of a file and all else as they are."""
        if isinstance(value, Message):
            return self.message(value)
        return self.text(value, _WEAK) if type(value) is str and "\n" not in value else value


@lru_cache(maxsize=8192)
def _patterns(message: str) -> list[re.Pattern[str]]:
    """Return what texts of a message look like; of two values side by side the first one has no blank, if possible."""
    literals = re.escape(message).replace(r"\{", "{").replace(r"\}", "}")
    forms = []
    for close in (True, False):
        seen = set[str]()

        def place(found: re.Match[str], seen: set[str] = seen, close: bool = close) -> str:
            if found[1] in seen:  # the same value once more
                return f"(?P={found[1]})"
            seen.add(found[1])
            beside = close and found.string[found.end() : found.end() + 1] == "{"
            return rf"(?P<{found[1]}>[\w.+-]*)" if beside else f"(?P<{found[1]}>.*?)"

        forms.append(_PLACE.sub(place, literals))
    return [re.compile(form, re.DOTALL) for form in dict.fromkeys(forms)]


def _loader(loader: BaseLoader, translate: Callable[[str], str]) -> BaseLoader:
    """Return a loader of the same templates after their translation."""
    from jinja2 import BaseLoader

    class Translated(BaseLoader):
        def get_source(self, environment: Environment, template: str) -> Any:
            source, name, current = loader.get_source(environment, template)
            return translate(source), name, current

    return Translated()


def parts(source: str, *, html: bool) -> Iterator[tuple[int, int]]:
    r"""Yield where the translatable parts of a template begin and end.

    In HTML they are the texts between two tags of blocks, in Markdown headings, paragraphs, items and rows of tables. A part
    contains all expressions, tags and branches within it, so that a translation can put them in another order.

    >>> text = "{% if a %}\n<p>With <b>{{ name }}</b>{% if b %} and more{% endif %}</p>\n{% endif %}"
    >>> [text[first:last] for first, last in parts(text, html=True)]
    ['With <b>{{ name }}</b>{% if b %} and more{% endif %}']
    """
    for first, last in _between_blocks(source) if html else _paragraphs(source):
        text = source[first:last]
        first += len(text) - len(text.lstrip())
        last -= len(text) - len(text.rstrip())
        if _WORDS.search(_UNREAD.sub(" ", _TOKEN.sub(" ", _CODE.sub(" ", source[first:last])))):
            yield first, last


def _between_blocks(source: str) -> Iterator[tuple[int, int]]:
    tokens: list[re.Match[str]] = []
    end = 0
    for found in _TOKEN.finditer(source):
        token = found[0]
        inline = token.startswith("{{") or _INLINE.match(token) or _BRANCH.match(token)
        if not inline:
            yield from _balanced(source, end, found.start(), tokens)
            tokens, end = [], found.end()
        elif _BRANCH.match(token):
            tokens.append(found)
    yield from _balanced(source, end, len(source), tokens)


def _balanced(source: str, first: int, last: int, branches: list[re.Match[str]]) -> Iterator[tuple[int, int]]:
    """Split a part at branches that do not begin and end within it."""
    open_ones: list[list[re.Match[str]]] = []
    cuts: list[re.Match[str]] = []
    for found in branches:
        kind = _BRANCH.match(found[0])[1]  # type: ignore[index]
        if kind == "if":
            open_ones.append([found])
        elif not open_ones:
            cuts.append(found)
        elif kind == "endif":
            open_ones.pop()
        else:
            open_ones[-1].append(found)
    for found in sorted([*cuts, *(item for group in open_ones for item in group)], key=lambda item: item.start()):
        yield first, found.start()
        first = found.end()
    yield first, last


def _paragraphs(source: str) -> Iterator[tuple[int, int]]:
    place, first, fenced, before = 0, None, False, ""
    for line in source.splitlines(keepends=True):
        marker = _MARKER.match(line)
        assert marker is not None
        row = line.startswith("|")
        fenced ^= line.lstrip().startswith("```")
        code = fenced or line.lstrip().startswith("```") or (line.startswith("    ") and not before.strip())
        alone = row or code or not line.strip() or _ONLY_STATEMENTS.match(line) is not None
        if first is not None and (alone or marker[1]):
            yield first, place
            first = None
        if row:
            yield place, place + len(line)
        elif not alone and first is None:
            first = place + marker.end()
        place += len(line)
        before = "" if code else line
        if first is not None and marker[1].startswith("#"):
            yield first, place
            first = None
    if first is not None:
        yield first, place


def wrapped(markdown: str) -> str:
    """Return Markdown whose long paragraphs and items are wrapped, as those of the English templates are."""
    lines = []
    # never before a sign or a number with a full stop: at the beginning of a line they would make a list
    for line in re.sub(r" (?=(?:[-+*=#>]+|\d+[.)]) )", "\0", markdown).split("\n"):
        if len(line) <= _COLUMN or line.startswith(("|", "#")):
            lines.append(line)
            continue
        marker = _MARKER.match(line)
        assert marker is not None
        lines += textwrap.wrap(
            line, _COLUMN, subsequent_indent=" " * marker.end(), break_long_words=False, break_on_hyphens=False
        )
    return "\n".join(lines).replace("\0", " ")
