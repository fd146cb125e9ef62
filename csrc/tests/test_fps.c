/* Farthest point sampling against the greedy definition in 64-bit integers, every distance from every sample. */
#include "check.h"

static bool quick; /* where it is slow */

static void greedy(const int32_t *points, int64_t begin, int64_t end, int64_t num, int64_t *indices) {
  const int64_t n = end - begin;
  int64_t *distance = malloc((size_t)(n + 1) * sizeof *distance);
  for (int64_t i = 0; i < n; i++) distance[i] = INT64_MAX;
  for (int64_t t = 0, pick = 0; t < num && t < n; t++) {
    indices[t] = begin + pick;
    distance[pick] = -1;
    int64_t farthest = -1;
    const int32_t *p = points + 3 * (begin + pick);
    for (int64_t i = 0; i < n; i++) {
      if (distance[i] < 0) continue;
      const int32_t *q = points + 3 * (begin + i);
      int64_t square = 0;
      for (int a = 0; a < 3; a++) square += ((int64_t)q[a] - p[a]) * ((int64_t)q[a] - p[a]);
      if (square < distance[i]) distance[i] = square;
      if (distance[i] > farthest) farthest = distance[i], pick = i;
    }
  }
  free(distance);
}

static int by_value(const void *a, const void *b) {
  const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
  return x < y ? -1 : x > y;
}

static void check_sample(const ast_kernels *kernels, const int32_t *points, const int64_t *scene_offsets, int64_t B,
                         int64_t num, const char *what) {
  int64_t *offsets = copy_ints(scene_offsets, B + 1), *out_offsets = new_ints(B + 1);
  out_offsets[0] = 0;
  for (int64_t b = 0; b < B; b++) {
    const int64_t n = offsets[b + 1] - offsets[b];
    out_offsets[b + 1] = out_offsets[b] + (n < num ? n : num);
  }
  const int64_t total = out_offsets[B];
  int64_t *indices = new_ints(total), *expected = new_ints(total);
  READ_ONLY(points, offsets, out_offsets);
  CHECK(kernels->farthest_point_sample(points, offsets, B, num, out_offsets, indices) == AST_OK, "%s", what);
  WRITABLE(points);
  for (int64_t b = 0; b < B; b++) {
    const int64_t n = offsets[b + 1] - offsets[b], at = out_offsets[b], rows = out_offsets[b + 1] - at;
    if (n <= num)
      for (int64_t i = 0; i < n; i++) expected[at + i] = offsets[b] + i;
    else greedy(points, offsets[b], offsets[b + 1], num, expected + at);
    for (int64_t i = at; i < at + rows; i++)
      CHECK(indices[i] == expected[i], "%s, %lld of %lld: sample %lld of scene %lld is %lld, not %lld", what,
            (long long)num, (long long)n, (long long)(i - at), (long long)b, (long long)indices[i],
            (long long)expected[i]);
    qsort(indices + at, (size_t)rows, sizeof *indices, by_value);
    for (int64_t i = at + 1; i < at + rows; i++)
      CHECK(indices[i] > indices[i - 1], "%s: %lld twice", what, (long long)indices[i]);
  }
  FREE(offsets, out_offsets, indices, expected);
}

enum { RANDOM, SORTED, LATTICE, COINCIDENT, TWINS, COLLINEAR, PLANAR, CORNERS, SHAPES };
static const char *const shapes[] = {"random", "sorted",    "lattice", "coincident",
                                     "twins",  "collinear", "planar",  "corners"};

static void fill(int32_t *points, int64_t n, int shape, int64_t extent, int32_t origin) {
  int64_t side = 1;
  while (side * side * side < n) side++;
  for (int64_t i = 0; i < n; i++)
    for (int a = 0; a < 3; a++) {
      int64_t x = (int64_t)(random_bits() % (uint64_t)extent);
      if (shape == SORTED) x = a == 0 ? i * (extent - 1) / n : x;
      if (shape == LATTICE) x = (a == 0 ? i / (side * side) : a == 1 ? i / side % side : i % side) % extent;
      if (shape == COINCIDENT) x = extent / 2;
      if (shape == TWINS && i % 3) x = points[3 * (i - i % 3) + a] - origin;
      if (shape == COLLINEAR && a) x = points[3 * i] - origin;
      if (shape == PLANAR && a == 1) x = extent - 1;
      if (shape == CORNERS) x = random_bits() & 1 ? extent - 1 : 0;
      points[3 * i + a] = (int32_t)x + origin;
    }
}

