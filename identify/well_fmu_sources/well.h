/* The gas-lifted well behind both FMI interfaces: variables, integration and the built-in input sequence.
   The equations are in the generated model.h. */

#ifndef WELL_H
#define WELL_H

#include <stdbool.h>
#include <stddef.h>

#define STATE_COUNT 8
#define INPUT_COUNT 3
#define OUTPUT_COUNT 8

/* Value references; fmu_source.py writes the same numbers into modelDescription.xml. */
#define VR_TIME 0u
#define VR_INPUT 1u
#define VR_SEPTIC_CONTROL 10u
#define VR_OUTPUT 20u
#define VR_STATE 40u

/* All that a run changes, without pointers, so that it is copied and serialised in one go. */
typedef struct {
    double time;
    double x[STATE_COUNT];
    double u[INPUT_COUNT];
    bool septic_control;
    bool initialised;
} Well;

void well_reset(Well *well);
bool well_get(const Well *well, unsigned int reference, double *value);
bool well_set(Well *well, unsigned int reference, double value);
bool well_advance(Well *well, double start, double duration);

#endif
