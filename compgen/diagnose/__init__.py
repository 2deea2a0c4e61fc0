"""Where model and measurement disagree, and the effect that explains it."""

from compgen.diagnose.axis_diagnosis import AxisDiagnosis
from compgen.diagnose.diagnose import DiagnoseOptions, diagnose
from compgen.diagnose.diagnosis import Diagnosis

__all__ = ["AxisDiagnosis", "DiagnoseOptions", "Diagnosis", "diagnose"]
