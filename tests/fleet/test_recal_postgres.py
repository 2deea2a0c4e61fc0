"""The store on a real PostgreSQL server, which the tests start for themselves."""

import importlib.util
import json
import os
import re
import sys
import threading
import time
from collections import Counter
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.errors import InputError
from compgen.fleet import claims, database, runner
from compgen.fleet import store as store_module
from compgen.fleet.database import StoreError
from compgen.fleet.records import NewMeasurement
from compgen.fleet.store import backup, open_store, restore
from compgen.fleet.watch import Watch

HERE = Path(__file__).resolve().parents[1]
#: What a page says while its figures are not there yet.
UNDER_WAY = re.compile("being calculated")


def _loaded(path):
    spec = importlib.util.spec_from_file_location(f"compgen_{path.stem}", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


postgres = _loaded(HERE / "postgres.py")
faults = _loaded(HERE.parent / "benchmarks" / "recal_faults.py")
pytestmark = pytest.mark.skipif(
    postgres.folder_of_programs() is None,
    reason="PostgreSQL (initdb, postgres) is not installed: the store is not tested on it",
)
MIGRATIONS = Path(database.__file__).with_name("migrations")


def _config():
    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS))
    return config


REVISIONS = [script.revision for script in ScriptDirectory.from_config(_config()).walk_revisions()]


@pytest.fixture(scope="session")
def server():
    """One server for this process."""
    made = postgres.Server()
    yield made
    made.close()


@pytest.fixture
def url(server):
    """Address of a new, empty database."""
    return server.database()


@pytest.fixture
def opened():
    """A function that opens stores; they are closed at the end."""
    stores = []

    def opening(address, **options):
        stores.append(open_store(address, **options))
        return stores[-1]

    yield opening
    for store in stores:
        store.close()


@pytest.fixture
def site(url, tmp_path):
    """A machine with an inbox whose store is on the server."""
    return faults.Site(tmp_path / "site", url)


@pytest.fixture
def impatient(monkeypatch):
    """Waits between attempts are short."""
    monkeypatch.setattr(database, "WAITS_S", (0.05, 0.1))


def everything(store):
    with store.engine.connect() as connection:
        return {table.name: sorted(connection.execute(sa.select(table)).all(), key=repr) for table in database.ALL}


def exit_of(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


# --- schema --------------------------------------------------------------------------------------------------------


#: One row of everything that refers to a machine, as the first version of the schema had it.
OLD_ROWS = f"""
INSERT INTO machines (name, at) VALUES ('old', '2025-01-01 00:00:00');
INSERT INTO blobs (sha256, size, deflated) VALUES ('{"a" * 64}', 1, '');
INSERT INTO machine_versions (machine_id, sha256, at) VALUES (1, '{"a" * 64}', '2025-01-01');
INSERT INTO measurements (machine_id, sha256, name, measured_at, measured_at_source, received_at, temperatures_c)
  VALUES (1, '{"b" * 64}', 'm', '2025-01-01', 'file', '2025-01-02', '{{"temp_x_c": {{"mean": 20.5}}}}');
INSERT INTO identifications (machine_id, measurement_id, machine_version_id, errors_sha256, summary, program, at)
  VALUES (1, 1, 1, '{"a" * 64}', '{{"rms": 0.5}}', '1', '2025-01-02');
INSERT INTO tables (machine_id, version, identification_id, accepted, controllers, reasons, summary, at)
  VALUES (1, 1, 1, true, '["isg-csv"]', '[]', '{{}}', '2025-01-02');
INSERT INTO decisions (machine_id, sequence, table_id, kind, actor, reason, at)
  VALUES (1, 1, 1, 'approve', 'ada', 'why', '2025-01-02');
"""


@pytest.mark.parametrize("kind", ["postgresql", "sqlite"])
@pytest.mark.parametrize("revision", REVISIONS)
def test_a_store_of_every_version_is_upgraded_to_the_schema_of_the_program(url, opened, tmp_path, kind, revision):
    address = url if kind == "postgresql" else f"sqlite:///{tmp_path}/old.sqlite"
    engine, config = database.engine_of(address), _config()
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.upgrade(config, revision)
        for statement in OLD_ROWS.split(";\n")[:-1]:
            connection.exec_driver_sql(statement)
    engine.dispose()
    store = opened(address)
    assert [(machine.name, machine.at) for machine in store.machines()] == [("old", datetime(2025, 1, 1, tzinfo=UTC))]
    assert [item.temperatures_c for item in store.measurements()] == [{"temp_x_c": {"mean": 20.5}}]
    assert [(item.summary, item.measurement_id) for item in store.identifications()] == [({"rms": 0.5}, 1)]
    assert [(table.version, table.state, table.controllers) for table in store.tables()] == [(1, "active", ["isg-csv"])]
    with store.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), database.metadata) == []
    for table in ("machines", "identifications", "decisions"):
        with pytest.raises((StoreError, sa.exc.IntegrityError), match="new rows only"):
            store.write(lambda connection, name=table: connection.execute(sa.text(f"DELETE FROM {name}")))
    assert store.add_machine("new").id == 2


