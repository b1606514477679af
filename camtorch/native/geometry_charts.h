/* Charts: a ray to a point of a plane, and back; optics/charts.py, unified.py and backprojection.py.
 *
 * Rays come with their largest component from 1 to 2. Most charts scale (x, y): (a, b) = scale (x, y), the scale a
 * function of x^2 + y^2 and z; and rays are (a S, b S, C), S and C functions of a^2 + b^2.
 */

/* A camera: its numbers, by parts, and what follows from them alone */
typedef struct {
    const Part *parts;
    int stages;
    const R *numbers[MOST_PARTS], *constants;
    R fx, fy, cx, cy, inner2, usual2, circle2;
    const R *limits2, *table;
    int has_lens, is_radial, by_stages, usable;
    R chart_inner2, chart_most2;
    const R *chart_table;
    R xi, alpha, beta; /* of a unified chart */
    R omega, slope, slope_by_omega, tan2, tan2_by_omega; /* of the fov chart */
} T(Camera);

/* The factor and, if it is wanted, its derivative by t, of optics/radial.py; see geometry_lens.h */
static void T(radial)(const Part *, const R *, const R *, int, const R *restrict, R *restrict, R *restrict);
static void T(radial_sums)(const Part *, const R *, const R *, int, const R *restrict, const R *restrict, double *);
static void T(chart_inverse)(const T(Camera) *, int, R *restrict, R *restrict);

/* What does not hang on the point, in double precision */
static void T(prepare_chart)(T(Camera) *c) {
    const Part *chart = c->parts;
    const R *k = c->numbers[0];
    if (chart->kind == UNIFIED) {
        c->xi = chart->flags & HAS_XI ? *k++ : 0;
        c->alpha = chart->flags & HAS_ALPHA ? *k++ : (R)chart->constant;
        c->beta = chart->flags & HAS_BETA ? *k++ : 1;
    } else if (chart->kind == FOV) {
        const double omega = k[0], t = omega * omega / 4;
        const double tanc = t < 1e-4 ? 1 + t * (1 / 3.0 + t * (2 / 15.0 + t * 17 / 315.0)) : tan(omega / 2) / (omega / 2);
        const double secant2 = 1 + t * tanc * tanc;
        c->omega = (R)omega, c->slope = (R)tanc;
        /* the derivative of tan(w) / w, w = omega / 2 */
        c->slope_by_omega = (R)(t < 1e-4 ? omega * (1 / 6.0 + t * (2 / 15.0 + t * 17 / 210.0)) : (secant2 - tanc) / omega);
        c->tan2 = (R)(4 * t * tanc * tanc), c->tan2_by_omega = (R)(2 * omega * tanc * secant2);
    }
}

/* The angle over x^2 + y^2's root */
INLINE R T(angle_per_radius)(R rho2, R z) {
    const R rho = T(root)(rho2 + FLOOR);
    return T(atan2)(rho, z) / rho;
}

/* z' + root where difference = root^2 - z^2, without the cancellation behind */
INLINE R T(sum_of)(R z, R root, R difference) { return z > 0 ? z + root : difference / (z > 0 ? 1 : root - z); }

/* The denominator of the unified chart, of x^2 + y^2, z' and d' */
INLINE R T(below)(R rho2, R z, R sphere, R alpha, R beta) {
    const R behind = (alpha * alpha * beta * rho2 + (2 * alpha - 1) * (z * z)) /
                     (z > 0 ? 1 : alpha * sphere - (1 - alpha) * z);
    return z > 0 ? z + alpha * (sphere - z) : behind;
}

