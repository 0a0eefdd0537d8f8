/*
 * Simulation of a stage with hysteresis inside its mechanics, one sample at a time.
 *
 * ${provenance}
 *
 * Commands are in the unit that the model was fitted in, V unless a force stood in the voltage's place; displacements
 * are in um, and the reading includes the sensor's offset. Samples are ${interval_s} s apart, and the command runs in
 * ${runs} between them. C99 in double precision with <math.h>; no allocation, no globals that change, loops of bounded
 * length. One state per axis; functions on different states may run at the same time. Compile without -ffast-math,
 * which removes the check for NaN.
 *
 *     static ${name}_state axis;
 *     ${name}_init(&axis, rest_V, command_V);    at the first sample
 *     for each further sample:
 *         reading_um = ${name}_step(&axis, command_V);
 */
#ifndef ${NAME}_H
#define ${NAME}_H
${include}
#ifdef __cplusplus
extern "C" {
#endif

/* Time between two samples, in s, and into how many steps it is divided. */
#define ${NAME}_INTERVAL_s (${interval_s})
#define ${NAME}_STEPS (${steps})

/* What happened to a sample; a bit of the status. */
#define ${NAME}_NOT_A_NUMBER (4U) /* the command was that of the sample before instead */

/* What the hysteresis remembers. */
${memory}

/* Read reading_um, displacement_um and status; leave the rest alone. */
typedef struct {
    double reading_um;      /* of the sensor, at the last sample */
    double displacement_um; /* of the mass, at the last sample */
    double command_V;       /* at the last sample */
    unsigned int status;    /* of the last sample; 0: all is well */
    double force_um;        /* of the hysteresis on the mass, as the piezo's displacement that balances it */
    double z[${order}];     /* states of the linear parts, less those at rest under the command */
    ${name}_memory memory;
} ${name}_state;

/* Begin: at rest under one command for long, and then at the first sample's, from which the reading comes back. */
double ${name}_init(${name}_state *state, double rest_V, double command_V);

/* Go on to the next sample's command; the sensor's reading there comes back. */
double ${name}_step(${name}_state *state, double command_V);

#ifdef __cplusplus
}
#endif

#endif
