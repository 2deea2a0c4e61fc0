"""NC programs: read in the dialect of a control, corrected for the errors of a machine, and what a part will look like."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.programs.correct import CorrectOptions, ProgramCorrection, correct_program, model_of
    from compgen.programs.dialects import DIALECTS, read_radii, read_tools
    from compgen.programs.features import Quantity
    from compgen.programs.part import Feature, PartMachine, PartPrediction, predict_part, rank_machines
    from compgen.programs.reader import Reader, Setup
    from compgen.programs.watch import FolderWatch, WatchedProgram

__all__ = [
    "DIALECTS",
    "CorrectOptions",
    "Feature",
    "FolderWatch",
    "PartMachine",
    "PartPrediction",
    "ProgramCorrection",
    "Quantity",
    "Reader",
    "Setup",
    "WatchedProgram",
    "correct_program",
    "model_of",
    "predict_part",
    "rank_machines",
    "read_radii",
    "read_tools",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
