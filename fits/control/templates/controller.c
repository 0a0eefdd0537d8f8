/*
 * Preisach hysteresis of a piezo actuator, and its exact inverse; see the header.
 *
 * ${provenance}
 *
 * The output starts a branch at every reversal and hangs from the extreme there until it passes the extreme before,
 * which closes a loop and wipes both out. The output rises with the voltage, so a displacement has the same extremes
 * as the voltage behind it, and either can say which are wiped out. Between two levels a branch is a cubic in the
 * voltage; the inverse is its one root between known ends.
 */
#include "${name}.h"

#define INTERVALS (${intervals})     /* between levels, all of one length */
#define WIDTH (INTERVALS + 2)        /* coefficients of a quadratic spline on them */
#define PER_V (${per_V})             /* intervals per V */
#define OFFSET_um (${lowest_um})     /* reading of the sensor at the lower end of the range */
#define ROUNDING_um (${rounding_um}) /* two units in the last place of the stroke */
#define NEWTON (32)                  /* steps after which only halving is left */
#define HALVINGS (96)                /* steps after which nothing is left to halve */
#define SWINGS (${swings})           /* of a demagnetised state */

/* Spline coefficients of the double integral of the density over both switching voltages. */
static const double WINDOW_um[WIDTH * WIDTH] = {
${window_um}
};

/* Cubics in one voltage, by powers of the fraction of an interval: of rising branches, then of falling ones. */
static const double BRANCH_um[2][INTERVALS][4] = {
    {
${rising_um}
    },
    {
${falling_um}
    },
};

/* A voltage as an interval between levels and a fraction of it. */
typedef struct {
    int interval;
    double fraction;
} place_t;

static place_t place(double voltage_V)
{
    const double x = (voltage_V - ${NAME}_LOWER_V) * PER_V;
    place_t p;

    p.interval = (int)x;
    if (p.interval < 0) {
        p.interval = 0;
    } else if (p.interval > (INTERVALS - 1)) {
        p.interval = INTERVALS - 1;
    }
    p.fraction = x - (double)p.interval;
    return p;
}

static double voltage(int interval, double fraction)
{
    return ${NAME}_LOWER_V + (((double)interval + fraction) / PER_V);
}

static double polynomial(const double c[4], double s)
{
    return c[0] + (s * (c[1] + (s * (c[2] + (s * c[3])))));
}

/* A branch: where it starts, and what all its points have in common. */
typedef struct {
    double start_um;
    double basis[3]; /* of the spline, at the start */
    int interval;    /* of the start */
    int rising;
} branch_t;

/* The branch that starts at an extreme, or at the last sample where it would be the next extreme. */
static branch_t branch_at(const ${name}_state *state, int start)
{
    const int turned = (start > state->top) ? 1 : 0;
    const place_t from = place((turned != 0) ? state->voltage_V : state->extreme_V[start]);
    const double s = from.fraction;
    /* A minimum was reached on a falling branch; the first one stands for a voltage that came from below. */
    const int before = (((start % 2) == 0) && (start > 0)) ? 0 : 1;
    branch_t b;

    b.rising = ((start % 2) == 0) ? 1 : 0;
    b.interval = from.interval;
    b.basis[0] = (1.0 - s) * (1.0 - s) * 0.5;
    b.basis[1] = 0.5 + (s * (1.0 - s));
    b.basis[2] = s * s * 0.5;
    b.start_um = (turned != 0) ? state->displacement_um : state->extreme_um[start];
    b.start_um -= polynomial(BRANCH_um[1 - before][from.interval], s);
    return b;
}

