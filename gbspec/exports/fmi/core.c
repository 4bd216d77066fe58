#include "gb_core.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define GB_NO_ROOM "the past has no room for so many steps within a delay"
#define ROUNDING 1e-10 /* the share of a time within which two times are equal */

static double *parameters(PREFIX_parameters *p) { return (double *)p; }

gb_instance *gb_new(const char *name) {
    gb_instance *g = (gb_instance *)calloc(1, sizeof(gb_instance));
    if (!g) return NULL;
    if (name) strncpy(g->name, name, sizeof g->name - 1);
    gb_reset(g);
    return g;
}

void gb_reset(gb_instance *g) {
    gb_memory *m = &g->memory;
    int i;
    memset(m, 0, sizeof *m);
    m->time = GB_START;
    for (i = 0; i < PREFIX_STATES; i++) m->x[i] = GB_X[i];
    for (i = 0; i < PREFIX_INPUTS; i++) m->u[i] = GB_U[i];
    for (i = 0; i < PREFIX_DOSES; i++) {
        m->regimen[4 * i + 1] = GB_START;
        m->regimen[4 * i + 3] = 1.0;
    }
    m->step = GB_STEP;
    PREFIX_defaults(&m->p);
    m->mode = GB_INSTANTIATED;
    g->fresh = 0;
    g->trouble = NULL;
}

double gb_nominal(int state) { return GB_NOMINAL[state]; }

#if GB_DELAYS > 0
/* A time on the side from which the present is seen. */
static double side(const gb_memory *m) {
    return m->mode == GB_RUNNING && m->time > m->event ? m->event : m->time + PREFIX_shortest(&m->p);
}

#endif

/* The delayed values of the present stand behind the inputs. Just at an event they are those after it. */
static void look_back(gb_memory *m) {
#if GB_DELAYS > 0
    if (m->mode != GB_RUNNING) PREFIX_begin(&m->p, m->time, m->x, m->u, &m->past);
    PREFIX_late(&m->p, &m->past, m->time, side(m), m->u + PREFIX_INPUTS);
#else
    (void)m;
#endif
}

void gb_rates(gb_instance *g, double *dx) {
    gb_memory *m = &g->memory;
    if (m->mode == GB_RUNNING && !g->fresh) {
        look_back(m);
        PREFIX_rhs(&m->p, m->time, m->x, m->u, dx);
    } else {
        gb_evaluate(g);
        memcpy(dx, g->dx, sizeof g->dx);
    }
}

/* Computes everything that follows from the memory. Before the start, states that are given by expressions follow too. */
void gb_evaluate(gb_instance *g) {
    gb_memory *m = &g->memory;
    if (g->fresh) return;
    if (m->mode != GB_RUNNING) PREFIX_initial(&m->p, m->x);
    look_back(m);
    PREFIX_rhs(&m->p, m->time, m->x, m->u, g->dx);
    PREFIX_observe(&m->p, m->time, m->x, m->u, g->y);
    PREFIX_functions(&m->p, m->time, m->x, m->u, g->f);
#if GB_ALGEBRAICS > 0
    PREFIX_algebraic(&m->p, m->time, m->x, m->u, g->solved);
#endif
    gb_indicators(g, g->z);
    g->outside = PREFIX_outside(&m->p, m->time, m->x, m->u, NULL);
    g->fresh = 1;
}

int gb_get(gb_instance *g, unsigned vr, double *value) {
    gb_memory *m = &g->memory;
    gb_evaluate(g);
    if (vr == VR_TIME) *value = m->time;
    else if (vr < VR_DERIVATIVE) *value = m->x[vr - VR_STATE];
    else if (vr < VR_INPUT) *value = g->dx[vr - VR_DERIVATIVE];
    else if (vr < VR_PARAMETER) *value = m->u[vr - VR_INPUT];
    else if (vr < VR_REGIMEN) *value = parameters(&m->p)[vr - VR_PARAMETER];
    else if (vr < VR_STEP) *value = m->regimen[vr - VR_REGIMEN];
    else if (vr == VR_STEP) *value = m->step;
    else if (vr < VR_FUNCTION) *value = g->y[vr - VR_CHANNEL];
    else if (vr < VR_ALGEBRAIC) *value = g->f[vr - VR_FUNCTION];
    else if (vr < VR_SWITCH) *value = g->solved[vr - VR_ALGEBRAIC];
    else if (vr < VR_OUTSIDE) *value = g->z[vr - VR_SWITCH]; /* and guards */
    else return 1;
    return 0;
}

