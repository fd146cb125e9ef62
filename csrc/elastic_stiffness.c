/* The stiffness of elastic tetrahedra: the second derivative of their energy by the positions, in double.
 *
 * The energy density at a point of an element depends on F = sum_a x_a (x) grad N_a alone. With T = F^-T and J = det F,
 * its second derivative by F and the block of the nodes a and b are
 *
 *   dF -> mu dF + spread (T : dF) T - c T dF^T T
 *   K_ab = V [mu (grad N_a . grad N_b) I + spread g_a (x) g_b - c g_b (x) g_a],  g_a = T grad N_a
 *
 * for Ciarlet's law with spread = lambda J^2 and c = lambda/2 (J^2 - 1) - mu. Projected, the negative eigenvalues by F
 * are replaced by zero. With F = sum_i s_i u_i v_i^T its eigenvectors are of two kinds (Smith et al. 2019). Each two
 * axes i and j have the twist u_i v_j^T - u_j v_i^T with the eigenvalue mu + c / (s_i s_j) and the flip
 * u_i v_j^T + u_j v_i^T with mu - c / (s_i s_j); at most one of them is negative. Both have the length sqrt(2). The
 * other three are sum_i w_i u_i v_i^T, with w an eigenvector of
 *
 *   A_ij = delta_ij (mu - c / s_i^2) + spread / (s_i s_j),
 *
 * which has no negative eigenvalue unless c is positive or spread is negative. An eigenvector D with the eigenvalue -x
 * adds V x b (x) b with b_a = D grad N_a.
 *
 * E elements with Q points and K nodes each. An entry of a symmetric 3 K x 3 K matrix costs 5 operations a point, and 2
 * for each negative eigenvalue; it is written once, which takes most of the time of linear elements. VW elements are
 * computed at once.
 */
#include <math.h>

#include "ast.h"
#include "simd.h"

enum {
  STIFFNESS_ELEMENTS = 512, /* elements a task */
  STIFFNESS_SWEEPS = 12,    /* of rotations at most; they converge quadratically, in four or five */
  STIFFNESS_NODES = 10,     /* of an element, at most */
  STIFFNESS_ENTRIES = 3 * STIFFNESS_NODES * (3 * STIFFNESS_NODES + 1) / 2
};

typedef double stiffness_unaligned __attribute__((vector_size(2 * AST_VECTOR_BYTES), aligned(8), may_alias));

/* n <= VW doubles; the last one stands in for the missing ones. */
AST_INLINE vd stiffness_load(const double *p, int64_t n) {
  if (n == VW) return *(const stiffness_unaligned *)p;
  vd x;
  for (int lane = 0; lane < VW; lane++) x[lane] = p[min64(lane, n - 1)];
  return x;
}

AST_INLINE void stiffness_store(double *p, vd x, int64_t n) {
  if (n == VW) *(stiffness_unaligned *)p = x;
  else
    for (int lane = 0; lane < n; lane++) p[lane] = x[lane];
}

AST_INLINE vd stiffness_select(vl mask, vd a, vd b) { return (vd)((mask & (vl)a) | (~mask & (vl)b)); }
AST_INLINE vd stiffness_larger(vd a, vd b) { return stiffness_select(a > b, a, b); }
/* |x| with the sign of y */
AST_INLINE vd stiffness_signed(vd x, vd y) { return (vd)(((vl)x & INT64_MAX) | ((vl)y & INT64_MIN)); }

AST_INLINE vd stiffness_root(vd x) {
  vd root;
  EACH(VW, lane) root[lane] = sqrt(x[lane]);
  return root;
}

AST_INLINE bool stiffness_any(vl mask) {
  int64_t any = 0;
  EACH(VW, lane) any |= mask[lane];
  return any != 0;
}

