"""Section ``[prior]`` of a machine file: sizes of the classes, keys of single errors, and what is refused."""

import pytest

import compgen
from compgen.data.prior import CLASSES, PriorSettings
from compgen.errors import InputError

MACHINE = 'name = "mill"\nchain = "WFYXZT"\n{}' + "".join(
    f"[axes.{axis}]\nrange_mm = [0.0, 500.0]\nnodes = 6\n" for axis in "XYZ"
)
#: Standard deviations of a machining centre, a quarter of the tolerances: um, um/m, um, urad, urad.
GENERAL = {
    "positioning_um": 6.0,
    "scale_um_per_m": 15.0,
    "straightness_um": 2.5,
    "angle_urad": 12.0,
    "squareness_urad": 40.0,
}
TIMES = {"precision": 1.0 / 3.0, "general": 1.0, "large": 3.0, "router": 20.0, "printer": 20.0}


def loaded(folder, section=""):
    path = folder / "mill.toml"
    path.write_text(MACHINE.format(f"[prior]\n{section}\n" if section else ""))
    return compgen.load_machine(path)


@pytest.mark.parametrize("name", CLASSES)
def test_the_sizes_of_a_class(tmp_path, name):
    prior = loaded(tmp_path, f'class = "{name}"').prior
    said = prior.as_dict()
    assert said["class"] == name and said["stated"] is True
    for key, size in GENERAL.items():
        assert said[key] == pytest.approx(size * TIMES[name])
    assert prior.size_um("EBZ") == pytest.approx(12.0 * TIMES[name])
    assert prior.size("EZX") == pytest.approx(2.5e-3 * TIMES[name])
    assert prior.size("EA0Z") == pytest.approx(40e-6 * TIMES[name])
    assert prior.scale("EYY") == pytest.approx(15e-6 * TIMES[name])
    assert prior.scale("EXY") == 0.0


def test_a_file_without_the_section_is_general_and_that_is_said(tmp_path):
    prior = loaded(tmp_path).prior
    assert prior.as_dict()["class"] == "general"
    assert prior.as_dict()["stated"] is False


def test_keys_of_kinds_and_of_single_errors_overrule_the_class(tmp_path):
    prior = loaded(tmp_path, 'class = "large"\nangle_urad = 9.0\nEAX_urad = 30.0\nEXY_um = 1.5\nEC0Y_urad = 70.0').prior
    assert [prior.size_um(name) for name in ("EAX", "EBX", "EXY", "EZY", "EC0Y", "EB0Z")] == pytest.approx(
        [30.0, 9.0, 1.5, 7.5, 70.0, 120.0]
    )


def test_none_assumes_nothing(tmp_path):
    prior = loaded(tmp_path, 'class = "none"').prior
    assert prior.is_none and prior.as_dict() == {"class": "none"}


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("angle_urad = 0", "angle_urad"),
        ("angle_urad = -12.0", "angle_urad"),
        ("squareness_urad = 4e-5", "is the unit that of the key"),  # rad
        ("straightness_um = 1e9", "is the unit that of the key"),
        ("positioning_um = nan", "positioning_um"),
        ("positioning_um = inf", "positioning_um"),
        ('scale_um_per_m = "15"', "scale_um_per_m"),
        ("angle_urad = [12.0]", "angle_urad"),
        ('class = "generel"', "general"),
        ("class = 3", "class"),
        ('learn = "down"', "learn"),
        ("angle_um = 12.0", "angle_urad"),
        ("EAX_um = 30.0", "EAX_urad"),
        ("EC0X_urad = 30.0", "EC0Y_urad"),
        ("EAX_urad = -1.0", "EAX_urad"),
        ('class = "none"\nangle_urad = 12.0', "'none' assumes nothing"),
        ('class = "none"\nEAX_urad = 12.0', "'none' assumes nothing"),
        ('class = "none"\ncyclic_X_um = 1.0', "'none' assumes nothing"),
        ("cyclic_um = -1.0", "not negative"),
        ("cyclic_um = nan", "cyclic_um"),
        ("cyclic_um = 0.0000002", "amplitude in um"),  # m
        ("cyclic_um = 2000", "amplitude in um"),  # nm
        ('cyclic_um = "2 um"', "cyclic_um"),
        ("cyclic_X_mm = 1.0", "cyclic_X_um"),
        ("cyclic_A_um = 1.0", "cyclic_"),
    ],
)
def test_what_is_no_size_is_refused_with_its_key(tmp_path, call, section, said):
    with pytest.raises(InputError) as found:
        loaded(tmp_path, section)
    assert said in str(found.value)
    code, out, err = call("check", tmp_path / "mill.toml")
    assert code == 2 and said in out + err


def test_an_unknown_class_of_the_command_line_is_refused(tmp_path, call):
    loaded(tmp_path)
    words = ("identify", tmp_path / "mill.toml", "--squareness", "EC0Y=25±3", "--out", tmp_path / "o")
    code, _, err = call(*words, "--prior", "generel")
    assert code == 2 and "generel" in err and "general" in err
    assert not (tmp_path / "o").exists()
    code, _, err = call(*words, "--prior", "general")
    assert code == 0, err


def test_what_a_covariance_file_keeps_of_a_prior_is_read_back():
    prior = PriorSettings(class_name="large", angle_urad=9.0, learn="no", single={"EAX": 30.0}, factor=(3.0, 1.0))
    assert PriorSettings.from_stated(prior.stated()) == prior
    prior = PriorSettings(cyclic_um=2.0, cyclic={"Z": 0.0})
    assert PriorSettings.from_stated(prior.stated()) == prior
    with pytest.raises(ValueError, match="no key of a prior"):
        PriorSettings.from_stated({"angle": 1.0})


def test_a_cyclic_error_is_stated_for_all_axes_or_one(tmp_path):
    prior = loaded(tmp_path, "cyclic_um = 2.0\ncyclic_Z_um = 0").prior
    assert [1e3 * prior.cyclic_sd(name) for name in ("EXX", "EYY", "EZZ", "EYX", "EAX")] == pytest.approx(
        [2.0**0.5, 2.0**0.5, 0.0, 0.0, 0.0]
    )
    assert prior.cyclic_text == "cyclic error of 2 um amplitude (X, Y)"
