// SPDX-License-Identifier: GPL-2.0-or-later
//
// volcomp.comp - HAL component that adds a volumetric compensation between motion and the drives.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING in this folder, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.

component volcomp "Volumetric compensation of three linear axes between motion and the drives";

description """
For machines whose kinematics (trivkins) must not be replaced, one joint for each of X, Y and Z. It adds the same correction
as volkins, in every mode, and the display does not show it. Order of the functions in the servo thread: volcomp.feedback,
motion-controller, volcomp.command. Positions are joint.N.pos-cmd, machine coordinates. All lengths are in machine units.
Load: loadrt volcomp file=volcomp.tab units=[TRAJ]LINEAR_UNITS. A table in another unit is not used.

Positions are valid only after homing: net enable to motion.is-all-homed. While enable is FALSE nothing is added. A change
without motion (of enable, of the tool offset, of a position that homing redefines) would be a step of the drives; the
correction then continues from its last value and approaches the new one at the speed given by the pin rate. The correction
that belongs to motion follows at once. Net settling to motion.feed-inhibit, so that nothing is cut with an incomplete correction.

The table is read once, at loadrt: a new table takes effect after LinuxCNC has been restarted.
""";

pin in bit enable "add the correction: motion.is-all-homed";
pin in float rate "speed at which a change without motion is applied, machine units per second; 0: 0.1 mm per second";
pin in float pos_x "position of X, joint.N.pos-cmd";
pin in float pos_y "the same for Y";
pin in float pos_z "the same for Z";
pin in float motor_x "command to the motor of X, joint.N.motor-pos-cmd";
pin in float motor_y "the same for Y";
pin in float motor_z "the same for Z";
pin in float drive_fb_x "position from the drive of X";
pin in float drive_fb_y "position from the drive of Y";
pin in float drive_fb_z "position from the drive of Z";
pin in float tool_x "motion.tooloffset.x";
pin in float tool_y "motion.tooloffset.y";
pin in float tool_z "motion.tooloffset.z";
pin in float gauge_x "tool offset of the error model when tool_x is zero";
pin in float gauge_y "the same for Y";
pin in float gauge_z "the same for Z";
pin out float drive_x "command to the drive of X";
pin out float drive_y "command to the drive of Y";
pin out float drive_z "command to the drive of Z";
pin out float motor_fb_x "to joint.N.motor-pos-fb of X";
pin out float motor_fb_y "the same for Y";
pin out float motor_fb_z "the same for Z";
pin out float correction_x "what is added to the command";
pin out float correction_y "the same for Y";
pin out float correction_z "the same for Z";
pin out bit loaded "the table is complete and in the unit of the machine; put this pin into the e-stop chain";
pin out bit settling "the correction has not yet reached that of the table; net it to motion.feed-inhibit";
pin out bit fault "a position or tool offset is not a number, or the inverse was not found: the last correction is kept";
pin out u32 cycles "number of command cycles, as a sign of life";
option singleton yes;
option extra_setup yes;
function command;
function feedback;
license "GPL-2.0-or-later";
author "the compgen authors";
;;

#include "rtapi_math.h"
#include "rtapi_string.h"
#include "volcomp.h"

static char *file = "";
RTAPI_MP_STRING(file, "table of volumetric errors");
static char *units = "";
RTAPI_MP_STRING(units, "unit of the machine, mm or inch: units=[TRAJ]LINEAR_UNITS");

// A position that bends by more than this in one cycle, mm, was redefined, not reached by motion: at 1 ms that would be 500 m/s2.
#define VOLCOMP_KINK 0.5
#define VOLCOMP_RATE 0.1        // mm per second

static volcomp_table table;
static double position[3], travel[3], offset[3];    // of the last cycle: position, its change, tool offset
static double residual[3];      // correction minus that of the table: what is still to be applied, with the opposite sign
static int active;              // the last cycle had a correction from the table

EXTRA_SETUP()
{
    (void) prefix;
    (void) extra_arg;
    volcomp_load(&table, file);
    volcomp_check_unit(&table, units);
    if (!table.good)
        rtapi_print_msg(RTAPI_MSG_ERR, "volcomp: NO COMPENSATION, table '%s': %s\n", file, table.message);
    return 0;
}

// Whether anything but motion has changed since the last cycle: the tool offset, or a position by redefinition.
static int changed_at_rest(const double p[3], const double t[3])
{
    const double kink = table.unit == VOLCOMP_INCH ? VOLCOMP_KINK / 25.4 : VOLCOMP_KINK;
    int k, changed = 0;
    for (k = 0; k < 3; k++) {
        changed |= t[k] != offset[k] || fabs(p[k] - position[k] - travel[k]) > kink;
        travel[k] = p[k] - position[k];
        position[k] = p[k];
        offset[k] = t[k];
    }
    return changed;
}

// Let the residual shrink by at most this step; returns whether something is left.
static int shrink(double step)
{
    int k, left = 0;
    for (k = 0; k < 3; k++) {
        residual[k] = fabs(residual[k]) <= step ? 0 : residual[k] - copysign(step, residual[k]);
        left |= residual[k] != 0;
    }
    return left;
}

FUNCTION(command)
{
    const double p[3] = {pos_x, pos_y, pos_z};
    const double t[3] = {gauge_x - tool_x, gauge_y - tool_y, gauge_z - tool_z};
    const double last[3] = {correction_x, correction_y, correction_z};
    const double usual = table.unit == VOLCOMP_INCH ? VOLCOMP_RATE / 25.4 : VOLCOMP_RATE;
    const int requested = table.good && enable;
    double target[3] = {0, 0, 0}, q[3];
    int k;
    loaded = table.good;
    fault = requested && volcomp_inverse(&table, p, t, q) != 0;
    if (fault) {
        active = 0;             // after the fault the correction continues from the value kept
        settling = 1;
    } else {
        for (k = 0; requested && k < 3; k++)
            target[k] = q[k] - p[k];
        if (changed_at_rest(p, t) || requested != active)
            for (k = 0; k < 3; k++)
                residual[k] = last[k] - target[k];
        active = requested;
        settling = shrink((rate > 0 ? rate : usual) * fperiod);
        correction_x = target[0] + residual[0];
        correction_y = target[1] + residual[1];
        correction_z = target[2] + residual[2];
    }
    drive_x = motor_x + correction_x;
    drive_y = motor_y + correction_y;
    drive_z = motor_z + correction_z;
    cycles++;
}

FUNCTION(feedback)
{
    motor_fb_x = drive_fb_x - correction_x;
    motor_fb_y = drive_fb_y - correction_y;
    motor_fb_z = drive_fb_z - correction_z;
}
// end of volcomp.comp
