/* The way back: front to back once more through the entries of a tile, and from its pixels to the splats. */

/* What a tile hands back to an entry: moments of the gradient, then each transmitter's gradient of the appearance. */
#define MOMENTS 5
#define PARTIALS (MOMENTS + TRANSMITTERS * APPEARANCE)

/* One transmitter's state over a tile: T, S and the gradient of the map. */
typedef struct {
    lanes transmittance[ROWS], behind[ROWS], gradient[CHANNELS][ROWS];
} state_t;

/* Gradients of one splat's appearance, summed over rows. */
typedef struct {
    lanes opacity, attenuation, signal[CHANNELS];
} found_t;

/* Passes an entry at one row, and returns the gradient of log G.
 *
 * With D = signal . gradient at a pixel, and S_i = sum_{j>i} D_j A_j T_j + left gradient_left what all behind it adds,
 *
 *   d/dA_i = T_i D_i - S_i / (1 - A_i)        d/d(log d_i) = G_i S_i
 *
 * S starts as the whole, image . gradient + left gradient_left, and loses a splat's own part when the splat is passed,
 * so that the walk is the forward's own. Where A is clamped, d/dA goes nowhere. */
static inline lanes pass(state_t *state, int r, lanes g, global const float *look, found_t *found) {
    lanes raw = g * look[0], before = state->transmittance[r], d = 0;
    masks acts = ~(raw < ALPHA_MIN);
    lanes alpha = MASKED(acts, LEAST(raw, ALPHA_MAX)), weight = alpha * before;
#pragma unroll
    for (int c = 0; c < CHANNELS; c++) {
        d += state->gradient[c][r] * look[1 + ATTENUATION + c];
        found->signal[c] += state->gradient[c][r] * weight;
    }
    lanes behind = state->behind[r] - weight * d, after = before - weight;
    lanes flow = MASKED(~(raw >= ALPHA_MAX), alpha * (before * d - behind / (1 - alpha)));
    found->opacity += flow;
#if ATTENUATION
    lanes covered = MASKED(acts, g * behind);
    found->attenuation += covered;
    flow += covered * (look[1] * 0.693147181f); /* log d */
    after *= power_of_two(MASKED(acts, g * look[1]));
#endif
    state->behind[r] = behind;
    state->transmittance[r] = after;
    return flow;
}

/* Moments of the gradient of log G over the pixels, in whitened coordinates: centre and covariance follow from them. */
typedef struct {
    lanes s, y, ss, sy, yy;
} moments_t;

