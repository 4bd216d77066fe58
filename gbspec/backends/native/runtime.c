/* Arithmetic that does not depend on the model: vectors, elementary functions, products of small matrices.

   No instruction set is assumed. With a compiler that has vector types (GCC, Clang), the hidden units of a network fill
   them, in the width of the target; with others a vector is one number. */

#if REAL_IS_FLOAT
typedef float real;
typedef int32_t bits;
#define FN(name) name##f
#else
typedef double real;
typedef int64_t bits;
#define FN(name) name
#endif
#define R(x) ((real)(x))

#if defined(__GNUC__) && !defined(PLAIN_C)
#if defined(__AVX512F__)
#define VECTOR_BYTES 64
#define COLUMNS 4
#define SIDE_BY_SIDE 4
#elif defined(__AVX__)
#define VECTOR_BYTES 32
#define COLUMNS 2
#define SIDE_BY_SIDE 2
#elif defined(__aarch64__)
#define VECTOR_BYTES 16
#define COLUMNS 4
#define SIDE_BY_SIDE 4
#else
#define VECTOR_BYTES 16
#define COLUMNS 2
#define SIDE_BY_SIDE 2
#endif
typedef real vec __attribute__((vector_size(VECTOR_BYTES), aligned(sizeof(real)), may_alias));
typedef bits mask __attribute__((vector_size(VECTOR_BYTES), aligned(sizeof(real)), may_alias));
#define LANES ((int)(VECTOR_BYTES / sizeof(real)))
#define LANES_HALVED 1
#define INLINE static inline __attribute__((always_inline))
#define APART static __attribute__((noinline))
#define UNROLL _Pragma("GCC unroll 8")
#define UNROLL_MORE _Pragma("GCC unroll 16")
#define BITS(x) ((mask)(x))
#define FROM_BITS(b) ((vec)(b))
#if defined(__AVX512F__)
#define IN_REGISTER(v) __asm__("" : "+v"(v))
#define X86(name, type) _mm512_##name##_p##type
#elif defined(__x86_64__)
#define IN_REGISTER(v) __asm__("" : "+x"(v))
#if defined(__AVX__)
#define X86(name, type) _mm256_##name##_p##type
#endif
#else
#define IN_REGISTER(v) (void)(v)
#endif
#define SELECT(condition, a, b) FROM_BITS((BITS(a) & (mask)(condition)) | (BITS(b) & ~(mask)(condition)))
#else
typedef real vec;
typedef bits mask;
#define COLUMNS 4
#define SIDE_BY_SIDE 1
#define IN_REGISTER(v) (void)(v)
#define LANES 1
#define LANES_HALVED 0
#define INLINE static inline
#define APART static
#define UNROLL
#define UNROLL_MORE
INLINE bits BITS(real x) { bits b; memcpy(&b, &x, sizeof b); return b; }
INLINE real FROM_BITS(bits b) { real x; memcpy(&x, &b, sizeof x); return x; }
#define SELECT(condition, a, b) ((condition) ? (a) : (b))
#endif
#define ROWS 4
#define PAD(n) (((n) + LANES - 1) / LANES * LANES)

/* ---------------------------------------------------------------- elementary functions, branch-free */

#if REAL_IS_FLOAT
#define SHIFT R(12582912.0) /* 1.5 * 2^23: adding it rounds to a whole number, kept in the low bits */
#define LN2_HIGH R(0.693359375)
#define LN2_LOW R(-2.12194440054690583e-4)
#define EXP_MOST R(60.0)
#define MANTISSA 23
#define BIAS 127
#else
#define SHIFT R(6755399441055744.0)
#define LN2_HIGH R(0.693147180369123816490)
#define LN2_LOW R(1.90821492927058770002e-10)
#define EXP_MOST R(300.0)
#define MANTISSA 52
#define BIAS 1023
#endif

INLINE vec load(const real *p) { return *(const vec *)p; }
INLINE void store(real *p, vec v) { *(vec *)p = v; }
INLINE vec splat(real x) { return (vec){0} + x; }

