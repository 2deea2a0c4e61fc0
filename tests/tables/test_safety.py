"""Steps and ends of tables, tables that were active while measuring, and the check program at the machine."""

import json
import re
from dataclasses import replace
from decimal import Decimal

import numpy as np
import pytest

import compgen
from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.controls import CONTROLLERS
from compgen.controls.siemens_eec import SiemensEec
from compgen.data.deviations import Deviations
from compgen.data.error_table import Curve, ErrorTable
from compgen.data.lengths import Lengths, format_lengths
from compgen.errors import InputError
from compgen.identification import identify_measurement
from compgen.kinematics.exact_chain import exact_error
from compgen.pipeline import identify_bare
from compgen.tables import export, read_tables, verify
from compgen.tables.active import ActiveTables, bare_errors, without_active
from compgen.tables.judge import SafetyLimits, lines_along, safety_of
from compgen.tables.signs import check_files, check_program, exported_tables, signed_permutations

ALL = sorted(CONTROLLERS)
NANOMETRE = 1e-6
MICROMETRE = 1e-3


# --- steps, reference point, ends ------------------------------------------------------------------------------------


def changed_field(tables, name, nodes_mm, values):
    """ISG tables with other nodes and values of one error."""
    field = replace(tables.tables.fields[name], nodes_mm=(nodes_mm,), values=values)
    return replace(tables, tables=replace(tables.tables, fields={**tables.tables.fields, name: field}))


def test_a_wild_node_outside_the_travel_is_found_which_no_residual_shows(small_machine, small_errors):
    """EXX gets a node at X = -500 mm, 200 mm before the travel begins: within the travel nothing changes."""
    good = exported_tables(small_machine, small_errors, "isg-csv")
    field = good.tables.fields["EXX"]
    nodes = np.concatenate([[-500.0], field.nodes_mm[0]])
    wild = changed_field(good, "EXX", nodes, np.concatenate([[0.9], field.values]))
    tame = changed_field(good, "EXX", nodes, np.concatenate([[field.values[0]], field.values]))
    assert verify(small_machine, tame, small_errors).accepted
    result = verify(small_machine, wild, small_errors)
    step_um = 1e3 * abs(0.9 - field.values[0])
    assert len(result.reasons) == 1
    assert result.reasons[0].startswith(f"correction X steps by {step_um:.1f} um between X -500 and -300 mm")
    data = result.summary()["safety"]
    assert data["largest_step_um"] == pytest.approx(step_um, abs=1e-6)
    assert data["largest_slope_um_per_mm"] == pytest.approx(step_um / 200.0, rel=1e-9)
    assert data["reasons"] == list(result.reasons)


def test_a_steep_spike_below_half_a_millimetre_is_found(small_machine, small_errors):
    """60 um over 1 mm outside the travel: more than ten times as steep as anything else."""
    good = exported_tables(small_machine, small_errors, "isg-csv")
    field = good.tables.fields["EXX"]
    nodes = np.concatenate([[-500.0, -499.0, -498.0], field.nodes_mm[0]])
    first = field.values[0]
    spike = changed_field(good, "EXX", nodes, np.concatenate([[first, first + 0.06, first], field.values]))
    reasons = verify(small_machine, spike, small_errors).reasons
    assert len(reasons) == 1
    assert "times as steep" in reasons[0]
    assert re.search(r"between X -(500 and -499|499 and -498) mm", reasons[0])


def test_a_large_squareness_explains_its_large_steps(small_machine, make_errors):
    """8 mrad over 100 mm of Y are steps of 0.8 mm, and right."""
    errors = make_errors(small_machine, squareness_rad=(8e-3, -30e-6, 25e-6))
    result = verify(small_machine, exported_tables(small_machine, errors, "siemens-cec"), errors)
    assert result.accepted, result.reasons
    assert result.safety.summary()["largest_step_um"] > 500.0


