/* The law of Bouc and Wen; it remembers the displacement, and its state in um. */
static double law_slope(double h, double sign)
{
    const double size = fabs(h);
    const double turn = (h > 0.0) ? sign : ((h < 0.0) ? -sign : 0.0);

    return LAW_stiffness_um_per_V - (pow(size, LAW_exponent) * (LAW_gamma + (LAW_beta * turn)));
}

static double law_step(${name}_memory *memory, double x_um)
{
    const double move = (x_um - memory->x[0]) / (double)LAW_substeps;
    const double sign = (move > 0.0) ? 1.0 : ((move < 0.0) ? -1.0 : 0.0);
    double h = memory->x[1];
    int n;

    for (n = 0; n < LAW_substeps; n++) {
        const double k1 = law_slope(h, sign);
        const double k2 = law_slope(h + (0.5 * move * k1), sign);
        const double k3 = law_slope(h + (0.5 * move * k2), sign);
        const double k4 = law_slope(h + (move * k3), sign);
        h += (move * (k1 + (2.0 * k2) + (2.0 * k3) + k4)) / 6.0;
    }
    memory->x[0] = x_um;
    memory->x[1] = h;
    return LAW_offset_um + (LAW_slope_um_per_V * x_um) - h;
}

static double law_begin(${name}_memory *memory, double x_um)
{
    memory->x[0] = x_um;
    memory->x[1] = 0.0;
    return law_step(memory, x_um);
}
