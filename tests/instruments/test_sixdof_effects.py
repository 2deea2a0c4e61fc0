"""What systematics, drift and wrong settings do to the errors: classes, crosstalk, roll bias, prism, health, air, print."""

import dataclasses
import warnings
from pathlib import Path

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable, fitted_line, read_errors
from compgen.data.machine import Axis, Chain, Machine
from compgen.data.names import ERRORS
from compgen.errors import CompgenWarning, InputError
from compgen.instruments.interferometer import compensated, refractive_index
from compgen.instruments.sixdof_evaluation import axis_runs, evaluate_readings
from compgen.instruments.sixdof_health import sixdof_health
from compgen.instruments.sixdof_instrument import (
    DIRECTIONS,
    ROTATIONS,
    SIGNALS,
    AxisSetUp,
    Optics,
    SetUp,
    SixDof,
    SixDofInstrument,
    error_matrix,
    read_sixdof,
    solve_errors,
    systematic_signals,
)
from compgen.instruments.sixdof_reduction import expected_away, printed_run, reduce_runs
from compgen.simulation import SimulatedSixDof
from compgen.simulation.sixdof import Tracer

ARCSEC, UM = np.pi / 648000, 1e-3
GIVEN = Optics(100.0, 30.0, 1.5151, 30.0, 3.0, 25.4, 0.0)
AT = np.linspace(0.0, 800.0, 17)
X, Y, Z = range(3)
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def machine_of(chain="WFXYZT", expansion=None):
    axes = tuple(Axis((0.0, 800.0), AT, expansion) for _ in range(3))
    return Machine("six", Chain(chain), axes)


def truth_of(seed=1, scale_um=5.0, scale_arcsec=4.0):
    rng, curves = np.random.default_rng(seed), {}
    for error in ERRORS[:18]:
        scale = scale_um * UM if error.kind == "linear" else scale_arcsec * ARCSEC
        value = np.polynomial.legendre.legval(np.linspace(-1, 1, 17), rng.normal(size=7)) * scale
        curves[error.name] = Curve(AT, value - value[0], np.zeros(17))
    return ErrorTable(curves, {"EC0Y": (24e-6, 0.0), "EB0Z": (-32e-6, 0.0), "EA0Z": (150e-6, 0.0)})


def instrument_of(modes=(1, 1, 1), systematics=None, distance_mm=None):
    """Tool-side machine: in mode 1 unit and target part as the command rises, in mode 2 they approach."""
    given = systematics or {}
    axes = {}
    for k in range(3):
        first = distance_mm if distance_mm is not None else (100.0 if modes[k] == 1 else 1000.0)
        axes[k] = AxisSetUp(SetUp(k, modes[k], 1), first, systematics=given.get(k, {}))
    return SixDofInstrument(GIVEN, axes)


def readings_of(machine, truth, instrument, seed=0, **changes):
    simulated = SimulatedSixDof(instrument, **{"runs": 1, **changes})
    return simulated.measure(machine, truth, np.random.default_rng(seed))


def evaluated(machine, truth, modes, known=None, real=None, **changes):
    """Errors found with the ``known`` systematics where the ``real`` ones act."""
    readings = readings_of(machine, truth, instrument_of(modes, real), **changes)
    return evaluate_readings(machine, readings, instrument_of(modes, known)).errors


# --- T2, T3 ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [X, Y, Z])
@pytest.mark.parametrize("mode", [1, 2])
def test_the_error_matrix_has_full_rank_and_its_inverse_is_that_of_linear_algebra(axis, mode):
    """T2: against numpy's own least squares on all seven signals."""
    rng = np.random.default_rng(axis)
    matrix = error_matrix(GIVEN, SetUp(axis, mode), AT + 100.0)
    errors = rng.normal(size=(17, 6)) * 1e-3
    signals = np.einsum("nij,nj->ni", matrix, errors)
    for k in range(17):
        assert np.linalg.matrix_rank(matrix[k]) == 6
        assert np.allclose(np.linalg.lstsq(matrix[k], signals[k], rcond=None)[0], errors[k], rtol=0, atol=1e-12)
    assert np.abs(solve_errors(GIVEN, SetUp(axis, mode), AT + 100.0, signals) - errors).max() <= 1e-12


