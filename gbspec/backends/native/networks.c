/* Networks: a call, forward and in reverse, and its contribution to the weights' gradient.

   A network has `layers` linear layers. `forward[l]` is the transpose of layer l's weights [in][PAD(out)], `back[l]` the
   weights [out][PAD(in)]; the last layer has only `back`, the first only `forward` (unless it is the last).
   Gradients have the layout of `forward` in the first layer, of `back` in the others. */

#define MOST_LAYERS 16

typedef struct {
    int layers;
    int size[MOST_LAYERS + 1];
    int kinds[MOST_LAYERS];         /* parts of hidden layer l with an activation each */
    int kind[MOST_LAYERS][3], count[MOST_LAYERS][3];
    real *forward[MOST_LAYERS], *back[MOST_LAYERS], *bias[MOST_LAYERS];
    real *gradient[MOST_LAYERS], *bias_gradient[MOST_LAYERS];
} Net;

/* The samples of a call, in blocks of TILE rows. `hidden[l]`, `slope[l]`: of hidden layer l = 1, 2, ...; the reverse
   pass replaces the slopes by the cotangents of pre-activations. */
typedef struct {
    const Net *net;
    real *args, *hidden[MOST_LAYERS], *slope[MOST_LAYERS], *y, *yb, *ab;
} Site;

/* Applies an activation to units begin to end - 1, which share a vector with others: all are computed, these stored. */
INLINE void activate_among(int kind, real *z, real *slope, size_t begin, size_t end) {
    const size_t from = begin / LANES * LANES;
    vec copy = load(z + from), copy_slope;
    activate(kind, (real *)&copy, (real *)&copy_slope, LANES);
    for (size_t i = 0; i < LANES; i++) {
        const int own = from + i >= begin && from + i < end;
        z[from + i] = own ? ((real *)&copy)[i] : z[from + i];
        slope[from + i] = own ? ((real *)&copy_slope)[i] : slope[from + i];
    }
}

/* A hidden layer of a sample, with a separate activation for each part. */
static void activate_parts(const Net *net, int layer, real *z, real *slope) {
    for (size_t i = 0, begin = 0; i < (size_t)net->kinds[layer]; i++) {
        const size_t end = begin + net->count[layer][i], whole = PAD(begin), rest = end / LANES * LANES;
        const int kind = net->kind[layer][i];
        if (begin < whole) activate_among(kind, z, slope, begin, end < whole ? end : whole);
        if (whole < rest) activate(kind, z + whole, slope + whole, rest - whole);
        if (whole <= rest && rest < end) activate_among(kind, z, slope, rest, end);
        begin = end;
    }
}

APART void net_forward(const Net *net, const Site *site, size_t block) {
    const int last = net->layers - 1;
    const int n_in = net->size[0], n_out = net->size[last + 1];
    const real *below = site->args + block * TILE * n_in;
    size_t stride = n_in;
    for (int l = 0; l < last; l++) {
        const size_t width = PAD(net->size[l + 1]);
        real *z = site->hidden[l + 1] + block * TILE * width, *slope = site->slope[l + 1] + block * TILE * width;
        if (net->kinds[l + 1] == 1 && net->kind[l + 1][0] == SILU) {
            silu_of_product(TILE, width, net->size[l], below, stride, net->forward[l], net->bias[l], z, slope);
        } else {
            product(TILE, width, net->size[l], below, stride, 1, net->forward[l], width, z, width, net->bias[l], 0);
            if (net->kinds[l + 1] == 1) activate(net->kind[l + 1][0], z, slope, TILE * width);
            else for (int t = 0; t < TILE; t++) activate_parts(net, l + 1, z + t * width, slope + t * width);
        }
        below = z;
        stride = width;
    }
    real *y = site->y + block * TILE * n_out;
    for (int o = 0; o < n_out; o++) {
        const real *weights = net->back[last] + (size_t)o * stride;
        if (last) dots(below, weights, stride, y + o, n_out);
        else for (int t = 0; t < TILE; t++) y[t * n_out + o] = short_dot(below + t * n_in, weights, 1, n_in);
        for (int t = 0; t < TILE; t++) y[t * n_out + o] += net->bias[last][o];
    }
}

/* Prefetches memory that is read soon. */
static void fetch(const real *p, size_t n) {
#if defined(__GNUC__)
    for (size_t i = 0; i < n * sizeof(real); i += 64) __builtin_prefetch((const char *)p + i, 0, 2);
#else
    (void)p; (void)n;
#endif
}

/* From the outputs' cotangents `yb` to those of pre-activations, and of the arguments whose bit is set in `wanted`. */
APART void net_backward(const Net *net, const Site *site, size_t block, unsigned wanted) {
    const int last = net->layers - 1;
    const int n_in = net->size[0], n_out = net->size[last + 1];
    const real *above = site->yb + block * TILE * n_out;
    size_t stride = n_out;
    for (int l = last; l > 0; l--) {
        const size_t width = PAD(net->size[l]);
        real *slope = site->slope[l] + block * TILE * width;
        if (block) { /* blocks are taken from the last to the first, which hardware prefetchers do not predict */
            fetch(slope - TILE * width, TILE * width);
            fetch(site->hidden[l] + (block - 1) * TILE * width, TILE * width);
        }
        scale_by_product(TILE, width, net->size[l + 1], above, stride, net->back[l], slope);
        above = slope;
        stride = width;
    }
    for (int i = 0; i < n_in; i++) {
        if (i < 32 && !(wanted >> i & 1)) continue;
        if (last) dots(above, net->forward[0] + i * stride, stride, site->ab + i, n_in);
        else for (int t = 0; t < TILE; t++) site->ab[t * n_in + i] = short_dot(above + t * n_out, net->back[0] + i, n_in, n_out);
    }
}

/* Adds the contributions of some samples to the gradients: `first` and every `apart`-th after it (1: all of a tile's
   lanes, TILE: one lane). */
APART void net_gradient(const Net *net, const Site *site, size_t first, size_t samples, size_t apart) {
    const int last = net->layers - 1;
    const size_t n_in = net->size[0], n_out = net->size[last + 1];
    const real *args = site->args + first * n_in, *yb = site->yb + first * n_out;
    for (size_t o = 0; o < n_out; o++) {
        real sum = 0;
        for (size_t s = 0; s < samples; s++) {
            const real c = yb[s * apart * n_out + o];
            sum += c;
            if (!last) for (size_t i = 0; i < n_in; i++) net->gradient[0][o * n_in + i] += c * args[s * apart * n_in + i];
        }
        net->bias_gradient[last][o] += sum;
    }
    for (int l = last; l > 0; l--) {
        const size_t width = PAD(net->size[l]), rows = net->size[l + 1], stride = l == last ? n_out : PAD(rows);
        const real *above = l == last ? yb : site->slope[l + 1] + first * stride;
        const real *below = site->hidden[l] + first * width, *dz = site->slope[l] + first * width;
        real *g = net->gradient[l], *g0 = net->gradient[0];
        product(rows, width, samples, above, 1, apart * stride, below, apart * width, g, width, g, width);
        add_rows(samples, width, dz, apart * width, net->bias_gradient[l - 1]);
        if (l == 1) product(n_in, width, samples, args, 1, apart * n_in, dz, apart * width, g0, width, g0, width);
    }
}
