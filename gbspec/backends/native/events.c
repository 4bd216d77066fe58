/* When events happen in sub-steps, which they cut. `gbspec/backends/module/template/events.py` does
   the same for the torch graph: the same search, so that both have the same times; a test compares the two. */

#if TILE != 1
#error "events need one trajectory at a time"
#endif
#define EPSILON 2.220446049250313e-16

/* ---------------------------------------------------------------- the sub-step and steps within it */

/* The Jacobian that is frozen in the sub-step; each part has a matrix for its own length. */
static void freeze(Work *w, const double *jacobian) {
#if MATRICES
    w->jacobian = jacobian;
    w->factored = NAN;
#else
    (void)w, (void)jacobian;
#endif
}

static double tick_of(const Crossing *c) { return 1e-6 * c->unit > TICK * c->band ? 1e-6 * c->unit : TICK * c->band; }

static void open_crossing(Work *w, int64_t s, Crossing *c) {
    const Data *d = w->data;
    const int64_t place = w->first[0] + s, at = w->who[0] * d->depth + place;
    c->begin = d->t[at];
    c->length = d->h[at];
    c->unit = c->length != 0 ? c->length : 1;
    c->origin = d->t[w->who[0] * d->depth];
    c->band = *d->band;
    c->tick = tick_of(c);
    for (int j = 0; j < INPUTS; j++) {
        c->first[j] = d->inputs[at * NODES * INPUTS + j];
        c->last[j] = d->inputs[(at * NODES + NODES - 1) * INPUTS + j];
        c->before[j] = place ? d->inputs[((at - 1) * NODES + NODES - 1) * INPUTS + j] : c->first[j];
    }
    c->count = c->fired_count = c->endless = 0;
    freeze(w, d->lu ? d->lu + at * STATES * STATES : NULL);
}

static void inputs_within(const Crossing *c, double time, real *u) {
    for (int j = 0; j < INPUTS; j++) u[j] = R(c->first[j] + (time - c->begin) / c->unit * (c->last[j] - c->first[j]));
}

#if MATRICES
static void factorise_part(Work *w, double size) {
    if (w->factored == size) return;
    factorise_step(w->jacobian, size, w->part, w->exchanges);
    w->factored = size;
}

/* sum = v of a Runge-Kutta stage, k = (f + v) / matrix - v. */
static void divide_stage(const Work *w, int q, real k[][STATES], real *sum) {
    zero(sum, STATES);
    add_weighted(q, TABLEAU_V[q], k, sum);
    for (int i = 0; i < STATES; i++) k[q][i] += sum[i];
    divide(w->part, w->exchanges, 0, k[q]);
    for (int i = 0; i < STATES; i++) k[q][i] -= sum[i];
}
#endif

/* A step of the method from some time within; its Runge-Kutta stages stay in the first places of the work space. */
static void step_within(Work *w, const Crossing *c, double at, double size, const real *x, real *end) {
    real sum[STATES], u[INPUTS + 1], time[1];
    real (*k)[STATES] = (real(*)[STATES])w->rates;
#if MATRICES
    factorise_part(w, size);
#endif
    for (int q = 0; q < STAGES; q++) {
        real *place = w->states + (size_t)q * STATES;
        zero(sum, STATES);
        add_weighted(q, TABLEAU_A[q], k, sum);
        for (int i = 0; i < STATES; i++) place[i] = x[i] + R(size) * sum[i];
        time[0] = R(at + TABLEAU_C[q] * size);
        inputs_within(c, at + TABLEAU_C[q] * size, u);
        rhs_forward(w, (size_t)q, place, time, u, k[q]);
#if MATRICES
        divide_stage(w, q, k, sum);
#endif
    }
    zero(sum, STATES);
    add_weighted(STAGES, TABLEAU_B, k, sum);
    for (int i = 0; i < STATES; i++) end[i] = x[i] + R(size) * sum[i];
}

/* ---------------------------------------------------------------- conditions */

static void guards_at(Work *w, const Crossing *c, double time, const real *x, real *guard) {
    real u[INPUTS + 1], now[1] = {R(time)};
    inputs_within(c, time, u);
    guards_forward(w, 0, x, now, u, guard);
}

/* The guards at a state, and their rates of change, by a difference, since no result contains them. */
static void rated(Work *w, const Crossing *c, double time, const real *x, real *guard, real *rates) {
    real u[INPUTS + 1], speed[STATES], ahead[STATES], now[1] = {R(time)};
    inputs_within(c, time, u);
    rhs_forward(w, 0, x, now, u, speed);
    guards_forward(w, 0, x, now, u, guard);
    for (int i = 0; i < STATES; i++) ahead[i] = x[i] + R(c->tick) * speed[i];
    guards_at(w, c, time + c->tick, ahead, rates);
    for (int j = 0; j < GUARDS; j++) rates[j] = (rates[j] - guard[j]) / R(c->tick);
}

/* ---------------------------------------------------------------- times */

/* The next time of a timed event; infinite after its last one. */
static double time_of(const Crossing *c, int k) {
    const double number = c->turn[k], first = TIMING_HAS[k][0] ? c->timing[k][0] : c->origin;
    const double every = c->timing[k][1], time = TIMING_HAS[k][1] ? first + number * every : first;
    int gone = TIMING_HAS[k][1] ? every <= 0 && number > 0 : number > 0;
    if (TIMING_HAS[k][2]) gone = gone || time > c->timing[k][2] + c->band;
    return gone ? INFINITY : time;
}

