"""Uncertainty of errors and of E, and its file: against dense algebra, repeated identification and closed forms."""

import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

import machines
from compgen.data.error_table import Curve, ErrorTable, read_errors
from compgen.data.files import sha256_of
from compgen.data.lengths import Lengths, Points, format_lengths, read_lengths
from compgen.data.names import SQUARENESS_NAMES, error_named
from compgen.errors import InputError
from compgen.identification import (
    IdentifyOptions,
    KnownStations,
    SystematicInputs,
    identify,
    joint_covariance,
    predict_uncertainty,
    read_covariance,
)
from compgen.identification.adjust.problem import length_problem
from compgen.identification.covariance import FILE_NAME, error_values, format_covariance, posterior_with
from compgen.kinematics import exact_error, modelled_errors, volumetric_error
from compgen.pipeline import identification_files, provenance_of

NANOMETRE = 1e-6  # mm
STATIONS = np.array([[400.0, -900.0, 50.0], [-700.0, -800.0, 100.0], [900.0, 700.0, -150.0], [-100.0, 1300.0, 600.0]])
DEAD_MM = np.array([310.0, 402.5, 250.25, 501.125])
NOISE_UM, NOISE_UM_PER_M = 0.2, 0.3
TOOLS = ((0.0, 0.0, -100.0), (80.0, 0.0, -100.0), (0.0, 90.0, -180.0))


def machine_of(counts=(4, 3, 4), **fields):
    ranges = ((-420.0, 130.0), (50.0, 650.0), (-300.0, 0.0))
    fields = {"reference_point_mm": (0.0, 50.0, -100.0), **fields}
    return machines.machine_of(ranges, counts, expansion=(11.5, 9.0, 12.0), **fields)


