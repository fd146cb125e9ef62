/* A dense layer with what follows it, and its gradients.
 *
 *   z = x W^T + bias,   out = act(z) + residual
 *   dz = act'(z) . dout,   dx = dz W,   dW = dz^T x,   dbias = the sum of the rows of dz
 *
 * with act(z) = z, max(0, z), or a . gelu(b) for z = [a, b] (Shazeer, GLU variants improve transformer, 2020), gelu(b) = b Phi(b).
 *
 * Forward, a task owns a block of rows and some panels of columns. The gradient of W is a sum over rows, cut by the shapes alone,
 * in one of two ways. By rows: a task owns a chunk of rows, and while a block of them lies in the cache takes dz, dx and its part
 * of dW from it; the parts are added in order. By tiles, where those parts would be larger than x and dz: first dz and dx by
 * blocks of rows, then dW by blocks of W, each over all rows.
 *
 * Cost: 2 M I O operations for z, for dx and for dW each. Memory: the packed weights, and either the parts or copies of x and dz.
 */
#include "ast.h"
#include "dense.h"
#include "gemm.h"
#include "simd.h"

/* ---- forward ---- */

typedef struct {
  const ast_linear *s;
  const float *x, *residual;
  float *out, *z;
  dense_layer layer;
  int64_t rows, panels; /* of a task */
  int64_t groups;       /* of panels */
} linear_job;

static dense_layer linear_layer(const ast_linear *s, const float *weight, const float *bias, bool paired) {
  return (dense_layer){
      .weight = weight, .row = 1, .column = s->I, .bias = bias, .K = s->I, .N = paired ? s->O / 2 : s->O, .paired = paired};
}

/* Enough tasks for some threads where there are few rows, whole rows where there are many. */
static void linear_cut(linear_job *job) {
  const int64_t M = job->s->M, panels = dense_panels(&job->layer);
  const bool small = (double)M * (double)job->s->I * (double)job->s->O < 3e5;
  job->rows = small ? M : M >= 64 * DENSE_ROWS ? 4 * DENSE_ROWS : M > DENSE_ROWS ? DENSE_ROWS : round_up((M + 1) / 2, GEMM_ROWS);
  job->rows = max64(1, job->rows);
  job->groups = small ? 1 : max64(1, min64(panels, 16 * job->rows / max64(1, M)));
  job->panels = (panels + job->groups - 1) / job->groups;
}

static ast_status linear_task(int64_t index, void *context) {
  const linear_job *job = context;
  const ast_linear *s = job->s;
  const int64_t first = index / job->groups * job->rows, last = min64(s->M, first + job->rows);
  const int64_t first_panel = index % job->groups * job->panels, last_panel = min64(dense_panels(&job->layer), first_panel + job->panels);
  const int64_t N = job->layer.N;
  for (int64_t i = first; i < last; i += DENSE_ROWS) {
    const dense_end end = {.activation = s->activation,
                           .out = job->out + i * N,
                           .out_row = N,
                           .residual = job->residual ? job->residual + i * s->residual_stride : NULL,
                           .residual_row = s->residual_stride,
                           .z = job->z ? job->z + i * s->O : NULL,
                           .next = {dense_rows_from(job->x, s->x_stride, s->I, i + DENSE_ROWS, s->M)}};
    dense_rows(&job->layer, first_panel, last_panel, min64(DENSE_ROWS, last - i), (gemm_a){job->x + i * s->x_stride, s->x_stride, 1}, end);
  }
  return AST_OK;
}

static ast_status linear(const ast_linear *s, const float *restrict x, const float *restrict weight, const float *restrict bias,
                         const float *restrict residual, float *restrict out, float *restrict z) {
  linear_job job = {.s = s, .x = x, .residual = residual, .out = out, .z = z};
  job.layer = linear_layer(s, weight, bias, s->activation == AST_GEGLU);
  const ast_status status = dense_pack(&job.layer, 1, 6);
  if (status != AST_OK) return status;
  linear_cut(&job);
  return ast_parallel((s->M + job.rows - 1) / job.rows * job.groups, linear_task, &job);
}

/* ---- backward ---- */

typedef struct {
  const ast_linear *s;
  const float *dout, *x, *z;
  float *dx, *dweight, *dbias;
  dense_layer layers[2];       /* that of z, if z is recomputed, and W^T, if dx is wanted */
  int64_t columns;             /* of dout */
  int64_t dz_row, x_row, size; /* floats of a row of the copies; of the partial sums of a chunk: dW, then dbias */
  dense_chunks chunks;
  float *partials;
  float *all_dz, *all_x; /* by tiles: copies of all rows */
} linear_backward_job;

