/* Lenses: stages on a chart's plane, radial factors, and their inverse; optics/lens.py, radial.py, radial_inverse.py. */

/* -- radial factors: a point m goes to m R(t), t = |m|^2 */

/* 1 + k0 t + k1 t^2 + ... and, if wanted, its derivative: Horner's scheme */
static void T(polynomial)(const R *k, int count, int n, const R *restrict t, R *restrict value, R *restrict slope) {
    const R last = k[count - 1];
    EACH(i) value[i] = last;
    if (slope) EACH(i) slope[i] = 0;
    for (int j = count - 2; j >= -1; j--) {
        const R c = j < 0 ? 1 : k[j];
        if (slope) EACH(i) slope[i] = slope[i] * t[i] + value[i];
        EACH(i) value[i] = value[i] * t[i] + c;
    }
}

/* The sums of weight t, weight t^2, ...; weights change */
static void T(powers)(int count, int n, const R *restrict t, R *restrict weight, double *sums) {
    for (int j = 0; j < count; j++) {
        EACH(i) weight[i] *= t[i];
        sums[j] += T(total)(n, weight);
    }
}

static void T(roots)(int n, const R *restrict t, R *restrict radius) { EACH(i) radius[i] = T(root)(t[i] + FLOOR); }

/* D of the ray (r, 0, D), and its derivative by t = r^2 */
static void T(ray_ahead)(const Part *part, const R *k, int n, const R *restrict t, R *restrict ahead, R *restrict slope) {
    if (part->factor == ANGLE_PER_RADIUS) {
        T(polynomial)(k, part->n, n, t, ahead, slope);
        return;
    }
    ALIGNED R radius[BLOCK];
    T(roots)(n, t, radius);
    T(polynomial)(k, part->n, n, radius, ahead, slope);
    if (slope) EACH(i) slope[i] /= 2 * radius[i];
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
    for (; step; step /= 2)
        EACH(i) {
            const I next = piece[i] + step, at = next < last ? next : last;
            piece[i] = (next <= last) & (nodes[at] <= offset[i]) ? next : piece[i];
        }
    EACH(i) offset[i] -= nodes[piece[i]];
}

static void T(table_factor)(const Part *part, const R *k, const R *nodes, int n, const R *restrict t, R *restrict factor,
                            R *restrict slope) {
    ALIGNED R radius[BLOCK], side[BLOCK], offset[BLOCK];
    ALIGNED I piece[BLOCK];
    const R *restrict zeroth = k, *restrict first = k + part->n, *restrict second = first + part->n,
            *restrict third = second + part->n;
    T(pieces)(part, nodes, n, t, radius, side, piece, offset);
    EACH(i) {
        const I p = piece[i];
        /* on the first piece neither division nor root has a part in the derivatives of the outer terms */
        const int central = (p == 0) & (side[i] > 0);
        const R share = central ? 1 : offset[i] / radius[i], square = central ? t[i] : offset[i] * offset[i];
        factor[i] = zeroth[p] / radius[i] + share * (first[p] + offset[i] * second[p] + square * third[p]);
    }
    if (slope)
        EACH(i) {
            const I p = piece[i];
            const R by_place = first[p] + 2 * offset[i] * second[p] + 3 * offset[i] * offset[i] * third[p];
            slope[i] = (side[i] * by_place - factor[i]) / (2 * radius[i] * radius[i]);
        }
}

