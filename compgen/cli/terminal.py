"""Text for people, through rich: tables, messages, progress; loaded by the first command or message that needs it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from compgen.cli.common import print_json
from compgen.data.messages import visible

#: Tables into a pipe or a file get the width that they need, not that of an unknown terminal.
PIPE_WIDTH = None if sys.stdout.isatty() else 130


class Terminal(Console):
    """A console that shows the control characters of names, reasons and files as escapes: no text commands a terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Turn text into what is shown; printing and the cells of tables come through here."""
        return super().render_str(visible(text), **options)


# emoji=False: rich would turn the place file.csv:100: into a picture
stdout = Terminal(highlight=False, emoji=False, markup=False, width=PIPE_WIDTH)
stderr = Terminal(stderr=True, highlight=False, emoji=False, markup=False)


def say(*lines: str, style: str | None = None) -> None:
    """Print lines of text as they are, without breaking them."""
    for line in lines:
        stdout.print(line, style=style, soft_wrap=True)


def say_paths(paths: Iterable[object]) -> None:
    """Print the files that were written."""
    say(*(f"  {path}" for path in paths))


def answer(as_json: bool, data: Any, *shown: Any) -> None:
    """Print a result: ``data`` as the one JSON object on stdout, or what is ``shown`` to people, tables and lines."""
    if as_json:
        print_json(data)
        return
    for item in shown:
        stdout.print(item, soft_wrap=isinstance(item, str))


def complain(text: str, style: str | None = "yellow") -> None:
    """Print a warning on stderr, or with style "red" what is wrong."""
    stderr.print(text, style=style, soft_wrap=True)


def table_of(headings: Sequence[str], rows: Iterable[Sequence[str]], **options: Any) -> Table:
    """Return rows of text below their headings; long cells are folded, none is cut."""
    table = Table(box=box.SIMPLE, **options)
    for heading in headings:
        table.add_column(heading, overflow="fold")
    for row in rows:
        table.add_row(*row)
    return table


@contextmanager
def progress(*, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Show the current step on a terminal; say nothing into a pipe."""
    if quiet or not stderr.is_terminal:
        yield lambda _: None
        return
    with stderr.status("starting") as status:
        yield lambda text: status.update(text)
