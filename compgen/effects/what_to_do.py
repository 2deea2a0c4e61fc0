"""What to do about each effect of the catalogue, a sentence for the one who stands at the machine."""

from __future__ import annotations

from compgen.effects.base import Card

#: By family: the name of the effect without the axis, station or error at its end.
WHAT_TO_DO = {
    "thermal_scale": "set the control's temperature compensation of this axis to this coefficient, fixed point and "
    "reference temperature, or let the axis reach its working temperature before the test; the tables do not follow it",
    "spindle_growth": "warm the spindle up at working speed before measuring, or use the control's compensation of spindle "
    "growth with this coefficient",
    "column_bending": "shield the column from draught and sun, or run it warm before measuring; compensate by the "
    "difference of two temperatures of the column if the control can",
    "backlash": "enter the reversal value (twice c) as the control's backlash compensation of this axis, or export tables "
    "with reversal; look at nut, preload, coupling and thrust bearing if it has grown",
    "lost_motion": "a single backlash value cannot hold it: export tables for each direction; look for a worn stretch of the "
    "screw, wind-up of a long screw and sticking guides, and measure again after lubrication",
    "periodic": "use table positions at a fraction of the pitch, or the control's periodic compensation; look at screw run-out, "
    "coupling and scale mounting, and measure one pitch in steps of a tenth",
    "servo_lag": "adapt loop gain (KV) or velocity feed-forward, or dwell before each reading; tables cannot hold it",
    "lever": "let the model of the machine file contain this angular error, measure with a second tool offset, and export it",
    "squareness": "let the model of the machine file contain this squareness and export it; check the alignment of the guides "
    "if it is new",
    "beam_sag": "measure more sections along the beam, and let the tables follow two axes; check the balance of the carriage",
    "ram_droop": "export tables over both axes, and measure with the heaviest tool; check the counterbalance",
    "load_deflection": "measure with the load of the workpieces, and keep one set of tables for each class of load",
    "refractive_index": "log air temperature, pressure and humidity beside the beam and switch the wavelength compensation on",
    "dead_path": "zero the interferometer close to the reflector's nearest point, or enter the dead path into its software",
    "laser_scale": "check wavelength and material compensation of the interferometer against a calibrated length",
    "station_drift": "let the tracer warm up, clamp it on the table and not on a tripod, and return to one reference point "
    "every few minutes",
    "length_step": "find the broken beam in the log, and measure these lines again with a reference point before and after",
    "machine_jump": "look for a bump, a clamp or a table that slipped at this time, and measure what came after it again",
    "tracer_runout": "have the centring of the tracer's sphere checked, or turn its head by 180 degrees and take the mean",
    "target_angle": "point the reflector at the station, or use one with a wider angle, and measure the far lines again",
    "tool_offset_error": "measure the length and the offset of the target again and enter them; a third offset shows which is "
    "wrong",
    "sign": "check sign and lever arm of this error in the machine file and in the source of the tables before any export",
    "cosine_error": "align the beam with the axis again",
    "warmup_drift": "repeat the test after a warm-up of three time constants with the axis moving and the sensor switched on; "
    "whether machine or sensor warms up shows a stationary test (axis at rest, then sensor warm)",
    "linear_drift": "log the temperatures of scale, workpiece and air, and repeat the test in a longer session: a warm-up "
    "levels off, a drift of sensor or room goes on",
    "step_between_runs": "look for what happened between these runs (zero set again, bumped sensor or optics, a slipped "
    "clamp, an axis that was homed), fix the sensor, and repeat the runs on one side of the step",
    "bad_run": "leave this run out and measure it again; look at what was different (first run after a stop, door open, "
    "another feed, a beam that was cut)",
    "disturbed_readings": "leave these readings out or measure them again; look for draught, vibration or people at that time",
    "settling": "raise the dwell at each target to five time constants before reading; if it stays, look at integral gain "
    "and friction of the axis",
    "outliers": "measure these readings again; they are left out of everything else",
    "variance_trend": "find what grew louder (draught, vibration, a warming laser), and repeat a few lines at the beginning "
    "and at the end",
    "autocorrelated_noise": "take repeats far apart in time and in random order; shield the beam from draught",
    "quantisation": "log more decimals",
    "axis_mapping": "correct columns or signs in the file, and confirm by a small move of one axis before any export",
    "stick_slip": "lubricate the guide, look at its preload and at the friction compensation of the control, and approach each "
    "target slowly and fast",
    "crosstalk_yaw": "turn the target by 180 degrees and measure again; have the instrument's crosstalk calibrated",
    "crosstalk_pitch": "turn the target by 180 degrees and measure again; have the instrument's crosstalk calibrated",
    "beam_drift": "let the laser warm up, shield its beam, and run forth and back three times",
    "detector_gain": "have the gain of this detector calibrated and entered into the instrument's file",
    "nonparallel_beams": "have the instrument's beams adjusted, or enter their angle into its file",
    "distance_offset": "enter the distance of the target's points into the instrument's file",
}


def what_to_do(card: Card) -> str:
    """Return what to do about an effect; for one of a plug-in without such a sentence, what to measure next."""
    name = card.name
    while name:
        if name in WHAT_TO_DO:
            return WHAT_TO_DO[name]
        name = name.rpartition("_")[0]
    return f"measure next: {card.breaker}" if card.breaker else "measure again, every line at least twice"
