/* The unroll: tiles of TILE trajectories, each run through its whole solution and back. Steps are taken in segments of
   which the activations are kept; of all other steps only the state at the segment's start is, and going back they are
   taken once more. */

typedef struct {
    int64_t depth, trajectories;
    const double *t, *h;             /* [trajectories][depth] */
    const double *inputs;            /* [trajectories][depth][NODES][INPUTS] */
    const double *condition;         /* [trajectories][CONDITIONS] */
    const int64_t *steps;            /* [trajectories] */
    const int32_t *row_at;           /* [trajectories][depth + 1]: key row on arrival, -1 for none */
    const double *row_time;          /* [rows] */
    const double *row_inputs;        /* [rows][INPUTS] */
    const double *measured, *factor; /* [rows][CHANNELS]; factor 0: not measured */
    const double *value, *weight;    /* [rows][STATES]: resets */
    const int32_t *jump_at;          /* [trajectories][depth]: first jump at a step's start, -1 for none; or NULL */
    const int32_t *jump_next;        /* [jumps]: next one at the same place, -1 for none */
    const int32_t *jump_state;       /* [jumps] */
    const int32_t *jump_cuts;        /* [jumps]: whether it moves the start of its sub-step */
    const double *slope;             /* [trajectories][depth][INPUTS]: of inputs in time, where sub-steps are cut */
    const int32_t *logarithmic;      /* [CHANNELS] */
} Data;

typedef struct {
    const Data *data;
    const double *jumps; /* [jumps]: what is added to the state */
    double *d_jumps, *d_times; /* [jumps]; d_times if TIMED */
    int64_t who[TILE], first[TILE], steps[TILE], depth, segment; /* a lane's trajectory, first sub-step, number of them */
    int active[TILE], rows[TILE];
    real *states;      /* [segment*STAGES][STATES][TILE]: where the right-hand side was taken */
    real *rates;       /* [segment*STAGES][STATES][TILE] if TIMED: what the right-hand side was */
    real *arrivals;    /* [segment][STATES][TILE] */
    real *checkpoints; /* [segments][STATES][TILE] */
    real condition[CONDITIONS * TILE + 1], constants[CONSTANTS * TILE + 1], numbers[NUMBERS + 1];
    double kb[LEARNABLES * TILE + 1];
    Net nets[NETWORKS + 1];
    Site sites[SITES + 1];
    real *gradients;
    double *totals;
    size_t n_gradients;
} Work;

/* ---- EQUATIONS ---- */

/* ---------------------------------------------------------------- work space */

static void *take(char **place, size_t bytes) {
    char *start = *place;
    *place += (bytes + 63) / 64 * 64;
    return start;
}

static real *take_real(char **place, size_t n) { return (real *)take(place, n * sizeof(real)); }

/* Whether the activations of a call are kept for every stage of a segment. */
static int kept(int site) { return site < RHS_SITES && !SITE_STILL[site]; }