INLINE void T(unified_scale)(const T(Camera) *c, int n, const R *restrict x, const R *restrict y, const R *restrict z,
                             R *restrict scale, I *restrict ok, const int has_xi, const int way) {
    const R xi = c->xi, alpha = c->alpha, beta = c->beta;
    EACH(i) {
        const R rho2 = x[i] * x[i] + y[i] * y[i], far = T(most)(T(absolute)(x[i]), T(absolute)(y[i]));
        const R distance = has_xi ? T(root)(rho2 + z[i] * z[i]) : 0, shifted = has_xi ? z[i] + xi * distance : z[i];
        const R sphere = way == 0 ? 0 : T(root)(beta * rho2 + shifted * shifted);
        const R below = way == 0 ? shifted : way == 1 ? sphere : T(below)(rho2, shifted, sphere, alpha, beta);
        const R before = way == 0 ? 1 : alpha * shifted + (1 - alpha) * sphere;
        scale[i] = 1 / below;
        ok[i] = ((FARTHEST * below - far) > 0) & (before > 0) & (has_xi ? distance + xi * z[i] > 0 : 1);
    }
}

/* The scale of a chart that has one, and whether a ray is covered: optics' `margin` > 0 */
static void T(chart_scale)(const T(Camera) *c, int n, const R *restrict x, const R *restrict y, const R *restrict z,
                           R *restrict scale, I *restrict ok) {
    switch (c->parts->kind) {
    case PERSPECTIVE:
        EACH(i) {
            const R far = T(most)(T(absolute)(x[i]), T(absolute)(y[i]));
            scale[i] = 1 / z[i];
            ok[i] = FARTHEST * z[i] - far > 0;
        }
        break;
    case EQUIDISTANT:
    case INVERTED:
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i];
            scale[i] = T(angle_per_radius)(rho2, z[i]);
            ok[i] = (z[i] > 0) | (rho2 > FLOOR / EPS);
        }
        if (c->parts->kind == INVERTED) {
            const R most2 = c->chart_most2, before = most2 * (1 - 32 * EPS);
            ALIGNED R found[BLOCK], theta2[BLOCK];
            EACH(i) {
                const R angle2 = (x[i] * x[i] + y[i] * y[i]) * scale[i] * scale[i];
                ok[i] &= before - angle2 > 0;
                theta2[i] = ok[i] ? T(least)(angle2, most2) : 0;
            }
            T(chart_inverse)(c, n, theta2, found);
            EACH(i) scale[i] *= found[i];
        }
        break;
    case EQUISOLID:
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], distance = T(root)(rho2 + z[i] * z[i]);
            scale[i] = T(root)(2 / (distance * T(sum_of)(z[i], distance, rho2)));
            ok[i] = (z[i] > 0) | (rho2 > FLOOR / EPS);
        }
        break;
    case UNIFIED: {
        const int fixed = !(c->parts->flags & HAS_ALPHA), has_xi = c->parts->flags & HAS_XI;
        const int way = fixed && c->alpha == 0 ? 0 : fixed && c->alpha == 1 ? 1 : 2;
        if (has_xi && way == 0) T(unified_scale)(c, n, x, y, z, scale, ok, 1, 0);
        else if (has_xi) T(unified_scale)(c, n, x, y, z, scale, ok, 1, 2);
        else if (way == 1) T(unified_scale)(c, n, x, y, z, scale, ok, 0, 1);
        else T(unified_scale)(c, n, x, y, z, scale, ok, 0, 2);
        break;
    }
    case FOV: {
        const R slope = c->slope, tan2 = c->tan2, beyond = c->omega * c->omega * FARTHEST * FARTHEST - (R)(PI * PI);
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], far = T(most)(T(absolute)(x[i]), T(absolute)(y[i]));
            scale[i] = slope * T(angle_per_radius)(tan2 * rho2, z[i]);
            /* behind the plane of the camera r is up to pi / omega */
            ok[i] = (FARTHEST * z[i] - far > 0) | ((tan2 * rho2 > FLOOR / EPS) & (beyond > 0));
        }
        break;
    }
    case ONE_DIVISION: {
        const R k = c->numbers[0][0];
        EACH(i) {
            const R far = T(most)(T(absolute)(x[i]), T(absolute)(y[i]));
            const R difference = -4 * k * (x[i] * x[i] + y[i] * y[i]), square = difference + z[i] * z[i];
            const R below = T(sum_of)(z[i], T(root)(square), difference);
            scale[i] = 2 / below;
            ok[i] = (FARTHEST / 2 * below - far > 0) & (square > 0);
        }
        break;
    }
    }
}

