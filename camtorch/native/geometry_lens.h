/* Lenses: stages on a chart's plane, radial factors, and their inverse; optics/lens.py, radial.py, radial_inverse.py. */

/* -- radial factors: a point m goes to m R(t), t = |m|^2 */

/* 1 + k0 t + k1 t^2 + ... and, if wanted, its derivative */
INLINE R T(horner)(const R *k, const int count, R t, R *slope) {
    R value = k[count - 1], by_t = 0;
    for (int j = count - 2; j >= 0; j--) by_t = by_t * t + value, value = value * t + k[j];
    if (slope) *slope = by_t * t + value;
    return value * t + 1;
}

/* A factor of n numbers, or n + m; and, if wanted, its slope */
INLINE R T(factor)(const R *k, const int kind, const int n, const int m, R t, R *slope) {
    if (kind == POLYNOMIAL) return T(horner)(k, n, t, slope);
    if (kind == RATIONAL) {
        R bend = 0;
        const R above = T(horner)(k, n, t, slope), one = 1 / T(horner)(k + n, m, t, slope ? &bend : NULL);
        if (slope) *slope = (*slope - above * one * bend) * one;
        return above * one;
    }
    const R radius = T(root)(t + FLOOR), place = kind == ANGLE_PER_RADIUS ? t : radius;
    R value = T(horner)(k, n, place, slope);
    if (slope && kind != ANGLE_PER_RADIUS) *slope /= 2 * radius;
    if (kind == RADIUS_POLYNOMIAL) return value;
    const R ahead = value; /* of the ray (radius, 0, ahead) */
    value = T(angle)(radius, ahead, radius);
    if (slope) *slope = ((ahead - 2 * t * *slope) / (t + ahead * ahead) - value) / (2 * t + FLOOR);
    return value;
}

static T(Factor) T(prepare_factor)(const Part *part, const R *numbers, const R *constants) {
    static const int forms[] = {ANY, FEW, RATIO, ROOTS, ANGLES, ALL, ANY};
    T(Factor) made = {part, numbers, constants, ANY, {0}};
    const int many = part->factor == RATIONAL ? PADDED / 2 : PADDED;
    if (part->n <= many && part->m <= many) made.form = forms[part->factor];
    if (made.form == FEW && part->n > PADDED / 2) made.form = SOME;
    if (made.form != ANY) {
        memcpy(made.padded, numbers, (size_t)part->n * sizeof(R));
        if (part->m) memcpy(made.padded + PADDED / 2, numbers + part->n, (size_t)part->m * sizeof(R));
    }
    return made;
}

/* Of a table: the radius, 1 or -1 behind the end, the piece, and how far from its node the place is */
static void T(pieces)(const Part *part, const R *nodes, int n, const R *restrict t, R *restrict radius, R *restrict side,
                      I *restrict piece, R *restrict offset) {
    const R end = nodes[part->n];
    const I last = part->n - 1;
    int step = 1;
    while (step <= last) step *= 2;
    EACH(i) {
        radius[i] = T(root)(t[i] + FLOOR);
        side[i] = radius[i] > end ? -1 : 1;
        /* behind its last node the table turns back */
        const R mirrored = 2 * end - radius[i] > 0 ? 2 * end - radius[i] : 0;
        offset[i] = radius[i] > end ? mirrored : radius[i], piece[i] = 0;
    }
    if (last < 32) /* to count them is faster than to read here and there */
        for (int j = 1; j <= last; j++) {
            const R node = nodes[j];
            EACH(i) piece[i] += node <= offset[i];
        }
    else for (; step; step /= 2)
        EACH(i) {
            const I next = piece[i] + step, at = next < last ? next : last;
            piece[i] = ((next <= last) & (nodes[at] <= offset[i])) ? next : piece[i];
        }
    EACH(i) offset[i] -= nodes[piece[i]];
}

