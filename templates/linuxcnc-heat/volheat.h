// SPDX-License-Identifier: GPL-2.0-or-later
//
// volheat.h - model of heat for LinuxCNC: reading its table, sensors that fail, lags, the hull, and a limited rate.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING in this folder, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.
//
// Displacement of the tool relative to the workpiece (actual minus nominal) since the first reading, in machine units:
//
//     d = sum of k (L - L at the first reading),  dL/dt = (T - L) / lag
//     offset = -share d,  share = 1 within the trained ranges, fading to 0 over the margin beyond them
//
// The offset is added to the command. It never moves faster than the rate, whatever happens to a sensor.
// A table that is not whole is not used: v_good is 0 and v_message says why.
//
// All members begin with v_, and no variable has the name of a pin: halcompile makes macros of the names of pins.

#ifndef VOLHEAT_H
#define VOLHEAT_H

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define VOLHEAT_SENSORS 16
#define VOLHEAT_TERMS 16
#define VOLHEAT_RANGES 136
#define VOLHEAT_COLDEST (-40.0) // degC: what a sensor in a machine tool reads
#define VOLHEAT_HOTTEST 200.0
#define VOLHEAT_GAP 900.0       // s: after a longer fault the state of the lags is not known
#define VOLHEAT_LAGS 3.0        // so many of the longest lag until it is known again

enum {                          // why the offset goes back to zero
    VOLHEAT_NONE = 0,
    VOLHEAT_NO_NUMBER = 1,      // not a number, or outside of what a sensor reads
    VOLHEAT_JUMP = 2,           // it jumps as no machine warms
    VOLHEAT_STUCK = 3,          // it rests while another one moves
    VOLHEAT_NOT_READ = 4,       // exactly 0 since the start: nothing is connected, or nothing has been read yet
    VOLHEAT_NO_TABLE = 5
};

typedef struct {
    int v_sensor, v_start;
    double v_lag, v_per_k[3];   // s; machine units per K
} volheat_term;

typedef struct {
    int v_sensor, v_minus;      // v_minus is -1 for a single sensor
    double v_low, v_high, v_margin;
} volheat_range;

typedef struct {
    int v_good, v_inch, v_sensors, v_terms, v_ranges;
    double v_rate, v_jump, v_stuck, v_moved;    // machine units per s, K, s, K
    volheat_term v_term[VOLHEAT_TERMS];
    volheat_range v_range[VOLHEAT_RANGES];
    char v_message[160];
} volheat_table;

typedef struct {
    int v_begun, v_fault, v_broken, v_outside, v_asked;
    double v_last[VOLHEAT_SENSORS];             // last reading
    double v_held[VOLHEAT_SENSORS];             // last good reading: what the model uses
    double v_rests[VOLHEAT_SENSORS];            // s since it changed
    double v_then[VOLHEAT_SENSORS][VOLHEAT_SENSORS];    // all others at that time
    double v_lagged[VOLHEAT_TERMS], v_zero[VOLHEAT_TERMS];
    double v_share, v_ill, v_unknown;           // share of the hull; s of fault; s until the lags are known
    double v_target[3], v_now[3];
} volheat_state;

// ---- reading -------------------------------------------------------------------------------------------------------

typedef struct {
    FILE *v_file;
    unsigned long v_crc;
    int v_words;
    char v_word[64];
} volheat_text;

static int volheat_fail(volheat_table *table, const volheat_text *text, const char *message)
{
    table->v_good = 0;
    snprintf(table->v_message, sizeof table->v_message, "%s, at word %d '%.32s'", message, text->v_words, text->v_word);
    return 0;
}

static void volheat_crc(volheat_text *text, unsigned char byte)
{
    int bit;
    text->v_crc ^= byte;
    for (bit = 0; bit < 8; bit++)
        text->v_crc = (text->v_crc & 1) ? (text->v_crc >> 1) ^ 0xEDB88320UL : text->v_crc >> 1;
}

