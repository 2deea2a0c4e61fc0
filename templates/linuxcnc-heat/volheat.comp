// SPDX-License-Identifier: GPL-2.0-or-later
//
// volheat.comp - HAL component that takes away what heat moves: temperatures in, smooth offsets between motion and drives.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING in this folder, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.

component volheat "Thermal growth of a machine tool taken away between motion and the drives";

description """
It reads temperatures and adds an offset to the commands of the drives of X, Y and Z: minus what its table says that heat has
moved the tool since the first reading. Order of the functions in the servo thread: volheat.feedback, motion-controller,
volheat.command. The display does not show the offset. All lengths are in machine units, temperatures in degC.
Load: loadrt volheat file=volheat.tab units=[TRAJ]LINEAR_UNITS. A table in another unit is not used.

The offset never moves faster than the rate of the table. It goes back to zero at that rate when enable is FALSE (net it to
motion.is-all-homed), outside the temperatures from which the model was learned, and when a sensor fails: the pin fault then is TRUE,
fault-code says why (1 not a number, 2 a jump, 3 stuck, 4 not read since the start, 5 no table), fault-sensor which one. It stays so
until reset rises. Home while at-zero is TRUE: what is added while a joint homes stays in its position.

Lags begin at the first reading. If LinuxCNC is started on a machine that is warm, set warm before the first cycle: nothing is added
until three times the longest lag has passed. The table is read once, at loadrt.
""";

pin in bit enable "add the offset: motion.is-all-homed";
pin in bit warm "the machine was warm when LinuxCNC was started";
pin in bit reset "rising: all sensors are in order again";
pin in float temp-##[16] "temperatures in the order of the table, degC";
pin in float motor_x "command to the motor of X, joint.N.motor-pos-cmd";
pin in float motor_y "the same for Y";
pin in float motor_z "the same for Z";
pin in float drive_fb_x "position from the drive of X";
pin in float drive_fb_y "position from the drive of Y";
pin in float drive_fb_z "position from the drive of Z";
pin out float drive_x "command to the drive of X";
pin out float drive_y "command to the drive of Y";
pin out float drive_z "command to the drive of Z";
pin out float motor_fb_x "to joint.N.motor-pos-fb of X";
pin out float motor_fb_y "the same for Y";
pin out float motor_fb_z "the same for Z";
pin out float offset_x "what is added to the command";
pin out float offset_y "the same for Y";
pin out float offset_z "the same for Z";
pin out float target_x "what the offset goes to";
pin out float target_y "the same for Y";
pin out float target_z "the same for Z";
pin out float share "1 within the trained temperatures, 0 far outside";
pin out bit outside "a temperature, or a difference of two, is outside of what was trained";
pin out bit waiting "the lags are not known yet: nothing is added";
pin out bit at_zero "nothing is added";
pin out bit loaded "the table is whole and in the unit of the machine";
pin out bit fault "a sensor failed, or there is no table: see fault-code";
pin out s32 fault_code "0 none, 1 not a number, 2 jump, 3 stuck, 4 not read since the start, 5 no table";
pin out s32 fault_sensor "number of the sensor that failed, -1 for none";
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
#include "volheat.h"

static char *file = "";
RTAPI_MP_STRING(file, "table of the model of heat");
static char *units = "";
RTAPI_MP_STRING(units, "unit of the machine, mm or inch: units=[TRAJ]LINEAR_UNITS");

static volheat_table table;
static volheat_state state;

EXTRA_SETUP()
{
    (void) prefix;
    (void) extra_arg;
    state.v_broken = -1;
    volheat_load(&table, file, units);
    if (!table.v_good)
        rtapi_print_msg(RTAPI_MSG_ERR, "volheat: NOTHING IS ADDED, table '%s': %s\n", file, table.v_message);
    return 0;
}

FUNCTION(command)
{
    double t[VOLHEAT_SENSORS];
    int k;
    for (k = 0; k < VOLHEAT_SENSORS; k++)
        t[k] = temp(k);
    volheat_step(&table, &state, t, enable, warm, reset, fperiod);
    offset_x = state.v_now[0];
    offset_y = state.v_now[1];
    offset_z = state.v_now[2];
    target_x = state.v_target[0];
    target_y = state.v_target[1];
    target_z = state.v_target[2];
    share = state.v_share;
    outside = state.v_outside;
    waiting = state.v_unknown > 0;
    at_zero = state.v_now[0] == 0 && state.v_now[1] == 0 && state.v_now[2] == 0;
    loaded = table.v_good;
    fault = state.v_fault != VOLHEAT_NONE;
    fault_code = state.v_fault;
    fault_sensor = state.v_broken;
    drive_x = motor_x + offset_x;
    drive_y = motor_y + offset_y;
    drive_z = motor_z + offset_z;
    cycles++;
}

FUNCTION(feedback)
{
    motor_fb_x = drive_fb_x - offset_x;
    motor_fb_y = drive_fb_y - offset_y;
    motor_fb_z = drive_fb_z - offset_z;
}
// end of volheat.comp