def test_steps_are_the_differences_of_neighbouring_values(small_machine, small_errors):
    """A pitch table's steps come straight from its numbers; no other axis has any."""
    tables = exported_tables(small_machine, small_errors, "siemens-eec")
    control = tables.controller
    safety = safety_of(small_machine, control, tables.tables, lambda position: 0.0 * position, SafetyLimits(None))
    found = {(step.output, step.along): step for step in safety.steps}
    assert set(found) == {("X", "X"), ("Y", "Y"), ("Z", "Z")}
    for axis, letter in enumerate("XYZ"):
        numbers, nodes = tables.tables.tables[axis, 0].numbers, tables.tables.tables[axis, 0].nodes_mm
        steps = np.abs(np.diff(numbers)) * 1e3
        worst = int(np.argmax(steps))
        step = found[letter, letter]
        if nodes[0] >= small_machine.lower_mm[axis] - 1e-6 and nodes[-1] <= small_machine.upper_mm[axis] + 1e-6:
            assert step.step_um == pytest.approx(steps[worst], abs=1e-9)
            assert (step.from_mm, step.to_mm) == pytest.approx((nodes[worst], nodes[worst + 1]))
            assert step.slope_um_per_mm == pytest.approx(np.max(steps / np.diff(nodes)), rel=1e-9)


@pytest.mark.parametrize("name", ALL)
def test_the_reference_point_gets_the_emulated_correction(name, small_machine, small_errors):
    tables = exported_tables(small_machine, small_errors, name)
    reference = np.array([small_machine.reference_point_mm])
    expected = tables.correction(small_machine, compgen.Points(reference))[0] * 1e3
    result = verify(small_machine, tables, small_errors)
    found = result.summary()["safety"]["reference_um"]
    assert [found[axis] for axis in "xyz"] == pytest.approx(expected, abs=1e-9)


def test_a_jump_at_the_reference_point_is_a_note(small_machine, small_errors):
    """The squareness of the small machine counts from machine zero: 1 mrad moves X by 100 um at Y = 100 mm."""
    errors = small_errors.replace(squareness={**small_errors.squareness, "EC0Y": (1e-3, 1e-6)})
    result = verify(small_machine, exported_tables(small_machine, errors, "isg-csv"), errors)
    assert result.accepted
    assert any("the correction at the reference point is X +" in note for note in result.notes)


class Dropping(SiemensEec):
    """A pitch table that the control drops outside its range."""

    def emulate(self, tables, points):
        correction = super().emulate(tables, points)
        for (axis, _), table in tables.tables.items():
            along = points.position_mm[:, axis]
            outside = (along < float(table.start_mm) - 1e-9) | (along > float(table.last_mm) + 1e-9)
            correction[outside, axis] = 0.0
        return correction


def test_what_happens_beyond_the_table_is_asked_of_the_control(small_machine, small_errors):
    tables = exported_tables(small_machine, small_errors, "siemens-eec").tables

    def ends(control):
        return safety_of(small_machine, control(small_machine), tables, lambda position: 0.0 * position)

    held, dropped = ends(SiemensEec), ends(Dropping)
    assert {end.outside for end in held.ends} == {"held"}
    assert not any("drops" in warning for warning in held.warnings)
    numbers = tables.tables[2, 0].numbers
    low = next(end for end in dropped.ends if end.along == "Z" and end.end_mm < -200)
    assert low.outside == "dropped"
    assert low.jump_um >= 1e3 * abs(numbers[0]) - 1e-6
    assert any("the tables over Z end at" in warning and "a jump of" in warning for warning in dropped.warnings)


def test_lever_arms_go_on_beyond_the_tables(small_machine, small_errors):
    """E = C P in the control: angles times position go on where the curves are held."""
    tables = exported_tables(small_machine, small_errors, "isg-csv")
    safety = safety_of(small_machine, tables.controller, tables.tables, lambda position: 0.0 * position)
    assert "continued" in {end.outside for end in safety.ends if end.along == "Z"}


