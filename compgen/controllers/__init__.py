"""The controls: one folder per vendor or family, what they share beside them, one explicit registry."""

from __future__ import annotations

from compgen.controllers.base import AnyController, Controller, Monomial, SourceFile, Term
from compgen.controllers.fanuc.pitch import FanucPitch
from compgen.controllers.fanuc.straightness import FanucStraightness
from compgen.controllers.fanuc.volumetric import Fanuc3d
from compgen.controllers.heidenhain.com import HeidenhainCom
from compgen.controllers.heidenhain.kinematics import HeidenhainKinematics
from compgen.controllers.isg.etalon_exchange import EtalonExchange
from compgen.controllers.isg.volcomp import IsgCsv
from compgen.controllers.linuxcnc.comp import LinuxcncComp
from compgen.controllers.linuxcnc.volumetric import LinuxcncVolumetric
from compgen.controllers.mitsubishi.control import Mitsubishi
from compgen.controllers.neutral.control import Neutral
from compgen.controllers.pmac.control import Pmac
from compgen.controllers.siemens.cec import SiemensCec
from compgen.controllers.siemens.cec_eec import SiemensCecEec
from compgen.controllers.siemens.eec import SiemensEec
from compgen.controllers.twincat.lists import TwincatLists
from compgen.core.files import read_text
from compgen.core.plugins import why_missing
from compgen.core.text import nearest
from compgen.errors import InputError
from compgen.resources import data_folder

#: Every control by its name on the command line.
CONTROLLERS: dict[str, AnyController] = {
    "isg-csv": IsgCsv(),
    "etalon-exchange": EtalonExchange(),
    "fanuc-pitch": FanucPitch(),
    "fanuc-3d": Fanuc3d(),
    "fanuc-straightness": FanucStraightness(),
    "heidenhain-com": HeidenhainCom(),
    "heidenhain-kinematics": HeidenhainKinematics(),
    "mitsubishi": Mitsubishi(),
    "siemens-cec": SiemensCec(),
    "siemens-cec-eec": SiemensCecEec(),
    "siemens-eec": SiemensEec(),
    "linuxcnc-comp": LinuxcncComp(),
    "linuxcnc-volumetric": LinuxcncVolumetric(),
    "twincat-lists": TwincatLists(),
    "pmac": Pmac(),
    "neutral": Neutral(),
}


#: Controls that are asked for and whose file format no public document describes: what there is instead.
NOT_PUBLIC = {
    "siemens-vcs": "the file format of the SINUMERIK volumetric compensation system is not public; export with another "
    "control and --templates FOLDER, where FOLDER/<control>/companion/<file name>.j2 is your own template with the 21 errors",
}


def controller_named(name: str) -> AnyController:
    """Return the control ``name`` or raise an InputError that lists what there is."""
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
