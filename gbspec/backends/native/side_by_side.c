/* Steps of all lanes, tried side by side, in models without events. */

#if MATRICES
/* Copies the slopes of activations, which a reverse pass overwrites, from the first block to the second one, which the
   choice of steps does not use, or back. */
static void copy_first_block(const Work *w, int back) {
    for (int i = 0; i < RHS_SITES; i++) {
        const Site *site = &w->sites[i];
        for (int l = 1; kept(i) && l < site->net->layers; l++) {
            const size_t n = TILE * PAD(site->net->size[l]);
            memcpy(site->slope[l] + (back ? 0 : n), site->slope[l] + (back ? n : 0), n * sizeof(real));
        }
    }
}

/* The Jacobian of the right-hand side at the start of the steps of lanes that have none yet. */
static void find_slopes(Control *c) {
    real ob[STATES * TILE], xb[STATES * TILE], tb[TILE], ub[INPUTS * TILE + 1];
    double kb[LEARNABLES * TILE + 1];
    int all = 1;
    for (int t = 0; t < TILE; t++) all = all && (c->known[t] || !c->going[t]);
    if (all) return;
    copy_first_block(c->w, 0);
    for (int g = 0; g < GROUPS; g++) {
        if (g) copy_first_block(c->w, 1);
        zero(xb, STATES * TILE);
        for (int i = 0; i < STATES * TILE; i++) ob[i] = GROUP[i / TILE] == g;
        invariant_start(c->w);
        rhs_reverse(c->w, 0, c->x, c->time, c->inputs, ob, xb, kb, tb, ub);
        for (int t = 0; t < TILE; t++)
            if (!c->known[t]) take_rows(g, xb + t, TILE, c->slopes[t]);
    }
    for (int t = 0; t < TILE; t++) c->known[t] = 1;
}
#endif

/* The Runge-Kutta stages of the tried steps (the first one is known), and the states after them. */
static void try_steps(Control *c) {
    real sum[STATES * TILE], place[STATES * TILE];
    for (int q = 0; q < TRIED; q++) {
        if (q) {
            zero(sum, STATES * TILE);
            add_weighted(q, TABLEAU_A[q], c->k, sum);
            for (int i = 0; i < STATES * TILE; i++) place[i] = c->x[i] + R(c->h[i % TILE]) * sum[i];
            place_at(c, TABLEAU_C[q]);
            rhs_forward(c->w, 0, place, c->time, c->inputs, c->k[q]);
        }
#if MATRICES
        double b[STATES];
        zero(sum, STATES * TILE);
        add_weighted(q, TABLEAU_V[q], c->k, sum);
        for (int t = 0; t < TILE; t++) {
            if (!c->going[t]) continue;
            for (int i = 0; i < STATES; i++) b[i] = c->k[q][i * TILE + t] + sum[i * TILE + t];
            divide(c->lu[t], c->pivots[t], 0, b);
            for (int i = 0; i < STATES; i++) c->k[q][i * TILE + t] = R(b[i] - sum[i * TILE + t]);
        }
#endif
    }
    zero(sum, STATES * TILE);
    add_weighted(STAGES, TABLEAU_B, c->k, sum);
    for (int i = 0; i < STATES * TILE; i++) c->after[i] = c->x[i] + R(c->h[i % TILE]) * sum[i];
    memcpy(c->from, c->x, sizeof c->from);
    memcpy(c->tried, c->h, sizeof c->tried);
}

static void attempt(Control *c) {
#if MATRICES
    find_slopes(c);
    for (int t = 0; t < TILE; t++)
        if (c->going[t]) factorise_step(c->slopes[t], c->h[t], c->lu[t], c->pivots[t]);
#endif
    try_steps(c);
    for (int t = 0; t < TILE; t++)
        if (c->going[t]) decide(c, t, error_of(c, t));
}
