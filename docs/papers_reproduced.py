"""The page docs/papers.md and its pictures: python docs/papers_reproduced.py (a minute and a half).

Every printed number is read from docs/papers/*.csv. Every number called "ours" is computed here, each time, from the
public functions and the commands; none is copied. The words are in docs/papers/papers.md.j2: each function below that
returns a dictionary fills in numbers and tables of one section.
"""

import contextlib
import csv
import io
import json
import re
import shutil
import sys
import tempfile
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import jinja2
import matplotlib
import numpy as np
from scipy.optimize import least_squares

import compgen
from compgen.__main__ import main as volcomp
from compgen.instruments.sixdof_instrument import SIGNALS, Optics, SetUp, drift_matrix, solve_errors
from compgen.kinematics import modelled_errors
from compgen.simulation.sixdof import Tracer

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402  (the backend is chosen before)

DOCS = Path(__file__).resolve().parent
PRINTED = DOCS / "papers"
FIGURES = DOCS / "figures"
EXAMPLES = DOCS.parent / "examples"
PAGE = DOCS / "papers.md"
TEMPLATE = PRINTED / "papers.md.j2"
SCREWS = "zha-zhang-2024-screws.csv"
ARCSEC = np.pi / 648000
URAD = 1e6
#: Simulated repetitions behind "ours" in Tables 2 and 3 of Jia.
SEEDS = 24
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#8a4fb0")


# --- printed numbers and Markdown --------------------------------------------------------------------------------


def rows_of(name):
    """Rows of a file of printed numbers, without its comments."""
    lines = (PRINTED / name).read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


@cache
def printed(name):
    """Printed numbers by (place, item), in the unit of the paper."""
    return {(row["place"], row["item"]): float(row["value"]) for row in rows_of(name)}


def zha(place, item):
    """A number of Zha and Zhang 2024."""
    return printed("zha-zhang-2024.csv")[place, item]


def jia(place, item):
    """A number of Jia et al. 2022."""
    return printed("jia-2022.csv")[place, item]


def table(head, rows):
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines) + "\n"


def number(value, decimals):
    """A number without the sign of a rounded zero."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def signed(value, decimals):
    """A difference, with its sign unless it rounds to zero."""
    text = number(value, decimals)
    return text if text.startswith("-") or not text.strip("0.") else "+" + text


# --- Zha and Zhang 2024: the measurement -------------------------------------------------------------------------


@cache
def gantry():
    """The machine of the paper, the example's true errors, and the scenario with Tables 6 and 7 in it."""
    return (
        compgen.load_machine("zha-gantry"),
        compgen.read_errors(EXAMPLES / "zha-gantry.truth.errors.csv"),
        compgen.read_scenario(EXAMPLES / "zha-gantry.scenario.toml"),
    )


def volume():
    """Positions of all nodes of the gantry, (n, 3), mm."""
    machine, _, _ = gantry()
    return np.stack(np.meshgrid(*(axis.nodes_mm for axis in machine.axes), indexing="ij"), -1).reshape(-1, 3)


@cache
def identified_on(kind, method="joint"):
    """Identification from simulated readings along a trajectory, with the example's noise."""
    return identified(compgen.simulate(gantry()[0], along(kind)).lengths, method)


def identified(lengths, method="joint", **options):
    """Identification without the remark that an error is weakly determined; its uncertainty says so."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", compgen.CompgenWarning)
        return compgen.identify(gantry()[0], lengths, compgen.IdentifyOptions(method=method, **options))


def averaged(lengths):
    """Mean of the lengths there and back, as the paper uses it: one reading for each station and point."""
    point = np.array(lengths.point)
    _, first, group = np.unique(
        np.char.add(np.char.add(point, " "), lengths.station.astype(str)), return_index=True, return_inverse=True
    )
    order = np.argsort(first)
    mean = np.bincount(group, lengths.length_mm) / np.bincount(group)
    first = first[order]
    return compgen.Lengths(
        stations=lengths.stations,
        station=lengths.station[first],
        point=[lengths.point[k] for k in first],
        position_mm=lengths.position_mm[first],
        length_mm=mean[order],
    )


@cache
def frame_readings(noise_um):
    """Averaged readings along the 12 edges, the same random numbers for any noise (um, each single reading)."""
    machine, _, scenario = gantry()
    scenario = replace(
        scenario,
        trajectory=replace(scenario.trajectory, kind="frame"),
        instrument=replace(scenario.instrument, noise_um=noise_um, noise_um_per_m=0.0),
    )
    return averaged(compgen.simulate(machine, scenario).lengths)


@cache
def noise_of_figure_9():
    """Noise of a single reading (um) with which our largest residual is the one printed for the authors' algorithm."""
    once = identified(frame_readings(1.0), u_length_um=np.sqrt(0.5), u_length_um_per_m=0.0, reject=False)
    return zha("Figure 9", "authors largest residual") / (1e3 * np.abs(once.residual_mm).max())


@cache
def as_noisy_as_figure_9(method="joint"):
    """Identification from frame readings as noisy as figure 9 (a) has them."""
    noise, mean_of_two = noise_of_figure_9(), np.sqrt(0.5)
    lengths = frame_readings(noise)
    return identified(lengths, method, u_length_um=noise * mean_of_two, u_length_um_per_m=0.0, reject=False)


def residual_of_perfect_machine(lengths):
    """Residuals (um) when only station and dead length are adjusted and the machine is taken as perfect."""
    _, _, scenario = gantry()
    residual = np.zeros(len(lengths))
    for k, station in enumerate(scenario.instrument.stations):
        rows = lengths.station == k
        position, length = lengths.position_mm[rows], lengths.length_mm[rows]

        def misfit(unknown, position=position, length=length):
            return np.linalg.norm(position - unknown[:3], axis=1) - unknown[3] - length

        found = least_squares(misfit, [*station.position_mm, station.dead_length_mm], x_scale=[1, 1, 1, 1], xtol=1e-14)
        residual[rows] = 1e3 * found.fun
    return residual


# --- Zha and Zhang 2024: the model -------------------------------------------------------------------------------


def screw(row, amount):
    """Exponential of a screw of Tables 2 to 5 for one amount, 4 x 4; all of them pass through the origin."""
    result = np.eye(4)
    if row["v"]:
        result[:3, 3] = amount * np.array(row["v"].split(), float)
        return result
    omega = np.array(row["omega"].split(), float)
    cross = np.cross(np.eye(3), omega)
    result[:3, :3] += np.sin(amount) * cross + (1 - np.cos(amount)) * cross @ cross
    return result


