/* The step of Muon (Jordan et al. 2024): matrices with all singular values moved to about 1.
 *
 *   z = x / |x|, with the Frobenius norm; then five times  z <- z (a I + b G + c G^2),  G = z^T z
 *
 * K matrices x [R,C], one a task. z is x, or its transpose if that is tall: [tall, wide], so that G is of the smaller
 * side. Columns are padded with zeros to whole vectors; the products leave them 0. G and G^2 are symmetric: blocks of
 * VW x VW on and above the diagonal are computed, the others copied. A matrix of 64 x 64 stays in the second cache at
 * most: its flops are the limit, 2 (tall wide^2 (1/2 + 1) + wide^3 / 2) an iteration.
 */
#include <math.h>

#include "ast.h"
#include "simd.h"

enum { ORTHOGONALIZE_ITERATIONS = 5 };
/* They move a singular value from [0.002, 1] into [0.68, 1.21]. */
static const float ORTHOGONALIZE_A = 3.4445f, ORTHOGONALIZE_B = -4.7750f, ORTHOGONALIZE_C = 2.0315f;

typedef struct {
  const float *x;
  int64_t R, C;
  float *out;
} orthogonalize_job;

/* out[j][i] = in[i][j] for j < columns and i < width, where in[i] is 0 from `rows` on. */
static void orthogonalize_transpose(const float *in, int64_t rows, int64_t columns, int64_t in_row, float *out,
                                    int64_t width, int64_t out_row) {
  for (int64_t i = 0; i < width; i += VW)
    for (int64_t j = 0; j < columns; j += VW) {
      vf x[VW];
      for (int k = 0; k < VW; k++) x[k] = i + k < rows ? vload_upto(in + (i + k) * in_row + j, columns - j) : (vf){0};
      vtranspose(x);
      for (int k = 0; k < min64(VW, columns - j); k++) vstore_upto(out + (j + k) * out_row + i, x[k], width - i);
    }
}

/* The sum of squares of n floats, none of which overflows: eight chains, so that it does not wait for each sum. */
static double orthogonalize_squares(const float *x, int64_t n) {
  enum { CHAINS = 8 };
  double sum[CHAINS] = {0};
  int64_t i = 0;
  for (; i + CHAINS <= n; i += CHAINS)
    for (int k = 0; k < CHAINS; k++) sum[k] += (double)x[i + k] * (double)x[i + k];
  for (; i < n; i++) sum[i % CHAINS] += (double)x[i] * (double)x[i];
  return ((sum[0] + sum[4]) + (sum[2] + sum[6])) + ((sum[1] + sum[5]) + (sum[3] + sum[7]));
}

/* s = a^T a, where a [K,n] and s [n,n] have rows of n floats, n a multiple of VW. */
static __attribute__((noinline)) void orthogonalize_gram(int64_t K, int64_t n, const float *a, float *s) {
  for (int64_t j = 0; j < n; j += GEMM_COLUMNS) {
    const gemm_a all = {a, 1, n}, last = {a + j + VW, 1, n};
    if (n - j < GEMM_COLUMNS) {
      gemm_strip(1, j + VW, K, all, a + j, n, s + j, n, false);
      break;
    }
    gemm_strip(2, j + VW, K, all, a + j, n, s + j, n, false);
    gemm_strip(1, VW, K, last, a + j + VW, n, s + (j + VW) * n + j + VW, n, false);
  }
  for (int64_t j = VW; j < n; j += VW) orthogonalize_transpose(s + j, j, VW, n, s + j * n, j, n);
}

/* z times p: z and out [M,n], p [n,n]. */
static __attribute__((noinline)) void orthogonalize_apply(int64_t M, int64_t n, const float *z, const float *p,
                                                          float *out) {
  gemm_inlined(M, n, n, (gemm_a){z, n, 1}, p, n, out, n, false);
}

static ast_status orthogonalize_task(int64_t index, void *context) {
  const orthogonalize_job *job = context;
  const int64_t R = job->R, C = job->C, tall = max64(R, C), wide = min64(R, C), n = round_up(wide, VW);
  const float *x = job->x + index * R * C;
  float *out = job->out + index * R * C;
  float *z = ast_scratch(2 * n * (tall + n) * (int64_t)sizeof *z);
  if (!z) return AST_NO_MEMORY;
  float *next = z + tall * n, *G = next + tall * n, *square = G + n * n;
  if (R < C) orthogonalize_transpose(x, R, C, C, z, n, n);
  else
    for (int64_t i = 0; i < R; i++)
      for (int64_t j = 0; j < n; j++) z[i * n + j] = j < C ? x[i * C + j] : 0;
  double norm = sqrt(orthogonalize_squares(x, R * C));
  if (norm < 1e-37) norm = 1e-37;
  const double factor = 1 / norm; /* in double, since neither it nor the norm need fit into a float */
  for (int64_t i = 0; i < tall * n; i++) z[i] = (float)((double)z[i] * factor);
  for (int iteration = 0; iteration < ORTHOGONALIZE_ITERATIONS; iteration++) {
    orthogonalize_gram(tall, n, z, G);
    orthogonalize_gram(n, n, G, square);
    for (int64_t i = 0; i < n * n; i++) G[i] = ORTHOGONALIZE_B * G[i] + ORTHOGONALIZE_C * square[i];
    for (int64_t i = 0; i < n; i++) G[i * n + i] += ORTHOGONALIZE_A;
    orthogonalize_apply(tall, n, z, G, next);
    float *const before = z;
    z = next;
    next = before;
  }
  if (R < C) orthogonalize_transpose(z, tall, wide, n, out, tall, tall);
  else
    for (int64_t i = 0; i < R; i++) memcpy(out + i * C, z + i * n, (size_t)C * sizeof *out);
  return AST_OK;
}

static ast_status orthogonalize(const float *restrict x, int64_t K, int64_t R, int64_t C, float *restrict out) {
  orthogonalize_job job = {x, R, C, out};
  return R && C ? ast_parallel(K, orthogonalize_task, &job) : AST_OK;
}
