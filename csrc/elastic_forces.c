/* The elastic forces of St. Venant-Kirchhoff tetrahedra, and the product of their Jacobian with a direction.
 *
 * Element e with nodes 0..3 has the edges D at rest and the edges d in the guess, as columns:
 *
 *   D = [X1 - X0, X2 - X0, X3 - X0],  d = [x1 - x0, x2 - x0, x3 - x0],  V = |det D| / 6
 *   F = d D^-1,  A = (d - D) D^-1 = F - I,  2 G = A + A^T + A^T A = F^T F - I,  S = lambda tr(G) I + 2 mu G
 *   [f1, f2, f3] = -V F S D^-T = -sign(det D) / 6 F S cof(D),  f0 = -(f1 + f2 + f3)
 *
 * and in a direction v of the positions, with dF = dv D^-1:
 *
 *   2 dG = F^T dF + dF^T F,  dS = lambda tr(dG) I + 2 mu dG,  [df1, df2, df3] = -sign(det D) / 6 (dF S + F dS) cof(D)
 *
 * The energy V (lambda/2 tr(G)^2 + mu G:G) is a polynomial of the positions: forces are finite for any guess, also for
 * one turned inside out. f = -dE/dx, so its Jacobian is symmetric: the product with dforce is the gradient dposition.
 *
 * A instead of F - I: at rest the forces are exactly 0, and near it they do not drown in the rounding of 1.
 *
 * N nodes, E elements. About 350 operations an element forward, 80 of them in double, and 530 in a direction, on 4 x 24
 * bytes of coordinates: arithmetic is the limit. VW elements are computed at once: their corners are transposed into
 * one vector per coordinate, and the forces back into 16 floats per element. Then each node adds the forces of its
 * corners in stored order, by chains whose sums are added by halves, so that the result depends on neither threads
 * nor batch.
 */
#include "ast.h"
#include "simd.h"

enum {
  ELASTIC_ELEMENTS = 2048, /* elements a task: large enough to pay for the hand-over */
  ELASTIC_NODES = 2048,    /* nodes a task */
  ELASTIC_CHAIN = 256,     /* corners of one chain of a sum at most: its rounding errors grow with their number */
  CORNERS = 16             /* floats of the corners of an element: 4 x (x, y, z, unused) */
};

/* A rest volume below this share of the sum of the magnitudes of its products may be rounding alone: 8 roundings of
 * 2^-24. */
static const double ELASTIC_FLAT = 0x1p-21;

typedef float corner __attribute__((vector_size(16), aligned(4), may_alias));

typedef struct {
  const ast_elastic *mesh;
  const float *position, *rest,
      *direction; /* copies that may be read one float past the end; direction is NULL for the forces */
  float *forces;  /* [E up to a multiple of VW,CORNERS] */
  float *out;     /* [N,3] */
} elastic_job;

/* ---- corners of VW elements <-> one vector per coordinate ---- */

/* Of vectors in blocks of four: a0 b0 a1 b1, a2 b2 a3 b3, a0 a1 b0 b1, a2 a3 b2 b3 of each block; then the numbers at
 * even and odd places. */
#if AST_VECTOR_BYTES == 64
#define BLOCKS(a, b, i, j, k, l) \
  VSHUFFLE(a, b, i, j, k, l, i + 4, j + 4, k + 4, l + 4, i + 8, j + 8, k + 8, l + 8, i + 12, j + 12, k + 12, l + 12)
