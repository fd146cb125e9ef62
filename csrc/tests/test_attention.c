/* attention and attention_backward against the formula in double, on every instruction set, serial and on a pool.
 *
 * Accuracy: the largest error is at most twice the error of the formula in plain float plus 1e-6 of the largest value;
 * four times for scores of 1e4, where the rounding of a few scores is all that counts.
 */
#include "check.h"

static bool same_bits(const void *a, const void *b, int64_t floats) {
  return memcmp(a, b, (size_t)floats * sizeof(float)) == 0;
}

typedef struct {
  int64_t B, H, D, Tq, Tk;
  int64_t q_offsets[8], k_offsets[8];
  double p;
  float *q, *k, *v, *dout;
} problem;

typedef struct {
  float *out, *maximum, *sum, *dq, *dk, *dv;
} answer;

static problem new_problem(int64_t B, const int64_t *queries, const int64_t *keys, int64_t H, int64_t D,
                           float amplitude, double p) {
  problem a = {.B = B, .H = H, .D = D, .p = p};
  for (int64_t b = 0; b < B; b++) {
    a.q_offsets[b + 1] = a.Tq += queries[b];
    a.k_offsets[b + 1] = a.Tk += keys[b];
  }
  a.q = scaled_floats(a.Tq * H * D, amplitude);
  a.k = scaled_floats(a.Tk * H * D, amplitude);
  a.v = random_floats(a.Tk * H * D);
  a.dout = random_floats(a.Tq * H * D);
  return a;
}

static ast_attention sizes_of(const problem *a) {
  const int64_t row = a->H * a->D;
  return (ast_attention){.B = a->B,
                         .H = a->H,
                         .D = a->D,
                         .q_offsets = a->q_offsets,
                         .k_offsets = a->k_offsets,
                         .q_stride = row,
                         .k_stride = row,
                         .v_stride = row,
                         .dq_stride = row,
                         .dk_stride = row,
                         .dv_stride = row,
                         .scale = 1 / sqrtf((float)a->D),
                         .dropout_p = a->p,
                         .seed = 0x123456789abcdefu};
}

static answer new_answer(const problem *a) {
  const int64_t row = a->H * a->D;
  return (answer){new_floats(a->Tq * row), new_floats(a->Tq * a->H), new_floats(a->Tq * a->H),
                  new_floats(a->Tq * row), new_floats(a->Tk * row),  new_floats(a->Tk * row)};
}

/* Both directions, on q, k and v with rows of their own strides. */
static answer solve_rows(const ast_kernels *kernels, const problem *a, ast_attention s, const float *q, const float *k,
                         const float *v) {
  const answer r = new_answer(a);
  s.q_offsets = copy_ints(a->q_offsets, a->B + 1), s.k_offsets = copy_ints(a->k_offsets, a->B + 1);
  READ_ONLY(q, k, v, a->dout, s.q_offsets, s.k_offsets);
  CHECK(kernels->attention(&s, q, k, v, r.out, r.maximum, r.sum) == AST_OK, "status");
  READ_ONLY(r.out, r.maximum, r.sum);
  CHECK(kernels->attention_backward(&s, q, k, v, r.out, r.maximum, r.sum, a->dout, r.dq, r.dk, r.dv) == AST_OK,
        "status");
  WRITABLE(q, k, v, a->dout);
  FREE(s.q_offsets, s.k_offsets);
  return r;
}
static answer solve(const ast_kernels *kernels, const problem *a) {
  return solve_rows(kernels, a, sizes_of(a), a->q, a->k, a->v);
}

static void free_problem(problem a) { FREE(a.q, a.k, a.v, a.dout); }
static void free_answer(answer r) { FREE(r.out, r.maximum, r.sum, r.dq, r.dk, r.dv); }

/* ---- the formula ---- */

static uint32_t rotate(uint32_t x, int n) { return x << n | x >> (32 - n); }

