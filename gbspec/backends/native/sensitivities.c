/* Derivatives of the measured values of whole trajectories with delays, by forward sensitivities: those of the states and
   rates at the ends of a sub-step are kept as long as a delay looks back to them. Reverse passes of single evaluations
   give the derivatives of rates and of what is delayed, whatever the number of columns; the columns are learnable constants
   in natural units, initial states, and the weights. */

typedef struct {
    const Sensitivities *all;
    int64_t columns, window;
    double *now, *stage, *seen; /* [TILE][STATES][columns]: at the place reached, of an evaluation, of a lookup */
    double *rates;              /* [EVALUATIONS][TILE][STATES][columns] */
    double *late;               /* [NODES][TILE][DELAYS][columns] */
    double *pieces;             /* [window][TILE][PARTS][STATES][columns] */
    double moved[TILE][LEARNABLES + 1]; /* of the time looked at */
} Forward;

static char *arrange_forward(Forward *f, char *place, int64_t columns, int64_t window) {
    const size_t rows = (size_t)(columns * TILE) * sizeof(double);
    f->columns = columns;
    f->window = window;
    f->now = take(&place, rows * STATES);
    f->stage = take(&place, rows * STATES);
    f->seen = take(&place, rows * STATES);
    f->rates = take(&place, rows * STATES * EVALUATIONS);
    f->late = take(&place, rows * DELAYS * NODES);
    f->pieces = take(&place, rows * PARTS * STATES * (size_t)window);
    return place;
}

static double *row_of(const Forward *f, double *table, int t, int i) { return table + (t * STATES + i) * f->columns; }
static double *rate_row(const Forward *f, int q, int t, int i) { return f->rates + ((q * TILE + t) * STATES + i) * f->columns; }
static double *late_row(const Forward *f, int n, int t, int d) { return f->late + ((n * TILE + t) * DELAYS + d) * f->columns; }
static double *piece_row(const Forward *f, int64_t s, int t, int part, int i) {
    return f->pieces + (((s % f->window * TILE + t) * PARTS + part) * STATES + i) * f->columns;
}

static void clear_row(const Forward *f, double *row) { memset(row, 0, (size_t)f->columns * sizeof(double)); }

static void add_row(const Forward *f, double factor, const double *restrict from, double *restrict row) {
    for (int64_t c = 0; factor != 0 && c < f->columns; c++) row[c] += factor * from[c];
}

/* Lanes that are computed in sub-step s; what is seen at the start counts for those without sub-steps, too. */
static int counts(const Work *w, int64_t s, int t) { return w->active[t] && (!s || s < w->steps[t]); }

/* row += the derivatives of a lane's time in sub-step s: a multiple of those of its start and of its length. */
static void add_time(const Work *w, const Forward *f, int64_t s, int t, double of_start, double of_length, double *row) {
    const int32_t start = cut_of(w, s, t), end = cut_of(w, s + 1, t);
    for (int i = 0; i < LEARNABLES; i++) {
        if (start >= 0) row[i] += (of_start - of_length) * f->all->of_times[start * LEARNABLES + i];
        if (end >= 0) row[i] += of_length * f->all->of_times[end * LEARNABLES + i];
    }
}

/* Contributions of inputs, which change in time, to the derivatives by start and length of sub-step s. */
static double moved_inputs(const Work *w, int64_t s, int t, const real *ub) {
    double sum = 0;
    if (w->data->slope && s < w->steps[t])
        for (int j = 0; j < INPUTS; j++) sum += ub[j * TILE + t] * w->data->slope[(first_cell(w, t) + s) * INPUTS + j];
    return sum;
}

/* row += what an evaluation that was reversed says about the constants and weights themselves. */
static void add_direct(Work *w, const Forward *f, int t, int first, int end, size_t block, double *row) {
    const Sensitivities *all = f->all;
    for (int i = 0; i < LEARNABLES; i++) row[i] += w->kb[i * TILE + t];
    if (first == end || f->columns == LEARNABLES + STATES) return;
    zero(w->gradients, w->n_gradients);
    for (int i = first; i < end; i++) net_gradient(w->sites[i].net, &w->sites[i], block * TILE + (size_t)t, 1, TILE);
    write_lane(w, all->factor, all->shift, row + LEARNABLES + STATES);
}

/* ob = the cotangent of one of several values, in all lanes. */
static void choose(real *ob, int count, int which) {
    zero(ob, (size_t)count * TILE);
    for (int t = 0; t < TILE; t++) ob[which * TILE + t] = 1;
}

/* ---------------------------------------------------------------- what is delayed */

