/* ---------------------------------------------------------------- over time */

/* The value of an input at a time (at a jump the value after it), and its slope just after that time. */
static double course(const PREFIX_course *input, int linear, double t, double *slope) {
    const double *times = input->times, *values = input->values;
    int low = 0, high = input->count;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (times[middle] <= t) low = middle + 1;
        else high = middle;
    }
    *slope = 0.0;
    if (low == 0) return values[0];
    if (!linear || low == input->count) return values[low - 1];
    *slope = (values[low] - values[low - 1]) / (times[low] - times[low - 1]);
    return values[low - 1] + *slope * (t - times[low - 1]);
}

/* When a dose arrives: within rounding of the start or of an output it arrives there, after the output. */
static double arrival(double time, double start, int count, const double *times) {
    const double end = times[count - 1];
    const double size = fabs(end) > end - start ? fabs(end) : end - start;
    double best = start;
    int low = 0, high = count, i;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (times[middle] <= time) low = middle + 1;
        else high = middle;
    }
    for (i = low > 0 ? low - 1 : 0; i < count && i <= low; i++)
        if (fabs(times[i] - time) < fabs(best - time)) best = times[i];
    return fabs(best - time) <= 1e-9 * size ? best : time;
}

/* A trajectory that is simulated: its outputs, and what changes on the way. */
typedef struct {
    const PREFIX_parameters *p;
    const PREFIX_course *inputs, *doses;
    const double *times;
    double start, max_step, fraction[PREFIX_DOSES + 1], lag[PREFIX_DOSES + 1];
    int count;
#if EVENTS
    PREFIX_events events;
#endif
#if DELAYS
    PREFIX_past *past;
#endif
} trajectory;

/* When dose k of a kind arrives. */
static double dose_time(const trajectory *r, int kind, int k) {
    return arrival(r->doses[kind].times[k] + r->lag[kind], r->start, r->count, r->times);
}

#if EVENTS
/* When an event at given times happens: like a dose it follows an output. */
static double event_time(const trajectory *r, int event) {
    const double at = PREFIX_due(r->p, &r->events, event);
    return at < HUGE_VAL ? arrival(at, r->start, r->count, r->times) : at;
}

#endif
/* The end of the piece that begins at t: where an input changes, a dose arrives, an event has its time; the last output. */
static double next_cut(const trajectory *r, double t) {
    double next = r->times[r->count - 1];
    int j, k;
    for (j = 0; j < PREFIX_INPUTS; j++)
        for (k = 0; k < r->inputs[j].count; k++)
            if (r->inputs[j].times[k] > t && r->inputs[j].times[k] < next) next = r->inputs[j].times[k];
    for (j = 0; r->doses && j < PREFIX_DOSES; j++)
        for (k = 0; k < r->doses[j].count; k++)
            if (dose_time(r, j, k) > t && dose_time(r, j, k) < next) next = dose_time(r, j, k);
#if EVENTS
    for (j = 0; j < PREFIX_TIMED; j++)
        if (event_time(r, j) > t && event_time(r, j) < next) next = event_time(r, j);
#endif
#if DELAYS
    if (PREFIX_mark(r->past) < HUGE_VAL) {
        const double at = arrival(PREFIX_mark(r->past), r->start, r->count, r->times);
        if (at > t && at < next) next = at;
    }
#endif
    return next;
}
#if DELAYS

/* Whether an input changes or a dose arrives at a time. */
static int jumps(const trajectory *r, double t) {
    int j, k;
    for (j = 0; j < PREFIX_INPUTS; j++)
        for (k = 0; k < r->inputs[j].count; k++)
            if (r->inputs[j].times[k] == t) return 1;
    for (j = 0; r->doses && j < PREFIX_DOSES; j++)
        for (k = 0; k < r->doses[j].count; k++)
            if (dose_time(r, j, k) == t) return 1;
    return 0;
}
#endif

/* What happens at the beginning t of a piece: doses, and then events. Returns 0, or 3 if these have no end. */
static int happening(trajectory *r, double t, const double *u, double *x) {
    int j, k;
    for (j = 0; r->doses && j < PREFIX_DOSES; j++)
        for (k = 0; k < r->doses[j].count; k++)
            if (dose_time(r, j, k) == t) x[DOSE_STATE[j]] += r->doses[j].values[k] * r->fraction[j];
#if EVENTS
    for (j = 0; j < PREFIX_TIMED; j++)
        if (event_time(r, j) == t) r->events.pending[j] = 1;
    return PREFIX_carry_out(r->p, t, u, x, &r->events) < 0 ? 3 : 0;
#else
    (void)u;
#if DELAYS
    PREFIX_reach(r->p, t + 1e-9 * (fabs(r->times[r->count - 1]) + r->times[r->count - 1] - r->start), r->past);
    if (jumps(r, t)) PREFIX_jump(r->p, t, r->past);
#endif
    return 0;
#endif
}