def test_both_modes_give_the_same_errors_of_the_same_machine():
    """T3."""
    machine, truth = machine_of(), truth_of()
    one, two = evaluated(machine, truth, (1, 1, 1)), evaluated(machine, truth, (2, 2, 2))
    for name in one.curves:
        limit = 0.02 * UM if name[1] in "XYZ" else 0.01 * ARCSEC
        assert np.abs(one.curves[name].value - two.curves[name].value).max() <= limit, name
    for name in one.squareness:
        assert abs(one.squareness[name][0] - two.squareness[name][0]) <= 0.02 * ARCSEC


# --- T4: classes ----------------------------------------------------------------------------------------------------

CONSTANT = {"delta_yic": 20 * UM, "eps_zic": 8 * ARCSEC, "delta_zmc1": 10 * UM, "eps_xic": 8 * ARCSEC}
LINEAR = {"eps_zmc1": 6 * ARCSEC, "eps_ymc1": -5 * ARCSEC}


def x_straightness(real, line, bend=True):
    """Straightness of X before anything but the first point, and after the line, in um; the truth taken off."""
    machine, truth = machine_of(), truth_of(scale_um=5.0 if bend else 0.0)
    readings = readings_of(machine, truth, instrument_of((1, 1, 1), {X: real}))
    plain = readings_of(machine, truth, instrument_of((1, 1, 1)))
    instrument = dataclasses.replace(instrument_of((1, 1, 1)), line=line)
    raw, clean = (axis_runs(machine, r, instrument)[0].delta_mm[:, 1] for r in (readings, plain))
    left, right = (evaluate_readings(machine, r, instrument).errors.curves["EYX"].value for r in (readings, plain))
    return np.abs(raw - clean).max() / UM, np.abs(left - right).max() / UM


@pytest.mark.parametrize("line", ["ls", "minzone"])
def test_constants_vanish_with_the_first_point_and_linear_terms_with_either_line(line):
    """T4."""
    raw, after = x_straightness(CONSTANT, line)
    assert raw <= 0.01
    assert after <= 0.01
    raw, after = x_straightness(LINEAR, line)
    assert raw == pytest.approx(6 * ARCSEC * 800 / 2 / UM, rel=1e-3)
    assert after <= 0.01


@pytest.mark.parametrize("line", ["ls", "minzone"])
def test_crosstalk_is_taken_out_by_no_line(line):
    """T4: without the arm of the angle the straightness keeps it, whatever line is fitted."""
    machine, truth = machine_of(), truth_of()
    instrument = dataclasses.replace(instrument_of((1, 1, 1)), line=line)
    readings = readings_of(machine, truth, instrument)
    thin = dataclasses.replace(instrument, optics=dataclasses.replace(GIVEN, plate_thickness_mm=0.0, cube_side_mm=1e-6))
    right, wrong = (evaluate_readings(machine, readings, i).errors.curves["EYX"].value for i in (instrument, thin))
    yaw = truth.curves["ECX"].value
    constant, slope = fitted_line(AT, yaw, "ls")
    bend = np.abs(yaw - constant - slope * AT).max() * GIVEN.reduced_depth_mm
    assert np.abs(right - wrong).max() >= 0.5 * bend >= 0.05 * UM


# --- T5, T6, T7 -----------------------------------------------------------------------------------------------------


def test_mode_2_at_the_tool_needs_the_absolute_distance():
    """T5: an L that is off by 10 mm makes 10 mm times the angle, 0.48 um for 10 arcsec."""
    machine, truth = machine_of(), truth_of()
    readings = readings_of(machine, truth, instrument_of((2, 2, 2), distance_mm=1000.0))
    found, wrong = (
        evaluate_readings(machine, readings, instrument_of((2, 2, 2), distance_mm=first)).errors
        for first in (1000.0, 1010.0)
    )
    yaw = truth.curves["ECX"].value
    constant, slope = fitted_line(AT, yaw, "ls")
    bent = yaw - constant - slope * AT
    difference = wrong.curves["EYX"].value - found.curves["EYX"].value
    assert np.abs(np.abs(difference) - np.abs(10.0 * (bent - bent[0]))).max() <= 0.01 * UM