/* Threefry-4x32 as in its paper, any number of rounds. */
static void threefry(int rounds, const uint32_t key[4], uint32_t x[4]) {
  static const int rotations[8][2] = {{10, 26}, {11, 21}, {13, 27}, {23, 5}, {6, 20}, {17, 11}, {25, 10}, {18, 20}};
  const uint32_t keys[5] = {key[0], key[1], key[2], key[3], 0x1BD11BDAu ^ key[0] ^ key[1] ^ key[2] ^ key[3]};
  for (int i = 0; i < 4; i++) x[i] += keys[i];
  for (int round = 0; round < rounds; round++) {
    const int *r = rotations[round % 8];
    uint32_t *a = &x[round % 2 ? 3 : 1], *b = &x[round % 2 ? 1 : 3];
    x[0] += *a, *a = rotate(*a, r[0]) ^ x[0];
    x[2] += *b, *b = rotate(*b, r[1]) ^ x[2];
    if (round % 4 != 3) continue;
    for (int i = 0; i < 4; i++) x[i] += keys[(i + round / 4 + 1) % 5];
    x[3] += (uint32_t)(round / 4 + 1);
  }
}

static double dropout_factor(const ast_attention *s, int64_t scene, int64_t head, int64_t query, int64_t key) {
  const uint32_t threshold = (uint32_t)fmin(65535, round(s->dropout_p * 65536)), slot = (uint32_t)(key % 128 / 16);
  const uint32_t words[4] = {(uint32_t)s->seed, (uint32_t)(s->seed >> 32), (uint32_t)scene, (uint32_t)head};
  uint32_t x[4] = {(uint32_t)(key / 128 * 16 + key % 16), (uint32_t)query, 0, 0};
  threefry(12, words, x);
  const uint32_t bits = x[slot / 2] >> (slot % 2 * 16) & 0xffff;
  return bits < threshold ? 0 : 65536.0 / (65536 - threshold);
}

#define real    double
#define FORMULA formula
#include "formula_attention.h"
#define real    float
#define FORMULA formula_float
#include "formula_attention.h"

static void compare(const char *what, const float *got, const double *exact, const float *plain, int64_t n,
                    double factor) {
  double error = 0, plain_error = 0, largest = 0;
  for (int64_t i = 0; i < n; i++) {
    if (!isfinite(exact[i])) {
      const float expected = (float)exact[i];
      CHECK(isnan(expected) ? isnan(got[i]) : got[i] == expected, "%s[%lld] is %g, not %g", what, (long long)i,
            (double)got[i], exact[i]);
      continue;
    }
    CHECK(isfinite(got[i]), "%s[%lld] is %g, not %g", what, (long long)i, (double)got[i], exact[i]);
    error = fmax(error, fabs((double)got[i] - exact[i]));
    plain_error = fmax(plain_error, fabs((double)plain[i] - exact[i]));
    largest = fmax(largest, fabs(exact[i]));
  }
  CHECK(error <= factor * plain_error + 1e-6 * largest, "%s is off by %g of %g, plain float by %g", what, error,
        largest, plain_error);
}

static void check_against_formula(const problem *a, const answer *r, double factor) {
  const int64_t sizes[5] = {a->Tq * a->H * a->D, a->Tq * a->H, a->Tq * a->H * a->D, a->Tk * a->H * a->D,
                            a->Tk * a->H * a->D};
  static const char *const names[5] = {"out", "lse", "dq", "dk", "dv"};
  float *lse = new_floats(sizes[1]);
  const float *got[5] = {r->out, lse, r->dq, r->dk, r->dv};
  for (int64_t i = 0; i < sizes[1]; i++) lse[i] = r->maximum[i] + logf(r->sum[i]);
  uint64_t key = add_to_key(1, (const int64_t[]){a->B, a->H, a->D}, 3 * (int64_t)sizeof(int64_t));
  key = add_to_key(key, a->q_offsets, (a->B + 1) * (int64_t)sizeof(int64_t));
  key = add_to_key(key, a->k_offsets, (a->B + 1) * (int64_t)sizeof(int64_t));
  key = add_to_key(key, &a->p, sizeof a->p);
  key = add_to_key(key, a->q, sizes[0] * (int64_t)sizeof(float));
  key = add_to_key(key, a->dout, sizes[0] * (int64_t)sizeof(float));
  key = add_to_key(key, a->k, sizes[3] * (int64_t)sizeof(float));
  key = add_to_key(key, a->v, sizes[3] * (int64_t)sizeof(float));
  bool fresh;
  const formula_results *f = results_of(key, sizes, 5, &fresh);
  if (fresh) {
    formula(a, f->exact[0], f->exact[1], f->exact[2], f->exact[3], f->exact[4]);
    formula_float(a, f->plain[0], f->plain[1], f->plain[2], f->plain[3], f->plain[4]);
  }
  for (int i = 0; i < 5; i++) compare(names[i], got[i], f->exact[i], f->plain[i], sizes[i], factor);
  FREE(lse);
}

