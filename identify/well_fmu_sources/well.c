/* Integration of the well with the fixed Runge-Kutta steps of the JAX plant, and access to its variables. */

#include "well.h"

#include <math.h>
#include <string.h>

#include "model.h" /* rates, outputs, START_STATE, START_INPUT, SUBSTEP, and the input sequence */

void well_reset(Well *well)
{
    memset(well, 0, sizeof *well); /* padding too: serialised states of equal runs are equal */
    memcpy(well->x, START_STATE, sizeof well->x);
    memcpy(well->u, START_INPUT, sizeof well->u);
}

bool well_get(const Well *well, unsigned int reference, double *value)
{
    if (reference == VR_TIME) {
        *value = well->time;
    } else if (reference >= VR_INPUT && reference < VR_INPUT + INPUT_COUNT) {
        *value = well->u[reference - VR_INPUT];
    } else if (reference >= VR_STATE && reference < VR_STATE + STATE_COUNT) {
        *value = well->x[reference - VR_STATE];
    } else if (reference >= VR_OUTPUT && reference < VR_OUTPUT + OUTPUT_COUNT) {
        double y[OUTPUT_COUNT];
        outputs(well->x, well->u, y);
        *value = y[reference - VR_OUTPUT];
    } else {
        return false;
    }
    return true;
}

bool well_set(Well *well, unsigned int reference, double value)
{
    if (!isfinite(value)) {
        return false;
    }
    if (reference >= VR_INPUT && reference < VR_INPUT + INPUT_COUNT) {
        well->u[reference - VR_INPUT] = value;
    } else if (!well->initialised && reference >= VR_STATE && reference < VR_STATE + STATE_COUNT) {
        well->x[reference - VR_STATE] = value;
    } else {
        return false;
    }
    return true;
}

/* What the valves make of the inputs: the choke ends at 0 and 100 %, the lift at 0. */
static void held_inputs(const Well *well, double u[INPUT_COUNT])
{
    memcpy(u, well->u, sizeof well->u);
    if (!well->septic_control) {
        size_t row = 0;
        while (row + 1 < SEQUENCE_ROWS && SEQUENCE[row + 1][0] <= well->time + 1e-6) {
            row++;
        }
        u[0] = SEQUENCE[row][1];
        u[1] = SEQUENCE[row][2];
    }
    u[0] = u[0] < 0.0 ? 0.0 : u[0] > 100.0 ? 100.0 : u[0];
    u[1] = u[1] < 0.0 ? 0.0 : u[1];
}

static void runge_kutta(double x[STATE_COUNT], const double u[INPUT_COUNT], double step)
{
    double k1[STATE_COUNT], k2[STATE_COUNT], k3[STATE_COUNT], k4[STATE_COUNT], ahead[STATE_COUNT];
    int i;
    rates(x, u, k1);
    for (i = 0; i < STATE_COUNT; i++) ahead[i] = x[i] + 0.5 * step * k1[i];
    rates(ahead, u, k2);
    for (i = 0; i < STATE_COUNT; i++) ahead[i] = x[i] + 0.5 * step * k2[i];
    rates(ahead, u, k3);
    for (i = 0; i < STATE_COUNT; i++) ahead[i] = x[i] + step * k3[i];
    rates(ahead, u, k4);
    for (i = 0; i < STATE_COUNT; i++) {
        x[i] = x[i] + step / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);
    }
}

/* Advance from `start` by a duration, in equal steps of at most SUBSTEP seconds; a failure changes nothing. */
bool well_advance(Well *well, double start, double duration)
{
    Well ahead = *well;
    double u[INPUT_COUNT];
    if (!well->initialised || !isfinite(start) || !(duration >= 0.0) || duration > 1e9) {
        return false;
    }
    ahead.time = start;
    long count = (long)ceil(duration / SUBSTEP - 1e-9);
    for (long step = 0; step < count; step++) {
        held_inputs(&ahead, u);
        runge_kutta(ahead.x, u, duration / (double)count);
        ahead.time = start + duration * (double)(step + 1) / (double)count;
    }
    for (int i = 0; i < STATE_COUNT; i++) {
        if (!isfinite(ahead.x[i])) {
            return false;
        }
    }
    *well = ahead;
    return true;
}