INLINE void T(table_factor)(const Part *part, const R *k, const R *nodes, int n, const R *restrict t,
                            R *restrict factor, R *restrict slope) {
    ALIGNED R radius[BLOCK], side[BLOCK], offset[BLOCK];
    ALIGNED I piece[BLOCK];
    const int count = part->n;
    T(pieces)(part, nodes, n, t, radius, side, piece, offset);
    EACH(i) {
        const I p = piece[i];
        const R first = k[count + p], second = k[2 * count + p], third = k[3 * count + p], one = 1 / radius[i];
        /* on the first piece neither division nor root has a part in the derivatives of the outer terms */
        const int central = (p == 0) & (side[i] > 0);
        const R share = central ? 1 : offset[i] * one, square = central ? t[i] : offset[i] * offset[i];
        factor[i] = k[p] * one + share * (first + offset[i] * second + square * third);
        if (slope) {
            const R by_place = first + offset[i] * (2 * second + 3 * offset[i] * third);
            slope[i] = (side[i] * by_place - factor[i]) * one * one / 2;
        }
    }
}

static void T(radial)(const T(Factor) *of, int n, const R *restrict t, R *restrict factor, R *restrict slope) {
    const Part *part = of->part;
    const R *k = of->numbers;
    if (part->factor == NO_FACTOR) {
        EACH(i) factor[i] = 1;
        if (slope) EACH(i) slope[i] = 0;
    } else if (part->factor == RADIUS_TABLE) {
        if (slope) T(table_factor)(part, k, of->constants, n, t, factor, slope);
        else T(table_factor)(part, k, of->constants, n, t, factor, NULL);
    } else if (of->form == ANY) { /* one by one */
        EACH(i) factor[i] = T(factor)(k, part->factor, part->n, part->m, t[i], slope ? slope + i : NULL);
    } else {
        R padded[PADDED];
        memcpy(padded, of->padded, sizeof padded);
        if (slope) EACH_FORM(of->form, EACH(i) factor[i] = T(factor)(padded, kind, count, below, t[i], slope + i);)
        else EACH_FORM(of->form, EACH(i) factor[i] = T(factor)(padded, kind, count, below, t[i], NULL);)
    }
}

/* The sums of weight t, weight t^2, ...; weights change */
static void T(powers)(int count, int n, const R *restrict t, R *restrict weight, double *sums) {
    for (int j = 0; j < count; j++) {
        EACH(i) weight[i] *= t[i];
        sums[j] += T(total)(n, weight);
    }
}

/* Adds the sums over the points of dR/dk weight, for each number k */
static void T(radial_sums)(const T(Factor) *of, int n, const R *restrict t, const R *restrict weight, double *sums) {
    const Part *part = of->part;
    const R *k = of->numbers;
    ALIGNED R w[BLOCK], other[BLOCK], more[BLOCK];
    EACH(i) w[i] = weight[i], other[i] = part->factor == POLYNOMIAL ? 0 : T(root)(t[i] + FLOOR);
    switch (part->factor) {
    case POLYNOMIAL:
        T(powers)(part->n, n, t, w, sums);
        break;
    case RATIONAL:
        EACH(i) {
            const R one = 1 / T(horner)(k + part->n, part->m, t[i], NULL);
            w[i] *= one, other[i] = -w[i] * one * T(horner)(k, part->n, t[i], NULL);
        }
        T(powers)(part->n, n, t, w, sums);
        T(powers)(part->m, n, t, other, sums + part->n);
        break;
    case RADIUS_POLYNOMIAL:
        T(powers)(part->n, n, other, w, sums);
        break;
    case ANGLE_PER_RADIUS:
    case ANGLE_OF_ALL_POWERS:
        EACH(i) {
            const R ahead = T(horner)(k, part->n, part->factor == ANGLE_PER_RADIUS ? t[i] : other[i], NULL);
            w[i] /= -(t[i] + ahead * ahead);
        }
        T(powers)(part->n, n, part->factor == ANGLE_PER_RADIUS ? t : other, w, sums);
        break;
    case RADIUS_TABLE: {
        ALIGNED R side[BLOCK];
        ALIGNED I piece[BLOCK];
        T(pieces)(part, of->constants, n, t, other, side, piece, more);
        EACH(i) w[i] /= other[i];
        for (int q = 0; q < 4; q++) {
            for (int i = 0; i < n; i++) sums[q * part->n + piece[i]] += w[i];
            EACH(i) w[i] *= more[i];
        }
        break;
    }
    }
}

