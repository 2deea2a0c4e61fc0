"""Prometheus metrics of the dashboard, of the fleet and of a long-running recalibration."""

from __future__ import annotations

import threading
from collections import Counter as Tally
from collections.abc import Callable, Iterator
from socketserver import ThreadingMixIn
from typing import TYPE_CHECKING, Any, get_args
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from compgen.errors import CompgenError, InputError
from compgen.fleet import logs
from compgen.fleet.records import TableState
from compgen.fleet.status import STATUSES, fleet
from compgen.fleet.store import Store
from compgen.web.guard import HOST
from compgen.web.site import LOCAL_NAMES

if TYPE_CHECKING:
    from compgen.fleet.runner import MachineOutcome

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
STATES: tuple[TableState, ...] = get_args(TableState)


class FleetCollector(Collector):
    """Read the store when the metrics are read; one metric says whether the store can be reached."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def describe(self) -> list[Any]:
        """Return nothing: the store is not read before somebody reads the metrics."""
        return []

    def collect(self) -> Iterator[GaugeMetricFamily]:
        """Return the gauges of the fleet."""
        up = GaugeMetricFamily("compgen_store_up", "Whether the store could be read.")
        try:
            found = fleet(self._store)
        except CompgenError:
            up.add_metric([], 0.0)
            yield up
            return
        up.add_metric([], 1.0)
        yield up
        rows = found.rows
        counts = Tally(row.status for row in rows)
        machines = GaugeMetricFamily("compgen_machines", "Machines by status.", labels=["status"])
        for status in STATUSES:
            machines.add_metric([status], counts[status])
        yield machines
        tables = GaugeMetricFamily("compgen_tables", "Sets of tables by state.", labels=["state"])
        for state in STATES:
            tables.add_metric([state], found.states.get(state, 0))
        yield tables
        measured = GaugeMetricFamily(
            "compgen_last_measurement_timestamp_seconds", "When the newest measurement was made.", labels=["machine"]
        )
        active = GaugeMetricFamily(
            "compgen_active_version", "Version of the active tables, 0 if none.", labels=["machine"]
        )
        waiting = GaugeMetricFamily(
            "compgen_waiting_tables", "Versions of tables that wait for a decision.", labels=["machine"]
        )
        failed = GaugeMetricFamily(
            "compgen_last_attempt_failed", "Whether the last attempt failed.", labels=["machine"]
        )
        for row in rows:
            name = [row.machine.name]
            if row.measured_at is not None:
                measured.add_metric(name, row.measured_at.timestamp())
            active.add_metric(name, float(row.active or 0))
            waiting.add_metric(name, float(len(row.waiting)))
            failed.add_metric(name, 1.0 if row.failure else 0.0)
        yield from (measured, active, waiting, failed)


class _Metrics:
    def __init__(self) -> None:
        self.registry = CollectorRegistry(auto_describe=False)

    def text(self) -> bytes:
        """Return everything in the text format of Prometheus."""
        return generate_latest(self.registry)


class ServeMetrics(_Metrics):
    """What the dashboard counts about itself, and the fleet."""

    def __init__(self, store: Store, sessions: Callable[[], int]) -> None:
        super().__init__()
        self.requests = Counter(
            "compgen_http_requests", "Requests.", ["endpoint", "method", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "compgen_http_request_seconds", "Time of requests, s.", ["endpoint"], registry=self.registry
        )
        self.logins = Counter("compgen_logins", "Logins by outcome.", ["outcome"], registry=self.registry)
        self.decisions = Counter(
            "compgen_dashboard_decisions", "Decisions made on this dashboard.", ["kind"], registry=self.registry
        )
        self.refused = Counter(
            "compgen_refused_requests", "Requests refused by reason.", ["reason"], registry=self.registry
        )
        Gauge("compgen_sessions", "Users logged in.", registry=self.registry).set_function(sessions)
        self.registry.register(FleetCollector(store))


class WatchMetrics(_Metrics):
    """What ``volcomp recal watch`` counts; give :meth:`count` to it as ``on_outcome``."""

    def __init__(self, store: Store | None = None) -> None:
        super().__init__()
        self.passes = Counter(
            "compgen_recal_passes", "Passes by outcome.", ["machine", "state"], registry=self.registry
        )
        self.measurements = Counter(
            "compgen_recal_measurements", "Measurements processed.", ["machine"], registry=self.registry
        )
        self.seconds = Histogram(
            "compgen_recal_pass_seconds",
            "Time of a pass over one machine, s.",
            buckets=(0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0),
            registry=self.registry,
        )
        self.last = Gauge(
            "compgen_recal_last_pass_timestamp_seconds", "When a machine was last checked.", ["machine"],
            registry=self.registry,
        )  # fmt: skip
        if store is not None:
            self.registry.register(FleetCollector(store))

    def count(self, outcome: MachineOutcome) -> None:
        """Count one pass over one machine."""
        self.passes.labels(outcome.machine, outcome.state).inc()
        self.measurements.labels(outcome.machine).inc(len(outcome.processed))
        self.seconds.observe(outcome.seconds)
        self.last.labels(outcome.machine).set_to_current_time()


class _Threads(ThreadingMixIn, WSGIServer):
    """A thread for each request: a slow reader keeps nobody else waiting."""

    daemon_threads = True


class _Quiet(WSGIRequestHandler):
    timeout = 10

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: metrics are read every few seconds."""


def start_metrics(text: Callable[[], bytes], port: int, host: str = "127.0.0.1") -> tuple[int, Callable[[], None]]:
    """Serve metrics at ``/metrics`` in a separate thread.

    The server of ``prometheus_client`` answers requests for any host name (DNS rebinding); this one does not.

    Returns
    -------
    The port (chosen by the system if ``port`` is 0) and a function that stops the server.

    Raises
    ------
    InputError
        if the port cannot be used.
    """

    def answer(environ: dict[str, Any], start_response: Any) -> list[bytes]:
        headers = [("X-Content-Type-Options", "nosniff"), ("Cache-Control", "no-store")]

        def say(status: str, body: bytes, kind: str = "text/plain") -> list[bytes]:
            start_response(status, [("Content-Type", kind), *headers])
            return [] if environ["REQUEST_METHOD"] == "HEAD" else [body]

        name = HOST.fullmatch(environ.get("HTTP_HOST", ""))
        if name is None or name["name"].lower() not in (*LOCAL_NAMES, host):
            return say("421 Misdirected Request", b"this server is not known by that name\n")
        if environ["PATH_INFO"] != "/metrics" or environ["REQUEST_METHOD"] not in ("GET", "HEAD"):
            return say("404 Not Found", b"metrics are at /metrics\n")
        try:
            return say("200 OK", text(), CONTENT_TYPE)
        except Exception as error:  # the recalibration continues after any error
            logs.error("metrics", problem=f"{type(error).__name__}: {error}")
            return say("500 Internal Server Error", b"the log says more\n")

    try:
        server = make_server(host, port, answer, server_class=_Threads, handler_class=_Quiet)
    except OSError as error:
        raise InputError(f"{host}:{port} cannot be used: {error.strerror or error}", field="--metrics-port") from error
    thread = threading.Thread(target=server.serve_forever, name="metrics", daemon=True)
    thread.start()

    def stop() -> None:
        server.shutdown()
        server.server_close()
        thread.join()

    return server.server_port, stop
