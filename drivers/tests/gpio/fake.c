// libgpiod as drivers/tests/gpio.rs builds it, version 1 or 2 by -DVERSION: one chip "fake", whose line 3 "ready" has two
// edges. What is asked of it is printed. Types are those of <gpiod.h>, written out, so that both build on one machine.
#include <errno.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <time.h>

static int edges = 2;
static uint64_t stamp(int i) {
    static uint64_t first;
    struct timespec t;
    if (!first && clock_gettime(CLOCK_MONOTONIC, &t) == 0) first = (uint64_t)t.tv_sec * 1000000000u + (uint64_t)t.tv_nsec;
    dprintf(1, "edge %llu\n", (unsigned long long)(first + 7u * (uint64_t)i));
    return first + 7u * (uint64_t)i;
}
static int line_of(const char *name) { return strcmp(name, "ready") == 0 ? 3 : -1; }

#if VERSION == 1
struct chip { char open; };
struct line { int offset; };
struct config { const char *consumer; int type, flags; };
struct event { struct timespec t; int type; };
static struct chip chip;
static struct line line;

struct chip *gpiod_chip_open_lookup(const char *name) { return strcmp(name, "fake") == 0 ? &chip : (errno = ENOENT, NULL); }
void gpiod_chip_close(struct chip *c) { dprintf(1, "close %d\n", c == &chip); }
struct line *gpiod_chip_get_line(struct chip *c, unsigned int offset) { line.offset = (int)offset; return c == &chip ? &line : NULL; }
struct line *gpiod_chip_find_line(struct chip *c, const char *name) { return gpiod_chip_get_line(c, (unsigned)line_of(name)); }
int gpiod_line_request(struct line *l, const struct config *r, int value) {
    dprintf(1, "request %d for %s: %d %d %d\n", l->offset, r->consumer, r->type, r->flags, value);
    return 0;
}
int gpiod_line_set_value(struct line *l, int value) { dprintf(1, "set %d %d\n", l->offset, value); return 0; }
int gpiod_line_event_wait(struct line *l, const struct timespec *t) { return l == &line && t->tv_nsec < 1000000000 && edges > 0; }
int gpiod_line_event_read_multiple(struct line *l, struct event *events, unsigned int n) {
    int i = 0;
    for (; l == &line && edges > 0 && i < (int)n; i++, edges--) {
        const uint64_t ns = stamp(i);
        events[i] = (struct event){{(time_t)(ns / 1000000000u), (long)(ns % 1000000000u)}, 1};
    }
    return i;
}
#else
struct object { int offset, direction, edge; bool low; const char *text; };
static struct object chip, info, settings, lines, config, request, buffer, event[2];
static int held;
static struct object *made(struct object *o) { held++; return o; }
static void freed(const struct object *o) { if (o && --held == 0) dprintf(1, "nothing held\n"); }

struct object *gpiod_chip_open(const char *path) { return strcmp(path, "/dev/gpiochip7") == 0 ? made(&chip) : (errno = ENOENT, NULL); }
void gpiod_chip_close(struct object *c) { freed(c); }
struct object *gpiod_chip_get_info(struct object *c) { return c == &chip ? made(&info) : NULL; }
const char *gpiod_chip_info_get_label(struct object *i) { return i == &info ? "fake" : ""; }
void gpiod_chip_info_free(struct object *i) { freed(i); }
int gpiod_chip_get_line_offset_from_name(struct object *c, const char *name) { return c == &chip ? line_of(name) : -1; }
struct object *gpiod_line_settings_new(void) { return made(&settings); }
void gpiod_line_settings_free(struct object *s) { freed(s); }
int gpiod_line_settings_set_direction(struct object *s, int direction) { s->direction = direction; return 0; }
int gpiod_line_settings_set_edge_detection(struct object *s, int edge) { s->edge = edge; return 0; }
void gpiod_line_settings_set_active_low(struct object *s, bool low) { s->low = low; }
struct object *gpiod_line_config_new(void) { return made(&lines); }
void gpiod_line_config_free(struct object *l) { freed(l); }
int gpiod_line_config_add_line_settings(struct object *l, const unsigned int *offsets, size_t n, struct object *s) {
    *l = *s;
    l->offset = (int)offsets[n - 1];
    return 0;
}
struct object *gpiod_request_config_new(void) { return made(&config); }
void gpiod_request_config_free(struct object *c) { freed(c); }
void gpiod_request_config_set_consumer(struct object *c, const char *name) { c->text = name; }
struct object *gpiod_chip_request_lines(struct object *c, struct object *r, struct object *l) {
    request = *l;
    dprintf(1, "request %d for %s: %d %d %d\n", l->offset, r->text, l->direction, l->edge, l->low);
    return c == &chip ? made(&request) : NULL;
}
void gpiod_line_request_release(struct object *r) { freed(r); }
int gpiod_line_request_set_value(struct object *r, unsigned int offset, int value) {
    dprintf(1, "set %u %d\n", offset, value);
    return r == &request ? 0 : -1;
}
int gpiod_line_request_wait_edge_events(struct object *r, int64_t ns) { return r == &request && ns >= 0 && edges > 0; }
struct object *gpiod_edge_event_buffer_new(size_t n) { return n >= 2 ? made(&buffer) : NULL; }
void gpiod_edge_event_buffer_free(struct object *b) { freed(b); }
int gpiod_line_request_read_edge_events(struct object *r, struct object *b, size_t n) {
    int read = edges;
    edges = 0;
    return r == &request && b == &buffer && n >= 2 ? read : -1;
}
struct object *gpiod_edge_event_buffer_get_event(struct object *b, unsigned long i) { return b == &buffer ? &event[i] : NULL; }
uint64_t gpiod_edge_event_get_timestamp_ns(struct object *e) { return stamp((int)(e - event)); }
#endif
