"""``volcomp recal reprocess``: a stored measurement gives one more version; nothing that was there changes."""

import importlib.util
import json
import shutil
import sqlite3
import sys
from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.errors import CompgenError, InputError
from compgen.fleet import actions, claims, database
from compgen.fleet.actions import REPROCESS_FAILED, reprocess
from compgen.fleet.change import calibrations_of
from compgen.fleet.records import ReprocessRequest
from compgen.fleet.status import history
from compgen.fleet.store import counting, open_store

HERE = Path(__file__).resolve()


def _plants():
    spec = importlib.util.spec_from_file_location("compgen_test_recal", Path(__file__).with_name("test_recal.py"))
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


plants = _plants()
REQUEST = ReprocessRequest(None, "ada", "pitch of X corrected")


@pytest.fixture(scope="module")
def measured(tmp_path_factory, small_machine, small_machine_file, small_errors):
    """The folder of a machine with one measurement whose tables wait for approval."""
    folder = tmp_path_factory.mktemp("measured")
    shutil.copy(small_machine_file, folder / "mill.toml")
    made = plants.plant_in(folder, small_machine, small_errors)
    made.write()
    made.measure("a", hours=-2)
    assert made.run().exit_code == 0
    return folder


@pytest.fixture
def plant(measured, tmp_path, small_machine, small_errors):
    shutil.copytree(measured, tmp_path / "plant", symlinks=True)
    return plants.plant_in(tmp_path / "plant", small_machine, small_errors)


@pytest.fixture
def store(plant):
    opened = open_store(plant.job().store)
    yield opened
    opened.close()


def change_machine(plant, old="nodes = 5", new="nodes = 4"):
    path = plant.folder / "mill.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def rows(store):
    """Every row of the store as text."""
    with store.engine.connect() as connection:
        tables = sa.inspect(connection).get_table_names()
        return {name: [str(row) for row in connection.execute(sa.text(f"SELECT * FROM {name}"))] for name in tables}


def test_another_machine_file_gives_another_version_and_everything_old_stays(plant, store):
    mill = store.machine("mill")
    before, files = rows(store), store.table_files(store.tables(mill)[0])
    change_machine(plant)
    done = reprocess(plant.job(), "mill", REQUEST)
    assert (done.exit_code, done.revision, done.table.version, done.table.state) == (0, 2, 2, "pending")
    assert [table.state for table in store.tables(mill)] == ["superseded", "pending"]
    after = rows(store)
    assert all(set(before[name]) <= set(after[name]) for name in before)
    assert store.table_files(store.tables(mill)[0]) == files
    first, second = store.identifications(mill)
    assert (first.revision, second.revision) == (1, 2)
    assert first.measurement_id == second.measurement_id
    counts = [len(store.errors_of(item).curves["EYY"].position_mm) for item in (first, second)]
    assert counts == [5, 4]
    assert (plant.out / "proposed" / "v0002" / "NC_CEC.INI").is_file()


def test_who_wanted_it_and_why_stand_in_the_history(plant, store):
    reprocess(plant.job(), "mill", REQUEST)
    entry = next(item for item in reversed(history(store)) if item.kind == "propose")
    assert (entry.actor, entry.version) == ("ada", 2)
    assert entry.text == "a.deviations.csv processed again: pitch of X corrected"


def test_the_next_pass_finds_nothing_to_do(plant, store):
    change_machine(plant)
    reprocess(plant.job(), "mill", REQUEST)
    before = rows(store)
    outcome = plant.run()
    assert (outcome.exit_code, outcome.outcomes[0].processed) == (0, ())
    assert rows(store) == before


def test_the_same_judgement_holds_for_it_and_the_active_tables_stay(plant, store, listing):
    """Against the tables from the same measurement nothing changed: held back, exit code 1; a person may override."""
    actions.approve(plant.job(), "mill", 1, "ada")
    active = listing(plant.out / "v0001")
    done = reprocess(plant.job(), "mill", REQUEST)
    assert (done.exit_code, done.table.state) == (1, "held")
    assert "within its uncertainty" in "; ".join(done.table.reasons)
    assert listing(plant.out / "v0001") == active
    held = store.decisions()[-1]
    assert (held.kind, held.actor) == ("hold", "ada")
    assert held.reason.startswith("a.deviations.csv processed again: pitch of X corrected; ")
    actions.approve(plant.job(), "mill", 2, "ada", "checked", override=True)
    actions.rollback(plant.job(), "mill", "ada", "worse")
    assert listing(plant.out / "v0001") == active


def test_a_policy_that_was_too_strict_is_judged_anew(plant, store):
    plant.write(policy="max_age_days = 0.01")
    assert reprocess(plant.job(), "mill", REQUEST).table.state == "held"
    plant.write(policy="max_age_days = 30")
    assert reprocess(plant.job(), "mill", REQUEST).table.state == "pending"
    assert [item.revision for item in store.identifications()] == [1, 2, 3]
    assert [table.state for table in store.tables()] == ["superseded", "superseded", "pending"]


def test_approval_by_itself_counts_here_too(plant, store):
    plant.write('approval = "auto"')
    assert reprocess(plant.job(), "mill", REQUEST).table.state == "active"
    assert (plant.out / "active" / "NC_CEC.INI").is_file()


def test_a_failure_leaves_the_tables_and_is_told_with_who_and_why(plant, store):
    change_machine(plant, "nodes = 5", "nodes = 1")
    tables = store.tables()
    with pytest.raises(CompgenError):
        reprocess(plant.job(), "mill", REQUEST)
    assert store.tables() == tables
    event = store.events(store.machine("mill"))[-1]
    assert event.kind == REPROCESS_FAILED
    assert event.message.startswith("ada (pitch of X corrected): ")
    assert "compgen-recal-" not in event.message
    change_machine(plant, "nodes = 1\n", "nodes = 5\n")
    assert plant.run().exit_code == 0  # the claim is free, the machine is well
    assert reprocess(plant.job(), "mill", REQUEST).table.version == 2


