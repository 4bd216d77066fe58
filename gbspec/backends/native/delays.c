/* Delayed values. Every sub-step is kept as the cubic polynomial of the states and rates at its ends, for the whole
   trajectory; later sub-steps, none of which is longer than the shortest delay, take delayed values of it. Each lane has
   its own times, so that it looks up its own places. */

typedef struct {
    real h[TILE], time[EVALUATIONS][TILE], inputs[EVALUATIONS][GIVEN * TILE + 1];
} Step;

/* A delayed time of every lane: the sub-step that it lies in (-1: before the start), how much of it has passed, and the
   states and inputs there. */
typedef struct {
    int64_t piece[TILE];
    double share[TILE], length[TILE];
    real time[TILE], x[STATES * TILE], inputs[INPUTS * TILE + 1];
} Seen;

/* The parts of a piece. */
enum { START, START_RATE, END, END_RATE, PARTS };

static real *piece_at(const Work *w, int64_t s) { return w->pieces + (size_t)s * (PARTS * STATES * TILE); }

static int moves(const Work *w, int64_t s, int t) { return w->active[t] && s < w->steps[t]; }

static int64_t first_cell(const Work *w, int t) { return w->who[t] * w->data->depth; }

/* Evaluation q of the right-hand side: the stages of the method, then the end of the sub-step. */
static int node_of(int q) { return q < STAGES ? TABLEAU_NODE[q] : NODES - 1; }

/* Prepares a tile's trajectories, which begin with the states x. */
static void begin_past(Work *w, const real *x) {
    memcpy(w->origin, x, sizeof w->origin);
    memset(w->hint, 0, sizeof w->hint);
}

/* Whether the rates at the start of sub-step s are computed: something may have happened since the end of the one before. */
static int fresh(const Work *w, int64_t s) {
    if (!s || INPUTS || SCHEDULED || w->data->forced) return 1;
    for (int t = 0; t < TILE; t++)
        if (arrival_of(w, s, t) >= 0) return 1;
    return 0;
}

/* ---------------------------------------------------------------- the solution so far */

/* The last of the first `known` sub-steps of a lane that begins at `time` or before, -1 before the start. */
static int64_t piece_of(Work *w, int t, int lag, int64_t known, double time) {
    const double *begins = w->data->t + first_cell(w, t);
    int64_t i = w->hint[lag * TILE + t];
    if (!known || time < w->data->begin[w->who[t]]) return -1;
    if (i >= known) i = known - 1;
    while (i + 1 < known && begins[i + 1] <= time) i++;
    while (i > 0 && begins[i] > time) i--;
    return w->hint[lag * TILE + t] = i;
}

static void interpolate(const Work *w, int t, Seen *seen) {
    const double share = seen->share[t], left = 1 - share, h = seen->length[t];
    const real *piece = piece_at(w, seen->piece[t]) + t;
    const double *first = w->data->inputs + (first_cell(w, t) + seen->piece[t]) * (NODES * INPUTS);
    for (int i = 0; i < STATES; i++) {
        const real *part = piece + i * TILE;
        const double start = part[START * STATES * TILE], whole = part[END * STATES * TILE] - start;
        const double begins = h * part[START_RATE * STATES * TILE] - whole, ends = whole - h * part[END_RATE * STATES * TILE];
        seen->x[i * TILE + t] = R(start + share * whole + share * left * (left * begins + share * ends));
    }
    for (int j = 0; j < INPUTS; j++)
        seen->inputs[j * TILE + t] = R(first[j] + share * (first[(NODES - 1) * INPUTS + j] - first[j]));
}

/* What a delay sees from a node of sub-step s. Where the time meets an end of an earlier one, the side towards the middle
   of s counts. Lanes that do not move see what was before their start. */
static void look(Work *w, int64_t s, int node, int lag, Seen *seen) {
    const Data *d = w->data;
    real early[STATES * TILE];
    int before = 0;
    for (int t = 0; t < TILE; t++) {
        const int live = moves(w, s, t);
        const int64_t at = first_cell(w, t) + s;
        const double from = live ? d->t[at] : d->begin[w->who[t]], h = live ? d->h[at] : 0;
        const double wait = w->inputs->lags[w->who[t] * LAGS + lag];
        double time = from + TABLEAU_NODES[node] * h - wait;
        const double away = from + h / 2 - wait - time;
        const int64_t i = live ? piece_of(w, t, lag, s, time + 1e-7 * away) : -1;
        if (SCHEDULED) /* not to be on the other side of a jump at the end of a step, by rounding */
            time += copysign(fmin(1e-13 * (fabs(time) + wait), 1e-3 * fabs(away)), away);
        seen->piece[t] = i;
        seen->time[t] = R(time);
        before |= i < 0;
        if (i < 0) {
            for (int j = 0; j < INPUTS; j++) seen->inputs[j * TILE + t] = R(d->before[w->who[t] * INPUTS + j]);
            continue;
        }
        const int64_t there = first_cell(w, t) + i;
        seen->length[t] = d->h[there];
        seen->share[t] = (time - d->t[there]) / (d->h[there] != 0 ? d->h[there] : 1);
        interpolate(w, t, seen);
    }
    if (!before) return;
    history_forward(w, 0, w->origin, seen->time, seen->inputs, early);
    for (int t = 0; t < TILE; t++)
        for (int i = 0; i < STATES && seen->piece[t] < 0; i++) seen->x[i * TILE + t] = early[i * TILE + t];
}

