"""Kills ``volcomp recal run`` at random moments (kill -9) and looks whether anything is lost, half done or done twice.

    python benchmarks/recal_faults.py [--kills 200] [--seed 1] [--store postgresql://USER@HOST/EMPTY]

A machine whose tables are approved automatically gets new measurements as long as runners are killed; every third time
two runners work at once. While they run, the tables that the pointer ``active`` leads to are read again and again. After
every kill the store and the folders are looked through. At the end the rest is processed, and the tables of each
measurement are compared with those of a run that nobody disturbed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import sqlite3
import tempfile
import time
from collections import Counter
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import sqlalchemy as sa

from compgen.data.deviations import Deviations, format_deviations
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import load_machine
from compgen.fleet import database
from compgen.fleet.job import read_job
from compgen.fleet.runner import run_jobs
from compgen.fleet.store import Store, open_store
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import volume_grid

MACHINE = """\
name = "mill"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [0.0, 0.0, 0.0]
errors = ["EXX", "EYY", "EZZ", "EC0Y", "EB0Z", "EA0Z"]
[axes.X]
range_mm = [-300.0, 200.0]
nodes = 4
[axes.Y]
range_mm = [-100.0, 300.0]
nodes = 4
[axes.Z]
range_mm = [-240.0, 0.0]
nodes = 4
[controllers.siemens-cec]
sign = "error"
mult_mode = "S1"
# Six errors are measured and the others are zero here; and the machine changes between two measurements as no real one does.
[prior]
class = "none"
[repeatability]
drift_squareness_urad = 100.0
drift_scale_um_per_m = 30.0
"""
TABLE, ITS_END = "NC_CEC.INI", b"M17\n"
NOISE_MM = 3e-4
#: How often the active tables are read while runners work, s.
READ_EVERY_S = 0.005
BEGIN = datetime.now(UTC) - timedelta(days=20)


class Site:
    """A folder with a job of one machine; ``url`` is the store (None: SQLite in the folder)."""

    def __init__(self, folder: Path, url: str | None = None) -> None:
        self.folder, self.inbox, self.out, self.count = folder, folder / "inbox", folder / "out", 0
        self.inbox.mkdir(parents=True)
        (folder / "mill.toml").write_text(MACHINE)
        store = "" if url is None else f"store = {json.dumps(url)}\n"
        (folder / "recal.toml").write_text(
            f'{store}[machines.mill]\nmachine = "mill.toml"\ninbox = "inbox"\ncontrollers = ["siemens-cec"]\nout = "out"\n'
            'measured_with = "bare"\napproval = "auto"\n'
        )
        self.job = read_job(folder / "recal.toml")
        self.machine = load_machine(folder / "mill.toml")

    def measure(self) -> None:
        """Put one more measurement into the inbox; squareness and pitch go to and fro, so that each one is news."""
        self.count += 1
        nodes = self.machine.axes[0].nodes_mm
        pitch = Curve(nodes, 1e-5 * nodes * (1 + self.count % 3), np.full_like(nodes, 1e-4))
        errors = ErrorTable({"EXX": pitch}, {"EC0Y": (2e-5 + 4e-5 * (self.count % 2), 1e-6)})
        position = volume_grid(self.machine, tuple(axis.nodes_mm for axis in self.machine.axes)).position_mm
        noise = np.random.default_rng(self.count).normal(0.0, NOISE_MM, position.shape)
        deviation = exact_error(self.machine, errors, position) + noise
        notes = {"measured_at": (BEGIN + timedelta(minutes=self.count)).isoformat()}
        text = format_deviations(Deviations(position, deviation, u_mm=np.full_like(noise, NOISE_MM), metadata=notes))
        temporary = self.inbox / ".new.csv"
        temporary.write_text(text)
        temporary.rename(self.inbox / f"{self.count:04d}.deviations.csv")

    def run(self) -> int:
        """Make one pass in this process and return its exit code."""
        return run_jobs(self.job).exit_code

    def store(self) -> Store:
        """Open the store."""
        return open_store(self.job.store)

    def start(self) -> int:
        """Start a runner in a process of its own and return its number; nothing has to be imported again."""
        child = os.fork()
        if child == 0:
            code = 99
            try:
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                code = self.run()
            finally:
                os._exit(code)
        return child


@dataclass
class Findings:
    """What was seen: runners killed by the point that they had reached, runners that came to their end, troubles."""

    killed: Counter[str] = field(default_factory=Counter)
    ended: Counter[int] = field(default_factory=Counter)
    reads: int = 0
    troubles: list[str] = field(default_factory=list)
    rows: dict[str, set[str]] = field(default_factory=dict)


# --- looking -------------------------------------------------------------------------------------------------------


def read_active(site: Site) -> list[str]:
    """Read the active tables as a control would; return what is wrong with them."""
    try:
        content = (site.out / "active" / TABLE).read_bytes()
    except FileNotFoundError:
        if os.path.lexists(site.out / "active"):
            return ["the pointer leads to nothing"]
        return []
    return [] if content.endswith(ITS_END) else ["the active table is cut off"]


def look(site: Site, found: Findings) -> None:
    """Look through store and folders after a kill; what is wrong is added to the findings."""
    store = site.store()
    try:
        found.troubles += _store_troubles(site, store) + _folder_troubles(site, store) + read_active(site)
        found.troubles += _lost_rows(store, found)
    finally:
        store.close()


def _lost_rows(store: Store, found: Findings) -> list[str]:
    """Rows that were there before and are gone or changed."""
    lost = []
    for table in database.ALL:
        columns = [column for column in table.c if column.name != "deflated"]
        query = sa.select(*columns)
        now = {repr(tuple(row)) for row in store.read(lambda c, q=query: list(c.execute(q)))}
        if found.rows.get(table.name, set()) - now:
            lost.append(f"rows of {table.name} are gone or changed")
        found.rows[table.name] = now
    return lost


def _store_troubles(site: Site, store: Store) -> list[str]:
    troubles = []
    if store.engine.dialect.name == "sqlite":
        with sqlite3.connect(str(store.engine.url.database)) as connection:
            troubles += [f"SQLite: {row}" for row in connection.execute("PRAGMA integrity_check") if row != ("ok",)]
            troubles += [f"SQLite: {row}" for row in connection.execute("PRAGMA foreign_key_check")]
        connection.close()
    measurements, kept, tables = store.measurements(), store.identifications(), store.tables(figures=False)
    if any(count > 1 for count in Counter(item.measurement_id for item in kept).values()):
        troubles.append("a measurement was processed twice")
    if sorted(item.id for item in kept) != sorted(table.identification_id for table in tables):
        troubles.append("an identification without its tables")
    done = sorted(item.measurement_id for item in store.attempts() if item.outcome == "done")
    if done != sorted(item.measurement_id for item in kept):
        troubles.append("attempts and results differ")
    if [table.version for table in tables] != list(range(1, len(tables) + 1)):
        troubles.append("versions are missing")
    for item in measurements[-3:]:
        if list(store.contents_of(item).values()) != [(site.inbox / item.name).read_bytes()]:
            troubles.append(f"{item.name} is not kept as it was")
    return troubles


def _folder_troubles(site: Site, store: Store) -> list[str]:
    """Versions that are not whole, and a pointer to one that was never active; the last ones stand for all."""
    troubles = []
    tables = {f"v{table.version:04d}": table for table in store.tables(figures=False)}
    folders = sorted([*site.out.glob("v*"), *(site.out / "proposed").glob("[!.]*")])
    for folder in folders[-4:]:
        wanted = {file.name: file.content for file in store.table_files(tables[folder.name[-5:]])}
        names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
        if names != {*wanted, "version.json"} or any((folder / n).read_bytes() != wanted[n] for n in wanted):
            troubles.append(f"{folder.name} is not whole")
    pointer = site.out / "active"
    if os.path.lexists(pointer) and tables[os.readlink(pointer)].state not in ("active", "retired"):
        troubles.append("the pointer leads to a version that was never active")
    return troubles


def reached(site: Site, child: int, before: tuple[int, int]) -> str:
    """Say how far a runner came: what of its work stands."""
    store = site.store()
    try:
        known, kept = len(store.measurements()), len(store.identifications())
        claims: dict[int, str] = {}
        for row in store.read(lambda c: list(c.execute(sa.select(database.claims).order_by(database.claims.c.id)))):
            claims[row.measurement_id] = "" if row.kind == "release" else row.owner
        active = next((item for item in store.tables(figures=False) if item.state == "active"), None)
    finally:
        store.close()
    pointer = site.out / "active"
    shown = os.readlink(pointer) if os.path.lexists(pointer) else None
    if any(f"/{child}/" in owner for owner in claims.values()):
        return "while a measurement was processed"
    if shown != (None if active is None else f"v{active.version:04d}"):
        return "after tables were approved, before they were published"
    if kept > before[1]:
        return "after tables were published"
    return (
        "after new measurements were kept, before one was claimed" if known > before[0] else "before anything was kept"
    )


# --- killing -------------------------------------------------------------------------------------------------------


def one_round(site: Site, generator: np.random.Generator, full_s: float, runners: int, found: Findings) -> None:
    """Start runners, kill each at its own moment, and look."""
    store = site.store()
    before = (len(store.measurements()), len(store.identifications()))
    store.close()
    for _ in range(max(0, int(generator.integers(1, 4)) - (site.count - before[1]))):
        site.measure()
    start = time.monotonic()
    alive = {site.start(): start + generator.uniform(0.0, full_s) for _ in range(runners)}
    while alive:
        found.troubles += read_active(site)
        found.reads += 1
        for child, moment in list(alive.items()):
            due = time.monotonic() >= moment
            if due:
                os.kill(child, signal.SIGKILL)
            ended, status = os.waitpid(child, 0 if due else os.WNOHANG)
            if ended:
                del alive[child]
                if os.WIFSIGNALED(status):
                    found.killed[reached(site, child, before)] += 1
                else:
                    found.ended[os.waitstatus_to_exitcode(status)] += 1
        time.sleep(READ_EVERY_S)
    look(site, found)


def tables_of(site: Site) -> dict[str, list[tuple[str, bytes]]]:
    """Table files by the hash of their measurement."""
    store = site.store()
    try:
        hashes = {item.id: item.sha256 for item in store.measurements()}
        kept = {item.id: hashes[item.measurement_id] for item in store.identifications()}
        return {
            kept[table.identification_id]: [(file.name, file.content) for file in store.table_files(table)]
            for table in store.tables(figures=False)
        }
    finally:
        store.close()


def finish(site: Site, found: Findings) -> None:
    """Process the rest, and compare with a run that nobody disturbed."""
    if site.run() not in (0, 1):  # 1: two runners finished in another order, so an older measurement is held back
        found.troubles.append("the last run failed")
    look(site, found)
    if any(path.name.endswith(".tmp") for path in site.out.rglob("*")):
        found.troubles.append("files were left behind")
    tables = tables_of(site)
    site.folder.rename(site.folder.with_name("killed"))  # at the same place, which stands in the manifests
    undisturbed = Site(site.folder)
    for _ in range(site.count):
        undisturbed.measure()
    undisturbed.run()
    wanted = tables_of(undisturbed)
    if len(wanted) != site.count or tables != wanted:
        found.troubles.append(f"tables of {len(tables)} measurements, of which {site.count} were made, or other bytes")


def kill(folder: Path, kills: int, seed: int = 1, url: str | None = None) -> tuple[Site, Findings]:
    """Kill so many runners in a new site below ``folder`` and return it with what was found."""
    generator, found = np.random.default_rng(seed), Findings()
    site = Site(folder / "site", url)
    for _ in range(2):
        site.measure()
    site.run()  # also loads and compiles what the runners need
    site.measure()
    start = time.monotonic()
    site.run()
    full_s = 2.0 * (time.monotonic() - start)
    rounds = 0
    while found.killed.total() < kills and not found.troubles:
        rounds += 1
        ended = found.ended.total()
        one_round(site, generator, full_s, 2 if rounds % 3 == 0 else 1, found)
        full_s *= 1.05 if found.ended.total() == ended else 0.85  # so that a fourth of them comes to its end
    finish(site, found)
    return site, found


def main() -> None:
    """Kill, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--store", default=None, help="URL of an empty PostgreSQL database; default: SQLite")
    options = parser.parse_args()
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        with Path(os.devnull).open("w") as quiet, redirect_stderr(quiet):
            site, found = kill(Path(folder), options.kills, options.seed, options.store)
        print(f"{found.killed.total()} runners killed, {found.ended.total()} came to their end: {dict(found.ended)}")
        for name, count in found.killed.most_common():
            print(f"  {count:4d} {name}")
        print(f"{site.count} measurements, active tables read {found.reads} times, {time.monotonic() - start:.0f} s")
        print("\n".join(dict.fromkeys(found.troubles)) or "nothing lost, nothing half done, nothing done twice")


if __name__ == "__main__":
    main()
