/* message and its gradients against the formulas edge by edge, in double.
 *
 * Accuracy: the largest error is at most twice that of the same loops in float plus 1e-6 of the largest value.
 */
#include "check.h"

/* M edges whose ends lie in the same of `parts` parts of S senders and R receivers (the scenes of a batch), and random weights. */
static ast_message new_case(int64_t M, int64_t S, int64_t R, int64_t E, int64_t H, int64_t F, int64_t F2, int64_t parts) {
  int64_t *senders = new_ints(M), *receivers = new_ints(M), *offsets = new_ints(R + 1);
  memset(offsets, 0, (size_t)(R + 1) * sizeof *offsets);
  for (int64_t m = 0; m < M; m++) offsets[m * R / M + 1]++; /* about the same number each, */
  for (int64_t r = 1; R > 5 && r < R; r += 5) {             /* but every fifth gives its edges to the one before */
    offsets[r] += offsets[r + 1];
    offsets[r + 1] = 0;
  }
  for (int64_t r = 0; r < R; r++) offsets[r + 1] += offsets[r];
  for (int64_t r = 0; r < R; r++)
    for (int64_t m = offsets[r]; m < offsets[r + 1]; m++) {
      const int64_t part = r * parts / R, first = part * S / parts, last = (part + 1) * S / parts;
      receivers[m] = r;
      senders[m] = first + (int64_t)(random_bits() % (uint64_t)(last - first));
    }
  return (ast_message){
      .M = M,
      .S = S,
      .R = R,
      .E = E,
      .H = H,
      .F = F,
      .F2 = F2,
      .senders = senders,
      .receivers = receivers,
      .receiver_offsets = offsets,
      .of_senders = random_floats(S * F),
      .of_receivers = random_floats(R * F),
      .edge_features = random_floats(M * E),
      .A1 = random_floats(H * E),
      .a1 = random_floats(H),
      .A2 = scaled_floats(F * H, 0.3f),
      .W2 = scaled_floats(F2 * F, 0.3f),
      .b2 = random_floats(F2),
      .gamma = random_floats(F2),
      .beta = random_floats(F2),
  };
}

#define CASE_BUFFERS(s)                                                                                                                   \
  (s)->senders, (s)->receivers, (s)->receiver_offsets, (s)->of_senders, (s)->of_receivers, (s)->edge_features, (s)->A1, (s)->a1, (s)->A2, \
      (s)->W2, (s)->b2, (s)->gamma, (s)->beta

/* The sum, the messages and the ten gradients lie one after the other; at[i] is where the i-th begins. */
enum { RESULTS = 12, SUM = 0, MESSAGES, P, Q, EDGES, A1, B1, A2, W2, B2, GAMMA, BETA };
static const char *const names[RESULTS] = {"sum", "messages", "dof_senders", "dof_receivers", "dedge_features", "dA1",
                                           "da1", "dA2",      "dW2",         "db2",           "dgamma",         "dbeta"};
static void layout(const ast_message *s, int64_t at[RESULTS + 1]) {
  const int64_t sizes[RESULTS] = {s->R * s->F2, s->M * s->F2, s->S * s->F,  s->R * s->F, s->M * s->E, s->H * s->E,
                                  s->H,         s->F * s->H,  s->F2 * s->F, s->F2,       s->F2,       s->F2};
  at[0] = 0;
  for (int i = 0; i < RESULTS; i++) at[i + 1] = at[i] + sizes[i];
}

