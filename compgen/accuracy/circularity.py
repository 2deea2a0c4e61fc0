"""Circular tests by ISO 230-4: circular deviation, hysteresis and radial deviation, with their uncertainty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from compgen.accuracy.evaluate import Accuracy
from compgen.accuracy.field import Figure, range_weight
from compgen.data.circles import PLANES, Circles
from compgen.data.csv_files import FloatArray

#: Angles at which runs and directions are compared: four per degree.
COMPARED = 1440


def accuracy_of_circles(circles: Circles) -> Accuracy:
    """Return G of each direction, G(b) of both, the hysteresis H, and the radial deviations F, by plane and set-up.

    The centre is the least-squares centre. Several runs of a direction are averaged. The uncertainty comes from the
    scatter between runs, or from the uncertainty of the readings stated in the file; nan without either. F needs a
    calibrated radius, stated by the comment ``# radius = calibrated`` of a file.
    """
    groups: dict[str, dict[str, Figure]] = {}
    statements = [
        "ISO 230-4, about the centre of least squares; G: largest minus smallest radius of one direction, G(b) of both "
        "directions together, H: largest radial difference between the directions"
    ]
    calibrated = circles.metadata.get("radius") == "calibrated"
    if not calibrated:
        statements.append("F: not given; it needs a calibrated radius (comment # radius = calibrated)")
    for name, own in circle_groups(circles).items():
        groups[name] = _figures(circles, own, calibrated=calibrated)
    return Accuracy(groups, (*statements, "checked against worked examples, not certified"))


def circle_groups(circles: Circles) -> dict[str, NDArray[np.bool_]]:
    """Return the readings (n,) that belong together by plane and set-up: ``"XY"``, or ``"XY 1"``, ``"XY 2"`` ..."""
    keys, groups = np.column_stack([circles.plane, circles.setup]), {}
    for plane, setup in np.unique(keys, axis=0).tolist():
        several = len(np.unique(keys[circles.plane == plane, 1])) > 1
        name = list(PLANES)[plane] + (f" {setup + 1}" if several else "")
        groups[name] = np.asarray((keys == (plane, setup)).all(axis=1))
    return groups


def about_centre(circles: Circles, own: NDArray[np.bool_]) -> FloatArray:
    """Return the radial deviations (mm) of the readings of one set-up about their least-squares centre."""
    angle = circles.angle_rad[own]
    centre = np.column_stack([np.cos(angle), np.sin(angle), np.ones(len(angle))])
    offset = np.linalg.lstsq(centre, circles.deviation_mm[own], rcond=1e-9)[0]
    return np.asarray(circles.deviation_mm[own] - centre[:, :2] @ offset[:2])


def _figures(circles: Circles, own: NDArray[np.bool_], *, calibrated: bool) -> dict[str, Figure]:
    """Figures of one set-up."""
    angle, direction, run = circles.angle_rad[own], circles.direction[own], circles.run[own]
    radial = about_centre(circles, own)
    found: dict[str, Figure] = {}
    ways = {}
    for sign, text in ((1, "counter-clockwise"), (-1, "clockwise")):
        rows = direction == sign
        if not rows.any():
            continue
        paths = [_at_angles(angle[rows & (run == k)], radial[rows & (run == k)]) for k in np.unique(run[rows])]
        mean = np.nanmean(paths, axis=0)
        if len(paths) > 1:  # uncertainty of the mean path at one angle: from the scatter between runs, else as stated
            u = float(np.sqrt(np.nanmean(np.nanvar(paths, axis=0, ddof=1)) / len(paths)))
        else:
            u = float(np.sqrt(np.mean(circles.u_mm[own][rows] ** 2)))
        ways[sign] = (mean, u)
        path = radial[rows] if len(paths) == 1 else mean[np.isfinite(mean)]
        weight = range_weight(path)
        key = "G_ccw" if sign > 0 else "G_cw"
        found[key] = Figure.of_mm(
            float(np.ptp(path)), u * float(np.linalg.norm(weight)), f"circular deviation G, {text}; ISO 230-4"
        )
        if calibrated:
            for end, which in (("max", np.max), ("min", np.min)):
                found[f"F_{end}_{key[2:]}"] = Figure.of_mm(
                    float(which(path)), u, f"radial deviation F, {end}imum, {text}; ISO 230-4"
                )
    if len(ways) == 2:
        (up, u_up), (down, u_down) = ways[1], ways[-1]
        both = np.concatenate([up, down])
        both = both[np.isfinite(both)]
        u = float(np.hypot(u_up, u_down))
        found["G_b"] = Figure.of_mm(float(np.ptp(both)), u, "bidirectional circular deviation G(b); ISO 230-4")
        found["H"] = Figure.of_mm(float(np.nanmax(np.abs(up - down))), u, "circular hysteresis H; ISO 230-4")
    return found


def _at_angles(angle: FloatArray, radial: FloatArray) -> FloatArray:
    """Radial deviations at the comparison angles, linear between readings; nan where an arc has none nearby."""
    at = np.arange(COMPARED) * 2 * np.pi / COMPARED
    order = np.argsort(angle % (2 * np.pi))
    known, values = (angle % (2 * np.pi))[order], radial[order]
    found = np.interp(at, known, values, period=2 * np.pi)
    around = np.concatenate([known[-1:] - 2 * np.pi, known, known[:1] + 2 * np.pi])
    next_one = np.searchsorted(around, at)
    near = np.minimum(at - around[next_one - 1], around[np.minimum(next_one, len(around) - 1)] - at)
    step = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    return np.where(near <= max(1.01 * step, np.radians(1.01)), found, np.nan)
