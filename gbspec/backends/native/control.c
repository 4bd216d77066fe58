/* Adaptive steps of a tile of trajectories on their own solutions, each lane with its own steps; and the matrices of
   steps, factored. `gbspec/training/engines/torch/control.py` does the same with torch; a test compares the two. */

#define PARTS 5 /* with events adaptive steps take at most this part of a cell: their error says nothing of conditions */

typedef struct {
    const Walk *walk;
    Work *w;
    real x[STATES * TILE], k[TRIED][STATES * TILE], after[STATES * TILE];
    real time[TILE], inputs[INPUTS * TILE + 1];
    double slopes[TILE][STATES * STATES + 1], lu[TILE][STATES * STATES + 1];
    int32_t pivots[TILE][STATES + 1];
    double begun[TILE], next[TILE], h[TILE], before[TILE];
    real from[STATES * TILE]; /* where the tried steps begin, and their lengths: with events up to the first of these */
    double tried[TILE];
#if EVENTS
    real prior[STATES];       /* before what arrived at the start of the cell */
    double event, last_gap;   /* the time of the last event, and its distance from the one before */
    int falling;              /* so many ever shorter ones */
#endif
    int64_t cell[TILE], attempts[TILE];
    int going[TILE], entering[TILE], known[TILE];
} Control;

static size_t cell_at(const Control *c, int t) { return (size_t)(c->w->who[t] * c->w->data->depth + c->cell[t]); }
static double whole(const Control *c, int t) { return c->w->data->h[cell_at(c, t)]; }

#if MATRICES
/* The rows of a group of the Jacobian from the derivatives of their sum, every `stride`-th number of `sums`. */
static void take_rows(int group, const real *sums, int stride, double *jacobian) {
    for (int i = 0; i < STATES; i++)
        for (int j = 0; j < STATES && GROUP[i] == group; j++)
            jacobian[i * STATES + j] = SEES[i][j] ? sums[j * stride] : 0;
}
#endif

/* Resets and doses at the start of a lane's cell. */
static void enter(Control *c, int t) {
    const Data *d = c->w->data;
    const int64_t row = d->row_at[c->w->who[t] * (d->depth + 1) + c->cell[t]];
    int full = row >= 0;
    for (int i = 0; row >= 0 && i < STATES; i++) {
        const double weight = d->weight[row * STATES + i];
        real *state = &c->x[i * TILE + t];
        full = full && weight == 1;
        if (weight != 0) *state = R(weight * d->value[row * STATES + i] + (weight == 1 ? 0 : (1 - weight) * *state));
    }
    if (full) c->attempts[t] = 0, c->next[t] = NAN, c->before[t] = 1;
#if EVENTS
    if (full) c->event = -INFINITY, c->last_gap = INFINITY, c->falling = 0;
    memcpy(c->prior, c->x, sizeof c->prior);
#endif
    for (int32_t j = d->arrival_at ? d->arrival_at[cell_at(c, t)] : -1; j >= 0; j = d->arrival_next[j])
        c->x[d->arrival_state[j] * TILE + t] += R(c->w->inputs->amounts[j]);
    c->entering[t] = c->known[t] = 0;
}

/* Times and inputs of all lanes at a fraction of their steps. */
static void place_at(Control *c, double share) {
    const Data *d = c->w->data;
    for (int t = 0; t < TILE; t++) {
        const int64_t cell = c->going[t] ? c->cell[t] : 0, at = c->w->who[t] * d->depth + cell;
        const double after = c->going[t] ? c->begun[t] + share * c->h[t] : 0, length = d->h[at];
        c->time[t] = R(d->t[at] + after);
        for (int j = 0; j < INPUTS; j++) {
            const double first = d->inputs[at * NODES * INPUTS + j], last = d->inputs[(at * NODES + NODES - 1) * INPUTS + j];
            c->inputs[j * TILE + t] = R(first + (length > 0 ? after / length : 0) * (last - first));
        }
    }
}

/* The error of a lane's step in units of the tolerance; infinite where it is not a number. */
static double error_of(const Control *c, int t) {
    double worst = 0;
    if (*c->walk->rtol < 0) return 0;
    for (int i = 0; i < STATES; i++) {
        const double x = fabs(c->from[i * TILE + t]), after = fabs(c->after[i * TILE + t]);
        double error = 0;
        for (int q = 0; q < TRIED; q++) error += TABLEAU_E[q] * c->k[q][i * TILE + t];
        const double ratio = fabs(c->tried[t] * error) / (*c->walk->rtol * ((x > after ? x : after) + c->walk->floor[i]));
        if (!(isfinite(ratio) && isfinite(after))) return INFINITY;
        if (ratio > worst) worst = ratio;
    }
    return worst;
}

static double between(double low, double x, double high) { return x < low ? low : x > high ? high : x; }

/* The next step by the errors of this one and the one before it. */
static void resize(Control *c, int t, double ratio) {
    const double safe = between(1e-10, ratio, 1e10), alone = 0.9 * pow(safe, -1.0 / ORDER);
    if (*c->walk->rtol < 0) return;
    if (ratio > 1) {
        c->next[t] = c->h[t] * between(0.2, alone, 0.9);
        return;
    }
    const double longer = c->h[t] * between(0.2, 0.9 * pow(safe, -0.7 / ORDER) * pow(c->before[t], 0.4 / ORDER), 5.0);
    c->next[t] = c->h[t] < c->next[t] && c->next[t] > longer ? c->next[t] : longer;
    c->before[t] = ratio > 1e-4 ? ratio : 1e-4;
}

