/* FMI 3.0 co-simulation interface of the well. Functions that the well does not need are exported as stubs,
   because importers look every one of them up. */

#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "token.h"
#include "well.h"

typedef struct {
    Well well;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log_message;
    bool logging;
} Instance;

static fmi3Status fail(fmi3Instance instance, const char *message)
{
    const Instance *self = instance;
    if (self->logging && self->log_message) {
        self->log_message(self->environment, fmi3Error, "logStatusError", message);
    }
    return fmi3Error;
}

/* Creation and destruction */

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources,
                                         fmi3Boolean visible, fmi3Boolean logging, fmi3Boolean event_mode,
                                         fmi3Boolean early_return, const fmi3ValueReference required[],
                                         size_t required_count, fmi3InstanceEnvironment environment,
                                         fmi3LogMessageCallback log_message,
                                         fmi3IntermediateUpdateCallback intermediate_update)
{
    (void)name;
    (void)resources;
    (void)visible;
    (void)event_mode;
    (void)early_return;
    (void)required;
    (void)required_count;
    (void)intermediate_update;
    if (!token || strcmp(token, TOKEN) != 0) {
        return NULL;
    }
    Instance *self = calloc(1, sizeof *self);
    if (!self) {
        return NULL;
    }
    self->environment = environment;
    self->log_message = log_message;
    self->logging = logging;
    well_reset(&self->well);
    return self;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources,
                                          fmi3Boolean visible, fmi3Boolean logging,
                                          fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log_message)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    (void)environment;
    (void)log_message;
    return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment,
                                               fmi3LogMessageCallback log_message,
                                               fmi3ClockUpdateCallback clock_update,
                                               fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock)
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    (void)environment;
    (void)log_message;
    (void)clock_update;
    (void)lock;
    (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean on, size_t count,
                               const fmi3String categories[])
{
    (void)count;
    (void)categories;
    ((Instance *)instance)->logging = on;
    return fmi3OK;
}

/* Phases */

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean tolerance_defined,
                                       fmi3Float64 tolerance, fmi3Float64 start_time,
                                       fmi3Boolean stop_time_defined, fmi3Float64 stop_time)
{
    (void)tolerance_defined;
    (void)tolerance;
    (void)stop_time_defined;
    (void)stop_time;
    ((Instance *)instance)->well.time = start_time;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    ((Instance *)instance)->well.initialised = true;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    (void)instance;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    well_reset(&((Instance *)instance)->well);
    return fmi3OK;
}

/* Variables */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          fmi3Float64 values[], size_t value_count)
{
    if (count != value_count) {
        return fail(instance, "fmi3GetFloat64: every variable is a scalar");
    }
    for (size_t i = 0; i < count; i++) {
        if (!well_get(&((Instance *)instance)->well, vr[i], &values[i])) {
            return fail(instance, "fmi3GetFloat64: unknown value reference");
        }
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          const fmi3Float64 values[], size_t value_count)
{
    if (count != value_count) {
        return fail(instance, "fmi3SetFloat64: every variable is a scalar");
    }
    for (size_t i = 0; i < count; i++) {
        if (!well_set(&((Instance *)instance)->well, vr[i], values[i])) {
            return fail(instance, "fmi3SetFloat64: not settable now, or not a finite number");
        }
    }
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          fmi3Boolean values[], size_t value_count)
{
    for (size_t i = 0; i < count; i++) {
        if (vr[i] != VR_SEPTIC_CONTROL || count != value_count) {
            return fail(instance, "fmi3GetBoolean: unknown value reference");
        }
        values[i] = ((Instance *)instance)->well.septic_control;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference vr[], size_t count,
                          const fmi3Boolean values[], size_t value_count)
{
    for (size_t i = 0; i < count; i++) {
        if (vr[i] != VR_SEPTIC_CONTROL || count != value_count) {
            return fail(instance, "fmi3SetBoolean: unknown value reference");
        }
        ((Instance *)instance)->well.septic_control = values[i];
    }
    return fmi3OK;
}

/* Simulation */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 time, fmi3Float64 duration, fmi3Boolean no_rollback,
                      fmi3Boolean *event_handling, fmi3Boolean *terminate, fmi3Boolean *early_return,
                      fmi3Float64 *last_time)
{
    Instance *self = instance;
    (void)no_rollback;
    *event_handling = false;
    *terminate = false;
    *early_return = false;
    bool good = well_advance(&self->well, time, duration);
    *last_time = self->well.time;
    return good ? fmi3OK : fail(instance, "fmi3DoStep: not initialised, or not a valid step");
}

/* Saved states */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    if (!*state) {
        *state = malloc(sizeof(Well));
    }
    if (!*state) {
        return fail(instance, "fmi3GetFMUState: out of memory");
    }
    memcpy(*state, &((Instance *)instance)->well, sizeof(Well));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState state)
{
    memcpy(&((Instance *)instance)->well, state, sizeof(Well));
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState state, size_t *size)
{
    (void)instance;
    (void)state;
    *size = sizeof(Well);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState state, fmi3Byte bytes[], size_t size)
{
    if (size < sizeof(Well)) {
        return fail(instance, "fmi3SerializeFMUState: the buffer is too small");
    }
    memcpy(bytes, state, sizeof(Well));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte bytes[], size_t size,
                                   fmi3FMUState *state)
{
    if (size != sizeof(Well)) {
        return fail(instance, "fmi3DeserializeFMUState: not a state of this well");
    }
    if (!*state) {
        *state = malloc(sizeof(Well));
    }
    if (!*state) {
        return fail(instance, "fmi3DeserializeFMUState: out of memory");
    }
    memcpy(*state, bytes, sizeof(Well));
    return fmi3OK;
}

