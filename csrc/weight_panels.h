/* What linear.c and mlp.c are made of: a dense layer on a block of rows, and sums over blocks of rows.
 *
 *   out_ij = act(sum_k a_ik W_jk + bias_j) + residual_ij,   i < rows, k < K, j < N
 *
 * W is packed once a call into panels of GEMM_COLUMNS outputs, padded with zeros; all tasks read the same panels.
 * Panels go by while a block of some 100 rows of A stays in the cache, and what follows the product happens in its
 * registers, so that every output is written once. For GEGLU a panel holds VW outputs of the first half of W beside the
 * same ones of the second half.
 *
 * An element is a sum of chains of multiply-adds over rising k, cut by K and N alone, then the bias, whatever tile it
 * falls into: a row's result depends on neither its place, the batch nor the threads.
 */
#ifndef AST_WEIGHT_PANELS_H
#define AST_WEIGHT_PANELS_H

#include "ast.h"
#include "gemm.h"
#ifdef AST_BFLOAT16
#include "bfloat16.h"
#endif

enum {
  DENSE_ROWS = 96,         /* rows of a block: a multiple of GEMM_ROWS */
  DENSE_APART = 16,        /* floats added to the rows of copied blocks: a power of two would crowd few cache sets */
  DENSE_DEPTH = 192,       /* terms of one chain at most: its rounding errors grow with their number, */
  DENSE_SHALLOW = 32,      /* and with few outputs, where lanes lie idle anyway, short chains cost little */
  DENSE_FEW = 8,           /* outputs */
  DENSE_CHAIN = 16,        /* blocks of one chain of a sum over blocks */
  DENSE_PACK = 1 << 16,    /* floats of weights from which several threads pack them */
  DENSE_PARTIALS = 1 << 24 /* floats at most of partial sums */
};

typedef struct {
  const float *weight; /* W_jk = weight[k*row + j*column] */
  int64_t row, column;
  const float *bias;  /* [N] or NULL; paired: [2N] */
  int64_t K, N;       /* paired: outputs of a half */
  bool paired;        /* N outputs beside N others */
  int64_t depth;      /* terms of one chain of multiply-adds */
  float *panels;      /* [panels][K][GEMM_COLUMNS], or in pairs (bfloat16.h) */
  float *panels_bias; /* [panels][GEMM_COLUMNS] */
} dense_layer;

/* y = x W^T + bias with W [N,K], and dx = dy W of N columns of W [K,row]; a NULL weight leaves the layer out. */
AST_INLINE dense_layer dense_forward(const float *weight, const float *bias, int64_t K, int64_t N) {
  return (dense_layer){.weight = weight, .row = 1, .column = K, .bias = bias, .K = K, .N = N};
}
AST_INLINE dense_layer dense_backward(const float *weight, int64_t row, int64_t K, int64_t N) {
  return (dense_layer){.weight = weight, .row = row, .column = 1, .K = K, .N = N};
}

AST_INLINE int64_t dense_panel_width(const dense_layer *l) { return l->paired ? VW : GEMM_COLUMNS; }
AST_INLINE int64_t dense_panels(const dense_layer *l) { return divide_up(l->N, dense_panel_width(l)); }
#ifdef AST_BFLOAT16
_Static_assert((int)DENSE_ROWS == (int)BFLOAT16_ROWS, "blocks of rows have one size");
#endif

/* Floats of a panel. */
AST_INLINE int64_t dense_panel_size(const dense_layer *l) {
#ifdef AST_BFLOAT16
  if (bfloat16_pays(l->K)) return bfloat16_panel_size(l->K);
#endif
  return l->K * GEMM_COLUMNS;
}
AST_INLINE float *dense_panel(const dense_layer *l, int64_t p) { return l->panels + p * dense_panel_size(l); }
AST_INLINE int64_t dense_packed_size(const dense_layer *l) {
  return dense_panels(l) * (dense_panel_size(l) + GEMM_COLUMNS);
}

