"""Recalibration of many machines: cost of a job on a cluster, and of a pass over thousands of inboxes; prints tables.

    python benchmarks/recal.py cluster [--machines 1000] [--workers 2] [--plain 100]
    python benchmarks/recal.py inboxes [--sizes 100,1000,10000] [--new 0.01]

``cluster``: every machine has one new measurement; all of the chain runs (identify, fit, export, read back, verify,
judge, keep, publish), on a local Dask cluster of so many processes, against the plain loop ``compgen.run`` into one
folder, without store and cluster, over the first machines.

``inboxes``: a pass in which every inbox has a new measurement, passes in which none has, and one in which some have. In
place of the chain a stand-in gives the files of one real run, marked with the name of the machine. Each size runs in a
process of its own, whose peak memory is shown.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import compgen
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.machine import Machine, load_machine
from compgen.data.names import error_named
from compgen.fleet import logs, runner
from compgen.fleet.job import Job, read_job
from compgen.fleet.process import Processed, process
from compgen.fleet.records import MachineRecord, MeasurementRecord, NewResult, StoredTableFile
from compgen.fleet.runner import run_fleet
from compgen.fleet.status import status
from compgen.fleet.store import Store, open_store
from compgen.kinematics import modelled_errors
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.kernel_switch import one_thread
from compgen.kinematics.many_points import volume_grid

CONTROL = "siemens-cec"
NOISE_MM = 3e-4
MACHINE = """\
name = "mill"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [-50.0, 100.0, -40.0]
[axes.X]
range_mm = [-300.0, 200.0]
nodes = 6
[axes.Y]
range_mm = [-100.0, 300.0]
nodes = 5
[axes.Z]
range_mm = [-240.0, 0.0]
nodes = 7
[controllers.siemens-cec]
sign = "error"
mult_mode = "S1"
"""
JOB = f"""\
[defaults]
machine = "mill.toml"
inbox = "inbox/{{name}}"
out = "out/{{name}}"
controllers = ["{CONTROL}"]
measured_with = "bare"
[defaults.policy]
max_age_days = 100000
"""


# --- simulated machines --------------------------------------------------------------------------------------------


def measurement_text(machine: Machine, seed: int) -> str:
    """Deviations of a machine with errors of its own on the grid of its nodes, with noise, as a file."""
    draw = np.random.default_rng(seed)
    curves, constants = {}, {}
    for name in modelled_errors(machine):
        error = error_named(name)
        if error.kind == "squareness":
            constants[name] = (draw.normal(0.0, 20e-6), 0.0)
            continue
        nodes = machine.axes[error.axis].nodes_mm
        share = (nodes - nodes[0]) / (nodes[-1] - nodes[0])
        size = 10e-6 if error.kind == "angular" else 5e-3
        curves[name] = compgen.Curve(nodes, size * draw.normal() * np.sin(3.0 * share), np.zeros(len(nodes)))
    errors = compgen.ErrorTable(curves, constants)
    position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    deviation = exact_error(machine, errors, position)
    deviation += draw.normal(0.0, NOISE_MM, deviation.shape)
    notes = {"measured_at": "2026-01-05T06:00:00+00:00", "u_deviation_um": str(1e3 * NOISE_MM)}
    return format_deviations(Deviations(position, deviation, u_mm=np.full_like(deviation, NOISE_MM), metadata=notes))


def factory(folder: Path, count: int, text_of: Callable[[Machine, int], str]) -> Job:
    """Make a folder with a job file for so many machines, each with one measurement in its inbox."""
    (folder / "mill.toml").write_text(MACHINE)
    machine = load_machine(str(folder / "mill.toml"))
    names = [f"mill-{number:05d}" for number in range(count)]
    for number, name in enumerate(names):
        inbox = folder / "inbox" / name
        inbox.mkdir(parents=True)
        (inbox / "a.deviations.csv").write_text(text_of(machine, number))
    (folder / "recal.toml").write_text(JOB + "".join(f"[machines.{name}]\n" for name in names))
    return read_job(folder / "recal.toml")


class Timer:
    """Time by the clock and of this process's processor since it was made, s."""

    def __init__(self) -> None:
        self.begin = time.perf_counter(), time.process_time()

    def spent(self) -> tuple[float, float]:
        """Return both."""
        return time.perf_counter() - self.begin[0], time.process_time() - self.begin[1]


