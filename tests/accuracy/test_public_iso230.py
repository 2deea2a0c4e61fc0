"""``benchmarks/public_iso230.py`` on a made-up measurement and report in the layout of the public ones."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from compgen.foreign import ImportOptions, import_file

PATH = Path(__file__).resolve().parents[2] / "benchmarks" / "public_iso230.py"

#: Mean and s (um) at 0, 100 ... 400 mm; readings are mean + s (-1, -1, 0, 1, 1): the worked numbers of test_accuracy.py.
UP = [(2, 1), (6, 2), (0, 1), (-2, 2), (5, 3)]
DOWN = [(-1, 1), (2, 1), (-3, 2), (-6, 1), (2, 2)]
STEPS = (-1, -1, 0, 1, 1)
#: As such reports have them (mm): forward is the negative direction; R is max(R_fwd, R_bwd) and not 13, E is 6 - (-2) and
#: not 6 - (-6).
PRINTED = {
    "B_avg": -0.0034, "B": 0.004, "R_fwd": 0.008, "R_bwd": 0.012, "R": 0.012, "E_fwd": 0.008, "E_bwd": 0.008, "E": 0.008,
    "M": 0.008, "A_fwd": 0.014, "A_bwd": 0.017, "A": 0.019,
}  # fmt: skip


@pytest.fixture
def benchmark():
    spec = importlib.util.spec_from_file_location("public_iso230", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def readings(table):
    return [[100.0 * i + (mean + s * step) * 1e-3 for step in STEPS] for i, (mean, s) in enumerate(table)]


def data_text():
    lines = ["TEST_DATA=# made up", "#     TGT_DATA[<pos_id>] : target", "UNIT=mm", "CYCLES=5", "POSITIONS=5", "DEC=5"]
    lines += [f"TGT_DATA[{i}]={100 * (i - 1)}" for i in range(1, 6)]
    for name, table in (("FWD", UP), ("BWD", DOWN)):
        for i, row in enumerate(readings(table), start=1):
            lines += [f"REF_DATA_{name}[{i},{j}]={value:.12f}" for j, value in enumerate(row, start=1)]
    return "\n".join(lines) + "\n"


def report_text(printed=PRINTED, residual=None, shift=0.0):
    rows = {"forward": readings(DOWN), "backward": readings(UP)}
    squares = sum((value - 100.0 * i) ** 2 for table in rows.values() for i, row in enumerate(table) for value in row)
    lines = ["# motion test report", "From | To | Ratio [] | Offset [mm] | Data count [] | Residual error [mm]"]
    lines += ["--- | --- | --- |", f"Target Position | Reference | -.998 | 5.0 | 50.0 | {residual or f'{squares:.8f}'}"]
    for name, table in rows.items():
        lines += ["", f"### Data {name} direction", "", "i |tgt_pos(i) [mm]|ref_pos(i,1) [mm]|", "--- |--- |"]
        for i, row in enumerate(table):
            lines.append(f"{i + 1}|{100.0 * i}|" + "".join(f"{round(value + shift, 5)}|" for value in row))
    lines += ["", "## Calculations", ""]
    lines += target_tables()
    for key, value in printed.items():
        lines += ["", f"{key} = Some figure of an axis [mm]", "", f"**{key} = {round(value, 5)} [mm]** "]
    return "\n".join(lines) + "\n"


def target_tables():
    """Mean and reversal, then s and R of both directions and R at each target, forward being the negative direction."""
    lines = ["i |x_avg(i) [mm]|B(i) [mm]|", "--- |--- |"]
    for i, ((up, _), (down, _)) in enumerate(zip(UP, DOWN, strict=True), start=1):
        lines.append(f"{i}|{(up + down) * 0.5e-3:.5f}|{(down - up) * 1e-3:.5f}|")
    lines += ["", "i |S_fwd(i) [mm]|S_bwd(i) [mm]|R_fwd(i) [mm]|R_bwd(i) [mm]|R(i) [mm]|", "--- |--- |--- |"]
    for i, ((_, s_u), (_, s_d), r) in enumerate(zip(UP, DOWN, (7, 10, 9, 10, 13), strict=True), start=1):
        lines.append(f"{i}|{s_d * 1e-3:.5f}|{s_u * 1e-3:.5f}|{s_d * 4e-3:.5f}|{s_u * 4e-3:.5f}|{r * 1e-3:.5f}|")
    return [*lines, ""]


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "x.md_ISO230.dat").write_text(data_text())
    (tmp_path / "another_name.md").write_text(report_text())
    (tmp_path / "readme.md").write_text("# nothing measured here\n")
    return tmp_path


def lines_of(text, name):
    return next(line.split() for line in text.splitlines() if line.startswith(f"  {name} "))


def test_a_report_is_found_by_its_readings_and_its_figures_are_compared(benchmark, folder, capsys):
    assert benchmark.main([str(folder)]) == 0
    text = capsys.readouterr().out
    for name in ("B", "M", "A", "B_avg", "R_fwd", "R_bwd", "E_fwd", "E_bwd", "A_fwd", "A_bwd"):
        assert float(lines_of(text, name)[1]) == pytest.approx(1e3 * PRINTED[name], abs=1e-4)
        assert len(lines_of(text, name)) == 4, "no remark: it agrees"
    assert "report another_name.md" in text
    assert "values at the targets: 35 of 35 agree" in text
    assert "forward of the report is REF_DATA_BWD of the data: exchanged" in text
    assert "reference reading x -.998 + 5.0 mm, fitted to these readings" in text
    assert "B, M, A differ in: none" in text


def test_the_wrong_rules_for_r_and_e_are_named_with_what_they_hide(benchmark, folder, capsys):
    benchmark.main([str(folder)])
    text = capsys.readouterr().out
    assert lines_of(text, "R")[1:3] == ["13.0000", "12.0000"]
    assert "the larger of R up and R down, 7.7 % too small" in text
    assert lines_of(text, "E")[1:3] == ["12.0000", "8.0000"]
    assert "largest mean minus the larger of both smallest means, 33.3 % too small" in text


@pytest.mark.parametrize("name", ["B", "M", "A"])
def test_one_unit_of_the_last_digit_in_b_m_or_a_is_a_difference(benchmark, folder, capsys, name):
    (folder / "another_name.md").write_text(report_text({**PRINTED, name: PRINTED[name] + 1e-5}))
    assert benchmark.main([str(folder)]) == 1
    assert f"differ in: x.md_ISO230.dat {name}" in capsys.readouterr().out


def test_a_figure_that_no_known_rule_gives_is_said_not_to_be_explained(benchmark, folder, capsys):
    (folder / "another_name.md").write_text(report_text({**PRINTED, "R": 0.0125, "E": 0.009}))
    assert benchmark.main([str(folder)]) == 0
    assert capsys.readouterr().out.count("NOT EXPLAINED") == 2


def test_a_value_at_a_target_that_is_printed_otherwise_is_counted(benchmark, folder, capsys):
    text = report_text()
    assert text.count("|0.01300|") == 1
    (folder / "another_name.md").write_text(text.replace("|0.01300|", "|0.01310|"))
    assert benchmark.main([str(folder)]) == 0
    assert "values at the targets: 34 of 35 agree" in capsys.readouterr().out


def test_a_report_of_other_readings_is_not_compared(benchmark, folder, capsys):
    (folder / "another_name.md").write_text(report_text(shift=2e-5))
    assert benchmark.main([str(folder)]) == 1
    assert "no report shows these readings" in capsys.readouterr().out


def test_a_gear_ratio_that_was_fitted_to_other_readings_is_told(benchmark, folder, capsys):
    (folder / "another_name.md").write_text(report_text(residual=".00200000"))
    assert benchmark.main([str(folder)]) == 0
    assert "fitted to other readings" in capsys.readouterr().out


def test_a_cut_data_file_is_refused_by_name(benchmark, folder, capsys):
    (folder / "x.md_ISO230.dat").write_text(data_text()[:-120])
    assert benchmark.main([str(folder)]) == 1
    assert "refused: " in capsys.readouterr().out


def test_reports_alone_are_evaluated_from_their_rounded_readings(benchmark, folder, capsys):
    (folder / "x.md_ISO230.dat").unlink()
    assert benchmark.main([str(folder), "--reports"]) == 0
    text = capsys.readouterr().out
    assert "1 sets compared" in text
    assert float(lines_of(text, "A")[1]) == pytest.approx(19.0, abs=1e-4)


def test_a_gear_ratio_that_was_fitted_before_is_noticed_in_the_readings_alone(tmp_path):
    """What remains of a least-squares fit of targets by readings has no mean and does not follow the readings."""
    plain = tmp_path / "plain.dat"
    plain.write_text(data_text())
    rows = {"FWD": readings(UP), "BWD": readings(DOWN)}
    raw = np.array([value for table in rows.values() for row in table for value in row]) * -1.0004 + 17.0
    target = np.tile(np.repeat(100.0 * np.arange(5), 5), 2)
    corrected = iter(np.polyval(np.polyfit(raw, target, 1), raw))
    lines = [
        f"REF_DATA_{name}[{i},{j}]={next(corrected):.12f}" for name in rows for i in range(1, 6) for j in range(1, 6)
    ]
    fitted = tmp_path / "fitted.dat"
    fitted.write_text(
        "\n".join([*(line for line in data_text().splitlines() if "REF_DATA" not in line), *lines]) + "\n"
    )
    notes = [" ".join(import_file(path, ImportOptions(axis="X")).notes) for path in (plain, fitted)]
    assert ["gear ratio was already fitted" in text for text in notes] == [False, True]
