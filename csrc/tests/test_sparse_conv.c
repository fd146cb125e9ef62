/* sparse_conv, its transposed form and its weight gradient against three loops in double.
 *
 * Accuracy: the largest error is at most twice the error of the same loops in float plus 1e-6 of the largest value.
 */
#include "problems.h"

/* sparse_conv on `destinations` rows, and its weight gradient. */
static float *convolve(const ast_kernels *kernels, const ast_pairs *p, int64_t destinations, const float *x,
                       const float *weight, const float *bias, int64_t C_in, int64_t C_out, bool transposed) {
  float *out = new_floats(destinations * C_out);
  READ_ONLY(PAIR_BUFFERS(p), x, weight, bias);
  CHECK(kernels->sparse_conv(x, weight, bias, C_in, C_out, transposed, *p, destinations, out) == AST_OK, "status");
  WRITABLE(PAIR_BUFFERS(p), x, weight, bias);
  return out;
}

static float *weight_gradient(const ast_kernels *kernels, const ast_pairs *p, const float *x, const float *dout,
                              int64_t C_in, int64_t C_out) {
  float *dweight = new_floats(OFFSETS * C_in * C_out);
  READ_ONLY(PAIR_BUFFERS(p), x, dout);
  CHECK(kernels->sparse_conv_weight(x, dout, C_in, C_out, *p, dweight) == AST_OK, "status");
  WRITABLE(PAIR_BUFFERS(p), x, dout);
  return dweight;
}

#define real    double
#define FORMULA formula
#include "formula_sparse_conv.h"
#define real    float
#define FORMULA formula_float
#include "formula_sparse_conv.h"

static void check_case(const ast_kernels *kernels, int64_t sources, int64_t destinations, int64_t C_in, int64_t C_out,
                       bool transposed) {
  const ast_pairs p = random_pairs(sources, destinations, 0.2, 1);
  const int64_t n = destinations * C_out, m = OFFSETS * C_in * C_out;
  float *x = random_floats(sources * C_in), *weight = random_floats(m), *dout = random_floats(n),
        *bias = random_floats(C_out);
  const float *used = (C_in + destinations) % 2 ? bias : NULL;
  double *exact = calloc((size_t)(n + m + 1), sizeof *exact);
  float *plain = calloc((size_t)(n + m + 1), sizeof *plain);
  CHECK(exact && plain, "no memory");
  formula(&p, destinations, x, weight, used, dout, C_in, C_out, transposed, exact, exact + n);
  formula_float(&p, destinations, x, weight, used, dout, C_in, C_out, transposed, plain, plain + n);
  float *out = convolve(kernels, &p, destinations, x, weight, used, C_in, C_out, transposed);
  float *dweight = weight_gradient(kernels, &p, x, dout, C_in, C_out);
  check_accuracy("out", out, exact, plain, n);
  check_accuracy("dweight", dweight, exact + n, plain + n, m);
  free(exact), free(plain);
  FREE(PAIR_BUFFERS(&p), x, weight, bias, dout, out, dweight);
}

static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t channels[][2] = {{0, 3},  {3, 0},   {1, 1},   {1, 16},  {3, 5},
                                        {16, 8}, {17, 33}, {64, 64}, {65, 130}};
  static const int64_t rows[][2] = {{0, 0}, {0, 3}, {4, 0}, {1, 1}, {2, 2}, {9, 300}, {700, 129}};
  for (int c = 0; c < 9; c++)
    for (int r = 0; r < 7; r++)
      check_case(kernels, rows[r][0], rows[r][1], channels[c][0], channels[c][1], (c + r) % 2);
  check_case(kernels, 900, 50000, 3, 5, false); /* ranges of rows, and groups in parts */
  check_case(kernels, 50, 3, 3, 150, true);     /* ranges of columns */
}

