"""Diagnosis: the parts against brute force, and small measurements whose truth is written down here."""

import json
from dataclasses import replace

import numpy as np
import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data.axis_runs import AxisRuns, format_axis_runs
from compgen.data.deviations import Deviations
from compgen.data.lengths import Lengths, format_lengths
from compgen.data.machine import load_machine, read_machine
from compgen.diagnose import DiagnoseOptions, diagnose
from compgen.diagnose.any_diagnosis import observed_of
from compgen.diagnose.base_fit import first_basis, fit_base, least_norm, orthonormal
from compgen.diagnose.groups import fit_smooth
from compgen.diagnose.noise_model import (
    PRIOR,
    RemlPoint,
    away_from_zero,
    difference_matrix,
    fit_reml,
    kernels,
    noise_of,
    pieces_of,
    reml_problem,
    rotation,
    whitener,
)
from compgen.diagnose.observed import read_diagnosed
from compgen.errors import InputError
from compgen.kinematics.kernel_switch import one_thread

MICROMETRE = 1e-3
SIGMA_UM = 0.5
STATIONS_MM = np.array([[-1050, -1300, -380], [250, -1250, -200], [-1000, 300, -350], [150, 200, 250.0]])


@pytest.fixture(autouse=True)
def single_thread():
    with one_thread():
        yield


@pytest.fixture(scope="module")
def gantry():
    return load_machine("zha-gantry")


def session(seed, *, lines=14, displaced=None, tools=((0.0, 0.0, 0.0),), repeats=2):
    """Lengths of a perfect machine with two curves of degree 3, each line run twice in random order.

    ``displaced(q, approach, time)`` (n, 3) in mm is added to the tip.
    """
    rng = np.random.default_rng(seed)
    low, span = np.array([-800, -1000, -350.0]), np.array([800, 1000, 350.0])
    ends = []
    for k in range(lines):
        a, b = low + span * rng.uniform(0.05, 0.95, 3), low + span * rng.uniform(0.05, 0.95, 3)
        if k < 9:
            b = a.copy()
            a[k % 3], b[k % 3] = low[k % 3] + 5, low[k % 3] + span[k % 3] - 5
        ends.append((a, b) if rng.random() < 0.5 else (b, a))
    order = rng.permutation(
        [(line, repeat, s) for s in range(len(tools)) for line in range(lines) for repeat in range(repeats)]
    )
    order = order[np.argsort(order[:, 2], kind="stable")]
    share = np.linspace(0.02, 0.98, 6)
    q = np.concatenate([ends[line][0] + (ends[line][1] - ends[line][0]) * share[:, None] for line, _, _ in order])
    travel = np.sign(np.round(np.concatenate([[ends[line][1] - ends[line][0]] * 6 for line, _, _ in order]), 6))
    approach = np.ones_like(travel)
    for k in range(len(travel)):
        approach[k] = np.where(travel[k] != 0, travel[k], approach[k - 1] if k else 1.0)
    labels = np.repeat(order, 6, axis=0)
    tool = np.asarray(tools)[labels[:, 2]]
    time = np.arange(len(q)) * 9.0
    s = (q - low) / span
    moved = np.zeros_like(q)
    moved[:, 0] = 6e-3 * (s[:, 0] - s[:, 0] ** 3)
    moved[:, 1] = 4e-3 * s[:, 2] * (1 - s[:, 2])
    if displaced is not None:
        moved += displaced(q, approach, time)
    tip = q + tool + moved
    count = len(STATIONS_MM)
    stop, station = np.repeat(np.arange(len(q)), count), np.tile(np.arange(count), len(q))
    distance = np.linalg.norm(tip[stop] - STATIONS_MM[station], axis=1)
    dead = np.array([120.0, 80.0, 260.0, 31.0])[station] + 7.0 * labels[stop, 2]
    return Lengths(
        stations=("A", "B", "C", "D"),
        station=station,
        point=[str(k) for k in stop],
        position_mm=q[stop],
        length_mm=distance - dead + rng.normal(size=len(stop)) * SIGMA_UM * MICROMETRE,
        tool_mm=tool[stop],
        approach=approach[stop],
        labels={"line": labels[stop, 0], "repeat": labels[stop, 1], "setup": labels[stop, 2]},
        covariates={"time_s": time[stop]},
    )