def readings(machine, truth=None, tools=None, moved_mm=None, there_and_back=False):
    """Noise-free lengths over the grid of nodes; ``moved_mm`` (n, 3) displaces the target of each reading."""
    grid = np.stack(np.meshgrid(*[axis.nodes_mm for axis in machine.axes], indexing="ij"), -1).reshape(-1, 3)
    passes = np.concatenate([grid, grid[::-1]]) if there_and_back else grid
    tools = np.array(tools if tools is not None else [machine.tool_offset_mm])
    position = np.tile(passes, (len(tools), 1))
    tool = np.repeat(tools, len(passes), axis=0)
    run = np.tile(np.arange(len(passes)) // len(grid), len(tools))
    tip = position + tool + exact_error(machine, truth or ErrorTable(), position, tool)
    station = np.tile(np.arange(4), len(tip))
    seen = np.repeat(tip, 4, axis=0) + (0.0 if moved_mm is None else moved_mm)
    distance = np.linalg.norm(seen - STATIONS[station], axis=1)
    return Lengths(
        stations=("A", "B", "C", "D"),
        station=station,
        point=[str(k) for k in range(len(station))],
        position_mm=np.repeat(position, 4, axis=0),
        length_mm=distance - DEAD_MM[station],
        tool_mm=np.repeat(tool, 4, axis=0) if len(tools) > 1 else None,
        labels={"run": np.repeat(run, 4)},
        covariates={"time_s": 5.0 * np.repeat(np.arange(len(tip)), 4)},
        metadata={"u_length_um": str(NOISE_UM), "u_length_um_per_m": str(NOISE_UM_PER_M)},
    )


def truth_of(machine, seed=4):
    rng = np.random.default_rng(seed)
    curves, squareness = {}, {}
    for name in modelled_errors(machine):
        error = error_named(name)
        if name in SQUARENESS_NAMES:
            squareness[name] = (rng.normal(0, 300e-6), 0.0)
            continue
        nodes = machine.axes[error.axis].nodes_mm
        value = rng.normal(0, 0.012 if error.kind == "linear" else 15e-6, len(nodes))
        curves[name] = Curve(nodes, value, np.zeros(len(nodes)))
    return ErrorTable(curves, squareness)


def sigma_mm(lengths):
    distance = lengths.length_mm + DEAD_MM[lengths.station]
    return 1e-3 * (NOISE_UM + NOISE_UM_PER_M * distance / 1000.0)


def some_points(machine, count=7, seed=9):
    rng = np.random.default_rng(seed)
    return Points(rng.uniform(machine.lower_mm, machine.upper_mm, (count, 3)))


def vector(errors):
    """All values of a table in the order of its rows, mm and rad."""
    parts = [errors.curves[n].value if n in errors.curves else [errors.squareness[n][0]] for n in errors.names]
    return np.concatenate(parts)


def vector_u(errors):
    parts = [errors.curves[n].u if n in errors.curves else [errors.squareness[n][1]] for n in errors.names]
    return np.concatenate(parts)


# --- random part ---------------------------------------------------------------------------------------------------


def dense_covariance(machine, lengths, result):
    """(J^T W J)^-1 with J by central differences of the exact readings."""
    problem, state = length_problem(machine, lengths, result.layout), result.adjustment.state
    columns = []
    for k in range(problem.size):
        step = np.zeros(problem.size)
        step[k] = 1e-6 if result.layout.size > k else 1e-3
        columns.append((problem.residuals(state.moved(step)) - problem.residuals(state.moved(-step))) / (2 * step[k]))
    weighted = np.column_stack(columns) / sigma_mm(lengths)[:, None]
    scale = 1.0 / np.linalg.norm(weighted, axis=0)
    return np.linalg.inv((weighted * scale).T @ (weighted * scale)) * scale * scale[:, None]


@pytest.mark.parametrize("curves", ["linear", "cubic"])
def test_the_uncertainty_of_e_is_that_of_the_full_dense_covariance(curves):
    machine = machine_of((4, 4, 5), curves=curves, tool_offset_mm=(20.0, -30.0, -150.0))
    lengths = readings(machine)
    result = identify(machine, lengths)
    dense = dense_covariance(machine, lengths, result)
    points = some_points(machine)
    columns = []
    for name, position_mm, place, matrix in error_values(result.layout):
        for k in range(place.stop - place.start):
            if name in SQUARENESS_NAMES:
                unit = ErrorTable(squareness={name: (1.0, 0.0)})
            else:
                unit = ErrorTable({name: Curve(position_mm, matrix[:, k], 0 * position_mm)})
            columns.append(volumetric_error(machine, unit, points.position_mm))
    design = np.stack(columns, axis=-1)
    size = result.layout.size
    expected = np.sqrt(np.einsum("nij,jk,nik->ni", design, dense[:size, :size], design))
    found = predict_uncertainty(machine, joint_covariance(result), points)
    # the normal matrix uses C instead of the exact derivative; without errors the two agree
    assert np.allclose(found, expected, rtol=1e-5, atol=0)
    stations = joint_covariance(result).stations_covariance
    assert np.allclose(stations, dense[size : size + 12, size : size + 12], rtol=1e-4, atol=1e-4 * stations.max())


def test_the_factor_gives_the_standard_uncertainties_of_the_table_and_of_the_stations():
    machine = machine_of()
    result = identify(machine, readings(machine, truth_of(machine)))
    joint = joint_covariance(result)
    assert np.allclose(np.sqrt(np.diag(joint.errors_covariance)), vector_u(result.errors), rtol=1e-9, atol=1e-18)
    u_stations = np.ravel([station.u_position_mm for station in result.stations])
    assert np.allclose(np.sqrt(np.diag(joint.stations_covariance)), u_stations, rtol=1e-9)
    u_dead = [station.u_dead_length_mm for station in result.stations]
    assert np.allclose(np.linalg.norm(joint.factor[-4:], axis=1), u_dead, rtol=1e-9)


def test_the_uncertainty_of_e_is_the_scatter_of_repeated_identifications():
    machine = machine_of()
    clean = readings(machine, truth_of(machine))
    points = some_points(machine)
    rng = np.random.default_rng(12)
    options = IdentifyOptions(reject=False)
    replicates = 60
    found = []
    for _ in range(replicates):
        noisy = replace(clean, length_mm=clean.length_mm + sigma_mm(clean) * rng.standard_normal(len(clean)))
        found.append(volumetric_error(machine, identify(machine, noisy, options).errors, points.position_mm))
    variance = np.var(found, axis=0, ddof=1)
    u = predict_uncertainty(machine, joint_covariance(identify(machine, clean, options)), points)
    ratio = variance / u**2
    low, high = chi2.ppf([0.0005, 0.9995], replicates - 1) / (replicates - 1)
    assert low < ratio.min()
    assert ratio.max() < high
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.15)