/* Points on the plane, of covered rays; `scale` is that of the chart, if it has one */
static void T(to_plane)(const T(Camera) *c, int n, const R *x, const R *y, const R *restrict z, R *a, R *b,
                        R *restrict scale, I *restrict ok) {
    const Part *chart = c->parts;
    if (chart->flags & TRANSVERSE && chart->kind >= CYLINDER) {
        const R *other = x;
        R *plane = a;
        x = y, y = other, a = b, b = plane;
    }
    {
        const R *restrict p = x, *restrict q = y;
        R *restrict u = a, *restrict v = b;
        if (chart->kind == CYLINDER) {
            EACH(i) {
                const R far = T(most)(T(absolute)(p[i]), T(absolute)(z[i]));
                u[i] = T(atan2)(p[i], z[i]), v[i] = q[i] / T(root)(p[i] * p[i] + z[i] * z[i]);
                ok[i] = FARTHEST * far - T(absolute)(q[i]) > 0;
            }
        } else if (chart->kind == SPHERE) {
            EACH(i) {
                const R across2 = p[i] * p[i] + z[i] * z[i];
                u[i] = T(atan2)(p[i], z[i]), v[i] = T(atan2)(q[i], T(root)(across2));
                ok[i] = across2 - FLOOR > 0;
            }
        } else {
            T(chart_scale)(c, n, p, q, z, scale, ok);
            EACH(i) u[i] = p[i] * scale[i], v[i] = q[i] * scale[i];
        }
    }
}

/* Twice the derivative of the scale by x^2 + y^2, and that by z. What cancels on the axis is multiplied by x^2 + y^2 */
static void T(scale_slopes)(const T(Camera) *c, int n, const R *restrict x, const R *restrict y, const R *restrict z,
                            const R *restrict s, R *restrict out, R *restrict along) {
    switch (c->parts->kind) {
    case PERSPECTIVE:
        EACH(i) out[i] = 0, along[i] = -s[i] * s[i];
        break;
    case EQUIDISTANT:
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i];
            along[i] = -1 / (rho2 + z[i] * z[i]);
            out[i] = -(along[i] * z[i] + s[i]) / (rho2 + FLOOR);
        }
        break;
    case INVERTED: {
        ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK];
        EACH(i) t[i] = (x[i] * x[i] + y[i] * y[i]) * s[i] * s[i];
        T(radial)(c->parts, c->numbers[0], c->constants, n, t, factor, slope);
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], by_angle = 1 / (factor[i] + 2 * t[i] * slope[i]);
            along[i] = -by_angle / (rho2 + z[i] * z[i]);
            out[i] = -(along[i] * z[i] + s[i]) / (rho2 + FLOOR);
        }
        break;
    }
    case EQUISOLID:
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], distance2 = rho2 + z[i] * z[i], distance = T(root)(distance2);
            const R sum = T(sum_of)(z[i], distance, rho2), twice = s[i] / (2 * distance2);
            along[i] = -twice * sum;
            /* 1 + z / (2 d) over d (d + z) */
            out[i] = -twice * (2 * distance + z[i]) / sum;
        }
        break;
    case UNIFIED: {
        const R xi = c->xi, alpha = c->alpha, beta = c->beta;
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], distance = T(root)(rho2 + z[i] * z[i]);
            const R shifted = z[i] + xi * distance, sphere = T(root)(beta * rho2 + shifted * shifted);
            const R by_below = -s[i] * s[i], by_root = by_below * alpha / sphere;
            const R by_shifted = by_below * (1 - alpha) + by_root * shifted, by_distance = by_shifted * xi / distance;
            out[i] = by_root * beta + by_distance;
            along[i] = by_shifted + by_distance * z[i];
        }
        break;
    }
    case FOV: {
        const R slope = c->slope, tan2 = c->tan2;
        EACH(i) {
            const R w = tan2 * (x[i] * x[i] + y[i] * y[i]);
            along[i] = -slope / (w + z[i] * z[i]);
            out[i] = -tan2 * (along[i] * z[i] + s[i]) / (w + FLOOR);
        }
        break;
    }
    case ONE_DIVISION: {
        const R k = c->numbers[0][0];
        EACH(i) {
            const R root = T(root)(z[i] * z[i] - 4 * k * (x[i] * x[i] + y[i] * y[i]));
            along[i] = -s[i] / root;
            out[i] = 2 * k * s[i] * s[i] / root;
        }
        break;
    }
    }
}

