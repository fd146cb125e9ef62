/* The next coarser level of an octree, and the pairs of the stride-2 convolution between the two levels.
 *
 * Chunks as in octree.c, which holds what the two share. Scratch of the calling thread: slot 1 holds the cells that follow each cell,
 * slot 2 the counts of the chunks.
 */
#include "ast.h"
#include "simd.h"

/* ---- neighbours ---- */

/* Cells are handled by blocks of 8 x 8 x 8, whose keys agree from bit 9 up. A table of 9 x 9 x 9 holds the cells of a block and those
 * of the layers before it, so that the neighbours of a cell are reads at fixed distances. Of the seven blocks before this one
 * only those are searched that one of its cells looks into: few where cells are sparse. */
enum { BLOCK_BITS = 9, BLOCK_CELLS = 512, BLOCK_TABLE = 729 };

typedef struct {
  int16_t place[BLOCK_CELLS]; /* in the table, of a cell by the low bits of its key */
  uint8_t low[BLOCK_CELLS];   /* axes, as bits 4x + 2y + z, along which it lies in the first layer of its block */
  uint8_t high[BLOCK_CELLS];  /* ... in the last layer */
  int16_t step[8];            /* in the table, from a cell to its neighbour at -(i,j,k), by 4i + 2j + k */
} octree_block_layout;

typedef struct {
  const int64_t *keys, *offsets;
  int64_t B, C;
  const octree_block_layout *layout;
  int64_t *neighbours;
} octree_neighbour_job;

static octree_block_layout octree_layout(void) {
  octree_block_layout layout;
  for (unsigned key = 0; key < BLOCK_CELLS; key++) {
    const unsigned x = (unsigned)octree_gather(key >> 2), y = (unsigned)octree_gather(key >> 1), z = (unsigned)octree_gather(key);
    layout.place[key] = (int16_t)(81 * (x + 1) + 9 * (y + 1) + z + 1);
    layout.low[key] = (uint8_t)((x == 0) << 2 | (y == 0) << 1 | (z == 0));
    layout.high[key] = (uint8_t)((x == 7) << 2 | (y == 7) << 1 | (z == 7));
  }
  for (int d = 0; d < 8; d++) layout.step[d] = (int16_t)(81 * (d >> 2) + 9 * (d >> 1 & 1) + (d & 1));
  return layout;
}

/* The first i in [low, high) with keys[i] >= key, else high; steps of doubling length from `near` find it fast if it is close. */
static int64_t octree_search(const int64_t *keys, int64_t low, int64_t high, int64_t key, int64_t near) {
  near = max64(low, min64(near, high));
  int64_t step = 1;
  if (near < high && keys[near] < key) {
    low = near + 1;
    while (high - low >= step && keys[low + step - 1] < key) {
      low += step;
      step *= 2;
    }
    high = min64(high, low + step - 1);
  } else {
    high = near;
    while (high - low >= step && keys[high - step] >= key) {
      high -= step;
      step *= 2;
    }
    low = max64(low, high - step + 1);
  }
  while (low < high) {
    const int64_t middle = low + (high - low) / 2;
    if (keys[middle] < key) low = middle + 1;
    else high = middle;
  }
  return low;
}

/* The key of the block at -(i,j,k), d = 4i + 2j + k, or -1 if that is outside the grid. */
static int64_t octree_block_before(int64_t block, int d) {
  const uint64_t key = (uint64_t)block;
  uint64_t before = 0;
  for (int axis = 0; axis < 3; axis++) {
    const uint64_t mask = 0x1249249249249249ull << axis, part = key & mask;
    if (d >> axis & 1 && !part) return -1;
    before |= d >> axis & 1 ? (part - (1ull << axis)) & mask : part;
  }
  return (int64_t)before;
}

/* Enters the layers of earlier blocks that the cells of this one look into. Returns the number of places filled. */
static int octree_enter_layers(const octree_neighbour_job *s, int64_t block, unsigned looked_into, int64_t scene_begin, int64_t block_begin,
                               int64_t near[8], int64_t table[BLOCK_TABLE], int16_t filled[BLOCK_TABLE]) {
  int num = 0;
  for (int d = 1; d < 8; d++) {
    if (!(looked_into >> d & 1)) continue;
    const int64_t before = octree_block_before(block, d);
    if (before < 0) continue;
    int64_t c = near[d] = octree_search(s->keys, scene_begin, block_begin, before << BLOCK_BITS, near[d]);
    for (; c < block_begin && s->keys[c] >> BLOCK_BITS == before; c++) {
      const int64_t in_block = s->keys[c] & (BLOCK_CELLS - 1);
      if ((s->layout->high[in_block] & d) != d) continue;
      const int16_t place = (int16_t)(s->layout->place[in_block] - 8 * s->layout->step[d]);
      table[place] = c;
      filled[num++] = place;
    }
  }
  return num;
}

