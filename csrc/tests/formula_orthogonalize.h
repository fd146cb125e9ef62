/* The formula of orthogonalize for one matrix x [R,C]. Included by test_orthogonalize.c once per type `real` of its
 * arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. */
static void FORMULA(const float *x, int64_t R, int64_t C, real *out) {
  real *G = calloc((size_t)(C * C), sizeof *G), *P = calloc((size_t)(C * C), sizeof *P);
  real *next = calloc((size_t)(R * C), sizeof *next);
  double squares = 0;
  for (int64_t i = 0; i < R * C; i++) squares += (double)x[i] * (double)x[i];
  for (int64_t i = 0; i < R * C; i++) out[i] = (real)((double)x[i] / fmax(sqrt(squares), 1e-37));
  for (int iteration = 0; iteration < 5; iteration++) {
    for (int64_t i = 0; i < C; i++)
      for (int64_t j = 0; j < C; j++) {
        G[i * C + j] = 0;
        for (int64_t k = 0; k < R; k++) G[i * C + j] += out[k * C + i] * out[k * C + j];
      }
    for (int64_t i = 0; i < C; i++)
      for (int64_t j = 0; j < C; j++) {
        real square = 0;
        for (int64_t k = 0; k < C; k++) square += G[i * C + k] * G[k * C + j];
        P[i * C + j] = (i == j ? (real)3.4445f : 0) + (real)-4.7750f * G[i * C + j] + (real)2.0315f * square;
      }
    for (int64_t i = 0; i < R; i++)
      for (int64_t j = 0; j < C; j++) {
        next[i * C + j] = 0;
        for (int64_t k = 0; k < C; k++) next[i * C + j] += out[i * C + k] * P[k * C + j];
      }
    memcpy(out, next, (size_t)(R * C) * sizeof *out);
  }
  free(G), free(P), free(next);
}
