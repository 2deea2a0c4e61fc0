"""Where the model and the measurement disagree, and which effect explains it."""

from compgen.diagnose.any_diagnosis import DiagnoseOptions, diagnose
from compgen.diagnose.axis_diagnosis import AxisDiagnosis
from compgen.diagnose.circle_diagnosis import CircleDiagnosis
from compgen.diagnose.diagnosis import Diagnosis

__all__ = ["AxisDiagnosis", "CircleDiagnosis", "DiagnoseOptions", "Diagnosis", "diagnose"]
