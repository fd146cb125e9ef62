/* Products of rows with panels of weights, both rounded to bfloat16; their sums stay in float32.
 *
 *   sum_ij = sum_k r(a_ik) r(W_jk),   r: the nearest number of 8 binary digits, of two the even one
 *
 * Processors have instructions for it: tiles of 16 x 16 sums (AMX), or dot products of pairs (AVX512-BF16). Without
 * either the same is computed in float32, so that tests run everywhere. Subnormal numbers count as 0.
 *
 * A panel holds pairs of inputs k, k + 1 of each of its outputs, [K/2][GEMM_COLUMNS][2], filled up with zeros to whole
 * steps. Rows are rounded once for all panels, BFLOAT16_DEPTH inputs at a time. Sums go over rising k, whatever the
 * block: a row's result depends on neither its place nor its neighbours.
 */
#ifndef AST_BFLOAT16_H
#define AST_BFLOAT16_H

#include "gemm.h"

#ifdef __AVX512BF16__
#include <immintrin.h>
#endif

enum {
  BFLOAT16_ROWS = 96,   /* of a block */
  BFLOAT16_STEP = 32,   /* inputs of a tile, which fill its rows of 64 bytes */
  BFLOAT16_DEPTH = 512, /* inputs that are rounded at a time: a block stays in the second cache */
  BFLOAT16_ROW = BFLOAT16_DEPTH + BFLOAT16_STEP /* numbers from row to row: a power of two would crowd few cache sets */
};

/* The rounded numbers of a block of rows from input k0 on, and their sums with one panel. */
typedef struct {
  uint16_t rows[BFLOAT16_ROWS * BFLOAT16_ROW] __attribute__((aligned(64)));
  float sums[BFLOAT16_ROWS * GEMM_COLUMNS] __attribute__((aligned(64)));
  int64_t k0; /* -1: nothing is rounded yet */
} bfloat16_block;

/* Fewer inputs do not fill a tile: rounding them costs more than it gains. */
AST_INLINE bool bfloat16_pays(int64_t K) { return K >= BFLOAT16_STEP; }

/* Of a panel, in units of float: a pair takes as much room. */
AST_INLINE int64_t bfloat16_panel_size(int64_t K) { return round_up(K, BFLOAT16_STEP) / 2 * GEMM_COLUMNS; }

/* r(x), a float whose lower half is 0. */
AST_INLINE vi bfloat16_of(vf x) {
  const vu bits = (vu)x, nearest = bits + 0x7fff + ((bits >> 16) & 1), sign = bits & 0x80000000;
  const vf number = vselect((bits & 0x7f800000) == 0, (vf)sign, (vf)nearest);
  return (vi)((vu)vselect(x != x, (vf)(bits | 0x400000), number) & 0xffff0000);
}

/* Pairs of r(even) in the lower and r(odd) in the upper halves. */
AST_INLINE vi bfloat16_pairs(vf even, vf odd) {
#ifdef __AVX512BF16__
  const vi order = LANE_INDICES | (LANE_INDICES + 16) << 16;
  return (vi)_mm512_permutexvar_epi16((__m512i)order, (__m512i)_mm512_cvtne2ps_pbh((__m512)odd, (__m512)even));
#else
  return (vi)((vu)bfloat16_of(even) >> 16) | bfloat16_of(odd);
#endif
}

/* One step of a panel from the same one in float32, BFLOAT16_STEP rows of GEMM_COLUMNS, `row` floats apart. */
AST_INLINE void bfloat16_pack(const float *step, int64_t row, float *panel) {
  for (int64_t k = 0; k < BFLOAT16_STEP; k += 2, step += 2 * row)
    for (int64_t j = 0; j < GEMM_COLUMNS; j += VW)
      vstore(panel + k / 2 * GEMM_COLUMNS + j, (vf)bfloat16_pairs(vload(step + j), vload(step + row + j)));
}

/* A panel of B_kj = b[k*row + j*column], row or column 1, j < N <= GEMM_COLUMNS. */
static inline void bfloat16_pack_columns(const float *b, int64_t row, int64_t column, int64_t K, int64_t N,
                                         float *panel) {
  for (int64_t k = 0; k < K; k += BFLOAT16_STEP) {
    float step[BFLOAT16_STEP * GEMM_COLUMNS] = {0};
    gemm_pack_columns(b + k * row, row, column, min64(BFLOAT16_STEP, K - k), N, GEMM_COLUMNS, step);
    bfloat16_pack(step, GEMM_COLUMNS, panel + k / 2 * GEMM_COLUMNS);
  }
}

/* to[k] = r(from[k]) for k < n, and 0 up to a whole step. */
AST_INLINE void bfloat16_round_row(const float *from, int64_t n, uint16_t *to) {
  for (int64_t k = 0; k < n; k += BFLOAT16_STEP) {
#ifdef __AVX512BF16__
    const vf low = vload_upto(from + k, n - k), high = vload_upto(from + k + VW, n - k - VW);
    const __m512bh both = _mm512_cvtne2ps_pbh((__m512)high, (__m512)low);
    memcpy(to + k, &both, sizeof both);
#else
    for (int64_t j = k; j < k + BFLOAT16_STEP; j += VW) {
      const vi rounded = bfloat16_of(vload_upto(from + j, n - j));
      EACH(VW, i) to[j + i] = (uint16_t)((uint32_t)rounded[i] >> 16);
    }
#endif
  }
}

#ifdef __AMX_BF16__

typedef struct {
  uint8_t palette, start, reserved[14];
  uint16_t bytes[16]; /* of a row of each tile */
  uint8_t rows[16];
} bfloat16_tiles;

enum { BFLOAT16_TILE = 16 }; /* rows of a tile */