/* Sets every array of a work space that begins at `place`, and tells where it ends. */
static char *arrange(Work *w, char *place, int64_t depth) {
    set_networks(w);
    for (int i = 0; i < NETWORKS; i++) {
        Net *net = &w->nets[i];
        for (int l = 0; l < net->layers; l++) {
            const size_t in = net->size[l], out = net->size[l + 1], last = l == net->layers - 1;
            net->forward[l] = last ? NULL : take_real(&place, in * PAD(out));
            net->back[l] = l || last ? take_real(&place, out * (l ? PAD(in) : in)) : NULL;
            net->bias[l] = take_real(&place, PAD(out));
        }
    }
    w->gradients = (real *)place;
    for (int i = 0; i < NETWORKS; i++) {
        Net *net = &w->nets[i];
        for (int l = 0; l < net->layers; l++) {
            const size_t in = net->size[l], out = net->size[l + 1];
            const int first = l == 0 && net->layers > 1;
            net->gradient[l] = take_real(&place, first ? in * PAD(out) : out * (l ? PAD(in) : in));
            net->bias_gradient[l] = take_real(&place, PAD(out));
        }
    }
    w->n_gradients = (size_t)(place - (char *)w->gradients) / sizeof(real);
    w->totals = take(&place, w->n_gradients * sizeof(double));
    /* What a step keeps: the states of its stages, arrivals, and of every call arguments, activations and outputs. */
    size_t step = ((TIMED ? 2 : 1) * STAGES + 1) * STATES * TILE;
    for (int i = 0; i < SITES; i++) {
        const Net *net = &w->nets[SITE_NETWORK[i]];
        size_t row = net->size[0] + 2 * net->size[net->layers];
        for (int l = 1; l < net->layers; l++) row += 2 * PAD(net->size[l]);
        if (kept(i)) step += row * TILE * STAGES;
    }
    w->segment = (int64_t)(KEPT_BYTES / (step * sizeof(real)));
    if (w->segment > depth) w->segment = depth;
    if (w->segment < 1) w->segment = 1;
    w->states = take_real(&place, (size_t)w->segment * STAGES * STATES * TILE);
    w->rates = TIMED ? take_real(&place, (size_t)w->segment * STAGES * STATES * TILE) : NULL;
    w->arrivals = take_real(&place, (size_t)w->segment * STATES * TILE);
    w->checkpoints = take_real(&place, (size_t)(depth / w->segment + 2) * STATES * TILE);
    for (int i = 0; i < SITES; i++) {
        Site *site = &w->sites[i];
        const Net *net = site->net = &w->nets[SITE_NETWORK[i]];
        const size_t n = (kept(i) ? (size_t)w->segment * STAGES : 1) * TILE;
        const size_t in = net->size[0], out = net->size[net->layers];
        site->args = take_real(&place, n * in);
        site->ab = take_real(&place, TILE * in);
        site->y = take_real(&place, n * out);
        site->yb = take_real(&place, n * out);
        for (int l = 1; l < net->layers; l++) {
            site->hidden[l] = take_real(&place, n * PAD(net->size[l]));
            site->slope[l] = take_real(&place, n * PAD(net->size[l]));
        }
    }
    return place;
}

/* Lays the weights out (each layer's weights [out][in], then its bias) and sets the gradients to zero. */
static void set_weights(Work *w, const double *weights) {
    for (int i = 0; i < NETWORKS; i++) {
        Net *net = &w->nets[i];
        for (int l = 0; l < net->layers; l++) {
            const size_t in = net->size[l], out = net->size[l + 1], ldf = PAD(out), ldb = l ? PAD(in) : in;
            if (net->forward[l]) zero(net->forward[l], in * ldf);
            if (net->back[l]) zero(net->back[l], out * ldb);
            zero(net->bias[l], PAD(out));
            for (size_t o = 0; o < out; o++)
                for (size_t j = 0; j < in; j++) {
                    const real value = R(*weights++);
                    if (net->forward[l]) net->forward[l][j * ldf + o] = value;
                    if (net->back[l]) net->back[l][o * ldb + j] = value;
                }
            for (size_t o = 0; o < out; o++) net->bias[l][o] = R(*weights++);
        }
    }
    zero(w->gradients, w->n_gradients);
    memset(w->totals, 0, w->n_gradients * sizeof(double));
}

/* Sums over a tile are in `real`, over all tiles in double. */
static void add_to_totals(Work *w) {
    for (size_t i = 0; i < w->n_gradients; i++) {
        w->totals[i] += w->gradients[i];
        w->gradients[i] = 0;
    }
}