# --- jobs on a cluster ---------------------------------------------------------------------------------------------


def plain_loop(job: Job, count: int, folder: Path) -> tuple[float, float]:
    """Run the chain for the first machines one after another; times of one, s."""
    machine = load_machine(str(job.path.parent / "mill.toml"))
    chosen = list(job.machines.values())[:count]
    with one_thread():
        compgen.run(machine, [chosen[0].inbox / "a.deviations.csv"], [CONTROL], folder / "first")
        timer = Timer()
        for item in chosen:
            compgen.run(machine, [item.inbox / "a.deviations.csv"], [CONTROL], folder / item.name)
    clock, processor = timer.spent()
    return clock / len(chosen), processor / len(chosen)


def processor_time() -> float:
    """Return the processor time of this process, s; the workers are asked for it."""
    return time.process_time()


#: Memory that the workers keep instead of giving every array back; Dask's own setting is 65536 bytes, which costs a
#: third of the time. See docs/recal.md.
ALLOCATION = {"MALLOC_TRIM_THRESHOLD_": 64 << 20, "MALLOC_MMAP_THRESHOLD_": 32 << 20}


def on_cluster(job: Job, workers: int) -> dict[str, float]:
    """Run all machines on a local cluster; seconds by the clock and of all processors."""
    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.nanny.pre-spawn-environ": {**ALLOCATION, "OMP_NUM_THREADS": 1}})

    options = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with LocalCluster(**options) as cluster, Client(cluster, set_as_default=False) as client:
        client.run(logs.configure, "json")
        before = sum(client.run(processor_time).values())
        timer = Timer()
        outcome = run_fleet(job, cluster=cluster.scheduler_address)
        clock, here = timer.spent()
        there = sum(client.run(processor_time).values()) - before
    wrong = [item for item in outcome.outcomes if item.state != "ok" or not item.processed]
    if wrong:
        raise SystemExit(f"{len(wrong)} machines failed: {wrong[0]}")
    return {"clock_s": clock, "workers_s": there, "here_s": here}


def cluster_table(machines: int, workers: int, plain: int) -> list[str]:
    """Measure and return the table of jobs on a cluster."""
    with tempfile.TemporaryDirectory() as name:
        job = factory(Path(name), machines, measurement_text)
        plain_clock, plain_processor = plain_loop(job, min(plain, machines), Path(name) / "plain")
        found = on_cluster(job, workers)
    per_job = {key: value / machines for key, value in found.items()}
    processor = per_job["workers_s"] + per_job["here_s"]
    return [
        "| recalibrations | by the clock | processor time |",
        "|---|---|---|",
        f"| plain loop of `compgen.run`, one process, each | {1e3 * plain_clock:.0f} ms | {1e3 * plain_processor:.0f} ms |",
        f"| {machines} on {workers} workers, all | {found['clock_s']:.0f} s | "
        f"{found['workers_s'] + found['here_s']:.0f} s |",
        f"| the same, each | {1e3 * per_job['clock_s']:.0f} ms | {1e3 * processor:.0f} ms |",
        f"| of which scheduler and client | | {1e3 * per_job['here_s']:.1f} ms |",
        f"| overhead of store, judgement, publishing and cluster, each | | {1e3 * (processor - plain_processor):.0f} ms |",
    ]


# --- many inboxes --------------------------------------------------------------------------------------------------


class StandIn:
    """In place of the chain: the result of one real run, marked with the name of the machine."""

    def __init__(self) -> None:
        self.result: NewResult | None = None

    def __call__(self, store: Store, job: Any, machine: MachineRecord, measurement: MeasurementRecord) -> Processed:
        """Return the result for one machine; the first call runs the chain."""
        if self.result is None:
            self.result = process(store, job, machine, measurement).result
        mark = f"\n# {machine.name} {measurement.name}\n".encode()
        found = self.result
        files = tuple(StoredTableFile(item.controller, item.name, item.content + mark) for item in found.files)
        made = replace(found, files=files, errors_text=found.errors_text + mark, fitted_text=found.fitted_text + mark)
        active = next((table.id for table in store.tables(machine) if table.state == "active"), None)
        return Processed(replace(made, settings_sha256=job.settings_sha256()), active)


