/* FMI 2.0 for model exchange and co-simulation. */

#include "fmi2Functions.h"

#include "gb_core.h"

#include <stdlib.h>
#include <string.h>

#define G ((gb_instance *)c)
#define NOT_THERE(name) return complain(c, name " is not supported by this unit")

static fmi2Status complain(fmi2Component c, const char *text) {
    const fmi2CallbackFunctions *functions = (const fmi2CallbackFunctions *)G->log;
    if (functions && functions->logger)
        functions->logger(functions->componentEnvironment, G->name, fmi2Error, "logStatusError", "%s", text);
    return fmi2Error;
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    (void)c, (void)on, (void)n, (void)categories;
    return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    gb_instance *g;
    (void)type, (void)resources, (void)visible, (void)logging;
    if (!guid || strcmp(guid, GB_TOKEN)) {
        if (functions && functions->logger)
            functions->logger(functions->componentEnvironment, name, fmi2Error, "logStatusError", "%s",
                              "the GUID is not that of this unit");
        return NULL;
    }
    g = gb_new(name);
    if (g) g->log = (void *)functions;
    return g;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean tolerance, fmi2Real value, fmi2Real start,
                               fmi2Boolean ends, fmi2Real stop) {
    (void)tolerance, (void)value, (void)ends, (void)stop;
    G->memory.time = start;
    G->fresh = 0;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    gb_begin(G, G->memory.time);
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    gb_exit_initialization(G);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c) {
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c) {
    gb_reset(G);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    size_t i;
    for (i = 0; i < n; i++)
        if (gb_get(G, vr[i], &value[i])) return complain(c, "there is no real variable of this value reference");
    return fmi2OK;
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    size_t i;
    for (i = 0; i < n; i++)
        if (gb_set(G, vr[i], value[i])) return complain(c, "a variable of this value reference cannot be set");
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Boolean value[]) {
    size_t i;
    gb_evaluate(G);
    for (i = 0; i < n; i++) {
        if (vr[i] != VR_OUTSIDE) return complain(c, "there is no boolean variable of this value reference");
        value[i] = G->outside ? fmi2True : fmi2False;
    }
    return fmi2OK;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "no boolean variable can be set") : fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Integer value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "there are no integer variables") : fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "there are no integer variables") : fmi2OK;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2String value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "there are no string variables") : fmi2OK;
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2String value[]) {
    (void)vr, (void)value;
    return n ? complain(c, "there are no string variables") : fmi2OK;
}

/* ---------------------------------------------------------------- the state of the unit */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    if (!*state) *state = malloc(sizeof(gb_memory));
    if (!*state) return complain(c, "there is not enough memory");
    memcpy(*state, &G->memory, sizeof(gb_memory));
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    memcpy(&G->memory, state, sizeof(gb_memory));
    G->fresh = 0;
    G->trouble = NULL;
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    (void)c, (void)state;
    *size = sizeof(gb_memory);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    if (size < sizeof(gb_memory)) return complain(c, "there is not enough room for the state");
    memcpy(bytes, state, sizeof(gb_memory));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    if (size != sizeof(gb_memory)) return complain(c, "this is not a state of this unit");
    if (!*state) *state = malloc(sizeof(gb_memory));
    if (!*state) return complain(c, "there is not enough memory");
    memcpy(*state, bytes, sizeof(gb_memory));
    return fmi2OK;
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknowns[], size_t n_unknowns,
                                        const fmi2ValueReference knowns[], size_t n_knowns, const fmi2Real seed[],
                                        fmi2Real found[]) {
    if (gb_along(G, unknowns, n_unknowns, knowns, n_knowns, seed, found))
        return complain(c, "there is no derivative of or by a variable of this value reference");
    return fmi2OK;
}

/* ---------------------------------------------------------------- model exchange */

fmi2Status fmi2EnterEventMode(fmi2Component c) {
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *info) {
    double next;
    info->newDiscreteStatesNeeded = fmi2False;
    info->terminateSimulation = fmi2False;
    info->nominalsOfContinuousStatesChanged = fmi2False;
    info->valuesOfContinuousStatesChanged = gb_update(G) ? fmi2True : fmi2False;
    if (G->trouble) return complain(c, G->trouble);
    info->nextEventTimeDefined = gb_next_event(G, &next) ? fmi2True : fmi2False;
    info->nextEventTime = next;
    return fmi2OK;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) {
    (void)c;
    return fmi2OK;
}

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean final, fmi2Boolean *event, fmi2Boolean *terminate) {
    (void)final;
    *event = *terminate = fmi2False;
    return gb_completed(G) ? complain(c, G->trouble) : fmi2OK;
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { return gb_set(G, VR_TIME, time) ? fmi2Error : fmi2OK; }

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t n) {
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    memcpy(G->memory.x, x, n * sizeof(double));
    G->fresh = 0;
    return fmi2OK;
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real dx[], size_t n) {
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    gb_rates(G, dx);
    return fmi2OK;
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real z[], size_t n) {
    if (n != PREFIX_SWITCHES + GB_GUARDS) return complain(c, "this is not the number of event indicators");
    gb_indicators(G, z);
    return fmi2OK;
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t n) {
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    if (G->memory.mode != GB_RUNNING) gb_evaluate(G);
    memcpy(x, G->memory.x, n * sizeof(double));
    return fmi2OK;
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real nominal[], size_t n) {
    size_t i;
    if (n != PREFIX_STATES) return complain(c, "this is not the number of states");
    for (i = 0; i < n; i++) nominal[i] = gb_nominal((int)i);
    return fmi2OK;
}

/* ---------------------------------------------------------------- co-simulation */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    size_t i;
    for (i = 0; i < n; i++) {
        if (vr[i] < VR_INPUT || vr[i] >= VR_PARAMETER || order[i] != 1)
            return complain(c, "only first derivatives of inputs can be set");
        G->memory.slope[vr[i] - VR_INPUT] = value[i];
    }
    return fmi2OK;
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                        const fmi2Integer order[], fmi2Real value[]) {
    (void)vr, (void)n, (void)order, (void)value;
    NOT_THERE("fmi2GetRealOutputDerivatives");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real step, fmi2Boolean final) {
    (void)final;
    return gb_advance(G, time, time + step) ? complain(c, G->trouble) : fmi2OK;
}

fmi2Status fmi2CancelStep(fmi2Component c) { NOT_THERE("fmi2CancelStep"); }

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value) {
    (void)kind, (void)value;
    NOT_THERE("fmi2GetStatus");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value) {
    if (kind != fmi2LastSuccessfulTime) NOT_THERE("this status");
    *value = G->memory.time;
    return fmi2OK;
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Integer *value) {
    (void)kind, (void)value;
    NOT_THERE("fmi2GetIntegerStatus");
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Boolean *value) {
    (void)kind;
    (void)c;
    *value = fmi2False;
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind, fmi2String *value) {
    (void)kind, (void)value;
    NOT_THERE("fmi2GetStringStatus");
}
