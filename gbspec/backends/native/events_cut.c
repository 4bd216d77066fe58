/* Sub-steps that are cut where events happen, and what events do. */

/* The pending event that comes first: timed ones, then by priority, then as written; -1: none. */
static int next_event(Work *w, const Crossing *c, double at, const real *x) {
    int first = -1;
#if RANKED
    real u[INPUTS + 1], now[1] = {R(at)}, ranks[EVENTS];
    double best = -INFINITY;
    int timed = 0;
    inputs_within(c, at, u);
    ranks_forward(w, 0, x, now, u, ranks);
    for (int k = 0; k < TIMED_EVENTS; k++) timed |= c->pending[k];
    for (int k = 0; k < EVENTS; k++) {
        const double rank = isnan(ranks[k]) ? -1.7e308 : ranks[k];
        if (c->pending[k] && (!timed || k < TIMED_EVENTS) && rank > best) best = rank, first = k;
    }
#else
    (void)w, (void)at, (void)x;
    for (int k = EVENTS - 1; k >= 0; k--)
        if (c->pending[k]) first = k;
#endif
    return first;
}

/* Which conditions are true, and which events are pending, after an event has changed the state from x to after. */
static void follow_event(Work *w, Crossing *c, double at, int k, const real *x, const real *after) {
    real earlier[GUARDS + 1], guard[GUARDS + 1], rates[GUARDS + 1];
    guards_at(w, c, at, x, earlier);
    turn_side(w, c, k);
    rated(w, c, at, after, guard, rates);
    c->pending[k] = 0;
    if (k < TIMED_EVENTS) c->turn[k] += 1;
    for (int j = 0; j < FIRST_SWITCH - TIMED_EVENTS; j++) {
        const int fired = k == TIMED_EVENTS + j;
        const double zone = 2 * c->band * fabs(rates[j]);
        const int caused = !c->on[j] && !fired && guard[j] >= 0 && (earlier[j] < 0 || guard[j] > zone);
        /* A guard that the event did not change is zero up to rounding: only its rate says which sign follows. */
        const int still = guard[j] == earlier[j] ? rates[j] > 0 || guard[j] > zone : guard[j] >= 0;
        c->on[j] = (c->on[j] || fired) && still;
        c->pending[TIMED_EVENTS + j] |= caused;
    }
    follow_sides(w, c, k, earlier, guard, rates);
}

/* The state after the pending events, and after those that they cause. */
static void happen(Work *w, Crossing *c, Piece *p, double at, real *x) {
    real u[INPUTS + 1], after[STATES], now[1] = {R(at)};
    inputs_within(c, at, u);
    for (int n = 0; n <= CASCADE; n++) {
        const int k = next_event(w, c, at, x);
        if (k < 0) return;
        if (n == CASCADE) break;
        happen_forward(w, k, x, now, u, after);
        c->fired[c->fired_count++] = (int16_t)k;
        p->count++;
        c->known = 0;
        follow_event(w, c, at, k, x, after);
        memcpy(x, after, sizeof after);
    }
    c->endless = 1;
    for (int i = 0; i < STATES; i++) x[i] = NAN;
}

static Piece *new_piece(Crossing *c, double at) {
    Piece *p = &c->pieces[c->count++];
    p->at = at;
    p->which = -1;
    p->first = c->fired_count;
    p->count = 0;
    return p;
}