def test_the_lines_stand_at_both_ends_and_the_middle(small_machine):
    lines = lines_along(small_machine, 1, np.array([5.0, 7.0]))
    assert lines.shape == (9, 2, 3)
    assert {tuple(line[0, [0, 2]]) for line in lines} == {(x, z) for x in (-300, -50, 200) for z in (-240, -120, 0)}
    assert np.array_equal(lines[4, :, 1], [5.0, 7.0])


def test_a_step_limit_of_the_user_counts(small_machine, small_errors):
    tables = exported_tables(small_machine, small_errors, "siemens-eec")
    largest = verify(small_machine, tables, small_errors).summary()["safety"]["largest_step_um"]
    for share, accepted in ((1.01, True), (0.99, False)):
        result = verify(small_machine, tables, small_errors, limits=SafetyLimits(share * largest))
        assert result.accepted is accepted
    assert "the limit is" in result.reasons[0]


# --- tables that were active while measuring -------------------------------------------------------------------------

STATIONS = np.array([[-420.0, -210, -420], [330, -190, -405], [310, 410, -415], [-400, 430, -90]])
NOISE_MM = 0.2 * MICROMETRE
#: Two measurements with the same noise, at commands some 30 um apart, agree to a tenth of it.
SAME_NOISE_MM = 0.1 * NOISE_MM


@pytest.fixture(scope="module")
def old_tables(small_machine, make_errors):
    """Tables of other errors by control: what happened to be active."""
    errors = make_errors(small_machine, seed=17, squareness_rad=(-60e-6, 80e-6, 15e-6))
    return {name: ActiveTables(exported_tables(small_machine, errors, name)) for name in ALL}


def stops(machine):
    nodes = [axis.nodes_mm for axis in machine.axes]
    return np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 3)


def readings(machine, errors, added):
    """Tracer readings at all nodes while the control adds ``added`` (n, 3): the axes go to p + c(p)."""
    position = stops(machine)
    really = position + added
    tool = np.array(machine.tool_offset_mm)
    tip = really + tool + exact_error(machine, errors, really)
    station = np.repeat(np.arange(4), len(position))
    noise = np.random.default_rng(23).normal(scale=NOISE_MM, size=4 * len(position))
    length = np.linalg.norm(np.tile(tip, (4, 1)) - STATIONS[station], axis=1) - 150.0 + noise
    points = [f"P{k}" for k in range(len(position))] * 4
    return Lengths(("S1", "S2", "S3", "S4"), station, points, np.tile(position, (4, 1)), length)


OPTIONS = compgen.IdentifyOptions(u_length_um=0.2, u_length_um_per_m=0.0)


@pytest.mark.parametrize("name", ALL)
def test_identification_with_active_tables_gives_the_bare_machine(name, small_machine, small_errors, old_tables):
    """Against the truth within the uncertainty, and against the same noise without any table."""
    active = old_tables[name]
    added = active.correction(small_machine, compgen.Points(stops(small_machine)))
    assert np.max(np.abs(added)) > 3 * MICROMETRE
    result = identify_bare(small_machine, readings(small_machine, small_errors, added), OPTIONS, active)
    plain = compgen.identify(small_machine, readings(small_machine, small_errors, 0.0 * added), OPTIONS)
    assert result.corrections["active_tables"]["controller"] == name
    assert 0.8 < result.reduced_chi_square < 1.2
    pulls = []
    for key, curve in result.errors.curves.items():
        assert np.array_equal(curve.position_mm, small_machine.axes["XYZ".index(key[-1])].nodes_mm)
        known = curve.u > 0
        pulls += list((curve.value - small_errors.curves[key].at(curve.position_mm))[known] / curve.u[known])
        without = plain.errors.curves[key]
        assert np.all(np.abs(curve.value - without.value) <= 0.02 * without.u.max()), key
    for key, (value, u) in result.errors.squareness.items():
        pulls.append((value - small_errors.squareness[key][0]) / u)
    assert np.max(np.abs(pulls)) < 4.5
    raw = compgen.identify(small_machine, readings(small_machine, small_errors, added), OPTIONS)
    miss = exact_error(small_machine, raw.errors, stops(small_machine)) - exact_error(
        small_machine, small_errors, stops(small_machine)
    )
    assert np.max(np.abs(miss)) > 3 * MICROMETRE  # without --active the table would have been left in