@pytest.mark.parametrize(("axis", "roll"), [(X, "EAX"), (Y, "EBY"), (Z, "ECZ")])
def test_an_unknown_tilt_of_the_second_beam_is_a_false_roll_of_33_arcsec_per_metre(axis, roll):
    """T6: 1 arcsec of eps_PEy at h = 30 mm."""
    machine, truth = machine_of(), truth_of()
    wrong = evaluated(machine, truth, (1, 1, 1), real={k: {"eps_PEy": ARCSEC} for k in range(3)})
    bias = wrong.curves[roll].value - truth.curves[roll].value
    assert abs(fitted_line(AT, bias)[1]) * 1000.0 / ARCSEC == pytest.approx(1000.0 / 30.0, rel=1e-3)
    right = evaluated(machine, truth, (1, 1, 1), *({k: {"eps_PEy": ARCSEC} for k in range(3)},) * 2)
    assert np.abs(right.curves[roll].value - truth.curves[roll].value).max() <= 0.01 * ARCSEC


@pytest.mark.parametrize(
    ("axis", "name", "error", "times"),
    [
        (Y, "eps_zir", "EC0Y", 2.0),
        (Z, "eps_yir", "EB0Z", 2.0),
        (Y, "eps_xir", "EA0Z", 1.0),
        (Z, "eps_xir", "EA0Z", 1.0),
        (Y, "eps_zmrs1", "EC0Y", 0.5151),
    ],
)
def test_an_unknown_prism_angle_goes_into_squareness_and_a_calibrated_one_does_not(axis, name, error, times):
    """T7: 1 arcsec of eps_zir shifts S_xy by 2 arcsec."""
    machine, truth = machine_of(), truth_of()
    real = {axis: {name: 3 * ARCSEC}}
    base = evaluated(machine, truth, (1, 1, 1)).squareness[error][0]
    wrong = evaluated(machine, truth, (1, 1, 1), real=real).squareness[error][0]
    right = evaluated(machine, truth, (1, 1, 1), real, real).squareness[error][0]
    assert abs(wrong - base) / ARCSEC == pytest.approx(3 * times, abs=0.01)
    assert abs(right - base) <= 0.01 * ARCSEC


# --- T8 and health --------------------------------------------------------------------------------------------------


def names_of(machine, readings, instrument):
    return {(item.name, item.axis) for item in sixdof_health(machine, readings, instrument)}


def test_the_second_spot_against_the_first_is_a_line_whatever_the_axis_does():
    """T8: slope -2 eps_PEz, no bow; a bow of 1 um is named."""
    machine, truth = machine_of(), truth_of()
    instrument = instrument_of((1, 2, 1), {k: {"eps_PEz": 3 * ARCSEC} for k in range(3)})
    readings = readings_of(machine, truth, instrument, drift_rad=0.3 * ARCSEC)
    signals = readings.signals_mm
    for axis in range(3):
        rows = readings.axis == axis
        away = expected_away(machine, instrument)[axis]
        difference = (signals["y_qd2_mm"] - signals["y_qd1_mm"])[rows]
        constant, slope = fitted_line(AT, difference)
        assert slope * away == pytest.approx(-6 * ARCSEC, rel=1e-3)
        assert np.abs(difference - constant - slope * AT).max() <= 0.01 * UM
    assert names_of(machine, readings, instrument) == set()
    bow = np.where(readings.axis == 1, 2 * UM * np.sin(np.pi * readings.position_mm / 800.0), 0.0)
    bent = dataclasses.replace(readings, signals_mm={**signals, "y_qd2_mm": signals["y_qd2_mm"] + bow})
    assert names_of(machine, bent, instrument) == {("second_beam", "Y")}


