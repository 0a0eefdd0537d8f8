/* The Preisach operator of the other pair of files. */
static double law_step(${name}_memory *memory, double x_um)
{
    return ${name}_law_forward(memory, x_um);
}

static double law_begin(${name}_memory *memory, double x_um)
{
    ${name}_law_init(memory, ${NAME}_LAW_NEGATIVE);
    return law_step(memory, x_um);
}
