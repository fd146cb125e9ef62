/* mlp and mlp_backward against the formula in double, on every instruction set, serial and on a pool.
 *
 * Accuracy: the largest error is at most twice the error of the formula in plain float plus 1e-6 of the largest value.
 */
#include "check.h"

static bool same_bits(const void *a, const void *b, int64_t floats) {
  return memcmp(a, b, (size_t)floats * sizeof(float)) == 0;
}

enum { RESULTS = 9 };
static const char *const names[RESULTS] = {"out",      "dx",     "dbeside", "dweight1", "dbias1",
                                           "dweight2", "dbias2", "dgamma",  "dbeta"};

typedef struct {
  ast_mlp s;
  int64_t sizes[RESULTS];
  float *arrays[10]; /* x, beside, weight1, bias1, weight2, bias2, gamma, beta, residual, dout */
} problem;

typedef struct {
  float *of[RESULTS];
} answer;

static problem new_problem(int64_t M, int64_t I, int64_t I2, int64_t H, int64_t O, bool norm) {
  const int64_t K = I + I2;
  const int64_t sizes[10] = {M * I, M * I2, H * K, H, O * H, O, O, O, M * O, M * O};
  const int64_t results[RESULTS] = {M * O, M * I, M * I2, H * K, H, O * H, O, O, O};
  problem a;
  memcpy(a.sizes, results, sizeof results);
  for (int i = 0; i < 10; i++) a.arrays[i] = random_floats(sizes[i]);
  a.s = (ast_mlp){M,
                  I,
                  I2,
                  H,
                  O,
                  I,
                  I2,
                  O,
                  O,
                  a.arrays[0],
                  I2 ? a.arrays[1] : NULL,
                  a.arrays[2],
                  a.arrays[3],
                  a.arrays[4],
                  a.arrays[5],
                  norm ? a.arrays[6] : NULL,
                  norm ? a.arrays[7] : NULL};
  return a;
}

static void free_problem(problem a) {
  for (int i = 0; i < 10; i++) FREE(a.arrays[i]);
}

static answer solve(const ast_kernels *kernels, const problem *a, bool keep) {
  const ast_mlp *s = &a->s;
  answer r;
  for (int i = 0; i < RESULTS; i++) r.of[i] = new_floats(a->sizes[i]);
  float *hidden = new_floats(s->M * s->H), *normalized = new_floats(s->M * s->O), *scale = new_floats(s->M);
  ast_mlp_kept kept = {0};
  if (keep) kept.hidden = hidden;
  if (keep && s->gamma) kept.normalized = normalized, kept.scale = scale;
  ast_mlp_gradients g = {r.of[1], s->beside ? r.of[2] : NULL, r.of[3], r.of[4], r.of[5], r.of[6], NULL, NULL};
  if (s->gamma) g.gamma = r.of[7], g.beta = r.of[8];
  for (int i = 0; i < 10; i++) READ_ONLY(a->arrays[i]);
  CHECK(kernels->mlp(s, a->arrays[8], r.of[0], kept) == AST_OK, "status");
  READ_ONLY(hidden, normalized, scale);
  CHECK(kernels->mlp_backward(s, a->arrays[9], kept, g) == AST_OK, "status");
  for (int i = 0; i < 10; i++) WRITABLE(a->arrays[i]);
  FREE(hidden, normalized, scale);
  return r;
}

static void free_answer(answer r) {
  for (int i = 0; i < RESULTS; i++) FREE(r.of[i]);
}

#define real    double
#define FORMULA formula
#include "formula_mlp.h"
#define real    float
#define FORMULA formula_float
#include "formula_mlp.h"

static void check_against_formula(const problem *a, const answer *r) {
  double *exact[RESULTS];
  float *plain[RESULTS];
  for (int i = 0; i < RESULTS; i++) {
    exact[i] = calloc((size_t)a->sizes[i] + 1, sizeof(double));
    plain[i] = calloc((size_t)a->sizes[i] + 1, sizeof(float));
  }
  for (int64_t i = 0; i < a->s.M; i++) formula(a, i, exact), formula_float(a, i, plain);
  for (int i = 0; i < RESULTS; i++) {
    double error = 0, plain_error = 0, largest = 0;
    const bool given = !(i == 2 && !a->s.beside) && !(i >= 7 && !a->s.gamma);
    for (int64_t j = 0; given && j < a->sizes[i]; j++) {
      CHECK(isfinite(r->of[i][j]), "%s[%lld] is %g", names[i], (long long)j, (double)r->of[i][j]);
      error = fmax(error, fabs((double)r->of[i][j] - exact[i][j]));
      plain_error = fmax(plain_error, fabs((double)plain[i][j] - exact[i][j]));
      largest = fmax(largest, fabs(exact[i][j]));
    }
    CHECK(error <= 2 * plain_error + 1e-6 * largest, "%s is off by %g of %g, plain float by %g", names[i], error,
          largest, plain_error);
    free(exact[i]), free(plain[i]);
  }
}

