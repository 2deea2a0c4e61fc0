"""Lines through straightness readings; see :mod:`compgen.core.lines`."""

from compgen.core.lines import fitted_line

__all__ = ["fitted_line"]
