"""The DCC schema on the user's disk: found with what it imports, without network, and asked whether a document is valid."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from compgen.errors import InputError
from compgen.report.dcc.xml import DCC, check_version

if TYPE_CHECKING:
    from xmlschema import XMLSchema10

#: Faults of a document that a message names.
MOST_FAULTS = 5


@dataclass(frozen=True)
class Schema:
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


def read_schema(path: str | Path) -> Schema:
    """Read ``dcc.xsd`` and the schemas that it imports from the disk.

    An import with a relative path is followed. One with a web address is looked for below the folder of the schema, by
    the end of its path: for ``https://ptb.de/si/v2.2.1/SI_Format.xsd`` as ``si/v2.2.1/SI_Format.xsd``, then
    ``v2.2.1/SI_Format.xsd``, then ``SI_Format.xsd``. The W3C's schema of XML signatures comes with the library.

    Raises
    ------
    InputError
        where a file is missing or no schema, it is no DCC schema, or one of a release that is not written.
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
        raise InputError(f"cannot be used as a schema: {_reason(error)}", file=source) from error
    return Schema(source, _release(rules, source), rules)


def _release(rules: XMLSchema10, source: Path) -> str:
    if rules.target_namespace != DCC:
        raise InputError(f"describes {rules.target_namespace or 'no namespace'}, not {DCC}; give dcc.xsd", file=source)
    try:
        return check_version(str(rules.root.get("version", "")))
    except InputError as error:
        raise InputError(error.message, file=source) from None


def _reason(error: BaseException) -> str:
    """The first line of the message, with what to do about an import that is not on the disk."""
    text = str(error).strip().partition("\n")[0].rstrip(":. ")[:400]
    if "remote" in text or isinstance(error, Warning):
        text += "; put the schemas that it imports into its folder (compgen uses no network)"
    return text


def local_copy(uri: str, folder: Path) -> str:
    """Return the address of the file below ``folder`` that a web address stands for; ``uri`` itself if there is none."""
    address = urlsplit(uri)
    if address.scheme not in ("http", "https"):
        return uri
    parts = [part for part in address.path.split("/") if part not in ("", ".", "..")]
    for first in range(len(parts)):
        candidate = folder.joinpath(*parts[first:])
        if candidate.is_file():
            return candidate.as_uri()
    return uri