int gb_set(gb_instance *g, unsigned vr, double value) {
    gb_memory *m = &g->memory;
    if (vr == VR_TIME) m->time = value;
    else if (vr < VR_DERIVATIVE) m->x[vr - VR_STATE] = value;
    else if (vr < VR_INPUT) return 1;
    else if (vr < VR_PARAMETER) m->u[vr - VR_INPUT] = value;
    else if (vr < VR_REGIMEN) parameters(&m->p)[vr - VR_PARAMETER] = value;
    else if (vr < VR_STEP) m->regimen[vr - VR_REGIMEN] = value;
    else if (vr == VR_STEP) m->step = value;
    else return 1;
    g->fresh = 0;
    return 0;
}

/* When the next dose of a kind arrives; infinite where none follows. */
static double arrival(const gb_memory *m, int dose) {
    const double *r = m->regimen + 4 * dose;
    double fraction[PREFIX_DOSES + 1], lag[PREFIX_DOSES + 1];
    if (r[0] == 0.0 || m->given[dose] >= r[3]) return HUGE_VAL;
    PREFIX_doses(&m->p, fraction, lag);
    return r[1] + m->given[dose] * r[2] + lag[dose];
}

static int before(double a, double b) {
    const double size = fabs(a) > fabs(b) ? fabs(a) : fabs(b);
    return a < b - ROUNDING * size;
}

#if GB_DELAYS > 0
/* After an event the next step begins. */
static void begin_step(gb_memory *m) {
    m->event = m->open.t = m->time;
    memcpy(m->open.x0, m->x, sizeof m->open.x0);
    memcpy(m->open.u0, m->u, PREFIX_INPUTS * sizeof(double));
    memcpy(m->bent, m->slope, sizeof m->bent);
    look_back(m);
    PREFIX_rhs(&m->p, m->time, m->x, m->u, m->open.f0);
}

/* What jumped since the end of the last step shows again after the delays. */
static void notice_jumps(gb_memory *m) {
    const int inputs = memcmp(m->open.u0, m->u, PREFIX_INPUTS * sizeof(double)) != 0;
    if (inputs && !m->past.count) memcpy(m->past.u, m->u, PREFIX_INPUTS * sizeof(double)); /* which hold before */
    PREFIX_reach(&m->p, m->time, &m->past);
    if (inputs || memcmp(m->open.x0, m->x, sizeof m->open.x0) || memcmp(m->bent, m->slope, sizeof m->bent))
        PREFIX_jump(&m->p, m->time, &m->past);
}

#endif
int gb_completed(gb_instance *g) {
#if GB_DELAYS > 0
    gb_memory *m = &g->memory;
    double now[PREFIX_INPUTS + 1];
    int i, changed = 0;
    if (m->mode != GB_RUNNING || !(m->time > m->open.t)) return 0;
    memcpy(now, m->u, PREFIX_INPUTS * sizeof(double));
    for (i = 0; i < PREFIX_INPUTS; i++) /* a held input changes at the end of a step, not within it */
        if (GB_HELD[i] && m->u[i] != m->open.u0[i]) m->u[i] = m->open.u0[i], changed = 1;
    m->open.h = m->time - m->open.t;
    memcpy(m->open.x1, m->x, sizeof m->open.x1);
    memcpy(m->open.u1, m->u, PREFIX_INPUTS * sizeof(double));
    look_back(m);
    PREFIX_rhs(&m->p, m->time, m->x, m->u, m->open.f1);
    if (PREFIX_keep(&m->p, &m->open, &m->past)) g->trouble = GB_NO_ROOM;
    memcpy(m->u, now, PREFIX_INPUTS * sizeof(double));
    m->open.t = m->time;
    memcpy(m->open.x0, m->open.x1, sizeof m->open.x0);
    memcpy(m->open.f0, m->open.f1, sizeof m->open.f0);
    memcpy(m->open.u0, now, PREFIX_INPUTS * sizeof(double));
    if (changed) {
        PREFIX_jump(&m->p, m->time, &m->past);
        PREFIX_rhs(&m->p, m->time, m->x, m->u, m->open.f0);
    }
#endif
    return g->trouble != NULL;
}

void gb_begin(gb_instance *g, double start) {
    g->memory.time = start;
    g->memory.mode = GB_INITIALIZATION;
    g->fresh = 0;
}

