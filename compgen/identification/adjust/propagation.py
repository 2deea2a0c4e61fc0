"""From the optimum to uncertainty: the joint covariance, and inputs common to all readings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.lengths import Lengths
from compgen.data.machine import Machine
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.toml_files import option
from compgen.errors import InputError, Message
from compgen.identification.adjust.solver import Factor
from compgen.identification.adjust.unknowns import ErrorParameters, IntArray, State

if TYPE_CHECKING:
    from compgen.identification.adjust.problem import LengthProblem

# What an identification keeps: the optimum, its factor, and the joint covariance.


@dataclass(frozen=True)
class Adjustment:
    """The optimum of a weighted least-squares problem of n readings.

    Parameters
    ----------
    state : the unknowns at the optimum.
    factor : of the normal matrix J^T W J there.
    weight : dimensionless weight of each reading (n,), zero for a rejected one.
    group : index of the dead length of each reading, (n,).
    sigma_mm : standard uncertainty of a reading of weight 1, so that the covariance is sigma^2 (J^T W J)^-1.
    known_weight : weight of a priori known unknowns, (size,), part of the normal matrix; None if there are none.
    """

    state: State
    factor: Factor
    weight: FloatArray
    group: IntArray
    sigma_mm: float
    known_weight: FloatArray | None = None

    @cached_property
    def _root(self) -> FloatArray:
        root = self.factor.inverse_root()
        root *= self.sigma_mm
        return root

    def covariance_factor(self) -> FloatArray:
        """Upper triangular F (size, size) with F F^T the covariance of all unknowns, mm and rad."""
        return self._root


# Contribution of inputs that repetition does not average out to the uncertainty of the errors.
#
# Each input disturbs all readings at once by a known pattern d (one column for each independent quantity, scaled to its
# standard uncertainty). To first order the unknowns move by H^-1 J^T W d, with J the Jacobian of the readings, W their
# weights and H = J^T W J (GUM, JCGM 100:2008, eq. 10, with these columns as sensitivities). No sampling is needed: the
# linear propagation agrees with identification from disturbed readings.


#: The factor is that of a matrix close to J^T W J; this many passes make the response exact.
PASSES = 4


@dataclass(frozen=True)
class SystematicInputs:
    """Standard uncertainties of inputs common to all readings; 0 omits one.

    Parameters
    ----------
    wavelength_ppm : relative error of the length scale of all stations together (wavelength, air), 1e-6.
    temperature_k : temperature of each axis in the correction to 20 degC, K; independent between the axes. It acts with
        the axis' ``expansion_um_per_m_k`` and the distance from the reference point.
    target_um : position of the target relative to the tool offset, um per coordinate; one for every tool and set-up,
    common to all stations.
    target_station_um : the same, separately for every tool, set-up and station.
    drift_um : movement of each station from its first to its last reading, linear in time, um per coordinate.
    """

    wavelength_ppm: float = option(
        0.0, "Standard uncertainty of the length scale of all stations together, 1e-6.", name="--u-wavelength-ppm"
    )
    temperature_k: float = option(
        0.0,
        "Standard uncertainty of each axis' temperature, K; acts with expansion_um_per_m_k.",
        name="--u-temperature-k",
    )
    target_um: float = option(
        0.0,
        "Standard uncertainty of the target's position on the tool, um, for every tool and set-up.",
        name="--u-target-um",
    )
    target_station_um: float = option(
        0.0, "The same, separately for every tool, set-up and station, um.", name="--u-target-station-um"
    )
    drift_um: float = option(
        0.0,
        "Standard uncertainty of each station's drift from its first to its last reading, um.",
        name="--u-drift-um",
    )

    def __post_init__(self) -> None:
        for name, value in self.items():
            if not (np.isfinite(value) and value >= 0):
                raise InputError(
                    Message(
                        "uncertainty-not-number",
                        "the uncertainty {name} is {value:g}; expected a finite number, zero or more",
                        name=name,
                        value=value,
                    )
                )

    def items(self) -> Iterator[tuple[str, float]]:
        """Names and values."""
        return ((item.name, float(getattr(self, item.name))) for item in fields(self))

    def __bool__(self) -> bool:
        """Whether any input is given."""
        return any(value > 0 for _, value in self.items())


@dataclass(frozen=True)
class Contribution:
    """One input: its standard uncertainty ``u`` and its effect on the unknowns.

    ``response`` (unknowns, quantities) is their change for one standard uncertainty of each independent quantity;
    ``worst`` the largest standard uncertainty that it gives an error, by unit, with the error's name.
    """

    name: str
    u: float
    response: FloatArray
    worst: dict[str, tuple[float, str]]


@dataclass(frozen=True)
class Systematic:
    """All contributions of systematic inputs; ``random_worst`` is the contribution of the readings' noise alone."""

    contributions: tuple[Contribution, ...]
    random_worst: dict[str, tuple[float, str]]

    @property
    def response(self) -> FloatArray:
        """Responses of all inputs side by side, shape (unknowns, quantities)."""
        return np.hstack([item.response for item in self.contributions])

    def summary(self) -> dict[str, Any]:
        """Return the object ``systematic`` of ``identify.json``."""
        return {
            "random": _worst_object(self.random_worst),
            **{
                item.name: {
                    "u": item.u,
                    "quantities": item.response.shape[1],
                    "worst_standard_uncertainty": _worst_object(item.worst),
                }
                for item in self.contributions
            },
        }


