/*
 * Preisach hysteresis of a piezo actuator, and its exact inverse, one sample at a time.
 *
 * ${provenance}
 *
 * Displacements are in um and include the sensor offset: what the sensor reads. Voltages are in V.
 * C99 in double precision; no allocation, no library, no globals that change. One state per axis; functions on
 * different states may run at the same time. Compile without -ffast-math, which removes the check for NaN.
 *
 *     static ${name}_state axis;
 *     ${name}_init(&axis, ${NAME}_NEGATIVE);
 *     for each sample:
 *         voltage_V = ${name}_inverse(&axis, reference_um);
 *         if (axis.status & ${NAME}_CLIPPED) then axis.displacement_um is what can be reached instead
 */
#ifndef ${NAME}_H
#define ${NAME}_H

#ifdef __cplusplus
extern "C" {
#endif

/* Range of the model. Beyond it the model knows nothing: voltages are clipped to it. */
#define ${NAME}_LOWER_V (${lower_V})
#define ${NAME}_UPPER_V (${upper_V})

/* Voltages that ${name}_inverse may give. */
#define ${NAME}_LOWEST_V (${lowest_V})
#define ${NAME}_HIGHEST_V (${highest_V})

/* Displacements at the ends of the model's range. */
#define ${NAME}_LOWEST_um (${lowest_um})
#define ${NAME}_HIGHEST_um (${highest_um})

/* Extremes that are remembered: half as many nested loops. */
#define ${NAME}_SIZE (${size})

/* What happened to a sample; bits of the status. */
#define ${NAME}_CLIPPED (1U)      /* out of reach: the nearest that can be reached was taken */
#define ${NAME}_FORGOTTEN (2U)    /* the memory was full: the smallest remembered swing was dropped */
#define ${NAME}_NOT_A_NUMBER (4U) /* the sample was left out: nothing moved */

/* Memory before the first sample. */
typedef enum {
    ${NAME}_NEGATIVE = 0,    /* came up from the lower end of the range */
    ${NAME}_POSITIVE = 1,    /* came down from the upper end of the range */
    ${NAME}_DEMAGNETISED = 2 /* came to rest in the middle after swings that decay */
} ${name}_initial;

/*
 * Memory. Minima stand at even places and maxima at odd ones, oldest first, each with the displacement there; the
 * first is the lower end of the range. Read voltage_V, displacement_um and status; leave the rest alone.
 */
typedef struct {
    double voltage_V;       /* at the last sample */
    double displacement_um; /* at the last sample, by the model */
    unsigned int status;    /* of the last sample; 0: all is well */
    int top;                /* place of the extreme that the present branch starts at */
    int rising;             /* whether the present branch rises */
    double extreme_V[${NAME}_SIZE];
    double extreme_um[${NAME}_SIZE];
} ${name}_state;

/* Begin. For another history, begin with a saturation and play the history with ${name}_forward. */
void ${name}_init(${name}_state *state, ${name}_initial initial);

/* Displacement in um after a voltage in V. */
double ${name}_forward(${name}_state *state, double voltage_V);

/*
 * Voltage in V after which the displacement is reference_um. A reference out of reach is clipped; if the voltages
 * are limited, what can be reached depends on the past. The two functions share the state and may be mixed.
 */
double ${name}_inverse(${name}_state *state, double reference_um);

#ifdef __cplusplus
}
#endif

#endif