def backlash(q, approach, time):
    return approach * np.array([0.0, 1.5 * MICROMETRE, 0.0])


def test_one_tracer_that_goes_from_station_to_station_repeats_nothing(gantry):
    """Each place is read four times, by four stations: no two readings of one station differ by noise alone."""
    own = session(6, repeats=1)
    order = np.argsort(own.station, kind="stable")
    moved = replace(
        own,
        station=own.station[order],
        point=[str(k) for k in range(len(order))],
        position_mm=own.position_mm[order],
        length_mm=own.length_mm[order],
        tool_mm=own.tool_mm[order],
        approach=own.approach[order],
        labels={name: values[order] for name, values in own.labels.items()},
        covariates={"time_s": 9.0 * np.arange(len(order))},
    )
    data = diagnose(gantry, moved).to_dict()
    assert not any(effect["grade"] == "confirmed" for effect in data["effects"])
    assert data["noise"]["source"] == "assumed"


def test_rotation_is_orthonormal_and_its_first_row_takes_the_mean():
    for channels in (1, 2, 4, 7):
        matrix = rotation(channels)
        assert np.allclose(matrix @ matrix.T, np.eye(channels), atol=1e-14)
        assert np.allclose(matrix[0], matrix[0, 0])


def test_the_least_norm_solution_leaves_undetermined_directions_at_zero():
    design = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    assert least_norm(design, np.array([2.0, 4.0, 6.0])) == pytest.approx([1.0, 1.0])


def test_the_base_jacobian_agrees_with_finite_differences(gantry):
    observed = observed_of(gantry, session(1, lines=6, tools=((0, 0, 0), (40.0, -30.0, -80.0))))
    basis = first_basis(gantry, observed.poses.position_mm, 10_000, 10_000)
    fit = fit_base(observed, basis)
    rng = np.random.default_rng(0)
    for k in rng.choice(len(fit.unknowns), 12, replace=False):
        step = 1e-6 if abs(fit.jacobian[:, k]).max() > 10 else 1e-4
        up, down = fit.unknowns.copy(), fit.unknowns.copy()
        up[k] += step
        down[k] -= step
        ahead = fit_base(observed, basis, start=up, steps=0).residual_mm
        behind = fit_base(observed, basis, start=down, steps=0).residual_mm
        numeric = (behind - ahead) / (2 * step)
        assert np.allclose(numeric, fit.jacobian[:, k], rtol=1e-4, atol=1e-5 * abs(fit.jacobian[:, k]).max())


def test_repeats_are_found_and_their_differences_hold_no_static_effect(gantry):
    clean = observed_of(gantry, session(2))
    assert clean.layout.repeated == 1.0
    block = clean.layout.blocks[0]
    matrix = difference_matrix(clean.layout, block)
    assert np.allclose((matrix @ matrix.T).toarray(), np.eye(matrix.shape[0]))
    static = clean.lengths.position_mm @ [1.0, 2.0, 3.0]
    assert np.abs(matrix @ static[block.rows]).max() < 1e-9


def restricted(gantry):
    """A restricted likelihood with two fixed effects, and variances to look at it."""
    observed = observed_of(gantry, session(3, lines=8))
    fit = fit_smooth(observed)
    time = observed.layout.time[observed.layout.stop]
    fixed = np.column_stack([time, np.where(observed.lengths.station == 1, time, 0.0)])
    problem = reml_problem(observed.layout, fit.residual_mm, fixed)
    return problem, problem.starts * np.exp(0.3 * np.sin(np.arange(len(problem.starts))))


def test_the_gradient_of_the_restricted_likelihood_agrees_with_finite_differences(gantry):
    problem, theta = restricted(gantry)
    gradient = problem.at(theta).gradient
    for k in range(0, len(theta), 3):
        up, down = theta.copy(), theta.copy()
        up[k] *= 1.0 + 1e-4
        down[k] *= 1.0 - 1e-4
        numeric = (problem.at(up).criterion - problem.at(down).criterion) / (2e-4 * theta[k])
        assert gradient[k] == pytest.approx(numeric, rel=1e-4, abs=1e-5 / theta[k])


