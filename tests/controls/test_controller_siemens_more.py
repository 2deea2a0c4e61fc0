"""SINUMERIK: both kinds of tables together, models with few tables, sub-programs, both measuring systems, golden values."""

import itertools
import re
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from compgen.controls import CONTROLLERS, SourceFile, controller_named
from compgen.controls.siemens_cec_tables import chosen_terms, table_count
from compgen.controls.siemens_machine_data import PROFILES
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Axis, Chain, Machine
from compgen.data.names import error_named
from compgen.data.toml_files import Section
from compgen.errors import InputError
from compgen.kinematics import modelled_errors
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import volume_sample
from compgen.tables import export, read_tables, verify, wanted_correction

GOLDEN = Path(__file__).parents[1] / "golden"
ARITHMETIC = 1e-12  # mm, rounding of doubles
NANOMETRE = 1e-6  # mm
ALL = ("siemens-eec", "siemens-cec", "siemens-cec-eec")
TOOL_MM = (12.0, -25.0, -90.0)


def machine_with(chain="WXYFZT", own=None, others=None):
    """An uneven machine with negative travel, an interior reference point and a tool, with settings of controls."""
    axes = tuple(Axis(r, np.linspace(*r, 7)) for r in ((-350.0, 450.0), (-200.0, 300.0), (-400.0, 50.0)))
    settings = {"siemens-cec": {"sign": "error", "mult_mode": "S1"}, **(others or {}), **(own or {})}
    controls = {name: Section(data, path=None, name=f"controllers.{name}") for name, data in settings.items()}
    return Machine("m", Chain(chain), axes, "X", TOOL_MM, (-50.0, 100.0, -150.0), controllers=controls)


def errors_of(machine, seed=3, angle_rad=60e-6):
    """Errors that are linear between 7 nodes, with the zeros of the fitted curves."""
    generator = np.random.default_rng(seed)
    curves = {}
    for name in modelled_errors(machine):
        error = error_named(name)
        if error.kind == "squareness":
            continue
        nodes = machine.axes[error.axis].nodes_mm
        share = (nodes - nodes[0]) / (nodes[-1] - nodes[0])
        value = np.sin(3.0 * share + generator.uniform(0, 6)) + 0.4 * generator.normal(size=7)
        if error.is_straightness:
            value = value - value[0] - share * (value[-1] - value[0])
        else:
            value = value - np.interp(machine.reference_point_mm[error.axis], nodes, value)
        size = 12e-3 if error.kind == "linear" else angle_rad
        curves[name] = Curve(nodes, value * size, np.full(7, np.nan))
    return ErrorTable(curves, {"EC0Y": (70e-6, np.nan), "EB0Z": (-40e-6, np.nan), "EA0Z": (55e-6, np.nan)})


def positions_in(machine, count=500, seed=8):
    return np.random.default_rng(seed).uniform(machine.lower_mm, machine.upper_mm, (count, 3))


def parsed(machine, name, texts):
    control = controller_named(name)
    own = control.read_settings(machine)
    sources = [SourceFile(Path(file), text) for file, text in texts.items()]
    return control, own, control(machine, own).parse(sources)


def rms(field):
    return float(np.sqrt(np.mean(np.sum(field**2, axis=1))))


# --- an emulator that knows nothing of the package -----------------------------------------------------------------


def read_assignments_plainly(texts):
    """All ``$NAME[index]=value`` of the texts as {name: {indices: value}}."""
    found = {}
    for text in texts.values():
        for name, index, value in re.findall(r"^\$(\w+)\[([\w,]+)\]=\(?([-\w.]+)\)?", text, re.MULTILINE):
            found.setdefault(name, {})[tuple(index.split(","))] = value
    return found


def emulated_plainly(texts, position, *, subtract=True, mode="S1"):
    """What a SINUMERIK adds (n, 3): encoder tables act by minus their value, cross tables by sum and product."""
    data, added = read_assignments_plainly(texts), np.zeros((len(position), 3))
    for encoder, name in data.get("AA_ENC_COMP_STEP", {}):
        axis = int(name[-1]) - 1
        first, step = (float(data[f"AA_ENC_COMP_{key}"][encoder, name]) for key in ("MIN", "STEP"))
        nodes = {int(k[1]): float(v) for k, v in data["AA_ENC_COMP"].items() if (k[0], k[2]) == (encoder, name)}
        values = [nodes[n] for n in range(len(nodes))]
        added[:, axis] = -np.interp(position[:, axis], first + step * np.arange(len(values)), values)
    outputs, total = {}, np.zeros_like(added)
    for (index,), name in data.get("AN_CEC_INPUT_AXIS", {}).items():
        first, step = (float(data[f"AN_CEC_{key}"][(index,)]) for key in ("MIN", "STEP"))
        nodes = {int(k[1]): float(v) for k, v in data["AN_CEC"].items() if k[0] == index}
        values = [nodes[n] for n in range(len(nodes))]
        outputs[index] = np.interp(position[:, int(name[-1]) - 1], first + step * np.arange(len(values)), values)
    factors = {str(int(number) - 1) for number in data.get("AN_CEC_MULT_BY_TABLE", {}).values() if number != "0"}
    for index, value in outputs.items():
        axis = int(data["AN_CEC_OUTPUT_AXIS"][(index,)][-1]) - 1
        other = int(data["AN_CEC_MULT_BY_TABLE"][(index,)]) - 1
        direct = not (other >= 0 and mode in ("S2", "S4")) and not (index in factors and mode in ("S2", "S3"))
        total[:, axis] += value * direct + (value * outputs[str(other)] if other >= 0 else 0.0)
    return added + (-total if subtract else total)


# --- positioning in encoder tables, the rest in cross tables -------------------------------------------------------


@pytest.mark.parametrize("mode", ["S1", "S2", "S3", "S4"])
@pytest.mark.parametrize(("chain", "sign"), [("WXYFZT", "error"), ("WFYXZT", "correction"), ("WZYXFT", "error")])
def test_both_files_together_take_out_what_one_alone_does_not(chain, sign, mode):
    own = {"siemens-cec-eec": {"sign": sign, "mult_mode": mode}}
    machine = machine_with(chain, own, {"siemens-cec": {"sign": "error"}})
    errors = errors_of(machine)
    made = export(machine, errors, "siemens-cec-eec")
    assert sorted(made.files) == ["AX_EEC.INI", "NC_CEC.INI"]
    assert list(made.violations) == []
    control, settings, tables = parsed(machine, "siemens-cec-eec", made.files)
    position = positions_in(machine)
    added = control(machine, settings).emulate(tables, Points(position))
    plain = emulated_plainly(made.files, position, subtract=sign == "error", mode=mode)
    np.testing.assert_allclose(added, plain, atol=ARITHMETIC)
    left = exact_error(machine, errors, position + added) + added
    before = exact_error(machine, errors, position)
    assert rms(left) < 2e-3 * rms(before)
    for file in made.files:
        alone = emulated_plainly({file: made.files[file]}, position, subtract=sign == "error", mode=mode)
        assert rms(exact_error(machine, errors, position + alone) + alone) > 0.1 * rms(before)


