/* Which splats reach which tile.
 *
 * Lists come in sets: one a transmitter, or one for all where covariances are shared. In each, a tile owns a run of
 * entries: the splats that reach the tile, front to back, with the rows each reaches. Splats come in blocks: where each
 * block's entries begin in each run is kept, so the gradient finds from splats to entries without atomics.
 *
 * A box meets a tile where it meets the tile's span of u and its span of v. Where the plane is separable, one span of u
 * is that of all tiles in a column, and one of v that of all in a row; else every tile has its own.
 */

#define BLOCK 16 /* words of 32 splats */
#define BLOCKS(sizes) (((sizes).words + BLOCK - 1) / BLOCK)

#if SEPARABLE
#define SPANS_U(sizes) (sizes).across
#define SPANS_V(sizes) (sizes).down
#define SPAN_U(sizes, tile) ((tile) % (sizes).across)
#define SPAN_V(sizes, tile) ((tile) / (sizes).across)
#else
#define SPANS_U(sizes) ((sizes).down * (sizes).across)
#define SPANS_V(sizes) SPANS_U(sizes)
#define SPAN_U(sizes, tile) (tile)
#define SPAN_V(sizes, tile) (tile)
#endif

/* Centre and half size, with slack for rounding. */
typedef struct {
    float centre, half_size;
} span_t;

static inline uint all_bits(masks bits) {
    int4 a = bits.lo | bits.hi;
    int2 b = a.lo | a.hi;
    return b.lo | b.hi;
}

/* Packs 32 splats of one set at their places in depth order:
 *   geometry    (sets, words 32, GEOMETRY)
 *   appearance  (words 32, transmitters, APPEARANCE)
 * and marks the spans that meet the box of the splat, outside which it does nothing:
 *   hits        (sets, spans of u and of v, words), a bit a splat */
kernel void prepare(sizes_t sizes, global const int *order, global const float *means, global const float *factors,
                    global const uchar *visible, global const float *signal, global const float *opacities,
                    global const float *attenuations, global const span_t *spans, global float *geometry,
                    global float *appearance, global uint *hits) {
    int word = get_global_id(0) % sizes.words, set = get_global_id(0) / sizes.words, padded = sizes.words * 32;
    int first = sizes.sets == 1 ? 0 : set, last = sizes.sets == 1 ? sizes.transmitters : set + 1;
    lanes boxes[4][4]; /* centre and half size */
    for (int i = word * 32; i < word * 32 + 32; i++) {
        global float *row = geometry + (set * padded + i) * GEOMETRY;
        float *box = (float *)boxes + (i - word * 32);
        int from = i < sizes.splats ? order[i] : -1;
        if (from < 0 || !visible[from]) {
            for (int j = 0; j < GEOMETRY; j++) row[j] = 0;
            box[0] = box[32] = 0;
            box[64] = box[96] = -INFINITY; /* which meets nothing */
            continue;
        }
        float opacity = 0;
        for (int t = first; t < last; t++) {
            global float *look = appearance + (i * sizes.transmitters + t) * APPEARANCE;
            int at = t * sizes.splats + from;
            look[0] = opacities[at];
            opacity = opacity >= look[0] || opacity != opacity ? opacity : look[0]; /* the largest, or NaN */
#if ATTENUATION
            look[1] = attenuations[at] == 0 ? OPAQUE : log2(attenuations[at]);
#endif
            for (int c = 0; c < CHANNELS; c++) look[1 + ATTENUATION + c] = signal[at * CHANNELS + c];
        }
        global const float *factor = factors + (set * sizes.splats + from) * 3;
        float p = factor[0], q = factor[1], r = factor[2], height = hypot(q, r);
        const float h = 0.849321800f; /* sqrt(log2(e) / 2) */
        float across = h / p, along = h / r, shear = along * (q / p);
        float reach = opacity < ALPHA_MIN ? -INFINITY : sqrt(log2(opacity / ALPHA_MIN));
        float half_v = reach * height / h;
        row[0] = box[0] = means[2 * from];
        row[1] = box[32] = means[2 * from + 1];
        row[2] = across;
        row[3] = along;
        row[4] = shear;
        row[5] = reach;
        row[6] = half_v * (q / height) * (p / height);
        row[7] = 1 / along;
        box[64] = reach / across * 1.0001f; /* slack: in doubt a splat is listed, and each pixel decides */
        box[96] = half_v * 1.0001f;
    }
    hits += set * (SPANS_U(sizes) + SPANS_V(sizes)) * sizes.words + word;
    for (int s = 0; s < SPANS_U(sizes) + SPANS_V(sizes); s++) {
        span_t span = spans[s];
        masks found = 0;
        for (int j = 0; j < 4; j++) {
            lanes offset = s < SPANS_U(sizes) ? offset_lanes(boxes[0][j], span.centre) : boxes[1][j] - span.centre;
            lanes limit = (s < SPANS_U(sizes) ? boxes[2][j] : boxes[3][j]) + span.half_size;
            found |= ~(MOST(offset, -offset) > limit) & (int8)(1, 2, 4, 8, 16, 32, 64, 128) << 8 * j;
        }
        hits[s * sizes.words] = all_bits(found);
    }
}

