"""Raw signals of the exact ray tracer on an exactly moved machine become its 21 errors, on every chain and in both modes."""

import dataclasses
import warnings

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable, fitted_line
from compgen.data.machine import Axis, Chain, Machine
from compgen.data.names import ERRORS, error_named
from compgen.errors import CompgenWarning
from compgen.instruments.sixdof_evaluation import evaluate
from compgen.instruments.sixdof_instrument import (
    SIGNALS,
    AxisSetUp,
    Optics,
    SetUp,
    SixDof,
    SixDofInstrument,
    known_systematics,
)
from compgen.instruments.sixdof_reduction import errors_of_run, expected_away, reduce_runs
from compgen.simulation.sixdof import Tracer, run_signals

ARCSEC = np.pi / 648000
UM = 1e-3
SQUARENESS = {"EC0Y": 5 * ARCSEC, "EB0Z": -7 * ARCSEC, "EA0Z": 35 * ARCSEC}
#: What is asked of the whole way, without noise.
STRAIGHTNESS_UM, ANGLE_ARCSEC = 0.05, 0.02


def axis(low, high):
    return Axis((low, high), np.linspace(low, high, 17))


def machine_of(chain):
    axes = (axis(-300, 500), axis(0, 600), axis(-400, 0))
    return Machine("six", Chain(chain), axes, reference_point_mm=(0.0, 100.0, -50.0))


def truth_of(machine, rng):
    """Smooth errors of some 10 um and 10 arcsec, zero at the reference point, lines and offsets in them."""
    curves = {}
    for error in ERRORS[:18]:
        nodes = machine.axes[error.axis].nodes_mm
        scale = 5 * UM if error.kind == "linear" else 4.5 * ARCSEC
        value = np.polynomial.legendre.legval(np.linspace(-1, 1, 17), rng.normal(size=5)) * scale
        value -= np.interp(machine.reference_point_mm[error.axis], nodes, value)
        curves[error.name] = Curve(nodes, value, np.full(17, np.nan))
    return ErrorTable(curves, {name: (value, np.nan) for name, value in SQUARENESS.items()})


def instrument_of(machine, modes, rng, beam_direction=1):
    systematics = {
        n: rng.uniform(-1, 1) * (8 * ARCSEC if n.startswith("eps") else 20 * UM) for n in known_systematics()
    }
    axes = {
        k: AxisSetUp(
            SetUp(k, modes[k], beam_direction),
            120.0,
            (40.0, 250.0, -120.0),
            (10.0, -20.0, -150.0),
            {n: v for n, v in systematics.items() if n in known_systematics(k)},
        )
        for k in range(3)
    }
    instrument = SixDofInstrument(Optics(), axes)
    for k, away in expected_away(machine, instrument).items():
        if away * beam_direction < 0:  # unit and target approach each other
            axes[k] = dataclasses.replace(axes[k], distance_first_mm=1000.0)
    return SixDofInstrument(Optics(), axes)


def readings_of(machine, truth, instrument, rng):
    """One run of each axis with a drift of the beam of 1.5 arcsec."""
    parts = []
    for k in range(3):
        at = machine.axes[k].nodes_mm
        drift = rng.normal(size=(len(at), 2)) * 1.5 * ARCSEC
        parts.append((np.full(len(at), k), at, run_signals(machine, truth, instrument, k, at, drift), drift))
    number, at, signals, drift = (np.concatenate(column) for column in zip(*parts, strict=True))
    monitor = instrument.optics.focal_length_mm * drift
    by_name = dict(zip(SIGNALS, signals.T, strict=True)) | {"y_psd2_mm": monitor[:, 0], "z_psd2_mm": monitor[:, 1]}
    return SixDof(number, at, np.ones(len(at), int), by_name, np.full(len(at), np.nan), np.zeros(len(at)))


def evaluated(machine, instrument, readings):
    runs = reduce_runs(readings, instrument, expected_away(machine, instrument))
    return evaluate(machine, instrument, [errors_of_run(machine, instrument, run) for run in runs])