def pass_over(job: Job, rows: list[dict[str, Any]], what: str, count: int) -> None:
    """Make one pass and add its costs."""
    timer = Timer()
    outcome = runner.run_jobs(job)
    clock, processor = timer.spent()
    if len([item for item in outcome.outcomes if item.processed]) != count:
        raise SystemExit(f"{what}: not {count} measurements were processed: {outcome.outcomes[0]}")
    rows.append({"what": what, "clock_s": clock, "processor_s": processor})


def one_size(size: int, share: float) -> dict[str, Any]:
    """Measure the passes over so many inboxes, in this process."""
    logs.info = lambda *_, **__: None  # type: ignore[assignment]
    runner.process = StandIn()  # type: ignore[assignment]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        first = measurement_text(_machine(Path(name)), 0)
        timer = Timer()
        job = factory(Path(name), size, lambda _, number: f"# number = {number}\n{first}")
        pass_over(job, rows, "all new", size)
        pass_over(job, rows, "nothing new", 0)
        some = list(job.machines.values())[:: max(1, round(1 / share))]
        for machine in some:
            (machine.inbox / "b.deviations.csv").write_text(f"# second = {machine.name}\n{first}")
        pass_over(job, rows, f"{100 * share:g} % new", len(some))
        timer = Timer()
        read_job(job.path)
        rows.append({"what": "job file", **dict(zip(("clock_s", "processor_s"), timer.spent(), strict=True))})
        store, timer = open_store(job.store), Timer()
        status(store, job)
        rows.append({"what": "status", **dict(zip(("clock_s", "processor_s"), timer.spent(), strict=True))})
        store.close()
        size_mb = Path(job.store.removeprefix("sqlite:///")).stat().st_size / 1e6
        shutil.rmtree(Path(name) / "out", ignore_errors=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"size": size, "peak_mb": peak, "store_mb": size_mb, "rows": rows}


def _machine(folder: Path) -> Machine:
    (folder / "mill.toml").write_text(MACHINE)
    return load_machine(str(folder / "mill.toml"))


def inboxes_table(sizes: list[int], share: float) -> list[str]:
    """Measure every size in a process of its own and return the table."""
    found = []
    for size in sizes:
        words = [sys.executable, __file__, "one-size", str(size), str(share)]
        found.append(json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout))
        print(found[-1], file=sys.stderr)
    names = [row["what"] for row in found[0]["rows"]]
    lines = ["| machines | " + " | ".join(names) + " | peak memory | store |", "|---" * (len(names) + 3) + "|"]
    for item in found:
        costs = [
            f"{1e3 * row['processor_s'] / item['size']:.2f} ms ({1e3 * row['clock_s'] / item['size']:.2f})"
            for row in item["rows"]
        ]
        lines.append(f"| {item['size']} | {' | '.join(costs)} | {item['peak_mb']:.0f} MB | {item['store_mb']:.0f} MB |")
    return [*lines, "", "Processor time of each machine (by the clock)."]


def parsed() -> argparse.Namespace:
    """Arguments of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    cluster = kinds.add_parser("cluster")
    cluster.add_argument("--machines", type=int, default=1000, help="recalibrations")
    cluster.add_argument("--workers", type=int, default=2, help="processes of the local cluster")
    cluster.add_argument("--plain", type=int, default=100, help="machines of the plain loop")
    inboxes = kinds.add_parser("inboxes")
    inboxes.add_argument("--sizes", default="100,1000,10000", help="numbers of machines, with commas between")
    inboxes.add_argument("--new", type=float, default=0.01, help="share of inboxes with something new")
    one = kinds.add_parser("one-size", help="what inboxes starts for each size")
    one.add_argument("size", type=int)
    one.add_argument("share", type=float)
    return parser.parse_args()


def main() -> None:
    """Run the benchmark."""
    options = parsed()
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    if options.kind == "one-size":
        print(json.dumps(one_size(options.size, options.share)))
        return
    if options.kind == "cluster":
        lines = cluster_table(options.machines, options.workers, options.plain)
    else:
        lines = inboxes_table([int(size) for size in options.sizes.split(",")], options.new)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print("\n".join([*lines, "", f"{os.cpu_count()} processors, load over 1, 5, 15 minutes at the end: {load}."]))


if __name__ == "__main__":
    main()
