// SPDX-License-Identifier: GPL-2.0-or-later
//
// volcomp.h - table of volumetric errors for LinuxCNC: reading, E = C P, and the exact inverse.
// Copyright (C) 2026 the compgen authors
//
// This program is free software; you can redistribute it and/or modify it under the terms of the GNU General Public
// License as published by the Free Software Foundation; either version 2 of the License, or (at your option) any later
// version. It comes WITHOUT ANY WARRANTY; see the file COPYING in this folder, or
// <https://www.gnu.org/licenses/old-licenses/gpl-2.0.html>.
//
// E(q, t) is the error of the tool tip, actual minus commanded, with the axes at q and the tool offset t. All lengths are in
// the unit of the machine, mm or inch; the table states for which it was written, and volcomp_check_unit compares:
//
//     P = q + E(q, t)         position of the tip minus the tool offset    (forward)
//     q = P - E(q, t)         position of the axes                         (inverse, by iteration until nothing changes)
//
// A table that cannot be read to its last word is not used at all: volcomp_load returns 0 and says why. The same
// applies to a table in another unit than that of the machine.

#ifndef VOLCOMP_H
#define VOLCOMP_H

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#define VOLCOMP_MM 1            // units of length; 0 is none
#define VOLCOMP_INCH 2
#define VOLCOMP_CURVES 64
#define VOLCOMP_TERMS 512
#define VOLCOMP_NODES 10000
#define VOLCOMP_VERTICES 100000
#define VOLCOMP_BYTES (64L << 20)
#define VOLCOMP_NAME 32
// The iteration ends when no axis moves by more than this, mm or inch, and this part of its coordinate (far from machine zero
// neighbouring numbers differ by more than the first); after this many rounds it has failed.
#define VOLCOMP_STEP 0.0000000000001
#define VOLCOMP_PART 0.000000000000001
#define VOLCOMP_ROUNDS 50

typedef struct {
    char name[VOLCOMP_NAME];
    int axis, count;
    double first, step;
    double *value;
} volcomp_curve;

typedef struct {
    int out, curve, lever;      // lever: 0 for the factor 1, 1..3 for x y z, 4..6 for tx ty tz
    double coefficient;
} volcomp_term;

typedef struct {
    int good;                   // the table was read to its last word, and its unit is that of the machine
    int unit;                   // VOLCOMP_MM or VOLCOMP_INCH: lengths of the table
    int curves, terms, vertices;
    int count[3];               // vertices of the grid along X, Y, Z
    double first[3], step[3];
    double *vertex;             // ex ey ez, x fastest
    volcomp_curve curve[VOLCOMP_CURVES];
    volcomp_term term[VOLCOMP_TERMS];
    char message[256];          // why it is not loaded
} volcomp_table;

// ---- reading -------------------------------------------------------------------------------------------------------

typedef struct {
    char *next, *end;
    int line;
    unsigned long crc;          // over the words, one blank between two of them
    int words;
    char word[64];
} volcomp_text;

static int volcomp_fail(volcomp_table *table, const volcomp_text *text, const char *message)
{
    snprintf(table->message, sizeof table->message, "line %d: %s, at '%.32s'", text->line, message, text->word);
    return 0;
}

static void volcomp_crc(volcomp_text *text, unsigned char byte)
{
    int bit;
    text->crc ^= byte;
    for (bit = 0; bit < 8; bit++)
        text->crc = (text->crc & 1) ? (text->crc >> 1) ^ 0xEDB88320UL : text->crc >> 1;
}

static int volcomp_blank(char c)
{
    return c == ' ' || c == '\t' || c == '\n' || c == '\r';
}

// Put the next word into text->word and return 1; 0 at the end of the text or for a word that is too long.
static int volcomp_next(volcomp_text *text)
{
    size_t length = 0;
    while (text->next < text->end && volcomp_blank(*text->next))
        text->line += *text->next++ == '\n';
    while (text->next < text->end && !volcomp_blank(*text->next) && length + 1 < sizeof text->word)
        text->word[length++] = *text->next++;
    text->word[length] = 0;
    return length > 0 && length + 1 < sizeof text->word;
}

