/* The pairs of the stride-2 convolution between a level of an octree and the next coarser one.
 *
 * Kernel offset k = 9(a+1) + 3(b+1) + (c+1) pairs the coarse cell P with the fine cell 2P + (a,b,c). Along one
 * axis a = 0 if the fine cell is even, and a = +1 (P its parent) or -1 (P the parent's successor) if it is odd. So P
 * pairs with child `octant` of the cell Q at P - (i,j,k) if the octant has the bits d = 4i+2j+k, at
 * (a,b,c) = octant - 2 (i,j,k): a kernel offset is such a pair (octant, d).
 *
 * The pairs of a group are written with P rising, by chunks of P whose places coarsen.c has counted. With d = 0 the
 * fine cell is a child of P and rises too, so the other order is the same. With d > 0 the fine cells of a group are
 * marked in a bit map and read out of it in order.
 */
#include "ast.h"
#include "simd.h"

typedef struct {
  const ast_octree_level *level;
  int64_t *keys, *first_child, *node_cell;
  int64_t *fine, *coarse, *fine_by_fine, *coarse_by_fine;
} octree_pair_job;

static ast_status octree_write_pairs_task(int64_t chunk, void *context) {
  const octree_pair_job *job = context;
  const ast_octree_level *level = job->level;
  const int64_t begin = chunk * OCTREE_CHUNK, end = min64(level->C, begin + OCTREE_CHUNK);
  int64_t next[OCTREE_GROUPS];
  memcpy(next, level->pairs + OCTREE_GROUPS * chunk, sizeof next);
  memcpy(job->keys + begin, level->keys + begin, (size_t)(end - begin) * sizeof *level->keys);
  for (int64_t P = begin; P < end; P++) {
    int64_t f = job->first_child[P] = octree_first(level->families[P]);
    for (unsigned octants = octree_octants(level->families[P]); octants; octants &= octants - 1, f++) {
      const int64_t to = next[octree_group(__builtin_ctz(octants))]++;
      job->fine[to] = job->fine_by_fine[to] = f;
      job->coarse[to] = job->coarse_by_fine[to] = job->node_cell[f] = P;
    }
    for (uint64_t others = level->others[P]; others; others &= others - 1) {
      const int place = __builtin_ctzll(others);
      const int64_t to = next[octree_group(place)]++, family = level->families[level->before[P][place >> 3]];
      job->fine[to] = octree_first(family) + __builtin_popcount(octree_octants(family) & ((1u << (place & 7)) - 1));
      job->coarse[to] = P;
    }
  }
  return AST_OK;
}

/* Sorts the pairs of group k, whose fine cells differ, by the fine cell. */
static ast_status octree_sort_pairs_task(int64_t k, void *context) {
  const octree_pair_job *job = context;
  const ast_octree_level *level = job->level;
  const int64_t begin = level->pair_offsets[k], end = level->pair_offsets[k + 1], words = level->C_fine / 64 + 1;
  const bool sorted = k / 9 > 0 && k / 3 % 3 > 0 && k % 3 > 0; /* a, b and c are not -1: d = 0 */
  if (sorted || begin == end) return AST_OK;
  uint64_t *marked = ast_scratch(8 * words + 4 * level->C_fine);
  if (!marked) return AST_NO_MEMORY;
  int32_t *place = (int32_t *)(marked + words);
  memset(marked, 0, 8 * (size_t)words);
  for (int64_t i = begin; i < end; i++) {
    marked[job->fine[i] >> 6] |= 1ull << (job->fine[i] & 63);
    place[job->fine[i]] = (int32_t)(i - begin);
  }
  for (int64_t word = 0, to = begin; to < end; word++)
    for (uint64_t bits = marked[word]; bits; bits &= bits - 1, to++) {
      const int64_t f = 64 * word + __builtin_ctzll(bits);
      job->fine_by_fine[to] = f;
      job->coarse_by_fine[to] = job->coarse[begin + place[f]];
    }
  return AST_OK;
}

static ast_status octree_write_level(const ast_octree_level *level, int64_t *restrict keys, int64_t *restrict offsets,
                                     int64_t *restrict first_child, int64_t *restrict node_cell, int64_t *restrict fine,
                                     int64_t *restrict coarse, int64_t *restrict fine_by_fine,
                                     int64_t *restrict coarse_by_fine) {
  octree_pair_job job = {level, keys, first_child, node_cell, fine, coarse, fine_by_fine, coarse_by_fine};
  memcpy(offsets, level->offsets, (size_t)(level->B + 1) * sizeof *offsets);
  first_child[level->C] = level->C_fine;
  ast_parallel(octree_chunks(level->C), octree_write_pairs_task, &job);
  return ast_parallel(OCTREE_GROUPS, octree_sort_pairs_task, &job);
}
