/* The formula of linear and its gradients. Included by test_linear.c once per type `real` of its
 * arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. */
#include <tgmath.h> /* exp, sqrt and others of the type of their argument */
#undef I            /* of complex.h */

static void FORMULA(const problem *a, real *out, real *dx, real *dweight, real *dbias) {
  const int64_t I = a->s.I, O = a->s.O, N = a->columns;
  real *z = calloc((size_t)O * 2 + 1, sizeof *z), *dz = z + O;
  for (int64_t j = 0; j < a->s.M * I; j++) dx[j] = 0;
  for (int64_t j = 0; j < O * I; j++) dweight[j] = 0;
  for (int64_t j = 0; j < O; j++) dbias[j] = 0;
  for (int64_t i = 0; i < a->s.M; i++) {
    for (int64_t o = 0; o < O; o++) {
      z[o] = (real)a->bias[o];
      for (int64_t k = 0; k < I; k++) z[o] += (real)a->x[i * I + k] * (real)a->weight[o * I + k];
    }
    for (int64_t j = 0; j < N; j++) {
      const real y = (real)a->dout[i * N + j];
      real act = z[j];
      if (a->s.activation == AST_GEGLU) {
        const real b = z[N + j], phi = (real)0.5 * (1 + erf(b * (real)0.70710678118654752));
        act = z[j] * b * phi;
        dz[j] = y * b * phi;
        dz[N + j] = y * z[j] * (phi + b * exp(-b * b / 2) * (real)0.3989422804014327);
      } else if (a->s.activation == AST_RELU) {
        act = z[j] <= 0 ? 0 : z[j];
        dz[j] = z[j] <= 0 ? 0 : y;
      } else {
        dz[j] = y;
      }
      out[i * N + j] = act + (real)a->residual[i * N + j];
    }
    for (int64_t o = 0; o < O; o++) {
      dbias[o] += dz[o];
      for (int64_t k = 0; k < I; k++) {
        dx[i * I + k] += dz[o] * (real)a->weight[o * I + k];
        dweight[o * I + k] += dz[o] * (real)a->x[i * I + k];
      }
    }
  }
  free(z);
}

#undef real
#undef FORMULA
