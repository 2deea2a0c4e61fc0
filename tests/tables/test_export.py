"""Export: strict and harmless templates, manifest, names of files that are not accepted, all files or none."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.controls import CONTROLLERS
from compgen.data import toml_files
from compgen.data.files import sha256_of
from compgen.errors import CompgenWarning, InputError
from compgen.pipeline import export_and_verify, run
from compgen.resources import data_folder
from compgen.tables import Provenance, export, load_format, render

ALL = sorted(CONTROLLERS)
#: Text that would show if it were executed, ended a comment or a line, or were written as it is.
HOSTILE = "{{ 'a' * 9 }} {% raw %}\nM17\r\n%\x0bX0\u2028\u00e4\u03a9 ) ; | ` <b> # entries: 3 // records: 3"


def own_templates(folder, name, **changes):
    """A user's templates folder with a copy of one format; ``changes`` map a file name to a function of its text."""
    shutil.copytree(data_folder("templates") / name, folder / name)
    for file, change in changes.items():
        path = folder / name / file
        path.write_text(change(path.read_text()))
    return folder


def with_settings(machine, name, **settings):
    section = toml_files.Section(settings, path=machine.source, name=f"controllers.{name}")
    return replace(machine, controllers={**machine.controllers, name: section})


# --- templates -------------------------------------------------------------------------------------------------------


def test_a_variable_that_is_missing_is_an_error_with_file_and_line(small_machine, small_errors, tmp_path):
    add = {"volcomp.csv.j2": lambda text: "// first\n{{ no_such_number }}\n" + text}
    templates = own_templates(tmp_path, "isg-csv", **add)
    with pytest.raises(InputError, match="no_such_number") as caught:
        export(small_machine, small_errors, "isg-csv", templates=templates)
    assert caught.value.line == 2
    assert str(caught.value.file).endswith("volcomp.csv.j2")


@pytest.mark.parametrize(
    "text",
    [
        "{{ machine_name.__class__.__mro__ }}",
        "{{ tables.__init__.__globals__ }}",
        "{{ ''.__class__.__base__.__subclasses__() }}",
        "{{ inputs.append('x') }}",
        "{% for k in range(10 ** 9) %}x{% endfor %}",
        "{{ 1 / 0 }}",
        "{{ machine_name + 1 }}",
        "{{ 'word' | fixed(3) }}",
        "{{ 1 | no_such_filter }}",
        "{% if %}",
        "{% include '../../pyproject.toml' %}",
        "{% include '/etc/hostname' %}",
    ],
)
def test_templates_are_sandboxed_and_their_mistakes_are_input_errors(small_machine, small_errors, tmp_path, text):
    templates = own_templates(tmp_path, "isg-csv", **{"volcomp.csv.j2": lambda old: old + text})
    with pytest.raises(InputError, match="template"):
        export(small_machine, small_errors, "isg-csv", templates=templates)


def test_the_users_folder_is_searched_first_file_by_file(small_machine, small_errors, tmp_path):
    """A single template without a format.toml replaces the shipped one; the others stay."""
    shipped = data_folder("templates") / "isg-csv"
    (tmp_path / "isg-csv").mkdir()
    own = (shipped / "volcomp.csv.j2").read_text().replace("// Volumetric", "// OURS Volumetric")
    (tmp_path / "isg-csv" / "volcomp.csv.j2").write_text(own)
    theirs = export(small_machine, small_errors, "isg-csv")
    ours = export(small_machine, small_errors, "isg-csv", templates=tmp_path)
    assert ours.files["volcomp0.csv"] == theirs.files["volcomp0.csv"].replace("// Volumetric", "// OURS Volumetric", 1)
    assert ours.files["volcomp0.lis"] == theirs.files["volcomp0.lis"]
    assert ours.preflight.startswith("# Preflight")


