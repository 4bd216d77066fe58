/* Sub-steps that events cut, in reverse: derivatives through the times of events, which are implicit functions, and through
   what events do. */

/* What cotangents of time and inputs say about a time. */
static double moved_by(const Crossing *c, const real *tb, const real *ub) {
    double sum = tb[0];
    for (int j = 0; j < INPUTS; j++) sum += ub[j] * (c->last[j] - c->first[j]) / c->unit;
    return sum;
}

typedef struct {
    double of_start, of_length; /* cotangents of a part's start, at a fixed length, and of its length */
} Moved;

#if MATRICES
/* A Runge-Kutta stage's division in reverse: `ob` becomes the cotangent of its right-hand side, `vb` that of what was
   added; returns that of the step's length, by which the matrix is multiplied. */
static double divide_back(const Work *w, int q, real *ob, real *vb) {
    real sum[STATES];
    double of_length = 0;
    for (int i = 0; i < STATES; i++) vb[i] = -ob[i];
    divide(w->part, w->exchanges, 1, ob);
    for (int i = 0; i < STATES; i++) vb[i] += ob[i];
    zero(sum, STATES);
    add_weighted(q, TABLEAU_V[q], (real(*)[STATES])w->rates, sum);
    for (int i = 0; i < STATES; i++)
        for (int j = 0; j < STATES; j++) of_length += GAMMA * ob[i] * w->jacobian[i * STATES + j] * (rate(w, 0, q)[j] + sum[j]);
    return of_length;
}
#endif

/* The reverse of the step that `step_within` has just taken. `xb`: cotangent of its end, then of its start. */
static Moved reverse_within(Work *w, const Crossing *c, double at, double size, real *xb, double *kb) {
    real sb[STAGES][STATES], ob[STATES], u[INPUTS + 1], tb[1], ub[INPUTS + 1], time[1];
    real hb[1] = {0};
#if MATRICES
    real vb[STAGES][STATES];
#endif
    Moved out = {0, 0};
    for (int q = 0; q < STAGES; q++) length_reverse(TABLEAU_B[q], xb, rate(w, 0, q), hb);
    for (int q = STAGES - 1; q >= 0; q--) {
        zero(ob, STATES);
        add_weighted(1, &TABLEAU_B[q], (real(*)[STATES])xb, ob);
        for (int p = q + 1; p < STAGES; p++) add_weighted(1, &TABLEAU_A[p][q], &sb[p], ob);
        for (int i = 0; i < STATES; i++) ob[i] *= R(size);
#if MATRICES
        for (int p = q + 1; p < STAGES; p++) add_weighted(1, &TABLEAU_V[p][q], &vb[p], ob);
        out.of_length += divide_back(w, q, ob, vb[q]);
#endif
        time[0] = R(at + TABLEAU_C[q] * size);
        inputs_within(c, at + TABLEAU_C[q] * size, u);
        zero(sb[q], STATES);
        zero(tb, 1);
        zero(ub, INPUTS + 1);
        rhs_reverse(w, (size_t)q, w->states + (size_t)q * STATES, time, u, ob, sb[q], kb, tb, ub);
        for (int p = 0; p < q; p++) length_reverse(TABLEAU_A[q][p], sb[q], rate(w, 0, p), hb);
        const double moved = moved_by(c, tb, ub);
        out.of_start += moved;
        out.of_length += TABLEAU_C[q] * moved;
    }
    out.of_length += hb[0];
    for (int q = 0; q < STAGES; q++)
        for (int i = 0; i < STATES; i++) xb[i] += sb[q][i];
    return out;
}

/* The events at the start of a part, in reverse; returns the cotangent of their time. */
static double happen_back(Work *w, Crossing *c, const Piece *p, const real *base, real *xb) {
    real u[INPUTS + 1], ob[STATES], tb[1], ub[INPUTS + 1], now[1] = {R(p->at)};
    double moved = 0;
    inputs_within(c, p->at, u);
    memcpy(c->chain, base, STATES * sizeof(real));
    for (int n = 0; n < p->count; n++)
        happen_forward(w, c->fired[p->first + n], c->chain + n * STATES, now, u, c->chain + (n + 1) * STATES);
    for (int n = p->count - 1; n >= 0; n--) {
        memcpy(ob, xb, sizeof ob);
        zero(xb, STATES);
        zero(tb, 1);
        zero(ub, INPUTS + 1);
        happen_reverse(w, c->fired[p->first + n], c->chain + n * STATES, now, u, ob, xb, w->kb, tb, ub);
        moved += moved_by(c, tb, ub);
    }
    return moved;
}

