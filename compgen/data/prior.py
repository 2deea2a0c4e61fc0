"""What is assumed of errors that were not measured: sizes by class of machine, and the key ``[prior]`` of a machine file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from compgen.data import toml_files
from compgen.data.names import AXES, ERROR_NAMES, MM_PER_UM, RAD_PER_URAD, error_named
from compgen.errors import InputError, nearest

#: Size of the errors of each class, relative to a machining centre within the tolerances of ISO 10791-2 and -4.
CLASSES = {"precision": 1.0 / 3.0, "general": 1.0, "large": 3.0, "router": 20.0, "printer": 20.0}
#: The classes as a shop says it.
CLASS_WORDS = {
    "precision": "precision jig borer",
    "general": "machining centre",
    "large": "large portal",
    "router": "hobby router",
    "printer": "printer",
}


def class_named(words: str) -> str:
    """Return the class that a shop names: one of the keys, or its words; InputError for others.

    >>> class_named("router"), class_named("Machining centre"), class_named("none")
    ('router', 'general', 'none')
    """
    given = " ".join(words.lower().replace("center", "centre").split())
    for name, said in CLASS_WORDS.items():
        if given in (name, said):
            return name
    if given == NONE:
        return NONE
    listed = ", ".join(f"{name} ({said})" for name, said in CLASS_WORDS.items())
    raise InputError(f"{words[:60]!r} is not a class of machines; known are {listed}, and {NONE}", field="--class")


#: The class of a machine whose file states none.
USUAL_CLASS = "general"
#: No prior: what is not measured stays without a statement.
NONE = "none"
LEARN = ("up", "both", "no")
#: An error counts as determined if its standard uncertainty is at most this share of its prior.
DETERMINED = 1.0 / 3.0

# Standard deviations of class "general", about a quarter of the tolerance: positioning 22 um and straightness 10 um up to
# 500 mm, angles 60 urad; squareness 20 um over 500 mm taken as one sigma, for transport, levelling and crashes. The
# tolerances are those of ISO 10791-2 and -4 as remembered; they were not checked in the standards.
_SIZES = {
    "positioning_um": 6.0,
    "scale_um_per_m": 15.0,
    "straightness_um": 2.5,
    "angle_urad": 12.0,
    "squareness_urad": 40.0,
}
#: Largest and smallest size that a key may state.
MOST, LEAST = 1e5, 1e-3


def _size(value: Any) -> float:
    """Return a standard deviation."""
    number = toml_files.positive(value)
    if not LEAST <= number <= MOST:
        raise ValueError(f"expected a standard deviation from {LEAST:g} to {MOST:g}; is the unit that of the key?")
    return number


_CHECK_SIZE = toml_files.accepts({"type": "number", "minimum": LEAST, "maximum": MOST})(_size)
#: Largest amplitude of a cyclic error, um.
MOST_CYCLIC_UM = 1e3


def _amplitude(value: Any) -> float:
    """Return an amplitude in um."""
    number = toml_files.not_negative(value)
    if number > MOST_CYCLIC_UM or 0.0 < number < LEAST:
        raise ValueError(f"expected an amplitude in um from {LEAST:g} to {MOST_CYCLIC_UM:g}, or 0 for none")
    return number


_CHECK_AMPLITUDE = toml_files.accepts({"type": "number", "minimum": 0, "maximum": MOST_CYCLIC_UM})(_amplitude)
#: The keys of cyclic errors of single axes.
CYCLIC_KEYS = {f"cyclic_{axis}_um": axis for axis in AXES}
#: The keys of single errors: ``EAX_urad``, ``EXY_um``.
SINGLE_KEYS = {f"{name}_{error_named(name).unit}": name for name in ERROR_NAMES}


@dataclass(frozen=True)
class PriorSettings:
    """Section ``[prior]`` of a machine file: standard deviations of the errors before anything is measured.

    ``class_name`` is None where the file states no class; ``single`` are sizes of single errors in um or urad, by name,
    ``cyclic`` amplitudes of cyclic errors of single axes in um, by letter.
    ``factor`` multiplies the sizes of the class, of curves and of squareness: above 1 where the readings show a machine
    that is worse than its class.

    Examples
    --------
    >>> from compgen.data.prior import PriorSettings
    >>> settings = PriorSettings(class_name="large", angle_urad=20.0)
    >>> settings.size_um("EAX"), settings.size_um("EC0Y"), settings.size_um("EXY")
    (20.0, 120.0, 7.5)
    """

    class_name: str | None = toml_files.setting(
        toml_files.choice(*CLASSES, NONE),
        None,
        key="class",
        meaning="class of the machine: how large errors are assumed that were not measured",
    )
    positioning_um: float | None = toml_files.setting(
        _CHECK_SIZE, None, meaning="standard deviation of positioning errors, um, beside that of the scale"
    )
    scale_um_per_m: float | None = toml_files.setting(
        _CHECK_SIZE, None, meaning="standard deviation of the scale of an axis, um/m"
    )
    straightness_um: float | None = toml_files.setting(
        _CHECK_SIZE, None, meaning="standard deviation of straightness errors, um"
    )
    angle_urad: float | None = toml_files.setting(
        _CHECK_SIZE, None, meaning="standard deviation of roll, pitch and yaw, urad"
    )
    squareness_urad: float | None = toml_files.setting(
        _CHECK_SIZE, None, meaning="standard deviation of squareness errors, urad"
    )
    learn: str | None = toml_files.setting(
        toml_files.choice(*LEARN),
        None,
        meaning="whether the readings change these sizes: up (larger only), both, no",
    )
    cyclic_um: float | None = toml_files.setting(
        _CHECK_AMPLITUDE,
        None,
        meaning="amplitude of positioning errors that repeat with every turn of the screw, um, between the readings",
    )
    cyclic: Mapping[str, float] = field(default_factory=dict)
    single: Mapping[str, float] = field(default_factory=dict)
    factor: tuple[float, float] = (1.0, 1.0)

    @property
    def is_none(self) -> bool:
        """Whether nothing is assumed."""
        return self.class_name == NONE

    @property
    def stated_class(self) -> str:
        """The class in use."""
        return self.class_name or USUAL_CLASS

    @property
    def class_text(self) -> str:
        """The class in words: by whom it was stated, and by how much the readings raised it."""
        text = f"class {self.stated_class}, {CLASS_WORDS.get(self.stated_class, 'nothing is assumed')}"
        if self.class_name is None:
            text += ", as the machine file states none"
        curves, squareness = self.factor
        larger = [f"curves {curves:.3g} times"] if curves > 1 else []
        larger += [f"squareness {squareness:.3g} times"] if squareness > 1 else []
        return text + (f"; raised: {', '.join(larger)}" if larger else "")

    def _of_class(self, key: str) -> float:
        own = getattr(self, key)
        size = _SIZES[key] * CLASSES[self.stated_class] if own is None else own
        return float(size) * self.factor[key == "squareness_urad"]

    def size_um(self, name: str) -> float:
        """Return the standard deviation of an error, um or urad."""
        error = error_named(name)
        if name in self.single:
            return self.single[name] * self.factor[error.kind == "squareness"]
        if error.kind == "squareness":
            return self._of_class("squareness_urad")
        if error.kind == "angular":
            return self._of_class("angle_urad")
        return self._of_class("straightness_um" if error.is_straightness else "positioning_um")

    def size(self, name: str) -> float:
        """Return the standard deviation of an error, mm or rad."""
        return self.size_um(name) * (MM_PER_UM if error_named(name).kind == "linear" else RAD_PER_URAD)

    def scale(self, name: str) -> float:
        """Return the standard deviation of the scale of a positioning error, mm per mm; 0 for others."""
        error = error_named(name)
        if error.kind != "linear" or error.is_straightness:
            return 0.0
        shrunk = self.single[name] / _SIZES["positioning_um"] if name in self.single else None
        stated = self._of_class("scale_um_per_m")
        return 1e-6 * (stated if shrunk is None else shrunk * _SIZES["scale_um_per_m"] * self.factor[0])

    def cyclic_sd(self, name: str) -> float:
        """Return the standard deviation of the cyclic part of a positioning error, mm: a sine of any phase."""
        error = error_named(name)
        if self.is_none or error.kind != "linear" or error.is_straightness:
            return 0.0
        amplitude_um = self.cyclic.get(AXES[error.axis], self.cyclic_um or 0.0)
        return MM_PER_UM * amplitude_um / math.sqrt(2.0)

    @property
    def cyclic_text(self) -> str:
        """What is assumed of cyclic errors, in words; empty without any."""
        by_axis = {axis: self.cyclic.get(axis, self.cyclic_um or 0.0) for axis in AXES}
        largest = max(by_axis.values())
        which = "" if len(set(by_axis.values())) == 1 else f" ({', '.join(axis for axis in AXES if by_axis[axis])})"
        return f"cyclic error of {largest:.3g} um amplitude{which}" if largest else ""

    def with_class(self, name: str) -> PriorSettings:
        """Return the prior of a class, without what the file states (``--prior``)."""
        if name not in (*CLASSES, NONE):
            raise InputError(f"{name!r} is not a class of machines; {nearest(name, (*CLASSES, NONE))}", field="--prior")
        return PriorSettings(class_name=name, learn=self.learn)

    def raised(self, curves: float, squareness: float) -> PriorSettings:
        """Return the prior with larger sizes."""
        return replace(self, factor=(self.factor[0] * curves, self.factor[1] * squareness))

    def stated(self) -> dict[str, Any]:
        """Return the keys of the section, with the factors that the readings raised; see :meth:`from_stated`."""
        keys = {key: getattr(self, key) for key in ("class_name", *_SIZES, "learn", "cyclic_um")}
        found = {key: value for key, value in keys.items() if value is not None}
        if self.cyclic:
            found["cyclic"] = dict(self.cyclic)
        return {**found, "single": dict(self.single), "factor": list(self.factor)}

    @classmethod
    def from_stated(cls, keys: Mapping[str, Any]) -> PriorSettings:
        """Return the prior whose :meth:`stated` keys are given; ValueError for others."""
        known = {item.name for item in fields(cls)}
        if not set(keys) <= known:
            raise ValueError(f"{', '.join(sorted(set(keys) - known))}: no key of a prior")
        return cls(**{**keys, "factor": tuple(keys.get("factor", (1.0, 1.0)))})

    def as_dict(self) -> dict[str, Any]:
        """Return the object ``prior`` of ``identify.json`` and ``result.json``."""
        if self.is_none:
            return {"class": NONE}
        sizes = {key: self._of_class(key) for key in _SIZES}
        single = {f"{name}_{error_named(name).unit}": self.size_um(name) for name in self.single}
        return {
            "class": self.stated_class,
            "stated": self.class_name is not None,
            **sizes,
            **single,
            **({} if self.cyclic_um is None else {"cyclic_um": self.cyclic_um}),
            **{f"cyclic_{axis}_um": amplitude for axis, amplitude in self.cyclic.items()},
            "learn": self.learn,
            "raised_by": {"curves": self.factor[0], "squareness": self.factor[1]},
        }


def read_prior(section: toml_files.Section) -> PriorSettings:
    """Read the section ``[prior]`` of a machine file; InputError for an unknown key, or a size that is not positive."""
    single = {name: section.take(key, _CHECK_SIZE) for key, name in SINGLE_KEYS.items() if key in section}
    cyclic = {axis: section.take(key, _CHECK_AMPLITUDE) for key, axis in CYCLIC_KEYS.items() if key in section}
    settings = toml_files.take_settings(PriorSettings, section, single=single, cyclic=cyclic)
    section.finish()
    sizes = (*_SIZES, "cyclic_um")
    stated = [item.name for item in fields(PriorSettings) if item.name in sizes and getattr(settings, item.name)]
    if settings.is_none and (stated or single or cyclic):
        raise section.fail(
            "class", "'none' assumes nothing, but the section also states sizes; give a class, or no sizes"
        )
    return settings


def prior_schema() -> dict[str, Any]:
    """Return what the section ``[prior]`` may hold, as a JSON schema."""
    amplitudes = dict.fromkeys(CYCLIC_KEYS, toml_files.accepted(_CHECK_AMPLITUDE))
    sizes = dict.fromkeys(SINGLE_KEYS, toml_files.accepted(_CHECK_SIZE))
    return toml_files.section_schema(PriorSettings, **sizes, **amplitudes)
