"""What a program may load before it needs it: start-up is what a user waits for at every command."""

import json
import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.core import ParameterSource

from compgen.cli import Sketch, cli

ROOT = Path(__file__).resolve().parents[2]
#: Libraries that take long to load. The lists below name those that a program may have loaded when it ends.
HEAVY = {
    "alembic", "apscheduler", "cvxpy", "dask", "flask", "jinja2", "matplotlib", "numba", "numpy", "openpyxl", "osqp",
    "pandas", "rich", "scipy", "scipy.interpolate", "scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial",
    "scipy.special", "scipy.stats", "sqlalchemy", "xmlschema",
}  # fmt: skip
TABLES = {"numpy", "rich", "jinja2"}
REPORT = f"""
import atexit, json, sys
heavy = {sorted(HEAVY)}
def say():
    loaded = [name for name in heavy if name in sys.modules]
    commands = [name.rpartition(".")[2] for name in sys.modules if name.startswith("compgen.cli.") and "_commands" in name]
    with open("loaded.json", "w") as file:
        json.dump([loaded, commands], file)
atexit.register(say)
"""
PROGRAM = "sys.argv = ['volcomp', *{}]\nfrom compgen.__main__ import main\nmain()"


def loaded(tmp_path, code, **environment):
    """Heavy libraries, and modules of commands, that a fresh process has loaded when it ends."""
    variables = {name: value for name, value in os.environ.items() if name not in ("COVERAGE_PROCESS_START",)}
    done = subprocess.run(
        [sys.executable, "-c", REPORT + code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        env={**variables, "COMPGEN_KERNELS": "plain", **environment},
    )
    assert done.returncode == 0, done.stderr
    libraries, commands = json.loads((tmp_path / "loaded.json").read_text())
    return set(libraries), set(commands), done.stdout


def test_import_compgen_loads_nothing(tmp_path):
    assert loaded(tmp_path, "import compgen")[:2] == (set(), set())


@pytest.mark.parametrize("words", [["--help"], ["--version"]])
def test_the_main_help_loads_neither_numpy_nor_any_command(tmp_path, words):
    libraries, commands, output = loaded(tmp_path, PROGRAM.format(words))
    assert (libraries, commands) == (set(), set())
    assert "crash-test" in output or "version" in output


def completed(tmp_path, line):
    variables = {"_VOLCOMP_COMPLETE": "bash_complete", "COMP_WORDS": line, "COMP_CWORD": str(line.count(" "))}
    return loaded(tmp_path, PROGRAM.format([]), XDG_CACHE_HOME=str(tmp_path / "cache"), **variables)


def test_completion_of_a_command_loads_no_command(tmp_path):
    libraries, commands, output = completed(tmp_path, "volcomp di")
    assert output.split() == ["plain,diagnose", "plain,diff"]
    assert (libraries, commands) == (set(), set())


def test_completion_of_an_option_knows_the_options_and_loads_that_command_alone(tmp_path):
    libraries, commands, output = completed(tmp_path, "volcomp fit --max")
    assert output.split() == ["plain,--max-abs", "plain,--max-slope", "plain,--max-curvature"]
    assert commands == {"identify_commands"}
    assert libraries <= TABLES


def test_a_second_completion_of_an_option_loads_no_command_unless_the_program_has_changed(tmp_path):
    first = completed(tmp_path, "volcomp fit --max")
    assert completed(tmp_path, "volcomp fit --max") == (set(), set(), first[2])
    # a value belongs to the command, which must then be loaded
    assert completed(tmp_path, "volcomp fit --smoothness ")[1] == {"identify_commands"}
    (note,) = (tmp_path / "cache" / "compgen" / "completion").glob("fit-*.json")
    content = json.loads(note.read_text())
    assert any(path.endswith("fitting/bounds.py") for path, *_ in content["files"])
    content["parameters"] = [item for item in content["parameters"] if "--max-abs" not in item["words"]]
    note.write_text(json.dumps(content))
    assert "--max-abs" not in completed(tmp_path, "volcomp fit --max")[2]  # the note is used
    content["files"][-1][1] -= 1  # as if this file had been written since
    note.write_text(json.dumps(content))
    assert completed(tmp_path, "volcomp fit --max") == first
    for damaged in ("", "[]", '{"files": [["gone.py", 1, 2]], "parameters": []}'):
        note.write_text(damaged)
        assert completed(tmp_path, "volcomp fit --max") == first


@pytest.mark.parametrize("name", [name for name, command in cli.commands.items() if name != "recal"])
def test_the_note_of_a_command_has_its_options_and_their_help(tmp_path, monkeypatch, name):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    command = cli.commands[name]
    Sketch.note(command)
    sketch = Sketch.of(command)
    if isinstance(command.loaded, click.Group):
        assert sketch is None
        return
    found = []
    for one in (sketch, command.loaded):
        context = click.Context(one, info_name=name, resilient_parsing=True)
        found.append([(item.value, item.help) for item in one.shell_complete(context, "--")])
        given = one.make_context(name, ["a", "b", "--json", "--out", "c"], resilient_parsing=True)
        found[-1].append(
            sorted(k for k in given.params if given.get_parameter_source(k) == ParameterSource.COMMANDLINE)
        )
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("words", "module", "allowed"),
    [
        (["machines", "--json"], "listing_commands", TABLES),
        (["controllers", "--json"], "listing_commands", TABLES),
        (["recal", "--help"], "fleet_commands", {"rich"}),
        (["recal", "run", "--help"], "fleet_commands", {"rich"}),
        (["recal", "add", "--help"], "fleet_commands", {"rich"}),
        (["serve", "--help"], "fleet_commands", {"rich"}),
        (["identify", "zha-gantry", "L", "--out", "o"], "identify_commands", {"numpy", "rich"}),
        (["fit", "zha-gantry", "E", "--out", "o"], "identify_commands", {"numpy", "rich"}),
        (["predict", "zha-gantry", "E", "--points", "P", "--out", "o"], "plan_commands", TABLES),
        (
            ["correct", "zha-gantry", "N", "--errors", "E", "--wcs", "G54=-400,-500,-200", "--out", "o"],
            "program_commands",
            {"numpy", "rich"},
        ),
        (
            ["export", "zha-gantry", "E", "--controller", "isg-csv", "--out", "o"],
            "table_commands",
            TABLES,
        ),
    ],
)
def test_a_command_loads_its_own_module_and_no_library_that_it_does_not_need(tmp_path, words, module, allowed):
    (tmp_path / "p.points.csv").write_text("x_mm,y_mm,z_mm\n-400,100,-200\n")
    (tmp_path / "n.ngc").write_text("G21 G90 G17 G54\nG0 X0 Y0 Z0\nG1 X50 F100\nM2\n")
    examples = ROOT / "examples"
    files = {
        "N": str(tmp_path / "n.ngc"),
        "L": str(examples / "zha-gantry.lengths.csv"),
        "E": str(examples / "zha-gantry.truth.errors.csv"),
        "P": str(tmp_path / "p.points.csv"),
    }
    libraries, commands, _ = loaded(tmp_path, PROGRAM.format([files.get(word, word) for word in words]))
    assert commands == {module}
    assert libraries <= allowed