/* Keeps a step of a lane; a NaN length says that there is no solution from here on. */
static void keep(Control *c, int t, double length) {
    const Walk *walk = c->walk;
    const size_t at = (size_t)t * walk->room + walk->taken[t]++;
    walk->cell[at] = (int32_t)c->cell[t];
    walk->begin[at] = c->begun[t];
    walk->length[at] = length;
#if MATRICES && EVENTS
    memcpy(walk->factors + at * (STATES * STATES), c->slopes[t], STATES * STATES * sizeof(double));
#elif MATRICES
    memcpy(walk->factors + at * (STATES * STATES), c->lu[t], STATES * STATES * sizeof(double));
    memcpy(walk->exchanges + at * STATES, c->pivots[t], STATES * sizeof(int32_t));
#endif
}

/* A lane without a solution continues where all its states are replaced, or ends. */
static void give_up(Control *c, int t) {
    const Data *d = c->w->data;
    keep(c, t, NAN);
    for (c->cell[t]++; c->cell[t] < c->w->steps[t]; c->cell[t]++) {
        const int64_t row = d->row_at[c->w->who[t] * (d->depth + 1) + c->cell[t]];
        int full = row >= 0;
        for (int i = 0; row >= 0 && i < STATES; i++) full = full && d->weight[row * STATES + i] == 1;
        if (full) break;
    }
    c->begun[t] = 0;
    c->entering[t] = 1;
    c->going[t] = c->cell[t] < c->w->steps[t];
}

static void decide(Control *c, int t, double ratio) {
    const double left = whole(c, t) - c->begun[t], now = fabs(c->w->data->t[cell_at(c, t)]) + c->begun[t];
    const int last = c->h[t] >= left * (1 - 1e-12);
    c->attempts[t]++;
    resize(c, t, ratio);
    if (ratio <= 1) {
        keep(c, t, c->h[t]);
        for (int i = 0; i < STATES; i++) c->x[i * TILE + t] = c->after[i * TILE + t];
        c->known[t] = 0;
        c->begun[t] += c->h[t];
        if (last) c->cell[t]++, c->begun[t] = 0, c->entering[t] = 1;
        c->going[t] = c->cell[t] < c->w->steps[t];
    }
    if (*c->walk->rtol < 0 || !c->going[t]) return;
    if (c->next[t] <= 1e-14 * now || c->next[t] < 1e-250 || c->attempts[t] > c->walk->most) give_up(c, t);
}

/* The lengths of the next steps: within the cells, in two equal parts where that is less than two steps. */
static void choose_steps(Control *c) {
    for (int t = 0; t < TILE; t++) {
        const double left = c->going[t] ? whole(c, t) - c->begun[t] : 0;
        c->h[t] = 0;
        if (!c->going[t]) continue;
        if (*c->walk->rtol < 0) c->next[t] = left;
        if (isnan(c->next[t])) {
            double rate = 0;
            for (int i = 0; i < STATES; i++) {
                const double r = fabs(c->k[0][i * TILE + t]) / (fabs(c->x[i * TILE + t]) + c->walk->floor[i]);
                rate = r > rate || isnan(r) ? r : rate;
            }
            rate = isfinite(rate) ? (rate > 1e-300 ? rate : 1e-300) : 1e300;
            c->next[t] = 1e-2 / rate < left ? 1e-2 / rate : left;
        }
        const double most = EVENTS && *c->walk->rtol >= 0 ? whole(c, t) / PARTS : INFINITY;
        const double wanted = c->next[t] < most ? c->next[t] : most;
        c->h[t] = wanted >= left * (1 - 1e-9) ? left : wanted > 0.5 * left ? 0.5 * left : wanted;
    }
}

/* Tries the chosen steps, and keeps those whose error is small enough: `side_by_side.c`, with events `interrupted.c`. */
static void attempt(Control *c);

/* Returns whether all lanes have reached their ends; else more room is needed. */
static int64_t walk_tile(Control *c) {
    for (;;) {
        int any = 0;
        for (int t = 0; t < TILE; t++) {
            any |= c->going[t];
            if (c->going[t] && c->walk->taken[t] + 2 > c->walk->room) return 0;
            if (c->going[t] && c->entering[t]) enter(c, t);
        }
        if (!any) return 1;
        for (int t = 0; t < TILE; t++) c->h[t] = 0;
        place_at(c, 0);
        rhs_forward(c->w, 0, c->x, c->time, c->inputs, c->k[0]);
        choose_steps(c);
        attempt(c);
    }
}

int64_t control(const Data *data, const Inputs *inputs, const Walk *walk, char *space) {
    Control c;
    Work *w = work_in(space);
    open_work(w, data, inputs, 1);
    memset(&c, 0, sizeof c);
    c.w = w;
    c.walk = walk;
    w->depth = 0;
    for (int t = 0; t < TILE; t++) {
        w->active[t] = t < walk->count;
        set_lane(w, t, walk->who[w->active[t] ? t : 0], 0, data->steps[walk->who[w->active[t] ? t : 0]]);
        for (int i = 0; i < STATES; i++) c.x[i * TILE + t] = R(inputs->initial[w->who[t] * STATES + i]);
        c.going[t] = w->active[t] && w->steps[t] > 0;
        c.entering[t] = 1;
        c.next[t] = NAN;
#if EVENTS
        c.event = -INFINITY;
        c.last_gap = INFINITY;
#endif
        c.before[t] = 1;
        walk->taken[t] = 0;
    }
    invariant_forward(w);
    return walk_tile(&c);
}
