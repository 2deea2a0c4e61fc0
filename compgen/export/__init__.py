"""From errors to controller files."""

from compgen.export.export import Export, Provenance, export, program_version, usable_format
from compgen.export.render import Format, load_format
from compgen.export.superseded import REJECTED_PREFIX, REPORT_FILES, set_aside_superseded
from compgen.export.synthesis import Projector, projector, synthesize, wanted_correction

__all__ = [
    "REJECTED_PREFIX",
    "REPORT_FILES",
    "Export",
    "Format",
    "Projector",
    "Provenance",
    "export",
    "load_format",
    "program_version",
    "projector",
    "set_aside_superseded",
    "synthesize",
    "usable_format",
    "wanted_correction",
]
