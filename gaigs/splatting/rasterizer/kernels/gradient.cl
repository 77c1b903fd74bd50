/* The way back: from the pixels of a tile to its entries, back to front, and from entries to splats.
 *
 * With D = signal . gradient at a pixel, and R_i the gradient with respect to the transmittance behind splat i, what
 * all behind it gives for each unit of light that gets there:
 *
 *   P_i = d_i^{G_i} R_i        R_{i-1} = P_i + A_i (D_i - P_i)        R_last = gradient_left
 *   d/dA_i = T_i (D_i - P_i)   d/d(log d_i) = G_i T_i (1 - A_i) P_i
 *
 * No division and no small difference of large sums: a float's digits last. T is found by going front to back once more
 * from the checkpoint of each chunk.
 */

/* A tile's result for an entry: moments of the gradient, then each transmitter's gradient of the appearance. */
#define MOMENTS 5
#define PARTIALS (MOMENTS + TRANSMITTERS * APPEARANCE)

/* A chunk of entries: footprints, and the gradients of their logarithm summed over transmitters; for one transmitter at
 * a time A, the transmittance before, and d^G. */
typedef struct {
    lanes footprint[CHUNK][ROWS], flow[CHUNK][ROWS];
    lanes alpha[CHUNK][ROWS], before[CHUNK][ROWS], attenuation[CHUNK][ROWS];
} chunk_t;

/* Gradients of one splat's appearance, summed over rows. */
typedef struct {
    lanes opacity, attenuation, signal[CHANNELS];
} found_t;

/* Front to back through one row of an entry. */
static inline void pass_forward(chunk_t *chunk, int k, int r, lanes *transmittance, global const float *look) {
    lanes g = chunk->footprint[k][r], alpha = alpha_of(g, look), before = *transmittance;
    lanes after = before - alpha * before;
    chunk->alpha[k][r] = alpha;
    chunk->before[k][r] = before;
#if ATTENUATION
    lanes attenuation = attenuation_of(g, alpha, look);
    chunk->attenuation[k][r] = attenuation;
    after *= attenuation;
#endif
    *transmittance = after;
}

/* Back to front through one row of an entry; channels of the gradient lie ROWS apart. */
static inline void pass_back(chunk_t *chunk, int k, int r, lanes *behind, const lanes *gradient,
                             global const float *look, found_t *found) {
    lanes alpha = chunk->alpha[k][r], before = chunk->before[k][r], weight = alpha * before, d = 0, p = *behind;
#pragma unroll
    for (int c = 0; c < CHANNELS; c++) {
        d += gradient[c * ROWS] * look[1 + ATTENUATION + c];
        found->signal[c] += gradient[c * ROWS] * weight;
    }
#if ATTENUATION
    p *= chunk->attenuation[k][r];
    lanes covered = MASKED(alpha != 0, chunk->footprint[k][r] * (before - weight) * p);
    found->attenuation += covered;
    chunk->flow[k][r] += covered * (look[1] * 0.693147181f); /* log d */
#endif
    lanes gain = d - p, flow = MASKED(~(alpha >= ALPHA_MAX), weight * gain); /* a clamped A does not move */
    found->opacity += flow;
    chunk->flow[k][r] += flow;
    *behind = p + alpha * gain;
}

/* Moments of the gradient of log G over the pixels, in whitened coordinates: centre and covariance follow from them. */
typedef struct {
    lanes s, y, ss, sy, yy;
} moments_t;

static inline void add_moments(moments_t *moments, lanes flow, offsets_t at) {
#if SEPARABLE /* s is the same in all rows: it comes in when they are summed up */
    lanes flow_y = flow * at.y;
    moments->s += flow;
    moments->y += flow_y;
    moments->yy += flow_y * at.y;
#else
    lanes flow_s = flow * at.s, flow_y = flow * at.y;
    moments->s += flow_s;
    moments->y += flow_y;
    moments->ss += flow_s * at.s;
    moments->sy += flow_s * at.y;
    moments->yy += flow_y * at.y;
#endif
}