static void write_gradient(const Work *w, double *out) {
    for (int i = 0; i < NETWORKS; i++) {
        const Net *net = &w->nets[i];
        for (int l = 0; l < net->layers; l++) {
            const size_t in = net->size[l], out_size = net->size[l + 1];
            const int first = l == 0 && net->layers > 1;
            const double *g = w->totals + (net->gradient[l] - w->gradients);
            const double *b = w->totals + (net->bias_gradient[l] - w->gradients);
            for (size_t o = 0; o < out_size; o++)
                for (size_t j = 0; j < in; j++)
                    *out++ = first ? g[j * PAD(out_size) + o] : g[o * (l ? PAD(in) : in) + j];
            for (size_t o = 0; o < out_size; o++) *out++ = b[o];
        }
    }
}

/* ---------------------------------------------------------------- one step */

/* Puts sub-steps `first` to `first + steps - 1` of a trajectory into a lane (whether it is active, the caller says). */
static void set_lane(Work *w, int t, int64_t who, int64_t first, int64_t steps, const double *constants) {
    w->who[t] = who;
    w->first[t] = first;
    w->steps[t] = steps;
    if (steps > w->depth) w->depth = steps;
    for (int i = 0; i < CONDITIONS; i++) w->condition[i * TILE + t] = R(w->data->condition[who * CONDITIONS + i]);
    for (int i = 0; i < CONSTANTS; i++) w->constants[i * TILE + t] = R(constants[who * CONSTANTS + i]);
}

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

/* The first jump of a lane at the start of step s, -1 for none. */
static int32_t jump_of(const Work *w, int64_t s, int t) {
    const Data *d = w->data;
    const int there = d->jump_at && w->active[t] && s < w->steps[t];
    return there ? d->jump_at[w->who[t] * d->depth + w->first[t] + s] : -1;
}

static void step_forward(Work *w, int64_t s, size_t slot, real *x) {
    Step step;
    real k[STAGES][STATES * TILE];
    read_step(w, s, &step);
    for (int t = 0; t < TILE; t++)
        for (int32_t j = jump_of(w, s, t); j >= 0; j = w->data->jump_next[j])
            x[w->data->jump_state[j] * TILE + t] += R(w->jumps[j]);
    for (int q = 0; q < STAGES; q++) {
        real *place = w->states + (slot * STAGES + q) * (STATES * TILE);
        for (int i = 0; i < STATES; i++)
            for (int t = 0; t < TILE; t++) {
                real sum = 0;
                UNROLL for (int p = 0; p < q; p++) sum += R(TABLEAU_A[q][p]) * k[p][i * TILE + t];
                place[i * TILE + t] = x[i * TILE + t] + step.h[t] * sum;
            }
        rhs_forward(w, slot * STAGES + q, place, step.time[q], step.inputs[q], k[q]);
    }
    for (int i = 0; i < STATES; i++)
        for (int t = 0; t < TILE; t++) {
            real sum = 0;
            UNROLL for (int q = 0; q < STAGES; q++) sum += R(TABLEAU_B[q]) * k[q][i * TILE + t];
            x[i * TILE + t] += step.h[t] * sum;
        }
    if (TIMED) memcpy(w->rates + slot * (STAGES * STATES * TILE), k, sizeof k);
}

/* The first jump of a lane at the start of step s, if it moves that start; else -1. */
static int32_t cut_of(const Work *w, int64_t s, int t) {
    const int32_t jump = jump_of(w, s, t);
    return jump >= 0 && w->data->jump_cuts[jump] ? jump : -1;
}

static const real *rate(const Work *w, size_t slot, int q) { return w->rates + (slot * STAGES + q) * (STATES * TILE); }

/* Whether a jump moves the start or the end of a lane's step s. */
static int at_cut(const Work *w, int64_t s) {
    for (int t = 0; t < TILE; t++)
        if (cut_of(w, s, t) >= 0 || cut_of(w, s + 1, t) >= 0) return 1;
    return 0;
}

/* What the times of cuts get from a sub-step: cotangents `hb` of its length as it stands in the step's formulas, `tb` of
   the times of its stages and `ub` of the inputs there. */
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

