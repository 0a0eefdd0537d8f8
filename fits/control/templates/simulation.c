/*
 * Simulation of a stage with hysteresis inside its mechanics; see the header.
 *
 * ${provenance}
 *
 * The linear parts are exact from step to step. The force of the hysteresis runs in a line over each step, and its end
 * is found along secants: an error of second order in the step.
 */
#include "${name}.h"

#include <math.h>

#define ORDER (${order})       /* states of the linear parts */
#define STEPS ${NAME}_STEPS
#define CORRECTIONS (4)        /* of the force at the end of a step */
#define HALVINGS (128)         /* of the bracket around the displacement at rest */
#define MASS_GAIN (${mass_gain})       /* um of the mass per um of force */
#define AT_REST_um (${mass_offset_um}) /* displacement of the mass under no command and force */
#define PER_V (${mass_per_V})          /* its change per V at rest */

/* Over one step: the states, and what a command and a force that rise by one add to them. */
static const double KEEP[ORDER][ORDER] = {
${keep}
};
static const double COMMAND[ORDER] = {
${command}
};
static const double FORCE[ORDER] = {
${force}
};
/* What the states add to the displacement of the mass, and to the reading. */
static const double MASS[ORDER] = {
${mass}
};
static const double READING[ORDER] = {
${reading}
};
/* States at rest under a command of one. */
static const double REST[ORDER] = {
${rest}
};

${law}
static double along(const double row[ORDER], const double z[ORDER])
{
    double sum = 0.0;
    int k;

    for (k = 0; k < ORDER; k++) {
        sum += row[k] * z[k];
    }
    return sum;
}

static double excess_um(double rest_um, double wanted_um)
{
    ${name}_memory memory;

    return (rest_um - law_begin(&memory, rest_um)) - wanted_um;
}

/* Where spring and force are in balance: the excess rises with the displacement. */
static double rest_at(double wanted_um)
{
    double reach = 1.0 + fabs(wanted_um);
    double low = wanted_um - reach;
    double high = wanted_um + reach;
    int k;

    for (k = 0; (k < HALVINGS) && (excess_um(low, wanted_um) > 0.0); k++) {
        reach *= 2.0;
        low -= reach;
    }
    for (k = 0; (k < HALVINGS) && (excess_um(high, wanted_um) < 0.0); k++) {
        reach *= 2.0;
        high += reach;
    }
    for (k = 0; k < HALVINGS; k++) {
        const double middle = low + (0.5 * (high - low));
        if (excess_um(middle, wanted_um) > 0.0) {
            high = middle;
        } else {
            low = middle;
        }
    }
    return low + (0.5 * (high - low));
}

static double read_at(${name}_state *state)
{
    const double level = AT_REST_um + (PER_V * state->command_V);

    state->displacement_um = (level - (MASS_GAIN * state->force_um)) + along(MASS, state->z);
    state->reading_um = ${offset_um} + (${per_V} * state->command_V);
    state->reading_um += along(READING, state->z) - (${force_gain} * state->force_um);
    return state->reading_um;
}

double ${name}_init(${name}_state *state, double rest_V, double command_V)
{
    const double wanted_um = AT_REST_um + (PER_V * rest_V);
    const double rest_um = rest_at(wanted_um);
    int k;

    state->force_um = -law_begin(&state->memory, rest_um) / MASS_GAIN;
    state->command_V = command_V;
    state->status = 0U;
    for (k = 0; k < ORDER; k++) {
        state->z[k] = REST[k] * (rest_V - command_V);
    }
    return read_at(state);
}

double ${name}_step(${name}_state *state, double command_V)
{
    const double from_V = state->command_V;
    double rise_V = command_V - from_V;
    int n;

    state->status = 0U;
    if (command_V != command_V) {
        state->status = ${NAME}_NOT_A_NUMBER;
        rise_V = 0.0;
    }
    for (n = 1; n <= STEPS; n++) {
        const double to_V = from_V + (rise_V * ${share});
        const double rise = to_V - state->command_V;
        const double level = AT_REST_um + (PER_V * to_V);
        double late = state->force_um;
        ${name}_memory memory;
        double z[ORDER];
        double free_um;
        double off = 0.0;
        double ahead = 0.0;
        int k;

        for (k = 0; k < ORDER; k++) {
            z[k] = along(KEEP[k], state->z) + (COMMAND[k] * rise);
        }
        free_um = level + along(MASS, z);
        for (k = 0; k <= CORRECTIONS; k++) {
            const double there_um = (free_um + (along(MASS, FORCE) * (late - state->force_um))) - (MASS_GAIN * late);
            memory = state->memory;
            {
                const double more = (-law_step(&memory, there_um) / MASS_GAIN) - late;
                /* Along the secant of the last two guesses. */
                ahead = ((k > 0) && (more != off)) ? ((ahead * more) / (off - more)) : more;
                off = more;
            }
            if (k < CORRECTIONS) {
                late += ahead;
            }
        }
        for (k = 0; k < ORDER; k++) {
            state->z[k] = z[k] + (FORCE[k] * (late - state->force_um));
        }
        state->memory = memory;
        state->force_um = late;
        state->command_V = to_V;
    }
    return read_at(state);
}