#define FORMULA(name, real, root)                                                                                                    \
  static void name(const ast_message *s, const float *dsum, const float *dmessages, real *out, const int64_t *at) {                  \
    const int64_t E = s->E, H = s->H, F = s->F, F2 = s->F2;                                                                          \
    real *h = calloc((size_t)(2 * H + 2 * F + 2 * F2 + 1), sizeof *h), *x = h + H, *u = x + F, *dy = u + F2, *dz = dy + F2;          \
    real *dc = dz + F;                                                                                                               \
    CHECK(h, "no memory");                                                                                                           \
    for (int64_t m = 0; m < s->M; m++) {                                                                                             \
      const float *e = s->edge_features + m * E, *p = s->of_senders + s->senders[m] * F, *q = s->of_receivers + s->receivers[m] * F; \
      for (int64_t i = 0; i < H; i++) {                                                                                              \
        h[i] = (real)s->a1[i];                                                                                                       \
        for (int64_t k = 0; k < E; k++) h[i] += (real)s->A1[i * E + k] * (real)e[k];                                                 \
        if (h[i] < 0) h[i] = 0;                                                                                                      \
      }                                                                                                                              \
      for (int64_t i = 0; i < F; i++) {                                                                                              \
        x[i] = (real)p[i] + (real)q[i];                                                                                              \
        for (int64_t k = 0; k < H; k++) x[i] += (real)s->A2[i * H + k] * h[k];                                                       \
        if (x[i] < 0) x[i] = 0;                                                                                                      \
      }                                                                                                                              \
      real mean = 0, variance = 0, mean_p = 0, mean_pu = 0;                                                                          \
      for (int64_t i = 0; i < F2; i++) {                                                                                             \
        u[i] = (real)s->b2[i];                                                                                                       \
        for (int64_t k = 0; k < F; k++) u[i] += (real)s->W2[i * F + k] * x[k];                                                       \
        mean += u[i] / (real)F2;                                                                                                     \
      }                                                                                                                              \
      for (int64_t i = 0; i < F2; i++) variance += (u[i] - mean) * (u[i] - mean) / (real)F2;                                         \
      const real inverse = 1 / root(variance + (real)1e-5);                                                                          \
      for (int64_t i = 0; i < F2; i++) {                                                                                             \
        const int64_t at_sum = s->receivers[m] * F2 + i;                                                                             \
        u[i] = (u[i] - mean) * inverse;                                                                                              \
        out[at[MESSAGES] + m * F2 + i] = u[i] * (real)s->gamma[i] + (real)s->beta[i];                                                \
        out[at[SUM] + at_sum] += out[at[MESSAGES] + m * F2 + i];                                                                     \
        const real g = (real)dsum[at_sum] + (dmessages ? (real)dmessages[m * F2 + i] : 0);                                           \
        dy[i] = g * (real)s->gamma[i];                                                                                               \
        mean_p += dy[i] / (real)F2;                                                                                                  \
        mean_pu += dy[i] * u[i] / (real)F2;                                                                                          \
        out[at[GAMMA] + i] += g * u[i];                                                                                              \
        out[at[BETA] + i] += g;                                                                                                      \
      }                                                                                                                              \
      for (int64_t i = 0; i < F2; i++) {                                                                                             \
        dy[i] = (dy[i] - mean_p - u[i] * mean_pu) * inverse;                                                                         \
        out[at[B2] + i] += dy[i];                                                                                                    \
        for (int64_t k = 0; k < F; k++) out[at[W2] + i * F + k] += dy[i] * x[k];                                                     \
      }                                                                                                                              \
      for (int64_t k = 0; k < F; k++) {                                                                                              \
        dz[k] = 0;                                                                                                                   \
        for (int64_t i = 0; x[k] > 0 && i < F2; i++) dz[k] += dy[i] * (real)s->W2[i * F + k];                                        \
        out[at[P] + s->senders[m] * F + k] += dz[k];                                                                                 \
        out[at[Q] + s->receivers[m] * F + k] += dz[k];                                                                               \
        for (int64_t j = 0; j < H; j++) out[at[A2] + k * H + j] += dz[k] * h[j];                                                     \
      }                                                                                                                              \
      for (int64_t j = 0; j < H; j++) {                                                                                              \
        dc[j] = 0;                                                                                                                   \
        for (int64_t k = 0; h[j] > 0 && k < F; k++) dc[j] += dz[k] * (real)s->A2[k * H + j];                                         \
        out[at[B1] + j] += dc[j];                                                                                                    \
        for (int64_t i = 0; i < E; i++) out[at[A1] + j * E + i] += dc[j] * (real)e[i];                                               \
        for (int64_t i = 0; i < E; i++) out[at[EDGES] + m * E + i] += dc[j] * (real)s->A1[j * E + i];                                \
      }                                                                                                                              \
    }                                                                                                                                \
    free(h);                                                                                                                         \
  }
FORMULA(formula, double, sqrt)
FORMULA(formula_float, float, sqrtf)

/* All results of the kernels, one after the other. */
static float *run(const ast_kernels *kernels, const ast_message *s, const float *dsum, const float *dmessages, const int64_t *at) {
  float *of[RESULTS], *out = random_floats(at[RESULTS]);
  for (int i = 0; i < RESULTS; i++) of[i] = new_floats(at[i + 1] - at[i]);
  READ_ONLY(CASE_BUFFERS(s), dsum, dmessages);
  CHECK(kernels->message(s, of[SUM], of[MESSAGES]) == AST_OK, "status");
  const ast_message_gradients gradients = {of[P], of[Q], of[EDGES], of[A1], of[B1], of[A2], of[W2], of[B2], of[GAMMA], of[BETA]};
  CHECK(kernels->message_backward(s, dsum, dmessages, &gradients) == AST_OK, "status");
  WRITABLE(CASE_BUFFERS(s), dsum, dmessages);
  for (int i = 0; i < RESULTS; i++) {
    memcpy(out + at[i], of[i], (size_t)(at[i + 1] - at[i]) * sizeof *out);
    FREE(of[i]);
  }
  return out;
}

