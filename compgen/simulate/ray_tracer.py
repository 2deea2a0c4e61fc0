"""Exact vector ray tracer of the six-DOF instrument: refraction and reflection at planes, cube corner, prism, plate.

Written from the geometry alone, not from the linear model; it stands where Jia et al. 2022 used a ray tracing program.

Frame of the unit: beam 1 leaves along +x on y = z = 0, beam 2 at y = -h; the detectors lie in the exit plane.
X: the beam goes straight on, the front face of the target stands at x = L. Y: prism 1 with entrance face x = -b/2,
reflector y = x, exit face y = b/2. Z: prism 2 reflects on its outside at z = x. Front faces at b/2 + L behind a prism.
A beam along the negative axis is the same picture after half a turn about the vertical direction.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from compgen.core.csvio import FloatArray
from compgen.sixdof.optics import DIRECTIONS, SIGNALS, Optics

X, Y, Z = np.eye(3)


@dataclass(frozen=True)
class Pose:
    """A rigid placement x -> turn x + shift_mm; ``turn`` (3, 3) is a rotation."""

    turn: FloatArray = field(default_factory=lambda: np.eye(3))
    shift_mm: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __matmul__(self, inner: Pose) -> Pose:
        """First ``inner``, then this one."""
        return Pose(self.turn @ inner.turn, self.turn @ inner.shift_mm + self.shift_mm)

    def inverse(self) -> Pose:
        """The placement undone."""
        return Pose(self.turn.T, -self.turn.T @ self.shift_mm)

    def about(self, pivot_mm: FloatArray) -> Pose:
        """The same turn about ``pivot_mm``."""
        return Pose(self.turn, self.shift_mm + pivot_mm - self.turn @ pivot_mm)


def rotation(vector_rad: FloatArray) -> FloatArray:
    """Rotation matrix of a rotation vector, rad."""
    angle = float(np.linalg.norm(vector_rad))
    matrix = np.array(
        [
            [0.0, -vector_rad[2], vector_rad[1]],
            [vector_rad[2], 0.0, -vector_rad[0]],
            [-vector_rad[1], vector_rad[0], 0.0],
        ]
    )
    once, twice = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + once * matrix + twice * matrix @ matrix)


@dataclass(frozen=True)
class Ray:
    """A ray: a point, a unit direction, and the optical path so far, mm."""

    point_mm: FloatArray
    direction: FloatArray
    path_mm: float = 0.0


@dataclass(frozen=True)
class Plane:
    """A plane through ``point_mm`` with unit ``normal``."""

    point_mm: FloatArray
    normal: FloatArray

    def placed(self, pose: Pose) -> Plane:
        """The plane moved by ``pose``."""
        return Plane(pose.turn @ self.point_mm + pose.shift_mm, pose.turn @ self.normal)

    def turned(self, vector_rad: FloatArray) -> Plane:
        """The plane turned about its own point."""
        return Plane(self.point_mm, rotation(vector_rad) @ self.normal)


def _advance(ray: Ray, plane: Plane, index: float) -> Ray:
    """Go along the ray to the plane, through a medium of refractive ``index``."""
    distance = float((plane.point_mm - ray.point_mm) @ plane.normal / (ray.direction @ plane.normal))
    return Ray(ray.point_mm + distance * ray.direction, ray.direction, ray.path_mm + index * distance)


def reflect(ray: Ray, plane: Plane, index: float = 1.0) -> Ray:
    """Go to the plane in a medium of ``index`` and reflect."""
    there = _advance(ray, plane, index)
    direction = there.direction - 2.0 * (there.direction @ plane.normal) * plane.normal
    return Ray(there.point_mm, direction, there.path_mm)


def refract(ray: Ray, plane: Plane, before: float, after: float) -> Ray:
    """Go to the plane in a medium of index ``before`` and refract into one of index ``after`` (Snell, as vectors)."""
    there = _advance(ray, plane, before)
    cosine = float(there.direction @ plane.normal)
    normal = plane.normal if cosine > 0 else -plane.normal
    ratio, cosine = before / after, abs(cosine)
    inside = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
    return Ray(there.point_mm, ratio * there.direction + (inside - ratio * cosine) * normal, there.path_mm)


@dataclass(frozen=True)
class Geometry:
    """Where things stand for one axis, before any error.

    Parameters
    ----------
    axis : 0, 1, 2 for X, Y, Z.
    exit_mm : x of the exit and detector plane.
    target : from the target's own frame (beam along +x, its horizontal along +y) to the unit's frame at distance 0.
    """

    axis: int
    exit_mm: float
    target: Pose


def _geometry(optics: Optics, axis: int) -> Geometry:
    half, ahead = 0.5 * optics.prism_leg_mm, optics.exit_to_prism_mm
    if axis == 0:
        return Geometry(0, -ahead, Pose())
    along = np.eye(3)[axis]
    turn = np.column_stack([along, *_across(axis)])
    return Geometry(axis, -half - ahead, Pose(turn, half * along))


def _across(axis: int) -> tuple[FloatArray, FloatArray]:
    """Two directions that make a right-handed frame with the axis."""
    return (Y, Z) if axis == 0 else (Z, X) if axis == 1 else (X, Y)


Path = Callable[[Ray], Ray]


def _vector(values: Mapping[str, float], kind: str, suffix: str) -> FloatArray:
    return np.array([values.get(f"{kind}_{letter}{suffix}", 0.0) for letter in "xyz"])


def _pose(values: Mapping[str, float], suffix: str) -> Pose:
    return Pose(rotation(_vector(values, "eps", suffix)), _vector(values, "delta", suffix))


class Tracer:
    """The instrument set up at one axis with its systematic parameters (mm, rad, names of the linear model)."""

    def __init__(
        self,
        optics: Optics,
        axis: int,
        mode: int = 1,
        beam_direction: int = 1,
        systematics: Mapping[str, float] | None = None,
    ) -> None:
        self.optics, self.mode, self.beam_direction = optics, mode, beam_direction
        self.half_turn = np.eye(3)
        if beam_direction < 0:
            self.half_turn = 2.0 * np.outer(np.eye(3)[DIRECTIONS[axis][2]], np.eye(3)[DIRECTIONS[axis][2]]) - np.eye(3)
        self.values = self._own_frame(systematics or {}, axis)
        self.geometry = _geometry(optics, axis)
        self._out, self._back = self._prism(self.values)

    def _own_frame(self, values: Mapping[str, float], axis: int) -> dict[str, float]:
        """Parameters in the frame of the picture: machine axes after the half turn; beam tilts by their channel."""
        own = {}
        for name, value in values.items():
            rest = name.partition("_")[2]
            if rest.startswith("PE"):
                own[name] = value * (self.beam_direction if rest == "PEz" else 1)
            else:
                own[name] = value * float(self.half_turn["xyz".index(rest[0]), "xyz".index(rest[0])])
        return own

    def _prism(self, values: Mapping[str, float]) -> tuple[Path, Path]:
        """The way from unit to target and back through the prism of the axis."""
        axis, n = self.geometry.axis, self.optics.glass_index
        half = 0.5 * self.optics.prism_leg_mm
        pose = _pose(values, "ir").about(np.array([-half, 0.0, 0.0]))
        if axis == 0:
            return (lambda ray: ray), (lambda ray: ray)
        if axis == 2:
            mirror = Plane(np.zeros(3), (X - Z) / np.sqrt(2.0)).placed(pose)
            return (lambda ray: reflect(ray, mirror)), (lambda ray: reflect(ray, mirror))
        entrance = Plane(-half * X, X).turned(_vector(values, "eps", "mrs1")).placed(pose)
        mirror = Plane(np.zeros(3), (X - Y) / np.sqrt(2.0)).placed(pose)
        leave = Plane(half * Y, Y).turned(_vector(values, "eps", "mrs2")).placed(pose)

        def out(ray: Ray) -> Ray:
            return refract(reflect(refract(ray, entrance, 1.0, n), mirror, n), leave, n, 1.0)

        def back(ray: Ray) -> Ray:
            return refract(reflect(refract(ray, leave, 1.0, n), mirror, n), entrance, n, 1.0)

        return out, back

    def _target(self, travel_mm: float, distance_mm: float, delta_mm: FloatArray, eps_rad: FloatArray) -> Pose:
        """Pose of the target's frame (origin: front centre at beam 1) in the frame of the unit."""
        along = self.geometry.target.turn[:, 0]
        start = Pose(shift_mm=self.geometry.target.shift_mm + distance_mm * along)
        install = _pose(self.values, "ic")
        delta, eps = self.half_turn @ delta_mm, self.half_turn @ eps_rad
        if self.mode == 1:
            moved = start @ Pose(rotation(eps), delta + travel_mm * along)
        else:
            moved = Pose(rotation(eps), delta + travel_mm * along).inverse() @ start
        return moved @ install @ Pose(self.geometry.target.turn)

    def signals(
        self,
        distance_mm: float,
        delta_mm: FloatArray,
        eps_rad: FloatArray,
        *,
        drift_rad: tuple[float, float] = (0.0, 0.0),
        travel_mm: float = 0.0,
    ) -> FloatArray:
        """Signals in mm in the order of SIGNALS, shape (7,).

        Parameters
        ----------
        distance_mm : L at travel 0, from the exit face of the prism (X: exit plane, less l_0) to the front face.
        delta_mm, eps_rad : motion errors of the moving body in machine axes, each (3,): of the target about the front
            centre of its first cube corner (mode 1), of unit and prism about the point where beam 1 meets the
            reflector (X: the exit point) (mode 2).
        drift_rad : tilt of both beams toward unit +y and +z, as the channels are read.
        travel_mm : travel of the moving body from where L holds, along the beam.
        """
        optics, geometry = self.optics, self.geometry
        pose = self._target(travel_mm, distance_mm, np.asarray(delta_mm), np.asarray(eps_rad))
        flip = float(self.beam_direction)
        tilt = np.array([flip * drift_rad[0], drift_rad[1]])
        first = self._beam(np.zeros(2), tilt)
        parallel = np.array([self.values.get("eps_PEz", 0.0), -self.values.get("eps_PEy", 0.0)])
        second = self._beam(np.array([-flip * optics.beam_separation_mm, 0.0]), tilt + parallel)
        number = 2 * geometry.axis + 1
        spot1, path = self._spot(first, pose, number)
        spot2, _ = self._spot(second, pose, number + 1, offset=-flip * optics.beam_separation_mm)
        angle = self._autocollimation(second, pose)
        nominal = (
            distance_mm
            + self.optics.exit_to_prism_mm
            + self._nominal_prism()
            + optics.apex_depth_mm * (optics.glass_index)
        )
        displacement = 0.5 * path - nominal
        result = np.array(
            [displacement, flip * spot1[0], spot1[1], flip * spot2[0], spot2[1], flip * angle[0], angle[1]]
        )
        assert len(result) == len(SIGNALS)
        return result

    def _nominal_prism(self) -> float:
        leg = self.optics.prism_leg_mm
        return (0.0, leg * self.optics.glass_index, leg)[self.geometry.axis]

    def _beam(self, offset_mm: FloatArray, tilt_rad: FloatArray) -> Ray:
        direction = np.array([1.0, tilt_rad[0], tilt_rad[1]])
        point = np.array([self.geometry.exit_mm, offset_mm[0], offset_mm[1]])
        return Ray(point, direction / np.linalg.norm(direction))

    def _cube(self, pose: Pose, offset_mm: float) -> tuple[Plane, list[Plane]]:
        """Front plane of the plate, and the three mirrors that meet at the apex behind it, ``offset_mm`` beside beam 1."""
        beside = np.eye(3)[DIRECTIONS[self.geometry.axis][1]]
        local = self.geometry.target.turn.T @ beside * offset_mm
        front = Plane(np.zeros(3), X).placed(pose)
        apex = local + self.optics.apex_depth_mm * X
        return front, [Plane(apex, normal).placed(pose) for normal in _TRIAD]

    def _spot(self, ray: Ray, pose: Pose, number: int, offset: float = 0.0) -> tuple[FloatArray, float]:
        """Spot (y, z) of the beam that cube corner ``number`` returns, and the whole optical path."""
        n = self.optics.glass_index
        front, mirrors = self._cube(pose, offset)
        ray = refract(self._out(ray), front, 1.0, n)
        for mirror in mirrors:
            ray = reflect(ray, mirror, n)
        ray = refract(ray, front, n, 1.0)
        turned = rotation(_vector(self.values, "eps", f"mc{number}")) @ ray.direction
        ray = Ray(ray.point_mm + _vector(self.values, "delta", f"mc{number}"), turned, ray.path_mm)
        end = _advance(self._back(ray), Plane(self.geometry.exit_mm * X, X), 1.0)
        return end.point_mm[1:] - np.array([offset, 0.0]), end.path_mm

    def _autocollimation(self, ray: Ray, pose: Pose) -> FloatArray:
        """Spot (y, z) behind the angle lens of the beam that the film on the front face reflects."""
        front = Plane(np.zeros(3), X).placed(pose)
        direction = self._back(reflect(self._out(ray), front)).direction
        return np.asarray(self.optics.focal_length_mm * direction[1:] / abs(direction[0]))


def _triad() -> FloatArray:
    """Three perpendicular unit normals, one a row, all inclined alike to +x."""
    first = np.ones(3) / np.sqrt(3.0)
    second = np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
    return np.column_stack([first, second, np.cross(first, second)])


_TRIAD = _triad()
