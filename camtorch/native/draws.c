/* New cameras of drawn values. augment/drawer.py has the same formulas, recorded by torch, and says why. */
#include "draws.h"

#include <math.h>
#include <string.h>

#include "small.h"

#define PI 3.14159265358979323846

int64_t THIS(geometry)(const Rows *);
int64_t THIS(moves)(const Move *);
void THIS(domain)(const Domain *);

/* Where the numbers of a camera lie, `size` of each */
static void *row(const Draws *d, const void *all, int64_t camera, int64_t size) {
    return (char *)all + camera * size * (int64_t)(d->made.is_double ? sizeof(double) : sizeof(float));
}

/* Points (n, 3) to pixels, or pixels (n, 2) to rays; how many wait for limits */
static int64_t evaluate(const Cameras *one, int64_t direction, int64_t n, const void *rows, void *results, uint8_t *valid) {
    const int64_t is_back = direction == UNPROJECT;
    const Rows call = {.cameras = one, .rows = rows, .row_strides = {0, 3 - is_back, 1}, .results = results,
                       .result_strides = {0, 2 + is_back, 1}, .valid = valid, .count = n, .tile = n, .direction = direction};
    return THIS(geometry)(&call);
}

static int all(const uint8_t *valid, int64_t n) { return !memchr(valid, 0, (size_t)n); }

/* The largest distance of a corner from the principal point, by each focal length */
static double farthest(const Start *s, const double *f) {
    return hypot(fmax(f[2] + 0.5, s->width - 0.5 - f[2]) / f[0], fmax(f[3] + 0.5, s->height - 0.5 - f[3]) / f[1]);
}

/* fx, fy, cx, cy before any crop */
static int64_t place(const Draws *d, int64_t c, double *f) {
    const Start *s = d->start;
    const Drawn *drawn = d->drawn + c;
    const int64_t is_double = d->made.is_double, each = s->is_each ? c : 0;
    memcpy(f, s->sized + 4 * each, 4 * sizeof *f);
    if (drawn->fov != 0) { /* between rays to both sides of the axis */
        const double half = drawn->fov * (PI / 360), x = sin(half), z = cos(half);
        const double ends[6] = {-x, 0, z, x, 0, z};
        double points[6], pixels[4];
        uint8_t valid[2];
        const Cameras base = only(s->base, c);
        for (int i = 0; i < 6; i++) put(points, i, ends[i], is_double);
        if (evaluate(&base, PROJECT, 2, points, pixels, valid)) return LEFT_BASE;
        if (!all(valid, 2)) return TOO_WIDE;
        const double wide = number(pixels, 2, is_double) - number(pixels, 0, is_double);
        for (int i = 0; i < 2; i++) f[i] = number(base.intrinsics, i, is_double) * s->width / wide;
    }
    const double larger = drawn->focal * drawn->zoom;
    f[0] *= larger, f[1] *= larger;
    f[2] += drawn->centre[0] * s->width, f[3] += drawn->centre[1] * s->height;
    if (s->reach) { /* all pixels have rays */
        const double factor = fmax(farthest(s, f) / (TO_FOLD * s->reach[each]), 1);
        f[0] *= factor, f[1] *= factor;
    }
    return 0;
}

/* Pixels of the outline of what the base shows of the image; the principal point for the rest. Their number, or less than
   zero the flag of what is left */
static int64_t outline(const Draws *d, int64_t c, const double *f, const void *intrinsics, void *rim) {
    const Start *s = d->start;
    const int64_t is_double = d->made.is_double, each = s->is_each ? c : 0;
    memcpy(rim, s->border, (size_t)((char *)row(d, rim, 1, 2 * RIM) - (char *)rim));
    Cameras base = only(s->base, c);
    double rays[6 * RIM];
    uint8_t valid[2 * RIM];
    base.intrinsics = intrinsics;
    if (evaluate(&base, UNPROJECT, RIM, rim, rays, valid)) return -LEFT_BASE;
    if (all(valid, RIM)) return RIM;
    if (!s->ends) return -LEFT_ENDS;
    for (int i = 0; i < RIM; i++) {
        const double *end = s->ends + 2 * (each * RIM + i), u = end[0] * f[0] + f[2], v = end[1] * f[1] + f[3];
        const int shown = u >= -0.5 && u <= s->width - 0.5 && v >= -0.5 && v <= s->height - 0.5;
        put(rim, 2 * (RIM + i), shown ? u : number(rim, 0, is_double), is_double);
        put(rim, 2 * (RIM + i) + 1, shown ? v : number(rim, 1, is_double), is_double);
    }
    if (evaluate(&base, UNPROJECT, 2 * RIM, rim, rays, valid)) return -LEFT_BASE;
    for (int i = 0; i < 2 * RIM; i++)
        if (!valid[i]) put(rim, 2 * i, f[2], is_double), put(rim, 2 * i + 1, f[3], is_double);
    return 2 * RIM;
}