/* Where a lookup lies before the start: its states depend on the initial ones, the constants and the time. */
static void seen_before(Work *w, const Forward *f, int64_t s, const Seen *seen) {
    real ob[STATES * TILE], xb[STATES * TILE], tb[TILE], ub[INPUTS * TILE + 1];
    for (int i = 0; i < STATES; i++) {
        choose(ob, STATES, i);
        zero(xb, STATES * TILE);
        zero(tb, TILE);
        zero(ub, INPUTS * TILE + 1);
        memset(w->kb, 0, sizeof w->kb);
        history_reverse(w, 0, w->origin, seen->time, seen->inputs, ob, xb, w->kb, tb, ub);
        for (int t = 0; t < TILE; t++) {
            double *row = row_of(f, f->seen, t, i);
            if (!counts(w, s, t) || seen->piece[t] >= 0) continue;
            clear_row(f, row);
            for (int k = 0; k < LEARNABLES; k++) row[k] = w->kb[k * TILE + t] + tb[t] * f->moved[t][k];
            for (int j = 0; j < STATES; j++) row[LEARNABLES + j] += xb[j * TILE + t];
        }
    }
}

/* Where it lies in an earlier sub-step. */
static void seen_within(const Work *w, const Forward *f, int t, const Seen *seen) {
    const int64_t there = seen->piece[t];
    const double h = seen->length[t], share = seen->share[t], pace = 1 / (h != 0 ? h : 1);
    const Cubic c = cubic(share, h);
    for (int i = 0; i < STATES; i++) {
        double *row = row_of(f, f->seen, t, i), of_share = 0, of_length = 0;
        clear_row(f, row);
        for (int p = 0; p < PARTS; p++) {
            const double value = piece_at(w, there)[(p * STATES + i) * TILE + t];
            add_row(f, c.part[p], piece_row(f, there, t, p, i), row);
            of_share += c.of_share[p] * value;
            of_length += c.of_length[p] * value;
        }
        for (int k = 0; k < LEARNABLES; k++) row[k] += of_share * pace * f->moved[t][k];
        add_time(w, f, there, t, -of_share * pace, of_length - (h != 0 ? share * of_share * pace : 0), row);
    }
}

/* row += what the inputs at the time looked at contribute; `ub`: derivatives by them. */
static void add_seen_inputs(const Work *w, const Forward *f, int t, const Seen *seen, const real *ub, double *row) {
    const int64_t there = seen->piece[t];
    const double h = seen->length[t], share = seen->share[t];
    if (there < 0 || !INPUTS) return;
    const double *first = w->data->inputs + (first_cell(w, t) + there) * (NODES * INPUTS), pace = 1 / (h != 0 ? h : 1);
    double of_share = 0, moved = moved_inputs(w, there, t, ub);
    for (int j = 0; j < INPUTS; j++) of_share += ub[j * TILE + t] * (first[(NODES - 1) * INPUTS + j] - first[j]);
    for (int k = 0; k < LEARNABLES; k++) row[k] += of_share * pace * f->moved[t][k];
    add_time(w, f, there, t, moved - of_share * pace, share * moved - (h != 0 ? share * of_share * pace : 0), row);
}

/* The derivatives of the delayed values at a node of sub-step s, whose calls are in `block`. */
static void late_forwards(Work *w, Forward *f, int64_t s, int node, size_t block) {
    Seen seen;
    real ob[DELAYS * TILE], xb[STATES * TILE], tb[TILE], ub[INPUTS * TILE + 1], out[DELAYS * TILE];
    for (int lag = 0; lag < LAGS; lag++) {
        int before = 0;
        look(w, s, node, lag, &seen);
        for (int t = 0; t < TILE; t++) {
            const double *of_lag = f->all->of_lags + (w->who[t] * LAGS + lag) * LEARNABLES;
            if (!counts(w, s, t)) continue;
            for (int k = 0; k < LEARNABLES; k++) f->moved[t][k] = -of_lag[k];
            add_time(w, f, s, t, 1, TABLEAU_NODES[node], f->moved[t]);
            before |= seen.piece[t] < 0;
            if (seen.piece[t] >= 0) seen_within(w, f, t, &seen);
        }
        if (before) seen_before(w, f, s, &seen);
        for (int k = 0; k < LATE_COUNT[lag]; k++) {
            if (k && LATE_SITES[lag] < LATE_SITES[lag + 1]) late_forward(w, lag, block, seen.x, seen.time, seen.inputs, out);
            choose(ob, LATE_COUNT[lag], k);
            zero(xb, STATES * TILE);
            zero(tb, TILE);
            zero(ub, INPUTS * TILE + 1);
            memset(w->kb, 0, sizeof w->kb);
            late_reverse(w, lag, block, seen.x, seen.time, seen.inputs, ob, xb, w->kb, tb, ub);
            for (int t = 0; t < TILE; t++) {
                double *row = late_row(f, node, t, LATE_OF[lag][k]);
                if (!counts(w, s, t)) continue;
                clear_row(f, row);
                for (int i = 0; i < STATES; i++) add_row(f, xb[i * TILE + t], row_of(f, f->seen, t, i), row);
                for (int i = 0; i < LEARNABLES; i++) row[i] += tb[t] * f->moved[t][i];
                add_seen_inputs(w, f, t, &seen, ub, row);
                add_direct(w, f, t, LATE_SITES[lag], LATE_SITES[lag + 1], block, row);
            }
        }
    }
}

