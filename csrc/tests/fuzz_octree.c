/* Fuzzes the octree: build and levels of any positions, and levels of any keys. */
#define main tests_of_octree
#include "test_octree.c"
#undef main

#include "fuzz.h"

/* The first node that is not finite or not in the cube, or N. */
static int64_t first_bad(cloud s, const double center[3], double half_width) {
  for (int64_t i = 0; i < s.N; i++)
    for (int a = 0; a < 3; a++) {
      const double u = (s.positions[3 * i + a] - center[a] + half_width) / (2 * half_width);
      if (!isfinite(s.positions[3 * i + a]) || !(u >= -1e-6 && u <= 1 + 1e-6)) return i;
    }
  return s.N;
}

static void fuzz_build(const ast_kernels *kernels) {
  const int64_t B = take_size(6);
  const bool many =
      take_chance(); /* nodes, so that they are cut into chunks; few levels of them, as each is checked cell by cell */
  const int depth = take_byte() % (many ? 7 : 22), shape = take_byte() % SHAPES;
  double center[3], half_width = 1;
  cloud s = {0, B, take_offsets(B, 300), NULL};
  if (B) s.offsets[B] += many ? 8192 : 0;
  s.N = s.offsets[B];
  s.positions = take_floats(3 * s.N);
  const uint8_t byte = take_byte();
  if (byte % 2) fill(s, shape, depth);
  for (int a = 0; a < 3; a++) {
    center[a] = byte / 2 % 2 ? take_float() : 0;
    if (!isfinite(center[a])) center[a] = 0;
  }
  if (byte / 4 % 2) half_width = fabs((double)take_float());
  if (!(half_width > 0 && half_width < 1e300)) half_width = (double)FLT_MAX;
  const int64_t bad = first_bad(s, center, half_width);
  if (bad == s.N) {
    check_build(kernels, s, center, half_width, depth, "fuzz");
    check_levels(kernels, s, center, half_width, depth, depth, "fuzz");
  } else {
    bool finite = true;
    for (int a = 0; a < 3; a++) finite &= isfinite(s.positions[3 * bad + a]);
    tree t = new_tree(s.N, B);
    int64_t node = -1;
    READ_ONLY(s.positions, s.offsets);
    const ast_status status = kernels->octree_build(s.positions, s.offsets, B, center, half_width, depth, t.keys,
                                                    t.cell_offsets, t.node_cell, t.node_order, t.node_offsets, &node);
    CHECK(status == (finite ? AST_OUTSIDE : AST_NOT_FINITE) && node == bad, "status %d at %lld, not %lld", (int)status,
          (long long)node, (long long)bad);
    free_tree(t);
  }
  free_cloud(s);
}

/* Keys that rise by random steps from anywhere, up to the last key there is. */
static void fuzz_coarsen(const ast_kernels *kernels) {
  const int64_t B = take_size(4);
  int64_t *offsets = take_offsets(B, 300), *keys = new_ints(offsets[B]), n = 0;
  for (int64_t b = 0; b < B; b++) {
    const int64_t rows = offsets[b + 1] - n < 300 ? offsets[b + 1] - n : 300;
    const int step_bits = 1 + take_byte() % 62, first_bits = take_byte() % 64;
    check_state = take_word(2);
    int64_t key = first_bits ? (int64_t)(random_bits() >> (64 - first_bits)) : 0;
    for (int64_t i = 0; i < rows && key >= 0; i++) {
      keys[n++] = key;
      const int64_t step = 1 + (int64_t)(random_bits() >> (64 - step_bits));
      key = key > INT64_MAX - step ? -1 : key + step;
    }
    offsets[b + 1] = n;
  }
  tree t = {copy_ints(keys, n), copy_ints(offsets, B + 1), new_ints(0), new_ints(0), new_ints(0)};
  check_levels_of(kernels, t, B, take_byte() % 22, "fuzz");
  FREE(keys, offsets);
}

static void fuzz(const ast_kernels *kernels) {
  if (take_byte() % 3) fuzz_build(kernels);
  else fuzz_coarsen(kernels);
}
