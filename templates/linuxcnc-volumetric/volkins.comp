// SPDX-License-Identifier: GPL-2.0-or-later
//
// volkins.comp - LinuxCNC kinematics of linear axes X, Y, Z with volumetric compensation; all other axes pass unchanged.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING in this folder, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.

component volkins "Kinematics like trivkins, with volumetric compensation of X, Y and Z from a table";

description """
Build and install: halcompile --install volkins.comp (with volcomp.h in the same folder). INI: [KINS] KINEMATICS = volkins
file=volcomp.tab coordinates=XYZ, JOINTS = 3. As in trivkins, coordinates= names the axis of each joint from joint 0 on: XYZA has
a rotary axis at joint 3, XYYZ a gantry with two joints for Y. Without it, [TRAJ] COORDINATES of the INI file is used. A, B, C,
U, V, W pass unchanged. Another setting after file=: units=mm or units=inch states the unit of the machine if the INI file cannot
be read.

All lengths are in machine units. A table in another unit than [TRAJ] LINEAR_UNITS is not used. Put volkins.loaded into the
e-stop chain: without a table the axes are not compensated, and coordinated motion is refused.

The pins volkins.* exist from loadrt on. Tool offset of the error model: volkins.gauge-* minus volkins.tool-* (net these to
motion.tooloffset.*). When it changes, the module goes to the new one at volkins.tool-rate, so that no joint is commanded
to jump; net volkins.settling to motion.feed-inhibit to hold the feed meanwhile. A pin that is not a number raises volkins.fault,
and coordinated motion stops with an error.

The table is read once, at loadrt: a new table takes effect after LinuxCNC has been restarted.
""";

pin out bit installed "always true once the module runs";
option singleton yes;
option extra_setup yes;
license "GPL-2.0-or-later";
author "the compgen authors";
;;

#include "rtapi_math.h"
#include "rtapi_string.h"
#include "kinematics.h"
#include "volcomp.h"

#define VOLKINS_JOINTS 16
#define VOLKINS_RATE 200.0      // mm of tool offset per second: with an angle of 0.5 mrad 0.1 mm per second at the joints

static char *file = "";
RTAPI_MP_STRING(file, "table of volumetric errors, relative to the folder of the INI file");
static char *coordinates = "";
RTAPI_MP_STRING(coordinates, "letter of the axis of each joint, as in trivkins; default: [TRAJ] COORDINATES");
static char *units = "";
RTAPI_MP_STRING(units, "unit of the machine, mm or inch; default: [TRAJ] LINEAR_UNITS");

static const char letters[] = "XYZABCUVW";
static volcomp_table table;
static int joints, axis_of[VOLKINS_JOINTS];     // index into letters
static int joint_of[9];                         // first joint of an axis, or -1
static struct volkins_pins {
    hal_bit_t *loaded, *fault, *settling;
    hal_float_t *tool[3], *gauge[3], *used[3], *error[3], *rate;
} *pins;

static int make_pins(int id)
{
    int k, bad;
    pins = hal_malloc(sizeof *pins);
    if (!pins)
        return -1;
    bad = hal_pin_bit_newf(HAL_OUT, &pins->loaded, id, "volkins.loaded");
    bad |= hal_pin_bit_newf(HAL_OUT, &pins->fault, id, "volkins.fault");
    bad |= hal_pin_bit_newf(HAL_OUT, &pins->settling, id, "volkins.settling");
    bad |= hal_pin_float_newf(HAL_IN, &pins->rate, id, "volkins.tool-rate");
    for (k = 0; k < 3; k++) {
        bad |= hal_pin_float_newf(HAL_IN, &pins->tool[k], id, "volkins.tool-%c", "xyz"[k]);
        bad |= hal_pin_float_newf(HAL_IN, &pins->gauge[k], id, "volkins.gauge-%c", "xyz"[k]);
        bad |= hal_pin_float_newf(HAL_OUT, &pins->used[k], id, "volkins.used-%c", "xyz"[k]);
        bad |= hal_pin_float_newf(HAL_OUT, &pins->error[k], id, "volkins.error-%c", "xyz"[k]);
    }
    return bad ? -1 : 0;
}

// Give each joint its axis; returns 0 with a message in the table if the words are not understood.
static int map_joints(const char *words)
{
    const char *letter;
    int k;
    for (k = 0; k < 9; k++)
        joint_of[k] = -1;
    for (joints = 0; *words; words++) {
        if (*words == ' ' || *words == '\t')
            continue;
        letter = strchr(letters, *words >= 'a' && *words <= 'z' ? *words - 'a' + 'A' : *words);
        if (!letter || joints == VOLKINS_JOINTS) {
            snprintf(table.message, sizeof table.message, "coordinates: '%.24s' at joint %d is not one of XYZABCUVW, "
                     "for at most 16 joints", words, joints);
            return 0;
        }
        axis_of[joints] = (int) (letter - letters);
        if (joint_of[axis_of[joints]] < 0)
            joint_of[axis_of[joints]] = joints;
        joints++;
    }
    for (k = 0; k < 3; k++)
        if (joint_of[k] < 0) {
            snprintf(table.message, sizeof table.message, "coordinates: there is no joint for %c", letters[k]);
            return 0;
        }
    return 1;
}

