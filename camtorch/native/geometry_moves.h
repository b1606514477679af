/* Pixels of cameras to those of others, block by block; the rays in between are turned. warp/grid.py */

typedef struct {
    int64_t index; /* of the cameras that these are; -1: none yet */
    T(Camera) from, to;
    R turn[9];
    const T(Camera) *bent, *plain; /* which of both is the other one with a surface after its lens, NULL where none is */
    R within2;                     /* see `surely2` */
    int is_sure;                   /* while nodes of a lattice are sought whose pixels are all mapped, see `reaches_all` */
    R bend;                        /* of lattices, what a Newton step leaves beside their tolerance; -1: none */
    float cubics[4][STEP], changes[4][STEP]; /* weights of nodes; of both ends, and of changes there */
} T(Between);

/* The squared radius of a circle of a camera's plane in which each point has a ray for certain */
static R T(surely2)(const T(Camera) *c) {
    const int is_bare = !c->parts->map && c->way != INVERTED;
    if (is_bare && !c->stages && c->way == PERSPECTIVE) return SQUARABLE;
    if (!is_bare || c->stages != 1 || c->parts[1].kind != PLANAR || c->parts[1].factor == NO_FACTOR) return 0;
    /* the lens is regular within a circle, and sends that one out of all of a smaller one */
    const T(Plane) k = c->planes[1];
    ALIGNED R t[LANES], factor[LANES];
    R furthest = 0;
    for (int i = 0; i < LANES; i++) t[i] = (R)0.98 * T(least)(c->inner2, c->usual2) / (R)(1 << i);
    T(radial)(c->factors + 1, LANES, t, factor, NULL);
    for (int i = 0; i < LANES; i++) {
        const R across = T(absolute)(k.s0) + T(absolute)(k.s1) * t[i], down = T(absolute)(k.s2) + T(absolute)(k.s3) * t[i];
        const R aside = t[i] * (3 * (T(absolute)(k.px) + T(absolute)(k.py)) + across + down);
        furthest = T(most)(furthest, T(root)(t[i]) * factor[i] - aside);
    }
    return furthest * furthest;
}

/* Whether one camera is the other one with a surface after its lens, regular in all places: then pixels move by that alone,
   wherever the other one has a ray */
static void T(compare)(const Move *move, T(Between) *b) {
    const T(Camera) *from = &b->from, *to = &b->to, *bent = from->stages > to->stages ? from : to, *plain = bent == from ? to : from;
    const int last = plain->stages + 1;
    const int64_t constants = move->from->constant_count;
    b->bent = b->plain = NULL, b->within2 = 0, b->is_sure = 0, b->bend = -1;
    if (move->turns || bent->stages != last || !bent->all_certain || !(from->usable & to->usable)) return;
    if (from->fx != to->fx || from->fy != to->fy || from->cx != to->cx || from->cy != to->cy) return;
    if (memcmp(from->parts, to->parts, (size_t)last * sizeof(Part)) || move->to->constant_count != constants) return;
    if (memcmp(from->map, to->map, (size_t)(bent->numbers[last] - bent->map) * sizeof(R))) return;
    if (constants && memcmp(from->constants, to->constants, (size_t)constants * sizeof(R))) return;
    b->bent = bent, b->plain = plain, b->within2 = T(surely2)(plain);
}

static void T(between)(const Move *move, int64_t index, T(Between) *b) {
    const int is_first = b->index < 0;
    if (b->index == index) return;
    if (is_first || move->from->cameras > 1) T(prepare)(move->from, move->from->cameras > 1 ? index : 0, &b->from);
    if (is_first || move->to->cameras > 1) T(prepare)(move->to, move->to->cameras > 1 ? index : 0, &b->to);
    const int64_t *strides = move->turn_strides;
    if (move->turns && (is_first || strides[0]))
        for (int i = 0; i < 9; i++)
            b->turn[i] = ((const R *)move->turns)[index * strides[0] + i / 3 * strides[1] + i % 3 * strides[2]];
    T(compare)(move, b);
    b->index = index;
}

/* Whether it takes more than is known of a camera to find rays */
static int T(lacks)(const T(Camera) *c) { return c->is_partial || ((c->is_radial || c->by_stages) && !c->table); }

/* Pixels (u, v) to those by their rays, `ok` where there is one; flags of what is left to do */
static int T(by_rays)(const Move *move, const T(Between) *b, int count, int n, R *restrict u, R *restrict v,
                      I *restrict ok) {
    ALIGNED I known[BLOCK];
    T(Seen) s;
    int left = (T(lacks)(&b->from) ? LEFT_FROM : 0) | (b->to.is_partial ? LEFT_TO : 0);
    if (left) {
        EACH(i) ok[i] = 0;
        return left;
    }
    T(solutions)(&b->from, n, u, v, known, ok, s.x, s.y, s.z);
    if (b->from.waits)
        for (int i = 0; i < count; i++) left |= !ok[i] & (known[i] != 0) ? LEFT_FROM : 0;
    if (move->turns) T(product)(b->turn, 1, 3, n, s.x, s.y, s.z);
    left |= T(pixels_of)(&b->to, count, n, &s, u, v) ? LEFT_TO : 0;
    EACH(i) ok[i] &= s.ok[i];
    return left;
}

