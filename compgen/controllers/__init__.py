"""The controls: one module per family, one explicit registry."""

from __future__ import annotations

from compgen.controllers.base import AnyController, Controller, Monomial, SourceFile, Term
from compgen.core.text import nearest
from compgen.errors import InputError

#: Every control by its name on the command line.
CONTROLLERS: dict[str, AnyController] = {}


def controller_named(name: str) -> AnyController:
    """Return the control ``name`` or raise an InputError that lists what there is."""
    if name not in CONTROLLERS:
        raise InputError(f"no controller is named {name!r}; {nearest(name, CONTROLLERS)}")
    return CONTROLLERS[name]


__all__ = ["CONTROLLERS", "AnyController", "Controller", "Monomial", "SourceFile", "Term", "controller_named"]
