"""Wrong times and lost histories at one machine: what comes of each (python examples/factory/clocks.py OUT).

The tables of mill-a are active. Then it is measured once more, but the program is misled about which tables were on. Every
case alone once made tables active that undo the compensation, with ``approval = "auto"`` and exit code 0.
"""

import argparse
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from factory import HOUR, Year, begin
from plant import CONTROL, day_of

from compgen.fleet import actions, logs
from compgen.fleet.database import StoreError
from compgen.fleet.job import read_job
from compgen.tables import read_tables

NAME = "mill-a"
DAY = timedelta(days=1)


@dataclass(frozen=True)
class Case:
    """What one mishap led to: state and messages, true rms in um with the active tables and with the new ones, if any."""

    name: str
    state: str
    said: str
    left_um: float
    would_leave_um: float | None
    same_files: bool


def prepared(folder: Path, seed: int = 1) -> Path:
    """Write a factory in which mill-a was measured bare and waits for approval; no limits, so that only times count."""
    year = begin(folder, seed)
    path = folder / "recal.toml"
    lines = path.read_text().replace('approval = "manual"', 'approval = "auto"').splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith(("temperature_c", "max_change_um"))))
    year.job = read_job(path)
    year.factory.measure(year.job, NAME, day_of(0), bare=True)
    return folder


def opened(folder: Path, seed: int = 1) -> Year:
    """A year that goes on in a copy of that folder, an hour after the measurement."""
    year = begin(folder / "unused", seed)
    year.factory = type(year.factory)(folder, seed)
    year.job, year.now = read_job(folder / "recal.toml"), day_of(0) + HOUR
    return year


def late_instrument(year: Year) -> None:
    """Version 1 becomes active; five minutes later it is checked, by an instrument whose clock is ten minutes behind."""
    year.run(NAME)
    year.now += timedelta(minutes=5)
    year.factory.measure(year.job, NAME, year.now, part="-x", says=_at(year.now - timedelta(minutes=10)))


def no_zone(year: Year) -> None:
    """The instrument writes UTC without saying so, and this computer takes it for local time."""
    year.run(NAME)
    year.now += 30 * DAY
    year.factory.measure(year.job, NAME, year.now, part="-x", says=_at(year.now.replace(tzinfo=None)))


def copied_file(year: Year) -> None:
    """Readings of the bare machine, made before version 1, are copied into the inbox a month later."""
    path = year.factory.measure(year.job, NAME, year.now, bare=True, part="-x", says={})
    path.rename(path.with_name(".hidden"))
    year.run(NAME)
    year.now += 30 * DAY
    path.with_name(".hidden").rename(path)
    os.utime(path, (year.now.timestamp(),) * 2)


def server_ahead(year: Year) -> None:
    """Version 1 becomes active while the clock of the server is a day ahead; six hours later it is checked."""
    true = year.now
    year.now = true + DAY
    year.run(NAME)
    year.now = true + 6 * HOUR
    year.factory.measure(year.job, NAME, year.now, part="-x", says=_at(year.now))


def renamed(year: Year) -> None:
    """The machine gets another name in the job file, and with it an empty history and folder; its tables stay on."""
    year.run(NAME)
    year.now += 30 * DAY
    year.factory.measure(year.job, NAME, year.now, part="-x", says=_at(year.now))
    next(year.job.machine(NAME).inbox.glob("*05.lengths.csv")).unlink()
    path = year.job.path
    own = '[machines.mill-x]\nmachine = "machines/mill-a.toml"\ninbox = "inbox/mill-a"\nout = "tables/mill-x"\n'
    path.write_text(path.read_text().replace(f"[machines.{NAME}]\n", own, 1))
    year.job = read_job(path)


def lost_store(year: Year) -> None:
    """The store is deleted."""
    year.run(NAME)
    _measured_later(year)
    for path in _store(year).parent.glob("recal.sqlite*"):
        path.unlink()


def emptied_store(year: Year) -> None:
    """The store is a file of 0 bytes."""
    lost_store(year)
    _store(year).touch()