def product_of_exponentials(errors, position_mm):
    """Tip minus command, (n, 3), mm, by equation 4 of the paper: Y, squareness of X, X, squareness of Z, Z."""
    tables = {f"Table {k}": [row for row in rows_of(SCREWS) if row["table"] == f"Table {k}"] for k in range(2, 6)}
    squareness = {row["motion"]: row for row in tables["Table 3"]}
    chain = [*tables["Table 2"], squareness["EC0X"], *tables["Table 4"]]
    chain += [squareness["EA0Z"], squareness["EB0Z"], *tables["Table 5"]]
    result = np.zeros_like(position_mm)
    for k, place in enumerate(position_mm):
        amounts = {name: errors.curves[name].at(place["XYZ".index(name[2])]) for name in errors.curves}
        amounts |= {name: value for name, (value, _) in errors.squareness.items()}
        amounts |= {"EC0X": -amounts["EC0Y"]} | dict(zip("XYZ", place, strict=True))
        pose = np.eye(4)
        for row in chain:
            pose = pose @ screw(row, amounts.get(row["motion"], 0.0))
        result[k] = pose[:3, 3] - place
    return result


def columns_of_c(machine, position_mm):
    """Coefficients of the errors by name, each (3,), at one position."""
    matrix = compgen.c_matrix(machine, np.array([position_mm]))[0]
    zero = np.zeros((1, 3))
    flat = np.array([0.0, 1.0])
    result = {}
    for name in modelled_errors(machine):
        one = (
            {"squareness": {name: (1.0, 0.0)}}
            if name[2] == "0"
            else {"curves": {name: compgen.Curve(flat, flat * 0 + 1, flat)}}
        )
        result[name] = matrix @ compgen.ErrorTable(**one).at(zero)[0]
    return result


def equation_9(name, x, z):
    """Coefficients of an error in dX, dY, dZ as equation 9 prints them."""
    special = {
        "EB0Z": (z, 0, 0),
        "EBX": (z, 0, 0),
        "EBY": (z, 0, -x),
        "EA0Z": (0, -z, 0),
        "EAX": (0, -z, 0),
        "EAY": (0, -z, 0),
        "EC0Y": (0, x, 0),
        "ECY": (0, x, 0),
    }
    return np.array(special.get(name) or np.eye(3)["XYZ".index(name[1])], float)


#: Rows of the matrix of equation 10 as the text has them; columns in the order of the errors of X, Y, Z, squareness.
EQUATION_10 = (
    "1 0 0 0 Z 1 0 0 0 Z 0 1 0 0 0 -Z 0",
    "0 1 0 0 0 1 0 -Z 0 X 0 1 0 -X 0 -Z",
    "0 0 1 0 0 0 1 0 -X 0 0 0 1 0 0 0",
)


def row_of_equation_10(k, ours):
    """What is otherwise in row ``k`` of equation 10: a sentence."""
    names, printed_row = list(ours), EQUATION_10[k].split()
    symbols = {0.0: "0", 1.0: "1", 2.0: "X", -2.0: "-X", 5.0: "Z", -5.0: "-Z"}
    row = [symbols[float(ours[name][k])] for name in names]
    if len(printed_row) == len(row):
        wrong = [f"{n} {p} (ours {o})" for n, p, o in zip(names, printed_row, row, strict=True) if p != o]
        return f"{len(row)} entries; " + (", ".join(wrong) or "all alike")
    missing = [n for j, n in enumerate(names) if row[:j] + row[j + 1 :] == printed_row]
    what = row[names.index(missing[0])]
    place = f"that of {missing[0]}" if len(missing) == 1 else f"one of {', '.join(missing)}"
    return f"{len(printed_row)} entries; one {what} is missing: {place}"


def model_figures():
    """Deviations of the model (um): equation 4, first order, and the two frames of EC0Y."""
    machine, truth, _ = gantry()
    in_y = replace(machine, squareness_reference="Y")
    places = np.random.default_rng(4).uniform(machine.lower_mm, machine.upper_mm, (500, 3))
    screws = product_of_exponentials(truth, places)
    exact = compgen.exact_error(in_y, truth, places)
    square = truth.replace(squareness={name: (0.0, 0.0) for name in truth.squareness})
    without = compgen.exact_error(in_y, square, places) - product_of_exponentials(square, places)
    first_order = compgen.volumetric_error(in_y, truth, places)
    in_x = compgen.exact_error(machine, truth, places)
    frames = compgen.without_rigid_motion(places, in_x) - compgen.without_rigid_motion(places, exact)
    return {
        "screws": largest_um(exact - screws),
        "screws, square axes": largest_um(without),
        "first order": largest_um(first_order - screws),
        "frames as they stand": largest_um(in_x - exact),
        "frames": largest_um(frames),
    }


def largest_um(error_mm):
    """Largest length of vectors (n, 3) in mm, as um."""
    return 1e3 * float(np.linalg.norm(error_mm, axis=1).max())


def model_rows(ours, figures):
    """Rows of the table: place, printed, ours, deviation and why; ``ours`` are columns of C with Y as reference."""
    wrong = [name for name, column in ours.items() if not np.allclose(column, equation_9(name, 2.0, 5.0), atol=1e-12)]
    names = {row["motion"] for row in rows_of(SCREWS)} - {"X", "Y", "Z", "EC0X"}
    every = {f"E{kind}{axis}" for axis in "XYZ" for kind in "XYZABC"} | {"EA0Z", "EB0Z"}
    return [
        [
            "Table 1",
            "21 errors",
            f"{len(names & every) + 1} of the same names",
            "Table 3 writes E_C0X for E_C0Y of Table 1",
        ],
        [
            "Tables 2 to 5, eq. 4",
            "product of exponentials",
            f"exact model, {figures['screws']:.3f} um apart",
            "500 random points with the errors of the example. The order of the squareness factors in eq. 4 cannot be read; "
            "it is taken so that eq. 9 follows. There squareness also turns the errors of the carriages, with us only the "
            f"direction of travel; without squareness both are {figures['screws, square axes']:.4f} um apart",
        ],
        [
            "eq. 9",
            "17 errors",
            f"{len(ours)} errors, {len(ours) - len(wrong)} columns of C alike",
            f"{', '.join(wrong)}: printed +X in dY; ours -X in dY (Y as reference; so has eq. 10) or -Y in dX (X as reference)",
        ],
        [
            "eq. 9 against eq. 4",
            "first order",
            f"{figures['first order']:.2f} um apart",
            "second order: EC0Y of 2.9 mrad over a metre. That is why `identify` uses the exact model",
        ],
        *(
            [f"eq. 10, row d{'XYZ'[k]}", "17 columns", row_of_equation_10(k, ours), "as our text has it; eq. 9 decides"]
            for k in range(3)
        ),
    ]


