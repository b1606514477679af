/* Pixels of cameras to those of others, block by block; the rays in between are turned. warp/grid.py */

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
    if (move->turns && (is_first || move->turn_stride))
        memcpy(b->turn, (const R *)move->turns + index * move->turn_stride, sizeof b->turn);
    b->index = index;
}

/* Pixels (u, v) to what `form` says, `ok` where there is any; flags of what is left to do */
static int T(moved)(const Move *move, const T(Between) *b, int count, int n, R *restrict u, R *restrict v,
                    I *restrict ok) {
    ALIGNED I known[BLOCK];
    T(Seen) s;
    int left = 0;
    T(solutions)(&b->from, n, u, v, known, ok, s.x, s.y, s.z);
    if (b->from.follows)
        for (int i = 0; i < count; i++) left |= !ok[i] & (known[i] != 0) ? LEFT_OPEN : 0;
    if (move->turns) {
        const R *t = b->turn;
        EACH(i) {
            const R x = s.x[i], y = s.y[i], z = s.z[i];
            s.x[i] = t[0] * x + t[1] * y + t[2] * z;
            s.y[i] = t[3] * x + t[4] * y + t[5] * z;
            s.z[i] = t[6] * x + t[7] * y + t[8] * z;
        }
    }
    left |= T(pixels_of)(&b->to, count, n, &s, u, v) ? LEFT_WAITING : 0;
    EACH(i) ok[i] &= s.ok[i];
    if (move->form == POSITIONS) {
        const R across = (R)(2 / move->width), down = (R)(2 / move->height), far = FAR;
        const R right = (R)(1 / move->width - 1), below = (R)(1 / move->height - 1);
        EACH(i) s.x[i] = u[i] * across, s.y[i] = v[i] * down; /* not at once, see `pixels_of` */
        EACH(i) {
            const R p = s.x[i] + right, q = s.y[i] + below;
            u[i] = !ok[i] ? OUTSIDE : p < -far ? -far : p > far ? far : p;
            v[i] = !ok[i] ? OUTSIDE : q < -far ? -far : q > far ? far : q;
        }
        return left;
    }
    EACH(i) u[i] = ok[i] ? u[i] : -1, v[i] = ok[i] ? v[i] : -1;
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

/* Gives a cell its place; where what is mapped ends in it, those around it are next */
static void T(settle)(const Move *move, const int64_t *place, int64_t number, int known) {
    const int64_t rows = move->cell_rows, columns = move->cell_columns, i = place[1], j = place[2];
    int32_t *cells = move->cells + place[0] * rows * columns;
    cells[i * columns + j] = (int32_t)number;
    if (known == 0 || known == SQUARE) return;
    for (int64_t y = i > 0 ? i - 1 : 0; y <= i + 1 && y < rows; y++)
        for (int64_t x = j > 0 ? j - 1 : 0; x <= j + 1 && x < columns; x++) {
            int32_t *at = cells + y * columns + x;
            if (*at == CELL_EMPTY || *at == CELL_CUBIC) *at = CELL_NEXT;
        }
}

/* Some squares of 8x8 pixels of one camera; how many */
static int T(move_squares)(const Move *move, T(Between) *b, int64_t first, int64_t end, int *left) {
    const int64_t *place = move->places + 3 * first;
    ALIGNED R u[BLOCK], v[BLOCK];
    ALIGNED I ok[BLOCK];
    int squares = 0;
    for (; squares < BLOCK / SQUARE && first + squares < end && place[3 * squares] == place[0]; squares++)
        for (int i = 0; i < SQUARE; i++) {
            u[squares * SQUARE + i] = (R)(8 * place[3 * squares + 2] + i % 8);
            v[squares * SQUARE + i] = (R)(8 * place[3 * squares + 1] + i / 8 + move->first_row);
        }
    T(between)(move, place[0], b);
    *left |= T(moved)(move, b, squares * SQUARE, squares * SQUARE, u, v, ok);
    R *across = (R *)move->results + first * SQUARE, *down = across + move->result_strides[2];
    for (int i = 0; i < squares * SQUARE; i++) across[i] = ok[i] ? u[i] : NAN, down[i] = ok[i] ? v[i] : NAN;
    for (int k = 0; k < squares; k++) {
        int known = 0;
        for (int i = 0; i < SQUARE; i++) known += ok[k * SQUARE + i] != 0;
        T(settle)(move, place + 3 * k, move->number + first + k, known);
    }
    return squares;
}

static int64_t T(moves)(const Move *move) {
    const int64_t tiles = (move->count + move->tile - 1) / move->tile;
    int64_t own = 0, at;
    int left = 0;
    T(Between) b;
    b.index = -1;
    while ((at = taken(move->next, &own)) < tiles * (move->places ? 1 : move->cameras)) {
        const int64_t first = at % tiles * move->tile;
        const int64_t end = first + move->tile < move->count ? first + move->tile : move->count;
        if (move->places) {
            for (int64_t i = first; i < end;) i += T(move_squares)(move, &b, i, end, &left);
            continue;
        }
        T(between)(move, at / tiles, &b);
        for (int64_t i = first; i < end; i += BLOCK)
            left |= T(move_row)(move, &b, i, (int)(end - i < BLOCK ? end - i : BLOCK));
    }
    return left;
}
