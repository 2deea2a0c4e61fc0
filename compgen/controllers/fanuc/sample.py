"""The style of a file that was punched from the user's own control, found out from its text.

No public document shows a file of a 0i-F or 30i, so such a sample is the best description of the style that it reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

from compgen.controllers.base import SourceFile
from compgen.controllers.fanuc.style import FanucStyle
from compgen.controllers.fanuc.text import Record, axis_values, read_records, type_word
from compgen.core import tomlio
from compgen.core.files import read_bytes

#: Parameters whose values are whole numbers, and the one that is a length.
WHOLE_PARAMETERS, LENGTH_PARAMETER = (3620, 3621, 3622, 3623, 3626, 3627), 3624
#: Line ends of controls; LF CR CR is the end of block in ISO code.
LINE_ENDS = {"\n\r\r": "LF CR CR", "\r\n": "CR LF", "\n": "LF", "\r": "CR"}


def take_style(section: tomlio.Section) -> tuple[FanucStyle, tuple[str, ...]]:
    """Take ``style_from`` from a control's settings, and the keys of the style, which stand before what a sample shows.

    Returns the style, and in words what was taken from the sample (nothing without one).
    """
    path = section.file("style_from")
    style, notes = (FanucStyle(), ()) if path is None else read_style(path)
    ends = {"lf": "\n", "crlf": "\r\n"}
    eol = section.take("eol", tomlio.choice(*ends), None)
    digits = section.take("digits", tomlio.whole(1, 8), None)
    style = replace(
        style,
        q_word=section.take("q_word", tomlio.flag, style.q_word),
        real_point=section.take("real_point", tomlio.flag, style.real_point),
        number_base=section.take("number_base", tomlio.whole(0, 90000), style.number_base),
        digits=style.digits if digits is None else digits,
        point_digits=style.point_digits if digits is None else digits,
        eol=style.eol if eol is None else ends[eol],
    )
    return style, notes


def take_length_unit_mm(section: tomlio.Section, style: FanucStyle) -> float:
    """Take ``interval_unit_mm``, the unit of lengths without a decimal point; it must be stated for these."""
    if not style.real_point and "interval_unit_mm" not in section:
        raise section.fail(
            "interval_unit_mm",
            "is missing; with real_point = false parameter 3624 is a whole number whose unit depends on the control "
            "(1.0 or 0.001 mm are common): read 3624 of a known axis and give the unit in mm",
        )
    return section.take("interval_unit_mm", tomlio.positive, 1.0)


def read_style(path: Path) -> tuple[FanucStyle, tuple[str, ...]]:
    """Return the style of a file that was punched from a control, and in words what was taken from it.

    InputError with the line for whatever is no FANUC record, and for a style that changes within the file.
    """
    return style_of(punched_file(path))


def punched_file(path: Path) -> SourceFile:
    """Read a punched file with its line ends as they are; InputError for bytes that are not ASCII."""
    content = read_bytes(path)
    try:
        return SourceFile(path, content.decode("ascii"))
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise SourceFile(path, "").fail("holds a byte that is not ASCII; a punched file is ASCII text", line) from None


def style_of(file: SourceFile) -> tuple[FanucStyle, tuple[str, ...]]:
    """Return the style of a punched file's text, and the notes; see :func:`read_style`."""
    records = list(read_records(file))
    points = [record for record in records if is_point(record)]
    others = [record for record in records if not is_point(record)]
    if not records:
        raise file.fail("holds no record; punch the parameters and the pitch error data of the control", 1)
    style = frame_of(file, records, points)
    style = spacing_of(style, records)
    style = _parameter_style(style, [record for record in others if _is_pitch_parameter(record)])
    style = _point_style(style, points)
    return style, _notes(style, points, others)


def is_point(record: Record) -> bool:
    """Whether a record looks like a compensation point: type Q0, or 10000 and above without axis words."""
    kind, words = type_word(record, record.words())
    return kind == 0 or (kind is None and record.number >= 10000 and not any(word[0] in "ASL" for word in words))


def _is_pitch_parameter(record: Record) -> bool:
    return record.number in (*WHOLE_PARAMETERS, LENGTH_PARAMETER)


def frame_of(file: SourceFile, records: Sequence[Record], points: Sequence[Record]) -> FanucStyle:
    """Line ends, order, comments before the first and behind the last record."""
    text = file.text
    eol = next((end for end in LINE_ENDS if end in text), "\n")
    pieces = text.split(eol)
    for number, piece in enumerate(pieces, start=1):
        if "\r" in piece or "\n" in piece:
            raise file.fail(f"this line does not end with {LINE_ENDS[eol]} as others do; punch the file again", number)
    marks = [k for k, piece in enumerate(pieces) if piece.strip().rstrip(";") == "%"]
    lines = sorted({record.line for record in records})
    comments = [(k + 1, piece.strip()) for k, piece in enumerate(pieces) if piece.strip().startswith("(")]
    first_point = points[0].line if points else 0
    first_other = next((record.line for record in records if record not in points), 0)
    return FanucStyle(
        eol=eol,
        header=tuple(piece for line, piece in comments if line < lines[0]),
        footer=tuple(piece for line, piece in comments if line > lines[-1]),
        last_eol=bool(marks) and marks[-1] < len(pieces) - 1,
        points_first=bool(points) and 0 < first_point < first_other,
        containers=2 if len(marks) >= 4 else 1,
        block_end=";" if any(piece.rstrip().endswith(";") for piece in pieces) else "",
        mark=pieces[marks[0]].strip() if marks else "%",
    )


