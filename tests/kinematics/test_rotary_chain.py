"""The exact chain with rotary axes against a product of 4 x 4 matrices that shares nothing with it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compgen.data.error_table import Curve, ErrorTable
from compgen.data.machine import Axis, Chain, Machine, RotaryAxis
from compgen.data.rotary import RotaryCurve, RotaryErrors, motion_names, position_names, unit_of
from compgen.errors import InputError
from compgen.kinematics.exact_chain import tip_position
from compgen.kinematics.rotary_chain import joints_of_tip, pose_error, tip_pose

CHAINS = (
    "WCAYFXZT",
    "WCYFXZBT",
    "WXYFZCBT",
    "WXYFZCAT",
    "WBYFXZAT",
    "WYXFZABT",
    "WCBXFYZT",
    "WFXYZCAT",
    "WCAXYZFT",
    "WXFYBZT",
)
UNITS = np.eye(3)


def five_axes(chain, rng, *, oblique=False):
    axes = tuple(Axis((-400.0, 400.0), np.linspace(-400.0, 400.0, 5)) for _ in range(3))
    rotary = {}
    for letter in Chain(chain).rotary:
        direction = UNITS["ABC".index(letter)] + (rng.uniform(-0.6, 0.6, 3) if oblique else 0.0)
        rotary[letter] = RotaryAxis(
            tuple(direction), tuple(rng.uniform(-80, 80, 3)), np.linspace(-120, 120, 9), range_deg=(-120.0, 120.0)
        )
    return Machine("five", Chain(chain), axes, tool_offset_mm=(3.0, -2.0, -90.0), rotary=rotary)


def drawn(machine, rng):
    curves = {
        f"E{part}{axis}": Curve(
            np.linspace(-400, 400, 5), (0.03 if part in "XYZ" else 2e-4) * rng.normal(size=5), np.zeros(5)
        )
        for axis in "XYZ"
        for part in "XYZABC"
    }
    squareness = {name: (3e-4 * rng.normal(), 0.0) for name in ("EC0Y", "EB0Z", "EA0Z")}
    turned, constants = {}, {}
    for letter in machine.rotary:
        for name in motion_names(letter):
            size = 0.02 if unit_of(name) == "um" else 2e-4
            turned[name] = RotaryCurve(np.linspace(-120, 120, 9), size * rng.normal(size=9), np.zeros(9))
        for name in position_names(letter):
            constants[name] = ((0.05 if unit_of(name) == "um" else 3e-4) * rng.normal(), 0.0)
    return ErrorTable(curves, squareness), RotaryErrors(turned, constants)


def moved(vector):
    matrix = np.eye(4)
    matrix[:3, 3] = vector
    return matrix


def turned(vector):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    return matrix


def product(machine, errors, rotary, position, angle):
    """Workpiece to tool by the words of the model: (tip, orientation) without the tool offset applied to rotations."""
    values = errors.at(position[None])[0]
    c0y, b0z, a0z = (errors.squareness.get(name, (0.0, 0.0))[0] for name in ("EC0Y", "EB0Z", "EA0Z"))
    direction = [
        UNITS[0],
        Rotation.from_rotvec([0, 0, c0y]).apply(UNITS[1]),
        Rotation.from_rotvec([a0z, b0z, 0]).apply(UNITS[2]),
    ]
    left, _, right = machine.chain.name[1:-1].partition("F")
    sides = []
    for letters, sign in ((right, 1.0), (left[::-1], -1.0)):
        pose = np.eye(4)
        for letter in letters:
            if letter in "XYZ":
                k = "XYZ".index(letter)
                delta, eps = values[6 * k : 6 * k + 3], values[6 * k + 3 : 6 * k + 6]
                pose = pose @ moved(sign * position[k] * direction[k]) @ moved(sign * delta) @ turned(sign * eps)
                continue
            axis = machine.rotary[letter]
            u, p = np.array(axis.direction), np.array(axis.point_mm)
            own = UNITS["ABC".index(letter)]
            between = np.cross(own, u)
            sine = np.linalg.norm(between)
            basis = Rotation.from_rotvec(between / sine * np.arctan2(sine, own @ u) if sine > 1e-12 else np.zeros(3))
            small = [
                (rotary.curves[name].value if name in rotary.curves else np.zeros(9)) for name in motion_names(letter)
            ]
            at = [np.interp(angle[letter], np.linspace(-120, 120, 9), one) - one[4] for one in small]
            fixed = np.zeros(6)
            for name in position_names(letter):
                fixed["XYZABC".index(name[1])] = rotary.constants.get(name, (0.0, 0.0))[0]
            small_motion, place = (
                moved(basis.apply(part[:3])) @ turned(basis.apply(part[3:])) for part in (np.array(at), fixed)
            )
            if sign < 0:
                small_motion, place = np.linalg.inv(small_motion), np.linalg.inv(place)
            pose = pose @ moved(p) @ place @ small_motion @ turned(sign * np.radians(angle[letter]) * u) @ moved(-p)
        sides.append(pose)
    return np.linalg.inv(sides[1]) @ sides[0]


@pytest.mark.parametrize("oblique", [False, True])
@pytest.mark.parametrize("chain", CHAINS)
def test_the_chain_is_the_product_of_its_bodies(chain, oblique):
    rng = np.random.default_rng([len(chain), ord(chain[1]), oblique])
    machine = five_axes(chain, rng, oblique=oblique)
    errors, rotary = drawn(machine, rng)
    position = rng.uniform(-300, 300, (4, 3))
    angle = {letter: rng.uniform(-110, 110, 4) for letter in machine.rotary}
    tip, orientation = tip_pose(machine, errors, rotary, position, angle)
    for k in range(4):
        pose = product(machine, errors, rotary, position[k], {letter: own[k] for letter, own in angle.items()})
        assert tip[k] == pytest.approx(pose[:3, :3] @ machine.tool_offset_mm + pose[:3, 3], rel=0, abs=1e-9)
        assert orientation[k] == pytest.approx(pose[:3, :3], rel=0, abs=1e-12)


@pytest.mark.parametrize("chain", CHAINS)
def test_with_its_rotary_axes_at_zero_it_is_the_machine_of_three_axes(chain):
    rng = np.random.default_rng(1)
    machine = five_axes(chain, rng)
    errors, _ = drawn(machine, rng)
    position = rng.uniform(-300, 300, (5, 3))
    angle = {letter: np.zeros(5) for letter in machine.rotary}
    three = Machine("three", Chain(machine.chain.linear), machine.axes, tool_offset_mm=machine.tool_offset_mm)
    tip, _ = tip_pose(machine, errors, RotaryErrors(), position, angle)
    assert tip == pytest.approx(tip_position(three, errors.at(position), position), rel=0, abs=1e-10)


def test_signs_by_hand():
    """A table whose C axis has EX0C > 0 has its axis line at -EX0C; the tool is too far in +X relative to the workpiece."""
    rng = np.random.default_rng(0)
    for chain in ("WCYFXZT", "WXYFZCT"):
        machine = five_axes(chain, rng)
        zero, quarter = ({"C": np.array([at])} for at in (0.0, 90.0))
        where = np.zeros((1, 3))
        moved_x, _ = pose_error(machine, ErrorTable(), RotaryErrors({}, {"EX0C": (0.1, 0.0)}), where, zero)
        assert moved_x[0] == pytest.approx([0.1, 0.0, 0.0], abs=1e-12)
        far = RotaryErrors({}, {"EC0C": (1e-4, 0.0)})  # the tool turns too far about +Z relative to the workpiece
        assert pose_error(machine, ErrorTable(), far, where, zero)[1][0] == pytest.approx([0.0, 0.0, 1e-4], abs=1e-12)
        tip, _ = pose_error(machine, ErrorTable(), RotaryErrors({}, {"EX0C": (0.1, 0.0)}), where, quarter)
        # a head moves as before; the frame of a table has turned with it by -90 degrees
        assert tip[0] == pytest.approx(
            [0.0, 0.1, 0.0] if chain.index("C") < chain.index("F") else [0.1, 0.0, 0.0], abs=1e-12
        )


def test_axes_for_a_tip_are_those_that_lead_there():
    rng = np.random.default_rng(3)
    for chain in CHAINS:
        machine = five_axes(chain, rng)
        position = rng.uniform(-300, 300, (6, 3))
        angle = {letter: rng.uniform(-110, 110, 6) for letter in machine.rotary}
        tool = rng.uniform(-150, 0, (6, 3))
        tip, _ = tip_pose(machine, ErrorTable(), RotaryErrors(), position, angle, tool)
        assert joints_of_tip(machine, tip, angle, tool) == pytest.approx(position, rel=0, abs=1e-9)


@pytest.mark.parametrize("name", ["WFYXZ", "WFYXZZT", "WCCFXYZT", "WDFXYZT", "FWXYZT", "WAXYZT", ""])
def test_a_chain_that_is_none_is_refused(name):
    with pytest.raises(InputError, match="is not valid; expected W, then X, Y, Z and F once each"):
        Chain(name)