/* -- stages */

typedef struct {
    ALIGNED R ua[BLOCK], ub[BLOCK], va[BLOCK], vb[BLOCK]; /* du/da, du/db, dv/da, dv/db */
} T(Jacobian);

/* Where a planar stage of that factor sends a point: m R(t) + (p t + 2 m (p . m)) + (s0 t + s1 t^2, s2 t + s3 t^2) */
INLINE void T(planar_at)(const T(Plane) k, R a, R b, R factor, R *u, R *v) {
    const R t = a * a + b * b, scale = factor + 2 * (k.px * a + k.py * b);
    *u = a * scale + (k.px + k.s0 + k.s1 * t) * t, *v = b * scale + (k.py + k.s2 + k.s3 * t) * t;
}

INLINE void T(planar_slopes)(const T(Plane) k, R a, R b, R factor, R slope, R *ua, R *ub, R *va, R *vb) {
    const R t = a * a + b * b, scale = factor + 2 * (k.px * a + k.py * b), twice = 2 * slope;
    const R across = twice * a * b + 2 * (k.px * b + k.py * a);
    const R gu = 2 * k.s0 + 4 * k.s1 * t, gv = 2 * k.s2 + 4 * k.s3 * t;
    *ua = scale + twice * a * a + 4 * k.px * a + gu * a, *ub = across + gu * b;
    *vb = scale + twice * b * b + 4 * k.py * b + gv * b, *va = across + gv * a;
}

static void T(planar)(const T(Camera) *c, int j, int n, const R *restrict a, const R *restrict b, R *restrict u,
                      R *restrict v, T(Jacobian) *restrict to) {
    ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK];
    const T(Plane) k = c->planes[j];
    EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
    T(radial)(c->factors + j, n, t, factor, to ? slope : NULL);
    EACH(i) T(planar_at)(k, a[i], b[i], factor[i], u + i, v + i);
    if (to)
        EACH(i) T(planar_slopes)(k, a[i], b[i], factor[i], slope[i], to->ua + i, to->ub + i, to->va + i, to->vb + i);
}

static void T(planar_vjp)(const T(Camera) *c, int j, int n, const R *restrict a, const R *restrict b, R *restrict gu,
                          R *restrict gv, double *sums) {
    ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK], along[BLOCK], even_u[BLOCK], even_v[BLOCK];
    const Part *part = c->parts + j;
    const T(Plane) k = c->planes[j];
    EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
    T(radial)(c->factors + j, n, t, factor, slope);
    EACH(i) {
        const R scale = factor[i] + 2 * (k.px * a[i] + k.py * b[i]), w = gu[i] * a[i] + gv[i] * b[i];
        const R out = 2 * (w * slope[i] + gu[i] * (k.px + k.s0 + 2 * k.s1 * t[i]) + gv[i] * (k.py + k.s2 + 2 * k.s3 * t[i]));
        along[i] = w, even_u[i] = gu[i] * t[i], even_v[i] = gv[i] * t[i];
        gu[i] = gu[i] * scale + 2 * w * k.px + a[i] * out, gv[i] = gv[i] * scale + 2 * w * k.py + b[i] * out;
    }
    if (!sums) return;
    if (part->factor != NO_FACTOR) T(radial_sums)(c->factors + j, n, t, along, sums);
    sums += part->factor == RADIUS_TABLE ? 4 * part->n : part->n + part->m;
    if (part->flags & TANGENTIAL) {
        *sums++ += T(total)(n, even_u) + 2 * T(dot)(n, along, a);
        *sums++ += T(total)(n, even_v) + 2 * T(dot)(n, along, b);
    }
    if (part->flags & PRISM) {
        sums[0] += T(total)(n, even_u), sums[1] += T(dot)(n, even_u, t);
        sums[2] += T(total)(n, even_v), sums[3] += T(dot)(n, even_v, t);
    }
}

