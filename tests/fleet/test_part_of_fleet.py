"""Which machine of a factory makes a part best: errors and active tables from the store of `recal`."""

import json
import shutil

import numpy as np
import pytest
from test_recal import CONTROL, deviations_text

from compgen.fleet.job import read_job
from compgen.fleet.runner import run_jobs
from compgen.kinematics import exact_error

PART = """G21 G90 G17 G54
G0 X-40 Y-30 Z20
F100
G81 X-40 Y-30 Z-5 R2
X40
Y30
X-40
G80
G0 Z20
M2
"""


@pytest.fixture(scope="module")
def factory(tmp_path_factory, small_machine, small_machine_file, small_errors):
    """mill-a is measured and its tables are active, mill-b is measured and its tables wait, mill-c is new."""
    folder = tmp_path_factory.mktemp("factory")
    shutil.copy(small_machine_file, folder / "mill.toml")
    text = "".join(
        f'[machines.mill-{k}]\nmachine = "mill.toml"\ninbox = "in-{k}"\ncontrollers = ["{CONTROL}"]\nout = "out-{k}"\n'
        f'measured_with = "bare"\napproval = "{"auto" if k == "a" else "manual"}"\n'
        for k in "abc"
    )
    (folder / "recal.toml").write_text(text)
    (folder / "p.ngc").write_text(PART)
    half = small_errors.with_values(0.5 * small_errors.values())
    for k, errors in (("a", small_errors), ("b", half)):
        (folder / f"in-{k}").mkdir()
        made = deviations_text(small_machine, errors, seed=1)
        (folder / f"in-{k}" / "x.deviations.csv").write_text(made)
    (folder / "in-c").mkdir()
    assert run_jobs(read_job(folder / "recal.toml")).exit_code == 0
    return folder


def test_machines_are_ranked_with_their_errors_and_active_tables(factory, call, small_machine, small_errors):
    words = ["part", "mill-b", factory / "p.ngc", "--fleet", factory / "recal.toml", "--wcs", "G54=0,50,-120"]
    code, out, _ = call(*words, "--json", "--out", factory / "part")
    found = json.loads(out)
    assert code == 0
    # mill-a has twice the errors of mill-b, but its tables are on
    assert [item["machine"] for item in found["machines"]] == ["mill-a", "mill-b"]
    first, second = found["machines"]
    assert first["best_fit"]["max_um"] < 0.5 * second["best_fit"]["max_um"]
    assert first["normal_max_um"] < 2.0 < 5.0 < second["normal_max_um"]
    assert found["machine"] == "mill-b"
    assert found["path_after"] is None
    # mill-b as its true errors say
    half = small_errors.with_values(0.5 * small_errors.values())
    nominal = np.array([[-40.0, -30.0, -5.0], [40.0, -30.0, -5.0], [40.0, 30.0, -5.0]]) + (0.0, 50.0, -120.0)
    off = exact_error(small_machine, half, nominal)
    features = {(item["name"], item["quantity"]): item["error_um"] for item in found["features"]}
    assert features["hole 1 to 2", "distance"] == pytest.approx(1e3 * (off[1, 0] - off[0, 0]), abs=1.0)
    assert features["hole 2 to 3", "distance"] == pytest.approx(1e3 * (off[2, 1] - off[1, 1]), abs=1.0)
    page = (factory / "part" / "part.html").read_text()
    assert "Which machine makes this part best" in page
    code, out, _ = call(*words)
    assert code == 0
    assert "no identified errors in the store: mill-c" in out


@pytest.mark.parametrize(
    ("name", "more", "message"),
    [
        ("mill-c", [], "mill-c has no identified errors in the store"),
        ("mill-x", [], "mill-x"),
        ("mill-a", ["--also", "m=e"], "leave out --errors"),
    ],
)
def test_what_a_fleet_cannot_answer(factory, call, name, more, message):
    words = ["part", name, factory / "p.ngc", "--fleet", factory / "recal.toml", "--wcs", "G54=0,50,-120"]
    code, _, error = call(*words, *more)
    assert code == 2
    assert message in error