/* n outputs from j on of the inputs k to k + depth. */
static void dense_pack_inputs(const dense_layer *l, int64_t j, int64_t n, int64_t k, int64_t depth, float *panel) {
  const float *weight = l->weight + j * l->column + k * l->row;
  if (l->paired) {
    gemm_pack_columns(weight, l->row, l->column, depth, n, VW, panel);
    gemm_pack_columns(weight + l->N * l->column, l->row, l->column, depth, n, VW, panel + VW);
  } else {
    gemm_pack_columns(weight, l->row, l->column, depth, n, GEMM_COLUMNS, panel);
  }
}

static void dense_pack_outputs(const dense_layer *l, int64_t j, int64_t n, float *panel) {
#ifdef AST_BFLOAT16
  for (int64_t k = 0; bfloat16_pays(l->K) && k < l->K; k += BFLOAT16_STEP) {
    float step[BFLOAT16_STEP * GEMM_COLUMNS] = {0};
    dense_pack_inputs(l, j, n, k, min64(BFLOAT16_STEP, l->K - k), step);
    bfloat16_pack(step, GEMM_COLUMNS, panel + k / 2 * GEMM_COLUMNS);
  }
  if (bfloat16_pays(l->K)) return;
#endif
  dense_pack_inputs(l, j, n, 0, l->K, panel);
}

static void dense_pack_panel(const dense_layer *l, int64_t p) {
  float *bias = l->panels_bias + p * GEMM_COLUMNS;
  const int64_t j = p * dense_panel_width(l), n = min64(dense_panel_width(l), l->N - j);
  dense_pack_outputs(l, j, n, dense_panel(l, p));
  for (int i = 0; i < GEMM_COLUMNS; i++) bias[i] = 0;
  for (int64_t i = 0; l->bias && i < n; i++) {
    bias[i] = l->bias[j + i];
    if (l->paired) bias[VW + i] = l->bias[l->N + j + i];
  }
}

static ast_status dense_pack_task(int64_t index, void *layers) {
  const dense_layer *l = layers;
  for (; index >= dense_panels(l); l++) index -= dense_panels(l);
  dense_pack_panel(l, index);
  return AST_OK;
}

/* Packs layers into scratch of the calling thread, which its tasks may read. A layer without weight is left out. */
static ast_status dense_pack(dense_layer *layers, int64_t num) {
  int64_t size = 0, panels = 0;
  for (int64_t i = 0; i < num; i++) {
    if (!layers[i].weight) layers[i].N = 0;
    const int64_t outputs =
        layers[i].paired ? 2 * layers[i].N : layers[i].N; /* as for both halves in one: z has the same bits */
    const int64_t most = outputs > DENSE_FEW ? DENSE_DEPTH : DENSE_SHALLOW,
                  chains = max64(1, divide_up(layers[i].K, most));
    layers[i].depth = divide_up(layers[i].K, chains);
    size += dense_packed_size(&layers[i]);
    panels += dense_panels(&layers[i]);
  }
  float *packed = ast_scratch(size * (int64_t)sizeof *packed);
  if (!packed) return AST_NO_MEMORY;
  for (int64_t i = 0; i < num; i++) {
    layers[i].panels = packed;
    layers[i].panels_bias = dense_panel(&layers[i], dense_panels(&layers[i]));
    packed += dense_packed_size(&layers[i]);
  }
  if (size >= DENSE_PACK) return ast_parallel(panels, dense_pack_task, layers);
  for (int64_t p = 0; p < panels; p++) dense_pack_task(p, layers);
  return AST_OK;
}

/* Rows that are needed soon; they are fetched into the second cache during the products of this one. */
typedef struct {
  const float *data; /* NULL: none */
  int64_t row, rows, columns;
} dense_next;

/* The rows from `first` on of an array of M rows, as many as a block has */
AST_INLINE dense_next dense_rows_from(const float *data, int64_t row, int64_t columns, int64_t first, int64_t M) {
  return data && first < M ? (dense_next){data + first * row, row, min64(DENSE_ROWS, M - first), columns}
                           : (dense_next){0};
}

enum { DENSE_NEXT = 2 };

