"""FANUC parameter and compensation data files: their records, their style, and what a punched sample shows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, TypeVar

from compgen.controls.shared.base import SourceFile
from compgen.controls.shared.scanner import check_size
from compgen.data import toml_files
from compgen.data.files import read_bytes
from compgen.data.machine import Machine
from compgen.data.toml_files import axis_setting, choice, file_setting, setting, whole, word_for
from compgen.errors import InputError, one_line

# Records of FANUC parameter and pitch data files: ``%``, blocks ``N... A... P...``, ``%``.
#
# The grammar is that of the Series 15i (parameter manual B-63330EN, board manual B-63322EN-2); a type word ``Q``, white
# space between words, ``(comments)``, ``;`` as printed block end, LF and CR LF are accepted too.


#: No parameter file of a control is nearly this long.
MOST_CHARACTERS = 4_000_000
#: No parameter file has this many blocks.
MOST_BLOCKS = 100_000
#: No block is this long: 99 axes with 20 characters each.
MOST_IN_BLOCK = 2000

_COMMENT = re.compile(r"\([^()]*\)")
_RECORD = re.compile(r"[ \t]*N(\d{1,8})(?!\d)([A-Z0-9.+\- \t]*)", re.ASCII)
_WORD = re.compile(r"[ \t]*([A-Z])([+-]?(?:\d{1,12}(?:\.\d{0,12})?|\.\d{1,12}))(?![\d.])", re.ASCII)


@dataclass(frozen=True)
class Record:
    """One block of a file: its number (with its digits, perhaps zero-padded), and the text after it."""

    number: int
    rest: str
    file: SourceFile
    line: int
    digits: int = 0
    filled: bool = False

    def fail(self, message: str) -> InputError:
        """Return the error that points at this record."""
        return self.file.fail(f"N{self.number:05d}: {message}", self.line)

    def words(self) -> list[tuple[str, str]]:
        """Return the words after the number as (letter, number as text)."""
        text, found, at = self.rest.rstrip(), [], 0
        while at < len(text):
            word = _WORD.match(text, at)
            if word is None:
                raise self.fail(
                    f"{one_line(text[at : at + 20])!r} is not a word; expected a letter and a plain decimal number"
                )
            found.append((word[1], word[2]))
            at = word.end()
        return found

    def whole(self, text: str, low: int, high: int) -> int:
        """Return ``text`` as a whole number within limits (a trailing decimal point is harmless)."""
        value = Decimal(text)
        if value != value.to_integral_value() or not low <= value <= high:
            raise self.fail(f"got {text}; expected a whole number from {low} to {high}")
        return int(value)


def read_records(file: SourceFile) -> Iterator[Record]:
    """Yield the records between pairs of ``%``; InputError for anything else and for a missing final ``%``."""
    check_size(file, MOST_CHARACTERS)
    lines = file.text.split("\n" if "\n" in file.text else "\r")
    inside, marks, blocks = False, 0, 0
    for number, line in enumerate(lines, start=1):
        bare = _COMMENT.sub(" ", line) if "(" in line else line
        for piece in bare.split(";"):
            block = piece.strip(" \t\r\ufeff")
            if block == "%":
                inside, marks = not inside, marks + 1
            elif block:
                blocks += 1
                if blocks > MOST_BLOCKS:
                    raise file.fail(f"has more than {MOST_BLOCKS} blocks; a parameter file has fewer", number)
                if not inside:
                    raise file.fail(f"{one_line(block[:20])!r} is not between two '%'", number)
                if len(block) > MOST_IN_BLOCK:
                    raise file.fail(
                        f"this block has {len(block)} characters; at most {MOST_IN_BLOCK} are allowed", number
                    )
                found = _RECORD.match(block)
                if found is None:
                    message = f"{one_line(block[:20])!r} is not a block; expected 'N' and a number of at most 8 digits"
                    raise file.fail(message, number)
                if found.end() != len(block):
                    what = one_line(block[found.end() : found.end() + 20])
                    message = f"{what!r} is not allowed in a block; a word is a letter and a decimal number with '.'"
                    raise file.fail(message, number)
                yield Record(int(found[1]), found[2], file, number, len(found[1]), found[1].startswith("0"))
    if marks == 0:
        raise file.fail("contains no '%'; a FANUC file begins and ends with one")
    if inside:
        raise file.fail("the last '%' is missing: the file is truncated", len(lines))


def type_word(record: Record, words: Sequence[tuple[str, str]]) -> tuple[int | None, list[tuple[str, str]]]:
    """Return the type word ``Q`` (0 pitch data, 1 parameter, None if absent) and the other words."""
    for place in (0, -1):
        if words and words[place][0] == "Q":
            others = list(words)
            return record.whole(others.pop(place)[1], 0, 9), others
    return None, list(words)


def axis_values(record: Record, words: Sequence[tuple[str, str]]) -> list[tuple[int, str]]:
    """Return the (axis number, value as text) pairs ``A1P40A2P20`` (or ``P40A1``) of a parameter of the axis type."""
    if not words or len(words) % 2:
        raise record.fail("expected pairs of an axis word A and a value word P, e.g. A1P40A2P20")
    pairs = []
    for first, second in zip(words[::2], words[1::2], strict=True):
        (axis_letter, axis), (value_letter, value) = (second, first) if second[0] == "A" else (first, second)
        if axis_letter != "A":
            raise record.fail(f"expected an axis word A, e.g. A1P40, found {axis_letter}{axis}")
        if value_letter == "I":
            raise record.fail("the value word I marks inch data; punch the file with the control set to mm")
        if value_letter not in ("P", "M"):
            raise record.fail(f"expected a value word P, e.g. A1P40, found {value_letter}{value}")
        pairs.append((record.whole(axis, 1, 99), value))
    return pairs


# How a FANUC control writes its records: digits, words, decimal points, line ends.


@dataclass(frozen=True)
class FanucStyle:
    """Style of a file.

    Parameters
    ----------
    eol, block_end, space : line end, what precedes it (``;`` or nothing), what separates words.
    mark : first and last line.
    digits, point_digits : digits of the N words of parameters and of compensation points, zero-padded.
    q_word, q_last : type word Q1 (parameter) or Q0 (pitch data), after the other words if ``q_last``.
    value_first : the value word comes before its axis word.
    axes_together : all axes of a parameter in one record.
    real_letter, real_point, decimals : value word of lengths, whether it has a decimal point, decimals (None: as
        few as needed, at least one).
    whole_point, plus, zeros : whole numbers end with a point, have a plus sign, are zero-padded to so many digits.
    number_base : record number of compensation point 0.
    points_first, containers : points before parameters; 1, or 2: each in a separate pair of ``%``.
    header, footer : lines after the first ``%`` and before the last one.
    last_eol : whether a line end follows the last ``%``.
    even : a blank makes the number of characters of a record even.
    path : path of parameters without axis, written as a word L; 0: no such word.
    """

    eol: str = "\n"
    block_end: str = ""
    mark: str = "%"
    space: str = ""
    digits: int = 5
    point_digits: int = 5
    q_word: bool = False
    q_last: bool = False
    value_first: bool = False
    axes_together: bool = True
    real_letter: str = "P"
    real_point: bool = True
    decimals: int | None = None
    whole_point: bool = False
    plus: bool = False
    zeros: int = 0
    number_base: int = 10000
    points_first: bool = False
    containers: int = 1
    header: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()
    last_eol: bool = True
    even: bool = False
    path: int = 0

    def whole(self, value: int) -> str:
        """Return a whole number as written in the file."""
        sign = "-" if value < 0 else "+" if self.plus else ""
        return f"{sign}{abs(value):0{max(self.zeros, 1)}d}{'.' if self.whole_point else ''}"

    def length(self, value: Decimal) -> str:
        """Return a length, in the unit of the file, as written in the file."""
        if not self.real_point:
            return str(int(value))
        if self.decimals is not None and self.decimals >= 2:
            return f"{value:.{self.decimals}f}"
        before, _, decimals = f"{value:f}".partition(".")
        decimals = decimals.rstrip("0")
        return f"{before}.{decimals or ('' if self.decimals == 0 else '0')}"

    def record(self, number: int, words: Sequence[str], kind: int, *, point: bool = False) -> str:
        """Return a record: N word, words, and the type word ``kind`` if the style has one."""
        name = f"N{number:0{self.point_digits if point else self.digits}d}"
        q_words = [f"Q{kind}"] if self.q_word else []
        text = self.space.join([name, *words, *q_words] if self.q_last else [name, *q_words, *words]) + self.block_end
        return text + " " if self.even and len(text) % 2 else text

    def parameter(self, number: int, values: Iterable[tuple[int, str]], letter: str = "P") -> list[str]:
        """Return the records of a parameter of the axis type from (axis number, value as text), axes ascending."""
        pairs = []
        for axis, text in sorted(values):
            pair = [f"A{axis}", f"{letter}{text}"]
            pairs.append(pair[::-1] if self.value_first else pair)
        if self.axes_together:
            return [self.record(number, [word for pair in pairs for word in pair], 1)]
        return [self.record(number, pair, 1) for pair in pairs]

    def common(self, number: int, value: int) -> str:
        """Return the record of a parameter of a path."""
        path = [f"L{self.path}"] if self.path else []
        return self.record(number, [*path, f"P{self.whole(value)}"], 1)

    def point(self, number: int, value: int) -> str:
        """Return the record of a compensation point."""
        return self.record(self.number_base + number, [f"P{self.whole(value)}"], 0, point=True)

    def file(self, parameters: Sequence[str], points: Sequence[str]) -> str:
        """Return the text of a file from its records."""
        parts = [points, parameters] if self.points_first else [parameters, points]
        between = [self.mark] * 2 if self.containers == 2 and parameters and points else []
        lines = [self.mark, *self.header, *parts[0], *between, *parts[1], *self.footer, self.mark]
        return self.eol.join(lines) + (self.eol if self.last_eol else "")


@dataclass(frozen=True)
class Punched:
    """Text of a file for the templates, including line ends and white space."""

    text: str


# What files punched from the user's control show: their style, and the points of every axis.
#
# No public document shows a file of a 0i-F or 30i, so a sample is the best description of the style that it reads. It
# also says which compensation points each axis has; those of other axes must never be overwritten.


#: Parameters with whole-number values, and the one that is a length.
WHOLE_PARAMETERS, LENGTH_PARAMETER = (3620, 3621, 3622, 3623, 3626, 3627), 3624
#: What the sample may contain for an axis: how its table works, its points. For a path: machine unit, total values,
#: straightness.
AXIS_PARAMETERS = (3605, *range(3620, 3628))
UNIT_PARAMETER, TOTAL_PARAMETER, STRAIGHTNESS_PARAMETERS = 1001, 3602, range(5700, 5800)
#: Largest compensation point number, and largest value of a point, accepted when reading.
MOST_NUMBER, MOST_VALUE = 9999, 10_000_000
#: Line ends of controls; LF CR CR is end of block in ISO code.
LINE_ENDS = {"\n\r\r": "LF CR CR", "\r\n": "CR LF", "\n": "LF", "\r": "CR"}

#: Comments may be in any language; they are copied with ? for non-ASCII characters.
_COMMENT_BYTES, _NOT_ASCII = re.compile(rb"\([^()\r\n]*\)"), re.compile(rb"[\x80-\xff]+")

Span = tuple[int, int]
#: (number, axis number) -> value as text and its record.
Parameters = dict[tuple[int, int], tuple[str, Record]]


@dataclass(frozen=True)
class PointGrid:
    """Compensation points of one axis: point n is at the reference point plus (n - ``reference``) intervals.

    Parameters 3620 (``reference``), 3621 and 3622 (``first`` and ``last``), 3624 (``interval_mm``).
    """

    reference: int
    first: int
    last: int
    interval_mm: Decimal

    def along_mm(self, number: int) -> float:
        """Position of a point from the reference point, mm."""
        return float((number - self.reference) * self.interval_mm)


@dataclass(frozen=True)
class AxisPoints:
    """What the sample shows for one controlled axis.

    ``grid`` are its compensation points (in degrees for a rotary axis), ``magnification`` is parameter 3623,
    ``negative_first`` the first number for negative travel (None unless 3605#0 is set). ``record`` is 3621.
    """

    number: int
    grid: PointGrid
    magnification: int
    negative_first: int | None
    record: Record

    @property
    def spans(self) -> tuple[Span, ...]:
        """Blocks (first, last) of point numbers that the axis uses, including its reference point."""
        low, high = min(self.grid.first, self.grid.reference), max(self.grid.last, self.grid.reference)
        if self.negative_first is None:
            return ((low, high),)
        return (low, high), (self.negative_first, self.negative_first + self.grid.last - self.grid.first)


@dataclass(frozen=True)
class Sample:
    """What punched files of the user's control show; empty, with the default style, if there are none.

    Parameters
    ----------
    style : how records are written; ``points_style`` is the style of the points file if that is separate.
    notes : what was taken from the sample, in words.
    axes : compensation points by controlled axis number, of all axes that have any, including those switched off.
    parameters : (number, axis number) -> (value as text, record) of the parameters that compensation needs.
    values : compensation point number -> value.
    common : path parameters 1001, 3602 and 5700 to 5799, number -> (value as text, record).
    """

    style: FanucStyle = FanucStyle()
    points_style: FanucStyle | None = None
    notes: tuple[str, ...] = ()
    axes: Mapping[int, AxisPoints] = field(default_factory=dict)
    parameters: Parameters = field(default_factory=dict)
    values: Mapping[int, int] = field(default_factory=dict)
    common: Mapping[int, tuple[str, Record]] = field(default_factory=dict)

    @property
    def shows_points(self) -> bool:
        """Whether the sample shows the points of the axes: it has a parameter 3621."""
        return any(number == 3621 for number, _ in self.parameters)

    def others(self, number: int) -> list[tuple[AxisPoints, Span]]:
        """Return the blocks of every axis except ``number``."""
        return [(axis, span) for key, axis in self.axes.items() if key != number for span in axis.spans]

    def check_free(self, number: int, name: str, first: int, last: int) -> None:
        """Raise InputError if the points ``first`` to ``last`` of an axis are used by another axis in the sample."""
        for axis, (low, high) in self.others(number):
            if first <= high and last >= low:
                raise axis.record.fail(
                    f"axis A{axis.number} uses the compensation points {low} to {high}; the points {first} to {last} "
                    f"of {name} (A{number}) would overwrite them. Set first_numbers or reserved_numbers so that they "
                    "do not overlap"
                )

    def bits(self, parameter: int, number: int) -> str | None:
        """Return a parameter of the bit type of an axis as eight binary digits, bit 7 first; None if absent."""
        found = self.parameters.get((parameter, number))
        if found is None:
            return None
        if not re.fullmatch("[01]{8}", found[0]):
            raise found[1].fail(f"A{number} has {found[0]}; expected eight binary digits, bit 7 first")
        return found[0]


# Settings shared by the FANUC controls.


@dataclass(frozen=True, kw_only=True)
class FanucSettings:
    """What the numbers of a FANUC control mean, and which of its axes are X, Y and Z."""

    detection_unit_um: float = setting(
        toml_files.positive, 1.0, meaning="detection unit: the step in which the control counts, um"
    )
    stores: str = setting(
        choice("correction", "error"),
        "correction",
        meaning='what the numbers are: "correction" (the control adds them) or "error" (it subtracts them)',
    )
    axis_numbers: tuple[int, int, int] = axis_setting(whole(1, 99), (1, 2, 3), meaning="numbers of the controlled axes")

    @property
    def sign(self) -> int:
        """+1 if the numbers are the correction, -1 if they are the error."""
        return 1 if self.stores == "correction" else -1

    def finish(self, section: toml_files.Section) -> None:
        """Raise InputError if two axes have the same number, or if the section has an unknown key."""
        if len(set(self.axis_numbers)) < 3:
            raise section.fail("axis_numbers", f"{self.axis_numbers} gives two axes the same number")
        section.finish()


@dataclass(frozen=True, kw_only=True)
class PunchedSettings(FanucSettings):
    """Settings of controls whose files follow the style of files punched from the user's control.

    Style keys take precedence over the style of the punched files; ``sample`` combines both. ``path`` is
    the path whose parameters apply if the control has several (word L).
    """

    style_from: tuple[Path, ...] = file_setting(
        several=True,
        meaning="a file punched out by your control, or a list of them (parameters, pitch data): style, points (3620 "
        "to 3624) and magnification are kept, points and entries of other axes are never overwritten; the "
        "style keys take precedence",
    )
    eol: str | None = setting(word_for({"lf": "\n", "crlf": "\r\n"}), None, meaning="line ends of the file")
    digits: int | None = setting(whole(1, 8), None, meaning="digits of the N words, 1 to 8")
    q_word: bool = setting(toml_files.flag, False, meaning="write the type words Q1 (parameters) and Q0 (points)")
    real_point: bool = setting(toml_files.flag, True, meaning="parameter 3624 with a decimal point")
    number_base: int = setting(whole(0, 90000), 10000, meaning="record number of compensation point 0")
    interval_unit_mm: float = setting(
        toml_files.positive, 1.0, meaning="unit of parameter 3624; required with real_point = false"
    )
    path: int = 1
    sample: Sample = field(default_factory=Sample, compare=False)

    @property
    def style(self) -> FanucStyle:
        """How the file is written."""
        return self.sample.style


P = TypeVar("P", bound=PunchedSettings)


def take_punched(kind: type[P], section: toml_files.Section, **given: Any) -> P:
    """Read the settings of a ``kind``, and what its punched files show; see :func:`sample_of` for errors."""
    settings = toml_files.take_settings(kind, section, **given)
    sample = sample_of([punched_file(path) for path in settings.style_from], settings.path)
    shown = {key: getattr(sample.style, key) for key in ("q_word", "real_point", "number_base")}
    settings = toml_files.unless_stated(settings, section, **shown)
    if not settings.real_point and "interval_unit_mm" not in section:
        raise section.fail(
            "interval_unit_mm",
            "is missing; with real_point = false parameter 3624 is a whole number whose unit depends on the control "
            "(1.0 or 0.001 mm are common): look up 3624 of an axis with a known interval and set the unit in mm",
        )
    style = replace(
        sample.style,
        **{key: getattr(settings, key) for key in shown},
        digits=settings.digits or sample.style.digits,
        point_digits=settings.digits or sample.style.point_digits,
        eol=settings.eol or sample.style.eol,
    )
    of_points = sample.points_style
    if of_points is not None:
        same = {key: getattr(style, key) for key in ("q_word", "number_base", "point_digits", "eol")}
        of_points = replace(of_points, **same)
    axes = _axes_of(sample.parameters, settings.interval_unit_mm)
    return replace(settings, sample=replace(sample, style=style, points_style=of_points, axes=axes))


def as_sample(machine: Machine, files: Sequence[Path], names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return ``style_from`` with punched files for each of the controls ``names``; the plan is ignored."""
    texts = [str(path.resolve()) for path in files if path.suffix.lower() != ".json"]
    return {name: {"style_from": texts} for name in names if "style_from" not in machine.controller_settings(name)}


def sample_of(files: Sequence[SourceFile], path: int = 1) -> Sample:
    """Return what punched files show, except the points of the axes, which need the length unit.

    InputError with the line of anything not understood, for a style that changes within a file, and for a machine
    in inches.
    """
    if not files:
        return Sample()
    read = [(file, list(read_records(file))) for file in files]
    with_points = [file for file, records in read if any(map(is_point, records))]
    with_parameters = [file for file, records in read if any(map(_is_pitch_parameter, records))]
    main = (with_parameters or with_points or list(files))[0]
    style, notes = style_of(main)
    sorted_in = PunchedRecords(path)
    for _, records in read:
        for record in records:
            sorted_in.take(record, is_point(record))
    sorted_in.check_metric()
    points_style = None
    if with_points and main not in with_points:
        points_style, point_notes = style_of(with_points[0])
        shown = ("q_word", "point_digits", "number_base", "whole_point", "plus", "zeros")
        style = replace(style, **{key: getattr(points_style, key) for key in shown})
        kept = [note for note in notes if "compensation point" not in note]
        notes = (
            *kept,
            *(n for n in point_notes if "compensation point" in n),
            "parameters and points in separate files",
        )
    straightness = [record for number, (_, record) in sorted_in.common.items() if number in STRAIGHTNESS_PARAMETERS]
    if any("L" in dict(record.words()) for record in straightness):
        style = replace(style, path=path)
        notes = (*notes, f"parameters of a path with a word L; those of path {path} are written")
    base = (points_style or style).number_base
    values: dict[int, int] = {}
    for text, record in sorted_in.points:
        if record.number - base in values:
            raise record.fail("the compensation point is given a second time; give each file once")
        values[record.number - base] = record.whole(text, -MOST_VALUE, MOST_VALUE)
    return Sample(style, points_style, notes, {}, sorted_in.axes, values, sorted_in.common)


class PunchedRecords:
    """Records of punched files by kind: axis parameters, path parameters, compensation points."""

    def __init__(self, path: int) -> None:
        self.path = path
        self.axes: Parameters = {}
        self.common: dict[int, tuple[str, Record]] = {}
        self.points: list[tuple[str, Record]] = []
        self.skipped = 0

    def take(self, record: Record, is_point: bool) -> None:
        """Sort in a record; one unrelated to compensation is counted."""
        if is_point:
            words = type_word(record, record.words())[1]
            self.points += [(words[0][1], record)] if words else []
        elif record.number in AXIS_PARAMETERS:
            kind, words = type_word(record, record.words())
            if kind not in (None, 1):
                raise record.fail(f"the type word Q{kind} is given for a parameter; use Q1")
            for axis, text in axis_values(record, words):
                self._once(self.axes, (record.number, axis), text, record, f"axis A{axis}")
        elif record.number in (UNIT_PARAMETER, TOTAL_PARAMETER, *STRAIGHTNESS_PARAMETERS):
            value = path_value(record, self.path)
            if value is not None:
                self._once(self.common, record.number, value, record, "the parameter")
        else:
            self.skipped += 1

    def _once(self, into: dict[Any, tuple[str, Record]], key: Any, text: str, record: Record, what: str) -> None:
        if key in into:
            before = into[key][1]
            raise record.fail(f"{what} is given a second time (first in {before.file.path}:{before.line})")
        into[key] = text, record

    def unit_remark(self, detection_unit_um: float) -> str:
        """Say which unit the machine is assumed to have."""
        known = UNIT_PARAMETER in self.common
        unit = "metric (1001#0, INM)" if known else "assumed to be metric (1001#0, INM, is not in the file)"
        return (
            f"unit: the machine is {unit}; parameter 3624 is in mm; the detection unit of the machine file is "
            f"{detection_unit_um:g} um"
        )

    def skipped_remark(self, kind: str) -> str:
        """Count the records that were skipped."""
        records = "1 record" if self.skipped == 1 else f"{self.skipped} records"
        return f"skipped: {records} that cannot change a {kind} table"

    def check_metric(self) -> None:
        """Reject a machine whose least command increment is in inch (1001#0, INM)."""
        found = self.common.get(UNIT_PARAMETER)
        if found is not None and found[0][-1:] == "1":
            raise found[1].fail(
                "bit 0 (INM) is 1: an inch machine, whose parameter 3624 and detection unit are in inches. Only metric "
                "machines are supported"
            )


def check_increments(common: Mapping[int, tuple[str, Record]]) -> None:
    """Reject a control whose pitch data are total values (3602#0, APE) where increments are read or written."""
    text, record = common.get(TOTAL_PARAMETER, ("0", None))
    if record is not None and text.endswith("1"):
        raise record.fail(
            'bit 0 (APE) is 1: the pitch data of this control are total values; set value_type = "total" in '
            "[controllers.fanuc-pitch], or set the bit to 0 and punch the files again"
        )


def _axes_of(parameters: Parameters, unit_mm: float) -> dict[int, AxisPoints]:
    """Compensation points of each axis that has any: an interval, or a number other than 0."""
    found = {}
    for axis in sorted({axis for _, axis in parameters}):
        entries = [parameters.get((number, axis)) for number in (3620, 3621, 3622)]
        numbers = tuple(record.whole(text, 0, MOST_NUMBER) for text, record in (entry for entry in entries if entry))
        if len(numbers) < 3:
            missing = [str(3620 + k) for k, entry in enumerate(entries) if entry is None]
            for entry in entries:
                if entry is not None and Decimal(entry[0]):
                    raise entry[1].fail(
                        f"axis A{axis} has a value here, but none for {' and '.join(missing)}: its points are not "
                        "known and could be overwritten. Punch all parameters of the control"
                    )
            continue
        (reference, first, last), record = numbers, entries[1][1]  # type: ignore[index]
        text, at = parameters.get((LENGTH_PARAMETER, axis), ("0", record))
        interval = length_of(at, text, unit_mm) if Decimal(text) else Decimal(0)
        magnification = parameters.get((3623, axis), ("1", record))
        factor = magnification[1].whole(magnification[0], 0, 100)
        if not interval and not factor and not any((reference, first, last)):
            continue
        if last < first:
            raise record.fail(f"axis A{axis} has the points {first} to {last}; the first must not be after the last")
        both = parameters.get((3605, axis), ("0", record))[0].endswith("1")
        start = parameters.get((3626, axis)) if both else None
        negative = None if start is None else start[1].whole(start[0], 0, MOST_NUMBER)
        grid = PointGrid(reference, first, last, interval)
        found[axis] = AxisPoints(axis, grid, factor, negative, record)
    return found


def length_of(record: Record, text: str, unit_mm: float) -> Decimal:
    """Return an interval in mm: a number with a decimal point is in mm, one without is in units of ``unit_mm``."""
    value = Decimal(text) if "." in text else Decimal(text) * Decimal(repr(unit_mm))
    if not 0 < value < 100000:
        raise record.fail(f"the interval {value} mm is not possible; expected the positive length of a section")
    return value


def path_value(record: Record, path: int) -> str | None:
    """Return the value of a parameter of a path: ``P2``, or the one after its word ``L`` (``L1P0L2P3``).

    None if the record has no value for this path.
    """
    kind, words = type_word(record, record.words())
    if kind not in (None, 1):
        raise record.fail(f"the type word Q{kind} is given for a parameter; use Q1")
    if len(words) == 1 and words[0][0] == "P":
        return words[0][1]
    if not words or len(words) % 2 or any(word[0] != "LP"[k % 2] for k, word in enumerate(words)):
        raise record.fail("expected a single value word P, e.g. P2, or pairs of a path word L and P, e.g. L1P2L2P0")
    values = {record.whole(one[1], 1, 99): value[1] for one, value in zip(words[::2], words[1::2], strict=True)}
    if 2 * len(values) != len(words):
        raise record.fail("a path is given twice")
    return values.get(path)


def punched_file(path: Path) -> SourceFile:
    """Read a punched file, keeping its line ends; InputError for non-ASCII bytes outside comments."""
    content = _COMMENT_BYTES.sub(lambda found: _NOT_ASCII.sub(b"?", found[0]), read_bytes(path))
    try:
        return SourceFile(path, content.decode("ascii"))
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise SourceFile(path, "").fail(
            "contains a byte that is not ASCII; a punched file is ASCII text", line
        ) from None


def style_of(file: SourceFile) -> tuple[FanucStyle, tuple[str, ...]]:
    """Return the style of a punched file's text and what was taken from it, in words; errors: :func:`sample_of`."""
    records = list(read_records(file))
    points = [record for record in records if is_point(record)]
    others = [record for record in records if not is_point(record)]
    if not records:
        raise file.fail("contains no record; punch the parameters and the pitch error data of the control", 1)
    style = frame_of(file, records, points)
    style = spacing_of(style, records)
    style = _parameter_style(style, [record for record in others if _is_pitch_parameter(record)])
    texts = []
    for record in points:
        words = type_word(record, record.words())[1]
        if len(words) != 1 or words[0][0] != "P":
            raise record.fail("expected a single value word P for a compensation point, e.g. P-2")
        record.whole(words[0][1], -MOST_VALUE, MOST_VALUE)
        texts.append(words[0][1])
    if points:
        base = min(record.number for record in points) // 10000 * 10000
        style = whole_numbers_of(style, texts)
        style = replace(style, point_digits=width_of(points, style.point_digits), number_base=base)
    return style, _notes(style, points, others)


def is_point(record: Record) -> bool:
    """Whether a record looks like a compensation point: type Q0, or 10000 and above without axis words."""
    kind, words = type_word(record, record.words())
    return kind == 0 or (kind is None and record.number >= 10000 and not any(word[0] in "ASL" for word in words))


def _is_pitch_parameter(record: Record) -> bool:
    return record.number in (*WHOLE_PARAMETERS, LENGTH_PARAMETER)


def frame_of(file: SourceFile, records: Sequence[Record], points: Sequence[Record]) -> FanucStyle:
    """Line ends, order, comments before the first and after the last record."""
    text = file.text
    eol = next((end for end in LINE_ENDS if end in text), "\n")
    pieces = text.split(eol)
    for number, piece in enumerate(pieces, start=1):
        if "\r" in piece or "\n" in piece:
            raise file.fail(
                f"this line does not end with {LINE_ENDS[eol]} like the others; punch the file again", number
            )
    marks = [k for k, piece in enumerate(pieces) if piece.strip().rstrip(";") == "%"]
    lines = sorted({record.line for record in records})
    used = [pieces[line - 1] for line in lines]
    padded = any(piece.endswith(" ") for piece in used) and all(len(piece) % 2 == 0 for piece in used)
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
        even=padded,
    )


