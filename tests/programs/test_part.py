"""What a machine leaves on a part: features against exact geometry, uncertainty against many drawn machines."""

import json
import re

import numpy as np
import pytest
from programs.make import mill

import compgen
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.files import json_text
from compgen.errors import InputError
from compgen.identify.covariance import covariance_or_independent
from compgen.kinematics import exact_error
from compgen.programs import Setup, model_of, part_page, predict_part

SETUP = Setup({"G54": (100.0, 100.0, -80.0)}, {"1": (0.0, 0.0, 20.0)}, gauge_mm=(0.0, 0.0, -50.0))
PART = """%
O1
G21 G90 G17 G40 G80 G54 T1 M6
G0 G43 H1 Z50.
G98 G81 X10. Y10. Z-5. R2. F90
X90.
Y90.
G80
G0 X20. Y20.
Z2.
G1 Z-3. F100
X80.
Y80.
X20.
Y20.
G0 Z5.
X65. Y50.
G1 Z-3.
G3 I-15. J0. F200
G0 Z50.
M30
%
"""


def predicted(tmp_path, errors, **more):
    program = tmp_path / "part<1>.nc"
    program.write_text(PART)
    found = predict_part(model_of(mill(), errors, None), program, "fanuc", SETUP, **more)
    return found, {(item.name, item.quantity): item for item in found.features}


def test_a_scale_and_a_squareness_by_hand(tmp_path):
    """X is 100 um/m too long, EC0Y = 30 urad opens the angle of +X and +Y: the corner at their origin by 30 urad."""
    ends = np.array([-600.0, 600.0])
    errors = ErrorTable({"EXX": Curve(ends, 100e-6 * ends, np.zeros(2))}, {"EC0Y": (30e-6, 0.0)})
    found, features = predicted(tmp_path, errors)
    assert features["hole 1 to 2", "distance"].error == pytest.approx(8.0, abs=1e-3)
    assert features["hole 2 to 3", "distance"].error == pytest.approx(0.0, abs=1e-3)
    assert features["circle 1", "diameter"].error == pytest.approx(30.0 * 0.1 / 2, abs=1e-3)  # the mean diameter
    corners = [item for (name, _), item in features.items() if name.startswith("corner")]
    assert [item.line for item in corners] == [13, 14, 15, 12]
    assert [item.error for item in corners] == pytest.approx([-30.0, 30.0, -30.0, 30.0], abs=0.02)
    widths = [item for (name, _), item in features.items() if name.startswith("sides")]
    assert {(item.nominal, round(item.error, 2)) for item in widths} == {(60.0, 6.0), (60.0, 0.0)}
    assert np.isnan(features["hole 1 to 2", "distance"].u)
    assert found.figures.length_mm == pytest.approx(3 * 7 + 5 + 4 * 60 + 8 + 30 * np.pi, abs=1e-6)


def test_features_are_those_of_points_on_the_exact_machine(tmp_path, make_errors):
    """Circle and sides fitted to points that the exact machine makes, by least squares."""
    errors = make_errors(mill(), 4)
    _, features = predicted(tmp_path, errors)
    tool = np.array([0.0, 0.0, -70.0])
    angle = np.linspace(0, 2 * np.pi, 721)[:-1]
    z = np.full_like(angle, -63.0)
    nominal = np.stack([150.0 + 15.0 * np.cos(angle), 150.0 + 15.0 * np.sin(angle), z], axis=1)
    real = nominal + exact_error(mill(), errors, nominal, tool)
    columns = np.stack([2 * real[:, 0], 2 * real[:, 1], np.ones(720)], axis=1)
    cx, cy, c = np.linalg.lstsq(columns, (real[:, :2] ** 2).sum(axis=1), rcond=None)[0]
    diameter = 2 * np.sqrt(c + cx**2 + cy**2)
    assert features["circle 1", "diameter"].error == pytest.approx(1e3 * (diameter - 30.0), abs=0.01)
    assert features["circle 1", "position X"].error == pytest.approx(1e3 * (cx - 150.0), abs=0.01)
    assert features["circle 1", "position Y"].error == pytest.approx(1e3 * (cy - 150.0), abs=0.01)
    share = np.linspace(0, 1, 400)[:, None]

    def slope(first, second):
        at = np.array(first) + share * (np.array(second) - np.array(first))
        x, y = (at + exact_error(mill(), errors, at, tool))[:, :2].T
        along = 0 if abs(second[0] - first[0]) > 1 else 1
        return np.polyfit(*((x, y) if along == 0 else (y, x)), 1)[0]

    bottom, right = slope((120, 120, -63.0), (180, 120, -63.0)), slope((180, 120, -63.0), (180, 180, -63.0))
    # +X turns by its slope, +Y by minus that of x over y; the angle between -X and +Y
    assert features["corner 1", "angle"].error == pytest.approx(1e6 * (bottom + right), abs=0.6)


