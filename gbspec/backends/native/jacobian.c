/* Derivatives of intervals between consecutive key rows: TILE intervals side by side, each a lane with its own
   sub-steps. One forward pass is followed by a reverse pass for each state, which computes a row of the interval's derivatives;
   the weights' products are formed for each lane separately. */

/* Work space that the derivatives need in addition to that of a solution. */
typedef struct {
    real *slopes;     /* copy from before the reverse pass, which overwrites them */
    real *cotangents; /* [STATES][STATES][TILE] */
} Kept;

static size_t slope_reals(const Work *w) {
    size_t n = 0;
    for (int i = 0; i < RHS_SITES; i++) {
        const Net *net = w->sites[i].net;
        for (int l = 1; l < net->layers; l++) n += (kept(i) ? (size_t)w->checkpoint_interval * STAGES : 1) * TILE * PAD(net->size[l]);
    }
    return n;
}

static char *arrange_kept(const Work *w, Kept *k, char *place) {
    k->slopes = take_real(&place, slope_reals(w) + 1);
    k->cotangents = take_real(&place, (size_t)STATES * STATES * TILE);
    return place;
}

/* Copies the slopes of the first `steps` stored sub-steps to `k` or back. */
static void copy_slopes(const Work *w, const Kept *k, size_t steps, int back) {
    real *place = k->slopes;
    for (int i = 0; i < RHS_SITES; i++) {
        const Net *net = w->sites[i].net;
        for (int l = 1; l < net->layers; l++) {
            const size_t n = (kept(i) ? steps * STAGES : 1) * TILE * PAD(net->size[l]);
            if (back) memcpy(w->sites[i].slope[l], place, n * sizeof(real));
            else memcpy(place, w->sites[i].slope[l], n * sizeof(real));
            place += n;
        }
    }
}

/* The reverse pass of one state over the stored sub-steps begin..end, and its contributions to rows of derivatives. */
static void reverse_state(Work *w, const Intervals *all, const int64_t *which, int state, int64_t begin, int64_t end,
                          real *xb) {
    memset(w->kb, 0, sizeof w->kb);
    invariant_start(w);
    w->d_amounts = all->d_amounts + (size_t)state * all->arrivals;
    w->d_times = all->d_times + (size_t)state * all->arrivals;
    if (EVENTS) zero(w->gradients, w->n_gradients); /* `step_reverse` adds to them */
    for (int64_t s = end - 1; s >= begin; s--) step_reverse(w, s, (size_t)(s - begin), xb);
    for (int i = 0; i < RHS_SITES; i++)
        if (SITE_INVARIANT[i]) net_backward(w->sites[i].net, &w->sites[i], 0, 0u);
    for (int t = 0; t < TILE; t++) {
        if (!w->active[t]) continue;
        const size_t row = (size_t)which[t] * STATES + state;
        for (int i = 0; i < LEARNABLES; i++) all->d_constants[row * LEARNABLES + i] += w->kb[i * TILE + t];
        const int64_t steps = (w->steps[t] < end ? w->steps[t] : end) - begin;
        if (!all->d_weights || steps <= 0) continue;
        if (!EVENTS) zero(w->gradients, w->n_gradients);
        for (int i = 0; i < RHS_SITES && !EVENTS; i++)
            net_gradient(w->sites[i].net, &w->sites[i], (size_t)t, SITE_INVARIANT[i] ? 1 : (size_t)steps * STAGES, TILE);
        write_lane(w, all->factor, all->shift, all->d_weights + row * all->columns);
    }
}

