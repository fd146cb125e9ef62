/* Scratch memory of each thread, kept between calls, and the C library's thresholds for giving memory back. */
#include <limits.h>
#include <pthread.h>
#include <stdlib.h>

#if defined(__GLIBC__)
#include <malloc.h>
#endif

#include "ast.h"

typedef struct {
  void *data[AST_SLOTS];
  int64_t size[AST_SLOTS];
} scratch;

static pthread_key_t key;
static pthread_once_t once = PTHREAD_ONCE_INIT;
static int key_status;

static void release(void *p) {
  scratch *s = p;
  for (int i = 0; i < AST_SLOTS; i++) free(s->data[i]);
  free(s);
}

static void create_key(void) { key_status = pthread_key_create(&key, release); }

void *ast_scratch(int slot, int64_t bytes) {
  pthread_once(&once, create_key);
  if (key_status) return NULL;
  scratch *s = pthread_getspecific(key);
  if (!s) {
    s = calloc(1, sizeof *s);
    if (!s || pthread_setspecific(key, s)) {
      free(s);
      return NULL;
    }
  }
  if (s->size[slot] <= bytes) { /* never NULL, not even for 0 bytes */
    const size_t size = ((size_t)bytes + 4096) & ~(size_t)4095;
    void *data = aligned_alloc(64, size);
    if (!data) return NULL;
    free(s->data[slot]);
    s->data[slot] = data;
    s->size[slot] = (int64_t)size;
  }
  return s->data[slot];
}

bool ast_keep_memory(void) {
#if defined(__GLIBC__)
  return mallopt(M_MMAP_THRESHOLD, 1 << 30) && mallopt(M_TRIM_THRESHOLD, INT_MAX);
#else
  return false;
#endif
}