def test_the_new_table_replaces_the_old_one(small_machine, small_errors, old_tables):
    """At random points: as good as a table from the same noise without any old one; wrong with old and new together."""
    active = old_tables["siemens-cec"]
    added = active.correction(small_machine, compgen.Points(stops(small_machine)))
    found = identify_bare(small_machine, readings(small_machine, small_errors, added), OPTIONS, active).errors
    new = exported_tables(small_machine, found, "siemens-cec")
    position = np.random.default_rng(2).uniform(small_machine.lower_mm, small_machine.upper_mm, (500, 3))
    points = compgen.Points(position)
    alone = new.correction(small_machine, points)
    both = alone + active.correction(small_machine, points)
    plain = compgen.identify(small_machine, readings(small_machine, small_errors, 0.0 * added), OPTIONS).errors
    best = exported_tables(small_machine, plain, "siemens-cec").correction(small_machine, points)
    assert np.max(np.abs(alone - best)) < SAME_NOISE_MM
    left, doubled = (exact_error(small_machine, small_errors, position + c) + c for c in (alone, both))
    assert np.sqrt(np.mean(left**2)) < NOISE_MM
    assert np.max(np.abs(doubled)) > 20 * MICROMETRE


@pytest.mark.parametrize("name", ["siemens-cec", "siemens-cec-eec", "siemens-eec"])
def test_measured_deviations_lose_the_active_table_exactly(name, small_machine, small_errors, old_tables):
    """Without noise: errors as they were put in, to a nanometre over the volume."""
    active = old_tables[name]
    position = stops(small_machine)
    added = active.correction(small_machine, compgen.Points(position))
    really = position + added
    measured = really + exact_error(small_machine, small_errors, really) - position
    machine, moved, report = without_active(small_machine, Deviations(position, measured), active)
    found = identify_measurement(machine, moved).errors
    grid = np.random.default_rng(3).uniform(small_machine.lower_mm, small_machine.upper_mm, (200, 3))
    miss = exact_error(small_machine, found, grid) - exact_error(small_machine, small_errors, grid)
    assert np.max(np.abs(compgen.without_rigid_motion(grid, miss))) < 20 * NANOMETRE
    assert report["largest_correction_um"] == pytest.approx(1e3 * np.max(np.abs(added)))


def test_errors_measured_with_a_table_become_those_of_the_bare_machine(small_machine, small_errors, old_tables):
    """The machine with its table is itself a machine with errors; their difference is taken back exactly."""
    active = old_tables["isg-csv"]
    position = stops(small_machine)
    added = active.correction(small_machine, compgen.Points(position))
    measured = identify_measurement(
        small_machine,
        Deviations(position, added + exact_error(small_machine, small_errors, position + added)),
    ).errors
    bare, lost_um = bare_errors(small_machine, measured, active)
    grid = np.random.default_rng(5).uniform(small_machine.lower_mm, small_machine.upper_mm, (300, 3))
    miss = exact_error(small_machine, bare, grid) - exact_error(small_machine, small_errors, grid)
    assert np.max(np.abs(compgen.without_rigid_motion(grid, miss))) < 0.05 * MICROMETRE
    assert lost_um < 0.05
    assert bare.curves["EXX"].u == pytest.approx(measured.curves["EXX"].u)