/* What happens to a product: pointers to the first row, and the floats from row to row. */
typedef struct {
  ast_activation activation;
  float *out;
  int64_t out_row;
  const float *residual; /* added, or NULL */
  int64_t residual_row;
  const float *hidden; /* or NULL; out is 0 where this is not above 0: the gradient of ReLU */
  int64_t hidden_row;
  float *z; /* what enters the activation, or NULL: [*, N], paired [*, 2N], contiguous */
  dense_next next[DENSE_NEXT];
} dense_end;

/* What follows the product of a tile in the seldom cases: halves of a panel, z, columns from j on of which not all n
 * are real. */
static __attribute__((noinline)) void dense_finish(const dense_layer *l, const dense_end *e, int64_t rows,
                                                   int64_t vectors, int64_t i, int64_t j, int64_t n, const float *sums,
                                                   const float *bias) {
  for (const int64_t end = i + rows; i < end; i++, sums += GEMM_COLUMNS) {
    if (l->paired) {
      const vf a = vload(sums) + vload(bias), b = vload(sums + VW) + vload(bias + VW);
      vf z = a * (b * vnormal(b, vgauss(b)));
      if (e->z) {
        vstore_upto(e->z + i * 2 * l->N + j, a, n);
        vstore_upto(e->z + (i * 2 + 1) * l->N + j, b, n);
      }
      if (e->residual) z += vload_upto(e->residual + i * e->residual_row + j, n);
      vstore_upto(e->out + i * e->out_row + j, z, n);
      continue;
    }
    for (int64_t v = 0; v < vectors * VW; v += VW) {
      vf z = vload(sums + v) + vload(bias + v); /* last: a large bias costs the sum no digits */
      if (e->z) vstore_upto(e->z + i * l->N + j + v, z, n - v);
      if (e->activation == AST_RELU) z = vmax((vf){0}, z);
      if (e->hidden) z = (vf)((vi)z & ~(vload_upto(e->hidden + i * e->hidden_row + j + v, n - v) <= 0));
      if (e->residual) z += vload_upto(e->residual + i * e->residual_row + j + v, n - v);
      vstore_upto(e->out + i * e->out_row + j + v, z, n - v);
    }
  }
}

/* The same in the usual cases, in the registers of the tile: rows from i on, whole vectors from column j on. */
AST_INLINE void dense_finish_tile(const int rows, const int vectors, const dense_end *e, int64_t i0, int64_t j,
                                  const float *bias, vf z[GEMM_ROWS][2]) {
  TILE_EACH(i, v) z[i][v] += vload(bias + v * VW);
  if (e->activation == AST_RELU) TILE_EACH(i, v) z[i][v] = vmax((vf){0}, z[i][v]);
  if (e->hidden) {
    const float *hidden = e->hidden + i0 * e->hidden_row + j;
    TILE_EACH(i, v) z[i][v] = (vf)((vi)z[i][v] & ~(vload(hidden + i * e->hidden_row + v * VW) <= 0));
  }
  if (e->residual) {
    const float *residual = e->residual + i0 * e->residual_row + j;
    TILE_EACH(i, v) z[i][v] += vload(residual + i * e->residual_row + v * VW);
  }
  float *out = e->out + i0 * e->out_row + j;
  TILE_EACH(i, v) vstore(out + i * e->out_row + v * VW, z[i][v]);
}

/* A block of rows of A, at most DENSE_ROWS, that a layer multiplies panel by panel. */
typedef struct {
  const dense_layer *layer;
  gemm_a a;
  int64_t rows;
#ifdef AST_BFLOAT16
  bfloat16_block rounded;
#endif
} dense_block;

AST_INLINE void dense_new_block(dense_block *block, const dense_layer *l, gemm_a a, int64_t rows) {
  block->layer = l;
  block->a = a;
  block->rows = rows;
#ifdef AST_BFLOAT16
  block->rounded.k0 = -1;
#endif
}

