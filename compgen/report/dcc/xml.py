"""Elements of a certificate: names, texts that are safe in XML, and quantities as the D-SI schema has them.

The tree is made with the standard library, which escapes every text; nothing is ever put together from strings.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any
from xml.etree import ElementTree

from compgen.errors import InputError

Element = ElementTree.Element

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
#: Releases of the DCC schema that can be written, the newest last; 3.3.0 stands on D-SI 2.2.1, 3.2.1 on D-SI 2.1.0.
VERSIONS = ("3.2.1", "3.3.0")
NEWEST = VERSIONS[-1]
#: Language of the program's own texts; texts of the user carry no language.
LANGUAGE = "en"

_ILLEGAL = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

# the prefixes of PTB's documents; the standard library keeps them for the whole program
ElementTree.register_namespace("dcc", DCC)
ElementTree.register_namespace("si", SI)


def legal(text: object) -> str:
    """Return ``text`` with a replacement mark for every character that XML 1.0 does not allow.

    >>> legal("a" + chr(0) + "b") == "a" + chr(0xFFFD) + "b"
    True
    """
    return _ILLEGAL.sub("\ufffd", str(text))


def flat(text: object) -> str:
    """Return ``text`` on one line without space at its ends, as ``dcc:notEmptyStringType`` asks for."""
    return " ".join(legal(text).split())


def _element(namespace: str, tag: str, parts: Sequence[Element | str | None], attributes: Mapping[str, str]) -> Element:
    found = Element(f"{{{namespace}}}{tag}", {key: legal(value) for key, value in attributes.items()})
    for part in parts:
        if isinstance(part, str):
            found.text = legal(part)
        elif part is not None:
            found.append(part)
    return found


def dcc(tag: str, *parts: Element | str | None, **attributes: str) -> Element:
    """Return an element of the DCC namespace with its children in the given order; None is left out."""
    return _element(DCC, tag, parts, attributes)


def si(tag: str, *parts: Element | str | None) -> Element:
    """Return an element of the D-SI namespace."""
    return _element(SI, tag, parts, {})


def said(tag: str, text: str) -> Element:
    """Return a text of the program, in its language."""
    return dcc(tag, dcc("content", text, lang=LANGUAGE))


def given(tag: str, text: object) -> Element:
    """Return a text of the user; its language is not known."""
    return dcc(tag, dcc("content", flat(text)))


def optional(tag: str, text: object) -> Element | None:
    """Return a plain element with ``text``, None where there is none."""
    return dcc(tag, flat(text)) if flat(text) else None


def plain_number(value: float | None) -> str:
    """Return a number with all its digits, ``NaN`` where it is not known.

    >>> plain_number(0.1), plain_number(1e-07), plain_number(None)
    ('0.1', '1e-07', 'NaN')
    """
    return "NaN" if value is None or not math.isfinite(value) else repr(float(value))


def plain_list(values: Sequence[float | None]) -> str:
    """Return numbers with one blank between them."""
    return " ".join(plain_number(value) for value in values)


def real(value: float | None, unit: str, version: str, expanded: Mapping[str, Any] | None = None) -> Element:
    """Return ``si:real``; ``expanded`` holds uncertainty, coverageFactor, coverageProbability and distribution."""
    return si("real", si("value", plain_number(value)), si("unit", unit), _expanded(expanded, version))


def real_list(item: Mapping[str, Any], version: str) -> Element:
    """Return ``si:realListXMLList`` from ``valueXMLList``, ``unitXMLList`` and, if there, ``expandedUncXMLList``."""
    return si(
        "realListXMLList",
        si("valueXMLList", plain_list(item["valueXMLList"])),
        si("unitXMLList", " ".join(item["unitXMLList"])),
        _expanded_list(item.get("expandedUncXMLList"), version),
    )


def _expanded(expanded: Mapping[str, Any] | None, version: str) -> Element | None:
    """Expanded uncertainty of one value: D-SI 2.2 has a new form, and calls the one before deprecated."""
    if expanded is None:
        return None
    shared = _coverage(expanded, "")
    uncertainty = plain_number(expanded["uncertainty"])
    if version == "3.2.1":
        return si("expandedUnc", si("uncertainty", uncertainty), *shared)
    return si("measurementUncertaintyUnivariate", si("expandedMU", si("valueExpandedMU", uncertainty), *shared))


def _expanded_list(expanded: Mapping[str, Any] | None, version: str) -> Element | None:
    if expanded is None:
        return None
    shared = _coverage(expanded, "XMLList")
    uncertainties = plain_list(expanded["uncertaintyXMLList"])
    if version == "3.2.1":
        return si("expandedUncXMLList", si("uncertaintyXMLList", uncertainties), *shared)
    inner = si("expandedMUXMLList", si("valueExpandedMUXMLList", uncertainties), *shared)
    return si("measurementUncertaintyUnivariateXMLList", inner)


def _coverage(expanded: Mapping[str, Any], suffix: str) -> list[Element]:
    return [
        si(f"coverageFactor{suffix}", plain_number(expanded["coverageFactor"])),
        si(f"coverageProbability{suffix}", plain_number(expanded["coverageProbability"])),
        si(f"distribution{suffix}", str(expanded["distribution"])),
    ]


def check_version(version: str) -> str:
    """Return ``version`` if certificates of that release can be written."""
    if version not in VERSIONS:
        raise InputError(
            f"release {version or 'without a number'} of the DCC schema; {' and '.join(VERSIONS)} can be written"
        )
    return version


def serialised(root: Element) -> bytes:
    """Return the document, indented, in UTF-8; ``root`` itself stays as it is."""
    tree = deepcopy(root)
    ElementTree.indent(tree)
    text = ElementTree.tostring(tree, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()
