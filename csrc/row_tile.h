/* The register tiles of the sparse convolution: products of rows that lie anywhere, without a copy of them.
 *
 *   row_panel:     out_i = base_i + sum_k A_ik B_kj     rows i of A and out by pointer, a panel of B packed (gemm.h)
 *   column_panel:  out_ij = base_ij + sum_k A_ki B_kj   rows k of A and B by pointer, out contiguous
 *
 * A strip has any number of rows i up to GEMM_ROWS: tiles are cut evenly, since the cut of gemm.h costs 6 to 19 % where
 * 48 pairs come at a time. A panel has up to GEMM_COLUMNS columns j. `base` is out itself or what it starts from (a
 * bias, nothing): so nothing is cleared beforehand, and no product is stored only to be added. The sum over k runs in
 * order for each element alone: its bits do not depend on the strip. Rows that are needed later are fetched a line at a
 * time between the steps of the sum: all at once they would fill the queue of cache misses, and the processor would
 * wait for it.
 */
#ifndef AST_ROW_TILE_H
#define AST_ROW_TILE_H

#include "gemm.h"

enum { LINE = 16 }; /* floats in a cache line */
_Static_assert(GEMM_ROWS <= 12 && GEMM_COLUMNS == 2 * VW, "a tile has at most 12 rows of 2 vectors");

/* How many strips n rows are cut into, evenly. */
AST_INLINE int64_t row_strips(int64_t n) { return divide_up(n, GEMM_ROWS); }

#define ROW_CASES(call) \
  switch (rows) {       \
    call(1);            \
    call(2);            \
    call(3);            \
    call(4);            \
    call(5);            \
    call(6);            \
    call(7);            \
    call(8);            \
    call(9);            \
    call(10);           \
    call(11);           \
    call(12);           \
  }

/* ---- rows of A ---- */

typedef struct {
  const float *const *a, *const *base; /* [rows] */
  float *const *out;                   /* [rows] */
} row_pointers;

/* Rows that are to be read and written later. */
typedef struct {
  const float *const *a;
  float *const *out;
  int64_t n;
} row_fetch;

AST_INLINE void row_tile(const int rows, const int vectors, int64_t K, row_pointers p, row_fetch next, const float *b,
                         int64_t column) {
  const float *a[GEMM_ROWS];
  vf sum[GEMM_ROWS][2];
  EACH(rows, i) {
    a[i] = p.a[i];
    EACH(vectors, j) sum[i][j] = (vf){0};
  }
  for (int64_t k0 = 0; k0 < K; k0 += LINE) {
    for (int64_t i = 0; i < next.n; i++) {
      __builtin_prefetch(next.a[i] + k0, 0, 2);
      __builtin_prefetch(next.out[i] + k0, 1, 2);
    }
    const int64_t end = min64(K, k0 + LINE);
    for (int64_t k = k0; k < end; k++) {
      vf b_k[2];
      EACH(vectors, j) b_k[j] = vload(b + k * GEMM_COLUMNS + j * VW);
      EACH(rows, i) {
        const vf a_ik = vsplat(a[i][k]);
        EACH(vectors, j) sum[i][j] += a_ik * b_k[j];
      }
    }
  }
  TILE_EACH(i, j) vstore(p.out[i] + column + j * VW, vload(p.base[i] + column + j * VW) + sum[i][j]);
}

AST_INLINE void row_strip(const int vectors, int64_t rows, int64_t K, row_pointers p, row_fetch next, const float *b,
                          int64_t column) {
#define ROW_CASE(n)                                                      \
  case n:                                                                \
    if ((n) <= GEMM_ROWS) row_tile((n), vectors, K, p, next, b, column); \
    return
  ROW_CASES(ROW_CASE)
#undef ROW_CASE
}

/* Columns [column, column + width) of out. */
AST_INLINE void row_panel(int64_t rows, int64_t width, int64_t K, row_pointers p, row_fetch next, const float *b,
                          int64_t column) {
  if (width == GEMM_COLUMNS) row_strip(2, rows, K, p, next, b, column);
  else if (width == VW) row_strip(1, rows, K, p, next, b, column);
  if (width % VW == 0) return;
  float part[GEMM_ROWS][GEMM_COLUMNS] = {{0}}, *to[GEMM_ROWS]; /* rows that end within a vector are copied in and out */
  const float *from[GEMM_ROWS];
  for (int64_t i = 0; i < rows; i++) {
    from[i] = to[i] = part[i];
    memcpy(part[i], p.base[i] + column, (size_t)width * sizeof(float));
  }
  row_strip(2, rows, K, (row_pointers){p.a, from, to}, next, b, 0);
  for (int64_t i = 0; i < rows; i++) memcpy(p.out[i] + column, part[i], (size_t)width * sizeof(float));
}

/* ---- columns of A ---- */

typedef struct {
  const float *const *a, *const *b, *const *next; /* [K]; next: rows of which a line is fetched */
  int64_t a_column, b_column, next_column;
} column_pointers;

AST_INLINE void column_tile(const int rows, const int vectors, int64_t K, column_pointers p, const float *base,
                            float *out, int64_t row) {
  vf sum[GEMM_ROWS][2];
  TILE_EACH(i, j) sum[i][j] = (vf){0};
  for (int64_t k = 0; k < K; k++) {
    __builtin_prefetch(p.next[k] + p.next_column, 0, 2);
    const float *a = p.a[k] + p.a_column, *b = p.b[k] + p.b_column;
    __asm__("" : "+r"(a), "+r"(b)); /* as pointers, or the compiler keeps a register for each offset */
    vf b_k[2];
    EACH(vectors, j) b_k[j] = vload(b + j * VW);
    EACH(rows, i) {
      const vf a_ki = vsplat(a[i]);
      EACH(vectors, j) sum[i][j] += a_ki * b_k[j];
    }
  }
  TILE_EACH(i, j) {
    const int64_t ij = i * row + j * VW;
    vstore(out + ij, base ? vload(base + ij) + sum[i][j] : sum[i][j]);
  }
}

AST_INLINE void column_strip(const int vectors, int64_t rows, int64_t K, column_pointers p, const float *base,
                             float *out, int64_t row) {
#define ROW_CASE(n)                                                        \
  case n:                                                                  \
    if ((n) <= GEMM_ROWS) column_tile((n), vectors, K, p, base, out, row); \
    return
  ROW_CASES(ROW_CASE)
#undef ROW_CASE
}

/* `width` columns of out, whose rows are `row` floats apart; rows of B are readable in whole vectors. base is out, or
 * NULL for 0. */
static inline void column_panel(int64_t rows, int64_t width, int64_t K, column_pointers p, const float *base,
                                float *out, int64_t row) {
  if (width == GEMM_COLUMNS) column_strip(2, rows, K, p, base, out, row);
  else if (width == VW) column_strip(1, rows, K, p, base, out, row);
  if (width % VW == 0) return;
  float part[GEMM_ROWS * GEMM_COLUMNS] = {0};
  for (int64_t i = 0; base && i < rows; i++)
    memcpy(part + i * GEMM_COLUMNS, base + i * row, (size_t)width * sizeof(float));
  column_strip(2, rows, K, p, part, part, GEMM_COLUMNS);
  for (int64_t i = 0; i < rows; i++) memcpy(out + i * row, part + i * GEMM_COLUMNS, (size_t)width * sizeof(float));
}

#endif
