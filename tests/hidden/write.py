"""Writes what a user would have: a machine file and a file of lengths. The key is kept apart."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from hidden.kinematics import AXES, HiddenMachine
from hidden.session import Session

CHANNELS = ("x", "y", "z", "ambient", "spindle", "column_front", "column_rear")


def machine_text(machine: HiddenMachine) -> str:
    """TOML of a machine."""
    lines = [f'name = "{machine.name}"', f'chain = "{machine.chain}"', "tool_offset_mm = [0.0, 0.0, 0.0]"]
    lines.append(f"reference_point_mm = {[float(high) for high in machine.range_mm[:, 1]]}")
    lines.append('errors = "observable"')
    for k, letter in enumerate(AXES):
        low, high = machine.range_mm[k]
        lines += [f"[axes.{letter}]", f"range_mm = [{low}, {high}]", f"nodes = {machine.nodes}"]
        lines.append(f"screw_pitch_mm = {machine.pitch_mm[k]}")
    return "\n".join(lines) + "\n"


def length_columns(session: Session, length_mm: np.ndarray, rng: np.random.Generator) -> dict[str, list[str]]:
    """Columns of the file of lengths as text."""
    stop = session.reading_stop
    pose = np.arange(len(session.t)) + 1

    def column(values: np.ndarray, form: str) -> list[str]:
        return [format(v, form) for v in values[stop]]

    found = {
        "station": [session.station_names[k] for k in session.reading_station],
        "point": [f"P{k:05d}" for k in pose[stop]],
    }
    found |= {f"{'xyz'[k]}_mm": column(session.q[:, k], ".4f") for k in range(3)}
    found["length_mm"] = [f"{v:.7f}" for v in length_mm]
    labels = {"run": session.run, "line": session.line, "repeat": session.repeat, "block": session.block}
    labels |= {"setup": session.setup, "pose": pose}
    found |= {name: column(values, "d") for name, values in labels.items()}
    found |= {f"approach_{'xyz'[k]}": column(session.direction[:, k], ".0f") for k in range(3)}
    found |= {f"tool_{'xyz'[k]}_mm": column(session.tool[:, k], ".3f") for k in range(3)}
    found["time_s"] = column(session.t, ".2f")
    found["feed_mm_min"] = column(session.feed, ".0f")
    found["load_kg"] = column(session.load, ".1f")
    for name in CHANNELS:
        logged = session.temp[name] + rng.normal(size=len(session.t)) * session.plan.sensor_noise_k
        found[f"temp_{name}_c"] = column(logged, ".3f")
    return found


def lengths_text(session: Session, length_mm: np.ndarray, rng: np.random.Generator) -> str:
    """CSV of lengths."""
    columns = length_columns(session, length_mm, rng)
    rows = [",".join(columns), *map(",".join, zip(*columns.values(), strict=True))]
    return "\n".join(rows) + "\n"


def write_set(folder: Path, machine: str, lengths: str) -> tuple[Path, Path]:
    """Write both files; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    places = folder / "machine.toml", folder / "session.lengths.csv"
    for place, text in zip(places, (machine, lengths), strict=True):
        place.write_text(text, encoding="utf-8")
    return places


def write_key(path: Path, key: dict) -> None:
    """Write what is true, away from the data."""
    path.write_text(json.dumps(key, indent=1), encoding="utf-8")
