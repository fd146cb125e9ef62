/* Scratch memory of each thread, a stack in blocks, and the C library's thresholds for giving memory back.
 *
 * A request that finds no room in the newest block gets a new one. Of the blocks that are released the largest stays as
 * a spare for the next request. When the stack is empty the spare goes, too, if it could not have held all that was in
 * use at once: the next block then can. So a kernel that is called again and again allocates nothing from its third
 * call on, and its arrays lie side by side. Where more than SCRATCH_KEPT bytes were in use, all are given back.
 */
#include <limits.h>
#include <pthread.h>
#include <stdlib.h>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include "ast.h"

enum { ALIGNMENT = 64, SCRATCH_KEPT = 1 << 26 };

/* With the address sanitizer every request is a block of its own, freed when it is released: no access beyond it, or
 * after, escapes. */
#ifndef __has_feature
#define __has_feature(name) 0
#endif
#if defined(__SANITIZE_ADDRESS__) || __has_feature(address_sanitizer)
enum { APART = true };
#else
enum { APART = false };
#endif

typedef struct block {
  struct block *below;
  char *next, *end; /* the room that is left */
} block;

_Static_assert(sizeof(block) <= ALIGNMENT, "the memory of a block begins at the first aligned byte behind its head");

typedef struct {
  block *newest, *spare;
  int64_t used, most; /* bytes now, and at most since memory was given back */
} stack;

static pthread_key_t key;
static pthread_once_t once = PTHREAD_ONCE_INIT;
static int key_status;

static char *memory_begin(block *b) { return (char *)b + ALIGNMENT; }
static int64_t memory_room(block *b) { return b ? b->end - memory_begin(b) : -1; }

static void memory_pop(stack *s) {
  block *b = s->newest;
  s->used -= b->next - memory_begin(b);
  s->newest = b->below;
  if (!APART && memory_room(b) > memory_room(s->spare)) {
    free(s->spare);
    s->spare = b;
  } else {
    free(b);
  }
}

static bool memory_push(stack *s, int64_t bytes) {
  block *b = s->spare;
  if (memory_room(b) >= bytes) {
    s->spare = NULL;
  } else {
    const int64_t room = s->newest || APART || s->most < bytes ? bytes : s->most;
    b = aligned_alloc(ALIGNMENT, (size_t)(ALIGNMENT + room));
    if (!b) return false;
    b->end = memory_begin(b) + room;
  }
  b->below = s->newest;
  b->next = memory_begin(b);
  s->newest = b;
  return true;
}

static void memory_free_stack(void *p) {
  stack *s = p;
  while (s->newest) memory_pop(s);
  free(s->spare);
  free(s);
}

static void memory_create_key(void) { key_status = pthread_key_create(&key, memory_free_stack); }

/* The stack of the calling thread; NULL if it has none yet. */
static stack *memory_own_stack(void) {
  pthread_once(&once, memory_create_key);
  return key_status ? NULL : pthread_getspecific(key);
}

static stack *memory_new_stack(void) {
  stack *s = key_status ? NULL : calloc(1, sizeof *s);
  if (s && !pthread_setspecific(key, s)) return s;
  free(s);
  return NULL;
}

void *ast_scratch(int64_t bytes) {
  stack *s = memory_own_stack();
  if (!s && !(s = memory_new_stack())) return NULL;
  const int64_t size = (bytes / ALIGNMENT + 1) * ALIGNMENT; /* never 0, so that no two requests give the same mark */
  if ((!s->newest || APART || s->newest->end - s->newest->next < size) && !memory_push(s, size)) return NULL;
  void *const data = s->newest->next;
  s->newest->next += size;
  s->used += size;
  if (s->most < s->used) s->most = s->used;
  return data;
}

void *ast_scratch_mark(void) {
  const stack *s = memory_own_stack();
  return s && s->newest ? s->newest->next : NULL;
}

/* A mark is the end of a request, where no block but its own reaches, or NULL for the empty stack. */
void ast_scratch_release(void *mark) {
  stack *s = memory_own_stack();
  if (!s || !s->newest) return;
  while (s->newest && (s->newest->next < (char *)mark || (char *)mark <= memory_begin(s->newest))) memory_pop(s);
  if (s->newest) {
    s->used -= s->newest->next - (char *)mark;
    s->newest->next = mark;
  } else if (s->most > SCRATCH_KEPT || memory_room(s->spare) < s->most) {
    free(s->spare);
    s->spare = NULL;
    if (s->most > SCRATCH_KEPT) s->most = 0;
  }
}

bool ast_keep_memory(void) {
#if defined(__GLIBC__)
  return mallopt(M_MMAP_THRESHOLD, 1 << 30) && mallopt(M_TRIM_THRESHOLD, INT_MAX);
#else
  return false;
#endif
}
