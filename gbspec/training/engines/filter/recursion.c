/* The Kalman filter over legs, with the sensitivities of its moments: `advanced` of recursion.py, one leg after the
   other. Tables are as described there, the last index first in memory; derivatives are left out where width is 0. */
#include <stdint.h>
#include <string.h>

typedef struct {
    int64_t legs, n, channels, width;
    const int64_t *owner, *place;
    double *m, *p, *dm, *dp;
    const double *at, *mean, *a, *q, *by_moment, *by_rest, *d_mean, *d_a, *d_q;
    const double *read_at, *y, *c, *value, *r, *read_by_moment, *read_by_rest, *d_y, *d_c, *d_r;
    const uint8_t *seen;
    double *before_m, *before_p, *end_m, *end_p, *post_m, *post_p;
    double *error, *variance, *predicted, *d_error, *d_variance;
    double *work;
} Sweep;

/* out[i][k] (+)= sum over l of left[i][l] right[l][k] */
static void product(double *restrict out, const double *left, const double *restrict right, int64_t rows, int64_t inner,
                    int64_t columns, int add) {
    int64_t i, l, k;
    for (i = 0; i < rows; i++) {
        double *restrict row = out + i * columns;
        if (!add) memset(row, 0, sizeof(double) * columns);
        for (l = 0; l < inner; l++) {
            const double factor = left[i * inner + l];
            const double *restrict from = right + l * columns;
            if (factor != 0.0)
                for (k = 0; k < columns; k++) row[k] += factor * from[k];
        }
    }
}

static void symmetric(double *p, int64_t n) {
    int64_t i, j;
    for (i = 0; i < n; i++)
        for (j = 0; j < i; j++) p[i * n + j] = p[j * n + i] = 0.5 * (p[i * n + j] + p[j * n + i]);
}

/* Derivatives of mean and covariance, one after the other: [n + n n][w]. */
static void stack(double *to, const double *dm, const double *dp, int64_t n, int64_t w) {
    memcpy(to, dm, sizeof(double) * n * w);
    memcpy(to + n * w, dp, sizeof(double) * n * n * w);
}

static void predict(const Sweep *s, int64_t leg, double *m, double *p, double *dm, double *dp) {
    const int64_t n = s->n, w = s->width, nn = n * n;
    const double *a = s->a + leg * nn, *at = s->at + leg * n;
    double *pa = s->work, *moved = pa + nn, *mean = moved + n, *da = mean + nn, *inner = da + nn * w, *along = inner + nn * w;
    int64_t i, j, l, k;
    for (i = 0; i < n; i++)
        for (j = 0; j < n; j++) {
            pa[i * n + j] = 0.0;
            for (l = 0; l < n; l++) pa[i * n + j] += p[i * n + l] * a[j * n + l];
        }
    for (i = 0; i < n; i++) moved[i] = m[i] - at[i];
    if (w && s->by_moment) {
        const int64_t all = n + nn;
        double *whole = da, *next = whole + all * w;
        stack(whole, dm, dp, n, w);
        memcpy(next, s->by_rest + leg * all * w, sizeof(double) * all * w);
        product(next, s->by_moment + leg * all * all, whole, all, all, w, 1);
        memcpy(dm, next, sizeof(double) * n * w);
        memcpy(dp, next + n * w, sizeof(double) * nn * w);
    } else if (w) {
        /* dp' = dq + da (P a') + its transpose + a dP a' */
        memcpy(da, s->d_a + leg * nn * w, sizeof(double) * nn * w);
        product(inner, a, dp, n, n, n * w, 0);
        for (i = 0; i < n; i++) product(dp + i * n * w, a, inner + i * n * w, n, n, w, 0);
        memset(along, 0, sizeof(double) * nn * w);
        for (i = 0; i < n; i++)
            for (l = 0; l < n; l++)
                for (j = 0; j < n; j++) {
                    const double factor = pa[l * n + j];
                    const double *restrict from = da + (i * n + l) * w;
                    double *restrict to = along + (i * n + j) * w;
                    for (k = 0; k < w; k++) to[k] += factor * from[k];
                }
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++) {
                const double *dq = s->d_q + (leg * nn + i * n + j) * w;
                const double *one = along + (i * n + j) * w, *other = along + (j * n + i) * w;
                double *to = dp + (i * n + j) * w;
                for (k = 0; k < w; k++) to[k] += dq[k] + one[k] + other[k];
            }
        memcpy(inner, s->d_mean + leg * n * w, sizeof(double) * n * w);
        product(inner, a, dm, n, n, w, 1);
        memcpy(dm, inner, sizeof(double) * n * w);
    }
    for (i = 0; i < n; i++) {
        mean[i] = s->mean[leg * n + i];
        for (l = 0; l < n; l++) mean[i] += a[i * n + l] * moved[l];
    }
    memcpy(m, mean, sizeof(double) * n);
    for (i = 0; i < n; i++)
        for (j = 0; j < n; j++) {
            double sum = s->q[leg * nn + i * n + j];
            for (l = 0; l < n; l++) sum += a[i * n + l] * pa[l * n + j];
            p[i * n + j] = sum;
        }
    symmetric(p, n);
}