// The same, and count the word in for the checksum.
static int volcomp_take(volcomp_text *text)
{
    const char *c;
    if (!volcomp_next(text))
        return 0;
    if (text->words++)
        volcomp_crc(text, ' ');
    for (c = text->word; *c; c++)
        volcomp_crc(text, (unsigned char) *c);
    return 1;
}

static int volcomp_number(volcomp_text *text, double *value)
{
    char *rest;
    if (!volcomp_take(text) || text->word[strspn(text->word, "0123456789+-.eE")])
        return 0;
    *value = strtod(text->word, &rest);
    return *rest == 0 && rest != text->word && isfinite(*value);
}

static int volcomp_whole(volcomp_text *text, int least, int most, int *value)
{
    long number;
    if (!volcomp_take(text) || text->word[strspn(text->word, "0123456789")] || strlen(text->word) > 9)
        return 0;
    number = strtol(text->word, NULL, 10);
    *value = (int) number;
    return number >= least && number <= most;
}

static double *volcomp_numbers(volcomp_table *table, volcomp_text *text, size_t count)
{
    size_t k;
    double *value = malloc(count * sizeof *value);
    for (k = 0; value && k < count; k++)
        if (!volcomp_number(text, &value[k])) {
            volcomp_fail(table, text, "expected a number");
            free(value);
            return NULL;
        }
    if (!value)
        volcomp_fail(table, text, "no memory");
    return value;
}

static int volcomp_find(const volcomp_table *table, const char *name)
{
    int k;
    for (k = 0; k < table->curves; k++)
        if (!strcmp(table->curve[k].name, name))
            return k;
    return -1;
}

static int volcomp_read_curve(volcomp_table *table, volcomp_text *text)
{
    volcomp_curve *curve = &table->curve[table->curves];
    if (table->curves == VOLCOMP_CURVES)
        return volcomp_fail(table, text, "too many curves");
    if (!volcomp_take(text) || strlen(text->word) >= VOLCOMP_NAME || volcomp_find(table, text->word) >= 0)
        return volcomp_fail(table, text, "expected a new name of a curve");
    strcpy(curve->name, text->word);
    if (!volcomp_whole(text, 0, 2, &curve->axis))
        return volcomp_fail(table, text, "expected an axis 0, 1 or 2");
    if (!volcomp_whole(text, 1, VOLCOMP_NODES, &curve->count))
        return volcomp_fail(table, text, "expected a number of nodes");
    if (!volcomp_number(text, &curve->first))
        return volcomp_fail(table, text, "expected the position of the first node");
    if (!volcomp_number(text, &curve->step) || curve->step <= 0)
        return volcomp_fail(table, text, "expected a step above zero");
    curve->value = volcomp_numbers(table, text, curve->count);
    table->curves += curve->value != NULL;
    return curve->value != NULL;
}

static int volcomp_read_term(volcomp_table *table, volcomp_text *text)
{
    static const char *const levers[] = {"1", "x", "y", "z", "tx", "ty", "tz"};
    volcomp_term *term = &table->term[table->terms];
    if (table->terms == VOLCOMP_TERMS)
        return volcomp_fail(table, text, "too many terms");
    if (!volcomp_whole(text, 0, 2, &term->out))
        return volcomp_fail(table, text, "expected an axis 0, 1 or 2");
    if (!volcomp_take(text) || (term->curve = volcomp_find(table, text->word)) < 0)
        return volcomp_fail(table, text, "expected the name of a curve above");
    if (!volcomp_number(text, &term->coefficient))
        return volcomp_fail(table, text, "expected a coefficient");
    if (!volcomp_take(text))
        return volcomp_fail(table, text, "expected a lever");
    for (term->lever = 0; term->lever < 7; term->lever++)
        if (!strcmp(text->word, levers[term->lever])) {
            table->terms++;
            return 1;
        }
    return volcomp_fail(table, text, "expected a lever: 1 x y z tx ty tz");
}

