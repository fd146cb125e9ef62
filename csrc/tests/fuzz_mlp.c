/* Fuzzes mlp and its gradients: rows alone give the bits that they give among others, absent arrays count as zeros,
 * nothing depends on the rows' strides or on which gradients are wanted, and results agree with the formula in double
 * within a bound that is computed along with it. */
#define main tests_of_mlp
#include "test_mlp.c"
#undef main

#include "fuzz.h"

/* ---- numbers with a bound of their error ---- */

/* What float arithmetic gives as some value within `error` of v, each operation being off by ROUNDING of its result at
 * most. */
typedef struct {
  double v, error;
} number;

static const double ROUNDING = 6.1e-8, SMALLEST = 1.5e-45,
                    LARGEST = 1e37; /* 2^-24 and a little; 2^-149; no overflow below this */

static number rounded(double v, double error) {
  const double most = fabs(v) + error;
  return (number){v, most < LARGEST ? error + ROUNDING * most + SMALLEST : INFINITY};
}
static number exactly(float v) { return (number){(double)v, 0}; }
static number plus(number a, number b) { return rounded(a.v + b.v, a.error + b.error); }
static number minus(number a, number b) { return rounded(a.v - b.v, a.error + b.error); }
static number times(number a, number b) {
  return rounded(a.v * b.v, fabs(a.v) * b.error + (fabs(b.v) + b.error) * a.error);
}
static number over(number a, int64_t n) { return rounded(a.v / (double)n, a.error / (double)n); }

/* 1 / sqrt(a + eps) within half the relative error of a + eps, and a little more as that is not small */
static number inverse_root(number a) {
  const double sum = a.v + (double)1e-5f, relative = a.error / sum + 2 * ROUNDING, v = 1 / sqrt(sum);
  return relative < 0.5 ? rounded(v, v * (1.5 * relative + 4 * ROUNDING)) : (number){v, INFINITY};
}

/* A sum of n terms in any order: each passes through n - 1 roundings at most. */
typedef struct {
  double v, error, magnitude;
  int64_t n;
} total;

static void add(total *to, number a) {
  *to = (total){to->v + a.v, to->error + a.error, to->magnitude + fabs(a.v) + a.error, to->n + 1};
}
static number sum_of(total s) {
  return (number){s.v,
                  s.magnitude < LARGEST ? s.error + (double)(s.n + 1) * ROUNDING * s.magnitude + SMALLEST : INFINITY};
}

/* ---- the formula in such numbers ---- */

