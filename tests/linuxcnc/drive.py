#!/usr/bin/python3
"""Client of a headless LinuxCNC session: homes, runs commands of plan.json, writes result.json and samples.f64.

It stands in the INI file as [DISPLAY] DISPLAY; when it ends, LinuxCNC shuts down. It runs on the distribution's Python,
which alone has the modules of LinuxCNC.
"""

import array
import faulthandler
import json
import os
import signal
import subprocess
import sys
import time

import hal
import linuxcnc

#: The session ends after this long, whatever happens; calls into LinuxCNC may block for ever.
WATCHDOG_S = 40
WAIT_S = 20
#: Debian's binding (2.9.0~pre1) crashes once in a few hundred sessions while it attaches to the sampler, before the control has
#: been told anything; this many processes try.
ATTEMPTS = 3


def wait(condition, what):
    end = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f"no end of: {what}")
        time.sleep(0.005)


def wait_cycles(count):
    """Wait for as many servo cycles: on a busy computer the threads of the control may rest for longer than any time."""

    def recorded():
        return hal.get_value("sampler.0.curr-depth") + hal.get_value("sampler.0.overruns")

    end = recorded() + count
    wait(lambda: recorded() >= end, f"{count} servo cycles")


class Session:
    def __init__(self):
        self.command, self.stat, self.errors = linuxcnc.command(), linuxcnc.stat(), linuxcnc.error_channel()
        self.messages, self.sensors = [], None

    def polled(self):
        self.stat.poll()
        found = self.errors.poll()
        if found:
            self.messages.append(found[1])
        return self.stat

    def start(self):
        """Take the e-stop back and switch on; return whether that was possible."""
        self.command.state(linuxcnc.STATE_ESTOP_RESET)
        self.command.wait_complete(5)
        if self.polled().estop:
            return False
        self.command.state(linuxcnc.STATE_ON)
        wait(lambda: self.polled().enabled, "switching on")
        self.command.mode(linuxcnc.MODE_MANUAL)
        self.command.wait_complete(5)
        self.command.home(-1)
        wait(lambda: all(self.polled().homed[: self.stat.joints]), "homing")
        self.command.teleop_enable(1)
        self.command.wait_complete(5)
        return True

    def mdi(self, line):
        self.command.mode(linuxcnc.MODE_MDI)
        self.command.wait_complete(5)
        self.command.mdi(line)
        if self.command.wait_complete(WAIT_S) != linuxcnc.RCS_DONE:
            self.messages.append(f"not done: {line}")

    def set(self, name_and_text):
        """Set a pin, or a signal that nobody writes (its name has no dot)."""
        name, text = name_and_text
        subprocess.run(["halcmd", "setp" if "." in name else "sets", name, text], check=True)
        wait_cycles(50)

    def temperatures(self, day):
        """Write rows of values to signals that nobody writes, evenly over some seconds."""
        if self.sensors is None:
            self.sensors = hal.component(f"compgen-sensors-{os.getpid()}")
            for name, value in zip(day["signals"], day["rows"][0], strict=True):
                self.sensors.newpin(name, hal.HAL_FLOAT, hal.HAL_OUT)
                self.sensors[name] = value
            self.sensors.ready()
            for name in day["signals"]:
                hal.connect(f"compgen-sensors-{os.getpid()}.{name}", name)
        rows, begin = day["rows"], time.monotonic()
        for number, row in enumerate(rows, start=1):
            for name, value in zip(day["signals"], row, strict=True):
                self.sensors[name] = value
            time.sleep(max(0.0, begin + day["seconds"] * number / len(rows) - time.monotonic()))

    def estop(self, _):
        """Press the e-stop, and switch on again."""
        self.command.state(linuxcnc.STATE_ESTOP)
        wait(lambda: self.polled().estop, "e-stop")
        wait_cycles(100)
        self.command.state(linuxcnc.STATE_ESTOP_RESET)
        wait(lambda: not self.polled().estop, "e-stop taken back")
        self.command.state(linuxcnc.STATE_ON)
        wait(lambda: self.polled().enabled, "switching on")
        wait_cycles(100)

    def rest(self, pin):
        """Wait until a pin is FALSE, after what came before has reached it, and a moment longer."""
        wait_cycles(5)
        wait(lambda: not hal.get_value(pin), pin)
        wait_cycles(50)

    def home(self, joint):
        """Home again, all joints with -1."""
        self.command.mode(linuxcnc.MODE_MANUAL)
        self.command.wait_complete(5)
        self.command.teleop_enable(0)
        self.command.wait_complete(5)
        self.command.home(joint)
        time.sleep(0.1)
        wait(lambda: all(self.polled().homed[: self.stat.joints]), "homing")
        self.command.teleop_enable(1)
        self.command.wait_complete(5)

    def program(self, path):
        self.command.mode(linuxcnc.MODE_AUTO)
        self.command.wait_complete(5)
        self.command.program_open(path)
        self.command.auto(linuxcnc.AUTO_RUN, 0)
        wait(lambda: self.polled().interp_state != linuxcnc.INTERP_IDLE, "start of the program")
        wait(lambda: self.polled().interp_state == linuxcnc.INTERP_IDLE and self.stat.inpos, "the program")


def read_samples(stream):
    found = array.array("d")
    while True:
        row = stream.read()
        if row is None:
            return found
        found.extend(row)


def main():
    """Run the session in a process of its own, and once more where that died while it attached to the sampler."""
    for _ in range(ATTEMPTS):
        session = os.fork()
        if session == 0:
            run()
            sys.exit()
        code = os.waitstatus_to_exitcode(os.waitpid(session, 0)[1])
        if code != -signal.SIGSEGV or os.path.exists("attached"):
            return code
        print("the session died while it attached to the sampler", flush=True)
    return code


def run():
    faulthandler.enable()
    faulthandler.dump_traceback_later(WATCHDOG_S, exit=True)
    with open("plan.json", encoding="ascii") as file:
        plan = json.load(file)
    component = hal.component(f"compgen-test-{os.getpid()}")
    component.ready()
    stream = hal.stream(component, hal.sampler_base, plan["channels"])
    with open("attached", "wb"):
        pass
    session = Session()
    result = {"started": session.start()}
    for step in plan["steps"] if result["started"] else ():
        ((kind, given),) = step.items()
        getattr(session, kind)(given)
    wait_cycles(50)
    session.polled()
    samples = read_samples(stream)
    result |= {"pins": {name: hal.get_value(name) for name in plan["pins"]}, "messages": session.messages}
    with open("samples.f64", "wb") as file:
        samples.tofile(file)
    with open("result.json", "w", encoding="ascii") as file:
        json.dump(result, file)
    del stream
    component.exit()


if __name__ == "__main__":
    sys.exit(main())