/* Comes before the tiles of panel p. */
AST_INLINE void dense_begin_panel(dense_block *block, int64_t p) {
#ifdef AST_BFLOAT16
  const dense_layer *l = block->layer;
  if (bfloat16_pays(l->K)) bfloat16_sums(block->rows, l->K, block->a, dense_panel(l, p), &block->rounded);
#else
  (void)block, (void)p;
#endif
}

/* sum_ij = sum_k a_ik W_jk for a register tile, rows from i0 on of panel p, chain after chain, their sum in the stack
 * between two of them. */
AST_INLINE void dense_sums(const int rows, const int vectors, const dense_block *block, int64_t p, int64_t i0,
                           vf sum[GEMM_ROWS][2]) {
  const dense_layer *l = block->layer;
#ifdef AST_BFLOAT16
  if (bfloat16_pays(l->K)) {
    TILE_EACH(i, v) sum[i][v] = vload(block->rounded.sums + (i0 + i) * GEMM_COLUMNS + v * VW);
    return;
  }
#endif
  const float *panel = dense_panel(l, p);
  const gemm_a a = {block->a.data + i0 * block->a.row, block->a.row, block->a.column};
  float sums[GEMM_ROWS * GEMM_COLUMNS] __attribute__((aligned(64)));
  for (int64_t k = 0;;) { /* once without inputs, too: the sums are then 0 */
    TILE_EACH(i, v) sum[i][v] = (vf){0};
    gemm_sums(rows, vectors, min64(l->depth, l->K - k), (gemm_a){a.data + k * a.column, a.row, a.column},
              panel + k * GEMM_COLUMNS, GEMM_COLUMNS, sum);
    if (k) TILE_EACH(i, v) sum[i][v] += vload(sums + i * GEMM_COLUMNS + v * VW);
    k += l->depth;
    if (k >= l->K) break;
    TILE_EACH(i, v) vstore(sums + i * GEMM_COLUMNS + v * VW, sum[i][v]);
    __asm__(""
            : "+m"(sums)); /* or the compiler moves what is not yet known of them through other stack for every tile */
  }
}

/* One register tile: rows i.. of panel p. */
AST_INLINE void dense_tile(const int rows, const int vectors, const dense_block *block, int64_t p, int64_t i0,
                           const dense_end *e) {
  const dense_layer *l = block->layer;
  const int64_t j = p * dense_panel_width(l);
  const float *bias = l->panels_bias + p * GEMM_COLUMNS;
  float sums[GEMM_ROWS * GEMM_COLUMNS] __attribute__((aligned(64)));
  TILE_EACH(i, v) __builtin_prefetch(e->out + (i0 + i) * e->out_row + j + v * VW, 1);
  vf sum[GEMM_ROWS][2];
  dense_sums(rows, vectors, block, p, i0, sum);
  if (!l->paired && !e->z && l->N - j >= vectors * VW) {
    dense_finish_tile(rows, vectors, e, i0, j, bias, sum);
    return;
  }
  TILE_EACH(i, v) vstore(sums + i * GEMM_COLUMNS + v * VW, sum[i][v]);
  dense_finish(l, e, rows, vectors, i0, j, l->N - j, sums, bias);
}

/* The parts of the rows first.. that panel p of `panels` fetches. */
AST_INLINE void dense_fetch(const dense_next *next, int64_t p, int64_t panels, int64_t first, int64_t rows) {
  const int64_t lines = (next->columns + 15) / 16, begin = lines * p / panels, end = lines * (p + 1) / panels;
  for (int64_t i = first; i < min64(first + rows, next->rows); i++)
    for (int64_t k = begin; k < end; k++) __builtin_prefetch(next->data + i * next->row + 16 * k, 0, 2);
}

AST_INLINE void dense_strip(const int vectors, const dense_block *block, int64_t p, const dense_end *e) {
#define DENSE_TILE(rows)                                                      \
  do {                                                                        \
    for (int n = 0; n < DENSE_NEXT && (rows) == GEMM_ROWS; n++)               \
      if (e->next[n].data) dense_fetch(&e->next[n], p, panels, i, GEMM_ROWS); \
    dense_tile(rows, vectors, block, p, i, e);                                \
  } while (0)
  const int64_t panels = dense_panels(block->layer);
  EACH_TILE_OF_ROWS(i, block->rows, DENSE_TILE);
#undef DENSE_TILE
}

