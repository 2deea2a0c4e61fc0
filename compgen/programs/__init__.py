"""NC programs: read in the dialect of a control, corrected for the errors of a machine, and what a part will look like."""

from compgen.programs.correct import CorrectOptions, ProgramCorrection, correct_program, model_of
from compgen.programs.dialects import DIALECTS, read_tools
from compgen.programs.reader import Reader, Setup

__all__ = [
    "DIALECTS",
    "CorrectOptions",
    "ProgramCorrection",
    "Reader",
    "Setup",
    "correct_program",
    "model_of",
    "read_tools",
]