// The next word, counted in for the checksum.
static int volheat_take(volheat_text *text)
{
    const char *c;
    if (fscanf(text->v_file, "%63s", text->v_word) != 1) {
        text->v_word[0] = 0;
        return 0;
    }
    if (text->v_words++)
        volheat_crc(text, ' ');
    for (c = text->v_word; *c; c++)
        volheat_crc(text, (unsigned char) *c);
    return 1;
}

static int volheat_is(volheat_text *text, const char *word)
{
    return volheat_take(text) && !strcmp(text->v_word, word);
}

static int volheat_number(volheat_text *text, double *value)
{
    char *rest;
    if (!volheat_take(text) || text->v_word[strspn(text->v_word, "0123456789+-.eE")])
        return 0;
    *value = strtod(text->v_word, &rest);
    return *rest == 0 && rest != text->v_word && isfinite(*value);
}

static int volheat_whole(volheat_text *text, int least, int most, int *value)
{
    double number;
    if (!volheat_number(text, &number) || number != floor(number) || number < least || number > most)
        return 0;
    *value = (int) number;
    return 1;
}

static int volheat_settings(volheat_text *text, volheat_table *table)
{
    return volheat_is(text, "rate") && volheat_number(text, &table->v_rate) && table->v_rate > 0
        && volheat_is(text, "jump") && volheat_number(text, &table->v_jump) && table->v_jump > 0
        && volheat_is(text, "stuck") && volheat_number(text, &table->v_stuck) && table->v_stuck >= 0
        && volheat_is(text, "moved") && volheat_number(text, &table->v_moved) && table->v_moved > 0;
}

static int volheat_rows(volheat_text *text, volheat_table *table)
{
    int k;
    if (!volheat_is(text, "sensors") || !volheat_whole(text, 1, VOLHEAT_SENSORS, &table->v_sensors))
        return volheat_fail(table, text, "expected the number of sensors");
    for (k = 0; k < table->v_sensors; k++)      // their names, for people
        if (!volheat_take(text))
            return volheat_fail(table, text, "expected the name of a sensor");
    if (!volheat_is(text, "terms") || !volheat_whole(text, 1, VOLHEAT_TERMS, &table->v_terms))
        return volheat_fail(table, text, "expected the number of terms");
    for (k = 0; k < table->v_terms; k++) {
        volheat_term *t = &table->v_term[k];
        if (!volheat_whole(text, 0, table->v_sensors - 1, &t->v_sensor)
            || !volheat_whole(text, 0, table->v_sensors - 1, &t->v_start) || !volheat_number(text, &t->v_lag)
            || t->v_lag < 0 || !volheat_number(text, &t->v_per_k[0]) || !volheat_number(text, &t->v_per_k[1])
            || !volheat_number(text, &t->v_per_k[2]))
            return volheat_fail(table, text, "expected sensor, start, lag and three coefficients");
    }
    if (!volheat_is(text, "ranges") || !volheat_whole(text, 1, VOLHEAT_RANGES, &table->v_ranges))
        return volheat_fail(table, text, "expected the number of ranges");
    for (k = 0; k < table->v_ranges; k++) {
        volheat_range *r = &table->v_range[k];
        if (!volheat_whole(text, 0, table->v_sensors - 1, &r->v_sensor)
            || !volheat_whole(text, -1, table->v_sensors - 1, &r->v_minus) || !volheat_number(text, &r->v_low)
            || !volheat_number(text, &r->v_high) || !volheat_number(text, &r->v_margin) || r->v_margin <= 0
            || r->v_low > r->v_high)
            return volheat_fail(table, text, "expected sensor, minus, low, high and margin");
    }
    return 1;
}

