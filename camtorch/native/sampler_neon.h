/* Bytes on ARM, eight pixels at a time: interpolated in the fixed point of sampler_bytes.h, to its bits, or moved. */

/* Eight pixels: where the upper left one of their neighbours lies, and parts t of a pixel, as 2 t - 1 in 2^-15 */
typedef struct {
    uint32_t at[STEP]; /* in bytes */
    int16x8_t u, v;
} Eight;

/* Whether no such neighbour lies beyond `right` and `bottom`, and all is known of them */
INLINE int is_eight(const Image *image, const float *u, const float *v, uint16_t right, uint16_t bottom, const int pixel,
                    const int mode, Eight *eight) {
    uint16x8_t whole[2], part[2];
    for (int k = 0; k < 2; k++) {
        uint16x8_t fixed[2];
        for (int i = 0; i < 2; i++) {
            const float32x4_t read = vld1q_f32((k ? v : u) + 4 * i), x = mode == NEAREST ? vrndnq_f32(read) : read;
            /* what is not a number lies off the image, too */
            const float32x4_t known = vmaxnmq_f32(vmulq_n_f32(x, 65536), vdupq_n_f32(-65536));
            fixed[i] = vreinterpretq_u16_s32(vcvtnq_s32_f32(known));
        }
        part[k] = vuzp1q_u16(fixed[0], fixed[1]), whole[k] = vuzp2q_u16(fixed[0], fixed[1]);
    }
    const uint16x8_t on_u = vcleq_u16(whole[0], vdupq_n_u16(right)), on_v = vcleq_u16(whole[1], vdupq_n_u16(bottom));
    const uint16_t below = (uint16_t)image->below;
    const uint32x4_t low = vmull_n_u16(vget_low_u16(whole[1]), below), high = vmull_n_u16(vget_high_u16(whole[1]), below);
    vst1q_u32(eight->at, vmlal_n_u16(low, vget_low_u16(whole[0]), (uint16_t)pixel));
    vst1q_u32(eight->at + 4, vmlal_n_u16(high, vget_high_u16(whole[0]), (uint16_t)pixel));
    eight->u = vreinterpretq_s16_u16(veorq_u16(part[0], vdupq_n_u16(0x8000)));
    eight->v = vreinterpretq_s16_u16(veorq_u16(part[1], vdupq_n_u16(0x8000)));
    return vminvq_u16(vandq_u16(on_u, on_v)) != 0;
}

INLINE int16x8_t across16(uint16x8_t sum, uint16x8_t difference, int16x8_t t) {
    const int16x8_t wide = vreinterpretq_s16_u16(vshlq_n_u16(difference, 6));
    return vaddq_s16(vreinterpretq_s16_u16(vshlq_n_u16(sum, 6)), vqrdmulhq_s16(wide, t));
}

/* Between neighbours on the left and on the right, of the upper row in lower halves, and of the lower one in upper halves */
INLINE uint8x8_t between_bytes(uint8x16_t l, uint8x16_t r, int16x8_t u, int16x8_t v) {
    const uint8x8_t l0 = vget_low_u8(l), r0 = vget_low_u8(r);
    const int16x8_t above = across16(vaddl_u8(l0, r0), vsubl_u8(r0, l0), u);
    const int16x8_t under = across16(vaddl_high_u8(l, r), vsubl_high_u8(r, l), u);
    const int16x8_t made = vaddq_s16(vaddq_s16(above, under), vqrdmulhq_s16(vsubq_s16(under, above), v));
    return vrshrn_n_u16(vreinterpretq_u16_s16(made), 8);
}

/* Makes them in each plane */
INLINE void eight_of_planes(const Image *image, char *result, const Eight *eight, const int mode) {
    const char *plane = image->source;
    for (int64_t c = 0; c < image->channels; c++, plane += image->from_plane, result += image->to_plane) {
        ask_below(plane + eight->at[0], image->below);
        uint16x8_t a = vdupq_n_u16(0), b = a;
        uint8x8_t moved = vdup_n_u8(0);
#define READ(i)                                                                                                        \
    if (mode == NEAREST) {                                                                                             \
        moved = vld1_lane_u8((const uint8_t *)plane + eight->at[i], moved, i);                                         \
    } else {                                                                                                           \
        a = vld1q_lane_u16((const uint16_t *)(const void *)(plane + eight->at[i]), a, i);                              \
        b = vld1q_lane_u16((const uint16_t *)(const void *)(plane + image->below + eight->at[i]), b, i);               \
    }
        READ(0) READ(1) READ(2) READ(3) READ(4) READ(5) READ(6) READ(7)
#undef READ
        const uint8x16_t upper = vreinterpretq_u8_u16(a), lower = vreinterpretq_u8_u16(b);
        if (mode != NEAREST) moved = between_bytes(vuzp1q_u8(upper, lower), vuzp2q_u8(upper, lower), eight->u, eight->v);
        vst1_u8((uint8_t *)result, moved);
    }
}