/* ---- tests ---- */

static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t sizes[][2] = {{0, 0},    {0, 3},     {3, 0},    {1, 1},    {2, 1},     {1, 2},
                                     {7, 5},    {33, 17},   {65, 127}, {64, 129}, {257, 129}, {31, 513},
                                     {530, 40}, {1100, 20}, {20, 2100}}; /* chunks of queries; scenes cut over queries
                                                                            and over keys */
  static const int64_t widths[] = {16, 32, 48, 64, 128};
  const bool quick = getenv("AST_TEST_QUICK") != NULL; /* where it is slow */
  for (size_t i = 0; i < sizeof sizes / sizeof *sizes; i++)
    for (int kind = 0; kind < (quick && sizes[i][0] + sizes[i][1] > 300 ? 1 : 4); kind++) {
      const int64_t D = widths[(i + (size_t)kind) % 5], H = 1 + (int64_t)(i % 3);
      static const float amplitudes[4] = {1, 0, 60, 1e15f}; /* usual; all scores equal; scores of 1e4; of 1e30 */
      problem a = new_problem(1, &sizes[i][0], &sizes[i][1], H, D, amplitudes[kind], kind % 2 ? 0.1 : 0);
      answer r = solve(kernels, &a);
      check_against_formula(&a, &r, kind == 2 ? 4 : 2);
      free_answer(r), free_problem(a);
    }
}

static void test_dropout_rate(const ast_kernels *kernels) {
  static const double rates[] = {0, 1e-9, 0.1, 0.5, 0.999999};
  const int64_t queries = 300, keys = 700;
  for (int i = 0; i < 5; i++) {
    problem a = new_problem(1, &queries, &keys, 1, 16, 0, rates[i]); /* equal scores: out is the kept share of v = 1 */
    for (int64_t j = 0; j < keys * 16; j++) a.v[j] = 1;
    answer r = solve(kernels, &a);
    double kept = 0;
    for (int64_t j = 0; j < queries; j++) kept += (double)r.out[j * 16] / (double)queries;
    const double p = fmin(rates[i], 65535.0 / 65536),
                 deviation = sqrt(p / (1 - p) / (double)(queries * keys)); /* of the mean, about 1 */
    CHECK(fabs(kept - 1) <= 5 * deviation + 1e-5, "p = %g: mean of the dropout factors is %g", rates[i], kept);
    free_answer(r), free_problem(a);
  }
}

/* The other scenes of a batch change no bit. */
static void test_same_bits(const ast_kernels *kernels) {
  static const int64_t queries[5] = {130, 0, 5, 70, 129}, keys[5] = {257, 4, 0, 40, 300};
  for (int with_dropout = 0; with_dropout < 2; with_dropout++) {
    problem a = new_problem(5, queries, keys, 2, 32, 2, with_dropout ? 0.3 : 0);
    answer batch = solve(kernels, &a);
    check_against_formula(&a, &batch, 2);
    const int64_t row = a.H * a.D;
    for (int64_t b = 0; b < (with_dropout ? 1 : 5); b++) { /* with dropout a scene alone has index 0 */
      problem one = {.B = 1, .H = a.H, .D = a.D, .Tq = queries[b], .Tk = keys[b], .p = a.p};
      const int64_t q0 = a.q_offsets[b] * row, k0 = a.k_offsets[b] * row;
      one.q_offsets[1] = queries[b], one.k_offsets[1] = keys[b];
      one.q = a.q + q0, one.k = a.k + k0, one.v = a.v + k0, one.dout = a.dout + q0;
      answer alone = solve(kernels, &one);
      CHECK(same_bits(alone.out, batch.out + q0, one.Tq * row) && same_bits(alone.dq, batch.dq + q0, one.Tq * row) &&
                same_bits(alone.dk, batch.dk + k0, one.Tk * row) && same_bits(alone.dv, batch.dv + k0, one.Tk * row),
            "scene %lld differs alone and in a batch", (long long)b);
      free_answer(alone);
    }
    free_answer(batch), free_problem(a);
  }
}

