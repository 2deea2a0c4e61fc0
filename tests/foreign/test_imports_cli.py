"""`volcomp import`, and commands that are given foreign files: from file to tables in one command."""

import json
import re
import tracemalloc
from pathlib import Path

import numpy as np
import openpyxl
import pytest

from compgen.data.error_table import read_errors

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = ROOT / "tests" / "golden" / "imports"
VENDOR = ROOT / "tests" / "golden" / "etalon-exchange" / "vendor.etalon.txt"
NANOMETRE_MM = 1e-6
MACHINE = """\
name = "imported"
chain = "WFYXZT"
[axes.X]
range_mm = [0.0, 400.0]
nodes = 5
[axes.Y]
range_mm = [-280.0, 270.0]
nodes = 5
[axes.Z]
range_mm = [-240.0, 0.0]
nodes = 5
"""


@pytest.fixture
def machine(tmp_path):
    path = tmp_path / "machine.toml"
    path.write_text(MACHINE)
    return str(path)


def test_import_shows_what_it_understood_and_writes_nothing_without_out(call, tmp_path, listing):
    before = listing(tmp_path)
    code, out, err = call("import", GOLDEN / "linear.rtl")
    assert code == 0
    for line in ("axis: X", "targets: 5", "runs: 5", "directions: both", "unit: um", "sign: measured minus target"):
        assert line in out
    assert err == ""
    assert listing(tmp_path) == before


def test_import_as_json_is_one_object_and_writes_the_contract_file(call, tmp_path, machine):
    code, out, _ = call("import", GOLDEN / "german.csv", "--machine", machine, "--out", tmp_path / "o", "--json")
    facts = json.loads(out)
    assert code == 0
    assert facts["kind"] == "axis"
    assert facts["doubts"] == []
    assert facts["machine"] == {"name": "imported", "outside": []}
    assert facts["files"] == [str(tmp_path / "o" / "german.axis.csv")]


def test_import_writes_nothing_while_something_is_open(call, tmp_path):
    code, out, _ = call("import", GOLDEN / "ecmc_ISO230.dat", "--out", tmp_path / "o")
    assert code == 2
    assert "give --axis" in out
    assert not (tmp_path / "o").exists()
    code, _, _ = call("import", GOLDEN / "ecmc_ISO230.dat", "--axis", "y", "--out", tmp_path / "o")
    assert code == 0
    assert (tmp_path / "o" / "ecmc_ISO230.axis.csv").exists()


def test_positions_beyond_the_travel_are_named(call, tmp_path, machine):
    path = tmp_path / "x.csv"
    path.write_text("position [mm],deviation [um],axis\n0,1,X\n4000,2,X\n")
    code, out, _ = call("import", path, "--machine", machine, "--out", tmp_path / "o")
    assert code == 2
    assert "0 to 4000 mm, but imported travels from 0 to 400 mm" in out
    assert not (tmp_path / "o").exists()


OWN = {
    "lengths": ROOT / "examples" / "zha-gantry.lengths.csv",
    "sixdof": ROOT / "examples" / "jia-xytz.sixdof.csv",
    "errors": ROOT / "examples" / "jia-xytz.truth.errors.csv",
    "part": "# origin_mm = -400, -500, -120\nx_mm,y_mm,mx_mm,my_mm\n10,10,10.013,9.998\n10,250,9.999,250.006\n90,10,90,10\n",
    "axis": "axis,position_mm,direction,run,deviation_um\nX,-800,1,1,2.5\nX,0,1,1,-1\n",
    "deviations": "x_mm,y_mm,z_mm,dx_um\n-800,0,0,1\n0,0,0,2\n",
    "diagonals": "diagonal,x_mm,y_mm,z_mm,direction,run,deviation_um\nPPP,-800,-1000,-350,1,1,0\nPPP,0,0,0,1,1,7\n",
}


@pytest.mark.parametrize("kind", OWN)
def test_files_of_the_own_format_are_shown_and_copied(call, tmp_path, kind):
    path = OWN[kind]
    if isinstance(path, str):
        path = tmp_path / f"a.{kind}.csv"
        path.write_text(OWN[kind])
    code, out, err = call("import", path, "--out", tmp_path / "o", "--json")
    assert code == 0, err
    facts = json.loads(out)
    assert (facts["format"], facts["kind"]) == ("compgen", kind)
    names = [line for line in path.read_text().splitlines() if not line.startswith("#")][0].split(",")
    assert list(facts["understood"]["columns"]) == names
    assert facts["files"] == [str(tmp_path / "o" / path.name)]
    assert (tmp_path / "o" / path.name).read_text() == path.read_text()
    code, out, _ = call("import", path)
    assert code == 0
    assert f"compgen, {kind}" in out
    assert "the other commands read it directly" in out


