/* Front to back through the entries of a tile. A work-item is one tile of one group of transmitters: group g holds
 * transmitters g group .. (g + 1) group - 1, and reads list set g where there are several.
 *
 * Images are (transmitters, CHANNELS, height, width); `left` is the transmittance behind the last splat.
 */

/* Entries from one checkpoint to the next. There the transmittance is kept for the way back, and a tile's upper and
 * lower rows end where the remainder behind, at most the row's largest transmittance times the loudest signal, changes
 * no pixel of theirs by more than NEGLIGIBLE of the tile's largest value. In doubt (NaN) they go on. */
#define CHUNK 32
#define NEGLIGIBLE 5e-7f

typedef struct {
    int tile, x, y;   /* the tile and its first pixel */
    int first, count; /* transmitters */
    int begin, end;   /* entries */
    int checkpoint;   /* the first of the tile's; each holds TRANSMITTERS rows of ROWS COLUMNS values */
} job_t;

static inline job_t find_job(sizes_t sizes, int item, global const int *offsets, global const int *counts) {
    int tiles = sizes.down * sizes.across, tile = item % tiles, group = item / tiles;
    int list = sizes.sets == 1 ? tile : item, first = group * sizes.group, rest = sizes.transmitters - first;
    job_t job = {tile, tile % sizes.across * COLUMNS, tile / sizes.across * ROWS, first, LEAST(rest, sizes.group)};
    job.begin = offsets[list];
    job.end = job.begin + counts[list];
    job.checkpoint = job.begin / CHUNK + list; /* a list ends within its last checkpoint: one more for each */
    if (sizes.sets == 1) job.checkpoint += group * (sizes.entries / CHUNK + tiles);
    return job;
}

/* Where a transmitter's transmittance in one row is kept. */
static inline size_t find_row(int checkpoint, int transmitter, int row) {
    return (((size_t)checkpoint * TRANSMITTERS + transmitter) * ROWS + row) * COLUMNS;
}

static inline void store_row(lanes value, global float *image, sizes_t sizes, job_t job, int row) {
    global float *pixels = image + (job.y + row) * sizes.width + job.x;
    int inside = job.y + row < sizes.height ? sizes.width - job.x : 0;
    if (inside >= COLUMNS)
        *(global loose_lanes *)pixels = value;
    else
        for (int x = 0; x < inside; x++) pixels[x] = ((float *)&value)[x];
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

/* A of a splat in one row, 0 where it does nothing. */
static inline lanes alpha_of(lanes g, global const float *look) {
    lanes alpha = g * look[0];
    return MASKED(~(alpha < ALPHA_MIN), LEAST(alpha, ALPHA_MAX));
}

#if ATTENUATION
/* d^G of a splat in one row, 1 where it does nothing. */
static inline lanes attenuation_of(lanes g, lanes alpha, global const float *look) {
    return power_of_two(MASKED(alpha != 0, g * look[1]));
}
#endif

/* One transmitter's map over a tile, as far as it is composited. */
typedef struct {
    lanes transmittance[ROWS], colour[CHANNELS][ROWS];
} map_t;

/* Lays an entry under one row: the map gains signal A T, and T becomes T (1 - A) d^G. */
static inline void blend(map_t *map, int r, lanes g, global const float *look) {
    lanes alpha = alpha_of(g, look), before = map->transmittance[r], weight = alpha * before, after = before - weight;
#if ATTENUATION
    after *= attenuation_of(g, alpha, look);
#endif
    map->transmittance[r] = after;
#pragma unroll
    for (int c = 0; c < CHANNELS; c++) map->colour[c][r] += weight * look[1 + ATTENUATION + c];
}

/* The rows of a tile that have not ended. */
typedef struct {
    int first, last;
} rows_t;

static inline entry_t clip(entry_t entry, rows_t rows) {
    return (entry_t){entry.splat, MOST(entry.first, rows.first), LEAST(entry.last, rows.last)};
}

static inline int has_ended(const map_t *maps, int row, job_t job, global const float *loudest, const float *bright) {
    for (int t = 0; t < job.count; t++) {
        float dark = largest(maps[t].transmittance + row, 1);
        if (!(dark <= NEGLIGIBLE && dark * loudest[job.first + t] <= NEGLIGIBLE * bright[t])) return 0;
    }
    return 1;
}

static inline rows_t end_rows(rows_t rows, const map_t *maps, job_t job, global const float *loudest) {
    float bright[TRANSMITTERS];
    for (int t = 0; t < job.count; t++) bright[t] = largest(maps[t].colour[0], CHANNELS * ROWS);
    while (rows.first <= rows.last && has_ended(maps, rows.first, job, loudest, bright)) rows.first++;
    while (rows.first <= rows.last && has_ended(maps, rows.last, job, loudest, bright)) rows.last--;
    return rows;
}

/* `checkpoints`, and the rows that had not ended at each, may be null: no gradient is wanted. */
kernel void forward(sizes_t sizes, global const float *u, global const float *v, global const int *offsets,
                    global const int *counts, global const uint *entries, global const float *geometry,
                    global const float *appearance, global const float *loudest, global float *image,
                    global float *left, global int *ends, global float *checkpoints, global rows_t *bounds) {
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
    rows_t rows = {0, ROWS - 1};
    int k = job.begin;
    while (k < job.end && rows.first <= rows.last) {
        if (checkpoints) {
            for (int t = 0; t < job.count; t++)
                for (int r = 0; r < ROWS; r++)
                    *(global loose_lanes *)(checkpoints + find_row(job.checkpoint, t, r)) = maps[t].transmittance[r];
            bounds[job.checkpoint++] = rows;
        }
        for (int pause = LEAST(k + CHUNK, job.end); k < pause; k++) {
            entry_t entry = clip(unpack(entries[k]), rows);
            if (entry.first > entry.last) continue;
            view_t view = view_splat(load_splat(geometry + entry.splat * GEOMETRY), u, v, sizes, job.tile);
            global const float *looks = appearance + entry.splat * sizes.transmitters * APPEARANCE;
            lanes footprints[ROWS];
            for (int r = entry.first; r <= entry.last; r++) footprints[r] = footprint(offsets_of(&view, r));
            for (int t = 0; t < job.count; t++)
                for (int r = entry.first; r <= entry.last; r++)
                    blend(maps + t, r, footprints[r], looks + t * APPEARANCE);
        }
        rows = end_rows(rows, maps, job, loudest);
    }
    ends[get_global_id(0)] = k;
    for (int t = 0; t < job.count; t++)
        for (int r = 0; r < ROWS; r++) {
            store_row(maps[t].transmittance[r], left + (job.first + t) * area, sizes, job, r);
            for (int c = 0; c < CHANNELS; c++)
                store_row(maps[t].colour[c][r], image + ((job.first + t) * CHANNELS + c) * area, sizes, job, r);
        }
}