EXTRAS = ("alembic", "apscheduler", "argon2", "flask", "sqlalchemy", "structlog", "waitress")
WITHOUT = f"import sys\nsys.modules.update(dict.fromkeys({EXTRAS}))\n"


@pytest.mark.parametrize("words", [["recal", "--help"], ["recal", "recheck", "--help"], ["serve", "--help"]])
def test_the_help_needs_none_of_the_extras(tmp_path, words):
    assert "Options:" in loaded(tmp_path, WITHOUT + PROGRAM.format(words))[2]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["recal", "status"],
            "volcomp recal needs SQLAlchemy, alembic, APScheduler, structlog; install compgen[recal]",
        ),
        (["serve", "--store", "s"], "is not installed; the dashboard needs: pip install 'compgen[serve]'"),
        (
            ["serve", "users", "--store", "s"],
            "argon2 is not installed; the dashboard needs: pip install 'compgen[serve]'",
        ),
    ],
)
def test_without_the_extras_a_command_says_what_to_install(tmp_path, words, said):
    code = WITHOUT + PROGRAM.format(words)
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2
    assert said in " ".join(done.stderr.split())


def test_a_run_loads_the_control_in_use_and_no_room_that_it_does_not_need(tmp_path):
    lengths = ROOT / "examples" / "zha-gantry.lengths.csv"
    words = ["run", "zha-gantry", str(lengths), "--controller", "isg-csv", "--out", "o", "--no-report"]
    listed = "import atexit, sys\natexit.register(lambda: open('modules.txt', 'w').write(' '.join(sys.modules)))\n"
    loaded(tmp_path, listed + PROGRAM.format(words))
    modules = {name.removeprefix("compgen.") for name in (tmp_path / "modules.txt").read_text().split()}
    controls = {name for name in modules if name.startswith("controls.") and not name.startswith("controls.shared")}
    assert controls == {"controls.isg_kernel"}
    rooms = {name.partition(".")[0] for name in modules}
    assert not rooms & {"simulation", "planning", "diagnose", "fleet", "accuracy", "plugins"}
    assert not {name for name in modules if name.startswith("scipy.")} - {"scipy.linalg._flapack"}
    assert "importlib.metadata" not in modules
    assert not modules & {
        "effects.all_effects",
        "foreign.detect",
        "identification.positions",
        "identification.six_dof",
        "tables.active",
    }


def test_pages_are_drawn_without_a_plotting_library(tmp_path):
    lengths = ROOT / "examples" / "zha-gantry.lengths.csv"
    words = ["run", "zha-gantry", str(lengths), "--controller", "isg-csv", "--out", "o"]
    libraries, _, _ = loaded(tmp_path, PROGRAM.format(words))
    assert (tmp_path / "o" / "report.html").is_file()
    assert "matplotlib" not in libraries
    users = [path.name for path in (ROOT / "compgen").rglob("*.py") if "import matplotlib" in path.read_text("utf-8")]
    assert users == ["display.py"]  # .plot() in notebooks