def test_the_order_of_the_two_files_does_not_matter_and_one_alone_is_an_error():
    machine = machine_with()
    made = export(machine, errors_of(machine), "siemens-cec-eec")
    _, _, tables = parsed(machine, "siemens-cec-eec", made.files)
    _, _, turned = parsed(machine, "siemens-cec-eec", dict(reversed(made.files.items())))
    assert tables == turned
    for file, missing in (("AX_EEC.INI", "cross"), ("NC_CEC.INI", "encoder")):
        with pytest.raises(InputError, match=f"contain no {missing} tables .* give both AX_EEC and NC_CEC"):
            parsed(machine, "siemens-cec-eec", {file: made.files[file]})


def test_no_cross_table_holds_positioning_and_one_that_does_is_a_violation():
    machine = machine_with(own={"siemens-cec-eec": {"products": False}})
    errors = errors_of(machine)
    made = export(machine, errors, "siemens-cec-eec")
    control, settings, tables = parsed(machine, "siemens-cec-eec", made.files)
    assert all(entry.input_axis != entry.output_axis for entry in tables.cec.tables.values())
    both = {
        **made.files,
        "NC_CEC.INI": export(
            machine_with(own={"siemens-cec": {"sign": "error", "products": False}}), errors, "siemens-cec"
        ).files["NC_CEC.INI"],
    }
    _, _, doubled = parsed(machine, "siemens-cec-eec", both)
    found = control(machine, settings).violations(doubled)
    assert len(found) == 3
    assert "the positioning error of AX1 is in its encoder table and" in found[0]
    assert "corrected twice" in found[0]


def test_folds_of_products_are_no_double_positioning_but_a_changed_one_is():
    machine = machine_with()
    made = export(machine, errors_of(machine), "siemens-cec-eec")
    control, settings, tables = parsed(machine, "siemens-cec-eec", made.files)
    folds = [
        i for i, entry in tables.cec.tables.items() if entry.input_axis == entry.output_axis and not entry.multiplier
    ]
    assert folds
    assert control(machine, settings).violations(tables) == []
    index = folds[0]
    entry = tables.cec.tables[index]
    values = (entry.table.values[0] + Decimal("0.001"), *entry.table.values[1:])
    changed = replace(entry, table=replace(entry.table, values=values))
    wrong = replace(tables, cec=replace(tables.cec, tables={**tables.cec.tables, index: changed}))
    (found,) = control(machine, settings).violations(wrong)
    assert "with up to 1.000 um, also in the CEC tables" in found


def test_a_reversal_stands_in_pairs_of_cross_tables_beside_encoder_tables_without_being_double():
    machine = machine_with()
    reversal = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([-8e-3]), np.zeros(1))})
    made = export(machine, errors_of(machine), "siemens-cec-eec", reversal=reversal)
    assert list(made.violations) == []
    control, settings, tables = parsed(machine, "siemens-cec-eec", made.files)
    position = positions_in(machine, 5)
    moved = [
        control(machine, settings).emulate(tables, Points(position, approach=np.full((5, 3), direction)))
        for direction in (1.0, -1.0)
    ]
    np.testing.assert_allclose(moved[0] - moved[1], [[8e-3, 0.0, 0.0]] * 5, atol=2 * NANOMETRE)


def test_settings_of_the_two_kinds_are_taken_where_the_own_section_is_silent():
    others = {
        "siemens-cec": {"sign": "correction", "mult_mode": "S3", "step_mm": {"X": 80.0}},
        "siemens-eec": {"encoder": 1, "max_points": 300, "decimals": 5, "step_mm": {"Y": 25.0}},
    }
    control = controller_named("siemens-cec-eec")
    settings = control.read_settings(machine_with(others=others))
    assert (settings.sign, settings.mult_mode, settings.step_mm) == ("correction", "S3", (80.0, None, None))
    assert (settings.eec.active, settings.eec.max_points, settings.eec.decimals) == ((1, 1, 1), 300, 5)
    assert settings.eec.step_mm == (None, 25.0, None)
    own = {"siemens-cec-eec": {"sign": "error", "eec_max_points": 50, "encoder": 0}}
    settings = control.read_settings(machine_with(own=own, others=others))
    assert (settings.sign, settings.eec.active, settings.eec.max_points) == ("error", (0, 0, 0), 50)
    with pytest.raises(InputError, match=r"\[controllers.siemens-cec-eec\] mult_mode: is missing"):
        control.read_settings(machine_with(others={"siemens-cec": {"products": True}}))
    with pytest.raises(InputError, match=r"eec_max_pints: is not a known key; did you mean 'eec_max_points'"):
        control.read_settings(machine_with(own={"siemens-cec-eec": {"eec_max_pints": 4}}))


def test_the_rounding_of_both_kinds_adds_up():
    machine = machine_with(own={"siemens-cec-eec": {"sign": "error", "eec_decimals": 3}})
    cross, both = (controller_named(name)(machine).resolution_mm() for name in ("siemens-cec", "siemens-cec-eec"))
    assert both - cross == pytest.approx(0.5e-3)  # half of the last of three decimals of an encoder table


def test_the_preflight_list_of_both_covers_both(tmp_path):
    machine = machine_with()
    page = export(machine, errors_of(machine), "siemens-cec-eec").preflight
    for text in ("MD38000", "MD18342", "MD32700", "MD32710", "MD32720", "SD41300", "AX_EEC.INI", "NC_CEC.INI", "0.56"):
        assert text in page


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("container", ["ini", "program"])
def test_written_tables_are_accepted_and_survive_the_round_trip(tmp_path, name, container):
    own = {name: {"container": container, **({} if name == "siemens-eec" else {"sign": "error"})}}
    machine = machine_with("WFYXZT", own)
    errors = errors_of(machine, angle_rad=5e-6)
    made = export(machine, errors, name)
    result = verify(machine, read_tables(machine, made.write(tmp_path), name), errors)
    assert result.reasons == ()
    assert result.after_rigid_removed.rms_um < result.before_rigid_removed.rms_um


@pytest.mark.parametrize("angle_rad", [120e-6, 1e-3, 3e-3])
@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
def test_the_file_leaves_hardly_more_than_the_optimum_in_its_basis_at_points_that_neither_has_seen(chain, angle_rad):
    """The optimum is found on 8000 random points and judged on others: on its own points it would be too good."""
    own = {"siemens-cec": {"sign": "error", "step_mm": {"X": 40.0, "Y": 25.0, "Z": 22.5}}}
    machine = machine_with(chain, own)
    errors = errors_of(machine, angle_rad=angle_rad)
    control, settings, tables = parsed(machine, "siemens-cec", export(machine, errors, "siemens-cec").files)
    terms = control(machine, settings).basis(errors)
    seen, unseen = positions_in(machine, 8000, seed=1), positions_in(machine, 4000, seed=2)
    best = np.zeros_like(unseen)
    wanted = wanted_correction(machine, errors, seen)
    for output in range(3):
        design = [
            np.hstack([columns_of(term, position) for term in terms if term.carrier[0].output == output])
            for position in (seen, unseen)
        ]
        scale = np.linalg.norm(design[0], axis=0)
        best[:, output] = design[1] @ (np.linalg.lstsq(design[0] / scale, wanted[:, output], rcond=1e-10)[0] / scale)
    added = control(machine, settings).emulate(tables, Points(unseen))
    left = [rms(exact_error(machine, errors, unseen + field) + field) for field in (added, best)]
    print(chain, angle_rad, left, left[0] / left[1])
    assert left[0] <= 1.05 * left[1]


