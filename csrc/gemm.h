/* The register-blocked product that every dense kernel is built on.
 *
 * C_ij (+)= sum_k A_ik B_kj. A has any strides (so A^T needs no copy) and is read by broadcast; B is read in whole
 * vectors, from a panel of GEMM_COLUMNS columns or from rows of a matrix. A tile of GEMM_ROWS x 2 vectors of C stays in
 * registers over the whole k loop.
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

AST_INLINE int64_t gemm_packed_size(int64_t K, int64_t N) { return K * round_up(N, GEMM_COLUMNS); }

/* out[k][j] = in[j][k] for n rows j of m columns k, both at most VW; out has VW columns within a panel, 0 from n on. */
AST_INLINE void gemm_transpose(const float *in, int64_t in_row, const int64_t n, const int64_t m, float *out) {
  vf x[VW];
  EACH(VW, j) x[j] = j < n ? vload_upto(in + j * in_row, m) : (vf){0};
  vtranspose(x);
  EACH(VW, k) {
    if (k < m) vstore(out + k * GEMM_COLUMNS, x[k]);
  }
}

/* The same for blocks at the end; out of line, as it is long. */
static __attribute__((noinline)) void gemm_transpose_part(const float *in, int64_t in_row, int64_t n, int64_t m,
                                                          float *out) {
  gemm_transpose(in, in_row, n, m, out);
}

/* One panel of B_kj = b[k*row + j*column], row or column 1, j < N <= `width`: that many of the GEMM_COLUMNS columns of
 * a panel, padded with zeros. */
AST_INLINE void gemm_pack_columns(const float *b, int64_t row, int64_t column, int64_t K, int64_t N,
                                  const int64_t width, float *panel) {
  if (row == 1) {
    for (int64_t j = 0; j < width; j += VW)
      for (int64_t k0 = 0; k0 < K; k0 += VW) {
        const int64_t k =
            max64(0, min64(k0, K - VW)); /* the last block overlaps the one before rather than end within it */
        const float *in = b + k + j * column;
        float *out = panel + k * GEMM_COLUMNS + j;
        if (N - j >= VW && K >= VW) gemm_transpose(in, column, VW, VW, out);
        else gemm_transpose_part(in, column, N - j, min64(VW, K), out);
      }
    return;
  }
  for (int64_t k = 0; k < K; k++) {
    float *out = panel + k * GEMM_COLUMNS;
    for (int64_t j = 0; j < width; j += VW) vstore(out + j, vload_upto(b + k * row + j, N - j));
  }
}

/* panels of B_kj = b[k*row + j*column], j < N, padded with zeros to whole panels */
static inline void gemm_pack(const float *b, int64_t row, int64_t column, int64_t K, int64_t N, float *panels) {
  for (int64_t j = 0; j < N; j += GEMM_COLUMNS)
    gemm_pack_columns(b + j * column, row, column, K, min64(GEMM_COLUMNS, N - j), GEMM_COLUMNS, panels + j * K);
}

/* sum_ij += sum_k A_ik B_kj in registers: `rows` and `vectors` are constants at every call, so that the loops over them
 * unroll. */
AST_INLINE void gemm_sums(const int rows, const int vectors, int64_t K, gemm_a a, const float *b, int64_t b_row,
                          vf sum[GEMM_ROWS][2]) {
  for (int64_t k = 0; k < K; k++) {
    vf b_k[2];
    EACH(vectors, j) b_k[j] = vload(b + k * b_row + j * VW);
    EACH(rows, i) {
      const vf a_ik = vsplat(a.data[i * a.row + k * a.column]);
      EACH(vectors, j) sum[i][j] += a_ik * b_k[j];
    }
  }
}

/* for all vectors of a register tile */
#define TILE_EACH(i, v) \
  _Pragma("GCC unroll 12") for (int i = 0; i < rows; i++) _Pragma("GCC unroll 2") for (int v = 0; v < vectors; v++)

/* Cuts n rows into register tiles: calls tile(rows) for the rows i, i + 1, ... with a constant number of them. Where
 * there are tiles of 12 the last 16 are 8 and 8. */
#define EACH_TILE_OF_ROWS(i, n, tile)                                            \
  do {                                                                           \
    int64_t i = 0;                                                               \
    TILES_OF_ROWS(i, GEMM_ROWS > 8 && (n) - i == 16 ? 0 : (n), GEMM_ROWS, tile); \
    if (GEMM_ROWS > 8) TILES_OF_ROWS(i, n, 8, tile);                             \
    TILES_OF_ROWS(i, n, 4, tile);                                                \
    TILES_OF_ROWS(i, n, 2, tile);                                                \
    TILES_OF_ROWS(i, n, 1, tile);                                                \
  } while (0)
#define TILES_OF_ROWS(i, n, rows, tile) \
  for (; i + (rows) <= (n); i += (rows)) tile(rows)

/* sum_ij = sum_k A_ik B_kj */
AST_INLINE void gemm_product(const int rows, const int vectors, int64_t K, gemm_a a, const float *b, int64_t b_row,
                             vf sum[GEMM_ROWS][2]) {
  TILE_EACH(i, v) sum[i][v] = (vf){0};
  gemm_sums(rows, vectors, K, a, b, b_row, sum);
}

/* One register tile of C. */
AST_INLINE void gemm_tile(const int rows, const int vectors, int64_t K, gemm_a a, const float *b, int64_t b_row,
                          float *c, int64_t c_row, bool add) {
  vf sum[GEMM_ROWS][2];
  gemm_product(rows, vectors, K, a, b, b_row, sum);
  TILE_EACH(i, v) {
    float *c_iv = c + i * c_row + v * VW;
    vstore(c_iv, add ? vload(c_iv) + sum[i][v] : sum[i][v]);
  }
}

AST_INLINE void gemm_strip(const int vectors, int64_t M, int64_t K, gemm_a a, const float *b, int64_t b_row, float *c,
                           int64_t c_row, bool add) {
#define GEMM_TILE(rows) \
  gemm_tile(rows, vectors, K, (gemm_a){a.data + i * a.row, a.row, a.column}, b, b_row, c + i * c_row, c_row, add)
  EACH_TILE_OF_ROWS(i, M, GEMM_TILE);
#undef GEMM_TILE
}

/* C [M,N] (+)= A [M,K] B [K,N], N a multiple of VW, rows of B and C b_row and c_row floats apart. */
AST_INLINE void gemm_inlined(int64_t M, int64_t N, int64_t K, gemm_a a, const float *b, int64_t b_row, float *c,
                             int64_t c_row, bool add) {
  for (int64_t j = 0; j < N; j += GEMM_COLUMNS) {
    if (N - j >= GEMM_COLUMNS) gemm_strip(2, M, K, a, b + j, b_row, c + j, c_row, add);
    else gemm_strip(1, M, K, a, b + j, b_row, c + j, c_row, add);
  }
}

/* C (+)= A^T B, rows of A [K,M] a_row floats apart. Its other stride, 1, is a constant in this function. */
static __attribute__((noinline)) void gemm(int64_t M, int64_t N, int64_t K, const float *a, int64_t a_row,
                                           const float *b, int64_t b_row, float *c, int64_t c_row, bool add) {
  gemm_inlined(M, N, K, (gemm_a){a, 1, a_row}, b, b_row, c, c_row, add);
}

#endif
