/* Linear octrees: the cells of points by Morton key.
 *
 * The Morton key of cell (x, y, z) interleaves the bits, x first: ... x1 y1 z1 x0 y0 z0. A shift by 3 is the parent's
 * key, and the cells of any aligned cube of 2^m cells a side are a contiguous run of the sorted keys.
 *
 * Work is cut into fixed chunks of the flat arrays, whatever the scenes, and every result is an integer that does not
 * depend on the chunks.
 */
#include <math.h>

#include "ast.h"
#include "simd.h"

enum { OCTREE_CHUNK = 1 << 13, OCTREE_TILE = 64 };

static int64_t octree_chunks(int64_t n) { return divide_up(n, OCTREE_CHUNK); }

/* ---- Morton keys ---- */

/* Bit i of x < 2^21 goes to bit 3i. */
AST_INLINE uint64_t octree_spread(uint64_t x) {
  x = (x | x << 32) & 0x001f00000000ffff;
  x = (x | x << 16) & 0x001f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  return (x | x << 2) & 0x1249249249249249;
}

/* The inverse: bit 3i goes to bit i. */
AST_INLINE uint64_t octree_gather(uint64_t x) {
  x &= 0x1249249249249249;
  x = (x | x >> 2) & 0x10c30c30c30c30c3;
  x = (x | x >> 4) & 0x100f00f00f00f00f;
  x = (x | x >> 8) & 0x001f0000ff0000ff;
  x = (x | x >> 16) & 0x001f00000000ffff;
  return (x | x >> 32) & 0x1fffff;
}

typedef struct {
  const float *positions;
  int64_t N;
  const double *center;
  double half_width;
  int depth;
  uint64_t *keys;
} octree_key_job;

/* u = (p - center + half_width) / (2 half_width), which is in [0, 1] inside the cube. */
static ast_status octree_check_node(const octree_key_job *job, int64_t n) {
  ast_status status = AST_OK;
  for (int a = 0; a < 3; a++) {
    const float p = job->positions[3 * n + a];
    const double u = (p - job->center[a] + job->half_width) / (2 * job->half_width);
    if (!isfinite(p)) return AST_NOT_FINITE;
    if (!(u >= -1e-6 && u <= 1 + 1e-6)) status = AST_OUTSIDE;
  }
  return status;
}

/* min(floor(u 2^depth), 2^depth - 1) = floor(min(u 2^depth, 2^depth - 1)), and truncation is floor above 0: so the
 * clamp comes first, in double, and no value overflows the conversion, not even NaN. */
static ast_status octree_key_task(int64_t index, void *context) {
  const octree_key_job *job = context;
  const int64_t end = min64(job->N, (index + 1) * OCTREE_CHUNK);
  const double cells = (double)(1 << job->depth), last = cells - 1, h = job->half_width, width = 2 * h;
  double center[3 * OCTREE_TILE];
  int32_t cell[3 * OCTREE_TILE];
  uint64_t x[OCTREE_TILE], y[OCTREE_TILE], z[OCTREE_TILE];
  int64_t inside = -1;
  for (int i = 0; i < 3 * OCTREE_TILE; i++) center[i] = job->center[i % 3];
  for (int64_t begin = index * OCTREE_CHUNK; begin < end; begin += OCTREE_TILE) {
    const int num = (int)min64(OCTREE_TILE, end - begin);
    const float *p = job->positions + 3 * begin;
    for (int i = 0; i < 3 * num; i++) {
      const double u = (p[i] - center[i] + h) / width;
      inside &= u >= -1e-6 && u <= 1 + 1e-6 ? -1 : 0;
      double v = u * cells;
      v = v < last ? v : last;
      v = v > 0 ? v : 0;
      cell[i] = (int32_t)v;
    }
    for (int i = 0; i < num; i++) {
      x[i] = (uint64_t)cell[3 * i];
      y[i] = (uint64_t)cell[3 * i + 1];
      z[i] = (uint64_t)cell[3 * i + 2];
    }
    uint64_t *key = job->keys + begin;
    for (int i = 0; i < num; i++) key[i] = octree_spread(x[i]) << 2 | octree_spread(y[i]) << 1 | octree_spread(z[i]);
  }
  return inside ? AST_OK : AST_OUTSIDE;
}