def test_the_average_information_agrees_with_dense_matrices(gantry):
    """1/2 d' P K P K P d from the whole covariance, with every channel of every difference in one vector."""
    problem, theta = restricted(gantry)
    (part,) = problem.parts
    channels, size = part.data.shape
    own = [np.kron(np.eye(channels), kernel) for kernel in part.square]
    first = np.zeros((channels, channels))
    first[0, 0] = channels  # what all channels share shows in their mean, the first one
    every = [np.eye(channels * size), *own, *(np.kron(first, kernel) for kernel in part.square)]
    inverse = np.linalg.inv(sum(value * kernel for value, kernel in zip(theta, every, strict=True)))
    fixed, data = part.columns[:, :, :-1].reshape(channels * size, -1), part.data.ravel()
    seen = inverse @ fixed
    lacking = inverse - seen @ np.linalg.solve(fixed.T @ seen, seen.T)
    moved = np.column_stack([kernel @ lacking @ data for kernel in every])
    expected = 0.5 * moved.T @ lacking @ moved
    found = problem.at(theta)
    assert found.information == pytest.approx(expected, rel=1e-6, abs=1e-8 * np.abs(expected).max())
    assert found.quadratic == pytest.approx(data @ lacking @ data, rel=1e-9)


def test_without_parts_of_the_runs_the_restricted_likelihood_is_that_with_their_variances_at_zero(gantry):
    observed = observed_of(gantry, session(3, lines=8))
    residual, nothing = fit_smooth(observed).residual_mm, np.zeros((len(observed), 0))
    whole, less = (reml_problem(observed.layout, residual, nothing, runs=runs) for runs in (True, False))
    of_runs = np.isin(np.arange(15), [6, 7, 13, 14])
    theta = np.where(of_runs, 0.0, whole.starts)
    assert less.at(whole.starts).criterion == pytest.approx(whole.at(theta).criterion, rel=1e-12)
    assert not less.at(whole.starts).gradient[of_runs].any()


def test_the_next_variances_are_the_best_of_the_model_and_its_prior():
    rng = np.random.default_rng(1)
    for _ in range(50):
        root, theta = rng.normal(size=(6, 6)), np.exp(rng.normal(0.0, 3.0, 6))
        information = root @ root.T / np.outer(theta, theta)
        point = RemlPoint(0.0, rng.normal(0.0, 3.0, 6) / theta, information, 0.0)
        found = away_from_zero(point, theta)
        without = RemlPoint(0.0, np.append(point.gradient, 0.0), np.pad(information, (0, 1)), 0.0)
        assert away_from_zero(without, np.append(theta, 2.0)) == pytest.approx(np.append(found, 2.0), rel=1e-9)
        assert found.min() > 0.0
        slope = (point.gradient + information @ (found - theta)) * found
        assert slope == pytest.approx(np.full(6, PRIOR), abs=0.05 * PRIOR)  # the gradient of PRIOR log t by log t


def test_the_restricted_likelihood_finds_the_noise_of_the_readings(gantry):
    observed = observed_of(gantry, session(4, lines=20))
    fit = fit_smooth(observed)
    problem = reml_problem(observed.layout, fit.residual_mm, np.zeros((len(observed), 0)))
    variances, quadratic, _, freedom = fit_reml(problem)
    assert np.sqrt(variances.white) / MICROMETRE == pytest.approx(SIGMA_UM, rel=0.12)
    assert np.sqrt(variances.slow) / MICROMETRE < 0.2
    assert quadratic / freedom == pytest.approx(1.0, abs=0.02)


def test_whitening_turns_the_covariance_into_the_identity(gantry):
    observed = observed_of(gantry, session(5, lines=4))
    noise = noise_of(fit_smooth(observed), [])
    variances = replace(noise.variances, own=np.full(7, 2e-8), common=np.full(7, 3e-8))
    layout = observed.layout
    white = whitener(layout, replace(noise, variances=variances))
    pattern = [*kernels(layout.time, 9.0, layout.run, layout.in_run)]
    own, common = 2e-8 * sum(pattern), 3e-8 * sum(pattern)
    stop, station = layout.stop, observed.lengths.station
    covariance = common[np.ix_(stop, stop)] + own[np.ix_(stop, stop)] * (station[:, None] == station[None, :])
    covariance += variances.white * np.eye(len(stop))
    assert np.allclose(white(white(covariance).T), np.eye(len(stop)), atol=1e-8)