/* Finds the domain of a new lens, or its limits of azimuths alone */
static void ask(const Start *s, Cameras *lens, int limits) {
    Domain asked = s->domain;
    double parameters[lens->parameter_count];
    if (!lens->safe_radius_sq && !lens->chart_table) return; /* its chart knows by its parameters where it ends */
    for (int64_t j = 0; j < lens->parameter_count; j++) parameters[j] = number(lens->parameters, j, lens->is_double);
    asked.cameras = 1, asked.parameters = parameters;
    asked.image_circle_sq = (void *)lens->image_circle_sq, asked.stagewise = (uint8_t *)lens->stagewise;
    if (lens->chart_table) asked.safe_radius_sq = (void *)lens->chart_safe_radius_sq, asked.table = (void *)lens->chart_table;
    else if (limits) asked.limits2 = (void *)lens->limits2, asked.extent = (void *)lens->extent;
    else asked.safe_radius_sq = (void *)lens->safe_radius_sq, asked.image_radius_sq = (void *)lens->image_radius_sq, asked.table = (void *)lens->table;
    THIS(domain)(&asked);
    if (lens->chart_table) put((void *)lens->chart_most2, 0, number(lens->chart_table, 1, lens->is_double), lens->is_double);
}

/* Finds the limits of azimuths of a new lens, for which a point waits */
static void follow(Draws *d, int64_t c, Cameras *lens) {
    const Cameras made = only(&d->made, c);
    lens->limits2 = made.limits2, lens->extent = made.extent;
    ask(d->start, lens, 1);
    d->followed++;
}

/* A new lens: coefficients move by drawn amounts, as far, or a part of it, as leaves the outline of the image invertible */
static int64_t bend(Draws *d, int64_t c, const double *f, Cameras *lens) {
    static const double parts[TRIES + 1] = {JITTER_PARTS, 0};
    const Start *s = d->start;
    const int64_t is_double = d->made.is_double, each = s->is_each ? c : 0, before = d->followed;
    const void *given = row(d, s->coefficients, each, s->count);
    void *k = row(d, d->distortion, c, s->count);
    double rim[4 * RIM], rays[6 * RIM];
    uint8_t valid[2 * RIM];
    *lens = only(&d->made, c);
    for (int i = 0; i < 4; i++) put((void *)lens->intrinsics, i, f[i], is_double);
    const int64_t n = outline(d, c, f, lens->intrinsics, rim);
    if (n < 0) return -n;
    for (int i = 0; i <= TRIES; i++) {
        for (int j = 0; j < s->count; j++) {
            const double step = d->drawn[c].distortion[j % AMOUNTS] * s->sensitivity[each * s->count + j];
            put(k, j, number(given, j, is_double) + parts[i] * step, is_double);
        }
        for (int j = 0; j < lens->parameter_count; j++)
            put((void *)lens->parameters, j, number(k, s->places[j], is_double), is_double);
        lens->limits2 = lens->extent = NULL, d->followed = before;
        ask(s, lens, 0);
        if (i == TRIES) break; /* no step fits: it keeps its coefficients */
        if (evaluate(lens, UNPROJECT, n, rim, rays, valid)) {
            follow(d, c, lens);
            evaluate(lens, UNPROJECT, n, rim, rays, valid);
        }
        if (all(valid, n)) break;
    }
    return 0;
}

