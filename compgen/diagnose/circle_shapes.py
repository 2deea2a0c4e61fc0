"""Shapes of circles that have no name: what a name must explain better than, so that it is not given to a part of them.

    bump, step, kink, slope    at an angle that is searched, alike in both directions or not
    lobes                      n waves a turn, of a kind that no name has
    waves                      across both guides, along a diagonal
    uneven reversal            a reversal that changes along the axis

A bump of 20 degrees has two, three and four lobes, as a wrong scale and bent guides together; only further lobes would tell
them apart, and noise may hide these. So a shape competes with the names for the same readings, at a price for the places at
which it was tried. With one direction only the columns that act alike are there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray
from compgen.data.names import AXES
from compgen.diagnose.layout import IntArray

#: Widths of bumps (standard deviation) and of steps, degrees, and the distance of the angles at which they are tried.
BUMP_DEG, STEP_DEG, EVERY_DEG = (3.0, 6.0, 10.0, 16.0, 25.0, 40.0), (10.0, 20.0, 35.0, 60.0, 90.0, 130.0), 5.0
#: Steps in angle, degrees, and in width, in which the best one is searched once more.
FINER_DEG, FINER = (-2.0, -1.0, 0.0, 1.0, 2.0), (0.75, 0.87, 1.0, 1.15, 1.33)
#: Waves a turn that are lobes of no name, and periods along a diagonal as shares of the radius.
LOBES = range(5, 25)
DIAGONAL = tuple(1.0 / (0.1 * k) for k in range(6, 120))
#: Share of its square that must remain beside the others.
LEAST_VISIBLE = 1e-4
#: Readings of one direction within this angle are one in the search, degrees.
CELL_DEG = 1.0


@dataclass(frozen=True)
class Path:
    """Angle (rad), direction (+1, -1) and radius (mm) of readings in one plane, (m,) each; names of its two axes."""

    t: FloatArray
    way: FloatArray
    radius: FloatArray
    axes: tuple[str, str]

    @property
    def both(self) -> bool:
        """Whether it was measured in both directions."""
        return len(np.unique(self.way)) == 2

    def away(self, angle_deg: float) -> FloatArray:
        """Angle from ``angle_deg``, from -pi to pi, (m,)."""
        return np.asarray((self.t - math.radians(angle_deg) + np.pi) % (2.0 * np.pi) - np.pi)


#: Columns (m, k) over the readings of a path, and what they are in words.
Named = tuple[Callable[[Path], FloatArray], str]


@dataclass(frozen=True)
class Kind:
    """Shapes of one kind: what makes one of its settings (an angle, a width and an angle, ...), and those to try.

    ``finer`` are steps within a setting of the first search, in which the best one is searched again.
    """

    make: Callable[..., Named]
    settings: Sequence[tuple[float, ...]]
    finer: Callable[..., Sequence[tuple[float, ...]]] | None = None


@dataclass(frozen=True)
class Shape:
    """Columns (n, k) over all readings of what has no name; ``trials`` places at which shapes of its kind were tried."""

    plane: str
    columns: FloatArray
    text: str
    trials: int


def best_shapes(circles: Circles, spaces: Sequence[tuple[FloatArray, FloatArray]]) -> list[Shape]:
    """Of each kind in each plane the shape that explains most beside each of the ``spaces``.

    A space is an orthonormal basis (n, r) and the readings without it (n,).
    """
    found: list[Shape] = []
    for k, plane in enumerate(PLANES):
        rows = np.flatnonzero(circles.plane == k)
        if not rows.size:
            continue
        first, second = PLANES[plane]
        way = circles.direction[rows].astype(np.float64)
        path = Path(circles.angle_rad[rows], way, circles.radius_mm[rows], (AXES[first], AXES[second]))
        cells, member = _cells(path)
        count = np.bincount(member).astype(np.float64)
        sums = [(_summed(basis[rows], member), _summed(left[rows, None], member)[:, 0]) for basis, left in spaces]
        for kind in _kinds(path):
            made = [kind.make(*setting) for setting in kind.settings]
            columns = np.stack([make(cells) for make, _ in made], axis=1)
            for own in sums:
                best = kind.settings[int(np.argmax(_gains(columns, count, *own)))]
                if kind.finer is not None:
                    near = kind.finer(*best)
                    close = np.stack([kind.make(*setting)[0](cells) for setting in near], axis=1)
                    best = near[int(np.argmax(_gains(close, count, *own)))]
                make, text = kind.make(*best)
                full = np.zeros((len(circles), columns.shape[2]))
                full[rows] = make(path)
                if text not in [shape.text for shape in found if shape.plane == plane]:
                    found.append(Shape(plane, full, text, len(kind.settings)))
    return found


def _cells(path: Path) -> tuple[Path, IntArray]:
    """A path with one reading for each cell of angle, direction and radius, and the cell of each reading (m,)."""
    keys = np.column_stack([np.floor(np.degrees(path.t) / CELL_DEG), path.way, path.radius])
    _, member = np.unique(keys, axis=0, return_inverse=True)
    member = member.ravel()
    count = np.bincount(member)
    t, way, radius = (np.bincount(member, values) / count for values in (path.t, path.way, path.radius))
    return Path(t, way, radius, path.axes), member


def _summed(values: FloatArray, member: IntArray) -> FloatArray:
    """Sums of values (m, r) over the readings of each cell, (cells, r)."""
    return np.stack([np.bincount(member, column) for column in values.T], axis=1)


def _gains(columns: FloatArray, count: FloatArray, basis: FloatArray, left: FloatArray) -> FloatArray:
    """By how much each of s shapes reduces the sum of squares beside a basis, (s,).

    columns (c, s, k) hold for ``count`` readings each; basis (c, r) and readings ``left`` (c,) are summed over them.
    """
    c, s, k = columns.shape
    flat = columns.reshape(c, s * k)
    shared = (basis.T @ flat).reshape(-1, s, k).transpose(1, 2, 0)
    own = columns.transpose(1, 2, 0)
    whole = (own * count) @ own.transpose(0, 2, 1)
    seen = whole - shared @ shared.transpose(0, 2, 1)
    value, turn = np.linalg.eigh(seen)
    right = np.einsum("sij,si->sj", turn, (left @ flat).reshape(s, k)) ** 2
    size = np.trace(whole, axis1=1, axis2=2)[:, None]
    return np.asarray(np.where(value > LEAST_VISIBLE * size, right / np.maximum(value, 1e-300), 0.0).sum(axis=1))


def _kinds(path: Path) -> Iterator[Kind]:
    """All kinds of shapes. A kink of a whole circle is one at the other side, too."""
    low, high = float(np.degrees(path.t.min())), float(np.degrees(path.t.max()))
    whole = high - low > 360.0 - 3.0 * EVERY_DEG
    angles = (np.arange(0.0, 360.0, EVERY_DEG) if whole else np.arange(low, high, EVERY_DEG)).tolist()
    at = [(a,) for a in angles]
    yield Kind(_bump, [(w, a) for w in BUMP_DEG for a in angles], _finer_bump)
    yield Kind(_step, [(w, a) for w in STEP_DEG for a in angles], _finer_step)
    yield Kind(_kinks if whole else _kink, at[: len(at) // 2] if whole else at, _finer)
    yield Kind(_jump, at, _finer)
    yield Kind(_slope, at, _finer)
    yield Kind(
        partial(_lobes, path.both),
        [(float(n), 0.0) for n in LOBES] + ([(float(n), 1.0) for n in (1, 3, 4, *LOBES)] if path.both else []),
    )
    radius = float(path.radius.max())
    yield Kind(_diagonal, [(sign, share * radius) for sign in (1.0, -1.0) for share in DIAGONAL])
    yield Kind(partial(_uneven_reversal, path.axes), [(0.0,), (1.0,)])


def _finer(a: float) -> list[tuple[float, ...]]:
    return [(a + step,) for step in FINER_DEG]


def _finer_bump(w: float, a: float) -> list[tuple[float, ...]]:
    return [(w * by, a + step) for by in FINER for step in FINER_DEG]


def _finer_step(w: float, a: float) -> list[tuple[float, ...]]:
    return [(w + 2.0 * more, a + step) for more in FINER_DEG for step in FINER_DEG]


def _bump(w: float, a: float) -> Named:
    text = f"a bump at {a % 360:.0f} degrees, about {2.4 * w:.0f} degrees wide"
    return _each(lambda p: np.exp(-0.5 * (p.away(a) / math.radians(w)) ** 2)), text


def _step(w: float, a: float) -> Named:
    text = f"a step at {(a - 0.5 * w) % 360:.0f} degrees, and back at {(a + 0.5 * w) % 360:.0f}"
    return _each(lambda p: (np.abs(p.away(a)) < 0.5 * math.radians(w)).astype(np.float64)), text


def _kink(a: float) -> Named:
    return _each(lambda p: np.abs(p.away(a))), f"a kink at {a % 360:.0f} degrees"


def _kinks(a: float) -> Named:
    text = f"kinks at {a % 180:.0f} and {a % 180 + 180:.0f} degrees"
    return _each(lambda p: np.abs(p.away(a))), text


def _jump(a: float) -> Named:
    return _each(lambda p: p.away(a)), f"a slope along the circle that jumps back at {(a + 180) % 360:.0f} degrees"


def _slope(a: float) -> Named:
    return _each(lambda p: np.maximum(p.away(a), 0.0)), f"a slope that begins at {a % 360:.0f} degrees"


def _each(shape: Callable[[Path], FloatArray]) -> Callable[[Path], FloatArray]:
    """A shape alike in both directions, and once more opposite in them."""

    def columns(path: Path) -> FloatArray:
        plain = np.asarray(shape(path), dtype=np.float64)[:, None]
        return np.hstack([plain, plain * path.way[:, None]]) if path.both else plain

    return columns


def _lobes(both: bool, n: float, opposite: float) -> Named:
    """Waves of a turn that no name has; of 1, 3 and 4 only those that are opposite in both directions."""

    def columns(p: Path) -> FloatArray:
        own = np.column_stack([np.cos(n * p.t), np.sin(n * p.t)])
        return own * p.way[:, None] if opposite else own

    if not both:
        return columns, f"{n:.0f} waves a turn"
    if opposite:
        return columns, f"{n:.0f} waves a turn, opposite in both directions"
    return columns, f"{n:.0f} waves a turn, alike in both directions"


def _diagonal(sign: float, period_mm: float) -> Named:
    """Displacement along a diagonal of the plane that repeats along it."""

    def columns(p: Path) -> FloatArray:
        along = (np.cos(p.t) + sign * np.sin(p.t)) / math.sqrt(2.0)
        turn = 2.0 * np.pi * along * p.radius / period_mm
        return np.column_stack([along * np.sin(turn), along * np.cos(turn)])

    return columns, f"waves along a diagonal, every {period_mm:.3g} mm"


def _uneven_reversal(axes: tuple[str, str], second: float) -> Named:
    """A reversal with a slope and a bow along the axis."""

    def columns(p: Path) -> FloatArray:
        s = np.sin(p.t) if second else np.cos(p.t)
        late = s * p.way * (np.sign(np.cos(p.t)) if second else -np.sign(np.sin(p.t)))
        return np.column_stack([late * s, late * s**2])

    return columns, f"a reversal of {axes[int(second)]} that changes along its way"