def test_many_points_and_their_own_tools_are_worked_in_blocks():
    machine = machine_of(tool_offset_mm=TOOLS[0])
    joint = joint_covariance(identify(machine, readings(machine, tools=TOOLS)))
    rng = np.random.default_rng(1)
    points = some_points(machine, 2500)
    points = Points(points.position_mm, np.array(TOOLS)[rng.integers(0, 3, 2500)])
    u = predict_uncertainty(machine, joint, points)
    picked = [0, 1023, 1024, 2499]
    single = [
        predict_uncertainty(machine, joint, Points(points.position_mm[[k]], points.tool_mm[[k]]))[0] for k in picked
    ]
    assert np.allclose(u[picked], single, rtol=1e-12)
    assert not np.allclose(u, predict_uncertainty(machine, joint, Points(points.position_mm)), rtol=1e-3)


# --- systematic part -----------------------------------------------------------------------------------------------


def contribution(machine, lengths, **inputs):
    """Response of the errors (rows of the errors file, quantities) to one input."""
    result = identify(machine, lengths, IdentifyOptions(systematic=SystematicInputs(**inputs)))
    (item,) = result.systematic.contributions
    rows = [matrix @ item.response[columns] for _, _, columns, matrix in error_values(result.layout)]
    return result, np.vstack(rows)


def slopes(machine, result, per_axis):
    """Table in which only EXX, EYY, EZZ are not zero: slopes about the reference point, one value for each axis."""
    values = []
    for name in result.errors.names:
        count = len(result.errors.curves[name].value) if name in result.errors.curves else 1
        if name in ("EXX", "EYY", "EZZ"):
            axis = error_named(name).axis
            values.append(per_axis[axis] * (machine.axes[axis].nodes_mm - machine.reference_point_mm[axis]))
        else:
            values.append(np.zeros(count))
    return np.concatenate(values)


def test_an_unknown_wavelength_is_one_direction_and_a_slope_of_the_three_positioning_curves():
    machine = machine_of()
    result, response = contribution(machine, readings(machine), wavelength_ppm=0.1)
    assert response.shape[1] == 1
    assert np.allclose(response[:, 0], slopes(machine, result, np.full(3, 1e-7)), rtol=0, atol=1e-12)
    assert result.systematic.contributions[0].worst["um"] == (pytest.approx(0.06, rel=1e-9), "EYY")


def test_scaled_readings_move_the_errors_by_the_response():
    machine = machine_of()
    truth = truth_of(machine)
    lengths = readings(machine, truth)
    result, response = contribution(machine, lengths, wavelength_ppm=5.0)
    scaled = identify(machine, replace(lengths, length_mm=lengths.length_mm * (1 + 5e-6)))
    difference = vector(scaled.errors) - vector(result.errors)
    assert np.max(np.abs(difference)) > 1e-3
    assert np.allclose(difference, response[:, 0], rtol=0, atol=NANOMETRE)


def test_temperature_acts_through_the_expansion_of_each_axis_by_itself():
    machine = machine_of()
    result, response = contribution(machine, readings(machine), temperature_k=0.2)
    assert response.shape[1] == 3
    for axis, coefficient in enumerate((11.5e-6, 9.0e-6, 12.0e-6)):
        expected = slopes(machine, result, 0.2 * coefficient * np.eye(3)[axis])
        assert np.allclose(response[:, axis], expected, rtol=0, atol=1e-11)


