/* Fuzzes segment_sum and segment_spread: sums in stored order are exact in float arithmetic, whatever the values. */
#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  const int64_t C = take_size(40), F = take_size(300);
  const bool mean = take_byte() % 2;
  int64_t *offsets = take_offsets(C, 300), N = offsets[C], *order = new_ints(N);
  check_state = take_word(2);
  for (int64_t i = 0; i < N; i++) { /* a random permutation */
    const int64_t j = (int64_t)(random_bits() % (uint64_t)(i + 1));
    order[i] = order[j];
    order[j] = i;
  }
  float *x = take_floats(N * F), *out = new_floats(C * F), *back = new_floats(N * F);
  READ_ONLY(x, order, offsets);
  CHECK(kernels->segment_sum(x, F, order, offsets, C, mean, out) == AST_OK, "status");
  READ_ONLY(out);
  CHECK(kernels->segment_spread(out, F, order, offsets, C, mean, back) == AST_OK, "status");
  for (int64_t c = 0; c < C; c++) {
    const int64_t rows = offsets[c + 1] - offsets[c];
    const float scale = mean && rows ? 1.0f / (float)rows : 1.0f;
    for (int64_t f = 0; f < F; f++) {
      float sum = 0;
      for (int64_t j = offsets[c]; j < offsets[c + 1]; j++) sum += x[order[j] * F + f];
      sum *= scale;
      CHECK(same_floats(&sum, out + c * F + f, 1), "segment %lld: %g, not %g", (long long)c, (double)out[c * F + f], (double)sum);
      sum *= scale;
      for (int64_t j = offsets[c]; j < offsets[c + 1]; j++)
        CHECK(same_floats(&sum, back + order[j] * F + f, 1), "row %lld", (long long)order[j]);
    }
  }
  FREE(x, out, back, order, offsets);
}
