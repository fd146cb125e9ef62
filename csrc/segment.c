/* Sums and means over the rows of each segment, and the adjoint; the sum over all rows.
 *
 *   segment_sum: out_c = s_c sum_{j in segment c} x_{order(j)}       segment_spread: dx_{order(j)} = s_c dout_c
 *   column_sum:  out = sum_n x_n
 *
 * N rows n, C segments c, F channels; s_c is 1, or 1 over the rows of c. N F operations on 4 (N + C) F bytes: memory is
 * the limit. One chain of sums would collect rounding errors. So a segment is summed in the stored order by chains of
 * SEGMENT_CHAIN rows, whose sums are added by halves; the sum over all rows goes by chains of COLUMN_CHAIN likewise.
 * Chains are counted from the first row of a segment, so the result depends on neither threads nor batch.
 */
#include "ast.h"
#include "simd.h"

enum {
  SEGMENT_FLOATS = 1 << 15, /* floats of output a task: large enough to pay for the hand-over */
  SEGMENT_CHAIN = 256,      /* rows of one chain of a sum at most */
  SEGMENT_VECTORS = 8,      /* sums in registers */
  SEGMENT_AHEAD = 12        /* rows by which fetching runs ahead */
};

typedef struct {
  const float *x;
  int64_t F, C, rows, last; /* rows: segments a task; last: the last place in `order` */
  const int64_t *order, *offsets;
  bool mean;
  float *out;
} segment_job;

static segment_job segment_plan(const float *x, int64_t F, const int64_t *order, const int64_t *offsets, int64_t C,
                                bool mean, float *out) {
  return (segment_job){x, F, C, max64(1, SEGMENT_FLOATS / max64(1, F)), offsets[C] - 1, order, offsets, mean, out};
}

/* `vectors` vectors of one chain from channel f on: all of a row is read at once, and rows that come later are
 * fetched. */
AST_INLINE void segment_columns(const int vectors, const segment_job *job, int64_t begin, int64_t end, int64_t f,
                                float scale, float *out) {
  vf sum[SEGMENT_VECTORS];
  EACH(vectors, v) sum[v] = (vf){0};
  for (int64_t j = begin; j < end; j++) {
    const float *row = job->x + job->order[j] * job->F + f,
                *later = job->x + job->order[min64(j + SEGMENT_AHEAD, job->last)] * job->F + f;
    EACH(vectors, v) {
      if (v * VW % 16 == 0) __builtin_prefetch(later + v * VW);
      sum[v] += vload(row + v * VW);
    }
  }
  EACH(vectors, v) vstore(out + f + v * VW, sum[v] * scale);
}

/* out = scale times the sum of the rows begin..end, in one chain. */
AST_INLINE void segment_chain(const segment_job *job, int64_t begin, int64_t end, float scale, float *out) {
  const int64_t F = job->F;
  int64_t f = 0;
  for (; f + SEGMENT_VECTORS * VW <= F; f += SEGMENT_VECTORS * VW)
    segment_columns(SEGMENT_VECTORS, job, begin, end, f, scale, out);
  for (; f + 4 * VW <= F; f += 4 * VW) segment_columns(4, job, begin, end, f, scale, out);
  for (; f + VW <= F; f += VW) segment_columns(1, job, begin, end, f, scale, out);
  for (; f < F; f++) {
    float sum = 0;
    for (int64_t j = begin; j < end; j++) sum += job->x[job->order[j] * F + f];
    out[f] = sum * scale;
  }
}

/* out = the sum of the rows begin..end, chains of them added by halves. */
static ast_status segment_halves(const segment_job *job, int64_t begin, int64_t end, float *out) {
  if (end - begin <= SEGMENT_CHAIN) {
    segment_chain(job, begin, end, 1, out);
    return AST_OK;
  }
  AST_SCRATCH_SCOPE;
  float *other = ast_scratch(job->F * (int64_t)sizeof *other);
  if (!other) return AST_NO_MEMORY;
  const int64_t middle = half_of_chains(begin, end, SEGMENT_CHAIN);
  ast_status status = segment_halves(job, begin, middle, out);
  if (status == AST_OK) status = segment_halves(job, middle, end, other);
  for (int64_t f = 0; status == AST_OK && f < job->F; f++) out[f] += other[f];
  return status;
}

