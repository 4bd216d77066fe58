/* Delayed values, in reverse: later sub-steps leave cotangents on the pieces that they looked at, which are complete when
   the reverse pass comes to them. */

static real *piece_bar_at(const Work *w, int64_t s) { return w->piece_bars + (size_t)s * (PARTS * STATES * TILE); }

/* Cotangents of the start (at a fixed length) and of the length of a sub-step, by lane. */
static double *time_bar_at(const Work *w, int64_t s) { return w->time_bars + (size_t)s * (2 * TILE); }

/* Clears all cotangents before a reverse pass. */
static void clear_bars(Work *w) {
    zero(w->piece_bars, (size_t)w->depth * (PARTS * STATES * TILE));
    memset(w->time_bars, 0, (size_t)w->depth * (2 * TILE) * sizeof(double));
    memset(w->lag_bar, 0, sizeof w->lag_bar);
    zero(w->origin_bar, STATES * TILE);
}

/* The weights of a piece's parts in a state that is looked up, and the derivative of that state by the share that has
   passed and, explicitly, by the length. */
typedef struct {
    double part[PARTS], of_share[PARTS], of_length[PARTS];
} Cubic;

static Cubic cubic(double share, double h) {
    const double left = 1 - share, whole = share * share * (3 - 2 * share), slope = 6 * share * left;
    const double begins = share * left * left, ends = -share * share * left;
    return (Cubic){
        {1 - whole, h * begins, whole, h * ends},
        {-slope, h * left * (1 - 3 * share), slope, h * share * (3 * share - 2)},
        {0, begins, 0, ends},
    };
}

/* A looked-up state of a lane, in reverse; `ub`: cotangent of the inputs there. Returns that of the time looked at. */
static double interpolate_back(Work *w, int t, const Seen *seen, const real *xb, const real *ub) {
    const int64_t there = seen->piece[t], at = first_cell(w, t) + there;
    const double h = seen->length[t], share = seen->share[t], *first = w->data->inputs + at * (NODES * INPUTS);
    const real *piece = piece_at(w, there) + t;
    real *bars = piece_bar_at(w, there) + t;
    double *times = time_bar_at(w, there) + t, of_share = 0, of_length = 0;
    const Cubic c = cubic(share, h);
    for (int i = 0; i < STATES; i++)
        for (int p = 0; p < PARTS; p++) {
            const int place = (p * STATES + i) * TILE;
            const double bar = xb[i * TILE + t], value = piece[place];
            bars[place] += R(bar * c.part[p]);
            of_share += bar * c.of_share[p] * value;
            of_length += bar * c.of_length[p] * value;
        }
    for (int j = 0; j < INPUTS; j++) {
        const double bar = ub[j * TILE + t], slope = w->data->slope ? w->data->slope[at * INPUTS + j] : 0;
        of_share += bar * (first[(NODES - 1) * INPUTS + j] - first[j]);
        times[0] += bar * slope;
        times[TILE] += bar * share * slope;
    }
    const double of_time = of_share / (h != 0 ? h : 1);
    times[0] -= of_time;
    times[TILE] += of_length - (h != 0 ? share * of_time : 0);
    return of_time;
}

/* The delayed values at a node of sub-step s, in reverse; `bar` [DELAYS][TILE]: their cotangents. Adds those of the time
   of the node [TILE] to `node_bar`. */
static void late_back(Work *w, int64_t s, int node, size_t block, const real *bar, double *node_bar) {
    Seen seen;
    real ob[DELAYS * TILE], xb[STATES * TILE], tb[TILE], ub[INPUTS * TILE + 1], early[STATES * TILE];
    for (int lag = 0; lag < LAGS; lag++) {
        int before = 0;
        look(w, s, node, lag, &seen);
        for (int k = 0; k < LATE_COUNT[lag]; k++) memcpy(ob + k * TILE, bar + LATE_OF[lag][k] * TILE, TILE * sizeof(real));
        zero(xb, STATES * TILE);
        zero(tb, TILE);
        zero(ub, INPUTS * TILE + 1);
        late_reverse(w, lag, block, seen.x, seen.time, seen.inputs, ob, xb, w->kb, tb, ub);
        for (int t = 0; t < TILE; t++) {
            before |= seen.piece[t] < 0;
            for (int i = 0; i < STATES; i++) early[i * TILE + t] = seen.piece[t] < 0 ? xb[i * TILE + t] : R(0);
        }
        if (before) history_reverse(w, 0, w->origin, seen.time, seen.inputs, early, w->origin_bar, w->kb, tb, ub);
        for (int t = 0; t < TILE; t++) {
            const double of_time = tb[t] + (seen.piece[t] < 0 ? 0 : interpolate_back(w, t, &seen, xb, ub));
            node_bar[t] += of_time;
            w->lag_bar[lag * TILE + t] -= of_time;
        }
    }
}

/* What the first observation sees, in reverse. */
static void see_start_back(Work *w, real *xb) {
    double node_bar[TILE] = {0};
    late_back(w, 0, 0, 0, w->seen_bar, node_bar);
    for (int i = LATE_SITES[0]; i < RHS_SITES; i++) net_gradient(w->sites[i].net, &w->sites[i], 0, TILE, 1);
    for (int i = 0; i < STATES * TILE; i++) xb[i] += w->origin_bar[i];
}