@pytest.mark.parametrize("counts", [(21, 21, 21), (61, 41, 41), (81, 41, 64), (3000, 3000, 3000), (2, 2, 5000)])
def test_points_over_the_volume_integrate_what_tables_hold_whatever_their_number_of_nodes(counts):
    """Means of 1, x, y^2, x y and z x^2 over the box by hand; every table interval has points."""
    machine = machine_with()
    nodes = tuple(np.linspace(*axis.range_mm, n) for axis, n in zip(machine.axes, counts, strict=True))
    sample = volume_sample(machine, nodes)
    assert len(sample.position_mm) < 1_000_000
    low, high = machine.lower_mm, machine.upper_mm
    middle, square = 0.5 * (low + high), (low**2 + low * high + high**2) / 3.0
    x, y, z = sample.position_mm.T
    weight = sample.weight / sample.weight.sum()
    for values, mean, size in (
        (x, middle[0], 450.0),
        (y**2, square[1], 300.0**2),
        (x * y, middle[0] * middle[1], 450.0 * 300.0),
        (z * x**2, middle[2] * square[0], 400.0 * 450.0**2),
    ):
        assert weight @ values == pytest.approx(mean, abs=2e-3 * size)
    assert np.mean(sample.weight) == pytest.approx(1.0)
    for axis in range(3):
        inside = sample.position_mm[sample.weight > 0, axis]
        assert np.all(np.histogram(inside, nodes[axis])[0] > 0)


def columns_of(term, position):
    """Columns of one term at points (n, 3): hats over its axis times its lever."""
    lever = term.carrier[0].lever
    arm = np.ones(len(position)) if lever is None else position[:, lever] - term.carrier[0].origin_mm
    hats = [np.interp(position[:, term.axis], term.nodes_mm, row) for row in np.eye(len(term.nodes_mm))]
    return np.stack(hats, axis=1) * arm[:, None]


# --- models with few tables ----------------------------------------------------------------------------------------


def test_capacities_are_those_of_the_manuals():
    assert (PROFILES["828D"].cec_tables, PROFILES["828D"].cec_nodes) == (8, 200)
    assert (PROFILES["802D sl"].cec_tables, PROFILES["802D sl"].cec_nodes) == (2, 350)
    assert (PROFILES["840D sl"].tables_per_axis, PROFILES["840D sl"].cec_nodes) == (2, 2000)
    assert PROFILES["808D"].eec_nodes == 200
    assert PROFILES["840D sl"].eec_nodes == 5000


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        ({}, (2000, None)),
        ({"profile": "840D sl", "nc_axes": 5}, (2000, 10)),
        ({"profile": "828D"}, (200, 8)),
        ({"profile": "828D", "max_points": 150, "tables_available": 6}, (150, 6)),
        ({"profile": "802D sl"}, (350, 2)),
        ({"profile": "808D", "max_points": 100, "tables_available": 4}, (100, 4)),
    ],
)
def test_a_profile_sets_the_limits_and_the_machine_file_overrides_it(data, expected):
    settings = controller_named("siemens-cec").read_settings(
        machine_with(own={"siemens-cec": {"sign": "error", **data}})
    )
    assert (settings.max_points, settings.tables_available) == expected


def test_a_model_without_documented_cross_tables_is_refused_with_the_reason():
    with pytest.raises(InputError, match="profile: no public document says that this model has cross-error"):
        controller_named("siemens-cec").read_settings(
            machine_with(own={"siemens-cec": {"sign": "error", "profile": "808D"}})
        )
    with pytest.raises(InputError, match="one of '840D sl', '828D', '808D', '802D sl'"):
        controller_named("siemens-cec").read_settings(
            machine_with(own={"siemens-cec": {"sign": "error", "profile": "828"}})
        )


def test_the_21_error_model_takes_19_tables_and_16_with_positioning_apart_and_nothing_folded():
    """Chain with X, then Y, then Z on the tool side, tables as the capacity estimate of the manuals' rules counts them."""
    own = {
        name: {"sign": "error", "mult_mode": mode} for name, mode in (("siemens-cec", "S1"), ("siemens-cec-eec", "S2"))
    }
    machine = replace(machine_with("WFXYZT", own), tool_offset_mm=(0.0, 0.0, 0.0), errors=21)
    errors = errors_of(machine)
    full = export(machine, errors, "siemens-cec").files["NC_CEC.INI"]
    assert len(re.findall("CEC_INPUT_AXIS", full)) == 19
    apart = export(machine, errors, "siemens-cec-eec").files["NC_CEC.INI"]
    assert len(re.findall("CEC_INPUT_AXIS", apart)) == 16


@pytest.mark.parametrize(("mode", "allowed"), [("S1", 8), ("S1", 2), ("S2", 8), ("S3", 5), ("S4", 11)])
def test_the_kept_tables_are_the_best_of_all_sets_by_brute_force(mode, allowed):
    """All subsets of the 15 terms, judged by a least squares of their own on random points, errors of one seed each."""
    own = {"siemens-cec": {"sign": "error", "mult_mode": mode, "step_mm": {"X": 400.0, "Y": 250.0, "Z": 225.0}}}
    machine = machine_with("WFYXZT", own)
    errors = errors_of(machine, seed=allowed)
    control = controller_named("siemens-cec")
    terms = control(machine).basis(errors)
    kept = chosen_terms(machine, errors, terms, mode, allowed).kept
    assert table_count(kept, mode) <= allowed
    position = positions_in(machine, 3000)
    wanted = wanted_correction(machine, errors, position)

    def normal_of(output):
        own_terms = [term for term in terms if term.carrier[0].output == output]
        return own_terms, [columns_of(term, position) for term in own_terms]

    def left_of(blocks, output):
        if not blocks:
            return float(np.sum(wanted[:, output] ** 2))
        design = np.hstack(blocks)
        design = design / np.linalg.norm(design, axis=0)
        rest = wanted[:, output] - design @ np.linalg.lstsq(design, wanted[:, output], rcond=1e-9)[0]
        return float(rest @ rest)

    best_of, own_left = [], 0.0
    for output in range(3):
        own_terms, blocks = normal_of(output)
        options = {}
        for size in range(len(own_terms) + 1):
            for part in itertools.combinations(range(len(own_terms)), size):
                count = table_count([own_terms[k] for k in part], mode)
                left = left_of([blocks[k] for k in part], output)
                options[count] = min(options.get(count, np.inf), left)
        best_of.append(options)
        own_left += left_of([block for term, block in zip(own_terms, blocks, strict=True) if term in kept], output)
    best = min(
        sum(left for _, left in part)
        for part in itertools.product(*(options.items() for options in best_of))
        if sum(count for count, _ in part) <= allowed
    )
    assert own_left <= 1.03 * best  # the sample of the ranking and the points here are not the same


def mean_and_square(curve):
    """Mean of a function that is linear between nodes, and of its square, over the range of its nodes."""
    gap, a, b = np.diff(curve.position_mm), curve.value[:-1], curve.value[1:]
    return np.array([np.sum(gap * (a + b) / 2), np.sum(gap * (a * a + a * b + b * b) / 3)]) / np.sum(gap)