def test_a_covariance_is_factorised_in_pieces_also_where_a_piece_lies_within_one_run():
    """Two runs of 210 stops: most pieces contain one run only, whose offset and drift connect them all the same."""
    count, white, variances = 210, 1e-8, np.full(7, 2e-9)
    time, run, in_run = np.arange(2.0 * count), np.repeat([0, 1], count), np.tile(np.linspace(-1.0, 1.0, count), 2)
    same = run[:, None] == run[None, :]
    covariance = white * np.eye(2 * count) + 2e-9 * same * (1.0 + np.outer(in_run, in_run))
    for tau in (3.0, 10.0, 40.0, 200.0, 2000.0):
        covariance += 2e-9 * np.exp(-np.abs(time[:, None] - time[None, :]) / tau)
    states, whitened = np.zeros((7, 2 * count)), np.empty_like(covariance)
    for piece in pieces_of(time, run, in_run, white, variances):
        rows = slice(piece.first, piece.last)
        new = piece.inverse @ covariance[rows] - piece.known @ states
        whitened[rows] = new
        states = piece.kept[:, None] * states + piece.learnt @ new
    factor = np.linalg.cholesky(covariance)
    assert np.allclose(whitened, factor.T, atol=1e-9 * np.abs(factor).max())


def test_an_orthonormal_basis_spans_the_columns():
    columns = np.random.default_rng(0).normal(size=(20, 4))
    basis = orthonormal(np.hstack([columns, columns[:, :1]]))
    assert basis.shape == (20, 4)
    assert np.allclose(basis @ (basis.T @ columns), columns)


def test_nothing_is_named_on_readings_without_effect(gantry):
    data = diagnose(gantry, session(6)).to_dict()
    assert (data["verdict"], data["effects"], data["unknown"]) == ("none", [], [])
    assert data["gap"]["noise_floor_um"] == pytest.approx(SIGMA_UM, rel=0.1)
    assert data["gap"]["noise_floor_source"] == "repeats"
    assert "laser_scale" in data["invisible"]


def test_a_backlash_is_named_with_its_size_and_the_gap_shrinks_on_lines_left_out(gantry):
    found = diagnose(gantry, session(7, displaced=backlash))
    data = found.to_dict()
    assert [item["name"] for item in data["effects"]] == ["backlash_Y"]
    item = data["effects"][0]
    assert item["grade"] == "confirmed"
    assert abs(item["parameters"]["c_um"]["value"] - 1.5) < 4 * item["parameters"]["c_um"]["u"] < 0.4
    gap = data["gap"]["heldout_lines"]
    assert gap["after_rms_um"] < 0.7 * gap["before_rms_um"]
    assert found.acceptable


def test_an_effect_outside_the_catalogue_is_unknown_with_what_it_depends_on(gantry):
    def shape(q, approach, time):
        moved = np.zeros_like(q)
        moved[:, 2] = 1.5 * MICROMETRE * approach[:, 0]
        return moved

    data = diagnose(gantry, session(8, displaced=shape)).to_dict()
    assert data["verdict"] == "unknown"
    assert [item for item in data["effects"] if item["grade"] != "tentative"] == []
    assert data["unknown"][0]["covariates"] == ["approach_x"]
    assert data["unknown"][0]["direction"] == "dZ"


def test_without_repeats_the_noise_is_assumed_and_no_name_confirmed(gantry):
    data = diagnose(gantry, session(9, displaced=backlash, repeats=1, lines=24)).to_dict()
    assert data["gap"]["noise_floor_source"] == "assumed"
    assert [item["grade"] for item in data["effects"]] == ["tentative"]
    assert data["effects"][0]["name"] == "backlash_Y"
    assert any("twice" in text for text in data["advice"])


def test_swapped_axes_are_found_first_and_said(gantry):
    lengths = session(10, tools=((0, 0, 0), (60.0, -40.0, -90.0)))
    low, high = gantry.lower_mm, gantry.upper_mm
    flipped = lengths.position_mm.copy()
    flipped[:, 2] = -flipped[:, 2]
    data = diagnose(gantry, replace(lengths, position_mm=flipped)).to_dict()
    assert np.all((lengths.position_mm >= low) & (lengths.position_mm <= high))
    assert [item["name"] for item in data["effects"]] == ["axis_mapping"]
    assert "Z is -Z of the file" in data["effects"][0]["text"]
    assert data["gap"]["train"]["before_rms_um"] > 100 * data["gap"]["train"]["after_rms_um"]


