"""A Digital Calibration Certificate (XML in PTB's schema) from the numbers of a report and the data of a laboratory."""

from compgen.report.dcc.certificate import certificate_files, certificate_xml
from compgen.report.dcc.laboratory import Certificate, read_certificate
from compgen.report.dcc.reading import ReferenceCertificate, read_dcc
from compgen.report.dcc.xml import NEWEST, VERSIONS, DccSchema, read_schema

__all__ = [
    "NEWEST",
    "VERSIONS",
    "Certificate",
    "DccSchema",
    "ReferenceCertificate",
    "certificate_files",
    "certificate_xml",
    "read_certificate",
    "read_dcc",
    "read_schema",
]