/* One row: what test_mlp.c's formula computes, into totals laid out as the results. */
static void bound_row(const problem *a, int64_t i, total *const *r) {
  const ast_mlp *s = &a->s;
  const int64_t I = s->I, I2 = s->I2, K = I + I2, H = s->H, O = s->O;
  number *z = malloc((size_t)(2 * H + 2 * O + 1) * sizeof *z), *dz = z + H, *y = dz + H, *dy = y + O, scale = {1, 0};
  total mean = {0}, variance = {0}, mean_d = {0}, mean_dn = {0};
#define INPUT(k)  exactly((k) < I ? s->x[i * I + (k)] : s->beside[i * I2 + (k) - I])
#define HIDDEN(u) ((number){fmax(0, z[u].v), z[u].error})
  for (int64_t u = 0; u < H; u++) {
    total t = {0};
    for (int64_t k = 0; k < K; k++) add(&t, times(INPUT(k), exactly(s->weight1[u * K + k])));
    z[u] = plus(sum_of(t), exactly(s->bias1[u]));
  }
  for (int64_t o = 0; o < O; o++) {
    total t = {0};
    for (int64_t u = 0; u < H; u++) add(&t, times(HIDDEN(u), exactly(s->weight2[o * H + u])));
    y[o] = plus(sum_of(t), exactly(s->bias2[o]));
    add(&mean, y[o]);
  }
  for (int64_t o = 0; s->gamma && o < O; o++) {
    y[o] = minus(y[o], over(sum_of(mean), O));
    add(&variance, times(y[o], y[o]));
  }
  if (s->gamma) scale = inverse_root(over(sum_of(variance), O));
  for (int64_t o = 0; o < O; o++) {
    dy[o] = exactly(a->arrays[9][i * O + o]);
    number out = y[o];
    if (s->gamma) {
      y[o] = times(scale, y[o]);
      add(&r[7][o], times(dy[o], y[o]));
      add(&r[8][o], dy[o]);
      dy[o] = times(dy[o], exactly(s->gamma[o]));
      add(&mean_d, dy[o]);
      add(&mean_dn, times(dy[o], y[o]));
      out = plus(times(exactly(s->gamma[o]), y[o]), exactly(s->beta[o]));
    }
    add(&r[0][i * O + o], plus(out, exactly(a->arrays[8][i * O + o])));
  }
  for (int64_t o = 0; o < O; o++) {
    if (s->gamma)
      dy[o] = times(scale, minus(minus(dy[o], over(sum_of(mean_d), O)), times(y[o], over(sum_of(mean_dn), O))));
    add(&r[6][o], dy[o]);
    for (int64_t u = 0; u < H; u++) add(&r[5][o * H + u], times(dy[o], HIDDEN(u)));
  }
  for (int64_t u = 0; u < H; u++) {
    total t = {0};
    for (int64_t o = 0; o < O; o++) add(&t, times(dy[o], exactly(s->weight2[o * H + u])));
    dz[u] = sum_of(t);
    if (!(fabs(z[u].v) > z[u].error)) dz[u].error += fabs(dz[u].v); /* on either side of 0 */
    else if (z[u].v < 0) dz[u].error = 0;
    if (!(z[u].v > 0)) dz[u].v = 0;
    add(&r[4][u], dz[u]);
    for (int64_t k = 0; k < K; k++) add(&r[3][u * K + k], times(dz[u], INPUT(k)));
  }
  for (int64_t k = 0; k < K; k++)
    for (int64_t u = 0; u < H; u++)
      add(k < I ? &r[1][i * I + k] : &r[2][i * I2 + k - I], times(dz[u], exactly(s->weight1[u * K + k])));
  free(z);
}

static void check_values(const problem *a, const answer *r) {
  double *exact[RESULTS];
  total *totals[RESULTS];
  for (int i = 0; i < RESULTS; i++) {
    exact[i] = calloc((size_t)a->sizes[i] + 1, sizeof *exact[i]);
    totals[i] = calloc((size_t)a->sizes[i] + 1, sizeof *totals[i]);
    CHECK(exact[i] && totals[i], "no memory");
  }
  for (int64_t i = 0; i < a->s.M; i++) formula(a, i, exact), bound_row(a, i, totals);
  for (int i = 0; i < RESULTS; i++) {
    const bool given = !(i == 2 && !a->s.beside) && !(i >= 7 && !a->s.gamma);
    for (int64_t j = 0; given && j < a->sizes[i]; j++) {
      const number expected = sum_of(totals[i][j]);
      if (!(expected.error < LARGEST)) continue;
      CHECK(fabs((double)r->of[i][j] - exact[i][j]) <= expected.error + 1e-12 * fabs(exact[i][j]),
            "%s[%lld] is %g, not %g within %g", names[i], (long long)j, (double)r->of[i][j], exact[i][j],
            expected.error);
    }
    free(exact[i]), free(totals[i]);
  }
}

/* ---- the same again ---- */

static void check_rows(const ast_kernels *kernels, const problem *a, const answer *all, bool keep) {
  problem part = *a;
  const int64_t first = take_index(a->s.M), M = 1 + take_index(a->s.M - first);
  const int64_t rows[] = {a->s.O, a->s.I, a->s.I2};
  part.s.M = M;
  part.s.x += first * a->s.I, part.arrays[8] += first * a->s.O, part.arrays[9] += first * a->s.O;
  if (part.s.beside) part.s.beside += first * a->s.I2;
  for (int i = 0; i < 3; i++) part.sizes[i] = M * rows[i];
  answer r = solve(kernels, &part, keep);
  for (int i = 0; i < 3; i++)
    CHECK(same_floats(r.of[i], all->of[i] + first * rows[i], part.sizes[i]), "%s of rows %lld + %lld", names[i],
          (long long)first, (long long)M);
  free_answer(r);
}

