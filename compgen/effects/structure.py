"""Effects of the structure: angular errors, squareness, signs, bending, sag, droop, deflection, jumps, tool offset.

Each class gives its equation, its card and its displacement of the tool tip per unit of every parameter.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from compgen.data.csv_files import FloatArray
from compgen.data.machine import Machine
from compgen.data.names import AXES, CURVE_NAMES, ERROR_INDEX, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.effects.base import Card, DisplacementEffect, Parameter, Setting, along, vector_parameters
from compgen.effects.readings import Readings, legendre, step_times_s
from compgen.kinematics.first_order import Coefficient, c_matrix, coefficients, modelled_errors

# Curves of angular errors: a polynomial over the axis travel, of a degree that is searched for.


#: The nine angular errors.
ANGULAR_NAMES = tuple(name for name in CURVE_NAMES if error_named(name).kind == "angular")
#: Degrees of the curve that are tried, and the degree shown on a card.
DEGREES = tuple(float(degree) for degree in range(1, 7))
USUAL_DEGREE = 3


class CurveEffect(DisplacementEffect):
    """An effect of one angular error as the sum of p_k P_k(s_a), k from ``lowest`` to the degree.

    Its ``template`` is its card with ``{name}`` for the error, ``{A}`` and ``{a}`` for its axis letter.
    """

    template: ClassVar[Card]
    lowest: ClassVar[int]

    def __init__(self, name: str) -> None:
        self.error = error_named(name)
        axis = AXES[self.error.axis]
        card = self.template.named(name=name, A=axis, a=axis.lower())
        aliases = tuple(alias for alias in card.aliases if alias != card.name)
        self.card = replace(card, aliases=aliases, parameters=self._parameters(USUAL_DEGREE))

    def _parameters(self, degree: int) -> tuple[Parameter, ...]:
        meaning = f"part of {self.error.name} proportional to P{{}} along {AXES[self.error.axis]}"
        return tuple(
            Parameter(f"p{k}_urad", RAD_PER_URAD, meaning.format(k), 200.0) for k in range(self.lowest, degree + 1)
        )

    @abstractmethod
    def acts(self, readings: Readings) -> bool:
        """Whether the effect can show in these readings."""

    def with_settings(self, settings: Mapping[str, float]) -> Self:
        """Return the effect with the curve's degree as given."""
        chosen = super().with_settings(settings)
        degree = int(chosen.settings.get("degree", USUAL_DEGREE))
        chosen.card = replace(self.card, parameters=self._parameters(degree))
        return chosen

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Degrees of the curve."""
        return DEGREES if self.acts(readings) else ()

    def defaults(self, readings: Readings) -> dict[str, float]:
        """The degree."""
        return {"degree": USUAL_DEGREE}

    def polynomials(self, readings: Readings) -> FloatArray:
        """P_k(s_a) of every reading, (n, k)."""
        degree = int(self.used(readings)["degree"])
        return legendre(readings.normalised(self.error.axis), range(self.lowest, degree + 1))


# Angular errors that the model for a single tool omits: they show with a second tool offset.


class Lever(CurveEffect):
    """d = theta(p_a) e x lever, lever from the first-order model of the chain, theta a polynomial of degree k."""

    lowest = 0
    template = Card(
        name="lever_{name}",
        title="{name}, visible only with a tool offset",
        equation="d = theta({a}) e x lever,  theta = sum of p_k P_k(s_{A}) up to the degree",
        source="ISO 230-1; column of C of Zha & Zhang 2024, eq. 9, with a tool offset",
        covariates=("tool_x_mm", "tool_y_mm", "tool_z_mm"),
        parameters=(),
        aliases=("lever_ECX", "lever_EAZ", "lever_EBZ", "lever_ECZ", "tool_offset_error"),
        breaker="measure with three or more tool offsets that are not in one plane",
        kinds=("lengths", "deviations"),
        settings=(Setting("degree", "degree of the curve, 1 ... 6"),),
        scan="degree",
    )

    def acts(self, readings: Readings) -> bool:
        """Whether the machine's model omits the error and tools of different offset were used."""
        spread = np.ptp(readings.tool_mm, axis=0).max(initial=0.0)
        return bool(spread > 1e-6) and self.error.name not in modelled_errors(readings.machine)

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Column of C times the polynomials; with a fixed degree also for one tool, as a machine file may request."""
        if "degree" not in self.settings and not self.acts(readings):
            return None
        arm = c_matrix(readings.machine, readings.position_mm, readings.tool_mm)[:, :, ERROR_INDEX[self.error.name]]
        return np.asarray(arm[:, :, None] * self.polynomials(readings)[:, None, :])


# A squareness error that the machine's model omits.


class Squareness(DisplacementEffect):
    """d = c times the column of C of the squareness error."""

    def __init__(self, short: str) -> None:
        self.error = f"E{short}"
        self.card = Card(
            name=f"squareness_{short}",
            title=f"Squareness {self.error}, missing from the model",
            equation={"C0Y": "d_X = -c y", "B0Z": "d_X = c z", "A0Z": "d_Y = -c z"}[short],
            source="ISO 230-1; docs/conventions.md",
            covariates=(),
            parameters=(Parameter("c_urad", RAD_PER_URAD, "squareness error", 1000.0),),
            aliases=("straightness slopes", "rotation of the workpiece frame"),
            breaker="add it to the errors of the machine file",
            kinds=("lengths", "deviations"),
        )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Column of C; None if the base model contains the error."""
        if self.error in modelled_errors(readings.machine):
            return None
        column = c_matrix(readings.machine, readings.position_mm, readings.tool_mm)[:, :, ERROR_INDEX[self.error]]
        return column[:, :, None]


