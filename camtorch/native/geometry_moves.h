/* Pixels of cameras to those of others, block by block; the rays in between are turned. warp/camera_pair.py */

typedef struct {
    int64_t index; /* of the cameras that these are; -1: none yet */
    T(Camera) from, to;
    R turn[9];
} T(Between);

static void T(between)(const Move *move, int64_t index, T(Between) *b) {
    const int is_first = b->index < 0;
    if (b->index == index) return;
    if (is_first || move->from->cameras > 1) T(prepare)(move->from, move->from->cameras > 1 ? index : 0, &b->from);
    if (is_first || move->to->cameras > 1) T(prepare)(move->to, move->to->cameras > 1 ? index : 0, &b->to);
    const int64_t *strides = move->turn_strides;
    if (move->turns && (is_first || strides[0]))
        for (int i = 0; i < 9; i++)
            b->turn[i] = ((const R *)move->turns)[index * strides[0] + i / 3 * strides[1] + i % 3 * strides[2]];
    b->index = index;
}

/* Pixels (u, v) to those by their rays, `ok` where there is one; flags of what is left to do */
static int T(by_rays)(const Move *move, const T(Between) *b, int count, int n, R *restrict u, R *restrict v,
                      I *restrict ok) {
    ALIGNED I known[BLOCK];
    T(Seen) s;
    int left = 0;
    T(solutions)(&b->from, n, u, v, known, ok, s.x, s.y, s.z);
    if (b->from.waits)
        for (int i = 0; i < count; i++) left |= (!ok[i] & (known[i] != 0)) ? LEFT_FROM : 0;
    if (move->turns) T(product)(b->turn, 1, 3, n, s.x, s.y, s.z);
    left |= T(pixels_of)(&b->to, count, n, &s, u, v) ? LEFT_TO : 0;
    EACH(i) ok[i] &= s.ok[i];
    return left;
}

/* Pixels (u, v) to what `form` says, `ok` where there is any; flags of what is left to do */
static int T(moved)(const Move *move, const T(Between) *b, int count, int n, R *restrict u, R *restrict v,
                    I *restrict ok) {
    ALIGNED R x[BLOCK], y[BLOCK];
    const int left = T(by_rays)(move, b, count, n, u, v, ok);
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

/* The box that encloses the moved outline of another, valid where some of that is on the image. A box is left if it has no
   extent, turns inside out, or some of its outline has no image */
static int T(move_box)(const Move *move, const T(Between) *b, int64_t at) {
    const R *box = (const R *)move->rows + b->index * move->row_strides[0] + at * move->row_strides[1];
    R *made = (R *)move->results + b->index * move->result_strides[0] + at * move->result_strides[1];
    const R x[] = {box[0], box[2], box[2], box[0], box[0]}, y[] = {box[1], box[1], box[3], box[3], box[1]};
    const R right = (R)(move->width - 0.5), below = (R)(move->height - 0.5);
    R before[2] = {0, 0}, start[2] = {0, 0}, area = 0;
    int left = 0, mapped = 1, shown = 0;
    for (int first = 0; first < 4 * EDGE_POINTS; first += BLOCK) {
        ALIGNED R u[BLOCK], v[BLOCK];
        ALIGNED I ok[BLOCK];
        for (int i = 0; i < BLOCK; i++) {
            const int side = (first + i) / EDGE_POINTS;
            const R share = (R)((first + i) % EDGE_POINTS) / EDGE_POINTS;
            u[i] = x[side] + (x[side + 1] - x[side]) * share, v[i] = y[side] + (y[side + 1] - y[side]) * share;
        }
        left |= T(by_rays)(move, b, BLOCK, BLOCK, u, v, ok);
        if (!first) {
            for (int i = 0; i < 2; i++) before[i] = start[i] = made[i] = made[i + 2] = i ? v[0] : u[0];
        }
        for (int i = 0; i < BLOCK; i++) {
            mapped &= ok[i] != 0;
            shown |= (u[i] >= (R)-0.5) & (u[i] <= right) & (v[i] >= (R)-0.5) & (v[i] <= below);
            area += (before[0] - start[0]) * (v[i] - before[1]) - (before[1] - start[1]) * (u[i] - before[0]);
            before[0] = u[i], before[1] = v[i];
            made[0] = u[i] < made[0] ? u[i] : made[0], made[1] = v[i] < made[1] ? v[i] : made[1];
            made[2] = u[i] > made[2] ? u[i] : made[2], made[3] = v[i] > made[3] ? v[i] : made[3];
        }
    }
    move->valid[b->index * move->count + at] = (uint8_t)shown;
    return left | (mapped && shown && area > 0 && box[2] > box[0] && box[3] > box[1] ? 0 : LEFT_LABELS);
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
        for (int64_t i = first; i < end && move->form == BOXES; i++) left |= T(move_box)(move, &b, i);
        for (int64_t i = first; i < end && move->form != BOXES; i += BLOCK)
            left |= T(move_row)(move, &b, i, (int)(end - i < BLOCK ? end - i : BLOCK));
    }
    return left;
}

/* -- lattices */