ENDLESS = {
    "silent": "{% for a in range(99999) %}{% for b in range(99999) %}{% endfor %}{% endfor %}",
    "writing": "{% for a in range(99999) %}{% for b in range(99999) %}xxxxxxxxxxxxxxxxxxxx{% endfor %}{% endfor %}",
    "macro": "{% macro m() %}{{ m() }}{% endmacro %}{{ m() }}",
    "power": "{{ 9 ** (9 ** 9) }}",
    "text": "{{ 'a' * 10 ** 12 }}",
    "list": "{{ [0] * 10 ** 12 }}",
    "squares": "{% set n = namespace(x=3) %}{% for a in range(9999) %}{% set n.x = n.x * n.x %}{% endfor %}",
}


@pytest.mark.parametrize("name", ENDLESS)
def test_a_template_that_never_ends_is_ended(small_machine, small_errors, tmp_path, monkeypatch, name):
    monkeypatch.setattr(render, "LONGEST_S", 1.0)
    monkeypatch.setattr(render, "MOST_CHARACTERS", 3_000_000)
    templates = own_templates(tmp_path, "isg-csv", **{"volcomp.csv.j2": lambda old: old + ENDLESS[name]})
    with pytest.raises(InputError, match="template cannot be rendered") as caught:
        export(small_machine, small_errors, "isg-csv", templates=templates)
    assert name == "writing" or str(tmp_path) in str(caught.value.file)
    export(small_machine, small_errors, "isg-csv")  # nothing strikes later
    time.sleep(1.2)


TRACED = """
import sys
import compgen
machine = compgen.load_machine("zha-gantry")
sys.settrace(lambda *_: None)
compgen.export(machine, compgen.ErrorTable(squareness={"EC0Y": (1e-5, 0.0)}), "isg-csv")
"""


def test_rendering_comes_back_where_calls_are_traced():
    """Coverage and debuggers trace calls; the guard against endless templates must leave nothing behind that stops them."""
    subprocess.run([sys.executable, "-c", TRACED], timeout=120, check=True)


def test_a_templates_folder_that_is_not_there_is_an_error(small_machine, small_errors, tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        export(small_machine, small_errors, "isg-csv", templates=tmp_path / "missing")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "volcomp0.csv"', 'name = "../volcomp0.csv"', "plain file name"),
        ('name = "volcomp0.csv"', 'name = "/tmp/volcomp0.csv"', "plain file name"),
        ('name = "volcomp0.csv"', 'name = "manifest.json"', "plain file name"),
        ('name = "volcomp0.csv"', 'name = "volcomp0.lis"', "its own name"),
        ('name = "isg-csv"', 'name = "siemens-cec"', "'isg-csv'"),
        ('evidence = "documented"', 'evidence = "rumour"', "evidence"),
        ('evidence = "documented"', 'evidense = "documented"', "evidence"),
        ('template = "volcomp.csv.j2"', 'template = "volcomp.cvs.j2"', "volcomp.cvs.j2"),
    ],
)
def test_a_wrong_format_card_is_an_input_error(small_machine, small_errors, tmp_path, old, new, message):
    def change(text):
        assert text.count(old) == 1
        return text.replace(old, new)

    templates = own_templates(tmp_path, "isg-csv", **{"format.toml": change})
    with pytest.raises(InputError, match=message):
        export(small_machine, small_errors, "isg-csv", templates=templates)


def test_line_ends_are_those_of_the_card(small_machine, small_errors, tmp_path):
    change = {
        "format.toml": lambda text: text.replace('name = "volcomp0.csv"', 'name = "volcomp0.csv"\nline_end = "crlf"')
    }
    templates = own_templates(tmp_path, "isg-csv", **change)
    export(small_machine, small_errors, "isg-csv", templates=templates).write(tmp_path / "out")
    content = (tmp_path / "out" / "volcomp0.csv").read_bytes()
    assert content.count(b"\r\n") == content.count(b"\n") > 10
    assert b"\r" not in (tmp_path / "out" / "volcomp0.lis").read_bytes()