/* The step of a part, in reverse, with the weights' gradients. */
static Moved piece_back(Work *w, const Crossing *c, const Piece *p, real *xb) {
    step_within(w, c, p->at, p->size, p->x, (real[STATES]){0});
    const Moved moved = reverse_within(w, c, p->at, p->size, xb, w->kb);
    for (int i = 0; i < RHS_SITES; i++) net_gradient(w->sites[i].net, &w->sites[i], 0, STAGES, 1);
    return moved;
}

/* What the cotangent `xb` of a part's end says about its length. */
static double length_back(Work *w, const Crossing *c, const Piece *p, const real *xb) {
    real copy[STATES];
    double kb[LEARNABLES + 1];
    memcpy(copy, xb, sizeof copy);
    memset(kb, 0, sizeof kb);
    step_within(w, c, p->at, p->size, p->x, (real[STATES]){0});
    return reverse_within(w, c, p->at, p->size, copy, kb).of_length;
}

/* A part that ends where a condition becomes true, in reverse. `moved`: the cotangent of the time of its end; returns
   that of its start. The length is an implicit function: g(start, length, x, constants) = 0. */
static double guarded_back(Work *w, const Crossing *c, const Piece *p, double moved, real *xb) {
    real u[INPUTS + 1], ob[GUARDS + 1], gb[STATES], tb[1], ub[INPUTS + 1], now[1] = {R(p->at + p->size)};
    double kb[LEARNABLES + 1];
    zero(ob, GUARDS + 1);
    zero(gb, STATES);
    zero(tb, 1);
    zero(ub, INPUTS + 1);
    memset(kb, 0, sizeof kb);
    ob[p->which - TIMED_EVENTS] = 1;
    inputs_within(c, p->at + p->size, u);
    guards_reverse(w, 0, p->reached, now, u, ob, gb, kb, tb, ub);
    const double of_time = moved_by(c, tb, ub), pace = length_back(w, c, p, gb) + of_time;
    const double bar = -(length_back(w, c, p, xb) + moved) / (pace != 0 ? pace : 1);
    for (int i = 0; i < STATES; i++) xb[i] += R(bar) * gb[i];
    for (int i = 0; i < LEARNABLES; i++) w->kb[i] += bar * kb[i];
    return moved + bar * of_time + piece_back(w, c, p, xb).of_start;
}

/* `xb`: on entry the cotangent of the state after sub-step s, on return of that before the arrivals at its start. */
static void cross_back(Work *w, int64_t s, const real *start, real *xb) {
    Crossing *c = w->crossing;
    real x[STATES];
    double moved = 0, of_end = 0; /* cotangents of the time where a part ends, with the sub-step's end fixed, and of that */
    memcpy(x, start, sizeof x);
    cross(w, s, x);
    for (int n = c->count - 1; n >= 0; n--) {
        const Piece *p = &c->pieces[n];
        if (SWITCHES) memcpy(w->side, p->side, sizeof w->side);
        if (p->which >= TIMED_EVENTS) {
            moved = guarded_back(w, c, p, moved, xb);
        } else {
            const Moved own = piece_back(w, c, p, xb);
            if (p->which >= 0) timing_reverse(w, p->which, own.of_length + moved, p->turn, w->kb);
            else of_end = own.of_length;
            moved = own.of_start - own.of_length;
        }
        moved += happen_back(w, c, p, n ? c->pieces[n - 1].reached : c->entry, xb);
    }
    const int32_t begins = cut_of(w, s, 0), ends = cut_of(w, s + 1, 0);
    if (begins >= 0) w->d_times[begins] += moved;
    if (ends >= 0) w->d_times[ends] += of_end;
    for (int32_t j = arrival_of(w, s, 0); j >= 0; j = w->data->arrival_next[j])
        w->d_amounts[j] = xb[w->data->arrival_state[j]];
}

/* ---------------------------------------------------------------- the interface of a step */

/* Counts what happened in the sub-step that was solved last. */
static void count_events(const Work *w, const Outputs *out) {
    const Crossing *c = w->crossing;
    for (int n = 0; n < c->fired_count; n++) out->happened[w->who[0] * EVENTS + c->fired[n]]++;
    out->endless[w->who[0]] |= c->endless;
    out->uncut[w->who[0]] += c->uncut;
}

static void step_forward(Work *w, int64_t s, size_t slot, real *x) {
    memcpy(w->starts + slot * STATES, x, STATES * sizeof(real));
    cross(w, s, x);
}

static void step_reverse(Work *w, int64_t s, size_t slot, real *xb) { cross_back(w, s, w->starts + slot * STATES, xb); }
