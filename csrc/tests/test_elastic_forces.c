/* elastic_forces and its gradient against the formulas in double, at sizes around every block; elements that contribute
 * nothing. */
#include "problems.h"

/* C = A B, or A^T B */
static void multiply(bool transposed, double A[3][3], double B[3][3], double C[3][3]) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      C[i][j] = 0;
      for (int k = 0; k < 3; k++) C[i][j] += (transposed ? A[k][i] : A[i][k]) * B[k][j];
    }
}

static void edges_of(const float *x, const int64_t *nodes, double D[3][3]) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) D[i][j] = (double)x[3 * nodes[j + 1] + i] - (double)x[3 * nodes[0] + i];
}

/* inverse = D^-1; the determinant */
static double invert(double D[3][3], double inverse[3][3]) {
  double det = 0;
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const int i1 = (i + 1) % 3, i2 = (i + 2) % 3, j1 = (j + 1) % 3, j2 = (j + 2) % 3;
      inverse[j][i] = D[i1][j1] * D[i2][j2] - D[i2][j1] * D[i1][j2];
      if (j == 0) det += D[i][0] * inverse[j][i];
    }
  for (int k = 0; k < 9; k++) inverse[k / 3][k % 3] /= det;
  return det;
}

/* S = lambda tr(G) I + 2 mu G of G = (M + M^T) / 2 + shift I */
static void stress_of(const float *lame, double M[3][3], double shift, double S[3][3]) {
  for (int i = 0; i < 3; i++)
    for (int j = 0; j < 3; j++) {
      const double trace = M[0][0] + M[1][1] + M[2][2] + 3 * shift, G = (M[i][j] + M[j][i]) / 2 + (i == j ? shift : 0);
      S[i][j] = (i == j ? (double)lame[0] * trace : 0) + 2 * (double)lame[1] * G;
    }
}

/* Adds the forces of one element to force, and their derivative in a direction to change. */
static void add_element(const ast_elastic *s, int64_t e, const float *direction, double *force, double *change) {
  const int64_t *nodes = s->elements + 4 * e;
  double D[3][3], inverse[3][3], d[3][3], F[3][3], dF[3][3], M[3][3], S[3][3], dS[3][3], stress[2][3][3], T[3][3];
  edges_of(s->rest_position, nodes, D);
  const double volume = fabs(invert(D, inverse)) / 6;
  edges_of(s->position, nodes, d), multiply(false, d, inverse, F);
  edges_of(direction, nodes, d), multiply(false, d, inverse, dF);
  multiply(true, F, F, M);
  for (int k = 0; k < 9; k++) M[k / 3][k % 3] /= 2;
  stress_of(s->lame + 2 * e, M, -0.5, S);
  multiply(true, F, dF, M), stress_of(s->lame + 2 * e, M, 0, dS);
  multiply(false, F, S, stress[0]);
  multiply(false, dF, S, stress[1]), multiply(false, F, dS, T);
  for (int k = 0; k < 9; k++) stress[1][k / 3][k % 3] += T[k / 3][k % 3];
  for (int which = 0; which < 2; which++)
    for (int i = 0; i < 3; i++)
      for (int j = 0; j < 3; j++) {
        double h = 0;
        for (int k = 0; k < 3; k++) h -= volume * stress[which][i][k] * inverse[j][k];
        (which ? change : force)[3 * nodes[j + 1] + i] += h;
        (which ? change : force)[3 * nodes[0] + i] -= h;
      }
}

static void check(const char *what, const float *got, const double *exact, int64_t n) {
  double largest = 0;
  for (int64_t i = 0; i < n; i++) largest = fmax(largest, fabs(exact[i]));
  for (int64_t i = 0; i < n; i++)
    CHECK(fabs((double)got[i] - exact[i]) <= 4e-6 * largest, "%s[%lld] is %g, not %g of %g", what, (long long)i,
          (double)got[i], exact[i], largest);
}

static void compare(const ast_kernels *kernels, int64_t E, float scale) {
  const ast_elastic s = new_elastic(E, scale);
  float *direction = random_floats(3 * s.N), *force = new_floats(3 * s.N), *change = new_floats(3 * s.N);
  double *exact = calloc((size_t)(6 * s.N), sizeof *exact), *exact_change = exact + 3 * s.N;
  CHECK(exact, "no memory");
  for (int64_t e = 0; e < E; e++) add_element(&s, e, direction, exact, exact_change);
  READ_ONLY(ELASTIC_BUFFERS(&s), direction);
  CHECK(kernels->elastic_forces(&s, force) == AST_OK, "status");
  CHECK(kernels->elastic_forces_backward(&s, direction, change) == AST_OK, "status");
  check("force", force, exact, 3 * s.N), check("change", change, exact_change, 3 * s.N);
  free(exact);
  FREE(ELASTIC_BUFFERS(&s), direction, force, change);
}

/* Elements that contribute nothing leave the forces at every node at 0, although their positions are not finite. */
static void contribute_nothing(const ast_kernels *kernels) {
  enum { E = 37 };
  for (int kind = 0; kind < 4; kind++) {
    const ast_elastic s = new_elastic(E, 1);
    float *rest = (float *)s.rest_position, *lame = (float *)s.lame, *position = (float *)s.position;
    float *force = new_floats(3 * s.N), *change = new_floats(3 * s.N);
    for (int64_t i = 0; i < 3 * s.N; i++) {
      position[i] = i % 2 ? NAN : INFINITY;
      if (kind == 0) rest[i] = i % 3 == 1 ? 0 : rest[i]; /* flat */
      if (kind == 1) rest[i] = 7;                        /* all at one place */
      if (kind == 2) rest[i] = i % 2 ? NAN : -INFINITY;
    }
    for (int64_t i = 0; kind == 3 && i < 2 * E; i++) lame[i] = 0;
    READ_ONLY(ELASTIC_BUFFERS(&s));
    CHECK(kernels->elastic_forces(&s, force) == AST_OK, "status");
    CHECK(kernels->elastic_forces_backward(&s, position, change) == AST_OK, "status");
    for (int64_t i = 0; i < 3 * s.N; i++)
      CHECK(force[i] == 0 && change[i] == 0, "kind %d: force %g, change %g", kind, (double)force[i], (double)change[i]);
    FREE(ELASTIC_BUFFERS(&s), force, change);
  }
}

/* At rest and where all nodes coincide the forces are exactly 0. */
static void balance(const ast_kernels *kernels) {
  for (int coincident = 0; coincident < 2; coincident++) {
    const ast_elastic s = new_elastic(50, 1);
    float *force = new_floats(3 * s.N);
    for (int64_t i = 0; i < 3 * s.N; i++) ((float *)s.position)[i] = coincident ? 0.3f : s.rest_position[i];
    CHECK(kernels->elastic_forces(&s, force) == AST_OK, "status");
    for (int64_t i = 0; i < 3 * s.N; i++) CHECK(force[i] == 0, "force %g", (double)force[i]);
    FREE(ELASTIC_BUFFERS(&s), force);
  }
}

static void test(const ast_kernels *kernels) {
  static const int64_t sizes[] = {0, 1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 33, 300, 2047, 2049, 5000};
  for (int i = 0; i < 17; i++) compare(kernels, sizes[i], 1);
  compare(kernels, 100, 1e-3f), compare(kernels, 100, 1e3f), compare(kernels, 100, 1e-9f), compare(kernels, 100, 1e9f);
  contribute_nothing(kernels);
  balance(kernels);
}

int main(void) {
  on_every_table(test);
  return 0;
}
