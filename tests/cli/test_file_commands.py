"""volcomp init, check and schema: what a reader takes, its schema takes; every problem of a file is said at once."""

import json
import os
import pty
import random
import subprocess
import sys
import tomllib
import warnings
from copy import deepcopy
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.cli.file_commands import KINDS
from compgen.controls import CONTROLLERS
from compgen.data import toml_files
from compgen.data.machine import read_machine
from compgen.errors import CompgenWarning, InputError

ROOT = Path(__file__).parents[2]
SHIPPED = {
    "machine": sorted((ROOT / "machines").glob("*.toml")),
    "job": [ROOT / "examples/recal/recal.toml"],
    "scenario": sorted((ROOT / "examples").glob("*.scenario.toml")),
    "instrument": sorted((ROOT / "examples").glob("*.instrument.toml")),
}
FILES = [(kind, path) for kind, paths in SHIPPED.items() for path in paths]


@pytest.fixture
def call(capsys, monkeypatch, tmp_path):
    """Run the command line in an empty folder: (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        code = run_command(cli, [str(word) for word in words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture(scope="module")
def schemas():
    return {name: kind.schema() for name, kind in KINDS.items()}


def refused(kind, data, path):
    """Whether the reader of a kind of file refuses these data."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        try:
            KINDS[kind].read(toml_files.Section(deepcopy(data), path=path, text=path.read_text()))
        except InputError:
            return True
    return False