/* A component of a piece of a surface at a place, and its derivatives by that */
INLINE R T(piece_at)(const R *piece, R x, R y, R *by_x, R *by_y) {
    R value = 0, across = 0, down = 0;
    UNROLLED_LOOP for (int q = 3; q >= 0; q--) { /* powers of x stand in the order 0, 2, 1, 3 */
        const R *k = piece + 8 * q, square = k[6] * x + k[2], line = square * x + k[4];
        down = down * y + value, value = value * y + (line * x + k[0]);
        across = across * y + ((k[6] * x + square) * x + line);
    }
    *by_x = across, *by_y = down;
    return value;
}

/* Where a surface alone sends points that lie together, each vector piece by piece */
static void T(sent_together)(const T(Camera) *c, int n, const R *restrict a, const R *restrict b, R *restrict u, R *restrict v,
                             T(Jacobian) *restrict to) {
    ALIGNED R x[BLOCK], y[BLOCK];
    ALIGNED int32_t at[BLOCK];
    const R *k = c->numbers[c->stages], sa = k[0], sb = k[1];
    const T(Pieces) pieces = T(pieces_on)(c);
    EACH(i) at[i] = T(piece)(pieces, a[i], b[i], x + i, y + i);
    for (int i = 0; i < n; i += LANES) {
        R value[2][LANES] = {{0}}, by_x[2][LANES] = {{0}}, by_y[2][LANES] = {{0}}, s[LANES], t[LANES];
        int32_t piece_at[LANES];
        memcpy(s, x + i, sizeof s), memcpy(t, y + i, sizeof t), memcpy(piece_at, at + i, sizeof piece_at);
        int32_t here = INT32_MAX, next;
        for (int j = 0; j < LANES; j++) here = piece_at[j] < here ? piece_at[j] : here;
        for (; here < INT32_MAX; here = next) {
            R piece[PIECE];
            memcpy(piece, c->pieces + (int64_t)PIECE * here, sizeof piece);
            for (int axis = 0; axis < 2; axis++)
                for (int j = 0; j < LANES; j++) {
                    R across, down;
                    const R found = T(piece_at)(piece + axis, s[j], t[j], &across, &down);
                    const int is_in = piece_at[j] == here;
                    value[axis][j] = is_in ? found : value[axis][j];
                    by_x[axis][j] = is_in ? across : by_x[axis][j], by_y[axis][j] = is_in ? down : by_y[axis][j];
                }
            next = INT32_MAX;
            for (int j = 0; j < LANES; j++) next = piece_at[j] > here && piece_at[j] < next ? piece_at[j] : next;
        }
        for (int j = 0; j < LANES; j++) {
            u[i + j] = a[i + j] + value[0][j], v[i + j] = b[i + j] + value[1][j];
            to->ua[i + j] = by_x[0][j] * sa + 1, to->ub[i + j] = by_y[0][j] * sb;
            to->va[i + j] = by_x[1][j] * sa, to->vb[i + j] = by_y[1][j] * sb + 1;
        }
    }
}

/* `by_rays` of cameras that differ by a surface: by that alone, where the other one has a ray */
static int T(by_surface)(const Move *move, const T(Between) *b, int count, int n, R *restrict u, R *restrict v,
                         I *restrict ok) {
    const T(Camera) *c = b->bent, *plain = b->plain;
    const int is_inverse = c == &b->from, of_plain = is_inverse ? LEFT_TO : LEFT_FROM;
    const R fx = c->fx, fy = c->fy, cx = c->cx, cy = c->cy, by_fx = 1 / fx, by_fy = 1 / fy, within2 = b->within2;
    const R further = is_inverse ? 1 + 32 * EPS : 1, behind = (R)c->parts[c->stages].constant;
    const T(Edge) edge = c->box;
    ALIGNED R x[BLOCK], y[BLOCK], p[BLOCK], q[BLOCK], some_u[BLOCK], some_v[BLOCK];
    ALIGNED I settled[BLOCK], on[BLOCK], known[BLOCK], found[BLOCK];
    int places[BLOCK], left = 0, some;
    EACH(i) x[i] = (u[i] - cx) * by_fx, y[i] = (v[i] - cy) * by_fy;
    if (is_inverse) {
        T(start)(c, c->stages, n, x, y, p, q);
        T(newton)(c, c->stages, n, x, y, p, q, settled, (IS_DOUBLE ? 3 : 2) - !!c->pieces);
    } else T(stage)(c, c->stages, n, x, y, p, q, NULL);
    if (b->is_sure) { /* behind its edge the surface goes on */
        EACH(i) x[i] = fx * p[i], y[i] = fy * q[i];
        EACH(i) u[i] = x[i] + cx, v[i] = y[i] + cy, ok[i] = settled[i];
        return 0;
    }
    const R *a = is_inverse ? p : x, *e = is_inverse ? q : y; /* on the surface's plane, where pixels of `plain` are */
    EACH(i) {
        on[i] = T(on_edge)(edge, a[i] * further, e[i] * further);
        /* behind the edge there is nothing; but a solution there need not be the only one */
        const I off = !(T(surface_edge)(c->parts + c->stages, c->numbers[c->stages], behind, a[i], e[i]) > 0);
        settled[i] = is_inverse ? settled[i] & on[i] : on[i] | off;
        ok[i] = settled[i] & on[i] & (within2 - (a[i] * a[i] + e[i] * e[i]) > 0);
    }
    EACH(i) found[i] = ok[i] | !(settled[i] & on[i]);
    if ((some = T(chosen)(n, found, places))) {
        T(Seen) s;
        const int filled = (some + LANES - 1) & -LANES;
        if (T(lacks)(plain)) left = of_plain;
        for (int i = 0; i < filled; i++) some_u[i] = a[places[i]] * fx + cx, some_v[i] = e[places[i]] * fy + cy;
        if (!left) T(solutions)(plain, filled, some_u, some_v, known, found, s.x, s.y, s.z);
        for (int i = 0; i < some && !left; i++) {
            ok[places[i]] = found[i];
            left |= plain->waits && !found[i] && known[i] ? of_plain : 0;
        }
    }
    EACH(i) x[i] = fx * p[i], y[i] = fy * q[i];
    EACH(i) p[i] = x[i] + cx, q[i] = y[i] + cy; /* not at once, see `pixels_of` */
    if ((some = T(chosen)(n, settled, places))) {
        const int filled = (some + LANES - 1) & -LANES;
        for (int i = 0; i < filled; i++) some_u[i] = u[places[i]], some_v[i] = v[places[i]];
        left |= T(by_rays)(move, b, some, filled, some_u, some_v, found);
        for (int i = 0; i < some; i++) p[places[i]] = some_u[i], q[places[i]] = some_v[i], ok[places[i]] = found[i];
    }
    EACH(i) u[i] = p[i], v[i] = q[i];
    return left;
}

