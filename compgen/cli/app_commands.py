"""``volcomp app``: the workbench in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path

import click

from compgen.cli.common import PATH, language_option, shown_units
from compgen.cli.terminal import say
from compgen.errors import InputError


@click.command("app")
@click.argument("folder", required=False, metavar="[DIR]", type=PATH)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port on this computer. Default: any free one.")
@click.option("--no-browser", is_flag=True, help="Print the address and open no browser.")
@click.option("--keep-open", is_flag=True, help="Run until Ctrl-C, also after the last page is closed.")
@language_option
def app_command(folder: Path | None, port: int, no_browser: bool, keep_open: bool, language: str) -> int:
    """Open the workbench in the browser: from files to checked tables without a command line.

    DIR is the folder of a project; without it a page asks for one. The pages are served to this computer only (127.0.0.1),
    behind an address that is valid once. Every step is a command of this program in the folder of the project; the
    pages show it. Ends when the last page is closed, or with Ctrl-C. Lengths are in mm, errors in um and urad.

    \b
    Example:
      volcomp app my-mill/
    """
    try:
        from compgen.app.pages import serve
    except ImportError as error:
        raise InputError(f"{error.name} is not installed; the app needs: pip install 'compgen[serve]'") from error

    def announce(address: str) -> None:
        say(f"The workbench: {address}", "It ends when the last page is closed, or with Ctrl-C.")

    browse = None if no_browser else webbrowser.open
    serve(folder, port, announce, keep_open=keep_open, language=language, units=shown_units(), browse=browse)
    return 0
