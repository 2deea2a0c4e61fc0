"""A virtual machine and virtual instruments: measurement files whose truth is known."""

from compgen.simulate.effects import EFFECTS
from compgen.simulate.effects import Displacement as Effect
from compgen.simulate.gauges import Ballbar, TouchProbe
from compgen.simulate.lasers import AxisLaser, DiagonalLaser, LaserTracer, Station
from compgen.simulate.run import (
    INSTRUMENTS,
    Instrument,
    MovingSimulation,
    Scenario,
    SimulatedReadings,
    Simulation,
    actual_tips,
    read_scenario,
    simulate,
    simulate_axis_runs,
    simulate_moving,
    simulate_sixdof,
    write_simulation,
)
from compgen.simulate.sixdof import SimulatedSixDof
from compgen.simulate.trajectory import Line, Stops, Trajectory, plan_stops, trajectory_points
from compgen.simulate.truth import RandomErrors, TruthPlan, draw_truth

__all__ = [
    "EFFECTS",
    "INSTRUMENTS",
    "AxisLaser",
    "Ballbar",
    "DiagonalLaser",
    "Effect",
    "Instrument",
    "LaserTracer",
    "Line",
    "MovingSimulation",
    "RandomErrors",
    "Scenario",
    "Simulation",
    "SimulatedSixDof",
    "SimulatedReadings",
    "Station",
    "Stops",
    "TouchProbe",
    "Trajectory",
    "TruthPlan",
    "actual_tips",
    "draw_truth",
    "plan_stops",
    "read_scenario",
    "simulate",
    "simulate_axis_runs",
    "simulate_moving",
    "simulate_sixdof",
    "trajectory_points",
    "write_simulation",
]