/* All delayed values [DELAYS][TILE] at a node of sub-step s; the calls of networks are kept in `block`. */
static void late_at(Work *w, int64_t s, int node, size_t block, real *late) {
    Seen seen;
    real out[DELAYS * TILE];
    for (int lag = 0; lag < LAGS; lag++) {
        look(w, s, node, lag, &seen);
        late_forward(w, lag, block, seen.x, seen.time, seen.inputs, out);
        for (int k = 0; k < LATE_COUNT[lag]; k++) memcpy(late + LATE_OF[lag][k] * TILE, out + k * TILE, TILE * sizeof(real));
    }
}

static real *late_of(const Work *w, size_t slot, int node) { return w->late + (slot * NODES + (size_t)node) * (DELAYS * TILE); }

/* The delayed values that observations at the end of a stored sub-step see, and those at the start. */
static void see_end(Work *w, size_t slot) { memcpy(w->seen, late_of(w, slot, NODES - 1), sizeof w->seen); }
static void see_start(Work *w) { late_at(w, 0, 0, 0, w->seen); }

/* ---------------------------------------------------------------- a step */

static void read_step(const Work *w, int64_t s, size_t slot, Step *step) {
    const Data *d = w->data;
    for (int t = 0; t < TILE; t++) {
        const int live = moves(w, s, t);
        const int64_t at = first_cell(w, t) + s;
        const double h = live ? d->h[at] : 0, from = live ? d->t[at] : d->begin[w->who[t]];
        step->h[t] = R(h);
        for (int q = 0; q < EVALUATIONS; q++) {
            const double *given = live ? d->inputs + (at * NODES + node_of(q)) * INPUTS : d->before + w->who[t] * INPUTS;
            step->time[q][t] = R(from + TABLEAU_NODES[node_of(q)] * h);
            for (int j = 0; j < INPUTS; j++) step->inputs[q][j * TILE + t] = R(given[j]);
        }
    }
    for (int q = 0; q < EVALUATIONS; q++)
        memcpy(step->inputs[q] + INPUTS * TILE, late_of(w, slot, node_of(q)), DELAYS * TILE * sizeof(real));
}

static real *place_of(const Work *w, size_t slot, int q) { return w->states + (slot * EVALUATIONS + (size_t)q) * (STATES * TILE); }

static void step_forward(Work *w, int64_t s, size_t slot, real *x) {
    Step step;
    real k[EVALUATIONS][STATES * TILE], sum[STATES * TILE], *piece = piece_at(w, s);
    const size_t block = slot * EVALUATIONS, n = STATES * TILE * sizeof(real);
    if (s) wait_where_begun(w, s, x);
    for (int t = 0; t < TILE; t++)
        for (int32_t j = arrival_of(w, s, t); j >= 0; j = w->data->arrival_next[j])
            x[w->data->arrival_state[j] * TILE + t] += R(w->inputs->amounts[j]);
    if (!s) memcpy(w->begun, x, sizeof w->begun);
    for (int node = 0; node < NODES; node++) late_at(w, s, node, block + (size_t)node, late_of(w, slot, node));
    read_step(w, s, slot, &step);
    memcpy(piece + START * STATES * TILE, x, n);
    for (int q = 0; q < EVALUATIONS; q++) {
        real *place = place_of(w, slot, q);
        zero(sum, STATES * TILE);
        add_weighted(q < STAGES ? q : STAGES, q < STAGES ? TABLEAU_A[q] : TABLEAU_B, k, sum);
        for (int i = 0; i < STATES * TILE; i++) place[i] = x[i] + step.h[i % TILE] * sum[i];
        if (q || fresh(w, s)) {
            rhs_forward(w, block + (size_t)q, place, step.time[q], step.inputs[q], k[q]);
            continue;
        }
        memcpy(k[q], piece_at(w, s - 1) + END_RATE * STATES * TILE, n);
        for (int i = 0; i < STATES * TILE; i++)
            if (!moves(w, s, i % TILE)) k[q][i] = 0; /* it may be infinite */
    }
    memcpy(x, place_of(w, slot, STAGES), n);
    memcpy(piece + START_RATE * STATES * TILE, k[0], n);
    memcpy(piece + END * STATES * TILE, x, n);
    memcpy(piece + END_RATE * STATES * TILE, k[STAGES], n);
    memcpy(w->rates + slot * (STAGES * STATES * TILE), k, STAGES * n);
}
