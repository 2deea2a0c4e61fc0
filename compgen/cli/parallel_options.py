"""``--workers N`` and ``--cluster ADDRESS``, and the signals that stop what they spread."""

from __future__ import annotations

import functools
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any

import click

from compgen.cli.common import Command
from compgen.core.parallel import Map, opened_workers, spread
from compgen.errors import InputError
from compgen.plugins import with_plugins


def fleet_options(command: Command) -> Command:
    """Add --workers and --cluster; the command receives ``workers`` and ``cluster``."""

    @functools.wraps(command)
    def wrapper(*args: Any, workers: int | None, cluster: str | None, **options: Any) -> Any:
        if workers is not None and cluster is not None:
            raise InputError("--workers and --cluster are both given; --workers is for processes of this machine")
        return command(*args, workers=workers or 1, cluster=cluster, **options)

    text = "Processes on this machine that share the work; the results stay the same, byte for byte. Default: 1."
    decorated: Any = wrapper
    decorated = click.option("--workers", type=click.IntRange(1, 256), metavar="N", help=text)(decorated)
    text = "Scheduler of an existing Dask cluster that does the work, e.g. tcp://10.0.0.5:8786; needs compgen[cluster]."
    return click.option("--cluster", metavar="ADDRESS", help=text)(decorated)  # type: ignore[no-any-return]


@contextmanager
def mapper(workers: int, cluster: str | None) -> Iterator[Map]:
    """Yield a ``map`` over so many processes of this machine, or over a cluster; ``map`` itself for one."""
    found = opened_workers(workers, cluster)
    if found is None:
        yield map
        return

    def spread_out(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        return spread(found, with_plugins(function), items)

    with closing(found):
        yield spread_out


@contextmanager
def stopped_by_signals() -> Iterator[threading.Event]:
    """Yield what is set by the first SIGTERM or Ctrl-C; a second one is KeyboardInterrupt."""
    stop = threading.Event()

    def ask(*_: object) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before: dict[int, Any] = {}
    with suppress(ValueError):  # outside the main thread signals are somebody else's
        for number in (signal.SIGTERM, signal.SIGINT):
            before[number] = signal.signal(number, ask)
    try:
        yield stop
    finally:
        for known, handler in before.items():
            signal.signal(known, handler)
