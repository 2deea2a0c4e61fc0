"""The six-DOF instrument: the linear model against hand-worked coefficients and against the exact ray tracer."""

import numpy as np
import pytest

from compgen.instruments.sixdof_instrument import (
    DIRECTIONS,
    ROLES,
    ROTATIONS,
    SIGNALS,
    Optics,
    SetUp,
    drift_matrix,
    error_matrix,
    solve_errors,
    systematic_columns,
    systematic_signals,
)
from compgen.simulation.sixdof import Tracer

RAD_PER_ARCSEC = np.pi / 648000
ARCSEC, UM = RAD_PER_ARCSEC, 1e-3
#: Constants for which the coefficients were worked out independently; L = 400 mm.
GIVEN = Optics(100.0, 30.0, 1.5151, 30.0, 3.0, 25.4, 0.0)
AT_400 = np.array([400.0])
COEFFICIENT = 2e-5  # of a coefficient: central differences of the tracer against the linear model
X, Y, Z = range(3)


def coefficient(axis, mode, role, signal):
    return error_matrix(GIVEN, SetUp(axis, mode), AT_400)[0, SIGNALS.index(signal), ROLES.index(role)]


@pytest.mark.parametrize(
    ("axis", "mode", "role", "expected"),
    [
        (X, 1, "yaw", {"y_qd1_mm": 20.127, "y_psd1_mm": -200.0}),
        (X, 2, "yaw", {"y_qd1_mm": -820.127, "y_psd1_mm": 200.0}),
        (X, 1, "roll", {"z_qd2_mm": -60.0, "z_qd1_mm": 0.0}),
        (X, 2, "roll", {"z_qd2_mm": 60.0}),
        (Y, 1, "pitch", {"z_qd1_mm": 20.127, "z_psd1_mm": -200.0}),
        (Y, 2, "yaw", {"y_qd1_mm": 845.527, "y_psd1_mm": -200.0}),
        (Z, 2, "pitch", {"z_qd1_mm": -845.527, "z_psd1_mm": 200.0}),
        (Y, 1, "roll", {"z_qd2_mm": 60.0}),
        (Z, 1, "roll", {"z_qd2_mm": 60.0}),
    ],
)
def test_coefficients_of_the_errors_are_the_traced_ones(axis, mode, role, expected):
    for signal, value in expected.items():
        assert coefficient(axis, mode, role, signal) == pytest.approx(value, abs=6e-4)


@pytest.mark.parametrize(
    ("axis", "name", "expected"),
    [
        (Y, "eps_zir", {"y_qd1_mm": 1699.184, "y_psd1_mm": -400.0}),
        (Y, "eps_yir", {"z_qd1_mm": -828.256, "z_qd2_mm": -888.256, "z_psd1_mm": 200.0}),
        (Y, "eps_zmrs1", {"y_qd1_mm": -439.718, "y_psd1_mm": 103.02}),
        (Y, "eps_zmrs2", {"y_qd1_mm": -422.448, "y_psd1_mm": 103.02}),
        (Z, "eps_yir", {"z_qd1_mm": -1716.455, "z_psd1_mm": 400.0}),
        (X, "eps_PEy", {"z_qd2_mm": 820.127, "z_psd1_mm": -100.0}),
        (Y, "eps_PEy", {"z_qd2_mm": 853.656, "z_psd1_mm": -100.0}),
        (Z, "eps_PEy", {"z_qd2_mm": 870.927, "z_psd1_mm": -100.0}),
    ],
)
def test_coefficients_of_the_systematics_are_the_traced_ones(axis, name, expected):
    column = systematic_columns(GIVEN, SetUp(axis), AT_400)[name][0]
    for signal, value in expected.items():
        assert column[SIGNALS.index(signal)] == pytest.approx(value, abs=6e-4)


@pytest.mark.parametrize(("axis", "value"), [(X, -820.127), (Y, -853.656), (Z, -870.927)])
def test_a_tilt_of_the_beams_moves_both_spots_alike(axis, value):
    matrix = drift_matrix(GIVEN, SetUp(axis), AT_400)[0]
    assert matrix[SIGNALS.index("y_qd1_mm"), 0] == pytest.approx(value, abs=6e-4)
    assert matrix[SIGNALS.index("y_qd2_mm"), 0] == pytest.approx(value, abs=6e-4)
    assert matrix[SIGNALS.index("y_psd1_mm"), 0] == 100.0


def random_optics(rng):
    low, high = [50, 20, 1.45, 20, 1, 15, 0], [200, 50, 1.8, 40, 6, 40, 60]
    return Optics(*rng.uniform(low, high))


CASES = [(axis, mode, direction) for axis in range(3) for mode in (1, 2) for direction in (1, -1)]