/* Compilers do not see what tiles read and write. */
#define BFLOAT16_FENCE() __asm__ volatile("" ::: "memory")

/* `count`, 1 or 2, tiles of rows by both tiles of a panel, over n inputs; added to the sums, or as the sums. */
AST_INLINE void bfloat16_multiply(const int count, int64_t n, const uint16_t *a, int64_t a_row, const float *panel,
                                  float *sums, int64_t sums_row, bool add) {
  const int64_t row = (int64_t)sizeof *a * a_row, pairs = sizeof *panel * GEMM_COLUMNS;
  const int64_t line = (int64_t)sizeof *sums * sums_row;
  float *const lower = sums + BFLOAT16_TILE * sums_row;
  if (add) {
    _tile_loadd(0, sums, line);
    _tile_loadd(1, sums + VW, line);
    if (count == 2) {
      _tile_loadd(2, lower, line);
      _tile_loadd(3, lower + VW, line);
    }
  } else {
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
  }
  for (int64_t k = 0; k < n; k += BFLOAT16_STEP, panel += BFLOAT16_STEP / 2 * GEMM_COLUMNS) {
    _tile_loadd(4, a + k, row);
    _tile_loadd(6, panel, pairs);
    _tile_loadd(7, panel + VW, pairs);
    _tile_dpbf16ps(0, 4, 6);
    _tile_dpbf16ps(1, 4, 7);
    if (count == 2) {
      _tile_loadd(5, a + BFLOAT16_TILE * a_row + k, row);
      _tile_dpbf16ps(2, 5, 6);
      _tile_dpbf16ps(3, 5, 7);
    }
  }
  _tile_stored(0, sums, line);
  _tile_stored(1, sums + VW, line);
  if (count == 2) {
    _tile_stored(2, lower, line);
    _tile_stored(3, lower + VW, line);
  }
}

/* Whole tiles: the rows behind the last one have any values. */
static void bfloat16_products(int64_t rows, int64_t n, const uint16_t *a, int64_t a_row, const float *panel,
                              float *sums, int64_t sums_row, bool add) {
  bfloat16_tiles shape = {.palette = 1};
  for (int i = 0; i < 8; i++) shape.bytes[i] = 64, shape.rows[i] = BFLOAT16_TILE;
  BFLOAT16_FENCE();
  _tile_loadconfig(&shape);
  int64_t i = 0;
  for (; rows - i > BFLOAT16_TILE; i += 2 * BFLOAT16_TILE)
    bfloat16_multiply(2, n, a + i * a_row, a_row, panel, sums + i * sums_row, sums_row, add);
  if (i < rows) bfloat16_multiply(1, n, a + i * a_row, a_row, panel, sums + i * sums_row, sums_row, add);
  _tile_release();
  BFLOAT16_FENCE();
}

#else

/* sum + the products of a pair of a row with the pairs of a panel */
AST_INLINE vf bfloat16_add(vf sum, int32_t pair, vi panel) {
#ifdef __AVX512BF16__
  return (vf)_mm512_dpbf16_ps((__m512)sum, (__m512bh)_mm512_set1_epi32(pair), (__m512bh)panel);
#else
  const vi pairs = pair - (vi){0};
  sum += (vf)(pairs << 16) * (vf)(panel << 16);
  return sum + (vf)((vu)pairs & 0xffff0000) * (vf)((vu)panel & 0xffff0000);
#endif
}

AST_INLINE void bfloat16_tile(const int rows, int64_t n, const uint16_t *a, int64_t a_row, const float *panel,
                              float *sums, int64_t sums_row, bool add) {
  const int vectors = 2;
  vf sum[GEMM_ROWS][2];
  TILE_EACH(i, v) sum[i][v] = add ? vload(sums + i * sums_row + v * VW) : (vf){0};
  for (int64_t k = 0; k < n; k += 2, panel += GEMM_COLUMNS) {
    vi b[2];
    EACH(vectors, v) b[v] = (vi)vload(panel + v * VW);
    EACH(rows, i) {
      int32_t pair;
      memcpy(&pair, a + i * a_row + k, sizeof pair);
      EACH(vectors, v) sum[i][v] = bfloat16_add(sum[i][v], pair, b[v]);
    }
  }
  TILE_EACH(i, v) vstore(sums + i * sums_row + v * VW, sum[i][v]);
}

static void bfloat16_products(int64_t rows, int64_t n, const uint16_t *a, int64_t a_row, const float *panel,
                              float *sums, int64_t sums_row, bool add) {
#define BFLOAT16_TILE(rows) bfloat16_tile(rows, n, a + i * a_row, a_row, panel, sums + i * sums_row, sums_row, add)
  EACH_TILE_OF_ROWS(i, rows, BFLOAT16_TILE);
#undef BFLOAT16_TILE
}

#endif

/* The sums of a block, at most BFLOAT16_ROWS rows of A of K inputs side by side, with a panel. */
static void bfloat16_sums(int64_t rows, int64_t K, gemm_a a, const float *panel, bfloat16_block *block) {
  for (int64_t k0 = 0; !k0 || k0 < K; k0 += BFLOAT16_DEPTH) {
    const int64_t n = min64(BFLOAT16_DEPTH, K - k0);
    if (block->k0 != k0)
      for (int64_t i = 0; i < rows; i++) bfloat16_round_row(a.data + i * a.row + k0, n, block->rows + i * BFLOAT16_ROW);
    block->k0 = k0;
    bfloat16_products(rows, round_up(n, BFLOAT16_STEP), block->rows, BFLOAT16_ROW, panel + k0 / 2 * GEMM_COLUMNS,
                      block->sums, GEMM_COLUMNS, k0);
  }
}

#endif