/* `mount_rotation`, of degrees */
static void turned(const Draws *d, int64_t c) {
    const Drawn *drawn = d->drawn + c;
    const double a = drawn->yaw * (PI / 180), b = drawn->pitch * (PI / 180);
    const double lean = drawn->roll * (PI / 180), ca = cos(a), sa = sin(a), cb = cos(b), sb = sin(b);
    const double cc = cos(lean), sc = sin(lean), right = sa * sb, ahead = ca * sb;
    const double elements[9] = {right * sc + ca * cc, cb * sc, ahead * sc - sa * cc,
                                right * cc - ca * sc, cb * cc, sa * sc + ahead * cc, sa * cb, -sb, ca * cb};
    for (int i = 0; i < 9; i++) put(row(d, d->rotations, c, 9), i, elements[i], d->made.is_double);
}

/* The part of a turn; `rotation_vector`, and its way back, by a quaternion */
static void turned_less(const double *m, double part, double *turn) {
    double q[4];
    quaternion_of(m, q);
    const double size = sqrt(dot(q + 1, q + 1)), half = part * atan2(size, fabs(q[0]));
    const double by = (q[0] < 0 ? -1 : 1) * sin(half) / (size > 0 ? size : 1), w = cos(half);
    const double a = q[1] * by, b = q[2] * by, c = q[3] * by;
    const double made[9] = {1 - 2 * (b * b + c * c), 2 * (a * b - w * c), 2 * (a * c + w * b),
                            2 * (a * b + w * c), 1 - 2 * (a * a + c * c), 2 * (b * c - w * a),
                            2 * (a * c - w * b), 2 * (b * c + w * a), 1 - 2 * (a * a + b * b)};
    memcpy(turn, made, sizeof made);
}

/* The share of a new image that shows something of the source, if the camera is turned and zooms; 1 where its whole rim
   does. Less than zero: a flag of what is left */
static double shown(const Draws *d, int64_t c, const Cameras *lens, const double *turn, double zoom) {
    const int64_t is_double = d->made.is_double;
    const Cameras source = only(d->start->source, c);
    double pixels[2 * LOOKED_AT], moved[2 * LOOKED_AT], turns[9];
    uint8_t valid[LOOKED_AT];
    for (int i = 0; i < 9; i++) put(turns, i, turn[i], is_double);
    for (int i = 0; i < 2 * LOOKED_AT; i++) {
        const double centre = number(lens->intrinsics, 2 + i % 2, is_double), pixel = number(d->start->looked_at, i, is_double);
        put(pixels, i, centre + (pixel - centre) / zoom, is_double);
    }
    const Move call = {.from = lens, .to = &source, .turns = turns, .turn_strides = {0, 1, 3}, .cameras = 1, .form = ON_IMAGE,
                       .height = d->start->source_height, .width = d->start->source_width, .rows = pixels, .row_strides = {0, 2, 1},
                       .results = moved, .result_strides = {0, 2, 1}, .valid = valid, .count = LOOKED_AT, .tile = LOOKED_AT};
    const int64_t left = THIS(moves)(&call);
    if (left) return -(double)left;
    int count = 0;
    for (int i = 0; i < SPREAD; i++) count += valid[i];
    const double part = count / (double)SPREAD;
    return all(valid + SPREAD, LOOKED_AT - SPREAD) ? part : fmin(part, NEARLY_FILLED);
}

/* Zooms, up to MOST_ZOOM, and then turns less far, until enough of the image shows something; `enough`. A flag of what is
   left, as of moves */
static int64_t fill(const Draws *d, int64_t c, const Cameras *lens) {
    static const double parts[] = {TURN_PARTS};
    double given[9], turn[9], found, best = 1;
    int is_straight = 1;
    for (int i = 0; i < 9; i++) {
        given[i] = turn[i] = number(row(d, d->rotations, c, 9), i, d->made.is_double);
        is_straight &= given[i] == (i % 4 == 0);
    }
    found = shown(d, c, lens, given, 1);
    if (found < 0) return (int64_t)-found;
    for (int i = is_straight ? 3 : 0; i < 4 && found < d->start->share; i++) {
        double low = 1, high = i < 3 ? MOST_ZOOM : FAR_ZOOM, now = found;
        const double most = high;
        if (i && !is_straight) {
            turned_less(given, parts[i], turn);
            if ((now = shown(d, c, lens, turn, 1)) < 0) return (int64_t)-now;
        }
        if (now >= d->start->share) high = 1;
        for (int count = 0; count < HALVINGS && high > 1; count++) {
            /* as torch rounds it, for what is chosen hangs on it */
            const double middle = d->made.is_double ? sqrt(low * high) : (double)sqrtf((float)(low * high));
            const double here = shown(d, c, lens, turn, middle);
            if (here < 0) return (int64_t)-here;
            if (here >= d->start->share) high = middle, now = here;
            else low = middle;
        }
        if (high == most && (now = shown(d, c, lens, turn, high)) < 0) return (int64_t)-now;
        if (!(now > found)) continue;
        found = now, best = high;
        for (int j = 0; j < 9; j++) put(row(d, d->rotations, c, 9), j, turn[j], d->made.is_double);
    }
    for (int i = 0; i < 2; i++) {
        const double focal = number(lens->intrinsics, i, d->made.is_double);
        put((void *)lens->intrinsics, i, focal * best, d->made.is_double);
    }
    d->factors[c] = best, d->filled[c] = found;
    return 0;
}

