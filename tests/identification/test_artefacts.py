"""Plates measured with the machine's probe: against known errors, by an independent formula of the probe readings."""

from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.data.deviations import read_artefacts
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning, InputError, UndeterminedError
from compgen.foreign import open_measurement
from compgen.identification import IdentifyOptions, identify_measurement
from compgen.kinematics.exact_chain import tip_position
from compgen.pipeline import identify_bare
from compgen.simulation import simulate_axis_runs

EC0Y, SLOPES, NOISE_MM = 120e-6, (30e-6, -20e-6), 3e-4


@pytest.fixture(scope="module", params=["WFYXZT", "WXYFZT"])
def machine(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("m") / "mill.toml"
    axes = "".join(f"[axes.{a}]\nrange_mm = [-200.0, 200.0]\nnodes = 5\n" for a in "XYZ")
    path.write_text(f'name = "mill"\nchain = "{request.param}"\n{axes}')
    return compgen.load_machine(path)


@pytest.fixture(scope="module")
def least_squares(machine):
    """The machine without a prior: what the plate itself says."""
    return replace(machine, prior=PriorSettings(class_name="none"))


@pytest.fixture(scope="module")
def errors():
    at, zero = np.linspace(-200.0, 200.0, 5), np.zeros(5)
    curves = {
        "EXX": Curve(at, SLOPES[0] * at + 4e-3 * np.array([0, 1, 0, 1, 0]), zero),
        "EYY": Curve(at, SLOPES[1] * at, zero),
        "EYX": Curve(at, 5e-3 * np.array([0, 1, 1.5, 0.5, 0]), zero),
        "EXY": Curve(at, -4e-3 * np.array([0, 0.5, 1.0, 1.2, 0]), zero),
    }
    return ErrorTable(curves, {"EC0Y": (EC0Y, 0.0)})


def probed(machine, errors, poses, *, form_mm=0.0, seed=1):
    """Rows of a plate of 6 x 6 holes in each pose (degrees, x, y): m with m + E(m) = hole position, by iteration."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-125, 125, 6), np.linspace(-125, 125, 6))
    nominal = np.column_stack([x.ravel(), y.ravel(), np.zeros(36)])
    actual = nominal + np.column_stack([*rng.normal(0.0, form_mm, (2, 36)), np.zeros(36)])
    rows = []
    for setup, (turn, dx, dy) in enumerate(poses):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        place = actual @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [dx, dy, 0.0]
        found = place.copy()
        for _ in range(5):
            found = place - (tip_position(machine, errors.at(found), found, np.zeros(3)) - found)
        found = found + rng.normal(0.0, NOISE_MM, found.shape)
        rows += [(f"H{k}", *nominal[k], *found[k, :2], setup) for k in range(36)]
    return rows


def written(path, rows, *comments):
    head = "feature,x_mm,y_mm,z_mm,mx_mm,my_mm,setup"
    lines = [",".join(str(v) if not isinstance(v, float) else f"{v:.7f}" for v in row) for row in rows]
    path.write_text("\n".join([*(f"# {text}" for text in comments), head, *lines]) + "\n")
    return path


def test_a_calibrated_plate_gives_squareness_scale_and_straightness(tmp_path, least_squares, errors):
    machine = least_squares
    path = written(tmp_path / "plate.artefact.csv", probed(machine, errors, [(0.4, 3.0, -2.0)]), "u_probe_um = 0.3")
    found = identify_bare(machine, open_measurement([path]))
    assert found.method == "artefact"
    assert 0.5 < found.reduced_chi_square < 1.6
    position = np.array([[x, y, 0.0] for x in (-120.0, 0.0, 120.0) for y in (-120.0, 0.0, 120.0)])
    left = compgen.volumetric_error(machine, found.errors, position) - compgen.volumetric_error(
        machine, errors, position
    )
    left[:, 2] = 0.0
    assert np.abs(compgen.without_rigid_motion(position, left)[:, :2]).max() < 4 * NOISE_MM


def test_a_plate_that_is_only_nominal_tells_its_errors_by_turning(tmp_path, machine, errors):
    """Holes are off by 20 um: one set-up is wrong by that, turned ones give squareness and straightness, not scale."""
    rows = probed(
        machine, errors, [(0.0, 0.0, 0.0), (90.2, 2.0, 1.0), (180.1, -3.0, 2.0), (0.1, 50.0, 30.0)], form_mm=0.02
    )
    path = written(tmp_path / "plate.artefact.csv", rows, "calibrated = false", "u_probe_um = 0.3")
    with pytest.warns(CompgenWarning, match="does not show a common scale of the axes"):
        found = identify_measurement(machine, open_measurement([path]))
    assert 0.5 < found.reduced_chi_square < 1.6
    position = np.array([[x, y, 0.0] for x in (-100.0, 0.0, 100.0) for y in (-100.0, 0.0, 100.0)])
    left = compgen.volumetric_error(machine, found.errors, position) - compgen.volumetric_error(
        machine, errors, position
    )
    left[:, 2] = 0.0
    scale = np.sum(left * position) / np.sum(position[:, :2] ** 2)  # turning does not determine the common scale
    rest = compgen.without_rigid_motion(position, left - scale * position)
    assert np.abs(rest[:, :2]).max() < 8 * NOISE_MM
    assert any(name in text for text in found.unobservable for name in ("EXX: part of it", "EYY: part of it"))
    wrong = written(tmp_path / "once.artefact.csv", rows[:36], "u_probe_um = 0.3")  # taken as calibrated
    assert identify_measurement(machine, open_measurement([wrong]), IdentifyOptions(reject=False)).rms_um > 5.0


@pytest.mark.parametrize("chosen", ["general", "large", "none"])
def test_a_scale_that_no_reading_shows_is_unknown_and_not_zero(tmp_path, machine, errors, chosen):
    """The uncertainty of the mean slope of X and Y is that of the prior, 15 um/m times the class; without one it is unknown."""
    rows = probed(
        machine, errors, [(0.0, 0.0, 0.0), (90.2, 2.0, 1.0), (180.1, -3.0, 2.0), (0.1, 50.0, 30.0)], form_mm=0.02
    )
    path = written(tmp_path / "plate.artefact.csv", rows, "calibrated = false", "u_probe_um = 0.3")
    machine = replace(machine, prior=PriorSettings(class_name=chosen, learn="no"))
    said = "it is unknown" if chosen == "none" else f"one of {15 if chosen == 'general' else 45} um/m"
    with pytest.warns(CompgenWarning, match=f"does not show a common scale of the axes: .*{said}"):
        found = identify_bare(machine, open_measurement([path]))
    if chosen == "none":
        assert np.isnan(found.errors.curves["EXX"].u).any()
        return
    ends, size = np.array([-200.0, 200.0]), {"general": 15.0, "large": 45.0}[chosen]
    factor = found.posterior.values_factor(["EXX", "EYY"], [ends, ends])
    mean_slope = np.array([-1.0, 1.0, -1.0, 1.0]) / 800.0
    assert 1e6 * np.linalg.norm(mean_slope @ factor) > 0.9 * size / np.sqrt(2.0)


def test_one_length_gives_a_turned_plate_its_scale(tmp_path, machine, errors):
    rows = probed(
        machine, errors, [(0.0, 0.0, 0.0), (90.2, 2.0, 1.0), (180.1, -3.0, 2.0), (0.1, 50.0, 30.0)], form_mm=0.02
    )
    path = written(tmp_path / "plate.artefact.csv", rows, "calibrated = false", "u_probe_um = 0.3")
    runs = tmp_path / "x.axis.csv"
    at = np.linspace(-200.0, 200.0, 5)
    lines = [f"X,{x},{way},{run},{1e3 * errors.curves['EXX'].at(np.array([x]))[0] + 0.1 * way:.4f}"
             for run in (1, 2) for way in (1, -1) for x in at]  # fmt: skip
    runs.write_text("axis,position_mm,direction,run,deviation_um\n" + "\n".join(lines) + "\n")
    found = identify_bare(machine, open_measurement([path, runs]))
    assert found.objections == ()
    slope = np.polyfit(found.errors.curves["EYY"].position_mm[1:-1], found.errors.curves["EYY"].value[1:-1], 1)[0]
    assert slope == pytest.approx(SLOPES[1], abs=4e-6)
    assert found.errors.squareness["EC0Y"][0] == pytest.approx(EC0Y, abs=8e-6)


def test_the_sign_is_the_opposite_of_that_of_a_part(tmp_path, least_squares, errors):
    """A machine that travels too far makes holes too far apart, and measures true holes too close together."""
    machine = least_squares
    rows = probed(machine, errors, [(0.0, 0.0, 0.0)])
    path = written(tmp_path / "plate.artefact.csv", rows, "u_probe_um = 0.3")
    as_part = tmp_path / "same.part.csv"
    as_part.write_text(
        "# origin_mm = 0, 0, 0\n" + path.read_text().replace("feature,", "temp_feature_c,").replace("H", "")
    )
    probe, part = (identify_measurement(machine, open_measurement([item])) for item in (path, as_part))
    slopes = [
        np.polyfit(item.errors.curves["EXX"].position_mm, item.errors.curves["EXX"].value, 1)[0]
        for item in (probe, part)
    ]
    assert slopes[0] == pytest.approx(SLOPES[0], abs=3e-6)
    assert slopes[1] == pytest.approx(-SLOPES[0], abs=3e-6)


def test_files_say_what_is_wrong_with_them(tmp_path, machine, errors):
    rows = probed(machine, errors, [(0.0, 0.0, 0.0)])
    path = written(tmp_path / "plate.artefact.csv", [*rows, rows[3]])
    with pytest.raises(InputError, match="feature 'H3' of set-up 0 is already in line 5"):
        read_artefacts(path)
    with pytest.raises(InputError, match="neither true nor false"):
        read_artefacts(written(tmp_path / "a.artefact.csv", rows, "calibrated = perhaps"))
    with pytest.raises(InputError, match="u_probe_um = 'fine' is not a number"):
        identify_measurement(
            machine, open_measurement([written(tmp_path / "c.artefact.csv", rows, "u_probe_um = fine")])
        )
    with pytest.raises(InputError, match="-1 um; it must be above zero"):
        identify_measurement(machine, open_measurement([written(tmp_path / "d.artefact.csv", rows, "u_probe_um = -1")]))
    text = path.read_text().replace("feature,", "u_x_um,feature,").replace("\nH", "\n-1,H")
    (tmp_path / "e.artefact.csv").write_text(text)
    with pytest.raises(InputError, match="-1 um is not a standard uncertainty"):
        read_artefacts(tmp_path / "e.artefact.csv")
    mirrored = [(name, x, y, z, -mx, my, setup) for name, x, y, z, mx, my, setup in rows]
    with pytest.raises(InputError, match="mirrored"):
        identify_measurement(machine, open_measurement([written(tmp_path / "b.artefact.csv", mirrored)]))
    far = [(name, x, y, z, mx, my + 5e3, setup) for name, x, y, z, mx, my, setup in rows]
    with pytest.raises(InputError, match="column my_mm: .* outside the travel"):
        identify_measurement(machine, open_measurement([written(tmp_path / "f.artefact.csv", far)]))


def test_set_ups_that_hardly_separate_plate_and_machine_are_named_as_the_reason(tmp_path):
    """A plate of 0.2 m on a machine of metres, turned by 90 degrees and shifted only: noise becomes millimetres."""
    scenario = tmp_path / "s.toml"
    poses = ["rotation_deg = [0, 0, 0]", "rotation_deg = [0, 0, 90]", "rotation_deg = [0, 0, 0]"]
    lines = [
        'name = "s"\nseed = 3\n[instrument]\ntype = "touch-probe"\ncomponents = "xy"\ncalibrated = false\nform_um = 20'
    ]
    for k, pose in enumerate(poses):
        lines.append(f"[[instrument.poses]]\norigin_mm = [{-400 + 25 * k}, -400, -200]\n{pose}")
    scenario.write_text("\n".join(lines))
    machine = compgen.load_machine("zha-gantry")
    plate = simulate_axis_runs(machine, compgen.read_scenario(scenario)).readings
    with pytest.raises(
        UndeterminedError, match="turned by 180 degrees and shifted, too, or give the machine fewer nodes"
    ):
        identify_measurement(machine, plate)


def test_tables_of_a_turned_plate_are_those_of_its_errors(tmp_path, call):
    """Curves of few readings are strongly correlated: smoothed one by one they would no longer fit together."""
    scenario = tmp_path / "plate.toml"
    poses = [(300, 200, 0), (300, 200, 90), (300, 200, 180), (350, 230, 0)]
    lines = ['name = "plate"\nseed = 3\n[instrument]\ntype = "touch-probe"\ncomponents = "xy"\ncalibrated = false']
    lines.append("form_um = 15\ncolumns = 6\nrows = 6")
    for x, y, angle in poses:
        lines.append(f"[[instrument.poses]]\norigin_mm = [{x}, {y}, 200]\nrotation_deg = [0, 0, {angle}]")
    scenario.write_text("\n".join(lines))
    machine = compgen.load_machine("moving-table-mill")
    compgen.write_simulation(simulate_axis_runs(machine, compgen.read_scenario(scenario)), tmp_path)
    code, _, _ = call(
        "run",
        "moving-table-mill",
        tmp_path / "plate.artefact.csv",
        "--controller",
        "isg-csv",
        "--out",
        tmp_path / "t",
        "--no-report",
    )
    assert code == 0
    fitted, found = (compgen.read_errors(tmp_path / "t" / f"{name}.errors.csv") for name in ("fitted", "identified"))
    for name, curve in found.curves.items():
        assert fitted.curves[name].value == pytest.approx(curve.value, abs=1e-8), name
