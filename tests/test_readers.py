"""Readers of every kind are public, and records are tables: the columns of their files, also for pandas and xarray."""

import ast
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import compgen
from compgen import readers
from compgen.data.csv_files import read_csv

FILES = {
    "axis": ("read_axis_runs", "axis,position_mm,direction,run,deviation_um\nX,0,1,1,0.5\nX,-100,-1,1,-2.25\n"),
    "circle": (
        "read_circles",
        "plane,angle_deg,radius_mm,deviation_um,direction,run\nXY,0,100,1.5,1,1\nXY,90,100,-2.5,1,1\nXY,180,100,0.5,1,1\n",
    ),
    "deviations": ("read_deviations", "x_mm,y_mm,z_mm,dx_um,dz_um\n0,0,0,1.5,-1\n10,20,30,2.5,4\n"),
    "lengths": ("read_lengths", "station,point,x_mm,y_mm,z_mm,length_mm\nLT1,P1,0,0,0,100.5\nLT2,P1,0,0,0,101.25\n"),
    "artefact": (
        "read_artefact",
        "# calibrated = false\nfeature,x_mm,y_mm,z_mm,mx_mm,my_mm,mz_mm,setup\n"
        "A,0,0,0,1,2,3,1\nB,100,0,0,101,2,3,1\nC,0,50,0,1,52,3,1\n",
    ),
    "errors": ("read_errors", "error,position_mm,value,u_value\nEXX,-100,3.25,0.5\nEXX,0,0,0.5\nEC0Y,,30,1\n"),
}


@pytest.fixture
def read(tmp_path):
    def make(kind):
        name, text = FILES[kind]
        path = tmp_path / f"a.{kind}.csv"
        path.write_text(text)
        return path, getattr(readers, name)(path)

    return make


@pytest.mark.parametrize("name", readers.__all__)
def test_each_name_of_readers_is_found_in_the_package_as_well(name):
    assert getattr(compgen, name) is getattr(readers, name)
    assert name in compgen.__all__ or name not in dir(compgen)


@pytest.mark.parametrize("kind", FILES)
def test_a_record_has_the_columns_of_its_file_with_their_numbers(kind, read):
    path, record = read(kind)
    columns, table = record.to_columns(), read_csv(path, (), (), ("*",))
    assert set(table.columns) - {"feature", "setup", "run", "direction"} <= set(columns)
    for name, cells in table.columns.items():
        if name.endswith(("_mm", "_um", "_deg")) or name in ("value", "u_value"):
            expected = [float(cell) if cell else np.nan for cell in cells]
            assert np.allclose(np.asarray(columns[name], float), expected, rtol=1e-12, atol=1e-12, equal_nan=True), name
        elif name in ("axis", "station", "plane", "error"):
            assert list(columns[name]) == list(cells)


def test_numbers_are_not_rounded_as_in_a_file(read):
    _, record = read("deviations")
    moved = compgen.Deviations(record.position_mm, record.deviation_mm + 1e-12)
    assert moved.to_columns()["dx_um"][0] == pytest.approx(1.500000001, abs=1e-12)


class Frame(dict):
    def __init__(self, columns):
        super().__init__(columns)
        self.attrs = {}


class Dataset(SimpleNamespace):
    def __init__(self, variables, coords, attrs):
        super().__init__(variables=variables, coords=coords, attrs=attrs)


@pytest.fixture
def stand_ins(monkeypatch):
    """Packages that keep what they are given: the real ones are no dependency."""
    for name, kind in (("pandas", {"DataFrame": Frame}), ("xarray", {"Dataset": Dataset})):
        module = ModuleType(name)
        vars(module).update(kind)
        monkeypatch.setitem(sys.modules, name, module)


def test_a_dataframe_has_the_columns_and_the_comments(read, stand_ins):
    _, record = read("artefact")
    frame = record.to_dataframe()
    assert list(frame["feature"]) == ["A", "B", "C"]
    assert frame.attrs["calibrated"] == "false"