/* The derivatives of the intervals `which[0..TILE)`, one per lane. */
static void interval_tile(Work *w, const Intervals *all, const int64_t *which, const Kept *keep) {
    const size_t block = STATES * TILE;
    real x[STATES * TILE], *bars = keep->cotangents;
    for (int i = 0; i < STATES; i++)
        for (int t = 0; t < TILE; t++) x[i * TILE + t] = R(all->start[which[t] * STATES + i]);
    zero(bars, STATES * block);
    for (int i = 0; i < STATES; i++)
        for (int t = 0; t < TILE; t++) bars[i * block + i * TILE + t] = 1;
    invariant_forward(w);
    for (int64_t begin = 0; begin < w->depth; begin += w->checkpoint_interval) {
        const int64_t end = next_checkpoint(w, begin);
        memcpy(checkpoint_at(w, begin), x, sizeof x);
        for (int64_t s = begin; s < end; s++) step_forward(w, s, (size_t)(s - begin), x);
    }
    for (int64_t begin = last_checkpoint(w); begin >= 0; begin -= w->checkpoint_interval) {
        const int64_t end = next_checkpoint(w, begin);
        if (end < w->depth) {
            memcpy(x, checkpoint_at(w, begin), sizeof x);
            for (int64_t s = begin; s < end; s++) step_forward(w, s, (size_t)(s - begin), x);
        }
        invariant_forward(w); /* the reverse pass has overwritten its slopes */
        copy_slopes(w, keep, (size_t)(end - begin), 0);
        for (int i = 0; i < STATES; i++) {
            copy_slopes(w, keep, (size_t)(end - begin), 1);
            reverse_state(w, all, which, i, begin, end, bars + i * block);
        }
    }
    for (int t = 0; t < TILE; t++)
        for (int i = 0; i < STATES && w->active[t]; i++)
            for (int j = 0; j < STATES; j++)
                all->d_start[(which[t] * STATES + i) * STATES + j] = bars[i * block + j * TILE + t];
}

/* Bytes of work space for intervals of at most `depth` sub-steps. */
int64_t interval_bytes(int64_t depth) {
    Work work;
    Kept keep;
    return bytes_until(arrange_kept(&work, &keep, arrange(&work, BASE, depth)));
}

/* The derivatives of all intervals. */
void intervals(const Data *data, const Inputs *inputs, const Intervals *all, char *space) {
    Work *w = work_in(space);
    Kept keep;
    arrange_kept(w, &keep, open_work(w, data, inputs, all->depth));
    for (int64_t begin = 0; begin < all->count; begin += TILE) {
        int64_t which[TILE];
        w->depth = 0;
        for (int t = 0; t < TILE; t++) {
            w->active[t] = begin + t < all->count;
            which[t] = w->active[t] ? begin + t : begin;
            set_lane(w, t, all->owner[which[t]], all->first[which[t]], all->steps[which[t]]);
        }
        interval_tile(w, all, which, &keep);
    }
}

/* `sum` is the derivative of an owner's state at the start of an interval. At the end it becomes `d_start sum + own`;
   the residuals from `begin` to `end` there have its products with `d_state`; resets multiply it by `release`. */
void chain(const Links *links) {
    enum { WIDE = 256 };
    const int64_t columns = links->columns;
    double after[STATES][WIDE];
    for (int64_t r = 0; r < links->rows; r++) {
        double *whole = links->sum + links->owner[r] * STATES * columns;
        for (int64_t begin = 0; begin < columns; begin += WIDE) {
            const int64_t n = columns - begin < WIDE ? columns - begin : WIDE;
            for (int i = 0; i < STATES; i++) {
                memcpy(after[i], links->own + (r * STATES + i) * columns + begin, (size_t)n * sizeof(double));
                for (int j = 0; j < STATES; j++) {
                    const double a = links->d_start[(r * STATES + i) * STATES + j], *before = whole + j * columns + begin;
                    if (a != 0) for (int64_t c = 0; c < n; c++) after[i][c] += a * before[c];
                }
            }
            for (int64_t k = links->begin[r]; k < links->end[r]; k++) {
                double *row = links->out + k * columns + begin;
                memset(row, 0, (size_t)n * sizeof(double));
                for (int i = 0; i < STATES; i++) {
                    const double d = links->d_state[k * STATES + i];
                    if (d != 0) for (int64_t c = 0; c < n; c++) row[c] += d * after[i][c];
                }
            }
            for (int i = 0; i < STATES; i++) {
                const double left = links->release[r * STATES + i];
                double *place = whole + i * columns + begin;
                for (int64_t c = 0; c < n; c++) place[c] = left * after[i][c];
            }
        }
    }
}
