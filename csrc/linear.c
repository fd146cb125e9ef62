/* A dense layer with what follows it, and its gradients.
 *
 *   z = x W^T + bias,   out = act(z) + residual
 *   dz = act'(z) . dout,   dx = dz W,   dW = dz^T x,   dbias = the sum of the rows of dz
 *
 * with act(z) = z, max(0, z), or a . gelu(b) for z = [a, b] (Shazeer, GLU variants improve transformer, 2020), where
 * gelu(b) = b Phi(b).
 *
 * Forward, a task owns a block of rows and some panels of columns. The gradient of W is a sum over rows, cut by the
 * shapes alone, in one of two ways. By rows: a task owns a chunk of rows, and while a block of them lies in the cache
 * takes dz, dx and its part of dW from it; the parts are added in a fixed order. By tiles, where the parts would be
 * larger than x and dz: dz by blocks of rows, unless it is dout itself, then side by side dW by tiles of W, each over
 * all rows, and dx as a product like the forward one.
 *
 * Cost: 2 M I O operations for z, for dx and for dW each. Memory: the packed weights, and either the parts or, where
 * they are not dout and x themselves, dz and x.
 */
#include "weight_panels.h"

/* ---- a product of all rows ---- */

typedef struct {
  dense_layer layer;
  const float *a; /* [M,K], */
  int64_t a_row, M;
  dense_end end;          /* of all rows */
  int64_t blocks, groups; /* of rows and of panels: a task each pair */
} linear_product;

static bool linear_is_small(const ast_linear *sizes) {
  return (double)sizes->M * (double)sizes->I * (double)sizes->O < 3e5;
}

/* Tasks of a layer that is too small to wake other threads run on this one. */
static ast_status linear_run(const ast_linear *sizes, int64_t tasks, ast_task task, void *job) {
  ast_status status = AST_OK;
  if (!linear_is_small(sizes)) return ast_parallel(tasks, task, job);
  for (int64_t i = 0; i < tasks && status == AST_OK; i++) {
    AST_SCRATCH_SCOPE;
    status = task(i, job);
  }
  return status;
}

/* The number of tasks: enough for some threads where there are few rows, whole rows where there are many. */
static int64_t linear_cut(linear_product *p, bool small) {
  const int64_t rows = p->M < 64 * DENSE_ROWS ? DENSE_ROWS : 4 * DENSE_ROWS, tiles = divide_up(p->M, GEMM_ROWS);
  p->blocks = small ? min64(1, tiles) : min64(tiles, round_up(divide_up(p->M, rows), 2));
  p->groups = small ? 1 : max64(1, min64(dense_panels(&p->layer), 24 / max64(1, p->blocks)));
  return p->blocks * p->groups;
}

