/* Rows of points and pixels, block by block: what is invalid, and why; projection/project.py, unproject.py, solve.py. */

static void T(prepare_stage)(T(Camera) *c, int j) {
    const Part *part = c->parts + j;
    const R *k = c->numbers[j] + (part->factor == RADIUS_TABLE ? 4 * part->n : part->n + part->m);
    T(Plane) *plane = c->planes + j;
    c->factors[j] = T(prepare_factor)(part, c->numbers[j], c->constants);
    if (part->kind != PLANAR) return;
    if (part->flags & TANGENTIAL) plane->px = k[0], plane->py = k[1], k += 2;
    if (part->flags & PRISM) plane->s0 = k[0], plane->s1 = k[1], plane->s2 = k[2], plane->s3 = k[3];
}

static void T(prepare)(const Cameras *all, int64_t camera, T(Camera) *c) {
    const R *numbers = (const R *)all->parameters + camera * all->parameter_count;
    const R *intrinsics = (const R *)all->intrinsics + 4 * camera;
    memset(c, 0, sizeof *c);
    c->parts = all->parts, c->stages = (int)all->part_count - 1;
    for (int j = 0; j <= c->stages; j++) c->numbers[j] = numbers, numbers += numbers_of(c->parts + j);
    c->constants = (const R *)all->constants + camera * all->constant_count;
    c->fx = intrinsics[0], c->fy = intrinsics[1], c->cx = intrinsics[2], c->cy = intrinsics[3];
    c->usable = !all->usable || all->usable[camera];
    c->safe_radius_sq = c->usable ? INFINITY : -1;
    c->swapped = c->parts->flags & TRANSVERSE && c->parts->kind >= CYLINDER;
    for (int j = 0; j <= c->stages; j++) T(prepare_stage)(c, j), c->ends |= c->parts[j].kind == SURFACE;
    if (c->stages) {
        const Part *first = c->parts + 1;
        c->is_radial = c->stages == 1 && first->kind == PLANAR && !first->flags;
        c->by_stages = all->stagewise && all->stagewise[camera];
        c->follows = !c->is_radial && !c->by_stages;
        c->safe_radius_sq = c->usable ? ((const R *)all->safe_radius_sq)[camera] : -1;
        c->image_radius_sq = all->image_radius_sq ? ((const R *)all->image_radius_sq)[camera] : c->safe_radius_sq;
        c->image_circle_sq = all->image_circle_sq ? ((const R *)all->image_circle_sq)[camera] : 0;
        c->limits2 = all->limits2 ? (const R *)all->limits2 + camera * AZIMUTHS : NULL;
        c->extent = all->extent ? (const R *)all->extent + camera * EXTENT : NULL;
        c->waits = c->follows && !c->extent;
        c->table = all->table ? (const R *)all->table + camera * (2 + 2 * NODES) : NULL;
    }
    if (c->parts->kind == INVERTED) {
        c->chart_safe_radius_sq = ((const R *)all->chart_safe_radius_sq)[camera];
        c->chart_most2 = ((const R *)all->chart_most2)[camera];
        c->chart_table = (const R *)all->chart_table + camera * (2 + 2 * NODES);
    }
    T(prepare_chart)(c);
}

/* -- memory */

/* A component of a row, with `filling` behind it */
static void T(copy)(const R *from, int64_t stride, int count, int n, R *restrict to, R filling) {
    if (stride == 1) memcpy(to, from, (size_t)count * sizeof(R));
    else for (int i = 0; i < count; i++) to[i] = from[stride * i];
    for (int i = count; i < n; i++) to[i] = filling;
}

/* The same: where it lies, if vectors can be read there, else in `to` */
static const R *T(load)(const R *from, int64_t stride, int count, int n, R *restrict to, R filling) {
    if (stride == 1 && count == n) return from;
    T(copy)(from, stride, count, n, to, filling);
    return to;
}

/* Components to results, at once where they are interleaved: from the same vectors */
static void T(store)(R *restrict to, const int64_t *strides, int components, int count, const R *restrict x,
                     const R *restrict y, const R *restrict z) {
    const int64_t point = strides[1], next = strides[2];
    if (components == 3 && point == 3 && next == 1)
        for (int i = 0; i < count; i++) to[3 * i] = x[i], to[3 * i + 1] = y[i], to[3 * i + 2] = z[i];
    else if (components == 2 && point == 2 && next == 1)
        for (int i = 0; i < count; i++) to[2 * i] = x[i], to[2 * i + 1] = y[i];
    else for (int j = 0; j < components; j++) {
        const R *from = j == 0 ? x : j == 1 ? y : z;
        if (point == 1) memcpy(to + j * next, from, (size_t)count * sizeof(R));
        else for (int i = 0; i < count; i++) to[point * i + j * next] = from[i];
    }
}

/* Where results go: at once where they belong, if vectors can be written there, else to a buffer that is stored then */
static int T(is_plane)(const int64_t *strides, int count, int n) { return strides[1] == 1 && count == n; }

/* The points of a row; those that fill up a block lie on the axis */
static void T(load_points)(const R *from, const int64_t *strides, int count, int n, R *restrict x, R *restrict y,
                           R *restrict z) {
    if (strides[1] == 3 && strides[2] == 1 && count == n) { /* at once, from the same vectors */
        EACH(i) x[i] = from[3 * i], y[i] = from[3 * i + 1], z[i] = from[3 * i + 2];
        return;
    }
    T(copy)(from, strides[1], count, n, x, 0);
    T(copy)(from + strides[2], strides[1], count, n, y, 0);
    T(copy)(from + 2 * strides[2], strides[1], count, n, z, 1);
}

