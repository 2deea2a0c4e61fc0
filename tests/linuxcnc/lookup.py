#!/usr/bin/python3
"""Looks positions of points.f64 up in the HAL component volcomp, in the realtime thread; writes corrections.f64.

Run by halrun: ``loadusr -w ./lookup.py``. A point counts when the component's cycle counter has moved by two.
"""

import array
import faulthandler
import time

import hal

faulthandler.dump_traceback_later(20, exit=True)

PINS = ("pos-x", "pos-y", "pos-z", "tool-x", "tool-y", "tool-z")


def main():
    points = array.array("d")
    with open("points.f64", "rb") as file:
        points.frombytes(file.read())
    component = hal.component("lookup")
    for name in PINS:
        component.newpin(name, hal.HAL_FLOAT, hal.HAL_OUT)
    component.ready()
    for name in PINS:
        hal.new_sig(name, hal.HAL_FLOAT)
        hal.connect(f"lookup.{name}", name)
        hal.connect(f"volcomp.{name}", name)
    found = array.array("d")
    for start in range(0, len(points), 6):
        for name, value in zip(PINS, points[start : start + 6], strict=True):
            component[name] = value
        cycle = hal.get_value("volcomp.cycles")
        while hal.get_value("volcomp.cycles") < cycle + 2:
            time.sleep(0.0003)
        found.extend(hal.get_value(f"volcomp.correction-{axis}") for axis in "xyz")
    with open("corrections.f64", "wb") as file:
        found.tofile(file)
    component.exit()


if __name__ == "__main__":
    main()
