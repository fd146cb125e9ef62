/* Sparse convolution over listed pairs of cells, and its weight gradient.
 *
 *   out_q = sum_k sum_{(p,q) in group k} x_p W_k        dW_k = sum_{(p,q) in group k} x_p^T dout_q
 *
 * Only pairs that exist are touched. Forward, a task owns a range of destinations: in each group its pairs are a contiguous
 * run, since destinations rise; it gathers their sources, multiplies them with the packed W_k and adds into its rows. Groups
 * follow in ascending order, so a row's sum depends on neither the ranges, the threads nor the other scenes. The gradient with
 * respect to x is the same kernel with the lists exchanged and W_k^T. A task of the weight gradient owns a block of rows of
 * one dW_k and takes the group's pairs in order.
 */
#include "ast.h"
#include "gemm.h"
#include "simd.h"

enum {
  OFFSETS = 27,
  PAIRS = 96,         /* pairs gathered at a time */
  LEAST_ROWS = 128,   /* destinations a task: fewer would read the weights too often, */
  MOST_ROWS = 1024,   /* more would not stay in the cache */
  CHANNEL_BLOCK = 64, /* rows of dW_k a task */
  AHEAD = 8           /* rows by which prefetching runs ahead */
};

/* to[i] = from[index[i]], `width` floats each, rows to_row apart */
static void gather_rows(const float *from, int64_t row, int64_t width, const int64_t *index, int64_t n, float *to, int64_t to_row) {
  for (int64_t i = 0; i < n; i++) {
    const float *next = from + index[min64(i + AHEAD, n - 1)] * row;
    for (int64_t c = 0; c < width; c += 16) __builtin_prefetch(next + c);
    memcpy(to + i * to_row, from + index[i] * row, (size_t)width * sizeof *to);
  }
}

/* the first i in [begin, end) with values[i] >= bound, or end */
static int64_t lower_bound(const int64_t *values, int64_t begin, int64_t end, int64_t bound) {
  while (begin < end) {
    const int64_t middle = begin + (end - begin) / 2;
    if (values[middle] < bound) begin = middle + 1;
    else end = middle;
  }
  return begin;
}

typedef struct {
  const float *x, *weight;
  float *packed; /* W_k in panels, [27] */
  int64_t C_in, C_out, num_out, rows;
  bool transposed;
  ast_pairs pairs;
  float *out;
} conv_job;

static ast_status pack_task(int64_t k, void *context) {
  const conv_job *job = context;
  const int64_t C_in = job->C_in, C_out = job->C_out;
  if (job->pairs.offsets[k] == job->pairs.offsets[k + 1]) return AST_OK;
  gemm_pack(job->weight + k * C_in * C_out, job->transposed ? 1 : C_out, job->transposed ? C_in : 1, C_in, C_out,
            job->packed + k * gemm_packed_size(C_in, C_out));
  return AST_OK;
}

static ast_status conv_task(int64_t index, void *context) {
  const conv_job *job = context;
  const ast_pairs *pairs = &job->pairs;
  const int64_t C_in = job->C_in, C_out = job->C_out, padded = round_up(C_out, VW);
  const int64_t first = index * job->rows, last = min64(job->num_out, first + job->rows);
  float *gathered = ast_scratch(5, PAIRS * (C_in + padded) * (int64_t)sizeof *gathered), *product = gathered + PAIRS * C_in;
  if (!gathered) return AST_NO_MEMORY;
  memset(job->out + first * C_out, 0, (size_t)((last - first) * C_out) * sizeof *job->out);
  for (int64_t k = 0; k < OFFSETS; k++) {
    const int64_t begin = lower_bound(pairs->destination, pairs->offsets[k], pairs->offsets[k + 1], first);
    const int64_t end = lower_bound(pairs->destination, begin, pairs->offsets[k + 1], last);
    const gemm_b weight = gemm_packed(job->packed + k * gemm_packed_size(C_in, C_out), C_in);
    for (int64_t i = begin; i < end; i += PAIRS) {
      const int64_t n = min64(PAIRS, end - i);
      gather_rows(job->x, C_in, C_in, pairs->source + i, n, gathered, C_in);
      gemm(n, padded, C_in, (gemm_a){gathered, C_in, 1}, weight, product, padded, false);
      for (int64_t j = 0; j < n; j++) {
        float *out = job->out + pairs->destination[i + j] * C_out;
        for (int64_t c = 0; c < C_out; c++) out[c] += product[j * padded + c];
      }
    }
  }
  return AST_OK;
}

