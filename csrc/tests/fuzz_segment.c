/* Fuzzes segment_sum and segment_spread: sums in stored order are exact in float arithmetic, whatever the values. And
 * column_sum: a column alone gives the bits that it gives among others, within the rounding of its terms. */
#include "fuzz.h"

static void fuzz_segments(const ast_kernels *kernels) {
  const int64_t C = take_size(300);
  const bool mean = take_byte() % 2;
  int64_t *offsets = take_offsets(C, 300), N = offsets[C], *order = new_ints(N);
  const int64_t F = within(1 << 18, N, take_size(300));
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
      CHECK(same_floats(&sum, out + c * F + f, 1), "segment %lld: %g, not %g", (long long)c, (double)out[c * F + f],
            (double)sum);
      sum *= scale;
      for (int64_t j = offsets[c]; j < offsets[c + 1]; j++)
        CHECK(same_floats(&sum, back + order[j] * F + f, 1), "row %lld", (long long)order[j]);
    }
  }
  FREE(x, out, back, order, offsets);
}

/* Blocks of rows and the sums of blocks are both added in order: at most N + 2 roundings of a partial sum. */
static void fuzz_columns(const ast_kernels *kernels) {
  const int64_t N = take_size(600) * (1 + take_byte() % 3), F = take_size(40), one = F ? take_index(F) : 0;
  float *x = take_floats(N * F), *out = new_floats(F), *column = new_floats(N), *alone = new_floats(1);
  READ_ONLY(x);
  CHECK(kernels->column_sum(x, N, F, out) == AST_OK, "status");
  for (int64_t f = 0; f < F; f++) {
    double sum = 0, magnitude = 0;
    for (int64_t n = 0; n < N; n++) sum += (double)x[n * F + f], magnitude += fabs((double)x[n * F + f]);
    if (magnitude <= (double)FLT_MAX) {
      const double bound = 6e-8 * (double)(N + 2) * magnitude;
      CHECK(fabs((double)out[f] - sum) <= bound, "column %lld: %g, not %g within %g", (long long)f, (double)out[f], sum,
            bound);
    } else if (!isfinite(sum)) {
      CHECK(!isfinite(out[f]), "column %lld is %g, not %g", (long long)f, (double)out[f], sum);
    }
  }
  for (int64_t n = 0; F && n < N; n++) column[n] = x[n * F + one];
  READ_ONLY(column);
  CHECK(!F || kernels->column_sum(column, N, 1, alone) == AST_OK, "status");
  CHECK(!F || same_floats(alone, out + one, 1), "column %lld differs alone", (long long)one);
  FREE(x, out, column, alone);
}

static void fuzz(const ast_kernels *kernels) {
  if (take_byte() % 4) fuzz_segments(kernels);
  else fuzz_columns(kernels);
}