@pytest.mark.parametrize(("axis", "mode", "direction"), CASES)
@pytest.mark.parametrize("seed", [None, 3])
def test_the_linear_model_is_the_derivative_of_the_ray_tracer(axis, mode, direction, seed):
    optics = GIVEN if seed is None else random_optics(np.random.default_rng(seed))
    set_up = SetUp(axis, mode, direction)
    for distance in (100.0, 800.0):
        at = np.array([distance])

        def derivative(trace, step):
            return (trace(step) - trace(-step)) / (2 * step)

        plain, none = Tracer(optics, axis, mode, direction), np.zeros(3)
        matrix = error_matrix(optics, set_up, at)[0]
        for k in range(6):
            unit = np.eye(3)[DIRECTIONS[axis][k] if k < 3 else ROTATIONS[axis][k - 3]]
            if k < 3:
                found = derivative(lambda h, unit=unit: plain.signals(distance, h * unit, none), 1e-3)  # noqa: B023
            else:
                found = derivative(lambda h, unit=unit: plain.signals(distance, none, h * unit), 1e-6)  # noqa: B023
            assert np.abs(found - matrix[:, k]).max() <= COEFFICIENT * max(1.0, np.abs(found).max())
        drift = drift_matrix(optics, set_up, at)[0]
        for k in range(2):
            tilt = np.eye(2)[k]
            found = derivative(lambda h, tilt=tilt: plain.signals(distance, none, none, drift_rad=h * tilt), 1e-6)  # noqa: B023
            assert np.abs(found - drift[:, k]).max() <= COEFFICIENT * np.abs(found).max()
        for name, column in systematic_columns(optics, set_up, at).items():
            step = 1e-6 if name.startswith("eps") else 1e-3
            found = derivative(
                lambda h, name=name: Tracer(optics, axis, mode, direction, {name: h}).signals(distance, none, none),  # noqa: B023
                step,
            )
            assert np.abs(found - column[0]).max() <= COEFFICIENT * max(1.0, np.abs(found).max()), name


def slope_um(axis, name, angle_arcsec, signal):
    ends = [
        Tracer(GIVEN, axis, 1, 1, {name: angle_arcsec * ARCSEC}).signals(distance, np.zeros(3), np.zeros(3))
        for distance in (0.0, 800.0)
    ]
    return (ends[1] - ends[0])[SIGNALS.index(signal)] / UM


@pytest.mark.parametrize(
    ("axis", "name", "arcsec", "signal", "change_um"),
    [
        (Y, "eps_zir", 3.6, "y_qd1_mm", 55.851),
        (Y, "eps_xir", 3.6, "z_qd1_mm", -27.925),
        (Z, "eps_xir", 3.6, "y_qd1_mm", 27.925),
        (Z, "eps_yir", 3.6, "z_qd1_mm", -55.851),
        (Y, "eps_zmrs1", 10.8, "y_qd1_mm", -43.153),
        (Y, "eps_ymrs1", 10.8, "z_qd1_mm", 43.153),
    ],
)
def test_prism_errors_change_the_spots_over_800_mm_as_equations_8_to_10_of_jia_say(
    axis, name, arcsec, signal, change_um
):
    assert slope_um(axis, name, arcsec, signal) == pytest.approx(change_um, abs=1e-3)


@pytest.mark.parametrize(("axis", "mode", "direction"), CASES)
def test_errors_come_back_from_their_own_signals(axis, mode, direction):
    rng = np.random.default_rng(7)
    set_up, distance = SetUp(axis, mode, direction), np.linspace(50, 850, 17)
    errors = rng.normal(size=(17, 6)) * [5e-3, 5e-3, 5e-3, 5e-5, 5e-5, 5e-5]
    signals = np.einsum("nij,nj->ni", error_matrix(GIVEN, set_up, distance), errors)
    assert np.abs(solve_errors(GIVEN, set_up, distance, signals) - errors).max() <= 1e-12


@pytest.mark.parametrize(("axis", "mode", "direction"), CASES)
def test_small_systematics_all_at_once_leave_the_linear_model_within_its_stated_bounds(axis, mode, direction):
    """All angles within 10 arcsec, offsets within 20 um, L up to 1 m: spots to 0.03 um, angles to 0.003 arcsec."""
    rng = np.random.default_rng(11)
    set_up, at = SetUp(axis, mode, direction), np.array([950.0])
    names = systematic_columns(GIVEN, set_up, at)
    values = {n: rng.uniform(-1, 1) * (10 * ARCSEC if n.startswith("eps") else 20 * UM) for n in names}
    traced = Tracer(GIVEN, axis, mode, direction, values).signals(950.0, np.zeros(3), np.zeros(3))
    linear = systematic_signals(GIVEN, set_up, at, values)[0]
    assert np.abs(traced - linear)[1:5].max() <= 0.03 * UM
    assert np.abs(traced - linear)[5:].max() / (2 * GIVEN.focal_length_mm) <= 0.003 * ARCSEC
