"""Output for people, through rich: tables, messages, progress; loaded when a command first needs it."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.console import Console, Group
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from compgen.cli.output import VERBOSE, print_json
from compgen.errors import visible
from compgen.resources import LANGUAGES
from compgen.units import UNITS, Inch, units_of_cells

if TYPE_CHECKING:
    from compgen.language import Texts

#: Tables in a pipe or a file get the width they need, not the width of an unknown terminal.
PIPE_WIDTH = None if sys.stdout.isatty() else 130


class Terminal(Console):
    """A console that escapes control characters in names, reasons and files: no text may control the terminal.

    What it prints is shown in the language of ``texts``, in English without them, and in the units of ``inch``, without it in
    mm, um and urad.
    """

    texts: Texts | None = None
    inch: Inch | None = None

    def print(self, *objects: Any, **options: Any) -> None:
        """Print texts and tables in the language and the units of the command."""
        units = [None if self.inch is None else _units_of(item) for item in objects]
        said = list(objects) if self.texts is None else [_said(item, self.texts) for item in objects]
        if self.inch is not None:
            said = [_measured(item, known, self.inch) for item, known in zip(said, units, strict=True)]
        super().print(*said, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Convert text to what is shown; printing and the cells of tables use it."""
        return super().render_str(visible(text), **options)


# emoji=False: rich would turn the location file.csv:100: into a symbol
stdout = Terminal(highlight=False, emoji=False, markup=False, width=PIPE_WIDTH)
stderr = Terminal(stderr=True, highlight=False, emoji=False, markup=False)


def _said(shown: Any, texts: Texts) -> Any:
    """Return what is printed in another language; tables are changed in place, since each is made to be printed once."""
    if isinstance(shown, str):
        return texts.lines(shown)
    if isinstance(shown, Text):
        return Text(texts.lines(shown.plain), style=shown.style, overflow=shown.overflow)
    if isinstance(shown, Group):
        return Group(*(_said(item, texts) for item in shown.renderables))
    if isinstance(shown, Padding):
        shown.renderable = _said(shown.renderable, texts)
    if isinstance(shown, Table):
        shown.title = shown.title and _said(shown.title, texts)
        for column in shown.columns:
            column.header = _said(column.header, texts)
            column._cells = [_said(cell, texts) for cell in column._cells]
    return shown


def _units_of(shown: Any) -> Any:
    """Return the units of the cells of a table, by rows, which its English headings state; of a group those of each part."""
    if isinstance(shown, Group):
        return [_units_of(item) for item in shown.renderables]
    if isinstance(shown, Padding):
        return _units_of(shown.renderable)
    if isinstance(shown, Table):
        cells = [[_plain(cell) for cell in column._cells] for column in shown.columns]
        return units_of_cells(
            _plain(shown.title), [_plain(column.header) for column in shown.columns], list(zip(*cells, strict=True))
        )
    return None


def _plain(cell: Any) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell or "")


def _measured(shown: Any, units: Any, inch: Inch) -> Any:
    """Return what is printed in inch; tables are changed in place, as by :func:`_said`."""
    if isinstance(shown, str):
        return inch.text(shown)
    if isinstance(shown, Text):
        return Text(inch.text(shown.plain), style=shown.style, overflow=shown.overflow)
    if isinstance(shown, Group):
        return Group(*(_measured(item, own, inch) for item, own in zip(shown.renderables, units, strict=True)))
    if isinstance(shown, Padding):
        shown.renderable = _measured(shown.renderable, units, inch)
    if isinstance(shown, Table):
        shown.title = shown.title and _measured(shown.title, None, inch)
        for k, column in enumerate(shown.columns):
            column.header = _measured(column.header, None, inch)
            column._cells = [_cell_measured(cell, row[k], inch) for cell, row in zip(column._cells, units, strict=True)]
    return shown


def _cell_measured(cell: Any, unit: str, inch: Inch) -> Any:
    if isinstance(cell, Text):
        return Text(inch.cell(cell.plain, unit), style=cell.style, overflow=cell.overflow)
    return inch.cell(cell, unit) if isinstance(cell, str) else _measured(cell, None, inch)


def measure_in(units: str) -> None:
    """Show lengths, deviations and angles in these units from now on, in the language that is printed.

    Warnings and errors speak of files and options in the units in which these are written. As in :func:`speak`, what a
    program reads stays as it is.
    """
    read_by_program = os.environ.get("COMPGEN_MESSAGES") == LANGUAGES[0]
    stdout.inch = None if units == UNITS[0] or read_by_program else Inch(_language())


def _language() -> str:
    return LANGUAGES[0] if stdout.texts is None else stdout.texts.language


def speak(language: str) -> None:
    """Print in a language from now on, unless COMPGEN_MESSAGES asks for English: a program reads the messages then."""
    texts = None
    if language != LANGUAGES[0] and os.environ.get("COMPGEN_MESSAGES") != LANGUAGES[0]:
        from compgen.language import texts_of

        texts = texts_of(language)
    stdout.texts = stderr.texts = texts
    if stdout.inch is not None:
        measure_in(UNITS[1])


def say(*lines: str, style: str | None = None) -> None:
    """Print lines of text as they are, without breaking them."""
    for line in lines:
        stdout.print(line, style=style, soft_wrap=True)


def say_paths(paths: Iterable[object]) -> None:
    """Print the files that were written; a name that looks like a quantity stays as it is."""
    inch, stdout.inch = stdout.inch, None
    try:
        say(*(f"  {path}" for path in paths))
    finally:
        stdout.inch = inch


def answer(as_json: bool, data: Any, *shown: Any) -> None:
    """Print a result: ``data`` as one JSON object on stdout, or the tables and lines ``shown`` to people."""
    if as_json:
        print_json(data)
        return
    for item in shown:
        stdout.print(item, soft_wrap=isinstance(item, str))


def complain(text: str, style: str | None = "yellow") -> None:
    """Print a warning on stderr; with style "red" an error."""
    stderr.print(text, style=style, soft_wrap=True)


def table_of(headings: Sequence[str], rows: Iterable[Sequence[str]], **options: Any) -> Table:
    """Return rows of text below their headings; long cells are wrapped, never cut."""
    table = Table(box=box.SIMPLE, **options)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        assert len(row) <= len(headings), row
        table.add_row(*row)
    return table


@contextmanager
def progress(*, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Show the current step on a terminal, with -v every step as a line with the time; otherwise nothing in a pipe."""
    context = click.get_current_context(silent=True)
    if context is not None and context.meta.get(VERBOSE):
        start = time.monotonic()
        yield lambda text: complain(f"{time.monotonic() - start:7.2f} s  {text}", None)
        complain(f"{time.monotonic() - start:7.2f} s  done", None)
        return
    if quiet or not stderr.is_terminal:
        yield lambda _: None
        return
    with stderr.status("starting") as status:
        yield lambda text: status.update(text if stderr.texts is None else stderr.texts.lines(text))
