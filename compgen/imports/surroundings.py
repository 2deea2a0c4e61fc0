"""What a laser file says about air, material and time: sections ENVIRONMENT and EQUIPMENT, and the date of USER-TEXT.

There is no public specification. Programs that read such files take two numbers for each key, at the beginning and at the
end of the test, and after some of them a third one whose meaning is not known (of the unit, it seems); older descriptions
have one. So everything is shown, and only temperatures that can be nothing but degC, and dates that can be read in one
way, are used.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from compgen.imports.amounts import USUAL_C
from compgen.imports.dates import Order, header_date, read_date
from compgen.imports.source import parse_number, shown

#: Channels by key; the air and up to three sensors on the machine or the workpiece.
_CHANNELS = {
    "air temp": "temp_ambient_c",
    "mat temp 1": "temp_material_1_c",
    "mat temp 2": "temp_material_2_c",
    "mat temp 3": "temp_material_3_c",
}
#: Beginning and end may differ so much that their mean still stands for the whole test, K.
STEADY_K = 1.0
_QUOTED = re.compile(r"\"([^\"]{4,60})\"")


@dataclass(frozen=True)
class Surroundings:
    """Temperatures of the whole test by contract name (degC), its date in ISO form if it is clear, and remarks."""

    temperatures_c: Mapping[str, float]
    measured_at: str | None
    notes: tuple[str, ...]


def surroundings_of(environment: Mapping[str, str], user_date: str, chosen: Order | None) -> Surroundings:
    """Return what can be used of the section ENVIRONMENT and of the date in the user text.

    Parameters
    ----------
    environment : values by lower-case key.
    user_date : the date in USER-TEXT, empty if there is none.
    chosen : order of day, month and year that the user gave.
    """
    temperatures: dict[str, float] = {}
    notes: list[str] = []
    unused = []
    for key, channel in _CHANNELS.items():
        text = environment.get(key, "")
        value = _steady_temperature(text)
        if value is not None:
            temperatures[channel] = value
        elif text:
            unused.append(f"{key} {shown(text)}")
    if unused:
        notes.append(f"not used (no temperature in degC, no sensor, or not steady): {', '.join(unused)}")
    at, against = _date(environment.get("date time", ""), user_date, chosen)
    if against:
        notes.append(against)
    if environment.get("exp coeff"):
        notes.append(
            f"its software has the expansion coefficient {shown(environment['exp coeff'])}: if it compensated the material, "
            "the readings hold at 20 degC already; nothing is corrected here"
        )
    return Surroundings(temperatures, at, tuple(notes))


def _steady_temperature(text: str) -> float | None:
    """Return the mean of beginning and end if both are usual in degC and close together (a third number is a code)."""
    words = text.split()
    numbers = [parse_number(word) for word in words]
    known = [value for value in numbers if value is not None]
    if not 1 <= len(words) <= 3 or len(known) != len(words):
        return None
    if len(known) == 3 and known[2] != 0.0:
        return None
    ends = known[:2]
    usual = all(USUAL_C[0] <= value <= USUAL_C[1] for value in ends)
    return sum(ends) / len(ends) if usual and max(ends) - min(ends) <= STEADY_K else None


def _date(stamps: str, user_date: str, chosen: Order | None) -> tuple[str | None, str | None]:
    """Return the beginning of the test; the date of the user text counts where it is clear, else the stamp of the software."""
    at, against = header_date(user_date, chosen)
    first = next(iter(_QUOTED.findall(stamps)), stamps)
    stamped, _ = header_date(first, chosen)
    dated = read_date(user_date)
    if stamped and (at is None or (dated is not None and dated.clock_s is None and stamped[:10] == at[:10])):
        return stamped, None
    if stamped and at and stamped[:10] != at[:10]:
        return at, f"the user's date is {at}, the software's stamp {stamped}: the user's is taken"
    return at, against
