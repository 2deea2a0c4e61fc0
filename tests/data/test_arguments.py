"""What the Python interface refuses: an InputError with the name of the argument, never a result of nonsense."""

import re
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.errors import InputError

AXIS = compgen.Axis((-300.0, 0.0), np.linspace(-300.0, 0.0, 4))
MACHINE = compgen.Machine("mill", compgen.Chain("WFYXZT"), (AXIS, AXIS, AXIS))
CURVE = compgen.Curve(np.array([-300.0, 0.0]), np.array([1e-3, 0.0]), np.zeros(2))
ERRORS = compgen.ErrorTable({"EXX": CURVE}, {"EC0Y": (1e-5, 1e-6)})
THREE = np.arange(3.0)
POINTS = np.zeros((3, 3))

LENGTHS = compgen.Lengths(("A",), np.zeros(3, int), ("1", "2", "3"), POINTS, THREE)

#: Public names with good arguments; each argument is replaced by what follows.
CALLS = {
    "Axis": {"range_mm": (-300.0, 0.0), "nodes_mm": np.linspace(-300.0, 0.0, 4)},
    "Chain": {"name": "WFYXZT"},
    "Machine": {"name": "mill", "chain": MACHINE.chain, "axes": MACHINE.axes, "reference_point_mm": (0.0, 0.0, 0.0)},
    "Curve": {"position_mm": THREE, "value": THREE, "u": THREE},
    "ErrorTable": {"curves": {"EXX": CURVE}, "squareness": {"EC0Y": (0.0, 0.0)}},
    "ReversalCurves": {"curves": {(0, 0): CURVE}},
    "Deviations": {"position_mm": POINTS, "deviation_mm": POINTS, "u_mm": POINTS + 1, "tool_mm": POINTS, "approach": POINTS,
                   "labels": {"run": np.zeros(3, int)}, "covariates": {"time_s": THREE}},
    "Lengths": {"stations": ("A",), "station": np.zeros(3, int), "point": ("1", "2", "3"), "position_mm": POINTS,
                "length_mm": THREE, "tool_mm": POINTS, "approach": POINTS, "labels": {"run": np.zeros(3, int)},
                "covariates": {"time_s": THREE}},
    "Points": {"position_mm": POINTS, "tool_mm": POINTS, "approach": POINTS},
    "FitOptions": {"smoothness": 1.0, "max_abs": {"EXX": 1.0}},
    "IdentifyOptions": {"u_length_um": 0.1, "u_deviation_um": 1.0, "method": "joint", "nodes": "machine"},
    "c_matrix": {"machine": MACHINE, "position_mm": POINTS, "tool_mm": POINTS},
    "observable_errors": {"machine": MACHINE, "tools_mm": POINTS},
    "volumetric_error": {"machine": MACHINE, "errors": ERRORS, "position_mm": POINTS, "tool_mm": POINTS},
    "exact_error": {"machine": MACHINE, "errors": ERRORS, "position_mm": POINTS, "tool_mm": POINTS},
    "predict": {"machine": MACHINE, "errors": ERRORS, "points": compgen.Points(POINTS)},
    "without_rigid_motion": {"position_mm": np.eye(3), "error_mm": POINTS},
    "fit": {"machine": MACHINE, "errors": ERRORS, "options": compgen.FitOptions()},
    "identify": {"machine": MACHINE, "lengths": LENGTHS, "options": None},
    "export": {"machine": MACHINE, "errors": ERRORS, "controller": "isg-csv"},
    "read_tables": {"machine": MACHINE, "paths": [], "controller": "isg-csv"},
    "verify": {"machine": MACHINE, "tables": object.__new__(compgen.ReadTables), "errors": ERRORS},
    "format_errors": {"errors": ERRORS},
    "plan": {"machine": MACHINE, "stations": compgen.planned_stations({}), "points": compgen.Points(POINTS)},
    "planned_stations": {"positions": {"A": (0.0, 0.0, 0.0)}},
    "simulate": {"machine": MACHINE, "scenario": None},
    "write_simulation": {"simulation": None},
    "run": {"machine": MACHINE, "measurements": [], "controllers": ["isg-csv"], "folder": "o"},
    "load_machine": {"machine": "mill"},
    "load_plugins": {"paths": []},
    **{name: {"path": "x"} for name in ("read_errors", "read_points", "read_reversal", "read_scenario")},
    **{name: {"files": "x"} for name in ("read_lengths", "read_deviations")},
}  # fmt: skip
#: Nothing takes these.
NONSENSE = {
    "complex": 1j * np.ones((3, 3)), "masked": np.ma.masked_array(np.ones((3, 3)), np.eye(3)), "an object": object(),
    "ragged": [[1.0, 2.0], [3.0]], "objects": np.array([1.0, None], dtype=object), "truth": np.ones(3, dtype=bool),
}  # fmt: skip


