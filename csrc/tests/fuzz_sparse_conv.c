/* Fuzzes sparse_conv and sparse_conv_weight against the loops of their test: every sum within the rounding of its
 * terms, and finite where its terms are. */
#define main tests_of_sparse_conv
#include "test_sparse_conv.c"
#undef main

#include "fuzz.h"

/* exact: the sums in double; magnitude: of the absolute values of their terms, at most `terms` of them */
static void compare_sums(const char *what, const float *got, const double *exact, const double *magnitude, int64_t n,
                         int64_t terms) {
  for (int64_t i = 0; i < n; i++) {
    if (isnan(magnitude[i]) || isinf(magnitude[i])) {
      CHECK(!isfinite(got[i]), "%s[%lld] is %g, but has a term that is not finite", what, (long long)i, (double)got[i]);
    } else if (magnitude[i] < 1e38) {
      const double bound = 1.2e-7 * (double)(terms + 2) * magnitude[i] + 1e-37;
      CHECK(fabs((double)got[i] - exact[i]) <= bound, "%s[%lld] is %g, not %g", what, (long long)i, (double)got[i],
            exact[i]);
    }
  }
}

static float *magnitudes(const float *x, int64_t n) {
  float *to = new_floats(n);
  for (int64_t i = 0; i < n; i++) to[i] = fabsf(x[i]);
  return to;
}

static void fuzz(const ast_kernels *kernels) {
  const bool many = take_chance(); /* pairs, so that a group is cut into parts */
  const int64_t sources = take_size(300), destinations = take_size(300) + (many ? 8192 : 0);
  const int options = take_byte();
  const bool transposed = options % 2, with_bias = options / 2 % 2;
  const double density = many ? 1 : take_byte() / 255.0;
  check_state = take_word(2);
  const ast_pairs p = random_pairs(sources, destinations, density * density, 1);
  const int64_t pairs = p.offsets[OFFSETS], C_in = take_size(many ? 3 : 140), wanted = take_size(many ? 3 : 80);
  const int64_t C_out = within(1 << 20, pairs * C_in, within(1 << 11, C_in, wanted));
  const int64_t n = destinations * C_out, m = OFFSETS * C_in * C_out, num = sources * C_in;
  float *x = take_floats(num), *weight = take_floats(m), *dout = take_floats(n),
        *bias = with_bias ? take_floats(C_out) : NULL;
  float *abs_x = magnitudes(x, num), *abs_weight = magnitudes(weight, m), *abs_dout = magnitudes(dout, n);
  float *abs_bias = with_bias ? magnitudes(bias, C_out) : NULL;
  double *exact = calloc((size_t)(n + m + 1), sizeof *exact),
         *magnitude = calloc((size_t)(n + m + 1), sizeof *magnitude);
  CHECK(exact && magnitude, "no memory");
  formula(&p, destinations, x, weight, bias, dout, C_in, C_out, transposed, exact, exact + n);
  formula(&p, destinations, abs_x, abs_weight, abs_bias, abs_dout, C_in, C_out, transposed, magnitude, magnitude + n);
  float *out = convolve(kernels, &p, destinations, x, weight, bias, C_in, C_out, transposed),
        *dweight = weight_gradient(kernels, &p, x, dout, C_in, C_out);
  compare_sums("out", out, exact, magnitude, n, OFFSETS * C_in + 1);
  compare_sums("dweight", dweight, exact + n, magnitude + n, m, destinations);
  free(exact), free(magnitude);
  FREE(PAIR_BUFFERS(&p), x, weight, dout, bias, abs_x, abs_weight, abs_dout, abs_bias, out, dweight);
}
