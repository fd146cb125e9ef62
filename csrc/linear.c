/* A dense layer with what follows it, and its gradients.
 *
 *   z = x W^T + bias,   out = act(z) + residual
 *   dz = act'(z) . dout,   dx = dz W,   dW = dz^T x,   dbias = the sum of the rows of dz
 *
 * with act(z) = z, max(0, z), or a . gelu(b) for z = [a, b] (Shazeer, GLU variants improve transformer, 2020), gelu(b) = b Phi(b).
 *
 * Forward, a task owns a block of rows and some panels of columns. The gradient of W is a sum over rows, cut by the shapes alone,
 * in one of two ways. By rows: a task owns a chunk of rows, and while a block of them lies in the cache takes dz, dx and its part
 * of dW from it; the parts are added in order. By tiles, where those parts would be larger than x and dz: dz by blocks of rows,
 * unless it is dout itself, then side by side dW by tiles of W, each over all rows, and dx as a product like the forward one.
 *
 * Cost: 2 M I O operations for z, for dx and for dW each. Memory: the packed weights, and either the parts or, where they are not
 * dout and x themselves, dz and x.
 */
#include "ast.h"
#include "weight_panels.h"
#include "gemm.h"
#include "simd.h"

/* ---- a product of all rows ---- */

typedef struct {
  dense_layer layer;
  const float *a; /* [M,K], */
  int64_t a_row, M;
  dense_end end;          /* of all rows */
  int64_t blocks, groups; /* of rows and of panels: a task each pair */
} linear_product;

static bool linear_is_small(const ast_linear *s) { return (double)s->M * (double)s->I * (double)s->O < 3e5; }

/* Tasks of a layer that is too small to wake other threads run on this one. */
static ast_status linear_run(const ast_linear *s, int64_t tasks, ast_task task, void *job) {
  ast_status status = AST_OK;
  if (!linear_is_small(s)) return ast_parallel(tasks, task, job);
  for (int64_t i = 0; i < tasks && status == AST_OK; i++) status = task(i, job);
  return status;
}

/* The number of tasks: enough for some threads where there are few rows, whole rows where there are many. */
static int64_t linear_cut(linear_product *p, bool small) {
  const int64_t rows = p->M < 64 * DENSE_ROWS ? DENSE_ROWS : 4 * DENSE_ROWS, tiles = (p->M + GEMM_ROWS - 1) / GEMM_ROWS;
  p->blocks = small ? min64(1, tiles) : min64(tiles, round_up((p->M + rows - 1) / rows, 2));
  p->groups = small ? 1 : max64(1, min64(dense_panels(&p->layer), 24 / max64(1, p->blocks)));
  return p->blocks * p->groups;
}

static ast_status linear_product_task(int64_t index, void *context) {
  const linear_product *p = context;
  const dense_layer *l = &p->layer;
  const int64_t block = index / p->groups, first = dense_begin(p->M, p->blocks, block), last = dense_begin(p->M, p->blocks, block + 1);
  const int64_t group = index % p->groups, panels = dense_panels(l);
  for (int64_t i = first; i < last; i += DENSE_ROWS) {
    dense_end end = p->end;
    end.out += i * end.out_row;
    if (end.residual) end.residual += i * end.residual_row;
    if (end.z) end.z += i * (l->paired ? 2 * l->N : l->N);
    end.next[0] = dense_rows_from(p->a, p->a_row, l->K, i + DENSE_ROWS, p->M);
    dense_rows(l, panels * group / p->groups, panels * (group + 1) / p->groups, min64(DENSE_ROWS, last - i),
               (gemm_a){p->a + i * p->a_row, p->a_row, 1}, end);
  }
  return AST_OK;
}

/* ---- forward ---- */

static dense_layer linear_layer(const ast_linear *s, const float *weight, const float *bias, bool paired) {
  return (dense_layer){
      .weight = weight, .row = 1, .column = s->I, .bias = bias, .K = s->I, .N = paired ? s->O / 2 : s->O, .paired = paired};
}

static ast_status linear(const ast_linear *s, const float *restrict x, const float *restrict weight, const float *restrict bias,
                         const float *restrict residual, float *restrict out, float *restrict z) {
  linear_product p = {.layer = linear_layer(s, weight, bias, s->activation == AST_GEGLU), .a = x, .a_row = s->x_stride, .M = s->M};
  p.end = (dense_end){
      .activation = s->activation, .out = out, .out_row = p.layer.N, .residual = residual, .residual_row = s->residual_stride, .z = z};
  const ast_status status = dense_pack(&p.layer, 1, 6);
  return status == AST_OK ? linear_run(s, linear_cut(&p, linear_is_small(s)), linear_product_task, &p) : status;
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
  float *all_dz, *all_x; /* by tiles: dz of all rows if it is not dout, and x if its rows do not end with a vector */
  gemm_a tiles_dz, tiles_x;
  int64_t tiles, across; /* all tiles; tiles beside each other */
  linear_product product;
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
      const vf b = vload_upto(z + half + j, n), gauss = vgauss(b), phi = vnormal(b, gauss);
      vstore_upto(dz + j, y * (b * phi), n);
      vstore_upto(dz + half + j, y * a * (b * vnormal_density(gauss) + phi), n);
    }
}

