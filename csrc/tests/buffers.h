/* Buffers beside pages that must not be touched: a read or write past an end stops the program.
 *
 *   slack | data | guard     as a rule: the last byte lies before a guard page, whatever the alignment of the data then
 *   guard | data | slack     with buffers_at_start: aligned to a page, and an index of -1 faults
 *
 * The slack up to a whole page holds a pattern that is checked when the buffer is freed. READ_ONLY makes the pages of
 * inputs read-only for a call, so that a write to an input stops the program, too.
 */
#ifndef AST_BUFFERS_H
#define AST_BUFFERS_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

#include "check.h"

enum { MOST_BUFFERS = 256, SLACK_PATTERN = 0xa5 };

typedef struct {
  char *map, *pages, *data; /* the mapping with its guard pages, the usable pages, the buffer in them */
  size_t map_size, pages_size, size;
} buffer;

static buffer buffers[MOST_BUFFERS];
static int num_buffers;
static bool buffers_at_start;

/* `size` bytes, all set: NaN as floats and -1 as integers, so that what a kernel leaves unwritten shows. */
static void *new_buffer(size_t size) {
  const size_t page = (size_t)sysconf(_SC_PAGESIZE), pages_size = (size + page - 1) / page * page;
  CHECK(num_buffers < MOST_BUFFERS, "more than %d buffers", MOST_BUFFERS);
  buffer *b = &buffers[num_buffers++];
  *b = (buffer){.map_size = pages_size + 2 * page, .pages_size = pages_size, .size = size};
  b->map = mmap(NULL, b->map_size, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  CHECK(b->map != MAP_FAILED, "no memory for %zu bytes", size);
  b->pages = b->map + page;
  b->data = b->pages + (buffers_at_start ? 0 : pages_size - size);
  CHECK(!pages_size || !mprotect(b->pages, pages_size, PROT_READ | PROT_WRITE), "no memory for %zu bytes", size);
  memset(b->pages, SLACK_PATTERN, pages_size);
  memset(b->data, 0xff, size);
  return b->data;
}

/* The buffer that p points into, or at the end of. */
static buffer *buffer_of(const void *p) {
  for (int i = num_buffers; i-- > 0;)
    if ((const char *)p >= buffers[i].data && (const char *)p <= buffers[i].data + buffers[i].size) return &buffers[i];
  CHECK(false, "%p lies in no buffer", p);
  return NULL;
}

static void protect_buffers(const void *const *inputs, size_t num, int protection) {
  for (size_t i = 0; i < num; i++) {
    if (!inputs[i]) continue;
    const buffer *b = buffer_of(inputs[i]);
    CHECK(!b->pages_size || !mprotect(b->pages, b->pages_size, protection), "mprotect");
  }
}

static void free_buffers(const void *const *data, size_t num) {
  for (size_t i = 0; i < num; i++) {
    if (!data[i]) continue;
    buffer *b = buffer_of(data[i]);
    for (const char *c = b->pages; c < b->pages + b->pages_size; c++)
      CHECK((c >= b->data && c < b->data + b->size) || *(const unsigned char *)c == SLACK_PATTERN,
            "written %td bytes from a buffer of %zu", c - b->data, b->size);
    CHECK(!munmap(b->map, b->map_size), "munmap");
    *b = buffers[--num_buffers];
  }
}

#define BUFFER_LIST(...) (const void *const[]){__VA_ARGS__}, sizeof((const void *const[]){__VA_ARGS__}) / sizeof(void *)
#define READ_ONLY(...)   protect_buffers(BUFFER_LIST(__VA_ARGS__), PROT_READ)
#define WRITABLE(...)    protect_buffers(BUFFER_LIST(__VA_ARGS__), PROT_READ | PROT_WRITE)
#define FREE(...)        free_buffers(BUFFER_LIST(__VA_ARGS__))

static float *new_floats(int64_t n) { return new_buffer((size_t)n * sizeof(float)); }
static int64_t *new_ints(int64_t n) { return new_buffer((size_t)n * sizeof(int64_t)); }
static int32_t *new_small_ints(int64_t n) { return new_buffer((size_t)n * sizeof(int32_t)); }
/* in -1..1 */
static float *random_floats(int64_t n) {
  float *x = new_floats(n);
  for (int64_t i = 0; i < n; i++) x[i] = random_float();
  return x;
}
/* in -amplitude..amplitude */
static float *scaled_floats(int64_t n, float amplitude) {
  float *x = random_floats(n);
  for (int64_t i = 0; i < n; i++) x[i] *= amplitude;
  return x;
}
static int64_t *copy_ints(const int64_t *values, int64_t n) {
  return memcpy(new_ints(n), values, (size_t)n * sizeof *values);
}

#endif
