"""Plans for a binary transfer: read back with the tables, and refused where one number differs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import compgen
from compgen.controls import SourceFile, controller_named
from compgen.tables import export

MACHINE = compgen.load_machine("zha-gantry")
WITH_PLAN = ("fanuc-pitch", "fanuc-straightness", "fanuc-3d", "mitsubishi")


@pytest.fixture(params=WITH_PLAN)
def exported(request, make_errors):
    made = export(MACHINE, make_errors(MACHINE), request.param, allow_unverified=True)
    (name,) = [name for name in made.files if name.endswith(".plan.json")]
    return request.param, dict(made.files), name


def contradictions(controller, files):
    control = controller_named(controller)
    settings = control.read_settings(MACHINE)
    given = [SourceFile(Path(name), text) for name, text in files.items()]
    return control(MACHINE, settings).contradictions(control(MACHINE, settings).parse(given), given)


def numbers(tree, where=()):
    """Places of all numbers and texts of digits in a plan."""
    if isinstance(tree, dict | list):
        for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
            yield from numbers(value, (*where, key))
    elif (
        isinstance(tree, str)
        and tree.lstrip("-").replace(".", "").isdigit()
        or isinstance(tree, int | float)
        and not isinstance(tree, bool)
    ):
        yield where


def changed(plan, where):
    tree = json.loads(json.dumps(plan))
    inner = tree
    for key in where[:-1]:
        inner = inner[key]
    old = inner[where[-1]]
    inner[where[-1]] = str(int(float(old)) + 1) if isinstance(old, str) else old + 1
    return tree


def test_a_plan_as_it_was_written_contradicts_nothing(exported):
    controller, files, name = exported
    assert json.loads(files[name])["machine"] == MACHINE.name
    assert contradictions(controller, files) == []
    assert contradictions(controller, {file: text for file, text in files.items() if file != name}) == []


def test_a_single_other_number_is_named_with_its_place(exported):
    controller, files, name = exported
    plan = json.loads(files[name])
    places = list(numbers(plan))
    assert len(places) > 20
    for where in (places[0], places[len(places) // 2], places[-1]):
        (text,) = contradictions(controller, {**files, name: json.dumps(changed(plan, where))})
        assert text.startswith(f"{name}: {where[0]}") and "but the tables of the same export give" in text


@pytest.mark.parametrize(
    ("text", "message"),
    [("{", "is not JSON"), ("[1]", "expected an object"), ("{}", "missing"), ('{"a": 1, "a": 2}', "is given twice")],
)
def test_what_is_no_plan_is_named(exported, text, message):
    controller, files, name = exported
    (found,) = contradictions(controller, {**files, name: text})
    assert message in found


def test_a_left_out_or_further_point_is_named(exported):
    controller, files, name = exported
    plan = json.loads(files[name])
    table = next(key for key in ("points", "values", "parameters") if key in plan)
    first = next(iter(plan[table]))
    without = {key: value for key, value in plan[table].items() if key != first}
    for other in (without, {**plan[table], "99999": 1}):
        (found,) = contradictions(controller, {**files, name: json.dumps({**plan, table: other})})
        assert "missing" in found


def test_tables_with_another_plan_beside_them_are_not_accepted(tmp_path, make_errors):
    errors = make_errors(MACHINE)
    paths = export(MACHINE, errors, "fanuc-pitch").write(tmp_path)
    assert compgen.verify(MACHINE, compgen.read_tables(MACHINE, paths, "fanuc-pitch"), errors).accepted
    (plan,) = [path for path in paths if path.name.endswith(".plan.json")]
    tree = json.loads(plan.read_text())
    point = next(number for number, value in tree["points"].items() if value)
    tree["points"][point] *= -1
    plan.write_text(json.dumps(tree))
    result = compgen.verify(MACHINE, compgen.read_tables(MACHINE, paths, "fanuc-pitch"), errors)
    assert not result.accepted and f"points.{point}" in " ".join(result.reasons)