/* dz of the rows from `first` on */
static void linear_dz(const linear_backward_job *job, int64_t first, int64_t rows, float *dz) {
  const ast_linear *s = job->s;
  const float *dout = job->dout + first * s->dout_stride, *x = job->x + first * s->x_stride;
  if (s->activation == AST_IDENTITY) {
    dense_copy_rows(dout, s->dout_stride, rows, s->O, dz, job->dz_row);
  } else if (job->z) {
    linear_activation(s, rows, job->z + first * s->O, s->O, dout, dz, job->dz_row);
  } else {
    const dense_end end = {.out = dz, .out_row = job->dz_row};
    dense_rows(&job->layers[0], 0, dense_panels(&job->layers[0]), rows, (gemm_a){x, s->x_stride, 1}, end);
    linear_activation(s, rows, dz, job->dz_row, dout, dz, job->dz_row);
  }
}

/* Rows from `first` on: dz and x as padded copies, dx, and the sum of dz added to dbias. */
static void linear_backward_rows(const linear_backward_job *job, int64_t first, int64_t rows, float *dz, float *x, float *dbias) {
  const ast_linear *s = job->s;
  linear_dz(job, first, rows, dz);
  if (job->dbias) dense_add_rows(dz, job->dz_row, rows, s->O, dbias);
  if (job->dweight) dense_copy_rows(job->x + first * s->x_stride, s->x_stride, rows, s->I, x, job->x_row);
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
  const ast_linear *s = job->s;
  const int64_t first = index * DENSE_ROWS, rows = min64(DENSE_ROWS, s->M - first);
  if (job->all_dz) linear_dz(job, first, rows, job->all_dz + first * job->dz_row);
  if (job->all_x) dense_copy_rows(job->x + first * s->x_stride, s->x_stride, rows, s->I, job->all_x + first * job->x_row, job->x_row);
  return AST_OK;
}

/* A tile of dW, beside the first ones their part of dbias, or a part of dx. */
static ast_status linear_tile_task(int64_t index, void *context) {
  linear_backward_job *job = context;
  const ast_linear *s = job->s;
  if (index >= job->tiles) return linear_product_task(index - job->tiles, &job->product);
  const int64_t o = index / job->across * LINEAR_TILE_ROWS, k = index % job->across * LINEAR_TILE_COLUMNS;
  const int64_t rows = min64(LINEAR_TILE_ROWS, s->O - o), columns = min64(LINEAR_TILE_COLUMNS, s->I - k), width = round_up(columns, VW);
  const gemm_a dz = job->tiles_dz, x = job->tiles_x;
  float *tile = ast_scratch(5, LINEAR_TILE_ROWS * LINEAR_TILE_COLUMNS * (int64_t)sizeof *tile);
  if (!tile) return AST_NO_MEMORY;
  if (job->dweight) {
    float *to = width == columns ? job->dweight + o * s->I + k : tile;
    const int64_t to_row = width == columns ? s->I : width;
    for (int64_t i = 0; i < s->M; i += LINEAR_TILE_DEPTH)
      gemm(rows, width, min64(LINEAR_TILE_DEPTH, s->M - i), (gemm_a){dz.data + i * dz.row + o, 1, dz.row},
           gemm_rows(x.data + i * x.row + k, x.row), to, to_row, i > 0);
    for (int64_t i = 0; to == tile && i < rows; i++)
      memcpy(job->dweight + (o + i) * s->I + k, tile + i * width, (size_t)columns * sizeof *tile);
  }
  if (job->dbias && k == 0) {
    float *sums = tile;
    memset(sums, 0, (size_t)round_up(rows, VW) * sizeof *sums);
    for (int64_t i = 0; i < s->M; i += DENSE_ROWS)
      dense_add_rows(dz.data + i * dz.row + o, dz.row, min64(DENSE_ROWS, s->M - i), rows, sums);
    memcpy(job->dbias + o, sums, (size_t)rows * sizeof *sums);
  }
  return AST_OK;
}

static ast_status linear_by_tiles(linear_backward_job *job) {
  const ast_linear *s = job->s;
  const bool new_dz = s->activation != AST_IDENTITY || s->O % VW, new_x = s->I % VW;
  job->tiles_dz = (gemm_a){job->dout, s->dout_stride, 1};
  job->tiles_x = (gemm_a){job->x, s->x_stride, 1};
  if (new_dz || new_x) {
    float *scratch = ast_scratch(7, s->M * (job->dz_row + job->x_row) * (int64_t)sizeof *scratch);
    if (!scratch) return AST_NO_MEMORY;
    if (new_dz) job->all_dz = scratch, job->tiles_dz = (gemm_a){scratch, job->dz_row, 1};
    scratch += s->M * job->dz_row;
    if (new_x) job->all_x = scratch, job->tiles_x = (gemm_a){scratch, job->x_row, 1};
    const ast_status status = linear_run(s, (s->M + DENSE_ROWS - 1) / DENSE_ROWS, linear_block_task, job);
    if (status != AST_OK) return status;
  }
  job->across = (s->I + LINEAR_TILE_COLUMNS - 1) / LINEAR_TILE_COLUMNS;
  if (job->dweight || job->dbias) job->tiles = (s->O + LINEAR_TILE_ROWS - 1) / LINEAR_TILE_ROWS * job->across;
  job->product = (linear_product){.layer = job->layers[1], .a = job->tiles_dz.data, .a_row = job->tiles_dz.row, .M = s->M};
  job->product.end = (dense_end){.out = job->dx, .out_row = s->I};
  return linear_run(s, job->tiles + (job->dx ? linear_cut(&job->product, linear_is_small(s)) : 0), linear_tile_task, job);
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
