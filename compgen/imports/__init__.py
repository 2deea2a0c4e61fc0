"""Files of instruments and other programs, as objects of the project."""

from compgen.imports.door import describe_own, open_errors, open_measurement
from compgen.imports.given import given_errors
from compgen.imports.recognise import form_of, import_file, own_kind
from compgen.imports.result import Imported, ImportOptions

__all__ = [
    "ImportOptions",
    "Imported",
    "describe_own",
    "form_of",
    "given_errors",
    "import_file",
    "open_errors",
    "open_measurement",
    "own_kind",
]
