/* Key rows: residuals and resets, forward and in reverse. */

static int find_rows(Work *w, int64_t s) {
    int any = 0;
    for (int t = 0; t < TILE; t++) {
        const int64_t at = w->who[t] * (w->data->depth + 1) + s;
        w->rows[t] = w->active[t] && s <= w->steps[t] ? w->data->row_at[at] : -1;
        any |= w->rows[t] >= 0;
    }
    return any;
}

/* A residual and its slope in the prediction: the definition of gbspec/ir/residual.py; a test compares the two. */
static double residual(const Data *d, size_t row, int channel, double predicted, double *slope) {
    const double factor = d->factor[row * CHANNELS + channel], measured = d->measured[row * CHANNELS + channel];
    *slope = 0;
    if (!(factor > 0)) return 0;
    if (!d->logarithmic[channel]) {
        *slope = factor;
        return (predicted - measured) * factor;
    }
    const double size = fabs(measured) > LEAST_SIZE ? fabs(measured) : LEAST_SIZE, ratio = predicted / size;
    const double safe = ratio < LOG_FLOOR ? LOG_FLOOR : ratio;
    *slope = factor / (size * safe);
    return (log(safe) + (ratio - safe) / LOG_FLOOR) * factor;
}

static void arrive(Work *w, int64_t s, real *x, double *residuals, double *states) {
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
            if (states) states[row * STATES + i] = *state;
            const real weight = R(d->weight[row * STATES + i]), left = R(1) - weight;
            /* A full reset discards the state, even if it is infinite. */
            if (weight != R(0)) *state = weight * R(d->value[row * STATES + i]) + (left == R(0) ? R(0) : left * *state);
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
        for (int i = 0; i < STATES; i++) {
            const real left = R(1) - R(d->weight[row * STATES + i]);
            xb[i * TILE + t] = left == R(0) ? R(0) : xb[i * TILE + t] * left;
        }
        for (int i = 0; i < CHANNELS; i++) {
            double slope;
            const double own = residual(d, row, i, predicted[i * TILE + t], &slope);
            ob[i * TILE + t] = slope == 0 ? R(0) : R((cotangent ? cotangent[row * CHANNELS + i] : own) * slope);
        }
    }
    observe_reverse(w, 0, x, ob, xb, w->kb);
    for (int i = RHS_SITES; i < SITES; i++) net_gradient(w->sites[i].net, &w->sites[i], 0, TILE, 1);
}