/* Pixels (u, v) to what `form` says, `ok` where there is any; flags of what is left to do */
static int T(moved)(const Move *move, const T(Between) *b, int count, int n, R *restrict u, R *restrict v,
                    I *restrict ok) {
    ALIGNED R x[BLOCK], y[BLOCK];
    const int left = b->bent ? T(by_surface)(move, b, count, n, u, v, ok) : T(by_rays)(move, b, count, n, u, v, ok);
    if (move->form == POSITIONS) {
        const R across = (R)(2 / move->width), down = (R)(2 / move->height), far = FAR;
        const R right = (R)(1 / move->width - 1), below = (R)(1 / move->height - 1);
        EACH(i) x[i] = u[i] * across, y[i] = v[i] * down; /* not at once, see `pixels_of` */
        EACH(i) {
            const R s = x[i] + right, t = y[i] + below;
            u[i] = !ok[i] ? OUTSIDE : s < -far ? -far : s > far ? far : s;
            v[i] = !ok[i] ? OUTSIDE : t < -far ? -far : t > far ? far : t;
        }
        return left;
    }
    EACH(i) u[i] = ok[i] ? u[i] : -1, v[i] = ok[i] ? v[i] : -1;
    if (move->form == ON_IMAGE) {
        const R low = (R)-0.5, right = (R)(move->width - 0.5), below = (R)(move->height - 0.5);
        EACH(i) ok[i] &= (u[i] >= low) & (u[i] <= right) & (v[i] >= low) & (v[i] <= below);
    }
    return left;
}

static int T(move_row)(const Move *move, const T(Between) *b, int64_t first, int count) {
    const int n = (count + LANES - 1) & -LANES;
    const int64_t *from = move->row_strides, *to = move->result_strides;
    ALIGNED R u[BLOCK], v[BLOCK];
    ALIGNED I ok[BLOCK];
    T(load_pixels)((const R *)move->rows + b->index * from[0] + first * from[1], from, count, n, u, v, b->from.cx,
                   b->from.cy);
    const int left = T(moved)(move, b, count, n, u, v, ok);
    T(store)((R *)move->results + b->index * to[0] + first * to[1], to, 2, count, u, v, NULL);
    uint8_t *valid = move->valid + b->index * move->count + first;
    for (int i = 0; i < count; i++) valid[i] = (uint8_t)ok[i];
    return left;
}

static int64_t T(moves)(const Move *move) {
    const int64_t tiles = (move->count + move->tile - 1) / move->tile;
    int64_t own = 0, at;
    int left = 0;
    T(Between) b;
    b.index = -1;
    while ((at = taken(move->next, &own)) < tiles * move->cameras) {
        const int64_t first = at % tiles * move->tile;
        const int64_t end = first + move->tile < move->count ? first + move->tile : move->count;
        T(between)(move, at / tiles, &b);
        for (int64_t i = first; i < end; i += BLOCK)
            left |= T(move_row)(move, &b, i, (int)(end - i < BLOCK ? end - i : BLOCK));
    }
    return left;
}

/* -- lattices */

/* Of polynomials through `count` nodes, the weights of each on the way from a cell's first one to the next */
static void T(weights_of)(const int count, float (*weights)[STEP]) {
    for (int j = 0; j < count; j++)
        for (int k = 0; k < STEP; k++) {
            weights[j][k] = 1;
            for (int m = 0; m < count; m++)
                if (m != j) weights[j][k] *= ((float)k / STEP + count / 2 - 1 - m) / (j - m);
        }
}

