"""The catalogue of effects: every column against the simulator's forward formulas, which share no code with it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from compgen.data import toml_files
from compgen.data.deviations import Deviations
from compgen.data.lengths import Lengths
from compgen.data.machine import Chain, load_machine
from compgen.effects import FAMILIES, DisplacementEffect, catalogue, listed, readings_of_deviations, readings_of_lengths
from compgen.effects.readings import step_times_s, velocity_mm_s
from compgen.kinematics.exact_chain import tip_position
from compgen.simulation.effects import LengthEffect, Sights, read_effects
from compgen.simulation.trajectory import Line, Session, Temperature, Trajectory, plan_session, with_temperatures

STATIONS = ("A", "B 2")
PLACES_MM = np.array([[-1300.0, 250.0, -500.0], [400.0, -1400.0, 300.0]])
#: Relative agreement of a central difference with a derivative.
FIRST_ORDER = 2e-6
#: Rounding of a length of 2 m in double precision, a few times over.
LENGTH_ROUNDING_MM = 2e-12


@pytest.fixture(scope="module")
def machine():
    return load_machine("zha-gantry")


def session_stops(machine, seed=3):
    """Stops of a session with everything that any effect depends on."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(machine.lower_mm, machine.upper_mm, (5, 2, 3))
    lines = [Line(tuple(a), tuple(b), 6) for a, b in ends]
    lines.append(Line((-700.0, -400.0, -100.0), (-100.0, -400.0, -100.0), 6))  # Y and Z at rest
    trajectory = Trajectory(kind="lines", lines=tuple(lines), tools_mm=((0.0, 0.0, -120.0), (60.0, 40.0, -200.0)))
    session = Session(repeats=2, loads_kg=(0.0, 80.0), feeds_mm_min=(500.0, 3000.0), shuffled=True, jitter=0.05)
    names = ("x", "y", "z", "spindle", "ambient", "column_front", "column_rear")
    channels = {name: Temperature(20.0 + k, 0.5 * k, 1.0 + 0.2 * k, 900.0 + 170.0 * k) for k, name in enumerate(names)}
    return with_temperatures(plan_session(session, trajectory, machine, 1, rng), channels)


def lengths_of(stops):
    """Readings of both stations at every stop, without their lengths."""
    stop = np.repeat(np.arange(len(stops)), 2)
    station = np.tile([0, 1], len(stops))
    covariates = {"time_s": stops.time_s, **stops.covariates}
    labels = {"run": stops.run, **stops.labels}
    lengths = Lengths(
        stations=STATIONS,
        station=station,
        point=[stops.point[k] for k in stop],
        position_mm=stops.position_mm[stop],
        length_mm=np.zeros(len(stop)),
        tool_mm=stops.tool_mm[stop],
        approach=stops.approach[stop],
        labels={name: values[stop] for name, values in labels.items()},
        covariates={name: values[stop] for name, values in covariates.items()},
    )
    return lengths, stop


def forward_lengths(machine, stops, stop, station, name, keys):
    """True distances with one effect of the scenario file, from its own forward formula."""
    section = toml_files.Section({"name": name, **keys}, path=None)
    (effect,) = read_effects([section])
    tip_mm = tip_position(machine, np.zeros((len(stops), 21)), stops.position_mm, stops.tool_mm)
    if not isinstance(effect, LengthEffect):
        tip_mm = tip_mm + effect(machine, stops)
    sights = Sights(stops, stop, STATIONS, station, PLACES_MM[station], tip_mm[stop])
    distance = np.linalg.norm(sights.tip_mm - sights.station_mm, axis=1)
    return distance + (effect.change(sights) if isinstance(effect, LengthEffect) else 0.0)


