/* Exact greedy farthest point sampling.
 *
 * t_0 = 0, t_{j+1} = argmax_i min_{k <= j} |x_i - x_{t_k}|^2, the lowest i of several. Points come in Morton order, so blocks of
 * consecutive points are small in space. Each block keeps its bounding box and the largest of its distances: a new sample that is
 * farther from the box than that changes nothing in the block, and only the few other blocks are scanned (Han et al., "QuickFPS",
 * IEEE TCAD 2023, with a KD tree in place of the Morton order). Any order of points gives the same, exact result.
 *
 * Squared distances are integers. They fit in int32 unless the scene is wide; then they are exact in double (3 * 2^42 < 2^53).
 * Scratch: slot 1 of the thread holds the blocks, slot 2 which points are taken.
 */
#include "ast.h"
#include "simd.h"

enum { FPS_LANES = 16, FPS_EXTENT = 1 << 21 };

#define T         int32_t
#define INTEGER   int32_t
#define FPS(name) fps_narrow_##name
#define FPS_FAR   INT32_MAX
#include "fps_scan.h"

#define T         double
#define INTEGER   int64_t
#define FPS(name) fps_wide_##name
#define FPS_FAR   0x1p62
#include "fps_scan.h"

typedef struct {
  const int32_t *coordinates;
  const int64_t *offsets, *out_offsets;
  int64_t num;
  int64_t *indices;
} fps_job;

/* The least coordinate on each axis, and the square of the diagonal of the bounding box; -1 if that is 2^21 or more wide. */
static int64_t fps_extent(const int32_t *coordinates, int64_t n, int32_t low[3]) {
  enum { FLAT = 3 * FPS_LANES };
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
    low[a] = least[a];
    int32_t high = most[a];
    for (int l = a; l < FLAT; l += 3) {
      low[a] = least[l] < low[a] ? least[l] : low[a];
      high = most[l] > high ? most[l] : high;
    }
    const int64_t extent = (int64_t)high - low[a];
    if (extent >= FPS_EXTENT) return -1;
    square += extent * extent;
  }
  return square;
}

static ast_status fps_task(int64_t scene, void *context) {
  const fps_job *s = context;
  const int64_t begin = s->offsets[scene], n = s->offsets[scene + 1] - begin, size = n < 10000 ? 64 : 128;
  const int32_t *coordinates = s->coordinates + 3 * begin;
  int64_t *indices = s->indices + s->out_offsets[scene], taken = 0;
  int32_t low[3];
  if (n == 0) return AST_OK;
  const int64_t square = fps_extent(coordinates, n, low);
  if (square < 0) return AST_OUTSIDE;
  if (n <= s->num) {
    for (int64_t i = 0; i < n; i++) indices[i] = begin + i;
    return AST_OK;
  }
  const bool narrow = square <= INT32_MAX;
  void *memory = ast_scratch(1, narrow ? fps_narrow_bytes(n, size) : fps_wide_bytes(n, size));
  uint8_t *used = ast_scratch(2, n);
  if (!memory || !used) return AST_NO_MEMORY;
  memset(used, 0, (size_t)n);
  fps_narrow_blocks ints;
  fps_wide_blocks doubles;
  if (narrow) ints = fps_narrow_cut(coordinates, n, low, size, memory);
  else doubles = fps_wide_cut(coordinates, n, low, size, memory);
  for (int64_t pick = 0; taken < s->num && pick >= 0;) {
    used[pick] = 1;
    indices[taken++] = begin + pick;
    if (taken < s->num) pick = narrow ? fps_narrow_step(&ints, pick) : fps_wide_step(&doubles, pick);
  }
  for (int64_t i = 0; taken < s->num; i++)
    if (!used[i]) indices[taken++] = begin + i;
  return AST_OK;
}

static ast_status farthest_point_sample(const int32_t *restrict coordinates, const int64_t *restrict offsets, int64_t B, int64_t num,
                                        const int64_t *restrict out_offsets, int64_t *restrict indices) {
  fps_job job = {coordinates, offsets, out_offsets, num, indices};
  return ast_parallel(B, fps_task, &job);
}