typedef struct {
  const int64_t *keys;
  int64_t C;
  int32_t *coordinates;
} octree_coordinates_job;

static ast_status octree_coordinates_task(int64_t index, void *context) {
  const octree_coordinates_job *job = context;
  for (int64_t c = index * OCTREE_CHUNK; c < min64(job->C, (index + 1) * OCTREE_CHUNK); c++) {
    const uint64_t key = (uint64_t)job->keys[c];
    for (int a = 0; a < 3; a++) job->coordinates[3 * c + a] = (int32_t)octree_gather(key >> (2 - a));
  }
  return AST_OK;
}

static ast_status octree_coordinates(const int64_t *restrict keys, int64_t C, int32_t *restrict coordinates) {
  octree_coordinates_job job = {keys, C, coordinates};
  return ast_parallel(octree_chunks(C), octree_coordinates_task, &job);
}

/* ---- sort ---- */

/* Rows to sort by key, stably: a word key << index_bits | index where that fits in 64 bits, else a key and an index. */
typedef struct {
  const int64_t *offsets;
  int64_t N;
  int index_bits; /* of the row within its scene; 0: not packed */
  bool packed;
  uint64_t *keys, *other; /* [N], or [2N] if not packed: the indices follow */
} octree_sort_job;

enum { OCTREE_MAX_DIGIT = 11, OCTREE_HISTOGRAM = 6 << OCTREE_MAX_DIGIT }; /* 63 bits in 6 digits of 11, or 8 of 8 */

/* Packed words, or keys beside the indices of their rows. */
typedef struct {
  uint64_t *keys, *nodes;
} octree_rows;

/* One pass of the LSD radix sort, by the digit (key >> shift) & mask; count[d] is where digit d starts. */
AST_INLINE void octree_scatter(octree_rows from, octree_rows to, int64_t n, int shift, uint64_t mask, int64_t *count,
                               const bool packed) {
  for (int64_t i = 0; i < n; i++) {
    const int64_t place = count[from.keys[i] >> shift & mask]++;
    to.keys[place] = from.keys[i];
    if (!packed) to.nodes[place] = from.nodes[i];
  }
}

/* Sorts n rows by the bits low..high-1 of their keys, the only ones that differ. */
AST_INLINE ast_status octree_radix_sort(const octree_rows rows, octree_rows other, int64_t n, int low, int high,
                                        const bool packed) {
  const int max_digit = n < 1 << 12 ? 8 : n < 1 << 20 ? OCTREE_MAX_DIGIT : 9;
  const int passes =
      (high - low + max_digit - 1) / max_digit; /* in int: the loops below come out slower from int64_t */
  if (!passes) return AST_OK;
  const int digit = (high - low + passes - 1) / passes;
  const uint64_t mask = (1ull << digit) - 1;
  int64_t *count = ast_scratch(OCTREE_HISTOGRAM * (int64_t)sizeof *count);
  if (!count) return AST_NO_MEMORY;
  memset(count, 0, sizeof *count * (size_t)passes << digit);
  for (int64_t i = 0; i < n; i++)
    for (int pass = 0; pass < passes; pass++)
      count[(uint64_t)pass << digit | (rows.keys[i] >> (low + pass * digit) & mask)]++;
  octree_rows now = rows;
  for (int pass = 0; pass < passes; pass++) {
    const int shift = low + pass * digit;
    int64_t *from = count + ((int64_t)pass << digit), total = 0;
    if (from[now.keys[0] >> shift & mask] == n) continue;
    for (uint64_t d = 0; d <= mask; d++) {
      const int64_t of_digit = from[d];
      from[d] = total;
      total += of_digit;
    }
    octree_scatter(now, other, n, shift, mask, from, packed);
    const octree_rows swap = now;
    now = other;
    other = swap;
  }
  if (now.keys != rows.keys) {
    memcpy(rows.keys, now.keys, sizeof *now.keys * (size_t)n);
    if (!packed) memcpy(rows.nodes, now.nodes, sizeof *now.nodes * (size_t)n);
  }
  return AST_OK;
}

