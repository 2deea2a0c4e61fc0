"""Folder and store know each other: a lost, emptied, older or foreign store never writes over what was published.

Nothing that this program did not write is deleted, and nothing is written through a link.
"""

import json
import os
import shutil
from datetime import timedelta

import pytest
from test_recal_active import drifted, site, site_in, site_with_tables  # noqa: F401  (fixtures)

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.errors import InputError
from compgen.fleet import actions
from compgen.fleet.database import StoreError
from compgen.fleet.inbox import with_twins
from compgen.fleet.job import read_job
from compgen.fleet.publish import LEDGER
from compgen.fleet.runner import run_jobs
from compgen.fleet.store import backup, open_store, restore

#: A control without tables.
NO_TABLES = "%_N_NC_CEC_INI\nCHANDATA(1)\nM17\n"


@pytest.fixture(scope="session")
def site_with_version_2(site_with_tables, tmp_path_factory, small_machine, small_machine_file, small_errors):  # noqa: F811
    """Folder of the machine with version 2 active; a backup of the store of before is next to it."""
    folder = tmp_path_factory.mktemp("second") / "site"
    shutil.copytree(site_with_tables, folder, symlinks=True)
    made = site_in(folder, small_machine, small_machine_file, small_errors)
    made.now += timedelta(days=9)
    backup(made.job.store, folder / "old.sqlite")
    made.measure("drift", drifted(small_errors, 40.0), on=made.on(), seed=2, shown=True)
    assert made.run().active == 2
    return folder


@pytest.fixture
def second(site_with_version_2, tmp_path, small_machine, small_machine_file, small_errors):
    """Version 2 is active since yesterday; a backup of the store of before is next to it."""
    shutil.copytree(site_with_version_2, tmp_path, symlinks=True, dirs_exist_ok=True)
    made = site_in(tmp_path, small_machine, small_machine_file, small_errors)
    made.now += timedelta(days=10)
    return made


def lose(made):
    """Delete the store."""
    for path in made.folder.glob("recal.sqlite*"):
        path.unlink()


def published(made, listing):
    return {name: content for name, content in listing(made.out).items() if name.startswith("v0")}


def test_a_lost_store_processes_nothing_and_overwrites_nothing(second, listing, small_errors):
    before = listing(second.out)
    lose(second)
    second.measure("third", drifted(small_errors, 70.0), seed=3, active_table="none")
    outcome = second.run()
    assert (outcome.state, outcome.processed) == ("failed", ())
    assert "this store never made active" in outcome.messages[0] and "volcomp recal adopt mill" in outcome.messages[0]
    assert listing(second.out) == before
    assert second.tables() == []


def test_a_store_without_contents_is_damage(second, listing):
    before = listing(second.out)
    lose(second)
    (second.folder / "recal.sqlite").touch()
    with pytest.raises(StoreError, match=r"damaged: the file is empty \(0 bytes\)") as caught:
        second.run()
    assert caught.value.exit_code == 2
    assert listing(second.out) == before


def test_a_store_that_is_being_made_is_waited_for(tmp_path, monkeypatch):
    from compgen.fleet import database

    path = tmp_path / "recal.sqlite"
    path.touch()
    monkeypatch.setattr(database.time, "sleep", lambda _: path.write_bytes(b"") or path.unlink())
    open_store(str(path)).close()


def test_an_older_backup_is_recognised_before_it_makes_another_version_2(second, listing, small_errors):
    before = listing(second.out)
    lose(second)
    restore(second.folder / "old.sqlite", second.job.store)
    second.measure("third", drifted(small_errors, 70.0), seed=3, active_table="none")
    outcome = second.run()
    assert (outcome.state, outcome.processed) == ("failed", ())
    assert "points to v0002, which this store never made active" in outcome.messages[0]
    with pytest.raises(InputError, match="never made active"):
        actions.rollback(second.job, "mill", "ada", "why", to=0, clock=lambda: second.now)
    assert listing(second.out) == before


def test_an_older_backup_is_recognised_by_the_number_of_decisions_alone(second, listing):
    backup(second.job.store, second.folder / "between.sqlite")
    actions.rollback(second.job, "mill", "ada", "scrap", clock=lambda: second.now)
    before = listing(second.out)
    lose(second)
    restore(second.folder / "between.sqlite", second.job.store)
    (message,) = second.run().messages
    assert "records 5 decisions about mill, but this store has 4" in message and "older backup" in message
    assert listing(second.out) == before
    assert os.readlink(second.out / "active") == "v0001"


