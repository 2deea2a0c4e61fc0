"""Records of three-dimensional compensation data as a file punched from the user's own control shows them.

No public document describes that file. What can be told from a sample is taken over: how records look, and in which
number the first point stands. In which order the points come cannot be told; ``order`` in the machine file says it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from compgen.controllers.base import SourceFile
from compgen.controllers.fanuc.sample import frame_of, punched_file, spacing_of, width_of
from compgen.controllers.fanuc.style import FanucStyle
from compgen.controllers.fanuc.text import Record, read_records, type_word
from compgen.core.names import AXES

#: Parameters of the function: axes, points per axis, number of the reference point, magnification, interval.
PARAMETERS = range(10800, 10815)
#: Words of a record behind its number and type word, and what such a file does with the three values of a point.
FORMS = {"APAPAP": "axis words", "XYZ": "axis letters", "P": "a record per value"}


@dataclass(frozen=True)
class VolumeStyle:
    """Style of the records, one of :data:`FORMS`, number of the first record, whether parameters stand beside them."""

    style: FanucStyle
    form: str
    first: int
    with_parameters: bool
    notes: tuple[str, ...]

    def records(self, axis_numbers: Sequence[int], values: Sequence[Sequence[int]]) -> list[str]:
        """Return the records of points in their order, from (x, y, z) values in counts."""
        found, number = [], self.first
        for point in values:
            texts = [self.style.whole(value) for value in point]
            if self.form == "P":
                rows = [[f"P{text}"] for text in texts]
            elif self.form == "XYZ":
                rows = [[f"{letter}{text}" for letter, text in zip(AXES, texts, strict=True)]]
            else:
                pairs = sorted(zip(axis_numbers, texts, strict=True))
                rows = [[word for axis, text in pairs for word in (f"A{axis}", f"P{text}")]]
            for row in rows:
                found.append(self.style.record(number, row, 0, point=True))
                number += 1
        return found


def read_volume_style(path: Path) -> VolumeStyle:
    """Return the style of punched three-dimensional data; InputError with the line for what is not understood."""
    return volume_style_of(punched_file(path))


def volume_style_of(file: SourceFile) -> VolumeStyle:
    """Return the style of punched data from their text; see :func:`read_volume_style`."""
    records = list(read_records(file))
    parameters, data = parted(records)
    if not data:
        raise file.fail("holds no compensation data; punch the table of three-dimensional compensation", 1)
    form = form_of(data[0])
    for before, record in zip(data, data[1:], strict=False):
        if form_of(record) != form:
            raise record.fail(f"its words differ from those of line {data[0].line}; the style is not clear")
        if record.number != before.number + 1:
            raise record.fail(f"does not follow N{before.number}; records of one table are due, in their order")
    style = spacing_of(frame_of(file, records, data), data)
    texts = [text for record in data for letter, text in record.words() if letter in "PXYZ"]
    padded = [text.lstrip("+-").rstrip(".") for text in texts]
    style = replace(
        style,
        point_digits=width_of(data, 5),
        digits=width_of(parameters, 5),
        whole_point=all(text.endswith(".") for text in texts),
        plus=any(text.startswith("+") for text in texts),
        zeros=max((len(text) for text in padded if len(text) > 1 and text[0] == "0"), default=0),
    )
    notes = (
        f"records of the form {FORMS[form]}, the first is N{data[0].number}, {len(data)} of them",
        f"parameters {'stand' if parameters else 'do not stand'} in the same file",
        "the order of the points cannot be told from the sample; `order` in the machine file says it",
    )
    return VolumeStyle(style, form, data[0].number, bool(parameters), notes)


def parted(records: Sequence[Record]) -> tuple[list[Record], list[Record]]:
    """Split records into parameters 10800 ... 10814 and data, whose numbers may run through those as well.

    A record of type Q1 is a parameter, one of type Q0 is data. Without type words a number of that range is data if
    the records of the numbers before and behind the range are there too.
    """
    numbers = {record.number for record in records}
    through = {PARAMETERS[0] - 1, PARAMETERS[-1] + 1} <= numbers
    found: tuple[list[Record], list[Record]] = ([], [])
    for record in records:
        kind, _ = type_word(record, record.words())
        parameter = record.number in PARAMETERS and (kind == 1 or (kind is None and not through))
        found[0 if parameter else 1].append(record)
    return found


def form_of(record: Record) -> str:
    """Return which of :data:`FORMS` a record has; InputError for another one."""
    _, words = type_word(record, record.words())
    form = "".join(letter for letter, _ in words)
    if form not in FORMS:
        raise record.fail(f"words {form or 'none'} are not understood; A1P..A2P..A3P.., X..Y..Z.. or P.. are due")
    for letter, text in words:
        record.whole(text, 1 if letter == "A" else -10_000_000, 10_000_000)
    return form