def test_the_other_squareness_reference_keeps_its_meaning(small_machine, small_errors, old_tables):
    machine = replace(small_machine, squareness_reference="Y")
    active = old_tables["isg-csv"]
    grid = np.random.default_rng(5).uniform(small_machine.lower_mm, small_machine.upper_mm, (300, 3))
    bare, lost_um = bare_errors(machine, small_errors, active)
    added = active.correction(machine, compgen.Points(grid))
    again = exact_error(machine, bare, grid + added) + added
    assert np.max(np.abs(again - exact_error(machine, small_errors, grid))) < 0.05 * MICROMETRE
    assert lost_um < 0.05


def test_readings_outside_the_travel_are_refused_as_without_tables(small_machine, small_errors, old_tables):
    measured = readings(small_machine, small_errors, 0.0)
    outside = replace(measured, position_mm=measured.position_mm + np.array([600.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="outside the travel"):
        without_active(small_machine, outside, old_tables["isg-csv"])


def test_tables_that_move_by_centimetres_are_refused(small_machine, small_errors, old_tables):
    tables = old_tables["isg-csv"].tables
    field = tables.tables.fields["EXX"]
    wild = ActiveTables(changed_field(tables, "EXX", field.nodes_mm[0], field.values + 50.0))
    with pytest.raises(InputError, match="too far for a compensation"):
        without_active(small_machine, readings(small_machine, small_errors, 0.0), wild)


# --- the same on the command line ------------------------------------------------------------------------------------


@pytest.fixture
def measured_with_table(small_machine, small_errors, make_errors, tmp_path):
    """Lengths file of a machine that was measured with its CEC table active, and that table's file."""
    old = make_errors(small_machine, seed=17, squareness_rad=(-60e-6, 80e-6, 15e-6))
    paths = export(small_machine, old, "siemens-cec").write(tmp_path / "old")
    added = read_tables(small_machine, paths, "siemens-cec").correction(
        small_machine, compgen.Points(stops(small_machine))
    )
    lengths = readings(small_machine, small_errors, added)
    file = tmp_path / "with-table.lengths.csv"
    file.write_text(format_lengths(replace(lengths, metadata={"u_length_um": "0.2", "u_length_um_per_m": "0"})))
    return file, paths[0]


def test_run_with_active_tables_writes_tables_for_the_bare_machine(
    small_machine_file, small_machine, small_errors, measured_with_table, tmp_path, capsys
):
    lengths, table = measured_with_table
    out = tmp_path / "out"
    words = ["run", str(small_machine_file), str(lengths), "--controller", "siemens-cec", "--out", str(out)]
    assert run_command(cli, [*words, "--active", str(table)]) == 0
    capsys.readouterr()
    report = json.loads((out / "identify.json").read_text())["corrections"]["active_tables"]
    assert report["files"][0]["name"] == "NC_CEC.INI"
    position = np.random.default_rng(2).uniform(small_machine.lower_mm, small_machine.upper_mm, (200, 3))
    new = read_tables(small_machine, [out / "NC_CEC.INI"], "siemens-cec").correction(
        small_machine, compgen.Points(position)
    )
    left = exact_error(small_machine, small_errors, position + new) + new
    assert np.sqrt(np.mean(left**2)) < NOISE_MM
    plain = compgen.identify(small_machine, readings(small_machine, small_errors, 0.0), OPTIONS).errors
    fitted = compgen.fit(small_machine, plain).errors
    best = exported_tables(small_machine, fitted, "siemens-cec").correction(small_machine, compgen.Points(position))
    assert np.max(np.abs(new - best)) < SAME_NOISE_MM


def test_identify_and_export_agree_on_the_bare_machine(
    small_machine_file, small_machine, measured_with_table, tmp_path, capsys
):
    """identify --active and then export, against identify as it is and then export --active: up to a rigid motion."""
    lengths, table = measured_with_table
    place = str(small_machine_file)
    active = ["--active", str(table)]
    first, second, tables = (str(tmp_path / name) for name in ("first", "second", "tables"))
    assert (
        run_command(cli, ["identify", place, str(lengths), "--out", first, *active, "--controller", "siemens-cec"]) == 0
    )
    assert run_command(cli, ["identify", place, str(lengths), "--out", second]) == 0
    errors = f"{second}/identified.errors.csv"
    assert run_command(cli, ["export", place, errors, "--controller", "siemens-cec", "--out", tables, *active]) == 0
    capsys.readouterr()
    one, two = (compgen.read_errors(path) for path in (f"{first}/identified.errors.csv", f"{tables}/bare.errors.csv"))
    grid = np.random.default_rng(5).uniform(small_machine.lower_mm, small_machine.upper_mm, (300, 3))
    miss = exact_error(small_machine, one, grid) - exact_error(small_machine, two, grid)
    assert np.max(np.abs(compgen.without_rigid_motion(grid, miss))) < 0.1 * MICROMETRE
    manifest = json.loads((tmp_path / "tables" / "manifest.json").read_text())
    assert "NC_CEC.INI" in {item["name"] for item in manifest["inputs"]}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--active", "{table}", "--controller", "isg-csv", "--controller", "siemens-cec"], "--active-controller"),
        (["--active", "{table}", "--controller", "isg-csv"], "NC_CEC.INI:1"),
        (["--active-controller", "siemens-cec", "--controller", "isg-csv"], "needs --active FILE"),
        (["--max-step-um", "0", "--controller", "isg-csv"], "above zero"),
        (["--active", "none.ini", "--controller", "siemens-cec"], "no such file"),
    ],
)
def test_wrong_words_exit_with_2_and_nothing_is_written(
    words, message, small_machine_file, measured_with_table, tmp_path, capsys
):
    lengths, table = measured_with_table
    out = tmp_path / "out"
    filled = [word.replace("{table}", str(table)) for word in words]
    assert run_command(cli, ["run", str(small_machine_file), str(lengths), "--out", str(out), *filled]) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not out.exists()