def _worst_object(worst: dict[str, tuple[float, str]]) -> dict[str, Any]:
    return {unit: {"value": value, "error": name} for unit, (value, name) in worst.items()}


@dataclass(frozen=True)
class Sight:
    """Lines of sight of n readings: unit vectors (n, 3) from station to target, distances (n,) in mm."""

    unit: FloatArray
    distance_mm: FloatArray


def responses(
    machine: Machine,
    lengths: Lengths,
    layout: ErrorParameters,
    adjustment: Adjustment,
    inputs: SystematicInputs,
) -> dict[str, FloatArray]:
    """Return the response (unknowns, quantities) of every given input, mm and rad.

    Raises
    ------
    InputError
        if a temperature uncertainty is given and the machine file has no expansion coefficient for an axis.
    """
    from compgen.identification.adjust.problem import length_problem

    linear = _Linear(length_problem(machine, lengths, layout, adjustment.group), adjustment)
    found = {}
    for name, value in inputs.items():
        if value > 0:
            found[name] = linear.response(value * _PATTERNS[name](machine, lengths, linear.sight))
    return found


def _temperature(machine: Machine, lengths: Lengths, sight: Sight) -> FloatArray:
    expansion = []
    for name, axis in zip(AXES, machine.axes, strict=True):
        if axis.expansion_um_per_m_k is None:
            raise InputError(
                Message(
                    "expansion-missing",
                    "is missing; an uncertainty of temperature requires it: give it for all three axes",
                ),
                file=machine.source,
                field=f"[axes.{name}] expansion_um_per_m_k",
            )
        expansion.append(1e-6 * axis.expansion_um_per_m_k)
    lever_mm = lengths.position_mm - np.array(machine.reference_point_mm)
    return np.asarray(sight.unit * lever_mm * np.array(expansion))


#: Pattern d (n, quantities) of one unit of each input, for n readings.
_PATTERNS: dict[str, Callable[[Machine, Lengths, Sight], FloatArray]] = {
    "wavelength_ppm": lambda machine, lengths, sight: 1e-6 * sight.distance_mm[:, None],
    "temperature_k": _temperature,
    "target_um": lambda machine, lengths, sight: _by_member(MM_PER_UM * sight.unit, _mountings(lengths)),
    "target_station_um": lambda machine, lengths, sight: _by_member(
        MM_PER_UM * sight.unit, _numbered(_mountings(lengths), lengths.station)
    ),
    "drift_um": lambda machine, lengths, sight: _drift(lengths, sight),
}


def _drift(lengths: Lengths, sight: Sight) -> FloatArray:
    """Movement of each station, which grows with time from its first to its last reading; by row without ``time_s``."""
    time = lengths.covariates.get("time_s")
    if time is None or not np.isfinite(time).all():
        time = np.arange(len(lengths), dtype=np.float64)
    share = np.zeros(len(lengths))
    for k in range(len(lengths.stations)):
        own = lengths.station == k
        first, last = time[own].min(), time[own].max()
        share[own] = (time[own] - first) / (last - first) if last > first else 0.0
    return _by_member(-MM_PER_UM * sight.unit * share[:, None], lengths.station)


