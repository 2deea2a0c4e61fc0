/* The part of HAL that kinematics modules of LinuxCNC ask for, so that a test can call them: pins with names in a list. */
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
static struct { char name[64]; void *value; int kind; } pins[64];
static int count;
int hal_init(const char *name) { return 1; }
int hal_ready(int id) { return 0; }
int hal_exit(int id) { return 0; }
int hal_set_unready(int id) { return 0; }
void *hal_malloc(long size) { return calloc(1, size); }
void rtapi_print(const char *format, ...) {}
void rtapi_print_msg(int level, const char *format, ...) {}
int rtapi_snprintf(char *text, unsigned long size, const char *format, ...) {
    va_list given; va_start(given, format); int n = vsnprintf(text, size, format, given); va_end(given); return n; }
static int pin(void **place, int kind, const char *format, va_list given) {
    vsnprintf(pins[count].name, 64, format, given);
    pins[count].value = calloc(1, 8); pins[count].kind = kind; *place = pins[count].value; count++; return 0; }
int hal_pin_float_newf(int dir, void **place, int id, const char *format, ...) {
    va_list g; va_start(g, format); pin(place, 0, format, g); va_end(g); return 0; }
int hal_pin_s32_newf(int dir, void **place, int id, const char *format, ...) {
    va_list g; va_start(g, format); pin(place, 1, format, g); va_end(g); return 0; }
int hal_pin_bit_newf(int dir, void **place, int id, const char *format, ...) {
    va_list g; va_start(g, format); pin(place, 1, format, g); va_end(g); return 0; }
static int named(void **place, int kind, const char *format, ...) {
    va_list g; va_start(g, format); pin(place, kind, format, g); va_end(g); return 0; }
int hal_pin_bit_new(const char *name, int dir, void **place, int id) { return named(place, 1, "%s", name); }
int hal_pin_s32_new(const char *name, int dir, void **place, int id) { return named(place, 1, "%s", name); }
int hal_pin_float_new(const char *name, int dir, void **place, int id) { return named(place, 0, "%s", name); }
int pin_count(void) { return count; }
const char *pin_name(int k) { return pins[k].name; }
int set_pin(const char *name, double value) {
    for (int k = 0; k < count; k++) if (!strcmp(pins[k].name, name)) {
        if (pins[k].kind == 0) *(double *)pins[k].value = value; else *(int *)pins[k].value = (int)value; return 0; }
    return -1; }
