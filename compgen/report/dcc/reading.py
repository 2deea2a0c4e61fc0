"""A Digital Calibration Certificate of a reference (laser, plate, square): what it identifies, and whether it is consistent."""

from __future__ import annotations

import base64
import datetime
import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.dom import minidom
from xml.etree import ElementTree

from compgen.data.files import read_bytes
from compgen.errors import InputError
from compgen.report.dcc.xml import DCC, SI

#: A larger file is no certificate, bytes.
MOST_BYTES = 50_000_000
#: Uncertainties of lists and of single values, in both forms of D-SI; and coverage factors.
_UNCERTAIN = ("uncertaintyXMLList", "valueExpandedMUXMLList", "valueStandardMUXMLList", "uncertainty", "valueExpandedMU",
              "valueStandardMU")  # fmt: skip
_FACTORS = ("coverageFactorXMLList", "coverageFactor")
_SIGNATURE, _XMLNS = "http://www.w3.org/2000/09/xmldsig#", "http://www.w3.org/2000/xmlns/"
#: Canonical forms with all prefixes in force, as signed certificates of PTB's good practice have them.
_CANONICAL = ("http://www.w3.org/2006/12/xml-c14n11", "http://www.w3.org/TR/2001/REC-xml-c14n-20010315")
_DIGESTS = {"sha256": "sha256", "sha384": "sha384", "sha512": "sha512"}
_D, _S = f"{{{DCC}}}", f"{{{SI}}}"


@dataclass(frozen=True)
class ReferenceCertificate:
    """What identifies the certificate of a reference: its number, laboratory, days of the measurement, items, SHA-256."""

    path: Path
    number: str
    laboratory: str
    begin: datetime.date
    end: datetime.date
    numbers: tuple[str, ...]
    sha256: str


def read_dcc(path: str | Path) -> ReferenceCertificate:
    """Read a DCC (XML of PTB's schema, any release 2 or 3).

    What was changed after it was signed is found by the digest in its signature; who signed it is not checked. What was changed
    without a signature is found where it contradicts itself: lists of different lengths, uncertainties below zero, coverage
    factors below one, an end before the begin.

    Raises
    ------
    InputError
        for a file that is no DCC, lacks what identifies it, or contradicts itself; it names the element.
    """
    source = Path(path)
    content = read_bytes(source, MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise InputError(f"has more than {MOST_BYTES // 1_000_000} MB; expected a calibration certificate", file=source)
    plain = content.replace(b"\0", b"").upper()  # also in UTF-16
    if b"<!DOCTYPE" in plain or b"<!ENTITY" in plain:
        raise InputError("declares XML entities; it is refused", file=source)
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError) as error:
        raise InputError(f"is not complete XML: {error}", file=source) from error
    if root.tag != f"{_D}digitalCalibrationCertificate":
        raise InputError(f"is no Digital Calibration Certificate: its root is {root.tag[:80]}", file=source)
    begin, end = (_day(root, tag, source) for tag in ("beginPerformanceDate", "endPerformanceDate"))
    if end < begin:
        raise InputError(f"ends before it begins: {end} is before {begin}", file=source, field="endPerformanceDate")
    try:
        unchanged = is_unchanged(content)
    except RecursionError:
        raise InputError(
            "has elements too deep within each other; expected a calibration certificate", file=source
        ) from None
    if unchanged is False:
        text = "was changed after it was signed: its contents do not have the digest that its signature states"
        raise InputError(text, file=source, field="DigestValue")
    for message in contradictions(root):
        raise InputError(f"contradicts itself: {message}", file=source)
    laboratory = root.find(f".//{_D}calibrationLaboratory//{_D}name/{_D}content")
    return ReferenceCertificate(
        source,
        _text(root, "uniqueIdentifier", source),
        "" if laboratory is None else " ".join((laboratory.text or "").split()),
        begin,
        end,
        tuple(dict.fromkeys(_numbers(root))),
        hashlib.sha256(content).hexdigest(),
    )


def _text(root: ElementTree.Element, tag: str, path: Path) -> str:
    found = root.find(f".//{_D}coreData/{_D}{tag}")
    if found is None or not (found.text or "").strip():
        raise InputError("is missing in the certificate", file=path, field=tag)
    return " ".join(str(found.text).split())


def _day(root: ElementTree.Element, tag: str, path: Path) -> datetime.date:
    text = _text(root, tag, path)
    try:
        return datetime.date.fromisoformat(text[:10])
    except ValueError:
        raise InputError(f"{text[:40]!r} is not a date", file=path, field=tag) from None


def _numbers(root: ElementTree.Element) -> Iterator[str]:
    """Yield the numbers that identify the items."""
    for value in root.iterfind(f".//{_D}items//{_D}identification/{_D}value"):
        yield " ".join((value.text or "").split())


