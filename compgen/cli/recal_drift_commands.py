"""``compgen recal history MACHINE --drift`` and ``compgen recal recheck``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from compgen.cli.common import print_json, stdout
from compgen.errors import InputError

if TYPE_CHECKING:
    from compgen.recal.drift import Drift
    from compgen.recal.job import Job
    from compgen.recal.store import Store


def show_drift(store: Store, job: Job, machine: str | None, report: Path | None, *, as_json: bool) -> int:
    """Print the drift of one machine and write its page; the exit code is 0."""
    from compgen.recal.drift import DriftSettings, drift_of_store

    if machine is None:
        raise InputError("--drift and --report are for one machine; name it")
    found = drift_of_store(store, store.machine(machine), DriftSettings(job.machine(machine).tolerances))
    paths = [] if report is None else [str(_write(report, found))]
    if as_json:
        print_json({"accepted": True, "paths": paths, "drift": found.summary()})
        return 0
    stdout.print(f"{machine}: {len(found.times)} calibrations, {found.times[0]} to {found.times[-1]}", soft_wrap=True)
    for title, change, errors in (
        ("last", found.volume_since_last, found.since_last),
        ("first", found.volume_since_first, found.since_first),
    ):
        if change is not None:
            level = 1.0 - found.settings.confidence
            named = ", ".join(item.error for item in errors if item.adjusted < level) or "no single error"
            stdout.print(
                f"since the {title}: {change.rms_um:.2f} um rms over the volume ({change.expected_rms_um:.2f} um by "
                f"uncertainty alone), p = {change.p_value:.2g}; changed: {named}",
                soft_wrap=True,
            )
    for text in found.sentences():
        stdout.print(f"  {text}", soft_wrap=True, markup=False)
    for path in paths:
        stdout.print(path, soft_wrap=True, markup=False)
    return 0


def _write(path: Path, drift: Drift) -> Path:
    from compgen.recal.history_report import write_history_report

    return write_history_report(path, drift)