/* Equal steps from `from` to `to` within a piece that begins at `begin`. Returns 0, or 3 if events have no end,
   4 if the past has no room. */
static int advance(trajectory *r, const double *value, const double *slope, double begin, double from, double to, double *x) {
#if DELAYS
    const double least = PREFIX_shortest(r->p), longest = r->max_step < least ? r->max_step : least;
#else
    const double longest = r->max_step;
#endif
    const double wanted = ceil((to - from) / longest - 1e-9);
    const long steps = wanted > 1.0 ? (long)wanted : 1;
    const double h = (to - from) / (double)steps;
    long i;
    for (i = 0; i < steps; i++) {
#if EVENTS
        if (PREFIX_cut(r->p, begin, value, slope, from + (double)i * h, h, x, &r->events)) return 3;
#else
#if DELAYS
        if (PREFIX_move(r->p, begin, value, slope, from + (double)i * h, h, x, r->past)) return 4;
#else
        PREFIX_move(r->p, begin, value, slope, from + (double)i * h, h, x);
#endif
#endif
    }
    return 0;
}

/* 1: a call with wrong arguments. */
static int wrong(const trajectory *r) {
    int i;
    if (r->count < 1 || !(r->max_step > 0.0) || !(r->times[0] >= r->start)) return 1;
    for (i = 1; i < r->count; i++)
        if (!(r->times[i] > r->times[i - 1])) return 1;
    for (i = 0; i < PREFIX_INPUTS; i++)
        if (r->inputs[i].count < 1) return 1;
    return 0;
}

int PREFIX_simulate(const PREFIX_parameters *p, double start, const double *x0, const PREFIX_course *inputs,
                    const PREFIX_course *doses, int count, const double *times, double max_step, double *states,
                    double *channelsPAST) {
    double x[PREFIX_STATES], value[PREFIX_INPUTS + 1], slope[PREFIX_INPUTS + 1], begin = start, t = start, cut = start, to;
    trajectory r;
    int next = 0, opens = 1, status, i; /* whether a piece begins */
    r.p = p, r.inputs = inputs, r.doses = doses, r.times = times;
    r.start = start, r.max_step = max_step, r.count = count;
    if (wrong(&r)) return 1;
#if DELAYS
    if (!(PREFIX_shortest(p) > 0.0)) return 1;
    r.past = past;
#endif
    for (i = 0; i < PREFIX_STATES; i++) x[i] = x0[i];
    PREFIX_initial(p, x);
    PREFIX_doses(p, r.fraction, r.lag);
    for (;;) {
        if (opens) /* inputs are those after their changes */
            for (i = 0; i < PREFIX_INPUTS; i++) value[i] = course(&inputs[i], LINEAR[i], t, &slope[i]);
#if EVENTS
        if (t == start) PREFIX_arm(p, t, x, value, &r.events);
#endif
#if DELAYS
        if (t == start) PREFIX_begin(p, t, x, value, past);
#endif
        if (times[next] == t) {
            double u[WIDTH + 1], ignored;
            for (i = 0; i < PREFIX_INPUTS; i++) u[i] = course(&inputs[i], LINEAR[i], t, &ignored);
#if DELAYS
            PREFIX_late(p, past, t, begin < t ? begin : start - 1.0, u + PREFIX_INPUTS);
#endif
            for (i = 0; states && i < PREFIX_STATES; i++) states[next * PREFIX_STATES + i] = x[i];
            if (channels) PREFIX_observe(p, t, x, u, channels + next * PREFIX_CHANNELS);
            if (++next == count) break;
        }
        if (opens) {
            status = happening(&r, t, value, x);
            if (status) return status;
            begin = t;
            cut = next_cut(&r, t);
        }
        to = times[next] < cut ? times[next] : cut;
        status = advance(&r, value, slope, begin, t, to, x);
        if (status) return status;
        t = to;
        opens = t == cut;
    }
    for (i = 0; i < PREFIX_STATES; i++)
        if (!isfinite(x[i])) return 2;
    return 0;
}
