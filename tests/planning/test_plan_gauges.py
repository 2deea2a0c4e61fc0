"""Plans with artefacts and circles: against the scatter of simulated measurements, and the pictures against exact readings."""

import json
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from compgen.data.comparison import without_rigid_motion
from compgen.data.error_table import Curve, ErrorTable, format_errors
from compgen.data.lengths import Points
from compgen.data.names import SQUARENESS_NAMES, error_named
from compgen.data.prior import PriorSettings
from compgen.errors import CompgenWarning
from compgen.identification.adjust.unknowns import state_names
from compgen.identification.any_measurement import MixedMeasurement, identify_measurement
from compgen.identification.axis_tests import identify_circles
from compgen.identification.options import IdentifyOptions
from compgen.identification.positions import identify_artefact
from compgen.identification.posterior import processes_of, symmetric_root
from compgen.identification.together import Source, identify_together
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.first_order import c_matrix
from compgen.kinematics.many_points import full_grid, volumetric_error
from compgen.planning import planned, planned_noise, planned_stations
from compgen.planning.gauges import perfect_readings, plan_gauges, plan_page, shown_by
from compgen.report.terminal import gauge_plan_table
from compgen.simulation.gauges import Ballbar, PlatePose, TouchProbe, circle_from_text, pose_from_text
from tests.browser import Browser, program

FLAT = TouchProbe(
    poses=(PlatePose((-50.0, 100.0, -100.0)),), columns=9, rows=7, pitch_mm=(60.0, 60.0, 0.0), components=(0, 1),
    calibrated=True, noise_um=0.5,
)  # fmt: skip


@pytest.fixture(scope="module")
def errors(small_machine):
    """Small errors, so that second-order terms stay below a nanometre or two."""
    x, y = (small_machine.axes[k].nodes_mm for k in (0, 1))
    curves = {
        "EXX": Curve(x, 20e-6 * (x + 50.0), np.zeros(6)),
        "EYX": Curve(x, 4e-3 * np.array([0, 1, 1.5, 1.2, 0.4, 0]), np.zeros(6)),
        "EXY": Curve(y, 3e-3 * np.array([0, -1, 1, 0.5, 0]), np.zeros(5)),
    }
    return ErrorTable(curves, {"EC0Y": (30e-6, 0.0)})


def noisy(machine, probe, seed):
    found = perfect_readings(machine, probe)
    rng = np.random.default_rng(seed)
    found.measured_mm[:] += probe.noise_um * 1e-3 * rng.standard_normal(found.measured_mm.shape)
    return found


@pytest.fixture(scope="module")
def bare_machine(small_machine):
    """Without a prior a plan is that of least squares: what the readings alone determine."""
    return replace(small_machine, prior=PriorSettings(class_name="none"))


def test_the_planned_uncertainty_is_the_scatter_of_measurements(bare_machine):
    small_machine = bare_machine
    plan = plan_gauges(small_machine, [FLAT], additions=False)
    assert {"EXX", "EYX", "EXY", "EYY", "EC0Y"} <= set(plan.whole)
    values = []
    for seed in range(60):
        found = identify_artefact(small_machine, noisy(small_machine, FLAT, seed), IdentifyOptions(reject=False))
        assert found.errors.names == plan.errors.names
        values.append(found.errors.values())
    scatter, u = np.std(values, axis=0), plan.errors.uncertainties()
    free = u > 1e-9
    ratio = scatter[free] / u[free]
    assert np.sqrt(np.mean(ratio**2)) == pytest.approx(1.0, abs=0.08)
    assert ratio.max() < 1.5


def test_a_pose_turned_is_what_an_uncalibrated_plate_lacks(bare_machine):
    """Self-calibration: one pose determines nothing, every addition is another pose; with turns and a shift it is enough."""
    alone = TouchProbe(**{**vars(FLAT), "calibrated": False, "columns": 5, "rows": 5})
    plan = plan_gauges(bare_machine, [alone])
    assert plan.errors.names == ()
    assert plan.additions
    assert plan.additions[0].adds
    places = [PlatePose((-50.0, 100.0, -100.0), (0.0, 0.0, angle)) for angle in (0.0, 90.0, 180.0)]
    turned = TouchProbe(**{**vars(alone), "poses": (*places, PlatePose((10.0, 100.0, -100.0)))})
    more = plan_gauges(bare_machine, [turned], additions=False)
    assert {"EYX", "EXY", "EC0Y"} <= set(more.whole)
    assert {"EXX", "EYY"} <= set(more.partly)  # no length: the common scale stays open