def without_line(machine, name, curve):
    """Straightness without its least-squares line, zero at the reference point; other errors as they are."""
    error, value = error_named(name), curve.value
    if error.is_straightness:
        constant, slope = fitted_line(curve.position_mm, value)
        value = value - constant - slope * curve.position_mm
    return value - np.interp(machine.reference_point_mm[error.axis], curve.position_mm, value)


def expected_squareness(truth):
    """Squareness between the least-squares lines: what the lines held moves into it."""

    def slope(name):
        curve = truth.curves[name]
        return fitted_line(curve.position_mm, curve.value)[1]

    return {
        "EC0Y": SQUARENESS["EC0Y"] - slope("EYX") - slope("EXY"),
        "EB0Z": SQUARENESS["EB0Z"] + slope("EZX") + slope("EXZ"),
        "EA0Z": SQUARENESS["EA0Z"] - slope("EZY") - slope("EYZ"),
    }


CHAINS = ["WFXYZT", "WXYFZT", "WYFXZT", "WZXYFT", "WXFZYT"]


@pytest.mark.parametrize("chain", CHAINS)
@pytest.mark.parametrize("modes", [(1, 1, 1), (2, 2, 2), (2, 2, 1)])
@pytest.mark.parametrize("beam_direction", [1, -1])
def test_the_21_errors_come_back_with_all_systematics_and_drift_on(chain, modes, beam_direction):
    rng = np.random.default_rng([CHAINS.index(chain), *modes])
    machine = machine_of(chain)
    truth, instrument = truth_of(machine, rng), instrument_of(machine, modes, rng, beam_direction)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = evaluated(machine, instrument, readings_of(machine, truth, instrument, rng)).errors
    assert len(found.names) == 21
    for name, curve in found.curves.items():
        limit = STRAIGHTNESS_UM * UM if error_named(name).kind == "linear" else ANGLE_ARCSEC * ARCSEC
        assert np.abs(curve.value - without_line(machine, name, truth.curves[name])).max() <= limit, name
    for name, value in expected_squareness(truth).items():
        assert abs(found.squareness[name][0] - value) <= ANGLE_ARCSEC * ARCSEC, name


def test_a_coordinate_that_contradicts_the_chain_is_taken_for_the_moving_body_and_said():
    """The paper's own picture: the unit moves by +q with its errors, whatever side of the machine it rides on."""
    rng = np.random.default_rng(9)
    machine = machine_of("WXYFZT")
    truth = truth_of(machine, rng)
    instrument = SixDofInstrument(Optics(), {0: AxisSetUp(SetUp(0, 2, 1), 1000.0)})
    at = machine.axes[0].nodes_mm
    values = truth.at(np.column_stack([at, at, at]))[:, :6]
    tracer = Tracer(Optics(), 0, 2)
    signals = np.array(
        [tracer.signals(1000.0, v[:3], v[3:], travel_mm=q - at[0]) for q, v in zip(at, values, strict=True)]
    )
    by_name = dict(zip(SIGNALS, signals.T, strict=True)) | {"y_psd2_mm": np.zeros(17), "z_psd2_mm": np.zeros(17)}
    readings = SixDof(np.zeros(17, int), at, np.ones(17, int), by_name, np.full(17, np.nan), np.zeros(17))
    with pytest.warns(CompgenWarning, match="contradicts mode 2"):
        found = evaluated(machine, instrument, readings).errors
    for name, curve in found.curves.items():
        limit = STRAIGHTNESS_UM * UM if error_named(name).kind == "linear" else ANGLE_ARCSEC * ARCSEC
        assert np.abs(curve.value - without_line(machine, name, truth.curves[name])).max() <= limit, name


def test_the_minimum_zone_line_beats_every_other_line():
    rng = np.random.default_rng(2)
    at, value = np.sort(rng.uniform(0, 800, 15)), rng.normal(size=15)
    constant, slope = fitted_line(at, value, "minzone")
    width = np.abs(value - constant - slope * at).max()
    for _ in range(2000):
        other = value - (constant + rng.normal() * 0.1) - (slope + rng.normal() * 1e-4) * at
        assert np.abs(other).max() >= width - 1e-12
    linear = 3.0 + 0.01 * at
    assert fitted_line(at, linear, "minzone") == pytest.approx((3.0, 0.01), abs=1e-12)
