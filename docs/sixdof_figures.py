"""The picture of docs/sixdof.md: python docs/sixdof_figures.py (writes docs/figures/sixdof.png).

Figures 9 and 11 of Jia et al. 2022 again: what an angle of the prism does to the spots on the first detector, from the
exact ray tracer (points) and from equations 8 to 10 (lines).
"""

from pathlib import Path

import matplotlib
import numpy as np

from compgen.instruments.sixdof_instrument import SIGNALS, Optics
from compgen.simulation.sixdof import Tracer

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402  (the backend is chosen before)

DOCS = Path(__file__).resolve().parent
ARCSEC = np.pi / 648000
DISTANCE_MM = np.arange(0.0, 801.0, 50.0)
OPTICS = Optics()
#: By panel: axis, parameter, arcsec, signal, slope of the spot per mm and rad (eq. 8-10), label.
LINES = (
    (
        "Prism turned by 3.6 arcsec (figure 9)",
        (
            (1, "eps_zir", 3.6, "y_qd1_mm", 4.0, "Y: 4 eps_zir L"),
            (1, "eps_xir", 3.6, "z_qd1_mm", -2.0, "Y: -2 eps_xir L"),
            (2, "eps_xir", 3.6, "y_qd1_mm", 2.0, "Z: 2 eps_xir L"),
            (2, "eps_yir", 3.6, "z_qd1_mm", -4.0, "Z: -4 eps_yir L"),
        ),
    ),
    (
        "Face of the prism off by 10.8 arcsec (figure 11)",
        (
            (1, "eps_zmrs1", 10.8, "y_qd1_mm", 2.0 * (1.0 - OPTICS.glass_index), "Y: 2 (1 - n) eps_zmrs1 L"),
            (1, "eps_ymrs1", 10.8, "z_qd1_mm", -2.0 * (1.0 - OPTICS.glass_index), "Y: -2 (1 - n) eps_ymrs1 L"),
        ),
    ),
)
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#8a4fb0")


def traced_um(axis, name, arcsec, signal):
    """Change of a spot over the distance, um, from the ray tracer."""
    tracer = Tracer(OPTICS, axis, 1, 1, {name: arcsec * ARCSEC})
    spots = [tracer.signals(d, np.zeros(3), np.zeros(3))[SIGNALS.index(signal)] for d in DISTANCE_MM]
    return 1e3 * (np.array(spots) - spots[0])


def main():
    """Draw both panels."""
    plt.rcParams.update({"font.size": 11, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True})
    plt.rcParams.update({"grid.color": "#e4e4e4", "legend.frameon": False, "savefig.facecolor": "white"})
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for panel, (title, lines) in zip(panels, LINES, strict=True):
        for colour, (axis, name, arcsec, signal, slope, label) in zip(COLOURS, lines, strict=False):
            panel.plot(DISTANCE_MM, 1e3 * slope * arcsec * ARCSEC * DISTANCE_MM, color=colour, linewidth=1.5)
            panel.plot(DISTANCE_MM, traced_um(axis, name, arcsec, signal), "o", color=colour, markersize=4, label=label)
        panel.set(title=title, xlabel="distance L (mm)", ylabel="spot on the first detector (µm)")
        panel.title.set_size(12)
        panel.legend()
    (DOCS / "figures").mkdir(exist_ok=True)
    figure.savefig(DOCS / "figures" / "sixdof.png", dpi=110)


if __name__ == "__main__":
    main()
