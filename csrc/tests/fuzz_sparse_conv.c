/* Fuzzes sparse_conv and sparse_conv_weight against the loops of their test: every sum within the rounding of its terms, and finite
 * where its terms are. */
#define main tests_of_sparse_conv
#include "test_sparse_conv.c"
#undef main

#include "fuzz.h"

/* exact: the sums in double; magnitude: of the absolute values of their terms, at most `terms` of them */
static void compare_sums(const char *what, const float *got, const double *exact, const double *magnitude, int64_t n, int64_t terms) {
  for (int64_t i = 0; i < n; i++) {
    if (isnan(magnitude[i]) || isinf(magnitude[i])) {
      CHECK(!isfinite(got[i]), "%s[%lld] is %g, but has a term that is not finite", what, (long long)i, (double)got[i]);
    } else if (magnitude[i] < 1e38) {
      const double bound = 1.2e-7 * (double)(terms + 2) * magnitude[i] + 1e-37;
      CHECK(fabs((double)got[i] - exact[i]) <= bound, "%s[%lld] is %g, not %g", what, (long long)i, (double)got[i], exact[i]);
    }
  }
}

static void fuzz(const ast_kernels *kernels) {
  const int64_t sources = take_size(300), destinations = take_size(300), C_in = take_size(140), C_out = take_size(80);
  const bool transposed = take_byte() % 2;
  const double density = take_byte() / 255.0;
  check_state = take_word(2);
  pair_list p = new_pairs(sources, destinations, density * density, 1);
  const int64_t n = destinations * C_out, m = OFFSETS * C_in * C_out, num = sources * C_in;
  float *x = take_floats(num), *weight = take_floats(m), *dout = take_floats(n);
  float *abs_x = new_floats(num), *abs_weight = new_floats(m), *abs_dout = new_floats(n);
  for (int64_t i = 0; i < num; i++) abs_x[i] = fabsf(x[i]);
  for (int64_t i = 0; i < m; i++) abs_weight[i] = fabsf(weight[i]);
  for (int64_t i = 0; i < n; i++) abs_dout[i] = fabsf(dout[i]);
  double *exact = calloc((size_t)(n + m + 1), sizeof *exact), *magnitude = calloc((size_t)(n + m + 1), sizeof *magnitude);
  CHECK(exact && magnitude, "no memory");
  formula(&p, x, weight, NULL, dout, C_in, C_out, transposed, exact, exact + n);
  formula(&p, abs_x, abs_weight, NULL, abs_dout, C_in, C_out, transposed, magnitude, magnitude + n);
  float *out = convolve(kernels, &p, x, weight, NULL, C_in, C_out, transposed),
        *dweight = weight_gradient(kernels, &p, x, dout, C_in, C_out);
  compare_sums("out", out, exact, magnitude, n, OFFSETS * C_in);
  compare_sums("dweight", dweight, exact + n, magnitude + n, m, destinations);
  free(p.source), free(p.destination), free(exact), free(magnitude);
  FREE(x, weight, dout, abs_x, abs_weight, abs_dout, out, dweight);
}
