/* What the fuzz targets share: the bytes of an input become a table of kernels, sizes, offsets and numbers.
 *
 * Arrays are random numbers of a seed that the input holds, with single elements replaced by what follows. Inputs are
 * short: one that has ended goes on as its first byte says, so that no part of a problem waits for inputs to grow. A
 * target includes the test of its kernel for the exact results, defines fuzz(kernels), and keeps its seeds in
 * corpus/<kernel>. `make fuzz` runs all of them.
 */
#ifndef AST_FUZZ_H
#define AST_FUZZ_H

#include <float.h>

#include "check.h"

static void fuzz(const ast_kernels *kernels);

static const uint8_t *fuzz_next, *fuzz_end;
static enum {
  ZEROS,
  BYTES,
  MODERATE
} fuzz_rest;                /* after the end: zeros, random bytes, or these with arrays of moderate numbers alone */
static uint64_t fuzz_state; /* of the random bytes: at first a hash of the input */

static uint8_t take_byte(void) {
  if (fuzz_next < fuzz_end) return *fuzz_next++;
  fuzz_state = fuzz_state * 6364136223846793005u + 1442695040888963407u;
  return fuzz_rest == ZEROS ? 0 : (uint8_t)(fuzz_state >> 56);
}
static uint64_t take_word(int bytes) {
  uint64_t word = 0;
  for (int i = 0; i < bytes; i++) word = word << 8 | take_byte();
  return word;
}

/* 0..most: any small number, or one at the edge of a block */
static int64_t take_size(int64_t most) {
  static const int64_t edges[] = {15,  16,  17,  31,  32,  33,  63,  64,  65,  95,  96, 97,
                                  127, 128, 129, 255, 256, 257, 300, 511, 512, 513, 600};
  const int num = sizeof edges / sizeof *edges, byte = take_byte();
  const int64_t size = byte < 256 - num ? byte % 40 : edges[byte - (256 - num)];
  return size <= most ? size : size % (most + 1);
}

/* True for one in sixteen. */
static bool take_chance(void) { return take_byte() % 16 == 15; }

/* n, or fewer if they would cost more than `budget` at `cost` each */
static int64_t within(int64_t budget, int64_t cost, int64_t n) {
  return cost > 0 && n > budget / cost ? budget / cost : n;
}

static int64_t take_index(int64_t n) { return (int64_t)(take_word(2) % (uint64_t)n); }

/* [B+1], from 0, never falling; at most `most` rows a scene */
static int64_t *take_offsets(int64_t B, int64_t most) {
  int64_t *offsets = new_ints(B + 1);
  offsets[0] = 0;
  for (int64_t b = 0; b < B; b++) offsets[b + 1] = offsets[b] + take_size(most);
  return offsets;
}

static float take_float(void) {
  static const float values[] = {0.0f,    -0.0f,    1.0f,    -1.0f,    NAN,         INFINITY, -INFINITY,
                                 FLT_MAX, -FLT_MAX, FLT_MIN, -FLT_MIN, 1.4013e-45f, 1e-40f,   -1e-40f,
                                 1e30f,   -1e30f,   1e-30f,  0.5f,     1e19f,       -1e19f};
  enum { VALUES = sizeof values / sizeof *values };
  const uint8_t byte = take_byte();
  if (byte < VALUES) return values[byte];
  if (byte < 128) return (float)(byte - 74);
  if (byte < 160) return (float)((int16_t)take_word(2)) / 256;
  const uint32_t bits = (uint32_t)take_word(4);
  float value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

/* Random numbers of one of some amplitudes, then up to 7 elements as the input says. */
static void take_values(float *x, int64_t n) {
  static const float amplitudes[] = {1, 4, 1, 1e-3f, 0, 1e-40f, 1e15f, FLT_MAX};
  check_state = take_word(2);
  const bool moderate = fuzz_rest == MODERATE && fuzz_next == fuzz_end;
  const int byte = take_byte() % (moderate ? 4 : 256);
  for (int64_t i = 0; i < n; i++) x[i] = amplitudes[byte % 8] * random_float();
  for (int edits = byte / 8 % 8; edits-- > 0 && n > 0;) {
    const int64_t at = take_index(n);
    x[at] = take_float();
  }
}
static float *take_floats(int64_t n) {
  float *x = new_floats(n);
  take_values(x, n);
  return x;
}

/* The same rows of n floats, `stride` apart, with NaN between them. */
static float *apart(const float *x, int64_t rows, int64_t n, int64_t stride) {
  float *to = new_floats(rows ? (rows - 1) * stride + n : 0);
  for (int64_t i = 0; i < rows * n; i++) to[i / n * stride + i % n] = x[i];
  return to;
}

static bool all_finite(const float *x, int64_t n) {
  for (int64_t i = 0; i < n; i++)
    if (!isfinite(x[i])) return false;
  return true;
}

/* The largest magnitude of the finite values. */
static double largest_finite(const float *x, int64_t n) {
  double largest = 0;
  for (int64_t i = 0; i < n; i++)
    if (isfinite(x[i]) && fabs((double)x[i]) > largest) largest = fabs((double)x[i]);
  return largest;
}

static bool same_floats(const float *a, const float *b, int64_t n) {
  for (int64_t i = 0; i < n; i++)
    if (memcmp(a + i, b + i, sizeof *a) && !(isnan(a[i]) && isnan(b[i]))) return false;
  return true;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  static const char *const names[] = {"base", "avx2", "avx512"};
  fuzz_next = data, fuzz_end = data + size, fuzz_state = size;
  for (size_t i = 0; i < size; i++) fuzz_state = (fuzz_state ^ data[i]) * 0x100000001b3u; /* FNV-1a */
  fuzz_rest = ZEROS;
  const uint8_t byte = take_byte();
  fuzz_rest = byte / 6 % 4 ? byte / 6 % 4 == 1 ? BYTES : MODERATE : ZEROS;
  const ast_kernels *kernels = ast_select(names[byte % 3]);
  buffers_at_start = byte / 3 % 2;
  fuzz(kernels ? kernels : ast_select("base"));
  CHECK(num_buffers == 0, "%d buffers are not freed", num_buffers);
  return 0;
}

#endif
