/* FMI 3.0 for model exchange and co-simulation. */

#include "fmi3Functions.h"

#include "gb_core.h"

#include <stdlib.h>
#include <string.h>

#define G ((gb_instance *)c)

static fmi3Status complain(fmi3Instance c, const char *text) {
    fmi3LogMessageCallback log;
    memcpy(&log, &G->log, sizeof log);
    if (log) log(G->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance c, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)c, (void)on, (void)n, (void)categories;
    return fmi3OK;
}

static fmi3Instance instantiate(fmi3String name, fmi3String token, fmi3InstanceEnvironment environment,
                                fmi3LogMessageCallback log) {
    gb_instance *g;
    if (!token || strcmp(token, GB_TOKEN)) {
        if (log) log(environment, fmi3Error, "logStatusError", "the instantiation token is not that of this unit");
        return NULL;
    }
    g = gb_new(name);
    if (!g) return NULL;
    memcpy(&g->log, &log, sizeof log);
    g->environment = environment;
    return g;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                          fmi3Boolean logging, fmi3InstanceEnvironment environment,
                                          fmi3LogMessageCallback log) {
    (void)resources, (void)visible, (void)logging;
    return instantiate(name, token, environment, log);
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference required[], size_t n_required,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback intermediate) {
    (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)required, (void)n_required, (void)intermediate;
    return instantiate(name, token, environment, log);
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String name, fmi3String token, fmi3String resources,
                                               fmi3Boolean visible, fmi3Boolean logging,
                                               fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                               fmi3ClockUpdateCallback clock, fmi3LockPreemptionCallback lock,
                                               fmi3UnlockPreemptionCallback unlock) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment;
    (void)log, (void)clock, (void)lock, (void)unlock;
    return NULL;
}

void fmi3FreeInstance(fmi3Instance c) { free(c); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean tolerance, fmi3Float64 value, fmi3Float64 start,
                                       fmi3Boolean ends, fmi3Float64 stop) {
    (void)tolerance, (void)value, (void)ends, (void)stop;
    gb_begin(G, start);
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
    gb_exit_initialization(G);
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance c) {
    gb_reset(G);
    return fmi3OK;
}

#define NOTHING_TO_DO(name) \
    fmi3Status name(fmi3Instance c) { \
        (void)c; \
        return fmi3OK; \
    }
NOTHING_TO_DO(fmi3EnterEventMode)
NOTHING_TO_DO(fmi3Terminate)
NOTHING_TO_DO(fmi3EnterConfigurationMode)
NOTHING_TO_DO(fmi3ExitConfigurationMode)
NOTHING_TO_DO(fmi3EvaluateDiscreteStates)
NOTHING_TO_DO(fmi3EnterContinuousTimeMode)
NOTHING_TO_DO(fmi3EnterStepMode)

/* ---------------------------------------------------------------- variables */

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 value[], size_t size) {
    size_t i;
    if (size != n) return complain(c, "every variable has one value");
    for (i = 0; i < n; i++)
        if (gb_get(G, vr[i], &value[i])) return complain(c, "there is no Float64 variable of this value reference");
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Float64 value[], size_t size) {
    size_t i;
    if (size != n) return complain(c, "every variable has one value");
    for (i = 0; i < n; i++)
        if (gb_set(G, vr[i], value[i])) return complain(c, "a variable of this value reference cannot be set");
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Boolean value[], size_t size) {
    size_t i;
    if (size != n) return complain(c, "every variable has one value");
    gb_evaluate(G);
    for (i = 0; i < n; i++) {
        if (vr[i] != VR_OUTSIDE) return complain(c, "there is no Boolean variable of this value reference");
        value[i] = G->outside ? fmi3True : fmi3False;
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Boolean value[], size_t size) {
    (void)vr, (void)value, (void)size;
    return n ? complain(c, "no Boolean variable can be set") : fmi3OK;
}

#define NO_VARIABLES(type) \
    fmi3Status fmi3Get##type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3##type value[], size_t size) { \
        (void)vr, (void)value, (void)size; \
        return n ? complain(c, "there are no variables of the type " #type) : fmi3OK; \
    } \
    fmi3Status fmi3Set##type(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3##type value[], \
                             size_t size) { \
        (void)vr, (void)value, (void)size; \
        return n ? complain(c, "there are no variables of the type " #type) : fmi3OK; \
    }
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

fmi3Status fmi3GetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, size_t sizes[], fmi3Binary value[],
                         size_t size) {
    (void)vr, (void)sizes, (void)value, (void)size;
    return n ? complain(c, "there are no variables of the type Binary") : fmi3OK;
}

