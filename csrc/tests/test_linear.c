/* linear and linear_backward against the formula in double, on every instruction set, serial and on a pool.
 *
 * Accuracy: the largest error is at most twice the error of the formula in plain float plus 1e-6 of the largest value.
 */
#include "check.h"

static bool same_bits(const void *a, const void *b, int64_t floats) {
  return memcmp(a, b, (size_t)floats * sizeof(float)) == 0;
}

enum { RESULTS = 4 }; /* out, dx, dweight, dbias */
static const char *const names[RESULTS] = {"out", "dx", "dweight", "dbias"};

typedef struct {
  ast_linear s;
  int64_t columns, sizes[RESULTS];
  float *x, *weight, *bias, *residual, *dout;
} problem;

typedef struct {
  float *of[RESULTS], *z;
} answer;

static problem new_problem(int64_t M, int64_t I, int64_t O, ast_activation activation, float amplitude) {
  problem a = {.s = {M, I, O, I, I, 0, 0, activation}, .columns = activation == AST_GEGLU ? O / 2 : O};
  a.s.residual_stride = a.s.dout_stride = a.columns;
  const int64_t sizes[RESULTS] = {M * a.columns, M * I, O * I, O};
  memcpy(a.sizes, sizes, sizeof sizes);
  a.x = scaled_floats(M * I, amplitude), a.weight = random_floats(O * I), a.bias = random_floats(O);
  a.residual = random_floats(M * a.columns), a.dout = random_floats(M * a.columns);
  return a;
}

static void free_problem(problem a) { FREE(a.x, a.weight, a.bias, a.residual, a.dout); }

static answer solve(const ast_kernels *kernels, const problem *a, bool save) {
  answer r;
  for (int i = 0; i < RESULTS; i++) r.of[i] = new_floats(a->sizes[i]);
  r.z = new_floats(a->s.M * a->s.O);
  READ_ONLY(a->x, a->weight, a->bias, a->residual, a->dout);
  CHECK(kernels->linear(&a->s, a->x, a->weight, a->bias, a->residual, r.of[0], save ? r.z : NULL) == AST_OK, "status");
  READ_ONLY(r.z);
  CHECK(kernels->linear_backward(&a->s, a->dout, a->x, a->weight, a->bias, save ? r.z : NULL, r.of[1], r.of[2],
                                 r.of[3]) == AST_OK,
        "status");
  WRITABLE(a->x, a->weight, a->bias, a->residual, a->dout);
  return r;
}

static void free_answer(answer r) {
  for (int i = 0; i < RESULTS; i++) FREE(r.of[i]);
  FREE(r.z);
}

#define real    double
#define FORMULA formula
#include "formula_linear.h"
#define real    float
#define FORMULA formula_float
#include "formula_linear.h"

static void check_against_formula(const problem *a, const answer *r) {
  const int64_t numbers[] = {a->s.M, a->s.I, a->s.O, a->s.activation};
  uint64_t key = add_to_key(1, numbers, sizeof numbers);
  const float *const inputs[] = {a->x, a->weight, a->bias, a->residual, a->dout};
  const int64_t lengths[] = {a->sizes[1], a->sizes[2], a->sizes[3], a->sizes[0], a->sizes[0]};
  for (int i = 0; i < 5; i++) key = add_to_key(key, inputs[i], lengths[i] * (int64_t)sizeof(float));
  bool fresh;
  const formula_results *f = results_of(key, a->sizes, RESULTS, &fresh);
  if (fresh) {
    formula(a, f->exact[0], f->exact[1], f->exact[2], f->exact[3]);
    formula_float(a, f->plain[0], f->plain[1], f->plain[2], f->plain[3]);
  }
  for (int i = 0; i < RESULTS; i++) check_accuracy(names[i], r->of[i], f->exact[i], f->plain[i], a->sizes[i]);
}

/* Both ways of cutting the gradient of the weight, and all kinds of tails. */
static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t sizes[][3] = {{0, 3, 4},    {1, 1, 2},    {2, 1, 2},      {1, 17, 34},  {7, 5, 6},
                                     {12, 16, 32}, {13, 33, 64}, {95, 3, 128},   {96, 60, 2},  {97, 128, 30},
                                     {193, 64, 8}, {300, 12, 4}, {41, 130, 200}, {400, 9, 66}, {128, 96, 256}};
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    for (int activation = 0; activation < 3; activation++) {
      problem a = new_problem(sizes[i][0], sizes[i][1], sizes[i][2], (ast_activation)activation, i % 2 ? 1 : 3);
      for (int save = 0; save < 2; save++) {
        answer r = solve(kernels, &a, save);
        check_against_formula(&a, &r);
        free_answer(r);
      }
      free_problem(a);
    }
}

/* A row's results are the same bits wherever it stands and whoever computes it; dW has the same for any threads. */
static void test_same_bits(const ast_kernels *kernels) {
  static const int64_t sizes[2][2] = {{40, 70}, {299, 14}}; /* GEGLU of 14 has few outputs in each half */
  for (int i = 0; i < 6; i++) {
    problem a = new_problem(700, sizes[i / 3][0], sizes[i / 3][1], (ast_activation)(i % 3), 1);
    answer all = solve(kernels, &a, false), again = solve(kernels, &a, true);
    for (int j = 0; j < RESULTS; j++)
      CHECK(same_bits(all.of[j], again.of[j], a.sizes[j]), "%s differs if z is kept", names[j]);
    for (int64_t first = 0; first < 700; first += 233) {
      problem one = a;
      one.s.M = 1 + first / 17;
      if (first + one.s.M > 700) one.s.M = 1;
      one.x += first * one.s.I, one.residual += first * one.columns, one.dout += first * one.columns;
      one.sizes[0] = one.s.M * one.columns, one.sizes[1] = one.s.M * one.s.I;
      answer r = solve(kernels, &one, false);
      CHECK(same_bits(r.of[0], all.of[0] + first * one.columns, one.sizes[0]), "out of %lld rows alone",
            (long long)one.s.M);
      CHECK(same_bits(r.of[1], all.of[1] + first * one.s.I, one.sizes[1]), "dx of %lld rows alone", (long long)one.s.M);
      free_answer(r);
    }
    free_answer(all), free_answer(again), free_problem(a);
  }
}

