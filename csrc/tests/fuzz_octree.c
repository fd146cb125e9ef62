/* Fuzzes the octree: build and levels of any positions, coarsening of any keys, and pairs of any tables, which must only be safe. */
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
  const int depth = take_byte() % 22, shape = take_byte() % SHAPES;
  double center[3], half_width = 1;
  cloud s = {0, B, take_offsets(B, 300), NULL};
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
    check_levels(kernels, s, center, half_width, depth, depth + 1, "fuzz");
  } else {
    bool finite = true;
    for (int a = 0; a < 3; a++) finite &= isfinite(s.positions[3 * bad + a]);
    tree t = new_tree(s.N, B);
    int64_t node = -1;
    READ_ONLY(s.positions, s.offsets);
    const ast_status status = kernels->octree_build(s.positions, s.offsets, B, center, half_width, depth, t.keys, t.cell_offsets,
                                                    t.node_cell, t.node_order, t.node_offsets, &node);
    CHECK(status == (finite ? AST_OUTSIDE : AST_NOT_FINITE) && node == bad, "status %d at %lld, not %lld", (int)status, (long long)node,
          (long long)bad);
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
  for (int level = 0; level < 22; level++) check_coarsen(kernels, keys, offsets, B, "fuzz");
  FREE(keys, offsets);
}

/* Tables that fit together in nothing but their sizes: the pairs are found, or said not to be those of pair_offsets. */
static void fuzz_pairs(const ast_kernels *kernels) {
  const int64_t C = take_size(100);
  int64_t *first_child = take_offsets(C, 20), *keys = new_ints(first_child[C]), *neighbours = new_ints(8 * C);
  int64_t *pair_offsets = new_ints(28), counts[27] = {0}, *out[4];
  check_state = take_word(2);
  const uint8_t sparse = take_byte();
  for (int64_t i = 0; i < first_child[C]; i++) keys[i] = (int64_t)random_bits();
  for (int64_t i = 0; i < 8 * C; i++)
    if (random_bits() % 256 >= sparse) neighbours[i] = (int64_t)(random_bits() % (uint64_t)C);
  for (int64_t i = 0; i < 8 * C; i++)
    for (int64_t f = neighbours[i] < 0 ? 0 : first_child[neighbours[i]]; neighbours[i] >= 0 && f < first_child[neighbours[i] + 1]; f++) {
      const int64_t octant = keys[f] & 7, d = i % 8;
      if ((octant & d) != d) continue;
      counts[9 * ((octant >> 2) - 2 * (d >> 2) + 1) + 3 * ((octant >> 1 & 1) - 2 * (d >> 1 & 1) + 1) + (octant & 1) - 2 * (d & 1) + 1]++;
    }
  for (int edits = take_byte() % 4; edits-- > 0;) {
    const int64_t k = take_index(27);
    counts[k] = take_size(600);
  }
  pair_offsets[0] = 0;
  for (int k = 0; k < 27; k++) pair_offsets[k + 1] = pair_offsets[k] + counts[k];
  for (int i = 0; i < 4; i++) out[i] = new_ints(pair_offsets[27]);
  READ_ONLY(keys, first_child, neighbours, pair_offsets);
  const ast_status status = kernels->octree_pairs(keys, first_child, neighbours, C, pair_offsets, out[0], out[1], out[2], out[3]);
  CHECK(status == AST_OK || status == AST_MISMATCH, "status %d", (int)status);
  for (int64_t i = 0; status == AST_OK && C && i < pair_offsets[27]; i++)
    for (int j = 0; j < 4; j++)
      CHECK(out[j][i] >= 0 && out[j][i] < (j % 2 ? C : first_child[C]), "pair %lld: %lld", (long long)i, (long long)out[j][i]);
  FREE(keys, first_child, neighbours, pair_offsets, out[0], out[1], out[2], out[3]);
}

static void fuzz(const ast_kernels *kernels) {
  const uint8_t byte = take_byte();
  if (byte % 3 == 0) fuzz_build(kernels);
  if (byte % 3 == 1) fuzz_coarsen(kernels);
  if (byte % 3 == 2) fuzz_pairs(kernels);
}