def spacing_of(style: FanucStyle, records: Sequence[Record]) -> FanucStyle:
    """White space and type words, which must be the same in all records."""
    first = records[0]
    words = first.words()
    if not words:
        raise first.fail("has no value; every punched record has one")
    space = first.rest[: len(first.rest) - len(first.rest.lstrip())]
    has_q, last = any(letter == "Q" for letter, _ in words), words[-1][0] == "Q" and len(words) > 1
    for record in records:
        here = record.words()
        if any(letter == "Q" for letter, _ in here) != has_q:
            raise record.fail("some records have a type word Q and some do not; the style is not clear")
        if here and (record.rest[: len(record.rest) - len(record.rest.lstrip())] != space):
            raise record.fail("white space before the words changes from record to record; the style is not clear")
    return replace(style, space=space, q_word=has_q, q_last=has_q and last)


def width_of(records: Sequence[Record], usual: int) -> int:
    """Digits of the N words: from zero-padded numbers, else 1; ``usual`` if there are no records."""
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


def whole_numbers_of(style: FanucStyle, texts: Sequence[str]) -> FanucStyle:
    """How whole numbers are written: with a trailing point, a plus sign, zero-padded."""
    padded = [text.lstrip("+-").rstrip(".") for text in texts]
    return replace(
        style,
        whole_point=all(text.endswith(".") for text in texts),
        plus=any(text.startswith("+") for text in texts),
        zeros=max((len(text) for text in padded if len(text) > 1 and text[0] == "0"), default=0),
    )


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


