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

/* The logarithm of the normal distribution function; beyond 20 by the asymptotic series of Mills' ratio. */
static double log_probability(double z) {
    if (z > 0) return log1p(-0.5 * erfc(z * 0.70710678118654752440));
    if (z > -20) return log(0.5 * erfc(-z * 0.70710678118654752440));
    const double s = 1 / (z * z);
    return -0.5 * z * z - log(-z) - 0.91893853320467274178 + log1p(-s * (1 - 3 * s * (1 - 5 * s * (1 - 7 * s))));
}

/* The residual of a limit and its slope from those of a known value: the definition of gbspec/ir/censoring.py. */
static double censored(double plain, int side, double level, double *slope) {
    const double violation = -side * plain;
    if (!(level > 0)) {
        if (!(violation > 0)) *slope = 0;
        return violation > 0 ? plain : violation <= 0 ? 0 : violation;
    }
    const double z = violation / level, logs = log_probability(-z), square = -2 * logs;
    const double root = sqrt(square > 1e-300 ? square : 1e-300);
    const double power = -0.5 * z * z - 0.91893853320467274178 - logs;
    *slope *= square > 1e-300 ? exp(power < 700 ? power : 700) / root : 0;
    return -side * level * root;
}

/* T of a count and its slope: the definition of gbspec/ir/residual.py. */
static double stabilised(double value, double size, double *slope) {
    const double below = value < 0 ? value : 0, shifted = value - below + COUNT_SHIFT;
    *slope = 1 / sqrt(shifted * (1 + shifted / size));
    const double root = sqrt(shifted), t = isfinite(size) ? sqrt(size) * asinh(root / sqrt(size)) : root;
    return 2 * t + below * *slope;
}

/* The residual of a known value: the definition of gbspec/ir/residual.py; a test compares the two. */
static double plain_residual(const Data *d, size_t row, int channel, double predicted, double *slope) {
    const double factor = d->factor[row * CHANNELS + channel], measured = d->measured[row * CHANNELS + channel];
    *slope = 0;
    if (!(factor > 0)) return 0;
    if (d->sizes && d->sizes[channel] > 0) {
        double unused;
        const double found = stabilised(predicted, d->sizes[channel], slope) - stabilised(measured, d->sizes[channel], &unused);
        *slope *= factor;
        return found * factor;
    }
    if (!d->logarithmic[channel]) {
        *slope = factor;
        return (predicted - measured) * factor;
    }
    const double size = fabs(measured) > LEAST_SIZE ? fabs(measured) : LEAST_SIZE, ratio = predicted / size;
    const double safe = ratio < LOG_FLOOR ? LOG_FLOOR : ratio;
    *slope = factor / (size * safe);
    return (log(safe) + (ratio - safe) / LOG_FLOOR) * factor;
}

/* A residual and its slope in the prediction. */
static double residual(const Data *d, size_t row, int channel, double predicted, double *slope) {
    const double plain = plain_residual(d, row, channel, predicted, slope);
    const int side = d->side ? d->side[row * CHANNELS + channel] : 0;
    return side ? censored(plain, side, d->level[channel], slope) : plain;
}

/* The resets at a key row. A full one discards the state, even if it is infinite. */
static void reset(const Data *d, size_t row, int t, real *x) {
    for (int i = 0; i < STATES; i++) {
        real *state = &x[i * TILE + t];
        const real weight = R(d->weight[row * STATES + i]), left = R(1) - weight;
        if (weight != R(0)) *state = weight * R(d->value[row * STATES + i]) + (left == R(0) ? R(0) : left * *state);
    }
}

/* `again`: sub-steps are solved again, and states are not stored. */
static void arrive(Work *w, int64_t s, real *x, const Outputs *out, int again) {
    const Data *d = w->data;
    real predicted[CHANNELS * TILE];
    double slope;
    if (!find_rows(w, s)) return;
    observe_forward(w, 0, x, predicted);
    for (int t = 0; t < TILE; t++) {
        if (w->rows[t] < 0) continue;
        const size_t row = w->rows[t];
        for (int i = 0; i < CHANNELS; i++)
            out->residuals[row * CHANNELS + i] = residual(d, row, i, predicted[i * TILE + t], &slope);
        for (int i = 0; i < STATES && !again; i++) out->states[row * STATES + i] = x[i * TILE + t];
#if DELAYS
        for (int i = 0; i < DELAYS; i++) out->late[row * DELAYS + i] = w->seen[i * TILE + t];
#endif
        reset(d, row, t, x);
    }
}

/* `x`: the state on arrival; `xb`: cotangent of the state after resets, then of that on arrival. */
static void arrive_reverse(Work *w, int64_t s, const real *x, const double *cotangent, real *xb) {
    const Data *d = w->data;
    real predicted[CHANNELS * TILE], ob[CHANNELS * TILE];
#if DELAYS
    zero(w->seen_bar, DELAYS * TILE);
#endif
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