/* One row of a tile from an image; pixels beyond its edges read 0. */
static inline lanes load_row(global const float *image, sizes_t sizes, job_t job, int row) {
    global const float *pixels = image + (job.y + row) * sizes.width + job.x;
    int inside = job.y + row < sizes.height ? sizes.width - job.x : 0;
    if (inside >= COLUMNS) return *(global const loose_lanes *)pixels;
    float value[COLUMNS];
    for (int x = 0; x < COLUMNS; x++) value[x] = x < inside ? pixels[x] : 0;
    return *(loose_lanes *)value;
}

static inline float sum(lanes v) {
    float4 a = v.lo + v.hi;
    float2 b = a.lo + a.hi;
    return b.lo + b.hi;
}

kernel void backward(sizes_t sizes, global const float *u, global const float *v, global const int *offsets,
                     global const int *counts, global const uint *entries, global const float *geometry,
                     global const float *appearance, global const int *ends, global const float *checkpoints,
                     global const rows_t *bounds, global const float *image_gradient,
                     global const float *left_gradient, global float *partials) {
    job_t job = find_job(sizes, get_global_id(0), offsets, counts);
    int area = sizes.height * sizes.width, end = ends[get_global_id(0)];
    if (sizes.sets > 1)
        geometry += job.first * sizes.words * 32 * GEOMETRY;
    else
        partials += get_global_id(0) / (sizes.down * sizes.across) * (size_t)sizes.entries * PARTIALS;
    appearance += job.first * APPEARANCE;
    lanes behind[TRANSMITTERS][ROWS], gradient[TRANSMITTERS][CHANNELS][ROWS];
    for (int t = 0; t < job.count; t++)
        for (int r = 0; r < ROWS; r++) {
            behind[t][r] = load_row(left_gradient + (job.first + t) * area, sizes, job, r);
            for (int c = 0; c < CHANNELS; c++)
                gradient[t][c][r] = load_row(image_gradient + ((job.first + t) * CHANNELS + c) * area, sizes, job, r);
        }

    chunk_t chunk;
    view_t views[CHUNK];
    entry_t clipped[CHUNK];
    for (int number = (end - job.begin + CHUNK - 1) / CHUNK - 1; number >= 0; number--) {
        int begin = job.begin + number * CHUNK, count = LEAST(end - begin, CHUNK);
        global float *partial = partials + (size_t)begin * PARTIALS;
        rows_t rows = bounds[job.checkpoint + number];
        for (int k = 0; k < count; k++) {
            entry_t entry = clipped[k] = clip(unpack(entries[begin + k]), rows);
            views[k] = view_splat(load_splat(geometry + entry.splat * GEOMETRY), u, v, sizes, job.tile);
            for (int r = entry.first; r <= entry.last; r++) {
                chunk.footprint[k][r] = footprint(offsets_of(views + k, r));
                chunk.flow[k][r] = 0;
            }
        }
        for (int t = 0; t < job.count; t++) {
            lanes transmittance[ROWS];
            for (int r = 0; r < ROWS; r++)
                transmittance[r] = *(global const loose_lanes *)(checkpoints + find_row(job.checkpoint + number, t, r));
            for (int k = 0; k < count; k++) {
                entry_t entry = clipped[k];
                global const float *look = appearance + (entry.splat * sizes.transmitters + t) * APPEARANCE;
                for (int r = entry.first; r <= entry.last; r++) pass_forward(&chunk, k, r, transmittance + r, look);
            }
            for (int k = count - 1; k >= 0; k--) {
                entry_t entry = clipped[k];
                global const float *look = appearance + (entry.splat * sizes.transmitters + t) * APPEARANCE;
                found_t found = {0};
                for (int r = entry.first; r <= entry.last; r++)
                    pass_back(&chunk, k, r, behind[t] + r, gradient[t][0] + r, look, &found);
                global float *sums = partial + k * PARTIALS + MOMENTS + t * APPEARANCE;
                sums[0] = sum(found.opacity);
                if (ATTENUATION) sums[1] = sum(found.attenuation);
                for (int c = 0; c < CHANNELS; c++) sums[1 + ATTENUATION + c] = sum(found.signal[c]);
            }
        }
        for (int k = 0; k < count; k++, partial += PARTIALS) {
            entry_t entry = clipped[k];
            moments_t moments = {0};
            for (int r = entry.first; r <= entry.last; r++)
                add_moments(&moments, chunk.flow[k][r], offsets_of(views + k, r));
#if SEPARABLE
            moments.s *= views[k].s;
            moments.ss = moments.s * views[k].s;
            moments.sy = moments.y * views[k].s;
#endif
            partial[0] = sum(moments.s);
            partial[1] = sum(moments.y);
            partial[2] = sum(moments.ss);
            partial[3] = sum(moments.sy);
            partial[4] = sum(moments.yy);
        }
    }
}

