/* message and its gradients against the formulas edge by edge, in double.
 *
 * Accuracy: the largest error is at most twice the error of the same loops in float plus 1e-6 of the largest value.
 */
#include "problems.h"

static const char *const names[MESSAGE_RESULTS] = {
    "sum", "messages", "dof_senders", "dof_receivers", "dedge_features", "dA1",
    "da1", "dA2",      "dW2",         "db2",           "dgamma",         "dbeta"};

#define real    double
#define FORMULA formula
#include "formula_message.h"
#define real    float
#define FORMULA formula_float
#include "formula_message.h"

static void check_case(const ast_kernels *kernels, const int64_t *edges, const int64_t *channels, bool with_messages) {
  const ast_message s =
      new_message(edges[0], edges[1], edges[2], channels[0], channels[1], channels[2], channels[3], 1);
  float *dsum = random_floats(s.R * s.F2), *dmessages = with_messages ? random_floats(s.M * s.F2) : NULL;
  const message_results r = solve_message(kernels, &s, dsum, dmessages);
  const int64_t numbers[] = {s.M, s.S, s.R, s.E, s.H, s.F, s.F2, with_messages};
  const int64_t ints = (int64_t)sizeof(int64_t), floats = (int64_t)sizeof(float);
  uint64_t key = add_to_key(1, numbers, sizeof numbers);
  key = add_to_key(key, s.senders, s.M * ints), key = add_to_key(key, s.receivers, s.M * ints);
  const float *const inputs[] = {s.of_senders, s.of_receivers, s.edge_features, s.A1,   s.a1, s.A2,
                                 s.W2,         s.b2,           s.gamma,         s.beta, dsum, dmessages};
  const int64_t lengths[] = {s.S * s.F,  s.R * s.F, s.M * s.E, s.H * s.E, s.H,        s.F * s.H,
                             s.F2 * s.F, s.F2,      s.F2,      s.F2,      s.R * s.F2, with_messages ? s.M * s.F2 : 0};
  for (int i = 0; i < 12; i++) key = add_to_key(key, inputs[i], lengths[i] * floats);
  bool fresh;
  const formula_results *f = results_of(key, r.size, MESSAGE_RESULTS, &fresh);
  if (fresh) {
    formula(&s, dsum, dmessages, f->exact);
    formula_float(&s, dsum, dmessages, f->plain);
  }
  for (int i = 0; i < MESSAGE_RESULTS; i++) check_accuracy(names[i], r.of[i], f->exact[i], f->plain[i], r.size[i]);
  free_message_results(r);
  FREE(MESSAGE_BUFFERS(&s), dsum, dmessages);
}

static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t channels[][4] = {{3, 16, 16, 16}, {8, 40, 24, 40}, {1, 1, 1, 4},
                                        {16, 7, 33, 65}, {0, 0, 20, 12},  {0, 4, 5, 6},
                                        {16, 0, 16, 16}, {33, 0, 33, 65}, {1, 0, 1, 4}};
  static const int64_t edges[][3] = {{0, 0, 0},  {0, 3, 2},       {1, 1, 1},   {2, 1, 3},
                                     {97, 5, 7}, {600, 300, 100}, {1000, 9, 1}};
  for (int c = 0; c < 9; c++)
    for (int e = 0; e < 7; e++) {
      check_state =
          (uint64_t)(7 * c + e); /* no case changes the numbers of another: with one or two edges the rule is sharp */
      check_case(kernels, edges[e], channels[c], (c + e) % 2);
    }
  if (getenv("AST_TEST_QUICK")) return;
  check_case(kernels, (const int64_t[]){20000, 900, 700}, (const int64_t[]){2, 8, 8, 16}, false);
  check_case(kernels, (const int64_t[]){20000, 900, 700}, (const int64_t[]){8, 0, 8, 16}, true);
}

/* A scene alone gives the bits that it gives behind another one, and a NaN in that one does not reach it. */
static void test_batch(const ast_kernels *kernels, int64_t E, int64_t H) {
  const ast_message both = new_message(5000, 400, 600, E, H, 40, 20, 2);
  const int64_t M = both.M - both.receiver_offsets[300], first = both.M - M;
  ast_message one = both;
  int64_t *senders = new_ints(M), *receivers = new_ints(M), *offsets = new_ints(301);
  one.M = M, one.S = 200, one.R = 300;
  one.senders = senders, one.receivers = receivers, one.receiver_offsets = offsets;
  for (int64_t m = 0; m < M; m++) {
    senders[m] = both.senders[first + m] - 200;
    receivers[m] = both.receivers[first + m] - 300;
  }
  for (int64_t r = 0; r <= 300; r++) offsets[r] = both.receiver_offsets[300 + r] - first;
  one.of_senders += 200 * one.F, one.of_receivers += 300 * one.F, one.edge_features += first * one.E;
  for (int64_t i = 0; i < 200 * one.F; i += 7) ((float *)(uintptr_t)both.of_senders)[i] = NAN;
  for (int64_t i = 0; i < first * E; i += 11) ((float *)(uintptr_t)both.edge_features)[i] = i % 2 ? NAN : INFINITY;
  float *dsum = random_floats(both.R * both.F2);
  const message_results batch = solve_message(kernels, &both, dsum, NULL),
                        alone = solve_message(kernels, &one, dsum + 300 * one.F2, NULL);
  for (int i = SUM; i <= EDGES; i++) {
    const int64_t n = alone.size[i];
    for (int64_t j = 0; j < n; j++) CHECK(isfinite(alone.of[i][j]), "%s[%lld]", names[i], (long long)j);
    CHECK(!memcmp(alone.of[i], batch.of[i] + batch.size[i] - n, (size_t)n * sizeof(float)), "%s: not the same bits",
          names[i]);
  }
  free_message_results(batch), free_message_results(alone);
  FREE(MESSAGE_BUFFERS(&both), senders, receivers, offsets, dsum);
}

/* The pool that this run is on gives what the calling thread alone gives. */
static void test_threads(const ast_kernels *kernels) {
  const ast_message problems[] = {new_message(18000, 700, 900, 3, 16, 24, 16, 1),
                                  new_message(18000, 700, 900, 24, 0, 24, 16, 1)};
  float *dsum = random_floats(900 * 16);
  message_results threaded[2];
  for (int k = 0; k < 2; k++) threaded[k] = solve_message(kernels, &problems[k], dsum, NULL);
  ast_set_pool(NULL, NULL);
  for (int k = 0; k < 2; k++) {
    const message_results serial = solve_message(kernels, &problems[k], dsum, NULL);
    for (int i = 0; i < MESSAGE_RESULTS; i++)
      CHECK(!memcmp(threaded[k].of[i], serial.of[i], (size_t)serial.size[i] * sizeof(float)), "threads change %s",
            names[i]);
    free_message_results(threaded[k]), free_message_results(serial);
    FREE(MESSAGE_BUFFERS(&problems[k]));
  }
  FREE(dsum);
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_batch(kernels, 5, 24);
  test_batch(kernels, 40, 0);
  test_threads(kernels); /* last: it takes the pool away */
}

int main(void) {
  on_every_table(test);
  return 0;
}
