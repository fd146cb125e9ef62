/* orthogonalize against the formula in double, on every instruction set, serial and on a pool.
 *
 * Accuracy: the largest error is at most twice the error of the formula in plain float plus 1e-6 of the largest value.
 */
#include "check.h"

#define FORMULA exact_orthogonalize
#define real    double
#include "formula_orthogonalize.h"
#undef FORMULA
#undef real
#define FORMULA plain_orthogonalize
#define real    float
#include "formula_orthogonalize.h"

static void orthogonalize(const ast_kernels *kernels, const float *x, int64_t K, int64_t R, int64_t C, float *out) {
  READ_ONLY(x);
  CHECK(kernels->orthogonalize(x, K, R, C, out) == AST_OK, "status");
  WRITABLE(x);
}

static void compare(const ast_kernels *kernels, const float *x, int64_t K, int64_t R, int64_t C) {
  const int64_t size = R * C, sizes[] = {K * size};
  float *out = new_floats(K * size);
  orthogonalize(kernels, x, K, R, C, out);
  bool fresh;
  const formula_results *r =
      results_of(add_to_key(add_to_key((uint64_t)(K << 40 | R << 20 | C), x, K * size * 4), "o", 1), sizes, 1, &fresh);
  for (int64_t k = 0; fresh && k < K; k++) {
    exact_orthogonalize(x + k * size, R, C, r->exact[0] + k * size);
    plain_orthogonalize(x + k * size, R, C, r->plain[0] + k * size);
  }
  check_accuracy("out", out, r->exact[0], r->plain[0], K * size);
  FREE(out);
}

/* At sizes around every block, and a matrix of any magnitude. */
static void compare_sizes(const ast_kernels *kernels) {
  static const int64_t sizes[] = {1, 2, 7, 16, 17, 33, 48, 64, 75};
  static const float amplitudes[] = {1, 1e-30f, 1e30f, 3e38f, 1e-40f, 0};
  for (int i = 0; i < 9; i++)
    for (int j = 0; j < 9; j++) {
      float *x = scaled_floats(2 * sizes[i] * sizes[j], amplitudes[(i + j) % 6]);
      compare(kernels, x, 2, sizes[i], sizes[j]);
      FREE(x);
    }
}

/* What the values must be, whatever the formula: 0 stays 0, a rank of one keeps its vectors with a singular value of
 * about 1 (rounding beside them grows 3.45^5 times), orthogonal rows stay so, and no matrix sees its neighbours. */
static void known_results(const ast_kernels *kernels) {
  enum { K = 3, R = 20, C = 35, SIZE = R * C };
  float *x = random_floats(K * SIZE), *out = new_floats(K * SIZE);
  memset(x, 0, SIZE * sizeof *x);
  for (int64_t i = 0; i < SIZE; i++) x[SIZE + i] = (float)((i / C + 1) * (i % C - 10)) * 1e30f;
  for (int64_t i = 0; i < SIZE; i++) x[2 * SIZE + i] = i / C == i % C ? -3e-30f : 0;
  orthogonalize(kernels, x, K, R, C, out);
  double norm = 0;
  for (int64_t i = 0; i < SIZE; i++) {
    CHECK(memcmp(out + i, x + i, sizeof *x) == 0, "zero became %g", (double)out[i]);
    norm += (double)out[SIZE + i] * (double)out[SIZE + i];
    CHECK(fabs((double)out[2 * SIZE + i] - (i / C == i % C ? -1 : 0)) < 0.33, "%g", (double)out[2 * SIZE + i]);
  }
  CHECK(sqrt(norm) > 0.67 && sqrt(norm) < 1.22, "a singular value of %g", sqrt(norm));
  for (int64_t i = 0; i < SIZE; i++) {
    const double ratio = (double)out[SIZE + i] / (double)out[2 * SIZE - 1], expected = x[SIZE + i] / x[2 * SIZE - 1];
    CHECK(fabs(ratio - expected) < 1e-3, "%g, not %g", ratio, expected);
  }
  x[SIZE + 5] = NAN, x[2 * SIZE + 7] = INFINITY;
  float *beside = new_floats(K * SIZE);
  orthogonalize(kernels, x, K, R, C, beside);
  CHECK(memcmp(beside, out, SIZE * sizeof *out) == 0, "a matrix saw its neighbour");
  for (int64_t i = SIZE; i < K * SIZE; i++) CHECK(isnan(beside[i]), "[%lld] is %g", (long long)i, (double)beside[i]);
  FREE(x, out, beside);
}

static void test(const ast_kernels *kernels) {
  float *none = new_floats(0), *out = new_floats(0);
  orthogonalize(kernels, none, 0, 4, 5, out);
  orthogonalize(kernels, none, 3, 0, 5, out);
  orthogonalize(kernels, none, 3, 4, 0, out);
  FREE(none, out);
  compare_sizes(kernels);
  known_results(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