/* M rows are cut evenly between register tiles: where task `index` of `tasks` begins. */
AST_INLINE int64_t dense_begin(int64_t M, int64_t tasks, int64_t index) {
  return min64(M, divide_up(M, GEMM_ROWS) * index / tasks * GEMM_ROWS);
}

/* Panels first <= p < last of the layer on `rows` rows of A. */
static void dense_rows(const dense_layer *l, int64_t first, int64_t last, int64_t rows, gemm_a a, dense_end e) {
  dense_block block;
  dense_new_block(&block, l, a, rows);
  for (int64_t p = first; p < last; p++) {
    dense_begin_panel(&block, p);
    if (l->paired || l->N - p * GEMM_COLUMNS > VW) dense_strip(2, &block, p, &e);
    else dense_strip(1, &block, p, &e);
  }
}

/* All of the layer. */
static void dense_all(const dense_layer *l, int64_t rows, gemm_a a, dense_end e) {
  dense_rows(l, 0, dense_panels(l), rows, a, e);
}

/* ---- what the gradients need ---- */

/* to[i] = from[i], n floats each, padded with zeros to whole vectors */
static void dense_copy_rows(const float *from, int64_t from_row, int64_t rows, int64_t n, float *to, int64_t to_row) {
  for (int64_t i = 0; i < rows; i++)
    for (int64_t j = 0; j < n; j += VW) vstore(to + i * to_row + j, vload_upto(from + i * from_row + j, n - j));
}

/* The sum of vectors that lie `row` floats apart, by four short chains, so that long sums stay accurate. */
AST_INLINE vf dense_four_chains(const float *x, int64_t row, int64_t rows) {
  vf chain[4] = {{0}};
  int64_t i = 0;
  for (; i + 4 <= rows; i += 4) EACH(4, c) chain[c] += vload(x + (i + c) * row);
  for (; i < rows; i++) chain[0] += vload(x + i * row);
  return (chain[0] + chain[1]) + (chain[2] + chain[3]);
}

/* sums[j] += sum_i x_ij, n padded to whole vectors */
static void dense_add_rows(const float *x, int64_t row, int64_t rows, int64_t n, float *sums) {
  for (int64_t j = 0; j < n; j += VW) vstore(sums + j, vload(sums + j) + dense_four_chains(x + j, row, rows));
}

/* Rows are cut into chunks by their number alone; each chunk has its own partial sums, added at the end by four chains.
 * The blocks of a chunk are added by chains of DENSE_CHAIN, whose sums are added to each other. */
typedef struct {
  int64_t num, rows, step; /* chunks, rows of a chunk, rows of a block within it */
} dense_chunks;

static dense_chunks dense_cut(int64_t M, int64_t floats) {
  const int64_t most = min64(32, max64(2, DENSE_PARTIALS / max64(1, floats)));
  const int64_t parts = M / 192 > 2 ? round_up(M / 192, 4) : min64(2, M / 16); /* even for 2 and for 4 threads */
  const int64_t num = max64(1, min64(parts, most)), rows = divide_up(M, num);
  const int64_t blocks = divide_up(rows, DENSE_ROWS);
  return (dense_chunks){num, rows, blocks ? round_up(divide_up(rows, blocks), GEMM_ROWS) : DENSE_ROWS};
}

/* The blocks of a chunk. */
AST_INLINE int64_t dense_blocks(dense_chunks chunks) { return divide_up(chunks.rows, chunks.step); }

/* One of the gradients that are sums over rows: to [rows,n], or NULL if it is not wanted. Each chunk has a partial sum
 * of it, `at` in the memory of the chunk, rows of whole vectors `row` floats apart. Blocks add to vectors; to matrices
 * only the blocks behind the first one of a chain, which sets them. */