/* All pixels of a cell from `count` x `count` nodes, of which the first is given: down the columns, then across */
INLINE void T(laid)(const float *nodes, int64_t width, const int count, const float (*weights)[STEP], R *restrict to) {
    for (int y = 0; y < STEP; y++) {
        float line[6], made[STEP];
        for (int j = 0; j < count; j++) {
            float sum = 0;
            for (int m = 0; m < count; m++) sum += weights[m][y] * nodes[m * width + j];
            line[j] = sum;
        }
        for (int k = 0; k < STEP; k++) made[k] = weights[0][k] * line[0];
        for (int j = 1; j < count; j++)
            for (int k = 0; k < STEP; k++) made[k] += weights[j][k] * line[j];
        for (int k = 0; k < STEP; k++) to[y * STEP + k] = (R)made[k];
    }
}

/* Positions on an image of that size to points of a camera's plane: times, and plus */
INLINE void T(plane_of)(const Move *move, const T(Camera) *c, R *times, R *plus) {
    times[0] = (R)(move->width / 2) / c->fx, times[1] = (R)(move->height / 2) / c->fy;
    plus[0] = times[0] - ((R)0.5 + c->cx) / c->fx, plus[1] = times[1] - ((R)0.5 + c->cy) / c->fy;
}

/* From pixels (u, v), and positions near those to which the surface moves them, to the latter as near as a lattice wants
   them, in place; 0 where that does not lead there */
static int T(refined)(const Move *move, const T(Between) *b, int n, const R *restrict u, const R *restrict v,
                      R (*restrict near)[BLOCK]) {
    const T(Camera) *c = b->bent;
    const R by_fx = 1 / c->fx, by_fy = 1 / c->fy, cx = c->cx, cy = c->cy, bend = b->bend;
    R k[2], l[2];
    ALIGNED R a[BLOCK], e[BLOCK], p[BLOCK], q[BLOCK];
    T(Jacobian) to;
    T(plane_of)(move, c, k, l);
    for (int count = 0; count < MOST_STEPS; count++) {
        I all = 1;
        EACH(i) a[i] = near[0][i] * k[0] + l[0], e[i] = near[1][i] * k[1] + l[1];
        T(sent_together)(c, n, a, e, p, q, &to);
        EACH(i) {
            R da, db;
            const R ua = to.ua[i], ub = to.ub[i], va = to.va[i], vb = to.vb[i];
            const R one = T(absolute)(T(step)(ua, ub, va, vb, (u[i] - cx) * by_fx - p[i], (v[i] - cy) * by_fy - q[i], &da, &db));
            const R off = bend * (da * da + db * db) * one;
            near[0][i] += da / k[0], near[1][i] += db / k[1];
            all &= (1 - off * off * (ua * ua + ub * ub + va * va + vb * vb) > 0) & (one > 0);
        }
        if (all) return 1;
    }
    return 0;
}

/* All pixels of some cells, `number` of the first one; where what is mapped ends in one, those around it are next */
static int T(squares)(const Lattices *given, const T(Between) *b, const Classification *asked, const int64_t *places,
                      int count, int64_t number) {
    const int64_t rows = asked->rows, columns = asked->columns, width = columns + 5;
    int32_t *cells = asked->cells;
    const int n = count * SQUARE;
    ALIGNED R u[BLOCK], v[BLOCK], near[2][BLOCK];
    ALIGNED I ok[BLOCK];
    int is_near = b->bend >= 0, left = 0;
    for (int k = 0; k < count; k++) {
        const int64_t first = (places[k] / columns + 1) * width + places[k] % columns + 1; /* of 4 x 4 nodes */
        for (int i = 0; i < SQUARE; i++) {
            u[k * SQUARE + i] = (R)(STEP * (places[k] % columns) + i % STEP);
            v[k * SQUARE + i] = (R)(STEP * (places[k] / columns) + i / STEP + given->first_row);
        }
        for (int i = 0; i < 16; i++) is_near &= asked->mapped[first + i / 4 * width + i % 4];
        for (int c = 0; c < 2 && is_near; c++)
            T(laid)(asked->nodes + c * asked->node_strides[1] + first, width, 4, b->cubics, near[c] + k * SQUARE);
    }
    R *across = (R *)given->exact + number * SQUARE, *down = across + given->move.cameras * rows * columns * SQUARE;
    if (is_near && T(refined)(&given->move, b, n, u, v, near)) {
        memcpy(across, near[0], (size_t)n * sizeof(R)), memcpy(down, near[1], (size_t)n * sizeof(R));
        for (int k = 0; k < count; k++) cells[places[k]] = (int32_t)(number + k);
        return 0;
    }
    left = T(moved)(&given->move, b, n, n, u, v, ok);
    for (int i = 0; i < n; i++) across[i] = ok[i] ? u[i] : NAN, down[i] = ok[i] ? v[i] : NAN;
    for (int k = 0; k < count; k++) {
        const int64_t i = places[k] / columns, j = places[k] % columns;
        int known = 0;
        for (int at = 0; at < SQUARE; at++) known += ok[k * SQUARE + at] != 0;
        cells[places[k]] = (int32_t)(number + k);
        if (known == 0 || known == SQUARE) continue;
        for (int64_t y = i > 0 ? i - 1 : 0; y <= i + 1 && y < rows; y++)
            for (int64_t x = j > 0 ? j - 1 : 0; x <= j + 1 && x < columns; x++) {
                int32_t *at = cells + y * columns + x;
                if (*at == CELL_EMPTY || *at == CELL_CUBIC || *at == CELL_QUINTIC) *at = CELL_NEXT;
            }
    }
    return left;
}

