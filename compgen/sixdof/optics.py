"""Constants of the six-DOF laser instrument, and which error of which axis each of its channels sees.

P. Jia, B. Zhang, F. Zheng, Q. Feng, Meas. Sci. Technol. 33 (2022) 015202, corrected by exact ray tracing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: Rows of every model matrix: interferometer, spots of beams 1 and 2, angle of the beam reflected by the film, in mm.
SIGNALS = ("displacement_mm", "y_qd1_mm", "z_qd1_mm", "y_qd2_mm", "z_qd2_mm", "y_psd1_mm", "z_psd1_mm")
#: Columns of the error matrix: along the beam, along the Y and the Z detector, about their axes, about the beam.
ROLES = ("along", "horizontal", "vertical", "yaw", "pitch", "roll")
#: ISO 230-1 names of the errors of X, Y and Z in the order of ROLES (Jia et al. 2022, eq. 5-7).
ERRORS_OF_AXIS = (
    ("EXX", "EYX", "EZX", "ECX", "EBX", "EAX"),
    ("EYY", "EXY", "EZY", "ECY", "EAY", "EBY"),
    ("EZZ", "EYZ", "EXZ", "EAZ", "EBZ", "ECZ"),
)
#: Machine axes of ``along``, ``horizontal``, ``vertical`` (translations) for X, Y and Z.
DIRECTIONS = ((0, 1, 2), (1, 0, 2), (2, 1, 0))
#: Machine axes of ``yaw``, ``pitch``, ``roll`` (rotations) for X, Y and Z.
ROTATIONS = ((2, 1, 0), (2, 0, 1), (0, 1, 2))
#: (along x horizontal) . vertical: the handedness of the channels at the target.
HANDEDNESS = (1, -1, -1)


@dataclass(frozen=True)
class Optics:
    """Constants of the optics.

    Parameters
    ----------
    focal_length_mm : f of the lenses of the angle channels.
    beam_separation_mm : h, beam 2 runs at y = -h of the unit.
    glass_index : n of plate, cube corners and first prism.
    cube_side_mm : a, side of the equilateral entry face of the cube corner; its apex lies sqrt(6) a / 6 behind it.
    plate_thickness_mm : L_D of the plate that carries the reflecting film in front of the cube corner.
    prism_leg_mm : b of the right-angle prisms.
    exit_to_prism_mm : l_0 from the exit (and detector) plane of the unit to the prism.
    """

    focal_length_mm: float = 100.0
    beam_separation_mm: float = 30.0
    glass_index: float = 1.5151
    cube_side_mm: float = 30.0
    plate_thickness_mm: float = 3.0
    prism_leg_mm: float = 25.4
    exit_to_prism_mm: float = 0.0

    @property
    def apex_depth_mm(self) -> float:
        """Depth of the cube's apex behind the front face of the plate, in glass."""
        return self.plate_thickness_mm + float(np.sqrt(6.0)) * self.cube_side_mm / 6.0

    @property
    def reduced_depth_mm(self) -> float:
        """The reduced depth t = (L_D + sqrt(6) a / 6) / n."""
        return self.apex_depth_mm / self.glass_index

    def reduced_prism_mm(self, axis: int) -> float:
        """Path through the prism of an axis, reduced by the index: none for X, b/n in glass for Y, b in air for Z."""
        return (0.0, self.prism_leg_mm / self.glass_index, self.prism_leg_mm)[axis]

    def lever_mm(self, axis: int) -> float:
        """l_p: from the reference point of the axis' translations to the exit plane if the unit moves."""
        return 0.0 if axis == 0 else 0.5 * self.prism_leg_mm