/* Rows `gap` floats more apart, and only the gradients in the set `wanted`. */
static void check_strides(const ast_kernels *kernels, const problem *a, const answer *all, int64_t gap, int wanted) {
  ast_mlp s = a->s;
  s.x_stride += gap, s.beside_stride += gap, s.residual_stride += gap, s.dout_stride += gap;
  float *x = apart(s.x, s.M, s.I, s.x_stride), *beside = s.beside ? apart(s.beside, s.M, s.I2, s.beside_stride) : NULL;
  float *residual = apart(a->arrays[8], s.M, s.O, s.residual_stride),
        *dout = apart(a->arrays[9], s.M, s.O, s.dout_stride);
  float *r[RESULTS] = {0};
  for (int i = 0; i < RESULTS; i++)
    if (i == 0 || (wanted >> (i - 1) & 1 && !(i == 2 && !s.beside) && !(i >= 7 && !s.gamma)))
      r[i] = new_floats(a->sizes[i]);
  s.x = x, s.beside = beside;
  READ_ONLY(x, beside, residual, dout);
  CHECK(kernels->mlp(&s, residual, r[0], (ast_mlp_kept){0}) == AST_OK, "status");
  const ast_mlp_gradients to = {r[1], r[2], r[3], r[4], r[5], r[6], r[7], r[8]};
  CHECK(kernels->mlp_backward(&s, dout, (ast_mlp_kept){0}, to) == AST_OK, "status");
  for (int i = 0; i < RESULTS; i++)
    CHECK(!r[i] || same_floats(r[i], all->of[i], a->sizes[i]), "%s differs with strides and the gradients %#x",
          names[i], wanted);
  FREE(x, beside, residual, dout);
  for (int i = 0; i < RESULTS; i++) FREE(r[i]);
}

/* Without arrays that are zero. */
static void check_absent(const ast_kernels *kernels, const problem *a, const answer *all) {
  problem bare = *a;
  float *out = new_floats(a->sizes[0]);
  bare.s.bias1 = bare.s.bias2 = NULL;
  CHECK(kernels->mlp(&bare.s, NULL, out, (ast_mlp_kept){0}) == AST_OK, "status");
  for (int64_t i = 0; i < a->sizes[0]; i++)
    CHECK(out[i] == all->of[0][i] || (isnan(out[i]) && isnan(all->of[0][i])), "out[%lld] is %g, with zeros %g",
          (long long)i, (double)out[i], (double)all->of[0][i]);
  FREE(out);
}

static void fuzz(const ast_kernels *kernels) {
  const bool tall = take_chance(); /* so that tasks have several blocks of rows */
  const int64_t most = tall ? 3 : 300, I = take_size(most), I2 = take_byte() % 2 ? take_size(tall ? 3 : 40) : 0,
                K = I + I2;
  const int64_t O = take_size(tall ? 3 : 140), H = within(1 << 15, K + O, take_size(most));
  const int64_t M = within(1 << 18, H * (K + O), take_size(600) + (tall ? 6100 : 0));
  const int options = take_byte(), wanted = take_byte();
  const bool norm = options % 2, keep = options / 2 % 2, bare = options / 4 % 4 == 0;
  const int64_t sizes[10] = {M * I, M * I2, H * K, H, O * H, O, O, O, M * O, M * O};
  problem a = new_problem(M, I, I2, H, O, norm);
  for (int i = 0; i < 10; i++) take_values(a.arrays[i], sizes[i]);
  for (int i = 3; bare && i < 10; i += i == 5 ? 3 : 2)
    memset(a.arrays[i], 0, (size_t)sizes[i] * sizeof(float)); /* biases, residual */
  answer r = solve(kernels, &a, keep);
  if (M) check_rows(kernels, &a, &r, options / 16 % 2);
  check_strides(kernels, &a, &r, options / 32, wanted);
  if (bare) check_absent(kernels, &a, &r);
  check_values(&a, &r);
  free_answer(r), free_problem(a);
}