/* In the middle of four nodes, or of six, from the first one on */
INLINE float T(middle)(const float *p, int64_t step, int count) {
    if (count == 4) return (9 * (p[step] + p[2 * step]) - (p[0] + p[3 * step])) / 16;
    return (150 * (p[2 * step] + p[3 * step]) - 25 * (p[step] + p[4 * step]) + 3 * (p[0] + p[5 * step])) / 256;
}

/* What `count` x `count` nodes say of a cell's middle, the middles of its sides before that; node: its first corner */
INLINE void T(middles)(const float *node, int64_t width, const int count, float *at) {
    const int64_t before = count / 2 - 1;
    float line[6];
    for (int k = 0; k < count; k++) line[k] = T(middle)(node + (k - before) * width - before, 1, count);
    at[0] = line[before], at[3] = line[before + 1], at[4] = T(middle)(line, 1, count);
    at[1] = T(middle)(node - before * width, width, count), at[2] = T(middle)(node - before * width + 1, width, count);
}

/* By how much, in pixels and squared, what `count` x `count` nodes say misses what was found: of each coordinate, and of
   both */
static float T(most_missed)(const Classification *asked, int64_t first, const int count, const R *u, const R *v,
                            float *of_each) {
    const float half[2] = {(float)asked->source_width / 2, (float)asked->source_height / 2};
    const int64_t width = asked->columns + 5;
    float said[2][PROBES], most = 0;
    for (int c = 0; c < 2; c++)
        T(middles)(asked->nodes + c * asked->node_strides[1] + first + 2 * width + 2, width, count, said[c]);
    of_each[0] = of_each[1] = 0;
    for (int at = 0; at < PROBES; at++) {
        const float across = ((float)u[at] - said[0][at]) * half[0], down = ((float)v[at] - said[1][at]) * half[1];
        const float u2 = across * across, v2 = down * down;
        of_each[0] = u2 > of_each[0] ? u2 : of_each[0], of_each[1] = v2 > of_each[1] ? v2 : of_each[1];
        most = u2 + v2 <= most ? most : u2 + v2; /* or what is not a number */
    }
    return most;
}

/* Whether a cell lies far off the image; missed: by how much cubics miss each coordinate, squared */
static int T(is_off)(const Classification *asked, int64_t first, const R *u, const R *v, const float *missed) {
    const float half[2] = {(float)asked->source_width / 2, (float)asked->source_height / 2}, pixels = 4; /* two would do */
    int is_off = 0;
    for (int c = 0; c < 2; c++) {
        const R *found = c ? v : u;
        float low = asked->nodes[c * asked->node_strides[1] + first + 2 * (asked->columns + 5) + 2], high = low;
        for (int at = 0; at < PROBES; at++) {
            const float exact = (float)found[at];
            low = exact < low ? exact : low, high = exact > high ? exact : high;
        }
        /* what lies between the places looked at */
        const float reach = (high - low) / 2 + pixels / half[c];
        is_off |= (missed[c] < 1) & ((high + reach < -1) | (low - reach > 1));
    }
    return is_off;
}

/* Whether all 6 x 6 nodes around a cell are mapped, of which the first is given */
static int T(is_inside)(const Classification *asked, int64_t first) {
    static const uint8_t all[6] = {1, 1, 1, 1, 1, 1};
    for (int y = 0; y < 6; y++)
        if (memcmp(asked->mapped + first + y * (asked->columns + 5), all, sizeof all)) return 0;
    return 1;
}

/* What becomes of cells in doubt: polynomials miss most in the middle of a cell and of its sides. Where half the tolerance
 * is kept there, or an image that ends in zeros is far off, cubics do; or quintics, through six nodes; the other cells are
 * to be computed */
