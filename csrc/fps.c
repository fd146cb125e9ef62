/* Exact greedy farthest point sampling, with lazy distances.
 *
 * t_0 = 0, t_{j+1} = argmax_i d_i with d_i = min_{k <= j} |x_i - x_{t_k}|^2, the lowest i of several. Legend: n points,
 * samples t.
 *
 * Distances only fall as samples come. So a block of consecutive points may stop looking at new samples: the largest
 * distance that it had then stays an upper bound. The next sample lies in the block with the largest bound, once that
 * block has seen all samples; until then it looks at the samples it missed, its bound falls, and another block may
 * lead. A missed sample matters only if its distance from the bounding box of the block is less than the bound.
 * (Bounding boxes and deferred samples: Han et al., "QuickFPS", IEEE TCAD 2023; there the blocks are the leaves of a KD
 * tree, here the points come in Morton order and any cut gives small blocks.)
 *
 * Exact for any order of points: a block whose bound is reached has seen everything, and among equal bounds the first
 * block leads. Cost: at most n distances a sample, as without blocks; in Morton order few blocks are looked at between
 * two samples.
 *
 * Squared distances are integers, below 2^44; they fit in int32 unless the scene is wide.
 */
#include "ast.h"
#include "simd.h"

enum { FPS_EXTENT = 1 << 21, FPS_TILE = 64 };

/* A tournament of blocks. The leaves, nodes leaves..2 leaves - 1, hold a key for each block; node i holds the larger of
 * nodes 2i and 2i + 1, node 1 the largest of all. A key is the bound, below 2^44, and the block counted from the last
 * one possible: so the first block wins among equals. Leaves beyond the last block hold -1. */
enum { FPS_BLOCK_BITS = 19, FPS_BLOCKS = 1 << FPS_BLOCK_BITS };

typedef struct {
  int64_t leaves; /* a power of two */
  int64_t *keys;  /* [2 leaves] */
} fps_tournament;

AST_INLINE int64_t fps_key(int64_t bound, int64_t block) { return bound << FPS_BLOCK_BITS | (FPS_BLOCKS - 1 - block); }
AST_INLINE int64_t fps_key_bound(int64_t key) { return key >> FPS_BLOCK_BITS; }
AST_INLINE int64_t fps_key_block(int64_t key) { return FPS_BLOCKS - 1 - (key & (FPS_BLOCKS - 1)); }

AST_INLINE void fps_replay(fps_tournament t, int64_t key) {
  int64_t i = t.leaves + fps_key_block(key);
  t.keys[i] = key;
  for (; i > 1; i /= 2) {
    key = max64(key, t.keys[i ^ 1]);
    t.keys[i / 2] = key;
  }
}

/* Points of a block: few blocks for small scenes, and never more than FPS_BLOCKS. */
static int64_t fps_block_size(int64_t n) {
  const int64_t size = n <= 512 ? n : n < 20000 ? 128 : 192;
  return round_up(max64(size, divide_up(n, FPS_BLOCKS)), FPS_TILE);
}

/* 2^l, for loops over l that no instruction set has a shift for. */
static const uint32_t fps_bits[32] = {0x1,        0x2,        0x4,        0x8,       0x10,      0x20,      0x40,
                                      0x80,       0x100,      0x200,      0x400,     0x800,     0x1000,    0x2000,
                                      0x4000,     0x8000,     0x10000,    0x20000,   0x40000,   0x80000,   0x100000,
                                      0x200000,   0x400000,   0x800000,   0x1000000, 0x2000000, 0x4000000, 0x8000000,
                                      0x10000000, 0x20000000, 0x40000000, 0x80000000};

#define T          int32_t
#define COORDINATE int16_t
#define FPS(name)  fps_narrow_##name
#include "fps_scan.h"

#define T          int64_t
#define COORDINATE int32_t
#define FPS(name)  fps_wide_##name
#include "fps_scan.h"

typedef struct {
  const int32_t *coordinates;
  const int64_t *offsets, *out_offsets;
  int64_t num;
  int64_t *indices;
} fps_job;

/* The middle of the bounding box, and the square of its diagonal; -1 if it is 2^21 or more wide. */
static int64_t fps_extent(const int32_t *coordinates, int64_t n, int32_t middle[3]) {
  enum { FLAT = 48 };
  int32_t least[FLAT], most[FLAT];
  for (int l = 0; l < FLAT; l++) least[l] = most[l] = coordinates[l % 3];
  int64_t i = 0, square = 0;
  for (; i + FLAT <= 3 * n; i += FLAT)
    for (int l = 0; l < FLAT; l++) {
      least[l] = coordinates[i + l] < least[l] ? coordinates[i + l] : least[l];
      most[l] = coordinates[i + l] > most[l] ? coordinates[i + l] : most[l];
    }
  for (int l = 0; i + l < 3 * n; l++) {
    least[l] = coordinates[i + l] < least[l] ? coordinates[i + l] : least[l];
    most[l] = coordinates[i + l] > most[l] ? coordinates[i + l] : most[l];
  }
  for (int a = 0; a < 3; a++) {
    int32_t low = least[a], high = most[a];
    for (int l = a; l < FLAT; l += 3) {
      low = least[l] < low ? least[l] : low;
      high = most[l] > high ? most[l] : high;
    }
    const int64_t extent = (int64_t)high - low;
    if (extent >= FPS_EXTENT) return -1;
    middle[a] = (int32_t)(low + extent / 2);
    square += extent * extent;
  }
  return square;
}

/* Once all distances are 0: the lowest points not among the `taken` samples, until there are num. */
static ast_status fps_fill_up(int64_t begin, int64_t n, int64_t taken, int64_t num, int64_t *indices) {
  if (taken == num) return AST_OK;
  uint8_t *used = ast_scratch(n);
  if (!used) return AST_NO_MEMORY;
  memset(used, 0, (size_t)n);
  for (int64_t i = 0; i < taken; i++) used[indices[i] - begin] = 1;
  for (int64_t i = 0; taken < num; i++)
    if (!used[i]) indices[taken++] = begin + i;
  return AST_OK;
}

static ast_status fps_task(int64_t scene, void *context) {
  const fps_job *job = context;
  const int64_t begin = job->offsets[scene], n = job->offsets[scene + 1] - begin;
  const int32_t *coordinates = job->coordinates + 3 * begin;
  int64_t *indices = job->indices + job->out_offsets[scene];
  int32_t middle[3];
  if (n == 0) return AST_OK;
  const int64_t square = fps_extent(coordinates, n, middle);
  if (square < 0) return AST_OUTSIDE;
  if (n <= job->num) {
    for (int64_t i = 0; i < n; i++) indices[i] = begin + i;
    return AST_OK;
  }
  /* Differences of at most sqrt(INT32_MAX) = 46340: relative to the middle they fit in int16. */
  const int64_t taken = square <= INT32_MAX ? fps_narrow_sample(coordinates, n, middle, begin, job->num, indices)
                                            : fps_wide_sample(coordinates, n, middle, begin, job->num, indices);
  return taken ? fps_fill_up(begin, n, taken, job->num, indices) : AST_NO_MEMORY;
}

static ast_status farthest_point_sample(const int32_t *restrict coordinates, const int64_t *restrict offsets, int64_t B,
                                        int64_t num, const int64_t *restrict out_offsets, int64_t *restrict indices) {
  fps_job job = {coordinates, offsets, out_offsets, num, indices};
  return ast_parallel(B, fps_task, &job);
}
