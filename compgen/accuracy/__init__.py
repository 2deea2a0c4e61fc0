"""Accuracy figures of the standards, with uncertainty, and comparison of before and after."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.accuracy.compare import CompareOptions, Comparison, compare_errors, compare_fields, compare_runs
    from compgen.accuracy.evaluate import Accuracy, accuracy_of_errors, straightness
    from compgen.accuracy.field import (
        ComparedFigure,
        ErrorField,
        ErrorSource,
        Figure,
        aligned,
        error_source,
        volume_figures,
    )
    from compgen.accuracy.positioning import (
        PositioningTest,
        RunStatistics,
        SetupBudget,
        accuracy_of_runs,
        axis_statistics,
        positioning_test,
        run_statistics,
        vdi_3441,
    )
    from compgen.accuracy.sides import Side, compare_prediction, compare_sides, read_side, with_prediction

__all__ = [
    "Accuracy",
    "CompareOptions",
    "ComparedFigure",
    "Comparison",
    "ErrorSource",
    "ErrorField",
    "Figure",
    "PositioningTest",
    "RunStatistics",
    "SetupBudget",
    "Side",
    "accuracy_of_errors",
    "accuracy_of_runs",
    "aligned",
    "axis_statistics",
    "compare_errors",
    "compare_fields",
    "compare_prediction",
    "compare_runs",
    "compare_sides",
    "error_source",
    "positioning_test",
    "read_side",
    "run_statistics",
    "straightness",
    "vdi_3441",
    "volume_figures",
    "with_prediction",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