fmi3Status fmi3SetBinary(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const size_t sizes[],
                         const fmi3Binary value[], size_t size) {
    (void)vr, (void)sizes, (void)value, (void)size;
    return n ? complain(c, "there are no variables of the type Binary") : fmi3OK;
}

fmi3Status fmi3GetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Clock value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "there are no clocks") : fmi3OK;
}

fmi3Status fmi3SetClock(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Clock value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "there are no clocks") : fmi3OK;
}

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t *n) {
    (void)vr, (void)n;
    return complain(c, "dependencies are in the model description");
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance c, fmi3ValueReference vr, size_t of[], fmi3ValueReference on[],
                                       size_t elements[], fmi3DependencyKind kinds[], size_t n) {
    (void)vr, (void)of, (void)on, (void)elements, (void)kinds, (void)n;
    return complain(c, "dependencies are in the model description");
}

/* ---------------------------------------------------------------- the state of the unit */

fmi3Status fmi3GetFMUState(fmi3Instance c, fmi3FMUState *state) {
    if (!*state) *state = malloc(sizeof(gb_memory));
    if (!*state) return complain(c, "there is not enough memory");
    memcpy(*state, &G->memory, sizeof(gb_memory));
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance c, fmi3FMUState state) {
    memcpy(&G->memory, state, sizeof(gb_memory));
    G->fresh = 0;
    G->trouble = NULL;
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance c, fmi3FMUState *state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance c, fmi3FMUState state, size_t *size) {
    (void)c, (void)state;
    *size = sizeof(gb_memory);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance c, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    if (size < sizeof(gb_memory)) return complain(c, "there is not enough room for the state");
    memcpy(bytes, state, sizeof(gb_memory));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance c, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    if (size != sizeof(gb_memory)) return complain(c, "this is not a state of this unit");
    if (!*state) *state = malloc(sizeof(gb_memory));
    if (!*state) return complain(c, "there is not enough memory");
    memcpy(*state, bytes, sizeof(gb_memory));
    return fmi3OK;
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                        const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                        size_t n_seed, fmi3Float64 found[], size_t n_found) {
    if (n_seed != n_knowns || n_found != n_unknowns) return complain(c, "every variable has one value");
    if (gb_along(G, unknowns, n_unknowns, knowns, n_knowns, seed, found))
        return complain(c, "there is no derivative of or by a variable of this value reference");
    return fmi3OK;
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance c, const fmi3ValueReference unknowns[], size_t n_unknowns,
                                    const fmi3ValueReference knowns[], size_t n_knowns, const fmi3Float64 seed[],
                                    size_t n_seed, fmi3Float64 found[], size_t n_found) {
    (void)unknowns, (void)n_unknowns, (void)knowns, (void)n_knowns, (void)seed, (void)n_seed, (void)found, (void)n_found;
    return complain(c, "adjoint derivatives are not supported by this unit");
}

/* ---------------------------------------------------------------- model exchange */

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance c, fmi3Boolean *again, fmi3Boolean *terminate, fmi3Boolean *nominals,
                                    fmi3Boolean *values, fmi3Boolean *defined, fmi3Float64 *time) {
    *again = *terminate = *nominals = fmi3False;
    *values = gb_update(G) ? fmi3True : fmi3False;
    if (G->trouble) return complain(c, G->trouble);
    *defined = gb_next_event(G, time) ? fmi3True : fmi3False;
    return fmi3OK;
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance c, fmi3Boolean final, fmi3Boolean *event, fmi3Boolean *terminate) {
    (void)final;
    *event = *terminate = fmi3False;
    return gb_completed(G) ? complain(c, G->trouble) : fmi3OK;
}