/* The smaller and the larger of two; a NaN in `x` is kept. On x86 compilers emit three instructions instead of one. */
#if defined(X86)
#include <immintrin.h>
#if REAL_IS_FLOAT
INLINE vec at_most(real limit, vec x) { return (vec)X86(min, s)(splat(limit), x); }
INLINE vec at_least(real limit, vec x) { return (vec)X86(max, s)(splat(limit), x); }
#else
INLINE vec at_most(real limit, vec x) { return (vec)X86(min, d)(splat(limit), x); }
INLINE vec at_least(real limit, vec x) { return (vec)X86(max, d)(splat(limit), x); }
#endif
#else
INLINE vec at_most(real limit, vec x) { return SELECT(x > splat(limit), splat(limit), x); }
INLINE vec at_least(real limit, vec x) { return SELECT(x < splat(limit), splat(limit), x); }
#endif
INLINE vec size_of(vec x) { return SELECT(x < splat(0), -x, x); }

/* exp(x) = s + s*q with s a power of two and q = exp(r) - 1, |r| <= ln 2/2, by its Taylor polynomial (error below half
   a unit in the last place). Beyond EXP_MOST activations are constant to rounding; arguments are clipped so that
   no product of such values is subnormal, since subnormal products are about a hundred times slower. */
INLINE void exp_parts(vec x, vec *s, vec *q) {
    x = at_most(EXP_MOST, at_least(-EXP_MOST, x));
    const vec shifted = x * R(1.44269504088896340736) + SHIFT;
    const vec n = shifted - SHIFT;
    const vec r = (x - n * LN2_HIGH) - n * LN2_LOW;
    const vec r2 = r * r, r4 = r2 * r2; /* in pairs, to shorten the chain of dependent operations */
#if REAL_IS_FLOAT
    const vec high = r * R(1.0 / 5040.0) + R(1.0 / 720.0);
#else
    const vec top = (r * R(1.0 / 39916800.0) + R(1.0 / 3628800.0)) + r2 * R(1.0 / 479001600.0);
    const vec middle = (r * R(1.0 / 362880.0) + R(1.0 / 40320.0)) * r2 + (r * R(1.0 / 5040.0) + R(1.0 / 720.0));
    const vec high = top * r4 + middle;
#endif
    const vec low = (r * R(1.0 / 120.0) + R(1.0 / 24.0)) * r2 + (r * R(1.0 / 6.0) + R(0.5));
    *q = r + r2 * (high * r4 + low);
    *s = FROM_BITS((BITS(shifted) + BIAS) << MANTISSA);
}

INLINE vec v_exp(vec x) { vec s, q; exp_parts(x, &s, &q); return s + s * q; }
INLINE vec v_expm1(vec x) { vec s, q; exp_parts(x, &s, &q); return s * q + (s - R(1)); }

/* 1/d for positive d that are not close to the ends of the range: a first value from bit arithmetic, with an error of
   at most 5 %, then iterations that square or cube the error. It is faster than a division of vectors unless other work
   hides the latency. */
INLINE vec v_reciprocal(vec d) {
#if REAL_IS_FLOAT
    vec y = FROM_BITS(0x7EF311C7 - BITS(d));
#else
    vec y = FROM_BITS(0x7FDE6238502484BA - BITS(d));
    y = y + y * (R(1) - d * y);
#endif
    const vec miss = R(1) - d * y;
    y = y + y * (miss + miss * miss);
    return y + y * (R(1) - d * y);
}

/* Coefficients of the polynomials 1 + c r + ... with the least relative distance from 2^r for |r| <= 1/2 (4e-9, 2e-17),
   the highest first. */
