/* The functions of simd.h over arrays, as a table of one instruction set: simd_*.c name the set and include this. */
#ifndef AST_SIMD_TABLE_H
#define AST_SIMD_TABLE_H

#include <stdint.h>

enum { SIMD_MOST_LANES = 16, SIMD_SHIFT = 9 };

/* y[i] = f(x[i]) for n elements, a multiple of SIMD_MOST_LANES */
typedef void simd_function(const float *x, float *y, int64_t n);

typedef struct {
  simd_function *exp, *exp_shifted, *gauss, *density, *normal;
} simd_table;

#ifdef AST_ISA
#include "../simd.h"

#define SIMD_FUNCTION(name, value)                        \
  static void name(const float *x, float *y, int64_t n) { \
    for (int64_t i = 0; i < n; i += VW) {                 \
      const vf v = vload(x + i);                          \
      vstore(y + i, value);                               \
    }                                                     \
  }
SIMD_FUNCTION(simd_exp, vexp(v, 0))
SIMD_FUNCTION(simd_exp_shifted, vexp(v, SIMD_SHIFT))
SIMD_FUNCTION(simd_gauss, vgauss(v))
SIMD_FUNCTION(simd_density, vnormal_density(vgauss(v)))
SIMD_FUNCTION(simd_normal, vnormal(v, vgauss(v)))

#define SIMD_TABLE_OF(isa) simd_table_##isa
#define SIMD_TABLE(isa)    SIMD_TABLE_OF(isa)
extern const simd_table SIMD_TABLE(AST_ISA);
const simd_table SIMD_TABLE(AST_ISA) = {simd_exp, simd_exp_shifted, simd_gauss, simd_density, simd_normal};
#endif

#endif