/* The projective map of a matrix k, row by row */
static void T(homography)(const R *k, int n, const R *restrict a, const R *restrict b, R *restrict u, R *restrict v,
                          T(Jacobian) *restrict to) {
    EACH(i) {
        const R one = 1 / (k[6] * a[i] + k[7] * b[i] + k[8]);
        const R x = one * (k[0] * a[i] + k[1] * b[i] + k[2]), y = one * (k[3] * a[i] + k[4] * b[i] + k[5]);
        u[i] = x, v[i] = y;
        if (to) {
            to->ua[i] = (k[0] - x * k[6]) * one, to->ub[i] = (k[1] - x * k[7]) * one;
            to->va[i] = (k[3] - y * k[6]) * one, to->vb[i] = (k[4] - y * k[7]) * one;
        }
    }
}

static void T(homography_vjp)(const R *k, int n, const R *restrict a, const R *restrict b, R *restrict gu,
                              R *restrict gv, double *sums) {
    ALIGNED R rows[3][BLOCK];
    EACH(i) {
        const R one = 1 / (k[6] * a[i] + k[7] * b[i] + k[8]);
        const R x = one * (k[0] * a[i] + k[1] * b[i] + k[2]), y = one * (k[3] * a[i] + k[4] * b[i] + k[5]);
        const R p = gu[i] * one, q = gv[i] * one, w = -(p * x + q * y);
        gu[i] = p * k[0] + q * k[3] + w * k[6], gv[i] = p * k[1] + q * k[4] + w * k[7];
        rows[0][i] = p, rows[1][i] = q, rows[2][i] = w;
    }
    for (int j = 0; sums && j < 3; j++) {
        sums[3 * j] += T(dot)(n, rows[j], a), sums[3 * j + 1] += T(dot)(n, rows[j], b);
        sums[3 * j + 2] += T(total)(n, rows[j]);
    }
}

/* The inverse matrix times the determinant */
INLINE void T(adjugate)(const R *k, R *m) {
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const int p = (j + 1) % 3, q = (j + 2) % 3, r = (i + 1) % 3, s = (i + 2) % 3;
            m[3 * i + j] = k[3 * p + r] * k[3 * q + s] - k[3 * p + s] * k[3 * q + r];
        }
}

/* Along one axis of a surface: the weights of the order + 1 control points that have a part in a point, by how much these
   change from cell to cell, and the first of the points. w: the place in cells, from the first control point on */
INLINE int64_t T(spline)(const int order, int size, R w, R *restrict weight, R *restrict slope) {
    const R last = (R)(size - order);
    R cell = T(whole)(order == 3 ? w : w + (R)0.5);
    cell = cell > 1 ? cell : 1, cell = cell < last ? cell : last;
    const R x = w - cell, xx = x * x, y = 1 - x;
    if (order == 3) {
        weight[0] = y * y * y / 6, weight[1] = (x / 2 - 1) * xx + (R)(2 / 3.0);
        weight[2] = ((1 - x) * x + 1) * x / 2 + (R)(1 / 6.0), weight[3] = xx * x / 6;
        slope[0] = -y * y / 2, slope[1] = ((R)1.5 * x - 2) * x;
        slope[2] = (R)0.5 + (1 - (R)1.5 * x) * x, slope[3] = xx / 2;
    } else {
        weight[0] = (xx - x) / 2 + (R)0.125, weight[1] = (R)0.75 - xx, weight[2] = (xx + x) / 2 + (R)0.125;
        slope[0] = x - (R)0.5, slope[1] = -2 * x, slope[2] = x + (R)0.5;
    }
    return (int64_t)cell - 1;
}

