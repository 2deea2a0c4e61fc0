"""Blocks of an NC program that are read many at a time by numpy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.data.csv_files import FloatArray
from compgen.programs.dialects import Dialect
from compgen.programs.path import IntArray


@dataclass(frozen=True)
class PlainRun:
    """Plain blocks in a row: their lines in the batch, and for each move its line, values, decimals and columns of values.

    ``value`` (n, 3) is nan where a block does not name the axis; ``span`` (n, 3, 2) are columns in the line.
    """

    lines: range
    first: int
    row: IntArray
    value: FloatArray
    decimals: IntArray
    span: IntArray
    scale: float


class PlainWords:
    """Words of the blocks of a batch that have nothing but N, G0, G1, X, Y, Z, F and S, found by numpy.

    ``run_end`` (n,) is the end of the run of plain blocks that each line is part of (its own number if it is not plain);
    ``g`` (n,) is 0, 1, or -1 without a G code; ``value``, ``decimals`` (n, 3) and ``span`` (n, 3, 2) belong to X, Y, Z.
    """

    _OTHER, _DIGIT, _POINT, _SIGN, _LETTER, _BLANK = range(6)

    def __init__(self, content: bytes, count: int, dialect: Dialect) -> None:
        table = np.zeros(256, dtype=np.uint8)
        table[list(b"0123456789")], table[list(b".")], table[list(b"+-")] = self._DIGIT, self._POINT, self._SIGN
        table[list(b"NGXYZFSngxyzfs")] = self._LETTER
        table[list(b" \t\r\n" + (b"*" if dialect.pole else b""))] = self._BLANK
        code = np.frombuffer(content, dtype=np.uint8)
        what = table[code]
        starts = np.concatenate([[0], np.flatnonzero(code == ord("\n")) + 1])[:count]
        plain = np.ones(count, dtype=bool)

        def spoil(positions: IntArray) -> None:
            plain[np.searchsorted(starts, positions, side="right") - 1] = False

        spoil(np.flatnonzero(what == self._OTHER))
        letter = np.flatnonzero(what == self._LETTER)
        token = np.cumsum(what == self._LETTER) - 1
        tokens = len(letter)
        digit, point, sign = (np.flatnonzero(what == kind) for kind in (self._DIGIT, self._POINT, self._SIGN))
        for positions in (digit, point, sign):
            spoil(positions[token[positions] < 0])
        digit, point, sign = (p[token[p] >= 0] for p in (digit, point, sign))
        digits, points, signs = (np.bincount(token[p], minlength=tokens) for p in (digit, point, sign))
        length = digits + points + signs
        for positions in (digit, point, sign):  # a number follows its letter without a gap, in the same line
            own = token[positions]
            far = positions - letter[own] > (1 if positions is sign else length[own])
            spoil(positions[far])
            spoil(letter[own[far]])
        spoil(letter[(digits == 0) | (digits > 15) | (points > 1) | (signs > 1)])
        own = token[digit]
        first = np.cumsum(digits) - digits
        rank = digits[own] - 1 - (np.arange(len(digit)) - first[own])
        weight = 10.0 ** np.arange(16)
        whole = np.bincount(own, (code[digit] - 48.0) * weight[np.clip(rank, 0, 15)], minlength=tokens)
        dot = np.full(tokens, len(code) + 1)
        dot[token[point]] = point
        decimals = np.bincount(own, digit > dot[own], minlength=tokens).astype(np.int64)
        value = whole / weight[np.clip(decimals, 0, 15)]
        value[token[sign][code[sign] == ord("-")]] *= -1.0
        address, line = code[letter] & 0xDF, np.searchsorted(starts, letter, side="right") - 1
        self.g = np.full(count, -1)
        is_g = np.flatnonzero(address == ord("G"))
        spoil(letter[is_g[(points[is_g] + signs[is_g] > 0) | (whole[is_g] > 1)]])
        self.g[line[is_g]] = whole[is_g]
        plain[np.bincount(line[is_g], minlength=count) > 1] = False
        self.value = np.full((count, 3), np.nan)
        self.decimals = np.zeros((count, 3), dtype=np.int64)
        self.span = np.zeros((count, 3, 2), dtype=np.int64)
        for axis, name in enumerate(b"XYZ"):
            at = np.flatnonzero(address == name)
            rows = line[at]
            if dialect.point_needed:
                spoil(letter[at[(points[at] == 0) & (whole[at] != 0)]])
            plain[np.bincount(rows, minlength=count) > 1] = False
            self.value[rows, axis], self.decimals[rows, axis] = value[at], decimals[at]
            self.span[rows, axis] = (
                np.stack([letter[at] + 1, letter[at] + 1 + length[at]], axis=1) - starts[rows][:, None]
            )
        # the end of each run of plain lines, found backwards
        stops = np.where(plain, count, np.arange(count))
        self.run_end = np.minimum.accumulate(stops[::-1])[::-1]