@pytest.mark.parametrize("wanted", ["7", "0" * 8, "a", "", "1' OR '1'='1", "a.deviations.csv"])
def test_a_measurement_that_is_not_there_is_refused_with_those_that_are(plant, store, wanted):
    before = rows(store)
    with pytest.raises(InputError, match="1 \\(a.deviations.csv"):
        reprocess(plant.job(), "mill", ReprocessRequest(wanted, "ada", "why"))
    assert rows(store) == before


def test_a_measurement_is_chosen_by_number_or_the_beginning_of_its_hash(plant, store):
    plant.measure("b", seed=2, hours=-1)
    plant.run()
    first, second = store.measurements()
    assert reprocess(plant.job(), "mill", ReprocessRequest(str(first.id), "ada", "why")).measurement == first
    assert reprocess(plant.job(), "mill", ReprocessRequest(first.sha256[:8].upper(), "ada", "why")).measurement == first
    assert reprocess(plant.job(), "mill", REQUEST).measurement == second


def test_without_reason_or_while_another_works_on_it_nothing_happens(plant, store):
    with pytest.raises(InputError, match="reason"):
        reprocess(plant.job(), "mill", ReprocessRequest(None, "ada", " "))
    claims.take(store, store.measurements()[0], "elsewhere/space/1/2", again=True)
    before = rows(store)
    with pytest.raises(claims.ClaimLostError, match="another runner works on"):
        reprocess(plant.job(), "mill", REQUEST)
    assert rows(store) == before


def test_one_identification_speaks_for_a_measurement(plant, store):
    """The drift counts a measurement once: the active one's, else the newest that nobody rejected."""
    mill = store.machine("mill")
    reprocess(plant.job(), "mill", REQUEST)
    assert [item.revision for item in counting(store, mill)] == [2]
    actions.reject(plant.job(), "mill", 2, "ada", "no")
    assert [item.revision for item in counting(store, mill)] == [1]
    reprocess(plant.job(), "mill", REQUEST)
    assert [item.revision for item in counting(store, mill)] == [3]
    actions.approve(plant.job(), "mill", 3, "ada")
    reprocess(plant.job(), "mill", REQUEST)
    assert [item.revision for item in counting(store, mill)] == [3]
    assert len(calibrations_of(store, mill)[0]) == 1


def test_the_command_says_what_came_of_it(plant, store, capsys):
    options = ["--job", str(plant.folder / "recal.toml"), "--actor", "ada", "--reason", "why", "--json"]
    assert run_command(cli, ["recal", "reprocess", "mill", *options]) == 0
    said = json.loads(capsys.readouterr().out)
    digest = store.measurements()[0].sha256
    assert said == {
        "accepted": True,
        "machine": "mill",
        "measurement": {"id": 1, "name": "a.deviations.csv", "sha256": digest},
        "revision": 2,
        "version": 2,
        "state": "pending",
        "reasons": [],
    }
    actions.approve(plant.job(), "mill", 2, "ada")
    assert run_command(cli, ["recal", "reprocess", "mill", *options[:-1], "--measurement", digest[:10]]) == 1
    assert "version 3 from a.deviations.csv is held" in capsys.readouterr().out
    for name in ("reprocess", "reject", "rollback"):
        assert run_command(cli, ["recal", name, "mill", *options[:2]]) == 2
        assert "--reason" in capsys.readouterr().err


#: A store whose schema four migrations made, before they became one.
EXISTING_STORE = next(folder for folder in HERE.parents if (folder / "golden").is_dir()) / "golden/fleet/store-0004.sql"


def test_an_existing_store_keeps_identifications_and_what_refers_to_them(tmp_path):
    """Ids, references, indexes and the refusal to change a row are as before; so is the schema."""
    with closing(sqlite3.connect(tmp_path / "old.sqlite")) as connection:
        connection.executescript(EXISTING_STORE.read_text(encoding="utf-8"))
    store = open_store(str(tmp_path / "old.sqlite"))
    found = {item.id: (item.measurement_id, item.revision, item.active_table_id) for item in store.identifications()}
    assert found == {7: (2, 1, None), 9: (1, 1, 3)}
    assert [table.identification_id for table in store.tables()] == [7, 9]
    assert [machine.name for machine in store.machines()] == ["old"]
    assert [item.temperatures_c for item in store.measurements()] == [{"temp_x_c": {"mean": 20.5}}, {}]
    assert [(table.version, table.state, table.controllers) for table in store.tables()] == [
        (1, "active", ["isg-csv"]),
        (2, "held", ["isg-csv"]),
    ]
    with store.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), database.metadata) == []
        assert connection.exec_driver_sql("PRAGMA foreign_key_check").all() == []
        assert connection.exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"
        names = {item["name"] for item in sa.inspect(connection).get_indexes("identifications")}
    assert {f"ix_identifications_{name}_id" for name in ("machine", "machine_version", "measurement")} <= names
    for text in ("UPDATE identifications SET revision = 5", "DELETE FROM identifications WHERE id = 9"):
        with pytest.raises(sa.exc.IntegrityError, match="new rows only"):
            store.write(lambda connection, text=text: connection.exec_driver_sql(text))
    again = "INSERT INTO identifications SELECT 10, 1, 1, 1, 3, errors_sha256, NULL, NULL, '{}', 'p', at, 1 "
    with pytest.raises(sa.exc.IntegrityError, match="UNIQUE|new rows only"):
        store.write(lambda connection: connection.exec_driver_sql(again + "FROM identifications WHERE id = 9"))
    store.close()