static void T(radial)(const Part *part, const R *k, const R *constants, int n, const R *restrict t, R *restrict factor,
                      R *restrict slope) {
    switch (part->factor) {
    case POLYNOMIAL:
        T(polynomial)(k, part->n, n, t, factor, slope);
        break;
    case RATIONAL: {
        ALIGNED R below[BLOCK], bend[BLOCK];
        T(polynomial)(k, part->n, n, t, factor, slope);
        T(polynomial)(k + part->n, part->m, n, t, below, slope ? bend : NULL);
        EACH(i) factor[i] /= below[i];
        if (slope) EACH(i) slope[i] = (slope[i] - factor[i] * bend[i]) / below[i];
        break;
    }
    case RADIUS_POLYNOMIAL: {
        ALIGNED R radius[BLOCK];
        T(roots)(n, t, radius);
        T(polynomial)(k, part->n, n, radius, factor, slope);
        if (slope) EACH(i) slope[i] /= 2 * radius[i];
        break;
    }
    case ANGLE_PER_RADIUS:
    case ANGLE_OF_ALL_POWERS: {
        ALIGNED R ahead[BLOCK], bend[BLOCK];
        T(ray_ahead)(part, k, n, t, ahead, slope ? bend : NULL);
        EACH(i) factor[i] = T(angle_per_radius)(t[i], ahead[i]);
        if (slope)
            EACH(i) {
                const R by_radius = (ahead[i] - 2 * t[i] * bend[i]) / (t[i] + ahead[i] * ahead[i]);
                slope[i] = (by_radius - factor[i]) / (2 * t[i] + FLOOR);
            }
        break;
    }
    case RADIUS_TABLE:
        T(table_factor)(part, k, constants, n, t, factor, slope);
        break;
    default:
        EACH(i) factor[i] = 1;
        if (slope) EACH(i) slope[i] = 0;
    }
}