def spacing_of(style: FanucStyle, records: Sequence[Record]) -> FanucStyle:
    """White space and type words, which must be alike in all records."""
    first = records[0]
    words = first.words()
    if not words:
        raise first.fail("has no value; a punched record has one")
    space = first.rest[: len(first.rest) - len(first.rest.lstrip())]
    has_q, last = any(letter == "Q" for letter, _ in words), words[-1][0] == "Q" and len(words) > 1
    for record in records:
        own = record.words()
        if any(letter == "Q" for letter, _ in own) != has_q:
            raise record.fail("some records have a type word Q and some do not; the style is not clear")
        if own and (record.rest[: len(record.rest) - len(record.rest.lstrip())] != space):
            raise record.fail("white space before the words changes from record to record; the style is not clear")
    return replace(style, space=space, q_word=has_q, q_last=has_q and last)


def width_of(records: Sequence[Record], usual: int) -> int:
    """Digits of the N words: those of filled numbers, else 1; ``usual`` if there are no records."""
    filled = [record for record in records if record.filled]
    if not records:
        return usual
    if not filled:
        return 1
    for record in records:
        if record.digits != filled[0].digits and (record.filled or record.digits < filled[0].digits):
            raise record.fail(
                f"{record.digits} digits, line {filled[0].line} has {filled[0].digits}; the style is not clear"
            )
    return filled[0].digits


def _parameter_style(style: FanucStyle, records: Sequence[Record]) -> FanucStyle:
    """Axis words, and how lengths are written, from the parameters 3620 ... 3627."""
    values = [(record, axis_values(record, type_word(record, record.words())[1])) for record in records]
    for record in records:
        letters = [letter for letter, _ in type_word(record, record.words())[1]]
        style = replace(style, value_first=letters[0] != "A")
    several = [len(pairs) for _, pairs in values]
    style = replace(style, digits=width_of(records, style.digits), axes_together=not several or max(several) > 1)
    if several and max(several) == 1:
        numbers = [record.number for record in records]
        style = replace(style, axes_together=len(set(numbers)) == len(numbers))
    lengths = [(record, text) for record, pairs in values if record.number == LENGTH_PARAMETER for _, text in pairs]
    if not lengths:
        return style
    real = ["." in text for _, text in lengths]
    if any(real) != all(real):
        raise lengths[0][0].fail("some lengths have a decimal point and some do not; the style is not clear")
    decimals = {len(text.partition(".")[2]) for _, text in lengths}
    letter = next(letter for letter, _ in lengths[0][0].words() if letter in "PM")
    fixed = decimals.pop() if len(decimals) == 1 else None
    return replace(style, real_point=real[0], decimals=fixed if real[0] and fixed != 1 else None, real_letter=letter)


def _point_style(style: FanucStyle, points: Sequence[Record]) -> FanucStyle:
    """Record numbers and whole numbers, from the compensation points."""
    if not points:
        return style
    texts = [type_word(record, record.words())[1] for record in points]
    for record, words in zip(points, texts, strict=True):
        if len(words) != 1 or words[0][0] != "P":
            raise record.fail("a single value word P is due for a compensation point, e.g. P-2")
        record.whole(words[0][1], -10_000_000, 10_000_000)
    bare = [words[0][1] for words in texts]
    padded = [text.lstrip("+-").rstrip(".") for text in bare]
    zeros = max((len(text) for text in padded if len(text) > 1 and text[0] == "0"), default=0)
    numbers = [record.number for record in points]
    return replace(
        style,
        point_digits=width_of(points, style.point_digits),
        number_base=min(numbers) // 10000 * 10000,
        whole_point=all(text.endswith(".") for text in bare),
        plus=any(text.startswith("+") for text in bare),
        zeros=zeros,
    )


def _notes(style: FanucStyle, points: Sequence[Record], others: Sequence[Record]) -> tuple[str, ...]:
    """Say in words what the sample showed, and what it did not show."""
    type_words = ("Q1 and Q0" + (" behind the other words" if style.q_last else "")) if style.q_word else "none"
    found = [
        f"line end {LINE_ENDS[style.eol]}" + (f", {style.block_end} before it" if style.block_end else ""),
        f"type words: {type_words}",
        f"words {'separated by white space' if style.space else 'without white space'}",
        f"digits of N words: {style.digits} (parameters), {style.point_digits} (points)",
    ]
    if points:
        found.append(f"compensation point 0 is record N{style.number_base}; e.g. {style.point(1, -2)}")
    else:
        found.append(f"no compensation point in it: number base {style.number_base} is NOT confirmed")
    if any(record.number == LENGTH_PARAMETER for record in others):
        example = style.length(Decimal(50))
        found.append(
            f"lengths {'with' if style.real_point else 'without'} decimal point, e.g. {style.real_letter}{example}"
        )
    else:
        found.append("no parameter 3624 in it: the form of lengths is NOT confirmed")
    order = "points before parameters" if style.points_first else "parameters before points"
    found.append(f"{order}, {style.containers} pair{'s' if style.containers > 1 else ''} of %")
    axes = "all axes of a parameter in one record" if style.axes_together else "one record per axis"
    found.append(axes + (", value word before axis word" if style.value_first else ""))
    found += [f"comment {text}" for text in (*style.header, *style.footer)]
    return tuple(found)
