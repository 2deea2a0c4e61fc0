"""Temperatures from where they are: an OPC UA server that restarts, an agent, LinuxCNC, files that grow, clocks, Ctrl-C."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from compgen.cli import cli
from compgen.cli.common import run_command
from compgen.errors import InputError
from compgen.heat import read_temperatures
from compgen.heat.recorder import Recorder
from compgen.heat.sources import GrowingFile, Reading, Source, SourceError, source_named, temperatures_of_mtconnect

BEGIN = datetime(2026, 3, 2, 6, 30, tzinfo=UTC)


class Clock:
    """A computer whose time passes when something waits; ``stop`` is set after so many seconds."""

    def __init__(self, ends_s):
        self.s, self.ends_s, self.set_back_s = 0.0, ends_s, 0.0

    def now(self):
        return BEGIN + timedelta(seconds=self.s - self.set_back_s)

    def wait(self, seconds):
        self.s += seconds
        return self.is_set()

    def is_set(self):
        return self.s >= self.ends_s


class Script(Source):
    """Readings by the time of the clock; a text is a failure."""

    def __init__(self, clock, says):
        self.clock, self.says = clock, says

    def read(self):
        found = self.says(self.clock.s)
        if isinstance(found, str):
            raise SourceError(found)
        return found


def recorded(tmp_path, says, *, ends_s=100.0, interval_s=10.0, sensors=("a",), clock=None):
    clock = clock or Clock(ends_s)
    file = tmp_path / "day.temperatures.csv"
    recorder = Recorder(Script(clock, says), sensors, file, interval_s, "opc.tcp://here", lambda: clock.s, clock.now)
    return recorder.run(clock, 1e6, lambda text: None), file


def test_rows_are_read_back_as_temperatures(tmp_path):
    done, file = recorded(tmp_path, lambda s: Reading({"a": 20 + s / 10}))
    read = read_temperatures(file)
    assert done.rows == len(read) == 10
    assert read.celsius["a"].tolist() == pytest.approx([20.0 + k for k in range(10)])
    assert read.since == BEGIN.timestamp()


@pytest.mark.filterwarnings("ignore::compgen.errors.CompgenWarning")
def test_a_gap_is_marked_and_the_reader_sees_it(tmp_path):
    done, file = recorded(
        tmp_path, lambda s: "connection = refused" if 30 < s < 2000 else Reading({"a": 20.0 + s}), ends_s=2200
    )
    assert len(done.gaps) == 1
    text = file.read_text()
    assert "# gap 2026-03-02T06:30:30.000+00:00 to 2026-03-02T07:03" in text
    assert "connection : refused" in text
    assert len(read_temperatures(file)) == 4  # up to the gap, which is too long to be bridged


def test_what_no_sensor_reads_is_left_empty(tmp_path):
    done, file = recorded(
        tmp_path, lambda s: Reading({"a": 20 + s / 100, "b": 999.0 if s == 50 else 21.0}), sensors=("a", "b")
    )
    assert done.implausible == 1
    assert any(line.endswith(",") for line in file.read_text().splitlines())


def test_the_clock_of_the_source_is_noted(tmp_path):
    done, file = recorded(tmp_path, lambda s: Reading({"a": 20.0 + s}, BEGIN + timedelta(seconds=s - 90)))
    assert done.clock_offset_s == pytest.approx(-90.0)
    assert "# source_clock_minus_ours_s = -90.000" in file.read_text()
    assert any("-90.0 s off" in line for line in done.lines())


def test_times_rise_even_if_this_clock_is_set_back(tmp_path):
    clock = Clock(100.0)

    def says(s):
        clock.set_back_s = 25.0 if s >= 40 else 0.0
        return Reading({"a": 20.0 + s})

    _, file = recorded(tmp_path, says, clock=clock)
    assert len(read_temperatures(file)) == 8  # 0 to 30 s, then from 60 s on, of which 35 s is the first time that rises


def test_a_source_that_never_answers_leaves_no_file(tmp_path):
    done, file = recorded(tmp_path, lambda s: "refused")
    assert (done.rows, file.exists()) == (0, False)


def test_a_day_that_is_there_is_not_overwritten(tmp_path):
    file = tmp_path / "day.temperatures.csv"
    file.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        recorded(tmp_path, lambda s: Reading({"a": 20.0}))
    assert file.read_text() == "mine"


# --- OPC UA ------------------------------------------------------------------------------------------------------------


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_opc_ua_server_is_read_and_read_again_after_it_restarted():
    sync = pytest.importorskip("asyncua.sync")
    ua = sync.ua
    port, loop = free_port(), sync.ThreadLoop()
    loop.start()
    server = sync.Server(tloop=loop)
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = server.register_namespace("shop")
    node = server.nodes.objects.add_variable(ua.NodeId("Spindle", space), "Spindle", 21.5)
    address = f"opc.tcp://127.0.0.1:{port}"
    source = source_named(address, {"spindle": f"ns={space};s=Spindle"})
    try:
        server.start()
        reading = source.read()
        assert reading.celsius == {"spindle": 21.5}
        assert abs((reading.source_time - datetime.now(UTC)).total_seconds()) < 60
        node.write_value(ua.DataValue(ua.Variant(30.0), StatusCode=ua.StatusCode(ua.StatusCodes.BadSensorFailure)))
        assert source.read().celsius == {}
        server.stop()
        with pytest.raises(SourceError):
            source.read()
        server.start()
        node.write_value(25.25)
        assert source.read().celsius == {"spindle": 25.25}
        source.close()
        with pytest.raises(InputError, match="no node"):
            source_named(address, {"spindle": "ns=2;s=Absent"}).read()
        with pytest.raises(InputError, match="no node id"):
            source_named(address, {"spindle": "Spindle"}).read()
    finally:
        source.close()
        server.stop()
        loop.stop()


# --- MTConnect ---------------------------------------------------------------------------------------------------------

STREAMS = """<?xml version="1.0"?>
<MTConnectStreams xmlns="urn:mtconnect.org:MTConnectStreams:1.3">
<Header creationTime="2026-03-02T06:31:00Z" sender="agent" instanceId="1" version="1.3" bufferSize="9" nextSequence="9"
 firstSequence="1" lastSequence="8"/>