/* `xb`: cotangent of the state after the step, then of that before its jumps. */
static void step_reverse(Work *w, int64_t s, size_t slot, real *xb) {
    Step step;
    real sb[STAGES][STATES * TILE], ob[STATES * TILE];
    real tb[STAGES][TILE] = {{0}}, ub[STAGES][INPUTS * TILE + 1] = {{0}}, hb[TILE] = {0};
    const int cut = TIMED && at_cut(w, s);
    read_step(w, s, &step);
    for (int q = 0; cut && q < STAGES; q++)
        for (int i = 0; i < STATES * TILE; i++) hb[i % TILE] += xb[i] * R(TABLEAU_B[q]) * rate(w, slot, q)[i];
    for (int q = STAGES - 1; q >= 0; q--) {
        const real *place = w->states + (slot * STAGES + q) * (STATES * TILE);
        for (int i = 0; i < STATES; i++)
            for (int t = 0; t < TILE; t++) {
                real sum = R(TABLEAU_B[q]) * xb[i * TILE + t];
                UNROLL for (int p = q + 1; p < STAGES; p++) sum += R(TABLEAU_A[p][q]) * sb[p][i * TILE + t];
                ob[i * TILE + t] = step.h[t] * sum;
            }
        zero(sb[q], STATES * TILE);
        rhs_reverse(w, slot * STAGES + q, place, step.time[q], step.inputs[q], ob, sb[q], w->kb, tb[q], ub[q]);
        for (int p = 0; cut && p < q; p++)
            for (int i = 0; i < STATES * TILE; i++) hb[i % TILE] += sb[q][i] * R(TABLEAU_A[q][p]) * rate(w, slot, p)[i];
    }
    for (int q = 0; q < STAGES; q++)
        for (int i = 0; i < STATES * TILE; i++) xb[i] += sb[q][i];
    if (cut) time_reverse(w, s, hb, tb, ub);
    for (int t = 0; t < TILE; t++)
        for (int32_t j = jump_of(w, s, t); j >= 0; j = w->data->jump_next[j])
            w->d_jumps[j] = xb[w->data->jump_state[j] * TILE + t];
}

/* ---------------------------------------------------------------- key rows */

static int find_rows(Work *w, int64_t s) {
    int any = 0;
    for (int t = 0; t < TILE; t++) {
        const int64_t at = w->who[t] * (w->data->depth + 1) + s;
        w->rows[t] = w->active[t] && s <= w->steps[t] ? w->data->row_at[at] : -1;
        any |= w->rows[t] >= 0;
    }
    return any;
}

/* A residual and its slope in the prediction: the definition of gbspec/ir/residuals.py, which a test compares with. */
static double residual(const Data *d, size_t row, int channel, double predicted, double *slope) {
    const double factor = d->factor[row * CHANNELS + channel], measured = d->measured[row * CHANNELS + channel];
    *slope = 0;
    if (!(factor > 0)) return 0;
    if (!d->logarithmic[channel]) {
        *slope = factor;
        return (predicted - measured) * factor;
    }
    const double size = fabs(measured) > 1e-300 ? fabs(measured) : 1e-300, ratio = predicted / size;
    const double safe = ratio < LOG_FLOOR ? LOG_FLOOR : ratio;
    *slope = factor / (size * safe);
    return (log(safe) + (ratio - safe) / LOG_FLOOR) * factor;
}

static void arrive(Work *w, int64_t s, real *x, double *residuals, double *arrivals) {
    const Data *d = w->data;
    real predicted[CHANNELS * TILE];
    double slope;
    if (!find_rows(w, s)) return;
    observe_forward(w, 0, x, predicted);
    for (int t = 0; t < TILE; t++) {
        if (w->rows[t] < 0) continue;
        const size_t row = w->rows[t];
        for (int i = 0; i < CHANNELS; i++)
            residuals[row * CHANNELS + i] = residual(d, row, i, predicted[i * TILE + t], &slope);
        for (int i = 0; i < STATES; i++) {
            real *state = &x[i * TILE + t];
            if (arrivals) arrivals[row * STATES + i] = *state;
            const real weight = R(d->weight[row * STATES + i]);
            if (weight != R(0)) *state -= weight * (*state - R(d->value[row * STATES + i]));
        }
    }
}

