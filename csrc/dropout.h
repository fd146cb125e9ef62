/* Dropout that depends on (seed, scene, head, query, key) alone, so that any cutting of the work drops the same
 * weights.
 *
 * Threefry-4x32 of 12 rounds (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, 2011) under the key
 * (seed, scene, head) turns the counter (16 g + lane, query) into four words, one half word for each of the 8 keys
 * 128 g + 16 slot + lane: half slot % 2 of word slot / 2. A weight is dropped if its half word is below round(65536 p);
 * the share kept is within 1e-5 of 1 - p. VW counters at once: some 11 operations a vector of decisions.
 */
#ifndef AST_DROPOUT_H
#define AST_DROPOUT_H

#include "ast.h"
#include "simd.h"

enum { DROPOUT_KEYS = 128, DROPOUT_SLOTS = 8, DROPOUT_LANES = DROPOUT_KEYS / DROPOUT_SLOTS };

typedef struct {
  uint32_t key[5];
  uint32_t threshold; /* of the 16 random bits; 0: no dropout */
  float gain;         /* 1 / the share kept, of the threshold itself */
} dropout;

static dropout dropout_of(const ast_attention *s, int64_t scene, int64_t head) {
  dropout d = {.key = {(uint32_t)s->seed, (uint32_t)(s->seed >> 32), (uint32_t)scene, (uint32_t)head}};
  d.key[4] = 0x1BD11BDAu ^ d.key[0] ^ d.key[1] ^ d.key[2] ^ d.key[3];
  d.threshold = (uint32_t)min64(65535, (int64_t)(s->dropout_p * 65536 + 0.5));
  d.gain = 65536.0f / (float)(65536 - d.threshold);
  return d;
}

/* The words of a vector of counters. */
AST_INLINE void dropout_draw(const dropout *d, vu counter, vu query, vu words[4]) {
  static const uint8_t rotation[8][2] = {{10, 26}, {11, 21}, {13, 27}, {23, 5}, {6, 20}, {17, 11}, {25, 10}, {18, 20}};
  vu x[4] = {counter + d->key[0], query + d->key[1], (vu){0} + d->key[2], (vu){0} + d->key[3]};
  EACH(12, round) {
    const int a = round % 2 ? 3 : 1, b = round % 2 ? 1 : 3;
    const uint32_t r = rotation[round % 8][0], t = rotation[round % 8][1];
    x[0] += x[a];
    x[a] = ((x[a] << r) | (x[a] >> (32 - r))) ^ x[0];
    x[2] += x[b];
    x[b] = ((x[b] << t) | (x[b] >> (32 - t))) ^ x[2];
    if (round % 4 != 3) continue;
    const uint32_t s = (uint32_t)round / 4 + 1;
#pragma GCC unroll 4
    for (uint32_t i = 0; i < 4; i++) x[i] += d->key[(i + s) % 5];
    x[3] += s;
  }
  EACH(4, i) words[i] = x[i];
}

/* Words are drawn ahead of their use: a loop of nothing else keeps several counters in flight, each of which is a long
 * chain of dependent operations. With queries across the lanes: the words of VW queries and DROPOUT_KEYS keys, as
 * [lane][word]. */
typedef vu dropout_words[DROPOUT_LANES][4];

/* The words of the queries from `query` and the keys from `group` on, a multiple of DROPOUT_KEYS; lanes up to n. */
AST_INLINE void dropout_draw_queries(const dropout *d, int64_t query, int64_t group, int64_t n, dropout_words words) {
  const vu queries = (vu)LANE_INDICES + (uint32_t)query;
  for (int64_t lane = 0; lane < min64(n, DROPOUT_LANES); lane++)
    dropout_draw(d, (vu){0} + (uint32_t)(group / DROPOUT_SLOTS + lane), queries, words[lane]);
}

/* With keys across the lanes: the words of one query and DROPOUT_KEYS keys; a slot fills DROPOUT_PARTS vectors. */
enum { DROPOUT_PARTS = DROPOUT_LANES / VW };
typedef vu dropout_row[DROPOUT_PARTS][4];

AST_INLINE void dropout_draw_keys(const dropout *d, int64_t query, int64_t group, dropout_row words) {
  EACH(DROPOUT_PARTS, part) {
    const vu keys = (vu)LANE_INDICES + (uint32_t)(group / DROPOUT_SLOTS + part * VW);
    dropout_draw(d, keys, (vu){0} + (uint32_t)query, words[part]);
  }
}

/* x where the weight of slot is kept, 0 where it is dropped; threshold in the upper half of the word. */
AST_INLINE vf dropout_keep(const vu words[4], int slot, vu threshold, vf x) {
  const vu bits =
      slot % 2 ? words[slot / 2] : words[slot / 2] << 16; /* the half word on top: what is below it decides nothing */
  return (vf)((vi)x & (vi)(bits >= threshold));
}

#endif
