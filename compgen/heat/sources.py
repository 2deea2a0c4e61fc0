"""Where temperatures are: OPC UA, MTConnect, pins of LinuxCNC, and files of loggers that grow; one reading at a time.

A source gives what each sensor reads now, and raises :class:`SourceError` while it cannot be reached: the recorder then tries
again. A sensor that reads nothing (bad quality, UNAVAILABLE, an empty field) is missing from a reading.
"""

from __future__ import annotations

import math
import os
import subprocess
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen
from xml.etree import ElementTree

from compgen.errors import InputError, nearest, visible_line

#: How long a source may take to answer, s, and how much it may send, bytes.
ANSWER_S, MOST_BYTES = 5.0, 4 << 20
#: A line of a logger that is longer is no line of readings.
LONGEST_LINE = 10_000


class SourceError(Exception):
    """A source cannot be reached, or answers nonsense: try again."""


@dataclass(frozen=True)
class Reading:
    """What sensors read, degC by name; ``source_time`` is the clock of the source, None if it has none."""

    celsius: Mapping[str, float]
    source_time: datetime | None = None


class Source(ABC):
    """A place with temperatures; ``keys`` say where each sensor is, by its name."""

    @abstractmethod
    def read(self) -> Reading:
        """What sensors read now.

        Raises
        ------
        SourceError
            while it cannot be reached.
        InputError
            for a key that the source does not have: it will not come by waiting.
        """

    def close(self) -> None:  # noqa: B027 - most sources keep nothing open
        """Let the connection go."""


def source_named(address: str, keys: Mapping[str, str]) -> Source:
    """The source of an address: opc.tcp://..., http://... (MTConnect), hal: (LinuxCNC), or the path of a file that grows."""
    scheme = urlsplit(address).scheme
    if scheme == "opc.tcp":
        return OpcUa(address, keys)
    if scheme in ("http", "https"):
        return MtConnect(address, keys)
    if address == "hal:":
        return Hal(keys)
    if len(scheme) > 1:
        raise InputError(
            f"{visible_line(address)[:60]!r} is no source; expected opc.tcp://HOST:PORT, "
            f"http://HOST:PORT/current (MTConnect), hal: "
            "(LinuxCNC) or the file of a logger",
            field="SOURCE",
        )
    return GrowingFile(Path(address), keys)


# OPC UA.


@dataclass
class OpcUa(Source):
    """Variables of an OPC UA server; keys are node ids such as ``ns=2;s=Spindle.Temperature``."""

    address: str
    keys: Mapping[str, str]
    _client: Any = None

    def read(self) -> Reading:
        """Values of all nodes whose quality is good, and the clock of the server."""
        try:
            from asyncua import ua
            from asyncua.sync import Client
        except ImportError:
            raise InputError(
                "OPC UA needs compgen[opcua] (the package asyncua): pip install 'compgen[opcua]'"
            ) from None
        try:
            if self._client is None:
                client = Client(self.address, timeout=ANSWER_S)
                try:
                    client.connect()
                except BaseException:
                    self._stop(client)
                    raise
                self._client = client
            clock = self._client.get_node(ua.ObjectIds.Server_ServerStatus_CurrentTime).read_value()
            found: dict[str, float] = {}
            for name, key in self.keys.items():
                value = self._client.get_node(self._id(ua, key)).read_data_value(raise_on_bad_status=False)
                if value.StatusCode is not None and value.StatusCode.value == ua.StatusCodes.BadNodeIdUnknown:
                    raise InputError(f"the server has no node {key}", field=f"--sensor {name}")
                good = value.StatusCode is None or value.StatusCode.is_good()
                number = value.Value.Value if good and value.Value is not None else None
                if isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number):
                    found[name] = float(number)
            return Reading(found, clock if clock.tzinfo else clock.replace(tzinfo=UTC))
        except InputError:
            self.close()
            raise
        except Exception as error:  # every fault of the connection has its own class there
            self.close()
            raise SourceError(f"{type(error).__name__} {error}".strip()) from None

    def _id(self, ua: Any, key: str) -> Any:
        try:
            return ua.NodeId.from_string(key)
        except Exception:
            example = "expected e.g. ns=2;s=Spindle.Temperature"
            raise InputError(f"{visible_line(key)[:60]!r} is no node id; {example}", field="--sensor") from None

    def close(self) -> None:
        """Disconnect; a server that is gone cannot be told."""
        client, self._client = self._client, None
        if client is not None:
            with suppress(Exception):
                client.disconnect()
            self._stop(client)

    def _stop(self, client: Any) -> None:
        with suppress(Exception):
            client.tloop.stop()