/* The cotangents of rays of that of their points (ga, gb); `s` is the chart's scale. Adds those of its numbers */
static void T(to_plane_vjp)(const T(Camera) *c, int n, const R *x, const R *y, const R *restrict z,
                            const R *restrict s, const R *ga, const R *gb, R *gx, R *gy, R *restrict gz, double *sums) {
    const Part *chart = c->parts;
    if (chart->kind >= CYLINDER) {
        const int swapped = chart->flags & TRANSVERSE;
        const R *restrict p = swapped ? y : x, *restrict q = swapped ? x : y;
        const R *restrict gu = swapped ? gb : ga, *restrict gv = swapped ? ga : gb;
        R *restrict gp = swapped ? gy : gx, *restrict gq = swapped ? gx : gy;
        EACH(i) {
            const R across2 = p[i] * p[i] + z[i] * z[i], across = T(root)(across2);
            const R turn = gu[i] / across2, length2 = across2 + q[i] * q[i];
            const R up = chart->kind == CYLINDER ? gv[i] / across : gv[i] * across / length2;
            const R in = chart->kind == CYLINDER ? -gv[i] * q[i] / (across2 * across) : -gv[i] * q[i] / (across * length2);
            gp[i] = turn * z[i] + in * p[i], gq[i] = up, gz[i] = in * z[i] - turn * p[i];
        }
        return;
    }
    ALIGNED R out[BLOCK], down[BLOCK], along[BLOCK];
    T(scale_slopes)(c, n, x, y, z, s, out, down);
    EACH(i) {
        along[i] = ga[i] * x[i] + gb[i] * y[i];
        gx[i] = ga[i] * s[i] + x[i] * along[i] * out[i];
        gy[i] = gb[i] * s[i] + y[i] * along[i] * out[i];
        gz[i] = along[i] * down[i];
    }
    if (!sums) return;
    ALIGNED R w[BLOCK], t[BLOCK];
    switch (chart->kind) {
    case UNIFIED: {
        const R xi = c->xi, alpha = c->alpha, beta = c->beta;
        ALIGNED R of_xi[BLOCK], of_alpha[BLOCK], of_beta[BLOCK];
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], distance = T(root)(rho2 + z[i] * z[i]);
            const R shifted = z[i] + xi * distance, sphere = T(root)(beta * rho2 + shifted * shifted);
            const R by_below = -along[i] * s[i] * s[i], by_root = by_below * alpha / sphere;
            of_xi[i] = (by_below * (1 - alpha) + by_root * shifted) * distance;
            of_alpha[i] = by_below * (sphere - shifted);
            of_beta[i] = by_root * rho2 / 2;
        }
        if (chart->flags & HAS_XI) *sums++ += T(total)(n, of_xi);
        if (chart->flags & HAS_ALPHA) *sums++ += T(total)(n, of_alpha);
        if (chart->flags & HAS_BETA) *sums += T(total)(n, of_beta);
        break;
    }
    case FOV: {
        /* the scale is slope times a function of tan2 rho2 and z */
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i], w2 = c->tan2 * rho2;
            const R by_w = -(s[i] - c->slope * z[i] / (w2 + z[i] * z[i])) / (2 * (w2 + FLOOR));
            w[i] = along[i] * (s[i] / c->slope * c->slope_by_omega + by_w * rho2 * c->tan2_by_omega);
        }
        *sums += T(total)(n, w);
        break;
    }
    case ONE_DIVISION: {
        const R k = c->numbers[0][0];
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i];
            w[i] = along[i] * s[i] * s[i] * rho2 / T(root)(z[i] * z[i] - 4 * k * rho2);
        }
        *sums += T(total)(n, w);
        break;
    }
    case INVERTED:
        /* d(scale) = -scale dR / (R + 2 t R'), whose denominator stands in `down` */
        EACH(i) {
            const R rho2 = x[i] * x[i] + y[i] * y[i];
            t[i] = rho2 * s[i] * s[i];
            w[i] = along[i] * s[i] * down[i] * (rho2 + z[i] * z[i]);
        }
        T(radial_sums)(chart, c->numbers[0], c->constants, n, t, w, sums);
        break;
    }
}