static void T(load_pixels)(const R *from, const int64_t *strides, int count, int n, R *restrict u, R *restrict v, R cx,
                           R cy) {
    if (strides[1] == 2 && strides[2] == 1 && count == n) {
        EACH(i) u[i] = from[2 * i], v[i] = from[2 * i + 1];
        return;
    }
    T(copy)(from, strides[1], count, n, u, cx);
    T(copy)(from + strides[2], strides[1], count, n, v, cy);
}

/* -- rays to pixels */

/* The azimuth at or below that of a point, in even steps along the rim of the diamond |a| + |b| = 1; `offset` 0.5: the
   nearest one */
static int T(azimuth)(R a, R b, double offset) {
    const R size = T(absolute)(a) + T(absolute)(b), across = b / (size > 0 ? size : 1);
    const double turn = floor((a < 0 ? 2 - across : across) * (AZIMUTHS / 4) + offset);
    const int index = fabs(turn) <= AZIMUTHS ? (int)turn : 0; /* infinite points have none */
    return (index + AZIMUTHS) % AZIMUTHS;
}

typedef struct {
    ALIGNED R x[BLOCK], y[BLOCK], z[BLOCK], shrink[BLOCK], scale[BLOCK], a[BLOCK], b[BLOCK];
    ALIGNED I ok[BLOCK];
} T(Seen);

/* Of points beyond `safe_radius_sq`, `ok` where the lens is regular all the way from the centre. How many of those that count
   wait for limits */
static int T(beyond)(const T(Camera) *c, int count, int n, T(Seen) *s) {
    ALIGNED R a[BLOCK], b[BLOCK], u[BLOCK], v[BLOCK], least[BLOCK];
    ALIGNED I settled[BLOCK];
    T(Jacobian) jacobian;
    int places[BLOCK], waiting = 0;
    EACH(i) settled[i] = s->ok[i] != 2;
    const int some = T(chosen)(n, settled, places), filled = (some + LANES - 1) & -LANES;
    if (c->limits2) {
        for (int i = 0; i < filled; i++) a[i] = s->a[places[i]], b[i] = s->b[places[i]];
        T(lens)(c, 1, filled, a, b, u, v, &jacobian, least);
    }
    for (int i = 0; i < some; i++) {
        const int at = places[i];
        s->ok[at] = c->limits2 && c->limits2[T(azimuth)(a[i], b[i], 0)] - (a[i] * a[i] + b[i] * b[i]) > 0 && least[i] > TINY;
        waiting += !c->limits2 && at < count;
    }
    return waiting;
}

static void T(product)(const R *m, int across, int down, int n, R *restrict x, R *restrict y, R *restrict z) {
    const R a = m[0], b = m[across], c = m[2 * across], d = m[down], e = m[down + across], f = m[down + 2 * across];
    const R g = m[2 * down], h = m[2 * down + across], k = m[2 * (down + across)];
    EACH(i) {
        const R p = x[i], q = y[i], r = z[i];
        x[i] = a * p + b * q + c * r, y[i] = d * p + e * q + f * r, z[i] = g * p + h * q + k * r;
    }
}

/* The step that a Jacobian sends to (du, dv), some finite one where it is singular; one over its determinant */
INLINE R T(step)(R ua, R ub, R va, R vb, R du, R dv, R *da, R *db) {
    const R determinant = ua * vb - ub * va, one = determinant / (determinant * determinant + FLOOR);
    *da = (vb * du - ub * dv) * one, *db = (ua * dv - va * du) * one;
    return one;
}

/* Points of covered rays on the chart's plane, the centre elsewhere; keeps: rays, the axis elsewhere, and their scale too.

   Rays are points times `shrink`, a power of two, with their largest component from 1 to 2. No ray are those that are
   not finite, and the origin, next to which a derivative would leave the range of numbers. */
INLINE void T(to_plane_by_way)(const T(Camera) *c, const int way, const int keeps, R safe_radius_sq, int n, R *restrict x, R *restrict y,
                      R *restrict z, R *restrict shrink, R *restrict scale, R *restrict a, R *restrict b, I *restrict ok) {
    const T(Chart) k = c->chart;
    EACH(i) {
        const R size = T(most)(T(most)(T(absolute)(x[i]), T(absolute)(y[i])), T(absolute)(z[i]));
        const R factor = T(shrink)(size), p = x[i] * factor, q = y[i] * factor, r = z[i] * factor;
        R u, v, by;
        I is_seen;
        T(to_plane)(k, way, p, q, r, &u, &v, &by, &is_seen);
        is_seen &= (size > FLOOR) & (p * p + q * q + r * r < 16) & (safe_radius_sq - (u * u + v * v) > 0);
        a[i] = is_seen ? u : 0, b[i] = is_seen ? v : 0, ok[i] = is_seen;
        if (keeps) {
            shrink[i] = factor, scale[i] = is_seen ? by : 1;
            x[i] = is_seen ? p : 0, y[i] = is_seen ? q : 0, z[i] = is_seen ? r : 1;
        }
    }
}