def test_what_is_left_of_jagged_curves_is_their_standard_deviation_over_the_travel():
    """41 nodes to an axis, and neighbours that have nothing in common.

    Without X(y), the mean of its curve goes into other tables. Without X(x)*z, so does what depends on x or on z only:
    (e - mean) (z - mean) is left of e(x) z, and the standard deviation of z is its travel divided by the root of 12.
    """
    ranges_mm = ((-350.0, 450.0), (-200.0, 300.0), (-400.0, 50.0))
    axes = tuple(Axis(range_mm, np.linspace(*range_mm, 41)) for range_mm in ranges_mm)
    steps_mm = {letter: axis.length_mm / 40 for letter, axis in zip("XYZ", axes, strict=True)}
    settings = {"sign": "error", "mult_mode": "S2", "step_mm": steps_mm}
    machine = machine_with("WFYXZT", {"siemens-cec": settings})
    machine = replace(machine, axes=axes, tool_offset_mm=(0.0, 0.0, -90.0))
    rng = np.random.default_rng(4)

    def jagged(axis, size):
        return Curve(axes[axis].nodes_mm, size * rng.normal(size=41), np.full(41, np.nan))

    x, y, z, angle = jagged(0, 0.02), jagged(1, 0.004), jagged(2, 0.02), jagged(0, 30e-6)
    (mean, square), (mean_rad, square_rad) = mean_and_square(y), mean_and_square(angle)
    straight = ErrorTable({"EXX": x, "EXY": y, "EXZ": z})
    terms = controller_named("siemens-cec")(machine).basis(straight)
    choice = chosen_terms(machine, straight, terms, "S2", 2)
    left_mm = np.sqrt(square - mean**2)
    assert choice.dropped == (("X(y)", pytest.approx(left_mm, rel=1e-9)),)
    assert choice.left_mm == pytest.approx(left_mm, rel=1e-9)

    leaning = ErrorTable({"EXX": x, "EXY": y, "EXZ": z, "EBX": angle})
    terms = controller_named("siemens-cec")(machine).basis(leaning)
    left_mm = np.sqrt((square_rad - mean_rad**2) * axes[2].length_mm ** 2 / 12)
    encoder = [term for term in terms if term.name == "X(x)"]
    for own, given, allowed in ((terms, [], 3), ([term for term in terms if term not in encoder], encoder, 2)):
        choice = chosen_terms(machine, leaning, own, "S2", allowed, given)
        assert choice.dropped == (("X(x)*z", pytest.approx(left_mm, rel=1e-9)),)
        assert choice.left_mm == pytest.approx(left_mm, rel=1e-9)


def test_what_tables_with_other_nodes_than_the_errors_would_remove_is_what_they_can_follow():
    """Errors with 31 nodes, tables with 41: least squares along the axis, at eight points between all of them."""
    ranges_mm = ((-350.0, 450.0), (-200.0, 300.0), (-400.0, 50.0))
    axes = tuple(Axis(range_mm, np.linspace(*range_mm, 41)) for range_mm in ranges_mm)
    steps_mm = {letter: axis.length_mm / 40 for letter, axis in zip("XYZ", axes, strict=True)}
    settings = {"sign": "error", "mult_mode": "S2", "step_mm": steps_mm}
    machine = replace(machine_with("WFYXZT", {"siemens-cec": settings}), axes=axes, tool_offset_mm=(0.0, 0.0, 0.0))
    rng = np.random.default_rng(5)
    x, y = (
        Curve(np.linspace(*ranges_mm[axis], 31), size * rng.normal(size=31), np.full(31, np.nan))
        for axis, size in ((0, 0.02), (1, 0.004))
    )
    errors = ErrorTable({"EXX": x, "EXY": y})
    choice = chosen_terms(machine, errors, controller_named("siemens-cec")(machine).basis(errors), "S2", 1)
    ends = np.unique(np.concatenate([y.position_mm, axes[1].nodes_mm]))
    points, weight = np.polynomial.legendre.leggauss(8)
    along = (0.5 * (ends[1:] + ends[:-1])[:, None] + 0.5 * np.diff(ends)[:, None] * points).ravel()
    weight = (np.diff(ends)[:, None] * weight).ravel() / np.sum(np.diff(ends)) / 2
    hats = np.stack([np.interp(along, axes[1].nodes_mm, row) for row in np.eye(41)], axis=1)
    wanted, root = np.interp(along, y.position_mm, y.value), np.sqrt(weight)
    follows = hats @ np.linalg.lstsq(root[:, None] * hats, root * wanted, rcond=None)[0]
    left_mm = np.sqrt(weight @ follows**2 - (weight @ wanted) ** 2)
    assert choice.dropped == (("X(y)", pytest.approx(left_mm, rel=1e-9)),)
    assert choice.left_mm == pytest.approx(left_mm, rel=1e-9)


@pytest.mark.parametrize("profile", ["828D", "802D sl"])
@pytest.mark.parametrize("name", ["siemens-cec", "siemens-cec-eec"])
def test_a_model_with_few_tables_gets_accepted_ones_and_says_what_stays(tmp_path, profile, name):
    own = {name: {"sign": "error", "mult_mode": "S1", "profile": profile}}
    machine = machine_with("WFYXZT", own)
    errors = errors_of(machine, angle_rad=20e-6)
    made = export(machine, errors, name)
    assert list(made.violations) == []
    control, settings, tables = parsed(machine, name, made.files)
    entries = (tables.cec if name.endswith("eec") else tables).tables
    assert len(entries) <= PROFILES[profile].cec_tables
    assert all(len(entry.table.values) <= PROFILES[profile].cec_nodes for entry in entries.values())
    (note,) = [text for text in made.warnings if "not corrected: " in text]
    assert re.search(r"tables are needed, but only \d may be used; not corrected: .*\(\d+\.\d\d um rms\)", note)
    assert note in made.preflight
    result = verify(machine, read_tables(machine, made.write(tmp_path), name), errors)
    assert result.reasons == ()
    position = positions_in(machine)
    added = control(machine, settings).emulate(tables, Points(position))
    left, before = (
        rms(exact_error(machine, errors, position + added) + added),
        rms(exact_error(machine, errors, position)),
    )
    assert left < before
    said = float(re.search(r"together these leave ([\d.]+) um", note).group(1)) * 1e-3
    assert said == pytest.approx(left, rel=0.1)


def test_a_set_that_is_nearly_as_good_is_judged_by_what_it_holds_and_a_bad_one_by_the_best(tmp_path):
    """Straightness X(y) and Y(x) of nearly one size and room for one table: slightly other errors prefer the other."""
    machine = machine_with("WFYXZT", {"siemens-cec": {"sign": "error", "mult_mode": "S1", "tables_available": 1}})
    nodes = [axis.nodes_mm for axis in machine.axes]
    shape = np.array([0.0, 1.0, -1.0, 1.0, -1.0, 1.0, 0.0])

    def errors(exy_mm, eyx_mm):
        unknown = np.full(7, np.nan)
        return ErrorTable(
            {"EXY": Curve(nodes[1], exy_mm * shape, unknown), "EYX": Curve(nodes[0], eyx_mm * shape, unknown)}
        )

    made = export(machine, errors(10.1e-3, 10e-3), "siemens-cec")
    assert "$AN_CEC_INPUT_AXIS[0]=(AX2)" in made.files["NC_CEC.INI"]
    tables = read_tables(machine, made.write(tmp_path), "siemens-cec")
    assert verify(machine, tables, errors(10e-3, 10.1e-3)).reasons == ()
    assert any("correction Y" in reason for reason in verify(machine, tables, errors(6e-3, 12e-3)).reasons)