/* dz from z, of rows of dout with their columns whole or half */
static void linear_activation(const ast_linear *s, int64_t rows, const float *z, int64_t z_row, const float *dout, float *dz,
                              int64_t dz_row) {
  const int64_t half = s->O / 2, N = s->activation == AST_GEGLU ? half : s->O;
  for (int64_t i = 0; i < rows; i++, z += z_row, dout += s->dout_stride, dz += dz_row)
    for (int64_t j = 0; j < N; j += VW) {
      const int64_t n = N - j;
      const vf y = vload_upto(dout + j, n), a = vload_upto(z + j, n);
      if (s->activation == AST_RELU) {
        vstore_upto(dz + j, (vf)((vi)y & ~(a <= 0)), n);
        continue;
      }
      const vf b = vload_upto(z + half + j, n), phi = vnormal(b);
      vstore_upto(dz + j, y * (b * phi), n);
      vstore_upto(dz + half + j, y * a * (b * vnormal_density(b) + phi), n);
    }
}

/* Rows from `first` on: dz and x as padded copies, dx, and the sum of dz added to dbias. */
static void linear_backward_rows(const linear_backward_job *job, int64_t first, int64_t rows, float *dz, float *x, float *dbias) {
  const ast_linear *s = job->s;
  const float *dout = job->dout + first * s->dout_stride, *x_rows = job->x + first * s->x_stride;
  if (s->activation == AST_IDENTITY) {
    dense_copy_rows(dout, s->dout_stride, rows, s->O, dz, job->dz_row);
  } else if (job->z) {
    linear_activation(s, rows, job->z + first * s->O, s->O, dout, dz, job->dz_row);
  } else {
    const dense_end end = {.out = dz, .out_row = job->dz_row};
    dense_rows(&job->layers[0], 0, dense_panels(&job->layers[0]), rows, (gemm_a){x_rows, s->x_stride, 1}, end);
    linear_activation(s, rows, dz, job->dz_row, dout, dz, job->dz_row);
  }
  if (job->dbias) dense_add_rows(dz, job->dz_row, rows, s->O, dbias);
  if (job->dweight) dense_copy_rows(x_rows, s->x_stride, rows, s->I, x, job->x_row);
  if (!job->dx) return;
  const dense_end end = {.out = job->dx + first * s->I,
                         .out_row = s->I,
                         .next = {dense_rows_from(job->dout, s->dout_stride, job->columns, first + rows, s->M),
                                  dense_rows_from(job->x, s->x_stride, s->I, first + rows, s->M)}};
  dense_rows(&job->layers[1], 0, dense_panels(&job->layers[1]), rows, (gemm_a){dz, job->dz_row, 1}, end);
}

/* By rows: a chunk, its part of dW and dbias. */
static ast_status linear_chunk_task(int64_t index, void *context) {
  const linear_backward_job *job = context;
  const ast_linear *s = job->s;
  const int64_t first = index * job->chunks.rows, last = min64(s->M, first + job->chunks.rows), width = round_up(s->I, VW);
  float *dz = ast_scratch(5, DENSE_ROWS * (job->dz_row + job->x_row) * (int64_t)sizeof *dz), *x = dz + DENSE_ROWS * job->dz_row;
  if (!dz) return AST_NO_MEMORY;
  float *dweight = job->partials + index * job->size, *dbias = dweight + s->O * width;
  memset(dbias, 0, (size_t)round_up(s->O, VW) * sizeof *dbias);
  if (first >= last) memset(dweight, 0, (size_t)(s->O * width) * sizeof *dweight);
  for (int64_t i = first; i < last; i += job->chunks.step) {
    const int64_t rows = min64(job->chunks.step, last - i);
    linear_backward_rows(job, i, rows, dz, x, dbias);
    if (job->dweight) gemm(s->O, width, rows, (gemm_a){dz, 1, job->dz_row}, gemm_rows(x, job->x_row), dweight, width, i > first);
  }
  return AST_OK;
}

static ast_status linear_by_rows(linear_backward_job *job) {
  const ast_linear *s = job->s;
  const int64_t width = round_up(s->I, VW);
  job->partials = ast_scratch(7, job->chunks.num * job->size * (int64_t)sizeof(float));
  if (!job->partials) return AST_NO_MEMORY;
  const ast_status status = ast_parallel(job->chunks.num, linear_chunk_task, job);
  if (status != AST_OK) return status;
  const dense_sum sums[2] = {{job->dweight, 0, s->O, s->I, width}, {job->dbias, s->O * width, 1, s->O, width}};
  return dense_add_partials((dense_sum_job){job->partials, job->size, job->chunks.num, sums, 2});
}

