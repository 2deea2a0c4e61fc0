"""Pages beside the tables say what was not measured: options, explanation, preflight list, readings, exported tables."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from virtual_shop import MIXTURES, case

from compgen.data.error_table import format_errors, read_errors
from compgen.data.files import Provenance
from compgen.errors import CompgenWarning
from compgen.fitting import FitOptions, fit
from compgen.identification.covariance import covariance_named_by, joint_covariance
from compgen.pipeline import fit_files, identification_files, identify_bare, verified_export
from compgen.report.options_text import explanation_markdown, level_rows, options_markdown
from compgen.tables import export, with_known
from compgen.tables.options import capability, explain
from compgen.tables.signs import check_files, check_program

CIRCLES = "pitch + 3 circles"


@pytest.fixture(scope="module")
def shop():
    return case(1, seed=31)


@pytest.fixture(scope="module")
def found(shop):
    return identify_bare(shop.machine, MIXTURES[CIRCLES](shop))


@pytest.fixture(scope="module")
def known(found):
    return joint_covariance(found)


@pytest.fixture(scope="module")
def offered(shop, found, known):
    return capability(shop.machine, found.errors, controllers=("isg-csv",), covariance=known)


def test_options_state_the_uncertainty_of_the_whole_machine_and_what_was_assumed(shop, found, offered):
    """U is twice the rms of the posterior's u over the volume; the mean square of both together is the sum."""
    posterior = found.posterior
    at = np.random.default_rng(0).uniform(shop.machine.lower_mm, shop.machine.upper_mm, (2000, 3))
    expected_um = 2e3 * np.sqrt(np.mean(posterior.field(at).variance.sum(axis=1)))
    # the grid of the figures has the ends of the travel, where most is unknown
    assert expected_um < offered.uncertainty.rms_um < 1.6 * expected_um
    left = offered.level("volumetric").left
    as_it_stands, _ = offered.with_unknown_um(left)
    assert as_it_stands == pytest.approx(np.hypot(left.after.rms_um, offered.uncertainty.rms_um / 2))
    text = options_markdown(offered)
    assert "assumed for what was not measured" in text and "not known:" in text
    volumetric = next(row for row in level_rows(offered) if row[0] == "full volumetric")
    assert "0.0" not in volumetric[1] and "<" in volumetric[1]  # no 0.002 um beside U of many um


def test_without_a_prior_nothing_is_claimed_of_what_was_not_measured(shop, found):

    machine = replace(shop.machine, prior=shop.machine.prior.with_class("none"))
    few = found.errors.only("EXX", "EYY", "EZZ")
    bare = capability(machine, few, controllers=())
    assert bare.uncertainty is None
    assert all(row[3] == "not determined" for row in level_rows(bare))
    assert "what they do is not determined" in " ".join(bare.notes)
    assert "uncertainty of every figure after compensation: not determined" in options_markdown(bare)


def test_the_explanation_says_what_is_to_be_expected_of_the_machine(shop, found, known):
    exported = export(shop.machine, found.errors, "isg-csv")
    text = explanation_markdown(explain(shop.machine, found.errors, exported, covariance=known))
    assert "With what the measurement does not know" in text and "assumed for what was not measured" in text