/* The branch in one interval, by powers of the fraction. */
static void cubic(const branch_t *b, int interval, double c[4])
{
    const double *own = BRANCH_um[1 - b->rising][interval];
    double g[3];
    int k;

    for (k = 0; k < 3; k++) {
        const double *w;
        if (b->rising != 0) {
            w = &WINDOW_um[((interval + k) * WIDTH) + b->interval];
            g[k] = -((b->basis[0] * w[0]) + (b->basis[1] * w[1]) + (b->basis[2] * w[2]));
        } else {
            w = &WINDOW_um[(b->interval * WIDTH) + interval + k];
            g[k] = (b->basis[0] * w[0]) + (b->basis[1] * w[WIDTH]) + (b->basis[2] * w[2 * WIDTH]);
        }
    }
    c[0] = b->start_um + own[0] + (0.5 * (g[0] + g[1]));
    c[1] = own[1] + (g[1] - g[0]);
    c[2] = own[2] + (0.5 * ((g[0] - g[1]) + (g[2] - g[1])));
    c[3] = own[3];
}

static double displacement_at(const branch_t *b, double voltage_V)
{
    const place_t p = place(voltage_V);
    double c[4];

    cubic(b, p.interval, c);
    return polynomial(c, p.fraction);
}

/*
 * Place of the extreme that the branch to x starts at; one beyond the top where the last sample is that extreme.
 * Extremes that x passes are wiped out, two at a time. They and x are voltages, or displacements.
 */
static int start_of(const ${name}_state *state, const double extreme[${NAME}_SIZE], int rising, double x)
{
    int start = state->top + ((state->rising != rising) ? 1 : 0);

    while ((start >= 2) && ((rising != 0) ? (extreme[start - 1] <= x) : (extreme[start - 1] >= x))) {
        start -= 2;
    }
    return start;
}

/* Go on along the branch that starts there. */
static void take(${name}_state *state, int start, int rising)
{
    state->rising = rising;
    if (start <= state->top) {
        state->top = start;
    } else if (start < ${NAME}_SIZE) {
        state->extreme_V[start] = state->voltage_V;
        state->extreme_um[start] = state->displacement_um;
        state->top = start;
    } else {
        /* Swings shrink inwards, so the last one is the smallest: it is taken back, as if it had not been. */
        state->top = start - 2;
        state->status |= ${NAME}_FORGOTTEN;
    }
}

/* Displacement if the voltage now went straight to another. */
static double displacement_if(const ${name}_state *state, double voltage_V)
{
    double displacement_um = state->displacement_um;

    if (voltage_V != state->voltage_V) {
        const int rising = (voltage_V > state->voltage_V) ? 1 : 0;
        const branch_t b = branch_at(state, start_of(state, state->extreme_V, rising, voltage_V));
        displacement_um = displacement_at(&b, voltage_V);
    }
    return displacement_um;
}

static void move_to(${name}_state *state, double voltage_V)
{
    if (voltage_V != state->voltage_V) {
        const int rising = (voltage_V > state->voltage_V) ? 1 : 0;
        branch_t b;

        take(state, start_of(state, state->extreme_V, rising, voltage_V), rising);
        b = branch_at(state, state->top);
        state->displacement_um = displacement_at(&b, voltage_V);
        state->voltage_V = voltage_V;
    }
}

/* The voltage between two others at which a branch has a displacement. */
static double solve(const branch_t *b, double low_V, double high_V, double wanted_um)
{
    const place_t from = place(low_V);
    const place_t to = place(high_V);
    int first = from.interval;
    int last = to.interval;
    int left = HALVINGS;
    double c[4];
    double low;
    double high;
    double s;

    /* The last interval that begins at or below it. */
    while (first < last) {
        const int middle = first + (((last - first) + 1) / 2);
        cubic(b, middle, c);
        if (c[0] <= wanted_um) {
            first = middle;
        } else {
            last = middle - 1;
        }
    }
    cubic(b, first, c);
    c[0] -= wanted_um;
    low = (first == from.interval) ? from.fraction : 0.0;
    high = (first == to.interval) ? to.fraction : 1.0;
    s = 0.5 * (low + high);
    while (left > 0) {
        const double off = polynomial(c, s);
        const double slope = c[1] + (s * ((2.0 * c[2]) + (s * 3.0 * c[3])));
        double next = s;

        if ((off > ROUNDING_um) || (off < -ROUNDING_um)) {
            if (off > 0.0) {
                high = s;
            } else {
                low = s;
            }
            /* Newton's step, unless it leaves the bracket or has had its chance. */
            next = 0.5 * (low + high);
            if ((slope > 0.0) && (left > (HALVINGS - NEWTON))) {
                const double newton = s - (off / slope);
                if ((newton >= low) && (newton <= high)) {
                    next = newton;
                }
            }
        }
        left = (next == s) ? 0 : (left - 1);
        s = next;
    }
    return voltage(first, s);
}

