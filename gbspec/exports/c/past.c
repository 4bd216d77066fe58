/* ---------------------------------------------------------------- delays */

#define WAVES 6      /* so many delays after a jump steps still end where it shows again */
#define SIDE 1e-9    /* the share of a distance by which a time between two steps counts to one of them */
#define EQUAL 1e-10  /* the share of a time within which two times are equal */

static double equal_within(double t) { return EQUAL * fabs(t); }

void PREFIX_begin(const PREFIX_parameters *p, double t, const double *x, const double *u, PREFIX_past *past) {
    int i;
    past->start = t;
    past->marks = past->first = past->count = 0;
    for (i = 0; i < PREFIX_STATES; i++) past->x[i] = x[i];
    for (i = 0; i < PREFIX_INPUTS; i++) past->u[i] = u[i];
    PREFIX_jump(p, t, past);
}

double PREFIX_shortest(const PREFIX_parameters *p) {
    double lags[LAGS], found = HUGE_VAL;
    int i;
    PREFIX_lags(p, lags);
    for (i = 0; i < LAGS; i++)
        if (!(lags[i] >= found)) found = lags[i];
    return found;
}

static const PREFIX_piece *piece_at(const PREFIX_past *past, int number) {
    return &past->piece[(past->first + number) % PREFIX_PIECES];
}

/* The number of the step that a time belongs to; -1: the first one begins later. */
static int piece_of(const PREFIX_past *past, double t) {
    int low = 0, high = past->count;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (piece_at(past, middle)->t <= t) low = middle + 1;
        else high = middle;
    }
    return low - 1;
}

/* State and inputs at an earlier time, and how they change along it and along the direction (dp, `from` and `given` of state
   and inputs at the start). */
static void looked_up(const PREFIX_parameters *p, const PREFIX_past *past, double t, double toward, double *x, double *u,
                      const PREFIX_parameters *dp, double dt, const double *from, const double *given, double *dx,
                      double *du) {
    const double near_by = t + SIDE * (toward - t);
    const int number = piece_of(past, near_by);
    int i;
    if (number < 0) {
        for (i = 0; i < PREFIX_STATES; i++) x[i] = past->x[i];
        for (i = 0; i < PREFIX_INPUTS; i++) u[i] = past->u[i];
        if (near_by < past->start) PREFIX_history(p, t, past->x, x);
        if (!dx) return;
        for (i = 0; i < PREFIX_STATES; i++) dx[i] = from ? from[i] : 0.0;
        for (i = 0; i < PREFIX_INPUTS; i++) du[i] = given ? given[i] : 0.0;
        if (near_by < past->start) history_along(p, t, past->x, dp, dt, from, dx);
    } else {
        const PREFIX_piece *s = piece_at(past, number);
        const double share = (t - s->t) / s->h, h = s->h;
        for (i = 0; i < PREFIX_STATES; i++) {
            const double whole = s->x1[i] - s->x0[i], early = h * s->f0[i] - whole, late = whole - h * s->f1[i];
            const double bend = (1.0 - share) * early + share * late;
            x[i] = s->x0[i] + share * whole + share * (1.0 - share) * bend;
            if (dx) dx[i] = dt / h * (whole + (1.0 - 2.0 * share) * bend + share * (1.0 - share) * (late - early));
        }
        for (i = 0; i < PREFIX_INPUTS; i++) {
            u[i] = s->u0[i] + share * (s->u1[i] - s->u0[i]);
            if (du) du[i] = dt / h * (s->u1[i] - s->u0[i]);
        }
    }
}

void PREFIX_late(const PREFIX_parameters *p, const PREFIX_past *past, double t, double toward, double *values) {
    double lags[LAGS], x[PREFIX_STATES], u[PREFIX_INPUTS + 1], found[PREFIX_DELAYS];
    int i, k;
    PREFIX_lags(p, lags);
    for (k = 0; k < LAGS; k++) {
        looked_up(p, past, t - lags[k], toward - lags[k], x, u, NULL, 0.0, NULL, NULL, NULL, NULL);
        PREFIX_delayed(p, t - lags[k], x, u, found);
        for (i = 0; i < PREFIX_DELAYS; i++)
            if (DELAY_LAG[i] == k) values[i] = found[i];
    }
}

void PREFIX_late_along(const PREFIX_parameters *p, const PREFIX_past *past, double t, double toward,
                       const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out) {
    double lags[LAGS], moved[LAGS], x[PREFIX_STATES], u[PREFIX_INPUTS + 1], found[PREFIX_DELAYS];
    double early_dx[PREFIX_STATES], early_du[PREFIX_INPUTS + 1];
    int i, k;
    PREFIX_lags(p, lags);
    lags_along(p, dp, moved);
    for (k = 0; k < LAGS; k++) {
        const double s = t - lags[k], ds = dt - moved[k];
        looked_up(p, past, s, toward - lags[k], x, u, dp, ds, dx, du, early_dx, early_du);
        delayed_along(p, s, x, u, dp, ds, early_dx, early_du, found);
        for (i = 0; i < PREFIX_DELAYS; i++)
            if (DELAY_LAG[i] == k) out[i] = found[i];
    }
}

/* Adds the times a delay after t to those to come, but not those that are there. */
static void show_again(const PREFIX_parameters *p, double t, int wave, PREFIX_past *past) {
    double lags[LAGS];
    int i, k;
    PREFIX_lags(p, lags);
    for (k = 0; k < LAGS; k++) {
        const double at = t + lags[k];
        for (i = 0; i < past->marks && fabs(past->mark[i] - at) > equal_within(at); i++) continue;
        if (i < past->marks && past->wave[i] > wave) past->wave[i] = wave;
        if (i < past->marks || i == PREFIX_MARKS || !(lags[k] > 0.0)) continue;
        past->mark[i] = at;
        past->wave[i] = wave;
        past->marks++;
    }
}

void PREFIX_jump(const PREFIX_parameters *p, double t, PREFIX_past *past) { show_again(p, t, 1, past); }

void PREFIX_reach(const PREFIX_parameters *p, double t, PREFIX_past *past) {
    int i = 0;
    while (i < past->marks) {
        if (past->mark[i] <= t + equal_within(t)) {
            const double at = past->mark[i];
            const int wave = past->wave[i];
            past->marks--;
            past->mark[i] = past->mark[past->marks];
            past->wave[i] = past->wave[past->marks];
            if (wave < WAVES) show_again(p, at, wave + 1, past);
            i = 0;
        } else i++;
    }
}

double PREFIX_mark(const PREFIX_past *past) {
    double next = HUGE_VAL;
    int i;
    for (i = 0; i < past->marks; i++)
        if (past->mark[i] < next) next = past->mark[i];
    return next;
}

int PREFIX_keep(const PREFIX_parameters *p, const PREFIX_piece *step, PREFIX_past *past) {
    double lags[LAGS], longest = 0.0;
    int i;
    PREFIX_lags(p, lags);
    for (i = 0; i < LAGS; i++)
        if (lags[i] > longest) longest = lags[i];
    if (past->count == PREFIX_PIECES) { /* the oldest step makes room, unless it is still looked at */
        if (piece_at(past, 1)->t > step->t + step->h - longest) return 1;
        past->first = (past->first + 1) % PREFIX_PIECES;
        past->count--;
    }
    past->piece[(past->first + past->count) % PREFIX_PIECES] = *step;
    past->count++;
    return 0;
}