@pytest.mark.parametrize(
    ("shape", "steps"),
    [
        ([0.0, *[1.0, -1.0, 0.0] * 2], None),
        ([0.0, *[1.0, 0.0, -1.0, 0.0] * 2], {"X": 100.0, "Y": 62.5, "Z": 56.25}),  # not the nodes of the machine
    ],
)
def test_what_has_no_room_is_named_with_its_rms_the_largest_first(shape, steps):
    """A zigzag of size a and mean zero has a root mean square of a / sqrt(3): 5.77, 2.89 and 0.009 um."""
    own = {"sign": "error", "mult_mode": "S1", "tables_available": 1, **({"step_mm": steps} if steps else {})}
    machine = machine_with("WFYXZT", {"siemens-cec": own})
    unknown = np.full(len(shape), np.nan)
    sizes = {"EXY": 12e-3, "EXZ": 5e-3, "EYX": 10e-3, "EZX": 15e-6}
    curves = {
        name: Curve(
            np.linspace(*machine.axes["XYZ".index(name[2])].range_mm, len(shape)), size * np.array(shape), unknown
        )
        for name, size in sizes.items()
    }
    (note,) = [
        text for text in export(machine, ErrorTable(curves), "siemens-cec").warnings if "not corrected: " in text
    ]
    found = re.findall(r"(\w\(\w\)) \(([\d.]+) um rms\)", note)
    assert [name for name, _ in found] == ["Y(x)", "X(z)"]
    together = re.search(r"together these leave ([\d.]+) um rms over the volume", note).group(1)
    due = [10.0, 5.0, np.hypot(10.0, 5.0)] / np.sqrt(3.0)
    # the figures are taken at a thinned sample of the volume, which is right to half a percent here
    assert [float(text) for text in (*(text for _, text in found), together)] == pytest.approx(due, rel=0.01)


def test_what_encoder_tables_hold_is_not_missed_by_a_cross_table_that_has_no_room():
    """A pitch error of 30 um from end to end has a mean; X(z) could take it up, but the encoder table of X has it."""
    own = {"sign": "error", "mult_mode": "S1", "products": False, "tables_available": 1}
    machine = machine_with("WFYXZT", {"siemens-cec-eec": own})
    x, _, z = (axis.nodes_mm for axis in machine.axes)
    unknown, shape = np.full(7, np.nan), np.array([0.0, *[1.0, -1.0, 0.0] * 2])
    pitch = np.interp(x, [-350.0, -50.0, 450.0], [-0.002, 0.0, 0.03])
    errors = ErrorTable(
        {
            "EXX": Curve(x, pitch, unknown),
            "EYX": Curve(x, 10e-3 * shape, unknown),
            "EXZ": Curve(z, 5e-3 * shape, unknown),
        }
    )
    (note,) = [text for text in export(machine, errors, "siemens-cec-eec").warnings if "not corrected: " in text]
    ((name, size),) = re.findall(r"(\w\(\w\)) \(([\d.]+) um rms\)", note)
    assert name == "X(z)"
    assert float(size) == pytest.approx(5.0 / np.sqrt(3.0), rel=0.1)  # 9.5 with the mean of 9 um


def test_more_tables_never_leave_more():
    errors, left = None, []
    for tables in (1, 3, 6, 9, 13, 19):
        machine = machine_with(
            "WFYXZT", {"siemens-cec": {"sign": "error", "mult_mode": "S1", "tables_available": tables}}
        )
        errors = errors or errors_of(machine)
        control, settings, read = parsed(machine, "siemens-cec", export(machine, errors, "siemens-cec").files)
        position = positions_in(machine, 2000)
        added = control(machine, settings).emulate(read, Points(position))
        left.append(rms(exact_error(machine, errors, position + added) + added))
    assert all(after <= 1.01 * before for before, after in itertools.pairwise(left))
    assert left[-1] < 1e-2 * left[0]


def test_reserved_tables_stay_free_for_a_pair_of_one_direction():
    own = {"siemens-cec": {"sign": "error", "mult_mode": "S1", "profile": "828D", "tables_reserved": 2}}
    machine = machine_with("WFYXZT", own)
    reversal = ReversalCurves({(0, 0): Curve(np.zeros(1), np.array([-8e-3]), np.zeros(1))})
    made = export(machine, errors_of(machine), "siemens-cec", reversal=reversal)
    assert list(made.violations) == []
    _, _, tables = parsed(machine, "siemens-cec", made.files)
    assert sorted(entry.direction for entry in tables.tables.values())[0] == -1
    assert len(tables.tables) <= 8


def test_the_speed_of_the_sum_is_held_against_a_stated_limit():
    speeds = {"X": 30000.0, "Y": 30000.0, "Z": 15000.0}
    text = (GOLDEN / "siemens-cec" / "two_tables.ini").read_text()
    for percent, broken in ((0.0039, 1), (0.0041, 0)):
        data = {"sign": "error", "max_velo_percent": percent, "max_speed_mm_min": speeds}
        machine = replace(machine_with(own={"siemens-cec": data}))
        control, settings, tables = parsed(machine, "siemens-cec", {"t": text})
        found = [item for item in control(machine, settings).violations(tables) if "MD32730" in item]
        assert len(found) == broken  # Z: 0.005 / 250 per mm of X, which runs twice as fast: 0.004 %
        assert not found or "AX3" in found[0]


# --- both measuring systems ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stated", "encoders"),
    [
        (0, ((0,), (0,), (0,))),
        (1, ((1,), (1,), (1,))),
        ([1, 0], ((0, 1), (0, 1), (0, 1))),
        ({"X": [0, 1], "Z": 1}, ((0, 1), (0,), (1,))),
    ],
)
def test_every_measuring_system_that_is_stated_gets_its_table(stated, encoders):
    machine = machine_with(own={"siemens-eec": {"encoder": stated}})
    made = export(machine, errors_of(machine), "siemens-eec")
    (text,) = made.files.values()
    for axis, own in enumerate(encoders):
        assert {int(e) for e in re.findall(rf"ENC_COMP_STEP\[(\d),AX{axis + 1}\]", text)} == set(own)
        for encoder in own:
            assert f"MD38000 $MA_MM_ENC_COMP_MAX_POINTS[{encoder},AX{axis + 1}]" in made.preflight
    control, settings, tables = parsed(machine, "siemens-eec", made.files)
    assert set(tables.tables) == {(axis, encoder) for axis, own in enumerate(encoders) for encoder in own}
    assert control(machine, settings).violations(tables) == []