/* Neither do the threads: the pool that this run is on gives what the calling thread alone gives. */
static void test_same_bits_on_threads(const ast_kernels *kernels) {
  static const int64_t queries[2] = {300, 90}, keys[2] = {260, 90};
  problem a = new_problem(2, queries, keys, 3, 16, 2, 0.2);
  const int64_t row = a.H * a.D;
  answer first = solve(kernels, &a), again = solve(kernels, &a);
  ast_set_pool(NULL, NULL);
  answer serial = solve(kernels, &a);
  const answer *const others[2] = {&again, &serial};
  for (int i = 0; i < 2; i++)
    CHECK(same_bits(first.out, others[i]->out, a.Tq * row) &&
              same_bits(first.maximum, others[i]->maximum, a.Tq * a.H) &&
              same_bits(first.dq, others[i]->dq, a.Tq * row) && same_bits(first.dk, others[i]->dk, a.Tk * row) &&
              same_bits(first.dv, others[i]->dv, a.Tk * row),
          "%s changes the result", i ? "a pool of threads" : "a second run");
  free_answer(first), free_answer(again), free_answer(serial), free_problem(a);
}

/* NaN and infinity reach the rows that the formula says, and no others. */
static void test_not_finite(const ast_kernels *kernels) {
  static const float values[3] = {NAN, INFINITY, -INFINITY};
  const int64_t queries = 70, keys = 300;
  for (int place = 0; place < 3; place++)
    for (int i = 0; i < 6; i++) {
      problem a = new_problem(1, &queries, &keys, 2, 16, 1, i < 3 ? 0 : 0.3);
      float *const array[3] = {a.q, a.k, a.v};
      array[place][37 * 32 + 5] = values[i % 3];
      answer r = solve(kernels, &a);
      check_against_formula(&a, &r, 2);
      free_answer(r), free_problem(a);
    }
  problem a =
      new_problem(1, &queries, &keys, 1, 16, 1, 0); /* every score of row 3 is -inf; the first keys of row 4 are */
  for (int64_t j = 0; j < keys; j++) {
    a.k[j * 16] = 1, a.k[j * 16 + 1] = j < 280 ? 1 : 0;
    for (int64_t i = 0; i < queries; i++) a.q[i * 16 + 1] = 0;
  }
  a.q[3 * 16] = -INFINITY;
  a.q[4 * 16 + 1] = -3e38f, a.q[4 * 16] = -3e38f;
  answer r = solve(kernels, &a);
  CHECK(isnan(r.out[3 * 16]) && isnan(r.maximum[3]) && isnan(r.sum[3]), "a row of -inf is not NaN");
  const int64_t one = 1;
  problem row = new_problem(1, &one, &keys, 1, 16, 1, 0);
  memcpy(row.q, a.q + 4 * 16, 16 * sizeof(float)), memcpy(row.k, a.k, (size_t)keys * 16 * sizeof(float));
  memcpy(row.v, a.v, (size_t)keys * 16 * sizeof(float));
  answer s = solve(kernels, &row);
  check_against_formula(&row, &s, 2);
  free_answer(r), free_answer(s), free_problem(a), free_problem(row);
}

/* Values of FLT_MAX: the mean of them is one, though their sum is not a float. */
static void test_large_values(const ast_kernels *kernels) {
  const int64_t queries = 3, keys = 1000;
  problem a = new_problem(1, &queries, &keys, 1, 16, 0, 0);
  for (int64_t j = 0; j < keys * 16; j++) a.v[j] = 3e38f;
  answer r = solve(kernels, &a);
  for (int64_t i = 0; i < queries * 16; i++)
    CHECK(fabs((double)r.out[i] / 3e38 - 1) < 1e-5, "out is %g", (double)r.out[i]);
  free_answer(r), free_problem(a);
}

/* Values near the smallest of float32 among many keys keep their digits; so do the others before one of FLT_MAX comes,
 * in the same part of the keys or in another. */