static void compare(const char *what, const float *got, const double *exact, const float *plain, int64_t n) {
  double error = 0, plain_error = 0, largest = 0;
  for (int64_t i = 0; i < n; i++) {
    CHECK(isfinite(got[i]), "%s[%lld] is %g", what, (long long)i, (double)got[i]);
    error = fmax(error, fabs((double)got[i] - exact[i]));
    plain_error = fmax(plain_error, fabs((double)plain[i] - exact[i]));
    largest = fmax(largest, fabs(exact[i]));
  }
  CHECK(error <= 2 * plain_error + 1e-6 * largest, "%s is off by %g of %g, plain float by %g", what, error, largest, plain_error);
}

static void check_case(const ast_kernels *kernels, const int64_t *edges, const int64_t *channels, bool with_messages) {
  const ast_message s = new_case(edges[0], edges[1], edges[2], channels[0], channels[1], channels[2], channels[3], 1);
  int64_t at[RESULTS + 1];
  layout(&s, at);
  float *dsum = random_floats(s.R * s.F2), *dmessages = with_messages ? random_floats(s.M * s.F2) : NULL;
  double *exact = calloc((size_t)(at[RESULTS] + 1), sizeof *exact);
  float *plain = calloc((size_t)(at[RESULTS] + 1), sizeof *plain);
  CHECK(exact && plain, "no memory");
  formula(&s, dsum, dmessages, exact, at);
  formula_float(&s, dsum, dmessages, plain, at);
  float *out = run(kernels, &s, dsum, dmessages, at);
  for (int i = 0; i < RESULTS; i++) compare(names[i], out + at[i], exact + at[i], plain + at[i], at[i + 1] - at[i]);
  free(exact), free(plain);
  FREE(CASE_BUFFERS(&s), dsum, dmessages, out);
}

static void test_accuracy(const ast_kernels *kernels) {
  static const int64_t channels[][4] = {{3, 16, 16, 16}, {8, 40, 24, 40}, {1, 1, 1, 4}, {16, 7, 33, 65}, {0, 0, 20, 12}, {0, 4, 5, 6}};
  static const int64_t edges[][3] = {{0, 0, 0}, {0, 3, 2}, {1, 1, 1}, {2, 1, 3}, {97, 5, 7}, {600, 300, 100}, {1000, 9, 1}};
  for (int c = 0; c < 6; c++)
    for (int e = 0; e < 7; e++) check_case(kernels, edges[e], channels[c], (c + e) % 2);
  if (!getenv("AST_TEST_QUICK")) check_case(kernels, (const int64_t[]){20000, 900, 700}, (const int64_t[]){2, 8, 8, 16}, false);
}

/* A scene alone gives the bits that it gives behind another one, and a NaN in that one does not reach it. */
static void test_batch(const ast_kernels *kernels) {
  const ast_message both = new_case(5000, 400, 600, 5, 24, 40, 20, 2);
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
  int64_t at[RESULTS + 1], at_one[RESULTS + 1];
  layout(&both, at), layout(&one, at_one);
  float *dsum = random_floats(both.R * both.F2);
  float *batch = run(kernels, &both, dsum, NULL, at), *alone = run(kernels, &one, dsum + 300 * one.F2, NULL, at_one);
  for (int i = SUM; i <= EDGES; i++) {
    const int64_t n = at_one[i + 1] - at_one[i];
    for (int64_t j = 0; j < n; j++) CHECK(isfinite(alone[at_one[i] + j]), "%s[%lld]", names[i], (long long)j);
    CHECK(!memcmp(alone + at_one[i], batch + at[i + 1] - n, (size_t)n * sizeof *alone), "%s: not the same bits", names[i]);
  }
  FREE(CASE_BUFFERS(&both), senders, receivers, offsets, dsum, batch, alone);
}

/* The pool that this run is on gives what the calling thread alone gives. */
static void test_threads(const ast_kernels *kernels) {
  const ast_message s = new_case(18000, 700, 900, 3, 16, 24, 16, 1);
  int64_t at[RESULTS + 1];
  layout(&s, at);
  float *dsum = random_floats(s.R * s.F2), *threaded = run(kernels, &s, dsum, NULL, at);
  ast_set_pool(NULL, NULL);
  float *serial = run(kernels, &s, dsum, NULL, at);
  CHECK(!memcmp(threaded, serial, (size_t)at[RESULTS] * sizeof *threaded), "threads change the result");
  FREE(CASE_BUFFERS(&s), dsum, threaded, serial);
}

static void test(const ast_kernels *kernels) {
  test_accuracy(kernels);
  test_batch(kernels);
  test_threads(kernels); /* last: it takes the pool away */
}

int main(void) {
  on_every_table(test);
  return 0;
}
