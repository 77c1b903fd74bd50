/* The arithmetic of the kernels of rasterizer opencl alone, to be compiled behind them. */

/* One splat that covers a whole tile, passed over and over; memory holds its appearance and its offsets, all small. */
static inline view_t view_still(global const float *memory) {
    view_t view;
    view.s = view.square = view.skew = memory[0];
    for (int r = 0; r < ROWS; r++) view.height[r] = memory[r];
    return view;
}

kernel void ceiling_forward(global float *memory, int chunks) {
    view_t view = view_still(memory);
    map_t map;
    lanes footprints[ROWS], all = 0;
    for (int r = 0; r < ROWS; r++)
        for (int c = 0; c < CHANNELS; c++) map.colour[c][r] = 0;
    for (int chunk = 0; chunk < chunks; chunk++) {
        for (int r = 0; r < ROWS; r++) map.transmittance[r] = 1;
        for (int k = 0; k < CHUNK; k++, view.square += 1e-6f) {
            for (int r = 0; r < ROWS; r++) footprints[r] = footprint(offsets_of(&view, r));
            for (int r = 0; r < ROWS; r++) blend(&map, r, footprints[r], memory);
        }
    }
    for (int r = 0; r < ROWS; r++)
        for (int c = 0; c < CHANNELS; c++) all += map.colour[c][r];
    memory[64 + get_global_id(0)] = sum(all);
}

kernel void ceiling_backward(global float *memory, int chunks) {
    view_t view = view_still(memory);
    chunk_t chunk;
    found_t found = {0};
    moments_t moments = {0};
    lanes transmittance[ROWS], behind[ROWS], gradient[CHANNELS][ROWS];
    for (int r = 0; r < ROWS; r++)
        for (int c = 0; c < CHANNELS; c++) gradient[c][r] = memory[c];
    for (int number = 0; number < chunks; number++) {
        for (int r = 0; r < ROWS; r++) transmittance[r] = behind[r] = 1;
        for (int k = 0; k < CHUNK; k++, view.square += 1e-6f)
            for (int r = 0; r < ROWS; r++) {
                chunk.footprint[k][r] = footprint(offsets_of(&view, r));
                chunk.flow[k][r] = 0;
            }
        for (int k = 0; k < CHUNK; k++)
            for (int r = 0; r < ROWS; r++) pass_forward(&chunk, k, r, transmittance + r, memory);
        for (int k = CHUNK - 1; k >= 0; k--)
            for (int r = 0; r < ROWS; r++) pass_back(&chunk, k, r, behind + r, gradient[0] + r, memory, &found);
        for (int k = 0; k < CHUNK; k++)
            for (int r = 0; r < ROWS; r++) add_moments(&moments, chunk.flow[k][r], offsets_of(&view, r));
    }
    lanes all = found.opacity + found.attenuation + moments.s + moments.y + moments.yy;
    for (int c = 0; c < CHANNELS; c++) all += found.signal[c];
    memory[64 + get_global_id(0)] = sum(all);
}