static ast_status octree_neighbour_task(int64_t chunk, void *context) {
  const octree_neighbour_job *s = context;
  const octree_block_layout *layout = s->layout;
  const int64_t chunk_end = min64(s->C, (chunk + 1) * OCTREE_CHUNK);
  int64_t b = octree_scene_of(s->offsets, s->B, chunk * OCTREE_CHUNK);
  int64_t table[BLOCK_TABLE], near[8];
  int16_t filled[BLOCK_TABLE];
  for (int i = 0; i < BLOCK_TABLE; i++) table[i] = -1;
  for (int d = 0; d < 8; d++) near[d] = chunk * OCTREE_CHUNK;
  for (int64_t c = chunk * OCTREE_CHUNK, end; c < chunk_end; c = end) {
    while (s->offsets[b + 1] <= c) b++;
    const int64_t block = s->keys[c] >> BLOCK_BITS, scene_end = min64(chunk_end, s->offsets[b + 1]);
    int64_t begin = c;
    while (begin > s->offsets[b] && s->keys[begin - 1] >> BLOCK_BITS == block) begin--;
    unsigned looked_into = 0; /* bit d: some cell's neighbour at some (i,j,k) lies in the block at -(i',j',k') = d */
    for (end = begin; end < scene_end && s->keys[end] >> BLOCK_BITS == block; end++) {
      const int64_t in_block = s->keys[end] & (BLOCK_CELLS - 1);
      table[layout->place[in_block]] = end;
      if (end >= c)
        for (int d = 1; d < 8; d++) looked_into |= (unsigned)((layout->low[in_block] & d) == d) << d;
    }
    const int num = octree_enter_layers(s, block, looked_into, s->offsets[b], begin, near, table, filled);
    for (int64_t i = c; i < end; i++)
      for (int d = 0; d < 8; d++) s->neighbours[8 * i + d] = table[layout->place[s->keys[i] & (BLOCK_CELLS - 1)] - layout->step[d]];
    for (int64_t i = begin; i < end; i++) table[layout->place[s->keys[i] & (BLOCK_CELLS - 1)]] = -1;
    for (int i = 0; i < num; i++) table[filled[i]] = -1;
  }
  return AST_OK;
}

/* ---- pairs ---- */

/* Along one axis fine = 2P + a has a = 0 if fine is even, and a = +1 (P its parent) or -1 (P the parent's successor) if it is odd.
 * So the coarse cell P pairs with the child `octant` of the cell Q at P - (i,j,k) if the octant has the bits (i,j,k), at
 * (a,b,c) = octant - 2 (i,j,k). */
enum { OCTREE_GROUPS = 27 };

typedef struct {
  const int64_t *keys, *first_child;
  const int64_t *before, *after; /* [C,8]: the coarse cells at -(i,j,k) and at +(i,j,k), or -1 */
  int64_t C;
  int64_t *counts; /* [2, chunks, 27]: pairs of each chunk, by coarse and by fine cell; then where they go */
  int64_t *fine[2], *coarse[2];
} octree_pair_job;

/* The kernel offset of child `octant` at (i,j,k), or -1. */
AST_INLINE int octree_group(int octant, int d) {
  if ((octant & d) != d) return -1;
  const int a = (octant >> 2) - 2 * (d >> 2), b = (octant >> 1 & 1) - 2 * (d >> 1 & 1), c = (octant & 1) - 2 * (d & 1);
  return 9 * (a + 1) + 3 * (b + 1) + (c + 1);
}

typedef struct {
  int8_t of[8][8]; /* [octant][d] */
} octree_group_table;

static octree_group_table octree_groups(void) {
  octree_group_table groups;
  for (int octant = 0; octant < 8; octant++)
    for (int d = 0; d < 8; d++) groups.of[octant][d] = (int8_t)octree_group(octant, d);
  return groups;
}

/* The pairs of a chunk with P rising: next[k] goes up by one for each of group k. */
AST_INLINE void octree_pairs_by_coarse(const octree_pair_job *s, int64_t chunk, int64_t *next, const bool write) {
  const octree_group_table groups = octree_groups();
  for (int64_t P = chunk * OCTREE_CHUNK; P < min64(s->C, (chunk + 1) * OCTREE_CHUNK); P++)
    for (int d = 0; d < 8; d++) {
      const int64_t Q = s->before[8 * P + d];
      if (Q < 0) continue;
      for (int64_t f = s->first_child[Q]; f < s->first_child[Q + 1]; f++) {
        const int k = groups.of[s->keys[f] & 7][d];
        if (k < 0) continue;
        const int64_t to = next[k]++;
        if (write) s->fine[0][to] = f;
        if (write) s->coarse[0][to] = P;
      }
    }
}

/* The same pairs for a chunk of parents Q, with the fine cell rising. */
AST_INLINE void octree_pairs_by_fine(const octree_pair_job *s, int64_t chunk, int64_t *next, const bool write) {
  const octree_group_table groups = octree_groups();
  for (int64_t Q = chunk * OCTREE_CHUNK; Q < min64(s->C, (chunk + 1) * OCTREE_CHUNK); Q++)
    for (int64_t f = s->first_child[Q]; f < s->first_child[Q + 1]; f++) {
      const int octant = (int)(s->keys[f] & 7);
      for (int d = octant;; d = (d - 1) & octant) { /* all subsets of its bits */
        const int64_t P = s->after[8 * Q + d];
        if (P >= 0) {
          const int64_t to = next[groups.of[octant][d]]++;
          if (write) s->fine[1][to] = f;
          if (write) s->coarse[1][to] = P;
        }
        if (d == 0) break;
      }
    }
}