def test_damaged_own_files_options_that_convert_and_unknown_sheets_are_usage_errors(call, tmp_path):
    path = tmp_path / "a.axis.csv"
    path.write_text(OWN["axis"].replace("2.5", "x"))
    code, _, err = call("import", path, "--out", tmp_path / "o")
    assert code == 2
    assert "a.axis.csv:2: column deviation_um: 'x' is not a number" in err
    assert not (tmp_path / "o").exists()
    code, _, err = call("import", OWN["lengths"], "--sign", "correction")
    assert code == 2
    assert "--sign: is already in the native format (lengths)" in err
    code, _, err = call("import", OWN["lengths"], "--machine", "jia-xytz", "--out", tmp_path / "o")
    assert code == 2
    code, _, err = call("import", GOLDEN / "wide.xlsx", "--sheet", "Q", "--json")
    assert code == 2
    assert "no sheet 'Q'" in err


@pytest.mark.parametrize("name", ["linear.rtl", "wide.xlsx", "german.csv"])
def test_from_a_foreign_measurement_to_accepted_tables_in_one_command(call, tmp_path, machine, name):
    words = ["run", machine, GOLDEN / name, "--controller", "isg-csv", "--smoothness", "0", "--json", "--out"]
    code, out, _ = call(*words, tmp_path / "refused")  # the runs of the golden example scatter widely
    assert (code, [item["code"] for item in json.loads(out)["objections"] if item["blocking"]]) == (
        1,
        ["residual_too_large"],
    )
    code, out, err = call(*words, tmp_path / "o", "--allow-misfit")
    assert code == 0, err
    facts = json.loads(out)
    assert facts["accepted"] is True
    assert "was read as" in err
    assert facts["identify"]["method"] == "axis-runs"
    assert facts["before"]["v_x_um"] == pytest.approx(8.0, abs=1e-6)  # M of ISO 230-2 in the golden example
    assert facts["after"]["max_um"] < 0.01
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    assert [round(1e3 * value, 9) for value in errors.curves["EXX"].value] == [0.0, 3.5, -2.0, -4.5, 3.0]


def test_from_an_exchange_file_and_from_a_sheet_of_errors_to_tables_in_one_command(call, tmp_path, machine):
    code, _, err = call("export", machine, VENDOR, "--controller", "isg-csv", "--out", tmp_path / "a")
    assert code == 0, err
    book = openpyxl.Workbook()
    for row in (["Position", "EXX"], ["mm", "um"], [0, 0], [200, 5], [400, -3]):
        book.active.append(row)
    book.save(tmp_path / "errors.xlsx")
    code, _, err = call("export", machine, tmp_path / "errors.xlsx", "--controller", "isg-csv", "--out", tmp_path / "b")
    assert code == 0, err
    assert (tmp_path / "b" / "volcomp0.csv").exists()


def test_an_exchange_file_runs_through_the_whole_chain(call, tmp_path, machine):
    path = tmp_path / "tracer.txt"
    path.write_text(
        "// constructed\n[C0Y]\nVALUE = 0.00002\n[EXX]\nGridpoints = {\n0 0.003\n100 0.007\n200 0.002\n400 0.005\n}\n"
        "[EYX]\nGridpoints = {\n0 0.001\n200 0.006\n400 0.003\n}\n"
    )
    code, out, err = call(
        "run", machine, path, "--controller", "isg-csv", "--prior", "none", "--out", tmp_path / "o", "--json"
    )
    assert code == 0, err
    facts = json.loads(out)
    assert facts["identify"]["method"] == "given"
    errors = read_errors(tmp_path / "o" / "identified.errors.csv")
    assert [round(1e3 * float(errors.curves["EXX"].at(x)), 6) for x in (0, 100, 200, 400)] == [0, 4, -1, 2]
    # the line 1 + 2 x / 400 um of the straightness turns X by +5 urad about Z: Y is 5 urad less beyond square to it
    assert [round(1e3 * float(errors.curves["EYX"].at(x)), 6) for x in (0, 200, 400)] == [0, 4, 0]
    assert 1e6 * errors.squareness["EC0Y"][0] == pytest.approx(15, abs=1e-6)


def test_a_file_that_leaves_something_open_is_not_computed_with(call, tmp_path, machine):
    code, _, err = call("run", machine, GOLDEN / "ecmc_ISO230.dat", "--controller", "isg-csv", "--out", tmp_path / "o")
    assert code == 2
    assert "leaves open" in err
    assert "give --axis" in err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("command", ["import", "identify", "run", "fit"])
