/* ---------------------------------------------------------------- over time */

/* The value of an input at a time (at a jump the value after it), and its slope just after that time. */
static double course(const PREFIX_course *input, int linear, double t, double *slope) {
    const double *times = input->times, *values = input->values;
    int low = 0, high = input->count;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (times[middle] <= t) low = middle + 1;
        else high = middle;
    }
    *slope = 0.0;
    if (low == 0) return values[0];
    if (!linear || low == input->count) return values[low - 1];
    *slope = (values[low] - values[low - 1]) / (times[low] - times[low - 1]);
    return values[low - 1] + *slope * (t - times[low - 1]);
}

/* When a dose arrives: within rounding of the start or of an output it arrives there, after the output. */
static double arrival(double time, double start, int count, const double *times) {
    const double end = times[count - 1];
    const double size = fabs(end) > end - start ? fabs(end) : end - start;
    double best = start;
    int low = 0, high = count, i;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (times[middle] <= time) low = middle + 1;
        else high = middle;
    }
    for (i = low > 0 ? low - 1 : 0; i < count && i <= low; i++)
        if (fabs(times[i] - time) < fabs(best - time)) best = times[i];
    return fabs(best - time) <= 1e-9 * size ? best : time;
}

/* The end of the piece that begins at t: the next change of an input, dose or, at the latest, `end`. */
static double next_cut(const PREFIX_course *inputs, const PREFIX_course *doses, const double *lag, double t, double start,
                       int count, const double *times) {
    double next = times[count - 1];
    int j, k;
    for (j = 0; j < PREFIX_INPUTS; j++)
        for (k = 0; k < inputs[j].count; k++)
            if (inputs[j].times[k] > t && inputs[j].times[k] < next) next = inputs[j].times[k];
    for (j = 0; doses && j < PREFIX_DOSES; j++)
        for (k = 0; k < doses[j].count; k++) {
            const double at = arrival(doses[j].times[k] + lag[j], start, count, times);
            if (at > t && at < next) next = at;
        }
    return next;
}

/* Adds the doses that arrive at the beginning t of a piece. */
static void give(const PREFIX_course *doses, const double *fraction, const double *lag, double t, double start, int count,
                 const double *times, double *x) {
    int j, k;
    for (j = 0; doses && j < PREFIX_DOSES; j++)
        for (k = 0; k < doses[j].count; k++)
            if (arrival(doses[j].times[k] + lag[j], start, count, times) == t)
                x[DOSE_STATE[j]] += doses[j].values[k] * fraction[j];
}

/* Equal steps of at most `max_step` from `from` to `to` within a piece that begins at `begin`. */
static void advance(const PREFIX_parameters *p, const double *value, const double *slope, double begin, double from, double to,
                    double max_step, double *x) {
    const double wanted = ceil((to - from) / max_step - 1e-9);
    const long steps = wanted > 1.0 ? (long)wanted : 1;
    const double h = (to - from) / (double)steps;
    double u[PREFIX_NODES * PREFIX_INPUTS + 1];
    long i;
    int q, j;
    for (i = 0; i < steps; i++) {
        const double t = from + (double)i * h;
        for (q = 0; q < PREFIX_NODES; q++)
            for (j = 0; j < PREFIX_INPUTS; j++)
                u[q * PREFIX_INPUTS + j] = value[j] + slope[j] * (t + NODE[q] * h - begin);
        PREFIX_step(p, t, h, u, x);
    }
}

/* 1: a call with wrong arguments. */
static int wrong(double start, const PREFIX_course *inputs, int count, const double *times, double max_step) {
    int i;
    if (count < 1 || !(max_step > 0.0) || times[0] < start) return 1;
    for (i = 1; i < count; i++)
        if (!(times[i] > times[i - 1])) return 1;
    for (i = 0; i < PREFIX_INPUTS; i++)
        if (inputs[i].count < 1) return 1;
    return 0;
}

int PREFIX_simulate(const PREFIX_parameters *p, double start, const double *x0, const PREFIX_course *inputs,
                    const PREFIX_course *doses, int count, const double *times, double max_step, double *states,
                    double *channels) {
    double x[PREFIX_STATES], u[PREFIX_INPUTS + 1], value[PREFIX_INPUTS + 1], slope[PREFIX_INPUTS + 1];
    double fraction[PREFIX_DOSES + 1], lag[PREFIX_DOSES + 1], ignored, t = start;
    int next = 0, i;
    if (wrong(start, inputs, count, times, max_step)) return 1;
    for (i = 0; i < PREFIX_STATES; i++) x[i] = x0[i];
    PREFIX_initial(p, x);
    PREFIX_doses(p, fraction, lag);
    for (;;) {
        const double begin = t, cut = next_cut(inputs, doses, lag, t, start, count, times);
        for (i = 0; i < PREFIX_INPUTS; i++) value[i] = course(&inputs[i], LINEAR[i], t, &slope[i]);
        for (;;) { /* outputs at and within this piece */
            if (next < count && times[next] == t) {
                for (i = 0; i < PREFIX_INPUTS; i++) u[i] = course(&inputs[i], LINEAR[i], t, &ignored);
                for (i = 0; states && i < PREFIX_STATES; i++) states[next * PREFIX_STATES + i] = x[i];
                if (channels) PREFIX_observe(p, t, x, u, channels + next * PREFIX_CHANNELS);
                next++;
            }
            if (t == begin) give(doses, fraction, lag, t, start, count, times, x);
            if (next == count || t == cut) break;
            advance(p, value, slope, begin, t, times[next] < cut ? times[next] : cut, max_step, x);
            t = times[next] < cut ? times[next] : cut;
        }
        if (next == count) break;
    }
    for (i = 0; i < PREFIX_STATES; i++)
        if (!isfinite(x[i])) return 2;
    return 0;
}