def test_an_older_backup_that_went_on_is_recognised_by_the_contents(second, listing, small_errors):
    """It has as many decisions and a version 2 of its own by now, published elsewhere."""
    before = listing(second.out)
    lose(second)
    restore(second.folder / "old.sqlite", second.job.store)
    text = (second.folder / "recal.toml").read_text()
    (second.folder / "recal.toml").write_text(text.replace('out = "out"', 'out = "elsewhere"'))
    shutil.copytree(second.out, second.folder / "elsewhere", symlinks=True)
    shutil.rmtree(second.folder / "elsewhere/v0002")
    (second.folder / "elsewhere" / LEDGER).unlink()
    (second.folder / "elsewhere/active").unlink()
    (second.inbox / "drift.deviations.csv").unlink()
    second.measure("other", drifted(small_errors, 90.0), seed=5, active_table="none")
    (second.inbox / "other.backup.INI").write_text(NO_TABLES)
    second.job = read_job(second.folder / "recal.toml")
    assert second.run().active == 2
    (second.folder / "recal.toml").write_text(text)
    second.job = read_job(second.folder / "recal.toml")
    (message,) = second.run().messages
    assert "records other decisions or tables than this store" in message
    assert listing(second.out) == before


def test_a_folder_without_ledger_is_known_by_its_contents(second, listing):
    (second.out / LEDGER).unlink()
    assert second.run().active == 2
    assert (second.out / LEDGER).is_file()
    (second.out / LEDGER).write_text("")  # cut
    about = json.loads((second.out / "v0001/version.json").read_text())
    about["measurement"]["sha256"] = "0" * 64
    (second.out / "v0001/version.json").write_text(json.dumps(about))
    (message,) = second.run().messages
    assert "v0001 was published from another measurement" in message


def test_altered_files_of_the_right_store_are_still_put_back(second, listing):
    before = listing(second.out)
    (second.out / "v0002/NC_CEC.INI").write_text("spoilt")
    (second.out / "v0002/version.json").write_text("{")
    assert second.run().active == 2
    assert listing(second.out) == before


def test_the_ledger_depends_on_what_was_decided_and_not_on_when_or_by_whom(second):
    ledger = json.loads((second.out / LEDGER).read_text())
    assert (ledger["machine"], ledger["decisions"]) == ("mill", 4)
    backup(second.job.store, second.folder / "copy.sqlite")
    lose(second)
    restore(second.folder / "copy.sqlite", second.job.store)
    assert second.run().active == 2
    assert json.loads((second.out / LEDGER).read_text()) == ledger


def test_a_machine_with_a_new_name_is_told_whose_folder_it_is(second, small_errors):
    second.write(name="lathe")
    second.measure("third", drifted(small_errors, 70.0), on=second.on(), seed=3)
    (message,) = second.run().messages
    assert "this store never made active" in message or "is the folder of machine mill" in message
    assert [table.version for table in second.tables()] == [1, 2]


def test_a_machine_with_a_new_name_and_folder_has_no_history(second, small_errors):
    on = second.on()
    second.write(name="lathe")
    text = (second.folder / "recal.toml").read_text().replace('out = "out"', 'out = "lathe"')
    (second.folder / "recal.toml").write_text(text)
    second.job = read_job(second.folder / "recal.toml")
    for path in second.inbox.iterdir():
        path.unlink()
    second.measure("third", drifted(small_errors, 40.0), on=on, seed=3)
    outcome = second.run()
    assert (outcome.state, outcome.active) == ("held", None)
    assert "does not know which tables were on" in outcome.messages[0]


def test_adopt_sets_aside_what_was_there_and_asks_which_tables_are_on(second, listing, small_errors):
    old = published(second, listing)
    on = second.on()
    lose(second)
    restore(second.folder / "old.sqlite", second.job.store)
    assert second.run().state == "failed"
    moved = actions.adopt(second.job, "mill", "ada", "the backup of Sunday counts", clock=lambda: second.now)
    assert moved == second.out / "SET-ASIDE-1"
    kept = {name: content for name, content in listing(moved).items() if name.startswith("v0")}
    assert kept == old and os.readlink(moved / "active") == "v0002"
    assert os.readlink(second.out / "active") == "v0001"
    second.now += timedelta(days=1)
    (second.inbox / "drift.deviations.csv").unlink()
    second.measure("third", drifted(small_errors, 40.0), on=on, seed=3)  # version 2 of the lost store is on
    outcome = second.run()
    assert (outcome.state, outcome.active) == ("held", 1)
    assert "does not know which tables were on" in outcome.messages[0]