/* The derivatives of predictions, slopes and variances of a row [channels (n + 2)][w] at its moments. */
static void read(const Sweep *s, int64_t row, const double *dm, const double *dp, double *out, double *space) {
    const int64_t n = s->n, w = s->width, channels = s->channels, all = n + n * n, count = channels * (n + 2);
    if (s->read_by_moment) {
        stack(space, dm, dp, n, w);
        memcpy(out, s->read_by_rest + row * count * w, sizeof(double) * count * w);
        product(out, s->read_by_moment + row * count * all, space, count, all, w, 1);
        return;
    }
    memcpy(out, s->d_y + row * channels * w, sizeof(double) * channels * w);
    product(out, s->c + row * channels * n, dm, channels, n, w, 1);
    memcpy(out + channels * w, s->d_c + row * channels * n * w, sizeof(double) * channels * n * w);
    memcpy(out + channels * (n + 1) * w, s->d_r + row * channels * w, sizeof(double) * channels * w);
}

/* One channel's value; `before` and `d_before` are the mean and its derivatives before the measurements of the row, and
   `slopes` what `read` has found. */
static void take(const Sweep *s, int64_t row, int64_t channel, const double *before, const double *d_before,
                 const double *slopes, double *m, double *p, double *dm, double *dp, double *space) {
    const int64_t n = s->n, w = s->width, nn = n * n, place = row * s->channels + channel;
    const double *c = s->c + place * n, r = s->r[place];
    const double *d_y = slopes + channel * w, *dc = slopes + (s->channels + channel * n) * w;
    const double *d_r = slopes + (s->channels * (n + 1) + channel) * w;
    double *pc = space, *gain = pc + n, *left = gain + n, *next = left + nn, *dpc = next + nn, *d_gain = dpc + n * w;
    double error = s->value[place] - s->predicted[place], variance = r;
    int64_t i, j, l, k;
    for (i = 0; i < n; i++) {
        error -= c[i] * (m[i] - before[i]);
        pc[i] = 0.0;
        for (l = 0; l < n; l++) pc[i] += p[i * n + l] * c[l];
    }
    for (i = 0; i < n; i++) variance += c[i] * pc[i];
    for (i = 0; i < n; i++) gain[i] = pc[i] / variance;
    s->error[place] = error;
    s->variance[place] = variance;
    if (w) {
        double *de = s->d_error + place * w, *dv = s->d_variance + place * w;
        for (k = 0; k < w; k++) {
            de[k] = -d_y[k];
            dv[k] = d_r[k];
        }
        product(dpc, p, dc, n, n, w, 0);
        for (i = 0; i < n; i++)
            for (k = 0; k < w; k++) {
                de[k] -= c[i] * (dm[i * w + k] - d_before[i * w + k]) + (m[i] - before[i]) * dc[i * w + k];
                dv[k] += pc[i] * dc[i * w + k];
            }
        for (l = 0; l < n; l++)
            for (i = 0; i < n; i++)
                for (k = 0; k < w; k++) dpc[i * w + k] += c[l] * dp[(l * n + i) * w + k];
        for (i = 0; i < n; i++)
            for (k = 0; k < w; k++) dv[k] += c[i] * dpc[i * w + k];
        for (i = 0; i < n; i++)
            for (k = 0; k < w; k++) {
                d_gain[i * w + k] = (dpc[i * w + k] - gain[i] * dv[k]) / variance;
                dm[i * w + k] += d_gain[i * w + k] * error + gain[i] * de[k];
            }
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++) {
                double *restrict to = dp + (i * n + j) * w;
                for (k = 0; k < w; k++) to[k] -= d_gain[i * w + k] * pc[j] + gain[i] * dpc[j * w + k];
            }
    }
    for (i = 0; i < n; i++) m[i] += gain[i] * error;
    /* (1 - K c) P (1 - K c)' + K r K', which stays positive whatever is rounded */
    for (i = 0; i < n; i++)
        for (j = 0; j < n; j++) left[i * n + j] = (i == j) - gain[i] * c[j];
    product(next, left, p, n, n, n, 0);
    for (i = 0; i < n; i++)
        for (j = 0; j < n; j++) {
            double sum = r * gain[i] * gain[j];
            for (l = 0; l < n; l++) sum += next[i * n + l] * left[j * n + l];
            p[i * n + j] = sum;
        }
    symmetric(p, n);
}

static void keep(double *table, int64_t leg, const double *values, int64_t count) {
    if (table) memcpy(table + leg * count, values, sizeof(double) * count);
}

void advance(const Sweep *s) {
    const int64_t n = s->n, w = s->width, nn = n * n;
    double *before = s->work, *d_before = before + n, *slopes = d_before + n * w;
    double *space = slopes + s->channels * (n + 2) * w;
    int64_t leg, channel, i;
    Sweep inner = *s;
    inner.work = space;
    for (leg = 0; leg < s->legs; leg++) {
        const int64_t owner = s->owner[leg], row = s->place[leg];
        double *m = s->m + owner * n, *p = s->p + owner * nn;
        double *dm = w ? s->dm + owner * n * w : 0, *dp = w ? s->dp + owner * nn * w : 0;
        keep(s->before_m, leg, m, n);
        keep(s->before_p, leg, p, nn);
        predict(&inner, leg, m, p, dm, dp);
        keep(s->end_m, leg, m, n);
        keep(s->end_p, leg, p, nn);
        if (row >= 0) {
            memcpy(before, m, sizeof(double) * n);
            if (w) {
                memcpy(d_before, dm, sizeof(double) * n * w);
                read(s, row, dm, dp, slopes, space);
            }
            for (channel = 0; channel < s->channels; channel++) {
                const int64_t place = row * s->channels + channel;
                double sum = s->y[place];
                for (i = 0; i < n; i++) sum += s->c[place * n + i] * (before[i] - s->read_at[row * n + i]);
                s->predicted[place] = sum;
                if (s->seen[place]) take(s, row, channel, before, d_before, slopes, m, p, dm, dp, space);
            }
        }
        keep(s->post_m, leg, m, n);
        keep(s->post_p, leg, p, nn);
    }
}