def test_many_that_open_a_new_store_at_once_upgrade_it_once(url, opened):
    found = []
    threads = [threading.Thread(target=lambda: found.append(opened(url).add_machine("mill").id)) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [1] * 6


@pytest.fixture(scope="module")
def filled(server, tmp_path_factory):
    """The store of a machine with one set of tables, and its address."""
    site = faults.Site(tmp_path_factory.mktemp("filled") / "site", server.database())
    site.measure()
    assert site.run() == 0
    store = site.store()
    store.add_event("clock", "clock", "text", store.machine("mill"))
    yield store
    store.close()


@pytest.mark.parametrize("table", [table.name for table in database.ALL])
@pytest.mark.parametrize("action", ["UPDATE {} SET {} = NULL", "DELETE FROM {}", "TRUNCATE {} CASCADE"])
def test_the_database_refuses_to_change_or_remove_a_row(filled, server, table, action):
    import psycopg

    column = list(database.metadata.tables[table].columns)[-1].name
    name = filled.engine.url.database
    before = server.sql(f"SELECT count(*) FROM {table}", name)
    assert before[0][0] > 0
    with pytest.raises(psycopg.errors.RaiseException, match="append-only: .* takes new rows only"):
        server.sql(action.format(table, f'"{column}"'), name)
    assert server.sql(f"SELECT count(*) FROM {table}", name) == before


def test_a_result_of_class_none_is_found_to_be_without_prior(filled):
    assert filled.without_prior() == filled.without_prior(filled.machine("mill")) == {1}
    named = sa.select(database.identifications.c.summary[("prior", "class")].as_string())
    assert filled.read(lambda connection: connection.execute(named).scalars().all()) == ["none"]


# --- the whole way -------------------------------------------------------------------------------------------------


def test_the_whole_way_by_commands(site, monkeypatch, capsys):
    monkeypatch.chdir(site.folder)
    text = (site.folder / "recal.toml").read_text()
    (site.folder / "recal.toml").write_text(text.replace('approval = "auto"', 'approval = "manual"'))

    def said(*words):
        code = run_command(cli, ["recal", *words, "--json"])
        return code, json.loads(capsys.readouterr().out)

    assert said("status")[1]["machines"][0]["state"] == "new"
    site.measure()
    assert said("run")[1]["machines"][0]["waiting"] == [1]
    assert said("approve", "mill", "1", "--actor", "ada")[1]["active"] == 1
    site.measure()
    assert said("run")[0] == 0
    assert said("reject", "mill", "2", "--reason", "sun on the table")[0] == 0
    site.measure()
    assert said("run")[0] == 0
    assert said("approve", "mill", "3")[1]["active"] == 3
    assert said("rollback", "mill", "--reason", "scrap")[1]["active"] == 1
    assert said("run")[0] == 0
    assert os.readlink(site.out / "active") == "v0001"
    kinds = [entry["kind"] for entry in said("history", "mill")[1]["entries"]]
    assert Counter(kinds) == {"measurement": 3, "propose": 3, "approve": 2, "reject": 1, "rollback": 1}
    assert said("history", "mill", "--drift")[0] == 0
    status = said("status")[1]["machines"][0]
    assert (status["active"], status["state"]) == (1, "ok")


def test_watch_works_on_it_and_goes_on_when_the_server_comes_back(site, server, impatient, monkeypatch):
    monkeypatch.setattr("compgen.fleet.watch.AGAIN_S", 0.1)
    outcomes = []
    site.measure()
    watch = Watch(site.folder / "recal.toml", on_outcome=outcomes.append, poll_s=0.05)
    thread = threading.Thread(target=watch.run, kwargs={"signals": False})

    def until(condition):
        end = time.monotonic() + 60.0
        while not condition() and time.monotonic() < end:
            time.sleep(0.02)
        assert condition()

    thread.start()
    try:
        until(lambda: outcomes)
        assert [(item.state, item.active) for item in outcomes] == [("ok", 1)]
        server.stop(crash=True)
        site.measure()
        machine = site.job.machines["mill"]
        watch._pass(machine, site.job.store)  # as its schedule would; without one it is every 5 minutes
        until(lambda: len(outcomes) > 2)
        assert all(item.unreachable and item.again for item in outcomes[1:])
        server.start()
        until(lambda: outcomes[-1].state == "ok")
    finally:
        if server.process.poll() is not None:
            server.start()
        watch.stop()
        thread.join()
    assert outcomes[-1].processed == ("0002.deviations.csv",)


def test_two_runners_process_each_of_many_measurements_once_and_in_order(site, opened):
    path = site.folder / "recal.toml"
    own = path.read_text()[path.read_text().index("[machines.mill]") :]
    other = own.replace("machines.mill", "machines.saw").replace('"out"', '"out2"').replace('"inbox"', '"inbox2"')
    path.write_text(path.read_text() + other)
    site.job = faults.read_job(path)
    for _ in range(5):
        site.measure()
    (site.folder / "inbox2").mkdir()
    for file in site.inbox.iterdir():  # not the same bytes, which would be held
        (site.folder / "inbox2" / file.name).write_text(f"# of = saw\n{file.read_text()}")
    assert [exit_of(child) for child in [site.start(), site.start()]] == [0, 0]
    store = opened(site.job.store)
    attempts, versions = store.attempts(), store.tables()
    assert sorted(Counter(item.measurement_id for item in attempts).values()) == [1] * 10
    assert {item.outcome for item in attempts} == {"done"}
    assert len({item.owner for item in attempts}) == 2
    for name in ("mill", "saw"):
        machine = store.machine(name)
        tables = store.tables(machine)
        assert [table.state for table in tables] == ["retired"] * 4 + ["active"]
        measured = {item.id: item.measured_at for item in store.identifications(machine)}
        times = [measured[table.identification_id] for table in tables]
        assert times == sorted(times)
    assert len(versions) == 10


@pytest.mark.parametrize("source", ["sqlite", "postgresql"])
def test_a_backup_moves_a_store_to_the_other_database_and_it_goes_on(url, opened, tmp_path, source):
    addresses = {"sqlite": f"sqlite:///{tmp_path}/recal.sqlite", "postgresql": url}
    site = faults.Site(tmp_path / "site", addresses.pop(source))
    site.measure()
    site.measure()
    site.run()
    (other,) = addresses.values()
    old = opened(site.job.store)
    old.add_event("unreadable", "a\0b", "\udcff", old.machine("mill"))
    counts = backup(site.job.store, tmp_path / "copy.sqlite")
    before = (tmp_path / "copy.sqlite").read_bytes()
    assert restore(tmp_path / "copy.sqlite", other) == counts
    assert (tmp_path / "copy.sqlite").read_bytes() == before
    new = opened(other)
    assert everything(new) == everything(old)
    moved = site.folder / "recal.toml"
    moved.write_text(moved.read_text().replace(json.dumps(site.job.store), json.dumps(other)))
    site.job = faults.read_job(moved)
    site.measure()
    assert site.run() == 0
    assert [table.state for table in new.tables()] == ["retired", "retired", "active"]
    assert os.readlink(site.out / "active") == "v0003"
    with pytest.raises(InputError, match="is not empty; restore into a new one"):
        restore(tmp_path / "copy.sqlite", other)


# --- the dashboard -------------------------------------------------------------------------------------------------


def test_the_dashboard_reads_and_decides_on_it(url, opened, tmp_path, monkeypatch):
    pytest.importorskip("flask", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
    pytest.importorskip("argon2", reason="the extra compgen[serve] is not installed: the dashboard is not tested")
    from compgen.fleet.dashboard import background
    from compgen.fleet.dashboard.app import make_app
    from compgen.fleet.dashboard.settings import DashboardSettings
    from compgen.fleet.dashboard.users import Users

    # this test asks again all the time, and the server works out the figures of the first page when nobody asks
    monkeypatch.setattr(background, "REST_S", 0.01)
    monkeypatch.setattr(background, "WAITING_SHOWN_S", 0.01)
    factory, own = _loaded(HERE / "serve_factory.py"), "http://localhost:8765"
    factory.make_factory(url).close()
    factory.make_factory(tmp_path / "same.sqlite").close()
    users = Users(tmp_path / "users.json")
    users.add("meyer", "correct horse battery")
    clients = {}
    for name, address in (("postgresql", url), ("sqlite", str(tmp_path / "same.sqlite"))):
        settings = DashboardSettings(address, decide=True, users=users.path)
        clients[name] = make_app(settings, opened(address)).test_client()

    def page(name, path):
        answer = clients[name].get(path, base_url=own)
        deadline = time.monotonic() + 60.0
        while (
            UNDER_WAY.search(answer.text) and time.monotonic() < deadline
        ):  # figures are worked out beside the requests
            time.sleep(0.05)
            answer = clients[name].get(path, base_url=own)
        moment = (
            r'\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d)?|nonce-\S+|nonce="[^"]+"|name="csrf" value="[^"]+"|\d+(\.\d+)? s\b'
        )
        return answer.status_code, re.sub(moment, "", answer.text)

    def post(path, **data):
        token = re.findall(r'name="csrf" value="([^"]+)"', clients["postgresql"].get("/login", base_url=own).text)
        fields = data if not token else {"csrf": token[-1], **data}
        return clients["postgresql"].post(path, base_url=own, data=fields, headers={"Origin": own})

    paths = ["/", "/machines/1", "/machines/1/drift", "/machines/1/tables/3", "/machines/4/tables/2", "/audit"]
    for path in [*paths, "/machines/99", "/machines/4"]:
        found = page("postgresql", path)
        assert found[0] == (404 if path.endswith("99") else found[0])
        assert found == page("sqlite", path)
    assert post("/login", name="meyer", password="correct horse battery").status_code in (302, 303)
    text = clients["postgresql"].get("/machines/1/tables/3", base_url=own).text
    token = re.findall(r'name="csrf" value="([^"]+)"', text)[-1]
    answer = clients["postgresql"].post(
        "/machines/1/tables/3/approve",
        base_url=own,
        data={"csrf": token, "reason": "fine", "seen": "2"},
        headers={"Origin": own},
    )
    assert answer.status_code in (200, 302, 303)
    last = opened(url).decisions()
    assert ("approve", "meyer", "fine") in [(item.kind, item.actor, item.reason) for item in last]


# --- faults --------------------------------------------------------------------------------------------------------


def run_while(site, at, then, after=lambda: None):
    """Run in a child; when the n-th measurement is begun, do ``then``, let it go on, do ``after``; return the exit code."""
    begun, go_on = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        code = 99
        try:
            real, count = runner.process, [0]

            def process(*parts):
                count[0] += 1
                if count[0] == at:
                    os.write(begun[1], b"x")
                    os.read(go_on[0], 1)
                return real(*parts)

            runner.process = process
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            code = site.run()
        finally:
            os._exit(code)
    os.close(begun[1])
    assert os.read(begun[0], 1) == b"x"
    then()
    os.write(go_on[1], b"x")
    after()
    for end in (begun[0], *go_on):
        os.close(end)
    return exit_of(child)


def test_a_server_that_dies_during_a_run_ends_it_with_2_and_nothing_is_lost(site, server, opened, impatient):
    for _ in range(3):
        site.measure()
    try:
        assert run_while(site, 2, lambda: server.stop(crash=True)) == 2
    finally:
        server.start()
    store = opened(site.job.store)
    assert (len(store.measurements()), len(store.identifications())) == (3, 1)
    assert site.run() == 0
    assert sorted(Counter(item.measurement_id for item in store.attempts()).values()) == [1, 1, 1]
    assert os.readlink(site.out / "active") == "v0003"


def test_a_server_that_is_back_soon_is_not_even_noticed(site, server, opened):
    for _ in range(2):
        site.measure()

    def start_soon():
        time.sleep(0.5)
        server.start()

    assert run_while(site, 1, lambda: server.stop(crash=True), start_soon) == 0
    assert [item.outcome for item in opened(site.job.store).attempts()] == ["done", "done"]


def test_runners_that_are_killed_lose_nothing_on_it(url, tmp_path):
    _, found = faults.kill(tmp_path, 5, seed=5, url=url)
    assert found.troubles == []
    assert found.killed.total() >= 5


def test_a_run_needs_no_more_than_two_connections_and_says_when_it_gets_none(site, server, impatient, monkeypatch):
    name = sa.make_url(site.job.store).database
    server.sql("DROP ROLE IF EXISTS few")
    server.sql("CREATE ROLE few LOGIN CONNECTION LIMIT 2")
    server.sql("GRANT ALL ON SCHEMA public TO few", name)
    limited = server.address(name, user="few")
    path = site.folder / "recal.toml"
    path.write_text(path.read_text().replace(json.dumps(site.job.store), json.dumps(limited)))
    site.job = faults.read_job(path)
    site.measure()
    assert site.run() == 0
    import psycopg

    with psycopg.connect(limited), psycopg.connect(limited), pytest.raises(StoreError, match="too many connections"):
        site.run()
    monkeypatch.undo()
    occupied = [psycopg.connect(limited), psycopg.connect(limited)]
    threading.Timer(1.0, lambda: [connection.close() for connection in occupied]).start()
    assert site.run() == 0  # after some attempts
    server.sql("DROP OWNED BY few", name)
    server.sql("DROP ROLE few")


def test_somebody_who_holds_a_lock_for_long_is_waited_for_and_reported(site, server, opened, impatient, monkeypatch):
    monkeypatch.setattr(database, "BUSY_S", 0.3)
    import psycopg

    store = opened(site.job.store)
    store.add_machine("mill")
    with psycopg.connect(server.address(store.engine.url.database)) as other:
        other.execute("LOCK TABLE machines IN ACCESS EXCLUSIVE MODE")
        started = time.monotonic()
        with pytest.raises(StoreError, match="lock timeout"):
            store.machines()
        assert time.monotonic() - started < 3.0
    assert len(store.machines()) == 1


def test_the_clock_of_the_server_counts(url, opened, server, monkeypatch):
    class Wrong(datetime):
        @classmethod
        def now(cls, zone=None):
            return datetime(1990, 1, 1, tzinfo=zone)

    monkeypatch.setattr(store_module, "datetime", Wrong)
    store = opened(url)
    machine = store.add_machine("mill")
    ((at,),) = server.sql("SELECT clock_timestamp()")
    assert abs(machine.at - at) < timedelta(seconds=30)
    measured = store.add_measurement(machine, NewMeasurement("0" * 64, "m", at, "file", {"a": b"b"}))
    claim = claims.take(store, measured, "elsewhere/s/1/2", lease_s=600)
    assert claim is not None
    assert claims.take(store, measured, claims.owner_name()) is None


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("postgresql://tester@127.0.0.1:1/store", "refused"),
        ("postgresql://tester@/nowhere?host={folder}", '"nowhere" does not exist'),
        ("postgresql://nobody@/postgres?host={folder}", '"nobody" does not exist'),
        ("postgresql://tester@/postgres?host=/nowhere", "No such file"),
    ],
)
def test_a_server_that_cannot_be_used_ends_with_2_and_its_reason(site, server, impatient, capsys, address, said):
    path = site.folder / "recal.toml"
    address = address.format(folder=server.folder)
    path.write_text(path.read_text().replace(json.dumps(site.job.store), json.dumps(address)))
    assert run_command(cli, ["recal", "run", "--job", str(path)]) == 2
    assert said in capsys.readouterr().err


def test_odd_names_and_comments_of_files_are_kept_and_stop_nobody(site, opened):
    site.measure()
    good = site.inbox / "0001.deviations.csv"
    odd = os.fsencode(site.inbox) + b"/\xff.deviations.csv"
    with open(odd, "wb") as stream:
        stream.write(b"# active_table = v\x001\n" + good.read_bytes())
    assert site.run() in (0, 1)
    store = opened(site.job.store)
    assert sorted(item.name for item in store.measurements()) == ["0001.deviations.csv", "\\udcff.deviations.csv"]
    assert {item.outcome for item in store.attempts()} == {"done", "failed"}
    assert site.run() in (0, 1)
    assert len(store.attempts()) == 2


def test_nothing_of_the_server_is_left_behind():
    made = postgres.Server()
    folder, process = made.folder, made.process
    made.close()
    assert process.returncode is not None
    assert not folder.exists()
