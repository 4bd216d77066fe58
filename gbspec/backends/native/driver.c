/* The unroll: tiles of TILE trajectories, each with its whole solution and reverse pass. */

/* `again`: the sub-steps were solved before. */
static void forward_to_checkpoint(Work *w, int64_t begin, int64_t end, real *x, const Outputs *out, int again) {
    for (int64_t s = begin; s < end; s++) {
        step_forward(w, s, (size_t)(s - begin), x);
#if EVENTS
        if (!again) count_events(w, out);
#endif
        memcpy(w->reached + (size_t)(s - begin) * STATES * TILE, x, STATES * TILE * sizeof(real));
#if DELAYS
        see_end(w, (size_t)(s - begin));
#endif
        arrive(w, s + 1, x, out, again);
    }
}

static void reverse_to_checkpoint(Work *w, int64_t begin, int64_t end, const double *cotangent, real *xb) {
    for (int64_t s = end - 1, pending = 0; s >= begin; s--) {
        const size_t slot = (size_t)(s - begin);
#if DELAYS
        see_end(w, slot);
#endif
        arrive_reverse(w, s + 1, w->reached + slot * STATES * TILE, cotangent, xb);
        step_reverse(w, s, slot, xb);
        /* The weights' products are deferred over some steps, so that a block of sums stays in registers for longer. */
        if (++pending == WEIGHT_STEPS || s == begin) {
            for (int i = 0; i < RHS_SITES && PLAIN; i++) /* else `step_reverse` has formed them */
                if (kept(i))
                    net_gradient(w->sites[i].net, &w->sites[i], slot * STAGES * TILE, (size_t)pending * STAGES * TILE, 1);
            pending = 0;
        }
    }
}

static void run_tile(Work *w, const Share *share, const Outputs *out) {
    const double *initial = w->inputs->initial;
    real x[STATES * TILE], start[STATES * TILE], xb[STATES * TILE];
    for (int i = 0; i < STATES; i++)
        for (int t = 0; t < TILE; t++) x[i * TILE + t] = R(initial[w->who[t] * STATES + i]);
    memcpy(start, x, sizeof start);
    invariant_forward(w);
#if DELAYS
    begin_past(w, x);
    see_start(w);
#endif
    arrive(w, 0, x, out, 0);
    for (int64_t begin = 0; begin < w->depth; begin += w->checkpoint_interval) {
        const int64_t end = next_checkpoint(w, begin);
        memcpy(checkpoint_at(w, begin), x, sizeof x);
        forward_to_checkpoint(w, begin, end, x, out, 0);
    }
    if (!share->gradient) return;
    zero(xb, STATES * TILE);
    memset(w->kb, 0, sizeof w->kb);
    invariant_start(w);
#if DELAYS
    clear_bars(w);
#endif
    for (int64_t begin = last_checkpoint(w); begin >= 0; begin -= w->checkpoint_interval) {
        const int64_t end = next_checkpoint(w, begin);
        if (end < w->depth) {
            memcpy(x, checkpoint_at(w, begin), sizeof x);
            forward_to_checkpoint(w, begin, end, x, out, 1);
        }
        reverse_to_checkpoint(w, begin, end, share->cotangent, xb);
    }
#if DELAYS
    see_start(w);
#endif
    arrive_reverse(w, 0, start, share->cotangent, xb);
#if DELAYS
    see_start_back(w, xb);
#endif
    for (int i = 0; i < RHS_SITES; i++)
        if (SITE_INVARIANT[i]) {
            net_backward(w->sites[i].net, &w->sites[i], 0, 0u);
            net_gradient(w->sites[i].net, &w->sites[i], 0, TILE, 1);
        }
    add_to_totals(w);
    for (int t = 0; t < TILE; t++) {
        if (!w->active[t]) continue;
        for (int i = 0; i < STATES; i++) out->d_initial[w->who[t] * STATES + i] = xb[i * TILE + t];
        for (int i = 0; i < LEARNABLES; i++) out->d_constants[w->who[t] * LEARNABLES + i] = w->kb[i * TILE + t];
#if DELAYS
        for (int i = 0; i < LAGS; i++) out->d_lags[w->who[t] * LAGS + i] = w->lag_bar[i * TILE + t];
#endif
    }
}

/* ---------------------------------------------------------------- exported functions */

/* Bytes of work space for trajectories of at most `depth` steps. */
int64_t work_bytes(int64_t depth) {
    Work work;
    return bytes_until(arrange(&work, BASE, depth));
}

/* Solves a share of the trajectories, with the reverse pass if requested. */
void run(const Data *data, const Inputs *inputs, const Share *share, const Outputs *outputs, char *space) {
    Work *w = work_in(space);
    open_work(w, data, inputs, data->depth);
    w->d_amounts = outputs->d_amounts;
    w->d_times = outputs->d_times;
    for (int64_t begin = share->first * TILE; begin < share->count; begin += share->stride * TILE) {
        w->depth = 0;
        for (int t = 0; t < TILE; t++) {
            w->active[t] = begin + t < share->count;
            const int64_t who = share->order[w->active[t] ? begin + t : begin];
            set_lane(w, t, who, 0, data->steps[who]);
        }
        run_tile(w, share, outputs);
    }
    if (share->gradient) write_gradient(w, share->d_weights);
}
