/* Vectors of the instruction set being compiled, in GCC/Clang vector extensions: 16 floats (AVX-512), 8 (AVX2) or 4. */
#ifndef AST_SIMD_H
#define AST_SIMD_H

#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "integers.h"

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the kernels need a little-endian machine" /* coarsen.c takes eight bytes for a word */
#endif

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
typedef double vd __attribute__((vector_size(2 * AST_VECTOR_BYTES))); /* VW doubles, in two registers */
typedef int64_t vl __attribute__((vector_size(2 * AST_VECTOR_BYTES)));

#define AST_INLINE static inline __attribute__((always_inline))
/* A loop over i < n, a constant up to 16, written out. */
#define EACH(n, i) _Pragma("GCC unroll 16") for (int i = 0; i < (n); i++)

AST_INLINE vf vload(const float *p) { return *(const vf_unaligned *)p; }
AST_INLINE void vstore(float *p, vf x) { *(vf_unaligned *)p = x; }
AST_INLINE vf vsplat(float x) { return x - (vf){0}; } /* x - 0 keeps -0 */

AST_INLINE vd vmagnitude(vd x) { return (vd)((vl)x & INT64_MAX); }

/* The first n < VW floats; the others are 0 and are not read. In pieces of fixed size: a copy of variable size is a
 * call. */
AST_INLINE vf vload_part(const float *p, int64_t n) {
  vf x = {0};
  float *to = (float *)&x;
#pragma GCC unroll 4
  for (int piece = VW / 2; piece; piece /= 2)
    if (n & piece) {
      memcpy(to, p, (size_t)piece * sizeof *p);
      to += piece, p += piece;
    }
  return x;
}
AST_INLINE void vstore_part(float *p, vf x, int64_t n) {
  const float *from = (const float *)&x;
#pragma GCC unroll 4
  for (int piece = VW / 2; piece; piece /= 2)
    if (n & piece) {
      memcpy(p, from, (size_t)piece * sizeof *p);
      from += piece, p += piece;
    }
}
/* The first min(n, VW) floats; none if n <= 0. */
AST_INLINE vf vload_upto(const float *p, int64_t n) { return n >= VW ? vload(p) : n > 0 ? vload_part(p, n) : (vf){0}; }
AST_INLINE void vstore_upto(float *p, vf x, int64_t n) {
  if (n >= VW) vstore(p, x);
  else if (n > 0) vstore_part(p, x, n);
}

/* a where the mask is set (-1), b where it is not (0) */
AST_INLINE vf vselect(vi mask, vf a, vf b) { return (vf)((mask & (vi)a) | (~mask & (vi)b)); }
/* b where either is NaN. Compilers turn it into the instruction of that meaning: clang from a selection, GCC only
 * from a loop over the elements that stays one. */
AST_INLINE vf vmax(vf a, vf b) {
#ifdef __clang__
  return vselect(a > b, a, b);
#else
  vf x;
#pragma GCC unroll 1
  for (int i = 0; i < VW; i++) x[i] = a[i] > b[i] ? a[i] : b[i];
  return x;
#endif
}

/* The lanes with these numbers, VW constants: 0 to VW - 1 are the lanes of a, VW to 2 VW - 1 the lanes of b. */
#ifdef __clang__
#define VSHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else /* GCC 11 has only this one */
#define VSHUFFLE(a, b, ...) __builtin_shuffle(a, b, (vi){__VA_ARGS__})
#endif

#if AST_VECTOR_BYTES == 64
static const vi LANE_INDICES = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
#elif AST_VECTOR_BYTES == 32
static const vi LANE_INDICES = {0, 1, 2, 3, 4, 5, 6, 7};
#else
static const vi LANE_INDICES = {0, 1, 2, 3};
#endif

/* lane i becomes lane i ^ distance, a power of two; the loop of vsum is written out for constant shuffles */
AST_INLINE vf vswap(vf x, const int distance) {
#ifdef __clang__
  vf y;
  for (int i = 0; i < VW; i++) y[i] = x[i ^ distance];
  return y;
#else
  return __builtin_shuffle(x, LANE_INDICES ^ distance);
#endif
}

/* Sum over the lanes, always paired the same way. */
AST_INLINE float vsum(vf x) {
  x += vswap(x, VW / 2);
  x += vswap(x, VW / 4);
  if (VW >= 8) x += vswap(x, VW / 8);
  if (VW >= 16) x += vswap(x, 1);
  return x[0];
}

/* ---- functions, whose bounds in units in the last place are the table of tests/test_simd.c ---- */

/* ln 2 = LN2 + LN2_REST; LN2 has 17 bits, so that n LN2 is exact for |n| <= 127, with or without FMA (Cody, Waite). */
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
enum { FUSED = 1 }; /* whether a product and a sum are rounded once */
#else
enum { FUSED = 0 };
#endif
static const float LN2 = 0x1.62e4p-1f, LN2_REST = 0x1.7f7d1cp-20f, LOG2_E = 0x1.715476p+0f;