def test_temperature_without_an_expansion_coefficient_is_refused():
    machine = machine_of()
    bare = replace(machine.axes[1], expansion_um_per_m_k=None)
    machine = replace(machine, axes=(machine.axes[0], bare, machine.axes[2]))
    with pytest.raises(InputError, match=r"\[axes.Y\] expansion_um_per_m_k"):
        contribution(machine, readings(machine), temperature_k=0.2)


@pytest.mark.parametrize("name", ["target_um", "target_station_um"])
def test_with_one_tool_a_misplaced_target_does_nothing_but_move_the_stations(name):
    machine = machine_of()
    result, response = contribution(machine, readings(machine), **{name: 5.0})
    assert np.max(np.abs(response)) < 1e-12
    without = identify(machine, readings(machine)).stations[0].u_position_mm
    assert np.hypot(without[0], 5e-3) == pytest.approx(result.stations[0].u_position_mm[0], rel=1e-6)


@pytest.mark.filterwarnings("ignore:the residuals are not white")  # the misplaced target also appears there
def test_with_several_tools_a_misplaced_target_moves_the_errors_as_identification_does():
    machine = machine_of(tool_offset_mm=TOOLS[0])
    clean = readings(machine, tools=TOOLS)
    result, response = contribution(machine, clean, target_um=3.0)
    assert response.shape[1] == 9
    second = np.all(clean.tool_mm == TOOLS[1], axis=1)
    moved = np.where(second[:, None], [0.0, 3e-3, 0.0], 0.0)
    disturbed = identify(machine, readings(machine, tools=TOOLS, moved_mm=moved))
    order = sorted(TOOLS).index(TOOLS[1])
    difference = vector(disturbed.errors) - vector(result.errors)
    assert np.max(np.abs(difference)) > 1e-6
    assert np.allclose(difference, response[:, 3 * order + 1], rtol=0, atol=NANOMETRE)


@pytest.mark.filterwarnings("ignore:the residuals are not white")  # a drift is meant to be seen there
def test_drift_of_a_station_moves_the_errors_as_identification_does():
    machine = machine_of()
    clean = readings(machine)
    result, response = contribution(machine, clean, drift_um=2.0)
    assert response.shape[1] == 12
    share = clean.covariates["time_s"] / clean.covariates["time_s"].max()
    of_c = (clean.station == 2)[:, None]
    moved = np.where(of_c, -2e-3 * share[:, None] * [1.0, 0.0, 0.0], 0.0)  # the station goes to +x
    disturbed = identify(machine, readings(machine, moved_mm=moved))
    difference = vector(disturbed.errors) - vector(result.errors)
    assert np.max(np.abs(difference)) > 1e-4
    assert np.allclose(difference, response[:, 3 * 2 + 0], rtol=0, atol=NANOMETRE)


@pytest.mark.filterwarnings("ignore:the residuals are not white")  # a drift is meant to be seen there
@pytest.mark.parametrize(
    "choice",
    [
        {"method": "two-step"},
        {"stations": KnownStations(("A", "C"), STATIONS[[0, 2]], np.array([1e-3, 5e-3]))},
    ],
)
def test_the_response_is_that_of_the_chosen_method_and_of_known_stations(choice):
    machine = machine_of((5, 4, 5))
    clean = readings(machine, truth_of(machine))
    options = IdentifyOptions(**choice)
    base = identify(machine, clean, options)
    found = identify(machine, clean, replace(options, systematic=SystematicInputs(wavelength_ppm=2.0)))
    rows = np.vstack([m @ found.systematic.response[columns] for _, _, columns, m in error_values(found.layout)])
    dead_mm = DEAD_MM[clean.station]
    scaled = replace(clean, length_mm=(clean.length_mm + dead_mm) * (1 + 2e-6) - dead_mm)
    difference = vector(identify(machine, scaled, options).errors) - vector(base.errors)
    assert np.max(np.abs(difference)) > 1e-3
    assert np.allclose(difference, rows[:, 0], rtol=0, atol=NANOMETRE)


