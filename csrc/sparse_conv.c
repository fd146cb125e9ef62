/* Sparse convolution over listed pairs of cells.
 *
 *   out_q = bias + sum_k sum_{(p,q) in group k} x_p W_k
 *
 * k < 27 kernel offsets, p source and q destination cells, P pairs, I = C_in and O = C_out channels. 2 P I O operations
 * on at most 4 P (I + 2 O) bytes: arithmetic is the limit if rows come in time. Only pairs that exist are touched; a
 * row without pairs is the bias.
 *
 * W_k is packed into panels once a call. A task owns a range of destinations (and, where there are few, some of the
 * columns). In each group its pairs are a contiguous run, since destinations rise. It takes them tile by tile: rows of
 * x are multiplied where they lie, and the products added to the rows of out, or to the bias at a row's first
 * contribution, while the rows of the next tile are fetched. Groups follow in ascending order and a sum over I is cut
 * by I alone: the bits of a row depend on neither the ranges, the threads nor the other scenes.
 *
 * The gradient with respect to x is the same kernel with the lists exchanged and W_k^T.
 */
#include "ast.h"
#include "row_tile.h"
#ifdef AST_BFLOAT16
#include "bfloat16.h"
#endif

enum {
  OFFSETS = 27,
  PAIR_TILE = 48,      /* pairs at a time: 24 KB at 128 channels, beside 16 KB of a panel of weights in L1 */
  TASK_PAIRS = 4096,   /* pairs a task, about: fewer would read the weights too often */
  LEAST_TASKS = 8,     /* however few pairs there are */
  CHAIN_CHANNELS = 512 /* products of one chain at most: their rounding errors grow with their number */
};

typedef struct {
  const float *x, *weight, *bias;
  float *packed; /* W_k in panels, [27] */
  int64_t C_in, C_out, num_out;
  int64_t rows, columns; /* of a task */
  int64_t column_tasks;
  bool transposed;
  ast_pairs pairs;
  float *out;
} conv_job;

#ifdef AST_BFLOAT16
_Static_assert((int)PAIR_TILE <= (int)BFLOAT16_ROWS && (int)CHAIN_CHANNELS == (int)BFLOAT16_DEPTH,
               "the rows of a tile are a block, a chain is what is rounded at a time");
#endif

/* Floats of a panel. */
AST_INLINE int64_t conv_panel_size(const conv_job *job) {
#ifdef AST_BFLOAT16
  if (bfloat16_pays(job->C_in)) return bfloat16_panel_size(job->C_in);
#endif
  return job->C_in * GEMM_COLUMNS;
}

/* The panel of W_k with column c. */
AST_INLINE float *conv_panel(const conv_job *job, int64_t k, int64_t c) {
  return job->packed + (k * divide_up(job->C_out, GEMM_COLUMNS) + c / GEMM_COLUMNS) * conv_panel_size(job);
}

/* Packs one panel of one W_k. */
static ast_status conv_pack_task(int64_t index, void *context) {
  const conv_job *job = context;
  const int64_t C_in = job->C_in, C_out = job->C_out, panels = divide_up(C_out, GEMM_COLUMNS);
  const int64_t k = index / panels, column = index % panels * GEMM_COLUMNS, n = min64(GEMM_COLUMNS, C_out - column);
  if (job->pairs.offsets[k] == job->pairs.offsets[k + 1]) return AST_OK;
  const int64_t from_row = job->transposed ? 1 : C_out, from_column = job->transposed ? C_in : 1;
  const float *weight = job->weight + k * C_in * C_out + column * from_column;
  float *panel = conv_panel(job, k, column);
#ifdef AST_BFLOAT16
  if (bfloat16_pays(job->C_in)) {
    bfloat16_pack_columns(weight, from_row, from_column, C_in, n, panel);
    return AST_OK;
  }
#endif
  gemm_pack(weight, from_row, from_column, C_in, n, panel);
  return AST_OK;
}

/* The tiles of a task, in order: pairs [first, first + n) of group k. */
typedef struct {
  int64_t begin[OFFSETS], end[OFFSETS]; /* the task's pairs in each group */
  int64_t k, first, n;
} conv_walk;

static void conv_advance(conv_walk *w) {
  w->first += w->n;
  while (w->k < OFFSETS && w->first == w->end[w->k])
    if (++w->k < OFFSETS) w->first = w->begin[w->k];
  w->n = w->k < OFFSETS ? min64(PAIR_TILE, w->end[w->k] - w->first) : 0;
}