/* The same; finds the limits of a new lens if they are needed. Flags of what is left */
static int64_t fill_knowing(Draws *d, int64_t c, Cameras *lens) {
    int64_t left = fill(d, c, lens);
    if (left & LEFT_FROM && d->start->places) {
        follow(d, c, lens);
        left = fill(d, c, lens);
    }
    return (left & LEFT_FROM ? LEFT_BASE : 0) | (left & LEFT_TO ? LEFT_SOURCE : 0);
}

/* Divides the memory among the new cameras; new lenses have what the base's has, and limits */
static void divide(Draws *d) {
    const int64_t rows = d->cameras;
    char *at = d->room;
    d->made = *d->start->base;
    d->made.cameras = rows, d->made.usable = NULL;
#define TAKE(place, size) place = (void *)at, at = row(d, at, rows, size)
#define TAKE_KNOWN(field, size) if (d->made.field) TAKE(d->made.field, size)
    TAKE(d->made.intrinsics, 4);
    TAKE(d->rotations, 9);
    TAKE(d->distortion, d->start->count);
    if (!d->start->places) return;
    TAKE_KNOWN(parameters, d->made.parameter_count);
    TAKE_KNOWN(safe_radius_sq, 1);
    TAKE_KNOWN(image_radius_sq, 1);
    TAKE_KNOWN(image_circle_sq, 1);
    TAKE_KNOWN(stagewise, 1);
    TAKE_KNOWN(table, 2 + 2 * NODES);
    TAKE_KNOWN(chart_safe_radius_sq, 1);
    TAKE_KNOWN(chart_most2, 1);
    TAKE_KNOWN(chart_table, 2 + 2 * NODES);
    d->made.limits2 = d->made.extent = NULL;
    if (!(at = d->limits)) return;
    TAKE(d->made.limits2, AZIMUTHS);
    TAKE(d->made.extent, EXTENT);
#undef TAKE
#undef TAKE_KNOWN
}

/* Makes the cameras; flags of what is left */
int64_t THIS(draws)(Draws *d) {
    const Start *s = d->start;
    int64_t left = d->followed = 0;
    divide(d);
    for (int64_t c = 0; c < d->cameras; c++) {
        const Drawn *drawn = d->drawn + c;
        double f[4];
        int64_t here = place(d, c, f);
        Cameras lens = only(s->base, c); /* of the new camera */
        lens.intrinsics = row(d, d->made.intrinsics, c, 4);
        if (!here && s->places) here = bend(d, c, f, &lens);
        left |= here;
        if (here) continue;
        const double share = drawn->crop; /* a part of the image, enlarged to the full size */
        for (int i = 0; i < 2; i++) {
            const double from = (1 - share) * drawn->place[i] * (i ? s->height : s->width);
            f[i] /= share, f[2 + i] = (f[2 + i] + 0.5 - from) / share - 0.5;
        }
        for (int i = 0; i < 4; i++) {
            put(row(d, d->made.intrinsics, c, 4), i, f[i], d->made.is_double);
            left |= isfinite(f[i]) && (i > 1 || f[i] > 0) ? 0 : NO_CAMERA;
        }
        turned(d, c);
        if (s->share > 0 && !(left & NO_CAMERA)) left |= fill_knowing(d, c, &lens);
    }
    if (s->places && d->followed < d->cameras) d->made.limits2 = d->made.extent = NULL;
    return left;
}