/* The weights and slopes of a point of a surface along both axes; where in the surface its control points begin */
INLINE int64_t T(patch)(const Part *part, const int order, R a, R b, R (*restrict weight)[4], R (*restrict slope)[4]) {
    const R across = (a - (R)part->centre[0]) * (R)part->cells[0] + (R)(part->n - 1) / 2;
    const R down = (b - (R)part->centre[1]) * (R)part->cells[1] + (R)(part->m - 1) / 2;
    const int64_t column = T(spline)(order, part->n, across, weight[0], slope[0]);
    return 2 * (T(spline)(order, part->m, down, weight[1], slope[1]) * part->n + column);
}

/* Of du and dv of rows of control points, weighted by row, what the weights of columns make of both */
INLINE void T(across)(const int order, const R *restrict line, const R *restrict weight, R *restrict sum) {
    R made[8];
    for (int j = 0; j < 2 * (order + 1); j++) made[j] = line[j] * weight[j / 2];
    for (int axis = 0; axis < 2; axis++)
        sum[axis] = (made[axis] + made[2 + axis]) + (order == 3 ? made[4 + axis] + made[6 + axis] : made[4 + axis]);
}

INLINE void T(surface_of)(const Part *part, const R *k, const int order, int n, const R *restrict a, const R *restrict b,
                          R *restrict u, R *restrict v, T(Jacobian) *restrict to) {
    const int width = 2 * (order + 1);
    const R sa = (R)part->cells[0], sb = (R)part->cells[1];
    const int64_t row = 2 * (int64_t)part->n;
    for (int i = 0; i < n; i++) {
        R weight[2][4] = {{0}}, slope[2][4] = {{0}}, line[8], sum[2];
        const R *restrict at = k + T(patch)(part, order, a[i], b[i], weight, slope), *restrict last = order == 3 ? at + 3 * row : at;
        for (int j = 0; j < width; j++)
            line[j] = (weight[1][0] * at[j] + weight[1][1] * at[row + j]) + (weight[1][2] * at[2 * row + j] + weight[1][3] * last[j]);
        T(across)(order, line, weight[0], sum);
        u[i] = a[i] + sum[0], v[i] = b[i] + sum[1];
        if (!to) continue;
        T(across)(order, line, slope[0], sum);
        to->ua[i] = 1 + sum[0] * sa, to->va[i] = sum[1] * sa;
        for (int j = 0; j < width; j++)
            line[j] = (slope[1][0] * at[j] + slope[1][1] * at[row + j]) + (slope[1][2] * at[2 * row + j] + slope[1][3] * last[j]);
        T(across)(order, line, weight[0], sum);
        to->ub[i] = sum[0] * sb, to->vb[i] = 1 + sum[1] * sb;
    }
}

static NOT_INLINE void T(surface)(const Part *part, const R *k, int n, const R *restrict a, const R *restrict b,
                                  R *restrict u, R *restrict v, T(Jacobian) *restrict to) {
    if (part->flags == 3 && to) T(surface_of)(part, k, 3, n, a, b, u, v, to);
    else if (part->flags == 3) T(surface_of)(part, k, 3, n, a, b, u, v, NULL);
    else T(surface_of)(part, k, 2, n, a, b, u, v, to);
}

static void T(surface_vjp)(const Part *part, const R *k, int n, const R *restrict a, const R *restrict b,
                           R *restrict gu, R *restrict gv, double *sums) {
    ALIGNED R u[BLOCK], v[BLOCK];
    T(Jacobian) to;
    T(surface)(part, k, n, a, b, u, v, &to);
    for (int i = 0; sums && i < n; i++) {
        R weight[2][4], slope[2][4];
        double *at = sums + T(patch)(part, part->flags, a[i], b[i], weight, slope);
        for (int q = 0; q <= part->flags; q++, at += 2 * part->n)
            for (int p = 0; p <= part->flags; p++) {
                const R w = weight[1][q] * weight[0][p];
                at[2 * p] += w * gu[i], at[2 * p + 1] += w * gv[i];
            }
    }
    EACH(i) {
        const R along = gu[i] * to.ua[i] + gv[i] * to.va[i];
        gv[i] = gu[i] * to.ub[i] + gv[i] * to.vb[i], gu[i] = along;
    }
}