/* Contributions of a sub-step to the cotangents of the times of cuts; `nodes`: of the times of its nodes for the delays. */
static void cuts_back(Work *w, int64_t s, const real *hb, real tb[EVALUATIONS][TILE],
                      real ub[EVALUATIONS][GIVEN * TILE + 1], double nodes[NODES][TILE]) {
    const double *times = time_bar_at(w, s);
    for (int t = 0; t < TILE; t++) {
        const int32_t start = cut_of(w, s, t), end = cut_of(w, s + 1, t);
        double of_start = times[t], of_length = hb[t] + times[TILE + t];
        if (start < 0 && end < 0) continue;
        const double *slope = w->data->slope + (first_cell(w, t) + s) * INPUTS;
        for (int q = 0; q < EVALUATIONS; q++) {
            double moved = tb[q][t];
            for (int j = 0; j < INPUTS; j++) moved += ub[q][j * TILE + t] * slope[j];
            of_start += moved;
            of_length += TABLEAU_NODES[node_of(q)] * moved;
        }
        for (int n = 0; n < NODES; n++) {
            of_start += nodes[n][t];
            of_length += TABLEAU_NODES[n] * nodes[n][t];
        }
        if (start >= 0) w->d_times[start] += of_start - of_length;
        if (end >= 0) w->d_times[end] += of_length;
    }
}

/* The delayed values at all nodes of a sub-step, in reverse. */
static void nodes_back(Work *w, int64_t s, size_t slot, real ub[EVALUATIONS][GIVEN * TILE + 1], double nodes[NODES][TILE]) {
    real bar[DELAYS * TILE];
    for (int n = 0; n < NODES; n++) {
        zero(bar, DELAYS * TILE);
        if (n == NODES - 1) memcpy(bar, w->seen_bar, sizeof bar);
        for (int q = 0; q < EVALUATIONS; q++)
            for (int i = 0; i < DELAYS * TILE && node_of(q) == n; i++) bar[i] += ub[q][INPUTS * TILE + i];
        late_back(w, s, n, slot * EVALUATIONS + (size_t)n, bar, nodes[n]);
    }
}

/* `xb`: on entry the cotangent of the state after the step, on return of that before the arrivals at its start. The
   weights' gradients are formed here: rates that were taken over from the step before have no calls. */
static void step_reverse(Work *w, int64_t s, size_t slot, real *xb) {
    Step step;
    real sb[EVALUATIONS][STATES * TILE] = {{0}}, ob[STATES * TILE], *bars = piece_bar_at(w, s);
    real tb[EVALUATIONS][TILE] = {{0}}, ub[EVALUATIONS][GIVEN * TILE + 1] = {{0}}, hb[TILE] = {0};
    double nodes[NODES][TILE] = {{0}};
    const int first = fresh(w, s) ? 0 : 1;
    const size_t block = slot * EVALUATIONS;
    read_step(w, s, slot, &step);
    memcpy(ob, bars + END_RATE * STATES * TILE, sizeof ob);
    rhs_reverse(w, block + STAGES, place_of(w, slot, STAGES), step.time[STAGES], step.inputs[STAGES], ob, sb[STAGES], w->kb,
                tb[STAGES], ub[STAGES]);
    for (int i = 0; i < STATES * TILE; i++) xb[i] += bars[END * STATES * TILE + i] + sb[STAGES][i];
    for (int q = 0; q < STAGES; q++) length_reverse(TABLEAU_B[q], xb, rate(w, slot, q), hb);
    for (int q = STAGES - 1; q >= 0; q--) {
        zero(ob, STATES * TILE);
        add_weighted(1, &TABLEAU_B[q], (real(*)[STATES * TILE])xb, ob);
        for (int p = q + 1; p < STAGES; p++) add_weighted(1, &TABLEAU_A[p][q], &sb[p], ob);
        for (int i = 0; i < STATES * TILE; i++) ob[i] *= step.h[i % TILE];
        for (int i = 0; i < STATES * TILE && !q; i++) ob[i] += bars[START_RATE * STATES * TILE + i];
        if (q < first) {
            for (int i = 0; i < STATES * TILE; i++) piece_bar_at(w, s - 1)[END_RATE * STATES * TILE + i] += ob[i];
            continue;
        }
        rhs_reverse(w, block + (size_t)q, place_of(w, slot, q), step.time[q], step.inputs[q], ob, sb[q], w->kb, tb[q], ub[q]);
        for (int p = 0; p < q; p++) length_reverse(TABLEAU_A[q][p], sb[q], rate(w, slot, p), hb);
    }
    for (int q = 0; q < STAGES; q++)
        for (int i = 0; i < STATES * TILE; i++) xb[i] += sb[q][i];
    for (int i = 0; i < STATES * TILE; i++) xb[i] += bars[START * STATES * TILE + i];
    nodes_back(w, s, slot, ub, nodes);
    cuts_back(w, s, hb, tb, ub, nodes);
    for (int i = 0; i < RHS_SITES; i++) {
        const size_t from = i < LATE_SITES[0] ? (size_t)first : 0, count = i < LATE_SITES[0] ? EVALUATIONS - from : NODES;
        net_gradient(w->sites[i].net, &w->sites[i], (block + from) * TILE, count * TILE, 1);
    }
    for (int t = 0; t < TILE; t++)
        for (int32_t j = arrival_of(w, s, t); j >= 0; j = w->data->arrival_next[j])
            w->d_amounts[j] = xb[w->data->arrival_state[j] * TILE + t];
}
