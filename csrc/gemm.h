/* The register-blocked product that every dense kernel is built on.
 *
 * C_ij (+)= sum_k A_ik B_kj. A has any strides (so A^T needs no copy) and is read by broadcast; B is read in whole vectors,
 * either packed into panels of GEMM_COLUMNS columns or as rows of a row-major matrix whose width is a multiple of VW. A tile of
 * GEMM_ROWS x 2 vectors of C stays in registers over the whole k loop; K is never blocked (all K here are at most some hundred).
 */
#ifndef AST_GEMM_H
#define AST_GEMM_H

#include "simd.h"

#if AST_VECTOR_BYTES == 64
enum { GEMM_ROWS = 12 }; /* 24 accumulators + 2 of B + 1 of A in 32 registers */
#elif AST_VECTOR_BYTES == 32
enum { GEMM_ROWS = 6 }; /* 12 + 2 + 1 in 16 registers */
#else
enum { GEMM_ROWS = 4 }; /* 8 + 2 + 1, and one for the product that has no FMA */
#endif
enum { GEMM_COLUMNS = 2 * VW };

typedef struct {
  const float *data;
  int64_t row, column; /* strides in floats */
} gemm_a;

typedef struct {
  const float *data;
  int64_t row;   /* from one k to the next: GEMM_COLUMNS if packed */
  int64_t panel; /* from one panel of GEMM_COLUMNS columns to the next: K * GEMM_COLUMNS if packed, GEMM_COLUMNS if not */
} gemm_b;

AST_INLINE gemm_b gemm_rows(const float *b, int64_t stride) { return (gemm_b){b, stride, GEMM_COLUMNS}; }
AST_INLINE gemm_b gemm_packed(const float *b, int64_t K) { return (gemm_b){b, GEMM_COLUMNS, K * GEMM_COLUMNS}; }
AST_INLINE int64_t gemm_packed_size(int64_t K, int64_t N) { return K * round_up(N, GEMM_COLUMNS); }

/* out[k][j] = in[j][k] for a block of 4 x 4, out within a panel */
AST_INLINE void gemm_transpose4(const float *in, int64_t in_row, float *out) {
  typedef float v4 __attribute__((vector_size(16)));
  typedef float v4_unaligned __attribute__((vector_size(16), aligned(4), may_alias));
  v4 x[4];
#pragma GCC unroll 4
  for (int j = 0; j < 4; j++) x[j] = *(const v4_unaligned *)(in + j * in_row);
  const v4 low01 = {x[0][0], x[1][0], x[0][1], x[1][1]}, low23 = {x[2][0], x[3][0], x[2][1], x[3][1]};
  const v4 high01 = {x[0][2], x[1][2], x[0][3], x[1][3]}, high23 = {x[2][2], x[3][2], x[2][3], x[3][3]};
  const v4 y[4] = {{low01[0], low01[1], low23[0], low23[1]},
                   {low01[2], low01[3], low23[2], low23[3]},
                   {high01[0], high01[1], high23[0], high23[1]},
                   {high01[2], high01[3], high23[2], high23[3]}};
#pragma GCC unroll 4
  for (int k = 0; k < 4; k++) *(v4_unaligned *)(out + k * GEMM_COLUMNS) = y[k];
}

/* One panel of B_kj = b[k*row + j*column], j < N <= `width`, padded with zeros: `width` columns of the GEMM_COLUMNS of a panel. */
AST_INLINE void gemm_pack_columns(const float *b, int64_t row, int64_t column, int64_t K, int64_t N, const int64_t width, float *panel) {
  const int64_t wide = row == 1 && N == width ? K / 4 * 4 : 0;
  for (int64_t k = 0; k < wide; k += 4)
#pragma GCC unroll 8
    for (int64_t j = 0; j < width; j += 4) gemm_transpose4(b + k + j * column, column, panel + k * GEMM_COLUMNS + j);
  for (int64_t k = wide; k < K; k++) {
    float *out = panel + k * GEMM_COLUMNS;
    const float *in = b + k * row;
    if (column == 1) memcpy(out, in, (size_t)N * sizeof *out);
    else
      for (int64_t j = 0; j < N; j++) out[j] = in[j * column];
    for (int64_t j = N; j < width; j++) out[j] = 0;
  }
}