static NOT_INLINE void T(to_plane_all)(const T(Camera) *c, int keeps, R safe_radius_sq, int n, R *restrict x, R *restrict y,
                                  R *restrict z, R *restrict shrink, R *restrict scale, R *restrict a, R *restrict b,
                                  I *restrict ok) {
    if (keeps) EACH_WAY(c->way, T(to_plane_by_way)(c, way, 1, safe_radius_sq, n, x, y, z, shrink, scale, a, b, ok))
    else EACH_WAY(c->way, T(to_plane_by_way)(c, way, 0, safe_radius_sq, n, x, y, z, shrink, scale, a, b, ok))
}

/* An inverted chart's angles to radii */
static void T(to_plane_inverted)(const T(Camera) *c, int keeps, int n, T(Seen) *s) {
    const R most2 = c->chart_most2, before = most2 * (1 - 32 * EPS);
    ALIGNED R found[BLOCK], theta2[BLOCK];
    EACH(i) {
        const R angle2 = s->a[i] * s->a[i] + s->b[i] * s->b[i];
        s->ok[i] &= before - angle2 > 0;
        theta2[i] = s->ok[i] ? T(least)(angle2, most2) : 0;
    }
    T(chart_inverse)(c, n, theta2, found);
    EACH(i) s->a[i] *= found[i], s->b[i] *= found[i];
    if (keeps) EACH(i) s->scale[i] *= found[i];
}

/* Where points are seen on the chart's plane in the lens's domain, the centre elsewhere. How many wait for limits */
static int T(to_plane_block)(const T(Camera) *c, int keeps, int count, int n, T(Seen) *s) {
    const int swapped = c->swapped, later = c->way == INVERTED || c->follows;
    const R safe_radius_sq = c->safe_radius_sq;
    I outside = 0;
    int waiting = 0;
    T(to_plane_all)(c, keeps, later ? c->usable ? INFINITY : -1 : safe_radius_sq, n, swapped ? s->y : s->x, swapped ? s->x : s->y,
               s->z, s->shrink, s->scale, swapped ? s->b : s->a, swapped ? s->a : s->b, s->ok);
    if (!later) return 0;
    if (c->way == INVERTED) T(to_plane_inverted)(c, keeps, n, s);
    EACH(i) {
        s->ok[i] += s->ok[i] & !(safe_radius_sq - (s->a[i] * s->a[i] + s->b[i] * s->b[i]) > 0); /* 2: beyond */
        outside |= s->ok[i];
    }
    if (!(outside & 2) && c->way != INVERTED) return 0;
    if (outside & 2 && c->follows) waiting = T(beyond)(c, count, n, s);
    EACH(i) {
        s->ok[i] = s->ok[i] == 1;
        s->a[i] = s->ok[i] ? s->a[i] : 0, s->b[i] = s->ok[i] ? s->b[i] : 0;
    }
    if (keeps)
        EACH(i) {
            s->x[i] = s->ok[i] ? s->x[i] : 0, s->y[i] = s->ok[i] ? s->y[i] : 0, s->z[i] = s->ok[i] ? s->z[i] : 1;
            s->scale[i] = s->ok[i] ? s->scale[i] : 1;
        }
    return waiting;
}

/* Points `s` to pixels, -1 where they are not `ok`. How many wait for limits */
static int T(pixels_of)(const T(Camera) *c, int count, int n, T(Seen) *s, R *restrict u, R *restrict v) {
    const int waiting = T(to_plane_block)(c, 0, count, n, s);
    const R fx = c->fx, fy = c->fy, cx = c->cx, cy = c->cy;
    if (c->is_radial) { /* most often */
        EACH(i) s->x[i] = s->a[i] * s->a[i] + s->b[i] * s->b[i];
        T(radial)(c->factors + 1, n, s->x, s->scale, NULL);
        EACH(i) s->x[i] = fx * (s->a[i] * s->scale[i]), s->y[i] = fy * (s->b[i] * s->scale[i]);
    } else if (c->stages) {
        T(lens)(c, 1, n, s->a, s->b, s->x, s->y, NULL, NULL);
        EACH(i) s->x[i] *= fx, s->y[i] *= fy;
    } else EACH(i) s->x[i] = fx * s->a[i], s->y[i] = fy * s->b[i];
    /* in a loop of its own, so that no processor does both at once: edges of images lie where round numbers put them */
    EACH(i) u[i] = s->ok[i] ? s->x[i] + cx : -1, v[i] = s->ok[i] ? s->y[i] + cy : -1;
    return waiting;
}

static int T(project)(const T(Camera) *c, const Rows *rows, int64_t camera, int64_t first, int count) {
    const int n = (count + LANES - 1) & -LANES;
    const int64_t *from = rows->row_strides, *to = rows->result_strides;
    const R *points = (const R *)rows->rows + camera * from[0] + first * from[1];
    R *pixels = (R *)rows->results + camera * to[0] + first * to[1];
    uint8_t *valid = rows->valid + camera * rows->count + first;
    T(Seen) s;
    ALIGNED R p[BLOCK], q[BLOCK];
    const int direct = T(is_plane)(to, count, n);
    R *u = direct ? pixels : p, *v = direct ? pixels + to[2] : q;
    T(load_points)(points, from, count, n, s.x, s.y, s.z);
    const int waiting = T(pixels_of)(c, count, n, &s, u, v);
    if (!direct) T(store)(pixels, to, 2, count, u, v, NULL);
    for (int i = 0; i < count; i++) valid[i] = (uint8_t)s.ok[i];
    return waiting;
}