/* How many times of a timed event lie before the sub-step. */
static double passed_times(const Crossing *c, int k) {
    const double passed = c->begin - 2 * c->band - (TIMING_HAS[k][0] ? c->timing[k][0] : c->origin);
    if (!TIMING_HAS[k][1]) return passed > 0;
    const double number = ceil(passed / c->timing[k][1]);
    return number < 0 ? 0 : number;
}

typedef struct {
    double g0, r0, g1, r1;
} Ends;

/* The value and the rate of guard j after a step of some size. */
static void follow(Work *w, const Crossing *c, double at, const real *x, double size, int j, double *value, double *slope) {
    real end[STATES], guard[GUARDS + 1], rates[GUARDS + 1];
    step_within(w, c, at, size, x, end);
    rated(w, c, at + size, end, guard, rates);
    *value = guard[j];
    *slope = rates[j];
}

/* A time in (0, left) at which the guard, as a cubic polynomial, has its extremum, and its value there; repeated on the
   part with the extremum while the sign is not the wanted one. */
static double extreme(Work *w, const Crossing *c, double at, const real *x, double left, int j, const Ends *e, double sign,
                      double *value) {
    double ga = e->g0, ra = e->r0, gb = e->g1, rb = e->r1, a = 0, b = left, place = left, slope;
    for (int n = 0; n < 4; n++) {
        const double length = b > a ? b - a : 1, chord = (gb - ga) / length;
        const double square = 3 * (ra + rb - 2 * chord), linear = 2 * (3 * chord - 2 * ra - rb);
        const double inner = linear * linear - 4 * square * ra, root = sqrt(inner > 0 ? inner : 0);
        const double half = -0.5 * (linear + (linear < 0 ? -root : root)), one = half / square, other = ra / half;
        double share = one > 0 && one < 1 ? one : other;
        if (!(share > 0 && share < 1)) share = 0.5;
        place = a + share * (b - a);
        follow(w, c, at, x, place, j, value, &slope);
        if (sign * *value > 0) break;
        if (sign * slope > 0) a = place, ga = *value, ra = slope;
        else b = place, gb = *value, rb = slope;
    }
    return place;
}

/* The time at which guard j is zero, between one at which it is negative and one at which it is not. */
static double root_within(Work *w, const Crossing *c, double at, const real *x, double left, int j, double low, double high) {
    const double exact = 4 * EPSILON * (fabs(at) + left);
    double size = 0.5 * (low + high), value, slope;
    for (int n = 0; n < 100; n++) {
        follow(w, c, at, x, size, j, &value, &slope);
        if (value < 0) low = size;
        else high = size;
        double new = size - value / slope;
        const int close = fabs(new - size) <= exact;
        if (!((isfinite(new) && new >= low && new <= high) || close)) new = 0.5 * (low + high);
        size = new;
        if (close || high - low <= exact) break;
    }
    return size < 0 ? 0 : size;
}

/* The first time at which guard j becomes positive; infinite where it does not. `e`: value and rate at both ends. */
static double first_time(Work *w, const Crossing *c, double at, const real *x, double left, int j, const Ends *e) {
    const int on = c->on[j], peaks = e->r0 > 0 && e->r1 < 0, dips = e->r0 < 0 && e->r1 > 0;
    if (!((e->g1 >= 0 && (!on || dips)) || (!on && (peaks || e->g0 >= 0)))) return INFINITY;
    const int due = !on && e->g0 >= 0 && e->g0 <= 2 * c->band * fabs(e->r0) && e->r0 > 0;
    const int below = !on && e->g0 < 0;
    double low = 0, high = left, value = 0;
    int crosses = below && e->g1 >= 0;
    if (below && e->g1 < 0 && peaks) {
        high = extreme(w, c, at, x, left, j, e, 1, &value);
        crosses = value > 0;
    } else if (!below && !due && e->g1 >= 0 && dips) {
        low = extreme(w, c, at, x, left, j, e, -1, &value);
        crosses = value < 0;
    }
    return crosses ? root_within(w, c, at, x, left, j, low, high) : due ? 0 : INFINITY;
}

/* The time until each event happens in the rest of a sub-step, infinite where it does not, and the state at its end;
   returns whether that was computed. */
static int waits_held(Work *w, Crossing *c, double at, double left, const real *x, double *wait, real *end) {
    const double limit = left - 2 * c->band;
    real guard[GUARDS + 1], rates[GUARDS + 1];
    for (int k = 0; k < TIMED_EVENTS; k++) {
        const double found = time_of(c, k) - at;
        wait[k] = found < limit && left > 0 ? (found > 0 ? found : 0) : INFINITY;
    }
    if (!GUARDS) return 0;
    if (!c->known) rated(w, c, at, x, c->guard, c->rate);
    c->known = 0;
    step_within(w, c, at, left, x, end);
    rated(w, c, at + left, end, guard, rates);
    for (int j = 0; j < GUARDS; j++) {
        const Ends e = {c->guard[j], c->rate[j], guard[j], rates[j]};
        const double found = first_time(w, c, at, x, left, j, &e);
        wait[TIMED_EVENTS + j] = found < limit && left > 0 ? found : INFINITY;
    }
    return 1;
}
