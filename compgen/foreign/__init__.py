"""Files of instruments and other programs, converted to the objects of this program."""

from typing import TYPE_CHECKING

from compgen.resources import on_first_use

if TYPE_CHECKING:
    from compgen.foreign.answers import ImportOptions
    from compgen.foreign.converted import describe_native, given_errors
    from compgen.foreign.detect import form_of, import_file
    from compgen.foreign.findings import Imported
    from compgen.foreign.opening import open_errors, open_measurement
    from compgen.foreign.source import native_format

__all__ = [
    "ImportOptions",
    "Imported",
    "describe_native",
    "form_of",
    "given_errors",
    "import_file",
    "open_errors",
    "open_measurement",
    "native_format",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
