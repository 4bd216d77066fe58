/* Switches of right-hand sides within sub-steps; `gbspec/backends/module/template/switches.py` does the same for the torch
   graph, and says what is done where. */

#if SWITCHES
#define HELD 1e30 /* a number beyond every quantity that decides at a switch */
#define MOST_SWITCHES 6

/* Nothing is held, and nothing suspended, at the start of a sub-step. */
static void open_sides(Work *w, Crossing *c) {
    for (int j = 0; j < SWITCHES; j++) w->side[j] = 0, c->suspended[j] = c->released[j] = 0;
    c->turns = c->uncut = c->slid = 0;
}

/* Where a switch is, from its guards: which of its two events are not to come, and the side. */
static void place(Work *w, Crossing *c, int i, const real *guard, const real *rates) {
    const int up = FIRST_SWITCH - TIMED_EVENTS + 2 * i;
    for (int j = up; j < up + 2; j++) c->on[j] = guard[j] > 2 * c->band * fabs(rates[j]) || (guard[j] >= 0 && rates[j] <= 0);
    /* Where neither is true the switch lies here, and the side before it counts. */
    if (!c->released[i]) w->side[i] = R(c->on[up] || (!c->on[up + 1] && guard[up] < 0) ? HELD : -HELD);
}

/* The sides at the start of a sub-step. */
static void place_sides(Work *w, Crossing *c) {
    for (int i = 0; i < SWITCHES; i++) {
        const int up = FIRST_SWITCH - TIMED_EVENTS + 2 * i;
        place(w, c, i, c->guard, c->rate);
        c->pending[TIMED_EVENTS + up] = c->pending[TIMED_EVENTS + up + 1] = 0;
        if (fabs(c->guard[up]) <= 2 * c->band * fabs(c->rate[up])) c->known = 0; /* its rate depends on the side */
    }
}

/* What is true at the start of a part, should it be gone back to. */
typedef struct {
    int on[GUARDS + 1];
    double turn[TIMED_EVENTS + 1], left;
} Held;

static void hold_part(const Crossing *c, double left, Held *held) {
    memcpy(held->on, c->on, sizeof held->on);
    memcpy(held->turn, c->turn, sizeof held->turn);
    held->left = left;
}

/* Goes back to the start of the last part, with nothing held at the switch along which its end slides. */
static Piece *go_back(Work *w, Crossing *c, const Held *held, real *x) {
    Piece *p = &c->pieces[--c->count];
    c->fired_count = p->first;
    p = &c->pieces[c->count - 1];
    p->which = -1;
    memcpy(x, p->x, sizeof p->x);
    memcpy(c->on, held->on, sizeof held->on);
    memcpy(c->turn, held->turn, sizeof held->turn);
    for (int i = 0; i < SWITCHES; i++) w->side[i] = c->released[i] ? 0 : p->side[i];
    c->known = c->slid = 0;
    return p;
}

/* Holds nothing any more. */
static void release(Work *w, Crossing *c) {
    for (int i = 0; i < SWITCHES; i++) w->side[i] = 0, c->released[i] = 1;
}

static void suspend(Work *w, Crossing *c, int i) {
    c->suspended[i] = c->released[i] = c->uncut = 1;
    w->side[i] = 0;
}

/* The switches after event k, from guards before and after it. */
static void follow_sides(Work *w, Crossing *c, int k, const real *earlier, const real *guard, const real *rates) {
    for (int i = 0; i < SWITCHES; i++) {
        const int event = FIRST_SWITCH + 2 * i, up = event - TIMED_EVENTS;
        if (k == event || k == event + 1) {
            for (int j = up; j < up + 2; j++) {
                const int goes_on = rates[j] > 0 || guard[j] > 2 * c->band * fabs(rates[j]);
                c->on[j] = (c->on[j] || j == k - TIMED_EVENTS) && goes_on;
            }
            /* A quantity that does not go on to the side that it has reached slides. */
            if (!c->on[k - TIMED_EVENTS]) suspend(w, c, i), c->slid = 1;
            if (c->suspended[i]) c->pending[event] = c->pending[event + 1] = 0;
        } else if (guard[up] != earlier[up]) {
            /* An event that changes the state may put it on another side, without a switch on the way. */
            place(w, c, i, guard, rates);
            c->pending[event] = c->pending[event + 1] = 0;
        }
    }
}

static void turn_side(Work *w, Crossing *c, int event) {
    const int i = (event - FIRST_SWITCH) / 2;
    if (event >= FIRST_SWITCH && !c->released[i]) w->side[i] = R((event - FIRST_SWITCH) % 2 ? -HELD : HELD);
}

/* Whether the rest of a sub-step, taken on some sides of the switches, ends on the other side of one. */
static int misses(Work *w, const Crossing *c, double time, const real *end) {
    real guard[GUARDS + 1], rates[GUARDS + 1];
    rated(w, c, time, end, guard, rates);
    for (int i = 0; i < SWITCHES; i++) {
        const int up = FIRST_SWITCH - TIMED_EVENTS + 2 * i;
        if (guard[up] * w->side[i] < 0 && fabs(guard[up]) > 4 * c->band * fabs(rates[up])) return 1;
    }
    return 0;
}

static int lost(const Work *w, const real *end) {
    int finite = 1, held = 0;
    for (int i = 0; i < STATES; i++) finite &= isfinite(end[i]) != 0;
    for (int i = 0; i < SWITCHES; i++) held |= w->side[i] != 0;
    return held && !finite;
}

static int first_of(const double *wait);

static void waits_allowed(Work *w, Crossing *c, double at, double left, const real *x, double *wait, real *end) {
    waits_held(w, c, at, left, x, wait, end);
    for (int k = FIRST_SWITCH; k < EVENTS; k++)
        if (c->suspended[(k - FIRST_SWITCH) / 2]) wait[k] = INFINITY;
}

static int waits(Work *w, Crossing *c, double at, double left, const real *x, double *wait, real *end) {
    waits_allowed(w, c, at, left, x, wait, end);
    if (lost(w, end)) {
        release(w, c);
        waits_allowed(w, c, at, left, x, wait, end);
    }
    int first = first_of(wait);
    if (isfinite(wait[first]) && first >= FIRST_SWITCH && c->turns++ >= MOST_SWITCHES) {
        for (int i = 0; i < SWITCHES; i++) suspend(w, c, i);
        waits_allowed(w, c, at, left, x, wait, end);
        first = first_of(wait);
    }
    if (!isfinite(wait[first]) && left > 0 && misses(w, c, at + left, end)) {
        release(w, c);
        c->uncut = 1;
        step_within(w, c, at, left, x, end);
    }
    return 1;
}
#else
#define waits waits_held
static void open_sides(Work *w, Crossing *c) { (void)w, (void)c; }
static void place_sides(Work *w, Crossing *c) { (void)w, (void)c; }
static void turn_side(Work *w, Crossing *c, int event) { (void)w, (void)c, (void)event; }
static void follow_sides(Work *w, Crossing *c, int k, const real *earlier, const real *guard, const real *rates) {
    (void)w, (void)c, (void)k, (void)earlier, (void)guard, (void)rates;
}
#endif
