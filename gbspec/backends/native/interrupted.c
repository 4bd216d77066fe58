/* Adaptive steps in models with events, which end just after the first event in them. `gbspec/training/engines/torch/
   interrupted.py` does the same with torch, and says why. */

#define AFTER 1e-9 /* a step ends after the event by this share of the length that was tried */
#define TICKS 1e-5 /* shorter intervals between events than this share of the step are near an end */

/* Opens a sub-step of some length from the place reached, and gives the state before what arrived there. */
static Crossing *open_ahead(Control *c, double length, real *before) {
    Work *w = c->w;
    const Data *d = w->data;
    const size_t at = cell_at(c, 0);
    Crossing *q = w->crossing;
    const double *given = d->inputs + at * NODES * INPUTS, whole = d->h[at] > 0 ? d->h[at] : 1e-300;
    const int enters = c->begun[0] == 0;
    q->begin = d->t[at] + c->begun[0];
    q->length = length;
    q->unit = length != 0 ? length : 1;
    q->origin = d->t[w->who[0] * d->depth];
    q->band = *d->band;
    q->tick = tick_of(q);
    for (int j = 0; j < INPUTS; j++) {
        const double first = given[j], change = given[(NODES - 1) * INPUTS + j] - first;
        q->first[j] = first + c->begun[0] / whole * change;
        q->last[j] = first + (c->begun[0] + length) / whole * change;
        q->before[j] = enters && c->cell[0] ? given[j - INPUTS] : q->first[j];
    }
    q->count = q->fired_count = q->endless = 0;
    memcpy(before, enters ? c->prior : c->x, sizeof c->prior);
    return q;
}

#if MATRICES
/* The Jacobian at the start of a step, on the sides of switches that hold there. */
static void find_jacobian(Control *c, const Crossing *q, const real *x) {
    real u[INPUTS + 1], now[1] = {R(q->begin)}, out[STATES], ob[STATES], xb[STATES], tb[1], ub[INPUTS + 1];
    double kb[LEARNABLES + 1];
    inputs_within(q, q->begin, u);
    for (int g = 0; g < GROUPS; g++) {
        zero(xb, STATES);
        for (int i = 0; i < STATES; i++) ob[i] = GROUP[i] == g;
        rhs_forward(c->w, 0, x, now, u, out);
        rhs_reverse(c->w, 0, x, now, u, ob, xb, kb, tb, ub);
        for (int j = 0; j < STATES; j++) xb[j] = isfinite(xb[j]) ? xb[j] : 0;
        take_rows(g, xb, 1, c->slopes[0]);
    }
    freeze(c->w, c->slopes[0]);
}
#endif

/* The Runge-Kutta stages of a step up to the first event, for its error estimate. */
static void try_part(Control *c, const Crossing *q, const real *x, double size) {
    real sum[STATES], place[STATES], u[INPUTS + 1], now[1];
    real (*k)[STATES] = (real(*)[STATES])c->k;
#if MATRICES
    factorise_part(c->w, size);
#endif
    for (int s = 0; s < TRIED; s++) {
        const double time = q->begin + TABLEAU_C[s] * size;
        zero(sum, STATES);
        add_weighted(s, TABLEAU_A[s], k, sum);
        for (int i = 0; i < STATES; i++) place[i] = x[i] + R(size) * sum[i];
        now[0] = R(time);
        inputs_within(q, time, u);
        rhs_forward(c->w, 0, place, now, u, k[s]);
#if MATRICES
        divide_stage(c->w, s, k, sum);
#endif
    }
    memcpy(c->from, x, sizeof c->from);
    c->tried[0] = size;
}

static void attempt(Control *c) {
    Work *w = c->w;
    real before[STATES], x[STATES], end[STATES];
    double wait[EVENTS], ratio = 0;
    const double left = whole(c, 0) - c->begun[0], h = c->h[0];
    Crossing *q = open_ahead(c, h, before);
    memcpy(x, c->x, sizeof x);
    begin_parts(w, q, before, x);
#if MATRICES
    find_jacobian(c, q, x);
#endif
    waits(w, q, q->begin, h, x, wait, end);
    const double first = wait[first_of(wait)], event = first < h ? first : h, gap = q->begin + event - c->event;
    const int found = isfinite(first);
    const double near = NEAR * q->band > TICKS * h ? NEAR * q->band : TICKS * h;
    const int endless = found && c->falling > FALLING && gap < 0.99 * c->last_gap && gap <= near;
    const double after = 4 * q->band > AFTER * h ? 4 * q->band : AFTER * h;
    const double ahead = found ? event + after : h;
    try_part(c, q, x, event);
    c->h[0] = endless || (found && left - ahead < after) ? left : ahead;
    memcpy(c->after, c->x, sizeof c->after);
    cross_opened(w, open_ahead(c, c->h[0], before), before, c->after);
    if (!endless) ratio = error_of(c, 0);
    if (found && ratio <= 1) {
        c->falling = gap < 0.99 * c->last_gap ? c->falling + 1 : 0;
        c->event = q->begin + event;
        c->last_gap = gap;
    }
    decide(c, 0, ratio);
}