static double clipped(double x, double low, double high)
{
    return (x < low) ? low : ((x > high) ? high : x);
}

static int is_a_number(double x)
{
    return (x == x) ? 1 : 0;
}

void ${name}_init(${name}_state *state, ${name}_initial initial)
{
    const double middle_V = 0.5 * (${NAME}_LOWER_V + ${NAME}_UPPER_V);
    int k;

    for (k = 0; k < ${NAME}_SIZE; k++) {
        state->extreme_V[k] = ${NAME}_LOWER_V;
        state->extreme_um[k] = OFFSET_um;
    }
    state->voltage_V = ${NAME}_LOWER_V;
    state->displacement_um = OFFSET_um;
    state->status = 0U;
    state->top = 0;
    state->rising = 1;
    if (initial == ${NAME}_POSITIVE) {
        move_to(state, ${NAME}_UPPER_V);
    } else if (initial == ${NAME}_DEMAGNETISED) {
        for (k = 0; k < SWINGS; k++) {
            const double left = 1.0 - ((double)k / (double)SWINGS);
            move_to(state, middle_V + (left * (${NAME}_LOWER_V - middle_V)));
            move_to(state, middle_V + (left * (${NAME}_UPPER_V - middle_V)));
        }
        move_to(state, middle_V);
    } else {
        /* Negative saturation is where it stands. */
    }
}

double ${name}_forward(${name}_state *state, double voltage_V)
{
    state->status = 0U;
    if (is_a_number(voltage_V) == 0) {
        state->status = ${NAME}_NOT_A_NUMBER;
    } else {
        const double inside_V = clipped(voltage_V, ${NAME}_LOWER_V, ${NAME}_UPPER_V);
        if (inside_V != voltage_V) {
            state->status = ${NAME}_CLIPPED;
        }
        move_to(state, inside_V);
    }
    return state->displacement_um;
}

double ${name}_inverse(${name}_state *state, double reference_um)
{
    const double lowest_um = displacement_if(state, ${NAME}_LOWEST_V);
    const double highest_um = displacement_if(state, ${NAME}_HIGHEST_V);

    state->status = 0U;
    if (is_a_number(reference_um) == 0) {
        state->status = ${NAME}_NOT_A_NUMBER;
    } else if (reference_um >= highest_um) {
        if (reference_um > (highest_um + (4.0 * ROUNDING_um))) {
            state->status = ${NAME}_CLIPPED;
        }
        move_to(state, ${NAME}_HIGHEST_V);
    } else if (reference_um <= lowest_um) {
        if (reference_um < (lowest_um - (4.0 * ROUNDING_um))) {
            state->status = ${NAME}_CLIPPED;
        }
        move_to(state, ${NAME}_LOWEST_V);
    } else if (reference_um != state->displacement_um) {
        const int rising = (reference_um > state->displacement_um) ? 1 : 0;
        double from_V;
        double to_V;
        branch_t b;

        take(state, start_of(state, state->extreme_um, rising, reference_um), rising);
        /* The branch ends at the extreme before, where its loop closes. */
        from_V = state->extreme_V[state->top];
        to_V = (state->top > 0) ? state->extreme_V[state->top - 1] : ${NAME}_UPPER_V;
        b = branch_at(state, state->top);
        state->voltage_V = (rising != 0) ? solve(&b, from_V, to_V, reference_um) : solve(&b, to_V, from_V, reference_um);
        state->voltage_V = clipped(state->voltage_V, ${NAME}_LOWEST_V, ${NAME}_HIGHEST_V);
        state->displacement_um = reference_um;
    } else {
        /* A sample that does not move. */
    }
    return state->voltage_V;
}
