"""The machine model: E = C P to first order, and the exact product of finite rotations."""

from compgen.model.evaluate import load_kernels, volumetric_error_at, volumetric_error_on_grid
from compgen.model.exact import exact_columns, exact_error
from compgen.model.exact_points import exact_error_at
from compgen.model.gauge import align, gauge_directions
from compgen.model.observability import modelled_errors, observable_errors
from compgen.model.predict import predict
from compgen.model.volumetric import c_matrix, coefficients, volumetric_error

__all__ = [
    "align",
    "c_matrix",
    "coefficients",
    "exact_columns",
    "exact_error",
    "exact_error_at",
    "load_kernels",
    "gauge_directions",
    "modelled_errors",
    "observable_errors",
    "predict",
    "volumetric_error",
    "volumetric_error_at",
    "volumetric_error_on_grid",
]
