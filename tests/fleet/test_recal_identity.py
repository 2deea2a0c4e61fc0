"""Whose readings they are: what names another machine waits; names that two systems read differently are refused."""

import io
import shutil
import zipfile

import numpy as np
import pytest
from test_recal import deviations_text
from test_recal_active import drifted, site, site_in, site_with_tables  # noqa: F401  (fixtures)

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.files import name_problem
from compgen.fleet.inbox import comments_in, duration_s, whose
from compgen.fleet.store import open_store


@pytest.fixture
def pair(tmp_path, small_machine, small_machine_file, small_errors):
    """Two machines with inboxes of their own; ``run`` is the command, ``reasons`` those of the newest version."""
    for name in ("m1", "m2"):
        (tmp_path / name).mkdir()
        shutil.copy(small_machine_file, tmp_path / f"{name}.toml")
    (tmp_path / "recal.toml").write_text(
        "".join(
            f'[machines.{name}]\nmachine = "{name}.toml"\ninbox = "{name}"\ncontrollers = ["isg-csv"]\nout = "out/{name}"\n'
            'measured_with = "bare"\n'
            for name in ("m1", "m2")
        )
    )

    class Pair:
        folder = tmp_path

        def measure(self, name, file, seed, **notes):
            said = "".join(f"# {key} = {value}\n" for key, value in notes.items())
            text = said + deviations_text(small_machine, small_errors, seed=seed)
            (tmp_path / name / f"{file}.deviations.csv").write_text(text)

        def run(self, *words):
            return run_command(cli, ["recal", *(words or ("run",)), "--job", str(tmp_path / "recal.toml")])

        def newest(self, name):
            store = open_store(str(tmp_path / "recal.sqlite"))
            try:
                return store.tables(store.machine(name))[-1]
            finally:
                store.close()

    return Pair()


@pytest.mark.parametrize("key", ["machine", "machine_name"])
@pytest.mark.parametrize(("said", "held"), [("m1", True), ("M2", False), ("small-gantry", False), ("lathe 7", True)])
def test_a_measurement_that_names_another_machine_waits(pair, key, said, held):
    pair.measure("m2", "a", 1, **{key: said})
    assert pair.run() == (1 if held else 0)
    table = pair.newest("m2")
    assert table.state == ("held" if held else "pending")
    if held:
        assert f"the file says that it is of machine {said}, but it came for m2" in table.reasons[0]
        assert pair.run("approve", "m2", "1") == 2
        assert pair.run("approve", "m2", "1", "--override", "--reason", "the comment was wrong") == 0


def test_one_of_several_files_names_another_machine(pair, small_machine, small_errors):
    (pair.folder / "m2" / "both").mkdir()
    for seed, (name, said) in enumerate((("a", "m2"), ("b", "m1"))):
        text = f"# machine = {said}\n" + deviations_text(small_machine, small_errors, seed=seed)
        (pair.folder / "m2" / "both" / f"{name}.deviations.csv").write_text(text)
    assert pair.run() == 1
    assert "of machine m1, but it came for m2" in pair.newest("m2").reasons[0]


def test_a_machine_file_with_the_name_of_another_machine_does_not_vouch_for_it(pair):
    path = pair.folder / "m2.toml"
    path.write_text(path.read_text().replace('name = "small-gantry"', 'name = "m1"'))  # copied, and not renamed
    pair.measure("m2", "a", 1, machine="m1")
    assert pair.run() == 1
    assert "of machine m1, but it came for m2" in pair.newest("m2").reasons[0]


def test_another_serial_number_than_before_waits_until_a_person_accepts_it(pair):
    pair.measure("m2", "a", 1, machine_serial="4711")
    assert pair.run() == 0 == pair.run("approve", "m2", "1")
    pair.measure("m2", "b", 2, machine_serial="4712")
    assert pair.run() == 1
    assert "gives serial number 4712 for the machine, but earlier measurements 4711" in " ".join(
        pair.newest("m2").reasons
    )
    pair.measure("m2", "c", 3)  # says nothing
    pair.run()
    assert "serial number" not in " ".join(pair.newest("m2").reasons)
    assert pair.run("approve", "m2", "2", "--override", "--reason", "a new control cabinet") == 0
    pair.measure("m2", "d", 4, machine_serial="4712")
    pair.run()
    assert "serial number" not in " ".join(pair.newest("m2").reasons)


def test_archives_and_other_programs_say_it_too():
    packed = io.BytesIO()
    times = np.array([0.0, 10.0, 7200.0])
    np.savez(packed, format="x", machine="m1", measured_at="2026-03-01T06:30:00Z", active_table="v3", time_s=times)
    archive = packed.getvalue()
    said = {"machine": "m1", "measured_at": "2026-03-01T06:30:00Z", "active_table": "v3"}
    assert comments_in(archive) == said
    assert duration_s(archive) == 7200.0
    assert whose({"a.lengths.npz": archive})[0] == {"machine": ["m1"]}
    assert whose({"a.log": b"MACHINE zha-gantry\nCALIBRATED true\n"})[0] == {"machine": ["zha-gantry"]}
    assert whose({"a.rtl": b"HEADER::\r\nMachine: Hermle C42\r\nSerial No:4711\r\n"})[1] == {
        "machine": ["Hermle C42"],
        "machine_serial": ["4711"],
    }