def test_a_file_of_500_megabytes_is_refused_unread(call, tmp_path, machine, command):
    path = tmp_path / "huge.rtl"
    with path.open("wb") as stream:
        stream.write(b"HEADER::\r\n")
        stream.truncate(500_000_000)
    words = {
        "import": [path],
        "identify": [machine, path, "--out", tmp_path / "o"],
        "run": [machine, path, "--controller", "isg-csv", "--out", tmp_path / "o"],
        "fit": [machine, path, "--out", tmp_path / "o"],
    }[command]
    tracemalloc.start()
    try:
        code, _, err = call(command, *words)
        assert tracemalloc.get_traced_memory()[1] < 50_000_000  # bytes; the highest
    finally:
        tracemalloc.stop()
    assert code == 2
    assert "500 MB" in err


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT"])
@pytest.mark.parametrize("source", ["laser", "exchange", "workbook"])
def test_an_axis_that_goes_too_far_is_told_to_go_less_far_whatever_the_file_and_the_machine(
    call, tmp_path, chain, source
):
    """EXX = +10 um at 400 mm, zero at the reference point 100 mm: the trims of joint 0 are minus that, EEC has it as error."""
    targets, per_mm = [0, 100, 200, 300, 400], 0.025
    machine = tmp_path / "m.toml"
    text = MACHINE.replace('"WFYXZT"', f'"{chain}"\nreference_point_mm = [100.0, -100.0, -40.0]')
    machine.write_text(text)
    measured = {"laser": _laser, "exchange": _exchange, "workbook": _workbook}[source](tmp_path, targets, per_mm)
    code, _, err = call("run", machine, measured, "--controller", "linuxcnc-comp", "--controller", "siemens-eec",
                        "--prior", "none", "--out", tmp_path / "o")  # fmt: skip
    assert code == 0, err
    assert (tmp_path / "o" / "report.html").stat().st_size > 10_000
    trims = np.loadtxt(tmp_path / "o" / "linuxcnc-comp" / "joint0-x.comp")
    expected_mm = 1e-3 * per_mm * (trims[:, 0] - 100.0)
    np.testing.assert_allclose(trims[:, 1], -expected_mm, rtol=0, atol=NANOMETRE_MM)
    assert trims[-1, 1] == pytest.approx(-0.0075, abs=NANOMETRE_MM)
    eec = (tmp_path / "o" / "siemens-eec" / "AX_EEC.INI").read_text()
    values = np.array([float(v) for v in re.findall(r"ENC_COMP\[0,\d+,AX1\]=(\S+)", eec)])
    low, step = (float(re.search(rf"{key}\[0,AX1\]=(\S+)", eec).group(1)) for key in ("_MIN", "_STEP"))
    at = low + step * np.arange(len(values))
    np.testing.assert_allclose(values, 1e-3 * per_mm * (at - 100.0), rtol=0, atol=NANOMETRE_MM)


def _laser(folder, targets, per_mm):
    lines = ["HEADER::", "File type : rtl", "TARGET DATA::", f"Target-count: {len(targets)}", "Targets :"]
    lines += [" ".join(str(t) for t in targets), "Flags: 0 0 2 0", "USER-TEXT::", "Axis: X", "RUNS::", "Run-count: 4"]
    lines += ["DEVIATIONS::", "Run Target Data:"]
    for run in range(1, 5):
        for k in range(len(targets))[:: 1 if run % 2 else -1]:
            lines.append(f"{run} {k + 1} {per_mm * targets[k] + (0.02 if run > 2 else -0.02):.4f}")
    (folder / "x.rtl").write_text("\r\n".join([*lines, "EOF::", ""]))
    return folder / "x.rtl"


def _exchange(folder, targets, per_mm):
    rows = "".join(f"{t} {1e-3 * per_mm * t:.7f}\n" for t in targets)
    (folder / "e.txt").write_text(f"// made up\n[EXX]\nGridpoints = {{\n{rows}}}\n")
    return folder / "e.txt"


def _workbook(folder, targets, per_mm):
    book = openpyxl.Workbook()
    for row in (
        ["Achse:", "X"],
        ["Datum:", "04.03.2025"],
        [],
        ["Soll [mm]", "Abweichung [\u00b5m]", "Richtung", "Lauf"],
    ):
        book.active.append(row)
    for run, noise in ((1, -0.02), (2, 0.02)):
        for way in (1, -1):
            for target in targets[::way]:
                book.active.append([target, per_mm * target + noise, "+" if way > 0 else "-", run])
    book.save(folder / "p.xlsx")
    return folder / "p.xlsx"


def test_import_shows_what_is_not_used_and_carries_the_date_over(call, tmp_path):
    path = tmp_path / "x.csv"
    path.write_text(
        "Date: 04/03/2025\nTarget [mm],Deviation [um],Dead path [mm],Air temp [degC]\n0,1,5,20\n100,2,5,20.5\n"
    )
    words = ("import", path, "--axis", "X", "--out", tmp_path / "o")
    code, out, _ = call(*words, "--dates", "dmy")
    assert code == 0
    assert "not_used:" in out
    assert "Dead path [mm]: the native format has no column for it" in out
    text = (tmp_path / "o" / "x.axis.csv").read_text()
    assert "# measured_at = 2025-03-04\n" in text
    assert "temp_ambient_c" in text
    code, out, _ = call(*words)
    assert code == 0
    assert "may be 2025-03-04 or 2025-04-03" in out
    assert "measured_at" not in (tmp_path / "o" / "x.axis.csv").read_text()