def _notes(style: FanucStyle, points: Sequence[Record], others: Sequence[Record]) -> tuple[str, ...]:
    """State what the sample showed, and what it did not show."""
    type_words = ("Q1 and Q0" + (" after the other words" if style.q_last else "")) if style.q_word else "none"
    found = [
        f"line end {LINE_ENDS[style.eol]}" + (f", {style.block_end} before it" if style.block_end else ""),
        f"type words: {type_words}",
        f"words {'separated by white space' if style.space else 'without white space'}",
        f"digits of N words: {style.digits} (parameters), {style.point_digits} (points)",
    ]
    if points:
        found.append(f"compensation point 0 is record N{style.number_base}; e.g. {style.point(1, -2)}")
    else:
        found.append(f"the sample contains no compensation point: number base {style.number_base} is NOT confirmed")
    if any(record.number == LENGTH_PARAMETER for record in others):
        example = style.length(Decimal(50))
        found.append(
            f"lengths {'with' if style.real_point else 'without'} decimal point, e.g. {style.real_letter}{example}"
        )
    else:
        found.append("the sample contains no parameter 3624: the form of lengths is NOT confirmed")
    order = "points before parameters" if style.points_first else "parameters before points"
    found.append(f"{order}, {style.containers} pairs of %" if style.containers > 1 else f"{order}, 1 pair of %")
    axes = "all axes of a parameter in one record" if style.axes_together else "one record per axis"
    found.append(axes + (", value word before axis word" if style.value_first else ""))
    found += [f"comment {text}" for text in (*style.header, *style.footer)]
    return tuple(found)
