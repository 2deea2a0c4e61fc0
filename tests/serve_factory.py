"""A store for tests of the dashboard: machines with tables in every state, and texts that try to break pages."""

import json
from datetime import UTC, datetime, timedelta

from compgen.fleet import claims, decisions
from compgen.fleet import claims as results
from compgen.fleet.records import NewMeasurement, NewResult, StoredTableFile
from compgen.fleet.store import open_store

EVIL = "<script>document.title='broken'</script>\"'><img src=x onerror=alert(1)>{{7*7}}"
MACHINE_TOML = b"""\
name = "mill"
chain = "WFYXZT"
tool_offset_mm = [0.0, 0.0, -80.0]
reference_point_mm = [0.0, 0.0, 0.0]
errors = ["EXX", "EC0Y"]
[axes.X]
range_mm = [0.0, 500.0]
nodes = 6
[axes.Y]
range_mm = [0.0, 400.0]
nodes = 5
[axes.Z]
range_mm = [-300.0, 0.0]
nodes = 4
"""
BEGIN = datetime(2026, 1, 10, 8, 0, tzinfo=UTC)


def errors_text(squareness_urad, scale):
    """An *.errors.csv text: one squareness error and one positioning error, um and urad."""
    rows = [f"EXX,{x},{scale * x / 100.0:.4f},0.3" for x in range(0, 600, 100)]
    return ("error,position_mm,value,u_value\n" + "\n".join(rows) + f"\nEC0Y,,{squareness_urad},0.8\n").encode()


def judgement(before_um, after_um):
    """Figures as the recalibration keeps them."""

    def figures(factor):
        return {"rms_um": factor, "p95_um": 2 * factor, "max_um": 3 * factor, "v_x_um": 2.5 * factor}

    return {
        "change": {"rms_um": 4.2, "expected_rms_um": 0.9, "p_value": 0.001, "significant": True},
        "remaining": {"isg-csv": {"active": {"as_it_stands": figures(before_um)}, "proposed": {}}},
        "correction": {"isg-csv": {"max_change_um": 7.5, "reference_change_um": {"x": -0.5, "y": 0.25, "z": 0.0}}},
        "result": {"isg-csv": {"accepted": True, "before": figures(4 * before_um), "after": figures(after_um)}},
    }


def add(store, machine, number, *, approve=False, hold=(), accepted=True, name=None, file="table.csv", content=None):
    """Keep one measurement with its result and return the set of tables."""
    at = BEGIN + timedelta(days=30 * number)
    warm = {"temp_x_c": {"low": 19.5 + number, "mean": 20.0 + number, "high": 20.5 + number}}
    contents = {"a.lengths.csv": f"{machine.name} {number}".encode()}
    digest = f"{machine.id:032d}{number:032d}"
    measurement = store.add_measurement(
        machine, NewMeasurement(digest, name or f"{number}.lengths.csv", at, "file", contents, None, warm)
    )
    claim = claims.take(store, measurement, claims.owner_name())
    active = decisions.active_table(store, machine)
    text = content or f"; table {number}\n0 1.0\n100 {number}.0\n".encode()
    new = NewResult(
        machine_text=MACHINE_TOML,
        errors_text=errors_text(10.0 + 3.0 * number, 1.0 + 0.2 * number),
        covariance=None,
        fitted_text=None,
        summary={},
        program="test",
        active_table_id=None if active is None else active.id,
        files=[
            StoredTableFile("isg-csv", file, text),
            StoredTableFile("isg-csv", "preflight.md", b"# same in every version\n"),
        ],
        accepted=accepted,
        hold=list(hold),
        judgement=judgement(6.0, 1.5),
        approve=approve,
        settings_sha256="0",
        seconds=1.0,
    )
    return results.keep_result(store, machine, claim, new, None if active is None else active.id)


def make_factory(path):
    """Open a store with four machines: one with a pending version 3, one held back, one refused, one that is evil."""
    store = open_store(str(path))
    mill = store.add_machine("mill-1")
    add(store, mill, 1, approve=True)
    second = add(store, mill, 2)
    decisions.approve(store, mill, second.version, "meyer", "looks right")
    add(store, mill, 3)
    held = store.add_machine("mill-2")
    add(store, held, 1, approve=True)
    add(store, held, 2, hold=["the measurement is 40.0 days old; at most 30 are allowed"])
    refused = store.add_machine("mill-3")
    add(store, refused, 1, accepted=False, hold=["a limit of the control is violated"])
    evil = store.add_machine(EVIL[:150])
    add(store, evil, 1, approve=True)
    add(store, evil, 2, name=EVIL, hold=[EVIL], file='../../etc/pass\r\nX-Evil: 1;"wd', content=EVIL.encode())
    store.add_event("unreadable", EVIL, EVIL, evil)
    failed = store.add_machine("mill-5")
    content = {"broken.lengths.csv": b"broken"}
    broken = store.add_measurement(failed, NewMeasurement("f" * 64, "broken", BEGIN, "file time", content))
    claim = claims.take(store, broken, claims.owner_name())
    results.keep_failure(store, failed, claim, f"broken.lengths.csv:3: {EVIL}", "0", 0.1)
    return store


def everything(store):
    """Everything that a request could have changed, as text."""
    parts = (store.machines(), store.measurements(), store.tables(), store.decisions(), store.events())
    return json.dumps([[str(item) for item in part] for part in parts])