/* panels of B_kj = b[k*row + j*column], j < N, padded with zeros to whole panels */
static void gemm_pack(const float *b, int64_t row, int64_t column, int64_t K, int64_t N, float *panels) {
  for (int64_t j = 0; j < N; j += GEMM_COLUMNS)
    gemm_pack_columns(b + j * column, row, column, K, min64(GEMM_COLUMNS, N - j), GEMM_COLUMNS, panels + j * K);
}

/* sum_ij += sum_k A_ik B_kj in registers: `rows` and `vectors` are constants at every call, so that the loops over them unroll. */
AST_INLINE void gemm_sums(const int rows, const int vectors, int64_t K, gemm_a a, const float *b, int64_t b_row, vf sum[GEMM_ROWS][2]) {
  for (int64_t k = 0; k < K; k++) {
    vf b_k[2];
#pragma GCC unroll 2
    for (int j = 0; j < vectors; j++) b_k[j] = vload(b + k * b_row + j * VW);
#pragma GCC unroll 12
    for (int i = 0; i < rows; i++) {
      const vf a_ik = vsplat(a.data[i * a.row + k * a.column]);
#pragma GCC unroll 2
      for (int j = 0; j < vectors; j++) sum[i][j] += a_ik * b_k[j];
    }
  }
}

/* One register tile. */
AST_INLINE void gemm_tile(const int rows, const int vectors, int64_t K, gemm_a a, const float *b, int64_t b_row, float *c, int64_t c_row,
                          bool add) {
  vf sum[GEMM_ROWS][2];
#pragma GCC unroll 12
  for (int i = 0; i < rows; i++)
#pragma GCC unroll 2
    for (int j = 0; j < vectors; j++) sum[i][j] = (vf){0};
  gemm_sums(rows, vectors, K, a, b, b_row, sum);
#pragma GCC unroll 12
  for (int i = 0; i < rows; i++)
#pragma GCC unroll 2
    for (int j = 0; j < vectors; j++) {
      float *c_ij = c + i * c_row + j * VW;
      vstore(c_ij, add ? vload(c_ij) + sum[i][j] : sum[i][j]);
    }
}

AST_INLINE void gemm_strip(const int vectors, int64_t M, int64_t K, gemm_a a, const float *b, int64_t b_row, float *c, int64_t c_row,
                           bool add) {
  int64_t i = 0;
#define GEMM_STEP(rows)                \
  for (; i + (rows) <= M; i += (rows)) \
  gemm_tile(rows, vectors, K, (gemm_a){a.data + i * a.row, a.row, a.column}, b, b_row, c + i * c_row, c_row, add)
  GEMM_STEP(GEMM_ROWS);
  if (GEMM_ROWS > 8) GEMM_STEP(8);
  GEMM_STEP(4);
  GEMM_STEP(2);
  GEMM_STEP(1);
#undef GEMM_STEP
}

/* C [M,N] (+)= A [M,K] B [K,N], N a multiple of VW, rows of C c_row floats apart. */
static void gemm(int64_t M, int64_t N, int64_t K, gemm_a a, gemm_b b, float *c, int64_t c_row, bool add) {
  for (int64_t j = 0; j < N; j += GEMM_COLUMNS) {
    const float *panel = b.data + j / GEMM_COLUMNS * b.panel;
    if (N - j >= GEMM_COLUMNS) gemm_strip(2, M, K, a, panel, b.row, c + j, c_row, add);
    else gemm_strip(1, M, K, a, panel, b.row, c + j, c_row, add);
  }
}

#endif