def test_the_best_addition_keeps_what_it_promises(small_machine):
    plan = plan_gauges(small_machine, [FLAT])
    assert [item.u_after_um for item in plan.additions] == sorted(item.u_after_um for item in plan.additions)
    for best in plan.additions[:2]:
        option, _, text = best.option.partition(" ")
        if option == "--circle":
            gauges = [FLAT, circle_from_text(text)]
        else:
            gauges = [TouchProbe(**{**vars(FLAT), "poses": (*FLAT.poses, pose_from_text(text))})]
        more = plan_gauges(small_machine, gauges, additions=False)
        assert set(best.adds) == set(more.whole) - set(plan.whole)
        assert best.u_after_um == pytest.approx(more.volume.rms_um, rel=1e-9)
        assert best.u_after_um < plan.volume.rms_um


def test_circles_in_three_planes_and_a_tracer_are_planned_in_one_adjustment(bare_machine):
    small_machine = bare_machine
    circles = [circle_from_text(f"{plane}:90") for plane in ("XY", "YZ", "ZX")]
    plan = plan_gauges(small_machine, circles, additions=False)
    assert plan.whole == ("EC0Y", "EB0Z", "EA0Z")
    assert np.isnan(plan.errors.squareness["EC0Y"][1])  # over the travel: nothing is known of the guides, nor assumed
    u = plan.solution.curve("EC0Y", np.zeros(1))[1][
        0
    ]  # within the circle: R/2 sin 2t: u = s / (R/2 sqrt(n/2)), the other terms are orthogonal to it
    assert u == pytest.approx(0.5e-3 / (45.0 * np.sqrt(720 / 2)), rel=0.05)
    stations = planned_stations({"A": (-500, -300, -400), "B": (400, -300, -400)})
    points = Points(full_grid([axis.nodes_mm for axis in small_machine.axes]).reshape(-1, 3))
    lengths = planned(small_machine, stations, points, planned_noise()).lengths
    both = plan_gauges(small_machine, [FLAT], lengths, additions=False)
    assert set(both.whole) > set(plan_gauges(small_machine, [FLAT], additions=False).whole)


def test_a_plan_with_a_circle_is_that_of_the_identification(bare_machine):
    """The planned uncertainty of a mixture is what its adjustment states."""
    small_machine = bare_machine
    ballbar = Ballbar((0,), 90.0, noise_um=0.5)
    plan = plan_gauges(small_machine, [FLAT, ballbar], additions=False)
    circles = perfect_readings(small_machine, ballbar)
    circles.deviation_mm[:] += 0.5e-3 * np.random.default_rng(4).standard_normal(len(circles))
    parts = [
        Source("p", noisy(small_machine, FLAT, 3), None),
        Source("c", circles, identify_circles(small_machine, circles)),
    ]
    found = identify_together(small_machine, parts, IdentifyOptions())
    u = found.errors.uncertainties() / found.u_scale
    places = zip(*plan.errors.labels(), strict=True)
    planned_u = [plan.solution.curve(name, np.array([at]))[1][0] for name, at in places]
    assert planned_u == pytest.approx(u, rel=0.1, abs=1e-9)


def drawn(machine, seed):
    """Errors of a machine drawn from its prior."""
    rng, names, curves = np.random.default_rng(seed), state_names(machine), {}
    for name, process in processes_of(machine, machine.prior, names).items():
        at = np.linspace(*machine.axes[error_named(name).axis].range_mm, 61)
        root = symmetric_root(process.covariance(at, at))
        curves[name] = Curve(at, root @ rng.standard_normal(root.shape[1]), np.zeros(61))
    squareness = {name: (machine.prior.size(name) * rng.standard_normal(), 0.0) for name in SQUARENESS_NAMES}
    return ErrorTable(curves, squareness)


def measured(machine, gauge, errors, seed):
    def tips(stops):
        tool = np.array(machine.tool_offset_mm)
        return tip_position(machine, errors.at(stops.position_mm), stops.position_mm, tool)

    return gauge.measure(machine, tips, [], {}, np.random.default_rng(seed))