static int volheat_read(volheat_text *text, volheat_table *table)
{
    char wanted[16];
    if (!volheat_is(text, "volheat") || !volheat_is(text, "1"))
        return volheat_fail(table, text, "expected 'volheat 1'");
    if (!volheat_take(text) || (strcmp(text->v_word, "mm") && strcmp(text->v_word, "inch")))
        return volheat_fail(table, text, "expected the unit, mm or inch");
    table->v_inch = !strcmp(text->v_word, "inch");
    if (!volheat_settings(text, table))
        return volheat_fail(table, text, "expected rate, jump, stuck and moved");
    if (!volheat_rows(text, table))
        return 0;
    if (!volheat_is(text, "end"))
        return volheat_fail(table, text, "expected 'end'");
    snprintf(wanted, sizeof wanted, "%08lX", (text->v_crc ^ 0xFFFFFFFFUL) & 0xFFFFFFFFUL);
    if (!volheat_is(text, "crc32") || !volheat_is(text, wanted))
        return volheat_fail(table, text, "the checksum does not match: the table was changed or damaged");
    return 1;
}

// Read a table; units is the unit of the machine, mm or inch.
static int volheat_load(volheat_table *table, const char *path, const char *units)
{
    volheat_text text;
    memset(table, 0, sizeof *table);
    memset(&text, 0, sizeof text);
    text.v_crc = 0xFFFFFFFFUL;
    text.v_file = fopen(path, "r");
    if (!text.v_file)
        return volheat_fail(table, &text, "cannot be opened");
    table->v_good = volheat_read(&text, table);
    fclose(text.v_file);
    if (table->v_good && strcmp(units, table->v_inch ? "inch" : "mm"))
        return volheat_fail(table, &text, "is not in the unit of the machine: units=[TRAJ]LINEAR_UNITS");
    return table->v_good;
}

// ---- one cycle -----------------------------------------------------------------------------------------------------

static int volheat_plain(double t)
{
    return isfinite(t) && t >= VOLHEAT_COLDEST && t <= VOLHEAT_HOTTEST;
}

static void volheat_accept(const volheat_table *table, volheat_state *s, const double *t, int k)
{
    int j;
    s->v_last[k] = t[k];
    s->v_rests[k] = 0;
    for (j = 0; j < table->v_sensors; j++)
        s->v_then[k][j] = t[j];
}

// Whether sensor k has rested for long while another one moved.
static int volheat_stuck(const volheat_table *table, const volheat_state *s, const double *t, int k)
{
    int j;
    if (table->v_stuck <= 0 || s->v_rests[k] < table->v_stuck)
        return 0;
    for (j = 0; j < table->v_sensors; j++)
        if (j != k && fabs(t[j] - s->v_then[k][j]) > table->v_moved)
            return 1;
    return 0;
}

// What is wrong with sensor k.
static int volheat_wrong(const volheat_table *table, const volheat_state *s, const double *t, int k)
{
    if (!volheat_plain(t[k]))
        return VOLHEAT_NO_NUMBER;
    if (fabs(t[k] - s->v_last[k]) > table->v_jump)
        return VOLHEAT_JUMP;
    return volheat_stuck(table, s, t, k) ? VOLHEAT_STUCK : VOLHEAT_NONE;
}

static double volheat_longest(const volheat_table *table)
{
    double longest = 0;
    int k;
    for (k = 0; k < table->v_terms; k++)
        longest = fmax(longest, table->v_term[k].v_lag);
    return longest;
}

// Begin when every sensor reads something; the lags then begin at the temperatures of their start sensors.
static void volheat_begin(const volheat_table *table, volheat_state *s, const double *t, int hot)
{
    int k;
    for (k = 0; k < table->v_sensors; k++)
        if (!volheat_plain(t[k]) || t[k] == 0) {
            s->v_fault = t[k] == 0 ? VOLHEAT_NOT_READ : VOLHEAT_NO_NUMBER;
            s->v_broken = k;
            return;
        }
    s->v_fault = VOLHEAT_NONE;
    s->v_broken = -1;
    for (k = 0; k < table->v_sensors; k++) {
        volheat_accept(table, s, t, k);
        s->v_held[k] = t[k];
    }
    for (k = 0; k < table->v_terms; k++)
        s->v_lagged[k] = s->v_zero[k] = t[table->v_term[k].v_lag > 0 ? table->v_term[k].v_start : table->v_term[k].v_sensor];
    s->v_unknown = hot ? VOLHEAT_LAGS * volheat_longest(table) : 0;
    s->v_begun = 1;
}