static void test_small_values(const ast_kernels *kernels) {
  const int64_t queries = 3;
  for (int64_t keys = 1000; keys <= 20000; keys *= 20) {
    problem a = new_problem(1, &queries, &keys, 1, 16, 0, 0);
    for (int64_t j = 0; j < keys * 16; j++) a.v[j] = 1;
    answer ones = solve(kernels, &a);
    for (int64_t j = 0; j < keys * 16; j++) a.v[j] = 0x1p-123f;
    answer r = solve(kernels, &a);
    for (int64_t i = 0; i < queries * 16; i++)
      CHECK(fabs(ldexp((double)r.out[i], 123) / (double)ones.out[i] - 1) < 2e-7, "%lld keys: out is %g, not %g",
            (long long)keys, (double)r.out[i], ldexp((double)ones.out[i], -123));
    for (int64_t j = 0; j < keys * 16; j++) a.k[j] = 0, a.v[j] = j < keys * 8 ? 1 : 3e38f;
    answer s = solve(kernels, &a);
    for (int64_t i = 0; i < queries * 16; i++)
      CHECK(fabs((double)s.out[i] / 1.5e38 - 1) < 1e-5, "%lld keys: out is %g", (long long)keys, (double)s.out[i]);
    for (int64_t i = 0; i < queries; i++)
      CHECK(fabs((double)s.sum[i] / (double)keys - 1) < 1e-5, "the sum of %lld weights is %g", (long long)keys,
            (double)s.sum[i]);
    free_answer(ones), free_answer(r), free_answer(s), free_problem(a);
  }
}

/* Rows of q, k and v as slices of one projection, and their gradients as slices of its gradient. */
static void test_row_strides(const ast_kernels *kernels) {
  const int64_t tokens = 150, H = 2, D = 16, row = H * D;
  problem a = new_problem(1, &tokens, &tokens, H, D, 1, 0);
  float *fused = new_floats(tokens * 3 * row);
  for (int64_t i = 0; i < tokens; i++) {
    memcpy(fused + i * 3 * row, a.q + i * row, (size_t)row * sizeof(float));
    memcpy(fused + i * 3 * row + row, a.k + i * row, (size_t)row * sizeof(float));
    memcpy(fused + i * 3 * row + 2 * row, a.v + i * row, (size_t)row * sizeof(float));
  }
  answer contiguous = solve(kernels, &a), sliced = new_answer(&a);
  float *gradient = new_floats(tokens * 3 * row);
  ast_attention s = sizes_of(&a);
  s.q_stride = s.k_stride = s.v_stride = s.dq_stride = s.dk_stride = s.dv_stride = 3 * row;
  CHECK(kernels->attention(&s, fused, fused + row, fused + 2 * row, sliced.out, sliced.maximum, sliced.sum) == AST_OK,
        "status");
  CHECK(kernels->attention_backward(&s, fused, fused + row, fused + 2 * row, sliced.out, sliced.maximum, sliced.sum,
                                    a.dout, gradient, gradient + row, gradient + 2 * row) == AST_OK,
        "status");
  CHECK(same_bits(contiguous.out, sliced.out, tokens * row), "strides change the result");
  for (int64_t i = 0; i < tokens; i++) {
    const float *d = gradient + i * 3 * row;
    CHECK(same_bits(contiguous.dq + i * row, d, row) && same_bits(contiguous.dk + i * row, d + row, row) &&
              same_bits(contiguous.dv + i * row, d + 2 * row, row),
          "strides change the gradients of row %lld", (long long)i);
  }
  FREE(gradient, fused);
  free_answer(contiguous), free_answer(sliced), free_problem(a);
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_dropout_rate(kernels);
  test_same_bits(kernels);
  test_not_finite(kernels);
  test_large_values(kernels);
  test_small_values(kernels);
  test_row_strides(kernels);
  test_same_bits_on_threads(kernels); /* last: it takes the pool away */
}

int main(void) {
  uint32_t x[4] = {0};
  threefry(20, (const uint32_t[4]){0}, x);
  CHECK(x[0] == 0x9c6ca96au && x[1] == 0xe17eae66u && x[2] == 0xfc10ecd4u && x[3] == 0x5256a7d8u, "not Threefry: %08x",
        x[0]);
  on_every_table(test);
  return 0;
}