static inline void add_moments(moments_t *moments, lanes flow, offsets_t at) {
#if SEPARABLE
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

kernel void backward(sizes_t sizes, global const float *u, global const float *v, global const int *offsets,
                     global const int *counts, global const uint *entries, global const float *geometry,
                     global const float *appearance, global const float *image, global const float *left,
                     global const float *image_gradient, global const float *left_gradient, global const int *stops,
                     global float *partials) {
    job_t job = find_job(sizes, get_global_id(0), offsets, counts);
    int area = sizes.height * sizes.width, stop = stops[get_global_id(0)];
    if (sizes.sets > 1)
        geometry += job.first * sizes.words * 32 * GEOMETRY;
    else
        partials += get_global_id(0) / (sizes.down * sizes.across) * (size_t)sizes.entries * PARTIALS;
    appearance += job.first * APPEARANCE;
    state_t states[TRANSMITTERS];
    for (int t = 0; t < job.count; t++) {
        int plane = (job.first + t) * area;
        for (int r = 0; r < ROWS; r++) {
            states[t].transmittance[r] = 1;
            states[t].behind[r] = load_row(left + plane, sizes, job, r);
            states[t].behind[r] *= load_row(left_gradient + plane, sizes, job, r);
            for (int c = 0; c < CHANNELS; c++) {
                int channel = plane * CHANNELS + c * area;
                states[t].gradient[c][r] = load_row(image_gradient + channel, sizes, job, r);
                states[t].behind[r] += states[t].gradient[c][r] * load_row(image + channel, sizes, job, r);
            }
        }
    }
    for (int k = job.begin; k < stop; k++) {
        uint entry = entries[k], i = entry & 0xffffff, first = entry >> 24 & 15, last = entry >> 28;
        view_t view = view_splat(load_splat(geometry + i * GEOMETRY), u, v, sizes, job.tile);
        global const float *looks = appearance + i * sizes.transmitters * APPEARANCE;
        global float *partial = partials + (size_t)k * PARTIALS;
        moments_t moments = {0, 0, 0, 0, 0};
        lanes footprints[ROWS], flows[ROWS];
        for (uint r = first; r <= last; r++) {
            footprints[r] = footprint(offsets_of(&view, r));
            flows[r] = 0;
        }
        for (int t = 0; t < job.count; t++) {
            global const float *look = looks + t * APPEARANCE;
            found_t found = {0};
            for (uint r = first; r <= last; r++) flows[r] += pass(states + t, r, footprints[r], look, &found);
            global float *sums = partial + MOMENTS + t * APPEARANCE;
            sums[0] = sum(found.opacity);
            if (ATTENUATION) sums[1] = sum(found.attenuation);
            for (int c = 0; c < CHANNELS; c++) sums[1 + ATTENUATION + c] = sum(found.signal[c]);
        }
        for (uint r = first; r <= last; r++) add_moments(&moments, flows[r], offsets_of(&view, r));
#if SEPARABLE
        moments.s *= view.s;
        moments.ss = moments.s * view.s;
        moments.sy = moments.y * view.s;
#endif
        partial[0] = sum(moments.s);
        partial[1] = sum(moments.y);
        partial[2] = sum(moments.ss);
        partial[3] = sum(moments.sy);
        partial[4] = sum(moments.yy);
    }
    for (size_t j = (size_t)stop * PARTIALS; j < (size_t)job.end * PARTIALS; j++) partials[j] = 0;
}

/* Adds up the partial sums of 32 splats over tiles, in the tiles' order, and turns them into gradients of what the host
 * handed over.
 *
 * With z = (s, y) = h L^-1 x and h^2 = log2(e) / 2,
 *
 *   d(log G)/d(mean) = L^-T z / h        d(log G)/dC = L^-T z z' L^-1 / (2 h^2)
 *
 * and L^-T / h = [across, -shear; 0, along] / h^2. */
kernel void gather(sizes_t sizes, global const int *order, global const uint *bits, global const int *ranks,
                   global const float *geometry, global const float *appearance, global const float *partials,
                   global float *means, global float *covariances, global float *signal, global float *opacities,
                   global float *attenuations) {
    int word = get_global_id(0), rest = sizes.splats - word * 32, size = LEAST(rest, 32);
    int tiles = sizes.down * sizes.across, shared_set = sizes.sets == 1;
    float sums[32][PARTIALS], centres[32][2];
    for (int j = 0; j < 32; j++) centres[j][0] = centres[j][1] = 0;
    for (int group = 0; group < sizes.groups; group++) {
        int set = shared_set ? 0 : group, first = group * sizes.group;
        for (int j = 0; j < size; j++)
            for (int p = shared_set && group ? MOMENTS : 0; p < PARTIALS; p++) sums[j][p] = 0;
        for (int tile = 0; tile < tiles; tile++) {
            int at = (set * tiles + tile) * sizes.words + word;
            global const float *partial = partials + (size_t)ranks[at] * PARTIALS;
            for (uint left = bits[at]; left; left &= left - 1, partial += PARTIALS)
                for (int p = 0; p < PARTIALS; p++) sums[LOWEST(left)][p] += partial[p];
        }
        if (shared_set) partials += (size_t)sizes.entries * PARTIALS;
        for (int j = 0; j < size; j++) {
            int i = word * 32 + j, to = order[i];
            for (int t = first; t < LEAST(first + sizes.group, sizes.transmitters); t++) {
                float *found = sums[j] + MOMENTS + (t - first) * APPEARANCE;
                global const float *look = appearance + (i * sizes.transmitters + t) * APPEARANCE;
                int at = t * sizes.splats + to;
                opacities[at] = found[0] == 0 ? 0 : found[0] / look[0];
#if ATTENUATION
                attenuations[at] = found[1] == 0 ? 0 : found[1] / exp2(look[1]);
#endif
                for (int c = 0; c < CHANNELS; c++) signal[at * CHANNELS + c] = found[1 + ATTENUATION + c];
            }
            if (shared_set && group < sizes.groups - 1) continue;
            splat_t splat = load_splat(geometry + (set * sizes.words * 32 + i) * GEOMETRY);
            const float inverse = 1.38629436f; /* 1 / h^2 */
            float a = splat.across, b = splat.along, k = splat.shear;
            float s = sums[j][0], y = sums[j][1], ss = sums[j][2], sy = sums[j][3], yy = sums[j][4];
            centres[j][0] += inverse * (a * s - k * y);
            centres[j][1] += inverse * b * y;
            global float *covariance = covariances + (set * sizes.splats + to) * 4;
            float scale = .5f * inverse * inverse;
            covariance[0] = scale * (a * a * ss - 2 * a * k * sy + k * k * yy);
            covariance[1] = covariance[2] = scale * b * (a * sy - k * yy);
            covariance[3] = scale * b * b * yy;
        }
    }
    for (int j = 0; j < size; j++)
        for (int x = 0; x < 2; x++) means[2 * order[word * 32 + j] + x] = centres[j][x];
}
