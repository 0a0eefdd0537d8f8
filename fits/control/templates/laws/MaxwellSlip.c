/* Springs that stick, then slip; it remembers where they are relaxed. */
static double law_step(${name}_memory *memory, double x_um)
{
    double sum = LAW_offset_um + (LAW_slope_um_per_V * x_um);
    int k;

    for (k = 0; k < LAW_COUNT; k++) {
        const double reach = LAW_limit_um[k] / LAW_stiffness_um_per_V[k];
        memory->x[k] = fmax(x_um - reach, fmin(x_um + reach, memory->x[k]));
        sum -= LAW_stiffness_um_per_V[k] * (x_um - memory->x[k]);
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