def test_exchanged_station_labels_are_found(gantry):
    lengths = session(11)
    swap = (lengths.labels["line"] == 3) & (lengths.labels["repeat"] == 1)
    station = lengths.station.copy()
    station[swap & (lengths.station == 1)] = 2
    station[swap & (lengths.station == 2)] = 1
    data = diagnose(gantry, replace(lengths, station=station)).to_dict()
    assert [item["name"] for item in data["effects"]] == ["axis_mapping"]
    assert "B and C" in data["effects"][0]["text"]


def test_gross_readings_are_left_out_and_counted(gantry):
    lengths = session(12)
    rows = np.random.default_rng(0).choice(len(lengths), 5, replace=False)
    value = lengths.length_mm.copy()
    value[rows] += 20 * MICROMETRE
    data = diagnose(gantry, replace(lengths, length_mm=value)).to_dict()
    assert [item["name"] for item in data["effects"]] == ["outliers"]
    assert data["effects"][0]["parameters"]["count"]["value"] == len(rows)


def axis_runs(seed, drift_um, tau=25.0, sigma_um=0.3):
    rng = np.random.default_rng(seed)
    targets = np.linspace(-780, -20, 11)
    position = np.tile(np.concatenate([targets, targets[::-1]]), 5)
    direction = np.tile(np.repeat([1, -1], 11), 5)
    order = np.arange(len(position))
    value = np.interp(position, targets, rng.normal(size=11) * 3.0) + drift_um * -np.expm1(-order / tau)
    value += rng.normal(size=len(position)) * sigma_um
    run = np.repeat(np.arange(1, 6), 22)
    return AxisRuns(np.zeros(len(position), dtype=np.int64), position, direction, run, value * MICROMETRE)


def test_the_warm_up_drift_of_axis_runs_is_named_and_the_iso_figures_shrink(gantry):
    data = diagnose(gantry, axis_runs(1, 4.0)).to_dict()
    assert [item["name"] for item in data["effects"]] == ["warmup_drift"]
    parameters = data["effects"][0]["parameters"]
    assert abs(parameters["c_um"]["value"] - 4.0) < 0.6
    assert 12.0 < parameters["tau"]["value"] < 50.0
    figures = data["iso_230_2"]["X"]
    assert figures["R"]["after"] < 0.5 * figures["R"]["before"]
    assert any("sensor" in note for note in data["notes"])


def test_axis_runs_without_drift_are_left_alone(gantry):
    assert diagnose(gantry, axis_runs(2, 0.0)).to_dict()["verdict"] == "none"