def test_columns_of_a_parquet_file_have_comments_too():
    arrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = arrow.table({"x": [1.0]}).replace_schema_metadata({"machine": "m1", "active_table": "none"})
    file = io.BytesIO()
    parquet.write_table(table, file)
    assert comments_in(file.getvalue()) == {"machine": "m1", "active_table": "none"}


@pytest.mark.parametrize("content", [b"PK\x03\x04 no archive", b"PAR1", b"PK\x03\x04", b"\xff\xfe# machine"])
def test_what_is_no_archive_says_nothing(content):
    assert comments_in(content) == {} and duration_s(content + b"time_s") == 0.0


def test_an_archive_cannot_fill_the_memory():
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("time_s.npy", b"\0" * 50_000_000)
        archive.writestr("machine.npy", b"\0" * 50_000_000)
    assert comments_in(packed.getvalue()) == {} and duration_s(packed.getvalue()) == 0.0


# --- names -----------------------------------------------------------------------------------------------------------


RESERVED = ["CON", "nul", "Com1", "LPT9", "aux.old", "PRN.2026", "conin$"]


@pytest.mark.parametrize("name", [*RESERVED, "mill.", "mill "])
def test_names_that_windows_reads_differently(name):
    assert name_problem(name) is not None


@pytest.mark.parametrize("name", ["console", "com10", "mill.con", "nullify", "M1", "lpt"])
def test_names_that_only_look_like_it(name):
    assert name_problem(name, ["other"]) is None


def refused(capsys, *words):
    assert run_command(cli, [*words]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("name", ["CON", "nul", "Com1", "aux.old", "mill-9.", "LPT1.x"])
def test_recal_add_refuses_reserved_names(tmp_path, small_machine_file, capsys, name):
    shutil.copy(small_machine_file, tmp_path / "mill.toml")
    given = ["--machine", "mill.toml", "--inbox", "in", "--controller", "isg-csv", "--out", "out/{name}"]
    job = ["--measured-with", "bare", "--job", str(tmp_path / "recal.toml")]
    said = refused(capsys, "recal", "add", name, *given, *job)
    assert "Windows" in said and not (tmp_path / "recal.toml").exists()


def test_recal_add_refuses_a_name_that_differs_by_case_only(pair, capsys):
    before = (pair.folder / "recal.toml").read_text()
    given = ["--machine", "m1.toml", "--inbox", "in", "--controller", "isg-csv", "--out", "out/third"]
    job = ["--measured-with", "bare", "--job", str(pair.folder / "recal.toml")]
    assert "differs from 'm1' by upper and lower case only" in refused(capsys, "recal", "add", "M1", *given, *job)
    assert (pair.folder / "recal.toml").read_text() == before


@pytest.mark.parametrize(("name", "said"), [("M1", "differs from 'm1'"), ("COM3", "Windows"), ("m3.", "Windows")])
def test_a_job_file_with_such_a_name_is_refused_by_every_command(pair, capsys, name, said):
    path = pair.folder / "recal.toml"
    path.write_text(path.read_text().replace("[machines.m2]", f'[machines."{name}"]'))
    for words in (["run"], ["status"], ["history"], ["approve", name, "1"], ["export-units", "--out", "units"]):
        assert said in refused(capsys, "recal", *words, "--job", str(path))
    assert not (pair.folder / "recal.sqlite").exists()


def test_output_folders_that_differ_by_case_only_are_one_on_some_systems(pair, capsys):
    path = pair.folder / "recal.toml"
    path.write_text(path.read_text().replace('out = "out/m2"', 'out = "OUT/M1"'))
    assert "has the same folder out as m1" in refused(capsys, "recal", "status", "--job", str(path))


def test_two_job_files_with_one_store_cannot_have_such_names_either(pair, capsys):
    pair.measure("m1", "a", 1)
    assert pair.run() == 0
    path = pair.folder / "recal.toml"
    path.write_text(path.read_text().replace("[machines.m1]", "[machines.M1]"))
    assert pair.run("run", "M1") == 1
    out, _ = capsys.readouterr()
    assert "the store cannot add a machine 'M1': it differs from 'm1' by upper and lower case only" in " ".join(
        out.split()
    )
    store = open_store(str(pair.folder / "recal.sqlite"))
    assert [item.name for item in store.machines()] == ["m1", "m2"]
    store.close()


@pytest.mark.parametrize("name", ["CON", "lpt1", "NUL.v2", "mill."])
def test_init_refuses_reserved_names(tmp_path, capsys, name):
    travel = [word for letter in "XYZ" for word in ("--travel", f"{letter}=0..300")]
    said = refused(capsys, "init", name, "--chain", "WXYFZT", *travel, "--out", str(tmp_path))
    assert "Windows" in said and not list(tmp_path.iterdir())


def test_init_refuses_a_file_that_another_system_takes_for_an_existing_one(tmp_path, capsys):
    travel = [word for letter in "XYZ" for word in ("--travel", f"{letter}=0..300")]
    assert run_command(cli, ["init", "mill", "--chain", "WXYFZT", *travel, "--out", str(tmp_path)]) == 0
    said = refused(capsys, "init", "Mill", "--chain", "WXYFZT", *travel, "--out", str(tmp_path), "--force")
    assert "differs from 'mill.toml' by upper and lower case only" in said
