"""The document as a whole, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from compgen.report.dcc.administrative import administrative_data
from compgen.report.dcc.options import Certificate
from compgen.report.dcc.results import measurement_results
from compgen.report.dcc.schema import Schema
from compgen.report.dcc.xml import DCC, NEWEST, XSI, check_version, dcc, serialised
from compgen.report.html.certificate import calibration_record

FILE = "dcc.xml"


def certificate_xml(data: Mapping[str, Any], options: Certificate, version: str = NEWEST) -> bytes:
    """Return the certificate as XML in UTF-8.

    Parameters
    ----------
    data : the numbers of a report (:func:`compgen.report.html.content.content`), only finite numbers or None.
    options : what the laboratory stated.
    version : release of the DCC schema, one of :data:`compgen.report.dcc.xml.VERSIONS`.

    Raises
    ------
    InputError
        where nothing was measured, or for a release that cannot be written.
    """
    root = dcc(
        "digitalCalibrationCertificate",
        administrative_data(data, options),
        measurement_results(data, calibration_record(data), options, check_version(version)),
        schemaVersion=version,
    )
    root.set(f"{{{XSI}}}schemaLocation", f"{DCC} {DCC}/v{version}/dcc.xsd")
    return serialised(root)


def certificate_files(data: Mapping[str, Any], options: Certificate, schema: Schema | None = None) -> dict[str, bytes]:
    """Return ``dcc.xml`` by its name: of the release of ``schema`` and valid by it, else of the newest release.

    Raises
    ------
    InputError
        where nothing was measured, or the document is not valid.
    """
    document = certificate_xml(data, options, NEWEST if schema is None else schema.version)
    if schema is not None:
        schema.check(document)
    return {FILE: document}