# --- the check program -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def programs(small_machine, small_errors):
    return {
        name: check_program(small_machine, exported_tables(small_machine, small_errors, name), small_errors)
        for name in ALL
    }


@pytest.mark.parametrize("name", ALL)
def test_five_different_positions_within_the_travel_approached_from_one_side(name, small_machine, programs):
    program = programs[name]
    assert len({tuple(row) for row in program.position_mm}) == 5
    for place in (program.position_mm, program.before_mm):
        assert np.all(place > small_machine.lower_mm)
        assert np.all(place < small_machine.upper_mm)
    way = program.position_mm - program.before_mm
    assert np.all(way[:, :2] > 0.5)
    assert np.all(way[:, 2] < -0.5)
    assert small_machine.upper_mm[2] > program.safe_z_mm >= program.before_mm[:, 2].max()


@pytest.mark.parametrize("name", ALL)
def test_the_readings_are_those_of_the_exact_machine(name, small_machine, small_errors, programs):
    program = programs[name]
    tables = exported_tables(small_machine, small_errors, name)
    added = tables.correction(small_machine, compgen.Points(program.position_mm))
    off = exact_error(small_machine, small_errors, program.position_mm)
    on = exact_error(small_machine, small_errors, program.position_mm + added) + added
    assert np.max(np.abs(program.added_mm - added)) < NANOMETRE
    assert np.max(np.abs(program.off_mm - (off - off[0]))) < NANOMETRE
    assert np.max(np.abs(program.on_mm - (on - on[0]))) < NANOMETRE