# A wrong sign in the model: one of the products of an angular error acts in the opposite direction.


def flipped_product(machine: Machine, name: str) -> Coefficient | None:
    """Product of an angular error whose sign the data determine: the last of two with travels of other axes.

    If the error acts through only one product, its sign is the sign of the curve and cannot be wrong.
    """
    axis = error_named(name).axis
    terms = [
        term
        for term in coefficients(machine.chain, machine.squareness_reference)
        if term.error == name and term.lever is not None and term.lever < 3 and term.lever != axis
    ]
    return max(terms, key=lambda term: term.output) if len(terms) > 1 else None


class SignError(CurveEffect):
    """d_o = q f(p_a): the product that should have the opposite sign, f = -2 times the error's curve."""

    lowest = 1
    template = Card(
        name="sign_{name}",
        title="Wrong sign of {name} in one direction",
        equation="d_o = q f({a}),  f = sum of p_k P_k(s_{A}), q another axis (EBY of WFYXZT: d_Z = x f(y))",
        source="sign conventions of the volumetric model: Zha & Zhang 2024, eq. 9; errata in docs/conventions.md",
        covariates=(),
        parameters=(),
        aliases=("beam_sag",),
        breaker="measure more sections along {A}",
        kinds=("lengths", "deviations"),
        settings=(Setting("degree", "degree of the curve, 1 ... 6"),),
        scan="degree",
    )

    def acts(self, readings: Readings) -> bool:
        """Whether the error acts through a product whose sign the data determine."""
        return flipped_product(readings.machine, self.error.name) is not None

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Lever axis travel times the polynomials, with the sign of the product; None without such a product."""
        term = flipped_product(readings.machine, self.error.name)
        if term is None or term.lever is None:
            return None
        return along(term.output, -term.sign * readings.position_mm[:, [term.lever]] * self.polynomials(readings))


# Sag of a gantry beam under its carriage, varying along the bed.


X, Y, Z = 0, 1, 2


class BeamSag(DisplacementEffect):
    """d_Z = sum of c_ij P_i(s_X) P_j(s_Y), i, j = 1, 2."""

    card = Card(
        name="beam_sag",
        title="Sag of the beam",
        equation="d_Z = sum of c_ij P_i(s_X) P_j(s_Y),  i, j = 1, 2",
        source="deflection of a beam under a travelling load, second order; Schwenke et al., CIRP Annals 57/2 (2008) 660",
        covariates=(),
        parameters=tuple(
            Parameter(f"c{i}{j}_um", MM_PER_UM, f"sag proportional to P{i} along X and P{j} along Y", 100.0)
            for i in (1, 2)
            for j in (1, 2)
        ),
        aliases=("sign_EBY",),
        breaker="measure more sections along Y",
        kinds=("lengths", "deviations"),
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Products of first and second Legendre polynomials."""
        across, along_bed = (legendre(readings.normalised(axis), range(1, 3)) for axis in (X, Y))
        products = across[:, :, None] * along_bed[:, None, :]
        return along(Z, np.asarray(products.reshape(len(readings), 4)))