def model():
    """Tables 1 to 5, figures 1 and 2, equations 4, 9 and 10."""
    machine, _, _ = gantry()
    ours, figures = columns_of_c(replace(machine, squareness_reference="Y"), (2.0, 3.0, 5.0)), model_figures()
    return {
        "chain": "-".join(machine.chain.name),
        "model_table": table(["place", "printed", "ours", "deviation, and why"], model_rows(ours, figures)),
        "frames_mm": f"{figures['frames as they stand'] / 1e3:.2f}",
        "frames_um": f"{figures['frames']:.3f}",
    }


# --- Zha and Zhang 2024: stations, squareness, curves, residuals -------------------------------------------------


def station_rows():
    """Table 6 and the stations that come back."""
    rows = []
    for station in identified_on("grid").stations:
        for axis, value, u in zip("xyz", station.position_mm, station.u_position_mm, strict=True):
            stated = zha("Table 6", f"{station.station} {axis}")
            rows.append(
                [
                    f"{station.station} {axis}",
                    f"{stated:.4f}",
                    f"{value:.4f}",
                    signed(1e3 * (value - stated), 2),
                    f"{1e3 * u:.2f}",
                ]
            )
    return rows


def largest_station_deviation(result):
    """Largest deviation of a station coordinate from Table 6: um, and in standard uncertainties."""
    deviation = np.array(
        [
            [v - zha("Table 6", f"{s.station} {a}") for a, v in zip("xyz", s.position_mm, strict=True)]
            for s in result.stations
        ]
    )
    u = np.array([s.u_position_mm for s in result.stations])
    return 1e3 * np.abs(deviation).max(), float(np.abs(deviation / u).max())


def distances(places):
    """Distances between all pairs of stations, mm."""
    places = np.array(places)
    return np.array([np.linalg.norm(a - b) for k, a in enumerate(places) for b in places[:k]])


def off_plane_mm():
    """Distance of LT4 from the plane of the other three in Table 6."""
    places = np.array([[zha("Table 6", f"LT{k} {axis}") for axis in "xyz"] for k in range(1, 5)])
    normal = np.cross(places[1] - places[0], places[2] - places[0])
    return abs(float((places[3] - places[0]) @ normal / np.linalg.norm(normal)))


def stations():
    """Table 6 and figures 3 and 4."""
    _, _, scenario = gantry()
    nominal = distances([station.position_mm for station in scenario.instrument.stations])
    found = distances([station.position_mm for station in identified_on("grid", "two-step").stations])
    rows = []
    for kind, method in (("grid", "joint"), ("grid", "two-step"), ("frame", "joint"), ("frame", "two-step")):
        um, in_u = largest_station_deviation(identified_on(kind, method))
        rows.append([f"{kind}, {method}", f"{um:.2f}", f"{in_u:.1f}"])
    head = ["station", "printed (mm)", "ours (mm)", "deviation (um)", "u, k = 1 (um)"]
    return {
        "station_table": table(head, station_rows()),
        "station_summary": table(["readings, method", "largest deviation (um)", "in standard uncertainties"], rows),
        "apart_um": f"{1e3 * np.abs(found - nominal).max():.2f}",
        "off_plane_mm": f"{off_plane_mm():.1f}",
    }


