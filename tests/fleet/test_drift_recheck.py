"""The shortest re-check: its information against dense algebra on lengths, its power against drawn readings."""

import numpy as np
import pytest

from compgen.data.error_table import Curve, ErrorTable
from compgen.errors import InputError
from compgen.fleet.recheck import power_of, shortest_recheck
from compgen.fleet.records import RequestedChange
from compgen.identification import IdentifyOptions
from compgen.identification.covariance import Covariance
from compgen.kinematics.first_order import modelled_errors
from compgen.kinematics.many_points import volumetric_error
from compgen.planning import planned_stations

UM, URAD = 1e-3, 1e-6
SIGMA_UM = 0.5
NOISE = IdentifyOptions(u_length_um=SIGMA_UM, u_length_um_per_m=0.0)
PLACES = {
    "A": [-420.0, -210.0, -420.0],
    "B": [330.0, -190.0, -405.0],
    "C": [310.0, 410.0, -415.0],
    "D": [-400.0, 430, -90],
}
STATIONS = planned_stations(PLACES)


def lengths(machine, position_mm, errors=None, places=None):
    """Readings without constants: distances of the tool tip from the stations, one after another."""
    tip = position_mm + np.array(machine.tool_offset_mm)
    tip = tip if errors is None else tip + volumetric_error(machine, errors, position_mm)
    where = np.array(list(PLACES.values())) if places is None else places
    return np.concatenate([np.linalg.norm(tip - place, axis=1) for place in where])


def nuisances(machine, position_mm):
    """Derivatives of the readings by station places and dead lengths, by differences."""
    places, columns = np.array(list(PLACES.values())), []
    for k in range(places.size):
        step = np.zeros(places.size)
        step[k] = 1e-3
        ends = [lengths(machine, position_mm, places=places + s * step.reshape(-1, 3)) for s in (1, -1)]
        columns.append((ends[0] - ends[1]) / 2e-3)
    dead = np.kron(np.eye(len(places)), np.ones((len(position_mm), 1)))
    return np.column_stack([*columns, dead])


def column(machine, position_mm, errors):
    """Derivative of the readings along a small change of the errors."""
    return lengths(machine, position_mm, errors) - lengths(machine, position_mm)


def left_over(target, others, spread):
    """Standard uncertainty of the factor of ``target`` beside ``others`` under a covariance of the readings."""
    root = np.linalg.cholesky(spread)
    rest = np.linalg.solve(root, others)
    white = np.linalg.solve(root, target)
    white = white - rest @ np.linalg.lstsq(rest, white, rcond=1e-11)[0]
    return 1.0 / np.sqrt(white @ white)


def test_the_uncertainty_is_that_of_least_squares_on_lengths(small_machine):
    found = shortest_recheck(small_machine, STATIONS, RequestedChange("EC0Y", 5 * URAD), options=NOISE)
    change = ErrorTable({}, {"EC0Y": (1e-4, 0.0)})
    target = column(small_machine, found.position_mm, change) / 1e-4
    spread = np.eye(len(target)) * (SIGMA_UM * UM) ** 2
    u = left_over(target, nuisances(small_machine, found.position_mm), spread)
    assert found.u == pytest.approx(u, rel=1e-3)
    assert found.readings == 4 * len(found.position_mm)
    assert found.power >= 0.9 and found.smallest <= 5 * URAD


def test_the_covariance_of_the_last_calibration_counts(small_machine):
    names = [name for name in modelled_errors(small_machine) if len(name) == 4 and "0" in name]
    curves = [name for name in modelled_errors(small_machine) if name not in names]
    error, position = [], []
    for name in curves:
        nodes = small_machine.axes["XYZ".index(name[2])].nodes_mm
        error += [name] * len(nodes)
        position.append(nodes)
    error, position = (*error, *names), np.append(np.concatenate(position), [np.nan] * len(names))
    # only EXX and EB0Z are uncertain: EXX as a line from the reference point, EB0Z by itself
    factor = np.zeros((len(error), 2))
    rows = [k for k, name in enumerate(error) if name == "EXX"]
    factor[rows, 0] = 2e-5 * (position[rows] - small_machine.reference_point_mm[0])
    factor[error.index("EB0Z"), 1] = 8e-6
    noise = 1e-9 * np.eye(len(error))  # the others are known to a picometre
    covariance = Covariance(error, position, (), np.zeros(0, dtype=np.int64), np.hstack([factor, noise]))
    found = shortest_recheck(small_machine, STATIONS, RequestedChange("EC0Y", 12 * URAD), covariance, NOISE)
    where = found.position_mm
    nodes = small_machine.axes[0].nodes_mm
    line = Curve(nodes, 1e-5 * (nodes - small_machine.reference_point_mm[0]), np.zeros(len(nodes)))
    known = [
        column(small_machine, where, ErrorTable({"EXX": line})) * 2.0,
        column(small_machine, where, ErrorTable({}, {"EB0Z": (1e-5, 0.0)})) * 0.8,
    ]
    target = column(small_machine, where, ErrorTable({}, {"EC0Y": (1e-4, 0.0)})) / 1e-4
    spread = np.eye(len(target)) * (SIGMA_UM * UM) ** 2 + sum(np.outer(each, each) for each in known)
    assert found.u == pytest.approx(left_over(target, nuisances(small_machine, where), spread), rel=2e-3)


def test_the_power_is_the_share_of_drawn_changes_that_are_seen():
    drawn = np.random.default_rng(1).normal(3.0, 1.0, 200_000)
    assert power_of(3.0, 1.0, 0.95) == pytest.approx(np.mean(np.abs(drawn) > 1.959964), abs=0.004)
    assert power_of(1e-9, 1.0, 0.95) == pytest.approx(0.05)


def test_a_smaller_change_needs_more_points_and_no_point_is_idle(small_machine):
    easy, hard = (
        shortest_recheck(small_machine, STATIONS, RequestedChange("EC0Y", size * URAD), options=NOISE)
        for size in (20, 4)
    )
    assert len(easy.position_mm) < len(hard.position_mm)
    assert easy.power >= 0.9 <= hard.power
    line = shortest_recheck(small_machine, STATIONS, RequestedChange("EXX", 5 * UM), options=NOISE)
    assert line.summary()["unit"] == "um" and line.power >= 0.9


@pytest.mark.parametrize(
    ("wanted", "text"),
    [
        (RequestedChange("EC0Y", -1.0), "give a positive one"),
        (RequestedChange("EC0Y", 1e-5, power=0.01), "is not a test"),
        (RequestedChange("ECZ", 1e-5), "is not in the model"),
        (RequestedChange("EC0Y", 1e-9), "ask for a larger change"),
    ],
)
def test_what_cannot_be_is_said(small_machine, wanted, text, monkeypatch):
    monkeypatch.setattr("compgen.fleet.recheck.MOST_POINTS", 9)
    with pytest.raises(InputError, match=text):
        shortest_recheck(small_machine, STATIONS, wanted, options=NOISE)