static int T(settle)(const Lattices *given, const T(Between) *b, const Classification *asked) {
    static const int across[PROBES] = {1, 0, 2, 1, 1}, down[PROBES] = {0, 1, 1, 2, 1};
    const int64_t columns = asked->columns, cells = asked->rows * columns, width = columns + 5;
    const float limit = (float)(asked->tolerance * asked->tolerance) / 4;
    int64_t places[BLOCK / PROBES], i = 0;
    ALIGNED R u[BLOCK], v[BLOCK];
    ALIGNED I ok[BLOCK];
    int left = 0;
    while (i < cells) {
        int count = 0;
        for (; i < cells && count < BLOCK / PROBES; i++)
            if (asked->cells[i] == CELL_DOUBT) places[count++] = i;
        const int points = count * PROBES, n = (points + LANES - 1) & -LANES;
        for (int k = 0; k < n; k++) { /* the last one again, up to whole vectors */
            const int64_t place = places[(k < points ? k : points - 1) / PROBES];
            u[k] = (R)(STEP * (place % columns) + STEP / 2 * across[k % PROBES]);
            v[k] = (R)(STEP * (place / columns) + STEP / 2 * down[k % PROBES] + given->first_row);
        }
        if (count) left |= T(moved)(&given->move, b, points, n, u, v, ok);
        for (int k = 0; k < count; k++) {
            const R *found_u = u + k * PROBES, *found_v = v + k * PROBES;
            const int64_t first = places[k] / columns * width + places[k] % columns; /* of its 6 x 6 nodes */
            float of_each[2];
            int known = 1, cell = CELL_NEXT;
            for (int at = 0; at < PROBES; at++) known &= ok[k * PROBES + at] != 0;
            const float by_cubics = T(most_missed)(asked, first, 4, found_u, found_v, of_each);
            if (known && (by_cubics <= limit || (asked->padding == ZEROS && T(is_off)(asked, first, found_u, found_v, of_each)))) {
                cell = CELL_CUBIC;
            } else if (known) {
                /* a quarter of that, and of what cubics miss: where the curvature steps, quintics gain nothing, and swing */
                if (T(is_inside)(asked, first) && T(most_missed)(asked, first, 6, found_u, found_v, of_each) <= limit / 16) cell = CELL_QUINTIC;
            }
            asked->cells[places[k]] = cell;
        }
    }
    return left;
}

/* Four rows of nodes, of each coordinate: positions, and by how much they change on the way to the next nodes */
typedef struct {
    const float *at[2][4], *across[2][4], *down[2][4];
} T(Nodes);

/* Those from a row on; of each eight rows in turn the changes have their place */
static T(Nodes) T(nodes_from)(const Classification *asked, int64_t first) {
    const int64_t width = asked->columns + 5;
    T(Nodes) found;
    for (int i = 0; i < 8; i++) {
        const int64_t c = i / 4, row = first + i % 4;
        found.at[c][i % 4] = asked->nodes + c * asked->node_strides[1] + row * width;
        found.across[c][i % 4] = asked->scratch + (row % 8 * 4 + c) * width;
        found.down[c][i % 4] = found.across[c][i % 4] + 2 * width;
    }
    return found;
}

/* The changes of a row of nodes, as the slopes of the surface say */
static void T(add_changes)(const Move *move, const T(Between) *b, const Classification *asked, int64_t row) {
    const T(Nodes) here = T(nodes_from)(asked, row);
    const int64_t width = asked->columns + 5;
    float *to = asked->scratch + row % 8 * 4 * width;
    R k[2], l[2];
    ALIGNED R x[BLOCK], y[BLOCK], p[BLOCK], q[BLOCK];
    T(Jacobian) by;
    T(plane_of)(move, b->bent, k, l);
    for (int64_t first = 0; first < width; first += BLOCK, to += BLOCK) {
        const int some = (int)(width - first < BLOCK ? width - first : BLOCK), n = (some + LANES - 1) & -LANES;
        for (int i = 0; i < n; i++) {
            const int64_t at = first + (i < some ? i : some - 1);
            x[i] = (R)here.at[0][0][at] * k[0] + l[0], y[i] = (R)here.at[1][0][at] * k[1] + l[1];
        }
        T(sent_together)(b->bent, n, x, y, p, q, &by);
        for (int i = 0; i < some; i++) { /* positions by pixels, the inverse */
            const R one = STEP / (by.ua[i] * by.vb[i] - by.ub[i] * by.va[i]), across = one / b->bent->fx, down = one / b->bent->fy;
            to[i] = (float)(by.vb[i] * across / k[0]), to[width + i] = (float)(-by.va[i] * across / k[1]);
            to[2 * width + i] = (float)(-by.ub[i] * down / k[0]), to[3 * width + i] = (float)(by.ua[i] * down / k[1]);
        }
    }
}

/* Between two values, by how much they change */
INLINE float T(halfway)(float first, float second, float change, float next_change) {
    return (first + second) / 2 + (change - next_change) / 8;
}

/* At node k of row r, by how much changes across change on the way down, and the other way round */
INLINE float T(twist)(const float *const *across, const float *const *down, int r, int64_t k) {
    return ((across[r + 1][k] - across[r - 1][k]) + (down[r][k + 1] - down[r][k - 1])) / 4;
}

/* Adds, of a coordinate and of the cell at the k-th of its nodes, by how much what cubics say in its middle and in those of
   its sides misses what changes at its corners say, in pixels and squared */
INLINE void T(add_missed)(const float *const *at, const float *const *across, const float *const *down, int64_t k, float half,
                          float *missed) {
    float line[4], said[2], change[2];
    UNROLLED_LOOP for (int r = 0; r < 4; r++) line[r] = T(middle)(at[r] + k - 1, 1, 4);
    UNROLLED_LOOP for (int i = 0; i < 2; i++) {
        const int r = 1 + i;
        const int64_t j = k + i;
        said[i] = T(halfway)(at[r][k], at[r][k + 1], across[r][k], across[r][k + 1]);
        change[i] = T(halfway)(down[r][k], down[r][k + 1], T(twist)(across, down, r, k), T(twist)(across, down, r, k + 1));
        const float side[4] = {at[0][j], at[1][j], at[2][j], at[3][j]};
        const float beside = (T(halfway)(side[1], side[2], down[1][j], down[2][j]) - T(middle)(side, 1, 4)) * half;
        const float above = (said[i] - line[r]) * half;
        missed[i] += above * above, missed[2 + i] += beside * beside;
    }
    const float within = (T(halfway)(said[0], said[1], change[0], change[1]) - T(middle)(line, 1, 4)) * half;
    missed[4] += within * within;
}