/* Eigenvalues, in no order, and eigenvectors, one a row, of symmetric matrices, by Jacobi's rotations. */
static void stiffness_eigenvectors(vd matrix[3][3], vd value[3], vd vector[3][3]) {
  vd beside[3] = {matrix[1][2], matrix[0][2], matrix[0][1]}, largest = {0}; /* by the third axis */
  EACH(3, i) EACH(3, j) {
    largest = stiffness_larger(vmagnitude(matrix[i][j]), largest);
    vector[i][j] = (vd){0} + (i == j);
  }
  EACH(3, i) value[i] = matrix[i][i];
  const vd rounding = 0x1p-52 * largest;
  for (int sweep = 0; sweep < STIFFNESS_SWEEPS; sweep++) {
    const vd most =
        stiffness_larger(stiffness_larger(vmagnitude(beside[0]), vmagnitude(beside[1])), vmagnitude(beside[2]));
    if (!stiffness_any(most > rounding)) return;
    EACH(3, turn) {
      const int p = turn / 2, q = 1 + (turn + 1) / 2, r = 2 - turn; /* 0 1 2, 0 2 1, 1 2 0 */
      const vd half = (value[q] - value[p]) / 2, b = beside[r];
      const vd length = vmagnitude(half) + stiffness_root(half * half + b * b);
      const vd share = vmagnitude(b) / stiffness_larger(length, (vd){0} + 0x1p-1022);
      const vd tangent = stiffness_signed(share, (vd)((vl)b ^ (vl)half));
      const vd cosine = 1 / stiffness_root(1 + tangent * tangent), sine = tangent * cosine;
      value[p] -= tangent * b, value[q] += tangent * b;
      beside[r] = (vd){0};
      const vd beside_q = cosine * beside[q] - sine * beside[p];
      beside[p] = sine * beside[q] + cosine * beside[p], beside[q] = beside_q;
      EACH(3, i) {
        const vd vector_p = cosine * vector[p][i] - sine * vector[q][i];
        vector[q][i] = sine * vector[p][i] + cosine * vector[q][i], vector[p][i] = vector_p;
      }
    }
  }
}

/* What is known of a point of VW elements. */
typedef struct {
  vd F[3][3], T[3][3], gradients[STIFFNESS_NODES][3];
  vd J, volume, mu, c, spread;
} stiffness_point;

AST_INLINE void stiffness_read(const int K, const ast_stiffness *s, int64_t point, int64_t n, stiffness_point *at) {
  const int64_t stride = s->Q * s->E;
  EACH(9, k) at->F[k / 3][k % 3] = stiffness_load(s->F + k * stride + point, n);
  for (int k = 0; k < 3 * K; k++) at->gradients[k / 3][k % 3] = stiffness_load(s->gradients + k * stride + point, n);
  at->volume = stiffness_load(s->volume + point, n), at->mu = stiffness_load(s->mu + point, n);
  at->c = stiffness_load(s->c + point, n), at->spread = stiffness_load(s->spread + point, n);
  EACH(3, i) EACH(3, j) {
    const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
    at->T[i][j] = at->F[i1][j1] * at->F[i2][j2] - at->F[i1][j2] * at->F[i2][j1];
  }
  at->J = at->F[0][0] * at->T[0][0] + at->F[0][1] * at->T[0][1] + at->F[0][2] * at->T[0][2];
  EACH(9, k) at->T[k / 3][k % 3] /= at->J;
}