/* `x`: the state on arrival; `xb`: cotangent of the state after resets, then of that on arrival. */
static void arrive_reverse(Work *w, int64_t s, const real *x, const double *cotangent, real *xb) {
    const Data *d = w->data;
    real predicted[CHANNELS * TILE], ob[CHANNELS * TILE];
    if (!find_rows(w, s)) return;
    observe_forward(w, 0, x, predicted);
    for (int t = 0; t < TILE; t++) {
        if (w->rows[t] < 0) {
            for (int i = 0; i < CHANNELS; i++) ob[i * TILE + t] = 0;
            continue;
        }
        const size_t row = w->rows[t];
        for (int i = 0; i < STATES; i++) xb[i * TILE + t] *= R(1) - R(d->weight[row * STATES + i]);
        for (int i = 0; i < CHANNELS; i++) {
            double slope;
            const double own = residual(d, row, i, predicted[i * TILE + t], &slope);
            ob[i * TILE + t] = slope == 0 ? R(0) : R((cotangent ? cotangent[row * CHANNELS + i] : own) * slope);
        }
    }
    observe_reverse(w, 0, x, ob, xb, w->kb);
    for (int i = RHS_SITES; i < SITES; i++) net_gradient(w->sites[i].net, &w->sites[i], 0, TILE, 1);
}

/* ---------------------------------------------------------------- one tile */

static void segment_forward(Work *w, int64_t begin, int64_t end, real *x, double *residuals, double *arrivals) {
    for (int64_t s = begin; s < end; s++) {
        step_forward(w, s, (size_t)(s - begin), x);
        memcpy(w->arrivals + (size_t)(s - begin) * STATES * TILE, x, STATES * TILE * sizeof(real));
        arrive(w, s + 1, x, residuals, arrivals);
    }
}

static void segment_reverse(Work *w, int64_t begin, int64_t end, const double *cotangent, real *xb) {
    for (int64_t s = end - 1, pending = 0; s >= begin; s--) {
        const size_t slot = (size_t)(s - begin);
        arrive_reverse(w, s + 1, w->arrivals + slot * STATES * TILE, cotangent, xb);
        step_reverse(w, s, slot, xb);
        /* The weights' products wait for some steps, so that a block of sums stays in registers for longer. */
        if (++pending == WEIGHT_STEPS || s == begin) {
            for (int i = 0; i < RHS_SITES; i++)
                if (kept(i))
                    net_gradient(w->sites[i].net, &w->sites[i], slot * STAGES * TILE, (size_t)pending * STAGES * TILE, 1);
            pending = 0;
        }
    }
}

