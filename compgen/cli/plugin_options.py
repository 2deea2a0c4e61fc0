"""``--plugin PATH``, before the command or among its options."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from compgen.plugins import load_plugins

_HELP = (
    "Plug-in to load: a .py file or a package folder with controls, effects, instruments (may be given several times)."
)


def _load(context: click.Context, parameter: click.Parameter, paths: tuple[Path, ...]) -> None:
    load_plugins(paths, installed=False)


def plugin_option(command: Any) -> Any:
    """Add --plugin to a command or to the function of one; the plug-ins are loaded before anything else is read."""
    option = click.option(
        "--plugin",
        multiple=True,
        metavar="PATH",
        type=click.Path(path_type=Path),
        envvar="COMPGEN_PLUGINS",
        show_envvar=True,
        is_eager=True,
        expose_value=False,
        callback=_load,
        help=_HELP,
    )
    return option(command)