static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t sizes[][5] = {{0, 3, 2, 4, 5},    {1, 1, 0, 1, 2},      {2, 3, 0, 17, 3},
                                     {7, 5, 4, 6, 33},   {12, 16, 16, 16, 16}, {13, 33, 5, 64, 31},
                                     {95, 3, 0, 30, 16}, {97, 60, 7, 20, 2},   {193, 17, 0, 40, 48}};
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    for (int norm = 0; norm < 2; norm++) {
      problem a = new_problem(sizes[i][0], sizes[i][1], sizes[i][2], sizes[i][3], sizes[i][4], norm);
      for (int keep = 0; keep < 2; keep++) {
        answer r = solve(kernels, &a, keep);
        check_against_formula(&a, &r);
        free_answer(r);
      }
      free_problem(a);
    }
}

/* Rows of the LayerNorm that are exact, weight2 being 0: equal values give beta, whatever their size. Nearly equal ones
 * keep their differences, and values whose squares are too large for a float are normalized, too. Plain float is no
 * measure of either: the bound is the rule's, where plain float errs by half a unit in the last place. */
static void test_norm(const ast_kernels *kernels) {
  static const float means[] = {1.1f, 33333.33f, 3.3e7f, 3e38f, 1e20f, 1e-40f};
  static const int64_t channels[] = {1, 7, 48, 64, 128, 131, 300};
  for (int m = 0; m < 6; m++)
    for (int c = 0; c < 7; c++)
      for (int spread = 0; spread < 3; spread++) {
        const int64_t M = 5, O = channels[c];
        if (spread && (means[m] > 1e30f || means[m] < 1e-30f)) continue;
        problem a = new_problem(M, 3, 0, 4, O, true);
        memset(a.arrays[4], 0, (size_t)(4 * O) * sizeof(float));
        for (int64_t o = 0; o < O; o++)
          a.arrays[5][o] =
              spread == 2 ? means[m] * random_float() : means[m] * (1 + 3e-7f * (float)spread * random_float());
        answer r = solve(kernels, &a, false);
        double exact_mean = 0, variance = 0, largest = 0;
        for (int64_t o = 0; o < O; o++) exact_mean += (double)a.arrays[5][o] / (double)O;
        for (int64_t o = 0; o < O; o++) variance += pow((double)a.arrays[5][o] - exact_mean, 2) / (double)O;
        for (int64_t i = 0; i < M * O; i++) largest = fmax(largest, fabs((double)r.of[0][i]));
        for (int64_t i = 0; i < M * O; i++) {
          const double u = ((double)a.arrays[5][i % O] - exact_mean) / sqrt(variance + 1e-5);
          const float beta = a.arrays[7][i % O], residual = a.arrays[8][i];
          const double exact = (double)a.arrays[6][i % O] * u + (double)beta + (double)residual;
          CHECK(spread ? fabs((double)r.of[0][i] - exact) <= 1.2e-6 * largest : r.of[0][i] == beta + residual,
                "out[%lld] of %lld channels near %g is %g, not %g", (long long)i, (long long)O, (double)means[m],
                (double)r.of[0][i], exact);
        }
        free_answer(r), free_problem(a);
      }
}

/* The same bits whether hidden units are kept or not, on a pool or not, and for rows alone. */
static void test_same_bits(const ast_kernels *kernels) {
  problem a = new_problem(500, 20, 9, 40, 33, true);
  const bool pool = ast_threads() > 1;
  answer first = solve(kernels, &a, false), kept = solve(kernels, &a, true);
  ast_set_pool(NULL, NULL);
  answer serial = solve(kernels, &a, false);
  if (pool) ast_set_pool(pool_for, pool_threads);
  for (int i = 0; i < RESULTS; i++) {
    CHECK(same_bits(first.of[i], kept.of[i], a.sizes[i]), "%s differs if hidden units are kept", names[i]);
    CHECK(same_bits(first.of[i], serial.of[i], a.sizes[i]), "%s differs with the threads", names[i]);
  }
  for (int64_t row = 0; row < 500; row += 166) {
    problem one = a;
    one.s.M = 1;
    one.s.x += row * 20, one.s.beside += row * 9, one.arrays[8] += row * 33, one.arrays[9] += row * 33;
    one.sizes[0] = 33, one.sizes[1] = 20, one.sizes[2] = 9;
    answer r = solve(kernels, &one, false);
    CHECK(same_bits(r.of[0], first.of[0] + row * 33, 33) && same_bits(r.of[1], first.of[1] + row * 20, 20) &&
              same_bits(r.of[2], first.of[2] + row * 9, 9),
          "row %lld differs alone", (long long)row);
    free_answer(r);
  }
  free_answer(first), free_answer(kept), free_answer(serial), free_problem(a);
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_norm(kernels);
  test_same_bits(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