@pytest.mark.parametrize("name", ALL)
def test_every_wrong_permutation_shows_at_one_of_the_positions(name, programs, small_machine, small_errors):
    program = programs[name]
    if name == "linuxcnc-matrixkins":  # it holds so little of this machine that Y and -Z look alike: one twice as bad
        worse = small_errors.with_values(2.0 * small_errors.values())
        program = check_program(small_machine, exported_tables(small_machine, worse, name), worse)
    moved = program.added_mm - program.added_mm[0]
    seen = np.array([np.max(np.abs(moved @ matrix.T - moved)) for matrix in signed_permutations()[1:]])
    assert seen.min() == pytest.approx(program.separation_mm, abs=1e-12)
    corrected = np.any(moved, axis=0)  # the sign of an axis without any table shows nowhere
    wrong = [np.any(matrix[:, corrected] != np.eye(3)[:, corrected]) for matrix in signed_permutations()[1:]]
    assert seen[wrong].min() > 3 * MICROMETRE
    assert np.count_nonzero(wrong) >= (40 if name == "ucnc" else 46)  # which moves X alone


def test_a_wrong_sign_reads_what_the_page_says(small_machine, small_errors, programs):
    """The true machine with every correction reversed, with X reversed, and without any, to the second order."""
    program = programs["siemens-cec"]
    slips = {name: (number, axis, right, wrong) for name, number, axis, right, wrong in program.slips}
    for name, factor in (
        ("all signs reversed", np.array([-1, -1, -1])),
        ("sign of X reversed", np.array([-1, 1, 1])),
        ("compensation does not act, or is 1000 times too small", np.array([0, 0, 0])),
    ):
        number, axis, right, wrong = slips[name]
        added = factor * program.added_mm
        tip = exact_error(small_machine, small_errors, program.position_mm + added) + added
        reading = (tip - tip[0])[number - 1, "XYZ".index(axis)]
        assert reading == pytest.approx(wrong, abs=0.1 * MICROMETRE)
        assert abs(wrong - right) > 10 * MICROMETRE


@pytest.mark.parametrize("name", ["siemens-cec", "siemens-cec-eec"])
@pytest.mark.parametrize("mode", ["S1", "S3"])
def test_one_position_tells_the_four_modes_of_products_apart(name, mode, small_machine, small_errors):
    machine = small_machine.with_setting("siemens-cec", "mult_mode", mode)
    tables = exported_tables(machine, small_errors, name)
    program = check_program(machine, tables, small_errors)
    assert len(program.position_mm) == 5
    slips = {text[10:12]: item for text, *item in program.slips if text.startswith("mult_mode S")}
    assert sorted(slips) == sorted({"S1", "S2", "S3", "S4"} - {mode})
    (number,), (axis,) = ({item[k] for item in slips.values()} for k in (0, 1))
    # each wrong reading by the control of that mode itself: the true machine with what it then adds
    readings = {}
    for other in ("S1", "S2", "S3", "S4"):
        changed = small_machine.with_setting("siemens-cec", "mult_mode", other)
        direction = np.tile([1.0, 1.0, -1.0], (5, 1))
        added = type(tables.controller)(changed).emulate(
            tables.tables, compgen.Points(program.position_mm, approach=direction)
        )
        tip = exact_error(small_machine, small_errors, program.position_mm + added) + added
        readings[other] = (tip - tip[0])[number - 1, "XYZ".index(axis)]
        if other != mode:
            assert readings[other] == pytest.approx(slips[other][3], abs=0.1 * MICROMETRE)
    assert slips["S2"][2] == pytest.approx(readings[mode], abs=0.1 * MICROMETRE)
    assert np.min(np.diff(sorted(readings.values()))) > 5 * MICROMETRE


PROGRAMS = [
    "etalon-exchange",
    "isg-csv",
    "linuxcnc-comp",
    "linuxcnc-volumetric",
    "siemens-cec",
    "siemens-cec-eec",
    "siemens-eec",
    "twincat-lists",
]


@pytest.mark.parametrize("name", ALL)
def test_a_program_is_written_only_where_its_motion_is_documented(name, small_machine, small_errors):
    files = check_files(small_machine, export(small_machine, small_errors, name, allow_unverified=True), small_errors)
    assert ("check/check-program.nc" in files) == (name in PROGRAMS)
    assert ("by hand" in files["check/check-program.md"]) == (name not in PROGRAMS)
    assert all(text.isascii() for text in files.values())