/* Makes them of three or four channels side by side: a pixel and the next one of a row are six or eight bytes */
INLINE void eight_of_pixels(const Image *image, char *result, const Eight *eight, const int pixel) {
    static const uint8_t THREE[24] = {0,  1,  2,  4,  5,  6,  8,  9,  10, 12, 13, 14,
                                      16, 17, 18, 20, 21, 22, 24, 25, 26, 28, 29, 30};
    const int16x8_t u[2] = {vzip1q_s16(eight->u, eight->u), vzip2q_s16(eight->u, eight->u)};
    const int16x8_t v[2] = {vzip1q_s16(eight->v, eight->v), vzip2q_s16(eight->v, eight->v)};
    const uint8_t *upper = (const uint8_t *)image->source, *lower = upper + image->below;
    uint8x8_t made[4];
    ask_below(image->source + eight->at[0], image->below), ask_below(image->source + eight->at[STEP - 1], image->below);
    for (int k = 0; k < 4; k++) {
        const uint32_t i = eight->at[2 * k], j = eight->at[2 * k + 1];
        const uint64x2_t above = vreinterpretq_u64_u8(vcombine_u8(vld1_u8(upper + i), vld1_u8(upper + j)));
        const uint64x2_t under = vreinterpretq_u64_u8(vcombine_u8(vld1_u8(lower + i), vld1_u8(lower + j)));
#define FOURS(a, b) vreinterpretq_u8_u32(vuzp1q_u32(vreinterpretq_u32_u64(a), vreinterpretq_u32_u64(b)))
#define TWICE(t) vreinterpretq_s32_s16(t[k / 2]), vreinterpretq_s32_s16(t[k / 2])
#define PARTS(t) vreinterpretq_s16_s32(k % 2 ? vzip2q_s32(TWICE(t)) : vzip1q_s32(TWICE(t)))
        const uint8x16_t r = pixel == 3 ? FOURS(vshrq_n_u64(above, 24), vshrq_n_u64(under, 24))
                                        : FOURS(vshrq_n_u64(above, 32), vshrq_n_u64(under, 32));
        made[k] = between_bytes(FOURS(above, under), r, PARTS(u), PARTS(v));
#undef FOURS
#undef TWICE
#undef PARTS
    }
    const uint8x16x2_t all = {{vcombine_u8(made[0], made[1]), vcombine_u8(made[2], made[3])}};
    if (pixel == 4) {
        vst1q_u8((uint8_t *)result, all.val[0]), vst1q_u8((uint8_t *)result + 16, all.val[1]);
    } else {
        vst1q_u8((uint8_t *)result, vqtbl2q_u8(all, vld1q_u8(THREE)));
        vst1_u8((uint8_t *)result + 16, vqtbl2_u8(all, vld1_u8(THREE + 16)));
    }
}

/* Makes pixels i ... n - 1, eight at a time, up to the first of which some lie off the image; returns where */
INLINE int64_t eights(const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, const int pixel,
                      const int mode) {
    const int beyond = mode == NEAREST ? 1 : 2;
    /* eight bytes hold a part of a third pixel of three channels */
    const uint16_t right = (uint16_t)(image->width - (pixel == 3 ? 3 : beyond));
    const uint16_t bottom = (uint16_t)(image->height - beyond);
    Eight eight;
    for (; n - i >= STEP && is_eight(image, at->u + i, at->v + i, right, bottom, pixel, mode, &eight); i += STEP) {
        if (pixel == 1) eight_of_planes(image, first + i, &eight, mode);
        else eight_of_pixels(image, first + i * pixel, &eight, pixel);
    }
    return i;
}

static NOT_INLINE int64_t eights_of(const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, int pixel,
                                    int mode) {
    if (image->height < 2) return i;
    if (mode == NEAREST) return eights(image, first, at, i, n, 1, NEAREST);
    if (pixel == 1) return eights(image, first, at, i, n, 1, BILINEAR);
    return pixel == 3 ? eights(image, first, at, i, n, 3, BILINEAR) : eights(image, first, at, i, n, 4, BILINEAR);
}

/* Makes pixels i ... n - 1, at least eight from 0 on: some before i again, if registers would not be full */
INLINE void fixed_point(Span *span, const Image *image, char *first, const Chunk *at, int64_t i, int64_t n, int mode,
                        int pixel) {
    while (i < n) {
        if (n - i < STEP) i = n - STEP;
        const int64_t end = eights_of(image, first, at, i, n, pixel, mode);
        if (i == end && mode == NEAREST) groups(span, first, at, i, i + STEP, BYTES1, NEAREST, SCATTERED);
        else if (i == end) groups(span, first, at, i, i + STEP, UINT8, BILINEAR, pixel == 1 ? PLANES : INTERLEAVED);
        i = i == end ? i + STEP : end;
    }
}
