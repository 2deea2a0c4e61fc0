"""Elements of a certificate as XML, and their check against the schema on the user's disk."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit
from xml.etree import ElementTree

from compgen.errors import InputError

if TYPE_CHECKING:
    from xmlschema import XMLSchema10


# Elements of a certificate: names, texts that are safe in XML, and quantities in the form of the D-SI schema.
#
# The tree is made with the standard library, which escapes every text; XML is never assembled from strings.


Element = ElementTree.Element

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
XSI = "http://www.w3.org/2001/XMLSchema-instance"
#: Releases of the DCC schema that can be written, the newest last; 3.3.0 builds on D-SI 2.2.1, 3.2.1 on D-SI 2.1.0.
VERSIONS = ("3.2.1", "3.3.0")
NEWEST = VERSIONS[-1]
#: Language of the program's texts; texts of the user have no language attribute.
LANGUAGE = "en"

_ILLEGAL = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

# the prefixes of PTB's documents; the standard library registers them for the whole process
ElementTree.register_namespace("dcc", DCC)
ElementTree.register_namespace("si", SI)


def legal(text: object) -> str:
    """Return ``text`` with a replacement mark for every character that XML 1.0 does not allow.

    >>> legal("a" + chr(0) + "b") == "a" + chr(0xFFFD) + "b"
    True
    """
    return _ILLEGAL.sub("\ufffd", str(text))


def flat(text: object) -> str:
    """Return ``text`` on one line without space at its ends, as ``dcc:notEmptyStringType`` requires."""
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
    """Return an element of the DCC namespace with its children in the given order; None is skipped."""
    return _element(DCC, tag, parts, attributes)


def si(tag: str, *parts: Element | str | None) -> Element:
    """Return an element of the D-SI namespace."""
    return _element(SI, tag, parts, {})


def said(tag: str, text: str) -> Element:
    """Return a text of the program, with its language."""
    return dcc(tag, dcc("content", text, lang=LANGUAGE))


def given(tag: str, text: object) -> Element:
    """Return a text of the user, whose language is unknown."""
    return dcc(tag, dcc("content", flat(text)))


def optional(tag: str, text: object) -> Element | None:
    """Return a plain element with ``text``, None if there is no text."""
    return dcc(tag, flat(text)) if flat(text) else None


def plain_number(value: float | None) -> str:
    """Return a number with all its digits, ``NaN`` if it is unknown.

    >>> plain_number(0.1), plain_number(1e-07), plain_number(None)
    ('0.1', '1e-07', 'NaN')
    """
    return "NaN" if value is None or not math.isfinite(value) else repr(float(value))


def plain_list(values: Sequence[float | None]) -> str:
    """Return numbers with one blank between them."""
    return " ".join(plain_number(value) for value in values)


def real(value: float | None, unit: str, version: str, expanded: Mapping[str, Any] | None = None) -> Element:
    """Return ``si:real``; ``expanded`` holds uncertainty, coverageFactor, coverageProbability and distribution."""
    return si("real", si("value", plain_number(value)), si("unit", unit), _uncertainty(expanded, "", version))


def real_list(item: Mapping[str, Any], version: str) -> Element:
    """Return ``si:realListXMLList`` from ``valueXMLList``, ``unitXMLList`` and, if there, ``expandedUncXMLList``."""
    return si(
        "realListXMLList",
        si("valueXMLList", plain_list(item["valueXMLList"])),
        si("unitXMLList", " ".join(item["unitXMLList"])),
        _uncertainty(item.get("expandedUncXMLList"), "XMLList", version),
    )


def _uncertainty(expanded: Mapping[str, Any] | None, suffix: str, version: str) -> Element | None:
    """Expanded uncertainty of a value or (suffix XMLList) of a list: D-SI 2.2 has a new form and deprecates the former."""
    if expanded is None:
        return None
    coverage = [
        si(f"coverageFactor{suffix}", plain_number(expanded["coverageFactor"])),
        si(f"coverageProbability{suffix}", plain_number(expanded["coverageProbability"])),
        si(f"distribution{suffix}", str(expanded["distribution"])),
    ]
    values = expanded[f"uncertainty{suffix}"]
    text = plain_list(values) if suffix else plain_number(values)
    if version == "3.2.1":
        return si(f"expandedUnc{suffix}", si(f"uncertainty{suffix}", text), *coverage)
    inner = si(f"expandedMU{suffix}", si(f"valueExpandedMU{suffix}", text), *coverage)
    return si(f"measurementUncertaintyUnivariate{suffix}", inner)


def check_version(version: str) -> str:
    """Return ``version`` if certificates of that release can be written."""
    if version not in VERSIONS:
        raise InputError(
            f"release {version or 'without a number'} of the DCC schema is not supported; use {' or '.join(VERSIONS)}"
        )
    return version


def serialised(root: Element) -> bytes:
    """Return the document, indented, in UTF-8; ``root`` itself stays as it is."""
    tree = deepcopy(root)
    ElementTree.indent(tree)
    text = ElementTree.tostring(tree, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'.encode()


# The DCC schema on the user's disk: found with what it imports, without network, and asked whether a document is valid.


#: Faults of a document that a message names.
MOST_FAULTS = 5


@dataclass(frozen=True)
class DccSchema:
    """A DCC schema that was read, and its release."""

    path: Path
    version: str
    rules: XMLSchema10

    def faults(self, document: bytes) -> list[str]:
        """Return what is wrong with ``document``: one line each with its place; empty if it is valid."""
        found = self.rules.iter_errors(document.decode("utf-8"), use_location_hints=False)
        return [f"{error.path or '/'}: {' '.join(str(error.reason or error.message).split())[:300]}" for error in found]

    def check(self, document: bytes) -> None:
        """Raise InputError unless ``document`` is valid."""
        faults = self.faults(document)
        if faults:
            more = f"; and {len(faults) - MOST_FAULTS} more" if len(faults) > MOST_FAULTS else ""
            listed = "; ".join(faults[:MOST_FAULTS])
            raise InputError(
                f"the certificate is not valid by this schema and was not written: {listed}{more}", file=self.path
            )


def read_schema(path: str | Path) -> DccSchema:
    """Read ``dcc.xsd`` and the schemas that it imports from the disk.

    An import with a relative path is followed. One with a web address is searched for below the folder of the schema,
    by the end of its path: for ``https://ptb.de/si/v2.2.1/SI_Format.xsd`` as ``si/v2.2.1/SI_Format.xsd``, then
    ``v2.2.1/SI_Format.xsd``, then ``SI_Format.xsd``. The W3C's schema of XML signatures comes with the library.

    Raises
    ------
    InputError
        if a file is missing or is not a DCC schema of a supported release.
    """
    try:
        import xmlschema
        from xmlschema.exceptions import XMLSchemaException
    except ImportError as error:
        raise InputError("the check against a schema needs xmlschema: python -m pip install 'compgen[dcc]'") from error
    source = Path(path)
    if not source.is_file():
        raise InputError("no such file; give the path of dcc.xsd", file=source)
    folder = source.resolve().parent
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", xmlschema.XMLSchemaImportWarning)
            warnings.simplefilter("error", xmlschema.XMLSchemaIncludeWarning)
            rules = xmlschema.XMLSchema10(
                str(source.resolve()),
                allow="local",
                uri_mapper=lambda uri: local_copy(uri, folder),
            )
    except (XMLSchemaException, Warning, OSError, SyntaxError) as error:
        reason = str(error).strip().partition("\n")[0].rstrip(":. ")[:400]
        if "remote" in reason or isinstance(error, Warning):
            reason += "; put the schemas that it imports into its folder (compgen uses no network)"
        raise InputError(f"cannot be used as a schema: {reason}", file=source) from error
    if rules.target_namespace != DCC:
        raise InputError(f"describes {rules.target_namespace or 'no namespace'}, not {DCC}; give dcc.xsd", file=source)
    try:
        release = check_version(str(rules.root.get("version", "")))
    except InputError as error:
        raise InputError(error.message, file=source) from None
    return DccSchema(source, release, rules)


def local_copy(uri: str, folder: Path) -> str:
    """Return the address of the file below ``folder`` that a web address refers to; ``uri`` itself if there is none."""
    address = urlsplit(uri)
    if address.scheme not in ("http", "https"):
        return uri
    parts = [part for part in address.path.split("/") if part not in ("", ".", "..")]
    for first in range(len(parts)):
        candidate = folder.joinpath(*parts[first:])
        if candidate.is_file():
            return candidate.as_uri()
    return uri