def older_store(year: Year) -> None:
    """The store is one of before version 1 became active."""
    manual = year.job.path.read_text().replace('approval = "auto"', 'approval = "manual"')
    text = year.job.path.read_text()
    year.job.path.write_text(manual)
    year.job = read_job(year.job.path)
    year.run(NAME)
    shutil.copytree(_store(year).parent, year.factory.folder / "old", ignore=lambda _, names: [
        name for name in names if not name.startswith("recal.sqlite")
    ])  # fmt: skip
    actions.approve(year.job, NAME, 1, "ada", clock=year.clock)
    year.job.path.write_text(text)
    year.job = read_job(year.job.path)
    _measured_later(year)
    for path in _store(year).parent.glob("recal.sqlite*"):
        path.unlink()
    for path in (year.factory.folder / "old").iterdir():
        shutil.copy(path, _store(year).parent)


CASES: dict[str, Callable[[Year], None]] = {
    "the instrument's clock is 10 minutes behind": late_instrument,
    "the time has no zone": no_zone,
    "the file has no time and was copied": copied_file,
    "the server's clock ran ahead": server_ahead,
    "the machine has another name in the job file": renamed,
    "the store was deleted": lost_store,
    "the store has 0 bytes": emptied_store,
    "the store is an older one": older_store,
}


def _at(time) -> dict:
    return {"measured_at": time.isoformat()}


def _measured_later(year: Year) -> None:
    year.now += 30 * DAY
    year.factory.measure(year.job, NAME, year.now, part="-x", says=_at(year.now))


def _store(year: Year) -> Path:
    return year.factory.folder / "recal.sqlite"


def carried_out(name: str, folder: Path, seed: int = 1) -> Case:
    """Let one case happen in a prepared folder."""
    year = opened(folder, seed)
    out = folder / "tables" / NAME
    CASES[name](year)
    before = _bytes(out)
    machine = next(item for item in year.job.machines if item in (NAME, "mill-x"))
    try:
        outcome = year.run(machine)
        state, said = outcome.state, "; ".join(outcome.messages)
    except StoreError as error:
        state, said = "stopped", str(error)
    left = year.factory.left_um(NAME, year.now, _tables(year, out / "active"))
    new = sorted(year.job.machine(machine).out.glob("proposed/[HN]*"))  # held, or not accepted
    would = year.factory.left_um(NAME, year.now, _tables(year, new[-1])) if new else None
    return Case(name, state, said, left, would, _bytes(out) == before)


def _bytes(out: Path) -> dict[str, bytes]:
    """What a control may read: the versions and where the pointer leads."""
    found = {str(path): path.read_bytes() for path in sorted(out.glob("v*/*")) if path.is_file()}
    return {**found, "active": os.readlink(out / "active").encode()}


def _tables(year: Year, folder: Path):
    control = CONTROL[NAME]
    (path,) = folder.glob("*NC_CEC.INI")  # NOT-ACCEPTED-NC_CEC.INI if they are refused
    return read_tables(year.factory.machine(NAME), [path], control)


def main() -> None:
    """Let every case happen and print what came of it."""
    parser = argparse.ArgumentParser(description="Wrong times and lost histories at one simulated machine.")
    parser.add_argument("out", type=Path, metavar="OUT", help="New folder for everything.")
    arguments = parser.parse_args()
    if arguments.out.exists() and any(arguments.out.iterdir()):
        parser.error(f"{arguments.out} is not empty; name a new folder")
    logs.configure("text")
    base = prepared(arguments.out / "base")
    for number, name in enumerate(CASES):
        shutil.copytree(base, arguments.out / str(number))
        case = carried_out(name, arguments.out / str(number))
        would = "" if case.would_leave_um is None else f"; the new tables would leave {case.would_leave_um:.2f}"
        print(
            f"{name}: {case.state}, {case.left_um:.2f} um rms with the active tables{would}\n    {case.said}",
            flush=True,
        )


if __name__ == "__main__":
    main()