#if REAL_IS_FLOAT
static const real POWER_OF_2[] = {
    R(0.00015394103730624784), R(0.0013409230741605595), R(0.009618294483665279),
    R(0.055502997187595897),   R(0.24022649036934279),   R(0.69314722389514778),
};
#else
static const real POWER_OF_2[] = {
    R(4.0779938562463538e-10), R(7.0725704454692941e-09), R(1.0180648196555812e-07), R(1.3215442675115585e-06),
    R(1.5252727383872463e-05), R(1.5403530441572599e-04), R(1.3333558153441335e-03), R(9.6181291076070020e-03),
    R(5.5504108664790389e-02), R(2.4022650695910098e-01), R(6.9314718055994570e-01),
};
#endif
#define POWER_TERMS (int)(sizeof POWER_OF_2 / sizeof *POWER_OF_2)

#define ALL UNROLL for (int j = 0; j < n; j++)

/* The logistic function p(x), and 1 - p(x) to the same accuracy, from e = exp(-x), whose relative error is that of one
   unit in the last place of x. Each operation is done for all n vectors in turn, to hide its latency. */
INLINE void logistics(const int n, const vec *x, vec *p, vec *rest) {
    vec z[SIDE_BY_SIDE], shifted[SIDE_BY_SIDE], r[SIDE_BY_SIDE], e[SIDE_BY_SIDE];
    ALL z[j] = at_most(EXP_MOST, at_least(-EXP_MOST, x[j]));
    ALL shifted[j] = z[j] * R(-1.44269504088896340736) + (SHIFT + BIAS);
    ALL r[j] = z[j] * R(-1.44269504088896340736) - (shifted[j] - (SHIFT + BIAS));
    ALL e[j] = r[j] * POWER_OF_2[0] + POWER_OF_2[1];
    UNROLL_MORE for (int i = 2; i < POWER_TERMS; i++) ALL e[j] = e[j] * r[j] + POWER_OF_2[i];
    ALL e[j] = (e[j] * r[j] + R(1)) * FROM_BITS(BITS(shifted[j]) << MANTISSA);
    ALL p[j] = R(1) / (R(1) + e[j]);
    ALL rest[j] = e[j] * p[j];
}

INLINE void v_logistic(vec x, vec *p, vec *rest) { logistics(1, &x, p, rest); }

/* Replaces x by x p(x) and computes its slope, for n vectors. */
INLINE void silu(const int n, vec *x, vec *slope) {
    vec p[SIDE_BY_SIDE], rest[SIDE_BY_SIDE];
    logistics(n, x, p, rest);
    ALL x[j] = x[j] * p[j];
    ALL slope[j] = x[j] * rest[j] + p[j];
}

INLINE vec v_tanh(vec x) {
    const vec e = v_expm1(R(2) * size_of(x)), y = e * v_reciprocal(e + R(2));
    return SELECT(x < splat(0), -y, y);
}

/* log(1 + u) for u in [0, 1]: with 1 + u = m or 2m, m = 1 + f between sqrt(1/2) and sqrt(2), log(m) = f - (f*f/2 - s*(f*f/2 + R)),
   s = f/(2 + f); R in powers of s*s as in Sun's fdlibm (e_log.c), in single precision the first terms of the series of 2 artanh(s). */
INLINE vec v_log1p_unit(vec u) {
    const vec f = SELECT(u > splat(R(0.41421356237309504880)), (u - R(1)) * R(0.5), u);
    const vec s = f * v_reciprocal(f + R(2)), q = s * s, q2 = q * q, half = f * f * R(0.5);
#if REAL_IS_FLOAT
    const vec rest = q * ((R(2.0 / 3) + q * R(2.0 / 5)) + q2 * (R(2.0 / 7) + q * R(2.0 / 9)));
#else
    const vec low = (R(6.666666666666735130e-01) + q * R(3.999999999940941908e-01)) +
                    q2 * (R(2.857142874366239149e-01) + q * R(2.222219843214978396e-01));
    const vec high = (R(1.818357216161805012e-01) + q * R(1.531383769920937332e-01)) + q2 * R(1.479819860511658591e-01);
    const vec rest = q * (low + q2 * q2 * high);
#endif
    const vec log_m = f - (half - s * (half + rest));
    return SELECT(u > splat(R(0.41421356237309504880)), log_m + R(0.69314718055994530942), log_m);
}

INLINE vec v_softplus(vec x) { return SELECT(x > splat(0), x, x - x) + v_log1p_unit(v_exp(-size_of(x))); }