fmi3Status fmi3SetTime(fmi3Instance c, fmi3Float64 time) { return gb_set(G, VR_TIME, time) ? fmi3Error : fmi3OK; }

fmi3Status fmi3SetContinuousStates(fmi3Instance c, const fmi3Float64 x[], size_t n) {
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    memcpy(G->memory.x, x, n * sizeof(double));
    G->fresh = 0;
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance c, fmi3Float64 dx[], size_t n) {
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    gb_rates(G, dx);
    return fmi3OK;
}

fmi3Status fmi3GetEventIndicators(fmi3Instance c, fmi3Float64 z[], size_t n) {
    if (n != PREFIX_SWITCHES + GB_GUARDS) return complain(c, "this is not the number of event indicators");
    gb_indicators(G, z);
    return fmi3OK;
}

fmi3Status fmi3GetContinuousStates(fmi3Instance c, fmi3Float64 x[], size_t n) {
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    if (G->memory.mode != GB_RUNNING) gb_evaluate(G);
    memcpy(x, G->memory.x, n * sizeof(double));
    return fmi3OK;
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance c, fmi3Float64 nominal[], size_t n) {
    size_t i;
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    for (i = 0; i < n; i++) nominal[i] = gb_nominal((int)i);
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance c, size_t *n) {
    (void)c;
    *n = PREFIX_SWITCHES + GB_GUARDS;
    return fmi3OK;
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance c, size_t *n) {
    (void)c;
    *n = PREFIX_STATES;
    return fmi3OK;
}

/* ---------------------------------------------------------------- co-simulation */

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 time, fmi3Float64 step, fmi3Boolean final, fmi3Boolean *event,
                      fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    (void)final;
    *event = *terminate = *early = fmi3False;
    *last = time + step;
    return gb_advance(G, time, time + step) ? complain(c, G->trouble) : fmi3OK;
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance c, const fmi3ValueReference vr[], size_t n, const fmi3Int32 order[],
                                    fmi3Float64 value[], size_t size) {
    (void)vr, (void)n, (void)order, (void)value, (void)size;
    return complain(c, "derivatives of outputs are not supported by this unit");
}

fmi3Status fmi3ActivateModelPartition(fmi3Instance c, fmi3ValueReference clock, fmi3Float64 time) {
    (void)clock, (void)time;
    return complain(c, "there are no clocks");
}

#define NO_CLOCKS(name, ...) \
    fmi3Status name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, __VA_ARGS__) { \
        (void)vr, (void)n, (void)a; \
        return complain(c, "there are no clocks"); \
    }
#define NO_CLOCK_FRACTIONS(name, type) \
    fmi3Status name(fmi3Instance c, const fmi3ValueReference vr[], size_t n, type a[], type b[]) { \
        (void)vr, (void)n, (void)a, (void)b; \
        return complain(c, "there are no clocks"); \
    }
fmi3Status fmi3GetIntervalDecimal(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3Float64 a[],
                                  fmi3IntervalQualifier b[]) {
    (void)vr, (void)n, (void)a, (void)b;
    return complain(c, "there are no clocks");
}
fmi3Status fmi3GetIntervalFraction(fmi3Instance c, const fmi3ValueReference vr[], size_t n, fmi3UInt64 a[],
                                   fmi3UInt64 b[], fmi3IntervalQualifier q[]) {
    (void)vr, (void)n, (void)a, (void)b, (void)q;
    return complain(c, "there are no clocks");
}
NO_CLOCKS(fmi3GetShiftDecimal, fmi3Float64 a[])
NO_CLOCKS(fmi3SetShiftDecimal, const fmi3Float64 a[])
NO_CLOCKS(fmi3SetIntervalDecimal, const fmi3Float64 a[])
NO_CLOCK_FRACTIONS(fmi3GetShiftFraction, fmi3UInt64)
NO_CLOCK_FRACTIONS(fmi3SetShiftFraction, const fmi3UInt64)
NO_CLOCK_FRACTIONS(fmi3SetIntervalFraction, const fmi3UInt64)
