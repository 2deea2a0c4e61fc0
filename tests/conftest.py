"""Fixtures that several files share: a small machine with settings for every control, and the shipped example."""

import os
import shutil
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import compgen
from compgen.data.names import error_named
from compgen.kinematics import modelled_errors

ROOT = Path(__file__).resolve().parents[1]

#: Folder in memory, and what has to be free there for the temporary files of all tests, several times over.
MEMORY, ENOUGH_BYTES = Path("/dev/shm"), 4_000_000_000


def pytest_configure(config):
    """Put temporary folders into memory: a store or a published table waits for the disk with every file it writes."""
    if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > ENOUGH_BYTES:
        os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))
    # Containers often forbid bytecode files; the programs that tests start would then compile all of their sources each time.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    os.environ["COMPGEN_CONFIG"] = ""  # the tests do not depend on the user's own defaults
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        # A shell gives what it starts in the background an ignored Ctrl-C, and programs that the tests start and
        # interrupt would inherit that: they would never end.
        signal.signal(signal.SIGINT, signal.default_int_handler)


#: Files that take longest, in the order in which the processes of a run take them: at the end none waits for another.
#: LinuxCNC keeps its own time and leaves the processors to the others.
LONGEST = (
    "tests/controls/test_linuxcnc_real.py",
    "tests/fleet/test_recal_cluster.py",
    "tests/fleet/test_recal_factory.py",
    "tests/fleet/test_recal_faults.py",
    "tests/tables/test_crash.py",
    "tests/app/test_app.py",
    "tests/app/test_app_browser.py",
    "tests/fleet/test_recal_commands.py",
    "tests/tables/test_best_tables.py",
    "tests/controls/test_all_controllers.py",
    "tests/diagnose/test_diagnose_circles.py",
    "tests/tables/test_entries.py",
    "tests/diagnose/test_diagnose_axis.py",
    "tests/identification/test_robust.py",
    "tests/fleet/test_recal.py",
    "tests/identification/test_grid.py",
    "tests/tables/test_verdict.py",
    "tests/identification/test_archive.py",
    "tests/test_papers.py",
    "tests/tables/test_options.py",
    "tests/diagnose/test_diagnosis_forms.py",
    "tests/fleet/test_recal_active.py",
)


def pytest_collection_modifyitems(items):
    """Put the longest files first; the others keep their order."""
    place = {name: number for number, name in enumerate(LONGEST)}
    assert all((ROOT / name).is_file() for name in LONGEST)
    items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0], len(LONGEST)))


#: Ranges, node counts and reference point differ between the axes; the reference lies inside the travel.
SMALL_MACHINE = """\
name = "small-gantry"
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
[controllers.mitsubishi]
mode = "incremental"
[controllers.siemens-cec]
sign = "error"
mult_mode = "S1"
[controllers.pmac]
counts_per_mm = { X = 1000.0, Y = 2000.0, Z = -1500.0 }
[controllers.ucnc]
build = "xy-only"
[controllers.ecmc]
version = "11.0.8"
[controllers.centroid]
sign = "correction"
values = "mm"

[controllers.weihong]
sign = "error"
[controllers.mach4]
sign = "correction"
[controllers.fagor-8055]
sign = "error"
"""

SMALL_SCENARIO = """\
name = "small"
seed = 11
[errors]
[instrument]
type = "laser-tracer"
noise_um = 0.1
noise_um_per_m = 0.15
[[instrument.stations]]
name = "S1"
position_mm = [-420.0, -210.0, -420.0]
dead_length_mm = 151.25
[[instrument.stations]]
name = "S2"
position_mm = [330.0, -190.0, -405.0]
dead_length_mm = 152.25
[[instrument.stations]]
name = "S3"
position_mm = [310.0, 410.0, -415.0]
dead_length_mm = 153.25
[[instrument.stations]]
name = "S4"
position_mm = [-400.0, 430.0, -90.0]
dead_length_mm = 154.25
[trajectory]
type = "grid"
"""


def smooth_errors(machine, seed=5, squareness_rad=(45e-6, -30e-6, 25e-6)):
    """The machine's modelled errors as a fit leaves them: straightness zero at the ends, the rest at the reference."""
    generator = np.random.default_rng(seed)
    curves, constants = {}, {}
    for name in modelled_errors(machine):
        error = error_named(name)
        if error.kind == "squareness":
            constants[name] = (squareness_rad[len(constants)], 1e-6)
            continue
        nodes = machine.axes[error.axis].nodes_mm
        share = (nodes - nodes[0]) / (nodes[-1] - nodes[0])
        value = sum(generator.normal() * np.sin((k + 1) * (share * 3 + generator.uniform(0, 3))) for k in range(2))
        if error.is_straightness:
            value = value - value[0] - share * (value[-1] - value[0])
        else:
            value = value - np.interp(machine.reference_point_mm[error.axis], nodes, value)
        value = value * (12e-3 if error.kind == "linear" else 25e-6) / np.max(np.abs(value))
        curves[name] = compgen.Curve(nodes, value, np.full(len(nodes), 1e-4 if error.kind == "linear" else 1e-7))
    return compgen.ErrorTable(curves, constants, {"machine": machine.name})


@pytest.fixture(scope="session")
def small_machine_file(tmp_path_factory):
    """Path of the small machine's TOML file."""
    path = tmp_path_factory.mktemp("machine") / "small-gantry.toml"
    path.write_text(SMALL_MACHINE)
    return path


@pytest.fixture(scope="session")
def small_machine(small_machine_file):
    return compgen.load_machine(small_machine_file)


@pytest.fixture(scope="session")
def small_errors(small_machine):
    return smooth_errors(small_machine)


@pytest.fixture(scope="session")
def make_errors():
    """The function that draws smooth errors for a machine."""
    return smooth_errors


@pytest.fixture(scope="session")
def small_lengths_file(small_machine, tmp_path_factory):
    """Simulated readings of four tracers on the small machine."""
    folder = tmp_path_factory.mktemp("lengths")
    scenario = folder / "scenario.toml"
    scenario.write_text(SMALL_SCENARIO)
    compgen.write_simulation(compgen.simulate(small_machine, compgen.read_scenario(scenario)), folder)
    return folder / "small.lengths.csv"


@pytest.fixture(scope="session")
def example():
    """The shipped example, identified and fitted once: machine, truth, identified, fitted."""
    machine = compgen.load_machine(ROOT / "machines" / "zha-gantry.toml")
    lengths = compgen.read_lengths(ROOT / "examples" / "zha-gantry.lengths.csv")
    identified = compgen.identify(machine, lengths)
    return SimpleNamespace(
        machine=machine,
        truth=compgen.read_errors(ROOT / "examples" / "zha-gantry.truth.errors.csv"),
        identified=identified,
        fitted=compgen.fit(machine, identified.errors),
    )


@pytest.fixture
def call(capsys):
    """Run the command line as the console script does: (exit code, stdout, stderr)."""
    from compgen.cli import cli
    from compgen.cli.common import run_command

    def run(*words):
        code = run_command(cli, [str(word) for word in words])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def listing():
    """A function that returns every path below a folder with its contents, hidden ones too."""

    def contents(folder):
        return {
            str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
            for path in sorted(Path(folder).rglob("*"))
        }

    return contents
