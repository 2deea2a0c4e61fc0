"""Blocks of an NC program that are read many at a time by numpy: their words, and the arcs among them."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.programs.dialects import AT_THE_END, MARK, Dialect
from compgen.programs.path import PLANE_AXES, IntArray

#: Letters of the words that blocks in runs may have, in the order of the columns of :class:`Words`; those after P only occur.
LETTERS = b"XYZIJKRPNFSGM"
R_WORD, P_WORD, COLUMNS = 6, 7, 8
#: Distances of start and end of an arc from its centre may differ by this much, mm.
RADIUS_TOLERANCE_MM = 0.02
#: Most full turns of one arc; every turn becomes many moves.
MOST_TURNS = 1000
#: The longest block, characters.
LONGEST_BLOCK = 4096
#: Semicolons that end a block, with the blanks about them; it begins where such characters begin, so that it is tried once.
_ENDS = re.compile(rb"(?<![; \t\r])[; \t\r]++(?=\n|\Z)")
_BLANK, _OTHER, _LETTER, _DIGIT, _POINT, _SIGN = range(6)
_GROUPS = {"motion": 0, "absolute": 1, "incremental": 1, "plane": 2, "nothing": 3}


@dataclass(frozen=True)
class Run:
    """Blocks in a row that were read together: their lines in the batch, and where and how its moves are programmed.

    For each of its moves, of which ``first`` is the number in the batch: ``row`` is the line, ``absolute`` whether it is in
    absolute. ``pole_at`` are the moves before which a block without a move gave a pole (their number if it was after the last).
    """

    lines: range
    first: int
    row: IntArray
    absolute: NDArray[np.bool_]
    scale: float
    centre_absolute: bool
    pole_at: IntArray

    @property
    def count(self) -> int:
        """How many moves."""
        return len(self.row)


def carried(given: IntArray, before: int) -> IntArray:
    """Return modal values (n,): that of each block, or the last one given; ``given`` is -1 where a block gives none."""
    last = np.maximum.accumulate(np.where(given >= 0, np.arange(1, len(given) + 1), 0))
    return np.asarray(np.concatenate([[before], given])[last])


class Words:
    """Words of the blocks of a batch, for those that numpy can read together.

    ``start`` (count + 1,) is where each line begins, ``run_end`` the end of the run of such blocks that a line is part of
    (its own number if it has to be read by itself), ``last`` where its last word ends. ``motion``, ``absolute``, ``plane``
    are what its G codes select, -1 without one; ``code`` are the bytes without comments, ``blanks`` counts the blanks up to each.
    By line and letter, (count, COLUMNS): ``value`` is nan without the word, ``decimals``, and the places ``begin`` and ``end`` of
    the number.
    """

    def __init__(self, content: bytes, dialect: Dialect, keep_unknown: Collection[str]) -> None:
        siemens, letters = dialect.name == "siemens", bytes(LETTERS)
        text = content
        if b"(" in text or b";" in text:
            text = re.sub(dialect.comments.encode(), _blanked, text, flags=re.IGNORECASE)
            if dialect.semicolon_ends:
                text = _ENDS.sub(_blanked, text)
        if dialect.pole:
            text = text.replace(b"*\n", b" \n").replace(b"*\r\n", b" \r\n")
        if siemens:  # one byte that no program contains stands for CR=, the radius of an arc
            text, letters = text.replace(b"CR=", b"  \x01"), letters.replace(b"R", b"\x01")
        table = np.full(256, _OTHER, dtype=np.uint8)
        table[list(b" \t\r\n")], table[list(letters + letters.lower())] = _BLANK, _LETTER
        table[list(b"0123456789")], table[list(b".")], table[list(b"+-")] = _DIGIT, _POINT, _SIGN
        code = np.frombuffer(text, dtype=np.uint8)
        self.code, what = code, table[code]
        self.blanks = np.cumsum(np.frombuffer(content, dtype=np.uint8) == ord(" "), dtype=np.int32)
        feed = code == ord("\n")
        self.start = np.concatenate([[0], np.flatnonzero(feed) + 1])
        if self.start[-1] < len(code):
            self.start = np.append(self.start, len(code))
        count = len(self.start) - 1
        line_of = np.cumsum(feed, dtype=np.int32) - feed
        plain = np.diff(self.start) <= LONGEST_BLOCK

        def spoil(places: IntArray) -> None:
            plain[line_of[places]] = False

        spoil(np.flatnonzero(what == _OTHER))
        edges = np.concatenate([[False], what >= _DIGIT, [False]])
        begin, end = np.flatnonzero(edges[1:] != edges[:-1]).reshape(-1, 2).T
        padded = np.concatenate([[_OTHER], what, [_OTHER]])  # what stands at a place is in the next one
        letter, sign, point = (np.flatnonzero(what == kind) for kind in (_LETTER, _SIGN, _POINT))
        # a number follows its letter without a gap, has one point at most, and a sign only before it
        spoil(begin[padded[begin] != _LETTER])
        spoil(letter[padded[letter + 2] < _DIGIT])
        spoil(sign[padded[sign] != _LETTER])
        own = np.searchsorted(begin, point, side="right") - 1
        points = np.bincount(own, minlength=len(begin))
        spoil(begin[(points > 1) | ~np.isin(end - begin - points - (what[begin] == _SIGN), range(1, 16))])
        decimals = np.zeros(len(begin), dtype=np.int64)
        decimals[own] = end[own] - point - 1
        kept = plain[line_of[begin]]
        begin, end, points, decimals = begin[kept], end[kept], points[kept], decimals[kept]
        shown = (what >= _DIGIT) & plain[line_of]
        value = np.array(list(map(float, np.where(shown, code, ord(" ")).tobytes().split())), dtype=np.float64)
        column_of = np.zeros(256, dtype=np.int64)
        column_of[list(letters)] = np.arange(len(letters))
        line, column = line_of[begin], column_of[code[begin - 1] & 0xDF]
        whole = (points == 0) & (what[begin] != _SIGN)

        def once(cell: IntArray, columns: int) -> None:
            """Spoil blocks with two words of one kind."""
            twice = np.flatnonzero(np.bincount(cell, minlength=count * columns) > 1)
            plain[twice // columns] = False

        if dialect.point_needed:
            spoil(begin[(column <= R_WORD) & (points == 0) & (value != 0.0)])
        ordinary = column < letters.index(b"G")
        once(line[ordinary] * len(letters) + column[ordinary], len(letters))
        groups = np.full((count, 4), -1)
        chosen = np.flatnonzero(column == letters.index(b"G"))
        group, argument = _meanings(dialect, keep_unknown)
        number = np.where(whole[chosen] & (value[chosen] < len(group)), value[chosen], 0.5)
        taken = (number != 0.5) & (group[number.astype(np.int64)] >= 0)
        spoil(begin[chosen[~taken]])
        own, number = line[chosen[taken]], number[taken].astype(np.int64)
        modal = group[number] < 3
        once(own[modal] * 4 + group[number[modal]], 4)
        groups[own, group[number]] = argument[number]
        self.motion, self.absolute, self.plane = groups.T[:3]
        self.value = np.full((count, COLUMNS), np.nan)
        self.decimals, self.begin, self.end = np.zeros((3, count, COLUMNS), dtype=np.int64)
        stored = column < COLUMNS
        cell = line[stored], column[stored]
        self.value[cell], self.decimals[cell] = value[stored], decimals[stored]
        self.begin[cell], self.end[cell] = begin[stored], end[stored]
        self.last = np.zeros(count, dtype=np.int64)
        self.last[line] = end
        chosen = np.flatnonzero(column == letters.index(b"M"))
        if len(chosen):
            moving = ~np.isnan(self.value[line[chosen], :P_WORD]).all(axis=1)
            allowed = [
                whole[k] and _moves_nothing(f"M{value[k]:g}", dialect, keep_unknown, bool(with_move))
                for k, with_move in zip(chosen, moving, strict=True)
            ]
            spoil(begin[chosen[~np.array(allowed)]])
        if dialect.klartext:
            plain[:] = False
        self.run_end = _ends_of_runs(plain)
        self._plain = plain

    @cached_property
    def places_end(self) -> IntArray:
        """As ``run_end``, of blocks in a row with X, Y, Z and R, and nothing else but block numbers, feeds and comments."""
        given = ~np.isnan(self.value)
        others, named = given[:, [3, 4, 5, P_WORD]].any(axis=1), given[:, :3].any(axis=1)
        selecting = np.maximum(np.maximum(self.motion, self.absolute), self.plane) >= 0
        return _ends_of_runs(self._plain & named & ~others & ~selecting)


def _ends_of_runs(inside: NDArray[np.bool_]) -> IntArray:
    stops = np.where(inside, len(inside), np.arange(len(inside)))
    return np.minimum.accumulate(stops[::-1])[::-1]


def _blanked(comment: re.Match[bytes]) -> bytes:
    return comment[0] if MARK.encode() in comment[0] else b" " * len(comment[0])


def _moves_nothing(code: str, dialect: Dialect, keep_unknown: Collection[str], with_move: bool) -> bool:
    """Whether an M code stays where it is and changes nothing that positions depend on."""
    known = dialect.m_codes - dialect.end - {"M6", "M89", "M91", "M97", "M98", "M99"}
    return code in known and code not in keep_unknown and not (with_move and code in AT_THE_END)


def _meanings(dialect: Dialect, keep_unknown: Collection[str]) -> tuple[IntArray, IntArray]:
    """Group of each G code that runs may have (0 motion, 1 absolute or incremental, 2 plane, 3 nothing; else -1), and which."""
    group, argument = np.full(1000, -1), np.zeros(1000, dtype=np.int64)
    for code, meaning in dialect.codes.items():
        what, _, which = meaning.partition(" ")
        if re.fullmatch(r"G\d+", code) and what in _GROUPS and not {code} & {*AT_THE_END, *keep_unknown}:
            number = int(code[1:])
            group[number], argument[number] = _GROUPS[what], int(which or what == "absolute")
    return group, argument


def centres_and_sweeps(
    start_mm: FloatArray,
    end_mm: FloatArray,
    centre_mm: FloatArray,
    radius_mm: FloatArray,
    plane: IntArray,
    ccw: NDArray[np.bool_],
    turns: FloatArray,
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Centres (n, 3), signed angles (n,) in rad of arcs, and which of them cannot be, as :meth:`Reader._arc` finds them.

    ``radius_mm`` is nan where ``centre_mm`` was programmed; ``turns`` are full turns that are added.
    """
    index, (a, b) = np.arange(len(plane)), np.array(PLANE_AXES)[plane].T
    start, end, given = ((points[index, a], points[index, b]) for points in (start_mm, end_mm, centre_mm))
    dx, dy = end[0] - start[0], end[1] - start[1]
    chord, by_radius = np.hypot(dx, dy), ~np.isnan(radius_mm)
    r = np.where(by_radius, radius_mm, 0.0)
    square = r * r - 0.25 * chord * chord
    wrong = by_radius & ((chord == 0.0) | (square < -RADIUS_TOLERANCE_MM * np.abs(r)))
    side = np.sqrt(np.maximum(square, 0.0)) / np.where(chord > 0, chord, 1.0) * np.where((r > 0) == ccw, 1.0, -1.0)
    u = np.where(by_radius, 0.5 * (start[0] + end[0]) - side * dy, given[0])
    v = np.where(by_radius, 0.5 * (start[1] + end[1]) + side * dx, given[1])
    first, second = np.hypot(start[0] - u, start[1] - v), np.hypot(end[0] - u, end[1] - v)
    wrong |= ~(np.abs(first - second) <= RADIUS_TOLERANCE_MM) | (first == 0.0) | ~((turns >= 0) & (turns <= MOST_TURNS))
    wrong |= turns != np.rint(turns)
    turn = np.arctan2(end[1] - v, end[0] - u) - np.arctan2(start[1] - v, start[0] - u)
    turn = np.where(ccw, turn, -turn) % (2.0 * np.pi)
    turn[(~by_radius & (chord < 1e-9)) | (turn == 0.0)] = 2.0 * np.pi
    turn += 2.0 * np.pi * turns
    centre = np.full((len(plane), 3), np.nan)
    centre[index, a], centre[index, b] = u, v
    return centre, np.where(ccw, turn, -turn), wrong
