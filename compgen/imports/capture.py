"""Dynamic captures of a laser interferometer (.rtx): displacement over time, no targets.

A header of lines ``key : value``, then ``Data:`` and ``Sample no`` little-endian doubles, then an end mark.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from compgen.core.csvio import FloatArray, format_csv
from compgen.core.files import read_bytes
from compgen.errors import InputError
from compgen.imports.source import HEAD_BYTES, check_size, parse_number, shown

_START, _DATA = b"HEADER::\r\n", b"\nData:\r\n"
#: The end mark is looked for in so many bytes behind the samples.
_TRAILER_BYTES, _SAMPLE_BYTES = 16, 8
MOST_BYTES = 4_000_000_000
#: More samples than this are not written as text.
MOST_ROWS = 2_000_000


@dataclass(frozen=True)
class Capture:
    """n samples of one channel at a fixed rate: ``value`` (n,) in ``unit`` (mm or mrad), every ``step_s``."""

    value: FloatArray
    unit: str
    step_s: float
    keys: Mapping[str, str]

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.value)

    def summary(self) -> dict[str, object]:
        """Say what was captured; the samples are looked at in blocks."""
        low, high, first, last = np.inf, -np.inf, float(self.value[0]), float(self.value[-1])
        for start in range(0, len(self.value), 1_000_000):
            block = self.value[start : start + 1_000_000]
            low, high = min(low, float(block.min())), max(high, float(block.max()))
        return {
            "samples": len(self.value),
            "step_s": self.step_s,
            "duration_s": (len(self.value) - 1) * self.step_s,
            "unit": self.unit,
            "lowest": low,
            "highest": high,
            "first": first,
            "last": last,
        }


def is_capture(head: bytes) -> bool:
    """Tell a binary capture by its first bytes."""
    return head.startswith(_START) and _DATA in head


def read_capture(path: Path) -> Capture:
    """Read a .rtx file without loading it whole; InputError for one that is cut."""
    size = check_size(path, MOST_BYTES)
    head = read_bytes(path, HEAD_BYTES)
    if not is_capture(head):
        raise InputError("is no capture: 'HEADER::' and 'Data:' are due", file=path)
    start = head.index(_DATA) + len(_DATA)
    keys = _keys(head[: start - len(_DATA) + 1].decode("utf-8", errors="replace"))
    count = _whole(path, keys, "sample no")
    if size < start + _SAMPLE_BYTES * count:
        held = max(0, (size - start) // _SAMPLE_BYTES)
        raise InputError(f"declares {count} samples but holds {held}: it was cut", file=path, field="Sample no")
    with path.open("rb") as stream:
        stream.seek(start + _SAMPLE_BYTES * count)
        trailer = stream.read(_TRAILER_BYTES)
    if not 0 <= trailer.find(b"EOF") < _SAMPLE_BYTES:  # further off, a sample that is not counted would stand before it
        raise InputError("has no end mark EOF:: behind its samples: it was cut, or Sample no is wrong", file=path)
    value = np.memmap(path, dtype="<f8", mode="r", offset=start, shape=(count,))
    for first in range(0, count, 1_000_000):
        if not np.isfinite(value[first : first + 1_000_000]).all():
            raise InputError("holds samples that are no finite numbers; is it damaged?", file=path)
    angular = "angular" in keys.get("file type", "").lower()
    return Capture(value, "mrad" if angular else "mm", _step(path, keys), keys)


def _keys(text: str) -> dict[str, str]:
    pairs = (line.partition(":") for line in text.splitlines() if ":" in line and "::" not in line)
    return {key.strip().lower(): value.strip() for key, _, value in pairs}


def _whole(path: Path, keys: Mapping[str, str], key: str) -> int:
    value = parse_number(keys.get(key, ""))
    if value is None or value != int(value) or value < 1:
        raise InputError(f"{shown(keys.get(key, ''))} is no number of samples", file=path, field=key)
    return int(value)


def _step(path: Path, keys: Mapping[str, str]) -> float:
    """Seconds between samples: by the actual rate, the interval, or the rate, whichever stands there."""
    for key, is_rate in (("actual sample rate", True), ("trigger interval", False), ("sample rate", True)):
        value = parse_number(keys.get(key, ""))
        if value is not None and value > 0:
            return 1.0 / value if is_rate else value
    raise InputError("says neither a sample rate nor an interval", file=path, field="Sample rate")


def format_capture(capture: Capture) -> str:
    """Return CSV text with ``time_s`` and ``value_mm`` or ``value_mrad``."""
    if len(capture) > MOST_ROWS:
        raise InputError(f"{len(capture)} samples are too many for a text file; at most {MOST_ROWS} are written")
    time_s = np.arange(len(capture), dtype=np.float64) * capture.step_s
    return format_csv(
        {"time_s": time_s, f"value_{capture.unit}": np.asarray(capture.value)},
        dict(capture.keys),
        {
            "time_s": 9,
            f"value_{capture.unit}": 9,
        },
    )
