"""Motor positions of firmware that is run, beside what the emulation and the exact machine say.

    python benchmarks/controls_in_the_loop.py --klipper CHECKOUT [--python PYTHON]
    python benchmarks/controls_in_the_loop.py --grblhal PROGRAM

CHECKOUT is a checkout of Klipper whose ``out/klipper.dict`` has been made as its own docs/Debugging.md says, for any
micro-controller; PYTHON has what its scripts/klippy-requirements.txt lists. Its host then runs in batch mode with the exported
``skew.cfg``, and the steps that it would send to the motors are added up. PROGRAM is the ``grblHAL_sim`` of
github.com/grblHAL/Simulator; it runs a program before and after ``volcomp correct``. Nothing of either is kept here.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from timing import print_table

import compgen
from compgen.controls import SourceFile, controller_named
from compgen.data.lengths import Points
from compgen.data.machine import Machine
from compgen.kinematics.exact_chain import exact_error

Array = NDArray[np.float64]
MACHINE = """
name = "router"
chain = "WFYXZT"
reference_point_mm = [0.0, 100.0, 0.0]
[axes.X]
range_mm = [-50.0, 700.0]
nodes = 6
[axes.Y]
range_mm = [0.0, 1200.0]
nodes = 7
[axes.Z]
range_mm = [-180.0, 10.0]
nodes = 4
"""
SQUARENESS_RAD = {"EC0Y": (2.9e-3, 0.0), "EB0Z": (-0.5e-3, 0.0), "EA0Z": (0.3e-3, 0.0)}
POSITIONS, SEED = 24, 11
UM = 1e3
#: The motors stand still for longer than the gap between any two of their steps.
DWELL_S, GAP_S = 0.5, 0.3
#: One step of the motors, mm. grblHAL counts steps in single precision and 32 bits.
KLIPPER_STEP_MM, GRBL_STEP_MM = 5e-4, 1e-3
GRBL_PROGRAM = "G21 G90 G17 G54\nG0 X0 Y0 Z0\n"


def machine_and_errors(folder: Path) -> tuple[Machine, compgen.ErrorTable, Array]:
    """Return a machine, its squarenesses and positioning errors, and positions (n, 3) all over its travel, mm."""
    path = folder / "router.toml"
    path.write_text(MACHINE)
    machine = compgen.load_machine(path)
    curves = {}
    for k, letter in enumerate("XYZ"):
        nodes = machine.axes[k].nodes_mm
        reach = (nodes - machine.reference_point_mm[k]) / 1000.0
        curves[f"E{letter}{letter}"] = compgen.Curve(nodes, 0.08 * reach, np.zeros(len(nodes)))
    positions = np.random.default_rng(SEED).uniform(machine.lower_mm, machine.upper_mm, (POSITIONS, 3)).round(3)
    return machine, compgen.ErrorTable(curves, SQUARENESS_RAD), positions


def rests_of(times_s: Array, positions: Array) -> Array:
    """Return the positions at which the motors stand still, from their positions after each step, the last one included."""
    return positions[np.append(np.diff(times_s) > GAP_S, True)]


def difference_rows(name: str, found: Array, expected: Array, step_mm: float) -> list[list[str]]:
    """Return a row of the printed table: number of positions, largest difference by axis, um; the step says what is possible."""
    largest = np.abs(found - expected).max(axis=0) * UM
    return [[name, str(len(found)), *(f"{value:.3f}" for value in largest), f"{step_mm * UM:.2f}"]]


# --- Klipper -----------------------------------------------------------------------------------------------------------

STEPPER = """[stepper_{axis}]
step_pin: {pins[0]}
dir_pin: {pins[1]}
enable_pin: {pins[2]}
endstop_pin: {pins[3]}
microsteps: 1
rotation_distance: {turn}
full_steps_per_rotation: 200
position_min: -2000
position_max: 2000
position_endstop: -2000
"""
PRINTER = """[mcu]
serial: /dev/null
[printer]
kinematics: cartesian
max_velocity: 200
max_accel: 2000
max_z_velocity: 200
max_z_accel: 2000
[force_move]
enable_force_move: True
[skew_correction]
[include skew.cfg]
"""


def klipper_positions(checkout: Path, python: str, folder: Path, skew: str, positions: Array) -> Array:
    """Return where Klipper's host sends the motors for commands (n, 3), mm: its own steps, added up."""
    dictionary = checkout / "out" / "klipper.dict"
    if not dictionary.is_file():
        raise SystemExit(f"{dictionary} is missing: make it as docs/Debugging.md of that checkout says")
    pins = [f"gpio{k}" for k in range(12)]
    steppers = [
        STEPPER.format(axis=axis, pins=pins[4 * k : 4 * k + 4], turn=200 * KLIPPER_STEP_MM)
        for k, axis in enumerate("xyz")
    ]
    (folder / "printer.cfg").write_text(PRINTER + "".join(steppers))
    (folder / "skew.cfg").write_text(skew)
    lines = ["SET_KINEMATIC_POSITION X=0 Y=0 Z=0", "SKEW_PROFILE LOAD=volcomp", "G90"]
    for x, y, z in positions.tolist():
        lines += [f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f} F9000", f"G4 P{DWELL_S * 1000:.0f}"]
    (folder / "moves.gcode").write_text("\n".join([*lines, "M400", ""]))
    host = [python, str(checkout / "klippy" / "klippy.py"), "printer.cfg", "-i", "moves.gcode", "-o", "moves.serial"]
    subprocess.run([*host, "-d", str(dictionary), "-l", "klippy.log"], cwd=folder, check=True, timeout=600)
    reader = [python, str(checkout / "klippy" / "parsedump.py"), str(dictionary), "moves.serial"]
    text = subprocess.run(reader, cwd=folder, check=True, capture_output=True, text=True, timeout=600).stdout
    return rests_of(*klipper_steps(text))


