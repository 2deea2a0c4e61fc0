"""LinuxCNC: COMP_FILE per joint (linuxcnc-comp), kinematics component with a lattice (linuxcnc-volumetric)."""
