"""One control that gets no tables beside others that do."""

import json

import pytest

import compgen
from compgen.cli.file_commands import init_command
from compgen.errors import CompgenWarning, InputError

RUNS = "axis,position_mm,direction,run,deviation_um\n" + "".join(
    f"X,{x},1,1,{x * 0.1}\n" for x in (0, 150, 300, 450, 600)
)


@pytest.fixture(scope="module")
def mill(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mill")
    travel = [
        word for letter, end in (("X", 600), ("Y", 400), ("Z", 500)) for word in ("--travel", f"{letter}=0..{end}")
    ]
    init_command.main(["mill", "--chain", "WXYFZT", *travel, "--out", str(folder)], standalone_mode=False)
    (folder / "x.axis.csv").write_text(RUNS)
    return folder


def test_the_others_get_their_tables_and_the_row_of_the_one_says_why(mill, tmp_path):
    machine = compgen.load_machine(str(mill / "mill.toml"))
    with pytest.warns(CompgenWarning) as caught:
        result = compgen.run(machine, [mill / "x.axis.csv"], ["isg-csv", "pmac"], tmp_path)
    assert any(str(item.message).startswith("pmac: no tables: ") for item in caught)
    assert not result.accepted
    assert [item.export.controller for item in result.results] == ["isg-csv"]
    assert (tmp_path / "isg-csv" / "result.json").is_file()
    assert "counts_per_mm" in (tmp_path / "pmac" / "NO-TABLES.txt").read_text()
    summary = result.summary()["controllers"]
    assert summary["pmac"]["state"] == "no_tables" and not summary["pmac"]["accepted"]
    assert "counts_per_mm" in summary["pmac"]["reasons"][0]
    json.dumps(summary)


def test_one_control_alone_or_all_of_them_stop_before_anything_is_written(mill, tmp_path):
    machine = compgen.load_machine(str(mill / "mill.toml"))
    with pytest.raises(InputError, match="counts_per_mm"):
        compgen.run(machine, [mill / "x.axis.csv"], ["pmac"], tmp_path)
    with pytest.warns(CompgenWarning), pytest.raises(InputError, match="missing|is"):
        compgen.run(machine, [mill / "x.axis.csv"], ["pmac", "mitsubishi"], tmp_path)
    assert list(tmp_path.iterdir()) == []
