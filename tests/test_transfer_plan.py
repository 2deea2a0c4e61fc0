"""Plans for a binary transfer: read back with the tables, and refused where one number differs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import compgen
from compgen.controllers import SourceFile, controller_named
from compgen.errors import InputError
from compgen.export import export

MACHINE = compgen.load_machine("zha-gantry")
WITH_PLAN = ("fanuc-pitch", "fanuc-straightness", "fanuc-3d", "mitsubishi")


@pytest.fixture(params=WITH_PLAN)
def exported(request, make_errors):
    made = export(MACHINE, make_errors(MACHINE), request.param, allow_unverified=True)
    (name,) = [name for name in made.files if name.endswith(".plan.json")]
    return request.param, dict(made.files), name


def parse(controller, files):
    control = controller_named(controller)
    given = [SourceFile(Path(name), text) for name, text in files.items()]
    return control.parse(MACHINE, control.read_settings(MACHINE), given)


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


def test_a_plan_as_it_was_written_is_read_with_its_tables(exported):
    controller, files, name = exported
    assert json.loads(files[name])["machine"] == MACHINE.name
    parse(controller, files)


def test_a_single_other_number_is_refused_with_its_place(exported):
    controller, files, name = exported
    plan = json.loads(files[name])
    places = list(numbers(plan))
    assert len(places) > 20
    for where in (places[0], places[len(places) // 2], places[-1]):
        with pytest.raises(InputError, match="but the tables beside it say") as caught:
            parse(controller, {**files, name: json.dumps(changed(plan, where))})
        assert str(caught.value.file) == name
        assert str(where[0]) in caught.value.field


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON"),
        ("[1]", "a plan is an object"),
        ("{}", "missing"),
        ('{"points": 1, "points": 2}', "stands twice"),
    ],
)
def test_what_is_no_plan_is_refused(exported, text, message):
    controller, files, name = exported
    with pytest.raises(InputError, match=message):
        parse(controller, {**files, name: text})


def test_a_left_out_or_further_point_is_refused(exported):
    controller, files, name = exported
    plan = json.loads(files[name])
    table = next(key for key in ("points", "values", "parameters") if key in plan)
    first = next(iter(plan[table]))
    without = {key: value for key, value in plan[table].items() if key != first}
    for other in (without, {**plan[table], "99999": 1}):
        with pytest.raises(InputError, match="missing"):
            parse(controller, {**files, name: json.dumps({**plan, table: other})})
