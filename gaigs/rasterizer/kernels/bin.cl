/* Which splats reach which tile.
 *
 * Lists come in sets: one a transmitter, or one for all where covariances are shared. In each, a tile owns a row of bits,
 * one a splat, and a run of entries: the splats that reach the tile, front to back, each with the rows it reaches. The
 * rank of a bit leads from the splat to the entry, and so the gradient finds its way back without atomics.
 */

/* Packs 32 splats of one set at their places in depth order:
 *   geometry    (sets, words 32, GEOMETRY)
 *   boxes       (sets, 4, words 32): centre and half size of the box outside of which a splat does nothing
 *   appearance  (words 32, transmitters, APPEARANCE) */
kernel void prepare(sizes_t sizes, global const int *order, global const float *means, global const float *covariances,
                    global const float *signal, global const float *opacities, global const float *attenuations,
                    global float *geometry, global float *boxes, global float *appearance) {
    int word = get_global_id(0) % sizes.words, set = get_global_id(0) / sizes.words, padded = sizes.words * 32;
    for (int i = word * 32; i < word * 32 + 32; i++) {
        global float *box = boxes + set * 4 * padded + i;
        if (i >= sizes.seen) {
            box[0] = box[padded] = 0;
            box[2 * padded] = box[3 * padded] = -INFINITY; /* which meets nothing */
            continue;
        }
        int from = order[i], first = sizes.sets == 1 ? 0 : set, last = sizes.sets == 1 ? sizes.transmitters : set + 1;
        float opacity = 0;
        for (int t = first; t < last; t++) {
            global float *look = appearance + (i * sizes.transmitters + t) * APPEARANCE;
            int at = t * sizes.splats + from;
            look[0] = opacities[at];
            opacity = MOST(opacity, look[0]);
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
        float reach = opacity >= ALPHA_MIN ? sqrt(log2(opacity / ALPHA_MIN)) : -INFINITY;
        float half_v = reach * sqrt(vv) / h; /* at du = reach uv / (h sqrt(vv)) */
        global float *row = geometry + (set * padded + i) * GEOMETRY;
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

/* Marks the splats whose box meets one tile of one set. `spans` holds the centre and half size of each tile in u and v. */
kernel void mark(sizes_t sizes, global const float *boxes, global const loose_span *spans, global uint *bits,
                 global int *counts) {
    int tiles = sizes.down * sizes.across, padded = sizes.words * 32, count = 0;
    global const float *box = boxes + get_global_id(0) / tiles * 4 * padded;
    float4 span = spans[get_global_id(0) % tiles];
    for (int word = 0; word < sizes.words; word++, box += 32) {
        uint hits = 0;
        for (int j = 0; j < 32; j++) {
            float du = offset_float(box[j], span.x), dv = box[j + padded] - span.z;
            uint hit = (MOST(du, -du) <= box[j + 2 * padded] + span.y) & (MOST(dv, -dv) <= box[j + 3 * padded] + span.w);
            hits |= hit << j;
            count += hit;
        }
        bits[get_global_id(0) * sizes.words + word] = hits;
    }
    counts[get_global_id(0)] = count;
}

/* The rows of a tile that a splat's ellipse touches within the tile's columns, a bit each. `low` and `high` hold the
 * least and largest v of each row. */
static inline uint rows_touched(splat_t splat, float4 span, float16 low, float16 high) {
    float reach = splat.reach * 1.0001f; /* slack, as for the boxes */
    float du = offset_float(span.x, splat.u), left = du - span.y, right = du + span.y;
#ifdef PERIOD
    if (left < -.5f * PERIOD || right > .5f * PERIOD) left = -INFINITY, right = INFINITY; /* reached from both sides */
#endif
    if (MOST(left, -right) * splat.across > reach) return 0;
    /* The ellipse is highest, and lowest, where du is nearest to its crest, and opposite of it. */
    float2 at = (float2)(splat.crest, -splat.crest);
    at = LEAST(MOST(at, left), right);
    float2 s = at * splat.across, left_over = reach * reach - s * s;
    float2 y = sqrt(MOST(left_over, 0.f));
    float top = splat.v + (at.x * splat.shear + y.x) / splat.along, bottom = splat.v + (at.y * splat.shear - y.y) / splat.along;
    int16 hits = (high >= bottom) & (low <= top);
    hits &= (int16)(1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, 32768);
    int8 a = hits.lo | hits.hi;
    int4 b = a.lo | a.hi;
    int2 c = b.lo | b.hi;
    return c.x | c.y;
}

/* Lists one tile of one set: splat | first row << 24 | last row << 28. Bits of ellipses that miss are cleared. */
kernel void list(sizes_t sizes, global const float *geometry, global const loose_span *spans, global const loose_rows *rows,
                 global const int *offsets, global uint *bits, global int *ranks, global uint *entries,
                 global int *counts) {
    int tiles = sizes.down * sizes.across, tile = get_global_id(0) % tiles, entry = offsets[get_global_id(0)];
    geometry += get_global_id(0) / tiles * sizes.words * 32 * GEOMETRY;
    float4 span = spans[tile];
    float16 low = rows[2 * tile], high = rows[2 * tile + 1];
    for (int word = 0; word < sizes.words; word++) {
        int at = get_global_id(0) * sizes.words + word;
        uint kept = 0;
        ranks[at] = entry;
        for (uint left = bits[at]; left; left &= left - 1) {
            uint i = word * 32 + LOWEST(left), touched = rows_touched(load_splat(geometry + i * GEOMETRY), span, low, high);
            if (!touched) continue;
            uint last = (as_uint((float)touched) >> 23) - 127; /* the highest bit: 16 of them are exact in a float */
            entries[entry++] = i | LOWEST(touched) << 24 | last << 28;
            kept |= left & -left;
        }
        bits[at] = kept;
    }
    counts[get_global_id(0)] = entry - offsets[get_global_id(0)];
}