# --- text that came from a user --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_hostile_names_stay_inert_in_every_file(name, small_machine, small_errors, tmp_path):
    tame = export(
        small_machine, small_errors, name, allow_unverified=True, provenance=Provenance((("a.csv", "0" * 64),))
    )
    machine = replace(small_machine, name=HOSTILE)
    errors = small_errors.replace(metadata={HOSTILE: HOSTILE, "machine": HOSTILE})
    made = export(machine, errors, name, allow_unverified=True, provenance=Provenance(((HOSTILE, "0" * 64),)))
    assert made.files.keys() == tame.files.keys()
    for file, text in [*made.files.items(), ("preflight.md", made.preflight)]:
        assert "a" * 9 not in text, file
        assert text.isascii(), file
        other = tame.preflight if file == "preflight.md" else tame.files[file]
        assert all(char >= " " or char in "\r\n\t" for char in text), file
        assert (text.count("\n"), text.count("\t")) == (other.count("\n"), other.count("\t")), file
    paths = made.write(tmp_path / "out")
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["machine"]["name"] == HOSTILE
    position = np.random.default_rng(2).uniform(machine.lower_mm, machine.upper_mm, (50, 3))
    read = [
        compgen.read_tables(small_machine, files, name).correction(small_machine, compgen.Points(position))
        for files in (paths, tame.write(tmp_path / "tame"))
    ]
    assert np.array_equal(read[0], read[1])


# --- manifest and bytes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_the_manifest_states_the_bytes_on_disk(name, small_machine, small_errors, tmp_path):
    paths = export(small_machine, small_errors, name, allow_unverified=True).write(tmp_path)
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert manifest["accepted"] is True
    assert {item["name"]: item["sha256"] for item in manifest["files"]} == {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths
    }
    assert manifest["machine"]["sha256"] == sha256_of(small_machine.source.read_bytes())
    preflight = (tmp_path / "preflight.md").read_text()
    assert all(item["sha256"] in preflight and item["name"] in preflight for item in manifest["files"])
    assert " ".join(manifest["sign_statement"].split()) in " ".join(preflight.split())


@pytest.mark.parametrize("name", ALL)
def test_the_same_input_gives_the_same_bytes(name, small_machine, small_errors, listing, tmp_path):
    for folder in ("first", "second"):
        export(small_machine, small_errors, name, allow_unverified=True).write(tmp_path / folder)
    assert listing(tmp_path / "first") == listing(tmp_path / "second")


@pytest.mark.parametrize("name", ALL)
def test_numbers_have_no_exponent_and_no_negative_zero(name, small_machine, small_errors):
    import re

    tiny = small_errors.replace(squareness={key: (-1e-13, 0.0) for key in small_errors.squareness})
    for text in export(small_machine, tiny, name, allow_unverified=True).files.values():
        assert not re.search(r"(?<![A-Za-z0-9])[-+]?\d+\.?\d*[eE][-+]?\d+", text)
        assert not re.search(r"-0\.?0*(?![0-9.])", text)


# --- tables that are not accepted ------------------------------------------------------------------------------------


def test_tables_that_break_a_limit_are_named_so_and_the_older_ones_are_moved_aside(
    small_machine, small_errors, tmp_path
):
    good = export(small_machine, small_errors, "isg-csv")
    good.write(tmp_path)
    bad = export(with_settings(small_machine, "isg-csv", max_records=3), small_errors, "isg-csv")
    assert "max_records" in bad.violations[0]
    paths = bad.write(tmp_path)
    assert [path.name for path in paths] == ["NOT-ACCEPTED-volcomp0.csv", "NOT-ACCEPTED-volcomp0.lis"]
    assert json.loads((tmp_path / "manifest.json").read_text())["file_prefix"] == "NOT-ACCEPTED-"
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "NOT-ACCEPTED-volcomp0.csv",
        "NOT-ACCEPTED-volcomp0.lis",
        "PREVIOUS-volcomp0.csv",
        "PREVIOUS-volcomp0.lis",
        "manifest.json",
        "preflight.md",
    ]
    assert (tmp_path / "PREVIOUS-volcomp0.csv").read_text() == good.files["volcomp0.csv"]
    good.write(tmp_path)
    assert (tmp_path / "PREVIOUS-NOT-ACCEPTED-volcomp0.csv").read_text() == bad.files["volcomp0.csv"]
    assert not (tmp_path / "NOT-ACCEPTED-volcomp0.csv").exists()
    assert (tmp_path / "volcomp0.csv").read_text() == good.files["volcomp0.csv"]