def _mountings(lengths: Lengths) -> IntArray:
    """Return the index of tool and set-up of each reading: the target is mounted again for each."""
    setup = lengths.labels.get("setup", np.zeros(len(lengths), dtype=np.int64))
    return _numbered(setup, *(() if lengths.tool_mm is None else lengths.tool_mm.T))


def _numbered(*columns: NDArray[Any]) -> IntArray:
    """Number the different rows (n,) of some columns (n,)."""
    _, member = np.unique(np.column_stack(columns), axis=0, return_inverse=True)
    return member.ravel().astype(np.int64)


def _by_member(pattern: FloatArray, member: IntArray) -> FloatArray:
    """Give every member separate columns: (n, 3) -> (n, 3 * members)."""
    count = int(member.max()) + 1
    spread = np.zeros((len(pattern), count, 3))
    spread[np.arange(len(pattern)), member] = pattern
    return spread.reshape(len(pattern), 3 * count)


class _Linear:
    """The readings linearised at the optimum: products with J and with J^T W, in chunks of poses."""

    def __init__(self, problem: LengthProblem, adjustment: Adjustment) -> None:
        self.problem, self.adjustment = problem, adjustment
        vector = problem.tip_mm(adjustment.state)[problem.pose] - adjustment.state.stations_mm[problem.station]
        distance = np.linalg.norm(vector, axis=1)
        self.sight = Sight(vector / distance[:, None], distance)

    def response(self, pattern_mm: FloatArray) -> FloatArray:
        """Return the change of the unknowns (size, q) for disturbances (n, q) of the readings."""
        found = self.adjustment.factor.solve(self.backward(pattern_mm))
        for _ in range(PASSES - 1):
            right = self.backward(pattern_mm - self.forward(found))
            if self.adjustment.known_weight is not None:
                right -= self.adjustment.known_weight[:, None] * found
            found = found + self.adjustment.factor.solve(right)
        return found

    def forward(self, unknowns: FloatArray) -> FloatArray:
        """J times changes of the unknowns (size, q): changes of the readings (n, q)."""
        problem, errors = self.problem, self.problem.parameters.size
        chunks = problem.chunks(self.adjustment.state)
        moved = np.concatenate([design @ unknowns[:errors] for _, _, design in chunks])  # (poses, 3, q)
        stations = unknowns[errors : errors + 3 * problem.stations].reshape(problem.stations, 3, -1)
        dead = unknowns[errors + 3 * problem.stations :]
        result = np.empty((len(problem.pose), unknowns.shape[1]))
        for k in range(unknowns.shape[1]):
            relative = moved[problem.pose, :, k] - stations[problem.station, :, k]
            result[:, k] = np.einsum("ij,ij->i", self.sight.unit, relative) - dead[self.adjustment.group, k]
        return result

    def backward(self, pattern_mm: FloatArray) -> FloatArray:
        """J^T W times disturbances of the readings (n, q): shape (size, q)."""
        problem, poses, quantities = self.problem, len(self.problem.position_mm), pattern_mm.shape[1]
        pulled = np.zeros((poses, 3, quantities))
        by_station = np.zeros((problem.stations, 3, quantities))
        by_group = np.zeros((problem.groups, quantities))
        for k in range(quantities):
            weighted = self.adjustment.weight * pattern_mm[:, k]
            by_group[:, k] = np.bincount(self.adjustment.group, weighted, problem.groups)
            for c in range(3):
                force = weighted * self.sight.unit[:, c]
                pulled[:, c, k] = np.bincount(problem.pose, force, poses)
                by_station[:, c, k] = np.bincount(problem.station, force, problem.stations)
        size = problem.parameters.size
        errors = np.zeros((size, quantities))
        for chunk, _, design in problem.chunks(self.adjustment.state):
            errors += design.reshape(-1, size).T @ pulled[chunk].reshape(-1, quantities)
        return np.vstack([errors, -by_station.reshape(-1, quantities), -by_group])
