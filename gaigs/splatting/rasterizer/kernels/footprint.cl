/* Shared by all kernels: sizes, the geometry of a splat, and its footprint.
 *
 * With the factor L = [p, 0; q, r] of a splat's covariance C = L L' the footprint exp(-x' C^-1 x / 2) is 2^-(s^2 + y^2), where
 * (s, y) = sqrt(log2(e) / 2) L^-1 x depends on x = (du, dv) as s = across du and y = along dv - shear du. Of all forms
 * of the exponent this one loses the fewest digits to cancellation, and where u depends on the column alone, s^2 and
 * shear du are one value a column.
 *
 * The host defines
 *   CHANNELS      colours of a splat
 *   ATTENUATION   1 where splats attenuate beyond their own opacity
 *   TRANSMITTERS  most transmitters that one work-item composites; they share covariances, hence footprints
 *   SEPARABLE     1 where u depends on the column alone and v on the row alone
 *   PERIOD        the period of u, where it has one, as PERIOD + PERIOD_REST, the second below the first one's rounding
 *   ALPHA_MIN, ALPHA_MAX, OPAQUE, STEEPEST
 *
 * A tile is ROWS rows of COLUMNS pixels; a row is one vector, `lanes`. Inner loops hold operators only: calls of
 * OpenCL's own functions stay calls on PoCL, lane by lane.
 */

#define ROWS 16
#define COLUMNS 8

typedef float8 lanes;
typedef int8 masks;
typedef float8 __attribute__((aligned(4))) loose_lanes; /* in memory where nothing aligns them */
typedef int8 __attribute__((aligned(4))) loose_masks;

#define MASKED(mask, value) as_float8((mask) & as_int8(value))
/* NaN in `a` stays, as in all comparisons of these kernels: it must show in the map. */
#define LEAST(a, b) ((b) < (a) ? (b) : (a))
#define MOST(a, b) ((b) > (a) ? (b) : (a))
/* The place of the lowest of 64 bits: a float's exponent, beside its sign. */
#define LOWEST(bits) ((as_int((float)(long)((bits) & -(bits))) >> 23 & 255) - 127)

typedef struct {
    int transmitters, sets, groups, group; /* sets of lists; groups of `group` transmitters, which share a work-item */
    int splats, words;                     /* words of 32 splats, the last one filled up */
    int height, width, down, across;       /* of the image, in pixels and in tiles */
    int entries;                           /* of all lists */
} sizes_t;

/* Rows of the buffers that `prepare` fills. */
#define GEOMETRY 8
#define APPEARANCE (1 + ATTENUATION + CHANNELS) /* opacity, log2 of the attenuation, signal */

typedef struct {
    float u, v;                 /* centre */
    float across, along, shear; /* the whitening (s, y) */
    float reach;                /* the opacity is ALPHA_MIN where s^2 + y^2 = reach^2, ... */
    float crest;                /* ... an ellipse whose highest point lies at du = crest */
} splat_t;

static inline splat_t load_splat(global const float *row) {
    return (splat_t){row[0], row[1], row[2], row[3], row[4], row[5], row[6]};
}

/* du = a - b taken to the nearest image. The period is subtracted from the exact a - b = difference + rest (Knuth's
 * two-sum), since at the seam du is smaller by far than the rounding error of a - b alone. */
#ifdef PERIOD
#define OFFSET(type)                                                                                                   \
    static inline type offset_##type(type a, float b) {                                                                \
        type difference = a - b, back = difference - a;                                                                \
        type rest = (a - (difference - back)) - (b + back);                                                            \
        type turns = difference * (1 / PERIOD) + 12582912.f; /* 1.5 2^23: adding it rounds */                          \
        turns = turns - 12582912.f;                                                                                    \
        return (difference - turns * PERIOD) + (rest - turns * PERIOD_REST);                                           \
    }
#else
#define OFFSET(type)                                                                                                   \
    static inline type offset_##type(type a, float b) { return a - b; }
#endif
OFFSET(float)
OFFSET(lanes)

/* 2^x for x <= 0, to 1.6e-7 relatively and exact at 0: x = n + f with |f| <= 1/2, a minimax polynomial for 2^f, and n
 * added to its exponent. Nothing below 2^-60 matters, and products with it stay clear of slow subnormal numbers. */
static inline lanes power_of_two(lanes x) {
    x = MOST(x, -60.f);
    lanes n = x + 12582912.f;
    lanes f = x - (n - 12582912.f);
    lanes p = f * 1.32746331e-3f + 9.67196189e-3f;
    p = p * f + 5.55067845e-2f;
    p = p * f + 2.4022235e-1f;
    p = p * f + 6.93147063e-1f;
    p = p * f + 1.f;
    return as_float8(as_int8(p) + (as_int8(n) << 23));
}

/* A splat against a tile: along dv of each row, s^2 and shear du of each column. Where the plane is not separable, only
 * the coordinates' place is kept. */
typedef struct {
    splat_t splat;
#if SEPARABLE
    lanes s, square, skew;
    float height[ROWS];
#else
    global const float *u, *v;
    int pitch;
#endif
} view_t;

static inline view_t view_splat(splat_t splat, global const float *u, global const float *v, sizes_t sizes, int tile) {
    int x = tile % sizes.across * COLUMNS, y = tile / sizes.across * ROWS;
    view_t view;
    view.splat = splat;
#if SEPARABLE
    lanes du = offset_lanes(*(global const loose_lanes *)(u + x), splat.u);
    view.s = du * splat.across;
    view.square = view.s * view.s;
    view.skew = du * splat.shear;
    for (int r = 0; r < ROWS; r++) view.height[r] = (v[y + r] - splat.v) * splat.along;
#else
    view.pitch = sizes.across * COLUMNS;
    view.u = u + y * view.pitch + x;
    view.v = v + y * view.pitch + x;
#endif
    return view;
}

/* The whitened offsets (s, y) of one row. */
typedef struct {
    lanes s, y, square;
} offsets_t;

static inline offsets_t offsets_of(const view_t *view, int row) {
#if SEPARABLE
    return (offsets_t){view->s, view->height[row] - view->skew, view->square};
#else
    splat_t splat = view->splat;
    lanes du = offset_lanes(*(global const loose_lanes *)(view->u + row * view->pitch), splat.u);
    lanes dv = *(global const loose_lanes *)(view->v + row * view->pitch) - splat.v;
    lanes s = du * splat.across;
    return (offsets_t){s, dv * splat.along - du * splat.shear, s * s};
#endif
}

static inline lanes footprint(offsets_t at) { return power_of_two(-at.y * at.y - at.square); }