/* Of quintics through six nodes, the weights of each on the way from a cell's first one to the next */
static void T(weights_of)(float (*weights)[STEP]) {
    for (int j = 0; j < 6; j++)
        for (int k = 0; k < STEP; k++) {
            weights[j][k] = 1;
            for (int m = 0; m < 6; m++)
                if (m != j) weights[j][k] *= ((float)k / STEP + 2 - m) / (j - m);
        }
}

/* All pixels of a cell from 6 x 6 nodes, of which the first is given: down the columns, then across */
INLINE void T(laid)(const float *nodes, int64_t width, const float (*weights)[STEP], R *restrict to) {
    for (int y = 0; y < STEP; y++) {
        float line[6], made[STEP];
        for (int j = 0; j < 6; j++) {
            float sum = 0;
            for (int m = 0; m < 6; m++) sum += weights[m][y] * nodes[m * width + j];
            line[j] = sum;
        }
        for (int k = 0; k < STEP; k++) made[k] = weights[0][k] * line[0];
        for (int j = 1; j < 6; j++)
            for (int k = 0; k < STEP; k++) made[k] += weights[j][k] * line[j];
        for (int k = 0; k < STEP; k++) to[y * STEP + k] = (R)made[k];
    }
}

/* All pixels of some cells, `number` of the first one; where what is mapped ends in one, those around it are next */
static int T(squares)(const Lattices *given, const T(Between) *b, const Classification *asked, const int64_t *places,
                      int count, int64_t number) {
    const int64_t rows = asked->rows, columns = asked->columns;
    int32_t *cells = asked->cells;
    const int n = count * SQUARE;
    ALIGNED R u[BLOCK], v[BLOCK];
    ALIGNED I ok[BLOCK];
    for (int k = 0; k < count; k++)
        for (int i = 0; i < SQUARE; i++) {
            u[k * SQUARE + i] = (R)(STEP * (places[k] % columns) + i % STEP);
            v[k * SQUARE + i] = (R)(STEP * (places[k] / columns) + i / STEP + given->first_row);
        }
    R *across = (R *)given->exact + number * SQUARE, *down = across + given->move.cameras * rows * columns * SQUARE;
    const int left = T(moved)(&given->move, b, n, n, u, v, ok);
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
    const float half[2] = {(float)asked->source_width / 2, (float)asked->source_height / 2};
    int is_off = 0;
    for (int c = 0; c < 2; c++) {
        const R *found = c ? v : u;
        float low = asked->nodes[c * asked->node_strides[1] + first + 2 * (asked->columns + 5) + 2], high = low;
        for (int at = 0; at < PROBES; at++) {
            const float exact = (float)found[at];
            low = exact < low ? exact : low, high = exact > high ? exact : high;
        }
        /* what lies between the places looked at */
        const float reach = (high - low) / 2 + CELL_OFF / half[c];
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

/* All pixels of the cells that quintics are laid in, each from its 6 x 6 nodes */
static void T(lay_quintics)(const Lattices *given, const Classification *asked) {
    const int64_t columns = asked->columns, cells = asked->rows * columns, width = columns + 5;
    R *exact[2] = {(R *)given->exact, (R *)given->exact + given->move.cameras * cells * SQUARE};
    float weights[6][STEP];
    T(weights_of)(weights);
    for (int64_t i = 0; i < cells; i++) {
        if (asked->cells[i] != CELL_QUINTIC) continue;
        const int64_t number = added(given->used, 1);
        asked->cells[i] = (int32_t)number;
        for (int c = 0; c < 2; c++) {
            const float *nodes = asked->nodes + c * asked->node_strides[1] + i / columns * width + i % columns;
            T(laid)(nodes, width, weights, exact[c] + number * SQUARE);
        }
    }
}

static int T(lattice)(const Lattices *given, int64_t camera, T(Between) *b) {
    const Move *move = &given->move;
    Classification asked = given->cells;
    const int64_t cells = asked.rows * asked.columns, nodes = (asked.rows + 5) * (asked.columns + 5);
    const R *at = (const R *)move->results + camera * move->result_strides[0];
    int left = 0;
    T(between)(move, camera, b);
    for (int64_t i = 0; i < move->count; i += BLOCK)
        left |= T(move_row)(move, b, i, (int)(move->count - i < BLOCK ? move->count - i : BLOCK));
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
        if (!asked.cells[i]) asked.cells[i] = CELL_NEXT;
    if ((left = T(settle)(given, b, &asked))) return left;
    int64_t most = 0, found;
    for (int64_t i = 0; i < cells; i++) most += asked.cells[i] == CELL_NEXT;
    if (given->learns ? 5 * most > cells : 8 * most > 7 * cells) return LEFT_MOST;
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
    if (!given->learns) T(lay_quintics)(given, &asked);
    return left;
}

static int64_t T(lattices)(const Lattices *given) {
    int64_t own = 0, at;
    int left = 0;
    T(Between) b;
    b.index = -1;
    while ((at = taken(given->move.next, &own)) < given->move.cameras && !left) {
        left = T(lattice)(given, at, &b);
        const Images images = {given->jobs, left ? 0 : given->job_count, at};
        THIS(sample_images)(&images);
    }
    return left;
}
