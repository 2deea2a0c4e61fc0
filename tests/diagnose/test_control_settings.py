"""Numbers for parameters of controls from a diagnosed effect, worked by hand."""

import numpy as np
import pytest

from compgen.diagnose.control_settings import settings_of


def backlash(c_um):
    return settings_of({"name": "backlash_Y", "parameters": {"c_um": {"value": c_um, "u": 0.2}}})


def test_an_axis_that_stops_short_gets_positive_values():
    """B = 2 c = -12 um. SINUMERIK and FANUC: minus B, as in their manuals. LinuxCNC adds half of BACKLASH in the direction of
    travel (tried on the running control): +6 um, so BACKLASH = +12 um. ISG: 0.1 um. PMAC: counts times 16."""
    said = "\n".join(backlash(-6.0))
    assert "Y stops short by 12.0 +- 0.4 um at each reversal" in said
    assert "MD32450 $MA_BACKLASH = +0.0120 mm" in said
    assert "1851 = +12 with" in said
    assert "LinuxCNC: BACKLASH = +0.0120 mm" in said
    assert "P-AXIS-00103 (getriebe[i].lose) = +120 (0.1 um)" in said
    assert "Ixx86 = 12.0 um in counts, times 16" in said
    assert "HEIDENHAIN: MP_backLash (MP710, MP750) 0.0120 mm in size; its sign is not documented" in said


def test_an_axis_that_goes_too_far_gets_negative_values_and_none_where_no_document_has_them():
    said = "\n".join(backlash(3.0))
    assert "MD32450 $MA_BACKLASH = -0.0060 mm" in said
    assert "1851 = -6 with" in said
    assert "P-AXIS-00103" not in said
    assert "no document tells that they take this sign" in said


def test_a_table_that_is_fine_enough_leaves_what_is_stated():
    """Straight lines between points of a sine: the largest rest, by trying all phases on a fine grid."""
    values = {"s1_um": 3.0, "c1_um": 4.0, "s2_um": 0.0, "c2_um": 1.0}
    item = {
        "name": "periodic_X",
        "settings": {"pitch_mm": 10.0},
        "parameters": {k: {"value": v, "u": 0.1} for k, v in values.items()},
    }
    said = settings_of(item)
    x = np.linspace(0.0, 10.0, 10001)

    def wave(at):
        w = 2 * np.pi * at / 10.0
        return 3 * np.sin(w) + 4 * np.cos(w) + np.cos(2 * w)

    worst = 0.0
    for shift in np.linspace(0.0, 1.0, 41):
        nodes = np.arange(-1.0, 12.5, 1.0) + shift
        worst = max(worst, float(np.abs(wave(x) - np.interp(x, nodes, wave(nodes))).max()))
    stated = float(said[0].split("leaves at most ")[1].split()[0])
    assert worst <= stated + 0.005
    assert stated == pytest.approx(worst, rel=0.25)
    assert "every 1 mm" in said[0]
    assert "256 mm of travel" in said[1]


def test_lost_motion_has_no_single_number_and_other_effects_have_none():
    item = {
        "name": "lost_motion_X",
        "parameters": {"c1_um": {"value": 2.0, "u": None}, "c2_um": {"value": 0.0, "u": None}},
    }
    assert "from -4.0 to +4.0 um about its mean" in settings_of(item)[0]
    assert settings_of({"name": "servo_lag_X", "parameters": {}}) == []