def fixed(effect, readings):
    """The effect at one of its scan positions, if it has any."""
    positions = list(effect.positions(readings))
    return effect.at(positions[len(positions) // 2]) if positions else effect


NAMES = [name for name, effect in catalogue(STATIONS).items() if "lengths" in effect.card.kinds]


@pytest.mark.parametrize("chain", ["WFYXZT", "WXYFZT", "WZFXYT"])
@pytest.mark.parametrize("name", NAMES)
def test_columns_are_the_derivative_of_the_simulated_lengths(machine, chain, name):
    machine = replace(
        machine, chain=Chain(chain), errors=("EXX", "EYY", "EZZ") if "squareness" in name else "observable"
    )
    stops = session_stops(machine)
    lengths, stop = lengths_of(stops)
    readings = readings_of_lengths(machine, lengths, PLACES_MM[lengths.station], lengths.position_mm + lengths.tool_mm)
    effect = fixed(catalogue(STATIONS)[name], readings)
    columns = effect.columns(readings)
    if columns is None:
        assert name.startswith(("lever_", "sign_"))  # the chain models the error, or has no sign to be wrong
        return
    for k, parameter in enumerate(effect.card.parameters):
        step = 1e-2 * parameter.plausible
        around = 2.0 * step if name.startswith("cosine") else 0.0  # half a squared angle is not negative
        up, down = (
            forward_lengths(machine, stops, stop, lengths.station, name, {**effect.settings, parameter.name: size})
            for size in (around + step, around - step)
        )
        difference = (up - down) / (2.0 * step * parameter.si_per_unit)
        rounding = LENGTH_ROUNDING_MM / (step * parameter.si_per_unit)
        scale = np.abs(columns).max()
        assert np.abs(difference - columns[:, k]).max() < FIRST_ORDER * scale + rounding, parameter.name


def test_every_chain_has_the_levers_that_its_model_leaves_out_and_signs_where_two_products_tell(machine):
    stops = session_stops(machine)
    lengths, _ = lengths_of(stops)

    def present(chain):
        own = replace(machine, chain=Chain(chain))
        reads = readings_of_lengths(own, lengths, PLACES_MM[lengths.station], lengths.position_mm + lengths.tool_mm)
        found = {name: fixed(effect, reads).columns(reads) for name, effect in catalogue(STATIONS).items()}
        return {name for name, columns in found.items() if columns is not None and name.startswith(("lever", "sign"))}

    assert present("WFYXZT") == {"lever_ECX", "lever_EAZ", "lever_EBZ", "lever_ECZ", "sign_EBY"}
    assert len({name for name in present("WXYFZT") if name.startswith("lever")}) == 4


def test_levers_need_a_second_tool(machine):
    lengths, _ = lengths_of(session_stops(machine))
    one = replace(lengths, tool_mm=np.broadcast_to([0.0, 0.0, -120.0], lengths.position_mm.shape))
    readings = readings_of_lengths(machine, one, PLACES_MM[one.station], one.position_mm + one.tool_mm)
    lever = catalogue()["lever_ECX"]
    assert lever.columns(readings) is None and not list(lever.positions(readings))


def test_without_its_covariates_an_effect_has_no_columns(machine):
    lengths, _ = lengths_of(session_stops(machine))
    bare = replace(lengths, approach=None, labels={}, covariates={}, tool_mm=None)
    readings = readings_of_lengths(machine, bare, PLACES_MM[bare.station], bare.position_mm)
    present = {
        name for name, effect in catalogue(STATIONS).items() if fixed(effect, readings).columns(readings) is not None
    }
    assert present == {
        *(f"periodic_{a}" for a in "XYZ"), *(f"cosine_error_{a}" for a in "XYZ"), "beam_sag", "ram_droop", "laser_scale",
        "target_angle", "sign_EBY", *(f"tracer_runout_{name}" for name in STATIONS), "warmup_drift", "linear_drift",
    }  # fmt: skip


def test_a_temperature_that_is_missing_for_some_readings_counts_as_not_logged(machine):
    lengths, _ = lengths_of(session_stops(machine))
    warm = lengths.covariates["temp_spindle_c"].copy()
    warm[3] = np.nan
    lengths = replace(lengths, covariates={**lengths.covariates, "temp_spindle_c": warm})
    readings = readings_of_lengths(machine, lengths, PLACES_MM[lengths.station], lengths.position_mm)
    assert catalogue()["spindle_growth_Z"].columns(readings) is None


def test_velocity_follows_the_motion_within_a_run_and_rests_where_the_axis_does(machine):
    stops = session_stops(machine)
    lengths, stop = lengths_of(stops)
    readings = readings_of_lengths(machine, lengths, PLACES_MM[lengths.station], lengths.position_mm)
    velocity = velocity_mm_s(readings)
    along_x = lengths.labels["line"] >= 11
    feed = lengths.covariates["feed_mm_min"]
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), feed / 60.0)
    np.testing.assert_allclose(velocity[along_x], (feed * readings.approach[:, 0])[along_x, None] / 60.0 * [1.0, 0, 0])
    shuffled = np.random.default_rng(0).permutation(len(lengths))
    mixed = lengths.part(shuffled)
    other = velocity_mm_s(readings_of_lengths(machine, mixed, PLACES_MM[mixed.station], mixed.position_mm))
    np.testing.assert_array_equal(other, velocity[shuffled])


