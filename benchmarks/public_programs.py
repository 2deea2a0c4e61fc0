"""Programs of a workshop before and after its own correction, beside ours (python benchmarks/public_programs.py FOLDER).

FOLDER is a checkout of adjustFanucFiles (github.com/ApachePointObservatory); nothing of it is kept here. Its program
moves every hole along its radius by the quadrupole q cos 2(angle - a) of the mill and leaves the tangential part, which no
rigid machine does: the same error of the guides also moves the hole across the radius, by q sin 2(angle - a). So ours
must equal it along the radius, to the digits that both write, and differ across it by just that.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from timing import print_table

import compgen

Array = NDArray[np.float64]
BEFORE, AFTER = "plFanucUnadjusted-4642.par", "plFanuc-4642Adjusted.par"
#: Codes of the programs that move nothing here: a rotation of the measured angle 0, the end of it, subprograms of the workshop.
KEPT = ("G68", "G69", "G52", "M98")
REACH_MM = 450.0
MACHINE = "".join(
    ['name = "plate-mill"\nchain = "WFYXZT"\n']
    + [f"[axes.{axis}]\nrange_mm = [-{REACH_MM}, {REACH_MM}]\nnodes = 9\n" for axis in "XYZ"]
)


def quadrupole_of(path: Path) -> tuple[float, float]:
    """Magnitude and angle in rad of the quadrupole that the workshop adopted."""
    text = re.sub(r"^\s*#.*$", "", path.read_text(), flags=re.MULTILINE)
    magnitude, degrees = (float(re.search(rf"{key}\s*=\s*(\S+)", text)[1]) for key in ("mag", "angle"))  # type: ignore[index]
    return magnitude, float(np.radians(degrees))


def errors_of(magnitude: float, angle_rad: float) -> compgen.ErrorTable:
    """Errors of a machine whose field in the plane is the quadrupole: dx = a x + b y, dy = b x - a y."""
    ends, zero = np.array([-REACH_MM, REACH_MM]), np.zeros(2)
    along, across = magnitude * np.cos(2 * angle_rad), magnitude * np.sin(2 * angle_rad)
    slopes = {"EXX": along, "EYX": across, "EXY": across, "EYY": -along}
    return compgen.ErrorTable({name: compgen.Curve(ends, slope * ends, zero) for name, slope in slopes.items()})


def holes_of(path: Path) -> Array:
    """Positions of the holes of a program, (n, 2), mm."""
    found = re.findall(r"G60 X([-.\d]+) Y([-.\d]+)", path.read_text(errors="replace"))
    return np.array(found, dtype=np.float64)


def main() -> None:
    """Correct the program, compare the holes with those of the workshop, print the largest differences."""
    examples = Path(sys.argv[1]) / "examples"
    magnitude, angle_rad = quadrupole_of(examples / "adjustFanucFiles.dat")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        (work / "mill.toml").write_text(MACHINE)
        (work / "mill.errors.csv").write_text(compgen.format_errors(errors_of(magnitude, angle_rad)))
        (work / "tools.csv").write_text("tool,length_mm\n" + "".join(f"{number},0\n" for number in range(1, 10)))
        words = [sys.executable, "-m", "compgen", "correct", str(work / "mill.toml"), str(examples / BEFORE)]
        words += ["--errors", str(work / "mill.errors.csv"), "--dialect", "fanuc", "--wcs", "G54=0,0,0"]
        words += ["--tools", str(work / "tools.csv"), "--decimals", "5", "--out", str(work / "out")]
        words += [f"--keep-unknown={code}" for code in KEPT]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        plain, theirs, ours = (holes_of(path) for path in (examples / BEFORE, examples / AFTER, work / "out" / BEFORE))
    moved = (np.abs(theirs - plain).max(axis=1) > 1e-9) & (np.linalg.norm(plain, axis=1) > 1e-6)
    plain, change, difference = plain[moved], (theirs - plain)[moved], (ours - theirs)[moved]
    radius = np.linalg.norm(plain, axis=1)
    outward = plain / radius[:, None]
    across = (difference * np.column_stack([-outward[:, 1], outward[:, 0]])).sum(axis=1)
    left = magnitude * radius * np.sin(2 * (np.arctan2(plain[:, 1], plain[:, 0]) - angle_rad))
    rows = [
        ["largest change, theirs", np.linalg.norm(change, axis=1)],
        ["ours beside it, along the radius", (difference * outward).sum(axis=1)],
        ["ours beside it, across the radius", across],
        ["the same, less what theirs leaves", across - left],
    ]
    print_table(
        [[f"{len(plain)} holes", "um"], *([name, f"{1e3 * np.abs(values).max():.3f}"] for name, values in rows)]
    )


if __name__ == "__main__":
    main()
