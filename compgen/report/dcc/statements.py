"""What a certificate says of itself: what it is and is not, signs, uncertainties, limitations, the laboratory's own words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from compgen.report.dcc.options import Certificate
from compgen.report.dcc.xml import Element, dcc, flat, said
from compgen.report.html.certificate import PROBABILITY
from compgen.report.html.curves import COVERAGE

IS = (
    "The results of a measurement of a machine tool as the program compgen computed them from the files whose SHA-256 "
    "stands with the results. Laboratory, customer, persons, dates, instruments and conditions are what the issuer "
    "stated; the program checked their form, not their truth. The laboratory named here answers for the document."
)
IS_NOT = (
    "The program and its authors are no calibration laboratory, neither accredited nor certified; the document claims no "
    "accreditation and no metrological traceability beyond what the issuer can show. It holds no electronic signature "
    "or seal: without one of the issuer it proves nothing about where it came from. It is no statement of conformity of "
    "the machine, and its figures follow published formulas of the standards but are not certified against them."
)
SIGN = (
    "Errors have the names and signs of ISO 230-1: actual minus commanded, of the tool relative to the workpiece, along "
    "and about the positive axes of the machine. A compensation has the opposite sign. The values do not carry the "
    "refType basic_measurementError, which is an indication minus a reference value: a machine indicates the commanded "
    "position, so that difference has the opposite sign."
)
UNCERTAINTY = (
    f"Stated is the expanded uncertainty: the standard uncertainty times the coverage factor k = {COVERAGE:g}, for a normal "
    f"distribution a coverage probability of {100 * PROBABILITY:g} %. Where value and uncertainty are both zero the value "
    "is fixed by the point or the line that the error is referred to. "
    "A figure without uncertainty is marked as computed, or its uncertainty is not known."
)


def statements(data: Mapping[str, Any], options: Certificate) -> Element:
    """Return ``dcc:statements``."""
    return dcc("statements", *_statements(data, options))


def _statements(data: Mapping[str, Any], options: Certificate) -> Iterator[Element]:
    yield _statement("What this document is", IS)
    yield _statement("What this document is not", IS_NOT)
    convention = dcc("convention", "actual minus commanded, tool relative to workpiece")
    yield _statement("Sign convention", SIGN, convention, dcc("norm", "ISO 230-1"))
    yield _statement("Measurement uncertainty", UNCERTAINTY, dcc("norm", "JCGM 100:2008"))
    for text in data["limitations"]:
        yield _statement("Limitation", flat(text))
    for name, text in options.statements:  # the user's words: language unknown
        yield dcc(
            "statement", dcc("name", dcc("content", flat(name))), dcc("declaration", dcc("content", text.strip()))
        )


def _statement(name: str, text: str, *rules: Element) -> Element:
    """A statement: ``rules`` (convention, norm) stand between its name and its text."""
    return dcc("statement", said("name", name), *rules, said("declaration", text))
