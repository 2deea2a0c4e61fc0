"""Pictures of a diagnosis as SVG: residuals before and after over everything that they may depend on, and the suspects."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.names import MM_PER_UM
from compgen.diagnose.axis_diagnosis import AxisDiagnosis, AxisFindings
from compgen.diagnose.layout import IntArray
from compgen.diagnose.result import Diagnosis
from compgen.diagnose.search import beside, gains

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BEFORE, AFTER = "#c1440e", "#1f6fb2"
BINS = 24
#: Readings drawn in a panel; more do not show.
MOST_DOTS = 1500
MOST_SUSPECTS = 12
STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "compgen", "font.size": 8, "axes.titlesize": 9}


def pictures_of(found: Diagnosis) -> dict[str, str]:
    """Return the SVG texts by name: ``where``, ``volume``, ``suspects``."""
    import matplotlib  # imported here: slow to load, and only the pages need it

    matplotlib.use("svg")
    with matplotlib.rc_context(STYLE):
        return {"where": _where(found), "volume": _volume(found), "suspects": _suspects(found)}


def axis_pictures(found: AxisDiagnosis) -> dict[str, str]:
    """Return a picture of the runs of every axis by its letter."""
    import matplotlib  # imported here: slow to load, and only the pages need it

    matplotlib.use("svg")
    with matplotlib.rc_context(STYLE):
        return {part.session.letter: _runs(part) for part in found.axes}


def _runs(part: AxisFindings) -> str:
    """Scatter within the cells over time, and all runs over the targets, before and after."""
    from matplotlib import pyplot

    session = part.session
    measured, without = session.deviation_mm / MM_PER_UM, (session.deviation_mm - part.removed_mm) / MM_PER_UM
    kept = ~np.isin(np.arange(len(session)), part.left_out)
    count = np.maximum(np.bincount(session.cell[kept], minlength=int(session.cell.max()) + 1), 1)
    figure, axes = pyplot.subplots(1, 3, figsize=(10, 3.2))
    figure.subplots_adjust(left=0.06, right=0.99, top=0.92, bottom=0.14, wspace=0.25)
    for values, colour, rows in ((measured, BEFORE, np.ones_like(kept)), (without, AFTER, kept)):
        means = np.bincount(session.cell[kept], values[kept], len(count)) / count
        left = values - means[session.cell]
        axes[0].plot(session.time[rows], left[rows], ".-", color=colour, lw=0.5, ms=4)
    axes[0].plot(session.time[~kept], (measured - means[session.cell])[~kept], "o", mfc="none", color=BEFORE, ms=5)
    axes[0].set_xlabel("time in s" if session.timed else "number of the reading in time")
    axes[0].set_ylabel("deviation less its mean, um")
    for panel, title, values, colour, rows in (
        (axes[1], "as measured", measured, BEFORE, np.ones_like(kept)),
        (axes[2], "without", without, AFTER, kept),
    ):
        for run in np.unique(session.leg):
            own = (session.leg == run) & rows
            marker = "^" if own.any() and session.direction[own][0] > 0 else "v"
            panel.plot(session.position_mm[own], values[own], marker + "-", color=colour, lw=0.5, ms=3, alpha=0.8)
        panel.set_title(title)
        panel.set_xlabel(f"{session.letter} in mm")
    axes[2].sharey(axes[1])
    return _text_of(figure)


def _text_of(figure: Any) -> str:
    from matplotlib import pyplot

    stream = StringIO()
    figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    pyplot.close(figure)
    text = stream.getvalue()
    return text[text.index("<svg") :]


def _where(found: Diagnosis) -> str:
    """Residuals before and after against every covariate."""
    from matplotlib import pyplot

    panels = _covariates(found)
    columns = 3
    rows = -(-len(panels) // columns)
    figure, axes = pyplot.subplots(rows, columns, figsize=(10, 2.3 * rows), squeeze=False)
    figure.subplots_adjust(left=0.07, right=0.99, top=1 - 0.1 / rows, bottom=0.22 / rows, hspace=0.45, wspace=0.28)
    for k, (label, values) in enumerate(panels):
        _panel(axes.flat[k], label, values, found)
    for k in range(len(panels), rows * columns):
        axes.flat[k].axis("off")
    return _text_of(figure)


def _covariates(found: Diagnosis) -> list[tuple[str, FloatArray]]:
    """What residuals are drawn against: label and values (n,)."""
    readings, layout = found.analysis.fit.readings, found.analysis.fit.observed.layout
    panels = [(f"{'XYZ'[k]} in mm", readings.position_mm[:, k]) for k in range(3) if np.ptp(readings.position_mm[:, k])]
    if len(readings.stations) > 1:
        panels.append(("station", readings.station.astype(np.float64)))
        panels.append(("range in mm", readings.range_mm))
    panels.append(("time in s" if layout.timed else "order of stops", layout.time[layout.stop]))
    if readings.approach is not None:
        for k in range(3):
            if np.ptp(readings.approach[:, k]):
                panels.append((f"direction of {'XYZ'[k]}", readings.approach[:, k]))
    for name, values in readings.covariates.items():
        if name != "time_s" and np.isfinite(values).all() and np.ptp(values):
            panels.append((name, values))
    return panels


def _panel(axes: Axes, label: str, values: FloatArray, found: Diagnosis) -> None:
    """Mean and scatter of the residuals in bins of a covariate."""
    few = len(np.unique(values)) <= BINS
    edges = np.unique(values) if few else np.quantile(values, np.linspace(0, 1, BINS + 1))
    index = np.searchsorted(edges, values) if few else np.clip(np.searchsorted(edges, values) - 1, 0, BINS - 1)
    centres = edges if few else 0.5 * (edges[1:] + edges[:-1])
    width = np.ptp(centres) / 120 if len(centres) > 1 else 0.01
    for shift, colour, residual in (
        (-width, BEFORE, found.gap.residual_before_mm),
        (width, AFTER, found.gap.residual_after_mm),
    ):
        count = np.maximum(np.bincount(index, minlength=len(centres)), 1)
        mean = np.bincount(index, residual, len(centres)) / count
        square = np.bincount(index, residual**2, len(centres)) / count
        spread = np.sqrt(np.maximum(square - mean**2, 0.0))
        axes.errorbar(
            centres + shift, mean / MM_PER_UM, spread / MM_PER_UM, fmt=".", color=colour, lw=0.7, ms=4, alpha=0.9
        )
    axes.axhline(0.0, color="#888888", lw=0.5)
    axes.set_xlabel(label)
    axes.set_ylabel("residual in um")


def _volume(found: Diagnosis) -> str:
    """Residuals over the volume, seen from three sides: left before, right after."""
    from matplotlib import pyplot

    position = found.analysis.fit.readings.position_mm
    rows = _some(len(position))
    figure, axes = pyplot.subplots(2, 3, figsize=(10, 5.2))
    figure.subplots_adjust(left=0.07, right=0.93, top=0.94, bottom=0.1, hspace=0.4, wspace=0.3)
    largest = float(np.quantile(np.abs(found.gap.residual_before_mm), 0.99)) / MM_PER_UM or 1.0
    shown: Any = None
    for row, (title, residual) in enumerate(
        (("before", found.gap.residual_before_mm), ("after", found.gap.residual_after_mm))
    ):
        for column, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            panel = axes[row, column]
            shown = panel.scatter(
                position[rows, a], position[rows, b], c=residual[rows] / MM_PER_UM, s=6, cmap="coolwarm",
                vmin=-largest, vmax=largest, rasterized=True,
            )  # fmt: skip
            panel.set_xlabel(f"{'XYZ'[a]} in mm")
            panel.set_ylabel(f"{'XYZ'[b]} in mm")
            panel.set_title(title)
    figure.colorbar(shown, ax=axes, label="residual in um", shrink=0.8, pad=0.02)
    return _text_of(figure)


def _some(count: int) -> IntArray:
    if count <= MOST_DOTS:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, MOST_DOTS, replace=False))


def suspects_of(found: Diagnosis) -> list[tuple[str, float, float]]:
    """Name, chi-square on its own and visible share of the strongest suspects."""
    scene = found.analysis.scene
    wanted = [g for g, group in enumerate(scene.groups) if group.tier == "named" and scene.size(g)]
    alone = gains(scene, beside(scene, []), wanted) if wanted else np.zeros(0)
    best: dict[str, tuple[float, float]] = {}
    for g, chi2 in zip(wanted, alone, strict=True):
        name = scene.groups[g].name
        if float(chi2) > best.get(name, (-1.0, 0.0))[0]:
            best[name] = (float(chi2), float(scene.visible[g]))
    ranked = sorted(best.items(), key=lambda item: -item[1][0])[:MOST_SUSPECTS]
    return [(name, chi2, share) for name, (chi2, share) in ranked]


def _suspects(found: Diagnosis) -> str:
    """Ranked suspects: what each would explain by itself; those of the verdict in another colour."""
    from matplotlib import pyplot

    ranked = suspects_of(found)
    chosen = {item.name for item in found.verdict.named}
    figure, axes = pyplot.subplots(figsize=(7, 0.35 * len(ranked) + 1.0))
    figure.subplots_adjust(left=0.28, right=0.97, top=0.97, bottom=0.15)
    names: Sequence[str] = [name for name, _, _ in ranked]
    colours = [AFTER if name in chosen else "#bbbbbb" for name in names]
    axes.barh(range(len(ranked)), [max(chi2, 0.5) for _, chi2, _ in ranked], color=colours)
    axes.set_yticks(range(len(ranked)), names)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("chi-square that it explains by itself")
    return _text_of(figure)
