"""Twelve months of a factory of three simulated machines under ``volcomp recal``.

    python examples/factory/factory.py OUT [--seed N]

writes OUT/recal.toml, machine files, scenarios, inboxes, tables and reports, prints what happened month by month, and what
the history says in the end. Any ``volcomp recal`` command works on OUT/recal.toml afterwards.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path

import people
from people import Decision
from plant import CRASH, MONTHS, NAMES, Factory, active_tables, day_of

from compgen.fleet import actions, logs
from compgen.fleet.decisions import exclude
from compgen.fleet.drift import Drift, DriftSettings, drift_of_store
from compgen.fleet.history_page import write_history_report
from compgen.fleet.job import Job, read_job
from compgen.fleet.records import TableRecord
from compgen.fleet.runner import MachineOutcome, run_jobs
from compgen.fleet.status import history
from compgen.fleet.store import Store, open_store

HOUR = timedelta(hours=1)
#: Months (0 is January) in which something out of the ordinary arrives.
EXCHANGED, STALE, WRONG_SIGN = 0, 3, 8


@dataclass
class Year:
    """A factory on its way through the year; ``now`` is the time that the store sees."""

    factory: Factory
    job: Job
    now: datetime = day_of(0)
    rows: list["Row"] = field(default_factory=list)
    undone: list["Undone"] = field(default_factory=list)

    def clock(self) -> datetime:
        return self.now

    def run(self, name: str) -> MachineOutcome:
        """One `volcomp recal run` of one machine."""
        return run_jobs(self.job, [name], clock=self.clock).outcomes[0]

    def tables(self, name: str) -> list[TableRecord]:
        store = open_store(self.job.store)
        try:
            known = {machine.name: machine for machine in store.machines()}
            return store.tables(known[name]) if name in known else []
        finally:
            store.close()

    def active_files(self, name: str) -> dict[str, bytes]:
        """Names and bytes of the files behind the pointer; none while nothing is active."""
        folder = self.job.machine(name).out / "active"
        return {
            str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
        }

    def left_um(self, name: str, *, compensated: bool = True) -> float:
        """True error of the machine now, with the tables in its control or without."""
        tables = active_tables(self.job, name, self.factory.machine(name)) if compensated else None
        return self.factory.left_um(name, self.now, tables)


@dataclass(frozen=True)
class Row:
    """What one measurement led to: version and state as proposed, the decision, and the true machine afterwards."""

    at: datetime
    machine: str
    file: str
    temperature_c: float
    outcome: MachineOutcome
    table: TableRecord | None
    decision: Decision | None
    active: int | None
    without_um: float
    with_um: float

    def words(self) -> str:
        """One line of the printed table."""
        if self.table is None:
            found, why = "failed", "; ".join(self.outcome.messages)
        else:
            found, why = f"v{self.table.version} {self.table.state}", "; ".join(self.table.reasons)
        decided = "" if self.decision is None else f"{self.decision.actor}: {self.decision.kind}"
        active = "none" if self.active is None else f"v{self.active}"
        line = (
            f"{self.at:%Y-%m-%d} {self.machine} {self.temperature_c:5.1f} degC  {found:11}  {decided:13}  active {active:4}"
            f"  {self.without_um:5.2f} -> {self.with_um:5.2f} um rms"
        )
        said = self.decision.reason if self.decision else ""
        return line + "".join(f"\n{'':24}{text}" for text in (why, said and f'"{said}"') if text)


@dataclass(frozen=True)
class Undone:
    """A wrong approval and its rollback: files before, between and after, and the true error with each, um rms."""

    files: tuple[dict[str, bytes], dict[str, bytes], dict[str, bytes]]
    left_um: tuple[float, float, float]
    version: int


def begin(folder: Path, seed: int = 1) -> Year:
    """Write the files of the factory."""
    factory = Factory(folder, seed)
    return Year(factory, read_job(factory.write()))


def months(year: Year) -> Iterator[Row]:
    """Run the year; yield after every measurement."""
    for month in range(MONTHS):
        for name in NAMES:
            for row in _month(year, name, month):
                year.rows.append(row)
                yield row


def _month(year: Year, name: str, month: int) -> Iterator[Row]:
    """One machine in one month: what is special, then the usual measurement."""
    at = day_of(month)
    if name == "mill-a" and month == STALE:
        path = year.factory.measure(year.job, name, at - timedelta(days=50), bare=True, part="-found-on-a-stick")
        yield _processed(year, name, path, at - HOUR)
    if name == "mill-b" and month == EXCHANGED:
        for part, wrong in (("-exchanged", exchanged), ("-wrong-sign", wrong_sign)):
            path = year.factory.measure(year.job, name, at - 24 * HOUR, part=part)
            path.write_text(wrong(path.read_text()))
            yield _processed(year, name, path, at - 23 * HOUR)
            path.unlink()
    if name == "mill-b" and month == WRONG_SIGN:
        yield _undone(year, name, at - 24 * HOUR)
    yield _processed(year, name, year.factory.measure(year.job, name, at), at + 2 * HOUR)


def exchanged(text: str) -> str:
    """A measurement file whose columns X and Y are exchanged."""
    return text.replace(",x_mm,y_mm,", ",y_mm,x_mm,")


def wrong_sign(text: str) -> str:
    """A measurement file whose lengths have the wrong sign."""
    lines = text.splitlines()
    head = next(k for k, line in enumerate(lines) if line.startswith("station,"))
    column = lines[head].split(",").index("length_mm")
    cells = [line.split(",") for line in lines[head + 1 :]]
    turned = [[*row[:column], str(-float(row[column])), *row[column + 1 :]] for row in cells]
    return "\n".join([*lines[: head + 1], *map(",".join, turned)]) + "\n"


def _processed(year: Year, name: str, path: Path, now: datetime) -> Row:
    """Run, decide, look at the true machine."""
    year.now = now
    before = len(year.tables(name))
    outcome = year.run(name)
    new = year.tables(name)[before:]
    year.now += HOUR
    crashed = name == "mill-b" and timedelta(0) < now - CRASH < timedelta(days=30)
    made = people.decide(year.job, name, year.clock, crashed=crashed) if new else {}
    return _row(year, name, path, outcome, new[0] if new else None, made)


def _row(
    year: Year,
    name: str,
    path: Path,
    outcome: MachineOutcome,
    table: TableRecord | None,
    made: dict[int, Decision],
) -> Row:
    active = next((item.version for item in year.tables(name) if item.state == "active"), None)
    return Row(
        at=year.now,
        machine=name,
        file=path.name,
        temperature_c=year.factory.temperature_c(name, year.now),
        outcome=outcome,
        table=table,
        decision=None if table is None else made.get(table.version),
        active=active,
        without_um=year.left_um(name, compensated=False),
        with_um=year.left_um(name),
    )


def _undone(year: Year, name: str, at: datetime) -> Row:
    """A program writes deviations with the wrong sign. Ben makes the tables active all the same; Ada undoes it."""
    year.now = at
    path = year.factory.measure_deviations(year.job, name, at, sign=-1.0)
    before = len(year.tables(name))
    outcome = year.run(name)
    table = year.tables(name)[before]
    files, left = [year.active_files(name)], [year.left_um(name)]
    year.now += HOUR
    wrong = Decision("override", "ben", "it is only a little over the limit")
    people.carry_out(year.job, name, table.version, wrong, year.clock)
    files.append(year.active_files(name))
    left.append(year.left_um(name))
    year.now += HOUR
    actions.rollback(year.job, name, "ada", "parts are out of tolerance since this morning", clock=year.clock)
    files.append(year.active_files(name))
    left.append(year.left_um(name))
    exclude(year.job, name, table.version, "ada", "the sign of the deviations was wrong", clock=year.clock)
    year.undone.append(Undone((files[0], files[1], files[2]), (left[0], left[1], left[2]), table.version))
    told = replace(wrong, reason=f"{wrong.reason}; rolled back by ada an hour later")
    return _row(year, name, path, outcome, table, {table.version: told})


def drift_of(store: Store, job: Job, name: str) -> Drift:
    """What `volcomp recal history NAME --drift` says."""
    return drift_of_store(store, store.machine(name), DriftSettings(job.machine(name).tolerances))


def tell(year: Year) -> Iterator[str]:
    """Write the page of each machine; yield what the histories say."""
    store = open_store(year.job.store)
    try:
        for name in NAMES:
            found = drift_of(store, year.job, name)
            yield f"\n{name}"
            yield from (f"  {text}" for text in found.sentences())
            yield f"  {write_history_report(year.factory.folder / 'reports' / f'{name}.html', found)}"
        yield "\nmill-b: who did what"
        for entry in history(store, store.machine("mill-b")):
            yield f"  {entry.at:16.16} {entry.kind:12} {entry.version or '':>3} {entry.actor:10} {entry.text}"
    finally:
        store.close()


def main() -> None:
    """Run the year from the command line."""
    parser = argparse.ArgumentParser(description="Twelve months of a factory of three simulated machines.")
    parser.add_argument("out", type=Path, metavar="OUT", help="New folder for everything.")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.out.exists() and any(arguments.out.iterdir()):
        parser.error(f"{arguments.out} is not empty; name a new folder")
    logs.configure("text")
    year = begin(arguments.out, arguments.seed)
    for row in months(year):
        print(row.words(), flush=True)
    for line in tell(year):
        print(line)


if __name__ == "__main__":
    main()