static NOT_INLINE void T(to_plane_block_vjp)(const T(Camera) *c, int n, const R *restrict x, const R *restrict y,
                                const R *restrict z, const R *restrict shrink, const R *restrict scale,
                                const R *restrict by_angle, const R *restrict ga, const R *restrict gb, R *restrict gx,
                                R *restrict gy, R *restrict gz) {
    const T(Chart) k = c->chart;
    EACH_WAY(c->way, EACH(i) {
        R p, q, r;
        T(to_plane_vjp)(k, way, x[i], y[i], z[i], scale[i], way == INVERTED ? by_angle[i] : 1, ga[i], gb[i], &p, &q, &r);
        gx[i] = p * shrink[i], gy[i] = q * shrink[i], gz[i] = r * shrink[i];
    })
}

/* The cotangents of points and numbers of those of pixels; `sums`: of intrinsics, then of the parts. How many wait for
   limits */
static int T(project_vjp)(const T(Camera) *c, const Rows *rows, int64_t camera, int64_t first, int count, double *sums) {
    const int n = (count + LANES - 1) & -LANES;
    const int64_t *from = rows->row_strides, *to = rows->result_strides, *by = rows->cotangent_strides;
    const R *points = (const R *)rows->rows + camera * from[0] + first * from[1];
    const R *cotangents = (const R *)rows->cotangents + camera * by[0] + first * by[1];
    const R fx = c->fx, fy = c->fy;
    T(Seen) s;
    ALIGNED R gu[BLOCK], gv[BLOCK], gx[BLOCK], gy[BLOCK], gz[BLOCK], by_angle[BLOCK];
    T(load_points)(points, from, count, n, s.x, s.y, s.z);
    const int waiting = T(to_plane_block)(c, 1, count, n, &s);
    if (waiting) return waiting;
    const R *to_u = T(load)(cotangents, by[1], count, n, gx, 0);
    const R *to_v = T(load)(cotangents + by[2], by[1], count, n, gy, 0);
    EACH(i) {
        const R p = fx * to_u[i], q = fy * to_v[i];
        gu[i] = s.ok[i] ? p : 0, gv[i] = s.ok[i] ? q : 0;
    }
    if (sums) {
        const R *restrict u = s.a, *restrict v = s.b;
        if (c->stages) T(lens)(c, 1, n, s.a, s.b, gx, gy, NULL, NULL), u = gx, v = gy;
        sums[0] += T(dot)(n, gu, u) / fx, sums[1] += T(dot)(n, gv, v) / fy;
        sums[2] += T(total)(n, gu) / fx, sums[3] += T(total)(n, gv) / fy;
        sums += 4;
    }
    T(lens_vjp)(c, n, s.a, s.b, gu, gv, sums);
    if (c->way == INVERTED) {
        EACH(i) gx[i] = s.a[i] * s.a[i] + s.b[i] * s.b[i];
        T(radial)(c->factors, n, gx, gy, gz);
        EACH(i) by_angle[i] = 1 / (gy[i] + 2 * gx[i] * gz[i]);
    }
    if (sums) T(to_plane_sums)(c, n, s.x, s.y, s.z, s.scale, by_angle, gu, gv, sums);
    if (!rows->results) return 0;
    const int swapped = c->swapped;
    T(to_plane_block_vjp)(c, n, swapped ? s.y : s.x, swapped ? s.x : s.y, s.z, s.shrink, s.scale, by_angle, swapped ? gv : gu,
             swapped ? gu : gv, swapped ? gy : gx, swapped ? gx : gy, gz);
    T(store)((R *)rows->results + camera * to[0] + first * to[1], to, 3, count, gx, gy, gz);
    return 0;
}

/* -- pixels to rays */

/* An inverted chart's angles, as points of a plane on which the radius is the angle */
static void T(angles)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, R *restrict p, R *restrict q,
                      R *restrict factor, R *restrict slope) {
    ALIGNED R t[BLOCK];
    EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
    T(radial)(c->factors, n, t, factor, slope);
    EACH(i) p[i] = a[i] * factor[i], q[i] = b[i] * factor[i];
}

/* The unit rays of points of the plane, the axis where they are not `ok` */
static NOT_INLINE void T(rays_of)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b,
                                  const I *restrict ok, R *restrict x, R *restrict y, R *restrict z) {
    const T(Chart) k = c->chart;
    EACH_WAY(c->way, EACH(i) {
        R p, q, r;
        T(to_ray)(k, way, a[i], b[i], &p, &q, &r);
        x[i] = ok[i] ? p : 0, y[i] = ok[i] ? q : 0, z[i] = ok[i] ? r : 1;
    })
}

static void T(rays)(const T(Camera) *c, int n, const R *a, const R *b, const I *ok, R *x, R *y, R *z) {
    ALIGNED R p[BLOCK], q[BLOCK], factor[BLOCK];
    if (c->way == INVERTED) T(angles)(c, n, a, b, p, q, factor, NULL), a = p, b = q;
    if (c->swapped) T(rays_of)(c, n, b, a, ok, y, x, z);
    else T(rays_of)(c, n, a, b, ok, x, y, z);
}

static NOT_INLINE void T(unrays_of)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b,
                                    const R *restrict gx, const R *restrict gy, const R *restrict gz, R *restrict ga,
                                    R *restrict gb) {
    const T(Chart) k = c->chart;
    EACH_WAY(c->way, EACH(i) T(to_ray_vjp)(k, way, a[i], b[i], gx[i], gy[i], gz[i], ga + i, gb + i);)
}