@pytest.fixture(scope="module")
def folder(found, tmp_path_factory):
    """An identification and its smooth curves, as files."""
    path = tmp_path_factory.mktemp("identified")
    files = identification_files(found, Provenance())
    for name, content in files.items():
        (path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def fitted_in(folder, found, known, shop):
    smooth = fit(shop.machine, found.errors, FitOptions(smoothness=0.0), covariance=known)
    name = "identified.covariance.npz"
    for file, text in fit_files(smooth, (name, (folder / name).read_bytes())).items():
        (folder / file).write_text(text)
    return folder / "fitted.errors.csv"


def test_tables_of_the_fitted_file_get_the_verdict_of_the_run(shop, found, known, folder):
    """What circles show of angles is hardly known, and known together: its u taken node by node was a measurement of each."""
    path = fitted_in(folder, found, known, shop)
    smooth = read_errors(path)
    again = covariance_named_by(path, smooth)
    exported = export(shop.machine, smooth, "isg-csv")
    of_run = verified_export(shop.machine, exported, found.errors, known=known)[1]
    of_file = verified_export(shop.machine, exported, smooth, known=again)[1]
    alone = verified_export(shop.machine, exported, smooth)[1]
    assert of_file.uncertainty.rms_um == pytest.approx(of_run.uncertainty.rms_um, rel=1e-6)
    assert of_file.gain.after_um == pytest.approx(of_run.gain.after_um, rel=1e-3)
    assert of_file.gain.probability_better == pytest.approx(of_run.gain.probability_better, abs=1e-3)
    assert abs(alone.uncertainty.rms_um / of_run.uncertainty.rms_um - 1.0) > 0.02


def test_a_covariance_of_another_identification_is_not_taken_for_fitted_errors(shop, found, known, folder):
    path = fitted_in(folder, found, known, shop)
    kept = (folder / "identified.covariance.npz").read_bytes()
    other = identify_bare(shop.machine, MIXTURES["pitch + 2 circles"](shop))
    files = identification_files(other, Provenance())
    (folder / "identified.covariance.npz").write_bytes(files["identified.covariance.npz"])
    with pytest.warns(CompgenWarning, match="belongs to another version"):
        assert covariance_named_by(path, read_errors(path)) is None
    (folder / "identified.covariance.npz").write_bytes(kept)


@pytest.mark.parametrize("name", ["identified.errors.csv", "fitted.errors.csv"])
def test_an_errors_file_that_was_copied_without_its_covariance_says_so(shop, found, known, folder, tmp_path, name):
    fitted_in(folder, found, known, shop)
    (tmp_path / name).write_bytes((folder / name).read_bytes())
    with pytest.warns(CompgenWarning, match=r"refers to identified\.covariance\.npz, which is not beside it"):
        assert covariance_named_by(tmp_path / name, read_errors(tmp_path / name)) is None


def test_the_preflight_list_says_what_is_known_before_its_first_step(shop, found, known):
    exported = export(shop.machine, found.errors, "isg-csv")
    verification = verified_export(shop.machine, exported, found.errors, known=known)[1]
    text = with_known(exported, verification.known_lines).preflight
    before, after = text.split("## What is known of the machine\n")
    assert "## 1." not in before and after.index("assumed for what was not measured") < after.index("## 1.")
    assert "the machine may be U =" in after


def test_expected_readings_have_the_uncertainty_of_their_difference_to_the_first(shop, found, known):
    """Against 4000 joint draws of the posterior at the five positions."""
    exported = export(shop.machine, found.errors, "isg-csv")
    page = check_files(shop.machine, exported, found.errors, covariance=known)["check/check-program.md"]
    rows = page[page.index("| U z |") :].splitlines()[2:7]
    stated = np.array([[float(cell) for cell in row.split("|")[14:17]] for row in rows])
    _, verification = verified_export(shop.machine, exported, found.errors, known=known)
    from compgen.controls import SourceFile, controller_named
    from compgen.tables import ReadTables

    control = controller_named("isg-csv")(shop.machine)
    parsed = control.parse([SourceFile(Path(name), text) for name, text in exported.files.items()])
    program = check_program(shop.machine, ReadTables(control, parsed, ()), found.errors)
    draws = found.posterior.field(program.position_mm).draws(4000, 1)
    expected = 2e3 * (draws - draws[:, :1]).std(axis=0)
    assert verification.accepted is not None
    assert np.allclose(stated, expected, rtol=0.06, atol=0.06)
    assert "?" in check_files(shop.machine, exported, _without_u(found.errors))["check/check-program.md"]


def _without_u(errors):
    return errors.with_values(u=np.full(len(errors.values()), np.nan))


def test_a_class_that_does_not_exist_is_refused(call, small_machine_file, small_errors, tmp_path):
    path = tmp_path / "a.errors.csv"
    path.write_text(format_errors(small_errors))
    for command in (("options",), ("export", "--controller", "isg-csv", "--out", tmp_path / "tables")):
        code, _, stderr = call(command[0], small_machine_file, path, *command[1:], "--prior", "huge")
        assert code == 2 and "huge" in stderr
    assert not (tmp_path / "tables").exists()