static int volcomp_read_grid(volcomp_table *table, volcomp_text *text)
{
    int k;
    double total = 1;
    if (table->vertices)
        return volcomp_fail(table, text, "there is a second grid");
    for (k = 0; k < 3; k++)
        if (!volcomp_whole(text, 1, VOLCOMP_NODES, &table->count[k]))
            return volcomp_fail(table, text, "expected a number of vertices");
    for (k = 0; k < 3; k++)
        if (!volcomp_number(text, &table->first[k]))
            return volcomp_fail(table, text, "expected the position of the first vertex");
    for (k = 0; k < 3; k++) {
        if (!volcomp_number(text, &table->step[k]) || table->step[k] <= 0)
            return volcomp_fail(table, text, "expected a step above zero");
        total *= table->count[k];
    }
    if (total > VOLCOMP_VERTICES)
        return volcomp_fail(table, text, "too many vertices");
    table->vertex = volcomp_numbers(table, text, 3 * (size_t) total);
    table->vertices = table->vertex ? (int) total : 0;
    return table->vertex != NULL;
}

// What follows the word "end": comments, and the checksum of all words up to "end".
static int volcomp_read_trailer(volcomp_table *table, volcomp_text *text)
{
    unsigned long stated, counted = text->crc ^ 0xFFFFFFFFUL;
    char *rest;
    int found = 0;
    while (volcomp_next(text) || text->word[0]) {
        if (text->word[0] == '#') {
            while (text->next < text->end && *text->next != '\n')
                text->next++;
            continue;
        }
        if (found || strcmp(text->word, "crc32") || !volcomp_next(text) || strlen(text->word) != 8)
            return volcomp_fail(table, text, "only a comment or 'crc32 XXXXXXXX' may follow 'end'");
        stated = strtoul(text->word, &rest, 16);
        if (*rest || stated != counted)
            return volcomp_fail(table, text, "the checksum is wrong");
        found = 1;
    }
    return found || volcomp_fail(table, text, "there is no checksum: the file is truncated");
}

static int volcomp_read_unit(volcomp_table *table, volcomp_text *text)
{
    if (!volcomp_take(text) || (strcmp(text->word, "mm") && strcmp(text->word, "inch")))
        return volcomp_fail(table, text, "expected the unit mm or inch");
    table->unit = strcmp(text->word, "mm") ? VOLCOMP_INCH : VOLCOMP_MM;
    return 1;
}

static int volcomp_read(volcomp_table *table, volcomp_text *text)
{
    int good = 1, first;
    if (!volcomp_take(text) || strcmp(text->word, "volcomp"))
        return volcomp_fail(table, text, "expected 'volcomp 1'");
    if (!volcomp_take(text) || strcmp(text->word, "1"))
        return volcomp_fail(table, text, "expected 'volcomp 1'");
    table->unit = VOLCOMP_MM;   // of tables without the word "unit"
    for (first = 1; good; first = 0) {
        if (!volcomp_take(text))
            return volcomp_fail(table, text, "there is no 'end': the file is truncated");
        if (!strcmp(text->word, "end"))
            break;
        if (first && !strcmp(text->word, "unit"))
            good = volcomp_read_unit(table, text);
        else if (!strcmp(text->word, "curve"))
            good = volcomp_read_curve(table, text);
        else if (!strcmp(text->word, "term"))
            good = volcomp_read_term(table, text);
        else if (!strcmp(text->word, "grid"))
            good = volcomp_read_grid(table, text);
        else
            good = volcomp_fail(table, text, "expected 'curve', 'term', 'grid' or 'end'");
    }
    if (good && !table->vertices == !table->terms)
        return volcomp_fail(table, text, "expected either terms or a grid");
    return good && volcomp_read_trailer(table, text);
}

static char *volcomp_slurp(volcomp_table *table, const char *path, size_t *length)
{
    FILE *file = fopen(path, "rb");
    char *bytes = NULL;
    long size = -1;
    if (!file) {
        snprintf(table->message, sizeof table->message, "cannot open: %s", strerror(errno));
        return NULL;
    }
    if (!fseek(file, 0, SEEK_END) && (size = ftell(file)) > 0 && size <= VOLCOMP_BYTES && !fseek(file, 0, SEEK_SET))
        bytes = malloc(size);
    if (bytes && fread(bytes, 1, size, file) != (size_t) size) {
        free(bytes);
        bytes = NULL;
    }
    fclose(file);
    if (!bytes)
        snprintf(table->message, sizeof table->message, "cannot be read (%ld bytes)", size);
    *length = bytes ? size : 0;
    return bytes;
}

