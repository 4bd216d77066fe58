/* One step of a tile, forward and in reverse, with the doses that arrive at its start. Models with events or delays have
   steps of their own, which share some functions. */

#define PLAIN (!EVENTS && !DELAYS)

/* Clears, before a reverse pass, the output cotangents of the calls that are made once for a tile. */
static void invariant_start(Work *w) {
    for (int i = 0; i < RHS_SITES; i++)
        if (SITE_INVARIANT[i]) zero(w->sites[i].yb, TILE * w->sites[i].net->size[w->sites[i].net->layers]);
}

/* Puts sub-steps `first` to `first + steps - 1` of a trajectory into a lane (the caller sets whether it is active). */
static void set_lane(Work *w, int t, int64_t who, int64_t first, int64_t steps) {
    w->who[t] = who;
    w->first[t] = first;
    w->steps[t] = steps;
    if (steps > w->depth) w->depth = steps;
    for (int i = 0; i < CONDITIONS; i++) w->condition[i * TILE + t] = R(w->data->condition[who * CONDITIONS + i]);
    for (int i = 0; i < CONSTANTS; i++) w->constants[i * TILE + t] = R(w->inputs->constants[who * CONSTANTS + i]);
}

#if PLAIN
typedef struct {
    real h[TILE], time[STAGES][TILE], inputs[STAGES][INPUTS * TILE + 1];
} Step;

static void read_step(const Work *w, int64_t s, Step *step) {
    const Data *d = w->data;
    for (int t = 0; t < TILE; t++) {
        const int moves = w->active[t] && s < w->steps[t];
        const int64_t at = w->who[t] * d->depth + (moves ? w->first[t] + s : 0);
        const double h = moves ? d->h[at] : 0.0;
        step->h[t] = R(h);
        for (int q = 0; q < STAGES; q++) {
            step->time[q][t] = R(d->t[at] + TABLEAU_C[q] * h);
            for (int j = 0; j < INPUTS; j++)
                step->inputs[q][j * TILE + t] = R(d->inputs[(at * NODES + TABLEAU_NODE[q]) * INPUTS + j]);
        }
    }
}
#endif

/* The first arrival in a lane at the start of step s, -1 for none. */
static int32_t arrival_of(const Work *w, int64_t s, int t) {
    const Data *d = w->data;
    const int there = d->arrival_at && w->active[t] && s < w->steps[t];
    return there ? d->arrival_at[w->who[t] * d->depth + w->first[t] + s] : -1;
}

#if !EVENTS
/* Lanes that have ended stay at their initial state, so that a state that has grown large causes no infinite rates. */
static void wait_where_begun(const Work *w, int64_t s, real *x) {
    for (int t = 0; t < TILE; t++)
        if (s == w->steps[t])
            for (int i = 0; i < STATES; i++) x[i * TILE + t] = w->begun[i * TILE + t];
}
#endif

/* sum += the rows' sum, weighted. A row of weight 0 is skipped: it may be infinite. */
INLINE void add_weighted(const int count, const double *weights, real rows[][STATES * TILE], real *sum) {
    for (int p = 0; p < count; p++)
        if (weights[p] != 0)
            for (int i = 0; i < STATES * TILE; i++) sum[i] += R(weights[p]) * rows[p][i];
}

#if MATRICES
/* b /= a factored matrix (LAPACK's factors, row by row), or its transpose. */
static void divide_block(const double *lu, const int32_t *pivots, int transposed, double *b) {
    const int n = MATRIX;
    if (!transposed) {
        for (int i = 0; i < n; i++) {
            const int p = pivots[i] - 1;
            const double swapped = b[p];
            b[p] = b[i];
            b[i] = swapped;
            for (int j = 0; j < i; j++) b[i] -= lu[i * n + j] * b[j];
        }
        for (int i = n - 1; i >= 0; i--) {
            for (int j = i + 1; j < n; j++) b[i] -= lu[i * n + j] * b[j];
            b[i] /= lu[i * n + i];
        }
        return;
    }
    for (int i = 0; i < n; i++) {
        for (int j = 0; j < i; j++) b[i] -= lu[j * n + i] * b[j];
        b[i] /= lu[i * n + i];
    }
    for (int i = n - 1; i >= 0; i--) {
        for (int j = i + 1; j < n; j++) b[i] -= lu[j * n + i] * b[j];
    }
    for (int i = n - 1; i >= 0; i--) {
        const int p = pivots[i] - 1;
        const double swapped = b[p];
        b[p] = b[i];
        b[i] = swapped;
    }
}

