/* Fuzzes attention and its gradients: a scene alone gives the bits that it gives in its batch, rows apart give the bits
 * of contiguous rows. Where the scores are moderate, results agree with the formula in double within the rounding of
 * the scores, and are not finite where the formula is not. */
#define main tests_of_attention
#include "test_attention.c"
#undef main

#include "fuzz.h"

static void check_alone(const ast_kernels *kernels, const problem *a, const answer *batch, int64_t b) {
  const int64_t row = a->H * a->D, q0 = a->q_offsets[b], k0 = a->k_offsets[b];
  problem one = {
      .B = 1, .H = a->H, .D = a->D, .Tq = a->q_offsets[b + 1] - q0, .Tk = a->k_offsets[b + 1] - k0, .p = a->p};
  one.q_offsets[1] = one.Tq, one.k_offsets[1] = one.Tk;
  one.q = a->q + q0 * row, one.k = a->k + k0 * row, one.v = a->v + k0 * row, one.dout = a->dout + q0 * row;
  answer alone = solve(kernels, &one);
  CHECK(same_floats(alone.out, batch->out + q0 * row, one.Tq * row) &&
            same_floats(alone.dq, batch->dq + q0 * row, one.Tq * row) &&
            same_floats(alone.dk, batch->dk + k0 * row, one.Tk * row) &&
            same_floats(alone.dv, batch->dv + k0 * row, one.Tk * row) &&
            same_floats(alone.maximum, batch->maximum + q0 * a->H, one.Tq * a->H) &&
            same_floats(alone.sum, batch->sum + q0 * a->H, one.Tq * a->H),
        "scene %lld differs alone and in a batch", (long long)b);
  free_answer(alone);
}

/* Whether rows of n floats, `stride` apart, equal the rows of x, with NaN as in new buffers between them. */
static bool same_apart(const float *got, const float *x, int64_t rows, int64_t n, int64_t stride) {
  float *expected = apart(x, rows, n, stride);
  const bool same = same_floats(got, expected, rows ? (rows - 1) * stride + n : 0);
  FREE(expected);
  return same;
}

/* Rows of q, k and v, and of their gradients, `gap` floats more apart. */
static void check_strides(const ast_kernels *kernels, const problem *a, const answer *contiguous, int64_t gap) {
  const int64_t row = a->H * a->D, stride = row + gap;
  ast_attention s = sizes_of(a);
  s.q_stride = s.k_stride = s.v_stride = s.dq_stride = s.dk_stride = s.dv_stride = stride;
  float *q = apart(a->q, a->Tq, row, stride), *k = apart(a->k, a->Tk, row, stride),
        *v = apart(a->v, a->Tk, row, stride);
  problem wide = *a; /* with room for gradients of such rows */
  wide.Tq += a->Tq * gap / row + 1, wide.Tk += a->Tk * gap / row + 1;
  answer r = solve_rows(kernels, &wide, s, q, k, v);
  CHECK(same_floats(r.out, contiguous->out, a->Tq * row) && same_floats(r.maximum, contiguous->maximum, a->Tq * a->H) &&
            same_floats(r.sum, contiguous->sum, a->Tq * a->H) && same_apart(r.dq, contiguous->dq, a->Tq, row, stride) &&
            same_apart(r.dk, contiguous->dk, a->Tk, row, stride) &&
            same_apart(r.dv, contiguous->dv, a->Tk, row, stride),
        "rows %lld floats apart differ", (long long)gap);
  FREE(q, k, v);
  free_answer(r);
}

static void compare_values(const char *what, const float *got, const double *exact, int64_t n, double bound) {
  for (int64_t i = 0; i < n; i++)
    CHECK(isfinite(exact[i]) ? fabs((double)got[i] - exact[i]) <= bound : !isfinite(got[i]),
          "%s[%lld] is %g, not %g within %g", what, (long long)i, (double)got[i], exact[i], bound);
}

/* error: of a weight, relative, from the rounding of its score */
static void check_values(const problem *a, const answer *r) {
  const int64_t row = a->H * a->D, queries = a->Tq * row, keys = a->Tk * row;
  const double q = largest_finite(a->q, queries), k = largest_finite(a->k, keys), v = largest_finite(a->v, keys);
  const double y = largest_finite(a->dout, queries), D = (double)a->D, scale = 1 / sqrt(D), score = scale * D * q * k;
  const double error = 2e-7 * (D + 8) * score + 1e-7 * (double)(a->Tk + a->Tq + 16), gain = 1 / (1 - fmin(a->p, 0.99));
  const double slope = 4 * gain * D * y * v * scale; /* of dS */
  if (!(score < 40 && v < 1e10 && y < 1e10 && q < 1e10 && k < 1e10)) return;
  double *out = calloc((size_t)(2 * queries + 2 * keys + a->Tq * a->H + 1), sizeof *out), *dq = out + queries,
         *dk = dq + queries;
  double *dv = dk + keys, *lse = dv + keys;
  CHECK(out, "no memory");
  formula(a, out, lse, dq, dk, dv);
  compare_values("out", r->out, out, queries, 4 * error * gain * v + 1e-37);
  compare_values("dq", r->dq, dq, queries, 8 * error * slope * k + 1e-36);
  compare_values("dk", r->dk, dk, keys, 8 * error * slope * q * (double)a->Tq + 1e-36);
  compare_values("dv", r->dv, dv, keys, 8 * error * gain * y * (double)a->Tq + 1e-36);
  free(out);
}

enum { COST = 1 << 19 }; /* pairs of a query and a key, times channels, about */

/* Scenes of any sizes, or, first, one so long in queries or in keys that it is cut over them. What their pairs cost is
 * saved on heads, then on channels. */
static problem take_problem(void) {
  static const double rates[] = {0, 0, 0.1, 0.9, 1e-9, 0.999999, 0.5, 0};
  problem a = {
      .B = take_size(5), .H = 1 + take_byte() % 3, .D = 16 * (1 + take_byte() % 8), .p = rates[take_byte() % 8]};
  const int shape = take_byte() % 16;
  int64_t pairs = 0;
  for (int64_t b = 0; b < a.B; b++) {
    int64_t queries = take_size(160), keys = take_size(160);
    if (b == 0 && shape == 15) queries = 500 + 2 * take_size(600), keys %= 40;
    if (b == 0 && shape == 14) keys = 1000 + take_size(600), queries %= 40;
    keys = within(COST / 16, queries, keys);
    a.q_offsets[b + 1] = a.Tq += queries;
    a.k_offsets[b + 1] = a.Tk += keys;
    pairs += queries * keys;
  }
  while (pairs * a.H * a.D > COST && a.H > 1) a.H--;
  while (pairs * a.H * a.D > COST && a.D > 16) a.D -= 16;
  const int64_t row = a.H * a.D;
  a.q = take_floats(a.Tq * row), a.k = take_floats(a.Tk * row), a.v = take_floats(a.Tk * row),
  a.dout = take_floats(a.Tq * row);
  return a;
}

static void fuzz(const ast_kernels *kernels) {
  problem a = take_problem();
  answer r = solve(kernels, &a);
  const int64_t b = a.B ? (a.p > 0 ? 0 : take_index(a.B)) : 0; /* with dropout a scene alone has index 0 */
  if (a.B) check_alone(kernels, &a, &r, b);
  const int gap = take_byte();
  if (gap % 2) check_strides(kernels, &a, &r, gap / 2);
  check_values(&a, &r);
  free_answer(r), free_problem(a);
}
