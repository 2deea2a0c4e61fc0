"""Many machines in processes or on a Dask cluster: the same bytes as one after another; killed, stopped, refused."""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from compgen import parallel
from compgen import parallel as cluster
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.deviations import Deviations, format_deviations
from compgen.data.lengths import read_lengths
from compgen.data.machine import read_machine
from compgen.errors import CompgenWarning, InputError
from compgen.fleet import database
from compgen.fleet import runner as fleet
from compgen.fleet.database import StoreError
from compgen.fleet.job import read_job
from compgen.fleet.runner import run_jobs
from compgen.fleet.store import open_store
from compgen.fleet.watch import Watch
from compgen.identification import identify, self_check
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import volume_grid
from compgen.parallel import LostError, Packed, Processes, RemoteError, StoppedError, spread

_SPEC = importlib.util.spec_from_file_location("compgen_postgres", Path(__file__).resolve().parents[1] / "postgres.py")
postgres = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(postgres)
KILL = "__import__('os').kill(__import__('os').getpid(), 9)"
#: An expression that kills its process the first time that it is evaluated, and is 7 the second time.
ONCE = "7 if __import__('os').path.exists({0!r}) else open({0!r}, 'w').close() or " + KILL
#: Columns that say when and by whom, or number the rows in the order in which they came.
NOT_COMPARED = ("id", "at", "received_at", "owner", "seconds", "until")
#: A few seconds for everything that waits for processes, on a computer that has other things to do.
PATIENCE_S = 120.0
#: Dask's processes do not look every 10 ms at what they are doing.
ENVIRONMENT = {**os.environ, "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}


@pytest.fixture(scope="module")
def pool():
    with closing(Processes(2)) as found:
        yield found


#: A scheduler and two workers until stdin ends; a task may take one worker with it, not two.
SERVE = """
import sys
import dask
from distributed import LocalCluster

if __name__ == "__main__":
    dask.config.set({"distributed.scheduler.allowed-failures": 1})
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0") as made:
        print(made.scheduler_address, flush=True)
        sys.stdin.read()
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """Address of a Dask cluster on this machine, as somebody else started it."""
    pytest.importorskip("distributed")
    script = tmp_path_factory.mktemp("dask") / "serve.py"
    script.write_text(SERVE)
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": script.parent}
    options["env"] = ENVIRONMENT
    with subprocess.Popen([sys.executable, str(script)], **options) as process:
        yield process.stdout.readline().strip()
        process.stdin.close()
        process.wait(PATIENCE_S)


@pytest.fixture(scope="module")
def there(address):
    with closing(cluster.Cluster(address)) as found:
        yield found


# --- a factory -----------------------------------------------------------------------------------------------------


def write_measurement(path, machine, errors, seed, days):
    position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    noise = np.random.default_rng(seed).normal(0.0, 3e-4, position.shape)
    notes = {"measured_at": (datetime.now(UTC) - timedelta(days=days)).isoformat()}
    u_mm = np.full_like(noise, 3e-4)
    made = Deviations(position, exact_error(machine, errors, position) + noise, u_mm=u_mm, metadata=notes)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(format_deviations(made))


@pytest.fixture
def factory(tmp_path, small_machine, small_machine_file, small_errors):
    """Four machines: two with deviations, one of them twice, one with tracer lengths, one whose file is no good."""
    shutil.copy(small_machine_file, tmp_path / "mill.toml")
    names = ("a", "b", "c", "bad")
    (tmp_path / "recal.toml").write_text(
        '[defaults]\nmachine = "mill.toml"\ninbox = "inbox/{name}"\nout = "out/{name}"\n'
        'controllers = ["siemens-cec"]\nmeasured_with = "bare"\n' + "".join(f"[machines.{name}]\n" for name in names)
    )
    for number, (name, days) in enumerate([("a", 4), ("a", 3), ("b", 4)]):
        path = tmp_path / "inbox" / name / f"{number}.deviations.csv"
        write_measurement(path, small_machine, small_errors, number, days)
    for name in ("c", "bad"):
        (tmp_path / "inbox" / name).mkdir(parents=True)
    (tmp_path / "inbox" / "bad" / "x.deviations.csv").write_text("x_mm,y_mm,z_mm,dx_um\n0,0,nan,1\n")
    return tmp_path


def contents(folder):
    """Every file below ``out`` by name; of version.json all but the time at which it was made."""
    found = {}
    for path in sorted((folder / "out").rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = os.readlink(path)
        elif path.name == "version.json":
            found[name] = {key: value for key, value in json.loads(path.read_text()).items() if key != "made_at"}
        elif path.is_file():
            found[name] = path.read_bytes()
    return found


def rows_of(url):
    """All rows of the store in words: numbers of rows that it refers to are replaced by what stands there."""
    engine = sa.create_engine(url.replace("postgresql://", "postgresql+psycopg://"))
    with engine.connect() as connection:
        tables = {table.name: connection.execute(sa.select(table)).mappings().all() for table in database.ALL}
    engine.dispose()
    machine = {row["id"]: row["name"] for row in tables["machines"]}
    measurement = {row["id"]: (machine[row["machine_id"]], row["name"]) for row in tables["measurements"]}
    version = {row["id"]: (machine[row["machine_id"]], row["version"]) for row in tables["tables"]}
    identified = {row["id"]: measurement[row["measurement_id"]] for row in tables["identifications"]}
    made = {row["id"]: (machine[row["machine_id"]], row["sha256"]) for row in tables["machine_versions"]}
    words = {
        "machine_id": machine,
        "measurement_id": measurement,
        "table_id": version,
        "active_table_id": version,
        "identification_id": identified,
        "machine_version_id": made,
    }

    def worded(row):
        kept = {key: value for key, value in row.items() if key not in NOT_COMPARED}
        if isinstance(kept.get("summary"), dict):
            kept["summary"] = {key: value for key, value in kept["summary"].items() if key != "age_days"}
        return repr({key: words[key].get(value) if key in words else value for key, value in kept.items()})

    return {name: sorted(worded(row) for row in rows) for name, rows in tables.items()}


def fresh(folder):
    """Remove what a run made."""
    shutil.rmtree(folder / "out", ignore_errors=True)
    for path in folder.glob("recal.sqlite*"):
        path.unlink()


def made_by(folder, run):
    """What a run makes of the factory: outcomes, files, rows."""
    fresh(folder)
    job = read_job(folder / "recal.toml")
    outcomes = [(item.machine, item.state, item.messages, item.processed) for item in run(job).outcomes]
    return outcomes, contents(folder), rows_of(job.store)


# --- workers on other computers: a network and a file system of their own -------------------------------------------


class Apart:
    """Two workers, each in a network name space and with a /tmp of its own, and a scheduler and a store here."""

    def __init__(self, folder):
        number = os.getpid() % 200 + 20
        self.network, self.host = f"10.{number}.0.0/16", f"10.{number}.1.1"
        self.names = [f"compgen{os.getpid()}-{k}" for k in (1, 2)]
        self.processes = []
        try:
            for k, name in enumerate(self.names, start=1):
                here, inside, net = f"cg{number}h{k}", f"cg{number}w{k}", f"10.{number}.{k}"
                self.do("ip", "netns", "add", name)
                self.do("ip", "link", "add", here, "type", "veth", "peer", "name", inside, "netns", name)
                self.do("ip", "addr", "add", f"{net}.1/24", "dev", here)
                self.do("ip", "link", "set", here, "up")
                self.do("ip", "-n", name, "addr", "add", f"{net}.2/24", "dev", inside)
                for device in (inside, "lo"):
                    self.do("ip", "-n", name, "link", "set", device, "up")
                self.do("ip", "-n", name, "route", "add", "default", "via", f"{net}.1")
            self.do("unshare", "--mount", "true")
            self.server = postgres.Server(self.network)
            self.processes.append(self.started([sys.executable, "-c", SCHEDULE.format(self.host)], folder))
            self.address = self.processes[0].stdout.readline().strip()
            root = next(place for place in (folder, *folder.parents) if place.name.startswith("pytest-"))
            for name in self.names:
                worker = f"{sys.executable} -m distributed.cli.dask_worker {self.address} --nthreads 1 --no-dashboard"
                # what the tests wrote is hidden, and all of /tmp unless the program itself is there
                whole = [place for place in ("/dev/shm", "/tmp") if not Path(sys.prefix).is_relative_to(place)]
                hidden = [*whole, *([] if any(root.is_relative_to(place) for place in whole) else [root])]
                alone = " && ".join(
                    [*(f"mount -t tmpfs none {place}" for place in hidden), f"cd {hidden[-1]}", f"exec {worker}"]
                )
                command = ["ip", "netns", "exec", name, "unshare", "--mount", "sh", "-c", alone]
                self.processes.append(self.started(command, "/"))
        except BaseException:
            self.close()
            raise

    def do(self, *words):
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            self.close()
            pytest.skip(f"network name spaces are not permitted here: {' '.join(words)}: {done.stderr.strip()}")

    def started(self, command, folder):
        options = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
        return subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, **options)

    def close(self):
        for process in reversed(self.processes):
            process.terminate()
            process.wait(PATIENCE_S)
            process.stdout.close()
        if hasattr(self, "server"):
            self.server.close()
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)


#: A scheduler that workers of other computers reach, until it is ended.
SCHEDULE = """
import asyncio
from distributed import Scheduler

async def serve():
    async with Scheduler(host="{}", port=0, dashboard=False) as made:
        print(made.address, flush=True)
        await made.finished()

asyncio.run(serve())
"""


@pytest.fixture
def apart(tmp_path_factory):
    pytest.importorskip("distributed")
    if os.name != "posix" or os.getuid() != 0 or not shutil.which("ip") or not shutil.which("unshare"):
        pytest.skip("network name spaces need root, ip and unshare")
    if postgres.folder_of_programs() is None:
        pytest.skip("PostgreSQL (initdb, postgres) is not installed")
    with closing(Apart(tmp_path_factory.mktemp("apart"))) as made:
        yield made


def test_workers_that_share_nothing_but_the_store_give_the_same_bytes(factory, apart):
    """Neither inbox nor machine file nor output folder can be seen by a worker."""
    plain = (factory / "recal.toml").read_text()

    def made_on(workers):
        name = apart.server.database().partition("?")[0].rpartition("/")[2]
        (factory / "recal.toml").write_text(f'store = "postgresql://tester@{apart.host}/{name}"\n{plain}')
        return made_by(factory, workers)

    with closing(cluster.Cluster(apart.address)) as there:
        until = time.monotonic() + PATIENCE_S
        while len(seen := there._client.run(os.path.exists, str(factory / "recal.toml"))) < 2:
            assert time.monotonic() < until
            time.sleep(0.1)
        assert list(seen.values()) == [False, False]
        local = made_on(run_jobs)
        assert [item[1] for item in local[0]] == ["ok", "ok", "ok", "failed"]
        assert made_on(lambda job: fleet.run_with(there, job)) == local
        again = fleet.run_with(there, read_job(factory / "recal.toml"))
        assert [item.processed for item in again.outcomes] == [()] * 4
        shutil.copy(factory / "inbox" / "a" / "1.deviations.csv", factory / "inbox" / "b" / "9.deviations.csv")
        local = made_on(lambda job: run_jobs(job, ["a"]))
        assert "the same file also came for b (its inbox)" in local[0][0][2][0]
        assert made_on(lambda job: fleet.run_with(there, job, ["a"])) == local


# --- the same results ----------------------------------------------------------------------------------------------


def test_one_after_another_in_processes_and_on_a_cluster_give_the_same_bytes(factory, small_lengths_file, pool, there):
    shutil.copy(small_lengths_file, factory / "inbox" / "c" / "c.lengths.csv")
    os.utime(factory / "inbox" / "c" / "c.lengths.csv", (time.time() - 86400,) * 2)
    local = made_by(factory, run_jobs)
    outcomes, files, rows = local
    assert [state for _, state, _, _ in outcomes] == ["ok", "ok", "ok", "failed"]
    assert len([name for name in files if name.endswith("NC_CEC.INI")]) == 3
    assert len(rows["tables"]) == 4
    assert made_by(factory, lambda job: fleet.run_with(pool, job)) == local
    assert made_by(factory, lambda job: fleet.run_with(there, job)) == local


def test_a_second_pass_on_a_cluster_changes_nothing(factory, there):
    job = read_job(factory / "recal.toml")
    first = fleet.run_with(there, job)
    before = contents(factory), rows_of(job.store)
    again = fleet.run_with(there, job)
    assert [item.processed for item in again.outcomes] == [()] * 4
    assert again.exit_code == first.exit_code
    assert (contents(factory), rows_of(job.store)) == before


def test_the_self_check_gives_the_same_numbers_in_processes_and_on_a_cluster(
    pool, there, small_machine_file, small_lengths_file
):
    machine, lengths = read_machine(small_machine_file), read_lengths(small_lengths_file)
    case = machine, lengths, identify(machine, lengths)
    identify(machine, lengths)  # from the second in a process on compiled loops are loaded, which round differently
    here = self_check(*case, replicates=10, seed=3)
    assert self_check(*case, replicates=10, seed=3, mapper=lambda f, items: spread(pool, f, items)) == here
    assert self_check(*case, replicates=10, seed=3, mapper=lambda f, items: spread(there, f, items)) == here
    assert self_check(*case, replicates=10, seed=4) != here


def test_diagnoses_of_many_measurements_are_the_same_in_processes(
    pool, small_machine_file, small_lengths_file, tmp_path, monkeypatch, capsys, listing
):
    lines = [line for line in small_lengths_file.read_text().splitlines(keepends=True) if "rows" not in line]
    kept = [line for k, line in enumerate(lines) if k < 20 or k % 7]
    (tmp_path / "short.lengths.csv").write_text("".join(kept))
    (tmp_path / "wrong.lengths.csv").write_text("station\n")
    shutil.copy(small_lengths_file, tmp_path / "whole.lengths.csv")
    files = [str(tmp_path / f"{name}.lengths.csv") for name in ("whole", "wrong", "short")]
    words = ["diagnose", str(small_machine_file), *files, "--each", "--max-effects", "0"]
    code = run_command(cli, [*words, "--out", str(tmp_path / "here")])
    said = capsys.readouterr().out
    assert code == 1 and "wrong.lengths.csv: " in said
    monkeypatch.setattr(pool, "close", lambda: None)
    monkeypatch.setattr(parallel, "opened_workers", lambda workers, address: pool)
    assert run_command(cli, [*words, "--out", str(tmp_path / "there"), "--workers", "2"]) == code
    assert capsys.readouterr().out == said
    assert listing(tmp_path / "here") == listing(tmp_path / "there")
    assert (tmp_path / "here" / "short" / "diagnosis.json").is_file()


# --- the mapper ----------------------------------------------------------------------------------------------------


def test_results_come_in_the_order_of_the_items(pool):
    items = [f"__import__('time').sleep({0.05 * (k % 3)}) or {k}" for k in range(12)]
    assert list(spread(pool, eval, items)) == list(range(12))


def test_a_process_that_is_killed_is_replaced_and_its_item_tried_once_more(pool, tmp_path):
    items = ["1", ONCE.format(str(tmp_path / "seen")), "3"]
    assert list(spread(pool, eval, items)) == [1, 7, 3]


def test_an_item_that_kills_twice_is_lost_and_the_others_go_on(pool):
    found = list(spread(pool, eval, ["1", KILL, "3", "4"], lost=lambda item, error: str(error)))
    assert found[::2] == [1, 3]
    assert "killed, twice" in found[1]
    with pytest.raises(LostError):
        list(spread(pool, eval, [KILL]))


@pytest.mark.parametrize(
    ("text", "kind", "said", "code"),
    [
        ("InputError('is wrong', file='a.csv', line=3)", InputError, "a.csv:3: is wrong", 2),
        ("UndeterminedError('is open', ['EXX'])", RemoteError, "is open", 1),
        ("type('Own', (Exception,), {})('odd')", RemoteError, "Own: odd", 3),
    ],
)
def test_an_error_of_another_process_keeps_its_text_and_exit_code(pool, text, kind, said, code):
    source = f"exec('from compgen.errors import *; raise ' + {text!r})"
    with pytest.raises(kind) as caught:
        list(spread(pool, eval, [source]))
    assert str(caught.value) == said
    assert caught.value.exit_code == code


def test_warnings_of_another_process_are_given_here(pool):
    source = "exec('import warnings; from compgen.errors import *; warnings.warn(\"look here\", CompgenWarning)')"
    with pytest.warns(CompgenWarning, match="look here"):
        assert list(spread(pool, eval, [source])) == [None]


class Counting:
    """Workers that count what they were given."""

    size = 2

    def call(self, function, item, stop):
        if stop():
            raise StoppedError("not started: stopped")
        return item.value()

    def close(self):
        pass


def test_only_some_items_are_under_way_at_a_time():
    taken = []
    results = spread(Counting(), str, (taken.append(k) or k for k in range(10_000)))
    for expected in range(100):
        assert next(results) == expected
        assert len(taken) <= expected + 1 + parallel.AHEAD * Counting.size
    results.close()


def test_what_is_stopped_is_not_begun():
    asked = threading.Event()
    results = spread(Counting(), str, range(10_000), lost=lambda item, error: None, stop=asked.is_set)
    assert next(results) == 0
    asked.set()
    assert list(results)[-1] is None


def test_worker_processes_end_with_the_one_that_started_them_even_if_it_is_killed(tmp_path):
    text = (
        "from compgen.parallel import *\n"
        "if __name__ == '__main__':\n"
        "    sleeping = \"print(__import__('os').getpid(), flush=True) or __import__('time').sleep(600)\"\n"
        "    list(spread(Processes(1), eval, [sleeping]))\n"
    )
    (tmp_path / "main.py").write_text(text)
    process = subprocess.Popen([sys.executable, str(tmp_path / "main.py")], stdout=subprocess.PIPE, text=True)
    worker = int(process.stdout.readline())
    process.kill()
    process.wait()
    process.stdout.close()
    assert ended(worker)


def ended(pid):
    """Whether a process ends, or is a corpse that nobody has buried yet."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.05)
    return False


# --- processes -----------------------------------------------------------------------------------------------------


def test_a_machine_whose_process_is_killed_fails_and_the_others_go_on(factory, pool):
    text = (factory / "recal.toml").read_text()
    killed = "[machines.b]\nnotify = ['sh', '-c', 'kill -9 $PPID']\n"  # the parent of the command is the worker
    (factory / "recal.toml").write_text(text.replace("[machines.b]\n", killed).replace("[machines.bad]\n", ""))
    outcome = fleet.run_with(pool, read_job(factory / "recal.toml"))
    states = {item.machine: (item.state, item.processed) for item in outcome.outcomes}
    assert states["a"] == ("ok", ("0.deviations.csv", "1.deviations.csv"))
    assert states["b"] == ("failed", ())
    assert "killed, twice" in outcome.outcomes[1].messages[0]
    assert outcome.exit_code == 1
    (factory / "recal.toml").write_text(text)
    again = run_jobs(read_job(factory / "recal.toml"), ["b"])  # what it had done was kept
    assert (again.outcomes[0].state, again.outcomes[0].waiting) == ("ok", (1,))


def test_on_sigterm_running_measurements_are_finished_and_the_rest_waits(factory, small_machine, small_errors):
    more = [f"m{k}" for k in range(12)]
    with (factory / "recal.toml").open("a") as stream:
        stream.write("".join(f"[machines.{name}]\n" for name in more))
    for number, name in enumerate(more):
        path = factory / "inbox" / name / "x.deviations.csv"
        write_measurement(path, small_machine, small_errors, number, 2)
    words = [sys.executable, "-m", "compgen", "recal", "run", "--workers", "2", "--json", "--log", "json"]
    process = subprocess.Popen(words, cwd=factory, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    line = next(line for line in process.stderr if "measurement processed" in line)
    process.send_signal(signal.SIGTERM)
    out, rest = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130, rest
    found = json.loads(out)["machines"]
    assert json.loads(line)["event"] == "measurement processed"
    assert any("stopped" in text for item in found for text in item["messages"])
    job = read_job(factory / "recal.toml")
    claims = database.claims
    store = open_store(job.store)
    kinds = store.read(lambda c: [row[0] for row in c.execute(sa.select(claims.c.kind).order_by(claims.c.id))])
    store.close()
    assert kinds.count("take") == kinds.count("release")  # nobody was interrupted
    assert {item.state for item in run_jobs(job).outcomes if item.machine != "bad"} == {"ok"}


def test_a_watch_works_through_processes_and_reports_a_lost_machine(factory, pool):
    text = (factory / "recal.toml").read_text()
    killed = "[machines.b]\nnotify = ['sh', '-c', 'kill -9 $PPID']\n"
    (factory / "recal.toml").write_text(text.replace("[machines.b]\n", killed))
    found = []
    watch = Watch(factory / "recal.toml", work=fleet.work_of(pool), threads=2, on_outcome=found.append, poll_s=0.05)
    thread = threading.Thread(target=watch.run, kwargs={"signals": False})
    thread.start()
    until = time.monotonic() + PATIENCE_S
    while len({item.machine for item in found}) < 4 and time.monotonic() < until:
        time.sleep(0.05)
    watch.stop()
    thread.join()
    first = {item.machine: item for item in reversed(found)}  # what failed may have had a second look by now
    states = {name: item.state for name, item in first.items()}
    assert states == {"a": "ok", "b": "failed", "c": "ok", "bad": "failed"}
    assert first["a"].active is None


# --- the cluster ---------------------------------------------------------------------------------------------------


def test_a_lost_worker_is_replaced_by_another_and_an_item_that_takes_every_worker_is_lost(there, tmp_path):
    assert list(spread(there, eval, [ONCE.format(str(tmp_path / "seen")), "1"])) == [7, 1]
    (found,) = spread(there, eval, [KILL], lost=lambda item, error: str(error))
    assert "was lost" in found
    assert list(spread(there, eval, ["3", "4"])) == [3, 4]


def test_a_scheduler_that_does_not_answer_is_exit_code_2_within_seconds(factory, capsys, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    began = time.monotonic()
    words = ["recal", "run", "--job", str(factory / "recal.toml"), "--cluster", "tcp://127.0.0.1:9"]
    assert run_command(cli, words) == 2
    assert time.monotonic() - began < 30.0
    assert "no Dask scheduler answers at tcp://127.0.0.1:9 within 1 s" in " ".join(capsys.readouterr().err.split())
    assert not (factory / "out").exists()


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"install compgen\[cluster\]"):
        cluster.Cluster("tcp://127.0.0.1:9")


def test_other_versions_are_refused_before_anything_is_sent(address, monkeypatch):
    mine = cluster.facts(host=False).versions
    monkeypatch.setattr(cluster, "facts", lambda *, host: cluster.WorkerFacts((("compgen", "99.0"), *mine[1:])))
    with pytest.raises(cluster.ClusterError, match=f"the scheduler has compgen {mine[0][1]} instead of 99.0"):
        cluster.Cluster(address)


def test_a_worker_of_another_version_that_comes_later_is_refused_too(there, monkeypatch):
    monkeypatch.setattr(there, "_required", cluster.WorkerFacts((("compgen", "99.0"), ("numpy", np.__version__))))
    with pytest.raises(cluster.ClusterError, match=r"a worker has compgen .* instead of 99.0"):
        list(spread(there, eval, ["1"]))


def test_an_sqlite_store_needs_workers_on_this_machine(factory, address, monkeypatch):
    url = read_job(factory / "recal.toml").store
    fleet.open_fleet(url, 1, address).close()
    monkeypatch.setattr(cluster, "gethostname", lambda: "elsewhere")
    cluster.facts.cache_clear()
    with pytest.raises(cluster.ClusterError, match=r"this is elsewhere; the store is an SQLite file.*postgresql://"):
        fleet.open_fleet(url, 1, address)
    cluster.facts.cache_clear()
    fleet.open_fleet("postgresql://u@db/n", 1, address).close()


def test_a_password_stands_in_no_log_no_key_and_no_text(factory, there, capfd, monkeypatch):
    url = "postgresql://ada:hush-hush@127.0.0.1:9/n"
    job = read_job(factory / "recal.toml").machine("a")
    keys = []
    client = there._client
    real = client.submit
    monkeypatch.setattr(
        client, "submit", lambda *args, **options: keys.append(options["key"]) or real(*args, **options)
    )
    outcome = fleet.work_of(there)(job, url, lambda: False)
    there_too = there.call(Packed(fleet.pass_of(url)), Packed(job), lambda: False)
    with pytest.raises(StoreError) as away:
        there.call(Packed(fleet.StoredPass(url, "json")), Packed(fleet.Parcel.of(job)), lambda: False)
    broken = real(cluster.perform_there, None, Packed(fleet.StoredPass(url, "json")), Packed(fleet.Parcel.of(job)))
    assert isinstance(broken.exception(), AttributeError)  # Dask shows the arguments of such a task
    logs = str(client.get_worker_logs()) + str(client.get_scheduler_logs())
    assert outcome.state == "failed" and "ada:***@127.0.0.1" in outcome.messages[0]
    assert "Compute Failed" in logs
    assert there_too.state == "failed" and "ada:***@127.0.0.1" in there_too.messages[0]
    assert "ada:***@127.0.0.1" in str(away.value)
    seen = "".join(capfd.readouterr()) + str(outcome) + str(there_too) + repr(fleet.StoredPass(url, "json"))
    assert len(keys) == 2 and "hush" not in logs + seen + "".join(keys)


def test_workers_and_cluster_together_are_wrong_usage(factory, capsys):
    words = ["recal", "run", "--job", str(factory / "recal.toml"), "--cluster", "tcp://h:1", "--workers", "2"]
    assert run_command(cli, words) == 2
    assert "cannot be combined" in capsys.readouterr().err


def test_a_process_takes_no_module_from_the_working_folder(tmp_path, monkeypatch):
    """Python begins a process with the working folder as the first place of modules, also of those that it needs itself."""
    marker = tmp_path / "PWNED"
    for name in ("socket", "tempfile", "selectors", "struct", "random", "numpy", "compgen"):
        (tmp_path / f"{name}.py").write_text(f"open({str(marker)!r}, 'a').write(__name__)\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    with closing(Processes(1)) as processes:
        assert processes.call(Packed(len), Packed([1, 2]), lambda: False) == 2
    assert not marker.exists()
    assert "PYTHONSAFEPATH" not in os.environ
