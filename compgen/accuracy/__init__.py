"""Accuracy figures of the standards, with uncertainty, and before against after."""

from compgen.accuracy.budget import Budget
from compgen.accuracy.compare import CompareOptions, Comparison, compare_errors, compare_fields, compare_runs
from compgen.accuracy.evaluate import Accuracy, accuracy_of_errors, accuracy_of_runs
from compgen.accuracy.field import Field, aligned, volume_figures
from compgen.accuracy.figure import ComparedFigure, Figure
from compgen.accuracy.iso230_2 import PositioningTest, positioning_test
from compgen.accuracy.match import compare_prediction, compare_sides, with_prediction
from compgen.accuracy.runs import RunStatistics, axis_statistics, run_statistics
from compgen.accuracy.sides import Side, read_side
from compgen.accuracy.source import ErrorSource, error_source
from compgen.accuracy.straightness import straightness
from compgen.accuracy.vdi3441 import vdi_3441

__all__ = [
    "Accuracy",
    "Budget",
    "CompareOptions",
    "ComparedFigure",
    "Comparison",
    "ErrorSource",
    "Field",
    "Figure",
    "PositioningTest",
    "RunStatistics",
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