def test_wrong_depth_and_wrong_distance_are_suspected_where_straightness_follows_the_angle():
    machine = machine_of()
    truth = truth_of(scale_um=0.05, scale_arcsec=8.0)
    instrument = instrument_of((1, 1, 1))
    thin = dataclasses.replace(instrument, optics=dataclasses.replace(GIVEN, cube_side_mm=1e-6))
    found = names_of(machine, readings_of(machine, truth, instrument), thin)
    assert {("crosstalk_yaw", "X"), ("crosstalk_pitch", "X")} <= found
    assert names_of(machine, readings_of(machine, truth, instrument), instrument) == set()
    far = instrument_of((2, 2, 2), distance_mm=1000.0)
    readings = readings_of(machine, truth, far)
    assert ("distance_offset", "X") in names_of(machine, readings, instrument_of((2, 2, 2), distance_mm=1040.0))
    assert names_of(machine, readings, far) == set()


def test_a_wrong_gain_or_sign_of_the_drift_monitor_is_suspected():
    machine, truth, instrument = machine_of(), truth_of(), instrument_of((1, 1, 1))
    readings = readings_of(machine, truth, instrument, runs=3, drift_rad=0.5 * ARCSEC)
    assert names_of(machine, readings, instrument) == set()
    signals = dict(readings.signals_mm)
    turned = dataclasses.replace(readings, signals_mm={**signals, "y_psd2_mm": -signals["y_psd2_mm"]})
    assert {name for name, _ in names_of(machine, turned, instrument)} == {"beam_drift"}


def test_a_monitor_that_is_zeroed_for_every_run_is_said():
    machine, truth, instrument = machine_of(), truth_of(), instrument_of((1, 1, 1))
    readings = readings_of(machine, truth, instrument, drift_rad=0.5 * ARCSEC)
    monitor = readings.signals_mm["y_psd2_mm"].copy()
    for _, _, rows in readings.runs():
        monitor[rows] -= monitor[rows[0]]
    zeroed = dataclasses.replace(readings, signals_mm={**readings.signals_mm, "y_psd2_mm": monitor})
    assert ("drift_zero", "") in names_of(machine, zeroed, instrument)


def test_swapped_channels_and_a_wrong_mode_are_suspected():
    machine, truth, instrument = machine_of(), truth_of(), instrument_of((1, 1, 1))
    readings = readings_of(machine, truth, instrument)
    signals = dict(readings.signals_mm)
    swapped = {**signals, "y_qd1_mm": signals["z_qd1_mm"], "z_qd1_mm": signals["y_qd1_mm"]}
    found = names_of(machine, dataclasses.replace(readings, signals_mm=swapped), instrument)
    assert {("detector_swap", axis) for axis in "XYZ"} <= found
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CompgenWarning)
        assert ("mode", "X") in names_of(machine, readings, instrument_of((2, 1, 1)))


# --- T9: the print --------------------------------------------------------------------------------------------------


def printed(axis, mode, systematics=None, drift=None):
    """Printed against traced errors of one axis: delta (17, 3), eps (17, 3) for both, and what was true."""
    rng = np.random.default_rng([axis, mode])
    away = 1 if mode == 1 else -1
    chain = "WFXYZT"
    machine, first = machine_of(chain), 100.0 if away > 0 else 1000.0
    entry = AxisSetUp(SetUp(axis, mode, 1), first, systematics=systematics or {})
    instrument = SixDofInstrument(GIVEN, {axis: entry})
    errors = np.polynomial.legendre.legval(np.linspace(-1, 1, 17), rng.normal(size=(5, 6))).T
    errors = (errors - errors[0]) * np.array([5 * UM] * 3 + [4 * ARCSEC] * 3)
    tracer = Tracer(GIVEN, axis, mode, 1, systematics)
    tilt = np.zeros((17, 2)) if drift is None else drift
    travel = AT if mode == 1 else -AT
    signals = np.array(
        [
            tracer.signals(first, error[:3], error[3:], drift_rad=tuple(beam), travel_mm=moved)
            for error, beam, moved in zip(errors, tilt, travel, strict=True)
        ]
    )
    by_name = dict(zip(SIGNALS, signals.T, strict=True))
    by_name |= {"y_psd2_mm": 100.0 * tilt[:, 0], "z_psd2_mm": 100.0 * tilt[:, 1]}
    position = AT
    readings = SixDof(np.full(17, axis), position, np.ones(17, int), by_name, np.full(17, np.nan), np.zeros(17))
    (run,) = reduce_runs(readings, instrument, expected_away(machine, instrument))
    return printed_run(machine, readings, instrument, run), errors, run