/* Adds the sums over the points of dR/dk weight, for each number k */
static void T(radial_sums)(const Part *part, const R *k, const R *constants, int n, const R *restrict t,
                           const R *restrict weight, double *sums) {
    ALIGNED R w[BLOCK], other[BLOCK], more[BLOCK];
    EACH(i) w[i] = weight[i];
    switch (part->factor) {
    case POLYNOMIAL:
        T(powers)(part->n, n, t, w, sums);
        break;
    case RATIONAL:
        T(radial)(part, k, constants, n, t, other, NULL);
        T(polynomial)(k + part->n, part->m, n, t, more, NULL);
        EACH(i) w[i] /= more[i], other[i] *= -w[i];
        T(powers)(part->n, n, t, w, sums);
        T(powers)(part->m, n, t, other, sums + part->n);
        break;
    case RADIUS_POLYNOMIAL:
        T(roots)(n, t, other);
        T(powers)(part->n, n, other, w, sums);
        break;
    case ANGLE_PER_RADIUS:
    case ANGLE_OF_ALL_POWERS:
        T(ray_ahead)(part, k, n, t, other, NULL);
        EACH(i) w[i] /= -(t[i] + other[i] * other[i]);
        T(roots)(n, t, other);
        T(powers)(part->n, n, part->factor == ANGLE_PER_RADIUS ? t : other, w, sums);
        break;
    case RADIUS_TABLE: {
        ALIGNED R side[BLOCK];
        ALIGNED I piece[BLOCK];
        T(pieces)(part, constants, n, t, other, side, piece, more);
        EACH(i) w[i] /= other[i];
        for (int j = 0; j < 4; j++) {
            for (int i = 0; i < n; i++) sums[j * part->n + piece[i]] += w[i];
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

/* Where a planar stage sends points: m R(t) + (p t + 2 m (p . m)) + (s0 t + s1 t^2, s2 t + s3 t^2) */
static void T(planar)(const Part *part, const R *k, const R *constants, int n, const R *restrict a, const R *restrict b,
                      R *restrict u, R *restrict v, T(Jacobian) *restrict to) {
    ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK];
    const R *rest = k + (part->factor == RADIUS_TABLE ? 4 * part->n : part->n + part->m);
    const int bent = part->flags & TANGENTIAL, has_prism = part->flags & PRISM;
    const R px = bent ? rest[0] : 0, py = bent ? rest[1] : 0, *s = rest + (bent ? 2 : 0);
    const R s0 = has_prism ? s[0] : 0, s1 = has_prism ? s[1] : 0, s2 = has_prism ? s[2] : 0, s3 = has_prism ? s[3] : 0;
    EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
    T(radial)(part, k, constants, n, t, factor, to ? slope : NULL);
    if (!bent && !has_prism) {
        EACH(i) u[i] = a[i] * factor[i], v[i] = b[i] * factor[i];
    } else {
        EACH(i) {
            const R dot = 2 * (px * a[i] + py * b[i]);
            u[i] = a[i] * (factor[i] + dot) + (px + s0 + s1 * t[i]) * t[i];
            v[i] = b[i] * (factor[i] + dot) + (py + s2 + s3 * t[i]) * t[i];
        }
    }
    if (!to) return;
    EACH(i) {
        const R dot = 2 * (px * a[i] + py * b[i]), twice = 2 * slope[i];
        const R across = twice * a[i] * b[i] + 2 * (px * b[i] + py * a[i]);
        const R gu = 2 * s0 + 4 * s1 * t[i], gv = 2 * s2 + 4 * s3 * t[i];
        to->ua[i] = factor[i] + twice * a[i] * a[i] + dot + 4 * px * a[i] + gu * a[i];
        to->ub[i] = across + gu * b[i], to->va[i] = across + gv * a[i];
        to->vb[i] = factor[i] + twice * b[i] * b[i] + dot + 4 * py * b[i] + gv * b[i];
    }
}

static void T(planar_vjp)(const Part *part, const R *k, const R *constants, int n, const R *restrict a,
                          const R *restrict b, R *restrict gu, R *restrict gv, double *sums) {
    ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK], along[BLOCK], ga[BLOCK], gb[BLOCK];
    const int radial = part->factor == RADIUS_TABLE ? 4 * part->n : part->n + part->m;
    const int bent = part->flags & TANGENTIAL, has_prism = part->flags & PRISM;
    const R *rest = k + radial, px = bent ? rest[0] : 0, py = bent ? rest[1] : 0, *s = rest + (bent ? 2 : 0);
    const R s0 = has_prism ? s[0] : 0, s1 = has_prism ? s[1] : 0, s2 = has_prism ? s[2] : 0, s3 = has_prism ? s[3] : 0;
    EACH(i) t[i] = a[i] * a[i] + b[i] * b[i];
    T(radial)(part, k, constants, n, t, factor, slope);
    EACH(i) {
        const R dot = 2 * (px * a[i] + py * b[i]);
        along[i] = gu[i] * a[i] + gv[i] * b[i];
        const R out = 2 * (along[i] * slope[i] + gu[i] * (px + s0 + 2 * s1 * t[i]) + gv[i] * (py + s2 + 2 * s3 * t[i]));
        ga[i] = gu[i] * (factor[i] + dot) + 2 * along[i] * px + a[i] * out;
        gb[i] = gv[i] * (factor[i] + dot) + 2 * along[i] * py + b[i] * out;
    }
    if (sums) {
        if (part->factor != NO_FACTOR) T(radial_sums)(part, k, constants, n, t, along, sums);
        sums += radial;
        if (bent || has_prism) {
            EACH(i) gu[i] *= t[i], gv[i] *= t[i];
            const double even_u = T(total)(n, gu), even_v = T(total)(n, gv);
            if (bent) {
                *sums++ += even_u + 2 * T(dot)(n, along, a);
                *sums++ += even_v + 2 * T(dot)(n, along, b);
            }
            if (has_prism) {
                sums[0] += even_u, sums[1] += T(dot)(n, gu, t);
                sums[2] += even_v, sums[3] += T(dot)(n, gv, t);
            }
        }
    }
    EACH(i) gu[i] = ga[i], gv[i] = gb[i];
}

/* The homography of a tilted sensor, R = k row by row: ((r00 a + r01 b + r02) r22 / depth - r02, ...) */
static void T(tilt)(const R *k, int n, const R *restrict a, const R *restrict b, R *restrict u, R *restrict v,
                    T(Jacobian) *restrict to) {
    EACH(i) {
        const R one = 1 / (k[6] * a[i] + k[7] * b[i] + k[8]), scale = k[8] * one;
        const R x = scale * (k[0] * a[i] + k[1] * b[i] + k[2]), y = scale * (k[3] * a[i] + k[4] * b[i] + k[5]);
        u[i] = x - k[2], v[i] = y - k[5];
        if (to) {
            to->ua[i] = (k[8] * k[0] - x * k[6]) * one, to->ub[i] = (k[8] * k[1] - x * k[7]) * one;
            to->va[i] = (k[8] * k[3] - y * k[6]) * one, to->vb[i] = (k[8] * k[4] - y * k[7]) * one;
        }
    }
}

static void T(tilt_vjp)(const R *k, int n, const R *restrict a, const R *restrict b, R *restrict gu, R *restrict gv,
                        double *sums) {
    ALIGNED R rows[3][BLOCK], of_scale[BLOCK], ga[BLOCK], gb[BLOCK];
    EACH(i) {
        const R one = 1 / (k[6] * a[i] + k[7] * b[i] + k[8]), scale = k[8] * one;
        const R x = scale * (k[0] * a[i] + k[1] * b[i] + k[2]), y = scale * (k[3] * a[i] + k[4] * b[i] + k[5]);
        ga[i] = gu[i] * (k[8] * k[0] - x * k[6]) * one + gv[i] * (k[8] * k[3] - y * k[6]) * one;
        gb[i] = gu[i] * (k[8] * k[1] - x * k[7]) * one + gv[i] * (k[8] * k[4] - y * k[7]) * one;
        of_scale[i] = gu[i] * x + gv[i] * y;
        rows[0][i] = scale * gu[i], rows[1][i] = scale * gv[i], rows[2][i] = -one * of_scale[i];
    }
    if (sums) {
        for (int j = 0; j < 3; j++) {
            sums[3 * j] += T(dot)(n, rows[j], a), sums[3 * j + 1] += T(dot)(n, rows[j], b);
            sums[3 * j + 2] += T(total)(n, rows[j]);
        }
        sums[2] -= T(total)(n, gu), sums[5] -= T(total)(n, gv);
        sums[8] += T(total)(n, of_scale) / k[8];
    }
    EACH(i) gu[i] = ga[i], gv[i] = gb[i];
}

static void T(stage)(const T(Camera) *c, int stage, int n, const R *a, const R *b, R *u, R *v, T(Jacobian) *to) {
    const Part *part = c->parts + stage;
    const R *k = c->numbers[stage];
    if (part->kind == TILT) T(tilt)(k, n, a, b, u, v, to);
    else if (part->kind == SHEAR) {
        EACH(i) u[i] = a[i] + k[1] * b[i], v[i] = b[i] + k[0] * a[i];
        if (to) EACH(i) to->ua[i] = to->vb[i] = 1, to->ub[i] = k[1], to->va[i] = k[0];
    } else T(planar)(part, k, c->constants, n, a, b, u, v, to);
}

/* Where the stages from `first` on send points; the Jacobian of all of them; if wanted, `least`: positive where each is
   defined, regular and not turned over */
static void T(lens)(const T(Camera) *c, int first, int n, const R *a, const R *b, R *u, R *v, T(Jacobian) *to,
                    R *least) {
    ALIGNED R x[BLOCK], y[BLOCK], p[BLOCK], q[BLOCK];
    T(Jacobian) here;
    EACH(i) x[i] = a[i], y[i] = b[i];
    for (int j = first; j <= c->stages; j++) {
        T(Jacobian) *made = !to ? NULL : j == first ? to : &here;
        T(stage)(c, j, n, x, y, p, q, made);
        if (least) {
            const R *k = c->numbers[j];
            ALIGNED R margin[BLOCK];
            if (c->parts[j].kind == TILT) EACH(i) margin[i] = k[6] * x[i] + k[7] * y[i] + k[8];
            else if (c->parts[j].factor == RATIONAL) {
                ALIGNED R t[BLOCK];
                EACH(i) t[i] = x[i] * x[i] + y[i] * y[i];
                T(polynomial)(k + c->parts[j].n, c->parts[j].m, n, t, margin, NULL);
            } else EACH(i) margin[i] = INFINITY;
            EACH(i) {
                /* a turn by half a circle has a positive determinant too: the trace tells it */
                const R trace = made->ua[i] + made->vb[i], area = made->ua[i] * made->vb[i] - made->ub[i] * made->va[i];
                R w = trace < area ? trace : area;
                w = margin[i] < w ? margin[i] : w, w = (trace == trace) & (margin[i] == margin[i]) ? w : -1;
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
        if (c->parts[j].kind == TILT) T(tilt_vjp)(k, n, x[j - 1], y[j - 1], gu, gv, part);
        else if (c->parts[j].kind == SHEAR) {
            if (part) part[0] += T(dot)(n, gv, x[j - 1]), part[1] += T(dot)(n, gu, y[j - 1]);
            EACH(i) {
                const R w = gu[i] + k[0] * gv[i];
                gv[i] += k[1] * gu[i], gu[i] = w;
            }
        } else T(planar_vjp)(c->parts + j, k, c->constants, n, x[j - 1], y[j - 1], gu, gv, part);
    }
}

/* -- the inverse of a radial factor */

/* The factor by which it scales points of squared radius r2, to about 1e-6; `InverseTable` */
static void T(tabulated)(const R *restrict table, int n, const R *restrict r2, R *restrict scale) {
    const R reach2 = table[0], top = (reach2 + 2) / reach2, *restrict values = table + 2, *restrict steps = values + NODES;
    EACH(i) {
        const R x = r2[i] / (r2[i] + 2) * top, left = 1 - x;
        R position = (1 - T(root)(left > 0 ? left : 0)) * NODES;
        position = position >= 0 ? position : 0; /* nor what is not a number */
        const I node = position < NODES - 1 ? (I)position : NODES - 1;
        scale[i] = values[node] + (position - (R)node) * steps[node];
    }
}

/* Newton's method for s R(r2 s^2) = 1 from there; `ok` where the last step was so short that the next is nothing */
static void T(solve)(const Part *part, const R *k, const R *constants, const R *table, int n, const R *restrict r2,
                     R *restrict scale, I *restrict ok) {
    const R shortest = IS_DOUBLE ? (R)1.862645149230957e-09 : (R)4.315837287515549e-05; /* sqrt(eps) / 8 */
    ALIGNED R t[BLOCK], factor[BLOCK], slope[BLOCK];
    T(tabulated)(table, n, r2, scale);
    EACH(i) ok[i] = 0;
    for (int count = 1; count <= MOST_STEPS; count++) {
        I all = 1;
        EACH(i) t[i] = r2[i] * scale[i] * scale[i];
        T(radial)(part, k, constants, n, t, factor, slope);
        EACH(i) {
            const R step = (1 - scale[i] * factor[i]) / (factor[i] + 2 * t[i] * slope[i]);
            /* what is converged stays, whatever else is in its block */
            scale[i] = ok[i] ? scale[i] : scale[i] + step;
            ok[i] |= (shortest * scale[i] - T(absolute)(step) > 0) & (count > IS_DOUBLE);
        }
        EACH(i) all &= ok[i];
        if (all) return;
    }
}

/* The same of few points in a bracket up to the fold: Newton's steps, and every other one halves the bracket */
static void T(bracketed)(const Part *part, const R *k, const R *constants, R inner2, int n, const R *restrict r2,
                         R *restrict scale) {
    const R end = T(root)(inner2);
    ALIGNED R rho[BLOCK], low[BLOCK], high[BLOCK], wanted[BLOCK], width[BLOCK], t[BLOCK], factor[BLOCK], slope[BLOCK];
    ALIGNED I moves[BLOCK];
    EACH(i) {
        wanted[i] = T(root)(r2[i]);
        rho[i] = wanted[i] < end ? wanted[i] : end, low[i] = 0, high[i] = width[i] = end, moves[i] = 1;
    }
    for (int count = 0; count < (IS_DOUBLE ? 208 : 92); count++) {
        I any = 0;
        EACH(i) t[i] = rho[i] * rho[i];
        T(radial)(part, k, constants, n, t, factor, slope);
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
    T(radial)(part, k, constants, n, t, factor, NULL);
    EACH(i) scale[i] = 1 / factor[i];
}

/* How many of a block are 0, their places filled up to whole vectors with the last one */
static int T(chosen)(int n, const I *open, int *places) {
    int count = 0;
    for (int i = 0; i < n; i++)
        if (!open[i]) places[count++] = i;
    for (int i = count; count && i % LANES; i++) places[i] = places[count - 1];
    return count;
}

/* The factor by which an inverted chart scales angles, of squares of these */
static void T(chart_inverse)(const T(Camera) *c, int n, R *restrict theta2, R *restrict found) {
    ALIGNED I ok[BLOCK];
    int places[BLOCK], count;
    T(solve)(c->parts, c->numbers[0], c->constants, c->chart_table, n, theta2, found, ok);
    if ((count = T(chosen)(n, ok, places))) {
        ALIGNED R some[BLOCK], made[BLOCK];
        const int filled = (count + LANES - 1) & -LANES;
        for (int i = 0; i < filled; i++) some[i] = theta2[places[i]];
        T(bracketed)(c->parts, c->numbers[0], c->constants, c->chart_inner2, filled, some, made);
        for (int i = 0; i < count; i++) found[places[i]] = made[i];
    }
}