/* Which conditions are true at the start of a sub-step, and which events what arrived makes happen. */
static void start_crossing(Work *w, Crossing *c, const real *before, const real *x) {
    real earlier[GUARDS + 1], u[INPUTS + 1], now[1] = {R(c->begin)};
    const int starting = fabs(c->begin - c->origin) <= c->band;
    for (int j = 0; j < INPUTS; j++) u[j] = R(c->before[j]);
    guards_forward(w, 0, before, now, u, earlier);
    rated(w, c, c->begin, x, c->guard, c->rate);
    c->known = 1;
    timing_forward(w, &c->timing[0][0]);
    for (int k = 0; k < TIMED_EVENTS; k++) c->pending[k] = 0, c->turn[k] = passed_times(c, k);
    for (int j = 0; j < GUARDS; j++) {
        const double guard = c->guard[j], zone = 2 * c->band * fabs(c->rate[j]);
        const int on = starting ? guard >= 0 : guard > zone || (guard >= 0 && c->rate[j] <= 0);
        int arrived = earlier[j] < 0 && guard >= 0 && (earlier[j] < -zone || guard > zone);
        arrived = arrived || (starting && ARMED[j] && guard >= 0);
        c->on[j] = on && !arrived;
        c->pending[TIMED_EVENTS + j] = arrived;
    }
    place_sides(w, c);
}

static int first_of(const double *wait) {
    int which = 0;
    for (int k = 1; k < EVENTS; k++)
        if (wait[k] < wait[which]) which = k;
    return which;
}

/* Shorter intervals than this are near an end of ever shorter ones. Rates of conditions are differences over a tick, and
   say nothing there. */
static double near_in(const Crossing *c) { return 10 * c->tick > NEAR * c->band ? 10 * c->tick : NEAR * c->band; }

/* The first part of an opened sub-step, from the states before and after what arrives at its start: x becomes the state
   after the events there. */
static Piece *begin_parts(Work *w, Crossing *c, const real *before, real *x) {
    open_sides(w, c);
    memcpy(c->entry, x, sizeof c->entry);
    start_crossing(w, c, before, x);
    Piece *p = new_piece(c, c->begin);
    happen(w, c, p, c->begin, x);
    return p;
}

/* The solution over an opened sub-step; `crossing` then has all its parts. */
static void cross_opened(Work *w, Crossing *c, const real *before, real *x) {
    real end[STATES];
    double wait[EVENTS], at = c->begin, left = c->length, last = INFINITY;
    int shorts = 0, falling = 0;
    Piece *p = begin_parts(w, c, before, x);
    for (int n = 0; n < CLOSE; n++) {
        const int ended = waits(w, c, at, left, x, wait, end), which = first_of(wait);
        const int found = isfinite(wait[which]);
        memcpy(p->x, x, sizeof p->x);
#if SWITCHES
        Held held;
        memcpy(p->side, w->side, sizeof p->side);
        hold_part(c, left, &held);
#endif
        shorts = found && wait[which] <= c->band ? shorts + 1 : 0;
        falling = found && wait[which] < 0.99 * last ? falling + 1 : 0;
        if (shorts > SHORT || (falling > FALLING && wait[which] <= near_in(c))) break;
        last = wait[which];
        p->size = found ? wait[which] : left;
        if (found || !ended) step_within(w, c, at, p->size, x, end);
        memcpy(p->reached, end, sizeof end);
        memcpy(x, end, sizeof end);
        if (!found) return;
        p->which = which;
        p->turn = which < TIMED_EVENTS ? c->turn[which] : 0;
        at += p->size, left -= p->size;
        for (int k = 0; k < EVENTS; k++) c->pending[k] = wait[k] <= wait[which] + 0.01 * c->band;
        p = new_piece(c, at);
        happen(w, c, p, at, x);
#if SWITCHES
        if (c->slid) p = go_back(w, c, &held, x), at = p->at, left = held.left;
#endif
    }
    p->size = left;
    c->endless = 1;
    for (int i = 0; i < STATES; i++) x[i] = p->x[i] = p->reached[i] = NAN;
}

/* The solution over sub-step s from the state x before what arrives at its start. */
static void cross(Work *w, int64_t s, real *x) {
    real before[STATES];
    open_crossing(w, s, w->crossing);
    memcpy(before, x, sizeof before);
    for (int32_t j = arrival_of(w, s, 0); j >= 0; j = w->data->arrival_next[j])
        x[w->data->arrival_state[j]] += R(w->inputs->amounts[j]);
    cross_opened(w, w->crossing, before, x);
}