AST_INLINE vd stiffness_dot(const vd a[3], const vd b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* Adds the second derivative to the upper entries, row by row. */
AST_INLINE void stiffness_add(const int K, const stiffness_point *at, vd *entries) {
  vd g[3 * STIFFNESS_NODES];
  for (int p = 0; p < 3 * K; p++) g[p] = stiffness_dot(at->T[p % 3], at->gradients[p / 3]);
  const vd direct = at->volume * at->spread, turned = -at->volume * at->c, alone = at->volume * at->mu;
  for (int p = 0; p < 3 * K; p++) {
    const int a = p / 3, i = p % 3;
    const vd row = direct * g[p];
    for (int q = p; q < 3 * K; q++) {
      const int b = q / 3, j = q % 3;
      *entries += row * g[q] + turned * (g[3 * b + i] * g[3 * a + j]);
      if (i == j) *entries += alone * stiffness_dot(at->gradients[a], at->gradients[b]);
      entries++;
    }
  }
}

/* Adds scale b (x) b to the upper entries. */
AST_INLINE void stiffness_lift(const int K, const vd *b, vd scale, vd *entries) {
  for (int p = 0; p < 3 * K; p++) {
    const vd row = scale * b[p];
    for (int q = p; q < 3 * K; q++) *entries++ += row * b[q];
  }
}

/* Adds what makes the negative eigenvalues zero; whether the stretches of all elements are known. */
AST_INLINE bool stiffness_project(const int K, stiffness_point *at, vd *entries) {
  vd C[3][3], squares[3], v[3][3], u[3][3], across[3][STIFFNESS_NODES], inverse[3], b[3 * STIFFNESS_NODES];
  EACH(3, i) EACH(3, j) C[i][j] = at->F[0][i] * at->F[0][j] + at->F[1][i] * at->F[1][j] + at->F[2][i] * at->F[2][j];
  stiffness_eigenvectors(C, squares, v);
  const vd most = stiffness_larger(stiffness_larger(squares[0], squares[1]), squares[2]);
  bool known = true;
  EACH(3, k) {
    known &= !stiffness_any(~(squares[k] > 0x1p-52 * most));
    inverse[k] = 1 / stiffness_root(squares[k]);
    EACH(3, i) u[k][i] = stiffness_dot(at->F[i], v[k]) * inverse[k];
    for (int a = 0; a < K; a++) across[k][a] = stiffness_dot(at->gradients[a], v[k]);
  }
  for (int k = 0; k < 3; k++) {
    const int i = (k + 1) % 3, j = (k + 2) % 3;
    const vd value = at->mu - vmagnitude(at->c) * inverse[i] * inverse[j];
    if (!stiffness_any(value < 0)) continue;
    const vd twisted = stiffness_signed((vd){0} + 1, at->c);
    for (int p = 0; p < 3 * K; p++) b[p] = across[j][p / 3] * u[i][p % 3] + twisted * across[i][p / 3] * u[j][p % 3];
    stiffness_lift(K, b, stiffness_select(value < 0, -value / 2 * at->volume, (vd){0}), entries);
  }
  if (!stiffness_any((at->c > 0) | (at->spread < 0))) return known;
  vd A[3][3], value[3], w[3][3];
  EACH(3, i) EACH(3, j) A[i][j] = at->spread * inverse[i] * inverse[j];
  EACH(3, i) A[i][i] += at->mu - at->c * inverse[i] * inverse[i];
  stiffness_eigenvectors(A, value, w);
  for (int k = 0; k < 3; k++) {
    if (!stiffness_any(value[k] < 0)) continue;
    for (int p = 0; p < 3 * K; p++) {
      b[p] = (vd){0};
      EACH(3, i) b[p] += w[k][i] * across[i][p / 3] * u[i][p % 3];
    }
    stiffness_lift(K, b, stiffness_select(value[k] < 0, -value[k] * at->volume, (vd){0}), entries);
  }
  return known;
}

/* The entries of n <= VW elements from e on. */
AST_INLINE bool stiffness_block(const int K, const int Q, const ast_stiffness *s, int64_t e, int64_t n, double *out) {
  vd entries[STIFFNESS_ENTRIES];
  const int num = 3 * K * (3 * K + 1) / 2;
  bool known = true;
  for (int k = 0; k < num; k++) entries[k] = (vd){0};
  for (int64_t q = 0; q < Q; q++) {
    stiffness_point at;
    stiffness_read(K, s, q * s->E + e, n, &at);
    stiffness_add(K, &at, entries);
    if (s->project) known &= stiffness_project(K, &at, entries);
  }
  for (int k = 0; k < num; k++) stiffness_store(out + k * s->E + e, entries[k], n);
  return known;
}

typedef struct {
  const ast_stiffness *elements;
  double *entries;
} stiffness_job;

static ast_status stiffness_task(int64_t index, void *context) {
  const stiffness_job *job = context;
  const ast_stiffness *s = job->elements;
  const int64_t end = min64(s->E, (index + 1) * STIFFNESS_ELEMENTS);
  bool known = true;
  for (int64_t e = index * STIFFNESS_ELEMENTS; e < end; e += VW) {
    const int64_t n = min64(VW, end - e);
    known &= s->K == 4 ? stiffness_block(4, 1, s, e, n, job->entries) : stiffness_block(10, 4, s, e, n, job->entries);
  }
  return known ? AST_OK : AST_NOT_FINITE;
}

static ast_status elastic_stiffness(const ast_stiffness *s, double *restrict entries) {
  stiffness_job job = {s, entries};
  return ast_parallel(divide_up(s->E, STIFFNESS_ELEMENTS), stiffness_task, &job);
}