def test_the_uncertainty_is_the_scatter_of_machines_drawn_from_it(tmp_path, make_errors):
    errors = make_errors(mill(), 2)
    covariance = covariance_or_independent(errors, None)
    _, features = predicted(tmp_path, errors, covariance=covariance)
    generator = np.random.default_rng(1)
    drawn = []
    for _ in range(300):
        values = errors.values() + covariance.errors_factor @ generator.normal(size=covariance.errors_factor.shape[1])
        drawn.append([item.error for item in predicted(tmp_path, errors.with_values(values))[1].values()])
    scatter = np.std(drawn, axis=0)
    stated = np.array([item.u for item in features.values()])
    assert np.all(stated > 0)
    assert scatter / stated == pytest.approx(np.ones(len(stated)), abs=0.2)


def test_the_page_holds_the_figures_and_escapes_names(tmp_path, make_errors):
    found, _ = predicted(tmp_path, make_errors(mill(), 1))
    page = part_page(found)
    assert "part&lt;1&gt;.nc on m" in page
    assert "part<1>" not in page
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    assert len(data["at"]) == len(data["off"]) > 100
    assert f"{found.figures.as_dict()['max_um']:.2f}" in page
    assert json.loads(json_text(found.as_dict()))["features"][0]["name"] == "hole 1"


def test_long_programs_keep_few_points(tmp_path, monkeypatch):
    monkeypatch.setattr("compgen.programs.part.MOST_POINTS", 50)
    ends = np.array([-600.0, 600.0])
    found, _ = predicted(tmp_path, ErrorTable({"EXX": Curve(ends, 1e-4 * ends, np.zeros(2))}))
    assert 20 < len(found.position_mm) <= 50
    assert np.diff(np.unique(np.round(found.position_mm[:, 0]))).max() < 60


def test_the_command_ranks_machines_and_evaluates_tables(tmp_path, small_machine_file, small_errors, call):
    (tmp_path / "e.errors.csv").write_text(compgen.format_errors(small_errors))
    half = small_errors.with_values(0.5 * small_errors.values())
    (tmp_path / "half.errors.csv").write_text(compgen.format_errors(half))
    (tmp_path / "p.nc").write_text(PART)
    (tmp_path / "t.csv").write_text("tool,length_mm\n1,20\n")
    assert (
        call(
            "export", small_machine_file, tmp_path / "e.errors.csv", "--controller", "isg-csv", "--out", tmp_path / "t"
        )[0]
        == 0
    )
    words = ["part", small_machine_file, tmp_path / "p.nc", "--dialect", "fanuc", "--wcs", "G54=0,50,-120"]
    words += ["--tools", tmp_path / "t.csv", "--errors", tmp_path / "e.errors.csv"]
    more = ["--also", f"{small_machine_file}={tmp_path / 'half.errors.csv'}"]
    table = ["--tables", tmp_path / "t" / "volcomp0.csv", "--controller", "isg-csv"]
    code, out, _ = call(*words, *more, *table, "--uncertainty", "--json", "--out", tmp_path / "o")
    found = json.loads(out)
    assert code == 0
    first, second = found["machines"]
    assert first["normal_max_um"] == pytest.approx(0.5 * second["normal_max_um"], rel=1e-3)
    assert found["path_after"]["max_um"] < 0.1 * found["path"]["max_um"]
    assert all(abs(item.get("after_um", 0.0)) < 1.0 for item in found["features"])
    assert {path.name for path in (tmp_path / "o").iterdir()} == {"part.json", "part.html"}
    code, out, _ = call(*words)
    assert code == 0
    assert "hole 1 to 2" in out
    for wrong, message in ((table[:2], "belong together"), (["--also", "m"], "MACHINE=ERRORS")):
        code, _, error = call(*words, *wrong)
        assert code == 2
        assert message in error


def test_a_program_that_cannot_be_followed_is_refused(tmp_path):
    program = tmp_path / "p.nc"
    program.write_text(PART.replace("X80.", "G41 X80."))
    with pytest.raises(InputError, match="cutter radius") as caught:
        predict_part(model_of(mill(), ErrorTable(), None), program, "fanuc", SETUP)
    assert caught.value.line == 12
