/* From derivatives by the weights in use to those by the trained ones. */

/* Adds the gradients to a row of derivatives with respect to the trained weights. These are those with respect to the
   weights in use, minus `shift` times that of the unit's bias (which contains the arguments' centers in a first layer),
   times `factor`. */
static void write_lane(const Work *w, const double *factor, const double *shift, double *row) {
    for (int i = 0; i < NETWORKS; i++) {
        const Net *net = &w->nets[i];
        for (int l = 0; l < net->layers; l++) {
            const size_t in = net->size[l], out = net->size[l + 1];
            const int first = l == 0 && net->layers > 1;
            const real *g = net->gradient[l], *b = net->bias_gradient[l];
            for (size_t o = 0; o < out; o++, row += in, factor += in, shift += in) {
                if (first)
                    for (size_t j = 0; j < in; j++) row[j] += factor[j] * (g[j * PAD(out) + o] - shift[j] * b[o]);
                else if (l)
                    for (size_t j = 0; j < in; j++) row[j] += factor[j] * g[o * PAD(in) + j];
                else
                    for (size_t j = 0; j < in; j++) row[j] += factor[j] * (g[o * in + j] - shift[j] * b[o]);
            }
            for (size_t o = 0; o < out; o++) row[o] += factor[o] * b[o];
            row += out, factor += out, shift += out;
        }
    }
}
