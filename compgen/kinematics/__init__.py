"""The machine model: E = C P to first order, and the exact product of finite rotations."""

from compgen.kinematics.exact_chain import exact_columns, exact_error, predict
from compgen.kinematics.first_order import c_matrix, coefficients, modelled_errors, observable_errors
from compgen.kinematics.gauge import align, gauge_directions
from compgen.kinematics.many_points import volumetric_error, volumetric_error_on_grid

__all__ = [
    "align",
    "c_matrix",
    "coefficients",
    "exact_columns",
    "exact_error",
    "gauge_directions",
    "modelled_errors",
    "observable_errors",
    "predict",
    "volumetric_error",
    "volumetric_error_on_grid",
]