def test_there_and_back_at_an_even_pace_takes_out_a_linear_drift():
    machine = machine_of()
    _, response = contribution(machine, readings(machine, there_and_back=True), drift_um=2.0)
    assert np.max(np.abs(response)) < 1e-9


def test_contributions_are_reported_by_themselves_and_added_in_squares():
    machine = machine_of()
    lengths = readings(machine, truth_of(machine))
    inputs = SystematicInputs(wavelength_ppm=1.0, temperature_k=0.3, drift_um=1.5)
    plain, result = identify(machine, lengths), identify(machine, lengths, IdentifyOptions(systematic=inputs))
    parts = [contribution(machine, lengths, **{name: value})[1] for name, value in inputs.items() if value]
    total = np.sqrt(vector_u(plain.errors) ** 2 + sum(np.sum(part**2, axis=1) for part in parts))
    assert np.allclose(vector_u(result.errors), total, rtol=1e-9, atol=1e-18)
    assert np.array_equal(vector(result.errors), vector(plain.errors))
    summary = result.summary()
    assert set(summary["systematic"]) == {"random", "wavelength_ppm", "temperature_k", "drift_um"}
    assert summary["systematic"]["random"] == plain.summary()["worst_standard_uncertainty"]
    assert plain.summary()["systematic"] is None
    assert np.allclose(np.diag(joint_covariance(result).errors_covariance), total**2, rtol=1e-9, atol=1e-30)
    u = result.covariance
    assert np.allclose(u, u.T)
    assert np.trace(u) > np.trace(plain.covariance)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_an_impossible_uncertainty_is_refused(value):
    with pytest.raises(InputError, match="drift_um"):
        SystematicInputs(drift_um=value)


# --- file ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """An identification and the folder with its files."""
    folder = tmp_path_factory.mktemp("identified")
    machine = machine_of()
    result = identify(machine, readings(machine, truth_of(machine)))
    for name, content in identification_files(result, provenance_of()).items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return machine, result, folder


def test_the_file_is_read_back_and_belongs_to_its_errors_file(written):
    _, result, folder = written
    errors = folder / "identified.errors.csv"
    assert read_errors(errors).metadata["covariance"] == FILE_NAME
    found, expected = read_covariance(folder / FILE_NAME, errors), joint_covariance(result)
    assert found.errors_sha256 == sha256_of(errors.read_bytes())
    assert (found.error, found.station, found.machine) == (expected.error, expected.station, "m")
    assert np.array_equal(found.factor, expected.factor)
    assert np.array_equal(found.position_mm, expected.position_mm, equal_nan=True)
    table = read_errors(errors)
    assert np.allclose(np.sqrt(np.diag(found.errors_covariance)), vector_u(table), rtol=0, atol=2e-12)


def test_the_file_can_be_read_with_numpy_alone_and_is_the_same_every_time(written):
    _, result, folder = written
    content = (folder / FILE_NAME).read_bytes()
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        rows = len(archive["error"])
        covariance = (archive["factor"] @ archive["factor"].T)[:rows, :rows]
        unit = archive["unit"]
    table = read_errors(folder / "identified.errors.csv")
    assert np.allclose(np.sqrt(np.diag(covariance)), vector_u(table), rtol=0, atol=2e-12)
    assert list(unit[:4]) == ["mm"] * 4
    assert unit[-1] == "rad"
    text = (folder / "identified.errors.csv").read_text()
    assert format_covariance(joint_covariance(result), text) == content


def test_another_errors_file_is_refused(written, tmp_path):
    _, _, folder = written
    other = tmp_path / "identified.errors.csv"
    other.write_text((folder / "identified.errors.csv").read_text().replace("EXX,130.000000,", "EXX,130.000000,9"))
    with pytest.raises(InputError, match="belongs to another errors file"):
        read_covariance(folder / FILE_NAME, other)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.99])
