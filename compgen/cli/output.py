"""What every command prints with, on a terminal or not: one JSON object, and whether it says what it does."""

from __future__ import annotations

from typing import Any

import click

from compgen.data.files import json_text

#: Key in the context of a command that is to say what it does.
VERBOSE = "compgen.verbose"


def print_json(data: Any) -> None:
    """Print one JSON object to stdout."""
    click.echo(json_text(data), nl=False)
