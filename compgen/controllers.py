"""Former home of the plug-in interface; the next minor version removes it. Use :mod:`compgen.controls`.

A control of the former interface is one object for all machines: every method takes the machine and the settings. This
module has its base class, and the adapter that turns such a control into a class of :mod:`compgen.controls`.
"""

import inspect
import sys
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Generic

import numpy as np

from compgen import controls
from compgen.controls import CONTROLLERS, Monomial, SourceFile, Term, controller_named
from compgen.controls.shared import base, grids, terms
from compgen.controls.shared.base import Settings, Tables, Usage
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable, ReversalCurves
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.errors import InputError

__all__ = ["CONTROLLERS", "AnyController", "Controller", "Monomial", "SourceFile", "Term", "controller_named"]


class Controller(ABC, Generic[Settings, Tables]):
    """The former base class; the method of the same name in :mod:`compgen.controls` says what each returns."""

    name: str
    anchored: bool = False
    bidirectional: bool = False
    at_axes: bool = False
    finite_rotations: bool = False
    templates: Path | None = None
    sample_setting: str | None = None

    @abstractmethod
    def read_settings(self, machine: Machine) -> Settings:
        """Check ``[controllers.<name>]`` of the machine file."""

    @abstractmethod
    def basis(self, machine: Machine, settings: Settings, errors: ErrorTable) -> list[Term]:
        """Return the tables that the control would get."""

    @abstractmethod
    def build(
        self, machine: Machine, settings: Settings, basis: Sequence[Term], values: Mapping[str, FloatArray]
    ) -> Tables:
        """Turn term values into the control's own numbers."""

    @abstractmethod
    def context(self, machine: Machine, settings: Settings, tables: Tables) -> dict[str, Any]:
        """Return what the templates need."""

    @abstractmethod
    def parse(self, machine: Machine, settings: Settings, files: Sequence[SourceFile]) -> Tables:
        """Read the numbers back from text."""

    @abstractmethod
    def emulate(self, machine: Machine, settings: Settings, tables: Tables, points: Points) -> FloatArray:
        """Return what the control adds to the command, shape (n, 3), mm."""

    @abstractmethod
    def violations(self, machine: Machine, settings: Settings, tables: Tables) -> list[str]:
        """Return the limits that the tables break."""

    @abstractmethod
    def resolution_mm(self, settings: Settings) -> float:
        """Return the largest error of rounding, mm."""

    def missing(self, machine: Machine, settings: Settings) -> InputError | None:
        """Return what is wrong with a setting that only an export needs."""
        return None

    def basis_of(self, machine: Machine, settings: Settings, errors: ErrorTable, tables: Tables) -> list[Term]:
        """Return the basis that parsed tables are judged by."""
        return self.basis(machine, settings, errors)

    def parse_foreign(
        self, machine: Machine, settings: Settings, files: Sequence[SourceFile]
    ) -> tuple[Tables, list[str]] | None:
        """Read files that this program did not write."""
        return None

    def contradictions(
        self, machine: Machine, settings: Settings, tables: Tables, files: Sequence[SourceFile]
    ) -> list[str]:
        """Return where files that are not needed disagree."""
        return []

    def remarks(self, machine: Machine, settings: Settings, tables: Tables, files: Sequence[SourceFile]) -> list[str]:
        """Return what reading assumed or ignored."""
        return []

    def keeping_others(
        self, machine: Machine, settings: Settings, tables: Tables, files: Sequence[Path]
    ) -> dict[str, dict[str, Any]]:
        """Return settings that keep the tables of other axes."""
        return {}

    def anchor_mm(self, machine: Machine, settings: Settings) -> FloatArray:
        """Return where tables are zero by nature, shape (3,)."""
        return np.array(machine.reference_point_mm, dtype=np.float64)

    def table_nodes_mm(self, machine: Machine, settings: Settings, tables: Tables) -> tuple[FloatArray, ...]:
        """Return the nodes of X, Y and Z."""
        return (np.zeros(0), np.zeros(0), np.zeros(0))

    def reversal_in_tables(self, settings: Settings, reversal: ReversalCurves) -> ReversalCurves:
        """Return the part of a reversal that goes into tables."""
        return reversal if self.bidirectional else ReversalCurves({})

    def with_reversal(self, machine: Machine, settings: Settings, tables: Tables, reversal: ReversalCurves) -> Tables:
        """Return the tables with the reversal in them."""
        raise TypeError(f"{self.name} has no direction-dependent tables")

    def backlash_parameters(
        self, machine: Machine, settings: Settings, reversal: ReversalCurves
    ) -> list[dict[str, str]]:
        """Return the control's backlash parameters."""
        return []

    def left_out(self, machine: Machine, settings: Settings, errors: ErrorTable) -> list[str]:
        """Return what the tables cannot express."""
        return []

    def reservations(self, machine: Machine, settings: Settings, tables: Tables) -> list[str]:
        """Return the reservations of the verdict."""
        return []

    def other_readings(self, settings: Settings, tables: Tables) -> dict[str, Settings]:
        """Return settings under which the tables may be read otherwise."""
        return {}

    def usage(self, machine: Machine, settings: Settings, tables: Tables) -> list[Usage]:
        """Return how much of each limit is used."""
        return []

    def bound_form(self) -> type[controls.AnyController]:
        """Return the class of :mod:`compgen.controls` that calls this control with its machine and settings."""
        message = f"the control {self.name!r} has the interface of compgen.controllers; see docs/tutorial-control.md"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
        attributes = {
            key: getattr(self, key)
            for key, value in vars(Controller).items()
            if key[0] != "_" and isinstance(value, bool | None)
        }
        methods = {
            key: _bound(self, key)
            for key, value in vars(Controller).items()
            if key[0] != "_" and key != "bound_form" and callable(value)
        }
        special = {
            "name": self.name,
            "read_settings": classmethod(lambda cls, machine: self.read_settings(machine)),
            "other_readings": lambda control, tables: {
                words: type(control)(control.machine, settings)
                for words, settings in self.other_readings(control.settings, tables).items()
            },
        }
        return type(type(self).__name__, (controls.Controller,), {**methods, **attributes, **special})


AnyController = Controller[Any, Any]


def _bound(former: AnyController, name: str) -> Callable[..., Any]:
    """Return the method ``name`` of a bound control, which calls that of the former one."""
    first = [key for key in inspect.signature(getattr(Controller, name)).parameters if key in ("machine", "settings")]

    def method(control: controls.AnyController, *rest: Any) -> Any:
        return getattr(former, name)(*(getattr(control, key) for key in first), *rest)

    return method


warnings.warn(
    "compgen.controllers is now compgen.controls (base, grids and terms: compgen.controls.shared), and a control there is "
    "bound to its machine, see docs/tutorial-control.md; the next minor version removes the former interface",
    DeprecationWarning,
    stacklevel=2,
)
for _part, _names in ((base, {"Controller": Controller, "AnyController": AnyController}), (grids, {}), (terms, {})):
    # a module registered here needs no folder of the former name
    _former = ModuleType(f"{__name__}.{_part.__name__.rpartition('.')[2]}", _part.__doc__)
    vars(_former).update({**vars(_part), **_names, "__name__": _former.__name__})
    sys.modules[_former.__name__] = _former
    globals()[_former.__name__.rpartition(".")[2]] = _former
