"""What is known of each output of a model of heat, for lists and refusals."""

from __future__ import annotations

from collections.abc import Mapping

ABOUT: Mapping[str, Mapping[str, str]] = {
    "linuxcnc-heat": {
        "title": "LinuxCNC, thermal growth: HAL component volheat between motion and drives",
        "expresses": "dx, dy, dz of a model of heat, with lags and starts; silent outside of what was trained; "
        "limited rate; sensors "
        "that fail are found",
        "evidence": "documented",
        "file": "volheat.tab, volheat.hal, volheat.comp, volheat.h (GPL-2.0-or-later)",
        "settings": "[controllers.linuxcnc-heat] machine_units, rate_um_s = 1, jump_k = 1.5, stuck_s = 1800, moved_k = 5",
    },
    "siemens-heat": {
        "title": "SINUMERIK, temperature compensation: SD43900 written by synchronized actions",
        "expresses": "dx, dy, dz of a model of heat, with lags and starts; silent outside of what was trained; "
        "limited rate. Sensors "
        "that jump or are stuck are not found",
        "evidence": "documented (MD32750, SD43900, MD32760, synchronized actions), sign stated by the user",
        "file": "VOLHEAT.SPF",
        "settings": '[controllers.siemens-heat] sign = "error" or "correction" and temperatures = { sensor = "$A_DBR[0]" }, both '
        'mandatory; axis_names = { X = "AX1" }, first_ids = 40, first_parameter = 20, timer = 1, rate_um_s = 1',
    },
    "twincat-heat": {
        "title": "TwinCAT CNC, temperature compensation: P-AXIS-00271 to 00274, offset calculated by the PLC",
        "expresses": "dx, dy, dz of a model of heat, with lags and starts; silent outside of what was trained; "
        "limited rate. Sensors "
        "that jump or are stuck are not found",
        "evidence": "documented (parameters, units, ADS), sign stated by the user",
        "file": "volheat.lis, FB_VolHeat.st",
        "settings": '[controllers.twincat-heat] sign = "error" or "correction", mandatory; axis_numbers = '
        "{ X = 1, Y = 2, Z = 3 }, "
        "rate_um_s = 1",
    },
    "klipper-heat": {
        "title": "Klipper, [z_thermal_adjust]",
        "expresses": "dz over one sensor behind one lag; acts outside of what was trained, too",
        "evidence": "documented",
        "file": "z_thermal_adjust.cfg",
        "settings": "[controllers.klipper-heat] sensor_type, sensor_pin",
    },
    "marlin-heat": {
        "title": "Marlin: no compensation of thermal growth",
        "expresses": "nothing: M871 (probe temperature compensation) changes what a probe reads, not where the tool goes",
        "evidence": "none: export refuses",
        "file": "none",
        "settings": "none",
    },
    "fanuc-heat": {
        "title": "FANUC: thermal growth along the tool vector, written by the PMC",
        "expresses": "nothing that a file carries: the data (detection units, positive for an extension of the "
        "tool) is an input of the "
        "PMC, G178 to G179 on the 15i, and the ladder is the machine builder's",
        "evidence": "meaning and sign documented (15i connection manual, 16i-MB additional manual); addresses of other series, "
        "option and format of a program are not: export refuses",
        "file": "none",
        "settings": "none",
    },
    "heidenhain-heat": {
        "title": "HEIDENHAIN: temperature compensation by the PLC",
        "expresses": "nothing that a file carries: TNC 335 to 360 take PLC words W576 to W582 (um, followed at "
        "1 um/s), TNC 426 the "
        "column TEMPCOMP; both belong to the machine builder. Cycle 452 corrects a drift that a sphere shows",
        "evidence": "documented for old controls; not for TNC 620, 640 and TNC7, nor a sign by a worked number: export refuses",
        "file": "none",
        "settings": "none",
    },
}