@pytest.mark.parametrize(
    "gauges",
    [
        (Ballbar((0,), 90.0, noise_um=0.5), Ballbar((1,), 90.0, noise_um=0.5)),
        (replace(FLAT, columns=5, rows=5), Ballbar((0,), 90.0, noise_um=0.5)),
    ],
    ids=["circles", "plate-and-circle"],
)
def test_what_is_planned_is_what_identification_says_of_machines_drawn_from_the_prior(small_machine, gauges):
    """u of the field and of every error; and the field of those machines is known as well as was planned."""
    machine = replace(
        small_machine, prior=PriorSettings(learn="no")
    )  # a plan knows no readings that would raise a size
    plan = plan_gauges(machine, gauges, additions=False)
    at_mm = plan.volume.position_mm[:: len(plan.volume.position_mm) // 100]
    fields, singles, errors_over_u = [], [], []
    for seed in range(8):
        truth = drawn(machine, seed)
        parts = [(f"{k}", measured(machine, gauge, truth, 50 + seed)) for k, gauge in enumerate(gauges)]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CompgenWarning)  # that two parts nearly disagree, as they do by chance
            found = identify_measurement(machine, MixedMeasurement(tuple(parts)), IdentifyOptions()).posterior
        fields.append(np.sqrt(found.field(at_mm).variance.mean() / plan.posterior.field(at_mm).variance.mean()))
        singles += [found.shares[name] / plan.posterior.shares[name] for name in found.names]
        mean = np.einsum("nij,nj->ni", c_matrix(machine, at_mm), found.mean_table(found.names).at(at_mm))
        off = volumetric_error(machine, truth, at_mm) - mean
        errors_over_u.append(np.mean(off**2) / plan.posterior.field(at_mm).variance.mean())
    assert np.median(fields) == pytest.approx(1.0, abs=0.1)
    assert 0.85 < min(fields) < max(fields) < 1.3
    assert np.median(singles) == pytest.approx(1.0, abs=0.15)
    assert 0.5 < np.sqrt(np.mean(errors_over_u)) < 1.2


def test_what_circles_do_not_show_has_the_uncertainty_of_its_class_and_is_what_to_add(small_machine):
    """Circles in XY and YZ say nothing of EB0Z: it makes most of u, so a circle in ZX comes first, and for it."""
    plan = plan_gauges(small_machine, [circle_from_text("XY:90"), circle_from_text("YZ:90")])
    report = plan.summary()
    assert set(report["u"]) == set(state_names(small_machine))
    assert all(item["u_max"] > 0 for item in report["u"].values())
    assert report["u"]["EB0Z"]["state"] == "assumed"
    assert report["u"]["EB0Z"]["u_max"] >= small_machine.prior.size_um("EB0Z")
    assert report["u"]["EC0Y"]["u_max"] < report["u"]["EB0Z"]["u_max"]
    assert "EB0Z" in report["left_out"]
    assert report["not_measured"]["EB0Z"]["unit"] == "urad"
    assert report["additions"][0]["option"] == "--circle ZX:100"
    assert report["additions"][0]["reduces"][0] == "EB0Z"
    assert "EC0Y" not in (*report["additions"][0]["reduces"], *report["additions"][0]["adds"])
    larger = replace(small_machine, prior=PriorSettings(class_name="large"))
    ratio = plan_gauges(larger, plan.gauges, additions=False).volume.rms_um / plan.volume.rms_um
    assert ratio == pytest.approx(3.0, rel=0.03)  # nearly all of it is what was not measured
    text = " ".join(str(item) for item in gauge_plan_table(plan).renderables)
    assert "taken as zero" not in text + plan_page(plan)


def test_pictures_show_what_exact_readings_show(small_machine, errors):
    (arrows,) = shown_by(small_machine, FLAT, errors)
    exact = perfect_readings(small_machine, FLAT, errors)
    nominal = perfect_readings(small_machine, FLAT)
    seen = np.nan_to_num(exact.measured_mm - nominal.measured_mm)
    expected = without_rigid_motion(
        np.where(np.isnan(nominal.measured_mm), nominal.nominal_mm, nominal.measured_mm), seen
    )
    total = np.sum(list(arrows.responses_um.values()), axis=0)
    assert total == pytest.approx(1e3 * expected[:, :2], abs=0.01)
    # a machine that travels too far finds true features too close together
    x = arrows.place_mm[:, 0] - arrows.place_mm[:, 0].mean()
    assert np.polyfit(x, arrows.responses_um["EXX"][:, 0], 1)[0] == pytest.approx(-20e-3, rel=1e-6)

    ballbar = Ballbar((0,), 90.0)
    (circle,) = shown_by(small_machine, ballbar, errors)
    exact = perfect_readings(small_machine, ballbar, errors)
    rows = np.flatnonzero(exact.direction == 1)
    rows = rows[np.argsort(exact.angle_rad[rows])]
    centre = np.column_stack([np.cos(exact.angle_rad[rows]), np.sin(exact.angle_rad[rows])])
    read = 1e3 * exact.deviation_mm[rows]
    read = read - centre @ np.linalg.lstsq(centre, read, rcond=None)[0]
    assert np.sum(list(circle.responses_um.values()), axis=0) == pytest.approx(read, abs=0.01)
    at_135 = int(np.argmin(np.abs(circle.angle_rad - np.radians(135))))
    assert circle.responses_um["EC0Y"][at_135] == pytest.approx(45.0 * 30e-3, rel=1e-3)  # docs/instruments.md


def write_plate(folder, *lines):
    path = folder / "plate.toml"
    path.write_text("\n".join(["columns = 5", "rows = 5", "pitch_mm = [40.0, 40.0, 0.0]", 'components = "xy"', *lines]))
    return path


