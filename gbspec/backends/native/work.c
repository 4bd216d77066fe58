/* Work space: the arrays of a thread while it computes solutions and reverse passes of tiles of TILE trajectories.
   Steps are grouped into checkpoint intervals. Activations are stored for one interval at a time; of the others only
   the state at the start is stored, and the reverse pass computes their steps again. */

typedef struct {
    const Data *data;
    const Inputs *inputs;
    double *d_amounts, *d_times;
    int64_t who[TILE], first[TILE], steps[TILE], depth; /* a lane's trajectory, first sub-step, number of them */
    int64_t checkpoint_interval;
    int active[TILE], rows[TILE];
    real *states;      /* [checkpoint_interval*EVALUATIONS][STATES][TILE]: where the right-hand side was evaluated */
    real *rates;       /* [checkpoint_interval*STAGES][STATES][TILE] if TIMED: values of the right-hand side */
    real *reached;     /* [checkpoint_interval][STATES][TILE]: states at the ends of steps */
    real *checkpoints; /* [checkpoints][STATES][TILE] */
    real begun[STATES * TILE]; /* state at the start of the first step */
#if DELAYS
    real *late;              /* [checkpoint_interval][NODES][DELAYS][TILE]: delayed values at the nodes */
    real *pieces, *piece_bars; /* [depth][PARTS][STATES][TILE]: the solution so far, and its cotangents */
    double *time_bars;       /* [depth][2][TILE]: cotangents of starts and lengths of sub-steps */
    int64_t hint[LAGS * TILE];
    double lag_bar[LAGS * TILE];
    real origin[STATES * TILE], origin_bar[STATES * TILE]; /* initial states, before what arrives */
    real seen[DELAYS * TILE], seen_bar[DELAYS * TILE];     /* delayed values of observations */
#endif
#if EVENTS
    real *starts; /* [checkpoint_interval][STATES]: states at the starts of steps */
    Crossing *crossing;
#if MATRICES
    const double *jacobian; /* of the right-hand side, frozen in the sub-step */
    double part[STATES * STATES], factored; /* the matrix of a part of it, factored, and the part's size */
    int32_t exchanges[STATES];
#endif
    real side[SWITCHES + 1]; /* added to what decides at a switch of right-hand sides; 0: not held on one side */
#endif
    real condition[CONDITIONS * TILE + 1], constants[CONSTANTS * TILE + 1], numbers[NUMBERS + 1];
    double kb[LEARNABLES * TILE + 1];
    Net nets[NETWORKS + 1];
    Site sites[SITES + 1];
    real *gradients;
    double *totals;
    size_t n_gradients;
} Work;

static void set_networks(Work *w); /* the model's own: sizes and activations */

static void *take(char **place, size_t bytes) {
    char *start = *place;
    *place += (bytes + 63) / 64 * 64;
    return start;
}

static real *take_real(char **place, size_t n) { return (real *)take(place, n * sizeof(real)); }

#define BASE ((char *)(uintptr_t)4096) /* only for computing sizes: nothing is read or written there */

/* Whether the activations of a call are stored for every Runge-Kutta stage of a checkpoint interval. */
static int kept(int site) { return site < RHS_SITES && !SITE_INVARIANT[site]; }

/* Sets the pointers to all arrays of a work space that begins at `place`, and returns its end. */
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
    /* Stored for each step: the states of its Runge-Kutta stages and at its end, and arguments, activations and outputs
       of every call. */
    size_t step = (EVALUATIONS + (TIMED ? STAGES : 0) + 1) * STATES * TILE + NODES * DELAYS * TILE;
    for (int i = 0; i < SITES; i++) {
        const Net *net = &w->nets[SITE_NETWORK[i]];
        size_t row = net->size[0] + 2 * net->size[net->layers];
        for (int l = 1; l < net->layers; l++) row += 2 * PAD(net->size[l]);
        if (kept(i)) step += row * TILE * EVALUATIONS;
    }
    w->checkpoint_interval = (int64_t)(KEPT_BYTES / (step * sizeof(real)));
    if (w->checkpoint_interval > depth) w->checkpoint_interval = depth;
    if (w->checkpoint_interval < 1) w->checkpoint_interval = 1;
    w->states = take_real(&place, (size_t)w->checkpoint_interval * EVALUATIONS * STATES * TILE);
    w->rates = TIMED ? take_real(&place, (size_t)w->checkpoint_interval * STAGES * STATES * TILE) : NULL;
    w->reached = take_real(&place, (size_t)w->checkpoint_interval * STATES * TILE);
    w->checkpoints = take_real(&place, (size_t)(depth / w->checkpoint_interval + 2) * STATES * TILE);
#if DELAYS
    w->late = take_real(&place, (size_t)w->checkpoint_interval * NODES * DELAYS * TILE);
    w->pieces = take_real(&place, (size_t)depth * 4 * STATES * TILE);
    w->piece_bars = take_real(&place, (size_t)depth * 4 * STATES * TILE);
    w->time_bars = take(&place, (size_t)depth * 2 * TILE * sizeof(double));
#endif
#if EVENTS
    w->starts = take_real(&place, (size_t)w->checkpoint_interval * STATES);
    w->crossing = take(&place, sizeof(Crossing));
#endif
    for (int i = 0; i < SITES; i++) {
        Site *site = &w->sites[i];
        const Net *net = site->net = &w->nets[SITE_NETWORK[i]];
        const size_t n = (kept(i) ? (size_t)w->checkpoint_interval * EVALUATIONS : 1) * TILE;
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

/* Prepares a work space for data and inputs, and returns its end. */
static char *open_work(Work *w, const Data *data, const Inputs *inputs, int64_t depth) {
    char *end = arrange(w, (char *)w + (sizeof *w + 63) / 64 * 64, depth);
    w->data = data;
    w->inputs = inputs;
    set_weights(w, inputs->weights);
    for (int i = 0; i < NUMBERS; i++) w->numbers[i] = R(inputs->numbers[i]);
    return end;
}

/* The (aligned) beginning of a work space in the memory for it. */
static Work *work_in(char *space) { return (Work *)(((uintptr_t)space + 63) / 64 * 64); }

/* Bytes of a work space, given where it would end if its arrays began at BASE. */
static int64_t bytes_until(const char *end) { return (int64_t)((size_t)(end - BASE) + (sizeof(Work) + 63) / 64 * 64 + 64); }

/* ---------------------------------------------------------------- checkpoints */

static real *checkpoint_at(const Work *w, int64_t step) {
    return w->checkpoints + (size_t)(step / w->checkpoint_interval) * (STATES * TILE);
}

static int64_t next_checkpoint(const Work *w, int64_t step) {
    return step + w->checkpoint_interval < w->depth ? step + w->checkpoint_interval : w->depth;
}

/* -1: there are no steps. */
static int64_t last_checkpoint(const Work *w) {
    return w->depth ? (w->depth - 1) / w->checkpoint_interval * w->checkpoint_interval : -1;
}