/* In cells, positive up to the edge of a surface and so many behind */
INLINE R T(surface_edge)(const Part *part, R a, R b) {
    const R behind = (R)part->constant, p = (a - (R)part->centre[0]) * (R)part->cells[0];
    const R q = (b - (R)part->centre[1]) * (R)part->cells[1];
    const R across = (R)(part->n - part->flags) / 2 + behind - T(absolute)(p);
    const R down = (R)(part->m - part->flags) / 2 + behind - T(absolute)(q);
    return across < down ? across : across == across ? down : -1;
}

static void T(stage)(const T(Camera) *c, int stage, int n, const R *a, const R *b, R *u, R *v, T(Jacobian) *to) {
    const Part *part = c->parts + stage;
    const R *k = c->numbers[stage];
    if (part->kind == HOMOGRAPHY) T(homography)(k, n, a, b, u, v, to);
    else if (part->kind == SHEAR) {
        EACH(i) u[i] = a[i] + k[1] * b[i], v[i] = b[i] + k[0] * a[i];
        if (to) EACH(i) to->ua[i] = to->vb[i] = 1, to->ub[i] = k[1], to->va[i] = k[0];
    } else if (part->kind == SURFACE) T(surface)(part, k, n, a, b, u, v, to);
    else T(planar)(c, stage, n, a, b, u, v, to);
}

/* Where the stages from `first` on send points, not in place; the Jacobian of all of them; if wanted, `least`: positive
   where each is defined, regular and not turned over */
static void T(lens)(const T(Camera) *c, int first, int n, const R *a, const R *b, R *u, R *v, T(Jacobian) *to,
                    R *least) {
    ALIGNED R x[BLOCK], y[BLOCK], p[BLOCK], q[BLOCK];
    T(Jacobian) here;
    if (first == c->stages && !least) {
        T(stage)(c, first, n, a, b, u, v, to);
        return;
    }
    EACH(i) x[i] = a[i], y[i] = b[i];
    for (int j = first; j <= c->stages; j++) {
        T(Jacobian) *made = !to ? NULL : j == first ? to : &here;
        T(stage)(c, j, n, x, y, p, q, made);
        if (least) {
            const R *k = c->numbers[j];
            ALIGNED R margin[BLOCK];
            if (c->parts[j].kind == HOMOGRAPHY) EACH(i) margin[i] = k[6] * x[i] + k[7] * y[i] + k[8];
            else if (c->parts[j].factor == RATIONAL) {
                EACH(i) margin[i] = T(horner)(k + c->parts[j].n, c->parts[j].m, x[i] * x[i] + y[i] * y[i], NULL);
            } else if (c->parts[j].kind == SURFACE && c->ends) {
                EACH(i) margin[i] = T(surface_edge)(c->parts + j, x[i], y[i]);
            } else EACH(i) margin[i] = INFINITY;
            EACH(i) {
                /* a turn by half a circle has a positive determinant too: the trace tells it */
                const R trace = made->ua[i] + made->vb[i], area = made->ua[i] * made->vb[i] - made->ub[i] * made->va[i];
                R w = trace < area ? trace : area;
                w = margin[i] < w ? margin[i] : w, w = ((trace == trace) & (margin[i] == margin[i])) ? w : -1;
                w = w == w ? w : -1;
                least[i] = j == first || w < least[i] ? w : least[i];
            }
        }
        if (to && j > first)
            EACH(i) {
                const R ua = to->ua[i], ub = to->ub[i], va = to->va[i], vb = to->vb[i];
                to->ua[i] = here.ua[i] * ua + here.ub[i] * va, to->ub[i] = here.ua[i] * ub + here.ub[i] * vb;
                to->va[i] = here.va[i] * ua + here.vb[i] * va, to->vb[i] = here.va[i] * ub + here.vb[i] * vb;
            }
        EACH(i) x[i] = p[i], y[i] = q[i];
    }
    EACH(i) u[i] = x[i], v[i] = y[i];
}

