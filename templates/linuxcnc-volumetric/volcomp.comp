// SPDX-License-Identifier: GPL-2.0-or-later
//
// volcomp.comp - HAL component that adds a volumetric compensation between motion and the drives.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING beside the sources, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.

component volcomp "Volumetric compensation of three linear axes between motion and the drives";

description """
For machines whose kinematics must stay as they are (trivkins). It adds the same correction as volkins, in every mode, and
the display does not show it. Order of the functions in the servo thread: volcomp.feedback, motion-controller,
volcomp.command. Positions are joint.N.pos-cmd, machine coordinates.
""";

pin in float pos_x "joint.0.pos-cmd";
pin in float pos_y "joint.1.pos-cmd";
pin in float pos_z "joint.2.pos-cmd";
pin in float motor_x "joint.0.motor-pos-cmd";
pin in float motor_y "joint.1.motor-pos-cmd";
pin in float motor_z "joint.2.motor-pos-cmd";
pin in float drive_fb_x "position from the drive of X";
pin in float drive_fb_y "position from the drive of Y";
pin in float drive_fb_z "position from the drive of Z";
pin in float tool_x "motion.tooloffset.x";
pin in float tool_y "motion.tooloffset.y";
pin in float tool_z "motion.tooloffset.z";
pin in float gauge_x "tool offset of the error model where tool_x is zero, mm";
pin in float gauge_y "the same for Y";
pin in float gauge_z "the same for Z";
pin out float drive_x "command to the drive of X";
pin out float drive_y "command to the drive of Y";
pin out float drive_z "command to the drive of Z";
pin out float motor_fb_x "to joint.0.motor-pos-fb";
pin out float motor_fb_y "to joint.1.motor-pos-fb";
pin out float motor_fb_z "to joint.2.motor-pos-fb";
pin out float correction_x "what is added to the command, mm";
pin out float correction_y "the same for Y";
pin out float correction_z "the same for Z";
pin out bit loaded "the table was read to its last word; put it into the e-stop chain";
pin out bit fault "the inverse was not found: the last correction holds";
pin out u32 cycles "number of the command cycles, as a sign of life";
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

static volcomp_table table;

EXTRA_SETUP()
{
    (void) prefix;
    (void) extra_arg;
    if (!volcomp_load(&table, file))
        rtapi_print_msg(RTAPI_MSG_ERR, "volcomp: NO COMPENSATION, table '%s': %s\n", file, table.message);
    return 0;
}

FUNCTION(command)
{
    const double p[3] = {pos_x, pos_y, pos_z};
    const double t[3] = {gauge_x - tool_x, gauge_y - tool_y, gauge_z - tool_z};
    double q[3] = {0, 0, 0};
    loaded = table.good;
    if (table.good && !(fault = volcomp_inverse(&table, p, t, q) != 0)) {
        correction_x = q[0] - p[0];
        correction_y = q[1] - p[1];
        correction_z = q[2] - p[2];
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