def places(data, at=()):
    """Every key of nested tables, and of tables in arrays."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield (*at, key)
        if isinstance(value, dict) or (isinstance(value, list) and value and isinstance(value[0], dict)):
            yield from places(value, (*at, key))


def changed(data, place, change):
    """The data with the table around a place changed by ``change(table, key)``."""
    result = deepcopy(data)
    table = result
    for key in place[:-1]:
        table = table[key]
    change(table, place[-1])
    return result


# --- schema --------------------------------------------------------------------------------------------------------


def test_every_kind_of_file_is_shipped_or_made_in_an_example():
    assert {kind for kind, _ in FILES} == set(KINDS)
    assert len(SHIPPED["machine"]) >= 3 and len(SHIPPED["scenario"]) >= 3


@pytest.mark.parametrize("kind", KINDS)
def test_the_schema_is_one_of_draft_2020_12(kind, call):
    code, stdout, stderr = call("schema", kind)
    assert (code, stderr) == (0, "")
    schema = json.loads(stdout)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    Draft202012Validator.check_schema(schema)
    assert {key: value for key, value in schema.items() if key not in ("$schema", "title")} == json.loads(
        json.dumps(KINDS[kind].schema())
    )


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda item: getattr(item, "name", item))
def test_a_shipped_file_is_valid(kind, path, schemas):
    data = tomllib.loads(path.read_text())
    assert [error.message for error in Draft202012Validator(schemas[kind]).iter_errors(data)] == []
    assert not refused(kind, data, path)


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda item: getattr(item, "name", item))
def test_what_is_wrong_with_one_key_is_refused_by_reader_and_schema_alike(kind, path, schemas):
    data, validator = tomllib.loads(path.read_text()), Draft202012Validator(schemas[kind])
    assert len(list(places(data))) > 8
    for place in places(data):
        nonsense = changed(data, place, lambda table, key: table.__setitem__(key, [[["nonsense"]]]))
        assert refused(kind, nonsense, path) and not validator.is_valid(nonsense), place
        if isinstance(place[-1], int):
            continue
        # names of machines and temperatures are free: their entries are tables
        unknown = changed(data, place, lambda table, key: table.__setitem__("no_such_key", 1))
        assert refused(kind, unknown, path) and not validator.is_valid(unknown), place
        # a key that is missing is refused by both or by none
        without = changed(data, place, lambda table, key: table.pop(key))
        assert refused(kind, without, path) == (not validator.is_valid(without)), place


PROBES = [True, False, 0, 1, 2, -1, 7, 0.5, -0.5, 1.0, 33.0, 1e16, "", " ", "x", "X", "XY", "AX1", "a=b", "a\nb", [], [1], [1, 2],
          [2, 1], [1.0, 2.0, 3.0], [0], [0, 1], ["X"], ["X", "X"], ["Y(x)"], [[1, 2]], [[1.0, 2.0, 3.0]], {}, {"X": 1.0},
          {"X": 1.0, "Y": 2.0, "Z": 3.0}, {"X": [0, 1]}, {"Q": 1}, "WFYXZT", "observable", 17, 18, "none", "XYZA"]  # fmt: skip


@pytest.mark.parametrize("name", sorted(CONTROLLERS))
def test_the_schema_takes_what_the_check_of_a_setting_takes_and_most_of_all_refuses_what_it_refuses(name):
    for key, _ in toml_files.declared_settings(CONTROLLERS[name].settings_class):
        schema = toml_files.accepted(key.check)
        if key.key == "points":  # the reader takes what is in this table key by key
            continue
        assert schema, f"the check of {key.key} does not say what it takes"
        validator = Draft202012Validator(schema)
        for probe in PROBES:
            try:
                key.check(probe)
            except ValueError:
                continue
            assert validator.is_valid(probe), (key.key, probe)
        assert not validator.is_valid([[["nonsense"]]])


def test_a_schema_tells_meaning_unit_default_and_choices(schemas):
    machine = schemas["machine"]["properties"]
    assert "mm" in machine["tool_offset_mm"]["description"]
    assert machine["tool_offset_mm"]["default"] == [0.0, 0.0, 0.0]
    assert machine["curves"]["enum"] == ["linear", "cubic"]
    assert machine["controllers"]["properties"]["siemens-cec"]["properties"]["sign"]["enum"] == ["error", "correction"]
    assert set(machine["controllers"]["properties"]) == set(CONTROLLERS)
    assert machine["effects"]["properties"]["backlash_X"]["anyOf"] == [{"required": ["c_um"]}]
    job = schemas["job"]["properties"]["defaults"]["properties"]
    assert job["policy"]["properties"]["confidence"]["default"] == 0.98
    trajectory = schemas["scenario"]["properties"]["trajectory"]["properties"]
    assert trajectory["feed_mm_min"]["description"].startswith("path speed between points")
    # every key of a machine, job and scenario says what it means
    for kind in ("machine", "job", "scenario"):
        assert [
            key for key, item in schemas[kind]["properties"].items() if key != "axes" and "description" not in item
        ] == []


def test_effects_of_stations_have_any_station_in_their_names(schemas):
    scenario = Draft202012Validator(schemas["scenario"]["properties"]["effects"])
    assert scenario.is_valid([{"name": "length_step_LT 1.b", "c_um": 1.0, "time_s": 3.0}])
    assert not scenario.is_valid([{"name": "length_step_", "c_um": 1.0, "time_s": 3.0}])
    assert not scenario.is_valid([{"name": "length_step_A", "c_mm": 1.0, "time_s": 3.0}])
    assert scenario.is_valid([{"name": "dead_path", "c_A_um_per_k": 1.0}])
    assert not scenario.is_valid([{"name": "no_such_effect"}])


# --- check ---------------------------------------------------------------------------------------------------------

BAD = """name = "x"
chain = "WXYZT"
reference_point = [0, 0, 0]
tool_offset_mm = "no"
[axes.X]
range = [0.0, 0.8]
nodes = 1
[axes.Y]
range_mm = [0.0, 500.0]
nodez = 5
[axes.Z]
range_mm = [0.0, 0.5]
nodes = 5
colour = 1
[controllers.siemens-cec]
sing = "error"
mult_mode = "S9"
[controllers.siemens-ceck]
[controllers.pmac]
motors = {X = 1, Y = 1, Z = 3}
[effects.backlash_X]
c_mm = 3
[effects.nonsense]
"""
FOUND = [
    (2, "chain", "chain 'WXYZT' is not valid"),
    (3, "reference_point", "did you mean 'reference_point_mm'?"),
    (4, "tool_offset_mm", "three numbers"),
    (5, "[axes.X] range_mm", "did you mean 'range_mm'?"),
    (7, "[axes.X] nodes", "a whole number from 2"),
    (8, "[axes.Y] nodes", "'nodez' is not a key here, did you mean 'nodes'?"),
    (14, "[axes.Z] colour", "is not a known key"),
    (16, "[controllers.siemens-cec] sing", "did you mean 'sign'?"),
    (17, "[controllers.siemens-cec] mult_mode", "expected one of 'S1', 'S2', 'S3', 'S4'; got 'S9'"),
    (18, "[controllers.siemens-ceck]", "is not a controller; did you mean 'siemens-cec'?"),
    (19, "[controllers.pmac] counts_per_mm", "is missing"),
    (20, "[controllers.pmac] motors", "three different motors are needed"),
    (21, "[effects.backlash_X] c_um", "is missing"),
    (22, "[effects.backlash_X] c_mm", "did you mean 'c_um'?"),
    (23, "[effects.nonsense]", "unknown effect"),
]


def test_every_problem_of_a_file_is_listed_with_its_line_and_what_is_expected(call, tmp_path):
    (tmp_path / "bad.toml").write_text(BAD)
    code, stdout, stderr = call("check", "bad.toml", "--json")
    assert (code, stderr) == (2, "")
    (item,) = json.loads(stdout)["files"]
    assert [(problem["line"], problem["field"]) for problem in item["problems"]] == [found[:2] for found in FOUND]
    assert all(part in problem["message"] for problem, (_, _, part) in zip(item["problems"], FOUND, strict=True))
    # a travel of less than 5 mm is asked about
    assert [text[:45] for text in item["warnings"]] == [
        "[axes.X] range_mm: is the travel really 0.8 m",
        "[axes.Z] range_mm: is the travel really 0.5 m",
    ]
    code, shown, _ = call("check", "bad.toml")
    assert code == 2 and "bad.toml:2: chain: chain 'WXYZT'" in shown and "question: [axes.X]" in shown


def test_mending_what_is_listed_leaves_nothing(call, tmp_path):
    text = BAD.replace("WXYZT", "WXYFZT").replace("reference_point", "reference_point_mm").replace('"no"', "[0, 0, 0]")
    text = text.replace("range =", "range_mm =").replace("nodes = 1\n", "nodes = 2\n").replace("nodez", "nodes")
    text = text.replace("colour = 1\n", "").replace("sing", "sign").replace("S9", "S1").replace("ceck]", "eec]")
    text = text.replace("{X = 1, Y = 1, Z = 3}", "{X = 1, Y = 2, Z = 3}\ncounts_per_mm = 1000.0").replace(
        "c_mm", "c_um"
    )
    (tmp_path / "good.toml").write_text(text.replace("[effects.nonsense]\n", ""))
    assert call("check", "good.toml")[0] == 0


def test_a_broken_file_does_not_keep_the_others_of_a_folder_from_being_checked(call, tmp_path):
    folder = tmp_path / "files" / "deeper"
    folder.mkdir(parents=True)
    (folder.parent / "a.toml").write_text("name = [")
    (folder.parent / "empty.toml").write_text("")
    (folder / "b.toml").write_text(
        (ROOT / "machines/zha-gantry.toml").read_text().replace("nodes = 11", "nodes = 1", 1)
    )
    (folder / "c.toml").write_text((ROOT / "machines/zha-gantry.toml").read_text())
    (folder / "other.toml").write_text("[project]\nversion = 1\n")
    code, stdout, stderr = call("check", "files")
    assert (code, stderr) == (2, "")
    lines = stdout.splitlines()
    assert "files/a.toml: file, 1 problem" in lines and "files/empty.toml: file, 1 problem" in lines
    assert "files/deeper/b.toml: machine, 1 problem" in lines and "files/deeper/c.toml: machine, no problem" in lines
    assert any(line.startswith("files/deeper/other.toml: skipped") for line in lines)
    assert call("check", "files/deeper/other.toml")[0] == 2  # named itself, it is a problem


@pytest.mark.parametrize("name", ["zha-gantry", "jia-xytz", "moving-table-mill"])
def test_shipped_machines_are_checked_by_name(name, call):
    code, stdout, stderr = call("check", name)
    assert (code, stderr) == (0, "") and f"{name}.toml: machine, no problem" in stdout


def test_problems_of_jobs_scenarios_and_instruments_are_listed(call, tmp_path):
    (tmp_path / "job.toml").write_text(
        '[defaults]\ninbox = "in"\nout = "out/{name}"\ncontroler = 1\n[machines.a]\nmachine = "zha-gantry"\n'
        'controllers = ["pmack"]\n[machines.b]\nmachine = "zha-gantry"\ncontrollers = ["pmac"]\nmeasured_with = "maybe"\n'
    )
    (tmp_path / "s.toml").write_text(
        'seed = -1\n[instrument]\ntype = "laser-tracer"\nnoise = 1\n[[instrument.stations]]\nname = "A"\n'
        'position_mm = [1, 2]\ndead_length_mm = 3\n[trajectory]\ntype = "gird"\n[[effects]]\nname = "backlash_Q"\n'
    )
    text = (ROOT / "examples/jia-xytz.instrument.toml").read_text()
    text = text.replace("glass_index = 1.5151", "glass_index = 15.1").replace("mode = 2", "mode = 3", 1)
    (tmp_path / "i.toml").write_text(text.replace("eps_PEy_arcsec = 4.0", "eps_PEy_deg = 4.0"))
    code, stdout, _ = call("check", "job.toml", "s.toml", "i.toml", "--json")
    found = {item["file"]: [problem["field"] for problem in item["problems"]] for item in json.loads(stdout)["files"]}
    assert code == 2
    assert sorted(found["job.toml"]) == sorted(
        ["[defaults] controler", "[machines.a] measured_with", "[machines.a] controllers", "[machines.b] measured_with"]
    )
    assert sorted(found["s.toml"]) == sorted(
        ["seed", "[instrument] noise", "[instrument.stations] position_mm", "[trajectory] type", "[effects] name"]
    )
    assert sorted(found["i.toml"]) == sorted(["glass_index", "[axes.X] mode", "[systematics] eps_PEy_deg"])


def test_a_file_that_a_scenario_names_is_checked_with_it_and_the_rest_all_the_same(call, tmp_path):
    (tmp_path / "i.toml").write_text('kind = "sixdof-laser"\n')
    (tmp_path / "s.toml").write_text('seed = 1\nnema = "x"\n[instrument]\ntype = "sixdof"\nfile = "i.toml"\n')
    code, stdout, _ = call("check", "s.toml", "--json")
    (item,) = json.loads(stdout)["files"]
    assert code == 2
    assert {(Path(problem["file"]).name, problem["field"]) for problem in item["problems"]} >= {("s.toml", "nema")}
    assert any(Path(problem["file"]).name == "i.toml" for problem in item["problems"])


@pytest.mark.parametrize(
    ("words", "message"),
    [(["no-such-machine"], "no-such-machine"), (["none.toml"], "none.toml"), (["empty"], "has no *.toml file")],
)
def test_what_is_not_there_cannot_be_checked(words, message, call, tmp_path):
    (tmp_path / "empty").mkdir()
    code, stdout, stderr = call("check", *words)
    assert code == 2 and message in stdout + stderr


@pytest.mark.parametrize(("kind", "path"), FILES, ids=lambda item: getattr(item, "name", item))
def test_a_file_damaged_anywhere_is_looked_over_to_its_end(kind, path, schemas):
    """Problems are listed exactly if the reader refuses the file, and what it takes its schema takes."""
    chance, data = random.Random(7), tomllib.loads(path.read_text())
    for _ in range(25):
        damaged = data
        for _ in range(chance.randint(1, 4)):
            place, probe = chance.choice(list(places(damaged))), deepcopy(chance.choice(PROBES))
            name = place[-1] if chance.random() < 0.6 or isinstance(place[-1], int) else "no_such_key"
            damaged = changed(damaged, place, lambda table, key, name=name, probe=probe: table.__setitem__(name, probe))
        found = problems_in(kind, damaged, path)
        assert bool(found.problems) == refused(kind, damaged, path)
        assert found.problems or Draft202012Validator(schemas[kind]).is_valid(damaged)


def problems_in(kind, data, path):
    """What ``problems_of`` finds in data as the file ``path`` would have them."""
    whole = toml_files.read_toml
    with pytest.MonkeyPatch.context() as patch:
        section = toml_files.Section(deepcopy(data), path=path, text=path.read_text())
        patch.setattr(toml_files, "read_toml", lambda other: section if Path(other) == path else whole(other))
        return toml_files.problems_of(path, KINDS[kind].read, ("controllers", "effects", "machines"))


# --- settings that a command does not use --------------------------------------------------------------------------


@pytest.mark.parametrize("section", ['[controllers.siemens-cec]\nsing = "error"\n', "[controllers.siemens-ceck]\n"])
def test_settings_of_controls_that_a_command_does_not_use_are_a_warning(section, call, tmp_path):
    text = (ROOT / "machines/moving-table-mill.toml").read_text()
    (tmp_path / "m.toml").write_text(text + section)
    (tmp_path / "p.points.csv").write_text("x_mm,y_mm,z_mm\n10,10,10\n")
    (tmp_path / "e.errors.csv").write_text("error,position_mm,value,u_value\nEXX,0,0,\nEXX,600,5,\n")
    code, _, stderr = call("predict", "m.toml", "e.errors.csv", "--points", "p.points.csv", "--out", "o")
    assert code == 0 and "warning: m.toml" in stderr and "This command does not use these settings" in stderr
    words = ["export", "m.toml", "e.errors.csv", "--out", "tables", "--controller"]
    code, _, stderr = call(*words, "isg-csv")
    if "sing" in section:
        assert code == 0 and "This command does not use these settings" in stderr
        code, _, stderr = call(*words, "siemens-cec")
        assert code == 2 and "[controllers.siemens-cec] sing: is not a known key; did you mean 'sign'?" in stderr
    else:  # the name may be that of the control in use, misspelt: its settings would be missing
        assert code == 2 and "[controllers.siemens-ceck]: is not a controller; did you mean 'siemens-cec'?" in stderr


# --- init ----------------------------------------------------------------------------------------------------------

TRAVEL = ["--travel", "X=-800..0", "--travel", "Y=0:400, Z=0..500"]


def test_the_written_file_passes_the_check_and_is_planned_and_simulated(call, tmp_path):
    controls = [word for name in sorted(CONTROLLERS) for word in ("--control", name)]
    code, stdout, stderr = call("init", "my-mill", "--chain", "table in X, saddle in Y, head in Z", *TRAVEL, *controls)
    assert (code, stderr) == (0, "") and "my-mill.toml: WXYFZT: table moves in X" in stdout
    machine = read_machine("my-mill.toml")
    assert machine.chain.name == "WXYFZT"
    assert [axis.range_mm for axis in machine.axes] == [(-800.0, 0.0), (0.0, 400.0), (0.0, 500.0)]
    assert [len(axis.nodes_mm) for axis in machine.axes] == [9, 5, 6]
    # what must be stated before the section can be read is left as a comment, with the reason
    text = Path("my-mill.toml").read_text()
    assert set(CONTROLLERS) - set(machine.controllers) == {
        "centroid",
        "ecmc",
        "fagor-8055",
        "mach4",
        "pmac",
        "ucnc",
        "weihong",
    }
    assert "# open: [controllers.pmac] counts_per_mm is missing" in text and "\n# counts_per_mm = ... " in text
    assert "# open: [controllers.mitsubishi] mode is missing" in text and '\n# sign = "error" ' in text
    code, stdout, stderr = call("check", "my-mill.toml")
    assert (code, stdout, stderr) == (0, "my-mill.toml: machine, no problem\n", "")
    scenario = (
        (ROOT / "examples/moving-table-mill.scenario.toml").read_text().replace("start_mm = [600.0", "start_mm = [0.0")
    )
    (tmp_path / "s.toml").write_text(scenario)
    assert call("simulate", "my-mill.toml", "--scenario", "s.toml", "--out", "simulated")[0] == 0
    stations = "station,x_mm,y_mm,z_mm\nA,-900,-100,-200\nB,100,-100,-200\nC,100,500,-200\nD,-900,500,100\n"
    (tmp_path / "stations.csv").write_text(stations)
    code, _, stderr = call("plan", "my-mill.toml", "--stations", "stations.csv", "--grid", "--out", "planned")
    assert code in (0, 1), stderr


def test_a_file_that_exists_is_overwritten_by_force_only(call):
    words = ["init", "m", "--chain", "WFYXZT", *TRAVEL]
    assert call(*words)[0] == 0
    before = Path("m.toml").read_text()
    code, _, stderr = call(*words, "--nodes", "7")
    assert code == 2 and "m.toml: exists; --force overwrites it" in stderr and Path("m.toml").read_text() == before
    assert call(*words, "--nodes", "7", "--nodes", "Z=3", "--force")[0] == 0
    assert [len(axis.nodes_mm) for axis in read_machine("m.toml").axes] == [7, 7, 3]


FIVE = ["--travel", "A=-110..30", "--travel", "C=endless", "--point", "A=0,0,-50", "--point", "C=1,2,3"]


def test_a_machine_with_rotary_axes_is_described_in_words(call):
    words = "trunnion in A and C, table in Y, column in X, head in Z"
    code, stdout, stderr = call("init", "five", "--chain", words, *TRAVEL, *FIVE)
    assert (code, stderr) == (0, "") and "WCAYFXZT" in stdout and "workpiece turns in C, carried by A" in stdout
    machine = read_machine("five.toml")
    assert machine.rotary["A"].range_deg == (-110.0, 30.0) and machine.rotary["A"].point_mm == (0.0, 0.0, -50.0)
    assert machine.rotary["C"].modulo_deg == 360.0 and machine.rotary["C"].point_mm == (1.0, 2.0, 3.0)
    assert call("check", "five.toml")[0] == 0
    # what is not stated is assumed aloud
    code, _, stderr = call("init", "nut", "--chain", "nutating head", *TRAVEL)
    assert code == 0 and stderr.count("question: ") == 6 and "where is its axis line" in stderr
    assert read_machine("nut.toml").rotary["B"].direction == pytest.approx([0.0, 0.5**0.5, 0.5**0.5])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--travel", "B=0..90"], "is not of the form AXIS=LOW..HIGH"),
        (["--point", "B=0,0,1"], "has no rotary axis B (it has C, A)"),
        (["--point", "A=0,1"], "is not of the form AXIS=X,Y,Z"),
        (["--point", "A=0,0,1", "--point", "A=0,0,2"], "A is given twice"),
        (["--travel", "A=30..-110"], "with the lower number first"),
        (["--travel", "A=-1.92..0.52"], "are these radians"),
        (["--travel", "A=some"], "is not of the form AXIS=LOW..HIGH in degrees"),
    ],
)
def test_bad_answers_about_rotary_axes_write_nothing(words, message, call):
    code, _, stderr = call("init", "m", "--chain", "WCAYFXZT", *TRAVEL, *words)
    assert code == 2 and message in " ".join(stderr.split()) and list(Path().iterdir()) == []


def test_words_with_two_orders_are_taken_as_named_and_asked_about(call):
    code, stdout, stderr = call("init", "m", "--chain", "table moves in X and Y, head in Z", *TRAVEL, "--json")
    answer = json.loads(stdout)
    assert (code, stderr.count("question: ")) == (0, 1) and "WYXFZT" in stderr
    assert answer["chain"] == "WXYFZT" and len(answer["questions"]) == 1
    assert list(Path().iterdir()) == [Path("m.toml")]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["m", "--chain", "table in X", *TRAVEL], "can mean 12 machines; give one of the codes: "),
        (["m", "--chain", "slide in X, column in Y, table in Z", *TRAVEL], "WZFYXT: table moves in Z; head moves in X"),
        (["m", "--chain", "foo", *TRAVEL], "names no axes that move"),
        (["m", *TRAVEL], "--chain: is missing"),
        (["--chain", "WFYXZT", *TRAVEL], "NAME: is missing"),
        (["m", "--chain", "WFYXZT", "--travel", "X=0..5"], "--travel: is missing"),
        (["m", "--chain", "WFYXZT", *TRAVEL, "--travel", "X=0..5"], "X is given twice"),
        (["m", "--chain", "WFYXZT", "--travel", "X=5..0,Y=0..1,Z=0..1"], "with the lower number first"),
        (["m", "--chain", "WFYXZT", "--travel", "X=a..0,Y=0..1,Z=0..1"], "is not of the form AXIS=LOW..HIGH"),
        (["m", "--chain", "WFYXZT", *TRAVEL, "--travel", "B=0..360"], "is not of the form AXIS=LOW..HIGH"),
        (["m", "--chain", "WFYXZT", *TRAVEL, "--nodes", "Q=5"], "is not of the form [AXIS=]N"),
        (["m", "--chain", "WFYXZT", *TRAVEL, "--nodes", "1"], "is not of the form [AXIS=]N"),
        (["m", "--chain", "WFYXZT", *TRAVEL, "--control", "pmack"], "pmac"),
        (["a=b", "--chain", "WFYXZT", *TRAVEL], "a name without '='"),
    ],
)
def test_bad_answers_write_nothing(words, message, call):
    code, _, stderr = call("init", *words)
    assert code == 2 and message in stderr and list(Path().iterdir()) == []


def test_on_a_terminal_what_no_option_says_is_asked(tmp_path):
    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", "from compgen.cli import main; main()", "init"]
    process = subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path)
    answers = [
        "mill",
        "table moves in X and Y, head in Z",
        "2",
        "0..600",
        "0..400",
        "-0.3..0.2",
        "isg-csv",
        "hobby router",
    ]
    os.write(ours, ("\n".join(answers) + "\n").encode())
    _, stderr = process.communicate(timeout=60)
    os.close(ours)
    os.close(theirs)
    assert process.returncode == 0, stderr.decode()
    machine = read_machine(tmp_path / "mill.toml")
    assert (machine.chain.name, list(machine.controllers)) == ("WYXFZT", ["isg-csv"])
    assert b"is the travel really 0.5 mm?" in stderr


@pytest.mark.parametrize(
    ("text", "ends"),
    [
        ("-800..0", [-800.0, 0.0]),
        ("24in", [0.0, 609.6]),
        ("0..24in", [0.0, 609.6]),
        ('-20..0"', [-508.0, 0.0]),
        ("0mm..0.6m", [0.0, 600.0]),
        ("-2ft", [-609.6, 0.0]),
        ("0 to 23,6 in", [0.0, 599.44]),
    ],
)
def test_travel_may_be_given_in_inches_and_is_written_in_mm(call, tmp_path, text, ends):
    travel = ("--travel", f"X={text}", "--travel", "Y=0..400", "--travel", "Z=0..500")
    if "," in text:  # commas separate axes: the machine would get another travel
        assert call("init", "mill", "--chain", "WXYFZT", *travel, "--out", tmp_path)[0] == 2
        return
    code, _, stderr = call("init", "mill", "--chain", "WXYFZT", *travel, "--out", tmp_path)
    assert (code, stderr) == (0, "")
    assert tomllib.loads((tmp_path / "mill.toml").read_text())["axes"]["X"]["range_mm"] == pytest.approx(ends, abs=1e-9)


@pytest.mark.parametrize("text", ["24", "0..24furlong", "1..2..3in", "in", "0in..x"])
def test_a_travel_that_is_not_understood_is_refused(call, tmp_path, text):
    travel = ("--travel", f"X={text}", "--travel", "Y=0..400", "--travel", "Z=0..500")
    code, _, stderr = call("init", "mill", "--chain", "WXYFZT", *travel, "--out", tmp_path)
    assert code == 2 and "LOW..HIGH" in stderr
    assert list(tmp_path.iterdir()) == []


def test_a_travel_that_may_be_in_inches_is_asked_about(call, tmp_path):
    travel = ("--travel", "X=0..23.6", "--travel", "Y=0..400", "--travel", "Z=0..500")
    code, _, stderr = call("init", "mill", "--chain", "WXYFZT", *travel, "--out", tmp_path)
    assert code == 0
    assert "[axes.X]" in stderr and "23.6 in are 599.44 mm" in stderr and "[axes.Y]" not in stderr


def test_the_help_of_run_groups_its_options_and_names_every_kind_of_file(call):
    text = call("run", "--help")[1]
    headings = ["Needed:", "Identification:", "Tables on the control:", "Verdict and output:", "Other options:"]
    assert all(f"\n{heading}" in text for heading in headings)
    assert "\nOptions:" not in text
    for kind in ("lengths", "axis", "errors", "circle", "artefact", "part", "deviations", "sixdof"):
        assert f"*.{kind}.csv" in text
    other = text.partition("\nOther options:")[2]
    assert other.count("  --") <= 4  # new options belong to a group


@pytest.mark.parametrize("control", ["grbl", "grblHAL", "FluidNC"])
def test_a_control_without_tables_leads_to_the_correction_of_programs(call, tmp_path, control):
    """The machine file is written, without a section of the control; other commands say what to use instead."""
    mill = (
        "--chain",
        "WXYFZT",
        "--travel",
        "X=0..600",
        "--travel",
        "Y=0..400",
        "--travel",
        "Z=0..500",
        "--out",
        tmp_path,
    )
    code, out, error = call("init", "my-mill", *mill, "--control", control)
    assert (code, f"{control} has no compensation tables" in out) == (0, True)
    assert "volcomp correct MACHINE PROGRAM --errors ERRORS --dialect grbl" in " ".join(out.split())
    assert "[controllers" not in (tmp_path / "my-mill.toml").read_text()
    code, _, error = call("controllers", control)
    assert (code, "volcomp correct" in " ".join(error.split())) == (2, True)