static ast_status sparse_conv(const float *restrict x, const float *restrict weight, int64_t C_in, int64_t C_out, bool transposed,
                              ast_pairs pairs, int64_t num_out, float *restrict out) {
  float *packed = ast_scratch(6, OFFSETS * gemm_packed_size(C_in, C_out) * (int64_t)sizeof *packed);
  if (!packed) return AST_NO_MEMORY;
  const int64_t rows = min64(MOST_ROWS, max64(LEAST_ROWS, num_out / (4 * ast_threads())));
  conv_job job = {x, weight, packed, C_in, C_out, num_out, rows, transposed, pairs, out};
  const ast_status status = ast_parallel(OFFSETS, pack_task, &job);
  return status == AST_OK ? ast_parallel((num_out + rows - 1) / rows, conv_task, &job) : status;
}

/* ---- weight gradient ---- */

typedef struct {
  const float *x, *dout;
  int64_t C_in, C_out, blocks;
  ast_pairs pairs;
  float *dweight;
} conv_weight_job;

static ast_status conv_weight_task(int64_t index, void *context) {
  const conv_weight_job *job = context;
  const ast_pairs *pairs = &job->pairs;
  const int64_t k = index / job->blocks, first = index % job->blocks * CHANNEL_BLOCK, rows = min64(CHANNEL_BLOCK, job->C_in - first);
  const int64_t C_in = job->C_in, C_out = job->C_out, padded = round_up(C_out, VW);
  const int64_t row = padded + 16; /* seldom a power of two, which would crowd few cache sets */
  float *x = ast_scratch(5, (PAIRS * (CHANNEL_BLOCK + row) + CHANNEL_BLOCK * padded) * (int64_t)sizeof *x);
  if (!x) return AST_NO_MEMORY;
  float *dout = x + PAIRS * CHANNEL_BLOCK, *sum = dout + PAIRS * row;
  const int64_t begin = pairs->offsets[k], end = pairs->offsets[k + 1];
  if (padded > C_out) memset(dout, 0, (size_t)(PAIRS * row) * sizeof *dout);
  if (begin == end) memset(sum, 0, (size_t)(rows * padded) * sizeof *sum);
  for (int64_t i = begin; i < end; i += PAIRS) {
    const int64_t n = min64(PAIRS, end - i);
    gather_rows(job->x + first, C_in, rows, pairs->source + i, n, x, CHANNEL_BLOCK);
    gather_rows(job->dout, C_out, C_out, pairs->destination + i, n, dout, row);
    gemm(rows, padded, n, (gemm_a){x, 1, CHANNEL_BLOCK}, gemm_rows(dout, row), sum, padded, i > begin);
  }
  for (int64_t i = 0; i < rows; i++) memcpy(job->dweight + (k * C_in + first + i) * C_out, sum + i * padded, (size_t)C_out * sizeof *sum);
  return AST_OK;
}

static ast_status sparse_conv_weight(const float *restrict x, const float *restrict dout, int64_t C_in, int64_t C_out, ast_pairs pairs,
                                     float *restrict dweight) {
  conv_weight_job job = {x, dout, C_in, C_out, (C_in + CHANNEL_BLOCK - 1) / CHANNEL_BLOCK, pairs, dweight};
  return ast_parallel(OFFSETS * job.blocks, conv_weight_task, &job);
}