static ast_status octree_sort_task(int64_t b, void *context) {
  const octree_sort_job *job = context;
  const int64_t begin = job->offsets[b], n = job->offsets[b + 1] - begin;
  if (n == 0) return AST_OK;
  uint64_t *keys = job->keys + begin, *other = job->other + begin, differ = 0;
  for (int64_t i = 0; i < n; i++) differ |= keys[i] ^ keys[0];
  const int low = differ ? __builtin_ctzll(differ) : 0, high = num_bits(differ);
  if (job->packed) {
    for (int64_t i = 0; i < n; i++) keys[i] = keys[i] << job->index_bits | (uint64_t)i;
    return octree_radix_sort((octree_rows){keys, NULL}, (octree_rows){other, NULL}, n, low + job->index_bits,
                             high + job->index_bits, true);
  }
  for (int64_t i = 0; i < n; i++) keys[job->N + i] = (uint64_t)i;
  const octree_rows rows = {keys, keys + job->N}, spare = {other, other + job->N};
  return octree_radix_sort(rows, spare, n, low, high, false);
}

/* ---- runs of equal keys ---- */

/* The runs of equal sorted[i] >> shift within each scene. */
typedef struct {
  const uint64_t *sorted;
  int shift;
  const int64_t *offsets;
  int64_t B, N;
  int64_t *chunk_runs;    /* [chunks + 1]: the runs that start in each chunk, then their running sums */
  int64_t *keys, *starts; /* of each run */
} octree_run_job;

/* The rows of begin..end-1, in one scene, that start a run; the scene starts at `first`. */
AST_INLINE int octree_heads(const octree_run_job *job, int64_t begin, int64_t end, int64_t first, int32_t *heads) {
  int num = 0;
  for (int64_t i = begin; i < end; i++) {
    heads[num] = (int32_t)(i - begin);
    num += i == first || job->sorted[i] >> job->shift != job->sorted[i - 1] >> job->shift;
  }
  return num;
}

AST_INLINE void octree_runs_of_chunk(const octree_run_job *job, int64_t chunk, const bool write) {
  const int64_t end = min64(job->N, (chunk + 1) * OCTREE_CHUNK);
  int64_t b = scene_at(job->offsets, job->B, chunk * OCTREE_CHUNK), run = write ? job->chunk_runs[chunk] : 0;
  int32_t heads[OCTREE_TILE];
  for (int64_t i = chunk * OCTREE_CHUNK, next; i < end; i = next) {
    while (job->offsets[b + 1] <= i) b++;
    next = min64(min64(end, job->offsets[b + 1]), i + OCTREE_TILE);
    const int num = octree_heads(job, i, next, job->offsets[b], heads);
    for (int j = 0; write && j < num; j++) {
      job->keys[run + j] = (int64_t)(job->sorted[i + heads[j]] >> job->shift);
      job->starts[run + j] = i + heads[j];
    }
    run += num;
  }
  if (!write) job->chunk_runs[chunk] = run;
}

static ast_status octree_count_runs_task(int64_t chunk, void *context) {
  octree_runs_of_chunk(context, chunk, false);
  return AST_OK;
}

static ast_status octree_write_runs_task(int64_t chunk, void *context) {
  octree_runs_of_chunk(context, chunk, true);
  return AST_OK;
}