def klipper_steps(text: str) -> tuple[Array, Array]:
    """Return the time in s and the positions (n, 3) in mm at the end of each run of steps, from a dump of the commands."""
    frequency = 50e6  # of the micro-controller, Hz; replaced by the one that the dump states
    axes: dict[str, int] = {}
    clocks, way = [0, 0, 0], [1, 1, 1]
    changes: list[tuple[int, int, int]] = []  # clock, axis, steps
    for line in text.splitlines():
        words = dict(re.findall(r"(\w+)=(\S+)", line))
        if line.startswith("config_stepper"):
            axes[words["oid"]] = len(axes)
        elif line.startswith("set_next_step_dir"):
            way[axes[words["oid"]]] = 1 if words["dir"] == "1" else -1
        elif line.startswith("reset_step_clock"):
            clocks[axes[words["oid"]]] = int(words["clock"])
        elif line.startswith("queue_step"):
            axis = axes[words["oid"]]
            interval, count, add = (int(words[key]) for key in ("interval", "count", "add"))
            # the first step of a run follows the clock before by its interval; then the interval grows by add
            changes.append((clocks[axis] + interval, axis, way[axis]))
            clocks[axis] += interval * count + add * count * (count - 1) // 2
            if count > 1:
                changes.append((clocks[axis], axis, way[axis] * (count - 1)))
    changes.sort()
    steps = np.zeros((len(changes), 3))
    for k, (_, axis, count) in enumerate(changes):
        steps[k, axis] = count
    return np.array([clock for clock, _, _ in changes]) / frequency, KLIPPER_STEP_MM * np.cumsum(steps, axis=0)


def with_klipper(checkout: Path, python: str, folder: Path) -> list[list[str]]:
    """Run Klipper's host with the exported factors; compare with the emulation, and with no correction at all."""
    machine, errors, positions = machine_and_errors(folder)
    made = compgen.export(machine, compgen.ErrorTable({}, errors.squareness), "klipper")
    control = controller_named("klipper")(machine)
    tables = control.parse([SourceFile(Path(name), text) for name, text in made.files.items()])
    expected = positions + control.emulate(tables, Points(positions))
    found = klipper_positions(checkout, python, folder, made.files["skew.cfg"], positions)
    if len(found) != len(positions):
        raise SystemExit(f"the motors stood still {len(found)} times for {len(positions)} commands")
    version = subprocess.run(
        ["git", "describe", "--always", "--tags"], cwd=checkout, capture_output=True, text=True, check=False
    ).stdout.strip()
    return [
        *difference_rows(f"Klipper {version}: motors - emulation", found, expected, KLIPPER_STEP_MM),
        *difference_rows("Klipper: motors - commands", found, positions, KLIPPER_STEP_MM),
    ]


# --- grblHAL -----------------------------------------------------------------------------------------------------------


def grbl_program(positions: Array) -> str:
    """Return lines between the positions and, at each, a half circle in the plane XY, with rests in between."""
    lines = []
    for x, y, z in positions.tolist():
        lines += [f"G1 X{x:.3f} Y{y:.3f} Z{z:.3f} F6000", f"G4 P{DWELL_S}"]
        lines += [f"G2 X{x + 20:.3f} Y{y:.3f} I10 J0", f"G4 P{DWELL_S}"]
    return GRBL_PROGRAM + "\n".join([*lines, "M2", ""])


