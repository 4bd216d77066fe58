/* What FMI 2.0 and 3.0 have in common: an instance of the model with its variables, events and steps. */

#ifndef GB_CORE_H
#define GB_CORE_H

#include "PREFIX.h"

#include <stddef.h>

/* Value references: the first of each kind of variable. */
enum {
    VR_TIME = 0,
    VR_STATE = 1,
    VR_DERIVATIVE = VR_STATE + PREFIX_STATES,
    VR_INPUT = VR_DERIVATIVE + PREFIX_STATES,
    VR_PARAMETER = VR_INPUT + PREFIX_INPUTS,
    VR_REGIMEN = VR_PARAMETER + GB_PARAMETERS, /* of each dose: amount, first time, interval, number */
    VR_STEP = VR_REGIMEN + 4 * PREFIX_DOSES,
    VR_CHANNEL = VR_STEP + 1,
    VR_FUNCTION = VR_CHANNEL + PREFIX_CHANNELS,
    VR_ALGEBRAIC = VR_FUNCTION + PREFIX_FUNCTIONS,
    VR_SWITCH = VR_ALGEBRAIC + GB_ALGEBRAICS,
    VR_GUARD = VR_SWITCH + PREFIX_SWITCHES,
    VR_OUTSIDE = VR_GUARD + GB_GUARDS,
    VR_END = VR_OUTSIDE + 1
};

typedef enum { GB_INSTANTIATED, GB_INITIALIZATION, GB_RUNNING } gb_mode;

/* All that an instance remembers, without pointers: copied as it is when its state is kept or written. */
typedef struct {
    double time, x[PREFIX_STATES], u[PREFIX_INPUTS + GB_DELAYS + 1], slope[PREFIX_INPUTS + 1];
    double regimen[4 * PREFIX_DOSES + 1], given[PREFIX_DOSES + 1], step;
#if GB_GUARDS + GB_TIMED > 0
    PREFIX_events events;
#endif
#if GB_DELAYS > 0
    PREFIX_past past;
    PREFIX_piece open;              /* the beginning of the step that is not complete yet */
    double event, bent[PREFIX_INPUTS + 1]; /* the time of the last event, the slopes of inputs in the last step */
#endif
    PREFIX_parameters p;
    gb_mode mode;
} gb_memory;

typedef struct {
    gb_memory memory;
    double dx[PREFIX_STATES], y[PREFIX_CHANNELS + 1], f[PREFIX_FUNCTIONS + 1], solved[GB_ALGEBRAICS + 1];
    double z[PREFIX_SWITCHES + GB_GUARDS + 1];
    const char *trouble; /* why it cannot go on; NULL: it can */
    int outside, fresh; /* whether these are those of the memory */
    void *environment, *log;
    char name[64];
} gb_instance;

gb_instance *gb_new(const char *name);
void gb_reset(gb_instance *g);
int gb_get(gb_instance *g, unsigned vr, double *value); /* 0, or 1 if there is no such variable */
int gb_set(gb_instance *g, unsigned vr, double value);  /* 0, or 1 if it cannot be set */
void gb_begin(gb_instance *g, double start);
void gb_exit_initialization(gb_instance *g);
int gb_next_event(const gb_instance *g, double *time); /* whether model exchange has to stop at a time, and when */
int gb_update(gb_instance *g);                         /* whether doses arrived or events happened now */
void gb_rates(gb_instance *g, double *dx);
void gb_indicators(gb_instance *g, double *z);
int gb_completed(gb_instance *g);                       /* after a step of model exchange: 0, or 1 in trouble */
int gb_advance(gb_instance *g, double from, double to); /* 0, or 1 in trouble */
int gb_along(gb_instance *g, const unsigned *unknowns, size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
             const double *seed, double *found);
void gb_evaluate(gb_instance *g);
double gb_nominal(int state);

#endif
