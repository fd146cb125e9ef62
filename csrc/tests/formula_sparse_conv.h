/* The formula of sparse_conv and its weight gradient, pair by pair. Included by test_sparse_conv.c once per type `real`
 * of its arithmetic: as FORMULA in double, the exact values, and in float, whose errors are the measure. */

static void FORMULA(const ast_pairs *p, int64_t destinations, const float *x, const float *weight, const float *bias,
                    const float *dout, int64_t C_in, int64_t C_out, bool transposed, real *out, real *dweight) {
  for (int64_t i = 0; bias && i < destinations * C_out; i++) out[i] = (real)bias[i % C_out];
  for (int64_t k = 0; k < OFFSETS; k++)
    for (int64_t i = p->offsets[k]; i < p->offsets[k + 1]; i++)
      for (int64_t a = 0; a < C_in; a++)
        for (int64_t b = 0; b < C_out; b++) {
          const real w = (real)weight[k * C_in * C_out + (transposed ? b * C_in + a : a * C_out + b)];
          const real x_pa = (real)x[p->source[i] * C_in + a];
          out[p->destination[i] * C_out + b] += x_pa * w;
          dweight[(k * C_in + a) * C_out + b] += x_pa * (real)dout[p->destination[i] * C_out + b];
        }
}

#undef real
#undef FORMULA
