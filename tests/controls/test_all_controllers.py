"""Every registered control on asymmetric machines: render, parse, the same numbers, and what they then do.

A new control is in these tests as soon as it is in ``CONTROLLERS``; settings that it needs stand in
``machines/zha-gantry.toml``.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import compgen
from compgen.controls import CONTROLLERS, SourceFile
from compgen.data import toml_files
from compgen.data.error_table import Curve, ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.prior import PriorSettings
from compgen.kinematics.exact_chain import exact_error
from compgen.report.cards import control_card
from compgen.tables import read_tables, verify
from compgen.tables.exporting import Provenance, export, export_context, rerender
from compgen.tables.judge import COMPONENT_FLOOR_MM, judge_of
from compgen.tables.synthesis import synthesize

ALL = sorted(CONTROLLERS)
UM = 1e-3
NANOMETRE = 1e-6
SHIPPED = compgen.load_machine("zha-gantry")

#: Ranges, node counts, signs of travel, reference points and tools have nothing in common.
MACHINES = {
    "negative": """
name = "negative"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [-50.0, -100.0, -40.0]
axes.X = { range_mm = [-300.0, -20.0], nodes = 5 }
axes.Y = { range_mm = [-420.0, -70.0], nodes = 6 }
axes.Z = { range_mm = [-240.0, 0.0], nodes = 4 }
""",
    "mixed": """
name = "mixed"
chain = "WXYFZT"
tool_offset_mm = [15.0, -25.0, 60.0]
reference_point_mm = [250.0, -150.0, 120.0]
axes.X = { range_mm = [100.0, 700.0], nodes = 7 }
axes.Y = { range_mm = [-450.0, 50.0], nodes = 6 }
axes.Z = { range_mm = [-60.0, 340.0], nodes = 5 }
""",
    "reference-y": """
