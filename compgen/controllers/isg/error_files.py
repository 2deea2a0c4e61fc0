"""Errors from the files that users have: ``*.errors.csv``, or an exchange file that a laser tracer's software wrote."""

from __future__ import annotations

from pathlib import Path

from compgen.controllers.isg.etalon_exchange import errors_from_etalon, is_exchange_text
from compgen.core.error_table import ErrorTable, read_errors
from compgen.core.files import read_text


def read_error_file(path: str | Path) -> ErrorTable:
    """Read an ``*.errors.csv`` file (um, urad) or an Etalon exchange file, variant Vendor (mm, rad).

    Which of the two it is shows in the text: an exchange file begins, after comments, with a name in brackets.
    """
    source = Path(path)
    text = read_text(source)
    return errors_from_etalon(text, source) if is_exchange_text(text) else read_errors(source)
