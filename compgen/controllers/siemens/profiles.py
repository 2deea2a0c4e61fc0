"""What the SINUMERIK models can hold: numbers of tables and nodes, and the usual values of limiting machine data.

Sources: SINUMERIK 840D sl / 828D Extended Functions, chapter K3, 03/2013, p. 264 (828D), newer edition p. 277 (number of
tables of the 840D sl); 802D sl Function Manual 11/2012, p. 215, 220; 808D Function Manual 01/2017, p. 106. The bounds of
2000 and 5000 nodes and the defaults of MD32720 and MD32730 are not from a manual that could be read.
"""

from __future__ import annotations

from dataclasses import dataclass

from compgen.core import tomlio


@dataclass(frozen=True)
class Profile:
    """Capacity of one model.

    Parameters
    ----------
    cec_tables : number of CEC tables; None: it follows from the number of axes, or is not documented.
    cec_nodes : nodes per CEC table; None: not documented.
    eec_nodes : nodes per encoder table.
    eec_nodes_documented : False if ``eec_nodes`` is the smallest number that is documented for any model.
    tables_per_axis : CEC tables for each axis of the control, 0 if their number is fixed.
    """

    cec_tables: int | None
    cec_nodes: int | None
    eec_nodes: int = 5000
    eec_nodes_documented: bool = True
    tables_per_axis: int = 0


#: Models by their name in the machine file.
PROFILES = {
    "840D sl": Profile(None, 2000, tables_per_axis=2),
    "828D": Profile(8, 200),
    "808D": Profile(None, None, eec_nodes=200),
    "802D sl": Profile(2, 350, eec_nodes=200, eec_nodes_documented=False),
}
#: Axes that a control of a machine with X, Y and Z has at least.
FEWEST_AXES = 3
#: What counts where the machine file names no model.
USUAL = "840D sl"
#: Defaults of MD32720 (mm) and MD32730 (%) as far as they are known, the same for all models.
DEFAULT_MAX_SUM_MM, DEFAULT_MAX_VELO_PERCENT = 1.0, 10.0

_NOT_DOCUMENTED = (
    "no public document says that this model has cross-error compensation; if yours has, state tables_available and "
    "max_points as its start-up list shows them"
)


def take_profile(section: tomlio.Section) -> Profile:
    """Take ``profile``, the model of the control; the limits of an 840D sl count where it is not stated."""
    return PROFILES[section.take("profile", tomlio.choice(*PROFILES), USUAL)]


def take_cec_capacity(section: tomlio.Section, profile: Profile) -> tuple[int, int | None]:
    """Take ``max_points`` and ``tables_available`` (None: not known); what is stated overrides the profile."""
    own_axes = section.take("nc_axes", tomlio.whole(FEWEST_AXES, 93), None)
    tables = profile.cec_tables
    if profile.tables_per_axis and own_axes is not None:
        tables = profile.tables_per_axis * own_axes
    nodes = section.take("max_points", tomlio.whole(3, 100_000), profile.cec_nodes)
    available = section.take("tables_available", tomlio.whole(1, 1000), tables)
    if nodes is None or (available is None and not profile.tables_per_axis):
        raise section.fail("profile", _NOT_DOCUMENTED)
    return nodes, available