typedef struct {
  float *to;
  int64_t rows, n, at, row;
} dense_sum;

enum { DENSE_SUM_ROWS = 16 };

typedef struct {
  dense_sum *sums;           /* [num] */
  int64_t num, size, chunks; /* floats of all sums; chunks */
  int64_t apart;             /* floats of a chunk: size, or 2 size where it has more than one chain */
  float *memory;             /* [chunks,apart]: of the last chain, and of the chains before it */
} dense_partials;

/* Says where each sum lies. */
static dense_partials dense_place_sums(dense_sum *sums, int64_t num) {
  dense_partials partials = {.sums = sums, .num = num};
  for (dense_sum *sum = sums; sum < sums + num; sum++) {
    sum->row = round_up(sum->n, VW);
    sum->at = partials.size;
    partials.size += sum->rows * sum->row;
  }
  return partials;
}

/* Room for chunks of at most `blocks` blocks. */
static bool dense_new_partials(dense_partials *partials, int64_t chunks, int64_t blocks) {
  partials->chunks = chunks;
  partials->apart = blocks > DENSE_CHAIN ? 2 * partials->size : partials->size;
  partials->memory = ast_scratch(chunks * partials->apart * (int64_t)sizeof(float));
  return partials->memory;
}

/* Clears vectors, to which the blocks add, and all sums of a chunk that is empty. */
static void dense_clear_sums(const dense_partials *partials, float *memory, bool empty) {
  for (const dense_sum *sum = partials->sums; sum < partials->sums + partials->num; sum++)
    if (sum->rows == 1 || empty) memset(memory + sum->at, 0, (size_t)(sum->rows * sum->row) * sizeof *memory);
}

/* The memory of a chunk before its first block. */
static float *dense_start_chunk(const dense_partials *partials, int64_t chunk, bool empty) {
  float *memory = partials->memory + chunk * partials->apart;
  dense_clear_sums(partials, memory, empty);
  if (partials->apart > partials->size) memset(memory + partials->size, 0, (size_t)partials->size * sizeof *memory);
  return memory;
}

/* Comes before each block of a chunk, counted from 0: whether it adds to the matrices of the chain, or sets them. */
static bool dense_begin_block(const dense_partials *partials, int64_t block, float *memory) {
  if (block % DENSE_CHAIN) return true;
  if (block == 0) return false;
  for (const dense_sum *sum = partials->sums; sum < partials->sums + partials->num; sum++) {
    float *chain = memory + sum->at, *chains = chain + partials->size;
    for (int64_t i = 0; sum->to && i < sum->rows * sum->row; i += VW)
      vstore(chains + i, vload(chains + i) + vload(chain + i));
  }
  dense_clear_sums(partials, memory, false);
  return false;
}

AST_INLINE int64_t dense_sum_tasks(const dense_sum *target) {
  return target->to ? divide_up(target->rows, DENSE_SUM_ROWS) : 0;
}

static ast_status dense_sum_task(int64_t index, void *context) {
  const dense_partials *partials = context;
  const dense_sum *target = partials->sums;
  for (; index >= dense_sum_tasks(target); target++) index -= dense_sum_tasks(target);
  for (int64_t i = index * DENSE_SUM_ROWS; i < min64(target->rows, (index + 1) * DENSE_SUM_ROWS); i++)
    for (int64_t j = 0; j < target->n; j += VW) {
      const float *partial = partials->memory + target->at + i * target->row + j;
      vf sum = dense_four_chains(partial, partials->apart, partials->chunks);
      if (partials->apart > partials->size)
        sum += dense_four_chains(partial + partials->size, partials->apart, partials->chunks);
      vstore_upto(target->to + i * target->n + j, sum, target->n - j);
    }
  return AST_OK;
}

/* The sums over all chunks. */
static ast_status dense_add_partials(dense_partials *partials) {
  int64_t tasks = 0;
  for (int64_t i = 0; i < partials->num; i++) tasks += dense_sum_tasks(&partials->sums[i]);
  return ast_parallel(tasks, dense_sum_task, partials);
}

#endif
