"""The picture of the README, made from the example: python docs/figures.py (writes docs/figures/example.png).

Left: how far the tool stands from where it was told to, before and after, with the tables of each control acting on
the true machine. Right: three identified error curves of the Y axis, and how far they are from the truth.
"""

import sys
import tempfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import matplotlib
import numpy as np

import compgen

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402  (the backend is chosen before)

DOCS = Path(__file__).resolve().parent
EXAMPLES = DOCS.parent / "examples"
CONTROLS = ("isg-csv", "etalon-exchange", "siemens-cec", "siemens-eec", "fanuc-pitch")
CURVES = {"EXY": "#0072b2", "EYY": "#d55e00", "EZY": "#009e73"}
GREY, VOLUMETRIC, POSITIONING = "#8a8a8a", "#0072b2", "#d55e00"
RIGHT_UM = 3e4  # where the numbers stand, right of the axis
STYLE = {
    "font.size": 11,
    "axes.titlesize": 12,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "savefig.facecolor": "white",
}


def against_truth():
    """Return the module ``examples/against_truth.py``, whose figures `make demo` prints and the text quotes."""
    spec = spec_from_file_location("against_truth", EXAMPLES / "against_truth.py")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def distances_um(machine, truth, folder):
    """Distance of the true tool tip from its command at the points of `make demo`: by row of the picture, each (n,), um."""
    demo = against_truth()
    rows = {"before": compgen.exact_error(machine, truth, demo.points_mm(machine))}
    rows |= {name: demo.residual_mm(machine, truth, folder / name) for name in CONTROLS}
    return {name: 1e3 * np.linalg.norm(error, axis=1) for name, error in rows.items()}


def rms_text(distance_um):
    """The root mean square of distances as the picture writes it, um."""
    rms = float(np.sqrt(np.mean(distance_um**2)))
    return f"{rms:.2f}" if rms < 10 else f"{rms:.0f}"


def draw_distances(axes, rows):
    """One line a control: 5 to 95 % as a bar, the largest as a tick, the root mean square as a point and a number."""
    for height, (name, distance) in enumerate(reversed(rows.items())):
        rms = float(np.sqrt(np.mean(distance**2)))
        low, high = np.percentile(distance, [5, 95])
        colour = GREY if name == "before" else VOLUMETRIC if rms < 10 else POSITIONING
        axes.plot([low, high], [height, height], color=colour, linewidth=11, alpha=0.35, solid_capstyle="butt")
        axes.plot([high, distance.max()], [height, height], color=colour, linewidth=1.5)
        axes.plot(distance.max(), height, "|", color=colour, markersize=11, markeredgewidth=2)
        axes.plot(rms, height, "o", color=colour, markersize=6)
        axes.text(RIGHT_UM, height, rms_text(distance), ha="right", va="center", color=colour, fontweight="bold")
    names = list(reversed(rows))
    axes.set(xscale="log", xlim=(0.08, 5000), ylim=(-0.6, len(names) - 0.1), yticks=range(len(names)))
    axes.set_yticklabels(names)
    ticks = [0.1, 1, 10, 100, 1000]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.text(RIGHT_UM, len(names) - 0.4, "rms (µm)", ha="right", va="center", color="#444444")
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    axes.text(0.1, 0.5, "positioning tables only:\nthe squareness of\n2.9 mrad stays", va="center", color=POSITIONING)
    axes.text(2, 3.0, "tables for all 17 errors", ha="left", va="center", color=VOLUMETRIC)
    axes.set_xlabel("tool tip to commanded place (µm): bar 5 ... 95 %, tick max")
    axes.set_title("True machine with the exported tables, 2000 points")


def draw_curves(upper, lower, truth, identified):
    """Identified curves on the true ones, and below their differences within two standard uncertainties."""
    for name, colour in CURVES.items():
        found, true = identified.curves[name], truth.curves[name]
        upper.plot(true.position_mm, 1e3 * true.value, color=colour, linewidth=1.3, label=f"{name} true")
        upper.plot(found.position_mm, 1e3 * found.value, "o", color=colour, markersize=4.5, label="identified")
        difference_um = 1e3 * (found.value - true.at(found.position_mm))
        lower.fill_between(found.position_mm, -2e3 * found.u, 2e3 * found.u, color=colour, alpha=0.16, linewidth=0)
        lower.plot(found.position_mm, difference_um, "o-", color=colour, markersize=4.5, linewidth=1)
    upper.set_ylabel("error (µm)")
    upper.set_ylim(top=22)
    upper.legend(ncols=3, fontsize=9.5, loc="upper center", columnspacing=1.2, handletextpad=0.5, borderaxespad=0.1)
    upper.set_title("Errors of the Y axis: positioning EYY, straightness EXY and EZY")
    lower.set_ylabel("identified\n− true (µm)")
    lower.set_xlabel("Y (mm); shaded: ± 2 standard uncertainties")


def main():
    """Run the example, draw, save."""
    machine = compgen.load_machine("zha-gantry")
    truth = compgen.read_errors(EXAMPLES / "zha-gantry.truth.errors.csv")
    with tempfile.TemporaryDirectory() as folder:
        outcome = compgen.run(machine, [EXAMPLES / "zha-gantry.lengths.csv"], CONTROLS, folder)
        rows = distances_um(machine, truth, Path(folder))
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(12, 4.6), layout="constrained")
        left, right = figure.subfigures(1, 2, width_ratios=[1.0, 1.12], wspace=0.03)
        draw_distances(left.subplots(), rows)
        upper, lower = right.subplots(2, 1, sharex=True, height_ratios=[1.7, 1.0])
        draw_curves(upper, lower, truth, outcome.identification.errors)
        target = DOCS / "figures" / "example.png"
        target.parent.mkdir(exist_ok=True)
        said = "; ".join(
            f"{name} {rms_text(distance)}" for name, distance in rows.items()
        )  # a test compares with the text
        figure.savefig(target, dpi=110, metadata={"Software": None, "Description": f"rms, um: {said}"})
    sys.stdout.write(f"{target.name}: {target.stat().st_size / 1000:.0f} kB\n")


if __name__ == "__main__":
    main()
