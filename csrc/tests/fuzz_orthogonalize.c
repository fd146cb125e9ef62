/* Fuzzes orthogonalize: a matrix alone, and transposed if it is not square, gives the bits that it gives among others.
 * Of finite numbers it makes numbers of at most about 1, of others NaN. */
#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t R = take_size(100), C = within(4000, R, take_size(100)), size = R * C;
  const int64_t K = within(12000, size, take_size(5)), one = K ? take_index(K) : 0;
  float *x = take_floats(K * size), *out = new_floats(K * size);
  float *alone = new_floats(K ? size : 0), *turned = new_floats(K ? size : 0), *result = new_floats(K ? size : 0);
  READ_ONLY(x);
  CHECK(kernels->orthogonalize(x, K, R, C, out) == AST_OK, "status");
  for (int64_t k = 0; k < K; k++) {
    const bool finite = all_finite(x + k * size, size);
    for (int64_t i = k * size; i < (k + 1) * size; i++)
      CHECK(finite ? fabs((double)out[i]) < 1.3 : isnan(out[i]), "[%lld] is %g", (long long)i, (double)out[i]);
  }
  const float *mine = x + one * size;
  for (int64_t i = 0; K && i < size; i++) alone[i] = mine[i], turned[i % C * R + i / C] = mine[i];
  READ_ONLY(alone, turned);
  CHECK(kernels->orthogonalize(alone, K ? 1 : 0, R, C, result) == AST_OK, "status");
  CHECK(!K || same_floats(result, out + one * size, size), "matrix %lld differs alone", (long long)one);
  CHECK(kernels->orthogonalize(turned, K && R != C ? 1 : 0, C, R, result) == AST_OK, "status");
  for (int64_t i = 0; K && R != C && i < size; i++)
    CHECK(same_floats(result + i % C * R + i / C, out + one * size + i, 1), "[%lld] differs transposed", (long long)i);
  FREE(x, out, alone, turned, result);
}
