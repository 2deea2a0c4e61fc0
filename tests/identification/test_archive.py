"""Lengths in binary form (``*.lengths.npz``): identified in chunks, with the same result as a file read at once."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.data import length_archive
from compgen.data.length_archive import open_archive
from compgen.data.machine import Chain
from compgen.errors import ConvergenceError, InputError, UndeterminedError
from compgen.identification import (
    IdentifyOptions,
    SystematicInputs,
    identify,
    identify_measurement,
    read_measurement,
    streamed_lengths,
)
from compgen.identification.adjust.path_problem import path_problem
from compgen.identification.adjust.problem import length_problem
from compgen.identification.adjust.unknowns import State, error_parameters
from compgen.kinematics import exact_error, modelled_errors
from compgen.kinematics.kernel_switch import COMPILED, PLAIN, VARIABLE, has_numba

STATIONS_MM = np.array(
    [[158.8, -1456.7, -349.7], [-113.1, -1671.7, -349.4], [-468.6, -1563.2, -349.4], [-769.9, -1599.5, -209.0]]
)
DEAD_MM = np.array([400.0, 500.0, 600.0, 700.0])
COUNT = 24_000


@pytest.fixture(scope="module")
def machine():
    return compgen.load_machine("zha-gantry")


@pytest.fixture(scope="module")
def truth():
    return compgen.read_errors("examples/zha-gantry.truth.errors.csv")


@pytest.fixture(scope="module")
def columns(machine, truth):
    """Readings of four stations while the machine moves: no two stops alike."""
    rng, time = np.random.default_rng(3), np.linspace(0.0, 300.0, COUNT // 4)
    position = np.stack([-400 + 400 * np.sin(time), -500 + 500 * np.sin(3.1 * time), -175 + 175 * np.sin(0.73 * time)])
    tip = position.T + exact_error(machine, truth, position.T)
    distance = np.linalg.norm(tip[:, None] - STATIONS_MM, axis=2)
    length = distance - DEAD_MM + (1e-4 + 1.5e-7 * distance) * rng.standard_normal(distance.shape)
    return {
        "stations": np.array(["LT1", "LT2", "LT3", "LT4"]),
        "station": np.tile(np.arange(4), len(time)),
        **{f"{axis}_mm": position[k].repeat(4) for k, axis in enumerate("xyz")},
        "length_mm": length.ravel(),
        "u_length_um": np.array(0.1),
        "u_length_um_per_m": np.array(0.15),
    }


@pytest.fixture
def streamed(monkeypatch):
    """Archives of more than a few readings are not read at once, and chunks end in the middle of a stop."""
    monkeypatch.setattr(length_archive, "CHUNK", 7001)
    monkeypatch.setattr(streamed_lengths, "CHUNK", 7001)
    monkeypatch.setattr(length_archive, "MOST_WHOLE", 1000)
    monkeypatch.setattr(length_archive, "SAMPLE", 4000)


def written(folder, columns, **changes):
    path = folder / "fly.lengths.npz"
    np.savez(path, **{name: values for name, values in {**columns, **changes}.items() if values is not None})
    return path


def values_of(result):
    curves, squareness = result.errors.curves.values(), result.errors.squareness.values()
    value = np.concatenate([*(curve.value for curve in curves), [value for value, _ in squareness]])
    return value, np.concatenate([*(curve.u for curve in curves), [u for _, u in squareness]])


@pytest.fixture(params=[COMPILED, PLAIN])
def way(request, monkeypatch):
    if request.param == COMPILED and not has_numba():
        pytest.skip("numba is not installed")
    monkeypatch.setenv(VARIABLE, request.param)
    return request.param


@pytest.mark.usefixtures("way", "streamed")
def test_an_archive_in_chunks_gives_what_the_readings_give_in_memory(machine, truth, columns, tmp_path):
    same = {"u_length_um": np.array(0.28), "u_length_um_per_m": np.array(0.0)}  # else weights follow the start values
    path = written(tmp_path, columns, **same)
    found = identify_measurement(machine, read_measurement([path]))
    whole = identify(machine, open_archive(path).taken(slice(None)))
    (value, u), (other, u_other) = values_of(found), values_of(whole)
    known = u > 0
    assert np.abs((value - other)[known] / u[known]).max() < 2e-3
    np.testing.assert_allclose(u[known], u_other[known], rtol=5e-3)
    assert found.readings == found.readings_used == COUNT == whole.readings
    assert found.reduced_chi_square == pytest.approx(whole.reduced_chi_square, rel=1e-3)
    assert found.degrees_of_freedom == whole.degrees_of_freedom
    assert (found.rank, found.unknowns) == (153, 153)
    for mine, theirs in zip(found.stations, whole.stations, strict=True):
        assert (mine.station, mine.readings) == (theirs.station, theirs.readings)
        assert mine.rms_um == pytest.approx(theirs.rms_um, rel=1e-4)
        np.testing.assert_allclose(mine.position_mm, theirs.position_mm, rtol=0, atol=2e-3 * theirs.u_position_mm[1])
        np.testing.assert_allclose(mine.u_position_mm, theirs.u_position_mm, rtol=5e-3)
    for name, (squareness, u_squareness) in found.errors.squareness.items():
        assert abs(squareness - truth.squareness[name][0]) < 4 * u_squareness


@pytest.mark.usefixtures("way", "streamed")
def test_gross_errors_are_rejected_and_named(machine, columns, tmp_path):
    length = columns["length_mm"].copy()
    rows = np.array([17, 7000, 7001, 12_345, COUNT - 1])
    length[rows] += 0.05
    path = written(tmp_path, columns, length_mm=length)
    found = identify_measurement(machine, read_measurement([path]))
    assert [item.row for item in found.rejected] == rows.tolist()
    assert found.readings_used == COUNT - len(rows)
    np.testing.assert_allclose([item.residual_um for item in found.rejected], 50.0, atol=2.0)
    assert [item.station for item in found.rejected] == [f"LT{row % 4 + 1}" for row in rows]
    kept = identify_measurement(machine, read_measurement([path]), IdentifyOptions(reject=False))
    assert kept.readings_used == COUNT and kept.reduced_chi_square > 2.0
    clean = identify_measurement(machine, read_measurement([written(tmp_path, columns)]))
    difference, u = values_of(found)[0] - values_of(clean)[0], values_of(clean)[1]
    assert np.abs(difference[u > 0] / u[u > 0]).max() < 0.3


@pytest.mark.usefixtures("streamed")
def test_each_setup_has_a_dead_length_of_its_own(machine, columns, tmp_path):
    setup = (np.arange(COUNT) >= COUNT // 2).astype(np.int64) * 3
    length = columns["length_mm"] - np.where((setup == 3) & (columns["station"] == 1), 12.5, 0.0)
    path = written(tmp_path, columns, setup=setup, length_mm=length)
    found = identify_measurement(machine, read_measurement([path]))
    dead = {(item.station, item.setup): item.dead_length_mm for item in found.stations}
    assert len(dead) == 8 and dead["LT2", 3] - dead["LT2", 0] == pytest.approx(12.5, abs=1e-3)
    assert dead["LT1", 3] - dead["LT1", 0] == pytest.approx(0.0, abs=1e-3)
    assert found.reduced_chi_square == pytest.approx(1.0, abs=0.05)


@pytest.mark.usefixtures("streamed")
def test_a_setup_that_the_sample_does_not_see_is_refused(machine, columns, tmp_path):
    rows = open_archive(written(tmp_path, columns)).sample_rows
    hidden = np.flatnonzero(~np.isin(np.arange(COUNT), rows))[:2]
    setup = np.zeros(COUNT, dtype=np.int64)
    for number in (1, 10**6):
        setup[hidden] = number
        with pytest.raises(InputError, match=f"setup {number} of station .* has so few readings"):
            identify_measurement(machine, read_measurement([written(tmp_path, columns, setup=setup)]))


@pytest.mark.usefixtures("streamed")
def test_what_the_readings_leave_open_is_named(machine, columns, tmp_path):
    flat = written(tmp_path, columns, z_mm=np.full(COUNT, -100.0))
    with pytest.raises((UndeterminedError, ConvergenceError, InputError)):
        identify_measurement(machine, read_measurement([flat]))


@pytest.mark.usefixtures("streamed")
@pytest.mark.parametrize(
    ("options", "match"),
    [
        (IdentifyOptions(method="two-step"), "--method"),
        (IdentifyOptions(stations="nominal"), "--stations"),
        (IdentifyOptions(systematic=SystematicInputs(drift_um=1.0)), "systematic"),
    ],
)
def test_options_that_need_all_readings_at_once_are_refused(machine, columns, tmp_path, options, match):
    with pytest.raises(InputError, match=match):
        identify_measurement(machine, read_measurement([written(tmp_path, columns)]), options)


@pytest.mark.usefixtures("streamed")
@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"length_mm": None}, "lacks length_mm"),
        ({"stations": None}, "lacks stations"),
        ({"station": np.zeros(COUNT)}, "whole numbers"),
        ({"station": np.full(COUNT, 4)}, "not one of the 4 stations"),
        ({"x_mm": np.zeros(5)}, r"has the shape \(5,\)"),
        ({"y_mm": np.full(COUNT, np.nan)}, "reading 1 is not a finite number"),
        ({"z_mm": np.full(COUNT, 1000.0)}, "is outside the travel"),
        ({"colour": np.zeros(COUNT)}, "not a column"),
        ({"u_length_um": np.full(COUNT, 0.1)}, "is a column"),
        ({"temp_x_c": np.full(COUNT, 25.0)}, "needs a correction"),
    ],
)
def test_a_malformed_archive_is_refused(machine, columns, tmp_path, changes, match):
    warm = replace(machine, axes=tuple(replace(axis, expansion_um_per_m_k=11.0) for axis in machine.axes))
    with pytest.raises(InputError, match=match):
        identify_measurement(warm, read_measurement([written(tmp_path, columns, **changes)]))


def test_damaged_and_compressed_files_are_refused(columns, tmp_path):
    path = written(tmp_path, columns)
    whole = path.read_bytes()
    for content in (b"", b"no archive", whole[:1000], whole[:-200]):
        path.write_bytes(content)
        with pytest.raises(InputError, match="is not an archive"):
            open_archive(path)
    np.savez_compressed(path, **columns)
    with pytest.raises(InputError, match=r"numpy.savez, not numpy.savez_compressed"):
        open_archive(path)
    np.savez(path, **{**columns, "point": np.array([object()] * COUNT)})
    with pytest.raises(InputError, match="contains objects"):
        open_archive(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("note.txt", "nothing")
    with pytest.raises(InputError):
        open_archive(path)


@pytest.mark.parametrize("bad", [b"(", b"'\\'", b"{'a", b"9" * 60, b"\xff\xfe"])
def test_a_damaged_header_of_a_column_is_bad_input(columns, tmp_path, bad):
    path = written(tmp_path, columns)
    whole = path.read_bytes()
    at = whole.index(b"\x93NUMPY") + 10
    path.write_bytes(whole[:at] + bad + whole[at + len(bad) :])
    with pytest.raises(InputError, match="is not an archive"):
        open_archive(path)


def test_a_small_archive_is_what_a_text_file_is(machine, columns, tmp_path):
    few = {name: values[:4000] if values.shape == (COUNT,) else values for name, values in columns.items()}
    lengths = compgen.read_lengths(written(tmp_path, few))
    assert isinstance(read_measurement([written(tmp_path, few)]), compgen.Lengths)
    assert len(lengths) == 4000 and lengths.metadata["u_length_um"] == "0.1"
    assert lengths.origin[7] == (str(tmp_path / "fly.lengths.npz"), 8)
    np.testing.assert_array_equal(lengths.length_mm, few["length_mm"])
    np.testing.assert_array_equal(lengths.position_mm[:, 1], few["y_mm"])


@pytest.mark.skipif(not has_numba(), reason="numba is not installed")
@pytest.mark.parametrize("chain", ["WFYXZT", "WXFYZT", "WYXFZT", "WXYZFT"])
@pytest.mark.parametrize("reference", ["X", "Y"])
def test_the_compiled_pass_has_the_sums_of_the_plain_one(machine, chain, reference):
    tool = (10.0, -20.0, -150.0)
    other = replace(machine, chain=Chain(chain), squareness_reference=reference, tool_offset_mm=tool)
    layout = error_parameters(other, modelled_errors(other))
    rng, count = np.random.default_rng(5), 900
    position = rng.uniform(other.lower_mm, other.upper_mm, (count, 3)).repeat(2, axis=0)
    station = np.arange(2 * count) % 4
    lengths = compgen.Lengths(
        ("A", "B", "C", "D"), station, [""] * len(station), position, np.full(len(station), 1200.0)
    )
    plain = length_problem(other, lengths, layout)
    fast = path_problem(layout, position, np.array(tool), station, station, lengths.length_mm)
    weight = rng.uniform(0.5, 2.0, len(station))
    plain, fast = plain.weighted(weight), fast.weighted(weight)
    errors = rng.normal(0.0, 1e-2, layout.size)
    errors[[curve.columns.start for curve in layout.curves if curve.error.kind == "angular"]] *= 1e-3
    for curve in layout.curves:
        errors[curve.columns] *= 1e-2 if curve.error.kind == "angular" else 1.0
    for size in (1.0, 0.0):
        state = State(size * errors, STATIONS_MM, DEAD_MM)
        (cost, gradient), (found, by_unknowns) = plain.evaluate(state), fast.evaluate(state)
        assert found == pytest.approx(cost, rel=1e-12)
        np.testing.assert_allclose(by_unknowns, gradient, rtol=0, atol=1e-12 * np.abs(gradient).max())
        np.testing.assert_allclose(fast.residuals(state), plain.residuals(state), rtol=0, atol=1e-11)
    exact, matrix = plain.normal_matrix(state), fast.normal_matrix(state)  # at zero errors C is the exact derivative
    scale = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(matrix / np.outer(scale, scale), exact / np.outer(scale, scale), rtol=0, atol=1e-12)


SCENARIO = """
name = "fly"
seed = 4
[errors]
linear_peak_um = [10.0, 30.0]
angular_peak_urad = [10.0, 30.0]
[instrument]
type = "laser-tracer"
rate_hz = 5.0
{stations}
[trajectory]
type = "grid"
levels = [5, 11, 5]
runs = "once"
feed_mm_min = 3000.0
"""


def test_readings_on_the_fly_are_simulated_and_identified_as_a_user_does(tmp_path, capsys, monkeypatch):
    stations = "".join(
        f'[[instrument.stations]]\nname = "LT{k + 1}"\nposition_mm = {place.tolist()}\ndead_length_mm = {400.0 + k}\n'
        for k, place in enumerate(STATIONS_MM)
    )
    scenario = tmp_path / "fly.toml"
    scenario.write_text(SCENARIO.format(stations=stations))
    words = ["simulate", "zha-gantry", "--scenario", str(scenario), "--out", str(tmp_path / "made"), "--json"]
    assert run_command(cli, words) == 0
    made = json.loads(capsys.readouterr().out)
    path = tmp_path / "made" / "fly.lengths.npz"
    archive = open_archive(path)
    assert made["readings"] == len(archive) > 10_000 and made["stations"] == ["LT1", "LT2", "LT3", "LT4"]
    step = np.linalg.norm(np.diff(archive.taken(slice(0, 400)).position_mm[::4], axis=0), axis=1)
    assert np.median(step) == pytest.approx(3000.0 / 60.0 / 5.0)
    monkeypatch.setattr(length_archive, "MOST_WHOLE", 1000)
    assert run_command(cli, ["identify", "zha-gantry", str(path), "--out", str(tmp_path / "found"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["readings"] == found["readings_used"] == len(archive)
    assert found["joint"]["sample_readings"] <= len(archive)
    true = compgen.read_errors(tmp_path / "made" / "truth.errors.csv")
    errors = compgen.read_errors(tmp_path / "found" / "identified.errors.csv")
    for name, (value, u) in errors.squareness.items():
        assert abs(value - true.squareness[name][0]) < 5 * u
    fly = compgen.read_scenario(scenario)
    with pytest.raises(InputError, match="call simulate_moving"):
        compgen.simulate(compgen.load_machine("zha-gantry"), fly)
