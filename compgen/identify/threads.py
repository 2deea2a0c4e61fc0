"""One BLAS thread inside a solve."""

from compgen.core.threads import one_thread

__all__ = ["one_thread"]