/* ---------------------------------------------------------------- functions of the equations */

INLINE real f_exp(real x) { return FN(exp)(x); }
INLINE real f_log(real x) { return FN(log)(x); }
INLINE real f_sin(real x) { return FN(sin)(x); }
INLINE real f_cos(real x) { return FN(cos)(x); }
INLINE real f_tan(real x) { return FN(tan)(x); }
INLINE real f_tanh(real x) { return FN(tanh)(x); }
INLINE real f_sinh(real x) { return FN(sinh)(x); }
INLINE real f_cosh(real x) { return FN(cosh)(x); }
INLINE real f_asin(real x) { return FN(asin)(x); }
INLINE real f_acos(real x) { return FN(acos)(x); }
INLINE real f_atan(real x) { return FN(atan)(x); }
INLINE real f_asinh(real x) { return FN(asinh)(x); }
INLINE real f_acosh(real x) { return FN(acosh)(x); }
INLINE real f_atanh(real x) { return FN(atanh)(x); }
INLINE real f_atan2(real y, real x) { return FN(atan2)(y, x); }
INLINE real f_sqrt(real x) { return FN(sqrt)(x); }
INLINE real f_power(real x, real p) { return FN(pow)(x, p); }
INLINE real f_abs(real x) { return FN(fabs)(x); }
INLINE real f_sign(real x) { return x > R(0) ? R(1) : x < R(0) ? R(-1) : x; }
INLINE real f_floor(real x) { return FN(floor)(x); }
INLINE real f_maximum(real a, real b) { return a > b || a != a ? a : b; }
INLINE real f_minimum(real a, real b) { return a < b || a != a ? a : b; }
INLINE real f_softplus(real x) { return x > R(40) ? x : FN(log1p)(FN(exp)(x)); }
INLINE real f_logistic(real x) { return R(1) / (R(1) + FN(exp)(-x)); }

/* ---------------------------------------------------------------- products of small matrices */

static void zero(real *p, size_t n) { memset(p, 0, n * sizeof(real)); }

/* The use of a product: it is stored; C is multiplied by it; its SiLU is stored, with the slopes. */
enum { STORED, SCALES, SILUS };

/* Stores a row of a product. */
INLINE void put_row(const int use, const int cols, vec *sum, real *C, real *slope) {
    vec s[COLUMNS];
    UNROLL for (int j = 0; j < cols; j++)
        if (use == SCALES) sum[j] *= load(C + j * LANES);
    if (use == SILUS)
        UNROLL for (int j = 0; j < cols; j += SIDE_BY_SIDE) silu(cols - j < SIDE_BY_SIDE ? cols - j : SIDE_BY_SIDE, sum + j, s + j);
    UNROLL for (int j = 0; j < cols; j++) {
        store(C + j * LANES, sum[j]);
        if (use == SILUS) store(slope + j * LANES, s[j]);
    }
}

/* A block of C[rows][cols vectors] = init + sum over k of A[r][k] B[k][:], used according to `use`; A is read at
   r*ars + k*acs. With SCALES there is no `init`, and only SILUS have slopes. */
INLINE void block_product(const int use, const int rows, const int cols, size_t depth, const real *A, size_t ars, size_t acs,
                          const real *B, size_t ldb, real *C, size_t ldc, const real *init, size_t ldi, real *slope) {
    vec acc[ROWS][COLUMNS];
    UNROLL for (int r = 0; r < rows; r++)
        UNROLL for (int j = 0; j < cols; j++) acc[r][j] = use == SCALES ? splat(0) : load(init + r * ldi + j * LANES);
    for (size_t k = 0; k < depth; k++) {
        vec b[COLUMNS];
        UNROLL for (int j = 0; j < cols; j++) {
            b[j] = load(B + k * ldb + j * LANES);
            IN_REGISTER(b[j]); /* else compilers load it again for every row */
        }
        UNROLL for (int r = 0; r < rows; r++) {
            const real a = A[r * ars + k * acs];
            UNROLL for (int j = 0; j < cols; j++) acc[r][j] += a * b[j];
        }
    }
    UNROLL for (int r = 0; r < rows; r++) put_row(use, cols, acc[r], C + r * ldc, use == SILUS ? slope + r * ldc : NULL);
}

