"""The controls: one or two files per control, shared code in ``shared``, one registry."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from compgen.data.files import read_text
from compgen.errors import InputError, nearest
from compgen.registry import Registry
from compgen.resources import data_folder, on_first_use

if TYPE_CHECKING:
    from compgen.controls.shared.base import AnyController, Controller, Monomial, SourceFile, Term


class Controls(Registry["type[AnyController]"]):
    """The class of every control by name; the module of a built-in control is imported when its class is requested."""

    def __init__(self, built_in: Mapping[str, str]) -> None:
        super().__init__()
        self._items: dict[str, Any] = dict(built_in)  # a class, or where it is until it is requested

    def __getitem__(self, name: str) -> type[AnyController]:
        found = self._items[name]
        if isinstance(found, str):
            module, _, kind = found.partition(".")
            found = self._items[name] = getattr(import_module(f"compgen.controls.{module}"), kind)
        control: type[AnyController] = found
        return control

    def templates(self, name: str) -> Path | None:
        """Return the template folder of a plug-in's control; None for a built-in control, which is not imported."""
        control = self._items.get(name)
        return None if control is None or isinstance(control, str) else control.templates


#: The class of every control by its name on the command line; ``CONTROLLERS["pmac"](machine)`` binds it to a machine.
CONTROLLERS = Controls(
    {
        "isg-csv": "isg_kernel.IsgCsv",
        "etalon-exchange": "isg_kernel.EtalonExchange",
        "fanuc-pitch": "fanuc_pitch.FanucPitch",
        "fanuc-3d": "fanuc_3d.Fanuc3d",
        "fanuc-straightness": "fanuc_straightness.FanucStraightness",
        "heidenhain-com": "heidenhain_com.HeidenhainCom",
        "heidenhain-kinematics": "heidenhain_kinematics.HeidenhainKinematics",
        "mitsubishi": "mitsubishi.Mitsubishi",
        "siemens-cec": "siemens_cec.SiemensCec",
        "siemens-cec-eec": "siemens_cec_eec.SiemensCecEec",
        "siemens-eec": "siemens_eec.SiemensEec",
        "linuxcnc-comp": "linuxcnc_comp.LinuxcncComp",
        "linuxcnc-matrixkins": "firmware_skew.LinuxcncMatrixkins",
        "linuxcnc-volumetric": "linuxcnc_volumetric.LinuxcncVolumetric",
        "twincat-lists": "twincat_lists.TwincatLists",
        "pmac": "pmac.Pmac",
        "klipper": "firmware_skew.Klipper",
        "marlin": "firmware_skew.Marlin",
        "reprapfirmware": "firmware_skew.RepRapFirmware",
        "ucnc": "firmware_skew.Ucnc",
        "smoothieware": "screw_maps.Smoothieware",
        "ecmc": "screw_maps.EcmcLookup",
        "aerotech": "screw_maps.Aerotech",
        "aerotech-2d": "planar_grids.Aerotech2d",
        "kmotion": "planar_grids.Kmotion",
        "weihong": "screw_maps.Weihong",
        "centroid": "screw_maps.Centroid",
        "mach4": "screw_maps.Mach4",
        "fagor-8055": "screw_maps.Fagor8055",
        "neutral": "neutral.Neutral",
    }
)


#: Names of what takes parameters of rotary axes; :mod:`compgen.controls.rotary_parameters` makes them.
ROTARY_TARGETS = ("linuxcnc-trt", "linuxcnc-tdr", "linuxcnc-5axis", "siemens-toolcarrier", "fanuc-5axis")

#: Names of tables over the angle of rotary axes; :mod:`compgen.controls.rotary_pitch` makes them.
ROTARY_PITCH = (
    "linuxcnc-rotary-comp",
    "siemens-rotary-eec",
    "siemens-rotary-cec",
    "fanuc-rotary-pitch",
    "heidenhain-rotary-com",
    "twincat-rotary-list",
    "aerotech-rotary",
)

#: Names of what takes a model of heat; :mod:`compgen.controls.heat_outputs` makes them, or says why it cannot.
HEAT_OUTPUTS = (
    "linuxcnc-heat",
    "siemens-heat",
    "twincat-heat",
    "klipper-heat",
    "marlin-heat",
    "fanuc-heat",
    "heidenhain-heat",
)

#: Controls that users request but whose file format is not published: what to use instead.
NOT_PUBLIC = {
    "siemens-vcs": "the file format of the SINUMERIK volumetric compensation system is not public; export with another "
    "control and --templates FOLDER, where FOLDER/<control>/companion/<file name>.j2 is your own template with the 21 errors",
}


#: Controls that have no compensation tables, with the dialect of their programs: the program itself is corrected.
WITHOUT_TABLES = {"grbl": "grbl", "grblhal": "grbl", "fluidnc": "grbl"}


def program_instead(name: str) -> str | None:
    """Return what corrects a control that has no compensation tables; None for any other name."""
    dialect = WITHOUT_TABLES.get(name.strip().lower())
    if dialect is None or name in CONTROLLERS:
        return None
    return (
        f"{name} has no compensation tables: correct its NC programs, "
        f"volcomp correct MACHINE PROGRAM --errors ERRORS --dialect {dialect} --wcs G54=X,Y,Z --out DIR"
    )


def controller_named(name: str) -> type[AnyController]:
    """Return the class of the control ``name``, to be called with a machine; InputError with suggestions if unknown."""
    if name in NOT_PUBLIC and name not in CONTROLLERS:
        raise InputError(f"there is no controller {name!r}: {NOT_PUBLIC[name]}")
    if instead := program_instead(name):
        raise InputError(instead)
    if name not in CONTROLLERS:
        from compgen.registry import why_missing

        if name in HEAT_OUTPUTS:
            raise InputError(
                f"{name} takes a model of heat (NAME.heat.toml of volcomp heat); use it with export, verify or read"
            )
        if name in (*ROTARY_TARGETS, *ROTARY_PITCH):
            raise InputError(f"{name} takes errors of rotary axes; use it with export, verify, read or run")

        # probable matches: controls with the word in their name, in the title of their card, or anywhere in the card
        folders = {known: control.templates or data_folder("templates") for known, control in CONTROLLERS.items()}
        cards = {known: folder / known / "format.toml" for known, folder in folders.items()}
        texts = {known: read_text(path) for known, path in cards.items() if path.is_file()}
        titles = {
            known: next((line for line in text.splitlines() if line.startswith("title")), "")
            for known, text in texts.items()
        }
        hint = nearest(name, CONTROLLERS, titles, alike=0.7)
        hint = hint if "did you mean" in hint else nearest(name, CONTROLLERS, texts)
        raise InputError(f"there is no controller {name!r}; {hint}{why_missing(CONTROLLERS.broken, name)}")
    return CONTROLLERS[name]


__all__ = [
    "CONTROLLERS",
    "HEAT_OUTPUTS",
    "ROTARY_TARGETS",
    "AnyController",
    "Controller",
    "Monomial",
    "SourceFile",
    "Term",
    "controller_named",
]

if not TYPE_CHECKING:
    __getattr__ = on_first_use(__name__)