/* Of the cells of a row, the largest of that */
static NOT_INLINE void T(judge)(T(Nodes) from, int64_t columns, const float *half, float *restrict missed) {
    for (int64_t j = 0; j < columns; j++) {
        float of[PROBES] = {0}, most = 0;
        UNROLLED_LOOP for (int c = 0; c < 2; c++)
            T(add_missed)(from.at[c], from.across[c], from.down[c], j + 2, half[c], of);
        UNROLLED_LOOP for (int k = 0; k < PROBES; k++) most = of[k] <= most ? most : of[k]; /* or what is not a number */
        missed[j] = most;
    }
}

/* All pixels of a cell from its corners and the changes there */
static void T(lay_changes)(const T(Nodes) *from, int64_t cell, const float (*weights)[STEP], R *const *to) {
    for (int c = 0; c < 2; c++) {
        float corners[16];
        for (int k = 0; k < 4; k++) {
            const int r = 1 + k / 2, at = k / 2 * 4 + k % 2;
            const int64_t node = cell + 2 + k % 2;
            corners[at] = from->at[c][r][node], corners[at + 2] = from->across[c][r][node];
            corners[at + 8] = from->down[c][r][node];
            corners[at + 10] = T(twist)(from->across[c], from->down[c], r, node);
        }
        T(laid)(corners, 4, 4, weights, to[c]);
    }
}

/* Of cells in doubt that pixels reach by a surface, within. What changes at the corners say misses a quarter of what cubics
   through the nodes miss, and less where no curvature steps, so that the difference of both tells of either; but where it
   changes its sign, that of the cells around */
static void T(settle_by_changes)(const Lattices *given, const T(Between) *b, const Classification *asked, int is_sure) {
    const int64_t rows = asked->rows, columns = asked->columns, width = columns + 5;
    const float half[2] = {(float)asked->source_width / 2, (float)asked->source_height / 2};
    const float limit = (float)(asked->tolerance * asked->tolerance), near = limit * 9 / 64, far = limit * 4;
    R *exact[2] = {(R *)given->exact, (R *)given->exact + given->move.cameras * rows * columns * SQUARE};
    float *missed = asked->scratch + 32 * width, *around = missed + 4 * width;
    int64_t made = 0, judged = 0;
    for (int64_t i = 0; i < rows; i++) {
        int32_t *cells = asked->cells + i * columns;
        const int64_t before = i > 0 ? i - 1 : 0, behind = i + 1 < rows ? i + 1 : i;
        int64_t j = 0;
        while (j < columns && cells[j] != CELL_DOUBT) j++;
        if (j == columns) continue;
        for (judged = judged > before ? judged : before; judged <= behind; judged++) {
            for (made = made > judged + 1 ? made : judged + 1; made < judged + 5; made++) T(add_changes)(&given->move, b, asked, made);
            T(judge)(T(nodes_from)(asked, judged + 1), columns, half, missed + judged % 4 * width);
        }
        const float *here = missed + i % 4 * width, *above = missed + before % 4 * width, *below = missed + behind % 4 * width;
        for (j = 0; j < columns; j++) around[j + 1] = fmaxf(here[j], fmaxf(above[j], below[j]));
        around[0] = around[columns + 1] = 0;
        const T(Nodes) from = T(nodes_from)(asked, i + 1);
        for (j = 0; j < columns; j++) {
            if (cells[j] != CELL_DOUBT || !(is_sure || T(is_inside)(asked, i * width + j))) continue;
            const float most = fmaxf(fmaxf(around[j], around[j + 1]), around[j + 2]) / 16;
            const float miss = most > here[j] ? most : here[j]; /* or what is not a number */
            cells[j] = miss <= near ? CELL_CUBIC : miss <= far ? (int32_t)added(given->used, 1) : CELL_NEXT;
            if (cells[j] < 0) continue;
            R *const to[2] = {exact[0] + (int64_t)cells[j] * SQUARE, exact[1] + (int64_t)cells[j] * SQUARE};
            T(lay_changes)(&from, j, b->changes, to);
        }
    }
}

/* All pixels of the cells that quintics are laid in, each from its 6 x 6 nodes */
static void T(lay_quintics)(const Lattices *given, const Classification *asked) {
    const int64_t columns = asked->columns, cells = asked->rows * columns, width = columns + 5;
    R *exact[2] = {(R *)given->exact, (R *)given->exact + given->move.cameras * cells * SQUARE};
    float weights[6][STEP];
    T(weights_of)(6, weights);
    for (int64_t i = 0; i < cells; i++) {
        if (asked->cells[i] != CELL_QUINTIC) continue;
        const int64_t number = added(given->used, 1);
        asked->cells[i] = (int32_t)number;
        for (int c = 0; c < 2; c++) {
            const float *nodes = asked->nodes + c * asked->node_strides[1] + i / columns * width + i % columns;
            T(laid)(nodes, width, 6, weights, exact[c] + number * SQUARE);
        }
    }
}

