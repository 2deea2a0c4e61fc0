// SPDX-License-Identifier: GPL-2.0-or-later
//
// volkins.comp - LinuxCNC kinematics of three linear axes X, Y, Z with volumetric compensation.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING beside the sources, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.

component volkins "Kinematics of three linear axes with volumetric compensation from a table";

description """
Build and install: halcompile --install volkins.comp (volcomp.h beside it). INI: [KINS] KINEMATICS = volkins
file=volcomp.tab, JOINTS = 3; joint 0, 1, 2 is X, Y, Z. The pins volkins.* exist from loadrt on. Tool offset of the error
model: volkins.gauge-* minus volkins.tool-* (to be netted to motion.tooloffset.*). Put volkins.loaded into the e-stop chain:
without a table the axes are not compensated, and coordinated motion is refused.
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

static char *file = "";
RTAPI_MP_STRING(file, "table of volumetric errors, relative to the folder of the INI file");

static volcomp_table table;
static struct volkins_pins {
    hal_bit_t *loaded, *fault;
    hal_float_t *tool[3], *gauge[3], *error[3];
} *pins;

static int make_pins(int id)
{
    int k, bad;
    pins = hal_malloc(sizeof *pins);
    if (!pins)
        return -1;
    bad = hal_pin_bit_newf(HAL_OUT, &pins->loaded, id, "volkins.loaded");
    bad |= hal_pin_bit_newf(HAL_OUT, &pins->fault, id, "volkins.fault");
    for (k = 0; k < 3; k++) {
        bad |= hal_pin_float_newf(HAL_IN, &pins->tool[k], id, "volkins.tool-%c", "xyz"[k]);
        bad |= hal_pin_float_newf(HAL_IN, &pins->gauge[k], id, "volkins.gauge-%c", "xyz"[k]);
        bad |= hal_pin_float_newf(HAL_OUT, &pins->error[k], id, "volkins.error-%c", "xyz"[k]);
    }
    return bad ? -1 : 0;
}

EXTRA_SETUP()
{
    (void) prefix;
    (void) extra_arg;
    if (make_pins(comp_id))
        return -1;
    *pins->loaded = volcomp_load(&table, file);
    if (!table.good)
        rtapi_print_msg(RTAPI_MSG_ERR, "volkins: NO COMPENSATION, table '%s': %s\n", file, table.message);
    return 0;
}

static void tool_offset(double t[3])
{
    int k;
    for (k = 0; k < 3; k++)
        t[k] = *pins->gauge[k] - *pins->tool[k];
}

int kinematicsForward(const double *joint, EmcPose *world, const KINEMATICS_FORWARD_FLAGS *fflags,
                      KINEMATICS_INVERSE_FLAGS *iflags)
{
    double t[3], e[3];
    (void) fflags;
    (void) iflags;
    tool_offset(t);
    volcomp_error(&table, joint, t, e);
    world->tran.x = joint[0] + e[0];
    world->tran.y = joint[1] + e[1];
    world->tran.z = joint[2] + e[2];
    return 0;
}

int kinematicsInverse(const EmcPose *world, double *joint, const KINEMATICS_INVERSE_FLAGS *iflags,
                      KINEMATICS_FORWARD_FLAGS *fflags)
{
    const double p[3] = {world->tran.x, world->tran.y, world->tran.z};
    double t[3];
    int k;
    (void) iflags;
    (void) fflags;
    tool_offset(t);
    if (!table.good || volcomp_inverse(&table, p, t, joint)) {
        *pins->fault = 1;
        return -1;
    }
    *pins->fault = 0;
    for (k = 0; k < 3; k++)
        *pins->error[k] = p[k] - joint[k];
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