/* The cotangents of points and numbers of those of where the lens sends them, in place */
static void T(lens_vjp)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, R *gu, R *gv, double *sums) {
    ALIGNED R x[MOST_PARTS][BLOCK], y[MOST_PARTS][BLOCK];
    EACH(i) x[0][i] = a[i], y[0][i] = b[i];
    for (int j = 1; j < c->stages; j++) T(stage)(c, j, n, x[j - 1], y[j - 1], x[j], y[j], NULL);
    for (int j = c->stages; j >= 1; j--) {
        const R *k = c->numbers[j];
        double *part = sums ? sums + (k - c->numbers[0]) : NULL;
        if (c->parts[j].kind == HOMOGRAPHY) T(homography_vjp)(k, n, x[j - 1], y[j - 1], gu, gv, part);
        else if (c->parts[j].kind == SHEAR) {
            if (part) part[0] += T(dot)(n, gv, x[j - 1]), part[1] += T(dot)(n, gu, y[j - 1]);
            EACH(i) {
                const R w = gu[i] + k[0] * gv[i];
                gv[i] += k[1] * gu[i], gu[i] = w;
            }
        } else if (c->parts[j].kind == SURFACE) T(surface_vjp)(c->parts + j, k, n, x[j - 1], y[j - 1], gu, gv, part);
        else T(planar_vjp)(c, j, n, x[j - 1], y[j - 1], gu, gv, part);
    }
}

/* -- the inverse of a radial factor */

/* The factor by which it scales points of squared radius r2, to about 1e-6; `InverseTable` */
static void T(tabulated)(const R *restrict table, int n, const R *restrict r2, R *restrict scale) {
    const R reach2 = table[0], top = (reach2 + 2) / reach2, *restrict values = table + 2, *restrict steps = values + NODES;
    ALIGNED int32_t node[BLOCK];
    EACH(i) {
        const R left = 1 - r2[i] / (r2[i] + 2) * top, position = (1 - T(root)(left > 0 ? left : 0)) * NODES;
        const R place = position >= 0 ? position : 0; /* nor what is not a number */
        node[i] = place < NODES - 1 ? (int32_t)place : NODES - 1, scale[i] = place - (R)node[i];
    }
    EACH(i) scale[i] = values[node[i]] + scale[i] * steps[node[i]]; /* with that above no loop of vectors */
}

/* A step of Newton's method for s R(r2 s^2) = 1; whether it was so short that the next one is nothing */
INLINE R T(nearer)(R s, R t, R factor, R slope, I *ok) {
    const R shortest = IS_DOUBLE ? (R)1.862645149230957e-09 : (R)4.315837287515549e-05; /* sqrt(eps) / 8 */
    const R step = (1 - s * factor) / (factor + 2 * t * slope);
    *ok = shortest * (s + step) - T(absolute)(step) > 0;
    return s + step;
}

/* How many of a block are 0, their places filled up to whole vectors with the last one */
static int T(chosen)(int n, const I *restrict open, int *restrict places) {
    int count = 0;
    I all = 1;
    EACH(i) all &= open[i] != 0;
    if (all) return 0;
    for (int i = 0; i < n; i++) places[count] = i, count += !open[i]; /* no branch, that nobody could foretell */
    for (int i = count; count && i % LANES; i++) places[i] = places[count - 1];
    return count;
}