/* -- back: points of the plane to rays */

INLINE R T(ahead)(R around, R alpha) {
    /* z' of the ray (a, b, z') whose denominator is 1; two forms of one function, each where it does not cancel */
    const R root = T(root)(1 - (2 * alpha - 1) * around), bend = 2 * alpha - 1;
    const int far = T(absolute)(bend) > (R)0.5;
    return (far ? alpha * root + (alpha - 1) : 1 - alpha * alpha * around) / (far ? bend : alpha * root + (1 - alpha));
}

/* Whether points of the plane are the image of a ray: optics' `on_plane` > 0 */
static void T(on_plane)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, I *restrict ok) {
    const R half_turn = (R)(PI * (1 - (double)EPS));
    const int swapped = c->parts->flags & TRANSVERSE && c->parts->kind >= CYLINDER;
    const R *restrict p = swapped ? b : a, *restrict q = swapped ? a : b;
    switch (c->parts->kind) {
    case PERSPECTIVE:
        EACH(i) ok[i] = FARTHEST - T(most)(T(absolute)(a[i]), T(absolute)(b[i])) > 0;
        break;
    case EQUIDISTANT:
        EACH(i) ok[i] = (R)(PI * PI) - (a[i] * a[i] + b[i] * b[i]) > 0;
        break;
    case EQUISOLID: {
        const R end = 2 * (1 - 64 * EPS);
        EACH(i) ok[i] = end * end - (a[i] * a[i] + b[i] * b[i]) > 0;
        break;
    }
    case UNIFIED: {
        const R xi = c->xi, alpha = c->alpha, beta = c->beta, floor = 64 * EPS;
        const int has_xi = c->parts->flags & HAS_XI;
        EACH(i) {
            const R rho2 = a[i] * a[i] + b[i] * b[i], around = beta * rho2;
            const R margin = 1 - floor - (2 * alpha - 1) * around;
            const R ahead = T(ahead)(around, alpha);
            const R before = ahead * ahead + (1 - xi) * (1 + xi) * rho2;
            const R reach = T(root)(before > 0 ? before : 0) + xi * ahead;
            ok[i] = (FARTHEST / 2 - T(most)(T(absolute)(a[i]), T(absolute)(b[i])) > 0) & (margin > 0);
            ok[i] &= (has_xi == 0) | ((before - floor * (rho2 + ahead * ahead) > 0) & (reach - floor * T(absolute)(ahead) > 0));
        }
        break;
    }
    case FOV: {
        const R omega2 = c->omega * c->omega;
        EACH(i) {
            ok[i] = ((R)(PI * PI) - omega2 * (a[i] * a[i] + b[i] * b[i]) > 0) &
                    (FARTHEST / 2 - T(most)(T(absolute)(a[i]), T(absolute)(b[i])) > 0);
        }
        break;
    }
    case ONE_DIVISION: {
        const R k = c->numbers[0][0];
        EACH(i) {
            ok[i] = (1 - 64 * EPS - k * (a[i] * a[i] + b[i] * b[i]) > 0) &
                    (FARTHEST / 2 - T(most)(T(absolute)(a[i]), T(absolute)(b[i])) > 0);
        }
        break;
    }
    case INVERTED: {
        const R inner2 = c->chart_inner2, limit = c->chart_most2 * (1 - 128 * EPS);
        const R before = limit < (R)(PI * PI) ? limit : (R)(PI * PI);
        ALIGNED R t[BLOCK], factor[BLOCK];
        EACH(i) t[i] = T(least)(a[i] * a[i] + b[i] * b[i], inner2);
        T(radial)(c->parts, c->numbers[0], c->constants, n, t, factor, NULL);
        EACH(i) {
            ok[i] = (inner2 * (1 - 64 * EPS) - (a[i] * a[i] + b[i] * b[i]) > 0) &
                    (before - t[i] * factor[i] * factor[i] > 0);
        }
        break;
    }
    case CYLINDER:
        EACH(i) ok[i] = (half_turn - T(absolute)(p[i]) > 0) & (FARTHEST - T(absolute)(q[i]) > 0);
        break;
    case SPHERE:
        EACH(i) ok[i] = (half_turn - T(absolute)(p[i]) > 0) & ((R)(PI / 2) - T(absolute)(q[i]) > 0);
        break;
    }
}