def grbl_positions(program: Path, folder: Path, text: str) -> Array:
    """Return where grblHAL leaves the motors at each rest of a program, mm."""
    for old in ("EEPROM.DAT", "steps.out"):
        (folder / old).unlink(missing_ok=True)
    rates = [
        f"${number + k}={value:g}"
        for number, value in ((100, 1 / GRBL_STEP_MM), (110, 10000), (120, 500))
        for k in range(3)
    ]
    command = [
        str(program.resolve()),
        "-t",
        "0",
        "-n",
        "-r",
        "0.05",
        "-s",
        "steps.out",
        "-b",
        "blocks.out",
        "-g",
        "answers.out",
    ]
    with subprocess.Popen(command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as running:
        assert running.stdin is not None
        lines = ["$X", *rates, *text.splitlines()]
        running.stdin.write(("\n".join(lines) + "\n").encode())
        running.stdin.flush()
        size, until = -1, time.monotonic() + 300.0
        while (
            now := (folder / "answers.out").stat().st_size if (folder / "answers.out").exists() else 0
        ) != size or now == 0:
            size = now
            time.sleep(3.0)
            if time.monotonic() > until:
                break
        running.stdin.write(b"\x06")  # the simulator ends
        running.stdin.close()
        running.wait(30.0)
    answers = (folder / "answers.out").read_text(errors="replace")
    if "error:" in answers.partition("ok")[2] or "ALARM" in answers:
        raise SystemExit(f"grblHAL refused a block: {answers[-300:]}")
    rows = re.findall(
        r"^\s+([0-9.]+) (-?[0-9]+), (-?[0-9]+), (-?[0-9]+),", (folder / "steps.out").read_text(), re.MULTILINE
    )
    values = np.array(rows, dtype=np.float64)
    values = values[np.argmax(np.any(values[:, 1:] != 0.0, axis=1)) :]  # before them the motors wait at the start
    # a row after a rest still has the position of the rest, and the program ends with one
    return GRBL_STEP_MM * values[1:, 1:][np.diff(values[:, 0]) > GAP_S]


def with_grblhal(program: Path, folder: Path) -> list[list[str]]:
    """Run a program before and after its correction; the error of the tool at each rest, by the exact machine."""
    machine, errors, positions = machine_and_errors(folder)
    positions = positions[:20] * [0.9, 0.9, 0.9]
    text = grbl_program(positions)
    (folder / "part.nc").write_text(text)
    (folder / "router.errors.csv").write_text(compgen.format_errors(errors))
    command = [
        sys.executable,
        "-m",
        "compgen",
        "correct",
        "router.toml",
        "part.nc",
        "--errors",
        "router.errors.csv",
    ]
    options = ["--dialect", "grbl", "--wcs", "G54=0,0,0", "--out", "corrected"]
    subprocess.run([*command, *options], cwd=folder, check=True, capture_output=True, timeout=300)
    corrected = (folder / "corrected" / "part.nc").read_text()
    targets = np.repeat(positions, 2, axis=0)
    targets[1::2, 0] += 20.0
    rows = []
    for name, lines in (("as programmed", text), ("corrected", corrected)):
        motors = grbl_positions(program, folder, lines)
        if len(motors) != len(targets):
            raise SystemExit(f"the motors stood still {len(motors)} times for {len(targets)} commands")
        tool = motors + exact_error(machine, errors, motors)
        rows += difference_rows(f"grblHAL, {name}: tool - programmed", tool, targets, GRBL_STEP_MM)
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what is there, and print the largest differences by axis."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--klipper", type=Path, help="checkout of Klipper with out/klipper.dict")
    parser.add_argument("--python", default=sys.executable, help="Python with the requirements of Klipper's host")
    parser.add_argument("--grblhal", type=Path, help="the program grblHAL_sim")
    given = parser.parse_args(arguments)
    rows: list[list[str]] = []
    for run, path in ((lambda work: with_klipper(given.klipper.resolve(), given.python, work), given.klipper),
                      (lambda work: with_grblhal(given.grblhal, work), given.grblhal)):  # fmt: skip
        if path is not None:
            with tempfile.TemporaryDirectory() as name:
                rows += run(Path(name))
    if not rows:
        parser.error("nothing to run: give --klipper or --grblhal")
    print_table([["", "positions", "X um", "Y um", "Z um", "step um"], *rows])


if __name__ == "__main__":
    main()
