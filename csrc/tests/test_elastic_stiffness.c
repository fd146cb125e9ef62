/* elastic_stiffness against its definition: the 9 x 9 second derivative by F at each point, whose negative eigenvalues
 * become zero, between the derivatives of F by the nodes. */
#include "check.h"

enum { DOFS = 30, SIDE = 9 };

static double *new_doubles(int64_t n) { return new_buffer((size_t)n * sizeof(double)); }

/* The eigenvalues of a symmetric matrix on its diagonal, and its eigenvectors as columns, by Jacobi's rotations. */
static void rotate(double m[SIDE][SIDE], double vectors[SIDE][SIDE]) {
  for (int i = 0; i < SIDE; i++)
    for (int j = 0; j < SIDE; j++) vectors[i][j] = i == j;
  for (int sweep = 0; sweep < 60; sweep++)
    for (int p = 0; p < SIDE; p++)
      for (int q = p + 1; q < SIDE; q++) {
        const double angle = atan2(2 * m[p][q], m[q][q] - m[p][p]) / 2, c = cos(angle), s = sin(angle);
        for (int i = 0; i < SIDE; i++) {
          const double a = m[i][p], b = m[i][q], v = vectors[i][p], w = vectors[i][q];
          m[i][p] = c * a - s * b, m[i][q] = s * a + c * b;
          vectors[i][p] = c * v - s * w, vectors[i][q] = s * v + c * w;
        }
        for (int i = 0; i < SIDE; i++) {
          const double a = m[p][i], b = m[q][i];
          m[p][i] = c * a - s * b, m[q][i] = s * a + c * b;
        }
      }
}

/* The second derivative by F [3,3], row by row. */
static void by_definition(const double *F, double mu, double c, double spread, bool project,
                          double second[SIDE][SIDE]) {
  double T[3][3], J = 0, vectors[SIDE][SIDE], m[SIDE][SIDE];
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
      T[i][j] = F[3 * i1 + j1] * F[3 * i2 + j2] - F[3 * i1 + j2] * F[3 * i2 + j1];
      if (i == 0) J += F[j] * T[0][j];
    }
  for (int p = 0; p < SIDE; p++)
    for (int q = 0; q < SIDE; q++) {
      const int i = p / 3, j = p % 3, k = q / 3, l = q % 3;
      m[p][q] = second[p][q] = (p == q) * mu + (spread * T[i][j] * T[k][l] - c * T[i][l] * T[k][j]) / (J * J);
    }
  if (!project) return;
  rotate(m, vectors);
  for (int p = 0; p < SIDE; p++)
    for (int q = 0; q < SIDE; q++)
      for (int k = 0; k < SIDE; k++) second[p][q] -= fmin(m[k][k], 0) * vectors[p][k] * vectors[q][k];
}

/* The matrix [3K,3K] of element e. */
static void exact_element(const ast_stiffness *s, int64_t e, double *matrix) {
  const int64_t P = s->Q * s->E, dofs = 3 * s->K;
  memset(matrix, 0, (size_t)(dofs * dofs) * sizeof *matrix);
  for (int64_t q = 0; q < s->Q; q++) {
    const int64_t point = q * s->E + e;
    double F[SIDE], second[SIDE][SIDE];
    for (int k = 0; k < SIDE; k++) F[k] = s->F[k * P + point];
    by_definition(F, s->mu[point], s->c[point], s->spread[point], s->project, second);
    for (int64_t m = 0; m < dofs; m++)
      for (int64_t n = 0; n < dofs; n++)
        for (int j = 0; j < 3; j++)
          for (int l = 0; l < 3; l++)
            matrix[m * dofs + n] += s->volume[point] * s->gradients[(m / 3 * 3 + j) * P + point] *
                                    second[m % 3 * 3 + j][n % 3 * 3 + l] * s->gradients[(n / 3 * 3 + l) * P + point];
  }
}

