"""From errors to the tables of a control: synthesised, rendered, read back from their text and judged."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.data.comparison import Residuals, residuals, without_rigid_motion
    from compgen.data.files import REJECTED_PREFIX, Provenance
    from compgen.resources import program_version
    from compgen.tables.exporting import REPORT_FILES, Export, export, set_aside_superseded, usable_format, with_known
    from compgen.tables.judge import SafetyLimits
    from compgen.tables.render import Format, load_format
    from compgen.tables.signs import check_files
    from compgen.tables.synthesis import Projector, projector, synthesize, wanted_correction
    from compgen.tables.verification import (
        MISFIT_CODES,
        ReadTables,
        Verification,
        blocking_reasons,
        measurement_objections,
        parse_tables,
        read_tables,
        taken_away_um,
        verification_files,
        verify,
    )

__all__ = [
    "MISFIT_CODES",
    "REJECTED_PREFIX",
    "REPORT_FILES",
    "Export",
    "Format",
    "Projector",
    "Provenance",
    "ReadTables",
    "Residuals",
    "SafetyLimits",
    "Verification",
    "blocking_reasons",
    "check_files",
    "export",
    "load_format",
    "measurement_objections",
    "parse_tables",
    "program_version",
    "projector",
    "read_tables",
    "residuals",
    "set_aside_superseded",
    "synthesize",
    "taken_away_um",
    "usable_format",
    "verification_files",
    "verify",
    "wanted_correction",
    "with_known",
    "without_rigid_motion",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