@cache
def along(kind):
    """The scenario of the example on another trajectory: ``grid``, ``faces``, ``frame``, or ``cross`` (three lines)."""
    machine, _, scenario = gantry()
    if kind != "cross":
        return replace(scenario, trajectory=replace(scenario.trajectory, kind=kind))
    text = (EXAMPLES / "zha-gantry.scenario.toml").read_text(encoding="utf-8").partition("[trajectory]")[0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cross.scenario.toml"
        path.write_text(f'{text}[trajectory]\ntype = "lines"\n{cross_lines(machine)}', encoding="utf-8")
        return compgen.read_scenario(path)


def cross_lines(machine):
    """Lines of a scenario: along each axis through the middle of the volume, with the printed number of points."""
    low, high = np.array(machine.lower_mm), np.array(machine.upper_mm)
    text = ""
    for axis in np.eye(3, dtype=bool):
        start, end = (np.where(axis, limit, 0.5 * (low + high)).tolist() for limit in (low, high))
        text += f"[[trajectory.lines]]\nfrom_mm = {start}\nto_mm = {end}\n"
        text += f"points = {zha('Section 6.1', 'points of an axis'):.0f}\n"
    return text


def duration(kind, there_and_back=True):
    """Target points, stops and hours of a trajectory with the feed and dwell of the paper."""
    scenario = along(kind)
    trajectory = replace(
        scenario.trajectory,
        there_and_back=there_and_back,
        feed_mm_min=zha("Section 6.1", "feed"),
        dwell_s=zha("Section 6.1", "dwell"),
    )
    lengths = compgen.simulate(gantry()[0], replace(scenario, trajectory=trajectory)).lengths
    stops = len(lengths) // len(lengths.stations)
    return len(set(lengths.point)), stops, float(lengths.covariates["time_s"].max()) / 3600


def determined(kind):
    """Whether readings along a trajectory determine the 17 errors."""
    try:
        identified(compgen.simulate(gantry()[0], along(kind)).lengths)
    except compgen.UndeterminedError:
        return False
    return True


def trajectory():
    """Figure 5 and the half hour."""
    machine, _, _ = gantry()
    facts = []
    for k, letter in enumerate("XYZ"):
        low, high = machine.axes[k].range_mm
        nodes, stated = len(machine.axes[k].nodes_mm), zha("Section 6.1", f"stroke {letter}")
        points = zha("Section 6.1", "points of an axis")
        facts.append(f"{letter} {high - low:g} mm with {nodes} points (printed {stated:g} mm, {points:g})")
    titles = {
        "cross": "cross: three lines through the middle",
        "frame": "12 edges",
        "faces": "6 faces",
        "grid": "whole grid",
    }
    rows = []
    for kind, title in titles.items():
        (points, _, once), (_, stops, both) = duration(kind, False), duration(kind)
        rows.append([title, points, stops, f"{once:.2f}", f"{both:.2f}", "yes" if determined(kind) else "no"])
    head = ["trajectory", "target points", "stops there and back", "once (h)", "there and back (h)"]
    return {
        "strokes": "; ".join(facts),
        "hours": f"{zha('Section 5', 'duration'):g}",
        "feed": f"{zha('Section 6.1', 'feed'):g}",
        "dwell": f"{zha('Section 6.1', 'dwell'):g}",
        "trajectory_table": table([*head, "determines all 17 errors"], rows),
    }


def gantry_squareness():
    """Table 7."""
    rows = []
    for name in ("EC0Y", "EB0Z", "EA0Z"):
        authors, software, stated = (zha("Table 7", f"{name} {what}") for what in ("authors", "software", "difference"))
        cells = [name, f"{authors:.3f}", f"{software:.3f}", f"{stated:.3f}", number(authors - software, 3)]
        for result in (identified_on("grid"), as_noisy_as_figure_9()):
            value, u = (URAD * part for part in result.errors.squareness[name])
            cells += [f"{value:.2f} ± {u:.2f}", signed(value - authors, 2)]
        rows.append(cells)
    head = ["urad", "authors", "maker's software", "difference, printed", "difference, ours"]
    head += ["ours, grid", "less authors'", "ours, frame as noisy as figure 9", "less authors'"]
    return {"squareness_table": table(head, rows), **straightness_for_squareness()}


def straightness_for_squareness():
    """A difference of squareness as a straightness that does not end at zero, and how far both forms are apart."""
    machine, _, _ = gantry()
    pairs = {"EC0Y": "EXY", "EB0Z": "EXZ", "EA0Z": "EYZ"}
    parts, worst = [], 0.0
    for name, straight in pairs.items():
        angle = zha("Table 7", f"{name} difference") / URAD
        axis = "XYZ".index(straight[2])
        nodes = machine.axes[axis].nodes_mm
        sign = columns_of_c(machine, np.eye(3)[axis])[name]["XYZ".index(straight[1])]
        line = compgen.ErrorTable(curves={straight: compgen.Curve(nodes, sign * angle * nodes, 0 * nodes)})
        one = compgen.volumetric_error(machine, line, volume())
        other = compgen.volumetric_error(machine, compgen.ErrorTable(squareness={name: (angle, 0.0)}), volume())
        worst = max(worst, largest_um(one - other))
        end_um = 1e3 * line.curves[straight].value[0]
        parts.append(f"{name} {URAD * angle:+.3f} urad is {straight} {end_um:+.2f} um at the far end")
    return {"same_motion": "; ".join(parts), "same_motion_um": number(worst, 3)}


PANELS = (
    ("Figure 6 (a), X linear", ("EXX", "EYX", "EZX"), ("Figure 6", "EZX largest difference"), "um"),
    ("Figure 6 (b), X angular", ("EAX", "EBX"), ("Figure 6", "EAX largest difference"), "urad"),
    ("Figure 7 (a), Y linear", ("EXY", "EYY", "EZY"), ("Figure 7", "EXY largest difference"), "um"),
    ("Figure 7 (b), Y angular", ("EAY", "EBY", "ECY"), ("Figure 7", "angles largest difference"), "urad"),
    ("Figure 8, Z", ("EXZ", "EYZ", "EZZ"), ("Figure 8", "EZZ largest difference"), "um"),
)


def largest_of(names, unit, values, decimals):
    """Largest absolute value over some curves: number and name."""
    factor = URAD if unit == "urad" else 1e3
    sizes = {name: factor * float(np.abs(values(name)).max()) for name in names}
    name = max(sizes, key=sizes.get)
    return f"{sizes[name]:.{decimals}f} ({name})"


def curves():
    """Figures 6 to 8."""
    _, truth, _ = gantry()
    joint, two = as_noisy_as_figure_9().errors.curves, as_noisy_as_figure_9("two-step").errors.curves
    values = (
        lambda name: joint[name].value - two[name].value,
        lambda name: joint[name].value - truth.curves[name].at(joint[name].position_mm),
        lambda name: joint[name].u,
    )
    rows = []
    for title, names, key, unit in PANELS:
        ours = [largest_of(names, unit, value, decimals) for value, decimals in zip(values, (3, 1, 1), strict=True)]
        rows.append([title, unit, f"{zha(*key):.1f} ({key[1].split()[0]})", *ours])
    head = ["figure", "unit", "printed: authors' less maker's", "ours: joint less two-step", "ours less truth"]
    return {"noise_um": f"{noise_of_figure_9():.2f}", "curve_table": table([*head, "largest u, k = 1"], rows)}


def length_residuals():
    """Figure 9."""
    lengths, result = frame_readings(noise_of_figure_9()), as_noisy_as_figure_9()
    before = residual_of_perfect_machine(lengths)
    authors, software = (zha("Figure 9", f"{who} largest residual") for who in ("authors", "software"))
    rows = [
        ["before: machine taken as perfect", "-", f"{np.abs(before).max():.1f}", f"{np.sqrt(np.mean(before**2)):.1f}"],
        ["after identification, joint", f"{authors:.1f} (authors)", *residual_cells(result)],
        ["after identification, two-step", "-", *residual_cells(as_noisy_as_figure_9("two-step"))],
        ["maker's software", f"{software:.1f}", "-", "-"],
        ["the example (grid, 0.1 um + 0.15 um/m)", "-", *residual_cells(identified_on("grid"))],
    ]
    return {
        "mean_lengths": len(lengths),
        "largest_to_rms": f"{authors / (1e3 * np.sqrt(np.mean(result.residual_mm**2))):.1f}",
        "residual_table": table(["", "printed, largest (um)", "ours, largest (um)", "ours, rms (um)"], rows),
        "authors_residual": f"{authors:.1f}",
    }


def residual_cells(result):
    """Largest and rms residual of an identification, um."""
    return f"{1e3 * np.abs(result.residual_mm).max():.2f}", f"{1e3 * np.sqrt(np.mean(result.residual_mm**2)):.2f}"


def limits_by_figure():
    """Largest printed difference of each error, mm and rad: that of its figure, and Table 7."""
    limits = {}
    for _, names, key, unit in PANELS:
        limits |= dict.fromkeys(names, zha(*key) / (URAD if unit == "urad" else 1e3))
    return limits | {name: abs(zha("Table 7", f"{name} difference")) / URAD for name in ("EC0Y", "EB0Z", "EA0Z")}


def limits_of_the_abstract():
    """The same with one number for every linear and one for every angular error, as abstract and conclusion have them."""
    linear, angular = zha("Figure 7", "EXY largest difference") / 1e3, zha("Table 7", "EA0Z difference") / URAD
    return {name: linear if name[1] in "XYZ" else angular for name in limits_by_figure()}


def bound_um(limits):
    """Most that differences of the single errors within ``limits`` make by E = C P: dX, dY, dZ, vector; um."""
    machine, _, _ = gantry()
    ends = np.meshgrid(*zip(machine.lower_mm, machine.upper_mm, strict=True))
    columns = [columns_of_c(machine, corner) for corner in np.array(ends).reshape(3, 8).T]
    components = np.array([sum(np.abs(column[name]) * limit for name, limit in limits.items()) for column in columns])
    return [*(1e3 * components.max(axis=0)), largest_um(components)]


def volumetric():
    """Figure 10."""
    machine, truth, _ = gantry()
    limits = (limits_by_figure(), limits_of_the_abstract())
    bounds = [", ".join(f"{value:.1f}" for value in bound_um(limit)) for limit in limits]
    places = volume()
    found, true = (compgen.exact_error(machine, errors, places) for errors in (as_noisy_as_figure_9().errors, truth))
    two = compgen.exact_error(machine, as_noisy_as_figure_9("two-step").errors, places)
    free = compgen.without_rigid_motion(places, found) - compgen.without_rigid_motion(places, true)
    stated = zha("Figure 10", "largest difference")
    rows = [
        ["authors' less maker's, printed", f"{stated:.1f}"],
        ["most that figures 6 to 8 and Table 7 allow: dX, dY, dZ, vector", bounds[0]],
        ["most that the abstract allows, 2.0 um and 2.7 urad for every error: dX, dY, dZ, vector", bounds[1]],
        ["ours: joint less two-step", f"{largest_um(found - two):.2f}"],
        ["ours less truth, as it stands", f"{largest_um(found - true):.1f}"],
        ["ours less truth, without the best-fit rigid motion", f"{largest_um(free):.1f}"],
    ]
    return {
        "space_table": table(["largest difference over the volume", "um"], rows),
        "space_um": f"{stated:.1f}",
        "turn_urad": f"{1e3 * stated / zha('Section 6.1', 'stroke X'):.0f}",
    }


# --- Jia et al. 2022 ---------------------------------------------------------------------------------------------

#: ISO 230-1 names of the rows of Table 1 for X, Y, Z.
JIA_ROWS = {
    "positioning": ("EXX", "EYY", "EZZ"),
    "horizontal": ("EYX", "EXY", "EYZ"),
    "vertical": ("EZX", "EZY", "EXZ"),
    "pitch": ("EBX", "EAY", "EBZ"),
    "yaw": ("ECX", "ECY", "EAZ"),
    "roll": ("EAX", "EBY", "ECZ"),
}
TITLES = {"horizontal": "horizontal straightness", "vertical": "vertical straightness"}
UNITS = {"positioning": ("nm", 1e6), "horizontal": ("um", 1e3), "vertical": ("um", 1e3)}
#: Pairs of straightness slopes whose sum is the squareness S = 90 degrees less the angle between the axes.
SQUARENESS = {"S_xy": ("EYX", "EXY"), "S_xz": ("EZX", "EXZ"), "S_yz": ("EZY", "EYZ")}
OPTICS = Optics()


def spot(signals, name):
    """One signal of the ray tracer, mm."""
    return signals[SIGNALS.index(name)]


def optical_lines():
    """Equations 8 to 10: axis, parameter, arcsec, signal, text, slope (1), place of the figure."""
    prism, face = jia("Section 4.1", "angle of the prism"), jia("Section 4.2", "angle of a face of the prism")
    glass = 2.0 * (1.0 - OPTICS.glass_index)
    return (
        ("figures 8, 9; eq. 8", 1, "eps_zir", prism, "y_qd1_mm", "Y: 4 eps_zir L", 4.0),
        ("figure 9; eq. 8", 1, "eps_xir", prism, "z_qd1_mm", "Y: -2 eps_xir L", -2.0),
        ("figure 9; eq. 8", 1, "eps_yir", prism, "z_qd1_mm", "Y: -2 eps_yir L", -2.0),
        ("figure 9; eq. 9", 2, "eps_xir", prism, "y_qd1_mm", "Z: 2 eps_xir L", 2.0),
        ("figure 9; eq. 9", 2, "eps_zir", prism, "y_qd1_mm", "Z: 2 eps_zir L", 2.0),
        ("figure 9; eq. 9", 2, "eps_yir", prism, "z_qd1_mm", "Z: -4 eps_yir L", -4.0),
        ("figures 10 (a), 11 (a); eq. 10", 1, "eps_zmrs1", face, "y_qd1_mm", "Y: 2 (1 - n) eps_zmrs1 L", glass),
        ("figures 10 (b), 11 (b); eq. 10", 1, "eps_ymrs1", face, "z_qd1_mm", "Y: -2 (1 - n) eps_ymrs1 L", -glass),
    )


def traced_um(axis, name, arcsec, signal):
    """Change of a spot from L = 0 over the distances of section 4.1, um, from the exact ray tracer."""
    tracer = Tracer(OPTICS, axis, systematics={name: arcsec * ARCSEC})
    distance_mm = np.arange(0.0, jia("Section 4.1", "largest distance") + 1.0, jia("Section 4.1", "step"))
    spots = np.array([spot(tracer.signals(d, np.zeros(3), np.zeros(3)), signal) for d in distance_mm])
    return distance_mm, 1e3 * (spots - spots[0])


def optics():
    """Section 4, figures 7 to 11."""
    rows = []
    for place, axis, name, arcsec, signal, text, slope in optical_lines():
        distance_mm, traced = traced_um(axis, name, arcsec, signal)
        formula = 1e3 * slope * arcsec * ARCSEC * distance_mm
        worst = np.abs(traced - formula).max()
        rows.append([place, text, f"{arcsec:g}", f"{formula[-1]:.3f}", f"{traced[-1]:.3f}", number(worst, 4)])
    head = [
        "place",
        "printed formula",
        "arcsec",
        "formula at 800 mm (um)",
        "ours, traced (um)",
        "largest deviation (um)",
    ]
    return {"distances": len(distance_mm), "optics_table": table(head, rows), "glass_index": OPTICS.glass_index}


def printed_motion(axis, mode, distance_mm, signals, drift=(0.0, 0.0)):
    """Straightness, yaw and roll by equations 5 to 7 as printed (horizontal channel, no systematic terms): mm, rad.

    ``drift`` are the terms PSD2 / f of straightness and of yaw, with the sign that was chosen for each.
    """
    sense, kappa = (1.0, -1.0)[mode - 1], (1.0, -1.0, -1.0)[axis]
    lever = 0.0 if axis == 0 else OPTICS.prism_leg_mm / 2
    yaw = -kappa * sense * spot(signals, "y_psd1_mm") / (2 * OPTICS.focal_length_mm) + drift[1]
    arm = OPTICS.reduced_depth_mm + (mode - 1) * (distance_mm + lever)
    straight = sense * (spot(signals, "y_qd1_mm") / 2 + kappa * arm * yaw) + distance_mm * drift[0]
    spots = spot(signals, "z_qd1_mm") - spot(signals, "z_qd2_mm")
    return np.array([straight, yaw, sense * spots / (2 * OPTICS.beam_separation_mm)])


def our_motion(axis, mode, distance_mm, signals, tilt=0.0):
    """The same by the model of the program, with drift of the beams toward y taken out."""
    set_up, distance = SetUp(axis, mode), np.array([distance_mm])
    drift = np.array([tilt, 0.0])
    errors = solve_errors(OPTICS, set_up, distance, signals[None] - drift_matrix(OPTICS, set_up, distance) @ drift)[0]
    return errors[[1, 3, 5]]


#: Machine axes (0, 1, 2) of yaw and roll of X, Y, Z, from Table 1.
YAW_ROLL = tuple(zip(*(["ABC".index(name[1]) for name in JIA_ROWS[row]] for row in ("yaw", "roll")), strict=True))
PUT_IN_ARCSEC, DRIFT_ARCSEC, AT_MM = 9.0, 1.5, 400.0


def equation_figures(axis, mode):
    """Errors that the printed and our equations make for pure yaw, pure roll, pure drift at L = 400 mm.

    Straightness (um) from yaw, roll (arcsec) from roll, straightness (um) and yaw (arcsec) from drift; each printed, ours.
    The printed drift terms have both signs; those count that do least harm to yaw, then to straightness.
    """
    tracer = Tracer(OPTICS, axis, mode)
    still = tracer.signals(AT_MM, np.zeros(3), np.zeros(3))
    yaw, roll = YAW_ROLL[axis]
    result = []
    for about, which, factor in ((yaw, 0, 1e3), (roll, 2, 1 / ARCSEC)):
        signals = tracer.signals(AT_MM, np.zeros(3), PUT_IN_ARCSEC * ARCSEC * np.eye(3)[about]) - still
        true = PUT_IN_ARCSEC * ARCSEC if which == 2 else 0.0
        result.append([factor * (f(axis, mode, AT_MM, signals)[which] - true) for f in (printed_motion, our_motion)])
    tilt = DRIFT_ARCSEC * ARCSEC
    signals = tracer.signals(AT_MM, np.zeros(3), np.zeros(3), drift_rad=(tilt, 0.0)) - still
    signs = [(one * tilt, other * tilt) for one in (1, -1) for other in (1, -1)]
    tried = [printed_motion(axis, mode, AT_MM, signals, drift) for drift in signs]
    best = min(tried, key=lambda motion: (round(abs(motion[1]), 12), abs(motion[0])))
    ours = our_motion(axis, mode, AT_MM, signals, tilt)
    return [*result, [1e3 * best[0], 1e3 * ours[0]], [best[1] / ARCSEC, ours[1] / ARCSEC]]


def equations():
    """Table 1, equations 1 and 5 to 7, figures 1 to 6."""
    rows = []
    for axis, letter in enumerate("XYZ"):
        for mode in (1, 2):
            cells = [f"{signed(a, 3)} / {signed(b, 3)}" for a, b in equation_figures(axis, mode)]
            rows.append([f"eq. {5 + axis}, {letter}", mode, *cells])
    motion, drift = f"{PUT_IN_ARCSEC:g} arcsec", f"{DRIFT_ARCSEC:g} arcsec of drift"
    head = ["equation", "mode", f"straightness from {motion} of yaw (um)", f"roll from {motion} of roll (arcsec)"]
    return {
        "jia_names": ", ".join(name for names in JIA_ROWS.values() for name in names),
        "at_mm": f"{AT_MM:g}",
        "equation_table": table([*head, f"straightness from {drift} (um)", f"yaw from {drift} (arcsec)"], rows),
    }


# --- Jia et al. 2022: repeatability and squareness ---------------------------------------------------------------


def command(*words):
    """Run a command of the program in this process and return its JSON."""
    before, out = sys.argv, io.StringIO()
    sys.argv = ["volcomp", *map(str, words), "--json"]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            volcomp()
    except SystemExit as end:
        if end.code:
            raise RuntimeError(f"{words} ended with {end.code}") from None
    finally:
        sys.argv = before
    return json.loads(out.getvalue())


QUIET = "[instrument.noise]\ndisplacement_um = 0\nqd_um = 0\npsd_um = 0\n"
#: The bench of Table 2: one axis, the target moves. The paper gives no constants; those of the example are taken.
BENCH = """kind = "sixdof-laser"
focal_length_mm = 100.0
beam_separation_mm = 30.0
glass_index = 1.5151
cube_side_mm = 30.0
plate_thickness_mm = 3.0
[axes.Z]
mode = 1
distance_first_mm = 100.0
"""


@cache
def factors():
    """Expected half range of 3 runs at the worst of 17 positions, in standard deviations of single readings.

    By what is taken out of each run: the first value, or a least-squares line. From 20000 draws; the half range of single
    values, for squareness, is the third.
    """
    draws = np.random.default_rng(17).standard_normal((20000, 3, 17))
    first = draws - draws[:, :, :1]
    x = np.linspace(-1.0, 1.0, 17)
    line = draws - draws.mean(axis=2, keepdims=True) - (draws @ x / (x @ x))[:, :, None] * x
    return tuple(float(np.mean(np.ptp(values, axis=1).max(axis=1) / 2)) for values in (first, line))


def scatter_text(place, columns):
    """The scatter section of a scenario: standard deviations that give the printed half ranges, by axis and column."""
    first, line = factors()
    keys = {"positioning": "positioning_um", "horizontal": "horizontal_um", "vertical": "vertical_um"}
    text = ""
    for letter, column in columns.items():
        text += f"[instrument.scatter.{letter}]\n"
        for row in JIA_ROWS:
            unit = 1e-3 if row == "positioning" else 1.0
            value = unit * jia(place, f"{row} {column}") / (line if row in ("horizontal", "vertical") else first)
            text += f"{keys.get(row, row + '_arcsec')} = {value!r}\n"
    return text


def one_run_files(path):
    """The file of each run on its own, as if each run were a measurement."""
    lines = path.read_text().splitlines()
    comments = [line for line in lines if line.startswith("#") and "rows" not in line]
    head, *body = [line for line in lines if not line.startswith("#")]
    run = head.split(",").index("run")
    for number in sorted({line.split(",")[run] for line in body}):
        single = path.with_name(f"run{number}.sixdof.csv")
        single.write_text(
            "\n".join([*comments, head, *(line for line in body if line.split(",")[run] == number)]) + "\n"
        )
        yield single


def measured_errors(folder, scenario, instrument):
    """Errors by run of a simulated measurement through the commands: simulate, then identify each run by itself."""
    (folder / "m.scenario.toml").write_text(scenario)
    (folder / "instrument.toml").write_text(instrument)
    command("simulate", "jia-xytz", "--scenario", folder / "m.scenario.toml", "--out", folder)
    result = []
    for single in one_run_files(folder / "m.sixdof.csv"):
        out = folder / single.name.partition(".")[0]
        command("identify", "jia-xytz", single, "--instrument", folder / "instrument.toml", "--out", out)
        result.append(compgen.read_errors(out / "identified.errors.csv"))
    return result


def at_tool(machine, errors, name):
    """Error of the tool point in the direction of ``name``, or the angle, over the nodes of its axis, (n,)."""
    axis = "XYZ".index(name[2])
    position = np.zeros((len(machine.axes[axis].nodes_mm), 3))
    position[:, axis] = machine.axes[axis].nodes_mm
    if name[1] in "ABC":
        return errors.curves[name].at(position[:, axis])
    return compgen.volumetric_error(machine, errors, position)[:, "XYZ".index(name[1])]


def evened(machine, name, value):
    """Values without the first one, straightness without its least-squares line, as the paper's section 3.2 says."""
    along_mm = machine.axes["XYZ".index(name[2])].nodes_mm
    if name[1] in "ABC" or name[1] == name[2]:
        return value - value[0]
    return value - np.polyval(np.polyfit(along_mm, value, 1), along_mm)


def squareness(machine, errors, pair):
    """S of a pair of axes (rad) from the lines of both straightnesses at the tool."""
    slopes = [
        np.polyfit(machine.axes["XYZ".index(n[2])].nodes_mm, at_tool(machine, errors, n), 1)[0]
        for n in SQUARENESS[pair]
    ]
    return float(sum(slopes))


def half_range(values):
    """(max - min) / 2 over the runs, the worst position."""
    return float(np.ptp(np.array(values), axis=0).max() / 2)


def half_ranges(machine, runs, letters):
    """Half ranges in the units of the paper: at the tool point, and at the carriage's own origin."""
    result = {}
    for row, names in JIA_ROWS.items():
        factor = UNITS.get(row, ("arcsec", 1 / ARCSEC))[1]
        for letter in letters:
            name = names["XYZ".index(letter)]
            tool = [evened(machine, name, at_tool(machine, errors, name)) for errors in runs]
            own = [
                evened(machine, name, errors.curves[name].at(machine.axes["XYZ".index(letter)].nodes_mm))
                for errors in runs
            ]
            result[f"{row} {letter}"] = (factor * half_range(tool), factor * half_range(own))
    if len(letters) == 3:
        for pair in SQUARENESS:
            values = [squareness(machine, errors, pair) for errors in runs]
            result[f"squareness {pair}"] = (np.ptp(values) / 2 / ARCSEC,) * 2
    return result


def simulated_half_ranges(place, columns, instrument, seeds):
    """Mean half ranges over simulated repetitions, and how far the mean is uncertain (k = 1)."""
    machine = compgen.load_machine("jia-xytz")
    collected = []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            shutil.copy(EXAMPLES / "jia-xytz.truth.errors.csv", folder / "truth.csv")
            text = f'name = "m"\nseed = {seed}\n[errors]\nfile = "truth.csv"\n[instrument]\ntype = "sixdof"\n'
            text += f'file = "instrument.toml"\nruns = 3\n{QUIET}{scatter_text(place, columns)}'
            collected.append(half_ranges(machine, measured_errors(folder, text, instrument), tuple(columns)))
    values = {key: np.array([item[key] for item in collected]) for key in collected[0]}
    return {key: (value.mean(axis=0), value.std(axis=0, ddof=1) / np.sqrt(seeds)) for key, value in values.items()}


@cache
def bench_figures(seeds=SEEDS):
    """Table 2, six degrees of freedom: one axis in mode 1."""
    return simulated_half_ranges("Table 2", {"Z": "instrument"}, BENCH, seeds)


@cache
def machine_figures(seeds=SEEDS):
    """Table 3: all axes, X and Y in mode 2."""
    instrument = (EXAMPLES / "jia-xytz.instrument.toml").read_text()
    return simulated_half_ranges("Table 3", {letter: letter for letter in "XYZ"}, instrument, seeds)


def repeatability_on_the_bench():
    """Table 2 and figures 12 and 13."""
    rows, beyond = [], []
    for row in (*JIA_ROWS, "squareness"):
        unit = UNITS.get(row, ("arcsec", 0))[0]
        decimals = 0 if unit == "nm" else 2
        instrument, standard, deviation = (
            jia("Table 2", f"{row} {what}") for what in ("instrument", "standard", "deviation")
        )
        cells = [f"{row} ({unit})", *(f"{value:.{decimals}f}" for value in (instrument, standard, deviation))]
        ratio = deviation / (instrument + standard)
        beyond += [TITLES.get(row, row)] * (ratio > 1)
        rows.append([*cells, f"{ratio:.2f}", *returned(bench_figures(), f"{row} Z", instrument, decimals)])
    head = ["", "instrument ±", "standard ±", "largest deviation", "deviation over the sum of both ±", "ours ±"]
    return {
        "seeds": SEEDS,
        "table_2": table([*head, "ours less printed"], rows),
        "beyond": f"{', '.join(beyond[:-1])} and {beyond[-1]}",
    }


def returned(figures, key, stated, decimals):
    """Our half range with its uncertainty, and the deviation from the print; empty if there is none."""
    if key not in figures:
        return "-", "-"
    value, u = (part[0] for part in figures[key])
    return f"{value:.{decimals}f} (u {u:.{decimals + 1}f})", signed(value - stated, decimals)


def repeatability_on_the_machine():
    """Table 3 and figures 14 to 17."""
    figures, rows, times = machine_figures(), [], {}
    for row in JIA_ROWS:
        unit = UNITS.get(row, ("arcsec", 0))[0]
        decimals = 0 if unit == "nm" else 2
        for letter in "XYZ":
            stated = jia("Table 3", f"{row} {letter}")
            cells = returned(figures, f"{row} {letter}", stated, decimals)
            own = figures[f"{row} {letter}"][0][1]
            rows.append([f"{row} {letter} ({unit})", f"{stated:.{decimals}f}", *cells, f"{own:.{decimals}f}"])
    for pair in SQUARENESS:
        stated, made = jia("Table 3", f"squareness {pair}"), figures[f"squareness {pair}"][0][0]
        cells = returned(figures, f"squareness {pair}", stated, 2)
        rows.append([f"squareness {pair} (arcsec)", f"{stated:.2f}", *cells, "-"])
        times |= {f"made{pair[1:]}": f"{made:.2f}", f"times{pair[1:]}": f"{stated / made:.1f}"}
    head = ["", "printed ±", "ours ±, at the tool", "ours less printed", "ours ±, at the carriage's origin"]
    return {
        "table_3": table(head, rows),
        "own_y": f"{figures['horizontal Y'][0][1]:.2f}",
        "straight_y": f"{jia('Table 3', 'horizontal Y'):.2f}",
        "yaw_y": f"{jia('Table 3', 'yaw Y'):.2f}",
        "nm_y": f"{jia('Table 3', 'positioning Y'):g}",
        **times,
    }


def squareness_outcome():
    """Squareness (arcsec) of section 5.2 after simulation and identification: by pair, value and standard uncertainty."""
    machine = compgen.load_machine("jia-xytz")
    truth = compgen.read_errors(EXAMPLES / "jia-xytz.truth.errors.csv")
    constants = dict(truth.squareness)
    for (pair, name), sign in zip({"S_xy": "EC0Y", "S_xz": "EB0Z", "S_yz": "EA0Z"}.items(), (-1, 1, -1), strict=True):
        missing = jia("Section 5.2", pair) * ARCSEC - squareness(machine, truth, pair)
        constants[name] = (constants[name][0] + sign * missing, 0.0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "truth.csv").write_text(compgen.format_errors(truth.replace(squareness=constants)))
        shutil.copy(EXAMPLES / "jia-xytz.instrument.toml", folder)
        text = (EXAMPLES / "jia-xytz.scenario.toml").read_text(encoding="utf-8")
        before, after = text.partition("[errors]")[0], text[text.index("[instrument]") :]
        (folder / "m.scenario.toml").write_text(f'{before}[errors]\nfile = "truth.csv"\n{after}', encoding="utf-8")
        command("simulate", "jia-xytz", "--scenario", folder / "m.scenario.toml", "--out", folder)
        words = ["jia-xytz", folder / "jia-xytz.sixdof.csv", "--instrument", folder / "jia-xytz.instrument.toml"]
        command("identify", *words, "--out", folder / "i")
        errors = compgen.read_errors(folder / "i" / "identified.errors.csv")
    u = dict(zip(SQUARENESS, (errors.squareness[name][1] for name in ("EC0Y", "EB0Z", "EA0Z")), strict=True))
    return {pair: (squareness(machine, errors, pair) / ARCSEC, u[pair] / ARCSEC) for pair in SQUARENESS}


def squareness_of_section_5_2():
    """Section 5.2 and figure 18."""
    rows = []
    for pair, (value, u) in squareness_outcome().items():
        stated = jia("Section 5.2", pair)
        rows.append([pair, f"{stated:.1f}", f"{value:.2f}", signed(value - stated, 2), f"{u:.2f}"])
    head = ["arcsec", "printed", "ours", "deviation", "u, k = 1"]
    return {"jia_squareness_table": table(head, rows), "minutes": f"{jia('Section 6', 'duration'):g}"}


# --- the page ----------------------------------------------------------------------------------------------------

#: What fills in the template; the last two repeat simulated measurements and take a minute.
SECTIONS = (model, stations, trajectory, gantry_squareness, curves, length_residuals, volumetric)
SECTIONS += (equations, optics, squareness_of_section_5_2, repeatability_on_the_bench, repeatability_on_the_machine)


def page():
    """The whole page."""
    values = {name: value for section in SECTIONS for name, value in section().items()}
    template = jinja2.Template(
        TEMPLATE.read_text(encoding="utf-8"), undefined=jinja2.StrictUndefined, keep_trailing_newline=True
    )
    return template.render(values)


def draw_curves():
    """The curves of figures 6 to 8 from the simulated frame readings."""
    _, truth, _ = gantry()
    joint, two = as_noisy_as_figure_9().errors.curves, as_noisy_as_figure_9("two-step").errors.curves
    figure, panels = plt.subplots(2, 3, figsize=(11, 5.6), layout="constrained")
    for panel, (title, names, _, unit) in zip(panels.flat, PANELS, strict=False):
        factor = URAD if unit == "urad" else 1e3
        for colour, name in zip(COLOURS, names, strict=False):
            at_mm, value = joint[name].position_mm, joint[name].value
            panel.plot(at_mm, factor * truth.curves[name].at(at_mm), color=colour, linewidth=5, alpha=0.2)
            panel.plot(at_mm, factor * value, color=colour, linewidth=1.2, label=name)
            panel.plot(at_mm, factor * two[name].value, color="black", linewidth=1.2, linestyle=(0, (2, 4)))
        panel.set_title(title.replace("Figure", "As figure"), fontsize=10)
        panel.set_xlabel(f"{names[0][2]} (mm)")
        panel.set_ylabel("µrad" if unit == "urad" else "µm")
        panel.legend(fontsize=8, frameon=False)
    panels.flat[-1].axis("off")
    words = "Simulated readings\n\nwide: truth\nline: joint method\ndashed: two-step method"
    panels.flat[-1].text(0.1, 0.4, words)
    save(figure, "papers-curves.svg")


def draw_residuals():
    """The residuals of figure 9 from the simulated frame readings."""
    lengths, result = frame_readings(noise_of_figure_9()), as_noisy_as_figure_9()
    figure, panel = plt.subplots(figsize=(8, 3), layout="constrained")
    for k, (station, colour) in enumerate(zip(lengths.stations, COLOURS, strict=True)):
        panel.plot(1e3 * result.residual_mm[lengths.station == k], color=colour, linewidth=0.8, label=station)
    for sign in (-1, 1):
        panel.axhline(sign * zha("Figure 9", "authors largest residual"), color="black", linewidth=0.6, linestyle="--")
    panel.set(xlabel="target point on the 12 edges", ylabel="residual (µm)")
    panel.legend(fontsize=8, ncols=4)
    save(figure, "papers-residuals.svg")


def save(figure, name):
    """Write a picture, the same bytes every time, coordinates to 0.01 of a point."""
    text = io.StringIO()
    with plt.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    plt.close(figure)
    short = re.sub(r"\d+\.\d{3,}", lambda found: f"{float(found.group()):.2f}", text.getvalue())
    (FIGURES / name).write_text(short, encoding="utf-8")


def main():
    """Write the page and its pictures."""
    PAGE.write_text(page(), encoding="utf-8")
    draw_curves()
    draw_residuals()
    sys.stdout.write(f"{PAGE.name} written\n")


if __name__ == "__main__":
    main()