#define EVEN(a, b) VSHUFFLE(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30)
#define ODD(a, b)  VSHUFFLE(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31)
#elif AST_VECTOR_BYTES == 32
#define BLOCKS(a, b, i, j, k, l) VSHUFFLE(a, b, i, j, k, l, i + 4, j + 4, k + 4, l + 4)
#define EVEN(a, b)               VSHUFFLE(a, b, 0, 2, 4, 6, 8, 10, 12, 14)
#define ODD(a, b)                VSHUFFLE(a, b, 1, 3, 5, 7, 9, 11, 13, 15)
#else
#define BLOCKS(a, b, i, j, k, l) VSHUFFLE(a, b, i, j, k, l)
#define EVEN(a, b)               VSHUFFLE(a, b, 0, 2, 4, 6)
#define ODD(a, b)                VSHUFFLE(a, b, 1, 3, 5, 7)
#endif
#define BLOCKS_LOW(a, b)   BLOCKS(a, b, 0, VW, 1, VW + 1)
#define BLOCKS_HIGH(a, b)  BLOCKS(a, b, 2, VW + 2, 3, VW + 3)
#define BLOCKS_FIRST(a, b) BLOCKS(a, b, 0, 1, VW, VW + 1)
#define BLOCKS_LAST(a, b)  BLOCKS(a, b, 2, 3, VW + 2, VW + 3)

/* Four floats from node nodes[16 b] on in each block b: the same corner of every fourth element. */
AST_INLINE vf elastic_load(const float *x, const int64_t *nodes) {
#if AST_VECTOR_BYTES == 16
  return *(const corner *)(x + 3 * nodes[0]);
#elif !__has_builtin(__builtin_shufflevector) /* GCC 11, which cannot join vectors otherwise */
  float corners[VW];
#pragma GCC unroll 4
  for (int block = 0; block < VW / 4; block++) memcpy(corners + 4 * block, x + 3 * nodes[16 * block], 4 * sizeof *x);
  return vload(corners);
#else
  typedef float pair __attribute__((vector_size(32)));
  const corner a = *(const corner *)(x + 3 * nodes[0]), b = *(const corner *)(x + 3 * nodes[16]);
  const pair ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
#if AST_VECTOR_BYTES == 32
  return ab;
#else
  const corner c = *(const corner *)(x + 3 * nodes[32]), d = *(const corner *)(x + 3 * nodes[48]);
  return __builtin_shufflevector(ab, (pair)__builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7), 0, 1, 2, 3, 4, 5, 6,
                                 7, 8, 9, 10, 11, 12, 13, 14, 15);
#endif
#endif
}

/* edges[i][j]: coordinate i of x_(j+1) - x_0 of VW elements. */
AST_INLINE void elastic_edges(const float *x, const int64_t *elements, vf edges[3][3]) {
  vf origin[3];
  EACH(4, j) {
    const vf a = elastic_load(x, elements + j), b = elastic_load(x, elements + 4 + j);
    const vf c = elastic_load(x, elements + 8 + j), d = elastic_load(x, elements + 12 + j);
    const vf low[2] = {BLOCKS_LOW(a, b), BLOCKS_LOW(c, d)}, high[2] = {BLOCKS_HIGH(a, b), BLOCKS_HIGH(c, d)};
    const vf at[3] = {BLOCKS_FIRST(low[0], low[1]), BLOCKS_LAST(low[0], low[1]), BLOCKS_FIRST(high[0], high[1])};
    EACH(3, i) {
      if (j == 0) origin[i] = at[i];
      else edges[i][j - 1] = at[i] - origin[i];
    }
  }
}

/* Writes H, the forces on nodes 1 to 3 as columns, and the force on node 0; 0 where the mask is not set. */
AST_INLINE void elastic_write(vf H[3][3], vi used, float *forces) {
  vf row[CORNERS];
  EACH(3, i) {
    row[i] = vselect(used, -(H[i][0] + H[i][1] + H[i][2]), (vf){0});
    EACH(3, j) row[4 * (j + 1) + i] = vselect(used, H[i][j], (vf){0});
  }
  EACH(4, j) row[4 * j + 3] = (vf){0};
#pragma GCC unroll 4
  for (int part = 0; part < CORNERS; part += VW) {
    vtranspose(row + part);
    EACH(VW, i) vstore(forces + i * CORNERS + part, row[part + i]);
  }
}

/* ---- 3 x 3 matrices, one per lane ---- */

/* C = A B, or A^T B */
AST_INLINE void elastic_product(const bool transposed, vf A[3][3], vf B[3][3], vf C[3][3]) {
  EACH(3, i) EACH(3, j) {
    const vf a = transposed ? A[0][i] : A[i][0], b = transposed ? A[1][i] : A[i][1], c = transposed ? A[2][i] : A[i][2];
    C[i][j] = a * B[0][j] + b * B[1][j] + c * B[2][j];
  }
}

