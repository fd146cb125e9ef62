/* Vectors of the instruction set being compiled, in GCC/Clang vector extensions: 16 floats (AVX-512), 8 (AVX2) or 4. */
#ifndef AST_SIMD_H
#define AST_SIMD_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#ifndef AST_VECTOR_BYTES
#if defined(__AVX512F__)
#define AST_VECTOR_BYTES 64
#elif defined(__AVX2__)
#define AST_VECTOR_BYTES 32
#else
#define AST_VECTOR_BYTES 16
#endif
#endif

enum { VW = AST_VECTOR_BYTES / 4 }; /* floats in a vector */

typedef float vf __attribute__((vector_size(AST_VECTOR_BYTES)));
typedef int32_t vi __attribute__((vector_size(AST_VECTOR_BYTES)));
typedef uint32_t vu __attribute__((vector_size(AST_VECTOR_BYTES)));
typedef float vf_unaligned __attribute__((vector_size(AST_VECTOR_BYTES), aligned(4), may_alias));

#define AST_INLINE static inline __attribute__((always_inline))

AST_INLINE vf vload(const float *p) { return *(const vf_unaligned *)p; }
AST_INLINE void vstore(float *p, vf x) { *(vf_unaligned *)p = x; }
AST_INLINE vf vsplat(float x) { return x - (vf){0}; } /* x - 0 keeps -0 */

/* The first n < VW floats; the others are 0 and are not read. */
AST_INLINE vf vload_part(const float *p, int64_t n) {
  vf x = {0};
  memcpy(&x, p, (size_t)n * sizeof *p);
  return x;
}
AST_INLINE void vstore_part(float *p, vf x, int64_t n) { memcpy(p, &x, (size_t)n * sizeof *p); }

/* a where the mask is set (-1), b where it is not (0) */
AST_INLINE vf vselect(vi mask, vf a, vf b) { return (vf)((mask & (vi)a) | (~mask & (vi)b)); }
AST_INLINE vf vmax(vf a, vf b) { return vselect(a > b, a, b); } /* b where either is NaN */

/* Sum and maximum over the lanes, always paired the same way; a NaN loses against anything in the maximum. */
AST_INLINE float vsum(vf x) {
#pragma GCC unroll 4
  for (int half = VW / 2; half; half /= 2)
#pragma GCC unroll 8
    for (int i = 0; i < half; i++) x[i] += x[i + half];
  return x[0];
}
AST_INLINE float vlargest(vf x) {
#pragma GCC unroll 4
  for (int half = VW / 2; half; half /= 2)
#pragma GCC unroll 8
    for (int i = 0; i < half; i++) x[i] = x[i] > x[i + half] ? x[i] : x[i + half];
  return x[0];
}

/* 2^(x - shift) within 1 ULP for x < 127: 0 where the result would be below 2^-125 (also for -inf), NaN for NaN. */
AST_INLINE vf vexp2(vf x, int32_t shift) {
  const float magic = 0x1.8p23f + (float)(127 - shift);
  const vf rounded = x + magic; /* its low bits: n + 127 - shift, the exponent of 2^(n - shift), n the integer nearest to x */
  const vf f = x - (rounded - magic);
  vf p = 0x1.41fbbcp-13f * f + 0x1.5f3e52p-10f; /* 2^f on [-1/2, 1/2], minimax with p(0) = 1 */
  p = p * f + 0x1.3b2d4cp-7f;
  p = p * f + 0x1.c6aee8p-5f;
  p = p * f + 0x1.ebfbdcp-3f;
  p = p * f + 0x1.62e430p-1f;
  p = p * f + 1.0f;
  const vf power = (vf)((vu)rounded << 23);
  return (vf)((vi)(p * power) & ~(x < (float)(shift - 125)));
}

AST_INLINE int64_t min64(int64_t a, int64_t b) { return a < b ? a : b; }
AST_INLINE int64_t max64(int64_t a, int64_t b) { return a > b ? a : b; }
AST_INLINE int64_t round_up(int64_t n, int64_t to) { return (n + to - 1) / to * to; }

#endif
