/* What the C tests share: checks that stop with a message, random numbers, and the run over all tables of kernels. */
#ifndef AST_CHECK_H
#define AST_CHECK_H

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../ast.h"

#pragma GCC diagnostic ignored "-Wunused-function" /* no test uses all of these */

#define CHECK(condition, ...)                                         \
  do {                                                                \
    if (!(condition)) {                                               \
      fprintf(stderr, "%s:%d: %s: ", __FILE__, __LINE__, #condition); \
      fprintf(stderr, __VA_ARGS__);                                   \
      fputc('\n', stderr);                                            \
      abort();                                                        \
    }                                                                 \
  } while (0)

/* splitmix64 */
static uint64_t check_state = 1;
static uint64_t random_bits(void) {
  uint64_t z = (check_state += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return z ^ (z >> 31);
}
static double random_unit(void) { return (double)(random_bits() >> 11) * 0x1p-53; }
static float random_float(void) { return (float)(2 * random_unit() - 1); }

#include "buffers.h"
#include "pool.h"

/* Largest errors against the exact values: at most twice the error of plain float plus 1e-6 of the largest value. */
static void check_accuracy(const char *what, const float *got, const double *exact, const float *plain, int64_t n) {
  double error = 0, plain_error = 0, largest = 0;
  for (int64_t i = 0; i < n; i++) {
    CHECK(isfinite(got[i]), "%s[%lld] is %g, not %g", what, (long long)i, (double)got[i], exact[i]);
    error = fmax(error, fabs((double)got[i] - exact[i]));
    plain_error = fmax(plain_error, fabs((double)plain[i] - exact[i]));
    largest = fmax(largest, fabs(exact[i]));
  }
  CHECK(error <= 2 * plain_error + 1e-6 * largest, "%s is off by %g of %g, plain float by %g", what, error, largest,
        plain_error);
}

/* What the formula gives for a problem, in double and in float. Every table is posed the same problems, and the formula
 * takes most of the time of a test, so the latest results are kept, under the bits of all that makes a problem. */
enum { MOST_RESULTS = 17, MOST_KEPT = 1024 };
typedef struct {
  uint64_t key;
  double *exact[MOST_RESULTS];
  float *plain[MOST_RESULTS];
} formula_results;

static uint64_t add_to_key(uint64_t key, const void *data, int64_t size) {
  for (int64_t i = 0; i < size; i += 4) {
    uint32_t word = 0;
    memcpy(&word, (const char *)data + i, (size_t)(size - i < 4 ? size - i : 4));
    key = (key ^ word) * 0x9e3779b97f4a7c15u;
    key ^= key >> 29;
  }
  return key;
}

/* The results under this key; if they are not there (*fresh), zeros, for the caller to replace. */
static const formula_results *results_of(uint64_t key, const int64_t *sizes, int num, bool *fresh) {
  static formula_results kept[MOST_KEPT];
  formula_results *r = &kept[key % MOST_KEPT];
  *fresh = r->key != key || !r->exact[0];
  if (!*fresh) return r;
  for (int i = 0; i < MOST_RESULTS; i++) {
    free(r->exact[i]), free(r->plain[i]);
    r->exact[i] = i < num ? calloc((size_t)sizes[i] + 1, sizeof *r->exact[i]) : NULL;
    r->plain[i] = i < num ? calloc((size_t)sizes[i] + 1, sizeof *r->plain[i]) : NULL;
    CHECK(i >= num || (r->exact[i] && r->plain[i]), "no memory");
  }
  r->key = key;
  return r;
}

enum { CHECK_THREADS = 4 };

/* Runs `test` on every table of kernels that this processor supports: on the calling thread, with buffers that end at a
 * page, and on a pool, with buffers that start at one. */
static void on_every_table(void (*test)(const ast_kernels *)) {
  static const char *const names[] = {"base", "avx2", "avx512"};
  for (int i = 0; i < 3; i++) {
    const ast_kernels *kernels = ast_select(names[i]);
    if (!kernels) continue;
    for (int threaded = 0; threaded < 2; threaded++) {
      check_state = 1;
      buffers_at_start = threaded;
      if (threaded) pool_start(CHECK_THREADS);
      test(kernels);
      if (threaded) pool_stop();
      CHECK(num_buffers == 0, "%d buffers are not freed", num_buffers);
      printf("  %s, %d byte vectors, %s: passed\n", names[i], kernels->vector_bytes, threaded ? "threads" : "serial");
    }
  }
}

#endif
