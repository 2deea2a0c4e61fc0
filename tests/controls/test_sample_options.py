"""--style-from and --template-from: a file of the user's own control reaches the settings of the controls that take it."""

from pathlib import Path

import pytest

from compgen.cli.shared_options import with_samples
from compgen.controls import CONTROLLERS
from compgen.data.machine import load_machine
from compgen.errors import InputError


@pytest.fixture
def machine():
    return load_machine("zha-gantry")


def test_a_sample_that_does_not_exist_is_named(machine, tmp_path):
    with pytest.raises(InputError, match="--style-from: no such file"):
        with_samples(machine, ["siemens-eec"], {"style_from": tmp_path / "missing.txt"})


def test_a_sample_for_a_control_that_takes_none_is_refused(machine, tmp_path):
    sample = tmp_path / "sample.txt"
    sample.write_text("%\n%\n")
    with pytest.raises(InputError, match="not for isg-csv"):
        with_samples(machine, ["isg-csv"], {"style_from": sample})


def test_a_sample_reaches_only_the_controls_that_take_it(machine, tmp_path, monkeypatch):
    sample = tmp_path / "sample.txt"
    sample.write_text("%\n%\n")
    monkeypatch.setattr(CONTROLLERS["siemens-eec"], "sample_setting", "style_from")
    changed = with_samples(machine, ["isg-csv", "siemens-eec"], {"style_from": sample, "template_from": None})
    assert changed.controller_settings("siemens-eec").file("style_from") == sample
    assert "style_from" not in changed.controller_settings("isg-csv")
    assert "style_from" not in machine.controller_settings("siemens-eec")


def test_several_samples_reach_the_control_together(machine, tmp_path):
    paths = [tmp_path / "CNC-PARA.TXT", tmp_path / "PITCH.TXT"]
    for path in paths:
        path.write_text("%\n%\n")
    changed = with_samples(machine, ["fanuc-pitch"], {"style_from": tuple(paths)})
    assert changed.controller_settings("fanuc-pitch").files("style_from") == tuple(paths)
    with pytest.raises(InputError, match="a list of paths"):
        machine.with_setting("fanuc-pitch", "style_from", 3).controller_settings("fanuc-pitch").files("style_from")


def test_a_sample_in_the_machine_file_is_looked_up_beside_it(machine, tmp_path):
    section = machine.with_setting("siemens-eec", "style_from", "no-such-file.txt").controller_settings("siemens-eec")
    section.path = tmp_path / "machine.toml"
    with pytest.raises(InputError, match="no such file"):
        section.file("style_from")
    Path(tmp_path / "no-such-file.txt").write_text("%")
    assert section.file("style_from") == tmp_path / "no-such-file.txt"