def test_velocity_is_approach_times_feed_where_neither_runs_nor_times_are_known(machine):
    lengths, _ = lengths_of(session_stops(machine))
    bare = replace(lengths, labels={}, covariates={"feed_mm_min": lengths.covariates["feed_mm_min"]})
    readings = readings_of_lengths(machine, bare, PLACES_MM[bare.station], bare.position_mm)
    np.testing.assert_allclose(velocity_mm_s(readings), bare.approach * bare.covariates["feed_mm_min"][:, None] / 60.0)


def test_steps_are_looked_for_between_runs(machine):
    stops = session_stops(machine)
    lengths, _ = lengths_of(stops)
    readings = readings_of_lengths(machine, lengths, PLACES_MM[lengths.station], lengths.position_mm)
    ends = [stops.time_s[stops.run == run] for run in np.unique(stops.run)]
    expected = [0.5 * (before[-1] + after[0]) for before, after in pairwise(ends)]
    np.testing.assert_allclose(step_times_s(readings), expected)


def test_periodic_errors_are_looked_for_at_usual_leads_where_the_machine_names_no_pitch(machine):
    lengths, _ = lengths_of(session_stops(machine))
    readings = readings_of_lengths(machine, lengths, PLACES_MM[lengths.station], lengths.position_mm)
    effect = catalogue()["periodic_X"]
    assert {10.0, 20.0} <= set(effect.positions(readings))
    axes = (replace(machine.axes[0], screw_pitch_mm=12.0), *machine.axes[1:])
    known = replace(readings, machine=replace(machine, axes=axes))
    assert not list(effect.positions(known)) and effect.used(known) == {"pitch_mm": 12.0}


@pytest.mark.parametrize(
    ("step", "shown"),
    [
        (1, ()),
        (2, ()),
        (1 / 2, ("c1",)),
        (1 / 3, ("s1", "c1")),
        (1 / 4, ("s1", "c1", "c2")),
        (0.37, ("s1", "c1", "s2", "c2")),
    ],
)
def test_periodic_errors_keep_only_the_waves_that_the_positions_show(machine, step, shown):
    """At n / 2 the sines are 0 and cos 2w is 1; at n / 3 sin 2w = -sin w, cos 2w = cos w; at n / 4 sin 2w is 0."""
    axes = (replace(machine.axes[0], screw_pitch_mm=25.4 / 3), *machine.axes[1:])
    position_mm = np.zeros((40, 3))
    position_mm[:, 0] = np.round(25.4 / 3 * step * np.arange(-40, 0), 3)  # as in a file
    deviations = Deviations(position_mm, np.zeros((40, 3)))
    readings = readings_of_deviations(replace(machine, axes=axes), deviations)
    effect = catalogue()["periodic_X"]
    found = effect.shown(readings)
    if not shown:
        assert found is None
        return
    own = np.any(found.columns(readings), axis=0)
    assert [p.name for p, seen in zip(effect.card.parameters, own, strict=True) if seen] == [f"{w}_um" for w in shown]
    assert np.array_equal(found.columns(readings)[:, own], effect.columns(readings)[:, own])