/* The same for states in blocks, all with one matrix. */
static void divide(const double *lu, const int32_t *pivots, int transposed, double *b) {
    for (int i = 0; i < STATES; i += MATRIX) divide_block(lu, pivots, transposed, b + i);
}

/* Factors a matrix, with exchanges of rows, as LAPACK does. */
static void factorise(double *a, int32_t *pivots) {
    const int n = STATES;
    for (int k = 0; k < n; k++) {
        int p = k;
        for (int i = k + 1; i < n; i++) p = fabs(a[i * n + k]) > fabs(a[p * n + k]) ? i : p;
        pivots[k] = p + 1;
        for (int j = 0; p != k && j < n; j++) {
            const double swapped = a[k * n + j];
            a[k * n + j] = a[p * n + j];
            a[p * n + j] = swapped;
        }
        for (int i = k + 1; i < n; i++) {
            if (a[i * n + k] == 0 && a[k * n + k] != 0) continue; /* states on a grid see few others */
            a[i * n + k] /= a[k * n + k];
            for (int j = k + 1; j < n; j++) a[i * n + j] -= a[i * n + k] * a[k * n + j];
        }
    }
}

/* The factors of I - gamma h W for a step of length h with the Jacobian W. */
static void factorise_step(const double *jacobian, double h, double *a, int32_t *pivots) {
    for (int i = 0; i < STATES * STATES; i++) {
        const double m = (i % (STATES + 1) == 0) - GAMMA * h * jacobian[i];
        a[i] = isfinite(m) ? m : 1;
    }
    factorise(a, pivots);
}

#if PLAIN
/* Divides a vector of each lane by the matrices of step s. */
static void divide_lanes(const Work *w, int64_t s, int transposed, real *vector) {
    double b[STATES];
    for (int t = 0; t < TILE; t++) {
        const int moves = w->active[t] && s < w->steps[t];
        const int64_t at = w->who[t] * w->data->depth + (moves ? w->first[t] + s : 0);
        if (!moves) continue;
        for (int i = 0; i < STATES; i++) b[i] = vector[i * TILE + t];
        divide(w->data->lu + at * (MATRIX * MATRIX), w->data->pivots + at * MATRIX, transposed, b);
        for (int i = 0; i < STATES; i++) vector[i * TILE + t] = R(b[i]);
    }
}
#endif
#endif

#if PLAIN
static void step_forward(Work *w, int64_t s, size_t slot, real *x) {
    Step step;
    real k[STAGES][STATES * TILE], sum[STATES * TILE];
    read_step(w, s, &step);
    if (s) wait_where_begun(w, s, x);
    for (int t = 0; t < TILE; t++)
        for (int32_t j = arrival_of(w, s, t); j >= 0; j = w->data->arrival_next[j])
            x[w->data->arrival_state[j] * TILE + t] += R(w->inputs->amounts[j]);
    if (!s) memcpy(w->begun, x, sizeof w->begun);
    for (int q = 0; q < STAGES; q++) {
        real *place = w->states + (slot * STAGES + q) * (STATES * TILE);
        zero(sum, STATES * TILE);
        add_weighted(q, TABLEAU_A[q], k, sum);
        for (int i = 0; i < STATES * TILE; i++) place[i] = x[i] + step.h[i % TILE] * sum[i];
        rhs_forward(w, slot * STAGES + q, place, step.time[q], step.inputs[q], k[q]);
#if MATRICES
        zero(sum, STATES * TILE);
        add_weighted(q, TABLEAU_V[q], k, sum);
        for (int i = 0; i < STATES * TILE; i++) k[q][i] += sum[i];
        divide_lanes(w, s, 0, k[q]);
        for (int i = 0; i < STATES * TILE; i++) k[q][i] -= sum[i];
#endif
    }
    zero(sum, STATES * TILE);
    add_weighted(STAGES, TABLEAU_B, k, sum);
    for (int i = 0; i < STATES * TILE; i++) x[i] += step.h[i % TILE] * sum[i];
    if (TIMED) memcpy(w->rates + slot * (STAGES * STATES * TILE), k, sizeof k);
}
#endif

/* The first arrival in a lane at the start of step s, if it moves that start; else -1. */
static int32_t cut_of(const Work *w, int64_t s, int t) {
    const int32_t j = arrival_of(w, s, t);
    return j >= 0 && w->data->arrival_cuts[j] ? j : -1;
}