def test_a_table_that_the_round_trip_rejects_is_named_so(small_machine, small_errors, tmp_path):
    """The errors are measured anew and have changed sign: the old table makes everything worse."""
    turned = {
        key: compgen.Curve(curve.position_mm, -curve.value, curve.u) for key, curve in small_errors.curves.items()
    }
    result = export_and_verify(small_machine, small_errors, small_errors.replace(curves=turned), "isg-csv", tmp_path)
    assert not result.verification.accepted
    assert [path.name for path in result.paths] == ["NOT-ACCEPTED-volcomp0.csv", "NOT-ACCEPTED-volcomp0.lis"]
    written = json.loads((tmp_path / "result.json").read_text())
    assert written["accepted"] is False
    assert written["files"] == [{"name": path.name, "sha256": sha256_of(path.read_bytes())} for path in result.paths]
    assert json.loads((tmp_path / "manifest.json").read_text())["accepted"] is False


# --- unverified formats ----------------------------------------------------------------------------------------------


def unverified(folder):
    change = {"format.toml": lambda text: text.replace('evidence = "documented"', 'evidence = "unverified"')}
    return own_templates(folder, "isg-csv", **change)


def test_an_unverified_format_needs_the_flag(small_machine, small_errors, tmp_path):
    templates = unverified(tmp_path)
    with pytest.raises(InputError, match="--allow-unverified") as caught:
        export(small_machine, small_errors, "isg-csv", templates=templates)
    assert load_format("isg-csv").unverified[0] in str(caught.value)
    made = export(small_machine, small_errors, "isg-csv", templates=templates, allow_unverified=True)
    assert made.manifest["evidence"] == "unverified"
    assert made.files == export(small_machine, small_errors, "isg-csv").files


def test_a_run_refuses_an_unverified_format_before_anything_is_written(
    small_machine, small_lengths_file, listing, tmp_path
):
    templates = unverified(tmp_path / "own")
    with pytest.raises(InputError, match="--allow-unverified"):
        run(small_machine, [small_lengths_file], ["isg-csv"], tmp_path / "out", templates=templates)
    assert not (tmp_path / "out").exists()


# --- all files or none -----------------------------------------------------------------------------------------------


def test_a_failure_while_renaming_leaves_the_old_files(small_machine, small_errors, listing, tmp_path, monkeypatch):
    export(small_machine, small_errors, "isg-csv").write(tmp_path)
    before = listing(tmp_path)
    real, calls = os.replace, []

    def failing(source, target):
        calls.append(target)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        real(source, target)

    monkeypatch.setattr(os, "replace", failing)
    other = small_errors.replace(squareness={})
    with pytest.raises(InputError, match="No space left"):
        export(small_machine, other, "isg-csv").write(tmp_path)
    monkeypatch.undo()
    assert len(calls) > 3
    assert listing(tmp_path) == before


def test_a_template_whose_text_cannot_be_read_back_leaves_nothing(small_machine, small_lengths_file, tmp_path):
    """The numbers get a decimal comma: the read-back finds it, after identification and fit, and nothing is written."""
    change = {"AX_EEC.INI.j2": lambda text: text.replace("M17", "$AA_ENC_COMP[0,0,AX1]=0,5\nM17")}
    templates = own_templates(tmp_path / "own", "siemens-eec", **change)
    with pytest.raises(InputError, match="cannot be read back") as caught:
        run(small_machine, [small_lengths_file], ["siemens-eec"], tmp_path / "out", templates=templates)
    assert caught.value.file == "AX_EEC.INI"
    assert caught.value.line is not None
    assert not (tmp_path / "out").exists()
    # beside another control it alone has no tables, and its row says why
    with pytest.warns(CompgenWarning, match="siemens-eec: no tables: AX_EEC.INI:.*cannot be read back"):
        run(small_machine, [small_lengths_file], ["isg-csv", "siemens-eec"], tmp_path / "out", templates=templates)
    assert not list((tmp_path / "out").rglob("AX_EEC.INI"))


def test_a_run_without_a_control_is_refused(small_machine, small_lengths_file, tmp_path):
    with pytest.raises(InputError, match="no controller"):
        run(small_machine, [small_lengths_file], [], tmp_path / "out")