def test_the_command_writes_a_page_that_needs_nothing_else(tmp_path, small_machine, errors, call):
    known = tmp_path / "known.errors.csv"
    known.write_text(format_errors(errors.replace(metadata={"machine": "<b>"})))
    command = [
        "plan",
        small_machine.source,
        "--artefact",
        write_plate(tmp_path),
        "--pose",
        "-50,100,-100;-50,100,-100,90",
    ]
    code, out, _ = call(*command, "--circle", "XY:90", "--errors", known, "--out", tmp_path / "o")
    assert code == 0
    assert "EC0Y" in out
    report = json.loads((tmp_path / "o" / "plan.json").read_text())
    assert report["u"]["EC0Y"]["state"] == "partly"  # within the plate and the circle; the guides may bend beyond them
    assert "EZZ" in report["left_out"]
    assert report["readings"] == 2 * 2 * 25 + 720
    page = (tmp_path / "o" / "plan.html").read_text()
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert len(re.findall('id="figure-view-', page)) == 3
    assert 'data-error="EXX"' in page
    assert 'data-error="EZZ"' not in page
    code, _, _ = call(*command[:3], write_plate(tmp_path, "calibrated = false"), *command[4:], "--out", tmp_path / "p")
    assert code == 0
    assert "usual sizes" in (tmp_path / "p" / "plan.html").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--pose", "0,0,0"], "--pose belongs to --artefact"),
        (["--grid"], "give --stations FILE (laser tracer), --artefact FILE or --circle"),
        (["--target-um", "1"], "give --stations FILE (laser tracer), --artefact FILE or --circle"),
        (["--prior", "none"], "class 'none' assumes nothing"),
        (["--prior", "lathe"], "'lathe' is not a class of machines"),
        (["--circle", "XY:90", "--prior", "lathe"], "'lathe' is not a class of machines"),
        (["--circle", "XZ:90"], "'XZ:90' is not PLANE:RADIUS"),
        (["--circle", "XY:5000"], "the circle leaves it"),
        (["--circle", "XY:90", "--grid"], "--points and --grid are where a laser tracer reads"),
        (["--circle", "XY:90", "--suggest"], "for a laser tracer alone"),
        (["--artefact", "plate.toml"], "give at least one [[poses]] with origin_mm"),
        (["--artefact", "plate.toml", "--pose", "1,2"], "'1,2' is not X,Y,Z in mm"),
        (["--artefact", "plate.toml", "--pose", "900,0,0"], "a feature lies there"),
        (["--artefact", "plate.toml", "--pose", "-50,100,-100,0,90,0"], "for an artefact that lies flat"),
    ],
)
def test_requests_that_make_no_plan_are_refused_and_write_nothing(
    tmp_path, monkeypatch, small_machine, call, words, message
):
    monkeypatch.chdir(tmp_path)
    write_plate(tmp_path)
    code, _, err = call("plan", small_machine.source, *words, "--out", "o")
    assert code == 2
    assert message in err.replace("\n", " ")
    assert not (tmp_path / "o").exists()


@pytest.mark.skipif(program() is None, reason="no browser")
def test_sliders_draw_the_picture_again(tmp_path, small_machine, errors):
    """The script adds the responses as Python does: all at 100 % it is the first drawing, one alone is that of its table."""
    plan = plan_gauges(small_machine, [FLAT, Ballbar((0,), 90.0)], additions=False)
    browser = Browser(tmp_path)
    chosen = "document.querySelectorAll('.layer-shown path, .layer-scale text')"
    paths = f"JSON.stringify([...{chosen}].map(p => p.getAttribute('d') || p.textContent))"
    try:
        drawn = {}
        for name, table in (("all", errors), ("one", errors.only("EC0Y"))):
            page = tmp_path / f"{name}.html"
            page.write_text(plan_page(plan, table))
            browser.open(page)
            drawn[name] = [numbers(text) for text in json.loads(browser.ask(paths))]
            browser.ask("document.querySelector('[data-all=\"100\"]').click()")
            assert all_close([numbers(text) for text in json.loads(browser.ask(paths))], drawn[name])
        browser.open(tmp_path / "all.html")
        browser.ask("document.querySelector('[data-only=EC0Y]').click()")
        assert all_close([numbers(text) for text in json.loads(browser.ask(paths))], drawn["one"])
        assert not all_close(drawn["one"], drawn["all"])
    finally:
        browser.close()


def numbers(text):
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?", text.replace("−", "-"))]


def all_close(first, second, picture_units=0.05):
    return len(first) == len(second) and all(
        len(one) == len(other) and np.allclose(one, other, atol=picture_units)
        for one, other in zip(first, second, strict=True)
    )