/* Tasks: the chunks by coarse cell, then those by fine cell. */
static ast_status octree_count_pairs_task(int64_t index, void *context) {
  const octree_pair_job *s = context;
  const int64_t chunks = octree_chunks(s->C);
  int64_t count[OCTREE_GROUPS] = {0};
  if (index < chunks) octree_pairs_by_coarse(s, index, count, false);
  else octree_pairs_by_fine(s, index - chunks, count, false);
  memcpy(s->counts + OCTREE_GROUPS * index, count, sizeof count);
  return AST_OK;
}

static ast_status octree_write_pairs_task(int64_t index, void *context) {
  const octree_pair_job *s = context;
  const int64_t chunks = octree_chunks(s->C);
  int64_t *next = s->counts + OCTREE_GROUPS * index;
  if (index < chunks) octree_pairs_by_coarse(s, index, next, true);
  else octree_pairs_by_fine(s, index - chunks, next, true);
  return AST_OK;
}

static ast_status octree_coarsen(const int64_t *restrict keys, const int64_t *restrict offsets, int64_t B, int64_t *restrict coarse_keys,
                                 int64_t *restrict coarse_offsets, int64_t *restrict first_child, int64_t *restrict neighbours,
                                 int64_t *restrict pair_offsets) {
  ast_status status = octree_runs((const uint64_t *)keys, 3, offsets, B, coarse_keys, first_child, coarse_offsets);
  if (status != AST_OK) return status;
  const int64_t C = coarse_offsets[B], chunks = octree_chunks(C);
  const octree_block_layout layout = octree_layout();
  octree_neighbour_job neighbour = {coarse_keys, coarse_offsets, B, C, &layout, neighbours};
  ast_parallel(chunks, octree_neighbour_task, &neighbour);

  octree_pair_job pair = {.keys = keys, .first_child = first_child, .before = neighbours, .C = C};
  pair.counts = ast_scratch(2, (OCTREE_GROUPS * chunks + 1) * (int64_t)sizeof *pair.counts);
  if (!pair.counts) return AST_NO_MEMORY;
  ast_parallel(chunks, octree_count_pairs_task, &pair);
  pair_offsets[0] = 0;
  for (int k = 0; k < OCTREE_GROUPS; k++) {
    pair_offsets[k + 1] = pair_offsets[k];
    for (int64_t i = 0; i < chunks; i++) pair_offsets[k + 1] += pair.counts[OCTREE_GROUPS * i + k];
  }
  return AST_OK;
}

typedef struct {
  const int64_t *before;
  int64_t C;
  int64_t *after;
} octree_after_job;

/* Q = before[P][d] means P = after[Q][d]: each entry of `after` has at most one writer. */
static ast_status octree_after_task(int64_t chunk, void *context) {
  const octree_after_job *s = context;
  for (int64_t i = 8 * chunk * OCTREE_CHUNK; i < 8 * min64(s->C, (chunk + 1) * OCTREE_CHUNK); i++)
    if (s->before[i] >= 0) s->after[8 * s->before[i] + (i & 7)] = i >> 3;
  return AST_OK;
}

static ast_status octree_pairs(const int64_t *restrict keys, const int64_t *restrict first_child, const int64_t *restrict neighbours,
                               int64_t C_coarse, const int64_t *restrict pair_offsets, int64_t *restrict fine, int64_t *restrict coarse,
                               int64_t *restrict fine_by_fine, int64_t *restrict coarse_by_fine) {
  const int64_t chunks = octree_chunks(C_coarse);
  if (chunks == 0) return AST_OK;
  octree_after_job after = {neighbours, C_coarse, ast_scratch(1, 8 * C_coarse * (int64_t)sizeof(int64_t))};
  octree_pair_job pair = {keys,
                          first_child,
                          neighbours,
                          after.after,
                          C_coarse,
                          ast_scratch(2, 2 * OCTREE_GROUPS * chunks * (int64_t)sizeof(int64_t)),
                          {fine, fine_by_fine},
                          {coarse, coarse_by_fine}};
  if (!after.after || !pair.counts) return AST_NO_MEMORY;
  memset(after.after, 0xff, 8 * (size_t)C_coarse * sizeof *after.after); /* -1 */
  ast_parallel(chunks, octree_after_task, &after);
  ast_parallel(2 * chunks, octree_count_pairs_task, &pair);
  for (int list = 0; list < 2; list++)
    for (int k = 0; k < OCTREE_GROUPS; k++) {
      int64_t next = pair_offsets[k];
      for (int64_t i = list * chunks; i < (list + 1) * chunks; i++) {
        const int64_t here = pair.counts[OCTREE_GROUPS * i + k];
        pair.counts[OCTREE_GROUPS * i + k] = next;
        next += here;
      }
      if (next != pair_offsets[k + 1]) return AST_MISMATCH;
    }
  return ast_parallel(2 * chunks, octree_write_pairs_task, &pair);
}
