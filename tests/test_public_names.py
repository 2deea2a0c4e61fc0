"""The public names: few, each with an example in its docstring, and former ones that say where they are now."""

import inspect
import warnings
from importlib import import_module

import pytest

import compgen

DEPRECATED = [(home, name) for home, names in compgen._DEPRECATED.items() for name in names.split()]


def test_the_public_names_are_about_forty():
    assert len(compgen.__all__) <= 50


@pytest.mark.parametrize("name", sorted(set(compgen.__all__) - {"CONTROLLERS"}))
def test_every_public_name_has_an_example_that_uses_it(name):
    """The examples run with the doctests; that of CONTROLLERS, which is a dict, is in docs/reference.md."""
    text = inspect.getdoc(getattr(compgen, name))
    examples = [line for line in text.splitlines() if line.startswith((">>> ", "... "))]
    assert any(f"compgen.{name}" in line for line in examples)


@pytest.mark.parametrize(("home", "name"), DEPRECATED)
def test_a_former_public_name_works_and_names_its_replacement(home, name):
    with pytest.warns(DeprecationWarning) as caught:
        found = getattr(compgen, name)
    (warning,) = caught
    assert str(warning.message) == (
        f"compgen.{name} is deprecated and will be removed in 0.3; use `from {home} import {name}`"
    )
    assert warning.filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert found is getattr(import_module(home), name)
    assert name not in compgen.__all__
    assert name not in dir(compgen)


def test_no_public_function_takes_unnamed_options():
    """An editor shows every option, and a misspelt one is refused where it stands."""
    for name in compgen.__all__:
        thing = getattr(compgen, name)
        for item in [thing, *(member for _, member in inspect.getmembers(thing, inspect.isfunction))]:
            if inspect.isfunction(item) and item.__module__.startswith("compgen"):
                kinds = {parameter.kind for parameter in inspect.signature(item).parameters.values()}
                assert inspect.Parameter.VAR_KEYWORD not in kinds, (name, item)