static void test_shapes(const ast_kernels *kernels) {
  static const int64_t sizes[] = {1, 2, 3, 63, 64, 65, 129, 1025}, nums[] = {1, 2, 17, 64, 400, 2000};
  static const int64_t extents[] = {2, 9, 1 << 12, 26755, 1 << 15, (1 << 21) - 1, 1 << 21};
  int32_t *points = new_small_ints(3 * 1025);
  for (int n = 0; n < (quick ? 7 : 8); n++)
    for (int e = 0; e < 7; e++)
      for (int shape = 0; shape < SHAPES; shape++) {
        const int64_t offsets[] = {0, sizes[n]};
        fill(points, sizes[n], shape, extents[e], (e - 3) * (1 << 28));
        check_sample(kernels, points, offsets, 1, nums[(n + e + shape) % 6], shapes[shape]);
      }
  FREE(points);
}

static void test_large_blocks(const ast_kernels *kernels) {
  enum { N = 20001 };
  const int64_t offsets[] = {0, N};
  int32_t *points = new_small_ints(3 * N);
  for (int shape = 0; shape < SHAPES; shape++) {
    fill(points, N, shape, shape & 1 ? 4096 : 1 << 21, 0);
    check_sample(kernels, points, offsets, 1, quick ? 5 : 100, shapes[shape]);
  }
  FREE(points);
}

static void test_scenes(const ast_kernels *kernels) {
  static const int64_t offsets[] = {0, 0, 1, 1, 1, 300, 302, 302, 1000, 1000};
  int32_t *points = new_small_ints(3 * 1000);
  fill(points, 1000, RANDOM, 30, -5);
  for (int64_t num = 1; num < 900; num += num < 5 ? 1 : 97) check_sample(kernels, points, offsets, 9, num, "scenes");
  check_sample(kernels, points, offsets, 9, INT64_MAX, "all points");
  check_sample(kernels, points, offsets, 2, 3, "one point");
  check_sample(kernels, points, offsets, 1, 3, "an empty scene");
  check_sample(kernels, points, offsets, 0, 3, "no scenes");
  FREE(points);
}

/* Every point, until only duplicates are left. */
static void test_exhausted(const ast_kernels *kernels) {
  static const int64_t offsets[] = {0, 700};
  int32_t *points = new_small_ints(3 * 700);
  for (int shape = 0; shape < SHAPES; shape++) {
    fill(points, 700, shape, 6, 0);
    for (int64_t num = 690; num <= 701; num++) check_sample(kernels, points, offsets, 1, num, shapes[shape]);
  }
  FREE(points);
}

static void test_too_wide(const ast_kernels *kernels) {
  int64_t *offsets = copy_ints((const int64_t[]){0, 2, 102}, 3),
          *out_offsets = copy_ints((const int64_t[]){0, 1, 2}, 3);
  int64_t *indices = new_ints(2);
  int32_t *points = new_small_ints(306);
  memset(points, 0, 306 * sizeof *points);
  for (int i = 6; i < 306; i++) {
    points[i] = i % 2 ? INT32_MIN : INT32_MAX;
    CHECK(kernels->farthest_point_sample(points, offsets, 2, 1, out_offsets, indices) == AST_OUTSIDE, "coordinate %d",
          i);
    points[i] = 1 << 21;
    CHECK(kernels->farthest_point_sample(points, offsets, 2, 1, out_offsets, indices) == AST_OUTSIDE, "coordinate %d",
          i);
    points[i] = (1 << 21) - 1;
    CHECK(kernels->farthest_point_sample(points, offsets, 2, 1, out_offsets, indices) == AST_OK, "coordinate %d", i);
    points[i] = 0;
  }
  FREE(offsets, out_offsets, indices, points);
}

static void test(const ast_kernels *kernels) {
  test_shapes(kernels);
  test_large_blocks(kernels);
  test_scenes(kernels);
  test_exhausted(kernels);
  test_too_wide(kernels);
}

int main(void) {
  quick = getenv("AST_TEST_QUICK") != NULL;
  on_every_table(test);
  return 0;
}