# MTConnect.


def temperatures_of_mtconnect(text: bytes, keys: Mapping[str, str]) -> Reading:
    """Readings of an MTConnectStreams document (``current`` or ``sample``: the last one of each) by dataItemId or name.

    Elements with any namespace are taken, so that every version of the standard is read. FAHRENHEIT and KELVIN are no units of
    streams: the standard has CELSIUS.
    """
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise SourceError("the answer declares entities, which no agent does")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise SourceError(f"the answer is no XML: {error}") from None
    kind = root.tag.rpartition("}")[2]
    if kind != "MTConnectStreams":
        said = " ".join("".join(root.itertext()).split())[:120]
        raise SourceError(f"the agent answers {kind}: {visible_line(said)}")
    latest: dict[str, tuple[str, str]] = {}
    for element in root.iter():
        for key in {element.get("dataItemId"), element.get("name")} - {None}:
            stamp = element.get("timestamp") or ""
            if element.get("dataItemId") is not None and stamp >= latest.get(str(key), ("", ""))[0]:
                latest[str(key)] = stamp, (element.text or "").strip()
    found: dict[str, float] = {}
    for name, key in keys.items():
        if key not in latest:
            raise InputError(
                f"the agent has no data item {key!r}; {nearest(key, sorted(latest))}", field=f"--sensor {name}"
            )
        with suppress(ValueError):  # UNAVAILABLE
            value = float(latest[key][1])
            found |= {name: value} if math.isfinite(value) else {}
    header = next((item for item in root.iter() if item.tag.rpartition("}")[2] == "Header"), None)
    stated = None if header is None else header.get("creationTime")
    try:
        clock = None if stated is None else datetime.fromisoformat(stated)
    except ValueError:
        clock = None
    return Reading(found, clock if clock is None or clock.tzinfo else clock.replace(tzinfo=UTC))


@dataclass
class MtConnect(Source):
    """An agent of MTConnect: its ``current`` (or ``sample``) over HTTP."""

    address: str
    keys: Mapping[str, str]

    def read(self) -> Reading:
        """Ask once."""
        try:
            with urlopen(Request(self.address, headers={"Accept": "text/xml"}), timeout=ANSWER_S) as answer:
                text = answer.read(MOST_BYTES + 1)
        except (URLError, OSError, ValueError) as error:
            raise SourceError(str(getattr(error, "reason", error))) from None
        if len(text) > MOST_BYTES:
            raise SourceError(
                f"the answer is longer than {MOST_BYTES >> 20} MB; ask for a path of the device, e.g. current?path=..."
            )
        return temperatures_of_mtconnect(text, self.keys)


# LinuxCNC.


@dataclass
class Hal(Source):
    """Pins or signals of a running LinuxCNC, by ``halcmd``."""

    keys: Mapping[str, str]

    def read(self) -> Reading:
        """Ask for each pin, or for the signal of that name."""
        found: dict[str, float] = {}
        for name, key in self.keys.items():
            value = self._asked("getp", key) or self._asked("gets", key)
            if value is None:
                raise SourceError(f"LinuxCNC does not run, or has no pin or signal {key}")
            with suppress(ValueError):
                number = float(value)
                found |= {name: number} if math.isfinite(number) else {}
        return Reading(found)

    def _asked(self, what: str, key: str) -> str | None:
        try:
            done = subprocess.run(["halcmd", what, key], capture_output=True, text=True, timeout=ANSWER_S, check=False)
        except FileNotFoundError:
            raise InputError(
                "halcmd is not installed: temperatures of pins are read on the computer of LinuxCNC"
            ) from None
        except subprocess.TimeoutExpired:
            raise SourceError("halcmd does not answer") from None
        return done.stdout.strip() if done.returncode == 0 and done.stdout.strip() else None


