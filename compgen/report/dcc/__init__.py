"""A Digital Calibration Certificate (XML in PTB's schema) from the numbers of a report and the data of a laboratory."""

from compgen.report.dcc.certificate import certificate_files, certificate_xml
from compgen.report.dcc.options import Certificate, read_certificate
from compgen.report.dcc.schema import Schema, read_schema
from compgen.report.dcc.xml import NEWEST, VERSIONS

__all__ = [
    "NEWEST",
    "VERSIONS",
    "Certificate",
    "Schema",
    "certificate_files",
    "certificate_xml",
    "read_certificate",
    "read_schema",
]