def contradictions(root: ElementTree.Element) -> Iterator[str]:
    """Yield what cannot be true of the quantities of a certificate."""
    for quantity in root.iter(f"{_S}realListXMLList"):
        yield from _of_quantity(quantity, "valueXMLList")
    for quantity in root.iter(f"{_S}real"):
        yield from _of_quantity(quantity, "value")
    for table in root.iter(f"{_D}list"):
        sizes = {
            len((values.text or "").split())
            for own in table.findall(f"{_D}quantity")
            for values in own.iterfind(f".//{_S}realListXMLList/{_S}valueXMLList")
        }
        if len(sizes - {1}) > 1:
            yield f"lists of one table have {', '.join(map(str, sorted(sizes)))} values"


def _of_quantity(quantity: ElementTree.Element, tag: str) -> Iterator[str]:
    values = _floats(quantity.find(f"{_S}{tag}"))
    if not values or not all(map(math.isfinite, values)):
        yield f"{tag} is empty or has something that is no number"
    units = quantity.find(f"{_S}unit{'XMLList' if tag.endswith('List') else ''}")
    if units is None or len((units.text or "").split()) not in (1, len(values)):
        yield f"{len(values)} values, and units for another number of them"
    for name in (*_UNCERTAIN, *_FACTORS):
        for found in quantity.iter(f"{_S}{name}"):
            numbers = _floats(found)
            if len(numbers) not in (1, len(values)):
                yield f"{len(values)} values, but {len(numbers)} of {name}"
            least = 1.0 if name in _FACTORS else 0.0
            if not all(math.isfinite(number) and number >= least for number in numbers):
                yield f"{name} has a value below {least:g}, or one that is no number"


# The digest of an enveloped signature (XML Signature), over the document in canonical form (C14N 1.0 and 1.1) without it.


def is_unchanged(content: bytes) -> bool | None:
    """Whether a document has the digest that its signature states; None without one, or of a form that is not checked here."""
    document = minidom.parseString(content)
    for reference in document.getElementsByTagNameNS(_SIGNATURE, "Reference"):
        forms = [item.getAttribute("Algorithm") for item in reference.getElementsByTagNameNS(_SIGNATURE, "Transform")]
        method = reference.getElementsByTagNameNS(_SIGNATURE, "DigestMethod")
        stated = reference.getElementsByTagNameNS(_SIGNATURE, "DigestValue")
        if reference.getAttribute("URI") or not method or not stated or not forms:
            continue
        digest = _DIGESTS.get(method[0].getAttribute("Algorithm").rpartition("#")[2])
        if forms[:-1] != [f"{_SIGNATURE}enveloped-signature"] or forms[-1] not in _CANONICAL or digest is None:
            continue
        pieces: list[str] = []
        _canonical(document.documentElement, {}, pieces)
        own = base64.b64encode(hashlib.new(digest, "".join(pieces).encode()).digest()).decode()
        words = "".join(node.data for node in stated[0].childNodes if node.nodeType == node.TEXT_NODE)
        return own == "".join(words.split())
    return None


def _canonical(node: Any, shown: Mapping[str, str], pieces: list[str]) -> None:
    """Append the canonical form of an element, without comments and signatures; ``shown`` are the prefixes in force."""
    if node.nodeType in (node.TEXT_NODE, node.CDATA_SECTION_NODE):
        pieces.append(_escaped(node.data).replace(">", "&gt;"))
    elif node.nodeType == node.PROCESSING_INSTRUCTION_NODE:
        pieces.append(f"<?{node.target}{' ' if node.data else ''}{node.data}?>")
    elif node.nodeType == node.ELEMENT_NODE and (node.namespaceURI, node.localName) != (_SIGNATURE, "Signature"):
        attributes = [node.attributes.item(k) for k in range(node.attributes.length)]
        declared = {
            "" if item.name == "xmlns" else item.localName: item.value
            for item in attributes
            if item.namespaceURI == _XMLNS
        }
        new = {prefix: uri for prefix, uri in sorted(declared.items()) if shown.get(prefix, "") != uri}
        others = [item for item in attributes if item.namespaceURI != _XMLNS]
        others.sort(key=lambda item: (item.namespaceURI or "", item.localName))
        pieces.append(f"<{node.tagName}")
        pieces += [f' xmlns{":" if prefix else ""}{prefix}="{_in_quotes(uri)}"' for prefix, uri in new.items()]
        pieces += [f' {item.name}="{_in_quotes(item.value)}"' for item in others]
        pieces.append(">")
        for child in node.childNodes:
            _canonical(child, {**shown, **new}, pieces)
        pieces.append(f"</{node.tagName}>")


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace("\r", "&#xD;")


def _in_quotes(text: str) -> str:
    return _escaped(text).replace('"', "&quot;").replace("\t", "&#x9;").replace("\n", "&#xA;")


def _floats(element: ElementTree.Element | None) -> list[float]:
    try:
        return [] if element is None else [float(word) for word in (element.text or "").split()]
    except ValueError:
        return [math.nan]