#define BLOCK(r, c) \
    block_product(use, r, c, depth, A + i * ars, ars, acs, B + j, ldb, C + i * ldc + j, ldc, \
                  use == SCALES ? NULL : init + i * ldi + j, ldi, use == SILUS ? slope + i * ldc + j : NULL)

/* C[rows][width] from A B, width a multiple of LANES. The three products of a layer (forward, cotangents of
   its inputs, gradient of its weights) all have this form; none needs a transpose in its loops. */
INLINE void any_product(const int use, size_t rows, size_t width, size_t depth, const real *A, size_t ars, size_t acs, const real *B,
                        size_t ldb, real *C, size_t ldc, const real *init, size_t ldi, real *slope) {
    for (size_t j = 0; j < width;) {
        const size_t left = (width - j) / LANES;
        const int columns = left >= COLUMNS ? COLUMNS : left >= 2 ? 2 : 1;
        for (size_t i = 0; i < rows;) {
            const int count = rows - i >= ROWS ? ROWS : 1;
            if (columns == COLUMNS) {
                if (count == ROWS) BLOCK(ROWS, COLUMNS);
                else BLOCK(1, COLUMNS);
            } else if (columns == 2) {
                if (count == ROWS) BLOCK(ROWS, 2);
                else BLOCK(1, 2);
            } else {
                if (count == ROWS) BLOCK(ROWS, 1);
                else BLOCK(1, 1);
            }
            i += count;
        }
        j += (size_t)columns * LANES;
    }
}

/* C = init + A B. */
APART void product(size_t rows, size_t width, size_t depth, const real *A, size_t ars, size_t acs, const real *B,
                   size_t ldb, real *C, size_t ldc, const real *init, size_t ldi) {
    any_product(STORED, rows, width, depth, A, ars, acs, B, ldb, C, ldc, init, ldi, NULL);
}

/* C *= A B, with A's rows `stride` apart and no gaps between those of B and C. */
APART void scale_by_product(size_t rows, size_t width, size_t depth, const real *A, size_t stride, const real *B, real *C) {
    any_product(SCALES, rows, width, depth, A, stride, 1, B, width, C, width, NULL, 0, NULL);
}

/* C = silu(bias + A B) and its slopes, likewise. */
APART void silu_of_product(size_t rows, size_t width, size_t depth, const real *A, size_t stride, const real *B,
                           const real *bias, real *C, real *slope) {
    any_product(SILUS, rows, width, depth, A, stride, 1, B, width, C, width, bias, 0, slope);
}

#if LANES_HALVED
/* Adds the halves of a vector to each other while they are vectors; the two or four remaining numbers one by one. */
#define HALVED(bytes) real half_##bytes __attribute__((vector_size(bytes)))
typedef HALVED(16);
#if VECTOR_BYTES >= 32
typedef HALVED(32);
INLINE half_16 sum_32(half_32 v) { union { half_32 whole; half_16 part[2]; } u = {v}; return u.part[0] + u.part[1]; }
#endif
#if VECTOR_BYTES >= 64
typedef HALVED(64);
INLINE half_32 sum_64(half_64 v) { union { half_64 whole; half_32 part[2]; } u = {v}; return u.part[0] + u.part[1]; }
#endif
INLINE real lane_sum(vec v) {
#if VECTOR_BYTES == 64
    const half_16 rest = sum_32(sum_64((half_64)v));
#elif VECTOR_BYTES == 32
    const half_16 rest = sum_32((half_32)v);
#else
    const half_16 rest = (half_16)v;
#endif
#if REAL_IS_FLOAT
    return (rest[0] + rest[2]) + (rest[1] + rest[3]);
#else
    return rest[0] + rest[1];
#endif
}
#else
INLINE real lane_sum(vec v) { return v; }
#endif