static ast_status segment_sum_task(int64_t index, void *context) {
  const segment_job *job = context;
  const int64_t F = job->F;
  for (int64_t c = index * job->rows; c < min64(job->C, (index + 1) * job->rows); c++) {
    const int64_t begin = job->offsets[c], end = job->offsets[c + 1];
    const float scale = job->mean && end > begin ? 1.0f / (float)(end - begin) : 1.0f;
    float *out = job->out + c * F;
    if (end - begin <= SEGMENT_CHAIN) {
      segment_chain(job, begin, end, scale, out);
      continue;
    }
    const ast_status status = segment_halves(job, begin, end, out);
    if (status != AST_OK) return status;
    for (int64_t f = 0; f < F; f++) out[f] *= scale;
  }
  return AST_OK;
}

static ast_status segment_spread_task(int64_t index, void *context) {
  const segment_job *job = context;
  const int64_t F = job->F;
  for (int64_t c = index * job->rows; c < min64(job->C, (index + 1) * job->rows); c++) {
    const int64_t begin = job->offsets[c], end = job->offsets[c + 1];
    const float scale = job->mean && end > begin ? 1.0f / (float)(end - begin) : 1.0f;
    for (int64_t j = begin; j < end; j++) {
      const float *in = job->x + c * F;
      float *out = job->out + job->order[j] * F;
      for (int64_t f = 0; f < F; f++) out[f] = in[f] * scale; /* forward: out += scale x */
    }
  }
  return AST_OK;
}

static ast_status segment_sum(const float *restrict x, int64_t F, const int64_t *restrict node_order,
                              const int64_t *restrict node_offsets, int64_t C, bool mean, float *restrict out) {
  segment_job job = segment_plan(x, F, node_order, node_offsets, C, mean, out);
  return ast_parallel(divide_up(C, job.rows), segment_sum_task, &job);
}

static ast_status segment_spread(const float *restrict dout, int64_t F, const int64_t *restrict node_order,
                                 const int64_t *restrict node_offsets, int64_t C, bool mean, float *restrict dx) {
  segment_job job = segment_plan(dout, F, node_order, node_offsets, C, mean, dx);
  return ast_parallel(divide_up(C, job.rows), segment_spread_task, &job);
}

/* ---- the sum over all rows ---- */

enum {
  COLUMN_CHAIN = 64, /* rows of one chain: of n equal rows it is off by up to n 2^-26 */
  COLUMN_CHAINS = 8  /* of a task */
};

typedef struct {
  const float *x;
  int64_t N, F, chains;
  float *sums; /* [chains, F] */
} column_job;

/* sum = the sum of some rows */
static void column_add_rows(const float *restrict x, int64_t rows, int64_t F, float *restrict sum) {
  for (int64_t f = 0; f < F; f++) sum[f] = 0;
  for (int64_t n = 0; n < rows; n++)
    for (int64_t f = 0; f < F; f++) sum[f] += x[n * F + f];
}

/* The sums of `num` chains or tasks that lie `apart` floats from each other, added by halves to the first. */
static void column_halves(float *sums, int64_t num, int64_t apart, int64_t F) {
  for (int64_t step = 1; step < num; step *= 2)
    for (int64_t i = 0; i + step < num; i += 2 * step)
      for (int64_t f = 0; f < F; f++) sums[i * apart + f] += sums[(i + step) * apart + f];
}

static ast_status column_sum_task(int64_t index, void *context) {
  const column_job *job = context;
  const int64_t F = job->F, begin = index * COLUMN_CHAINS, end = min64(job->chains, begin + COLUMN_CHAINS);
  for (int64_t i = begin; i < end; i++) {
    const int64_t first = i * COLUMN_CHAIN;
    column_add_rows(job->x + first * F, min64(COLUMN_CHAIN, job->N - first), F, job->sums + i * F);
  }
  column_halves(job->sums + begin * F, end - begin, F, F);
  return AST_OK;
}

static ast_status column_sum(const float *restrict x, int64_t N, int64_t F, float *restrict out) {
  AST_SCRATCH_SCOPE;
  const int64_t chains = max64(1, divide_up(N, COLUMN_CHAIN)), tasks = divide_up(chains, COLUMN_CHAINS);
  column_job job = {x, N, F, chains, ast_scratch(chains * F * (int64_t)sizeof *job.sums)};
  if (!job.sums) return AST_NO_MEMORY;
  const ast_status status = ast_parallel(tasks, column_sum_task, &job);
  if (status != AST_OK) return status;
  column_halves(job.sums, tasks, COLUMN_CHAINS * F, F);
  memcpy(out, job.sums, (size_t)F * sizeof *out);
  return AST_OK;
}