/* Doses that arrive before the start are not given. */
void gb_exit_initialization(gb_instance *g) {
    gb_memory *m = &g->memory;
    int i;
    PREFIX_initial(&m->p, m->x);
    for (i = 0; i < PREFIX_DOSES; i++) {
        m->given[i] = 0.0;
        while (before(arrival(m, i), m->time)) m->given[i] += 1.0;
    }
#if GB_GUARDS + GB_TIMED > 0
    PREFIX_arm(&m->p, m->time, m->x, m->u, &m->events);
#endif
    m->mode = GB_RUNNING;
    g->fresh = 0;
#if GB_DELAYS > 0
    PREFIX_begin(&m->p, m->time, m->x, m->u, &m->past);
    begin_step(m);
#endif
}

/* Whether doses arrived now. */
static int give(gb_instance *g) {
    gb_memory *m = &g->memory;
    double fraction[PREFIX_DOSES + 1], lag[PREFIX_DOSES + 1];
    int i, given = 0;
    PREFIX_doses(&m->p, fraction, lag);
    for (i = 0; i < PREFIX_DOSES; i++)
        while (arrival(m, i) < HUGE_VAL && !before(m->time, arrival(m, i))) {
            m->x[GB_DOSE_STATE[i]] += m->regimen[4 * i] * fraction[i];
            m->given[i] += 1.0;
            given = 1;
        }
    if (given) g->fresh = 0;
    return given;
}

/* The time of what happens next: a dose, an event, a jump that shows again. */
static double next_one(const gb_instance *g) {
    double next = HUGE_VAL;
    int i;
    for (i = 0; i < PREFIX_DOSES; i++)
        if (arrival(&g->memory, i) < next) next = arrival(&g->memory, i);
#if GB_TIMED > 0
    for (i = 0; i < GB_TIMED; i++)
        if (PREFIX_due(&g->memory.p, &g->memory.events, i) < next) next = PREFIX_due(&g->memory.p, &g->memory.events, i);
#endif
#if GB_DELAYS > 0
    if (PREFIX_mark(&g->memory.past) < next) next = PREFIX_mark(&g->memory.past);
#endif
    return next;
}

int gb_next_event(const gb_instance *g, double *time) {
    *time = next_one(g);
#if GB_DELAYS > 0 /* no step is longer than the shortest delay, within which the past is known */
    {
        const double latest = g->memory.event + PREFIX_shortest(&g->memory.p);
        if (latest < *time) *time = latest;
    }
#endif
    return *time < HUGE_VAL;
}

int gb_update(gb_instance *g) {
    int changed;
    gb_completed(g);
    changed = give(g);
#if GB_GUARDS + GB_TIMED > 0
    gb_memory *m = &g->memory;
    const int happened = PREFIX_carry_out(&m->p, m->time, m->u, m->x, &m->events);
    if (happened < 0) g->trouble = "events follow each other without end";
    if (happened) g->fresh = 0, changed = 1;
#endif
#if GB_DELAYS > 0
    if (!(PREFIX_shortest(&g->memory.p) > 0.0)) g->trouble = "a delay is not positive";
    notice_jumps(&g->memory);
    begin_step(&g->memory);
    g->fresh = 0;
#endif
    return changed;
}

/* Quantities whose signs change at events. A guard is moved by a band, so that a condition that has just become true, or
   false, lies beyond the zero of its indicator. */
void gb_indicators(gb_instance *g, double *z) {
    gb_memory *m = &g->memory;
    look_back(m);
    if (PREFIX_SWITCHES) PREFIX_switches(&m->p, m->time, m->x, m->u, z);
#if GB_GUARDS > 0
    {
        int i;
        PREFIX_guards(&m->p, m->time, m->x, m->u, z + PREFIX_SWITCHES);
        for (i = 0; i < GB_GUARDS; i++) z[PREFIX_SWITCHES + i] += m->events.on[i] ? m->events.band[i] : -m->events.band[i];
    }
#endif
}

/* Equal steps from `from` to `to`; the inputs are those at `from`, and change by their slopes. */
static int steps(gb_instance *g, double from, double to) {
    gb_memory *m = &g->memory;
    double longest = m->step > 0.0 ? m->step : to - from, wanted;
    long k, count;
    double h;
#if GB_DELAYS > 0
    if (PREFIX_shortest(&m->p) < longest) longest = PREFIX_shortest(&m->p);
#endif
    wanted = ceil((to - from) / longest - 1e-9);
    count = wanted > 1.0 ? (long)wanted : 1;
    h = (to - from) / (double)count;
    for (k = 0; k < count; k++) {
        const double t = from + (double)k * h;
#if GB_GUARDS + GB_TIMED > 0
        if (PREFIX_cut(&m->p, from, m->u, m->slope, t, h, m->x, &m->events)) {
            g->trouble = "events follow each other without end";
            return 1;
        }
#elif GB_DELAYS > 0
        if (PREFIX_move(&m->p, from, m->u, m->slope, t, h, m->x, &m->past)) {
            g->trouble = GB_NO_ROOM;
            return 1;
        }
#else
        PREFIX_move(&m->p, from, m->u, m->slope, t, h, m->x);
#endif
    }
    return 0;
}