/* ---------------------------------------------------------------- a step */

/* The derivatives of the rates of evaluation q, at states that have those of `stage`. */
static void rates_forwards(Work *w, const Forward *f, int64_t s, int q, const Step *step) {
    real ob[STATES * TILE], xb[STATES * TILE], tb[TILE], ub[GIVEN * TILE + 1], out[STATES * TILE];
    const real *place = place_of(w, 0, q);
    for (int i = 0; i < STATES; i++) {
        if (i && LATE_SITES[0]) rhs_forward(w, (size_t)q, place, step->time[q], step->inputs[q], out);
        choose(ob, STATES, i);
        zero(xb, STATES * TILE);
        zero(tb, TILE);
        zero(ub, GIVEN * TILE + 1);
        memset(w->kb, 0, sizeof w->kb);
        rhs_reverse(w, (size_t)q, place, step->time[q], step->inputs[q], ob, xb, w->kb, tb, ub);
        for (int t = 0; t < TILE; t++) {
            double *row = rate_row(f, q, t, i);
            if (!moves(w, s, t)) continue;
            const double moved = tb[t] + moved_inputs(w, s, t, ub);
            clear_row(f, row);
            for (int j = 0; j < STATES; j++) add_row(f, xb[j * TILE + t], row_of(f, f->stage, t, j), row);
            for (int d = 0; d < DELAYS; d++)
                add_row(f, ub[(INPUTS + d) * TILE + t], late_row(f, node_of(q), t, d), row);
            add_time(w, f, s, t, moved, TABLEAU_NODES[node_of(q)] * moved, row);
            add_direct(w, f, t, 0, LATE_SITES[0], (size_t)q, row);
        }
    }
}

/* stage = now + h times the weighted sum of the first rates. */
static void weigh(const Work *w, const Forward *f, int64_t s, const Step *step, int count, const double *weights) {
    for (int t = 0; t < TILE; t++)
        for (int i = 0; i < STATES && moves(w, s, t); i++) {
            double *row = row_of(f, f->stage, t, i), sum = 0;
            memcpy(row, row_of(f, f->now, t, i), (size_t)f->columns * sizeof(double));
            for (int p = 0; p < count; p++) {
                add_row(f, step->h[t] * weights[p], rate_row(f, p, t, i), row);
                if (weights[p] != 0) sum += weights[p] * rate(w, 0, p)[i * TILE + t];
            }
            add_time(w, f, s, t, 0, sum, row);
        }
}

static void keep(const Work *w, const Forward *f, int64_t s, int part, const double *table) {
    for (int t = 0; t < TILE; t++)
        if (moves(w, s, t))
            memcpy(piece_row(f, s, t, part, 0), table + t * STATES * f->columns, (size_t)(STATES * f->columns) * sizeof(double));
}

/* Sub-step s, whose solution is in the first slot. */
static void step_forwards(Work *w, Forward *f, int64_t s) {
    Step step;
    const size_t block = (size_t)(TILE * STATES * f->columns);
    read_step(w, s, 0, &step);
    for (int t = 0; t < TILE; t++)
        for (int32_t j = arrival_of(w, s, t); j >= 0; j = w->data->arrival_next[j])
            for (int i = 0; i < LEARNABLES; i++)
                row_of(f, f->now, t, w->data->arrival_state[j])[i] += f->all->of_amounts[j * LEARNABLES + i];
    for (int n = 0; n < NODES; n++) late_forwards(w, f, s, n, (size_t)n);
    keep(w, f, s, START, f->now);
    for (int q = 0; q < EVALUATIONS; q++) {
        weigh(w, f, s, &step, q < STAGES ? q : STAGES, q < STAGES ? TABLEAU_A[q] : TABLEAU_B);
        if (q || fresh(w, s)) {
            rates_forwards(w, f, s, q, &step);
            continue;
        }
        for (int t = 0; t < TILE; t++)
            if (moves(w, s, t))
                memcpy(rate_row(f, 0, t, 0), piece_row(f, s - 1, t, END_RATE, 0), (size_t)(STATES * f->columns) * sizeof(double));
    }
    keep(w, f, s, START_RATE, f->rates);
    keep(w, f, s, END, f->stage);
    keep(w, f, s, END_RATE, f->rates + STAGES * block);
    for (int t = 0; t < TILE; t++)
        if (moves(w, s, t))
            memcpy(row_of(f, f->now, t, 0), row_of(f, f->stage, t, 0), (size_t)(STATES * f->columns) * sizeof(double));
}