/* The keys and starts of all runs, starts closed by N, and the first run of each scene. */
static ast_status octree_runs(const uint64_t *sorted, int shift, const int64_t *offsets, int64_t B, int64_t *keys,
                              int64_t *starts, int64_t *run_offsets) {
  const int64_t N = offsets[B], chunks = octree_chunks(N);
  octree_run_job job = {sorted, shift, offsets, B, N, ast_scratch((chunks + 1) * (int64_t)sizeof(int64_t)),
                        keys,   starts};
  if (!job.chunk_runs) return AST_NO_MEMORY;
  ast_parallel(chunks, octree_count_runs_task, &job);
  int64_t runs = 0;
  for (int64_t i = 0; i < chunks; i++) {
    const int64_t here = job.chunk_runs[i];
    job.chunk_runs[i] = runs;
    runs += here;
  }
  ast_parallel(chunks, octree_write_runs_task, &job);
  starts[runs] = N;
  for (int64_t b = 0, run = 0; b <= B; b++) run_offsets[b] = run = lower_bound(starts, run, runs, offsets[b]);
  return AST_OK;
}

/* ---- build ---- */

typedef struct {
  const octree_sort_job *sort;
  const int64_t *offsets, *cell_offsets, *node_offsets;
  int64_t B, C;
  int64_t *node_cell, *node_order;
} octree_node_job;

static ast_status octree_node_task(int64_t chunk, void *context) {
  const octree_node_job *job = context;
  const octree_sort_job *sort = job->sort;
  const uint64_t *index = sort->packed ? sort->keys : sort->keys + sort->N;
  const uint64_t mask = sort->packed ? (1ull << sort->index_bits) - 1 : UINT64_MAX;
  const int64_t end = min64(job->C, (chunk + 1) * OCTREE_CHUNK);
  int64_t b = scene_at(job->cell_offsets, job->B, chunk * OCTREE_CHUNK);
  for (int64_t c = chunk * OCTREE_CHUNK; c < end; c++) {
    while (job->cell_offsets[b + 1] <= c) b++;
    for (int64_t i = job->node_offsets[c]; i < job->node_offsets[c + 1]; i++) {
      const int64_t node = job->offsets[b] + (int64_t)(index[i] & mask);
      job->node_order[i] = node;
      job->node_cell[node] = c;
    }
  }
  return AST_OK;
}

static ast_status octree_build(const float *restrict positions, const int64_t *restrict offsets, int64_t B,
                               const double center[3], double half_width, int depth, int64_t *restrict keys,
                               int64_t *restrict cell_offsets, int64_t *restrict node_cell,
                               int64_t *restrict node_order, int64_t *restrict node_offsets, int64_t *bad_node) {
  AST_SCRATCH_SCOPE;
  const int64_t N = offsets[B];
  memset(cell_offsets, 0, sizeof *cell_offsets * (size_t)(B + 1));
  node_offsets[0] = 0;
  if (N == 0) return AST_OK;
  int64_t largest = 0;
  for (int64_t b = 0; b < B; b++) largest = max64(largest, offsets[b + 1] - offsets[b]);
  const int index_bits = num_bits((uint64_t)(largest - 1));
  const bool packed = 3 * depth + index_bits <= 64;
  const int64_t bytes = (packed ? 1 : 2) * N * (int64_t)sizeof(uint64_t);
  octree_sort_job sort = {offsets, N, index_bits, packed, ast_scratch(bytes), ast_scratch(bytes)};
  if (!sort.keys || !sort.other) return AST_NO_MEMORY;

  octree_key_job key = {positions, N, center, half_width, depth, sort.keys};
  ast_status status = ast_parallel(octree_chunks(N), octree_key_task, &key);
  if (status != AST_OK) {
    int64_t n = 0;
    while ((status = octree_check_node(&key, n)) == AST_OK && n + 1 < N) n++;
    *bad_node = n;
    return status == AST_OK ? AST_OUTSIDE : status; /* another thread has moved the node since */
  }
  status = ast_parallel(B, octree_sort_task, &sort);
  if (status == AST_OK)
    status = octree_runs(sort.keys, packed ? index_bits : 0, offsets, B, keys, node_offsets, cell_offsets);
  if (status != AST_OK) return status;
  octree_node_job node = {&sort, offsets, cell_offsets, node_offsets, B, cell_offsets[B], node_cell, node_order};
  return ast_parallel(octree_chunks(node.C), octree_node_task, &node);
}
