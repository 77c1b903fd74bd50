/* Front to back through the entries of a tile. A work-item is one tile of one group of transmitters: group g holds
 * transmitters g group .. (g + 1) group - 1, and reads list set g where there are several.
 *
 * Images are (transmitters, CHANNELS, height, width); `left` is the transmittance behind the last splat.
 */

/* A tile is done where what remains behind, at most its largest transmittance times the loudest signal, can change none
 * of its pixels by more than this part of its largest value. In doubt (NaN) it goes on. */
#define NEGLIGIBLE 1e-7f

typedef struct {
    int tile, x, y;   /* the tile and its first pixel */
    int first, count; /* transmitters */
    int begin, end;   /* entries */
} job_t;

static inline job_t find_job(sizes_t sizes, int item, global const int *offsets, global const int *counts) {
    int tiles = sizes.down * sizes.across, tile = item % tiles, list = sizes.sets == 1 ? tile : item;
    int first = item / tiles * sizes.group, rest = sizes.transmitters - first, begin = offsets[list];
    int x = tile % sizes.across * COLUMNS, y = tile / sizes.across * ROWS;
    return (job_t){tile, x, y, first, LEAST(rest, sizes.group), begin, begin + counts[list]};
}

/* One row of a tile from or to an image; pixels beyond its edges read 0. */
static inline lanes load_row(global const float *image, sizes_t sizes, job_t job, int row) {
    global const float *pixels = image + (job.y + row) * sizes.width + job.x;
    int inside = job.y + row < sizes.height ? sizes.width - job.x : 0;
    if (inside >= COLUMNS) return *(global const loose_lanes *)pixels;
    float value[COLUMNS];
    for (int x = 0; x < COLUMNS; x++) value[x] = x < inside ? pixels[x] : 0;
    return *(loose_lanes *)value;
}

static inline void store_row(lanes value, global float *image, sizes_t sizes, job_t job, int row) {
    global float *pixels = image + (job.y + row) * sizes.width + job.x;
    int inside = job.y + row < sizes.height ? sizes.width - job.x : 0;
    if (inside >= COLUMNS)
        *(global loose_lanes *)pixels = value;
    else
        for (int x = 0; x < inside; x++) pixels[x] = ((float *)&value)[x];
}

static inline float sum(lanes v) {
    float4 a = v.lo + v.hi;
    float2 b = a.lo + a.hi;
    return b.lo + b.hi;
}

/* The largest absolute value; as integers, which order like the floats. */
static inline float largest(const lanes *rows, int count) {
    masks most = 0;
    for (int r = 0; r < count; r++) {
        masks bits = as_int8(rows[r]) & 0x7fffffff;
        most = MOST(bits, most);
    }
    int4 a = MOST(most.lo, most.hi);
    int2 b = MOST(a.lo, a.hi);
    return as_float(MOST(b.lo, b.hi));
}

/* One transmitter's map over a tile, as far as it is composited. */
typedef struct {
    lanes transmittance[ROWS], colour[CHANNELS][ROWS];
} map_t;

/* Lays an entry under one row: the map gains signal A T, and T becomes T (1 - A) d^G. */
static inline void blend(map_t *map, int r, lanes g, global const float *look) {
    lanes raw = g * look[0], before = map->transmittance[r];
    masks acts = ~(raw < ALPHA_MIN);
    lanes weight = MASKED(acts, LEAST(raw, ALPHA_MAX)) * before, after = before - weight;
#if ATTENUATION
    after *= power_of_two(MASKED(acts, g * look[1]));
#endif
    map->transmittance[r] = after;
#pragma unroll
    for (int c = 0; c < CHANNELS; c++) map->colour[c][r] += weight * look[1 + ATTENUATION + c];
}

kernel void forward(sizes_t sizes, global const float *u, global const float *v, global const int *offsets,
                    global const int *counts, global const uint *entries, global const float *geometry,
                    global const float *appearance, global const float *loudest, global float *image,
                    global float *left, global int *stops) {
    job_t job = find_job(sizes, get_global_id(0), offsets, counts);
    int area = sizes.height * sizes.width;
    if (sizes.sets > 1) geometry += job.first * sizes.words * 32 * GEOMETRY;
    appearance += job.first * APPEARANCE;
    map_t maps[TRANSMITTERS];
    for (int t = 0; t < job.count; t++)
        for (int r = 0; r < ROWS; r++) {
            maps[t].transmittance[r] = 1;
            for (int c = 0; c < CHANNELS; c++) maps[t].colour[c][r] = 0;
        }
    int done = 0, k = job.begin;
    while (k < job.end && done < job.count) {
        for (int pause = LEAST(k + 16, job.end); k < pause; k++) {
            uint entry = entries[k], i = entry & 0xffffff, first = entry >> 24 & 15, last = entry >> 28;
            view_t view = view_splat(load_splat(geometry + i * GEOMETRY), u, v, sizes, job.tile);
            global const float *looks = appearance + i * sizes.transmitters * APPEARANCE;
            lanes footprints[ROWS];
            for (uint r = first; r <= last; r++) footprints[r] = footprint(offsets_of(&view, r));
            for (int t = 0; t < job.count; t++)
                for (uint r = first; r <= last; r++) blend(maps + t, r, footprints[r], looks + t * APPEARANCE);
        }
        for (done = 0; done < job.count; done++) {
            float dark = largest(maps[done].transmittance, ROWS);
            if (!(dark <= NEGLIGIBLE)) break;
            float bright = largest(maps[done].colour[0], CHANNELS * ROWS);
            if (!(dark * loudest[job.first + done] <= NEGLIGIBLE * bright)) break;
        }
    }
    stops[get_global_id(0)] = k;
    for (int t = 0; t < job.count; t++)
        for (int r = 0; r < ROWS; r++) {
            store_row(maps[t].transmittance[r], left + (job.first + t) * area, sizes, job, r);
            for (int c = 0; c < CHANNELS; c++)
                store_row(maps[t].colour[c][r], image + ((job.first + t) * CHANNELS + c) * area, sizes, job, r);
        }
}
