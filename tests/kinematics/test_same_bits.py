"""The same call gives the same bits, whatever the process did before, and the switch between compiled and plain kernels."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.errors import InputError
from compgen.kinematics import kernel_switch as kernels

EXAMPLES = Path(__file__).parents[2] / "examples"

#: Does what its arguments name, in their order, and prints the hash of every result, and whether numba was loaded.
JOBS = """
import hashlib, pathlib, sys, tempfile, warnings
import numpy as np, compgen
warnings.simplefilter("ignore")
examples = pathlib.Path(sys.argv[1])
machine = compgen.load_machine("zha-gantry")
file = examples / "zha-gantry.lengths.csv"
place = np.random.default_rng(0).uniform(machine.lower_mm, machine.upper_mm, (600_000, 3))

def identify():
    found = compgen.identify(machine, compgen.read_lengths(file))
    return [found.covariance, *(array for curve in found.errors.curves.values() for array in (curve.value, curve.u))]

def predict():
    errors, points = compgen.read_errors(examples / "zha-gantry.truth.errors.csv"), compgen.Points(place)
    return [compgen.predict(machine, errors, points), compgen.predict(machine, errors, points, exact=True)]

def run():
    with tempfile.TemporaryDirectory() as folder:
        compgen.run(machine, [file], ["siemens-cec"], folder + "/out")
        return [path.read_bytes() for path in sorted(pathlib.Path(folder).rglob("*")) if path.is_file()]

for name in sys.argv[2:]:
    parts = {"identify": identify, "predict": predict, "run": run}[name]()
    print(name, hashlib.sha256(b"".join(map(bytes, parts))).hexdigest())
print("numba", "numba" in sys.modules)
"""


def done(*names):
    """(job, hash) of the jobs, done one after another in a process of their own."""
    environment = {key: value for key, value in os.environ.items() if key != kernels.VARIABLE}
    command = [sys.executable, "-c", JOBS, str(EXAMPLES), *names]
    found = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert found.returncode == 0, found.stderr
    return [tuple(line.split()) for line in found.stdout.splitlines()]


def test_the_order_of_calls_does_not_change_a_bit():
    one = done("identify", "predict", "predict", "identify", "run", "run")
    other = done("run", "predict", "identify")
    assert len(one) == 7
    assert len(other) == 4
    assert sorted(set(one)) == sorted(other)
    assert one[-1] == ("numba", "False"), "compiled kernels were loaded for small data, which costs time"


@pytest.mark.parametrize("first", ["", "import scipy.linalg"])
def test_lapack_is_scipys_own_and_loads_nothing_else_of_it(first):
    code = f"""if True:
        import sys, numpy as np
        {first}
        from compgen.kinematics.kernel_switch import lapack
        found = lapack()
        alone = "scipy.linalg" not in sys.modules
        from scipy.linalg import cholesky, lapack as whole
        names = ("dpocon", "dpotrf", "dpotrs", "dtrtri", "dpbsv", "dpbtrs")
        assert all(getattr(found, name) is getattr(whole, name) for name in names)
        assert np.array_equal(cholesky([[4.0]]), [[2.0]])
        print(alone)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == (str(not first), "")


SMALL = compgen.load_machine("zha-gantry")
ERRORS = compgen.ErrorTable({}, {"EC0Y": (1e-3, 0.0)})
HERE = np.array([[0.0, -1000.0, 0.0]])


def test_the_size_decides_where_nothing_is_said(monkeypatch):
    pytest.importorskip("numba")
    for value in ("", "auto", "AUTO"):
        monkeypatch.setenv(kernels.VARIABLE, value)
        assert [kernels.use_compiled(size, 5) for size in (0, 4, 5, 4)] == [False, False, True, False]
    monkeypatch.delenv(kernels.VARIABLE)
    assert [kernels.use_compiled(size, 5) for size in (4, 5, 4)] == [False, True, False]


def test_the_switch_decides_for_every_size(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setenv(kernels.VARIABLE, "compiled")
    assert kernels.use_compiled(0, 5)
    monkeypatch.setenv(kernels.VARIABLE, "plain")
    assert not kernels.use_compiled(10, 5)


def test_another_value_is_refused(monkeypatch):
    monkeypatch.setenv(kernels.VARIABLE, "fast")
    with pytest.raises(InputError, match=r"COMPGEN_KERNELS is 'fast'; set it to auto, compiled or plain"):
        compgen.volumetric_error(SMALL, ERRORS, HERE)


def test_compiled_kernels_that_are_not_installed_are_not_replaced_in_silence(monkeypatch):
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.setenv(kernels.VARIABLE, "compiled")
    with pytest.raises(InputError, match=r"numba cannot be imported; install compgen\[fast\]"):
        compgen.volumetric_error(SMALL, ERRORS, HERE)
    monkeypatch.setenv(kernels.VARIABLE, "auto")
    assert not kernels.use_compiled(10, 5)
    assert compgen.volumetric_error(SMALL, ERRORS, HERE)[0, 0] == 1.0