static ast_status linear_product_task(int64_t index, void *context) {
  const linear_product *p = context;
  const dense_layer *l = &p->layer;
  const int64_t block = index / p->groups, first = dense_begin(p->M, p->blocks, block),
                last = dense_begin(p->M, p->blocks, block + 1);
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

static dense_layer linear_layer(const ast_linear *sizes, const float *weight, const float *bias, bool paired) {
  dense_layer layer = dense_forward(weight, bias, sizes->I, paired ? sizes->O / 2 : sizes->O);
  layer.column = sizes->weight_stride;
  layer.paired = paired;
  return layer;
}

static ast_status linear(const ast_linear *sizes, const float *restrict x, const float *restrict weight,
                         const float *restrict bias, const float *restrict residual, float *restrict out,
                         float *restrict z) {
  AST_SCRATCH_SCOPE;
  linear_product p = {.layer = linear_layer(sizes, weight, bias, sizes->activation == AST_GEGLU),
                      .a = x,
                      .a_row = sizes->x_stride,
                      .M = sizes->M};
  p.end = (dense_end){.activation = sizes->activation,
                      .out = out,
                      .out_row = p.layer.N,
                      .residual = residual,
                      .residual_row = sizes->residual_stride,
                      .z = z};
  const ast_status status = dense_pack(&p.layer, 1);
  return status == AST_OK ? linear_run(sizes, linear_cut(&p, linear_is_small(sizes)), linear_product_task, &p) : status;
}

/* ---- backward ---- */

typedef struct {
  const ast_linear *sizes;
  const float *dout, *x, *z;
  float *dx, *dweight, *dbias;
  dense_layer layers[2]; /* of z, if z is recomputed, and with W^T, if dx is wanted */
  int64_t columns;       /* of dout */
  int64_t dz_row, x_row; /* floats of a row of the copies */
  dense_chunks chunks;
  dense_partials partials; /* dW and dbias */
  float *all_dz, *all_x;   /* by tiles: dz of all rows if it is not dout, and x if its rows do not end with a vector */
  gemm_a tiles_dz, tiles_x;
  int64_t tiles, across; /* all tiles; tiles beside each other */
  linear_product product;
} linear_backward_job;

/* dz from z, of rows of dout with their columns whole or half */
static void linear_activation(const ast_linear *sizes, int64_t rows, const float *z, int64_t z_row, const float *dout,
                              float *dz, int64_t dz_row) {
  const int64_t half = sizes->O / 2, N = sizes->activation == AST_GEGLU ? half : sizes->O;
  for (int64_t i = 0; i < rows; i++, z += z_row, dout += sizes->dout_stride, dz += dz_row)
    for (int64_t j = 0; j < N; j += VW) {
      const int64_t n = N - j;
      const vf y = vload_upto(dout + j, n), a = vload_upto(z + j, n);
      /* forward: max(0, z), or a b Phi(b) for z = [a, b] */
      if (sizes->activation == AST_RELU) {
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
  const ast_linear *sizes = job->sizes;
  const float *dout = job->dout + first * sizes->dout_stride, *x = job->x + first * sizes->x_stride;
  if (sizes->activation == AST_IDENTITY) {
    dense_copy_rows(dout, sizes->dout_stride, rows, sizes->O, dz, job->dz_row);
  } else if (job->z) {
    linear_activation(sizes, rows, job->z + first * sizes->O, sizes->O, dout, dz, job->dz_row);
  } else {
    const dense_end end = {.out = dz, .out_row = job->dz_row};
    dense_all(&job->layers[0], rows, (gemm_a){x, sizes->x_stride, 1}, end);
    linear_activation(sizes, rows, dz, job->dz_row, dout, dz, job->dz_row);
  }
}

/* Rows from `first` on: dz and x as padded copies, dx, and the sum of dz added to dbias. */
static void linear_backward_rows(const linear_backward_job *job, int64_t first, int64_t rows, float *dz, float *x,
                                 float *dbias) {
  const ast_linear *sizes = job->sizes;
  linear_dz(job, first, rows, dz);
  /* forward: z = x W^T + bias, so dbias = dz, dx = dz W and dW = dz^T x */
  if (job->dbias) dense_add_rows(dz, job->dz_row, rows, sizes->O, dbias);
  if (job->dweight) dense_copy_rows(job->x + first * sizes->x_stride, sizes->x_stride, rows, sizes->I, x, job->x_row);
  if (!job->dx) return;
  const dense_end end = {.out = job->dx + first * sizes->I,
                         .out_row = sizes->I,
                         .next = {dense_rows_from(job->dout, sizes->dout_stride, job->columns, first + rows, sizes->M),
                                  dense_rows_from(job->x, sizes->x_stride, sizes->I, first + rows, sizes->M)}};
  dense_all(&job->layers[1], rows, (gemm_a){dz, job->dz_row, 1}, end);
}

/* By rows: a chunk, its part of dW and dbias. */
static ast_status linear_chunk_task(int64_t index, void *context) {
  const linear_backward_job *job = context;
  const ast_linear *sizes = job->sizes;
  const dense_sum *sums = job->partials.sums;
  const int64_t first = index * job->chunks.rows, last = min64(sizes->M, first + job->chunks.rows);
  float *dz = ast_scratch(DENSE_ROWS * (job->dz_row + job->x_row) * (int64_t)sizeof *dz);
  if (!dz) return AST_NO_MEMORY;
  float *x = dz + DENSE_ROWS * job->dz_row;
  float *partials = dense_start_chunk(&job->partials, index, first >= last);
  for (int64_t i = first, block = 0; i < last; i += job->chunks.step, block++) {
    const int64_t rows = min64(job->chunks.step, last - i);
    const bool add = dense_begin_block(&job->partials, block, partials);
    linear_backward_rows(job, i, rows, dz, x, partials + sums[1].at);
    if (job->dweight)
      gemm(sizes->O, sums[0].row, rows, dz, job->dz_row, x, job->x_row, partials + sums[0].at, sums[0].row, add);
  }
  return AST_OK;
}

static ast_status linear_by_rows(linear_backward_job *job) {
  if (!dense_new_partials(&job->partials, job->chunks.num, dense_blocks(job->chunks))) return AST_NO_MEMORY;
  const ast_status status = ast_parallel(job->chunks.num, linear_chunk_task, job);
  return status == AST_OK ? dense_add_partials(&job->partials) : status;
}

enum { LINEAR_TILE_ROWS = 48, LINEAR_TILE_COLUMNS = 8 * GEMM_COLUMNS, LINEAR_TILE_DEPTH = 256 };

static ast_status linear_block_task(int64_t index, void *context) {
  const linear_backward_job *job = context;
  const ast_linear *sizes = job->sizes;
  const int64_t first = index * DENSE_ROWS, rows = min64(DENSE_ROWS, sizes->M - first);
  if (job->all_dz) linear_dz(job, first, rows, job->all_dz + first * job->dz_row);
  if (job->all_x)
    dense_copy_rows(job->x + first * sizes->x_stride, sizes->x_stride, rows, sizes->I, job->all_x + first * job->x_row,
                    job->x_row);
  return AST_OK;
}

/* A tile of dW, beside the first ones their part of dbias, or a part of dx. */
static ast_status linear_tile_task(int64_t index, void *context) {
  linear_backward_job *job = context;
  const ast_linear *sizes = job->sizes;
  if (index >= job->tiles) return linear_product_task(index - job->tiles, &job->product);
  const int64_t o = index / job->across * LINEAR_TILE_ROWS, k = index % job->across * LINEAR_TILE_COLUMNS;
  const int64_t rows = min64(LINEAR_TILE_ROWS, sizes->O - o), columns = min64(LINEAR_TILE_COLUMNS, sizes->I - k),
                width = round_up(columns, VW);
  const gemm_a dz = job->tiles_dz, x = job->tiles_x;
  float *tile = ast_scratch(LINEAR_TILE_ROWS * LINEAR_TILE_COLUMNS * (int64_t)sizeof *tile);
  if (!tile) return AST_NO_MEMORY;
  if (job->dweight) {
    float *to = width == columns ? job->dweight + o * sizes->I + k : tile;
    const int64_t to_row = width == columns ? sizes->I : width;
    for (int64_t i = 0; i < sizes->M; i += LINEAR_TILE_DEPTH)
      gemm(rows, width, min64(LINEAR_TILE_DEPTH, sizes->M - i), dz.data + i * dz.row + o, dz.row,
           x.data + i * x.row + k, x.row, to, to_row, i > 0);
    for (int64_t i = 0; to == tile && i < rows; i++)
      memcpy(job->dweight + (o + i) * sizes->I + k, tile + i * width, (size_t)columns * sizeof *tile);
  }
  if (job->dbias && k == 0) {
    float *sums = tile, *chain = tile + round_up(rows, VW);
    memset(sums, 0, (size_t)round_up(rows, VW) * sizeof *sums);
    for (int64_t i = 0; i < sizes->M;) {
      memset(chain, 0, (size_t)round_up(rows, VW) * sizeof *chain);
      for (const int64_t end = min64(sizes->M, i + DENSE_CHAIN * DENSE_ROWS); i < end; i += DENSE_ROWS)
        dense_add_rows(dz.data + i * dz.row + o, dz.row, min64(DENSE_ROWS, end - i), rows, chain);
      dense_add_rows(chain, 0, 1, rows, sums);
    }
    memcpy(job->dbias + o, sums, (size_t)rows * sizeof *sums);
  }
  return AST_OK;
}

static ast_status linear_by_tiles(linear_backward_job *job) {
  const ast_linear *sizes = job->sizes;
  const bool new_dz = sizes->activation != AST_IDENTITY || sizes->O % VW, new_x = sizes->I % VW;
  job->tiles_dz = (gemm_a){job->dout, sizes->dout_stride, 1};
  job->tiles_x = (gemm_a){job->x, sizes->x_stride, 1};
  if (new_dz || new_x) {
    float *scratch = ast_scratch(sizes->M * (job->dz_row + job->x_row) * (int64_t)sizeof *scratch);
    if (!scratch) return AST_NO_MEMORY;
    if (new_dz) job->all_dz = scratch, job->tiles_dz = (gemm_a){scratch, job->dz_row, 1};
    scratch += sizes->M * job->dz_row;
    if (new_x) job->all_x = scratch, job->tiles_x = (gemm_a){scratch, job->x_row, 1};
    const ast_status status = linear_run(sizes, divide_up(sizes->M, DENSE_ROWS), linear_block_task, job);
    if (status != AST_OK) return status;
  }
  job->across = divide_up(sizes->I, LINEAR_TILE_COLUMNS);
  if (job->dweight || job->dbias) job->tiles = divide_up(sizes->O, LINEAR_TILE_ROWS) * job->across;
  job->product =
      (linear_product){.layer = job->layers[1], .a = job->tiles_dz.data, .a_row = job->tiles_dz.row, .M = sizes->M};
  job->product.end = (dense_end){.out = job->dx, .out_row = sizes->I};
  return linear_run(sizes, job->tiles + (job->dx ? linear_cut(&job->product, linear_is_small(sizes)) : 0),
                    linear_tile_task, job);
}

static ast_status linear_backward(const ast_linear *sizes, const float *restrict dout, const float *restrict x,
                                  const float *restrict weight, const float *restrict bias, const float *restrict z,
                                  float *restrict dx, float *restrict dweight, float *restrict dbias) {
  AST_SCRATCH_SCOPE;
  const bool recompute = sizes->activation != AST_IDENTITY && !z;
  linear_backward_job job = {
      .sizes = sizes, .dout = dout, .x = x, .z = z, .dx = dx, .dweight = dweight, .dbias = dbias};
  job.layers[0] = linear_layer(sizes, recompute ? weight : NULL, bias, false);
  job.layers[1] = dense_backward(dx ? weight : NULL, sizes->weight_stride, sizes->O, sizes->I);
  const ast_status status = dense_pack(job.layers, 2);
  if (status != AST_OK) return status;
  job.columns = sizes->activation == AST_GEGLU ? sizes->O / 2 : sizes->O;
  job.dz_row = round_up(sizes->O, VW) + DENSE_APART;
  job.x_row = round_up(sizes->I, VW) + DENSE_APART;
  dense_sum sums[] = {{.to = dweight, .rows = sizes->O, .n = sizes->I}, {.to = dbias, .rows = 1, .n = sizes->O}};
  job.partials = dense_place_sums(sums, 2);
  job.chunks = dense_cut(sizes->M, job.partials.size);
  return sizes->M * (job.dz_row + job.x_row) < job.chunks.num * job.partials.size && sizes->M > 0
             ? linear_by_tiles(&job)
             : linear_by_rows(&job);
}
