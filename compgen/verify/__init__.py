"""The round trip on the written text."""

from compgen.verify.residuals import Residuals, residuals, without_rigid_motion
from compgen.verify.verify import ReadTables, Verification, read_tables, verify

__all__ = ["ReadTables", "Residuals", "Verification", "read_tables", "residuals", "verify", "without_rigid_motion"]
