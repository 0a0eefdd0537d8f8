/* Dahl's friction; it remembers the displacement, and its state from -1 to 1. */
static double law_step(${name}_memory *memory, double x_um)
{
    const double move = x_um - memory->x[0];
    const double kept = exp(-fabs(move) / LAW_length_V);
    const double limit = (move > 0.0) ? 1.0 : ((move < 0.0) ? -1.0 : memory->x[1]);

    memory->x[0] = x_um;
    memory->x[1] = limit + (kept * (memory->x[1] - limit));
    return LAW_offset_um + (LAW_slope_um_per_V * x_um) - (LAW_amplitude_um * memory->x[1]);
}

static double law_begin(${name}_memory *memory, double x_um)
{
    memory->x[0] = x_um;
    memory->x[1] = 0.0;
    return law_step(memory, x_um);
}