/* What the rays of charts that scale are made of, with derivatives */
typedef struct {
    ALIGNED R s[BLOCK], c[BLOCK], twice_s[BLOCK], twice_c[BLOCK]; /* S and C, twice their derivatives by a^2 + b^2 */
} T(Turned);

static void T(turned)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, T(Turned) *to, int order) {
    R *restrict s = to->s, *restrict z = to->c, *restrict ds = to->twice_s, *restrict dz = to->twice_c;
    switch (c->parts->kind) {
    case PERSPECTIVE:
    case ONE_DIVISION: {
        const R k = c->parts->kind == ONE_DIVISION ? c->numbers[0][0] : 0;
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], h = 1 + k * r2;
            s[i] = 1 / T(root)(r2 + h * h), z[i] = h * s[i];
            ds[i] = -s[i] * s[i] * s[i] * (1 + 2 * h * k), dz[i] = 2 * k * s[i] + h * ds[i];
        }
        break;
    }
    case EQUIDISTANT:
    case INVERTED:
        EACH(i) {
            const R theta2 = a[i] * a[i] + b[i] * b[i], theta = T(root)(theta2 + FLOOR);
            R sine, cosine;
            T(turn)(theta, &sine, &cosine);
            s[i] = sine / theta, z[i] = cosine;
            ds[i] = (cosine - s[i]) / (theta2 + FLOOR), dz[i] = -s[i];
        }
        break;
    case EQUISOLID:
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i];
            s[i] = T(root)(1 - r2 / 4), z[i] = 1 - r2 / 2;
            ds[i] = -1 / (4 * s[i]), dz[i] = -1;
        }
        break;
    case UNIFIED: {
        const R xi = c->xi, alpha = c->alpha, beta = c->beta, short_of = (1 - xi) * (1 + xi);
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], h = T(ahead)(beta * r2, alpha), below = r2 + h * h;
            /* where the line from the shifted centre meets the unit sphere, on the side of the axis */
            const R root = T(root)(h * h + short_of * r2);
            s[i] = (xi * h + root) / below, z[i] = h * s[i] - xi;
        }
        if (order)
            EACH(i) {
                const R r2 = a[i] * a[i] + b[i] * b[i], h = T(ahead)(beta * r2, alpha), below = r2 + h * h;
                const R root = T(root)(h * h + short_of * r2);
                const R by_r2 = -alpha * beta / (2 * T(root)(1 - (2 * alpha - 1) * beta * r2)); /* of h */
                const R by_h = (xi + h / root - 2 * h * s[i]) / below;                         /* of S */
                ds[i] = (short_of / root - 2 * s[i]) / below + 2 * by_h * by_r2;
                dz[i] = 2 * by_r2 * s[i] + h * ds[i];
            }
        break;
    }
    case FOV: {
        const R omega2 = c->omega * c->omega, slope = c->slope;
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], angle2 = omega2 * r2, angle = T(root)(angle2 + FLOOR);
            R sine, cosine;
            T(turn)(angle, &sine, &cosine);
            sine /= angle;
            const R across = sine / slope, length = 1 / T(root)(r2 * across * across + cosine * cosine);
            s[i] = across * length, z[i] = cosine * length;
            const R by_across = omega2 * (cosine - sine) / (angle2 + FLOOR) / slope, by_cosine = -omega2 * sine; /* twice */
            const R by_length = -length * length * length * (across * across + r2 * across * by_across + cosine * by_cosine);
            ds[i] = by_across * length + across * by_length, dz[i] = by_cosine * length + cosine * by_length;
        }
        break;
    }
    }
}