static void volheat_watch(const volheat_table *table, volheat_state *s, const double *t, int asked, double dt)
{
    int k, plain = 1;
    for (k = 0; k < table->v_sensors; k++)
        plain &= volheat_plain(t[k]);
    if (s->v_fault && asked && !s->v_asked && plain) {
        if (s->v_ill > VOLHEAT_GAP)
            s->v_unknown = VOLHEAT_LAGS * volheat_longest(table);
        s->v_fault = VOLHEAT_NONE;
        s->v_broken = -1;
        for (k = 0; k < table->v_sensors; k++)
            volheat_accept(table, s, t, k);
    }
    s->v_asked = asked;
    s->v_ill = s->v_fault ? s->v_ill + dt : 0;
    for (k = 0; k < table->v_sensors && !s->v_fault; k++) {
        s->v_rests[k] += dt;
        s->v_fault = volheat_wrong(table, s, t, k);
        if (s->v_fault)
            s->v_broken = k;
    }
    if (s->v_fault)
        return;                 // the last good readings are kept
    for (k = 0; k < table->v_sensors; k++) {
        if (t[k] != s->v_last[k])
            volheat_accept(table, s, t, k);
        s->v_held[k] = t[k];
    }
}

static void volheat_follow(const volheat_table *table, volheat_state *s, double dt)
{
    int k;
    for (k = 0; k < table->v_terms; k++) {
        const volheat_term *term = &table->v_term[k];
        const double t = s->v_held[term->v_sensor];
        s->v_lagged[k] = term->v_lag > 0 ? s->v_lagged[k] - (t - s->v_lagged[k]) * expm1(-dt / term->v_lag) : t;
    }
    s->v_unknown = fmax(0, s->v_unknown - dt);
}

static double volheat_share(const volheat_table *table, volheat_state *s)
{
    double part = 1;
    int k;
    s->v_outside = 0;
    for (k = 0; k < table->v_ranges; k++) {
        const volheat_range *r = &table->v_range[k];
        const double value = s->v_held[r->v_sensor] - (r->v_minus < 0 ? 0 : s->v_held[r->v_minus]);
        const double beyond = fmax(0, fmax(r->v_low - value, value - r->v_high));
        part = fmin(part, fmax(0, 1 - beyond / r->v_margin));
        s->v_outside |= beyond > 0;
    }
    return part;
}

// One cycle of dt seconds: t are the readings, degC. The offset of each axis is then in v_now.
static void volheat_step(const volheat_table *table, volheat_state *s, const double *t, int on, int hot, int asked, double dt)
{
    int axis, k;
    if (!table->v_good) {
        s->v_fault = VOLHEAT_NO_TABLE;
        return;
    }
    if (!s->v_begun)
        volheat_begin(table, s, t, hot);
    else
        volheat_watch(table, s, t, asked, dt);
    if (s->v_begun) {
        volheat_follow(table, s, dt);
        s->v_share = volheat_share(table, s);
    }
    for (axis = 0; axis < 3; axis++) {
        double moved = 0, step;
        for (k = 0; k < table->v_terms; k++)
            moved += table->v_term[k].v_per_k[axis] * (s->v_lagged[k] - s->v_zero[k]);
        s->v_target[axis] = on && s->v_begun && !s->v_fault && s->v_unknown <= 0 ? -s->v_share * moved : 0;
        step = table->v_rate * dt;
        s->v_now[axis] += fmax(-step, fmin(step, s->v_target[axis] - s->v_now[axis]));
    }
}

#endif