/* Elements whose stretches lie between 0.4 and 2.4, some of them mirrored; every third is not deformed. */
static ast_stiffness new_elements(int64_t E, int64_t K, bool project) {
  const int64_t Q = K == 4 ? 1 : 4, P = Q * E;
  double *F = new_doubles(SIDE * P), *gradients = new_doubles(3 * K * P), *fields[4];
  for (int i = 0; i < 4; i++) fields[i] = new_doubles(P);
  for (int64_t i = 0; i < 3 * K * P; i++) gradients[i] = 2 * random_unit() - 1;
  for (int64_t p = 0; p < P; p++) {
    double x[SIDE] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
    for (int turn = 0; turn < 6 && p % 3 > 0; turn++) {
      const double c = cos(6.28 * random_unit()), s = sqrt(1 - c * c);
      const int a = turn % 3, b = (turn + 1) % 3;
      for (int i = 0; i < 3; i++) { /* rotations before and after a stretch */
        const double one = x[3 * i + a], other = x[3 * i + b];
        x[3 * i + a] = c * one - s * other, x[3 * i + b] = s * one + c * other;
      }
      if (turn == 2)
        for (int i = 0; i < 3; i++) {
          const double stretch = (0.4 + 2 * random_unit()) * (i == 0 && random_bits() % 8 == 0 ? -1 : 1);
          for (int j = 0; j < 3; j++) x[3 * i + j] *= stretch;
        }
    }
    for (int k = 0; k < SIDE; k++) F[k * P + p] = x[k];
    fields[0][p] = 0.1 + random_unit(), fields[1][p] = 0.1 + random_unit();
    fields[2][p] = 4 * random_unit() - 2, fields[3][p] = 3 * random_unit() - 1;
  }
  return (ast_stiffness){E, Q, K, F, gradients, fields[0], fields[1], fields[2], fields[3], project};
}

static ast_status run(const ast_kernels *kernels, const ast_stiffness *s, double *entries) {
  READ_ONLY(s->F, s->gradients, s->volume, s->mu, s->c, s->spread);
  const ast_status status = kernels->elastic_stiffness(s, entries);
  WRITABLE(s->F, s->gradients, s->volume, s->mu, s->c, s->spread);
  return status;
}

static void check_elements(const ast_kernels *kernels, const ast_stiffness *s) {
  const int64_t dofs = 3 * s->K, num = dofs * (dofs + 1) / 2;
  double *entries = new_doubles(num * s->E), matrix[DOFS * DOFS];
  CHECK(run(kernels, s, entries) == AST_OK, "status");
  for (int64_t e = 0; e < s->E; e++) {
    double largest = 0;
    exact_element(s, e, matrix);
    for (int64_t i = 0; i < dofs * dofs; i++) largest = fmax(largest, fabs(matrix[i]));
    for (int64_t m = 0, k = 0; m < dofs; m++)
      for (int64_t n = m; n < dofs; n++, k++) {
        const double got = entries[k * s->E + e], exact = matrix[m * dofs + n];
        CHECK(fabs(got - exact) <= 1e-11 * largest, "entry %lld of element %lld is %g, not %g", (long long)k,
              (long long)e, got, exact);
      }
  }
  FREE(entries);
}

static void free_elements(const ast_stiffness *s) { FREE(s->F, s->gradients, s->volume, s->mu, s->c, s->spread); }

/* An element without a stretch, or with numbers that are not finite, cannot be projected; as it is, it is no error. */
static void test_lost_stretches(const ast_kernels *kernels) {
  static const double wrong[] = {0, 1e-9, NAN, INFINITY};
  for (int i = 0; i < 4; i++)
    for (int project = 0; project < 2; project++) {
      ast_stiffness s = new_elements(37, 4, project);
      for (int k = 0; k < 3; k++) ((double *)s.F)[k * 37 + 35] = k == 0 ? wrong[i] : 0; /* the first row of F */
      double *entries = new_doubles(78 * 37);
      const ast_status status = run(kernels, &s, entries);
      CHECK(status == (project ? AST_NOT_FINITE : AST_OK), "status %d of %g", (int)status, wrong[i]);
      FREE(entries);
      free_elements(&s);
    }
}

static void test(const ast_kernels *kernels) {
  static const int64_t sizes[] = {0, 1, 3, 4, 8, 15, 16, 17, 33, 700};
  for (int i = 0; i < 10; i++)
    for (int64_t K = 4; K <= 10; K += 6)
      for (int project = 0; project < 2; project++) {
        const ast_stiffness s = new_elements(K == 4 ? sizes[i] : sizes[i] / 5, K, project);
        check_elements(kernels, &s);
        free_elements(&s);
      }
  test_lost_stretches(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