def test_warm_up_is_an_exponential_in_measuring_order():
    effect = catalogue()["warmup_drift"].at(5.0)
    machine = load_machine("zha-gantry")
    lengths = Lengths(("A",), np.zeros(8, dtype=np.int64), ["p"] * 8, np.zeros((8, 3)), np.zeros(8))
    readings = replace(readings_of_lengths(machine, lengths, np.full((8, 3), 100.0), np.zeros((8, 3))), kind="axis")
    np.testing.assert_allclose(effect.columns(readings)[:, 0], 1.0 - np.exp(-np.arange(8) / 5.0))
    timed = replace(readings, covariates={"time_s": 100.0 + 10.0 * np.arange(8)})
    np.testing.assert_allclose(effect.columns(timed)[:, 0], 1.0 - np.exp(-10.0 * np.arange(8) / 5.0))


def test_cards_are_complete():
    for name, effect in listed().items():
        card = effect.card
        assert card.name == name and card.title and card.equation and card.source and card.breaker, name
        assert not card.scan or card.scan in {setting.name for setting in card.settings}, name
        for parameter in card.parameters:
            assert parameter.meaning and parameter.plausible > 0 and parameter.si_per_unit > 0, name
        noise = set(card.kinds) & {"noise", "sixdof"}
        assert bool(card.parameters) != bool(noise), name
        assert noise or isinstance(effect, DisplacementEffect) or card.kinds in (("lengths",), ("axis",)), name


def test_alias_partners_are_effects_of_the_catalogue_or_words():
    known = set(listed()) | {name.partition("_<")[0] for name in listed()}
    for name, effect in listed().items():
        for alias in effect.card.aliases:
            assert alias in known or " " in alias, (name, alias)


def test_the_names_of_the_report_are_all_there():
    axes = [f"{family}_{a}" for a in "XYZ" for family in (
        "thermal_scale", "spindle_growth", "backlash", "lost_motion", "periodic", "servo_lag", "cosine_error", "stick_slip"
    )]  # fmt: skip
    stations = [f"{family}_S1" for family in ("station_drift", "length_step", "tracer_runout")]
    single = """
        column_bending beam_sag ram_droop load_deflection refractive_index dead_path laser_scale target_angle
        tool_offset_error sign_EBY outliers variance_trend autocorrelated_noise quantisation axis_mapping beam_drift
        crosstalk_yaw crosstalk_pitch nonparallel_beams distance_offset warmup_drift machine_jump
        lever_ECX lever_EAZ lever_EBZ lever_ECZ squareness_C0Y squareness_B0Z squareness_A0Z
    """
    assert {*axes, *stations, *single.split()} <= set(catalogue(("S1",)))


def test_families_are_registered_under_their_own_names():
    assert all(name == family.name for name, family in FAMILIES.items())


def test_within_a_few_runs_every_stop_may_be_a_step(machine):
    stops = session_stops(machine)
    lengths, _ = lengths_of(stops)
    readings = readings_of_lengths(machine, lengths, PLACES_MM[lengths.station], lengths.position_mm)
    end = stops.time_s[np.isin(stops.run, np.unique(stops.run)[:2])].max()
    few = readings.part(np.flatnonzero(readings.covariates["time_s"] <= end))
    times = np.unique(few.covariates["time_s"])
    np.testing.assert_allclose(step_times_s(few), 0.5 * (times[1:] + times[:-1]))