@pytest.mark.parametrize("axis", [X, Y, Z])
def test_the_printed_straightness_of_mode_1_is_off_by_twice_the_crosstalk(axis):
    """T9: the print adds t eps where it has to be subtracted; angles agree, roll of Y and Z is turned."""
    found, errors, _ = printed(axis, 1)
    kappa = (1, -1, -1)[axis]
    horizontal, yaw = DIRECTIONS[axis][1], ROTATIONS[axis][0]
    excess = found.delta_mm[:, horizontal] - errors[:, horizontal]
    expected = 2.0 * kappa * GIVEN.reduced_depth_mm * errors[:, 3 + yaw]
    assert np.abs(excess - expected).max() <= 0.01 * UM
    assert np.abs(found.eps_rad[:, yaw] - errors[:, 3 + yaw]).max() <= 0.01 * ARCSEC
    roll = ROTATIONS[axis][2]
    sign = 1.0 if axis == X else -1.0
    assert np.abs(sign * found.eps_rad[:, roll] - errors[:, 3 + roll]).max() <= 0.01 * ARCSEC


@pytest.mark.parametrize("axis", [X, Y, Z])
def test_the_printed_straightness_of_mode_2_is_right(axis):
    found, errors, _ = printed(axis, 2)
    for k in DIRECTIONS[axis][1:]:
        assert np.abs(found.delta_mm[:, k] - errors[:, k]).max() <= 0.05 * UM


@pytest.mark.parametrize("axis", [X, Y, Z])
def test_the_printed_drift_of_the_angles_is_twice_too_large(axis):
    drift = np.random.default_rng(3).normal(size=(17, 2)) * ARCSEC
    with_drift, errors, _ = printed(axis, 1, drift=drift)
    yaw = ROTATIONS[axis][0]
    excess = with_drift.eps_rad[:, yaw] - errors[:, 3 + yaw]
    assert np.abs(np.abs(excess) - np.abs(0.5 * (drift - drift[0])[:, 0])).max() <= 0.01 * ARCSEC


def test_the_print_knows_one_beam_direction_only():
    machine = machine_of()
    readings = readings_of(machine, truth_of(), instrument_of((1, 1, 1)))
    instrument = dataclasses.replace(
        instrument_of((1, 1, 1)), axes={0: AxisSetUp(SetUp(0, 2, -1), 100.0)}, as_printed=True
    )
    part = dataclasses.replace(
        readings,
        axis=readings.axis[:17],
        position_mm=AT,
        run=readings.run[:17],
        signals_mm={name: values[:17] for name, values in readings.signals_mm.items()},
        distance_mm=readings.distance_mm[:17],
        direction=readings.direction[:17],
        covariates={},
    )
    with pytest.raises(InputError, match="beam_direction = 1"):
        axis_runs(machine, part, instrument)


# --- interferometer -------------------------------------------------------------------------------------------------


def in_air(readings, celsius, hpa, percent):
    """The phase that the interferometer counts: 4 pi / lambda times the change of index times distance."""
    n = refractive_index(celsius, hpa, percent)
    phase = np.empty(len(readings))
    for axis, _, rows in readings.runs():
        ahead = 100.0 + (GIVEN.prism_leg_mm if axis == Z else 0.0)
        distance = (
            ahead + readings.signals_mm["displacement_mm"][rows] - readings.signals_mm["displacement_mm"][rows[0]]
        )
        phase[rows] = 4 * np.pi / 632.9913e-6 * (n[rows] * distance - n[rows[0]] * ahead)
    return phase


