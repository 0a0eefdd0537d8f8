/* Plays; it remembers where they stand. */
static double law_step(${name}_memory *memory, double x_um)
{
    double sum = LAW_offset_um + (LAW_slope_um_per_V * x_um);
    int k;

    for (k = 0; k < LAW_COUNT; k++) {
        memory->x[k] = fmax(x_um - LAW_threshold_V[k], fmin(x_um + LAW_threshold_V[k], memory->x[k]));
        sum += LAW_weight_um_per_V[k] * memory->x[k];
    }
    return sum;
}

static double law_begin(${name}_memory *memory, double x_um)
{
    int k;

    for (k = 0; k < LAW_COUNT; k++) {
        memory->x[k] = 0.0;
    }
    return law_step(memory, x_um);
}
