/* Which splats reach which tile.
 *
 * Lists come in sets: one a transmitter, or one for all where covariances are shared. In each, a tile owns a row of
 * marks, words of one bit a splat, and a run of entries: the splats that reach the tile, front to back, with the rows
 * each reaches. Beside a word stands the place of its first entry: so the gradient finds from splats to entries without
 * atomics.
 */

/* Packs 32 splats of one set at their places in depth order:
 *   geometry    (sets, words 32, GEOMETRY)
 *   boxes       (sets, 4, words 32): centre and half size of the box outside of which a splat does nothing
 *   appearance  (words 32, transmitters, APPEARANCE) */
kernel void prepare(sizes_t sizes, global const int *order, global const float *means, global const float *covariances,
                    global const uchar *visible, global const float *signal, global const float *opacities,
                    global const float *attenuations, global float *geometry, global float *boxes,
                    global float *appearance) {
    int word = get_global_id(0) % sizes.words, set = get_global_id(0) / sizes.words, padded = sizes.words * 32;
    int first = sizes.sets == 1 ? 0 : set, last = sizes.sets == 1 ? sizes.transmitters : set + 1;
    for (int i = word * 32; i < word * 32 + 32; i++) {
        global float *row = geometry + (set * padded + i) * GEOMETRY, *box = boxes + set * 4 * padded + i;
        int from = i < sizes.splats ? order[i] : -1;
        if (from < 0 || !visible[from]) {
            for (int j = 0; j < GEOMETRY; j++) row[j] = 0;
            box[0] = box[padded] = 0;
            box[2 * padded] = box[3 * padded] = -INFINITY; /* which meets nothing */
            continue;
        }
        float opacity = 0;
        for (int t = first; t < last; t++) {
            global float *look = appearance + (i * sizes.transmitters + t) * APPEARANCE;
            int at = t * sizes.splats + from;
            look[0] = opacities[at];
            opacity = opacity >= look[0] || opacity != opacity ? opacity : look[0]; /* the largest, or NaN */
#if ATTENUATION
            look[1] = log2(attenuations[at]);
#endif
            for (int c = 0; c < CHANNELS; c++) look[1 + ATTENUATION + c] = signal[at * CHANNELS + c];
        }
        global const float *covariance = covariances + (set * sizes.splats + from) * 4;
        float uu = covariance[0], uv = .5f * (covariance[1] + covariance[2]), vv = covariance[3];
        /* Kahan's difference of products: right to the last digits where a splat is long and thin. */
        float product = uv * uv, determinant = fma(uu, vv, -product) - fma(uv, uv, -product);
        const float h = 0.849321800f; /* sqrt(log2(e) / 2) */
        float across = h / sqrt(uu), along = h * sqrt(uu / determinant), shear = along * uv / uu;
        float reach = opacity < ALPHA_MIN ? -INFINITY : sqrt(log2(opacity / ALPHA_MIN));
        float half_v = reach * sqrt(vv) / h;
        row[0] = box[0] = means[2 * from];
        row[1] = box[padded] = means[2 * from + 1];
        row[2] = across;
        row[3] = along;
        row[4] = shear;
        row[5] = reach;
        row[6] = half_v * uv / vv;
        box[2 * padded] = reach / across * 1.0001f; /* slack: in doubt a splat is listed, and each pixel decides */
        box[3 * padded] = half_v * 1.0001f;
    }
}

/* What a tile spans, with slack for rounding: centre and half size in u and v, least and largest v of each row. */
typedef struct {
    float u, half_u, v, half_v;
    float16 low, high;
} span_t;

static inline span_t span_tile(global const float *u, global const float *v, sizes_t sizes, int tile) {
    float left = INFINITY, right = -INFINITY, bottom = INFINITY, top = -INFINITY, low[ROWS], high[ROWS];
    for (int r = 0; r < ROWS; r++) {
        low[r] = INFINITY;
        high[r] = -INFINITY;
        for (int x = 0; x < COLUMNS; x++) {
            int row = tile / sizes.across * ROWS + r, column = tile % sizes.across * COLUMNS + x;
            float a = u[SEPARABLE ? column : row * sizes.across * COLUMNS + column];
            float b = v[SEPARABLE ? row : row * sizes.across * COLUMNS + column];
            left = LEAST(left, a);
            right = MOST(right, a);
            low[r] = LEAST(low[r], b);
            high[r] = MOST(high[r], b);
        }
        bottom = LEAST(bottom, low[r]);
        top = MOST(top, high[r]);
    }
    float slack = 1e-6f * (MOST(-left, right) + MOST(-bottom, top));
#ifdef PERIOD
    slack += 1e-6f * PERIOD;
#endif
    float16 lows, highs;
    for (int r = 0; r < ROWS; r++) {
        ((float *)&lows)[r] = low[r] - slack;
        ((float *)&highs)[r] = high[r] + slack;
    }
    return (span_t){.5f * (left + right), .5f * (right - left) + slack,
                    .5f * (bottom + top), .5f * (top - bottom) + slack, lows, highs};
}