/* b[width] += the sum of A's rows, which are `lda` apart. */
static void add_rows(size_t rows, size_t width, const real *A, size_t lda, real *b) {
    for (size_t i = 0; i < width; i += LANES) {
        vec even = load(b + i), odd = splat(0);
        size_t s = 0;
        for (; s + 2 <= rows; s += 2) {
            even += load(A + s * lda + i);
            odd += load(A + (s + 1) * lda + i);
        }
        if (s < rows) even += load(A + s * lda + i);
        store(b + i, even + odd);
    }
}

/* Sums over n (a multiple of LANES) of A's rows, which are contiguous, times b: sums[r * stride], r < TILE. */
INLINE void dots(const real *A, const real *b, size_t n, real *sums, size_t stride) {
    vec sum[TILE];
    for (int r = 0; r < TILE; r++) sum[r] = load(A + r * n) * load(b);
    for (size_t i = LANES; i < n; i += LANES) {
        const vec factor = load(b + i);
        for (int r = 0; r < TILE; r++) sum[r] += load(A + r * n + i) * factor;
    }
    for (int r = 0; r < TILE; r++) sums[r * stride] = lane_sum(sum[r]);
}

/* Sum over n of a*b[i*stride], where there are no whole vectors. */
INLINE real short_dot(const real *a, const real *b, size_t stride, int n) {
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i * stride];
    return sum;
}

/* ---------------------------------------------------------------- activations: z -> value, slope */

enum { SILU, TANH, SOFTPLUS, RELU, GELU, SIGMOID, ELU, SIN };

#define EACH(body) \
    for (size_t i = 0; i < n; i += LANES) { \
        const vec x = load(z + i); \
        vec y, s; \
        body; \
        store(z + i, y); \
        store(slope + i, s); \
    }

#define EACH_ALONE(body) \
    for (size_t i = 0; i < n; i++) { \
        const real x = z[i]; \
        body; \
    }

static void silus(real *restrict z, real *restrict slope, size_t n) {
    vec x[SIDE_BY_SIDE], s[SIDE_BY_SIDE];
    size_t i = 0;
    for (; i + SIDE_BY_SIDE * LANES <= n; i += SIDE_BY_SIDE * LANES) {
        UNROLL for (int j = 0; j < SIDE_BY_SIDE; j++) x[j] = load(z + i + j * LANES);
        silu(SIDE_BY_SIDE, x, s);
        UNROLL for (int j = 0; j < SIDE_BY_SIDE; j++) store(z + i + j * LANES, x[j]), store(slope + i + j * LANES, s[j]);
    }
    for (; i < n; i += LANES) {
        x[0] = load(z + i);
        silu(1, x, s);
        store(z + i, x[0]), store(slope + i, s[0]);
    }
}

/* n is a multiple of LANES. */
APART void activate(int kind, real *restrict z, real *restrict slope, size_t n) {
    switch (kind) {
    case SILU: silus(z, slope, n); break;
    case TANH: EACH(y = v_tanh(x); s = R(1) - y * y) break;
    case SOFTPLUS: EACH(vec q; v_logistic(x, &s, &q); y = v_softplus(x)) break;
    case RELU: EACH(y = SELECT(x < splat(0), splat(0), x); s = SELECT(x > splat(0), splat(1), splat(0))) break;
    case SIGMOID: EACH(vec q; v_logistic(x, &y, &q); s = y * q) break;
    case ELU:
        EACH(const vec e = v_expm1(SELECT(x > splat(0), splat(0), x)); y = SELECT(x > splat(0), x, e);
             s = SELECT(x > splat(0), splat(1), e + R(1)))
        break;
    case GELU:
        EACH_ALONE(const real c = R(0.5) * (R(1) + FN(erf)(x * R(0.70710678118654752440))); z[i] = x * c;
                   slope[i] = c + x * R(0.39894228040143267794) * FN(exp)(R(-0.5) * x * x))
        break;
    default: EACH_ALONE(z[i] = FN(sin)(x); slope[i] = FN(cos)(x)) break;
    }
}
