/* What the C tests share: a check that stops with a message, random numbers, and a pool of threads to hand to the core. */
#ifndef AST_CHECK_H
#define AST_CHECK_H

#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "../ast.h"

#define CHECK(condition, ...)                                         \
  do {                                                                \
    if (!(condition)) {                                               \
      fprintf(stderr, "%s:%d: %s: ", __FILE__, __LINE__, #condition); \
      fprintf(stderr, __VA_ARGS__);                                   \
      fputc('\n', stderr);                                            \
      exit(1);                                                        \
    }                                                                 \
  } while (0)

/* splitmix64 */
static uint64_t check_state = 1;
__attribute__((unused)) static uint64_t random_bits(void) {
  uint64_t z = (check_state += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return z ^ (z >> 31);
}
__attribute__((unused)) static double random_unit(void) { return (double)(random_bits() >> 11) * 0x1p-53; }
__attribute__((unused)) static float random_float(void) { return (float)(2 * random_unit() - 1); }

/* A pool of CHECK_THREADS fresh threads a call: slow, but it is a real one. */
enum { CHECK_THREADS = 3 };
typedef struct {
  void (*body)(int64_t, int64_t, void *);
  void *context;
  int64_t index;
} check_call;
static void *check_run(void *p) {
  check_call *c = p;
  c->body(c->index, c->index + 1, c->context);
  return NULL;
}
__attribute__((unused)) static int32_t check_parallel_for(int64_t begin, int64_t end, int64_t grain, void (*body)(int64_t, int64_t, void *),
                                                          void *context) {
  (void)grain;
  pthread_t threads[CHECK_THREADS];
  check_call calls[CHECK_THREADS];
  const int64_t n = end - begin;
  CHECK(n <= CHECK_THREADS, "%lld tasks for %d threads", (long long)n, CHECK_THREADS);
  for (int64_t i = 0; i < n; i++) {
    calls[i] = (check_call){body, context, begin + i};
    CHECK(!pthread_create(&threads[i], NULL, check_run, &calls[i]), "no thread");
  }
  for (int64_t i = 0; i < n; i++) pthread_join(threads[i], NULL);
  return 0;
}
__attribute__((unused)) static int32_t check_num_threads(uint32_t *num) {
  *num = CHECK_THREADS;
  return 0;
}

/* Runs `test` on every table of kernels that this processor supports, serial and with the pool. */
__attribute__((unused)) static void on_every_table(void (*test)(const ast_kernels *)) {
  static const char *const names[] = {"base", "avx2", "avx512"};
  for (int i = 0; i < 3; i++) {
    const ast_kernels *kernels = ast_select(names[i]);
    if (!kernels) continue;
    for (int threaded = 0; threaded < 2; threaded++) {
      ast_set_pool(threaded ? check_parallel_for : NULL, threaded ? check_num_threads : NULL);
      check_state = 1;
      test(kernels);
      printf("  %s, %d byte vectors, %s: passed\n", names[i], kernels->vector_bytes, threaded ? "threads" : "serial");
    }
  }
}

#endif