def test_the_command_writes_its_files_and_the_extended_machine_takes_the_effect_away(gantry, tmp_path, capsys):
    path = tmp_path / "m.lengths.csv"
    path.write_text(format_lengths(session(13, displaced=backlash)))
    assert run_command(cli, ["diagnose", "zha-gantry", str(path), "--out", str(tmp_path / "out"), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["effects"][0]["name"] == "backlash_Y"
    assert json.loads((tmp_path / "out/diagnosis.json").read_text())["verdict"] == "named"
    page = (tmp_path / "out/index.html").read_text()
    assert all(f'id="figure-{name}"' in page for name in ("where-0", "volume-before-01", "volume-after-12", "suspects"))
    assert "http" not in page.replace("http://www.w3.org", "").replace("http-equiv", "")
    extended = read_machine(tmp_path / "out/extended.toml")
    assert list(extended.effects) == ["backlash_Y"]
    again = diagnose(extended, session(13, displaced=backlash)).to_dict()
    assert again["verdict"] == "none"


def test_the_command_reads_axis_runs_and_refuses_two_kinds_at_once(tmp_path):
    runs, lengths = tmp_path / "a.axis.csv", tmp_path / "b.lengths.csv"
    runs.write_text(format_axis_runs(axis_runs(3, 4.0)))
    lengths.write_text(format_lengths(session(14, lines=4)))
    out = str(tmp_path / "out")
    assert run_command(cli, ["diagnose", "zha-gantry", str(runs), "--out", out]) == 0
    assert run_command(cli, ["diagnose", "zha-gantry", str(runs), str(lengths), "--out", out]) == 2


def test_too_few_readings_and_unknown_names_are_refused(gantry):
    with pytest.raises(InputError, match="degrees of freedom"):
        diagnose(gantry, session(15, lines=1, repeats=1))
    with pytest.raises(InputError, match="cannot be added"):
        diagnose(gantry, axis_runs(4, 0.0), DiagnoseOptions(add=("no_such_effect",)))


def gust(lengths, *, stops=5, um=8.0):
    """A pulse in all lengths of some stops in the middle of the session."""
    times = np.unique(lengths.covariates["time_s"])
    at = np.searchsorted(times, lengths.covariates["time_s"]) - len(times) // 2
    pulse = np.where((at >= 0) & (at < stops), np.sin(np.pi * (at + 1) / (stops + 1)), 0.0)
    return replace(lengths, length_mm=lengths.length_mm + um * MICROMETRE * pulse), times[len(times) // 2 :][:stops]


def test_a_gust_is_named_with_its_time_and_may_be_left_out(gantry):
    disturbed, times = gust(session(31, lines=40))
    data = diagnose(gantry, disturbed).to_dict()
    (item,) = data["effects"]
    assert item["name"] == "disturbed_readings"
    assert f"from time {times[0]:g} s to {times[-1]:g} s" in item["text"]
    assert "--leave-out-disturbed" in item["text"]
    without = diagnose(gantry, disturbed, DiagnoseOptions(leave_out_disturbed=True)).to_dict()
    assert [item["name"] for item in without["effects"]] == ["disturbed_readings"]
    assert "left out" in without["effects"][0]["text"]
    assert without["gap"]["train"]["after_rms_um"] < 0.85 * data["gap"]["train"]["after_rms_um"]


def test_what_has_no_name_says_which_name_it_resembles(gantry):
    def swelling(q, approach, time):
        """A backlash that grows with the square of time: no name, but nearest to that of a backlash."""
        moved = np.zeros_like(q)
        moved[:, 1] = 1.2 * MICROMETRE * approach[:, 1] * (0.3 + 2.0 * (time / time.max()) ** 3)
        return moved

    data = diagnose(gantry, session(32, displaced=swelling)).to_dict()
    said = [item["resembles"] for item in data["unknown"]] + [item["name"] for item in data["effects"]]
    assert "backlash_Y" in said
    assert all("resembles" in item for item in data["unknown"])
    for item in data["effects"]:
        assert item["what_to_do"]


def test_what_is_left_of_a_runout_of_another_law_is_its_inexact_shape(gantry):
    from compgen.diagnose.verdict import _owner

    class Group:
        def __init__(self, name, covariates):
            self.name, self.covariates = name, covariates

    groups = [
        Group("tracer_runout_A", ("station",)),
        Group("beam elevation of A", ("elevation", "station_A")),
        Group("beam elevation of B", ("elevation", "station_B")),
    ]
    support = type("Support", (), {"chi2": {0: 1800.0, 1: 45.0, 2: 45.0}})
    analysis = type("Analysis", (), {"design": type("Design", (), {"groups": groups}), "support": support})
    assert _owner(analysis, 1, [0]) == 0
    assert _owner(analysis, 2, [0]) is None
    assert _owner(analysis, 1, [0], 400.0) is None


@pytest.mark.parametrize("step", [1, 2])
def test_at_steps_of_the_pitch_no_periodic_error_is_named_and_the_diagnosis_says_so(gantry, step):
    """Every level has its own deviation; waves of the rounded positions would fit them, with amplitudes of metres."""
    pitch_mm = 25.4 / 3
    machine = replace(gantry, axes=(replace(gantry.axes[0], screw_pitch_mm=pitch_mm), *gantry.axes[1:]))
    rng = np.random.default_rng(3)
    levels = np.round(step * pitch_mm * np.arange(-88 // step, 0, 8), 3)
    grid = np.array([[x, y, z] for x in levels for y in (-900.0, -500.0, -100.0) for z in (-300.0, -50.0)])
    own_mm = 1.5 * MICROMETRE * rng.normal(size=len(levels))
    deviation_mm = np.vstack([0.3 * MICROMETRE * rng.normal(size=grid.shape) for _ in range(2)])
    deviation_mm[:, 0] += np.tile(np.repeat(own_mm, 6), 2)
    measured = Deviations(np.vstack([grid, grid]), deviation_mm, labels={"repeat": np.repeat([1, 2], len(grid))})
    found = diagnose(machine, measured, DiagnoseOptions(effects=("periodic_X",))).to_dict()
    assert not found["effects"] and "periodic_X" in found["invisible"]
    assert any(text.startswith("steps that are not a multiple of the pitch") for text in found["advice"])


def plane_of(errors, folder, *, still, seed=3, backlash_um=0.0):
    """Deviations of three runs there and back along X at one or three places of Y; only ``errors`` are in the model."""
    path = folder / "restricted.toml"
    axes = "".join(f"[axes.{a}]\nrange_mm = [-100.0, 900.0]\nnodes = 9\n" for a in "XYZ")
    path.write_text(f'name = "r"\nchain = "WFYXZT"\nerrors = {json.dumps(errors)}\n{axes}')
    rng, rows = np.random.default_rng(seed), []
    for run in range(3):
        for way in (1.0, -1.0):
            for y in [300.0] if still else [0.0, 300.0, 600.0]:
                for x in np.linspace(0, 800, 9)[:: int(way)]:
                    bow = (x / 800) * (1 - x / 800)
                    moved = [0.01 * x + backlash_um * way, 8 * bow, -6 * bow]
                    rows.append([x, y, 250.0, *(moved + rng.normal(0, 0.4, 3)), way, 5.0 * len(rows), run])
    text = "x_mm,y_mm,z_mm,dx_um,dy_um,dz_um,approach_x,time_s,run\n"
    text += "".join(",".join(f"{v:.4f}" for v in row[:-1]) + f",{row[-1]:.0f}\n" for row in rows)
    file = folder / "plane.deviations.csv"
    file.write_text(text)
    return diagnose(read_machine(path), read_diagnosed([file]))


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize("errors", [["EXX"], ["EYX"], ["EC0Y"], ["EZY", "EXZ"], ["EAX"], ["EXX", "EYY", "EZZ"]])
def test_any_list_of_errors_can_be_diagnosed(errors, still, tmp_path):
    found = plane_of(errors, tmp_path, still=still).to_dict()
    assert found["verdict"] in ("none", "named", "unknown")
    # nothing depends on an axis that stood still, and no amount is beyond what a machine does
    if still:
        assert not [u for u in found["unknown"] if {"y", "z"} & set(u["covariates"]) - {"x"}]
    assert all(abs(p["value"]) < 1e4 for e in found["effects"] for p in e["parameters"].values())


def test_backlash_is_named_with_a_list_of_errors_that_holds_the_curve(tmp_path):
    found = plane_of(["EXX", "EYX", "EZX"], tmp_path, still=False, backlash_um=1.5).to_dict()
    firm = [e["name"] for e in found["effects"] if e["grade"] != "tentative"]
    assert firm == ["backlash_X"] and found["effects"][0]["belongs_to"] == "machine"
    assert found["effects"][0]["parameters"]["c_um"]["value"] == pytest.approx(1.5, abs=0.15)


def test_what_happened_in_one_session_is_not_kept_as_the_machine(gantry, tmp_path, capsys):
    def slipped(q, approach, time):
        return backlash(q, approach, time) + 8e-3 * (time > np.median(time))[:, None] * [1.0, -1.0, 0.5]

    path = tmp_path / "m.lengths.csv"
    path.write_text(format_lengths(session(21, displaced=slipped)))
    run_command(cli, ["diagnose", "zha-gantry", str(path), "--out", str(tmp_path / "out"), "--json"])
    data = json.loads(capsys.readouterr().out)
    belongs = {e["name"]: e["belongs_to"] for e in data["effects"] if e["grade"] != "tentative"}
    assert belongs == {"backlash_Y": "machine", "machine_jump": "session"}
    assert list(read_machine(tmp_path / "out/extended.toml").effects) == ["backlash_Y"]
    assert set(read_machine(tmp_path / "out/session.toml").effects) == {"backlash_Y", "machine_jump"}
    # a clean measurement after it fits the machine that was kept
    clean = diagnose(read_machine(tmp_path / "out/extended.toml"), session(22, displaced=backlash)).to_dict()
    assert clean["verdict"] == "none"