/* The cotangents of points of the plane of those of their rays. Adds those of the chart's numbers */
static void T(rays_vjp)(const T(Camera) *c, int n, const R *a, const R *b, const R *gx, const R *gy, const R *gz,
                        R *ga, R *gb, double *sums) {
    if (c->way != INVERTED) {
        if (c->swapped) T(unrays_of)(c, n, b, a, gy, gx, gz, gb, ga);
        else T(unrays_of)(c, n, a, b, gx, gy, gz, ga, gb);
        if (sums) T(to_ray_sums)(c, n, a, b, gx, gy, gz, sums);
        return;
    }
    ALIGNED R p[BLOCK], q[BLOCK], t[BLOCK], factor[BLOCK], slope[BLOCK], gp[BLOCK], gq[BLOCK];
    T(angles)(c, n, a, b, p, q, factor, slope);
    T(unrays_of)(c, n, p, q, gx, gy, gz, gp, gq);
    EACH(i) {
        const R along = gp[i] * a[i] + gq[i] * b[i];
        t[i] = a[i] * a[i] + b[i] * b[i];
        ga[i] = gp[i] * factor[i] + a[i] * 2 * slope[i] * along, gb[i] = gq[i] * factor[i] + b[i] * 2 * slope[i] * along;
        gp[i] = along;
    }
    if (sums) T(radial_sums)(c->factors, n, t, gp, sums);
}

static NOT_INLINE void T(cover_of)(const T(Camera) *c, int n, R *restrict a, R *restrict b, const I *restrict known,
                                   I *restrict ok) {
    const T(Chart) k = c->chart;
    EACH_WAY(c->way, EACH(i) {
        const I is_on = known[i] & T(on_plane)(k, way, a[i], b[i]);
        ok[i] = is_on, a[i] = is_on ? a[i] : 0, b[i] = is_on ? b[i] : 0;
    })
}

/* Of points of the plane of an inverted chart that are `ok`, those whose ray it covers for certain; the centre elsewhere */
static void T(cover_inverted)(const T(Camera) *c, int n, R *restrict a, R *restrict b, I *restrict ok) {
    const R safe_radius_sq = c->chart_safe_radius_sq * (1 - 64 * EPS), limit = c->chart_most2 * (1 - 128 * EPS);
    const R before = limit < (R)(PI * PI) ? limit : (R)(PI * PI);
    ALIGNED R p[BLOCK], q[BLOCK], factor[BLOCK];
    EACH(i) {
        ok[i] &= safe_radius_sq - (a[i] * a[i] + b[i] * b[i]) > 0;
        a[i] = ok[i] ? a[i] : 0, b[i] = ok[i] ? b[i] : 0;
    }
    T(angles)(c, n, a, b, p, q, factor, NULL);
    EACH(i) {
        ok[i] &= before - (p[i] * p[i] + q[i] * q[i]) > 0;
        a[i] = ok[i] ? a[i] : 0, b[i] = ok[i] ? b[i] : 0;
    }
}

/* Of points of the plane, `ok` where they are known to be the image of a ray; the centre elsewhere */
static void T(cover)(const T(Camera) *c, int n, R *a, R *b, const I *known, I *ok) {
    T(cover_of)(c, n, c->swapped ? b : a, c->swapped ? a : b, known, ok);
    if (c->way == INVERTED) T(cover_inverted)(c, n, a, b, ok);
}

/* Points near those that the stages from `first` on send to (u, v) */
static void T(start)(const T(Camera) *c, int first, int n, const R *u, const R *v, R *restrict a, R *restrict b) {
    ALIGNED R x[BLOCK], y[BLOCK];
    EACH(i) a[i] = u[i], b[i] = v[i];
    for (int j = c->stages; j >= first; j--) {
        const R *k = c->numbers[j];
        if (c->parts[j].kind == HOMOGRAPHY) {
            R m[9];
            T(adjugate)(k, m);
            EACH(i) {
                const R p = a[i], q = b[i], one = 1 / (m[6] * p + m[7] * q + m[8]);
                a[i] = (m[0] * p + m[1] * q + m[2]) * one, b[i] = (m[3] * p + m[4] * q + m[5]) * one;
            }
        } else if (c->parts[j].kind == SHEAR) {
            const R area = 1 - k[0] * k[1];
            EACH(i) {
                const R p = (a[i] - k[1] * b[i]) / area;
                b[i] = (b[i] - k[0] * a[i]) / area, a[i] = p;
            }
        } else if (c->parts[j].kind == SURFACE) {
            const Part *part = c->parts + j;
            const R across = (R)(part->n - part->flags) / 2 / (R)part->cells[0], ca = (R)part->centre[0];
            const R down = (R)(part->m - part->flags) / 2 / (R)part->cells[1], cb = (R)part->centre[1];
            ALIGNED R p[BLOCK], q[BLOCK];
            EACH(i) p[i] = a[i], q[i] = b[i];
            for (int count = 0; count < 3; count++) { /* on the surface, behind which it may be anywhere */
                EACH(i) {
                    a[i] = T(inside)(ca - across, a[i], ca + across), b[i] = T(inside)(cb - down, b[i], cb + down);
                }
                T(stage)(c, j, n, a, b, x, y, NULL);
                EACH(i) a[i] += p[i] - x[i], b[i] += q[i] - y[i];
            }
        } else {
            T(stage)(c, j, n, a, b, x, y, NULL);
            EACH(i) a[i] = 2 * a[i] - x[i], b[i] = 2 * b[i] - y[i];
        }
    }
}

