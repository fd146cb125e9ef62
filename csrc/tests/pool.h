/* A pool of threads with the interface of torch's: all threads, the caller among them, start a call together. */
#ifndef AST_POOL_H
#define AST_POOL_H

#include <pthread.h>
#include <stdbool.h>
#include <stdint.h>

#include "check.h"

enum { MOST_THREADS = 8 };

static struct {
  uint32_t threads;
  bool stopped;
  pthread_t thread[MOST_THREADS];
  pthread_barrier_t start, finish;
  int64_t begin, end;
  void (*body)(int64_t, int64_t, void *);
  void *context;
} the_pool;

/* Thread i of the pool; the caller of pool_for is thread 0. */
static void *pool_work(void *index) {
  const int64_t i = (intptr_t)index;
  for (;;) {
    pthread_barrier_wait(&the_pool.start);
    if (the_pool.stopped) return NULL;
    if (the_pool.begin + i < the_pool.end) the_pool.body(the_pool.begin + i, the_pool.begin + i + 1, the_pool.context);
    pthread_barrier_wait(&the_pool.finish);
  }
}

static int32_t pool_for(int64_t begin, int64_t end, int64_t grain, void (*body)(int64_t, int64_t, void *),
                        void *context) {
  (void)grain;
  CHECK(begin < end && end - begin <= the_pool.threads, "%lld tasks for %u threads", (long long)(end - begin),
        the_pool.threads);
  the_pool.begin = begin, the_pool.end = end, the_pool.body = body, the_pool.context = context;
  pthread_barrier_wait(&the_pool.start);
  body(begin, begin + 1, context);
  pthread_barrier_wait(&the_pool.finish);
  return 0;
}

static int32_t pool_threads(uint32_t *num) {
  *num = the_pool.threads;
  return 0;
}

/* Lets the kernels run on this many threads, from here to pool_stop. */
static void pool_start(uint32_t threads) {
  CHECK(threads >= 1 && threads <= MOST_THREADS, "%u threads", threads);
  the_pool.threads = threads, the_pool.stopped = false;
  CHECK(!pthread_barrier_init(&the_pool.start, NULL, threads) && !pthread_barrier_init(&the_pool.finish, NULL, threads),
        "no barrier");
  for (uint32_t i = 1; i < threads; i++)
    CHECK(!pthread_create(&the_pool.thread[i], NULL, pool_work, (void *)(intptr_t)i), "no thread");
  ast_set_pool(pool_for, pool_threads);
}

static void pool_stop(void) {
  ast_set_pool(NULL, NULL);
  the_pool.stopped = true;
  pthread_barrier_wait(&the_pool.start);
  for (uint32_t i = 1; i < the_pool.threads; i++) pthread_join(the_pool.thread[i], NULL);
  pthread_barrier_destroy(&the_pool.start), pthread_barrier_destroy(&the_pool.finish);
  the_pool.threads = 0;
}

#endif
