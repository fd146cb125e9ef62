/* The weight gradient of the sparse convolution.
 *
 *   dW_k = sum_{(p,q) in group k} x_p^T dout_q
 *
 * k < 27 kernel offsets, p source and q destination cells, P pairs, I = C_in and O = C_out channels. 2 P I O operations
 * on 4 P (I + O) bytes, O again for each further CHANNEL_BLOCK of I.
 *
 * A group is cut evenly into parts by its size alone. A task owns a part, and a block of rows of its dW_k: it adds tile
 * after tile of pairs to sums that stay in the cache, while the rows of the next tile are fetched. The parts of a group
 * are then added in order: the bits depend on the pairs, not on the threads.
 */
#include "ast.h"
#include "row_tile.h"

enum {
  WEIGHT_TILE = 96,   /* pairs at a time: their rows stay in L2 while the panels and strips of dW_k pass over them */
  PART_PAIRS = 4096,  /* pairs of a part at least: fewer would not pay for its sums */
  MOST_PARTS = 64,    /* parts in all, about: what their sums take is bounded */
  CHANNEL_BLOCK = 128 /* rows of dW_k a task */
};

typedef struct {
  const float *x, *dout;
  int64_t C_in, C_out, blocks;
  int64_t first_part[OFFSETS + 1]; /* of each group, in the list of all parts */
  ast_pairs pairs;
  float *parts; /* [parts - groups, C_in, C_out]: sums of all parts but the first of each group */
  float *dweight;
} conv_weight_job;

/* Rows of a tile, x from the first channel of the block on. */
typedef struct {
  const float *x[WEIGHT_TILE], *dout[WEIGHT_TILE];
  int64_t n;
} conv_weight_tile;

static void conv_weight_point(const conv_weight_job *job, int64_t block, int64_t first, int64_t end,
                              conv_weight_tile *tile) {
  tile->n = max64(0, min64(WEIGHT_TILE, end - first));
  for (int64_t i = 0; i < tile->n; i++) {
    tile->x[i] = job->x + job->pairs.source[first + i] * job->C_in + block;
    tile->dout[i] = job->dout + job->pairs.destination[first + i] * job->C_out;
  }
}

/* sum [rows,C_out] (+)= x^T dout over the pairs of a tile. */
static void conv_weight_add_tile(const conv_weight_tile *tile, const conv_weight_tile *next, int64_t rows,
                                 int64_t C_out, bool add, float *sum) {
  const int64_t strips = row_strips(rows), x_lines = divide_up(rows, LINE), lines = x_lines + divide_up(C_out, LINE);
  float tail[WEIGHT_TILE][GEMM_COLUMNS];
  const float *tail_rows[WEIGHT_TILE];
  for (int64_t c = 0, line = 0; c < C_out; c += GEMM_COLUMNS) {
    const int64_t width = min64(GEMM_COLUMNS, C_out - c);
    column_pointers p = {.a = tile->x, .b = tile->dout, .b_column = c};
    for (int64_t i = 0; width % VW && i < tile->n; i++) { /* rows that end within a vector */
      memset(tail[i], 0, sizeof tail[i]);
      memcpy(tail[i], tile->dout[i] + c, (size_t)width * sizeof(float));
      tail_rows[i] = tail[i];
    }
    if (width % VW) p.b = tail_rows, p.b_column = 0;
    for (int64_t strip = 0; strip < strips; strip++, line++) {
      p.a_column = rows * strip / strips;
      p.next = next->n < tile->n || line >= lines ? p.b : line < x_lines ? next->x : next->dout;
      p.next_column = p.next == p.b ? p.b_column : LINE * (line < x_lines ? line : line - x_lines);
      float *out = sum + p.a_column * C_out + c;
      column_panel(rows * (strip + 1) / strips - p.a_column, width, tile->n, p, add ? out : NULL, out, C_out);
    }
  }
}

static ast_status conv_weight_task(int64_t index, void *context) {
  const conv_weight_job *job = context;
  const int64_t C_in = job->C_in, C_out = job->C_out, number = index / job->blocks;
  const int64_t block = index % job->blocks * CHANNEL_BLOCK, rows = min64(CHANNEL_BLOCK, C_in - block);
  int64_t k = 0;
  while (job->first_part[k + 1] <= number) k++;
  const int64_t part = number - job->first_part[k], parts = job->first_part[k + 1] - job->first_part[k];
  const int64_t first = job->pairs.offsets[k], size = job->pairs.offsets[k + 1] - first;
  const int64_t begin = first + size * part / parts, end = first + size * (part + 1) / parts;
  float *sum = (part ? job->parts + (number - k - 1) * C_in * C_out : job->dweight + k * C_in * C_out) + block * C_out;
  if (begin == end) memset(sum, 0, (size_t)(rows * C_out) * sizeof *sum);
  conv_weight_tile tiles[2];
  conv_weight_point(job, block, begin, end, &tiles[0]);
  int t = 0;
  for (int64_t i = begin; i < end; i += WEIGHT_TILE, t = !t) {
    conv_weight_point(job, block, i + WEIGHT_TILE, end, &tiles[!t]);
    conv_weight_add_tile(&tiles[t], &tiles[!t], rows, C_out, i > begin, sum);
  }
  return AST_OK;
}

/* Adds the parts of a group to its first, in order; a task has CHANNEL_BLOCK rows of one dW_k. */
static ast_status conv_weight_join_task(int64_t index, void *context) {
  const conv_weight_job *job = context;
  const int64_t k = index / job->blocks, block = index % job->blocks * CHANNEL_BLOCK;
  const int64_t n = min64(CHANNEL_BLOCK, job->C_in - block) * job->C_out, size = job->C_in * job->C_out;
  float *restrict sum = job->dweight + k * size + block * job->C_out;
  for (int64_t number = job->first_part[k] + 1; number < job->first_part[k + 1]; number++) {
    const float *restrict part = job->parts + (number - k - 1) * size + block * job->C_out;
    for (int64_t i = 0; i < n; i++) sum[i] += part[i];
  }
  return AST_OK;
}

static ast_status sparse_conv_weight(const float *restrict x, const float *restrict dout, int64_t C_in, int64_t C_out,
                                     ast_pairs pairs, float *restrict dweight) {
  AST_SCRATCH_SCOPE;
  if (C_in == 0 || C_out == 0) return AST_OK;
  conv_weight_job job = {.x = x, .dout = dout, .C_in = C_in, .C_out = C_out, .pairs = pairs, .dweight = dweight};
  job.blocks = divide_up(C_in, CHANNEL_BLOCK);
  const int64_t part_pairs = max64(PART_PAIRS, pairs.offsets[OFFSETS] / MOST_PARTS);
  for (int64_t k = 0; k < OFFSETS; k++)
    job.first_part[k + 1] = job.first_part[k] + max64(1, (pairs.offsets[k + 1] - pairs.offsets[k]) / part_pairs);
  const int64_t parts = job.first_part[OFFSETS];
  job.parts = ast_scratch((parts - OFFSETS) * C_in * C_out * (int64_t)sizeof *job.parts);
  if (!job.parts) return AST_NO_MEMORY;
  const ast_status status = ast_parallel(parts * job.blocks, conv_weight_task, &job);
  return status == AST_OK && parts > OFFSETS ? ast_parallel(OFFSETS * job.blocks, conv_weight_join_task, &job) : status;
}