/* The words of two spans: a splat whose box meets a tile has its bit in both. */
typedef struct {
    global const uint *u, *v;
} words_t;

static inline words_t find_words(sizes_t sizes, global const uint *hits, int list) {
    int tiles = sizes.down * sizes.across, tile = list % tiles;
    hits += list / tiles * (SPANS_U(sizes) + SPANS_V(sizes)) * sizes.words;
    return (words_t){hits + SPAN_U(sizes, tile) * sizes.words,
                     hits + (SPANS_U(sizes) + SPAN_V(sizes, tile)) * sizes.words};
}

/* Counts the splats whose box meets one tile of one set. */
kernel void count(sizes_t sizes, global const uint *hits, global int *counts) {
    words_t words = find_words(sizes, hits, get_global_id(0));
    uint count = 0;
    for (int word = 0; word < sizes.words; word++) {
        uint bits = words.u[word] & words.v[word]; /* its ones are counted in pairs, fours, eights, and summed */
        bits -= bits >> 1 & 0x55555555;
        bits = (bits & 0x33333333) + (bits >> 2 & 0x33333333);
        bits = (bits + (bits >> 4)) & 0x0f0f0f0f;
        count += bits * 0x01010101 >> 24;
    }
    counts[get_global_id(0)] = count;
}

/* A splat in a tile's list, with the rows it reaches; packed as splat | first << 24 | last << 28. */
typedef struct {
    uint splat;
    int first, last;
} entry_t;

#define NO_ENTRY -1
#define AT_ONCE 64 /* words */

static inline entry_t unpack(uint entry) { return (entry_t){entry & 0xffffff, entry >> 24 & 15, entry >> 28}; }

/* sqrt(x), or up to 0.2 % of it more. */
static inline lanes root_above(lanes x) {
    x = LEAST(x, 1e30f);
    lanes y = as_float8(0x5f375a86 - (as_int8(x) >> 1)); /* about 1 / sqrt(x); Newton's step ends below it */
    y *= 1.5f - .5f * x * y * y;
    return x * y * 1.002f;
}

/* The geometry of eight splats, turned from a row each into a vector for each value. */
static inline void load_columns(const int *splats, global const float *geometry, lanes *columns) {
    lanes rows[8], pairs[8], fours[8];
#pragma unroll
    for (int j = 0; j < 8; j++) rows[j] = *(global const loose_lanes *)(geometry + splats[j] * GEOMETRY);
#pragma unroll
    for (int j = 0; j < 8; j += 2) {
        lanes a = rows[j], b = rows[j + 1];
        pairs[j] = (lanes)(a.s0, b.s0, a.s1, b.s1, a.s4, b.s4, a.s5, b.s5);
        pairs[j + 1] = (lanes)(a.s2, b.s2, a.s3, b.s3, a.s6, b.s6, a.s7, b.s7);
    }
#pragma unroll
    for (int j = 0; j < 8; j += 4)
#pragma unroll
        for (int k = j; k < j + 2; k++) {
            lanes a = pairs[k], b = pairs[k + 2];
            fours[2 * k - j] = (lanes)(a.s01, b.s01, a.s45, b.s45);
            fours[2 * k - j + 1] = (lanes)(a.s23, b.s23, a.s67, b.s67);
        }
#pragma unroll
    for (int j = 0; j < 4; j++) {
        columns[j] = (lanes)(fours[j].lo, fours[j + 4].lo);
        columns[j + 4] = (lanes)(fours[j].hi, fours[j + 4].hi);
    }
}