// Read the table at path; returns 1 and sets good, or 0 with message. Nothing of a bad file is used.
static int volcomp_load(volcomp_table *table, const char *path)
{
    volcomp_text text;
    size_t length;
    char *bytes;
    memset(table, 0, sizeof *table);
    memset(&text, 0, sizeof text);
    bytes = volcomp_slurp(table, path, &length);
    if (!bytes)
        return 0;
    text.next = bytes;
    text.end = bytes + length;
    text.line = 1;
    text.crc = 0xFFFFFFFFUL;
    table->good = volcomp_read(table, &text);
    free(bytes);
    return table->good;
}

// ---- the machine ---------------------------------------------------------------------------------------------------

// Copy what the INI file of the running LinuxCNC says at [section] key, without blanks around it; 0 if that is not known.
// The script linuxcnc names the file, with all includes expanded, in INI_FILE_NAME.
static inline int volcomp_ini(const char *section, const char *key, char *value, size_t size)
{
    const char *path = getenv("INI_FILE_NAME");
    FILE *file = path ? fopen(path, "r") : NULL;
    char line[1024], *start, *end, *equals;
    int inside = 0, found = 0;
    while (file && !found && fgets(line, sizeof line, file)) {
        start = line + strspn(line, " \t");
        for (end = start + strlen(start); end > start && volcomp_blank(end[-1]);)
            *--end = 0;
        if (*start == '[') {
            inside = !strncmp(start + 1, section, strlen(section)) && start[1 + strlen(section)] == ']';
            continue;
        }
        equals = strchr(start, '=');
        if (!inside || *start == '#' || *start == ';' || !equals || strncmp(start, key, strlen(key)))
            continue;
        if (start + strlen(key) + strspn(start + strlen(key), " \t") != equals)
            continue;
        equals++;
        snprintf(value, size, "%s", equals + strspn(equals, " \t"));
        found = 1;
    }
    if (file)
        fclose(file);
    return found;
}

// The unit that a word names, in all spellings of [TRAJ] LINEAR_UNITS (a number is units per mm); 0 for any other word.
static inline int volcomp_unit(const char *word)
{
    char *rest;
    double per_mm = strtod(word, &rest);
    if (!strcasecmp(word, "mm") || !strcasecmp(word, "metric"))
        return VOLCOMP_MM;
    if (!strcasecmp(word, "in") || !strcasecmp(word, "inch") || !strcasecmp(word, "imperial"))
        return VOLCOMP_INCH;
    if (rest == word || *rest)
        return 0;
    return fabs(per_mm - 1) < 0.001 ? VOLCOMP_MM : fabs(per_mm * 25.4 - 1) < 0.001 ? VOLCOMP_INCH : 0;
}

// Take the table out of use unless its unit is that of the machine: what "units=" states, and what the INI file says. Both
// must agree, and one of them must be given; a table in the wrong unit would act 25.4 times too much at the wrong place.
static inline void volcomp_check_unit(volcomp_table *table, const char *stated)
{
    static const char *names[] = {"?", "mm", "inch"};
    char ini[64] = "";
    int said, known = volcomp_ini("TRAJ", "LINEAR_UNITS", ini, sizeof ini), machine;
    size_t size = sizeof table->message;
    if (!table->good)
        return;
    table->good = 0;
    said = volcomp_unit(stated);
    machine = known ? volcomp_unit(ini) : said;
    if (*stated && !said)
        snprintf(table->message, size, "units=%.32s is not known; expected mm or inch", stated);
    else if (known && !machine)
        snprintf(table->message, size, "[TRAJ] LINEAR_UNITS = %.32s is not known; expected mm or inch", ini);
    else if (!machine)
        snprintf(table->message, size, "the unit of the machine is not known: add units=mm or units=inch after file=");
    else if (said && said != machine)
        snprintf(table->message, size, "units=%.32s, but [TRAJ] LINEAR_UNITS = %.32s", stated, ini);
    else if (machine != table->unit)
        snprintf(table->message, size, "the table is in %s, but the machine is in %s: export it with machine_units = \"%s\"",
                 names[table->unit], names[machine], names[machine]);
    else
        table->good = 1;
}