/* Adds up the partial sums of one block of splats over tiles, in the tiles' order and as far as they were composited,
 * and turns them into gradients of the host's inputs.
 *
 * With z = (s, y) = h L^-1 x and h^2 = log2(e) / 2,
 *
 *   d(log G)/d(mean) = L^-T z / h        d(log G)/dL = the lower triangle of L^-T z z' / h^2
 *
 * and L^-T / h = [across, -shear; 0, along] / h^2. */
kernel void gather(sizes_t sizes, global const int *order, global const int *blocks, global const int *ends,
                   global const uint *entries, global const float *geometry, global const float *appearance,
                   global const float *partials, global float *means, global float *factors, global float *signal,
                   global float *opacities, global float *attenuations) {
    int block = get_global_id(0), base = block * BLOCK * 32, rest = sizes.splats - base, size = LEAST(rest, BLOCK * 32);
    int tiles = sizes.down * sizes.across, together = sizes.sets == 1; /* one set of lists, walked by every group */
    float sums[BLOCK * 32][PARTIALS], centres[BLOCK * 32][2];
    for (int j = 0; j < size; j++) centres[j][0] = centres[j][1] = 0;
    for (int group = 0; group < sizes.groups; group++) {
        int set = together ? 0 : group, first = group * sizes.group;
        for (int j = 0; j < size; j++)
            for (int p = together && group ? MOMENTS : 0; p < PARTIALS; p++) sums[j][p] = 0;
        for (int tile = 0; tile < tiles; tile++) {
            global const int *bounds = blocks + (set * tiles + tile) * (BLOCKS(sizes) + 1) + block;
            int end = LEAST(bounds[1], ends[group * tiles + tile]);
            for (int k = bounds[0]; k < end; k++) {
                float *sum = sums[unpack(entries[k]).splat - base];
                for (int p = 0; p < PARTIALS; p++) sum[p] += partials[(size_t)k * PARTIALS + p];
            }
        }
        if (together) partials += (size_t)sizes.entries * PARTIALS;
        for (int j = 0; j < size; j++) {
            int i = base + j, to = order[i];
            for (int t = first; t < LEAST(first + sizes.group, sizes.transmitters); t++) {
                float *found = sums[j] + MOMENTS + (t - first) * APPEARANCE;
                global const float *look = appearance + (i * sizes.transmitters + t) * APPEARANCE;
                int at = t * sizes.splats + to;
                opacities[at] = found[0] == 0 ? 0 : found[0] / look[0];
#if ATTENUATION
                attenuations[at] = look[1] == OPAQUE ? 0 : found[1] / fmax(exp2(look[1]), STEEPEST);
#endif
                for (int c = 0; c < CHANNELS; c++) signal[at * CHANNELS + c] = found[1 + ATTENUATION + c];
            }
            if (together && group < sizes.groups - 1) continue;
            splat_t splat = load_splat(geometry + (set * sizes.words * 32 + i) * GEOMETRY);
            const float inverse = 1.38629436f; /* 1 / h^2 */
            float a = splat.across, b = splat.along, k = splat.shear;
            float s = sums[j][0], y = sums[j][1], ss = sums[j][2], sy = sums[j][3], yy = sums[j][4];
            centres[j][0] += inverse * (a * s - k * y);
            centres[j][1] += inverse * b * y;
            global float *factor = factors + (set * sizes.splats + to) * 3;
            const float root = 1.17741002f; /* 1 / h */
            factor[0] = inverse * root * (a * ss - k * sy);
            factor[1] = inverse * root * b * sy;
            factor[2] = inverse * root * b * yy;
        }
    }
    for (int j = 0; j < size; j++)
        for (int x = 0; x < 2; x++) means[2 * order[base + j] + x] = centres[j][x];
}