/* The unit rays of points of the plane */
static void T(to_ray)(const T(Camera) *c, int n, const R *a, const R *b, R *x, R *y, R *restrict z) {
    const Part *chart = c->parts;
    if (chart->kind >= CYLINDER) {
        const int swapped = chart->flags & TRANSVERSE;
        const R *restrict u = swapped ? b : a, *restrict v = swapped ? a : b;
        R *restrict p = swapped ? y : x, *restrict q = swapped ? x : y;
        const int is_sphere = chart->kind == SPHERE;
        EACH(i) {
            R sine, cosine, up, across;
            T(turn)(u[i], &sine, &cosine);
            if (is_sphere) T(turn)(v[i], &up, &across);
            else across = 1 / T(root)(1 + v[i] * v[i]), up = v[i] * across;
            p[i] = sine * across, q[i] = up, z[i] = cosine * across;
        }
        return;
    }
    T(Turned) to;
    if (chart->kind == INVERTED) {
        ALIGNED R t[BLOCK], factor[BLOCK], p[BLOCK], q[BLOCK];
        EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
        T(radial)(chart, c->numbers[0], c->constants, n, t, factor, NULL);
        EACH(i) p[i] = a[i] * factor[i], q[i] = b[i] * factor[i];
        T(turned)(c, n, p, q, &to, 0);
        EACH(i) x[i] = p[i] * to.s[i], y[i] = q[i] * to.s[i], z[i] = to.c[i];
        return;
    }
    T(turned)(c, n, a, b, &to, 0);
    EACH(i) x[i] = a[i] * to.s[i], y[i] = b[i] * to.s[i], z[i] = to.c[i];
}