INLINE I T(step_of)(R *a, R *b, R du, R dv, R ua, R ub, R va, R vb, I ok) {
    R da, db;
    const R one = T(absolute)(T(step)(ua, ub, va, vb, du, dv, &da, &db)), p = *a + da, q = *b + db;
    const R left = EPS / 64 * (p * p + q * q + (R)0.01) - (da * da + db * db);
    *a = ok ? *a : p, *b = ok ? *b : q;
    return ok | ((left > 0) & (one > 0));
}

/* A step of Newton's method for the stages from `first` on, of points that are not `ok`: are they now? */
static void T(newton_step)(const T(Camera) *c, int first, int n, const R *restrict u, const R *restrict v,
                           R *restrict a, R *restrict b, I *restrict ok) {
    ALIGNED R x[BLOCK], y[BLOCK];
    if (first == c->stages && c->parts[first].kind == PLANAR) { /* most often */
        ALIGNED R t[BLOCK];
        const T(Plane) k = c->planes[first];
        EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
        T(radial)(c->factors + first, n, t, x, y);
        EACH(i) {
            R p, q, ua, ub, va, vb;
            T(planar_at)(k, a[i], b[i], x[i], &p, &q);
            T(planar_slopes)(k, a[i], b[i], x[i], y[i], &ua, &ub, &va, &vb);
            ok[i] = T(step_of)(a + i, b + i, u[i] - p, v[i] - q, ua, ub, va, vb, ok[i]);
        }
    } else {
        T(Jacobian) to;
        T(lens)(c, first, n, a, b, x, y, &to, NULL);
        EACH(i)
            ok[i] = T(step_of)(a + i, b + i, u[i] - x[i], v[i] - y[i], to.ua[i], to.ub[i], to.va[i], to.vb[i], ok[i]);
    }
}

/* Newton's method for the stages from `first` on, wherever that leads; `ok` where the next step would be nothing: `fewest`
   steps of all points, more of those alone that need them */
static void T(newton)(const T(Camera) *c, int first, int n, const R *restrict u, const R *restrict v, R *restrict a,
                      R *restrict b, I *restrict ok, int fewest) {
    for (int count = 0; count < fewest; count++) {
        EACH(i) ok[i] = 0;
        T(newton_step)(c, first, n, u, v, a, b, ok);
    }
    int places[BLOCK];
    const int some = T(chosen)(n, ok, places), filled = (some + LANES - 1) & -LANES;
    if (!some) return;
    ALIGNED R p[BLOCK], q[BLOCK], x[BLOCK], y[BLOCK];
    ALIGNED I found[BLOCK], any = 1;
    for (int i = 0; i < filled; i++) {
        const int at = places[i];
        p[i] = u[at], q[i] = v[at], x[i] = a[at], y[i] = b[at], found[i] = 0;
    }
    for (int count = fewest; count < MOST_STEPS && any; count++) {
        T(newton_step)(c, first, filled, p, q, x, y, found);
        any = 0;
        for (int i = 0; i < filled; i++) any |= !found[i];
    }
    for (int i = 0; i < some; i++) a[places[i]] = x[i], b[places[i]] = y[i], ok[places[i]] = found[i];
}

/* By the radial factor of the first stage alone: where it sends points to (p, q); `possible` within the fold's image */
static void T(invert_radial)(const T(Camera) *c, int n, const R *restrict p, const R *restrict q, R *restrict a,
                             R *restrict b, I *restrict ok, I *restrict possible) {
    const R most2 = c->table[1], reach2 = most2 * (1 + 8 * EPS);
    ALIGNED R r2[BLOCK], scale[BLOCK];
    EACH(i) {
        const R square = p[i] * p[i] + q[i] * q[i];
        possible[i] = reach2 - square > 0;
        /* what is beyond the fold would never settle */
        r2[i] = possible[i] ? square < most2 ? square : most2 : 0;
    }
    T(solve)(c->factors + 1, c->table, n, r2, scale, ok);
    /* a ray's rounding must not carry it across the fold */
    const R inside2 = c->safe_radius_sq * (1 - 32 * EPS);
    EACH(i) {
        a[i] = p[i] * scale[i], b[i] = q[i] * scale[i];
        ok[i] &= possible[i] & (inside2 - r2[i] * scale[i] * scale[i] > 0);
    }
}

/* See geometry_search.h */
static void T(contained)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, const R *restrict least,
                         I *restrict ok);
static void T(search)(const T(Camera) *c, int n, const R *restrict u, const R *restrict v, R *restrict a, R *restrict b,
                      I *restrict ok);

