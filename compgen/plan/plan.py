"""What a measurement will determine, and how well, before it is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.core.error_table import Curve, ErrorTable
from compgen.core.lengths import Lengths
from compgen.core.machine import Machine
from compgen.core.names import MM_PER_UM, error_named
from compgen.core.points import Points
from compgen.core.threads import one_thread
from compgen.identify.covariance import error_values
from compgen.identify.noise import IdentifyOptions, ReadingNoise, reading_noise
from compgen.identify.rank import Rank
from compgen.model.grid import volume_grid
from compgen.plan.planned import Planned, Prediction, planned, planned_rank, predict_unknowns
from compgen.plan.stations import PlannedStations

#: Points of the volume whose rows of C B are made together.
CHUNK = 1024


@dataclass(frozen=True)
class VolumeUncertainty:
    """Standard uncertainty of E = C P over the grid of nodes and the middles between them, reference point fixed.

    Parameters
    ----------
    position_mm : the points, shape (n, 3).
    u_mm : standard uncertainty of each component, shape (n, 3), nan where it is not determined.
    """

    position_mm: FloatArray
    u_mm: FloatArray

    @property
    def total_mm(self) -> FloatArray:
        """Root of the sum of the squares of the three components, (n,)."""
        return np.asarray(np.sqrt(np.sum(self.u_mm**2, axis=1)))

    @property
    def worst_um(self) -> float:
        """Largest total in um; infinite if a point is not determined."""
        return float(self.total_mm.max()) / MM_PER_UM if np.isfinite(self.u_mm).all() else np.inf

    @property
    def rms_um(self) -> float:
        """Root mean square of the total in um; infinite if a point is not determined."""
        return float(np.sqrt(np.mean(self.total_mm**2))) / MM_PER_UM if np.isfinite(self.u_mm).all() else np.inf

    def summary(self) -> dict[str, Any]:
        """Return the object ``volume`` of ``plan.json``; None where a point is not determined."""
        open_points = ~np.isfinite(self.u_mm).all(axis=1)
        report: dict[str, Any] = {"points": len(self.u_mm), "undetermined_points": int(np.count_nonzero(open_points))}
        whole = not open_points.any()
        for k, axis in enumerate("xyz"):
            report[f"u_{axis}_max_um"] = float(self.u_mm[:, k].max()) / MM_PER_UM if whole else None
            report[f"u_{axis}_rms_um"] = float(np.sqrt(np.mean(self.u_mm[:, k] ** 2))) / MM_PER_UM if whole else None
        report["u_max_um"] = self.worst_um if whole else None
        report["u_rms_um"] = self.rms_um if whole else None
        report["worst_at_mm"] = self.position_mm[int(np.argmax(self.total_mm))].tolist() if whole else None
        return report


@dataclass(frozen=True)
class Plan:
    """What a planned measurement determines.

    Parameters
    ----------
    planned : the measurement.
    rank : numerical rank, condition and the combinations without data in words.
    nodes_without_data : nodes in mm by axis that no reading touches.
    errors : zero values with the predicted standard uncertainties, nan where they are not determined.
    volume : uncertainty of E over the working volume.
    """

    planned: Planned
    rank: Rank
    nodes_without_data: dict[str, list[float]]
    errors: ErrorTable
    volume: VolumeUncertainty

    @property
    def readings(self) -> int:
        """Number of readings."""
        return len(self.planned.lengths)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the measurement will not do, in words; empty if everything is determined."""
        found = list(self.rank.combinations) if self.rank.rank < self.rank.size else []
        if not found and self.readings <= self.rank.size:
            found.append(f"{self.readings} readings for {self.rank.size} unknowns leave nothing to check them by")
        return tuple(found)

    @property
    def determined(self) -> bool:
        """Whether the measurement determines every unknown."""
        return not self.reasons

    def summary(self) -> dict[str, Any]:
        """Return the contents of ``plan.json``."""
        stations, noise = self.planned.stations, self.planned.noise
        return {
            "determined": self.determined,
            "reasons": list(self.reasons),
            "machine": self.planned.machine.name,
            "stations": [
                {"station": name, "position_mm": place.tolist()}
                for name, place in zip(stations.names, stations.position_mm, strict=True)
            ],
            "passes": len(stations.passes),
            "points": self.readings // len(stations.passes),
            "readings": self.readings,
            "rank": self.rank.rank,
            "unknowns": self.rank.size,
            "undetermined_directions": self.rank.size - self.rank.rank,
            "condition": self.rank.condition,
            "nodes_without_data": self.nodes_without_data,
            "u_length": {
                "source": noise.source,
                "constant_um": noise.constant_um,
                "proportional_um_per_m": noise.proportional_um_per_m,
            },
            "curves": {name: _curve_summary(name, curve) for name, curve in self.errors.curves.items()},
            "squareness": {
                name: {"unit": "urad", "u": _known(u * 1e6)} for name, (_, u) in self.errors.squareness.items()
            },
            "volume": self.volume.summary(),
        }


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _curve_summary(name: str, curve: Curve) -> dict[str, Any]:
    error = error_named(name)
    whole = bool(np.isfinite(curve.u).all())
    return {
        "unit": error.unit,
        "determined": whole,
        "u_max": float(curve.u.max()) / error.si_per_unit if whole else None,
        "at_mm": float(curve.position_mm[int(np.argmax(curve.u))]) if whole else None,
    }