@pytest.mark.parametrize("name", PROGRAMS)
def test_the_program_moves_slowly_z_first_and_stops_five_times_and_once_more(
    name, small_machine, small_errors, programs
):
    """The blocks are walked through by hand: no rapid, no tool, no spindle; X and Y move at the safe height only."""
    made = export(small_machine, small_errors, name, allow_unverified=True)
    text = check_files(small_machine, made, small_errors)["check/check-program.nc"]
    code = [re.sub(r"\(.*?\)|;.*", "", line).strip() for line in text.splitlines()]
    place, stopped, start = {}, [], []
    for line in filter(None, code):
        words = line.split()
        if line == "M0":
            stopped.append(dict(place))
        elif words[0] == "G90":
            start = words
        elif line == "M30":
            break
        else:
            assert words[0] == "G1"
            assert ("SUPA" in words) == name.startswith("siemens")
            assert ("G53" in words) == name.startswith("linuxcnc")
            target = {word[0]: float(word[1:]) for word in words if word[0] in "XYZ"}
            feed = next(int(word[1:]) for word in words if word[0] == "F")
            near = place and all(abs(target.get(k, place[k]) - place[k]) <= 10.0 for k in "XYZ" if k in place)
            assert feed <= (1000 if not near or len(target) < 3 else 200)
            if "X" in target and not near:
                assert place["Z"] == programs[name].safe_z_mm
            place |= target
    linuxcnc = name.startswith("linuxcnc")  # metric is G21 there, and no tool offset G49
    assert {"G90", "G94", *(("G21", "G49") if linuxcnc else ("G71", "D0"))} <= set(start)
    assert not re.search(r"\b[TSH]\d|M0?[36]\b|G0\b|G00", "\n".join(code))
    expected = [dict(zip("XYZ", row, strict=True)) for row in programs[name].position_mm.round(3).tolist()]
    assert stopped == [{}, *expected, expected[0]]
    assert code[-1] == "M30"


def test_names_of_the_user_do_not_reach_the_program(small_machine, small_errors):
    machine = replace(small_machine, name="x ) G0 Z-999 (\nM30 ;")
    for name in PROGRAMS:
        files = check_files(machine, export(machine, small_errors, name, allow_unverified=True), small_errors)
        plain = check_files(
            small_machine, export(small_machine, small_errors, name, allow_unverified=True), small_errors
        )
        assert "999" not in files["check/check-program.nc"]
        assert files["check/check-program.nc"].count("\n") == plain["check/check-program.nc"].count("\n")


def test_a_machine_without_errors_has_a_page_that_says_that_nothing_shows(small_machine, small_errors):
    zero = ErrorTable({"EXX": Curve(np.array([-300.0, 200.0]), np.zeros(2), np.full(2, np.nan))})
    page = check_files(small_machine, export(small_machine, zero, "siemens-cec"), zero)["check/check-program.md"]
    assert "changes at least one reading by 0.0 um" in page
    assert "That is little" in page


def test_steps_of_tables_for_downward_travel_count_too(small_machine, small_errors):
    """A CEC table that acts downwards only (DIRECTION -1) with a wild node: nothing shows on the way up."""
    tables = exported_tables(small_machine, small_errors, "siemens-cec")
    entry = tables.tables.tables[0]
    values = list(entry.table.values)
    values[1] += Decimal("0.7")
    wild = replace(entry, direction=-1, table=replace(entry.table, values=tuple(values)))
    spoilt = replace(tables.tables, tables={**tables.tables.tables, 0: wild})
    safety = safety_of(small_machine, tables.controller, spoilt, lambda position: 0.0 * position)
    axis = "XYZ"[entry.input_axis]
    assert any(f"between {axis} " in reason for reason in safety.reasons)
    assert max(step.step_um for step in safety.steps) > 600.0
