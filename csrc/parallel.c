/* Tasks on a pool of threads that the caller provides: torch's own, so that one process has one pool. */
#include <stdatomic.h>
#include <stddef.h>

#include "ast.h"

static ast_parallel_for pool_for;
static ast_num_threads pool_threads;

void ast_set_pool(ast_parallel_for parallel_for, ast_num_threads num_threads) {
  pool_for = parallel_for;
  pool_threads = num_threads;
}

int64_t ast_threads(void) {
  uint32_t num = 1;
  if (!pool_for || !pool_threads || pool_threads(&num) != 0 || num < 1) return 1;
  return (int64_t)num;
}

typedef struct {
  int64_t tasks;
  ast_task task;
  void *context;
  atomic_int_least64_t next;
  atomic_int_least64_t failed; /* (index << 8 | status) of the first failure by index, or INT64_MAX */
} job;

static void parallel_run(int64_t begin, int64_t end, void *context) {
  (void)begin, (void)end;
  job *j = context;
  void *const mark = ast_scratch_mark();
  for (;;) {
    const int64_t i = atomic_fetch_add(&j->next, 1);
    if (i >= j->tasks) return;
    const ast_status status = j->task(i, j->context);
    ast_scratch_release(mark);
    if (status == AST_OK) continue;
    const int64_t failure = i << 8 | (int64_t)status;
    int64_t known = atomic_load(&j->failed);
    while (failure < known && !atomic_compare_exchange_weak(&j->failed, &known, failure)) {
    }
  }
}

ast_status ast_parallel(int64_t tasks, ast_task task, void *context) {
  job j = {.tasks = tasks, .task = task, .context = context, .next = 0, .failed = INT64_MAX};
  const int64_t threads = ast_threads();
  if (tasks < 2 || threads < 2 || pool_for(0, threads < tasks ? threads : tasks, 1, parallel_run, &j) != 0)
    parallel_run(0, 1, &j);
  const int64_t failed = atomic_load(&j.failed);
  return failed == INT64_MAX ? AST_OK : (ast_status)(failed & 255);
}
