"""A mill measured through its parts: plates drilled by one machine and measured by a CMM, ours beside what was printed.

    python benchmarks/public_parts.py FOLDER

FOLDER is a checkout of fitPlugPlateMeas (github.com/csayres or ApachePointObservatory); nothing of it is kept here. Its
program fits offset, rotation and scale, then a radial quadrupole, both by the smallest sum of the fourth powers of the
distances; its printed fits are repeated that way first, to the digits that it prints. Then the plates are identified: the
quadrupole of magnitude q at angle a is the same as EC0Y = -2 q sin 2a and a difference of the scales of X and Y of
2 q cos 2a.
"""

from __future__ import annotations

import re
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import leastsq

import compgen
from compgen.identification import IdentifyOptions, identify_measurement, joint_covariance
from compgen.identification.any_measurement import read_measurement
from compgen.identification.covariance import error_design

Array = NDArray[np.float64]
#: The correction that the workshop adopted for its mill, 1e-6 and degrees, and after the repair of 2012.
ADOPTED = {"before 2012": (32.0, -38.33), "after the repair": (27.39, -31.47)}
MACHINE = """\
name = "plate-mill"
chain = "WFXYZT"
errors = ["EXX", "EYX", "EXY", "EYY", "EC0Y"]
[axes.X]
range_mm = [-330.0, 330.0]
nodes = 7
[axes.Y]
range_mm = [-330.0, 330.0]
nodes = 7
[axes.Z]
range_mm = [-100.0, 100.0]
nodes = 3
"""


def read_plate(path: Path) -> tuple[Array, Array]:
    """Nominal and measured coordinates of a plate's holes, (n, 2), mm."""
    rows = [line.split() for line in path.read_text(errors="replace").splitlines()]
    numbers = [[float(word) for word in row[:4]] for row in rows if len(row) == 9 and re.match(r"-?\d", row[0])]
    table = np.array(numbers)
    return table[:, 2:4], table[:, 0:2]


def fourth_power_fit(start: Array, residual: object) -> Array:
    """Parameters with the smallest sum of squared squared distances, as the observatory's program fits."""
    found, _ = leastsq(lambda values: np.sum(residual(values) ** 2, axis=1), start, maxfev=5000)  # type: ignore[operator]
    return np.asarray(found)


def printed_way(nominal: Array, measured: Array) -> dict[str, float]:
    """Offset, scale, rotation and radial quadrupole in the way of the observatory's program."""

    def placed(values: Array) -> Array:
        turn = np.array([[values[3], values[2]], [-values[2], values[3]]])
        return np.asarray(values[:2] + nominal @ turn)

    pose = fourth_power_fit(np.array([0.0, 0.0, 0.0, 1.0]), lambda values: measured - placed(values))
    fitted = placed(pose)
    angle = np.arctan2(fitted[:, 1], fitted[:, 0])

    def swollen(values: Array) -> Array:
        return np.asarray(fitted * (1.0 + values[0] * 1e-3 * np.cos(2.0 * (angle - values[1])))[:, None])

    magnitude, at = fourth_power_fit(np.array([0.01, 0.0]), lambda values: measured - swollen(values))
    if magnitude < 0:
        magnitude, at = -magnitude, at + np.pi / 2
    at = (at + np.pi / 2) % np.pi - np.pi / 2
    left = measured - fitted
    return {
        "x": pose[0],
        "y": pose[1],
        "scale": float(np.hypot(pose[2], pose[3])),
        "rotation": float(np.degrees(np.arctan2(pose[2], pose[3]))),
        "quadrupole": magnitude * 1e-3,
        "angle": float(np.degrees(at)),
        "rms": float(np.sqrt(np.mean(np.sum(left**2, axis=1)))),
    }


def identified(nominal: Array, measured: Array, machine: compgen.Machine, folder: Path) -> tuple[Array, Array]:
    """The plate's errors by compgen, with a free scale (the temperatures are not known), as their part that is linear.

    Returns
    -------
    tuple
        angle between X and Y (as EC0Y) and scale of X minus that of Y of the field at the holes, 1e-6, and their standard
        uncertainties, each (2,).
    """
    path = folder / "plate.part.csv"
    rows = "".join(f"{x},{y},{mx},{my}\n" for (x, y), (mx, my) in zip(nominal, measured, strict=True))
    path.write_text("# origin_mm = 0, 0, 0\nx_mm,y_mm,mx_mm,my_mm\n" + rows)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify_measurement(machine, read_measurement([path]), IdentifyOptions(part_scale="free"))
    print(f"   residual {found.rms_um:.1f} um rms, {len(found.rejected)} of {2 * len(nominal)} coordinates rejected")
    points = compgen.Points(np.column_stack([nominal, np.zeros(len(nominal))]))
    joint = joint_covariance(found)
    design = error_design(machine, joint, points.position_mm)[:, :2].reshape(2 * len(nominal), -1)
    x, y = nominal.T
    one, zero = np.ones(len(x)), np.zeros(len(x))
    #  shift, turn, scale; then the two of interest: dX = -EC0Y y, and half the difference of the scales
    columns = [[one, zero], [zero, one], [-y, x], [x, y], [-y, zero], [x / 2, -y / 2]]
    linear = np.linalg.pinv(np.array(columns).transpose(2, 1, 0).reshape(-1, 6))[4:]
    field = compgen.volumetric_error(machine, found.errors, points.position_mm)[:, :2].ravel()
    return 1e6 * linear @ field, 1e6 * np.linalg.norm(linear @ design @ joint.errors_factor, axis=1)


def main() -> None:
    """Print the table."""
    root = Path(sys.argv[1])
    for printed in sorted(root.glob("tests/testData/fit_*.txt")):
        text = printed.read_text()
        plate = printed.with_name("D" + "_".join(printed.stem.split("_")[1:3]))
        ours = printed_way(*read_plate(plate))
        shown = " ".join(
            line for line in text.splitlines() if re.match(r"Fit(Offset|Scale|RotAngle)|QP(Magnitude|Angle)", line)
        )
        print(f"{plate.name}: printed  {' '.join(shown.split())}")
        print(
            f"   repeated: offset {ours['x']:.3f} {ours['y']:.3f} mm, scale {ours['scale']:.6f}, rotation "
            f"{ours['rotation']:.3f} deg, quadrupole {ours['quadrupole']:.8f} at {ours['angle']:.2f} deg, "
            f"rms {1e3 * ours['rms']:.1f} um"
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "mill.toml").write_text(MACHINE)
        machine = compgen.load_machine(folder / "mill.toml")
        for path in [*sorted(root.glob("examples/D*")), *sorted(root.glob("tests/testData/D*"))]:
            nominal, measured = read_plate(path)
            print(f"{path.name}: {len(nominal)} holes")
            (value, difference), u = identified(nominal, measured, machine, folder)
            q, angle = 0.5 * np.hypot(value, difference), 0.5 * np.degrees(np.arctan2(-value, difference))
            print(
                f"   EC0Y {value:.1f} +- {2 * u[0]:.1f} urad, scale of X minus Y {difference:.1f} +- {2 * u[1]:.1f} um/m "
                f"(k = 2): quadrupole {q:.1f}e-6 at {angle:.1f} deg"
            )
    for when, (q, angle) in ADOPTED.items():
        a = np.radians(2 * angle)
        print(
            f"adopted {when}: {q}e-6 at {angle} deg = EC0Y {-2 * q * np.sin(a):.1f} urad, X minus Y {2 * q * np.cos(a):.1f} um/m"
        )


if __name__ == "__main__":
    main()