def test_only_the_active_measuring_system_acts():
    text = (GOLDEN / "siemens-eec" / "five_nodes.ini").read_text().replace("M17\n", "").replace("X1", "AX1")
    other = "".join(line + "\n" for line in text.splitlines() if line.startswith("$")).replace("[0,", "[1,")
    other = other.replace("=0.004000", "=0.006000")
    for active, value in ((0, 0.004), (1, 0.006)):
        data = {"encoder": {"X": [0, 1]}, "active_encoder": {"X": active}}
        machine = machine_with(own={"siemens-eec": data})
        control, settings, tables = parsed(machine, "siemens-eec", {"t": text + other + "M17\n"})
        moved = control(machine, settings).emulate(tables, Points(np.array([[50.0, 0.0, 0.0]])))
        np.testing.assert_allclose(moved, [[-value, 0.0, 0.0]], atol=ARITHMETIC)
    _, _, alone = parsed(machine, "siemens-eec", {"t": text + "M17\n"})
    assert "AX1 has no table for measuring system 2" in control(machine, settings).violations(alone)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"encoder": 2}, "expected 0 (measuring system 1), 1 (measuring system 2) or [0, 1]"),
        ({"encoder": [0, 0]}, "expected 0 (measuring system 1), 1 (measuring system 2) or [0, 1]"),
        ({"encoder": {"A": 0}}, "a table of these with the keys X, Y, Z"),
        ({"encoder": True}, "expected 0 (measuring system 1), 1 (measuring system 2) or [0, 1]"),
        ({"encoder": 0, "active_encoder": 1}, "active_encoder: expected one of the encoders of X, [0]"),
        ({"program_enables": True}, 'needs container = "program"'),
        ({"container": "spf"}, "expected one of 'ini', 'program'"),
    ],
)
def test_wrong_settings_of_encoder_tables_say_what_is_expected(data, message):
    with pytest.raises(InputError) as caught:
        controller_named("siemens-eec").read_settings(machine_with(own={"siemens-eec": data}))
    assert message in str(caught.value)


def test_an_encoder_table_of_a_small_control_keeps_its_number_of_nodes():
    machine = machine_with(own={"siemens-eec": {"profile": "808D", "loss_um": 1e-6}})
    errors = errors_of(machine)
    _, settings, tables = parsed(machine, "siemens-eec", export(machine, errors, "siemens-eec").files)
    assert settings.max_points == 200
    assert max(len(table.values) for table in tables.tables.values()) <= 200
    machine = machine_with(own={"siemens-eec": {"profile": "802D sl"}})
    assert any(
        "is not documented; the limit is taken as 200" in text
        for text in export(machine, errors, "siemens-eec").warnings
    )


# --- sub-programs --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_a_sub_program_holds_the_same_tables_and_switches_the_function_off_first(name):
    machines = {
        kind: machine_with(own={name: {"container": kind, **({} if name == "siemens-eec" else {"sign": "error"})}})
        for kind in ("ini", "program")
    }
    errors = errors_of(machines["ini"])
    made = {kind: export(machine, errors, name).files for kind, machine in machines.items()}
    assert all(file.endswith(".SPF") for file in made["program"])
    read = [parsed(machines[kind], name, made[kind])[2] for kind in ("ini", "program")]
    assert read[0] == read[1]
    assert parsed(machines["ini"], name, made["program"])[2] == read[0]  # either container is read with any setting
    for text in made["program"].values():
        lines = [line for line in text.splitlines() if not line.startswith(";")]
        assert lines[0].startswith("%_N_") and lines[0].endswith("_SPF")
        assert "CHANDATA" not in text
        first_table = next(k for k, line in enumerate(lines) if re.match(r"\$A[AN]_", line))
        assert lines[first_table - 1] == "NEWCONF"
        assert all(re.match(r"\$MA_(ENC_COMP|CEC)_ENABLE\[.*\]=0", line) for line in lines[1 : first_table - 1])
        assert "ENABLE[" not in "".join(lines[first_table:])
        assert lines[-1] == "M17"


def test_a_sub_program_switches_the_tables_on_where_that_is_asked_for():
    data = {"sign": "error", "container": "program", "program_enables": True}
    machine = machine_with(own={"siemens-cec-eec": data})
    made = export(machine, errors_of(machine), "siemens-cec-eec")
    assert made.files["NC_CEC.SPF"].endswith(
        "$MA_CEC_ENABLE[AX1]=1\n$MA_CEC_ENABLE[AX2]=1\n$MA_CEC_ENABLE[AX3]=1\nNEWCONF\nM17\n"
    )
    assert made.files["AX_EEC.SPF"].endswith("$MA_ENC_COMP_ENABLE[0,AX3]=1\nNEWCONF\nM17\n")
    assert "$SN_CEC_TABLE_ENABLE[0]=1" in made.files["NC_CEC.SPF"]
    parsed(machine, "siemens-cec-eec", made.files)


def constant(index, value, multiplier=0, direction=0):
    """A table of one value over the travel of X, into X."""
    lines = [f"$AN_CEC[{index},{node}]={value}" for node in (0, 1)]
    lines += [f"$AN_CEC_INPUT_AXIS[{index}]=(AX1)", f"$AN_CEC_OUTPUT_AXIS[{index}]=(AX1)"]
    lines += [f"$AN_CEC_{key}[{index}]={number}" for key, number in (("STEP", 800.0), ("MIN", -350.0), ("MAX", 450.0))]
    lines += [f"$AN_CEC_DIRECTION[{index}]={direction}", f"$AN_CEC_MULT_BY_TABLE[{index}]={multiplier}"]
    return "\n".join([*lines, f"$AN_CEC_IS_MODULO[{index}]=0", ""])


@pytest.mark.parametrize(
    ("switch", "moved"),
    [
        ("", -0.5),
        ("$SN_CEC_TABLE_ENABLE[1]=0\n", -0.2),
        ("$SN_CEC_TABLE_ENABLE[1]=0\n$SN_CEC_TABLE_ENABLE[1]=1\n", -0.5),
        ("$SN_CEC_TABLE_WEIGHT[1]=0.5\n", -0.35),
    ],
)
def test_switch_and_weight_of_a_table_count(switch, moved):
    machine = machine_with()
    text = constant(0, "0.2") + constant(1, "0.3") + switch + "M17\n"
    control, settings, tables = parsed(machine, "siemens-cec", {"t": text})
    assert control(machine, settings).emulate(tables, Points(np.zeros((1, 3))))[0, 0] == pytest.approx(moved, abs=1e-12)
    assert control(machine, settings).violations(tables) == []


@pytest.mark.parametrize(
    ("mode", "text", "doubled"),
    [
        # what the mode leaves of 0.2 mm times 0.3 mm beside the product
        ("S1", constant(0, "0.2", 2) + constant(1, "0.3"), "with up to 500.000 um, also in the CEC tables [0, 1]"),
        ("S2", constant(0, "0.2", 2) + constant(1, "0.3"), ""),
        ("S3", constant(0, "0.2", 2) + constant(1, "0.3"), "with up to 200.000 um, also in the CEC tables [0]"),
        ("S4", constant(0, "0.2", 2) + constant(1, "0.3"), "with up to 300.000 um, also in the CEC tables [1]"),
        # the mean of both directions
        (
            "S1",
            constant(0, "0.2") + constant(1, "0.3", direction=-1),
            "with up to 350.000 um, also in the CEC tables [0, 1]",
        ),
        ("S1", constant(0, "0.3", direction=1) + constant(1, "-0.3", direction=-1), ""),
    ],
)
def test_positioning_in_both_kinds_of_tables_is_what_the_mode_leaves_of_it(mode, text, doubled):
    machine = machine_with(own={"siemens-cec-eec": {"sign": "error", "mult_mode": mode}})
    files = {
        "NC_CEC.INI": text + "M17\n",
        "AX_EEC.INI": export(machine, errors_of(machine), "siemens-eec").files["AX_EEC.INI"],
    }
    control, settings, tables = parsed(machine, "siemens-cec-eec", files)
    found = [item for item in control(machine, settings).violations(tables) if "corrected twice" in item]
    assert len(found) == bool(doubled)
    assert all("the positioning error of AX1 is in its encoder table and, " + doubled in item for item in found)