/* The factor by which the inverse of a factor scales points, from the table; `ok` where that is found by a few steps */
static void T(solve)(const T(Factor) *of, const R *table, int n, const R *restrict r2, R *restrict scale,
                     I *restrict ok) {
    T(tabulated)(table, n, r2, scale);
    EACH(i) ok[i] = 0;
    R k[PADDED];
    memcpy(k, of->padded, sizeof k);
    EACH_FORM(of->form, EACH(i) {
        R s = scale[i], slope;
        I found = 0;
        for (int step = 0; step < INVERSE_STEPS; step++) {
            const R t = r2[i] * s * s, factor = T(factor)(k, kind, count, below, t, &slope);
            s = T(nearer)(s, t, factor, slope, &found);
        }
        scale[i] = s, ok[i] = found;
    })
    ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK];
    for (int count = 0; count < MOST_STEPS; count++) {
        I all = 1;
        EACH(i) all &= ok[i] != 0;
        if (all) return;
        EACH(i) t[i] = r2[i] * scale[i] * scale[i];
        T(radial)(of, n, t, factor, slope);
        EACH(i) {
            I is_short;
            const R ahead = T(nearer)(scale[i], t[i], factor[i], slope[i], &is_short);
            scale[i] = ok[i] ? scale[i] : ahead, ok[i] |= is_short;
        }
    }
}

/* The same of few points in a bracket up to the fold: Newton's steps, and every other one halves the bracket */
static void T(bracketed)(const T(Factor) *of, R safe_radius_sq, int n, const R *restrict r2, R *restrict scale) {
    const R end = T(root)(safe_radius_sq);
    ALIGNED R rho[BLOCK], low[BLOCK], high[BLOCK], wanted[BLOCK], width[BLOCK], t[BLOCK], factor[BLOCK], slope[BLOCK];
    ALIGNED I moves[BLOCK];
    EACH(i) {
        wanted[i] = T(root)(r2[i]);
        rho[i] = wanted[i] < end ? wanted[i] : end, low[i] = 0, high[i] = width[i] = end, moves[i] = 1;
    }
    for (int count = 0; count < (IS_DOUBLE ? 208 : 92); count++) {
        I any = 0;
        EACH(i) t[i] = rho[i] * rho[i];
        T(radial)(of, n, t, factor, slope);
        EACH(i) {
            const R error = wanted[i] - rho[i] * factor[i], ascent = factor[i] + 2 * t[i] * slope[i];
            low[i] = error > 0 ? rho[i] : low[i], high[i] = error > 0 ? high[i] : rho[i];
            R ahead = rho[i] + error / (ascent > 0 ? ascent : (R)1e-30);
            ahead = ahead > low[i] ? ahead : low[i], ahead = ahead < high[i] ? ahead : high[i];
            moves[i] &= T(absolute)(ahead - rho[i]) > 2 * EPS * rho[i];
            const int halves = (count & 1) & (high[i] - low[i] > width[i] / 2);
            ahead = halves ? (low[i] + high[i]) / 2 : ahead;
            width[i] = count & 1 ? high[i] - low[i] : width[i];
            rho[i] = moves[i] ? ahead : rho[i];
            any |= moves[i];
        }
        if (!any) break;
    }
    EACH(i) t[i] = rho[i] * rho[i];
    T(radial)(of, n, t, factor, NULL);
    EACH(i) scale[i] = 1 / factor[i];
}

/* The factor by which an inverted chart scales angles, of squares of these */
static void T(chart_inverse)(const T(Camera) *c, int n, R *restrict theta2, R *restrict found) {
    ALIGNED I ok[BLOCK];
    int places[BLOCK], count;
    T(solve)(c->factors, c->chart_table, n, theta2, found, ok);
    if ((count = T(chosen)(n, ok, places))) {
        ALIGNED R some[BLOCK], made[BLOCK];
        const int filled = (count + LANES - 1) & -LANES;
        for (int i = 0; i < filled; i++) some[i] = theta2[places[i]];
        T(bracketed)(c->factors, c->chart_safe_radius_sq, filled, some, made);
        for (int i = 0; i < count; i++) found[places[i]] = made[i];
    }
}