int gb_advance(gb_instance *g, double from, double to) {
    gb_memory *m = &g->memory;
    double t = from, next;
    int i;
    m->time = t;
#if GB_DELAYS > 0
    m->open.t = t;
#endif
    while (before(t, to)) {
        gb_update(g);
        next = next_one(g);
        if (!before(next, to)) next = to;
        if (g->trouble || steps(g, t, next)) return 1;
        for (i = 0; i < PREFIX_INPUTS; i++) m->u[i] += m->slope[i] * (next - t);
        m->time = t = next;
#if GB_DELAYS > 0
        m->open.t = t; /* the step is in the past already */
        memcpy(m->open.x0, m->x, sizeof m->open.x0);
        memcpy(m->open.u0, m->u, PREFIX_INPUTS * sizeof(double));
#endif
    }
    m->time = to;
    g->fresh = 0;
    for (i = 0; i < PREFIX_STATES; i++)
        if (!(fabs(m->x[i]) < HUGE_VAL)) g->trouble = "the states are not finite";
    return g->trouble != NULL;
}

int gb_along(gb_instance *g, const unsigned *unknowns, size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
             const double *seed, double *found) {
    gb_memory *m = &g->memory;
    PREFIX_parameters dp;
    double dx[PREFIX_STATES], own[PREFIX_STATES], du[PREFIX_INPUTS + GB_DELAYS + 1] = {0.0}, dt = 0.0, outer = 0.0;
    double rates[PREFIX_STATES], y[PREFIX_CHANNELS + 1], f[PREFIX_FUNCTIONS + 1], solved[GB_ALGEBRAICS + 1];
    size_t i;
    memset(&dp, 0, sizeof dp);
    memset(own, 0, sizeof own);
    gb_evaluate(g);
    for (i = 0; i < n_knowns; i++) {
        const unsigned vr = knowns[i];
        if (vr == VR_TIME) dt = seed[i];
        else if (vr < VR_DERIVATIVE) own[vr - VR_STATE] = seed[i];
        else if (vr < VR_INPUT) return 1;
        else if (vr < VR_PARAMETER) du[vr - VR_INPUT] = seed[i];
        else if (vr < VR_REGIMEN) parameters(&dp)[vr - VR_PARAMETER] = seed[i];
        else if (vr <= VR_STEP) outer += seed[i]; /* a dose or the step: no continuous variable depends on it */
        else return 1;
    }
    (void)outer;
    if (m->mode == GB_RUNNING) memcpy(dx, own, sizeof dx);
    else PREFIX_initial_along(&m->p, m->x, &dp, own, dx);
#if GB_DELAYS > 0
    {
        const int running = m->mode == GB_RUNNING;
        PREFIX_late_along(&m->p, &m->past, m->time, side(m), &dp, dt, running ? NULL : dx, running ? NULL : du,
                          du + PREFIX_INPUTS);
    }
#endif
    PREFIX_rhs_along(&m->p, m->time, m->x, m->u, &dp, dt, dx, du, rates);
    PREFIX_observe_along(&m->p, m->time, m->x, m->u, &dp, dt, dx, du, y);
    PREFIX_functions_along(&m->p, m->time, m->x, m->u, &dp, dt, dx, du, f);
#if GB_ALGEBRAICS > 0
    PREFIX_algebraic_along(&m->p, m->time, m->x, m->u, &dp, dt, dx, du, solved);
#else
    (void)solved;
#endif
    for (i = 0; i < n_unknowns; i++) {
        const unsigned vr = unknowns[i];
        if (vr >= VR_STATE && vr < VR_DERIVATIVE) found[i] = dx[vr - VR_STATE];
        else if (vr >= VR_DERIVATIVE && vr < VR_INPUT) found[i] = rates[vr - VR_DERIVATIVE];
        else if (vr >= VR_CHANNEL && vr < VR_FUNCTION) found[i] = y[vr - VR_CHANNEL];
        else if (vr >= VR_FUNCTION && vr < VR_ALGEBRAIC) found[i] = f[vr - VR_FUNCTION];
        else if (vr >= VR_ALGEBRAIC && vr < VR_SWITCH) found[i] = solved[vr - VR_ALGEBRAIC];
        else return 1;
    }
    return 0;
}