<Streams><DeviceStream name="mill" uuid="m"><ComponentStream component="Spindle" name="S" componentId="s"><Samples>
<Temperature dataItemId="t1" timestamp="2026-03-02T06:30:00Z" name="Stemp" sequence="3">24.5</Temperature>
<Temperature dataItemId="t1" timestamp="2026-03-02T06:30:50Z" name="Stemp" sequence="5">25.5</Temperature>
<Temperature dataItemId="t2" timestamp="2026-03-02T06:30:50Z" sequence="6">UNAVAILABLE</Temperature>
</Samples></ComponentStream></DeviceStream></Streams></MTConnectStreams>"""
ERROR = (
    '<MTConnectError xmlns="urn:mtconnect.org:MTConnectError:1.3"><Errors><Error errorCode="X">no device</Error></Errors>'
    "</MTConnectError>"
)


def test_an_agents_answer_gives_the_last_sample_of_each_item():
    found = temperatures_of_mtconnect(STREAMS.encode(), {"spindle": "Stemp", "again": "t1", "bed": "t2"})
    assert found.celsius == {"spindle": 25.5, "again": 25.5}
    assert found.source_time == BEGIN + timedelta(seconds=60)
    with pytest.raises(InputError, match="no data item 'T9'"):
        temperatures_of_mtconnect(STREAMS.encode(), {"spindle": "T9"})
    for text, said in ((ERROR, "no device"), ("<a", "no XML"), ('<!DOCTYPE a [<!ENTITY b "c">]><a/>', "entities")):
        with pytest.raises(SourceError, match=said):
            temperatures_of_mtconnect(text.encode(), {"spindle": "t1"})


class Agent(BaseHTTPRequestHandler):
    status = 200

    def do_GET(self):
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(STREAMS.encode())

    def log_message(self, *_):
        pass


def test_an_agent_is_asked_over_http_and_its_failures_are_retried():
    server = HTTPServer(("127.0.0.1", 0), Agent)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    source = source_named(f"http://127.0.0.1:{server.server_port}/current", {"spindle": "t1"})
    try:
        assert source.read().celsius == {"spindle": 25.5}
        Agent.status = 503
        with pytest.raises(SourceError, match="Unavailable"):
            source.read()
    finally:
        Agent.status = 200
        server.shutdown()
        server.server_close()
        thread.join()
    with pytest.raises(SourceError):
        source.read()


# --- files and pins ------------------------------------------------------------------------------------------------------


def test_a_file_that_grows_gives_its_last_whole_line(tmp_path):
    file = tmp_path / "logger.csv"
    source = GrowingFile(file, {"spindle": "T1", "bed": "3"})
    with pytest.raises(SourceError, match="No such file"):
        source.read()
    file.write_text("Time;T1;T2\n12:00;21,5;20\n12:01;21,75;20,5\n12:02;2")
    assert source.read().celsius == {"spindle": 21.75, "bed": 20.5}
    with pytest.raises(SourceError, match="no new line"):
        source.read()  # the half line is no reading: 2 for 21
    with file.open("a") as more:
        more.write("2,0;20,6\n12:03;;20,7\n")
    assert source.read().celsius == {"bed": 20.7}
    file.write_text("Time;T1;T2\n12:09;30;31\n")  # the logger began anew
    assert source.read().celsius == {"spindle": 30.0, "bed": 31.0}
    source.close()
    with pytest.raises(InputError, match="no column 'T7'"):
        GrowingFile(file, {"a": "T7"}).read()


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no serial ports to try")
def test_a_serial_port_is_read_as_a_file_that_grows():
    ours, theirs = os.openpty()
    source = GrowingFile(Path(os.ttyname(theirs)), {"a": "1", "b": "2"})
    with pytest.raises(SourceError):
        source.read()
    os.write(ours, b"21.5 22.5\r\n21.6 2")
    time.sleep(0.05)
    assert source.read().celsius == {"a": 21.5, "b": 22.5}
    source.close()
    os.close(ours)
    os.close(theirs)


def test_pins_are_asked_by_halcmd(tmp_path, monkeypatch):
    (tmp_path / "halcmd").write_text('#!/bin/sh\n[ "$1 $2" = "getp therm.0" ] && echo 23.25 && exit 0\nexit 1\n')
    (tmp_path / "halcmd").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert source_named("hal:", {"spindle": "therm.0"}).read().celsius == {"spindle": 23.25}
    with pytest.raises(SourceError, match="no pin or signal absent"):
        source_named("hal:", {"spindle": "absent"}).read()
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    with pytest.raises(InputError, match="halcmd"):
        source_named("hal:", {"spindle": "therm.0"}).read()


# --- the command ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["log.csv", "--sensor", "a", "--out", "o.csv"], "no sensor"),
        (["log.csv", "--sensor", "a=1", "--sensor", "temp_a_c=2", "--out", "o.csv"], "twice"),
        (["log.csv", "--sensor", "a=1", "--out", "o.txt"], "temperatures.csv"),
        (["log.csv", "--sensor", "a=1", "--out", "o.csv", "--interval", "0"], "3600"),
        (["log.csv", "--sensor", "a=1", "--out", f"{__file__}/o.csv"], "is a file"),
        (["ftp://here", "--sensor", "a=1", "--out", "o.csv"], "no source"),
    ],
)
def test_wrong_usage_writes_nothing(tmp_path, monkeypatch, capsys, words, said):
    monkeypatch.chdir(tmp_path)
    assert run_command(cli, ["log", *words]) == 2
    assert said in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_folder_of_the_file_is_made_with_the_first_reading(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["log", "log.csv", "--sensor", "a=T", "--interval", "0.1", "--hours", "0.0001"]
    assert run_command(cli, [*words, "--out", "new/o.csv"]) == 1
    assert "nothing was read" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "log.csv").write_text("T\n20.5\n")
    assert run_command(cli, [*words, "--out", "new/o.csv"]) == 0
    assert "20.5" in (tmp_path / "new" / "o.csv").read_text()


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_ends_cleanly_with_whole_lines(tmp_path):
    (tmp_path / "logger.csv").write_text("T\n20.5\n")
    code = (
        "import sys; sys.argv = ['volcomp', 'log', 'logger.csv', '--sensor', 'a=T', '--out', 'day.temperatures.csv', "
    )
    code += "'--interval', '0.1', '--json']; from compgen.__main__ import main; main()"
    running = subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    end = time.monotonic() + 60
    rows = 0
    while rows < 3 and time.monotonic() < end:
        with (tmp_path / "logger.csv").open("a") as more:
            more.write("21.5\n")
        file = tmp_path / "day.temperatures.csv"
        rows = len([line for line in file.read_text().splitlines() if line[:1].isdigit()]) if file.exists() else 0
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    out, _ = running.communicate(timeout=60)
    assert running.returncode == 0
    data = json.loads(out)
    text = file.read_text()
    assert text.endswith("\n")
    assert data["rows"] == len([line for line in text.splitlines() if line[:1].isdigit()]) >= 3
    assert len(read_temperatures(file)) == data["rows"]