def plan(machine: Machine, stations: PlannedStations, points: Points, options: IdentifyOptions | None = None) -> Plan:
    """Predict what a measurement will determine, and with which standard uncertainty.

    Parameters
    ----------
    machine : chain, nodes, and which errors its model contains.
    stations : any number of them; with one or two the ambiguity that is left is reported.
    points : commanded points; a point that stands twice is read twice.
    options : standard uncertainty of a reading.
    """
    with one_thread():
        return plan_of(planned(machine, stations, points, planned_noise(options)))


def planned_noise(options: IdentifyOptions | None = None) -> ReadingNoise:
    """Return the uncertainty of a planned reading: the stated one, else the usual one of a laser tracer."""
    nothing = np.zeros(0)
    no_readings = Lengths((), nothing.astype(np.int64), (), nothing.reshape(0, 3), nothing)
    return reading_noise(no_readings, options or IdentifyOptions())


def plan_of(found: Planned) -> Plan:
    """Return the plan of a measurement that has been set up."""
    matrix = found.normal_matrix(found.stations.position_mm)
    rank = planned_rank(found, matrix)
    prediction = predict_unknowns(matrix)
    nodes = [axis.nodes_mm for axis in found.machine.axes]
    grid = volume_grid(found.machine, (nodes[0], nodes[1], nodes[2])).position_mm
    return Plan(
        planned=found,
        rank=rank,
        nodes_without_data=found.nodes_without_data(),
        errors=_predicted_errors(found, prediction),
        volume=VolumeUncertainty(grid, _volume_u(found, prediction, grid)),
    )


def _volume_u(found: Planned, prediction: Prediction, position_mm: FloatArray) -> FloatArray:
    size = found.problem.parameters.size
    part = Prediction(prediction.scale[:size], prediction.eigenvalues, prediction.vectors[:size])
    chunks = [position_mm[k : k + CHUNK] for k in range(0, len(position_mm), CHUNK)]
    return np.concatenate([part.u(found.error_rows(chunk)) for chunk in chunks])


def _predicted_errors(found: Planned, prediction: Prediction) -> ErrorTable:
    layout = found.problem.parameters
    curves, squareness = {}, {}
    for name, position_mm, columns, matrix in error_values(layout):
        part = Prediction(prediction.scale[columns], prediction.eigenvalues, prediction.vectors[columns])
        u = part.u(matrix)
        if np.isnan(position_mm).any():
            squareness[name] = (0.0, float(u[0]))
        else:
            curves[name] = Curve(position_mm, np.zeros(len(position_mm)), u)
    reference = " ".join(f"{value:g}" for value in found.machine.reference_point_mm)
    metadata = {
        "machine": found.machine.name,
        "source": "compgen plan",
        "values": "zero, only u_value is predicted",
        "reference_point_mm": reference,
    }
    return ErrorTable(curves, squareness, metadata)
