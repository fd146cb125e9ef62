/* Sums and means over the rows of each segment, and the adjoint.
 *
 * out_c = sum_{j in segment c} x_{order(j)}, in the stored order, so the result depends on neither threads nor batch.
 */
#include "ast.h"
#include "simd.h"

enum { SEGMENT_FLOATS = 1 << 15 }; /* floats of output a task: large enough to pay for the hand-over */

typedef struct {
  const float *x;
  int64_t F, C, rows; /* rows: segments a task */
  const int64_t *order, *offsets;
  bool mean;
  float *out;
} segment_job;

static segment_job segment_plan(const float *x, int64_t F, const int64_t *order, const int64_t *offsets, int64_t C, bool mean, float *out) {
  return (segment_job){x, F, C, max64(1, SEGMENT_FLOATS / max64(1, F)), order, offsets, mean, out};
}

static ast_status segment_sum_task(int64_t index, void *context) {
  const segment_job *s = context;
  const int64_t F = s->F;
  for (int64_t c = index * s->rows; c < min64(s->C, (index + 1) * s->rows); c++) {
    const int64_t begin = s->offsets[c], end = s->offsets[c + 1];
    const float scale = s->mean && end > begin ? 1.0f / (float)(end - begin) : 1.0f;
    float *out = s->out + c * F;
    int64_t f = 0;
    for (; f + VW <= F; f += VW) {
      vf sum = {0};
      for (int64_t j = begin; j < end; j++) sum += vload(s->x + s->order[j] * F + f);
      vstore(out + f, sum * scale);
    }
    for (; f < F; f++) {
      float sum = 0;
      for (int64_t j = begin; j < end; j++) sum += s->x[s->order[j] * F + f];
      out[f] = sum * scale;
    }
  }
  return AST_OK;
}

static ast_status segment_spread_task(int64_t index, void *context) {
  const segment_job *s = context;
  const int64_t F = s->F;
  for (int64_t c = index * s->rows; c < min64(s->C, (index + 1) * s->rows); c++) {
    const int64_t begin = s->offsets[c], end = s->offsets[c + 1];
    const float scale = s->mean && end > begin ? 1.0f / (float)(end - begin) : 1.0f;
    for (int64_t j = begin; j < end; j++) {
      const float *in = s->x + c * F;
      float *out = s->out + s->order[j] * F;
      for (int64_t f = 0; f < F; f++) out[f] = in[f] * scale;
    }
  }
  return AST_OK;
}

static ast_status segment_sum(const float *restrict x, int64_t F, const int64_t *restrict node_order, const int64_t *restrict node_offsets,
                              int64_t C, bool mean, float *restrict out) {
  segment_job job = segment_plan(x, F, node_order, node_offsets, C, mean, out);
  return ast_parallel((C + job.rows - 1) / job.rows, segment_sum_task, &job);
}

static ast_status segment_spread(const float *restrict dout, int64_t F, const int64_t *restrict node_order,
                                 const int64_t *restrict node_offsets, int64_t C, bool mean, float *restrict dx) {
  segment_job job = segment_plan(dout, F, node_order, node_offsets, C, mean, dx);
  return ast_parallel((C + job.rows - 1) / job.rows, segment_spread_task, &job);
}