// ---- evaluation ----------------------------------------------------------------------------------------------------

// Linear between the nodes, end values outside.
static double volcomp_curve_at(const volcomp_curve *curve, double q)
{
    double ratio = (q - curve->first) / curve->step;
    int left;
    if (!(ratio > 0))
        return curve->value[0];
    if (ratio >= curve->count - 1)
        return curve->value[curve->count - 1];
    left = (int) ratio;
    return curve->value[left] + (ratio - left) * (curve->value[left + 1] - curve->value[left]);
}

// Trilinear between the vertices, the values of the surface outside.
static void volcomp_grid_at(const volcomp_table *table, const double q[3], double e[3])
{
    double share[3];
    int cell[3], corner, k;
    for (k = 0; k < 3; k++) {
        int last = table->count[k] - 1;
        double ratio = (q[k] - table->first[k]) / table->step[k];
        ratio = ratio > 0 ? (ratio < last ? ratio : last) : 0;
        cell[k] = (int) ratio;
        if (cell[k] > last - 1)
            cell[k] = last > 0 ? last - 1 : 0;
        share[k] = ratio - cell[k];
    }
    for (corner = 0; corner < 8; corner++) {
        const int upper[3] = {corner & 1, corner >> 1 & 1, corner >> 2};
        size_t at[3];
        double weight = 1;
        const double *vertex;
        for (k = 0; k < 3; k++) {
            weight = weight * (upper[k] ? share[k] : 1 - share[k]);
            at[k] = cell[k] + upper[k] < table->count[k] ? cell[k] + upper[k] : table->count[k] - 1;
        }
        vertex = table->vertex + 3 * ((at[2] * table->count[1] + at[1]) * table->count[0] + at[0]);
        for (k = 0; k < 3; k++)
            e[k] += weight * vertex[k];
    }
}

// Error of the tip at axis positions q with the tool offset t.
static void volcomp_error(const volcomp_table *table, const double q[3], const double t[3], double e[3])
{
    double value[VOLCOMP_CURVES];
    const double lever[7] = {1, q[0], q[1], q[2], t[0], t[1], t[2]};
    int k;
    e[0] = e[1] = e[2] = 0;
    if (!table->good)
        return;
    if (table->vertices) {
        volcomp_grid_at(table, q, e);
        return;
    }
    for (k = 0; k < table->curves; k++)
        value[k] = volcomp_curve_at(&table->curve[k], q[table->curve[k].axis]);
    for (k = 0; k < table->terms; k++) {
        const volcomp_term *term = &table->term[k];
        e[term->out] += term->coefficient * lever[term->lever] * value[term->curve];
    }
}

static int volcomp_finite(const double v[3])
{
    return isfinite(v[0]) && isfinite(v[1]) && isfinite(v[2]);
}

// Axis positions q that put the tip at P; returns 0, or -1 if the iteration does not end, or P or t is not a number
// (one NaN on a tool pin would reach every drive).
static int volcomp_inverse(const volcomp_table *table, const double p[3], const double t[3], double q[3])
{
    int round, k;
    for (k = 0; k < 3; k++)
        q[k] = p[k];
    if (!volcomp_finite(p) || !volcomp_finite(t))
        return -1;
    for (round = 0; round < VOLCOMP_ROUNDS; round++) {
        double e[3];
        int moved = 0;
        volcomp_error(table, q, t, e);
        for (k = 0; k < 3; k++) {
            double next = p[k] - e[k];
            double step = fabs(next - q[k]);
            moved |= step > VOLCOMP_STEP + VOLCOMP_PART * fabs(next);
            q[k] = next;
        }
        if (!volcomp_finite(q))
            return -1;
        if (!moved)
            return 0;
    }
    return -1;
}

#endif
// end of volcomp.h
