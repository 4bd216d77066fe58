/* ---------------------------------------------------------------- events */

#define CASCADE 100    /* most events at one time */
#define SHARE 1e-10    /* the band of a guard, relative to its size at the start */
#define ROUNDING 1e-10 /* the share of a time within which two times are equal */

static int earlier(double a, double b) {
    const double size = fabs(a) > fabs(b) ? fabs(a) : fabs(b);
    return a < b - ROUNDING * size;
}

double PREFIX_due(const PREFIX_parameters *p, const PREFIX_events *e, int event) {
    double timing[3 * PREFIX_TIMED + 1] = {0.0}, at;
    PREFIX_timing(p, timing);
    at = timing[3 * event];
    if (at != at) at = e->start;
    if (timing[3 * event + 1] > 0.0) at += e->turn[event] * timing[3 * event + 1];
    else if (e->turn[event] > 0.0) return HUGE_VAL;
    return earlier(timing[3 * event + 2], at) ? HUGE_VAL : at;
}

void PREFIX_arm(const PREFIX_parameters *p, double t, const double *x, const double *u, PREFIX_events *e) {
    double guard[PREFIX_GUARDS + 1];
    int i;
    e->start = t;
    PREFIX_guards(p, t, x, u, guard);
    for (i = 0; i < PREFIX_GUARDS; i++) {
        e->on[i] = guard[i] >= 0.0 && !ARMED[i];
        e->band[i] = SHARE * (fabs(guard[i]) < HUGE_VAL ? fabs(guard[i]) + 1e-3 : 1.0);
    }
    for (i = 0; i < PREFIX_TIMED; i++) {
        e->turn[i] = 0.0;
        while (earlier(PREFIX_due(p, e, i), t)) e->turn[i] += 1.0;
    }
    for (i = 0; i < PREFIX_TIMED + PREFIX_GUARDS; i++) e->pending[i] = 0;
}

/* Conditions that are true no longer; events whose conditions became true, or whose time has come, are pending. */
static int notice(const PREFIX_parameters *p, double t, const double *x, const double *u, PREFIX_events *e) {
    double guard[PREFIX_GUARDS + 1];
    int i, found = 0;
    for (i = 0; i < PREFIX_TIMED; i++) {
        const double at = PREFIX_due(p, e, i);
        if (at < HUGE_VAL && !earlier(t, at)) e->pending[i] = 1;
        found = found || e->pending[i];
    }
    PREFIX_guards(p, t, x, u, guard);
    for (i = 0; i < PREFIX_GUARDS; i++) {
        if (guard[i] >= 0.0 && !e->on[i]) e->pending[PREFIX_TIMED + i] = 1;
        if (!(guard[i] >= 0.0)) e->on[i] = 0;
        found = found || e->pending[PREFIX_TIMED + i];
    }
    return found;
}

/* The pending event that comes first: timed ones, then by priority, then as they are written. */
static int chosen(const PREFIX_parameters *p, double t, const double *x, const double *u, const PREFIX_events *e) {
    double rank[PREFIX_TIMED + PREFIX_GUARDS];
    int i, best = -1;
    PREFIX_ranks(p, t, x, u, rank);
    for (i = 0; i < PREFIX_TIMED + PREFIX_GUARDS; i++)
        if (e->pending[i] && (best < 0 || ((i < PREFIX_TIMED) == (best < PREFIX_TIMED) && rank[i] > rank[best]))) best = i;
    return best;
}

int PREFIX_carry_out(const PREFIX_parameters *p, double t, const double *u, double *x, PREFIX_events *e) {
    double after[PREFIX_STATES];
    int count = 0, event, i;
    while (notice(p, t, x, u, e)) {
        event = chosen(p, t, x, u, e);
        if (event < 0) break;
        if (++count > CASCADE) return -1;
        PREFIX_happen(p, t, x, u, event, after);
        for (i = 0; i < PREFIX_STATES; i++) x[i] = after[i];
        e->pending[event] = 0;
        if (event < PREFIX_TIMED) e->turn[event] += 1.0;
        else e->on[event - PREFIX_TIMED] = 1; /* it happens again once its condition was false */
    }
    return count;
}

/* The guards and the state a part of a step later. */
static void ahead(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double part,
                  const double *from, double *x, double *guard) {
    double u[PREFIX_INPUTS + 1];
    int i;
    for (i = 0; i < PREFIX_STATES; i++) x[i] = from[i];
    PREFIX_move(p, begin, value, slope, t, part, x);
    for (i = 0; i < PREFIX_INPUTS; i++) u[i] = value[i] + slope[i] * (t + part - begin);
    PREFIX_guards(p, t + part, x, u, guard);
}

/* Whether a condition became true that was false. */
static int entered(const PREFIX_events *e, const double *guard) {
    int i;
    for (i = 0; i < PREFIX_GUARDS; i++)
        if (!e->on[i] && guard[i] >= 0.0) return 1;
    return 0;
}

int PREFIX_cut(const PREFIX_parameters *p, double begin, const double *value, const double *slope, double t, double h,
               double *x, PREFIX_events *e) {
    double place[PREFIX_STATES], guard[PREFIX_GUARDS + 1], u[PREFIX_INPUTS + 1], low, high, middle;
    int i, half, found, count = 0;
    while (PREFIX_GUARDS > 0 && h > 0.0) {
        for (half = 1, found = 0; half <= 2 && !found; half++) {
            low = (half - 1) * 0.5 * h;
            high = half == 2 ? h : 0.5 * h;
            ahead(p, begin, value, slope, t, high, x, place, guard);
            found = entered(e, guard);
            for (i = 0; i < PREFIX_GUARDS && !found; i++)
                if (!(guard[i] >= 0.0)) e->on[i] = 0;
        }
        if (!found) break;
        if (++count > CASCADE) return 1;
        for (i = 0; i < 100 && high - low > 4.0 * 2.220446049250313e-16 * (fabs(t) + h); i++) {
            middle = 0.5 * (low + high);
            ahead(p, begin, value, slope, t, middle, x, place, guard);
            if (entered(e, guard)) high = middle;
            else low = middle;
        }
        if (!earlier(t + high, t + h)) break; /* at the end of the step it happens after it, like an event at a time */
        ahead(p, begin, value, slope, t, high, x, place, guard);
        for (i = 0; i < PREFIX_STATES; i++) x[i] = place[i];
        for (i = 0; i < PREFIX_INPUTS; i++) u[i] = value[i] + slope[i] * (t + high - begin);
        if (PREFIX_carry_out(p, t + high, u, x, e) < 0) return 1;
        t += high;
        h -= high;
    }
    if (h > 0.0) PREFIX_move(p, begin, value, slope, t, h, x);
    return 0;
}

