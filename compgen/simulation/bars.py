"""A bar between a ball on the table and one in the spindle of a virtual machine with rotary axes: ``*.bar.csv``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from compgen.data import toml_files
from compgen.data.csv_files import FloatArray
from compgen.data.error_table import ErrorTable
from compgen.data.machine import Machine, Vector3
from compgen.data.names import AXES, MM_PER_UM
from compgen.data.pose_readings import Bars
from compgen.data.rotary import JOINTS, RotaryErrors
from compgen.data.toml_files import setting
from compgen.errors import InputError, Message
from compgen.kinematics.rotary_chain import joints_of_tip, tip_pose
from compgen.simulation.spheres import RotaryTruth
from compgen.simulation.trajectory import check_stops


@toml_files.accepts({"type": "array", "items": {"enum": list(AXES)}, "minItems": 1})
def _directions(value: object) -> tuple[str, ...]:
    if not isinstance(value, list) or not value or not set(value) <= set(AXES):
        raise ValueError(
            Message("bar-axes-expected", 'expected axes that the bar points along, such as ["X", "Y", "Z"]')
        )
    return tuple(value)


@dataclass(frozen=True)
class RotaryBallbar(RotaryTruth):
    """A bar that follows turned axes (ISO 10791-6, BK and CK): it points along an axis of the machine at every pose.

    Parameters
    ----------
    balls_mm : places of the ball on the table in the workpiece frame; each is a set-up.
    bar_mm : length of the bar between the centres of the balls.
    tool_length_mm : from the gauge point of the spindle to its ball, along -Z.
    directions : axes of the machine along which the bar points, each at all poses of a set-up.
    poses : number of poses for each ball and direction, drawn evenly over the travel of all rotary axes.
    noise_um : standard deviation of a reading.
    setup_um, length_um : standard deviations of the place of the ball (each coordinate), and of the length of the bar.
    """

    balls_mm: tuple[Vector3, ...] = setting(toml_files.vectors3)
    bar_mm: float = setting(toml_files.positive, 100.0)
    tool_length_mm: float = setting(toml_files.positive, 100.0)
    directions: tuple[str, ...] = setting(_directions, AXES)
    poses: int = setting(toml_files.whole(4, 100_000), 40)
    noise_um: float = setting(toml_files.not_negative, 0.5)
    setup_um: float = setting(toml_files.not_negative, 20.0)
    length_um: float = setting(toml_files.not_negative, 5.0)

    def measure(self, machine: Machine, errors: ErrorTable, rotary: RotaryErrors, rng: np.random.Generator) -> Bars:
        """Lengths between the balls, with noise; the ball on the table is off by its set-up, the bar by its length."""
        if not machine.rotary:
            raise InputError(
                Message(
                    "machine-without-rotary-axis",
                    "the machine {name} has no rotary axis; see [axes.C] in docs/five-axis.md",
                    name=machine.name,
                )
            )
        each = self.poses * len(self.directions)
        count = each * len(self.balls_mm)
        ball = np.repeat(self.balls_mm, each, axis=0)
        pointing = np.tile(np.repeat([AXES.index(axis) for axis in self.directions], self.poses), len(self.balls_mm))
        tool = np.tile(np.array(machine.tool_offset_mm) + [0.0, 0.0, -self.tool_length_mm], (count, 1))
        angle: dict[str, FloatArray] = {
            letter: np.round(rng.uniform(*axis.ends_deg, count), 3) for letter, axis in sorted(machine.rotary.items())
        }
        joint = joints_of_tip(machine, ball, angle, tool) + self.bar_mm * np.eye(3)[pointing]
        try:
            check_stops(joint, machine)
        except InputError as error:
            text = f"{error.message.partition(';')[0]}; a bar leads there: change balls_mm, or the ranges of the axes"
            raise InputError(text, field="[instrument] balls_mm") from None
        setup = np.repeat(np.arange(len(self.balls_mm)), each)
        off = self.setup_um * MM_PER_UM * rng.standard_normal((len(self.balls_mm), 3))
        longer = self.length_um * MM_PER_UM * rng.standard_normal(len(self.balls_mm))
        tip = tip_pose(machine, errors, rotary, joint, angle, tool)[0]
        length = np.linalg.norm(tip - ball - off[setup], axis=1) - self.bar_mm - longer[setup]
        return Bars(
            found_mm=joint,
            coordinates=JOINTS,
            angle_deg=angle,
            tool_mm=tool,
            setup=setup + 1,
            u_mm=np.full(count, self.noise_um * MM_PER_UM if self.noise_um else np.nan),
            ball_mm=ball,
            nominal_mm=np.full(count, self.bar_mm),
            deviation_mm=length + self.noise_um * MM_PER_UM * rng.standard_normal(count),
            metadata={"instrument": "rotary-ballbar"},
        )


def read_rotary_ballbar(section: toml_files.Section) -> RotaryBallbar:
    """A bar between two balls at poses of all rotary axes: *.bar.csv."""
    return toml_files.read_settings(RotaryBallbar, section)