# Files of loggers, and serial ports.


@dataclass
class GrowingFile(Source):
    """The last whole line of a file that grows, or of a serial port; keys are names of its header, or numbers from 1.

    Fields are separated by comma, semicolon, tab or blanks. A decimal comma is read where the separator is another one. A file
    that becomes shorter, or is another one of the same name, is read from its beginning: the logger began anew.
    """

    path: Path
    keys: Mapping[str, str]
    _at: int = 0
    _file: tuple[int, int] = (0, 0)
    _rest: bytes = b""
    _header: list[str] = field(default_factory=list)
    _handle: int | None = None

    def read(self) -> Reading:
        """The last whole line that has come since the last reading; SourceError if none has."""
        try:
            lines = self._new_lines()
        except OSError as error:
            self.close()
            raise SourceError(error.strerror or str(error)) from None
        last = None
        for line in lines:
            fields = fields_of(line)
            if not fields:
                continue
            if not self._header and not any(_is_number(item) for item in fields):
                self._header = fields
            else:
                last = fields
        if last is None:
            raise SourceError("no new line")
        return Reading(
            {name: value for name, key in self.keys.items() if (value := self._field(last, name, key)) is not None}
        )

    def _new_lines(self) -> list[str]:
        if self._handle is None:
            self._handle = os.open(self.path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_NOCTTY", 0))
            opened = os.fstat(self._handle)
            self._file, self._at, self._rest, self._header = (opened.st_dev, opened.st_ino), 0, b"", []
        now = self.path.stat()
        regular = (now.st_mode & 0o170000) == 0o100000
        if (now.st_dev, now.st_ino) != self._file or (regular and now.st_size < self._at):
            self.close()
            return self._new_lines()
        while True:
            try:
                piece = os.read(self._handle, 1 << 16)
            except BlockingIOError:
                break
            if not piece:
                break
            self._at += len(piece)
            self._rest += piece
            self._rest = self._rest[-MOST_BYTES:]
        *whole, self._rest = self._rest.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
        self._rest = self._rest[-LONGEST_LINE:]
        texts = [line.decode("utf-8", "replace").strip() for line in whole if len(line) <= LONGEST_LINE]
        return [text for text in texts if text and not text.startswith("#")]

    def _field(self, fields: Sequence[str], name: str, key: str) -> float | None:
        if key.isdigit() and int(key) >= 1:
            place = int(key) - 1
        elif key in self._header:
            place = self._header.index(key)
        else:
            known = (
                f"; {nearest(key, self._header)}" if self._header else "; the file has no header, give a number from 1"
            )
            raise InputError(
                f"there is no column {visible_line(key)[:40]!r}{known}", file=self.path, field=f"--sensor {name}"
            )
        if place >= len(fields):
            return None
        text = fields[place]
        return float(text.replace(",", ".")) if _is_number(text) else None

    def close(self) -> None:
        """Close the file; the next reading begins anew."""
        if self._handle is not None:
            os.close(self._handle)
        self._handle = None


def fields_of(line: str) -> list[str]:
    """Fields of a line of a logger.

    >>> fields_of("12:00; 21,5; 22,0"), fields_of("21.5, 22"), fields_of("21.5 22.0")
    (['12:00', '21,5', '22,0'], ['21.5', '22'], ['21.5', '22.0'])
    """
    for mark in (";", "\t", ","):
        if mark in line:
            return [item.strip().strip('"') for item in line.split(mark)]
    return line.split()


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text.replace(",", ".")))
    except ValueError:
        return False