def test_a_switch_or_a_step_is_no_table():
    """Both kinds must be there with their numbers, also where an archive names something of the missing kind."""
    machine = machine_with(own={"siemens-cec-eec": {"sign": "error"}})
    made = export(machine, errors_of(machine), "siemens-cec-eec").files
    control = controller_named("siemens-cec-eec")
    of_control = control(machine, control.read_settings(machine))
    for file, other, missing in (
        ("AX_EEC.INI", "$SN_CEC_TABLE_ENABLE[0]=1", "cross"),
        ("NC_CEC.INI", "$AA_ENC_COMP_STEP[0,AX1]=1.0", "encoder"),
    ):
        with pytest.raises(
            InputError, match=f"other: the files contain no {missing} tables .* give both AX_EEC and NC_CEC"
        ):
            parsed(machine, "siemens-cec-eec", {file: made[file], "other": f"{other}\nM17\n"})
        with pytest.raises(
            InputError, match=f"{file}: the files contain no {missing} tables .* give all files of the control"
        ):
            of_control.parse_foreign([SourceFile(Path(file), made[file])])
        both = [SourceFile(Path(file), made[file]), SourceFile(Path("other"), f"{other}\nM17\n")]
        with pytest.raises(
            InputError, match=f"other: the files contain no {missing} tables .* give all files of the control"
        ):
            of_control.parse_foreign(both)


@pytest.mark.parametrize("switch", ["$SN_CEC_TABLE_ENABLE[1]=0", "$SN_CEC_TABLE_WEIGHT[0]=2.0"])
def test_a_factor_that_is_switched_off_or_weighted_is_a_violation(switch):
    machine = machine_with()
    text = constant(0, "0.2", 2) + constant(1, "0.3") + switch + "\nM17\n"
    control, settings, tables = parsed(machine, "siemens-cec", {"t": text})
    (found,) = control(machine, settings).violations(tables)
    assert "is a factor of a product" in found and "is not documented" in found


@pytest.mark.parametrize(
    ("text", "message", "line"),
    [
        (
            "$MA_CEC_ENABLE[AX1]=1\nNEWCONF\n" + constant(0, "0.1"),
            "is written while $MA_CEC_ENABLE[AX1] is 1 (line 1)",
            3,
        ),
        ("$MA_CEC_ENABLE[AX1]=2\n" + constant(0, "0.1"), "2 is not a whole number from 0 to 1", 1),
        ("$MA_CEC_ENABLE[AX7]=0\n" + constant(0, "0.1"), "no axis of the machine file is named 'AX7'", 1),
        (constant(0, "0.1") + "$SN_CEC_TABLE_ENABLE[5]=1\n", "the files contain no table 5", 11),
        (constant(0, "0.1") + "$SN_CEC_TABLE_WEIGHT[0]=1E0\n", "has an exponent", 11),
        ("$MA_CEC_ENABLE[AX1]=0\nNEWCONF\n", "contains no table", None),
        ("NEWCONFIG\n" + constant(0, "0.1"), "'NEWCONFIG' is not an assignment", 1),
    ],
)
def test_malformed_sub_programs_are_errors_at_their_line(text, message, line):
    with pytest.raises(InputError) as caught:
        parsed(machine_with(), "siemens-cec", {"t.spf": text + "M17\n"})
    assert message in str(caught.value)
    assert caught.value.line == line


# --- golden values -------------------------------------------------------------------------------------------------


def test_the_direction_example_of_the_manual_has_11_nodes_and_a_pair_of_tables():
    """K3-2013, p. 264: X from -585 to -5 in steps of 58, two tables with DIRECTION 1 and -1, MD18342 = 11 for both."""
    axes = (Axis((-585.0, -5.0), np.linspace(-585, -5, 11)), *machine_with().axes[1:])
    data = {"siemens-cec": Section({"sign": "error", "step_mm": {"X": 58.0}}, path=None, name="c")}
    machine = replace(machine_with(), axes=axes, reference_point_mm=(-5.0, 100.0, -150.0), controllers=data)
    nodes = np.array([-585, -527, -469, -411, -353, -295, -237, -179, -121, -63, -5], dtype=float)
    reversal = ReversalCurves({(0, 0): Curve(nodes, np.linspace(-9e-3, -4e-3, 11), np.full(11, np.nan))})
    made = export(machine, ErrorTable({}, {"EC0Y": (0.0, np.nan)}), "siemens-cec", reversal=reversal)
    _, _, tables = parsed(machine, "siemens-cec", made.files)
    pair = [entry for entry in tables.tables.values() if entry.direction]
    assert [entry.direction for entry in pair] == [1, -1]
    for entry in pair:
        np.testing.assert_array_equal(entry.table.nodes_mm, nodes)
        assert (entry.input_axis, entry.output_axis, entry.table.step_mm) == (0, 0, Decimal(58))
    rows = {row["name"]: row["value"] for row in made.manifest["parameters"]}
    for index, entry in tables.tables.items():
        if entry.direction:
            assert rows[f"MD18342 $MN_MM_CEC_MAX_POINTS[{index}]"] == "11"
    assert rows["MD32450 $MA_BACKLASH[AX1]"] == "0"


def test_nodes_of_the_802s_example_give_its_values():
    """802S/C base line, p. 6-116: as the 840D example, nodes 0, 1, 800 = 0.01, 0.012, -0.02, no header CHANDATA."""
    text = (GOLDEN / "siemens-eec" / "manual_p242.ini").read_text()
    text = text.replace("%_N_AX_EEC_INI\nCHANDATA(1)\n", "%_N_EECDAT_EEC_INI\n")
    for node, value in ((0, "0.01"), (1, "0.012"), (800, "-0.02")):
        text = re.sub(rf"(\$AA_ENC_COMP\[0,{node},X1\])=.*", rf"\1={value}", text)
    machine = machine_with(own={"siemens-eec": {"axis_names": {"X": "X1"}}})
    control, settings, tables = parsed(machine, "siemens-eec", {"t": text})
    position = np.array([[-200.0, 0, 0], [-199.5, 0, 0], [-199.0, 0, 0], [600.0, 0, 0], [700.0, 0, 0]])
    moved = control(machine, settings).emulate(tables, Points(position))[:, 0]
    np.testing.assert_allclose(moved, [-0.01, -0.011, -0.012, 0.02, 0.02], atol=ARITHMETIC)


def test_the_802d_example_is_not_equidistant_to_its_end_and_is_refused():
    """802D sl, p. 222: MIN -400, MAX 400, STEP 6.73: 800 / 6.73 is no whole number."""
    text = constant(0, "0.1").replace("800.0", "6.73").replace("-350.0", "-400.0").replace("450.0", "400.0")
    text += "".join(f"$AN_CEC[0,{node}]=0.1\n" for node in range(2, 120)) + "M17\n"
    control, settings, tables = parsed(machine_with(), "siemens-cec", {"t": text})
    assert "MIN + k STEP never meets MAX" in control(machine_with(), settings).violations(tables)[0]