static void run_tile(Work *w, const double *initial, const double *cotangent, double *residuals, double *arrivals,
                     double *d_constants, double *d_initial, int gradient) {
    const size_t block = STATES * TILE;
    real x[STATES * TILE], start[STATES * TILE], xb[STATES * TILE];
    for (int i = 0; i < STATES; i++)
        for (int t = 0; t < TILE; t++) x[i * TILE + t] = R(initial[w->who[t] * STATES + i]);
    memcpy(start, x, sizeof start);
    still_forward(w);
    arrive(w, 0, x, residuals, arrivals);
    for (int64_t begin = 0; begin < w->depth; begin += w->segment) {
        const int64_t end = begin + w->segment < w->depth ? begin + w->segment : w->depth;
        memcpy(w->checkpoints + (size_t)(begin / w->segment) * block, x, sizeof x);
        segment_forward(w, begin, end, x, residuals, arrivals);
    }
    if (!gradient) return;
    zero(xb, block);
    memset(w->kb, 0, sizeof w->kb);
    for (int i = 0; i < RHS_SITES; i++)
        if (SITE_STILL[i]) zero(w->sites[i].yb, TILE * w->sites[i].net->size[w->sites[i].net->layers]);
    for (int64_t begin = w->depth ? (w->depth - 1) / w->segment * w->segment : -1; begin >= 0; begin -= w->segment) {
        const int64_t end = begin + w->segment < w->depth ? begin + w->segment : w->depth;
        if (end < w->depth) {
            memcpy(x, w->checkpoints + (size_t)(begin / w->segment) * block, sizeof x);
            segment_forward(w, begin, end, x, residuals, NULL);
        }
        segment_reverse(w, begin, end, cotangent, xb);
    }
    arrive_reverse(w, 0, start, cotangent, xb);
    for (int i = 0; i < RHS_SITES; i++)
        if (SITE_STILL[i]) {
            net_backward(w->sites[i].net, &w->sites[i], 0, 0u);
            net_gradient(w->sites[i].net, &w->sites[i], 0, TILE, 1);
        }
    add_to_totals(w);
    for (int t = 0; t < TILE; t++) {
        if (!w->active[t]) continue;
        for (int i = 0; i < STATES; i++) d_initial[w->who[t] * STATES + i] = xb[i * TILE + t];
        for (int i = 0; i < LEARNABLES; i++) d_constants[w->who[t] * LEARNABLES + i] = w->kb[i * TILE + t];
    }
}

/* ---------------------------------------------------------------- what is called from outside */

/* Bytes of work space for trajectories of at most `depth` steps. */
int64_t work_bytes(int64_t depth) {
    Work work;
    char *base = (char *)(uintptr_t)4096; /* nothing is read or written there */
    const size_t head = (sizeof work + 63) / 64 * 64;
    return (int64_t)((size_t)(arrange(&work, base, depth) - base) + head + 64);
}

/* The trajectories `order[0..count)`, of which this call takes every `stride`-th tile from `first` on: residuals
   [rows][CHANNELS], states on arrival [rows][STATES] (unless NULL), and, if `gradient`, the product of `cotangent`
   [rows][CHANNELS] (NULL: the residuals themselves) with the residuals' Jacobian: of `weights` (layer by layer, network
   by network), of each trajectory's learnable constants, of its initial state, of jumps and, if TIMED, of the times of
   those that cut sub-steps (added to `d_times`, which is zero at first). `work` has `work_bytes` bytes. */
void run(const Data *data, const int64_t *order, int64_t count, int64_t first, int64_t stride, const double *weights,
         const double *numbers, const double *constants, const double *initial, const double *jumps,
         const double *cotangent, double *residuals, double *arrivals, double *d_weights, double *d_constants,
         double *d_initial, double *d_jumps, double *d_times, int32_t gradient, char *work) {
    Work *w = (Work *)(((uintptr_t)work + 63) / 64 * 64);
    w->data = data;
    w->jumps = jumps;
    w->d_jumps = d_jumps;
    w->d_times = d_times;
    arrange(w, (char *)w + (sizeof *w + 63) / 64 * 64, data->depth);
    set_weights(w, weights);
    for (int i = 0; i < NUMBERS; i++) w->numbers[i] = R(numbers[i]);
    for (int64_t begin = first * TILE; begin < count; begin += stride * TILE) {
        w->depth = 0;
        for (int t = 0; t < TILE; t++) {
            w->active[t] = begin + t < count;
            const int64_t who = order[w->active[t] ? begin + t : begin];
            set_lane(w, t, who, 0, data->steps[who], constants);
        }
        run_tile(w, initial, cotangent, residuals, arrivals, d_constants, d_initial, gradient);
    }
    if (gradient) write_gradient(w, d_weights);
}
