#include "gb_core.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

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
    g->fresh = g->endless = 0;
}

double gb_nominal(int state) { return GB_NOMINAL[state]; }

/* Computes everything that follows from the memory. Before the start, states that are given by expressions follow too. */
void gb_evaluate(gb_instance *g) {
    gb_memory *m = &g->memory;
    if (g->fresh) return;
    if (m->mode != GB_RUNNING) PREFIX_initial(&m->p, m->x);
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

#if GB_GUARDS + GB_TIMED > 0
static void arm(gb_memory *m);
#endif

static int before(double a, double b) {
    const double size = fabs(a) > fabs(b) ? fabs(a) : fabs(b);
    return a < b - ROUNDING * size;
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
    arm(m);
#endif
    m->mode = GB_RUNNING;
    g->fresh = 0;
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

#if GB_GUARDS + GB_TIMED > 0
#define EVENTS (GB_TIMED + GB_GUARDS)
#define CASCADE 100 /* most events at one time */
#define SHARE 1e-10 /* the band of a guard, relative to its size at the start */

/* The next time of a timed event; infinite after its last one. */
static double due(const gb_memory *m, int event) {
    double timing[3 * GB_TIMED + 1], at;
    PREFIX_timing(&m->p, timing);
    at = timing[3 * event];
    if (at != at) at = m->start;
    if (timing[3 * event + 1] > 0.0) at += m->turn[event] * timing[3 * event + 1];
    else if (m->turn[event] > 0.0) return HUGE_VAL;
    return before(timing[3 * event + 2], at) ? HUGE_VAL : at;
}

/* Conditions at the start; those of armed events that are true make them happen. Times before it have passed. */
static void arm(gb_memory *m) {
    double guard[GB_GUARDS + 1];
    int i;
    m->start = m->time;
    PREFIX_guards(&m->p, m->time, m->x, m->u, guard);
    for (i = 0; i < GB_GUARDS; i++) {
        m->on[i] = guard[i] >= 0.0 && !GB_ARMED[i];
        m->band[i] = SHARE * (fabs(guard[i]) < HUGE_VAL ? fabs(guard[i]) + 1e-3 : 1.0);
    }
    for (i = 0; i < GB_TIMED; i++) {
        m->turn[i] = 0.0;
        while (before(due(m, i), m->time)) m->turn[i] += 1.0;
    }
}

/* Conditions that are true no longer; events whose conditions became true, or whose time has come, are pending. */
static int notice(gb_memory *m) {
    double guard[GB_GUARDS + 1];
    int i, found = 0;
    for (i = 0; i < GB_TIMED; i++) {
        if (due(m, i) < HUGE_VAL && !before(m->time, due(m, i))) m->pending[i] = 1;
        found = found || m->pending[i];
    }
    PREFIX_guards(&m->p, m->time, m->x, m->u, guard);
    for (i = 0; i < GB_GUARDS; i++) {
        if (guard[i] >= 0.0 && !m->on[i]) m->pending[GB_TIMED + i] = 1;
        if (!(guard[i] >= 0.0)) m->on[i] = 0;
        found = found || m->pending[GB_TIMED + i];
    }
    return found;
}

/* The pending event that comes first: timed ones, then by priority, then as they are written. */
static int chosen(const gb_memory *m) {
    double rank[EVENTS];
    int i, best = -1;
    PREFIX_ranks(&m->p, m->time, m->x, m->u, rank);
    for (i = 0; i < EVENTS; i++)
        if (m->pending[i] && (best < 0 || ((i < GB_TIMED) == (best < GB_TIMED) && rank[i] > rank[best]))) best = i;
    return best;
}

/* What happens now, and what that causes. */
static int happen(gb_instance *g) {
    gb_memory *m = &g->memory;
    double after[PREFIX_STATES];
    int count = 0, event;
    while (notice(m)) {
        event = chosen(m);
        if (++count > CASCADE) {
            g->endless = 1;
            return 1;
        }
        PREFIX_happen(&m->p, m->time, m->x, m->u, event, after);
        memcpy(m->x, after, sizeof after);
        m->pending[event] = 0;
        if (event < GB_TIMED) m->turn[event] += 1.0;
        else m->on[event - GB_TIMED] = 1; /* it happens again once its condition was false */
    }
    if (count) g->fresh = 0;
    return count > 0;
}
#endif

int gb_next_event(const gb_instance *g, double *time) {
    double next = HUGE_VAL;
    int i;
    for (i = 0; i < PREFIX_DOSES; i++)
        if (arrival(&g->memory, i) < next) next = arrival(&g->memory, i);
#if GB_TIMED > 0
    for (i = 0; i < GB_TIMED; i++)
        if (due(&g->memory, i) < next) next = due(&g->memory, i);
#endif
    *time = next;
    return next < HUGE_VAL;
}

int gb_update(gb_instance *g) {
    int changed = give(g);
#if GB_GUARDS + GB_TIMED > 0
    changed = happen(g) || changed;
#endif
    return changed;
}

/* Quantities whose signs change at events. A guard is moved by a band, so that a condition that has just become true, or
   false, lies beyond the zero of its indicator. */
void gb_indicators(const gb_instance *g, double *z) {
    const gb_memory *m = &g->memory;
    if (PREFIX_SWITCHES) PREFIX_switches(&m->p, m->time, m->x, m->u, z);
#if GB_GUARDS > 0
    {
        int i;
        PREFIX_guards(&m->p, m->time, m->x, m->u, z + PREFIX_SWITCHES);
        for (i = 0; i < GB_GUARDS; i++) z[PREFIX_SWITCHES + i] += m->on[i] ? m->band[i] : -m->band[i];
    }
#endif
}

/* One step of the model's method; inputs are those at `start` and change by their slopes. */
static void step(const gb_memory *m, double start, double t, double h, double *x) {
    double u[PREFIX_NODES * PREFIX_INPUTS + 1];
    int q, j;
    for (q = 0; q < PREFIX_NODES; q++)
        for (j = 0; j < PREFIX_INPUTS; j++)
            u[q * PREFIX_INPUTS + j] = m->u[j] + m->slope[j] * (t + GB_NODE[q] * h - start);
    PREFIX_step(&m->p, t, h, u, x);
}

#if GB_GUARDS > 0
/* The state a part of a step later, and whether a condition became true by then that was false. */
static int reached(const gb_memory *m, double start, double t, double part, double *x) {
    double guard[GB_GUARDS], u[PREFIX_INPUTS + 1];
    int i;
    memcpy(x, m->x, sizeof m->x);
    step(m, start, t, part, x);
    for (i = 0; i < PREFIX_INPUTS; i++) u[i] = m->u[i] + m->slope[i] * (t + part - start);
    PREFIX_guards(&m->p, t + part, x, u, guard);
    for (i = 0; i < GB_GUARDS; i++)
        if (!m->on[i] && guard[i] >= 0.0) return 1;
    return 0;
}

/* Conditions that became false by a part of a step. */
static void released(gb_memory *m, double start, double t, double part) {
    double guard[GB_GUARDS], u[PREFIX_INPUTS + 1], x[PREFIX_STATES];
    int i;
    memcpy(x, m->x, sizeof m->x);
    step(m, start, t, part, x);
    for (i = 0; i < PREFIX_INPUTS; i++) u[i] = m->u[i] + m->slope[i] * (t + part - start);
    PREFIX_guards(&m->p, t + part, x, u, guard);
    for (i = 0; i < GB_GUARDS; i++)
        if (!(guard[i] >= 0.0)) m->on[i] = 0;
}
#endif

/* One step of length h, cut where events happen. */
static int cut(gb_instance *g, double start, double t, double h) {
    gb_memory *m = &g->memory;
#if GB_GUARDS > 0
    double x[PREFIX_STATES], low, high, middle;
    int half, found, count = 0;
    while (h > 0.0) {
        found = 0;
        for (half = 1; half <= 2 && !found; half++) {
            low = (half - 1) * 0.5 * h;
            high = half == 2 ? h : 0.5 * h;
            found = reached(m, start, t, high, x);
            if (!found) released(m, start, t, high);
        }
        if (!found) break;
        if (++count > CASCADE) {
            g->endless = 1;
            return 1;
        }
        for (half = 0; half < 100 && high - low > 4.0 * 2.220446049250313e-16 * (fabs(t) + h); half++) {
            middle = 0.5 * (low + high);
            if (reached(m, start, t, middle, x)) high = middle;
            else low = middle;
        }
        reached(m, start, t, high, x);
        memcpy(m->x, x, sizeof x);
        {
            double u[PREFIX_INPUTS + 1];
            int i;
            memcpy(u, m->u, sizeof u);
            for (i = 0; i < PREFIX_INPUTS; i++) m->u[i] += m->slope[i] * (t + high - start);
            m->time = t + high;
            happen(g);
            memcpy(m->u, u, sizeof u);
        }
        if (g->endless) return 1;
        t += high;
        h -= high;
    }
#endif
    if (h > 0.0) step(m, start, t, h, m->x);
    return 0;
}

/* Equal steps from `from` to `to`, where inputs are those at `start`. */
static int steps(gb_instance *g, double start, double from, double to) {
    gb_memory *m = &g->memory;
    const double wanted = m->step > 0.0 ? ceil((to - from) / m->step - 1e-9) : 1.0;
    const long count = wanted > 1.0 ? (long)wanted : 1;
    const double h = (to - from) / (double)count;
    long k;
    for (k = 0; k < count; k++)
        if (cut(g, start, from + (double)k * h, h)) return 1;
    return 0;
}

int gb_advance(gb_instance *g, double from, double to) {
    gb_memory *m = &g->memory;
    double t = from, next;
    int i;
    m->time = t;
    while (before(t, to)) {
        gb_update(g);
        if (!gb_next_event(g, &next) || !before(next, to)) next = to;
        if (g->endless || steps(g, from, t, next)) return 1;
        m->time = t = next;
    }
    for (i = 0; i < PREFIX_INPUTS; i++) m->u[i] += m->slope[i] * (to - from);
    m->time = to;
    g->fresh = 0;
    for (i = 0; i < PREFIX_STATES; i++)
        if (!(fabs(m->x[i]) < HUGE_VAL)) return 1;
    return 0;
}

int gb_along(gb_instance *g, const unsigned *unknowns, size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
             const double *seed, double *found) {
    gb_memory *m = &g->memory;
    PREFIX_parameters dp;
    double dx[PREFIX_STATES], own[PREFIX_STATES], du[PREFIX_INPUTS + 1] = {0.0}, dt = 0.0, outer = 0.0;
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