def test_a_measured_error_goes_into_the_encoder_table_as_it_is():
    """Worked in the manual's words: nominal -199, laser -198.990: +0.010 in the table, the axis goes 0.010 further."""
    machine = machine_with(own={"siemens-eec": {"axis_names": {"X": "X1"}}})
    text = (GOLDEN / "siemens-eec" / "manual_p242.ini").read_text()
    control, settings, tables = parsed(machine, "siemens-eec", {"t": text})
    moved = control(machine, settings).emulate(tables, Points(np.array([[-199.0, 0.0, 0.0]])))
    assert -199.0 + 0.010 + moved[0, 0] == pytest.approx(-199.0, abs=ARITHMETIC)


# --- volumetric compensation whose format is not public ------------------------------------------------------------

VCS = """{% for error in errors21 %}
{{ error.name }} {{ error.kind }} {{ error.axis or "-" }} {{ error.unit }} {{ error.known }}
{% for value in error.value %}
{{ (error.position_mm[loop.index0] if error.position_mm else 0) | fixed(3) }} {{ value | fixed(9) }}
{% endfor %}
{% endfor %}
; {{ machine_name }} {{ chain }} {{ input_sha256[:12] }}
"""


def vcs_folder(folder, name="VCS.DAT.j2", text=VCS):
    path = folder / "siemens-cec-eec" / "companion" / name
    path.parent.mkdir(parents=True)
    path.write_text(text)
    return folder


def test_a_template_of_the_user_gets_the_21_errors_and_stands_beside_the_verified_files(tmp_path):
    machine = machine_with("WFYXZT")
    errors = errors_of(machine).only("EXX", "EBY", "EC0Y")
    made = export(machine, errors, "siemens-cec-eec", templates=vcs_folder(tmp_path / "own"))
    text = made.companions["VCS.DAT"]
    blocks = {line.split()[0]: line.split()[1:] for line in text.splitlines() if re.match(r"E[A-C X-Z0][A-Z0]", line)}
    assert len(blocks) == 21
    assert blocks["EXX"] == ["linear", "X", "mm", "True"]
    assert blocks["EBY"] == ["angular", "Y", "rad", "True"]
    assert blocks["EA0Z"] == ["squareness", "-", "rad", "False"]
    lines = text.splitlines()
    first = lines.index("EXX linear X mm True")
    for row, position, value in zip(
        lines[first + 1 : first + 8], errors.curves["EXX"].position_mm, errors.curves["EXX"].value, strict=True
    ):
        written = [float(cell) for cell in row.split()]
        assert written[0] == pytest.approx(position, abs=5.1e-4)  # as the template rounds
        assert written[1] == pytest.approx(value, abs=5.1e-10)
    assert lines[lines.index("EC0Y squareness - rad True") + 1] == "0.000 0.000070000"
    paths = made.write(tmp_path / "out")
    assert sorted(path.name for path in paths) == ["AX_EEC.INI", "NC_CEC.INI"]
    assert (tmp_path / "out" / "VCS.DAT").read_text() == text
    assert [item["name"] for item in made.manifest["companions"]] == ["VCS.DAT"]
    assert any("VCS.DAT comes from your own template: it is not read back" in note for note in made.warnings)
    assert verify(machine, read_tables(machine, paths, "siemens-cec-eec"), errors).reasons == ()


def test_line_ends_of_a_users_file_follow_the_name_of_its_template(tmp_path):
    machine = machine_with()
    folder = vcs_folder(tmp_path, "V.TXT.crlf.j2", "a\nb\n")
    assert export(machine, errors_of(machine), "siemens-cec-eec", templates=folder).companions == {
        "V.TXT": "a\r\nb\r\n"
    }


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("NC_CEC.INI.j2", "x", "'NC_CEC.INI' is a reserved file name"),
        ("result.json.j2", "x", "'result.json' is a reserved file name"),
        ("V.TXT.j2", "{{ errors21[0].valu }}", "has no attribute 'valu'"),
        ("V.TXT.j2", "{{ errors22 }}", "'errors22' is undefined"),
        ("V.TXT.j2", "{% for %}", "the template cannot be rendered"),
    ],
)
def test_wrong_templates_of_a_user_are_errors(tmp_path, name, text, message):
    machine = machine_with()
    with pytest.raises(InputError) as caught:
        export(machine, errors_of(machine), "siemens-cec-eec", templates=vcs_folder(tmp_path, name, text))
    assert message in str(caught.value)


def test_the_control_without_public_format_is_refused_with_the_way_round():
    with pytest.raises(InputError, match="there is no controller 'siemens-vcs': the file format .* is not public"):
        export(machine_with(), errors_of(machine_with()), "siemens-vcs")


# --- malformed files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize(
    "garbage",
    [
        lambda: "x" * 20_000_001,
        lambda: "$AN_CEC[0,0]=0.1\n" * 1_200_000,
        lambda: "; \xe9\n" * 5_000_001,
        lambda: "\x00" * 20_000_001,
    ],
    ids=["one line", "one assignment", "not ASCII", "zeros"],
)
def test_twenty_megabytes_of_garbage_are_refused_for_their_size_before_they_are_parsed(name, garbage):
    machine, text = machine_with(), garbage()
    control = controller_named(name)
    settings = control.read_settings(machine)
    source = SourceFile(Path("g.ini"), text)
    with pytest.raises(
        InputError, match=rf"g\.ini:1: has {len(text)} characters; a file of this kind has at most 20000000"
    ):
        control(machine, settings).parse([source])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text[: len(text) // 2], "M17 is missing: the file is truncated"),
        (lambda text: text.replace("0.0", "0,0", 5), "the decimal mark is '.'"),
        (lambda text: re.sub(r"(\$AA_ENC_COMP\[0,1,AX1\]=).*", r"\g<1>1.2e-05", text), "has an exponent"),
        (lambda text: text.replace("$AA_ENC_COMP[0,2,AX1]", "$AA_ENC_COMP[0,1,AX1]"), "is assigned a second time"),
        (lambda text: re.sub(r"\$AA_ENC_COMP\[0,1,AX2\]=.*\n", "", text), "node 1 of 0 ..."),
        (lambda text: text.replace("MAX[0,AX3]=", "MAX[0,AX3]=1"), "node"),
        (lambda text: "\ufeff" + text, "contains the character '\\ufeff'"),
        (lambda text: "".join(f"{char}\x00" for char in text), "contains the character '\\x00'"),
    ],
    ids=["cut", "comma", "exponent", "twice", "gap", "count", "mark", "wide"],
)
@pytest.mark.parametrize("name", ["siemens-eec", "siemens-cec-eec"])
def test_damaged_exports_are_errors_that_name_the_file(name, change, message):
    machine = machine_with()
    files = dict(export(machine, errors_of(machine), name).files)
    files["AX_EEC.INI"] = change(files["AX_EEC.INI"])
    with pytest.raises(InputError) as caught:
        parsed(machine, name, files)
    assert message in str(caught.value)
    assert "AX_EEC.INI" in str(caught.value)


@pytest.mark.parametrize("name", ALL)
def test_settings_of_the_card_are_all_explained(name):
    from compgen.report.cards import control_card

    card = control_card(name)
    assert [setting.key for setting in card.settings if not setting.meaning] == []
    assert name in CONTROLLERS
