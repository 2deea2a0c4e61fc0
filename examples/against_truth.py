"""The example is simulated, so the truth is known: move the TRUE exact machine with the tables that were written.

    python examples/against_truth.py demo-out

This uses nothing of what the identification found: the files of each control are parsed from disk, the control is
emulated at 2000 random points, and the exact model moves with the errors of ``zha-gantry.truth.errors.csv``.
"""

import json
import sys
from pathlib import Path

import numpy as np

import compgen
from compgen.tables import residuals

HERE = Path(__file__).parent


def points_mm(machine: compgen.Machine) -> np.ndarray:
    """The random points, shape (2000, 3), mm."""
    return np.random.default_rng(2000).uniform(machine.lower_mm, machine.upper_mm, (2000, 3))


def residual_mm(machine: compgen.Machine, truth: compgen.ErrorTable, folder: Path) -> np.ndarray:
    """Error of the true machine at 2000 random points with the tables of one folder active, shape (2000, 3), mm."""
    manifest = json.loads((folder / "manifest.json").read_text())
    paths = [folder / (manifest["file_prefix"] + item["name"]) for item in manifest["files"]]
    tables = compgen.read_tables(machine, paths, manifest["controller"])
    position_mm = points_mm(machine)
    correction_mm = tables.correction(machine, compgen.Points(position_mm))
    return compgen.exact_error(machine, truth, position_mm + correction_mm) + correction_mm


def main(folder: Path) -> None:
    """Print the residual of every control's files in ``folder``."""
    machine = compgen.load_machine("zha-gantry")
    truth = compgen.read_errors(HERE / "zha-gantry.truth.errors.csv")
    print("against the truth, 2000 random points (reference point fixed):")
    for path in sorted(folder.glob("*/manifest.json")):
        figures = residuals(residual_mm(machine, truth, path.parent))
        print(f"  {path.parent.name:16s} max {figures.max_um:9.2f} um   rms {figures.rms_um:9.2f} um")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo-out"))