/* `invert`, from a table and a few steps; what is not `ok`, and yet possible, is left */
static void T(invert)(const T(Camera) *c, int n, const R *restrict u, const R *restrict v, R *restrict a, R *restrict b,
                      I *restrict ok, I *restrict possible) {
    const int fewest = IS_DOUBLE ? 3 : 2;
    ALIGNED R p[BLOCK], q[BLOCK];
    if (c->is_radial) {
        T(invert_radial)(c, n, u, v, a, b, ok, possible);
    } else if (c->by_stages) {
        ALIGNED R x[BLOCK], y[BLOCK];
        ALIGNED I known[BLOCK], within[BLOCK];
        const R image_circle_sq = c->image_circle_sq;
        EACH(i) {
            within[i] = image_circle_sq - (u[i] * u[i] + v[i] * v[i]) > 0;
            x[i] = within[i] ? u[i] : 0, y[i] = within[i] ? v[i] : 0;
        }
        T(start)(c, 2, n, x, y, p, q);
        T(newton)(c, 2, n, x, y, p, q, known, fewest - 1);
        T(invert_radial)(c, n, p, q, a, b, ok, possible);
        EACH(i) {
            ok[i] &= known[i] & within[i];
            possible[i] = within[i] & (possible[i] | !known[i]);
        }
    } else {
        const int has_table = c->table != NULL;
        const R image_radius_sq = c->image_radius_sq * (1 - 32 * EPS), further = 1 + 32 * EPS;
        T(start)(c, has_table ? 2 : 1, n, u, v, a, b);
        if (has_table) {
            ALIGNED R r2[BLOCK], scale[BLOCK];
            EACH(i) r2[i] = a[i] * a[i] + b[i] * b[i] < INFINITY ? a[i] * a[i] + b[i] * b[i] : 0;
            T(tabulated)(c->table, n, r2, scale);
            EACH(i) a[i] *= scale[i], b[i] *= scale[i];
        }
        T(newton)(c, 1, n, u, v, a, b, ok, fewest);
        I outside = 0;
        EACH(i) possible[i] = ok[i]; /* converged, somewhere */
        EACH(i) ok[i] &= image_radius_sq - (a[i] * a[i] + b[i] * b[i]) > 0;
        EACH(i) outside |= possible[i] & !ok[i];
        if (outside && c->ends && c->limits2) { /* no circle: much of an image lies beyond any within its edge */
            ALIGNED R x[BLOCK], y[BLOCK], least[BLOCK];
            ALIGNED I inside[BLOCK];
            T(Jacobian) to;
            int places[BLOCK];
            EACH(i) inside[i] = ok[i] | !possible[i];
            const int some = T(chosen)(n, inside, places), filled = (some + LANES - 1) & -LANES;
            for (int i = 0; i < filled; i++) p[i] = a[places[i]] * further, q[i] = b[places[i]] * further;
            T(lens)(c, 1, filled, p, q, x, y, &to, least);
            T(contained)(c, filled, p, q, least, inside);
            for (int i = 0; i < some; i++) ok[places[i]] = inside[i];
        }
        EACH(i) possible[i] = 1;
    }
}

/* Pixels (u, v) to points (u, v) of the chart's plane and rays, the axis where there is none. `known` are numbers to
   calculate with; where one is not `ok`, a lens that `waits` for its extent leaves open whether it has a ray */
static void T(solutions)(const T(Camera) *c, int n, R *restrict u, R *restrict v, I *restrict known, I *restrict ok,
                         R *x, R *y, R *z) {
    ALIGNED R a[BLOCK], b[BLOCK];
    ALIGNED I possible[BLOCK];
    const R by_fx = 1 / c->fx, by_fy = 1 / c->fy, cx = c->cx, cy = c->cy;
    const I usable = c->usable;
    EACH(i) {
        const R p = (u[i] - cx) * by_fx, q = (v[i] - cy) * by_fy;
        known[i] = (T(absolute)(p) < SQUARABLE) & (T(absolute)(q) < SQUARABLE) & usable;
        u[i] = known[i] ? p : 0, v[i] = known[i] ? q : 0;
    }
    if (c->stages) {
        T(invert)(c, n, u, v, a, b, ok, possible);
        int places[BLOCK], some;
        EACH(i) possible[i] = (possible[i] == 0) | ok[i] | (known[i] == 0); /* what is settled */
        if (c->follows && c->extent) {
            const R *furthest = c->extent + RADII + AZIMUTHS * RADII;
            for (int i = 0; i < n; i++)
                if (!possible[i]) possible[i] = T(root)(u[i] * u[i] + v[i] * v[i]) > furthest[T(azimuth)(u[i], v[i], 0)];
        }
        if ((!c->follows || c->extent) && (some = T(chosen)(n, possible, places))) {
            ALIGNED R p[BLOCK], q[BLOCK], found_a[BLOCK], found_b[BLOCK];
            ALIGNED I found[BLOCK];
            const int filled = (some + LANES - 1) & -LANES;
            for (int i = 0; i < filled; i++) p[i] = u[places[i]], q[i] = v[places[i]];
            T(search)(c, filled, p, q, found_a, found_b, found);
            for (int i = 0; i < some; i++)
                a[places[i]] = found_a[i], b[places[i]] = found_b[i], ok[places[i]] = found[i];
        }
        EACH(i) {
            ok[i] &= known[i];
            u[i] = ok[i] ? a[i] : 0, v[i] = ok[i] ? b[i] : 0;
        }
        if (c->way == INVERTED) T(cover_inverted)(c, n, u, v, ok);
    } else T(cover)(c, n, u, v, known, ok);
    T(rays)(c, n, u, v, ok, x, y, z);
}

