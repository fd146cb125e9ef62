/* Integers: the smaller and the larger, division and multiples rounded up, bits, and the search in sorted numbers. */
#ifndef AST_INTEGERS_H
#define AST_INTEGERS_H

#include <stdint.h>

static inline int64_t min64(int64_t a, int64_t b) { return a < b ? a : b; }
static inline int64_t max64(int64_t a, int64_t b) { return a > b ? a : b; }

/* How many parts of size `by` > 0 hold n >= 0, and what they hold. */
static inline int64_t divide_up(int64_t n, int64_t by) { return (n + by - 1) / by; }
static inline int64_t round_up(int64_t n, int64_t to) { return divide_up(n, to) * to; }

/* Between begin and end, of whose more than `chain` numbers each half has whole chains but for the last. */
static inline int64_t half_of_chains(int64_t begin, int64_t end, int64_t chain) {
  return begin + divide_up(end - begin, chain) / 2 * chain;
}

/* The number of bits of n. */
static inline int num_bits(uint64_t n) { return n ? 64 - __builtin_clzll(n) : 0; }

/* The first i in [begin, end) with values[i] >= bound, or end; values never fall. */
static inline int64_t lower_bound(const int64_t *values, int64_t begin, int64_t end, int64_t bound) {
  while (begin < end) {
    const int64_t middle = begin + (end - begin) / 2;
    if (values[middle] < bound) begin = middle + 1;
    else end = middle;
  }
  return begin;
}

/* The scene of row i: the last b with offsets[b] <= i, for offsets [B+1] from 0 on and 0 <= i < offsets[B]. */
static inline int64_t scene_at(const int64_t *offsets, int64_t B, int64_t i) {
  return lower_bound(offsets, 0, B, i + 1) - 1;
}

#endif