# Bending of a column whose front is warmer than its rear.


CHANNELS = ("temp_column_front_c", "temp_column_rear_c")


class ColumnBending(DisplacementEffect):
    """d_Y = c G (z - z0)^2, G the temperature of the front minus that of the rear, minus its reference."""

    card = Card(
        name="column_bending",
        title="Bending of the column by a temperature gradient",
        equation="d_Y = c (T_front - T_rear - reference) (z - z0)^2",
        source="bending of a free beam under a linear temperature gradient; Mayr et al., CIRP Annals 61/2 (2012) 771",
        covariates=CHANNELS,
        parameters=(Parameter("c_um_per_k_m2", 1e-9, "deflection per kelvin at 1 m from the foot", 200.0),),
        aliases=("spindle_growth_Y", "EYZ (its constant part)"),
        breaker="let the gradient cycle while measuring over the full travel of Z",
        settings=(
            Setting("z0_mm", "position of Z at which the column is clamped"),
            Setting("reference_k", "gradient at which the effect is zero; default: mean of the readings"),
        ),
        scan="z0_mm",
        slow=True,
    )

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Foot of the column: either end, the middle or the reference point of Z."""
        low, high = readings.machine.axes[Z].range_mm
        return list(dict.fromkeys((low, high, 0.5 * (low + high), readings.machine.reference_point_mm[Z])))

    def _gradient_k(self, readings: Readings) -> FloatArray | None:
        front, rear = (readings.covariate(channel) for channel in CHANNELS)
        return None if front is None or rear is None else front - rear

    def defaults(self, readings: Readings) -> dict[str, float]:
        """The foot and the reference gradient."""
        gradient = self._gradient_k(readings)
        mean = {} if gradient is None else {"reference_k": float(gradient.mean())}
        return {"z0_mm": readings.machine.axes[Z].range_mm[0], **mean}

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Gradient times the squared distance from the foot."""
        gradient = self._gradient_k(readings)
        if gradient is None or ("reference_k" not in self.settings and np.ptp(gradient) == 0.0):
            return None
        used = self.used(readings)
        lever_mm = readings.position_mm[:, Z] - used["z0_mm"]
        return along(Y, (gradient - used["reference_k"]) * lever_mm**2)


# Droop of a ram with increasing overhang along Z, varying along Y.


