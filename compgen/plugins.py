"""The registries that plug-ins may add to, one line each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from compgen.controls import CONTROLLERS
from compgen.data.registry import PATH_ORIGIN, Kind, load_entry_points, load_file
from compgen.effects import FAMILIES
from compgen.effects.catalogue import check_family
from compgen.simulate import EFFECTS, INSTRUMENTS
from compgen.simulate.run import check_effect, check_instrument
from compgen.tables.render import check_control

#: What plug-ins may add: word, name of the dict in a file, group of entry points, registry, check.
KINDS = (
    Kind("control", "CONTROLLERS", "compgen.controllers", CONTROLLERS, check_control),
    Kind("effect", "EFFECTS", "compgen.effects", EFFECTS, check_effect),
    Kind("effect family", "FAMILIES", "compgen.effect_families", FAMILIES, check_family),
    Kind("instrument", "INSTRUMENTS", "compgen.instruments", INSTRUMENTS, check_instrument),
)
CONTROLS, SIMULATED_EFFECTS, EFFECT_FAMILIES, SIMULATED_INSTRUMENTS = KINDS


def load_plugins(paths: Sequence[str | Path] = (), *, installed: bool = True) -> None:
    """Register plug-ins for this process.

    Parameters
    ----------
    paths : ``.py`` files or package folders that hold ``CONTROLLERS``, ``EFFECTS``, ``FAMILIES`` or
        ``INSTRUMENTS``.
    installed : also those of installed distributions; one that is broken is left out with a warning.

    Raises
    ------
    InputError
        with file and line for a plug-in among ``paths`` that cannot be imported or is not complete.

    Examples
    --------
    >>> from pathlib import Path
    >>> import compgen
    >>> try:
    ...     compgen.load_plugins(["my_control.py"], installed=False)
    ... except compgen.InputError as error:
    ...     print(Path(error.file).name)
    my_control.py
    """
    if installed:
        load_entry_points(KINDS)
    for path in paths:
        load_file(path, KINDS)


@dataclass(frozen=True)
class WithPlugins:
    """A function that another process calls with the plug-ins of this one."""

    function: Callable[[Any], Any]
    paths: tuple[str, ...]

    def __call__(self, item: Any) -> Any:
        """Load the plug-ins, unless they are, and call the function."""
        _load_once(self.paths)
        return self.function(item)


@cache
def _load_once(paths: tuple[str, ...]) -> None:
    load_plugins(paths)


def with_plugins(function: Callable[[Any], Any]) -> WithPlugins:
    """Return the function with the plug-ins that were loaded from paths."""
    origins = {origin for kind in KINDS for origin in kind.origins.values() if origin.startswith(PATH_ORIGIN)}
    return WithPlugins(function, tuple(sorted(origin.removeprefix(PATH_ORIGIN) for origin in origins)))