/* Marks the splats whose box meets one tile of one set. */
kernel void mark(sizes_t sizes, global const float *u, global const float *v, global const float *boxes,
                 global uint2 *marks, global int *counts) {
    int tiles = sizes.down * sizes.across, padded = sizes.words * 32, count = 0;
    global const float *box = boxes + get_global_id(0) / tiles * 4 * padded;
    span_t span = span_tile(u, v, sizes, get_global_id(0) % tiles);
    for (int word = 0; word < sizes.words; word++, box += 32) {
        uint hits = 0;
        for (int j = 0; j < 32; j++) {
            float du = offset_float(box[j], span.u), dv = box[j + padded] - span.v;
            float half_u = box[j + 2 * padded] + span.half_u, half_v = box[j + 3 * padded] + span.half_v;
            uint hit = !(MOST(du, -du) > half_u | MOST(dv, -dv) > half_v);
            hits |= hit << j;
            count += hit;
        }
        marks[get_global_id(0) * sizes.words + word].x = hits;
    }
    counts[get_global_id(0)] = count;
}

/* The rows of a tile that a splat's ellipse touches within the tile's columns, a bit each. */
static inline uint rows_touched(splat_t splat, span_t span) {
    float reach = splat.reach * 1.0001f; /* slack, as for the boxes */
    float du = offset_float(span.u, splat.u), left = du - span.half_u, right = du + span.half_u;
#ifdef PERIOD
    if (left < -.5f * PERIOD || right > .5f * PERIOD) { /* reached from both sides */
        left = -INFINITY;
        right = INFINITY;
    }
#endif
    if (MOST(left, -right) * splat.across > reach) return 0;
    /* The ellipse is highest, and lowest, where du is nearest to its crest, and opposite of it. */
    float2 at = (float2)(splat.crest, -splat.crest);
    at = LEAST(MOST(at, left), right);
    float2 s = at * splat.across, rest = reach * reach - s * s;
    float2 y = sqrt(MOST(rest, 0.f)) * (float2)(1, -1), v = splat.v + (at * splat.shear + y) / splat.along;
    int16 hits = ~((span.low > v.x) | (span.high < v.y));
    hits &= (int16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768);
    int8 a = hits.lo | hits.hi;
    int4 b = a.lo | a.hi;
    int2 c = b.lo | b.hi;
    return c.x | c.y;
}

/* A splat in a tile's list, with the rows it reaches; packed as splat | first << 24 | last << 28. */
typedef struct {
    uint splat, first, last;
} entry_t;

static inline entry_t unpack(uint entry) { return (entry_t){entry & 0xffffff, entry >> 24 & 15, entry >> 28}; }

/* Lists one tile of one set. Bits of ellipses that miss are cleared. */
kernel void list(sizes_t sizes, global const float *u, global const float *v, global const float *geometry,
                 global const int *offsets, global uint2 *marks, global uint *entries, global int *counts) {
    int tiles = sizes.down * sizes.across, entry = offsets[get_global_id(0)];
    geometry += get_global_id(0) / tiles * sizes.words * 32 * GEOMETRY;
    span_t span = span_tile(u, v, sizes, get_global_id(0) % tiles);
    marks += get_global_id(0) * sizes.words;
    for (int word = 0; word < sizes.words; word++) {
        uint kept = 0, rank = entry;
        for (uint left = marks[word].x; left; left &= left - 1) {
            uint i = word * 32 + LOWEST(left), rows = rows_touched(load_splat(geometry + i * GEOMETRY), span);
            if (!rows) continue;
            entries[entry++] = i | LOWEST(rows) << 24 | HIGHEST(rows) << 28;
            kept |= left & -left;
        }
        marks[word] = (uint2)(kept, rank);
    }
    counts[get_global_id(0)] = entry - offsets[get_global_id(0)];
}
