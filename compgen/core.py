"""Former home of the reader of settings: import :mod:`compgen.data.toml_files`. The next minor version removes it."""

import sys
import warnings

from compgen.data import toml_files as tomlio

__all__ = ["tomlio"]

warnings.warn(
    "compgen.core.tomlio is now compgen.data.toml_files; the next minor version removes the old name",
    DeprecationWarning,
    stacklevel=2,
)
sys.modules[f"{__name__}.tomlio"] = tomlio