static conv_walk conv_start(const ast_pairs *pairs, int64_t first, int64_t last) {
  conv_walk w = {.k = 0};
  for (int64_t k = 0; k < OFFSETS; k++) {
    w.begin[k] = lower_bound(pairs->destination, pairs->offsets[k], pairs->offsets[k + 1], first);
    w.end[k] = lower_bound(pairs->destination, w.begin[k], pairs->offsets[k + 1], last);
  }
  w.first = w.begin[0];
  conv_advance(&w);
  return w;
}

/* Rows of a tile, in memory that need not hold them yet; base is the bias where out has no contribution before this
 * one, else out. */
typedef struct {
  const float *x[PAIR_TILE], *base[PAIR_TILE];
  float *out[PAIR_TILE];
} conv_rows;

static void conv_point(const conv_job *job, const conv_walk *tile, int64_t first_row, const float *bias, uint8_t *seen,
                       conv_rows *r) {
  for (int64_t i = 0; i < tile->n; i++) {
    const int64_t q = job->pairs.destination[tile->first + i];
    r->x[i] = job->x + job->pairs.source[tile->first + i] * job->C_in;
    r->out[i] = job->out + q * job->C_out;
    r->base[i] = seen[q - first_row] ? r->out[i] : bias;
    seen[q - first_row] = 1;
  }
}

#ifdef AST_BFLOAT16
/* As `conv_chain`, with products in bfloat16: all rows of the tile with one panel at a time. */
static void conv_rounded_chain(const conv_job *job, const conv_walk *tile, const conv_rows *rows, const conv_walk *next,
                               const conv_rows *next_rows, int64_t first, int64_t column, int64_t columns) {
  bfloat16_block block;
  const int64_t n = tile->n, K = min64(job->C_in - first, CHAIN_CHANNELS), panels = divide_up(columns, GEMM_COLUMNS);
  for (int64_t i = 0; i < n; i++) bfloat16_round_row(rows->x[i], K, block.rows + i * BFLOAT16_ROW);
  for (int64_t p = 0; p < panels; p++) {
    const int64_t c = column + p * GEMM_COLUMNS, width = min64(GEMM_COLUMNS, job->C_out - c);
    for (int64_t i = next->n * p / panels; i < next->n * (p + 1) / panels; i++)
      for (int64_t k = 0; k < job->C_in; k += LINE) __builtin_prefetch(next_rows->x[i] + k, 0, 2);
    bfloat16_products(n, round_up(K, BFLOAT16_STEP), block.rows, BFLOAT16_ROW,
                      conv_panel(job, tile->k, c) + first / 2 * GEMM_COLUMNS, block.sums, GEMM_COLUMNS, false);
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < width; j += VW) {
        const vf sum = vload_upto(rows->base[i] + c + j, width - j) + vload(block.sums + i * GEMM_COLUMNS + j);
        vstore_upto(rows->out[i] + c + j, sum, width - j);
      }
  }
}
#endif

/* The products of channels first.. of the rows of a tile, strip by strip and panel by panel, while the rows of the next
 * are fetched. Inlined with its strips: 128 channels are so few products that a call for each would cost 4 to 7 %. */
AST_INLINE void conv_chain(const conv_job *job, const conv_walk *tile, const conv_rows *rows, const conv_walk *next,
                           const conv_rows *next_rows, int64_t first, int64_t column, int64_t columns) {
#ifdef AST_BFLOAT16
  if (bfloat16_pays(job->C_in)) {
    conv_rounded_chain(job, tile, rows, next, next_rows, first, column, columns);
    return;
  }
#endif
  const int64_t C_out = job->C_out, n = tile->n, K = min64(job->C_in - first, CHAIN_CHANNELS);
  const int64_t strips = row_strips(n), parts = strips * divide_up(columns, GEMM_COLUMNS);
  for (int64_t c = column, part = 0; c < column + columns; c += GEMM_COLUMNS)
    for (int64_t strip = 0; strip < strips; strip++, part++) {
      const int64_t i = n * strip / strips, f = next->n * part / parts, f_end = next->n * (part + 1) / parts;
      const row_pointers pointers = {rows->x + i, rows->base + i, rows->out + i};
      const row_fetch fetch = {next_rows->x + f, next_rows->out + f, f_end - f};
      row_panel(n * (strip + 1) / strips - i, min64(GEMM_COLUMNS, C_out - c), K, pointers, fetch,
                conv_panel(job, tile->k, c) + first * GEMM_COLUMNS, c);
    }
}

