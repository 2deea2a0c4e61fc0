"""A job with a model of heat and logged temperatures: measurements are corrected, channels are joined, gaps are failures."""

from contextlib import closing
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from test_recal_commands import MACHINE, site  # noqa: F401

from compgen.data.deviations import Deviations, format_deviations
from compgen.data.machine import load_machine
from compgen.fleet.inbox import measurement_of
from compgen.fleet.job import read_job
from compgen.fleet.store import open_store
from compgen.kinematics.exact_chain import exact_error
from compgen.kinematics.many_points import volume_grid

BEGIN = datetime.now(UTC).replace(microsecond=0) - timedelta(hours=5)
MODEL = """format = 1
machine = "{name}"
[[terms]]
sensor = "spindle"
lag_s = 0.0
start = "spindle"
dz_um_per_k = 4.0
[[hull]]
sensor = "spindle"
low_c = 18.0
high_c = 30.0
[left_out.dz]
before_rms = 9.0
after_rms = 0.1
covariance = [[0.01]]
"""


def log(path, hours=1.0):
    rows = []
    for minute in range(0, int(60 * hours) + 1, 5):
        time = (BEGIN + timedelta(minutes=minute)).isoformat()
        rows.append(f"{time},{20 + 6 * minute / 60:.3f},{20.5 + minute / 60:.3f}")
    path.write_text("time,temp_spindle_c,temp_x_c\n" + "\n".join(rows) + "\n")


@pytest.fixture
def warm(site, small_errors):  # noqa: F811
    """A job with both keys, and a measurement during which the spindle warms by 6 K."""
    machine = load_machine("mill.toml")
    (site.folder / "mill.heat.toml").write_text(MODEL.format(name=machine.name))
    (site.folder / "logs").mkdir()
    site.job.write_text(MACHINE + 'heat = "mill.heat.toml"\ntemperatures = "logs"\n')
    position = volume_grid(machine, tuple(axis.nodes_mm for axis in machine.axes)).position_mm
    position = position[np.argsort(position[:, 0], kind="stable")]
    time_s = np.linspace(0, 3600, len(position))
    noise = np.random.default_rng(1).normal(0.0, 3e-4, position.shape)
    deviation = exact_error(machine, small_errors, position) + noise
    deviation[:, 2] += 4e-3 * 6 * time_s / 3600
    said = {"time_zero": BEGIN.isoformat(), "measured_at": BEGIN.isoformat(), "active_table": "none"}
    deviations = Deviations(
        position, deviation, u_mm=np.full_like(noise, 3e-4), covariates={"time_s": time_s}, metadata=said
    )
    (site.folder / "inbox" / "a.deviations.csv").write_text(format_deviations(deviations))
    return site


def test_a_job_takes_heat_out_and_keeps_the_temperatures_of_its_scales(warm):
    log(warm.folder / "logs" / "a.temperatures.csv")
    assert warm.call("run") == 0
    with closing(open_store(read_job(warm.job).store)) as store:
        machine = store.machine("mill")
        (measurement,) = store.measurements(machine)
        (found,) = store.identifications(machine)
    assert measurement.temperatures_c["temp_x_c"]["mean"] == pytest.approx(21.0, abs=0.01)
    assert found.summary["corrections"]["heat"]["largest_um"]["dz"] == pytest.approx(24.0, abs=0.01)


def test_a_measurement_without_temperatures_at_its_time_is_a_failure_that_says_so(warm, capsys):
    log(warm.folder / "logs" / "a.temperatures.csv", hours=0.5)
    assert warm.call("run") == 1
    assert "no temperature is known" in " ".join(capsys.readouterr())


def test_a_file_without_temperatures_gets_those_of_the_log_and_one_with_them_keeps_its_own(tmp_path):
    log(tmp_path / "a.temperatures.csv")
    head = f"# time_zero = {BEGIN.isoformat()}\n".encode()
    body = b"x_mm,time_s\n1,0\n2,1800\n"
    found = measurement_of("a", {"a.csv": head + body}, BEGIN, tmp_path / "a.temperatures.csv")
    assert found.temperatures_c == {"temp_x_c": pytest.approx({"low": 20.5, "mean": 20.75, "high": 21.0}, abs=1e-3)}
    own = head + b"x_mm,time_s,temp_x_c\n1,0,30\n2,1800,30\n"
    assert (
        measurement_of("a", {"a.csv": own}, BEGIN, tmp_path / "a.temperatures.csv").temperatures_c["temp_x_c"]["mean"]
        == 30
    )
    assert measurement_of("a", {"a.csv": body}, BEGIN, tmp_path / "a.temperatures.csv").temperatures_c == {}


def test_settings_are_others_with_another_model(warm):
    before = read_job(warm.job).machines["mill"].settings_sha256()
    path = warm.folder / "mill.heat.toml"
    path.write_text(path.read_text().replace("4.0", "4.1"))
    assert read_job(warm.job).machines["mill"].settings_sha256() != before