# --- other people's files ------------------------------------------------------------------------------------------


def test_what_others_put_below_proposed_stays(second, small_errors):
    theirs = second.out / "proposed/notes"
    theirs.mkdir(parents=True)
    (theirs / "keep.txt").write_text("mine")
    second.write(approval="manual")
    second.measure("a", drifted(small_errors, 80.0), on=second.on(), seed=4, shown=True)
    second.run()
    (second.out / "proposed/v0003/remarks.txt").write_text("looks good")
    (second.out / "proposed/v0003/NC_CEC.INI").write_text("edited by hand")
    actions.reject(second.job, "mill", 3, "ada", "no", clock=lambda: second.now)
    assert (theirs / "keep.txt").read_text() == "mine"
    assert not (second.out / "proposed/v0003").exists()
    left = second.out / "proposed/LEFT-v0003-1"
    found = {path.name: path.read_text() for path in left.iterdir()}
    assert found == {"remarks.txt": "looks good", "NC_CEC.INI": "edited by hand"}


def test_nothing_is_deleted_through_a_link(second, tmp_path_factory, small_errors):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "v0001").mkdir()
    (elsewhere / "v0001/precious.txt").write_text("mine")
    shutil.rmtree(second.out / "proposed", ignore_errors=True)
    (second.out / "proposed").symlink_to(elsewhere)
    second.measure("a", drifted(small_errors, 80.0), on=second.on(), seed=4)
    (message,) = second.run().messages
    assert "is a link; nothing is written through it" in message
    assert (elsewhere / "v0001/precious.txt").read_text() == "mine"
    assert [path.name for path in elsewhere.iterdir()] == ["v0001"]


@pytest.mark.parametrize("name", ["v0001", "v0002"])
def test_a_version_that_is_a_link_is_not_followed(second, tmp_path_factory, name):
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "copy"
    shutil.move(second.out / name, elsewhere)
    (second.out / name).symlink_to(elsewhere)
    (elsewhere / "NC_CEC.INI").write_text("mine")
    (message,) = second.run().messages
    assert "is a link" in message
    assert (elsewhere / "NC_CEC.INI").read_text() == "mine"


def test_a_pointer_that_is_a_file_or_folder_of_others_stays(second):
    (second.out / "active").unlink()
    (second.out / "active").write_text("mine")
    (message,) = second.run().messages
    assert "is not a link to a version" in message
    assert (second.out / "active").read_text() == "mine"


def test_temporary_folders_of_others_stay(second):
    theirs = second.out / ".backup.tmp"
    theirs.mkdir()
    (theirs / "keep.txt").write_text("mine")
    own = second.out / ".v0002.tmp"
    own.mkdir()
    (own / ".NC_CEC.INI.abc123.tmp").write_text("half")
    assert second.run().active == 2
    assert (theirs / "keep.txt").read_text() == "mine" and not own.exists()


MACHINE = """
[machines.{name}]
machine = "mill.toml"
inbox = "inbox/{name}"
controllers = ["neutral"]
out = "{out}"
measured_with = "bare"
"""


