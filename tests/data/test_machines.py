"""The shipped machine files: every one loads, is what its source says, and models 17 errors with one tool."""

from pathlib import Path

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Machine, load_machine, machine_files, read_machine
from compgen.data.names import CURVE_NAMES, ERROR_NAMES, SQUARENESS_NAMES, error_named
from compgen.kinematics import exact_error, modelled_errors, observable_errors, volumetric_error

FOLDER = Path(__file__).parents[2] / "machines"
FILES = sorted(FOLDER.glob("*.toml"))
ROUNDING_MM = 1e-12  # double precision over a metre


@pytest.fixture(params=FILES, ids=lambda path: path.stem)
def path(request: pytest.FixtureRequest) -> Path:
    return request.param


@pytest.fixture
def machine(path: Path) -> Machine:
    return read_machine(path)


def corners_and_middle(machine: Machine) -> np.ndarray:
    ends = [(*axis.range_mm, sum(axis.range_mm) / 2) for axis in machine.axes]
    return np.array(np.meshgrid(*ends)).reshape(3, -1).T


def zero_table(machine: Machine) -> ErrorTable:
    curves = {}
    for name in CURVE_NAMES:
        nodes = machine.axes[error_named(name).axis].nodes_mm
        curves[name] = Curve(nodes, np.zeros(len(nodes)), np.full(len(nodes), np.nan))
    return ErrorTable(curves, dict.fromkeys(SQUARENESS_NAMES, (0.0, np.nan)))


def test_the_three_machines_are_there():
    assert {"zha-gantry", "moving-table-mill", "jia-xytz"} <= {path.stem for path in FILES}


def test_the_folder_holds_data_only():
    assert not list(FOLDER.rglob("*.py"))


def test_a_machine_bears_the_name_of_its_file_and_is_found_by_it(path):
    assert machine_files()[path.stem] == path
    assert load_machine(path.stem).source == path


def test_every_number_of_an_axis_stands_beside_its_source(path):
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith(("range_mm", "expansion_um_per_m_k", "screw_pitch_mm", "chain", "tool_offset_mm")):
            assert "#" in line, line


def test_zero_errors_give_zero_displacement_everywhere(machine):
    points, zero = corners_and_middle(machine), zero_table(machine)
    for tool in (None, np.array([12.0, -7.0, -150.0])):
        assert np.array_equal(volumetric_error(machine, zero, points, tool), np.zeros_like(points))
        assert np.abs(exact_error(machine, zero, points, tool)).max() < ROUNDING_MM


def test_one_tool_shows_seventeen_errors(machine):
    assert len(observable_errors(machine)) == 17
    assert modelled_errors(machine) == observable_errors(machine)


def test_nodes_span_the_travel_and_hold_the_reference_point(machine):
    for axis, reference_mm in zip(machine.axes, machine.reference_point_mm, strict=True):
        assert (axis.nodes_mm[0], axis.nodes_mm[-1]) == axis.range_mm
        assert reference_mm in axis.nodes_mm


def test_the_gantry_is_that_of_zha_and_zhang():
    machine = load_machine("zha-gantry")
    assert machine.chain.name == "WFYXZT"
    assert [axis.range_mm for axis in machine.axes] == [(-800, 0), (-1000, 0), (-350, 0)]
    assert [np.diff(axis.nodes_mm) for axis in machine.axes] == [
        pytest.approx([80] * 10),
        pytest.approx([100] * 10),
        pytest.approx([35] * 10),
    ]
    assert set(ERROR_NAMES) - set(observable_errors(machine)) == {"ECX", "EAZ", "EBZ", "ECZ"}
    assert machine.squareness_reference == "X"


def test_the_gantry_carries_the_settings_that_its_exports_need():
    machine = load_machine("zha-gantry")
    cec = machine.controller_settings("siemens-cec")
    assert (cec.data["sign"], cec.data["mult_mode"]) == ("error", "S1")
    assert machine.controller_settings("fanuc-pitch").data["detection_unit_um"] == 1.0


@pytest.mark.parametrize("name", ["moving-table-mill", "jia-xytz"])
def test_machines_with_x_on_y_and_a_spindle_on_z_hide_ecy_and_the_angles_of_z(name):
    machine = load_machine(name)
    assert machine.chain.name == "WXYFZT"
    assert set(ERROR_NAMES) - set(observable_errors(machine)) == {"ECY", "EAZ", "EBZ", "ECZ"}
    assert (machine.lower_mm == 0).all()


def test_on_a_moving_table_the_yaw_of_x_acts_through_the_travel_of_both_table_axes():
    # ECX turns the table: lever (X, Y, .), so dX = -Y ECX and dY = +X ECX at machine positions X, Y
    machine = load_machine("moving-table-mill")
    yaw_rad = 20e-6
    constant = Curve(np.array([0.0, 600.0]), np.full(2, yaw_rad), np.full(2, np.nan))
    error = volumetric_error(machine, ErrorTable({"ECX": constant}), np.array([[300.0, 200.0, 100.0]]))
    assert error[0] == pytest.approx([-200 * yaw_rad, 300 * yaw_rad, 0.0], abs=ROUNDING_MM)
