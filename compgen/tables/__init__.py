"""From errors to the tables of a control: synthesised, rendered, read back from their text and judged."""

from __future__ import annotations

from compgen.kinematics.gauge import without_rigid_motion
from compgen.resources import program_version
from compgen.tables.export import (
    REJECTED_PREFIX,
    REPORT_FILES,
    Export,
    Provenance,
    export,
    set_aside_superseded,
    usable_format,
)
from compgen.tables.judge import Residuals, residuals
from compgen.tables.render import Format, load_format
from compgen.tables.synthesis import Projector, projector, synthesize, wanted_correction
from compgen.tables.verification import ReadTables, Verification, parse_tables, read_tables, verify

__all__ = [
    "REJECTED_PREFIX",
    "REPORT_FILES",
    "Export",
    "Format",
    "Projector",
    "Provenance",
    "ReadTables",
    "Residuals",
    "Verification",
    "export",
    "load_format",
    "program_version",
    "projector",
    "parse_tables",
    "read_tables",
    "residuals",
    "set_aside_superseded",
    "synthesize",
    "usable_format",
    "verify",
    "wanted_correction",
    "without_rigid_motion",
]