/* Stubs */

#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

#define STUB(name, parameters) \
    fmi3Status name parameters { return fail(instance, #name ": the well does not offer this"); }
#define NO_VARIABLES(type)                                                                          \
    STUB(fmi3Get##type, (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,        \
                         fmi3##type values[], size_t value_count))                                  \
    STUB(fmi3Set##type, (fmi3Instance instance, const fmi3ValueReference vr[], size_t count,        \
                         const fmi3##type values[], size_t value_count))
#define REFERENCES fmi3Instance instance, const fmi3ValueReference vr[], size_t count

NO_VARIABLES(Float32)
NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(Int64)
NO_VARIABLES(UInt64)
NO_VARIABLES(String)
STUB(fmi3GetBinary, (REFERENCES, size_t sizes[], fmi3Binary values[], size_t value_count))
STUB(fmi3SetBinary, (REFERENCES, const size_t sizes[], const fmi3Binary values[], size_t value_count))
STUB(fmi3GetClock, (REFERENCES, fmi3Clock values[]))
STUB(fmi3SetClock, (REFERENCES, const fmi3Clock values[]))
STUB(fmi3GetNumberOfVariableDependencies,
     (fmi3Instance instance, fmi3ValueReference vr, size_t *dependency_count))
STUB(fmi3GetVariableDependencies,
     (fmi3Instance instance, fmi3ValueReference dependent, size_t elements[], fmi3ValueReference independents[],
      size_t independent_elements[], fmi3DependencyKind kinds[], size_t dependency_count))
STUB(fmi3GetDirectionalDerivative,
     (fmi3Instance instance, const fmi3ValueReference unknowns[], size_t unknown_count,
      const fmi3ValueReference knowns[], size_t known_count, const fmi3Float64 seed[], size_t seed_count,
      fmi3Float64 sensitivity[], size_t sensitivity_count))
STUB(fmi3GetAdjointDerivative,
     (fmi3Instance instance, const fmi3ValueReference unknowns[], size_t unknown_count,
      const fmi3ValueReference knowns[], size_t known_count, const fmi3Float64 seed[], size_t seed_count,
      fmi3Float64 sensitivity[], size_t sensitivity_count))
STUB(fmi3EnterConfigurationMode, (fmi3Instance instance))
STUB(fmi3ExitConfigurationMode, (fmi3Instance instance))
STUB(fmi3EnterEventMode, (fmi3Instance instance))
STUB(fmi3EnterStepMode, (fmi3Instance instance))
STUB(fmi3GetIntervalDecimal, (REFERENCES, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]))
STUB(fmi3GetIntervalFraction,
     (REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]))
STUB(fmi3GetShiftDecimal, (REFERENCES, fmi3Float64 shifts[]))
STUB(fmi3GetShiftFraction, (REFERENCES, fmi3UInt64 counters[], fmi3UInt64 resolutions[]))
STUB(fmi3SetIntervalDecimal, (REFERENCES, const fmi3Float64 intervals[]))
STUB(fmi3SetIntervalFraction, (REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
STUB(fmi3SetShiftDecimal, (REFERENCES, const fmi3Float64 shifts[]))
STUB(fmi3SetShiftFraction, (REFERENCES, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
STUB(fmi3EvaluateDiscreteStates, (fmi3Instance instance))
STUB(fmi3UpdateDiscreteStates,
     (fmi3Instance instance, fmi3Boolean *needs_update, fmi3Boolean *terminate, fmi3Boolean *nominals_changed,
      fmi3Boolean *values_changed, fmi3Boolean *next_event_defined, fmi3Float64 *next_event))
STUB(fmi3EnterContinuousTimeMode, (fmi3Instance instance))
STUB(fmi3CompletedIntegratorStep,
     (fmi3Instance instance, fmi3Boolean no_rollback, fmi3Boolean *enter_event_mode, fmi3Boolean *terminate))
STUB(fmi3SetTime, (fmi3Instance instance, fmi3Float64 time))
STUB(fmi3SetContinuousStates, (fmi3Instance instance, const fmi3Float64 states[], size_t count))
STUB(fmi3GetContinuousStateDerivatives, (fmi3Instance instance, fmi3Float64 derivatives[], size_t count))
STUB(fmi3GetEventIndicators, (fmi3Instance instance, fmi3Float64 indicators[], size_t count))
STUB(fmi3GetContinuousStates, (fmi3Instance instance, fmi3Float64 states[], size_t count))
STUB(fmi3GetNominalsOfContinuousStates, (fmi3Instance instance, fmi3Float64 nominals[], size_t count))
STUB(fmi3GetNumberOfEventIndicators, (fmi3Instance instance, size_t *count))
STUB(fmi3GetNumberOfContinuousStates, (fmi3Instance instance, size_t *count))
STUB(fmi3GetOutputDerivatives, (REFERENCES, const fmi3Int32 orders[], fmi3Float64 values[], size_t value_count))
STUB(fmi3ActivateModelPartition,
     (fmi3Instance instance, fmi3ValueReference clock, fmi3Float64 activation_time))