/* S = lambda/2 tr(M) I + mu M of a symmetric M = 2 G */
AST_INLINE void elastic_stress(vf lambda, vf mu, vf M[3][3], vf S[3][3]) {
  const vf pressure = 0.5f * lambda * (M[0][0] + M[1][1] + M[2][2]);
  EACH(3, i) EACH(3, j) S[i][j] = i == j ? mu * M[i][j] + pressure : mu * M[i][j];
}

/* D in double: the products of two edges are exact, so that D^-1 is rounded but once, however flat the element. Edges
 * of any float are in the range of their volumes, whatever the unit of length.
 *
 * What the rest edges D of an element say: whether it counts, D^-1, and area = -V D^-T = -sign(det D) / 6 cof(D). */
typedef struct {
  vi counts;
  vf D[3][3], inverse[3][3], area[3][3];
} elastic_rest;

AST_INLINE elastic_rest elastic_measure(const float *rest, const int64_t *elements) {
  elastic_rest r;
  vd D[3][3], cofactor[3][3], size = {0};
  elastic_edges(rest, elements, r.D);
  EACH(9, k) D[k / 3][k % 3] = __builtin_convertvector(r.D[k / 3][k % 3], vd);
  EACH(3, i) EACH(3, j) {
    const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
    const vd plus = D[i1][j1] * D[i2][j2], minus = D[i2][j1] * D[i1][j2];
    cofactor[i][j] = plus - minus;
    if (j == 0) size += vmagnitude(D[i][0]) * (vmagnitude(plus) + vmagnitude(minus));
  }
  const vd det = D[0][0] * cofactor[0][0] + D[1][0] * cofactor[1][0] + D[2][0] * cofactor[2][0];
  const vd per_det = 1.0 / det, sixth = vmagnitude(det) * per_det * (-1.0 / 6);
  vf zero = {0}; /* NaN where an entry of the inverse is not finite */
  EACH(3, i) EACH(3, j) {
    r.inverse[j][i] = __builtin_convertvector(cofactor[i][j] * per_det, vf);
    r.area[i][j] = __builtin_convertvector(cofactor[i][j] * sixth, vf);
    zero += r.inverse[j][i] * 0.0f;
  }
  r.counts = (__builtin_convertvector(ELASTIC_FLAT * size * vmagnitude(per_det), vf) < 1) & (zero == 0);
  return r;
}

/* The corners of up to VW elements from `first` on. */
AST_INLINE void elastic_block(const bool directed, const elastic_job *job, int64_t first, int64_t n) {
  const int64_t *elements = job->mesh->elements + 4 * first;
  int64_t some[4 * VW];
  if (n < VW) { /* the last one stands in for the missing ones, whose forces are not read */
    for (int64_t k = 0; k < 4 * VW; k++) some[k] = elements[4 * min64(k / 4, n - 1) + k % 4];
    elements = some;
  }
  const float *lame = job->mesh->lame + 2 * first;
  const vf even = vload_upto(lame, 2 * n), odd = vload_upto(lame + VW, 2 * n - VW), lambda = EVEN(even, odd),
           mu = ODD(even, odd);
  elastic_rest r = elastic_measure(job->rest, elements);
  const vi used = r.counts & ((lambda != 0) | (mu != 0));
  vf d[3][3], F[3][3], A[3][3], M[3][3], S[3][3], T[3][3], H[3][3];
  elastic_edges(job->position, elements, d);
  EACH(9, k) r.D[k / 3][k % 3] = d[k / 3][k % 3] - r.D[k / 3][k % 3];
  elastic_product(false, d, r.inverse, F);
  elastic_product(false, r.D, r.inverse, A);
  elastic_product(true, A, A, M);
  EACH(9, k) M[k / 3][k % 3] += A[k / 3][k % 3] + A[k % 3][k / 3];
  elastic_stress(lambda, mu, M, S);
  if (directed) { /* T = dF S + F dS, H = T area */
    vf dF[3][3], M2[3][3], dS[3][3];
    elastic_edges(job->direction, elements, d);
    elastic_product(false, d, r.inverse, dF);
    elastic_product(true, F, dF, M);
    EACH(9, k) M2[k / 3][k % 3] = M[k / 3][k % 3] + M[k % 3][k / 3];
    elastic_stress(lambda, mu, M2, dS);
    elastic_product(false, dF, S, T);
    elastic_product(false, F, dS, A);
    EACH(9, k) T[k / 3][k % 3] += A[k / 3][k % 3];
    elastic_product(false, T, r.area, H);
  } else { /* F (S area): the product of the areas first, which are small where F is large */
    elastic_product(false, S, r.area, T);
    elastic_product(false, F, T, H);
  }
  elastic_write(H, used, job->forces + first * CORNERS);
}