// Compare the joints with the INI file: an axis without a joint would take commands and never move.
static int check_joints(void)
{
    char ini[64], *c, *letter;
    if (volcomp_ini("TRAJ", "COORDINATES", ini, sizeof ini))
        for (c = ini; *c; c++) {
            letter = strchr(letters, *c >= 'a' && *c <= 'z' ? *c - 'a' + 'A' : *c);
            if (letter && joint_of[letter - letters] < 0) {
                snprintf(table.message, sizeof table.message, "no joint for %c of [TRAJ] COORDINATES = %.32s: add it to "
                         "coordinates= after file=", *letter, ini);
                return 0;
            }
        }
    // as in trivkins, coordinates= may leave out joints on purpose; [TRAJ] COORDINATES may not
    if (volcomp_ini("KINS", "JOINTS", ini, sizeof ini) && (*coordinates ? atoi(ini) < joints : atoi(ini) != joints)) {
        snprintf(table.message, sizeof table.message, "[KINS] JOINTS = %.16s, and the coordinates are for %d joints: name "
                 "the axis of each joint by coordinates= after file=", ini, joints);
        return 0;
    }
    return 1;
}

EXTRA_SETUP()
{
    char ini[64] = "XYZ";
    (void) prefix;
    (void) extra_arg;
    if (make_pins(comp_id))
        return -1;
    volcomp_load(&table, file);
    volcomp_check_unit(&table, units);
    if (!*coordinates)
        volcomp_ini("TRAJ", "COORDINATES", ini, sizeof ini);
    if (table.good)
        table.good = map_joints(*coordinates ? coordinates : ini) && check_joints();
    else
        map_joints("XYZABCUVW");
    *pins->loaded = table.good;
    if (!table.good)
        rtapi_print_msg(RTAPI_MSG_ERR, "volkins: NO COMPENSATION, table '%s': %s\n", file, table.message);
    return 0;
}

// The tool offset in use: it follows the pins at the tool rate. Returns -1 where a pin is not a number.
static int tool_offset(double t[3])
{
    static long long last;
    const long long now = rtapi_get_time();
    const double usual = table.unit == VOLCOMP_INCH ? VOLKINS_RATE / 25.4 : VOLKINS_RATE;
    const double step = (*pins->rate > 0 ? *pins->rate : usual) * 0.000000001 * (double) (now - last);
    const int first = last == 0;
    int k, left = 0;
    for (k = 0; k < 3; k++)
        t[k] = *pins->gauge[k] - *pins->tool[k];
    if (!volcomp_finite(t))
        return -1;
    last = now;
    for (k = 0; k < 3; k++) {
        double change = t[k] - *pins->used[k];
        if (!first && fabs(change) > step) {
            t[k] = *pins->used[k] + copysign(step, change);
            left = 1;
        }
        *pins->used[k] = t[k];
    }
    *pins->settling = left;
    return 0;
}

static double *coordinate(EmcPose *pose, int axis)
{
    double *const all[9] = {&pose->tran.x, &pose->tran.y, &pose->tran.z, &pose->a, &pose->b, &pose->c,
                            &pose->u, &pose->v, &pose->w};
    return all[axis];
}

int kinematicsForward(const double *joint, EmcPose *world, const KINEMATICS_FORWARD_FLAGS *fflags,
                      KINEMATICS_INVERSE_FLAGS *iflags)
{
    double t[3], e[3], q[3];
    int k;
    (void) fflags;
    (void) iflags;
    if (tool_offset(t)) {
        *pins->fault = 1;
        return -1;
    }
    for (k = 0; k < 3; k++)
        q[k] = joint_of[k] < 0 ? 0 : joint[joint_of[k]];
    volcomp_error(&table, q, t, e);
    for (k = 0; k < 3; k++)
        *coordinate(world, k) = q[k] + e[k];
    for (k = 3; k < 9; k++)
        if (joint_of[k] >= 0)
            *coordinate(world, k) = joint[joint_of[k]];
    return 0;
}

int kinematicsInverse(const EmcPose *world, double *joint, const KINEMATICS_INVERSE_FLAGS *iflags,
                      KINEMATICS_FORWARD_FLAGS *fflags)
{
    const double p[3] = {world->tran.x, world->tran.y, world->tran.z};
    EmcPose reached = *world;
    double t[3], q[3];
    int k;
    (void) iflags;
    (void) fflags;
    if (!table.good || tool_offset(t) || volcomp_inverse(&table, p, t, q)) {
        *pins->fault = 1;
        return -1;
    }
    *pins->fault = 0;
    for (k = 0; k < 3; k++) {
        *coordinate(&reached, k) = q[k];
        *pins->error[k] = p[k] - q[k];
    }
    for (k = 0; k < joints; k++)
        joint[k] = *coordinate(&reached, axis_of[k]);
    return 0;
}

KINEMATICS_TYPE kinematicsType(void)
{
    return KINEMATICS_BOTH;
}

KINS_NOT_SWITCHABLE
EXPORT_SYMBOL(kinematicsType);
EXPORT_SYMBOL(kinematicsForward);
EXPORT_SYMBOL(kinematicsInverse);
// end of volkins.comp
