"""The controls: one or two files per control, what they share in ``shared``, one registry."""

from __future__ import annotations

from compgen.controls.etalon_exchange import EtalonExchange
from compgen.controls.fanuc_3d import Fanuc3d
from compgen.controls.fanuc_pitch import FanucPitch
from compgen.controls.fanuc_straightness import FanucStraightness
from compgen.controls.heidenhain_com import HeidenhainCom
from compgen.controls.heidenhain_kinematics import HeidenhainKinematics
from compgen.controls.isg_csv import IsgCsv
from compgen.controls.linuxcnc_comp import LinuxcncComp
from compgen.controls.linuxcnc_volumetric import LinuxcncVolumetric
from compgen.controls.mitsubishi import Mitsubishi
from compgen.controls.neutral import Neutral
from compgen.controls.pmac import Pmac
from compgen.controls.shared.base import AnyController, Controller, Monomial, SourceFile, Term
from compgen.controls.siemens_cec import SiemensCec
from compgen.controls.siemens_cec_eec import SiemensCecEec
from compgen.controls.siemens_eec import SiemensEec
from compgen.controls.twincat_lists import TwincatLists
from compgen.data.files import read_text
from compgen.data.messages import nearest
from compgen.data.registry import why_missing
from compgen.errors import InputError
from compgen.resources import data_folder

#: The class of every control by its name on the command line; ``CONTROLLERS["pmac"](machine)`` is that of a machine.
CONTROLLERS: dict[str, type[AnyController]] = {
    "isg-csv": IsgCsv,
    "etalon-exchange": EtalonExchange,
    "fanuc-pitch": FanucPitch,
    "fanuc-3d": Fanuc3d,
    "fanuc-straightness": FanucStraightness,
    "heidenhain-com": HeidenhainCom,
    "heidenhain-kinematics": HeidenhainKinematics,
    "mitsubishi": Mitsubishi,
    "siemens-cec": SiemensCec,
    "siemens-cec-eec": SiemensCecEec,
    "siemens-eec": SiemensEec,
    "linuxcnc-comp": LinuxcncComp,
    "linuxcnc-volumetric": LinuxcncVolumetric,
    "twincat-lists": TwincatLists,
    "pmac": Pmac,
    "neutral": Neutral,
}


#: Controls that are asked for and whose file format no public document describes: what there is instead.
NOT_PUBLIC = {
    "siemens-vcs": "the file format of the SINUMERIK volumetric compensation system is not public; export with another "
    "control and --templates FOLDER, where FOLDER/<control>/companion/<file name>.j2 is your own template with the 21 errors",
}


def controller_named(name: str) -> type[AnyController]:
    """Return the class of the control ``name``, to be called with a machine, or raise an InputError that lists what there is."""
    if name in NOT_PUBLIC and name not in CONTROLLERS:
        raise InputError(f"no controller is named {name!r}: {NOT_PUBLIC[name]}")
    if name not in CONTROLLERS:
        raise InputError(f"no controller is named {name!r}; {_hint(name)}{why_missing('control', name)}")
    return CONTROLLERS[name]


def _hint(name: str) -> str:
    """What was probably meant: the controls with it in their name, in the title of their card, anywhere in the card."""
    folders = {known: control.templates or data_folder("templates") for known, control in CONTROLLERS.items()}
    cards = {known: folder / known / "format.toml" for known, folder in folders.items()}
    texts = {known: read_text(path) for known, path in cards.items() if path.is_file()}
    titles = {
        known: next((line for line in text.splitlines() if line.startswith("title")), "")
        for known, text in texts.items()
    }
    hint = nearest(name, CONTROLLERS, titles, alike=0.7)
    return hint if "did you mean" in hint else nearest(name, CONTROLLERS, texts)


__all__ = ["CONTROLLERS", "AnyController", "Controller", "Monomial", "SourceFile", "Term", "controller_named"]