/* The transposed form is the adjoint: <conv(x), y> = <x, conv'(y)>, with the pairs of conv' sorted by the other end. */
static void test_adjoint(const ast_kernels *kernels) {
  const int64_t C_in = 24, C_out = 40, n = 200;
  int64_t *low = new_ints(OFFSETS * n), *high = new_ints(OFFSETS * n), offsets[OFFSETS + 1] = {0}, num = 0;
  for (int k = 0; k < OFFSETS; k++) { /* destination = source + k */
    for (int64_t i = 0; i + k < n; i++, num++) low[num] = i, high[num] = i + k;
    offsets[k + 1] = num;
  }
  const ast_pairs p = copy_pairs(offsets, low, high), q = copy_pairs(offsets, high, low);
  float *x = random_floats(n * C_in), *y = random_floats(n * C_out), *weight = random_floats(OFFSETS * C_in * C_out);
  float *out = convolve(kernels, &p, n, x, weight, NULL, C_in, C_out, false);
  float *back = convolve(kernels, &q, n, y, weight, NULL, C_out, C_in, true);
  double left = 0, right = 0, magnitude = 0;
  for (int64_t i = 0; i < n * C_out; i++)
    left += (double)out[i] * (double)y[i], magnitude += fabs((double)out[i] * (double)y[i]);
  for (int64_t i = 0; i < n * C_in; i++) right += (double)x[i] * (double)back[i];
  CHECK(fabs(left - right) <= 1e-6 * magnitude, "%.9g and %.9g", left, right);
  FREE(low, high, PAIR_BUFFERS(&p), PAIR_BUFFERS(&q), x, y, weight, out, back);
}

/* A scene alone gives the bits that it gives in a batch, and a NaN in another scene does not reach it. */
static void test_batch(const ast_kernels *kernels) {
  const int64_t C_in = 20, C_out = 36, sources = 900, destinations = 16000;
  const ast_pairs both = random_pairs(sources, destinations, 0.1, 2);
  int64_t *source = new_ints(both.offsets[OFFSETS]), *destination = new_ints(both.offsets[OFFSETS]),
          offsets[OFFSETS + 1] = {0}, n = 0;
  for (int k = 0; k < OFFSETS; k++) {
    for (int64_t i = both.offsets[k]; i < both.offsets[k + 1]; i++)
      if (both.destination[i] >= destinations / 2) {
        source[n] = both.source[i] - sources / 2;
        destination[n++] = both.destination[i] - destinations / 2;
      }
    offsets[k + 1] = n;
  }
  const ast_pairs one = copy_pairs(offsets, source, destination);
  float *x = random_floats(sources * C_in), *weight = random_floats(OFFSETS * C_in * C_out);
  for (int64_t i = 0; i < sources / 2 * C_in; i += 7) x[i] = NAN;
  float *batch = convolve(kernels, &both, destinations, x, weight, NULL, C_in, C_out, false);
  float *alone = convolve(kernels, &one, destinations / 2, x + sources / 2 * C_in, weight, NULL, C_in, C_out, false);
  for (int64_t i = 0; i < destinations / 2 * C_out; i++) CHECK(isfinite(alone[i]), "out[%lld]", (long long)i);
  CHECK(!memcmp(alone, batch + destinations / 2 * C_out, (size_t)(destinations / 2 * C_out) * sizeof *alone),
        "not the same bits");
  FREE(PAIR_BUFFERS(&both), PAIR_BUFFERS(&one), source, destination, x, weight, batch, alone);
}

/* The pool that this run is on gives what the calling thread alone gives: with pairs enough for
 * a weight gradient that is summed in parts. */
static void test_threads(const ast_kernels *kernels) {
  const int64_t C_in = 9, C_out = 17, n = 20000;
  const ast_pairs p = random_pairs(n, n, 0.5, 1);
  float *x = random_floats(n * C_in), *dout = random_floats(n * C_out), *weight = random_floats(OFFSETS * C_in * C_out),
        *out[2], *dweight[2];
  for (int i = 0; i < 2; i++) {
    if (i) ast_set_pool(NULL, NULL);
    out[i] = convolve(kernels, &p, n, x, weight, NULL, C_in, C_out, false);
    dweight[i] = weight_gradient(kernels, &p, x, dout, C_in, C_out);
  }
  CHECK(!memcmp(out[0], out[1], (size_t)(n * C_out) * sizeof(float)), "threads change the result");
  CHECK(!memcmp(dweight[0], dweight[1], (size_t)(OFFSETS * C_in * C_out) * sizeof(float)),
        "threads change the weight gradient");
  FREE(PAIR_BUFFERS(&p), x, dout, weight, out[0], out[1], dweight[0], dweight[1]);
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_adjoint(kernels);
  test_batch(kernels);
  test_threads(kernels); /* last: it takes the pool away */
}

int main(void) {
  on_every_table(test);
  return 0;
}