/* The chains behind the first: out holds their sum so far, so that each starts from there. */
static __attribute__((noinline)) void conv_more_chains(const conv_job *job, const conv_walk *tile, conv_rows *rows,
                                                       const conv_rows *next_rows, int64_t column, int64_t columns) {
  const conv_walk none = {0};
  for (int64_t first = CHAIN_CHANNELS; first < job->C_in; first += CHAIN_CHANNELS) {
    for (int64_t i = 0; i < tile->n; i++) rows->x[i] += CHAIN_CHANNELS, rows->base[i] = rows->out[i];
    conv_chain(job, tile, rows, &none, next_rows, first, column, columns);
  }
}

static ast_status conv_task(int64_t index, void *context) {
  const conv_job *job = context;
  const int64_t C_out = job->C_out;
  const int64_t first = index / job->column_tasks * job->rows, last = min64(job->num_out, first + job->rows);
  const int64_t column = index % job->column_tasks * job->columns, columns = min64(job->columns, C_out - column);
  float *bias = ast_scratch(C_out * (int64_t)sizeof *bias + job->rows);
  if (!bias) return AST_NO_MEMORY;
  uint8_t *seen = (uint8_t *)(bias + C_out);
  if (job->bias) memcpy(bias, job->bias, (size_t)C_out * sizeof *bias);
  else memset(bias, 0, (size_t)C_out * sizeof *bias);
  memset(seen, 0, (size_t)(last - first));
  conv_rows rows[2];
  conv_walk tile = conv_start(&job->pairs, first, last);
  conv_point(job, &tile, first, bias, seen, &rows[0]);
  for (int i = 0; tile.n; i = !i) {
    conv_walk next = tile;
    conv_advance(&next);
    conv_point(job, &next, first, bias, seen, &rows[!i]);
    conv_chain(job, &tile, &rows[i], &next, &rows[!i], 0, column, columns);
    if (job->C_in > CHAIN_CHANNELS) conv_more_chains(job, &tile, &rows[i], &rows[!i], column, columns);
    tile = next;
  }
  for (int64_t row = first; row < last; row++)
    if (!seen[row - first]) memcpy(job->out + row * C_out + column, bias + column, (size_t)columns * sizeof *bias);
  return AST_OK;
}

/* Sizes of the tasks. Where there are few pairs, ranges of rows (each reads all weights) and of columns (each reads all
 * pairs) make up LEAST_TASKS so that the least is read. */
static void conv_cut(conv_job *job) {
  const int64_t num_pairs = job->pairs.offsets[OFFSETS], panels = divide_up(job->C_out, GEMM_COLUMNS);
  int64_t row_tasks = num_pairs / TASK_PAIRS, column_tasks = 1;
  if (row_tasks < LEAST_TASKS) {
    while (column_tasks < min64(panels, LEAST_TASKS) &&
           column_tasks * num_pairs < LEAST_TASKS / 2 / column_tasks * OFFSETS * job->C_out)
      column_tasks *= 2;
    row_tasks = LEAST_TASKS / column_tasks;
  }
  row_tasks = min64(row_tasks, job->num_out);
  job->rows = divide_up(job->num_out, row_tasks);
  job->columns = divide_up(panels, column_tasks) * GEMM_COLUMNS;
  job->column_tasks = divide_up(job->C_out, job->columns);
}

static ast_status sparse_conv(const float *restrict x, const float *restrict weight, const float *restrict bias,
                              int64_t C_in, int64_t C_out, bool transposed, ast_pairs pairs, int64_t num_out,
                              float *restrict out) {
  AST_SCRATCH_SCOPE;
  if (num_out == 0 || C_out == 0) return AST_OK;
  conv_job job = {.x = x,
                  .weight = weight,
                  .bias = bias,
                  .C_in = C_in,
                  .C_out = C_out,
                  .num_out = num_out,
                  .transposed = transposed,
                  .pairs = pairs,
                  .out = out};
  const int64_t panels = OFFSETS * divide_up(C_out, GEMM_COLUMNS);
  job.packed = ast_scratch(panels * conv_panel_size(&job) * (int64_t)sizeof *job.packed);
  if (!job.packed) return AST_NO_MEMORY;
  conv_cut(&job);
  const ast_status status = ast_parallel(panels, conv_pack_task, &job);
  return status == AST_OK ? ast_parallel(divide_up(num_out, job.rows) * job.column_tasks, conv_task, &job) : status;
}