enum { LINEAR_TILE_ROWS = 48, LINEAR_TILE_COLUMNS = 8 * GEMM_COLUMNS, LINEAR_TILE_DEPTH = 256 };

static ast_status linear_block_task(int64_t index, void *context) {
  const linear_backward_job *job = context;
  const int64_t first = index * DENSE_ROWS, rows = min64(DENSE_ROWS, job->s->M - first), width = round_up(job->s->O, VW);
  float *dbias = job->partials + index * width;
  memset(dbias, 0, (size_t)width * sizeof *dbias);
  linear_backward_rows(job, first, rows, job->all_dz + first * job->dz_row, job->all_x + first * job->x_row, dbias);
  return AST_OK;
}

static ast_status linear_tile_task(int64_t index, void *context) {
  const linear_backward_job *job = context;
  const ast_linear *s = job->s;
  const int64_t across = (s->I + LINEAR_TILE_COLUMNS - 1) / LINEAR_TILE_COLUMNS;
  const int64_t o = index / across * LINEAR_TILE_ROWS, k = index % across * LINEAR_TILE_COLUMNS;
  const int64_t rows = min64(LINEAR_TILE_ROWS, s->O - o), columns = min64(LINEAR_TILE_COLUMNS, s->I - k), width = round_up(columns, VW);
  float *tile = ast_scratch(5, LINEAR_TILE_ROWS * LINEAR_TILE_COLUMNS * (int64_t)sizeof *tile);
  if (!tile) return AST_NO_MEMORY;
  for (int64_t i = 0; i < s->M; i += LINEAR_TILE_DEPTH)
    gemm(rows, width, min64(LINEAR_TILE_DEPTH, s->M - i), (gemm_a){job->all_dz + i * job->dz_row + o, 1, job->dz_row},
         gemm_rows(job->all_x + i * job->x_row + k, job->x_row), tile, width, i > 0);
  for (int64_t i = 0; i < rows; i++) memcpy(job->dweight + (o + i) * s->I + k, tile + i * width, (size_t)columns * sizeof *tile);
  return AST_OK;
}

static ast_status linear_by_tiles(linear_backward_job *job) {
  const ast_linear *s = job->s;
  const int64_t blocks = (s->M + DENSE_ROWS - 1) / DENSE_ROWS, width = round_up(s->O, VW);
  float *scratch = ast_scratch(7, (blocks * width + s->M * (job->dz_row + job->x_row)) * (int64_t)sizeof *scratch);
  if (!scratch) return AST_NO_MEMORY;
  job->partials = scratch;
  job->all_dz = scratch + blocks * width;
  job->all_x = job->all_dz + s->M * job->dz_row;
  ast_status status = ast_parallel(blocks, linear_block_task, job);
  const int64_t down = (s->O + LINEAR_TILE_ROWS - 1) / LINEAR_TILE_ROWS, across = (s->I + LINEAR_TILE_COLUMNS - 1) / LINEAR_TILE_COLUMNS;
  if (status == AST_OK && job->dweight) status = ast_parallel(down * across, linear_tile_task, job);
  const dense_sum sum = {job->dbias, 0, 1, s->O, width};
  return status == AST_OK && job->dbias ? dense_add_partials((dense_sum_job){scratch, width, blocks, &sum, 1}) : status;
}

static ast_status linear_backward(const ast_linear *s, const float *restrict dout, const float *restrict x, const float *restrict weight,
                                  const float *restrict bias, const float *restrict z, float *restrict dx, float *restrict dweight,
                                  float *restrict dbias) {
  const bool recompute = s->activation != AST_IDENTITY && !z;
  linear_backward_job job = {.s = s, .dout = dout, .x = x, .z = z, .dx = dx, .dweight = dweight, .dbias = dbias};
  job.layers[0] = linear_layer(s, recompute ? weight : NULL, bias, false);
  job.layers[1] = (dense_layer){.weight = dx ? weight : NULL, .row = s->I, .column = 1, .K = s->O, .N = s->I};
  const ast_status status = dense_pack(job.layers, 2, 6);
  if (status != AST_OK) return status;
  job.columns = s->activation == AST_GEGLU ? s->O / 2 : s->O;
  job.dz_row = round_up(s->O, VW) + DENSE_APART;
  job.x_row = round_up(s->I, VW) + DENSE_APART;
  job.size = s->O * round_up(s->I, VW) + round_up(s->O, VW);
  job.chunks = dense_cut(s->M, job.size);
  return s->M * (job.dz_row + job.x_row) < job.chunks.num * job.size && s->M > 0 ? linear_by_tiles(&job) : linear_by_rows(&job);
}