/* The cotangents of points of the plane of those of their rays. Adds those of the chart's numbers */
static void T(to_ray_vjp)(const T(Camera) *c, int n, const R *a, const R *b, const R *gx, const R *gy,
                          const R *restrict gz, R *ga, R *gb, double *sums) {
    const Part *chart = c->parts;
    if (chart->kind >= CYLINDER) {
        const int swapped = chart->flags & TRANSVERSE, is_sphere = chart->kind == SPHERE;
        const R *restrict u = swapped ? b : a, *restrict v = swapped ? a : b;
        const R *restrict gp = swapped ? gy : gx, *restrict gq = swapped ? gx : gy;
        R *restrict gu = swapped ? gb : ga, *restrict gv = swapped ? ga : gb;
        EACH(i) {
            R sine, cosine, up, across;
            T(turn)(u[i], &sine, &cosine);
            if (is_sphere) T(turn)(v[i], &up, &across);
            else across = 1 / T(root)(1 + v[i] * v[i]), up = v[i] * across;
            const R level = gp[i] * sine + gz[i] * cosine, slant = gq[i] * across - level * up;
            gu[i] = (gp[i] * cosine - gz[i] * sine) * across;
            /* the latitude of a height v moves by dv / (1 + v^2) */
            gv[i] = is_sphere ? slant : slant * across * across;
        }
        return;
    }
    T(Turned) to;
    if (chart->kind == INVERTED) {
        ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK], p[BLOCK], q[BLOCK], w[BLOCK];
        EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
        T(radial)(chart, c->numbers[0], c->constants, n, t, factor, slope);
        EACH(i) p[i] = a[i] * factor[i], q[i] = b[i] * factor[i];
        T(turned)(c, n, p, q, &to, 1);
        EACH(i) {
            const R out = (gx[i] * p[i] + gy[i] * q[i]) * to.twice_s[i] + gz[i] * to.twice_c[i];
            const R gp = gx[i] * to.s[i] + p[i] * out, gq = gy[i] * to.s[i] + q[i] * out;
            w[i] = gp * a[i] + gq * b[i];
            ga[i] = gp * factor[i] + a[i] * 2 * slope[i] * w[i], gb[i] = gq * factor[i] + b[i] * 2 * slope[i] * w[i];
        }
        if (sums) T(radial_sums)(chart, c->numbers[0], c->constants, n, t, w, sums);
        return;
    }
    T(turned)(c, n, a, b, &to, 1);
    EACH(i) {
        const R out = (gx[i] * a[i] + gy[i] * b[i]) * to.twice_s[i] + gz[i] * to.twice_c[i];
        ga[i] = gx[i] * to.s[i] + a[i] * out, gb[i] = gy[i] * to.s[i] + b[i] * out;
    }
    if (!sums) return;
    ALIGNED R w[BLOCK], of_alpha[BLOCK], of_beta[BLOCK];
    switch (chart->kind) {
    case UNIFIED: {
        const R xi = c->xi, alpha = c->alpha, beta = c->beta, short_of = (1 - xi) * (1 + xi);
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], h = T(ahead)(beta * r2, alpha), below = r2 + h * h;
            const R root = T(root)(h * h + short_of * r2), along = gx[i] * a[i] + gy[i] * b[i] + gz[i] * h; /* by S */
            const R by_h = along * (xi + h / root - 2 * h * to.s[i]) / below + gz[i] * to.s[i];
            const R fold = T(root)(1 - (2 * alpha - 1) * beta * r2), sphere = T(root)(beta * r2 + h * h);
            w[i] = along * (h - xi * r2 / root) / below - gz[i];
            of_alpha[i] = -by_h * (sphere - h) * sphere / fold;
            of_beta[i] = -by_h * alpha * r2 / (2 * fold);
        }
        if (chart->flags & HAS_XI) *sums++ += T(total)(n, w);
        if (chart->flags & HAS_ALPHA) *sums++ += T(total)(n, of_alpha);
        if (chart->flags & HAS_BETA) *sums += T(total)(n, of_beta);
        break;
    }
    case FOV: {
        const R omega = c->omega, slope = c->slope;
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], angle2 = omega * omega * r2, angle = T(root)(angle2 + FLOOR);
            R sine, cosine;
            T(turn)(angle, &sine, &cosine);
            sine /= angle;
            const R across = sine / slope, length = 1 / T(root)(r2 * across * across + cosine * cosine);
            const R by_across = (cosine - sine) / (angle2 + FLOOR) * omega * r2 / slope - across * c->slope_by_omega / slope;
            const R by_cosine = -sine * omega * r2;
            const R by_length = -length * length * length * (r2 * across * by_across + cosine * by_cosine);
            w[i] = (gx[i] * a[i] + gy[i] * b[i]) * (by_across * length + across * by_length) +
                   gz[i] * (by_cosine * length + cosine * by_length);
        }
        *sums += T(total)(n, w);
        break;
    }
    case ONE_DIVISION: {
        const R k = c->numbers[0][0];
        EACH(i) {
            const R r2 = a[i] * a[i] + b[i] * b[i], h = 1 + k * r2, by_length = -to.s[i] * to.s[i] * to.s[i] * h;
            w[i] = r2 * ((gx[i] * a[i] + gy[i] * b[i]) * by_length + gz[i] * (to.s[i] + h * by_length));
        }
        *sums += T(total)(n, w);
        break;
    }
    }
}
