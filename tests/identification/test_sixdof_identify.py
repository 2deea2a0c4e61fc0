"""From *.sixdof.csv and an instrument file to errors, tables and reports: the user interface."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.error_table import Curve, ErrorTable, read_errors, read_reversal
from compgen.data.machine import load_machine
from compgen.errors import CompgenWarning, InputError
from compgen.identification import identify_measurement, joint_covariance, read_measurement
from compgen.identification.adjust.unknowns import error_parameters
from compgen.identification.six_dof import SixDofMeasurement, identify_sixdof
from compgen.identification.together import projected
from compgen.instruments.sixdof_instrument import format_sixdof, read_instrument, read_sixdof
from compgen.kinematics import modelled_errors, volumetric_error
from compgen.simulation import SimulatedSixDof, read_scenario, simulate_sixdof, write_simulation

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
DATA, FILE = EXAMPLES / "jia-xytz.sixdof.csv", EXAMPLES / "jia-xytz.instrument.toml"
TRUTH = EXAMPLES / "jia-xytz.truth.errors.csv"
MACHINE = load_machine("jia-xytz")
UM, ARCSEC = 1e-3, np.pi / 648000


def main(words):
    """Run the command line; return the exit code."""
    return run_command(cli, words)


def test_the_example_is_what_its_scenario_makes(tmp_path):
    simulation = simulate_sixdof(MACHINE, read_scenario(EXAMPLES / "jia-xytz.scenario.toml"))
    paths = write_simulation(simulation, tmp_path)
    assert sorted(paths) == ["jia-xytz.sixdof.csv", "truth.errors.csv"]
    made, kept = read_sixdof(paths["jia-xytz.sixdof.csv"]), read_sixdof(DATA)
    for name, values in made.signals_mm.items():
        assert np.abs(values - kept.signals_mm[name]).max() <= 2e-9, name
    assert paths["truth.errors.csv"].read_text() == TRUTH.read_text()


def test_the_squareness_of_the_paper_comes_out_within_its_uncertainty():
    """S_xy, S_xz, S_yz = -5.0, -6.7, -31.1 arcsec plus the slopes of the true straightness."""
    found = identify_sixdof(MACHINE, SixDofMeasurement(read_sixdof(DATA), read_instrument(FILE)))
    truth = read_errors(TRUTH)
    assert [round(truth.squareness[n][0] / ARCSEC * s, 2) for n, s in (("EC0Y", -1), ("EB0Z", 1), ("EA0Z", -1))] == [
        -5.0,
        -6.7,
        -31.1,
    ]

    def line(name):
        curve = truth.curves[name]
        return np.polyfit(curve.position_mm, curve.value, 1)[0]

    moved = {"EC0Y": -line("EYX") - line("EXY"), "EB0Z": line("EZX") + line("EXZ"), "EA0Z": -line("EZY") - line("EYZ")}
    for name, (value, u) in found.errors.squareness.items():
        assert abs(value - truth.squareness[name][0] - moved[name]) <= 3.0 * u, name
        assert 0.1 * ARCSEC <= u <= 1.0 * ARCSEC


def test_identify_writes_errors_covariance_and_report(tmp_path, capsys):
    assert main(["identify", "jia-xytz", str(DATA), "--instrument", str(FILE), "--out", str(tmp_path)]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "identified.covariance.npz",
        "identified.errors.csv",
        "identify.json",
        "machine.toml",
        "residuals.csv",
    ]
    errors = read_errors(tmp_path / "identified.errors.csv")
    assert len(errors.names) == 21
    assert all(np.isfinite(curve.u).all() for curve in errors.curves.values())
    report = json.loads((tmp_path / "identify.json").read_text())
    assert report["method"] == "sixdof"
    part = report["sixdof"]
    assert set(part["axes"]) == {"X", "Y", "Z"}
    assert part["line"] == "ls"
    assert part["contradictions"] == []
    assert "eps_zir" in part["axes"]["Y"]["removed"]["linear"]["parameters"]
    assert part["squareness"]["EA0Z"]["of"] == "S_yz"
    assert part["squareness"]["EA0Z"]["sign"] == -1.0
    assert part["budget"]["EAX"]["eps_PEy"] == pytest.approx(0.05 * ARCSEC * 800 / 30 * 1e6, rel=1e-6)
    assert set(part["repeatability_half_range"]) >= {"positioning (nm)", "roll (arcsec)", "squareness (arcsec)"}
    assert {item["name"] for item in report["inputs"]} >= {"jia-xytz.sixdof.csv", "jia-xytz.instrument.toml"}
    assert "roll (arcsec) X" in capsys.readouterr().out


def test_run_goes_straight_to_accepted_tables_that_make_the_true_machine_better(tmp_path):
    from compgen.data.lengths import Points
    from compgen.kinematics.exact_chain import exact_error
    from compgen.tables import read_tables

    words = ["run", "jia-xytz", str(DATA), "--instrument", str(FILE), "--controller", "isg-csv", "--out", str(tmp_path)]
    assert main(words) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["accepted"] is True
    tables = read_tables(MACHINE, [tmp_path / "volcomp0.csv", tmp_path / "volcomp0.lis"], "isg-csv")
    at = np.random.default_rng(1).uniform(0.0, 800.0, (500, 3))
    truth = read_errors(TRUTH)
    added = tables.correction(MACHINE, Points(at))

    def rms(values):
        """About the best-fit rigid motion: the placement of the workpiece is unknown."""
        design = np.hstack([np.tile(np.eye(3), (len(at), 1)), np.vstack([_turn(p) for p in at])])
        flat = values.ravel()
        return float(np.sqrt(np.mean((flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]) ** 2)))

    before, after = exact_error(MACHINE, truth, at), exact_error(MACHINE, truth, at + added) + added
    assert rms(after) < 0.15 * rms(before)


def _turn(p):
    return np.array([[0.0, p[2], -p[1]], [-p[2], 0.0, p[0]], [p[1], -p[0], 0.0]])


def test_predict_knows_the_uncertainty_of_six_dof_errors(tmp_path):
    main(["identify", "jia-xytz", str(DATA), "--instrument", str(FILE), "--out", str(tmp_path)])
    (tmp_path / "p.points.csv").write_text("x_mm,y_mm,z_mm\n800,800,800\n0,0,0\n")
    words = ["predict", "jia-xytz", str(tmp_path / "identified.errors.csv"), "--points", str(tmp_path / "p.points.csv")]
    assert main([*words, "--out", str(tmp_path / "out.csv"), "--uncertainty"]) == 0
    rows = (tmp_path / "out.csv").read_text().splitlines()
    header = next(line for line in rows if not line.startswith("#")).split(",")
    first = dict(zip(header, rows[-2].split(","), strict=True))
    assert 0.3 < float(first["u_x_um"]) < 20.0


def test_the_covariance_has_the_uncertainties_of_the_errors_file():
    found = identify_sixdof(MACHINE, SixDofMeasurement(read_sixdof(DATA), read_instrument(FILE)))
    covariance = joint_covariance(found)
    u = np.sqrt(np.diag(covariance.errors_covariance))
    names = np.array(covariance.error)
    for name, curve in found.errors.curves.items():
        assert np.allclose(u[names == name], curve.u, rtol=1e-12, atol=1e-18)


# --- contradictions ------------------------------------------------------------------------------------------------


def wrong_mode(tmp_path):
    text = FILE.read_text().replace("[axes.X]\nmode = 2", "[axes.X]\nmode = 1")
    (tmp_path / "wrong.toml").write_text(text)
    return tmp_path / "wrong.toml"


def test_a_contradiction_is_a_warning_in_identify_and_refuses_the_tables_of_run(tmp_path, capsys):
    wrong = wrong_mode(tmp_path)
    words = ["jia-xytz", str(DATA), "--instrument", str(wrong)]
    assert main(["identify", *words, "--out", str(tmp_path / "i")]) == 0
    assert "contradicts mode 1" in capsys.readouterr().err
    report = json.loads((tmp_path / "i" / "identify.json").read_text())
    assert "contradicts mode 1" in report["sixdof"]["contradictions"][0]
    assert main(["run", *words, "--controller", "isg-csv", "--out", str(tmp_path / "r")]) == 1
    result = json.loads((tmp_path / "r" / "result.json").read_text())
    assert result["accepted"] is False
    assert any("contradicts mode 1" in reason for reason in result["reasons"])
    assert (tmp_path / "r" / "NOT-ACCEPTED-volcomp0.csv").is_file()


def test_as_printed_is_loud_and_never_accepted(tmp_path, capsys):
    (tmp_path / "printed.toml").write_text(FILE.read_text().replace('line = "ls"', 'line = "ls"\nas_printed = true'))
    words = ["jia-xytz", str(DATA), "--instrument", str(tmp_path / "printed.toml")]
    assert main(["run", *words, "--controller", "isg-csv", "--out", str(tmp_path / "r")]) == 1
    assert "for comparison with the paper only" in capsys.readouterr().err
    assert not (tmp_path / "r" / "volcomp0.csv").exists()


# --- what is not calibrated ----------------------------------------------------------------------------------------


def test_roll_and_squareness_without_calibration_are_said():
    instrument = read_instrument(FILE)
    bare = dataclasses.replace(
        instrument,
        axes={k: dataclasses.replace(entry, systematics={}) for k, entry in instrument.axes.items()},
        u_systematics={},
    )
    with pytest.warns(CompgenWarning) as caught:
        identify_sixdof(MACHINE, SixDofMeasurement(read_sixdof(DATA), bare))
    texts = " | ".join(str(item.message) for item in caught)
    assert "1 arcsec of eps_PEy is 33.33 arcsec/m at h = 30 mm" in texts
    assert "prism of Y, Z" in texts


# --- reversal ------------------------------------------------------------------------------------------------------


def test_runs_there_and_back_give_the_reversal_and_the_mean_of_both(tmp_path):
    instrument = read_instrument(FILE)
    simulated = SimulatedSixDof(
        instrument,
        runs=2,
        there_and_back=True,
        positions_mm=(np.linspace(0, 800, 9),) * 3,
        noise_mm=np.full(9, 0.02 * UM),
        reversal_mm=(-3 * UM, 0.0, 2 * UM),
    )
    truth = read_errors(TRUTH)
    readings = simulated.measure(MACHINE, truth, np.random.default_rng(2))
    (tmp_path / "there.sixdof.csv").write_text(format_sixdof(readings))
    words = ["identify", "jia-xytz", str(tmp_path / "there.sixdof.csv"), "--instrument", str(FILE)]
    assert main([*words, "--out", str(tmp_path / "o")]) == 0
    reversal = read_reversal(tmp_path / "o" / "identified.reversal.csv")
    assert set(reversal.curves) == {(0, 0), (2, 2)}
    assert reversal.mean_mm(0) == pytest.approx(-3 * UM, abs=0.05 * UM)
    assert reversal.mean_mm(2) == pytest.approx(2 * UM, abs=0.05 * UM)
    exx = read_errors(tmp_path / "o" / "identified.errors.csv").curves["EXX"]
    assert np.abs(exx.value - truth.curves["EXX"].at(exx.position_mm)).max() <= 0.1 * UM


# --- bad input -----------------------------------------------------------------------------------------------------


def test_six_dof_readings_without_an_instrument_file_are_refused(tmp_path, capsys):
    assert main(["identify", "jia-xytz", str(DATA), "--out", str(tmp_path / "o")]) == 2
    assert "--instrument FILE" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_an_instrument_file_for_other_readings_is_refused(tmp_path, capsys):
    lengths = str(EXAMPLES / "zha-gantry.lengths.csv")
    assert main(["identify", "zha-gantry", lengths, "--instrument", str(FILE), "--out", str(tmp_path / "o")]) == 2
    assert "no file contains six-DOF readings" in capsys.readouterr().err


def test_options_of_other_measurements_are_refused(tmp_path, capsys):
    words = ["identify", "jia-xytz", str(DATA), "--instrument", str(FILE), "--out", str(tmp_path)]
    assert main([*words, "--u-length-um", "0.1"]) == 2
    assert "[noise]" in capsys.readouterr().err


def rows_of_example():
    lines = DATA.read_text().splitlines()
    comments = [line for line in lines if line.startswith("#") and "rows" not in line]
    table = [line.split(",") for line in lines if not line.startswith("#")]
    return comments, table


def in_micrometres(table):
    """The spots 1000 times as large."""
    column = table[0].index("y_qd1_mm")
    return [table[0], *[[*r[:column], f"{float(r[column]) * 1000 + 60:.6f}", *r[column + 1 :]] for r in table[1:]]]


def without(table, name):
    column = table[0].index(name)
    return [[*row[:column], *row[column + 1 :]] for row in table]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda t: [row[:-1] if k == 5 else row for k, row in enumerate(t)], "fields, the header has"),
        (lambda t: without(t, "y_psd1_mm"), "y_psd1_mm"),
        (lambda t: [[c if c != "X" else "A" for c in row] for row in t], "expected X, Y or Z"),
        (in_micrometres, "is the unit mm"),
        (lambda t: [row if k != 3 else [row[0], "900", *row[2:]] for k, row in enumerate(t)], "outside the travel"),
    ],
)
def test_spoiled_files_name_what_is_wrong(tmp_path, spoil, message):
    comments, table = rows_of_example()
    path = tmp_path / "bad.sixdof.csv"
    path.write_text("\n".join([*comments, *(",".join(row) for row in spoil(table))]) + "\n")
    with pytest.raises(InputError, match=message):
        identify_measurement(MACHINE, read_measurement([path], FILE))


def test_a_cut_file_is_noticed(tmp_path):
    path = tmp_path / "cut.sixdof.csv"
    path.write_text(DATA.read_text()[:-200])
    with pytest.raises(InputError):
        read_sixdof(path)


def test_micrometres_in_place_of_millimetres_and_swapped_columns_are_noticed(tmp_path):
    readings, instrument = read_sixdof(DATA), read_instrument(FILE)
    signals = dict(readings.signals_mm)
    wrong = dataclasses.replace(
        readings, signals_mm={**signals, "displacement_mm": 1000.0 * signals["displacement_mm"]}
    )
    with pytest.raises(InputError, match="mm per mm of position_mm"):
        identify_sixdof(MACHINE, SixDofMeasurement(wrong, instrument))
    swapped = {**signals, "y_qd1_mm": signals["z_qd1_mm"], "z_qd1_mm": signals["y_qd1_mm"]}
    with pytest.warns(CompgenWarning) as caught:
        identify_sixdof(MACHINE, SixDofMeasurement(dataclasses.replace(readings, signals_mm=swapped), instrument))
    assert any("channels of the first detector" in str(item.message) for item in caught)


def test_an_axis_that_the_instrument_file_lacks_is_named(tmp_path):
    text = FILE.read_text()
    first, last = text.index("[axes.Z]"), text.index("[systematics]")
    second = text.index("[axes.Z.systematics]")
    text = text[:first] + text[last:second] + text[text.index("[u_systematics]") :]
    (tmp_path / "xy.toml").write_text(text)
    with pytest.raises(InputError, match=r"no \[axes.Z\]"):
        identify_measurement(MACHINE, read_measurement([DATA], tmp_path / "xy.toml"))


def test_two_axes_alone_give_their_errors_and_one_squareness(tmp_path):
    readings = read_sixdof(DATA)
    rows = np.flatnonzero(readings.axis != 2)
    part = dataclasses.replace(
        readings,
        axis=readings.axis[rows],
        position_mm=readings.position_mm[rows],
        run=readings.run[rows],
        signals_mm={name: values[rows] for name, values in readings.signals_mm.items()},
        distance_mm=readings.distance_mm[rows],
        direction=readings.direction[rows],
        covariates={},
        origin=(),
    )
    found = identify_sixdof(MACHINE, SixDofMeasurement(part, read_instrument(FILE)))
    assert len(found.errors.curves) == 12
    assert list(found.errors.squareness) == ["EC0Y"]
    assert any(text.startswith("EZZ") for text in found.unobservable)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "sixdof-laser"', 'kind = "tracer"', "sixdof-laser"),
        ("glass_index = 1.5151", "glass_index = 15.151", "between 1 and 4"),
        ("focal_length_mm = 100.0\n", "", "focal_length_mm: is missing"),
        ("[axes.X]\nmode = 2", "[axes.X]\nmode = 3", "from 1 to 2"),
        (
            "[axes.X]\nmode = 2\nbeam_direction = 1",
            "[axes.X]\nmode = 2\nbeam_direction = 0",
            "expected 1 \\(beam along",
        ),
        ("eps_PEy_arcsec = 4.0", "eps_PEy_deg = 4.0", "is not a systematic parameter"),
        ("eps_PEy_arcsec = 4.0", "eps_PEy_arcsec = 4.0\neps_PEy_urad = 4.0", "twice, in two units"),
        ("eps_PEy_arcsec = 0.05", "eps_PEy_arcsec = -0.05", "not negative"),
        ("[axes.Y.systematics]", "[axes.X.systematics]", "is not a systematic parameter"),
        ("qd_um = 0.05", "qd_mm = 0.05", "did you mean 'qd_um'"),
        ('line = "ls"', 'line = "endpoints"', "'ls', 'minzone'"),
        ('line = "ls"', 'line = "ls"\nsquareness_sign = 2', "-1"),
    ],
)
def test_a_wrong_instrument_file_names_key_and_choices(tmp_path, old, new, message):
    text = FILE.read_text()
    assert old in text
    (tmp_path / "wrong.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message) as caught:
        read_instrument(tmp_path / "wrong.toml")
    assert caught.value.file is not None
    assert caught.value.field


def test_a_distance_that_becomes_negative_is_refused(tmp_path):
    """Command and chain bring the target closer by 800 mm from a distance of 100 mm."""
    text = FILE.read_text().replace("[axes.Z]\nmode = 1\nbeam_direction = 1", "[axes.Z]\nmode = 1\nbeam_direction = -1")
    (tmp_path / "near.toml").write_text(text)
    readings = read_sixdof(DATA)
    flipped = np.where(readings.axis == 2, -1.0, 1.0) * readings.signals_mm["displacement_mm"]
    signals = {**readings.signals_mm, "displacement_mm": flipped}
    with pytest.raises(InputError, match="optical distance would become"):
        identify_sixdof(
            MACHINE,
            SixDofMeasurement(
                dataclasses.replace(readings, signals_mm=signals), read_instrument(tmp_path / "near.toml")
            ),
        )


# --- merging -------------------------------------------------------------------------------------------------------


def test_the_projection_keeps_how_the_tool_moves_up_to_a_rigid_motion():
    """All 21 errors expressed in the 17 that a tracer sees: E at random nodes, outside the solver's sample.

    Between nodes an angle times its own travel is not a straight line, but a straightness curve is.
    """
    found = identify_sixdof(MACHINE, SixDofMeasurement(read_sixdof(DATA), read_instrument(FILE)))
    layout = error_parameters(MACHINE, modelled_errors(MACHINE))
    names, positions, values, factor, left = projected(MACHINE, layout, found)
    assert left <= 1e-9
    label, curves, squareness = np.array(names), {}, {}
    for name in dict.fromkeys(names):
        rows = label == name
        if name in ("EC0Y", "EB0Z", "EA0Z"):
            squareness[name] = (float(values[rows][0]), 0.0)
        else:
            curves[name] = Curve(positions[rows], values[rows], np.zeros(rows.sum()))
    table = ErrorTable(curves, squareness)
    assert len(table.names) == 17
    at = 50.0 * np.random.default_rng(4).integers(0, 17, (300, 3))
    difference = volumetric_error(MACHINE, table, at) - volumetric_error(MACHINE, found.errors, at)
    design = np.hstack([np.tile(np.eye(3), (len(at), 1)), np.vstack([_turn(p) for p in at])])
    rest = difference.ravel() - design @ np.linalg.lstsq(design, difference.ravel(), rcond=None)[0]
    assert np.abs(difference).max() > 1 * UM
    assert np.abs(rest).max() <= 1e-8
    assert factor.shape[0] == len(values)


def lengths_of(truth_file, tmp_path, seed=3):
    """Lengths of four tracers on a machine with the errors of a file."""
    shutil.copy(truth_file, tmp_path / "truth.csv")
    stations = [(-300, -250, -100), (1100, -200, -150), (1050, 1100, -120), (-280, 1000, 700)]
    text = f'name = "t"\nseed = {seed}\n[errors]\nfile = "truth.csv"\n[instrument]\ntype = "laser-tracer"\nnoise_um = 0.3\n'
    for k, (x, y, z) in enumerate(stations):
        text += f'[[instrument.stations]]\nname = "S{k}"\nposition_mm = [{x}, {y}, {z}]\ndead_length_mm = 100.0\n'
    (tmp_path / "t.scenario.toml").write_text(text + '[trajectory]\ntype = "grid"\n')
    words = [
        "simulate",
        str(tmp_path / "coarse.toml"),
        "--scenario",
        str(tmp_path / "t.scenario.toml"),
        "--out",
        str(tmp_path / "sim"),
    ]
    assert main(words) == 0
    return tmp_path / "sim" / "t.lengths.csv"


def merged(tmp_path, truth_file, out):
    lengths = lengths_of(truth_file, tmp_path)
    words = ["identify", str(tmp_path / "coarse.toml"), str(lengths), str(DATA), "--instrument", str(FILE)]
    code = main([*words, "--out", str(tmp_path / out)])
    return code, json.loads((tmp_path / out / "identify.json").read_text()), tmp_path / out


@pytest.fixture
def coarse(tmp_path):
    """The machine with curves of 9 nodes."""
    text = (EXAMPLES.parent / "machines" / "jia-xytz.toml").read_text().replace("nodes = 17", "nodes = 9")
    (tmp_path / "coarse.toml").write_text(text)


@pytest.mark.usefixtures("coarse")
def test_tracer_and_six_dof_of_the_same_machine_agree_and_are_averaged(tmp_path):
    code, report, folder = merged(tmp_path, TRUTH, "m")
    assert (code, report["merged"]["disagree"]) == (0, [])
    assert max(report["merged"]["en"].values()) <= 1.0
    assert "stations.csv" in {p.name for p in folder.iterdir()}
    errors = read_errors(folder / "identified.errors.csv")
    main(
        [
            "identify",
            str(tmp_path / "coarse.toml"),
            str(tmp_path / "sim" / "t.lengths.csv"),
            "--out",
            str(tmp_path / "l"),
        ]
    )
    alone = read_errors(tmp_path / "l" / "identified.errors.csv")
    assert errors.names == alone.names
    for name, curve in errors.curves.items():
        assert np.all(curve.u <= alone.curves[name].u + 1e-12), name
    assert errors.squareness["EA0Z"][1] <= alone.squareness["EA0Z"][1]


@pytest.mark.usefixtures("coarse")
def test_an_error_that_changed_between_the_measurements_is_named(tmp_path, capsys):
    """40 um/m of squareness between Z and Y appeared: only EA0Z may be named."""
    text = []
    for line in TRUTH.read_text().splitlines():
        cells = line.split(",")
        if cells[0] == "EA0Z":
            cells[2] = f"{float(cells[2]) + 40.0:.9f}"
        text.append(",".join(cells))
    (tmp_path / "moved.csv").write_text("\n".join(text) + "\n")
    code, report, _ = merged(tmp_path, tmp_path / "moved.csv", "m")
    assert (code, report["merged"]["disagree"]) == (1, ["EA0Z"])
    assert "disagree beyond their uncertainty in EA0Z" in capsys.readouterr().err
