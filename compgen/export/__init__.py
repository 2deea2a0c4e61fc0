"""From errors to controller files."""

from compgen.export.export import REJECTED_PREFIX, Export, Provenance, export, program_version, usable_format
from compgen.export.render import Format, load_format
from compgen.export.synthesis import Projector, projector, synthesize, wanted_correction

__all__ = [
    "REJECTED_PREFIX",
    "Export",
    "Format",
    "Projector",
    "Provenance",
    "export",
    "load_format",
    "program_version",
    "projector",
    "synthesize",
    "usable_format",
    "wanted_correction",
]
