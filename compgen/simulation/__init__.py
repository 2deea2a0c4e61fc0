"""A virtual machine and virtual instruments: measurement files whose truth is known."""

from compgen.simulation.effects import EFFECTS
from compgen.simulation.effects import Displacement as Effect
from compgen.simulation.gauges import Ballbar, TouchProbe
from compgen.simulation.lasers import AxisLaser, DiagonalLaser, LaserTracer, Station
from compgen.simulation.run import (
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
from compgen.simulation.sixdof import SimulatedSixDof
from compgen.simulation.trajectory import Line, Stops, Trajectory, plan_stops, trajectory_points
from compgen.simulation.truth import RandomErrors, TruthPlan, draw_truth

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
