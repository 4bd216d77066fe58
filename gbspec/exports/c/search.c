/* ---------------------------------------------------------------- algebraic variables */

#define TICKS 60     /* most evaluations of equations and their derivatives in a search */
#define LEAST 1e-8   /* a smaller change, in sizes of the variables, is not tried */
#define ENOUGH 1e-4  /* of the fall of what is left that Newton's step promises */
#define INSIDE 0.9   /* of the way to an end of the range */
#define CLOSE_TO 9.034374752702698e-08 /* a step of this size, relative to the variables, ends the search */
#define CORRECTIONS 3

/* What is left of the equations of a search, and its derivative along a direction. */
static void left_over(int search, const PREFIX_parameters *p, double t, const double *x, const double *u,
                      const double *solved, double *out) {
    switch (search) {
LEFT
    }
}

static void left_over_along(int search, const PREFIX_parameters *p, double t, const double *x, const double *u,
                            const double *solved, const PREFIX_parameters *dp, double dt, const double *dx,
                            const double *du, const double *dsolved, double *out) {
    switch (search) {
ALONG
    }
}

/* Solves linear equations by elimination with pivots; no number where they have no single solution. */
static void divide(int n, const double *matrix, const double *right, double *out) {
    double a[LARGEST * LARGEST] = {0.0}, swap;
    int i, j, k, best;
    for (i = 0; i < n * n; i++) a[i] = matrix[i];
    for (i = 0; i < n; i++) out[i] = right[i];
    for (k = 0; k < n; k++) {
        best = k;
        for (i = k + 1; i < n; i++)
            if (fabs(a[i * n + k]) > fabs(a[best * n + k])) best = i;
        for (j = k; j < n; j++) swap = a[k * n + j], a[k * n + j] = a[best * n + j], a[best * n + j] = swap;
        swap = out[k], out[k] = out[best], out[best] = swap;
        for (i = k + 1; i < n; i++) {
            const double share = a[i * n + k] / a[k * n + k];
            for (j = k + 1; j < n; j++) a[i * n + j] -= share * a[k * n + j];
            out[i] -= share * out[k];
        }
    }
    for (k = n - 1; k >= 0; k--) {
        for (j = k + 1; j < n; j++) out[k] -= a[k * n + j] * out[j];
        out[k] = a[k * n + k] == 0.0 ? NAN : out[k] / a[k * n + k];
    }
}

/* What is left of equations, and its derivatives by the variables sought, row by row. */
static void linear(int search, const PREFIX_parameters *p, double t, const double *x, const double *u, const double *solved,
                   double *left, double *slopes) {
    double direction[PREFIX_ALGEBRAICS] = {0.0}, column[LARGEST];
    const int n = COUNT[search];
    int i, j;
    left_over(search, p, t, x, u, solved, left);
    for (j = 0; j < n; j++) {
        direction[FIRST[search] + j] = 1.0;
        left_over_along(search, p, t, x, u, solved, NULL, 0.0, NULL, NULL, direction, column);
        direction[FIRST[search] + j] = 0.0;
        for (i = 0; i < n; i++) slopes[i * n + j] = column[i];
    }
}

/* Newton's method from the starts of the variables, damped so that what is left falls and no variable leaves its range. */
static void seek(int search, const PREFIX_parameters *p, double t, const double *x, const double *u, double *solved) {
    const int n = COUNT[search], first = FIRST[search];
    const double *low = LOW + first, *high = HIGH + first, *scale = SIZE + first;
    double left[LARGEST], slopes[LARGEST * LARGEST], new_left[LARGEST], new_slopes[LARGEST * LARGEST], at[LARGEST];
    double step[LARGEST], weight[LARGEST], size = 1.0, merit = 0.0, room, longest, change, total;
    int i, j, tick, taken = 1, done = 0;
    double *trial = solved + first;
    for (i = 0; i < n; i++) trial[i] = START[first + i];
    linear(search, p, t, x, u, solved, new_left, new_slopes);
    for (tick = 0; tick < TICKS; tick++) {
        if (taken) {
            room = HUGE_VAL, change = merit = 0.0;
            for (i = 0; i < n * n; i++) slopes[i] = new_slopes[i];
            for (i = 0; i < n; i++) at[i] = trial[i], left[i] = new_left[i];
            divide(n, slopes, left, step);
            for (i = 0; i < n; i++) {
                step[i] = -step[i];
                total = 0.0;
                for (j = 0; j < n; j++) total += fabs(slopes[i * n + j]) * scale[j];
                weight[i] = 1.0 / (total > 0.0 ? total : 1.0);
                merit = gb_max(merit, fabs(left[i]) * weight[i]);
                change = gb_max(change, fabs(step[i]) / (fabs(at[i]) + scale[i]));
                room = gb_min(room, (step[i] > 0.0 ? high[i] - at[i] : at[i] - low[i]) / (fabs(step[i]) + 1e-300));
            }
            done = change <= CLOSE_TO;
            size = room >= 1.0 ? 1.0 : INSIDE * room;
        } else size *= 0.5;
        longest = 0.0;
        for (i = 0; i < n; i++) longest = gb_max(longest, fabs(step[i]) / scale[i]);
        if (done || !(size * longest >= LEAST)) break;
        for (i = 0; i < n; i++) trial[i] = at[i] + size * step[i];
        linear(search, p, t, x, u, solved, new_left, new_slopes);
        total = 0.0;
        for (i = 0; i < n; i++) total = gb_max(total, fabs(new_left[i]) * weight[i]);
        taken = total <= (1.0 - ENOUGH * size) * merit;
    }
    for (i = 0; i < n; i++) trial[i] = done ? at[i] : NAN;
    for (tick = 0; tick < CORRECTIONS; tick++) {
        left_over(search, p, t, x, u, solved, left);
        divide(n, slopes, left, step);
        for (i = 0; i < n; i++) trial[i] -= step[i];
    }
}

void PREFIX_algebraic(const PREFIX_parameters *p, double t, const double *x, const double *u, double *values) {
    int search;
    for (search = 0; search < SEARCHES; search++) seek(search, p, t, x, u, values);
}

/* The derivatives of the solution, by those of the equations. */
static void solved_along(const PREFIX_parameters *p, double t, const double *x, const double *u, const double *solved,
                         const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out) {
    double left[LARGEST], slopes[LARGEST * LARGEST], moved[LARGEST], fall[LARGEST];
    int search, i;
    for (i = 0; i < PREFIX_ALGEBRAICS; i++) out[i] = 0.0;
    for (search = 0; search < SEARCHES; search++) {
        linear(search, p, t, x, u, solved, left, slopes);
        left_over_along(search, p, t, x, u, solved, dp, dt, dx, du, out, moved);
        divide(COUNT[search], slopes, moved, fall);
        for (i = 0; i < COUNT[search]; i++) out[FIRST[search] + i] = -fall[i];
    }
}

void PREFIX_algebraic_along(const PREFIX_parameters *p, double t, const double *x, const double *u,
                            const PREFIX_parameters *dp, double dt, const double *dx, const double *du, double *out) {
    double solved[PREFIX_ALGEBRAICS];
    PREFIX_algebraic(p, t, x, u, solved);
    solved_along(p, t, x, u, solved, dp, dt, dx, du, out);
}