/* ---------------------------------------------------------------- key rows */

/* The rows of the Jacobian at the key rows before sub-step s, then the resets; `node`: of the delayed values seen. */
static void observe_forwards(Work *w, const Forward *f, int64_t s, int node, real *x) {
    const Data *d = w->data;
    real predicted[CHANNELS * TILE], ob[CHANNELS * TILE], xb[STATES * TILE];
    if (!find_rows(w, s)) return;
    for (int channel = 0; channel < CHANNELS; channel++) {
        if (!channel || RHS_SITES < SITES) observe_forward(w, 0, x, predicted);
        choose(ob, CHANNELS, channel);
        zero(xb, STATES * TILE);
        zero(w->seen_bar, DELAYS * TILE);
        memset(w->kb, 0, sizeof w->kb);
        observe_reverse(w, 0, x, ob, xb, w->kb);
        for (int t = 0; t < TILE; t++) {
            const int64_t cell = (int64_t)w->rows[t] * CHANNELS + channel;
            if (w->rows[t] < 0 || f->all->place[cell] < 0) continue;
            double *row = f->all->out + f->all->place[cell] * f->columns;
            clear_row(f, row);
            for (int i = 0; i < STATES; i++) add_row(f, xb[i * TILE + t], row_of(f, f->now, t, i), row);
            for (int i = 0; i < DELAYS; i++) add_row(f, w->seen_bar[i * TILE + t], late_row(f, node, t, i), row);
            add_direct(w, f, t, RHS_SITES, SITES, 0, row);
            for (int64_t c = 0; c < f->columns; c++) row[c] *= f->all->scale[cell];
        }
    }
    for (int t = 0; t < TILE; t++) {
        if (w->rows[t] < 0) continue;
        for (int i = 0; i < STATES; i++) {
            double *row = row_of(f, f->now, t, i);
            const double left = 1 - d->weight[w->rows[t] * STATES + i];
            for (int64_t c = 0; c < f->columns; c++) row[c] = left == 0 ? 0 : left * row[c];
        }
        reset(d, (size_t)w->rows[t], t, x);
    }
}

static void sensitive_tile(Work *w, Forward *f) {
    real x[STATES * TILE];
    for (int i = 0; i < STATES; i++)
        for (int t = 0; t < TILE; t++) {
            x[i * TILE + t] = R(w->inputs->initial[w->who[t] * STATES + i]);
            clear_row(f, row_of(f, f->now, t, i));
            row_of(f, f->now, t, i)[LEARNABLES + i] = 1;
        }
    begin_past(w, x);
    see_start(w);
    late_forwards(w, f, 0, 0, 0);
    observe_forwards(w, f, 0, 0, x);
    for (int64_t s = 0; s < w->depth; s++) {
        step_forward(w, s, 0, x);
        step_forwards(w, f, s);
        see_end(w, 0);
        observe_forwards(w, f, s + 1, NODES - 1, x);
    }
}

/* ---------------------------------------------------------------- exported functions */

/* Bytes of work space for trajectories of at most `depth` sub-steps. */
int64_t sensitivity_bytes(int64_t depth, int64_t columns, int64_t window) {
    Work work;
    Forward forward;
    return bytes_until(arrange_forward(&forward, arrange(&work, BASE, depth), columns, window));
}

/* The derivatives of the measured values of some trajectories. */
void sensitivities(const Data *data, const Inputs *inputs, const Sensitivities *all, char *space) {
    Work *w = work_in(space);
    Forward f = {.all = all};
    arrange_forward(&f, open_work(w, data, inputs, data->depth), all->columns, all->window);
    for (int64_t begin = 0; begin < all->count; begin += TILE) {
        w->depth = 0;
        for (int t = 0; t < TILE; t++) {
            w->active[t] = begin + t < all->count;
            const int64_t who = all->order[w->active[t] ? begin + t : begin];
            set_lane(w, t, who, 0, data->steps[who]);
        }
        sensitive_tile(w, &f);
    }
}