/* Pixels of a row to rays; how many wait for an extent */
static int T(unproject)(const T(Camera) *c, const Rows *rows, int64_t camera, int64_t first, int count) {
    const int n = (count + LANES - 1) & -LANES;
    const int64_t *from = rows->row_strides, *to = rows->result_strides;
    const R *pixels = (const R *)rows->rows + camera * from[0] + first * from[1];
    R *rays = (R *)rows->results + camera * to[0] + first * to[1];
    uint8_t *valid = rows->valid + camera * rows->count + first;
    ALIGNED R u[BLOCK], v[BLOCK], x[BLOCK], y[BLOCK], z[BLOCK];
    ALIGNED I ok[BLOCK], known[BLOCK];
    int left = 0;
    const int direct = T(is_plane)(to, count, n);
    R *p = direct ? rays : x, *q = direct ? rays + to[2] : y, *r = direct ? rays + 2 * to[2] : z;
    T(load_pixels)(pixels, from, count, n, u, v, c->cx, c->cy);
    T(solutions)(c, n, u, v, known, ok, p, q, r);
    if (!direct) T(store)(rays, to, 3, count, p, q, r);
    for (int i = 0; i < count; i++) valid[i] = (uint8_t)ok[i];
    if (c->waits)
        for (int i = 0; i < count; i++) left += !ok[i] & (known[i] != 0);
    if (rows->solution) {
        const int64_t planes[3] = {0, 1, rows->cameras->cameras * rows->count};
        T(store)((R *)rows->solution + camera * rows->count + first, planes, 2, count, u, v, NULL);
    }
    return left;
}

/* The cotangents of pixels and numbers of those of rays, of solutions that are known */
static void T(unproject_vjp)(const T(Camera) *c, const Rows *rows, int64_t camera, int64_t first, int count,
                             double *sums) {
    const int n = (count + LANES - 1) & -LANES;
    const int64_t *to = rows->result_strides, *by = rows->cotangent_strides;
    const R *cotangents = (const R *)rows->cotangents + camera * by[0] + first * by[1];
    const R *solution = (const R *)rows->solution + camera * rows->count + first;
    const uint8_t *valid = rows->valid + camera * rows->count + first;
    ALIGNED R p[BLOCK], q[BLOCK], gx[BLOCK], gy[BLOCK], gz[BLOCK], ga[BLOCK], gb[BLOCK], x[BLOCK], y[BLOCK], z[BLOCK];
    const R *a = T(load)(solution, 1, count, n, p, 0), *u = a;
    const R *b = T(load)(solution + rows->cameras->cameras * rows->count, 1, count, n, q, 0), *v = b;
    const R *to_x = T(load)(cotangents, by[1], count, n, x, 0);
    const R *to_y = T(load)(cotangents + by[2], by[1], count, n, y, 0);
    const R *to_z = T(load)(cotangents + 2 * by[2], by[1], count, n, z, 0);
    for (int i = 0; i < count; i++) {
        const int is_known = valid[i] != 0;
        gx[i] = is_known ? to_x[i] : 0, gy[i] = is_known ? to_y[i] : 0, gz[i] = is_known ? to_z[i] : 0;
    }
    for (int i = count; i < n; i++) gx[i] = gy[i] = gz[i] = 0;
    T(rays_vjp)(c, n, a, b, gx, gy, gz, ga, gb, sums ? sums + 4 : NULL);
    if (c->stages) {
        T(Jacobian) jacobian;
        T(lens)(c, 1, n, a, b, x, y, &jacobian, NULL), u = x, v = y;
        EACH(i) {
            R da, db;
            T(step)(jacobian.ua[i], jacobian.va[i], jacobian.ub[i], jacobian.vb[i], ga[i], gb[i], &da, &db);
            ga[i] = da, gb[i] = db;
            gx[i] = -da, gy[i] = -db;
        }
        if (sums) T(lens_vjp)(c, n, a, b, gx, gy, sums + 4);
    }
    const R by_fx = 1 / c->fx, by_fy = 1 / c->fy;
    EACH(i) ga[i] *= by_fx, gb[i] *= by_fy;
    if (sums) {
        sums[0] -= T(dot)(n, ga, u), sums[1] -= T(dot)(n, gb, v);
        sums[2] -= T(total)(n, ga), sums[3] -= T(total)(n, gb);
    }
    if (rows->results) T(store)((R *)rows->results + camera * to[0] + first * to[1], to, 2, count, ga, gb, NULL);
}

static int64_t T(rows)(const Rows *rows) {
    const int64_t tiles = (rows->count + rows->tile - 1) / rows->tile, width = 4 + rows->cameras->parameter_count;
    int64_t left = 0, last = -1, own = 0, at;
    T(Camera) camera;
    while ((at = taken(rows->next, &own)) < tiles * rows->cameras->cameras) {
        const int64_t index = at / tiles, first = at % tiles * rows->tile;
        const int64_t end = first + rows->tile < rows->count ? first + rows->tile : rows->count;
        double *sums = rows->sums ? rows->sums + at * width : NULL;
        if (index != last) T(prepare)(rows->cameras, last = index, &camera);
        for (int64_t i = first; i < end; i += BLOCK) {
            const int count = (int)(end - i < BLOCK ? end - i : BLOCK);
            switch (rows->direction) {
            case PROJECT: left += T(project)(&camera, rows, index, i, count); break;
            case UNPROJECT: left += T(unproject)(&camera, rows, index, i, count); break;
            case PROJECT_VJP: left += T(project_vjp)(&camera, rows, index, i, count, sums); break;
            default: T(unproject_vjp)(&camera, rows, index, i, count, sums);
            }
        }
    }
    return left;
}
