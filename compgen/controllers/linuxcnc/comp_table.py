"""LinuxCNC's COMP_FILE: strict reading, and the control's rule in its own arithmetic (float32 trims and slopes).

The rule was read from running LinuxCNC 2.9: trims and their slopes are stored as float32, positions as double; the table
holds its end values outside; a position p with ``nominal[i] <= p < nominal[i+1]`` is corrected by
``trim[i] + slope[i] * (p - nominal[i])``, forward while the joint moves up, reverse while it moves down. The correction is
ADDED to the motor command.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compgen.controllers.base import SourceFile
from compgen.controllers.linuxcnc.text import SHOWN, check_size, lines_of, number_in
from compgen.core.csvio import FloatArray

#: Rows that LinuxCNC keeps, and characters of a line that it reads.
MOST_ROWS, LONGEST_LINE = 256, 254
_MOST_CHARACTERS = 1_000_000
#: A step of the correction at standstill acts at once below the first share of a T^2, is ramped above the second, and
#: never acts in between (a: joint acceleration, T: servo period).
AT_ONCE, RAMPED = 0.25, 0.5
#: Columns whose values grow by more than this share of the nominal position are positions and no trims.
_LIKE_POSITIONS = 0.9
_COLUMNS = ("the nominal position", "the forward value", "the reverse value")


@dataclass(frozen=True)
class CompTable:
    """One COMP_FILE with the numbers of its text, in machine units of ``mm_per_unit``, in which the control rounds too.

    ``nominal`` (n,) is strictly increasing; ``forward`` and ``reverse`` (n,) are trims, which are added.
    """

    nominal: FloatArray
    forward: FloatArray
    reverse: FloatArray
    mm_per_unit: float = 1.0

    @property
    def nominal_mm(self) -> FloatArray:
        """Positions of the rows, mm."""
        return self.nominal * self.mm_per_unit

    @property
    def forward_mm(self) -> FloatArray:
        """Trims while the joint moves up, mm."""
        return self.forward * self.mm_per_unit

    @property
    def reverse_mm(self) -> FloatArray:
        """Trims while the joint moves down, mm."""
        return self.reverse * self.mm_per_unit

    def at(self, position_mm: FloatArray, direction: int) -> FloatArray:
        """Return the correction at joint positions (m,) in the direction +1 or -1, bit for bit as the control."""
        trims = (self.forward if direction > 0 else self.reverse).astype(np.float32)
        slopes = _slopes(self.nominal, trims)
        position = np.asarray(position_mm, dtype=np.float64) / self.mm_per_unit
        row = np.searchsorted(self.nominal, position, side="right") - 1
        inside = np.clip(row, 0, len(trims) - 1)
        found = trims[inside].astype(np.float64) + slopes[inside].astype(np.float64) * (position - self.nominal[inside])
        return np.where(row < 0, np.float64(trims[0]), found) * self.mm_per_unit

    @property
    def step_mm(self) -> FloatArray:
        """Size of the step between forward and reverse at each row, shape (n,), mm."""
        return np.abs(self.forward_mm - self.reverse_mm)


def _slopes(nominal: FloatArray, trims: NDArray[np.float32]) -> NDArray[np.float32]:
    """Slopes behind each row, float32 of the float32 differences; zero behind the last."""
    differences = (trims[1:] - trims[:-1]).astype(np.float64)
    return np.append((differences / np.diff(nominal)).astype(np.float32), np.float32(0.0))


def standstill_outcome(step_mm: float, acceleration_mm_s2: float, period_s: float) -> str:
    """Say what a step of the correction does from standstill: ``"at once"``, ``"never"`` or ``"ramped"``.

    LinuxCNC ramps the correction with half of the joint's acceleration. A step of at most 0.25 a T^2 is applied at once,
    above 0.5 a T^2 it is ramped; in between the filter keeps its velocity of zero (found by running LinuxCNC 2.9).

    >>> [standstill_outcome(step, 5000.0, 1e-3) for step in (0.001, 0.002, 0.003)]
    ['at once', 'never', 'ramped']
    """
    unit_mm = acceleration_mm_s2 * period_s**2
    if abs(step_mm) <= AT_ONCE * unit_mm:
        return "at once"
    return "never" if abs(step_mm) <= RAMPED * unit_mm else "ramped"


def parse_comp(source: SourceFile, file_type: int, mm_per_unit: float = 1.0) -> CompTable:
    """Read a COMP_FILE strictly.

    Parameters
    ----------
    source : the text; CRLF, exponents and further columns are what the control takes too.
    file_type : 0: nominal, actual forward, actual reverse (the trim is nominal minus actual); 1: the trims themselves.
    mm_per_unit : unit of the machine, in which the file is written; the file itself does not say it.

    Raises
    ------
    InputError
        with the line, for what makes the control stop reading without a word (a comment, a blank line, text, a decimal
        comma), for rows that it drops (more than 256, or not increasing), and for a file that was cut.
    """
    check_size(source, _MOST_CHARACTERS)
    rows: list[tuple[float, ...]] = []
    blank = 0
    for line, text, ended in lines_of(source):
        if not text.strip(" \t"):
            blank = blank or line
            continue
        if blank:
            raise source.fail("is blank, and LinuxCNC stops reading there without a word; take the line out", blank)
        rows.append(_row(source, line, text, rows))
        if not ended:
            raise source.fail("the last line has no line end; was the file cut?", line)
    if not rows:
        raise source.fail("holds no row; is it the right file, or was it cut?", 1)
    nominal, forward, reverse = np.array(rows).T
    _check_type(source, file_type, nominal, forward)
    if file_type == 0:
        return CompTable(nominal, nominal - forward, nominal - reverse, mm_per_unit)
    return CompTable(nominal, forward, reverse, mm_per_unit)


def _check_type(source: SourceFile, file_type: int, nominal: FloatArray, forward: FloatArray) -> None:
    """Refuse positions that would be read as trims, and trims that would be read as positions: mistakes of many mm."""
    span = float(np.ptp(nominal))
    slope = float(np.ptp(forward)) / span if span > 0.0 and len(nominal) > 2 else 0.5
    if file_type == 1 and slope > _LIKE_POSITIONS:
        message = "these are nominal and actual positions (file type 0), and comp_file_type is 1: the trims would be"
    elif file_type == 0 and slope < 1.0 - _LIKE_POSITIONS:
        message = "these are trims (file type 1), and comp_file_type is 0: the trims would be"
    else:
        return
    largest = float(np.max(np.abs(forward if file_type == 1 else nominal - forward)))
    raise source.fail(f"{message} up to {largest:g} machine units; set comp_file_type in the machine file", 1)


def _row(source: SourceFile, line: int, text: str, above: list[tuple[float, ...]]) -> tuple[float, ...]:
    if len(text) > LONGEST_LINE:
        raise source.fail(f"has {len(text)} characters; LinuxCNC reads {LONGEST_LINE} of a line", line)
    words = text.split()
    if words[0][0] in "#;(%":
        raise source.fail("is a comment; LinuxCNC stops reading there without a word, take the line out", line)
    if len(words) < 3:
        message = f"has {len(words)} columns; nominal, forward and reverse are due, got {text.strip()[:SHOWN]!r}"
        raise source.fail(message, line)
    row = tuple(number_in(source, line, word, what) for word, what in zip(words, _COLUMNS, strict=False))
    if above and row[0] <= above[-1][0]:
        message = f"{row[0]:g} does not lie above {above[-1][0]:g} of the row before; LinuxCNC drops such a row"
        raise source.fail(message, line)
    if len(above) == MOST_ROWS:
        raise source.fail(f"is row {MOST_ROWS + 1}; LinuxCNC takes {MOST_ROWS} rows and drops the rest", line)
    return row
