/* Fuzzes farthest_point_sample against the greedy definition of its test. */
#define main tests_of_fps
#include "test_fps.c"
#undef main

#include "fuzz.h"

static void fuzz(const ast_kernels *kernels) {
  static const int64_t extents[] = {1, 2, 6, 100, 1 << 12, 26755, (1 << 21) - 1, 1 << 21};
  const int64_t B = take_size(5), num = 1 + take_size(600);
  int64_t *offsets = take_offsets(B, 600), N = offsets[B];
  int32_t *points = new_small_ints(3 * N);
  check_state = take_word(2);
  const int32_t origin = (int32_t)take_word(take_byte() % 4);
  const int shape = take_byte() % SHAPES;
  fill(points, N, shape, extents[take_byte() % 8], origin);
  for (int edits = take_byte() % 8; edits-- > 0 && N > 0;) {
    const int64_t at = take_index(3 * N);
    points[at] = (int32_t)take_word(1 + take_byte() % 4);
  }
  bool wide = false;
  for (int64_t b = 0; b < B; b++)
    for (int a = 0; a < 3; a++) {
      int64_t low = INT32_MAX, high = INT32_MIN;
      for (int64_t i = offsets[b]; i < offsets[b + 1]; i++) {
        low = points[3 * i + a] < low ? points[3 * i + a] : low;
        high = points[3 * i + a] > high ? points[3 * i + a] : high;
      }
      wide |= high - low >= 1 << 21;
    }
  if (wide) {
    int64_t *out_offsets = new_ints(B + 1);
    out_offsets[0] = 0;
    for (int64_t b = 0; b < B; b++) {
      const int64_t n = offsets[b + 1] - offsets[b];
      out_offsets[b + 1] = out_offsets[b] + (n < num ? n : num);
    }
    int64_t *indices = new_ints(out_offsets[B]);
    READ_ONLY(points, offsets, out_offsets);
    CHECK(kernels->farthest_point_sample(points, offsets, B, num, out_offsets, indices) == AST_OUTSIDE, "2^21 wide");
    FREE(out_offsets, indices);
  } else {
    check_sample(kernels, points, offsets, B, num, shapes[shape]);
  }
  FREE(points, offsets);
}