def test_errors_as_a_dataset_share_the_positions_of_an_axis_where_they_are_the_same(stand_ins):
    at, none = np.array([0.0, 100.0]), np.zeros(2)
    curves = {
        "EXX": compgen.Curve(at, np.array([0.0, 5e-3]), none),
        "ECX": compgen.Curve(at, np.array([0.0, 7e-6]), none),
        "EYX": compgen.Curve(at + 1.0, np.array([0.0, 2e-3]), none),
    }
    made = compgen.ErrorTable(curves, {"EC0Y": (30e-6, 1e-6)}).to_xarray()
    assert {name: item[0] for name, item in made.variables.items()} == {
        "EXX": "x_mm", "u_EXX": "x_mm", "ECX": "x_mm", "u_ECX": "x_mm", "EYX": "EYX_mm", "u_EYX": "EYX_mm",
        "EC0Y": (), "u_EC0Y": (),
    }  # fmt: skip
    assert made.variables["EXX"][1].tolist() == pytest.approx([0.0, 5.0])
    assert made.variables["ECX"][1].tolist() == pytest.approx([0.0, 7.0])
    assert made.variables["EC0Y"][1] == pytest.approx(30.0)
    assert (made.variables["EXX"][2]["units"], made.variables["ECX"][2]["units"]) == ("um", "urad")
    assert made.coords["EYX_mm"].tolist() == [1.0, 101.0]


def test_the_volume_as_a_dataset_is_a_grid_with_each_value_at_its_place(stand_ins):
    places = np.array([(x, y, z) for z in (0.0, 1.0) for x in (5.0, -5.0) for y in (2.0, 3.0, 4.0)])
    fake = SimpleNamespace(
        position_mm=places, error_before_mm=1e-3 * places, error_after_mm=0 * places, machine="m", controller="c"
    )
    fake.to_columns = lambda: compgen.Verification.to_columns(fake)
    made = compgen.Verification.to_xarray(fake)
    assert made.coords["x_mm"].tolist() == [-5.0, 5.0]
    dimensions, values, _ = made.variables["before_y_um"]
    assert dimensions == ("x_mm", "y_mm", "z_mm")
    assert values.shape == (2, 3, 2)
    assert values[1, 2, 0] == pytest.approx(4.0)
    assert made.variables["before_x_um"][1][0, 0, 1] == pytest.approx(-5.0)
    fake.position_mm = places[:-1]  # one corner is missing: no grid
    fake.error_before_mm, fake.error_after_mm = fake.error_before_mm[:-1], fake.error_after_mm[:-1]
    made = compgen.Verification.to_xarray(fake)
    assert made.variables["before_x_um"][0] == ("point",)
    assert made.coords["x_mm"][1].tolist() == places[:-1, 0].tolist()


def test_a_missing_package_is_named_with_what_installs_it(read, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    _, record = read("axis")
    with pytest.raises(ImportError, match="pip install pandas"):
        record.to_dataframe()


def test_the_notebook_of_the_documentation_runs_from_top_to_bottom(monkeypatch):
    """Its code cells in one namespace, in the folder of the repository, as a reader runs them; without a notebook program."""
    root = Path(__file__).resolve().parents[1]
    monkeypatch.chdir(root)
    notebook = json.loads((root / "docs" / "notebook.ipynb").read_text("utf-8"))
    assert notebook["nbformat"] == 4
    found = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []  # what it shows is not committed
            *before, last = ast.parse("".join(cell["source"])).body
            exec(compile(ast.Module(before, []), "notebook.ipynb", "exec"), found)
            if isinstance(last, ast.Expr):
                found["shown"] = eval(compile(ast.Expression(last.value), "notebook.ipynb", "eval"), found)
            else:
                exec(compile(ast.Module([last], []), "notebook.ipynb", "exec"), found)
            if cell["source"][-1].startswith("max("):
                assert found["shown"] in found["result"].errors.curves
    assert found["verification"].accepted
    assert found["shown"].squareness["EC0Y"][0] == pytest.approx(25e-6)