/* e^r for |r| up to ln(2) / 2 and a little more: minimax with e^r = 1 + r + O(r^2) */
AST_INLINE vf vexp_near(vf r) {
  vf p = 0x1.6a511ap-10f * r + 0x1.12397cp-7f;
  p = p * r + 0x1.5558acp-5f;
  p = p * r + 0x1.555492p-3f;
  p = p * r + 0x1.fffffcp-2f;
  return FUSED ? (p * r + 1) * r + 1 : p * (r * r) + r + 1; /* what rounds least */
}

/* n, the integer nearest to x log2(e), and 2^(n - shift) */
AST_INLINE vf vexp_power(vf x, int32_t shift, vf *n) {
  const float magic = 0x1.8p23f + (float)(127 - shift);
  const vf rounded = x * LOG2_E + magic; /* its low bits are n + 127 - shift, the exponent of 2^(n - shift) */
  *n = rounded - magic;
  return (vf)((vu)rounded << 23);
}

/* e^x 2^-shift for x < 88: 0 where it would be below 2^-125 (also for -inf), NaN for NaN. */
AST_INLINE vf vexp(vf x, int32_t shift) {
  vf n;
  const vf power = vexp_power(x, shift, &n);
  const vf r = (x - n * LN2) - n * LN2_REST;
  return (vf)((vi)(vexp_near(r) * power) & ~(x < (float)(shift - 125) * 0x1.62e430p-1f));
}

/* e^(-x^2/2): the square in two parts, as the upper half of x has an exact square; rounded, it would cost 40 ULP. */
AST_INLINE vf vgauss(vf x) {
  const vf high = (vf)((vi)x & ~0xfff), half = -0.5f * high, s = half * high, rest = (half - 0.5f * x) * (x - high);
  vf n;
  const vf power = vexp_power(s + rest, 0, &n);
  const vf r = (s - n * LN2) + (rest - n * LN2_REST);
  return (vf)((vi)(vexp_near(r) * power) & ~(s < -126 * 0x1.62e430p-1f));
}

/* The density of the normal distribution and its distribution function Phi, given e^(-x^2/2). */
AST_INLINE vf vnormal_density(vf gauss) { return 0x1.988454p-2f * gauss; }
AST_INLINE vf vnormal(vf x, vf gauss) {
  const vf t = (vf)((vi)x & INT32_MAX), s = x * x;
  vf near = -0x1.c4628ap-18f * s + 0x1.d02a46p-14f; /* Phi(x) = 1/2 + x p(x^2) where |x| is at most 1.2, */
  near = near * s - 0x1.36267ap-10f;
  near = near * s + 0x1.46c0dcp-7f;
  near = near * s - 0x1.1057dap-4f;
  near = near * s + 0x1.988452p-2f;
  near = near * x + 0.5f;
  const vf v = 1.0f / (0.5f * t + 1.0f);
  vf far = -0x1.19a4p-3f * v + 0x1.989f4ep-2f; /* Phi(-t) = e^(-t^2/2) v q(v) elsewhere, minimax */
  far = far * v - 0x1.782fccp-2f;
  far = far * v + 0x1.4e8616p-6f;
  far = far * v + 0x1.162892p-5f;
  far = far * v + 0x1.360a72p-3f;
  far = far * v + 0x1.984ceep-3f;
  far = far * v + 0x1.9885ap-3f;
  const vf tail = far * v * gauss;
  return vselect(t > 1.2f, vselect(x < 0, tail, 1 - tail), near);
}

#if AST_VECTOR_BYTES == 64
#define INTERLEAVE_LOW(a, b)  VSHUFFLE(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23)
#define INTERLEAVE_HIGH(a, b) VSHUFFLE(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31)
#elif AST_VECTOR_BYTES == 32
#define INTERLEAVE_LOW(a, b)  VSHUFFLE(a, b, 0, 8, 1, 9, 2, 10, 3, 11)
#define INTERLEAVE_HIGH(a, b) VSHUFFLE(a, b, 4, 12, 5, 13, 6, 14, 7, 15)
#else
#define INTERLEAVE_LOW(a, b)  VSHUFFLE(a, b, 0, 4, 1, 5)
#define INTERLEAVE_HIGH(a, b) VSHUFFLE(a, b, 2, 6, 3, 7)
#endif

/* x_ij <-> x_ji: each pass rotates the bits of the index (i, j) by one, log2(VW) passes exchange i and j. */
AST_INLINE void vtranspose(vf x[VW]) {
#pragma GCC unroll 4
  for (int pass = 1; pass < VW; pass *= 2) {
    vf y[VW];
#pragma GCC unroll 8
    for (int i = 0; i < VW / 2; i++) {
      y[2 * i] = INTERLEAVE_LOW(x[i], x[i + VW / 2]);
      y[2 * i + 1] = INTERLEAVE_HIGH(x[i], x[i + VW / 2]);
    }
#pragma GCC unroll 16
    for (int i = 0; i < VW; i++) x[i] = y[i];
  }
}

#endif
