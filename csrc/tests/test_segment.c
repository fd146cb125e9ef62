/* segment_sum and segment_spread against a double loop, at sizes around every block. */
#include "check.h"

static void compare(const ast_kernels *kernels, int64_t N, int64_t C, int64_t F, bool mean) {
  float *x = random_floats(N * F), *out = new_floats(C * F), *back = new_floats(N * F);
  int64_t *order = new_ints(N), *offsets = new_ints(C + 1);
  for (int64_t i = 0; i < N; i++) order[i] = i;
  for (int64_t i = N - 1; i > 0; i--) {
    const int64_t j = (int64_t)(random_bits() % (uint64_t)(i + 1)), o = order[i];
    order[i] = order[j];
    order[j] = o;
  }
  offsets[0] = 0;
  for (int64_t c = 1; c <= C; c++) {
    const int64_t left = N - offsets[c - 1];
    offsets[c] = c == C ? N : offsets[c - 1] + (int64_t)(random_bits() % (uint64_t)(left / 2 + 1));
  }
  READ_ONLY(x, order, offsets);
  CHECK(kernels->segment_sum(x, F, order, offsets, C, mean, out) == AST_OK, "status");
  READ_ONLY(out);
  CHECK(kernels->segment_spread(out, F, order, offsets, C, mean, back) == AST_OK, "status");
  for (int64_t c = 0; c < C; c++)
    for (int64_t f = 0; f < F; f++) {
      const double count = mean && offsets[c + 1] > offsets[c] ? (double)(offsets[c + 1] - offsets[c]) : 1;
      double sum = 0, magnitude = 0;
      for (int64_t j = offsets[c]; j < offsets[c + 1]; j++) {
        sum += (double)x[order[j] * F + f];
        magnitude += fabs((double)x[order[j] * F + f]);
        const float expected = out[c * F + f] * (float)(1 / (float)count);
        CHECK(back[order[j] * F + f] == expected, "row %lld", (long long)order[j]);
      }
      CHECK(fabs((double)out[c * F + f] - sum / count) <=
                1e-7 * (double)(offsets[c + 1] - offsets[c] + 2) * magnitude / count + 0.0,
            "N %lld C %lld F %lld: %g", (long long)N, (long long)C, (long long)F, (double)out[c * F + f]);
    }
  FREE(x, out, back, order, offsets);
}

/* Of values that do not cancel: the rounding errors of one long chain would add up, most of all where values are equal,
 * since all have one sign then. */
static void sum_columns(const ast_kernels *kernels, int64_t N, int64_t F, bool equal) {
  float *x = new_floats(N * F), *out = new_floats(F);
  for (int64_t i = 0; i < N * F; i++) x[i] = equal ? 0.3f : 1 + random_float();
  memset(out, 0xff, (size_t)F * 4);
  CHECK(kernels->column_sum(x, N, F, out) == AST_OK, "status");
  for (int64_t f = 0; f < F; f++) {
    double sum = 0;
    for (int64_t n = 0; n < N; n++) sum += (double)x[n * F + f];
    CHECK(fabs((double)out[f] - sum) <= 1e-6 * sum, "N %lld F %lld: %.9g, not %.9g", (long long)N, (long long)F,
          (double)out[f], sum);
  }
  FREE(x, out);
}

static void sum_one_segment(const ast_kernels *kernels, int64_t N, int64_t F) {
  float *x = new_floats(N * F), *out = new_floats(F);
  int64_t *order = new_ints(N), *offsets = new_ints(2);
  for (int64_t i = 0; i < N * F; i++) x[i] = 1 + random_float();
  for (int64_t n = 0; n < N; n++) order[n] = N - 1 - n;
  offsets[0] = 0;
  offsets[1] = N;
  READ_ONLY(x, order, offsets);
  CHECK(kernels->segment_sum(x, F, order, offsets, 1, false, out) == AST_OK, "status");
  for (int64_t f = 0; f < F; f++) {
    double sum = 0;
    for (int64_t n = 0; n < N; n++) sum += (double)x[n * F + f];
    CHECK(fabs((double)out[f] - sum) <= 1e-6 * sum, "N %lld F %lld: %.9g, not %.9g", (long long)N, (long long)F,
          (double)out[f], sum);
  }
  FREE(x, out, order, offsets);
}

static void test(const ast_kernels *kernels) {
  static const int64_t channels[] = {0, 1, 2, 3, 4, 15, 16, 17, 64, 128, 131};
  for (int f = 0; f < 11; f++)
    for (int mean = 0; mean < 2; mean++) {
      compare(kernels, 0, 0, channels[f], mean);
      compare(kernels, 0, 3, channels[f], mean);
      compare(kernels, 1, 1, channels[f], mean);
      compare(kernels, 2, 5, channels[f], mean);
      compare(kernels, 1001, 257, channels[f], mean);
    }
  static const int64_t rows[] = {0, 1, 511, 513, 2000};
  for (int f = 0; f < 11; f++)
    for (int n = 0; n < 5; n++)
      for (int equal = 0; equal < 2; equal++) sum_columns(kernels, rows[n], channels[f], equal);
  sum_columns(kernels, 4000000, 1, false);
  sum_columns(kernels, 1000000, 1, true);
  static const int64_t lengths[] = {255, 256, 257, 511, 512, 513, 769};
  for (int f = 0; f < 11; f++)
    for (int n = 0; n < 7; n++) sum_one_segment(kernels, lengths[n], channels[f]);
  sum_one_segment(kernels, 3000000, 1);
  sum_one_segment(kernels, 200000, 21);
}

int main(void) {
  on_every_table(test);
  return 0;
}