@pytest.mark.parametrize(
    ("first", "other", "said"),
    [
        ("tables", "tables", "same folder out as a"),
        ("tables/a", "tables/b/../a", "same folder out as a"),
        ("real", "link", "same folder out as a"),
        ("tables", "tables/b", "inside that of a"),
        ("tables/a/proposed", "tables/a", "inside that of b"),
        ("real", "link/b", "inside that of a"),
        ("link/proposed", "real", "inside that of b"),
    ],
)
def test_folders_out_are_compared_as_real_paths(tmp_path, first, other, said):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    text = MACHINE.format(name="a", out=first) + MACHINE.format(name="b", out=other)
    (tmp_path / "recal.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        read_job(tmp_path / "recal.toml")


def test_folders_beside_each_other_are_fine(tmp_path):
    text = MACHINE.format(name="a", out="tables/a") + MACHINE.format(name="b", out="tables/ab")
    (tmp_path / "recal.toml").write_text(text)
    assert len(read_job(tmp_path / "recal.toml").machines) == 2


# --- one file, two machines ----------------------------------------------------------------------------------------


def two_machines(made, inbox_b="inbox-b"):
    (made.folder / "inbox-b").mkdir()
    text = (made.folder / "recal.toml").read_text()
    other = text.replace("machines.mill", "machines.twin").replace('out = "out"', 'out = "out-b"')
    (made.folder / "recal.toml").write_text(text + other.replace('inbox = "inbox"', f'inbox = "{inbox_b}"'))
    made.job = read_job(made.folder / "recal.toml")

    def run_both():
        return {item.machine: item for item in run_jobs(made.job, clock=lambda: made.now).outcomes}

    return run_both


@pytest.mark.parametrize("inbox_b", ["inbox-b", "inbox", "./inbox-b/../inbox"])
def test_one_file_for_two_machines_is_held_for_both(site, inbox_b):  # noqa: F811
    run_both = two_machines(site, inbox_b)
    path = site.measure("a", active_table="none")
    if inbox_b == "inbox-b":
        shutil.copy(path, site.folder / inbox_b / "renamed.deviations.csv")
    found = run_both()
    for name, other in (("mill", "twin"), ("twin", "mill")):
        assert (found[name].state, found[name].active) == ("held", None)
        assert "the same file also came for" in found[name].messages[0] and other in found[name].messages[0]
        assert "recal reject" in found[name].messages[0]


def test_a_file_that_came_for_another_machine_long_ago_is_held(site):  # noqa: F811
    run_both = two_machines(site)
    path = site.measure("a", active_table="none")
    assert run_both()["mill"].active == 1
    site.now += timedelta(days=1)
    path.rename(site.folder / "inbox-b/late.deviations.csv")
    found = run_both()["twin"]
    assert (found.state, found.active) == ("held", None)
    assert "the same file also came for mill (version 1 is active)" in found.messages[0]


def test_the_wrong_machine_lets_go_of_a_file(site):  # noqa: F811
    run_both = two_machines(site)
    path = site.measure("a", active_table="none")
    path.rename(site.folder / "inbox-b/a.deviations.csv")
    assert run_both()["twin"].active == 1
    actions.rollback(site.job, "twin", "ada", "the file of mill", to=0, clock=lambda: site.now)
    (site.folder / "inbox-b/a.deviations.csv").rename(path)
    site.now += timedelta(hours=1)
    found = run_both()["mill"]
    assert found.state == "held" and "version 1 is retired" in found.messages[0]
    done = actions.approve(site.job, "mill", 1, "ada", "it is of mill", override=True, clock=lambda: site.now)
    assert done.kind == "approve"


def test_different_files_in_two_inboxes_are_not_held(site, small_errors):  # noqa: F811
    run_both = two_machines(site)
    site.measure("a", active_table="none")
    path = site.measure("b", drifted(small_errors, 30.0), seed=2, active_table="none")
    path.rename(site.folder / "inbox-b/b.deviations.csv")
    assert {name: item.state for name, item in run_both().items()} == {"mill": "ok", "twin": "ok"}


def test_adopt_from_the_command_line(second, capsys):
    lose(second)
    restore(second.folder / "old.sqlite", second.job.store)
    path = str(second.folder / "recal.toml")

    def call(*words):
        code = run_command(cli, ["recal", *words, "--job", path])
        return code, capsys.readouterr()

    code, said = call("approve", "mill", "1")
    assert code == 2 and "this store never made active" in said.err
    assert call("adopt", "mill")[0] == 2  # without a reason
    code, said = call("adopt", "mill", "--reason", "Sunday counts", "--actor", "ada", "--json")
    assert code == 0
    assert json.loads(said.out) == {
        "accepted": True,
        "machine": "mill",
        "set_aside": str(second.out / "SET-ASIDE-1"),
    }
    code, said = call("history", "mill", "--json")
    assert "assigned to this store by ada, the earlier contents are in SET-ASIDE-1: Sunday counts" in said.out


def test_what_a_job_knows_of_other_machines_does_not_grow_with_the_fleet(tmp_path):
    names = [f"m{k}" for k in range(300)]
    (tmp_path / "recal.toml").write_text("".join(MACHINE.format(name=name, out=f"out/{name}") for name in names))
    job = read_job(tmp_path / "recal.toml")
    for k, name in enumerate(names):
        (tmp_path / "inbox" / name).mkdir(parents=True)
        (tmp_path / "inbox" / name / "a.lengths.csv").write_text(f"{k:04d}")
    shutil.copy(tmp_path / "inbox/m7/a.lengths.csv", tmp_path / "inbox/m9/b.lengths.csv")
    found = with_twins(job.machines.values(), job.machines.values())
    others = {item.name: [other.name for other in item.others] for item in found if item.others}
    assert others == {"m7": ["m9"], "m9": ["m7"]}