/* Whether all pixels of the image lie so far inside of what a surface and the camera before it show that none is moved
   out of that: no further than its furthest control point is */
static int T(reaches_all)(const Lattices *given, const T(Between) *b) {
    const T(Camera) *c = b->bent;
    const Part *last = c->parts + c->stages;
    const T(Edge) edge = c->box;
    const R *k = c->numbers[c->stages] + 4;
    R most[2] = {0, 0};
    for (int i = 0; i < 2 * last->n * last->m; i++) most[i % 2] = T(most)(most[i % 2], T(absolute)(k[i]));
    for (int i = 0; i < 4; i++) {
        const R u = i % 2 ? (R)(given->cells.width - 1) : 0;
        const R v = (R)given->first_row + (i / 2 ? (R)(given->cells.height - 1) : 0);
        const R a = (u - c->cx) / c->fx + (i % 2 ? most[0] : -most[0]), e = (v - c->cy) / c->fy + (i / 2 ? most[1] : -most[1]);
        if (!T(on_edge)(edge, a, e) || !(b->within2 - (a * a + e * e) > 0)) return 0;
    }
    return 1;
}

static int T(lattice)(const Lattices *given, int64_t camera, T(Between) *b) {
    const Move *move = &given->move;
    Classification asked = given->cells;
    const int64_t cells = asked.rows * asked.columns, nodes = (asked.rows + 5) * (asked.columns + 5);
    const R *at = (const R *)move->results + camera * move->result_strides[0];
    int64_t wanted = move->count;
    int left = 0, is_sure = 0;
    T(between)(move, camera, b);
    if (b->bent == &b->from && b->bent->pieces) { /* to a quarter of the tolerance, as cells are held to half of it */
        const R focal = T(most)(T(absolute)(b->bent->fx), T(absolute)(b->bent->fy));
        b->bend = 2 * focal / (R)asked.tolerance * b->bent->curve;
        T(weights_of)(4, b->cubics);
        for (int k = 0; k < STEP; k++) {
            const float t = (float)k / STEP, s = 1 - t;
            b->changes[0][k] = (1 + 2 * t) * s * s, b->changes[1][k] = (1 + 2 * s) * t * t;
            b->changes[2][k] = t * s * s, b->changes[3][k] = -s * t * t;
        }
        if ((b->is_sure = is_sure = T(reaches_all)(given, b))) {
            wanted = nodes; /* not those at the rim */
            memset(move->valid + camera * move->count + nodes, 1, (size_t)(move->count - nodes));
        }
    }
    for (int64_t i = 0; i < wanted; i += BLOCK)
        left |= T(move_row)(move, b, i, (int)(wanted - i < BLOCK ? wanted - i : BLOCK));
    b->is_sure = 0;
    if (left) return left;
    asked.count = 1, asked.cells += camera * cells, asked.mapped = move->valid + camera * move->count;
    asked.rim = asked.mapped + nodes, asked.nodes = (const float *)at;
    asked.scratch += camera * SCRATCH * (asked.columns + 8);
    if (given->narrow) {
        float *to = given->narrow + 2 * camera * nodes;
        for (int64_t i = 0; i < nodes; i++) to[i] = (float)at[i], to[nodes + i] = (float)at[move->result_strides[2] + i];
        asked.nodes = to, asked.node_strides[1] = nodes;
    }
    THIS(classify)(&asked);
    for (int64_t i = 0; i < cells; i++)
        if (!asked.cells[i] || (is_sure && asked.cells[i] == CELL_EMPTY)) asked.cells[i] = CELL_NEXT;
    if (b->bend >= 0) T(settle_by_changes)(given, b, &asked, is_sure);
    if ((left = T(settle)(given, b, &asked))) return left;
    int64_t most = 0, found;
    for (int64_t i = 0; i < cells; i++) most += asked.cells[i] == CELL_NEXT;
    if (b->bend < 0 && 8 * most > 7 * cells) return LEFT_MOST;
    do { /* those that are next turn up ahead, and behind */
        int64_t places[BLOCK / SQUARE];
        int count = 0;
        found = 0;
        for (int64_t i = 0; i < cells || count; i++) {
            if (i < cells && asked.cells[i] == CELL_NEXT) places[count++] = i;
            if (count < BLOCK / SQUARE && (i < cells || !count)) continue;
            left |= T(squares)(given, b, &asked, places, count, added(given->used, count));
            found += count, count = 0;
        }
    } while (found);
    T(lay_quintics)(given, &asked);
    return left;
}

static int64_t T(lattices)(const Lattices *given) {
    int64_t own = 0, at;
    int left = 0;
    T(Between) b;
    b.index = -1;
    while ((at = taken(given->move.next, &own)) < given->move.cameras && !left) {
        left = T(lattice)(given, at, &b);
        for (int64_t i = 0; i < given->job_count && !left; i++) THIS(sample_image)(given->jobs + i, at);
    }
    return left;
}