/* ---- tasks ---- */

static ast_status elastic_force_task(int64_t index, void *context) {
  const elastic_job *job = context;
  const int64_t end = min64(job->mesh->E, (index + 1) * ELASTIC_ELEMENTS);
  int64_t e = index * ELASTIC_ELEMENTS;
  if (job->direction) {
    for (; e < end; e += VW) elastic_block(true, job, e, min64(VW, end - e));
  } else {
    for (; e < end; e += VW) elastic_block(false, job, e, min64(VW, end - e));
  }
  return AST_OK;
}

/* The sum of some corners, chains of them added by halves. */
static corner elastic_sum(const elastic_job *job, int64_t begin, int64_t end) {
  if (end - begin > ELASTIC_CHAIN) {
    const int64_t middle = half_of_chains(begin, end, ELASTIC_CHAIN);
    return elastic_sum(job, begin, middle) + elastic_sum(job, middle, end);
  }
  corner sum = {0};
  for (int64_t j = begin; j < end; j++) sum += *(const corner *)(job->forces + 4 * job->mesh->node_order[j]);
  return sum;
}

static ast_status elastic_sum_task(int64_t index, void *context) {
  const elastic_job *job = context;
  const ast_elastic *mesh = job->mesh;
  for (int64_t n = index * ELASTIC_NODES; n < min64(mesh->N, (index + 1) * ELASTIC_NODES); n++) {
    const corner sum = elastic_sum(job, mesh->node_offsets[n], mesh->node_offsets[n + 1]);
    for (int i = 0; i < 3; i++) job->out[3 * n + i] = sum[i];
  }
  return AST_OK;
}

static ast_status elastic_run(const ast_elastic *mesh, const float *direction, float *out) {
  AST_SCRATCH_SCOPE;
  const int64_t fields = direction ? 3 : 2, length = 3 * mesh->N + 4;
  float *copies = ast_scratch(fields * length * (int64_t)sizeof *copies);
  elastic_job job = {
      .mesh = mesh, .forces = ast_scratch(round_up(mesh->E, VW) * CORNERS * (int64_t)sizeof *copies), .out = out};
  if (!copies || !job.forces) return AST_NO_MEMORY;
  const float *from[3] = {mesh->position, mesh->rest_position, direction};
  const float **to[3] = {&job.position, &job.rest, &job.direction};
  for (int64_t i = 0; i < fields; i++) {
    *to[i] = memcpy(copies + i * length, from[i], (size_t)(3 * mesh->N) * sizeof *copies);
    copies[i * length + 3 * mesh->N] = 0;
  }
  const ast_status status = ast_parallel(divide_up(mesh->E, ELASTIC_ELEMENTS), elastic_force_task, &job);
  return status == AST_OK ? ast_parallel(divide_up(mesh->N, ELASTIC_NODES), elastic_sum_task, &job) : status;
}

static ast_status elastic_forces(const ast_elastic *mesh, float *restrict force) {
  return elastic_run(mesh, NULL, force);
}

static ast_status elastic_forces_backward(const ast_elastic *mesh, const float *restrict dforce,
                                          float *restrict dposition) {
  return elastic_run(mesh, dforce, dposition);
}