/* Entries of eight splats in the list of a tile: the first and the last row that the ellipse touches within the tile's
 * columns, or NO_ENTRY. `low` holds the least v of each row, `high` the largest. */
static inline masks find_entries(const int *splats, global const float *geometry, span_t span, global const float *low,
                                 global const float *high) {
    lanes columns[8];
    load_columns(splats, geometry, columns);
    lanes centre = columns[1], across = columns[2], shear = columns[4], crest = columns[6], height = columns[7];
    lanes reach = columns[5] * 1.0001f; /* slack, as for the boxes */
    lanes du = -offset_lanes(columns[0], span.centre), left = du - span.half_size, right = du + span.half_size;
#ifdef PERIOD
    masks both = left < -.5f * PERIOD | right > .5f * PERIOD; /* reached from both sides */
    left = both ? -INFINITY : left;
    right = both ? INFINITY : right;
#endif
    masks misses = MOST(left, -right) * across > reach;
    /* The ellipse is highest, and lowest, where du is nearest to its crest, and opposite of it. */
    lanes at_top = LEAST(MOST(crest, left), right), at_bottom = LEAST(MOST(-crest, left), right);
    lanes s_top = at_top * across, s_bottom = at_bottom * across;
    lanes rest_top = reach * reach - s_top * s_top, rest_bottom = reach * reach - s_bottom * s_bottom;
    lanes top = centre + (at_top * shear + root_above(MOST(rest_top, 0.f))) * height;
    lanes bottom = centre + (at_bottom * shear - root_above(MOST(rest_bottom, 0.f))) * height;
    masks first = 0, last = NO_ENTRY;
#pragma unroll
    for (int r = 0; r < ROWS; r++) {
        last = low[r] > top | high[r] < bottom ? last : r;
        int back = ROWS - 1 - r;
        first = low[back] > top | high[back] < bottom ? first : back;
    }
    return misses | last < 0 ? NO_ENTRY : *(const loose_masks *)splats | first << 24 | last << 28;
}

/* Lists one tile of one set: finds the splats whose boxes meet it, some words at a time, then takes eight ellipses at
 * once. */
kernel void list(sizes_t sizes, global const uint *hits, global const span_t *spans, global const float *edges,
                 global const float *geometry, global const int *offsets, global int *blocks, global int *entries,
                 global int *counts) {
    int list = get_global_id(0), tiles = sizes.down * sizes.across, tile = list % tiles, entry = offsets[list];
    words_t words = find_words(sizes, hits, list);
    span_t span = spans[SPAN_U(sizes, tile)];
    global const float *low = edges + SPAN_V(sizes, tile) * 2 * ROWS;
    geometry += list / tiles * sizes.words * 32 * GEOMETRY;
    for (int word = 0; word < sizes.words;) {
        int splats[AT_ONCE * 32 + 8], size = 0;
        for (int pause = LEAST(word + AT_ONCE, sizes.words); word < pause; word += 2) {
            ulong left = words.u[word] & words.v[word];
            if (word + 1 < pause) left |= (ulong)(words.u[word + 1] & words.v[word + 1]) << 32;
            while (left) /* mostly once: a branch that is hard to predict would cost more than idle steps */
#pragma unroll
                for (int j = 0; j < 4; j++, left &= left - 1) {
                    splats[size] = word * 32 + LOWEST(left);
                    size += left != 0;
                }
        }
        for (int j = size; j < size + 7; j++) splats[j] = 0; /* whose entries are not kept */
        for (int k = 0; k < size; k += 8) {
            masks found = find_entries(splats + k, geometry, span, low, low + ROWS);
            const int *kept = (const int *)&found;
            for (int j = 0; j < LEAST(size - k, 8); j++) {
                entries[entry] = kept[j];
                entry += kept[j] != NO_ENTRY;
            }
        }
    }
    counts[list] = entry - offsets[list];
    blocks += list * (BLOCKS(sizes) + 1);
    int block = 0;
    for (int k = offsets[list]; k < entry; k++)
        for (int last = unpack(entries[k]).splat / (BLOCK * 32); block <= last; block++) blocks[block] = k;
    for (; block <= BLOCKS(sizes); block++) blocks[block] = entry;
}