def test_a_cut_file_is_refused(written, tmp_path, share):
    content = (written[2] / FILE_NAME).read_bytes()
    path = tmp_path / "cut.npz"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match=r"cut.npz: (cannot be read|is not a covariance file)"):
        read_covariance(path)


def test_damaged_bytes_are_noticed(written, tmp_path):
    content = bytearray((written[2] / FILE_NAME).read_bytes())
    content[len(content) // 2] ^= 0xFF
    path = tmp_path / "damaged.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="truncated or damaged"):
        read_covariance(path)


def with_member(path, name, content):
    """The same archive with other bytes in one of its arrays."""
    with zipfile.ZipFile(path) as archive:
        members = {item: archive.read(item) for item in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for item, raw in (members | {name: content(members[name])}).items():
            archive.writestr(item, raw)


@pytest.mark.parametrize("bad", [b"(", b"'\\'", b"{'a", b"9" * 60, b"import os", b"\xff\xfe"])
def test_a_damaged_header_of_an_array_is_bad_input_whatever_numpy_makes_of_it(written, tmp_path, bad):
    """Numpy reads a header as an expression of Python: a byte in it gave an error of its tokenizer, and exit code 3."""
    path = tmp_path / "damaged.npz"
    path.write_bytes((written[2] / FILE_NAME).read_bytes())
    with_member(path, "factor.npy", lambda raw: raw[:10] + bad + raw[10 + len(bad) :])
    with pytest.raises(InputError, match="truncated or damaged"):
        read_covariance(path)


@pytest.mark.parametrize("name", ["factor", "error", "setup", "machine", "position_mm"])
def test_a_member_that_is_no_array_is_bad_input(written, tmp_path, name):
    path = tmp_path / "damaged.npz"
    path.write_bytes((written[2] / FILE_NAME).read_bytes())
    with_member(path, f"{name}.npy", lambda raw: b"\x00" + raw[1:])
    with pytest.raises(InputError, match=f"{name} is not an array"):
        read_covariance(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": np.array("other 7")}, "is not a covariance file of this version"),
        ({"factor": None}, "lacks factor"),
        ({"factor": np.zeros((3, 3))}, "do not match"),
        ({"factor": np.array(["x"])}, "something other than numbers"),
        ({"factor": np.array([{}], dtype=object)}, "truncated or damaged"),
        ({"position_mm": "reversed"}, "ascending"),
        ({"error": "renamed"}, "'EQQ'"),
        ({"factor": "nan"}, "not finite"),
    ],
)
def test_what_does_not_fit_is_refused(written, tmp_path, change, message):
    with np.load(written[2] / FILE_NAME, allow_pickle=False) as archive:
        members = {name: archive[name] for name in archive.files}
    special = {
        "reversed": lambda array: array[::-1],
        "renamed": lambda array: np.where(array == "EXX", "EQQ", array),
        "nan": lambda array: np.full(array.shape, np.nan),
    }
    for name, value in change.items():
        members[name] = special[value](members[name]) if isinstance(value, str) else value
    path = tmp_path / "changed.npz"
    np.savez(path, **{name: value for name, value in members.items() if value is not None})
    with pytest.raises(InputError, match=message):
        read_covariance(path)


def test_a_file_of_another_kind_is_refused(written):
    with pytest.raises(InputError, match="is not a covariance file"):
        read_covariance(written[2] / "identified.errors.csv")


# --- command line --------------------------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path, small_machine, small_machine_file, small_lengths_file, call):
    out = tmp_path / "i"
    words = ("--out", out, "--u-wavelength-ppm", "0.5", "--json")
    code, stdout, _ = call("identify", small_machine_file, small_lengths_file, *words)
    assert code == 0
    points = tmp_path / "p.points.csv"
    points.write_text("x_mm,y_mm,z_mm\n-300,-100,-240\n200,300,0\n-50,100,-40\n")
    return out, points, json.loads(stdout)


def test_predict_adds_three_columns(call, files, small_machine, small_machine_file, tmp_path):
    out, points, summary = files
    result = tmp_path / "predicted.csv"
    errors = out / "identified.errors.csv"
    words = ("--points", points, "--out", result, "--json", "--uncertainty")
    code, stdout, _ = call("predict", small_machine_file, errors, *words)
    assert code == 0
    header, *rows = [line for line in result.read_text().splitlines() if not line.startswith("#")]
    assert header.split(",")[-6:] == ["ex_um", "ey_um", "ez_um", "u_x_um", "u_y_um", "u_z_um"]
    u_um = np.array([row.split(",")[-3:] for row in rows], dtype=float)
    covariance = read_covariance(out / FILE_NAME, errors)
    positions = Points(np.array([[-300.0, -100.0, -240.0], [200.0, 300.0, 0.0], [-50.0, 100.0, -40.0]]))
    known = posterior_with(small_machine, read_errors(errors), covariance)
    assert known is not None
    assert np.allclose(u_um, 1e3 * np.sqrt(known.field(positions.position_mm).variance), rtol=0, atol=1e-6)
    least = 1e3 * predict_uncertainty(small_machine, covariance, positions)  # of the values at the nodes alone
    assert (u_um > least - 1e-3).all()
    assert json.loads(stdout)["u_x_max_um"] == pytest.approx(u_um[:, 0].max(), abs=1e-6)
    assert u_um[0, 0] > 0.5e-6 * 250e3  # at least the wavelength's part over 250 mm
    assert summary["systematic"]["wavelength_ppm"]["u"] == 0.5
    named = tmp_path / "named.csv"
    words = ("--points", points, "--out", named, "--uncertainty", out / FILE_NAME)
    assert call("predict", small_machine_file, errors, *words)[0] == 0
    assert named.read_text() == result.read_text()


def test_predict_refuses_a_covariance_of_other_errors(call, files, small_machine_file, tmp_path):
    out, points, _ = files
    assert call("fit", small_machine_file, out / "identified.errors.csv", "--out", out)[0] == 0
    target = tmp_path / "never.csv"
    words = ("--points", points, "--out", target)
    bare = tmp_path / "bare.errors.csv"  # neither a covariance nor uncertainties
    bare.write_text("error,position_mm,value,u_value\nEXX,-300,0,\nEXX,200,10,\n")
    code, _, stderr = call("predict", small_machine_file, bare, *words, "--uncertainty")
    assert (code, "refers to no covariance file" in stderr) == (2, True)
    words = (*words, "--uncertainty", out / FILE_NAME)
    code, _, stderr = call("predict", small_machine_file, out / "fitted.errors.csv", *words)
    assert (code, "belongs to another errors file" in stderr) == (2, True)
    assert not target.exists()


def test_identify_refuses_a_negative_input(call, small_machine_file, small_lengths_file, tmp_path):
    words = ("--out", tmp_path / "no", "--u-drift-um", "-1")
    code, _, stderr = call("identify", small_machine_file, small_lengths_file, *words)
    assert (code, "drift_um" in stderr) == (2, True)
    assert not (tmp_path / "no").exists()


def test_lengths_with_times_and_tools_survive_writing(tmp_path):
    """The systematic part uses these columns; a measurement written and read back gives the same numbers."""
    machine = machine_of(tool_offset_mm=TOOLS[0])
    lengths = readings(machine, tools=TOOLS)
    path = tmp_path / "a.lengths.csv"
    path.write_text(format_lengths(lengths))
    again = read_lengths(path)
    inputs = SystematicInputs(target_um=1.0, target_station_um=1.0, drift_um=1.0)
    options = IdentifyOptions(systematic=inputs)
    first, second = identify(machine, lengths, options), identify(machine, again, options)
    assert np.allclose(vector_u(first.errors), vector_u(second.errors), rtol=1e-6, atol=1e-12)
