/* Duhem's law; it remembers the displacement, and its distance from the curve in um. */
static double law_step(${name}_memory *memory, double x_um)
{
    const double move = x_um - memory->x[0];
    const double steps = LAW_pursuit_per_V * fabs(move);
    const double lead = LAW_local_um_per_V - LAW_slope_um_per_V - (2.0 * LAW_curvature_um_per_V2 * memory->x[0]);
    const double bend = 2.0 * LAW_curvature_um_per_V2 * move;
    /* (1 - exp(-s)) / s, and (s - 1 + exp(-s)) / s^2, which cancel where s is small. */
    double decay = 1.0 - (steps * (0.5 - (steps * ((1.0 / 6.0) - (steps / 24.0)))));
    double ramp = 0.5 - (steps * ((1.0 / 6.0) - (steps * ((1.0 / 24.0) - (steps / 120.0)))));

    if (steps > 1e-3) {
        decay = -expm1(-steps) / steps;
        ramp = (1.0 - decay) / steps;
    }
    memory->x[0] = x_um;
    memory->x[1] = (exp(-steps) * memory->x[1]) + (move * ((lead * decay) - (bend * ramp)));
    return LAW_offset_um + (x_um * (LAW_slope_um_per_V + (LAW_curvature_um_per_V2 * x_um))) + memory->x[1];
}

static double law_begin(${name}_memory *memory, double x_um)
{
    memory->x[0] = x_um;
    memory->x[1] = 0.0;
    return law_step(memory, x_um);
}