def named(argument):
    return pytest.raises(InputError, match=re.escape(argument))


@pytest.mark.parametrize("what", NONSENSE)
@pytest.mark.parametrize(("name", "argument"), [(name, key) for name, given in CALLS.items() for key in given])
def test_nonsense_is_refused_with_the_name_of_the_argument(name, argument, what, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given = {**CALLS[name], argument: NONSENSE[what]}
    if name == "write_simulation":
        given["folder"] = tmp_path
    with named(argument):
        getattr(compgen, name)(**given)
    assert not list(tmp_path.iterdir())


def test_every_public_function_and_constructor_is_tried():
    results = {
        "Export",
        "FitResult",
        "Identification",
        "Plan",
        "ReadTables",
        "RunResult",
        "Verification",
        "CONTROLLERS",
    }
    wrong = {name for name in compgen.__all__ if name.endswith(("Error", "Warning"))}
    assert set(CALLS) == set(compgen.__all__) - results - wrong


@pytest.mark.parametrize(
    ("argument", "value", "says"),
    [
        ("u", [-1.0, 0.0, 0.0], "u: contains -1; expected numbers of at least 0"),
        ("u", [0.0, np.inf, 0.0], "u: contains inf"),
        ("value", [0.0, np.nan, 0.0], "value: contains nan, which is not finite"),
        ("value", np.zeros((3, 1)), "value: has the shape (3, 1); expected (n,)"),
        ("position_mm", ["a", "b", "c"], "position_mm: contains text"),
    ],
)
def test_a_curve_has_finite_values_and_possible_uncertainties(argument, value, says):
    with named(says):
        compgen.Curve(**{"position_mm": THREE, "value": THREE, "u": THREE, argument: value})
    assert np.isnan(compgen.Curve(THREE, THREE, np.full(3, np.nan)).u).all()  # unknown
    assert compgen.Curve([0, 1], [0, 1], [0, 1]).at(np.array([0.5])).tolist() == [0.5]


@pytest.mark.parametrize("argument", ["deviation_mm", "u_mm", "tool_mm", "approach"])
def test_the_rows_of_deviations_belong_together(argument):
    with named(f"{argument}: has the shape (2, 3)"):
        compgen.Deviations(**{"position_mm": POINTS, "deviation_mm": POINTS, argument: np.ones((2, 3))})
    with named("labels[run]: has the shape (2,)"):
        compgen.Deviations(POINTS, POINTS, labels={"run": np.zeros(2, int)})


def test_one_tool_for_each_point_or_one_for_all():
    for function in (compgen.volumetric_error, compgen.exact_error):
        assert function(MACHINE, ERRORS, POINTS, np.ones((1, 3))).shape == (3, 3)
        with named("tool_mm: has the shape (2, 3)"):
            function(MACHINE, ERRORS, POINTS, np.ones((2, 3)))
    with named("tool_mm"):
        compgen.c_matrix(MACHINE, POINTS, np.ones((2, 3)))


@pytest.mark.parametrize("path", ["machines/zha-gantry.toml", Path("zha-gantry.toml")])
def test_a_path_in_place_of_a_machine_says_what_reads_it(path):
    says = "machine: expected Machine, got .*zha-gantry.toml'; compgen.load_machine\\(...\\) reads one from a file"
    for call in (compgen.volumetric_error, compgen.exact_error, compgen.fit, compgen.identify, compgen.simulate):
        with pytest.raises(InputError, match=says):
            call(path, *([ERRORS, POINTS] if call in (compgen.volumetric_error, compgen.exact_error) else [ERRORS]))
    with pytest.raises(InputError, match="errors: expected ErrorTable, got .*compgen.read_errors"):
        compgen.fit(MACHINE, path)


def test_a_station_without_readings_is_named():
    r = compgen.read_lengths("examples/zha-gantry.lengths.csv")
    with named("station 'LT2' has only 0 reading(s)"):
        compgen.identify(compgen.load_machine("zha-gantry"), r.part(r.station != 1))