def test_a_phase_in_changing_air_gives_the_true_displacement():
    machine, truth, instrument = machine_of(), truth_of(), instrument_of((1, 1, 1))
    readings = readings_of(machine, truth, instrument)
    count = np.linspace(0.0, 1.0, len(readings))
    celsius, hpa, percent = 22.0 + 1.5 * count, 1000.0 + 5.0 * count, 40.0 + 10.0 * count
    phase = in_air(readings, celsius, hpa, percent)
    air = {"temp_ambient_c": celsius, "pressure_hpa": hpa, "humidity_percent": percent, "phase_rad": phase}
    nothing = {**readings.signals_mm, "displacement_mm": np.full(len(readings), np.nan)}
    found, notes = compensated(dataclasses.replace(readings, signals_mm=nothing, covariates=air), instrument)
    assert notes["wavelength"]["from_phase"] is True
    for _, _, rows in readings.runs():
        true = readings.signals_mm["displacement_mm"][rows]
        assert np.abs(found.signals_mm["displacement_mm"][rows] - true + true[0]).max() <= 1e-6


def test_an_uncompensated_displacement_is_scaled_with_the_index():
    """1 hPa less is 0.27 ppm more length: at 1003.25 hPa the reading is 2.7 ppm short, 2.1 um over 800 mm."""
    machine, truth, instrument = machine_of(), truth_of(), instrument_of((1, 1, 1))
    readings = readings_of(machine, truth, instrument)
    air = {"temp_ambient_c": np.full(len(readings), 20.0), "pressure_hpa": np.full(len(readings), 1003.25)}
    plain = dataclasses.replace(readings, covariates=air, metadata={"wavelength_compensated": "false"})
    found, _ = compensated(plain, instrument)
    travel = found.signals_mm["displacement_mm"][16] - readings.signals_mm["displacement_mm"][16]
    assert travel == pytest.approx(2.7e-6 * 800.0, rel=0.03)
    missing = dataclasses.replace(plain, covariates={})
    with pytest.raises(InputError, match="temp_ambient_c"):
        compensated(missing, instrument)


def test_a_warm_scale_is_brought_to_20_degrees():
    """11.5 um/(m K) at 23 degC: 27.6 um over 800 mm, on top of EXX."""
    machine, warm = machine_of(), machine_of(expansion=11.5)
    truth, instrument = truth_of(), instrument_of((1, 1, 1))
    readings = readings_of(machine, truth, instrument)
    heated = dataclasses.replace(readings, covariates={"temp_x_c": np.full(len(readings), 23.0)})
    cold = evaluate_readings(machine, readings, instrument).errors.curves["EXX"].value
    found = evaluate_readings(warm, heated, instrument).errors.curves["EXX"].value
    assert np.abs(cold - found - 11.5e-6 * 3.0 * AT).max() <= 1e-9


def test_a_file_with_a_phase_is_read_and_one_with_neither_or_both_is_refused(tmp_path):
    head = "axis,position_mm,run,y_qd1_mm,z_qd1_mm,z_qd2_mm,y_psd1_mm,z_psd1_mm,y_psd2_mm,z_psd2_mm"
    rows = ["X,0,1,0,0,0,0,0,0,0", "X,100,1,0,0,0,0,0,0,0"]
    cases = {
        "phase": (",phase_rad", ["0", "2000000"]),
        "none": ("", ["", ""]),
        "both": (",phase_rad,displacement_mm", ["0,0", "1,1"]),
    }
    for name, (columns, cells) in cases.items():
        lines = [
            head + columns,
            *(row + ("," + cell if columns else "") for row, cell in zip(rows, cells, strict=True)),
        ]
        (tmp_path / f"{name}.sixdof.csv").write_text("\n".join(lines) + "\n")
    assert read_sixdof(tmp_path / "phase.sixdof.csv").covariates["phase_rad"].tolist() == [0.0, 2e6]
    for name, text in (("none", "neither"), ("both", "both")):
        with pytest.raises(InputError, match=text):
            read_sixdof(tmp_path / f"{name}.sixdof.csv")


def test_the_linear_part_of_the_systematics_is_what_the_classification_says():
    at = np.array([100.0, 900.0])
    for name, constant in (("delta_yic", True), ("eps_zic", True), ("eps_zmc1", False), ("eps_PEy", False)):
        column = systematic_signals(GIVEN, SetUp(X), at, {name: 1.0})
        assert bool(np.ptp(column, axis=0).max() <= 1e-9) is constant


def test_the_truth_of_the_example_has_all_21_errors():
    assert len(read_errors(EXAMPLES / "jia-xytz.truth.errors.csv").names) == 21