static void test_same_bits_on_threads(const ast_kernels *kernels) {
  static const int64_t sizes[][3] = {{700, 40, 70}, {100, 130, 300}, {90, 128, 128}};
  for (int i = 0; i < 3; i++) {
    problem a = new_problem(sizes[i][0], sizes[i][1], sizes[i][2], AST_GEGLU, 1);
    answer first = solve(kernels, &a, false), again = solve(kernels, &a, false);
    ast_set_pool(NULL, NULL);
    answer serial = solve(kernels, &a, false);
    ast_set_pool(pool_for, pool_threads);
    for (int j = 0; j < RESULTS; j++) {
      CHECK(same_bits(first.of[j], again.of[j], a.sizes[j]), "%s changes from run to run", names[j]);
      CHECK(same_bits(first.of[j], serial.of[j], a.sizes[j]), "%s changes with the threads", names[j]);
    }
    free_answer(first), free_answer(again), free_answer(serial), free_problem(a);
  }
}

/* Rows that lie apart, and gradients that are not wanted. */
static void test_strides_and_absent_arrays(const ast_kernels *kernels) {
  const int64_t M = 100, I = 20, O = 18, apart = 50;
  problem a = new_problem(M, I, O, AST_RELU, 1);
  answer contiguous = solve(kernels, &a, false);
  float *wide = new_floats(M * apart);
  for (int64_t i = 0; i < M; i++) {
    memcpy(wide + i * apart, a.x + i * I, (size_t)I * sizeof *wide);
    memcpy(wide + i * apart + I, a.dout + i * O, (size_t)O * sizeof *wide);
  }
  float *weights = new_floats(O * apart);
  for (int64_t j = 0; j < O; j++) memcpy(weights + j * apart, a.weight + j * I, (size_t)I * sizeof *weights);
  ast_linear s = a.s;
  s.x_stride = s.dout_stride = s.weight_stride = apart;
  float *dx = new_floats(M * I), *dweight = new_floats(O * I), *dbias = new_floats(O), *out = new_floats(M * O);
  READ_ONLY(wide, weights, a.bias, a.residual);
  CHECK(kernels->linear(&s, wide, weights, a.bias, a.residual, out, NULL) == AST_OK, "status");
  CHECK(same_bits(out, contiguous.of[0], M * O), "strides change the result");
  CHECK(kernels->linear_backward(&s, wide + I, wide, weights, a.bias, NULL, dx, NULL, NULL) == AST_OK, "status");
  CHECK(same_bits(dx, contiguous.of[1], M * I), "dx alone");
  CHECK(kernels->linear_backward(&s, wide + I, wide, weights, a.bias, NULL, NULL, dweight, NULL) == AST_OK, "status");
  CHECK(same_bits(dweight, contiguous.of[2], O * I), "dweight alone");
  CHECK(kernels->linear_backward(&s, wide + I, wide, weights, a.bias, NULL, NULL, NULL, dbias) == AST_OK, "status");
  CHECK(same_bits(dbias, contiguous.of[3], O), "dbias alone");
  WRITABLE(a.bias, a.residual);
  memset(a.bias, 0, (size_t)O * sizeof *a.bias), memset(a.residual, 0, (size_t)(M * O) * sizeof *a.residual);
  answer zero = solve(kernels, &a, false);
  CHECK(kernels->linear(&s, wide, weights, NULL, NULL, out, NULL) == AST_OK, "status");
  CHECK(same_bits(out, zero.of[0], M * O), "without bias and residual");
  FREE(wide, weights, dx, dweight, dbias, out);
  free_answer(contiguous), free_answer(zero), free_problem(a);
}

/* A row that is not finite touches no other; the padding never shows. */
static void test_not_finite(const ast_kernels *kernels) {
  static const float values[3] = {NAN, INFINITY, -INFINITY};
  for (int activation = 0; activation < 3; activation++)
    for (int i = 0; i < 3; i++) {
      problem a = new_problem(50, 5, 6, (ast_activation)activation, 1);
      answer clean = solve(kernels, &a, false);
      a.x[31 * 5 + 2] = values[i];
      answer r = solve(kernels, &a, false);
      CHECK(same_bits(r.of[0], clean.of[0], 31 * a.columns) && same_bits(r.of[1], clean.of[1], 31 * 5), "rows before");
      CHECK(same_bits(r.of[0] + 32 * a.columns, clean.of[0] + 32 * a.columns, 18 * a.columns), "rows after");
      for (int64_t j = 0; j < a.columns; j++) {
        const float out = r.of[0][31 * a.columns + j];
        CHECK(!isfinite(out) || activation != AST_IDENTITY, "out is %g", (double)out);
        CHECK(isnan(out) || i > 0, "a NaN is lost");
      }
      free_answer(clean), free_answer(r), free_problem(a);
    }
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_same_bits(kernels);
  test_strides_and_absent_arrays(kernels);
  test_not_finite(kernels);
  if (ast_threads() > 1) test_same_bits_on_threads(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
