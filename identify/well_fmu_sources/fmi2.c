/* FMI 2.0 co-simulation interface of the well. Functions that the well does not need are exported as stubs,
   because importers look every one of them up. */

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "token.h"
#include "well.h"

typedef struct {
    Well well;
    fmi2CallbackFunctions callbacks;
    bool logging;
    char name[64];
} Instance;

static fmi2Status fail(fmi2Component c, const char *message)
{
    const Instance *instance = c;
    if (instance->logging && instance->callbacks.logger) {
        instance->callbacks.logger(instance->callbacks.componentEnvironment, instance->name, fmi2Error,
                                   "logStatusError", "%s", message);
    }
    return fmi2Error;
}

static fmi2Status only_none(fmi2Component c, size_t count)
{
    return count == 0 ? fmi2OK : fail(c, "the well has no variables of this type");
}

/* Creation and destruction */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging)
{
    (void)resources;
    (void)visible;
    if (type != fmi2CoSimulation || !guid || strcmp(guid, TOKEN) != 0) {
        return NULL;
    }
    Instance *instance = calloc(1, sizeof *instance);
    if (!instance) {
        return NULL;
    }
    if (functions) {
        instance->callbacks = *functions;
    }
    instance->logging = logging;
    snprintf(instance->name, sizeof instance->name, "%s", name ? name : "");
    well_reset(&instance->well);
    return instance;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t count, const fmi2String categories[])
{
    (void)count;
    (void)categories;
    ((Instance *)c)->logging = on;
    return fmi2OK;
}

/* Phases */

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance_defined, fmi2Real tolerance,
                               fmi2Real start_time, fmi2Boolean stop_time_defined, fmi2Real stop_time)
{
    (void)tolerance_defined;
    (void)tolerance;
    (void)stop_time_defined;
    (void)stop_time;
    ((Instance *)c)->well.time = start_time;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    ((Instance *)c)->well.initialised = true;
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    well_reset(&((Instance *)c)->well);
    return fmi2OK;
}

/* Variables */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Real value[])
{
    for (size_t i = 0; i < count; i++) {
        if (!well_get(&((Instance *)c)->well, vr[i], &value[i])) {
            return fail(c, "fmi2GetReal: unknown value reference");
        }
    }
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t count, const fmi2Real value[])
{
    for (size_t i = 0; i < count; i++) {
        if (!well_set(&((Instance *)c)->well, vr[i], value[i])) {
            return fail(c, "fmi2SetReal: not settable now, or not a finite number");
        }
    }
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Boolean value[])
{
    for (size_t i = 0; i < count; i++) {
        if (vr[i] != VR_SEPTIC_CONTROL) {
            return fail(c, "fmi2GetBoolean: unknown value reference");
        }
        value[i] = ((Instance *)c)->well.septic_control;
    }
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t count,
                          const fmi2Boolean value[])
{
    for (size_t i = 0; i < count; i++) {
        if (vr[i] != VR_SEPTIC_CONTROL) {
            return fail(c, "fmi2SetBoolean: unknown value reference");
        }
        ((Instance *)c)->well.septic_control = value[i] != fmi2False;
    }
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2Integer value[])
{
    (void)vr;
    (void)value;
    return only_none(c, count);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t count,
                          const fmi2Integer value[])
{
    (void)vr;
    (void)value;
    return only_none(c, count);
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t count, fmi2String value[])
{
    (void)vr;
    (void)value;
    return only_none(c, count);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t count,
                         const fmi2String value[])
{
    (void)vr;
    (void)value;
    return only_none(c, count);
}

/* Simulation */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real duration, fmi2Boolean no_rollback)
{
    (void)no_rollback;
    return well_advance(&((Instance *)c)->well, time, duration)
               ? fmi2OK
               : fail(c, "fmi2DoStep: not initialised, or not a valid step");
}

/* Saved states */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    if (!*state) {
        *state = malloc(sizeof(Well));
    }
    if (!*state) {
        return fail(c, "fmi2GetFMUstate: out of memory");
    }
    memcpy(*state, &((Instance *)c)->well, sizeof(Well));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    memcpy(&((Instance *)c)->well, state, sizeof(Well));
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c;
    (void)state;
    *size = sizeof(Well);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
{
    if (size < sizeof(Well)) {
        return fail(c, "fmi2SerializeFMUstate: the buffer is too small");
    }
    memcpy(bytes, state, sizeof(Well));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)
{
    if (size != sizeof(Well)) {
        return fail(c, "fmi2DeSerializeFMUstate: not a state of this well");
    }
    if (!*state) {
        *state = malloc(sizeof(Well));
    }
    if (!*state) {
        return fail(c, "fmi2DeSerializeFMUstate: out of memory");
    }
    memcpy(*state, bytes, sizeof(Well));
    return fmi2OK;
}

/* Stubs */

#define STUB(name, parameters) \
    fmi2Status name parameters { return fail(c, #name ": the well does not offer this"); }

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

STUB(fmi2GetDirectionalDerivative,
     (fmi2Component c, const fmi2ValueReference unknowns[], size_t unknown_count,
      const fmi2ValueReference knowns[], size_t known_count, const fmi2Real seed[], fmi2Real sensitivity[]))
STUB(fmi2SetRealInputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t count,
                                   const fmi2Integer order[], const fmi2Real value[]))
STUB(fmi2GetRealOutputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t count,
                                    const fmi2Integer order[], fmi2Real value[]))
STUB(fmi2CancelStep, (fmi2Component c))
STUB(fmi2GetStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Status *value))
STUB(fmi2GetRealStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Real *value))
STUB(fmi2GetIntegerStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value))
STUB(fmi2GetBooleanStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value))
STUB(fmi2GetStringStatus, (fmi2Component c, const fmi2StatusKind kind, fmi2String *value))
STUB(fmi2EnterEventMode, (fmi2Component c))
STUB(fmi2NewDiscreteStates, (fmi2Component c, fmi2EventInfo *info))
STUB(fmi2EnterContinuousTimeMode, (fmi2Component c))
STUB(fmi2CompletedIntegratorStep,
     (fmi2Component c, fmi2Boolean no_rollback, fmi2Boolean *enter_event_mode, fmi2Boolean *terminate))
STUB(fmi2SetTime, (fmi2Component c, fmi2Real time))
STUB(fmi2SetContinuousStates, (fmi2Component c, const fmi2Real x[], size_t count))
STUB(fmi2GetDerivatives, (fmi2Component c, fmi2Real derivatives[], size_t count))
STUB(fmi2GetEventIndicators, (fmi2Component c, fmi2Real indicators[], size_t count))
STUB(fmi2GetContinuousStates, (fmi2Component c, fmi2Real x[], size_t count))
STUB(fmi2GetNominalsOfContinuousStates, (fmi2Component c, fmi2Real nominals[], size_t count))