static const real *rate(const Work *w, size_t slot, int q) { return w->rates + (slot * STAGES + q) * (STATES * TILE); }

#if PLAIN
/* Whether an arrival moves the start or the end of a lane's step s. */
static int at_cut(const Work *w, int64_t s) {
    for (int t = 0; t < TILE; t++)
        if (cut_of(w, s, t) >= 0 || cut_of(w, s + 1, t) >= 0) return 1;
    return 0;
}

/* Contributions of a sub-step to the cotangents of the times of cuts: `hb` is the cotangent of its length in the step's
   formulas, `tb` of the times of its Runge-Kutta stages and `ub` of the inputs there. */
static void time_reverse(Work *w, int64_t s, const real *hb, real tb[STAGES][TILE], real ub[STAGES][INPUTS * TILE + 1]) {
    for (int t = 0; t < TILE; t++) {
        const int32_t start = cut_of(w, s, t), end = cut_of(w, s + 1, t);
        double of_start = 0, of_length = hb[t];
        if (start < 0 && end < 0) continue;
        const double *slope = w->data->slope + (w->who[t] * w->data->depth + w->first[t] + s) * INPUTS;
        for (int q = 0; q < STAGES; q++) {
            double moved = tb[q][t];
            for (int j = 0; j < INPUTS; j++) moved += ub[q][j * TILE + t] * slope[j];
            of_start += moved;
            of_length += TABLEAU_C[q] * moved;
        }
        if (start >= 0) w->d_times[start] += of_start - of_length;
        if (end >= 0) w->d_times[end] += of_length;
    }
}
#endif

/* Contribution of a weighted rate to the cotangent of a step's length; `bar` is the cotangent of the weighted sum. */
static void length_reverse(double weight, const real *bar, const real *rates, real *hb) {
    for (int i = 0; weight != 0 && i < STATES * TILE; i++) hb[i % TILE] += bar[i] * R(weight) * rates[i];
}

#if PLAIN
/* `xb`: on entry the cotangent of the state after the step, on return of that before the arrivals at its start. */
static void step_reverse(Work *w, int64_t s, size_t slot, real *xb) {
    Step step;
    real sb[STAGES][STATES * TILE], ob[STATES * TILE];
#if MATRICES
    real vb[STAGES][STATES * TILE];
#endif
    real tb[STAGES][TILE] = {{0}}, ub[STAGES][INPUTS * TILE + 1] = {{0}}, hb[TILE] = {0};
    const int cut = TIMED && at_cut(w, s);
    read_step(w, s, &step);
    for (int q = 0; cut && q < STAGES; q++) length_reverse(TABLEAU_B[q], xb, rate(w, slot, q), hb);
    for (int q = STAGES - 1; q >= 0; q--) {
        const real *place = w->states + (slot * STAGES + q) * (STATES * TILE);
        zero(ob, STATES * TILE);
        add_weighted(1, &TABLEAU_B[q], (real(*)[STATES * TILE])xb, ob);
        for (int p = q + 1; p < STAGES; p++) add_weighted(1, &TABLEAU_A[p][q], &sb[p], ob);
        for (int i = 0; i < STATES * TILE; i++) ob[i] *= step.h[i % TILE];
#if MATRICES
        for (int p = q + 1; p < STAGES; p++) add_weighted(1, &TABLEAU_V[p][q], &vb[p], ob);
        for (int i = 0; i < STATES * TILE; i++) vb[q][i] = -ob[i];
        divide_lanes(w, s, 1, ob);
        for (int i = 0; i < STATES * TILE; i++) vb[q][i] += ob[i];
#endif
        zero(sb[q], STATES * TILE);
        rhs_reverse(w, slot * STAGES + q, place, step.time[q], step.inputs[q], ob, sb[q], w->kb, tb[q], ub[q]);
        for (int p = 0; cut && p < q; p++) length_reverse(TABLEAU_A[q][p], sb[q], rate(w, slot, p), hb);
    }
    for (int q = 0; q < STAGES; q++)
        for (int i = 0; i < STATES * TILE; i++) xb[i] += sb[q][i];
    if (cut) time_reverse(w, s, hb, tb, ub);
    for (int t = 0; t < TILE; t++)
        for (int32_t j = arrival_of(w, s, t); j >= 0; j = w->data->arrival_next[j])
            w->d_amounts[j] = xb[w->data->arrival_state[j] * TILE + t];
}
#endif
