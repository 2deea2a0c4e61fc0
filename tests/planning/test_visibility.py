"""What plans see of the effects: against dense projections, and facts that are known beforehand."""

import json
from dataclasses import replace

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.lengths import Points
from compgen.data.machine import Axis, load_machine
from compgen.effects.all_effects import alike_pairs, visible_parts
from compgen.planning import plan_visibility, planned, planned_noise, planned_stations
from compgen.planning.prediction import _gram, _readings

PLACES = {
    "A": [400.0, -1900.0, 50.0],
    "B": [-700.0, -1800.0, 100.0],
    "C": [900.0, 700.0, -150.0],
    "D": [-100.0, 1300.0, 600.0],
}
#: Share of a direction that counts as nothing: rounding of a Gram matrix, by its root.
NOTHING = 1e-3


@pytest.fixture(scope="module")
def machine():
    gantry = load_machine("zha-gantry")
    pitches = (10.0, 10.0, None)
    axes = tuple(
        Axis(a.range_mm, np.linspace(*a.range_mm, 5), None, p) for a, p in zip(gantry.axes, pitches, strict=True)
    )
    return replace(gantry, axes=axes)


def visible(machine, points):
    found = planned(machine, planned_stations(PLACES), points, planned_noise(None))
    return plan_visibility(found, points)


def serpentine(machine, jitter=0.0, runs=2):
    """A grid there and back, with random shifts of the points."""
    rng = np.random.default_rng(2)
    grid = np.stack(np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij"), axis=-1).reshape(-1, 3)
    passes = [grid if k % 2 == 0 else grid[::-1] for k in range(runs)]
    points = np.concatenate([p + jitter * rng.uniform(-1, 1, p.shape) for p in passes])
    return np.clip(points, machine.lower_mm, machine.upper_mm)


def test_parts_and_pairs_follow_from_dense_projections():
    rng = np.random.default_rng(0)
    base, shared = rng.normal(size=(300, 12)), rng.normal(size=300)
    groups = {
        "a": np.column_stack([shared, rng.normal(size=300)]),
        "b": np.column_stack([shared + 0.1 * rng.normal(size=300) + 5.0 * base[:, 0], rng.normal(size=300)]),
        "hidden": base[:, :2] @ rng.normal(size=(2, 1)),
        "half": base[:, [3]] / np.linalg.norm(base[:, 3]) * 3.0 + rng.normal(size=(300, 1)) / np.sqrt(300.0) * 4.0,
    }
    everything = np.column_stack([base, *groups.values()])
    columns, start = {}, 0
    for name, group in groups.items():
        columns[name] = slice(start, start + group.shape[1])
        start += group.shape[1]
    gram = everything.T @ everything
    parts = visible_parts(gram, 12, columns)
    q, _ = np.linalg.qr(base)
    orthonormal = {}
    for name, group in groups.items():
        own, _ = np.linalg.qr(group)
        left = own - q @ (q.T @ own)
        singular = np.linalg.svd(left, compute_uv=False)
        assert abs(parts[name].fraction - np.sqrt(np.mean(singular**2))) < NOTHING, name
        orthonormal[name] = np.linalg.qr(left)[0]
    (pair,) = alike_pairs(gram, 12, parts)
    expected = np.linalg.svd(orthonormal["a"].T @ orthonormal["b"], compute_uv=False)
    assert pair.names == ("a", "b") and (pair.shared, pair.directions) == (1, 2)
    assert abs(pair.correlation - expected[0]) < NOTHING


def test_one_pass_at_one_feed_with_one_tool_on_the_pitch_hides_what_it_must(machine):
    found = visible(machine, Points(serpentine(machine, runs=1)))
    never = found.never
    assert {"lever_ECX", "lever_EAZ", "lever_EBZ", "lever_ECZ"} <= set(never)
    assert never["lever_ECX"] == "one tool offset" and never["tool_offset_error"] == "one set-up"
    assert {"laser_scale", "cosine_error_X", "periodic_X", "periodic_Y", "load_deflection", "backlash_X"} <= set(never)
    assert found.parts["laser_scale"].fraction < NOTHING
    assert not {"sign_EBX", "squareness_C0Y", "lever_EBX"} & {*never, *found.parts}


def test_both_directions_show_backlash_and_shifted_points_the_pitch(machine):
    found = visible(machine, Points(serpentine(machine, jitter=9.0)))
    assert not {"backlash_X", "backlash_Y", "periodic_X", "periodic_Y"} & set(found.never)
    assert "laser_scale" in found.never


def test_one_feed_cannot_tell_backlash_from_lag_and_two_feeds_can(machine):
    """Moves along one axis at a time: velocity is direction times feed."""
    where = serpentine(machine)
    one = visible(machine, Points(where))
    alike = {pair.names: pair for pair in one.pairs}
    assert alike["backlash_Z", "servo_lag_Z"].correlation > 0.95
    assert "feed" in next(
        entry["measure"] for entry in one.summary()["alike"] if entry["names"] == ["backlash_Z", "servo_lag_Z"]
    )
    twice, feeds = np.tile(where, (2, 1)), np.repeat([500.0, 4000.0], len(where))
    two = visible(machine, Points(twice, covariates={"feed_mm_min": feeds}))
    assert ("backlash_Z", "servo_lag_Z") not in {pair.names for pair in two.pairs}


def test_a_second_tool_shows_the_levers(machine):
    where = serpentine(machine)
    tools = np.repeat([[0.0, 0.0, -100.0], [60.0, 40.0, -200.0]], len(where), axis=0)
    setup = np.repeat([1.0, 2.0], len(where))
    found = visible(machine, Points(np.tile(where, (2, 1)), tools, covariates={"setup": setup}))
    assert not {"lever_ECX", "lever_EAZ", "tool_offset_error"} & set(found.hidden)


def test_the_base_jacobian_of_a_plan_is_that_of_its_adjustment(machine):
    points = Points(serpentine(machine, jitter=9.0))
    found = planned(machine, planned_stations(PLACES), points, planned_noise(None))
    gram, size, _ = _gram(found, _readings(found, points)[0], {})
    expected = found.normal_matrix(found.stations.position_mm)
    assert gram.shape == expected.shape == (size, size)
    scale = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    assert np.abs((gram - expected) / scale).max() < 1e-9


def test_the_plan_says_what_it_can_never_see(machine, tmp_path, capsys):
    stations = tmp_path / "stations.csv"
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in PLACES.items()]
    stations.write_text("\n".join(["station,x_mm,y_mm,z_mm", *rows]) + "\n")
    code = run_command(cli, ["plan", "zha-gantry", "--stations", str(stations), "--grid", "--out", str(tmp_path / "p")])
    said = " ".join(capsys.readouterr().out.split())
    assert code == 0 and "what this plan cannot show" in said and "one tool offset" in said
    report = json.loads((tmp_path / "p" / "plan.json").read_text())["visibility"]
    never = {entry["name"]: entry for entry in report["never"]}
    assert never["laser_scale"]["measure"].startswith("measure a calibrated length")
    assert "one feed" in report["assumed"]