class RamDroop(DisplacementEffect):
    """d_Y = P2(s_Z) (c1 P1(s_Y) + c2 P2(s_Y))."""

    card = Card(
        name="ram_droop",
        title="Droop of the ram",
        equation="d_Y = P2(s_Z) (c1 P1(s_Y) + c2 P2(s_Y))",
        source="deflection of a cantilever of variable length; Schwenke et al., CIRP Annals 57/2 (2008) 660",
        covariates=(),
        parameters=(
            Parameter("c1_um", MM_PER_UM, "droop, linear along Y", 100.0),
            Parameter("c2_um", MM_PER_UM, "droop, quadratic along Y", 100.0),
        ),
        aliases=("EYZ (the part that does not depend on Y)", "EAY (the part linear in z)"),
        breaker="measure more heights of Z at several places of Y",
        kinds=("lengths", "deviations"),
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Second Legendre polynomial along Z times first and second along Y."""
        height = legendre(readings.normalised(Z), range(2, 3))
        return along(Y, height * legendre(readings.normalised(Y), range(1, 3)))


# Deflection of the table or bed under the workpiece mass.


class LoadDeflection(DisplacementEffect):
    """d_Z = m (c0 + c1 P2(s_X) + c2 P2(s_Y))."""

    card = Card(
        name="load_deflection",
        title="Deflection under load",
        equation="d_Z = load (c0 + c1 P2(s_X) + c2 P2(s_Y))",
        source="elastic compliance of table and bed, second order in the position",
        covariates=("load_kg",),
        parameters=(
            Parameter("c0_um_per_kg", MM_PER_UM, "deflection, the same everywhere", 2.0),
            Parameter("c1_um_per_kg", MM_PER_UM, "deflection, quadratic along X", 2.0),
            Parameter("c2_um_per_kg", MM_PER_UM, "deflection, quadratic along Y", 2.0),
        ),
        aliases=("tool_offset_error", "station_drift"),
        breaker="two loads, alternated between the lines, not changed once at the end",
        kinds=("lengths", "deviations"),
    )

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Load times 1 and second Legendre polynomials along X and Y; None if the load is unknown or always zero."""
        load = readings.covariate("load_kg")
        if load is None or not np.any(load):
            return None
        bend = [legendre(readings.normalised(axis), range(2, 3))[:, 0] for axis in (X, Y)]
        return along(Z, load[:, None] * np.column_stack([np.ones(len(readings)), *bend]))


# A jump of the workpiece relative to the tool, seen by all stations at once: the table, a clamp, a spindle collision.


class MachineJump(DisplacementEffect):
    """d = c H(t - tau), c a vector, H = 1 from tau on."""

    card = Card(
        name="machine_jump",
        title="Jump of the machine seen by all stations",
        equation="d = c H(t - tau)",
        source="change point common to all stations, which separate jumps of single stations do not explain",
        covariates=("time_s",),
        parameters=vector_parameters("jump along {}", 1000.0),
        aliases=("tool_offset_error", "length_step"),
        breaker="return to the first set-up, and to one reference point from time to time",
        settings=(Setting("time_s", "time of the jump", needed=True),),
        scan="time_s",
        slow=True,
    )

    def candidates(self, readings: Readings) -> Sequence[float]:
        """Times between the runs."""
        return step_times_s(readings)

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Unit vectors after the jump; None without a jump time."""
        time_s = readings.covariate("time_s")
        if "time_s" not in self.settings or time_s is None:
            return None
        return np.asarray((time_s >= self.settings["time_s"])[:, None, None] * np.eye(3))


# A tool or target offset that differs from the file, in one set-up.


def tool_setups(readings: Readings) -> NDArray[np.int64]:
    """Set-up of every reading, (n,): its label, else the number of its tool offset, from 1 in sorted order."""
    label = readings.labels.get("setup")
    if label is not None and np.any(label != label[0]):
        return label
    _, number = np.unique(np.round(readings.tool_mm, 6), axis=0, return_inverse=True)
    return np.asarray(number.ravel().astype(np.int64) + 1)


class ToolOffsetError(DisplacementEffect):
    """d = c in one set-up, c a vector."""

    card = Card(
        name="tool_offset_error",
        title="Wrong tool or target offset in one set-up",
        equation="d = c in set-up i, 0 in the others",
        source="offset of the target from the spindle, constant in the workpiece frame",
        covariates=("setup",),
        parameters=vector_parameters("error of the offset along {}", 2000.0),
        aliases=("machine_jump", "laser_scale", "lever_ECX", "lever_EAZ", "lever_EBZ", "lever_ECZ"),
        breaker="measure with a third tool offset, and return to the first",
        kinds=("lengths", "deviations"),
        settings=(Setting("setup", "label of the set-up", needed=True),),
        scan="setup",
    )

    def candidates(self, readings: Readings) -> Sequence[float]:
        """The second of two set-ups; every one if there are more."""
        known = np.unique(tool_setups(readings))
        return [float(setup) for setup in (known[1:] if len(known) == 2 else known if len(known) > 2 else ())]

    def displacement(self, readings: Readings) -> FloatArray | None:
        """Unit vectors in the set-up; None without one."""
        if "setup" not in self.settings:
            return None
        return np.asarray((tool_setups(readings) == self.settings["setup"])[:, None, None] * np.eye(3))