name = "reference-y"
chain = "WYFXZT"
squareness_reference = "Y"
tool_offset_mm = [-30.0, 40.0, -55.0]
reference_point_mm = [0.0, 200.0, -100.0]
axes.X = { range_mm = [-500.0, 300.0], nodes = 9 }
axes.Y = { range_mm = [0.0, 350.0], nodes = 8 }
axes.Z = { range_mm = [-200.0, 50.0], nodes = 6 }
""",
}


@pytest.fixture(scope="module", params=sorted(MACHINES))
def machine(request, tmp_path_factory):
    """One asymmetric machine with the settings of the shipped one for every control."""
    path = tmp_path_factory.mktemp(request.param) / f"{request.param}.toml"
    path.write_text(MACHINES[request.param])
    return replace(compgen.load_machine(path), controllers=SHIPPED.controllers)


@pytest.fixture(scope="module")
def errors(machine, make_errors):
    return make_errors(machine, seed=23)


@pytest.fixture(scope="module")
def exported(machine, errors):
    """Export of each control on the machine, made once."""
    made = {}

    def of(name):
        if name not in made:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", compgen.CompgenWarning)
                made[name] = export(machine, errors, name, allow_unverified=True)
        return made[name]

    return of


def write(made, folder):
    """Write the controller files byte by byte and return their paths."""
    paths = []
    for name, text in made.files.items():
        paths.append(folder / name)
        paths[-1].write_bytes(text.encode("ascii"))
    return paths


def parsed(machine, name, files):
    control = CONTROLLERS[name]
    settings = control.read_settings(machine)
    return control, settings, control(machine, settings).parse([SourceFile(Path(k), v) for k, v in files.items()])


def inside(machine, count=60, seed=7):
    """Random positions in the volume; each axis came from below."""
    position = np.random.default_rng(seed).uniform(machine.lower_mm, machine.upper_mm, (count, 3))
    return Points(position, approach=np.ones_like(position))


@pytest.mark.parametrize("name", ALL)
def test_what_is_parsed_renders_to_the_same_bytes(name, machine, errors, exported):
    files = exported(name).files
    common = export_context(machine, errors, name, Provenance())
    assert rerender(machine, name, files, common) == dict(files)
    assert all(text.isascii() and "\0" not in text for text in files.values())


#: Formats that hold samples of the tables, between which they lose up to ``loss_um``.
SAMPLED = ("neutral",)
#: Controls that hold squareness alone, which is a few micrometres on these machines.
SHEARS = ("klipper", "linuxcnc-matrixkins", "marlin", "reprapfirmware", "ucnc")
STEEPEST = 3e-4  # change of the correction per length on these machines


@pytest.mark.parametrize("name", ALL)
def test_the_emulated_control_does_what_the_tables_were_made_for(name, machine, errors, exported):
    """The sum over the tables of carrier times interpolated value, to within the rounding of the format."""
    control, settings, tables = parsed(machine, name, exported(name).files)
    basis = control(machine, settings).basis(errors)
    values = synthesize(machine, errors, basis, anchored=control.anchored, at_axes=control.at_axes)
    points, tool = inside(machine), np.asarray(machine.tool_offset_mm)
    expected = sum(
        term.curve(values[term.name], points.position_mm)[:, None] * term.carrier_field(points.position_mm, tool)
        for term in basis
    )
    added = control(machine, settings).emulate(tables, points)
    assert added.shape == (len(points), 3)
    moved, least = np.ptp(added, axis=0), 2 * UM if name in SHEARS else 5 * UM
    assert np.all((moved > least) | (moved == 0.0))
    assert moved.max() > 2 * least
    again = STEEPEST * np.max(np.abs(added)) if control.at_axes else 0.0  # looked up at the corrected position
    loss = 2 * settings.loss_mm if name in SAMPLED else 0.0  # of two curves that act on one axis
    assert (
        np.max(np.abs(added - expected))
        <= 1.000001 * control(machine, settings).resolution_mm() + NANOMETRE + again + loss
    )


@pytest.mark.parametrize("name", ALL)
def test_the_tables_are_accepted_and_those_of_the_opposite_errors_are_not(name, machine, errors, exported, tmp_path):
    """And what the verification calls expressed is gone at random points of the exact machine."""
    machine = replace(
        machine, prior=PriorSettings(class_name="none")
    )  # not whether it is worth while: uCNC corrects little here
    tables = read_tables(machine, write(exported(name), tmp_path), name)
    result = verify(machine, tables, errors)
    assert result.reasons == ()
    points = inside(machine, seed=8)
    added = tables.correction(machine, points)
    before = exact_error(machine, errors, points.position_mm, machine.tool_offset_mm)
    after = exact_error(machine, errors, points.position_mm + added, machine.tool_offset_mm) + added
    assert np.max(np.linalg.norm(before, axis=1)) > 20 * UM
    rest = after - after.mean(axis=0) if tables.controller.anchored else after
    quantum = tables.controller.resolution_mm()
    mean = 0.15 if tables.controller.anchored else 0.0  # that of few points is not that of the whole volume
    allowed = (1 + mean) * result.unrepresentable_um * UM + 0.5 * UM + 4 * quantum
    assert np.max(np.linalg.norm(rest, axis=1)) <= allowed
    assert verify(machine, tables, opposite(errors)).reasons


def opposite(errors):
    curves = {key: Curve(curve.position_mm, -curve.value, curve.u) for key, curve in errors.curves.items()}
    return ErrorTable(curves, {key: (-value, u) for key, (value, u) in errors.squareness.items()}, errors.metadata)


WRONG = {
    "X reversed": np.diag([-1.0, 1.0, 1.0]),
    "Y reversed": np.diag([1.0, -1.0, 1.0]),
    "Z reversed": np.diag([1.0, 1.0, -1.0]),
    "all reversed": -np.eye(3),
    "X and Y swapped": np.eye(3)[[1, 0, 2]],
    "X and Z swapped": np.eye(3)[[2, 1, 0]],
    "axes moved on by one": np.eye(3)[[1, 2, 0]],
}


@pytest.mark.parametrize("name", ALL)
def test_a_wrong_order_or_sign_of_axes_is_rejected(name, machine, errors, exported):
    """In what the control adds, and in the frame that positions and corrections are both taken in."""
    control, settings, tables = parsed(machine, name, exported(name).files)
    judge = judge_of(machine, control(machine, settings), errors)

    def added(position_mm):
        return control(machine, settings).emulate(tables, Points(position_mm, approach=np.ones_like(position_mm)))

    def reasons(on_grid, correction):
        return judge.reasons(on_grid, correction(judge.line_mm))

    grid_mm, visible_mm = judge.grid.position_mm, control(machine, settings).resolution_mm() + COMPONENT_FLOOR_MM
    right = added(grid_mm)
    assert reasons(right, added) == []
    seen = 0
    for what, matrix in WRONG.items():
        for frame, wrong in (
            ("", lambda p, m=matrix: added(p) @ m.T),
            ("frame ", lambda p, m=matrix: added(p @ m) @ m.T),
        ):
            on_grid = wrong(grid_mm)
            if np.max(np.abs(on_grid - right)) > visible_mm:  # else this control corrects nothing that it changes
                assert reasons(on_grid, wrong), frame + what
                seen += 1
    assert seen >= 10


@pytest.mark.parametrize("name", ALL)
def test_beyond_the_travel_the_correction_goes_on_without_a_jump(name, machine, exported):
    """At both ends of each axis: held, or as a straight line times a lever, but nothing that jumps."""
    control, settings, tables = parsed(machine, name, exported(name).files)
    middle = 0.5 * (machine.lower_mm + machine.upper_mm)
    for axis in range(3):
        for end, out in ((machine.lower_mm[axis], -1.0), (machine.upper_mm[axis], 1.0)):
            position = np.tile(middle, (4, 1))
            position[:, axis] = end + out * np.array([0.0, 1e-6, 1.0, 500.0])
            added = control(machine, settings).emulate(tables, Points(position, approach=np.ones_like(position)))
            assert np.all(np.isfinite(added))
            step = np.max(np.abs(added[1] - added[0]))
            assert step <= NANOMETRE, (axis, out)
            inside_mm = np.max(np.abs(added[0]))
            assert np.max(np.abs(added[2:])) <= inside_mm + 500.0 * STEEPEST, (axis, out)


@pytest.mark.parametrize("name", ALL)
def test_a_reversal_goes_into_the_tables_of_one_direction_or_is_named(name, machine, errors, exported):
    """X comes 6 um further in its positive direction, Y 8 um less far; the control takes that out."""
    wanted = ReversalCurves({(0, 0): constant(6 * UM), (1, 1): constant(-8 * UM)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", compgen.CompgenWarning)
        made = export(machine, errors, name, allow_unverified=True, reversal=wanted)
    control, settings, tables = parsed(machine, name, made.files)
    held = control(machine, settings).reversal_in_tables(wanted)
    position = inside(machine).position_mm
    ones = np.ones_like(position)
    both = [
        control(machine, settings).emulate(tables, Points(position, approach=np.full_like(position, sign)))
        for sign in (1.0, -1.0)
    ]
    plain = parsed(machine, name, exported(name).files)[2]
    for of_one_way, item in ((bool(held.curves), tables), (False, plain)):
        bound = control(machine, settings)
        assert bound.by_direction(item) or not of_one_way
        if not bound.by_direction(item):  # then the direction does not matter, nor whether it is known
            found = [
                bound.emulate(item, Points(position, approach=side)) for side in (None, *(s * ones for s in (1, -1)))
            ]
            assert np.array_equal(found[0], found[1])
            assert np.array_equal(found[0], found[2])
    expected = np.zeros_like(position)
    for axis, value in ((0, -6 * UM), (1, 8 * UM)):
        if (axis, axis) in held.curves:
            expected[:, axis] = value
    assert (
        np.max(np.abs(both[0] - both[1] - expected))
        <= 2.000001 * control(machine, settings).resolution_mm() + NANOMETRE
    )
    rest = wanted.without(held)
    named = [*control(machine, settings).backlash_parameters(rest), *(w for w in made.warnings if "reversal" in w)]
    assert not rest.curves or named


def constant(value_mm):
    return Curve(np.zeros(1), np.array([value_mm]), np.array([np.nan]))


@pytest.mark.parametrize("name", ALL)
def test_export_twice_gives_the_same_bytes_and_leaves_its_input_alone(name, machine, errors, exported):
    before = {key: (curve.position_mm.copy(), curve.value.copy()) for key, curve in errors.curves.items()}
    data = dict(machine.controller_settings(name).data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", compgen.CompgenWarning)
        again = export(machine, errors, name, allow_unverified=True)
    assert dict(again.files) == dict(exported(name).files)
    assert again.preflight == exported(name).preflight
    assert dict(machine.controller_settings(name).data) == data
    for key, (position, value) in before.items():
        assert np.array_equal(errors.curves[key].position_mm, position)
        assert np.array_equal(errors.curves[key].value, value)


@pytest.mark.parametrize("name", ALL)
def test_the_order_of_the_files_and_line_ends_do_not_matter(name, machine, exported):
    control, settings, tables = parsed(machine, name, exported(name).files)
    texts = {key: text.replace("\r\n", "\n") for key, text in reversed(list(exported(name).files.items()))}
    points = inside(machine)
    right = control(machine, settings).emulate(tables, points)
    for end in ("\n", "\r\n"):
        changed = {key: text.replace("\n", end) for key, text in texts.items()}
        other = control(machine, settings).parse([SourceFile(Path(key), text) for key, text in changed.items()])
        assert np.array_equal(control(machine, settings).emulate(other, points), right)


@pytest.mark.parametrize("name", ALL)
def test_the_nodes_of_the_tables_cover_the_travel_and_usage_is_within_limits(name, machine, errors, exported):
    control, settings, tables = parsed(machine, name, exported(name).files)
    nodes = control(machine, settings).table_nodes_mm(tables)
    with_tables = {term.axis for term in control(machine, settings).basis(errors)} - {None}
    assert (len(with_tables) == 0) == (name in SHEARS)
    for axis in with_tables:
        positions = nodes[axis]
        assert len(positions) >= 2
        assert np.all(np.diff(positions) > 0)
        low, high = machine.axes[axis].range_mm
        assert positions[0] <= low + NANOMETRE
        assert positions[-1] >= high - NANOMETRE
    for usage in control(machine, settings).usage(tables):
        assert 0 <= usage.used <= usage.allowed, usage
    assert control(machine, settings).violations(tables) == []


# --- the cards -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ALL)
def test_the_card_explains_every_setting_and_no_other(name):
    """The keys are those that are declared; each says what it means, and a reader does not pass over any of them."""
    card = control_card(name)
    assert [item.key for item in card.settings if not item.meaning] == []
    assert set(card.format.settings) == set()
    assert card.format.limits
    assert card.format.sources
    for key in {item.key.partition(".")[0] for item in card.settings}:
        data = {**SHIPPED.controller_settings(name).data, key: float("nan")}
        section = toml_files.Section(data, path=None, name=f"controllers.{name}")
        with pytest.raises(compgen.InputError, match=f"{key}: .*expected.*; got nan"):
            CONTROLLERS[name].read_settings(replace(SHIPPED, controllers={**SHIPPED.controllers, name: section}))


@pytest.mark.parametrize("name", ALL)
def test_the_keys_of_the_shipped_machine_are_on_the_card(name):
    """The machine file has been written by hand, with the settings that the control needs."""
    known = {item.key.partition(".")[0] for item in control_card(name).settings}
    assert set(SHIPPED.controller_settings(name).data) <= known


@pytest.mark.parametrize("name", ALL)
def test_every_default_of_the_card_is_what_the_control_takes_without_the_key(name):
    control, card = CONTROLLERS[name], control_card(name)
    plain = control.read_settings(SHIPPED)
    stated = SHIPPED.controller_settings(name).data
    for item in card.settings:
        if item.required or item.default is None or "." in item.key or item.key in stated:
            continue
        data = {**stated, item.key: item.default}
        section = toml_files.Section(data, path=None, name=f"controllers.{name}")
        changed = replace(SHIPPED, controllers={**SHIPPED.controllers, name: section})
        assert control.read_settings(changed) == plain, item.key


@pytest.mark.parametrize("name", ALL)
def test_an_unknown_setting_is_refused(name):
    section = toml_files.Section({**SHIPPED.controller_settings(name).data, "no_such_key": 1}, path=None, name=name)
    with pytest.raises(compgen.InputError, match="no_such_key"):
        CONTROLLERS[name].read_settings(replace(SHIPPED, controllers={**SHIPPED.controllers, name: section}))
