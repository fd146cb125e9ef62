/* Fuzzes linear and its gradients: rows alone give the bits that they give among others, nothing depends on the rows'
 * strides or on which gradients are wanted, and where all sums are moderate the results agree with the formula in
 * double within the rounding of their terms. */
#define main tests_of_linear
#include "test_linear.c"
#undef main

#include "fuzz.h"

static void check_rows(const ast_kernels *kernels, const problem *a, const answer *all) {
  problem part = *a;
  const int64_t first = take_index(a->s.M), M = 1 + take_index(a->s.M - first);
  part.s.M = M;
  part.x += first * a->s.I, part.residual += first * a->columns, part.dout += first * a->columns;
  part.sizes[0] = M * a->columns, part.sizes[1] = M * a->s.I;
  answer r = solve(kernels, &part, false);
  CHECK(same_floats(r.of[0], all->of[0] + first * a->columns, part.sizes[0]), "out of rows %lld + %lld",
        (long long)first, (long long)M);
  CHECK(same_floats(r.of[1], all->of[1] + first * a->s.I, part.sizes[1]), "dx of rows %lld + %lld", (long long)first,
        (long long)M);
  free_answer(r);
}

/* Rows `gap` floats more apart, and only the gradients in the set `wanted`, z recomputed. */
static void check_strides(const ast_kernels *kernels, const problem *a, const answer *all, int64_t gap, int wanted) {
  ast_linear s = a->s;
  s.x_stride += gap, s.weight_stride += gap, s.residual_stride += gap, s.dout_stride += gap;
  float *x = apart(a->x, s.M, s.I, s.x_stride), *weight = apart(a->weight, s.O, s.I, s.weight_stride);
  float *residual = apart(a->residual, s.M, a->columns, s.residual_stride);
  float *dout = apart(a->dout, s.M, a->columns, s.dout_stride), *r[RESULTS] = {0};
  for (int i = 0; i < RESULTS; i++)
    if (i == 0 || wanted >> (i - 1) & 1) r[i] = new_floats(a->sizes[i]);
  READ_ONLY(x, weight, residual, dout);
  CHECK(kernels->linear(&s, x, weight, a->bias, residual, r[0], NULL) == AST_OK, "status");
  CHECK(kernels->linear_backward(&s, dout, x, weight, a->bias, NULL, r[1], r[2], r[3]) == AST_OK, "status");
  for (int i = 0; i < RESULTS; i++)
    CHECK(!r[i] || same_floats(r[i], all->of[i], a->sizes[i]), "%s differs with strides and the gradients %#x",
          names[i], wanted);
  FREE(x, weight, residual, dout, r[0], r[1], r[2], r[3]);
}

/* GEGLU multiplies a value by another; its slope is below 1.2. */
static void check_values(const problem *a, const answer *r) {
  const double I = (double)a->s.I, x = largest_finite(a->x, a->s.M * a->s.I),
               w = largest_finite(a->weight, a->s.O * a->s.I);
  const double bias = largest_finite(a->bias, a->s.O), residual = largest_finite(a->residual, a->sizes[0]);
  const double y = largest_finite(a->dout, a->sizes[0]), z = I * x * w + bias, dz = 1.2 * y * fmax(1, z),
               M = (double)a->s.M;
  if (!(all_finite(a->x, a->s.M * a->s.I) && all_finite(a->weight, a->s.O * a->s.I) && all_finite(a->bias, a->s.O) &&
        all_finite(a->residual, a->sizes[0]) && all_finite(a->dout, a->sizes[0])) ||
      !(z < 1e4 && residual < 1e8 && y < 1e8 && x < 1e8 && w < 1e8))
    return;
  double *exact[RESULTS];
  const double error = 4e-7 * (I + 8) * fmax(1, z), slope = error * (1 + z) * 4 * y; /* of z, of dz */
  const double bounds[RESULTS] = {error * (2 + 4 * z) + 2e-7 * residual,
                                  (slope + 2e-7 * (double)a->s.O * dz) * w * (double)a->s.O,
                                  (slope + 2e-7 * M * dz) * x * M, (slope + 2e-7 * M * dz) * M};
  for (int i = 0; i < RESULTS; i++) exact[i] = calloc((size_t)a->sizes[i] + 1, sizeof(double));
  formula(a, exact[0], exact[1], exact[2], exact[3]);
  for (int i = 0; i < RESULTS; i++) {
    for (int64_t j = 0; j < a->sizes[i] && (a->s.activation != AST_RELU || i == 0); j++)
      CHECK(fabs((double)r->of[i][j] - exact[i][j]) <= bounds[i] + 1e-30, "%s[%lld] is %g, not %g within %g", names[i],
            (long long)j, (double)r->of[i][j], exact[i][j], bounds[i]);
    free(exact[i]);
  }
}

static void fuzz(const ast_kernels *kernels) {
  const bool tall = take_chance(); /* so that tasks have several blocks of rows */
  const int64_t I = take_size(tall ? 8 : 300), half = take_size(tall ? 8 : 130);
  const ast_activation activation = (ast_activation)(take_byte() % 3);
  const int64_t O = activation == AST_GEGLU ? 2 * half : half + take_byte() % 2;
  const int64_t M = within(1 << 18, I * O, take_size(600) + (tall ? 6100 : 0));
  const uint8_t byte = take_byte();
  problem a = {.s = {M, I, O, I, I, 0, 0, activation}, .columns = activation == AST_GEGLU ? O / 2 : O};
  a.s.residual_stride = a.s.dout_stride = a.columns;
  const int64_t sizes[RESULTS] = {M * a.columns, M * I, O * I, O};
  memcpy(a.sizes, sizes, sizeof sizes);
  a.x = take_floats(M * I), a.weight = take_floats(O * I), a.bias = take_floats(O);
  a.residual = take_floats(sizes[0]), a.dout = take_floats(sizes[0]);
  answer r = solve(kernels, &a, byte % 2);
  if (M) check_rows(kernels, &a, &r);
  check_strides(kernels, &a, &r, byte / 16, byte / 2 % 8);
  check_values(&a, &r);
  free_answer(r), free_problem(a);
}
